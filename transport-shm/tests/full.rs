//! Another program fills `/dev/shm` while processes start, send and leave. No process ends by a
//! signal.
//!
//! `FIPA_FULL_SECONDS` is the running time in seconds (default 30). `FIPA_FULL_SEED` repeats the
//! random decisions of a run, but not its timing.

#![allow(clippy::unwrap_used, reason = "a failed precondition fails the test")]
#![allow(
    clippy::print_stdout,
    clippy::print_stderr,
    reason = "processes report their results"
)]

mod common;

use std::fs::File;
use std::io::Read;
use std::os::unix::process::ExitStatusExt;
use std::process::{Child, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use common::{FRONT, RecordingSink, TestDomain, attempt, location_of, parcel};
use fastrand::Rng;
use fipa_testbed::{ignored_test, until};
use fipa_transport::{Answer, Conclusion, Incarnation, Transport};
use fipa_transport_shm::{ShmConfig, ShmError, ShmTransport, cleanup_dead};
use rustix::fs::{FallocateFlags, fallocate, statvfs};

const ROLE: &str = "FIPA_SHM_FULL_ROLE";

/// Size of the file system in bytes.
const SIZE: u64 = 24 << 20;

/// Processes that run at the same time.
const PROCESSES: usize = 6;

const PAGE: u64 = 4096;

#[test]
fn a_full_file_system_ends_no_process() {
    fipa_testbed::isolated("inside_a_full_file_system_ends_no_process", &[]);
}

#[test]
#[ignore = "run by the other test in namespaces of its own"]
fn inside_a_full_file_system_ends_no_process() {
    fipa_testbed::enter();
    fipa_testbed::run(&format!("mount -t tmpfs -o size={SIZE} tmpfs /dev/shm"));
    let seconds = from_env("FIPA_FULL_SECONDS").unwrap_or(30);
    let seed = from_env("FIPA_FULL_SEED").unwrap_or_else(|| fastrand::u64(..));
    println!("seed {seed}, {seconds} s");
    let mut rng = Rng::with_seed(seed);
    let domain = TestDomain::new();
    let stop = Arc::new(AtomicBool::new(false));
    let other_program = {
        let (stop, rng) = (stop.clone(), rng.fork());
        std::thread::spawn(move || fill_and_empty(&stop, rng))
    };
    let mut sum = Sum::default();
    let mut running: Vec<Child> = Vec::new();
    let end = Instant::now() + Duration::from_secs(seconds);
    while Instant::now() < end {
        running.retain_mut(|child| !sum.has_ended(child));
        while running.len() < PROCESSES {
            running.push(start(&domain, rng.u64(..)));
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    until("the end of the processes", || {
        running.retain_mut(|child| !sum.has_ended(child));
        running.is_empty()
    });
    stop.store(true, Ordering::SeqCst);
    sum.filled = other_program.join().unwrap();
    println!("{sum:?}");
    assert_eq!(sum.signals, Vec::<i32>::new(), "ended by a signal, {sum:?}");
    assert_eq!(sum.failed, 0, "{sum:?}");
    assert!(sum.delivered > 0 && sum.refused > 0, "{sum:?}");
    assert!(sum.started > 0 && sum.not_started > 0, "{sum:?}");

    // Afterwards everything works, and no file remains.
    let cleaned = cleanup_dead(&domain.config()).unwrap();
    assert_eq!(cleaned.alive, 0);
    let (sender, sink) = domain.listening();
    let (receiver, _got) = domain.listening();
    let one = attempt();
    let content = vec![1; 300_000].into();
    sender
        .post(one, &receiver.location(), parcel(content))
        .unwrap();
    until("answer", || sink.conclusion_of(one).is_some());
    let accepted = Some(Conclusion::Answered(Answer::Accepted));
    assert_eq!(sink.conclusion_of(one), accepted);
    drop((sender, receiver, _got));
    domain.until_removed();
}

fn from_env(name: &str) -> Option<u64> {
    let text = std::env::var(name).ok()?;
    Some(text.parse().unwrap())
}

/// The results of all processes.
#[derive(Debug, Default)]
struct Sum {
    /// Number of times the file system was filled.
    filled: u64,
    /// Endpoints that were opened, and that were not because of missing room.
    started: u64,
    not_started: u64,
    /// Answered letters, and failed attempts.
    delivered: u64,
    refused: u64,
    /// Processes that exited.
    ended: u64,
    /// Exited processes that reported a failure.
    failed: u64,
    /// Signals that ended the other processes.
    signals: Vec<i32>,
}

impl Sum {
    fn has_ended(&mut self, child: &mut Child) -> bool {
        let Some(status) = child.try_wait().unwrap() else {
            return false;
        };
        if let Some(signal) = status.signal() {
            self.signals.push(signal);
            return true;
        }
        self.ended += 1;
        self.failed += u64::from(!status.success());
        let mut report = String::new();
        let stdout = child.stdout.as_mut().unwrap();
        stdout.read_to_string(&mut report).unwrap();
        for line in report.lines() {
            let Some(numbers) = line.strip_prefix("report ") else {
                continue;
            };
            let numbers: Vec<u64> = numbers.split(' ').map(|n| n.parse().unwrap()).collect();
            self.started += numbers[0];
            self.not_started += numbers[1];
            self.delivered += numbers[2];
            self.refused += numbers[3];
        }
        true
    }
}

fn start(domain: &TestDomain, seed: u64) -> Child {
    let config = domain.config();
    ignored_test("process_entry")
        .env(
            ROLE,
            format!("{} {} {seed}", config.root.display(), config.prefix),
        )
        .stdout(Stdio::piped())
        .spawn()
        .unwrap()
}

/// Acts as a program outside of the domain: fills the file system except for some pages, and frees
/// it.
fn fill_and_empty(stop: &AtomicBool, mut rng: Rng) -> u64 {
    let path = "/dev/shm/other_program";
    let mut filled = 0;
    while !stop.load(Ordering::SeqCst) {
        let file = File::create(path).unwrap();
        let pages_left = match rng.u8(..3) {
            0 => 0,
            1 => rng.u64(..16),
            _ => rng.u64(..512),
        };
        // Concurrent allocations of other processes change the result by a little.
        let mut taken = 0;
        while let free = statvfs("/dev/shm").unwrap().f_bavail
            && free > pages_left
        {
            let more = (free - pages_left) * PAGE;
            if fallocate(&file, FallocateFlags::empty(), taken, more).is_ok() {
                taken += more;
            }
        }
        filled += 1;
        pause(&mut rng, 4000);
        file.set_len(0).unwrap();
        pause(&mut rng, 12_000);
    }
    std::fs::remove_file(path).unwrap();
    filled
}

/// Sleeps for less than this many microseconds.
fn pause(rng: &mut Rng, most: u64) {
    std::thread::sleep(Duration::from_micros(rng.u64(..most)));
}

/// The test process, started several times.
#[test]
#[ignore = "started by another test"]
fn process_entry() {
    let role = std::env::var(ROLE).unwrap();
    let words: Vec<&str> = role.split(' ').collect();
    let mut rng = Rng::with_seed(words[2].parse().unwrap());
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .unwrap();
    let [mut started, mut not_started, mut delivered, mut refused] = [0; 4];
    for _ in 0..rng.u8(1..8) {
        let config = ShmConfig::new(words[0], words[1], Incarnation::random());
        let endpoint = match ShmTransport::new(config, runtime.handle().clone()) {
            Ok(endpoint) => Arc::new(endpoint),
            Err(error) => {
                assert!(is_full(&error), "{error}");
                not_started += 1;
                continue;
            }
        };
        started += 1;
        let sink = Arc::new(RecordingSink::default());
        endpoint.listen(sink.clone()).unwrap();
        for _ in 0..rng.u8(10..60) {
            match send(&endpoint, words[0], words[1], &mut rng) {
                Ok(true) => {}
                Ok(false) => pause(&mut rng, 2000),
                Err(()) => refused += 1,
            }
            if rng.u8(..8) == 0 {
                sink.arrived.lock().unwrap().clear();
            }
        }
        let concluded = sink.concluded.lock().unwrap();
        let answers = concluded.iter();
        let answers = answers.filter(|(_, what)| matches!(what, Conclusion::Answered(_)));
        delivered += answers.count();
        drop(concluded);
        if rng.u8(..4) == 0 {
            println!("\nreport {started} {not_started} {delivered} {refused}");
            // Without closing, as after a crash: other processes clean up.
            std::process::exit(0);
        }
    }
    println!("\nreport {started} {not_started} {delivered} {refused}");
}

/// Whether the cause is a full file system, or a lock that another process holds for too long.
fn is_full(error: &ShmError) -> bool {
    match error {
        ShmError::NoRoom { .. } | ShmError::Full { .. } | ShmError::Busy { .. } => true,
        ShmError::File { source, .. } => source.kind() == std::io::ErrorKind::StorageFull,
        _ => false,
    }
}

/// Sends a letter to a random process. `Ok(false)` if there is none.
fn send(from: &ShmTransport, root: &str, prefix: &str, rng: &mut Rng) -> Result<bool, ()> {
    let files = std::fs::read_dir(format!("{root}/processes")).map_err(|_| ())?;
    let prefix = format!("{prefix}_");
    let others: Vec<Incarnation> = files
        .flatten()
        .filter_map(|file| {
            let name = file.file_name().into_string().ok()?;
            // The secret of the domain comes before the digits.
            let digits = name.strip_prefix(&prefix)?.strip_suffix(".live")?;
            digits.rsplit('_').next()?.parse().ok()
        })
        .filter(|one| location_of(*one) != from.location())
        .collect();
    let Some(to) = rng.choice(others) else {
        return Ok(false);
    };
    let to = location_of(to);
    let len = [10, 2000, 30_000, 200_000, 800_000][rng.usize(..5)];
    let content = match rng.u8(..3) {
        0 => vec![1; len].into(),
        1 => {
            let mut loan = from.loan(&to, FRONT, len, 1).map_err(|_| ())?.unwrap();
            loan.content_mut().fill(2);
            loan.freeze()
        }
        _ => match from.loan_for_many(len).map_err(|_| ())? {
            Some(mut loan) => {
                loan.content_mut().fill(3);
                loan.freeze()
            }
            None => vec![3; len].into(),
        },
    };
    from.post(attempt(), &to, parcel(content)).map_err(|_| ())?;
    Ok(true)
}
