//! The clerk: the agent that the gateway itself is. It has the gateway's name and incarnation, is
//! written to by agents of this host and by other gateways, and answers.
//!
//! Letters are told apart by their ontology. What nobody here understands is answered so, when an
//! answer was asked for.

use std::sync::Arc;
use std::time::{Duration, SystemTime};

use fipa_acl::{AgentId, Message, Performative};
use fipa_mts::core::{Received, Submission};
use fipa_mts::{Mts, letter_for};
use fipa_sds::{Directory, Entry};
use fipa_transport::Incarnation;

/// How long an answer may be under way.
const ANSWER_DEADLINE: Duration = Duration::from_secs(5);

/// The agent that the gateway itself is.
pub(crate) struct Clerk {
    pub(crate) mts: Mts,
    pub(crate) id: AgentId,
    pub(crate) incarnation: Incarnation,
    pub(crate) view: Arc<dyn Directory>,
}

impl Clerk {
    /// Reads and answers until the service ends.
    pub(crate) async fn run(self) {
        while let Some(received) = self.mts.receive(self.incarnation).await {
            let Received { letter, sender, .. } = received;
            match Message::decode(letter.payload()) {
                Ok(message) => self.handle(&message, sender),
                Err(error) => tracing::info!(%error, "a letter to the gateway makes no sense"),
            }
        }
    }

    fn handle(&self, message: &Message, sender: Incarnation) {
        let asked = matches!(
            message.performative(),
            Performative::Request
                | Performative::QueryIf
                | Performative::QueryRef
                | Performative::Subscribe
        );
        if !asked {
            tracing::debug!(performative = %message.performative(), "nothing to be done about it");
            return;
        }
        self.answer(message, sender, Performative::NotUnderstood, |answer| {
            answer.content("the gateway does not know this ontology")
        });
    }

    /// Answers to the very life of an agent that asked.
    fn answer(
        &self,
        message: &Message,
        sender: Incarnation,
        performative: Performative,
        fill: impl FnOnce(fipa_acl::MessageBuilder) -> fipa_acl::MessageBuilder,
    ) {
        let Some(to) = self.view.by_incarnation(sender) else {
            tracing::info!("who has asked the gateway is not known any more");
            return;
        };
        let answer = message.reply(performative).sender(self.id.clone());
        match fill(answer).build() {
            Ok(answer) => self.send(&answer, &to),
            Err(error) => tracing::warn!(%error, "the gateway could not answer"),
        }
    }

    /// Sends a message in the gateway's name.
    pub(crate) fn send(&self, message: &Message, to: &Entry) {
        match letter_for(message, SystemTime::now()) {
            Ok(letter) => {
                let submission = Submission {
                    sender: self.incarnation,
                    letter,
                    receivers: Vec::new(),
                    deadline: ANSWER_DEADLINE,
                };
                // It is on its way; when it fails, whoever waits for it asks again.
                drop(self.mts.send_to(submission, to));
            }
            Err(error) => tracing::warn!(%error, "the gateway could not write"),
        }
    }
}
