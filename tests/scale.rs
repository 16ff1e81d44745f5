//! A thousand agents in fifty processes of one host: all are found, and no process exceeds its limits
//! of descriptors and memory. With `--nocapture` the test prints the times and the usage.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod support;

use std::io::{BufRead, BufReader, Read, Write};
use std::process::Stdio;
use std::time::{Duration, Instant};

use fipa::{Config, Domain, Matcher, Query};
use fipa_testbed::{ChildGuard, ignored_test};

const PROCESSES: usize = 50;
const AGENTS: usize = 20;

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
    for agent in 0..AGENTS {
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

/// Returns the private anonymous memory of a process, in bytes.
fn private_memory(pid: u32) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap();
    let line = status
        .lines()
        .find_map(|line| line.strip_prefix("RssAnon:"));
    let kib: u64 = line
        .unwrap()
        .trim()
        .trim_end_matches(" kB")
        .parse()
        .unwrap();
    kib << 10
}

struct Process {
    child: ChildGuard,
    /// Private memory before it joined the domain, in bytes.
    before: u64,
}

fn start(domain: &str, directory: &std::path::Path) -> Vec<Process> {
    let spawned: Vec<ChildGuard> = (0..PROCESSES)
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
    let ready = |mut child: ChildGuard| {
        let lines = BufReader::new(child.child().stdout.take().unwrap()).lines();
        let mut lines = lines.map_while(Result::ok);
        let before = lines.find_map(|line| line.split_once("ready ")?.1.parse().ok());
        let before = before.expect("the process prints that it is ready");
        // Reads the rest: the test harness of the process prints more, and fails if the pipe is closed.
        std::thread::spawn(move || lines.for_each(drop));
        Process { child, before }
    };
    spawned.into_iter().map(ready).collect()
}

#[test]
fn a_thousand_agents_in_fifty_processes() {
    let directory = tempfile::tempdir().unwrap();
    let domain = format!("scale-{}", std::process::id());
    let run = directory.path().join("run");
    let began = Instant::now();
    let mut processes = start(&domain, &run);
    let registered = began.elapsed();

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
    let bytes: u64 = shared().map(blocks).sum();
    assert!(
        bytes <= MEMORY * PROCESSES as u64,
        "{bytes} bytes of shared memory"
    );
    println!(
        "{PROCESSES} processes with {AGENTS} agents each: started and registered after \
         {registered:.2?}, all found by one more after {found:.2?}; at most {most_open} \
         descriptors and {} KiB of private memory per process, {} KiB of shared memory on average",
        most_taken >> 10,
        (bytes / PROCESSES as u64) >> 10,
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
    let total = PROCESSES * AGENTS;
    let exact = || {
        let names = (0..total).map(|n| format!("agent-{}-{}", n / AGENTS, n % AGENTS));
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
