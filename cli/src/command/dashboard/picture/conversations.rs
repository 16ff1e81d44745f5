//! The conversations, with their newest letters.

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::sync::Arc;
use std::time::SystemTime;

use fipa::admin::watch::Passage;
use serde::Serialize;

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
#[derive(Debug)]
pub(super) struct Conversation {
    protocol: Option<String>,
    /// State of the protocol after the last letter.
    state: Option<String>,
    is_complete: bool,
    began: SystemTime,
    last: SystemTime,
    participants: Vec<String>,
    letters: u64,
    failures: u64,
    violations: u64,
    steps: VecDeque<Arc<Letter>>,
    position: u64,
}

/// The row of a conversation.
#[derive(Debug, Serialize)]
pub(super) struct ConversationRow<'a> {
    id: &'a str,
    protocol: Option<&'a str>,
    state: Option<&'a str>,
    complete: bool,
    began: String,
    last: String,
    participants: &'a [String],
    letters: u64,
    failures: u64,
    violations: u64,
}

impl Conversations {
    /// Adds a letter that belongs to a conversation.
    pub(super) fn add(&mut self, letter: &Arc<Letter>, checked: &CheckResult) {
        let Some(id) = &letter.conversation else {
            return;
        };
        if let Some(conversation) = self.by_id.get_mut(id) {
            let id = self.order.remove(&conversation.key());
            conversation.add(letter, checked);
            self.order
                .insert(conversation.key(), id.unwrap_or_default());
            return;
        }
        self.make_room();
        let mut conversation = Conversation::new(letter);
        conversation.add(letter, checked);
        self.order.insert(conversation.key(), id.clone());
        self.by_id.insert(id.clone(), conversation);
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
            let had_failed = letter.has_failed();
            Arc::make_mut(letter).news(passage);
            conversation.failures += u64::from(letter.has_failed() && !had_failed);
        }
    }

    /// The conversations by identifier: those with violations first, then those with the newest letters.
    pub(super) fn newest(&self) -> impl Iterator<Item = (&str, &Conversation)> {
        let newest = self.order.values().rev();
        newest.filter_map(|id| Some((id.as_str(), self.by_id.get(id)?)))
    }

    /// The row of a conversation, and its letters.
    pub(super) fn steps(
        &self,
        id: &str,
    ) -> Option<(ConversationRow<'_>, impl Iterator<Item = &Letter>)> {
        let (id, conversation) = self.by_id.get_key_value(id)?;
        let letters = conversation.steps.iter().map(|letter| &**letter);
        Some((conversation.row(id), letters))
    }
}

impl Conversation {
    /// Begins with this letter, which is still to be added.
    fn new(first: &Letter) -> Self {
        Self {
            protocol: None,
            state: None,
            is_complete: false,
            began: first.at,
            last: first.at,
            participants: Vec::new(),
            letters: 0,
            failures: 0,
            violations: 0,
            steps: VecDeque::new(),
            position: first.number,
        }
    }

    fn key(&self) -> (bool, u64) {
        (self.violations > 0, self.position)
    }

    fn add(&mut self, letter: &Arc<Letter>, checked: &CheckResult) {
        self.position = letter.number;
        self.letters += 1;
        self.last = letter.at;
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
            self.protocol.clone_from(&letter.protocol);
        }
        for name in [&letter.from, &letter.to] {
            if self.participants.len() < MAX_PARTICIPANTS && !self.participants.contains(name) {
                self.participants.push(name.clone());
            }
        }
        self.failures += u64::from(letter.has_failed());
        if self.steps.len() >= MAX_STEPS {
            self.steps.pop_front();
        }
        self.steps.push_back(Arc::clone(letter));
    }

    /// Whether an agent is among the participants that are listed.
    pub(super) fn has(&self, participant: &str) -> bool {
        self.participants.iter().any(|it| it == participant)
    }

    pub(super) fn row<'a>(&'a self, id: &'a str) -> ConversationRow<'a> {
        ConversationRow {
            id,
            protocol: self.protocol.as_deref(),
            state: self.state.as_deref(),
            complete: self.is_complete,
            began: moment(self.began),
            last: moment(self.last),
            participants: &self.participants,
            letters: self.letters,
            failures: self.failures,
            violations: self.violations,
        }
    }
}
