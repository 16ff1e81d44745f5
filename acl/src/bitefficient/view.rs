//! Reading a bit-efficient message.

use crate::bitefficient::agent_id::{agent_id, agent_ids, token, user_defined};
use crate::bitefficient::code;
use crate::bitefficient::expression::expression;
use crate::bitefficient::notes::{self, NoNotes, Notes};
use crate::bitefficient::reader::{Form, Reader, string_form};
use crate::error::{DecodeError, Problem};
use crate::view::{AgentIdView, Content, PerformativeView, UserDefined};
use crate::word::is_word;
use crate::{AgentId, Message, MessageView, Payload, Performative, Representation, Text};

/// The name that fipa_services writes if a message has no sender.
pub(super) const UNDEFINED_AGENT: &str = "agent_id:undefined";

/// Reads a message in one piece.
///
/// # Errors
/// The bytes are not one whole message in this encoding.
pub(crate) fn view(bytes: &[u8]) -> Result<MessageView<'_>, DecodeError> {
    Parser::new(Reader::new(bytes), None)?.message()
}

/// Reads a message that is split around its content. The content is not accessed.
///
/// # Errors
/// The pieces are not one whole message in this encoding.
pub(crate) fn view_split(payload: &Payload) -> Result<MessageView<'_>, DecodeError> {
    let pieces = Pieces {
        content: &payload.content,
        tail: &payload.tail,
    };
    Parser::new(Reader::new(&payload.head), Some(pieces))?.message()
}

/// Reads a message in one piece and notes the meaning of every byte.
///
/// # Errors
/// The errors of [`view`].
pub(crate) fn view_noting(
    bytes: &[u8],
    base: usize,
    notes: impl Notes,
) -> Result<MessageView<'_>, DecodeError> {
    Parser::new(Reader::noting(bytes, base, notes), None)?.message()
}

/// Reads the next user-defined parameter of a checked message.
pub(crate) fn next_user_defined<'a>(pieces: &mut [&'a [u8]; 2]) -> Option<Pair<'a>> {
    // Receives the other parameters, which are skipped.
    let mut skipped = MessageView::empty(PerformativeView::Standard(0));
    for piece in pieces {
        let mut reader = Reader::new(piece);
        while reader.remaining() > 0 {
            // An error cannot occur in checked bytes. It would end the iteration.
            let mut pair = None;
            skipped.step(&mut reader, &mut pair).ok()?;
            *piece = reader.rest();
            if pair.is_some() {
                return pair;
            }
        }
    }
    None
}

const CLAUSE: &str = "FIPA00069 2.2 Message";

/// The item that was read.
#[derive(PartialEq, Eq)]
enum Step {
    /// A parameter, which was stored in the view or, if user-defined, given to the caller.
    Parameter,
    End,
}

/// Name and value of a user-defined parameter.
type Pair<'a> = (Text<'a>, Text<'a>);

impl<'a> MessageView<'a> {
    /// Reads one parameter. A user-defined one is written to `pair` and not stored.
    #[inline(always)]
    fn step<N: Notes>(
        &mut self,
        reader: &mut Reader<'a, N>,
        pair: &mut Option<Pair<'a>>,
    ) -> Result<Step, DecodeError> {
        let (text, what) = match reader.byte(CLAUSE, "a message")? {
            code::message::REPLY_WITH => (&mut self.reply_with, "reply-with"),
            code::message::IN_REPLY_TO => (&mut self.in_reply_to, "in-reply-to"),
            code::message::LANGUAGE => (&mut self.language, "language"),
            code::message::ENCODING => (&mut self.encoding, "encoding"),
            code::message::ONTOLOGY => (&mut self.ontology, "ontology"),
            code::message::CONVERSATION_ID => (&mut self.conversation_id, "conversation-id"),
            code::message::USER_DEFINED => {
                *pair = Some(user_defined(reader)?);
                return Ok(Step::Parameter);
            }
            code::END => {
                reader.note(|| "end of message".to_owned());
                return Ok(Step::End);
            }
            code::message::SENDER => {
                let sender = sender(reader)?;
                let is_defined = sender.name().raw() != UNDEFINED_AGENT.as_bytes();
                self.sender = is_defined.then_some(sender);
                return Ok(Step::Parameter);
            }
            code::message::RECEIVER => {
                self.receivers = agent_ids(reader, "receivers")?;
                return Ok(Step::Parameter);
            }
            code::message::CONTENT => {
                if let Some(Content::Beside(_)) = self.content {
                    let problem = Problem::Split("the tail has a second content parameter");
                    return Err(reader.error(CLAUSE, problem));
                }
                self.content = Some(content(reader)?);
                return Ok(Step::Parameter);
            }
            code::message::REPLY_BY => {
                let time = reader.date_time("FIPA00069 2.2 BinDateTimeToken")?;
                reader.note(|| notes::date("reply-by:", time));
                self.reply_by = Some(time);
                return Ok(Step::Parameter);
            }
            code::message::REPLY_TO => {
                self.reply_to = agent_ids(reader, "reply-to")?;
                return Ok(Step::Parameter);
            }
            code::message::PROTOCOL => {
                self.protocol = Some(protocol(reader)?);
                return Ok(Step::Parameter);
            }
            other => return Err(reader.unexpected(CLAUSE, other, "a parameter of a message")),
        };
        *text = Some(self::text(reader, what)?);
        Ok(Step::Parameter)
    }
}

#[inline(always)]
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

#[inline(always)]
fn protocol<'a, N: Notes>(reader: &mut Reader<'a, N>) -> Result<Text<'a>, DecodeError> {
    let offset = reader.offset();
    let (name, is_token) = token(reader, "protocol")?;
    if is_token {
        reader.note(|| format!("protocol: {}", notes::quoted(&name.as_str())));
        return Ok(name);
    }
    let problem = Problem::NotAWord("protocol");
    Err(DecodeError::new(offset, "FIPA00070 Word", problem))
}

#[inline(always)]
fn content<'a, N: Notes>(reader: &mut Reader<'a, N>) -> Result<Content<'a>, DecodeError> {
    const CLAUSE: &str = "FIPA00069 2.2 BinString";
    let len = match reader.peek() {
        Some(code::token::STRING) => return string_content(reader),
        Some(code::token::LEN8..=code::token::LEN32) => content_len(reader)?,
        _ => return expression_content(reader),
    };
    let bytes = reader.bytes(len, CLAUSE, "content")?;
    reader.notes().deeper();
    reader.note(|| notes::content(bytes));
    reader.notes().shallower();
    Ok(Content::Bytes(bytes))
}

#[inline(never)]
fn string_content<'a, N: Notes>(reader: &mut Reader<'a, N>) -> Result<Content<'a>, DecodeError> {
    const CLAUSE: &str = "FIPA00069 2.2 BinString";
    reader.skip_peeked();
    let bytes = reader.until_nul(CLAUSE, "content")?;
    if bytes.len() as u64 > Message::MAX_CONTENT {
        return Err(reader.error(CLAUSE, Problem::TooLong("content")));
    }
    reader.note(|| string_noted(bytes));
    Ok(Content::String(bytes))
}

#[inline(never)]
fn expression_content<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
) -> Result<Content<'a>, DecodeError> {
    Ok(Content::Expression(text(reader, "content")?))
}

/// Reads the code and the length of content with a length.
fn content_len<N: Notes>(reader: &mut Reader<'_, N>) -> Result<usize, DecodeError> {
    const CLAUSE: &str = "FIPA00069 2.2 BinString";
    let (len, size) = match reader.byte(CLAUSE, "content")? {
        code::token::LEN8 => (reader.u8_len(CLAUSE)?, "Len8"),
        code::token::LEN16 => (reader.u16_len(CLAUSE)?, "Len16"),
        code::token::LEN32 => (reader.u32_len(CLAUSE)?, "Len32"),
        code::token::LEN_INDEX => return Err(reader.error(CLAUSE, Problem::CodeTable)),
        other => return Err(reader.unexpected(CLAUSE, other, "content with its length")),
    };
    reader.note(|| format!("content, {len} bytes ({size})"));
    Ok(len)
}

/// Describes content that ends with a NUL.
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

/// The pieces behind the head of a split message.
#[derive(Clone, Copy)]
struct Pieces<'a> {
    content: &'a [u8],
    tail: &'a [u8],
}

struct Parser<'a, N = NoNotes> {
    reader: Reader<'a, N>,
    /// The other pieces of a split message, until the content is reached.
    split: Option<Pieces<'a>>,
    performative: PerformativeView<'a>,
}

impl<'a, N: Notes> Parser<'a, N> {
    /// Reads the identifier, the version and the performative.
    #[inline(always)]
    fn new(mut reader: Reader<'a, N>, split: Option<Pieces<'a>>) -> Result<Self, DecodeError> {
        let start = reader.ahead();
        match reader.byte(CLAUSE, "a message")? {
            code::message_id::PLAIN => {}
            code::message_id::TABLE_UPDATED | code::message_id::TABLE_UNCHANGED => {
                return Err(start.error(CLAUSE, Problem::CodeTable));
            }
            _ => return Err(not_bit_efficient(&start)),
        }
        reader.note(|| "message, bit-efficient, without code tables".to_owned());
        // Test messages of fipa_services have version 0.1 and the format of 1.0.
        let version = reader.byte(CLAUSE, "the version")?;
        reader.note(|| match version {
            code::VERSION_1_0 => "version 1.0".to_owned(),
            other => format!("version {}.{}, read as 1.0", other >> 4, other & 0x0f),
        });
        let offset = reader.offset();
        let wrong = |clause, problem| DecodeError::new(offset, clause, problem);
        let act = reader.byte(CLAUSE, "the performative")?;
        let performative = if act == code::USER_DEFINED_PERFORMATIVE {
            let (name, _) = token(&mut reader, "performative")?;
            if !is_word(name.raw()) {
                let problem = Problem::NotAWord("performative");
                return Err(wrong("FIPA00070 Word", problem));
            }
            PerformativeView::Other(name)
        } else {
            if Performative::name_of_code(act).is_empty() {
                let (found, expected) = (act, "the code of a performative");
                return Err(wrong(CLAUSE, Problem::Unexpected { found, expected }));
            }
            PerformativeView::Standard(act)
        };
        reader.note(|| match performative {
            PerformativeView::Standard(act) => {
                format!("performative: {}", Performative::name_of_code(act))
            }
            PerformativeView::Other(name) => {
                format!(
                    "performative: {}, user-defined",
                    notes::plain(&name.as_str())
                )
            }
        });
        Ok(Self {
            reader,
            split,
            performative,
        })
    }

    #[inline(always)]
    fn message(mut self) -> Result<MessageView<'a>, DecodeError> {
        let mut view = MessageView::empty(self.performative);
        let (mut before, mut start) = (&[][..], self.reader.position());
        let mut pair = None;
        loop {
            if self.split.is_some() {
                let in_front = self.reader.since(start);
                if let Some(content) = self.content_beside()? {
                    before = in_front;
                    view.content = Some(Content::Beside(content));
                    start = self.reader.position();
                }
            }
            if view.step(&mut self.reader, &mut pair)? == Step::End {
                break;
            }
        }
        if pair.is_some() {
            let pieces = [before, self.reader.since(start)];
            view.user_defined = UserDefined::BitEfficient(pieces);
        }
        self.end()?;
        Ok(view)
    }

    /// Returns the content of a split message if it is next. The reader then continues behind it.
    #[inline]
    fn content_beside(&mut self) -> Result<Option<&'a [u8]>, DecodeError> {
        const CLAUSE: &str = "FIPA00069 2.2 BinString";
        let Some(Pieces { content, tail }) = self.split else {
            return Ok(None);
        };
        // The head ends with the code of the parameter and the code and length of the string.
        if self.reader.peek() != Some(code::message::CONTENT) || self.reader.remaining() > 6 {
            return Ok(None);
        }
        let mut ahead = self.reader.ahead();
        ahead.skip_peeked();
        let len = content_len(&mut ahead)?;
        if ahead.remaining() > 0 {
            return Ok(None);
        }
        if len != content.len() {
            let problem = Problem::Split("the content has another length than the head announces");
            return Err(self.reader.error(CLAUSE, problem));
        }
        let base = ahead.offset().saturating_add(len);
        self.reader.continue_with(tail, base);
        self.split = None;
        Ok(Some(content))
    }

    fn end(&self) -> Result<(), DecodeError> {
        let rest = self.reader.remaining();
        if rest > 0 {
            return Err(self.reader.error(CLAUSE, Problem::Trailing(rest)));
        }
        if self.split.is_some() {
            let problem = Problem::Split("the head alone is a whole message");
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
