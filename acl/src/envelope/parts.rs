//! The events of reading an envelope, for every encoding.

use crate::bitefficient::reader::Reader;
use crate::envelope::read::{ReceivedPart, received_part};
use crate::error::DecodeError;
use crate::view::{AgentIdView, AgentIds};
use crate::{AclRepresentation, Representation, Text, Time, xml};

/// A pull parser of an envelope.
pub(crate) trait Events<'a> {
    /// Reads the next event. Returns `None` behind the envelope.
    fn next(&mut self) -> Result<Option<Event<'a>>, DecodeError>;

    /// Number of bytes read: at the end, the length of the envelope.
    fn position(&self) -> usize;
}

#[derive(Debug)]
pub(crate) enum Event<'a> {
    /// A part begins, or an outer part continues behind a nested one.
    Part(Part<'a>),
    /// A parameter of the current part.
    Parameter(Parameter<'a>),
}

/// A base or an extension envelope.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Part<'a> {
    /// An extension and the stamp in its header (FIPA00088).
    Extension(ReceivedView<'a>),
    /// The base, which comes last (FIPA00088).
    Base(AclRepresentationView<'a>, Time),
    /// A base or an extension in XML (FIPA00085). `part` counts the parts from 1. A newer part has a
    /// higher `index`, and the base has the lowest.
    Params { part: usize, index: u64 },
}

#[derive(Debug, Clone, Copy)]
pub(crate) enum AclRepresentationView<'a> {
    Standard(Representation),
    Named(Text<'a>),
}

impl AclRepresentationView<'_> {
    pub(super) fn to_owned(self) -> AclRepresentation {
        match self {
            Self::Standard(representation) => representation.into(),
            Self::Named(name) => AclRepresentation::from(&*name.as_str()),
        }
    }
}

#[derive(Debug, Clone, Copy)]
pub(crate) struct ReceivedView<'a> {
    pub(crate) by: Text<'a>,
    pub(crate) date: Time,
    pub(crate) from: Option<Text<'a>>,
    pub(crate) id: Option<Text<'a>>,
    pub(crate) via: Option<Text<'a>>,
    pub(crate) parts: StampParts<'a>,
}

/// The encoded parts of a stamp, among them its user-defined parameters.
#[derive(Debug, Clone, Copy)]
pub(crate) enum StampParts<'a> {
    BitEfficient(&'a [u8]),
    Xml(&'a [u8]),
}

#[derive(Debug, Clone)]
pub(crate) enum Parameter<'a> {
    To(AgentIds<'a>),
    From(AgentIdView<'a>),
    AclRepresentation(AclRepresentationView<'a>),
    Comments(Text<'a>),
    PayloadLength(u64),
    PayloadEncoding(Text<'a>),
    Date(Time),
    IntendedReceivers(AgentIds<'a>),
    Received(ReceivedView<'a>),
    TransportBehaviour(Text<'a>),
    UserDefined(UserDefined<'a>),
}

#[derive(Debug, Clone, Copy)]
pub(crate) enum UserDefined<'a> {
    Pair(Text<'a>, Text<'a>),
    /// Name, blank and value in one string (JADE).
    Joined(Text<'a>),
}

impl<'a> ReceivedView<'a> {
    /// Iterates over the user-defined parameters of the stamp.
    pub(super) fn user_defined(&self) -> impl Iterator<Item = UserDefined<'a>> + use<'a> {
        let mut rest = self.parts;
        // An error cannot occur in checked bytes. It would end the iteration.
        std::iter::from_fn(move || match &mut rest {
            StampParts::Xml(rest) => xml::next_received_user_defined(rest),
            StampParts::BitEfficient(rest) => {
                let mut reader = Reader::new(rest);
                while reader.remaining() > 0 {
                    let part = received_part(&mut reader).ok()??;
                    *rest = reader.rest();
                    if let ReceivedPart::UserDefined(found) = part {
                        return Some(found);
                    }
                }
                None
            }
        })
    }
}
