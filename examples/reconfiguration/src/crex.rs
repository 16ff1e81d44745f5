//! The program of the mobile robot: it goes where a master guides it, and leads the robot that it becomes a part of.

use std::sync::Arc;
use std::time::Duration;

use fipa::coalitions::{CoalitionState, Membership};
use fipa::locks::Owned;
use fipa::topics::{Publisher, Topic};
use fipa::{Domain, Message, Performative};

use crate::COALITION;
use crate::face::Contact;
use crate::fetching::{self, Way};
use crate::geometry::Pose;
use crate::hardware::Hardware;
use crate::looking::{self, Stack};
use crate::owning::own_all;
use crate::part::{Failed, Part, Stop};
use crate::report::{Claim, Reporter};
use crate::taking_part::{Event, Open, Side};
use crate::words::{self, Drive, Members, POSE};

/// The pose of its interface at its body.
const TOP: Pose = Pose::new(0.3, 0.0, 0.0);
/// The length of an item, in meters.
const ITEM: f64 = 0.2;
/// Poses per second.
const RATE: f64 = 20.0;
/// Maximum wait for the answer of another agent.
const TIMEOUT: Duration = Duration::from_secs(10);

struct Crex<'a> {
    side: Side<'a>,
    hardware: Hardware,
    drive: Arc<Owned>,
    membership: Membership,
    /// The members as they were reported last.
    members: Option<fipa::Members>,
    stack: Stack,
}

/// Runs the program.
pub(crate) async fn run(part: &Part) -> Result<(), Failed> {
    let domain = Domain::open(&part.config()?).await?;
    let agent = domain.register(&part.name).await?;
    let reporter = Reporter::new(&part.name);
    let resources = ["drive", "top"].map(|resource| format!("{}/{resource}", part.name));
    let [drive, _top] = own_all(&agent, &resources, &reporter, &Arc::default()).await?;
    let stack = Stack::default();
    let poses = agent.publisher(Topic::new(POSE).rate(RATE))?;
    let encoder = Hardware::connect(&part.world, &part.name).await?;
    let publishing = tokio::spawn(publish(poses, encoder, Arc::clone(&stack)));
    let membership = agent.join_coalition(COALITION)?;
    let _fetching = fetching::offer(part, &agent, Way::InFront { part: TOP }).await?;
    let _looking = looking::offer(&agent, &stack, &reporter)?;
    reporter.claim(Claim::Ready);

    let mut changes = membership.changes();
    let mut crex = Crex {
        side: Side::new(part, agent, reporter),
        hardware: Hardware::connect(&part.world, &part.name).await?,
        drive,
        membership,
        members: None,
        stack,
    };
    let mut stop = Stop::default();
    loop {
        tokio::select! {
            event = crex.side.next() => match event? {
                Event::Letter(message) => crex.handle(&message).await?,
                Event::Gone(agent) => crex.end(&format!("{agent} is gone")).await?,
            },
            Some(state) = changes.next() => crex.changed(&state),
            () = stop.requested() => break,
        }
    }
    publishing.abort();
    drop((crex, _looking, _fetching));
    domain.close().await;
    Ok(())
}

/// Publishes the pose of the free interface.
async fn publish(poses: Publisher, mut encoder: Hardware, stack: Stack) -> Result<(), Failed> {
    let mut ticks = tokio::time::interval(Duration::from_secs_f64(1.0 / RATE));
    loop {
        ticks.tick().await;
        let front = front(&stack.lock().await);
        let pose = encoder.encoder().await?.then(front);
        poses.publish(words::say(&pose)).await;
    }
}

/// Returns the pose of the free interface at the body.
fn front(stack: &[String]) -> Pose {
    let items = u32::try_from(stack.len()).unwrap_or(u32::MAX);
    TOP.then(Pose::new(ITEM * f64::from(items), 0.0, 0.0))
}

impl Crex<'_> {
    async fn handle(&mut self, message: &Message) -> Result<(), Failed> {
        match (message.performative(), self.side.is_open(message)) {
            (Performative::Request, false) => {
                // Its motors obey the holder of their lock.
                let drive = Arc::clone(&self.drive);
                let begun = self
                    .side
                    .begin(message, |_| Some(&*drive), |words| &words.face.body);
                begun.await;
            }
            (Performative::Request, true) => self.drive(message).await?,
            (Performative::Inform, true) => self.feel().await?,
            (Performative::Failure, true) => {
                self.tell(Performative::Failure, &message.text()).await
            }
            (Performative::Cancel, _) => {
                self.end("cancelled").await?;
                self.side
                    .answer(message, Performative::Inform, "stopped")
                    .await;
            }
            _ => {}
        }
        Ok(())
    }

    /// Moves its free interface at the velocity that the master wants.
    async fn drive(&mut self, message: &Message) -> Result<(), Failed> {
        let asked = words::hear(message).ok_or_else(|| "expected a velocity".to_owned());
        let admitted = asked.and_then(|drive: Drive| {
            let admitted = self.side.admit(message, &self.drive, "drive");
            admitted.map(|()| drive.twist)
        });
        let (act, content) = match admitted {
            Ok(twist) => {
                let front = front(&self.stack.lock().await);
                self.hardware.drive(twist.of_body(front)).await?;
                let pose = self.hardware.encoder().await?.then(front);
                (Performative::Inform, words::say(&pose))
            }
            Err(reason) => (Performative::Refuse, reason),
        };
        self.side.answer(message, act, content).await;
        Ok(())
    }

    /// The item has latched: confirms if the interface feels it.
    async fn feel(&mut self) -> Result<(), Failed> {
        let Some(Open { words, .. }) = &self.side.docking else {
            return Ok(());
        };
        let contact = words.contact();
        let Contact { face, other } = &contact;
        // The interface of an item is asked by the program of the item.
        let felt = other.body != self.side.part.name
            || self.hardware.contact(&other.side).await?.as_ref() == Some(face);
        self.hardware.stop().await?;
        if !felt {
            let nothing = "the interface feels nothing";
            self.tell(Performative::Disconfirm, nothing).await;
            return Ok(());
        }
        let item = face.body.clone();
        self.side.reporter.claim(Claim::Confirmed { contact });
        self.tell(Performative::Confirm, "").await;
        self.side.end();
        self.joined(item).await;
        Ok(())
    }

    /// Takes the item into the stack, and asks the founder to list it.
    async fn joined(&mut self, item: String) {
        let mut stack = self.stack.lock().await;
        stack.push(item);
        let [founder, _, ..] = stack.as_slice() else {
            return;
        };
        let (founder, mut members) = (founder.clone(), vec![self.side.part.name.clone()]);
        members.extend(stack.iter().cloned());
        drop(stack);
        let agent = &self.side.agent;
        let ask = agent.message(Performative::Request).receiver(founder);
        let ask = ask.content(words::say(&Members { members }));
        let asked = async {
            // It leads as soon as the first item has founded the coalition.
            tokio::time::timeout(TIMEOUT, self.membership.leads()).await??;
            let ask = self.membership.guard(ask)?;
            let mut request = agent.request(ask, TIMEOUT).await?;
            Ok::<_, Failed>(request.result().await?)
        };
        if let Err(error) = asked.await {
            self.side.reporter.noticed(error);
        }
    }

    /// The coalition may have other members, or another leader.
    fn changed(&mut self, state: &CoalitionState) {
        if self.members == state.members {
            return;
        }
        self.members.clone_from(&state.members);
        let members = self.members.as_ref();
        let names = members.map(|it| it.names().iter().map(ToString::to_string).collect());
        self.side.reporter.claim(Claim::Coalition {
            name: COALITION.to_owned(),
            members: names.unwrap_or_default(),
            leader: members.and_then(|it| it.leader()).map(ToString::to_string),
        });
    }

    /// Ends the docking.
    async fn end(&mut self, why: &str) -> Result<(), Failed> {
        self.hardware.stop().await?;
        if self.side.end().is_some() {
            self.side
                .reporter
                .noticed(format!("the docking has ended: {why}"));
        }
        Ok(())
    }

    /// Tells the master of the docking.
    async fn tell(&self, act: Performative, content: &str) {
        if let Some(open) = &self.side.docking {
            self.side.tell(&open.master, act, content).await;
        }
    }
}
