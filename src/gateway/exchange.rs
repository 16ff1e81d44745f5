//! The exchange of directories with neighbours: the shell around [`fipa_sds::Exchange`].
//!
//! Its letters are those of the gateway itself, to the neighbour itself, so they go by whatever
//! transport leads there, in order and acknowledged. The clerk hands over what comes in.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_acl::{AgentId, Message, Performative};
use fipa_mts::core::Submission;
use fipa_mts::{Sending, letter_for};
use fipa_sds::{
    Directory, EXCHANGE_ONTOLOGY, Entry, Exchange, ExchangeDirectory, MergedDirectory, Mts,
};
use fipa_transport::{Incarnation, Location, WayFault};
use parking_lot::Mutex;
use tokio::sync::Notify;
use tokio::task::JoinSet;

use super::Network;
use super::neighbours::{Neighbour, Neighbours};
use super::publisher::{Contested, own_agents};
use crate::service::Service;

/// How long a letter of the exchange may be under way. A neighbour that a link was cut to for
/// longer is told everything again.
const DEADLINE: Duration = Duration::from_secs(5);
/// How long goodbyes may take.
const GOODBYE_DEADLINE: Duration = Duration::from_millis(500);

/// The ontology of messages about registrations (FIPA00023).
const MANAGEMENT_ONTOLOGY: &str = "fipa-agent-management";

/// What neighbours have told, and what they are told.
pub(super) struct Exchanging {
    core: Mutex<Exchange>,
    directory: Arc<ExchangeDirectory>,
    /// Tells the task that there may be something to do.
    wake: Notify,
}

/// What the task needs of the gateway.
pub(super) struct Means {
    pub(super) service: Arc<Service>,
    pub(super) id: AgentId,
    pub(super) neighbours: Arc<Neighbours>,
    pub(super) network: Option<Arc<dyn Network>>,
}

impl Exchanging {
    /// Nobody is there yet. The seed decides when what is said; that of two gateways differs.
    pub(super) fn new(seed: u64) -> Self {
        let core = Exchange::new(seed);
        Self {
            directory: core.directory(),
            core: Mutex::new(core),
            wake: Notify::new(),
        }
    }

    /// What neighbours have told.
    pub(super) fn directory(&self) -> Arc<ExchangeDirectory> {
        Arc::clone(&self.directory)
    }

    /// A letter with [`EXCHANGE_ONTOLOGY`] has come.
    pub(super) fn received(&self, from: Incarnation, content: &[u8]) {
        let taken = self
            .core
            .lock()
            .handle_letter(Instant::now(), from, content);
        match taken {
            Ok(()) => self.wake.notify_one(),
            Err(error) => tracing::info!(%error, "what a gateway has told was not used"),
        }
    }

    /// Tells and is told, until the service ends.
    pub(super) async fn run(self: Arc<Self>, means: Means, known: Arc<MergedDirectory>) {
        let (mut host, mut there) = (means.service.host.watch(), known.watch());
        let mut contests = Contests::default();
        let mut sent: JoinSet<(Incarnation, bool)> = JoinSet::new();
        let mut own_changed = true;
        loop {
            let told_now = contests.due().is_some_and(|due| due <= Instant::now());
            if std::mem::take(&mut own_changed) || told_now {
                let (own, contested) = own_agents(&means.service.host, &*known);
                self.core.lock().handle_own(Instant::now(), &own);
                contests.tell(&means, &contested);
            }
            let due = [self.work(&means, &mut sent), contests.due()];
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
                () = means.neighbours.changed() => {}
                () = self.wake.notified() => {}
                Some(arrived) = sent.join_next() => {
                    if let Ok((to, arrived)) = arrived {
                        self.core.lock().handle_sent(Instant::now(), to, arrived);
                    }
                }
                () = tokio::time::sleep_until(until.unwrap_or_else(tokio::time::Instant::now)),
                    if until.is_some() => {}
            }
            // Many changes that came together are one.
            while host.try_next().is_some() || there.try_next().is_some() {
                own_changed = true;
            }
        }
    }

    /// Brings the core up to date, sends what is to be sent, and says when there is more.
    fn work(&self, means: &Means, sent: &mut JoinSet<(Incarnation, bool)>) -> Option<Instant> {
        let now = Instant::now();
        let neighbours = means.neighbours.all();
        let announced = means.network.clone().map(Network::directory);
        let announced_at = announced_by(&neighbours, announced.as_deref());
        let located = |neighbour: &Neighbour| {
            let entry = &neighbour.entry;
            let others = announced_at.get(&entry.incarnation);
            let others = others.into_iter().flat_map(|other| &other.locations);
            (entry.mts.clone(), with_others(&entry.locations, others))
        };
        let present: Vec<(Mts, Vec<Location>)> = neighbours.iter().map(located).collect();
        let mut core = self.core.lock();
        core.handle_neighbours(now, &present);
        for (location, fault) in means.neighbours.take_doubted() {
            if core.handle_silence(now, &location) {
                if let Some(network) = &means.network {
                    network.ended(location.incarnation());
                }
            } else if fault == WayFault::WrongIncarnation {
                // The service that is there introduces itself.
                let at = location.with_incarnation(Incarnation::UNKNOWN);
                means.service.mts.greet(vec![(at.address().into(), at)]);
            }
        }
        if let Some(announced) = announced {
            core.leave_to_others(|entry| announced.known_incarnation(entry.incarnation).is_some());
        }
        core.handle_timeout(now);
        while let Some((to, content)) = core.poll_letter(now) {
            let mut there = neighbours.iter().map(|neighbour| &neighbour.entry);
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

    /// Takes leave of all neighbours, and waits a moment for them to hear it.
    pub(super) async fn goodbye(&self, means: &Means) {
        let (to, content) = self.core.lock().goodbye();
        let mut sent = JoinSet::new();
        for neighbour in means.neighbours.all() {
            if to.contains(&neighbour.entry.incarnation)
                && let Some(sending) =
                    means.send(&neighbour.entry, content.clone(), GOODBYE_DEADLINE)
            {
                sent.spawn(sending.outcomes());
            }
        }
        // Whoever has not heard it notices that the connection ends.
        while sent.join_next().await.is_some() {}
    }
}

/// An entry that each neighbour announces, with the locations of the neighbour.
fn announced_by(
    neighbours: &[Neighbour],
    announced: Option<&dyn Directory>,
) -> HashMap<Incarnation, Arc<Entry>> {
    let gateways = neighbours.iter().map(|it| it.entry.incarnation);
    let gateways: HashSet<Incarnation> = gateways.collect();
    let entries = announced.map(Directory::entries);
    let entries = entries.iter().flat_map(|entries| entries.iter());
    entries
        .filter(|entry| gateways.contains(&entry.mts.incarnation))
        .map(|entry| (entry.mts.incarnation, Arc::clone(entry)))
        .collect()
}

/// These locations, and others of kinds that are not among them.
fn with_others<'a>(
    known: &'a [Location],
    others: impl Iterator<Item = &'a Location>,
) -> Vec<Location> {
    let is_new = |other: &&Location| known.iter().all(|it| it.kind() != other.kind());
    let all = known.iter().chain(others.filter(is_new));
    all.take(Entry::MAX_LOCATIONS).cloned().collect()
}

/// How long somebody else has to have a name before its later owner is told: news of an agent that
/// moves may overtake each other.
const CONTESTED: Duration = Duration::from_secs(1);

/// The agents of this host whose name somebody else has: since when, and whether they were told.
#[derive(Default)]
struct Contests(HashMap<Incarnation, (Instant, bool)>);

impl Contests {
    /// When somebody is to be told next.
    fn due(&self) -> Option<Instant> {
        let untold = self.0.values().filter(|(_, told)| !told);
        untold.map(|(since, _)| *since + CONTESTED).min()
    }

    /// Tells agents of this host, once, that others reach somebody else by their name.
    fn tell(&mut self, means: &Means, contested: &[Contested]) {
        let now = Instant::now();
        self.0
            .retain(|agent, _| contested.iter().any(|one| one.entry.incarnation == *agent));
        for one in contested {
            let contest = self.0.entry(one.entry.incarnation);
            let (since, told) = contest.or_insert((now, false));
            if !*told && now >= *since + CONTESTED {
                *told = true;
                one.tell(means);
            }
        }
    }
}

impl Contested {
    fn tell(&self, means: &Means) {
        let Self { entry, holder } = self;
        let (name, mts) = (&entry.name, &holder.mts.name);
        tracing::warn!(%name, holder = %mts, "an earlier registration on another host has the name");
        let content = format!(
            "the name {name:?} was registered earlier at {mts:?}: other hosts reach that agent, \
             and this one on its own host only; deregister one of them"
        );
        if let Ok(receiver) = AgentId::new(&**name) {
            let message = Message::builder(Performative::Failure)
                .sender(means.id.clone())
                .receiver(receiver)
                .ontology(MANAGEMENT_ONTOLOGY)
                .content(content)
                .build();
            // The letter is on its way, whether somebody waits for its outcome or not.
            drop(
                message
                    .ok()
                    .and_then(|message| means.post(&message, entry, DEADLINE)),
            );
        }
    }
}

impl Means {
    /// Sends a letter of the exchange. None when there is no such letter.
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

    fn post(&self, message: &Message, to: &Entry, deadline: Duration) -> Option<Sending> {
        let letter = Some(message).and_then(|message| {
            let letter = letter_for(message, SystemTime::now());
            letter
                .inspect_err(|error| tracing::warn!(%error, "could not be written to"))
                .ok()
        })?;
        let submission = Submission {
            sender: self.service.own.incarnation,
            letter,
            receivers: Vec::new(),
            deadline,
        };
        Some(self.service.mts.send_to(submission, to))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_kind_without_a_connection_is_reached_where_it_is_announced() {
        let at = |text: &str| -> Location { text.parse().unwrap() };
        let open = [at("udp://10.0.0.2:1")];
        let announced = [at("udp://10.0.0.9:1"), at("tcp://10.0.0.2:1")];
        let all = with_others(&open, announced.iter());
        assert_eq!(all, [at("udp://10.0.0.2:1"), at("tcp://10.0.0.2:1")]);
    }
}
