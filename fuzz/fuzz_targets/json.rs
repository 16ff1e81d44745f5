//! Any JSON is a message or a letter or is refused. A decoded message or letter can be encoded.

#![no_main]

use fipa_acl::json::{Document, document_from_json};
use fipa_fuzz::{envelope_survives, message_survives};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let Ok(json) = serde_json::from_slice(bytes) else {
        return;
    };
    match document_from_json(&json) {
        Ok(Document::Message(message)) => message_survives(&message),
        Ok(Document::Letter(envelope, message)) => {
            envelope_survives(&envelope);
            message_survives(&message);
        }
        Ok(Document::EncodedLetter(envelope, _)) => envelope_survives(&envelope),
        Err(error) => drop(error.to_string()),
    }
});
