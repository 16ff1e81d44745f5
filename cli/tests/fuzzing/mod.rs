//! Input for a gateway under test: valid conversations, and seeded random mutations of them.

#![allow(dead_code, reason = "not every test uses all of it")]
#![allow(clippy::unwrap_used, reason = "a test that cannot go on ends")]

pub(crate) mod datagram;
pub(crate) mod stream;
pub(crate) mod trusted;

use std::time::Duration;

use fastrand::Rng;
use fipa::{AgentId, Message, Performative};
use fipa_acl::{AclRepresentation, Envelope, EnvelopeParams, Letter};
use fipa_testbed::frame;
use fipa_transport::wire::ParcelHeader;
use fipa_transport::{Body, FailureReason, Incarnation, Outcome, Parcel, Report, Stream};

/// Recorded letters of legacy peers: a fipa_services peer in its own dialect, and in JADE's.
const LEGACY_PEERS: [&[u8]; 2] = [
    include_bytes!("../../../transport-net/tests/data/tcp_letter.bin"),
    include_bytes!("../../../transport-net/tests/data/tcp_letter_jade.bin"),
];

/// Recorded requests of JADE, in each encoding of messages.
const REQUESTS: [&[u8]; 3] = [
    include_bytes!("../../../transport-net/tests/data/jade_http/string.3-echo-reply-from-jade.bin"),
    include_bytes!("../../../transport-net/tests/data/jade_http/xml.3-echo-reply-from-jade.bin"),
    include_bytes!(
        "../../../transport-net/tests/data/jade_http/bitefficient.3-echo-reply-from-jade.bin"
    ),
];

/// Values at the limits of lengths and counters.
const EDGES: [u64; 14] = [
    0,
    1,
    0x7f,
    0xff,
    0x7fff,
    0xffff,
    0x1_0000,
    0x7fff_ffff,
    0xffff_ffff,
    (64 << 20) - 1,
    (64 << 20) + 1,
    1 << 40,
    i64::MAX as u64,
    u64::MAX,
];

pub(crate) const HELLO: u8 = 1;
pub(crate) const PARCEL: u8 = 2;
const ANSWER: u8 = 3;

/// Behavior of the peer after the last piece.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Ending {
    /// Closes the connection at once.
    Drop,
    /// Shuts down the write side, then reads for at most `timeout`.
    Finish,
    /// Keeps the connection open and reads for at most `timeout`.
    Linger,
    /// Keeps the connection open for `timeout` without reading.
    Deaf,
}

/// One conversation.
#[derive(Debug)]
pub(crate) struct Script {
    /// The pieces to write, each with the pause after it.
    pub(crate) pieces: Vec<(Vec<u8>, Duration)>,
    pub(crate) ending: Ending,
    pub(crate) timeout: Duration,
}

/// Generates conversations.
pub(crate) struct Writer<'a> {
    pub(crate) random: &'a mut Rng,
    /// Service name in each hello.
    pub(crate) name: &'a str,
    /// Names of the receivers.
    pub(crate) receivers: &'a [String],
    /// Registrations of existing agents, by name. A letter to one of them passes admission.
    pub(crate) known: &'a [(String, Incarnation)],
    /// Registrations that hellos and parcels claim as the sender, in addition to random ones.
    pub(crate) claimed: &'a [Incarnation],
}

impl Writer<'_> {
    /// Returns the frames of a connection, with mutations.
    pub(crate) fn frames(&mut self) -> Script {
        let mut pieces = vec![frame(HELLO, 0, &self.hello())];
        for id in 1..=self.random.u64(0..6) {
            let next = match self.random.u8(0..10) {
                0..=5 => frame(PARCEL, id, &self.parcel()),
                6 => frame(ANSWER, id, &self.answer()),
                kind => frame(kind - 3, self.edge(), b""),
            };
            pieces.push(next);
        }
        self.script(pieces)
    }

    /// Returns a letter of a legacy peer, with mutations.
    pub(crate) fn legacy_peer(&mut self) -> Script {
        let letter = LEGACY_PEERS[self.random.usize(..LEGACY_PEERS.len())];
        let pieces = letter.chunks(self.random.usize(16..600));
        let pieces = pieces.map(<[u8]>::to_vec).collect();
        self.script(pieces)
    }

    /// Returns requests of a platform on one connection, with mutations.
    pub(crate) fn requests(&mut self) -> Script {
        let mut pieces = Vec::new();
        for _ in 0..self.random.usize(1..4) {
            let request = REQUESTS[self.random.usize(..REQUESTS.len())];
            let chunks = request.chunks(self.random.usize(16..2000));
            pieces.extend(chunks.map(<[u8]>::to_vec));
        }
        self.script(pieces)
    }

    /// Returns the packets of a UDT connection whose first packet has this number: letters of a
    /// legacy peer, with other packets between them.
    pub(crate) fn udt(&mut self, peer: u32, first: u32) -> Vec<Vec<u8>> {
        let (mut packets, mut sequence) = (Vec::new(), first);
        for message in 1..=self.random.u32(1..4) {
            let letter = LEGACY_PEERS[self.random.usize(..LEGACY_PEERS.len())];
            // libudt fills its packets; other lengths are legal.
            let parts = letter.chunks(if self.random.bool() { 1456 } else { 100 });
            let count = parts.len();
            for (number, part) in parts.enumerate() {
                let position = (number == 0, number + 1 == count);
                packets.push(datagram::udt_data(peer, sequence, position, message, part));
                sequence += 1;
                if self.random.u8(..4) == 0 {
                    // Each kind with the words that it may have, and kinds that do not exist.
                    let kind = self.random.u32(..9);
                    let number = self.counted() as u32;
                    let words: Vec<u32> = (0..self.random.usize(..7))
                        .map(|_| match self.random.bool() {
                            true => sequence.wrapping_add(self.random.u32(..20)),
                            false => self.edge() as u32,
                        })
                        .collect();
                    packets.push(datagram::udt_control(peer, kind, number, &words));
                }
            }
        }
        packets
    }

    /// Returns these recorded pieces, with mutations.
    pub(crate) fn recorded(&mut self, pieces: &[Vec<u8>]) -> Script {
        self.script(pieces.to_vec())
    }

    fn script(&mut self, mut pieces: Vec<Vec<u8>>) -> Script {
        for _ in 0..self.random.usize(..5) {
            mutate(self.random, &mut pieces);
        }
        // Splits some pieces at random positions.
        let mut script = Vec::new();
        for mut piece in pieces {
            while self.random.u8(..4) == 0 && piece.len() > 1 {
                let rest = piece.split_off(self.random.usize(1..piece.len()));
                script.push((piece, self.pause()));
                piece = rest;
            }
            script.push((piece, self.pause()));
        }
        Script {
            pieces: script,
            ending: match self.random.u8(..8) {
                0..3 => Ending::Drop,
                3..5 => Ending::Finish,
                5..7 => Ending::Linger,
                _ => Ending::Deaf,
            },
            timeout: Duration::from_millis(self.random.u64(..40)),
        }
    }

    fn pause(&mut self) -> Duration {
        let most = if self.random.u8(..20) == 0 { 30 } else { 1 };
        Duration::from_millis(self.random.u64(..most))
    }

    /// Returns the known registration of a receiver in seven of eight cases, otherwise a number
    /// below four.
    fn life_of(&mut self, receiver: &str) -> Incarnation {
        let known = self.known.iter().find(|(name, _)| name == receiver);
        match known {
            Some((_, life)) if self.random.u8(..8) > 0 => *life,
            _ => Incarnation::from_u64(self.random.u64(..4)),
        }
    }

    /// Returns one of the registrations to claim, or a random one if there are none.
    fn claim(&mut self) -> u64 {
        match self.claimed {
            [] => self.random.u64(1..),
            claimed => claimed[self.random.usize(..claimed.len())].as_u64(),
        }
    }

    /// Returns a sequence number: a small one, or in one of eight cases an edge value.
    fn counted(&mut self) -> u64 {
        match self.random.u8(..8) {
            0 => self.edge(),
            _ => self.random.u64(..5),
        }
    }

    fn edge(&mut self) -> u64 {
        EDGES[self.random.usize(..EDGES.len())]
    }

    /// Returns the body of a hello.
    pub(crate) fn hello(&mut self) -> Vec<u8> {
        let mut body = Vec::new();
        let service = match self.random.u8(..8) {
            0 => self.claim(),
            _ => self.random.u64(1..),
        };
        body.extend(service.to_le_bytes());
        let letter = [1 << 26, 1 << 10, self.edge()][self.random.usize(..3)];
        body.extend(letter.to_le_bytes());
        let in_flight = [100, 1, self.random.u32(..)][self.random.usize(..3)];
        body.extend(in_flight.to_le_bytes());
        body.extend(self.random.u64(..100).to_le_bytes());
        for text in [self.name, "fuzzed", "elsewhere", "tcp://127.0.0.1:1"] {
            body.extend((text.len() as u16).to_le_bytes());
            body.extend(text.as_bytes());
        }
        let listening = self.random.u8(..3);
        body.push(listening);
        for text in ["127.0.0.1:9", "[::1]:9"].iter().take(listening.into()) {
            body.extend((text.len() as u16).to_le_bytes());
            body.extend(text.as_bytes());
        }
        body
    }

    /// Returns a random parcel in its encoding for frames and packets.
    pub(crate) fn parcel(&mut self) -> Vec<u8> {
        let receiver = &self.receivers[self.random.usize(..self.receivers.len())];
        let body = match self.random.u8(..12) {
            0 => Body::Credit,
            1 => Body::Report(Report::Settled(Outcome::Failed {
                reason: FailureReason::Unreachable,
                attempts: Vec::new(),
            })),
            2 => Body::Report(Report::Returned {
                uncertain: self.random.bool(),
            }),
            3 => Body::Predecessor,
            _ => Body::Letter(letter(self.random, receiver)),
        };
        let parcel = Parcel {
            receiver: receiver.as_str().into(),
            stream: Stream::between(
                Incarnation::from_u64(match self.random.u8(..4) {
                    0 => self.claim(),
                    1 => self.random.u64(..4),
                    _ => self.random.u64(..),
                }),
                self.life_of(receiver),
            ),
            sequence: self.counted(),
            after: match self.random.u8(..4) {
                0 => self.counted(),
                _ => 0,
            },
            transfer: self.random.u64(..5),
            remaining: Duration::from_millis(self.random.u64(..5000)),
            body,
        };
        written(&parcel)
    }

    /// Returns a parcel with a letter that has `len` bytes of content. Its stream has random
    /// registrations.
    pub(crate) fn letter_of(&mut self, len: usize) -> Vec<u8> {
        let letter = letter_with(self.random, &self.receivers[0], vec![7; len]);
        written(&Parcel {
            receiver: self.receivers[0].as_str().into(),
            stream: Stream::between(
                Incarnation::from_u64(self.random.u64(1..)),
                Incarnation::from_u64(self.random.u64(1..)),
            ),
            sequence: 1,
            after: 0,
            remaining: Duration::from_secs(5),
            transfer: 0,
            body: Body::Letter(letter),
        })
    }

    /// Returns the body of an answer.
    pub(crate) fn answer(&mut self) -> Vec<u8> {
        let mut body = vec![self.random.u8(..6)];
        body.extend(
            self.edge()
                .to_le_bytes()
                .iter()
                .take(self.random.usize(..9)),
        );
        body
    }
}

/// Returns the encoding of the parcel for frames and packets.
fn written(parcel: &Parcel) -> Vec<u8> {
    let (header, pieces) = ParcelHeader::of(parcel).unwrap();
    let mut bytes = zerocopy::IntoBytes::as_bytes(&header).to_vec();
    bytes.extend(pieces.concat());
    bytes
}

/// Returns a valid letter from an agent that is not registered.
fn letter(random: &mut Rng, receiver: &str) -> Letter {
    let content = match random.u8(..4) {
        0 => (0..random.usize(..200)).map(|_| random.u8(..)).collect(),
        1 => vec![random.u8(..); random.usize(..40_000)],
        _ => b"((search (sequence :all)))".to_vec(),
    };
    letter_with(random, receiver, content)
}

fn letter_with(random: &mut Rng, receiver: &str, content: Vec<u8>) -> Letter {
    let receiver = AgentId::new(receiver).unwrap();
    let sender = AgentId::new("nobody").unwrap();
    let base = EnvelopeParams {
        to: vec![receiver.clone()],
        from: Some(sender.clone()),
        acl_representation: Some(AclRepresentation::BitEfficient),
        date: Some("20261121T120000000Z".parse().unwrap()),
        ..EnvelopeParams::default()
    };
    let envelope = Envelope {
        base,
        extensions: Vec::new(),
    };
    // Gateways also use letters for the messages between them.
    let ontology = ["fipa-sds-exchange", "fipa-agent-management", "tea"][random.usize(..3)];
    let performative = [
        Performative::Inform,
        Performative::Request,
        Performative::Subscribe,
        Performative::Failure,
    ];
    let message = Message::builder(performative[random.usize(..4)].clone())
        .sender(sender)
        .receiver(receiver)
        .ontology(ontology)
        .reply_with("1")
        .content(content)
        .build()
        .unwrap();
    Letter::new(envelope.encode_standard().unwrap(), message.to_payload())
}

/// Applies one random mutation to the pieces.
pub(crate) fn mutate(random: &mut Rng, pieces: &mut Vec<Vec<u8>>) {
    if pieces.is_empty() {
        pieces.push(vec![random.u8(..)]);
    }
    let (at, other) = (random.usize(..pieces.len()), random.usize(..pieces.len()));
    let piece = &mut pieces[at];
    let len = piece.len();
    match random.u8(..12) {
        // Flips a bit.
        0 | 1 if len > 0 => piece[random.usize(..len)] ^= 1 << random.u8(..8),
        // Replaces a byte.
        2 if len > 0 => piece[random.usize(..len)] = random.u8(..),
        // Overwrites a number, in half of the cases near the start, where the lengths are.
        3..=5 if len > 0 => {
            let near = if random.bool() { len.min(96) } else { len };
            let from = random.usize(..near);
            let number = EDGES[random.usize(..EDGES.len())].to_le_bytes();
            let width = [2, 4, 8][random.usize(..3)];
            for (byte, new) in piece[from..].iter_mut().zip(&number[..width]) {
                *byte = *new;
            }
        }
        // Truncates a piece.
        6 => piece.truncate(random.usize(..=len)),
        // Inserts random bytes.
        7 => {
            let extra = (0..random.usize(1..64)).map(|_| random.u8(..));
            let extra: Vec<u8> = extra.collect();
            let from = random.usize(..=len);
            piece.splice(from..from, extra);
        }
        // Repeats, removes or swaps a piece, or replaces its end by the end of another piece.
        8 => {
            let again = piece.clone();
            pieces.insert(other, again);
        }
        9 => drop(pieces.remove(at)),
        10 => pieces.swap(at, other),
        _ => {
            let from = pieces[other].clone();
            let cut = random.usize(..=from.len());
            let piece = &mut pieces[at];
            piece.truncate(random.usize(..=len));
            piece.extend(&from[cut..]);
        }
    }
}
