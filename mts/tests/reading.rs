//! The runtime has arriving letters read before it locks the core.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod common;

use std::fs;
use std::net::{IpAddr, Ipv4Addr};
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc;
use std::sync::{Arc, OnceLock};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant, SystemTime};

use fipa_acl::{AgentId, Letter, Message, Performative};
use fipa_mts::core::CoreConfig;
use fipa_mts::{AccessGate, LetterParts, Link, Mts, RuntimeConfig, letter_for};
use fipa_sds::{Directory, MemoryDirectory, Registration};
use fipa_transport::{
    Answer, Arrival, Body, Hop, Incarnation, Kind, LegacySource, Location, Parcel, Principal,
    Reaction, Signature, Stream, Ticket, Transport,
};
use parking_lot::Mutex;

use self::common::{Silent, letter};

const TIMEOUT: Duration = Duration::from_secs(60);
const ARM: Incarnation = Incarnation::from_u64(3);

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
            let received = service.try_receive(ARM).unwrap().is_some();
            let _ = ended.send(received);
        });
        let waited = end.recv_timeout(TIMEOUT);
        waited.expect("the service is locked while a letter is read");
        LetterParts::default()
    }

    fn admits(&self, _: Instant, receiver: &str, _: &LetterParts, _: Link) -> Result<(), String> {
        self.asked.lock().push(receiver.to_owned());
        Ok(())
    }
}

/// A started gateway with this gate, its only transport, and its runtime.
struct Gateway {
    service: Mts,
    transport: Arc<Silent>,
    _runtime: tokio::runtime::Runtime,
}

impl Gateway {
    /// A gateway whose directory has these agents. `arm` is in its process.
    fn start(gate: Arc<dyn AccessGate>, agents: &[(&str, Incarnation)]) -> Self {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .unwrap();
        let config = RuntimeConfig {
            spin: Duration::ZERO,
            unframed_deadline: Duration::from_secs(1),
            contacts: None,
            tap: None,
            gate: Some(gate),
            counts: None,
        };
        let own = Incarnation::from_u64(1);
        let directory = MemoryDirectory::new(fipa_sds::MtsId::new("mts", own));
        for (name, agent) in agents {
            let at = "tcp://127.0.0.1:9#0000000000000001".parse().unwrap();
            let agent = Registration::new(*name, *agent, vec![at]);
            directory.register(agent).unwrap();
        }
        let core = CoreConfig {
            forwards: true,
            ..CoreConfig::new("mts", own, vec![Kind::Tcp])
        };
        let transport = Arc::new(Silent::new(Kind::Tcp));
        let transports: Vec<Arc<dyn Transport>> = vec![transport.clone()];
        let directory = Arc::new(directory);
        let started = Mts::start(core, config, directory, transports, runtime.handle());
        started.mts.register("arm".into(), ARM);
        Self {
            service: started.mts,
            transport,
            _runtime: runtime,
        }
    }
}

const LEGACY_PEER: LegacySource = LegacySource {
    address: IpAddr::V4(Ipv4Addr::LOCALHOST),
    signature: Signature::FipaServices,
};

#[test]
fn the_service_is_not_locked_while_the_gate_reads_a_letter() {
    let gate = Arc::new(Calling::default());
    let gateway = Gateway::start(gate.clone(), &[("arm", ARM)]);
    assert!(gate.service.set(gateway.service.clone()).is_ok());
    let sink = gateway.transport.sink();

    let location: Location = "tcp://192.0.2.1:1#0000000000000002".parse().unwrap();
    let verdict = sink.arrived(Arrival {
        parcel: Parcel {
            receiver: "arm".into(),
            stream: Stream::between(Incarnation::from_u64(9), ARM),
            sequence: 1,
            after: 0,
            transfer: 1,
            remaining: TIMEOUT,
            body: Body::Letter(letter()),
        },
        from: Hop {
            location,
            principal: Principal::Unproved,
        },
        ticket: Some(Ticket(1)),
    });
    assert_eq!(verdict, Reaction::Now(Answer::Accepted));
    sink.arrived_unframed(letter(), Kind::Tcp, LEGACY_PEER);
    assert_eq!(*gate.asked.lock(), ["arm", "arm"]);
}

/// Number of agents of the host on which another thread waits for the service.
const AGENTS: usize = 100;

/// A gate that, when it is asked first, has another thread wait for the lock of the service. When it is asked last,
/// it waits until the other thread has had the lock.
#[derive(Default)]
struct Queueing {
    service: OnceLock<Mts>,
    asked: AtomicUsize,
    other: Mutex<Option<JoinHandle<()>>>,
}

impl AccessGate for Queueing {
    fn read(&self, _: &Letter) -> LetterParts {
        LetterParts::default()
    }

    fn admits(&self, _: Instant, _: &str, _: &LetterParts, _: Link) -> Result<(), String> {
        match self.asked.fetch_add(1, Ordering::Relaxed) + 1 {
            1 => {
                let service = self.service.get().unwrap().clone();
                let task = Arc::new(OnceLock::new());
                let name = task.clone();
                let other = thread::spawn(move || {
                    name.set(fs::read_link("/proc/thread-self").unwrap())
                        .unwrap();
                    service.try_receive(ARM).unwrap();
                });
                *self.other.lock() = Some(other);
                // A thread may also sleep for a moment before it waits for this lock, when another
                // test of the process wakes up.
                let mut looks = 0;
                until(|| {
                    looks = match task.get().is_some_and(|task| is_asleep(task)) {
                        true => looks + 1,
                        false => 0,
                    };
                    looks > 1000
                });
            }
            AGENTS => until(|| self.other.lock().as_ref().unwrap().is_finished()),
            _ => {}
        }
        Ok(())
    }
}

/// Whether a thread sleeps, by its name in `/proc`.
fn is_asleep(task: &Path) -> bool {
    let stat = fs::read_to_string(Path::new("/proc").join(task).join("stat"));
    stat.is_ok_and(|stat| stat.contains(") S "))
}

fn until(mut condition: impl FnMut() -> bool) {
    let end = Instant::now() + TIMEOUT;
    while !condition() {
        assert!(Instant::now() < end, "the condition never holds");
        thread::yield_now();
    }
}

#[test]
fn a_thread_gets_the_lock_between_portions_of_the_receivers_of_a_legacy_peers_letter() {
    let gate = Arc::new(Queueing::default());
    let names: Vec<String> = (1..AGENTS).map(|number| format!("arm_{number}")).collect();
    let mut agents = vec![("arm", ARM)];
    for (name, number) in names.iter().zip(1000..) {
        agents.push((name, Incarnation::from_u64(number)));
    }
    let gateway = Gateway::start(gate.clone(), &agents);
    assert!(gate.service.set(gateway.service.clone()).is_ok());

    let message = Message::builder(Performative::Inform)
        .sender(AgentId::new("rover").unwrap())
        .receiver(AgentId::new("arm.*").unwrap())
        .build()
        .unwrap();
    let letter = letter_for(&message, SystemTime::UNIX_EPOCH).unwrap();
    let sink = gateway.transport.sink();
    sink.arrived_unframed(letter, Kind::Tcp, LEGACY_PEER);
    assert_eq!(gate.asked.load(Ordering::Relaxed), AGENTS);
}
