//! The protocol of one endpoint without sockets and clock: its connections, the assignment of
//! packets to them, and the handshakes of peers.
//!
//! A location has at most one connection, which carries all letters to it in order until it ends.
//!
//! The endpoint stores no state about a peer that has not returned a cookie, and no reply to such a
//! peer is larger than the packet it answers: both are handshakes. A packet for a connection only
//! counts with the number of its socket (30 random bits), from the address that the connection was
//! opened from.

use std::collections::{HashMap, HashSet, VecDeque};
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::Instant;

use bytes::Bytes;
use fipa_acl::Letter;
use fipa_transport::{
    Abandoned, AttemptId, Conclusion, Location, TransportError, TransportErrorKind, log_limit,
    quota_address,
};

use super::config::UdtLimits;
use super::connection::{Connection, SocketIds};
use super::counters::UdtCounters;
use super::packet::{
    self, CONCLUSION, Control, DATAGRAMS, Handshake, MAX_PACKET, MIN_PACKET, Packet, REFUSAL,
    REQUEST, VERSION,
};
use super::receiver::{Arrived, Receiver};
use super::sequence;
use super::untranslated::{Translation, Untranslated};
use crate::datagrams::connections::{Connections, Scheduled};
use crate::datagrams::cookie::Cookies;
use crate::datagrams::{DatagramCore, Outbound, Path, Random, Transmit};
use crate::end::ConnectionEnd;
use crate::rate_limit::{PeerRateLimits, is_one_peer};
use crate::stream::budget::ByteBudget;
use crate::stream::source::{Home, QuotaKey};

/// Maximum number of queued datagrams to unproved peers; further ones are dropped.
const MAX_OUTBOX: usize = 64;

/// Mask of socket numbers. libudt begins with such numbers, too.
const SOCKETS: u64 = (1 << 30) - 1;

/// Whether letters may be exchanged with a peer at an address.
pub(crate) type Access = Box<dyn Fn(IpAddr) -> bool + Send>;

/// An event for the sink.
#[derive(Debug)]
pub(crate) enum CoreEvent {
    /// A letter has arrived from this address.
    Arrived(Arrived, SocketAddr),
    /// The beginning of a letter that is too large has arrived from this address.
    TooLarge(Bytes, SocketAddr),
    Concluded(AttemptId, Conclusion),
}

pub(crate) struct Core {
    limits: UdtLimits,
    access: Access,
    cookies: Cookies,
    random: Random,
    connections: Connections<Entry>,
    /// Connections by the number of their socket.
    sockets: HashMap<u32, u32>,
    /// Connections opened by this side, by location.
    dialed: HashMap<Location, u32>,
    /// Connections opened by peers, by their origin.
    accepted: HashMap<Origin, u32>,
    /// Letters that no connection has yet.
    untranslated: Untranslated,
    outbox: VecDeque<Outbound>,
    /// Conclusions of connections that have ended, and of letters that could not be translated.
    concluded: VecDeque<(AttemptId, Conclusion)>,
    /// Letters of connections that have ended. The peers have got acknowledgments for them.
    arrived: VecDeque<CoreEvent>,
    rate_limits: PeerRateLimits,
    byte_budget: ByteBudget,
    counters: UdtCounters,
}

struct Entry {
    connection: Connection,
    /// The location, if this side opened the connection.
    dialed: Option<Location>,
    /// The origin, if the peer opened it.
    origin: Option<Origin>,
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

/// The handshake by which a peer opened a connection: its address, its socket and its first packet.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
struct Origin {
    from: SocketAddr,
    socket: u32,
    initial: u32,
}

impl Core {
    pub(crate) fn new(limits: UdtLimits, access: Access, mut random: Random, now: Instant) -> Self {
        let cookies = Cookies::new((random(), random()), now);
        Self {
            limits,
            access,
            cookies,
            random,
            connections: Connections::new(),
            sockets: HashMap::new(),
            dialed: HashMap::new(),
            accepted: HashMap::new(),
            untranslated: Untranslated::default(),
            outbox: VecDeque::new(),
            concluded: VecDeque::new(),
            arrived: VecDeque::new(),
            rate_limits: PeerRateLimits::default(),
            byte_budget: ByteBudget::default(),
            counters: UdtCounters::default(),
        }
    }

    pub(crate) fn counters(&self) -> UdtCounters {
        UdtCounters {
            connections: self.connections.len() as u64,
            ..self.counters
        }
    }

    /// Notes that bytes which had arrived as a letter are none.
    pub(crate) fn count_nonsense(&mut self) {
        self.counters.refused_nonsense += 1;
    }

    /// Queues a letter for its translation. Returns whether the caller must start the task that
    /// translates letters: it calls [`begin_translation`](Self::begin_translation) and
    /// [`handle_translated`](Self::handle_translated) by turns.
    ///
    /// # Errors
    /// When there is no room for the letter, or for the connection that it needs.
    pub(crate) fn post(
        &mut self,
        attempt: AttemptId,
        to: &Location,
        receiver: Arc<str>,
        letter: Letter,
    ) -> Result<bool, TransportError> {
        let waiting = self.untranslated.load(to);
        let dialed = self.dialed.get(to);
        let entry = dialed.and_then(|number| self.connections.get(*number));
        let load = match entry.and_then(|entry| entry.connection.sender()) {
            Some(sender) => waiting + sender.load(),
            None if waiting.letters == 0 && !self.has_room_for_another_location() => {
                return Err(ConnectionEnd::TooManyConnections.after());
            }
            None => waiting,
        };
        self.limits.check_room(load, letter.len())?;
        Ok(self.untranslated.push(attempt, to, receiver, letter))
    }

    /// Returns the next letter to be translated. `None` ends the task that translates letters.
    pub(crate) fn begin_translation(&mut self) -> Option<Translation> {
        self.untranslated.begin()
    }

    /// Queues the letter that has been translated, or concludes it as not sent. A letter whose attempt
    /// has ended is dropped. Returns the number of the connection if it is new; the caller then calls
    /// [`begin`](Self::begin) or [`cannot_begin`](Self::cannot_begin).
    pub(crate) fn handle_translated(
        &mut self,
        now: Instant,
        translated: Result<[Bytes; 2], TransportError>,
    ) -> Option<u32> {
        let (attempt, to) = self.untranslated.finish()?;
        let sent = translated.and_then(|pieces| self.send(now, attempt, &to, pieces));
        sent.unwrap_or_else(|error| {
            let conclusion = Conclusion::NotSent(error);
            self.concluded.push_back((attempt, conclusion));
            None
        })
    }

    /// Concludes the letters that wait for their translation as not sent.
    pub(crate) fn end_translations(&mut self) {
        let conclusion = Conclusion::NotSent(ConnectionEnd::Closed.after());
        let waiting = self.untranslated.clear();
        let concluded = waiting.map(|attempt| (attempt, conclusion.clone()));
        self.concluded.extend(concluded);
    }

    /// Queues a letter in the dialect of the peer. Returns the number of the connection if it is new.
    fn send(
        &mut self,
        now: Instant,
        attempt: AttemptId,
        to: &Location,
        letter: [Bytes; 2],
    ) -> Result<Option<u32>, TransportError> {
        let there = self.dialed.get(to).copied();
        let number = match there {
            Some(number) => number,
            None => self.create(now, to)?,
        };
        let sender = self.connections.get_mut(number);
        let sent = match sender.and_then(|entry| entry.connection.sender_mut()) {
            Some(sender) => sender.send(attempt, letter),
            None => Err(ConnectionEnd::Hangup.after()),
        };
        if let Err(error) = sent {
            if there.is_none() {
                self.remove(number);
            }
            return Err(error);
        }
        self.connections.touch(number);
        Ok(there.is_none().then_some(number))
    }

    /// Whether a further location can get a connection, besides the locations whose letters wait for
    /// their translation.
    fn has_room_for_another_location(&self) -> bool {
        let waiting = self.untranslated.locations();
        let needed = waiting.filter(|to| !self.dialed.contains_key(to)).count();
        self.connections.len() + needed < self.limits.max_connections
    }

    /// Ends the connections that are bound to addresses that this host no longer has. `local`
    /// returns the address of a socket that belongs to one connection.
    pub(crate) fn lost(
        &mut self,
        now: Instant,
        lost: &HashSet<IpAddr>,
        local: impl Fn(u32) -> Option<IpAddr>,
    ) {
        let numbers = self.connections.bound_to(lost, local);
        for (number, ip) in numbers {
            let what = format!("this host no longer has the address {ip}");
            self.end(now, number, &ConnectionEnd::Broken(what));
        }
    }

    /// Ends a new connection that cannot be opened.
    pub(crate) fn cannot_begin(&mut self, now: Instant, number: u32, error: TransportError) {
        self.end(now, number, &ConnectionEnd::NotOpened(error));
    }

    /// Ends an attempt to this location.
    pub(crate) fn abandon(&mut self, attempt: AttemptId, to: &Location) -> Abandoned {
        if self.untranslated.abandon(attempt, to) {
            return Abandoned::NotSent;
        }
        let mut concluded = self.concluded.iter();
        let concluded = concluded.position(|(other, _)| *other == attempt);
        if let Some((_, conclusion)) = concluded.and_then(|place| self.concluded.remove(place)) {
            return match conclusion {
                Conclusion::NotSent(_) => Abandoned::NotSent,
                _ => Abandoned::Unconfirmed,
            };
        }
        let Some(number) = self.dialed.get(to) else {
            return Abandoned::Unconfirmed;
        };
        let entry = self.connections.get_mut(*number);
        let sender = entry.and_then(|entry| entry.connection.sender_mut());
        let end = sender.map_or(Abandoned::Unconfirmed, |sender| sender.abandon(attempt));
        self.connections.touch(*number);
        end
    }

    /// Ends every connection, and concludes every letter.
    pub(crate) fn close(&mut self, now: Instant) {
        self.end_translations();
        for number in self.connections.numbers() {
            self.end(now, number, &ConnectionEnd::Closed);
        }
    }

    /// Handles the handshake of a peer that opens a connection.
    fn handle_request(&mut self, now: Instant, path: Path, handshake: &Handshake) {
        let from = path.remote;
        if !(self.access)(from.ip()) {
            log_limit::warn!(
                of: quota_address(from.ip()),
                "{from}: UDT connection refused: the peer cannot prove its identity over UDT, and is not \
                 listed in security.legacy_peers"
            );
            self.counters.refused_unproved += 1;
            return;
        }
        let is_fit = handshake.version == VERSION
            && handshake.kind == DATAGRAMS
            && handshake.max_packet >= MIN_PACKET
            && handshake.initial <= sequence::LARGEST
            && handshake.socket != 0;
        if !is_fit || !matches!(handshake.request, REQUEST | CONCLUSION) {
            self.counters.ignored += 1;
            return self.reply(path, handshake, REFUSAL, handshake.cookie);
        }
        let origin = Origin {
            from,
            socket: handshake.socket,
            initial: handshake.initial,
        };
        let cookie = self.cookie(now, &origin);
        if handshake.request == REQUEST || !self.is_valid(now, &origin, handshake.cookie) {
            return self.reply(path, handshake, REQUEST, cookie);
        }
        let max_packet = handshake.max_packet.min(MAX_PACKET);
        if let Some(number) = self.accepted.get(&origin) {
            // The answer was lost.
            if let Some(entry) = self.connections.get(*number) {
                let answer = entry.connection.answer(handshake, max_packet);
                self.put_out(path, answer);
            }
            return;
        }
        if !self.makes_room(now, from.ip()) {
            self.counters.refused_crowd += 1;
            return self.reply(path, handshake, REFUSAL, handshake.cookie);
        }
        let home = quota_address(from.ip());
        let quota_key = QuotaKey::Unproved(Home::Address(home));
        let meter = self
            .byte_budget
            .meter(quota_key, self.limits.budget_of(home));
        let rates = self.limits.rates();
        let rate_limit = match is_one_peer(from.ip()) {
            true => self.rate_limits.of(from.ip(), rates, now),
            false => None,
        };
        let limits = self.limits.clone();
        let receiver = Receiver::new(limits, handshake.initial, max_packet, rate_limit, meter);
        let sockets = SocketIds {
            own: self.fresh_socket(),
            peer: handshake.socket,
        };
        let limits = self.limits.clone();
        let connection =
            Connection::accepted(limits, sockets, handshake.initial, path, receiver, now);
        let answer = connection.answer(handshake, max_packet);
        let number = self.insert(connection, None, Some(origin));
        self.counters.accepted += 1;
        self.connections.touch(number);
        self.put_out(path, answer);
    }

    /// Whether a peer at this address may open another connection. Ends its connection that has been
    /// idle for the longest time if there are too many.
    fn makes_room(&mut self, now: Instant, ip: IpAddr) -> bool {
        let home = quota_address(ip);
        let of_home = |origin: &Origin| quota_address(origin.from.ip()) == home;
        let numbers = self.accepted.iter().filter(|(origin, _)| of_home(origin));
        let numbers: Vec<u32> = numbers.map(|(_, number)| *number).collect();
        let greedy = numbers.len() >= self.limits.max_connections_of(home);
        if !greedy && self.connections.len() < self.limits.max_connections {
            return true;
        }
        let idle = numbers.into_iter().filter_map(|number| {
            let entry = self.connections.get(number)?;
            Some((entry.connection.idle_since()?, number))
        });
        match idle.min() {
            Some((since, number)) if since + self.limits.idle_close <= now => {
                self.end(now, number, &ConnectionEnd::Idle);
                true
            }
            _ => false,
        }
    }

    /// Returns the cookie of a peer.
    fn cookie(&self, now: Instant, origin: &Origin) -> u32 {
        let cookie = self.cookies.give(now, origin.from, number_of(origin));
        short(&cookie)
    }

    fn is_valid(&self, now: Instant, origin: &Origin, cookie: u32) -> bool {
        let number = number_of(origin);
        self.cookies
            .valid(now, origin.from, number)
            .any(|valid| short(&valid) == cookie)
    }

    /// Answers a handshake with one of the same length.
    fn reply(&mut self, path: Path, handshake: &Handshake, request: i32, cookie: u32) {
        let answer = Handshake {
            request,
            cookie,
            ..*handshake
        };
        let answer = packet::control(&Control::Handshake(answer), 0, handshake.socket);
        self.put_out(path, answer);
    }

    fn put_out(&mut self, path: Path, contents: Vec<u8>) {
        if self.outbox.len() < MAX_OUTBOX {
            self.outbox.push_back((path, contents));
        }
    }

    /// Creates a connection for a location.
    fn create(&mut self, now: Instant, to: &Location) -> Result<u32, TransportError> {
        if self.connections.len() >= self.limits.max_connections {
            return Err(ConnectionEnd::TooManyConnections.after());
        }
        let id = self.fresh_socket();
        let initial = sequence::wire((self.random)());
        let connection = Connection::dialing(self.limits.clone(), id, initial, now);
        let number = self.insert(connection, Some(to.clone()), None);
        self.dialed.insert(to.clone(), number);
        Ok(number)
    }

    /// Calls `act` with a connection, and handles its result.
    fn with(
        &mut self,
        now: Instant,
        number: u32,
        act: impl FnOnce(&mut Connection, &mut UdtCounters) -> Result<(), ConnectionEnd>,
    ) {
        let Some(entry) = self.connections.get_mut(number) else {
            return;
        };
        match act(&mut entry.connection, &mut self.counters) {
            Ok(()) => self.connections.touch(number),
            Err(end) => self.end(now, number, &end),
        }
    }

    fn end(&mut self, now: Instant, number: u32, end: &ConnectionEnd) {
        let Some(mut entry) = self.remove(number) else {
            return;
        };
        if end.is_misbehavior() {
            log_limit::warn!(
                of: entry.connection.path().map(|path| quota_address(path.remote.ip())),
                "UDT connection closed: {}",
                end.after()
            );
            self.counters.refused_nonsense += 1;
        } else {
            tracing::debug!(connection = number, "UDT connection ended: {}", end.after());
        }
        if let ConnectionEnd::NotOpened(_) = end {
            self.counters.dial_failures += 1;
        }
        // What has arrived before the end counts.
        while let Some(concluded) = entry.connection.poll_concluded() {
            self.counters.letters_out += 1;
            self.concluded.push_back(concluded);
        }
        // libudt sends its shutdown as soon as the last letter is acknowledged.
        while let Some(arrived) = next_arrival(&mut entry.connection, &mut self.counters) {
            self.arrived.push_back(arrived);
        }
        let (concluded, shutdown) = entry.connection.end(end, now);
        self.concluded.extend(concluded);
        // Bounded by the number of connections.
        self.outbox.extend(shutdown);
    }

    fn insert(
        &mut self,
        connection: Connection,
        dialed: Option<Location>,
        origin: Option<Origin>,
    ) -> u32 {
        let id = connection.id();
        let number = self.connections.insert(Entry {
            connection,
            dialed,
            origin,
        });
        self.sockets.insert(id, number);
        self.accepted.extend(origin.map(|origin| (origin, number)));
        number
    }

    /// Removes a connection from every table.
    fn remove(&mut self, number: u32) -> Option<Entry> {
        let entry = self.connections.remove(number)?;
        self.sockets.remove(&entry.connection.id());
        if let Some(location) = &entry.dialed {
            self.dialed.remove(location);
        }
        if let Some(origin) = &entry.origin {
            self.accepted.remove(origin);
        }
        Some(entry)
    }

    fn fresh_socket(&mut self) -> u32 {
        loop {
            let socket = ((self.random)() & SOCKETS) as u32;
            if socket != 0 && !self.sockets.contains_key(&socket) {
                return socket;
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

    fn begin(&mut self, now: Instant, number: u32, mut paths: Vec<Path>) {
        let Some(remote) = paths.first().map(|path| path.remote) else {
            return;
        };
        paths.retain(|path| (self.access)(path.remote.ip()));
        if paths.is_empty() {
            let detail = format!(
                "{remote} is a legacy peer, which cannot prove its identity, and is not listed in security.legacy_peers"
            );
            let error = TransportError::new(TransportErrorKind::Refused, detail);
            return self.end(now, number, &ConnectionEnd::NotOpened(error));
        }
        self.with(now, number, |connection, _| {
            if let Some(dialing) = connection.dialing_mut() {
                dialing.begin(paths, now);
            }
            Ok(())
        });
    }

    fn handle_datagram(&mut self, now: Instant, path: Path, listening: bool, bytes: &[u8]) {
        let Some((to, packet)) = Packet::read(bytes) else {
            self.counters.ignored += 1;
            return;
        };
        if let (0, Packet::Control(Control::Handshake(handshake)), true) = (to, &packet, listening)
        {
            return self.handle_request(now, path, handshake);
        }
        let number = self.sockets.get(&to).copied();
        let entry = number.and_then(|number| Some((number, self.connections.get_mut(number)?)));
        let Some((number, entry)) = entry else {
            self.counters.ignored += 1;
            return;
        };
        let is_its = match (entry.connection.path(), entry.connection.dialing_mut()) {
            (Some(its), _) => its.remote == path.remote,
            (None, Some(dialing)) => dialing.uses(path),
            (None, None) => false,
        };
        if !is_its {
            self.counters.ignored += 1;
            return;
        }
        self.with(now, number, |connection, counters| match &packet {
            Packet::Control(Control::Handshake(handshake)) => {
                let was_opening = connection.is_opening();
                connection.handle_handshake(path, handshake, now)?;
                counters.dialed += u64::from(was_opening && !connection.is_opening());
                Ok(())
            }
            _ if connection.is_opening() => {
                counters.ignored += 1;
                Ok(())
            }
            Packet::Data(data) => {
                connection.handle_data(data, now, counters);
                Ok(())
            }
            Packet::Control(control) => connection.handle_control(control, now, counters),
        });
    }

    fn handle_error(&mut self, now: Instant, number: u32, path: Path, what: &str) {
        self.with(now, number, |connection, _| {
            match connection.dialing_mut() {
                Some(dialing) => dialing.failed(path, what, now),
                None => Err(ConnectionEnd::Broken(what.to_owned())),
            }
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
        let (number, (path, contents, segment)) = self
            .connections
            .poll_ready(|entry| entry.connection.poll_transmit(now, counters))?;
        Some(Transmit {
            connection: Some(number),
            path,
            contents,
            segment,
        })
    }

    fn poll_event(&mut self) -> Option<CoreEvent> {
        if let Some((attempt, conclusion)) = self.concluded.pop_front() {
            return Some(CoreEvent::Concluded(attempt, conclusion));
        }
        // They came before those of a later connection of the same peer.
        if let Some(arrived) = self.arrived.pop_front() {
            return Some(arrived);
        }
        let counters = &mut self.counters;
        self.connections.poll_eventful(|_, entry| {
            if let Some((attempt, conclusion)) = entry.connection.poll_concluded() {
                counters.letters_out += 1;
                return Some(CoreEvent::Concluded(attempt, conclusion));
            }
            next_arrival(&mut entry.connection, counters)
        })
    }

    fn has_events(&self) -> bool {
        !self.concluded.is_empty() || !self.arrived.is_empty() || self.connections.has_events()
    }

    fn poll_gone(&mut self) -> Option<u32> {
        self.connections.poll_gone()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        self.connections.poll_timeout()
    }

    fn handle_timeout(&mut self, now: Instant) {
        for number in self.connections.due(now) {
            self.with(now, number, |connection, _| connection.handle_timeout(now));
        }
    }
}

/// Returns the next letter that has arrived over a connection, or the beginning of one that is too large.
fn next_arrival(connection: &mut Connection, counters: &mut UdtCounters) -> Option<CoreEvent> {
    let from = connection.path()?.remote;
    if let Some(beginning) = connection.poll_too_large() {
        return Some(CoreEvent::TooLarge(beginning, from));
    }
    let arrived = connection.poll_arrived()?;
    counters.letters_in += 1;
    Some(CoreEvent::Arrived(arrived, from))
}

/// The number that the cookie of a peer depends on.
fn number_of(origin: &Origin) -> u64 {
    u64::from(origin.socket) << 32 | u64::from(origin.initial)
}

/// Returns the part of a cookie that a handshake has room for.
fn short(cookie: &[u8; 16]) -> u32 {
    cookie
        .first_chunk()
        .map_or(0, |bytes| u32::from_be_bytes(*bytes))
}
