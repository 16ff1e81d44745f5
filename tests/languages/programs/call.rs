//! An operator in Rust, which has crates carried. Usage: `call NAME`
//!
//! The position of a crate is a line of the standard input. The operator prints the proposals of the carriers, and
//! awards the nearest one after a further line.

#![allow(clippy::print_stdout, reason = "the program prints its observations")]

use std::error::Error;
use std::io::stdin;
use std::time::Duration;

use fipa::Performative::Cfp;
use fipa::{Agent, Domain, Message};
use fipa_bindings::Failure;
use serde::Deserialize;
use serde_json::json;

/// A time limit that no step reaches.
const LONG: Duration = Duration::from_secs(60);

type Result<T> = std::result::Result<T, Box<dyn Error + Send + Sync>>;

#[derive(Deserialize)]
struct Proposal {
    distance: f64,
}

#[tokio::main]
async fn main() -> Result<()> {
    let name = std::env::args().nth(1).unwrap_or_default();
    let domain = Domain::from_environment().await?;
    let agent = domain.register(name.as_str()).await?;
    println!("ready");
    let mut position = String::new();
    while stdin().read_line(&mut position)? > 0 {
        let (x, y) = position.trim().split_once(' ').ok_or("not a position")?;
        call(&agent, x.parse()?, y.parse()?).await?;
        position.clear();
    }
    domain.close().await;
    Ok(())
}

async fn call(agent: &Agent, x: f64, y: f64) -> Result<()> {
    let content = json!({ "x": x, "y": y }).to_string();
    let cfp = agent.message(Cfp).language("json").content(content);
    let mut net = agent.contract_net(cfp, &["carrier_.*"], LONG).await?;
    let mut proposals: Vec<(f64, Message)> = Vec::new();
    for proposal in &net.bids().proposals {
        let Proposal { distance } = serde_json::from_str(&proposal.text())?;
        proposals.push((distance, proposal.clone()));
    }
    proposals.sort_by(|(one, _), (other, _)| one.total_cmp(other));
    for (distance, proposal) in &proposals {
        let sender = proposal.sender().ok_or("no sender")?;
        println!("{} at {distance:.1}", sender.name());
    }
    println!("{} refused", net.bids().refusals.len());

    stdin().read_line(&mut String::new())?;
    let nearest: Vec<Message> = proposals.into_iter().take(1).map(|(_, one)| one).collect();
    for awarded in net.award(&nearest, "", LONG).await? {
        match awarded.result {
            Ok(result) => println!("{}: {}", awarded.agent, result.text()),
            Err(error) => println!("{}: {:?}", awarded.agent, Failure::of(error).kind),
        }
    }
    Ok(())
}
