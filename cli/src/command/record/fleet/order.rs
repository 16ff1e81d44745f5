//! The messages between `fipa record fleet` and the recorders of gateways: JSON in conversations of `fipa-request`.
//!
//! | order | answer |
//! |---|---|
//! | `start`, `stop` | a [`Recording`] |
//! | `list` | a [`Listing`] |
//! | `read` | the bytes of the file, without a frame |
//! | `digest` | a [`Digest`] |
//! | `clock` | a [`ClockAnswer`](super::clock::ClockAnswer) |
//!
//! A recorder refuses an order with the reason as text.

use std::fmt;

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use super::clock::Clock;

/// Ontology of orders and answers.
pub(super) const ONTOLOGY: &str = "fipa-recording";
/// Maximum length of an order, in bytes.
const MAX_ORDER: usize = 16 << 10;
/// Maximum length of an answer in JSON, in bytes.
const MAX_ANSWER: usize = 1 << 20;
/// Maximum number of bytes of a file in an answer.
pub(super) const MAX_PIECE: u32 = 256 << 10;
/// Maximum time of a recording, in seconds: a week.
pub(super) const MAX_SECONDS: u64 = 7 * 24 * 60 * 60;
/// Maximum number of patterns of each kind in an order.
const MAX_PATTERNS: usize = 16;
/// Maximum length of a pattern and of the name of a host, in bytes.
const MAX_TEXT: usize = 256;
/// Maximum number of recordings in a [`Listing`].
pub(super) const MAX_LISTED: usize = 1000;

/// The name of a recording, which is part of the names of files: 1 to 64 letters, digits, `-` and `_`.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub(in crate::command) struct RecordingName(String);

/// Error of a name that no recording has.
#[derive(Debug, thiserror::Error)]
#[error("the name of a recording has 1 to 64 letters, digits, - and _, and does not begin with -")]
pub(in crate::command) struct NameError;

impl TryFrom<String> for RecordingName {
    type Error = NameError;

    fn try_from(name: String) -> Result<Self, NameError> {
        let is_allowed = |byte: u8| byte.is_ascii_alphanumeric() || matches!(byte, b'-' | b'_');
        let fits = (1..=64).contains(&name.len()) && !name.starts_with('-');
        match fits && name.bytes().all(is_allowed) {
            true => Ok(Self(name)),
            false => Err(NameError),
        }
    }
}

impl std::str::FromStr for RecordingName {
    type Err = NameError;

    fn from_str(name: &str) -> Result<Self, NameError> {
        name.to_owned().try_into()
    }
}

impl From<RecordingName> for String {
    fn from(name: RecordingName) -> Self {
        name.0
    }
}

impl fmt::Display for RecordingName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// An order for a recorder.
#[derive(Debug, Serialize, Deserialize)]
#[serde(tag = "order", rename_all = "snake_case", deny_unknown_fields)]
pub(super) enum Order {
    /// Begin a recording.
    Start {
        name: RecordingName,
        options: Options,
        clock: Option<Clock>,
    },
    /// End a recording.
    Stop {
        name: RecordingName,
        clock: Option<Clock>,
    },
    /// List the recordings.
    List,
    /// Read a part of a finished recording.
    Read {
        name: RecordingName,
        offset: u64,
        length: u32,
    },
    /// Compute the SHA-256 of a finished recording.
    Digest { name: RecordingName },
    /// Read the clock.
    Clock,
}

/// The options of a recording.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Options {
    /// Time after which it ends.
    pub(super) seconds: u64,
    /// Maximum number of recorded bytes of each content; `None` for all, as `fipa record` limits them.
    pub(super) content: Option<u64>,
    /// Names or patterns of the agents whose letters are recorded; empty for all.
    pub(super) agents: Vec<String>,
    /// The protocols whose letters are recorded; empty for all.
    pub(super) protocols: Vec<String>,
}

/// Error of an order or an answer that cannot be read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub(super) enum ReadError {
    /// It is too long.
    #[error("the message has {0} bytes, which are too many")]
    Length(usize),
    /// It is not JSON of this form.
    #[error("the message is malformed: {0}")]
    Json(#[from] serde_json::Error),
    /// A value is out of its range.
    #[error("{0}")]
    Value(&'static str),
}

impl Order {
    /// Reads an order and checks its values.
    pub(super) fn read(json: &[u8]) -> Result<Self, ReadError> {
        let order = from_json(json, MAX_ORDER)?;
        let clock = match &order {
            Self::Start { options, clock, .. } => {
                options.check()?;
                clock
            }
            Self::Stop { clock, .. } => clock,
            Self::Read { length, .. } if !(1..=MAX_PIECE).contains(length) => {
                return Err(ReadError::Value("a piece has 1 byte to 256 KiB"));
            }
            _ => &None,
        };
        match clock {
            Some(clock) if clock.reference.len() > MAX_TEXT => {
                Err(ReadError::Value("the name of the host is too long"))
            }
            _ => Ok(order),
        }
    }
}

impl Options {
    fn check(&self) -> Result<(), ReadError> {
        if !(1..=MAX_SECONDS).contains(&self.seconds) {
            return Err(ReadError::Value("a recording takes 1 second to 7 days"));
        }
        let fits = |all: &[String]| {
            all.len() <= MAX_PATTERNS && all.iter().all(|it| (1..=MAX_TEXT).contains(&it.len()))
        };
        match fits(&self.agents) && fits(&self.protocols) {
            true => Ok(()),
            false => Err(ReadError::Value(
                "an order has at most 16 agents and 16 protocols of 1 to 256 bytes",
            )),
        }
    }
}

/// Reads an answer in JSON.
pub(super) fn read_answer<T: DeserializeOwned>(json: &[u8]) -> Result<T, ReadError> {
    from_json(json, MAX_ANSWER)
}

fn from_json<T: DeserializeOwned>(json: &[u8], max: usize) -> Result<T, ReadError> {
    match json.len() > max {
        true => Err(ReadError::Length(json.len())),
        false => Ok(serde_json::from_slice(json)?),
    }
}

/// A recording of a host.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Recording {
    pub(super) name: RecordingName,
    pub(super) state: State,
    pub(super) bytes: u64,
}

/// The state of a recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum State {
    Recording,
    Finished,
}

impl State {
    pub(super) fn as_str(self) -> &'static str {
        match self {
            Self::Recording => "recording",
            Self::Finished => "finished",
        }
    }
}

/// The recordings of a host.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Listing {
    pub(super) recordings: Vec<Recording>,
}

/// The SHA-256 of a recording, in hexadecimal digits.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Digest {
    pub(super) sha256: String,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_is_no_path() {
        for name in ["run1", "a-b_C", "_", &"x".repeat(64)] {
            assert!(name.parse::<RecordingName>().is_ok(), "{name}");
        }
        for name in [
            "",
            "../x",
            "a/b",
            ".",
            "a.b",
            "-x",
            "a b",
            "ä",
            "a\0",
            &"x".repeat(65),
        ] {
            assert!(name.parse::<RecordingName>().is_err(), "{name:?}");
        }
    }

    #[test]
    fn an_order_has_known_keys_and_values_in_their_ranges() {
        let options = r#""options":{"seconds":5,"content":null,"agents":[],"protocols":[]}"#;
        let start = format!(r#"{{"order":"start","name":"run",{options},"clock":null}}"#);
        let Order::Start { name, .. } = Order::read(start.as_bytes()).unwrap() else {
            panic!("another order");
        };
        assert_eq!(name.to_string(), "run");
        for wrong in [
            start.replace("run", "../run"),
            start.replace(":5", ":0"),
            start.replace(":5", ":604801"),
            start.replace("\"agents\":[]", "\"agents\":[\"\"]"),
            start.replace("\"agents\":[]", "\"arguments\":[\"--keep\"]"),
            start.replace("\"name\"", "\"output\":\"/etc/x\",\"name\""),
            r#"{"order":"read","name":"run","offset":0,"length":300000}"#.to_owned(),
            r#"{"order":"read","name":"run","offset":-1,"length":3}"#.to_owned(),
            format!("{start}{}", " ".repeat(MAX_ORDER)),
            "[".repeat(1000),
        ] {
            assert!(Order::read(wrong.as_bytes()).is_err(), "{wrong}");
        }
    }
}
