//! The letters of each conversation, to be drawn.

use std::collections::{BTreeMap, HashMap};
use std::time::{Duration, Instant, SystemTime};

use fipa::Outcome;
use fipa::watch::{Fate, Passage};
use fipa_acl::escape;

use super::judge::Judged;
use super::person::Look;
use super::sequence;

/// Conversations that are kept; the one that rests longest goes first.
const MAX_CONVERSATIONS: usize = 1000;
/// Letters of one that are kept; of a longer one, the first.
const MAX_STEPS: usize = 2000;
/// One that may be over is drawn when nothing has come for so long,
const QUIET: Duration = Duration::from_secs(1);
/// and any other when nothing has come for so long.
const ABANDONED: Duration = Duration::from_secs(10);

/// All conversations that have been seen.
#[derive(Debug, Default)]
pub(super) struct Conversations {
    by_id: HashMap<String, Conversation>,
    /// In the order in which they began.
    order: BTreeMap<u64, String>,
    begun: u64,
}

/// One conversation.
#[derive(Debug, Clone)]
pub(super) struct Conversation {
    pub(super) id: String,
    pub(super) protocol: Option<String>,
    pub(super) steps: Vec<Step>,
    /// How many letters were left out.
    pub(super) left_out: u64,
    place: u64,
    last: Instant,
    complete: bool,
    /// How many of the steps have been drawn.
    drawn: usize,
}

/// A letter of a conversation. All texts are [escaped](escape).
#[derive(Debug, Clone)]
pub(super) struct Step {
    pub(super) at: SystemTime,
    pub(super) from: String,
    pub(super) to: String,
    /// The performative, and the way unless it is shared memory.
    pub(super) label: String,
    /// Why it did not arrive.
    pub(super) failed: Option<String>,
    /// In which way it breaks the protocol.
    pub(super) violation: Option<String>,
}

impl Conversations {
    /// Takes a letter in. What must be drawn now, because there is no room for it any more.
    pub(super) fn add(&mut self, passage: &Passage, judged: &Judged) -> Option<Conversation> {
        let message = passage.message.as_ref()?;
        let id = message.conversation_id()?;
        let mut evicted = None;
        if !self.by_id.contains_key(id) {
            if self.by_id.len() >= MAX_CONVERSATIONS {
                evicted = self.evict();
            }
            self.begun += 1;
            self.order.insert(self.begun, id.to_owned());
            let conversation = Conversation {
                id: id.to_owned(),
                protocol: None,
                steps: Vec::new(),
                left_out: 0,
                place: self.begun,
                last: Instant::now(),
                complete: false,
                drawn: 0,
            };
            self.by_id.insert(id.to_owned(), conversation);
        }
        let conversation = self.by_id.get_mut(id)?;
        conversation.last = Instant::now();
        if conversation.protocol.is_none() {
            let said = judged.protocol().or_else(|| message.protocol());
            conversation.protocol = said.map(str::to_owned);
        }
        if let Judged::Accepted { complete, .. } = judged {
            conversation.complete = *complete;
        }
        if conversation.steps.len() >= MAX_STEPS {
            conversation.left_out += 1;
        } else {
            conversation.steps.push(Step::of(passage, judged));
        }
        evicted
    }

    fn evict(&mut self) -> Option<Conversation> {
        let oldest = self.by_id.values().min_by_key(|it| it.last)?.id.clone();
        let conversation = self.by_id.remove(&oldest)?;
        self.order.remove(&conversation.place);
        (conversation.drawn < conversation.steps.len()).then_some(conversation)
    }

    /// Those that have come to rest and were not drawn yet.
    pub(super) fn resting(&mut self) -> impl Iterator<Item = &Conversation> {
        self.undrawn(|conversation| {
            let quiet = conversation.last.elapsed();
            quiet >= ABANDONED || (conversation.complete && quiet >= QUIET)
        })
    }

    /// All that were not drawn yet.
    pub(super) fn rest(&mut self) -> impl Iterator<Item = &Conversation> {
        self.undrawn(|_| true)
    }

    fn undrawn(
        &mut self,
        wanted: impl Fn(&Conversation) -> bool,
    ) -> impl Iterator<Item = &Conversation> {
        let mut due = Vec::new();
        for conversation in self.by_id.values_mut() {
            if conversation.drawn < conversation.steps.len() && wanted(conversation) {
                conversation.drawn = conversation.steps.len();
                due.push(conversation.place);
            }
        }
        due.sort_unstable();
        let ids = due.into_iter().filter_map(|place| self.order.get(&place));
        ids.filter_map(|id| self.by_id.get(id))
    }

    /// All, in the order in which they began.
    pub(super) fn all(&self) -> impl Iterator<Item = &Conversation> {
        self.order.values().filter_map(|id| self.by_id.get(id))
    }
}

impl Conversation {
    /// As a sequence diagram in the terminal, with a blank line behind it.
    pub(super) fn drawn(&self, look: Look) -> String {
        sequence::draw(self, look) + "\n"
    }

    /// What stands above its diagram.
    pub(super) fn title(&self) -> String {
        let id = escape(&self.id);
        match &self.protocol {
            Some(protocol) => format!("conversation {id} ({})", escape(protocol)),
            None => format!("conversation {id}"),
        }
    }

    /// Who takes part, in the order in which they appear.
    pub(super) fn participants(&self) -> Vec<&str> {
        let mut names: Vec<&str> = Vec::new();
        let mut known = std::collections::HashSet::new();
        for step in &self.steps {
            for name in [&step.from, &step.to] {
                if known.insert(name.as_str()) {
                    names.push(name);
                }
            }
        }
        names
    }

    #[cfg(test)]
    pub(super) fn of(id: &str, protocol: &str, steps: Vec<Step>) -> Self {
        Self {
            id: id.to_owned(),
            protocol: Some(protocol.to_owned()),
            steps,
            left_out: 0,
            place: 1,
            last: Instant::now(),
            complete: true,
            drawn: 0,
        }
    }
}

impl Step {
    fn of(passage: &Passage, judged: &Judged) -> Self {
        let message = passage.message.as_ref();
        let performative = message.map_or("?", |it| it.performative().as_str());
        let mut label = escape(performative).into_owned();
        match passage.via {
            Some(via) if via != fipa::Kind::Shm => label.push_str(&format!(" ({via})")),
            _ => {}
        }
        Self {
            at: passage.at,
            from: escape(passage.sender().unwrap_or("?")).into_owned(),
            to: escape(&passage.receiver).into_owned(),
            label,
            failed: match &passage.fate {
                Fate::Settled(Outcome::Failed { reason, .. })
                | Fate::Passed(Outcome::Failed { reason, .. }) => Some(reason.to_string()),
                _ => None,
            },
            violation: match judged {
                Judged::Violation(violation) => Some(violation.to_string()),
                _ => None,
            },
        }
    }
}
