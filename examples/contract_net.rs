//! A rover calls three arms for proposals and awards the cheapest.
//!
//! ```console
//! $ cargo run --example contract_net --features monitor
//! ```

use std::time::Duration;

use fipa::config::Sources;
use fipa::protocol::{DialogueError, Reply};
use fipa::{Agent, AgentId, Config, Domain, Performative};

/// Maximum wait for the answers of a step.
const TIMEOUT: Duration = Duration::from_secs(10);

#[tokio::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let domain = Domain::open(&Config::load(&Sources::from_environment())?).await?;
    let rover = domain.register("rover").await?;
    let mut arms = Vec::new();
    for (name, price) in [("arm_1", 30), ("arm_2", 10), ("arm_3", 20)] {
        let arm = domain.register(name).await?;
        arms.push(arm.id().clone());
        tokio::spawn(async move { work(&arm, price).await });
    }
    call(&rover, &arms).await?;
    domain.close().await;
    Ok(())
}

/// Runs the initiator.
async fn call(rover: &Agent, arms: &[AgentId]) -> Result<(), DialogueError> {
    let call = rover.message(Performative::Cfp).content("(carry crate)");
    let mut net = rover.contract_net(call, arms, TIMEOUT).await?;
    let price = |bid: &fipa::Message| {
        let text = String::from_utf8_lossy(bid.content()?).into_owned();
        text.parse::<u32>().ok()
    };
    let best = net.bids().proposals.iter().min_by_key(|bid| price(bid));
    let best: Vec<_> = best.into_iter().cloned().collect();
    for awarded in net.award(&best, "", TIMEOUT).await? {
        match awarded.result {
            Ok(done) => print(&format!("{}: {done}", awarded.agent)),
            Err(error) => print(&format!("{}: {error}", awarded.agent)),
        }
    }
    Ok(())
}

/// Runs a participant.
async fn work(arm: &Agent, price: u32) -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
    let call = arm.receive().await?.into_message();
    let mut task = arm.take_part(&call)?;
    if task.propose(price.to_string(), TIMEOUT).await? {
        task.reply(Reply::Inform("carried".into())).await?;
    }
    Ok(())
}

#[expect(clippy::print_stdout, reason = "an example prints its results")]
fn print(text: &str) {
    println!("{text}");
}
