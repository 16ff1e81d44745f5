//! The runtime has arriving letters read before it locks the core.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::net::{IpAddr, Ipv4Addr};
use std::sync::mpsc;
use std::sync::{Arc, OnceLock};
use std::thread;
use std::time::{Duration, Instant, SystemTime};

use fipa_acl::{AgentId, Letter, Message, Performative};
use fipa_mts::core::CoreConfig;
use fipa_mts::{AccessGate, LetterParts, Link, Mts, RuntimeConfig, letter_for};
use fipa_sds::{Directory, MemoryDirectory, Registration};
use fipa_transport::{
    Abandoned, Answer, Arrival, AttemptId, Body, Hop, Incarnation, Kind, LegacySource, ListenError,
    Location, Parcel, Principal, Signature, Sink, Stream, Ticket, Transport, TransportError,
    TransportErrorKind, Verdict,
};
use parking_lot::Mutex;

const PATIENCE: Duration = Duration::from_secs(60);
const ARM: Incarnation = Incarnation::from_u64(3);

/// A transport without peers, whose sink the test calls.
#[derive(Default)]
struct Silent(OnceLock<Arc<dyn Sink>>);

impl Transport for Silent {
    fn kind(&self) -> Kind {
        Kind::Tcp
    }

    fn max_letter(&self) -> usize {
        usize::MAX
    }

    fn answers_at_once(&self) -> bool {
        false
    }

    fn listen(&self, sink: Arc<dyn Sink>) -> Result<Vec<Location>, ListenError> {
        let _ = self.0.set(sink);
        Ok(Vec::new())
    }

    fn dispatch(&self, _: AttemptId, _: &Location, _: Parcel) -> Result<(), TransportError> {
        Err(TransportError::new(TransportErrorKind::Unreachable, ""))
    }

    fn abandon(&self, _: AttemptId) -> Abandoned {
        Abandoned::Unconfirmed
    }

    fn answer(&self, _: Ticket, _: Answer) {}

    fn close(&self) {}
}

/// A gate that calls the service on another thread while it reads a letter, and records the receivers
/// that it is asked about.
#[derive(Default)]
struct Calling {
    service: OnceLock<Mts>,
    asked: Mutex<Vec<String>>,
}

impl AccessGate for Calling {
    fn read(&self, _: &Letter) -> LetterParts {
        let service = self.service.get().unwrap().clone();
        let (ended, end) = mpsc::channel();
        thread::spawn(move || {
            let received = service.try_receive(ARM).is_some();
            let _ = ended.send(received);
        });
        let waited = end.recv_timeout(PATIENCE);
        waited.expect("the service is locked while a letter is read");
        LetterParts::default()
    }

    fn admits(&self, _: Instant, receiver: &str, _: &LetterParts, _: Link) -> Result<(), String> {
        self.asked.lock().push(receiver.to_owned());
        Ok(())
    }
}

fn letter() -> Letter {
    let message = Message::builder(Performative::Inform)
        .sender(AgentId::new("rover").unwrap())
        .receiver(AgentId::new("arm").unwrap())
        .build()
        .unwrap();
    letter_for(&message, SystemTime::UNIX_EPOCH).unwrap()
}

#[test]
fn the_service_is_not_locked_while_the_gate_reads_a_letter() {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .unwrap();
    let gate = Arc::new(Calling::default());
    let config = RuntimeConfig {
        spin: Duration::ZERO,
        unframed_deadline: Duration::from_secs(1),
        contacts: None,
        tap: None,
        gate: Some(gate.clone()),
    };
    let own = Incarnation::from_u64(1);
    let directory = MemoryDirectory::new(fipa_sds::Mts::new("mts", own));
    let at = "tcp://127.0.0.1:9#0000000000000001".parse().unwrap();
    let arm = Registration::new("arm", ARM, vec![at]);
    directory.register(arm).unwrap();
    let core = CoreConfig {
        forwards: true,
        ..CoreConfig::new("mts", own, vec![Kind::Tcp])
    };
    let transport = Arc::new(Silent::default());
    let transports: Vec<Arc<dyn Transport>> = vec![transport.clone()];
    let started = Mts::start(
        core,
        config,
        Arc::new(directory),
        transports,
        runtime.handle(),
    );
    started.mts.register("arm".into(), ARM);
    assert!(gate.service.set(started.mts.clone()).is_ok());
    let sink = transport.0.get().unwrap();

    let location: Location = "tcp://192.0.2.1:1#0000000000000002".parse().unwrap();
    let verdict = sink.arrived(Arrival {
        parcel: Parcel {
            receiver: "arm".into(),
            stream: Stream {
                sender: Incarnation::from_u64(9),
                receiver: ARM,
            },
            sequence: 1,
            after: 0,
            transfer: 1,
            remaining: PATIENCE,
            body: Body::Letter(letter()),
        },
        from: Hop {
            location,
            principal: Principal::Unproved,
        },
        ticket: Ticket(1),
    });
    assert_eq!(verdict, Verdict::Now(Answer::Accepted));
    let from = LegacySource {
        address: IpAddr::V4(Ipv4Addr::LOCALHOST),
        signature: Signature::FipaServices,
    };
    sink.arrived_unframed(letter(), Kind::Tcp, from);
    assert_eq!(*gate.asked.lock(), ["arm", "arm"]);
}
