//! What comes of a call for proposals.

use std::time::Instant;

use fipa_acl::{Message, Performative};
use fipa_monitor::Violation;

use super::dialogue::{Dialogue, DialogueError};

/// Most violations that are told of one call.
const MAX_VIOLATIONS: usize = 64;

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
    /// What broke the protocol, the first 64: who did so can still bid. Nobody else is concerned.
    pub violations: Vec<Violation>,
}

impl Bids {
    /// The next answer, and whether nothing more can come from its sender; none when time is up.
    pub(super) async fn next(
        &mut self,
        dialogue: &mut Dialogue<'_>,
        due: Option<Instant>,
    ) -> Result<Option<(Message, bool)>, DialogueError> {
        loop {
            return match dialogue.hear(due).await {
                // It answers an earlier call.
                Ok(heard) if heard.meaning.void => continue,
                Ok(heard) => Ok(Some((heard.message, heard.meaning.over))),
                Err(DialogueError::NotUnderstood(message)) => Ok(Some((*message, true))),
                Err(DialogueError::TimedOut) => Ok(None),
                // Who it is about is in the outcomes already.
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
