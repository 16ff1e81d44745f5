//! The registry of connections, without sockets.
#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::net::SocketAddr;

use fipa_acl::Letter;
use fipa_transport::{Answer, Arrival, Conclusion, Reaction, Stream};

use super::super::frame::FrameReader;
use super::super::link::LinkTask;
use super::super::proof::Proof;
use super::super::wire;
use super::*;
use crate::Identity;

struct Ignores;

impl Sink for Ignores {
    fn arrived(&self, _: Arrival) -> Reaction {
        Reaction::Now(Answer::Accepted)
    }

    fn arrived_unframed(&self, _: Letter, _: Kind, _: fipa_transport::LegacySource) {}

    fn concluded(&self, _: AttemptId, _: Conclusion) {}
}

fn identity(incarnation: u64) -> Identity {
    Identity {
        name: "test-mts".into(),
        incarnation: Incarnation::from_u64(incarnation),
        domain: "test".into(),
        host: incarnation.to_string(),
    }
}

/// An endpoint without a listener. Must be used within a runtime.
fn endpoint(limits: NetLimits) -> Arc<Endpoint> {
    let config = StreamConfig::new(identity(1 << 40), limits);
    let endpoint = Endpoint::new(Kind::Tcp, config, Handle::current());
    let mut registry = endpoint.registry.lock();
    registry.phase = Phase::Open;
    registry.sink = Some(Arc::new(Ignores));
    drop(registry);
    endpoint
}

fn at(text: &str) -> Source {
    let address: SocketAddr = text.parse().unwrap();
    Source::Address(address)
}

fn certificate(number: u8) -> Option<Principal> {
    Some(Principal::Certificate([number; 32]))
}

/// An accepted connection whose peer sends a hello.
struct Greeting {
    incarnation: u64,
    serial: u64,
    dialed: &'static str,
    proved: Option<Principal>,
    from: Source,
    listening: &'static [&'static str],
    load: Load,
}

fn greeting(incarnation: u64, proved: Option<Principal>, from: &str) -> Greeting {
    Greeting {
        incarnation,
        serial: 1,
        dialed: "tcp://10.0.0.1:7788",
        proved,
        from: at(from),
        listening: &[],
        load: Load::Any,
    }
}

async fn enters(
    endpoint: &Endpoint,
    greeting: Greeting,
) -> Result<(Arc<Link>, Hop), ConnectionEnd> {
    let (link, _) = endpoint.accepted().unwrap();
    let peer = Hello {
        identity: identity(greeting.incarnation),
        max_letter: 1 << 20,
        max_in_flight: 8,
        serial: greeting.serial,
        dialed: greeting.dialed.into(),
        listening: greeting.listening.iter().map(|it| (*it).into()).collect(),
        load: greeting.load,
    };
    link.hears(peer.clone());
    let entered = endpoint.enter(&link, &peer, greeting.proved, greeting.from);
    Ok((link.clone(), entered.await?))
}

#[tokio::test]
async fn no_source_has_more_than_half_of_the_slots() {
    let endpoint = endpoint(NetLimits {
        max_connections: 16,
        max_per_address: 4,
        ..NetLimits::default()
    });
    let mut number = 0;
    let mut get_in = async |proved: Option<Principal>, from: &dyn Fn(u64) -> String| {
        let mut entered = 0;
        for _ in 0..10 {
            number += 1;
            let greeting = greeting(number, proved, &from(number));
            entered += usize::from(enters(&endpoint, greeting).await.is_ok());
        }
        entered
    };
    // Every local user has all addresses of 127.0.0.0/8.
    assert_eq!(get_in(None, &|n| format!("127.0.0.{n}:1")).await, 8);
    // Peers with keys are counted by certificate, also on loopback.
    assert_eq!(get_in(certificate(1), &|_| "[::1]:1".into()).await, 4);
    assert_eq!(get_in(None, &|n| format!("[2001:db8::{n}]:1")).await, 4);
    assert_eq!(
        get_in(None, &|_| "10.0.0.1:1".into()).await,
        0,
        "all slots are taken"
    );
    assert_eq!(endpoint.tally().read().refused_crowd, 2 + 6 + 6 + 10);
}

#[tokio::test]
async fn unproved_connections_of_one_source_evict_each_other() {
    let limits = NetLimits::default();
    let endpoint = endpoint(limits.clone());
    let slot = |from: &str| {
        let place = endpoint.admit_unproved(at(from)).unwrap();
        let task = tokio::spawn(std::future::pending::<()>());
        endpoint.unproved_started(place.number, task.abort_handle());
        (place, task)
    };
    let slow = slot("10.0.0.7:1");
    let crowd: Vec<_> = (0..4 * limits.max_strangers)
        .map(|n| slot(&format!("127.0.{}.{}:1", n / 250, n % 250 + 1)))
        .collect();
    let networks: Vec<_> = (0..4 * limits.max_strangers)
        .map(|n| slot(&format!("[2001:db8::{n:x}]:1")))
        .collect();
    let registry = endpoint.registry.lock();
    let has =
        |(place, _): &(UnprovedSlot, JoinHandle<()>)| registry.unproved.contains_key(&place.number);
    assert!(has(&slow));
    let remaining = [&crowd, &networks].map(|crowd| crowd.iter().filter(|it| has(it)).count());
    assert_eq!(1 + remaining[0] + remaining[1], limits.max_strangers);
    drop(registry);
}

/// A certificate or none, an incarnation, an origin, the serial number, and the dialed location.
fn comes(
    proved: Option<Principal>,
    incarnation: u64,
    from: &str,
    serial: u64,
    dialed: &'static str,
) -> Greeting {
    Greeting {
        serial,
        dialed,
        ..greeting(incarnation, proved, from)
    }
}

const X: &str = "tcp://10.0.0.1:7788";
const Y: &str = "tcp://10.0.0.2:7788";

/// Stands for the task of a link, because the tests have no sockets: ends the link on request.
async fn ends_when_asked_to(link: Arc<Link>) {
    let end = link.end_requested().await;
    assert_eq!(end, ConnectionEnd::Superseded);
    link.is_over();
}

#[tokio::test]
async fn an_incarnation_belongs_to_the_certificate_it_is_connected_with() {
    let endpoint = endpoint(NetLimits::default());
    let refused = |why| Err(ConnectionEnd::IdentityConflict(why));
    enters(&endpoint, comes(certificate(1), 7, "10.0.0.7:1", 1, X))
        .await
        .unwrap();
    for from in ["10.0.0.7:2", "10.0.0.8:2"] {
        let entered = enters(&endpoint, comes(certificate(2), 7, from, 2, X)).await;
        let another =
            "it claims the incarnation of a service that is connected with another certificate";
        assert_eq!(entered.map(|_| ()), refused(another));
        let entered = enters(&endpoint, comes(None, 7, from, 2, X)).await;
        let proved = "it has no certificate and claims the incarnation of a service that is connected with one";
        assert_eq!(entered.map(|_| ()), refused(proved));
    }
    // A connection with an unproved claim is replaced.
    let (claimed, _) = enters(&endpoint, comes(None, 9, "10.0.0.8:1", 1, X))
        .await
        .unwrap();
    tokio::spawn(ends_when_asked_to(claimed));
    enters(&endpoint, comes(certificate(2), 9, "10.0.0.9:1", 1, X))
        .await
        .unwrap();
}

#[tokio::test]
async fn a_moved_peer_with_keys_replaces_only_its_older_connection_for_the_same_location() {
    let endpoint = endpoint(NetLimits::default());
    let proved = certificate(1);
    let (first, _) = enters(&endpoint, comes(proved, 7, "10.0.0.7:1", 1, X))
        .await
        .unwrap();
    // One connection for another location, and one opened by this side.
    let (second, _) = enters(&endpoint, comes(proved, 7, "10.0.0.7:2", 2, Y))
        .await
        .unwrap();
    let (crossing, _) = enters(&endpoint, comes(proved, 7, "10.0.0.7:7788", 0, ""))
        .await
        .unwrap();
    for link in [&first, &second, &crossing] {
        assert_eq!(link.ending(), None);
    }
    tokio::spawn(ends_when_asked_to(first));
    tokio::spawn(ends_when_asked_to(second));
    enters(&endpoint, comes(proved, 7, "10.0.0.8:1", 3, X))
        .await
        .unwrap();
    assert_eq!(crossing.ending(), None);
}

#[tokio::test]
async fn a_peer_without_keys_is_admitted_at_each_address_that_its_first_connection_lists() {
    let endpoint = endpoint(NetLimits::default());
    let first = Greeting {
        listening: &["0.0.0.0:7788", "10.0.0.7:7788", "10.0.1.7:7788"],
        ..comes(None, 7, "10.0.0.7:1", 1, X)
    };
    let (first, _) = enters(&endpoint, first).await.unwrap();
    tokio::spawn(ends_when_asked_to(first.clone()));
    for dialed in [X, Y] {
        let second = comes(None, 7, "10.0.1.7:1", 2, dialed);
        enters(&endpoint, second).await.unwrap();
        assert_eq!(first.ending(), None, "both stay: {dialed}");
    }
    // An unproved peer cannot list its own address: the connected peer must list it. The peer of
    // the first connection has no socket here and does not respond.
    let slot = Greeting {
        listening: &["10.0.0.8:7788", "10.0.0.7:7788"],
        ..comes(None, 8, "10.0.0.8:1", 3, X)
    };
    let (claimed, _) = enters(&endpoint, comes(None, 8, "10.0.0.9:1", 1, X))
        .await
        .unwrap();
    tokio::spawn(ends_when_asked_to(claimed.clone()));
    enters(&endpoint, slot).await.unwrap();
    assert_eq!(
        claimed.ending(),
        Some(ConnectionEnd::Superseded),
        "it did not respond"
    );
    assert_eq!(first.ending(), None);
}

#[tokio::test]
async fn receive_windows_share_one_budget_with_a_share_for_each_certificate() {
    let endpoint = endpoint(NetLimits::default());
    let limits = endpoint.limits().clone();
    let len = limits.max_incoming_per_source / 2 - 1;
    let quota_key = |number| QuotaKey::Certificate([number; 32]);
    let of_one: Vec<_> = (0..64)
        .filter_map(|_| endpoint.window(&quota_key(0), len))
        .collect();
    assert_eq!(of_one.len(), 2);
    let of_all: Vec<_> = (0..64)
        .filter_map(|number| endpoint.window(&quota_key(number), len))
        .collect();
    let taken = (of_one.len() + of_all.len()) * len;
    assert!(
        taken <= limits.max_incoming && taken + len > limits.max_incoming,
        "{taken}"
    );
    // A connection that ends releases its share.
    drop(of_all);
    assert!(endpoint.window(&quota_key(9), len).is_some());
}

#[tokio::test]
async fn a_peer_that_dials_an_earlier_incarnation_keeps_its_connection_with_this_one() {
    let endpoint = endpoint(NetLimits::default());
    let proved = certificate(1);
    let (good, _) = enters(&endpoint, comes(proved, 7, "10.0.0.7:1", 1, X))
        .await
        .unwrap();
    tokio::spawn(ends_when_asked_to(good.clone()));
    // From a new address, as after a move, the peer dials the location in an outdated directory
    // entry.
    let earlier = comes(
        proved,
        7,
        "10.0.0.8:1",
        2,
        "tcp://10.0.0.1:7788#0000000000000009",
    );
    let entered = enters(&endpoint, earlier).await;
    assert_eq!(entered.map(|_| ()), Err(ConnectionEnd::NotSought));
    assert_eq!(good.ending(), None);
}

/// Whatever its hello says, an unproved peer at another address takes no letters of a service that is alive.
#[tokio::test]
async fn an_unproved_peer_elsewhere_is_refused_beside_a_service_that_is_alive() {
    for load in [Load::Any, Load::Large] {
        for (serial, dialed) in [(2, X), (2, Y), (0, X), (0, ""), (2, "")] {
            let endpoint = endpoint(NetLimits::default());
            let honest = comes(None, 7, "10.0.0.7:1", 1, X);
            let (honest, _) = enters(&endpoint, honest).await.unwrap();
            let thief = Greeting {
                load,
                ..comes(None, 7, "10.0.0.9:1", serial, dialed)
            };
            let answers = async {
                loop {
                    honest.hears_pong();
                    tokio::task::yield_now().await;
                }
            };
            let entered = tokio::select! {
                entered = enters(&endpoint, thief) => entered,
                () = answers => unreachable!("it does not end"),
            };
            let refused = matches!(entered, Err(ConnectionEnd::IdentityConflict(_)));
            assert!(refused, "{load:?}, {serial}, {dialed}");
            let to = "tcp://10.0.0.7:7788#0000000000000007".parse().unwrap();
            let route = endpoint.route_to(&to, load).unwrap();
            assert_eq!(matches!(route, Route::New(..)), load == Load::Large);
        }
    }
}

/// A link that was dialed for this location and whose peer has introduced itself.
async fn dials(endpoint: &Endpoint, to: &Location) -> Arc<Link> {
    let Route::New(link, _) = endpoint.route_to(to, Load::Any).unwrap() else {
        panic!("there is a connection already");
    };
    greets(&link, to.incarnation().as_u64());
    link
}

/// The peer of a link says hello.
fn greets(link: &Link, peer: u64) {
    link.connected(Instant::now());
    link.greeted_by(Hello {
        identity: identity(peer),
        max_letter: 1 << 20,
        max_in_flight: 8,
        serial: 0,
        dialed: String::new(),
        listening: Vec::new(),
        load: Load::Any,
    });
}

fn letter_of(len: usize, sender: u64) -> Parcel {
    let payload = fipa_acl::Payload {
        head: "head".into(),
        content: vec![b'x'; len].into(),
        tail: "tail".into(),
    };
    Parcel {
        receiver: "arm".into(),
        stream: Stream::between(Incarnation::from_u64(sender), Incarnation::from_u64(2)),
        sequence: 1,
        after: 0,
        transfer: 1,
        remaining: Duration::from_secs(1),
        body: Body::Letter(Letter::new("envelope".into(), payload)),
    }
}

/// Dispatches letters through links that do not send. Returns the link that took the last one.
struct Dispatcher<'a> {
    endpoint: &'a Endpoint,
    to: Location,
    links: Mutex<Vec<Arc<Link>>>,
    attempts: u64,
}

impl<'a> Dispatcher<'a> {
    fn new(endpoint: &'a Endpoint) -> Self {
        Self {
            endpoint,
            to: "tcp://10.0.0.7:7788#0000000000000007".parse().unwrap(),
            links: Mutex::default(),
            attempts: 0,
        }
    }

    /// Returns the place of the link among the dialed ones.
    fn post(&mut self, parcel: &Parcel) -> usize {
        self.attempts += 1;
        let attempt = AttemptId(self.attempts);
        let dial = |link: Arc<Link>, _| {
            greets(&link, self.to.incarnation().as_u64());
            self.links.lock().push(link);
            tokio::spawn(std::future::pending())
        };
        self.endpoint.post(attempt, &self.to, parcel, dial).unwrap();
        let links = self.links.lock();
        let place = links.iter().position(|link| link.has_attempt(attempt));
        place.unwrap()
    }

    fn link(&self, place: usize) -> Arc<Link> {
        Arc::clone(&self.links.lock()[place])
    }
}

#[tokio::test]
async fn large_letters_take_a_connection_of_their_own() {
    let endpoint = endpoint(NetLimits::default());
    let mut to_arm = Dispatcher::new(&endpoint);
    let (small, large) = (letter_of(64 << 10, 1), letter_of(70_000, 1));
    assert_eq!(to_arm.post(&small), 0);
    assert_eq!(to_arm.post(&large), 1);
    assert_eq!(to_arm.post(&small), 1, "it follows the large one");
    assert_eq!(to_arm.post(&letter_of(10, 9)), 0, "another stream");
    let report = Parcel {
        body: Body::Credit,
        ..small.clone()
    };
    assert_eq!(to_arm.post(&report), 0);
    assert_eq!(to_arm.link(1).load(), Load::Large);
    // The large one does not begin before the small one is answered.
    assert_eq!(to_arm.link(1).may_begin(), 0);
    to_arm.link(0).answered(1);
    assert_eq!(to_arm.link(1).may_begin(), 2);
    for id in 1..=2 {
        to_arm.link(1).begins();
        to_arm.link(1).answered(id);
    }
    assert_eq!(to_arm.post(&small), 0, "the large one has arrived");
}

#[tokio::test]
async fn a_large_letter_does_not_wait_for_an_attempt_that_has_ended() {
    let endpoint = endpoint(NetLimits::default());
    let mut to_arm = Dispatcher::new(&endpoint);
    assert_eq!(to_arm.post(&letter_of(10, 1)), 0);
    to_arm.link(0).begins();
    assert_eq!(to_arm.post(&letter_of(70_000, 1)), 1);
    assert_eq!(to_arm.link(1).may_begin(), 0);
    let ended = endpoint.abandon(AttemptId(1), &to_arm.to);
    assert_eq!(ended, Abandoned::Unconfirmed);
    assert_eq!(to_arm.link(1).may_begin(), 1);
}

#[tokio::test]
async fn without_a_connection_of_their_own_large_letters_take_the_other_one() {
    let endpoint = endpoint(NetLimits::default());
    let mut to_arm = Dispatcher::new(&endpoint);
    let (small, large) = (letter_of(10, 1), letter_of(70_000, 2));
    assert_eq!(to_arm.post(&large), 0);
    let alone = to_arm.link(0);
    assert!(!endpoint.has_detour(&alone), "there is no other one");
    assert_eq!(to_arm.post(&small), 1);
    assert!(endpoint.has_detour(&alone));
    endpoint.forget(&alone);
    assert_eq!(to_arm.post(&large), 1);
}

#[tokio::test]
async fn a_peer_has_a_connection_of_each_load() {
    let endpoint = endpoint(NetLimits::default());
    let proved = certificate(1);
    let enter = async |serial, load| {
        let greeting = Greeting {
            serial,
            load,
            ..greeting(7, proved, "10.0.0.7:1")
        };
        enters(&endpoint, greeting).await.unwrap().0
    };
    let any = enter(1, Load::Any).await;
    let large = enter(2, Load::Large).await;
    assert_eq!((any.ending(), large.ending()), (None, None));
    tokio::spawn(ends_when_asked_to(large.clone()));
    let again = enter(3, Load::Large).await;
    assert_eq!(large.ending(), Some(ConnectionEnd::Superseded));
    assert_eq!((any.ending(), again.ending()), (None, None));
    // After a move, the peer has one connection from its new address.
    for link in [&any, &again] {
        tokio::spawn(ends_when_asked_to(link.clone()));
    }
    let moved = Greeting {
        serial: 4,
        ..greeting(7, proved, "10.0.0.8:1")
    };
    let moved = enters(&endpoint, moved).await.unwrap().0;
    assert_eq!(any.ending(), Some(ConnectionEnd::Superseded));
    assert_eq!(again.ending(), Some(ConnectionEnd::Superseded));
    assert_eq!(moved.ending(), None);
}

#[tokio::test]
async fn letters_take_another_connection_when_one_is_suspect() {
    let endpoint = endpoint(NetLimits {
        keep_alive: Duration::ZERO,
        connect_timeout: Duration::ZERO,
        ..NetLimits::default()
    });
    let to: Location = "tcp://10.0.0.7:7788#0000000000000007".parse().unwrap();
    let first = dials(&endpoint, &to).await;
    let Route::Open(same) = endpoint.route_to(&to, Load::Any).unwrap() else {
        panic!("a healthy connection is kept");
    };
    assert!(Arc::ptr_eq(&first, &same));
    first.doubt();
    assert!(first.is_suspect());
    let second = dials(&endpoint, &to).await;
    assert_eq!(
        first.ending(),
        Some(ConnectionEnd::Silent),
        "the other one is open"
    );
    let Route::Open(used) = endpoint.route_to(&to, Load::Any).unwrap() else {
        panic!("it is used");
    };
    assert!(Arc::ptr_eq(&second, &used));
    second.doubt();
    assert!(matches!(
        endpoint.route_to(&to, Load::Any).unwrap(),
        Route::New(..)
    ));
}

#[tokio::test]
async fn letters_take_another_connection_after_their_peer_has_announced_another_address() {
    let endpoint = endpoint(NetLimits::default());
    let to: Location = "tcp://10.0.0.7:7788#0000000000000007".parse().unwrap();
    let moved: Location = "tcp://10.0.0.8:7788#0000000000000007".parse().unwrap();
    let dialed = dials(&endpoint, &to).await;
    let elsewhere = comes(None, 7, "10.0.0.9:1", 1, Y);
    let (elsewhere, _) = enters(&endpoint, elsewhere).await.unwrap();
    let hello = comes(None, 8, "10.0.0.7:1", 1, X);
    let (other_peer, _) = enters(&endpoint, hello).await.unwrap();
    endpoint.service_left(&to);
    assert!(dialed.is_suspect());
    assert!(!elsewhere.is_suspect());
    assert!(!other_peer.is_suspect());
    endpoint.service_left(&"tcp://10.0.0.9:7788#0000000000000007".parse().unwrap());
    assert!(elsewhere.is_suspect());
    assert!(!other_peer.is_suspect());
    assert!(matches!(
        endpoint.route_to(&moved, Load::Any).unwrap(),
        Route::New(..)
    ));
}

/// A peer that has announced another address is not waited for as long as others.
#[tokio::test]
async fn a_question_ends_early_after_its_peer_has_announced_another_address() {
    let endpoint = endpoint(NetLimits::default());
    let to: Location = "tcp://10.0.0.7:7788#0000000000000007".parse().unwrap();
    let link = dials(&endpoint, &to).await;
    let asked = link.clone();
    let long = Duration::from_secs(3600);
    let answer =
        tokio::spawn(async move { asked.answers(Instant::now(), long, Duration::ZERO).await });
    tokio::task::yield_now().await;
    endpoint.service_left(&to);
    let watchdog = Duration::from_secs(30);
    let answered = tokio::time::timeout(watchdog, answer).await;
    assert!(!answered.expect("the question ends").unwrap());
}

/// Records the error of the last attempt.
#[derive(Default)]
struct Errors(Mutex<Option<TransportError>>);

impl Sink for Errors {
    fn arrived(&self, _: Arrival) -> Reaction {
        Reaction::Now(Answer::Accepted)
    }

    fn arrived_unframed(&self, _: Letter, _: Kind, _: fipa_transport::LegacySource) {}

    fn concluded(&self, _: AttemptId, conclusion: Conclusion) {
        if let Conclusion::NotSent(error) = conclusion {
            *self.0.lock() = Some(error);
        }
    }
}

/// The hello of this side then finds a connection that is reset, before the bytes of the peer are read.
#[tokio::test]
async fn the_reason_of_a_peer_counts_when_writing_fails_first() {
    let endpoint = endpoint(NetLimits::default());
    let errors = Arc::new(Errors::default());
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let peer = listener.local_addr().unwrap();
    let to: Location = format!("tcp://{peer}").parse().unwrap();
    let stream = tokio::net::TcpStream::connect(peer).await.unwrap();
    let (mut other, _) = listener.accept().await.unwrap();
    tokio::io::AsyncWriteExt::write_all(&mut other, b"fipa\x09\x01\0\0")
        .await
        .unwrap();
    let reset = socket2::SockRef::from(&other).set_linger(Some(Duration::ZERO));
    reset.unwrap();
    drop(other);
    // The next write fails.
    let gone = || matches!(stream.try_write(b"x"), Err(error) if error.kind() != io::ErrorKind::WouldBlock);
    while !gone() {
        tokio::task::yield_now().await;
    }
    let letter = letter_of(100, 1);
    let sink = errors.clone();
    let stream = Mutex::new(Some(stream));
    let serving = endpoint.post(AttemptId(1), &to, &letter, |link, _| {
        let running = LinkTask::new(
            endpoint.clone(),
            link.clone(),
            sink.clone(),
            Some(to.clone()),
        );
        let stream = stream.lock().take().unwrap();
        link.connected(Instant::now());
        let reader = FrameReader::new(1 << 20, bytes::BytesMut::new());
        tokio::spawn(running.serve(
            wire::plain(stream),
            Proof::default(),
            reader,
            Source::Address(peer),
            || {},
        ))
    });
    serving.unwrap();
    let error = tokio::time::timeout(Duration::from_secs(60), async {
        loop {
            if let Some(error) = errors.0.lock().take() {
                return error;
            }
            tokio::task::yield_now().await;
        }
    });
    let error = error.await.unwrap();
    assert_eq!(error.fault, TransportErrorKind::Incompatible, "{error}");
    assert!(error.detail.contains("version 9"), "{error}");
}
