//! Recordings: files in the format MCAP (<https://mcap.dev>).
//!
//! | channel | message |
//! |---|---|
//! | `/letters/<receiver>` | a letter: the JSON object of `fipa watch --json`, and `check` |
//! | `/letters/<receiver>/raw` | the bytes of the letter, if all of them were observed |
//! | `/letters`, `/letters/raw` | the letters of further receivers, after [`MAX_RECEIVERS`] |
//! | `/events` | agents, gone hosts, later outcomes, violations, overdue messages, locks and lost records as JSON |
//! | `/log` | violations, lost records, gone hosts, lost, refused and abandoned locks as `foxglove.Log` |
//! | `/topics/<agent>/<topic>` | the values of a topic with the media type of the topic |
//!
//! The times of a letter are its time of sending. A letter and its bytes have the same sequence number.
//!
//! `check` has the data of a letter that its check needs beside the message: see [`letter`]. The metadata record
//! [`ABOUT`] is at the beginning of a file, [`TOTALS`] at its end.

mod fields;
pub(in crate::command) mod letter;
pub(in crate::command) mod reader;
pub(in crate::command) mod writer;

use std::io;

/// Name of the metadata record at the beginning of a file.
pub(in crate::command) const ABOUT: &str = "fipa.recording";
/// Name of the metadata record at the end of a file.
pub(in crate::command) const TOTALS: &str = "fipa.totals";
/// Name of the metadata record of a file in which letters are left out.
pub(in crate::command) const FILTERED: &str = "fipa.filtered";

/// Channel of events.
pub(in crate::command) const EVENTS: &str = "/events";
/// Channel of the log.
pub(in crate::command) const LOG: &str = "/log";
/// First part of the channels of letters.
pub(in crate::command) const LETTERS: &str = "/letters";
/// Last part of the channels with the bytes of letters.
pub(in crate::command) const RAW: &str = "/raw";
/// Maximum number of receivers with channels of their own.
pub(in crate::command) const MAX_RECEIVERS: usize = 256;

/// Encoding of the messages that are JSON.
pub(in crate::command) const JSON: &str = "json";
/// Encoding of the bytes of a letter: an envelope and a message, as `fipa decode` reads them.
pub(in crate::command) const LETTER: &str = "fipa-letter";

/// A schema of JSON messages.
#[derive(Debug, Clone, Copy)]
pub(in crate::command) struct Schema {
    pub(in crate::command) name: &'static str,
    pub(in crate::command) text: &'static str,
}

/// Schema of a letter.
pub(in crate::command) const LETTER_SCHEMA: Schema = Schema {
    name: "fipa.Letter",
    text: include_str!("letter.schema.json"),
};

/// Schema of an event.
pub(in crate::command) const EVENT_SCHEMA: Schema = Schema {
    name: "fipa.Event",
    text: include_str!("event.schema.json"),
};

/// Schema of a line of the log.
pub(in crate::command) const LOG_SCHEMA: Schema = Schema {
    name: "foxglove.Log",
    text: include_str!("log.schema.json"),
};

/// Error of reading or writing a recording.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub(in crate::command) enum RecordingError {
    /// The file cannot be read or written.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// The file is empty.
    #[error("the recording is empty")]
    Empty,
    /// The file does not begin as a recording does.
    #[error("this is no recording in the format MCAP")]
    NotARecording,
    /// A record is malformed.
    #[error(transparent)]
    Mcap(#[from] mcap::McapError),
    /// A record is malformed.
    #[error("a record with the opcode {0} is malformed")]
    Malformed(u8),
    /// The schemas and channels exceed a limit.
    #[error("the channels and schemas have more than {0} bytes")]
    TooManyChannels(usize),
    /// A message of a channel that was not announced.
    #[error("a message belongs to channel {0}, which the file does not announce")]
    UnknownChannel(u16),
}
