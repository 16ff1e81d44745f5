//! Agents follow a protocol of their own, which the file handover.scxml beside this one describes.
//! `monitor.check` keeps the agents of this process from breaking it.
//!
//! ```console
//! $ fipa protocol check examples/handover.scxml
//! $ cargo run --example own_protocol
//! ```

#![allow(clippy::print_stdout, reason = "an example prints")]

use fipa::config::{Check, Sources};
use fipa::{Config, Domain, Performative};

const PROTOCOL: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/handover.scxml");

#[tokio::main]
async fn main() -> fipa::Result<()> {
    let mut config = Config::load(&Sources::from_environment())?;
    config.monitor.check = Check::Enforce;
    config.monitor.protocols = vec![PROTOCOL.to_owned()];
    config.check()?;
    let domain = Domain::open(&config).await?;
    let rover = domain.register("rover").await?;
    let arm = domain.register("arm").await?;

    let offer = rover
        .message(Performative::Propose)
        .receiver("arm")
        .protocol("handover")
        .conversation_id(rover.unique_id())
        .content("(take crate)");
    rover.send(offer).await?;
    let letter = arm.receive().await?;

    // The protocol requires a confirm; another act is not sent.
    let wrong = arm.reply(letter.message(), Performative::AcceptProposal);
    match arm.send(wrong).await {
        Ok(deliveries) => println!("{deliveries}"),
        Err(error) => println!("{error}"),
    }
    let right = arm.reply(letter.message(), Performative::Confirm);
    println!("{}", arm.send(right).await?);
    println!(
        "rover received {}",
        rover.receive().await?.message().performative()
    );

    domain.close().await;
    Ok(())
}
