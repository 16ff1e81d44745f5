//! One connection without its socket: frames and `now` in, bytes to write and events out.
//!
//! The connection keeps the honest account of parcels. A parcel is *waiting* until the kernel has
//! begun to take it, and *begun* until its answer arrives; when the connection ends, the former
//! cannot have arrived and the latter may have.

use std::collections::{BTreeMap, HashMap, HashSet, VecDeque};
use std::io::IoSlice;
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_acl::{EnvelopeView, Letter, MessageView};
use fipa_transport::{
    Abandoned, Answer, AttemptId, Body, Conclusion, Incarnation, Mandate, Parcel, Principal,
    WayError, WayFault,
};

use super::config::Limits;
use super::frame::{self, Frame};
use super::outbox::{About, Outbox, Progress};
use super::proof::Proof;
use crate::end::End;
use crate::hello::{Hello, OWN_INCARNATION};

/// Numbers of parcels stay below this, so that a ticket has room for the connection's number too.
pub(crate) const MAX_ID: u64 = 1 << 40;

/// Control frames that may wait to be written before pings are no longer answered: a peer that
/// does not read needs no more signs of life.
const MAX_CONTROL: usize = 4;

/// A peer that has to read more before it can answer gets more time: it reads this fast at least.
const SLOWEST_BYTES_PER_SECOND: u64 = 128 << 10;

/// Which side opened the connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Role {
    /// This side, looking for this incarnation (which may be unknown).
    Dialler { expected: Incarnation },
    /// The other side.
    Acceptor,
}

/// What happened, in order.
#[derive(Debug, PartialEq)]
pub(crate) enum Event {
    /// The peer introduced itself, and is the one that was meant. To be
    /// [welcomed](Connection::welcome), or the connection to be ended.
    Greeted,
    /// A parcel arrived, to be answered by its number.
    Arrived { id: u64, parcel: Box<Parcel> },
    /// A parcel sent from here came to its end.
    Concluded(AttemptId, Conclusion),
}

/// Why a parcel is not taken for sending.
#[derive(Debug, PartialEq)]
pub(crate) enum SendError {
    /// The connection has ended: another one is needed.
    Ended,
    /// The parcel does not go.
    Way(WayError),
}

#[derive(Debug)]
pub(crate) struct Connection {
    limits: Limits,
    role: Role,
    hello: Hello,
    peer: Option<Hello>,
    proof: Proof,
    /// Whether parcels may be sent: the peer is known, and knows this side.
    open: bool,
    /// Whether nothing is read, because there is no memory for the next letter.
    paused: bool,
    /// See [`Connection::is_suspect`].
    suspect: bool,
    /// Whether it is about to end for idleness: what comes now needs another connection.
    retiring: bool,
    ended: bool,
    outbox: Outbox,
    /// Parcels sent from here, by number, until their answer arrives.
    sent: BTreeMap<u64, Sent>,
    attempts: HashMap<AttemptId, u64>,
    last_sent: u64,
    /// How many of `sent` have begun.
    begun: usize,
    /// Parcels that arrived and are not answered.
    arrivals: HashSet<u64>,
    last_arrival: u64,
    answers_waiting: usize,
    control_waiting: usize,
    parcels_written: u64,
    events: VecDeque<Event>,
    clock: Clock,
}

#[derive(Debug)]
struct Sent {
    /// None when it was abandoned.
    attempt: Option<AttemptId>,
    receiver: Arc<str>,
    letter_len: u64,
    /// When the kernel began to take it, if it has.
    begun: Option<Instant>,
}

/// What the timers go by.
#[derive(Debug)]
struct Clock {
    /// When the socket was connected, before the peer's hello.
    connected: Option<Instant>,
    received: Instant,
    written: Instant,
    /// Bytes written since something last arrived.
    written_since: u64,
    /// When something last went on that makes the connection useful.
    busy: Instant,
    pinged: bool,
    /// Since when the connection is in doubt; see [`Connection::doubt`].
    doubted: Option<Instant>,
    /// Since when a frame has been half arrived, and the bytes that came since.
    partial: Option<(Instant, u64)>,
}

impl Connection {
    /// A connection whose socket is connected, or (for the dialler) will be.
    pub(crate) fn new(limits: Limits, role: Role, hello: Hello, now: Instant) -> Self {
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
            begun: 0,
            arrivals: HashSet::new(),
            last_arrival: 0,
            answers_waiting: 0,
            control_waiting: 0,
            parcels_written: 0,
            events: VecDeque::new(),
            clock: Clock {
                connected,
                received: now,
                written: now,
                written_since: 0,
                busy: now,
                pinged: false,
                doubted: None,
                partial: None,
            },
        }
    }

    /// The dialler's socket is connected.
    pub(crate) fn connected(&mut self, now: Instant) {
        self.clock.connected = Some(now);
        self.clock.received = now;
        self.clock.written = now;
        self.say_hello();
    }

    /// The peer has proved who it is, before anything else.
    pub(crate) fn proved(&mut self, proof: Proof) {
        self.proof = proof;
    }

    /// Whether the peer may send this letter: whoever has proved who it is speaks for its agents
    /// only, in the envelope and in the message.
    ///
    /// # Errors
    /// Why not.
    pub(crate) fn admits(&self, letter: &Letter) -> Result<(), String> {
        if !self.proof.restricts() {
            return Ok(());
        }
        let envelope = letter.envelope();
        let view = EnvelopeView::parse(&envelope);
        let view = view.map_err(|error| format!("its envelope cannot be read: {error}"))?;
        let from = view.from_name().ok_or("it names no sender")?;
        if !self.proof.speaks_for(&from.to_string()) {
            return Err(format!("the peer's certificate does not speak for {from}"));
        }
        // Agents go by whom the message calls its sender.
        let message = MessageView::parse_payload(letter.payload());
        let message = message.map_err(|error| format!("its message cannot be read: {error}"))?;
        match message.sender() {
            Some(sender) if sender.name().as_str() != from.as_str() => Err(format!(
                "its envelope is from {from}, and its message from {}",
                sender.name()
            )),
            _ => Ok(()),
        }
    }

    /// The peer that has introduced itself is wanted.
    pub(crate) fn welcome(&mut self) {
        if self.role == Role::Acceptor {
            self.say_hello();
        }
        self.open = true;
    }

    /// The peer's hello, once it came.
    pub(crate) fn peer(&self) -> Option<&Hello> {
        self.peer.as_ref()
    }

    /// The certificate that the peer has proved to have the key of, if any.
    pub(crate) fn proved_principal(&self) -> Option<Principal> {
        self.proof.principal()
    }

    /// The agents that the peer may speak for.
    pub(crate) fn mandate(&self) -> Mandate {
        self.proof.mandate()
    }

    /// Takes a parcel for sending.
    ///
    /// # Errors
    /// When it does not go; nothing has been changed then.
    pub(crate) fn send(&mut self, attempt: AttemptId, parcel: &Parcel) -> Result<(), SendError> {
        let refuse = |fault, detail: String| Err(SendError::Way(WayError::new(fault, detail)));
        if self.ended || self.retiring {
            return Err(SendError::Ended);
        }
        let letter_len = letter_len(parcel);
        let peer_max = self.peer.as_ref().map_or(u64::MAX, |peer| peer.max_letter);
        if letter_len > peer_max {
            return Err(SendError::Way(too_large_for_peer(letter_len, peer_max)));
        }
        if !self.proof.speaks_for(&parcel.receiver) {
            return Err(SendError::Way(not_its_agent(&parcel.receiver)));
        }
        let Limits {
            max_in_flight,
            max_queued_bytes,
            ..
        } = self.limits;
        if self.sent.len() >= max_in_flight.max(1) {
            let detail = format!("{max_in_flight} parcels are on their way (max_in_flight)");
            return refuse(WayFault::Congested, detail);
        }
        let id = self.last_sent + 1;
        if id >= MAX_ID {
            return refuse(WayFault::Congested, "the connection is worn out".into());
        }
        let pieces = match frame::parcel(id, parcel) {
            Ok(pieces) => pieces,
            Err(error) => return refuse(WayFault::TooLarge, error.to_string()),
        };
        let queued = self.outbox.parcel_bytes();
        let len: usize = pieces.iter().map(bytes::Bytes::len).sum();
        if queued > 0 && queued.saturating_add(len) > max_queued_bytes {
            let detail = format!("{queued} bytes wait to be sent (max_queued_bytes)");
            return refuse(WayFault::Congested, detail);
        }
        self.last_sent = id;
        self.outbox.push_parcel(id, pieces);
        self.attempts.insert(attempt, id);
        self.sent.insert(
            id,
            Sent {
                attempt: Some(attempt),
                receiver: Arc::clone(&parcel.receiver),
                letter_len,
                begun: None,
            },
        );
        Ok(())
    }

    /// Ends an attempt: it is not sent if the kernel has taken nothing of it. An attempt that had time
    /// enough, and in which nothing came from the peer, puts the connection in doubt.
    pub(crate) fn abandon(&mut self, attempt: AttemptId, now: Instant) -> Abandoned {
        let Some(id) = self.attempts.remove(&attempt) else {
            return Abandoned::Unconfirmed;
        };
        if self.outbox.remove_parcel(id) {
            self.sent.remove(&id);
            if !self.open {
                self.suspect_slow_start(now);
            }
            return Abandoned::NotSent;
        }
        let begun = self.sent.get(&id).and_then(|sent| sent.begun);
        if let Some(begun) = begun
            && begun > self.clock.received
            && now >= begun + self.answer_patience()
            && self.doubt(now, Duration::ZERO)
        {
            self.suspect = true;
        }
        if let Some(sent) = self.sent.get_mut(&id) {
            // The peer counts it until it has answered, so it goes on filling the window.
            sent.attempt = None;
        }
        Abandoned::Unconfirmed
    }

    /// Answers a parcel that arrived. Unknown ones are ignored.
    pub(crate) fn answer(&mut self, id: u64, answer: &Answer, now: Instant) {
        if !self.ended && self.arrivals.remove(&id) {
            self.answers_waiting += 1;
            self.clock.busy = now;
            self.outbox
                .push_urgent(About::Answer, frame::answer(id, answer));
        }
    }

    /// So many bytes arrived, and a frame is half arrived now, or not.
    pub(crate) fn received(&mut self, bytes: usize, partial: bool, now: Instant) {
        self.clock.received = now;
        self.clock.pinged = false;
        self.clock.doubted = None;
        self.clock.written_since = 0;
        self.suspect = false;
        self.clock.partial = match (self.clock.partial, partial) {
            (_, false) => None,
            (None, true) => Some((now, 0)),
            (Some((since, before)), true) => Some((since, before.saturating_add(bytes as u64))),
        };
    }

    /// Nothing is read from now on, or it is again. Meanwhile the peer is told that this side lives,
    /// and is not given up, because its signs of life are not read either.
    pub(crate) fn pause(&mut self, paused: bool, now: Instant) {
        if std::mem::replace(&mut self.paused, paused) != paused {
            self.clock.received = now;
            self.clock.pinged = false;
            self.clock.doubted = None;
            self.suspect = false;
        }
    }

    /// There is reason to believe that the peer is elsewhere by now: it is asked for a sign of life,
    /// with less patience than usual. Does nothing when the peer has been heard within `quiet`.
    /// Returns whether the connection is in doubt.
    pub(crate) fn doubt(&mut self, now: Instant, quiet: Duration) -> bool {
        if self.ended || self.paused || self.peer.is_none() || now < self.clock.received + quiet {
            return false;
        }
        if self.clock.doubted.is_none() {
            self.clock.doubted = Some(now);
            if !self.clock.pinged {
                self.push_control(frame::ping());
            }
        }
        true
    }

    /// The peer has not introduced itself yet. If that takes long, what is dispatched from now on
    /// needs another connection: the system repeats lost packets more and more rarely.
    fn suspect_slow_start(&mut self, now: Instant) {
        let since = self.clock.connected.unwrap_or(self.clock.received);
        self.suspect |= now >= since + self.answer_patience();
    }

    /// Whether letters are to take another connection with the same peer, if there is one or one can
    /// be opened: an attempt got no answer, and nothing has come since.
    pub(crate) fn is_suspect(&self) -> bool {
        self.suspect
    }

    /// Another connection with the peer came from elsewhere; see [`is_suspect`](Self::is_suspect).
    pub(crate) fn suspect(&mut self, now: Instant) {
        self.suspect |= self.doubt(now, Duration::ZERO);
    }

    /// The time without an answer, and without any byte from the peer, after which an attempt that is
    /// abandoned speaks against the connection.
    fn answer_patience(&self) -> Duration {
        self.limits.keep_alive / 20 + self.transfer_time()
    }

    /// The time that the bytes may take to arrive that were written since the peer was last heard.
    fn transfer_time(&self) -> Duration {
        Duration::from_millis(
            self.clock.written_since.saturating_mul(1000) / SLOWEST_BYTES_PER_SECOND,
        )
    }

    /// Asks the peer for a sign of life, of which nothing follows here.
    pub(crate) fn ask(&mut self) {
        if !self.ended && self.control_waiting < MAX_CONTROL {
            self.push_control(frame::ping());
        }
    }

    /// Whether the peer has been heard since, or would not have been because nothing is read.
    pub(crate) fn is_heard_since(&self, since: Instant) -> bool {
        !self.ended && (self.paused || self.clock.received > since)
    }

    /// How long a peer in doubt has to give a sign of life.
    pub(crate) fn doubt_patience(&self) -> Duration {
        self.limits.keep_alive / 4
    }

    /// When a connection in doubt is given up. While something waits to be written, bytes that the
    /// kernel still takes show that the peer reads.
    fn doubt_due(&self) -> Option<Instant> {
        let doubted = self.clock.doubted?;
        let since = match self.is_flushed() {
            true => doubted,
            false => doubted.max(self.clock.written),
        };
        Some(since + self.doubt_patience() + self.transfer_time())
    }

    /// Takes a frame from the peer.
    ///
    /// # Errors
    /// When the connection is over because of it.
    pub(crate) fn handle_frame(&mut self, frame: Frame, now: Instant) -> Result<(), End> {
        if self.ended {
            // What arrives behind a goodbye has been disowned by it.
            return Ok(());
        }
        match (frame, self.peer.is_some()) {
            (Frame::Hello(hello), false) => self.greet(hello, now),
            (Frame::Goodbye { last }, _) => Err(End::Goodbye { last }),
            (_, false) => Err(End::Nonsense("something else before the hello".into())),
            (Frame::Hello(_), true) => Err(End::Nonsense("a second hello".into())),
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

    /// The next thing that happened.
    pub(crate) fn poll_event(&mut self) -> Option<Event> {
        self.events.pop_front()
    }

    /// Fills `slices` with what is to be written next and says how many were filled.
    pub(crate) fn gather<'a>(&'a self, slices: &mut [IoSlice<'a>]) -> usize {
        self.outbox.gather(slices, self.window())
    }

    /// Whether there is nothing to write now.
    pub(crate) fn is_flushed(&self) -> bool {
        self.outbox.is_idle(self.window())
    }

    /// The kernel took so many bytes of what [`gather`](Self::gather) had shown.
    pub(crate) fn written(&mut self, taken: usize, now: Instant) {
        self.clock.written = now;
        self.clock.written_since += taken as u64;
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
            Progress::Written(About::Control) => *control_waiting -= 1,
        });
    }

    /// Parcels handed to the kernel since this was last asked.
    pub(crate) fn take_parcels_written(&mut self) -> u64 {
        std::mem::take(&mut self.parcels_written)
    }

    /// When [`handle_timeout`](Self::handle_timeout) is to be called at the latest.
    pub(crate) fn poll_timeout(&self) -> Option<Instant> {
        let connected = self.clock.connected?;
        let stalled = self
            .clock
            .partial
            .map(|(since, _)| since + self.limits.stall_timeout);
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

    /// Does what is due. `least_progress` is how many bytes the frame that is half arrived needs to
    /// get in the time in which that is measured.
    ///
    /// # Errors
    /// When the connection is over.
    pub(crate) fn handle_timeout(&mut self, now: Instant, least_progress: u64) -> Result<(), End> {
        let Some(connected) = self.clock.connected else {
            return Ok(());
        };
        if self.peer.is_none() {
            return if now >= connected + self.limits.handshake_timeout {
                Err(End::TooSlow("the peer did not say hello in time"))
            } else {
                Ok(())
            };
        }
        if let Some((since, bytes)) = self.clock.partial
            && now >= since + self.limits.stall_timeout
        {
            if bytes < least_progress.max(Limits::MIN_PROGRESS) {
                return Err(End::TooSlow("the peer stopped in the middle of a frame"));
            }
            self.clock.partial = Some((now, 0));
        }
        if self.is_idle() && now >= self.clock.busy + self.limits.idle_close {
            self.retiring = true;
            return Err(End::Idle);
        }
        if self.doubt_due().is_some_and(|due| now >= due) {
            return Err(End::Silent);
        }
        if now >= self.sign_of_life_due() {
            if self.paused {
                self.clock.received = now;
                if self.control_waiting < MAX_CONTROL {
                    self.push_control(frame::pong());
                }
                return Ok(());
            }
            if self.clock.pinged {
                return Err(End::Silent);
            }
            self.clock.pinged = true;
            self.push_control(frame::ping());
        }
        Ok(())
    }

    /// Ends the connection: gives every parcel sent from here its conclusion, in the order of
    /// sending. After an orderly end what is left to write is a goodbye.
    pub(crate) fn end(&mut self, end: &End) -> Vec<(AttemptId, Conclusion)> {
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
            End::Goodbye { last } => *last,
            _ => u64::MAX,
        };
        let greeted = self.peer.is_some();
        std::mem::take(&mut self.sent)
            .into_iter()
            .filter_map(|(id, sent)| {
                let conclusion = if sent.begun.is_some() && id <= taken {
                    Conclusion::Unconfirmed(end.after())
                } else {
                    Conclusion::NotSent(end.before(greeted))
                };
                Some((sent.attempt?, conclusion))
            })
            .collect()
    }

    /// How many more parcels may begin.
    fn window(&self) -> usize {
        let Some(peer) = self.peer.as_ref().filter(|_| self.open) else {
            return 0;
        };
        (peer.max_in_flight as usize).saturating_sub(self.begun)
    }

    fn is_idle(&self) -> bool {
        self.attempts.is_empty() && self.arrivals.is_empty() && self.answers_waiting == 0
    }

    /// When the peer must be asked for a sign of life, or (after that) given up. Bytes that the
    /// kernel still takes show that the peer reads: it may be busy with a large letter.
    fn sign_of_life_due(&self) -> Instant {
        if self.paused {
            // Before the peer begins to ask.
            return self.clock.received + self.limits.keep_alive / 2;
        }
        if self.clock.pinged {
            let last = self.clock.received.max(self.clock.written);
            return last.max(self.clock.received + self.limits.keep_alive) + self.limits.keep_alive;
        }
        self.clock.received + self.limits.keep_alive
    }

    fn say_hello(&mut self) {
        let hello = frame::hello(&self.hello);
        self.push_control(hello);
    }

    fn push_control(&mut self, frame: bytes::Bytes) {
        self.control_waiting += 1;
        self.outbox.push_urgent(About::Control, frame);
    }

    /// Why this peer cannot get what was meant for whoever is there.
    fn unfit(&self, sent: &Sent, peer: &Hello) -> Option<WayError> {
        if sent.letter_len > peer.max_letter {
            return Some(too_large_for_peer(sent.letter_len, peer.max_letter));
        }
        let is_its = self.proof.speaks_for(&sent.receiver);
        (!is_its).then(|| not_its_agent(&sent.receiver))
    }

    fn greet(&mut self, hello: Hello, now: Instant) -> Result<(), End> {
        let found = hello.identity.incarnation;
        if let Role::Dialler { expected } = self.role
            && expected.is_known()
            && expected != found
        {
            return Err(End::WrongIncarnation { expected, found });
        }
        if found == self.hello.identity.incarnation {
            // This side would write to itself, and exchange its directory with itself.
            return Err(End::Nonsense(OWN_INCARNATION.into()));
        }
        if hello.max_in_flight == 0 {
            return Err(End::Nonsense("the peer takes no parcels at all".into()));
        }
        if let Some(what) = self.proof.contradicts(&hello.identity.name) {
            return Err(End::Nonsense(what));
        }
        self.clock.busy = now;
        self.events.push_back(Event::Greeted);
        // These were taken before it was known who the peer is, and how much it takes.
        let unfit: Vec<(u64, WayError)> = self
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

    fn arrive(&mut self, id: u64, parcel: Box<Parcel>, now: Instant) -> Result<(), End> {
        if id <= self.last_arrival || id >= MAX_ID {
            return Err(End::Nonsense("parcels whose numbers do not rise".into()));
        }
        if self.arrivals.len() + self.answers_waiting >= self.limits.max_in_flight.max(1) {
            return Err(End::Nonsense("more parcels than may be in flight".into()));
        }
        if letter_len(&parcel) > self.limits.max_letter as u64 {
            return Err(End::Nonsense("a larger letter than may be sent".into()));
        }
        self.last_arrival = id;
        self.arrivals.insert(id);
        self.clock.busy = now;
        self.events.push_back(Event::Arrived { id, parcel });
        Ok(())
    }

    fn conclude(&mut self, id: u64, answer: Answer, now: Instant) -> Result<(), End> {
        match self.sent.remove(&id) {
            Some(sent) if sent.begun.is_some() => {
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
                // Put back: it still needs its conclusion.
                self.sent.insert(id, unsent);
                Err(End::Nonsense("an answer to what was never sent".into()))
            }
            None => Err(End::Nonsense("an answer to what was never asked".into())),
        }
    }
}

/// Length of the letter in a parcel; what is no letter is small.
pub(crate) fn letter_len(parcel: &Parcel) -> u64 {
    match &parcel.body {
        Body::Letter(letter) => letter.len() as u64,
        Body::Report(_) | Body::Credit | Body::Predecessor => 0,
    }
}

fn not_its_agent(receiver: &str) -> WayError {
    let detail = format!("the certificate of the peer there does not speak for {receiver}");
    WayError::new(WayFault::Refused, detail)
}

fn too_large_for_peer(len: u64, max: u64) -> WayError {
    WayError::new(
        WayFault::TooLarge,
        format_args!("{len} bytes; the peer takes letters of up to {max}"),
    )
}

#[cfg(test)]
#[path = "connection_tests.rs"]
mod tests;
