//! The state of the domain that the dashboard shows, from observed letters, the directory and reports. No I/O.
//!
//! All tables are bounded, and so is each text: any process of the domain can invent names.

mod agents;
mod conversations;
mod goals;
mod history;
mod letters;
mod partners;

use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use fipa::Entry;
use fipa::admin::watch::{Event, Passage};
use fipa::locks::ResourceStatus;
use serde::Serialize;
use serde_json::json;

use self::agents::Agents;
use self::conversations::{Conversation, Conversations};
use self::goals::Goals;
pub(super) use self::goals::cancelled_object;
use self::history::History;
use self::letters::{Letter, Letters};
use self::partners::Partners;
use super::view::View;
use crate::command::locks;
use crate::command::top::{Snapshot, TotalsObject, peer_object};
use crate::command::watch::checker::CheckResult;
pub(super) use crate::output::moment;

/// Maximum length of a text, in characters.
const MAX_TEXT: usize = 256;

/// Maximum number of letters in a view.
const SHOWN_LETTERS: usize = 200;

/// Maximum number of conversations in a view.
const SHOWN_CONVERSATIONS: usize = 200;

/// The state of the domain.
#[derive(Debug, Default)]
pub(super) struct Picture {
    agents: Agents,
    conversations: Conversations,
    letters: Letters,
    history: History,
    locks: Vec<ResourceStatus>,
    pub(super) goals: Goals,
    /// The counted letters at the last look.
    counted: Option<Snapshot>,
    /// The fleet at the last look, as soon as a page has asked for it.
    fleet: Option<Arc<View>>,
    /// The reason why the domain cannot be observed.
    problem: Option<String>,
    /// Whether clients may send messages.
    has_control: bool,
}

/// The values of the whole domain.
#[derive(Debug, Serialize)]
struct Totals<'a> {
    #[serde(flatten)]
    totals: TotalsObject<'a>,
    control: bool,
}

/// A view with its parameter.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Wanted {
    /// Hosts, agents and coalitions.
    Fleet,
    /// An agent, its conversations and its letters.
    Agent {
        name: String,
        /// The topic whose values are wanted, beside the first ones.
        topic: Option<String>,
    },
    /// The conversations with the newest letters, and those with violations.
    Conversations,
    /// A conversation with its letters.
    Conversation(String),
    /// The resources that agents lock, and the goals that they run.
    Locks,
    /// The newest letters.
    Letters,
    /// The newest letters of this time, in seconds since 1970.
    Past(u64),
}

impl Picture {
    /// An empty picture.
    pub(super) fn new(has_control: bool) -> Self {
        Self {
            has_control,
            ..Self::default()
        }
    }

    /// Handles an event of a letter; `checked` is the result of the check of a new one.
    pub(super) fn handle(&mut self, event: &Event, checked: Option<&CheckResult>) {
        match (event, checked) {
            (Event::Letter(passage), Some(checked)) => {
                let letter = Arc::new(Letter::of(passage, checked));
                self.conversations.add(&letter, checked);
                self.letters.add(letter);
            }
            (Event::Later(passage) | Event::Confirmed(passage), _) => self.news(passage),
            _ => {}
        }
    }

    fn news(&mut self, passage: &Passage) {
        self.letters.news(passage);
        self.conversations.news(passage);
    }

    /// Takes the agents in the directory, and the counted letters.
    pub(super) fn look(&mut self, now: SystemTime, entries: &Arc<[Arc<Entry>]>, counted: Snapshot) {
        self.problem = None;
        self.agents.look(now, entries);
        self.history.add(now, &counted);
        self.counted = Some(counted);
        self.fleet = None;
    }

    /// The fleet. All pages share it until the next look.
    fn fleet(&mut self) -> Arc<View> {
        if let Some(fleet) = &self.fleet {
            return Arc::clone(fleet);
        }
        let mut fleet = View::default();
        if let Some(counted) = &self.counted {
            for section in ["agents", "hosts", "history"] {
                fleet.section(section);
            }
            for (second, point) in self.history.points() {
                fleet.put("history", second.to_string(), point);
            }
            let totals = Totals {
                totals: TotalsObject::of(counted),
                control: self.has_control,
            };
            fleet.put("domain", "totals", &totals);
            for peer in &counted.peers {
                fleet.put("hosts", clipped(&peer.name), &peer_object(peer));
            }
            for (name, row) in self.agents.rows(&counted.agents) {
                fleet.put("agents", name, &row);
            }
        }
        let fleet = Arc::new(fleet);
        self.fleet = Some(Arc::clone(&fleet));
        fleet
    }

    /// Takes the state of all locks.
    pub(super) fn take_locks(&mut self, locks: Vec<ResourceStatus>) {
        self.locks = locks;
    }

    /// Takes the reason why the domain cannot be observed.
    pub(super) fn fail(&mut self, problem: String) {
        self.problem = Some(problem);
    }

    /// Returns a view.
    pub(super) fn view(&mut self, wanted: &Wanted) -> Arc<View> {
        if let Some(problem) = &self.problem {
            let mut view = View::default();
            view.put("domain", "totals", &json!({ "problem": problem }));
            return Arc::new(view);
        }
        match wanted {
            Wanted::Fleet => return self.fleet(),
            Wanted::Agent { name, .. } => self.agent(name),
            Wanted::Conversations => self.all_conversations(),
            Wanted::Conversation(id) => self.conversation(id),
            Wanted::Locks => self.all_locks(),
            Wanted::Letters => self.newest_letters(|_| true),
            Wanted::Past(second) => self.past(*second),
        }
        .into()
    }

    fn agent(&self, name: &str) -> View {
        let mut view = self.newest_letters(|letter| letter.from == name || letter.to == name);
        for section in ["agent", "conversations", "partners", "reasons"] {
            view.section(section);
        }
        let partners = Partners::of(name, self.letters.newest());
        for (partner, row) in partners.rows() {
            view.put("partners", partner, &row);
        }
        for (reason, row) in partners.reasons() {
            view.put("reasons", reason, &row);
        }
        view.put("domain", "totals", &json!({ "control": self.has_control }));
        if let Some(row) = self.agents.row(name) {
            view.put("agent", name, &row);
        }
        self.put_conversations(&mut view, |conversation| conversation.has(name));
        view
    }

    fn all_conversations(&self) -> View {
        let mut view = View::default();
        view.section("conversations");
        self.put_conversations(&mut view, |_| true);
        view
    }

    fn put_conversations(&self, view: &mut View, shown: impl Fn(&Conversation) -> bool) {
        let newest = self.conversations.newest();
        let shown = newest.filter(|(_, conversation)| shown(conversation));
        for (id, conversation) in shown.take(SHOWN_CONVERSATIONS) {
            view.put("conversations", id, &conversation.row(id));
        }
    }

    fn conversation(&self, id: &str) -> View {
        let mut view = View::default();
        for section in ["conversation", "letters"] {
            view.section(section);
        }
        if let Some((row, letters)) = self.conversations.steps(id) {
            view.put("conversation", id, &row);
            for letter in letters {
                view.put("letters", letter.number.to_string(), &letter.row());
            }
        }
        view
    }

    fn all_locks(&self) -> View {
        let mut view = View::default();
        view.section("locks");
        for lock in &self.locks {
            view.put("locks", lock.resource.as_str(), &locks::in_json(lock));
        }
        self.goals.put(&mut view);
        view.put("domain", "totals", &json!({ "control": self.has_control }));
        view
    }

    /// The letters at the end of a second.
    fn past(&self, second: u64) -> View {
        let end = UNIX_EPOCH.checked_add(Duration::from_secs(second.saturating_add(1)));
        let mut view = self.newest_letters(|letter| end.is_none_or(|end| letter.at < end));
        let since = self.letters.oldest().map(|letter| moment(letter.at));
        view.put("domain", "totals", &json!({ "since": since }));
        view
    }

    fn newest_letters(&self, shown: impl Fn(&Letter) -> bool) -> View {
        let mut view = View::default();
        view.section("letters");
        let letters = self.letters.newest().filter(|letter| shown(letter));
        for letter in letters.take(SHOWN_LETTERS) {
            view.put("letters", letter.number.to_string(), &letter.row());
        }
        view
    }
}

/// The beginning of a text.
pub(super) fn clipped(text: &str) -> String {
    match text.char_indices().nth(MAX_TEXT) {
        Some((end, _)) => format!("{}…", text.get(..end).unwrap_or_default()),
        None => text.to_owned(),
    }
}
