//! The positions of the parameters in a checked message, apart from its bytes.

use bytes::Bytes;

use crate::bitefficient::code;
use crate::error::DecodeError;
use crate::view::agent_id::Set;
use crate::view::text::Repr;
use crate::view::{AgentIdView, AgentIds, Content, Encoding, PerformativeView, Text, UserDefined};
use crate::{Message, MessageView, Payload, Performative, Time, xml};

/// The positions of the parameters in an encoded message.
///
/// A [`MessageView`] borrows the bytes of its message. An index does not, so a value can own it
/// together with the message. The bytes are checked once, when the index is made, and
/// [`view`](Self::view) does not check them again. Neither allocates.
///
/// The methods take the payload that the index was made of. With another payload they return
/// arbitrary parts of it.
#[derive(Debug, Clone)]
pub struct MessageIndex {
    performative: Act,
    sender: Option<AgentAt>,
    receivers: SetAt,
    reply_to: SetAt,
    content: Option<ContentAt>,
    language: Option<TextAt>,
    encoding: Option<TextAt>,
    ontology: Option<TextAt>,
    protocol: Option<TextAt>,
    conversation_id: Option<TextAt>,
    reply_with: Option<TextAt>,
    in_reply_to: Option<TextAt>,
    reply_by: Option<Time>,
    user_defined: UserDefinedAt,
    is_base64: bool,
}

impl MessageIndex {
    /// Reads a message, as [`MessageView::parse_payload`] does.
    ///
    /// # Errors
    /// See [`MessageView::parse_payload`].
    pub fn of(payload: &Payload) -> Result<Self, DecodeError> {
        let view = MessageView::parse_payload(payload)?;
        let bytes = Pieces::of(payload);
        let text = |text: Option<Text<'_>>| text.map(|text| bytes.text_at(text));
        Ok(Self {
            performative: match view.performative {
                PerformativeView::Standard(code) => Act::Standard(code),
                PerformativeView::Other(name) => Act::Other(bytes.text_at(name)),
            },
            sender: view.sender.map(|agent| bytes.agent_at(agent)),
            receivers: bytes.set_at(&view.receivers),
            reply_to: bytes.set_at(&view.reply_to),
            content: view.content.map(|content| bytes.content_at(content)),
            language: text(view.language),
            encoding: text(view.encoding),
            ontology: text(view.ontology),
            protocol: text(view.protocol),
            conversation_id: text(view.conversation_id),
            reply_with: text(view.reply_with),
            in_reply_to: text(view.in_reply_to),
            reply_by: view.reply_by,
            user_defined: match view.user_defined {
                UserDefined::None => UserDefinedAt::None,
                UserDefined::BitEfficient([before, behind]) => {
                    UserDefinedAt::BitEfficient([bytes.span(before), bytes.span(behind)])
                }
                UserDefined::String(rest) => UserDefinedAt::String(bytes.span(rest)),
                UserDefined::Xml(inside) => UserDefinedAt::Xml(bytes.span(inside)),
            },
            is_base64: view.is_base64,
        })
    }

    /// Returns the view of the message.
    #[must_use]
    pub fn view<'a>(&self, payload: &'a Payload) -> MessageView<'a> {
        let bytes = Pieces::of(payload);
        let text = |text: Option<TextAt>| text.map(|text| bytes.text(text));
        MessageView {
            performative: match self.performative {
                Act::Standard(code) => PerformativeView::Standard(code),
                Act::Other(name) => PerformativeView::Other(bytes.text(name)),
            },
            sender: self.sender.map(|agent| bytes.agent(agent)),
            receivers: bytes.set(&self.receivers),
            reply_to: bytes.set(&self.reply_to),
            content: self.content.map(|content| bytes.content(content)),
            language: text(self.language),
            encoding: text(self.encoding),
            ontology: text(self.ontology),
            protocol: text(self.protocol),
            conversation_id: text(self.conversation_id),
            reply_with: text(self.reply_with),
            in_reply_to: text(self.in_reply_to),
            reply_by: self.reply_by,
            user_defined: match self.user_defined {
                UserDefinedAt::None => UserDefined::None,
                UserDefinedAt::BitEfficient([before, behind]) => {
                    UserDefined::BitEfficient([bytes.get(before), bytes.get(behind)])
                }
                UserDefinedAt::String(rest) => UserDefined::String(bytes.get(rest)),
                UserDefinedAt::Xml(inside) => UserDefined::Xml(bytes.get(inside)),
            },
            is_base64: self.is_base64,
        }
    }

    /// Returns the owned message, equal to that of [`Message::decode`].
    #[must_use]
    pub fn to_message(&self, payload: &Payload) -> Message {
        self.view(payload).to_checked_message(payload)
    }

    /// Returns the content. It shares the memory of the payload unless it must be unescaped.
    #[must_use]
    pub fn content(&self, payload: &Payload) -> Option<Bytes> {
        // The other parameters of a view are not needed.
        let content = Pieces::of(payload).content(self.content?);
        let content = match self.is_base64 {
            true => content.of_base64(),
            false => content.bytes(),
        };
        Some(super::shared(payload, content))
    }

    /// Whether the message has this communicative act of the standard (FIPA00037).
    #[must_use]
    pub fn is(&self, performative: &Performative) -> bool {
        matches!(self.performative, Act::Standard(code) if performative.code() == Some(code))
    }

    /// Returns the conversation identifier.
    #[must_use]
    pub fn conversation_id<'a>(&self, payload: &'a Payload) -> Option<Text<'a>> {
        Some(Pieces::of(payload).text(self.conversation_id?))
    }

    /// Returns the protocol.
    #[must_use]
    pub fn protocol<'a>(&self, payload: &'a Payload) -> Option<Text<'a>> {
        Some(Pieces::of(payload).text(self.protocol?))
    }

    /// Returns the ontology.
    #[must_use]
    pub fn ontology<'a>(&self, payload: &'a Payload) -> Option<Text<'a>> {
        Some(Pieces::of(payload).text(self.ontology?))
    }
}

/// A range of the head and the tail of a payload, taken together.
#[derive(Debug, Clone, Copy, Default)]
struct Span {
    start: usize,
    end: usize,
}

#[derive(Debug, Clone, Copy)]
enum Act {
    Standard(u8),
    Other(TextAt),
}

/// The position of a [`Text`].
#[derive(Debug, Clone, Copy)]
enum TextAt {
    Plain(Span),
    String(Span),
    Quoted(Span),
    Encoded(Span),
    Xml(Span, xml::Whitespace),
}

/// The position of an [`AgentIdView`].
#[derive(Debug, Clone, Copy)]
struct AgentAt {
    name: TextAt,
    encoding: Encoding,
    /// The parts behind the name; `None` for a bit-efficient identifier without parts.
    parts: Option<Span>,
}

/// The position of [`AgentIds`].
#[derive(Debug, Clone)]
enum SetAt {
    Empty,
    BitEfficient(Span),
    Envelope(Span),
    String(Span),
    /// Boxed, because the other encodings are shorter and far more frequent.
    Xml(Box<(Span, xml::AgentSet<'static>)>),
}

/// The position of a [`Content`].
#[derive(Debug, Clone, Copy)]
enum ContentAt {
    Bytes(Span),
    Beside,
    String(Span),
    Quoted(Span),
    Expression(TextAt),
    Xml(Span),
}

/// The position of [`UserDefined`].
#[derive(Debug, Clone, Copy)]
enum UserDefinedAt {
    None,
    BitEfficient([Span; 2]),
    String(Span),
    Xml(Span),
}

/// The bytes of a payload.
#[derive(Clone, Copy)]
struct Pieces<'a> {
    head: &'a [u8],
    content: &'a [u8],
    tail: &'a [u8],
}

/// The bytes behind the name of a bit-efficient identifier without parts. The reader returns these
/// constant bytes instead of a part of the message.
const NO_PARTS: &[u8] = &[code::END];

impl<'a> Pieces<'a> {
    fn of(payload: &'a Payload) -> Self {
        Self {
            head: &payload.head,
            content: &payload.content,
            tail: &payload.tail,
        }
    }

    fn locate(&self, part: &[u8]) -> Option<Span> {
        let within = |whole: &[u8], base: usize| {
            let start = part.as_ptr().addr().checked_sub(whole.as_ptr().addr())?;
            let end = start.checked_add(part.len())?;
            (end <= whole.len()).then(|| Span {
                start: base + start,
                end: base + end,
            })
        };
        within(self.head, 0).or_else(|| within(self.tail, self.head.len()))
    }

    fn span(&self, part: &[u8]) -> Span {
        let span = self.locate(part);
        debug_assert!(span.is_some() || part.is_empty(), "a part of the message");
        span.unwrap_or_default()
    }

    fn get(&self, Span { start, end }: Span) -> &'a [u8] {
        let head = self.head.len();
        let part = match end <= head {
            true => self.head.get(start..end),
            false => start
                .checked_sub(head)
                .and_then(|start| self.tail.get(start..end - head)),
        };
        part.unwrap_or_default()
    }

    fn text_at(&self, text: Text<'_>) -> TextAt {
        match text.0 {
            Repr::Plain(bytes) => TextAt::Plain(self.span(bytes)),
            Repr::String(bytes) => TextAt::String(self.span(bytes)),
            Repr::Quoted(bytes) => TextAt::Quoted(self.span(bytes)),
            Repr::Encoded(bytes) => TextAt::Encoded(self.span(bytes)),
            Repr::Xml(bytes, space) => TextAt::Xml(self.span(bytes), space),
        }
    }

    fn text(&self, at: TextAt) -> Text<'a> {
        Text(match at {
            TextAt::Plain(span) => Repr::Plain(self.get(span)),
            TextAt::String(span) => Repr::String(self.get(span)),
            TextAt::Quoted(span) => Repr::Quoted(self.get(span)),
            TextAt::Encoded(span) => Repr::Encoded(self.get(span)),
            TextAt::Xml(span, space) => Repr::Xml(self.get(span), space),
        })
    }

    fn agent_at(&self, agent: AgentIdView<'_>) -> AgentAt {
        let (encoding, parts) = agent.encoded_parts();
        AgentAt {
            name: self.text_at(agent.name()),
            encoding,
            parts: self.locate(parts).or_else(|| {
                debug_assert!(parts == NO_PARTS || parts.is_empty());
                (parts != NO_PARTS).then(Span::default)
            }),
        }
    }

    fn agent(&self, at: AgentAt) -> AgentIdView<'a> {
        let parts = at.parts.map_or(NO_PARTS, |span| self.get(span));
        AgentIdView::new(self.text(at.name), at.encoding, parts)
    }

    fn set_at(&self, agents: &AgentIds<'_>) -> SetAt {
        match &agents.0 {
            Set::Empty => SetAt::Empty,
            Set::BitEfficient(rest) => SetAt::BitEfficient(self.span(rest)),
            Set::Envelope(rest) => SetAt::Envelope(self.span(rest)),
            Set::String(rest) => SetAt::String(self.span(rest)),
            Set::Xml(set) => {
                let (bytes, set) = set.take_bytes();
                SetAt::Xml(Box::new((self.span(bytes), set)))
            }
        }
    }

    fn set(&self, at: &SetAt) -> AgentIds<'a> {
        AgentIds(match at {
            SetAt::Empty => Set::Empty,
            SetAt::BitEfficient(span) => Set::BitEfficient(self.get(*span)),
            SetAt::Envelope(span) => Set::Envelope(self.get(*span)),
            SetAt::String(span) => Set::String(self.get(*span)),
            SetAt::Xml(at) => Set::Xml(at.1.with_bytes(self.get(at.0))),
        })
    }

    fn content_at(&self, content: Content<'_>) -> ContentAt {
        match content {
            Content::Bytes(bytes) => ContentAt::Bytes(self.span(bytes)),
            Content::Beside(_) => ContentAt::Beside,
            Content::String(bytes) => ContentAt::String(self.span(bytes)),
            Content::Quoted(bytes) => ContentAt::Quoted(self.span(bytes)),
            Content::Expression(text) => ContentAt::Expression(self.text_at(text)),
            Content::Xml(bytes) => ContentAt::Xml(self.span(bytes)),
        }
    }

    fn content(&self, at: ContentAt) -> Content<'a> {
        match at {
            ContentAt::Bytes(span) => Content::Bytes(self.get(span)),
            ContentAt::Beside => Content::Beside(self.content),
            ContentAt::String(span) => Content::String(self.get(span)),
            ContentAt::Quoted(span) => Content::Quoted(self.get(span)),
            ContentAt::Expression(text) => Content::Expression(self.text(text)),
            ContentAt::Xml(span) => Content::Xml(self.get(span)),
        }
    }
}
