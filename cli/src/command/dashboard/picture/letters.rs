//! The newest letters.

use std::collections::VecDeque;

use fipa::Outcome;
use fipa::admin::watch::{Fate, Passage};
use serde_json::{Map, Value, json};

use super::{clipped, moment};
use crate::command::watch::checker::CheckResult;
use crate::command::watch::json;

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
    fate: Map<String, Value>,
    pub(super) violation: Option<String>,
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
            fate: Map::new(),
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
        self.fate = Map::new();
        json::fate(&mut self.fate, &passage.fate);
    }

    /// The reason why it was not delivered.
    pub(super) fn reason(&self) -> Option<&str> {
        self.fate.get("reason").and_then(Value::as_str)
    }

    /// Its time as RFC 3339.
    pub(super) fn time(&self) -> &str {
        &self.at
    }

    /// Whether it was sent before this time in RFC 3339, of which all have the same form.
    pub(super) fn is_before(&self, time: &str) -> bool {
        *self.at < *time
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
