//! Any text is a string message or an error; a message that was read survives being written in
//! every dialect that can say it, and bit-efficiently.

#![no_main]

use bytes::Bytes;
use fipa_acl::{Dialect, Message, Payload, Representation};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    // What begins otherwise is the other targets' business.
    if Representation::detect(bytes) != Some(Representation::String) {
        return;
    }
    let Ok(message) = Message::decode(&Payload::from(Bytes::copy_from_slice(bytes))) else {
        return;
    };
    assert_eq!(
        Message::decode(&message.to_payload()).as_ref(),
        Ok(&message)
    );
    for dialect in [Dialect::Standard, Dialect::FipaServices, Dialect::Jade] {
        let Ok(written) = message.encode(Representation::String, dialect) else {
            continue;
        };
        let again = Message::decode(&written.into()).expect("what was written can be read");
        match dialect {
            // Times go there without their zone.
            Dialect::FipaServices => {
                let rewritten = again.encode(Representation::String, dialect);
                assert_eq!(rewritten, message.encode(Representation::String, dialect));
                assert_eq!(again.content(), message.content());
                assert_eq!(again.sender(), message.sender());
                assert_eq!(again.receivers(), message.receivers());
                assert_eq!(again.user_defined(), message.user_defined());
            }
            _ => assert_eq!(again, message, "{dialect}"),
        }
    }
});
