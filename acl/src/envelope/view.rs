//! What a transport service looks at in an envelope, without allocating.

use crate::bitefficient::notes::Notes;
use crate::envelope::parts::{AclRepresentationView, Event, Events, Parameter, Part};
use crate::envelope::read::Walk;
use crate::error::DecodeError;
use crate::view::{AgentIdView, AgentIds};
use crate::{AclRepresentation, Representation, Text, xml};

/// An encoded envelope (FIPA00088 or FIPA00085), checked once and read without allocating.
///
/// Gives what delivery needs: from whom, to whom, and who has stamped it. The values are the
/// effective ones (the newest of each parameter). For everything else there is
/// [`Envelope::decode`](crate::Envelope::decode).
#[derive(Debug, Clone)]
pub struct EnvelopeView<'a> {
    bytes: &'a [u8],
    from: Newest<AgentIdView<'a>>,
    to: Newest<AgentIds<'a>>,
    intended: Newest<AgentIds<'a>>,
    acl_representation: Newest<AclRepresentationView<'a>>,
}

impl<'a> EnvelopeView<'a> {
    /// Reads an envelope with its extensions, behind which the payload may follow. XML is told by
    /// its `<`.
    ///
    /// # Errors
    /// When the bytes do not begin with a whole envelope.
    pub fn parse(bytes: &'a [u8]) -> Result<Self, DecodeError> {
        if is_xml(bytes) {
            Self::walk(bytes, xml::Walk::new(bytes))
        } else {
            Self::walk(bytes, Walk::new(bytes))
        }
    }

    /// Reads a bit-efficient envelope, and tells `notes` what every byte of it means.
    pub(crate) fn parse_noting(bytes: &'a [u8], notes: impl Notes) -> Result<Self, DecodeError> {
        Self::walk(bytes, Walk::noting(bytes, notes))
    }

    #[inline]
    fn walk(bytes: &'a [u8], mut walk: impl Events<'a>) -> Result<Self, DecodeError> {
        let mut view = Self {
            bytes: &[],
            from: Newest::default(),
            to: Newest::default(),
            intended: Newest::default(),
            acl_representation: Newest::default(),
        };
        let mut at = Origin::default();
        while let Some(event) = walk.next()? {
            match event {
                Event::Part(part) => {
                    at = Origin::of(&part, at.part + 1);
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
        view.bytes = bytes.get(..walk.position()).unwrap_or_default();
        Ok(view)
    }

    /// The name of the agent that sent the letter.
    #[must_use]
    pub fn from_name(&self) -> Option<Text<'a>> {
        self.from.value.map(|agent| agent.name())
    }

    /// The names of the agents that this copy of the letter is for: the intended receivers, or
    /// those in `to` when there are none.
    #[must_use]
    pub fn receivers(&self) -> ReceiverNames<'a> {
        let ids = self.intended.value.as_ref().or(self.to.value.as_ref());
        ReceiverNames(ids.cloned().unwrap_or_default())
    }

    /// How the message is encoded.
    #[must_use]
    pub fn acl_representation(&self) -> Option<AclRepresentation> {
        self.acl_representation
            .value
            .map(AclRepresentationView::to_owned)
    }

    /// The stamps of the services that the letter passed, in the order of the bytes. A peer may
    /// have written one twice.
    #[must_use]
    pub fn stamps(&self) -> Stamps<'a> {
        Stamps(if is_xml(self.bytes) {
            AnyWalk::Xml(xml::Walk::new(self.bytes))
        } else {
            AnyWalk::BitEfficient(Walk::new(self.bytes))
        })
    }

    /// Length of the envelope with its extensions in bytes: the payload begins here.
    #[must_use]
    #[allow(
        clippy::len_without_is_empty,
        reason = "an envelope that was read is never empty"
    )]
    pub fn len(&self) -> usize {
        self.bytes.len()
    }
}

/// The names of the agents that a letter is for: see [`EnvelopeView::receivers`].
#[derive(Debug, Clone)]
pub struct ReceiverNames<'a>(AgentIds<'a>);

impl<'a> Iterator for ReceiverNames<'a> {
    type Item = Text<'a>;

    fn next(&mut self) -> Option<Self::Item> {
        self.0.next().map(|agent| agent.name())
    }
}

/// The stamp of a transport service, as far as loops are to be noticed.
#[derive(Debug, Clone, Copy)]
pub struct StampView<'a> {
    by: Text<'a>,
    id: Option<Text<'a>>,
}

impl<'a> StampView<'a> {
    /// Address or name of the service that received the letter.
    #[must_use]
    pub fn by(&self) -> Text<'a> {
        self.by
    }

    /// What identifies the letter at the service that sent it.
    #[must_use]
    pub fn id(&self) -> Option<Text<'a>> {
        self.id
    }
}

/// The stamps on a letter: see [`EnvelopeView::stamps`].
#[derive(Debug, Clone)]
pub struct Stamps<'a>(AnyWalk<'a>);

#[derive(Debug, Clone)]
#[allow(
    clippy::large_enum_variant,
    reason = "nobody keeps one, and a box would allocate"
)]
enum AnyWalk<'a> {
    BitEfficient(Walk<'a>),
    Xml(xml::Walk<'a>),
}

impl<'a> Iterator for Stamps<'a> {
    type Item = StampView<'a>;

    fn next(&mut self) -> Option<Self::Item> {
        // An error cannot occur in bytes that were checked, and would end the list.
        loop {
            let event = match &mut self.0 {
                AnyWalk::BitEfficient(walk) => walk.next(),
                AnyWalk::Xml(walk) => walk.next(),
            };
            let received = match event.ok()?? {
                Event::Part(Part::Extension(received)) => received,
                Event::Parameter(Parameter::Received(received)) => received,
                _ => continue,
            };
            if !received.by.is_empty() {
                return Some(StampView {
                    by: received.by,
                    id: received.id,
                });
            }
        }
    }
}

/// Where a value stands.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Origin {
    /// Counts the parts in the order of the bytes, from 1.
    pub(super) part: usize,
    /// How new the part is, compared to others; of two as new as each other, the later one counts.
    ///
    /// In XML the index says so. In the bit-efficient encoding the base is older than every
    /// extension, and the standard puts the newest extension first. fipa_services puts the oldest
    /// first; its hand is known by the byte counts in front of its texts. Where both are there,
    /// ours is the one that came later: fipa_services writes everything anew when it forwards a
    /// letter.
    pub(super) age: u64,
}

impl Origin {
    /// Of a part, which is this one unless it says itself.
    pub(super) fn of(part: &Part<'_>, count: usize) -> Self {
        let (part, age) = match part {
            Part::Params { part, index } => (*part, *index),
            Part::Base(..) => (count, 0),
            Part::Extension(received) if received.by.is_counted() => (count, count as u64),
            Part::Extension(_) => (count, u64::MAX - count as u64),
        };
        Self { part, age }
    }
}

/// The newest value of a parameter among those met so far; within one part, the last one.
#[derive(Debug, Clone, Copy)]
struct Newest<T> {
    value: Option<T>,
    origin: Origin,
}

impl<T> Default for Newest<T> {
    fn default() -> Self {
        Self {
            value: None,
            origin: Origin::default(),
        }
    }
}

impl<T> Newest<T> {
    fn offer(&mut self, value: T, origin: Origin) {
        let (known, new) = (&self.origin, &origin);
        let newer = known.part == new.part || (new.age, new.part) > (known.age, known.part);
        if self.value.is_none() || newer {
            self.value = Some(value);
            self.origin = origin;
        }
    }
}

impl<'a> Newest<AgentIds<'a>> {
    /// The lists of one part add up in XML; a list that is empty is how JADE says that there is
    /// none.
    fn offer_agents(&mut self, ids: AgentIds<'a>, origin: Origin) {
        if let Some(known) = &mut self.value
            && self.origin == origin
            && known.add(&ids)
        {
            return;
        }
        if !ids.is_empty() {
            self.offer(ids, origin);
        }
    }
}

pub(super) fn is_xml(bytes: &[u8]) -> bool {
    Representation::detect(bytes) == Some(Representation::Xml)
}
