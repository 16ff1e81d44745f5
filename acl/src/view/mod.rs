//! Views of encoded messages in any encoding: checked once, borrowed from the bytes.
//!
//! This module has the values of a view. The modules of the encodings read the bytes. An owned
//! message is made from a view.

mod agent_id;
mod content;
mod index;
mod text;

use std::borrow::Cow;

use bytes::Bytes;

pub use agent_id::{AgentIdView, AgentIds};
pub(crate) use agent_id::{Encoding, List, Part, check_name};
pub(crate) use content::{Content, check_base64};
pub use index::MessageIndex;
pub use text::Text;

use crate::error::{DecodeError, Problem};
use crate::{
    Message, Payload, Performative, Representation, Time, bitefficient, dialect, string, xml,
};

/// An encoded message, read without allocating.
///
/// The bytes are checked once, when the view is made. The methods return parts of them. All
/// encodings are accepted (FIPA00069, FIPA00070, FIPA00071). The reader is lenient: it accepts the
/// standard and what fipa_services and JADE write. If a parameter is repeated, the last value counts.
/// User-defined parameters, and the lists of agents in XML, add up.
#[derive(Debug, Clone)]
pub struct MessageView<'a> {
    pub(crate) performative: PerformativeView<'a>,
    pub(crate) sender: Option<AgentIdView<'a>>,
    pub(crate) receivers: AgentIds<'a>,
    pub(crate) reply_to: AgentIds<'a>,
    pub(crate) content: Option<Content<'a>>,
    pub(crate) language: Option<Text<'a>>,
    pub(crate) encoding: Option<Text<'a>>,
    pub(crate) ontology: Option<Text<'a>>,
    pub(crate) protocol: Option<Text<'a>>,
    pub(crate) conversation_id: Option<Text<'a>>,
    pub(crate) reply_with: Option<Text<'a>>,
    pub(crate) in_reply_to: Option<Text<'a>>,
    pub(crate) reply_by: Option<Time>,
    pub(crate) user_defined: UserDefined<'a>,
    /// Whether a user-defined parameter marks the content as Base64.
    pub(crate) is_base64: bool,
}

#[derive(Debug, Clone, Copy)]
pub(crate) enum PerformativeView<'a> {
    /// The code of a standard act.
    Standard(u8),
    /// The name of a user-defined act.
    Other(Text<'a>),
}

impl<'a> PerformativeView<'a> {
    /// Returns the act with this name. Returns `None` if the name is not a word.
    pub(crate) fn of_name(name: Text<'a>) -> Option<Self> {
        match Performative::code_of_name(name.raw()) {
            Some(code) => Some(Self::Standard(code)),
            None => Self::of_other(name),
        }
    }

    #[cold]
    fn of_other(name: Text<'a>) -> Option<Self> {
        let text = name.as_str();
        match Performative::code_of_name(text.as_bytes()) {
            Some(code) => Some(Self::Standard(code)),
            None => crate::word::is_word(&*text).then_some(Self::Other(name)),
        }
    }
}

/// The bytes that contain the user-defined parameters of a message, among others.
#[derive(Debug, Clone, Copy)]
pub(crate) enum UserDefined<'a> {
    None,
    /// The parameters of a bit-efficient message. The first piece is in front of the content of a
    /// split message and otherwise empty.
    BitEfficient([&'a [u8]; 2]),
    /// The bytes behind the performative of a string message.
    String(&'a [u8]),
    /// The inside of the outermost XML element.
    Xml(&'a [u8]),
}

impl<'a> MessageView<'a> {
    /// Reads a message in one piece. The first bytes determine the encoding.
    ///
    /// # Errors
    /// The bytes are not one whole message.
    pub fn parse(bytes: &'a [u8]) -> Result<Self, DecodeError> {
        match Representation::detect(bytes) {
            Some(Representation::String) => string::view(bytes),
            Some(Representation::Xml) => xml::view(bytes),
            _ => bitefficient::view(bytes),
        }
    }

    /// Reads a message that may be split around its content. The content of a split message is not
    /// accessed.
    ///
    /// # Errors
    /// The pieces are not one whole message. A split message must be bit-efficient, and its `head`
    /// must end with the length of `content`.
    pub fn parse_payload(payload: &'a Payload) -> Result<Self, DecodeError> {
        if payload.is_split() {
            bitefficient::view_split(payload)
        } else {
            Self::parse(&payload.head)
        }
    }

    /// The communicative act. A user-defined act is allocated.
    #[must_use]
    pub fn performative(&self) -> Performative {
        // The reader has checked the code or the name, so the fallback is never used.
        match self.performative {
            PerformativeView::Standard(code) => Performative::of_code(code),
            PerformativeView::Other(name) => name.as_str().parse().ok(),
        }
        .unwrap_or(Performative::NotUnderstood)
    }

    /// The name of the communicative act.
    #[must_use]
    pub fn performative_name(&self) -> Text<'a> {
        match self.performative {
            PerformativeView::Standard(code) => {
                Text::plain(Performative::name_of_code(code).as_bytes())
            }
            PerformativeView::Other(name) => name,
        }
    }

    /// The sender.
    #[must_use]
    pub fn sender(&self) -> Option<AgentIdView<'a>> {
        self.sender
    }

    /// The receivers.
    #[must_use]
    pub fn receivers(&self) -> AgentIds<'a> {
        self.receivers.clone()
    }

    /// The agents that receive replies instead of the sender.
    #[must_use]
    pub fn reply_to(&self) -> AgentIds<'a> {
        self.reply_to.clone()
    }

    /// The content: a slice of the encoded message. It is allocated if it was encoded with escapes,
    /// as an expression or in Base64.
    #[must_use]
    pub fn content(&self) -> Option<Cow<'a, [u8]>> {
        let content = self.content?;
        Some(if self.is_base64 {
            content.of_base64()
        } else {
            content.bytes()
        })
    }

    /// The language of the content.
    #[must_use]
    pub fn language(&self) -> Option<Text<'a>> {
        self.language
    }

    /// The encoding of the content expression.
    #[must_use]
    pub fn encoding(&self) -> Option<Text<'a>> {
        self.encoding
    }

    /// The ontology of the content.
    #[must_use]
    pub fn ontology(&self) -> Option<Text<'a>> {
        self.ontology
    }

    /// The interaction protocol.
    #[must_use]
    pub fn protocol(&self) -> Option<Text<'a>> {
        self.protocol
    }

    /// The conversation identifier.
    #[must_use]
    pub fn conversation_id(&self) -> Option<Text<'a>> {
        self.conversation_id
    }

    /// The `in-reply-to` that a reply must have.
    #[must_use]
    pub fn reply_with(&self) -> Option<Text<'a>> {
        self.reply_with
    }

    /// The `reply-with` of the message that this message answers.
    #[must_use]
    pub fn in_reply_to(&self) -> Option<Text<'a>> {
        self.in_reply_to
    }

    /// The latest time for a reply.
    #[must_use]
    pub fn reply_by(&self) -> Option<Time> {
        self.reply_by
    }

    /// Names, without their `X-`, and values of user-defined parameters, in the order of the message.
    pub fn user_defined(&self) -> impl Iterator<Item = (Text<'a>, Text<'a>)> + use<'a> {
        let mut rest = self.user_defined;
        let hidden = self.is_base64;
        std::iter::from_fn(move || match &mut rest {
            UserDefined::None => None,
            UserDefined::BitEfficient(pieces) => bitefficient::next_user_defined(pieces),
            UserDefined::String(rest) => string::next_user_defined(rest),
            UserDefined::Xml(rest) => xml::next_user_defined(rest),
        })
        // The mark for Base64 belongs to the encoding, not to the message.
        .filter(move |(name, value)| !(hidden && dialect::announces_base64(name, value)))
    }

    /// Converts the view to an owned message. The content shares the memory of the payload unless it
    /// must be unescaped.
    pub(crate) fn to_message(&self, payload: &Payload) -> Result<Message, DecodeError> {
        let text = |text: Option<Text<'_>>| text.map(|text| text.as_str().into_owned());
        Ok(Message {
            performative: self.performative(),
            sender: self.sender.map(AgentIdView::to_agent_id).transpose()?,
            receivers: self.receivers.to_agent_ids()?,
            reply_to: self.reply_to.to_agent_ids()?,
            content: self.content().map(|content| shared(payload, content)),
            language: text(self.language),
            encoding: text(self.encoding),
            ontology: text(self.ontology),
            protocol: text(self.protocol),
            conversation_id: text(self.conversation_id),
            reply_with: text(self.reply_with),
            in_reply_to: text(self.in_reply_to),
            reply_by: self.reply_by,
            user_defined: self
                .user_defined()
                .map(|(name, value)| (name.as_str().into_owned(), value.as_str().into_owned()))
                .collect(),
        })
    }

    /// Converts the view of a checked message to an owned message. The reader has checked all that the
    /// conversion checks, so the message with the performative alone is never used.
    fn to_checked_message(&self, payload: &Payload) -> Message {
        self.to_message(payload).unwrap_or_else(|error| {
            debug_assert!(false, "a checked message is not whole: {error}");
            Message::empty(self.performative())
        })
    }

    /// Creates a view of a message with a performative only.
    #[inline(always)]
    pub(crate) fn empty(performative: PerformativeView<'a>) -> Self {
        Self {
            performative,
            sender: None,
            receivers: AgentIds::default(),
            reply_to: AgentIds::default(),
            content: None,
            language: None,
            encoding: None,
            ontology: None,
            protocol: None,
            conversation_id: None,
            reply_with: None,
            in_reply_to: None,
            reply_by: None,
            user_defined: UserDefined::None,
            is_base64: false,
        }
    }

    /// Detects and checks content in Base64, after all parameters were read.
    pub(crate) fn check_for_base64(
        &mut self,
        offset: usize,
        clause: &'static str,
    ) -> Result<(), DecodeError> {
        let (Some(content), false) = (self.content, matches!(self.user_defined, UserDefined::None))
        else {
            return Ok(());
        };
        self.is_base64 = self
            .user_defined()
            .any(|(name, value)| dialect::announces_base64(&name, &value));
        if self.is_base64 && !check_base64(&content.bytes()) {
            return Err(DecodeError::new(offset, clause, Problem::Base64));
        }
        Ok(())
    }
}

fn shared(payload: &Payload, content: Cow<'_, [u8]>) -> Bytes {
    match content {
        Cow::Borrowed([]) => Bytes::new(),
        Cow::Borrowed(slice) if payload.is_split() => {
            // The content of a split message is its own piece. Otherwise it is in the head.
            if std::ptr::eq(slice, &*payload.content) {
                payload.content.clone()
            } else {
                payload.head.slice_ref(slice)
            }
        }
        Cow::Borrowed(slice) => payload.head.slice_ref(slice),
        Cow::Owned(bytes) => bytes.into(),
    }
}
