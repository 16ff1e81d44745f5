//! A connection with its socket: the thin shell around [`Connection`].
//!
//! A sending thread writes to the socket itself, as far as the kernel takes the bytes; the task of
//! the link writes the rest. Only that task reads, and only it calls the sink.
//!
//! Between hosts, several frames that are queued in a row share a write: while parcels are unanswered,
//! the task writes, which runs as soon as the calling task yields. A frame that no other one is likely to
//! follow is written at once.

use std::io::{self, IoSlice};
#[cfg(feature = "ip")]
use std::net::IpAddr;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use fipa_transport::{
    Abandoned, Answer, Arriving, AttemptId, Body, Conclusion, FailureReason, Introduction,
    Location, Parcel, Sink, Stream, Ticket, TransportError, TransportErrorKind, log_limit,
};
use parking_lot::Mutex;
use tokio::runtime::Handle;
use tokio::sync::{Notify, watch};
use tokio::time::sleep_until;

use super::budget::ContentBuffer;
use super::connection::{Connection, Event, MAX_ID, Predecessors, Reader, SendError};
use super::counters::count;
use super::endpoint::Endpoint;
use super::frame::{FrameError, FrameReader, Placed, VERSION};
use super::proof::Proof;
use super::source::{QuotaKey, Source};
use super::wire::{ExtraStreams, Reading, Writing};
use crate::end::ConnectionEnd;
use crate::hello::Load;
use crate::rate_limit::PeerRateLimit;
#[cfg(feature = "secure")]
use crate::secure::advice::TlsFailure;

/// Maximum number of buffers handed to the kernel in one call.
const MAX_SLICES: usize = 64;

/// Number of waiting frames at which they are written at once.
const MAX_TOGETHER: usize = 8;

/// Maximum number of bytes that are discarded after this side has refused a peer, while the peer reads the reason.
const MAX_DISCARDED: usize = 1 << 16;

/// Time to read the reason that a peer sent before its side of the connection was reset.
const REASON_TIMEOUT: Duration = Duration::from_millis(100);

/// Maximum number of bytes written before the task yields.
const MAX_BURST: usize = 1 << 20;

/// Upper bound of link numbers (see [`Link::ticket`]).
pub(crate) const MAX_LINKS: u32 = 1 << 24;

#[derive(Debug)]
pub(crate) struct Link {
    /// Unique among the links of an endpoint.
    pub(crate) number: u32,
    state: Mutex<State>,
    /// Wakes the task to write bytes or to end the connection.
    wake: Notify,
    /// Notifies waiters that bytes have arrived.
    received: Notify,
    over: watch::Sender<bool>,
    begun: AtomicBool,
    /// Whether the connection is [suspect](Connection::is_suspect); readable without the lock of
    /// `state`.
    suspect: AtomicBool,
    /// Suspect connections with the same peer, beside which this one was opened.
    beside: Mutex<Vec<Arc<Link>>>,
}

#[derive(Debug)]
struct State {
    connection: Connection,
    writer: Option<Arc<Writing>>,
    /// Whether frames may share a write.
    together: bool,
    /// The reason for which the task is to end the connection.
    ending: Option<ConnectionEnd>,
    /// The last location for which the connection was used and confirmed or put in doubt.
    leads_to: Option<Location>,
    /// Time at which the peer announced that it is no longer at the location of this connection.
    peer_moved_at: Option<Instant>,
}

/// The result of a flush.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Flushed {
    All,
    Rest,
    /// Writing failed; no more bytes can be written.
    Broken,
}

impl Link {
    pub(crate) fn new(number: u32, connection: Connection) -> Arc<Self> {
        Arc::new(Self {
            number,
            state: Mutex::new(State {
                connection,
                writer: None,
                together: false,
                ending: None,
                leads_to: None,
                peer_moved_at: None,
            }),
            wake: Notify::new(),
            received: Notify::new(),
            over: watch::Sender::new(false),
            begun: AtomicBool::new(false),
            suspect: AtomicBool::new(false),
            beside: Mutex::default(),
        })
    }

    /// Whether the task has begun, which guarantees a conclusion for every parcel.
    pub(crate) fn has_begun(&self) -> bool {
        self.begun.load(Ordering::Acquire)
    }

    /// Notes that the socket is connected.
    pub(crate) fn connected(&self, now: Instant) {
        self.state.lock().connection.connected(now);
    }

    /// Ends the suspect connections beside which this one was opened and on which still no byte has
    /// arrived: bytes in their sockets would arrive late or not at all. Called when the peer has
    /// introduced itself.
    pub(crate) fn replace_suspects(&self) {
        for other in std::mem::take(&mut *self.beside.lock()) {
            if other.is_suspect() {
                other.leave(ConnectionEnd::Silent);
            }
        }
    }

    /// Sets the suspect connections with the same peer beside which this one is opened.
    pub(crate) fn opened_beside(&self, others: Vec<Arc<Self>>) {
        *self.beside.lock() = others;
    }

    /// Whether letters should take another connection if there is one.
    pub(crate) fn is_suspect(&self) -> bool {
        self.suspect.load(Ordering::Acquire)
    }

    fn note_suspicion(&self, state: &State) {
        self.suspect
            .store(state.connection.is_suspect(), Ordering::Release);
    }

    /// Sets what the peer has proved before its hello.
    fn proved(&self, proof: &Proof) {
        self.state.lock().connection.proved(proof.clone());
    }

    /// Queues a parcel for sending, and writes as many bytes as the kernel takes. The parcel does not begin before
    /// its `predecessors` are answered.
    pub(crate) fn send(
        &self,
        attempt: AttemptId,
        parcel: &Parcel,
        predecessors: Option<Weak<Predecessors>>,
    ) -> Result<(), SendError> {
        let mut state = self.state.lock();
        let is_busy = state.connection.is_busy();
        state.connection.send(attempt, parcel)?;
        if let Some(predecessors) = predecessors {
            state.connection.hold(predecessors);
        }
        self.flush_together(&mut state, is_busy);
        Ok(())
    }

    /// Returns the letters that the connection is for.
    pub(crate) fn load(&self) -> Load {
        self.state.lock().connection.load()
    }

    /// Whether the other side opened the connection.
    pub(crate) fn was_accepted(&self) -> bool {
        self.state.lock().connection.was_accepted()
    }

    /// Whether a parcel of this stream is not answered yet.
    pub(crate) fn carries(&self, stream: Stream) -> bool {
        self.state.lock().connection.carries(stream)
    }

    /// Returns the unanswered parcels of a stream on these connections. The task of this link is woken when the last
    /// one is answered.
    pub(crate) fn predecessors(
        self: &Arc<Self>,
        stream: Stream,
        on: &[Arc<Self>],
    ) -> Weak<Predecessors> {
        let link = Arc::downgrade(self);
        let all = Predecessors::new(move || {
            if let Some(link) = link.upgrade() {
                link.wake.notify_one();
            }
        });
        for other in on {
            let connection = &mut other.state.lock().connection;
            connection.note_predecessors(stream, &all);
        }
        Arc::downgrade(&all)
    }

    /// Ends an attempt. A peer that has not answered in time gets a ping. `None` if the attempt is not here.
    pub(crate) fn abandon(&self, attempt: AttemptId) -> Option<Abandoned> {
        let mut state = self.state.lock();
        let end = state.connection.abandon(attempt, Instant::now())?;
        self.note_suspicion(&state);
        if state.connection.is_suspect() && self.has_begun() {
            self.flush(&mut state);
            self.wake.notify_one();
        }
        Some(end)
    }

    /// Answers a parcel that arrived on this link, by its number.
    pub(crate) fn answer(&self, id: u64, answer: &Answer) {
        let mut state = self.state.lock();
        state.connection.answer(id, answer, Instant::now());
        let is_busy = state.connection.is_busy();
        self.flush_together(&mut state, is_busy);
    }

    /// Notes that the connection is used for a location for which it was not opened. When the peer
    /// did not list that address it may have moved there, so the connection is in doubt.
    pub(crate) fn is_used_for(&self, to: &Location) {
        let mut state = self.state.lock();
        if state.leads_to.as_ref() == Some(to) {
            return;
        }
        let peer = state.connection.peer();
        let listed = peer.is_some_and(|peer| peer.listening.iter().any(|it| it == to.address()));
        let quiet = state.connection.doubt_timeout();
        if listed || state.connection.doubt(Instant::now(), quiet) {
            state.leads_to = Some(to.clone());
        }
        if !listed {
            self.flush(&mut state);
            self.wake.notify_one();
        }
    }

    /// Puts the connection in doubt because another connection with the same service came from
    /// another address.
    pub(crate) fn doubt(&self) {
        let mut state = self.state.lock();
        state.connection.suspect(Instant::now());
        self.note_suspicion(&state);
        self.flush(&mut state);
        self.wake.notify_one();
    }

    /// Puts the connection in doubt because the peer has announced that it is no longer at this location.
    #[cfg(feature = "ip")]
    pub(crate) fn peer_moved(&self) {
        self.state.lock().peer_moved_at = Some(Instant::now());
        self.doubt();
        self.received.notify_waiters();
    }

    /// Sends a ping to the peer.
    pub(crate) fn ask(&self) {
        let mut state = self.state.lock();
        state.connection.ask();
        self.flush(&mut state);
    }

    /// Returns whether a byte of the peer arrives within `timeout` after the ping at `asked`. After the peer has
    /// announced that it is elsewhere, within `after_left`.
    pub(crate) async fn answers(
        &self,
        asked: Instant,
        timeout: Duration,
        after_move: Duration,
    ) -> bool {
        loop {
            let received = self.received.notified();
            tokio::pin!(received);
            received.as_mut().enable();
            let moved_at = {
                let state = self.state.lock();
                if state.connection.received_since(asked) {
                    return true;
                }
                state.peer_moved_at
            };
            let due_after_move = moved_at.map(|at| at.max(asked) + after_move);
            let due = due_after_move.map_or(asked + timeout, |at| at.min(asked + timeout));
            let due = tokio::time::Instant::from_std(due);
            tokio::select! {
                () = received => {}
                () = self.over() => return false,
                () = sleep_until(due) => return false,
            }
        }
    }

    /// Requests that the task ends the connection.
    pub(crate) fn leave(&self, end: ConnectionEnd) {
        self.state.lock().ending.get_or_insert(end);
        self.wake.notify_one();
    }

    /// Returns the local address of the connection; see [`Writing::local_ip`].
    #[cfg(feature = "ip")]
    pub(crate) fn local_ip(&self) -> Option<IpAddr> {
        self.state.lock().writer.as_ref()?.local_ip()
    }

    /// Waits until the end is requested.
    pub(crate) async fn end_requested(&self) -> ConnectionEnd {
        loop {
            if let Some(end) = self.state.lock().ending.clone() {
                return end;
            }
            self.wake.notified().await;
        }
    }

    /// Returns the requested end, if any.
    #[cfg(all(test, feature = "ip"))]
    pub(crate) fn ending(&self) -> Option<ConnectionEnd> {
        self.state.lock().ending.clone()
    }

    /// Handles a hello of the peer.
    #[cfg(all(test, feature = "ip"))]
    pub(crate) fn hears(&self, hello: crate::hello::Hello) {
        self.takes(super::frame::Frame::Hello(hello));
    }

    #[cfg(all(test, feature = "ip"))]
    fn takes(&self, frame: super::frame::Frame) {
        let mut state = self.state.lock();
        let taken = state.connection.handle_frame(frame, Instant::now());
        assert_eq!(taken, Ok(()));
    }

    /// A sign of life of the peer arrives.
    #[cfg(all(test, feature = "ip"))]
    pub(crate) fn hears_pong(&self) {
        self.takes(super::frame::Frame::Pong);
        let mut state = self.state.lock();
        let now = Instant::now();
        state.connection.received(Reader::Main, 1, false, now);
        drop(state);
        self.received.notify_waiters();
    }

    /// Handles and welcomes a hello of the peer.
    #[cfg(all(test, feature = "ip"))]
    pub(crate) fn greeted_by(&self, hello: crate::hello::Hello) {
        self.hears(hello);
        self.state.lock().connection.welcome();
        self.replace_suspects();
    }

    /// Whether this attempt is on this connection.
    #[cfg(all(test, feature = "ip"))]
    pub(crate) fn has_attempt(&self, attempt: AttemptId) -> bool {
        self.state.lock().connection.has_attempt(attempt)
    }

    /// Returns the number of waiting parcels that may begin.
    #[cfg(all(test, feature = "ip"))]
    pub(crate) fn may_begin(&self) -> usize {
        self.state.lock().connection.may_begin()
    }

    /// Sends all bytes of the parcels that may begin.
    #[cfg(all(test, feature = "ip"))]
    pub(crate) fn begins(&self) {
        let connection = &mut self.state.lock().connection;
        while !connection.is_flushed() {
            let mut slices = [IoSlice::new(&[]); MAX_SLICES];
            let count = connection.gather(&mut slices);
            let len = slices[..count].iter().map(|slice| slice.len()).sum();
            connection.written(len, Instant::now());
        }
    }

    /// Sends all bytes, and handles an answer of the peer.
    #[cfg(all(test, feature = "ip"))]
    pub(crate) fn answered(&self, id: u64) {
        self.begins();
        let answer = Answer::Accepted;
        self.takes(super::frame::Frame::Answer { id, answer });
    }

    /// Marks the task as ended.
    #[cfg(all(test, feature = "ip"))]
    pub(crate) fn is_over(&self) {
        self.over.send_replace(true);
    }

    /// Waits until the last parcel of this connection has been handed to the sink.
    pub(crate) async fn over(&self) {
        // `self` owns the sender, so an error is impossible.
        let _ = self.over.subscribe().wait_for(|over| *over).await;
    }

    /// Checks that the peer may send this parcel.
    ///
    /// # Errors
    /// The reason for which the parcel is refused.
    fn admits(&self, parcel: &Parcel) -> Result<(), String> {
        let Body::Letter(letter) = &parcel.body else {
            return Ok(());
        };
        self.state.lock().connection.admits(letter)
    }

    /// Returns the ticket of a parcel that arrived on this link.
    fn ticket(&self, id: u64) -> Ticket {
        Ticket(u64::from(self.number) * MAX_ID + id)
    }

    /// Writes like [`flush`](Self::flush), or leaves that to the task if more frames are likely to
    /// follow before it runs. Only on a runtime, whose tasks yield.
    fn flush_together(&self, state: &mut State, is_busy: bool) {
        let is_together = state.together
            && is_busy
            && state.connection.frames_waiting() < MAX_TOGETHER
            && Handle::try_current().is_ok();
        match is_together {
            true => self.wake.notify_one(),
            false => self.flush(state),
        }
    }

    /// Writes as many bytes as the kernel takes, and wakes the task for the rest.
    fn flush(&self, state: &mut State) {
        if state.flush() != Flushed::All {
            self.wake.notify_one();
        }
    }
}

/// Splits a ticket into the number of the link and the number of the parcel.
pub(crate) fn of_ticket(ticket: Ticket) -> (u32, u64) {
    let number = u32::try_from(ticket.0 / MAX_ID).unwrap_or(u32::MAX);
    (number, ticket.0 % MAX_ID)
}

impl State {
    fn flush(&mut self) -> Flushed {
        let Some(writer) = &self.writer else {
            return Flushed::All;
        };
        if let Err(end) = self.connection.check_proof() {
            self.ending.get_or_insert(end);
            return Flushed::Broken;
        }
        let mut burst = 0;
        while !self.connection.is_flushed() {
            if burst >= MAX_BURST {
                return Flushed::Rest;
            }
            let mut slices = [IoSlice::new(&[]); MAX_SLICES];
            let count = self.connection.gather(&mut slices);
            match writer.try_write(&slices[..count]) {
                Ok(0) => {
                    let what = "the kernel accepted no bytes".to_owned();
                    return self.ended_by(ConnectionEnd::Broken(what));
                }
                Ok(taken) => {
                    burst += taken;
                    self.connection.written(taken, Instant::now());
                }
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => return Flushed::Rest,
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return self.ended_by(end_of(&error)),
            }
        }
        match writer.try_finish() {
            Ok(()) => Flushed::All,
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => Flushed::Rest,
            Err(error) => self.ended_by(end_of(&error)),
        }
    }

    fn ended_by(&mut self, end: ConnectionEnd) -> Flushed {
        self.ending.get_or_insert(end);
        Flushed::Broken
    }
}

/// The task of a link: serves the connection and concludes its attempts when dropped.
pub(crate) struct LinkTask {
    endpoint: Arc<Endpoint>,
    link: Arc<Link>,
    sink: Arc<dyn Sink>,
    /// The location that this side dialed, if it opened the connection.
    dialed: Option<Location>,
    /// The introduction of the peer, after its hello.
    peer: Option<Introduction>,
    /// The rate limit of the peer, if it has one.
    rate_limit: Option<Arc<PeerRateLimit>>,
    /// Time until which no bytes are read because the peer exceeded its rate limit.
    paused: Option<Instant>,
    end: ConnectionEnd,
}

impl LinkTask {
    /// Must be called by the task itself: dropping the result ends the link, even if the task is
    /// aborted.
    pub(crate) fn new(
        endpoint: Arc<Endpoint>,
        link: Arc<Link>,
        sink: Arc<dyn Sink>,
        dialed: Option<Location>,
    ) -> Self {
        link.begun.store(true, Ordering::Release);
        Self {
            endpoint,
            link,
            sink,
            dialed,
            peer: None,
            rate_limit: None,
            paused: None,
            // The end that is reported when the runtime drops the task.
            end: ConnectionEnd::Closed,
        }
    }

    /// Returns the endpoint of the link.
    #[cfg(feature = "secure")]
    pub(crate) fn endpoint(&self) -> &Endpoint {
        &self.endpoint
    }

    /// Ends a link whose socket could not be connected.
    pub(crate) fn fail(mut self, end: ConnectionEnd) {
        self.end = end;
    }

    /// Serves the connection to its end. `greeted` is called when the peer has introduced itself.
    pub(crate) async fn serve(
        mut self,
        (read, writer): (Reading, Writing),
        proof: Proof,
        mut reader: FrameReader,
        from: Source,
        greeted: impl FnOnce() + Send,
    ) {
        let mut read = read;
        let mut extra = read.take_extra_streams();
        let writer = Arc::new(writer);
        self.link.proved(&proof);
        self.rate_limit = self.endpoint.rate_limit(from.home());
        let quota_key = QuotaKey::of(from, proof.principal().as_ref());
        let _window = read.widen(|len| self.endpoint.window(&quota_key, len));
        reader.count_with(self.endpoint.meter(&quota_key));
        if let Some(letters) = extra.reader() {
            letters.count_with(self.endpoint.meter(&quota_key));
        }
        {
            let mut state = self.link.state.lock();
            state.together = writer.leads_out() && !self.endpoint.serves_processes();
            state.writer = Some(writer.clone());
        }
        let mut greeted = Some(greeted);
        let exchange = self.exchange(
            (&mut read, &mut extra),
            &writer,
            &mut reader,
            from,
            &mut greeted,
        );
        let end = tokio::select! {
            end = exchange => end,
            end = proof.withdrawn() => end,
        };
        let end = match (end, &self.peer) {
            (ConnectionEnd::Broken(what), None) => {
                let reason = self.reason((&mut read, &mut reader), from, &mut greeted);
                let reason = tokio::time::timeout(REASON_TIMEOUT, reason)
                    .await
                    .ok()
                    .flatten();
                reason.unwrap_or(ConnectionEnd::Broken(what))
            }
            (end, _) => end,
        };
        self.end = match self.peer {
            None if !writer.leads_out() => end.of_process(),
            _ => end,
        };
        if let ConnectionEnd::OtherVersion { .. } = self.end {
            self.endpoint
                .other_version(from, self.dialed.as_ref(), &self.end);
        }
        if self.end == ConnectionEnd::Silent {
            writer.discard();
        }
        drop((writer, extra, reader));
        let (link, timeout) = (self.link.clone(), self.endpoint.limits().handshake_timeout);
        let orderly = self.end.is_orderly();
        // A peer of another version has nothing to send that counts.
        let most = match self.end {
            ConnectionEnd::OtherVersion { .. } => MAX_DISCARDED,
            _ => usize::MAX,
        };
        drop(self);
        if orderly {
            // After the timeout, the socket is closed without waiting for the peer.
            let _ = tokio::time::timeout(timeout, close_gracefully(&link, read, most)).await;
        }
        link.state.lock().writer = None;
    }

    /// Returns the reason that the peer sent before its side of the connection was closed. A write can fail before
    /// that reason has been read.
    async fn reason(
        &mut self,
        (read, reader): (&mut Reading, &mut FrameReader),
        from: Source,
        greeted: &mut Option<impl FnOnce() + Send>,
    ) -> Option<ConnectionEnd> {
        match read.read(&mut reader.space()).await {
            Ok(0) => None,
            Ok(arrived) => {
                let reader = (Reader::Main, reader);
                self.take_frames(reader, arrived, from, greeted).await.err()
            }
            Err(error) => match end_of(&error) {
                ConnectionEnd::Broken(_) => None,
                end => Some(end),
            },
        }
    }

    async fn exchange(
        &mut self,
        (read, extra): (&mut Reading, &mut ExtraStreams),
        writer: &Writing,
        reader: &mut FrameReader,
        from: Source,
        greeted: &mut Option<impl FnOnce() + Send>,
    ) -> ConnectionEnd {
        let timer = sleep_until(Instant::now().into());
        tokio::pin!(timer);
        let (link, byte_budget) = (self.link.clone(), self.endpoint.byte_budget.clone());
        let begun = self.take_frames((Reader::Main, reader), 0, from, greeted);
        if let Err(end) = begun.await {
            return end;
        }
        loop {
            let freed = byte_budget.freed();
            tokio::pin!(freed);
            let mut blocked = (reader.is_blocked(), extra.is_blocked());
            if blocked != (false, false) {
                // Enabled before memory is requested again, so that no notification is missed.
                freed.as_mut().enable();
                let retried = self.retry((reader, extra), blocked, from, greeted).await;
                if let Err(end) = retried {
                    return end;
                }
                blocked = (reader.is_blocked(), extra.is_blocked());
            }
            let (flushed, due) = {
                let mut state = link.state.lock();
                state.connection.pause(blocked.0, Instant::now());
                link.note_suspicion(&state);
                let flushed = state.flush();
                self.endpoint
                    .tally()
                    .add_written(state.connection.take_written());
                if let Some(end) = state.ending.clone() {
                    return end;
                }
                (flushed, state.connection.poll_timeout())
            };
            self.paused = self.paused.filter(|until| *until > Instant::now());
            let reads = self.paused.is_none();
            let due = [due, self.paused].into_iter().flatten().min();
            // The deadline usually moves later. The timer is not reset then and fires early.
            let armed = timer.deadline().into_std();
            if let Some(due) = due
                && (timer.is_elapsed() || due < armed)
            {
                timer.as_mut().reset(due.into());
            }
            let mut space = reader.space();
            tokio::select! {
                arrived = read.read(&mut space), if reads && !blocked.0 => {
                    let arrived = match arrived {
                        Ok(0) => return ConnectionEnd::Hangup,
                        Ok(bytes) => bytes,
                        Err(error) => return end_of(&error),
                    };
                    let taken = self.take_frames((Reader::Main, reader), arrived, from, greeted);
                    if let Err(end) = taken.await {
                        return end;
                    }
                }
                // A parcel of the peer may overtake its hello.
                arrived = extra.read(), if reads && !blocked.1 && self.peer.is_some() => {
                    let arrived = match arrived {
                        Ok(bytes) => bytes,
                        Err(error) => return ConnectionEnd::ProtocolViolation(error.to_string()),
                    };
                    if let Some(letters) = extra.reader() {
                        let reader = (Reader::Parcels, letters);
                        let taken = self.take_frames(reader, arrived, from, greeted);
                        if let Err(end) = taken.await {
                            return end;
                        }
                    }
                }
                ready = writer.writable(), if flushed == Flushed::Rest => {
                    if let Err(error) = ready {
                        return ConnectionEnd::Broken(error.to_string());
                    }
                }
                () = link.wake.notified() => {}
                () = &mut freed, if blocked != (false, false) => {}
                () = &mut timer => {
                    let parcels = extra.reader().map_or(0, |it| it.least_progress());
                    let least = [reader.least_progress(), parcels];
                    let mut state = link.state.lock();
                    if let Err(end) = state.connection.handle_timeout(Instant::now(), least) {
                        return end;
                    }
                }
            }
        }
    }

    /// Requests memory again for the letters that wait for it.
    async fn retry(
        &mut self,
        (reader, extra): (&mut FrameReader, &mut ExtraStreams),
        blocked: (bool, bool),
        from: Source,
        greeted: &mut Option<impl FnOnce() + Send>,
    ) -> Result<(), ConnectionEnd> {
        if blocked.0 {
            let reader = (Reader::Main, reader);
            self.take_frames(reader, 0, from, greeted).await?;
        }
        match extra.reader() {
            Some(letters) if blocked.1 => {
                let reader = (Reader::Parcels, letters);
                self.take_frames(reader, 0, from, greeted).await
            }
            _ => Ok(()),
        }
    }

    /// Processes the complete frames that have arrived at a reader.
    async fn take_frames(
        &mut self,
        (which, reader): (Reader, &mut FrameReader),
        arrived: usize,
        from: Source,
        greeted: &mut Option<impl FnOnce() + Send>,
    ) -> Result<(), ConnectionEnd> {
        let now = Instant::now();
        let link = self.link.clone();
        reader.put(arrived);
        let mut letters = 0;
        loop {
            let frame = reader.next(|arriving| self.buffer_for(arriving));
            let frame = frame.map_err(|error| self.end_by(&error))?;
            let Some(frame) = frame else { break };
            let events: [Option<Event>; 2];
            {
                let mut state = link.state.lock();
                if let Some(end) = state.ending.clone() {
                    return Err(end);
                }
                state.connection.check_proof()?;
                state.connection.handle_frame(frame, now)?;
                events = [state.connection.poll_event(), state.connection.poll_event()];
            }
            for event in events.into_iter().flatten() {
                letters += u64::from(matches!(event, Event::Arrived { .. }));
                self.handle_event(event, from, greeted).await?;
            }
            loop {
                // Rare: a hello with which many waiting letters turn out too large.
                let Some(event) = link.state.lock().connection.poll_event() else {
                    break;
                };
                self.handle_event(event, from, greeted).await?;
            }
        }
        let placed = reader.take_placed();
        if placed != Placed::default() {
            let tally = self.endpoint.tally();
            let add = |counter: &AtomicU64, more| counter.fetch_add(more, Ordering::Relaxed);
            add(&tally.placed, placed.contents);
            add(&tally.placed_moved_bytes, placed.moved);
        }
        if let Some(rate_limit) = &self.rate_limit {
            let until = rate_limit.spend(letters, arrived, now);
            if self.paused.is_none() && until.is_some() {
                count(&self.endpoint.tally().held_back);
            }
            self.paused = self.paused.max(until);
        }
        let mut state = link.state.lock();
        let partial = reader.is_partial();
        // A letter that waits for memory does not count as received.
        if arrived > 0 || !reader.is_blocked() {
            state.connection.received(which, arrived, partial, now);
            link.note_suspicion(&state);
        }
        drop(state);
        if arrived > 0 {
            link.received.notify_waiters();
        }
        Ok(())
    }

    /// Returns the end of the connection by these bytes of the peer.
    fn end_by(&self, error: &FrameError) -> ConnectionEnd {
        match (error, &self.peer) {
            (FrameError::Version(peer), None) => ConnectionEnd::OtherVersion {
                peer: *peer,
                own: VERSION,
                is_process: self.endpoint.is_within_host(),
            },
            _ => ConnectionEnd::ProtocolViolation(error.to_string()),
        }
    }

    /// Returns memory of the sink for announced content of an introduced peer.
    fn buffer_for(&self, arriving: &Arriving<'_>) -> Option<ContentBuffer> {
        self.peer.as_ref()?;
        let most = self.endpoint.limits().max_arriving;
        let loan = self.endpoint.byte_budget.lend(arriving.len, most)?;
        let memory = self.sink.memory_for(arriving)?;
        Some(ContentBuffer::new(memory, loan))
    }

    async fn handle_event(
        &mut self,
        event: Event,
        from: Source,
        greeted: &mut Option<impl FnOnce() + Send>,
    ) -> Result<(), ConnectionEnd> {
        match event {
            Event::Greeted => {
                let (peer, proved, mandate) = {
                    let connection = &self.link.state.lock().connection;
                    let proved = connection.proved_principal();
                    (connection.peer().cloned(), proved, connection.mandate())
                };
                if let Some(peer) = peer {
                    let entered = self.endpoint.enter(&self.link, &peer, proved, from).await;
                    if let Err(ConnectionEnd::NotSought) = entered {
                        // This side's hello tells the peer which service it has reached.
                        self.link.state.lock().connection.welcome();
                    }
                    let hop = entered?;
                    let introduction = Introduction {
                        name: peer.identity.name.into(),
                        hop,
                        dialed: self.dialed.clone(),
                        mandate,
                    };
                    if !self.sink.accepts(&introduction) {
                        return Err(ConnectionEnd::IdentityConflict(
                            "another certificate belongs to this service",
                        ));
                    }
                    let service = introduction.hop.location.incarnation();
                    let refused_dials = &self.endpoint.config.refused_dials;
                    refused_dials.connected(self.dialed.as_ref(), service);
                    self.peer = Some(introduction);
                }
                self.link.state.lock().connection.welcome();
                self.link.replace_suspects();
                if let Some(peer) = &self.peer {
                    self.sink.introduced(peer);
                }
                if let Some(greeted) = greeted.take() {
                    greeted();
                }
            }
            Event::Arrived { id, parcel } => {
                count(&self.endpoint.tally().parcels_in);
                let Some(peer) = &self.peer else {
                    return Err(ConnectionEnd::ProtocolViolation(
                        "a parcel before the hello".into(),
                    ));
                };
                if let Err(refused) = self.link.admits(&parcel) {
                    count(&self.endpoint.tally().refused_senders);
                    log_limit::warn!(of: from.home().whole(), "{from}: letter refused: {refused}");
                    self.link
                        .answer(id, &Answer::failed(FailureReason::Refused, &refused));
                    return Ok(());
                }
                let from = peer.hop.clone();
                let ticket = self.link.ticket(id);
                let reaction = self.sink.arrived(fipa_transport::Arrival {
                    parcel: *parcel,
                    from,
                    ticket: Some(ticket),
                });
                if let fipa_transport::Reaction::Now(answer) = reaction {
                    let mut state = self.link.state.lock();
                    state.connection.answer(id, &answer, Instant::now());
                }
            }
            Event::Concluded(attempt, conclusion) => self.sink.concluded(attempt, conclusion),
        }
        Ok(())
    }
}

impl Drop for LinkTask {
    fn drop(&mut self) {
        let (acquaintance, concluded) = {
            let mut state = self.link.state.lock();
            self.endpoint
                .tally()
                .add_written(state.connection.take_written());
            if !self.end.is_orderly() {
                state.writer = None;
            }
            let acquaintance = state.connection.acquaintance();
            (acquaintance, state.connection.end(&self.end))
        };
        if let (Some(to), None) = (&self.dialed, &self.peer)
            && let Some(refusal) = self.end.refusal(acquaintance)
        {
            self.endpoint.config.refused_dials.add(to, &refusal.detail);
        }
        let detour = self.peer.is_none() && self.endpoint.has_detour(&self.link);
        self.endpoint.connection_ended(&self.link, &self.end);
        for (attempt, conclusion) in concluded {
            let conclusion = match conclusion {
                Conclusion::NotSent(error) if detour => Conclusion::NotSent(again(&error)),
                other => other,
            };
            self.sink.concluded(attempt, conclusion);
        }
        if let Some(peer) = &self.peer {
            self.sink.disconnected(peer);
        }
        self.link.over.send_replace(true);
    }
}

/// Returns the error of a large letter that is to be dispatched again and takes the connection for all parcels.
fn again(error: &TransportError) -> TransportError {
    let detail = format!("no connection for large letters: {}", error.detail);
    TransportError::new(TransportErrorKind::Congested, detail)
}

/// Returns the end of a connection by an error of its wire.
fn end_of(error: &io::Error) -> ConnectionEnd {
    #[cfg(feature = "secure")]
    if let Some(failure) = TlsFailure::in_error(error) {
        return ConnectionEnd::Tls(failure.to_string());
    }
    ConnectionEnd::Broken(error.to_string())
}

/// Writes the remaining bytes, closes this direction, and waits until the peer closes the other or has sent `most`
/// bytes: closing a socket with unread bytes would discard the bytes that are on their way to the peer.
async fn close_gracefully(link: &Link, mut read: Reading, most: usize) {
    loop {
        let writer = {
            let mut state = link.state.lock();
            let flushed = state.flush();
            match (flushed, &state.writer) {
                (Flushed::Rest, Some(writer)) => writer.clone(),
                // A broken socket is always writable, so waiting for it would spin.
                (Flushed::Broken, _) => return,
                _ => break,
            }
        };
        if writer.writable().await.is_err() {
            return;
        }
    }
    link.state.lock().writer = None;
    read.drain(most).await;
}
