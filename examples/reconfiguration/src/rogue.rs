//! The program of an agent that breaks the rules: it reads the letters of its host, and sends what it may not send.

use fipa::admin::watch::{Event, WatchOptions, Watcher};
use fipa::locks::{Fence, fences_of, with_fences};
use fipa::{Agent, Domain, Message, Performative};

use crate::part::{Failed, Part, Stop};
use crate::report::{Claim, Reporter};
use crate::words::{self, DOCK, Members};

/// The agent that it tries to mislead.
const MASTER: &str = "sherpa";
/// The robot that gets the stack.
const CLIENT: &str = "crex";

/// Runs the program.
pub(crate) async fn run(part: &Part) -> Result<(), Failed> {
    let config = part.config()?;
    let mut watcher = Watcher::open(&config, WatchOptions::default()).await?;
    let domain = Domain::open(&config).await?;
    let agent = domain.register(&part.name).await?;
    let reporter = Reporter::new(&part.name);
    reporter.claim(Claim::Ready);
    let mut rogue = Rogue {
        agent,
        reporter,
        old: None,
        founder: None,
    };
    let mut stop = Stop::default();
    loop {
        tokio::select! {
            event = watcher.next() => if let Event::Letter(passage) = event
                && let Some(message) = &passage.message {
                rogue.disturb(message, &passage.receiver).await;
            },
            () = stop.requested() => break,
        }
    }
    drop(rogue);
    domain.close().await;
    Ok(())
}

struct Rogue {
    agent: Agent,
    reporter: Reporter,
    /// An item and the fences of a docking at it, which become old.
    old: Option<(String, Vec<Fence>)>,
    /// The first item, which founds the coalition.
    founder: Option<String>,
}

impl Rogue {
    async fn disturb(&mut self, message: &Message, receiver: &str) {
        let sender = message
            .sender()
            .map(fipa::AgentId::name)
            .unwrap_or_default();
        if sender == self.agent.name() {
            return;
        }
        let protocol = message.protocol().unwrap_or_default();
        match (message.performative(), protocol) {
            // An award that the operator has not given.
            (Performative::Cfp, _) if receiver == MASTER => {
                self.send(message, Performative::AcceptProposal, MASTER, &[])
                    .await;
            }
            // A contact that the client has not felt.
            (Performative::Request, DOCK)
                if sender == MASTER && receiver.starts_with("payload") =>
            {
                let fences = fences_of(message).unwrap_or_default();
                self.old
                    .get_or_insert_with(|| (receiver.to_owned(), fences));
                self.send(message, Performative::Confirm, MASTER, &[]).await;
            }
            // The docking is over: its fences are old.
            (Performative::Confirm, DOCK) if sender == MASTER => {
                // Members that the leader does not want.
                if let Some(founder) = &self.founder {
                    let words = words::say(&Members {
                        members: vec![
                            CLIENT.to_owned(),
                            founder.clone(),
                            self.agent.name().to_owned(),
                        ],
                    });
                    let change = self
                        .agent
                        .message(Performative::Request)
                        .receiver(founder.as_str());
                    let change = change
                        .protocol("fipa-request")
                        .conversation_id(self.agent.unique_id());
                    self.report("request", founder, change.content(words)).await;
                }
                if let Some((item, fences)) = self.old.take() {
                    self.founder.get_or_insert_with(|| item.clone());
                    self.send(message, Performative::Request, &item, &fences)
                        .await;
                    let content = format!(
                        r#"{{"face":"{item}/a","with":"crex/top","client":"crex","coalition":"crex_stack"}}"#
                    );
                    let dock = self
                        .agent
                        .message(Performative::Request)
                        .receiver(item.as_str());
                    let dock = dock.protocol(DOCK).conversation_id(self.agent.unique_id());
                    self.report(
                        "request",
                        &item,
                        with_fences(dock.content(content), &fences),
                    )
                    .await;
                }
            }
            _ => {}
        }
    }

    /// Sends an act within the conversation of a message.
    async fn send(&self, of: &Message, act: Performative, to: &str, fences: &[Fence]) {
        let shown = act.to_string();
        let mut message = self.agent.message(act).receiver(to);
        if let Some(protocol) = of.protocol() {
            message = message.protocol(protocol);
        }
        if let Some(conversation) = of.conversation_id() {
            message = message.conversation_id(conversation);
        }
        self.report(&shown, to, with_fences(message, fences)).await;
    }

    async fn report(&self, act: &str, to: &str, message: fipa::MessageBuilder) {
        self.reporter.claim(Claim::Fault {
            what: format!("rogue sends {act} to {to}"),
        });
        self.reporter.send(&self.agent, message).await;
    }
}
