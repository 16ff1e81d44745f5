//! The platform agents of the gateway: the agent management system and the directory facilitator
//! (FIPA00023). This module is the I/O around [`fipa_platform`].
//!
//! Each of the two is an agent of this host with a name, a queue and a directory entry of its own. The
//! descriptions in the directory facilitators of gateways travel with the exchange of their directories.

use std::collections::{HashSet, VecDeque};
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_acl::{AgentId, ErrorChain, Message, escape_name};
use fipa_content::SlDialect;
use fipa_mts::core::{Received, Submission};
use fipa_mts::dial::Endpoint;
use fipa_mts::{Sending, letter_for};
use fipa_platform::{
    AddressBook, Ams, ApDescription, Asker, Df, LocalEntry, Platform, PlatformAnswer, PlatformTime,
    RemoteEntry, Resident, SubscriptionId, limits,
};
use fipa_sds::{
    DfEntry, Directory, Entry, Exchange, MergedDirectory, OwnDfEntry, Reach, RegisterError,
    Registration, Role, second_name,
};
use fipa_transport::{Incarnation, Location, Principal, log_limit};
use tokio::task::{JoinHandle, JoinSet};

use super::early_letters::{Early, EarlyLetters};
use super::exchange::Exchanging;
use super::names::other_claim;
use super::neighbors::Neighbors;
use super::state::{Predecessor, StateFile};
use crate::config;
use crate::domain::service::Service;

/// Deadline for the delivery of an answer.
const ANSWER_DEADLINE: Duration = Duration::from_secs(5);

/// Time for which an agent of another host must have the name before this one gets a second name. The
/// updates of a directory may arrive in the wrong order.
const CONTESTED: Duration = Duration::from_secs(1);

/// Minimum time between two copies of the state for a successor, which take time in proportion to the
/// number of descriptions.
const KEEP_PAUSE: Duration = Duration::from_millis(50);

// The exchange carries what the directory facilitator accepts.
const _: () = assert!(Exchange::MAX_DF_ENTRY == limits::REMOTE_BYTES);
const _: () = assert!(Exchange::MAX_TOTAL_DF_ENTRIES == limits::REMOTE_DESCRIPTIONS);
const _: () = assert!(Exchange::MAX_DF_LEASE.as_secs() == limits::LEASE.as_secs());

/// The parts of the gateway that the platform agents use.
#[derive(Clone)]
pub(super) struct PlatformAgents {
    pub(super) service: Arc<Service>,
    pub(super) neighbors: Arc<Neighbors>,
    pub(super) view: Arc<dyn Directory>,
    /// The agents of other hosts.
    pub(super) known: Arc<MergedDirectory>,
    pub(super) exchange: Arc<Exchanging>,
    /// Whether `security.keys` is set.
    pub(super) has_keys: bool,
    /// The state that the agents keep for their successors.
    pub(super) state: Arc<StateFile>,
    /// The state that the last gateway of this domain kept.
    pub(super) predecessor: Arc<Predecessor>,
}

impl PlatformAgents {
    /// Registers the agents that the configuration turns on, and starts their tasks. An agent that
    /// cannot register is logged; letters do not depend on it.
    pub(super) fn start(self, config: &config::Platform) -> Vec<JoinHandle<()>> {
        let agents = [
            (Kind::Ams, "ams", &config.ams),
            (Kind::Df, "df", &config.df),
        ];
        let started = agents.into_iter().filter_map(|(kind, prefix, agent)| {
            let name = match agent {
                config::PlatformAgent::Off => return None,
                config::PlatformAgent::On => format!("{prefix}@{}", self.service.name),
                config::PlatformAgent::Named(name) => name.clone(),
            };
            let task = Task::register(self.clone(), kind, name)?;
            Some(tokio::spawn(task.run()))
        });
        started.collect()
    }

    /// Describes the agent that sent a letter, as far as its connection proves it. Returns `None` if no
    /// answer can reach it.
    fn asker(&self, message: &Message, received: &Received) -> Option<Asker> {
        let claimed = message.sender()?;
        let holder = self.view.lookup(claimed.name());
        let (entry, is_proved) = if received.sender.is_known() {
            let (sender, peer) = (received.sender, &received.peer);
            let entry = self.view.sender(sender, claimed.name(), peer)?;
            let is_holder = holder.is_some_and(|it| it.incarnation == entry.incarnation);
            let is_proved = is_holder && *entry.name == *claimed.name();
            (entry, is_proved)
        } else {
            // An agent of a legacy peer, which has no registration. Answers go to its name only if no
            // agent with a registration has the name.
            let entry = holder.filter(|it| !it.incarnation.is_known())?;
            (entry, true)
        };
        let id = match *claimed.name() == *entry.name {
            true => claimed.clone(),
            false => AgentId::new(&*entry.name).ok()?,
        };
        let mut asker = Asker::new(
            id,
            received.sender.as_u64(),
            self.platform(&entry, received),
        );
        asker.is_proved = is_proved;
        let is_jade = |location: &Location| location.signature().is_jade();
        if entry.locations.iter().any(is_jade) {
            asker.dialect = SlDialect::Jade;
        }
        Some(asker)
    }

    /// Returns the platform of an agent. A gateway of this host in another domain counts as another
    /// host.
    fn platform(&self, entry: &Entry, received: &Received) -> Platform {
        if entry.reach == Reach::Local && !received.remote {
            return Platform::Host;
        }
        match self.neighbors.principal(received.service) {
            Some(Principal::Certificate(fingerprint)) => Platform::Proved(fingerprint),
            _ => Platform::Unproved,
        }
    }

    /// Returns the agents of this host, sorted by name.
    fn residents(&self) -> Vec<Resident> {
        let entries = self.service.host.entries();
        let agents = entries
            .iter()
            .filter(|it| it.reach == Reach::Local && it.role == Role::Agent);
        agents
            .map(|entry| Resident {
                name: Arc::clone(&entry.name),
                registration: entry.incarnation.as_u64(),
            })
            .collect()
    }

    /// Describes the platform: the gateway, and its addresses on the network.
    fn description(&self) -> ApDescription {
        let mut services: Vec<(String, Vec<String>)> = Vec::new();
        for location in self.service.shown_locations() {
            let kind = location.kind();
            if kind.is_host_local() {
                continue;
            }
            let address = address_text(&location);
            match services.iter_mut().find(|(name, _)| name == kind.name()) {
                Some((_, addresses)) => addresses.push(address),
                None => services.push((kind.name().to_owned(), vec![address])),
            }
        }
        ApDescription {
            name: self.service.name.to_string(),
            services,
        }
    }

    /// Returns the addresses under which agents of legacy platforms reach the agents of this host.
    fn address_book(&self) -> AddressBook {
        let (service, view) = (Arc::clone(&self.service), Arc::clone(&self.view));
        Arc::new(move |asker| {
            let entry = view.lookup(asker.name());
            let entry = entry.filter(|it| !it.incarnation.is_known());
            let first = entry.and_then(|it| it.locations.first().cloned());
            first.map_or_else(Vec::new, |it| reached_at(&service.shown_locations(), &it))
        })
    }

    /// Returns the entries of the directory facilitators of other gateways. An entry counts only while
    /// the directory shows its agent, at the gateway that sent the entry.
    fn remote_entries(&self) -> Vec<RemoteEntry> {
        let holder = |entry: &DfEntry| {
            let is_here = |own: Arc<Entry>| own.reach == Reach::Local;
            let is_local = self.service.host.known(&entry.name).is_some_and(is_here);
            let holder = self.known.known(&entry.name).filter(|_| !is_local)?;
            let is_listed =
                holder.incarnation == entry.incarnation && holder.mts.incarnation == entry.gateway;
            is_listed.then_some(holder)
        };
        let entries = self.exchange.directory().df_entries().into_iter();
        let remote = entries.filter_map(|entry| {
            let holder = holder(&entry)?;
            Some(RemoteEntry {
                name: Arc::clone(&entry.name),
                source: match entry.principal {
                    Principal::Certificate([a, b, c, d, e, f, g, h, ..]) => {
                        u64::from_le_bytes([a, b, c, d, e, f, g, h])
                    }
                    _ => entry.gateway.as_u64(),
                },
                text: Arc::clone(&entry.text),
                addresses: at_hosts_of(&holder.locations, &entry.addresses),
                ends: entry.ends,
                has_lease: entry.has_lease,
            })
        });
        remote.collect()
    }

    /// Returns the addresses at which agents of other platforms reach the agents of this host.
    fn addresses(&self) -> Vec<String> {
        let all = self.service.shown_locations().into_iter();
        let http = all.filter(|it| it.kind().is_http());
        let addresses = http.map(|it| address_text(&it));
        let fitting = addresses.filter(|it| it.len() <= Exchange::MAX_DF_ADDRESS);
        fitting.take(Exchange::MAX_DF_ADDRESSES).collect()
    }

    /// Sends the entries of the directory facilitator to other gateways. Returns the agents whose
    /// entries stay here.
    fn send_df(&self, local: Vec<LocalEntry>) -> HashSet<(Arc<str>, u64)> {
        let all: Vec<(Arc<str>, u64)> = local
            .iter()
            .map(|entry| (Arc::clone(&entry.name), entry.registration))
            .collect();
        let mut staying: HashSet<Arc<str>> = local
            .iter()
            .filter(|entry| entry.text.is_none())
            .map(|entry| Arc::clone(&entry.name))
            .collect();
        let addresses = self.addresses();
        let entries = local.into_iter().filter_map(|entry| {
            Some(OwnDfEntry {
                name: entry.name,
                incarnation: Incarnation::from_u64(entry.registration),
                text: entry.text?,
                addresses: addresses.clone(),
                lease: entry.lease,
            })
        });
        staying.extend(self.exchange.send_df(entries.collect()));
        let all = all.into_iter();
        all.filter(|(name, _)| staying.contains(name)).collect()
    }

    /// Sends a message of an agent of this gateway.
    fn send(&self, from: Incarnation, answer: &PlatformAnswer) -> Option<Sending> {
        let letter = letter_for(&answer.message, SystemTime::now());
        let letter = letter
            .inspect_err(|error| log_limit::warn!(error = %ErrorChain(error), "cannot encode a letter of the gateway"))
            .ok()?;
        let mut submission = Submission {
            sender: from,
            letter,
            receivers: Vec::new(),
            deadline: ANSWER_DEADLINE,
        };
        let registration = Incarnation::from_u64(answer.registration);
        if !registration.is_known() {
            submission.receivers = vec![Arc::clone(&answer.to)];
            return Some(self.service.mts.submit(submission));
        }
        let Some(to) = self.view.registered_as(registration, &answer.to) else {
            log_limit::info!("dropping a reply: its requester is no longer registered");
            return None;
        };
        Some(self.service.mts.submit_to(submission, &to))
    }
}

/// The two agents.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Ams,
    Df,
}

impl Kind {
    fn agent_type(self) -> &'static str {
        match self {
            Self::Ams => Entry::AMS_TYPE,
            Self::Df => Entry::DF_TYPE,
        }
    }

    fn description(self) -> &'static str {
        match self {
            Self::Ams => "agent management system",
            Self::Df => "directory facilitator",
        }
    }
}

enum Core {
    Ams(Ams),
    Df(Df),
}

/// A registration of one of the agents, with a queue of its own.
struct Registered {
    id: AgentId,
    incarnation: Incarnation,
}

impl Registered {
    fn name(&self) -> &str {
        self.id.name()
    }
}

/// The registration by which other hosts reach the agent when they know another agent by its name.
enum SecondName {
    /// There was no need for one.
    None,
    Registered(Registered),
    /// The directory of this host refused it.
    Refused,
}

/// One of the agents, while the gateway runs.
struct Task {
    means: PlatformAgents,
    kind: Kind,
    core: Core,
    own: Registered,
    second: SecondName,
    /// Since when an agent of another host has the name.
    contested: Option<Instant>,
    /// The notifications under way.
    sent: JoinSet<(SubscriptionId, bool)>,
    /// The agents that are too many or too large for the directory facilitators of other hosts.
    staying: HashSet<(Arc<str>, u64)>,
    /// Time of the last and of the next reading of the entries of other gateways.
    remote_read: Option<Instant>,
    remote_due: Option<Instant>,
    /// The revision of the core that was kept last, and when.
    last_stored: Option<(u64, Instant)>,
    /// The letters whose senders are not in the directory yet.
    early: EarlyLetters,
}

impl Task {
    /// Registers the agent in the directory of this host.
    fn register(means: PlatformAgents, kind: Kind, configured: String) -> Option<Self> {
        let own = enter(&means, kind, configured.into())?;
        let id = own.id.clone();
        let core = match kind {
            Kind::Ams => {
                let ams = Ams::new(id, means.description());
                Core::Ams(ams.with_addresses(means.address_book()))
            }
            Kind::Df => Core::Df(Df::new(id).with_addresses(means.address_book())),
        };
        let mut task = Self {
            means,
            kind,
            core,
            own,
            second: SecondName::None,
            contested: None,
            sent: JoinSet::new(),
            staying: HashSet::new(),
            remote_read: None,
            remote_due: None,
            last_stored: None,
            early: EarlyLetters::default(),
        };
        task.take_over();
        Some(task)
    }

    /// Takes over what the last gateway kept. The descriptions of agents that have ended since end.
    fn take_over(&mut self) {
        let means = &self.means;
        let from = &*means.predecessor;
        let now = now();
        let stays = |platform| means.state.stays(from, platform);
        match &mut self.core {
            Core::Ams(ams) => {
                ams.take_over(
                    now.at,
                    from.elapsed,
                    &from.agents,
                    &means.residents(),
                    stays,
                );
            }
            Core::Df(df) => {
                let stored = (&from.descriptions[..], &from.subscriptions[..]);
                df.take_over(now, from.elapsed, stored, stays);
            }
        }
        self.handle_departures();
    }

    /// Keeps the state for a successor after a change, at most every [`KEEP_PAUSE`]. Returns the time at
    /// which to call this again.
    fn keep(&mut self) -> Option<Instant> {
        let revision = match &self.core {
            Core::Ams(ams) => ams.revision(),
            Core::Df(df) => df.revision(),
        };
        let now = Instant::now();
        if let Some((stored, at)) = self.last_stored {
            if stored == revision {
                return None;
            }
            if now < at + KEEP_PAUSE {
                return Some(at + KEEP_PAUSE);
            }
        }
        self.last_stored = Some((revision, now));
        let state = &self.means.state;
        match &self.core {
            Core::Ams(ams) => state.set_agents(now, ams.keep(now)),
            Core::Df(df) => state.set_services(now, df.keep(now)),
        }
        None
    }

    /// Reads and answers letters until the service ends.
    async fn run(mut self) {
        let service = Arc::clone(&self.means.service);
        let (mut local_changes, mut remote_changes) =
            (service.host.watch(), self.means.known.watch());
        let mut locations = service.follow_locations();
        let exchanged = self.means.exchange.directory();
        let is_df = self.kind == Kind::Df;
        loop {
            self.send_answers();
            self.send_df();
            let keep = self.keep();
            let contested = self.contested.map(|since| since + CONTESTED);
            let due = [self.poll_timeout(), contested, self.remote_due, keep];
            let due = due.into_iter().flatten().min();
            let due = due.map(tokio::time::Instant::from_std);
            let second = self.second().map(|second| second.incarnation);
            tokio::select! {
                received = service.mts.receive(self.own.incarnation) => match received {
                    Some(received) => self.handle(received, None),
                    None => return,
                },
                received = service.mts.receive(second.unwrap_or_default()), if second.is_some() => {
                    let Some(received) = received else {
                        return;
                    };
                    let asked = self.second().map(|second| second.id.clone());
                    self.handle(received, asked);
                }
                change = local_changes.next() => {
                    if change.is_none() {
                        return;
                    }
                    // Several pending changes are handled together.
                    while local_changes.try_next().is_some() {}
                    self.handle_departures();
                    self.handle_early();
                    self.schedule_remote();
                }
                change = remote_changes.next() => {
                    if change.is_none() {
                        return;
                    }
                    while remote_changes.try_next().is_some() {}
                    self.check_name();
                    self.handle_early();
                    self.schedule_remote();
                }
                () = exchanged.df_changed(), if is_df => self.schedule_remote(),
                moved = locations.changed() => {
                    if moved.is_err() {
                        return;
                    }
                    self.relocate();
                }
                Some(sent) = self.sent.join_next() => {
                    if let (Ok((id, is_delivered)), Core::Df(df)) = (sent, &mut self.core) {
                        df.handle_sent(Instant::now(), id, is_delivered);
                    }
                }
                () = tokio::time::sleep_until(due.unwrap_or_else(tokio::time::Instant::now)),
                    if due.is_some() =>
                {
                    self.handle_timeout();
                }
            }
        }
    }

    /// Handles a letter to the agent. `asked` is its second name, if the letter came to that.
    fn handle(&mut self, received: Received, asked: Option<AgentId>) {
        let name = asked.as_ref().map_or(self.own.name(), AgentId::name);
        let message = match Message::decode(received.letter.payload()) {
            Ok(message) => message,
            Err(error) => {
                log_limit::info!(error = %ErrorChain(&error), agent = name, "cannot decode a letter to an agent of the gateway");
                let mts = &self.means.service.mts;
                return mts.handle_undecodable(&name.into(), &received, &error);
            }
        };
        let now = now();
        let letter = Early::new(now.at, message, received, asked);
        let mut letters = self.early.take_of(&letter.author());
        letters.push_back(letter);
        self.answer_or_keep(now, letters);
    }

    /// Handles the letters whose senders may be in the directory now.
    fn handle_early(&mut self) {
        let letters = self.early.take();
        self.answer_or_keep(now(), letters);
    }

    /// Answers letters, or keeps them until their senders are in the directory.
    fn answer_or_keep(&mut self, now: PlatformTime, letters: VecDeque<Early>) {
        // The entry of a sender may arrive meanwhile: its later letters do not overtake one that is kept.
        let mut absent = HashSet::new();
        for letter in letters {
            let author = letter.author();
            let asker = match absent.contains(&author) {
                true => None,
                false => self.means.asker(&letter.message, &letter.received),
            };
            if let Some(asker) = asker {
                self.answer(now, asker, letter);
                continue;
            }
            absent.insert(author);
            if !self.early.keep(now.at, letter) {
                let agent = self.own.name();
                log_limit::info!(
                    agent,
                    "cannot answer a letter: its sender is not registered"
                );
            }
        }
    }

    fn answer(&mut self, now: PlatformTime, mut asker: Asker, letter: Early) {
        asker.asked = letter.asked;
        match &mut self.core {
            Core::Ams(ams) => {
                ams.handle_message(now, &asker, &letter.message, &self.means.residents());
            }
            Core::Df(df) => df.handle_message(now, &asker, &letter.message),
        }
    }

    fn handle_departures(&mut self) {
        let host = &self.means.service.host;
        if let Core::Df(df) = &mut self.core {
            df.handle_departures(Instant::now(), |name, registration| {
                let known = host.known_incarnation(Incarnation::from_u64(registration));
                known.is_some_and(|it| *it.name == *name && it.reach == Reach::Local)
            });
        }
    }

    fn poll_timeout(&self) -> Option<Instant> {
        let core = match &self.core {
            Core::Ams(ams) => ams.poll_timeout(),
            Core::Df(df) => df.poll_timeout(),
        };
        let early = self.early.poll_timeout();
        [core, early].into_iter().flatten().min()
    }

    fn handle_timeout(&mut self) {
        let now = Instant::now();
        match &mut self.core {
            Core::Ams(ams) => ams.handle_timeout(now),
            Core::Df(df) => df.handle_timeout(now),
        }
        if self.early.poll_timeout().is_some_and(|due| due <= now) {
            self.handle_early();
        }
        self.check_name();
        if self.remote_due.is_some_and(|due| due <= now) {
            self.read_remote();
        }
    }

    /// Reads the entries of other gateways soon, because they or their agents have changed.
    fn schedule_remote(&mut self) {
        if self.kind != Kind::Df {
            return;
        }
        let now = Instant::now();
        let earliest = self.remote_read.map(|last| last + limits::REMOTE_PAUSE);
        let due = earliest.map_or(now, |earliest| earliest.max(now));
        self.remote_due.get_or_insert(due);
    }

    fn read_remote(&mut self) {
        let now = now();
        (self.remote_read, self.remote_due) = (Some(now.at), None);
        if let Core::Df(df) = &mut self.core
            && df.handle_remote(now, &self.means.remote_entries())
        {
            self.remote_due = Some(now.at + limits::REMOTE_PAUSE);
        }
    }

    /// Sends the entries of agents of this host to other gateways after a change.
    fn send_df(&mut self) {
        let Core::Df(df) = &mut self.core else {
            return;
        };
        let Some(local) = df.poll_local() else {
            return;
        };
        let staying = self.means.send_df(local);
        for (agent, _) in staying.difference(&self.staying) {
            log_limit::warn!(
                agent = %escape_name(agent),
                "the services of an agent are not told to other hosts: at most {} descriptions of {} \
                 bytes and {} parts, and {} bytes together, travel; agents of other hosts find them \
                 with `fipa df search --df {}`",
                Exchange::MAX_DF_ENTRIES,
                Exchange::MAX_DF_ENTRY,
                limits::REMOTE_PARTS,
                Exchange::MAX_DF_BYTES,
                self.own.name()
            );
        }
        self.staying = staying;
    }

    fn send_answers(&mut self) {
        loop {
            let answer = match &mut self.core {
                Core::Ams(ams) => ams.poll_answer(),
                Core::Df(df) => df.poll_answer(),
            };
            let Some(answer) = answer else {
                return;
            };
            let sending = self.means.send(self.sender(&answer), &answer);
            let Some(id) = answer.notification else {
                // The outcome is not awaited: a requester that gets no answer asks again.
                continue;
            };
            self.sent.spawn(async move {
                let is_delivered = match sending {
                    Some(sending) => {
                        let outcomes = sending.outcomes().await;
                        outcomes.iter().all(|(_, outcome)| outcome.is_success())
                    }
                    None => false,
                };
                (id, is_delivered)
            });
        }
    }

    /// Updates the addresses of the agent after a change of the locations of the gateway.
    fn relocate(&mut self) {
        let means = &self.means;
        for one in [Some(&self.own), self.second()].into_iter().flatten() {
            if let Err(error) = entry(means, self.kind, one.name().into(), one.incarnation) {
                log_limit::warn!(error = %ErrorChain(&error), agent = one.name(), "cannot update an agent of the gateway");
            }
        }
        match &mut self.core {
            Core::Ams(ams) => ams.describe(means.description()),
            Core::Df(df) => df.handle_relocation(),
        }
    }

    /// Registers a second name when an agent of another host has had the name of this one for
    /// [`CONTESTED`]. The second name stays, because agents of other hosts use it from then on.
    fn check_name(&mut self) {
        if !matches!(self.second, SecondName::None) {
            self.contested = None;
            return;
        }
        let means = &self.means;
        let own = means.service.host.known(self.own.name());
        let own = own.filter(|own| own.incarnation == self.own.incarnation);
        let claim = own.and_then(|own| other_claim(&own, &*means.known, means.has_keys));
        let Some(claim) = claim else {
            self.contested = None;
            return;
        };
        let since = *self.contested.get_or_insert_with(Instant::now);
        if since.elapsed() < CONTESTED {
            return;
        }
        let name = second_name(self.own.name(), means.service.own.incarnation);
        self.second = match enter(means, self.kind, Arc::clone(&name)) {
            Some(second) => {
                log_limit::info!(
                    agent = self.own.name(), second = %name, other = %escape_name(claim.mts.shown()),
                    "an agent of the gateway has a second name for other hosts: an agent of another host \
                     has its name"
                );
                SecondName::Registered(second)
            }
            None => SecondName::Refused,
        };
    }

    fn second(&self) -> Option<&Registered> {
        match &self.second {
            SecondName::Registered(second) => Some(second),
            SecondName::None | SecondName::Refused => None,
        }
    }

    /// Returns the registration that sends an answer: that which was asked.
    fn sender(&self, answer: &PlatformAnswer) -> Incarnation {
        let second = self.second().filter(|second| {
            let sender = answer.message.sender();
            sender.is_some_and(|sender| sender.name() == second.name())
        });
        second.unwrap_or(&self.own).incarnation
    }
}

/// Returns the addresses of this gateway under which the platform at a location reaches it: those of the same kind, and
/// of them the one on the way to the platform, if there is one.
fn reached_at(own: &[Location], platform: &Location) -> Vec<String> {
    let same = own.iter().filter(|it| it.kind() == platform.kind());
    let same: Vec<(Option<IpAddr>, String)> = same
        .map(|location| (ip_of(location), address_text(location)))
        .collect();
    let way = match Endpoint::of(platform) {
        Some(Endpoint::Numeric(at)) => local_address_to(at),
        _ => None,
    };
    let on_way = same.iter().find(|(ip, _)| way.is_some() && *ip == way);
    match on_way {
        Some((_, address)) => vec![address.clone()],
        None => {
            let all = same.into_iter().map(|(_, address)| address);
            all.take(Exchange::MAX_DF_ADDRESSES).collect()
        }
    }
}

/// Returns a location as agents of other platforms write it.
fn address_text(location: &Location) -> String {
    format!("{}://{}", location.kind(), location.address())
}

/// Whether two locations are at one host. This machine has all loopback addresses.
fn are_at_one_host(one: &Location, other: &Location) -> bool {
    match (ip_of(one), ip_of(other)) {
        (Some(one), Some(other)) => one == other || one.is_loopback() && other.is_loopback(),
        _ => one.host() == other.host(),
    }
}

/// Returns the address of the host of a location; `None` if the location has its name.
fn ip_of(location: &Location) -> Option<IpAddr> {
    match Endpoint::of(location) {
        Some(Endpoint::Numeric(at)) => Some(at.ip().to_canonical()),
        _ => None,
    }
}

/// Returns those of the HTTP addresses that a gateway told which are at a host where it has another location: a gateway
/// tells the addresses of its own hosts only.
fn at_hosts_of(locations: &[Location], told: &[String]) -> Vec<String> {
    let is_own = |address: &&String| {
        let location = address.parse::<Location>().ok();
        let location = location.filter(|it| it.kind().is_http());
        location.is_some_and(|it| locations.iter().any(|own| are_at_one_host(own, &it)))
    };
    told.iter().filter(is_own).cloned().collect()
}

/// Returns the address of this host in packets to another one. Nothing is sent.
fn local_address_to(at: SocketAddr) -> Option<IpAddr> {
    let any: SocketAddr = match at {
        SocketAddr::V4(_) => (Ipv4Addr::UNSPECIFIED, 0).into(),
        SocketAddr::V6(_) => (Ipv6Addr::UNSPECIFIED, 0).into(),
    };
    let socket = UdpSocket::bind(any).ok()?;
    socket.connect(at).ok()?;
    Some(socket.local_addr().ok()?.ip().to_canonical())
}

fn now() -> PlatformTime {
    PlatformTime {
        at: Instant::now(),
        wall: SystemTime::now(),
    }
}

/// Registers an agent under a name of its own.
fn enter(means: &PlatformAgents, kind: Kind, name: Arc<str>) -> Option<Registered> {
    let incarnation = Incarnation::random();
    let id = AgentId::new(&*name)
        .inspect_err(|error| log_limit::warn!(error = %ErrorChain(error), "cannot register an agent of the gateway"))
        .ok()?;
    // The queue must exist before the name is visible, because letters can arrive from then on.
    let mts = &means.service.mts;
    mts.register(Arc::clone(&name), incarnation);
    if let Err(error) = entry(means, kind, name, incarnation) {
        drop(mts.deregister(incarnation));
        log_limit::warn!(error = %ErrorChain(&error), "cannot register the {} of the gateway", kind.description());
        return None;
    }
    Some(Registered { id, incarnation })
}

/// Registers or updates the directory entry of an agent.
fn entry(
    means: &PlatformAgents,
    kind: Kind,
    name: Arc<str>,
    incarnation: Incarnation,
) -> Result<Arc<Entry>, RegisterError> {
    let known = means.service.host.known_incarnation(incarnation);
    let registration = Registration {
        agent_type: kind.agent_type().to_owned(),
        description: kind.description().to_owned(),
        ..Registration::new(name, incarnation, means.service.locations())
    };
    means.service.host.register(Registration {
        // The age of the registration decides about the name.
        registered: known.map_or(registration.registered, |known| known.registered),
        ..registration
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_platform_reaches_this_gateway_on_the_way_to_it() {
        let at = |text: &str| -> Location { text.parse().unwrap() };
        let own = [
            at("tcp://127.0.0.1:7788"),
            at("http://192.0.2.1:7778/acc"),
            at("http://127.0.0.1:7778/acc"),
        ];
        let reached = reached_at(&own, &at("http://127.0.0.1:27778/acc"));
        assert_eq!(reached, ["http://127.0.0.1:7778/acc"]);
        // The way to a platform with a host name is not known.
        let reached = reached_at(&own, &at("http://crex:7778/acc"));
        assert_eq!(reached.len(), 2);
        assert!(reached_at(&own, &at("https://127.0.0.1:443/acc")).is_empty());
    }

    #[test]
    fn only_http_addresses_at_the_hosts_of_a_gateway_are_told() {
        let locations = ["tcp://10.0.0.2:7788", "quic://[fd00::2]:7788"];
        let locations: [Location; 2] = locations.map(|it| it.parse().unwrap());
        let told = [
            "http://10.0.0.2:7778/acc",
            "https://[fd00::2]:7778/acc",
            "http://10.0.0.3:7778/acc",
            "http://127.0.0.1:7778/acc",
            "http://0.0.0.0:7778/acc",
            "http://localhost:7778/acc",
            "tcp://10.0.0.2:7788",
            "http:",
        ];
        let told = told.map(str::to_owned);
        assert_eq!(at_hosts_of(&locations, &told), told[..2]);
        let here: [Location; 1] = ["tcp://127.0.0.2:7788".parse().unwrap()];
        assert_eq!(at_hosts_of(&here, &told), told[3..4]);
    }
}
