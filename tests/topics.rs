//! Topics between processes: streams, slow and stopped subscribers, latched contents, and publishers that end and return.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]
#![allow(clippy::print_stdout, reason = "a child process reports by its output")]

mod support;

use std::io::{BufRead, BufReader, Lines};
use std::path::Path;
use std::process::{Child, ChildStdout, Stdio};
use std::time::Duration;

use fipa::blocking::Wait;
use fipa::protocol::{DialogueError, Keep, Notification};
use fipa::topics::{NotificationResult, Publisher, Topic};
use fipa::{Agent, Config, Domain, Gateway, Kind, Performative};
use fipa_testbed::{ignored_test, send_signal, until_async};
use support::{config, load, mark};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::tcp::{OwnedReadHalf, OwnedWriteHalf};
use tokio::net::{TcpListener, TcpStream};
use tokio::time::Instant;

/// Time limit of all calls, which a passing test does not reach.
const TIMEOUT: Duration = Duration::from_secs(60);

/// Length of an image in bytes.
const IMAGE: usize = 1 << 20;

/// Settings of a domain that a child process joins, too.
fn shared(domain: &str) -> Config {
    load([
        format!("domain={domain}"),
        "discovery.mdns=false".to_owned(),
    ])
}

async fn subscribed(
    agent: &Agent,
    keep: Keep,
    topic: &str,
) -> Result<fipa::protocol::Subscription, DialogueError> {
    let subscribe = agent.message(Performative::Subscribe).receiver("camera");
    let subscribe = subscribe.content(topic.to_owned());
    agent.subscribe_keeping(keep, subscribe, TIMEOUT).await
}

/// A process that prints the notifications it gets.
struct Viewer {
    process: Child,
    lines: Lines<BufReader<ChildStdout>>,
}

/// A line of a viewer.
#[derive(Debug, PartialEq, Eq)]
struct Seen {
    number: u64,
    missed: u64,
    /// The byte that fills the image.
    fill: u8,
}

impl Viewer {
    fn start(domain: &str, name: &str, keep: Keep) -> Self {
        let mut process = ignored_test("inside_viewer")
            .env("FIPA_TOPICS_DOMAIN", domain)
            .env("FIPA_TOPICS_NAME", name)
            .env("FIPA_TOPICS_KEEP", keep.to_string())
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut lines = BufReader::new(process.stdout.take().unwrap()).lines();
        let mut all = lines.by_ref().map_while(Result::ok);
        assert!(all.any(|line| line.ends_with("subscribed")), "{name}");
        Self { process, lines }
    }

    /// Waits for the next notification.
    fn seen(&mut self) -> Seen {
        let mut lines = self.lines.by_ref().map_while(Result::ok);
        let line = lines.find(|line| line.starts_with("got ")).unwrap();
        let mut values = line.split(' ').skip(1).map(|it| it.parse().unwrap());
        let mut value = || values.next().unwrap();
        Seen {
            number: value(),
            missed: value(),
            fill: u8::try_from(value()).unwrap(),
        }
    }

    fn signal(&self, signal: &str) {
        send_signal(self.process.id(), signal);
    }
}

impl Drop for Viewer {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

#[test]
#[ignore = "is run by the other tests in a process of its own"]
fn inside_viewer() {
    let variable = |name: &str| std::env::var(format!("FIPA_TOPICS_{name}")).unwrap();
    let domain = Domain::open(&shared(&variable("DOMAIN"))).wait().unwrap();
    let viewer = domain.register(&variable("NAME")).wait().unwrap();
    let keep = variable("KEEP").parse().unwrap();
    let mut images = subscribed(&viewer, keep, "image").wait().unwrap();
    println!("\nsubscribed");
    loop {
        let image = match images.next().wait() {
            Ok(image) => image,
            Err(error) if images.goes_on() => {
                println!("lost {error}");
                continue;
            }
            Err(_) => return,
        };
        let content = image.content().unwrap();
        let fill = content.first().copied().unwrap_or_default();
        assert!(content.iter().all(|byte| *byte == fill), "a torn image");
        println!("got {} {} {fill}", image.number().unwrap(), image.missed());
    }
}

/// Publishes an image that is filled with the low byte of its number.
async fn publish_image(camera: &Publisher, number: u64) -> fipa::topics::Publication {
    let mut loan = camera.loan(IMAGE).unwrap();
    loan.content_mut().fill(number.to_le_bytes()[0]);
    let published = camera.publish_loan(loan).await;
    assert_eq!(published.number(), number);
    published
}

/// Number of segments of shared content in a domain.
fn segments(domain: &str) -> usize {
    let files = std::fs::read_dir(Path::new("/dev/shm")).unwrap();
    let names = files.filter_map(|file| file.unwrap().file_name().into_string().ok());
    names
        .filter(|name| name.contains(domain) && name.ends_with(".content"))
        .count()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stopped_viewer_slows_neither_the_camera_nor_other_viewers() {
    const IMAGES: u64 = 90;
    let name = format!("topics-{}", mark());
    let domain = Domain::open(&shared(&name)).await.unwrap();
    let agent = domain.register("camera").await.unwrap();
    let camera = agent.publisher(Topic::new("image").rate(30.0)).unwrap();
    let start = |viewer: &str| Viewer::start(&name, viewer, Keep::Auto);
    let (mut one, mut two, mut stopped) = (start("one"), start("two"), start("stopped"));
    until_async("all have subscribed", || camera.subscribers() == 3).await;

    let mut results = tokio::task::JoinSet::new();
    let mut most = 0;
    for number in 1..=IMAGES {
        if number == 15 {
            assert_eq!(stopped.seen().number, 1);
            stopped.signal("-STOP");
        }
        let published = publish_image(&camera, number).await;
        assert_eq!(published.subscribers(), 3);
        results.spawn(published.results());
        let fill = number.to_le_bytes()[0];
        let expected = Seen {
            number,
            missed: 0,
            fill,
        };
        // The next image is published when these two have this one.
        assert_eq!(one.seen(), expected);
        assert_eq!(two.seen(), expected);
        most = most.max(segments(&name));
    }
    // That of the stopped viewer, the newest one, the next one, and one that a viewer is about to release.
    assert!(most <= 5, "{most} segments");

    stopped.signal("-CONT");
    let mut last = Vec::new();
    while last.last().is_none_or(|seen: &Seen| seen.number < IMAGES) {
        last.push(stopped.seen());
    }
    // Those before the stop, the one that was under way, and the newest.
    let after: Vec<&Seen> = last.iter().filter(|seen| seen.number >= 15).collect();
    assert!(after.len() <= 3, "{last:?}");
    let missed: u64 = last.iter().map(|seen| seen.missed).sum();
    assert!(missed >= IMAGES - 18, "{last:?}");

    let mut replaced = 0;
    while let Some(result) = results.join_next().await {
        for notified in result.unwrap() {
            match notified.result {
                NotificationResult::Replaced => {
                    assert_eq!(notified.subscriber, "stopped");
                    replaced += 1;
                }
                result => assert!(result.is_success(), "{result:?}"),
            }
        }
    }
    assert!(replaced >= IMAGES - 18, "{replaced} replaced");
    drop((one, two, stopped));
    domain.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn each_of_many_stopped_viewers_holds_one_image() {
    const VIEWERS: u64 = 16;
    let name = format!("topics-{}", mark());
    let domain = Domain::open(&shared(&name)).await.unwrap();
    let agent = domain.register("camera").await.unwrap();
    let camera = agent.publisher(Topic::new("image").rate(30.0)).unwrap();
    let viewers = 0..VIEWERS;
    let viewers = viewers.map(|viewer| Viewer::start(&name, &format!("v{viewer}"), Keep::Auto));
    let mut viewers: Vec<Viewer> = viewers.collect();
    until_async("all have subscribed", || {
        camera.subscribers() == viewers.len()
    })
    .await;
    // The next image finds one more viewer stopped.
    for number in 1..=VIEWERS {
        let stopped = usize::try_from(number).unwrap() - 1;
        viewers[stopped].signal("-STOP");
        drop(publish_image(&camera, number).await);
        for viewer in &mut viewers[stopped + 1..] {
            assert_eq!(viewer.seen().number, number);
        }
    }
    // Each stopped viewer holds another image. The newest ones wait, and the next one is written.
    for number in VIEWERS + 1..VIEWERS + 20 {
        drop(publish_image(&camera, number).await);
    }
    let held = segments(&name);
    let most = usize::try_from(VIEWERS).unwrap() + 3;
    assert!(held <= most, "{held} segments");
    for viewer in &mut viewers {
        viewer.signal("-CONT");
        while viewer.seen().number < VIEWERS + 19 {}
    }
    drop(viewers);
    domain.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stopped_viewer_of_all_images_delays_the_camera_and_its_images_fail_in_the_end() {
    let name = format!("topics-{}", mark());
    let domain = Domain::open(&shared(&name)).await.unwrap();
    let agent = domain.register("camera").await.unwrap();
    let topic = Topic::new("image").wait_for_slow(Duration::from_millis(1));
    let camera = agent.publisher(topic).unwrap();
    let mut stopped = Viewer::start(&name, "stopped", Keep::All);
    stopped.signal("-STOP");
    let mut results = Vec::new();
    for number in 1..=80_u8 {
        let published = camera.publish(vec![number; 10]).await;
        results.push(tokio::spawn(published.results()));
    }
    stopped.signal("-CONT");
    let mut too_slow = 0;
    for result in results {
        let notified = result.await.unwrap().remove(0);
        match notified.result {
            NotificationResult::TooSlow => too_slow += 1,
            result => assert!(result.is_success(), "{result:?}"),
        }
    }
    // One was under way, and 64 waited. On a busy machine, the first one leaves late.
    assert!(matches!(too_slow, 15 | 16), "{too_slow}");
    let (mut last, mut missed) = (0, 0);
    for _ in 0..80 - too_slow {
        let seen = stopped.seen();
        assert_eq!(seen.number, last + 1 + seen.missed);
        last = seen.number;
        missed += seen.missed;
    }
    assert!(last >= 64, "{last}");
    let last = camera.publish(vec![81; 10]).await;
    assert_eq!(last.delivered().await, 1);
    let seen = stopped.seen();
    assert_eq!((seen.number, seen.fill), (81, 81));
    assert_eq!(missed + seen.missed, too_slow);
    // The domain that closes last removes the files of a process that was killed.
    drop(stopped);
    domain.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_new_subscriber_gets_the_latched_contents_at_once() {
    let config = config(&[]);
    let (here, there) = support::two(&config).await;
    let agent = here.register("camera").await.unwrap();
    let map = agent.publisher(Topic::new("map").latched(2)).unwrap();
    for content in ["a", "b", "c"] {
        assert_eq!(map.publish(content).await.subscribers(), 0);
    }
    let rover = there.register("rover").await.unwrap();
    let mut all = subscribed(&rover, Keep::All, "map").await.unwrap();
    let mut newest = subscribed(&rover, Keep::latest(1), "map").await.unwrap();
    let text = |notification: Notification| notification.text();
    assert_eq!(text(all.next().await.unwrap()), "b");
    assert_eq!(text(all.next().await.unwrap()), "c");
    let newest = newest.next().await.unwrap();
    assert_eq!((newest.text(), newest.missed()), ("c".into(), 0));
    assert!(newest.age().unwrap() < TIMEOUT);
}

#[tokio::test(flavor = "multi_thread")]
async fn each_notification_names_its_language_and_ontology() {
    let (here, there) = support::two(&config(&[])).await;
    let agent = here.register("camera").await.unwrap();
    let pose = Topic::new("pose").language("json").ontology("poses");
    let (pose, map) = (agent.publisher(pose.latched(1)), agent.publisher("map"));
    let (pose, map) = (pose.unwrap(), map.unwrap());
    pose.publish("{}").await;
    let rover = there.register("rover").await.unwrap();
    let mut poses = subscribed(&rover, Keep::All, "pose").await.unwrap();
    for _ in 0..2 {
        let notification = poses.next().await.unwrap();
        assert_eq!(notification.language(), Some("json"));
        assert_eq!(notification.ontology(), Some("poses"));
        pose.publish("{}").await;
    }
    let mut maps = subscribed(&rover, Keep::All, "map").await.unwrap();
    map.publish("a").await;
    let notification = maps.next().await.unwrap();
    assert_eq!(notification.language(), None);
    assert_eq!(notification.ontology(), None);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_program_that_does_not_read_keeps_the_newest_and_other_messages_arrive() {
    let (here, there) = support::two(&config(&[])).await;
    let agent = here.register("camera").await.unwrap();
    let camera = agent.publisher(Topic::new("image").rate(100.0)).unwrap();
    let rover = there.register("rover").await.unwrap();
    let mut images = subscribed(&rover, Keep::latest(3), "image").await.unwrap();
    for number in 1..=2_000_u32 {
        let published = camera.publish(number.to_string()).await;
        // The rover's process is not stopped, so each one is delivered.
        assert_eq!(published.delivered().await, 1);
    }
    let hello = agent.message(Performative::Inform).receiver("rover");
    assert!(agent.send(hello).await.unwrap().all_succeeded());
    let received = rover.receive_within(TIMEOUT).await.unwrap().unwrap();
    assert_eq!(received.message().content(), None);
    let mut numbers = Vec::new();
    while numbers.last() != Some(&2_000) {
        numbers.push(images.next().await.unwrap().number().unwrap());
    }
    // A task reads them, and may not have read the last ones when the first call returns.
    assert!(numbers.len() < 1_000, "{} were kept", numbers.len());
    assert!(numbers.ends_with(&[1_998, 1_999, 2_000]), "{numbers:?}");
    // The notifications name their times in milliseconds.
    tokio::time::sleep(Duration::from_millis(2)).await;
    camera.publish("later").await;
    assert_eq!(images.next().await.unwrap().number(), Some(2_001));
    assert!(images.rate().unwrap() > 0.0);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_dropped_subscription_ends_at_the_publisher() {
    let (here, there) = support::two(&config(&[])).await;
    let agent = here.register("camera").await.unwrap();
    let camera = agent.publisher("image").unwrap();
    let rover = there.register("rover").await.unwrap();
    for keep in [Keep::All, Keep::latest(1)] {
        drop(subscribed(&rover, keep, "image").await.unwrap());
        while camera.publish("x").await.subscribers() > 0 {
            tokio::task::yield_now().await;
        }
    }
    // No notification takes its place in the queue of the rover.
    let hello = agent.message(Performative::Inform).receiver("rover");
    assert!(agent.send(hello).await.unwrap().all_succeeded());
    let received = rover.receive_within(TIMEOUT).await.unwrap().unwrap();
    assert_eq!(received.message().content(), None);
}

/// Forwards connections to a gateway, each byte after this delay. Returns its address.
async fn distance(to: String, delay: Duration) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let at = listener.local_addr().unwrap().to_string();
    tokio::spawn(async move {
        loop {
            let (near, _) = listener.accept().await.unwrap();
            let Ok(far) = TcpStream::connect(&to).await else {
                continue;
            };
            let ((near_in, near_out), (far_in, far_out)) = (near.into_split(), far.into_split());
            tokio::spawn(delayed(near_in, far_out, delay));
            tokio::spawn(delayed(far_in, near_out, delay));
        }
    });
    at
}

async fn delayed(mut from: OwnedReadHalf, mut to: OwnedWriteHalf, delay: Duration) {
    let (sender, mut receiver) = tokio::sync::mpsc::unbounded_channel();
    tokio::spawn(async move {
        while let Some((due, bytes)) = receiver.recv().await {
            tokio::time::sleep_until(due).await;
            let bytes: Vec<u8> = bytes;
            if to.write_all(&bytes).await.is_err() {
                return;
            }
        }
    });
    let mut bytes = vec![0; 64 << 10];
    while let Ok(len @ 1..) = from.read(&mut bytes).await {
        let _ = sender.send((Instant::now() + delay, bytes[..len].to_vec()));
    }
}

/// One image under way would be one image per round trip.
#[tokio::test(flavor = "multi_thread")]
async fn two_images_are_under_way_to_a_distant_viewer() {
    let near_config = config(&[]);
    let near = Gateway::open(&near_config).await.unwrap();
    let at = |gateway: &Gateway| {
        let locations = gateway.locations();
        let tcp = locations.iter().find(|it| it.kind() == Kind::Tcp).unwrap();
        tcp.address().to_owned()
    };
    let address = distance(at(&near), Duration::from_millis(100)).await;
    let peer = format!("discovery.static={{ \"near\" = [\"tcp://{address}\"] }}");
    let far_config = config(&[&peer]);
    let _far = Gateway::open(&far_config).await.unwrap();
    let there = Domain::open(&far_config).await.unwrap();
    let here = Domain::open(&near_config).await.unwrap();
    let camera = there.register("camera").await.unwrap();
    let viewer = here.register("viewer").await.unwrap();
    let operator = there.register("operator").await.unwrap();
    let images = camera.publisher(Topic::new("image").rate(100.0)).unwrap();
    until_async("the viewer knows the camera", || {
        viewer.domain().directory().lookup("camera").is_some()
    })
    .await;
    let mut seen = subscribed(&viewer, Keep::Auto, "image").await.unwrap();
    let mut numbers = Vec::new();
    let watch = async {
        loop {
            let status = operator.topics_of(camera.id()).await.unwrap();
            // Two under way, and the newest one.
            if status[0].first_subscribers[0].waiting == 3 {
                break;
            }
        }
    };
    tokio::select! {
        watched = tokio::time::timeout(TIMEOUT, watch) => watched.unwrap(),
        () = async {
            loop {
                images.publish(vec![7; 1000]).await;
                tokio::time::sleep(Duration::from_millis(10)).await;
            }
        } => {}
        () = async {
            loop {
                numbers.push(seen.next().await.unwrap().number().unwrap());
            }
        } => {}
    }
    assert!(numbers.is_sorted(), "{numbers:?}");
}
