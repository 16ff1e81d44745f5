//! Processes without work sleep.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;

use std::collections::HashMap;
use std::ffi::OsString;
use std::fs;
use std::thread;
use std::time::{Duration, Instant};

use common::Host;

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
        let before = most.each_ref().map(|(pid, _)| wake_ups(pid));
        thread::sleep(WINDOW);
        let after = most.each_ref().map(|(pid, _)| wake_ups(pid));
        let counts = [0, 1].map(|process: usize| {
            let threads = after[process].iter();
            let new = threads.map(|(thread, count)| match before[process].get(thread) {
                Some(earlier) => count - earlier,
                None => *count,
            });
            new.sum::<u64>()
        });
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

/// The number of times that each thread of a process waited.
fn wake_ups(pid: &str) -> HashMap<OsString, u64> {
    let threads = fs::read_dir(format!("/proc/{pid}/task")).unwrap();
    let counts = threads.filter_map(|thread| {
        let thread = thread.unwrap();
        // The thread may end meanwhile.
        let status = fs::read_to_string(thread.path().join("status")).ok()?;
        let mut lines = status.lines();
        let count = lines.find_map(|line| line.strip_prefix("voluntary_ctxt_switches:"))?;
        Some((thread.file_name(), count.trim().parse().unwrap()))
    });
    counts.collect()
}
