//! The program of the robot with the gripper: it guides a client to the interface of an item.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use fipa::actions::{Action, Execution, Progress};
use fipa::locks::Lock;
use fipa::platform::{AgentDescription, ServiceDescription};
use fipa::protocol::{PartnerEvent, PartnerWatch, Subscription};
use fipa::{Agent, Domain, Message, Performative};
use serde::{Deserialize, Serialize};
use tokio::sync::{Mutex, Notify, mpsc};
use tokio::time::Instant;

use crate::face::{Contact, Face};
use crate::fetching::{self, Way};
use crate::geometry::{Pose, Twist};
use crate::hardware::{Hardware, Sight};
use crate::part::{Failed, Mutant, Part, Stop};
use crate::report::{Claim, Reporter};
use crate::words::{self, DOCK, Docking, Drive, IMAGES, POSE};
use crate::{COALITION, Fault};

/// The type of the service.
pub(crate) const SERVICE: &str = "guide";
/// The pose of the gripper at the body.
const GRIPPER: Pose = Pose::new(0.4, 0.0, 0.0);
/// Maximum error of the position before the latch, in meters, and of the angle, in radians.
const ALIGNED: (f64, f64) = (0.005, 0.02);
/// Number of letters that wait for a docking.
const INBOX: usize = 64;
/// Maximum wait for locks and answers.
const TIMEOUT: Duration = Duration::from_secs(20);

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

struct Sherpa {
    part: Part,
    agent: Agent,
    reporter: Reporter,
    world: PathBuf,
    /// The launcher lets a stopped master go on.
    go_on: Arc<Notify>,
    stopped: AtomicBool,
    /// The letters of the docking protocol.
    inbox: Mutex<mpsc::Receiver<Message>>,
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
        world: part.world.clone(),
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
        let mut guidance = Guidance {
            sherpa: self,
            lock: &lock,
            conversation: self.agent.unique_id(),
            partners: self.agent.watch_partners(),
            words,
            asked: Vec::new(),
        };
        let docked = guidance.run(run).await;
        let docked = match docked {
            Ok(steps) => Ok(DockResult { steps }),
            Err(error) => {
                guidance.cancel().await;
                self.reporter.claim(Claim::NotDocked {
                    conversation: guidance.conversation.clone(),
                    reason: error.to_string(),
                });
                Err(error)
            }
        };
        if self.part.has(Mutant::ReservationKept) && docked.is_err() {
            std::mem::forget(lock);
        } else {
            lock.release();
            self.reporter.claim(Claim::Released { fences });
        }
        docked
    }

    /// Asks the directory where an item lies.
    async fn pose_of(&self, item: &str) -> Result<Pose, Failed> {
        let template = AgentDescription {
            services: vec![ServiceDescription::new(item, "payload")],
            ..AgentDescription::default()
        };
        let found = self.agent.df()?.search(&template).await?;
        let services = found.iter().flat_map(|agent| &agent.services);
        let pose = services
            .filter(|it| it.name.as_deref() == Some(item))
            .find_map(crate::operator::pose);
        Ok(pose.ok_or_else(|| format!("no pose of {item} is listed"))?)
    }
}

/// A docking from the view of the master.
struct Guidance<'a> {
    sherpa: &'a Sherpa,
    lock: &'a Lock,
    conversation: String,
    partners: PartnerWatch,
    words: Docking,
    /// The agents that have agreed, the client first.
    asked: Vec<String>,
}

impl Guidance<'_> {
    /// Guides the client until it is docked. Returns the number of steps.
    async fn run(&mut self, run: &Execution) -> Result<u32, Failed> {
        let (sherpa, began) = (self.sherpa, Instant::now());
        let (client, item) = (self.words.client.clone(), self.words.face.body.clone());
        let place = sherpa.pose_of(&item).await?.then(Pose::new(-0.6, 0.0, 0.0));
        let mut poses = self.subscribe(&client, POSE).await?;
        let mut images = self.subscribe(&item, IMAGES).await?;
        for agent in [&client, &item] {
            self.partners.add(agent);
            let agreed = self.ask(agent, words::say(&self.words), agent).await?;
            if *agreed.performative() != Performative::Agree {
                return Err(format!("{agent} refuses: {}", agreed.text()).into());
            }
            self.asked.push(agent.clone());
        }
        let (mut steps, mut good) = (0, 0);
        while good < 2 {
            if let Some(cause) = run.stop_cause() {
                return Err(format!("{cause:?}").to_lowercase().into());
            }
            if !self.lock.is_held() {
                return Err("the locks are lost".into());
            }
            let (error, phase) = match self.sight(&mut images).await? {
                Some(seen) => (
                    seen.sees(Pose::new(0.0, 0.0, std::f64::consts::PI)),
                    "align",
                ),
                None => {
                    let pose = self.while_partners_live(poses.next()).await??;
                    let pose: Pose = words::hear(pose.message()).ok_or("expected a pose")?;
                    (pose.sees(place), "approach")
                }
            };
            steps += 1;
            let is_good =
                phase == "align" && error.distance() < ALIGNED.0 && error.yaw.abs() < ALIGNED.1;
            good = if is_good { good + 1 } else { 0 };
            sherpa.reporter.claim(Claim::Step {
                conversation: self.conversation.clone(),
                error_mm: error.distance() * 1e3,
                phase: phase.to_owned(),
            });
            run.progress(Progress::fraction(if phase == "align" { 0.5 } else { 0.0 }).note(phase));
            let twist = if good > 0 {
                Twist::default()
            } else {
                Twist::towards(error)
            };
            let moved = self
                .ask(&client, words::say(&Drive { twist }), &client)
                .await?;
            if *moved.performative() != Performative::Inform {
                return Err(format!("{client} refuses: {}", moved.text()).into());
            }
        }
        self.latch(&client, &item).await?;
        sherpa.reporter.claim(Claim::Docked {
            conversation: self.conversation.clone(),
            contact: Contact {
                face: self.words.face.clone(),
                other: self.words.with.clone(),
            },
            steps,
            seconds: began.elapsed().as_secs_f64(),
        });
        poses.cancel(TIMEOUT).await?;
        images.cancel(TIMEOUT).await?;
        Ok(steps)
    }

    /// Lets the item latch, and waits until the client feels it.
    async fn latch(&mut self, client: &str, item: &str) -> Result<(), Failed> {
        let sherpa = self.sherpa;
        sherpa.reporter.claim(Claim::Aligned {
            conversation: self.conversation.clone(),
        });
        // The launcher stops this process here, once.
        if sherpa.part.fault == Some(Fault::MasterStopped)
            && !sherpa.stopped.swap(true, Ordering::Relaxed)
        {
            sherpa.go_on.notified().await;
        }
        let felt = self.ask(item, "latch".to_owned(), client).await?;
        if *felt.performative() != Performative::Confirm {
            return Err(format!("{item} is not latched: {}", felt.text()).into());
        }
        let confirm = self.message(Performative::Confirm, item);
        sherpa.reporter.send(&sherpa.agent, confirm).await;
        self.asked.clear();
        // The gripper lets the item go: it belongs to the other robot now.
        let mut hardware = Hardware::connect(&sherpa.world, sherpa.agent.name()).await?;
        hardware.grip(false).await?;
        Ok(())
    }

    /// Cancels the docking with all that have agreed, the client first. If the client does not get the cancel, the item
    /// opens when its lock is released.
    async fn cancel(&mut self) {
        for agent in std::mem::take(&mut self.asked) {
            let cancel = self.message(Performative::Cancel, &agent);
            if !self.sherpa.reporter.send(&self.sherpa.agent, cancel).await {
                return;
            }
            if let Err(error) = self.answer(&agent).await {
                self.sherpa.reporter.noticed(error);
            }
        }
    }

    /// Sends a request, and returns the answer, which comes from `from`.
    async fn ask(&mut self, to: &str, content: String, from: &str) -> Result<Message, Failed> {
        let ask = self.message(Performative::Request, to).content(content);
        if !self
            .sherpa
            .reporter
            .send(&self.sherpa.agent, self.lock.guard(ask))
            .await
        {
            return Err(format!("{to} cannot be reached").into());
        }
        self.answer(from).await
    }

    /// Waits for the next message of an agent in this conversation.
    async fn answer(&mut self, from: &str) -> Result<Message, Failed> {
        let sherpa = self.sherpa;
        let until = Instant::now() + TIMEOUT;
        loop {
            let mut inbox = sherpa.inbox.lock().await;
            let next = tokio::time::timeout_at(until, inbox.recv());
            let Ok(message) = self.while_partners_live(next).await? else {
                return Err(format!("{from} does not answer").into());
            };
            let message = message.ok_or("the program ends")?;
            let sender = message.sender().map(fipa::AgentId::name);
            if message.conversation_id() == Some(&self.conversation) && sender == Some(from) {
                return Ok(message);
            }
        }
    }

    /// Waits for this, unless a partner is gone.
    async fn while_partners_live<T>(&mut self, wait: impl Future<Output = T>) -> Result<T, Failed> {
        tokio::pin!(wait);
        loop {
            tokio::select! {
                biased;
                done = &mut wait => return Ok(done),
                event = self.partners.next() => match event {
                    PartnerEvent::Gone { agent } => {
                        self.asked.retain(|asked| *asked != agent);
                        return Err(format!("{agent} is gone").into());
                    }
                    PartnerEvent::Unreachable { agent, .. } => {
                        self.sherpa.reporter.noticed(format!("{agent} is unreachable"));
                    }
                    _ => {}
                },
            }
        }
    }

    /// Returns the pose of the client's interface, if the camera sees it.
    async fn sight(&mut self, images: &mut Subscription) -> Result<Option<Pose>, Failed> {
        let image = self.while_partners_live(images.next()).await??;
        let bytes = image.message().content().map_or(&[][..], |content| content);
        let sight = Sight::find(bytes).filter(|sight| sight.marker == self.words.with);
        Ok(sight.map(|sight| sight.pose))
    }

    async fn subscribe(&self, to: &str, topic: &str) -> Result<Subscription, Failed> {
        let agent = &self.sherpa.agent;
        let subscribe = agent.message(Performative::Subscribe).receiver(to);
        Ok(agent
            .subscribe(subscribe.content(topic.to_owned()), TIMEOUT)
            .await?)
    }

    fn message(&self, act: Performative, to: &str) -> fipa::MessageBuilder {
        let message = self.sherpa.agent.message(act).receiver(to);
        message.protocol(DOCK).conversation_id(&self.conversation)
    }
}
