//! Calling for proposals and accepting some (FIPA00029).

use std::collections::HashMap;
use std::time::{Duration, Instant};

use fipa_acl::{AgentId, Message, MessageBuilder, Performative};
use fipa_transport::Outcome;

use super::dialogue::{Dialogue, DialogueError, after};
use crate::agent::Agent;

impl Agent {
    /// Calls for proposals (`cfp`, FIPA00029) and collects those that come within `patience`; it
    /// does not wait longer than until all have answered. Receivers that cannot be reached count
    /// as silent.
    ///
    /// ```no_run
    /// # async fn example(agent: fipa::Agent) -> Result<(), Box<dyn std::error::Error>> {
    /// use std::time::Duration;
    /// use fipa::{AgentId, Performative};
    ///
    /// let call = agent.message(Performative::Cfp).content("(carry crate)");
    /// let arms = ["arm_1", "arm_2"].map(AgentId::new).into_iter().collect::<Result<Vec<_>, _>>()?;
    /// let mut net = agent.contract_net(call, &arms, Duration::from_secs(2)).await?;
    /// let best = net.bids().proposals.first().cloned();
    /// if let Some(best) = best {
    ///     let done = net.award(&[best], "", Duration::from_secs(60)).await?;
    ///     println!("{done:?}");
    /// }
    /// # Ok(())
    /// # }
    /// ```
    ///
    /// # Errors
    /// When the message is none that begins the protocol, or a participant breaks it.
    pub async fn contract_net(
        &self,
        call: MessageBuilder,
        receivers: &[AgentId],
        patience: Duration,
    ) -> Result<ContractNet<'_>, DialogueError> {
        let due = after(patience);
        let call = receivers
            .iter()
            .fold(call, |call, receiver| call.receiver(receiver.clone()));
        let (dialogue, sent) = Dialogue::open(self, "fipa-contract-net", call, due).await?;
        let mut silent = Vec::new();
        let mut called = Vec::new();
        for delivery in sent.0 {
            let name = delivery.receiver.to_string();
            match delivery.outcome {
                Outcome::Failed { .. } => silent.push(name),
                _ => called.push(name),
            }
        }
        let mut net = ContractNet {
            dialogue,
            bids: Bids {
                silent,
                ..Bids::default()
            },
        };
        net.collect(called, due).await?;
        Ok(net)
    }
}

/// What came of a call.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct Bids {
    /// The proposals, in the order in which they came.
    pub proposals: Vec<Message>,
    /// Who refused, or did not understand.
    pub refusals: Vec<Message>,
    /// Who did not answer in time, or could not be reached.
    pub silent: Vec<String>,
}

/// A call for proposals whose time is up. Every proposal is to be decided upon with
/// [`award`](Self::award).
#[must_use = "proposals are decided upon with award()"]
pub struct ContractNet<'a> {
    dialogue: Dialogue<'a>,
    bids: Bids,
}

/// What an agent whose proposal was accepted made of it.
#[derive(Debug)]
#[non_exhaustive]
pub struct Awarded {
    /// The agent.
    pub agent: String,
    /// Its `inform`, or why there is none.
    pub result: Result<Message, DialogueError>,
}

impl ContractNet<'_> {
    /// What came of the call.
    #[must_use]
    pub fn bids(&self) -> &Bids {
        &self.bids
    }

    /// The conversation's id.
    #[must_use]
    pub fn conversation_id(&self) -> &str {
        self.dialogue.id()
    }

    async fn collect(
        &mut self,
        mut called: Vec<String>,
        due: Option<Instant>,
    ) -> Result<(), DialogueError> {
        while !called.is_empty() {
            let message = match self.dialogue.hear(due).await {
                Ok(heard) => heard.message,
                Err(DialogueError::NotUnderstood(message)) => *message,
                Err(DialogueError::TimedOut) => break,
                // Who it is about is in the outcomes already.
                Err(DialogueError::Undelivered(_)) => continue,
                Err(other) => return Err(other),
            };
            let from = message.sender().map(|sender| sender.name().to_owned());
            called.retain(|name| Some(name) != from.as_ref());
            match message.performative() {
                Performative::Propose => self.bids.proposals.push(message),
                Performative::Failure => {}
                _ => self.bids.refusals.push(message),
            }
        }
        self.bids.silent.extend(called);
        Ok(())
    }

    /// Accepts these proposals and rejects all others, and waits for what those who were accepted
    /// make of it. `content` goes with both.
    ///
    /// # Errors
    /// When an answer cannot be sent, or somebody breaks the protocol.
    pub async fn award(
        &mut self,
        accepted: &[Message],
        content: &str,
        patience: Duration,
    ) -> Result<Vec<Awarded>, DialogueError> {
        let due = after(patience);
        let mut results = Vec::new();
        let mut at_work: HashMap<String, ()> = HashMap::new();
        for proposal in std::mem::take(&mut self.bids.proposals) {
            let agent = name_of(&proposal);
            let (act, due) = if accepted.contains(&proposal) {
                (Performative::AcceptProposal, due)
            } else {
                (Performative::RejectProposal, None)
            };
            let is_accepted = act == Performative::AcceptProposal;
            let answered = self
                .dialogue
                .answer(&proposal, act, content.to_owned(), due)
                .await;
            match answered {
                Ok(()) if is_accepted => {
                    at_work.insert(agent, ());
                }
                Ok(()) => {}
                // Who has gone away needs no rejection.
                Err(error @ DialogueError::NotDelivered { .. }) if is_accepted => {
                    let result = Err(error);
                    results.push(Awarded { agent, result });
                }
                Err(DialogueError::NotDelivered { .. }) => {}
                Err(other) => return Err(other),
            }
        }
        while !at_work.is_empty() {
            let result = match self.dialogue.hear(due).await {
                Ok(heard) => Ok(heard.message),
                Err(DialogueError::TimedOut) => break,
                Err(DialogueError::NotUnderstood(message)) => {
                    Err(DialogueError::NotUnderstood(message))
                }
                Err(DialogueError::Undelivered(_)) => continue,
                Err(other) => return Err(other),
            };
            let (agent, result) = match result {
                Ok(message) if *message.performative() == Performative::Failure => {
                    let agent = name_of(&message);
                    (agent, Err(DialogueError::Failed(Box::new(message))))
                }
                Ok(message) if *message.performative() == Performative::Propose => {
                    // After the time of the call: what is late is rejected.
                    let reject = Performative::RejectProposal;
                    match self.dialogue.answer(&message, reject, "late", None).await {
                        Ok(()) | Err(DialogueError::NotDelivered { .. }) => continue,
                        Err(other) => return Err(other),
                    }
                }
                Ok(message) => (name_of(&message), Ok(message)),
                Err(DialogueError::NotUnderstood(message)) => {
                    let agent = name_of(&message);
                    (agent, Err(DialogueError::NotUnderstood(message)))
                }
                Err(other) => return Err(other),
            };
            if at_work.remove(&agent).is_some() {
                results.push(Awarded { agent, result });
            }
        }
        for agent in at_work.into_keys() {
            let result = Err(DialogueError::TimedOut);
            results.push(Awarded { agent, result });
        }
        Ok(results)
    }
}

fn name_of(message: &Message) -> String {
    let sender = message.sender();
    sender.map_or_else(String::new, |sender| sender.name().to_owned())
}
