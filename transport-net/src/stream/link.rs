//! A connection with its socket: the thin shell around [`Connection`].
//!
//! Whoever has something to send writes it to the socket at once, on its own thread, as far as the
//! kernel takes it; the connection's task writes the rest. Only that task reads, and only it calls
//! the sink.

use std::io::{self, IoSlice};
#[cfg(feature = "ip")]
use std::net::IpAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use fipa_transport::{
    Abandoned, Answer, Arriving, AttemptId, Body, FailureReason, Introduction, Location, Parcel,
    Sink, Ticket,
};
use parking_lot::Mutex;
use tokio::sync::{Notify, watch};
use tokio::time::{sleep_until, timeout};

use super::connection::{Connection, Event, MAX_ID, SendError};
use super::counters::count;
use super::endpoint::Endpoint;
use super::frame::{FrameReader, Placed};
use super::place::Place;
use super::proof::Proof;
use super::source::{Account, Source};
use super::wire::{Beside, Reading, Writing};
use crate::end::End;
use crate::ration::Ration;
use crate::seldom::warn_seldom;

/// Pieces handed to the kernel in one call.
const MAX_SLICES: usize = 64;

/// Bytes written in one go before others get their turn.
const MAX_BURST: usize = 1 << 20;

/// Numbers of links stay below this (see [`Link::ticket`]).
pub(crate) const MAX_LINKS: u32 = 1 << 24;

#[derive(Debug)]
pub(crate) struct Link {
    /// Unique among the links of an endpoint.
    pub(crate) number: u32,
    state: Mutex<State>,
    /// Wakes the task: there is something to write, or an end.
    wake: Notify,
    /// Tells that something has arrived.
    heard: Notify,
    over: watch::Sender<bool>,
    begun: AtomicBool,
    /// Whether the connection is [suspect](Connection::is_suspect); to be read without its lock.
    suspect: AtomicBool,
    /// Suspect connections with the same peer, which this one was opened beside.
    beside: Mutex<Vec<Arc<Link>>>,
}

#[derive(Debug)]
struct State {
    connection: Connection,
    writer: Option<Arc<Writing>>,
    /// Why the task is to end the connection.
    ending: Option<End>,
    /// Where the peer has been found to be, of what it was last looked for.
    leads_to: Option<Location>,
}

/// How far writing got.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Flushed {
    All,
    Rest,
    /// Writing failed: nothing more goes out, ever.
    Broken,
}

impl Link {
    pub(crate) fn new(number: u32, connection: Connection) -> Arc<Self> {
        Arc::new(Self {
            number,
            state: Mutex::new(State {
                connection,
                writer: None,
                ending: None,
                leads_to: None,
            }),
            wake: Notify::new(),
            heard: Notify::new(),
            over: watch::Sender::new(false),
            begun: AtomicBool::new(false),
            suspect: AtomicBool::new(false),
            beside: Mutex::default(),
        })
    }

    /// Whether the task has begun, and will see to it that every parcel gets its conclusion.
    pub(crate) fn has_begun(&self) -> bool {
        self.begun.load(Ordering::Acquire)
    }

    /// The socket is connected.
    pub(crate) fn connected(&self, now: Instant) {
        self.state.lock().connection.connected(now);
    }

    /// The peer has introduced itself. The suspect connections that this one was opened beside, and on
    /// which still nothing has come, end: what waits in their sockets would arrive late or not at all.
    pub(crate) fn replace_suspects(&self) {
        for other in std::mem::take(&mut *self.beside.lock()) {
            if other.is_suspect() {
                other.leave(End::Silent);
            }
        }
    }

    /// This connection is to be opened beside suspect ones with the same peer.
    pub(crate) fn opened_beside(&self, others: Vec<Arc<Self>>) {
        *self.beside.lock() = others;
    }

    /// Whether letters are to take another connection, if they can.
    pub(crate) fn is_suspect(&self) -> bool {
        self.suspect.load(Ordering::Acquire)
    }

    fn note_suspicion(&self, state: &State) {
        self.suspect
            .store(state.connection.is_suspect(), Ordering::Release);
    }

    /// The peer has proved this, before its hello.
    fn proved(&self, proof: &Proof) {
        self.state.lock().connection.proved(proof.clone());
    }

    /// Takes a parcel for sending, and writes what the kernel takes at once.
    pub(crate) fn send(&self, attempt: AttemptId, parcel: &Parcel) -> Result<(), SendError> {
        let mut state = self.state.lock();
        state.connection.send(attempt, parcel)?;
        self.flush(&mut state);
        Ok(())
    }

    /// Ends an attempt. A peer that has not answered in time is asked for a sign of life.
    pub(crate) fn abandon(&self, attempt: AttemptId) -> Abandoned {
        let mut state = self.state.lock();
        let end = state.connection.abandon(attempt, Instant::now());
        self.note_suspicion(&state);
        if state.connection.is_suspect() && self.has_begun() {
            self.flush(&mut state);
            self.wake.notify_one();
        }
        end
    }

    /// Answers a parcel that arrived on this link, by its number.
    pub(crate) fn answer(&self, id: u64, answer: &Answer) {
        let mut state = self.state.lock();
        state.connection.answer(id, answer, Instant::now());
        self.flush(&mut state);
    }

    /// The peer is looked for at a location that this connection was not opened for. When the peer
    /// did not list that address it may have moved there, so the connection is in doubt.
    pub(crate) fn is_used_for(&self, to: &Location) {
        let mut state = self.state.lock();
        if state.leads_to.as_ref() == Some(to) {
            return;
        }
        let peer = state.connection.peer();
        let listed = peer.is_some_and(|peer| peer.listening.iter().any(|it| it == to.address()));
        let quiet = state.connection.doubt_patience();
        if listed || state.connection.doubt(Instant::now(), quiet) {
            state.leads_to = Some(to.clone());
        }
        if !listed {
            self.flush(&mut state);
            self.wake.notify_one();
        }
    }

    /// Another connection with the same service comes from another address.
    pub(crate) fn doubt(&self) {
        let mut state = self.state.lock();
        state.connection.suspect(Instant::now());
        self.note_suspicion(&state);
        self.flush(&mut state);
        self.wake.notify_one();
    }

    /// Asks the peer for a sign of life.
    pub(crate) fn ask(&self) {
        let mut state = self.state.lock();
        state.connection.ask();
        self.flush(&mut state);
    }

    /// Returns whether the peer that was asked at this time gives a sign of life within `patience`.
    pub(crate) async fn answers(&self, asked: Instant, patience: Duration) -> bool {
        let due = tokio::time::Instant::from_std(asked + patience);
        loop {
            let heard = self.heard.notified();
            tokio::pin!(heard);
            heard.as_mut().enable();
            if self.state.lock().connection.is_heard_since(asked) {
                return true;
            }
            tokio::select! {
                () = heard => {}
                () = self.over() => return false,
                () = sleep_until(due) => return false,
            }
        }
    }

    /// Asks the task to end the connection.
    pub(crate) fn leave(&self, end: End) {
        self.state.lock().ending.get_or_insert(end);
        self.wake.notify_one();
    }

    /// The address of this host that the connection stays with; see [`Writing::local_ip`].
    #[cfg(feature = "ip")]
    pub(crate) fn local_ip(&self) -> Option<IpAddr> {
        self.state.lock().writer.as_ref()?.local_ip()
    }

    /// Waits until somebody asks for the end.
    pub(crate) async fn leaving(&self) -> End {
        loop {
            if let Some(end) = self.state.lock().ending.clone() {
                return end;
            }
            self.wake.notified().await;
        }
    }

    /// Why the task is to end the connection, if it is.
    #[cfg(all(test, feature = "ip"))]
    pub(crate) fn ending(&self) -> Option<End> {
        self.state.lock().ending.clone()
    }

    /// The peer says hello.
    #[cfg(all(test, feature = "ip"))]
    pub(crate) fn greeted_by(&self, hello: crate::hello::Hello) {
        use super::frame::Frame;
        let mut state = self.state.lock();
        let greeted = state
            .connection
            .handle_frame(Frame::Hello(hello), Instant::now());
        assert_eq!(greeted, Ok(()));
        state.connection.welcome();
        drop(state);
        self.replace_suspects();
    }

    /// The task has ended.
    #[cfg(all(test, feature = "ip"))]
    pub(crate) fn is_over(&self) {
        self.over.send_replace(true);
    }

    /// Waits until the last parcel of this connection has been handed to the sink.
    pub(crate) async fn over(&self) {
        // The sender lives in self: an error is impossible, and would mean the same.
        let _ = self.over.subscribe().wait_for(|over| *over).await;
    }

    /// Whether the peer may send this.
    ///
    /// # Errors
    /// Why not.
    fn admits(&self, parcel: &Parcel) -> Result<(), String> {
        let Body::Letter(letter) = &parcel.body else {
            return Ok(());
        };
        self.state.lock().connection.admits(letter)
    }

    /// The endpoint's number for an arrival on this link.
    fn ticket(&self, id: u64) -> Ticket {
        Ticket(u64::from(self.number) * MAX_ID + id)
    }

    /// Writes what the kernel takes, and sees to it that the task writes the rest.
    fn flush(&self, state: &mut State) {
        if state.flush() != Flushed::All {
            self.wake.notify_one();
        }
    }
}

/// The link's number and the parcel's number in a ticket.
pub(crate) fn of_ticket(ticket: Ticket) -> (u32, u64) {
    let number = u32::try_from(ticket.0 / MAX_ID).unwrap_or(u32::MAX);
    (number, ticket.0 % MAX_ID)
}

impl State {
    fn flush(&mut self) -> Flushed {
        let Some(writer) = &self.writer else {
            return Flushed::All;
        };
        let mut burst = 0;
        while !self.connection.is_flushed() {
            if burst >= MAX_BURST {
                return Flushed::Rest;
            }
            let mut slices = [IoSlice::new(&[]); MAX_SLICES];
            let count = self.connection.gather(&mut slices);
            match writer.try_write(&slices[..count]) {
                Ok(0) => {
                    return self.broken("the system takes no more bytes");
                }
                Ok(taken) => {
                    burst += taken;
                    self.connection.written(taken, Instant::now());
                }
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => return Flushed::Rest,
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return self.broken(error),
            }
        }
        match writer.try_finish() {
            Ok(()) => Flushed::All,
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => Flushed::Rest,
            Err(error) => self.broken(error),
        }
    }

    fn broken(&mut self, why: impl ToString) -> Flushed {
        let why = why.to_string();
        self.ending.get_or_insert(End::Broken(why));
        Flushed::Broken
    }
}

/// What the task of a link needs beside the link.
pub(crate) struct Running {
    endpoint: Arc<Endpoint>,
    link: Arc<Link>,
    sink: Arc<dyn Sink>,
    /// What this side opened the connection for, if it did.
    dialled: Option<Location>,
    /// Who is there, once the peer has said hello.
    peer: Option<Introduction>,
    /// What the peer may still send, if that is limited.
    ration: Option<Arc<Ration>>,
    /// Until when nothing is read, because it has sent more.
    paused: Option<Instant>,
    end: End,
}

impl Running {
    /// To be made by the task itself: from now on the link gets its end, whatever happens to the
    /// task.
    pub(crate) fn new(
        endpoint: Arc<Endpoint>,
        link: Arc<Link>,
        sink: Arc<dyn Sink>,
        dialled: Option<Location>,
    ) -> Self {
        link.begun.store(true, Ordering::Release);
        Self {
            endpoint,
            link,
            sink,
            dialled,
            peer: None,
            ration: None,
            paused: None,
            // What is said when the runtime drops the task.
            end: End::Closed,
        }
    }

    /// Where it belongs.
    #[cfg(feature = "secure")]
    pub(crate) fn endpoint(&self) -> &Endpoint {
        &self.endpoint
    }

    /// Ends a link whose socket could not be connected.
    pub(crate) fn fail(mut self, end: End) {
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
        let mut beside = read.take_beside();
        let writer = Arc::new(writer);
        self.link.proved(&proof);
        self.ration = self.endpoint.ration(from.home());
        let account = Account::of(from, proof.principal().as_ref());
        let _window = read.widen(|len| self.endpoint.window(&account, len));
        reader.count_with(self.endpoint.meter(&account));
        if let Some(letters) = beside.reader() {
            letters.count_with(self.endpoint.meter(&account));
        }
        self.link.state.lock().writer = Some(writer.clone());
        let mut greeted = Some(greeted);
        let exchange = self.exchange(
            (&mut read, &mut beside),
            &writer,
            &mut reader,
            from,
            &mut greeted,
        );
        let end = tokio::select! {
            end = exchange => end,
            end = proof.withdrawn() => end,
        };
        self.end = end;
        if self.end == End::Silent {
            writer.discard();
        }
        drop((writer, beside, reader));
        let (link, patience) = (self.link.clone(), self.endpoint.limits().handshake_timeout);
        let orderly = self.end.is_orderly();
        drop(self);
        if orderly {
            // A peer that does not hang up in time is left alone.
            let _ = timeout(patience, farewell(&link, read)).await;
        }
        link.state.lock().writer = None;
    }

    async fn exchange(
        &mut self,
        (read, beside): (&mut Reading, &mut Beside),
        writer: &Writing,
        reader: &mut FrameReader,
        from: Source,
        greeted: &mut Option<impl FnOnce() + Send>,
    ) -> End {
        let timer = sleep_until(Instant::now().into());
        tokio::pin!(timer);
        let (link, rooms) = (self.link.clone(), self.endpoint.rooms.clone());
        if let Err(end) = self.take_frames(reader, 0, false, from, greeted).await {
            return end;
        }
        loop {
            let freed = rooms.freed();
            tokio::pin!(freed);
            let mut blocked = (reader.is_blocked(), beside.is_blocked());
            if blocked != (false, false) {
                // Before the next look at whether there is room, so that none is missed.
                freed.as_mut().enable();
                let retried = self.retry((reader, beside), blocked, from, greeted).await;
                if let Err(end) = retried {
                    return end;
                }
                blocked = (reader.is_blocked(), beside.is_blocked());
            }
            let (flushed, due) = {
                let mut state = link.state.lock();
                state.connection.pause(blocked.0, Instant::now());
                link.note_suspicion(&state);
                let flushed = state.flush();
                self.endpoint
                    .tally()
                    .parcels_out
                    .fetch_add(state.connection.take_parcels_written(), Ordering::Relaxed);
                if let Some(end) = state.ending.clone() {
                    return end;
                }
                (flushed, state.connection.poll_timeout())
            };
            self.paused = self.paused.filter(|until| *until > Instant::now());
            let reads = self.paused.is_none();
            let due = [due, self.paused].into_iter().flatten().min();
            // Most of the time what is due moves away: then the timer is left to go off early.
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
                        Ok(0) => return End::Hangup,
                        Ok(bytes) => bytes,
                        Err(error) => return End::Broken(error.to_string()),
                    };
                    let other = beside.is_partial();
                    if let Err(end) = self.take_frames(reader, arrived, other, from, greeted).await {
                        return end;
                    }
                }
                // What the peer sends after its hello may overtake it.
                arrived = beside.read(), if reads && !blocked.1 && self.peer.is_some() => {
                    let arrived = match arrived {
                        Ok(bytes) => bytes,
                        Err(error) => return End::Nonsense(error.to_string()),
                    };
                    let other = reader.is_partial();
                    if let Some(letters) = beside.reader()
                        && let Err(end) = self.take_frames(letters, arrived, other, from, greeted).await
                    {
                        return end;
                    }
                }
                ready = writer.writable(), if flushed == Flushed::Rest => {
                    if let Err(error) = ready {
                        return End::Broken(error.to_string());
                    }
                }
                () = link.wake.notified() => {}
                () = &mut freed, if blocked != (false, false) => {}
                () = &mut timer => {
                    let least = reader.least_progress();
                    let least = least.max(beside.reader().map_or(0, |it| it.least_progress()));
                    let mut state = link.state.lock();
                    if let Err(end) = state.connection.handle_timeout(Instant::now(), least) {
                        return end;
                    }
                }
            }
        }
    }

    /// Tries again to get memory for the letters that wait for it.
    async fn retry(
        &mut self,
        (reader, beside): (&mut FrameReader, &mut Beside),
        blocked: (bool, bool),
        from: Source,
        greeted: &mut Option<impl FnOnce() + Send>,
    ) -> Result<(), End> {
        if blocked.0 {
            let other = beside.is_partial();
            self.take_frames(reader, 0, other, from, greeted).await?;
        }
        let other = reader.is_partial();
        match beside.reader() {
            Some(letters) if blocked.1 => self.take_frames(letters, 0, other, from, greeted).await,
            _ => Ok(()),
        }
    }

    /// Hands on what has arrived in whole frames, and answers. `other_partial` is whether a frame is
    /// half arrived elsewhere on this link.
    async fn take_frames(
        &mut self,
        reader: &mut FrameReader,
        arrived: usize,
        other_partial: bool,
        from: Source,
        greeted: &mut Option<impl FnOnce() + Send>,
    ) -> Result<(), End> {
        let now = Instant::now();
        let link = self.link.clone();
        reader.put(arrived);
        let mut letters = 0;
        loop {
            let frame = reader.next(|arriving| self.place_for(arriving));
            let frame = frame.map_err(|e| End::Nonsense(e.to_string()))?;
            let Some(frame) = frame else { break };
            let events: [Option<Event>; 2];
            {
                let mut state = link.state.lock();
                if let Some(end) = state.ending.clone() {
                    return Err(end);
                }
                state.connection.handle_frame(frame, now)?;
                events = [state.connection.poll_event(), state.connection.poll_event()];
            }
            for event in events.into_iter().flatten() {
                letters += u64::from(matches!(event, Event::Arrived { .. }));
                self.handle_event(event, from, greeted).await?;
            }
            loop {
                // Rare: a hello that makes many waiting letters too large.
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
        if let Some(ration) = &self.ration {
            let until = ration.spend(letters, arrived, now);
            if self.paused.is_none() && until.is_some() {
                count(&self.endpoint.tally().held_back);
            }
            self.paused = self.paused.max(until);
        }
        let mut state = link.state.lock();
        let partial = reader.is_partial() || other_partial;
        // A letter that waits for memory is no sign of life.
        if arrived > 0 || !reader.is_blocked() {
            state.connection.received(arrived, partial, now);
            link.note_suspicion(&state);
        }
        drop(state);
        if arrived > 0 {
            link.heard.notify_waiters();
        }
        Ok(())
    }

    /// Where the content goes that a peer has announced who has introduced himself.
    fn place_for(&self, arriving: &Arriving<'_>) -> Option<Place> {
        self.peer.as_ref()?;
        let most = self.endpoint.limits().max_arriving;
        let loan = self.endpoint.rooms.lend(arriving.len, most)?;
        let memory = self.sink.memory_for(arriving)?;
        Some(Place::new(memory, loan))
    }

    async fn handle_event(
        &mut self,
        event: Event,
        from: Source,
        greeted: &mut Option<impl FnOnce() + Send>,
    ) -> Result<(), End> {
        match event {
            Event::Greeted => {
                let (peer, proved, mandate) = {
                    let connection = &self.link.state.lock().connection;
                    let proved = connection.proved_principal();
                    (connection.peer().cloned(), proved, connection.mandate())
                };
                if let Some(peer) = peer {
                    let entered = self.endpoint.enter(&self.link, &peer, proved, from).await;
                    if let Err(End::NotSought) = entered {
                        // The hello tells the peer which service is here.
                        self.link.state.lock().connection.welcome();
                    }
                    let hop = entered?;
                    let introduction = Introduction {
                        name: peer.identity.name.into(),
                        hop,
                        dialled: self.dialled.clone(),
                        mandate,
                    };
                    if !self.sink.accepts(&introduction) {
                        return Err(End::Impostor("another certificate belongs to this service"));
                    }
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
                    return Err(End::Nonsense("a parcel from nobody".into()));
                };
                if let Err(refused) = self.link.admits(&parcel) {
                    let before = &self.endpoint.tally().refused_senders;
                    let before = before.fetch_add(1, Ordering::Relaxed);
                    warn_seldom(before, format_args!("{from}: letter refused: {refused}"));
                    self.link
                        .answer(id, &Answer::failed(FailureReason::Refused, &refused));
                    return Ok(());
                }
                let from = peer.hop.clone();
                let ticket = self.link.ticket(id);
                let verdict = self.sink.arrived(fipa_transport::Arrival {
                    parcel: *parcel,
                    from,
                    ticket,
                });
                if let fipa_transport::Verdict::Now(answer) = verdict {
                    let mut state = self.link.state.lock();
                    state.connection.answer(id, &answer, Instant::now());
                }
            }
            Event::Concluded(attempt, conclusion) => self.sink.concluded(attempt, conclusion),
        }
        Ok(())
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let concluded = {
            let mut state = self.link.state.lock();
            let written = state.connection.take_parcels_written();
            self.endpoint
                .tally()
                .parcels_out
                .fetch_add(written, Ordering::Relaxed);
            if !self.end.is_orderly() {
                state.writer = None;
            }
            state.connection.end(&self.end)
        };
        self.endpoint.left(&self.link, &self.end);
        for (attempt, conclusion) in concluded {
            self.sink.concluded(attempt, conclusion);
        }
        if let Some(peer) = &self.peer {
            self.sink.parted(peer);
        }
        self.link.over.send_replace(true);
    }
}

/// Writes what is left, closes this direction, and waits for the peer to close the other: closing
/// while bytes of the peer are unread would destroy what is on its way to it.
async fn farewell(link: &Link, mut read: Reading) {
    loop {
        let writer = {
            let mut state = link.state.lock();
            let flushed = state.flush();
            match (flushed, &state.writer) {
                (Flushed::Rest, Some(writer)) => writer.clone(),
                // The socket of one that is broken counts as writable: waiting would be no waiting.
                (Flushed::Broken, _) => return,
                _ => break,
            }
        };
        if writer.writable().await.is_err() {
            return;
        }
    }
    link.state.lock().writer = None;
    read.drain().await;
}
