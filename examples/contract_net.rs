//! A rover calls three arms for proposals and awards the cheapest (FIPA00029).
//!
//! ```console
//! $ cargo run --example contract_net
//! ```

#![allow(clippy::print_stdout, reason = "an example prints")]

use std::time::Duration;

use fipa::protocol::{Reply, Task};
use fipa::{Agent, Domain, Performative::Cfp};

/// Maximum wait for the answers of a step.
const TIMEOUT: Duration = Duration::from_secs(60);

#[tokio::main]
async fn main() -> fipa::Result<()> {
    let domain = Domain::from_environment().await?;
    let rover = domain.register("rover").await?;
    let mut arms = Vec::new();
    for (name, price) in [("arm_1", 30), ("arm_2", 10), ("arm_3", 20)] {
        let arm = domain.register(name).await?;
        let server = arm.serve("fipa-contract-net", move |task| bid(task, price))?;
        arms.push((arm, server));
    }
    call(&rover).await?;
    domain.close().await;
    Ok(())
}

/// Runs the initiator.
async fn call(rover: &Agent) -> fipa::Result<()> {
    let carry = rover.message(Cfp).content("(carry crate)");
    let mut net = rover.contract_net(carry, &["arm_.*"], TIMEOUT).await?;
    let mut bids = net.bids().proposals.clone();
    bids.sort_by_key(|bid| bid.parse::<u32>().unwrap_or(u32::MAX));
    println!("{} proposals", bids.len());
    for awarded in net.award(bids.get(..1).unwrap_or(&[]), "", TIMEOUT).await? {
        match awarded.result {
            Ok(done) => println!("{}: {:?}", awarded.agent, done.text()),
            Err(error) => println!("{}: {error}", awarded.agent),
        }
    }
    Ok(())
}

/// Runs a participant.
async fn bid(mut task: Task, price: u32) -> fipa::Result<Reply> {
    match task.propose(price.to_string(), TIMEOUT).await? {
        true => Ok(Reply::Inform("carried".into())),
        false => Ok(Reply::Nothing),
    }
}
