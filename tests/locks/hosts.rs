//! The counter of `counter.rs` on two hosts: workers are killed and stopped for longer than the lease, links are
//! cut in one direction, and gateways are killed.
//!
//! `FIPA_LOCKS_SECONDS` is the maximum time, 6 s by default, and `FIPA_LOCKS_ACQUISITIONS` the number of
//! acquisitions after which the faults end. `FIPA_LOCKS_PAUSE` is the mean time between two faults, 225 ms by default.
//! `FIPA_LOCKS_SEED` repeats the faults of an earlier run.

#![allow(clippy::print_stdout, reason = "the counts are the result of the test")]

use std::process::{Child, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use fastrand::Rng;
use fipa::locks::OwnOptions;
use fipa::{Domain, Gateway};
use fipa_testbed::{Family, Host, Network, enter, isolated, until};

use super::counter::{LEASE, Worker, hurried, keep, number};
use super::support::load;

/// Environment variable of a gateway: arguments of `--set`, one in a line.
const GATEWAY: &str = "FIPA_LOCKS_GATEWAY";

/// Worker 0 is on the host of the owner, the others are on the other host.
const WORKERS: usize = 3;

fn domain_of(worker: usize) -> &'static str {
    if worker == 0 { "first" } else { "second" }
}

/// Settings of all processes of a host.
fn settings(domain: &str) -> Vec<String> {
    let set = [
        "discovery.mdns=false",
        "mts.deadline=2s",
        "security.insecure=true",
    ];
    let set = set.map(str::to_owned);
    set.into_iter()
        .chain([format!("domain={domain}")])
        .collect()
}

#[test]
#[ignore = "started by the other tests"]
fn gateway_entry() {
    let Ok(set) = std::env::var(GATEWAY) else {
        return;
    };
    let runtime = tokio::runtime::Runtime::new().unwrap();
    runtime.block_on(async {
        let config = load(set.lines());
        let _gateway = Gateway::open(&config).await.unwrap();
        // Ends with the process.
        std::future::pending::<()>().await;
    });
}

struct GatewayProcess(Child);

impl GatewayProcess {
    fn start(host: &Host, domain: &str, peer: &Host) -> Self {
        let mut set = settings(domain);
        set.push(format!("mts.name=gateway-{domain}"));
        set.push(format!("transport.tcp.listen=[\"{}:7788\"]", address(host)));
        set.push(format!(
            "discovery.static={{ peer = [\"tcp://{}:7788\"] }}",
            address(peer)
        ));
        let mut command = host.command(std::env::current_exe().unwrap());
        command
            .args([
                "--exact",
                "hosts::gateway_entry",
                "--ignored",
                "--nocapture",
            ])
            .env(GATEWAY, set.join("\n"))
            .stdin(Stdio::null())
            .stdout(Stdio::null());
        Self(command.spawn().unwrap())
    }
}

impl Drop for GatewayProcess {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn address(host: &Host) -> String {
    host.addresses().remove(0)
}

/// Drops all packets that arrive at the host, except those by which hosts find each other's interfaces: these
/// are no IP packets with IPv4. It can still send.
fn cut(host: &Host) {
    for rule in [
        "add table inet cut",
        "add chain inet cut in { type filter hook input priority 0; policy drop; }",
        "add rule inet cut in icmpv6 type { nd-neighbor-solicit, nd-neighbor-advert } accept",
    ] {
        let nft = host.command("nft").arg(rule).status();
        assert!(nft.unwrap().success(), "nft {rule}");
    }
}

fn heal(host: &Host) {
    let nft = host.command("nft").arg("delete table inet cut").status();
    assert!(nft.unwrap().success(), "nft delete");
}

#[test]
fn a_guarded_counter_loses_no_increment_across_hosts() {
    isolated("hosts::inside_two_hosts", &["nft", "kill"]);
}

#[test]
fn a_guarded_counter_loses_no_increment_across_hosts_with_ipv6() {
    isolated("hosts::inside_two_hosts_with_ipv6", &["nft", "kill"]);
}

#[derive(Debug, Default)]
struct Faults {
    kills: u32,
    stops: u32,
    cuts: u32,
    gateways: u32,
}

#[test]
#[ignore = "is run by the other test in namespaces of its own"]
fn inside_two_hosts() {
    enter();
    two_hosts(Family::V4);
}

#[test]
#[ignore = "is run by the other test in namespaces of its own"]
fn inside_two_hosts_with_ipv6() {
    enter();
    two_hosts(Family::UniqueLocal);
}

fn two_hosts(family: Family) {
    let network = Network::of(family, 2);
    let seed = number("FIPA_LOCKS_SEED").unwrap_or_else(|| fastrand::u64(..));
    println!("FIPA_LOCKS_SEED={seed}");
    let mut random = Rng::with_seed(seed);
    let time = Duration::from_secs(number("FIPA_LOCKS_SECONDS").unwrap_or(6));
    let pause = number("FIPA_LOCKS_PAUSE").unwrap_or(225).max(4);
    let enough = number("FIPA_LOCKS_ACQUISITIONS").unwrap_or(u64::MAX);
    let start_gateway = |host: usize| {
        let domain = ["first", "second"][host];
        GatewayProcess::start(network.host(host), domain, network.host(1 - host))
    };
    let mut gateways = [start_gateway(0), start_gateway(1)];
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let files = tempfile::tempdir().unwrap();
    let (domain, keeper, counter) = runtime.block_on(async {
        let domain = Domain::open(&load(settings("first"))).await.unwrap();
        let keeper = domain.register("keeper").await.unwrap();
        keeper.use_locks(hurried()).unwrap();
        let options = OwnOptions {
            lease: LEASE,
            state_dir: Some(files.path().to_owned()),
            volatile: false,
            forget: true,
        };
        let counter = keeper.own("counter", options).await.unwrap();
        (domain, Arc::new(keeper), Arc::new(counter))
    });
    let ends = Arc::new(AtomicBool::new(false));
    let keeping = {
        let (keeper, counter, ends) = (keeper.clone(), counter.clone(), ends.clone());
        runtime.spawn(async move { keep(&keeper, &counter, &ends).await })
    };
    let start =
        |number: usize| Worker::start(&format!("worker-{number}"), &settings(domain_of(number)));
    let mut workers: Vec<Worker> = (0..WORKERS).map(start).collect();
    let position = || counter.status().fence.map(|fence| fence.position());
    let holder = || {
        let holder = counter.status().holder?;
        holder.strip_prefix("worker-")?.parse::<usize>().ok()
    };
    let by_other_host = || holder().is_some_and(|worker| worker > 0);
    until("the other host holds the counter", by_other_host);
    let mut faults = Faults::default();
    let began = Instant::now();
    while began.elapsed() < time && position().is_none_or(|(_, number)| number < enough) {
        std::thread::sleep(Duration::from_millis(random.u64(pause / 4..pause * 7 / 4)));
        // Most faults hit the holder.
        let number = match holder() {
            Some(number) if number < WORKERS && random.u8(..4) > 0 => number,
            _ => random.usize(..WORKERS),
        };
        let host = random.usize(..2);
        match random.u8(..8) {
            0..3 => {
                // The name is free again when the process has ended.
                workers[number].end();
                workers[number] = start(number);
                faults.kills += 1;
            }
            3..5 => {
                workers[number].signal("-STOP");
                std::thread::sleep(LEASE + Duration::from_millis(random.u64(50..400)));
                workers[number].signal("-CONT");
                faults.stops += 1;
            }
            5..7 => {
                cut(network.host(host));
                std::thread::sleep(Duration::from_millis(random.u64(100..1_500)));
                heal(network.host(host));
                faults.cuts += 1;
            }
            _ => {
                // Ends the earlier process first: it has the port.
                let _ = gateways[host].0.kill();
                let _ = gateways[host].0.wait();
                gateways[host] = start_gateway(host);
                faults.gateways += 1;
            }
        }
    }
    // Without faults, agents of both hosts go on.
    let at_end = position();
    until("the counter is locked again", || {
        position().is_some() && position() > at_end
    });
    until("the other host holds the counter again", by_other_host);
    ends.store(true, Ordering::Relaxed);
    let kept = runtime.block_on(keeping).unwrap();
    println!(
        "{} kills, {} stops, {} cuts in one direction, {} gateways killed in {:.0?}; {} acquisitions, \
         {} with commands, {} increments, {} refused commands",
        faults.kills,
        faults.stops,
        faults.cuts,
        faults.gateways,
        began.elapsed(),
        position().map_or(0, |(_, number)| number),
        kept.grants,
        kept.admitted,
        kept.refused
    );
    assert_eq!(kept.counter, kept.admitted);
    assert!(kept.grants > 0 && kept.admitted > 0);
    drop(workers);
    runtime.block_on(domain.close());
}
