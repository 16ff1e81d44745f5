//! The conversations, with their newest letters.

use std::collections::{BTreeMap, HashMap, VecDeque};

use fipa::admin::watch::Passage;
use serde_json::{Value, json};

use super::letters::Letter;
use super::{clipped, moment};
use crate::command::watch::checker::CheckResult;

/// Maximum number of conversations. The one with the oldest last letter is forgotten first; one with a violation, last.
const MAX_CONVERSATIONS: usize = 1000;
/// Maximum number of letters of a conversation. The oldest is forgotten first.
const MAX_STEPS: usize = 200;
/// Maximum number of participants that are listed.
const MAX_PARTICIPANTS: usize = 8;

/// The conversations so far.
#[derive(Debug, Default)]
pub(super) struct Conversations {
    by_id: HashMap<String, Conversation>,
    /// The keys by violation and age: of the first, less is lost.
    order: BTreeMap<(bool, u64), String>,
}

/// One conversation.
#[derive(Debug, Default)]
struct Conversation {
    protocol: Option<String>,
    /// State of the protocol after the last letter.
    state: Option<String>,
    is_complete: bool,
    began: String,
    last: String,
    participants: Vec<String>,
    letters: u64,
    failures: u64,
    violations: u64,
    steps: VecDeque<Letter>,
    position: u64,
}

impl Conversations {
    /// Adds a letter that belongs to a conversation.
    pub(super) fn add(&mut self, passage: &Passage, checked: &CheckResult, letter: &Letter) {
        let Some(id) = passage.message.as_ref().and_then(|it| it.conversation_id()) else {
            return;
        };
        let id = clipped(id);
        if !self.by_id.contains_key(&id) {
            self.make_room();
        }
        let conversation = self.by_id.entry(id.clone()).or_default();
        self.order.remove(&conversation.key());
        conversation.add(passage, checked, letter);
        self.order.insert(conversation.key(), id);
    }

    fn make_room(&mut self) {
        if self.by_id.len() >= MAX_CONVERSATIONS
            && let Some((_, id)) = self.order.pop_first()
        {
            self.by_id.remove(&id);
        }
    }

    /// Takes later news of a letter.
    pub(super) fn news(&mut self, passage: &Passage) {
        let Some(id) = passage.message.as_ref().and_then(|it| it.conversation_id()) else {
            return;
        };
        let Some(conversation) = self.by_id.get_mut(&clipped(id)) else {
            return;
        };
        let mut newest = conversation.steps.iter_mut().rev();
        if let Some(letter) = newest.find(|letter| letter.number == passage.number) {
            let had_failed = letter.has_failed;
            letter.news(passage);
            conversation.failures += u64::from(letter.has_failed && !had_failed);
        }
    }

    /// The rows by identifier: those with violations first, then those with the newest letters.
    pub(super) fn newest(&self) -> impl Iterator<Item = (&str, Value)> {
        let newest = self.order.values().rev();
        newest.filter_map(|id| Some((id.as_str(), self.by_id.get(id)?.row(id))))
    }

    /// The row of a conversation, and those of its letters.
    pub(super) fn steps(&self, id: &str) -> Option<(Value, impl Iterator<Item = &Letter>)> {
        let conversation = self.by_id.get(id)?;
        Some((conversation.row(id), conversation.steps.iter()))
    }
}

impl Conversation {
    fn key(&self) -> (bool, u64) {
        (self.violations > 0, self.position)
    }

    fn add(&mut self, passage: &Passage, checked: &CheckResult, letter: &Letter) {
        self.position = passage.number;
        self.letters += 1;
        self.last = moment(passage.at);
        if self.began.is_empty() {
            self.began.clone_from(&self.last);
        }
        match checked {
            CheckResult::Accepted {
                protocol,
                state,
                complete,
                ..
            } => {
                self.protocol = Some(clipped(protocol));
                self.state = Some(clipped(state));
                self.is_complete = *complete;
            }
            CheckResult::Violation(violation) => {
                self.protocol = Some(clipped(&violation.protocol));
                self.violations += 1;
            }
            _ => {}
        }
        if self.protocol.is_none() {
            let said = passage.message.as_ref().and_then(|it| it.protocol());
            self.protocol = said.map(clipped);
        }
        for name in [&letter.from, &letter.to] {
            if self.participants.len() < MAX_PARTICIPANTS && !self.participants.contains(name) {
                self.participants.push(name.clone());
            }
        }
        self.failures += u64::from(letter.has_failed);
        if self.steps.len() >= MAX_STEPS {
            self.steps.pop_front();
        }
        self.steps.push_back(letter.clone());
    }

    fn row(&self, id: &str) -> Value {
        json!({
            "id": id, "protocol": self.protocol, "state": self.state, "complete": self.is_complete,
            "began": self.began, "last": self.last, "participants": self.participants,
            "letters": self.letters, "failures": self.failures, "violations": self.violations,
        })
    }
}
