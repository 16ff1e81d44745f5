//! A child process: a robot that offers an action and never ends it by itself, or a client that invokes an
//! action of the rover.

use std::process::Command;

use fipa::actions::{Action, Execution, Orphans};
use fipa::config::Sources;
use fipa::{AgentId, Config, Domain};
use fipa_testbed::{ChildGuard, ignored_test};

/// Environment variable with the role of a child process, `robot` or `client`, then arguments of `--set`,
/// separated by spaces.
const ROLE: &str = "FIPA_ACTIONS_ROLE";

/// Starts a process with this role and waits until it is ready.
pub(crate) fn start(role: &str, set: &[String]) -> ChildGuard {
    let mut command: Command = ignored_test("process_entry");
    command.env(ROLE, format!("{role} {}", set.join(" ")));
    ChildGuard::until_ready(&mut command).0
}

/// Runs the role of the environment, if there is one.
pub(crate) fn run() {
    let Ok(role) = std::env::var(ROLE) else {
        return;
    };
    let mut words = role.split(' ').map(str::to_owned);
    let role = words.next().unwrap();
    let config = Config::load(&Sources {
        set: words.collect(),
        ..Sources::default()
    });
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .unwrap();
    runtime.block_on(async {
        let domain = Domain::open(&config.unwrap()).await.unwrap();
        let agent = domain.register(&role).await.unwrap();
        if role == "robot" {
            let offered = agent.offer(endless("drive"), |(): (), run| forever(run));
            let _offer = offered.unwrap();
            println!("ready");
            std::future::pending::<()>().await;
        }
        let rover = agent.robot(AgentId::new("rover").unwrap());
        let mut goals = Vec::new();
        for action in ["drive", "orphan"] {
            goals.push(rover.invoke(action, &()).await.unwrap());
        }
        println!("ready");
        std::future::pending::<()>().await;
    });
}

/// An action that runs until it is to stop.
pub(crate) fn endless(name: &str) -> Action {
    let orphans = match name {
        "orphan" => Orphans::Continue,
        _ => Orphans::Cancel,
    };
    Action::new(name).orphans(orphans)
}

pub(crate) async fn forever(run: Execution) -> Result<(), String> {
    let cause = run.stopped().await;
    Err(format!("{cause:?}"))
}
