//! Any bytes are a bit-efficient message or an error; a message that was read survives being
//! written, whole and split around its content, and as JSON.

#![no_main]

use bytes::Bytes;
use fipa_acl::json::{message_from_json, message_to_json};
use fipa_acl::{Message, MessageView, Payload, Representation};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    if Representation::detect(bytes) != Some(Representation::BitEfficient) {
        return;
    }
    let decoded = Message::decode(&Payload::from(Bytes::copy_from_slice(bytes)));
    assert_eq!(decoded.is_ok(), MessageView::parse(bytes).is_ok());
    let Ok(message) = decoded else { return };
    let payload = message.to_payload();
    assert_eq!(payload.len(), fipa_acl::bitefficient::encoded_len(&message));
    assert_eq!(Message::decode(&payload).as_ref(), Ok(&message));
    let whole = Payload::from(payload.to_bytes());
    assert_eq!(Message::decode(&whole).as_ref(), Ok(&message));
    message_from_json(&message_to_json(&message)).expect("a message survives JSON");
    let _ = message.to_string();
});
