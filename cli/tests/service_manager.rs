//! The notifications of `fipa up` to a service manager: readiness, reloads, the end, and the watchdog.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;

use std::fs;
use std::io::ErrorKind;
use std::os::unix::net::UnixDatagram;
use std::time::Duration;

use common::{Host, Running};

/// Timeout for hanging tests. No step is expected to take this long.
const TIMEOUT: Duration = Duration::from_secs(60);

/// The time after which systemd would restart the gateway.
const WATCHDOG: Duration = Duration::from_millis(200);

/// The socket of a service manager.
struct Manager(UnixDatagram);

impl Manager {
    fn new(host: &Host) -> Self {
        let socket = UnixDatagram::bind(host.path("notify")).unwrap();
        socket.set_read_timeout(Some(TIMEOUT)).unwrap();
        Self(socket)
    }

    /// Returns the lines of the next notification, or `None` if none arrives within the timeout of the socket.
    fn received(&self) -> Option<Vec<String>> {
        let mut buffer = [0; 4096];
        match self.0.recv(&mut buffer) {
            Ok(len) => {
                let text = std::str::from_utf8(&buffer[..len]).unwrap();
                Some(text.lines().map(str::to_owned).collect())
            }
            Err(error) if error.kind() == ErrorKind::WouldBlock => None,
            Err(error) => panic!("{error}"),
        }
    }

    /// Waits for the next notification that is not one of the watchdog, and checks its first line.
    #[track_caller]
    fn next(&self, first: &str) -> Vec<String> {
        loop {
            let lines = self.received().expect("no notification");
            if lines != ["WATCHDOG=1"] {
                assert_eq!(lines[0], first, "{lines:?}");
                return lines;
            }
        }
    }

    /// Waits for the next notification, which must be one of the watchdog.
    #[track_caller]
    fn watchdog(&self) {
        assert_eq!(self.received().expect("no notification"), ["WATCHDOG=1"]);
    }
}

/// Starts a gateway as a service manager does.
fn start(host: &Host, watchdog: Option<Duration>) -> Running {
    let mut command = host.command(&["up", "--json", "--set", "mts.name=sherpa"]);
    command.env("NOTIFY_SOCKET", host.path("notify"));
    if let Some(watchdog) = watchdog {
        command.env("WATCHDOG_USEC", watchdog.as_micros().to_string());
    }
    Running::new(command)
}

#[test]
fn the_gateway_reports_its_start_its_reloads_and_its_end() {
    let host = Host::new();
    let manager = Manager::new(&host);
    let mut gateway = start(&host, None);
    let ready = manager.next("READY=1");
    let status = format!("STATUS=gateway sherpa of domain {}", host.domain);
    assert_eq!(ready[1..], [status]);
    let listed = host.run(&["agents", "--json"]).done_json();
    assert_eq!(listed["gateway"], "sherpa");

    fs::write(host.path("fipa.toml"), "[mts]\ndeadline = \"9s\"\n").unwrap();
    gateway.send_signal("-HUP");
    let reloading = manager.next("RELOADING=1");
    let time = reloading[1].strip_prefix("MONOTONIC_USEC=").unwrap();
    assert!(time.parse::<u64>().unwrap() > 0);
    let ready = manager.next("READY=1");
    assert_eq!(ready[1..], ["STATUS=configuration reloaded"]);

    fs::write(host.path("fipa.toml"), "nonsense").unwrap();
    gateway.send_signal("-HUP");
    manager.next("RELOADING=1");
    let ready = manager.next("READY=1");
    assert!(ready[1].contains("previous configuration"), "{ready:?}");

    gateway.send_signal("-INT");
    manager.next("STOPPING=1");
    let (code, log) = gateway.end();
    assert_eq!(code, Some(0), "{log}");
    manager.0.set_nonblocking(true).unwrap();
    assert_eq!(manager.received(), None);
}

#[test]
fn a_gateway_that_works_satisfies_the_watchdog_and_a_stopped_one_does_not() {
    let host = Host::new();
    let manager = Manager::new(&host);
    let mut gateway = start(&host, Some(WATCHDOG));
    manager.next("READY=1");
    for _ in 0..3 {
        manager.watchdog();
    }

    gateway.send_signal("-STOP");
    manager.0.set_nonblocking(true).unwrap();
    while manager.received().is_some() {}
    manager.0.set_nonblocking(false).unwrap();
    manager.0.set_read_timeout(Some(5 * WATCHDOG)).unwrap();
    assert_eq!(manager.received(), None);

    gateway.send_signal("-CONT");
    manager.0.set_read_timeout(Some(TIMEOUT)).unwrap();
    for _ in 0..3 {
        manager.watchdog();
    }
    gateway.send_signal("-INT");
    manager.next("STOPPING=1");
    let (code, log) = gateway.end();
    assert_eq!(code, Some(0), "{log}");
}

#[test]
fn a_missing_service_manager_does_not_end_the_gateway() {
    let host = Host::new();
    let mut gateway = start(&host, Some(WATCHDOG));
    gateway.wait_for_log(&["WARN", "cannot notify the service manager"]);
    let listed = host.run(&["agents", "--json"]).done_json();
    assert_eq!(listed["gateway"], "sherpa");
    let (code, log) = gateway.signal("-INT");
    assert_eq!(code, Some(0), "{log}");
}
