//! Failure messages: report to a sender, in a FIPA message, that its letter was not delivered.
//!
//! The message is a `failure` with the ontology `fipa-agent-management` (FIPA00067) from the
//! message transport service to the sender of the letter; `in-reply-to`, `conversation-id` and
//! `protocol` are taken from the failed message. A failure message is never answered with another
//! one. If the message cannot be decoded, the sender in the envelope is used. The content depends
//! on the sender's implementation:
//!
//! * agents of this project and of JADE: language `fipa-sl`, content `((action (agent-identifier
//!   :name SENDER) (ACLMessage)) (MTS-error (agent-identifier :name RECEIVER) (internal-error
//!   "REASON: DETAIL")))`;
//! * agents of fipa_services: an `inform` in the string encoding, from the sender to the intended
//!   receiver, in the language `internal-error`, with the list of the services that the letter
//!   passed.

mod read;

use std::error::Error;
use std::time::SystemTime;

use fipa_acl::{
    AgentId, Dialect, EnvelopeView, Letter, Message, Performative, Representation, escape,
};
use fipa_transport::FailureReason;
use fipa_transport::wire::truncated;

pub use self::read::DeliveryFailure;
use crate::letter_for;

/// The failed delivery of a letter to one receiver.
pub(crate) struct Failure<'a> {
    /// Receiver of the failure message.
    pub(crate) sender: AgentId,
    /// Intended receiver of the letter.
    pub(crate) receiver: &'a str,
    /// The failed message, unless it cannot be decoded.
    message: Option<Message>,
    reason: FailureReason,
    detail: &'a str,
    /// Services that stamped the letter, in order.
    path: Vec<String>,
}

impl<'a> Failure<'a> {
    /// The failure of this letter. `None` if neither its message nor its envelope names a sender, or
    /// the message is a failure message itself.
    pub(crate) fn of(
        letter: &Letter,
        receiver: &'a str,
        reason: FailureReason,
        detail: &'a str,
    ) -> Option<Self> {
        let (sender, message) = match Message::decode(letter.payload()) {
            Ok(message) if *message.performative() == Performative::Failure => return None,
            Ok(message) => (sender_of(&message, letter)?, Some(message)),
            Err(_) => (letter.parse_envelope().ok()?.effective().from?, None),
        };
        Some(Self {
            sender,
            receiver,
            message,
            reason,
            detail,
            path: path(letter),
        })
    }

    /// Encodes the failure message of this service for a sender that reads this dialect.
    pub(crate) fn written_for(
        &self,
        mts: &str,
        dialect: Dialect,
        utc: SystemTime,
    ) -> Result<Letter, Box<dyn Error>> {
        let mut failure = Message::builder(Performative::Failure)
            .sender(AgentId::new(mts)?)
            .receiver(self.sender.clone())
            .ontology("fipa-agent-management");
        failure = match dialect {
            Dialect::FipaServices => match self.path_content(mts) {
                Ok(content) => failure.content(content),
                // The string encoding cannot represent some names.
                Err(error) => {
                    tracing::debug!(%error, receiver = self.receiver, "writing the failure message in FIPA SL");
                    failure.language("fipa-sl").content(self.sl_content())
                }
            },
            _ => failure.language("fipa-sl").content(self.sl_content()),
        };
        if let Some(message) = &self.message {
            if let Some(protocol) = message.protocol() {
                failure = failure.protocol(protocol);
            }
            if let Some(conversation) = message.conversation_id() {
                failure = failure.conversation_id(conversation);
            }
            if let Some(reply_with) = message.reply_with() {
                failure = failure.in_reply_to(reply_with);
            }
        }
        Ok(letter_for(&failure.build()?, utc)?)
    }

    fn sl_content(&self) -> String {
        let text = self.text();
        format!(
            "((action (agent-identifier :name {}) (ACLMessage)) \
             (MTS-error (agent-identifier :name {}) (internal-error {})))",
            sl_string(self.sender.name()),
            sl_string(self.receiver),
            sl_string(&text),
        )
    }

    /// The reason, and its detail if there is one.
    fn text(&self) -> String {
        match self.detail {
            "" => self.reason.to_string(),
            detail => format!("{}: {detail}", self.reason),
        }
    }

    fn path_content(&self, mts: &str) -> Result<Vec<u8>, Box<dyn Error>> {
        let mut path = self.path.clone();
        path.push(mts.to_owned());
        let report = Message::builder(Performative::Inform)
            .sender(self.sender.clone())
            .receiver(AgentId::new(self.receiver)?)
            .language("internal-error")
            .content(format!(
                "description: message delivery failed: {}\ndelivery path: {}",
                one_line(&self.text()),
                path.join(",")
            ))
            .build()?;
        let report = report.encode(Representation::String, Dialect::FipaServices)?;
        Ok(report.to_vec())
    }
}

/// Returns the sender of a message. If the message has no addresses of the sender, the addresses in
/// the envelope are used.
pub(crate) fn sender_of(message: &Message, letter: &Letter) -> Option<AgentId> {
    let sender = message.sender()?;
    if sender.addresses().is_empty()
        && let Ok(envelope) = letter.parse_envelope()
        && let Some(from) = envelope.effective().from
        && from.name() == sender.name()
    {
        return Some(from);
    }
    Some(sender.clone())
}

fn path(letter: &Letter) -> Vec<String> {
    let envelope = letter.envelope();
    let mut path: Vec<String> = match EnvelopeView::parse(&envelope) {
        Ok(view) => {
            let stamps = view.stamps();
            stamps
                .map(|stamp| stamp.by().as_str().into_owned())
                .collect()
        }
        Err(_) => Vec::new(),
    };
    // The newest stamp comes first.
    path.reverse();
    path
}

/// The beginning of a text on one line, because fipa_services reads line by line.
fn one_line(text: &str) -> String {
    let line = escape(truncated(text, 400));
    truncated(&line, 400).to_owned()
}

/// A string literal of FIPA SL (FIPA00008): `\"` is its only escape.
fn sl_string(text: &str) -> String {
    format!("\"{}\"", text.replace('"', "\\\""))
}
