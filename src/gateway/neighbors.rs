//! Neighbors: the gateways of other hosts with which a connection is open now, whether this gateway
//! or the other one opened it.
//!
//! A static peer becomes a neighbor as soon as it is reached. Another gateway is a neighbor while
//! letters pass between the two. A gateway sends letters to a neighbor by its incarnation, not by
//! its name, because the gateways of two robots may have the same name.

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant, SystemTime};

use fipa_acl::{ErrorChain, escape_name};
use fipa_mts::core::Peer;
use fipa_sds::{
    DeregisterError, Directory, Entry, MergedDirectory, MtsId, Reach, RegisterError, Registration,
    Role, Source, Subscriber, View as DirectoryView, Watch,
};
use fipa_transport::{
    Incarnation, Introduction, Location, Mandate, PeerId, Principal, TransportErrorKind, log_limit,
};
use parking_lot::Mutex;
use tokio::sync::Notify;

use crate::admin::routes::{Connected, LinkSecurity, LostHost};

/// The gateways with an open connection. The number of connections bounds their number.
#[derive(Debug, Default)]
pub(crate) struct Neighbors {
    state: Mutex<State>,
    /// Number of changes of the neighbors' entries.
    generation: AtomicU64,
    changed: Notify,
}

#[derive(Debug, Default)]
struct State {
    present: HashMap<Incarnation, Neighbor>,
    static_peers: Vec<Peer>,
    /// Locations at which an attempt failed, and the cause.
    suspected: HashMap<Location, TransportErrorKind>,
    /// The name of this gateway.
    own_name: Option<Arc<str>>,
    /// Whether a neighbor with the same name was reported.
    has_namesake: bool,
    /// Neighbors whose last connection has ended, the latest last.
    disconnected: VecDeque<Disconnected>,
}

/// A neighbor whose last connection has ended.
#[derive(Debug)]
struct Disconnected {
    at: Instant,
    entry: Arc<Entry>,
    principal: Principal,
}

impl Disconnected {
    /// Whether the neighbor is the same host that has connected again. Without keys, the name of a host is a
    /// claim, and its address may change.
    fn is_back_as(&self, neighbor: &Neighbor) -> bool {
        let is_same = match self.principal {
            Principal::Certificate(_) => self.principal == neighbor.principal,
            Principal::Host | Principal::User(_) | Principal::Unproved => true,
        };
        is_same && self.entry.name == neighbor.entry.name
    }
}

/// Time for which a disconnected neighbor is still greeted when this host gets another address. The
/// connections may have ended because this host lost its address, long before it gets another.
const STILL_GREETED: Duration = Duration::from_secs(600);

/// Time for which a disconnected neighbor is reported as lost.
const LOST: Duration = Duration::from_secs(3600);

/// Maximum number of disconnected neighbors that are stored.
const MAX_DISCONNECTED: usize = 64;

/// Maximum number of disconnected neighbors with one certificate, or without keys at one address.
const MAX_DISCONNECTED_OF_PEER: usize = 8;

/// Maximum number of suspected locations that wait to be handled.
const MAX_SUSPECTED: usize = 64;

/// A gateway of another host with which a connection is open.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct Neighbor {
    /// The directory entry of the gateway; its time of registration is that of the first
    /// connection. Its locations are also those of the agents of the gateway.
    pub entry: Arc<Entry>,
    /// The locations in the configuration, with the incarnation of the gateway.
    configured: Vec<Location>,
    /// The locations at which the gateway accepts letters, one for each open connection, the latest
    /// last.
    hops: Vec<Location>,
    /// Time of the first connection.
    pub(super) since: Instant,
    /// Number of open connections with the gateway.
    pub connections: usize,
    /// The identity that the links prove. A connection that proves another one is ignored.
    pub(super) principal: Principal,
    /// The agents for which the gateway may act, as far as its links prove it.
    pub(super) mandate: Mandate,
    /// The name in `discovery.static`, if the gateway is listed there.
    pub peer: Option<Arc<str>>,
}

impl From<Neighbor> for Connected {
    fn from(neighbor: Neighbor) -> Self {
        let entry = neighbor.entry;
        let since = SystemTime::now().duration_since(entry.registered);
        Self {
            name: entry.name.to_string(),
            incarnation: entry.incarnation,
            locations: entry.locations.clone(),
            connections: neighbor.connections,
            seconds: since.unwrap_or_default().as_secs(),
            security: security(neighbor.principal),
        }
    }
}

/// The security of connections that prove this identity.
fn security(principal: Principal) -> LinkSecurity {
    let hex = |fingerprint: [u8; 32]| {
        fingerprint
            .iter()
            .map(|byte| format!("{byte:02x}"))
            .collect()
    };
    match principal {
        Principal::Certificate(fingerprint) => LinkSecurity {
            encrypted: true,
            certificate: Some(hex(fingerprint)),
        },
        Principal::Host | Principal::User(_) | Principal::Unproved => LinkSecurity::default(),
    }
}

impl Neighbors {
    /// Sets the name of this gateway. The first neighbor with the same name is reported.
    pub(super) fn name_own(&self, name: &str) {
        self.state.lock().own_name = Some(name.into());
    }

    /// Sets the peers that the configuration names, with their locations.
    pub(crate) fn name_peers(&self, peers: Vec<Peer>) {
        self.state.lock().static_peers = peers;
    }

    /// Whether this gateway or a neighbor has the name.
    pub(super) fn has_gateway(&self, name: &str) -> bool {
        let state = self.state.lock();
        let mut neighbors = state.present.values();
        state.own_name.as_deref() == Some(name) || neighbors.any(|it| *it.entry.name == *name)
    }

    /// Whether a neighbor with the name of this gateway was logged.
    pub(super) fn has_namesake(&self) -> bool {
        self.state.lock().has_namesake
    }

    /// Returns all neighbors, in no particular order.
    pub(crate) fn all(&self) -> Vec<Neighbor> {
        self.state.lock().present.values().cloned().collect()
    }

    /// Returns the identity that the links of this neighbor prove.
    pub(super) fn principal(&self, gateway: Incarnation) -> Option<Principal> {
        let state = self.state.lock();
        state.present.get(&gateway).map(|it| it.principal)
    }

    /// Waits until a neighbor changes or a location is suspected. Only one task may wait.
    pub(super) async fn changed(&self) {
        self.changed.notified().await;
    }

    /// Records that an attempt at this location failed: the gateway may have ended.
    pub(super) fn suspect(&self, location: &Location, fault: TransportErrorKind) {
        let mut state = self.state.lock();
        if state.suspected.len() < MAX_SUSPECTED {
            state.suspected.insert(location.clone(), fault);
            self.changed.notify_one();
        }
    }

    /// Returns the locations at which attempts failed since the last call.
    pub(super) fn take_suspects(&self) -> HashMap<Location, TransportErrorKind> {
        std::mem::take(&mut self.state.lock().suspected)
    }

    /// Adds a connection on which this peer has introduced itself.
    pub(super) fn introduced(&self, peer: &Introduction) {
        let incarnation = peer.hop.location.incarnation();
        // Processes of this host open connections as well.
        if !peer.hop.is_remote() || !incarnation.is_known() {
            return;
        }
        let mut state = self.state.lock();
        let before = state.present.get(&incarnation);
        if before.is_some_and(|before| before.principal != peer.hop.principal) {
            let (name, at) = (escape_name(&peer.name), &peer.hop.location);
            log_limit::info!(of: source(at), %name, %at, "ignored a connection with another certificate");
            return;
        }
        let neighbor = state.neighbor(peer, before);
        if let Err(error) = neighbor.entry.check() {
            log_limit::info!(of: source(&peer.hop.location), error = %ErrorChain(&error), at = %peer.hop.location, "ignored a gateway with an invalid entry");
            return;
        }
        let changed = before.is_none_or(|before| !Arc::ptr_eq(&before.entry, &neighbor.entry));
        let is_new = before.is_none();
        if is_new {
            let security = security(peer.hop.principal);
            log_limit::info!(
                of: source(&peer.hop.location), name = %escape_name(&peer.name),
                at = %peer.hop.location,
                encrypted = security.encrypted,
                certificate = security.certificate.as_deref(),
                "connected with a gateway"
            );
        }
        if is_new && state.is_namesake(&peer.name) {
            log_limit::warn!(
                of: source(&peer.hop.location), "the gateway at {} has the name of this gateway, {}: logs and lists do not tell the hosts \
                 apart; set mts.name on one of them",
                peer.hop.location,
                escape_name(&peer.name)
            );
        }
        state.present.insert(incarnation, neighbor);
        self.generation.fetch_add(1, Ordering::Release);
        state
            .disconnected
            .retain(|gone| gone.entry.incarnation != incarnation);
        if changed {
            self.changed.notify_one();
        }
    }

    /// Removes a connection of this peer that has ended.
    pub(super) fn disconnected(&self, now: Instant, peer: &Introduction) {
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
            // A location that only this connection had is removed.
            if known.locate() {
                self.generation.fetch_add(1, Ordering::Release);
                self.changed.notify_one();
            }
            return;
        }
        if let Some(gone) = state.present.remove(&incarnation) {
            state.record_disconnected(Disconnected {
                at: now,
                entry: gone.entry,
                principal: gone.principal,
            });
        }
        self.generation.fetch_add(1, Ordering::Release);
        self.changed.notify_one();
        log_limit::info!(of: source(&peer.hop.location), name = %escape_name(&peer.name), at = %peer.hop.location, "no longer connected");
    }

    /// Returns the hosts that were connected within the last hour and are not, the latest first.
    pub(super) fn lost(&self, now: Instant) -> Vec<LostHost> {
        let state = self.state.lock();
        let mut lost: Vec<&Disconnected> = Vec::new();
        for gone in state.disconnected.iter().rev() {
            let is_over = gone.at + LOST <= now;
            let is_back = state.present.values().any(|it| gone.is_back_as(it));
            let is_same = |later: &&Disconnected| {
                later.entry.name == gone.entry.name && later.principal == gone.principal
            };
            if !is_over && !is_back && !lost.iter().any(is_same) {
                lost.push(gone);
            }
        }
        let reported = |gone: &Disconnected| LostHost {
            name: gone.entry.name.to_string(),
            seconds: now.saturating_duration_since(gone.at).as_secs(),
            certificate: security(gone.principal).certificate,
        };
        lost.into_iter().map(reported).collect()
    }

    /// Returns the gateways to greet from the current locations of this one, by name and location:
    /// the connected ones, and those that were connected within the last [`STILL_GREETED`].
    pub(super) fn to_greet(&self, now: Instant) -> Vec<(Arc<str>, Location)> {
        let state = self.state.lock();
        let present = state.present.values().map(|neighbor| &neighbor.entry);
        let recent = state.disconnected.iter();
        let recent = recent.filter(|gone| gone.at + STILL_GREETED > now);
        let recent = recent.map(|gone| &gone.entry);
        let all = present.chain(recent).flat_map(|entry| {
            // The transports race the locations of one kind, so one of each kind is enough.
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
    /// Whether a neighbor has the name of this gateway, and is the first one.
    fn is_namesake(&mut self, name: &str) -> bool {
        let is_same = self.own_name.as_deref() == Some(name);
        is_same && !std::mem::replace(&mut self.has_namesake, true)
    }

    /// Stores a disconnected neighbor. The oldest one makes room, first one of the same peer.
    fn record_disconnected(&mut self, gone: Disconnected) {
        let same = self.disconnected.iter().enumerate();
        let same = same.filter(|(_, it)| it.entry.peer == gone.entry.peer);
        let same: Vec<usize> = same.map(|(place, _)| place).collect();
        match same.first() {
            Some(oldest) if same.len() >= MAX_DISCONNECTED_OF_PEER => {
                self.disconnected.remove(*oldest);
            }
            _ if self.disconnected.len() >= MAX_DISCONNECTED => {
                self.disconnected.pop_front();
            }
            _ => {}
        }
        self.disconnected.push_back(gone);
    }

    /// Returns the neighbor with this new connection, based on its state before.
    fn neighbor(&self, peer: &Introduction, before: Option<&Neighbor>) -> Neighbor {
        let incarnation = peer.hop.location.incarnation();
        let named = |listed: &&Peer| {
            let dialed = peer.dialed.as_ref();
            dialed.is_some_and(|dialed| listed.locations.contains(dialed))
        };
        let listed = self.static_peers.iter().find(named);
        if let Some(listed) = listed
            && *listed.name != *peer.name
        {
            let (name, says) = (escape_name(&listed.name), escape_name(&peer.name));
            log_limit::info!(of: &*listed.name, %name, %says, "a static peer has another name than in discovery.static");
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
            mts: MtsId::new(Arc::clone(&peer.name), incarnation),
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
            peer: PeerId::of(peer.hop.principal, Some(&peer.hop.location)),
            role: Role::Gateway,
        };
        let mut neighbor = before.cloned().unwrap_or_else(|| Neighbor {
            entry: Arc::new(entry),
            configured: Vec::new(),
            hops: Vec::new(),
            since: Instant::now(),
            connections: 0,
            principal: peer.hop.principal,
            mandate: peer.mandate.clone(),
            peer: None,
        });
        if let Some(listed) = listed
            && neighbor.peer.is_none()
        {
            neighbor.peer = Some(Arc::clone(&listed.name));
            neighbor.configured = configured;
            Arc::make_mut(&mut neighbor.entry).source = Source::Static;
        }
        neighbor.connections += 1;
        neighbor.hops.push(peer.hop.location.clone());
        neighbor.locate();
        neighbor
    }
}

impl Neighbor {
    /// Updates the locations of the entry and returns whether they have changed. First come the
    /// locations of the open connections, the latest first. Then come the configured locations over
    /// transports without an open connection. The other configured locations are left out: the peer
    /// may not have such an address now, and each letter to it would wait for an answer.
    fn locate(&mut self) -> bool {
        let hops: Vec<&Location> = self.hops.iter().rev().collect();
        let is_open = |kind| hops.iter().any(|hop| hop.kind() == kind);
        // Locations at an address of an open connection come first.
        let configured = self.configured.iter();
        let mut others: Vec<&Location> = configured.filter(|it| !is_open(it.kind())).collect();
        others.sort_by_key(|location| !hops.iter().any(|hop| hop.host() == location.host()));
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

/// Returns the host at this location, by which log lines are counted.
fn source(location: &Location) -> PeerId {
    PeerId::of(Principal::Unproved, Some(location))
}

/// The directory in which the gateway looks up receivers: all directories, and the neighbors by
/// their incarnation.
pub(crate) struct View {
    pub(crate) all: MergedDirectory,
    pub(crate) neighbors: Arc<Neighbors>,
}

impl Directory for View {
    fn known(&self, name: &str) -> Option<Arc<Entry>> {
        self.all.known(name)
    }

    fn known_incarnation(&self, incarnation: Incarnation) -> Option<Arc<Entry>> {
        let listed = self.all.known_incarnation(incarnation);
        let state = self.neighbors.state.lock();
        let neighbor = state.present.get(&incarnation).map(|it| &it.entry);
        unless_claimed(listed, neighbor)
    }

    fn refresh(&self) {
        self.all.refresh();
    }

    fn entries(&self) -> Arc<[Arc<Entry>]> {
        self.all.entries()
    }

    fn generation(&self) -> u64 {
        let neighbors = self.neighbors.generation.load(Ordering::Acquire);
        self.all.generation().wrapping_add(neighbors)
    }

    fn view(&self) -> Arc<dyn DirectoryView> {
        let state = self.neighbors.state.lock();
        let present = state.present.iter();
        let present = present.map(|(gateway, it)| (*gateway, Arc::clone(&it.entry)));
        Arc::new(PresentView {
            all: self.all.view(),
            neighbors: present.collect(),
        })
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

/// Returns the listed entry of an incarnation, or that of the connected gateway that has it: other hosts list what
/// they choose.
fn unless_claimed(listed: Option<Arc<Entry>>, neighbor: Option<&Arc<Entry>>) -> Option<Arc<Entry>> {
    let listed = listed.filter(|it| it.reach == Reach::Local || neighbor.is_none());
    listed.or_else(|| neighbor.cloned())
}

/// A [`View`] at one time.
struct PresentView {
    all: Arc<dyn DirectoryView>,
    neighbors: HashMap<Incarnation, Arc<Entry>>,
}

impl DirectoryView for PresentView {
    fn named(&self, name: &str) -> Option<Arc<Entry>> {
        self.all.named(name)
    }

    fn registered(&self, incarnation: Incarnation) -> Option<Arc<Entry>> {
        let listed = self.all.registered(incarnation);
        unless_claimed(listed, self.neighbors.get(&incarnation))
    }

    fn all(&self) -> Arc<[Arc<Entry>]> {
        self.all.all()
    }

    fn lost_agents(&self) -> Vec<Arc<Entry>> {
        self.all.lost_agents()
    }

    fn lost_agent(&self, name: &str) -> Option<Arc<Entry>> {
        self.all.lost_agent(name)
    }
}

#[cfg(test)]
mod tests {
    use fipa_transport::Hop;

    use super::*;

    const GATEWAY: Incarnation = Incarnation::from_u64(7);

    #[test]
    fn an_agent_with_the_incarnation_of_a_connected_gateway_takes_nothing_from_it() {
        let entry = |name: &str, reach| {
            let directory = fipa_sds::MemoryDirectory::new(MtsId::new("mts", GATEWAY));
            let agent = Registration::new(name, GATEWAY, Vec::new());
            let entry = directory.register(agent).unwrap();
            Arc::new(Entry {
                reach,
                ..Entry::clone(&entry)
            })
        };
        let elsewhere = Reach::Remote { gateway: GATEWAY };
        let gateway = entry("crex-mts", elsewhere);
        let found = |listed: Option<Arc<Entry>>, neighbor| {
            unless_claimed(listed, neighbor).map(|it| it.name.to_string())
        };
        let claim = || Some(entry("stray", elsewhere));
        assert_eq!(found(claim(), Some(&gateway)).as_deref(), Some("crex-mts"));
        assert_eq!(found(claim(), None).as_deref(), Some("stray"));
        let own = Some(entry("own", Reach::Local));
        assert_eq!(found(own, Some(&gateway)).as_deref(), Some("own"));
        assert_eq!(found(None, None), None);
    }

    fn at(address: &str) -> Location {
        let location: Location = format!("tcp://{address}").parse().unwrap();
        location.with_incarnation(GATEWAY)
    }

    /// Creates the introduction of the gateway on a connection from this address.
    fn introduction(address: &str, dialed: Option<&str>) -> Introduction {
        Introduction {
            name: "crex-mts".into(),
            hop: Hop {
                location: at(address),
                principal: Principal::Unproved,
            },
            dialed: dialed.map(|text| text.parse().unwrap()),
            mandate: Mandate::Unproved,
        }
    }

    fn locations(neighbors: &Neighbors) -> Vec<Location> {
        neighbors.all()[0].entry.locations.clone()
    }

    #[test]
    fn a_neighbor_is_where_its_latest_connection_comes_from() {
        let (neighbors, now) = (Neighbors::default(), Instant::now());
        let (before, after) = (
            introduction("10.0.0.2:1", None),
            introduction("10.0.0.3:1", None),
        );
        neighbors.introduced(&before);
        neighbors.introduced(&after);
        assert_eq!(locations(&neighbors), [at("10.0.0.3:1"), at("10.0.0.2:1")]);
        neighbors.introduced(&after);
        neighbors.disconnected(now, &before);
        neighbors.disconnected(now, &after);
        assert_eq!(locations(&neighbors), [at("10.0.0.3:1")]);
        assert_eq!(neighbors.all()[0].connections, 1);
        neighbors.disconnected(now, &after);
        assert!(neighbors.all().is_empty());
    }

    #[test]
    fn what_the_configuration_says_counts_where_no_connection_is_open() {
        let (neighbors, now) = (Neighbors::default(), Instant::now());
        neighbors.name_peers(vec![Peer {
            name: "crex".into(),
            locations: ["tcp://crex.local:1", "udp://crex.local:1"]
                .map(|text| text.parse().unwrap())
                .to_vec(),
        }]);
        let (accepted, dialed) = (
            introduction("10.0.0.2:1", None),
            introduction("10.0.0.2:1", Some("tcp://crex.local:1")),
        );
        neighbors.introduced(&accepted);
        assert_eq!(neighbors.all()[0].peer, None);
        neighbors.introduced(&dialed);
        // Letters use no other address of this kind while a connection shows the current one.
        let udp: Location = "udp://crex.local:1".parse().unwrap();
        let known = [at("10.0.0.2:1"), udp.with_incarnation(GATEWAY)];
        assert_eq!(locations(&neighbors), known);
        assert_eq!(neighbors.all()[0].peer.as_deref(), Some("crex"));
        neighbors.disconnected(now, &dialed);
        assert_eq!(locations(&neighbors), known);
    }

    #[test]
    fn one_neighbor_with_the_name_of_this_gateway_is_reported() {
        let neighbors = Neighbors::default();
        neighbors.name_own("crex-mts");
        let mut state = neighbors.state.lock();
        assert!(!state.is_namesake("sherpa-mts"));
        assert!(state.is_namesake("crex-mts"));
        assert!(!state.is_namesake("crex-mts"));
    }

    #[test]
    fn the_security_of_a_link_is_that_of_its_proof() {
        let proved = security(Principal::Certificate([0xa5; 32]));
        assert!(proved.encrypted);
        assert_eq!(proved.certificate, Some("a5".repeat(32)));
        for open in [Principal::Unproved, Principal::Host] {
            assert_eq!(security(open), LinkSecurity::default());
        }
    }

    #[test]
    fn those_that_have_parted_are_greeted_for_a_while() {
        let (neighbors, now) = (Neighbors::default(), Instant::now());
        let one = introduction("10.0.0.2:1", None);
        let greeted = vec![("crex-mts".into(), at("10.0.0.2:1"))];
        neighbors.introduced(&one);
        assert_eq!(neighbors.to_greet(now), greeted);
        neighbors.disconnected(now, &one);
        assert_eq!(neighbors.to_greet(now + STILL_GREETED / 2), greeted);
        assert_eq!(neighbors.to_greet(now + STILL_GREETED), []);
    }

    /// Creates the introduction of a gateway of this name, with the certificate of this number.
    fn proved(name: &str, address: &str, incarnation: u64, certificate: u8) -> Introduction {
        let location = at(address).with_incarnation(Incarnation::from_u64(incarnation));
        Introduction {
            name: name.into(),
            hop: Hop {
                location,
                principal: Principal::Certificate([certificate; 32]),
            },
            ..introduction(address, None)
        }
    }

    #[test]
    fn a_host_that_is_gone_is_lost_until_it_returns() {
        let (neighbors, now) = (Neighbors::default(), Instant::now());
        let lost = |seconds| {
            let lost = neighbors.lost(now + Duration::from_secs(seconds));
            let lost = lost.into_iter().map(|host| (host.name, host.seconds));
            lost.collect::<Vec<_>>()
        };
        let crex = proved("crex-mts", "10.0.0.2:1", 1, 1);
        neighbors.introduced(&crex);
        assert_eq!(lost(0), []);
        neighbors.disconnected(now, &crex);
        assert_eq!(lost(75), [("crex-mts".to_owned(), 75)]);
        // Another host that claims the name.
        neighbors.introduced(&proved("crex-mts", "10.0.0.3:1", 2, 2));
        assert_eq!(lost(75).len(), 1);
        // The host after its restart.
        let restarted = proved("crex-mts", "10.0.0.2:1", 3, 1);
        neighbors.introduced(&restarted);
        assert_eq!(lost(75), []);
        neighbors.disconnected(now + Duration::from_secs(100), &restarted);
        assert_eq!(lost(110), [("crex-mts".to_owned(), 10)], "listed once");
        assert_eq!(lost(3700), []);
    }

    #[test]
    fn a_peer_that_reconnects_under_many_names_hides_no_lost_host() {
        let (neighbors, now) = (Neighbors::default(), Instant::now());
        let part = |peer: Introduction| {
            neighbors.introduced(&peer);
            neighbors.disconnected(now, &peer);
        };
        part(proved("crex-mts", "10.0.0.2:1", 1, 1));
        for number in 2..200 {
            part(proved(&format!("x{number}"), "10.0.0.3:1", number, 2));
        }
        let lost = neighbors.lost(now);
        assert_eq!(lost.len(), 1 + MAX_DISCONNECTED_OF_PEER);
        assert_eq!(lost.last().map(|host| host.name.as_str()), Some("crex-mts"));
    }
}
