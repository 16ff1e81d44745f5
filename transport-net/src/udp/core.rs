//! What the connections of one endpoint share, without sockets or clock: who is there, which
//! connection a datagram belongs to, and what strangers are told.
//!
//! A location stays with one connection for as long as that lives, so that order holds. A location
//! with a known incarnation uses whatever connection there is with that incarnation, whichever side
//! opened it; so reports find their way back to peers that cannot be reached otherwise.
//!
//! Of a stranger nothing is remembered before it has brought back a cookie, and what it is told is
//! shorter than what it wrote. A datagram for a connection counts only with the right number of
//! 64 random bits, from the address that the connection was opened from.

mod greeting;

use std::collections::{BTreeSet, HashMap, HashSet, VecDeque};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_transport::{
    Abandoned, Answer, AttemptId, Conclusion, Hop, Incarnation, Introduction, Location, Mandate,
    Parcel, Ticket, WayError, WayFault,
};

use super::config::UdpLimits;
use super::connection::{Connection, Event, MAX_ID, Outbound, Path};
use super::cookie::Cookies;
use super::counters::UdpCounters;
use super::packet::{self, Datagram};
use crate::Identity;
use crate::end::ConnectionEnd;
use crate::log_limit::warn_limited;
use crate::rate_limit::{PeerRateLimit, PeerRateLimits, is_one_peer, quota_address};
use crate::stream::budget::{ByteBudget, Meter};
use crate::stream::source::{Home, QuotaKey};

/// Numbers of connections stay below this (see [`Core::ticket`]).
const MAX_CONNECTIONS: u32 = 1 << 24;

/// Datagrams to strangers that may wait to be sent; more are forgotten.
const MAX_OUTBOX: usize = 64;

/// Draws unpredictable numbers.
pub(crate) type Random = Box<dyn FnMut() -> u64 + Send>;

/// What happened, for the sink.
#[derive(Debug)]
pub(crate) enum Told {
    Arrived {
        parcel: Box<Parcel>,
        from: Hop,
        ticket: Ticket,
    },
    Concluded(AttemptId, Conclusion),
    /// Somebody has introduced itself.
    Introduced(Introduction),
    /// The connection on which somebody had introduced itself is no more.
    Parted(Introduction),
}

/// A datagram to be sent.
#[derive(Debug)]
pub(crate) struct Transmit {
    /// The connection it belongs to, if any.
    pub(crate) connection: Option<u32>,
    pub(crate) path: Path,
    pub(crate) contents: Vec<u8>,
}

pub(crate) struct Core {
    identity: Identity,
    limits: UdpLimits,
    listening: Vec<String>,
    cookies: Cookies,
    random: Random,
    connections: HashMap<u32, Entry>,
    /// By the number that the peers write.
    ids: HashMap<u64, u32>,
    /// The connection that was opened for a location.
    dialled: HashMap<Location, u32>,
    /// The connections with the service of this incarnation, in the order they came.
    known: HashMap<Incarnation, Vec<u32>>,
    /// The peers' last connections for each of the locations they dialled.
    inbound: HashMap<Inbound, (u64, u32)>,
    /// By where a hello came from, and its number.
    greeted: HashMap<(SocketAddr, u64), u32>,
    ready: VecDeque<u32>,
    timers: BTreeSet<(Instant, u32)>,
    outbox: VecDeque<Outbound>,
    eventful: VecDeque<u32>,
    /// What is to be told before what the connections have to tell.
    notes: VecDeque<Told>,
    /// Connections that are no more.
    gone: Vec<u32>,
    /// What peers may still send.
    rate_limits: PeerRateLimits,
    /// What is taken for parcels that wait for earlier ones.
    byte_budget: ByteBudget,
    counters: UdpCounters,
    last_number: u32,
    last_serial: u64,
}

struct Entry {
    connection: Connection,
    /// The location it was opened for, if from this side.
    dialled: Option<Location>,
    /// Who is there, once that is known.
    peer: Option<Introduction>,
    /// Where the hello came from, and its number, if the peer opened it.
    greeted: Option<(SocketAddr, u64)>,
    /// When it was asked for a sign of life because another peer says to be the same service.
    asked: Option<Instant>,
    timer: Option<Instant>,
    is_ready: bool,
    is_eventful: bool,
}

/// What tells a peer's connections for one location from others. With the address, so that a
/// stranger elsewhere cannot push out somebody's connection by using its incarnation.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Inbound {
    incarnation: Incarnation,
    ip: IpAddr,
    dialled: String,
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
            connections: HashMap::new(),
            ids: HashMap::new(),
            dialled: HashMap::new(),
            known: HashMap::new(),
            inbound: HashMap::new(),
            greeted: HashMap::new(),
            ready: VecDeque::new(),
            timers: BTreeSet::new(),
            outbox: VecDeque::new(),
            eventful: VecDeque::new(),
            notes: VecDeque::new(),
            gone: Vec::new(),
            rate_limits: PeerRateLimits::default(),
            byte_budget: ByteBudget::default(),
            counters: UdpCounters::default(),
            last_number: 0,
            last_serial: 0,
        }
    }

    pub(crate) fn counters(&self) -> UdpCounters {
        self.counters
    }

    /// What whoever is at this address may still send, if that is limited.
    fn rate_limit(&self, ip: IpAddr, now: Instant) -> Option<Arc<PeerRateLimit>> {
        is_one_peer(ip).then(|| self.rate_limits.of(ip, self.limits.rates(), now))?
    }

    /// Takes memory for parcels of the peers at this address.
    fn meter(&self, ip: IpAddr) -> Meter {
        let home = quota_address(ip);
        let quota_key = QuotaKey::Unproved(Home::Address(home));
        self.byte_budget
            .meter(quota_key, self.limits.budget_of(home))
    }

    /// Takes a parcel for sending. When the connection has just been made up, its number is
    /// returned: it is to [begin](Self::begin), or [not](Self::cannot_begin).
    pub(crate) fn dispatch(
        &mut self,
        now: Instant,
        attempt: AttemptId,
        to: &Location,
        parcel: &Parcel,
    ) -> Result<Option<u32>, WayError> {
        let dialled = self.dialled.get(to).copied();
        let known = self.known.get(&to.incarnation());
        let there = dialled.or_else(|| known.and_then(|numbers| numbers.first().copied()));
        let (number, fresh) = match there {
            Some(number) => (number, false),
            None => (self.make_up(now, to)?, true),
        };
        let Some(entry) = self.connections.get_mut(&number) else {
            return Err(WayError::new(WayFault::Broken, "the connection is gone"));
        };
        if dialled.is_none() && !fresh {
            entry.connection.is_used_for(now, to);
        }
        if let Err(error) = entry.connection.send(attempt, parcel) {
            if fresh {
                self.remove(number);
            }
            return Err(error);
        }
        self.touch(number);
        Ok(fresh.then_some(number))
    }

    /// What others are told from now on of the addresses that this endpoint listens on.
    pub(crate) fn listens_on(&mut self, listening: Vec<String>) {
        self.listening = listening;
    }

    /// This host no longer has these addresses: nothing arrives any more on the connections that
    /// stay with them. `local` is the address of a socket that belongs to one connection.
    pub(crate) fn lost(&mut self, lost: &HashSet<IpAddr>, local: impl Fn(u32) -> Option<IpAddr>) {
        let numbers: Vec<(u32, IpAddr)> = self
            .connections
            .iter()
            .filter_map(|(number, entry)| {
                let path = entry.connection.path()?;
                let ip = path.local.or_else(|| local(path.socket))?;
                lost.contains(&ip).then_some((*number, ip))
            })
            .collect();
        for (number, ip) in numbers {
            let what = format!("this host no longer has the address {ip}");
            self.end(number, &ConnectionEnd::Broken(what));
        }
    }

    /// Whether a connection that was made up is still to be opened.
    pub(crate) fn is_opening(&self, number: u32) -> bool {
        let entry = self.connections.get(&number);
        entry.is_some_and(|entry| entry.connection.is_opening())
    }

    /// The ways to the peer of a connection that was made up.
    pub(crate) fn begin(&mut self, now: Instant, number: u32, paths: Vec<Path>) {
        self.with(number, |connection, _| {
            if let Some(dialling) = connection.dialling_mut() {
                dialling.begin(paths, now);
            }
            Ok(())
        });
    }

    /// A connection that was made up cannot be opened.
    pub(crate) fn cannot_begin(&mut self, number: u32, error: WayError) {
        self.end(number, &ConnectionEnd::NotOpened(error));
    }

    pub(crate) fn abandon(&mut self, attempt: AttemptId) -> Abandoned {
        self.notes
            .retain(|told| !matches!(told, Told::Concluded(other, _) if *other == attempt));
        let mut connections = self.connections.values_mut();
        let unsent = connections.any(|it| it.connection.abandon(attempt) == Abandoned::NotSent);
        match unsent {
            true => Abandoned::NotSent,
            false => Abandoned::Unconfirmed,
        }
    }

    pub(crate) fn answer(&mut self, now: Instant, ticket: Ticket, answer: &Answer) {
        let number = u32::try_from(ticket.0 / MAX_ID).unwrap_or(u32::MAX);
        let id = ticket.0 % MAX_ID;
        self.with(number, |connection, _| {
            connection.answer(id, answer, now);
            Ok(())
        });
    }

    /// Takes a datagram. `listening` is whether strangers are heard on the socket it came to.
    pub(crate) fn handle_datagram(
        &mut self,
        now: Instant,
        path: Path,
        listening: bool,
        bytes: &[u8],
    ) {
        let Some(datagram) = Datagram::read(bytes) else {
            self.counters.ignored += 1;
            return;
        };
        match datagram {
            Datagram::Hello {
                initiator,
                cookie,
                hello,
            } if listening => self.greet(now, path, initiator, &cookie, hello),
            Datagram::Cookie { to, cookie } => {
                self.of_dialling(to, path, |_, connection| {
                    if let Some(dialling) = connection.dialling_mut() {
                        dialling.handle_cookie(path, cookie, now);
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
                self.of_dialling(to, path, |_, _| {
                    let detail = "the peer takes no more connections (its max_connections), or is connected \
                                  with this service already";
                    Err(ConnectionEnd::NotOpened(WayError::new(WayFault::Refused, detail)))
                });
            }
            Datagram::Unknown { number } => self.is_unknown(path, number),
            Datagram::Data { to, number, frames } => {
                let entry = self.ids.get(&to).copied();
                let from = entry
                    .and_then(|entry| self.connections.get(&entry))
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

    /// The operating system says that a way does not work.
    pub(crate) fn handle_error(&mut self, now: Instant, number: u32, path: Path, what: &str) {
        self.with(number, |connection, _| match connection.dialling_mut() {
            Some(dialling) => dialling.failed(path, what, now),
            None => Err(ConnectionEnd::Broken(what.to_owned())),
        });
    }

    /// The datagram that was taken last is larger than what can be sent from here.
    pub(crate) fn too_big(&mut self, number: u32, size: usize) {
        self.with(number, |connection, _| connection.too_big(size));
    }

    pub(crate) fn poll_transmit(&mut self, now: Instant) -> Option<Transmit> {
        if let Some((path, contents)) = self.outbox.pop_front() {
            return Some(Transmit {
                connection: None,
                path,
                contents,
            });
        }
        while let Some(number) = self.ready.front().copied() {
            if let Some(entry) = self.connections.get_mut(&number) {
                let next = entry.connection.poll_transmit(now, &mut self.counters);
                if let Some((path, contents)) = next {
                    return Some(Transmit {
                        connection: Some(number),
                        path,
                        contents,
                    });
                }
                entry.is_ready = false;
            }
            self.ready.pop_front();
            self.reschedule(number);
        }
        None
    }

    pub(crate) fn poll_event(&mut self) -> Option<Told> {
        if let Some(told) = self.notes.pop_front() {
            return Some(told);
        }
        while let Some(number) = self.eventful.front().copied() {
            if let Some(entry) = self.connections.get_mut(&number) {
                match (entry.connection.poll_event(), &entry.peer) {
                    (Some(Event::Concluded(attempt, conclusion)), _) => {
                        return Some(Told::Concluded(attempt, conclusion));
                    }
                    (Some(Event::Arrived { id, parcel }), Some(peer)) => {
                        let ticket = Ticket(u64::from(number) * MAX_ID + id);
                        let from = peer.hop.clone();
                        return Some(Told::Arrived {
                            parcel,
                            from,
                            ticket,
                        });
                    }
                    (Some(Event::Arrived { .. }), None) | (None, _) => entry.is_eventful = false,
                }
            }
            self.eventful.pop_front();
        }
        None
    }

    /// Whether there is something to be told.
    pub(crate) fn has_events(&self) -> bool {
        !self.notes.is_empty() || !self.eventful.is_empty()
    }

    /// The next connection that is no more, so that its sockets can be closed.
    pub(crate) fn poll_gone(&mut self) -> Option<u32> {
        self.gone.pop()
    }

    pub(crate) fn poll_timeout(&self) -> Option<Instant> {
        self.timers.first().map(|(due, _)| *due)
    }

    pub(crate) fn handle_timeout(&mut self, now: Instant) {
        // Each once: what is due to be sent stays due until it has been fetched.
        let due: Vec<u32> = self
            .timers
            .iter()
            .take_while(|(due, _)| *due <= now)
            .map(|(_, number)| *number)
            .collect();
        for number in due {
            self.with(number, |connection, _| connection.handle_timeout(now));
        }
    }

    /// Ends every connection.
    pub(crate) fn close(&mut self) {
        let numbers: Vec<u32> = self.connections.keys().copied().collect();
        for number in numbers {
            self.end(number, &ConnectionEnd::Closed);
        }
    }

    /// Makes up a connection for a location.
    fn make_up(&mut self, now: Instant, to: &Location) -> Result<u32, WayError> {
        if self.connections.len() >= self.limits.max_connections {
            return Err(ConnectionEnd::TooManyConnections.after());
        }
        self.last_serial += 1;
        let mut hasher = DefaultHasher::new();
        to.hash(&mut hasher);
        let hello = self.own_hello(self.last_serial, format!("{:016x}", hasher.finish()));
        let id = self.fresh_id();
        let limits = self.limits.clone();
        let connection = Connection::dialling(limits, id, to.incarnation(), hello, now);
        let number = self.insert(connection, Some(to.clone()), None);
        self.dialled.insert(to.clone(), number);
        Ok(number)
    }

    /// Lets a connection act, and sees to what follows.
    fn with(
        &mut self,
        number: u32,
        act: impl FnOnce(&mut Connection, &mut UdpCounters) -> Result<(), ConnectionEnd>,
    ) {
        let Some(entry) = self.connections.get_mut(&number) else {
            return;
        };
        match act(&mut entry.connection, &mut self.counters) {
            Ok(()) => self.touch(number),
            Err(end) => self.end(number, &end),
        }
    }

    /// Something has changed at a connection.
    fn touch(&mut self, number: u32) {
        if let Some(entry) = self.connections.get_mut(&number)
            && !std::mem::replace(&mut entry.is_ready, true)
        {
            self.ready.push_back(number);
        }
        self.reschedule(number);
    }

    fn reschedule(&mut self, number: u32) {
        let Some(entry) = self.connections.get_mut(&number) else {
            return;
        };
        let due = entry.connection.poll_timeout();
        if due != entry.timer {
            if let Some(before) = entry.timer {
                self.timers.remove(&(before, number));
            }
            if let Some(due) = due {
                self.timers.insert((due, number));
            }
            entry.timer = due;
        }
        // Sending may have found out that something cannot be sent.
        if entry.connection.has_events() && !std::mem::replace(&mut entry.is_eventful, true) {
            self.eventful.push_back(number);
        }
    }

    fn end(&mut self, number: u32, end: &ConnectionEnd) {
        let Some(entry) = self.remove(number) else {
            return;
        };
        if end.is_misbehavior() {
            warn_limited(
                self.counters.refused_nonsense,
                format_args!("connection closed: {}", end.after()),
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
            .extend(concluded.map(|(attempt, what)| Told::Concluded(attempt, what)));
        self.notes.extend(entry.peer.map(Told::Parted));
        // Bounded by the number of connections.
        self.outbox.extend(goodbye);
    }

    fn insert(
        &mut self,
        connection: Connection,
        dialled: Option<Location>,
        greeted: Option<(SocketAddr, u64)>,
    ) -> u32 {
        loop {
            self.last_number = (self.last_number + 1) % MAX_CONNECTIONS;
            if !self.connections.contains_key(&self.last_number) {
                break;
            }
        }
        let number = self.last_number;
        self.ids.insert(connection.id(), number);
        let entry = Entry {
            connection,
            dialled,
            peer: None,
            greeted,
            asked: None,
            timer: None,
            is_ready: false,
            is_eventful: false,
        };
        self.connections.insert(number, entry);
        number
    }

    /// The peer of a connection is known.
    fn enter(&mut self, now: Instant, number: u32, name: Arc<str>, hop: Hop) {
        self.doubt_others(now, number, hop.location.incarnation());
        if let Some(entry) = self.connections.get_mut(&number) {
            let incarnation = hop.location.incarnation();
            let peer = Introduction {
                name,
                hop,
                dialled: entry.dialled.clone(),
                mandate: Mandate::Unproved,
            };
            self.notes.push_back(Told::Introduced(peer.clone()));
            entry.peer = Some(peer);
            self.known.entry(incarnation).or_default().push(number);
            self.counters.connections += 1;
        }
    }

    /// The service of a connection may have moved to where it comes from: its connections from
    /// elsewhere are in doubt. They are asked, because a stranger must not end the connections of
    /// the service that it claims to be.
    fn doubt_others(&mut self, now: Instant, number: u32, incarnation: Incarnation) {
        let place = |entry: &Entry| Some(entry.connection.path()?.remote.ip());
        let here = self.connections.get(&number).and_then(place);
        let others = self.known.get(&incarnation).cloned().unwrap_or_default();
        for other in others {
            if let Some(entry) = self.connections.get_mut(&other)
                && place(entry) != here
            {
                entry.connection.doubt(now, Duration::ZERO);
                self.touch(other);
            }
        }
    }

    /// Takes a connection out of every table.
    fn remove(&mut self, number: u32) -> Option<Entry> {
        let entry = self.connections.remove(&number)?;
        self.ids.remove(&entry.connection.id());
        self.dialled.retain(|_, other| *other != number);
        self.inbound.retain(|_, (_, other)| *other != number);
        if let Some(greeted) = entry.greeted {
            self.greeted.remove(&greeted);
        }
        if let Some(timer) = entry.timer {
            self.timers.remove(&(timer, number));
        }
        if entry.peer.is_some() {
            self.counters.connections -= 1;
            self.known.retain(|_, numbers| {
                numbers.retain(|other| *other != number);
                !numbers.is_empty()
            });
        }
        self.ready.retain(|other| *other != number);
        self.eventful.retain(|other| *other != number);
        self.gone.push(number);
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
