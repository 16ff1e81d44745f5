//! What several fuzz targets check.

use std::fmt::Debug;

use bytes::Bytes;
use fipa_acl::json::{Document, document_from_json, envelope_to_json, message_to_json};
use fipa_acl::{Dialect, Envelope, Message, Payload, Representation};
use serde_json::json;

const DIALECTS: [Dialect; 3] = [Dialect::Standard, Dialect::FipaServices, Dialect::Jade];

/// A message that was read survives every encoding in every dialect that can say it, and JSON.
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
            let Ok(written) = message.encode(representation, dialect) else {
                continue;
            };
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
    // Where all times are in UTC.
    assert!(matches!(again, Document::Message(_)));
    let _ = message.to_string();
}

/// An envelope that was read survives both encodings in every dialect that can say it.
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
                // JADE reads one part only.
                assert_eq!(again.base, envelope.effective());
            } else {
                same(&again, envelope, dialect);
            }
        }
    }
}

/// fipa_services gets times without their zone.
fn same<T: Debug + PartialEq>(one: &T, other: &T, dialect: Dialect) {
    if dialect == Dialect::FipaServices {
        let local = |what: &T| format!("{what:?}").replace("zone: Utc", "zone: Unspecified");
        assert_eq!(local(one), local(other));
    } else {
        assert_eq!(one, other, "{dialect}");
    }
}

/// The bytes as a message that lies in one piece.
pub fn payload(bytes: &[u8]) -> Payload {
    Payload::from(Bytes::copy_from_slice(bytes))
}
