//! A gateway moves the content of a legacy peer's letter to memory from which it is sent without a copy,
//! before it locks the core.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::net::{IpAddr, Ipv4Addr};
use std::sync::{Arc, OnceLock};
use std::time::{Duration, SystemTime};

use bytes::Bytes;
use fipa_acl::{
    AclRepresentation, AgentId, Dialect, EnvelopeView, Letter, Message, Performative,
    Representation,
};
use fipa_mts::core::CoreConfig;
use fipa_mts::{Mts, RuntimeConfig, letter_for};
use fipa_sds::{Directory, MemoryDirectory, Registration};
use fipa_transport::{
    Abandoned, Answer, AttemptId, Body, Incarnation, Kind, LegacySource, ListenError,
    LoanedContent, Location, Parcel, Signature, Sink, Ticket, Transport, TransportError,
};
use parking_lot::Mutex;

/// Content from this length on is in segments.
const SHARE_FROM: usize = 64 << 10;

/// Shared memory: records the parcels, and the addresses of its segments.
#[derive(Default)]
struct Shared {
    sink: OnceLock<Arc<dyn Sink>>,
    segments: Arc<Mutex<Vec<usize>>>,
    sent: Mutex<Vec<Parcel>>,
}

struct Segment {
    bytes: Vec<u8>,
    segments: Arc<Mutex<Vec<usize>>>,
}

impl LoanedContent for Segment {
    fn content_mut(&mut self) -> &mut [u8] {
        &mut self.bytes
    }

    fn freeze(self: Box<Self>) -> Bytes {
        let bytes = Bytes::from(self.bytes);
        self.segments.lock().push(bytes.as_ptr() as usize);
        bytes
    }
}

impl Shared {
    fn holds(&self, content: &Bytes) -> bool {
        self.segments.lock().contains(&(content.as_ptr() as usize))
    }
}

impl Transport for Shared {
    fn kind(&self) -> Kind {
        Kind::Shm
    }

    fn max_letter(&self) -> usize {
        64 << 20
    }

    fn listen(&self, sink: Arc<dyn Sink>) -> Result<Vec<Location>, ListenError> {
        assert!(self.sink.set(sink).is_ok());
        Ok(Vec::new())
    }

    fn post(&self, _: AttemptId, _: &Location, parcel: Parcel) -> Result<(), TransportError> {
        self.sent.lock().push(parcel);
        Ok(())
    }

    fn abandon(&self, _: AttemptId, _: &Location) -> Abandoned {
        Abandoned::Unconfirmed
    }

    fn answer(&self, _: Ticket, _: Answer) {}

    fn loan_for_many(&self, len: usize) -> Result<Option<Box<dyn LoanedContent>>, TransportError> {
        Ok(Some(Box::new(Segment {
            bytes: vec![0; len],
            segments: Arc::clone(&self.segments),
        })))
    }

    fn copies_for_each(&self, content: &Bytes) -> bool {
        content.len() >= SHARE_FROM && !self.holds(content)
    }

    fn close(&self) {}
}

/// A letter in one piece, as a legacy peer sends it.
fn in_one_piece(content: &str, reply_with: usize) -> (Letter, Message) {
    let message = Message::builder(Performative::Inform)
        .sender(AgentId::new("old").unwrap())
        .receiver(AgentId::new("arm").unwrap())
        .reply_with("r".repeat(reply_with))
        .content(content.to_owned())
        .build()
        .unwrap();
    let short = Message::builder(Performative::Inform)
        .sender(AgentId::new("old").unwrap())
        .receiver(AgentId::new("arm").unwrap())
        .build()
        .unwrap();
    let mut envelope = letter_for(&short, SystemTime::UNIX_EPOCH)
        .unwrap()
        .parse_envelope()
        .unwrap();
    envelope.base.acl_representation = Some(AclRepresentation::String);
    envelope.base.payload_encoding = Some("UTF-8".to_owned());
    let text = message.encode(Representation::String, Dialect::Standard);
    let envelope = envelope.encode_standard().unwrap();
    (Letter::new(envelope, text.unwrap()), message)
}

/// The parcels that a gateway sends for these letters of a legacy peer to the only agent of its host.
fn sent(letters: impl IntoIterator<Item = Letter>) -> (Arc<Shared>, Vec<Parcel>) {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .unwrap();
    let own = Incarnation::from_u64(1);
    let directory = MemoryDirectory::new(fipa_sds::MtsId::new("mts", own));
    let at = "shm://0000000000000009#0000000000000009".parse().unwrap();
    let arm = Registration::new("arm", Incarnation::from_u64(3), vec![at]);
    directory.register(arm).unwrap();
    let config = RuntimeConfig {
        spin: Duration::ZERO,
        unframed_deadline: Duration::from_secs(60),
        contacts: None,
        tap: None,
        gate: None,
        counts: None,
    };
    let core = CoreConfig {
        forwards: true,
        ..CoreConfig::new("mts", own, vec![Kind::Shm, Kind::Tcp])
    };
    let transport = Arc::new(Shared::default());
    let transports: Vec<Arc<dyn Transport>> = vec![transport.clone()];
    let started = Mts::start(
        core,
        config,
        Arc::new(directory),
        transports,
        runtime.handle(),
    );
    let from = LegacySource {
        address: IpAddr::V4(Ipv4Addr::LOCALHOST),
        signature: Signature::FipaServices,
    };
    let sink = transport.sink.get().unwrap();
    for letter in letters {
        sink.arrived_unframed(letter, Kind::Tcp, from);
    }
    let sent = std::mem::take(&mut *transport.sent.lock());
    started.mts.abort();
    (transport, sent)
}

#[test]
fn the_content_of_a_legacy_peers_large_letter_is_shared_before_it_is_sent() {
    let (letter, message) = in_one_piece(&"content ".repeat(400_000), 10);
    assert!(letter.around_len() > 3 << 20);
    let (transport, sent) = sent([letter]);
    let [
        Parcel {
            body: Body::Letter(letter),
            ..
        },
    ] = &sent[..]
    else {
        panic!("{sent:?}");
    };
    assert!(transport.holds(&letter.payload().content));
    assert!(letter.around_len() < 1000);
    assert_eq!(Message::decode(letter.payload()).unwrap(), message);
    let envelope = letter.envelope();
    let view = EnvelopeView::parse(&envelope).unwrap();
    assert_eq!(
        view.acl_representation(),
        Some(AclRepresentation::BitEfficient)
    );
    let effective = letter.parse_envelope().unwrap().effective();
    assert_eq!(
        (effective.payload_encoding, effective.payload_length),
        (None, None)
    );
    assert_eq!(effective.from.unwrap().name(), "old");
}

#[test]
fn a_legacy_peers_letter_that_is_short_is_sent_as_it_came() {
    let (letter, _) = in_one_piece(&"content ".repeat(100_000), 10);
    let (_, sent) = sent([letter.clone()]);
    let [
        Parcel {
            body: Body::Letter(sent),
            ..
        },
    ] = &sent[..]
    else {
        panic!("{sent:?}");
    };
    assert_eq!(sent.payload(), letter.payload());
}

#[test]
fn a_legacy_peers_letter_that_is_long_without_its_content_is_refused() {
    let (letter, _) = in_one_piece("content", 2 << 20);
    let (_, sent) = sent([letter]);
    assert_eq!(sent, []);
}
