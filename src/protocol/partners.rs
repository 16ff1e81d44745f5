//! The agents that a conversation waits for: whether they are gone, or their host is silent.
//!
//! [`Partners`] has no I/O and no clock. Changes of the directory, answers of the gateway and the time go
//! in; events and questions come out. `watching.rs` is the shell.
//!
//! Only the agent's own host proves that a registration has ended. On this host, that is the directory.
//! For an agent of another host, it is the answer of that host's gateway: its entry can also leave the
//! directory because a connection or a gateway has ended.

use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_sds::{Change, Entry, Reach};
use fipa_transport::Incarnation;

use crate::domain::presence::{Answer, Asked};

/// Time between the proof that a registration has ended and the event. Letters that the agent sent
/// before, and the new registration of an agent that moves, may arrive in the meantime.
///
/// The host of an agent that leaves cannot know whether the agent registers elsewhere later, and a call
/// ends within 100 ms of the proof. So an agent moves if it is registered again within this time, and has
/// left otherwise.
const SETTLE: Duration = Duration::from_millis(50);

/// A change that concerns a partner.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum PartnerEvent {
    /// The agent left, died, or has registered again without having moved. An agent that moves to another
    /// host is registered there within 50 ms after it has left.
    Gone {
        /// The name of the agent.
        agent: String,
    },
    /// The host of the agent gives no sign of life.
    Unreachable {
        /// The name of the agent.
        agent: String,
        /// The time of the last sign of life.
        since: Instant,
    },
    /// The host of the agent gives signs of life again, and the agent still exists.
    Returned {
        /// The name of the agent.
        agent: String,
    },
}

/// The agents that a conversation waits for.
#[derive(Debug)]
pub(crate) struct Partners {
    all: Vec<Partner>,
    heartbeat: Duration,
}

#[derive(Debug)]
struct Partner {
    name: Arc<str>,
    /// The registration with which the conversation goes on.
    entry: Option<Arc<Entry>>,
    /// The time of the last sign of life.
    heard: Instant,
    /// The time of the last question to the gateway.
    asked: Option<Instant>,
    /// The time of the first question after the last sign of life.
    unanswered: Option<Instant>,
    /// Whether the gateway of the agent cannot be asked.
    is_unsupported: bool,
    /// Whether the directory has the entry: no letter reaches an agent without one.
    is_listed: bool,
    /// Whether a question is due because the entry has left the directory.
    is_doubted: bool,
    /// The time of the event that the agent is gone.
    gone: Option<Instant>,
    /// Whether the event that the agent is gone was returned.
    is_gone: bool,
    /// Whether the event that the agent is unreachable was returned.
    is_silent: bool,
    /// Whether the agent has answered since.
    has_returned: bool,
}

impl Partners {
    /// Creates an empty list. A silence of `heartbeat` is an event.
    pub(crate) fn new(heartbeat: Duration) -> Self {
        Self {
            all: Vec::new(),
            heartbeat,
        }
    }

    /// Adds an agent with its registration, if the directory has one.
    pub(crate) fn add(&mut self, now: Instant, name: &str, entry: Option<Arc<Entry>>) {
        if self.all.iter().any(|it| *it.name == *name && !it.is_gone) {
            return;
        }
        self.remove(name);
        self.all.push(Partner {
            name: name.into(),
            is_listed: entry.is_some(),
            entry,
            heard: now,
            asked: None,
            unanswered: None,
            is_unsupported: false,
            is_doubted: false,
            gone: None,
            is_gone: false,
            is_silent: false,
            has_returned: false,
        });
    }

    /// Removes an agent.
    pub(crate) fn remove(&mut self, name: &str) {
        self.all.retain(|partner| *partner.name != *name);
    }

    /// Returns an agent that is gone, if no agent is left.
    pub(crate) fn all_gone(&self) -> Option<&str> {
        let last = self.all.last()?;
        let all = self.all.iter().all(|partner| partner.is_gone);
        all.then_some(&*last.name)
    }

    /// Whether an agent of another host may have left the directory for a while only: its gateway tells when it is gone.
    pub(crate) fn may_return(&self) -> bool {
        self.all.iter().any(Partner::is_asked_for)
    }

    /// Returns the agents that are unreachable now, with the time of their last sign of life.
    pub(crate) fn unreachable(&self) -> impl Iterator<Item = (&str, Instant)> {
        let silent = self.all.iter().filter(|it| it.is_silent && !it.is_gone);
        silent.map(|partner| (&*partner.name, partner.heard))
    }

    /// Handles a change of the directory.
    pub(crate) fn handle_change(&mut self, now: Instant, change: &Change) {
        for change in change.single() {
            let name = match change {
                Change::Joined(entry)
                | Change::Left(entry)
                | Change::Changed { after: entry, .. } => &entry.name,
                _ => continue,
            };
            let partner = self.all.iter_mut().find(|it| it.name == *name);
            let Some(partner) = partner.filter(|partner| !partner.is_gone) else {
                continue;
            };
            match change {
                Change::Left(entry) => partner.left(now, entry),
                Change::Joined(after) | Change::Changed { after, .. } => {
                    partner.registered(now, after);
                }
                _ => {}
            }
        }
    }

    /// Handles the present entry of each agent, after changes of the directory were missed.
    pub(crate) fn handle_entries(
        &mut self,
        now: Instant,
        entry_of: impl Fn(&str) -> Option<Arc<Entry>>,
    ) {
        for partner in self.all.iter_mut().filter(|partner| !partner.is_gone) {
            match (entry_of(&partner.name), partner.entry.clone()) {
                (Some(entry), _) => partner.registered(now, &entry),
                (None, Some(before)) => partner.left(now, &before),
                (None, None) => {}
            }
        }
    }

    /// Handles a message of an agent: a sign of life.
    pub(crate) fn handle_message(&mut self, now: Instant, from: &str) {
        let mut all = self.all.iter_mut();
        if let Some(partner) = all.find(|it| *it.name == *from && !it.is_gone) {
            partner.lives(now);
        }
    }

    /// Handles an answer of the gateway of this host.
    pub(crate) fn handle_answer(&mut self, now: Instant, answer: &Answer) {
        for partner in self.all.iter_mut().filter(|partner| !partner.is_gone) {
            let Some(id) = partner.registration() else {
                continue;
            };
            if answer.here.contains(&id) {
                partner.answers(now);
            }
            if answer.gone.contains(&id) {
                partner.ends(now);
            }
            if answer.unsupported.contains(&id) {
                partner.is_unsupported = true;
                partner.answers(now);
            }
        }
    }

    /// Returns the registrations that the gateway is to be asked for now.
    pub(crate) fn poll_question(&mut self, now: Instant) -> Vec<Asked> {
        let interval = self.interval();
        let mut due = Vec::new();
        for partner in &mut self.all {
            let is_due = partner.question(interval).is_some_and(|due| due <= now);
            if is_due && let Some(entry) = &partner.entry {
                due.push(Asked {
                    id: entry.incarnation,
                    mts: entry.mts.incarnation,
                });
                partner.asked = Some(now);
                partner.unanswered.get_or_insert(now);
                partner.is_doubted = false;
            }
        }
        due
    }

    /// Returns the next event.
    pub(crate) fn poll_event(&mut self, now: Instant) -> Option<PartnerEvent> {
        let (heartbeat, interval) = (self.heartbeat, self.interval());
        for partner in &mut self.all {
            let agent = || partner.name.to_string();
            if partner.gone.is_some_and(|due| due <= now) {
                let agent = agent();
                (partner.gone, partner.is_gone) = (None, true);
                return Some(PartnerEvent::Gone { agent });
            }
            if partner.has_returned {
                let agent = agent();
                partner.has_returned = false;
                return Some(PartnerEvent::Returned { agent });
            }
            let silent = partner.silence(heartbeat, interval);
            if silent.is_some_and(|due| due <= now) {
                let (agent, since) = (agent(), partner.heard);
                partner.is_silent = true;
                return Some(PartnerEvent::Unreachable { agent, since });
            }
        }
        None
    }

    /// Returns the time of the next question or event.
    pub(crate) fn poll_timeout(&self) -> Option<Instant> {
        let (heartbeat, interval) = (self.heartbeat, self.interval());
        let times = self.all.iter().flat_map(|partner| {
            [
                partner.gone,
                partner.question(interval),
                partner.silence(heartbeat, interval),
                partner.has_returned.then_some(partner.heard),
            ]
        });
        times.flatten().min()
    }

    /// Returns the time between two questions.
    fn interval(&self) -> Duration {
        self.heartbeat / 5
    }
}

impl Partner {
    /// Returns the incarnation of the registration.
    fn registration(&self) -> Option<Incarnation> {
        let id = self.entry.as_ref()?.incarnation;
        id.is_known().then_some(id)
    }

    /// Handles that an entry left the directory.
    fn left(&mut self, now: Instant, entry: &Arc<Entry>) {
        match self.registration() {
            Some(id) if id != entry.incarnation => return,
            Some(_) => {}
            // The entry left between the delivery of the first message and the first look-up.
            None => self.entry = Some(Arc::clone(entry)),
        }
        self.is_listed = false;
        // The event that it has returned is not true any more.
        self.is_silent |= std::mem::take(&mut self.has_returned);
        match entry.reach {
            Reach::Local => self.ends(now),
            Reach::Remote { .. } => self.is_doubted = true,
        }
    }

    /// Handles an entry of the agent's name.
    fn registered(&mut self, now: Instant, after: &Arc<Entry>) {
        let Some(before) = &self.entry else {
            self.entry = Some(Arc::clone(after));
            self.is_listed = true;
            return;
        };
        let is_same = before.incarnation == after.incarnation;
        if is_same || is_move(before, after) {
            let was_listed = std::mem::replace(&mut self.is_listed, true);
            if !is_same || !was_listed {
                self.lives(now);
            }
            self.is_unsupported &= is_same;
            self.entry = Some(Arc::clone(after));
            (self.gone, self.is_doubted) = (None, false);
        } else {
            self.ends(now);
        }
    }

    /// Handles the proof that the registration has ended.
    fn ends(&mut self, now: Instant) {
        self.gone.get_or_insert(now + SETTLE);
    }

    fn lives(&mut self, now: Instant) {
        self.answers(now);
        self.has_returned |= std::mem::take(&mut self.is_silent);
    }

    /// Handles an answer of its gateway, which comes before the directory has the entry again: letters fail until then.
    fn answers(&mut self, now: Instant) {
        self.heard = now;
        self.unanswered = None;
        self.has_returned |= self.is_listed && std::mem::take(&mut self.is_silent);
    }

    /// Whether its gateway is asked for it.
    fn is_asked_for(&self) -> bool {
        let can_answer = |entry: &Arc<Entry>| {
            let is_remote = matches!(entry.reach, Reach::Remote { .. });
            is_remote && entry.incarnation.is_known() && entry.mts.incarnation.is_known()
        };
        let is_over = self.is_gone || self.gone.is_some() || self.is_unsupported;
        self.entry.as_ref().is_some_and(can_answer) && !is_over
    }

    /// Returns the time of the next question.
    fn question(&self, interval: Duration) -> Option<Instant> {
        if !self.is_asked_for() {
            return None;
        }
        if self.is_doubted {
            return Some(self.heard);
        }
        Some(self.asked.unwrap_or(self.heard).max(self.heard) + interval)
    }

    /// Returns the time at which the agent counts as unreachable.
    fn silence(&self, heartbeat: Duration, interval: Duration) -> Option<Instant> {
        let is_over = self.is_gone || self.gone.is_some() || self.is_unsupported;
        let unanswered = self.unanswered.filter(|_| !self.is_silent && !is_over)?;
        // The first question comes one interval after the last sign of life.
        Some(unanswered + heartbeat.saturating_sub(interval))
    }
}

/// Whether the agent has moved: its new registration is on another host than the one before.
fn is_move(before: &Entry, after: &Entry) -> bool {
    match (before.reach, after.reach) {
        (Reach::Local, Reach::Local) => false,
        (Reach::Remote { .. }, Reach::Remote { .. }) => {
            match (&before.mts.name, &after.mts.name) {
                // The name of a gateway stays when it starts again.
                (Some(before), Some(after)) => before != after,
                _ => before.mts.incarnation != after.mts.incarnation,
            }
        }
        _ => true,
    }
}

#[cfg(test)]
mod tests {
    use std::time::SystemTime;

    use fipa_sds::{MtsId, Role, Source};

    use super::*;

    const HEARTBEAT: Duration = Duration::from_secs(5);

    fn id(number: u64) -> Incarnation {
        Incarnation::from_u64(number)
    }

    fn entry(registration: u64, reach: Reach, mts: &str, service: u64) -> Arc<Entry> {
        Arc::new(Entry {
            name: "arm".into(),
            agent_type: String::new(),
            incarnation: id(registration),
            locations: Vec::new(),
            mts: MtsId::new(mts, id(service)),
            description: String::new(),
            registered: SystemTime::UNIX_EPOCH,
            source: Source::Host,
            reach,
            peer: fipa_transport::PeerId::THIS_HOST,
            role: Role::Agent,
        })
    }

    fn local(registration: u64) -> Arc<Entry> {
        entry(registration, Reach::Local, "host-1", 50)
    }

    fn remote(registration: u64, mts: &str) -> Arc<Entry> {
        entry(registration, Reach::Remote { gateway: id(60) }, mts, 70)
    }

    /// Creates the partner `arm` with this registration, and the times of a test in milliseconds.
    fn with(entry: Option<Arc<Entry>>) -> (Partners, impl Fn(u64) -> Instant) {
        let begun = Instant::now();
        let mut partners = Partners::new(HEARTBEAT);
        partners.add(begun, "arm", entry);
        (partners, move |ms| begun + Duration::from_millis(ms))
    }

    fn gone() -> Option<PartnerEvent> {
        let agent = "arm".to_owned();
        Some(PartnerEvent::Gone { agent })
    }

    fn here(registration: u64) -> Answer {
        Answer {
            here: vec![id(registration)],
            ..Answer::default()
        }
    }

    fn ended(registration: u64) -> Answer {
        Answer {
            gone: vec![id(registration)],
            ..Answer::default()
        }
    }

    #[test]
    fn an_agent_of_this_host_that_leaves_is_gone_once() {
        let (mut partners, at) = with(Some(local(1)));
        assert_eq!(partners.poll_timeout(), None, "nothing to do until then");
        partners.handle_change(at(1000), &Change::Left(local(1)));
        assert_eq!(partners.poll_event(at(1049)), None);
        assert_eq!(partners.poll_timeout(), Some(at(1050)));
        assert_eq!(partners.all_gone(), None);
        assert_eq!(partners.poll_event(at(1050)), gone());
        assert_eq!(partners.all_gone(), Some("arm"));
        assert_eq!(partners.poll_event(at(9000)), None);
        assert_eq!(partners.poll_timeout(), None);
    }

    #[test]
    fn another_registration_on_the_same_host_is_no_move() {
        let (mut partners, at) = with(Some(local(1)));
        let (before, after) = (local(1), local(2));
        partners.handle_change(at(0), &Change::Changed { before, after });
        assert_eq!(partners.poll_event(at(50)), gone());
        // A host that starts again has another gateway of the same name.
        let (mut partners, at) = with(Some(remote(1, "crex-mts")));
        let after = remote(2, "crex-mts");
        let before = remote(1, "crex-mts");
        partners.handle_change(at(0), &Change::Changed { before, after });
        assert_eq!(partners.poll_event(at(50)), gone());
    }

    #[test]
    fn an_agent_that_moves_is_not_gone() {
        let (mut partners, at) = with(Some(local(1)));
        partners.handle_change(at(0), &Change::Left(local(1)));
        partners.handle_change(at(40), &Change::Joined(remote(2, "crex-mts")));
        assert_eq!(partners.poll_event(at(60)), None);
        let (before, after) = (remote(2, "crex-mts"), remote(3, "argo-mts"));
        partners.handle_change(at(90), &Change::Changed { before, after });
        partners.handle_change(at(95), &Change::Left(remote(2, "crex-mts")));
        assert_eq!(partners.poll_event(at(200)), None);
        // The new registration is the one that counts.
        partners.handle_answer(at(300), &ended(3));
        assert_eq!(partners.poll_event(at(350)), gone());
    }

    #[test]
    fn an_entry_of_another_host_that_leaves_is_no_proof_but_a_reason_to_ask() {
        let (mut partners, at) = with(Some(remote(1, "crex-mts")));
        assert!(partners.poll_question(at(0)).is_empty(), "not at once");
        partners.handle_change(at(10), &Change::Left(remote(1, "crex-mts")));
        let asked = Asked {
            id: id(1),
            mts: id(70),
        };
        assert_eq!(partners.poll_question(at(10)), [asked]);
        assert_eq!(partners.poll_event(at(500)), None);
        partners.handle_answer(at(510), &ended(1));
        assert_eq!(partners.poll_timeout(), Some(at(560)));
        assert_eq!(partners.poll_event(at(560)), gone());
        assert!(partners.poll_question(at(9000)).is_empty());
    }

    #[test]
    fn a_silent_host_is_unreachable_after_the_heartbeat_and_may_return() {
        let (mut partners, at) = with(Some(remote(1, "crex-mts")));
        assert_eq!(partners.poll_timeout(), Some(at(1000)));
        assert_eq!(partners.poll_question(at(1000)).len(), 1);
        partners.handle_answer(at(1001), &here(1));
        assert_eq!(partners.poll_timeout(), Some(at(2001)));
        for second in 0..4 {
            assert_eq!(partners.poll_event(at(2001 + 1000 * second)), None);
            assert_eq!(partners.poll_question(at(2001 + 1000 * second)).len(), 1);
        }
        // An answer about another registration is none.
        partners.handle_answer(at(6000), &here(9));
        assert_eq!(partners.poll_event(at(6000)), None);
        let (agent, since) = ("arm".to_owned(), at(1001));
        let silent = PartnerEvent::Unreachable { agent, since };
        assert_eq!(partners.poll_event(at(6001)), Some(silent));
        assert_eq!(partners.poll_event(at(7000)), None, "once");
        assert_eq!(partners.unreachable().next(), Some(("arm", at(1001))));
        // The gateway is still asked.
        assert_eq!(partners.poll_question(at(7001)).len(), 1);
        partners.handle_answer(at(7100), &here(1));
        let agent = "arm".to_owned();
        assert_eq!(
            partners.poll_event(at(7100)),
            Some(PartnerEvent::Returned { agent })
        );
        assert_eq!(partners.unreachable().next(), None);
        assert_eq!(partners.all_gone(), None);
    }

    /// Letters to it would fail.
    #[test]
    fn an_agent_that_the_directory_has_lost_returns_with_its_entry() {
        let (mut partners, at) = with(Some(remote(1, "crex-mts")));
        partners.handle_change(at(0), &Change::Left(remote(1, "crex-mts")));
        assert_eq!(partners.poll_question(at(0)).len(), 1);
        let silent = partners.poll_event(at(4000));
        assert!(matches!(silent, Some(PartnerEvent::Unreachable { .. })));
        partners.handle_answer(at(4500), &here(1));
        assert_eq!(partners.poll_event(at(4500)), None);
        assert_eq!(partners.unreachable().count(), 1);
        partners.handle_change(at(4600), &Change::Joined(remote(1, "crex-mts")));
        let agent = "arm".to_owned();
        assert_eq!(
            partners.poll_event(at(4600)),
            Some(PartnerEvent::Returned { agent })
        );
        // It leaves the directory again before the event that it has returned.
        partners.handle_change(at(4700), &Change::Left(remote(1, "crex-mts")));
        assert_eq!(partners.poll_question(at(4700)).len(), 1);
        assert!(partners.poll_event(at(9000)).is_some());
        partners.handle_change(at(9001), &Change::Joined(remote(1, "crex-mts")));
        partners.handle_change(at(9001), &Change::Left(remote(1, "crex-mts")));
        assert_eq!(partners.poll_event(at(9001)), None);
        assert_eq!(partners.unreachable().count(), 1);
        partners.handle_change(at(9002), &Change::Joined(remote(1, "crex-mts")));
        assert!(partners.poll_event(at(9002)).is_some());
    }

    #[test]
    fn a_silent_agent_that_sends_a_message_or_moves_has_returned() {
        let silent = || {
            let (mut partners, at) = with(Some(remote(1, "crex-mts")));
            partners.handle_change(at(0), &Change::Left(remote(1, "crex-mts")));
            assert_eq!(partners.poll_question(at(0)).len(), 1);
            assert!(partners.poll_event(at(4000)).is_some());
            (partners, at)
        };
        let (mut partners, at) = silent();
        partners.handle_message(at(4001), "arm");
        assert_eq!(partners.unreachable().count(), 0);
        for moved in [local(2), remote(2, "argo-mts")] {
            let (mut partners, at) = silent();
            partners.handle_change(at(4001), &Change::Joined(moved));
            assert_eq!(partners.unreachable().count(), 0);
            let event = partners.poll_event(at(4001));
            assert!(matches!(event, Some(PartnerEvent::Returned { .. })));
        }
    }

    #[test]
    fn time_without_a_call_that_waits_is_no_silence() {
        let (mut partners, at) = with(Some(remote(1, "crex-mts")));
        // No call waits for a minute, so no question is sent.
        assert_eq!(partners.poll_event(at(60_000)), None);
        assert_eq!(partners.poll_question(at(60_000)).len(), 1);
        assert_eq!(partners.poll_event(at(60_001)), None);
        partners.handle_message(at(60_002), "arm");
        assert_eq!(partners.poll_event(at(65_000)), None);
    }

    #[test]
    fn a_gateway_that_cannot_be_asked_is_never_silent() {
        let (mut partners, at) = with(Some(remote(1, "crex-mts")));
        assert_eq!(partners.poll_question(at(1000)).len(), 1);
        let unsupported = Answer {
            unsupported: vec![id(1)],
            ..Answer::default()
        };
        partners.handle_answer(at(1001), &unsupported);
        assert_eq!(partners.poll_timeout(), None);
        // A legacy peer has no incarnations.
        let legacy = entry(0, Reach::Remote { gateway: id(0) }, "jade", 0);
        let (mut partners, at) = with(Some(Arc::clone(&legacy)));
        assert_eq!(partners.poll_timeout(), None);
        partners.handle_change(at(0), &Change::Left(legacy));
        assert_eq!(partners.poll_timeout(), None);
        assert_eq!(partners.poll_event(at(60_000)), None);
    }

    #[test]
    fn missed_changes_are_made_up_for() {
        let (mut partners, at) = with(Some(local(1)));
        partners.handle_entries(at(0), |_| Some(local(1)));
        assert_eq!(partners.poll_timeout(), None);
        partners.handle_entries(at(0), |_| None);
        assert_eq!(partners.poll_event(at(50)), gone());
        let (mut partners, at) = with(Some(local(1)));
        partners.handle_entries(at(0), |_| Some(local(2)));
        assert_eq!(partners.poll_event(at(50)), gone());
    }

    #[test]
    fn an_agent_that_left_before_it_was_looked_up_is_gone() {
        let (mut partners, at) = with(None);
        let of_other = Change::Left(Arc::new(Entry {
            name: "leg".into(),
            ..Entry::clone(&local(9))
        }));
        partners.handle_change(at(0), &of_other);
        assert_eq!(partners.poll_timeout(), None);
        partners.handle_change(at(0), &Change::Left(local(1)));
        assert_eq!(partners.poll_event(at(50)), gone());
        // The changes before the first look-up are of an earlier registration.
        let (mut partners, at) = with(Some(local(2)));
        partners.handle_change(at(0), &Change::Left(local(1)));
        partners.handle_change(at(0), &Change::Joined(local(2)));
        assert_eq!(partners.poll_timeout(), None);
    }
}
