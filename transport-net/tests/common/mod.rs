//! Support for the tests of the endpoints: endpoints on loopback, a recording sink, and waiting for
//! a condition.
#![allow(dead_code, reason = "each test file uses a part of it")]

#[cfg(feature = "secure")]
pub(crate) mod certificates;
#[cfg(feature = "quic")]
pub(crate) mod intruder;

use std::collections::HashMap;
use std::ops::Deref;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use bytes::Bytes;
use fipa_acl::{
    AclRepresentation, AgentId, Envelope, EnvelopeParams, Letter, Message, Payload, Performative,
};
use fipa_testbed::until_some;
use fipa_transport::wire::ParcelHeader;
use fipa_transport::{
    Answer, Arrival, Arriving, AttemptId, Body, Conclusion, Hop, Incarnation, Introduction, Kind,
    LegacySource, LoanedContent, Location, Parcel, Reaction, Sink, Stream, Ticket, Transport,
    TransportError,
};
use fipa_transport_net::{
    Identity, NetLimits, TcpConfig, TcpTransport, UdpConfig, UdpLimits, UnixConfig,
};
use parking_lot::Mutex;
use tokio::runtime::{Handle, Runtime};
use zerocopy::IntoBytes as _;

pub(crate) fn runtime() -> Threads {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build();
    Threads(Some(runtime.unwrap()))
}

/// A runtime. A task that blocks its thread forever fails the test instead of hanging it.
pub(crate) struct Threads(Option<Runtime>);

impl Deref for Threads {
    type Target = Runtime;

    fn deref(&self) -> &Runtime {
        self.0.as_ref().unwrap()
    }
}

impl Drop for Threads {
    fn drop(&mut self) {
        let began = Instant::now();
        if let Some(runtime) = self.0.take() {
            runtime.shutdown_timeout(TIMEOUT);
        }
        assert!(
            began.elapsed() < TIMEOUT || std::thread::panicking(),
            "a task blocks its thread"
        );
    }
}

/// A test that waits this long has failed.
const TIMEOUT: Duration = Duration::from_secs(60);

/// The name of every endpoint of the tests.
pub(crate) const NAME: &str = "test-mts";

fn identity() -> Identity {
    Identity {
        name: NAME.into(),
        incarnation: Incarnation::random(),
        domain: "test".into(),
        host: "here".into(),
    }
}

pub(crate) fn udp_config(listen: &[&str]) -> UdpConfig {
    UdpConfig {
        listen: listen.iter().map(|text| (*text).into()).collect(),
        identity: identity(),
        limits: UdpLimits {
            // A test that waits this long has failed.
            connect_timeout: Duration::from_secs(30),
            silence: Duration::from_secs(30),
            ..UdpLimits::default()
        },
    }
}

#[cfg(feature = "udt")]
pub(crate) fn udt_config(listen: &[&str]) -> fipa_transport_net::UdtConfig {
    fipa_transport_net::UdtConfig {
        listen: listen.iter().map(|text| (*text).into()).collect(),
        identity: identity(),
        limits: fipa_transport_net::UdtLimits::default(),
        #[cfg(feature = "secure")]
        security: None,
    }
}

/// The configuration of an endpoint whose socket is in this directory.
pub(crate) fn unix_config(directory: &Path) -> UnixConfig {
    UnixConfig {
        users: fipa_transport::DomainUsers::This,
        directory: directory.to_owned(),
        identity: identity(),
        limits: config(&[]).limits,
    }
}

pub(crate) fn config(listen: &[&str]) -> TcpConfig {
    let listen = listen.iter().map(|text| (*text).into()).collect();
    let mut config = TcpConfig::new(listen, identity());
    config.processes = true;
    // A test that waits this long has failed.
    config.limits.connect_timeout = Duration::from_secs(30);
    config.limits.handshake_timeout = Duration::from_secs(30);
    config
}

#[cfg(feature = "quic")]
pub(crate) fn quic_config(
    listen: &[&str],
    security: fipa_transport_net::secure::Security,
) -> fipa_transport_net::QuicConfig {
    let config = config(listen);
    fipa_transport_net::QuicConfig {
        listen: config.listen,
        identity: config.identity,
        limits: NetLimits {
            // The network does not report an unreachable peer.
            connect_timeout: Duration::from_secs(3),
            ..config.limits
        },
        refused_dials: fipa_transport_net::RefusedDials::default(),
        security,
        refusals: config.refusals,
    }
}

#[derive(Default)]
pub(crate) struct Record {
    pub(crate) arrivals: Vec<(Parcel, Hop, Ticket)>,
    pub(crate) unframed: Vec<(Letter, Kind)>,
    pub(crate) concluded: HashMap<AttemptId, Vec<Conclusion>>,
    pub(crate) introduced: Vec<Introduction>,
    /// Beginnings of letters that the transport has refused.
    pub(crate) refused: Vec<Letter>,
}

pub(crate) struct Recorder {
    pub(crate) record: Mutex<Record>,
    reaction: Reaction,
    /// Bytes of lent memory now and at most, if memory is lent.
    lent: Option<Arc<Mutex<(usize, usize)>>>,
    /// Further locations of every service.
    pub(crate) also_at: Mutex<Vec<Location>>,
    /// Whether the sink refuses each peer that introduces itself.
    pub(crate) refuses_peers: AtomicBool,
}

impl Default for Recorder {
    fn default() -> Self {
        Self {
            record: Mutex::default(),
            reaction: Reaction::Now(Answer::Accepted),
            lent: None,
            also_at: Mutex::default(),
            refuses_peers: AtomicBool::new(false),
        }
    }
}

/// Memory for content that is arriving.
struct Lent {
    memory: Vec<u8>,
    of: Arc<Mutex<(usize, usize)>>,
}

impl LoanedContent for Lent {
    fn content_mut(&mut self) -> &mut [u8] {
        &mut self.memory
    }

    fn freeze(mut self: Box<Self>) -> Bytes {
        let content = std::mem::take(&mut self.memory);
        self.of.lock().0 -= content.len();
        content.into()
    }
}

impl Drop for Lent {
    fn drop(&mut self) {
        self.of.lock().0 -= self.memory.len();
    }
}

impl Sink for Recorder {
    fn arrived(&self, arrival: Arrival) -> Reaction {
        let Arrival {
            parcel,
            from,
            ticket,
        } = arrival;
        let ticket = ticket.expect("the answer may come later");
        self.record.lock().arrivals.push((parcel, from, ticket));
        self.reaction.clone()
    }

    fn memory_for(&self, arriving: &Arriving<'_>) -> Option<Box<dyn LoanedContent>> {
        let of = Arc::clone(self.lent.as_ref()?);
        let mut lent = of.lock();
        lent.0 += arriving.len;
        lent.1 = lent.1.max(lent.0);
        drop(lent);
        let memory = vec![0; arriving.len];
        Some(Box::new(Lent { memory, of }))
    }

    fn also_at(&self, _: &Location) -> Vec<Location> {
        self.also_at.lock().clone()
    }

    fn arrived_unframed(&self, letter: Letter, via: Kind, from: LegacySource) {
        assert!(
            from.address.is_loopback(),
            "the peers of the tests are on loopback, not at {from:?}"
        );
        self.record.lock().unframed.push((letter, via));
    }

    fn refused_unframed(&self, letter: Letter, _: Kind, _: LegacySource, _: &str) {
        self.record.lock().refused.push(letter);
    }

    fn accepts(&self, _: &Introduction) -> bool {
        !self.refuses_peers.load(Ordering::Relaxed)
    }

    fn introduced(&self, peer: &Introduction) {
        self.record.lock().introduced.push(peer.clone());
    }

    fn concluded(&self, attempt: AttemptId, conclusion: Conclusion) {
        let mut record = self.record.lock();
        record
            .concluded
            .entry(attempt)
            .or_default()
            .push(conclusion);
    }
}

/// An endpoint that listens.
pub(crate) struct Party<T = TcpTransport> {
    pub(crate) transport: T,
    pub(crate) sink: Arc<Recorder>,
    pub(crate) locations: Vec<Location>,
    pub(crate) runtime: Threads,
}

impl Party {
    pub(crate) fn new() -> Self {
        Self::with(config(&["127.0.0.1:0"]))
    }

    pub(crate) fn with(config: TcpConfig) -> Self {
        Self::judging(config, Reaction::Now(Answer::Accepted))
    }

    pub(crate) fn judging(config: TcpConfig, reaction: Reaction) -> Self {
        let sink = Recorder {
            reaction,
            ..Recorder::default()
        };
        Self::over(sink, |runtime| TcpTransport::new(config, runtime))
    }

    /// An endpoint whose sink lends memory for contents.
    pub(crate) fn lending(config: TcpConfig) -> Self {
        let sink = Recorder {
            lent: Some(Arc::default()),
            ..Recorder::default()
        };
        Self::over(sink, |runtime| TcpTransport::new(config, runtime))
    }
}

impl<T: Transport> Party<T> {
    pub(crate) fn over(sink: Recorder, make: impl FnOnce(Handle) -> T) -> Self {
        let runtime = runtime();
        let transport = make(runtime.handle().clone());
        let sink = Arc::new(sink);
        let locations = transport.listen(sink.clone()).unwrap();
        Self {
            transport,
            sink,
            locations,
            runtime,
        }
    }

    /// Returns the bytes that its sink lends now, and lent at most.
    pub(crate) fn lent(&self) -> (usize, usize) {
        let lent = self.sink.lent.as_ref();
        lent.map(|lent| *lent.lock()).unwrap_or_default()
    }

    pub(crate) fn location(&self) -> &Location {
        &self.locations[0]
    }

    pub(crate) fn send(
        &self,
        attempt: u64,
        to: &Location,
        parcel: Parcel,
    ) -> Result<(), TransportError> {
        self.transport.post(AttemptId(attempt), to, parcel)
    }

    /// Waits for the conclusion of an attempt.
    pub(crate) fn conclusion(&self, attempt: u64) -> Conclusion {
        until_some("a conclusion", || {
            let record = self.sink.record.lock();
            record.concluded.get(&AttemptId(attempt))?.first().cloned()
        })
    }

    pub(crate) fn arrivals(&self) -> usize {
        self.sink.record.lock().arrivals.len()
    }

    /// Asserts that letters arrive in both directions.
    pub(crate) fn assert_reaches(&self, attempt: u64, to: &Self) {
        self.send(attempt, to.location(), parcel(1, "still there?"))
            .unwrap();
        assert_eq!(self.conclusion(attempt), accepted());
    }
}

pub(crate) fn accepted() -> Conclusion {
    Conclusion::Answered(Answer::Accepted)
}

pub(crate) fn parcel(sequence: u64, content: impl Into<Bytes>) -> Parcel {
    let payload = Payload {
        head: Bytes::from_static(b"head"),
        content: content.into(),
        tail: Bytes::from_static(b"\x01"),
    };
    letter_parcel(
        sequence,
        Letter::new(Bytes::from_static(b"envelope"), payload),
    )
}

/// Encodes the hello of a hostile peer.
pub(crate) fn rogue_hello(incarnation: u64) -> Vec<u8> {
    hello_of("rogue", incarnation)
}

/// Encodes the hello of a hostile peer with this name.
pub(crate) fn hello_of(name: &str, incarnation: u64) -> Vec<u8> {
    let mut body = Vec::new();
    body.extend(incarnation.to_le_bytes());
    body.extend((1_u64 << 30).to_le_bytes());
    body.extend(100_u32.to_le_bytes());
    body.extend(1_u64.to_le_bytes());
    for text in [name, "test", "there", "tcp://127.0.0.1:1"] {
        body.extend((text.len() as u16).to_le_bytes());
        body.extend(text.as_bytes());
    }
    body.push(0);
    body
}

/// Encodes a parcel as in frames and packets.
pub(crate) fn written(parcel: &Parcel) -> Vec<u8> {
    let (header, pieces) = ParcelHeader::of(parcel).unwrap();
    let mut bytes = header.as_bytes().to_vec();
    bytes.extend(pieces.concat());
    bytes
}

/// A letter with an `inform` of `rover` to `arm_1`, encoded as FIPA00069 and FIPA00088 define.
pub(crate) fn message_parcel(sequence: u64, content: &str) -> Parcel {
    let arm = AgentId::new("arm_1").unwrap();
    let rover = AgentId::new("rover").unwrap();
    let message = Message::builder(Performative::Inform)
        .sender(rover.clone())
        .receiver(arm.clone())
        .content(content.to_owned())
        .conversation_id("c-1")
        .build()
        .unwrap();
    let base = EnvelopeParams {
        to: vec![arm.clone()],
        from: Some(rover),
        acl_representation: Some(AclRepresentation::BitEfficient),
        date: Some("20261120T112644481Z".parse().unwrap()),
        intended_receivers: vec![arm],
        ..EnvelopeParams::default()
    };
    let envelope = Envelope {
        base,
        extensions: Vec::new(),
    };
    let letter = Letter::new(envelope.encode_standard().unwrap(), message.to_payload());
    letter_parcel(sequence, letter)
}

pub(crate) fn letter_parcel(sequence: u64, letter: Letter) -> Parcel {
    Parcel {
        receiver: "arm_1".into(),
        stream: Stream::between(Incarnation::from_u64(1), Incarnation::from_u64(2)),
        sequence,
        after: 0,
        remaining: Duration::from_secs(5),
        transfer: 0,
        body: Body::Letter(letter),
    }
}
