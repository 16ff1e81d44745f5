//! Checks that several fuzz targets share.

pub mod access;
pub mod actions;
pub mod config;
pub mod datagrams;
pub mod delivery;
pub mod exchange;
pub mod framed;
pub mod host;
pub mod http;
pub mod input;
pub mod locking;
pub mod mdns;
pub mod platform;
pub mod quic;
pub mod seeds;
pub mod shm;
pub mod texts;
pub mod udt;

use std::fmt::Debug;

use bytes::Bytes;
use fipa_acl::json::{Document, document_from_json, envelope_to_json, message_to_json};
use fipa_acl::{
    AgentId, AgentIdView, DecodeError, Dialect, Envelope, EnvelopeView, Message, MessageIndex,
    MessageView, Payload, Representation,
};
use serde_json::json;

const DIALECTS: [Dialect; 3] = [Dialect::Standard, Dialect::FipaServices, Dialect::Jade];

/// Checks that a decoded message is the same after a round trip in every encoding and dialect that can
/// represent it, and in JSON.
pub fn message_survives(message: &Message) {
    let payload = message.to_payload();
    assert_eq!(payload.len(), fipa_acl::bitefficient::encoded_len(message));
    assert_eq!(Message::decode(&payload).as_ref(), Ok(message));
    let whole = Payload::from(payload.to_bytes());
    assert_eq!(Message::decode(&whole).as_ref(), Ok(message));
    for representation in [
        Representation::BitEfficient,
        Representation::String,
        Representation::Xml,
    ] {
        for dialect in DIALECTS {
            let len = message.encoded_len(representation, dialect);
            let Ok(written) = message.encode(representation, dialect) else {
                assert!(len.is_err());
                continue;
            };
            assert_eq!(len, Ok(written.len()));
            let mut into = Vec::new();
            let again = message.encode_into(representation, dialect, &mut into);
            assert_eq!((again, &into[..]), (Ok(()), &written[..]));
            assert_eq!(Representation::detect(&written), Some(representation));
            let again = Message::decode(&written.into());
            let again = again.unwrap_or_else(|error| {
                panic!("{representation} for {dialect} cannot be read: {error}")
            });
            same(&again, message, dialect);
        }
    }
    let json = json!({ "message": message_to_json(message) });
    let again = document_from_json(&json).expect("a message survives JSON");
    // This JSON has no envelope, so it is a message and not a letter.
    assert!(matches!(again, Document::Message(_)));
    let _ = message.to_string();
}

/// Checks that a decoded envelope is the same after a round trip in both encodings and in every dialect
/// that can represent it.
pub fn envelope_survives(envelope: &Envelope) {
    let _ = envelope_to_json(envelope);
    for representation in [Representation::BitEfficient, Representation::Xml] {
        for dialect in DIALECTS {
            let Ok(written) = envelope.encode(representation, dialect) else {
                continue;
            };
            let read = Envelope::decode(&written);
            let (again, len) = read.unwrap_or_else(|error| {
                panic!("{representation} for {dialect} cannot be read: {error}")
            });
            assert_eq!(len, written.len());
            if representation == Representation::Xml && dialect == Dialect::Jade {
                // JADE reads only one part of an envelope.
                assert_eq!(again.base, envelope.effective());
            } else {
                same(&again, envelope, dialect);
            }
        }
    }
}

/// Checks that both values are the same. The dialect of fipa_services has times without a zone.
fn same<T: Debug + PartialEq>(one: &T, other: &T, dialect: Dialect) {
    if dialect == Dialect::FipaServices {
        let local = |what: &T| format!("{what:?}").replace("zone: Utc", "zone: Unspecified");
        assert_eq!(local(one), local(other));
    } else {
        assert_eq!(one, other, "{dialect}");
    }
}

/// Checks that the view and the index of a message have the same values as the message, or the same
/// error.
pub fn message_view_agrees(bytes: &[u8], decoded: &Result<Message, DecodeError>) {
    let view = MessageView::parse(bytes);
    assert_eq!(decoded.as_ref().err(), view.as_ref().err());
    message_index_agrees(&payload(bytes), decoded);
    let (Ok(message), Ok(view)) = (decoded, view) else {
        return;
    };
    assert_eq!(
        view.content().as_deref(),
        message.content().map(|all| &**all)
    );
    let names = |agents: &mut dyn Iterator<Item = AgentIdView<'_>>| -> Vec<String> {
        agents.map(|agent| agent.name().to_string()).collect()
    };
    let owned = |agents: &[AgentId]| -> Vec<String> {
        agents.iter().map(|agent| agent.name().to_owned()).collect()
    };
    assert_eq!(names(&mut view.receivers()), owned(message.receivers()));
    assert_eq!(names(&mut view.reply_to()), owned(message.reply_to()));
    assert_eq!(view.user_defined().count(), message.user_defined().len());
}

/// Checks that the index of a message gives the same message, or the same error.
fn message_index_agrees(payload: &Payload, decoded: &Result<Message, DecodeError>) {
    let index = MessageIndex::of(payload);
    assert_eq!(decoded.as_ref().err(), index.as_ref().err());
    let (Ok(message), Ok(index)) = (decoded, index) else {
        return;
    };
    assert_eq!(index.to_message(payload), *message);
    assert_eq!(index.content(payload).as_ref(), message.content());
}

/// Checks that the view of an envelope has the same values as the envelope.
pub fn envelope_view_agrees(bytes: &[u8], envelope: &Envelope, len: usize) {
    let view = EnvelopeView::parse(bytes).expect("the view is not stricter");
    assert_eq!(view.len(), len);
    let effective = envelope.effective();
    let from = effective.from.as_ref().map(|agent| agent.name().to_owned());
    assert_eq!(view.from_name().map(|name| name.to_string()), from);
    assert_eq!(view.acl_representation(), effective.acl_representation);
    let receivers: Vec<_> = view.receivers().map(|name| name.to_string()).collect();
    let named = if effective.intended_receivers.is_empty() {
        &effective.to
    } else {
        &effective.intended_receivers
    };
    let named: Vec<_> = named.iter().map(|agent| agent.name().to_owned()).collect();
    assert_eq!(receivers, named);
    let _ = view.stamps().count();
}

/// Returns the bytes as a message in one piece.
pub fn payload(bytes: &[u8]) -> Payload {
    Payload::from(Bytes::copy_from_slice(bytes))
}
