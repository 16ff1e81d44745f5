//! The answers to a call for proposals.

use std::time::Instant;

use fipa_acl::{Message, Performative};
use fipa_monitor::Violation;

use super::dialogue::{Dialogue, DialogueError, lost_by};

/// Maximum number of violations that are kept per call.
const MAX_VIOLATIONS: usize = 64;

/// The answers to a call for proposals.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct Bids {
    /// The proposals, in the order of their arrival.
    pub proposals: Vec<Message>,
    /// The `refuse` and `not-understood` messages.
    pub refusals: Vec<Message>,
    /// The names of the agents that did not answer in time, could not be reached, or are gone.
    pub silent: Vec<String>,
    /// The names of the agents that the call did not reach: of those in `silent`, the ones for which a
    /// message transport service has reported a failure, for example because they do not exist.
    pub unreached: Vec<String>,
    /// The names of the agents that are gone: of those in `silent`, the ones that received the call and
    /// then left or died.
    pub gone: Vec<String>,
    /// The first 64 violations of the protocol. An agent that violates it can still make a proposal,
    /// and other agents are not affected.
    pub violations: Vec<Violation>,
}

impl Bids {
    /// Waits for the next answer.
    pub(super) async fn next(
        &mut self,
        dialogue: &mut Dialogue,
        due: Option<Instant>,
    ) -> Result<Next, DialogueError> {
        loop {
            return match dialogue.receive(due).await {
                // An answer to an earlier call.
                Ok(received) if received.meaning.void => continue,
                Ok(received) => {
                    let message = Box::new(received.message);
                    Ok(Next::Answer(message, received.meaning.over))
                }
                Err(DialogueError::NotUnderstood(message)) => Ok(Next::Answer(message, true)),
                Err(DialogueError::Gone { agent }) => Ok(Next::Gone(agent)),
                Err(DialogueError::TimedOut | DialogueError::Unreachable { .. }) => {
                    Ok(Next::TimedOut)
                }
                Err(DialogueError::Undelivered(report)) => Ok(Next::Unreached(lost_by(&report))),
                Err(DialogueError::Violation { violation, .. }) => {
                    if self.violations.len() < MAX_VIOLATIONS {
                        self.violations.push(*violation);
                    }
                    continue;
                }
                Err(other) => Err(other),
            };
        }
    }

    /// Adds an agent that is gone.
    pub(super) fn lose(&mut self, agent: &str) {
        self.silent.push(agent.to_owned());
        self.gone.push(agent.to_owned());
    }

    /// Adds an agent that the call did not reach.
    pub(super) fn miss(&mut self, agent: &str) {
        self.silent.push(agent.to_owned());
        self.unreached.push(agent.to_owned());
    }

    pub(super) fn add(&mut self, answer: Message) {
        match answer.performative() {
            Performative::Propose => self.proposals.push(answer),
            _ => self.refusals.push(answer),
        }
    }
}

/// The next event of a call for proposals.
pub(super) enum Next {
    /// An answer, and whether its sender can send nothing more.
    Answer(Box<Message>, bool),
    /// This agent is gone.
    Gone(String),
    /// A message transport service reports that this agent did not get the call. The outcomes of the
    /// call may already have said so.
    Unreached(String),
    /// The time of the call is over.
    TimedOut,
}
