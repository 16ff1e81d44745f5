//! A battery publishes its charge, and two agents subscribe to it (FIPA00035).
//!
//! ```console
//! $ cargo run --example publish_subscribe
//! ```

#![allow(clippy::print_stdout, reason = "an example prints")]

use std::time::Duration;

use fipa::{Domain, Performative::Subscribe};

const TIMEOUT: Duration = Duration::from_secs(60);

#[tokio::main]
async fn main() -> fipa::Result<()> {
    let domain = Domain::from_environment().await?;
    let battery = domain.register("battery").await?;
    let charge = battery.publisher("charge")?;

    let mut subscriptions = Vec::new();
    for name in ["rover", "operator"] {
        let agent = domain.register(name).await?;
        let subscribe = agent
            .message(Subscribe)
            .receiver("battery")
            .content("charge");
        let subscription = agent.subscribe(subscribe, TIMEOUT).await?;
        // The agent is deregistered when its last handle is dropped.
        subscriptions.push((agent, subscription));
    }
    // A subscriber has the agreement a moment before the publisher lists it.
    while charge.subscribers() < subscriptions.len() {
        tokio::time::sleep(Duration::from_millis(1)).await;
    }

    for percent in [80.5, 80.0, 79.5] {
        let delivered = charge.publish(percent.to_string()).await.delivered().await;
        println!("{percent} % was delivered to {delivered}");
        for (agent, subscription) in &mut subscriptions {
            let percent: f64 = subscription.next().await?.parse()?;
            println!("{} knows {percent} %", agent.name());
        }
    }
    for (_, subscription) in subscriptions {
        subscription.cancel(TIMEOUT).await?;
    }
    domain.close().await;
    Ok(())
}
