//! Letters that the caller reads, and the structure of a message.

use std::sync::OnceLock;
use std::time::{SystemTime, UNIX_EPOCH};

use bytes::Bytes;
use fipa::protocol::Notification;
use fipa::{AgentId, Incoming, Kind, Message, Time, is_in_place};

use crate::raw::{Extensible, FipaBytes, FipaText, Readable};

/// A user-defined parameter of a message.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct FipaParameter {
    /// The name, one word.
    pub name: FipaText,
    /// The value.
    pub value: FipaText,
}

/// The parameters of a message (FIPA00061). A parameter that is zero is not set.
///
/// A call does not use the structure, or anything that it points to, after the call. The texts and bytes that
/// `fipa_read_message` writes into it belong to the letter, and are valid until the handle of the letter is closed.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct FipaMessage {
    /// sizeof(struct fipa_message).
    pub size: usize,
    /// The act, such as `request` or `inform`. An answer (`fipa_answer`) and a message (`fipa_send`) need one.
    pub performative: FipaText,
    /// The name of the sender. Ignored in messages that are sent: the agent is the sender.
    pub sender: FipaText,
    /// Names of the receivers, or patterns such as `arm_.*`.
    pub receivers: *const FipaText,
    /// Number of the receivers.
    pub receiver_count: usize,
    /// Names of the agents that get the answers instead of the sender.
    pub reply_to: *const FipaText,
    /// Number of these agents.
    pub reply_to_count: usize,
    /// The content. An empty content has a pointer that is not NULL.
    pub content: FipaBytes,
    /// The language of the content.
    pub language: FipaText,
    /// The encoding of the content.
    pub encoding: FipaText,
    /// The ontology of the content.
    pub ontology: FipaText,
    /// The interaction protocol, such as `fipa-request`.
    pub protocol: FipaText,
    /// The conversation identifier.
    pub conversation_id: FipaText,
    /// The text that an answer has as its `in_reply_to`.
    pub reply_with: FipaText,
    /// The `reply_with` of the message that this one answers.
    pub in_reply_to: FipaText,
    /// Time by which an answer is due, in nanoseconds since 1970-01-01 UTC.
    pub reply_by: i64,
    /// User-defined parameters.
    pub parameters: *const FipaParameter,
    /// Number of the user-defined parameters.
    pub parameter_count: usize,
    /// The handle of a lock, or of the membership in a coalition that the agent leads. The message then carries its
    /// fences. Zero in messages that are read.
    pub lock: u64,
}

// SAFETY: It begins with a `usize`.
unsafe impl Extensible for FipaMessage {}
// SAFETY: Its fields are pointers and numbers.
unsafe impl Readable for FipaMessage {}

/// Facts about a letter.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct FipaLetterInfo {
    /// sizeof(struct fipa_letter_info).
    pub size: usize,
    /// The transport that handed the letter to this process. Empty for a letter of this process itself, and for a
    /// message that a conversation has read.
    pub via: FipaText,
    /// How the message violates its protocol, if `monitor.check` is `warn` or `enforce`. Empty if it does not.
    pub violation: FipaText,
    /// Whether the content is read in shared memory of the sender: 1, or 0. A process has a bounded number of such
    /// contents: at most 15 of one sender. It gets copies of further ones.
    pub in_place: i32,
}

// SAFETY: It begins with a `usize`.
unsafe impl Extensible for FipaLetterInfo {}

/// A message that the caller reads.
pub(crate) struct Letter {
    source: Source,
    content: OnceLock<Option<Bytes>>,
    lists: OnceLock<Lists>,
    violation: OnceLock<Option<String>>,
}

enum Source {
    Incoming(Box<Incoming>),
    Message(Box<Message>),
}

/// The lists of a message in the form of the interface. The pointers lead into the message.
struct Lists {
    receivers: Vec<FipaText>,
    reply_to: Vec<FipaText>,
    parameters: Vec<FipaParameter>,
}

// SAFETY: The pointers lead into the message of the same letter, which is behind a pointer of its own and is never
// changed. Reading them from any thread is like reading the message.
unsafe impl Send for Lists {}
// SAFETY: As above.
unsafe impl Sync for Lists {}

impl From<Incoming> for Letter {
    fn from(incoming: Incoming) -> Self {
        Self::new(Source::Incoming(Box::new(incoming)))
    }
}

impl From<Message> for Letter {
    fn from(message: Message) -> Self {
        Self::new(Source::Message(Box::new(message)))
    }
}

impl From<Notification> for Letter {
    fn from(notification: Notification) -> Self {
        notification.into_message().into()
    }
}

impl Letter {
    fn new(source: Source) -> Self {
        Self {
            source,
            content: OnceLock::new(),
            lists: OnceLock::new(),
            violation: OnceLock::new(),
        }
    }

    pub(crate) fn message(&self) -> &Message {
        match &self.source {
            Source::Incoming(incoming) => incoming.message(),
            Source::Message(message) => message,
        }
    }

    fn bytes(&self) -> Option<&[u8]> {
        let content = self.content.get_or_init(|| match &self.source {
            // Without decoding the other parameters.
            Source::Incoming(incoming) => incoming.content(),
            Source::Message(message) => message.content().cloned(),
        });
        content.as_deref()
    }

    pub(crate) fn content(&self) -> FipaBytes {
        self.bytes().map_or(FipaBytes::NONE, FipaBytes::of)
    }

    fn lists(&self) -> &Lists {
        self.lists.get_or_init(|| {
            let message = self.message();
            let names =
                |agents: &[AgentId]| agents.iter().map(|it| FipaText::of(it.name())).collect();
            let parameters = message.user_defined().iter();
            Lists {
                receivers: names(message.receivers()),
                reply_to: names(message.reply_to()),
                parameters: parameters
                    .map(|(name, value)| FipaParameter {
                        name: FipaText::of(name),
                        value: FipaText::of(value),
                    })
                    .collect(),
            }
        })
    }

    pub(crate) fn info(&self) -> FipaLetterInfo {
        let incoming = match &self.source {
            Source::Incoming(incoming) => Some(incoming),
            Source::Message(_) => None,
        };
        let violation = self.violation.get_or_init(|| {
            let violation = incoming?.violation()?;
            Some(violation.to_string())
        });
        FipaLetterInfo {
            size: size_of::<FipaLetterInfo>(),
            via: FipaText::of_option(incoming.and_then(|it| it.via).map(Kind::name)),
            violation: FipaText::of_option(violation.as_deref()),
            in_place: self.bytes().is_some_and(is_in_place).into(),
        }
    }

    pub(crate) fn parameters(&self) -> FipaMessage {
        let message = self.message();
        let lists = self.lists();
        FipaMessage {
            size: size_of::<FipaMessage>(),
            performative: FipaText::of(message.performative().as_str()),
            sender: FipaText::of_option(message.sender().map(AgentId::name)),
            receivers: lists.receivers.as_ptr(),
            receiver_count: lists.receivers.len(),
            reply_to: lists.reply_to.as_ptr(),
            reply_to_count: lists.reply_to.len(),
            content: self.content(),
            language: FipaText::of_option(message.language()),
            encoding: FipaText::of_option(message.encoding()),
            ontology: FipaText::of_option(message.ontology()),
            protocol: FipaText::of_option(message.protocol()),
            conversation_id: FipaText::of_option(message.conversation_id()),
            reply_with: FipaText::of_option(message.reply_with()),
            in_reply_to: FipaText::of_option(message.in_reply_to()),
            reply_by: message.reply_by().map_or(0, nanoseconds),
            parameters: lists.parameters.as_ptr(),
            parameter_count: lists.parameters.len(),
            lock: 0,
        }
    }
}

fn nanoseconds(time: Time) -> i64 {
    let time = time.to_system_time(SystemTime::now());
    let (span, sign) = match time.duration_since(UNIX_EPOCH) {
        Ok(after) => (after, 1),
        Err(before) => (before.duration(), -1),
    };
    i64::try_from(span.as_nanos()).map_or(i64::MAX * sign, |span| span * sign)
}
