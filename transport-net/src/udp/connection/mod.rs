//! One connection without its socket: datagrams and `now` in, datagrams and events out.
//!
//! Parcels get consecutive numbers when they are first sent, and the other side delivers them in
//! that order; a parcel that arrives early is held back. A packet is acknowledged as soon as its
//! contents are stored. The answer to a parcel is a separate frame that may be sent later, and is
//! also repeated until it is acknowledged.

mod receiving;
mod sending;

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::{Bytes, BytesMut};
use fipa_transport::wire::{self, ParcelHeader};
use fipa_transport::{
    Abandoned, Answer, AttemptId, Body, Conclusion, Incarnation, Location, Parcel, TransportError,
    TransportErrorKind,
};

use super::config::UdpLimits;
use super::counters::UdpCounters;
use super::dialing::{Dialing, OwnHello};
use super::mtu::Mtu;
use super::packet::{self, BASE, DATA_LEN, MAX_ACK, PARCEL_OVERHEAD};
use super::received::Received;
use super::recovery::{Recovery, SentContent};
use crate::answer::{self, Contradictions};
use crate::datagrams::{Outbound, Path};
use crate::end::{Acquaintance, ConnectionEnd};
use crate::hello::Hello;
use crate::rate_limit::PeerRateLimit;
use crate::stream::budget::{Meter, ReservedBytes};

/// Upper bound of parcel numbers, so that a ticket also holds the number of the connection.
pub(crate) const MAX_ID: u64 = 1 << 40;

/// Time that a peer has to respond after it has announced that it is elsewhere.
const LEFT_TIMEOUT: Duration = Duration::from_millis(200);

/// Number of losses of a large packet after which the path is assumed to have a smaller MTU.
const LOSSES_OF_LARGE: u8 = 6;

/// Minimum number of retransmissions before a peer counts as silent.
const MIN_TRIES: u32 = 3;

/// An event of a connection. Events are delivered in order.
#[derive(Debug)]
pub(crate) enum Event {
    /// A parcel arrived; it is answered by its number.
    Arrived { id: u64, parcel: Box<Parcel> },
    /// An attempt of this side is concluded.
    Concluded(AttemptId, Conclusion),
}

/// A parcel, or the notice that a number is skipped, that arrived before an earlier parcel.
#[derive(Debug)]
struct OutOfOrderParcel {
    parcel: Option<Box<Parcel>>,
    _room: Option<ReservedBytes>,
}

#[derive(Debug)]
pub(crate) struct Connection {
    limits: UdpLimits,
    /// The identifier on datagrams of the peer.
    id: u64,
    /// The identifier on datagrams to the peer, once it is known.
    peer_id: u64,
    expected: Incarnation,
    peer: Option<Hello>,
    /// The handshake, until the peer has answered.
    dialing: Option<Dialing>,
    path: Option<Path>,
    waiting: VecDeque<Outgoing>,
    waiting_bytes: usize,
    /// Sent parcels, until their answer arrives.
    sent: BTreeMap<u64, Sent>,
    attempts: HashMap<AttemptId, u64>,
    contradictions: Contradictions,
    last_sent: u64,
    /// Parcels to retransmit.
    resend: BTreeSet<u64>,
    /// Small frames to send.
    urgent: VecDeque<SentContent>,
    /// Answers that are not acknowledged yet.
    answers: HashMap<u64, Bytes>,
    /// The number of the parcel to deliver next, and the parcels that arrived out of order.
    next_arrival: u64,
    held: BTreeMap<u64, OutOfOrderParcel>,
    held_bytes: usize,
    /// Reserves memory for them, once the peer is known.
    pub(super) meter: Option<Meter>,
    /// Delivered parcels that are not answered yet.
    arrivals: HashSet<u64>,
    /// The last parcel that was polled for the sink.
    last_polled: u64,
    /// The rate limit of the peer, if it has one. No parcels are accepted before `paused_until`.
    pub(super) rate_limit: Option<Arc<PeerRateLimit>>,
    paused_until: Option<Instant>,
    received: Received,
    recovery: Recovery,
    mtu: Mtu,
    events: VecDeque<Event>,
    last_received: Option<Instant>,
    /// Time since which the connection is in doubt; see [`Connection::doubt`].
    doubted: Option<Instant>,
    /// Whether it is in doubt because the peer has announced that it is elsewhere.
    peer_moved: bool,
    /// The last location for which the connection was used and confirmed or put in doubt.
    leads_to: Option<Location>,
    spoken: Instant,
    busy: Instant,
}

/// A parcel that waits to be sent.
#[derive(Debug)]
struct Outgoing {
    attempt: AttemptId,
    after: u64,
    header: ParcelHeader,
    pieces: Vec<Bytes>,
    /// Size of a datagram that carries nothing else.
    size: usize,
}

#[derive(Debug)]
struct Sent {
    /// `None` when the attempt was abandoned or concluded.
    attempt: Option<AttemptId>,
    after: u64,
    /// `None` when the parcel was acknowledged or is not retransmitted.
    outgoing: Option<Outgoing>,
    losses: u8,
}

impl Connection {
    /// Creates a connection that this side opens, with the expected incarnation, which may be
    /// unknown.
    pub(crate) fn dialing(
        limits: UdpLimits,
        id: u64,
        expected: Incarnation,
        hello: Hello,
        now: Instant,
    ) -> Self {
        let dialing = Dialing::new(OwnHello { id, hello }, now + limits.connect_timeout);
        Self {
            expected,
            dialing: Some(dialing),
            ..Self::new(limits, id, now)
        }
    }

    /// Creates a connection that a peer has opened, after the peer has returned its cookie.
    pub(crate) fn accepted(
        limits: UdpLimits,
        id: u64,
        peer_id: u64,
        peer: Hello,
        path: Path,
        now: Instant,
    ) -> Self {
        Self {
            peer_id,
            peer: Some(peer),
            path: Some(path),
            ..Self::new(limits, id, now)
        }
    }

    /// Sets the rate limit and the meter of the peer.
    pub(crate) fn bounded(self, rate_limit: Option<Arc<PeerRateLimit>>, meter: Meter) -> Self {
        Self {
            rate_limit,
            meter: Some(meter),
            ..self
        }
    }

    fn new(limits: UdpLimits, id: u64, now: Instant) -> Self {
        Self {
            id,
            peer_id: 0,
            expected: Incarnation::UNKNOWN,
            peer: None,
            dialing: None,
            path: None,
            waiting: VecDeque::new(),
            waiting_bytes: 0,
            sent: BTreeMap::new(),
            attempts: HashMap::new(),
            contradictions: Contradictions::default(),
            last_sent: 0,
            resend: BTreeSet::new(),
            urgent: VecDeque::new(),
            answers: HashMap::new(),
            next_arrival: 1,
            held: BTreeMap::new(),
            held_bytes: 0,
            meter: None,
            arrivals: HashSet::new(),
            last_polled: 0,
            rate_limit: None,
            paused_until: None,
            received: Received::default(),
            recovery: Recovery::new(now),
            mtu: Mtu::new(limits.max_datagram),
            events: VecDeque::new(),
            last_received: None,
            doubted: None,
            peer_moved: false,
            leads_to: None,
            spoken: now,
            busy: now,
            limits,
        }
    }

    pub(crate) fn id(&self) -> u64 {
        self.id
    }

    pub(crate) fn peer_id(&self) -> u64 {
        self.peer_id
    }

    pub(crate) fn path(&self) -> Option<Path> {
        self.path
    }

    pub(crate) fn peer(&self) -> Option<&Hello> {
        self.peer.as_ref()
    }

    /// Whether the peer has not answered the hello yet.
    pub(crate) fn is_opening(&self) -> bool {
        self.dialing.is_some()
    }

    /// Returns the handshake while it is not complete.
    pub(crate) fn dialing_mut(&mut self) -> Option<&mut Dialing> {
        self.dialing.as_mut()
    }

    /// Queues a parcel for sending.
    ///
    /// # Errors
    /// When the parcel cannot be sent. The connection is unchanged then.
    pub(crate) fn send(
        &mut self,
        attempt: AttemptId,
        parcel: &Parcel,
    ) -> Result<(), TransportError> {
        let Ok((header, pieces)) = ParcelHeader::of(parcel) else {
            let detail = "the receiver's name is empty or too long";
            return Err(TransportError::new(TransportErrorKind::Refused, detail));
        };
        let body: usize = pieces.iter().map(Bytes::len).sum();
        let size = body.saturating_add(PARCEL_OVERHEAD);
        let carried = if self.mtu.is_settled() {
            self.mtu.current()
        } else {
            self.limits.max_datagram
        };
        if size > carried {
            return Err(too_large(size, carried));
        }
        let UdpLimits {
            max_in_flight,
            max_queued_bytes,
            ..
        } = self.limits;
        let is_letter = matches!(parcel.body, Body::Letter(_));
        if self.sent.len() + self.waiting.len() >= answer::places(max_in_flight, is_letter) {
            let detail = format!(
                "{max_in_flight} parcels of this connection wait for their answer; the limit is max_in_flight"
            );
            return Err(TransportError::new(TransportErrorKind::Congested, detail));
        }
        let queued = self.waiting_bytes;
        if is_letter && queued > 0 && queued.saturating_add(size) > max_queued_bytes {
            let detail = format!(
                "{queued} bytes of this connection wait to be sent; the limit is {max_queued_bytes} (max_queued_bytes)"
            );
            return Err(TransportError::new(TransportErrorKind::Congested, detail));
        }
        if self.last_sent.saturating_add(self.waiting.len() as u64) + 1 >= MAX_ID {
            let detail = "parcel numbers of this connection are exhausted";
            return Err(TransportError::new(TransportErrorKind::Congested, detail));
        }
        self.waiting_bytes += size;
        self.waiting.push_back(Outgoing {
            attempt,
            after: parcel.after,
            header,
            pieces,
            size,
        });
        Ok(())
    }

    /// Ends an attempt. The parcel is not sent if no datagram with it was sent.
    pub(crate) fn abandon(&mut self, attempt: AttemptId) -> Abandoned {
        let mut end = Abandoned::Unconfirmed;
        if let Some(id) = self.attempts.remove(&attempt) {
            if let Some(sent) = self.sent.get_mut(&id) {
                sent.attempt = None;
            }
        } else if let Some(place) = self.waiting.iter().position(|o| o.attempt == attempt)
            && let Some(outgoing) = self.waiting.remove(place)
        {
            self.waiting_bytes -= outgoing.size;
            end = Abandoned::NotSent;
        }
        self.events
            .retain(|event| !matches!(event, Event::Concluded(other, _) if *other == attempt));
        end
    }

    /// Answers a parcel that arrived. An unknown number is ignored.
    pub(crate) fn answer(&mut self, id: u64, answer: &Answer, now: Instant) {
        if self.arrivals.remove(&id) {
            let mut body = BytesMut::with_capacity(wire::answer_len(answer));
            wire::write_answer(answer, &mut body);
            self.answers.insert(id, body.freeze());
            self.urgent.push_back(SentContent::Answer(id));
            self.busy = now;
        }
    }

    /// Opens the connection after the peer's welcome.
    ///
    /// # Errors
    /// When the peer has another incarnation than expected, or accepts no parcels.
    pub(crate) fn welcomed(
        &mut self,
        path: Path,
        peer_id: u64,
        peer: Hello,
        now: Instant,
    ) -> Result<(), ConnectionEnd> {
        let Some(dialing) = self.dialing.take() else {
            return Ok(());
        };
        self.path = Some(path);
        self.peer_id = peer_id;
        if let Some(sample) = dialing.round_trip(path, now) {
            self.recovery.measured(sample);
        }
        self.last_received = Some(now);
        self.busy = now;
        let (expected, found) = (self.expected, peer.identity.incarnation);
        if expected.is_known() && expected != found {
            return Err(ConnectionEnd::WrongIncarnation { expected, found });
        }
        if peer.max_in_flight == 0 {
            return Err(ConnectionEnd::ProtocolViolation(
                "the peer's hello allows no parcels in flight".into(),
            ));
        }
        self.peer = Some(peer);
        Ok(())
    }

    /// Puts the connection in doubt because the peer may have moved: sends a ping with a shorter
    /// timeout than usual. Does nothing when a packet arrived within `quiet`. Returns whether the
    /// connection is in doubt.
    pub(crate) fn doubt(&mut self, now: Instant, quiet: Duration) -> bool {
        let is_recent = self.last_received.is_some_and(|at| now < at + quiet);
        if self.peer.is_none() || is_recent {
            return false;
        }
        if self.doubted.is_none() {
            self.doubted = Some(now);
            self.urgent.push_back(SentContent::Ping);
        }
        true
    }

    /// Puts the connection in doubt because the peer has announced that it is elsewhere.
    pub(crate) fn peer_moved(&mut self, now: Instant) {
        self.peer_moved = self.doubt(now, Duration::ZERO);
    }

    /// Sends a ping to the peer.
    pub(crate) fn ask(&mut self) {
        if !self
            .urgent
            .iter()
            .any(|content| matches!(content, SentContent::Ping))
        {
            self.urgent.push_back(SentContent::Ping);
        }
    }

    /// Whether a packet arrived after this time.
    pub(crate) fn received_since(&self, since: Instant) -> bool {
        self.last_received.is_some_and(|at| at > since)
    }

    /// Notes that the connection is used for a location for which it was not opened. When the peer
    /// did not list that address it may have moved there, so the connection is in doubt.
    pub(crate) fn is_used_for(&mut self, now: Instant, to: &Location) {
        if self.leads_to.as_ref() == Some(to) {
            return;
        }
        let peer = self.peer.as_ref();
        let listed = peer.is_some_and(|peer| peer.listening.iter().any(|it| it == to.address()));
        if listed || self.doubt(now, self.doubt_timeout()) {
            self.leads_to = Some(to.clone());
        }
    }

    /// Returns the time that a peer in doubt has to respond.
    fn doubt_timeout(&self) -> Duration {
        let timeout = self.limits.silence / 4;
        match self.peer_moved {
            true => timeout.min(LEFT_TIMEOUT),
            false => timeout,
        }
    }

    fn doubt_due(&self) -> Option<Instant> {
        Some(self.doubted? + self.doubt_timeout())
    }

    /// Handles the failure to send the last datagram because of its size.
    ///
    /// # Errors
    /// When its size is one that every path must carry, so that its contents cannot be sent in
    /// smaller datagrams.
    pub(crate) fn too_big(&mut self, size: usize) -> Result<(), ConnectionEnd> {
        if !self.is_opening() && size <= BASE {
            return Err(ConnectionEnd::Broken(format!(
                "this host cannot send datagrams of {size} bytes to this peer, and UDP needs {BASE}; \
                 check the MTU of the network interface"
            )));
        }
        self.mtu.too_big(size);
        let contents = self.recovery.withdraw();
        contents.into_iter().for_each(|content| self.lost(content));
        Ok(())
    }

    pub(crate) fn has_events(&self) -> bool {
        !self.events.is_empty()
    }

    /// Returns the next event.
    pub(crate) fn poll_event(&mut self) -> Option<Event> {
        let event = self.events.pop_front()?;
        if let Event::Arrived { id, .. } = event {
            self.last_polled = id;
        }
        Some(event)
    }

    /// Returns the next datagram to send, with its destination.
    pub(crate) fn poll_transmit(
        &mut self,
        now: Instant,
        counters: &mut UdpCounters,
    ) -> Option<Outbound> {
        if let Some(dialing) = &mut self.dialing {
            return dialing.poll_transmit(now);
        }
        let path = self.path?;
        self.drop_unsendable();
        let mtu = self.mtu.current();
        let parcel = self.next_parcel();
        let mut out = Vec::with_capacity(parcel.map_or(256, |(_, size)| size + MAX_ACK));
        // The packet number is set below, once there is a packet to send.
        packet::put_data(&mut out, self.peer_id, 0);
        if let Some(due) = self.received.due() {
            let alone = due <= now;
            let with_small = !self.urgent.is_empty();
            let with_parcel = parcel.is_some_and(|(_, size)| size + MAX_ACK <= mtu);
            if (alone || with_small || with_parcel)
                && let Some(ack) = self.received.take_ack(now)
            {
                packet::put_ack(&mut out, &ack);
            }
        }
        let empty = out.len() == DATA_LEN;
        let mut contents = Vec::new();
        while let Some(next) = self.urgent.front() {
            if out.len() + self.frame_len(*next) > mtu {
                break;
            }
            let next = *next;
            self.urgent.pop_front();
            if self.put_small(&mut out, next) {
                contents.push(next);
            }
        }
        if let Some((fresh, size)) = parcel
            && out.len() + size - DATA_LEN <= mtu
            && self.recovery.has_room(out.len() + size - DATA_LEN)
        {
            contents.extend(self.put_next_parcel(&mut out, fresh, now, counters));
        } else if contents.is_empty()
            && self.wants_probe()
            && let Some(size) = self.mtu.take_probe()
        {
            packet::put_ping(&mut out);
            out.resize(size, 0);
            contents.push(SentContent::Probe(size));
        }
        if contents.is_empty() && empty {
            return None;
        }
        let number = self.recovery.take_number();
        if let Some(place) = out.get_mut(DATA_LEN - 8..DATA_LEN) {
            place.copy_from_slice(&number.to_le_bytes());
        }
        if !contents.is_empty() {
            self.recovery.sent(number, now, out.len(), contents);
            self.spoken = now;
        }
        Some((path, out))
    }

    /// Returns the time at which [`handle_timeout`](Self::handle_timeout) must be called at the
    /// latest.
    pub(crate) fn poll_timeout(&self) -> Option<Instant> {
        if let Some(dialing) = &self.dialing {
            return Some(dialing.due());
        }
        let silent = self
            .recovery
            .waiting_since()
            .filter(|(_, tries)| *tries >= MIN_TRIES)
            .map(|(since, _)| since + self.limits.silence);
        [
            self.received.due(),
            self.recovery.timeout_at(),
            silent,
            self.doubt_due(),
            self.ping_due(),
            self.idle_due(),
        ]
        .into_iter()
        .flatten()
        .min()
    }

    /// Handles the timers that are due.
    ///
    /// # Errors
    /// When the connection is over.
    pub(crate) fn handle_timeout(&mut self, now: Instant) -> Result<(), ConnectionEnd> {
        if let Some(dialing) = &mut self.dialing {
            return dialing.handle_timeout(now, self.limits.connect_timeout);
        }
        if let Some((since, tries)) = self.recovery.waiting_since()
            && tries >= MIN_TRIES
            && now >= since + self.limits.silence
        {
            return Err(ConnectionEnd::Silent);
        }
        if self.doubt_due().is_some_and(|due| now >= due) {
            return Err(ConnectionEnd::Silent);
        }
        if self.idle_due().is_some_and(|due| now >= due) {
            return Err(ConnectionEnd::Idle);
        }
        if self.recovery.timeout_at().is_some_and(|due| now >= due) {
            let lost = self.recovery.timed_out();
            lost.into_iter().for_each(|content| self.lost(content));
            if !self.recovery.is_waiting() && self.resend.is_empty() && self.urgent.is_empty() {
                // The lost packets had no contents that are still needed.
                self.recovery.reset_backoff();
            }
        }
        if self.ping_due().is_some_and(|due| now >= due) {
            self.urgent.push_back(SentContent::Ping);
            self.spoken = now;
        }
        Ok(())
    }

    /// Ends the connection. Returns the conclusion of every attempt, in the order of sending, and a
    /// goodbye if the peer can receive one.
    pub(crate) fn end(
        mut self,
        end: &ConnectionEnd,
    ) -> (Vec<(AttemptId, Conclusion)>, Option<Outbound>) {
        let taken = match end {
            ConnectionEnd::Goodbye { last } => *last,
            _ => u64::MAX,
        };
        let mut concluded = Vec::new();
        // Conclusions that have not been polled yet.
        while let Some(event) = self.events.pop_front() {
            if let Event::Concluded(attempt, conclusion) = event {
                concluded.push((attempt, conclusion));
            }
        }
        for (id, sent) in std::mem::take(&mut self.sent) {
            let Some(attempt) = sent.attempt else {
                continue;
            };
            let conclusion = if id <= taken {
                Conclusion::Unconfirmed(end.after())
            } else {
                Conclusion::NotSent(end.before(Acquaintance::Greeted))
            };
            concluded.push((attempt, conclusion));
        }
        let peer = match self.peer {
            Some(_) => Acquaintance::Greeted,
            None => Acquaintance::Unknown,
        };
        for outgoing in std::mem::take(&mut self.waiting) {
            let conclusion = Conclusion::NotSent(end.before(peer));
            concluded.push((outgoing.attempt, conclusion));
        }
        let speechless = matches!(
            end,
            ConnectionEnd::Goodbye { .. } | ConnectionEnd::Broken(_) | ConnectionEnd::NotOpened(_)
        );
        let goodbye = self.path.filter(|_| !speechless).map(|path| {
            let mut out = Vec::new();
            packet::put_data(&mut out, self.peer_id, self.recovery.take_number());
            packet::put_goodbye(&mut out, self.last_polled);
            (path, out)
        });
        (concluded, goodbye)
    }

    /// Returns the time at which a peer that owes answers gets a ping.
    fn ping_due(&self) -> Option<Instant> {
        let owed = !self.sent.is_empty() && !self.recovery.is_waiting() && self.urgent.is_empty();
        let last_received = self.last_received.unwrap_or(self.spoken);
        owed.then(|| last_received.max(self.spoken) + self.limits.silence / 4)
    }

    fn idle_due(&self) -> Option<Instant> {
        let idle = self.sent.is_empty()
            && self.waiting.is_empty()
            && self.arrivals.is_empty()
            && self.answers.is_empty();
        let timeout = match self.last_received {
            Some(_) => self.limits.idle_close,
            // The connection was opened but never used.
            None => self.limits.connect_timeout.min(self.limits.idle_close),
        };
        idle.then(|| self.busy + timeout)
    }
}

fn too_large(size: usize, carried: usize) -> TransportError {
    let detail =
        format!("the parcel needs a datagram of {size} bytes; the path carries at most {carried}");
    TransportError::new(TransportErrorKind::TooLarge, detail)
}
