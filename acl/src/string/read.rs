//! The lenient reader of string messages.

use super::agent_id::{agent, agent_set};
use super::lex::{Follows, Keyword, Keywords, Lexer, unwrapped};
use crate::error::{DecodeError, Problem};
use crate::view::{Content, PerformativeView, UserDefined};
use crate::{AgentId, Message, MessageView, Text, Time};

/// Reads a string message.
///
/// # Errors
/// The bytes are not one whole string message.
pub(crate) fn view(bytes: &[u8]) -> Result<MessageView<'_>, DecodeError> {
    let mut lexer = Lexer::new(bytes);
    if lexer.rest().starts_with(BYTE_ORDER_MARK) {
        lexer.skip(BYTE_ORDER_MARK.len());
    }
    lexer.open(MESSAGE)?;
    lexer.skip_space();
    let mut view = MessageView::empty(performative(&mut lexer)?);
    let parameters = lexer.rest();
    // Offset of the content, for the error if it is not valid Base64.
    let mut content_offset = 0;
    while !lexer.accept(b')') {
        match view.parameter(&mut lexer, &mut None)? {
            Step::Parameter => {}
            Step::Content(offset) => content_offset = offset,
            Step::UserDefined => view.user_defined = UserDefined::String(parameters),
        }
    }
    lexer.skip_space();
    match lexer.rest().len() {
        0 => view.check_for_base64(content_offset, "JADE X-JADE-Encoding")?,
        behind => return Err(lexer.error(MESSAGE, Problem::Trailing(behind))),
    }
    Ok(view)
}

/// Reads the next user-defined parameter behind the performative of a checked message.
pub(crate) fn next_user_defined<'a>(rest: &mut &'a [u8]) -> Option<(Text<'a>, Text<'a>)> {
    // Receives the other parameters, which are skipped.
    let mut skipped = MessageView::empty(PerformativeView::Standard(0));
    let mut lexer = Lexer::new(rest);
    while !lexer.accept(b')') {
        // An error cannot occur in checked bytes. It would end the iteration.
        let mut pair = None;
        skipped.parameter(&mut lexer, &mut pair).ok()?;
        *rest = lexer.rest();
        if pair.is_some() {
            return pair;
        }
    }
    None
}

/// The item that was read.
enum Step {
    /// A parameter, which was stored in the view.
    Parameter,
    /// The content, which was stored in the view. The value is its offset.
    Content(usize),
    /// A user-defined parameter, which was not stored.
    UserDefined,
}

impl<'a> MessageView<'a> {
    /// Reads one parameter of a string message. A user-defined one is written to `pair` and not
    /// stored.
    #[inline]
    fn parameter(
        &mut self,
        lexer: &mut Lexer<'a>,
        pair: &mut Option<(Text<'a>, Text<'a>)>,
    ) -> Result<Step, DecodeError> {
        let keyword = lexer.keyword(
            PARAMETERS,
            Parameter::of,
            MESSAGE,
            "a parameter of a message",
        )?;
        let Keyword::Known(parameter) = keyword else {
            *pair = Some(user_defined(lexer)?);
            return Ok(Step::UserDefined);
        };
        // Without white space in front of the value, the next keyword ends it.
        let terminators = (!lexer.skip_space()).then_some(PARAMETERS);
        let (text, what) = match parameter {
            Parameter::ReplyWith => (&mut self.reply_with, "reply-with"),
            Parameter::InReplyTo => (&mut self.in_reply_to, "in-reply-to"),
            Parameter::Language => (&mut self.language, "language"),
            Parameter::Encoding => (&mut self.encoding, "encoding"),
            Parameter::Ontology => (&mut self.ontology, "ontology"),
            Parameter::ConversationId => (&mut self.conversation_id, "conversation-id"),
            Parameter::Sender => {
                self.sender = Some(agent(lexer, AgentId::MAX_DEPTH)?);
                return Ok(Step::Parameter);
            }
            Parameter::Receiver => {
                self.receivers = agent_set(lexer)?;
                return Ok(Step::Parameter);
            }
            Parameter::ReplyTo => {
                self.reply_to = agent_set(lexer)?;
                return Ok(Step::Parameter);
            }
            Parameter::Protocol => {
                self.protocol = Some(protocol(lexer, terminators)?);
                return Ok(Step::Parameter);
            }
            Parameter::ReplyBy => {
                self.reply_by = Some(date_time(lexer)?);
                return Ok(Step::Parameter);
            }
            Parameter::Content => {
                let offset = lexer.offset();
                self.content = Some(content(lexer, terminators)?);
                return Ok(Step::Content(offset));
            }
        };
        *text = Some(lexer.expression(terminators, what)?);
        Ok(Step::Parameter)
    }
}

const BYTE_ORDER_MARK: &[u8] = b"\xef\xbb\xbf";
const MESSAGE: &str = "FIPA00070 Message";

#[derive(Clone, Copy)]
pub(super) enum Parameter {
    Sender,
    Receiver,
    Content,
    ReplyWith,
    ReplyBy,
    InReplyTo,
    ReplyTo,
    Language,
    Encoding,
    Ontology,
    Protocol,
    ConversationId,
}

impl Parameter {
    /// Returns the parameter with this lowercase name. The match on the length limits the
    /// comparisons.
    #[inline]
    fn of(name: &[u8]) -> Option<Self> {
        Some(match name.len() {
            6 if name == b"sender" => Self::Sender,
            7 if name == b"content" => Self::Content,
            8 => match name {
                b"receiver" => Self::Receiver,
                b"reply-to" => Self::ReplyTo,
                b"reply-by" => Self::ReplyBy,
                b"language" => Self::Language,
                b"encoding" => Self::Encoding,
                b"ontology" => Self::Ontology,
                b"protocol" => Self::Protocol,
                _ => return None,
            },
            10 if name == b"reply-with" => Self::ReplyWith,
            11 if name == b"in-reply-to" => Self::InReplyTo,
            15 if name == b"conversation-id" => Self::ConversationId,
            _ => return None,
        })
    }
}

pub(super) const PARAMETERS: &Keywords<Parameter> = &[
    ("sender", Follows::Parenthesis, Parameter::Sender),
    ("receiver", Follows::Parenthesis, Parameter::Receiver),
    ("content", Follows::Counted, Parameter::Content),
    ("reply-with", Follows::Counted, Parameter::ReplyWith),
    ("reply-by", Follows::DateTime, Parameter::ReplyBy),
    ("in-reply-to", Follows::Counted, Parameter::InReplyTo),
    ("reply-to", Follows::Parenthesis, Parameter::ReplyTo),
    ("language", Follows::Counted, Parameter::Language),
    ("encoding", Follows::Counted, Parameter::Encoding),
    ("ontology", Follows::Counted, Parameter::Ontology),
    ("protocol", Follows::Word, Parameter::Protocol),
    (
        "conversation-id",
        Follows::Counted,
        Parameter::ConversationId,
    ),
];

fn performative<'a>(lexer: &mut Lexer<'a>) -> Result<PerformativeView<'a>, DecodeError> {
    let offset = lexer.offset();
    let name = lexer.word(Some(PARAMETERS), "performative")?;
    let problem = Problem::NotAWord("performative");
    PerformativeView::of_name(name).ok_or_else(|| DecodeError::new(offset, MESSAGE, problem))
}

/// Reads the protocol, which must be a word. JADE may write it in quotation marks.
fn protocol<'a>(
    lexer: &mut Lexer<'a>,
    terminators: Option<&Keywords<Parameter>>,
) -> Result<Text<'a>, DecodeError> {
    let offset = lexer.offset();
    let text = lexer.text(terminators, "protocol")?;
    if text.is_token() {
        Ok(text)
    } else {
        let problem = Problem::NotAWord("protocol");
        Err(DecodeError::new(offset, MESSAGE, problem))
    }
}

fn date_time(lexer: &mut Lexer<'_>) -> Result<Time, DecodeError> {
    let offset = lexer.offset();
    let text = lexer.text(Some(PARAMETERS), "reply-by")?;
    let clause = "FIPA00070 DateTime";
    text.as_str()
        .parse()
        .map_err(|_| DecodeError::new(offset, clause, Problem::DateTime))
}

/// Reads the content: a string (standard), a word (JADE) or an expression (editions before F).
fn content<'a>(
    lexer: &mut Lexer<'a>,
    terminators: Option<&Keywords<Parameter>>,
) -> Result<Content<'a>, DecodeError> {
    let offset = lexer.offset();
    let (bytes, escaped) = match lexer.peek() {
        Some(b'"') => lexer.quoted_content("content")?,
        Some(b'#') => (lexer.counted("content")?, false),
        Some(b'(') => (lexer.parenthesized("content")?, false),
        _ => (lexer.word(terminators, "content")?.raw(), false),
    };
    if bytes.len() as u64 > Message::MAX_CONTENT {
        let problem = Problem::TooLong("content");
        return Err(DecodeError::new(offset, MESSAGE, problem));
    }
    Ok(if escaped {
        Content::Quoted(bytes)
    } else {
        Content::Bytes(bytes)
    })
}

/// Reads the name and the value of a user-defined parameter. The `:X-` was read.
pub(super) fn user_defined<'a>(lexer: &mut Lexer<'a>) -> Result<(Text<'a>, Text<'a>), DecodeError> {
    let name = lexer.word::<()>(None, "name of a user-defined parameter")?;
    lexer.skip_space();
    let wrapped = lexer.peek() == Some(b'(');
    let text = lexer.expression::<()>(None, "user-defined parameter")?;
    let unwrapped = wrapped.then(|| unwrapped(&text)).flatten();
    Ok((name, unwrapped.unwrap_or(text)))
}
