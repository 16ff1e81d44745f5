//! Neighbours: gateways of other hosts that a connection is open with at the moment, whoever
//! opened it.
//!
//! Static peers become neighbours as soon as they are reached, and others while letters pass
//! between them. A neighbour can be written to, gateway to gateway, by its incarnation; by name it
//! cannot, because two robots may give their gateways one name.

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_acl::escape;
use fipa_mts::core::Peer;
use fipa_sds::{
    DeregisterError, Directory, Entry, MergedDirectory, Mts, Reach, RegisterError, Registration,
    Role, Source, Subscriber, Watch,
};
use fipa_transport::{Incarnation, Introduction, Location, Mandate, Principal, TransportErrorKind};
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
    /// Locations at which an attempt failed, and why it did.
    doubted: HashMap<Location, TransportErrorKind>,
    /// Those whose last connection has ended, and when, the latest last.
    parted: VecDeque<(Instant, Arc<Entry>)>,
}

/// For how long a neighbour that has parted is greeted when this host moves: the connections may
/// have ended because it lost its address, long before it gets another.
const PARTED: Duration = Duration::from_secs(600);

/// Most parted neighbours that are remembered.
const MAX_PARTED: usize = 64;

/// Most locations in doubt that wait to be looked at.
const MAX_DOUBTED: usize = 64;

/// A gateway of another host that a connection is open with.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct Neighbour {
    /// The gateway as the directory has it, registered when it was first connected. Its locations
    /// are those of all its agents.
    pub entry: Arc<Entry>,
    /// The locations of the configuration, with its incarnation.
    configured: Vec<Location>,
    /// Where it takes letters by what its open connections show, one location for each, the latest
    /// last.
    hops: Vec<Location>,
    /// How many connections are open with it.
    pub connections: usize,
    /// What its links prove. Connections that prove something else are not its own.
    principal: Principal,
    /// The agents that its links prove it to speak for.
    pub(super) mandate: Mandate,
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
    /// The peers that the configuration names, with their locations.
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

    /// An attempt at this location failed: the gateway may not be there any more.
    pub(super) fn doubt(&self, location: &Location, fault: TransportErrorKind) {
        let mut state = self.state.lock();
        if state.doubted.len() < MAX_DOUBTED {
            state.doubted.insert(location.clone(), fault);
            self.changed.notify_one();
        }
    }

    /// The locations at which attempts failed since the last call.
    pub(super) fn take_doubted(&self) -> HashMap<Location, TransportErrorKind> {
        std::mem::take(&mut self.state.lock().doubted)
    }

    pub(super) fn introduced(&self, peer: &Introduction) {
        let incarnation = peer.hop.location.incarnation();
        // Other processes of this host open connections, too.
        if !peer.hop.is_remote() || !incarnation.is_known() {
            return;
        }
        let mut state = self.state.lock();
        let before = state.present.get(&incarnation);
        if before.is_some_and(|before| before.principal != peer.hop.principal) {
            let (name, at) = (escape(&peer.name), &peer.hop.location);
            tracing::info!(%name, %at, "a connected gateway has another certificate");
            return;
        }
        let neighbour = state.neighbour(peer, before);
        if let Err(error) = neighbour.entry.check() {
            tracing::info!(%error, at = %peer.hop.location, "a gateway that cannot be written to");
            return;
        }
        let changed = before.is_none_or(|before| !Arc::ptr_eq(&before.entry, &neighbour.entry));
        if before.is_none() {
            tracing::info!(name = %peer.name, at = %peer.hop.location, "connected with a gateway");
        }
        state.present.insert(incarnation, neighbour);
        state
            .parted
            .retain(|(_, entry)| entry.incarnation != incarnation);
        if changed {
            self.changed.notify_one();
        }
    }

    pub(super) fn parted(&self, now: Instant, peer: &Introduction) {
        let incarnation = peer.hop.location.incarnation();
        let mut state = self.state.lock();
        let known = state.present.get_mut(&incarnation);
        let Some(known) = known.filter(|known| known.principal == peer.hop.principal) else {
            return;
        };
        if let Some(place) = known.hops.iter().position(|hop| *hop == peer.hop.location) {
            known.hops.remove(place);
        }
        known.connections -= 1;
        if known.connections > 0 {
            // A location that only this connection has shown is not known any more.
            if known.locate() {
                self.changed.notify_one();
            }
            return;
        }
        if let Some(gone) = state.present.remove(&incarnation) {
            if state.parted.len() >= MAX_PARTED {
                state.parted.pop_front();
            }
            state.parted.push_back((now, gone.entry));
        }
        self.changed.notify_one();
        tracing::info!(name = %peer.name, at = %peer.hop.location, "no longer connected");
    }

    /// The gateways that are to be told where this one is now, by name and location: those that are
    /// connected, and those that were a while ago.
    pub(super) fn to_greet(&self, now: Instant) -> Vec<(Arc<str>, Location)> {
        let mut state = self.state.lock();
        state.parted.retain(|(since, _)| *since + PARTED > now);
        let present = state.present.values().map(|neighbour| &neighbour.entry);
        let parted = state.parted.iter().map(|(_, entry)| entry);
        let all = present.chain(parted).flat_map(|entry| {
            // The transports race the locations of one kind.
            let mut kinds = Vec::new();
            let of_kind = entry.locations.iter().filter(move |location| {
                let first = !kinds.contains(&location.kind());
                kinds.push(location.kind());
                first
            });
            of_kind.map(|location| (Arc::clone(&entry.name), location.clone()))
        });
        all.collect()
    }
}

impl State {
    /// What is known of a neighbour when a connection with it has been opened.
    fn neighbour(&self, peer: &Introduction, before: Option<&Neighbour>) -> Neighbour {
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
        let configured: Vec<Location> = configured
            .map(|location| location.clone().with_incarnation(incarnation))
            .take(Entry::MAX_LOCATIONS - 1)
            .collect();
        let entry = Entry {
            name: Arc::clone(&peer.name),
            agent_type: "fipa-mts".to_owned(),
            incarnation,
            mts: Mts::new(Arc::clone(&peer.name), incarnation),
            locations: Vec::new(),
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
        let mut neighbour = before.cloned().unwrap_or_else(|| Neighbour {
            entry: Arc::new(entry),
            configured: Vec::new(),
            hops: Vec::new(),
            connections: 0,
            principal: peer.hop.principal,
            mandate: peer.mandate.clone(),
            peer: None,
        });
        if let Some(listed) = listed
            && neighbour.peer.is_none()
        {
            neighbour.peer = Some(Arc::clone(&listed.name));
            neighbour.configured = configured;
            Arc::make_mut(&mut neighbour.entry).source = Source::Static;
        }
        neighbour.connections += 1;
        neighbour.hops.push(peer.hop.location.clone());
        neighbour.locate();
        neighbour
    }
}

impl Neighbour {
    /// Brings the locations of the entry up to date: those of the open connections, the latest first,
    /// then those of the configuration over transports that no connection is open by. Another location
    /// of the configuration may be an address that the peer does not have at present, and each letter
    /// that tries it waits for an answer. Says whether they have changed.
    fn locate(&mut self) -> bool {
        let hops: Vec<&Location> = self.hops.iter().rev().collect();
        let is_open = |kind| hops.iter().any(|hop| hop.kind() == kind);
        // Those at an address that the peer has come first.
        let configured = self.configured.iter();
        let mut others: Vec<&Location> = configured.filter(|it| !is_open(it.kind())).collect();
        others.sort_by_key(|location| !hops.iter().any(|hop| host(hop) == host(location)));
        let mut locations: Vec<Location> = Vec::new();
        for location in hops.iter().copied().chain(others) {
            if locations.len() < Entry::MAX_LOCATIONS && !locations.contains(location) {
                locations.push(location.clone());
            }
        }
        if locations == self.entry.locations {
            return false;
        }
        Arc::make_mut(&mut self.entry).locations = locations;
        true
    }
}

/// The host of an address with a port.
fn host(location: &Location) -> &str {
    let address = location.address();
    address.rsplit_once(':').map_or(address, |(host, _)| host)
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

#[cfg(test)]
mod tests {
    use fipa_transport::Hop;

    use super::*;

    const GATEWAY: Incarnation = Incarnation::from_u64(7);

    fn at(address: &str) -> Location {
        let location: Location = format!("tcp://{address}").parse().unwrap();
        location.with_incarnation(GATEWAY)
    }

    /// The gateway introduces itself on a connection from this address.
    fn introduction(address: &str, dialled: Option<&str>) -> Introduction {
        Introduction {
            name: "crex-mts".into(),
            hop: Hop {
                location: at(address),
                principal: Principal::Unproved,
            },
            dialled: dialled.map(|text| text.parse().unwrap()),
            mandate: Mandate::Unproved,
        }
    }

    fn locations(neighbours: &Neighbours) -> Vec<Location> {
        neighbours.all()[0].entry.locations.clone()
    }

    #[test]
    fn a_neighbour_is_where_its_latest_connection_comes_from() {
        let (neighbours, now) = (Neighbours::default(), Instant::now());
        let (before, after) = (
            introduction("10.0.0.2:1", None),
            introduction("10.0.0.3:1", None),
        );
        neighbours.introduced(&before);
        neighbours.introduced(&after);
        assert_eq!(locations(&neighbours), [at("10.0.0.3:1"), at("10.0.0.2:1")]);
        neighbours.introduced(&after);
        neighbours.parted(now, &before);
        neighbours.parted(now, &after);
        assert_eq!(locations(&neighbours), [at("10.0.0.3:1")]);
        assert_eq!(neighbours.all()[0].connections, 1);
        neighbours.parted(now, &after);
        assert!(neighbours.all().is_empty());
    }

    #[test]
    fn what_the_configuration_says_counts_where_no_connection_is_open() {
        let (neighbours, now) = (Neighbours::default(), Instant::now());
        neighbours.name_peers(vec![Peer {
            name: "crex".into(),
            locations: ["tcp://crex.local:1", "udp://crex.local:1"]
                .map(|text| text.parse().unwrap())
                .to_vec(),
        }]);
        let (accepted, dialled) = (
            introduction("10.0.0.2:1", None),
            introduction("10.0.0.2:1", Some("tcp://crex.local:1")),
        );
        neighbours.introduced(&accepted);
        assert_eq!(neighbours.all()[0].peer, None);
        neighbours.introduced(&dialled);
        // No letter tries another address while a connection shows the present one.
        let udp: Location = "udp://crex.local:1".parse().unwrap();
        let known = [at("10.0.0.2:1"), udp.with_incarnation(GATEWAY)];
        assert_eq!(locations(&neighbours), known);
        assert_eq!(neighbours.all()[0].peer.as_deref(), Some("crex"));
        neighbours.parted(now, &dialled);
        assert_eq!(locations(&neighbours), known);
    }

    #[test]
    fn those_that_have_parted_are_greeted_for_a_while() {
        let (neighbours, now) = (Neighbours::default(), Instant::now());
        let one = introduction("10.0.0.2:1", None);
        let greeted = vec![("crex-mts".into(), at("10.0.0.2:1"))];
        neighbours.introduced(&one);
        assert_eq!(neighbours.to_greet(now), greeted);
        neighbours.parted(now, &one);
        assert_eq!(neighbours.to_greet(now + PARTED / 2), greeted);
        assert_eq!(neighbours.to_greet(now + PARTED), []);
    }
}
