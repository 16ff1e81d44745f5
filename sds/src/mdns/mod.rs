//! The directory of the local network: DNS-SD over multicast DNS.
//!
//! Every agent that a gateway announces is one record of the service type
//! `_fipa_service_directory._udp`, which Avahi's tools and the C++ peers read as well; module
//! `record` defines the format. Failed or blocked multicast is never fatal; it is reported in the
//! [status](MdnsDirectory::status).
//!
//! Agents of several gateways may have one name: all are announced, and a directory shows that which
//! was announced to it first. The instance label of a record has no meaning between gateways: a label
//! in use by another record is replaced by a different one.

mod alarm;
mod beacon;
mod browse;
mod coalition_sync;
#[cfg(feature = "fuzzing")]
pub(crate) mod fuzzing;
mod listener;
mod pace;
mod packet;
mod probe;
mod record;
mod relocations;
mod restart;
mod sockets;
mod task;
mod verification;

use std::collections::{HashMap, HashSet};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use fipa_transport::{Incarnation, log_limit};
use mdns_sd::{DaemonStatus, IfKind, Receiver, ServiceDaemon, ServiceInfo, TxtProperty};
use parking_lot::Mutex;
use tokio::sync::{Notify, watch};

use self::beacon::Digest;
use self::coalition_sync::{CoalitionSync, Updates};
use self::pace::Pace;
pub use self::probe::{Multicast, probe};
use self::relocations::Relocations;
use self::verification::Verification;
use crate::table::Table;
use crate::{
    DeregisterError, Directory, Entry, MtsId, RegisterError, Registration, Role, Source,
    Subscriber, Updated,
};

/// The type of the records, 22 characters long.
const SERVICE_TYPE: &str = "_fipa_service_directory._udp.local.";
/// Exceeds the 15 characters that DNS-SD allows; without this setting the library refuses to
/// announce.
const SERVICE_NAME_LEN: u8 = 22;
/// The port of multicast DNS.
const MDNS_PORT: u16 = 5353;
/// Largest TXT record that is announced, in bytes: with the other records it must fit a packet of
/// 9000 bytes (RFC 6762 clause 17).
const MAX_TXT: usize = 8000;

/// Configuration of [`MdnsDirectory`].
#[derive(Debug, Clone)]
pub struct MdnsConfig {
    /// The gateway that announces the registrations and accepts letters for them.
    pub mts: MtsId,
    /// Interfaces to use, by name or address; an empty list means all, including loopback.
    pub interfaces: Vec<String>,
    /// The UDP port, by default 5353; another port makes a separate directory.
    pub port: u16,
}

impl MdnsConfig {
    /// Creates a configuration with all interfaces and the standard port.
    #[must_use]
    pub fn new(mts: MtsId) -> Self {
        Self {
            mts,
            interfaces: Vec::new(),
            port: MDNS_PORT,
        }
    }
}

/// The agents that other gateways announce on the local network, and the announcements of this
/// gateway.
///
/// The view contains only agents of other gateways, because other back ends have this gateway's
/// own. Dropping the directory withdraws its announcements.
#[derive(Debug)]
pub struct MdnsDirectory {
    shared: Arc<Shared>,
    task: tokio::task::JoinHandle<()>,
}

/// Status of [`MdnsDirectory`].
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct MdnsStatus {
    /// Number of registrations that are announced.
    pub announced: usize,
    /// Number of known records of other hosts.
    pub known: usize,
    /// Number of refused records of other hosts: malformed, or beyond the limits.
    pub refused: u64,
    /// Number of restarts of the mDNS library because its cache was too large.
    pub restarts: u64,
    /// The latest error, if any.
    pub last_error: Option<String>,
}

impl MdnsDirectory {
    /// Maximum number of records of other hosts.
    pub const MAX_RECORDS: usize = 20_000;
    /// Maximum total size of their TXT records, in bytes.
    pub const MAX_BYTES: usize = 16 << 20;
    /// Maximum number of DNS records in the cache of the mDNS library, each of at most 9,000 bytes.
    /// The library keeps records of packets that introduce no service forever. The cache is checked
    /// every two to three seconds while packets arrive; beyond this limit the library is restarted,
    /// and this gateway's agents are announced again without a goodbye.
    pub const MAX_CACHED: u64 = restart::MAX_CACHED;

    /// Opens the directory; a task of the current tokio runtime keeps the view up to date. Failing
    /// multicast is not an error but part of the [status](Self::status).
    ///
    /// # Errors
    /// Fails when no tokio runtime is running.
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
            verification: Mutex::default(),
            coalition_sync: Mutex::default(),
            coalitions_changed: AtomicBool::new(false),
            closing: AtomicBool::new(false),
            // The addresses of a host that starts may not be usable yet.
            interfaces_changed: AtomicBool::new(true),
            own: Mutex::default(),
            status: Mutex::default(),
            last_error: watch::Sender::new(failed),
            postponed: Notify::new(),
        });
        if let Some(daemon) = &*shared.daemon.lock() {
            shared.choose(daemon);
        }
        let task = runtime.spawn(task::run(Arc::clone(&shared)));
        Ok(Self { shared, task })
    }

    /// Returns the current status.
    #[must_use]
    pub fn status(&self) -> MdnsStatus {
        let mut status = self.shared.status.lock().clone();
        status.announced = self.shared.own.lock().agents.len();
        status.known = self.shared.table.len();
        status
            .last_error
            .clone_from(&self.shared.last_error.borrow());
        status
    }

    /// Returns the [latest error](MdnsStatus::last_error) and its changes.
    #[must_use]
    pub fn last_error(&self) -> watch::Receiver<Option<String>> {
        self.shared.last_error.subscribe()
    }

    /// Queries the network for the record of this name, because letters to it do not arrive.
    /// Without an answer the entry is removed within a few seconds, together with all others of its
    /// gateway.
    pub fn verify(&self, name: &str) {
        let Some((fullname, entry)) = self.shared.table.holder(name) else {
            return;
        };
        match entry.mts.incarnation {
            Incarnation::UNKNOWN => {
                self.shared.verification.lock().verify(&fullname);
                self.shared.postponed.notify_one();
            }
            gateway => self.verify_gateway(gateway),
        }
    }

    /// Queries the network for this gateway; see [`verify`](Self::verify). A repeated call within a
    /// few seconds does nothing.
    pub fn verify_gateway(&self, gateway: Incarnation) {
        let suspected = self
            .shared
            .verification
            .lock()
            .suspect(Instant::now(), gateway);
        if suspected {
            self.shared.postponed.notify_one();
        }
    }

    /// Removes all entries of this gateway at once, because it ended without a goodbye and another
    /// one took its place.
    pub fn gateway_has_ended(&self, gateway: Incarnation) {
        self.shared.verification.lock().end(gateway);
        self.shared.postponed.notify_one();
    }

    /// Sends and receives on changed interfaces at once, instead of at the next poll.
    pub fn interfaces_changed(&self) {
        self.shared
            .interfaces_changed
            .store(true, Ordering::Relaxed);
        self.shared.postponed.notify_one();
    }

    /// Withdraws all announcements with a goodbye, and stops listening. Blocks until the goodbye is
    /// sent, for about 10 s at most. A repeated call does nothing.
    pub fn close(&self) {
        {
            let mut own = self.shared.own.lock();
            if std::mem::replace(&mut own.closed, true) {
                return;
            }
            own.agents.clear();
        }
        // Before the task is aborted: it may be about to report the end of the library.
        self.shared.closing.store(true, Ordering::Relaxed);
        self.task.abort();
        // The last beacon reports that the coalitions are gone; other gateways wait for that.
        let (config, nothing) = (&self.shared.config, beacon::BeaconContent::default());
        if let Some(beacon) = beacon::packet(config.mts.incarnation, nothing)
            && let Err(error) = sockets::send_once(config, &beacon)
        {
            tracing::debug!(%error, "the last beacon was not sent");
        }
        let Ok(Some(ended)) = self.shared.ask(ServiceDaemon::shutdown) else {
            return;
        };
        if ended.recv_timeout(Duration::from_secs(5)).is_err() {
            log_limit::error!(
                "timed out after 5 s waiting for the mDNS library to send its goodbyes; other hosts keep the records until they expire"
            );
        }
    }
}

impl Drop for MdnsDirectory {
    fn drop(&mut self) {
        self.close();
    }
}

impl Directory for MdnsDirectory {
    reads_its_table!(viewed shared.table);

    /// Announces the agent. Its locations are those at which this gateway accepts letters for it.
    fn register(&self, registration: Registration) -> Result<Arc<Entry>, RegisterError> {
        let entry = registration.into_entry(&self.shared.config.mts, Source::Mdns)?;
        self.shared.register(&mut self.shared.own.lock(), entry)
    }

    fn deregister(&self, name: &str, incarnation: Incarnation) -> Result<(), DeregisterError> {
        let mut own = self.shared.own.lock();
        self.shared.deregister(&mut own, name, incarnation)
    }

    /// Applies the update atomically: coalitions in it change together.
    fn update(&self, leaving: &[(Arc<str>, Incarnation)], joining: Vec<Registration>) -> Updated {
        let mut own = self.shared.own.lock();
        let removals = leaving
            .iter()
            .map(|(name, incarnation)| self.shared.deregister(&mut own, name, *incarnation))
            .collect();
        let joining = joining.into_iter().map(|registration| {
            let entry = registration.into_entry(&self.shared.config.mts, Source::Mdns)?;
            self.shared.register(&mut own, entry)
        });
        Updated {
            joined: joining.collect(),
            removed: removals,
        }
    }
}

/// Error of [`MdnsDirectory::open`].
#[derive(Debug, Clone, thiserror::Error)]
#[non_exhaustive]
pub enum MdnsError {
    /// No tokio runtime is running.
    #[error("no tokio runtime is running; open the network's directory within one")]
    NoRuntime,
}

struct Shared {
    /// `None` when it could not be started, or is stopped after a flood.
    daemon: Mutex<Option<ServiceDaemon>>,
    config: MdnsConfig,
    /// Entries of other gateways, by the full name of their record with its original spelling.
    table: Table<Arc<str>>,
    /// The records in `table`, by the gateway that announces them.
    verification: Mutex<Verification>,
    /// Records that are not in the table yet.
    coalition_sync: Mutex<CoalitionSync>,
    /// Whether to send a beacon at once because coalitions changed.
    coalitions_changed: AtomicBool,
    /// Whether this process closes the directory, so that the end of the library is no problem.
    closing: AtomicBool,
    /// Whether to check the interfaces at once.
    interfaces_changed: AtomicBool,
    own: Mutex<OwnAgents>,
    status: Mutex<MdnsStatus>,
    last_error: watch::Sender<Option<String>>,
    /// Wakes the task for work that is due later or now.
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
struct OwnAgents {
    closed: bool,
    agents: HashMap<Arc<str>, Announcement>,
    pace: Pace,
    /// Full names for which the library has just sent a goodbye, and the end of their rest. The
    /// library sends a goodbye twice, and would take its second one for a conflicting claim to the
    /// name.
    resting: HashMap<Arc<str>, Instant>,
    /// Full names that the library has renamed, and will always rename again.
    spoilt: HashSet<Arc<str>>,
    /// The announcements at the time the library was stopped, until the next one starts. Later changes
    /// are not announced meanwhile, so a beacon with them would cause unanswered queries.
    while_stopped: Option<beacon::BeaconContent>,
    /// Records in which only the locations changed.
    relocations: Relocations,
}

impl OwnAgents {
    fn announced(&self) -> beacon::BeaconContent {
        let mut announced = beacon::BeaconContent::default();
        for one in self.agents.values() {
            if let Some((_, digest)) = one.last_registration {
                announced.all.add(digest);
            }
            if matches!(one.entry.role, Role::Coalition(_)) {
                announced.coalitions.add(one.digest);
            }
        }
        announced
    }
}

#[derive(Debug)]
struct Announcement {
    entry: Arc<Entry>,
    /// The full name of its record, in lower case.
    fullname: Arc<str>,
    /// The host of its record. Each record has its own, because the library sends a goodbye for the
    /// host together with the record.
    host: Incarnation,
    /// Number of labels tried before this one.
    attempt: u32,
    /// Time at which it is to be announced, if it is not yet.
    due: Option<Instant>,
    digest: Digest,
    /// Time and digest of the last registration with the library.
    last_registration: Option<(Instant, Digest)>,
}

impl Announcement {
    fn host_name(&self) -> String {
        format!("fipa-{}.local.", self.host)
    }
}

/// Time for which a record stays unchanged before it is changed again (RFC 6762 clause 8.4).
/// Probing takes most of a second, the two announcements are a second apart, and the previous
/// record leaves the caches only a second later. A record that returned earlier would be mistaken
/// for the one that is leaving.
const SETTLING: Duration = Duration::from_secs(3);

/// Time for which a record stays unchanged before only its locations change: letters do not arrive until other
/// gateways have it. It may be announced before the previous record has left all caches.
const MOVING: Duration = Duration::from_secs(1);

/// Intervals in seconds at which the library polls the interfaces: normally, and while they change,
/// which this crate detects.
const NORMAL_POLL: u32 = 60;
const FAST_POLL: u32 = 1;

/// Time for which the library polls fast after a change. An IPv6 address takes up to two seconds
/// until it is usable (RFC 4862 clause 5.4).
const CHANGING: Duration = Duration::from_secs(5);

/// Time for which a full name rests after a goodbye.
const REST: Duration = Duration::from_secs(1);

/// Maximum number of full names remembered as spoilt.
const MAX_SPOILT: usize = 1024;

impl Shared {
    fn register(&self, own: &mut OwnAgents, entry: Entry) -> Result<Arc<Entry>, RegisterError> {
        if own.closed {
            return Err(RegisterError::Closed);
        }
        let announced = own.agents.get(&entry.name);
        if let Some(holder) = announced.map(|announced| Arc::clone(&announced.entry))
            && holder.incarnation != entry.incarnation
        {
            return Err(RegisterError::AlreadyRegistered { holder });
        }
        let len = record::len_of(&record::encode(&entry));
        if len > MAX_TXT {
            let why = format!("the record has {len} bytes; at most {MAX_TXT} are allowed");
            return Err(RegisterError::Full(why));
        }
        let entry = Arc::new(entry);
        let attempt = announced.map_or(0, |announced| announced.attempt);
        self.announce(own, &entry, attempt)
            .map_err(|error| RegisterError::Failed(Arc::new(error)))?;
        Ok(entry)
    }

    /// Announces the entry under the first free label, starting with this attempt; either at once,
    /// or when the label has rested and the pace allows it.
    fn announce(
        &self,
        own: &mut OwnAgents,
        entry: &Arc<Entry>,
        mut attempt: u32,
    ) -> Result<(), mdns_sd::Error> {
        let fullname = loop {
            let fullname = fullname(&self.label(&entry.name, attempt));
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
            // An announced record is changed only after it has settled.
            Some(Announcement {
                entry: before,
                last_registration: Some((when, _)),
                ..
            }) => {
                let relocated = moves(before, entry);
                let settling = match relocated {
                    true => MOVING,
                    false => SETTLING,
                };
                if relocated {
                    own.relocations.add(now, &entry.name);
                    self.postponed.notify_one();
                }
                Some(*when + settling).filter(|settled| *settled > now)
            }
            Some(waiting) => waiting.due,
            None => own.pace.turn(now, fastrand::f64()),
        };
        let mut announced = Announcement {
            entry: Arc::clone(entry),
            digest: Digest::of(&record::encode(entry)),
            host: before.map_or_else(Incarnation::random, |announced| announced.host),
            due: rested.max(turn),
            last_registration: before.and_then(|announced| announced.last_registration),
            fullname,
            attempt,
        };
        if announced.due.is_some() {
            self.postponed.notify_one();
        } else {
            self.register_with_daemon(&announced)?;
            announced.last_registration = Some((now, announced.digest));
        }
        own.agents.insert(entry.name.clone(), announced);
        self.coalition_changed(entry);
        Ok(())
    }

    fn label(&self, name: &str, attempt: u32) -> String {
        record::label(name, attempt, self.config.mts.incarnation)
    }

    fn register_with_daemon(&self, announced: &Announcement) -> Result<(), mdns_sd::Error> {
        let label = self.label(&announced.entry.name, announced.attempt);
        let host = announced.host_name();
        let properties = record::encode(&announced.entry);
        let properties: Vec<TxtProperty> = properties.into_iter().map(TxtProperty::from).collect();
        // The locations contain the port; the addresses are those of this host.
        let service = ServiceInfo::new(SERVICE_TYPE, &label, &host, "", 0, properties)?;
        let service = service.enable_addr_auto();
        self.ask(|daemon| daemon.register(service.clone()))?;
        Ok(())
    }

    /// Builds the due packets for records in which only the locations changed, each with the label of
    /// its record.
    fn relocated(&self, now: Instant) -> Vec<(String, Vec<u8>)> {
        let mut own = self.own.lock();
        let due = own.relocations.take_due(now);
        let packets = due.iter().filter_map(|name| {
            let announced = own.agents.get(name)?;
            let label = self.label(name, announced.attempt);
            let properties = record::encode(&announced.entry);
            let packet = packet::announcement(&label, &announced.host_name(), &properties)?;
            Some((label, packet))
        });
        packets.collect()
    }

    /// Announces postponed records that are due, and returns the time of the next.
    fn announce_due(&self) -> Option<Instant> {
        let mut own = self.own.lock();
        let now = Instant::now();
        own.resting.retain(|_, until| *until > now);
        for announced in own.agents.values_mut() {
            if announced.due.is_some_and(|due| due <= now) {
                announced.due = None;
                announced.last_registration = Some((now, announced.digest));
                if let Err(error) = self.register_with_daemon(announced) {
                    let name = &announced.entry.name;
                    self.failed(format!("cannot announce {name:?}: {error}"));
                }
            }
        }
        own.agents.values().filter_map(|one| one.due).min()
    }

    /// Withdraws the record with a goodbye.
    fn withdraw(&self, own: &mut OwnAgents, name: &str) -> Result<(), mdns_sd::Error> {
        let Some(announced) = own.agents.get(name) else {
            return Ok(());
        };
        let now = Instant::now();
        own.resting.retain(|_, until| *until > now);
        if announced.last_registration.is_some() {
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
        own: &mut OwnAgents,
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
        self.withdraw(own, name)
            .map_err(|error| DeregisterError::Failed(Arc::new(error)))
    }

    /// Sets the interval at which the library polls the interfaces; it applies after the next poll.
    fn set_poll_interval(&self, seconds: u32) {
        if let Err(error) = self.ask(|daemon| daemon.set_ip_check_interval(seconds)) {
            self.failed(format!(
                "cannot set the interval for polling the interfaces: {error}"
            ));
        }
    }

    /// Makes the library use new interfaces at once, instead of after its next poll.
    fn daemon_adds_interfaces(&self) {
        let none = || Vec::<IfKind>::new();
        if let Err(error) = self.ask(|daemon| daemon.enable_interface(none())) {
            self.failed(format!("cannot use a new interface: {error}"));
        }
    }

    /// Sends a command to the library, with retries for up to 5 s while its command queue is full.
    /// Does nothing when the library is stopped.
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

    /// Stops the library without a goodbye for the announced records, and returns a channel that
    /// reports completion. Nothing is announced or answered until the next start.
    fn end_daemon(&self) -> Result<Option<Receiver<DaemonStatus>>, mdns_sd::Error> {
        let Some(daemon) = self.daemon.lock().clone() else {
            return Ok(None);
        };
        // The library sends goodbyes on its enabled interfaces.
        let ended = daemon.disable_interface(IfKind::All);
        let ended = match ended.and_then(|()| daemon.shutdown()) {
            // The library has already ended.
            Err(mdns_sd::Error::DaemonShutdown) => None,
            ended => Some(ended?),
        };
        let mut own = self.own.lock();
        *self.daemon.lock() = None;
        own.while_stopped = Some(own.announced());
        Ok(ended)
    }

    /// Starts the library again, and registers the previous announcements at the usual pace.
    /// Returns whether it is running.
    fn start_daemon(&self) -> bool {
        // A concurrent close waits for this lock, and then stops the new library.
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
        self.interfaces_changed.store(true, Ordering::Relaxed);
        own.while_stopped = None;
        let now = Instant::now();
        let agents = own.agents.values_mut();
        let mut before: Vec<_> = agents
            .filter(|one| one.last_registration.is_some())
            .collect();
        // Another flood may stop the library before all records are registered; the next start
        // begins with the rest.
        before.sort_by_key(|one| one.last_registration.map(|(when, _)| when));
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

    /// Stores the current state of a record, or its removal.
    fn put(&self, fullname: &Arc<str>, entry: Option<Arc<Entry>>) {
        let now = Instant::now();
        self.verification
            .lock()
            .put(now, fullname, entry.as_deref());
        self.show(|coalition_sync| coalition_sync.put(now, fullname, entry));
    }

    /// Applies the updates that are visible now, atomically.
    fn show(&self, what: impl FnOnce(&mut CoalitionSync) -> Updates) {
        // StoredDigest until the table is updated, so that updates stay in order.
        let mut coalition_sync = self.coalition_sync.lock();
        let updates = what(&mut coalition_sync);
        if !updates.is_empty() {
            self.table.replace(updates);
        }
    }

    /// The announcements of this gateway. Includes coalitions that will be announced soon, because
    /// other gateways must wait for them.
    fn announced(&self) -> beacon::BeaconContent {
        let own = self.own.lock();
        own.while_stopped.unwrap_or_else(|| own.announced())
    }

    /// Sends a beacon at once if the entry is a coalition.
    fn coalition_changed(&self, entry: &Entry) {
        if matches!(entry.role, Role::Coalition(_)) {
            self.coalitions_changed.store(true, Ordering::Relaxed);
            self.postponed.notify_one();
        }
    }

    fn set_last_error(&self, error: String) {
        self.last_error.send_if_modified(|last| {
            let changed = last.as_ref() != Some(&error);
            *last = Some(error);
            changed
        });
    }

    fn failed(&self, error: String) {
        if self.closing.load(Ordering::Relaxed) {
            tracing::debug!(%error, "multicast DNS, while it is closed");
            return;
        }
        log_limit::warn!(%error, "multicast DNS");
        self.set_last_error(error);
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

/// The full name of a record with this label, in lower case. Labels have no dots or backslashes, so
/// nothing needs escaping.
fn fullname(label: &str) -> Arc<str> {
    format!("{label}.{SERVICE_TYPE}").to_lowercase().into()
}

fn choose(daemon: &ServiceDaemon, interfaces: &[String]) -> Result<(), mdns_sd::Error> {
    daemon.set_service_name_len_max(SERVICE_NAME_LEN)?;
    daemon.set_ip_check_interval(NORMAL_POLL)?;
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
