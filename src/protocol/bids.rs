//! The answers to a call for proposals.

use std::time::Instant;

use fipa_acl::{Message, Performative};
use fipa_monitor::Violation;

use super::dialogue::{Dialogue, DialogueError};

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
    /// The names of the agents that did not answer in time or could not be reached.
    pub silent: Vec<String>,
    /// The first 64 violations of the protocol. An agent that violates it can still make a proposal,
    /// and other agents are not affected.
    pub violations: Vec<Violation>,
}

impl Bids {
    /// Waits for the next answer. Returns it with whether its sender can send nothing more, or `None`
    /// at the time limit.
    pub(super) async fn next(
        &mut self,
        dialogue: &mut Dialogue<'_>,
        due: Option<Instant>,
    ) -> Result<Option<(Message, bool)>, DialogueError> {
        loop {
            return match dialogue.receive(due).await {
                // An answer to an earlier call.
                Ok(received) if received.meaning.void => continue,
                Ok(received) => Ok(Some((received.message, received.meaning.over))),
                Err(DialogueError::NotUnderstood(message)) => Ok(Some((*message, true))),
                Err(DialogueError::TimedOut) => Ok(None),
                // The outcomes of the call already have its receiver.
                Err(DialogueError::Undelivered(_)) => continue,
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

    pub(super) fn add(&mut self, answer: Message) {
        match answer.performative() {
            Performative::Propose => self.proposals.push(answer),
            _ => self.refusals.push(answer),
        }
    }
}
