//! An arm serves requests, several at a time, and a rover requests (FIPA00026).
//!
//! ```console
//! $ cargo run --example serve
//! ```

#![allow(clippy::print_stdout, reason = "an example prints")]

use std::time::Duration;

use fipa::protocol::{DialogueError, Reply, Task};
use fipa::{Domain, Performative::Request};

const TIMEOUT: Duration = Duration::from_secs(60);

#[tokio::main]
async fn main() -> fipa::Result<()> {
    let domain = Domain::from_environment().await?;
    let arm = domain.register("arm_1").await?;
    // Dropping the server ends it.
    let _server = arm.serve("fipa-request", lift)?;

    let rover = domain.register("rover").await?;
    for (action, weight) in [("lift", "2.5"), ("lift", "400"), ("lift", "a crate")] {
        let request = rover.message(Request).receiver("arm_1").content(weight);
        let mut request = rover.request(request, TIMEOUT).await?;
        let agreed = request.agreed().await;
        match agreed {
            Ok(agreed) => println!("{action} {weight}: agreed {agreed}"),
            Err(error @ DialogueError::Refused(_)) => {
                println!("{action} {weight}: {error}");
                continue;
            }
            Err(error) => return Err(error.into()),
        }
        println!("{action} {weight}: {:?}", request.result().await?.text());
    }
    domain.close().await;
    Ok(())
}

/// Handles one request. An error becomes a `failure`, or `not-understood` before the agreement.
async fn lift(mut task: Task) -> fipa::Result<Reply> {
    let Ok(weight) = task.message().parse::<f64>() else {
        return Ok(Reply::Refuse("the content is no weight".into()));
    };
    if weight > 100.0 {
        return Ok(Reply::Refuse("too heavy".into()));
    }
    task.agree("").await?;
    tokio::time::sleep(Duration::from_millis(10)).await;
    Ok(Reply::Inform(format!("lifted {weight} kg").into()))
}
