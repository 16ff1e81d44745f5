//! The newest letters.

use std::collections::VecDeque;

use fipa::Outcome;
use fipa::admin::watch::{Fate, Passage};
use serde_json::{Value, json};

use super::{clipped, moment};
use crate::command::watch::checker::CheckResult;

/// Maximum number of letters.
const MAX_LETTERS: usize = 5000;

/// An observed letter.
#[derive(Debug, Clone)]
pub(super) struct Letter {
    pub(super) number: u64,
    at: String,
    pub(super) from: String,
    pub(super) to: String,
    performative: String,
    protocol: Option<String>,
    conversation: Option<String>,
    size: u64,
    via: Option<&'static str>,
    gateway: Option<String>,
    fate: Value,
    violation: Option<String>,
    pub(super) has_failed: bool,
}

impl Letter {
    pub(super) fn of(passage: &Passage, checked: &CheckResult) -> Self {
        let message = passage.message.as_ref();
        let mut letter = Self {
            number: passage.number,
            at: moment(passage.at),
            from: clipped(passage.sender().unwrap_or("?")),
            to: clipped(&passage.receiver),
            performative: clipped(message.map_or("?", |it| it.performative().as_str())),
            protocol: message.and_then(|it| it.protocol()).map(clipped),
            conversation: message.and_then(|it| it.conversation_id()).map(clipped),
            size: passage.size,
            via: None,
            gateway: None,
            fate: Value::Null,
            violation: match checked {
                CheckResult::Violation(violation) => Some(clipped(&violation.to_string())),
                _ => None,
            },
            has_failed: false,
        };
        letter.news(passage);
        letter
    }

    /// Takes later news of it.
    pub(super) fn news(&mut self, passage: &Passage) {
        self.via = passage.via.map(fipa::Kind::name);
        self.gateway = passage.gateway.as_deref().map(clipped);
        self.has_failed = matches!(&passage.fate, Fate::Settled(Outcome::Failed { .. }));
        self.fate = fate(&passage.fate);
    }

    /// The row of the letter.
    pub(super) fn row(&self) -> Value {
        json!({
            "number": self.number, "time": self.at, "from": self.from, "to": self.to,
            "performative": self.performative, "protocol": self.protocol, "conversation": self.conversation,
            "size": self.size, "via": self.via, "gateway": self.gateway, "fate": self.fate,
            "violation": self.violation,
        })
    }
}

/// State of the delivery: outcome, reason of a failure, and each attempt.
fn fate(fate: &Fate) -> Value {
    let outcome = match fate {
        Fate::UnderWay => return json!({ "outcome": "under way" }),
        Fate::Taken => return json!({ "outcome": "received" }),
        Fate::Passed(outcome) | Fate::Settled(outcome) => outcome,
    };
    let (word, reason) = match outcome {
        Outcome::Delivered { .. } => ("delivered", None),
        Outcome::Sent { .. } => ("sent", None),
        Outcome::Failed { reason, .. } => ("failed", Some(reason.to_string())),
        _ => ("unknown", None),
    };
    let attempts = outcome.attempts().iter().map(|attempt| {
        json!({
            "via": attempt.via.name(), "location": clipped(&attempt.location.to_string()),
            "error": clipped(&attempt.error.to_string()),
        })
    });
    json!({ "outcome": word, "reason": reason.map(|it| clipped(&it)), "attempts": attempts.collect::<Vec<_>>() })
}

/// The newest letters in the order of their numbers.
#[derive(Debug, Default)]
pub(super) struct Letters {
    newest: VecDeque<Letter>,
}

impl Letters {
    pub(super) fn add(&mut self, letter: Letter) {
        if self.newest.len() >= MAX_LETTERS {
            self.newest.pop_front();
        }
        self.newest.push_back(letter);
    }

    /// Takes later news of a letter.
    pub(super) fn news(&mut self, passage: &Passage) {
        let found = self
            .newest
            .binary_search_by_key(&passage.number, |letter| letter.number);
        if let Ok(index) = found
            && let Some(letter) = self.newest.get_mut(index)
        {
            letter.news(passage);
        }
    }

    /// The letters, the newest first.
    pub(super) fn newest(&self) -> impl Iterator<Item = &Letter> {
        self.newest.iter().rev()
    }
}
