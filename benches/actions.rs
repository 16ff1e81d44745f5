//! Benchmarks actions: a call of an action, from the goal to its result, beside the bare `fipa-request` that it
//! uses (request, agree, inform) with contents of the same length. The two take turns, so other load affects
//! them alike; a ratio is the median of the ratios of turns. Then 1,000 goals run at the same time: the memory
//! of the process beside that before, and its processor time while nothing else happens.
//!
//! ```console
//! $ cargo bench --features actions --bench actions
//! ```

#![expect(clippy::unwrap_used, reason = "a bench that cannot go on has failed")]
#![expect(clippy::print_stdout, reason = "figures")]

use std::fs;
use std::time::{Duration, Instant};

use fipa::actions::{Action, Execution};
use fipa::config::Sources;
use fipa::protocol::{Reply, Task};
use fipa::{Agent, AgentId, Config, Domain, Performative};
use rustix::time::{ClockId, clock_gettime};
use serde::{Deserialize, Serialize};

const TURNS: usize = 100;
/// Calls of a turn; the first ones wake sleeping threads.
const CALLS: usize = 40;
const FIRST: usize = 5;

/// Clients and goals of each for the goals that run at the same time.
const CLIENTS: usize = 5;
const GOALS: usize = 200;

/// Time in which nothing happens.
const IDLE: Duration = Duration::from_secs(10);

const TIMEOUT: Duration = Duration::from_secs(60);

#[derive(Serialize, Deserialize)]
struct Pose {
    x: f64,
    y: f64,
    yaw: f64,
}

#[derive(Serialize, Deserialize)]
struct Drive {
    target: Pose,
}

fn main() {
    let settings = [
        "mts.transports=shm",
        "transport.shm.spin=0us",
        "discovery.mdns=false",
    ];
    let own = format!("domain=actions-{}", std::process::id());
    let config = Config::load(&Sources {
        set: settings
            .map(str::to_owned)
            .into_iter()
            .chain([own])
            .collect(),
        ..Sources::default()
    })
    .unwrap();
    let runtime = tokio::runtime::Runtime::new().unwrap();
    runtime.block_on(async {
        let (here, there) = (
            Domain::open(&config).await.unwrap(),
            Domain::open(&config).await.unwrap(),
        );
        calls(&here, &there).await;
        running(&here, &there).await;
        here.close().await;
        there.close().await;
    });
}

/// Calls beside requests.
async fn calls(here: &Domain, there: &Domain) {
    let robot = here.register("crex").await.unwrap();
    let drive = Action::new("drive").parameter::<Pose>("target", "m, rad; frame crex/base");
    let _offer = robot
        .offer(drive, |_: Drive, _run: Execution| async {
            Ok::<_, String>(())
        })
        .unwrap();
    let _server = robot
        .serve(
            "fipa-request",
            async |mut task: Task| -> fipa::Result<Reply> {
                // As long as the answers of the action.
                task.agree("x".repeat(90)).await?;
                Ok(Reply::Inform("x".repeat(90).into()))
            },
        )
        .unwrap();
    let rover = there.register("rover").await.unwrap();
    let (mut bare, mut action, mut ratios) = (Vec::new(), Vec::new(), Vec::new());
    for turn in 0..=TURNS {
        let (one, other) = match turn % 2 {
            0 => {
                let bare = turn_of(async || ask(&rover).await).await;
                (bare, turn_of(async || invoke(&rover).await).await)
            }
            _ => {
                let action = turn_of(async || invoke(&rover).await).await;
                (turn_of(async || ask(&rover).await).await, action)
            }
        };
        if turn > 0 {
            bare.push(one);
            action.push(other);
            ratios.push(other / one);
        }
    }
    println!(
        "request, agree and inform {:.1} us; goal, agreement and result {:.1} us; ratio {:.3} \
         (middle half {:.3} to {:.3})",
        middle(&mut bare, 2),
        middle(&mut action, 2),
        middle(&mut ratios, 2),
        middle(&mut ratios, 1),
        middle(&mut ratios, 3),
    );
}

async fn ask(rover: &Agent) {
    let request = rover
        .message(Performative::Request)
        .receiver(AgentId::new("crex").unwrap())
        .ontology("bare")
        .language("fipa-sl")
        .content("x".repeat(140));
    let mut request = rover.request(request, TIMEOUT).await.unwrap();
    request.agreed().await.unwrap();
    request.result().await.unwrap();
}

async fn invoke(rover: &Agent) {
    let target = Pose {
        x: 1.5,
        y: 0.2,
        yaw: 3.1,
    };
    let robot = rover.robot(AgentId::new("crex").unwrap());
    let mut goal = robot.invoke("drive", &Drive { target }).await.unwrap();
    assert_eq!(goal.outcome().await.unwrap(), None);
}

/// Median of a turn, in microseconds.
async fn turn_of(call: impl AsyncFn()) -> f64 {
    let mut times = Vec::with_capacity(CALLS);
    for number in 0..CALLS {
        let began = Instant::now();
        call().await;
        if number >= FIRST {
            times.push(began.elapsed().as_secs_f64() * 1e6);
        }
    }
    middle(&mut times, 2)
}

/// Goals that run at the same time.
async fn running(here: &Domain, there: &Domain) {
    let robot = here.register("sherpa").await.unwrap();
    let wait = Action::new("wait").concurrency(CLIENTS * GOALS);
    let _offer = robot
        .offer(wait, |(): (), run: Execution| async move {
            Err::<(), _>(format!("{:?}", run.stopped().await))
        })
        .unwrap();
    let mut clients = Vec::new();
    for number in 0..CLIENTS {
        clients.push(there.register(&format!("client_{number}")).await.unwrap());
    }
    let (memory, idle) = (resident(), idle_time().await);
    let mut goals = Vec::new();
    for client in &clients {
        let robot = client.robot(AgentId::new("sherpa").unwrap());
        for _ in 0..GOALS {
            goals.push(robot.invoke("wait", &()).await.unwrap());
        }
    }
    println!(
        "{} running goals, both sides in one process: {:.1} KiB each; processor time in {} s without a \
         change: {:.1} ms, without goals {:.1} ms",
        goals.len(),
        resident().saturating_sub(memory) as f64 / goals.len() as f64 / 1024.0,
        IDLE.as_secs(),
        idle_time().await,
        idle,
    );
}

/// Resident memory of this process, in bytes.
fn resident() -> usize {
    let text = fs::read_to_string("/proc/self/status").unwrap();
    let line = text
        .lines()
        .find_map(|line| line.strip_prefix("VmRSS:"))
        .unwrap();
    let kibibytes: usize = line.trim().trim_end_matches(" kB").parse().unwrap();
    kibibytes * 1024
}

/// Processor time of this process while it is idle, in milliseconds.
async fn idle_time() -> f64 {
    let used = || {
        let time = clock_gettime(ClockId::ProcessCPUTime);
        time.tv_sec as f64 * 1e3 + time.tv_nsec as f64 / 1e6
    };
    let before = used();
    tokio::time::sleep(IDLE).await;
    used() - before
}

/// A quartile.
fn middle(all: &mut [f64], quarter: usize) -> f64 {
    all.sort_by(f64::total_cmp);
    all[all.len() * quarter / 4]
}
