//! The directory of a simulation, as each process sees it.

use std::sync::Arc;
use std::time::{Instant, SystemTime};

use fipa_sds::{Directory, Entry, MtsId, Reach, Role, Source, Subscriber};
use fipa_transport::{Incarnation, Kind, Location};
use parking_lot::Mutex;

use super::{Map, Set};

/// All registrations of a simulation, and the times at which each host learns of them.
#[derive(Default)]
pub(super) struct Registry {
    entries: Vec<Registered>,
    by_incarnation: Map<Incarnation, usize>,
    by_name: Map<Arc<str>, Vec<usize>>,
    gateways: Vec<usize>,
    /// Changes of a gateway's address.
    readdressed: Vec<Readdressed>,
    /// Entries as processes see them, by index of the registration, host of the viewer, and whether
    /// the viewer is its gateway. An entry changes only with its locations.
    seen: Map<(usize, usize, bool), (Reached, Arc<Entry>)>,
    /// Time at which each process last began to refresh its view.
    refreshed: Map<Incarnation, Instant>,
    pub(super) now: Option<Instant>,
}

pub(super) struct Registered {
    pub(super) name: Arc<str>,
    pub(super) incarnation: Incarnation,
    pub(super) host: usize,
    pub(super) mts: Incarnation,
    pub(super) role: Role,
    pub(super) since: Instant,
    pub(super) ended: Option<Instant>,
    /// Time at which each host learns of it.
    pub(super) known: Vec<Instant>,
    /// Time at which each host learns of its end, once it has ended.
    pub(super) left_at: Vec<Instant>,
}

/// Two locations: kind, service, and number of the address.
type Reached = [(Kind, Incarnation, usize); 2];

struct Readdressed {
    host: usize,
    kind: Kind,
    known: Vec<Instant>,
}

impl Registered {
    fn is_seen(&self, host: usize, now: Option<Instant>) -> bool {
        let past = |times: &[Instant]| times.get(host).is_some_and(|at| now >= Some(*at));
        past(&self.known) && !past(&self.left_at)
    }
}

impl Registry {
    /// Records that this process has refreshed its view, which shows the registrations on its host
    /// from before `began`.
    pub(super) fn refreshed(&mut self, mts: Incarnation, began: Instant) {
        let latest = self.refreshed.entry(mts).or_insert(began);
        *latest = (*latest).max(began);
    }

    /// Whether the view shows this registration.
    fn is_seen_by(&self, view: &View, registered: &Registered) -> bool {
        let refreshed = self.refreshed.get(&view.mts);
        if registered.host == view.host
            && registered
                .ended
                .is_some_and(|ended| refreshed.is_some_and(|at| *at >= ended))
        {
            return false;
        }
        if registered.is_seen(view.host, self.now) {
            return true;
        }
        let has_read = registered.mts == view.mts
            || self
                .refreshed
                .get(&view.mts)
                .is_some_and(|at| *at >= registered.since);
        registered.host == view.host && registered.left_at.is_empty() && has_read
    }

    pub(super) fn register(&mut self, registered: Registered) {
        let place = self.entries.len();
        self.by_incarnation.insert(registered.incarnation, place);
        let named = self.by_name.entry(Arc::clone(&registered.name));
        named.or_default().push(place);
        if registered.role == Role::Gateway {
            self.gateways.push(place);
        }
        self.entries.push(registered);
    }

    /// Ends this registration, which each host learns at its own time.
    pub(super) fn end(&mut self, incarnation: Incarnation, left_at: &[Instant]) {
        if let Some(place) = self.by_incarnation.get(&incarnation) {
            self.entries[*place].left_at = left_at.to_vec();
            self.entries[*place].ended = self.now;
        }
    }

    /// Changes the address of one kind of this host's gateway, which each host learns at its own
    /// time.
    pub(super) fn readdress(&mut self, host: usize, kind: Kind, known: Vec<Instant>) {
        self.readdressed.push(Readdressed { host, kind, known });
    }

    /// The address of this host's gateway that another host knows.
    fn address(&self, host: usize, kind: Kind, seen_from: usize) -> usize {
        let changes = self.readdressed.iter();
        let known = changes.filter(|change| {
            (change.host, change.kind) == (host, kind) && self.now >= Some(change.known[seen_from])
        });
        known.count()
    }

    /// The current address of this host's gateway.
    pub(super) fn present_address(&self, host: usize, kind: Kind) -> usize {
        self.address(host, kind, host)
    }

    fn gateway(&self, host: usize, seen_from: usize) -> Option<Incarnation> {
        let gateways = self
            .gateways
            .iter()
            .rev()
            .map(|place| &self.entries[*place]);
        let mut gateways = gateways.filter(|gateway| gateway.host == host);
        let found = gateways.find(|gateway| gateway.is_seen(seen_from, self.now))?;
        Some(found.mts)
    }
}

pub(super) struct View {
    pub(super) registry: Arc<Mutex<Registry>>,
    pub(super) host: usize,
    pub(super) gateway: bool,
    /// The process that has the view.
    pub(super) mts: Incarnation,
}

impl View {
    fn entry(&self, registry: &mut Registry, place: usize) -> Option<Arc<Entry>> {
        let registered = registry.entries.get(place)?;
        if !registry.is_seen_by(self, registered) {
            return None;
        }
        let (locations, reach) = if registered.host == self.host {
            let mts = registered.mts;
            ([(Kind::Shm, mts, 0), (Kind::Tcp, mts, 0)], Reach::Local)
        } else if self.gateway {
            let host = registered.host;
            let gateway = registry.gateway(host, self.host)?;
            let address = |kind| (kind, gateway, registry.address(host, kind, self.host));
            let locations = [address(Kind::Udp), address(Kind::Tcp)];
            (locations, Reach::Remote { gateway })
        } else {
            // Other processes know only agents to which the gateway has a route.
            registry.gateway(registered.host, self.host)?;
            let gateway = registry.gateway(self.host, self.host)?;
            let locations = [(Kind::Shm, gateway, 0), (Kind::Tcp, gateway, 0)];
            (locations, Reach::Remote { gateway })
        };
        let key = (place, self.host, self.gateway);
        if let Some((reached, entry)) = registry.seen.get(&key)
            && *reached == locations
        {
            return Some(Arc::clone(entry));
        }
        let reached = locations;
        let locations = reached.map(|(kind, mts, address)| way(kind, mts, address));
        let entry = Arc::new(Entry {
            name: Arc::clone(&registered.name),
            agent_type: String::new(),
            incarnation: registered.incarnation,
            locations: locations.to_vec(),
            mts: MtsId::new("mts", registered.mts),
            description: String::new(),
            registered: SystemTime::UNIX_EPOCH,
            source: Source::Host,
            reach,
            peer: fipa_transport::PeerId::THIS_HOST,
            role: registered.role.clone(),
        });
        registry.seen.insert(key, (reached, Arc::clone(&entry)));
        Some(entry)
    }
}

impl Directory for View {
    fn known(&self, name: &str) -> Option<Arc<Entry>> {
        let mut registry = self.registry.lock();
        // The registration that has the name keeps it until its end is known.
        let count = registry.by_name.get(name)?.len();
        (0..count).find_map(|nth| {
            let place = *registry.by_name.get(name)?.get(nth)?;
            self.entry(&mut registry, place)
        })
    }

    fn known_incarnation(&self, incarnation: Incarnation) -> Option<Arc<Entry>> {
        let mut registry = self.registry.lock();
        let place = *registry.by_incarnation.get(&incarnation)?;
        self.entry(&mut registry, place)
    }

    fn entries(&self) -> Arc<[Arc<Entry>]> {
        let mut registry = self.registry.lock();
        let mut names = Set::default();
        (0..registry.entries.len())
            .filter_map(|place| self.entry(&mut registry, place))
            .filter(|entry| names.insert(Arc::clone(&entry.name)))
            .collect()
    }

    fn generation(&self) -> u64 {
        0
    }

    fn subscribe(&self, _: &Subscriber) {}
}

/// The location of a service. The number stands for the address of its host, which may change.
pub(super) fn way(kind: Kind, mts: Incarnation, address: usize) -> Location {
    Location::new(kind, &format!("{mts}:{address}"))
        .expect("an address")
        .with_incarnation(mts)
}

/// The number of the address in a location.
pub(super) fn address_of(location: &Location) -> Option<usize> {
    location.address().rsplit_once(':')?.1.parse().ok()
}
