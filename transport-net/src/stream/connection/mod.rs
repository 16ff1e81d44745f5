//! One connection without its socket: frames and `now` in, bytes to write and events out.
//!
//! The connection tracks the state of each parcel. A parcel is *waiting* until the kernel has begun
//! to take it, and *begun* until its answer arrives. When the connection ends, a waiting parcel
//! cannot have arrived, and a begun parcel may have.

use std::collections::{BTreeMap, HashMap, HashSet, VecDeque};
use std::io::IoSlice;
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use fipa_acl::{EnvelopeView, Letter, MessageView};
use fipa_transport::{
    Abandoned, Answer, AttemptId, Body, Conclusion, Incarnation, Mandate, Parcel, Principal,
    Stream, TransportError, TransportErrorKind,
};

use super::config::NetLimits;
use super::counters::Written;
use super::frame::{self, Frame};
use super::outbox::{About, Outbox, Progress};
use super::proof::Proof;
use crate::answer::{self, Contradictions};
use crate::end::{Acquaintance, ConnectionEnd};
use crate::hello::{Hello, Load};

/// Upper bound of parcel numbers, so that a ticket also holds the number of the connection.
pub(crate) const MAX_ID: u64 = 1 << 40;

/// Maximum number of queued control frames. Beyond it, pings are not answered: a peer that does not
/// read needs no more pongs.
const MAX_CONTROL: usize = 4;

/// Assumed minimum speed at which a peer reads. A peer that has to read more before it can answer
/// gets more time.
const SLOWEST_BYTES_PER_SECOND: u64 = 128 << 10;

/// The side that opened the connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Role {
    /// This side opened it and expects this incarnation, which may be unknown.
    Dialler { expected: Incarnation },
    /// The other side opened it.
    Acceptor,
}

/// The readers of a connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Reader {
    /// Reads all frames, or all except parcels.
    Main,
    /// Reads the streams of parcels, where they are apart.
    Parcels,
}

/// An event of a connection. Events are delivered in order.
#[derive(Debug, PartialEq)]
pub(crate) enum Event {
    /// The peer introduced itself with the expected incarnation. The caller
    /// [welcomes](Connection::welcome) it or ends the connection.
    Greeted,
    /// A parcel arrived; it is answered by its number.
    Arrived { id: u64, parcel: Box<Parcel> },
    /// An attempt of this side is concluded.
    Concluded(AttemptId, Conclusion),
}

/// The reason for which a parcel is not queued.
#[derive(Debug, PartialEq)]
pub(crate) enum SendError {
    /// The connection has ended; another one is needed.
    Ended,
    /// The parcel cannot be sent to this peer.
    Transport(TransportError),
}

#[derive(Debug)]
pub(crate) struct Connection {
    limits: NetLimits,
    role: Role,
    hello: Hello,
    peer: Option<Hello>,
    proof: Proof,
    /// Whether parcels may be sent: both sides have exchanged their hello.
    open: bool,
    /// Whether reading is paused because there is no memory for the next letter.
    paused: bool,
    /// See [`Connection::is_suspect`].
    suspect: bool,
    /// Whether the connection is about to close for idleness; new parcels need another connection.
    retiring: bool,
    ended: bool,
    outbox: Outbox,
    /// Parcels of this side, by number, until their answer arrives.
    sent: BTreeMap<u64, Sent>,
    attempts: HashMap<AttemptId, u64>,
    last_sent: u64,
    /// Parcels that may not begin yet; see [`Connection::hold`].
    held: VecDeque<(u64, Weak<Predecessors>)>,
    /// Number of parcels in `sent` that have begun.
    begun: usize,
    /// Parcels that arrived and are not answered yet.
    arrivals: HashSet<u64>,
    last_arrival: u64,
    answers_waiting: usize,
    contradictions: Contradictions,
    control_waiting: usize,
    parcels_written: u64,
    writes: u64,
    events: VecDeque<Event>,
    clock: Clock,
}

#[derive(Debug)]
struct Sent {
    /// `None` when the attempt was abandoned.
    attempt: Option<AttemptId>,
    receiver: Arc<str>,
    stream: Stream,
    /// Holds large letters of the stream back, on the connection for them.
    predecessors: Vec<Arc<Predecessors>>,
    after: u64,
    letter_len: u64,
    /// Time at which the kernel began to take it.
    begun: Option<Instant>,
}

/// The unanswered letters of a stream on one connection. The next letter of the stream is large and begins on another
/// connection when all of them are answered.
pub(crate) struct Predecessors {
    answered: Box<dyn Fn() + Send + Sync>,
}

impl Predecessors {
    /// Creates the set; `answered` is called when nothing holds it any more.
    pub(crate) fn new(answered: impl Fn() + Send + Sync + 'static) -> Arc<Self> {
        let answered = Box::new(answered);
        Arc::new(Self { answered })
    }
}

impl Drop for Predecessors {
    fn drop(&mut self) {
        (self.answered)();
    }
}

impl std::fmt::Debug for Predecessors {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Predecessors").finish_non_exhaustive()
    }
}

/// The times that the timers are based on.
#[derive(Debug)]
struct Clock {
    /// Time at which the socket was connected.
    connected: Option<Instant>,
    received: Instant,
    written: Instant,
    /// Bytes written since the last byte arrived.
    written_since: u64,
    /// Time of the last parcel, answer or hello.
    busy: Instant,
    pinged: Option<Ping>,
    /// Time since which the connection is in doubt; see [`Connection::doubt`].
    doubted: Option<Instant>,
    /// For each [reader](Reader): start of the present measuring period of a partly arrived frame, and
    /// the bytes that arrived since.
    partial: [Option<(Instant, u64)>; 2],
}

/// A ping without a byte of the peer after it.
#[derive(Debug, Clone, Copy)]
struct Ping {
    /// Time at which the ping was queued or, later, handed to the kernel.
    at: Instant,
    /// Number of control frames that wait to be written, up to the ping.
    waiting: usize,
}

impl Connection {
    /// Creates a connection whose socket is connected or, for the dialler, will be connected.
    pub(crate) fn new(limits: NetLimits, role: Role, hello: Hello, now: Instant) -> Self {
        let connected = (role == Role::Acceptor).then_some(now);
        Self {
            limits,
            role,
            hello,
            peer: None,
            proof: Proof::default(),
            open: false,
            paused: false,
            suspect: false,
            retiring: false,
            ended: false,
            outbox: Outbox::default(),
            sent: BTreeMap::new(),
            attempts: HashMap::new(),
            last_sent: 0,
            held: VecDeque::new(),
            begun: 0,
            arrivals: HashSet::new(),
            last_arrival: 0,
            answers_waiting: 0,
            contradictions: Contradictions::default(),
            control_waiting: 0,
            parcels_written: 0,
            writes: 0,
            events: VecDeque::new(),
            clock: Clock {
                connected,
                received: now,
                written: now,
                written_since: 0,
                busy: now,
                pinged: None,
                doubted: None,
                partial: [None; 2],
            },
        }
    }

    /// Notes that the dialler's socket is connected.
    pub(crate) fn connected(&mut self, now: Instant) {
        self.clock.connected = Some(now);
        self.clock.received = now;
        self.clock.written = now;
        self.say_hello();
    }

    /// Sets what the peer has proved before the first frame.
    pub(crate) fn proved(&mut self, proof: Proof) {
        self.proof = proof;
    }

    /// Checks that what the peer has proved still counts.
    ///
    /// # Errors
    /// The reason for which the connection ends.
    pub(crate) fn check_proof(&self) -> Result<(), ConnectionEnd> {
        self.proof.check()
    }

    /// Checks that the peer may send this letter. A peer with a certificate may only send letters
    /// of its own agents, according to both the envelope and the message.
    ///
    /// # Errors
    /// The reason for which the letter is refused.
    pub(crate) fn admits(&self, letter: &Letter) -> Result<(), String> {
        if !self.proof.restricts() {
            return Ok(());
        }
        let envelope = letter.envelope();
        let view = EnvelopeView::parse(&envelope);
        let view = view.map_err(|error| format!("its envelope cannot be decoded: {error}"))?;
        let from = view.from_name().ok_or("its envelope names no sender")?;
        if !self.proof.speaks_for(&from.to_string()) {
            return Err(format!(
                "the peer's certificate does not cover the sender {from}"
            ));
        }
        // Agents rely on the sender that the message names.
        let message = MessageView::parse_payload(letter.payload());
        let message = message.map_err(|error| format!("its message cannot be decoded: {error}"))?;
        match message.sender() {
            Some(sender) if sender.name().as_str() != from.as_str() => Err(format!(
                "its envelope names the sender {from}, but its message names {}",
                sender.name()
            )),
            _ => Ok(()),
        }
    }

    /// Accepts the peer that has introduced itself.
    pub(crate) fn welcome(&mut self) {
        if self.role == Role::Acceptor {
            self.say_hello();
        }
        self.open = true;
    }

    /// Returns the peer's hello after its arrival.
    pub(crate) fn peer(&self) -> Option<&Hello> {
        self.peer.as_ref()
    }

    /// Returns the certificate whose key the peer has proved to have, if any.
    pub(crate) fn proved_principal(&self) -> Option<Principal> {
        self.proof.principal()
    }

    /// Returns the agents that the peer may speak for.
    pub(crate) fn mandate(&self) -> Mandate {
        self.proof.mandate()
    }

    /// Queues a parcel for sending.
    ///
    /// # Errors
    /// When the parcel cannot be sent. The connection is unchanged then.
    pub(crate) fn send(&mut self, attempt: AttemptId, parcel: &Parcel) -> Result<(), SendError> {
        let refuse =
            |fault, detail: String| Err(SendError::Transport(TransportError::new(fault, detail)));
        if self.ended || self.retiring {
            return Err(SendError::Ended);
        }
        let letter_len = letter_len(parcel);
        let peer_max = self.peer.as_ref().map_or(u64::MAX, |peer| peer.max_letter);
        if letter_len > peer_max {
            return Err(SendError::Transport(too_large_for_peer(
                letter_len, peer_max,
            )));
        }
        if !self.proof.speaks_for(&parcel.receiver) {
            return Err(SendError::Transport(not_its_agent(&parcel.receiver)));
        }
        let NetLimits {
            max_in_flight,
            max_queued_bytes,
            ..
        } = self.limits;
        let is_letter = matches!(parcel.body, Body::Letter(_));
        if self.sent.len() >= answer::places(max_in_flight, is_letter) {
            let detail = format!(
                "{max_in_flight} parcels of this connection wait for their answer; the limit is max_in_flight"
            );
            return refuse(TransportErrorKind::Congested, detail);
        }
        let id = self.last_sent + 1;
        if id >= MAX_ID {
            return refuse(
                TransportErrorKind::Congested,
                "parcel numbers of this connection are exhausted".into(),
            );
        }
        let pieces = match frame::parcel(id, parcel) {
            Ok(pieces) => pieces,
            Err(error) => return refuse(TransportErrorKind::TooLarge, error.to_string()),
        };
        let queued = self.outbox.parcel_bytes();
        let len: usize = pieces.iter().map(bytes::Bytes::len).sum();
        if is_letter && queued > 0 && queued.saturating_add(len) > max_queued_bytes {
            let detail = format!(
                "{queued} bytes of this connection wait to be sent; the limit is {max_queued_bytes} (max_queued_bytes)"
            );
            return refuse(TransportErrorKind::Congested, detail);
        }
        self.last_sent = id;
        self.outbox.push_parcel(id, pieces);
        self.attempts.insert(attempt, id);
        self.sent.insert(
            id,
            Sent {
                attempt: Some(attempt),
                receiver: Arc::clone(&parcel.receiver),
                stream: parcel.stream,
                predecessors: Vec::new(),
                after: parcel.after,
                letter_len,
                begun: None,
            },
        );
        Ok(())
    }

    /// Returns the letters this side was asked to carry with the hello of the side that opened the connection.
    pub(crate) fn load(&self) -> Load {
        match (self.role, &self.peer) {
            (Role::Acceptor, Some(peer)) => peer.load,
            _ => self.hello.load,
        }
    }

    /// Whether the other side opened the connection.
    pub(crate) fn was_accepted(&self) -> bool {
        self.role == Role::Acceptor
    }

    /// Whether a parcel of this stream is not answered yet.
    pub(crate) fn carries(&self, stream: Stream) -> bool {
        self.sent.values().any(|sent| sent.stream == stream)
    }

    #[cfg(all(test, feature = "ip"))]
    pub(crate) fn has_attempt(&self, attempt: AttemptId) -> bool {
        self.attempts.contains_key(&attempt)
    }

    #[cfg(all(test, feature = "ip"))]
    pub(crate) fn may_begin(&self) -> usize {
        self.outbox.parcels_before(MAX_ID).min(self.window())
    }

    /// Adds the unanswered parcels of a stream to `predecessors`. An attempt that ends holds nothing back.
    pub(crate) fn note_predecessors(&mut self, stream: Stream, predecessors: &Arc<Predecessors>) {
        let is_open = |sent: &&mut Sent| sent.stream == stream && sent.attempt.is_some();
        let of_stream = self.sent.values_mut().filter(is_open);
        of_stream.for_each(|sent| sent.predecessors.push(Arc::clone(predecessors)));
    }

    /// Lets the parcel that was queued last begin only when all `predecessors` are answered.
    pub(crate) fn hold(&mut self, predecessors: Weak<Predecessors>) {
        self.held.retain(|(_, it)| !is_answered(it));
        self.held.push_back((self.last_sent, predecessors));
    }

    /// Ends an attempt. The parcel is not sent if the kernel has taken no byte of it. An attempt
    /// that had enough time and during which no byte came from the peer puts the connection in
    /// doubt. `None` if the attempt is not here.
    pub(crate) fn abandon(&mut self, attempt: AttemptId, now: Instant) -> Option<Abandoned> {
        let id = self.attempts.remove(&attempt)?;
        if self.outbox.remove_parcel(id) {
            self.sent.remove(&id);
            if !self.open {
                self.suspect_slow_start(now);
            }
            return Some(Abandoned::NotSent);
        }
        let begun = self.sent.get(&id).and_then(|sent| sent.begun);
        if let Some(begun) = begun
            && begun > self.clock.received
            && now >= begun + self.answer_timeout()
            && self.doubt(now, Duration::ZERO)
        {
            self.suspect = true;
        }
        if let Some(sent) = self.sent.get_mut(&id) {
            // The peer counts the parcel until it has answered, so the parcel still occupies the
            // window.
            sent.attempt = None;
            sent.predecessors.clear();
        }
        Some(Abandoned::Unconfirmed)
    }

    /// Answers a parcel that arrived. An unknown number is ignored.
    pub(crate) fn answer(&mut self, id: u64, answer: &Answer, now: Instant) {
        if !self.ended && self.arrivals.remove(&id) {
            self.answers_waiting += 1;
            self.clock.busy = now;
            self.outbox
                .push_urgent(About::Answer, frame::answer(id, answer));
        }
    }

    /// Notes that `bytes` arrived at a reader; `partial` is whether a frame has partly arrived there. They
    /// are no progress of a frame that has partly arrived at the other one.
    pub(crate) fn received(&mut self, reader: Reader, bytes: usize, partial: bool, now: Instant) {
        self.clock.received = now;
        self.clock.pinged = None;
        self.clock.doubted = None;
        self.clock.written_since = 0;
        self.suspect = false;
        let [main, parcels] = &mut self.clock.partial;
        let clock = match reader {
            Reader::Main => main,
            Reader::Parcels => parcels,
        };
        *clock = match (*clock, partial) {
            (_, false) => None,
            (None, true) => Some((now, 0)),
            (Some((since, before)), true) => Some((since, before.saturating_add(bytes as u64))),
        };
    }

    /// Pauses or resumes reading. While reading is paused, pongs show the peer that this side is
    /// alive, and the peer is not given up, because its pongs are not read either.
    pub(crate) fn pause(&mut self, paused: bool, now: Instant) {
        if std::mem::replace(&mut self.paused, paused) != paused {
            self.clock.received = now;
            self.clock.pinged = None;
            self.clock.doubted = None;
            self.suspect = false;
        }
    }

    /// Puts the connection in doubt because the peer may have moved: sends a ping with a shorter
    /// timeout than usual. Does nothing when a byte arrived within `quiet`. Returns whether the
    /// connection is in doubt.
    pub(crate) fn doubt(&mut self, now: Instant, quiet: Duration) -> bool {
        if self.ended || self.paused || self.peer.is_none() || now < self.clock.received + quiet {
            return false;
        }
        if self.clock.doubted.is_none() {
            self.clock.doubted = Some(now);
            if self.clock.pinged.is_none() {
                self.push_control(frame::ping());
            }
        }
        true
    }

    /// Makes the connection suspect when the peer's hello takes too long: later dispatches then
    /// need another connection, because the system retransmits lost packets with growing pauses.
    fn suspect_slow_start(&mut self, now: Instant) {
        let since = self.clock.connected.unwrap_or(self.clock.received);
        self.suspect |= now >= since + self.answer_timeout();
    }

    /// Whether letters should take another connection with the same peer, if there is one or one
    /// can be opened: an attempt got no answer, and no byte has arrived since.
    pub(crate) fn is_suspect(&self) -> bool {
        self.suspect
    }

    /// Makes the connection suspect because another connection with the peer came from another
    /// address; see [`is_suspect`](Self::is_suspect).
    pub(crate) fn suspect(&mut self, now: Instant) {
        self.suspect |= self.doubt(now, Duration::ZERO);
    }

    /// Returns the time without any byte from the peer after which an abandoned attempt makes the
    /// connection suspect.
    fn answer_timeout(&self) -> Duration {
        self.limits.keep_alive / 20 + self.transfer_time()
    }

    /// Returns the time that the bytes written since the last arrival may take to reach the peer.
    fn transfer_time(&self) -> Duration {
        Duration::from_millis(
            self.clock.written_since.saturating_mul(1000) / SLOWEST_BYTES_PER_SECOND,
        )
    }

    /// Sends a ping without changing any timer.
    pub(crate) fn ask(&mut self) {
        if !self.ended && self.control_waiting < MAX_CONTROL {
            self.push_control(frame::ping());
        }
    }

    /// Whether a byte arrived after `since`, or reading is paused.
    pub(crate) fn received_since(&self, since: Instant) -> bool {
        !self.ended && (self.paused || self.clock.received > since)
    }

    /// Returns the time that a peer in doubt has to respond.
    pub(crate) fn doubt_timeout(&self) -> Duration {
        self.limits.keep_alive / 4
    }

    /// Returns the time at which a connection in doubt is given up. While bytes wait to be written,
    /// bytes that the kernel still takes show that the peer reads.
    fn doubt_due(&self) -> Option<Instant> {
        let doubted = self.clock.doubted?;
        let since = match self.is_flushed() {
            true => doubted,
            false => doubted.max(self.clock.written),
        };
        Some(since + self.doubt_timeout() + self.transfer_time())
    }

    /// Handles a frame of the peer.
    ///
    /// # Errors
    /// When the frame ends the connection.
    pub(crate) fn handle_frame(&mut self, frame: Frame, now: Instant) -> Result<(), ConnectionEnd> {
        if self.ended {
            // Frames after a goodbye are not valid.
            return Ok(());
        }
        match (frame, self.peer.is_some()) {
            (Frame::Hello(hello), false) => self.handle_hello(hello, now),
            (Frame::Goodbye { last }, _) => Err(ConnectionEnd::Goodbye { last }),
            (_, false) => Err(ConnectionEnd::ProtocolViolation(
                "a frame before the hello".into(),
            )),
            (Frame::Hello(_), true) => {
                Err(ConnectionEnd::ProtocolViolation("a second hello".into()))
            }
            (Frame::Parcel { id, parcel }, true) => self.arrive(id, parcel, now),
            (Frame::Answer { id, answer }, true) => self.conclude(id, answer, now),
            (Frame::Ping, true) => {
                if self.control_waiting < MAX_CONTROL {
                    self.push_control(frame::pong());
                }
                Ok(())
            }
            (Frame::Pong, true) => Ok(()),
        }
    }

    /// Returns the next event.
    pub(crate) fn poll_event(&mut self) -> Option<Event> {
        self.events.pop_front()
    }

    /// Fills `slices` with the next bytes to write. Returns the number of filled slices.
    pub(crate) fn gather<'a>(&'a self, slices: &mut [IoSlice<'a>]) -> usize {
        self.outbox.gather(slices, self.window())
    }

    /// Whether there are no bytes to write now.
    pub(crate) fn is_flushed(&self) -> bool {
        self.outbox.is_idle(self.window())
    }

    /// Notes that the kernel took `taken` bytes of those that [`gather`](Self::gather) returned.
    pub(crate) fn written(&mut self, taken: usize, now: Instant) {
        self.clock.written = now;
        self.clock.written_since += taken as u64;
        self.writes += 1;
        let Self {
            outbox,
            sent,
            begun,
            answers_waiting,
            control_waiting,
            parcels_written,
            clock,
            ..
        } = self;
        outbox.written(taken, |progress| match progress {
            Progress::Begun(About::Parcel(id)) => {
                if let Some(sent) = sent.get_mut(&id) {
                    sent.begun = Some(now);
                    *begun += 1;
                    clock.busy = now;
                }
            }
            Progress::Begun(About::Answer | About::Control) => {}
            Progress::Written(About::Parcel(_)) => *parcels_written += 1,
            Progress::Written(About::Answer) => *answers_waiting -= 1,
            Progress::Written(About::Control) => {
                *control_waiting -= 1;
                if let Some(ping) = clock.pinged.as_mut().filter(|ping| ping.waiting > 0) {
                    ping.waiting -= 1;
                    ping.at = now;
                }
            }
        });
    }

    /// Returns the numbers of parcels handed to the kernel, and of writes, since the last call.
    pub(crate) fn take_written(&mut self) -> Written {
        Written {
            parcels: std::mem::take(&mut self.parcels_written),
            writes: std::mem::take(&mut self.writes),
        }
    }

    /// Whether another frame is likely to follow soon: the peer has parcels to answer, or this side
    /// has.
    pub(crate) fn is_busy(&self) -> bool {
        self.begun > 0 || !self.arrivals.is_empty()
    }

    /// Returns the number of frames that wait to be written.
    pub(crate) fn frames_waiting(&self) -> usize {
        self.outbox.frames()
    }

    /// Returns the time at which [`handle_timeout`](Self::handle_timeout) must be called at the
    /// latest.
    pub(crate) fn poll_timeout(&self) -> Option<Instant> {
        let connected = self.clock.connected?;
        let partial = self.clock.partial.iter().flatten();
        let stalled = partial.map(|(since, _)| *since + self.limits.stall_timeout);
        let stalled = stalled.min();
        if self.peer.is_none() {
            return Some(connected + self.limits.handshake_timeout);
        }
        let alive = self.sign_of_life_due();
        let idle = self
            .is_idle()
            .then(|| self.clock.busy + self.limits.idle_close);
        [stalled, Some(alive), idle, self.doubt_due()]
            .into_iter()
            .flatten()
            .min()
    }

    /// Handles the timers that are due. `least_progress` is the number of bytes of a partly arrived
    /// frame that must arrive in each measuring period, at the main reader and at that of parcels.
    ///
    /// # Errors
    /// When the connection is over.
    pub(crate) fn handle_timeout(
        &mut self,
        now: Instant,
        least_progress: [u64; 2],
    ) -> Result<(), ConnectionEnd> {
        let Some(connected) = self.clock.connected else {
            return Ok(());
        };
        if self.peer.is_none() {
            return if now >= connected + self.limits.handshake_timeout {
                Err(ConnectionEnd::TooSlow(
                    "the peer sent no hello in time (handshake_timeout)",
                ))
            } else {
                Ok(())
            };
        }
        for (clock, least) in self.clock.partial.iter_mut().zip(least_progress) {
            if let Some((since, bytes)) = *clock
                && now >= since + self.limits.stall_timeout
            {
                if bytes < least.max(NetLimits::MIN_PROGRESS) {
                    return Err(ConnectionEnd::TooSlow(
                        "the peer stopped sending in the middle of a frame (stall_timeout)",
                    ));
                }
                *clock = Some((now, 0));
            }
        }
        if self.is_idle() && now >= self.clock.busy + self.limits.idle_close {
            self.retiring = true;
            return Err(ConnectionEnd::Idle);
        }
        if self.doubt_due().is_some_and(|due| now >= due) {
            return Err(ConnectionEnd::Silent);
        }
        if now >= self.sign_of_life_due() {
            if self.paused {
                self.clock.received = now;
                if self.control_waiting < MAX_CONTROL {
                    self.push_control(frame::pong());
                }
                return Ok(());
            }
            if self.clock.pinged.is_some() {
                return Err(ConnectionEnd::Silent);
            }
            self.push_control(frame::ping());
            self.clock.pinged = Some(Ping {
                at: now,
                waiting: self.control_waiting,
            });
        }
        Ok(())
    }

    /// Returns what this side knows about the peer.
    pub(crate) fn acquaintance(&self) -> Acquaintance {
        match (&self.peer, self.proof.principal()) {
            (Some(_), _) => Acquaintance::Greeted,
            (None, Some(_)) => Acquaintance::Proved,
            (None, None) => Acquaintance::Unknown,
        }
    }

    /// Ends the connection. Returns the conclusion of every attempt, in the order of sending. After
    /// an orderly end, a goodbye remains to be written.
    pub(crate) fn end(&mut self, end: &ConnectionEnd) -> Vec<(AttemptId, Conclusion)> {
        if std::mem::replace(&mut self.ended, true) {
            return Vec::new();
        }
        self.outbox.drop_parcels();
        if end.is_orderly() && self.clock.connected.is_some() {
            self.push_control(frame::goodbye(self.last_arrival));
        }
        self.arrivals.clear();
        self.attempts.clear();
        let taken = match end {
            ConnectionEnd::Goodbye { last } => *last,
            _ => u64::MAX,
        };
        let peer = self.acquaintance();
        std::mem::take(&mut self.sent)
            .into_iter()
            .filter_map(|(id, sent)| {
                let conclusion = if sent.begun.is_some() && id <= taken {
                    Conclusion::Unconfirmed(end.after())
                } else {
                    Conclusion::NotSent(end.before(peer))
                };
                Some((sent.attempt?, conclusion))
            })
            .collect()
    }

    /// Returns the number of parcels that may still begin.
    fn window(&self) -> usize {
        let Some(peer) = self.peer.as_ref().filter(|_| self.open) else {
            return 0;
        };
        let window = (peer.max_in_flight as usize).saturating_sub(self.begun);
        let held = self.held.iter().find(|(_, it)| !is_answered(it));
        held.map_or(window, |(id, _)| {
            window.min(self.outbox.parcels_before(*id))
        })
    }

    fn is_idle(&self) -> bool {
        self.attempts.is_empty() && self.arrivals.is_empty() && self.answers_waiting == 0
    }

    /// Returns the time at which a ping is due or, after a ping, the peer is given up. While bytes wait to be written,
    /// bytes that the kernel still takes show that the peer reads: it may be busy with a large letter.
    fn sign_of_life_due(&self) -> Instant {
        let keep_alive = self.limits.keep_alive;
        if self.paused {
            // Earlier than the peer's own ping.
            return self.clock.received + keep_alive / 2;
        }
        match self.clock.pinged {
            None => self.clock.received + keep_alive,
            Some(ping) if ping.waiting == 0 && self.is_flushed() => ping.at + keep_alive,
            Some(ping) => ping.at.max(self.clock.written) + keep_alive,
        }
    }

    fn say_hello(&mut self) {
        let hello = frame::hello(&self.hello);
        self.push_control(hello);
    }

    fn push_control(&mut self, frame: bytes::Bytes) {
        self.control_waiting += 1;
        self.outbox.push_urgent(About::Control, frame);
    }

    /// Returns the error of a parcel that was queued before the hello and that this peer cannot
    /// receive.
    fn unfit(&self, sent: &Sent, peer: &Hello) -> Option<TransportError> {
        if sent.letter_len > peer.max_letter {
            return Some(too_large_for_peer(sent.letter_len, peer.max_letter));
        }
        let is_its = self.proof.speaks_for(&sent.receiver);
        (!is_its).then(|| not_its_agent(&sent.receiver))
    }

    fn handle_hello(&mut self, hello: Hello, now: Instant) -> Result<(), ConnectionEnd> {
        let found = hello.identity.incarnation;
        if found == self.hello.identity.incarnation {
            // This side would send letters and its directory to itself. The hello shows the dialing side
            // why the connection ends.
            if self.role == Role::Acceptor {
                self.say_hello();
            }
            return Err(ConnectionEnd::Itself);
        }
        if let Role::Dialler { expected } = self.role
            && expected.is_known()
            && expected != found
        {
            return Err(ConnectionEnd::WrongIncarnation { expected, found });
        }
        if hello.max_in_flight == 0 {
            return Err(ConnectionEnd::ProtocolViolation(
                "the peer's hello allows no parcels in flight".into(),
            ));
        }
        if let Some(what) = self.proof.contradicts(&hello.identity.name) {
            return Err(ConnectionEnd::ProtocolViolation(what));
        }
        self.clock.busy = now;
        self.events.push_back(Event::Greeted);
        // These parcels were queued before the peer's identity and limits were known.
        let unfit: Vec<(u64, TransportError)> = self
            .sent
            .iter()
            .filter_map(|(id, sent)| Some((*id, self.unfit(sent, &hello)?)))
            .collect();
        for (id, error) in unfit {
            self.outbox.remove_parcel(id);
            let sent = self.sent.remove(&id);
            if let Some(attempt) = sent.and_then(|sent| sent.attempt) {
                self.attempts.remove(&attempt);
                let concluded = Event::Concluded(attempt, Conclusion::NotSent(error));
                self.events.push_back(concluded);
            }
        }
        self.peer = Some(hello);
        Ok(())
    }

    fn arrive(&mut self, id: u64, parcel: Box<Parcel>, now: Instant) -> Result<(), ConnectionEnd> {
        if id <= self.last_arrival || id >= MAX_ID {
            return Err(ConnectionEnd::ProtocolViolation(
                "a parcel number that is not larger than the one before".into(),
            ));
        }
        if self.arrivals.len() + self.answers_waiting >= self.limits.max_in_flight.max(1) {
            return Err(ConnectionEnd::ProtocolViolation(
                "more unanswered parcels than max_in_flight".into(),
            ));
        }
        if letter_len(&parcel) > self.limits.max_letter as u64 {
            return Err(ConnectionEnd::ProtocolViolation(
                "a letter larger than max_letter".into(),
            ));
        }
        self.last_arrival = id;
        self.arrivals.insert(id);
        self.clock.busy = now;
        self.events.push_back(Event::Arrived { id, parcel });
        Ok(())
    }

    fn conclude(&mut self, id: u64, answer: Answer, now: Instant) -> Result<(), ConnectionEnd> {
        match self.sent.remove(&id) {
            Some(sent) if sent.begun.is_some() => {
                if let Err(end) = self.contradictions.check(&answer, sent.after) {
                    // Reinserted because it still needs a conclusion.
                    self.sent.insert(id, sent);
                    return Err(end);
                }
                self.begun -= 1;
                self.clock.busy = now;
                if let Some(attempt) = sent.attempt {
                    self.attempts.remove(&attempt);
                    let conclusion = Conclusion::Answered(answer);
                    self.events.push_back(Event::Concluded(attempt, conclusion));
                }
                Ok(())
            }
            Some(unsent) => {
                // As above.
                self.sent.insert(id, unsent);
                Err(ConnectionEnd::ProtocolViolation(
                    "an answer to a parcel that was not sent".into(),
                ))
            }
            None => Err(ConnectionEnd::ProtocolViolation(
                "an answer to an unknown parcel".into(),
            )),
        }
    }
}

/// Whether the last of these letters has been answered, or its connection has ended.
fn is_answered(predecessors: &Weak<Predecessors>) -> bool {
    predecessors.strong_count() == 0
}

/// Returns the length of the letter in a parcel; 0 for other parcels.
pub(crate) fn letter_len(parcel: &Parcel) -> u64 {
    match &parcel.body {
        Body::Letter(letter) => letter.len() as u64,
        Body::Report(_) | Body::Credit | Body::Predecessor => 0,
    }
}

fn not_its_agent(receiver: &str) -> TransportError {
    let detail = format!("the certificate of the peer does not cover the agent {receiver}");
    TransportError::new(TransportErrorKind::Refused, detail)
}

fn too_large_for_peer(len: u64, max: u64) -> TransportError {
    TransportError::new(
        TransportErrorKind::TooLarge,
        format_args!("the letter has {len} bytes; the peer accepts at most {max}"),
    )
}

#[cfg(test)]
mod tests;
