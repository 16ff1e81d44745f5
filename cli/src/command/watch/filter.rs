//! Selects the letters to show.

use fipa::admin::watch::Passage;
use fipa::{Matcher, Performative};

use super::checker::CheckResult;

/// The conditions for showing a letter. An empty list accepts every letter.
#[derive(Debug)]
pub(super) struct Filter<'a> {
    pub(super) agents: &'a [Matcher],
    pub(super) protocols: &'a [Matcher],
    pub(super) performatives: &'a [Performative],
    pub(super) conversations: &'a [Conversation],
    pub(super) violations: bool,
}

/// A conversation identifier or pattern. Programs make identifiers, so one can look like a pattern;
/// therefore the text is compared in both meanings.
#[derive(Debug, Clone)]
pub(super) struct Conversation {
    id: String,
    pattern: Matcher,
}

pub(super) fn conversation(text: &str) -> Result<Conversation, fipa::error::PatternError> {
    let exact = || Matcher::Exact(text.to_owned());
    Ok(Conversation {
        id: text.to_owned(),
        pattern: Matcher::parse(text).unwrap_or_else(|_| exact()),
    })
}

impl Filter<'_> {
    pub(super) fn takes(&self, passage: &Passage, checked: &CheckResult) -> bool {
        let message = passage.message.as_ref();
        let of = |agent: &Matcher| {
            let from = passage.sender().is_some_and(|sender| agent.matches(sender));
            from || agent.matches(&passage.receiver)
        };
        let performative = message.map(fipa::Message::performative);
        // The checker knows the protocol of a conversation when the message has none.
        let protocol = message.and_then(fipa::Message::protocol);
        let protocol = protocol.or_else(|| checked.protocol());
        (self.agents.is_empty() || self.agents.iter().any(of))
            && (self.performatives.is_empty()
                || performative.is_some_and(|it| self.performatives.contains(it)))
            && self.takes_conversation(protocol, message.and_then(fipa::Message::conversation_id))
            && (!self.violations || checked.is_violation())
    }

    /// Whether the filter accepts this protocol and conversation, for any agent.
    pub(super) fn takes_conversation(
        &self,
        protocol: Option<&str>,
        conversation: Option<&str>,
    ) -> bool {
        let of_protocol = |wanted: &Matcher| protocol.is_some_and(|it| wanted.matches(it));
        let of_conversation = |wanted: &Conversation| {
            conversation.is_some_and(|it| wanted.id == it || wanted.pattern.matches(it))
        };
        (self.protocols.is_empty() || self.protocols.iter().any(of_protocol))
            && (self.conversations.is_empty() || self.conversations.iter().any(of_conversation))
    }
}
