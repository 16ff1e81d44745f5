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

/// Maximum number of addresses of the sender in a failure message.
const MAX_ADDRESSES: usize = 16;
/// Maximum length in bytes of a text that a failure message repeats. A longer one is left out.
const MAX_REPEATED: usize = 4096;
/// Maximum number of services in the path of a letter, of which the last ones count.
const MAX_PATH: usize = 64;

/// The parts of a letter that a message about its failure repeats. Their length is bounded, because the message
/// is written while the core is locked.
#[derive(Debug)]
pub(crate) struct Failed {
    /// Receiver of the failure message.
    pub(crate) sender: AgentId,
    protocol: Option<String>,
    conversation_id: Option<String>,
    reply_with: Option<String>,
    /// Services that stamped the letter, in order.
    path: Vec<String>,
}

impl Failed {
    /// Decodes the message, in time in proportion to its bytes. `None` if neither the message nor
    /// the envelope names a sender, or the message is a failure message itself.
    pub(crate) fn of(letter: &Letter) -> Option<Self> {
        match Message::decode(letter.payload()) {
            Ok(message) => Self::of_message(&message, letter),
            Err(_) => Self::of_envelope(letter),
        }
    }

    /// Describes the failure of a letter whose message is decoded.
    pub(crate) fn of_message(message: &Message, letter: &Letter) -> Option<Self> {
        if *message.performative() == Performative::Failure {
            return None;
        }
        Some(Self {
            sender: brief(&sender_of(message, letter)?)?,
            protocol: repeated(message.protocol()),
            conversation_id: repeated(message.conversation_id()),
            reply_with: repeated(message.reply_with()),
            path: path(letter),
        })
    }

    /// Describes the failure of a letter whose message cannot be decoded.
    pub(crate) fn of_envelope(letter: &Letter) -> Option<Self> {
        Some(Self {
            sender: brief(&letter.parse_envelope().ok()?.effective().from?)?,
            protocol: None,
            conversation_id: None,
            reply_with: None,
            path: path(letter),
        })
    }
}

/// The failed delivery of a letter to one receiver.
pub(crate) struct Failure<'a> {
    pub(crate) letter: &'a Failed,
    /// Intended receiver of the letter.
    pub(crate) receiver: &'a str,
    pub(crate) reason: FailureReason,
    pub(crate) detail: &'a str,
    /// Number of the sender's letters that failed, also to other receivers and for other reasons.
    pub(crate) count: usize,
}

impl Failure<'_> {
    /// Encodes the failure message of this service for a sender that reads this dialect.
    pub(crate) fn written_for(
        &self,
        mts: &str,
        dialect: Dialect,
        utc: SystemTime,
    ) -> Result<Letter, Box<dyn Error>> {
        let mut failure = Message::builder(Performative::Failure)
            .sender(AgentId::new(mts)?)
            .receiver(self.letter.sender.clone())
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
        if let Some(protocol) = &self.letter.protocol {
            failure = failure.protocol(protocol);
        }
        if let Some(conversation) = &self.letter.conversation_id {
            failure = failure.conversation_id(conversation);
        }
        if let Some(reply_with) = &self.letter.reply_with {
            failure = failure.in_reply_to(reply_with);
        }
        Ok(letter_for(&failure.build()?, utc)?)
    }

    fn sl_content(&self) -> String {
        let text = self.text();
        format!(
            "((action (agent-identifier :name {}) (ACLMessage)) \
             (MTS-error (agent-identifier :name {}) (internal-error {})))",
            sl_string(self.letter.sender.name()),
            sl_string(self.receiver),
            sl_string(&text),
        )
    }

    /// The reason, its detail if there is one, and the number of letters if the message is about several.
    fn text(&self) -> String {
        let text = match self.detail {
            "" => self.reason.to_string(),
            detail => format!("{}: {detail}", self.reason),
        };
        match self.count {
            0 | 1 => text,
            count => format!("{text} (and {} more letters were not delivered)", count - 1),
        }
    }

    fn path_content(&self, mts: &str) -> Result<Vec<u8>, Box<dyn Error>> {
        let mut path = self.letter.path.clone();
        path.push(mts.to_owned());
        let report = Message::builder(Performative::Inform)
            .sender(self.letter.sender.clone())
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

/// Returns the name of an agent and its first addresses.
fn brief(agent: &AgentId) -> Option<AgentId> {
    let mut brief = AgentId::new(agent.name()).ok()?;
    let addresses = agent.addresses().iter().take(MAX_ADDRESSES);
    for address in addresses.filter(|it| it.len() <= MAX_REPEATED) {
        brief = brief.with_address(address).ok()?;
    }
    Some(brief)
}

fn repeated(text: Option<&str>) -> Option<String> {
    let text = text.filter(|text| text.len() <= MAX_REPEATED)?;
    Some(text.to_owned())
}

fn path(letter: &Letter) -> Vec<String> {
    let envelope = letter.envelope();
    let mut path: Vec<String> = match EnvelopeView::parse(&envelope) {
        Ok(view) => {
            let stamps = view.stamps().take(MAX_PATH);
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
