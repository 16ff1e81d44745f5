//! One agent sends a message, and another one reads it.
//!
//! ```console
//! $ cargo run --example hello
//! ```

#![allow(clippy::print_stdout, reason = "an example prints")]

use fipa::{Domain, Performative::Inform};

#[tokio::main]
async fn main() -> fipa::Result<()> {
    let domain = Domain::from_environment().await?;
    let arm = domain.register("arm").await?;
    let rover = domain.register("rover").await?;

    let hello = rover.message(Inform).receiver("arm").content("hello");
    println!("{}", rover.send(hello).await?);

    let letter = arm.receive().await?;
    println!("arm received {}", letter.message());

    domain.close().await;
    Ok(())
}
