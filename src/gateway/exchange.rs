//! The exchange of directories with neighbours: the shell around [`fipa_sds::Exchange`].
//!
//! Its letters are those of the gateway itself, to the neighbour itself, so they go by whatever
//! transport leads there, in order and acknowledged. The clerk hands over what comes in.

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_acl::{AgentId, Message, Performative};
use fipa_mts::core::Submission;
use fipa_mts::{Sending, letter_for};
use fipa_sds::{Directory, EXCHANGE_ONTOLOGY, Entry, Exchange, ExchangeDirectory, Mts};
use fipa_transport::{Incarnation, Location};
use parking_lot::Mutex;
use tokio::sync::Notify;
use tokio::task::JoinSet;

use super::neighbours::Neighbours;
use super::publisher::own_agents;
use crate::service::Service;

/// How long a letter of the exchange may be under way. A neighbour that a link was cut to for
/// longer is told everything again.
const DEADLINE: Duration = Duration::from_secs(5);
/// How long goodbyes may take.
const GOODBYE_DEADLINE: Duration = Duration::from_millis(500);

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
    pub(super) async fn run(self: Arc<Self>, means: Means) {
        let mut host = means.service.host.watch();
        let mut sent: JoinSet<(Incarnation, bool)> = JoinSet::new();
        let mut own_changed = true;
        loop {
            let due = self.work(&means, own_changed, &mut sent);
            own_changed = false;
            let until = due.map(tokio::time::Instant::from_std);
            tokio::select! {
                change = host.next() => {
                    if change.is_none() {
                        return;
                    }
                    while host.try_next().is_some() {}
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
        }
    }

    /// Brings the core up to date, sends what is to be sent, and says when there is more.
    fn work(
        &self,
        means: &Means,
        own_changed: bool,
        sent: &mut JoinSet<(Incarnation, bool)>,
    ) -> Option<Instant> {
        let now = Instant::now();
        let neighbours = means.neighbours.all();
        let present: Vec<(Mts, Vec<Location>)> = neighbours
            .iter()
            .map(|neighbour| {
                (
                    neighbour.entry.mts.clone(),
                    neighbour.entry.locations.clone(),
                )
            })
            .collect();
        let mut core = self.core.lock();
        if own_changed {
            core.handle_own(now, &own_agents(&means.service.host));
        }
        core.handle_neighbours(now, &present);
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
        let letter = message.ok().and_then(|message| {
            let letter = letter_for(&message, SystemTime::now());
            letter
                .inspect_err(|error| tracing::warn!(%error, "a neighbour could not be written to"))
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
