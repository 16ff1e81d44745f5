//! The parts of a docking that its client and its item have in common: the fence of each command, the answers, and the
//! partners that may be gone.

use fipa::error::ReceiveError;
use fipa::locks::Owned;
use fipa::protocol::{PartnerEvent, PartnerWatch};
use fipa::{Agent, Message, MessageBuilder, Performative};

use crate::part::{Mutant, Part};
use crate::report::Reporter;
use crate::words::{self, DOCK, Docking};

/// A docking that has begun.
pub(crate) struct Open {
    pub(crate) conversation: String,
    pub(crate) master: String,
    /// The agent beside the master in whose absence the docking cannot go on.
    other: String,
    pub(crate) words: Docking,
}

/// The event for which a side waits.
pub(crate) enum Event {
    /// A letter of the protocol.
    Letter(Box<Message>),
    /// The agent of this name is gone.
    Gone(String),
}

/// The side of an agent that a master asks to dock.
pub(crate) struct Side<'a> {
    pub(crate) part: &'a Part,
    pub(crate) agent: Agent,
    pub(crate) reporter: Reporter,
    partners: PartnerWatch,
    pub(crate) docking: Option<Open>,
}

impl<'a> Side<'a> {
    pub(crate) fn new(part: &'a Part, agent: Agent, reporter: Reporter) -> Self {
        Self {
            part,
            partners: agent.watch_partners(),
            agent,
            reporter,
            docking: None,
        }
    }

    /// Whether a message belongs to the docking that has begun.
    pub(crate) fn is_open(&self, message: &Message) -> bool {
        let conversation = message.conversation_id().unwrap_or_default();
        self.docking
            .as_ref()
            .is_some_and(|it| it.conversation == conversation)
    }

    /// Agrees to a docking whose master holds the lock of the resource that `owned` returns. `other` returns the name of
    /// the agent beside the master. Returns whether it agrees.
    pub(crate) async fn begin<'o>(
        &mut self,
        message: &Message,
        owned: impl Fn(&Docking) -> Option<&'o Owned>,
        other: impl Fn(&Docking) -> &str,
    ) -> bool {
        let asked = words::hear::<Docking>(message).ok_or_else(|| "expected a docking".to_owned());
        let admitted = asked.and_then(|words| {
            let owned = owned(&words).ok_or("this agent has no such interface")?;
            self.admit(message, owned, "dock").map(|()| words)
        });
        let words = match admitted {
            Ok(words) => words,
            Err(reason) => {
                self.answer(message, Performative::Refuse, reason).await;
                return false;
            }
        };
        self.end();
        let open = Open {
            conversation: message.conversation_id().unwrap_or_default().to_owned(),
            master: message
                .sender()
                .map(|id| id.name().to_owned())
                .unwrap_or_default(),
            other: other(&words).to_owned(),
            words,
        };
        for agent in [&open.master, &open.other] {
            self.partners.add(agent);
        }
        self.docking = Some(open);
        self.answer(message, Performative::Agree, String::new())
            .await;
        true
    }

    /// Ends the docking, and watches its partners no longer.
    pub(crate) fn end(&mut self) -> Option<Open> {
        self.leave();
        self.docking.take()
    }

    /// Watches the partners no longer, although their letters may still come.
    pub(crate) fn leave(&mut self) {
        if let Some(open) = &self.docking {
            for agent in [&open.master, &open.other] {
                self.partners.remove(agent);
            }
        }
    }

    /// Waits for the next letter of the protocol, or for the end of a partner.
    pub(crate) async fn next(&mut self) -> Result<Event, ReceiveError> {
        loop {
            tokio::select! {
                incoming = self.agent.receive() => {
                    let incoming = incoming?;
                    match incoming.violation() {
                        Some(violation) => self.reporter.noticed(violation),
                        None if incoming.message().protocol() == Some(DOCK) => {
                            return Ok(Event::Letter(Box::new(incoming.into_message())));
                        }
                        None => {}
                    }
                }
                event = self.partners.next() => match event {
                    PartnerEvent::Gone { agent } => return Ok(Event::Gone(agent)),
                    PartnerEvent::Unreachable { agent, .. } => {
                        self.reporter.noticed(format!("{agent} is unreachable"));
                    }
                    _ => {}
                },
            }
        }
    }

    /// Checks the fence of a command. Returns the reason if the command is not to be obeyed.
    pub(crate) fn admit(
        &self,
        message: &Message,
        owned: &Owned,
        action: &str,
    ) -> Result<(), String> {
        if self.part.has(Mutant::FencesUnchecked) {
            return Ok(());
        }
        self.reporter
            .admission(action, owned.resource(), owned.check(message))
    }

    /// Answers a message.
    pub(crate) async fn answer(
        &self,
        message: &Message,
        act: Performative,
        content: impl Into<String>,
    ) {
        let answer = self.agent.reply(message, act).content(content.into());
        self.send(answer).await;
    }

    /// Tells another agent of the docking.
    pub(crate) async fn tell(&self, to: &str, act: Performative, content: impl Into<String>) {
        if let Some(open) = &self.docking {
            let tell = self.agent.message(act).receiver(to).protocol(DOCK);
            self.send(
                tell.conversation_id(&open.conversation)
                    .content(content.into()),
            )
            .await;
        }
    }

    async fn send(&self, message: MessageBuilder) {
        self.reporter.send(&self.agent, message).await;
    }
}
