//! A robot offers three actions, and another agent lists them, invokes one with progress, and cancels one.
//!
//! ```console
//! $ cargo run --example actions --features actions
//! ```
//!
//! With the argument `robot`, only the robot runs, for `fipa actions crex` and
//! `fipa do crex drive distance=2` in another terminal.

use std::time::Duration;

use fipa::actions::{Action, ActionError, Execution, Offer, OfferError, Policy, Progress};
use fipa::actions::{ParameterDescription, Robot};
use fipa::config::Sources;
use fipa::{Agent, AgentId, Config, Domain};
use serde::{Deserialize, Serialize};

#[derive(Debug, Serialize, Deserialize)]
#[serde(rename = "pose")]
struct Pose {
    x: f64,
    y: f64,
    yaw: f64,
}

#[derive(Debug, Serialize, Deserialize)]
struct Dock {
    target: Pose,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(rename = "docked")]
struct Docked {
    charge: f64,
}

#[derive(Debug, Serialize, Deserialize)]
struct Drive {
    distance: f64,
    speed: Option<f64>,
}

#[tokio::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let domain = Domain::open(&Config::load(&Sources::from_environment())?).await?;
    let crex = domain.register("crex").await?;
    let offers = offer(&crex)?;
    if std::env::args().nth(1).as_deref() == Some("robot") {
        print(&format!(
            "crex offers {} actions; press Ctrl-C to stop",
            offers.len()
        ));
        tokio::signal::ctrl_c().await?;
    } else {
        let rover = domain.register("rover").await?;
        client(&rover.robot(AgentId::new("crex")?)).await?;
    }
    domain.close().await;
    Ok(())
}

/// Offers the actions of the robot.
pub(crate) fn offer(crex: &Agent) -> Result<[Offer; 3], Box<dyn std::error::Error>> {
    let dock = Action::new("dock")
        .described("Drives to a charger and docks")
        .parameter::<Pose>("target", "m, rad; frame crex/base")
        .result::<Docked>();
    let dock = crex.offer(dock, |goal: Dock, run: Execution| async move {
        let way = goal.target.x.hypot(goal.target.y);
        work(&run, way).await?;
        Ok::<_, String>(Docked { charge: 0.8 })
    })?;
    // ANCHOR: offer
    let speed = ParameterDescription::of::<f64>("speed").unit("m/s");
    let drive = Action::new("drive")
        .described("Drives straight on")
        .parameter::<f64>("distance", "m")
        .with(speed.range(0.1..=0.5).default(&0.25)?)
        .policy(Policy::Preempt);
    let drive = crex.offer(drive, |goal: Drive, run: Execution| async move {
        work(&run, goal.distance / goal.speed.unwrap_or(0.25)).await
    })?;
    // ANCHOR_END: offer
    Ok([dock, drive, blink(crex)?])
}

fn blink(crex: &Agent) -> Result<Offer, OfferError> {
    let blink = Action::new("blink").policy(Policy::Queue(8));
    crex.offer(blink, |(): (), run: Execution| async move {
        work(&run, 1.0).await
    })
}

// ANCHOR: work
/// Works until it is done, or is to stop.
async fn work(run: &Execution, seconds: f64) -> Result<(), String> {
    const STEPS: u32 = 20;
    let step = Duration::from_secs_f64(seconds.clamp(0.0, 600.0) / f64::from(STEPS));
    for done in 0..STEPS {
        let part = f64::from(done) / f64::from(STEPS);
        run.progress(Progress::fraction(part).note("on the way"));
        tokio::select! {
            cause = run.stopped() => return Err(format!("stopped: {cause:?}")),
            () = tokio::time::sleep(step) => {}
        }
    }
    Ok(())
}
// ANCHOR_END: work

/// Uses the actions of the robot.
pub(crate) async fn client(crex: &Robot<'_>) -> Result<(), ActionError> {
    for action in crex.actions().await? {
        print(&format!(
            "crex offers {}, result {}",
            action.name, action.result
        ));
    }
    let target = Pose {
        x: 0.5,
        y: 0.2,
        yaw: 3.1,
    };
    // ANCHOR: client
    let goal = crex.invoke("dock", &Dock { target }).await?;
    let mut progress = goal.progress().await?;
    while let Some(status) = progress.next().await? {
        let part = status.progress.and_then(|it| it.fraction);
        print(&format!(
            "dock: {} {:.2}",
            status.state.as_str(),
            part.unwrap_or(0.0)
        ));
    }
    let docked: Docked = goal.result().await?;
    // ANCHOR_END: client
    print(&format!("docked, charge {}", docked.charge));

    let far = Drive {
        distance: 100.0,
        speed: None,
    };
    let mut goal = crex.invoke("drive", &far).await?;
    if goal.cancel(Duration::from_secs(10)).await? {
        print("drive: cancelled");
    }
    let fast = Drive {
        distance: 1.0,
        speed: Some(3.0),
    };
    if let Err(refused) = crex.invoke("drive", &fast).await {
        print(&format!("drive: {refused}"));
    }
    Ok(())
}

#[expect(clippy::print_stdout, reason = "an example prints its results")]
fn print(text: &str) {
    println!("{text}");
}
