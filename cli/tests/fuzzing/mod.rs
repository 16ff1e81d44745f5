//! What is said to a gateway to find out whether it bears it: valid conversations, and what a seeded
//! generator makes of them.

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

/// Letters that legacy peers sent: a fipa_services peer in its own dialect, and in JADE's.
const LEGACY_PEERS: [&[u8]; 2] = [
    include_bytes!("../../../transport-net/tests/data/tcp_letter.bin"),
    include_bytes!("../../../transport-net/tests/data/tcp_letter_jade.bin"),
];

/// Numbers at which lengths and counters go wrong.
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

/// What becomes of a connection when everything has been said.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Ending {
    /// It is closed at once.
    Drop,
    /// Nothing more is written; what comes is read for a while.
    Finish,
    /// It stays as it is for a while, and what comes is read.
    Linger,
    /// It stays as it is for a while, and nothing is read.
    Deaf,
}

/// One conversation.
#[derive(Debug)]
pub(crate) struct Script {
    /// What is written, and how long is waited afterwards.
    pub(crate) pieces: Vec<(Vec<u8>, Duration)>,
    pub(crate) ending: Ending,
    pub(crate) patience: Duration,
}

/// Writes conversations.
pub(crate) struct Writer<'a> {
    pub(crate) random: &'a mut Rng,
    /// What the other side believes the speaker is called.
    pub(crate) name: &'a str,
    /// To whom letters go.
    pub(crate) receivers: &'a [String],
    /// Registrations that the other side knows, by name: with a true one a letter gets past admission.
    pub(crate) known: &'a [(String, Incarnation)],
    /// Registrations that the speaker claims to be, or to send for, beside made-up ones.
    pub(crate) claimed: &'a [Incarnation],
}

impl Writer<'_> {
    /// Frames as they stand on a connection, with mistakes.
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

    /// A letter of a legacy peer, with mistakes.
    pub(crate) fn legacy_peer(&mut self) -> Script {
        let letter = LEGACY_PEERS[self.random.usize(..LEGACY_PEERS.len())];
        let pieces = letter.chunks(self.random.usize(16..600));
        let pieces = pieces.map(<[u8]>::to_vec).collect();
        self.script(pieces)
    }

    /// Bytes that were recorded, with mistakes.
    pub(crate) fn recorded(&mut self, pieces: &[Vec<u8>]) -> Script {
        self.script(pieces.to_vec())
    }

    fn script(&mut self, mut pieces: Vec<Vec<u8>>) -> Script {
        for _ in 0..self.random.usize(..5) {
            mutate(self.random, &mut pieces);
        }
        // Not all of it in the pieces that were meant.
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
            patience: Duration::from_millis(self.random.u64(..40)),
        }
    }

    fn pause(&mut self) -> Duration {
        let most = if self.random.u8(..20) == 0 { 30 } else { 1 };
        Duration::from_millis(self.random.u64(..most))
    }

    /// The true registration of a receiver, most often.
    fn life_of(&mut self, receiver: &str) -> Incarnation {
        let known = self.known.iter().find(|(name, _)| name == receiver);
        match known {
            Some((_, life)) if self.random.u8(..8) > 0 => *life,
            _ => Incarnation::from_u64(self.random.u64(..4)),
        }
    }

    /// A registration that is not the speaker's.
    fn claim(&mut self) -> u64 {
        match self.claimed {
            [] => self.random.u64(1..),
            claimed => claimed[self.random.usize(..claimed.len())].as_u64(),
        }
    }

    /// A number of a letter.
    fn counted(&mut self) -> u64 {
        match self.random.u8(..8) {
            0 => self.edge(),
            _ => self.random.u64(..5),
        }
    }

    fn edge(&mut self) -> u64 {
        EDGES[self.random.usize(..EDGES.len())]
    }

    /// How somebody introduces himself.
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

    /// A parcel as it stands in frames and packets.
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
            stream: Stream {
                sender: Incarnation::from_u64(match self.random.u8(..4) {
                    0 => self.claim(),
                    1 => self.random.u64(..4),
                    _ => self.random.u64(..),
                }),
                receiver: self.life_of(receiver),
            },
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

    /// A parcel with a letter of so many bytes to nobody.
    pub(crate) fn letter_of(&mut self, len: usize) -> Vec<u8> {
        let letter = letter_with(self.random, &self.receivers[0], vec![7; len]);
        written(&Parcel {
            receiver: self.receivers[0].as_str().into(),
            stream: Stream {
                sender: Incarnation::from_u64(self.random.u64(1..)),
                receiver: Incarnation::from_u64(self.random.u64(1..)),
            },
            sequence: 1,
            after: 0,
            remaining: Duration::from_secs(5),
            transfer: 0,
            body: Body::Letter(letter),
        })
    }

    /// The body of an answer.
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

/// A parcel as it stands in frames and packets.
fn written(parcel: &Parcel) -> Vec<u8> {
    let (header, pieces) = ParcelHeader::of(parcel).unwrap();
    let mut bytes = zerocopy::IntoBytes::as_bytes(&header).to_vec();
    bytes.extend(pieces.concat());
    bytes
}

/// A letter that is one, of somebody who is nobody.
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
    // What gateways say to each other is in letters as well.
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

/// Makes one mistake.
pub(crate) fn mutate(random: &mut Rng, pieces: &mut Vec<Vec<u8>>) {
    if pieces.is_empty() {
        pieces.push(vec![random.u8(..)]);
    }
    let (at, other) = (random.usize(..pieces.len()), random.usize(..pieces.len()));
    let piece = &mut pieces[at];
    let len = piece.len();
    match random.u8(..12) {
        // A bit,
        0 | 1 if len > 0 => piece[random.usize(..len)] ^= 1 << random.u8(..8),
        // a byte,
        2 if len > 0 => piece[random.usize(..len)] = random.u8(..),
        // a number, most often near the beginning, where lengths stand,
        3..=5 if len > 0 => {
            let near = if random.bool() { len.min(96) } else { len };
            let from = random.usize(..near);
            let number = EDGES[random.usize(..EDGES.len())].to_le_bytes();
            let width = [2, 4, 8][random.usize(..3)];
            for (byte, new) in piece[from..].iter_mut().zip(&number[..width]) {
                *byte = *new;
            }
        }
        // a cut,
        6 => piece.truncate(random.usize(..=len)),
        // something between,
        7 => {
            let extra = (0..random.usize(1..64)).map(|_| random.u8(..));
            let extra: Vec<u8> = extra.collect();
            let from = random.usize(..=len);
            piece.splice(from..from, extra);
        }
        // something twice, left out, in another order, or of something else.
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
