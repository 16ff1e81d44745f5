//! The directory of the local network: DNS-SD over multicast DNS.
//!
//! Every agent that a gateway announces is one record of the service type
//! `_fipa_service_directory._udp`, which Avahi's tools and the C++ peers read as well; the format
//! is in `record`. Multicast that fails, or is blocked, is never fatal: the
//! [status](MdnsDirectory::status) says so.
//!
//! A name belongs to the earlier registration. The directory whose registration is the later one
//! withdraws it and [tells](MdnsDirectory::withdrawals); nothing is ever renamed. The instance
//! label of a record, on the other hand, means nothing between us: if it is taken by another
//! name, another one is used.

mod anew;
mod beacon;
mod browse;
mod ear;
#[cfg(feature = "fuzzing")]
pub(crate) mod fuzzing;
mod held;
mod pace;
mod packet;
mod probe;
mod record;
mod sockets;
mod task;
mod together;

use std::collections::{HashMap, HashSet};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use fipa_transport::Incarnation;
use mdns_sd::{DaemonStatus, IfKind, Receiver, ServiceDaemon, ServiceInfo, TxtProperty};
use parking_lot::Mutex;
use tokio::sync::{Notify, broadcast};

use self::beacon::Digest;
use self::held::Holdings;
use self::pace::Pace;
pub use self::probe::{Multicast, probe};
use self::together::{Together, Updates};
use crate::table::Table;
use crate::{
    DeregisterError, Directory, Entry, Mts, RegisterError, Registration, Role, Source, Subscriber,
    Updated,
};

/// The type of the records, 22 characters long.
const SERVICE_TYPE: &str = "_fipa_service_directory._udp.local.";
/// More than the 15 that DNS-SD allows; without asking for it nothing is announced.
const SERVICE_NAME_LEN: u8 = 22;
/// The port of multicast DNS.
const MDNS_PORT: u16 = 5353;
/// Largest TXT record announced, in bytes: it has to fit one packet of 9000 bytes with the rest
/// (RFC 6762 clause 17).
const MAX_TXT: usize = 8000;

/// How a gateway takes part in the directory of the network.
#[derive(Debug, Clone)]
pub struct MdnsConfig {
    /// The gateway that announces, and takes letters for, what is registered.
    pub mts: Mts,
    /// The interfaces used, by name or address; none means all of them, loopback included.
    pub interfaces: Vec<String>,
    /// The UDP port, 5353; another one makes a directory of its own.
    pub port: u16,
}

impl MdnsConfig {
    /// All interfaces, and the usual port.
    #[must_use]
    pub fn new(mts: Mts) -> Self {
        Self {
            mts,
            interfaces: Vec::new(),
            port: MDNS_PORT,
        }
    }
}

/// The agents that other gateways announce on the local network, and what this one announces.
///
/// Its view has the others' only: a gateway knows its own better. Takes back what it has
/// announced when dropped.
#[derive(Debug)]
pub struct MdnsDirectory {
    shared: Arc<Shared>,
    task: tokio::task::JoinHandle<()>,
}

/// A registration that was taken back because somebody else has had the name for longer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Withdrawal {
    /// What was registered here.
    pub withdrawn: Arc<Entry>,
    /// Who has the name.
    pub holder: Arc<Entry>,
}

/// How the directory of the network fares.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct MdnsStatus {
    /// How many registrations are announced.
    pub announced: usize,
    /// How many records of others are known.
    pub known: usize,
    /// How many records of others were not used: malformed, or too many.
    pub refused: u64,
    /// How often the mDNS library was started anew because it kept too much of what it heard.
    pub restarts: u64,
    /// What went wrong last, if anything did.
    pub last_error: Option<String>,
}

impl MdnsDirectory {
    /// Most records of others that are kept.
    pub const MAX_RECORDS: usize = 20_000;
    /// Most bytes that they say, all together.
    pub const MAX_BYTES: usize = 16 << 20;
    /// Most DNS records that the mDNS library keeps, each of at most 9,000 bytes. It keeps what
    /// comes in packets that introduce no service, for ever. It is looked at every two seconds.
    /// When there are more the library is started anew: our own agents are announced again without
    /// having said goodbye.
    pub const MAX_CACHED: u64 = anew::MAX_CACHED;

    /// Starts to listen; a task of the current tokio runtime keeps the view up to date. That
    /// multicast does not work is not an error here but part of the [status](Self::status).
    ///
    /// # Errors
    /// When there is no tokio runtime.
    pub fn open(config: MdnsConfig) -> Result<Self, MdnsError> {
        let runtime = tokio::runtime::Handle::try_current().map_err(|_| MdnsError::NoRuntime)?;
        let daemon = ServiceDaemon::new_with_port(config.port);
        let (daemon, failed) = match daemon {
            Ok(daemon) => (Some(daemon), None),
            Err(error) => (
                None,
                Some(format!("cannot open a multicast socket: {error}")),
            ),
        };
        let shared = Arc::new(Shared {
            daemon: Mutex::new(daemon),
            config,
            table: Table::new(),
            held: Mutex::default(),
            together: Mutex::default(),
            coalitions_changed: AtomicBool::new(false),
            interfaces_changed: AtomicBool::new(false),
            own: Mutex::default(),
            withdrawals: broadcast::channel(64).0,
            status: Mutex::new(MdnsStatus {
                last_error: failed,
                ..MdnsStatus::default()
            }),
            postponed: Notify::new(),
        });
        if let Some(daemon) = &*shared.daemon.lock() {
            shared.choose(daemon);
        }
        let task = runtime.spawn(task::run(Arc::clone(&shared)));
        Ok(Self { shared, task })
    }

    /// Tells of every registration that is withdrawn from now on. Who does not read for more
    /// than 64 of them misses the oldest.
    #[must_use]
    pub fn withdrawals(&self) -> broadcast::Receiver<Withdrawal> {
        self.shared.withdrawals.subscribe()
    }

    /// How it fares.
    #[must_use]
    pub fn status(&self) -> MdnsStatus {
        let mut status = self.shared.status.lock().clone();
        status.announced = self.shared.own.lock().agents.len();
        status.known = self.shared.table.len();
        status
    }

    /// Asks the network whether the record of this name is still there, because letters to it do
    /// not arrive. If nobody answers, it leaves within a few seconds, and with it all others of
    /// its gateway.
    pub fn verify(&self, name: &str) {
        let Some((fullname, entry)) = self.shared.table.holder(name) else {
            return;
        };
        match entry.mts.incarnation {
            Incarnation::UNKNOWN => {
                self.shared.held.lock().verify(&fullname);
                self.shared.postponed.notify_one();
            }
            gateway => self.verify_gateway(gateway),
        }
    }

    /// Asks the network whether this gateway is still there; see [`verify`](Self::verify). Asking
    /// again within a few seconds does nothing.
    pub fn verify_gateway(&self, gateway: Incarnation) {
        let doubted = self.shared.held.lock().doubt(Instant::now(), gateway);
        if doubted {
            self.shared.postponed.notify_one();
        }
    }

    /// This gateway has ended without a goodbye, and another one has its place: all that it announced is
    /// forgotten at once.
    pub fn gateway_has_ended(&self, gateway: Incarnation) {
        self.shared.held.lock().end(gateway);
        self.shared.postponed.notify_one();
    }

    /// The interfaces of this host have changed: speaks and listens on the new ones at once, rather
    /// than when it looks next.
    pub fn interfaces_changed(&self) {
        self.shared
            .interfaces_changed
            .store(true, Ordering::Relaxed);
        self.shared.postponed.notify_one();
    }

    /// Takes back everything that was announced, with a goodbye, and stops listening. Blocks for
    /// as long as it takes to send that. Doing it again does nothing.
    pub fn close(&self) {
        {
            let mut own = self.shared.own.lock();
            if std::mem::replace(&mut own.closed, true) {
                return;
            }
            own.agents.clear();
        }
        self.task.abort();
        // Whose coalitions are gone, too, says so: others wait for that.
        let (config, nothing) = (&self.shared.config, beacon::Announced::default());
        if let Some(beacon) = beacon::packet(config.mts.incarnation, nothing)
            && let Err(error) = sockets::send_once(config, &beacon)
        {
            tracing::debug!(%error, "the last beacon was not sent");
        }
        let Ok(Some(ended)) = self.shared.ask(ServiceDaemon::shutdown) else {
            return;
        };
        if ended.recv_timeout(Duration::from_secs(5)).is_err() {
            tracing::error!("multicast DNS did not say goodbye in time");
        }
    }
}

impl Drop for MdnsDirectory {
    fn drop(&mut self) {
        self.close();
    }
}

impl Directory for MdnsDirectory {
    reads_its_table!(shared.table);

    /// Announces the agent. Its locations are those at which this gateway takes letters for it.
    fn register(&self, registration: Registration) -> Result<Arc<Entry>, RegisterError> {
        let entry = registration.into_entry(&self.shared.config.mts, Source::Mdns)?;
        self.shared.register(&mut self.shared.own.lock(), entry)
    }

    fn deregister(&self, name: &str, incarnation: Incarnation) -> Result<(), DeregisterError> {
        let mut own = self.shared.own.lock();
        self.shared.deregister(&mut own, name, incarnation)
    }

    /// All in one go: coalitions among them are seen to change together.
    fn update(&self, leaving: &[(Arc<str>, Incarnation)], joining: Vec<Registration>) -> Updated {
        let mut own = self.shared.own.lock();
        let left = leaving
            .iter()
            .map(|(name, incarnation)| self.shared.deregister(&mut own, name, *incarnation))
            .collect();
        let joining = joining.into_iter().map(|registration| {
            let entry = registration.into_entry(&self.shared.config.mts, Source::Mdns)?;
            self.shared.register(&mut own, entry)
        });
        Updated {
            joined: joining.collect(),
            left,
        }
    }
}

/// Why the directory of the network was not opened.
#[derive(Debug, Clone, thiserror::Error)]
#[non_exhaustive]
pub enum MdnsError {
    /// A task is needed, and there is nobody to run it.
    #[error("the network's directory must be opened within a tokio runtime")]
    NoRuntime,
}

struct Shared {
    /// None when it could not be started, and while it rests after a flood.
    daemon: Mutex<Option<ServiceDaemon>>,
    config: MdnsConfig,
    /// The others' entries, by the full name of their record, spelt as they spell it.
    table: Table<Arc<str>>,
    /// The same records, by the gateways that announce them.
    held: Mutex<Holdings>,
    /// What of that is not in the table yet.
    together: Mutex<Together>,
    /// Whether others are to be told at once what coalitions there are.
    coalitions_changed: AtomicBool,
    /// Whether to look at the interfaces at once.
    interfaces_changed: AtomicBool,
    own: Mutex<Own>,
    withdrawals: broadcast::Sender<Withdrawal>,
    status: Mutex<MdnsStatus>,
    /// Tells the task that there is something to be announced later.
    postponed: Notify,
}

impl std::fmt::Debug for Shared {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Shared")
            .field("config", &self.config)
            .field("status", &self.status)
            .finish_non_exhaustive()
    }
}

#[derive(Debug, Default)]
struct Own {
    closed: bool,
    agents: HashMap<Arc<str>, Announced>,
    pace: Pace,
    /// Full names of which the daemon has just said goodbye, and until when they rest. It says so
    /// twice, and would take the second goodbye for somebody else's claim to the name.
    resting: HashMap<Arc<str>, Instant>,
    /// Full names that the daemon has renamed, and will rename ever after.
    spoilt: HashSet<Arc<str>>,
    /// What was announced when the daemon was ended, until there is another one: nobody hears of
    /// what changes meanwhile, and who was told of it would ask in vain.
    meanwhile: Option<beacon::Announced>,
    /// The names of records of which only the locations have changed, and which are announced at
    /// once: the daemon needs about two seconds for that.
    moved: Vec<Arc<str>>,
}

/// Most records that are announced at once; the others are by the daemon.
const MAX_MOVED: usize = 256;

impl Own {
    fn announced(&self) -> beacon::Announced {
        let mut announced = beacon::Announced::default();
        for one in self.agents.values() {
            if let Some((_, told)) = one.told {
                announced.all.add(told);
            }
            if matches!(one.entry.role, Role::Coalition(_)) {
                announced.coalitions.add(one.digest);
            }
        }
        announced
    }
}

#[derive(Debug)]
struct Announced {
    entry: Arc<Entry>,
    /// The full name of its record, in lower case.
    fullname: Arc<str>,
    /// The host of its record. Each has its own, because the daemon says goodbye to the host
    /// with the record.
    host: Incarnation,
    /// How many labels have been tried.
    attempt: u32,
    /// When this is to be announced, if it is not yet.
    due: Option<Instant>,
    digest: Digest,
    /// What the daemon has been told last, and when.
    told: Option<(Instant, Digest)>,
}

impl Announced {
    fn host_name(&self) -> String {
        format!("fipa-{}.local.", self.host)
    }
}

/// How long a record stays as it is before it is changed again (RFC 6762 clause 8.4). It is probed
/// for most of a second, announced twice a second apart, and only a second after that has the record
/// before left the caches: one that came back earlier would be taken for the one that leaves.
const SETTLING: Duration = Duration::from_secs(3);

/// The same for a record of which only the locations change: letters do not arrive until others know
/// them. It may be announced before the record before has left all caches.
const MOVING: Duration = Duration::from_secs(1);

/// How often the daemon looks at the interfaces: usually, and while they change.
const LOOKS: u32 = mdns_sd::IP_CHECK_INTERVAL_IN_SECS_DEFAULT;
const LOOKS_SOON: u32 = 1;

/// How long a full name rests after a goodbye.
const REST: Duration = Duration::from_secs(1);

/// Most full names remembered as spoilt.
const MAX_SPOILT: usize = 1024;

impl Shared {
    fn register(&self, own: &mut Own, entry: Entry) -> Result<Arc<Entry>, RegisterError> {
        if own.closed {
            return Err(RegisterError::Closed);
        }
        let announced = own.agents.get(&entry.name);
        let ours = announced.map(|announced| Arc::clone(&announced.entry));
        if let Some(holder) = ours.or_else(|| self.table.known(&entry.name))
            && holder.incarnation != entry.incarnation
        {
            return Err(RegisterError::AlreadyRegistered { holder });
        }
        let len: usize = record::encode(&entry)
            .iter()
            .map(|(key, value)| key.len() + value.len() + 2)
            .sum();
        if len > MAX_TXT {
            let why = format!("the record would have {len} bytes, and at most {MAX_TXT} fit");
            return Err(RegisterError::Full(why));
        }
        let entry = Arc::new(entry);
        let attempt = announced.map_or(0, |announced| announced.attempt);
        self.announce(own, &entry, attempt)
            .map_err(|error| RegisterError::Failed(Arc::new(error)))?;
        Ok(entry)
    }

    /// Announces the entry under the first label, from this attempt on, that is free; at once, or
    /// when the label has rested and it is its turn.
    fn announce(
        &self,
        own: &mut Own,
        entry: &Arc<Entry>,
        mut attempt: u32,
    ) -> Result<(), mdns_sd::Error> {
        let fullname = loop {
            let fullname = fullname(&record::label(&entry.name, attempt));
            let mut others = own.agents.iter().filter(|(name, _)| **name != entry.name);
            let free = others.all(|(_, other)| other.fullname != fullname);
            if free && !own.spoilt.contains(&fullname) {
                break fullname;
            }
            attempt += 1;
        };
        let rested = own.resting.get(&fullname).copied();
        let before = own.agents.get(&entry.name);
        let before = before.filter(|announced| announced.fullname == fullname);
        let now = Instant::now();
        let turn = match before {
            // What is announced already is changed when it has settled.
            Some(Announced {
                entry: before,
                told: Some((when, _)),
                ..
            }) => {
                let settling = match moves(before, entry) {
                    true => MOVING,
                    false => SETTLING,
                };
                if settling == MOVING && own.moved.len() < MAX_MOVED {
                    own.moved.push(Arc::clone(&entry.name));
                    self.postponed.notify_one();
                }
                Some(*when + settling).filter(|settled| *settled > now)
            }
            Some(waiting) => waiting.due,
            None => own.pace.turn(now, fastrand::f64()),
        };
        let mut announced = Announced {
            entry: Arc::clone(entry),
            digest: Digest::of(&record::encode(entry)),
            host: before.map_or_else(Incarnation::random, |announced| announced.host),
            due: rested.max(turn),
            told: before.and_then(|announced| announced.told),
            fullname,
            attempt,
        };
        if announced.due.is_some() {
            self.postponed.notify_one();
        } else {
            self.tell_daemon(&announced)?;
            announced.told = Some((now, announced.digest));
        }
        own.agents.insert(entry.name.clone(), announced);
        self.coalition_changed(entry);
        Ok(())
    }

    fn tell_daemon(&self, announced: &Announced) -> Result<(), mdns_sd::Error> {
        let label = record::label(&announced.entry.name, announced.attempt);
        let host = announced.host_name();
        let properties = record::encode(&announced.entry);
        let properties: Vec<TxtProperty> = properties.into_iter().map(TxtProperty::from).collect();
        // The port stands in the locations; the addresses are those of this host.
        let service = ServiceInfo::new(SERVICE_TYPE, &label, &host, "", 0, properties)?;
        let service = service.enable_addr_auto();
        self.ask(|daemon| daemon.register(service.clone()))?;
        Ok(())
    }

    /// Packets that announce the records of which only the locations have changed.
    fn moved(&self) -> Vec<Vec<u8>> {
        let mut own = self.own.lock();
        let moved = std::mem::take(&mut own.moved);
        let packets = moved.iter().filter_map(|name| {
            let announced = own.agents.get(name)?;
            let label = record::label(name, announced.attempt);
            let says = record::encode(&announced.entry);
            packet::announcement(&label, &announced.host_name(), &says)
        });
        packets.collect()
    }

    /// Announces what has been postponed and is due, and says when the next is.
    fn announce_due(&self) -> Option<Instant> {
        let mut own = self.own.lock();
        let now = Instant::now();
        own.resting.retain(|_, until| *until > now);
        for announced in own.agents.values_mut() {
            if announced.due.is_some_and(|due| due <= now) {
                announced.due = None;
                announced.told = Some((now, announced.digest));
                if let Err(error) = self.tell_daemon(announced) {
                    let name = &announced.entry.name;
                    self.failed(format!("cannot announce {name:?}: {error}"));
                }
            }
        }
        own.agents.values().filter_map(|one| one.due).min()
    }

    /// Takes the record back, with a goodbye.
    fn take_back(&self, own: &mut Own, name: &str) -> Result<(), mdns_sd::Error> {
        let Some(announced) = own.agents.get(name) else {
            return Ok(());
        };
        let now = Instant::now();
        own.resting.retain(|_, until| *until > now);
        if announced.told.is_some() {
            self.ask(|daemon| daemon.unregister(&announced.fullname))?;
            own.resting
                .insert(Arc::clone(&announced.fullname), now + REST);
        }
        if let Some(gone) = own.agents.remove(name) {
            self.coalition_changed(&gone.entry);
        }
        Ok(())
    }

    fn deregister(
        &self,
        own: &mut Own,
        name: &str,
        incarnation: Incarnation,
    ) -> Result<(), DeregisterError> {
        if own.closed {
            return Err(DeregisterError::Closed);
        }
        let announced = own.agents.get(name);
        if announced.is_none_or(|one| one.entry.incarnation != incarnation) {
            return Err(DeregisterError::NotRegistered(name.into()));
        }
        self.take_back(own, name)
            .map_err(|error| DeregisterError::Failed(Arc::new(error)))
    }

    /// Has the daemon look at the interfaces so often, the first time after that.
    fn daemon_looks(&self, seconds: u32) {
        if let Err(error) = self.ask(|daemon| daemon.set_ip_check_interval(seconds)) {
            self.failed(format!("cannot look at the interfaces: {error}"));
        }
    }

    /// Has the daemon use interfaces that are new, without waiting until it looks.
    fn daemon_adds_interfaces(&self) {
        let none = || Vec::<IfKind>::new();
        if let Err(error) = self.ask(|daemon| daemon.enable_interface(none())) {
            self.failed(format!("cannot use a new interface: {error}"));
        }
    }

    /// Gives the daemon something to do. It takes so many things at a time and asks others to
    /// come again, which is waited for; nothing at all happens when there is no daemon.
    fn ask<T>(
        &self,
        what: impl Fn(&ServiceDaemon) -> Result<T, mdns_sd::Error>,
    ) -> Result<Option<T>, mdns_sd::Error> {
        let Some(daemon) = self.daemon.lock().clone() else {
            return Ok(None);
        };
        let deadline = Instant::now() + Duration::from_secs(5);
        loop {
            match what(&daemon) {
                Err(mdns_sd::Error::Again) if Instant::now() < deadline => {
                    std::thread::sleep(Duration::from_millis(1));
                }
                done => return done.map(Some),
            }
        }
    }

    /// Ends the daemon, without a goodbye for what is announced, and gives what tells when that
    /// is done. Until another one is started nothing is announced or answered.
    fn end_daemon(&self) -> Result<Option<Receiver<DaemonStatus>>, mdns_sd::Error> {
        let Some(daemon) = self.daemon.lock().clone() else {
            return Ok(None);
        };
        // It says goodbye on the interfaces that it has.
        let ended = daemon.disable_interface(IfKind::All);
        let ended = match ended.and_then(|()| daemon.shutdown()) {
            // It has ended by itself.
            Err(mdns_sd::Error::DaemonShutdown) => None,
            ended => Some(ended?),
        };
        let mut own = self.own.lock();
        *self.daemon.lock() = None;
        own.meanwhile = Some(own.announced());
        Ok(ended)
    }

    /// Starts another daemon, and announces to it, at the usual pace, what was announced before.
    /// Says whether there is one now.
    fn start_daemon(&self) -> bool {
        // Whoever closes meanwhile waits, and then ends the new one.
        let mut own = self.own.lock();
        let own = &mut *own;
        if own.closed {
            return false;
        }
        let daemon = match ServiceDaemon::new_with_port(self.config.port) {
            Ok(daemon) => daemon,
            Err(error) => {
                self.failed(format!("cannot open a multicast socket again: {error}"));
                return false;
            }
        };
        self.choose(&daemon);
        *self.daemon.lock() = Some(daemon);
        own.meanwhile = None;
        let now = Instant::now();
        let agents = own.agents.values_mut();
        let mut before: Vec<_> = agents.filter(|one| one.told.is_some()).collect();
        // Another flood may end this one before it has told all: the next begins with the rest.
        before.sort_by_key(|one| one.told.map(|(when, _)| when));
        for announced in before {
            let turn = own.pace.turn(now, fastrand::f64());
            announced.due = announced.due.max(Some(turn.unwrap_or(now)));
        }
        true
    }

    fn choose(&self, daemon: &ServiceDaemon) {
        if let Err(error) = choose(daemon, &self.config.interfaces) {
            self.failed(format!("cannot choose the interfaces: {error}"));
        }
    }

    /// What the network says of a record now: this, or that it is gone.
    fn put(&self, fullname: &Arc<str>, entry: Option<Arc<Entry>>) {
        let now = Instant::now();
        self.held.lock().put(now, fullname, entry.as_deref());
        self.show(|together| together.put(now, fullname, entry));
    }

    /// Shows what is to be shown now, in one go.
    fn show(&self, what: impl FnOnce(&mut Together) -> Updates) {
        // Held until it is done, so that nothing overtakes.
        let mut together = self.together.lock();
        let updates = what(&mut together);
        if !updates.is_empty() {
            self.table.replace(updates);
        }
    }

    /// What this gateway announces; of the coalitions also what it will in a moment, because
    /// others are to wait for that.
    fn announced(&self) -> beacon::Announced {
        let own = self.own.lock();
        own.meanwhile.unwrap_or_else(|| own.announced())
    }

    /// Others are told at once, if this is about a coalition.
    fn coalition_changed(&self, entry: &Entry) {
        if matches!(entry.role, Role::Coalition(_)) {
            self.coalitions_changed.store(true, Ordering::Relaxed);
            self.postponed.notify_one();
        }
    }

    fn failed(&self, error: String) {
        tracing::warn!(%error, "multicast DNS");
        self.status.lock().last_error = Some(error);
    }
}

/// Whether two entries of a name differ in their locations only.
fn moves(before: &Entry, now: &Entry) -> bool {
    before.locations != now.locations
        && *now
            == Entry {
                locations: now.locations.clone(),
                ..before.clone()
            }
}

/// The full name of a record with this label, in lower case. Labels have no dots and no
/// backslashes, which would have to be escaped.
fn fullname(label: &str) -> Arc<str> {
    format!("{label}.{SERVICE_TYPE}").to_lowercase().into()
}

fn choose(daemon: &ServiceDaemon, interfaces: &[String]) -> Result<(), mdns_sd::Error> {
    daemon.set_service_name_len_max(SERVICE_NAME_LEN)?;
    if interfaces.is_empty() {
        return Ok(());
    }
    let chosen: Vec<IfKind> = interfaces
        .iter()
        .map(|interface| match interface.parse() {
            Ok(address) => IfKind::Addr(address),
            Err(_) => IfKind::Name(interface.clone()),
        })
        .collect();
    daemon.disable_interface(IfKind::All)?;
    daemon.enable_interface(chosen)
}
