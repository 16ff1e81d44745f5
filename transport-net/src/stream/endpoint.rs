//! What the connections of one endpoint share: who is connected, and which connection leads
//! where.
//!
//! A location stays with one connection for as long as that lives, so that order holds. A
//! location with a known incarnation uses whatever connection there is with that incarnation,
//! whichever side opened it; so reports find their way back to peers that cannot be dialled. When
//! two endpoints connect to each other at the same time both connections are kept: the one that is
//! not used closes when it has been idle.
//!
//! A connection on which an attempt had no answer, and nothing else has come either, is *suspect*: the
//! system repeats lost packets more and more rarely, and a peer that has moved never answers. What is
//! dispatched from then on takes another connection with the same peer, which is opened if there is
//! none. When that is open and the suspect one is still silent, the suspect one ends.

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
    Abandoned, Answer, AttemptId, Hop, Incarnation, Kind, ListenError, Location, Parcel, Principal,
    Sink, Ticket, WayError, WayFault,
};
use parking_lot::Mutex;
use tokio::runtime::Handle;
use tokio::task::{AbortHandle, JoinHandle};
use tokio::time::sleep;

use super::config::{Limits, StreamConfig};
use super::connection::{Connection, Role, SendError, letter_len};
use super::counters::{Tally, count};
use super::link::{Link, MAX_LINKS, of_ticket};
use super::place::{Meter, Room, Rooms};
use super::source::{Account, Home, Source};
use crate::Identity;
#[cfg(feature = "ip")]
use crate::address::{self, Listening};
use crate::end::End;
use crate::hello::Hello;
#[cfg(feature = "ip")]
use crate::interfaces::Changes;
use crate::ration::Ration;
#[cfg(feature = "ip")]
use crate::ration::Rations;
use crate::seldom::warn_seldom;
#[cfg(feature = "ip")]
use crate::tcp::Legacy;

/// How long a service that is connected has to give a sign of life when a stranger says that it is the
/// service.
const SIGN_OF_LIFE: Duration = Duration::from_secs(1);

/// After so many silent connections, a stranger is refused when there are others to ask.
const MAX_ASKED: usize = 4;

/// The pause between connections that are opened beside suspect ones doubles this often.
const LONGEST_BESIDE: u32 = 4;

/// How long accepting rests when the system has no descriptors left.
const REST: Duration = Duration::from_millis(100);

#[derive(Debug)]
pub(crate) struct Endpoint {
    kind: Kind,
    pub(crate) config: StreamConfig,
    pub(crate) runtime: Handle,
    /// Letters of legacy peers, in both directions.
    #[cfg(feature = "ip")]
    pub(crate) legacy: Legacy,
    /// What is taken for letters that are arriving.
    pub(crate) rooms: Rooms,
    /// What is taken for bytes that peers may send ahead; see [`Self::window`].
    windows: Rooms,
    /// What peers may still send.
    #[cfg(feature = "ip")]
    rations: Rations,
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
    /// Connections that were dialled, or whose peer has said hello.
    links: HashMap<u32, Arc<Link>>,
    /// The connection that was opened for a location.
    dialled: HashMap<Location, Arc<Link>>,
    /// Locations for which connections were opened beside suspect ones.
    beside: HashMap<Location, Beside>,
    /// A connection with the service of this incarnation, and all others in the order they came.
    known: HashMap<Incarnation, Vec<Arc<Link>>>,
    /// The peers' last connections for each of the locations they dialled.
    inbound: HashMap<Inbound, (u64, Arc<Link>)>,
    /// The accounts of the accepted ones.
    accounts: HashMap<u32, Account>,
    /// The peers of the links, as they introduced themselves.
    peers: HashMap<u32, Peer>,
    /// Accepted connections that have not introduced themselves, oldest first, and whose they are.
    strangers: BTreeMap<u64, (Home, Option<AbortHandle>)>,
    last_stranger: u64,
    last_number: u32,
    last_serial: u64,
}

/// How often a connection was opened beside suspect ones, and when last.
#[derive(Debug, Clone, Copy)]
struct Beside {
    last: Instant,
    times: u32,
}

impl Beside {
    /// Whether it is too soon for another one. The pause doubles each time.
    fn is_soon(self, now: Instant, pause: Duration) -> bool {
        now < self.last + pause.saturating_mul(1 << self.times.min(LONGEST_BESIDE))
    }

    /// Whether it is so long ago that it does not matter any more.
    fn is_over(self, now: Instant, pause: Duration) -> bool {
        now >= self.last + pause.saturating_mul(4 << LONGEST_BESIDE)
    }
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
enum Phase {
    #[default]
    New,
    Open,
    Closed,
}

/// Where an endpoint is reached.
#[derive(Debug, Default)]
enum Reached {
    #[default]
    Nowhere,
    /// At the one socket with this address.
    Socket(String),
    #[cfg(feature = "ip")]
    Addresses(Listening),
}

impl Reached {
    /// What a hello says of it.
    fn texts(&self) -> Vec<String> {
        match self {
            Self::Nowhere => Vec::new(),
            Self::Socket(address) => vec![address.clone()],
            #[cfg(feature = "ip")]
            Self::Addresses(listening) => listening.texts(),
        }
    }
}

/// The peer of a link, as it introduced itself.
#[derive(Debug, Clone)]
struct Peer {
    identity: Identity,
    /// What it has proved about itself, if anything.
    proved: Option<Principal>,
    /// Where it was.
    home: Home,
    /// What it dialled, if it opened the connection, and the number that it gave to that.
    dialled: Option<(String, u64)>,
    /// Where it listens, as it says.
    listening: Vec<String>,
}

/// What follows for other connections from a peer's introduction.
#[derive(Default)]
struct Rivals {
    /// This one takes their place.
    superseded: Vec<Arc<Link>>,
    /// This one takes their place unless their peers give a sign of life.
    asked: Vec<Arc<Link>>,
    /// Their peer may have moved here.
    doubted: Vec<Arc<Link>>,
}

/// What tells a peer's connections for one location from others. With the address, so that a
/// stranger elsewhere cannot push out somebody's connection by using its incarnation.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Inbound {
    incarnation: Incarnation,
    home: Home,
    dialled: String,
}

impl Peer {
    /// Whether a peer at this home may be this one at another of its addresses: it has listed that.
    fn is_also_at(&self, home: Home) -> bool {
        match home {
            Home::Process(_) => false,
            #[cfg(feature = "ip")]
            Home::Address(ip) => self.home != home && address::lists(&self.listening, ip),
        }
    }

    /// Whether this connection takes the place of that one, if both are of the same service: that
    /// service was restarted, or it opened this one after that one, from another address or for the
    /// same location. Connections that cross each other stay, and so do those for several locations.
    fn replaces(&self, before: &Self) -> bool {
        if self.identity.incarnation != before.identity.incarnation {
            let (this, that) = (&self.identity, &before.identity);
            return (&this.name, &this.domain, &this.host)
                == (&that.name, &that.domain, &that.host);
        }
        match (&self.dialled, &before.dialled) {
            (Some((this, serial)), Some((that, earlier))) => {
                serial >= earlier && (self.home != before.home || this == that)
            }
            // A stranger at another address may be the service or not.
            (Some(_), None) => self.proved.is_none() && self.home != before.home,
            (None, _) => false,
        }
    }
}

/// The connection for a location.
enum Way {
    /// It is there.
    There(Arc<Link>),
    /// It has just been made up and is still to be opened.
    ToDial(Arc<Link>, Arc<dyn Sink>),
}

impl std::fmt::Debug for Registry {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Registry")
            .field("phase", &self.phase)
            .field("listening", &self.listening)
            .field("links", &self.links.len())
            .field("strangers", &self.strangers.len())
            .finish_non_exhaustive()
    }
}

impl Endpoint {
    /// An endpoint of this kind of transport; what has been opened, it does not ask.
    pub(crate) fn new(kind: Kind, config: StreamConfig, runtime: Handle) -> Arc<Self> {
        Arc::new(Self {
            kind,
            config,
            runtime,
            #[cfg(feature = "ip")]
            legacy: Legacy::default(),
            rooms: Rooms::default(),
            windows: Rooms::default(),
            #[cfg(feature = "ip")]
            rations: Rations::default(),
            tally: Tally::default(),
            registry: Mutex::default(),
        })
    }

    pub(crate) fn limits(&self) -> &Limits {
        &self.config.limits
    }

    /// What the peers there may still send, if that is limited.
    pub(crate) fn ration(&self, home: Home) -> Option<Arc<Ration>> {
        if !self.config.limits_peer_at(home) {
            return None;
        }
        match home {
            Home::Process(_) => None,
            #[cfg(feature = "ip")]
            Home::Address(ip) => self.rations.of(ip, self.limits().rates(), Instant::now()),
        }
    }

    /// Takes memory for arriving letters of this account.
    pub(crate) fn meter(&self, account: &Account) -> Meter {
        let budget = self.config.budget_of(account);
        self.rooms.meter(account.clone(), budget)
    }

    /// Takes room for bytes that a peer of this account may send ahead. The budget is as large as that of
    /// arriving letters.
    pub(crate) fn window(&self, account: &Account, len: usize) -> Option<Room> {
        let budget = self.config.budget_of(account);
        self.windows.meter(account.clone(), budget).take_now(len)
    }

    pub(crate) fn tally(&self) -> &Tally {
        &self.tally
    }

    /// Who is told, while the endpoint is open.
    #[cfg(feature = "ip")]
    pub(crate) fn sink(&self) -> Option<Arc<dyn Sink>> {
        self.registry.lock().sink.clone()
    }

    /// Whether the endpoint can be opened.
    ///
    /// # Errors
    /// When it was opened before, or its identity cannot be told.
    fn may_listen(&self) -> Result<(), ListenError> {
        if self.registry.lock().phase != Phase::New {
            return Err(ListenError::OpenedBefore);
        }
        match self.config.identity.fault() {
            Some(fault) => Err(ListenError::Unavailable(fault)),
            None => Ok(()),
        }
    }

    /// Opens the one socket of the endpoint with `open`, which returns its address as well, and has
    /// `accept` start the task that serves it. Returns where the endpoint is reached.
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

    /// Another socket takes the place of the one of [`listen_at`](Self::listen_at), at the same
    /// address. Does nothing when the endpoint is not open.
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

    /// Opens a socket at each of these addresses with `open`, which returns the address that the
    /// socket is bound to as well, and has `accept` start the task that serves it. Returns where the
    /// endpoint is reached at present; the sink is told when that changes.
    ///
    /// # Errors
    /// When the endpoint was opened before, or a socket cannot be opened.
    #[cfg(feature = "ip")]
    pub(crate) fn listen<S>(
        self: &Arc<Self>,
        sink: Arc<dyn Sink>,
        listen: &[String],
        open: impl Fn(&str) -> Result<(S, SocketAddr), ListenError>,
        accept: impl Fn(S) -> JoinHandle<()>,
    ) -> Result<Vec<Location>, ListenError> {
        self.may_listen()?;
        let _inside = self.runtime.enter();
        let (mut sockets, mut bound) = (Vec::new(), Vec::new());
        for text in listen {
            let (socket, address) = open(text)?;
            bound.push(address);
            sockets.push(socket);
        }
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

    /// What a hello says of where this endpoint is reached.
    #[cfg(feature = "ip")]
    pub(crate) fn listening(&self) -> Vec<String> {
        self.registry.lock().listening.texts()
    }

    /// The interfaces of this host have changed: tells the sink where the endpoint is reached now,
    /// and ends the connections of addresses that this host has no more, on which nothing can
    /// arrive.
    #[cfg(feature = "ip")]
    fn interfaces_changed(&self) {
        let (sink, told, lost, links) = {
            let mut registry = self.registry.lock();
            let Reached::Addresses(listening) = &mut registry.listening else {
                return;
            };
            let moved = match listening.refresh() {
                Ok(moved) => moved,
                Err(error) => {
                    tracing::warn!(kind = %self.kind, %error, "the locations stay as they were");
                    return;
                }
            };
            let incarnation = self.config.identity.incarnation;
            let told = moved
                .relocated
                .then(|| listening.locations(self.kind, incarnation));
            let links: Vec<_> = match moved.lost.is_empty() {
                true => Vec::new(),
                false => registry.links.values().cloned().collect(),
            };
            (registry.sink.clone(), told, moved.lost, links)
        };
        for link in links {
            if let Some(ip) = link.local_ip()
                && lost.contains(&ip)
            {
                let what = format!("this host no longer has the address {ip}");
                link.leave(End::Broken(what));
                // What is dispatched from now on needs another connection.
                self.forget(&link);
            }
        }
        match (sink, told) {
            (Some(sink), Some(Ok(locations))) => sink.relocated(locations),
            (_, Some(Err(error))) => {
                tracing::warn!(kind = %self.kind, %error, "the locations stay as they were");
            }
            _ => {}
        }
    }

    /// Ends everything. The connections' tasks conclude what is outstanding.
    pub(crate) fn close(&self) {
        #[cfg(feature = "ip")]
        self.legacy.close();
        let (links, tasks) = {
            let mut registry = self.registry.lock();
            registry.phase = Phase::Closed;
            registry.sink = None;
            let mut tasks = std::mem::take(&mut registry.listeners);
            tasks.extend(
                std::mem::take(&mut registry.strangers)
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
            link.leave(End::Closed);
        }
    }

    /// Whether a parcel can be taken at all for this location.
    pub(crate) fn check(&self, to: &Location, parcel: &Parcel) -> Result<(), WayError> {
        if to.kind() != self.kind {
            let detail = format!("{to} is no {} location", self.kind);
            return Err(WayError::new(WayFault::Unreachable, detail));
        }
        if parcel.receiver.is_empty() || parcel.receiver.len() > Parcel::MAX_NAME {
            let detail = "the receiver's name is empty or too long";
            return Err(WayError::new(WayFault::Refused, detail));
        }
        let (len, max) = (letter_len(parcel), self.limits().max_letter);
        if len > max as u64 {
            let detail = format!("{len} bytes; at most {max} are taken (max_letter)");
            return Err(WayError::new(WayFault::TooLarge, detail));
        }
        Ok(())
    }

    /// Sends a parcel over the connection that leads to a location. When there is none, `dial` is
    /// to start the task of one.
    pub(crate) fn dispatch(
        &self,
        attempt: AttemptId,
        to: &Location,
        parcel: &Parcel,
        dial: impl Fn(Arc<Link>, Arc<dyn Sink>) -> JoinHandle<()>,
    ) -> Result<(), WayError> {
        loop {
            let (link, fresh) = match self.way_to(to)? {
                Way::There(link) => (link, None),
                Way::ToDial(link, sink) => (link, Some(sink)),
            };
            let sent = link.send(attempt, parcel);
            if let Some(sink) = fresh {
                let task = dial(link.clone(), sink);
                if task.is_finished() && !link.has_begun() {
                    self.forget(&link);
                    let detail = "the runtime of this endpoint has been shut down";
                    return Err(WayError::new(WayFault::Closed, detail));
                }
                return sent.map_err(|error| match error {
                    SendError::Way(error) => error,
                    SendError::Ended => End::Closed.after(),
                });
            }
            match sent {
                Ok(()) => return Ok(()),
                Err(SendError::Way(error)) => return Err(error),
                // It ended in this moment: the next turn makes up another.
                Err(SendError::Ended) => self.forget(&link),
            }
        }
    }

    /// The connection that leads to a location, made up when there is none.
    fn way_to(&self, to: &Location) -> Result<Way, WayError> {
        let mut registry = self.registry.lock();
        let sink = match (registry.phase, &registry.sink) {
            (Phase::Open, Some(sink)) => sink.clone(),
            (Phase::New, _) => {
                return Err(WayError::new(WayFault::Closed, "listen was not called yet"));
            }
            _ => return Err(End::Closed.after()),
        };
        let dialled = registry.dialled.get(to);
        let known = registry.known.get(&to.incarnation());
        let open = || dialled.into_iter().chain(known.into_iter().flatten());
        let is_full = registry.links.len() >= self.limits().max_connections;
        let healthy = open().find(|link| !link.is_suspect());
        // Another connection is opened beside suspect ones, if it gets a place, and ever more rarely:
        // a peer that is busy is not to be given more work.
        let now = Instant::now();
        let spare = self.limits().connect_timeout;
        let is_soon = || {
            registry
                .beside
                .get(to)
                .is_some_and(|it| it.is_soon(now, spare))
        };
        let link = healthy.or_else(|| open().next().filter(|_| is_full || is_soon()));
        if let Some(link) = link.cloned() {
            if dialled.is_none_or(|dialled| !Arc::ptr_eq(dialled, &link)) {
                drop(registry);
                link.is_used_for(to);
            }
            return Ok(Way::There(link));
        }
        if is_full {
            return Err(End::Crowd.after());
        }
        let suspect: Vec<_> = open().cloned().collect();
        let serial = registry.last_serial + 1;
        registry.last_serial = serial;
        let role = Role::Dialler {
            expected: to.incarnation(),
        };
        let link = self.make_link(&mut registry, role, serial, to.to_string());
        if !suspect.is_empty() {
            registry.note_beside(to, now, spare);
        }
        link.opened_beside(suspect);
        registry.links.insert(link.number, link.clone());
        registry.dialled.insert(to.clone(), link.clone());
        Ok(Way::ToDial(link, sink))
    }

    /// Answers a parcel on the connection that it came by, if that is still there.
    pub(crate) fn answer(&self, ticket: Ticket, answer: &Answer) {
        let (number, id) = of_ticket(ticket);
        let link = self.registry.lock().links.get(&number).cloned();
        if let Some(link) = link {
            link.answer(id, answer);
        }
    }

    /// Ends an attempt, on whichever connection it is.
    pub(crate) fn abandon(&self, attempt: AttemptId) -> Abandoned {
        let links: Vec<_> = self.registry.lock().links.values().cloned().collect();
        let unsent = |link: &Arc<Link>| link.abandon(attempt) == Abandoned::NotSent;
        if links.iter().any(unsent) {
            return Abandoned::NotSent;
        }
        #[cfg(feature = "ip")]
        return self.legacy.abandon(attempt);
        #[cfg(not(feature = "ip"))]
        Abandoned::Unconfirmed
    }

    /// A link for a connection that was accepted, unless the endpoint has been closed.
    pub(crate) fn accepted(&self) -> Option<(Arc<Link>, Arc<dyn Sink>)> {
        let mut registry = self.registry.lock();
        let sink = registry.sink.clone()?;
        let link = self.make_link(&mut registry, Role::Acceptor, 0, String::new());
        Some((link, sink))
    }

    fn make_link(
        &self,
        registry: &mut Registry,
        role: Role,
        serial: u64,
        dialled: String,
    ) -> Arc<Link> {
        let hello = Hello {
            identity: self.config.identity.clone(),
            max_letter: self.limits().max_letter as u64,
            max_in_flight: u32::try_from(self.limits().max_in_flight.max(1)).unwrap_or(u32::MAX),
            serial,
            dialled,
            listening: registry.listening.texts(),
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

    /// A peer has introduced itself on a connection. Returns where its parcels come from.
    ///
    /// # Errors
    /// When the connection is not wanted.
    pub(crate) async fn enter(
        &self,
        link: &Arc<Link>,
        peer: &Hello,
        proved: Option<Principal>,
        from: Source,
    ) -> Result<Hop, End> {
        if !self.is_sought_by(peer) {
            // It takes the place of none of the peer's connections with this service.
            return Err(End::NotSought);
        }
        let incarnation = peer.identity.incarnation;
        let inbound = Inbound {
            incarnation,
            home: from.home(),
            dialled: peer.dialled.clone(),
        };
        let this = Peer {
            identity: peer.identity.clone(),
            proved,
            home: from.home(),
            dialled: (!peer.dialled.is_empty()).then(|| (peer.dialled.clone(), peer.serial)),
            listening: peer.listening.clone(),
        };
        let mut silent: Vec<u32> = Vec::new();
        let rivals = loop {
            let asked = {
                let mut registry = self.registry.lock();
                if registry.phase != Phase::Open {
                    return Err(End::Closed);
                }
                let rivals = registry.rivals(link, &this);
                let mut rivals = rivals.map_err(|why| self.refuse(from, why))?;
                let (gone, asked): (Vec<_>, Vec<_>) = std::mem::take(&mut rivals.asked)
                    .into_iter()
                    .partition(|rival| silent.contains(&rival.number));
                if asked.is_empty() {
                    rivals.superseded.extend(gone);
                    self.admit(&mut registry, link, &this, &rivals.superseded, from)?;
                    count(match this.dialled {
                        Some(_) => &self.tally.accepted,
                        None => &self.tally.dialled,
                    });
                    registry.note(link, this, inbound)?;
                    count(&self.tally.connections);
                    break rivals;
                }
                asked
            };
            if silent.len() > MAX_ASKED {
                return Err(End::Crowd);
            }
            let now = Instant::now();
            asked.iter().for_each(|rival| rival.ask());
            for rival in asked {
                if rival.answers(now, SIGN_OF_LIFE).await {
                    return Err(self.refuse(from, "its incarnation has a connection that is alive"));
                }
                silent.push(rival.number);
            }
        };
        for other in rivals.doubted {
            other.doubt();
        }
        for superseded in &rivals.superseded {
            superseded.leave(End::Superseded);
        }
        for superseded in rivals.superseded {
            // What the peer sent on its connection before this one must not arrive after what it
            // sends now.
            superseded.over().await;
        }
        let (principal, back) = match from {
            // A process of this host is reached at the socket that bears its incarnation.
            Source::Process(_) => (Principal::Host, incarnation.to_string()),
            #[cfg(feature = "ip")]
            Source::Address(from) => (
                self.config.principal_at(from.ip(), &peer.identity),
                address::way_back(&peer.listening, from).to_string(),
            ),
        };
        let location = Location::new(self.kind, &back)
            .map_err(|error| End::Nonsense(error.to_string()))?
            .with_incarnation(incarnation);
        Ok(Hop {
            location,
            principal: proved.unwrap_or(principal),
        })
    }

    /// Whether the peer opened the connection for this service, as far as it says. If not, it dialled
    /// an address that another incarnation had before.
    fn is_sought_by(&self, peer: &Hello) -> bool {
        let sought = peer.dialled.parse::<Location>().ok();
        let sought = sought.map_or(Incarnation::UNKNOWN, |location| location.incarnation());
        !sought.is_known() || sought == self.config.identity.incarnation
    }

    /// Gives a place to a connection whose peer has introduced itself, in place of others.
    ///
    /// # Errors
    /// When there is none.
    fn admit(
        &self,
        registry: &mut Registry,
        link: &Arc<Link>,
        peer: &Peer,
        superseded: &[Arc<Link>],
        from: Source,
    ) -> Result<(), End> {
        if registry.links.contains_key(&link.number) {
            return Ok(());
        }
        let goes = |number: &u32| superseded.iter().any(|other| other.number == *number);
        let account = Account::of(from, peer.proved.as_ref());
        let accounts = registry.accounts.iter();
        let of_account = accounts
            .filter(|(number, it)| **it == account && !goes(number))
            .count();
        let all = registry.links.len() - registry.links.keys().filter(|it| goes(it)).count();
        if all >= self.limits().max_connections || of_account >= self.config.places_of(&account) {
            count(&self.tally.refused_crowd);
            return Err(End::Crowd);
        }
        registry.accounts.insert(link.number, account);
        registry.links.insert(link.number, link.clone());
        Ok(())
    }

    /// Says why a peer is not the service that it says it is.
    fn refuse(&self, from: Source, why: &'static str) -> End {
        let before = self.tally.refused_unproved.fetch_add(1, Ordering::Relaxed);
        warn_seldom(before, format_args!("{from}: connection refused: {why}"));
        End::Impostor(why)
    }

    /// A connection has ended: nothing leads there any more.
    pub(crate) fn left(&self, link: &Arc<Link>, end: &End) {
        if end.is_misbehaviour() {
            let before = self.tally.refused_nonsense.fetch_add(1, Ordering::Relaxed);
            warn_seldom(before, format_args!("connection closed: {}", end.after()));
        } else {
            tracing::debug!(link = link.number, "connection ended: {}", end.after());
        }
        if let End::NotOpened(_) = end {
            count(&self.tally.dial_failures);
        }
        self.forget(link);
    }

    /// Takes a connection out of every table.
    pub(crate) fn forget(&self, link: &Arc<Link>) {
        let mut registry = self.registry.lock();
        if registry
            .links
            .get(&link.number)
            .is_some_and(|there| Arc::ptr_eq(there, link))
        {
            registry.links.remove(&link.number);
            registry.accounts.remove(&link.number);
            registry.peers.remove(&link.number);
        }
        let is_other = |other: &Arc<Link>| !Arc::ptr_eq(other, link);
        registry.dialled.retain(|_, other| is_other(other));
        registry.inbound.retain(|_, (_, other)| is_other(other));
        let mut was_known = false;
        registry.known.retain(|_, links| {
            let before = links.len();
            links.retain(is_other);
            was_known |= links.len() < before;
            !links.is_empty()
        });
        if was_known {
            self.tally.connections.fetch_sub(1, Ordering::Relaxed);
        }
    }

    /// Accepting a connection has failed: tells that, and rests.
    pub(crate) async fn accept_failed(&self, error: &io::Error) {
        let before = self.tally.accept_failures.fetch_add(1, Ordering::Relaxed);
        warn_seldom(
            before,
            format_args!("cannot accept a connection: {error} (`ulimit -n`?)"),
        );
        sleep(REST).await;
    }

    /// Gives a place to a connection accepted from this home that has not introduced itself, unless
    /// the endpoint has been closed. One too many pushes out another; so does one more of an address
    /// that has half of all places.
    pub(crate) fn receive_stranger(self: &Arc<Self>, from: Source) -> Option<Stranger> {
        let home = from.home().whole();
        let (number, pushed_out) = {
            let mut registry = self.registry.lock();
            if registry.phase != Phase::Open {
                return None;
            }
            registry.last_stranger += 1;
            let most = self.limits().max_strangers.max(1);
            let of_home = registry.strangers.values().filter(|(it, _)| *it == home);
            let greedy = self.config.limits_peer_at(home) && of_home.count() >= most.div_ceil(2);
            let too_many = greedy || registry.strangers.len() >= most;
            let pushed_out = too_many.then(|| registry.one_too_many(home)).flatten();
            let pushed_out = pushed_out.and_then(|number| registry.strangers.remove(&number));
            let number = registry.last_stranger;
            registry.strangers.insert(number, (home, None));
            (number, pushed_out)
        };
        if let Some(task) = pushed_out.and_then(|(_, task)| task) {
            count(&self.tally.refused_crowd);
            task.abort();
        }
        Some(Stranger {
            endpoint: self.clone(),
            number,
        })
    }

    /// Whether so many have not introduced themselves yet that one should be slow to take more.
    #[cfg(feature = "quic")]
    pub(crate) fn is_crowded(&self) -> bool {
        self.registry.lock().strangers.len() * 2 >= self.limits().max_strangers
    }

    /// The stranger with this number is served by this task.
    pub(crate) fn stranger_started(&self, number: u64, task: AbortHandle) {
        // Otherwise it is no stranger any more, or gone.
        if let Some((_, place)) = self.registry.lock().strangers.get_mut(&number) {
            *place = Some(task);
        }
    }
}

impl Registry {
    /// What follows for others when this peer introduces itself on this link.
    ///
    /// # Errors
    /// When its incarnation is connected with another principal that has proved more.
    fn rivals(&self, link: &Arc<Link>, this: &Peer) -> Result<Rivals, &'static str> {
        let mut rivals = Rivals::default();
        let incarnation = this.identity.incarnation;
        let others = self.links.values().filter(|it| it.number != link.number);
        for (other, peer) in others.filter_map(|it| Some((it, self.peers.get(&it.number)?))) {
            let is_same = peer.identity.incarnation == incarnation;
            let list = match (this.proved, peer.proved) {
                (Some(proved), Some(other)) if proved != other && is_same => {
                    return Err("its incarnation is connected with another certificate");
                }
                (None, Some(_)) if is_same => {
                    return Err("its incarnation is connected with a certificate");
                }
                // It was only claimed.
                (Some(_), None) if is_same => &mut rivals.superseded,
                (Some(proved), Some(before)) if proved == before && this.replaces(peer) => {
                    &mut rivals.superseded
                }
                // The connected peer itself has said that it has this address. Both connections stay,
                // unless it has moved there.
                (None, None) if is_same && peer.is_also_at(this.home) => &mut rivals.doubted,
                (None, None) if is_same && this.replaces(peer) => match this.home {
                    // The kernel proves the process.
                    Home::Process(_) => &mut rivals.superseded,
                    // A stranger must not end the connections of the service that it claims to be.
                    #[cfg(feature = "ip")]
                    Home::Address(_) => &mut rivals.asked,
                },
                _ if is_same && peer.home != this.home => &mut rivals.doubted,
                _ => continue,
            };
            list.push(other.clone());
        }
        Ok(rivals)
    }

    /// Enters a connection that has a place into the other tables.
    ///
    /// # Errors
    /// When the peer has opened a later one.
    fn note(&mut self, link: &Arc<Link>, peer: Peer, inbound: Inbound) -> Result<(), End> {
        if let Some((_, serial)) = &peer.dialled {
            match self.inbound.get(&inbound) {
                Some((later, _)) if later > serial => return Err(End::Superseded),
                _ => self.inbound.insert(inbound, (*serial, link.clone())),
            };
        }
        let known = self.known.entry(peer.identity.incarnation).or_default();
        known.push(link.clone());
        self.peers.insert(link.number, peer);
        Ok(())
    }

    /// A connection is opened beside suspect ones now. What is remembered is bounded by the connections
    /// that an endpoint may have within the longest pause.
    fn note_beside(&mut self, to: &Location, now: Instant, pause: Duration) {
        self.beside.retain(|_, it| !it.is_over(now, pause));
        let known = self.beside.entry(to.clone());
        let beside = known.or_insert(Beside {
            last: now,
            times: 0,
        });
        beside.times += 1;
        beside.last = now;
    }

    /// Which stranger goes when another one comes from this home: the oldest of those from the home
    /// that has the most places then. So those who knock often push out each other, and somebody with
    /// a slow link gets in beside them.
    fn one_too_many(&self, coming: Home) -> Option<u64> {
        let mut homes: HashMap<Home, (usize, Reverse<u64>)> = HashMap::new();
        for (number, (home, task)) in &self.strangers {
            if task.is_some() {
                let fresh = || (usize::from(*home == coming), Reverse(*number));
                homes.entry(*home).or_insert_with(fresh).0 += 1;
            }
        }
        let most = homes.into_values().max();
        most.map(|(_, Reverse(oldest))| oldest)
    }
}

/// Tells an endpoint of changes of the interfaces, until it is gone or the task is aborted.
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

/// The place of one stranger; dropping it gives the place free.
#[derive(Debug)]
pub(crate) struct Stranger {
    endpoint: Arc<Endpoint>,
    pub(crate) number: u64,
}

impl Drop for Stranger {
    fn drop(&mut self) {
        self.endpoint.registry.lock().strangers.remove(&self.number);
    }
}

#[cfg(all(test, feature = "ip"))]
#[path = "endpoint_tests.rs"]
mod tests;
