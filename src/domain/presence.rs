//! The letters about registrations on other hosts: a process asks the gateway of its host whether a
//! registration still exists, and that gateway asks the gateway of the registration's host.
//!
//! A question is a `query-ref` with the [`ONTOLOGY`], an answer an `inform` in the same conversation.
//! The content is JSON:
//!
//! ```json
//! { "version": 1, "ask": [ { "id": registration, "mts": service } ] }
//! { "version": 1, "here": [registration], "gone": [registration], "unsupported": [registration] }
//! ```
//!
//! A process asks only while a call waits for an agent of another host. Unknown keys are ignored, so
//! that a later version may add some.

use fipa_transport::Incarnation;
use serde::{Deserialize, Serialize};

/// The ontology of the letters.
pub(crate) const ONTOLOGY: &str = "fipa-mts-presence";

/// The beginning of the conversation ids of questions.
#[cfg(feature = "protocols")]
pub(crate) const CONVERSATION: &str = "fipa-presence-";

/// Maximum number of registrations in one letter.
pub(crate) const MAX_ASKED: usize = 256;

/// Maximum length of the content of one letter, in bytes.
const MAX_CONTENT: usize = 64 << 10;

const VERSION: u32 = 1;

/// A registration, and the service that delivers to it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Asked {
    pub(crate) id: Incarnation,
    pub(crate) mts: Incarnation,
}

#[derive(Debug, Serialize, Deserialize)]
struct Question {
    version: u32,
    ask: Vec<Asked>,
}

/// The registrations of a question, by their state.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Answer {
    #[serde(default)]
    pub(crate) version: u32,
    /// Registered on their host.
    #[serde(default)]
    pub(crate) here: Vec<Incarnation>,
    /// Not registered any more.
    #[serde(default)]
    pub(crate) gone: Vec<Incarnation>,
    /// At a gateway that does not answer such questions.
    #[serde(default)]
    pub(crate) unsupported: Vec<Incarnation>,
}

impl Answer {
    /// Returns the number of registrations.
    fn len(&self) -> usize {
        self.here.len() + self.gone.len() + self.unsupported.len()
    }
}

/// The error of a letter about registrations.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub(crate) enum PresenceError {
    #[error("the content has {0} bytes; at most {MAX_CONTENT} are allowed")]
    TooLong(usize),
    #[error("the content is not valid: {0}")]
    Json(#[from] serde_json::Error),
    #[error("version {0} is not supported")]
    Version(u32),
    #[error("it has {0} registrations; at most {MAX_ASKED} are allowed")]
    TooMany(usize),
}

/// Encodes a question. Only the first [`MAX_ASKED`] registrations are asked for.
pub(crate) fn question(ask: &[Asked]) -> Vec<u8> {
    let ask = ask.iter().take(MAX_ASKED).copied().collect();
    let version = VERSION;
    // Serialization of numbers and lists cannot fail.
    serde_json::to_vec(&Question { version, ask }).unwrap_or_default()
}

/// Decodes a question.
#[cfg(any(feature = "net", test))]
pub(crate) fn read_question(content: &[u8]) -> Result<Vec<Asked>, PresenceError> {
    let question: Question = serde_json::from_slice(bounded(content)?)?;
    match question.ask.len() {
        _ if question.version != VERSION => Err(PresenceError::Version(question.version)),
        many if many > MAX_ASKED => Err(PresenceError::TooMany(many)),
        _ => Ok(question.ask),
    }
}

/// Encodes an answer.
#[cfg(any(feature = "net", test))]
pub(crate) fn answer(mut answer: Answer) -> Vec<u8> {
    answer.version = VERSION;
    // Serialization of numbers and lists cannot fail.
    serde_json::to_vec(&answer).unwrap_or_default()
}

/// Decodes an answer.
pub(crate) fn read_answer(content: &[u8]) -> Result<Answer, PresenceError> {
    let answer: Answer = serde_json::from_slice(bounded(content)?)?;
    match answer.len() {
        _ if answer.version != VERSION => Err(PresenceError::Version(answer.version)),
        many if many > MAX_ASKED => Err(PresenceError::TooMany(many)),
        _ => Ok(answer),
    }
}

fn bounded(content: &[u8]) -> Result<&[u8], PresenceError> {
    match content.len() {
        0..=MAX_CONTENT => Ok(content),
        len => Err(PresenceError::TooLong(len)),
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn any_content_is_read_or_refused(
            content in "[\\[\\]{}:,\"0-9a-f]{0,40}|\\{\"version\":1,\"(ask|here|gone)\":\\[.{0,30}\\]\\}",
        ) {
            if let Ok(asked) = read_question(content.as_bytes()) {
                prop_assert!(read_question(&question(&asked)).is_ok_and(|again| again == asked));
            }
            if let Ok(answered) = read_answer(content.as_bytes()) {
                prop_assert!(read_answer(&answer(answered.clone())).is_ok_and(|again| again == answered));
            }
        }
    }

    #[test]
    fn letters_are_read_as_they_were_written() {
        let [a, b, c] = [1, 2, 3].map(Incarnation::from_u64);
        let asked = [Asked { id: a, mts: b }, Asked { id: b, mts: c }];
        assert_eq!(read_question(&question(&asked)).unwrap(), asked);
        let answered = Answer {
            here: vec![a],
            gone: vec![b],
            unsupported: vec![c],
            version: VERSION,
        };
        assert_eq!(read_answer(&answer(answered.clone())).unwrap(), answered);
    }

    #[test]
    fn other_content_is_refused() {
        let many = vec![
            Asked {
                id: Incarnation::from_u64(1),
                mts: Incarnation::from_u64(2)
            };
            MAX_ASKED + 1
        ];
        assert_eq!(read_question(&question(&many)).unwrap().len(), MAX_ASKED);
        let letter = |ask: &[Asked], version| {
            let ask = ask.to_vec();
            serde_json::to_vec(&Question { version, ask }).unwrap()
        };
        let refused = read_question(&letter(&many, VERSION));
        assert!(matches!(refused, Err(PresenceError::TooMany(257))));
        let refused = read_question(&letter(&[], 2));
        assert!(matches!(refused, Err(PresenceError::Version(2))));
        assert!(matches!(read_answer(b"{}"), Err(PresenceError::Version(0))));
        assert!(matches!(read_answer(b"["), Err(PresenceError::Json(_))));
        let gone = vec![Incarnation::from_u64(1); MAX_ASKED + 1];
        let too_many = Answer {
            gone,
            ..Answer::default()
        };
        let long = vec![b' '; MAX_CONTENT + 1];
        assert!(matches!(
            read_question(&long),
            Err(PresenceError::TooLong(_))
        ));
        let refused = read_answer(&answer(too_many));
        assert!(matches!(refused, Err(PresenceError::TooMany(257))));
    }
}
