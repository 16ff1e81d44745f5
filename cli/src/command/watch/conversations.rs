//! Collects the letters of each conversation for the diagrams.

use std::collections::{BTreeMap, HashMap};
use std::time::{Duration, Instant, SystemTime};

use fipa::Outcome;
use fipa::admin::watch::{Fate, Passage};
use fipa_acl::{escape, escape_name};

use super::checker::CheckResult;
use super::sequence;
use super::text::Look;

/// Maximum number of stored conversations; the one that is idle longest is evicted first.
const MAX_CONVERSATIONS: usize = 1000;
/// Maximum number of stored letters per conversation; further letters are only counted.
const MAX_STEPS: usize = 2000;
/// Idle time after which a complete conversation is drawn.
const COMPLETE_IDLE: Duration = Duration::from_secs(1);
/// Idle time after which an incomplete conversation is drawn.
const INCOMPLETE_IDLE: Duration = Duration::from_secs(10);

/// The conversations seen so far.
#[derive(Debug, Default)]
pub(super) struct Conversations {
    by_id: HashMap<String, Conversation>,
    /// Identifiers by the order in which the conversations began.
    order: BTreeMap<u64, String>,
    begun: u64,
}

/// One conversation.
#[derive(Debug, Clone)]
pub(super) struct Conversation {
    pub(super) id: String,
    pub(super) protocol: Option<String>,
    pub(super) steps: Vec<Step>,
    /// Number of letters that are not stored.
    pub(super) left_out: u64,
    /// Key in `Conversations::order`.
    position: u64,
    last: Instant,
    complete: bool,
    /// Number of steps that were drawn.
    drawn: usize,
}

/// A letter of a conversation. All its texts are [escaped](escape).
#[derive(Debug, Clone)]
pub(super) struct Step {
    pub(super) at: SystemTime,
    pub(super) from: String,
    pub(super) to: String,
    /// The performative, and the transport unless it is shared memory.
    pub(super) label: String,
    /// Reason of the failed delivery.
    pub(super) failed: Option<String>,
    /// Description of the protocol violation.
    pub(super) violation: Option<String>,
}

impl Conversations {
    /// Adds a letter. Returns a conversation that was evicted before it was drawn.
    pub(super) fn add(&mut self, passage: &Passage, checked: &CheckResult) -> Option<Conversation> {
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
                position: self.begun,
                last: Instant::now(),
                complete: false,
                drawn: 0,
            };
            self.by_id.insert(id.to_owned(), conversation);
        }
        let conversation = self.by_id.get_mut(id)?;
        conversation.last = Instant::now();
        if conversation.protocol.is_none() {
            let protocol = checked.protocol().or_else(|| message.protocol());
            conversation.protocol = protocol.map(str::to_owned);
        }
        if let CheckResult::Accepted { complete, .. } = checked {
            conversation.complete = *complete;
        }
        if conversation.steps.len() >= MAX_STEPS {
            conversation.left_out += 1;
        } else {
            conversation.steps.push(Step::of(passage, checked));
        }
        evicted
    }

    fn evict(&mut self) -> Option<Conversation> {
        let oldest = self.by_id.values().min_by_key(|it| it.last)?.id.clone();
        let conversation = self.by_id.remove(&oldest)?;
        self.order.remove(&conversation.position);
        (conversation.drawn < conversation.steps.len()).then_some(conversation)
    }

    /// Takes the idle conversations that were not drawn yet.
    pub(super) fn take_idle(&mut self) -> impl Iterator<Item = &Conversation> {
        self.take_undrawn(|conversation| {
            let idle = conversation.last.elapsed();
            idle >= INCOMPLETE_IDLE || (conversation.complete && idle >= COMPLETE_IDLE)
        })
    }

    /// Takes all conversations that were not drawn yet.
    pub(super) fn take_all(&mut self) -> impl Iterator<Item = &Conversation> {
        self.take_undrawn(|_| true)
    }

    fn take_undrawn(
        &mut self,
        wanted: impl Fn(&Conversation) -> bool,
    ) -> impl Iterator<Item = &Conversation> {
        let mut due = Vec::new();
        for conversation in self.by_id.values_mut() {
            if conversation.drawn < conversation.steps.len() && wanted(conversation) {
                conversation.drawn = conversation.steps.len();
                due.push(conversation.position);
            }
        }
        due.sort_unstable();
        let ids = due
            .into_iter()
            .filter_map(|position| self.order.get(&position));
        ids.filter_map(|id| self.by_id.get(id))
    }

    /// All stored conversations in the order in which they began.
    pub(super) fn all(&self) -> impl Iterator<Item = &Conversation> + Clone {
        self.order.values().filter_map(|id| self.by_id.get(id))
    }
}

impl Conversation {
    /// The conversation as a sequence diagram for the terminal, followed by a blank line.
    pub(super) fn drawn(&self, look: Look) -> String {
        sequence::draw(self, look) + "\n"
    }

    /// The title of the diagram.
    pub(super) fn title(&self) -> String {
        let id = escape_name(&self.id);
        match &self.protocol {
            Some(protocol) => format!("conversation {id} ({})", escape(protocol)),
            None => format!("conversation {id}"),
        }
    }

    /// The participants in the order of their first letters.
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
            position: 1,
            last: Instant::now(),
            complete: true,
            drawn: 0,
        }
    }
}

impl Step {
    fn of(passage: &Passage, checked: &CheckResult) -> Self {
        let message = passage.message.as_ref();
        let performative = message.map_or("?", |it| it.performative().as_str());
        let mut label = escape(performative).into_owned();
        match passage.via {
            Some(via) if via != fipa::Kind::Shm => label.push_str(&format!(" ({via})")),
            _ => {}
        }
        Self {
            at: passage.at,
            from: escape_name(passage.sender().unwrap_or("?")).into_owned(),
            to: escape_name(&passage.receiver).into_owned(),
            label,
            failed: match &passage.fate {
                Fate::Settled(Outcome::Failed { reason, .. })
                | Fate::Passed(Outcome::Failed { reason, .. }) => Some(reason.to_string()),
                _ => None,
            },
            violation: match checked {
                CheckResult::Violation(violation) => Some(violation.to_string()),
                _ => None,
            },
        }
    }
}
