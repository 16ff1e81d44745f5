//! Checks the messages of this process's agents against their protocols: one monitor per agent, and
//! the reaction that the configuration demands.
//!
//! Not in this module: the rules of the protocols (`fipa-monitor`).

use std::sync::Arc;
use std::time::{Duration, SystemTime};

use fipa_acl::{Message, Performative};
use fipa_monitor::{
    Header, History, Library, LibraryError, LibraryFull, Moment, Monitor, MonitorLimits,
    MonitorPolicy, SnapshotError, Verdict, Violation, ViolationKind,
};
use fipa_mts::core::Received;
use fipa_sds::{Directory, Entry, Reach, Resolution, Role, resolve};
use fipa_transport::counts::SharedCounts;
use fipa_transport::{Incarnation, log_limit};
use parking_lot::Mutex;

use crate::agent::incoming::Incoming;
use crate::config::{self, Check};
use crate::domain::counting;
use crate::error::{ProtocolError, SendError};

/// The settings of `[monitor]` and the known protocols, for all agents of this process.
pub(crate) struct Rules {
    library: Arc<Library>,
    check: Check,
    answer: bool,
    heartbeat: Duration,
    limits: MonitorLimits,
    policy: MonitorPolicy,
}

impl Rules {
    pub(crate) fn load(config: &config::Monitor) -> Result<Self, ProtocolError> {
        let mut library = Library::standard();
        for file in &config.protocols {
            let text = std::fs::read_to_string(file).map_err(|source| ProtocolError::Read {
                path: file.into(),
                source,
            })?;
            library.read(file, &text).map_err(|error| match error {
                LibraryError::Scxml(error) => ProtocolError::Scxml(error),
                _ => ProtocolError::Full(LibraryFull),
            })?;
        }
        let mut limits = MonitorLimits::default();
        limits.idle = config.idle;
        limits.conversations = config.conversations;
        limits.bytes = usize::try_from(config.bytes).unwrap_or(usize::MAX);
        let mut policy = MonitorPolicy::strict();
        policy.exempt = config.exempt.iter().cloned().collect();
        Ok(Self {
            limits,
            policy,
            library: Arc::new(library),
            check: config.check,
            answer: config.answer,
            heartbeat: config.heartbeat,
        })
    }

    /// Returns the silence of another host after which its agents count as unreachable.
    pub(crate) fn heartbeat(&self) -> Duration {
        self.heartbeat
    }

    /// Returns the known protocols.
    pub(crate) fn library(&self) -> &Arc<Library> {
        &self.library
    }

    /// Creates the checks of an agent that has just been registered in this directory. Its own
    /// conversation ids begin with `ids`. Violations count in `counts`.
    pub(crate) fn checks(
        &self,
        agent: &str,
        ids: String,
        directory: &dyn Directory,
        counts: SharedCounts,
    ) -> Checks {
        if self.check == Check::Off {
            return Checks(None);
        }
        let monitor = Monitor::agent(Arc::clone(&self.library), agent);
        let monitor = monitor.with_limits(self.limits);
        directory.refresh();
        let entries = directory.entries();
        let here = entries.iter().filter(|entry| entry.reach == Reach::Local);
        Checks(Some(Arc::new(Monitored {
            monitor: Mutex::new(monitor.with_policy(self.policy.clone())),
            earlier: Mutex::new(Some(here.cloned().collect())),
            ids,
            enforce: self.check == Check::Enforce,
            answer: self.answer,
            counts,
        })))
    }
}

/// The checks of one agent; empty if the configuration turns them off.
#[derive(Clone)]
pub(crate) struct Checks(Option<Arc<Monitored>>);

/// The monitor of one agent.
struct Monitored {
    monitor: Mutex<Monitor>,
    /// The agents of this host at the registration of the agent. An agent of this host that is not among them
    /// cannot continue a conversation of an earlier registration. None if there was no earlier one.
    earlier: Mutex<Option<Arc<[Arc<Entry>]>>>,
    /// The beginning of the conversation ids that only this registration issues.
    ids: String,
    enforce: bool,
    answer: bool,
    counts: SharedCounts,
}

/// The origin of a received letter, as far as its link proves it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Origin {
    /// The registration of the sending agent.
    sender: Incarnation,
    /// The service that handed the letter over.
    service: Incarnation,
    /// Whether the letter is from this process itself.
    is_own: bool,
    /// Whether the service is on another host.
    remote: bool,
}

/// An accepted message whose outcomes are unknown.
pub(crate) struct Unsettled {
    monitored: Arc<Monitored>,
    /// In a box, because the future of each sent message has room for it.
    header: Box<Header<'static>>,
}

impl Checks {
    /// See [`Protocols::expect_conversation`](crate::protocol::Protocols::expect_conversation).
    pub(crate) fn expect_conversation(&self, id: &str) {
        if let Some(monitored) = &self.0 {
            monitored.monitor.lock().expect(id);
        }
    }

    /// See [`Departure::conversations`](crate::protocol::Departure::conversations).
    pub(crate) fn conversations(&self) -> Vec<u8> {
        let monitored = self.0.as_ref();
        monitored.map_or_else(Vec::new, |monitored| {
            monitored.monitor.lock().snapshot(now())
        })
    }

    /// See [`Protocols::restore_conversations`](crate::protocol::Protocols::restore_conversations).
    pub(crate) fn restore_conversations(
        &self,
        conversations: &[u8],
    ) -> Result<usize, SnapshotError> {
        match &self.0 {
            Some(monitored) if !conversations.is_empty() => {
                monitored.monitor.lock().restore(conversations, now())
            }
            _ => Ok(0),
        }
    }

    /// See [`Protocols::set_history`](crate::protocol::Protocols::set_history).
    pub(crate) fn set_history(&self, history: History) {
        if let Some(monitored) = &self.0 {
            *monitored.earlier.lock() = None;
            monitored.monitor.lock().set_history(history);
        }
    }

    /// Checks a message that is about to be sent. Returns the receiver of its outcomes.
    pub(crate) fn check_outgoing(
        &self,
        message: &Message,
        directory: &dyn Directory,
    ) -> Result<Option<Unsettled>, SendError> {
        let Some(monitored) = &self.0 else {
            return Ok(None);
        };
        let groups = groups(message, directory);
        let mut header = Header::from(message);
        for (name, members) in &groups {
            header = header.group(*name, members.iter().map(|member| &**member));
        }
        let violation = monitored.violation(&header, |earlier| {
            let receivers = message.receivers().iter().map(|receiver| receiver.name());
            let members = groups.iter().flat_map(|(_, members)| members);
            let mut partners = receivers.chain(members.map(|member| &**member));
            partners.any(|partner| {
                let is_remote = |entry: Arc<Entry>| entry.reach != Reach::Local;
                earlier.contains(partner) || directory.lookup(partner).is_some_and(is_remote)
            })
        });
        match violation {
            Some(violation) if monitored.enforce => Err(SendError::Violation(violation)),
            Some(violation) => {
                log_limit::warn!("sent a message that violates its protocol: {violation}");
                Ok(None)
            }
            None => Ok(Unsettled::new(monitored, message)),
        }
    }

    /// Checks a received message. `answer` is called with the text of a violation that is to be
    /// answered with not-understood, and returns that answer if one was sent.
    pub(crate) fn arrived(
        &self,
        mut incoming: Incoming,
        origin: Origin,
        directory: &dyn Directory,
        answer: impl FnOnce(&Message, String) -> Option<Message>,
    ) -> Incoming {
        let Some(monitored) = &self.0 else {
            return incoming;
        };
        let Some(violation) = monitored.arrived(&incoming, origin, directory) else {
            return incoming;
        };
        if origin.is_legacy() && violation.kind.depends_on_policy() {
            log_limit::warn!(
                of: incoming.message().sender(), "received a message of a legacy peer that is accepted although it breaks a rule: \
                 {violation}"
            );
            return incoming;
        }
        // Not-understood and failure are never answered; otherwise two agents could answer each other
        // without end.
        let never_answered = [Performative::NotUnderstood, Performative::Failure];
        if monitored.answer
            && !never_answered.contains(incoming.message().performative())
            && let Some(answer) = answer(incoming.message(), violation.to_string())
        {
            // The answer ends the conversation in the monitor, if the sender takes part in one.
            let _ = monitored.check(&Header::from(&answer));
        }
        log_limit::warn!(of: incoming.message().sender(), "received a message that violates its protocol: {violation}");
        incoming.violates(violation);
        incoming
    }
}

/// The agents that were registered before the monitored one.
struct Earlier<'a>(&'a [Arc<Entry>]);

impl Earlier<'_> {
    fn contains(&self, name: &str) -> bool {
        let found = self.0.binary_search_by(|entry| (*entry.name).cmp(name));
        found.is_ok()
    }
}

impl Monitored {
    /// Checks a received message.
    fn arrived(
        &self,
        incoming: &Incoming,
        origin: Origin,
        directory: &dyn Directory,
    ) -> Option<Box<Violation>> {
        let mut header = incoming.header();
        // Only a message with both begins a conversation.
        if header.protocol_name().is_some() && header.conversation().is_some() {
            let name = header.sender_name().unwrap_or_default();
            let sender = directory.sender(origin.sender, name, &incoming.peer());
            header = match origin.peer(sender.as_deref()) {
                Some(peer) => header.peer(peer),
                None => header,
            };
        }
        self.violation(&header, |earlier| {
            let sender = header.sender_name();
            sender.is_some_and(|sender| earlier.contains(sender)) || origin.is_remote(directory)
        })
    }

    /// Checks a message. `may_continue` is called if the message continues an unknown conversation: it
    /// returns whether its other agents may have begun it with an earlier registration of this agent.
    fn violation(
        &self,
        header: &Header<'_>,
        may_continue: impl FnOnce(&Earlier<'_>) -> bool,
    ) -> Option<Box<Violation>> {
        let violation = self.check(header);
        tracing::trace!(
            performative = %header.performative(),
            conversation = header.conversation(),
            violates = violation.is_some(),
            "checked"
        );
        let violation = violation?;
        let is_unknown = matches!(
            violation.kind,
            ViolationKind::NotOpened | ViolationKind::Unsolicited
        );
        let id = header.conversation().filter(|_| is_unknown);
        let earlier = self.earlier.lock().clone();
        if let (Some(id), Some(earlier)) = (id, earlier)
            && !id.starts_with(&self.ids)
            && may_continue(&Earlier(&earlier))
        {
            self.monitor.lock().expect(id);
            return self.check(header);
        }
        Some(violation)
    }

    fn check(&self, header: &Header<'_>) -> Option<Box<Violation>> {
        let now = now();
        let mut monitor = self.monitor.lock();
        if monitor.poll_elapsed().is_some_and(|due| due <= now.elapsed) {
            for event in monitor.handle_timeout(now) {
                tracing::debug!(?event, "conversation");
            }
        }
        match monitor.check(header, now) {
            Verdict::Violation(violation) => {
                let protocol = counting::protocol_number(&violation.protocol);
                (*self.counts).as_ref().shared_violation(protocol);
                Some(violation)
            }
            _ => None,
        }
    }
}

impl Origin {
    pub(crate) fn of(received: &Received) -> Self {
        Self {
            sender: received.sender,
            service: received.service,
            is_own: received.via.is_none(),
            remote: received.remote,
        }
    }

    /// Whether the sender is an agent of a legacy peer.
    fn is_legacy(&self) -> bool {
        !self.is_own && !self.sender.is_known()
    }

    /// Whether the sender is not proved to be an agent of this host.
    fn is_remote(&self, directory: &dyn Directory) -> bool {
        if self.is_own {
            return false;
        }
        if self.remote || self.is_legacy() {
            return true;
        }
        match directory.known_incarnation(self.sender) {
            Some(entry) => entry.reach != Reach::Local,
            // The entry has left the directory. The gateway hands over the letters of other hosts.
            None => {
                let service = directory.by_incarnation(self.service);
                service.is_some_and(|service| service.role == Role::Gateway)
            }
        }
    }

    /// Returns the peer that is charged with a conversation that the letter begins: the one that announced an
    /// agent on another host, otherwise the process that handed the letter over. `sender` is the entry of
    /// the sender.
    fn peer(&self, sender: Option<&Entry>) -> Option<String> {
        if self.is_own {
            return None;
        }
        Some(match sender {
            Some(entry) if entry.reach != Reach::Local => entry.peer.to_string(),
            _ => self.service.to_string(),
        })
    }
}

impl Unsettled {
    fn new(monitored: &Arc<Monitored>, message: &Message) -> Option<Self> {
        let header = header_of_outcomes(message)?;
        Some(Self {
            monitored: Arc::clone(monitored),
            header: Box::new(header),
        })
    }

    /// Handles the outcomes, of which these receivers had a failure: the message may be sent to them
    /// again.
    pub(crate) fn settle<'a>(self, undelivered: impl Iterator<Item = &'a str>) {
        for receiver in undelivered {
            let mut monitor = self.monitored.monitor.lock();
            monitor.undelivered(&self.header, receiver, now());
        }
    }
}

/// Returns the parameters of a message that [`Monitor::undelivered`] reads. A message outside of a
/// conversation has none.
pub(crate) fn header_of_outcomes(message: &Message) -> Option<Header<'static>> {
    let id = message.conversation_id()?.to_owned();
    let sender = message.sender()?.name().to_owned();
    let mut header = Header::new(message.performative().clone())
        .sender(sender)
        .conversation_id(id);
    if let Some(protocol) = message.protocol() {
        header = header.protocol(protocol.to_owned());
    }
    if let Some(reply_with) = message.reply_with() {
        header = header.reply_with(reply_with.to_owned());
    }
    Some(header)
}

/// Returns the receivers that stand for several agents, with these agents.
fn groups<'m>(message: &'m Message, directory: &dyn Directory) -> Vec<(&'m str, Vec<Arc<str>>)> {
    if message.conversation_id().is_none() {
        return Vec::new();
    }
    let own = message.sender().map_or("", |sender| sender.name());
    let names = message.receivers().iter().map(|receiver| receiver.name());
    let group = |name: &'m str| {
        let known = directory.known(name);
        if known.is_some_and(|entry| !matches!(entry.role, Role::Coalition(_))) {
            return None;
        }
        let name_of = |entry: Arc<Entry>| Arc::clone(&entry.name);
        match resolve(directory, name, own) {
            Ok(Resolution::Multicast(entries)) => {
                Some((name, entries.into_iter().map(name_of).collect()))
            }
            Ok(Resolution::Coalition {
                agents, missing, ..
            }) => {
                let agents = agents.into_iter().map(name_of);
                Some((name, agents.chain(missing).collect()))
            }
            // The delivery reports an invalid pattern.
            Ok(Resolution::Exact(_) | Resolution::None) | Err(_) => None,
        }
    };
    names.filter_map(group).collect()
}

/// Returns the current time. The monotonic clock counts while the machine is suspended.
pub(crate) fn now() -> Moment {
    let elapsed = rustix::time::clock_gettime(rustix::time::ClockId::Boottime);
    let elapsed = Duration::try_from(elapsed).unwrap_or_default();
    Moment::new(SystemTime::now(), elapsed)
}

#[cfg(test)]
mod tests {
    use std::time::SystemTime;

    use fipa_acl::{AgentId, Time};
    use fipa_mts::letter_for;
    use fipa_sds::{MemoryDirectory, MtsId, Registration};
    use fipa_transport::counts::Counts;
    use fipa_transport::{Kind, PeerId};

    use super::*;
    use crate::Config;

    const ARM: Incarnation = Incarnation::from_u64(7);
    const PROCESS: Incarnation = Incarnation::from_u64(8);

    fn message(act: Performative, protocol: &str, id: Option<&str>) -> Message {
        let agent = |name| AgentId::new(name).unwrap();
        let message = Message::builder(act).sender(agent("arm"));
        let message = message.receiver(agent("rover")).protocol(protocol);
        match id {
            Some(id) => message.conversation_id(id),
            None => message,
        }
        .build()
        .unwrap()
    }

    fn received(message: &Message, sender: Incarnation, via: Option<Kind>) -> Received {
        received_at(SystemTime::UNIX_EPOCH, message, sender, via)
    }

    /// A letter with this time of its sending.
    fn received_at(
        sent: SystemTime,
        message: &Message,
        sender: Incarnation,
        via: Option<Kind>,
    ) -> Received {
        Received {
            letter: letter_for(message, sent).unwrap(),
            sender,
            via,
            service: PROCESS,
            peer: PeerId::THIS_HOST,
            remote: false,
        }
    }

    fn directory() -> MemoryDirectory {
        MemoryDirectory::new(MtsId::new("here", PROCESS))
    }

    /// Returns the kind of violation that an enforcing agent finds in a message from this sender.
    fn kind(message: Message, sender: Incarnation, answered: &mut u32) -> Option<ViolationKind> {
        let mut config = Config::for_host("here");
        (config.monitor.check, config.monitor.answer) = (Check::Enforce, true);
        let rules = Rules::load(&config.monitor).unwrap();
        let directory = directory();
        let checks = rules.checks(
            "rover",
            "c-".to_owned(),
            &directory,
            Arc::new(Counts::default()),
        );
        let received = received(&message, sender, Some(Kind::Tcp));
        let origin = Origin::of(&received);
        let incoming = Incoming::new(received).unwrap();
        let checked = checks.arrived(incoming, origin, &directory, |_, _| {
            *answered += 1;
            None
        });
        checked.violation().map(|violation| violation.kind)
    }

    #[test]
    fn legacy_peers_are_only_warned_by_the_rules_about_unknown_conversations() {
        let legacy = Incarnation::UNKNOWN;
        let request = || message(Performative::Request, "fipa-request", None);
        let mut answered = 0;
        assert_eq!(kind(request(), legacy, &mut answered), None);
        let misspelled = message(Performative::Request, "fipa-reqest", Some("c"));
        assert_eq!(kind(misspelled, legacy, &mut answered), None);
        let own_id = message(Performative::Inform, "fipa-request", Some("c-1"));
        assert_eq!(kind(own_id, legacy, &mut answered), None);
        assert_eq!(answered, 0);
        // The rules of the protocols hold for them.
        let impossible = message(Performative::Subscribe, "fipa-request", Some("c"));
        let found = kind(impossible, legacy, &mut answered);
        assert_eq!(found, Some(ViolationKind::NotOpened));
        let found = kind(request(), ARM, &mut answered);
        assert_eq!(found, Some(ViolationKind::NoConversation));
        assert_eq!(answered, 2);
    }

    /// The clock of the caller is an hour behind, or ahead. The proposal comes in time.
    #[test]
    fn a_call_needs_no_common_clock() {
        let hour = Duration::from_secs(3600);
        let here = SystemTime::now();
        for caller in [here - hour, here, here + hour] {
            let mut config = Config::for_host("here");
            config.monitor.check = Check::Enforce;
            let rules = Rules::load(&config.monitor).unwrap();
            let directory = directory();
            let checks = rules.checks(
                "rover",
                "c-".to_owned(),
                &directory,
                Arc::new(Counts::default()),
            );
            let arrived = |message: &Message| {
                let received = received_at(caller, message, ARM, Some(Kind::Tcp));
                let origin = Origin::of(&received);
                let incoming = Incoming::new(received).unwrap();
                let checked = checks.arrived(incoming, origin, &directory, |_, _| None);
                checked.violation().map(|violation| violation.kind)
            };
            let by = Time::from_system_time(caller + Duration::from_secs(60)).unwrap();
            let part = |act, from: &str, to: &str| {
                let agent = |name: &str| AgentId::new(name).unwrap();
                let message = Message::builder(act).sender(agent(from));
                let message = message.receiver(agent(to)).protocol("fipa-contract-net");
                message.conversation_id("c")
            };
            let call = part(Performative::Cfp, "arm", "rover").reply_by(by);
            assert_eq!(arrived(&call.build().unwrap()), None);
            let bid = part(Performative::Propose, "rover", "arm");
            checks
                .check_outgoing(&bid.build().unwrap(), &directory)
                .unwrap();
            let award = part(Performative::AcceptProposal, "arm", "rover");
            assert_eq!(arrived(&award.build().unwrap()), None);
        }
    }

    #[test]
    fn a_conversation_is_charged_to_a_process_of_this_host_or_to_another_host() {
        let message = message(Performative::Request, "fipa-request", Some("c"));
        let registration = Registration::new("leg", ARM, Vec::new());
        let here = directory().register(registration).unwrap();
        let mut there = (*here).clone();
        there.reach = Reach::Remote { gateway: PROCESS };
        there.peer = PeerId::of_ip([192, 0, 2, 1].into());
        let origin = Origin::of(&received(&message, ARM, Some(Kind::Shm)));
        assert_eq!(origin.peer(Some(&there)).as_deref(), Some("192.0.2.1"));
        assert_eq!(origin.peer(Some(&here)), Some(PROCESS.to_string()));
        let unknown = Origin::of(&received(&message, Incarnation::UNKNOWN, Some(Kind::Tcp)));
        assert_eq!(unknown.peer(None), Some(PROCESS.to_string()));
        let own = Origin::of(&received(&message, Incarnation::UNKNOWN, None));
        assert_eq!(own.peer(None), None);
    }
}
