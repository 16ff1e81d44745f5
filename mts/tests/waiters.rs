//! Tasks that wait for letters of an agent that is gone.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Barrier};
use std::time::Duration;

use fipa_mts::core::CoreConfig;
use fipa_mts::{Mts, RuntimeConfig};
use fipa_sds::MemoryDirectory;
use fipa_transport::{
    Abandoned, Answer, AttemptId, Incarnation, Kind, ListenError, Location, Parcel, Sink, Ticket,
    Transport, TransportError, TransportErrorKind,
};

const ARM: Incarnation = Incarnation::from_u64(0xa);

/// A transport that carries nothing. The first two tasks that drive it, after finding no letter,
/// continue when the test does.
struct Slow {
    looks: AtomicUsize,
    together: Barrier,
}

impl Transport for Slow {
    fn kind(&self) -> Kind {
        Kind::Shm
    }

    fn max_letter(&self) -> usize {
        0
    }

    fn listen(&self, _: Arc<dyn Sink>) -> Result<Vec<Location>, ListenError> {
        Ok(Vec::new())
    }

    fn post(&self, _: AttemptId, _: &Location, _: Parcel) -> Result<(), TransportError> {
        Err(TransportError::new(
            TransportErrorKind::Unreachable,
            "no process is there",
        ))
    }

    fn abandon(&self, _: AttemptId, _: &Location) -> Abandoned {
        Abandoned::Unconfirmed
    }

    fn answer(&self, _: Ticket, _: Answer) {}

    fn drive(&self) -> bool {
        if self.looks.fetch_add(1, Ordering::SeqCst) < 2 {
            self.together.wait();
            self.together.wait();
        }
        false
    }

    fn close(&self) {}
}

#[test]
fn all_tasks_that_are_about_to_wait_are_told_that_the_agent_is_gone() {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(3)
        .enable_all()
        .build()
        .unwrap();
    let own = Incarnation::from_u64(1);
    let slow = Arc::new(Slow {
        looks: AtomicUsize::new(0),
        together: Barrier::new(3),
    });
    let config = RuntimeConfig {
        spin: Duration::from_nanos(1),
        unframed_deadline: Duration::from_secs(1),
        contacts: None,
        tap: None,
        gate: None,
        counts: None,
    };
    let directory = MemoryDirectory::new(fipa_sds::MtsId::new("mts", own));
    let core = CoreConfig::new("mts", own, vec![Kind::Shm]);
    let transports: Vec<Arc<dyn Transport>> = vec![slow.clone()];
    let started = Mts::start(
        core,
        config,
        Arc::new(directory),
        transports,
        runtime.handle(),
    );
    let mts = started.mts;
    mts.register("arm".into(), ARM);
    let receiving = [(); 2].map(|()| {
        let mts = mts.clone();
        runtime.spawn(async move { mts.receive(ARM).await.is_some() })
    });
    slow.together.wait();
    mts.deregister(ARM);
    slow.together.wait();
    runtime.block_on(async {
        for receiving in receiving {
            let watchdog = Duration::from_secs(30);
            let received = tokio::time::timeout(watchdog, receiving).await;
            assert!(!received.unwrap().unwrap());
        }
    });
    mts.abort();
}
