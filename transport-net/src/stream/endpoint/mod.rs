//! The registry of an endpoint: its connections, their peers and the locations they lead to.
//!
//! A location keeps its connection until that connection ends, so that order is preserved. A
//! location with a known incarnation uses any connection with that incarnation, opened by either
//! side; this is how reports reach peers that cannot be dialed. When two endpoints connect to each
//! other at the same time both connections are kept, and the unused one closes after the idle
//! timeout.
//!
//! Between hosts, large letters take a connection of their own, so that they do not delay the other parcels in
//! either direction. So do the small letters that follow a large one in its stream, until it is answered; a large one
//! begins when those before it in its stream are answered. Without such a connection, for example because
//! the peer cannot be dialed, large letters take the one for all parcels.
//!
//! A connection is *suspect* after an attempt on it got no answer and no other byte arrived either:
//! the system retransmits lost packets with growing pauses, and a peer that moved never answers.
//! Later dispatches take another connection with the same peer, which is opened if there is none.
//! When that connection is open and the suspect one is still silent, the suspect one ends.

use std::cmp::Reverse;
use std::collections::{BTreeMap, HashMap};
use std::io;
#[cfg(feature = "ip")]
use std::net::SocketAddr;
use std::sync::Arc;
#[cfg(feature = "ip")]
use std::sync::Weak;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use fipa_transport::{
    Abandoned, Answer, AttemptId, Body, Hop, Incarnation, Kind, ListenError, Location, Parcel,
    Principal, Sink, Ticket, TransportError, TransportErrorKind, log_limit,
};
use parking_lot::Mutex;
use tokio::runtime::Handle;
use tokio::task::{AbortHandle, JoinHandle};
use tokio::time::sleep;

use super::budget::{ByteBudget, Meter, ReservedBytes};
use super::config::{NetLimits, StreamConfig};
use super::connection::{Connection, Role, SendError, letter_len};
use super::counters::{Tally, count};
#[cfg(feature = "ip")]
use super::dialing::SilentPeers;
use super::link::{Link, MAX_LINKS, of_ticket};
use super::source::{Home, QuotaKey, Source};
use crate::Identity;
#[cfg(feature = "ip")]
use crate::address::{self, Listening};
use crate::end::ConnectionEnd;
use crate::hello::{Hello, Load};
#[cfg(feature = "ip")]
use crate::interfaces::Changes;
use crate::rate_limit::PeerRateLimit;
#[cfg(feature = "ip")]
use crate::rate_limit::PeerRateLimits;

/// Time in which a connected service must respond to a ping when an unproved peer claims to be that
/// service.
const RESPONSE_TIMEOUT: Duration = Duration::from_secs(1);

/// Time in which it must respond when the service has announced that it is elsewhere.
const LEFT_TIMEOUT: Duration = Duration::from_millis(200);

/// Maximum number of silent connections that are pinged before an unproved peer is refused.
const MAX_ASKED: usize = 4;

/// Maximum number of times that the pause between retries beside suspect connections doubles.
const MAX_DOUBLINGS: u32 = 4;

/// Maximum length of a small letter: 64 KiB of content and the rest of the letter. At 10 Mbit/s, it takes 56 ms.
const MAX_SMALL: u64 = 68 << 10;

/// Pause of accepting after a failure, for example when the process has no descriptors left.
const ACCEPT_RETRY_DELAY: Duration = Duration::from_millis(100);

#[derive(Debug)]
pub(crate) struct Endpoint {
    kind: Kind,
    pub(crate) config: StreamConfig,
    pub(crate) runtime: Handle,
    /// Memory of letters that are arriving.
    pub(crate) byte_budget: ByteBudget,
    /// Receive windows beyond the minimum; see [`Self::window`].
    windows: ByteBudget,
    /// Rate limits of the peers.
    #[cfg(feature = "ip")]
    rate_limits: PeerRateLimits,
    #[cfg(feature = "ip")]
    silent_peers: SilentPeers,
    tally: Tally,
    registry: Mutex<Registry>,
}

#[derive(Default)]
struct Registry {
    phase: Phase,
    sink: Option<Arc<dyn Sink>>,
    listening: Reached,
    /// The tasks that accept connections, and the one that watches the interfaces.
    listeners: Vec<AbortHandle>,
    /// Connections that were dialed, or whose peer has said hello.
    links: HashMap<u32, Arc<Link>>,
    /// The connections for all parcels.
    any: Connections,
    /// The connections for large letters.
    large: Connections,
    /// The latest connection of each peer for each location that the peer dialed, with the peer's
    /// serial number.
    inbound: HashMap<Inbound, (u64, Arc<Link>)>,
    /// The quota keys of the accepted connections.
    quota_keys: HashMap<u32, QuotaKey>,
    /// The introduced peers of the links.
    peer_by_link: HashMap<u32, Peer>,
    /// Accepted connections before the peer's hello, oldest first, with their origin and task.
    unproved: BTreeMap<u64, (Home, Option<AbortHandle>)>,
    last_unproved: u64,
    last_number: u32,
    last_serial: u64,
}

/// The connections of one [`Load`].
#[derive(Default)]
struct Connections {
    /// Those opened by this side, by location.
    dialed: HashMap<Location, Arc<Link>>,
    /// Those with the service of an incarnation, in the order of introduction.
    known: HashMap<Incarnation, Vec<Arc<Link>>>,
    /// Locations for which connections were opened beside suspect ones or, for large letters, could not be opened.
    retries: HashMap<Location, Retries>,
}

/// Number and time of the connections that were opened beside suspect ones, or could not be opened.
#[derive(Debug, Clone, Copy)]
struct Retries {
    last: Instant,
    times: u32,
}

impl Retries {
    /// Whether the pause since the last one has not passed. The pause doubles each time.
    fn is_soon(self, now: Instant, pause: Duration) -> bool {
        now < self.last + pause.saturating_mul(1 << self.times.min(MAX_DOUBLINGS))
    }

    /// Whether the record has expired.
    fn is_over(self, now: Instant, pause: Duration) -> bool {
        now >= self.last + pause.saturating_mul(4 << MAX_DOUBLINGS)
    }
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
enum Phase {
    #[default]
    New,
    Open,
    Closed,
}

/// The addresses at which an endpoint is reached.
#[derive(Debug, Default)]
enum Reached {
    #[default]
    Nowhere,
    /// One socket with this address.
    Socket(String),
    #[cfg(feature = "ip")]
    Addresses(Listening),
}

impl Reached {
    /// Returns the addresses as listed in a hello.
    fn texts(&self) -> Vec<String> {
        match self {
            Self::Nowhere => Vec::new(),
            Self::Socket(address) => vec![address.clone()],
            #[cfg(feature = "ip")]
            Self::Addresses(listening) => listening.texts(),
        }
    }
}

/// The introduced peer of a link.
#[derive(Debug, Clone)]
struct Peer {
    identity: Identity,
    /// The principal that the peer has proved, if any.
    proved: Option<Principal>,
    /// The origin of its connection.
    home: Home,
    /// The location that the peer dialed and the serial number of that dialing, if the peer
    /// opened the connection.
    dialed: Option<(String, u64)>,
    /// The letters that the connection is for.
    load: Load,
    /// The listening addresses in its hello.
    #[cfg_attr(not(feature = "ip"), expect(dead_code, reason = "only IP peers move"))]
    listening: Vec<String>,
}

/// The effect of a peer's hello on other connections.
#[derive(Default)]
struct SupersededConnections {
    /// Connections that the new one replaces.
    superseded: Vec<Arc<Link>>,
    /// Connections that the new one replaces unless their peers respond to a ping.
    asked: Vec<Arc<Link>>,
    /// Connections whose peer may have moved to the origin of the new one.
    doubted: Vec<Arc<Link>>,
}

/// The key of a peer's connections for one location. It contains the origin, so that an unproved
/// peer elsewhere cannot replace the connection of a service by claiming its incarnation.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Inbound {
    incarnation: Incarnation,
    home: Home,
    dialed: String,
    load: Load,
}

impl Peer {
    /// Whether `home` is another address in the listening addresses of this peer.
    fn is_also_at(&self, home: Home) -> bool {
        match home {
            Home::Process(_) => false,
            #[cfg(feature = "ip")]
            Home::Address(ip) => self.home != home && address::lists(&self.listening, ip),
        }
    }

    /// Whether this connection replaces that one, if both are of the same service: the service was
    /// restarted, or it opened this connection later from another address or for the same location.
    /// Connections that both sides opened at the same time stay, and so do connections for several
    /// locations.
    fn replaces(&self, before: &Self) -> bool {
        if self.identity.incarnation != before.identity.incarnation {
            let (this, that) = (&self.identity, &before.identity);
            return (&this.name, &this.domain, &this.host)
                == (&that.name, &that.domain, &that.host);
        }
        match (&self.dialed, &before.dialed) {
            // An unproved peer at another address may or may not be the service, whatever its hello says.
            (Some(_), _) if self.proved.is_none() && self.home != before.home => true,
            (Some((this, serial)), Some((that, earlier))) => {
                let is_for_same = this == that && self.load == before.load;
                serial >= earlier && (self.home != before.home || is_for_same)
            }
            (Some(_), None) | (None, _) => false,
        }
    }
}

/// A connection for a location.
enum Route {
    /// An existing connection.
    Open(Arc<Link>),
    /// A new link whose connection has yet to be opened.
    New(Arc<Link>, Arc<dyn Sink>),
}

impl std::fmt::Debug for Registry {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Registry")
            .field("phase", &self.phase)
            .field("listening", &self.listening)
            .field("links", &self.links.len())
            .field("unproved", &self.unproved.len())
            .finish_non_exhaustive()
    }
}

impl Endpoint {
    /// Creates an endpoint of this kind of transport.
    pub(crate) fn new(kind: Kind, config: StreamConfig, runtime: Handle) -> Arc<Self> {
        Arc::new(Self {
            kind,
            config,
            runtime,
            byte_budget: ByteBudget::default(),
            windows: ByteBudget::default(),
            #[cfg(feature = "ip")]
            rate_limits: PeerRateLimits::default(),
            #[cfg(feature = "ip")]
            silent_peers: SilentPeers::default(),
            tally: Tally::default(),
            registry: Mutex::default(),
        })
    }

    pub(crate) fn limits(&self) -> &NetLimits {
        &self.config.limits
    }

    /// Whether the peers are processes of this host and of this user.
    pub(crate) fn is_within_host(&self) -> bool {
        self.kind == Kind::Unix
    }

    /// Counts, logs and lists a connection that ends because the peer has another version of the protocol.
    /// `dialed` is the location that this side dialed, if it opened the connection.
    pub(crate) fn other_version(
        &self,
        from: Source,
        dialed: Option<&Location>,
        end: &ConnectionEnd,
    ) {
        count(&self.tally.refused_nonsense);
        let (why, key) = (end.after().detail, from.home().whole());
        if let Some(to) = dialed {
            log_limit::warn!(of: key, "{to}: connection closed: {why}");
            return;
        }
        log_limit::warn!(of: key, "{from}: connection refused: {why}");
        #[cfg(feature = "ip")]
        if let Home::Address(ip) = key {
            self.config.refusals.add(ip, &why);
        }
    }

    /// Whether processes of this host connect to this endpoint, whose tasks may block.
    pub(crate) fn serves_processes(&self) -> bool {
        #[cfg(feature = "ip")]
        return self.config.processes;
        #[cfg(not(feature = "ip"))]
        true
    }

    /// Returns the rate limit of the peers at `home`, if they have one.
    pub(crate) fn rate_limit(&self, home: Home) -> Option<Arc<PeerRateLimit>> {
        if !self.config.limits_peer_at(home) {
            return None;
        }
        match home {
            Home::Process(_) => None,
            #[cfg(feature = "ip")]
            Home::Address(ip) => self
                .rate_limits
                .of(ip, self.limits().rates(), Instant::now()),
        }
    }

    /// Returns a meter that reserves memory for arriving letters of this quota.
    pub(crate) fn meter(&self, quota_key: &QuotaKey) -> Meter {
        let budget = self.config.budget_of(quota_key);
        self.byte_budget.meter(quota_key.clone(), budget)
    }

    /// Reserves bytes of receive window for a peer of this quota. The budget has the size of the
    /// budget of arriving letters.
    pub(crate) fn window(&self, quota_key: &QuotaKey, len: usize) -> Option<ReservedBytes> {
        let budget = self.config.budget_of(quota_key);
        self.windows.meter(quota_key.clone(), budget).take_now(len)
    }

    pub(crate) fn tally(&self) -> &Tally {
        &self.tally
    }

    /// Returns the addresses from which no packet came back.
    #[cfg(feature = "ip")]
    pub(crate) fn silent_peers(&self) -> &SilentPeers {
        &self.silent_peers
    }

    /// Returns the sink while the endpoint is open.
    #[cfg(feature = "ip")]
    pub(crate) fn sink(&self) -> Option<Arc<dyn Sink>> {
        self.registry.lock().sink.clone()
    }

    /// Checks that the endpoint can be opened.
    ///
    /// # Errors
    /// When the endpoint was opened before, or its identity is invalid.
    fn may_listen(&self) -> Result<(), ListenError> {
        if self.registry.lock().phase != Phase::New {
            return Err(ListenError::OpenedBefore);
        }
        match self.config.identity.fault() {
            Some(fault) => Err(ListenError::Unavailable(fault)),
            None => Ok(()),
        }
    }

    /// Opens the only socket of the endpoint with `open`, which also returns its address, and
    /// starts the task that serves it with `accept`. Returns the location of the endpoint.
    ///
    /// # Errors
    /// When the endpoint was opened before, or the socket cannot be opened.
    pub(crate) fn listen_at<S>(
        &self,
        sink: Arc<dyn Sink>,
        open: impl FnOnce() -> Result<(S, String), ListenError>,
        accept: impl FnOnce(S) -> JoinHandle<()>,
    ) -> Result<Vec<Location>, ListenError> {
        self.may_listen()?;
        let _inside = self.runtime.enter();
        let (socket, address) = open()?;
        let location = Location::new(self.kind, &address)
            .map_err(|error| ListenError::Unavailable(error.to_string()))?
            .with_incarnation(self.config.identity.incarnation);
        let mut registry = self.registry.lock();
        if registry.phase != Phase::New {
            return Err(ListenError::OpenedBefore);
        }
        registry.phase = Phase::Open;
        registry.sink = Some(sink);
        registry.listening = Reached::Socket(address);
        registry.listeners = vec![accept(socket).abort_handle()];
        Ok(vec![location])
    }

    /// Replaces the socket of [`listen_at`](Self::listen_at) by another one at the same address.
    /// Does nothing when the endpoint is not open.
    pub(crate) fn replace_listener(&self, accept: impl FnOnce() -> JoinHandle<()>) {
        let mut registry = self.registry.lock();
        if registry.phase != Phase::Open {
            return;
        }
        let before = std::mem::replace(&mut registry.listeners, vec![accept().abort_handle()]);
        drop(registry);
        for task in before {
            task.abort();
        }
    }

    /// Opens the sockets for these entries of `listen` with `open`, which also returns the address
    /// that the socket is bound to, and starts the task that serves it with `accept`. Returns the
    /// present locations of the endpoint; the sink is notified when they change.
    ///
    /// # Errors
    /// When the endpoint was opened before, or a socket cannot be opened.
    #[cfg(feature = "ip")]
    pub(crate) fn listen<S>(
        self: &Arc<Self>,
        sink: Arc<dyn Sink>,
        listen: &[String],
        open: impl Fn(SocketAddr) -> io::Result<(S, SocketAddr)>,
        accept: impl Fn(S) -> JoinHandle<()>,
    ) -> Result<Vec<Location>, ListenError> {
        self.may_listen()?;
        let _inside = self.runtime.enter();
        let (sockets, bound): (Vec<S>, Vec<SocketAddr>) =
            address::bind_all(listen, open)?.into_iter().unzip();
        let unavailable =
            |error: &dyn std::fmt::Display| ListenError::Unavailable(error.to_string());
        // Subscribed before the interfaces are listed, so that no change is missed.
        let changes = bound
            .iter()
            .any(|bound| !bound.ip().is_loopback())
            .then(Changes::subscribe);
        let listening = Listening::new(bound).map_err(|error| unavailable(&error))?;
        let locations = listening.locations(self.kind, self.config.identity.incarnation);
        let locations = locations.map_err(|error| unavailable(&error))?;
        let mut registry = self.registry.lock();
        if registry.phase != Phase::New {
            return Err(ListenError::OpenedBefore);
        }
        registry.phase = Phase::Open;
        registry.sink = Some(sink);
        registry.listening = Reached::Addresses(listening);
        let tasks = sockets.into_iter().map(accept);
        let watch = changes.map(|changes| {
            let watch = follow_interfaces(Arc::downgrade(self), changes);
            self.runtime.spawn(watch)
        });
        registry.listeners = tasks.chain(watch).map(|task| task.abort_handle()).collect();
        Ok(locations)
    }

    /// Returns the listening addresses of this endpoint as listed in a hello.
    #[cfg(feature = "ip")]
    pub(crate) fn listening(&self) -> Vec<String> {
        self.registry.lock().listening.texts()
    }

    /// Returns the sockets of this endpoint and their addresses.
    #[cfg(feature = "ip")]
    pub(crate) fn own(&self) -> Listening {
        match &self.registry.lock().listening {
            Reached::Addresses(listening) => listening.clone(),
            Reached::Nowhere | Reached::Socket(_) => Listening::default(),
        }
    }

    /// Handles a change of the network interfaces: reports the new locations to the sink, and ends
    /// the connections of local addresses that no longer exist, on which no byte can arrive.
    #[cfg(feature = "ip")]
    fn interfaces_changed(&self) {
        let (sink, locations, lost, links) = {
            let mut registry = self.registry.lock();
            let Reached::Addresses(listening) = &mut registry.listening else {
                return;
            };
            let moved = match listening.refresh() {
                Ok(moved) => moved,
                Err(error) => {
                    log_limit::warn!(kind = %self.kind, %error, "cannot refresh the locations; keeping the previous ones");
                    return;
                }
            };
            let incarnation = self.config.identity.incarnation;
            let locations = moved
                .relocated
                .then(|| listening.locations(self.kind, incarnation));
            let links: Vec<_> = match moved.lost.is_empty() {
                true => Vec::new(),
                false => registry.links.values().cloned().collect(),
            };
            (registry.sink.clone(), locations, moved.lost, links)
        };
        for link in links {
            if let Some(ip) = link.local_ip()
                && lost.contains(&ip)
            {
                let what = format!("this host no longer has the address {ip}");
                link.leave(ConnectionEnd::Broken(what));
                // Later dispatches need another connection.
                self.forget(&link);
            }
        }
        match (sink, locations) {
            (Some(sink), Some(Ok(locations))) => sink.relocated(locations),
            (_, Some(Err(error))) => {
                log_limit::warn!(kind = %self.kind, %error, "cannot refresh the locations; keeping the previous ones");
            }
            _ => {}
        }
    }

    /// Closes every connection. The tasks of the connections conclude outstanding attempts.
    pub(crate) fn close(&self) {
        let (links, tasks) = {
            let mut registry = self.registry.lock();
            registry.phase = Phase::Closed;
            registry.sink = None;
            let mut tasks = std::mem::take(&mut registry.listeners);
            tasks.extend(
                std::mem::take(&mut registry.unproved)
                    .into_values()
                    .filter_map(|(_, task)| task),
            );
            let links: Vec<_> = registry.links.values().cloned().collect();
            (links, tasks)
        };
        for task in tasks {
            task.abort();
        }
        for link in links {
            link.leave(ConnectionEnd::Closed);
        }
    }

    /// Checks a parcel against the kind of the location, the receiver's name and `max_letter`.
    pub(crate) fn check(&self, to: &Location, parcel: &Parcel) -> Result<(), TransportError> {
        if to.kind() != self.kind {
            let detail = format!("{to} is not a {} location", self.kind);
            return Err(TransportError::new(TransportErrorKind::Unreachable, detail));
        }
        if parcel.receiver.is_empty() || parcel.receiver.len() > Parcel::MAX_NAME {
            let detail = "the receiver's name is empty or too long";
            return Err(TransportError::new(TransportErrorKind::Refused, detail));
        }
        let (len, max) = (letter_len(parcel), self.limits().max_letter);
        if len > max as u64 {
            let detail = format!("the letter has {len} bytes; the limit is {max} (max_letter)");
            return Err(TransportError::new(TransportErrorKind::TooLarge, detail));
        }
        Ok(())
    }

    /// Sends a parcel over a connection to a location. `dial` starts the task of a new connection
    /// when there is none.
    pub(crate) fn post(
        &self,
        attempt: AttemptId,
        to: &Location,
        parcel: &Parcel,
        dial: impl Fn(Arc<Link>, Arc<dyn Sink>) -> JoinHandle<()>,
    ) -> Result<(), TransportError> {
        loop {
            let load = self.load_for(to, parcel);
            let (link, fresh) = match self.route_to(to, load)? {
                Route::Open(link) => (link, None),
                Route::New(link, sink) => (link, Some(sink)),
            };
            let predecessors = (load == Load::Large).then(|| {
                let registry = self.registry.lock();
                let others = registry.any.open(to);
                let others: Vec<_> = others
                    .filter(|it| !Arc::ptr_eq(it, &link))
                    .cloned()
                    .collect();
                drop(registry);
                link.predecessors(parcel.stream, &others)
            });
            let sent = link.send(attempt, parcel, predecessors);
            if let Some(sink) = fresh {
                let task = dial(link.clone(), sink);
                if task.is_finished() && !link.has_begun() {
                    self.forget(&link);
                    let detail = "the runtime of this endpoint has been shut down";
                    return Err(TransportError::new(TransportErrorKind::Closed, detail));
                }
                return sent.map_err(|error| match error {
                    SendError::Transport(error) => error,
                    SendError::Ended => ConnectionEnd::Closed.after(),
                });
            }
            match sent {
                Ok(()) => return Ok(()),
                Err(SendError::Transport(error)) => return Err(error),
                // The connection has just ended: the next iteration creates another one.
                Err(SendError::Ended) => self.forget(&link),
            }
        }
    }

    /// Returns the connections that a parcel takes to a location.
    fn load_for(&self, to: &Location, parcel: &Parcel) -> Load {
        if self.kind.is_host_local() || !matches!(parcel.body, Body::Letter(_)) {
            return Load::Any;
        }
        if letter_len(parcel) > MAX_SMALL {
            return Load::Large;
        }
        let large: Vec<_> = self.registry.lock().large.open(to).cloned().collect();
        match large.iter().any(|link| link.carries(parcel.stream)) {
            true => Load::Large,
            false => Load::Any,
        }
    }

    /// Returns a connection to a location; creates a link when there is none.
    fn route_to(&self, to: &Location, load: Load) -> Result<Route, TransportError> {
        let mut registry = self.registry.lock();
        let sink = match (registry.phase, &registry.sink) {
            (Phase::Open, Some(sink)) => sink.clone(),
            (Phase::New, _) => {
                return Err(TransportError::new(
                    TransportErrorKind::Closed,
                    "`listen` has not been called",
                ));
            }
            _ => return Err(ConnectionEnd::Closed.after()),
        };
        let connections = registry.of(load);
        let open = || connections.open(to);
        let is_full = registry.links.len() >= self.limits().max_connections;
        let healthy = open().find(|link| !link.is_suspect());
        // Another connection is opened beside suspect ones if `max_connections` allows it, with
        // growing pauses: a busy peer must not get more work.
        let now = Instant::now();
        let spare = self.limits().connect_timeout;
        let is_soon = || {
            connections
                .retries
                .get(to)
                .is_some_and(|it| it.is_soon(now, spare))
        };
        let for_all = || registry.any.open(to).filter(|_| load == Load::Large);
        let without_new = || open().chain(for_all()).next();
        let link = healthy.or_else(|| without_new().filter(|_| is_full || is_soon()));
        if let Some(link) = link.cloned() {
            let dialed = connections.dialed.get(to);
            if dialed.is_none_or(|dialed| !Arc::ptr_eq(dialed, &link)) {
                drop(registry);
                link.is_used_for(to);
            }
            return Ok(Route::Open(link));
        }
        if is_full {
            return Err(ConnectionEnd::TooManyConnections.after());
        }
        let suspect: Vec<_> = open().cloned().collect();
        let serial = registry.last_serial + 1;
        registry.last_serial = serial;
        let role = Role::Dialler {
            expected: to.incarnation(),
        };
        let link = self.make_link(&mut registry, role, load, serial, to.to_string());
        if !suspect.is_empty() {
            registry.of_mut(load).note_retry(to, now, spare);
        }
        link.opened_beside(suspect);
        registry.links.insert(link.number, link.clone());
        let dialed = &mut registry.of_mut(load).dialed;
        dialed.insert(to.clone(), link.clone());
        Ok(Route::New(link, sink))
    }

    /// Answers a parcel on the connection that it arrived on, if that connection still exists.
    pub(crate) fn answer(&self, ticket: Ticket, answer: &Answer) {
        let (number, id) = of_ticket(ticket);
        let link = self.registry.lock().links.get(&number).cloned();
        if let Some(link) = link {
            link.answer(id, answer);
        }
    }

    /// Ends an attempt to this location.
    pub(crate) fn abandon(&self, attempt: AttemptId, to: &Location) -> Abandoned {
        let registry = self.registry.lock();
        let present: Vec<_> = registry
            .any
            .open(to)
            .chain(registry.large.open(to))
            .cloned()
            .collect();
        drop(registry);
        let end = |links: &[Arc<Link>]| links.iter().find_map(|link| link.abandon(attempt));
        if let Some(end) = end(&present) {
            return end;
        }
        // A connection that another one has replaced keeps its attempts.
        let all: Vec<_> = self.registry.lock().links.values().cloned().collect();
        end(&all).unwrap_or(Abandoned::Unconfirmed)
    }

    /// Puts the connections with this location in doubt, because the service has announced that it is elsewhere.
    #[cfg(feature = "ip")]
    pub(crate) fn service_left(&self, location: &Location) {
        let home = address::numeric(location.authority()).ok();
        let home = home.map(|address| Source::Address(address).home());
        let registry = self.registry.lock();
        let is_there = |link: &&Arc<Link>| {
            let peer = registry.peer_by_link.get(&link.number);
            peer.is_some_and(|peer| Some(peer.home) == home)
        };
        let links = [&registry.any, &registry.large].into_iter().flat_map(|it| {
            let known = it.known_of(location).filter(is_there);
            known.chain(it.dialed.get(location)).cloned()
        });
        let links: Vec<_> = links.collect();
        drop(registry);
        for link in links {
            link.peer_moved();
        }
    }

    /// Creates a link for an accepted connection. Returns `None` when the endpoint is closed.
    pub(crate) fn accepted(&self) -> Option<(Arc<Link>, Arc<dyn Sink>)> {
        let mut registry = self.registry.lock();
        let sink = registry.sink.clone()?;
        let link = self.make_link(&mut registry, Role::Acceptor, Load::Any, 0, String::new());
        Some((link, sink))
    }

    fn make_link(
        &self,
        registry: &mut Registry,
        role: Role,
        load: Load,
        serial: u64,
        dialed: String,
    ) -> Arc<Link> {
        let hello = Hello {
            identity: self.config.identity.clone(),
            max_letter: self.limits().max_letter as u64,
            max_in_flight: u32::try_from(self.limits().max_in_flight.max(1)).unwrap_or(u32::MAX),
            serial,
            dialed,
            listening: registry.listening.texts(),
            load,
        };
        loop {
            registry.last_number = (registry.last_number + 1) % MAX_LINKS;
            if !registry.links.contains_key(&registry.last_number) {
                break;
            }
        }
        let connection = Connection::new(self.limits().clone(), role, hello, Instant::now());
        Link::new(registry.last_number, connection)
    }

    /// Registers a connection whose peer has introduced itself. Returns the origin of its parcels.
    ///
    /// # Errors
    /// When the connection is refused.
    pub(crate) async fn enter(
        &self,
        link: &Arc<Link>,
        peer: &Hello,
        proved: Option<Principal>,
        from: Source,
    ) -> Result<Hop, ConnectionEnd> {
        if !self.is_sought_by(peer) {
            // It does not replace any connection of the peer with this service.
            return Err(ConnectionEnd::NotSought);
        }
        let incarnation = peer.identity.incarnation;
        let load = link.load();
        let inbound = Inbound {
            incarnation,
            home: from.home(),
            dialed: peer.dialed.clone(),
            load,
        };
        let this = Peer {
            identity: peer.identity.clone(),
            proved,
            home: from.home(),
            // Without a key, an accepted connection counts as one, whatever its hello says.
            dialed: (!peer.dialed.is_empty() || proved.is_none() && link.was_accepted())
                .then(|| (peer.dialed.clone(), peer.serial)),
            load,
            listening: peer.listening.clone(),
        };
        let mut silent: Vec<u32> = Vec::new();
        let affected = loop {
            let asked = {
                let mut registry = self.registry.lock();
                if registry.phase != Phase::Open {
                    return Err(ConnectionEnd::Closed);
                }
                let affected = registry.affected(link, &this);
                let mut affected = affected.map_err(|why| self.refuse(from, why))?;
                let (gone, asked): (Vec<_>, Vec<_>) = std::mem::take(&mut affected.asked)
                    .into_iter()
                    .partition(|other| silent.contains(&other.number));
                if asked.is_empty() {
                    affected.superseded.extend(gone);
                    self.admit(&mut registry, link, &this, &affected.superseded, from)?;
                    count(match this.dialed {
                        Some(_) => &self.tally.accepted,
                        None => &self.tally.dialed,
                    });
                    registry.note(link, this, inbound)?;
                    count(&self.tally.connections);
                    break affected;
                }
                asked
            };
            if silent.len() > MAX_ASKED {
                return Err(ConnectionEnd::TooManyConnections);
            }
            let now = Instant::now();
            asked.iter().for_each(|other| other.ask());
            for other in asked {
                if other.answers(now, RESPONSE_TIMEOUT, LEFT_TIMEOUT).await {
                    return Err(self.refuse_beside(&other, from));
                }
                silent.push(other.number);
            }
        };
        for other in affected.doubted {
            other.doubt();
        }
        for superseded in &affected.superseded {
            superseded.leave(ConnectionEnd::Superseded);
        }
        for superseded in affected.superseded {
            // Letters that the peer sent on the previous connection must not arrive after letters
            // on this one.
            superseded.over().await;
        }
        let (principal, back) = match from {
            // A process of this host is reached at the socket that is named after its incarnation.
            Source::Process { other_user, .. } => (
                other_user.map_or(Principal::Host, Principal::User),
                incarnation.to_string(),
            ),
            #[cfg(feature = "ip")]
            Source::Address(from) => (
                self.config.principal_at(from.ip(), &peer.identity),
                address::return_address(&peer.listening, from).to_string(),
            ),
        };
        let location = Location::new(self.kind, &back)
            .map_err(|error| ConnectionEnd::ProtocolViolation(error.to_string()))?
            .with_incarnation(incarnation);
        Ok(Hop {
            location,
            principal: proved.unwrap_or(principal),
        })
    }

    /// Whether the peer dialed this service, according to its hello. If not, it dialed an address
    /// that another incarnation used before.
    fn is_sought_by(&self, peer: &Hello) -> bool {
        let sought = peer.dialed.parse::<Location>().ok();
        let sought = sought.map_or(Incarnation::UNKNOWN, |location| location.incarnation());
        !sought.is_known() || sought == self.config.identity.incarnation
    }

    /// Admits a connection whose peer has introduced itself, within the limits and in place of
    /// superseded connections.
    ///
    /// # Errors
    /// When a limit is reached.
    fn admit(
        &self,
        registry: &mut Registry,
        link: &Arc<Link>,
        peer: &Peer,
        superseded: &[Arc<Link>],
        from: Source,
    ) -> Result<(), ConnectionEnd> {
        if registry.links.contains_key(&link.number) {
            return Ok(());
        }
        let goes = |number: &u32| superseded.iter().any(|other| other.number == *number);
        let quota_key = QuotaKey::of(from, peer.proved.as_ref());
        let quota_keys = registry.quota_keys.iter();
        let of_quota_key = quota_keys
            .filter(|(number, it)| **it == quota_key && !goes(number))
            .count();
        let all = registry.links.len() - registry.links.keys().filter(|it| goes(it)).count();
        if all >= self.limits().max_connections
            || of_quota_key >= self.config.max_connections_of(&quota_key)
        {
            count(&self.tally.refused_crowd);
            return Err(ConnectionEnd::TooManyConnections);
        }
        registry.quota_keys.insert(link.number, quota_key);
        registry.links.insert(link.number, link.clone());
        Ok(())
    }

    /// Logs and returns the refusal of a peer that claims to be another service.
    fn refuse(&self, from: Source, why: &'static str) -> ConnectionEnd {
        count(&self.tally.refused_unproved);
        log_limit::warn!(of: from.home().whole(), "{from}: connection refused: {why}");
        ConnectionEnd::IdentityConflict(why)
    }

    /// Logs and returns the refusal of an unproved peer that claims to be the service of another connection,
    /// which is alive. From the same address, it is that service itself in the normal case: under load, a
    /// service opens a second connection when an answer on the first one is late.
    fn refuse_beside(&self, other: &Arc<Link>, from: Source) -> ConnectionEnd {
        const WHY: &str =
            "it claims the incarnation of a connected service whose connection is alive";
        let home = {
            let registry = self.registry.lock();
            registry
                .peer_by_link
                .get(&other.number)
                .map(|peer| peer.home)
        };
        if home != Some(from.home()) {
            return self.refuse(from, WHY);
        }
        count(&self.tally.refused_again);
        tracing::debug!(
            "{from}: another connection of a connected service was refused, because the first one is alive"
        );
        ConnectionEnd::IdentityConflict(WHY)
    }

    /// Logs the end of a connection and removes the connection from every table.
    pub(crate) fn connection_ended(&self, link: &Arc<Link>, end: &ConnectionEnd) {
        if end.is_misbehavior() {
            count(&self.tally.refused_nonsense);
            let key = self.registry.lock().quota_keys.get(&link.number).cloned();
            log_limit::warn!(of: key, "connection closed: {}", end.after());
        } else {
            tracing::debug!(link = link.number, "connection ended: {}", end.after());
        }
        if let ConnectionEnd::NotOpened(_) = end {
            count(&self.tally.dial_failures);
        }
        self.forget(link);
    }

    /// Whether the large letters of a connection that could not be opened may take another one. From then on, they do
    /// so without delay, for a pause that grows with each failure.
    pub(crate) fn has_detour(&self, link: &Arc<Link>) -> bool {
        let mut registry = self.registry.lock();
        let mut dialed = registry.large.dialed.iter();
        let Some((to, _)) = dialed.find(|(_, it)| Arc::ptr_eq(it, link)) else {
            return false;
        };
        let to = to.clone();
        let has_detour = registry.phase == Phase::Open && registry.any.open(&to).next().is_some();
        if has_detour {
            let pause = self.limits().connect_timeout;
            registry.large.note_retry(&to, Instant::now(), pause);
        }
        has_detour
    }

    /// Removes a connection from every table.
    pub(crate) fn forget(&self, link: &Arc<Link>) {
        let mut registry = self.registry.lock();
        if registry
            .links
            .get(&link.number)
            .is_some_and(|there| Arc::ptr_eq(there, link))
        {
            registry.links.remove(&link.number);
            registry.quota_keys.remove(&link.number);
            registry.peer_by_link.remove(&link.number);
        }
        let is_other = |other: &Arc<Link>| !Arc::ptr_eq(other, link);
        registry.inbound.retain(|_, (_, other)| is_other(other));
        let mut was_known = false;
        for load in [Load::Any, Load::Large] {
            let connections = registry.of_mut(load);
            connections.dialed.retain(|_, other| is_other(other));
            connections.known.retain(|_, links| {
                let before = links.len();
                links.retain(is_other);
                was_known |= links.len() < before;
                !links.is_empty()
            });
        }
        if was_known {
            self.tally.connections.fetch_sub(1, Ordering::Relaxed);
        }
    }

    /// Logs a failure to accept a connection, and pauses.
    pub(crate) async fn accept_failed(&self, error: &io::Error) {
        count(&self.tally.accept_failures);
        log_limit::warn!(
            "cannot accept a connection: {error}; retrying (for `too many open files`, raise `ulimit -n`)"
        );
        sleep(ACCEPT_RETRY_DELAY).await;
    }

    /// Admits an accepted connection before its peer's hello. Returns `None` when the endpoint is
    /// closed. When the limit is reached, another connection is evicted; likewise when the
    /// connections of one address take half of the limit.
    pub(crate) fn admit_unproved(self: &Arc<Self>, from: Source) -> Option<UnprovedSlot> {
        let home = from.home().whole();
        let (number, evicted) = {
            let mut registry = self.registry.lock();
            if registry.phase != Phase::Open {
                return None;
            }
            registry.last_unproved += 1;
            let most = self.limits().max_strangers.max(1);
            let of_home = registry.unproved.values().filter(|(it, _)| *it == home);
            let greedy = self.config.limits_peer_at(home) && of_home.count() >= most.div_ceil(2);
            let too_many = greedy || registry.unproved.len() >= most;
            let evicted = too_many
                .then(|| registry.eviction_candidate(home))
                .flatten();
            let evicted = evicted.and_then(|number| registry.unproved.remove(&number));
            let number = registry.last_unproved;
            registry.unproved.insert(number, (home, None));
            (number, evicted)
        };
        if let Some(task) = evicted.and_then(|(_, task)| task) {
            count(&self.tally.refused_crowd);
            task.abort();
        }
        Some(UnprovedSlot {
            endpoint: self.clone(),
            number,
        })
    }

    /// Whether the connections before their hello take at least half of their limit.
    #[cfg(feature = "quic")]
    pub(crate) fn is_crowded(&self) -> bool {
        self.registry.lock().unproved.len() * 2 >= self.limits().max_strangers
    }

    /// Sets the task that serves the connection with this number before its hello.
    pub(crate) fn unproved_started(&self, number: u64, task: AbortHandle) {
        // If it is absent, the peer has introduced itself or the connection has ended.
        if let Some((_, slot)) = self.registry.lock().unproved.get_mut(&number) {
            *slot = Some(task);
        }
    }
}

impl Connections {
    /// Returns the connections that lead to a location, the one opened for it first.
    fn open(&self, to: &Location) -> impl Iterator<Item = &Arc<Link>> {
        self.dialed.get(to).into_iter().chain(self.known_of(to))
    }

    fn known_of(&self, to: &Location) -> impl Iterator<Item = &Arc<Link>> {
        self.known.get(&to.incarnation()).into_iter().flatten()
    }

    /// Records that a connection is opened beside suspect ones, or could not be opened. The number of records is
    /// bounded by the connections that an endpoint may have within the longest pause.
    fn note_retry(&mut self, to: &Location, now: Instant, pause: Duration) {
        self.retries.retain(|_, it| !it.is_over(now, pause));
        let known = self.retries.entry(to.clone());
        let retries = known.or_insert(Retries {
            last: now,
            times: 0,
        });
        retries.times += 1;
        retries.last = now;
    }
}

impl Registry {
    fn of(&self, load: Load) -> &Connections {
        match load {
            Load::Any => &self.any,
            Load::Large => &self.large,
        }
    }

    fn of_mut(&mut self, load: Load) -> &mut Connections {
        match load {
            Load::Any => &mut self.any,
            Load::Large => &mut self.large,
        }
    }

    /// Returns the effect on other connections when this peer introduces itself on this link.
    ///
    /// # Errors
    /// When its incarnation is connected with another principal that has proved more.
    fn affected(
        &self,
        link: &Arc<Link>,
        this: &Peer,
    ) -> Result<SupersededConnections, &'static str> {
        let mut affected = SupersededConnections::default();
        let incarnation = this.identity.incarnation;
        let others = self.links.values().filter(|it| it.number != link.number);
        for (other, peer) in others.filter_map(|it| Some((it, self.peer_by_link.get(&it.number)?)))
        {
            let is_same = peer.identity.incarnation == incarnation;
            let list = match (this.proved, peer.proved) {
                (Some(proved), Some(other)) if proved != other && is_same => {
                    return Err(
                        "it claims the incarnation of a service that is connected with another certificate",
                    );
                }
                (None, Some(_)) if is_same => {
                    return Err(
                        "it has no certificate and claims the incarnation of a service that is connected with one",
                    );
                }
                // The other peer only claimed the incarnation.
                (Some(_), None) if is_same => &mut affected.superseded,
                (Some(proved), Some(before)) if proved == before && this.replaces(peer) => {
                    &mut affected.superseded
                }
                // The connected peer has listed this address itself. Both connections stay, unless
                // the peer has moved there.
                (None, None) if is_same && peer.is_also_at(this.home) => &mut affected.doubted,
                (None, None) if is_same && this.replaces(peer) => match this.home {
                    // The kernel proves the process.
                    Home::Process(_) => &mut affected.superseded,
                    // An unproved peer must not end the connections of the service that it claims
                    // to be.
                    #[cfg(feature = "ip")]
                    Home::Address(_) => &mut affected.asked,
                },
                _ if is_same && peer.home != this.home => &mut affected.doubted,
                _ => continue,
            };
            list.push(other.clone());
        }
        Ok(affected)
    }

    /// Adds an admitted connection to the other tables.
    ///
    /// # Errors
    /// When the peer has opened a later one.
    fn note(
        &mut self,
        link: &Arc<Link>,
        peer: Peer,
        inbound: Inbound,
    ) -> Result<(), ConnectionEnd> {
        if let Some((_, serial)) = &peer.dialed {
            match self.inbound.get(&inbound) {
                Some((later, _)) if later > serial => return Err(ConnectionEnd::Superseded),
                _ => self.inbound.insert(inbound, (*serial, link.clone())),
            };
        }
        let connections = self.of_mut(peer.load);
        let known = connections
            .known
            .entry(peer.identity.incarnation)
            .or_default();
        known.push(link.clone());
        self.peer_by_link.insert(link.number, peer);
        Ok(())
    }

    /// Selects the connection to evict when another one comes from `coming`: the oldest of the
    /// origin that has the most connections then. Frequent connections of one origin evict each
    /// other, so a peer with a slow link is still admitted.
    fn eviction_candidate(&self, coming: Home) -> Option<u64> {
        let mut homes: HashMap<Home, (usize, Reverse<u64>)> = HashMap::new();
        for (number, (home, task)) in &self.unproved {
            if task.is_some() {
                let fresh = || (usize::from(*home == coming), Reverse(*number));
                homes.entry(*home).or_insert_with(fresh).0 += 1;
            }
        }
        let most = homes.into_values().max();
        most.map(|(_, Reverse(oldest))| oldest)
    }
}

/// Reports interface changes to an endpoint until the endpoint is dropped or the task is aborted.
#[cfg(feature = "ip")]
async fn follow_interfaces(endpoint: Weak<Endpoint>, mut changes: Changes) {
    loop {
        changes.next().await;
        match endpoint.upgrade() {
            Some(endpoint) => endpoint.interfaces_changed(),
            None => return,
        }
    }
}

/// The slot of one accepted connection before its peer's hello. Dropping it frees the slot.
#[derive(Debug)]
pub(crate) struct UnprovedSlot {
    endpoint: Arc<Endpoint>,
    pub(crate) number: u64,
}

impl Drop for UnprovedSlot {
    fn drop(&mut self) {
        self.endpoint.registry.lock().unproved.remove(&self.number);
    }
}

#[cfg(all(test, feature = "ip"))]
mod tests;
