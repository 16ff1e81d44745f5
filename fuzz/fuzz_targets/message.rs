//! Any bytes are a bit-efficient message or are refused. A decoded message is the same after a round
//! trip. The view and the explanation agree with the decoder.

#![no_main]

use fipa_acl::{Message, Representation, explain};
use fipa_fuzz::{message_survives, message_view_agrees, payload};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    if !matches!(bytes.first(), Some(0xfa..=0xfc)) {
        return;
    }
    assert_eq!(
        Representation::detect(bytes),
        Some(Representation::BitEfficient)
    );
    let decoded = Message::decode(&payload(bytes));
    message_view_agrees(bytes, &decoded);
    assert_eq!(decoded.as_ref().err(), explain(bytes).error.as_ref());
    if let Ok(message) = decoded {
        message_survives(&message);
    }
});
