//! One connection without its socket: datagrams and `now` in, datagrams and events out.
//!
//! Parcels are numbered without holes when they first leave, and handed on in that order at the
//! other side; what arrives early is held back. A packet is acknowledged as soon as what it
//! carries is in safe hands; the answer to a parcel is a frame of its own that may come later, and
//! is repeated until it is acknowledged, too.

mod receiving;
mod sending;

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet, VecDeque};
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::{Bytes, BytesMut};
use fipa_transport::wire::ParcelHeader;
use fipa_transport::{
    Abandoned, Answer, AttemptId, Conclusion, Incarnation, Location, Parcel, WayError, WayFault,
};

use super::config::UdpLimits;
use super::counters::UdpCounters;
use super::dialling::Dialling;
use super::mtu::Mtu;
use super::packet::{self, BASE, DATA_LEN, MAX_ACK, PARCEL_OVERHEAD};
use super::received::Received;
use super::recovery::{Kept, Recovery};
use crate::answer;
use crate::end::ConnectionEnd;
use crate::hello::Hello;
use crate::rate_limit::PeerRateLimit;
use crate::stream::budget::{Meter, ReservedBytes};

/// Numbers of parcels stay below this, so that a ticket has room for the connection's number too.
pub(crate) const MAX_ID: u64 = 1 << 40;

/// How often a large packet gets lost before the path is taken to have become smaller.
const LOSSES_OF_LARGE: u8 = 6;

/// How often what was sent is sent again, at least, before a peer counts as silent.
const MIN_TRIES: u32 = 3;

/// Where datagrams of a connection come from and go to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct Path {
    /// The number of the socket.
    pub(crate) socket: u32,
    pub(crate) remote: SocketAddr,
    /// The own address that the peer writes to, where the socket has several.
    pub(crate) local: Option<IpAddr>,
}

/// A datagram, and where it goes.
pub(crate) type Outbound = (Path, Vec<u8>);

/// What happened, in order.
#[derive(Debug)]
pub(crate) enum Event {
    /// A parcel arrived, to be answered by its number.
    Arrived { id: u64, parcel: Box<Parcel> },
    /// A parcel sent from here came to its end.
    Concluded(AttemptId, Conclusion),
}

/// What has arrived before its turn: a parcel, or that there never is one.
#[derive(Debug)]
struct Held {
    parcel: Option<Box<Parcel>>,
    _room: Option<ReservedBytes>,
}

#[derive(Debug)]
pub(crate) struct Connection {
    limits: UdpLimits,
    /// What the peer writes on its datagrams.
    id: u64,
    /// What stands on those to the peer, once it is known.
    peer_id: u64,
    expected: Incarnation,
    peer: Option<Hello>,
    /// Until the peer has answered.
    dialling: Option<Dialling>,
    path: Option<Path>,
    waiting: VecDeque<Outgoing>,
    waiting_bytes: usize,
    /// Parcels that left, until their answer arrives.
    sent: BTreeMap<u64, Sent>,
    attempts: HashMap<AttemptId, u64>,
    last_sent: u64,
    /// Parcels to be sent again.
    resend: BTreeSet<u64>,
    /// Small frames to be sent.
    urgent: VecDeque<Kept>,
    /// Answers that are not acknowledged.
    answers: HashMap<u64, Bytes>,
    /// The parcel to be handed on next, and what arrived before its turn.
    next_arrival: u64,
    held: BTreeMap<u64, Held>,
    held_bytes: usize,
    /// Takes the memory for those, once the peer is known.
    pub(super) meter: Option<Meter>,
    /// Parcels handed on and not answered.
    arrivals: HashSet<u64>,
    /// The last parcel that the sink has really been told of.
    told: u64,
    /// What the peer may still send, if that is limited; no parcels are taken before then.
    pub(super) rate_limit: Option<Arc<PeerRateLimit>>,
    resting: Option<Instant>,
    received: Received,
    recovery: Recovery,
    mtu: Mtu,
    events: VecDeque<Event>,
    heard: Option<Instant>,
    /// Since when the connection is in doubt; see [`Connection::doubt`].
    doubted: Option<Instant>,
    /// Where the peer has been found to be, of what it was last looked for.
    leads_to: Option<Location>,
    spoken: Instant,
    busy: Instant,
}

/// A parcel that waits to be sent.
#[derive(Debug)]
struct Outgoing {
    attempt: AttemptId,
    header: ParcelHeader,
    pieces: Vec<Bytes>,
    /// Size of a datagram that carries nothing else.
    size: usize,
}

#[derive(Debug)]
struct Sent {
    /// None when it was abandoned, or its conclusion has been told.
    attempt: Option<AttemptId>,
    /// None when it was acknowledged, or is not to be sent again.
    outgoing: Option<Outgoing>,
    losses: u8,
}

impl Connection {
    /// A connection that this side opens, looking for an incarnation (which may be unknown).
    pub(crate) fn dialling(
        limits: UdpLimits,
        id: u64,
        expected: Incarnation,
        hello: Hello,
        now: Instant,
    ) -> Self {
        let dialling = Dialling::new(id, hello, now + limits.connect_timeout);
        Self {
            expected,
            dialling: Some(dialling),
            ..Self::new(limits, id, now)
        }
    }

    /// A connection that a peer has opened, which has shown that it receives what is sent there.
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

    /// The same, of a peer that may send so much, and whose parcels wait in memory from this meter.
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
            dialling: None,
            path: None,
            waiting: VecDeque::new(),
            waiting_bytes: 0,
            sent: BTreeMap::new(),
            attempts: HashMap::new(),
            last_sent: 0,
            resend: BTreeSet::new(),
            urgent: VecDeque::new(),
            answers: HashMap::new(),
            next_arrival: 1,
            held: BTreeMap::new(),
            held_bytes: 0,
            meter: None,
            arrivals: HashSet::new(),
            told: 0,
            rate_limit: None,
            resting: None,
            received: Received::default(),
            recovery: Recovery::new(now),
            mtu: Mtu::new(limits.max_datagram),
            events: VecDeque::new(),
            heard: None,
            doubted: None,
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

    /// Whether the peer has not answered yet.
    pub(crate) fn is_opening(&self) -> bool {
        self.dialling.is_some()
    }

    /// The opening of this connection, while it goes on.
    pub(crate) fn dialling_mut(&mut self) -> Option<&mut Dialling> {
        self.dialling.as_mut()
    }

    /// Takes a parcel for sending.
    ///
    /// # Errors
    /// When it does not go; nothing has been changed then.
    pub(crate) fn send(&mut self, attempt: AttemptId, parcel: &Parcel) -> Result<(), WayError> {
        let Ok((header, pieces)) = ParcelHeader::of(parcel) else {
            let detail = "the receiver's name is empty or too long";
            return Err(WayError::new(WayFault::Refused, detail));
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
        if self.sent.len() + self.waiting.len() >= max_in_flight.max(1) {
            let detail = format!("{max_in_flight} parcels are on their way (max_in_flight)");
            return Err(WayError::new(WayFault::Congested, detail));
        }
        let queued = self.waiting_bytes;
        if queued > 0 && queued.saturating_add(size) > max_queued_bytes {
            let detail = format!("{queued} bytes wait to be sent (max_queued_bytes)");
            return Err(WayError::new(WayFault::Congested, detail));
        }
        if self.last_sent.saturating_add(self.waiting.len() as u64) + 1 >= MAX_ID {
            let detail = "the connection is worn out";
            return Err(WayError::new(WayFault::Congested, detail));
        }
        self.waiting_bytes += size;
        self.waiting.push_back(Outgoing {
            attempt,
            header,
            pieces,
            size,
        });
        Ok(())
    }

    /// Ends an attempt: it is not sent if no datagram of it has left.
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

    /// Answers a parcel that arrived. Unknown ones are ignored.
    pub(crate) fn answer(&mut self, id: u64, answer: &Answer, now: Instant) {
        if self.arrivals.remove(&id) {
            let mut body = BytesMut::with_capacity(answer::len(answer));
            answer::encode(answer, &mut body);
            self.answers.insert(id, body.freeze());
            self.urgent.push_back(Kept::Answer(id));
            self.busy = now;
        }
    }

    /// The peer has answered: the connection is open.
    ///
    /// # Errors
    /// When it is not the peer that was meant.
    pub(crate) fn welcomed(
        &mut self,
        path: Path,
        peer_id: u64,
        peer: Hello,
        now: Instant,
    ) -> Result<(), ConnectionEnd> {
        let Some(dialling) = self.dialling.take() else {
            return Ok(());
        };
        self.path = Some(path);
        self.peer_id = peer_id;
        if let Some(sample) = dialling.round_trip(path, now) {
            self.recovery.measured(sample);
        }
        self.heard = Some(now);
        self.busy = now;
        let (expected, found) = (self.expected, peer.identity.incarnation);
        if expected.is_known() && expected != found {
            return Err(ConnectionEnd::WrongIncarnation { expected, found });
        }
        if peer.max_in_flight == 0 {
            return Err(ConnectionEnd::ProtocolViolation(
                "the peer takes no parcels at all".into(),
            ));
        }
        self.peer = Some(peer);
        Ok(())
    }

    /// There is reason to believe that the peer is elsewhere by now: it is asked for a sign of life,
    /// with less patience than usual. Does nothing when the peer has been heard within `quiet`.
    /// Returns whether the connection is in doubt.
    pub(crate) fn doubt(&mut self, now: Instant, quiet: Duration) -> bool {
        let heard = self.heard.is_some_and(|heard| now < heard + quiet);
        if self.peer.is_none() || heard {
            return false;
        }
        if self.doubted.is_none() {
            self.doubted = Some(now);
            self.urgent.push_back(Kept::Ping);
        }
        true
    }

    /// Asks the peer for a sign of life.
    pub(crate) fn ask(&mut self) {
        if !self.urgent.iter().any(|kept| matches!(kept, Kept::Ping)) {
            self.urgent.push_back(Kept::Ping);
        }
    }

    /// Whether the peer was heard after this time.
    pub(crate) fn is_heard_since(&self, since: Instant) -> bool {
        self.heard.is_some_and(|heard| heard > since)
    }

    /// The peer is looked for at a location that this connection was not opened for. When the peer
    /// did not list that address it may have moved there, so the connection is in doubt.
    pub(crate) fn is_used_for(&mut self, now: Instant, to: &Location) {
        if self.leads_to.as_ref() == Some(to) {
            return;
        }
        let peer = self.peer.as_ref();
        let listed = peer.is_some_and(|peer| peer.listening.iter().any(|it| it == to.address()));
        if listed || self.doubt(now, self.doubt_patience()) {
            self.leads_to = Some(to.clone());
        }
    }

    /// How long a peer in doubt has to give a sign of life.
    fn doubt_patience(&self) -> Duration {
        self.limits.silence / 4
    }

    fn doubt_due(&self) -> Option<Instant> {
        Some(self.doubted? + self.doubt_patience())
    }

    /// The datagram that was taken last is larger than what can be sent from here.
    ///
    /// # Errors
    /// When it was of a size that every path carries: nothing smaller is made of what it carried.
    pub(crate) fn too_big(&mut self, size: usize) -> Result<(), ConnectionEnd> {
        if !self.is_opening() && size <= BASE {
            return Err(ConnectionEnd::Broken(format!(
                "this host takes no datagrams of {size} bytes for this peer, and UDP needs {BASE}; \
                 see the MTU of the interface that leads there"
            )));
        }
        self.mtu.too_big(size);
        let kept = self.recovery.withdraw();
        kept.into_iter().for_each(|kept| self.lost(kept));
        Ok(())
    }

    pub(crate) fn has_events(&self) -> bool {
        !self.events.is_empty()
    }

    /// The next thing that happened.
    pub(crate) fn poll_event(&mut self) -> Option<Event> {
        let event = self.events.pop_front()?;
        if let Event::Arrived { id, .. } = event {
            self.told = id;
        }
        Some(event)
    }

    /// The next datagram to be sent, and where to.
    pub(crate) fn poll_transmit(
        &mut self,
        now: Instant,
        counters: &mut UdpCounters,
    ) -> Option<Outbound> {
        if let Some(dialling) = &mut self.dialling {
            return dialling.poll_transmit(now);
        }
        let path = self.path?;
        self.sift();
        let mtu = self.mtu.current();
        let parcel = self.next_parcel();
        let mut out = Vec::with_capacity(parcel.map_or(256, |(_, size)| size + MAX_ACK));
        // The number follows once it is certain that there is a packet.
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
        let mut kept = Vec::new();
        while let Some(next) = self.urgent.front() {
            if out.len() + self.frame_len(*next) > mtu {
                break;
            }
            let next = *next;
            self.urgent.pop_front();
            if self.put_small(&mut out, next) {
                kept.push(next);
            }
        }
        if let Some((fresh, size)) = parcel
            && out.len() + size - DATA_LEN <= mtu
            && self.recovery.has_room(out.len() + size - DATA_LEN)
        {
            kept.extend(self.put_next_parcel(&mut out, fresh, now, counters));
        } else if kept.is_empty()
            && self.wants_probe()
            && let Some(size) = self.mtu.take_probe()
        {
            packet::put_ping(&mut out);
            out.resize(size, 0);
            kept.push(Kept::Probe(size));
        }
        if kept.is_empty() && empty {
            return None;
        }
        let number = self.recovery.take_number();
        if let Some(place) = out.get_mut(DATA_LEN - 8..DATA_LEN) {
            place.copy_from_slice(&number.to_le_bytes());
        }
        if !kept.is_empty() {
            self.recovery.sent(number, now, out.len(), kept);
            self.spoken = now;
        }
        Some((path, out))
    }

    /// When [`handle_timeout`](Self::handle_timeout) is to be called at the latest.
    pub(crate) fn poll_timeout(&self) -> Option<Instant> {
        if let Some(dialling) = &self.dialling {
            return Some(dialling.due());
        }
        let silent = self
            .recovery
            .waiting_since()
            .filter(|(_, tries)| *tries >= MIN_TRIES)
            .map(|(since, _)| since + self.limits.silence);
        [
            self.received.due(),
            self.recovery.timeout(),
            silent,
            self.doubt_due(),
            self.ping_due(),
            self.idle_due(),
        ]
        .into_iter()
        .flatten()
        .min()
    }

    /// Does what is due.
    ///
    /// # Errors
    /// When the connection is over.
    pub(crate) fn handle_timeout(&mut self, now: Instant) -> Result<(), ConnectionEnd> {
        if let Some(dialling) = &mut self.dialling {
            return dialling.handle_timeout(now, self.limits.connect_timeout);
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
        if self.recovery.timeout().is_some_and(|due| now >= due) {
            let lost = self.recovery.timed_out();
            lost.into_iter().for_each(|kept| self.lost(kept));
            if !self.recovery.is_waiting() && self.resend.is_empty() && self.urgent.is_empty() {
                // It was about what nobody waits for any more.
                self.recovery.calm();
            }
        }
        if self.ping_due().is_some_and(|due| now >= due) {
            self.urgent.push_back(Kept::Ping);
            self.spoken = now;
        }
        Ok(())
    }

    /// Ends the connection: gives every parcel sent from here its conclusion, in the order of
    /// sending, and says goodbye where that makes sense.
    pub(crate) fn end(
        mut self,
        end: &ConnectionEnd,
    ) -> (Vec<(AttemptId, Conclusion)>, Option<Outbound>) {
        let taken = match end {
            ConnectionEnd::Goodbye { last } => *last,
            _ => u64::MAX,
        };
        let mut concluded = Vec::new();
        // What has been concluded already, and not been told yet.
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
                Conclusion::NotSent(end.before(true))
            };
            concluded.push((attempt, conclusion));
        }
        let greeted = self.peer.is_some();
        for outgoing in std::mem::take(&mut self.waiting) {
            let conclusion = Conclusion::NotSent(end.before(greeted));
            concluded.push((outgoing.attempt, conclusion));
        }
        let speechless = matches!(
            end,
            ConnectionEnd::Goodbye { .. } | ConnectionEnd::Broken(_) | ConnectionEnd::NotOpened(_)
        );
        let goodbye = self.path.filter(|_| !speechless).map(|path| {
            let mut out = Vec::new();
            packet::put_data(&mut out, self.peer_id, self.recovery.take_number());
            packet::put_goodbye(&mut out, self.told);
            (path, out)
        });
        (concluded, goodbye)
    }

    /// When a peer that owes answers is asked for a sign of life.
    fn ping_due(&self) -> Option<Instant> {
        let owed = !self.sent.is_empty() && !self.recovery.is_waiting() && self.urgent.is_empty();
        let heard = self.heard.unwrap_or(self.spoken);
        owed.then(|| heard.max(self.spoken) + self.limits.silence / 4)
    }

    fn idle_due(&self) -> Option<Instant> {
        let idle = self.sent.is_empty()
            && self.waiting.is_empty()
            && self.arrivals.is_empty()
            && self.answers.is_empty();
        let patience = match self.heard {
            Some(_) => self.limits.idle_close,
            // It was opened, and then not used.
            None => self.limits.connect_timeout.min(self.limits.idle_close),
        };
        idle.then(|| self.busy + patience)
    }
}

fn too_large(size: usize, carried: usize) -> WayError {
    let detail = format!("it needs a datagram of {size} bytes, and the path carries {carried}");
    WayError::new(WayFault::TooLarge, detail)
}
