//! A host whose certificate is revoked: its agents, its services, and the letters for it.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod support;

use std::fs;
use std::time::{Duration, Instant};

use fipa::admin::keys::{Keys, VALID};
use fipa::admin::routes;
use fipa::platform::ServiceDescription;
use fipa::{Agent, Config, Domain, FailureReason, Gateway, Kind, Outcome};
use fipa_testbed::until_async;
use support::{config, inform, mark};

/// Time limit of all waits, which a passing test does not reach.
const TIMEOUT: Duration = Duration::from_secs(60);

/// Number and length of the letters, of which only some fit into the receiver's queue and the custody of
/// its gateway.
const LETTERS: usize = 60;
const LETTER: usize = 10_000;

fn with_keys(keys: &Keys, set: &[&str]) -> Config {
    let mut config = config(&[&["mts.deadline=30s", "security.loopback=true"], set].concat());
    config.security.keys = keys.dir().display().to_string();
    keys.init(&config.mts.name, &[], VALID).unwrap();
    config
}

fn trust(keys: &Keys, other: &Keys) {
    keys.trust(&fs::read(other.own_file()).unwrap()).unwrap();
}

async fn knows(domain: &Domain, name: &str) {
    until_async(name, || domain.directory().lookup(name).is_some()).await;
}

/// Waits until the gateway has been told so many times that a letter finds no room.
async fn turned_back(asker: &Agent, gateway: &Gateway, times: u64) {
    let gateway = gateway.directory().known(gateway.name()).unwrap();
    loop {
        let report = routes::of_gateway(asker, &gateway, None, TIMEOUT).await;
        let ways = report.unwrap().ways;
        let abroad = ways.iter().filter(|way| way.location.kind() == Kind::Tcp);
        if abroad.map(|way| way.turned_back).sum::<u64>() >= times {
            return;
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_revoked_host_ends_with_its_agents_its_services_and_the_letters_for_it() {
    let dir = tempfile::tempdir().unwrap();
    let [near_keys, far_keys] = ["near", "far"].map(|name| Keys::at(dir.path().join(name)));
    let far_config = with_keys(&far_keys, &["mts.queue_bytes=64KiB"]);
    // The keys of both exist before a gateway reads them.
    let mut near_config = with_keys(&near_keys, &[]);
    trust(&near_keys, &far_keys);
    trust(&far_keys, &near_keys);
    let far = Gateway::open(&far_config).await.unwrap();
    let locations = far.locations();
    let at = locations.iter().find(|it| it.kind() == Kind::Tcp).unwrap();
    let peer = format!(
        "discovery.static={{ \"far\" = [\"tcp://{}\"] }}",
        at.address()
    );
    near_config.discovery = config(&[&peer]).discovery;
    let near = Gateway::open(&near_config).await.unwrap();
    let (ours, theirs) = (
        Domain::open(&near_config).await.unwrap(),
        Domain::open(&far_config).await.unwrap(),
    );
    let mark = mark();
    // It takes no letter out of its queue.
    let arm = theirs.register(&format!("arm-{mark}")).await.unwrap();
    let crane = theirs.register(&format!("crane-{mark}")).await.unwrap();
    let facilitator = crane.df().unwrap();
    let lift = ServiceDescription::new("lift-1", "lifting");
    facilitator.register_service(lift).await.unwrap();
    let [rover, asker] = ["rover", "asker"].map(|name| format!("{name}-{mark}"));
    let rover = ours.register(&rover).await.unwrap();
    let asker = ours.register(&asker).await.unwrap();
    let (arm, crane) = (arm.name().to_owned(), crane.name().to_owned());
    knows(&ours, &arm).await;
    let df = rover.df().unwrap();
    let lifting = ServiceDescription::of_type("lifting").into();
    while df.search(&lifting).await.unwrap().is_empty() {}

    let mut letters = tokio::task::JoinSet::new();
    for _ in 0..LETTERS {
        let letter = inform(&rover, &arm, vec![b'x'; LETTER]);
        letters.spawn(rover.send(letter));
    }
    turned_back(&asker, &near, LETTERS as u64).await;
    near_keys.revoke(&far_config.mts.name).unwrap();
    let mut refused = 0;
    for deliveries in letters.join_all().await {
        match &deliveries.unwrap().0[0].outcome {
            outcome if outcome.is_success() => {}
            Outcome::Failed { reason, attempts } => match reason {
                FailureReason::Refused => {
                    let attempts = format!("{attempts:?}");
                    let why = "the trust in the certificate of";
                    assert!(attempts.contains(why), "{attempts}");
                    refused += 1;
                }
                // The revoked host may have taken it.
                reason => assert_eq!(*reason, FailureReason::Unconfirmed),
            },
            outcome => panic!("{outcome:?}"),
        }
    }
    assert!(refused > 0);

    until_async("the agents have left", || {
        [&arm, &crane].map(|name| ours.directory().known(name)) == [None, None]
    })
    .await;
    // A host that has only lost its connection may return, and its agents are unreachable.
    let after = rover.send(inform(&rover, &arm, "again")).await.unwrap();
    let outcome = &after.0[0].outcome;
    let is_unknown = matches!(
        outcome,
        Outcome::Failed { reason: FailureReason::NoSuchAgent, attempts } if attempts.is_empty()
    );
    assert!(is_unknown, "{outcome:?}");
    let begun = Instant::now();
    while !df.search(&lifting).await.unwrap().is_empty() {
        assert!(begun.elapsed() < TIMEOUT, "the facilitator still has it");
    }
    assert!(near.neighbors().is_empty());
}

/// A platform such as JADE has no gateway whose certificate belongs to its agents.
#[cfg(feature = "http")]
#[tokio::test(flavor = "multi_thread")]
async fn letters_for_a_revoked_platform_end_as_refused() {
    let dir = tempfile::tempdir().unwrap();
    let [near_keys, far_keys] = ["near", "far"].map(|name| Keys::at(dir.path().join(name)));
    let over_https = [
        r#"mts.transports=["shm", "unix", "https"]"#,
        r#"transport.https.listen=["127.0.0.1:0"]"#,
    ];
    let platform = |keys: &Keys| {
        let own = format!("security.keys={:?}", keys.dir());
        with_keys(keys, &[&over_https[..], &[&own]].concat())
    };
    let far_config = platform(&far_keys);
    let mut near_config = platform(&near_keys);
    trust(&near_keys, &far_keys);
    trust(&far_keys, &near_keys);
    let far = Gateway::open(&far_config).await.unwrap();
    let locations = far.locations();
    let at = locations.iter().find(|it| it.kind() == Kind::Https);
    let at = at.unwrap().address().to_owned();
    let theirs = Domain::open(&far_config).await.unwrap();
    let mark = mark();
    let arm = theirs.register(&format!("arm-{mark}")).await.unwrap();
    let platform = format!(
        "discovery.static={{ \"{}\" = [\"https://{at}\"] }}",
        arm.name()
    );
    near_config.discovery = config(&[&platform]).discovery;
    let _near = Gateway::open(&near_config).await.unwrap();
    let ours = Domain::open(&near_config).await.unwrap();
    let rover = ours.register(&format!("rover-{mark}")).await.unwrap();
    knows(&ours, arm.name()).await;
    let send = || rover.send(inform(&rover, arm.name(), "down"));
    let before = send().await.unwrap();
    assert!(before.0[0].outcome.is_success(), "{before:?}");
    near_keys.revoke(&far_config.mts.name).unwrap();
    // The gateway reads its keys a moment later.
    let refused = loop {
        match &send().await.unwrap().0[0].outcome {
            outcome if outcome.is_success() => {}
            // It was under way when the connection ended.
            Outcome::Failed { reason, .. } if *reason == FailureReason::Unconfirmed => {}
            Outcome::Failed { reason, attempts } => break (*reason, format!("{attempts:?}")),
            outcome => panic!("{outcome:?}"),
        }
    };
    assert_eq!(refused.0, FailureReason::Refused);
    let why = "the trust in the certificate of the platform was withdrawn";
    assert!(refused.1.contains(why), "{}", refused.1);
}
