//! The program of a payload item: it owns its two interfaces, latches, and publishes the images of its camera. It runs
//! on a small module.

use std::sync::Arc;
use std::time::Duration;

use fipa::coalitions::LedCoalition;
use fipa::locks::Owned;
use fipa::platform::ServiceDescription;
use fipa::protocol::{DialogueError, Reply, Task};
use fipa::topics::{Publisher, Topic};
use fipa::{Domain, Message, Performative};
use tokio::sync::{Mutex, Notify};

use crate::face::Face;
use crate::hardware::{Hardware, HardwareError, IMAGE};
use crate::leading::give_back;
use crate::owning::{coalition_options, own_all};
use crate::part::{Failed, Mutant, Part, Stop};
use crate::report::{Claim, Reporter};
use crate::taking_part::{Event, Open, Side};
use crate::words::{self, IMAGES};

/// Images per second.
const RATE: f64 = 20.0;

/// The coalition that this item has founded.
type Founded = Arc<Mutex<Option<LedCoalition>>>;

struct Item<'a> {
    side: Side<'a>,
    hardware: Hardware,
    owned: [Arc<Owned>; 2],
    /// Whether the interface of the docking is latched.
    latched: bool,
    /// Whether the interface stays open: the conversation may go on, the docking does not.
    is_over: bool,
    founded: Founded,
}

/// Runs the program.
///
/// # Errors
/// If the domain or the hardware fails.
pub async fn run(part: &Part) -> Result<(), Failed> {
    let domain = Domain::open(&part.config()?).await?;
    let agent = domain.register(&part.name).await?;
    let mut hardware = Hardware::connect(&part.world, &part.name).await?;
    let reporter = Reporter::new(&part.name);
    let resources = ["a", "b"].map(|side| format!("{}/{side}", part.name));
    let ended = Arc::new(Notify::new());
    let owned = own_all(&agent, &resources, &reporter, &ended).await?;
    let camera = Hardware::connect(&part.world, &part.name).await?;
    let images = Topic::new(IMAGES).media_type("image/x-marker").rate(RATE);
    let camera = tokio::spawn(publish(agent.publisher(images)?, camera));
    let founded = Founded::default();
    let obeys_all = part.has(Mutant::LeaderNotFenced);
    let serving = (Arc::clone(&founded), reporter.clone());
    let _server = agent.serve("fipa-request", move |task| {
        let (founded, reporter) = serving.clone();
        grow(task, founded, reporter, obeys_all)
    })?;
    let membership = agent.join_coalition(crate::COALITION)?;
    let leading = tokio::spawn(give_back(agent.clone(), membership));
    let pose = words::say(&hardware.encoder().await?);
    let service = ServiceDescription::new(&part.name, "payload").with_property("pose", pose);
    agent.df()?.register_service(service).await?;
    reporter.claim(Claim::Ready);

    let mut item = Item {
        side: Side::new(part, agent, reporter),
        hardware,
        owned,
        latched: false,
        is_over: false,
        founded,
    };
    let mut stop = Stop::default();
    loop {
        tokio::select! {
            event = item.side.next() => match event? {
                Event::Letter(message) => item.handle(&message).await?,
                Event::Gone(agent) => item.open(&format!("{agent} is gone")).await?,
            },
            () = ended.notified() => item.lock_ended().await?,
            () = stop.requested() => break,
        }
    }
    camera.abort();
    leading.abort();
    drop(item);
    domain.close().await;
    Ok(())
}

/// Publishes images while there are subscribers.
async fn publish(images: Publisher, mut camera: Hardware) -> Result<(), Failed> {
    let mut ticks = tokio::time::interval(Duration::from_secs_f64(1.0 / RATE));
    loop {
        ticks.tick().await;
        if images.subscribers() > 0 {
            let mut image = images.loan(IMAGE)?;
            camera.camera("a", image.content_mut()).await?;
            images.publish_loan(image).await;
        }
    }
}

/// The leader changes the members of the coalition.
async fn grow(
    task: Task,
    founded: Founded,
    reporter: Reporter,
    obeys_all: bool,
) -> Result<Reply, DialogueError> {
    let founded = founded.lock().await;
    let (Some(coalition), Some(words)) = (&*founded, words::hear::<words::Members>(task.message()))
    else {
        return Ok(Reply::Refuse("this item has founded no coalition".into()));
    };
    let lock = format!("coalition/{}", coalition.name());
    if !obeys_all
        && let Err(refused) = reporter.admission("change", &lock, coalition.check(task.message()))
    {
        return Ok(Reply::Refuse(refused.into()));
    }
    Ok(match coalition.change(words.members).await {
        Ok(()) => Reply::Inform("changed".into()),
        Err(error) => Reply::Failure(error.to_string().into()),
    })
}

impl Item<'_> {
    async fn handle(&mut self, message: &Message) -> Result<(), HardwareError> {
        match (message.performative(), self.side.is_open(message)) {
            (Performative::Request, false) => self.begin(message).await,
            (Performative::Request, true) => self.latch(message).await?,
            (Performative::Confirm, true) => self.complete().await,
            (Performative::Cancel, _) => {
                self.open("cancelled").await?;
                self.side
                    .answer(message, Performative::Inform, "open")
                    .await;
            }
            _ => {}
        }
        Ok(())
    }

    /// Takes part in a docking whose master holds the lock of the interface.
    async fn begin(&mut self, message: &Message) {
        let owned = &self.owned;
        let begun = self.side.begin(
            message,
            |words| lock_of(owned, &words.face),
            |words| &words.client,
        );
        if begun.await {
            (self.latched, self.is_over) = (false, false);
        }
    }

    /// Latches, and tells the client.
    async fn latch(&mut self, message: &Message) -> Result<(), HardwareError> {
        let Some(Open { words, .. }) = &self.side.docking else {
            return Ok(());
        };
        let (client, contact) = (words.client.clone(), words.contact());
        let Some(owned) = lock_of(&self.owned, &contact.face) else {
            return Ok(());
        };
        let latched = match self.side.admit(message, owned, "latch") {
            Ok(()) if self.side.part.has(Mutant::ReportInvented) => Ok(()),
            Ok(()) if self.hardware.latch(&contact.face.side).await? => Ok(()),
            Ok(()) => Err("nothing is in reach of the interface".to_owned()),
            Err(refused) => Err(refused),
        };
        match latched {
            Ok(()) => {
                self.latched = true;
                let content = words::say(&contact);
                self.side.reporter.claim(Claim::Latched { contact });
                self.side.tell(&client, Performative::Inform, content).await;
            }
            Err(reason) => self.side.tell(&client, Performative::Failure, reason).await,
        }
        Ok(())
    }

    /// The client feels the contact: the first item founds the coalition.
    async fn complete(&mut self) {
        let Some(Open { words, .. }) = self.side.end() else {
            return;
        };
        if words.with.body == words.client {
            let members = [words.client.as_str(), &self.side.part.name];
            let founding =
                self.side
                    .agent
                    .found_coalition(&words.coalition, members, coalition_options());
            match founding.await {
                Ok(coalition) => *self.founded.lock().await = Some(coalition),
                Err(error) => self.side.reporter.noticed(error),
            }
        }
    }

    /// Opens the interface of a docking that does not go on.
    async fn open(&mut self, why: &str) -> Result<(), HardwareError> {
        let docking = self.side.docking.as_ref();
        let Some(face) = docking
            .filter(|_| !self.is_over)
            .map(|it| it.words.face.clone())
        else {
            return Ok(());
        };
        self.is_over = true;
        self.side.leave();
        if self.latched {
            self.hardware.open(&face.side).await?;
        }
        self.side.reporter.claim(Claim::Unlatched { face });
        self.side
            .reporter
            .noticed(format!("the docking has ended: {why}"));
        Ok(())
    }

    /// The master may hold the interface no longer.
    async fn lock_ended(&mut self) -> Result<(), HardwareError> {
        let held = |open: &Open| {
            let owned = lock_of(&self.owned, &open.words.face);
            owned.is_some_and(|owned| owned.status().holder.as_ref() == Some(&open.master))
        };
        match self.side.docking.as_ref().is_some_and(|open| !held(open)) {
            true => self.open("the lock of the interface has ended").await,
            false => Ok(()),
        }
    }
}

/// Returns the lock of an interface.
fn lock_of<'o>(owned: &'o [Arc<Owned>], face: &Face) -> Option<&'o Owned> {
    let resource = face.to_string();
    let found = owned.iter().find(|owned| owned.resource() == resource);
    found.map(AsRef::as_ref)
}
