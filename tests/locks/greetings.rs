//! A host that announces many agents, of which each is asked whether it uses locks.

use std::fmt::Write as _;
use std::time::{Duration, Instant};

use fipa::locks::LockOptions;
use fipa::{Domain, Gateway};
use tokio::io::AsyncReadExt as _;
use tokio::net::TcpListener;

use super::support::config;
use super::watched;

/// Number of agents of the host.
const AGENTS: usize = 600;
/// Letters to its agents at once, and the number after which the test ends.
const AT_ONCE: usize = 256;
const COUNTED: usize = AT_ONCE + 80;
/// Letters a second afterwards.
const RATE: f64 = 20.0;

/// Receives this number of letters.
async fn receive(listener: &TcpListener, count: usize) {
    for _ in 0..count {
        let (mut stream, _) = listener.accept().await.unwrap();
        stream.read_to_end(&mut Vec::new()).await.unwrap();
    }
}

async fn a_host_with_many_agents_is_greeted_slowly(many: &str, other: &str) {
    let many = TcpListener::bind(many).await.unwrap();
    let other = TcpListener::bind(other).await.unwrap();
    let at = many.local_addr().unwrap();
    let mut peers = String::new();
    for number in 0..AGENTS {
        write!(peers, "a{number} = [\"tcp://{at};fipa-services\"], ").unwrap();
    }
    // An address of the loopback interface is one host with all others. A host name is another host.
    let at = format!("localhost:{}", other.local_addr().unwrap().port());
    // The last one in the order of the directory.
    let peers = format!("discovery.static={{ {peers} z = [\"tcp://{at};fipa-services\"] }}");
    let config = config(&[
        &peers,
        "transport.tcp.listen=[\"127.0.0.1:0\", \"[::1]:0\"]",
    ]);
    let _gateway = Gateway::open(&config).await.unwrap();
    let domain = Domain::open(&config).await.unwrap();
    fipa_testbed::until_async("all are known", || {
        domain.directory().entries().len() > AGENTS
    })
    .await;
    let agent = domain.register("rover").await.unwrap();
    let options = LockOptions {
        legacy_peers: true,
        ..LockOptions::default()
    };
    let begun = Instant::now();
    // Starts the locks.
    agent.use_locks(options).unwrap();
    // The agent of another host does not wait until the others were greeted.
    let (to_other, to_many) = tokio::join!(
        async {
            receive(&other, 1).await;
            begun.elapsed()
        },
        async {
            receive(&many, COUNTED).await;
            begun.elapsed()
        }
    );
    assert!(to_other < to_many, "{to_other:?} {to_many:?}");
    let rest = (COUNTED - AT_ONCE) as f64 - 1.0;
    let least = Duration::from_secs_f64(rest / RATE);
    assert!(to_many >= least, "{to_many:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_host_with_many_agents_is_greeted_slowly_and_delays_no_other_over_ipv4() {
    watched(a_host_with_many_agents_is_greeted_slowly(
        "127.0.0.1:0",
        "127.0.0.1:0",
    ))
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_host_with_many_agents_is_greeted_slowly_and_delays_no_other_over_ipv6() {
    watched(a_host_with_many_agents_is_greeted_slowly(
        "[::1]:0",
        "127.0.0.1:0",
    ))
    .await;
}
