//! Benchmarks the service directory: lookup, search and subscription with 10,000 entries, beside a map of
//! the standard library or a bare channel; lookup and search among the 1,000 agents of a host, as each of
//! its processes does; then two hosts with 500 agents each on a network of their own, which needs root
//! and five minutes (`crowd`).
//!
//! `-- two-hosts` runs that last part alone; any other filter omits it.
#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "a bench that cannot go on may panic, and prints what it has measured"
)]

mod crowd;

use std::collections::HashMap;
use std::hint::black_box;
use std::sync::Arc;

use criterion::{Criterion, criterion_group};
use fipa_sds::{
    Change, Directory, Exchange, HostConfig, HostDirectory, MemoryDirectory, MergedDirectory,
    MtsId, Query, Registration, StaticDirectory, resolve,
};
use fipa_transport::Incarnation;

const ENTRIES: usize = 10_000;
const ON_ONE_HOST: usize = 1000;
/// The filter that selects the two hosts.
const TWO_HOSTS: &str = "two-hosts";

fn name(number: usize) -> String {
    format!("robot-{}.arm_{number:05}", number % 20)
}

fn registration(number: usize) -> Registration {
    let locations = [
        "shm://0123456789abcdef#0123456789abcdef",
        "tcp://10.0.0.2:7788",
    ];
    let locations = locations.map(|location| location.parse().unwrap()).to_vec();
    Registration {
        agent_type: "gripper".to_owned(),
        description: "left front".to_owned(),
        ..Registration::new(name(number), Incarnation::random(), locations)
    }
}

/// The view of a gateway: several back ends, one of which has all entries.
fn directory() -> (Arc<MemoryDirectory>, MergedDirectory) {
    let memory = MemoryDirectory::new(MtsId::new("mts", Incarnation::random()));
    for number in 0..ENTRIES {
        memory.register(registration(number)).unwrap();
    }
    let memory = Arc::new(memory);
    let gateways = Arc::new(StaticDirectory::new::<&str>([]).unwrap());
    let exchanged = Exchange::new(1).directory();
    let back_ends: Vec<Arc<dyn Directory>> = vec![memory.clone(), gateways, exchanged];
    (memory, MergedDirectory::new(back_ends))
}

fn looking_up(criterion: &mut Criterion) {
    let (_, merged) = directory();
    let map: HashMap<String, usize> = (0..ENTRIES).map(|number| (name(number), number)).collect();
    let names: Vec<String> = (0..ENTRIES)
        .map(|number| name(number * 7 % ENTRIES))
        .collect();
    let mut group = criterion.benchmark_group("exact lookup");
    let mut next = names.iter().cycle();
    group.bench_function("raw HashMap", |bench| {
        bench.iter(|| map.get(black_box(next.next().unwrap().as_str())));
    });
    group.bench_function("merged view", |bench| {
        bench.iter(|| merged.lookup(black_box(next.next().unwrap())));
    });
}

fn searching(criterion: &mut Criterion) {
    let (_, merged) = directory();
    let pattern = r"robot-7\.arm_.*";
    let compiled = regex::Regex::new(&format!(r"\A(?:{pattern})\z")).unwrap();
    let names: Vec<String> = (0..ENTRIES).map(name).collect();
    let mut group = criterion.benchmark_group("pattern on names");
    group.bench_function("raw regex over a list", |bench| {
        bench.iter(|| names.iter().filter(|name| compiled.is_match(name)).count());
    });
    group.bench_function("receivers of a multicast", |bench| {
        bench.iter(|| resolve(&merged, black_box(pattern), "sender").unwrap());
    });
}

/// Agents of another process of the host, as a process sees them.
fn on_one_host(criterion: &mut Criterion) {
    let place = tempfile::tempdir().unwrap();
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .unwrap();
    let _within = runtime.enter();
    let [other, own] = ["other", "own"].map(|mts| {
        let config = HostConfig {
            brief: false,
            users: fipa_transport::DomainUsers::This,
            dir: place.path().join("run"),
            mts: MtsId::new(mts, Incarnation::random()),
            gateway: false,
        };
        HostDirectory::open(config).unwrap()
    });
    let agents = (0..ON_ONE_HOST).map(registration).collect();
    other.replace(agents, &[]).unwrap();
    own.refresh();
    assert_eq!(own.search(&Query::all()).len(), ON_ONE_HOST);
    let names: Vec<String> = (0..ON_ONE_HOST)
        .map(|number| name(number * 7 % ON_ONE_HOST))
        .collect();
    let map: HashMap<&str, usize> = names.iter().map(String::as_str).zip(0..).collect();
    let pattern = r"robot-.*\.arm_.*";
    let compiled = regex::Regex::new(&format!(r"\A(?:{pattern})\z")).unwrap();
    let mut group = criterion.benchmark_group("1,000 agents of one host");
    let mut next = names.iter().cycle();
    group.bench_function("raw HashMap", |bench| {
        bench.iter(|| map.get(black_box(next.next().unwrap().as_str())));
    });
    group.bench_function("exact lookup", |bench| {
        bench.iter(|| own.lookup(black_box(next.next().unwrap())));
    });
    group.bench_function("raw regex over a list", |bench| {
        bench.iter(|| names.iter().filter(|name| compiled.is_match(name)).count());
    });
    group.bench_function("pattern that all match", |bench| {
        bench.iter(|| resolve(&own, black_box(pattern), "sender").unwrap());
    });
    group.bench_function("pattern that 50 match", |bench| {
        bench.iter(|| resolve(&own, black_box(r"robot-7\.arm_.*"), "sender").unwrap());
    });
}

fn watching(criterion: &mut Criterion) {
    let (memory, merged) = directory();
    let mut watch = merged.watch();
    let (sender, mut raw) = tokio::sync::mpsc::channel(16);
    let mut agent = registration(ENTRIES);
    let mut group = criterion.benchmark_group("one change");
    group.bench_function("raw channel", |bench| {
        bench.iter(|| {
            sender.try_send(agent.clone()).unwrap();
            raw.try_recv().unwrap()
        });
    });
    // Counts on across samples, so each registration is a change.
    let mut number = 0_u64;
    group.bench_function("registered and told by the merged view", |bench| {
        bench.iter(|| {
            number += 1;
            agent.description = number.to_string();
            memory.register(agent.clone()).unwrap();
            match watch.try_next() {
                Some(Change::Joined(entry) | Change::Changed { after: entry, .. }) => entry,
                other => panic!("{other:?}"),
            }
        });
    });
}

criterion_group!(benches, looking_up, searching, on_one_host, watching);

fn main() {
    // Starts this program again in namespaces of its own.
    if std::env::args().any(|argument| argument == "crowd_in_namespaces") {
        return crowd::measure();
    }
    let mut arguments = std::env::args().skip(1);
    let filter = arguments.find(|argument| !argument.starts_with('-'));
    if filter.as_deref() != Some(TWO_HOSTS) {
        benches();
        Criterion::default().configure_from_args().final_summary();
    }
    if filter.is_none_or(|filter| filter == TWO_HOSTS) {
        fipa_testbed::isolated("crowd_in_namespaces", &[]);
    }
}
