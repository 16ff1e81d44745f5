//! The exchange of directories with neighbors: the I/O around [`fipa_sds::Exchange`].
//!
//! A letter of the exchange goes from this gateway to a neighbor, over any transport that leads
//! there. The letters arrive in order and are acknowledged. The gateway agent passes the letters of
//! neighbors to [`Exchanging::received`], which queues them: the agent handles its other letters meanwhile.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_acl::{AgentId, ErrorChain, Message, Performative, escape, escape_name};
use fipa_mts::core::Submission;
use fipa_mts::{Sending, letter_for};
use fipa_sds::{
    Directory, EXCHANGE_ONTOLOGY, Entry, Exchange, ExchangeDirectory, ExchangeError,
    MergedDirectory, OwnDfEntry, Present,
};
#[cfg(feature = "secure")]
use fipa_transport::Principal;
use fipa_transport::{Incarnation, Location, PeerId, TransportErrorKind, log_limit};
use parking_lot::{Mutex, MutexGuard};
use tokio::sync::Notify;
use tokio::task::JoinSet;

use super::Network;
use super::exchange_queues::{ExchangeQueues, Unread};
use super::names::{Contested, contested, own_agents};
use super::neighbors::{Neighbor, Neighbors};
use crate::admin::routes::ContestedName;
use crate::domain::background::{self, BackgroundError};
use crate::domain::service::Service;

/// The receiver of a greeting to a service whose name is not known. It is not read.
const UNNAMED: &str = "gateway";

/// Deadline for the delivery of a letter of the exchange. After a longer interruption of the link,
/// a neighbor receives all agents again.
const DEADLINE: Duration = Duration::from_secs(5);
/// Deadline for the delivery of goodbyes.
const GOODBYE_DEADLINE: Duration = Duration::from_millis(500);

/// Maximum number of contested names in the report of the gateway.
const MAX_SHOWN: usize = 64;

/// The ontology of messages about registrations (FIPA00023).
pub(super) const MANAGEMENT_ONTOLOGY: &str = "fipa-agent-management";

/// The directory exchange of this gateway with its neighbors.
pub(super) struct Exchanging {
    core: Mutex<Exchange>,
    directory: Arc<ExchangeDirectory>,
    /// The letters of neighbors that are to be read.
    unread: Mutex<ExchangeQueues>,
    /// Wakes the task that reads them.
    arrived: Notify,
    /// The agents of this host whose names agents of other hosts have.
    contested: Mutex<Vec<ContestedName>>,
    /// Wakes the task after a letter has changed the state.
    wake: Notify,
}

/// The parts of the gateway that the exchange uses.
pub(super) struct Means {
    pub(super) service: Arc<Service>,
    pub(super) id: AgentId,
    pub(super) neighbors: Arc<Neighbors>,
    pub(super) network: Option<Arc<dyn Network>>,
    /// Whether `security.keys` is set.
    pub(super) has_keys: bool,
}

impl Exchanging {
    /// Creates an exchange without neighbors. The seed randomizes the times of the letters; two
    /// gateways use different seeds.
    pub(super) fn new(seed: u64) -> Self {
        let core = Exchange::new(seed);
        Self {
            directory: core.directory(),
            core: Mutex::new(core),
            unread: Mutex::default(),
            arrived: Notify::new(),
            contested: Mutex::default(),
            wake: Notify::new(),
        }
    }

    /// Returns the agents of this host whose names agents of other hosts also have, at most
    /// [`MAX_SHOWN`].
    pub(super) fn contested(&self) -> Vec<ContestedName> {
        self.contested.lock().clone()
    }

    /// Returns the directory of the agents that neighbors have sent.
    pub(super) fn directory(&self) -> Arc<ExchangeDirectory> {
        Arc::clone(&self.directory)
    }

    /// Sets the entries of the directory facilitator that are sent to the neighbors. Returns the names
    /// of the agents whose entries are not sent, because there are too many or they are too large.
    pub(super) fn send_df(&self, entries: Vec<OwnDfEntry>) -> Vec<Arc<str>> {
        let others = self.core.lock().handle_own_df(Instant::now(), entries);
        self.wake.notify_one();
        others
    }

    /// Sets the gateways whose certificate is no longer trusted; see [`Exchange::handle_withdrawn`].
    #[cfg(feature = "secure")]
    pub(super) fn withdraw(&self, gateways: &[(Incarnation, Principal)]) {
        let gateways = gateways.iter().copied();
        self.core.lock().handle_withdrawn(gateways);
        self.wake.notify_one();
    }

    /// Queues the content of a letter with [`EXCHANGE_ONTOLOGY`] from this gateway, which the peer handed over.
    pub(super) fn received(&self, peer: &PeerId, from: Incarnation, content: &[u8]) {
        if content.len() > Exchange::MAX_CONTENT {
            return rejected(from, &ExchangeError::TooLarge(content.len()));
        }
        self.unread.lock().push(peer, from, content);
        self.arrived.notify_one();
    }

    /// Reads the letters of neighbors until the task is aborted: one after the other, on a thread of its own,
    /// because a list of many agents takes long.
    pub(super) async fn read_letters(self: Arc<Self>) {
        loop {
            let now = Instant::now();
            let (next, due) = {
                let mut unread = self.unread.lock();
                (unread.poll(now), unread.poll_timeout(now))
            };
            let Some(next) = next else {
                let due = due.map(tokio::time::Instant::from_std);
                tokio::select! {
                    () = self.arrived.notified() => {}
                    () = tokio::time::sleep_until(due.unwrap_or_else(tokio::time::Instant::now)),
                        if due.is_some() => {}
                }
                continue;
            };
            let (this, gateway, unread) = (Arc::clone(&self), next.gateway, next.unread);
            let runtime = tokio::runtime::Handle::current();
            let read = background::try_run(&runtime, move |_| this.read(gateway, &unread)).await;
            match read {
                Ok(cost) => {
                    let mut unread = self.unread.lock();
                    unread.handle_cost(Instant::now(), next.peer, cost);
                }
                Err(BackgroundError::Ended) => return,
                Err(error) => {
                    log_limit::error!(of: gateway, %error, "cannot read a letter of a gateway");
                    self.read(gateway, &Unread::Lost);
                }
            }
        }
    }

    /// Reads a letter from this gateway. Returns the time that it took.
    fn read(&self, from: Incarnation, unread: &Unread) -> Duration {
        let mut core = self.core.lock();
        let began = Instant::now();
        let taken = match unread {
            Unread::Letter(content) => core.handle_letter(began, from, content),
            Unread::Lost => {
                core.handle_unread(began, from);
                Ok(())
            }
        };
        let cost = began.elapsed();
        // Without fairness, the next letter may take the lock before the task that sends letters.
        MutexGuard::unlock_fair(core);
        match taken {
            Ok(()) => self.wake.notify_one(),
            Err(error) => rejected(from, &error),
        }
        cost
    }

    /// Runs the exchange until the service ends.
    pub(super) async fn run(self: Arc<Self>, means: Means, known: Arc<MergedDirectory>) {
        let (mut host, mut there) = (means.service.host.watch(), known.watch());
        let (mut conflicts, mut disputes) = (NameConflicts::default(), Disputes::default());
        let mut greetings = Greetings::default();
        let mut sent: JoinSet<(Incarnation, bool)> = JoinSet::new();
        let mut own_changed = true;
        loop {
            let conflict_due = conflicts.due().is_some_and(|due| due <= Instant::now());
            if std::mem::take(&mut own_changed) || conflict_due {
                let own = own_agents(&means.service.host);
                self.core.lock().handle_own(Instant::now(), &own);
                let contested = contested(&own, &*known, means.has_keys);
                let shown = contested.iter().take(MAX_SHOWN).map(ContestedName::from);
                *self.contested.lock() = shown.collect();
                conflicts.report(&means, &contested);
            }
            let mut contested = self.directory.contested();
            // The agents of gateways get second names.
            contested.retain(|(_, other)| !other.is_platform_agent());
            disputes.report(&means, Instant::now(), &contested);
            if self.core.lock().has_own_df() {
                greetings.send(&means, Instant::now());
            }
            let due = [
                self.work(&means, &mut sent),
                greetings.due,
                conflicts.due(),
                disputes.due(),
            ];
            let until = due
                .into_iter()
                .flatten()
                .min()
                .map(tokio::time::Instant::from_std);
            tokio::select! {
                change = host.next() => {
                    if change.is_none() {
                        return;
                    }
                    own_changed = true;
                }
                change = there.next() => {
                    if change.is_none() {
                        return;
                    }
                    own_changed = true;
                }
                () = means.neighbors.changed() => {}
                () = self.wake.notified() => {}
                Some(arrived) = sent.join_next() => {
                    if let Ok((to, arrived)) = arrived {
                        self.core.lock().handle_sent(Instant::now(), to, arrived);
                    }
                }
                () = tokio::time::sleep_until(until.unwrap_or_else(tokio::time::Instant::now)),
                    if until.is_some() => {}
            }
            // Several pending changes are handled together.
            while host.try_next().is_some() || there.try_next().is_some() {
                own_changed = true;
            }
        }
    }

    /// Updates the core and sends the letters that are due. Returns the time of the next call.
    fn work(&self, means: &Means, sent: &mut JoinSet<(Incarnation, bool)>) -> Option<Instant> {
        let now = Instant::now();
        let neighbors = means.neighbors.all();
        let announced = means.network.clone().map(Network::directory);
        let announced_at = announced_by(&neighbors, announced.as_deref());
        let located = |neighbor: &Neighbor| {
            let entry = &neighbor.entry;
            let others = announced_at.get(&entry.incarnation);
            let others = others.into_iter().flat_map(|other| &other.locations);
            Present {
                mts: entry.mts.clone(),
                locations: with_others(&entry.locations, others),
                mandate: neighbor.mandate.clone(),
                principal: neighbor.principal,
            }
        };
        let present: Vec<Present> = neighbors.iter().map(located).collect();
        let mut core = self.core.lock();
        core.handle_neighbors(now, &present);
        for (location, fault) in means.neighbors.take_suspects() {
            if core.handle_silence(now, &location) {
                if let Some(network) = &means.network {
                    network.ended(location.incarnation());
                }
            } else if fault == TransportErrorKind::WrongIncarnation {
                // The greeting makes the service that runs there now introduce itself.
                let at = location.with_incarnation(Incarnation::UNKNOWN);
                means
                    .service
                    .mts
                    .announce_locations(vec![(UNNAMED.into(), at)]);
            }
        }
        if let Some(announced) = announced {
            core.leave_to_others(|entry| announced.known_incarnation(entry.incarnation).is_some());
        }
        core.handle_timeout(now);
        while let Some((to, content)) = core.poll_letter(now) {
            let mut there = neighbors.iter().map(|neighbor| &neighbor.entry);
            let entry = there.find(|entry| entry.incarnation == to);
            let sending = entry.and_then(|entry| means.send(entry, content, DEADLINE));
            sent.spawn(async move {
                let arrived = match sending {
                    Some(sending) => {
                        let outcomes = sending.outcomes().await;
                        outcomes.iter().all(|(_, outcome)| outcome.is_success())
                    }
                    None => false,
                };
                (to, arrived)
            });
        }
        core.poll_timeout()
    }

    /// Sends a goodbye to the neighbors and waits until it is delivered, at most
    /// [`GOODBYE_DEADLINE`].
    pub(super) async fn goodbye(&self, means: &Means) {
        let (to, content) = self.core.lock().goodbye();
        let mut sent = JoinSet::new();
        for neighbor in means.neighbors.all() {
            if to.contains(&neighbor.entry.incarnation)
                && let Some(sending) =
                    means.send(&neighbor.entry, content.clone(), GOODBYE_DEADLINE)
            {
                sent.spawn(sending.outcomes());
            }
        }
        // A neighbor that does not receive the goodbye detects the end of the connection.
        while sent.join_next().await.is_some() {}
    }
}

fn rejected(from: Incarnation, error: &ExchangeError) {
    // The text of a malformed letter may be part of the error.
    let error = ErrorChain(error).to_string();
    log_limit::info!(of: from, error = %escape(&error), "rejected an exchange letter of a gateway");
}

/// Greetings to gateways that the network announces. Gateways become neighbors when letters pass between
/// them; a gateway with DF entries connects with the others before that.
#[derive(Default)]
struct Greetings {
    /// The greeted gateways, and the times.
    greeted: HashMap<Incarnation, Instant>,
    /// Earliest time of the next greetings.
    not_before: Option<Instant>,
    /// The time at which further gateways are greeted, if there are any.
    due: Option<Instant>,
}

impl Greetings {
    /// Maximum number of gateways that are greeted at once, and the time until the next ones.
    const AT_ONCE: usize = 4;
    const PAUSE: Duration = Duration::from_secs(1);
    /// Time after which a gateway that has not become a neighbor is greeted again.
    const AGAIN: Duration = Duration::from_secs(1800);
    /// Number of neighbors from which on no gateway is greeted. Connections are left for letters.
    const NEIGHBORS: usize = 128;
    /// Maximum number of gateways that are remembered.
    const REMEMBERED: usize = 1024;

    /// Greets announced gateways that have a directory facilitator and are not neighbors.
    fn send(&mut self, means: &Means, now: Instant) {
        if self.not_before.is_some_and(|earliest| earliest > now) {
            return;
        }
        let Some(network) = &means.network else {
            return;
        };
        let entries = Arc::clone(network).directory().entries();
        let neighbors = means.neighbors.all();
        let neighbors: HashSet<Incarnation> =
            neighbors.iter().map(|it| it.entry.incarnation).collect();
        let next = self.next(now, &entries, &neighbors);
        let oldest = self.greeted.values().min();
        self.not_before = (!next.is_empty()).then(|| now + Self::PAUSE);
        self.due = self.not_before.or(oldest.map(|at| *at + Self::AGAIN));
        for entry in next {
            let mut kinds = HashSet::new();
            let locations = entry.locations.iter().filter(|location| {
                let kind = location.kind();
                means.service.uses(kind) && kinds.insert(kind)
            });
            let Some(name) = &entry.mts.name else {
                continue;
            };
            let greetings = locations.map(|location| (Arc::clone(name), location.clone()));
            means.service.mts.announce_locations(greetings.collect());
        }
    }

    /// Returns the directory facilitators of the gateways to greet now.
    fn next(
        &mut self,
        now: Instant,
        entries: &[Arc<Entry>],
        neighbors: &HashSet<Incarnation>,
    ) -> Vec<Arc<Entry>> {
        self.greeted.retain(|_, at| now < *at + Self::AGAIN);
        let room = Self::NEIGHBORS.saturating_sub(neighbors.len());
        let room = room.min(Self::REMEMBERED.saturating_sub(self.greeted.len()));
        let mut next = Vec::new();
        for entry in entries {
            let gateway = entry.mts.incarnation;
            if next.len() >= room.min(Self::AT_ONCE) {
                break;
            }
            if entry.agent_type == Entry::DF_TYPE
                && entry.is_platform_agent()
                && gateway.is_known()
                && !neighbors.contains(&gateway)
                && !self.greeted.contains_key(&gateway)
            {
                self.greeted.insert(gateway, now);
                next.push(Arc::clone(entry));
            }
        }
        next
    }
}

/// Returns, for each neighbor, one entry that it announces. The locations of the entry are those of
/// the neighbor.
fn announced_by(
    neighbors: &[Neighbor],
    announced: Option<&dyn Directory>,
) -> HashMap<Incarnation, Arc<Entry>> {
    let gateways = neighbors.iter().map(|it| it.entry.incarnation);
    let gateways: HashSet<Incarnation> = gateways.collect();
    let entries = announced.map(Directory::entries);
    let entries = entries.iter().flat_map(|entries| entries.iter());
    entries
        .filter(|entry| gateways.contains(&entry.mts.incarnation))
        .map(|entry| (entry.mts.incarnation, Arc::clone(entry)))
        .collect()
}

/// Returns the known locations, and those of the others whose kind the known ones lack.
fn with_others<'a>(
    known: &'a [Location],
    others: impl Iterator<Item = &'a Location>,
) -> Vec<Location> {
    let is_new = |other: &&Location| known.iter().all(|it| it.kind() != other.kind());
    let all = known.iter().chain(others.filter(is_new));
    all.take(Entry::MAX_LOCATIONS).cloned().collect()
}

/// Time for which a conflict about a name has to last before it is reported. The updates about an
/// agent that moves may arrive in the wrong order.
const CONTESTED: Duration = Duration::from_secs(1);

/// The agents of this host whose name an agent of another host has: the start of each conflict, and
/// whether the agent was informed.
#[derive(Default)]
struct NameConflicts(HashMap<Incarnation, (Instant, bool)>);

impl NameConflicts {
    /// Returns the time at which the next agent is to be informed.
    fn due(&self) -> Option<Instant> {
        let unreported = self.0.values().filter(|(_, reported)| !reported);
        unreported.map(|(since, _)| *since + CONTESTED).min()
    }

    /// Informs each of these agents once that an agent of another host has its name.
    fn report(&mut self, means: &Means, contested: &[Contested]) {
        let now = Instant::now();
        self.0
            .retain(|agent, _| contested.iter().any(|one| one.entry.incarnation == *agent));
        for one in contested {
            let conflict = self.0.entry(one.entry.incarnation);
            let (since, reported) = conflict.or_insert((now, false));
            if !*reported && now >= *since + CONTESTED {
                *reported = true;
                one.report(means);
            }
        }
    }
}

/// The names that agents of two other hosts claim, both with proof or both without, and the reports
/// about them to the gateways of the agents.
#[derive(Default)]
struct Disputes {
    /// By name and agent of the claimant that does not hold the name.
    all: HashMap<(Arc<str>, Incarnation), Dispute>,
    /// Time of the last report about a claim of each gateway.
    last_reports: HashMap<Incarnation, Instant>,
}

/// A name that agents of two other hosts claim.
struct Dispute {
    since: Instant,
    is_reported: bool,
    /// The gateway of the agent that claims the name but does not hold it.
    gateway: Incarnation,
    /// Whether the directory still shows it.
    is_present: bool,
}

impl Disputes {
    /// Minimum time between two reports about claims of one gateway.
    const PAUSE: Duration = Duration::from_secs(1);

    /// Returns the time of the next report.
    fn due(&self) -> Option<Instant> {
        let unreported = self.all.values().filter(|dispute| !dispute.is_reported);
        unreported
            .map(|dispute| {
                let last_report = self.last_reports.get(&dispute.gateway);
                let free =
                    last_report.map_or(dispute.since, |last_report| *last_report + Self::PAUSE);
                free.max(dispute.since + CONTESTED)
            })
            .min()
    }

    /// Reports each dispute once, to the gateways of both agents. Of the claims of one gateway to
    /// names of other agents, at most one per second is reported.
    fn report(&mut self, means: &Means, now: Instant, contested: &[(Arc<Entry>, Arc<Entry>)]) {
        for (holder, other) in self.next(now, contested) {
            let (name, at, by) = (&other.name, holder.mts.shown(), other.mts.shown());
            let (shown, by_shown) = (escape_name(at), escape_name(by));
            log_limit::warn!(of: other.mts.incarnation, name = %escape_name(name), holder = %shown, other = %by_shown, "agents of two hosts claim the same name");
            let content = format!(
                "the name {name:?} is registered at {at:?} and at {by:?}: this host reaches the agent \
                 at {at:?}; deregister one of them"
            );
            for gateway in means.neighbors.all() {
                let known = gateway.entry.incarnation;
                if known == holder.mts.incarnation || known == other.mts.incarnation {
                    drop(means.notify(&gateway.entry, &content));
                }
            }
        }
    }

    /// Returns the disputes that are to be reported now.
    fn next(
        &mut self,
        now: Instant,
        contested: &[(Arc<Entry>, Arc<Entry>)],
    ) -> Vec<(Arc<Entry>, Arc<Entry>)> {
        if contested.is_empty() && self.all.is_empty() {
            return Vec::new();
        }
        for dispute in self.all.values_mut() {
            dispute.is_present = false;
        }
        self.last_reports
            .retain(|_, last_report| now < *last_report + Self::PAUSE);
        let mut due = Vec::new();
        for (holder, other) in contested {
            let gateway = other.mts.incarnation;
            let key = (Arc::clone(&other.name), other.incarnation);
            let dispute = self.all.entry(key).or_insert(Dispute {
                since: now,
                is_reported: false,
                gateway,
                is_present: true,
            });
            (dispute.gateway, dispute.is_present) = (gateway, true);
            let is_due = now >= dispute.since + CONTESTED;
            if !dispute.is_reported && is_due && !self.last_reports.contains_key(&gateway) {
                dispute.is_reported = true;
                self.last_reports.insert(gateway, now);
                due.push((Arc::clone(holder), Arc::clone(other)));
            }
        }
        self.all.retain(|_, dispute| dispute.is_present);
        due
    }
}

impl Contested {
    /// Logs the conflict and informs the agent of this host.
    fn report(&self, means: &Means) {
        let Self { entry, claim } = self;
        let (name, mts) = (&entry.name, escape_name(claim.mts.shown()));
        log_limit::warn!(name = %escape_name(name), other = %mts, "an agent of another host has the same name");
        if entry.is_platform_agent() {
            // The agent management system and the directory facilitator get second names.
            return;
        }
        let content = format!(
            "the name {name:?} is also registered at {mts:?}: each other host reaches the agent \
             that was announced to it first; deregister one of them"
        );
        if let Ok(receiver) = AgentId::new(&**name) {
            let message = Message::builder(Performative::Failure)
                .sender(means.id.clone())
                .receiver(receiver)
                .ontology(MANAGEMENT_ONTOLOGY)
                .content(content)
                .build();
            // The letter is sent although its outcome is not awaited.
            drop(
                message
                    .ok()
                    .and_then(|message| means.post(&message, entry, DEADLINE)),
            );
        }
    }
}

impl Means {
    /// Sends a letter of the exchange. Returns `None` if the letter cannot be built.
    fn send(&self, to: &Entry, content: Vec<u8>, deadline: Duration) -> Option<Sending> {
        let receiver = AgentId::new(&*to.name).ok()?;
        let message = Message::builder(Performative::Inform)
            .sender(self.id.clone())
            .receiver(receiver)
            .ontology(EXCHANGE_ONTOLOGY)
            .content(content)
            .build();
        self.post(&message.ok()?, to, deadline)
    }

    /// Sends a notice about a name to another gateway, which logs it for its operator.
    fn notify(&self, to: &Entry, content: &str) -> Option<Sending> {
        let message = Message::builder(Performative::Failure)
            .sender(self.id.clone())
            .receiver(AgentId::new(&*to.name).ok()?)
            .ontology(MANAGEMENT_ONTOLOGY)
            .content(content.to_owned())
            .build();
        self.post(&message.ok()?, to, DEADLINE)
    }

    fn post(&self, message: &Message, to: &Entry, deadline: Duration) -> Option<Sending> {
        let letter = Some(message).and_then(|message| {
            let letter = letter_for(message, SystemTime::now());
            letter
                .inspect_err(
                    |error| log_limit::warn!(error = %ErrorChain(error), "cannot encode a letter"),
                )
                .ok()
        })?;
        let submission = Submission {
            sender: self.service.own.incarnation,
            letter,
            receivers: Vec::new(),
            deadline,
        };
        Some(self.service.mts.submit_to(submission, to))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Creates the entry of an agent with this name and number at the gateway with that number.
    fn agent(name: &str, number: u64, gateway: u64) -> Arc<Entry> {
        let gateway = Incarnation::from_u64(gateway);
        Arc::new(Entry {
            name: name.into(),
            agent_type: String::new(),
            incarnation: Incarnation::from_u64(number),
            locations: Vec::new(),
            mts: fipa_sds::MtsId::new("mts", gateway),
            description: String::new(),
            registered: SystemTime::UNIX_EPOCH,
            source: fipa_sds::Source::Exchange,
            reach: fipa_sds::Reach::Remote { gateway },
            peer: PeerId::THIS_HOST,
            role: fipa_sds::Role::Agent,
        })
    }

    #[test]
    fn announced_gateways_with_a_directory_facilitator_are_greeted_a_few_at_once() {
        let (mut greetings, begun) = (Greetings::default(), Instant::now());
        let df = |gateway: u64| {
            let mut entry = agent(&format!("df@{gateway:03}"), 1000 + gateway, gateway);
            Arc::make_mut(&mut entry).agent_type = Entry::DF_TYPE.to_owned();
            entry
        };
        let mut entries: Vec<_> = (1..=10).map(df).collect();
        entries.push(agent("rover", 7, 11));
        let mut next = |seconds, entries: &[_], neighbors: &[u64]| {
            let known = neighbors.iter().copied().map(Incarnation::from_u64);
            let now = begun + Duration::from_secs(seconds);
            let next = greetings.next(now, entries, &known.collect());
            let gateways = next.iter().map(|entry| entry.mts.incarnation.as_u64());
            gateways.collect::<Vec<u64>>()
        };
        assert_eq!(next(0, &entries, &[]), [1, 2, 3, 4]);
        assert_eq!(next(1, &entries, &[5]), [6, 7, 8, 9]);
        assert_eq!(next(2, &entries, &[5]), [10]);
        assert_eq!(next(3, &entries, &[5]), [0; 0]);
        // A gateway that did not become a neighbor, after a while.
        assert_eq!(next(1801, &entries, &[1, 2, 3, 5]), [4, 6, 7, 8]);
        // With many neighbors, none.
        let many: Vec<u64> = (100..100 + Greetings::NEIGHBORS as u64).collect();
        assert_eq!(next(9000, &entries, &many), [0; 0]);
        assert_eq!(next(9000, &entries, &many[1..]), [1]);
        // Any number of announced gateways takes bounded memory.
        let flood: Vec<_> = (1000..9000).map(df).collect();
        for seconds in 0..Greetings::AGAIN.as_secs() {
            assert!(next(20_000 + seconds, &flood, &[]).len() <= Greetings::AT_ONCE);
        }
        assert_eq!(next(21_799, &flood, &[]), [0; 0]);
    }

    #[test]
    fn disputes_are_told_once_and_one_a_second_for_each_gateway_that_claims_names_of_others() {
        let (mut disputes, begun) = (Disputes::default(), Instant::now());
        let at = |ms| begun + Duration::from_millis(ms);
        let of = |name: &str, gateway| (agent(name, 1, 7), agent(name, 10 + gateway, gateway));
        // Gateway 8 claims three names, and gateway 9 one.
        let all = [of("a", 8), of("b", 8), of("c", 8), of("a", 9)];
        let mut reports_at = |ms, all: &[_]| {
            let next = disputes.next(at(ms), all).into_iter();
            let names = next.map(|(_, other)| (other.name.to_string(), other.mts.incarnation));
            (names.collect::<Vec<_>>(), disputes.due())
        };
        let one = |name: &str, gateway| (name.to_owned(), Incarnation::from_u64(gateway));
        // The directory may show an agent that moves at two gateways for a moment.
        assert_eq!(reports_at(0, &all), (vec![], Some(at(1000))));
        assert_eq!(reports_at(999, &all), (vec![], Some(at(1000))));
        let first = vec![one("a", 8), one("a", 9)];
        assert_eq!(reports_at(1000, &all), (first, Some(at(2000))));
        assert_eq!(reports_at(1500, &all), (vec![], Some(at(2000))));
        assert_eq!(reports_at(2000, &all), (vec![one("b", 8)], Some(at(3000))));
        assert_eq!(reports_at(3000, &all), (vec![one("c", 8)], None));
        assert_eq!(reports_at(9000, &all), (vec![], None));
        // A dispute that ended and began again is reported again.
        assert_eq!(reports_at(9000, &[]), (vec![], None));
        assert_eq!(reports_at(9000, &all[3..]), (vec![], Some(at(10_000))));
        assert_eq!(reports_at(10_000, &all[3..]), (vec![one("a", 9)], None));
    }

    #[test]
    fn a_kind_without_a_connection_is_reached_where_it_is_announced() {
        let at = |text: &str| -> Location { text.parse().unwrap() };
        let open = [at("udp://10.0.0.2:1")];
        let announced = [at("udp://10.0.0.9:1"), at("tcp://10.0.0.2:1")];
        let all = with_others(&open, announced.iter());
        assert_eq!(all, [at("udp://10.0.0.2:1"), at("tcp://10.0.0.2:1")]);
    }
}
