//! The messages as ACL messages.
//!
//! | act | performative | protocol | content |
//! |---|---|---|---|
//! | `Query` | `query-if` | `dlm_discover` | resource |
//! | `Owned` | `inform` | `dlm_discover` | resource |
//! | `Contested` * | `refuse` | `dlm_discover` | resource |
//! | `Seen` * | `inform` | `fipa-fence` | resource, fence |
//! | `Probe` | `request` | `dlm_probe` | empty |
//! | `Alive` | `confirm` | `dlm_probe` | empty |
//! | `Ask` * | `request` | `owner_queue` | resource, or resource and place |
//! | `Place` * | `agree` | `owner_queue` | resource, place |
//! | `Request` | `request` | `ricart_agrawala…` | clock, resource |
//! | `Agree` | `agree` | `ricart_agrawala…` | clock, resource |
//! | `RequestToken` | `request` | `suzuki_kasami…` | resource, number |
//! | `Token` | `propagate` | `suzuki_kasami…` | the token |
//! | `Confirm` | `confirm` | that of the algorithm | resource |
//! | `Renew` * | `confirm` | that of the algorithm | resource, fence |
//! | `Granted` * | `inform` | that of the algorithm | resource, fence, lease in ms |
//! | `Refused` * | `refuse` | that of the algorithm | resource, reason |
//! | `Release` | `disconfirm` | that of the algorithm | resource |
//!
//! Parts of a content are separated by newlines. Acts with * are sent between agents of this library
//! only; the others are those of `distributed_locking`. An agent of this library sets the `ontology`
//! to [`ONTOLOGY`], which `distributed_locking` ignores. The time of sending of a request for a grant is
//! its `reply-with`, and the `in-reply-to` of the answer. A `Query` that claims has the `reply-with`
//! `claim`. An `Owned` names the algorithm of the resource in the user-defined parameter [`ALGORITHM`].
//!
//! The token is a Boost text archive with the `language` [`BOOST_TOKEN`], or, when no legacy agent is a
//! member, lines with the `language` [`TOKEN`]: `generation 2`, `last 7 rover` for each agent, and
//! `next rover` for each agent in the queue.

mod boost;

use std::sync::Arc;

use fipa_acl::{AgentId, BuildError, Message, Performative};

use crate::{
    Act, Algorithm, Content, Conversation, FenceError, LockDialect, LockMessage, MAX_NAME,
    MAX_PLACE, Millis, NameError, Refusal, Resource, Token,
};

/// Ontology of the messages of this library.
pub const ONTOLOGY: &str = "fipa-locking";

/// Language of a token of this library.
pub const TOKEN: &str = "fipa-locking-token";

/// Language of a token of `distributed_locking`.
pub const BOOST_TOKEN: &str = "suzuki_kasami::Token";

/// Name of the user-defined parameter (without `X-`) in which an owner names the algorithm of its resource.
pub const ALGORITHM: &str = "fipa-algorithm";

/// Protocol of discovery.
pub const DISCOVER: &str = "dlm_discover";

/// Protocol of reports about fences, between agents of this library only.
pub const FENCES: &str = "fipa-fence";

/// Protocol of probes.
pub const PROBE: &str = "dlm_probe";

/// Maximum number of agents in a token.
const MAX_AGENTS: usize = 4096;

/// Maximum length of a content in bytes.
const MAX_CONTENT: usize = 2 * MAX_AGENTS * (MAX_NAME + 32);

/// Value of `reply-with` in a query that claims.
const CLAIM: &str = "claim";

/// Error of reading a message.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum DecodeError {
    /// The protocol is not one of locks, or not the one of this group.
    #[error("the protocol is not {DISCOVER}, {PROBE}, {FENCES} or {0}")]
    Protocol(Algorithm),
    /// The protocol has no such message.
    #[error("the protocol has no message with performative {0}")]
    Performative(String),
    /// The message has no conversation.
    #[error("the message has no conversation-id")]
    NoConversation,
    /// The content is longer than a message of the protocol can be.
    #[error("the content has {0} bytes (maximum {MAX_CONTENT})")]
    TooLong(usize),
    /// The content is not UTF-8.
    #[error("the content is not UTF-8")]
    Utf8,
    /// The content has another number of parts.
    #[error("the content has {0} lines, which the message of this performative does not have")]
    Parts(usize),
    /// A number is missing or too large.
    #[error("{0} is not a number in the range of the protocol")]
    Number(&'static str),
    /// A resource or an agent has no valid name.
    #[error(transparent)]
    Name(#[from] NameError),
    /// The fence is not valid.
    #[error(transparent)]
    Fence(#[from] FenceError),
    /// A refusal has an unknown reason.
    #[error("the refusal has an unknown reason")]
    Reason,
    /// The token is not valid.
    #[error("the token is not valid at byte {at}: {problem}")]
    Token {
        /// Position in the content.
        at: usize,
        /// The problem.
        problem: &'static str,
    },
}

/// Writes a message. `kind` is the algorithm of a message that names none.
///
/// # Errors
/// A name cannot be encoded in an ACL message.
pub fn encode(
    message: &LockMessage,
    kind: Algorithm,
    sender: &AgentId,
    receiver: &AgentId,
) -> Result<Message, BuildError> {
    let kind = message.algorithm.unwrap_or(kind);
    let (performative, protocol, content) = parts(message, kind);
    let mut builder = Message::builder(performative)
        .sender(sender.clone())
        .receiver(receiver.clone())
        .protocol(protocol)
        .conversation_id(message.conversation.to_string())
        .content(content);
    if message.dialect == LockDialect::Own {
        builder = builder.ontology(ONTOLOGY);
    }
    if let Content::Lock { act, .. } = &message.content {
        builder = match act {
            Act::Query { claim: true } => builder.reply_with(CLAIM),
            Act::Owned => match message.algorithm {
                Some(kind) => builder.user_defined(ALGORITHM, kind.protocol()),
                None => builder,
            },
            Act::Ask { asked, .. } => builder.reply_with(asked.to_string()),
            Act::Confirm { asked: Some(asked) } | Act::Renew { asked, .. } => {
                builder.reply_with(asked.to_string())
            }
            Act::Granted { asked, .. } | Act::Refused { asked, .. } => {
                builder.in_reply_to(asked.to_string())
            }
            Act::Token(token) => builder.language(match token.archive {
                Some(_) => BOOST_TOKEN,
                None => TOKEN,
            }),
            _ => builder,
        };
    }
    builder.build()
}

fn parts(message: &LockMessage, kind: Algorithm) -> (Performative, &'static str, String) {
    let (resource, act) = match &message.content {
        Content::Probe => return (Performative::Request, PROBE, String::new()),
        Content::Alive => return (Performative::Confirm, PROBE, String::new()),
        Content::Lock { resource, act } => (resource, act),
    };
    let protocol = kind.protocol();
    match act {
        Act::Query { .. } => (Performative::QueryIf, DISCOVER, resource.to_string()),
        Act::Owned => (Performative::Inform, DISCOVER, resource.to_string()),
        Act::Contested => (Performative::Refuse, DISCOVER, resource.to_string()),
        Act::Seen { fence } => {
            let content = format!("{resource}\n{fence}");
            (Performative::Inform, FENCES, content)
        }
        Act::Ask { place, .. } => {
            let content = match place {
                Some(place) => format!("{resource}\n{place}"),
                None => resource.to_string(),
            };
            (Performative::Request, protocol, content)
        }
        Act::Place { place } => {
            let content = format!("{resource}\n{place}");
            (Performative::Agree, protocol, content)
        }
        Act::Request { clock } => {
            let content = format!("{clock}\n{resource}");
            (Performative::Request, protocol, content)
        }
        Act::Agree { clock } => {
            let content = format!("{clock}\n{resource}");
            (Performative::Agree, protocol, content)
        }
        Act::RequestToken { number } => {
            let content = format!("{resource}\n{number}");
            (Performative::Request, protocol, content)
        }
        Act::Token(token) => {
            let content = match token.archive {
                Some(version) => boost::write(version, resource, token),
                None => write_token(resource, token),
            };
            (Performative::Propagate, protocol, content)
        }
        Act::Confirm { .. } => (Performative::Confirm, protocol, resource.to_string()),
        Act::Renew { fence, .. } => {
            let content = format!("{resource}\n{fence}");
            (Performative::Confirm, protocol, content)
        }
        Act::Granted { fence, lease, .. } => {
            let content = format!("{resource}\n{fence}\n{lease}");
            (Performative::Inform, protocol, content)
        }
        Act::Refused { reason, .. } => {
            let content = format!("{resource}\n{}", reason.as_str());
            (Performative::Refuse, protocol, content)
        }
        Act::Release => (Performative::Disconfirm, protocol, resource.to_string()),
    }
}

/// Whether a message with this protocol is one of locks, in any algorithm.
#[must_use]
pub fn is_lock_protocol(protocol: &str) -> bool {
    let mut kinds = Algorithm::ALL.iter().map(|kind| kind.protocol());
    [DISCOVER, PROBE, FENCES].contains(&protocol) || kinds.any(|name| name == protocol)
}

/// Reads a message of any algorithm.
///
/// # Errors
/// The message is not a message of locks.
pub fn read(message: &Message) -> Result<LockMessage, DecodeError> {
    let kind = message.protocol().and_then(Algorithm::named);
    decode(message, kind.unwrap_or_default())
}

/// Returns the algorithm that a message of discovery names.
fn named(message: &Message) -> Option<Algorithm> {
    let mut parameters = message.user_defined().iter();
    let (_, value) = parameters.find(|(name, _)| name.eq_ignore_ascii_case(ALGORITHM))?;
    Algorithm::named(value)
}

/// Reads a message of an agent of a group that uses `kind`.
///
/// # Errors
/// The message is not a message of locks.
pub fn decode(message: &Message, kind: Algorithm) -> Result<LockMessage, DecodeError> {
    let protocol = message.protocol().ok_or(DecodeError::Protocol(kind))?;
    let conversation = message
        .conversation_id()
        .map(Conversation::parse)
        .ok_or(DecodeError::NoConversation)?;
    let dialect = match message.ontology() {
        Some(ONTOLOGY) => LockDialect::Own,
        _ => LockDialect::Legacy,
    };
    let content = message
        .content()
        .map_or(&[][..], |content| content.as_ref());
    if content.len() > MAX_CONTENT {
        return Err(DecodeError::TooLong(content.len()));
    }
    let text = str::from_utf8(content).map_err(|_| DecodeError::Utf8)?;
    let wrong = || DecodeError::Performative(message.performative().as_str().to_owned());
    let mut algorithm_of = None;
    let content = match protocol {
        PROBE => match message.performative() {
            Performative::Request => Content::Probe,
            Performative::Confirm => Content::Alive,
            _ => return Err(wrong()),
        },
        DISCOVER => Content::Lock {
            resource: Resource::new(text)?,
            act: match message.performative() {
                Performative::QueryIf => Act::Query {
                    claim: message.reply_with() == Some(CLAIM),
                },
                Performative::Inform => {
                    algorithm_of = named(message);
                    Act::Owned
                }
                Performative::Refuse => Act::Contested,
                _ => return Err(wrong()),
            },
        },
        FENCES => {
            if *message.performative() != Performative::Inform {
                return Err(wrong());
            }
            let (resource, fence) = text
                .split_once('\n')
                .ok_or_else(|| DecodeError::Parts(text.split('\n').count()))?;
            Content::Lock {
                resource: Resource::new(resource)?,
                act: Act::Seen {
                    fence: fence.parse()?,
                },
            }
        }
        _ if protocol == kind.protocol() => {
            let (resource, act) = algorithm(message, text, kind, dialect)?.ok_or_else(wrong)?;
            algorithm_of = Some(kind);
            Content::Lock { resource, act }
        }
        _ => return Err(DecodeError::Protocol(kind)),
    };
    Ok(LockMessage {
        conversation,
        dialect,
        algorithm: algorithm_of,
        content,
    })
}

/// Reads a message of the algorithm. `None` if it has no message with this performative.
fn algorithm(
    message: &Message,
    text: &str,
    kind: Algorithm,
    dialect: LockDialect,
) -> Result<Option<(Resource, Act)>, DecodeError> {
    if *message.performative() == Performative::Propagate && kind.has_token() {
        let (resource, token) = match message.language() {
            Some(TOKEN) => read_token(text)?,
            _ => boost::read(text)?,
        };
        return Ok(Some((resource, Act::Token(token))));
    }
    let mut lines = text.splitn(4, '\n');
    let lines = (lines.next(), lines.next(), lines.next(), lines.next());
    let parts = || DecodeError::Parts(text.split('\n').count());
    let number = |what, text: &str| {
        let number = text.parse::<u64>().map_err(|_| DecodeError::Number(what));
        number.and_then(|number| match i32::try_from(number) {
            Ok(_) => Ok(number),
            Err(_) => Err(DecodeError::Number(what)),
        })
    };
    let time = |what, text: Option<&str>| -> Result<Millis, DecodeError> {
        text.and_then(|text| text.parse().ok())
            .ok_or(DecodeError::Number(what))
    };
    let place = |text: &str| match text.parse::<u32>() {
        Ok(place) if (1..=MAX_PLACE).contains(&place) => Ok(place),
        _ => Err(DecodeError::Number("the place")),
    };
    let (resource, act) = match (message.performative(), kind.has_token()) {
        (Performative::Request, _) if kind == Algorithm::OwnerQueue => {
            let (Some(resource), former, None, None) = lines else {
                return Err(parts());
            };
            let asked = time("reply-with", message.reply_with())?;
            let place = former.map(place).transpose()?;
            (resource, Act::Ask { asked, place })
        }
        (Performative::Agree, _) if kind == Algorithm::OwnerQueue => {
            let (Some(resource), Some(text), None, None) = lines else {
                return Err(parts());
            };
            let place = place(text)?;
            (resource, Act::Place { place })
        }
        // The request is the report.
        (Performative::Confirm, _) if kind == Algorithm::OwnerQueue && lines.1.is_none() => {
            return Ok(None);
        }
        (Performative::Request, false) | (Performative::Agree, false) => {
            let (Some(clock), Some(resource), None, None) = lines else {
                return Err(parts());
            };
            let clock = number("the clock", clock)?;
            let act = match message.performative() {
                Performative::Agree => Act::Agree { clock },
                _ => Act::Request { clock },
            };
            (resource, act)
        }
        (Performative::Request, true) => {
            let (Some(resource), Some(of_request), None, None) = lines else {
                return Err(parts());
            };
            let number = number("the number of the request", of_request)?;
            (resource, Act::RequestToken { number })
        }
        (Performative::Confirm, _) => match lines {
            (Some(resource), None, None, None) => {
                let asked = match dialect {
                    LockDialect::Own => Some(time("reply-with", message.reply_with())?),
                    LockDialect::Legacy => None,
                };
                (resource, Act::Confirm { asked })
            }
            (Some(resource), Some(fence), None, None) => {
                let asked = time("reply-with", message.reply_with())?;
                let fence = fence.parse()?;
                (resource, Act::Renew { fence, asked })
            }
            _ => return Err(parts()),
        },
        (Performative::Inform, _) => {
            let (Some(resource), Some(fence), Some(lease), None) = lines else {
                return Err(parts());
            };
            let granted = Act::Granted {
                fence: fence.parse()?,
                lease: time("the lease", Some(lease))?,
                asked: time("in-reply-to", message.in_reply_to())?,
            };
            (resource, granted)
        }
        (Performative::Refuse, _) => {
            let (Some(resource), Some(reason), None, None) = lines else {
                return Err(parts());
            };
            let mut reasons = Refusal::ALL.into_iter();
            let refused = Act::Refused {
                reason: reasons
                    .find(|known| known.as_str() == reason)
                    .ok_or(DecodeError::Reason)?,
                asked: time("in-reply-to", message.in_reply_to())?,
            };
            (resource, refused)
        }
        (Performative::Disconfirm, _) => {
            let (Some(resource), None, None, None) = lines else {
                return Err(parts());
            };
            (resource, Act::Release)
        }
        _ => return Ok(None),
    };
    Ok(Some((Resource::new(resource)?, act)))
}

fn write_token(resource: &Resource, token: &Token) -> String {
    let mut text = format!("{resource}\ngeneration {}", token.generation.unwrap_or(0));
    for (name, last) in &token.last {
        text += &format!("\nlast {last} {name}");
    }
    for name in &token.queue {
        text += &format!("\nnext {name}");
    }
    text
}

fn read_token(text: &str) -> Result<(Resource, Token), DecodeError> {
    let mut at = 0;
    let mut resource = None;
    let mut token = Token::default();
    for (index, line) in text.split('\n').enumerate() {
        let wrong = |problem| DecodeError::Token { at, problem };
        let (key, value) = line.split_once(' ').unwrap_or((line, ""));
        match (index, key) {
            (0, _) => resource = Some(Resource::new(line)?),
            (1, "generation") => {
                let generation = value.parse().map_err(|_| wrong("no generation"))?;
                token.generation = Some(generation);
            }
            (1, _) => return Err(wrong("no generation")),
            (_, "last") => {
                let (number, name) = value.split_once(' ').ok_or(wrong("no agent"))?;
                let number = number.parse().map_err(|_| wrong("no number"))?;
                token.add_last(name, number, at)?;
            }
            (_, "next") => token.add_next(value, at)?,
            _ => return Err(wrong("an unknown word")),
        }
        at += line.len() + 1;
    }
    match (resource, token.generation) {
        (Some(resource), Some(_)) => Ok((resource, token)),
        _ => Err(DecodeError::Token {
            at,
            problem: "no generation",
        }),
    }
}

impl Token {
    fn add_last(&mut self, name: &str, number: u64, at: usize) -> Result<(), DecodeError> {
        let problem = match () {
            () if self.last.len() >= MAX_AGENTS => "too many agents",
            () if i32::try_from(number).is_err() => "a number out of range",
            () => {
                self.last.insert(agent(name)?, number);
                return Ok(());
            }
        };
        Err(DecodeError::Token { at, problem })
    }

    fn add_next(&mut self, name: &str, at: usize) -> Result<(), DecodeError> {
        if self.queue.len() >= MAX_AGENTS {
            let problem = "too many agents";
            return Err(DecodeError::Token { at, problem });
        }
        self.queue.push_back(agent(name)?);
        Ok(())
    }
}

fn agent(name: &str) -> Result<Arc<str>, DecodeError> {
    Ok(crate::LockPeer::new(name, 0)?.shared_name().clone())
}

#[cfg(test)]
mod tests;
