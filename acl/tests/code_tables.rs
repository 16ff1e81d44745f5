//! Messages with dynamic code tables (FIPA00069 2.3).

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

use bytes::Bytes;
use fipa_acl::{CodeTable, DecodeError, Message, Payload, Problem};

fn read(bytes: &[u8], table: &mut CodeTable) -> Result<Message, DecodeError> {
    Message::decode_with_table(&Payload::from(Bytes::copy_from_slice(bytes)), table)
}

fn plain(bytes: &[u8]) -> Message {
    Message::decode(&Payload::from(Bytes::copy_from_slice(bytes))).unwrap()
}

/// A message with every kind of text that enters a table.
const FULL: &[u8] = b"\xfb\x10\x00\x10ping\0\
    \x02\x02\x10alice\0\x02\x10tcp://a:1\0\x01\x03\x02\x10bob\0\x01\x01\x04\x10X-k\0\x10v\0\x01\
    \x05\x70seq\0\x12\x53\0\x14\"a b\"\0\x16\x02cd\x74\"e\"\0\x76\x01f\x40\x56\x01g\x40\
    \x06\x24\x31\x11\x16\x19\x15\x37\x62\x59\x20Z\
    \x00\x10X-prio\0\x12\x80\
    \x04\x16\x03\x00\x01\xff\
    \x01";

/// The same message with the indexes of its texts: performative 0, alice 1, her address 2, bob 3,
/// X-k 4, v 5, seq 6, "a b" 7, cd 8, "e" 9, f 10, g 11, X-prio 12.
const BY_NUMBER: &[u8] = b"\xfc\x10\x00\x11\x00\
    \x02\x02\x11\x01\x02\x11\x02\x01\x03\x02\x11\x03\x01\x01\x04\x11\x04\x11\x05\x01\
    \x05\x71\x06\x12\x53\0\x15\x07\x18\x08\x75\x09\x79\x0a\x40\x59\x0b\x40\
    \x06\x24\x31\x11\x16\x19\x15\x37\x62\x59\x20Z\
    \x00\x11\x0c\x12\x80\
    \x04\x16\x03\x00\x01\xff\
    \x01";

fn without_tables(bytes: &[u8]) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    bytes[0] = 0xfa;
    bytes
}

#[test]
fn texts_of_earlier_messages_are_read_by_index() {
    let mut table = CodeTable::new(8).unwrap();
    let expected = plain(&without_tables(FULL));
    assert_eq!(read(FULL, &mut table), Ok(expected.clone()));
    assert_eq!(table.len(), 13);
    assert_eq!(read(BY_NUMBER, &mut table), Ok(expected));
    assert_eq!(table.len(), 13, "content and numbers never enter");
}

#[test]
fn content_shares_the_memory_of_the_message() {
    let mut table = CodeTable::new(8).unwrap();
    let bytes = Bytes::from_static(FULL);
    let message = Message::decode_with_table(&bytes.clone().into(), &mut table).unwrap();
    let content = message.content().unwrap();
    assert!(bytes.as_ptr_range().contains(&content.as_ptr()));
}

#[test]
fn larger_tables_have_longer_indexes() {
    let mut table = CodeTable::new(9).unwrap();
    let full = b"\xfb\x10\x08\x0c\x10request\0\x01";
    let message = read(full, &mut table).unwrap();
    assert_eq!(message.protocol(), Some("request"));
    assert_eq!(
        read(b"\xfc\x10\x08\x0c\x11\0\0\x01", &mut table),
        Ok(message)
    );
    assert!(CodeTable::new(7).is_none() && CodeTable::new(17).is_none());
}

#[test]
fn messages_with_an_unchanged_table_add_no_entries() {
    let mut table = CodeTable::new(8).unwrap();
    read(b"\xfc\x10\x08\x0c\x10request\0\x01", &mut table).unwrap();
    assert!(table.is_empty());
    read(b"\xfa\x10\x08\x0c\x10request\0\x01", &mut table).unwrap();
    assert!(table.is_empty());
}

#[test]
fn a_full_table_evicts_the_least_recently_used_entries() {
    let mut table = CodeTable::new(8).unwrap();
    let say = |word: usize, table: &mut CodeTable| {
        let mut bytes = b"\xfb\x10\x08\x0c\x10".to_vec();
        bytes.extend(format!("w{word}\0\x01").bytes());
        read(&bytes, table).unwrap();
    };
    let by_number = |code: u8, table: &mut CodeTable| {
        let message = read(&[0xfc, 0x10, 0x08, 0x0c, 0x11, code, 0x01], table);
        message.map(|message| message.protocol().unwrap().to_owned())
    };
    for word in 0..256 {
        say(word, &mut table);
    }
    assert_eq!(table.len(), 256);
    assert_eq!(by_number(0, &mut table).as_deref(), Ok("w0"));
    // The 32 least recently used entries are evicted: w1 to w32.
    say(256, &mut table);
    assert_eq!(table.len(), 225);
    assert_eq!(by_number(0, &mut table).as_deref(), Ok("w0"));
    assert_eq!(by_number(1, &mut table).as_deref(), Ok("w256"));
    assert_eq!(by_number(33, &mut table).as_deref(), Ok("w33"));
    let unknown = by_number(2, &mut table).unwrap_err();
    assert_eq!(unknown.problem(), &Problem::NoSuchCode(2));
    assert!(table.is_empty(), "an error clears the table");
}

#[test]
fn messages_with_code_tables_are_refused_without_a_table() {
    for id in [0xfb, 0xfc] {
        let refused = Message::decode(&Payload::from(Bytes::from(vec![id, 0x10, 0x08, 0x01])));
        assert_eq!(refused.unwrap_err().problem(), &Problem::CodeTable);
    }
}

#[test]
fn the_length_of_an_expanded_message_is_bounded() {
    let mut table = CodeTable::new(8).unwrap();
    let mut full = b"\xfb\x10\x08\x09\x10".to_vec();
    full.extend(vec![b'a'; CodeTable::MAX_TEXT]);
    full.extend(b"\0\x01");
    read(&full, &mut table).unwrap();
    let mut bomb = b"\xfc\x10\x08\x05\x60".to_vec();
    bomb.extend(b"\x11\x00".repeat(100_000));
    bomb.extend(b"\x40\x01");
    let refused = read(&bomb, &mut table).unwrap_err();
    assert_eq!(refused.problem(), &Problem::TooLong("message"));

    let mut long = b"\xfb\x10\x08\x09\x10".to_vec();
    long.extend(vec![b'a'; CodeTable::MAX_TEXT + 1]);
    long.extend(b"\0\x01");
    assert!(read(&long, &mut table).is_err());
    let deep = [&b"\xfc\x10\x08\x05"[..], &[0x60; 1000]].concat();
    let refused = read(&deep, &mut table).unwrap_err();
    assert_eq!(refused.problem(), &Problem::TooDeep("expressions"));
}

#[test]
fn truncated_messages_are_refused() {
    let mut filled = CodeTable::new(8).unwrap();
    read(FULL, &mut filled).unwrap();
    for bytes in [FULL, BY_NUMBER] {
        for len in 0..bytes.len() {
            assert!(read(&bytes[..len], &mut filled.clone()).is_err(), "{len}");
        }
        let behind = [bytes, b"?"].concat();
        assert!(read(&behind, &mut filled.clone()).is_err());
    }
}
