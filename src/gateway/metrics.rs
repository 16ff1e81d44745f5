//! The values that the gateway shows at `http.listen`.

use std::collections::BTreeMap;
use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_acl::ErrorChain;
use fipa_sds::{Directory, Reach};
use fipa_transport::counts::{self, Direction, Event, LetterOutcome, Totals};
use parking_lot::Mutex;
use tokio::sync::watch;

use super::neighbors::Neighbors;
use super::self_check::SelfCheck;
use crate::domain::service::Service;
use crate::web::{Families, Source};

/// Time for the letter of a readiness check.
const CHECK_TIMEOUT: Duration = Duration::from_secs(5);

/// Maximum number of hosts with values of their own.
const MAX_HOSTS: usize = 256;

/// The sources of the values.
pub(super) struct Shown {
    pub(super) service: Arc<Service>,
    pub(super) view: Arc<dyn Directory>,
    pub(super) neighbors: Arc<Neighbors>,
    pub(super) check: SelfCheck,
    pub(super) discovery_problem: watch::Receiver<Option<String>>,
    /// The counters at the last question, below which they never fall: a process that is killed while it keeps the
    /// counters of another one loses those.
    pub(super) shown: Mutex<Totals>,
}

impl Source for Shown {
    fn metrics(&self) -> Result<Families, String> {
        let counted = self.service.counting.totals(&self.service.host);
        let counted = counted.map_err(|error| ErrorChain(&error).to_string())?;
        let mut all = counted.running.clone();
        all.add(&counted.ended);
        {
            let mut shown = self.shown.lock();
            all.at_least(&shown);
            shown.clone_from(&all);
        }
        let mut families = Families::default();
        letters(&mut families, &all);
        waiting(&mut families, &counted.running);
        violations(&mut families, &all);
        self.gateway(&mut families);
        self.hosts(&mut families);
        #[cfg(feature = "shm")]
        self.memory(&mut families);
        families.process();
        Ok(families)
    }

    fn readiness(&self) -> Pin<Box<dyn Future<Output = Result<(), String>> + Send + '_>> {
        Box::pin(async {
            let passed = self.check.pass_letter(CHECK_TIMEOUT).await;
            passed.map_err(|error| ErrorChain(&error).to_string())?;
            match &*self.discovery_problem.borrow() {
                Some(problem) => Err(format!("other hosts are not discovered: {problem}")),
                None => Ok(()),
            }
        })
    }
}

impl Shown {
    fn gateway(&self, families: &mut Families) {
        let version = env!("CARGO_PKG_VERSION");
        families
            .gauge("fipa_build_info", "The version of the gateway.")
            .count(&[("version", version)], 1);
        let entries = self.view.entries();
        let local = entries.iter().filter(|it| it.reach == Reach::Local).count();
        let mut agents = families.gauge("fipa_agents", "Agents in the directory of the gateway.");
        agents.count(&[("host", "this")], local as u64);
        agents.count(&[("host", "other")], (entries.len() - local) as u64);
        drop(agents);
        families
            .gauge(
                "fipa_custody_bytes",
                "Bytes of letters that the gateway holds until they are delivered.",
            )
            .count(&[], self.service.mts.held_bytes() as u64);
    }

    /// Values of other hosts. Several with one name count as one.
    fn hosts(&self, families: &mut Families) {
        let ways = self.service.mts.ways();
        let mut hosts: BTreeMap<String, Host> = BTreeMap::new();
        for neighbor in self.neighbors.all() {
            let host = hosts.entry(neighbor.entry.name.to_string()).or_default();
            host.connections += neighbor.connections as u64;
            let incarnation = neighbor.entry.incarnation;
            for way in ways
                .iter()
                .filter(|way| way.location.incarnation() == incarnation)
            {
                let times = [host.answer_micros, way.answer_micros];
                host.answer_micros = times.into_iter().flatten().min();
                host.tried += way.tried;
                host.failed += way.failed;
                host.in_flight += way.in_flight;
            }
        }
        for lost in self.neighbors.lost(Instant::now()) {
            hosts.entry(lost.name).or_default();
        }
        let hosts: Vec<(String, Host)> = hosts.into_iter().take(MAX_HOSTS).collect();
        let mut show = |name, help, value: fn(&Host) -> Option<f64>| {
            let mut gauge = families.gauge(name, help);
            for (name, host) in &hosts {
                if let Some(value) = value(host) {
                    gauge.value(&[("host", name)], value);
                }
            }
        };
        show(
            "fipa_peer_connections",
            "Open connections with the gateway of a host; 0 for a host that was lost within the last hour.",
            |host| Some(host.connections as f64),
        );
        show(
            "fipa_peer_rtt_seconds",
            "Smoothed time from handing a letter to the gateway of a host to its answer.",
            |host| host.answer_micros.map(|micros| micros as f64 / 1e6),
        );
        show(
            "fipa_peer_letters_in_flight",
            "Letters that were handed to a host and have no answer yet.",
            |host| Some(host.in_flight as f64),
        );
        show(
            "fipa_peer_attempts",
            "Attempts to hand a letter to the host, at its present locations.",
            |host| Some(host.tried as f64),
        );
        show(
            "fipa_peer_failed_attempts",
            "Failed attempts among them.",
            |host| Some(host.failed as f64),
        );
    }

    #[cfg(feature = "shm")]
    fn memory(&self, families: &mut Families) {
        use fipa_transport_shm::{ShmConfig, inspect};
        let (dir, own) = (&self.service.dir, self.service.own.incarnation);
        let config = ShmConfig::new(dir.memory(), dir.prefix(), own);
        // Without shared memory, there is nothing to show.
        let Ok(found) = inspect(&config) else {
            return;
        };
        for (name, help, value) in [
            (
                "fipa_shm_used_bytes",
                "Shared memory that the domain uses on this host.",
                found.used,
            ),
            (
                "fipa_shm_free_bytes",
                "Shared memory that is free on this host.",
                found.free,
            ),
            (
                "fipa_shm_processes",
                "Processes of the domain with shared memory on this host.",
                found.alive as u64,
            ),
        ] {
            families.gauge(name, help).count(&[], value);
        }
    }
}

/// Values of another host.
#[derive(Default)]
struct Host {
    connections: u64,
    answer_micros: Option<u64>,
    tried: u64,
    failed: u64,
    in_flight: u64,
}

fn letters(families: &mut Families, all: &Totals) {
    let mut letters = families.counter(
        "fipa_letters_total",
        "Letters that the processes of the domain on this host sent, received and forwarded, once for each receiver.",
    );
    for direction in Direction::ALL {
        for via in counts::transports() {
            for outcome in LetterOutcome::ALL {
                let number = all.letters(direction, via, outcome);
                if number > 0 {
                    let transport = via.map_or("none", |via| via.name());
                    let labels = [
                        ("direction", direction.name()),
                        ("transport", transport),
                        ("outcome", outcome.name()),
                    ];
                    letters.count(&labels, number);
                }
            }
        }
    }
    drop(letters);
    let mut times = families.histogram(
        "fipa_delivery_seconds",
        "Time from sending a letter to its outcome, at the sender.",
    );
    for via in counts::transports() {
        let found = all.delivery_times(via);
        if found.count > 0 {
            times.times(
                &[("transport", via.map_or("none", |via| via.name()))],
                &found,
            );
        }
    }
    drop(times);
    for (name, help, event) in [
        (
            "fipa_failed_attempts_total",
            "Attempts to deliver a letter that failed; most are retried.",
            Event::FailedAttempt,
        ),
        (
            "fipa_failure_messages_total",
            "Failure messages to the senders of letters.",
            Event::FailureMessage,
        ),
    ] {
        families.counter(name, help).count(&[], all.events(event));
    }
}

/// Letters on their way at this moment. Those of killed processes are not among them.
fn waiting(families: &mut Families, running: &Totals) {
    let outcomes = |direction| {
        let all = LetterOutcome::ALL.into_iter();
        // The numbers of another process may be any.
        all.map(|outcome| running.all_letters(direction, outcome))
            .fold(0, u64::wrapping_add)
    };
    let under_way = running
        .events(Event::Submitted)
        .saturating_sub(outcomes(Direction::Sent));
    let taken = running.all_letters(Direction::Received, LetterOutcome::Delivered);
    let queued = taken.saturating_sub(running.events(Event::Read));
    for (name, help, value) in [
        (
            "fipa_letters_under_way",
            "Letters of agents on this host that have no outcome yet.",
            under_way,
        ),
        (
            "fipa_letters_queued",
            "Letters in the queues of agents on this host.",
            queued,
        ),
    ] {
        families.gauge(name, help).count(&[], value);
    }
}

#[cfg(feature = "protocols")]
fn violations(families: &mut Families, all: &Totals) {
    let mut violations = families.counter(
        "fipa_violations_total",
        "Messages that violate their protocol, at the agents of this host that check them.",
    );
    for (number, protocol) in crate::domain::counting::protocols() {
        violations.count(&[("protocol", protocol)], all.violations(number));
    }
}

#[cfg(not(feature = "protocols"))]
fn violations(_: &mut Families, _: &Totals) {}
