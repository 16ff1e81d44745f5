//! Two domains that represent two hosts, with gateways that discover each other by mDNS on the
//! loopback interface.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod support;

use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa::admin::routes::{self, RouteState, Standing};
use fipa::error::{ErrorChain, OpenError, TransportErrorKind};
use fipa::{
    Agent, Config, Deliveries, Domain, FailureReason, Gateway, Kind, Outcome, Performative, Query,
};
use support::inform;

/// A simulated host with a domain and names that no other test uses.
struct Host {
    config: Config,
    set: Vec<String>,
    mark: String,
}

impl Host {
    fn new(set: &[&str]) -> Self {
        let mark = support::mark();
        let mut all = vec![
            format!("domain=gw-{mark}"),
            format!("mts.name=gateway-{mark}"),
            "discovery.interfaces=lo".to_owned(),
        ];
        all.extend(set.iter().map(|setting| (*setting).to_owned()));
        let mut host = Self {
            config: Config::for_host("gateways"),
            set: all,
            mark,
        };
        host.config = host.configured(&[]);
        host
    }

    /// Returns its configuration with further settings.
    fn configured(&self, set: &[&str]) -> Config {
        let set = set.iter().map(|setting| (*setting).to_owned());
        support::load(self.set.iter().cloned().chain(set))
    }

    /// Starts the gateway of the host and a process on it.
    async fn start(&self) -> (Gateway, Domain) {
        let gateway = Gateway::open(&self.config).await.unwrap();
        (gateway, Domain::open(&self.config).await.unwrap())
    }

    fn name(&self, agent: &str) -> String {
        format!("{agent}-{}", self.mark)
    }
}

async fn known(domain: &Domain, name: &str) {
    let started = Instant::now();
    while domain.directory().lookup(name).is_none() {
        assert!(
            started.elapsed() < Duration::from_secs(60),
            "{name} was not found"
        );
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

async fn forgotten(domain: &Domain, name: &str) {
    let started = Instant::now();
    while domain.directory().lookup(name).is_some() {
        assert!(
            started.elapsed() < Duration::from_secs(60),
            "{name} was not forgotten"
        );
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

fn via(deliveries: &Deliveries) -> Option<Kind> {
    assert_eq!(deliveries.0.len(), 1, "{deliveries}");
    assert!(deliveries.all_succeeded(), "{deliveries}");
    deliveries.0[0].outcome.via()
}

fn reason(deliveries: &Deliveries) -> FailureReason {
    match deliveries.0.as_slice() {
        [delivery] => match &delivery.outcome {
            Outcome::Failed { reason, .. } => *reason,
            other => panic!("{other}"),
        },
        other => panic!("{other:?}"),
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn small_letters_use_udp_and_letters_too_large_for_it_use_tcp() {
    let order = ["mts.transports=shm,udp,tcp"];
    let (here, there) = (Host::new(&order), Host::new(&order));
    let (_near, at_home) = here.start().await;
    let (_far, abroad) = there.start().await;
    let rover = at_home.register(&here.name("rover")).await.unwrap();
    let arm = abroad.register(&there.name("arm")).await.unwrap();
    known(&at_home, arm.name()).await;
    for round in 0..10 {
        for (len, expected) in [(100, Kind::Udp), (200_000, Kind::Tcp), (20_000, Kind::Udp)] {
            let content = round.to_string().repeat(len);
            let sent = rover
                .send(inform(&rover, arm.name(), &content))
                .await
                .unwrap();
            assert_eq!(via(&sent), Some(expected), "{len} bytes");
            let attempts = sent.0[0].outcome.attempts();
            match expected {
                Kind::Tcp => {
                    assert_eq!(attempts.len(), 1, "{sent}");
                    assert_eq!(attempts[0].via, Kind::Udp);
                    assert_eq!(attempts[0].error.fault, TransportErrorKind::TooLarge);
                }
                _ => assert!(attempts.is_empty(), "{sent}"),
            }
            let incoming = arm.receive().await.unwrap();
            assert_eq!(incoming.message().content().unwrap(), &content);
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn hosts_discover_each_other_and_exchange_letters() {
    let (here, there) = (Host::new(&[]), Host::new(&[]));
    let (_near, at_home) = here.start().await;
    let (_far, abroad) = there.start().await;
    let rover = at_home.register(&here.name("rover")).await.unwrap();
    let arm = abroad.register(&there.name("arm")).await.unwrap();
    known(&at_home, arm.name()).await;
    known(&abroad, rover.name()).await;

    for number in 0..20 {
        let sent = rover
            .send(inform(&rover, arm.name(), number.to_string()))
            .await
            .unwrap();
        assert_eq!(via(&sent), Some(Kind::Tcp));
    }
    for number in 0..20 {
        let incoming = arm.receive().await.unwrap();
        assert_eq!(incoming.message().content().unwrap(), &number.to_string());
        assert!(
            incoming.letter().parse_envelope().unwrap().extensions.len() >= 2,
            "two stamps"
        );
    }
    // Loaned content passes through both gateways.
    let message = inform(&arm, rover.name(), "");
    let mut loan = arm.loan(message, 1 << 20).unwrap();
    loan.content_mut().fill(3);
    assert_eq!(via(&arm.send_loan(loan).await.unwrap()), Some(Kind::Tcp));
    assert_eq!(
        rover.receive().await.unwrap().message().content().unwrap(),
        &vec![3; 1 << 20]
    );

    // The deregistration of the remote agent becomes known here.
    drop(arm.deregister().unwrap());
    forgotten(&at_home, &there.name("arm")).await;
    let gone = rover
        .send(inform(&rover, &there.name("arm"), "?"))
        .await
        .unwrap();
    assert_eq!(reason(&gone), FailureReason::NoSuchAgent);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_slow_agent_on_another_host_holds_its_sender_back() {
    let (here, there) = (Host::new(&[]), Host::new(&["mts.queue=2"]));
    let (_near, at_home) = here.start().await;
    let (_far, abroad) = there.start().await;
    let rover = at_home.register(&here.name("rover")).await.unwrap();
    let arm = abroad.register(&there.name("arm")).await.unwrap();
    known(&at_home, arm.name()).await;
    for _ in 0..2 {
        via(&rover.send(inform(&rover, arm.name(), "x")).await.unwrap());
    }
    let short = Duration::from_secs(5);
    let late = rover
        .send_within(inform(&rover, arm.name(), "late"), short)
        .await
        .unwrap();
    assert_eq!(reason(&late), FailureReason::QueueFull, "{late}");
    let waiting = rover.send(inform(&rover, arm.name(), "in time"));
    let reading = async {
        for _ in 0..3 {
            arm.receive().await.unwrap();
        }
    };
    let (waiting, ()) = tokio::join!(waiting, reading);
    via(&waiting.unwrap());
}

#[tokio::test(flavor = "multi_thread")]
async fn agents_of_one_host_exchange_letters_without_their_gateway() {
    let (here, there) = (Host::new(&["mts.deadline=60s"]), Host::new(&[]));
    let near = Gateway::open(&here.config).await.unwrap();
    let _far = Gateway::open(&there.config).await.unwrap();
    let (at_home, next_door, abroad) = (
        Domain::open(&here.config).await.unwrap(),
        Domain::open(&here.config).await.unwrap(),
        Domain::open(&there.config).await.unwrap(),
    );
    let rover = at_home.register(&here.name("rover")).await.unwrap();
    let camera = next_door.register(&here.name("camera")).await.unwrap();
    let arm = abroad.register(&there.name("arm")).await.unwrap();
    known(&at_home, arm.name()).await;
    via(&rover
        .send(inform(&rover, arm.name(), "before"))
        .await
        .unwrap());

    near.close().await;
    forgotten(&at_home, arm.name()).await;
    let lost = rover
        .send(inform(&rover, arm.name(), "without the gateway"))
        .await
        .unwrap();
    assert_eq!(reason(&lost), FailureReason::NoSuchAgent);
    let sent = rover
        .send(inform(&rover, camera.name(), "on this host"))
        .await
        .unwrap();
    assert_eq!(via(&sent), Some(Kind::Shm));

    let _near = Gateway::open(&here.config).await.unwrap();
    known(&at_home, arm.name()).await;
    via(&rover
        .send(inform(&rover, arm.name(), "after"))
        .await
        .unwrap());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_second_gateway_of_a_domain_or_on_a_port_is_refused() {
    let host = Host::new(&["discovery.mdns=false"]);
    let gateway = Gateway::open(&host.config).await.unwrap();
    match Gateway::open(&host.config).await {
        Err(OpenError::GatewayRunning(name)) => assert_eq!(name, gateway.name()),
        Err(other) => panic!("{other}"),
        Ok(_) => panic!("two gateways"),
    }
    // A gateway with another name is refused, too.
    let mut another = host.config.clone();
    another.mts.name = "another-gateway".to_owned();
    assert!(matches!(
        Gateway::open(&another).await,
        Err(OpenError::GatewayRunning(name)) if name == gateway.name()
    ));
    let mut locations = gateway.locations().into_iter();
    let location = locations.find(|it| it.kind() == Kind::Tcp).unwrap();
    let taken = format!("transport.tcp.listen={}", location.address());
    let other = Host::new(&["discovery.mdns=false", &taken]);
    match Gateway::open(&other.config).await {
        Err(error @ OpenError::Listen { .. }) => {
            let error = ErrorChain(&error).to_string();
            assert!(error.contains(location.address()), "{error}");
        }
        Err(other) => panic!("{other}"),
        Ok(_) => panic!("two on one port"),
    }
    gateway.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_new_agent_that_sends_a_letter_can_be_answered_at_once() {
    let (here, there) = (Host::new(&[]), Host::new(&[]));
    let (_near, at_home) = here.start().await;
    let (_far, abroad) = there.start().await;
    let arm = abroad.register(&there.name("arm")).await.unwrap();
    known(&at_home, arm.name()).await;
    // The last one registers more often than agents become known by their letters.
    let names = ["one", "two", "three", "again", "again", "again", "again"];
    for name in names {
        // Its letter may arrive before its announcement.
        let newcomer = at_home.register(&here.name(name)).await.unwrap();
        via(&newcomer
            .send(inform(&newcomer, arm.name(), "hello"))
            .await
            .unwrap());
        let greeting = arm.receive().await.unwrap().into_message();
        let from = greeting.sender().unwrap().name().to_owned();
        assert_eq!(
            via(&arm.send(inform(&arm, &from, "welcome")).await.unwrap()),
            Some(Kind::Tcp)
        );
        assert_eq!(
            newcomer
                .receive()
                .await
                .unwrap()
                .message()
                .content()
                .unwrap(),
            "welcome"
        );
        newcomer.deregister().unwrap();
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn the_gateway_reports_the_routes_of_letters_and_their_state() {
    let here = Host::new(&[
        "mts.deadline=1s",
        "routes={ \"arm.*\" = [\"tcp\", \"unix\"] }",
    ]);
    let there = Host::new(&[]);
    let (near, at_home) = here.start().await;
    let (far, abroad) = there.start().await;
    let rover = at_home.register(&here.name("rover")).await.unwrap();
    let arm = abroad.register(&there.name("arm")).await.unwrap();
    known(&at_home, arm.name()).await;
    let timeout = Duration::from_secs(30);
    for _ in 0..5 {
        let letter = inform(&rover, arm.name(), "x");
        via(&rover.send_within(letter, timeout).await.unwrap());
    }
    let asker = at_home.register(&here.name("asker")).await.unwrap();
    let gateway = at_home.directory().lookup(near.name()).unwrap();
    let ask = || routes::of_gateway(&asker, &gateway, Some(arm.name()), timeout);

    let report = ask().await.unwrap();
    assert_eq!(report.incarnation, near.incarnation());
    let [route] = report.routes.as_slice() else {
        panic!("{report:?}");
    };
    assert_eq!(route.receiver, arm.name());
    assert_eq!(route.gateway, Some(far.incarnation()));
    assert_eq!(route.exception.as_deref(), Some("arm.*"));
    assert_eq!(route.ways[0].location.incarnation(), far.incarnation());
    assert_eq!(route.ways[0].standing, Standing::Ready);
    let location = &route.ways[0].location;
    let counted = report
        .ways
        .iter()
        .find(|it| it.location == *location)
        .unwrap();
    // The messages between the gateways use the same route, and count as well.
    assert!(counted.taken >= 5 && counted.failed == 0, "{counted:?}");
    let mut connected = report.neighbors.iter();
    assert!(connected.any(|it| it.incarnation == far.incarnation()));

    // The letters of this process go to the gateway, by the same entry of `[routes]`.
    let own = at_home.routes(&Query::all());
    let mut routes = own.routes.iter();
    let to_arm = routes.find(|it| it.receiver == arm.name()).unwrap();
    assert_eq!(to_arm.gateway, Some(near.incarnation()));
    assert_eq!(to_arm.exception.as_deref(), Some("arm.*"));
    assert_eq!(to_arm.ways[0].location.kind(), Kind::Unix);

    // A killed gateway sends no goodbye: attempts fail, and the report counts them.
    let mut killed = Some(far);
    drop(killed.take());
    let lost = rover.send(inform(&rover, arm.name(), "?")).await.unwrap();
    assert!(!lost.all_succeeded(), "{lost}");
    let report = ask().await.unwrap();
    let counted = report.ways.iter().find(|it| it.location == *location);
    let counted = counted.unwrap();
    assert!(counted.failed > 0, "{counted:?}");
    assert!(counted.last_error.is_some(), "{counted:?}");
    let ended = counted.taken + counted.failed;
    assert!(ended <= counted.tried, "{counted:?}");
}

/// Sends numbered letters, two at a time, and returns their outcomes.
async fn numbered(from: Arc<Agent>, to: String, numbers: std::ops::Range<u32>) -> Vec<Deliveries> {
    let sending = |number: u32| {
        let message = inform(&from, &to, number.to_string());
        let from = Arc::clone(&from);
        async move { from.send(message).await.unwrap() }
    };
    let mut outcomes = Vec::new();
    for number in numbers.step_by(2) {
        let (one, other) = tokio::join!(sending(number), sending(number + 1));
        outcomes.extend([one, other]);
    }
    outcomes
}

async fn numbers(agent: &Agent, count: u32) -> Vec<u32> {
    let mut all = Vec::new();
    while all.len() < count as usize {
        let message = agent.receive().await.unwrap().into_message();
        if *message.performative() == Performative::Inform {
            let content = message.content().unwrap().to_vec();
            all.push(String::from_utf8(content).unwrap().parse().unwrap());
        }
    }
    all
}

#[tokio::test(flavor = "multi_thread")]
async fn reloading_the_configuration_loses_no_letter() {
    const LETTERS: u32 = 2000;
    let (here, there) = (Host::new(&[]), Host::new(&[]));
    let (mut near, at_home) = here.start().await;
    let (_far, abroad) = there.start().await;
    let rover = Arc::new(at_home.register(&here.name("rover")).await.unwrap());
    let arm = abroad.register(&there.name("arm")).await.unwrap();
    known(&at_home, arm.name()).await;
    let sending = numbered(Arc::clone(&rover), arm.name().to_owned(), 0..LETTERS);
    let sending = tokio::spawn(sending);
    let reading = async {
        let received = numbers(&arm, LETTERS).await;
        assert_eq!(received, (0..LETTERS).collect::<Vec<_>>());
    };
    let changing = async {
        let mut config = here.config.clone();
        for round in 0_u16.. {
            let order = ["shm,unix,tcp", "tcp,unix,shm"][usize::from(round % 2)];
            config = here.configured(&[
                &format!("mts.transports={order}"),
                &format!("mts.deadline={}s", 5 + round % 3),
                "routes={ \"arm.*\" = [\"tcp\"] }",
                &format!(
                    "discovery.static={{ x = [\"tcp://127.0.0.1:{}\"] }}",
                    round % 9 + 1
                ),
            ]);
            assert_eq!(near.reload(&config).unwrap().later, Vec::<String>::new());
            if sending.is_finished() {
                break;
            }
            tokio::time::sleep(Duration::from_millis(2)).await;
        }
        config.transport.tcp.listen = vec!["127.0.0.1:1".to_owned()];
        config.mts.queue = 0;
        assert!(
            near.reload(&config).is_err(),
            "a configuration with mistakes is refused"
        );
        config.mts.queue = 7;
        let reloaded = near.reload(&config).unwrap();
        assert_eq!(reloaded.later, ["mts.queue", "transport.tcp.listen"]);
    };
    tokio::join!(reading, changing);
    for deliveries in sending.await.unwrap() {
        via(&deliveries);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn letters_in_transit_when_the_gateway_ends_have_an_outcome() {
    const LETTERS: u32 = 600;
    let (here, there) = (Host::new(&["mts.deadline=3s"]), Host::new(&[]));
    let (near, at_home) = here.start().await;
    let (_far, abroad) = there.start().await;
    let rover = Arc::new(at_home.register(&here.name("rover")).await.unwrap());
    let arm = Arc::new(abroad.register(&there.name("arm")).await.unwrap());
    known(&at_home, arm.name()).await;
    let sending = numbered(Arc::clone(&rover), arm.name().to_owned(), 0..LETTERS);
    let sending = tokio::spawn(sending);
    let reader = Arc::clone(&arm);
    let first = numbers(&reader, 50).await;
    near.close().await;
    let mut delivered = 0;
    for deliveries in sending.await.unwrap() {
        assert_eq!(deliveries.0.len(), 1);
        delivered += u32::from(deliveries.all_succeeded());
    }
    assert!(delivered < LETTERS, "the gateway has not ended");
    // Delivered letters have arrived in order. Letters with an unknown outcome may have arrived, too.
    let mut rest = numbers(&arm, delivered.saturating_sub(50)).await;
    rest.splice(0..0, first);
    assert!(rest.is_sorted_by(|a, b| a < b), "{rest:?}");
}

/// Ends the gateway of the sender's host or of the receiver's, while both have a letter in custody, and
/// returns the reason of its failure.
async fn ends_with_custody(near_ends: bool) -> FailureReason {
    let here = Host::new(&["mts.deadline=1h"]);
    let there = Host::new(&["mts.queue=1"]);
    let (near, at_home) = here.start().await;
    let (far, abroad) = there.start().await;
    let rover = at_home.register(&here.name("rover")).await.unwrap();
    let arm = abroad.register(&there.name("arm")).await.unwrap();
    let asker = abroad.register(&there.name("asker")).await.unwrap();
    known(&at_home, arm.name()).await;
    let entry = abroad.directory().lookup(far.name()).unwrap();
    let (ends, _continues) = match near_ends {
        true => (near, far),
        false => (far, near),
    };
    let first = rover.send(inform(&rover, arm.name(), "1")).await.unwrap();
    via(&first);
    // The queue of the receiver is full, and no task reads it.
    let second = rover.send(inform(&rover, arm.name(), "2"));
    let ending = async {
        let timeout = Duration::from_secs(60);
        let is_refused = |ways: &[RouteState]| {
            let mut local = ways
                .iter()
                .filter(|way| way.location.kind().is_host_local());
            local.any(|way| way.turned_back > 0)
        };
        loop {
            let report = routes::of_gateway(&asker, &entry, None, timeout).await;
            if is_refused(&report.unwrap().ways) {
                break;
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
        ends.close().await;
    };
    let ended = async { tokio::join!(second, ending) };
    // Without an outcome, the sender would wait for its deadline of an hour.
    let watchdog = Duration::from_secs(60);
    let (second, ()) = tokio::time::timeout(watchdog, ended).await.unwrap();
    reason(&second.unwrap())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_letter_in_the_custody_of_its_own_gateway_that_ends_has_an_outcome_at_once() {
    assert_eq!(ends_with_custody(true).await, FailureReason::Unconfirmed);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_letter_in_the_custody_of_the_other_gateway_that_ends_has_an_outcome_at_once() {
    let reason = ends_with_custody(false).await;
    // An attempt of that gateway may have been under way.
    assert!(
        matches!(
            reason,
            FailureReason::NoSuchAgent | FailureReason::Unreachable | FailureReason::Unconfirmed
        ),
        "{reason}"
    );
}
