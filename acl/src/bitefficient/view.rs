//! A bit-efficient message, checked once and borrowed.

use std::borrow::Cow;

use crate::bitefficient::agent_id::{
    AgentIdView, AgentIds, agent_id, agent_ids, user_defined, word,
};
use crate::bitefficient::notes::{self, Notes, Silent};
use crate::bitefficient::reader::{Form, Reader, string_form};
use crate::bitefficient::text::{Text, expression, string_content};
use crate::error::{DecodeError, Problem};
use crate::word::{is_token, is_word};
use crate::{AgentId, Message, Payload, Performative, Representation, Time};

/// The name that fipa_services writes for a sender that is not set.
pub(super) const UNDEFINED_AGENT: &str = "agent_id:undefined";

/// An encoded message (FIPA00069), read without allocating.
///
/// The bytes are checked once, when the view is made; everything else hands out what lies in them.
/// The reader is lenient: it takes what the standard says and what fipa_services and JADE write.
/// Of a parameter that is there several times the last one counts, but for user-defined ones.
#[derive(Debug, Clone)]
pub struct MessageView<'a> {
    performative: PerformativeView<'a>,
    sender: Option<AgentIdView<'a>>,
    receivers: AgentIds<'a>,
    reply_to: AgentIds<'a>,
    content: Option<ContentView<'a>>,
    language: Option<Text<'a>>,
    encoding: Option<Text<'a>>,
    ontology: Option<Text<'a>>,
    protocol: Option<&'a str>,
    conversation_id: Option<Text<'a>>,
    reply_with: Option<Text<'a>>,
    in_reply_to: Option<Text<'a>>,
    reply_by: Option<Time>,
    /// Of a split message, the parameters in front of the content; and all others.
    parameters: [&'a [u8]; 2],
    has_user_defined: bool,
}

#[derive(Debug, Clone, Copy)]
enum PerformativeView<'a> {
    /// The code of one of the standard.
    Standard(u8),
    Other(&'a str),
}

#[derive(Debug, Clone, Copy)]
pub(super) enum ContentView<'a> {
    /// Behind a length: the bytes as they are.
    Bytes(&'a [u8]),
    /// The same, beside the message: see [`Payload`].
    Beside(&'a [u8]),
    /// Up to a NUL: perhaps in quotation marks, perhaps with a byte count.
    String(&'a [u8]),
    /// An expression, from peers of before the edition of November 2002.
    Expression(Text<'a>),
}

impl<'a> MessageView<'a> {
    /// Reads a message that lies in one piece.
    ///
    /// # Errors
    /// When the bytes are not one whole message in the bit-efficient encoding.
    pub fn parse(bytes: &'a [u8]) -> Result<Self, DecodeError> {
        Parser::new(Reader::new(bytes), None)?.message()
    }

    /// Reads a message that may be split around its content, which is not touched then.
    ///
    /// # Errors
    /// When the pieces are not one whole message in the bit-efficient encoding. A split one must
    /// be split just where its content is: `head` ends with the length of `content`.
    pub fn parse_payload(payload: &'a Payload) -> Result<Self, DecodeError> {
        let split = payload.is_split().then_some(Pieces {
            content: &payload.content,
            tail: &payload.tail,
        });
        Parser::new(Reader::new(&payload.head), split)?.message()
    }

    /// Reads what lies in one piece, and tells `notes` what every byte of it means.
    pub(crate) fn parse_noting(
        bytes: &'a [u8],
        base: usize,
        notes: impl Notes,
    ) -> Result<Self, DecodeError> {
        Parser::new(Reader::noting(bytes, base, notes), None)?.message()
    }

    /// What the message does; allocates for a user-defined act.
    #[must_use]
    pub fn performative(&self) -> Performative {
        // Checked when the message was read: there is such an act, or the name is a word.
        match self.performative {
            PerformativeView::Standard(code) => Performative::of_code(code),
            PerformativeView::Other(name) => name.parse().ok(),
        }
        .unwrap_or(Performative::NotUnderstood)
    }

    /// The name of what the message does.
    #[must_use]
    pub fn performative_name(&self) -> &'a str {
        match self.performative {
            PerformativeView::Standard(code) => Performative::name_of_code(code),
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

    /// What it says: a slice of the encoded message, unless it was written with escapes or as an
    /// expression.
    #[must_use]
    pub fn content(&self) -> Option<Cow<'a, [u8]>> {
        Some(match self.content? {
            ContentView::Bytes(bytes) | ContentView::Beside(bytes) => Cow::Borrowed(bytes),
            ContentView::String(bytes) => string_content(bytes),
            ContentView::Expression(text) => match text.as_str() {
                Cow::Borrowed(text) => Cow::Borrowed(text.as_bytes()),
                Cow::Owned(text) => Cow::Owned(text.into_bytes()),
            },
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
    pub fn protocol(&self) -> Option<&'a str> {
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

    /// The latest time for the next message of the conversation.
    #[must_use]
    pub fn reply_by(&self) -> Option<Time> {
        self.reply_by
    }

    /// User-defined parameters in the order of the message, names without `X-`.
    pub fn user_defined(&self) -> impl Iterator<Item = (&'a str, Text<'a>)> + use<'a> {
        let walked = if self.has_user_defined {
            self.parameters
        } else {
            [&[][..]; 2]
        };
        walked.into_iter().flat_map(|parameters| {
            let mut reader = Reader::new(parameters);
            std::iter::from_fn(move || {
                // Checked when the message was read: an error cannot occur, and would end this.
                let mut passed = MessageView::empty(PerformativeView::Other(""));
                while reader.remaining() > 0 {
                    if let Step::UserDefined(name, value) = passed.step(&mut reader).ok()? {
                        return Some((name, value));
                    }
                }
                None
            })
        })
    }

    pub(super) fn content_view(&self) -> Option<ContentView<'a>> {
        self.content
    }
}

const CLAUSE: &str = "FIPA00069 2.1 Message";

/// What was read of a message.
enum Step<'a> {
    /// A parameter that is in the view now.
    Parameter,
    UserDefined(&'a str, Text<'a>),
    End,
}

impl<'a> MessageView<'a> {
    fn empty(performative: PerformativeView<'a>) -> Self {
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
            parameters: [&[]; 2],
            has_user_defined: false,
        }
    }

    /// Reads one parameter.
    #[inline]
    fn step<N: Notes>(&mut self, reader: &mut Reader<'a, N>) -> Result<Step<'a>, DecodeError> {
        let code = reader.byte(CLAUSE, "a message")?;
        let (text, what) = match code {
            0x05 => (&mut self.reply_with, "reply-with"),
            0x07 => (&mut self.in_reply_to, "in-reply-to"),
            0x09 => (&mut self.language, "language"),
            0x0a => (&mut self.encoding, "encoding"),
            0x0b => (&mut self.ontology, "ontology"),
            0x0d => (&mut self.conversation_id, "conversation-id"),
            _ => return self.other_step(code, reader),
        };
        *text = Some(self::text(reader, what)?);
        Ok(Step::Parameter)
    }

    #[inline]
    fn other_step<N: Notes>(
        &mut self,
        code: u8,
        reader: &mut Reader<'a, N>,
    ) -> Result<Step<'a>, DecodeError> {
        match code {
            0x00 => {
                let (name, value) = user_defined(reader)?;
                return Ok(Step::UserDefined(name, value));
            }
            0x01 => {
                reader.note(|| "end of message".to_owned());
                return Ok(Step::End);
            }
            0x02 => {
                let sender = sender(reader)?;
                self.sender = (sender.name() != UNDEFINED_AGENT).then_some(sender);
            }
            0x03 => {
                let ids = agent_ids(reader, AgentId::MAX_DEPTH, "receivers")?;
                self.receivers = AgentIds::new(ids);
            }
            0x04 => {
                if let Some(ContentView::Beside(_)) = self.content {
                    let problem = Problem::Split("there is more content behind the content");
                    return Err(reader.error(CLAUSE, problem));
                }
                self.content = Some(content(reader)?);
            }
            0x06 => {
                let time = reader.date_time("FIPA00069 2.3 BinDateTime")?;
                reader.note(|| notes::date("reply-by:", time));
                self.reply_by = Some(time);
            }
            0x08 => {
                let ids = agent_ids(reader, AgentId::MAX_DEPTH, "reply-to")?;
                self.reply_to = AgentIds::new(ids);
            }
            0x0c => self.protocol = Some(protocol(reader)?),
            other => return Err(reader.unexpected(CLAUSE, other, "a parameter of a message")),
        }
        Ok(Step::Parameter)
    }
}

fn sender<'a, N: Notes>(reader: &mut Reader<'a, N>) -> Result<AgentIdView<'a>, DecodeError> {
    reader.note(|| "sender".to_owned());
    reader.notes().deeper();
    let sender = agent_id(reader, AgentId::MAX_DEPTH)?;
    reader.notes().shallower();
    Ok(sender)
}

#[inline(always)]
fn text<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
    what: &'static str,
) -> Result<Text<'a>, DecodeError> {
    let text = expression(reader, what)?;
    reader.note(|| notes::named(what, &text));
    Ok(text)
}

fn protocol<'a, N: Notes>(reader: &mut Reader<'a, N>) -> Result<&'a str, DecodeError> {
    let offset = reader.offset();
    let name = word(reader, "protocol")?;
    if is_token(name) {
        reader.note(|| format!("protocol: {}", notes::quoted(name)));
        return Ok(name);
    }
    let problem = Problem::NotAWord("protocol");
    Err(DecodeError::new(offset, "FIPA00070 Word", problem))
}

fn content<'a, N: Notes>(reader: &mut Reader<'a, N>) -> Result<ContentView<'a>, DecodeError> {
    const CLAUSE: &str = "FIPA00069 2.1 BinString";
    let len = match reader.peek() {
        Some(0x14) => {
            reader.skip_peeked();
            let bytes = reader.until_nul(CLAUSE, "content")?;
            if bytes.len() as u64 > Message::MAX_CONTENT {
                return Err(reader.error(CLAUSE, Problem::TooLong("content")));
            }
            reader.note(|| string_noted(bytes));
            return Ok(ContentView::String(bytes));
        }
        Some(0x16..=0x19) => content_len(reader)?,
        _ => return Ok(ContentView::Expression(text(reader, "content")?)),
    };
    let bytes = reader.bytes(len, CLAUSE, "content")?;
    reader.notes().deeper();
    reader.note(|| notes::content(bytes));
    reader.notes().shallower();
    Ok(ContentView::Bytes(bytes))
}

/// Reads code and length of content that is given with its length.
fn content_len<N: Notes>(reader: &mut Reader<'_, N>) -> Result<usize, DecodeError> {
    const CLAUSE: &str = "FIPA00069 2.1 BinString";
    let (len, code) = match reader.byte(CLAUSE, "content")? {
        0x16 => (reader.u8_len(CLAUSE)?, "Len8"),
        0x17 => (reader.u16_len(CLAUSE)?, "Len16"),
        0x19 => (reader.u32_len(CLAUSE)?, "Len32"),
        0x18 => return Err(reader.error(CLAUSE, Problem::CodeTable)),
        other => return Err(reader.unexpected(CLAUSE, other, "content with its length")),
    };
    reader.note(|| format!("content, {len} bytes ({code})"));
    Ok(len)
}

/// Describes content that was read up to a NUL.
fn string_noted(bytes: &[u8]) -> String {
    let (form, inner) = string_form(bytes);
    let written = match form {
        Form::Quoted => ", a string in quotation marks",
        Form::Counted => ", a string with its length in front",
        Form::Bare => ", a string",
    };
    let (len, content) = (inner.len(), notes::content(inner));
    format!("content, {len} bytes{written}: {content}")
}

/// What comes behind the head of a split message.
#[derive(Clone, Copy)]
struct Pieces<'a> {
    content: &'a [u8],
    tail: &'a [u8],
}

struct Parser<'a, N = Silent> {
    reader: Reader<'a, N>,
    /// The rest of a split message, until its content was met.
    split: Option<Pieces<'a>>,
    performative: PerformativeView<'a>,
}

impl<'a, N: Notes> Parser<'a, N> {
    /// Reads what comes before the parameters.
    fn new(mut reader: Reader<'a, N>, split: Option<Pieces<'a>>) -> Result<Self, DecodeError> {
        let start = reader.ahead();
        match reader.byte(CLAUSE, "a message")? {
            0xfa => {}
            0xfb | 0xfc => return Err(start.error(CLAUSE, Problem::CodeTable)),
            _ => return Err(not_bit_efficient(&start)),
        }
        reader.note(|| "message, bit-efficient, without code tables".to_owned());
        // Peers write other versions than 1.0 and mean the same.
        let version = reader.byte(CLAUSE, "the version")?;
        reader.note(|| match version {
            0x10 => "version 1.0".to_owned(),
            other => format!("version {}.{}, taken for 1.0", other >> 4, other & 0x0f),
        });
        let offset = reader.offset();
        let wrong = |clause, problem| DecodeError::new(offset, clause, problem);
        let code = reader.byte(CLAUSE, "the performative")?;
        let performative = if code == 0 {
            let name = word(&mut reader, "performative")?;
            if !is_word(name) {
                let problem = Problem::NotAWord("performative");
                return Err(wrong("FIPA00070 Word", problem));
            }
            PerformativeView::Other(name)
        } else {
            if Performative::name_of_code(code).is_empty() {
                let found = code;
                let expected = "the code of a performative";
                return Err(wrong(CLAUSE, Problem::Unexpected { found, expected }));
            }
            PerformativeView::Standard(code)
        };
        reader.note(|| match performative {
            PerformativeView::Standard(code) => {
                format!("performative: {}", Performative::name_of_code(code))
            }
            PerformativeView::Other(name) => {
                format!("performative: {}, user-defined", notes::plain(name))
            }
        });
        Ok(Self {
            reader,
            split,
            performative,
        })
    }

    #[inline]
    fn message(mut self) -> Result<MessageView<'a>, DecodeError> {
        let mut view = MessageView::empty(self.performative);
        let mut start = self.reader.position();
        loop {
            if self.split.is_some() {
                let in_front = self.reader.since(start);
                if let Some(content) = self.content_beside()? {
                    view.parameters[0] = in_front;
                    view.content = Some(ContentView::Beside(content));
                    start = self.reader.position();
                }
            }
            match view.step(&mut self.reader)? {
                Step::Parameter => {}
                Step::UserDefined(..) => view.has_user_defined = true,
                Step::End => break,
            }
        }
        view.parameters[1] = self.reader.since(start);
        self.end()?;
        Ok(view)
    }

    /// Of a split message, the content if it is next. Reading goes on behind it then.
    #[inline]
    fn content_beside(&mut self) -> Result<Option<&'a [u8]>, DecodeError> {
        const CLAUSE: &str = "FIPA00069 2.1 BinString";
        let Some(Pieces { content, tail }) = self.split else {
            return Ok(None);
        };
        // Code of the parameter, code and length of the string, and nothing more.
        if self.reader.peek() != Some(0x04) || self.reader.remaining() > 6 {
            return Ok(None);
        }
        let mut ahead = self.reader.ahead();
        ahead.skip_peeked();
        let len = content_len(&mut ahead)?;
        if ahead.remaining() > 0 {
            return Ok(None);
        }
        if len != content.len() {
            let problem = Problem::Split("the length of the content differs");
            return Err(self.reader.error(CLAUSE, problem));
        }
        self.reader.go_on(tail, ahead.offset().saturating_add(len));
        self.split = None;
        Ok(Some(content))
    }

    fn end(&self) -> Result<(), DecodeError> {
        let rest = self.reader.remaining();
        if rest > 0 {
            return Err(self.reader.error(CLAUSE, Problem::Trailing(rest)));
        }
        if self.split.is_some() {
            let problem = Problem::Split("the head is a whole message already");
            return Err(self.reader.error(CLAUSE, problem));
        }
        Ok(())
    }
}

#[cold]
fn not_bit_efficient(start: &Reader<'_>) -> DecodeError {
    let problem = match Representation::detect(start.rest()) {
        Some(other @ (Representation::String | Representation::Xml)) => {
            Problem::UnsupportedRepresentation(other)
        }
        _ => Problem::UnknownRepresentation,
    };
    start.error(CLAUSE, problem)
}
