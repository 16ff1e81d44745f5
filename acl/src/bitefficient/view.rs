//! Reading a bit-efficient message.

use crate::bitefficient::agent_id::{agent_id, agent_ids, token, user_defined};
use crate::bitefficient::expression::expression;
use crate::bitefficient::notes::{self, Notes, Silent};
use crate::bitefficient::reader::{Form, Reader, string_form};
use crate::error::{DecodeError, Problem};
use crate::view::{AgentIdView, Content, PerformativeView, UserDefined};
use crate::word::is_word;
use crate::{AgentId, Message, MessageView, Payload, Performative, Representation, Text};

/// The name that fipa_services writes for a sender that is not set.
pub(super) const UNDEFINED_AGENT: &str = "agent_id:undefined";

/// Reads a message that lies in one piece.
///
/// # Errors
/// When the bytes are not one whole message in this encoding.
pub(crate) fn view(bytes: &[u8]) -> Result<MessageView<'_>, DecodeError> {
    Parser::new(Reader::new(bytes), None)?.message()
}

/// Reads a message that is split around its content, which is not touched then.
///
/// # Errors
/// When the pieces are not one whole message in this encoding.
pub(crate) fn view_split(payload: &Payload) -> Result<MessageView<'_>, DecodeError> {
    let pieces = Pieces {
        content: &payload.content,
        tail: &payload.tail,
    };
    Parser::new(Reader::new(&payload.head), Some(pieces))?.message()
}

/// Reads what lies in one piece, and tells `notes` what every byte of it means.
///
/// # Errors
/// Like [`view`].
pub(crate) fn view_noting(
    bytes: &[u8],
    base: usize,
    notes: impl Notes,
) -> Result<MessageView<'_>, DecodeError> {
    Parser::new(Reader::noting(bytes, base, notes), None)?.message()
}

/// The next user-defined parameter among those of a checked message.
pub(crate) fn next_user_defined<'a>(pieces: &mut [&'a [u8]; 2]) -> Option<Pair<'a>> {
    // What is passed over on the way is read into this.
    let mut passed = MessageView::empty(PerformativeView::Standard(0));
    for piece in pieces {
        let mut reader = Reader::new(piece);
        while reader.remaining() > 0 {
            // An error cannot occur in checked bytes, and would end this.
            let mut pair = None;
            passed.step(&mut reader, &mut pair).ok()?;
            *piece = reader.rest();
            if pair.is_some() {
                return pair;
            }
        }
    }
    None
}

const CLAUSE: &str = "FIPA00069 2.1 Message";

/// What was read of a message.
#[derive(PartialEq, Eq)]
enum Step {
    /// A parameter that is in the view now, or beside it.
    Parameter,
    End,
}

/// Name and value of a user-defined parameter.
type Pair<'a> = (Text<'a>, Text<'a>);

impl<'a> MessageView<'a> {
    /// Reads one parameter. What is user-defined is given, not kept.
    #[inline(always)]
    fn step<N: Notes>(
        &mut self,
        reader: &mut Reader<'a, N>,
        pair: &mut Option<Pair<'a>>,
    ) -> Result<Step, DecodeError> {
        let code = reader.byte(CLAUSE, "a message")?;
        let (text, what) = match code {
            0x05 => (&mut self.reply_with, "reply-with"),
            0x07 => (&mut self.in_reply_to, "in-reply-to"),
            0x09 => (&mut self.language, "language"),
            0x0a => (&mut self.encoding, "encoding"),
            0x0b => (&mut self.ontology, "ontology"),
            0x0d => (&mut self.conversation_id, "conversation-id"),
            0x00 => {
                *pair = Some(user_defined(reader)?);
                return Ok(Step::Parameter);
            }
            0x01 => {
                reader.note(|| "end of message".to_owned());
                return Ok(Step::End);
            }
            0x02 => {
                let sender = sender(reader)?;
                let is_defined = sender.name().raw() != UNDEFINED_AGENT.as_bytes();
                self.sender = is_defined.then_some(sender);
                return Ok(Step::Parameter);
            }
            0x03 => {
                self.receivers = agent_ids(reader, "receivers")?;
                return Ok(Step::Parameter);
            }
            0x04 => {
                if let Some(Content::Beside(_)) = self.content {
                    let problem = Problem::Split("there is more content behind the content");
                    return Err(reader.error(CLAUSE, problem));
                }
                self.content = Some(content(reader)?);
                return Ok(Step::Parameter);
            }
            0x06 => {
                let time = reader.date_time("FIPA00069 2.3 BinDateTime")?;
                reader.note(|| notes::date("reply-by:", time));
                self.reply_by = Some(time);
                return Ok(Step::Parameter);
            }
            0x08 => {
                self.reply_to = agent_ids(reader, "reply-to")?;
                return Ok(Step::Parameter);
            }
            0x0c => {
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
    const CLAUSE: &str = "FIPA00069 2.1 BinString";
    let len = match reader.peek() {
        Some(0x14) => return string_content(reader),
        Some(0x16..=0x19) => content_len(reader)?,
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
    const CLAUSE: &str = "FIPA00069 2.1 BinString";
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
    #[inline(always)]
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
            let (name, _) = token(&mut reader, "performative")?;
            if !is_word(name.raw()) {
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
