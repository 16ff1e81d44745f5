//! What envelopes consist of, whatever their encoding: a walk through one comes by these.

use crate::bitefficient::reader::Reader;
use crate::envelope::read::{ReceivedPart, received_part};
use crate::error::DecodeError;
use crate::view::{AgentIdView, AgentIds};
use crate::{AclRepresentation, Representation, Text, Time, xml};

/// A walk through an envelope, part by part.
pub(crate) trait Events<'a> {
    /// The next thing, or `None` behind the envelope.
    fn next(&mut self) -> Result<Option<Event<'a>>, DecodeError>;

    /// How many bytes were walked through: in the end, the length of the envelope.
    fn position(&self) -> usize;
}

/// What a walk comes by.
#[derive(Debug)]
pub(crate) enum Event<'a> {
    /// A part begins, or one goes on that another was in.
    Part(Part<'a>),
    /// A parameter of that part.
    Parameter(Parameter<'a>),
}

/// One of the envelopes that an envelope consists of.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Part<'a> {
    /// An extension, with the stamp it begins with (FIPA00088).
    Extension(ReceivedView<'a>),
    /// The base, which is the last one (FIPA00088).
    Base(AclRepresentationView<'a>, Time),
    /// Either (FIPA00085): which part it is, counted from 1, and the index that tells how new it
    /// is; the base is the one with the lowest.
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
    pub(crate) rest: Stamp<'a>,
}

/// Where a stamp has its user-defined parameters, among other things.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Stamp<'a> {
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
    /// Name, a blank, value (JADE).
    Joined(Text<'a>),
}

impl<'a> ReceivedView<'a> {
    /// The user-defined parameters of the stamp.
    pub(super) fn user_defined(&self) -> impl Iterator<Item = UserDefined<'a>> + use<'a> {
        let mut rest = self.rest;
        // An error cannot occur in checked bytes, and would end the list.
        std::iter::from_fn(move || match &mut rest {
            Stamp::Xml(rest) => xml::next_received_user_defined(rest),
            Stamp::BitEfficient(rest) => {
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
