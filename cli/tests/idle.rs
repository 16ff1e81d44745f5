//! Processes without work sleep.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;

use std::thread;
use std::time::{Duration, Instant};

use common::Host;
use fipa_testbed::Waits;

/// A test that never finds its processes idle fails after this time.
const WATCHDOG: Duration = Duration::from_secs(60);

/// Longer than the timers of polling loops, which this test is to detect.
const WINDOW: Duration = Duration::from_secs(10);

#[test]
fn idle_processes_do_not_wake_up() {
    let host = Host::new();
    let agent = host.echo("rover");
    let gateway = host.start(&["up", "--json"]);
    // A check every five seconds wakes a process four times in a window.
    let most = [(agent.pid(), 1), (gateway.pid(), 5)];
    let began = Instant::now();
    loop {
        let before = most.each_ref().map(|(pid, _)| Waits::of(*pid));
        thread::sleep(WINDOW);
        let counts =
            [0, 1].map(|process: usize| Waits::of(most[process].0).since(&before[process]));
        if counts
            .iter()
            .zip(&most)
            .all(|(count, (_, most))| count <= most)
        {
            return;
        }
        assert!(began.elapsed() < WATCHDOG, "wake-ups: {counts:?}");
    }
}
