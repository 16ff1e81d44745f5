//! The server in Rust. Usage: `serve NAME`

#![allow(clippy::print_stdout, reason = "the harness waits for a line")]

use std::sync::Arc;
use std::time::Duration;

use fipa::Performative::Inform;
use fipa::actions::{Action, Execution, Progress};
use fipa::locks::{Fence, OwnOptions, Owned};
use fipa::protocol::{Reply, Task};
use fipa::topics::{Publisher, Topic};
use fipa::{Agent, Domain, Error, Message, Result};
use fipa_bindings::Failure;
use serde::Deserialize;
use tokio::sync::{Mutex, Notify};

/// The state of the handlers.
struct Shared {
    second: Agent,
    bay: Owned,
    charge: Publisher,
    /// The last command with a fence.
    command: Mutex<Option<Message>>,
    go_on: Notify,
}

#[derive(Deserialize)]
struct Count {
    to: u32,
}

#[tokio::main]
async fn main() -> Result<()> {
    let name = std::env::args().nth(1).unwrap_or_default();
    let name = name.as_str();
    let domain = Domain::from_environment().await?;
    let agent = domain.register(name).await?;
    let second = domain.register(&format!("{name}_2")).await?;
    let options = OwnOptions {
        volatile: true,
        forget: true,
        ..OwnOptions::default()
    };
    let shared = Arc::new(Shared {
        second: second.clone(),
        bay: agent.own("bay", options).await?,
        charge: agent.publisher(Topic::new("charge").latched(1))?,
        command: Mutex::default(),
        go_on: Notify::new(),
    });
    shared.charge.publish("90").await;

    let count = Action::new("count")
        .parameter::<u32>("to", "")
        .result::<u32>();
    let counting = Arc::clone(&shared);
    let _offer = agent.offer(count, move |goal, run| {
        pursue(Arc::clone(&counting), goal, run)
    })?;
    let requested = Arc::clone(&shared);
    let _server = agent.serve("fipa-request", move |task| {
        handle(Arc::clone(&requested), task)
    })?;
    println!("ready");
    tokio::try_join!(answer(&agent), answer(&second))?;
    Ok(())
}

/// Answers letters.
async fn answer(agent: &Agent) -> Result<()> {
    loop {
        let letter = agent.receive().await?;
        let message = letter.message();
        if let (Some(violation), Some(sender)) = (letter.violation(), message.sender()) {
            let report = agent.message(Inform).receiver(sender.clone());
            let report = report.conversation_id("violation report");
            agent.send(report.content(violation.to_string())).await?;
        } else if *message.performative() == Inform {
            let content = message.content().map_or(&[][..], |content| content);
            agent
                .send(agent.reply(message, Inform).content(sum(content)))
                .await?;
        }
    }
}

async fn handle(shared: Arc<Shared>, mut task: Task) -> Result<Reply> {
    let content = task.message().text();
    match content.split_once(' ').unwrap_or((&content, "")) {
        ("lift", _) => {
            task.agree("").await?;
            Ok(Reply::Inform("lifted".into()))
        }
        ("drop", _) => Ok(Reply::Refuse("too heavy".into())),
        ("throw", _) => {
            task.agree("").await?;
            Ok(Reply::Failure("no motor".into()))
        }
        ("wait", _) => {
            task.agree("").await?;
            task.cancelled().await?;
            Ok(task.confirm_cancel().await?)
        }
        ("go", _) => {
            shared.go_on.notify_one();
            Ok(Reply::Inform("".into()))
        }
        ("publish", charge) => {
            shared.charge.publish(charge.to_owned()).await;
            Ok(Reply::Inform("".into()))
        }
        ("dock", _) => {
            let checked = match shared.bay.check(task.message()) {
                Ok(_) => "admitted".to_owned(),
                Err(error) => kind(error),
            };
            *shared.command.lock().await = Some(task.message().clone());
            Ok(Reply::Inform(checked.into()))
        }
        ("lock", millis) => {
            let limit = Duration::from_millis(millis.parse().unwrap_or(0));
            let lock = match shared.second.lock_within("bay", limit).await {
                Ok(lock) => lock,
                Err(error) => return Ok(Reply::Inform(kind(error).into())),
            };
            let command = shared.command.lock().await.take();
            let late = match command.map(|command| shared.bay.check(&command)) {
                Some(Err(error)) => kind(error),
                checked => format!("{checked:?}"),
            };
            let fence = lock.fence().map(Fence::to_string).unwrap_or_default();
            Ok(Reply::Inform(format!("{late} {fence}").into()))
        }
        _ => Ok(Reply::Refuse("unknown".into())),
    }
}

/// Counts to the number of the goal when the leader lets it go on.
async fn pursue(shared: Arc<Shared>, goal: Count, run: Execution) -> Result<u32, String> {
    run.progress(Progress::fraction(0.5).note("half way"));
    tokio::select! {
        () = shared.go_on.notified() => Ok(goal.to),
        _ = run.stopped() => Err("stopped".to_owned()),
    }
}

/// Returns the length and the Adler-32 checksum of a content.
fn sum(content: &[u8]) -> String {
    let (mut a, mut b) = (1_u32, 0_u32);
    for byte in content {
        a = (a + u32::from(*byte)) % 65_521;
        b = (b + a) % 65_521;
    }
    format!("{} bytes, {:08x}, 谢谢 🤖", content.len(), b << 16 | a)
}

/// Returns the name of the kind of an error.
fn kind(error: impl Into<Error>) -> String {
    format!("{:?}", Failure::of(error).kind)
}
