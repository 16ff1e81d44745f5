//! Encoded messages, checked once and borrowed, whatever the encoding.
//!
//! Here is what a view gives; how the bytes are read is the business of the modules that know one
//! encoding each. Owned messages are made of views.

mod agent_id;
mod content;
mod text;

use std::borrow::Cow;

use bytes::Bytes;

pub use agent_id::{AgentIdView, AgentIds};
pub(crate) use agent_id::{Encoding, List, Part, check_name};
pub(crate) use content::{Content, check_base64};
pub use text::Text;

use crate::error::{DecodeError, Problem};
use crate::{
    Message, Payload, Performative, Representation, Time, bitefficient, dialect, string, xml,
};

/// An encoded message, read without allocating.
///
/// The bytes are checked once, when the view is made; everything else hands out what lies in them.
/// Every encoding is read (FIPA00069, FIPA00070, FIPA00071), and leniently: what the standard says
/// and what fipa_services and JADE write. Of a parameter that is there several times the last one
/// counts, but for user-defined ones and the lists of agents in XML, which add up.
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
    /// The content is in Base64, as one of the user-defined parameters says.
    pub(crate) is_base64: bool,
}

#[derive(Debug, Clone, Copy)]
pub(crate) enum PerformativeView<'a> {
    /// The code of one of the standard.
    Standard(u8),
    /// A word.
    Other(Text<'a>),
}

impl<'a> PerformativeView<'a> {
    /// The act of this name, if it can be one.
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

/// Where the user-defined parameters of a message are.
#[derive(Debug, Clone, Copy)]
pub(crate) enum UserDefined<'a> {
    None,
    /// Among the parameters of a bit-efficient message; those in front of the content of a split
    /// one, and all others.
    BitEfficient([&'a [u8]; 2]),
    /// Behind the performative of a string message.
    String(&'a [u8]),
    /// Inside of the outermost element.
    Xml(&'a [u8]),
}

impl<'a> MessageView<'a> {
    /// Reads a message that lies in one piece; its first bytes tell the encoding.
    ///
    /// # Errors
    /// When the bytes are not one whole message.
    pub fn parse(bytes: &'a [u8]) -> Result<Self, DecodeError> {
        match Representation::detect(bytes) {
            Some(Representation::String) => string::view(bytes),
            Some(Representation::Xml) => xml::view(bytes),
            _ => bitefficient::view(bytes),
        }
    }

    /// Reads a message that may be split around its content, which is not touched then.
    ///
    /// # Errors
    /// When the pieces are not one whole message. A split one must be bit-efficient, and split just
    /// where its content is: `head` ends with the length of `content`.
    pub fn parse_payload(payload: &'a Payload) -> Result<Self, DecodeError> {
        if payload.is_split() {
            bitefficient::view_split(payload)
        } else {
            Self::parse(&payload.head)
        }
    }

    /// What the message does; allocates for a user-defined act.
    #[must_use]
    pub fn performative(&self) -> Performative {
        // Checked when the message was read: there is such an act, or the name is a word.
        match self.performative {
            PerformativeView::Standard(code) => Performative::of_code(code),
            PerformativeView::Other(name) => name.as_str().parse().ok(),
        }
        .unwrap_or(Performative::NotUnderstood)
    }

    /// The name of what the message does.
    #[must_use]
    pub fn performative_name(&self) -> Text<'a> {
        match self.performative {
            PerformativeView::Standard(code) => {
                Text::plain(Performative::name_of_code(code).as_bytes())
            }
            PerformativeView::Other(name) => name,
        }
    }

    /// Who sent it.
    #[must_use]
    pub fn sender(&self) -> Option<AgentIdView<'a>> {
        self.sender
    }

    /// Whom it is for.
    #[must_use]
    pub fn receivers(&self) -> AgentIds<'a> {
        self.receivers.clone()
    }

    /// Whom to send replies to, instead of the sender.
    #[must_use]
    pub fn reply_to(&self) -> AgentIds<'a> {
        self.reply_to.clone()
    }

    /// What it says: a slice of the encoded message, unless it was written with escapes, as an
    /// expression or in Base64.
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

    /// The conversation.
    #[must_use]
    pub fn conversation_id(&self) -> Option<Text<'a>> {
        self.conversation_id
    }

    /// What a reply is to have as `in-reply-to`.
    #[must_use]
    pub fn reply_with(&self) -> Option<Text<'a>> {
        self.reply_with
    }

    /// The `reply-with` of the message that this one answers.
    #[must_use]
    pub fn in_reply_to(&self) -> Option<Text<'a>> {
        self.in_reply_to
    }

    /// The latest time for the next message.
    #[must_use]
    pub fn reply_by(&self) -> Option<Time> {
        self.reply_by
    }

    /// User-defined parameters in the order of the message, names without `X-`.
    pub fn user_defined(&self) -> impl Iterator<Item = (Text<'a>, Text<'a>)> + use<'a> {
        let mut rest = self.user_defined;
        let hidden = self.is_base64;
        std::iter::from_fn(move || match &mut rest {
            UserDefined::None => None,
            UserDefined::BitEfficient(pieces) => bitefficient::next_user_defined(pieces),
            UserDefined::String(rest) => string::next_user_defined(rest),
            UserDefined::Xml(rest) => xml::next_user_defined(rest),
        })
        // That is part of the encoding, not of the message.
        .filter(move |(name, value)| !(hidden && dialect::announces_base64(name, value)))
    }

    /// An owned message. Its content shares the memory of the payload that was read, unless it has
    /// to be written out.
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

    /// A message with nothing but its act.
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

    /// Finds out, once all was read, whether the content is in Base64, and checks it then.
    pub(crate) fn settle_base64(
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
            // Of a split message, the content is that piece, or unusual enough for a copy.
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
