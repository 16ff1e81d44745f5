//! Reads changed files and files that announce more than they have.
//!
//! `FIPA_FUZZ_SEED` repeats the inputs of an earlier run, and `FIPA_FUZZ_INPUTS` is their number.

#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "a panic fails the test"
)]

use std::collections::BTreeMap;
use std::io::Cursor;

use allocation_counter::measure;
use fastrand::Rng;
use mcap::WriteOptions;

use super::super::letter::RecordedLetter;
use super::*;

#[path = "../../../../../tests/common/mcap_file.rs"]
#[allow(dead_code, reason = "not all items are used here")]
#[allow(clippy::indexing_slicing, reason = "a panic fails the test")]
mod mcap_file;

use mcap_file::{Compression, chunk, chunk_of, rechunked, record};

/// More memory than a file of any content takes: a record and a chunk, and twice as much while they grow.
const MEMORY: u64 = 5 * MAX_RECORD as u64;

/// More memory than the pairs of texts of a file take beside its chunks.
const PAIRS_MEMORY: u64 = 96 << 20;

/// A letter as `fipa record` writes it.
const LETTER: &str = r#"{"event":"letter","number":1,"sender":"rover","receiver":"arm","content_length":2,
    "outcome":"delivered","verdict":{"verdict":"violation","protocol":"fipa-request"},
    "letter":{"message":{"performative":"inform","sender":{"name":"rover"},"content":"hi"}},
    "check":{"answer_within_ms":7,"may_continue":true}}"#;

/// A file of several chunks with all kinds of records.
fn file() -> Vec<u8> {
    let mut file = Cursor::new(Vec::new());
    let options = WriteOptions::new()
        .chunk_size(Some(600))
        .disable_seeking(true);
    let mut writer = options.create(&mut file).unwrap();
    let pairs: BTreeMap<String, String> =
        [("a".into(), "b".into()), ("c".into(), "d".into())].into();
    let about = Metadata {
        name: "fipa.recording".to_owned(),
        metadata: pairs.clone(),
    };
    writer.write_metadata(&about).unwrap();
    let schema = writer
        .add_schema("fipa.Letter", "jsonschema", b"{}")
        .unwrap();
    for number in 0..8 {
        let topic = format!("/letters/arm_{}", number % 3);
        let channel_id = writer.add_channel(schema, &topic, "json", &pairs).unwrap();
        let header = MessageHeader {
            channel_id,
            sequence: number,
            log_time: u64::from(number) << 40,
            publish_time: u64::from(number) << 40,
        };
        writer
            .write_to_known_channel(&header, LETTER.as_bytes())
            .unwrap();
    }
    writer.finish().unwrap();
    drop(writer);
    file.into_inner()
}

/// A source that returns few bytes at once.
struct Slow<'a>(&'a [u8], Rng);

impl Read for Slow<'_> {
    fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
        let most = self.1.usize(1..50).min(into.len());
        self.0.read(&mut into[..most])
    }
}

/// The items and the end of a file, as text.
fn read_all(source: impl Read) -> Vec<String> {
    let mut all = Vec::new();
    let failed = |error: &RecordingError| Failure::failed(error.to_string(), String::new(), "");
    let end = read(source, failed, |item| {
        all.push(match &item {
            Item::Message { header, data, .. } => {
                // The letter is read or refused.
                let letter = RecordedLetter::read(data, header.publish_time);
                if let Ok(letter) = &letter {
                    let _ = (letter.letter(), letter.traits());
                }
                format!("{item:?} {letter:?}")
            }
            Item::Metadata(_) => format!("{item:?}"),
        });
        Ok(())
    });
    all.push(match end {
        Ok(end) => format!(
            "{} {:?}",
            end.is_closed,
            end.damage.map(|it| it.to_string())
        ),
        Err(_) => "refused".to_owned(),
    });
    all
}

/// Reads a file with at most this memory. Returns its end as text.
#[track_caller]
fn read_within(most: u64, file: &[u8]) -> String {
    let mut last = None;
    let memory = measure(|| {
        let failed = |error: &RecordingError| Failure::failed(error.to_string(), String::new(), "");
        let end = read(file, failed, |_| Ok(()));
        last = Some(match end {
            Ok(end) => format!(
                "{} {:?}",
                end.is_closed,
                end.damage.map(|it| it.to_string())
            ),
            Err(_) => "refused".to_owned(),
        });
    });
    assert!(memory.bytes_max < most, "{} bytes", memory.bytes_max);
    last.unwrap()
}

/// Changes some bytes: random ones, extreme lengths, cuts and repetitions.
fn mutate(random: &mut Rng, bytes: &mut Vec<u8>) {
    for _ in 0..random.usize(1..6) {
        if bytes.len() < 16 {
            return;
        }
        let at = random.usize(..bytes.len() - 8);
        match random.u8(..7) {
            0 => bytes[at] = random.u8(..),
            1 => bytes[at] ^= 1 << random.u8(..8),
            2 => bytes[at..at + 4].copy_from_slice(&u32::MAX.to_le_bytes()),
            3 => {
                let numbers = [u64::MAX, 1 << 32, MAX_RECORD as u64, 1 << 63, 0];
                let number = random.choice(numbers).unwrap();
                bytes[at..at + 8].copy_from_slice(&number.to_le_bytes());
            }
            4 => bytes.truncate(at),
            5 => {
                let end = at + random.usize(..bytes.len() - at);
                drop(bytes.drain(at..end));
            }
            _ => {
                let end = at + random.usize(..bytes.len() - at);
                let again = bytes[at..end].to_vec();
                bytes.splice(at..at, again);
            }
        }
    }
}

#[test]
fn changed_files_are_read_to_the_damage_whatever_their_pieces() {
    let number = |name: &str| std::env::var(name).ok()?.parse::<u64>().ok();
    let seed = number("FIPA_FUZZ_SEED").unwrap_or_else(|| fastrand::u64(..));
    println!("FIPA_FUZZ_SEED={seed}");
    let mut random = Rng::with_seed(seed);
    let file = file();
    let whole = read_all(&file[..]);
    assert_eq!(
        (whole.len(), whole.last().unwrap().as_str()),
        (10, "true None")
    );
    let mut read_further = 0;
    for _ in 0..number("FIPA_FUZZ_INPUTS").unwrap_or(600) {
        // In bytes of the file, whose checksums are then wrong.
        let mut changed = file.clone();
        mutate(&mut random, &mut changed);
        let in_file = read_all(&changed[..]);
        assert_eq!(read_all(Slow(&changed, random.fork())), in_file);

        // In the records of a chunk, with valid checksums.
        let seed = random.u64(..);
        let [stored, packed] = [Compression::None, Compression::Zstd].map(|compression| {
            let mut random = Rng::with_seed(seed);
            let chunks = random.u32(1..);
            let mut number = 0;
            let changed = rechunked(&file, compression, |records| {
                if chunks >> (number % 32) & 1 == 1 {
                    mutate(&mut random, records);
                }
                number += 1;
            });
            read_all(&changed[..])
        });
        assert_eq!(stored, packed);
        read_further += usize::from(stored.len() > 2);

        // Anything behind the magic number.
        let mut noise = file[..8].to_vec();
        noise.extend((0..random.usize(..200)).map(|_| random.u8(..)));
        read_within(MEMORY, &noise);
    }
    assert!(
        read_further > 50,
        "the changes are too coarse: {read_further}"
    );
}

/// Zeros of this length in blocks of zstd, each of which is one byte that is repeated (RFC 8878 3.1.1.2).
fn zeros(mut len: u64, window: u8) -> Vec<u8> {
    const BLOCK: u64 = 128 << 10;
    let mut zstd = vec![0x28, 0xb5, 0x2f, 0xfd, 0x00, window];
    while len > 0 {
        let block = len.min(BLOCK);
        len -= block;
        let header = block << 3 | 1 << 1 | u64::from(len == 0);
        zstd.extend(&header.to_le_bytes()[..3]);
        zstd.push(0);
    }
    zstd
}

#[test]
fn chunks_that_announce_or_unpack_to_gigabytes_take_bounded_memory() {
    let file = file();
    let limit = MAX_RECORD as u64;
    let read = |record: &[u8]| read_within(MEMORY, &[&file[..8], record].concat());
    // The exponent 13 of the format is a window of 8 MiB, and 31 is one of 2 TiB.
    let (usual, largest) = (13 << 3, 31 << 3);
    for (announced, len, window, expected) in [
        (4 << 30, 10, usual, "4294967296"),
        (u64::MAX, 10, usual, &*u64::MAX.to_string()),
        (limit + 1, limit + 1, usual, "67108865"),
        // It unpacks to more than it announces: the rest is not unpacked.
        (9, 1 << 30, usual, "None"),
        (limit, limit, usual, "malformed"),
        // And to less.
        (limit, 9, usual, "malformed"),
        (9, 9, largest, "memory"),
    ] {
        let chunk = chunk_of(announced, 0, "zstd", &zeros(len, window));
        let end = read(&chunk);
        assert!(end.contains(expected), "{announced} {len}: {end}");
    }
    for chunk in [
        chunk_of(9, 0, "lz4", &[0; 9]),
        chunk_of(9, 7, "", &[0; 9]),
        chunk_of(10, 0, "", &[0; 9]),
        chunk_of(9, 0, "zstd", &[0; 9]),
        chunk(&[0; 10], Compression::Zstd),
    ] {
        let end = read(&chunk);
        assert!(end.starts_with("false Some"), "{end}");
    }
}

#[test]
fn texts_take_memory_in_proportion_to_the_limits() {
    let prefixed =
        |bytes: &[u8]| [&u32::try_from(bytes.len()).unwrap().to_le_bytes(), bytes].concat();
    // Keys of four characters, as few bytes of the file for each pair as possible.
    let key = |number: u32| [21, 14, 7, 0].map(|shift| (number >> shift) as u8 & 0x7f);
    let pairs = |count: u32| {
        let pairs = (0..count).flat_map(|number| [prefixed(&key(number)), prefixed(b"")].concat());
        prefixed(&pairs.collect::<Vec<_>>())
    };
    let channel = |id: u16, count: u32| {
        let id = id.to_le_bytes();
        let texts = [prefixed(b"topic"), prefixed(b"json")].concat();
        record(
            op::CHANNEL,
            &[&id[..], &[0, 0], &texts, &pairs(count)].concat(),
        )
    };
    let metadata = |count: u32| record(op::METADATA, &[prefixed(b"name"), pairs(count)].concat());
    let many = 1 << 20;
    let file = &file()[..8];
    for record in [metadata(many), channel(1, many)] {
        let end = read_within(
            PAIRS_MEMORY,
            &[file, &chunk(&record, Compression::Zstd)].concat(),
        );
        assert!(end.contains("false Some"), "{end}");
    }
    let channels: Vec<u8> = (0..400).flat_map(|id| channel(id, 4000)).collect();
    let end = read_within(
        PAIRS_MEMORY,
        &[file, &chunk(&channels, Compression::Zstd)].concat(),
    );
    assert!(end.contains("channels"), "{end}");
}
