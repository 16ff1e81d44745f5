//! The events that a watcher of a domain gets, and that watching does not affect agents.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod support;

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa::admin::watch::{Event, Fate, Passage, WatchOptions, Watcher};
use fipa::{
    Agent, AgentId, Config, Domain, FailureReason, Gateway, Kind, Message, Outcome, Performative,
};
use rustix::net::{AddressFamily, SendFlags, SocketAddrUnix, SocketType};
use support::config;

/// Ends a test that hangs.
const WATCHDOG: Duration = Duration::from_secs(60);

/// Returns the directory with the entries of the domain.
fn directory(config: &Config) -> PathBuf {
    let base = std::env::var_os("FIPA_RUNTIME_DIR").map_or_else(
        || format!("/tmp/fipa-{}", rustix::process::geteuid().as_raw()).into(),
        PathBuf::from,
    );
    base.join(&config.domain).join("directory")
}

/// Returns the socket of the watcher.
fn socket(config: &Config) -> Option<PathBuf> {
    let files = std::fs::read_dir(directory(config)).ok()?;
    let mut files = files.map(|file| file.unwrap().path());
    files.find(|path| path.extension().is_some_and(|it| it == "socket"))
}

fn request(from: &Agent, to: &str, content: &str) -> Message {
    from.message(Performative::Request)
        .receiver(AgentId::new(to).unwrap())
        .protocol("fipa-request")
        .conversation_id("c1")
        .content(content.to_owned())
        .build()
        .unwrap()
}

async fn next(watcher: &mut Watcher) -> Event {
    let next = tokio::time::timeout(WATCHDOG, watcher.next()).await;
    next.expect("an event arrives")
}

async fn letter(watcher: &mut Watcher) -> Arc<Passage> {
    match next(watcher).await {
        Event::Letter(passage) => passage,
        other => panic!("{other:?}"),
    }
}

/// Skips the letters before the next one with this length of the content.
async fn letter_of_len(watcher: &mut Watcher, len: u64) -> Arc<Passage> {
    loop {
        let passage = letter(watcher).await;
        if passage.content_len == Some(len) {
            return passage;
        }
    }
}

/// Sends letters until the watcher gets an event, because processes connect to it asynchronously.
async fn until_seen(watcher: &mut Watcher, from: &Agent, to: &str) {
    loop {
        from.send(request(from, to, "are you watched?"))
            .await
            .unwrap();
        if tokio::time::timeout(Duration::from_millis(50), watcher.next())
            .await
            .is_ok()
        {
            break;
        }
    }
    // Skips all events before this letter.
    from.send(request(from, to, "yes")).await.unwrap();
    letter_of_len(watcher, 3).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn each_letter_yields_one_event_with_its_outcome() {
    let config = config(&[]);
    let (here, there) = (
        Domain::open(&config).await.unwrap(),
        Domain::open(&config).await.unwrap(),
    );
    let rover = here.register("rover").await.unwrap();
    let arms = [
        there.register("arm_1").await.unwrap(),
        there.register("arm_2").await.unwrap(),
    ];
    let mut watcher = Watcher::open(&config, WatchOptions::default())
        .await
        .unwrap();
    until_seen(&mut watcher, &rover, "arm_1").await;
    until_seen(&mut watcher, &arms[0], "rover").await;

    rover
        .send(request(&rover, "arm_1", "lift sample-3"))
        .await
        .unwrap();
    let seen = letter(&mut watcher).await;
    assert_eq!((seen.sender(), &*seen.receiver), (Some("rover"), "arm_1"));
    assert_eq!(seen.stream.sender, rover.incarnation());
    assert_eq!(seen.stream.receiver, arms[0].incarnation());
    let message = seen.message.as_ref().unwrap();
    assert_eq!(*message.performative(), Performative::Request);
    assert_eq!(message.protocol(), Some("fipa-request"));
    assert_eq!(message.conversation_id(), Some("c1"));
    assert_eq!(
        (seen.content_len, seen.content.len()),
        (Some(13), 0),
        "content is not included by default"
    );
    let envelope = seen.envelope.get().unwrap();
    assert_eq!(envelope.base.from.as_ref().unwrap().name(), "rover");
    assert_eq!(seen.via, Some(Kind::Shm));
    assert!(matches!(
        &seen.fate,
        Fate::Settled(Outcome::Delivered { via: Kind::Shm, .. })
    ));

    // The letters of one message to several receivers have the same send number.
    rover.send(request(&rover, "arm_.*", "all")).await.unwrap();
    let (one, two) = (letter(&mut watcher).await, letter(&mut watcher).await);
    assert_ne!(one.receiver, two.receiver);
    assert!(one.submission.is_some() && one.submission == two.submission);

    // A letter that fails, and the failure message to its sender.
    rover
        .send(request(&rover, "unknown", "hello?"))
        .await
        .unwrap();
    let failed = letter(&mut watcher).await;
    let Fate::Settled(Outcome::Failed { reason, .. }) = &failed.fate else {
        panic!("{failed:?}");
    };
    assert_eq!(
        (&*failed.receiver, *reason),
        ("unknown", FailureReason::NoSuchAgent)
    );
    let failure = letter(&mut watcher).await;
    assert_eq!(
        *failure.message.as_ref().unwrap().performative(),
        Performative::Failure
    );
    assert!(failure.from_service && !failed.from_service);

    // A process that joins later is watched, too.
    let late = Domain::open(&config).await.unwrap();
    let late = late.register("late").await.unwrap();
    until_seen(&mut watcher, &late, "rover").await;
    assert!(watcher.directory().lookup("late").is_some());
}

#[tokio::test(flavor = "multi_thread")]
async fn only_a_watcher_that_requests_content_gets_it() {
    let config = config(&[]);
    let domain = Domain::open(&config).await.unwrap();
    let (rover, _arm) = (
        domain.register("rover").await.unwrap(),
        domain.register("arm").await.unwrap(),
    );
    let options = WatchOptions { content: 4 };
    let (mut with_content, mut without_content) = (
        Watcher::open(&config, options).await.unwrap(),
        Watcher::open(&config, WatchOptions::default())
            .await
            .unwrap(),
    );
    until_seen(&mut with_content, &rover, "arm").await;
    until_seen(&mut without_content, &rover, "arm").await;
    rover.send(request(&rover, "arm", "secret")).await.unwrap();
    // Events of the earlier letters may arrive first.
    let seen = letter_of_len(&mut with_content, 6).await;
    assert_eq!(&seen.content[..], b"secr");
    let seen = letter_of_len(&mut without_content, 6).await;
    assert!(seen.content.is_empty());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_dropped_watcher_removes_its_files() {
    let config = config(&[]);
    let domain = Domain::open(&config).await.unwrap();
    let (rover, arm) = (
        domain.register("rover").await.unwrap(),
        domain.register("arm").await.unwrap(),
    );
    for _ in 0..3 {
        let mut watcher = Watcher::open(&config, WatchOptions::default())
            .await
            .unwrap();
        assert!(socket(&config).is_some());
        until_seen(&mut watcher, &rover, "arm").await;
        drop(watcher);
        assert!(socket(&config).is_none());
        rover
            .send(request(&rover, "arm", "alone again"))
            .await
            .unwrap();
    }
    drop((rover, arm));
    domain.close().await;
    assert!(!directory(&config).exists());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_watcher_that_does_not_read_delays_no_agent_and_gets_the_count_of_lost_records() {
    const LETTERS: u64 = 12_000;
    const CONTENT: usize = 1000;
    let config = config(&[]);
    let (here, there) = (
        Domain::open(&config).await.unwrap(),
        Domain::open(&config).await.unwrap(),
    );
    let rover = here.register("rover").await.unwrap();
    let arm = there.register("arm").await.unwrap();
    let reading = tokio::spawn(async move {
        let mut last = String::new();
        while last != "end" {
            let content = arm.receive().await.unwrap().message().content().cloned();
            last = String::from_utf8(content.unwrap().to_vec()).unwrap();
            last.truncate(last.trim_end().len());
        }
        arm
    });
    let options = WatchOptions { content: CONTENT };
    let mut watcher = Watcher::open(&config, options).await.unwrap();
    until_seen(&mut watcher, &rover, "arm").await;
    for number in 0..LETTERS {
        // The queue of the watcher does not hold so much.
        let content = format!("{number:<CONTENT$}");
        let deliveries = rover.send(request(&rover, "arm", &content)).await.unwrap();
        assert!(deliveries.all_succeeded(), "{deliveries}");
    }
    rover.send(request(&rover, "arm", "end")).await.unwrap();
    let _arm = tokio::time::timeout(WATCHDOG, reading)
        .await
        .unwrap()
        .unwrap();

    let (mut seen, mut lost) = (0, BTreeMap::new());
    // Reads all queued records; the last one of a process has the count of lost ones.
    loop {
        match tokio::time::timeout(Duration::from_secs(2), watcher.next()).await {
            Ok(Event::Letter(_)) => seen += 1,
            Ok(Event::Lost { process, records }) => {
                *lost.entry(process.to_string()).or_insert(0) += records;
            }
            Ok(Event::Later(_) | Event::Confirmed(_)) => {}
            Ok(other) => panic!("{other:?}"),
            Err(_) => break,
        }
    }
    let all: u64 = lost.values().sum();
    assert!(seen > 0 && seen < LETTERS, "{seen} seen");
    // Per letter, the sender sends two records and the receiver one.
    assert!(all > 0 && all <= 3 * (LETTERS + 1), "{lost:?}");
    assert!(seen + all >= LETTERS, "{seen} seen, {lost:?}");
    assert!(
        lost.keys()
            .all(|name| name.contains(&std::process::id().to_string())),
        "{lost:?}"
    );
    // Later letters are seen again.
    until_seen(&mut watcher, &rover, "arm").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn invalid_records_are_refused_without_effect_on_others() {
    let config = config(&[]);
    let domain = Domain::open(&config).await.unwrap();
    let (rover, _arm) = (
        domain.register("rover").await.unwrap(),
        domain.register("arm").await.unwrap(),
    );
    let mut watcher = Watcher::open(&config, WatchOptions::default())
        .await
        .unwrap();
    until_seen(&mut watcher, &rover, "arm").await;
    let address = SocketAddrUnix::new(socket(&config).unwrap()).unwrap();
    for nonsense in [&b"hello"[..], b"fipw\x09", &[0; 60_000], &[0xff; 96]] {
        let socket = rustix::net::socket(AddressFamily::UNIX, SocketType::SEQPACKET, None).unwrap();
        rustix::net::connect(&socket, &address).unwrap();
        rustix::net::send(&socket, nonsense, SendFlags::empty()).unwrap();
        let Event::Refused { process, why } = next(&mut watcher).await else {
            panic!("{nonsense:?} was not refused");
        };
        assert_eq!(&*process, format!("process {}", std::process::id()));
        assert!(why.to_string().starts_with("not a record"), "{why}");
    }
    // A process that connects and sends nothing, and one that disconnects at once.
    let silent = rustix::net::socket(AddressFamily::UNIX, SocketType::SEQPACKET, None).unwrap();
    rustix::net::connect(&silent, &address).unwrap();
    let gone = rustix::net::socket(AddressFamily::UNIX, SocketType::SEQPACKET, None).unwrap();
    rustix::net::connect(&gone, &address).unwrap();
    drop(gone);
    rover
        .send(request(&rover, "arm", "still there"))
        .await
        .unwrap();
    assert_eq!(letter(&mut watcher).await.content_len, Some(11));
}

#[tokio::test(flavor = "multi_thread")]
async fn the_outcome_of_the_only_letter_of_a_process_is_seen() {
    let config = config(&[]);
    let there = Domain::open(&config).await.unwrap();
    let arm = there.register("arm").await.unwrap();
    let mut watcher = Watcher::open(&config, WatchOptions::default())
        .await
        .unwrap();
    let own = there.register("own").await.unwrap();
    until_seen(&mut watcher, &own, "own").await;
    // Fills the queue of the arm.
    let moment = Duration::from_millis(200);
    let began = Instant::now();
    let mut filling = true;
    while filling {
        assert!(began.elapsed() < WATCHDOG, "the queue is not full");
        let one = own.send_within(request(&own, "arm", "one"), moment);
        let outcome = &one.await.unwrap().0[0].outcome;
        filling = !matches!(
            outcome,
            Outcome::Failed {
                reason: FailureReason::QueueFull,
                ..
            }
        );
    }
    for number in 0..5 {
        let here = Domain::open(&config).await.unwrap();
        let name = format!("rover_{number}");
        let rover = here.register(&name).await.unwrap();
        let only = request(&rover, "arm", "only");
        let deliveries = rover.send_within(only, moment).await.unwrap();
        let Outcome::Failed {
            reason: expected, ..
        } = deliveries.0[0].outcome
        else {
            panic!("{deliveries}");
        };
        drop(rover);
        here.close().await;
        let seen = loop {
            let seen = letter(&mut watcher).await;
            // The failure message to the sender is a letter, too.
            if seen.sender() == Some(&name) {
                break seen;
            }
        };
        let Fate::Settled(Outcome::Failed { reason, .. }) = &seen.fate else {
            panic!("{seen:?}");
        };
        assert_eq!((&*seen.receiver, *reason), ("arm", expected));
    }
    drop(arm);
}

/// Starts a host with a gateway that knows the gateway at this address, and a watcher.
async fn watched(peer: Option<&str>) -> (Gateway, Domain, Watcher) {
    let known = peer.map(|address| format!("discovery.static={{ far = [\"tcp://{address}\"] }}"));
    let config = config(known.as_deref().as_slice());
    let gateway = Gateway::open(&config).await.unwrap();
    let domain = Domain::open(&config).await.unwrap();
    let watcher = Watcher::open(&config, WatchOptions::default()).await;
    (gateway, domain, watcher.unwrap())
}

async fn known(domain: &Domain, name: &str) {
    let mut changes = domain.directory().watch();
    while domain.directory().lookup(name).is_none() {
        let change = tokio::time::timeout(WATCHDOG, changes.next()).await;
        assert!(change.unwrap().is_some());
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn between_hosts_each_watcher_sees_a_letter_once_with_its_gateway() {
    let (far, abroad, mut watching_far) = watched(None).await;
    let mut locations = far.locations().into_iter();
    let location = locations.find(|it| it.kind() == Kind::Tcp).unwrap();
    let at = location.address();
    let (near, at_home, mut watching_near) = watched(Some(at)).await;
    let rover = at_home.register("rover").await.unwrap();
    let arm = abroad.register("arm").await.unwrap();
    known(&at_home, "arm").await;
    known(&abroad, "rover").await;
    // Waits until both processes have connected to their watchers.
    for (watcher, from) in [(&mut watching_near, &rover), (&mut watching_far, &arm)] {
        until_seen(watcher, from, from.name()).await;
    }
    let ends = async |watcher: &mut Watcher, content: u64| loop {
        let seen = letter(watcher).await;
        if seen.content_len == Some(content) && seen.sender() != Some(&*seen.receiver) {
            return seen;
        }
    };
    // Waits until both gateways have connected to their watchers, too.
    loop {
        let sent = rover.send(request(&rover, "arm", "known?")).await.unwrap();
        assert!(sent.all_succeeded(), "{sent}");
        let near = ends(&mut watching_near, 6).await;
        let far = ends(&mut watching_far, 6).await;
        if near.gateway.is_some() && far.gateway.is_some() {
            break;
        }
    }
    for (from, to, content) in [(&rover, "arm", "there"), (&arm, "rover", "and back")] {
        let sent = from.send(request(from, to, content)).await.unwrap();
        assert!(sent.all_succeeded(), "{sent}");
        let leaves_near = to == "arm";
        let content = content.len() as u64;
        let at_near = ends(&mut watching_near, content).await;
        let at_far = ends(&mut watching_far, content).await;
        assert_eq!(at_near.gateway.as_deref(), Some(near.name()));
        assert_eq!(at_far.gateway.as_deref(), Some(far.name()));
        assert_eq!(at_near.from_elsewhere, !leaves_near);
        assert_eq!(at_far.from_elsewhere, leaves_near);
        assert_eq!(
            (at_near.via, at_far.via),
            (Some(Kind::Tcp), Some(Kind::Tcp))
        );
        // The sender's host reports the outcome; the other host reports that the letter was received.
        let (own, other) = if leaves_near {
            (&at_near.fate, &at_far.fate)
        } else {
            (&at_far.fate, &at_near.fate)
        };
        assert!(
            matches!(own, Fate::Settled(outcome) if outcome.is_success()),
            "{own:?}"
        );
        assert!(
            matches!(other, Fate::Taken | Fate::Passed(Outcome::Delivered { .. })),
            "{other:?}"
        );
        assert_eq!(at_near.sequence, at_far.sequence);
        assert_eq!(at_near.stream, at_far.stream);
    }
    // There are no further events of these letters; letters between the gateways are ignored.
    let mut others = Vec::new();
    while let Ok(Event::Letter(seen)) =
        tokio::time::timeout(Duration::from_millis(500), watching_near.next()).await
    {
        others.push(seen);
    }
    assert!(
        others
            .iter()
            .all(|seen| seen.message.as_ref().unwrap().conversation_id() != Some("c1")),
        "{others:?}"
    );
}
