//! The monitor of conversations.

mod eviction;
mod timeouts;

use std::hash::{BuildHasher, RandomState};
use std::sync::Arc;
use std::time::UNIX_EPOCH;

use crate::check::judge::Move;
use crate::conversation::deadlines::Deadlines;
use crate::conversation::fingerprints::Fingerprints;
use crate::conversation::ids::SlotIndex;
use crate::conversation::memory::{Refused, Removed};
use crate::conversation::names::Names;
use crate::conversation::table::Table;
use crate::protocol::machine::Machine;
use crate::verdict::Verdict;
use crate::{Header, History, Library, Moment, MonitorLimits, MonitorPolicy};

/// Checks messages against the protocols of their conversations.
///
/// [`check`](Self::check) takes the messages in the order in which they were sent or received, and
/// returns a verdict. A message that violates its protocol changes nothing. The monitor has no clock:
/// the caller passes the current time. [`handle_timeout`](Self::handle_timeout) reports overdue
/// messages, and removes conversations that are over or abandoned.
///
/// Several conversations may have one identifier: a message belongs to the one in which its sender and
/// its receivers take part.
#[derive(Debug)]
pub struct Monitor {
    pub(crate) library: Arc<Library>,
    pub(crate) limits: MonitorLimits,
    pub(crate) policy: MonitorPolicy,
    history: History,
    /// The monitored agent; none for an observer.
    pub(crate) agent: Option<Arc<str>>,
    pub(crate) names: Names,
    pub(crate) table: Table,
    pub(crate) removed: Removed,
    pub(crate) refused: Refused,
    pub(crate) deadlines: Deadlines,
    pub(crate) hasher: RandomState,
    pub(crate) fingerprints: Fingerprints,
    /// Whether all messages belong to one conversation.
    pub(crate) single: bool,
    /// Buffer that is reused.
    pub(crate) moves: Vec<Move>,
    forgotten: u64,
    pub(crate) last: Moment,
}

/// An event that has no message.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum Event {
    /// No message came by the `reply-by` of the last one, or within the timeout of the state.
    Overdue {
        /// Name of the protocol.
        protocol: String,
        /// Conversation identifier.
        conversation_id: String,
        /// Participant, if each has a state of its own.
        participant: Option<String>,
        /// State in which no message came.
        state: String,
        /// State after the timeout, if the protocol defines one.
        next: Option<String>,
    },
    /// The monitor has removed a conversation that was not over, because it had no message for
    /// [`MonitorLimits::idle`].
    Abandoned {
        /// Name of the protocol.
        protocol: String,
        /// Conversation identifier.
        conversation_id: String,
    },
}

impl Monitor {
    /// Creates a monitor of the conversations of all agents.
    #[must_use]
    pub fn observer(library: Arc<Library>) -> Self {
        Self::with(library, None)
    }

    /// Creates a monitor of the conversations of one agent.
    ///
    /// The caller passes all messages that the agent sends and receives, in their order, and no other
    /// ones. So a message of the agent cannot have crossed a message that was passed before it, and the
    /// monitor is stricter than an observer. A message of another agent that does not name the agent
    /// was sent to a group of which it is a member.
    #[must_use]
    pub fn agent(library: Arc<Library>, name: &str) -> Self {
        Self::with(library, Some(name.into()))
    }

    fn with(library: Arc<Library>, agent: Option<Arc<str>>) -> Self {
        let hasher = RandomState::new();
        Self {
            library,
            limits: MonitorLimits::default(),
            policy: MonitorPolicy::default(),
            history: History::Complete,
            agent,
            names: Names::new(hasher.clone()),
            table: Table::new(&hasher),
            removed: Removed::default(),
            refused: Refused::default(),
            deadlines: Deadlines::default(),
            hasher,
            fingerprints: Fingerprints::random(),
            single: false,
            moves: Vec::new(),
            forgotten: 0,
            last: Moment::from(UNIX_EPOCH),
        }
    }

    /// Sets the limits.
    #[must_use]
    pub fn with_limits(mut self, limits: MonitorLimits) -> Self {
        self.limits = limits;
        self
    }

    /// Sets the messages that are refused without a conversation. By default, there are none.
    #[must_use]
    pub fn with_policy(mut self, policy: MonitorPolicy) -> Self {
        self.policy = policy;
        self
    }

    /// Sets the extent of the knowledge of the monitor. By default, it is complete.
    #[must_use]
    pub fn with_history(mut self, history: History) -> Self {
        self.history = history;
        self
    }

    /// Makes all messages with one identifier belong to one conversation. By default, an agent that does
    /// not lead a conversation can begin another one with the same identifier. A caller that knows that
    /// a message continues its conversation forbids this: the message is then a violation, unless its
    /// protocol may run within the conversation now.
    #[must_use]
    pub fn with_one_conversation(mut self) -> Self {
        self.single = true;
        self
    }

    /// Changes the extent of the knowledge of the monitor: see [`with_history`](Self::with_history).
    pub fn set_history(&mut self, history: History) {
        self.history = history;
    }

    /// Records that a conversation with this identifier may have begun without the monitor: before it,
    /// or between other agents of which one names the monitored agent in a `reply-to`. A message that
    /// continues it is then [unchecked](crate::Unchecked::UnknownHistory) instead of a violation.
    pub fn expect(&mut self, id: &str) {
        self.remember_removed(id);
    }

    /// Protocols of the monitor.
    #[must_use]
    pub fn library(&self) -> &Library {
        &self.library
    }

    /// Number of conversations, including embedded ones.
    #[must_use]
    pub fn len(&self) -> usize {
        self.table.len()
    }

    /// Whether the monitor has no conversation.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Number of conversations that were evicted before their end because of
    /// [`MonitorLimits::conversations`] or [`MonitorLimits::bytes`].
    #[must_use]
    pub fn forgotten(&self) -> u64 {
        self.forgotten
    }

    /// Bytes of all conversations: see [`MonitorLimits::bytes`].
    #[must_use]
    pub fn bytes(&self) -> usize {
        self.table.bytes()
    }

    /// Checks a message. If it fits its conversation, updates the conversation.
    pub fn check(&mut self, header: &Header<'_>, now: impl Into<Moment>) -> Verdict<'_> {
        let now = now.into();
        self.last = now;
        match self.judge_and_apply(header, now) {
            Ok(passed) => self.accepted(&passed),
            Err(denied) => self.denied(header, denied),
        }
    }

    /// Whether a conversation with this identifier that the monitor does not have did not begin.
    pub(crate) fn is_certain(&self, id: &str) -> bool {
        self.history == History::Complete && !self.removed.contains(self.hasher.hash_one(id))
    }

    /// Records that the monitor does not know the conversations with this identifier any more.
    pub(crate) fn remember_removed(&mut self, id: &str) {
        self.removed.add(self.hasher.hash_one(id));
    }

    pub(crate) fn machine_of<'l>(
        &self,
        library: &'l Library,
        at: SlotIndex,
    ) -> Option<&'l Machine> {
        library.machine(self.table.slot(at)?.conversation.machine)
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use fipa_acl::{Performative, Time};

    use super::*;
    use crate::conversation::names::COMPARISONS;
    use crate::conversation::party::Details;
    use crate::conversation::rare::Rare;

    #[test]
    fn stale_deadlines_are_removed() {
        let mut monitor = Monitor::observer(Arc::new(Library::standard()));
        let now = UNIX_EPOCH + Duration::from_secs(1_700_000_000);
        let due = Time::from_system_time(now + Duration::from_secs(3_600));
        let due = due.expect("a time of this century");
        for number in 0..5_000 {
            let say = |act, from: &'static str, to: &'static str| {
                let header = Header::new(act).sender(from).receivers([to]);
                let header = header.protocol("fipa-contract-net");
                header.conversation_id(number.to_string())
            };
            let call = say(Performative::Cfp, "ann", "ben").reply_by(due);
            assert!(monitor.check(&call, now).is_accepted());
            let answer = say(Performative::Refuse, "ben", "ann");
            assert!(monitor.check(&answer, now).is_accepted());
        }
        assert!(
            monitor.deadlines.len() < 1_100,
            "{:?}",
            monitor.deadlines.len()
        );
    }

    #[test]
    fn embedded_conversations_have_references_to_the_peer_of_theirs() {
        let mut monitor = Monitor::agent(Arc::new(Library::standard()), "ben");
        let now = UNIX_EPOCH + Duration::from_secs(1_700_000_000);
        let hour = Duration::from_secs(3_600);
        let mut say = |words: &'static str, protocol, id, now| {
            let (act, agents) = words.split_once(' ').unwrap();
            let (from, to) = agents.split_once('>').unwrap();
            let header = Header::new(act.parse().unwrap()).sender(from);
            let header = header.receivers([to]).protocol(protocol);
            assert!(
                monitor
                    .check(&header.conversation_id(id), now)
                    .is_accepted()
            );
        };
        say("request zed>ben", "fipa-request", "1", now);
        say("request ann>ben", "fipa-request", "2", now);
        say("proxy ann>ben", "fipa-brokering", "3", now);
        say("agree ben>ann", "fipa-brokering", "3", now);
        say("request ben>cid", "fipa-request", "3", now);
        say("query-if ben>cid", "fipa-query", "3", now);
        say("cfp ben>cid", "fipa-contract-net", "3", now);
        say("agree ben>zed", "fipa-request", "1", now + 20 * hour);
        say("agree ben>ann", "fipa-request", "2", now + 20 * hour);
        let held = |monitor: &Monitor, name| {
            let name = monitor.names.known(name);
            name.map(|name| monitor.table.of_peer(Some(name)).0)
        };
        let both = |monitor: &Monitor| ["zed", "ann"].map(|name| held(monitor, name));
        assert_eq!(both(&monitor), [Some(1), Some(5)]);
        monitor.handle_timeout(now + 25 * hour);
        assert_eq!(both(&monitor), [Some(1), Some(1)]);
        monitor.handle_timeout(now + 50 * hour);
        assert_eq!(monitor.names.len(), 0);
    }

    #[test]
    fn names_of_undelivered_messages_are_released() {
        let text = r#"<scxml initial="1">
            <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
            <state id="2"><transition performative="propagate" from="b" to="c" target="3"/></state>
            <state id="3"><transition performative="inform" from="c" to="a" target="4"/></state>
            <state id="4" final="yes"/></scxml>"#;
        let mut library = Library::standard();
        library.add(Machine::read("own", text).unwrap()).unwrap();
        let mut monitor = Monitor::agent(Arc::new(library), "ann");
        let now = UNIX_EPOCH + Duration::from_secs(1_700_000_000);
        let request = |to: &'static str| {
            let header = Header::new(Performative::Request).sender("ann");
            header.receivers([to]).protocol("own").conversation_id("1")
        };
        let mut bytes = Vec::new();
        for to in ["ben", "cid", "dan"] {
            assert!(monitor.check(&request(to), now).is_accepted());
            assert!(monitor.names.known(to).is_some());
            assert_eq!(monitor.names.len(), 2, "{to}");
            bytes.push(monitor.bytes());
            monitor.undelivered(&request(to), to, now);
            assert_eq!(monitor.names.len(), 2, "{to}");
        }
        assert_eq!(bytes[1], bytes[2]);
        monitor.handle_timeout(now + Duration::from_secs(100_000));
        assert_eq!(monitor.names.len(), 0);
    }

    #[test]
    fn names_are_compared_in_linear_steps() {
        const MANY: usize = 500;
        let text = r#"<scxml initial="1">
            <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
            <state id="2"><transition performative="inform" from="a" to="b" target="3"/></state>
            <state id="3"><transition performative="agree" from="b" to="a" target="3"/></state></scxml>"#;
        let mut library = Library::standard();
        library.add(Machine::read("plain", text).unwrap()).unwrap();
        let library = Arc::new(library);
        let now = UNIX_EPOCH + Duration::from_secs(1_700_000_000);
        let header = |act, protocol| Header::new(act).protocol(protocol).conversation_id("1");
        let all = || (0..MANY).map(|number| format!("agent {number}"));
        for (protocol, acts) in [
            ("plain", [Performative::Request, Performative::Inform]),
            (
                "fipa-contract-net",
                [Performative::Cfp, Performative::Cancel],
            ),
        ] {
            let mut monitor = Monitor::observer(Arc::clone(&library));
            let sent = |act| header(act, protocol).sender("ann").receivers(all());
            let lost = header(Performative::Failure, protocol).sender("mts");
            let lost = lost.receivers(all()).undelivered_to("ann");
            for message in acts.map(sent).into_iter().chain([lost]) {
                let before = COMPARISONS.get();
                let verdict = monitor.check(&message, now);
                assert!(verdict.is_accepted(), "{verdict:?}");
                let comparisons = COMPARISONS.get() - before;
                assert!(
                    comparisons < 10 * MANY,
                    "{protocol}: {comparisons} comparisons"
                );
            }
        }
    }

    #[test]
    fn a_conversation_may_have_the_whole_share_of_a_peer() {
        let now = UNIX_EPOCH + Duration::from_secs(1_700_000_000);
        let library = Arc::new(Library::standard());
        let begun = |share| {
            let limits = MonitorLimits {
                bytes: share * 8,
                ..MonitorLimits::default()
            };
            let mut monitor = Monitor::observer(Arc::clone(&library)).with_limits(limits);
            let request = Header::new(Performative::Request).sender("ann");
            let request = request.receivers(["ben"]).protocol("fipa-request");
            let verdict = monitor.check(&request.conversation_id("1"), now);
            (verdict.is_accepted(), monitor.bytes())
        };
        let (_, bytes) = begun(1 << 20);
        // The conversation may need details and rare parts later.
        let bound = bytes + size_of::<Details>() + size_of::<Rare>();
        assert_eq!(begun(bound), (true, bytes));
        assert_eq!(begun(bound - 1), (false, 0));
    }

    #[test]
    fn names_are_released_with_the_last_conversation() {
        let mut monitor = Monitor::observer(Arc::new(Library::standard()));
        let now = UNIX_EPOCH + Duration::from_secs(1_700_000_000);
        for id in ["1", "2"] {
            let call = Header::new(Performative::Cfp).sender("ann");
            let call = call.receivers(["ben", "cid"]).reply_to(["dan"]);
            let call = call.protocol("fipa-contract-net").conversation_id(id);
            assert!(monitor.check(&call, now).is_accepted());
        }
        assert_eq!(monitor.names.len(), 4);
        monitor.handle_timeout(now + Duration::from_secs(100_000));
        assert_eq!(monitor.names.len(), 0);
    }
}
