//! A crane owns a docking bay, and two rovers lock it before they dock.
//!
//! ```console
//! $ cargo run --example lock
//! ```

use std::error::Error;
use std::time::Duration;

use fipa::config::Sources;
use fipa::locks::{OwnOptions, Owned};
use fipa::{Agent, Config, Domain, Performative};

/// Maximum wait for the bay.
const TIMEOUT: Duration = Duration::from_secs(60);

type Failed = Box<dyn Error + Send + Sync>;

#[tokio::main]
async fn main() -> Result<(), Failed> {
    let domain = Domain::open(&Config::load(&Sources::from_environment())?).await?;
    for answer in share(&domain, OwnOptions::default()).await? {
        print(&answer);
    }
    domain.close().await;
    Ok(())
}

/// Runs the agents. Returns the answers of the crane.
pub(crate) async fn share(domain: &Domain, options: OwnOptions) -> Result<Vec<String>, Failed> {
    let crane = domain.register("crane").await?;
    let bay = crane.own("bay", options).await?;
    let rovers = [
        domain.register("rover_1").await?,
        domain.register("rover_2").await?,
    ];
    let docking = rovers.map(|rover| tokio::spawn(async move { dock(&rover).await }));
    // Each rover sends one command in time, and one that is late.
    for _ in 0..4 {
        guard(&crane, &bay).await?;
    }
    let mut answers = Vec::new();
    for docked in docking {
        answers.extend(docked.await??);
    }
    bay.release().await;
    Ok(answers)
}

// ANCHOR: rover
/// Runs a rover: it docks while it holds the bay, and tries to when it does not.
async fn dock(rover: &Agent) -> Result<[String; 2], Failed> {
    let lock = rover.lock_within("bay", TIMEOUT).await?;
    let command = || -> Result<_, Failed> {
        let dock = rover.message(Performative::Request).content("(dock)");
        let dock = dock.receiver("crane");
        Ok(lock.guard(dock).build()?)
    };
    let (in_time, late) = (command()?, command()?);
    rover.send(in_time).await?;
    let first = tokio::select! {
        answer = rover.receive() => answer?.message().to_string(),
        // The bay belongs to another agent now.
        lost = lock.lost() => return Err(lost.into()),
    };
    lock.release();
    // A later grant has another fence.
    rover.lock_within("bay", TIMEOUT).await?.release();
    rover.send(late).await?;
    Ok([first, rover.receive().await?.message().to_string()])
}

// ANCHOR_END: rover
// ANCHOR: owner
/// Answers the next command: only the holder of the bay may dock.
async fn guard(crane: &Agent, bay: &Owned) -> Result<(), Failed> {
    let command = crane.receive().await?.into_message();
    let answer = match bay.check(&command) {
        Ok(_) => crane.reply(&command, Performative::Agree),
        Err(error) => crane
            .reply(&command, Performative::Refuse)
            .content(error.to_string()),
    };
    crane.send(answer.build()?).await?;
    Ok(())
}
// ANCHOR_END: owner

#[expect(clippy::print_stdout, reason = "an example prints its results")]
fn print(text: &str) {
    println!("{text}");
}
