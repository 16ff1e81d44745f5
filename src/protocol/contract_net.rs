//! Calling for proposals and accepting some (FIPA00029), in several rounds if need be (FIPA00030).

use std::time::{Duration, Instant};

use fipa_acl::{AgentId, Message, MessageBuilder, Performative};
use fipa_mts::Sending;

use super::bids::Bids;
use super::dialogue::{Dialogue, DialogueError, after, name_of, only_delivered, settle, unreached};
use crate::agent::Agent;
use crate::delivery::deliveries;

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
    /// When the message is none that begins the protocol, or cannot be sent.
    pub async fn contract_net(
        &self,
        call: MessageBuilder,
        receivers: &[AgentId],
        patience: Duration,
    ) -> Result<ContractNet<'_>, DialogueError> {
        ContractNet::begin(self, "fipa-contract-net", call, receivers, patience).await
    }

    /// The same with the leave to call again for better proposals
    /// ([`ContractNet::call_again`], FIPA00030).
    ///
    /// # Errors
    /// See [`contract_net`](Self::contract_net).
    pub async fn iterated_contract_net(
        &self,
        call: MessageBuilder,
        receivers: &[AgentId],
        patience: Duration,
    ) -> Result<ContractNet<'_>, DialogueError> {
        let protocol = "fipa-iterated-contract-net";
        ContractNet::begin(self, protocol, call, receivers, patience).await
    }
}

/// A call for proposals whose time is up. Every proposal is to be decided upon with
/// [`award`](Self::award).
#[must_use = "proposals are decided upon with award()"]
pub struct ContractNet<'a> {
    dialogue: Dialogue<'a>,
    bids: Bids,
    /// With whom it has not ended.
    open: Vec<AgentId>,
    /// Rejections on their way.
    rejections: Vec<Sending>,
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

impl<'a> ContractNet<'a> {
    async fn begin(
        agent: &'a Agent,
        protocol: &str,
        call: MessageBuilder,
        receivers: &[AgentId],
        patience: Duration,
    ) -> Result<Self, DialogueError> {
        let due = after(patience);
        let call = call.receivers(receivers.to_vec());
        let (dialogue, sent) = Dialogue::open(agent, protocol, call, due).await?;
        let mut net = Self {
            dialogue,
            bids: Bids::default(),
            open: receivers.to_vec(),
            rejections: Vec::new(),
        };
        net.lose(unreached(&sent));
        let called = net.open.iter().map(|agent| agent.name().to_owned());
        let called = called.collect();
        net.collect(called, due).await?;
        Ok(net)
    }

    /// What came of the last call.
    #[must_use]
    pub fn bids(&self) -> &Bids {
        &self.bids
    }

    /// The conversation's id.
    #[must_use]
    pub fn conversation_id(&self) -> &str {
        self.dialogue.id()
    }

    /// Calls those who made some of the proposals for better ones, and rejects the others
    /// (FIPA00030); what came of it is in [`bids`](Self::bids), which holds the proposals of the
    /// last round only.
    ///
    /// # Errors
    /// When the protocol is not the iterated one, the message is no `cfp`, or cannot be sent.
    pub async fn call_again(
        &mut self,
        invited: &[Message],
        call: MessageBuilder,
        patience: Duration,
    ) -> Result<(), DialogueError> {
        let due = after(patience);
        let before = std::mem::take(&mut self.bids.proposals);
        let (again, others): (Vec<_>, Vec<_>) = before
            .into_iter()
            .partition(|proposal| invited.contains(proposal));
        let senders = again.iter().filter_map(|proposal| proposal.sender());
        let senders: Vec<AgentId> = senders.cloned().collect();
        let mut called: Vec<String> = again.iter().map(name_of).collect();
        let sending = match senders.is_empty() {
            true => None,
            false => match self.dialogue.post(call.receivers(senders), due) {
                Ok(sending) => Some(sending),
                Err(error) => {
                    // They can still be accepted.
                    self.bids.proposals = again.into_iter().chain(others).collect();
                    return Err(error);
                }
            },
        };
        self.bids = Bids::default();
        for proposal in &others {
            self.reject(proposal, "")?;
        }
        if let Some(sending) = sending {
            let sent = deliveries(sending).await;
            self.lose(unreached(&sent));
            called.retain(|name| !unreached(&sent).any(|lost| lost == name));
        }
        self.collect(called, due).await?;
        self.settle(due).await;
        Ok(())
    }

    /// Accepts these proposals and rejects all others, and waits for what those who were accepted
    /// make of it. `content` goes with both. All are told at once: nobody waits for who cannot be
    /// reached any more.
    ///
    /// # Errors
    /// When an answer cannot be sent. What becomes of each award is in the list.
    pub async fn award(
        &mut self,
        accepted: &[Message],
        content: &str,
        patience: Duration,
    ) -> Result<Vec<Awarded>, DialogueError> {
        let due = after(patience);
        let mut results = Vec::new();
        let mut at_work = Vec::new();
        let mut told = Vec::new();
        for proposal in std::mem::take(&mut self.bids.proposals) {
            if accepted.contains(&proposal) {
                let act = Performative::AcceptProposal;
                let content = content.to_owned();
                let sending = self.dialogue.post_answer(&proposal, act, content, due)?;
                told.push((name_of(&proposal), sending));
            } else {
                self.reject(&proposal, content)?;
            }
        }
        for (agent, sending) in told {
            match only_delivered(&deliveries(sending).await) {
                Ok(()) => at_work.push(agent),
                Err(error) => {
                    self.open.retain(|open| open.name() != agent);
                    let result = Err(error);
                    results.push(Awarded { agent, result });
                }
            }
        }
        while !at_work.is_empty() {
            let (agent, result) = match self.dialogue.hear(due).await {
                Ok(heard) if heard.meaning.void => continue,
                Ok(heard) => {
                    let message = heard.message;
                    match message.performative() {
                        Performative::Inform => (name_of(&message), Ok(message)),
                        Performative::Failure => {
                            let agent = name_of(&message);
                            (agent, Err(DialogueError::Failed(Box::new(message))))
                        }
                        _ => {
                            self.late(&message)?;
                            continue;
                        }
                    }
                }
                Err(DialogueError::NotUnderstood(message)) => {
                    let agent = name_of(&message);
                    (agent, Err(DialogueError::NotUnderstood(message)))
                }
                Err(DialogueError::Violation { violation, message }) => {
                    let agent = name_of(&message);
                    (agent, Err(DialogueError::Violation { violation, message }))
                }
                Err(DialogueError::TimedOut) => break,
                Err(DialogueError::Undelivered(_)) => continue,
                Err(other) => return Err(other),
            };
            if let Some(at) = at_work.iter().position(|name| *name == agent) {
                at_work.swap_remove(at);
                if !matches!(result, Err(DialogueError::Violation { .. })) {
                    self.open.retain(|open| open.name() != agent);
                }
                results.push(Awarded { agent, result });
            }
        }
        for agent in at_work {
            let result = Err(DialogueError::TimedOut);
            results.push(Awarded { agent, result });
        }
        self.settle(due).await;
        Ok(results)
    }

    /// Cancels the call, with all with whom it has not ended: those who have not answered, whose
    /// proposals are not decided upon, or who have not told the result. Waits until all have said
    /// whether it is cancelled.
    ///
    /// # Errors
    /// When somebody goes on ([`DialogueError::Failed`]), cannot be reached, or does not say in time
    /// whether it does.
    pub async fn cancel(mut self, patience: Duration) -> Result<(), DialogueError> {
        self.dialogue.cancel(self.open, after(patience)).await
    }

    /// Waits until these have answered.
    async fn collect(
        &mut self,
        mut called: Vec<String>,
        due: Option<Instant>,
    ) -> Result<(), DialogueError> {
        while !called.is_empty() {
            let Some((answer, over)) = self.bids.next(&mut self.dialogue, due).await? else {
                break;
            };
            let from = name_of(&answer);
            if over {
                self.open.retain(|open| open.name() != from);
            }
            match called.iter().position(|name| *name == from) {
                Some(at) => {
                    called.swap_remove(at);
                    self.bids.add(answer);
                }
                None => self.late(&answer)?,
            }
        }
        self.bids.silent.extend(called);
        Ok(())
    }

    /// What is proposed after the time of the call is rejected; what else comes then ends by itself.
    fn late(&mut self, answer: &Message) -> Result<(), DialogueError> {
        if *answer.performative() == Performative::Propose {
            self.reject(answer, "late")?;
        }
        Ok(())
    }

    fn reject(&mut self, proposal: &Message, content: &str) -> Result<(), DialogueError> {
        let from = name_of(proposal);
        self.open.retain(|open| open.name() != from);
        let act = Performative::RejectProposal;
        let content = content.to_owned();
        let sending = self.dialogue.post_answer(proposal, act, content, None)?;
        self.rejections.push(sending);
        Ok(())
    }

    /// Waits until the rejections have arrived or failed, so that whoever ends now takes none back.
    async fn settle(&mut self, due: Option<Instant>) {
        settle(self.rejections.drain(..), due).await;
    }

    /// These cannot be reached.
    fn lose<'n>(&mut self, names: impl Iterator<Item = &'n str>) {
        for name in names {
            self.open.retain(|open| open.name() != name);
            self.bids.silent.push(name.to_owned());
        }
    }
}
