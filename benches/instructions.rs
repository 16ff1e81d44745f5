//! Letters between two agents of one process through shared memory, one path at a time, to count their
//! instructions under valgrind: `.ci/instructions`.
//!
//! The argument is the name of a path; without one, all names are listed. The instructions within
//! `measured` are counted, for some hundred letters after the setup. One thread works for both agents in
//! turn: the sender sends, the receiver polls and takes the letter, and the sender polls and takes the
//! outcome. So the number of polls does not depend on time.
//!
//! With `--allocations` the program counts allocations instead, of all paths.

#![expect(clippy::unwrap_used, reason = "a bench that cannot go on may panic")]
#![expect(clippy::print_stdout, reason = "the names and counts are the output")]

use std::hint::black_box;
use std::time::Duration;

use fipa::config::Sources;
use fipa::{Agent, AgentId, Config, Domain, Message, Performative};
use tokio::runtime::{Builder, Runtime};

const LETTERS: usize = 480;

type Path = (&'static str, fn(&Pair));

const PATHS: &[Path] = &[
    ("agents/copied/1KB", |pair| pair.copied(1)),
    ("agents/copied/1KB/16-in-flight", |pair| pair.copied(16)),
    ("agents/loaned/1KB", |pair| pair.loaned(1024, 1)),
    ("agents/loaned/4KB", |pair| pair.loaned(4096, 1)),
    ("agents/loaned/4KB/8-in-flight", |pair| pair.loaned(4096, 8)),
    ("agents/poll", |pair| {
        for _ in 0..LETTERS {
            assert!(pair.arm.try_receive().unwrap().is_none());
        }
    }),
    ("agents/poll/unanswered", |pair| {
        let sent = pair.rover.send(pair.message.clone());
        for _ in 0..LETTERS {
            assert!(pair.rover.try_receive().unwrap().is_none());
        }
        assert!(pair.arm.try_receive().unwrap().is_some());
        assert!(pair.runtime.block_on(sent).unwrap().all_succeeded());
    }),
];

fn main() {
    // Cargo's own arguments begin with a hyphen.
    let asked = std::env::args().skip(1).find(|name| !name.starts_with('-'));
    if std::env::args().any(|argument| argument == "--allocations") {
        let pair = Pair::new();
        for (name, run) in PATHS {
            run(&pair);
            let counted = allocation_counter::measure(|| run(&pair));
            println!("{name:<32} {:>9}", counted.count_total);
        }
        return pair.end();
    }
    match asked {
        None => PATHS.iter().for_each(|(name, _)| println!("{name}")),
        Some(asked) => {
            let path = PATHS.iter().find(|(name, _)| *name == asked);
            let (_, run) = path.unwrap_or_else(|| panic!("unknown path {asked}"));
            let pair = Pair::new();
            run(&pair);
            measured(|| run(&pair));
            pair.end();
        }
    }
}

/// The instructions of the closure are counted.
#[inline(never)]
fn measured(run: impl FnOnce()) {
    run();
    black_box(());
}

/// Two agents, each in a domain of its own with the same name, as in two processes.
struct Pair {
    runtime: Runtime,
    domains: [Domain; 2],
    rover: Agent,
    arm: Agent,
    message: Message,
}

impl Pair {
    fn new() -> Self {
        let config = Config::load(&Sources {
            set: [
                &format!("domain=instructions-{}", std::process::id()),
                "mts.transports=shm",
                // Longer than any wait: the thread polls, and does not sleep.
                "transport.shm.spin=1s",
                "discovery.mdns=false",
            ]
            .map(str::to_owned)
            .to_vec(),
            ..Sources::default()
        })
        .unwrap();
        let runtime = Builder::new_current_thread().enable_all().build().unwrap();
        let (domains, rover, arm) = runtime.block_on(async {
            let domains = [
                Domain::open(&config).await.unwrap(),
                Domain::open(&config).await.unwrap(),
            ];
            let rover = domains[0].register("rover").await.unwrap();
            let arm = domains[1].register("arm").await.unwrap();
            (domains, rover, arm)
        });
        let message = rover
            .message(Performative::Inform)
            .receiver(AgentId::new("arm").unwrap())
            .content(vec![7; 1024])
            .build()
            .unwrap();
        let pair = Self {
            runtime,
            domains,
            rover,
            arm,
            message,
        };
        // Opens the mailboxes in both directions, on other threads.
        pair.runtime.block_on(async {
            let sent = pair.rover.send(pair.message.clone()).await;
            assert!(sent.unwrap().all_succeeded());
            tokio::time::sleep(Duration::from_millis(50)).await;
            pair.arm.receive().await.unwrap();
        });
        pair
    }

    /// Letters with content that the transport copies, this many in flight at once.
    fn copied(&self, in_flight: usize) {
        self.letters(1024, in_flight, || self.rover.send(self.message.clone()));
    }

    /// Letters with content of this length in loaned memory, this many in flight at once.
    fn loaned(&self, len: usize, in_flight: usize) {
        self.letters(len, in_flight, || {
            let loan = self.rover.loan(self.message.clone(), len).unwrap();
            self.rover.send_loan(loan)
        });
    }

    fn letters<S>(&self, len: usize, in_flight: usize, mut send: impl FnMut() -> S)
    where
        S: Future<Output = Result<fipa::Deliveries, fipa::error::SendError>>,
    {
        for _ in 0..LETTERS / in_flight {
            let sent: Vec<_> = (0..in_flight).map(|_| send()).collect();
            for _ in 0..in_flight {
                let incoming = self.arm.try_receive().unwrap().unwrap();
                assert_eq!(black_box(incoming.content()).unwrap().len(), len);
            }
            for sent in sent {
                let outcomes = self.runtime.block_on(sent);
                assert!(outcomes.unwrap().all_succeeded());
            }
        }
    }

    fn end(self) {
        let Self {
            runtime,
            domains,
            rover,
            arm,
            ..
        } = self;
        drop((rover, arm));
        for domain in domains {
            runtime.block_on(domain.close());
        }
    }
}
