//! Agents of other hosts that become known by their letters are published before the letters are forwarded, without
//! the service locked.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod common;

use std::net::{IpAddr, Ipv4Addr};
use std::sync::mpsc;
use std::sync::{Arc, OnceLock};
use std::thread;
use std::time::{Duration, SystemTime};

use fipa_acl::{AgentId, Letter, Message, Performative};
use fipa_mts::core::CoreConfig;
use fipa_mts::{Contacts, Mts, RuntimeConfig, letter_for};
use fipa_sds::{Directory, MemoryDirectory, Registration};
use fipa_transport::{
    Abandoned, Answer, Arrival, AttemptId, Body, Hop, Incarnation, Introduction, Kind,
    LegacySource, ListenError, Location, Parcel, Principal, Signature, Sink, Stream, Ticket,
    Transport, TransportError, TransportErrorKind,
};
use parking_lot::Mutex;

const TIMEOUT: Duration = Duration::from_secs(60);
const OWN: Incarnation = Incarnation::from_u64(1);
/// Agents of another process of this host.
const AGENTS: u64 = 40;

/// The events, in order.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Event {
    Heard(String),
    Published,
    Dispatched(String),
}

type Events = Arc<Mutex<Vec<Event>>>;

/// Calls the service on another thread while it publishes.
struct Publishing {
    service: OnceLock<Mts>,
    events: Events,
}

impl Contacts for Publishing {
    fn contact_seen(&self, name: &str, _: Incarnation, _: Location, _: Option<&str>) {
        self.events.lock().push(Event::Heard(name.to_owned()));
    }

    fn contact_seen_again(&self, _: &str) {}

    fn took(&self, _: &str, _: &Location) {}

    fn publish(&self) -> bool {
        let service = self.service.get().unwrap().clone();
        let (ended, end) = mpsc::channel();
        thread::spawn(move || {
            let received = service.try_receive(OWN).is_ok_and(|it| it.is_some());
            let _ = ended.send(received);
        });
        let waited = end.recv_timeout(TIMEOUT);
        waited.expect("the service is locked while contacts are published");
        self.events.lock().push(Event::Published);
        true
    }

    fn suspect(&self, _: &Location, _: TransportErrorKind) {}

    fn introduced(&self, _: &Introduction) {}

    fn disconnected(&self, _: &Introduction) {}
}

/// A transport that records what it is to send.
struct Recording {
    sink: OnceLock<Arc<dyn Sink>>,
    events: Events,
}

impl Transport for Recording {
    fn kind(&self) -> Kind {
        Kind::Tcp
    }

    fn max_letter(&self) -> usize {
        usize::MAX
    }

    fn listen(&self, sink: Arc<dyn Sink>) -> Result<Vec<Location>, ListenError> {
        let _ = self.sink.set(sink);
        Ok(Vec::new())
    }

    fn post(&self, _: AttemptId, _: &Location, parcel: Parcel) -> Result<(), TransportError> {
        let receiver = parcel.receiver.to_string();
        self.events.lock().push(Event::Dispatched(receiver));
        Ok(())
    }

    fn abandon(&self, _: AttemptId, _: &Location) -> Abandoned {
        Abandoned::Unconfirmed
    }

    fn answer(&self, _: Ticket, _: Answer) {}

    fn close(&self) {}
}

/// A started gateway, and the sink of its only transport.
struct Gateway {
    sink: Arc<dyn Sink>,
    events: Events,
    _service: Mts,
    _runtime: tokio::runtime::Runtime,
}

impl Gateway {
    fn start() -> Self {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .unwrap();
        let events = Events::default();
        let contacts = Arc::new(Publishing {
            service: OnceLock::new(),
            events: Arc::clone(&events),
        });
        let config = RuntimeConfig {
            spin: Duration::ZERO,
            unframed_deadline: TIMEOUT,
            contacts: Some(contacts.clone()),
            tap: None,
            gate: None,
            counts: None,
        };
        let directory = MemoryDirectory::new(fipa_sds::MtsId::new("mts", Incarnation::from_u64(2)));
        for number in 0..AGENTS {
            let at = "tcp://127.0.0.1:9#0000000000000002".parse().unwrap();
            let agent = Incarnation::from_u64(100 + number);
            let agent = Registration::new(format!("arm_{number}"), agent, vec![at]);
            directory.register(agent).unwrap();
        }
        let core = CoreConfig {
            forwards: true,
            ..CoreConfig::new("gateway", OWN, vec![Kind::Tcp])
        };
        let transport = Arc::new(Recording {
            sink: OnceLock::new(),
            events: Arc::clone(&events),
        });
        let transports: Vec<Arc<dyn Transport>> = vec![transport.clone()];
        let directory = Arc::new(directory);
        let started = Mts::start(core, config, directory, transports, runtime.handle());
        assert!(contacts.service.set(started.mts.clone()).is_ok());
        Self {
            sink: Arc::clone(transport.sink.get().unwrap()),
            events,
            _service: started.mts,
            _runtime: runtime,
        }
    }

    fn take_events(&self) -> Vec<Event> {
        std::mem::take(&mut self.events.lock())
    }

    /// A letter of this agent of another gateway arrives.
    fn arrives(&self, name: &str, agent: u64) {
        let location: Location = "tcp://192.0.2.1:1#0000000000000003".parse().unwrap();
        let _ = self.sink.arrived(Arrival {
            parcel: Parcel {
                receiver: "arm_0".into(),
                stream: Stream::between(Incarnation::from_u64(agent), Incarnation::from_u64(100)),
                sequence: 1,
                after: 0,
                transfer: 1,
                remaining: TIMEOUT,
                body: Body::Letter(letter(name, &["arm_0".to_owned()])),
            },
            from: Hop {
                location,
                principal: Principal::Unproved,
            },
            ticket: Some(Ticket(agent)),
        });
    }
}

fn letter(sender: &str, receivers: &[String]) -> Letter {
    let sender = AgentId::new(sender).unwrap();
    let sender = sender.with_address("tcp://127.0.0.1:6789").unwrap();
    let mut message = Message::builder(Performative::Inform).sender(sender);
    for receiver in receivers {
        message = message.receiver(AgentId::new(receiver).unwrap());
    }
    letter_for(&message.build().unwrap(), SystemTime::UNIX_EPOCH).unwrap()
}

#[test]
fn the_sender_of_a_letter_is_published_before_the_letter_is_forwarded_and_without_a_lock() {
    let gateway = Gateway::start();
    gateway.arrives("rover", 9);
    assert_eq!(
        gateway.take_events(),
        [
            Event::Heard("rover".to_owned()),
            Event::Published,
            Event::Dispatched("arm_0".to_owned())
        ]
    );
}

#[test]
fn the_sender_of_a_legacy_peers_letter_is_published_before_the_letter_is_forwarded() {
    let gateway = Gateway::start();
    let receivers: Vec<String> = (0..AGENTS).map(|number| format!("arm_{number}")).collect();
    let from = LegacySource {
        address: IpAddr::V4(Ipv4Addr::LOCALHOST),
        signature: Signature::FipaServices,
    };
    let letter = letter("rover", &receivers);
    gateway.sink.arrived_unframed(letter, Kind::Tcp, from);
    let events = gateway.take_events();
    assert_eq!(
        events[..2],
        [Event::Heard("rover".to_owned()), Event::Published]
    );
    let dispatched = events[2..].iter();
    let dispatched: Vec<String> = dispatched
        .map(|event| match event {
            Event::Dispatched(receiver) => receiver.clone(),
            other => panic!("{other:?}"),
        })
        .collect();
    assert_eq!(dispatched, receivers);
}
