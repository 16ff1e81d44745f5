//! A counter that the owner of a resource guards by fences. Workers in processes of their own read it,
//! pause, and write the next value, while the test kills them and stops them for longer than the lease.
//!
//! `FIPA_LOCKS_SECONDS` is the time, 5 s by default. `FIPA_LOCKS_SEED` repeats the faults of an earlier
//! run.

#![allow(clippy::print_stdout, reason = "the counts are the result of the test")]

use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use fastrand::Rng;
use fipa::locks::{Algorithm, Fence, LockOptions, OwnOptions, Owned};
use fipa::{Agent, AgentId, Domain, Performative};
use fipa_testbed::{ignored_test, send_signal, until};

use super::support::{load, mark};
use super::{options, text, watched};

/// Environment variable of a worker: its name, then arguments of `--set`, one in a line.
const WORKER: &str = "FIPA_LOCKS_WORKER";

const WORKERS: usize = 3;

/// Options with short probes: requests do not wait for members that were stopped or cut off.
pub(super) fn hurried() -> LockOptions {
    LockOptions {
        probe_interval: Duration::from_millis(300),
        probe_timeout: Duration::from_millis(600),
        retry: Duration::from_millis(300),
        ..options(Algorithm::default())
    }
}

/// Short, so that many leases end. Holders are stopped for longer.
pub(super) const LEASE: Duration = Duration::from_millis(600);

pub(super) fn number(variable: &str) -> Option<u64> {
    std::env::var(variable).ok()?.parse().ok()
}

#[test]
#[ignore = "started by the other tests"]
fn worker_entry() {
    let Ok(role) = std::env::var(WORKER) else {
        return;
    };
    let mut lines = role.lines().map(str::to_owned);
    let name = lines.next().unwrap();
    let config = load(lines);
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .unwrap();
    runtime.block_on(async {
        let domain = Domain::open(&config).await.unwrap();
        let worker = domain.register(&name).await.unwrap();
        worker.use_locks(hurried()).unwrap();
        loop {
            // Ends with the process.
            let _ = increment(&worker).await;
        }
    });
}

/// Adds one to the counter. Fails if the lock is lost, or the owner refuses.
async fn increment(worker: &Agent) -> Result<(), Box<dyn std::error::Error>> {
    let lock = worker.lock("counter").await?;
    let ask = async |content: String| {
        let id = worker.unique_id();
        let request = worker
            .message(Performative::Request)
            .receiver(AgentId::new("keeper")?)
            .conversation_id(id.as_str())
            .content(content);
        worker.send(lock.guard(request).build()?).await?;
        let answered = async {
            loop {
                let answer = worker.receive().await?.into_message();
                if answer.conversation_id() == Some(&id) {
                    return Ok::<_, fipa::error::ReceiveError>(answer);
                }
            }
        };
        let answer = tokio::time::timeout(Duration::from_secs(5), answered).await??;
        match answer.performative() {
            Performative::Agree => Ok(text(&answer).to_owned()),
            _ => Err(Box::<dyn std::error::Error>::from("refused")),
        }
    };
    let value: u64 = ask("read".to_owned()).await?.parse()?;
    // The test stops and kills workers here, too.
    tokio::time::sleep(Duration::from_millis(fastrand::u64(..20))).await;
    ask((value + 1).to_string()).await?;
    Ok(())
}

/// The results of the owner.
#[derive(Debug, Default)]
pub(super) struct Kept {
    pub(super) counter: u64,
    pub(super) admitted: u64,
    pub(super) refused: u64,
    fence: Option<Fence>,
    pub(super) grants: u64,
}

/// Reads and writes the counter, with the fence of the live grant only, until `ends`, and until a worker has written.
pub(super) async fn keep(keeper: &Agent, counter: &Owned, ends: &AtomicBool) -> Kept {
    let mut kept = Kept::default();
    while !ends.load(Ordering::Relaxed) || kept.admitted == 0 {
        let received = tokio::time::timeout(Duration::from_millis(50), keeper.receive()).await;
        let Ok(received) = received else {
            continue;
        };
        let message = received.unwrap().into_message();
        if *message.performative() != Performative::Request {
            continue;
        }
        let admitted = counter.check(&message);
        let (act, content) = match admitted {
            Err(_) => {
                kept.refused += 1;
                (Performative::Refuse, String::new())
            }
            Ok(fence) => {
                if kept.fence.as_ref() != Some(&fence) {
                    let before = kept.fence.replace(fence.clone());
                    // No fence is accepted after a later one.
                    assert!(before.is_none_or(|before| before.position() < fence.position()));
                    kept.grants += 1;
                }
                if let Ok(value) = text(&message).parse::<u64>() {
                    // A write by an earlier holder would lose increments.
                    assert_eq!(value, kept.counter + 1, "{message}");
                    kept.counter = value;
                    kept.admitted += 1;
                }
                (Performative::Agree, kept.counter.to_string())
            }
        };
        let answer = keeper
            .reply(&message, act)
            .content(content)
            .build()
            .unwrap();
        // The worker may have been killed.
        drop(keeper.send(answer));
    }
    kept
}

pub(super) struct Worker(Child);

impl Worker {
    pub(super) fn start(name: &str, set: &[String]) -> Self {
        let mut command: Command = ignored_test("counter::worker_entry");
        command
            .env(WORKER, format!("{name}\n{}", set.join("\n")))
            .stdin(Stdio::null())
            .stdout(Stdio::null());
        Self(command.spawn().unwrap())
    }

    pub(super) fn signal(&self, signal: &str) {
        send_signal(self.0.id(), signal);
    }

    /// Kills the process with SIGKILL.
    pub(super) fn end(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

impl Drop for Worker {
    fn drop(&mut self) {
        self.end();
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_guarded_counter_loses_no_increment_when_holders_are_killed_and_stopped() {
    watched(async {
        let seed = number("FIPA_LOCKS_SEED").unwrap_or_else(|| fastrand::u64(..));
        println!("FIPA_LOCKS_SEED={seed}");
        let mut random = Rng::with_seed(seed);
        let time = Duration::from_secs(number("FIPA_LOCKS_SECONDS").unwrap_or(5));
        let set = vec![
            format!("domain=locks-{}", mark()),
            "discovery.mdns=false".to_owned(),
        ];
        let domain = Domain::open(&load(set.clone())).await.unwrap();
        let files = tempfile::tempdir().unwrap();
        let keeper = Arc::new(domain.register("keeper").await.unwrap());
        keeper.use_locks(hurried()).unwrap();
        let options = OwnOptions {
            lease: LEASE,
            state_dir: Some(files.path().to_owned()),
            volatile: false,
            forget: true,
        };
        let counter = Arc::new(keeper.own("counter", options).await.unwrap());
        let ends = Arc::new(AtomicBool::new(false));
        let keeping = {
            let (keeper, counter, ends) = (keeper.clone(), counter.clone(), ends.clone());
            tokio::spawn(async move { keep(&keeper, &counter, &ends).await })
        };
        let chaos = tokio::task::spawn_blocking(move || {
            let start = |number: usize| Worker::start(&format!("worker-{number}"), &set);
            let mut workers: Vec<Worker> = (0..WORKERS).map(start).collect();
            let (mut kills, mut stops) = (0, 0);
            let holder = |workers: &[Worker]| {
                let holder = counter.status().holder?;
                let number = holder.strip_prefix("worker-")?.parse::<usize>().ok()?;
                (number < workers.len()).then_some(number)
            };
            let began = Instant::now();
            while began.elapsed() < time {
                std::thread::sleep(Duration::from_millis(random.u64(50..250)));
                // Most faults hit the holder.
                let number = match holder(&workers) {
                    Some(number) if random.u8(..4) > 0 => number,
                    _ => random.usize(..WORKERS),
                };
                if random.bool() {
                    // The name is free again when the process has ended.
                    workers[number].end();
                    workers[number] = start(number);
                    kills += 1;
                } else {
                    workers[number].signal("-STOP");
                    std::thread::sleep(LEASE + Duration::from_millis(random.u64(50..400)));
                    workers[number].signal("-CONT");
                    stops += 1;
                }
            }
            // Without faults, all go on.
            let position = || counter.status().fence.map(|fence| fence.position());
            let at_end = position();
            until("the counter is locked again", || {
                position().is_some() && position() != at_end
            });
            (kills, stops, workers)
        });
        let (kills, stops, workers) = chaos.await.unwrap();
        ends.store(true, Ordering::Relaxed);
        let kept = keeping.await.unwrap();
        drop(workers);
        println!(
            "{kills} kills, {stops} stops, {} grants, {} increments, {} refused commands",
            kept.grants, kept.admitted, kept.refused
        );
        assert_eq!(kept.counter, kept.admitted);
        assert!(kept.grants > 0 && kept.admitted > 0);
    })
    .await;
}
