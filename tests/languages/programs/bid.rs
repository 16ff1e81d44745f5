//! A carrier in Rust, which bids its distance from a crate. Usage: `bid NAME X Y`

#![allow(clippy::print_stdout, reason = "the harness waits for lines")]

use std::error::Error;
use std::sync::Arc;
use std::time::Duration;

use fipa::Domain;
use fipa::protocol::{Reply, Task};
use serde::Deserialize;
use serde_json::json;

type Result<T> = std::result::Result<T, Box<dyn Error + Send + Sync>>;

/// A carrier refuses a crate that is farther away.
const REACH: f64 = 6.0;
/// Maximum wait for a decision.
const TIMEOUT: Duration = Duration::from_secs(3600);

#[derive(Deserialize)]
struct Position {
    x: f64,
    y: f64,
}

struct Carrier {
    name: String,
    at: Position,
}

#[tokio::main]
async fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().collect();
    let [_, name, x, y] = &arguments[..] else {
        return Err("usage: bid NAME X Y".into());
    };
    let carrier = Arc::new(Carrier {
        name: name.clone(),
        at: Position {
            x: x.parse()?,
            y: y.parse()?,
        },
    });
    let domain = Domain::from_environment().await?;
    let agent = domain.register(name.as_str()).await?;
    let _server = agent.serve("fipa-contract-net", move |task| {
        bid(Arc::clone(&carrier), task)
    })?;
    println!("ready");
    std::future::pending().await
}

async fn bid(carrier: Arc<Carrier>, mut task: Task) -> Result<Reply> {
    let crate_at: Position = serde_json::from_str(&task.message().text())?;
    let distance = f64::hypot(crate_at.x - carrier.at.x, crate_at.y - carrier.at.y);
    if distance > REACH {
        println!("refused");
        return Ok(Reply::Refuse("too far".into()));
    }
    let proposal = json!({ "distance": distance }).to_string();
    if !task.propose(proposal, TIMEOUT).await? {
        println!("rejected");
        return Ok(Reply::Nothing);
    }
    println!("accepted");
    Ok(Reply::Inform(format!("carried by {}", carrier.name).into()))
}
