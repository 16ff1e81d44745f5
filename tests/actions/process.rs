//! A child process: a robot that offers an action and never ends it by itself, or a client that invokes an
//! action of the rover.

#![expect(clippy::print_stdout, reason = "the parent process reads it")]

use std::io::{BufRead as _, BufReader};
use std::process::Stdio;
use std::time::Duration;

use fipa::actions::{Action, Execution, Orphans};
use fipa::{AgentId, Domain};
use fipa_testbed::{ChildGuard, ignored_test};

use crate::support;

/// Environment variable with the role of a child process, `robot` or `client`, then arguments of `--set`,
/// separated by spaces.
const ROLE: &str = "FIPA_ACTIONS_ROLE";

/// Starts a process with this role and waits until it is ready.
pub(crate) fn start(role: &str, set: &[String]) -> ChildGuard {
    let mut command = ignored_test("process_entry");
    command.env(ROLE, format!("{role} {}", set.join(" ")));
    let mut child = ChildGuard::start(command.stdout(Stdio::piped()));
    let mut lines = BufReader::new(child.child().stdout.take().unwrap()).lines();
    // The test harness prints lines of its own.
    let ready = lines.find(|line| line.as_ref().is_ok_and(|line| line.ends_with("ready")));
    assert!(ready.is_some(), "the process has ended before it was ready");
    // A closed pipe would end it.
    std::thread::spawn(move || lines.for_each(drop));
    child
}

/// Runs the role of the environment, if there is one.
pub(crate) fn run() {
    let Ok(role) = std::env::var(ROLE) else {
        return;
    };
    let mut words = role.split(' ').map(str::to_owned);
    let role = words.next().unwrap();
    let config = support::load(words);
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .unwrap();
    runtime.block_on(async {
        let domain = Domain::open(&config).await.unwrap();
        let agent = domain.register(&role).await.unwrap();
        if role == "robot" {
            let offered = agent.offer(endless("drive"), |(): (), run| forever(run));
            let _offer = offered.unwrap();
            let think = Action::new("think").decided_by_handler();
            // Nothing else runs meanwhile on the only thread.
            let offered = agent.offer(think, |(): (), run| async move {
                std::thread::sleep(THOUGHT);
                run.accept();
                Ok::<_, String>(())
            });
            let _second = offered.unwrap();
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

/// Time for which the action `think` blocks the robot, more than twice the deadline of letters.
pub(crate) const THOUGHT: Duration = Duration::from_secs(14);

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
