//! Any messages with code tables, one after the other, are read or refused; what is read survives
//! being written.

#![no_main]

use fipa_acl::{CodeTable, Message};
use fipa_fuzz::{message_survives, payload};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let mut table = CodeTable::new(8).expect("a size there is");
    // Each but the last has its length in front.
    let mut rest = bytes;
    while let Some((len, behind)) = rest.split_first() {
        let (one, others) = behind.split_at(behind.len().min(usize::from(*len)));
        // Nearly all should be of those that are to be tried.
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
