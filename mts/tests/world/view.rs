//! The directory of a simulated world, as it is seen from each of its processes.

use std::collections::HashSet;
use std::sync::Arc;
use std::time::{Instant, SystemTime};

use fipa_sds::{Directory, Entry, Mts, Reach, Role, Source, Subscriber};
use fipa_transport::{Incarnation, Kind, Location};
use parking_lot::Mutex;

/// What everybody knows of everybody, as a directory seen from one process.
#[derive(Default)]
pub(super) struct Registry {
    pub(super) entries: Vec<Registered>,
    pub(super) now: Option<Instant>,
}

pub(super) struct Registered {
    pub(super) name: Arc<str>,
    pub(super) incarnation: Incarnation,
    pub(super) host: usize,
    pub(super) mts: Incarnation,
    pub(super) role: Role,
    /// When it is known on each host, if not from the beginning.
    pub(super) known: Vec<Instant>,
    /// When it is known on each host that it has left, once it has.
    pub(super) left: Vec<Instant>,
}

impl Registered {
    fn is_seen(&self, host: usize, now: Option<Instant>) -> bool {
        let past = |times: &[Instant]| Some(*times.get(host)? <= now?);
        past(&self.known).unwrap_or(true) && !past(&self.left).unwrap_or(false)
    }
}

pub(super) struct View {
    pub(super) registry: Arc<Mutex<Registry>>,
    pub(super) host: usize,
    pub(super) gateway: bool,
}

impl View {
    fn entry(&self, registry: &Registry, registered: &Registered) -> Option<Arc<Entry>> {
        let gateway_of = |host: usize| {
            let mut all = registry.entries.iter();
            all.find(|e| e.role == Role::Gateway && e.host == host)
                .map(|e| e.mts)
        };
        let (locations, reach) = if registered.host == self.host {
            (
                vec![
                    way(Kind::Shm, registered.mts),
                    way(Kind::Tcp, registered.mts),
                ],
                Reach::Local,
            )
        } else if self.gateway {
            let gateway = gateway_of(registered.host)?;
            let ways = vec![way(Kind::Udp, gateway), way(Kind::Tcp, gateway)];
            (ways, Reach::Remote { gateway })
        } else {
            let gateway = gateway_of(self.host)?;
            let ways = vec![way(Kind::Shm, gateway), way(Kind::Tcp, gateway)];
            (ways, Reach::Remote { gateway })
        };
        Some(Arc::new(Entry {
            name: Arc::clone(&registered.name),
            agent_type: String::new(),
            incarnation: registered.incarnation,
            locations,
            mts: Mts::new("mts", registered.mts),
            description: String::new(),
            registered: SystemTime::UNIX_EPOCH,
            source: Source::Host,
            reach,
            role: registered.role.clone(),
        }))
    }

    fn find(&self, matches: impl Fn(&Registered) -> bool) -> Option<Arc<Entry>> {
        let registry = self.registry.lock();
        let mut seen = registry
            .entries
            .iter()
            .filter(|entry| entry.is_seen(self.host, registry.now));
        let found = seen.find(|entry| matches(entry))?;
        self.entry(&registry, found)
    }
}

impl Directory for View {
    fn known(&self, name: &str) -> Option<Arc<Entry>> {
        self.find(|entry| *entry.name == *name)
    }

    fn known_incarnation(&self, incarnation: Incarnation) -> Option<Arc<Entry>> {
        self.find(|entry| entry.incarnation == incarnation)
    }

    fn entries(&self) -> Arc<[Arc<Entry>]> {
        let registry = self.registry.lock();
        // Who has the name keeps it, until it is known to have left.
        let mut names = HashSet::new();
        registry
            .entries
            .iter()
            .filter(|entry| entry.is_seen(self.host, registry.now))
            .filter(|entry| names.insert(Arc::clone(&entry.name)))
            .filter_map(|entry| self.entry(&registry, entry))
            .collect()
    }

    fn generation(&self) -> u64 {
        0
    }

    fn subscribe(&self, _: &Subscriber) {}
}

pub(super) fn way(kind: Kind, mts: Incarnation) -> Location {
    Location::new(kind, &mts.to_string())
        .expect("an address")
        .with_incarnation(mts)
}
