//! Benchmarks the cost of `monitor.check = "enforce"` and of rules under `[access]`: a request and its
//! inform through shared memory between blocking threads, beside the same without. The variants take turns
//! of some milliseconds, so other load affects them alike. A ratio is the median of the ratios of turns.
//!
//! ```console
//! $ cargo bench --features protocols --bench enforcing
//! ```

#![expect(clippy::unwrap_used, reason = "a bench that cannot go on has failed")]
#![expect(clippy::print_stdout, reason = "figures")]

use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Instant;

use fipa::config::Sources;
use fipa::{Agent, AgentId, Config, Domain, Performative};
use tokio::runtime::{Builder, Runtime};

const TURNS: usize = 300;
/// Rounds of a turn of about ten milliseconds; the first ones wake sleeping threads.
const ROUNDS: usize = 150;
const FIRST: usize = 10;

/// The variants with their settings; the first has none.
const KINDS: [(&str, &[&str]); 3] = [
    ("nothing checked", &[]),
    ("protocols enforced", &["monitor.check=enforce"]),
    (
        "rules kept",
        &[
            "access.rate=1000000",
            "access.allow={ rover = [\"arm\"], arm = [\"rover protocol=fipa-request\"] }",
            "access.deny={ \".*\" = [\"brake.*\", \"arm performative=cancel protocol=x\"], \"guest_.*\" = [\"arm\"] }",
        ],
    ),
];

fn main() {
    let mut pairs = KINDS.map(|(_, settings)| Pair::new(settings));
    for pair in &mut pairs {
        pair.turn();
    }
    let mut times = KINDS.map(|_| Vec::with_capacity(TURNS));
    for turn in 0..TURNS {
        // The order changes, so no variant has an advantage.
        for number in 0..pairs.len() {
            let which = (turn + number) % pairs.len();
            times[which].push(pairs[which].turn());
        }
    }
    let base = times[0].clone();
    println!("a request and its inform, blocking, both sides alike:");
    for ((what, _), mut times) in KINDS.into_iter().zip(times) {
        let mut ratios: Vec<f64> = times
            .iter()
            .zip(&base)
            .map(|(one, base)| one / base)
            .collect();
        println!(
            "{what:20} {:.1} us, ratio {:.3} (middle half {:.3} to {:.3})",
            middle(&mut times, 2),
            middle(&mut ratios, 2),
            middle(&mut ratios, 1),
            middle(&mut ratios, 3),
        );
    }
    for pair in pairs {
        pair.end();
    }
}

/// A quartile.
fn middle(all: &mut [f64], quarter: usize) -> f64 {
    all.sort_by(f64::total_cmp);
    all[all.len() * quarter / 4]
}

/// A rover and an arm, each with a membership of its own.
struct Pair {
    runtime: Runtime,
    domain: Domain,
    rover: Agent,
    arm: std::thread::JoinHandle<()>,
    asked: u64,
}

impl Pair {
    fn new(settings: &[&str]) -> Self {
        static NEXT: AtomicU32 = AtomicU32::new(0);
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        let mut set = vec![format!("domain=enforcing-{}-{number}", std::process::id())];
        let common = [
            "mts.transports=shm",
            "transport.shm.spin=0us",
            "discovery.mdns=false",
        ];
        set.extend(common.iter().chain(settings).map(|it| (*it).to_owned()));
        let config = Config::load(&Sources {
            set,
            ..Sources::default()
        })
        .unwrap();
        let runtime = one_thread();
        let domain = runtime.block_on(Domain::open(&config)).unwrap();
        let rover = runtime.block_on(domain.register("rover")).unwrap();
        let (ready, is_ready) = std::sync::mpsc::channel();
        let arm = std::thread::spawn(move || {
            let runtime = one_thread();
            let domain = runtime.block_on(Domain::open(&config)).unwrap();
            let arm = runtime.block_on(domain.register("arm")).unwrap();
            ready.send(()).unwrap();
            runtime.block_on(answer(&arm));
            drop(arm);
            runtime.block_on(domain.close());
        });
        is_ready.recv().unwrap();
        Self {
            runtime,
            domain,
            rover,
            arm,
            asked: 0,
        }
    }

    /// Median of a turn, in microseconds.
    fn turn(&mut self) -> f64 {
        let mut times = Vec::with_capacity(ROUNDS);
        for round in 0..ROUNDS {
            let began = Instant::now();
            self.ask(Performative::Request);
            if round >= FIRST {
                times.push(began.elapsed().as_secs_f64() * 1e6);
            }
        }
        middle(&mut times, 2)
    }

    fn ask(&mut self, act: Performative) {
        self.asked += 1;
        let asks = act == Performative::Request;
        let mut message = self.rover.message(act);
        if asks {
            message = message
                .protocol("fipa-request")
                .conversation_id(format!("c{}", self.asked))
                .reply_with("r");
        }
        let message = message.receiver(AgentId::new("arm").unwrap());
        let message = message.content("lift").build().unwrap();
        let Self { runtime, rover, .. } = self;
        runtime.block_on(async {
            assert!(rover.send(message).await.unwrap().all_succeeded());
            if asks {
                let answer = rover.receive().await.unwrap().into_message();
                assert_eq!(*answer.performative(), Performative::Inform);
            }
        });
    }

    fn end(mut self) {
        self.ask(Performative::Cancel);
        self.arm.join().unwrap();
        drop(self.rover);
        self.runtime.block_on(self.domain.close());
    }
}

/// Answers requests until a cancel without a conversation arrives.
async fn answer(arm: &Agent) {
    loop {
        let asked = arm.receive().await.unwrap().into_message();
        if *asked.performative() == Performative::Cancel {
            return;
        }
        let done = arm.reply(&asked, Performative::Inform).content("done");
        let done = arm.send(done.build().unwrap()).await;
        assert!(done.unwrap().all_succeeded());
    }
}

fn one_thread() -> Runtime {
    Builder::new_current_thread().enable_all().build().unwrap()
}
