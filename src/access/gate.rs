//! The access gate of a process: checks arriving letters against the rules of `[access]`.
//!
//! The gateway checks the letters that come from other hosts or go there. Every other process
//! checks the letters to its own agents, because it must not rely on the checks of other processes.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use fipa_acl::{EnvelopeView, Letter, MessageView};
use fipa_mts::{AccessGate, LetterParts, LetterSource, Link};
use fipa_sds::{Directory, Entry, HostDirectory, Role as EntryRole};
use fipa_transport::{DomainUsers, log_limit};
use parking_lot::Mutex;

use crate::access::rules::{Access, LetterFacts, Refusal};

/// Log target of the lines about refused letters.
const AUDIT: &str = "fipa::audit";

/// Checks every arriving letter against the rules, which can be replaced. Without rules it is inactive.
pub(crate) struct RulesGate {
    access: Mutex<Access>,
    of: Of,
    host: Arc<HostDirectory>,
    /// The user of this process.
    this_user: u32,
    is_active: AtomicBool,
    /// Whether a rule names an action, so that contents are read.
    #[cfg(feature = "actions")]
    names_actions: AtomicBool,
}

/// The owner of a gate.
pub(crate) enum Of {
    /// The gateway with this name. Every sender may send letters to the gateway itself, because
    /// gateways and their agents communicate this way.
    Gateway(Arc<str>),
    /// Another process. The gateway of the host is identified by its link. It may send its own letters to every agent,
    /// because they are answers only. The letters that it forwards are not counted again, because it has counted them.
    Process,
}

impl RulesGate {
    /// Creates a gate without rules.
    pub(crate) fn new(of: Of, host: Arc<HostDirectory>) -> Self {
        Self {
            access: Mutex::default(),
            is_active: AtomicBool::new(is_shared(&host)),
            of,
            host,
            this_user: rustix::process::geteuid().as_raw(),
            #[cfg(feature = "actions")]
            names_actions: AtomicBool::new(false),
        }
    }

    /// Replaces the rules. The rates of senders are counted from the beginning.
    pub(crate) fn set_rules(&self, rules: Option<Access>) {
        let is_active = rules.is_some() || is_shared(&self.host);
        let rules = rules.unwrap_or_default();
        // A letter that was read before has no action, so it is judged like one that is no goal.
        #[cfg(feature = "actions")]
        self.names_actions
            .store(rules.names_actions(), Ordering::Release);
        *self.access.lock() = rules;
        self.is_active.store(is_active, Ordering::Release);
    }

    /// Whether the agent with this name is an operator of robots (`access.operators`).
    #[cfg(feature = "actions")]
    pub(crate) fn is_operator(&self, agent: &str) -> bool {
        self.access.lock().is_operator(agent)
    }

    /// Whether the agent with this name may record on this host (`access.recorders`).
    pub(crate) fn is_recorder(&self, agent: &str) -> bool {
        self.access.lock().is_recorder(agent)
    }

    /// Reads the parts of a message with this sender in its envelope.
    fn parts_of(&self, message: &MessageView<'_>, sender: String) -> LetterParts {
        let signed = message.sender().map(|it| it.name());
        let other = signed.filter(|signed| signed.as_str() != sender);
        let fault = other
            .map(|signed| format!("its envelope names the sender {sender}, its message {signed}"));
        LetterParts {
            performative: message.performative_name().as_str().into_owned(),
            protocol: message.protocol().map(|it| it.as_str().into_owned()),
            ontology: message.ontology().map(|it| it.as_str().into_owned()),
            action: self.action(message),
            is_stamped: false,
            fault,
            sender,
        }
    }

    /// Checks a letter to this receiver.
    fn judge(
        &self,
        now: Instant,
        receiver: &str,
        letter: &LetterParts,
        link: Link,
    ) -> Result<(), Refused> {
        if let Some(fault) = &letter.fault {
            return Err(Refused::Other(fault.clone()));
        }
        let sender = &*letter.sender;
        let facts = LetterFacts {
            sender,
            user: self.user_at(link),
            receiver,
            performative: &letter.performative,
            protocol: letter.protocol.as_deref(),
            ontology: letter.ontology.as_deref(),
            action: letter.action.as_deref(),
        };
        let judge = |gateway: Option<Arc<Entry>>| match gateway {
            // The gateway has forwarded this letter: it has stamped and counted it.
            Some(_) if letter.is_stamped => self.access.lock().judge(&facts),
            Some(gateway) if *gateway.name == *sender => Ok(()),
            _ => {
                let mut access = self.access.lock();
                access
                    .judge(&facts)
                    .and_then(|()| access.count(link.source, sender, now))
            }
        };
        let gateway = self.gateway_on(link);
        let is_known = gateway.is_some();
        judge(gateway).or_else(|refusal| {
            // The gateway may have registered a moment ago. The directory is refreshed only for
            // letters that would be refused.
            match self.refreshed_gateway_on(link).filter(|_| !is_known) {
                Some(gateway) => Ok(judge(Some(gateway))?),
                None => Err(refusal.into()),
            }
        })
    }

    /// Returns the action of a goal for a robot, if a rule names actions. The content is read as the
    /// robot reads it, so that no other notation evades a rule.
    #[cfg(feature = "actions")]
    fn action(&self, message: &MessageView<'_>) -> Option<String> {
        if !self.names_actions.load(Ordering::Acquire) {
            return None;
        }
        let content = message.content();
        let content = content.filter(|content| content.len() <= fipa_actions::MAX_CONTENT)?;
        let language = message.language();
        let language = language.as_ref().map(|text| text.as_str());
        match fipa_actions::language(language.as_deref())?.read_ask(&content) {
            Ok((_, fipa_actions::Ask::Goal(goal))) => Some(goal.action),
            _ => None,
        }
    }

    #[cfg(not(feature = "actions"))]
    fn action(&self, _message: &MessageView<'_>) -> Option<String> {
        None
    }

    /// Returns the entry of the gateway of this host if the directory shows the gateway at the
    /// other end of this link. The link must be within the host: only there does the kernel prove
    /// that the other end is a process of a user of this domain.
    fn gateway_on(&self, link: Link) -> Option<Arc<Entry>> {
        if !matches!(self.of, Of::Process) || !link.via.is_host_local() {
            return None;
        }
        let entry = self.host.known_incarnation(link.service)?;
        let is_gateway = entry.role == EntryRole::Gateway;
        // The service at the other end of a link only claims its incarnation, also to other users.
        let is_proved =
            !is_shared(&self.host) || self.host.user_of(&entry.name) == self.user_at(link);
        (is_gateway && is_proved).then_some(entry)
    }

    /// Returns the user of the process at the other end of a link within this host.
    fn user_at(&self, link: Link) -> Option<u32> {
        let is_process = matches!(link.source, LetterSource::Process(_));
        (link.via.is_host_local() && is_process).then(|| link.user.unwrap_or(self.this_user))
    }

    /// Checks that a process of this host sends no letter in the name of an agent of another user. A gateway is no
    /// exception: any process of the domain can register as one, and it passes on letters of other hosts only.
    fn check_user(&self, sender: &str, link: Link) -> Result<(), Refused> {
        let Some(user) = self.user_at(link).filter(|_| is_shared(&self.host)) else {
            return Ok(());
        };
        let other = || self.host.user_of(sender).filter(|owner| *owner != user);
        if other().is_none() {
            return Ok(());
        }
        // The agent may have moved to a process of this user a moment ago.
        self.host.refresh();
        match other() {
            None => Ok(()),
            Some(owner) => Err(Refused::Other(format!(
                "{sender} is an agent of user {owner}, but a process of user {user} has sent the letter"
            ))),
        }
    }

    /// Like [`gateway_on`](Self::gateway_on), after a refresh of the directory.
    fn refreshed_gateway_on(&self, link: Link) -> Option<Arc<Entry>> {
        if matches!(self.of, Of::Process) && link.via.is_host_local() {
            self.host.refresh();
        }
        self.gateway_on(link)
    }
}

/// Whether the domain has several users.
fn is_shared(host: &HostDirectory) -> bool {
    host.users() != DomainUsers::This
}

/// The reason why a letter is refused.
#[derive(Debug, thiserror::Error)]
enum Refused {
    #[error(transparent)]
    ByRule(#[from] Refusal),
    #[error("{0}")]
    Other(String),
}

impl AccessGate for RulesGate {
    fn is_active(&self) -> bool {
        self.is_active.load(Ordering::Acquire)
    }

    fn read(&self, letter: &Letter) -> LetterParts {
        let envelope = letter.envelope();
        let view = EnvelopeView::parse(&envelope).ok();
        let sender = view.as_ref().and_then(EnvelopeView::from_name);
        let (Some(view), Some(sender)) = (&view, sender) else {
            return LetterParts {
                fault: Some("its envelope names no sender".to_owned()),
                ..LetterParts::default()
            };
        };
        let sender = sender.as_str().into_owned();
        match MessageView::parse_payload(letter.payload()) {
            Ok(message) => LetterParts {
                is_stamped: view.stamps().next().is_some(),
                ..self.parts_of(&message, sender)
            },
            Err(error) => LetterParts {
                fault: Some(format!("its message cannot be decoded: {error}")),
                sender,
                ..LetterParts::default()
            },
        }
    }

    fn admits(
        &self,
        now: Instant,
        receiver: &str,
        letter: &LetterParts,
        link: Link,
    ) -> Result<(), String> {
        let judged = self
            .check_user(&letter.sender, link)
            .and_then(|()| match &self.of {
                Of::Gateway(own) if receiver == &**own => Ok(()),
                _ => self.judge(now, receiver, letter, link),
            });
        judged.map_err(|why| {
            let sender = &*letter.sender;
            log_limit::warn!(target: AUDIT, of: link.source, sender, receiver, "letter refused: {why}");
            why.to_string()
        })
    }
}

#[cfg(test)]
mod tests {
    use fipa_acl::{
        AclRepresentation, AgentId, Envelope, EnvelopeParams, Message, Performative, Received, Time,
    };
    use fipa_mts::LetterSource;
    use fipa_sds::{HostConfig, MtsId, Registration};
    use fipa_transport::{Incarnation, Kind};

    use super::*;
    use crate::config;

    /// Creates a letter to `arm`. Its envelope names `sender` and its message names `signed` as the
    /// sender. If `is_stamped`, it has the stamp of a gateway.
    fn letter(sender: &str, signed: &str, is_stamped: bool) -> Letter {
        let [arm, sender, signed] = ["arm", sender, signed].map(|name| AgentId::new(name).unwrap());
        let date: Time = "20261121T120000000Z".parse().unwrap();
        let base = EnvelopeParams {
            to: vec![arm.clone()],
            from: Some(sender),
            acl_representation: Some(AclRepresentation::BitEfficient),
            date: Some(date),
            ..EnvelopeParams::default()
        };
        let stamp = EnvelopeParams {
            received: Some(Received::new("mts", date)),
            ..EnvelopeParams::default()
        };
        let extensions = is_stamped.then_some(stamp).into_iter().collect();
        let envelope = Envelope { base, extensions };
        let message = Message::builder(Performative::Inform).sender(signed);
        let message = message.receiver(arm).build().unwrap();
        Letter::new(envelope.encode_standard().unwrap(), message.to_payload())
    }

    /// Returns the gate of a process, the directory of the gateway of its host, and the temporary
    /// directory of both. The gate accepts one letter per second from each sender, and none from
    /// the denied senders.
    fn gate(denied: &[&str]) -> (RulesGate, HostDirectory, tempfile::TempDir) {
        gate_for(DomainUsers::This, denied)
    }

    fn gate_for(
        users: DomainUsers,
        denied: &[&str],
    ) -> (RulesGate, HostDirectory, tempfile::TempDir) {
        let place = tempfile::tempdir().unwrap();
        let open = |gateway| {
            let directory = HostDirectory::open(HostConfig {
                brief: false,
                users,
                dir: place.path().join("domain"),
                mts: MtsId::new("mts", Incarnation::random()),
                gateway,
            });
            directory.unwrap()
        };
        let deny = denied.iter().map(|sender| config::AccessRule {
            sender: (*sender).to_owned(),
            receivers: vec![".*".to_owned()],
        });
        let rules = config::Access {
            rate: 1,
            deny: deny.collect(),
            ..config::Access::default()
        };
        let access = rules.rules().unwrap().unwrap();
        let gate = RulesGate::new(Of::Process, Arc::new(open(false)));
        assert_eq!(gate.is_active(), users != DomainUsers::This);
        gate.set_rules(Some(access));
        assert!(gate.is_active());
        (gate, open(true), place)
    }

    const GATEWAY: Incarnation = Incarnation::from_u64(0x6a7e);

    /// Returns the source of the letters of a service on this host.
    fn source_by(via: Kind, service: Incarnation) -> LetterSource {
        match via.is_host_local() {
            true => LetterSource::Process(service),
            false => LetterSource::at(std::net::Ipv4Addr::LOCALHOST.into()),
        }
    }

    /// Creates a link with the gateway.
    fn gateway_by(via: Kind) -> Link {
        Link {
            via,
            service: GATEWAY,
            user: None,
            source: source_by(via, GATEWAY),
        }
    }

    /// Creates a link with a process that is not the gateway.
    fn process_by(via: Kind) -> Link {
        let service = Incarnation::from_u64(0x9);
        Link {
            via,
            service,
            user: None,
            source: source_by(via, service),
        }
    }

    /// Registers the gateway, and refreshes the directory of the process with this gate.
    fn register(gateway: &HostDirectory, gate: &RulesGate) {
        let at = "shm://0000000000006a7e#0000000000006a7e".parse().unwrap();
        let registration = Registration {
            role: EntryRole::Gateway,
            ..Registration::new("mts", GATEWAY, vec![at])
        };
        gateway.register(registration).unwrap();
        gate.host.refresh();
    }

    fn admits(gate: &RulesGate, now: Instant, letter: &Letter, link: Link) -> Result<(), String> {
        gate.admits(now, "arm", &gate.read(letter), link)
    }

    #[tokio::test]
    async fn what_the_gateway_has_counted_is_not_counted_again() {
        let (gate, gateway, _place) = gate(&[]);
        register(&gateway, &gate);
        let now = Instant::now();
        let taken = |is_stamped, link| {
            let letter = letter("rover", "rover", is_stamped);
            admits(&gate, now, &letter, link).is_ok()
        };
        let link = gateway_by(Kind::Unix);
        // Delayed letters may arrive closer together than they were sent.
        assert!(taken(true, link) && taken(true, link) && taken(true, link));
        assert!(taken(false, link));
        assert!(!taken(false, link), "one a second");
    }

    #[tokio::test]
    async fn a_stamp_evades_the_rate_on_no_link_but_the_gateways() {
        for link in [
            process_by(Kind::Shm),
            process_by(Kind::Unix),
            // Over TCP the incarnation is only a claim of the peer.
            gateway_by(Kind::Tcp),
        ] {
            let (gate, gateway, _place) = gate(&[]);
            register(&gateway, &gate);
            let now = Instant::now();
            let stamped = letter("rover", "rover", true);
            assert!(admits(&gate, now, &stamped, link).is_ok());
            assert!(admits(&gate, now, &stamped, link).is_err(), "{link:?}");
        }
    }

    #[tokio::test]
    async fn envelope_and_message_name_one_sender() {
        let (gate, _gateway, _place) = gate(&[]);
        let letter = letter("rover", "crex", false);
        let judged = admits(&gate, Instant::now(), &letter, process_by(Kind::Shm));
        let refusal = judged.unwrap_err();
        assert!(
            refusal.contains("rover") && refusal.contains("crex"),
            "{refusal}"
        );
    }

    #[tokio::test]
    async fn the_gateway_of_the_host_is_taken_by_its_link_and_nothing_else_by_its_name() {
        let (gate, gateway, _place) = gate(&["mts", "rover"]);
        register(&gateway, &gate);
        let taken = |sender, is_passed_on, link| {
            let letter = letter(sender, sender, is_passed_on);
            admits(&gate, Instant::now(), &letter, link).is_ok()
        };
        for local in [Kind::Shm, Kind::Unix] {
            assert!(taken("mts", false, gateway_by(local)));
            assert!(!taken("mts", true, gateway_by(local)), "from another host");
            assert!(!taken("rover", false, gateway_by(local)));
            assert!(!taken("mts", false, process_by(local)), "by its name");
        }
        assert!(!taken("mts", false, gateway_by(Kind::Tcp)), "unproved");
    }

    #[tokio::test]
    async fn a_process_of_another_user_sends_no_letter_in_the_name_of_an_agent_of_this_user() {
        let group = DomainUsers::Group(rustix::process::getegid().as_raw());
        let (gate, other, _place) = gate_for(group, &[]);
        let at = "unix://0000000000000009#0000000000000009".parse().unwrap();
        let rover = Registration::new("rover", Incarnation::from_u64(0x7), vec![at]);
        other.register(rover).unwrap();
        gate.host.refresh();
        let by_user = |user, via| Link {
            user,
            ..process_by(via)
        };
        let sent = |sender: &str, link| {
            admits(&gate, Instant::now(), &letter(sender, sender, false), link)
        };
        let another = rustix::process::geteuid().as_raw().wrapping_add(1);
        let refusal = sent("rover", by_user(Some(another), Kind::Unix)).unwrap_err();
        assert!(
            refusal.starts_with("rover is an agent of user "),
            "{refusal}"
        );
        sent("rover", by_user(None, Kind::Unix)).unwrap();
        sent("crex", by_user(Some(another), Kind::Unix)).unwrap();
        // Another user cannot claim to be the gateway of this user.
        register(&other, &gate);
        let gateway = gateway_by(Kind::Unix);
        assert!(gate.gateway_on(gateway).is_some());
        let claimed = Link {
            user: Some(another),
            ..gateway
        };
        assert!(gate.gateway_on(claimed).is_none());
        sent("rover", claimed).unwrap_err();
    }
}
