//! One end of a framed stream for fuzz targets: takes any bytes of a peer, and checks the
//! invariants of the reader and the connection.

use std::collections::{BTreeMap, BTreeSet};
use std::io::IoSlice;
use std::time::Instant;

use bytes::{BufMut, Bytes, BytesMut};
use fipa_transport::{
    Abandoned, Answer, AttemptId, Conclusion, Incarnation, LoanedContent, Parcel,
};

use super::budget::{ByteBudget, ContentBuffer};
use super::config::NetLimits;
use super::connection::{Connection, Event, Reader, Role};
use super::frame::{self, FrameReader, Space};
use crate::Identity;
use crate::end::ConnectionEnd;
use crate::hello::{Hello, Load};

const MAX_LETTER: usize = 100_000;
const MAX_IN_FLIGHT: usize = 8;

/// One end of a framed stream, with a reader and a connection combined as for TCP, TLS, the Unix
/// socket and QUIC.
#[derive(Debug)]
pub struct Framed {
    connection: Connection,
    reader: FrameReader,
    /// Whether the owner of the connection lends memory for large contents.
    lends: bool,
    byte_budget: ByteBudget,
    /// Queued attempts, and those of which the kernel has taken bytes.
    dispatched: u64,
    concluded: BTreeMap<AttemptId, Conclusion>,
    abandoned: BTreeSet<AttemptId>,
    /// Parcels that arrived and are not answered yet.
    open: Vec<u64>,
    ended: bool,
}

/// Memory for large contents.
pub(crate) struct Memory(pub(crate) Vec<u8>);

impl LoanedContent for Memory {
    fn content_mut(&mut self) -> &mut [u8] {
        &mut self.0
    }

    fn freeze(self: Box<Self>) -> Bytes {
        self.0.into()
    }
}

pub(crate) fn identity(incarnation: u64) -> Identity {
    Identity {
        name: "fuzzed".into(),
        incarnation: Incarnation::from_u64(incarnation),
        domain: "default".into(),
        host: "here".into(),
    }
}

fn hello(incarnation: u64) -> Hello {
    Hello {
        identity: identity(incarnation),
        max_letter: MAX_LETTER as u64,
        max_in_flight: MAX_IN_FLIGHT as u32,
        serial: 1,
        dialed: String::new(),
        listening: vec!["192.0.2.1:7788".into()],
        load: Load::Any,
    }
}

/// Encodes a frame with this kind, number and body.
#[must_use]
pub fn frame(kind: u8, id: u64, body: &[u8]) -> Vec<u8> {
    let mut frame = frame::ping().to_vec();
    frame[5] = kind;
    frame[8..16].copy_from_slice(&id.to_le_bytes());
    frame[16..24].copy_from_slice(&(body.len() as u64).to_le_bytes());
    frame.extend_from_slice(body);
    frame
}

/// Encodes the body of a hello.
#[must_use]
pub fn hello_body(incarnation: u64, max_in_flight: u32) -> Vec<u8> {
    let hello = Hello {
        max_in_flight,
        ..hello(incarnation)
    };
    hello.encode().to_vec()
}

/// Encodes the body of an answer.
#[must_use]
pub fn answer_body(answer: &Answer) -> Vec<u8> {
    frame::answer(0, answer)[frame::HEADER_LEN..].to_vec()
}

/// Encodes the body of a frame with this parcel; empty when it cannot be encoded.
#[must_use]
pub fn parcel_body(parcel: &Parcel) -> Vec<u8> {
    match frame::parcel(0, parcel) {
        Ok(pieces) => pieces.concat().split_off(frame::HEADER_LEN),
        Err(_) => Vec::new(),
    }
}

impl Framed {
    /// Creates the end that opened the connection, expecting incarnation 7, or the other one.
    #[must_use]
    pub fn new(opened: bool, lends: bool, now: Instant) -> Self {
        let limits = NetLimits {
            max_letter: MAX_LETTER,
            max_in_flight: MAX_IN_FLIGHT,
            ..NetLimits::default()
        };
        let role = match opened {
            true => Role::Dialler {
                expected: Incarnation::from_u64(7),
            },
            false => Role::Acceptor,
        };
        let mut connection = Connection::new(limits, role, hello(1), now);
        if opened {
            connection.connected(now);
        }
        Self {
            connection,
            reader: FrameReader::new(MAX_LETTER, BytesMut::new()),
            lends,
            byte_budget: ByteBudget::default(),
            dispatched: 0,
            concluded: BTreeMap::new(),
            abandoned: BTreeSet::new(),
            open: Vec::new(),
            ended: false,
        }
    }

    /// Whether the connection has ended.
    #[must_use]
    pub fn has_ended(&self) -> bool {
        self.ended
    }

    /// Handles bytes of the peer, at most `step` at a time.
    pub fn arrive(&mut self, mut bytes: &[u8], step: usize, now: Instant) {
        while !bytes.is_empty() && !self.ended {
            let mut space = self.reader.space();
            let taken = match &mut space {
                Space::Buffer(buffer) => {
                    let taken = step.max(1).min(bytes.len()).min(buffer.remaining_mut());
                    buffer.put_slice(&bytes[..taken]);
                    taken
                }
                Space::Content(content) => {
                    let taken = step.max(1).min(bytes.len()).min(content.len());
                    content[..taken].copy_from_slice(&bytes[..taken]);
                    taken
                }
            };
            assert!(taken > 0, "a full buffer reads as the end of the stream");
            self.reader.put(taken);
            bytes = &bytes[taken..];
            self.take_frames(now);
            if !self.ended {
                let partial = self.reader.is_partial();
                self.connection.received(Reader::Main, taken, partial, now);
            }
        }
    }

    fn take_frames(&mut self, now: Instant) {
        let (lends, byte_budget) = (self.lends, self.byte_budget.clone());
        loop {
            let memory = |arriving: &fipa_transport::Arriving<'_>| {
                assert!(arriving.len <= MAX_LETTER * 2, "much memory is asked for");
                let loan = byte_budget.lend(arriving.len, 1 << 20).filter(|_| lends)?;
                Some(ContentBuffer::new(
                    Box::new(Memory(vec![0; arriving.len])),
                    loan,
                ))
            };
            let end = match self.reader.next(memory) {
                Ok(Some(frame)) => self.connection.handle_frame(frame, now).err(),
                Ok(None) => return,
                Err(error) => Some(ConnectionEnd::ProtocolViolation(error.to_string())),
            };
            self.take_events();
            if let Some(end) = end {
                return self.end(&end);
            }
        }
    }

    fn take_events(&mut self) {
        while let Some(event) = self.connection.poll_event() {
            match event {
                Event::Greeted => {
                    let peer = self.connection.peer().map(|it| it.identity.incarnation);
                    assert_ne!(
                        peer,
                        Some(Incarnation::from_u64(1)),
                        "it is this end itself"
                    );
                    self.connection.welcome();
                }
                Event::Arrived { id, .. } => {
                    assert!(!self.open.contains(&id), "parcel {id} arrives twice");
                    self.open.push(id);
                    assert!(self.open.len() <= MAX_IN_FLIGHT);
                }
                Event::Concluded(attempt, conclusion) => self.conclude(attempt, conclusion),
            }
        }
    }

    fn conclude(&mut self, attempt: AttemptId, conclusion: Conclusion) {
        assert!(attempt.0 < self.dispatched, "{attempt:?} was never sent");
        assert!(!self.abandoned.contains(&attempt));
        let twice = self.concluded.insert(attempt, conclusion);
        assert_eq!(twice, None, "{attempt:?} is concluded twice");
    }

    /// Sends a parcel.
    pub fn send(&mut self, parcel: &Parcel) {
        let attempt = AttemptId(self.dispatched);
        if self.connection.send(attempt, parcel).is_ok() {
            self.dispatched += 1;
        }
    }

    /// Abandons one of the attempts.
    pub fn abandon(&mut self, pick: u64, now: Instant) {
        let attempt = AttemptId(pick % self.dispatched.max(1));
        let is_open = attempt.0 < self.dispatched
            && !self.concluded.contains_key(&attempt)
            && self.abandoned.insert(attempt);
        let abandoned = self.connection.abandon(attempt, now);
        assert!(is_open || abandoned.is_none_or(|it| it == Abandoned::Unconfirmed));
    }

    /// Answers one of the parcels that arrived.
    pub fn answer(&mut self, pick: usize, answer: &Answer, now: Instant) {
        if !self.open.is_empty() {
            let id = self.open.swap_remove(pick % self.open.len());
            self.connection.answer(id, answer, now);
        }
    }

    /// Writes up to `max` bytes.
    pub fn transmit(&mut self, max: usize, now: Instant) {
        let mut slices = [IoSlice::new(&[]); 16];
        let count = self.connection.gather(&mut slices);
        let shown: usize = slices[..count].iter().map(|it| it.len()).sum();
        self.connection.written(shown.min(max), now);
    }

    /// Handles the timers that are due.
    pub fn timeout(&mut self, now: Instant) {
        if self.ended || self.connection.poll_timeout().is_none_or(|due| now < due) {
            return;
        }
        let least = self.reader.least_progress();
        if let Err(end) = self.connection.handle_timeout(now, [least, 0]) {
            self.end(&end);
        }
    }

    /// Ends the connection and checks that every attempt has a conclusion.
    pub fn close(&mut self) {
        self.end(&ConnectionEnd::Closed);
        for attempt in (0..self.dispatched).map(AttemptId) {
            let known = self.concluded.contains_key(&attempt);
            assert!(known || self.abandoned.contains(&attempt), "{attempt:?}");
        }
    }

    fn end(&mut self, end: &ConnectionEnd) {
        self.ended = true;
        for (attempt, conclusion) in self.connection.end(end) {
            assert!(!matches!(conclusion, Conclusion::Answered(_)));
            self.conclude(attempt, conclusion);
        }
        self.open.clear();
    }
}
