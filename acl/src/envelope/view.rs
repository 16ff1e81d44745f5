//! What a transport service looks at in an envelope, without allocating.

use crate::AclRepresentation;
use crate::bitefficient::Text;
use crate::bitefficient::notes::Notes;
use crate::envelope::agent_id::{AgentIdView, AgentIdViews};
use crate::envelope::read::{AclRepresentationView, Event, Parameter, Part, Walk};
use crate::error::DecodeError;

/// An encoded envelope (FIPA00088), checked once and read without allocating.
///
/// Gives what delivery needs: from whom, to whom, and who has stamped it. The values are the
/// effective ones (the newest of each parameter). For everything else there is
/// [`Envelope::decode`](crate::Envelope::decode).
#[derive(Debug, Clone)]
pub struct EnvelopeView<'a> {
    bytes: &'a [u8],
    from: Newest<AgentIdView<'a>>,
    to: Newest<&'a [u8]>,
    intended: Newest<&'a [u8]>,
    acl_representation: Newest<AclRepresentationView<'a>>,
}

impl<'a> EnvelopeView<'a> {
    /// Reads an envelope with its extensions, behind which the payload may follow.
    ///
    /// # Errors
    /// When the bytes do not begin with a whole envelope in the bit-efficient encoding.
    pub fn parse(bytes: &'a [u8]) -> Result<Self, DecodeError> {
        Self::walk(bytes, Walk::new(bytes))
    }

    /// Reads an envelope, and tells `notes` what every byte of it means.
    pub(crate) fn parse_noting(bytes: &'a [u8], notes: impl Notes) -> Result<Self, DecodeError> {
        Self::walk(bytes, Walk::noting(bytes, notes))
    }

    fn walk<N: Notes>(bytes: &'a [u8], mut walk: Walk<'a, N>) -> Result<Self, DecodeError> {
        let mut view = Self {
            bytes: &[],
            from: Newest::default(),
            to: Newest::default(),
            intended: Newest::default(),
            acl_representation: Newest::default(),
        };
        let mut at = Origin {
            part: 0,
            age: Age::Base,
        };
        while let Some(event) = walk.next()? {
            match event {
                Event::Part(part) => {
                    at.part += 1;
                    at.age = Age::of(&part);
                    if let Part::Base(representation, _) = part {
                        view.acl_representation.offer(representation, at);
                    }
                }
                Event::Parameter(Parameter::From(agent)) => view.from.offer(agent, at),
                Event::Parameter(Parameter::To(ids)) if !ids.is_empty() => view.to.offer(ids, at),
                Event::Parameter(Parameter::IntendedReceivers(ids)) if !ids.is_empty() => {
                    view.intended.offer(ids, at);
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
        self.from.value.map(|agent| agent.name)
    }

    /// The names of the agents that this copy of the letter is for: the intended receivers, or
    /// those in `to` when there are none.
    #[must_use]
    pub fn receivers(&self) -> ReceiverNames<'a> {
        let ids = self.intended.value.or(self.to.value).unwrap_or_default();
        ReceiverNames(AgentIdViews::new(ids))
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
        Stamps(Walk::new(self.bytes))
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
pub struct ReceiverNames<'a>(AgentIdViews<'a>);

impl<'a> Iterator for ReceiverNames<'a> {
    type Item = Text<'a>;

    fn next(&mut self) -> Option<Self::Item> {
        self.0.next().map(|agent| agent.name)
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
pub struct Stamps<'a>(Walk<'a>);

impl<'a> Iterator for Stamps<'a> {
    type Item = StampView<'a>;

    fn next(&mut self) -> Option<Self::Item> {
        // An error cannot occur in bytes that were checked, and would end the list.
        while let Some(event) = self.0.next().ok()? {
            let received = match event {
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
        None
    }
}

/// How the parts of an envelope follow each other in time. The standard puts the newest extension
/// first. fipa_services puts the oldest first; its hand is known by the byte counts in front of its
/// texts. Where both are there, ours is the one that came later: fipa_services writes everything
/// anew when it forwards a letter.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Age {
    /// An extension by the standard: newer than all that follow.
    NewestFirst,
    /// An extension of fipa_services: newer than those of its kind in front of it.
    OldestFirst,
    /// The base: older than every extension.
    Base,
}

impl Age {
    pub(super) fn of(part: &Part<'_>) -> Self {
        match part {
            Part::Base(..) => Self::Base,
            Part::Extension(received) if received.by.is_counted() => Self::OldestFirst,
            Part::Extension(_) => Self::NewestFirst,
        }
    }
}

/// Where a value stands.
#[derive(Debug, Clone, Copy)]
struct Origin {
    /// Counts the parts in the order of the bytes.
    part: usize,
    age: Age,
}

/// The newest value of a parameter among those met so far; within one part, the last one.
#[derive(Debug, Clone, Copy)]
struct Newest<T> {
    value: Option<T>,
    origin: Option<Origin>,
}

impl<T> Default for Newest<T> {
    fn default() -> Self {
        Self {
            value: None,
            origin: None,
        }
    }
}

impl<T> Newest<T> {
    fn offer(&mut self, value: T, origin: Origin) {
        let newer = match self.origin {
            None => true,
            Some(known) if known.part == origin.part => true,
            Some(known) => known.age == Age::OldestFirst && origin.age != Age::Base,
        };
        if newer {
            self.value = Some(value);
            self.origin = Some(origin);
        }
    }
}
