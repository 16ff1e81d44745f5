//! Any sequence of messages with code tables is decoded or refused. A decoded message is the same after
//! a round trip.

#![no_main]

use fipa_acl::{CodeTable, Message};
use fipa_fuzz::{message_survives, payload};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let mut table = CodeTable::new(8).expect("a valid size");
    // Each message but the last has its length in front.
    let mut rest = bytes;
    while let Some((len, behind)) = rest.split_first() {
        let (one, others) = behind.split_at(behind.len().min(usize::from(*len)));
        // A valid message identifier. Two of three messages use code tables.
        let one: Vec<u8> = match one.split_first() {
            Some((id, one)) => [&[0xfa + id % 3], one].concat(),
            None => Vec::new(),
        };
        if let Ok(message) = Message::decode_with_table(&payload(&one), &mut table) {
            message_survives(&message);
        }
        assert!(table.len() <= 256);
        rest = others;
    }
});
