//! Two hosts with 500 agents each that start at the same moment: the time until all processes see all
//! agents, and the idle load of the gateways afterwards.

use std::fs;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use fipa::config::Sources;
use fipa::{Agent, Config, DirectoryView, Domain, Gateway, Reach};
use fipa_testbed::{Host, Network};
use tokio::runtime::{Builder, Runtime};

const AGENTS: usize = 500;
/// Announcements are repeated for some seconds.
const SETTLING: Duration = Duration::from_secs(15);
/// Records are refreshed before their two minutes end, so each window is longer than that. Full
/// questions become rarer later.
const IDLE: Duration = Duration::from_secs(130);
/// Interval of the maximum.
const PART: Duration = Duration::from_secs(5);
const WATCHDOG: Duration = Duration::from_secs(120);

/// Measures in namespaces of its own, and prints the results.
pub(crate) fn measure() {
    fipa_testbed::enter();
    let network = Network::new(2);
    let started = Instant::now();
    let robots: Vec<Robot> = network.hosts().iter().map(Robot::start).collect();
    let there = started.elapsed();
    while !robots.iter().all(Robot::sees_all) {
        assert!(started.elapsed() < WATCHDOG, "they do not see each other");
        std::thread::sleep(Duration::from_millis(10));
    }
    let seen = started.elapsed();
    println!(
        "2 hosts x {AGENTS} agents: registered after {there:.1?}, complete mutual view after {seen:.1?}"
    );
    std::thread::sleep(SETTLING);
    for window in 1..=2 {
        idle(&network, window);
    }
}

/// Idle load of the hosts.
fn idle(network: &Network, window: u32) {
    let look = || -> Vec<Spent> { network.hosts().iter().map(Spent::of).collect() };
    let (before, since) = (look(), Instant::now());
    let mut peaks = vec![0.0_f64; before.len()];
    let (mut part, mut of_part) = (Instant::now(), look());
    while since.elapsed() < IDLE {
        std::thread::sleep(PART);
        let (now, seconds) = (look(), part.elapsed().as_secs_f64());
        part = Instant::now();
        for ((peak, before), now) in peaks.iter_mut().zip(&of_part).zip(&now) {
            *peak = peak.max((now.bytes - before.bytes) as f64 / seconds / 1000.0);
        }
        of_part = now;
    }
    let seconds = since.elapsed().as_secs_f64();
    for (((host, before), after), peak) in network.hosts().iter().zip(before).zip(look()).zip(peaks)
    {
        println!(
            "idle, window {window} of {seconds:.0} s, {}: {:.2} % of a core, {:.2} kB/s sent in {:.1} \
             packets/s, at most {peak:.1} kB/s over 5 s",
            host.name(),
            (after.cpu - before.cpu).as_secs_f64() / seconds * 100.0,
            (after.bytes - before.bytes) as f64 / seconds / 1000.0,
            (after.packets - before.packets) as f64 / seconds,
        );
    }
}

/// A gateway and a process with all the agents.
struct Robot {
    name: String,
    gateway: Gateway,
    domain: Domain,
    _agents: Vec<Agent>,
    /// Starts it with threads in the host's namespace that have its name.
    _runtime: Runtime,
}

impl Robot {
    fn start(host: &Host) -> Self {
        host.enter(|| {
            let name = host.name().to_owned();
            let runtime = Builder::new_multi_thread()
                .worker_threads(2)
                .enable_all()
                .build()
                .unwrap();
            let sources = Sources {
                set: vec![
                    format!("domain={name}"),
                    format!("mts.name={name}-mts"),
                    "discovery.interfaces=[\"eth0\"]".to_owned(),
                    format!("transport.tcp.listen=[\"{}:0\"]", host.ipv4()),
                    "security.insecure=true".to_owned(),
                ],
                ..Sources::default()
            };
            let config = Config::load(&sources).unwrap();
            let (gateway, domain) = runtime.block_on(async {
                let gateway = Gateway::open(&config).await.unwrap();
                (gateway, Domain::open(&config).await.unwrap())
            });
            let agents = (0..AGENTS).map(|number| {
                let agent = format!("{name}.agent_{number:03}");
                runtime.block_on(domain.register(&agent)).unwrap()
            });
            Self {
                _agents: agents.collect(),
                name,
                gateway,
                domain,
                _runtime: runtime,
            }
        })
    }

    /// The gateway, and the processes of its host.
    fn sees_all(&self) -> bool {
        let remote = |directory: DirectoryView<'_>| {
            directory.refresh();
            let entries = directory.entries();
            let remote = entries
                .iter()
                .filter(|it| it.reach != Reach::Local && !it.is_platform_agent());
            remote.filter(|it| !it.name.starts_with(&self.name)).count()
        };
        remote(self.gateway.directory()) == AGENTS && remote(self.domain.directory()) == AGENTS
    }
}

/// What a host has used so far.
struct Spent {
    /// Of all threads in its namespace.
    cpu: Duration,
    bytes: u64,
    packets: u64,
}

impl Spent {
    fn of(host: &Host) -> Self {
        let namespace = host.enter(|| fs::read_link("/proc/thread-self/ns/net").unwrap());
        let device = host.enter(|| fs::read_to_string("/proc/thread-self/net/dev").unwrap());
        let line = device.lines().find(|line| line.trim().starts_with("eth0"));
        let counts: Vec<u64> = line
            .unwrap()
            .split_ascii_whitespace()
            .filter_map(|word| word.parse().ok())
            .collect();
        // Eight numbers of what was received, then those of what was sent.
        Self {
            cpu: threads_in(&namespace),
            bytes: counts[8],
            packets: counts[9],
        }
    }
}

/// The time that the threads of this process in a namespace have used.
fn threads_in(namespace: &PathBuf) -> Duration {
    let threads = fs::read_dir("/proc/self/task").unwrap().flatten();
    let here = threads.filter(|thread| {
        let of_thread = fs::read_link(thread.path().join("ns/net"));
        of_thread.is_ok_and(|it| it == *namespace)
    });
    let used = here.map(|thread| {
        let stat = fs::read_to_string(thread.path().join("schedstat")).unwrap_or_default();
        let first = stat.split_ascii_whitespace().next();
        first.and_then(|word| word.parse().ok()).unwrap_or(0)
    });
    Duration::from_nanos(used.sum())
}
