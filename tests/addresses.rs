//! A service with several addresses of one kind is reached at the address that answers, without a
//! second attempt for its letters.

use std::net::{Ipv4Addr, SocketAddr, TcpStream};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use fipa::{AgentId, Kind, Message, Outcome, Performative};
use fipa_mts::core::{CoreConfig, Submission};
use fipa_mts::{Mts, RuntimeConfig, letter_for};
use fipa_sds::{Directory as _, MemoryDirectory, Registration};
use fipa_transport::{Incarnation, Location, Transport};
use fipa_transport_net::{Identity, TcpConfig, TcpTransport};
use tokio::net::TcpSocket;
use tokio::runtime::Handle;

const ROVER: Incarnation = Incarnation::from_u64(0x50e4);
const ARM: Incarnation = Incarnation::from_u64(0xa53);

/// Starts a service with TCP and timeouts longer than this test. Returns also its directory and
/// location.
fn service(name: &str) -> (Mts, Arc<MemoryDirectory>, Location) {
    let incarnation = Incarnation::random();
    let patient = Duration::from_secs(60);
    let identity = Identity {
        name: name.into(),
        incarnation,
        domain: "addresses".into(),
        host: name.into(),
    };
    let mut config = TcpConfig::new(vec!["127.0.0.1:0".to_owned()], identity);
    config.processes = true;
    config.limits.connect_timeout = patient;
    let transport = Arc::new(TcpTransport::new(config, Handle::current()));
    let directory = Arc::new(MemoryDirectory::new(fipa_sds::MtsId::new(
        name,
        incarnation,
    )));
    let started = Mts::start(
        CoreConfig {
            attempt_timeout: patient,
            ..CoreConfig::new(name, incarnation, vec![Kind::Tcp])
        },
        RuntimeConfig {
            spin: Duration::ZERO,
            unframed_deadline: patient,
            contacts: None,
            tap: None,
            gate: None,
            counts: None,
        },
        directory.clone(),
        vec![transport as Arc<dyn Transport>],
        &Handle::current(),
    );
    (started.mts, directory, started.locations[0].clone())
}

#[tokio::test(flavor = "multi_thread")]
async fn an_address_that_does_not_answer_costs_no_attempt() {
    let (rovers, known, _) = service("rovers");
    let (arms, there, location) = service("arms");
    // The only slot of the accept queue is taken, so the system does not answer further connections.
    let full = TcpSocket::new_v4().unwrap();
    full.bind(SocketAddr::from((Ipv4Addr::LOCALHOST, 0)))
        .unwrap();
    let full = full.listen(0).unwrap();
    let silent = full.local_addr().unwrap();
    let _first = TcpStream::connect(silent).unwrap();
    let silent = Location::new(Kind::Tcp, &silent.to_string()).unwrap();
    let silent = silent.with_incarnation(location.incarnation());

    let arm = |at: Vec<Location>| Registration::new("arm", ARM, at);
    known.register(arm(vec![silent, location.clone()])).unwrap();
    there.register(arm(vec![location])).unwrap();
    rovers.register("rover".into(), ROVER);
    arms.register("arm".into(), ARM);

    let message = Message::builder(Performative::Inform)
        .sender(AgentId::new("rover").unwrap())
        .receiver(AgentId::new("arm").unwrap())
        .content("hello")
        .build()
        .unwrap();
    let sent = rovers.submit(Submission {
        sender: ROVER,
        letter: letter_for(&message, SystemTime::now()).unwrap(),
        receivers: vec!["arm".into()],
        deadline: Duration::from_secs(30),
    });
    let outcomes = sent.outcomes().await;
    let [(_, Outcome::Delivered { via, attempts })] = &outcomes[..] else {
        panic!("{outcomes:?}")
    };
    assert_eq!(*via, Kind::Tcp);
    assert!(attempts.is_empty(), "{attempts:?}");
    assert!(arms.try_receive(ARM).unwrap().is_some());
    assert!(arms.try_receive(ARM).unwrap().is_none());
    rovers.abort();
    arms.abort();
}
