//! The names of the elements of FIPA.

/// The type of an element, by its name in any case and without its prefix.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Tag {
    AclRepresentation,
    Addresses,
    AgentIdentifier,
    Comments,
    Content,
    ConversationId,
    Date,
    Encoding,
    Envelope,
    FipaMessage,
    From,
    InReplyTo,
    IntendedReceiver,
    Language,
    Name,
    Ontology,
    Params,
    PayloadEncoding,
    PayloadLength,
    Protocol,
    Received,
    ReceivedBy,
    ReceivedDate,
    ReceivedFrom,
    ReceivedId,
    ReceivedVia,
    Receiver,
    ReplyBy,
    ReplyTo,
    ReplyWith,
    Resolvers,
    Sender,
    To,
    TransportBehaviour,
    Url,
    UserDefined,
    /// Any other element.
    Other,
}

/// Length of the longest name.
const LONGEST: usize = 19;

impl Tag {
    #[inline]
    pub(super) fn of(name: &[u8]) -> Self {
        let tag = Self::of_lower(name);
        if tag == Self::Other && name.iter().any(u8::is_ascii_uppercase) {
            return Self::of_any(name);
        }
        tag
    }

    #[cold]
    fn of_any(name: &[u8]) -> Self {
        let mut lower = [0; LONGEST];
        let Some(lower) = lower.get_mut(..name.len()) else {
            return Self::Other;
        };
        lower.copy_from_slice(name);
        lower.make_ascii_lowercase();
        Self::of_lower(lower)
    }

    /// Returns the tag with this lowercase name. The match on the length limits the comparisons.
    #[inline]
    fn of_lower(name: &[u8]) -> Self {
        match name.len() {
            2 if name == b"to" => Self::To,
            3 if name == b"url" => Self::Url,
            4 => match name {
                b"name" => Self::Name,
                b"from" => Self::From,
                b"date" => Self::Date,
                _ => Self::Other,
            },
            6 => match name {
                b"sender" => Self::Sender,
                b"params" => Self::Params,
                _ => Self::Other,
            },
            7 if name == b"content" => Self::Content,
            8 => match name {
                b"receiver" => Self::Receiver,
                b"reply-to" => Self::ReplyTo,
                b"reply-by" => Self::ReplyBy,
                b"language" => Self::Language,
                b"encoding" => Self::Encoding,
                b"ontology" => Self::Ontology,
                b"protocol" => Self::Protocol,
                b"received" => Self::Received,
                b"comments" => Self::Comments,
                b"envelope" => Self::Envelope,
                _ => Self::Other,
            },
            9 => match name {
                b"addresses" => Self::Addresses,
                b"resolvers" => Self::Resolvers,
                _ => Self::Other,
            },
            10 if name == b"reply-with" => Self::ReplyWith,
            11 => match name {
                b"in-reply-to" => Self::InReplyTo,
                b"received-by" => Self::ReceivedBy,
                b"received-id" => Self::ReceivedId,
                _ => Self::Other,
            },
            12 => match name {
                b"user-defined" => Self::UserDefined,
                b"fipa-message" => Self::FipaMessage,
                b"received-via" => Self::ReceivedVia,
                _ => Self::Other,
            },
            13 => match name {
                b"received-date" => Self::ReceivedDate,
                b"received-from" => Self::ReceivedFrom,
                _ => Self::Other,
            },
            14 if name == b"payload-length" => Self::PayloadLength,
            15 if name == b"conversation-id" => Self::ConversationId,
            16 => match name {
                b"agent-identifier" => Self::AgentIdentifier,
                b"payload-encoding" => Self::PayloadEncoding,
                _ => Self::Other,
            },
            17 if name == b"intended-receiver" => Self::IntendedReceiver,
            18 if name == b"acl-representation" => Self::AclRepresentation,
            LONGEST if name == b"transport-behaviour" => Self::TransportBehaviour,
            _ => Self::Other,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_read_in_any_case() {
        assert_eq!(Tag::of(b"Transport-BEHAVIOUR"), Tag::TransportBehaviour);
        assert_eq!(Tag::of(b"to"), Tag::To);
        assert_eq!(Tag::of(b"tu"), Tag::Other);
        assert_eq!(Tag::of(b"X-transport-behaviour"), Tag::Other);
    }
}
