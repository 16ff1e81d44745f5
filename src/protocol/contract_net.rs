//! The initiator's side of the contract net (FIPA00029) and the iterated contract net (FIPA00030).

use std::fmt;
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_acl::{AgentId, AgentIdError, Message, MessageBuilder, Performative};

use super::bids::{Bids, Next};
use super::dialogue::{
    Dialogue, DialogueError, after, lost_by, name_of, only_delivered, settle, unreached,
};
use super::protocols::Protocols;
use super::reachability::Reachability;
use super::receivers::{expand, identified};
use crate::agent::delivery::{Sent, deliveries};
use crate::agent::{Agent, AgentCore};

impl Agent {
    /// Calls for proposals (`cfp`, FIPA00029) and collects the answers until all receivers have
    /// answered, at most for `timeout`. Receivers that cannot be reached, or are gone, count as silent, and
    /// are not waited for.
    ///
    /// The receivers are [`AgentId`]s or names. A pattern or a coalition among them stands for the agents known now, which
    /// [`ContractNet::called`] returns. A name that is given twice counts once.
    ///
    /// ```no_run
    /// # async fn example(agent: fipa::Agent) -> Result<(), Box<dyn std::error::Error>> {
    /// use std::time::Duration;
    /// use fipa::Performative;
    ///
    /// let call = agent.message(Performative::Cfp).content("(carry crate)");
    /// let mut net = agent.contract_net(call, &["arm_1", "arm_2"], Duration::from_secs(2)).await?;
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
    /// If the message does not begin the protocol, or cannot be sent.
    pub async fn contract_net<A>(
        &self,
        call: MessageBuilder,
        receivers: &[A],
        timeout: Duration,
    ) -> Result<ContractNet, DialogueError>
    where
        A: Clone + TryInto<AgentId, Error: Into<AgentIdError>>,
    {
        let receivers = identified(receivers)?;
        ContractNet::begin(&self.core, "fipa-contract-net", call, &receivers, timeout).await
    }
}

impl Protocols<'_> {
    /// Calls for proposals like [`Agent::contract_net`], with the iterated protocol
    /// (FIPA00030), which allows further calls for better proposals ([`ContractNet::call_again`]).
    ///
    /// # Errors
    /// See [`Agent::contract_net`].
    pub async fn iterated_contract_net<A>(
        self,
        call: MessageBuilder,
        receivers: &[A],
        timeout: Duration,
    ) -> Result<ContractNet, DialogueError>
    where
        A: Clone + TryInto<AgentId, Error: Into<AgentIdError>>,
    {
        let protocol = "fipa-iterated-contract-net";
        let receivers = identified(receivers)?;
        ContractNet::begin(self.core, protocol, call, &receivers, timeout).await
    }
}

/// A call for proposals whose answers are collected. [`award`](Self::award) decides on the proposals.
#[must_use = "award() decides on the proposals"]
pub struct ContractNet {
    dialogue: Dialogue,
    bids: Bids,
    /// The agents that received or were to receive the first call.
    called: Vec<AgentId>,
    /// The agents with which the conversation has not ended.
    open: Vec<AgentId>,
    /// Rejections in transit.
    rejections: Vec<Sent>,
}

/// The result of an accepted proposal.
#[derive(Debug)]
#[non_exhaustive]
pub struct Awarded {
    /// The name of the agent.
    pub agent: String,
    /// Its `inform`, or the error instead of one.
    pub result: Result<Message, DialogueError>,
}

impl fmt::Debug for ContractNet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ContractNet")
            .field("dialogue", &self.dialogue)
            .field("bids", &self.bids)
            .field("open", &self.open)
            .finish_non_exhaustive()
    }
}

impl ContractNet {
    async fn begin(
        core: &Arc<AgentCore>,
        protocol: &str,
        call: MessageBuilder,
        receivers: &[AgentId],
        timeout: Duration,
    ) -> Result<Self, DialogueError> {
        let due = after(timeout);
        let expanded = expand(core, receivers);
        let call = call.receivers(expanded.agents.clone());
        let (dialogue, sent) = Dialogue::open(core, protocol, call, due).await?;
        let mut net = Self {
            dialogue,
            bids: Bids {
                silent: expanded.missing,
                ..Bids::default()
            },
            open: expanded.agents.clone(),
            called: expanded.agents,
            rejections: Vec::new(),
        };
        net.lose(unreached(&sent));
        let called = net.open.iter().map(|agent| agent.name().to_owned());
        let called = called.collect();
        net.collect(called, due).await?;
        Ok(net)
    }

    /// Returns the agents that were called first: the given ones, with the members of coalitions and
    /// the agents that matched patterns.
    #[must_use]
    pub fn called(&self) -> &[AgentId] {
        &self.called
    }

    /// Returns a receiver of changes of the reachability of the called agents.
    #[must_use]
    pub fn reachability(&self) -> Reachability {
        self.dialogue.reachability()
    }

    /// Returns the answers to the last call.
    #[must_use]
    pub fn bids(&self) -> &Bids {
        &self.bids
    }

    /// Returns the conversation id.
    #[must_use]
    pub fn conversation_id(&self) -> &str {
        self.dialogue.id()
    }

    /// Calls the agents of the `invited` proposals for better ones, and rejects the other proposals
    /// (FIPA00030). Afterwards [`bids`](Self::bids) returns the answers to this call only.
    ///
    /// # Errors
    /// If the protocol is not the iterated one, or if the message is not a `cfp` or cannot be sent.
    pub async fn call_again(
        &mut self,
        invited: &[Message],
        call: MessageBuilder,
        timeout: Duration,
    ) -> Result<(), DialogueError> {
        let due = after(timeout);
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
                    // The proposals can still be accepted.
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

    /// Accepts these proposals, rejects all others, and waits for the results of the accepted ones. An
    /// agent that leaves or dies has the result [`DialogueError::Gone`] at once.
    /// `content` is the content of acceptances and rejections. All of them are sent before the first
    /// outcome is awaited, so that an unreachable agent does not delay the others.
    ///
    /// # Errors
    /// If an answer cannot be sent. The list has the failures of single agents.
    pub async fn award(
        &mut self,
        accepted: &[Message],
        content: &str,
        timeout: Duration,
    ) -> Result<Vec<Awarded>, DialogueError> {
        let due = after(timeout);
        let mut results = Vec::new();
        let mut working = Vec::new();
        let mut sent = Vec::new();
        for proposal in std::mem::take(&mut self.bids.proposals) {
            if accepted.contains(&proposal) {
                let act = Performative::AcceptProposal;
                let content = content.to_owned();
                let sending = self.dialogue.post_answer(&proposal, act, content, due)?;
                sent.push((name_of(&proposal), sending));
            } else {
                self.reject(&proposal, content)?;
            }
        }
        for (agent, sending) in sent {
            match only_delivered(&deliveries(sending).await) {
                Ok(()) => working.push(agent),
                Err(error) => {
                    self.open.retain(|open| open.name() != agent);
                    let result = Err(error);
                    results.push(Awarded { agent, result });
                }
            }
        }
        while !working.is_empty() {
            let (agent, result) = match self.dialogue.receive(due).await {
                Ok(received) if received.meaning.void => continue,
                Ok(received) => {
                    let message = received.message;
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
                Err(DialogueError::Gone { agent }) => {
                    let gone = DialogueError::Gone {
                        agent: agent.clone(),
                    };
                    (agent, Err(gone))
                }
                Err(DialogueError::TimedOut | DialogueError::Unreachable { .. }) => break,
                // Of an acceptance. Other reports name agents that do not work.
                Err(DialogueError::Undelivered(report)) => {
                    (lost_by(&report), Err(DialogueError::Undelivered(report)))
                }
                Err(other) => return Err(other),
            };
            if let Some(at) = working.iter().position(|name| *name == agent) {
                working.swap_remove(at);
                if !matches!(result, Err(DialogueError::Violation { .. })) {
                    self.open.retain(|open| open.name() != agent);
                }
                results.push(Awarded { agent, result });
            } else if self.dialogue.all_gone() {
                break;
            }
        }
        for agent in working {
            let result = Err(self.dialogue.timed_out(Some(&agent)));
            results.push(Awarded { agent, result });
        }
        self.settle(due).await;
        Ok(results)
    }

    /// Cancels the call with all agents with which it has not ended: those that have not answered,
    /// whose proposals are undecided, or that have not sent the result. Waits for their confirmations.
    ///
    /// # Errors
    /// If an agent does not cancel ([`DialogueError::Failed`]), cannot be reached, or does not answer
    /// within `timeout`.
    pub async fn cancel(mut self, timeout: Duration) -> Result<(), DialogueError> {
        self.dialogue.cancel(self.open, after(timeout)).await
    }

    /// Waits until these agents have answered, or until `due`.
    async fn collect(
        &mut self,
        mut called: Vec<String>,
        due: Option<Instant>,
    ) -> Result<(), DialogueError> {
        while !called.is_empty() {
            let (answer, over) = match self.bids.next(&mut self.dialogue, due).await? {
                Next::Answer(answer, over) => (*answer, over),
                Next::TimedOut => break,
                Next::Gone(agent) => {
                    self.open.retain(|open| open.name() != agent);
                    if let Some(at) = called.iter().position(|name| *name == agent) {
                        called.swap_remove(at);
                        self.bids.lose(&agent);
                    } else if self.dialogue.all_gone() {
                        break;
                    }
                    continue;
                }
                Next::Unreached(agent) => {
                    if let Some(at) = called.iter().position(|name| *name == agent) {
                        called.swap_remove(at);
                        self.lose([agent.as_str()].into_iter());
                    }
                    continue;
                }
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

    /// Rejects a proposal that arrives after the time of its call. Other late answers need no reaction.
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

    /// Waits until the rejections are delivered or have failed, so that none is lost if this process
    /// ends now.
    async fn settle(&mut self, due: Option<Instant>) {
        settle(self.rejections.drain(..), due).await;
    }

    /// Counts agents that cannot be reached as silent.
    fn lose<'n>(&mut self, names: impl Iterator<Item = &'n str>) {
        for name in names {
            self.open.retain(|open| open.name() != name);
            self.bids.miss(name);
        }
    }
}
