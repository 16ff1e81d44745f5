//! Building messages that every encoding can carry.

use bytes::Bytes;

use crate::word::is_token;
use crate::{AgentId, Message, Performative, Time};

/// A message in the making: see [`Message::builder`] and [`Message::reply`].
///
/// Setting a parameter again replaces it; receivers, reply-to and user-defined parameters add up.
#[derive(Debug, Clone)]
#[must_use]
pub struct MessageBuilder {
    message: Message,
}

/// Why a message cannot be built.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum BuildError {
    /// A text has a NUL character, which ends a text in FIPA00069 and cannot stand in XML.
    #[error("the {parameter} of a message must not have NUL characters")]
    Nul {
        /// The parameter.
        parameter: &'static str,
    },
    /// The protocol is not one word.
    #[error(
        "not a protocol name: {0:?} (one word without blanks, parentheses or control characters)"
    )]
    Protocol(String),
    /// The name of a user-defined parameter is not one word.
    #[error(
        "not a name for a user-defined parameter: {0:?} (one word without blanks, parentheses or \
         control characters, and without X-)"
    )]
    UserDefinedName(String),
    /// There is more content than a message can carry.
    #[error("content of {0} bytes (a message carries at most 4294967295)")]
    ContentTooLong(usize),
}

/// Goes on from a message that exists.
impl From<Message> for MessageBuilder {
    fn from(message: Message) -> Self {
        Self::of(message)
    }
}

impl MessageBuilder {
    pub(crate) fn new(performative: Performative) -> Self {
        Self::of(Message::empty(performative))
    }

    pub(crate) fn of(message: Message) -> Self {
        Self { message }
    }

    /// Who sends it.
    pub fn sender(mut self, sender: AgentId) -> Self {
        self.message.sender = Some(sender);
        self
    }

    /// One more receiver.
    pub fn receiver(mut self, receiver: AgentId) -> Self {
        self.message.receivers.push(receiver);
        self
    }

    /// More receivers.
    pub fn receivers(mut self, receivers: impl IntoIterator<Item = AgentId>) -> Self {
        self.message.receivers.extend(receivers);
        self
    }

    /// One more agent to send replies to, instead of the sender.
    pub fn reply_to(mut self, agent: AgentId) -> Self {
        self.message.reply_to.push(agent);
        self
    }

    /// What it says.
    pub fn content(mut self, content: impl Into<Bytes>) -> Self {
        self.message.content = Some(content.into());
        self
    }

    /// The language of the content.
    pub fn language(mut self, language: impl Into<String>) -> Self {
        self.message.language = Some(language.into());
        self
    }

    /// The encoding of the content expression.
    pub fn encoding(mut self, encoding: impl Into<String>) -> Self {
        self.message.encoding = Some(encoding.into());
        self
    }

    /// The ontology of the content.
    pub fn ontology(mut self, ontology: impl Into<String>) -> Self {
        self.message.ontology = Some(ontology.into());
        self
    }

    /// The interaction protocol: one word.
    pub fn protocol(mut self, protocol: impl Into<String>) -> Self {
        self.message.protocol = Some(protocol.into());
        self
    }

    /// The conversation.
    pub fn conversation_id(mut self, conversation_id: impl Into<String>) -> Self {
        self.message.conversation_id = Some(conversation_id.into());
        self
    }

    /// What a reply is to have as `in-reply-to`.
    pub fn reply_with(mut self, reply_with: impl Into<String>) -> Self {
        self.message.reply_with = Some(reply_with.into());
        self
    }

    /// The `reply-with` of the message that this one answers.
    pub fn in_reply_to(mut self, in_reply_to: impl Into<String>) -> Self {
        self.message.in_reply_to = Some(in_reply_to.into());
        self
    }

    /// The latest time for the next message of the conversation.
    pub fn reply_by(mut self, reply_by: Time) -> Self {
        self.message.reply_by = Some(reply_by);
        self
    }

    /// One more user-defined parameter; the name is given without `X-`.
    pub fn user_defined(mut self, name: impl Into<String>, value: impl Into<String>) -> Self {
        self.message.user_defined.push((name.into(), value.into()));
        self
    }

    /// The message.
    ///
    /// # Errors
    /// When a parameter has a value that a message cannot carry.
    pub fn build(self) -> Result<Message, BuildError> {
        let message = self.message;
        let texts = [
            ("language", &message.language),
            ("encoding", &message.encoding),
            ("ontology", &message.ontology),
            ("conversation-id", &message.conversation_id),
            ("reply-with", &message.reply_with),
            ("in-reply-to", &message.in_reply_to),
        ];
        for (parameter, text) in texts {
            if text.as_ref().is_some_and(|text| text.contains('\0')) {
                return Err(BuildError::Nul { parameter });
            }
        }
        if let Some(protocol) = message.protocol.as_ref().filter(|name| !is_token(name)) {
            return Err(BuildError::Protocol(short(protocol)));
        }
        for (name, value) in &message.user_defined {
            if !is_token(name) {
                return Err(BuildError::UserDefinedName(short(name)));
            }
            if value.contains('\0') {
                let parameter = "user-defined parameter";
                return Err(BuildError::Nul { parameter });
            }
        }
        let content_len = message.content.as_ref().map_or(0, Bytes::len);
        if content_len as u64 > Message::MAX_CONTENT {
            return Err(BuildError::ContentTooLong(content_len));
        }
        Ok(message)
    }
}

fn short(text: &str) -> String {
    text.chars().take(60).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn built(set: impl Fn(MessageBuilder) -> MessageBuilder) -> Result<Message, BuildError> {
        set(Message::builder(Performative::Inform)).build()
    }

    #[test]
    fn what_no_encoding_can_carry_is_refused() {
        let nul = |parameter| Err(BuildError::Nul { parameter });
        assert_eq!(built(|b| b.language("a\0")), nul("language"));
        assert_eq!(built(|b| b.conversation_id("\0")), nul("conversation-id"));
        assert_eq!(
            built(|b| b.user_defined("a", "\0")),
            nul("user-defined parameter")
        );
        for wrong in ["", "a b", "a\0", "(a)"] {
            assert!(built(|b| b.protocol(wrong)).is_err(), "{wrong:?}");
            assert!(built(|b| b.user_defined(wrong, "")).is_err(), "{wrong:?}");
        }
    }

    #[test]
    fn empty_content_differs_from_none() {
        let empty = built(|b| b.content("")).unwrap();
        assert_eq!(empty.content(), Some(&Bytes::new()));
        assert_ne!(empty, built(|b| b).unwrap());
    }
}
