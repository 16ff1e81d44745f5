//! The last handle of a service is dropped while a transport calls the service.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod common;

use std::sync::Arc;
use std::sync::mpsc::{self, Receiver, Sender};
use std::thread;
use std::time::Duration;

use fipa_mts::core::CoreConfig;
use fipa_mts::{Contacts, Mts, RuntimeConfig};
use fipa_sds::MemoryDirectory;
use fipa_transport::{
    Hop, Incarnation, Introduction, Kind, Location, Mandate, Principal, Transport,
    TransportErrorKind,
};
use parking_lot::Mutex;

use self::common::Silent;

const TIMEOUT: Duration = Duration::from_secs(60);

/// Stops in the middle of a call until the test continues it.
struct Halting {
    called: Mutex<Sender<()>>,
    go_on: Mutex<Receiver<()>>,
}

impl Contacts for Halting {
    fn contact_seen(&self, _: &str, _: Incarnation, _: Location, _: Option<&str>) {}

    fn contact_seen_again(&self, _: &str) {}

    fn took(&self, _: &str, _: &Location) {}

    fn publish(&self) -> bool {
        true
    }

    fn suspect(&self, _: &Location, _: TransportErrorKind) {}

    fn introduced(&self, _: &Introduction) {
        let _ = self.called.lock().send(());
        let _ = self.go_on.lock().recv_timeout(TIMEOUT);
    }

    fn disconnected(&self, _: &Introduction) {}
}

#[test]
fn no_transport_is_closed_from_within_a_call_of_its_own() {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap();
    let (called, call) = mpsc::channel();
    let (go_on, going_on) = mpsc::channel();
    let (closing, closes) = mpsc::channel();
    // The transport calls its sink with a lock held, and takes this lock when it is closed.
    let turn = Arc::new(Mutex::new(()));
    let closing = Mutex::new(closing);
    let transport = Arc::new(Silent::closed_with(Kind::Shm, {
        let turn = turn.clone();
        move || {
            let _ = closing.lock().send(thread::current().id());
            drop(turn.lock());
        }
    }));
    let config = RuntimeConfig {
        spin: Duration::ZERO,
        unframed_deadline: Duration::from_secs(1),
        contacts: Some(Arc::new(Halting {
            called: Mutex::new(called),
            go_on: Mutex::new(going_on),
        })),
        tap: None,
        gate: None,
        counts: None,
    };
    let own = Incarnation::from_u64(1);
    let directory = MemoryDirectory::new(fipa_sds::MtsId::new("mts", own));
    let core = CoreConfig::new("mts", own, vec![Kind::Shm]);
    let transports: Vec<Arc<dyn Transport>> = vec![transport.clone()];
    let directory = Arc::new(directory);
    let started = Mts::start(core, config, directory, transports, runtime.handle());
    drop(runtime);
    let introduction = Introduction {
        name: "crex-mts".into(),
        hop: Hop {
            location: "shm://crex".parse().unwrap(),
            principal: Principal::Unproved,
        },
        dialed: None,
        mandate: Mandate::Unproved,
    };

    let caller = thread::spawn(move || {
        let _turn = turn.lock();
        transport.sink().introduced(&introduction);
    });
    call.recv_timeout(TIMEOUT).unwrap();
    let mts = started.mts;
    let dropping = thread::spawn(move || drop(mts));
    let closed_by = closes.recv_timeout(TIMEOUT).unwrap();
    assert_eq!(closed_by, dropping.thread().id());
    go_on.send(()).unwrap();
    dropping.join().unwrap();
    caller.join().unwrap();
}
