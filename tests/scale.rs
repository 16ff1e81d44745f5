//! A thousand agents in fifty processes of one host: all are found, and no process exceeds its limits
//! of descriptors and memory. With `--nocapture` the test prints the times and the usage;
//! `FIPA_SCALE_PROCESSES=100` distributes the agents over another number of processes.
//!
//! A process beside a gateway that publishes thousands of agents of other hosts stays within its memory, too.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod support;

use std::io::{BufRead, BufReader, Read, Write};
use std::process::Stdio;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa::{Config, Domain, Entry, Incarnation, Location, Matcher, Query, Reach, Role, Source};
use fipa_sds::{HostConfig, HostDirectory, MtsId};
use fipa_testbed::{ChildGuard, ignored_test, private_memory};

const AGENTS: usize = 1000;

/// Number of processes that have the agents.
fn processes() -> usize {
    let set = std::env::var("FIPA_SCALE_PROCESSES");
    set.map_or(50, |set| set.parse().unwrap())
}

/// Maximum number of descriptors of a process without peers.
const DESCRIPTORS: usize = 60;
/// Maximum memory of a process without peers, in bytes. Unoptimized code keeps larger stacks.
const MEMORY: u64 = if cfg!(debug_assertions) {
    6 << 20
} else {
    4 << 20
};

const DOMAIN: &str = "FIPA_SCALE_DOMAIN";
const NUMBER: &str = "FIPA_SCALE_NUMBER";

fn config(domain: &str) -> Config {
    support::load([&format!("domain={domain}"), "discovery.mdns=false"])
}

/// Registers agents, prints `ready`, and leaves when its input ends.
#[tokio::test]
#[ignore = "started by the other test"]
async fn a_process_of_its_own() {
    let Ok(domain) = std::env::var(DOMAIN) else {
        return;
    };
    let number = std::env::var(NUMBER).unwrap();
    let before = private_memory(std::process::id());
    let domain = Domain::open(&config(&domain)).await.unwrap();
    let mut agents = Vec::new();
    for agent in 0..AGENTS / processes() {
        let name = format!("agent-{number}-{agent}");
        agents.push(domain.register(&name).await.unwrap());
    }
    let line = format!("ready {before}\n");
    std::io::stdout().write_all(line.as_bytes()).unwrap();
    let waiting = tokio::task::spawn_blocking(|| {
        let mut rest = Vec::new();
        std::io::stdin().read_to_end(&mut rest)
    });
    waiting.await.unwrap().unwrap();
    drop(agents);
    domain.close().await;
}

/// Returns the processor time that a process has used so far.
fn processor_time(pid: u32) -> Duration {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).unwrap();
    let (_, fields) = stat.rsplit_once(')').unwrap();
    let ticks = fields.split_ascii_whitespace().skip(11).take(2);
    let ticks: u64 = ticks.map(|ticks| ticks.parse::<u64>().unwrap()).sum();
    // The kernel reports 100 ticks per second on every architecture.
    Duration::from_millis(ticks * 10)
}

struct Process {
    child: ChildGuard,
    /// Private memory before it joined the domain, in bytes.
    before: u64,
}

fn start(domain: &str, directory: &std::path::Path) -> Vec<Process> {
    let spawned: Vec<ChildGuard> = (0..processes())
        .map(|number| {
            let mut command = ignored_test("a_process_of_its_own");
            command
                .env(DOMAIN, domain)
                .env(NUMBER, number.to_string())
                .env("FIPA_RUNTIME_DIR", directory)
                .stdin(Stdio::piped())
                .stdout(Stdio::piped());
            ChildGuard::start(&mut command)
        })
        .collect();
    spawned.into_iter().map(ready).collect()
}

/// Waits until the process prints that it is ready.
fn ready(mut child: ChildGuard) -> Process {
    let lines = BufReader::new(child.child().stdout.take().unwrap()).lines();
    let mut lines = lines.map_while(Result::ok);
    let before = lines.find_map(|line| line.split_once("ready ")?.1.parse().ok());
    let before = before.expect("the process prints that it is ready");
    // Reads the rest: the test harness of the process prints more, and fails if the pipe is closed.
    std::thread::spawn(move || lines.for_each(drop));
    Process { child, before }
}

#[test]
fn a_thousand_agents_in_fifty_processes() {
    let directory = tempfile::tempdir().unwrap();
    let domain = format!("scale-{}", std::process::id());
    let run = directory.path().join("run");
    let began = Instant::now();
    let mut processes = start(&domain, &run);
    let registered = began.elapsed();
    let pids = processes.iter().map(|process| process.child.id());
    let used: Duration = pids.map(processor_time).sum();

    // Another process looks up all agents.
    let lookup = ignored_test("a_process_that_looks_up_all_agents")
        .env(DOMAIN, &domain)
        .env("FIPA_RUNTIME_DIR", &run)
        .output()
        .unwrap();
    let output = String::from_utf8_lossy(&lookup.stdout).into_owned();
    assert!(lookup.status.success(), "{output}");
    assert!(output.contains("found 1000 of 1000"), "{output}");
    let found = began.elapsed();

    let (mut most_open, mut most_taken) = (0, 0);
    for process in &processes {
        let pid = process.child.id();
        let open = std::fs::read_dir(format!("/proc/{pid}/fd"))
            .unwrap()
            .count();
        assert!(open <= DESCRIPTORS, "{open} descriptors");
        let taken = private_memory(pid).saturating_sub(process.before);
        assert!(taken <= MEMORY, "{taken} bytes of memory");
        (most_open, most_taken) = (most_open.max(open), most_taken.max(taken));
    }
    let prefix = format!("fipa_{domain}_");
    let shared = || {
        let files = std::fs::read_dir("/dev/shm").unwrap().flatten();
        files.filter(|file| file.file_name().to_string_lossy().starts_with(&prefix))
    };
    let blocks = |file: std::fs::DirEntry| {
        std::os::unix::fs::MetadataExt::blocks(&file.metadata().unwrap()) * 512
    };
    let count = processes.len();
    let bytes: u64 = shared().map(blocks).sum();
    assert!(
        bytes <= MEMORY * count as u64,
        "{bytes} bytes of shared memory"
    );
    println!(
        "{AGENTS} agents in {count} processes: started and registered after {registered:.2?} with \
         {used:.2?} of processor time, all found by one more after {found:.2?}; at most {most_open} \
         descriptors and {} KiB of private memory per process, {} KiB of shared memory on average",
        most_taken >> 10,
        (bytes / count as u64) >> 10,
    );

    for process in &mut processes {
        drop(process.child.child().stdin.take());
        assert!(process.child.wait().success());
    }
    assert_eq!(shared().count(), 0);
}

#[tokio::test]
#[ignore = "started by the other test"]
async fn a_process_that_looks_up_all_agents() {
    let Ok(name) = std::env::var(DOMAIN) else {
        return;
    };
    let domain = Domain::open(&config(&name)).await.unwrap();
    let directory = domain.directory();
    let each = AGENTS / processes();
    let total = processes() * each;
    let exact = || {
        let names = (0..total).map(|n| format!("agent-{}-{}", n / each, n % each));
        names
            .filter(|name| directory.lookup(name).is_some())
            .count()
    };
    let all = Query::by_name(Matcher::parse("agent-.*").unwrap());
    let began = Instant::now();
    while (exact(), directory.search(&all).len()) != (total, total) {
        // Ends a test that hangs.
        assert!(
            began.elapsed() < Duration::from_secs(60),
            "found {}",
            exact()
        );
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    let line = format!("found {} of {total}\n", exact());
    std::io::stdout().write_all(line.as_bytes()).unwrap();
    domain.close().await;
}

/// Agents of other hosts, in the number that the variable says, of 200 peers.
const REMOTE: &str = "FIPA_SCALE_REMOTE";
/// Maximum private memory of a process with 10,000 agents of other hosts, in bytes. Unoptimized code is
/// larger, and the test harness is part of it.
const MEMORY_WITH_REMOTE: u64 = 8 << 20;

fn remote_agents(count: usize) -> Vec<Arc<Entry>> {
    let at: Location = "shm://0123456789abcdef#0123456789abcdef".parse().unwrap();
    let agent = |number: usize| {
        let peer = number % 200;
        Arc::new(Entry {
            name: format!("robot-{peer}.arm_{number:05}").into(),
            agent_type: "gripper".to_owned(),
            incarnation: Incarnation::random(),
            locations: vec![at.clone()],
            mts: MtsId::new(
                format!("robot-{peer}-mts"),
                Incarnation::from_u64(peer as u64 + 1),
            ),
            description: "left front, with a camera".to_owned(),
            registered: SystemTime::UNIX_EPOCH,
            source: Source::Exchange,
            reach: Reach::Local,
            peer: fipa_transport::PeerId::THIS_HOST,
            role: Role::Agent,
        })
    };
    (0..count).map(agent).collect()
}

/// Publishes agents of other hosts as a gateway does, prints `ready`, and leaves when its input ends.
#[tokio::test]
#[ignore = "started by the other test"]
async fn a_process_that_publishes_agents_of_other_hosts() {
    let (Ok(name), Ok(count)) = (std::env::var(DOMAIN), std::env::var(REMOTE)) else {
        return;
    };
    let domain = Domain::open(&config(&name)).await.unwrap();
    let run = std::env::var_os("FIPA_RUNTIME_DIR").unwrap();
    let gateway = HostDirectory::open(HostConfig {
        brief: false,
        users: fipa_transport::DomainUsers::This,
        dir: std::path::Path::new(&run).join(&name).join("directory"),
        mts: MtsId::new("gateway", Incarnation::random()),
        gateway: true,
    });
    let gateway = gateway.unwrap();
    let agents = remote_agents(count.parse().unwrap());
    gateway.publish_remote(&agents, &[]).unwrap();
    std::io::stdout().write_all(b"ready 0\n").unwrap();
    let waiting = tokio::task::spawn_blocking(|| {
        let mut rest = Vec::new();
        std::io::stdin().read_to_end(&mut rest)
    });
    waiting.await.unwrap().unwrap();
    drop(gateway);
    domain.close().await;
}

/// Registers an agent, looks up some agents of other hosts, and prints its private memory and processor time.
#[tokio::test]
#[ignore = "started by the other test"]
async fn a_process_beside_agents_of_other_hosts() {
    let (Ok(name), Ok(count)) = (std::env::var(DOMAIN), std::env::var(REMOTE)) else {
        return;
    };
    let count: usize = count.parse().unwrap();
    let domain = Domain::open(&config(&name)).await.unwrap();
    let agent = domain.register("own").await.unwrap();
    let directory = domain.directory();
    let joined = processor_time(std::process::id());
    for number in (0..count).step_by((count / 1000).max(1)) {
        let name = format!("robot-{}.arm_{number:05}", number % 200);
        assert!(directory.lookup(&name).is_some(), "{name}");
    }
    let (used, memory) = (
        processor_time(std::process::id()),
        private_memory(std::process::id()),
    );
    let line = format!(
        "measured {memory} {} {}\n",
        joined.as_millis(),
        used.as_millis()
    );
    std::io::stdout().write_all(line.as_bytes()).unwrap();
    drop(agent);
    domain.close().await;
}

#[test]
fn agents_of_other_hosts_take_little_memory_of_a_process() {
    for count in [10, 1000, 10_000] {
        let directory = tempfile::tempdir().unwrap();
        let run = |test: &str| {
            let mut command = ignored_test(test);
            command
                .env(DOMAIN, format!("remote-{}", std::process::id()))
                .env(REMOTE, count.to_string())
                .env("FIPA_RUNTIME_DIR", directory.path().join("run"))
                .stdin(Stdio::piped())
                .stdout(Stdio::piped());
            command
        };
        let publisher =
            ChildGuard::start(&mut run("a_process_that_publishes_agents_of_other_hosts"));
        let mut publisher = ready(publisher);
        let output = run("a_process_beside_agents_of_other_hosts")
            .output()
            .unwrap();
        let output = String::from_utf8_lossy(&output.stdout).into_owned();
        let measured = output.lines().find_map(|line| line.split_once("measured "));
        let (_, measured) = measured.unwrap_or_else(|| panic!("{output}"));
        let measured: Vec<u64> = measured.split(' ').map(|it| it.parse().unwrap()).collect();
        let [memory, joined, used] = measured[..] else {
            panic!("{output}");
        };
        println!(
            "{count} agents of other hosts: {} KiB of private memory, {joined} ms of processor time to \
             join, {} ms for 1,000 lookups",
            memory >> 10,
            used - joined,
        );
        assert!(memory <= MEMORY_WITH_REMOTE, "{memory} bytes of memory");
        drop(publisher.child.child().stdin.take());
        assert!(publisher.child.wait().success());
    }
}
