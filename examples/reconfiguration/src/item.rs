//! The program of a payload item: it owns its two interfaces, latches, and publishes the images of its camera. It runs
//! on a small module.

use std::sync::Arc;
use std::time::Duration;

use fipa::coalitions::LedCoalition;
use fipa::locks::Owned;
use fipa::platform::{Property, ServiceDescription};
use fipa::protocol::{DialogueError, PartnerEvent, PartnerWatch, Reply, Task};
use fipa::topics::{Publisher, Topic};
use fipa::{Agent, Domain, Message, Performative};
use tokio::sync::{Mutex, Notify};

use crate::face::{Contact, Face};
use crate::hardware::{Hardware, HardwareError, IMAGE};
use crate::owning::{coalition_options, own_all};
use crate::part::{Failed, Mutant, Part, Stop};
use crate::report::{Claim, Reporter};
use crate::words::{self, DOCK, Docking, IMAGES};

/// Images per second.
const RATE: f64 = 20.0;

/// The coalition that this item has founded.
type Founded = Arc<Mutex<Option<LedCoalition>>>;

struct Item<'a> {
    part: &'a Part,
    agent: Agent,
    reporter: Reporter,
    hardware: Hardware,
    owned: [Arc<Owned>; 2],
    partners: PartnerWatch,
    docking: Option<Open>,
    founded: Founded,
}

/// A docking that has begun.
struct Open {
    conversation: String,
    master: String,
    words: Docking,
    latched: bool,
    /// Whether the interface stays open: the conversation may go on, the docking does not.
    is_over: bool,
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
    let serving = (
        Arc::clone(&founded),
        reporter.clone(),
        part.has(Mutant::LeaderNotFenced),
    );
    let _server = agent.serve("fipa-request", move |task| {
        let (founded, reporter, obeys_all) = serving.clone();
        async move { grow(task, founded, reporter, obeys_all).await }
    })?;
    let _member = agent.join_coalition(crate::COALITION)?;
    let pose = words::say(&hardware.encoder().await?);
    let mut service = ServiceDescription::new(&part.name, "payload");
    service.properties.push(Property::new("pose", pose));
    agent.df()?.register_service(service).await?;
    reporter.claim(Claim::Ready);

    let mut item = Item {
        part,
        partners: agent.watch_partners(),
        agent,
        reporter,
        hardware,
        owned,
        docking: None,
        founded,
    };
    let mut stop = Stop::default();
    loop {
        tokio::select! {
            incoming = item.agent.receive() => {
                let incoming = incoming?;
                match incoming.violation() {
                    Some(violation) => item.reporter.noticed(violation),
                    None if incoming.message().protocol() == Some(DOCK) => item.handle(incoming.message()).await?,
                    None => {}
                }
            }
            event = item.partners.next() => item.partner(event).await?,
            () = ended.notified() => item.lock_ended().await?,
            () = stop.requested() => break,
        }
    }
    camera.abort();
    drop(item);
    domain.close().await;
    Ok(())
}

/// Publishes images as long as somebody looks at them.
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
        let conversation = message.conversation_id().unwrap_or_default();
        let open = self
            .docking
            .as_ref()
            .filter(|it| it.conversation == conversation);
        match (message.performative(), open.is_some()) {
            (Performative::Request, false) => self.begin(message).await,
            (Performative::Request, true) => self.latch(message).await?,
            (Performative::Confirm, true) => self.complete().await,
            (Performative::Cancel, _) => {
                self.open("cancelled").await?;
                self.answer(message, Performative::Inform, String::from("open"))
                    .await;
            }
            _ => {}
        }
        Ok(())
    }

    /// Takes part in a docking, if the interface is free and its lock is held by the master.
    async fn begin(&mut self, message: &Message) {
        let Some(words) = words::hear::<Docking>(message) else {
            return self
                .answer(message, Performative::Refuse, "expected a docking".into())
                .await;
        };
        if let Err(reason) = self.admit(message, &words.face, "dock") {
            return self.answer(message, Performative::Refuse, reason).await;
        }
        let master = message
            .sender()
            .map(|id| id.name().to_owned())
            .unwrap_or_default();
        for agent in [&master, &words.client] {
            self.partners.add(agent);
        }
        self.docking = Some(Open {
            conversation: message.conversation_id().unwrap_or_default().to_owned(),
            master,
            words,
            latched: false,
            is_over: false,
        });
        self.answer(message, Performative::Agree, String::new())
            .await;
    }

    /// Latches, and tells the client.
    async fn latch(&mut self, message: &Message) -> Result<(), HardwareError> {
        let Some(Open { words, .. }) = &self.docking else {
            return Ok(());
        };
        let (face, with, client) = (words.face.clone(), words.with.clone(), words.client.clone());
        let contact = Contact { face, other: with };
        let latched = match self.admit(message, &contact.face, "latch") {
            Ok(()) if self.part.has(Mutant::ReportInvented) => Ok(()),
            Ok(()) if self.hardware.latch(&contact.face.side).await? => Ok(()),
            Ok(()) => Err("nothing is in reach of the interface".to_owned()),
            Err(refused) => Err(refused),
        };
        let (act, content) = match latched {
            Ok(()) => (Performative::Inform, words::say(&contact)),
            Err(reason) => (Performative::Failure, reason),
        };
        if act == Performative::Inform {
            self.reporter.claim(Claim::Latched { contact });
            if let Some(docking) = &mut self.docking {
                docking.latched = true;
            }
        }
        let tell = self.agent.message(act).receiver(client).protocol(DOCK);
        let conversation = message.conversation_id().unwrap_or_default();
        self.send(tell.conversation_id(conversation).content(content))
            .await;
        Ok(())
    }

    /// The client feels the contact: the first item founds the coalition.
    async fn complete(&mut self) {
        let Some(Open { words, master, .. }) = self.docking.take() else {
            return;
        };
        for agent in [&master, &words.client] {
            self.partners.remove(agent);
        }
        if words.with.body == words.client {
            let members = [words.client.as_str(), &self.part.name];
            let founding =
                self.agent
                    .found_coalition(&words.coalition, members, coalition_options());
            match founding.await {
                Ok(coalition) => *self.founded.lock().await = Some(coalition),
                Err(error) => self.reporter.noticed(error),
            }
        }
    }

    /// Opens the interface of a docking that does not go on.
    async fn open(&mut self, why: &str) -> Result<(), HardwareError> {
        let Some(docking) = self.docking.as_mut().filter(|docking| !docking.is_over) else {
            return Ok(());
        };
        docking.is_over = true;
        for agent in [&docking.master, &docking.words.client] {
            self.partners.remove(agent);
        }
        let face = docking.words.face.clone();
        if docking.latched {
            self.hardware.open(&face.side).await?;
        }
        self.reporter.claim(Claim::Unlatched { face });
        self.reporter
            .noticed(format!("the docking has ended: {why}"));
        Ok(())
    }

    async fn partner(&mut self, event: PartnerEvent) -> Result<(), HardwareError> {
        match event {
            PartnerEvent::Gone { agent } => self.open(&format!("{agent} is gone")).await?,
            PartnerEvent::Unreachable { agent, .. } => {
                self.reporter.noticed(format!("{agent} is unreachable"))
            }
            _ => {}
        }
        Ok(())
    }

    /// The master may hold the interface no longer.
    async fn lock_ended(&mut self) -> Result<(), HardwareError> {
        let held = |open: &Open| {
            let resource = open.words.face.to_string();
            let owned = self.owned.iter().find(|owned| owned.resource() == resource);
            owned.is_some_and(|owned| owned.status().holder.as_ref() == Some(&open.master))
        };
        match self.docking.as_ref().is_some_and(|open| !held(open)) {
            true => self.open("the lock of the interface has ended").await,
            false => Ok(()),
        }
    }

    /// Checks the fence of a command for an interface.
    fn admit(&self, message: &Message, face: &Face, action: &str) -> Result<(), String> {
        if self.part.has(Mutant::FencesUnchecked) {
            return Ok(());
        }
        let resource = face.to_string();
        let owned = self.owned.iter().find(|owned| owned.resource() == resource);
        let Some(owned) = owned else {
            return Err(format!("this item has no interface {resource}"));
        };
        self.reporter
            .admission(action, &resource, owned.check(message))
    }

    async fn answer(&self, message: &Message, act: Performative, content: String) {
        self.send(self.agent.reply(message, act).content(content))
            .await;
    }

    async fn send(&self, message: fipa::MessageBuilder) {
        self.reporter.send(&self.agent, message).await;
    }
}
