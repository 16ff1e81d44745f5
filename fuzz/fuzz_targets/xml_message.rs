//! Any bytes are an XML message or are refused. A decoded message is the same after a round trip.

#![no_main]

use fipa_acl::{Message, Representation};
use fipa_fuzz::{message_survives, message_view_agrees, payload};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    if Representation::detect(bytes) != Some(Representation::Xml) {
        return;
    }
    let decoded = Message::decode(&payload(bytes));
    message_view_agrees(bytes, &decoded);
    match decoded {
        Ok(message) => message_survives(&message),
        Err(error) => assert!(error.offset() <= bytes.len()),
    }
});
