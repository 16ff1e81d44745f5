//! Selects letters.

use clap::Args;
use fipa::admin::watch::Passage;
use fipa::{Matcher, Message, Performative};

use super::checker::CheckResult;

// The conditions for a letter. An empty list accepts every letter. Not a doc comment: clap would print it as the help of
// the command.
#[derive(Debug, Clone, Args)]
pub(in crate::command) struct Filter {
    /// Only letters from or to this agent, or agents matching this pattern; repeatable
    #[arg(long, value_name = "AGENT", value_parser = Matcher::parse)]
    agent: Vec<Matcher>,

    /// Only letters of this protocol, or protocols matching this pattern; repeatable
    #[arg(long, value_name = "PROTOCOL", value_parser = Matcher::parse)]
    protocol: Vec<Matcher>,

    /// Only letters with this performative; repeatable
    #[arg(long, value_name = "PERFORMATIVE")]
    pub(in crate::command) performative: Vec<Performative>,

    /// Only letters of this conversation, or conversations matching this pattern; repeatable
    #[arg(long, value_name = "ID", value_parser = conversation)]
    conversation: Vec<Conversation>,

    /// Only letters that violate their protocols
    #[arg(long)]
    pub(in crate::command) violations: bool,
}

/// A conversation identifier or pattern. Programs make identifiers, so one can look like a pattern;
/// therefore the text is compared in both meanings.
#[derive(Debug, Clone)]
pub(super) struct Conversation {
    id: String,
    pattern: Matcher,
}

fn conversation(text: &str) -> Result<Conversation, fipa::error::PatternError> {
    let exact = || Matcher::Exact(text.to_owned());
    Ok(Conversation {
        id: text.to_owned(),
        pattern: Matcher::parse(text).unwrap_or_else(|_| exact()),
    })
}

/// The data of a letter that a filter compares.
#[derive(Debug, Clone, Copy)]
pub(in crate::command) struct Traits<'a> {
    pub(in crate::command) sender: Option<&'a str>,
    pub(in crate::command) receiver: &'a str,
    pub(in crate::command) message: Option<&'a Message>,
    /// The protocol of the conversation, which the checker knows when the message has none.
    pub(in crate::command) checked_protocol: Option<&'a str>,
    pub(in crate::command) is_violation: bool,
}

impl Filter {
    /// Whether every letter is taken.
    pub(in crate::command) fn is_empty(&self) -> bool {
        let Self {
            agent,
            protocol,
            performative,
            conversation,
            violations,
        } = self;
        agent.is_empty()
            && protocol.is_empty()
            && performative.is_empty()
            && conversation.is_empty()
            && !violations
    }

    pub(in crate::command) fn takes(&self, passage: &Passage, checked: &CheckResult) -> bool {
        self.takes_letter(&Traits {
            sender: passage.sender(),
            receiver: &passage.receiver,
            message: passage.message.as_ref(),
            checked_protocol: checked.protocol(),
            is_violation: checked.is_violation(),
        })
    }

    pub(in crate::command) fn takes_letter(&self, letter: &Traits<'_>) -> bool {
        let of = |agent: &Matcher| {
            letter.sender.is_some_and(|sender| agent.matches(sender))
                || agent.matches(letter.receiver)
        };
        let performative = letter.message.map(Message::performative);
        let protocol = letter.message.and_then(Message::protocol);
        let protocol = protocol.or(letter.checked_protocol);
        let conversation = letter.message.and_then(Message::conversation_id);
        (self.agent.is_empty() || self.agent.iter().any(of))
            && (self.performative.is_empty()
                || performative.is_some_and(|it| self.performative.contains(it)))
            && self.takes_conversation(protocol, conversation)
            && (!self.violations || letter.is_violation)
    }

    /// Whether the filter accepts this protocol and conversation, for any agent.
    pub(in crate::command) fn takes_conversation(
        &self,
        protocol: Option<&str>,
        conversation: Option<&str>,
    ) -> bool {
        let of_protocol = |wanted: &Matcher| protocol.is_some_and(|it| wanted.matches(it));
        let of_conversation = |wanted: &Conversation| {
            conversation.is_some_and(|it| wanted.id == it || wanted.pattern.matches(it))
        };
        (self.protocol.is_empty() || self.protocol.iter().any(of_protocol))
            && (self.conversation.is_empty() || self.conversation.iter().any(of_conversation))
    }
}
