//! Any bytes from a process are a record or are refused. For any records, the watcher reports no letter
//! twice and stays within its limits. The records that this project writes are accepted.

#![no_main]

use std::collections::HashSet;
use std::time::{Duration, Instant, SystemTime};

use bytes::Bytes;
use fipa_acl::{Envelope, Letter};
use fipa_mts::core::{News, Notice, SubmissionId};
use fipa_mts::watch::record::{MAX_CONTENT, MAX_LEN, RecordBody, Wish, of};
use fipa_mts::watch::{Event, Joiner, Record, RecordSource};
use fipa_transport::{Incarnation, Stream};
use libfuzzer_sys::fuzz_target;

/// Offsets of the lengths of the five parts in the header, and of the end of the header.
const LENGTHS: usize = 72;
const HEADER: usize = 96;

fuzz_target!(|bytes: &[u8]| {
    let _ = Wish::parse(bytes);
    let whole = Bytes::copy_from_slice(bytes);
    // Payloads that are not a message are recorded, too.
    let envelope_len = Envelope::decode(&whole).map_or(bytes.len() / 2, |(_, len)| len);
    let (envelope, payload) = (whole.slice(..envelope_len), whole.slice(envelope_len..));
    written_records_are_accepted(&Letter::new(envelope, payload));
    let mut joiner = Joiner::new();
    joiner.handle_begin(RecordSource(0), "arm_2");
    let mut now = Instant::now();
    let mut reported = HashSet::new();
    let mut rest = bytes;
    let mut number = 0_u64;
    while let Some(([kind, wait, low, high], after)) = rest.split_first_chunk::<4>() {
        let len = usize::from(u16::from_le_bytes([*low, *high])).min(after.len());
        let (record, after) = after.split_at(len);
        rest = after;
        number += 1;
        let source = RecordSource(number % 3);
        // A record of kind 0 stays unchanged. Other records get a valid header.
        let record = match kind {
            0 => record.to_vec(),
            kind => repaired(*kind, record),
        };
        match Record::parse(&record) {
            Ok(record) => {
                if let RecordBody::Letter { letter, .. } = &record.body {
                    let given = letter.content().len();
                    assert!(given <= MAX_CONTENT);
                    assert!(given as u64 <= letter.content_len.unwrap_or(0));
                }
                joiner.handle(now, source, record);
            }
            Err(error) => {
                assert!(!error.to_string().is_empty());
                joiner.handle_malformed(source, error);
            }
        }
        now += Duration::from_millis(u64::from(*wait));
        while let Some(event) = joiner.poll_event(now) {
            note(&event, &mut reported);
        }
    }
    while let Some(event) = joiner.finish() {
        note(&event, &mut reported);
    }
});

fn note(event: &Event, reported: &mut HashSet<(Incarnation, u64)>) {
    if let Event::Letter(passage) = event {
        let letter = (passage.stream.sender, passage.sequence);
        assert!(reported.insert(letter), "a letter was reported twice");
    }
}

/// Returns the record with a valid magic number, version and kind, and matching lengths, so that
/// the parser reads the parts behind the header.
fn repaired(kind: u8, record: &[u8]) -> Vec<u8> {
    let mut record = record.to_vec();
    record.resize(record.len().max(HEADER), 0);
    record[..6].copy_from_slice(&[b'f', b'i', b'p', b'w', 1, kind % 8]);
    let mut left = u32::try_from(record.len() - HEADER).expect("inputs are short");
    for part in 0..5 {
        let at = LENGTHS + part * 4;
        let said: [u8; 4] = record[at..at + 4].try_into().expect("four bytes");
        let len = match part {
            4 => left,
            _ => (u32::from_le_bytes(said) % 256).min(left),
        };
        left -= len;
        record[at..at + 4].copy_from_slice(&len.to_le_bytes());
    }
    record
}

fn written_records_are_accepted(letter: &Letter) {
    let notice = Notice {
        stream: Stream::between(Incarnation::from_u64(7), Incarnation::from_u64(8)),
        sequence: 3,
        receiver: "arm_1".into(),
        news: News::Sent {
            submission: Some(SubmissionId(9)),
            letter: letter.clone(),
        },
    };
    for content in [0, 10, u32::MAX] {
        let at = SystemTime::UNIX_EPOCH + Duration::from_secs(1_700_000_000);
        let written = of(&notice, Wish { content }, at);
        assert!(written.len() <= MAX_LEN);
        let record = Record::parse(&written).expect("a written record can be read");
        let RecordBody::Letter { letter: seen, .. } = record.body else {
            panic!("a record of another kind");
        };
        assert_eq!(seen.size, letter.len() as u64);
        assert!(seen.content().len() as u64 <= u64::from(content));
    }
}
