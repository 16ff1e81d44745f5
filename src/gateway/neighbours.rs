//! Neighbours: gateways of other hosts that a connection is open with at the moment, whoever
//! opened it.
//!
//! Static peers become neighbours as soon as they are reached, and others while letters pass
//! between them. A neighbour can be written to, gateway to gateway, by its incarnation; by name it
//! cannot, because two robots may give their gateways one name.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::SystemTime;

use fipa_mts::core::Peer;
use fipa_sds::{
    DeregisterError, Directory, Entry, MergedDirectory, Mts, Reach, RegisterError, Registration,
    Role, Source, Subscriber, Watch,
};
use fipa_transport::{Incarnation, Introduction, Location};
use parking_lot::Mutex;
use tokio::sync::Notify;

use crate::routes::Connected;

/// Those that a connection is open with. Their number is bounded by that of connections.
#[derive(Debug, Default)]
pub(crate) struct Neighbours {
    state: Mutex<State>,
    changed: Notify,
}

#[derive(Debug, Default)]
struct State {
    present: HashMap<Incarnation, Neighbour>,
    peers: Vec<Peer>,
}

/// A gateway of another host that a connection is open with.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct Neighbour {
    /// The gateway as the directory has it, registered when it was first connected. Its locations
    /// are those of all its agents.
    pub entry: Arc<Entry>,
    /// How many connections are open with it.
    pub connections: usize,
    /// What `discovery.static` calls it, if it stands there.
    pub peer: Option<Arc<str>>,
}

impl From<Neighbour> for Connected {
    fn from(neighbour: Neighbour) -> Self {
        let entry = neighbour.entry;
        let since = SystemTime::now().duration_since(entry.registered);
        Self {
            name: entry.name.to_string(),
            incarnation: entry.incarnation,
            locations: entry.locations.clone(),
            connections: neighbour.connections,
            seconds: since.unwrap_or_default().as_secs(),
        }
    }
}

impl Neighbours {
    /// The peers that the configuration names, whose locations are known better than by what a
    /// connection shows of them.
    pub(crate) fn name_peers(&self, peers: Vec<Peer>) {
        self.state.lock().peers = peers;
    }

    /// All of them, in no particular order.
    pub(crate) fn all(&self) -> Vec<Neighbour> {
        self.state.lock().present.values().cloned().collect()
    }

    /// Returns when there are others than before. For one task only.
    pub(super) async fn changed(&self) {
        self.changed.notified().await;
    }

    pub(super) fn introduced(&self, peer: &Introduction) {
        let incarnation = peer.hop.location.incarnation();
        // Other processes of this host open connections, too.
        if !peer.hop.remote || !incarnation.is_known() {
            return;
        }
        let mut state = self.state.lock();
        if let Some(known) = state.present.get_mut(&incarnation) {
            known.connections += 1;
            if known.peer.is_some() || peer.dialled.is_none() {
                return;
            }
        }
        let connections = state
            .present
            .get(&incarnation)
            .map_or(1, |it| it.connections);
        let neighbour = state.neighbour(peer, connections);
        if let Err(error) = neighbour.entry.check() {
            tracing::info!(%error, at = %peer.hop.location, "a gateway that cannot be written to");
            return;
        }
        tracing::info!(name = %peer.name, at = %peer.hop.location, "connected with a gateway");
        state.present.insert(incarnation, neighbour);
        self.changed.notify_one();
    }

    pub(super) fn parted(&self, peer: &Introduction) {
        let incarnation = peer.hop.location.incarnation();
        let mut state = self.state.lock();
        let Some(known) = state.present.get_mut(&incarnation) else {
            return;
        };
        known.connections -= 1;
        if known.connections > 0 {
            return;
        }
        state.present.remove(&incarnation);
        self.changed.notify_one();
        tracing::info!(name = %peer.name, at = %peer.hop.location, "no longer connected");
    }
}

impl State {
    fn neighbour(&self, peer: &Introduction, connections: usize) -> Neighbour {
        let incarnation = peer.hop.location.incarnation();
        let named = |listed: &&Peer| {
            let dialled = peer.dialled.as_ref();
            dialled.is_some_and(|dialled| listed.locations.contains(dialled))
        };
        let listed = self.peers.iter().find(named);
        if let Some(listed) = listed
            && *listed.name != *peer.name
        {
            let (name, says) = (&listed.name, &peer.name);
            tracing::info!(%name, %says, "a static peer calls itself by another name");
        }
        let configured = listed.iter().flat_map(|listed| &listed.locations);
        let mut locations: Vec<Location> = configured
            .map(|location| location.clone().with_incarnation(incarnation))
            .take(Entry::MAX_LOCATIONS - 1)
            .collect();
        if !locations.contains(&peer.hop.location) {
            locations.push(peer.hop.location.clone());
        }
        let entry = Entry {
            name: Arc::clone(&peer.name),
            agent_type: "fipa-mts".to_owned(),
            incarnation,
            mts: Mts::new(Arc::clone(&peer.name), incarnation),
            locations,
            description: String::new(),
            registered: SystemTime::now(),
            source: if listed.is_some() {
                Source::Static
            } else {
                Source::Contact
            },
            reach: Reach::Remote {
                gateway: incarnation,
            },
            role: Role::Gateway,
        };
        Neighbour {
            entry: Arc::new(entry),
            connections,
            peer: listed.map(|listed| Arc::clone(&listed.name)),
        }
    }
}

/// The directory as the gateway looks up receivers in it: what everybody sees, and neighbours by
/// their incarnation.
pub(crate) struct View {
    pub(crate) all: MergedDirectory,
    pub(crate) neighbours: Arc<Neighbours>,
}

impl Directory for View {
    fn known(&self, name: &str) -> Option<Arc<Entry>> {
        self.all.known(name)
    }

    fn known_incarnation(&self, incarnation: Incarnation) -> Option<Arc<Entry>> {
        self.all.known_incarnation(incarnation).or_else(|| {
            let state = self.neighbours.state.lock();
            let neighbour = state.present.get(&incarnation)?;
            Some(Arc::clone(&neighbour.entry))
        })
    }

    fn refresh(&self) {
        self.all.refresh();
    }

    fn entries(&self) -> Arc<[Arc<Entry>]> {
        self.all.entries()
    }

    fn generation(&self) -> u64 {
        self.all.generation()
    }

    fn subscribe(&self, subscriber: &Subscriber) {
        self.all.subscribe(subscriber);
    }

    fn watch(&self) -> Watch {
        self.all.watch()
    }

    fn register(&self, registration: Registration) -> Result<Arc<Entry>, RegisterError> {
        self.all.register(registration)
    }

    fn deregister(&self, name: &str, incarnation: Incarnation) -> Result<(), DeregisterError> {
        self.all.deregister(name, incarnation)
    }
}
