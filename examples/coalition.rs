//! A payload item joins a rover and an arm to one robot. When the leader goes, the other member leads.
//!
//! ```console
//! $ cargo run --example coalition
//! ```

#![expect(clippy::print_stdout, reason = "an example prints its results")]

use std::error::Error;
use std::time::Duration;

use fipa::coalitions::{CoalitionOptions, Membership};
use fipa::config::Sources;
use fipa::{Agent, Config, Domain, Performative};

/// Maximum wait for a message.
const TIMEOUT: Duration = Duration::from_secs(60);

type Failed = Box<dyn Error + Send + Sync>;

#[tokio::main]
async fn main() -> Result<(), Failed> {
    let domain = Domain::open(&Config::load(&Sources::from_environment())?).await?;
    // The agent of the interface that joins the two. Its process decides who leads.
    let item = domain.register("item").await?;
    let mut options = CoalitionOptions::default();
    // Without a file for the next start, which this example does not have.
    options.lock.volatile = true;
    options.lock.forget = true;
    let robot = item
        .found_coalition("robot_1", ["rover", "arm"], options)
        .await?;

    let (rover, arm) = (
        domain.register("rover").await?,
        domain.register("arm").await?,
    );
    let rover_in = rover.join_coalition("robot_1")?;
    rover_in.leads().await?;
    let arm_in = arm.join_coalition("robot_1")?;

    let late = command(&rover, &rover_in, "(fold)")?;
    rover.send(command(&rover, &rover_in, "(unfold)")?).await?;
    obey(&arm, &arm_in).await?;

    // The rover drives away. A letter to the robot reaches its next leader.
    rover_in.resign();
    arm_in.leads().await?;
    let question = item.message(Performative::QueryRef).receiver("robot_1");
    println!("{}", item.send(question.content("(battery)")).await?);

    // The rover does not know it yet.
    rover.send(late).await?;
    arm.receive_within(TIMEOUT).await?;
    obey(&arm, &arm_in).await?;

    drop(robot);
    domain.close().await;
    Ok(())
}

/// Builds a command of the leader to the arm, with the leader's fence.
fn command(leader: &Agent, robot: &Membership, what: &str) -> Result<fipa::Message, Failed> {
    let command = leader.message(Performative::Request).receiver("arm");
    Ok(robot.guard(command)?.content(what.to_owned()).build()?)
}

/// Carries out the next command, if its sender leads.
async fn obey(arm: &Agent, robot: &Membership) -> Result<(), Failed> {
    let Some(command) = arm.receive_within(TIMEOUT).await? else {
        return Err("no command".into());
    };
    match robot.check(command.message()) {
        Ok(_) => println!("the arm obeys: {}", command.message().text()),
        Err(refused) => println!("the arm refuses {}: {refused}", command.message().text()),
    }
    Ok(())
}
