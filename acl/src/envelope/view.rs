//! A borrowed view of the parameters that a transport service reads in an envelope.

use crate::bitefficient::notes::Notes;
use crate::envelope::parts::{AclRepresentationView, Event, Events, Parameter, Part};
use crate::envelope::read::EnvelopeReader;
use crate::error::DecodeError;
use crate::view::{AgentIdView, AgentIds};
use crate::{AclRepresentation, Representation, Text, xml};

/// An encoded envelope (FIPA00088 or FIPA00085), checked once and read without allocating.
///
/// The view has the parameters for delivery: sender, receivers, encoding of the message, and
/// stamps. Apart from the stamps, the values are the effective ones, the newest of each parameter.
/// [`Envelope::decode`](crate::Envelope::decode) reads all parameters.
#[derive(Debug, Clone)]
pub struct EnvelopeView<'a> {
    bytes: &'a [u8],
    from: Newest<AgentIdView<'a>>,
    to: Newest<AgentIds<'a>>,
    intended: Newest<AgentIds<'a>>,
    acl_representation: Newest<AclRepresentationView<'a>>,
}

impl<'a> EnvelopeView<'a> {
    /// Reads an envelope with its extensions. A payload may follow. An envelope in XML begins with
    /// `<`.
    ///
    /// # Errors
    /// The bytes do not begin with a whole envelope.
    pub fn parse(bytes: &'a [u8]) -> Result<Self, DecodeError> {
        if is_xml(bytes) {
            Self::read(bytes, xml::EnvelopeReader::new(bytes))
        } else {
            Self::read(bytes, EnvelopeReader::new(bytes))
        }
    }

    /// Reads a bit-efficient envelope and notes the meaning of every byte.
    pub(crate) fn parse_noting(bytes: &'a [u8], notes: impl Notes) -> Result<Self, DecodeError> {
        Self::read(bytes, EnvelopeReader::noting(bytes, notes))
    }

    #[inline]
    fn read(bytes: &'a [u8], mut reader: impl Events<'a>) -> Result<Self, DecodeError> {
        let mut view = Self {
            bytes: &[],
            from: Newest::default(),
            to: Newest::default(),
            intended: Newest::default(),
            acl_representation: Newest::default(),
        };
        let mut at = ValuePosition::default();
        while let Some(event) = reader.next()? {
            match event {
                Event::Part(part) => {
                    at = ValuePosition::of(&part, at.part + 1);
                    if let Part::Base(representation, _) = part {
                        view.acl_representation.offer(representation, at);
                    }
                }
                Event::Parameter(Parameter::From(agent)) => view.from.offer(agent, at),
                Event::Parameter(Parameter::To(ids)) => view.to.offer_agents(ids, at),
                Event::Parameter(Parameter::IntendedReceivers(ids)) => {
                    view.intended.offer_agents(ids, at);
                }
                Event::Parameter(Parameter::AclRepresentation(representation)) => {
                    view.acl_representation.offer(representation, at);
                }
                Event::Parameter(_) => {}
            }
        }
        view.bytes = bytes.get(..reader.position()).unwrap_or_default();
        Ok(view)
    }

    /// Name of the agent that sent the letter.
    #[must_use]
    pub fn from_name(&self) -> Option<Text<'a>> {
        self.from.value.map(|agent| agent.name())
    }

    /// Names of the agents that this copy of the letter is for: the intended receivers, or those in
    /// `to` if there are none.
    #[must_use]
    pub fn receivers(&self) -> ReceiverNames<'a> {
        let ids = self.intended.value.as_ref().or(self.to.value.as_ref());
        ReceiverNames(ids.cloned().unwrap_or_default())
    }

    /// Encoding of the message.
    #[must_use]
    pub fn acl_representation(&self) -> Option<AclRepresentation> {
        self.acl_representation
            .value
            .map(AclRepresentationView::to_owned)
    }

    /// Stamps of the services that received the letter, in the order of the bytes. fipa_services
    /// writes some stamps twice.
    #[must_use]
    pub fn stamps(&self) -> Stamps<'a> {
        Stamps(if is_xml(self.bytes) {
            AnyReader::Xml(xml::EnvelopeReader::new(self.bytes))
        } else {
            AnyReader::BitEfficient(EnvelopeReader::new(self.bytes))
        })
    }

    /// Length of the envelope with its extensions, in bytes. The payload begins at this offset.
    #[must_use]
    #[allow(
        clippy::len_without_is_empty,
        reason = "an envelope that was read is never empty"
    )]
    pub fn len(&self) -> usize {
        self.bytes.len()
    }
}

/// Names of the agents that a letter is for: see [`EnvelopeView::receivers`].
#[derive(Debug, Clone)]
pub struct ReceiverNames<'a>(AgentIds<'a>);

impl<'a> Iterator for ReceiverNames<'a> {
    type Item = Text<'a>;

    fn next(&mut self) -> Option<Self::Item> {
        self.0.next().map(|agent| agent.name())
    }
}

/// The parameters of a stamp that a transport service needs to detect loops.
#[derive(Debug, Clone, Copy)]
pub struct StampView<'a> {
    by: Text<'a>,
    from: Option<Text<'a>>,
    id: Option<Text<'a>>,
}

impl<'a> StampView<'a> {
    /// Address or name of the service that received the letter.
    #[must_use]
    pub fn by(&self) -> Text<'a> {
        self.by
    }

    /// The service that sent the letter.
    #[must_use]
    pub fn from(&self) -> Option<Text<'a>> {
        self.from
    }

    /// Identifier of the letter at the service that sent it.
    #[must_use]
    pub fn id(&self) -> Option<Text<'a>> {
        self.id
    }
}

/// The stamps on a letter: see [`EnvelopeView::stamps`].
#[derive(Debug, Clone)]
pub struct Stamps<'a>(AnyReader<'a>);

#[derive(Debug, Clone)]
#[allow(
    clippy::large_enum_variant,
    reason = "it is short-lived, and a box would allocate"
)]
enum AnyReader<'a> {
    BitEfficient(EnvelopeReader<'a>),
    Xml(xml::EnvelopeReader<'a>),
}

impl<'a> Iterator for Stamps<'a> {
    type Item = StampView<'a>;

    fn next(&mut self) -> Option<Self::Item> {
        // An error cannot occur in checked bytes. It would end the iteration.
        loop {
            let event = match &mut self.0 {
                AnyReader::BitEfficient(reader) => reader.next(),
                AnyReader::Xml(reader) => reader.next(),
            };
            let received = match event.ok()?? {
                Event::Part(Part::Extension(received)) => received,
                Event::Parameter(Parameter::Received(received)) => received,
                _ => continue,
            };
            if !received.by.is_empty() {
                return Some(StampView {
                    by: received.by,
                    from: received.from,
                    id: received.id,
                });
            }
        }
    }
}

/// The position of a value: the part of the envelope that has it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct ValuePosition {
    /// Number of the part in the order of the bytes, from 1.
    pub(super) part: usize,
    /// Order of the parts: a newer part has a higher value. Of two equal parts, the later one is
    /// newer.
    ///
    /// In XML, this is the index. In the bit-efficient encoding, the base is older than every
    /// extension, and the standard writes the newest extension first (FIPA00088 2.2: "by adding a
    /// new ExtEnvelope element at the beginning"). fipa_services writes the oldest first. Its
    /// extensions have a byte count in front of each text. If a letter has extensions of both
    /// kinds, those of the standard are newer: fipa_services encodes the whole envelope again when
    /// it forwards a letter.
    pub(super) recency: u64,
}

impl ValuePosition {
    /// Returns the position of a part. `count` is its number unless the part has its own.
    pub(super) fn of(part: &Part<'_>, count: usize) -> Self {
        let (part, recency) = match part {
            Part::Params { part, index } => (*part, *index),
            Part::Base(..) => (count, 0),
            Part::Extension(received) if received.by.is_counted() => (count, count as u64),
            Part::Extension(_) => (count, u64::MAX - count as u64),
        };
        Self { part, recency }
    }
}

/// The newest value of a parameter so far. Within one part, the last value counts.
#[derive(Debug, Clone, Copy)]
struct Newest<T> {
    value: Option<T>,
    position: ValuePosition,
}

impl<T> Default for Newest<T> {
    fn default() -> Self {
        Self {
            value: None,
            position: ValuePosition::default(),
        }
    }
}

impl<T> Newest<T> {
    fn offer(&mut self, value: T, position: ValuePosition) {
        let (known, new) = (&self.position, &position);
        let newer = known.part == new.part || (new.recency, new.part) > (known.recency, known.part);
        if self.value.is_none() || newer {
            self.value = Some(value);
            self.position = position;
        }
    }
}

impl<'a> Newest<AgentIds<'a>> {
    /// Offers a list of agents. In XML, the lists of one part add up. JADE writes an empty list for
    /// a missing one.
    fn offer_agents(&mut self, ids: AgentIds<'a>, position: ValuePosition) {
        if let Some(known) = &mut self.value
            && self.position == position
            && known.add(&ids)
        {
            return;
        }
        if !ids.is_empty() {
            self.offer(ids, position);
        }
    }
}

pub(super) fn is_xml(bytes: &[u8]) -> bool {
    Representation::detect(bytes) == Some(Representation::Xml)
}
