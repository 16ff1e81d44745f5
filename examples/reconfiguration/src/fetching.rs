//! The bid of a robot to fetch an item: its cost is the way.

use std::path::PathBuf;
use std::time::Duration;

use fipa::Agent;
use fipa::platform::ServiceDescription;
use fipa::protocol::{Reply, Server, Task};

use crate::geometry::Pose;
use crate::hardware::Hardware;
use crate::part::{Failed, Part};
use crate::report::{Claim, Reporter};
use crate::words::{self, Fetch};

/// The type of the service.
pub(crate) const SERVICE: &str = "fetch";

/// Maximum wait for the decision of the operator.
const TIMEOUT: Duration = Duration::from_secs(20);

/// The work of a robot with an item.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Way {
    /// It drives in front of the item, with a part of its body.
    InFront { part: Pose },
    /// It drives behind the item and grips it.
    Grip { part: Pose },
}

#[derive(Clone)]
struct Robot {
    world: PathBuf,
    name: String,
    reporter: Reporter,
    way: Way,
}

/// Offers to fetch items, and lists the service.
pub(crate) async fn offer(part: &Part, agent: &Agent, way: Way) -> Result<Server, Failed> {
    let robot = Robot {
        world: part.world.clone(),
        name: part.name.clone(),
        reporter: Reporter::new(&part.name),
        way,
    };
    let server = agent.serve("fipa-contract-net", move |task| {
        let robot = robot.clone();
        async move { robot.bid(task).await.map_err(|error| error.to_string()) }
    })?;
    let service = ServiceDescription::new(&part.name, SERVICE);
    agent.df()?.register_service(service).await?;
    Ok(server)
}

impl Robot {
    async fn bid(&self, mut task: Task) -> Result<Reply, Failed> {
        let Some(Fetch { item, pose }) = words::hear(task.message()) else {
            return Ok(Reply::Refuse("expected an item and its pose".into()));
        };
        let mut hardware = Hardware::connect(&self.world, &self.name).await?;
        let cost = hardware.encoder().await?.sees(pose).distance();
        let bid = Claim::Bid {
            item: item.clone(),
            cost,
        };
        self.reporter.claim(bid);
        if !task.propose(words::say(&cost), TIMEOUT).await? {
            return Ok(Reply::Nothing);
        }
        let turned = Pose::new(0.0, 0.0, std::f64::consts::PI);
        let held = match self.way {
            Way::InFront { part } => {
                let front = pose.then(Pose::new(-0.9, 0.0, 0.0));
                hardware.drive_to(front, part).await?;
                false
            }
            Way::Grip { part } => {
                let behind = pose.then(Pose::new(0.1, 0.0, 0.0)).then(turned);
                hardware.drive_to(behind, part).await?;
                if !hardware.grip(true).await? {
                    return Ok(Reply::Failure("the gripper is empty".into()));
                }
                true
            }
        };
        self.reporter.claim(Claim::Fetched { item, held });
        Ok(Reply::Inform(words::say(&held).into()))
    }
}
