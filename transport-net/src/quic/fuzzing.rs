//! The streams of a QUIC connection for a fuzz target: the task of a link reads any bytes of an
//! introduced or unknown peer, on any streams and with any ends. There is no socket and no time passes.
//!
//! The task chooses at random among the streams that have bytes, as it does on a socket.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::fmt;
use std::io::{self, IoSlice};
use std::net::IpAddr;
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, LazyLock};
use std::task::{Context, Poll, Wake, Waker};

use bytes::{Bytes, BytesMut};
use fipa_acl::Letter;
use fipa_transport::{
    Abandoned, Answer, Arrival, Arriving, AttemptId, Body, Conclusion, Incarnation, Introduction,
    Kind, LegacySource, LoanedContent, Parcel, Reaction, Sink, Ticket,
};
use parking_lot::Mutex;
use quinn::{ConnectionError, ReadError, VarInt};
use tokio::runtime::{Builder, Runtime};

use super::streams::{Letters, PeerStream, PeerStreams};
use crate::NetLimits;
use crate::stream::config::StreamConfig;
use crate::stream::endpoint::Endpoint;
use crate::stream::frame::{FrameReader, Space};
use crate::stream::fuzzing::{Memory, identity};
use crate::stream::link::{Link, LinkTask};
use crate::stream::proof::Proof;
use crate::stream::source::Source;
use crate::stream::wire::{BoxFuture, ControlStream, Reading, StreamWriter, Writing};

const MAX_LETTER: usize = 100_000;
const MAX_IN_FLIGHT: usize = 8;

/// Memory of arriving letters: not enough for two of the largest.
const MAX_INCOMING: usize = 150_000;

/// Maximum number of polls after an event. Each poll reads all bytes that have arrived, so a task that
/// is polled more often makes no progress.
const MAX_POLLS: usize = 10_000;

/// Incarnation of the end that reads.
const OWN: u64 = 1;

/// Provides timers, none of which fires.
static RUNTIME: LazyLock<Runtime> = LazyLock::new(|| {
    let mut builder = Builder::new_current_thread();
    builder.enable_time().build().expect("a runtime")
});

/// One end of a QUIC connection, whose peer is the fuzzer.
pub struct QuicStreams {
    wire: Arc<Mutex<Wire>>,
    sink: Arc<Recorder>,
    endpoint: Arc<Endpoint>,
    link: Arc<Link>,
    task: Option<Pin<Box<dyn Future<Output = ()> + Send>>>,
    dispatched: u64,
    abandoned: BTreeSet<AttemptId>,
}

/// The bytes on their way between the peer and the task.
#[derive(Debug, Default)]
struct Wire {
    control: Arrived,
    /// In the order of opening.
    letters: Vec<Arrived>,
    accepted: usize,
    /// Number of bytes that the task may write.
    room: usize,
    is_lost: bool,
}

/// The bytes of one stream that have arrived and are not read.
#[derive(Debug, Default)]
struct Arrived {
    bytes: VecDeque<u8>,
    end: Option<End>,
}

#[derive(Debug, Clone, Copy)]
enum End {
    Finished,
    Reset,
}

impl Arrived {
    /// Returns the next bytes. `None` while none have arrived.
    fn take(&mut self, most: usize) -> Option<Result<Option<Bytes>, ReadError>> {
        assert!(most > 0, "a full buffer reads as the end of the stream");
        // A reset discards the bytes that have not been read.
        if matches!(self.end, Some(End::Reset)) {
            return Some(Err(ReadError::Reset(VarInt::from_u32(0))));
        }
        if self.bytes.is_empty() {
            return self.end.map(|_finished| Ok(None));
        }
        let len = most.min(self.bytes.len());
        Some(Ok(Some(self.bytes.drain(..len).collect())))
    }
}

/// Is pending until `take` returns a value. The task is polled after each event of the peer.
async fn when<T>(mut take: impl FnMut() -> Option<T>) -> T {
    std::future::poll_fn(|_| take().map_or(Poll::Pending, Poll::Ready)).await
}

struct FakeConnection {
    wire: Arc<Mutex<Wire>>,
    sink: Arc<Recorder>,
}

impl PeerStreams for FakeConnection {
    type Stream = FakeStream;

    async fn accept(&self) -> Result<FakeStream, ConnectionError> {
        let number = when(|| {
            let mut wire = self.wire.lock();
            if wire.is_lost {
                return Some(Err(ConnectionError::TimedOut));
            }
            (wire.accepted < wire.letters.len()).then(|| {
                wire.accepted += 1;
                Ok(wire.accepted - 1)
            })
        })
        .await?;
        assert!(
            self.sink.state.lock().is_introduced,
            "a letter is read before the hello"
        );
        Ok(FakeStream {
            wire: Arc::clone(&self.wire),
            number,
        })
    }
}

struct FakeStream {
    wire: Arc<Mutex<Wire>>,
    number: usize,
}

impl PeerStream for FakeStream {
    async fn next(&mut self, most: usize) -> Result<Option<Bytes>, ReadError> {
        when(|| {
            let mut wire = self.wire.lock();
            assert_eq!(self.number + 1, wire.accepted, "streams are read in order");
            if wire.is_lost {
                return Some(Err(ReadError::ConnectionLost(ConnectionError::TimedOut)));
            }
            wire.letters[self.number].take(most)
        })
        .await
    }
}

struct FakeControl(Arc<Mutex<Wire>>);

impl ControlStream for FakeControl {
    fn read<'a>(&'a mut self, space: &'a mut Space<'_>) -> BoxFuture<'a, io::Result<usize>> {
        Box::pin(async {
            let most = space.room();
            let bytes = when(|| {
                let mut wire = self.0.lock();
                if wire.is_lost {
                    return Some(Err(ReadError::ConnectionLost(ConnectionError::TimedOut)));
                }
                wire.control.take(most)
            });
            match bytes.await? {
                Some(bytes) => Ok(space.fill(&bytes)),
                None => Ok(0),
            }
        })
    }

    fn extra_window(&self) -> usize {
        super::settings::WIDENING
    }

    fn widen(&self) {}

    fn drain(&mut self) -> BoxFuture<'_, ()> {
        Box::pin(std::future::ready(()))
    }
}

#[derive(Debug)]
struct FakeWriter(Arc<Mutex<Wire>>);

impl StreamWriter for FakeWriter {
    fn local_ip(&self) -> Option<IpAddr> {
        None
    }

    fn write(&self, slices: &[IoSlice<'_>]) -> io::Result<usize> {
        let mut wire = self.0.lock();
        let len: usize = slices.iter().map(|slice| slice.len()).sum();
        let taken = len.min(wire.room);
        wire.room -= taken;
        match taken {
            0 if len > 0 => Err(io::ErrorKind::WouldBlock.into()),
            _ => Ok(taken),
        }
    }

    fn writable(&self) -> BoxFuture<'_, io::Result<()>> {
        Box::pin(when(|| (self.0.lock().room > 0).then_some(Ok(()))))
    }
}

/// Checks the calls of the task.
#[derive(Default)]
struct Recorder {
    state: Mutex<Recorded>,
}

#[derive(Default)]
struct Recorded {
    /// Whether the sink accepts the peer.
    refuses: bool,
    /// Whether the sink lends memory for large contents.
    lends: bool,
    /// Whether parcels are answered at once.
    answers: bool,
    is_introduced: bool,
    has_parted: bool,
    last_ticket: Option<Ticket>,
    open: Vec<Ticket>,
    concluded: BTreeMap<AttemptId, Conclusion>,
}

impl Sink for Recorder {
    fn arrived(&self, arrival: Arrival) -> Reaction {
        let mut state = self.state.lock();
        assert!(state.is_introduced && !state.has_parted);
        if let Body::Letter(letter) = &arrival.parcel.body {
            assert!(letter.len() <= MAX_LETTER);
        }
        let ticket = arrival.ticket.expect("a stream has slots of its own");
        let last = state.last_ticket.replace(ticket);
        assert!(last.is_none_or(|last| last.0 < ticket.0), "in order");
        if state.answers {
            return Reaction::Now(Answer::Accepted);
        }
        state.open.push(ticket);
        assert!(state.open.len() <= MAX_IN_FLIGHT);
        Reaction::Later
    }

    fn arrived_unframed(&self, _: Letter, _: Kind, _: LegacySource) {
        panic!("a QUIC connection carries no letters of legacy peers");
    }

    fn concluded(&self, attempt: AttemptId, conclusion: Conclusion) {
        let twice = self.state.lock().concluded.insert(attempt, conclusion);
        assert_eq!(twice, None, "{attempt:?} is concluded twice");
    }

    fn memory_for(&self, arriving: &Arriving<'_>) -> Option<Box<dyn LoanedContent>> {
        let state = self.state.lock();
        assert!(state.is_introduced);
        assert!(arriving.len <= MAX_LETTER * 2, "much memory is asked for");
        let memory = || Box::new(Memory(vec![0; arriving.len])) as Box<dyn LoanedContent>;
        state.lends.then(memory)
    }

    fn accepts(&self, peer: &Introduction) -> bool {
        assert_ne!(peer.hop.location.incarnation(), Incarnation::from_u64(OWN));
        !self.state.lock().refuses
    }

    fn introduced(&self, _: &Introduction) {
        let mut state = self.state.lock();
        assert!(!state.refuses && !state.is_introduced);
        state.is_introduced = true;
    }

    fn disconnected(&self, _: &Introduction) {
        let mut state = self.state.lock();
        assert!(state.is_introduced && !state.has_parted);
        state.has_parted = true;
    }
}

/// Whether the task has been woken.
#[derive(Default)]
struct Woken(AtomicBool);

impl Wake for Woken {
    fn wake(self: Arc<Self>) {
        self.0.store(true, Ordering::Relaxed);
    }
}

impl fmt::Debug for QuicStreams {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("QuicStreams")
            .field("wire", &self.wire)
            .field("dispatched", &self.dispatched)
            .finish_non_exhaustive()
    }
}

impl QuicStreams {
    /// Accepts a connection of the peer. The sink may refuse the peer, lend memory for large contents, and
    /// answer parcels at once.
    #[must_use]
    pub fn new(refuses: bool, lends: bool, answers: bool) -> Self {
        let limits = NetLimits {
            max_letter: MAX_LETTER,
            max_in_flight: MAX_IN_FLIGHT,
            max_incoming: MAX_INCOMING,
            max_incoming_per_source: MAX_INCOMING,
            ..NetLimits::default()
        };
        let identity = identity(OWN);
        let config = StreamConfig::new(identity, limits);
        let endpoint = Endpoint::new(Kind::Quic, config, RUNTIME.handle().clone());
        let sink = Arc::new(Recorder {
            state: Mutex::new(Recorded {
                refuses,
                lends,
                answers,
                ..Recorded::default()
            }),
        });
        let open = || Ok(((), "192.0.2.1:7788".to_owned()));
        let accept = |()| RUNTIME.spawn(async {});
        endpoint
            .listen_at(sink.clone(), open, accept)
            .expect("an endpoint without a socket");
        let (link, taken) = endpoint.accepted().expect("the endpoint is open");
        let wire = Arc::new(Mutex::new(Wire {
            room: usize::MAX,
            ..Wire::default()
        }));
        let letters = Letters::new(
            FakeConnection {
                wire: Arc::clone(&wire),
                sink: sink.clone(),
            },
            MAX_LETTER,
        );
        let reading = Reading::Streams(
            Box::new(FakeControl(Arc::clone(&wire))),
            Some(Box::new(letters)),
        );
        let writing = Writing::Streams(Box::new(FakeWriter(Arc::clone(&wire))));
        let task = LinkTask::new(Arc::clone(&endpoint), link.clone(), taken, None);
        let reader = FrameReader::new(MAX_LETTER, BytesMut::new());
        let from = Source::Address(([192, 0, 2, 7], 7788).into());
        let task = async move {
            let ends = (reading, writing);
            task.serve(ends, Proof::default(), reader, from, || {})
                .await;
        };
        let mut end = Self {
            wire,
            sink,
            endpoint,
            link,
            task: Some(Box::pin(task)),
            dispatched: 0,
            abandoned: BTreeSet::new(),
        };
        end.poll();
        end
    }

    /// Whether the connection has ended.
    #[must_use]
    pub fn has_ended(&self) -> bool {
        self.task.is_none()
    }

    /// The peer sends bytes on the stream of hello, answers, pings and goodbye.
    pub fn control(&mut self, bytes: &[u8]) {
        let mut wire = self.wire.lock();
        if wire.control.end.is_none() {
            wire.control.bytes.extend(bytes);
        }
        drop(wire);
        self.poll();
    }

    /// The peer opens a stream for a parcel.
    pub fn open(&mut self) {
        self.wire.lock().letters.push(Arrived::default());
        self.poll();
    }

    /// The peer sends bytes on one of the streams for parcels; `usize::MAX` is the latest one.
    pub fn letter(&mut self, pick: usize, bytes: &[u8]) {
        self.of_letter(pick, |stream| stream.bytes.extend(bytes));
    }

    /// The peer finishes or resets one of the streams for parcels.
    pub fn end_letter(&mut self, pick: usize, is_reset: bool) {
        let end = match is_reset {
            true => End::Reset,
            false => End::Finished,
        };
        self.of_letter(pick, |stream| stream.end = Some(end));
    }

    fn of_letter(&mut self, pick: usize, change: impl FnOnce(&mut Arrived)) {
        let mut wire = self.wire.lock();
        let count = wire.letters.len().max(1);
        let number = match pick {
            usize::MAX => count - 1,
            pick => pick % count,
        };
        if let Some(stream) = wire.letters.get_mut(number)
            && stream.end.is_none()
        {
            change(stream);
        }
        drop(wire);
        self.poll();
    }

    /// The peer finishes or resets the stream of all other frames.
    pub fn end_control(&mut self, is_reset: bool) {
        let end = match is_reset {
            true => End::Reset,
            false => End::Finished,
        };
        self.wire.lock().control.end.get_or_insert(end);
        self.poll();
    }

    /// The connection is lost.
    pub fn lose(&mut self) {
        self.wire.lock().is_lost = true;
        self.poll();
    }

    /// Sets the number of bytes that this end can write.
    pub fn room(&mut self, room: usize) {
        self.wire.lock().room = room;
        self.poll();
    }

    /// Sends a parcel.
    pub fn send(&mut self, parcel: &Parcel) {
        let attempt = AttemptId(self.dispatched);
        if self.link.send(attempt, parcel, None).is_ok() {
            self.dispatched += 1;
        }
        self.poll();
    }

    /// Abandons one of the attempts.
    pub fn abandon(&mut self, pick: u64) {
        let attempt = AttemptId(pick % self.dispatched.max(1));
        let is_open = attempt.0 < self.dispatched
            && !self.sink.state.lock().concluded.contains_key(&attempt)
            && self.abandoned.insert(attempt);
        let abandoned = self.link.abandon(attempt);
        assert!(is_open || abandoned.is_none_or(|it| it == Abandoned::Unconfirmed));
        self.poll();
    }

    /// Answers one of the parcels that arrived.
    pub fn answer(&mut self, pick: usize, answer: &Answer) {
        let ticket = {
            let mut state = self.sink.state.lock();
            let count = state.open.len();
            (count > 0).then(|| state.open.swap_remove(pick % count))
        };
        if let Some(ticket) = ticket {
            self.endpoint.answer(ticket, answer);
        }
        self.poll();
    }

    /// Ends the connection and checks that every attempt has a conclusion.
    pub fn close(&mut self) {
        self.room(usize::MAX);
        self.lose();
        assert!(self.has_ended(), "a lost connection ends");
        // Runs the task that stands for the listener.
        RUNTIME.block_on(tokio::task::yield_now());
        let state = self.sink.state.lock();
        assert_eq!(state.is_introduced, state.has_parted);
        for attempt in (0..self.dispatched).map(AttemptId) {
            let known = state.concluded.contains_key(&attempt);
            let is_abandoned = self.abandoned.contains(&attempt);
            assert!(known || is_abandoned, "{attempt:?} has no conclusion");
        }
    }

    /// Polls the task until it waits.
    fn poll(&mut self) {
        let Some(task) = &mut self.task else { return };
        let _inside = RUNTIME.enter();
        let woken = Arc::new(Woken::default());
        let waker = Waker::from(Arc::clone(&woken));
        for _ in 0..MAX_POLLS {
            woken.0.store(false, Ordering::Relaxed);
            let polled = task.as_mut().poll(&mut Context::from_waker(&waker));
            if polled.is_ready() {
                self.task = None;
                return;
            }
            if !woken.0.load(Ordering::Relaxed) {
                return;
            }
        }
        panic!("the task is woken without end");
    }
}

#[cfg(test)]
mod tests {
    use fipa_transport::{Incarnation, Stream};

    use super::*;
    use crate::stream::fuzzing::{frame, hello_body, parcel_body};

    fn letter(number: u64) -> Vec<u8> {
        let parcel = Parcel {
            receiver: "arm".into(),
            stream: Stream::between(Incarnation::from_u64(7), Incarnation::from_u64(8)),
            sequence: number,
            after: number - 1,
            transfer: number,
            remaining: std::time::Duration::from_secs(5),
            body: Body::Letter(Letter::new(
                Bytes::from_static(b"e"),
                Bytes::from_static(b"m"),
            )),
        };
        frame(2, number, &parcel_body(&parcel))
    }

    /// A connection whose parcels are not answered, and whose peer sends its hello later.
    fn unknown() -> QuicStreams {
        QuicStreams::new(false, false, false)
    }

    fn introduced() -> QuicStreams {
        let mut end = unknown();
        end.control(&frame(1, 0, &hello_body(7, 4)));
        end
    }

    /// Returns the number of parcels that have arrived.
    fn arrived(end: &QuicStreams) -> usize {
        end.sink.state.lock().open.len()
    }

    #[test]
    fn letters_are_read_after_the_hello_in_the_order_of_their_streams() {
        let mut end = unknown();
        for _ in 0..3 {
            end.open();
        }
        for number in [2, 1, 0] {
            end.letter(number, &letter(number as u64 + 1));
            end.end_letter(number, false);
        }
        assert_eq!(arrived(&end), 0);
        end.control(&frame(1, 0, &hello_body(7, 4)));
        assert_eq!(arrived(&end), 3);
        end.close();
    }

    #[test]
    fn streams_without_bytes_are_skipped() {
        let mut end = introduced();
        for _ in 0..1000 {
            end.open();
            end.end_letter(usize::MAX, false);
        }
        end.open();
        end.letter(usize::MAX, &letter(1));
        assert_eq!((arrived(&end), end.has_ended()), (1, false));
        end.close();
    }

    #[test]
    fn a_stream_that_ends_within_a_letter_ends_the_connection() {
        for is_reset in [false, true] {
            let mut end = introduced();
            let whole = letter(1);
            end.open();
            end.letter(0, &whole[..whole.len() - 1]);
            assert!(!end.has_ended());
            end.end_letter(0, is_reset);
            assert!(end.has_ended());
            assert_eq!(arrived(&end), 0);
            end.close();
        }
    }

    #[test]
    fn a_second_hello_on_a_stream_of_a_parcel_ends_the_connection() {
        let mut end = introduced();
        end.open();
        end.letter(0, &frame(1, 0, &hello_body(9, 4)));
        assert!(end.has_ended());
        end.close();
    }
}
