//! Recordings: letters with their times, in a file.
//!
//! ```text
//! recording := "fipa-rec" version(u32) entry*
//! entry     := length(u32) time(u64) answer-within(u64) flags(u8) receiver-length(u16) receiver message
//! ```
//!
//! All integers are little-endian. `version` is 1. `length` counts the bytes of the entry after itself,
//! at most [`MAX_ENTRY`]. `time` is in nanoseconds since 1970-01-01T00:00:00Z.
//! `answer-within` is the time from then, in milliseconds, by which the sender expects an answer, or 2^64 - 1 if only the
//! `reply-by` of the message has it, by another clock. `flags` is the sum of 1
//! for a letter that was not delivered, 2 for a letter of a message transport service, 4 for a letter
//! whose conversation may have begun before the recording, and 8 if letters before this one are missing.
//! A reader ignores other flags. `receiver` is the name of the agent that got, or was to get, the letter, in UTF-8. `message` is the message without
//! its content in bit-efficient encoding (FIPA00069), or empty if it is unknown. The entries are in the
//! order in which the letters were sent.
//!
//! A reader must skip the rest of an entry with a message that it cannot decode. A file that ends within
//! an entry was not closed: the entries before it are valid.

use std::time::{Duration, SystemTime, UNIX_EPOCH};

use fipa_acl::Message;

/// The first bytes of a recording.
pub const MAGIC: [u8; 8] = *b"fipa-rec";

/// The version of the format.
pub const VERSION: u32 = 1;

/// Maximum length of an entry, in bytes, without its length.
pub const MAX_ENTRY: usize = 128 * 1024;

/// Bytes of an entry before the name of the receiver.
const FIXED: usize = 8 + 8 + 1 + 2;

/// The value of `answer-within` for a letter without it.
const UNKNOWN: u64 = u64::MAX;

const UNDELIVERED: u8 = 1;
const FROM_SERVICE: u8 = 2;
const MAY_CONTINUE: u8 = 4;
const AFTER_LOSS: u8 = 8;

/// A recorded letter to one receiver.
#[derive(Debug, Clone, PartialEq)]
pub struct Recorded {
    /// The time of sending, with a resolution of 1 ns. Times before 1970 or after 2554 are not
    /// represented.
    pub at: SystemTime,
    /// The time from `at` by which the sender expects an answer, with a resolution of 1 ms.
    pub answer_within: Option<Duration>,
    /// The name of the receiver.
    pub receiver: String,
    /// Whether the letter was not delivered.
    pub undelivered: bool,
    /// Whether a message transport service wrote the letter.
    pub from_service: bool,
    /// Whether the conversation of the letter may have begun before the recording.
    pub may_continue: bool,
    /// Whether letters before this one are missing, so that the conversations so far are unknown.
    pub after_loss: bool,
    /// The message; its content is not recorded.
    pub message: Option<Message>,
}

/// Error of reading a recording.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum RecordingError {
    /// The file does not begin with [`MAGIC`].
    #[error("the file is no recording of letters; `fipa watch --record FILE` writes one")]
    NotARecording,
    /// The recording has another version.
    #[error("the recording has version {0}, and this program reads version {VERSION}")]
    Version(u32),
    /// The length of an entry is out of range.
    #[error("entry {number} has a length of {length} bytes (maximum {MAX_ENTRY})")]
    Length {
        /// Number of the entry, from 1.
        number: u64,
        /// Its length.
        length: u32,
    },
    /// An entry is malformed.
    #[error("entry {number} is malformed: {what}")]
    Malformed {
        /// Number of the entry, from 1.
        number: u64,
        /// The malformed part.
        what: &'static str,
    },
}

/// Error of writing an entry: the letter exceeds [`MAX_ENTRY`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the receiver and the message without its content have more than {MAX_ENTRY} bytes")]
pub struct TooLong;

/// Appends the beginning of a recording.
pub fn begin(out: &mut Vec<u8>) {
    out.extend_from_slice(&MAGIC);
    out.extend_from_slice(&VERSION.to_le_bytes());
}

/// Appends an entry. The message must have no content.
///
/// # Errors
/// The entry is too long. Nothing is appended.
pub fn append(recorded: &Recorded, out: &mut Vec<u8>) -> Result<(), TooLong> {
    let message = match &recorded.message {
        Some(message) => message.to_payload().to_bytes(),
        None => bytes::Bytes::new(),
    };
    let receiver = recorded.receiver.as_bytes();
    let receiver_len = u16::try_from(receiver.len()).map_err(|_| TooLong)?;
    let length = FIXED + receiver.len() + message.len();
    let length = u32::try_from(length).ok().filter(|_| length <= MAX_ENTRY);
    let length = length.ok_or(TooLong)?;
    let since = recorded.at.duration_since(UNIX_EPOCH).unwrap_or_default();
    let nanos = u64::try_from(since.as_nanos()).unwrap_or(u64::MAX);
    let flag = |set: bool, flag: u8| if set { flag } else { 0 };
    let flags = flag(recorded.undelivered, UNDELIVERED)
        | flag(recorded.from_service, FROM_SERVICE)
        | flag(recorded.may_continue, MAY_CONTINUE)
        | flag(recorded.after_loss, AFTER_LOSS);
    out.extend_from_slice(&length.to_le_bytes());
    out.extend_from_slice(&nanos.to_le_bytes());
    let within = recorded
        .answer_within
        .map(|it| u64::try_from(it.as_millis()));
    let within = within.and_then(Result::ok).unwrap_or(UNKNOWN);
    out.extend_from_slice(&within.to_le_bytes());
    out.push(flags);
    out.extend_from_slice(&receiver_len.to_le_bytes());
    out.extend_from_slice(receiver);
    out.extend_from_slice(&message);
    Ok(())
}

/// Reads a recording from pieces of its file. It keeps at most one entry and the last piece.
#[derive(Debug, Default)]
pub struct Reader {
    buffer: Vec<u8>,
    /// Number of the bytes of the buffer that were read.
    read: usize,
    has_begun: bool,
    /// Number of entries that were read.
    entries: u64,
}

impl Reader {
    /// Creates a reader of a file from its beginning.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds the next piece of the file. Call [`next_entry`](Self::next_entry) until it returns `None`
    /// before the next piece.
    pub fn push(&mut self, piece: &[u8]) {
        self.buffer.drain(..self.read);
        self.read = 0;
        self.buffer.extend_from_slice(piece);
    }

    /// Returns the next entry, or `None` if it is not complete yet.
    ///
    /// # Errors
    /// The file is no recording, or is malformed. The reader cannot go on.
    pub fn next_entry(&mut self) -> Result<Option<Recorded>, RecordingError> {
        if !self.has_begun {
            let Some((magic, rest)) = self.rest().split_first_chunk::<8>() else {
                let begins = MAGIC.starts_with(self.rest());
                return match begins {
                    true => Ok(None),
                    false => Err(RecordingError::NotARecording),
                };
            };
            if *magic != MAGIC {
                return Err(RecordingError::NotARecording);
            }
            let Some((version, _)) = rest.split_first_chunk::<4>() else {
                return Ok(None);
            };
            let version = u32::from_le_bytes(*version);
            if version != VERSION {
                return Err(RecordingError::Version(version));
            }
            self.has_begun = true;
            self.read += MAGIC.len() + size_of::<u32>();
        }
        let Some((length, rest)) = self.rest().split_first_chunk::<4>() else {
            return Ok(None);
        };
        let length = u32::from_le_bytes(*length);
        let number = self.entries + 1;
        let len = usize::try_from(length).unwrap_or(usize::MAX);
        if !(FIXED..=MAX_ENTRY).contains(&len) {
            return Err(RecordingError::Length { number, length });
        }
        let Some(entry) = rest.get(..len) else {
            return Ok(None);
        };
        let recorded =
            entry_of(entry).map_err(|what| RecordingError::Malformed { number, what })?;
        self.read += size_of::<u32>() + len;
        self.entries = number;
        Ok(Some(recorded))
    }

    /// Whether all pieces so far form whole entries: a file that ends here was closed.
    #[must_use]
    pub fn is_complete(&self) -> bool {
        self.has_begun && self.rest().is_empty()
    }

    fn rest(&self) -> &[u8] {
        self.buffer.get(self.read..).unwrap_or_default()
    }
}

fn entry_of(entry: &[u8]) -> Result<Recorded, &'static str> {
    let (time, rest) = entry.split_first_chunk::<8>().ok_or("it has no time")?;
    let (within, rest) = rest
        .split_first_chunk::<8>()
        .ok_or("it has no answer-within")?;
    let within = Some(u64::from_le_bytes(*within)).filter(|within| *within != UNKNOWN);
    let ([flags], rest) = rest.split_first_chunk::<1>().ok_or("it has no flags")?;
    let (len, rest) = rest.split_first_chunk::<2>().ok_or("it has no receiver")?;
    let len = usize::from(u16::from_le_bytes(*len));
    let receiver = rest.get(..len).ok_or("the receiver is longer than it")?;
    let message = rest.get(len..).unwrap_or_default();
    let receiver = std::str::from_utf8(receiver).map_err(|_| "the receiver is not UTF-8")?;
    let at = UNIX_EPOCH.checked_add(Duration::from_nanos(u64::from_le_bytes(*time)));
    Ok(Recorded {
        at: at.ok_or("the time is out of range")?,
        answer_within: within.map(Duration::from_millis),
        receiver: receiver.to_owned(),
        undelivered: flags & UNDELIVERED != 0,
        from_service: flags & FROM_SERVICE != 0,
        may_continue: flags & MAY_CONTINUE != 0,
        after_loss: flags & AFTER_LOSS != 0,
        message: Message::decode(&bytes::Bytes::copy_from_slice(message).into()).ok(),
    })
}

#[cfg(test)]
mod tests {
    use fipa_acl::{AgentId, Performative};

    use super::*;

    fn recorded(number: u64) -> Recorded {
        let id = |name| AgentId::new(name).unwrap();
        let message = Message::builder(Performative::Request)
            .sender(id("ann"))
            .receiver(id("ben"))
            .protocol("fipa-request")
            .conversation_id(number.to_string())
            .build();
        Recorded {
            at: UNIX_EPOCH + Duration::from_nanos(1_700_000_000_000_000_001 + number),
            answer_within: (number != 3).then(|| Duration::from_millis(number)),
            receiver: "ben".to_owned(),
            undelivered: number % 2 == 1,
            from_service: number % 3 == 1,
            may_continue: number % 4 == 3,
            after_loss: number == 4,
            message: message.ok().filter(|_| number != 2),
        }
    }

    fn file() -> (Vec<Recorded>, Vec<u8>) {
        let all: Vec<Recorded> = (0..5).map(recorded).collect();
        let mut file = Vec::new();
        begin(&mut file);
        for one in &all {
            append(one, &mut file).unwrap();
        }
        (all, file)
    }

    /// Reads a file in pieces of this length.
    fn read(file: &[u8], piece: usize) -> Result<(Vec<Recorded>, bool), RecordingError> {
        let mut reader = Reader::new();
        let mut all = Vec::new();
        for piece in file.chunks(piece) {
            reader.push(piece);
            while let Some(one) = reader.next_entry()? {
                all.push(one);
            }
        }
        Ok((all, reader.is_complete()))
    }

    #[test]
    fn a_recording_is_read_in_pieces_of_any_length() {
        let (all, file) = file();
        for piece in [1, 2, 7, 64, 10_000] {
            assert_eq!(read(&file, piece), Ok((all.clone(), true)), "{piece}");
        }
    }

    #[test]
    fn a_recording_that_ends_within_an_entry_has_the_entries_before() {
        let (all, file) = file();
        for end in 0..file.len() {
            let (found, complete) = read(&file[..end], 64).unwrap();
            assert_eq!(found, all[..found.len()]);
            assert_eq!(found.len() == all.len(), end == file.len());
            if complete {
                let mut closed = Vec::new();
                begin(&mut closed);
                for one in &found {
                    append(one, &mut closed).unwrap();
                }
                assert_eq!(closed, file[..end]);
            }
        }
    }

    #[test]
    fn files_that_are_no_recordings_are_refused() {
        let (_, good) = file();
        let changed = |at: usize, to: u8| {
            let mut file = good.clone();
            file[at] = to;
            read(&file, 64)
        };
        assert_eq!(changed(0, b'F'), Err(RecordingError::NotARecording));
        assert_eq!(read(b"<scxml/>", 3), Err(RecordingError::NotARecording));
        assert_eq!(changed(8, 2), Err(RecordingError::Version(2)));
        let huge = changed(15, 1);
        assert!(
            matches!(huge, Err(RecordingError::Length { number: 1, .. })),
            "{huge:?}"
        );
        let receiver = changed(12 + 4 + 17 + 1, 200);
        assert!(
            matches!(receiver, Err(RecordingError::Malformed { number: 1, .. })),
            "{receiver:?}"
        );
    }

    #[test]
    fn an_entry_that_is_too_long_is_not_appended() {
        let mut out = Vec::new();
        let mut long = recorded(0);
        long.receiver = "x".repeat(70_000);
        assert_eq!(append(&long, &mut out), Err(TooLong));
        assert!(out.is_empty());
    }
}
