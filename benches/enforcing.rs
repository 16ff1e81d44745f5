//! What it costs that agents check themselves: a request and its inform through shared memory,
//! between threads that block, with `monitor.check = "enforce"` beside the same without. Both take turns
//! of some milliseconds, so that other work on the machine hits both alike; a ratio is the median of
//! those of the turns.
//!
//! ```console
//! $ cargo bench --features monitor --bench enforcing
//! ```

#![expect(clippy::unwrap_used, reason = "a bench that cannot go on has failed")]
#![expect(clippy::print_stdout, reason = "figures")]

use std::time::Instant;

use fipa::config::Sources;
use fipa::{Agent, AgentId, Config, Domain, Performative};
use tokio::runtime::{Builder, Runtime};

const TURNS: usize = 300;
/// Of a turn, which takes some ten milliseconds; the first few wake what has slept meanwhile.
const ROUNDS: usize = 150;
const FIRST: usize = 10;

fn main() {
    let mut without = Pair::new("off");
    let mut with = Pair::new("enforce");
    for pair in [&mut without, &mut with] {
        pair.turn();
    }
    let mut medians = [Vec::new(), Vec::new()];
    let mut ratios = Vec::new();
    for turn in 0..TURNS {
        // Who is first has no advantage.
        let (one, other) = if turn % 2 == 0 {
            let one = without.turn();
            (one, with.turn())
        } else {
            let other = with.turn();
            (without.turn(), other)
        };
        ratios.push(other / one);
        medians[0].push(one);
        medians[1].push(other);
    }
    let [without_us, with_us] = medians.map(|mut all| middle(&mut all, 2));
    println!("a request and its inform, blocking: {without_us:.1} us");
    println!("with both sides enforcing:          {with_us:.1} us");
    println!(
        "ratio: {:.3} (middle half {:.3} to {:.3})",
        middle(&mut ratios, 2),
        middle(&mut ratios, 1),
        middle(&mut ratios, 3),
    );
    without.end();
    with.end();
}

/// One of the quartiles.
fn middle(all: &mut [f64], quarter: usize) -> f64 {
    all.sort_by(f64::total_cmp);
    all[all.len() * quarter / 4]
}

/// A rover and an arm, each a process of its own as far as the domain knows.
struct Pair {
    runtime: Runtime,
    domain: Domain,
    rover: Agent,
    arm: std::thread::JoinHandle<()>,
    asked: u64,
}

impl Pair {
    fn new(check: &str) -> Self {
        let config = Config::load(&Sources {
            set: vec![
                format!("domain=enforcing-{}-{check}", std::process::id()),
                format!("monitor.check={check}"),
                "mts.transports=shm".to_owned(),
                "transport.shm.spin=0us".to_owned(),
                "discovery.mdns=false".to_owned(),
            ],
            ..Sources::default()
        })
        .unwrap();
        let runtime = one_thread();
        let domain = runtime.block_on(Domain::open(&config)).unwrap();
        let rover = domain.register("rover").unwrap();
        let (ready, is_ready) = std::sync::mpsc::channel();
        let arm = std::thread::spawn(move || {
            let runtime = one_thread();
            let domain = runtime.block_on(Domain::open(&config)).unwrap();
            let arm = domain.register("arm").unwrap();
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

    /// The median of a turn, in microseconds.
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
                let answer = rover.receive().await.unwrap().message;
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

/// Does what it is asked for, until a cancel comes that belongs to nothing.
async fn answer(arm: &Agent) {
    loop {
        let asked = arm.receive().await.unwrap().message;
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
