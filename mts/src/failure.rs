//! Failure messages: how a sender is told in FIPA's own words that its letter was not delivered.
//!
//! The message is a `failure` with the ontology `fipa-agent-management` (FIPA00067), written like
//! JADE's: language `fipa-sl`, content
//! `((action (agent-identifier :name SENDER) (ACLMessage)) (MTS-error (agent-identifier :name
//! RECEIVER) (internal-error "REASON: DETAIL")))`. It goes to the sender of the letter,
//! `in-reply-to`, `conversation-id` and `protocol` taken from the message, and only when the
//! message is not a failure itself.

use std::time::SystemTime;

use fipa_acl::{AgentId, Letter, Message, Performative};
use fipa_transport::FailureReason;

use crate::letter_for;

/// A failure message, ready to be sent.
pub(crate) struct FailureMessage {
    /// The name of the agent that is told.
    pub(crate) to: String,
    pub(crate) letter: Letter,
}

/// The failure message about a letter, unless there is nobody to tell, or the letter is a failure
/// message itself. What cannot be decoded or encoded is logged: nobody else could be told.
pub(crate) fn compose(
    mts: &str,
    letter: &Letter,
    receiver: &str,
    reason: FailureReason,
    detail: &str,
    utc: SystemTime,
) -> Option<FailureMessage> {
    let message = match Message::decode(letter.payload()) {
        Ok(message) => message,
        Err(error) => {
            tracing::info!(%error, receiver, "no failure message about what cannot be decoded");
            return None;
        }
    };
    let sender = message.sender()?;
    if *message.performative() == Performative::Failure {
        return None;
    }
    match written(mts, &message, sender, receiver, reason, detail, utc) {
        Ok(letter) => Some(FailureMessage {
            to: sender.name().to_owned(),
            letter,
        }),
        Err(error) => {
            tracing::warn!(%error, receiver, "a failure message could not be written");
            None
        }
    }
}

fn written(
    mts: &str,
    message: &Message,
    sender: &AgentId,
    receiver: &str,
    reason: FailureReason,
    detail: &str,
    utc: SystemTime,
) -> Result<Letter, Box<dyn std::error::Error>> {
    let text = if detail.is_empty() {
        reason.to_string()
    } else {
        format!("{reason}: {detail}")
    };
    let content = format!(
        "((action (agent-identifier :name {}) (ACLMessage)) \
         (MTS-error (agent-identifier :name {}) (internal-error {})))",
        sl_string(sender.name()),
        sl_string(receiver),
        sl_string(&text),
    );
    let mut failure = Message::builder(Performative::Failure)
        .sender(AgentId::new(mts)?)
        .receiver(sender.clone())
        .ontology("fipa-agent-management")
        .language("fipa-sl")
        .content(content);
    if let Some(protocol) = message.protocol() {
        failure = failure.protocol(protocol);
    }
    if let Some(conversation) = message.conversation_id() {
        failure = failure.conversation_id(conversation);
    }
    if let Some(reply_with) = message.reply_with() {
        failure = failure.in_reply_to(reply_with);
    }
    Ok(letter_for(&failure.build()?, utc)?)
}

/// A string literal of FIPA SL (FIPA00008): `\"` is its only escape.
fn sl_string(text: &str) -> String {
    format!("\"{}\"", text.replace('"', "\\\""))
}
