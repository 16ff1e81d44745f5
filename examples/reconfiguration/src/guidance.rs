//! A docking from the view of its master: it guides the client to the interface of the item, and lets the item latch.

use std::f64::consts::PI;
use std::sync::atomic::Ordering;

use fipa::actions::{Execution, Progress};
use fipa::locks::Lock;
use fipa::protocol::{PartnerEvent, PartnerWatch, Subscription};
use fipa::{AgentId, Message, MessageBuilder, Performative};
use tokio::time::Instant;

use crate::Fault;
use crate::geometry::{Pose, Twist};
use crate::hardware::{Hardware, Sight};
use crate::part::Failed;
use crate::report::Claim;
use crate::sherpa::{Sherpa, TIMEOUT};
use crate::words::{self, DOCK, Docking, Drive, IMAGES, POSE};

/// Maximum error of the position before the latch, in meters, and of the angle, in radians.
const ALIGNED: (f64, f64) = (0.005, 0.02);

/// A docking from the view of the master.
pub(crate) struct Guidance<'a> {
    sherpa: &'a Sherpa,
    lock: &'a Lock,
    conversation: String,
    partners: PartnerWatch,
    words: Docking,
    /// The agents that have agreed, the client first.
    asked: Vec<String>,
}

impl<'a> Guidance<'a> {
    pub(crate) fn new(sherpa: &'a Sherpa, lock: &'a Lock, words: Docking) -> Self {
        Self {
            sherpa,
            lock,
            conversation: sherpa.agent.unique_id(),
            partners: sherpa.agent.watch_partners(),
            words,
            asked: Vec::new(),
        }
    }

    /// Guides the client until it is docked. Returns the number of steps. A docking that fails is cancelled.
    pub(crate) async fn run(mut self, run: &Execution) -> Result<u32, Failed> {
        let guided = self.guide(run).await;
        if let Err(error) = &guided {
            self.cancel().await;
            self.sherpa.reporter.claim(Claim::NotDocked {
                conversation: self.conversation,
                reason: error.to_string(),
            });
        }
        guided
    }

    async fn guide(&mut self, run: &Execution) -> Result<u32, Failed> {
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
                Some(seen) => (seen.sees(Pose::new(0.0, 0.0, PI)), "align"),
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
            contact: self.words.contact(),
            steps,
            seconds: began.elapsed().as_secs_f64(),
        });
        // The item is docked, also if the link breaks now.
        for ended in [poses.cancel(TIMEOUT).await, images.cancel(TIMEOUT).await] {
            if let Err(error) = ended {
                sherpa.reporter.noticed(error);
            }
        }
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
        self.send(self.message(Performative::Confirm, item)).await;
        self.asked.clear();
        // The gripper lets the item go: it belongs to the other robot now.
        let mut hardware = Hardware::connect(&sherpa.part.world, sherpa.agent.name()).await?;
        hardware.grip(false).await?;
        Ok(())
    }

    /// Cancels the docking with all that have agreed, the client first. If the client does not get the cancel, the item
    /// opens when its lock is released.
    async fn cancel(&mut self) {
        for agent in std::mem::take(&mut self.asked) {
            if !self.send(self.message(Performative::Cancel, &agent)).await {
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
        match self.send(self.lock.guard(ask)).await {
            true => self.answer(from).await,
            false => Err(format!("{to} cannot be reached").into()),
        }
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
            let sender = message.sender().map(AgentId::name);
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
        let sight = Sight::find(words::bytes(image.message()));
        let sight = sight.filter(|sight| sight.marker == self.words.with);
        Ok(sight.map(|sight| sight.pose))
    }

    async fn subscribe(&self, to: &str, topic: &str) -> Result<Subscription, Failed> {
        let agent = &self.sherpa.agent;
        let subscribe = agent.message(Performative::Subscribe).receiver(to);
        Ok(agent
            .subscribe(subscribe.content(topic.to_owned()), TIMEOUT)
            .await?)
    }

    /// Returns whether the message is delivered.
    async fn send(&self, message: MessageBuilder) -> bool {
        self.sherpa.reporter.send(&self.sherpa.agent, message).await
    }

    fn message(&self, act: Performative, to: &str) -> MessageBuilder {
        let message = self.sherpa.agent.message(act).receiver(to);
        message.protocol(DOCK).conversation_id(&self.conversation)
    }
}
