//! The newest letters.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::SystemTime;

use fipa::admin::watch::{Fate, Passage};
use fipa::{FailureReason, Outcome};
use serde::Serialize;
use serde_json::{Map, Value};

use super::{clipped, moment};
use crate::command::watch::checker::CheckResult;
use crate::command::watch::json;

/// Maximum number of letters.
const MAX_LETTERS: usize = 5000;

/// An observed letter.
#[derive(Debug, Clone)]
pub(super) struct Letter {
    pub(super) number: u64,
    pub(super) at: SystemTime,
    pub(super) from: String,
    pub(super) to: String,
    performative: String,
    pub(super) protocol: Option<String>,
    pub(super) conversation: Option<String>,
    size: u64,
    via: Option<&'static str>,
    gateway: Option<String>,
    fate: Fate,
    pub(super) violation: Option<String>,
}

/// The row of a letter.
#[derive(Debug, Serialize)]
pub(super) struct LetterRow<'a> {
    number: u64,
    time: String,
    from: &'a str,
    to: &'a str,
    performative: &'a str,
    protocol: Option<&'a str>,
    conversation: Option<&'a str>,
    size: u64,
    via: Option<&'static str>,
    gateway: Option<&'a str>,
    fate: Map<String, Value>,
    violation: Option<&'a str>,
}

impl Letter {
    pub(super) fn of(passage: &Passage, checked: &CheckResult) -> Self {
        let message = passage.message.as_ref();
        Self {
            number: passage.number,
            at: passage.at,
            from: clipped(passage.sender().unwrap_or("?")),
            to: clipped(&passage.receiver),
            performative: clipped(message.map_or("?", |it| it.performative().as_str())),
            protocol: message.and_then(|it| it.protocol()).map(clipped),
            conversation: message.and_then(|it| it.conversation_id()).map(clipped),
            size: passage.size,
            via: passage.via.map(fipa::Kind::name),
            gateway: passage.gateway.as_deref().map(clipped),
            fate: passage.fate.clone(),
            violation: match checked {
                CheckResult::Violation(violation) => Some(clipped(&violation.to_string())),
                _ => None,
            },
        }
    }

    /// Takes later news of it.
    pub(super) fn news(&mut self, passage: &Passage) {
        self.via = passage.via.map(fipa::Kind::name);
        self.gateway = passage.gateway.as_deref().map(clipped);
        self.fate.clone_from(&passage.fate);
    }

    /// The reason why it was not delivered, as its sender was told.
    pub(super) fn reason(&self) -> Option<FailureReason> {
        match &self.fate {
            Fate::Settled(Outcome::Failed { reason, .. }) => Some(*reason),
            _ => None,
        }
    }

    /// Whether its sender was told that it was not delivered.
    pub(super) fn has_failed(&self) -> bool {
        self.reason().is_some()
    }

    /// The row of the letter.
    pub(super) fn row(&self) -> LetterRow<'_> {
        let mut fate = Map::new();
        json::fate(&mut fate, &self.fate);
        LetterRow {
            number: self.number,
            time: moment(self.at),
            from: &self.from,
            to: &self.to,
            performative: &self.performative,
            protocol: self.protocol.as_deref(),
            conversation: self.conversation.as_deref(),
            size: self.size,
            via: self.via,
            gateway: self.gateway.as_deref(),
            fate,
            violation: self.violation.as_deref(),
        }
    }
}

/// The newest letters in the order of their numbers.
#[derive(Debug, Default)]
pub(super) struct Letters {
    newest: VecDeque<Arc<Letter>>,
}

impl Letters {
    pub(super) fn add(&mut self, letter: Arc<Letter>) {
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
            Arc::make_mut(letter).news(passage);
        }
    }

    /// The oldest letter.
    pub(super) fn oldest(&self) -> Option<&Letter> {
        self.newest.front().map(|letter| &**letter)
    }

    /// The letters, the newest first.
    pub(super) fn newest(&self) -> impl Iterator<Item = &Letter> {
        self.newest.iter().rev().map(|letter| &**letter)
    }
}
