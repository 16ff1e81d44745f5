//! The protocol of one endpoint without sockets and clock: its connections, the assignment of
//! datagrams to them, and the replies to unproved peers.
//!
//! A location keeps its connection until that connection ends, so that order is preserved. A
//! location with a known incarnation uses any connection with that incarnation, opened by either
//! side; this is how reports reach peers that cannot be reached otherwise.
//!
//! The endpoint stores no state about a peer that has not returned a cookie, and its replies to
//! such a peer are shorter than the peer's datagram. A datagram for a connection only counts with
//! the right number of 64 random bits, from the address that the connection was opened from.

mod greeting;

use std::collections::{HashMap, HashSet, VecDeque};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_transport::{
    Abandoned, Answer, AttemptId, Conclusion, Hop, Incarnation, Introduction, Location, Mandate,
    Parcel, Ticket, TransportError, TransportErrorKind, log_limit, quota_address,
};

use super::config::UdpLimits;
use super::connection::{Connection, Event, MAX_ID};
use super::counters::UdpCounters;
use super::packet::{self, Datagram};
use crate::Identity;
use crate::address;
use crate::datagrams::connections::{Connections, Scheduled};
use crate::datagrams::cookie::Cookies;
use crate::datagrams::{DatagramCore, Outbound, Path, Random, Transmit};
use crate::end::ConnectionEnd;
use crate::rate_limit::{PeerRateLimit, PeerRateLimits, is_one_peer};
use crate::stream::budget::{ByteBudget, Meter};
use crate::stream::source::{Home, QuotaKey};

/// Maximum number of queued datagrams to unproved peers; further ones are dropped.
const MAX_OUTBOX: usize = 64;

/// An event for the sink.
#[derive(Debug)]
pub(crate) enum CoreEvent {
    Arrived {
        parcel: Box<Parcel>,
        from: Hop,
        ticket: Ticket,
    },
    Concluded(AttemptId, Conclusion),
    /// A peer has introduced itself.
    Introduced(Introduction),
    /// The connection of an introduced peer has ended.
    Disconnected(Introduction),
}

pub(crate) struct Core {
    identity: Identity,
    limits: UdpLimits,
    listening: Vec<String>,
    cookies: Cookies,
    random: Random,
    connections: Connections<Entry>,
    /// Connections by the identifier that peers put on their datagrams.
    ids: HashMap<u64, u32>,
    /// Connections opened by this side, by location.
    dialed: HashMap<Location, u32>,
    /// The connections with the service of an incarnation, in the order of introduction.
    known: HashMap<Incarnation, Vec<u32>>,
    /// The latest connection of each peer for each location that the peer dialed, with the peer's
    /// serial number.
    inbound: HashMap<Inbound, (u64, u32)>,
    /// Accepted connections by the source address and the initiator number of their hello.
    greeted: HashMap<(SocketAddr, u64), u32>,
    outbox: VecDeque<Outbound>,
    /// Events of the endpoint, delivered before the events of connections.
    notes: VecDeque<CoreEvent>,
    /// Rate limits of the peers.
    rate_limits: PeerRateLimits,
    /// Memory of parcels that wait for earlier ones.
    byte_budget: ByteBudget,
    counters: UdpCounters,
    last_serial: u64,
}

struct Entry {
    connection: Connection,
    /// The location that this side dialed, if it opened the connection.
    dialed: Option<Location>,
    /// The introduction of the peer, after its hello.
    peer: Option<Introduction>,
    /// The source address and initiator number of the hello, if the peer opened the connection.
    greeted: Option<(SocketAddr, u64)>,
    /// Time of the ping that was sent because another peer claims to be the same service.
    asked: Option<Instant>,
}

impl Scheduled for Entry {
    fn path(&self) -> Option<Path> {
        self.connection.path()
    }

    fn has_events(&self) -> bool {
        self.connection.has_events()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        self.connection.poll_timeout()
    }
}

/// The key of a peer's connections for one location. It contains the address, so that an unproved
/// peer elsewhere cannot replace the connection of a service by claiming its incarnation.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Inbound {
    incarnation: Incarnation,
    ip: IpAddr,
    dialed: String,
}

impl Core {
    pub(crate) fn new(
        identity: Identity,
        limits: UdpLimits,
        listening: Vec<String>,
        mut random: Random,
        now: Instant,
    ) -> Self {
        let cookies = Cookies::new((random(), random()), now);
        Self {
            identity,
            limits,
            listening,
            cookies,
            random,
            connections: Connections::new(),
            ids: HashMap::new(),
            dialed: HashMap::new(),
            known: HashMap::new(),
            inbound: HashMap::new(),
            greeted: HashMap::new(),
            outbox: VecDeque::new(),
            notes: VecDeque::new(),
            rate_limits: PeerRateLimits::default(),
            byte_budget: ByteBudget::default(),
            counters: UdpCounters::default(),
            last_serial: 0,
        }
    }

    pub(crate) fn counters(&self) -> UdpCounters {
        self.counters
    }

    /// Returns the rate limit of the peer at this address, if it has one.
    fn rate_limit(&self, ip: IpAddr, now: Instant) -> Option<Arc<PeerRateLimit>> {
        is_one_peer(ip).then(|| self.rate_limits.of(ip, self.limits.rates(), now))?
    }

    /// Returns a meter that reserves memory for parcels of the peers at this address.
    fn meter(&self, ip: IpAddr) -> Meter {
        let home = quota_address(ip);
        let quota_key = QuotaKey::Unproved(Home::Address(home));
        self.byte_budget
            .meter(quota_key, self.limits.budget_of(home))
    }

    /// Queues a parcel for sending. Returns the number of the connection if it is new; the caller
    /// then calls [`begin`](Self::begin) or [`cannot_begin`](Self::cannot_begin).
    pub(crate) fn post(
        &mut self,
        now: Instant,
        attempt: AttemptId,
        to: &Location,
        parcel: &Parcel,
    ) -> Result<Option<u32>, TransportError> {
        let dialed = self.dialed.get(to).copied();
        let known = self.known.get(&to.incarnation());
        let there = dialed.or_else(|| known.and_then(|numbers| numbers.first().copied()));
        let (number, fresh) = match there {
            Some(number) => (number, false),
            None => (self.create(now, to)?, true),
        };
        let Some(entry) = self.connections.get_mut(number) else {
            return Err(TransportError::new(
                TransportErrorKind::Broken,
                "the connection has ended",
            ));
        };
        if dialed.is_none() && !fresh {
            entry.connection.is_used_for(now, to);
        }
        if let Err(error) = entry.connection.send(attempt, parcel) {
            if fresh {
                self.remove(number);
            }
            return Err(error);
        }
        self.connections.touch(number);
        Ok(fresh.then_some(number))
    }

    /// Sets the listening addresses that later hellos contain.
    pub(crate) fn listens_on(&mut self, listening: Vec<String>) {
        self.listening = listening;
    }

    /// Ends the connections that are bound to addresses that this host no longer has. `local`
    /// returns the address of a socket that belongs to one connection.
    pub(crate) fn lost(&mut self, lost: &HashSet<IpAddr>, local: impl Fn(u32) -> Option<IpAddr>) {
        let numbers = self.connections.bound_to(lost, local);
        for (number, ip) in numbers {
            let what = format!("this host no longer has the address {ip}");
            self.end(number, &ConnectionEnd::Broken(what));
        }
    }

    /// Puts the connections with this location in doubt, because the service has announced that it is elsewhere.
    pub(crate) fn location_vacated(&mut self, now: Instant, location: &Location) {
        let home = address::numeric(location.authority()).ok();
        let home = home.map(|address| address.ip());
        let known = self.known.get(&location.incarnation());
        for number in known.cloned().unwrap_or_default() {
            self.with(number, |connection, _| {
                let path = connection.path().map(|path| path.remote.ip());
                if path.is_some() && path == home {
                    connection.peer_moved(now);
                }
                Ok(())
            });
        }
    }

    /// Ends a new connection that cannot be opened.
    pub(crate) fn cannot_begin(&mut self, number: u32, error: TransportError) {
        self.end(number, &ConnectionEnd::NotOpened(error));
    }

    /// Ends an attempt to this location.
    pub(crate) fn abandon(&mut self, attempt: AttemptId, to: &Location) -> Abandoned {
        self.notes
            .retain(|event| !matches!(event, CoreEvent::Concluded(other, _) if *other == attempt));
        let dialed = self.dialed.get(to).into_iter();
        let known = self.known.get(&to.incarnation()).into_iter().flatten();
        for number in dialed.chain(known) {
            let Some(entry) = self.connections.get_mut(*number) else {
                continue;
            };
            let end = entry.connection.abandon(attempt);
            self.connections.touch(*number);
            if end == Abandoned::NotSent {
                return end;
            }
        }
        Abandoned::Unconfirmed
    }

    pub(crate) fn answer(&mut self, now: Instant, ticket: Ticket, answer: &Answer) {
        let number = u32::try_from(ticket.0 / MAX_ID).unwrap_or(u32::MAX);
        let id = ticket.0 % MAX_ID;
        self.with(number, |connection, _| {
            connection.answer(id, answer, now);
            Ok(())
        });
    }

    /// Handles the failure to send the last datagram because of its size.
    pub(crate) fn too_big(&mut self, number: u32, size: usize) {
        self.with(number, |connection, _| connection.too_big(size));
    }

    /// Ends every connection.
    pub(crate) fn close(&mut self) {
        for number in self.connections.numbers() {
            self.end(number, &ConnectionEnd::Closed);
        }
    }

    /// Creates a connection for a location.
    fn create(&mut self, now: Instant, to: &Location) -> Result<u32, TransportError> {
        if self.connections.len() >= self.limits.max_connections {
            return Err(ConnectionEnd::TooManyConnections.after());
        }
        self.last_serial += 1;
        let mut hasher = DefaultHasher::new();
        to.hash(&mut hasher);
        let hello = self.own_hello(self.last_serial, format!("{:016x}", hasher.finish()));
        let id = self.fresh_id();
        let limits = self.limits.clone();
        let connection = Connection::dialing(limits, id, to.incarnation(), hello, now);
        let number = self.insert(connection, Some(to.clone()), None);
        self.dialed.insert(to.clone(), number);
        Ok(number)
    }

    /// Calls `act` with a connection, and handles its result.
    fn with(
        &mut self,
        number: u32,
        act: impl FnOnce(&mut Connection, &mut UdpCounters) -> Result<(), ConnectionEnd>,
    ) {
        let Some(entry) = self.connections.get_mut(number) else {
            return;
        };
        match act(&mut entry.connection, &mut self.counters) {
            Ok(()) => self.connections.touch(number),
            Err(end) => self.end(number, &end),
        }
    }

    fn end(&mut self, number: u32, end: &ConnectionEnd) {
        let Some(entry) = self.remove(number) else {
            return;
        };
        if end.is_misbehavior() {
            log_limit::warn!(
                of: entry.connection.path().map(|path| quota_address(path.remote.ip())),
                "connection closed: {}",
                end.after()
            );
            self.counters.refused_nonsense += 1;
        } else {
            tracing::debug!(connection = number, "connection ended: {}", end.after());
        }
        if let ConnectionEnd::NotOpened(_) = end {
            self.counters.dial_failures += 1;
        }
        let (concluded, goodbye) = entry.connection.end(end);
        let concluded = concluded.into_iter();
        self.notes
            .extend(concluded.map(|(attempt, what)| CoreEvent::Concluded(attempt, what)));
        self.notes.extend(entry.peer.map(CoreEvent::Disconnected));
        // Bounded by the number of connections.
        self.outbox.extend(goodbye);
    }

    fn insert(
        &mut self,
        connection: Connection,
        dialed: Option<Location>,
        greeted: Option<(SocketAddr, u64)>,
    ) -> u32 {
        let id = connection.id();
        let number = self.connections.insert(Entry {
            connection,
            dialed,
            peer: None,
            greeted,
            asked: None,
        });
        self.ids.insert(id, number);
        number
    }

    /// Registers the peer of a connection.
    fn enter(&mut self, now: Instant, number: u32, name: Arc<str>, hop: Hop) {
        self.doubt_others(now, number, hop.location.incarnation());
        if let Some(entry) = self.connections.get_mut(number) {
            let incarnation = hop.location.incarnation();
            let peer = Introduction {
                name,
                hop,
                dialed: entry.dialed.clone(),
                mandate: Mandate::Unproved,
            };
            self.notes.push_back(CoreEvent::Introduced(peer.clone()));
            entry.peer = Some(peer);
            self.known.entry(incarnation).or_default().push(number);
            self.counters.connections += 1;
        }
    }

    /// Puts the connections of the same service from other addresses in doubt, because the service
    /// may have moved. They get a ping instead of ending, because an unproved peer must not end the
    /// connections of the service that it claims to be.
    fn doubt_others(&mut self, now: Instant, number: u32, incarnation: Incarnation) {
        let remote = |entry: &Entry| Some(entry.connection.path()?.remote.ip());
        let address = self.connections.get(number).and_then(remote);
        let others = self.known.get(&incarnation).cloned().unwrap_or_default();
        for other in others {
            if let Some(entry) = self.connections.get_mut(other)
                && remote(entry) != address
            {
                entry.connection.doubt(now, Duration::ZERO);
                self.connections.touch(other);
            }
        }
    }

    /// Removes a connection from every table.
    fn remove(&mut self, number: u32) -> Option<Entry> {
        let entry = self.connections.remove(number)?;
        self.ids.remove(&entry.connection.id());
        self.dialed.retain(|_, other| *other != number);
        self.inbound.retain(|_, (_, other)| *other != number);
        if let Some(greeted) = entry.greeted {
            self.greeted.remove(&greeted);
        }
        if entry.peer.is_some() {
            self.counters.connections -= 1;
            self.known.retain(|_, numbers| {
                numbers.retain(|other| *other != number);
                !numbers.is_empty()
            });
        }
        Some(entry)
    }

    fn fresh_id(&mut self) -> u64 {
        loop {
            let id = (self.random)();
            if id != 0 && !self.ids.contains_key(&id) {
                return id;
            }
        }
    }
}

impl DatagramCore for Core {
    type Event = CoreEvent;

    fn is_opening(&self, number: u32) -> bool {
        let entry = self.connections.get(number);
        entry.is_some_and(|entry| entry.connection.is_opening())
    }

    fn begin(&mut self, now: Instant, number: u32, paths: Vec<Path>) {
        self.with(number, |connection, _| {
            if let Some(dialing) = connection.dialing_mut() {
                dialing.begin(paths, now);
            }
            Ok(())
        });
    }

    fn handle_datagram(&mut self, now: Instant, path: Path, listening: bool, bytes: &[u8]) {
        let Some(datagram) = Datagram::read(bytes) else {
            self.counters.ignored += 1;
            return;
        };
        match datagram {
            Datagram::Hello {
                initiator,
                cookie,
                hello,
            } if listening => self.handle_hello(now, path, initiator, &cookie, hello),
            Datagram::Cookie { to, cookie } => {
                self.of_dialing(to, path, |_, connection| {
                    if let Some(dialing) = connection.dialing_mut() {
                        dialing.handle_cookie(path, cookie, now);
                    }
                    Ok(())
                });
            }
            Datagram::Welcome {
                to,
                acceptor,
                hello,
            } => self.welcome(now, path, to, acceptor, hello),
            Datagram::Refused { to } => {
                self.of_dialing(to, path, |_, _| {
                    let detail = "the peer refused the connection: its max_connections is reached, or it is connected \
                                  with this service already";
                    Err(ConnectionEnd::NotOpened(TransportError::new(TransportErrorKind::Refused, detail)))
                });
            }
            Datagram::Unknown { number } => self.is_unknown(path, number),
            Datagram::Data { to, number, frames } => {
                let entry = self.ids.get(&to).copied();
                let from = entry
                    .and_then(|entry| self.connections.get(entry))
                    .and_then(|entry| entry.connection.path())
                    .map(|path| path.remote);
                match entry {
                    Some(entry) if from == Some(path.remote) => {
                        self.with(entry, |connection, counters| {
                            connection.handle_packet(number, frames, now, counters)
                        });
                    }
                    Some(_) => self.counters.ignored += 1,
                    None => {
                        self.counters.ignored += 1;
                        if listening {
                            self.reply(path, packet::unknown(to));
                        }
                    }
                }
            }
            Datagram::Hello { .. } => self.counters.ignored += 1,
        }
    }

    fn handle_error(&mut self, now: Instant, number: u32, path: Path, what: &str) {
        self.with(number, |connection, _| match connection.dialing_mut() {
            Some(dialing) => dialing.failed(path, what, now),
            None => Err(ConnectionEnd::Broken(what.to_owned())),
        });
    }

    fn poll_transmit(&mut self, now: Instant) -> Option<Transmit> {
        if let Some((path, contents)) = self.outbox.pop_front() {
            return Some(Transmit {
                connection: None,
                path,
                contents,
                segment: None,
            });
        }
        let counters = &mut self.counters;
        let (number, (path, contents)) = self
            .connections
            .poll_ready(|entry| entry.connection.poll_transmit(now, counters))?;
        Some(Transmit {
            connection: Some(number),
            path,
            contents,
            segment: None,
        })
    }

    fn poll_event(&mut self) -> Option<CoreEvent> {
        if let Some(event) = self.notes.pop_front() {
            return Some(event);
        }
        self.connections.poll_eventful(|number, entry| {
            match (entry.connection.poll_event()?, &entry.peer) {
                (Event::Concluded(attempt, conclusion), _) => {
                    Some(CoreEvent::Concluded(attempt, conclusion))
                }
                (Event::Arrived { id, parcel }, Some(peer)) => Some(CoreEvent::Arrived {
                    parcel,
                    from: peer.hop.clone(),
                    ticket: Ticket(u64::from(number) * MAX_ID + id),
                }),
                (Event::Arrived { .. }, None) => None,
            }
        })
    }

    fn has_events(&self) -> bool {
        !self.notes.is_empty() || self.connections.has_events()
    }

    fn poll_gone(&mut self) -> Option<u32> {
        self.connections.poll_gone()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        self.connections.poll_timeout()
    }

    fn handle_timeout(&mut self, now: Instant) {
        for number in self.connections.due(now) {
            self.with(number, |connection, _| connection.handle_timeout(now));
        }
    }
}
