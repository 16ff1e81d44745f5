//! The builder of messages. It refuses values that an encoding cannot represent.

use std::convert::Infallible;

use bytes::Bytes;

use crate::word::is_token;
use crate::{AgentId, AgentIdError, Message, Performative, Time};

/// A builder of a message: see [`Message::builder`] and [`Message::reply`].
///
/// Setting a parameter again replaces its value. Receivers, reply-to and user-defined parameters
/// add up.
///
/// An agent is given as an [`AgentId`] or as its name. An invalid name is an error of
/// [`build`](Self::build).
#[derive(Debug, Clone)]
#[must_use]
pub struct MessageBuilder {
    message: Message,
    /// The error of the first invalid agent.
    invalid_agent: Option<AgentIdError>,
}

/// Error of building a message.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum BuildError {
    /// A text has a NUL character, which ends a text in FIPA00069 and is not allowed in XML.
    #[error("the {parameter} of the message has a NUL character")]
    Nul {
        /// The parameter.
        parameter: &'static str,
    },
    /// The protocol is not one word.
    #[error(
        "not a protocol name: {0:?}; give one word without blanks, parentheses or control characters"
    )]
    Protocol(String),
    /// The name of a user-defined parameter is not one word.
    #[error(
        "not a name of a user-defined parameter: {0:?}; give one word without blanks, parentheses \
         or control characters, and without X-"
    )]
    UserDefinedName(String),
    /// The content is longer than [`Message::MAX_CONTENT`].
    #[error("content of {0} bytes is too long for a message (maximum 4294967295)")]
    ContentTooLong(usize),
    /// The name of a receiver is invalid.
    #[error(transparent)]
    Agent(#[from] AgentIdError),
}

/// Starts with the parameters of an existing message.
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
        Self {
            message,
            invalid_agent: None,
        }
    }

    /// Converts an agent. Keeps the error of the first one that is invalid.
    fn agent<A>(&mut self, agent: A) -> Option<AgentId>
    where
        A: TryInto<AgentId, Error: Into<AgentIdError>>,
    {
        match agent.try_into() {
            Ok(agent) => Some(agent),
            Err(error) => {
                self.invalid_agent.get_or_insert(error.into());
                None
            }
        }
    }

    /// Sets the sender.
    pub fn sender(mut self, sender: AgentId) -> Self {
        self.message.sender = Some(sender);
        self
    }

    /// Adds a receiver: an [`AgentId`] or a name.
    pub fn receiver<A>(self, receiver: A) -> Self
    where
        A: TryInto<AgentId, Error: Into<AgentIdError>>,
    {
        self.receivers([receiver])
    }

    /// Adds receivers: [`AgentId`]s or names.
    pub fn receivers<A>(mut self, receivers: impl IntoIterator<Item = A>) -> Self
    where
        A: TryInto<AgentId, Error: Into<AgentIdError>>,
    {
        for receiver in receivers {
            if let Some(receiver) = self.agent(receiver) {
                self.message.receivers.push(receiver);
            }
        }
        self
    }

    /// Sets the receivers, and removes those that were set before.
    pub fn replace_receivers<A>(mut self, receivers: impl IntoIterator<Item = A>) -> Self
    where
        A: TryInto<AgentId, Error: Into<AgentIdError>>,
    {
        self.message.receivers.clear();
        self.receivers(receivers)
    }

    /// Adds an agent that receives replies instead of the sender.
    pub fn reply_to<A>(mut self, agent: A) -> Self
    where
        A: TryInto<AgentId, Error: Into<AgentIdError>>,
    {
        if let Some(agent) = self.agent(agent) {
            self.message.reply_to.push(agent);
        }
        self
    }

    /// Sets the content.
    pub fn content(mut self, content: impl Into<Bytes>) -> Self {
        self.message.content = Some(content.into());
        self
    }

    /// Sets the language of the content.
    pub fn language(mut self, language: impl Into<String>) -> Self {
        self.message.language = Some(language.into());
        self
    }

    /// Sets the encoding of the content expression.
    pub fn encoding(mut self, encoding: impl Into<String>) -> Self {
        self.message.encoding = Some(encoding.into());
        self
    }

    /// Sets the ontology of the content.
    pub fn ontology(mut self, ontology: impl Into<String>) -> Self {
        self.message.ontology = Some(ontology.into());
        self
    }

    /// Sets the interaction protocol: one word.
    pub fn protocol(mut self, protocol: impl Into<String>) -> Self {
        self.message.protocol = Some(protocol.into());
        self
    }

    /// Sets the conversation identifier.
    pub fn conversation_id(mut self, conversation_id: impl Into<String>) -> Self {
        self.message.conversation_id = Some(conversation_id.into());
        self
    }

    /// Sets the `in-reply-to` of replies.
    pub fn reply_with(mut self, reply_with: impl Into<String>) -> Self {
        self.message.reply_with = Some(reply_with.into());
        self
    }

    /// Sets the `reply-with` of the message that this message answers.
    pub fn in_reply_to(mut self, in_reply_to: impl Into<String>) -> Self {
        self.message.in_reply_to = Some(in_reply_to.into());
        self
    }

    /// Sets the latest time for a reply.
    pub fn reply_by(mut self, reply_by: Time) -> Self {
        self.message.reply_by = Some(reply_by);
        self
    }

    /// Adds a user-defined parameter. The name has no `X-`.
    pub fn user_defined(mut self, name: impl Into<String>, value: impl Into<String>) -> Self {
        self.message.user_defined.push((name.into(), value.into()));
        self
    }

    /// Builds the message.
    ///
    /// # Errors
    /// A message cannot have one of the values: see [`BuildError`].
    pub fn build(self) -> Result<Message, BuildError> {
        if let Some(error) = self.invalid_agent {
            return Err(error.into());
        }
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

impl TryFrom<MessageBuilder> for Message {
    type Error = BuildError;

    /// Builds the message; see [`MessageBuilder::build`].
    fn try_from(builder: MessageBuilder) -> Result<Self, BuildError> {
        builder.build()
    }
}

/// A message that is built already has no error.
impl From<Infallible> for BuildError {
    fn from(never: Infallible) -> Self {
        match never {}
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
    fn values_that_an_encoding_cannot_represent_are_refused() {
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
    fn agents_are_given_by_name_or_identifier_and_a_bad_name_is_an_error_of_build() {
        let id = AgentId::new("c").unwrap();
        let message = built(|b| {
            let b = b.receiver("a").receivers([String::from("b")]);
            b.receiver(&id).receiver(id.clone()).reply_to("d")
        });
        let message = message.unwrap();
        let names: Vec<&str> = message.receivers().iter().map(AgentId::name).collect();
        assert_eq!(names, ["a", "b", "c", "c"]);
        assert_eq!(message.reply_to()[0].name(), "d");
        let nul = Err(BuildError::Agent(AgentIdError::Nul("name")));
        // The first error counts, and removing the receivers does not remove it.
        assert_eq!(
            built(|b| b.receivers(["a", "b\0", ""]).replace_receivers(["a"])),
            nul
        );
        assert!(built(|b| b.reply_to("")).is_err());
    }

    #[test]
    fn empty_content_differs_from_missing_content() {
        let empty = built(|b| b.content("")).unwrap();
        assert_eq!(empty.content(), Some(&Bytes::new()));
        assert_ne!(empty, built(|b| b).unwrap());
    }
}
