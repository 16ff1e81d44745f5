//! Fifty hostile peers attack one of two honest gateways: every honest letter is delivered.
//!
//! The test prints the delivery times in three states: without an attack, during an attack on the
//! gateway, and during an attack on a sink that accepts and ignores everything. The third state shows
//! the cost of the hostile peers themselves on the shared CPUs. `FIPA_LOAD_SECONDS` is the duration of
//! each state, in seconds, repeated three times; without it each state takes one second, once. The
//! figures are meaningful only in a release build on an otherwise idle machine:
//!
//! ```console
//! $ FIPA_LOAD_SECONDS=10 cargo test --release -p fipa-cli --test hostile_load -- --nocapture --test-threads=1
//! ```
//!
//! With `FIPA_LOAD_KINDS=silence,letters` there is one hostile peer of each of these kinds instead of fifty
//! peers. The kinds are the behaviors in `load/hostile.rs`, in lower case.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]
#![allow(clippy::print_stdout, reason = "the test prints its figures")]

mod fuzzing;
mod load;

use std::io::{BufRead as _, BufReader};
use std::net::SocketAddr;
use std::path::Path;
use std::process::Stdio;
use std::sync::Arc;
use std::time::Duration;

use fipa::admin::keys::Keys;
use fipa_testbed::{ChildGuard, frame, ignored_test};
use fuzzing::trusted::{client, quic};
use fuzzing::{Writer, datagram, stream};
use load::hostile::{self, AT_KEYS, IN_THE_CLEAR, Means};
use load::{percentiles, usage};

/// Environment variable with the orders of the hostile peers: whether there are keys, the directory, and
/// two addresses or `sink`.
const ORDERS: &str = "FIPA_LOAD_AT";

/// Number of prepared first datagrams of connections. A datagram is reused after its connection has
/// ended.
const INITIALS: usize = 300;

/// The hostile peers, in a separate process so that their CPU time is measured separately.
struct Hostile(ChildGuard);

impl Hostile {
    fn start(to: Option<(SocketAddr, SocketAddr)>, secured: bool, place: &Path) -> Self {
        let at = to.map_or("sink".to_owned(), |(tcp, datagrams)| {
            format!("{tcp} {datagrams}")
        });
        let mut command = ignored_test("inside_hostile_peers");
        command
            .env(ORDERS, format!("{secured} {} {at}", place.display()))
            .stdout(Stdio::piped());
        let mut child = ChildGuard::start(&mut command);
        let lines = BufReader::new(child.child().stdout.take().unwrap()).lines();
        let mut lines = lines.map_while(Result::ok);
        assert!(
            lines.any(|line| line.contains("READY")),
            "the hostile peers did not start"
        );
        // Reads further output, so that the process does not block.
        std::thread::spawn(move || lines.for_each(drop));
        Self(child)
    }
}

#[test]
#[ignore = "is run by the other tests in a process of its own"]
fn inside_hostile_peers() {
    let orders = std::env::var(ORDERS).unwrap();
    let mut words = orders.split(' ');
    let secured: bool = words.next().unwrap().parse().unwrap();
    let place = Path::new(words.next().unwrap()).to_owned();
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build();
    runtime.unwrap().block_on(async move {
        let at = match words.next().unwrap() {
            "sink" => hostile::sink().await,
            tcp => (tcp.parse().unwrap(), words.next().unwrap().parse().unwrap()),
        };
        let means = Arc::new(means(secured, &place, at).await);
        println!("READY");
        let vices = if secured { &AT_KEYS } else { &IN_THE_CLEAR };
        hostile::set_off(vices, &means);
        std::future::pending::<()>().await;
    });
}

async fn means(secured: bool, place: &Path, (tcp, datagrams): (SocketAddr, SocketAddr)) -> Means {
    let mut random = fastrand::Rng::with_seed(1);
    let receivers = ["unknown".to_owned()];
    let mut writer = Writer {
        random: &mut random,
        name: "rogue",
        receivers: &receivers,
        known: &[],
        claimed: &[],
    };
    let mut means = Means {
        tcp: Some(tcp),
        datagrams: Some(datagrams),
        greeting: frame(fuzzing::HELLO, 0, &writer.hello()),
        letter: frame(fuzzing::PARCEL, 1, &writer.letter_of(64)),
        announcement: frame(fuzzing::PARCEL, 1, &writer.letter_of(60 << 20))[..10_000].to_vec(),
        hello: datagram::hello(1, &[0; 16], &writer.hello()),
        ..Means::default()
    };
    let keys = Keys::at(place.join("stranger"));
    if secured {
        let tls = client(&keys, "stranger");
        means.client_hello = stream::client_hello(&tls);
        let quic = quic(&tls);
        for _ in 0..INITIALS {
            means.initials.push(datagram::initial(&quic).await);
        }
    } else {
        means.client_hello = vec![22; 200];
    }
    means
}

/// The figures of one state.
#[derive(Debug, Default)]
struct Account {
    took: Vec<Duration>,
    gateway: Duration,
    hostile: Duration,
}

fn under_load(secured: bool) {
    let asked = load::number("FIPA_LOAD_SECONDS");
    let (seconds, rounds) = asked.map_or((1, 1), |seconds| (seconds, 3));
    let place = tempfile::Builder::new().prefix("load-").tempdir().unwrap();
    if secured {
        // No gateway trusts this key.
        load::keys(place.path().join("stranger"), "stranger");
    }
    let pair = load::Pair::new(place.path(), secured, "hostile-load");
    let talk = pair.rover.talk("arm");
    talk.goes_on(100);
    talk.take();
    let to = (
        pair.gateway.at("tcp"),
        pair.gateway.at(if secured { "quic" } else { "udp" }),
    );
    let mut accounts: [Account; 3] = Default::default();
    for _ in 0..rounds {
        for (state, account) in accounts.iter_mut().enumerate() {
            let hostile = match state {
                0 => None,
                1 => Some(Hostile::start(Some(to), secured, place.path())),
                _ => Some(Hostile::start(None, secured, place.path())),
            };
            let used = |of: Option<&Hostile>| of.map(|it| usage(it.0.id()).processor);
            let before = (pair.gateway.usage(), used(hostile.as_ref()));
            talk.take();
            std::thread::sleep(Duration::from_secs(seconds));
            // Also when the letters are slow.
            talk.goes_on(20);
            account.took.extend(talk.take());
            account.gateway += pair.gateway.usage().processor - before.0.processor;
            if let (Some(now), Some(before)) = (used(hostile.as_ref()), before.1) {
                account.hostile += now - before;
            }
        }
    }
    talk.end();
    println!("{}:", if secured { "with keys" } else { "without keys" });
    let quiet = percentiles(accounts[0].took.clone());
    for (state, account) in ["no attack", "attack on gateway", "attack on sink"]
        .iter()
        .zip(accounts)
    {
        let letters = account.took.len();
        let (median, last) = percentiles(account.took);
        let ratio = |one: Duration, other: Duration| one.as_secs_f64() / other.as_secs_f64();
        println!(
            "  {state:17} {letters:6} letters: median {median:.1?} ({:.2}), 99 % {last:.1?} ({:.2}); \
             CPU time: gateway {:.1?}, hostile peers {:.1?}",
            ratio(median, quiet.0),
            ratio(last, quiet.1),
            account.gateway,
            account.hostile,
        );
    }
    pair.end();
}

#[test]
fn honest_letters_are_delivered_by_an_attacked_gateway_with_keys() {
    under_load(true);
}

#[test]
fn honest_letters_are_delivered_by_an_attacked_gateway_without_keys() {
    under_load(false);
}
