//! The message (FIPA00061), independent of its encoding.

use std::error::Error;
use std::fmt;
use std::str::{FromStr, Utf8Error};

use bytes::Bytes;

use crate::builder::MessageBuilder;
use crate::escape::quote;
use crate::{AgentId, Performative, Time, escape, escape_name};

/// A FIPA message (FIPA00061).
///
/// Every message can be encoded bit-efficiently: [`MessageBuilder::build`] and the decoders refuse
/// values that cannot. An absent parameter is `None` or empty. Absent content differs from empty
/// content.
///
/// Encodings: bit-efficient (FIPA00069), string (FIPA00070), XML (FIPA00071).
///
/// Cloning shares the memory of the content. The content may be in shared memory that another
/// process of the same user can still write to. Code that depends on stable bytes must copy it
/// first.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Message {
    pub(crate) performative: Performative,
    pub(crate) sender: Option<AgentId>,
    pub(crate) receivers: Vec<AgentId>,
    pub(crate) reply_to: Vec<AgentId>,
    pub(crate) content: Option<Bytes>,
    pub(crate) language: Option<String>,
    pub(crate) encoding: Option<String>,
    pub(crate) ontology: Option<String>,
    pub(crate) protocol: Option<String>,
    pub(crate) conversation_id: Option<String>,
    pub(crate) reply_with: Option<String>,
    pub(crate) in_reply_to: Option<String>,
    pub(crate) reply_by: Option<Time>,
    pub(crate) user_defined: Vec<(String, String)>,
}

impl Message {
    /// Maximum length of the content in bytes. FIPA00069 has lengths of up to 32 bits.
    pub const MAX_CONTENT: u64 = u32::MAX as u64;

    /// Returns a builder of a message.
    pub fn builder(performative: Performative) -> MessageBuilder {
        MessageBuilder::new(performative)
    }

    /// Returns a builder of a reply to this message.
    ///
    /// The receivers are the agents in `reply-to`, or the sender if there are none. Language,
    /// ontology, protocol and conversation identifier are those of this message. `in-reply-to` is
    /// its `reply-with`. The caller sets the sender and, if it expects an answer, a new
    /// `reply-with`.
    pub fn reply(&self, performative: Performative) -> MessageBuilder {
        let receivers = if self.reply_to.is_empty() {
            self.sender.iter().cloned().collect()
        } else {
            self.reply_to.clone()
        };
        MessageBuilder::of(Self {
            receivers,
            language: self.language.clone(),
            ontology: self.ontology.clone(),
            protocol: self.protocol.clone(),
            conversation_id: self.conversation_id.clone(),
            in_reply_to: self.reply_with.clone(),
            ..Self::empty(performative)
        })
    }

    /// Whether this message answers `other`.
    ///
    /// If this message has `in-reply-to` and `other` has `reply-with`, they must be equal, and the
    /// conversation identifiers must not differ. Otherwise the conversation identifiers must be
    /// equal and the senders must differ. (fipa_services does not evaluate `in-reply-to`.)
    #[must_use]
    pub fn is_reply_to(&self, other: &Self) -> bool {
        let same_conversation = match (&self.conversation_id, &other.conversation_id) {
            (Some(mine), Some(theirs)) => Some(mine == theirs),
            _ => None,
        };
        let same_sender = match (&self.sender, &other.sender) {
            (Some(mine), Some(theirs)) => mine.same_agent(theirs),
            _ => false,
        };
        match (&self.in_reply_to, &other.reply_with) {
            (Some(mine), Some(theirs)) => mine == theirs && same_conversation != Some(false),
            _ => same_conversation == Some(true) && !same_sender,
        }
    }

    /// The communicative act.
    #[must_use]
    pub fn performative(&self) -> &Performative {
        &self.performative
    }

    /// The sender. Anonymous messages have none.
    #[must_use]
    pub fn sender(&self) -> Option<&AgentId> {
        self.sender.as_ref()
    }

    /// The receivers.
    #[must_use]
    pub fn receivers(&self) -> &[AgentId] {
        &self.receivers
    }

    /// The agents that receive replies instead of the sender.
    #[must_use]
    pub fn reply_to(&self) -> &[AgentId] {
        &self.reply_to
    }

    /// The content, in the [`language`](Self::language) and [`encoding`](Self::encoding) of the
    /// message.
    #[must_use]
    pub fn content(&self) -> Option<&Bytes> {
        self.content.as_ref()
    }

    /// Returns a copy of the content as text. Bytes that are not UTF-8 become U+FFFD. Missing content
    /// is empty text.
    #[must_use]
    pub fn text(&self) -> String {
        let content = self.content.as_deref().unwrap_or_default();
        // Copied before it is decoded: another process may change shared memory meanwhile.
        let copy = content.to_vec();
        String::from_utf8(copy)
            .unwrap_or_else(|error| String::from_utf8_lossy(error.as_bytes()).into_owned())
    }

    /// Parses the content as text, without white space at both ends.
    ///
    /// ```
    /// # use fipa_acl::{Message, Performative};
    /// let bid = Message::builder(Performative::Propose).content("2.5\n").build()?;
    /// assert_eq!(bid.parse::<f64>()?, 2.5);
    /// # Ok::<_, Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// # Errors
    /// If the message has no content, or if the content is not UTF-8 text or not a value of the type.
    pub fn parse<T>(&self) -> Result<T, ContentError>
    where
        T: FromStr<Err: Into<Box<dyn Error + Send + Sync>>>,
    {
        let content = self.content.as_ref().ok_or(ContentError::Missing)?.to_vec();
        let text = std::str::from_utf8(&content).map_err(ContentError::NotText)?;
        let text = text.trim();
        text.parse().map_err(|error: T::Err| ContentError::Parse {
            text: text.chars().take(SHOWN).collect(),
            source: error.into(),
        })
    }

    /// The language of the content.
    #[must_use]
    pub fn language(&self) -> Option<&str> {
        self.language.as_deref()
    }

    /// The encoding of the content expression.
    #[must_use]
    pub fn encoding(&self) -> Option<&str> {
        self.encoding.as_deref()
    }

    /// The ontology that gives the symbols in the content their meaning.
    #[must_use]
    pub fn ontology(&self) -> Option<&str> {
        self.ontology.as_deref()
    }

    /// The interaction protocol that the message is part of.
    #[must_use]
    pub fn protocol(&self) -> Option<&str> {
        self.protocol.as_deref()
    }

    /// The identifier of the conversation that the message is part of.
    #[must_use]
    pub fn conversation_id(&self) -> Option<&str> {
        self.conversation_id.as_deref()
    }

    /// The `in-reply-to` that a reply to this message must have.
    #[must_use]
    pub fn reply_with(&self) -> Option<&str> {
        self.reply_with.as_deref()
    }

    /// The `reply-with` of the message that this message answers.
    #[must_use]
    pub fn in_reply_to(&self) -> Option<&str> {
        self.in_reply_to.as_deref()
    }

    /// The latest time for a reply.
    #[must_use]
    pub fn reply_by(&self) -> Option<Time> {
        self.reply_by
    }

    /// Names, without their `X-`, and values of user-defined parameters, in the order of the
    /// message. The last of several with the same name counts.
    #[must_use]
    pub fn user_defined(&self) -> &[(String, String)] {
        &self.user_defined
    }

    /// Removes the content and returns it. [`MessageBuilder::from`] can set another content.
    pub fn take_content(&mut self) -> Option<Bytes> {
        self.content.take()
    }

    pub(crate) fn empty(performative: Performative) -> Self {
        Self {
            performative,
            sender: None,
            receivers: Vec::new(),
            reply_to: Vec::new(),
            content: None,
            language: None,
            encoding: None,
            ontology: None,
            protocol: None,
            conversation_id: None,
            reply_with: None,
            in_reply_to: None,
            reply_by: None,
            user_defined: Vec::new(),
        }
    }
}

/// Error of [`Message::parse`].
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ContentError {
    /// The message has no content.
    #[error("the message has no content")]
    Missing,
    /// The content is not UTF-8 text.
    #[error("the content is not text")]
    NotText(#[source] Utf8Error),
    /// The content is not a value of the type. `text` has its first 80 characters.
    #[error("cannot parse the content \"{}\"", escape(text))]
    Parse {
        /// The beginning of the content.
        text: String,
        /// The error of the type.
        source: Box<dyn Error + Send + Sync>,
    },
}

/// Maximum number of characters of a text or content that [`Message`]'s `Display` shows.
const SHOWN: usize = 80;

/// Writes a form similar to FIPA00070 for people: agents by name only, long texts truncated, all
/// texts [escaped](escape), and those that are not one word [in quotation marks](escape_name). The alternate form
/// (`{:#}`) truncates no text. No decoder reads it.
impl fmt::Display for Message {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let most = if f.alternate() { usize::MAX } else { SHOWN };
        write!(f, "({}", escape_name(self.performative.as_str()))?;
        if let Some(sender) = &self.sender {
            write!(f, " :sender {}", escape_name(sender.name()))?;
        }
        for (key, agents) in [("receiver", &self.receivers), ("reply-to", &self.reply_to)] {
            if !agents.is_empty() {
                write!(f, " :{key} (set")?;
                for agent in agents {
                    write!(f, " {}", escape_name(agent.name()))?;
                }
                f.write_str(")")?;
            }
        }
        for (key, value) in [
            ("protocol", &self.protocol),
            ("conversation-id", &self.conversation_id),
            ("reply-with", &self.reply_with),
            ("in-reply-to", &self.in_reply_to),
            ("language", &self.language),
            ("encoding", &self.encoding),
            ("ontology", &self.ontology),
        ] {
            if let Some(value) = value {
                write!(f, " :{key} {}", shown(value, most))?;
            }
        }
        if let Some(reply_by) = self.reply_by {
            write!(f, " :reply-by {reply_by}")?;
        }
        for (name, value) in &self.user_defined {
            write!(f, " :X-{} {}", escape_name(name), shown(value, most))?;
        }
        if let Some(content) = &self.content {
            write!(f, " :content {}", shown_content(content, most))?;
        }
        f.write_str(")")
    }
}

/// Formats at most the first `most` characters of a text.
fn shown(text: &str, most: usize) -> String {
    if text.chars().nth(most).is_none() {
        return escape_name(text).into_owned();
    }
    shown_start(text, text.len(), most)
}

/// Formats a text of `len` bytes that begins with `start`.
fn shown_start(start: &str, len: usize, most: usize) -> String {
    let cut: String = start.chars().take(most).collect();
    let mut out = quote(&cut);
    if cut.len() < len {
        out.push_str(&format!("… ({len} bytes)"));
    }
    out
}

fn shown_content(content: &Bytes, most: usize) -> String {
    // A copy, because another process may change shared memory after it was checked for UTF-8.
    let start = content.slice(..content.len().min(most.saturating_mul(4)));
    let start = start.to_vec();
    match std::str::from_utf8(&start) {
        Ok(text) => shown_start(text, content.len(), most),
        // The last character is incomplete.
        Err(error) if error.error_len().is_none() && start.len() < content.len() => {
            let whole = start.get(..error.valid_up_to()).unwrap_or_default();
            shown_start(&String::from_utf8_lossy(whole), content.len(), most)
        }
        Err(_) => format!("<{} bytes>", content.len()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn agent(name: &str) -> AgentId {
        AgentId::new(name).unwrap()
    }

    fn request() -> Message {
        Message::builder(Performative::Request)
            .sender(agent("alice"))
            .receiver(agent("bob"))
            .content("lift")
            .language("plain")
            .encoding("utf-8")
            .ontology("crane")
            .protocol("fipa-request")
            .conversation_id("c 1")
            .reply_with("r1")
            .build()
            .unwrap()
    }

    #[test]
    fn a_reply_copies_the_parameters_of_the_standard() {
        let reply = request().reply(Performative::Agree).build().unwrap();
        assert_eq!(reply.receivers(), [agent("alice")]);
        assert_eq!(reply.sender(), None);
        assert_eq!(reply.language(), Some("plain"));
        assert_eq!(reply.ontology(), Some("crane"));
        assert_eq!(reply.protocol(), Some("fipa-request"));
        assert_eq!(reply.conversation_id(), Some("c 1"));
        assert_eq!(reply.in_reply_to(), Some("r1"));
        assert_eq!((reply.encoding(), reply.reply_with()), (None, None));
        assert_eq!(reply.content(), None);
        assert!(reply.is_reply_to(&request()));
    }

    #[test]
    fn replies_go_to_reply_to_instead_of_the_sender() {
        let mut message = request();
        message.reply_to = vec![agent("carol"), agent("dave")];
        let reply = message.reply(Performative::Agree).build().unwrap();
        assert_eq!(reply.receivers(), [agent("carol"), agent("dave")]);
    }

    #[test]
    fn replies_are_recognized_by_reply_with_and_conversation() {
        let asked = request();
        let mut answer = asked
            .reply(Performative::Inform)
            .sender(agent("bob"))
            .build()
            .unwrap();
        answer.in_reply_to = Some("another".into());
        assert!(!answer.is_reply_to(&asked));
        answer.in_reply_to = None;
        assert!(answer.is_reply_to(&asked), "the conversation decides");
        answer.conversation_id = Some("c 2".into());
        assert!(!answer.is_reply_to(&asked));
        assert!(
            !asked.is_reply_to(&asked),
            "a message is no reply to itself"
        );
    }

    #[test]
    fn content_is_read_as_text_and_as_a_value() {
        let of = |content: &'static [u8]| {
            let builder = Message::builder(Performative::Inform).content(content);
            builder.build().unwrap()
        };
        assert_eq!(of(b" 12\n").parse::<u8>().unwrap(), 12);
        assert_eq!(of(b" 12\n").text(), " 12\n");
        assert_eq!(of(b"a\xffb").text(), "a\u{fffd}b");
        let none = Message::empty(Performative::Inform);
        assert_eq!(none.text(), "");
        assert!(matches!(none.parse::<u8>(), Err(ContentError::Missing)));
        let parsed = of(b"\xff").parse::<u8>();
        assert!(matches!(parsed, Err(ContentError::NotText(_))));
        let error = of(b"300\x1b").parse::<u8>().unwrap_err();
        assert_eq!(error.to_string(), r#"cannot parse the content "300\u{1b}""#);
        assert!(error.source().is_some());
    }

    #[test]
    fn display_shows_truncated_and_escaped_parameters() {
        assert_eq!(
            request().to_string(),
            "(request :sender alice :receiver (set bob) :protocol fipa-request \
             :conversation-id \"c 1\" :reply-with r1 :language plain :encoding utf-8 \
             :ontology crane :content \"lift\")"
        );
        let mut long = request();
        long.content = Some("x\x1b".repeat(100).into());
        assert!(long.to_string().ends_with("… (200 bytes))"));
        assert!(!long.to_string().contains('\x1b'));
        assert!(!format!("{long:#}").contains(['…', '\x1b']));
        long.content = Some(Bytes::from_static(b"\xff\xfe"));
        assert!(long.to_string().contains(":content <2 bytes>"));
    }

    #[test]
    fn names_cannot_forge_parameters_of_the_shown_message() {
        let name = "boss-mts :receiver rover :ontology \"estop\"";
        let message = Message::builder(Performative::Inform)
            .sender(agent(name))
            .receiver(agent("rover) :content \"stop\""))
            .build()
            .unwrap();
        assert_eq!(
            message.to_string(),
            r#"(inform :sender "boss-mts :receiver rover :ontology \"estop\"" :receiver (set "rover) :content \"stop\""))"#
        );
    }
}
