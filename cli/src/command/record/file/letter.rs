//! The JSON object of a recorded letter: that of `fipa watch --json`, and `check` with
//!
//! * `answer_within_ms`: time from the sending by which the sender expects an answer, if the letter has it,
//! * `undelivered`: the letter was not delivered,
//! * `from_service`: a message transport service wrote it,
//! * `may_continue`: its conversation may have begun before the recording,
//! * `after_loss`: letters before this one are missing.
//!
//! An absent key of `check` is false. `letter_id` is the same in the recordings of all hosts on the way of the letter.

use std::time::{Duration, SystemTime, UNIX_EPOCH};

use bytes::{BufMut as _, BytesMut};
use fipa::admin::watch::Passage;
use fipa::{Message, Payload};
use fipa_acl::json::message_from_json;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::command::watch::checker::{CheckResult, Letter};
use crate::command::watch::filter::Traits;
use crate::command::watch::json;

/// Maximum length of the JSON object of a letter that is read, in bytes.
const MAX_LETTER: usize = 1 << 20;

#[derive(Debug, Clone, Copy, Default, Serialize, Deserialize)]
#[serde(default)]
struct Check {
    #[serde(skip_serializing_if = "Option::is_none")]
    answer_within_ms: Option<u64>,
    #[serde(skip_serializing_if = "is_false")]
    undelivered: bool,
    #[serde(skip_serializing_if = "is_false")]
    from_service: bool,
    #[serde(skip_serializing_if = "is_false")]
    may_continue: bool,
    #[serde(skip_serializing_if = "is_false")]
    after_loss: bool,
}

#[expect(
    clippy::trivially_copy_pass_by_ref,
    reason = "serde calls it with a reference"
)]
fn is_false(value: &bool) -> bool {
    !value
}

/// Returns the JSON object of an observed letter.
pub(in crate::command) fn to_json(
    passage: &Passage,
    checked: &CheckResult,
    letter: &Letter<'_>,
    after_loss: bool,
) -> serde_json::Result<Vec<u8>> {
    let within = letter.answer_within;
    let check = Check {
        answer_within_ms: within.map(|it| u64::try_from(it.as_millis()).unwrap_or(u64::MAX)),
        undelivered: letter.undelivered,
        from_service: letter.from_service,
        may_continue: letter.may_continue,
        after_loss,
    };
    let mut object = json::letter_object(passage, checked);
    object.insert("check".to_owned(), serde_json::to_value(check)?);
    if passage.stream.sender.is_known() {
        let id = format!("{}/{}", passage.stream.sender, passage.sequence);
        object.insert("letter_id".to_owned(), id.into());
    }
    serde_json::to_vec(&object)
}

/// Returns the bytes of an observed letter, envelope and message, if all of them were observed.
pub(in crate::command) fn to_bytes(passage: &Passage) -> Option<BytesMut> {
    let is_whole = passage.content_len.unwrap_or(0) == passage.content.len() as u64;
    let envelope = passage.envelope.get().filter(|_| is_whole)?;
    let payload = json::message(passage)?.to_payload();
    let envelope = envelope.encode_standard().ok()?;
    let mut bytes = BytesMut::with_capacity(envelope.len() + payload.len());
    bytes.put(&*envelope);
    for part in parts(&payload) {
        bytes.put(part);
    }
    // The encodings have other lengths if the letter is of another implementation.
    (bytes.len() as u64 == passage.size).then_some(bytes)
}

fn parts(payload: &Payload) -> [&[u8]; 3] {
    [&payload.head, &payload.content, &payload.tail]
}

/// Reads the identifier that a letter has in the recordings of all hosts.
pub(in crate::command) fn read_id(json: &[u8]) -> Option<String> {
    #[derive(Deserialize)]
    struct IdJson {
        letter_id: Option<String>,
    }
    let read: IdJson = serde_json::from_slice(json.get(..MAX_LETTER.min(json.len()))?).ok()?;
    read.letter_id
}

/// A letter of a recording.
#[derive(Debug)]
pub(in crate::command) struct RecordedLetter {
    pub(in crate::command) at: SystemTime,
    pub(in crate::command) sender: Option<String>,
    pub(in crate::command) receiver: String,
    pub(in crate::command) message: Option<Message>,
    /// The message as JSON.
    pub(in crate::command) message_json: Value,
    /// Whether content of the message is missing.
    pub(in crate::command) is_cut: bool,
    pub(in crate::command) after_loss: bool,
    is_violation: bool,
    checked_protocol: Option<String>,
    check: Check,
}

/// The keys that are read.
#[derive(Deserialize)]
struct LetterJson {
    sender: Option<String>,
    receiver: String,
    content_length: Option<u64>,
    #[serde(default)]
    content_cut: bool,
    #[serde(default)]
    verdict: Option<VerdictJson>,
    #[serde(default)]
    letter: PartsJson,
    #[serde(default)]
    check: Check,
}

#[derive(Deserialize)]
struct VerdictJson {
    verdict: String,
    protocol: Option<String>,
}

#[derive(Default, Deserialize)]
struct PartsJson {
    #[serde(default)]
    message: Value,
}

/// Error of [`RecordedLetter::read`].
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub(in crate::command) enum LetterError {
    /// The object is too long.
    #[error("the letter has {0} bytes (maximum {MAX_LETTER})")]
    Length(usize),
    /// The bytes are not the JSON object of a letter.
    #[error("the letter is malformed: {0}")]
    Json(#[from] serde_json::Error),
}

impl RecordedLetter {
    /// Reads the JSON object of a letter that was sent at this time.
    ///
    /// A message that is no valid one counts as unknown, as one that was not decoded while it was recorded.
    pub(in crate::command) fn read(json: &[u8], nanos: u64) -> Result<Self, LetterError> {
        if json.len() > MAX_LETTER {
            return Err(LetterError::Length(json.len()));
        }
        let read: LetterJson = serde_json::from_slice(json)?;
        let message_json = read.letter.message;
        let message = message_from_json(&message_json).ok();
        let has_content = message.as_ref().is_some_and(|it| it.content().is_some());
        let verdict = read.verdict;
        Ok(Self {
            at: UNIX_EPOCH + Duration::from_nanos(nanos),
            sender: read.sender,
            receiver: read.receiver,
            is_cut: read.content_cut
                || read.content_length.is_some_and(|it| it > 0) && !has_content,
            message,
            message_json,
            after_loss: read.check.after_loss,
            is_violation: verdict.as_ref().is_some_and(|it| it.verdict == "violation"),
            checked_protocol: verdict.and_then(|it| it.protocol),
            check: read.check,
        })
    }

    /// Whether a message transport service wrote it.
    pub(in crate::command) fn is_from_service(&self) -> bool {
        self.check.from_service
    }

    /// The data that its check needs.
    pub(in crate::command) fn letter(&self) -> Letter<'_> {
        Letter {
            message: self.message.as_ref(),
            receiver: &self.receiver,
            at: self.at,
            answer_within: self.check.answer_within_ms.map(Duration::from_millis),
            from_service: self.check.from_service,
            undelivered: self.check.undelivered,
            may_continue: self.check.may_continue,
        }
    }

    /// The data that a filter compares.
    pub(in crate::command) fn traits(&self) -> Traits<'_> {
        Traits {
            sender: self.sender.as_deref(),
            receiver: &self.receiver,
            message: self.message.as_ref(),
            checked_protocol: self.checked_protocol.as_deref(),
            is_violation: self.is_violation,
        }
    }
}
