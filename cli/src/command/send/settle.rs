//! Answers the proposals that a sent message has caused.

use std::time::Instant;

use fipa::error::ErrorChain;
use fipa::{Agent, AgentId, Incoming, Message, Performative};
use fipa_acl::escape_name;
use fipa_acl::json::message_to_json;
use serde_json::{Value, json};

use super::super::request::shown;
use super::{Answers, Arguments, advice};
use crate::output;
use crate::report::{self, Failure};

/// The answered proposals.
#[derive(Debug, Default)]
pub(super) struct Settled {
    accepted: Vec<String>,
    rejected: Vec<String>,
    results: Vec<Message>,
    pub(super) failures: Vec<Failure>,
}

impl Settled {
    /// Adds the answers to the JSON of the command.
    pub(super) fn add_to(&self, json: &mut Value) {
        if self.accepted.is_empty() && self.rejected.is_empty() {
            return;
        }
        json["accepted"] = json!(self.accepted);
        json["rejected"] = json!(self.rejected);
        json["results"] = self.results.iter().map(message_to_json).collect();
    }
}

/// Answers every proposal among the replies, and those that have arrived since. Waits for the results of
/// the accepted ones.
pub(super) async fn proposals(
    agent: &Agent,
    sent: &Message,
    answers: &Answers,
    arguments: &Arguments,
) -> Result<Settled, Failure> {
    let mut settled = Settled::default();
    let is_proposal = |message: &Message| *message.performative() == Performative::Propose;
    for reply in answers.replies.iter().map(|reply| reply.message()) {
        if is_proposal(reply) {
            settled.answer(agent, reply, arguments).await?;
        }
    }
    // A proposal that comes later finds its initiator gone. The result of a quick agent may be among
    // these messages, too.
    let mut arrived = Vec::new();
    while let Ok(Some(late)) = agent.try_receive() {
        match is_proposal(late.message()) && late.message().is_reply_to(sent) {
            true => settled.answer(agent, late.message(), arguments).await?,
            false => arrived.push(late),
        }
    }
    settled.wait(agent, sent, arrived, arguments).await?;
    let bid = |name: &&AgentId| settled.accepted.iter().any(|bid| bid == name.name());
    let absent = arguments.accept.iter().filter(|name| !bid(name));
    let absent: Vec<&str> = absent.map(AgentId::name).collect();
    if !absent.is_empty() {
        settled.failures.push(Failure::failed(
            "no proposal to accept",
            advice::receivers(&absent),
            "name an agent that proposes",
        ));
    }
    Ok(settled)
}

impl Settled {
    async fn answer(
        &mut self,
        agent: &Agent,
        proposal: &Message,
        arguments: &Arguments,
    ) -> Result<(), Failure> {
        let bidder = proposal.sender().map_or("", AgentId::name);
        let is_accepted = arguments.accept.iter().any(|name| name.name() == bidder);
        let (performative, done, names) = match is_accepted {
            true => (Performative::AcceptProposal, "accepted", &mut self.accepted),
            false => (Performative::RejectProposal, "rejected", &mut self.rejected),
        };
        let answer = agent.reply(proposal, performative);
        let problem = match agent.send(answer).await {
            Ok(deliveries) if deliveries.all_succeeded() => {
                names.push(bidder.to_owned());
                if !arguments.json {
                    output::text(&format!("{done}: {}\n", escape_name(bidder)))?;
                }
                return Ok(());
            }
            Ok(deliveries) => deliveries.to_string(),
            Err(error) => ErrorChain(&error).to_string(),
        };
        self.failures.push(Failure::failed(
            format!("the proposal was not {done}: {problem}"),
            format!("{bidder:?}"),
            "the agent may still be bound to its proposal: check its log",
        ));
        Ok(())
    }

    /// Waits for the last message of each accepted agent. `early` has what has arrived already.
    async fn wait(
        &mut self,
        agent: &Agent,
        sent: &Message,
        arrived: Vec<Incoming>,
        arguments: &Arguments,
    ) -> Result<(), Failure> {
        let mut working = self.accepted.clone();
        let mut arrived = arrived.into_iter();
        let mut partners = agent.watch_partners();
        for name in &working {
            partners.add(name);
        }
        let Some(until) = Instant::now().checked_add(arguments.timeout) else {
            return Ok(());
        };
        while !working.is_empty() {
            let received = tokio::select! {
                biased;
                received = async {
                    match arrived.next() {
                        Some(incoming) => Ok(incoming),
                        None => agent.receive().await,
                    }
                } => received,
                event = partners.next() => {
                    if let fipa::protocol::PartnerEvent::Gone { agent } = event {
                        working.retain(|name| *name != agent);
                        self.failures.extend(super::gone(&[agent]));
                    }
                    continue;
                }
                () = tokio::time::sleep_until(until.into()) => break,
            };
            let incoming = received.map_err(|error| {
                Failure::failed(
                    format!("cannot wait for a result: {}", ErrorChain(&error)),
                    format!("agent {:?}", agent.name()),
                    "send the message again",
                )
            })?;
            let message = incoming.message();
            let from = message.sender().map_or("", AgentId::name);
            if message.conversation_id() != sent.conversation_id() {
                report::warn(&format!("ignored, not a result: {message}"));
                continue;
            }
            if !arguments.json {
                output::text(&format!("result: {}\n", shown(message)))?;
            }
            if *message.performative() == Performative::Failure {
                self.failures.push(Failure::failed(
                    "the agent has failed",
                    format!("{from:?}"),
                    "the message above has the reason",
                ));
            }
            working.retain(|name| name != from);
            self.results.push(message.clone());
        }
        if !working.is_empty() {
            let names: Vec<&str> = working.iter().map(String::as_str).collect();
            let timeout = humantime::format_duration(arguments.timeout);
            self.failures.push(Failure::failed(
                format!("no result within {timeout}"),
                advice::receivers(&names),
                "wait longer with --timeout",
            ));
        }
        Ok(())
    }
}
