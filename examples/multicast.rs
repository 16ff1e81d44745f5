//! One message reaches several agents: by a pattern of names, and by the name of a coalition.
//!
//! ```console
//! $ cargo run --example multicast
//! ```

#![allow(clippy::print_stdout, reason = "an example prints")]

use fipa::{Domain, Performative::Inform, RegisterOptions};

#[tokio::main]
async fn main() -> fipa::Result<()> {
    let domain = Domain::from_environment().await?;
    let rover = domain.register("rover").await?;
    let mut arms = Vec::new();
    for name in ["arm_1", "arm_2", "arm_3"] {
        let options = RegisterOptions {
            agent_type: "arm".into(),
            ..RegisterOptions::default()
        };
        arms.push(domain.register_with(name, options).await?);
    }

    // Each agent whose whole name matches, and never the sender itself.
    let stop = rover.message(Inform).receiver("arm_.*").content("stop");
    println!("{}", rover.send(stop).await?);
    for arm in &arms {
        println!(
            "{} received {:?}",
            arm.name(),
            arm.receive().await?.message().text()
        );
    }

    // A coalition exists until it is dropped. With a leader, only the leader receives.
    let names = ["arm_1", "arm_3"];
    let left = domain.form("left_side", names, None, RegisterOptions::default());
    let left = left.await?;
    let lift = rover.message(Inform).receiver(left.name()).content("lift");
    println!("{}", rover.send(lift).await?);

    for arm in domain.agents_of_type("arm") {
        println!("{} is an arm", arm.name);
    }
    drop(left);
    domain.close().await;
    Ok(())
}
