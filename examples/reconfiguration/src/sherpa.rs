//! The program of the robot with the gripper: it guides a client to the interface of an item.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use fipa::actions::{Action, Execution};
use fipa::platform::ServiceDescription;
use fipa::{Agent, Domain, Message};
use serde::{Deserialize, Serialize};
use tokio::sync::{Mutex, Notify, mpsc};

use crate::COALITION;
use crate::face::Face;
use crate::fetching::{self, Way};
use crate::geometry::Pose;
use crate::guidance::Guidance;
use crate::part::{Failed, Mutant, Part, Stop};
use crate::report::{Claim, Reporter};
use crate::words::{self, DOCK, Docking};

/// The type of the service.
pub(crate) const SERVICE: &str = "guide";
/// The pose of the gripper at the body.
const GRIPPER: Pose = Pose::new(0.4, 0.0, 0.0);
/// Number of letters that wait for a docking.
const INBOX: usize = 64;
/// Maximum wait for locks and answers.
pub(crate) const TIMEOUT: Duration = Duration::from_secs(20);

/// The goal of the action `dock`.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct Dock {
    pub(crate) item: String,
    pub(crate) client: String,
    /// The interface that comes to the item.
    pub(crate) with: String,
}

/// The result of the action `dock`.
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename = "docked")]
pub(crate) struct DockResult {
    pub(crate) steps: u32,
}

/// The robot with the gripper.
pub(crate) struct Sherpa {
    pub(crate) part: Part,
    pub(crate) agent: Agent,
    pub(crate) reporter: Reporter,
    /// The launcher lets a stopped master go on.
    pub(crate) go_on: Arc<Notify>,
    /// Whether the launcher has stopped the master before.
    pub(crate) stopped: AtomicBool,
    /// The letters of the docking protocol.
    pub(crate) inbox: Mutex<mpsc::Receiver<Message>>,
}

/// Runs the program.
pub(crate) async fn run(part: &Part) -> Result<(), Failed> {
    let domain = Domain::open(&part.config()?).await?;
    let agent = domain.register(&part.name).await?;
    let fetching = fetching::offer(part, &agent, Way::Grip { part: GRIPPER }).await?;
    let guide = ServiceDescription::new("guide", SERVICE);
    agent.df()?.register_service(guide).await?;
    let go_on = Arc::new(Notify::new());
    let (letters, inbox) = mpsc::channel(INBOX);
    let reporter = Reporter::new(&part.name);
    let sherpa = Arc::new(Sherpa {
        part: part.clone(),
        agent: agent.clone(),
        reporter: reporter.clone(),
        go_on: Arc::clone(&go_on),
        stopped: AtomicBool::new(false),
        inbox: Mutex::new(inbox),
    });
    sherpa.reporter.claim(Claim::Ready);
    let action = Action::new("dock")
        .described("Guides a client to the interface of an item, which latches it")
        .parameter::<String>("item", "agent")
        .parameter::<String>("client", "agent")
        .parameter::<String>("with", "interface")
        .result::<DockResult>();
    let offer = agent.offer(action, move |goal: Dock, run: Execution| {
        let sherpa = Arc::clone(&sherpa);
        async move {
            sherpa
                .dock(goal, &run)
                .await
                .map_err(|error| error.to_string())
        }
    })?;
    let mut stop = Stop::default();
    // All letters are received, so that those of a docking that has ended do not fill the queue of the agent.
    loop {
        tokio::select! {
            goes_on = stop.line() => match goes_on {
                true => go_on.notify_one(),
                false => break,
            },
            incoming = agent.receive() => {
                let incoming = incoming?;
                match incoming.violation() {
                    Some(violation) => reporter.noticed(violation),
                    // A letter that finds no room is not awaited: the docking has ended.
                    None if incoming.message().protocol() == Some(DOCK) => drop(letters.try_send(incoming.into_message())),
                    None => {}
                }
            }
        }
    }
    drop((offer, fetching, agent));
    domain.close().await;
    Ok(())
}

impl Sherpa {
    async fn dock(&self, goal: Dock, run: &Execution) -> Result<DockResult, Failed> {
        let face = Face {
            body: goal.item.clone(),
            side: "a".to_owned(),
        };
        let with: Face = goal.with.try_into()?;
        let motors = format!("{}/drive", goal.client);
        let (item, carried) = (face.to_string(), with.to_string());
        let mut resources = vec![motors.as_str(), &carried];
        if !self.part.has(Mutant::LockSkipped) {
            resources.push(&item);
        }
        let lock = self.agent.lock_all_within(&resources, TIMEOUT).await?;
        let shown = |name: &str| {
            lock.fence_of(name)
                .map(|fence| (name.to_owned(), fence.to_string()))
        };
        let fences: BTreeMap<_, _> = resources.iter().filter_map(|name| shown(name)).collect();
        self.reporter.claim(Claim::Locked {
            fences: fences.clone(),
        });
        let words = Docking {
            face,
            with,
            client: goal.client,
            coalition: COALITION.to_owned(),
        };
        let docked = Guidance::new(self, &lock, words).run(run).await;
        if self.part.has(Mutant::ReservationKept) && docked.is_err() {
            std::mem::forget(lock);
        } else {
            lock.release();
            self.reporter.claim(Claim::Released { fences });
        }
        Ok(DockResult { steps: docked? })
    }

    /// Asks the directory where an item lies.
    pub(crate) async fn pose_of(&self, item: &str) -> Result<Pose, Failed> {
        let template = ServiceDescription::new(item, "payload").into();
        let found = self.agent.df()?.search(&template).await?;
        let services = found.iter().flat_map(|agent| &agent.services);
        let pose = services
            .filter(|it| it.name.as_deref() == Some(item))
            .find_map(words::pose);
        Ok(pose.ok_or_else(|| format!("no pose of {item} is listed"))?)
    }
}
