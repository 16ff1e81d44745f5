//! The metrics of a gateway, with real processes.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;
#[path = "common/listener.rs"]
mod listener;

use std::collections::BTreeMap;
use std::fs;
use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::time::Duration;

use common::Host;
use fipa::blocking::Wait;
use fipa::config::Sources;
use fipa::{Agent, Config, Domain, Kind, Message, Performative};
use fipa_testbed::{Waits, until};
use listener::Shown;

/// Timeout for hanging tests.
const WATCHDOG: Duration = Duration::from_secs(60);

/// Maximum number of series of a host without neighbors.
const MAX_SERIES: usize = 200;

/// Starts a gateway that shows metrics.
fn shown(host: &Host, listen: &str, settings: &[&str]) -> Shown {
    let settings = [&["http.names=[\"rover.example\"]"], settings].concat();
    Shown::start(host, listen, &settings)
}

impl Shown {
    /// The status and the body of the answer to a request with these lines after the first.
    fn ask(&self, path: &str, headers: &str) -> (u16, String) {
        let (status, _, body) = self.exchange(&format!("GET {path} HTTP/1.1\r\n{headers}\r\n"));
        (status, body)
    }

    fn admitted(&self) -> String {
        format!("Host: {}\r\n{}", self.address, self.bearer())
    }

    /// Waits until a series has this value.
    #[track_caller]
    fn until(&self, series: &str, value: f64) {
        let what = format!("{series} is {value}");
        until(&what, || self.values()[series] == value);
    }

    /// The values by their series.
    fn values(&self) -> BTreeMap<String, f64> {
        let (status, text) = self.ask("/metrics", &self.admitted());
        assert_eq!(status, 200, "{text}");
        let lines = text.lines().filter(|line| !line.starts_with('#'));
        let values = lines.map(|line| {
            let (series, value) = line.rsplit_once(' ').unwrap();
            (series.to_owned(), value.parse().unwrap())
        });
        values.collect()
    }
}

fn letters(direction: &str, transport: &str, outcome: &str) -> String {
    format!(
        "fipa_letters_total{{direction=\"{direction}\",transport=\"{transport}\",outcome=\"{outcome}\"}}"
    )
}

#[test]
fn letters_of_all_processes_are_counted_and_stay_counted_when_these_end() {
    let host = Host::new();
    let shown = shown(&host, "127.0.0.1:0", &[]);
    let echo = host.echo("echo");
    let before = shown.values();
    assert_eq!(before.get(&letters("sent", "shm", "delivered")), None);

    let ping = ["ping", "echo", "--count", "20", "--interval", "1ms"];
    host.run(&ping).done();
    let (failed, _) = host.run(&["send", "nobody_here", "text"]).failed_text();
    assert!(!failed.is_empty());
    shown.until(UNDER_WAY, 0.0);
    shown.until(QUEUED, 0.0);
    let counted = shown.values();
    let delivered = counted[&letters("sent", "shm", "delivered")];
    assert!(delivered >= 20.0, "{counted:#?}");
    assert_eq!(counted[&letters("received", "shm", "delivered")], delivered);
    assert_eq!(counted[&letters("sent", "none", "failed")], 1.0);
    assert_eq!(
        counted["fipa_delivery_seconds_count{transport=\"shm\"}"],
        delivered
    );

    // A killed process counted, too, and another one now keeps its counters.
    let (code, _) = echo.signal("-KILL");
    assert_eq!(code, None);
    host.run(&["agents"]).done();
    let _again = host.echo("echo");
    host.run(&ping).done();
    let kept = shown.values();
    assert!(kept[&letters("sent", "shm", "delivered")] >= delivered + 20.0);
    assert!(kept.len() <= MAX_SERIES, "{} series", kept.len());
    let falls = |(series, value): (&String, &f64)| {
        let is_counter = ["_total", "_bucket", "_count", "_sum"]
            .iter()
            .any(|end| series.split('{').next().unwrap().ends_with(end));
        is_counter && kept.get(series).is_none_or(|later| later < value)
    };
    let fallen: Vec<_> = counted.iter().filter(|it| falls(*it)).collect();
    assert!(fallen.is_empty(), "{fallen:?}");
}

#[test]
fn counters_survive_the_removal_of_their_files() {
    let host = Host::new();
    let shown = shown(&host, "127.0.0.1:0", &[]);
    let mut echo = host.start(&["-v", "echo", "echo"]);
    let ping = ["ping", "echo", "--count", "10", "--interval", "1ms"];
    host.run(&ping).done();
    let received = letters("received", "shm", "delivered");
    let before = shown.values()[&received];
    let directory = host.path("run").join(&host.domain).join("directory");
    let files = fs::read_dir(&directory)
        .unwrap()
        .map(|file| file.unwrap().path());
    let counts = files.filter(|file| file.to_string_lossy().ends_with(".counts"));
    for file in counts.collect::<Vec<_>>() {
        fs::remove_file(file).unwrap();
    }
    echo.wait_for_log(&["joined the domain", "again"]);
    host.run(&ping).done();
    let after = shown.values()[&received];
    assert!(after >= before + 10.0, "{before} {after}");
}

#[test]
fn violations_are_counted_by_protocol() {
    let host = Host::new();
    let shown = shown(&host, "[::1]:0", &[]);
    let mut echo = host.start(&["echo", "echo", "--set", "monitor.check=warn"]);
    let text = [
        "send",
        "echo",
        "text",
        "-p",
        "inform",
        "--conversation-id",
        "c1",
    ];
    let protocol = ["--protocol", "fipa-request"];
    host.run(&[&text[..], &protocol].concat()).done();
    echo.wait_for_log(&["violates its protocol"]);
    let values = shown.values();
    let violations = |protocol| format!("fipa_violations_total{{protocol=\"{protocol}\"}}");
    assert_eq!(values[&violations("fipa-request")], 1.0, "{values:#?}");
    assert_eq!(values[&violations("other")], 0.0);
    let (status, _) = shown.ask("/readyz", &shown.admitted());
    assert_eq!(status, 200);
}

/// Joins the domain of a host with this process.
fn join(host: &Host) -> Domain {
    let mut sources = Sources::default();
    let directory = host.path("run");
    sources.set = vec![
        format!("domain={}", host.domain),
        format!("runtime_dir={}", directory.display()),
        "discovery.mdns=false".to_owned(),
    ];
    let config = Config::load(&sources).unwrap();
    Domain::open(&config).wait().unwrap()
}

fn inform(from: &Agent, to: &str) -> Message {
    let message = from.message(Performative::Inform).receiver(to);
    message.content("text").build().unwrap()
}

const QUEUED: &str = "fipa_letters_queued";
const UNDER_WAY: &str = "fipa_letters_under_way";

/// Sends letters to an agent that does not read, and then reads two of five.
#[track_caller]
fn letters_wait(from: &Agent, to: &Agent, over: Kind, shown: &Shown) {
    shown.until(QUEUED, 0.0);
    for number in 1..=5 {
        let sent = from.send(inform(from, to.name())).wait().unwrap();
        assert_eq!(sent.0[0].outcome.via(), Some(over), "{sent}");
        shown.until(QUEUED, f64::from(number));
    }
    for left in [4, 3] {
        to.receive_within(WATCHDOG).wait().unwrap().unwrap();
        shown.until(QUEUED, f64::from(left));
    }
}

#[test]
fn letters_that_an_agent_does_not_read_are_queued_until_it_reads_or_ends() {
    let host = Host::new();
    let shown = shown(&host, "127.0.0.1:0", &[]);
    let (one, other) = (join(&host), join(&host));
    let rover = one.register("rover").wait().unwrap();
    let arm = other.register("arm").wait().unwrap();
    letters_wait(&rover, &arm, Kind::Shm, &shown);
    assert_eq!(arm.deregister().unwrap().len(), 3);
    shown.until(QUEUED, 0.0);
    one.close().wait();
    other.close().wait();
}

/// Two hosts whose gateways are connected over TCP at this address.
fn letters_wait_at_another_host(address: &str) {
    let (near, far) = (Host::new(), Host::new());
    let listen = format!("transport.tcp.listen=[\"{address}:0\"]");
    let named = |name: &str| format!("mts.name={name}-{}", near.domain);
    let far_shown = shown(&far, "127.0.0.1:0", &[&listen, &named("far")]);
    let at = far_shown.gateway.tcp_address();
    let knows = format!("discovery.static={{ far = [\"tcp://{at}\"] }}");
    let settings = [&*listen, &knows, &named("near")];
    let near_shown = shown(&near, "127.0.0.1:0", &settings);
    let (here, there) = (join(&near), join(&far));
    let rover = here.register("rover").wait().unwrap();
    let arm = there.register("arm").wait().unwrap();
    until("the arm is known", || {
        here.directory().known("arm").is_some()
    });
    letters_wait(&rover, &arm, Kind::Tcp, &far_shown);
    near_shown.until(QUEUED, 0.0);

    // The other host is silent: the letter has no outcome, and waits on this one.
    near_shown.until(UNDER_WAY, 0.0);
    far_shown.gateway.send_signal("-STOP");
    let sent = rover.send_within(inform(&rover, "arm"), WATCHDOG);
    // The gateways write letters to each other, too.
    assert!(near_shown.values()[UNDER_WAY] >= 1.0);
    far_shown.gateway.send_signal("-CONT");
    let sent = sent.wait().unwrap();
    assert!(sent.all_succeeded(), "{sent}");
    near_shown.until(UNDER_WAY, 0.0);
    far_shown.until(QUEUED, 4.0);
    // The letters that are not read end with their agent.
    there.close().wait();
    far_shown.until(QUEUED, 0.0);
    here.close().wait();
}

#[test]
fn letters_for_another_host_are_queued_there_or_under_way_here_over_ipv4() {
    letters_wait_at_another_host("127.0.0.1");
}

#[test]
fn letters_for_another_host_are_queued_there_or_under_way_here_over_ipv6() {
    letters_wait_at_another_host("[::1]");
}

#[test]
fn a_question_for_metrics_wakes_no_other_process() {
    const QUESTIONS: u64 = 200;
    let host = Host::new();
    let shown = shown(&host, "127.0.0.1:0", &[]);
    let echo = host.echo("echo");
    host.run(&["ping", "echo", "--count", "1"]).done();
    let before = Waits::of(echo.pid());
    for _ in 0..QUESTIONS {
        shown.values();
    }
    let waited = Waits::of(echo.pid()).since(&before);
    // The process has work of its own from time to time.
    assert!(
        waited < QUESTIONS / 2,
        "{waited} wake-ups of another process"
    );
}

#[test]
fn requests_without_the_token_or_under_another_name_are_refused() {
    let host = Host::new();
    let shown = shown(&host, "127.0.0.1:0", &[]);
    let own = format!("Host: {}\r\n", shown.address);
    let token = format!("Authorization: Bearer {}\r\n", shown.token);
    for path in ["/metrics", "/healthz", "/readyz"] {
        assert_eq!(shown.ask(path, &format!("{own}{token}")).0, 200, "{path}");
        for (headers, expected) in [
            (own.clone(), 401),
            (
                format!("{own}Authorization: Bearer 0{}\r\n", shown.token),
                401,
            ),
            (format!("{own}Authorization: Bearer \r\n"), 401),
            (
                format!("{own}Authorization: Basic {}\r\n", shown.token),
                401,
            ),
            (format!("Host: evil.example\r\n{token}"), 421),
            (format!("{own}Host: evil.example\r\n{token}"), 421),
            (token.clone(), 421),
            (format!("Host: ROVER.example:80\r\n{token}"), 200),
        ] {
            let (status, body) = shown.ask(path, &headers);
            assert_eq!(status, expected, "{path} {headers} {body}");
            assert!(!body.contains(&shown.token));
        }
    }
    let (status, _) = shown.ask("/other", &shown.admitted());
    assert_eq!(status, 404);
    // A whole URI in the first line.
    for (host, expected) in [("evil.example", 421), ("localhost:80", 200)] {
        let path = format!("http://{host}/metrics");
        assert_eq!(shown.ask(&path, &shown.admitted()).0, expected, "{host}");
    }
    // A client that closes its side after the request.
    let mut stream = shown.connect();
    write!(stream, "GET /metrics HTTP/1.1\r\n{}\r\n", shown.admitted()).unwrap();
    stream.shutdown(std::net::Shutdown::Write).unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    assert!(answer.starts_with("HTTP/1.1 200 "), "{answer}");
    let long = format!("{own}{token}X: {}\r\n", "x".repeat(20_000));
    let mut stream = shown.connect();
    // The gateway may close the connection before it has read all.
    let _ = write!(stream, "GET /metrics HTTP/1.1\r\n{long}\r\n");
    let mut answer = Vec::new();
    let _ = stream.read_to_end(&mut answer);
    assert!(!answer.windows(5).any(|it| it == b"fipa_"));

    // More connections than the gateway keeps, which send nothing: others get their turn.
    let idle: Vec<TcpStream> = (0..64).map(|_| shown.connect()).collect();
    assert_eq!(shown.ask("/healthz", &shown.admitted()).0, 200);
    drop(idle);
}

#[test]
fn a_wrong_configuration_is_explained() {
    let host = Host::new();
    for (setting, parts) in [
        ("http.listen=0.0.0.0:0", ["http.listen", "127.0.0.1"]),
        ("http.listen=9790", ["http.listen", "127.0.0.1"]),
        ("http.token_file=~/token", ["http.token_file", "full path"]),
    ] {
        let error = host.run(&["up", "--set", setting]).failed(2);
        for part in parts {
            assert!(error.contains(part), "{error}");
        }
    }
    let open = host.path("open.token");
    fs::write(&open, "0123456789abcdef\n").unwrap();
    let file = format!("http.token_file={}", open.display());
    let listen = "http.listen=127.0.0.1:0";
    let (_, error) = host
        .run(&["up", "--set", listen, "--set", &file])
        .failed_text();
    assert!(error.contains("chmod 600"), "{error}");
    // No advice to change or delete a device.
    let file = "http.token_file=/dev/zero";
    let (_, error) = host
        .run(&["up", "--set", listen, "--set", file])
        .failed_text();
    let is_named = error.contains("regular file") && error.contains("http.token_file");
    assert!(is_named && !error.contains("delete"), "{error}");
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let listen = format!("http.listen={}", taken.local_addr().unwrap());
    let (_, error) = host.run(&["up", "--set", &listen]).failed_text();
    assert!(error.contains("ss -ltnp"), "{error}");
}
