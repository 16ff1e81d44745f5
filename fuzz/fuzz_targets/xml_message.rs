//! Any bytes are an XML message or an error; a message that was read survives being written in XML,
//! if it can be written, and bit-efficiently.

#![no_main]

use bytes::Bytes;
use fipa_acl::{Dialect, Message, Payload, Representation};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    if Representation::detect(bytes) != Some(Representation::Xml) {
        return;
    }
    let decoded = Message::decode(&Payload::from(Bytes::copy_from_slice(bytes)));
    let message = match decoded {
        Ok(message) => message,
        Err(error) => return assert!(error.offset() <= bytes.len()),
    };
    assert_eq!(
        Message::decode(&message.to_payload()).as_ref(),
        Ok(&message)
    );
    for dialect in [Dialect::Standard, Dialect::Jade] {
        // Bytes that are no text can be read in XML, but not written.
        if let Ok(encoded) = message.encode(Representation::Xml, dialect) {
            assert_eq!(Message::decode(&encoded.into()).as_ref(), Ok(&message));
        }
    }
    let _ = message.encode(Representation::Xml, Dialect::FipaServices);
});
