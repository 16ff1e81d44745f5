//! Reading string messages, leniently.

use std::borrow::Cow;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64_ENGINE;
use bytes::Bytes;

use super::announces_base64;
use super::lex::{Follows, Keyword, Keywords, Lexer, unwrapped};
use crate::error::{DecodeError, Problem};
use crate::{AgentId, AgentIdError, Message, Payload, Performative, Time};

/// Reads a string message. The content of the result shares the memory it was given in, unless it
/// was written with escapes or in Base64.
///
/// # Errors
/// When the payload is not one whole string message.
pub(crate) fn decode(payload: &Payload) -> Result<Message, DecodeError> {
    let bytes = payload.to_bytes();
    let mut lexer = Lexer::new(&bytes);
    if lexer.rest().starts_with(BYTE_ORDER_MARK) {
        lexer.skip(BYTE_ORDER_MARK.len());
    }
    lexer.open(MESSAGE)?;
    lexer.skip_space();
    let mut message = Message::empty(performative(&mut lexer)?);
    // Where the content stood, to say so when it is found not to be Base64.
    let mut content_offset = 0;
    while !lexer.accept(b')') {
        let keyword = lexer.keyword(PARAMETERS, MESSAGE, "a parameter of a message")?;
        let Keyword::Known(parameter) = keyword else {
            message.user_defined.push(user_defined(&mut lexer)?);
            continue;
        };
        // Without white space in front, the value ends where the next keyword begins.
        let glued = (!lexer.skip_space()).then_some(PARAMETERS);
        let mut text = |what| {
            let text = lexer.expression(glued, what)?;
            Ok(Some(text.into_owned()))
        };
        match parameter {
            Parameter::ReplyWith => message.reply_with = text("reply-with")?,
            Parameter::InReplyTo => message.in_reply_to = text("in-reply-to")?,
            Parameter::Language => message.language = text("language")?,
            Parameter::Encoding => message.encoding = text("encoding")?,
            Parameter::Ontology => message.ontology = text("ontology")?,
            Parameter::ConversationId => message.conversation_id = text("conversation-id")?,
            Parameter::Sender => message.sender = Some(agent(&mut lexer, 0)?),
            Parameter::Receiver => message.receivers = agent_set(&mut lexer)?,
            Parameter::ReplyTo => message.reply_to = agent_set(&mut lexer)?,
            Parameter::Protocol => message.protocol = Some(protocol(&mut lexer, glued)?),
            Parameter::ReplyBy => message.reply_by = Some(date_time(&mut lexer)?),
            Parameter::Content => {
                content_offset = lexer.offset();
                message.content = Some(content(&mut lexer, &bytes, glued)?);
            }
        }
    }
    lexer.skip_space();
    match lexer.rest().len() {
        0 => without_base64(message, content_offset),
        behind => Err(lexer.error(MESSAGE, Problem::Trailing(behind))),
    }
}

const BYTE_ORDER_MARK: &[u8] = b"\xef\xbb\xbf";
const MESSAGE: &str = "FIPA00070 Message";
const AGENT_ID: &str = "FIPA00070 AgentIdentifier";

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

#[derive(Clone, Copy)]
pub(super) enum Slot {
    Name,
    Addresses,
    Resolvers,
}

pub(super) const SLOTS: &Keywords<Slot> = &[
    ("name", Follows::Never, Slot::Name),
    ("addresses", Follows::Parenthesis, Slot::Addresses),
    ("resolvers", Follows::Parenthesis, Slot::Resolvers),
];

fn performative(lexer: &mut Lexer<'_>) -> Result<Performative, DecodeError> {
    let offset = lexer.offset();
    let word = lexer.word(Some(PARAMETERS), "performative")?;
    word.parse()
        .map_err(|_| DecodeError::new(offset, MESSAGE, Problem::NotAWord("performative")))
}

/// JADE may write it in quotation marks; a word it must be all the same.
fn protocol(
    lexer: &mut Lexer<'_>,
    glued: Option<&Keywords<Parameter>>,
) -> Result<String, DecodeError> {
    let offset = lexer.offset();
    let text = lexer.text(glued, "protocol")?;
    if crate::word::is_token(&text) {
        Ok(text.into_owned())
    } else {
        let problem = Problem::NotAWord("protocol");
        Err(DecodeError::new(offset, MESSAGE, problem))
    }
}

fn date_time(lexer: &mut Lexer<'_>) -> Result<Time, DecodeError> {
    let offset = lexer.offset();
    let text = lexer.text(Some(PARAMETERS), "reply-by")?;
    let clause = "FIPA00070 DateTime";
    text.parse()
        .map_err(|_| DecodeError::new(offset, clause, Problem::DateTime))
}

/// A string by the standard, a word from JADE, and an expression from before edition F.
fn content<'a>(
    lexer: &mut Lexer<'a>,
    whole: &'a Bytes,
    glued: Option<&Keywords<Parameter>>,
) -> Result<Bytes, DecodeError> {
    let offset = lexer.offset();
    let content = match lexer.peek() {
        Some(b'"' | b'#') => lexer.string("content")?,
        Some(b'(') => Cow::Borrowed(lexer.parenthesised("content")?),
        _ => Cow::Borrowed(lexer.word(glued, "content")?.as_bytes()),
    };
    if content.len() as u64 > Message::MAX_CONTENT {
        let problem = Problem::TooLong("content");
        return Err(DecodeError::new(offset, MESSAGE, problem));
    }
    Ok(match content {
        Cow::Borrowed(slice) => whole.slice_ref(slice),
        Cow::Owned(unescaped) => unescaped.into(),
    })
}

/// Undoes what JADE does to content that is no text.
fn without_base64(mut message: Message, content_offset: usize) -> Result<Message, DecodeError> {
    let Some(content) = &message.content else {
        return Ok(message);
    };
    if !message.user_defined.iter().any(announces_base64) {
        return Ok(message);
    }
    let encoded: Vec<u8> = content
        .iter()
        .copied()
        .filter(|byte| !byte.is_ascii_whitespace())
        .collect();
    let decoded = BASE64_ENGINE.decode(encoded);
    let problem = |_| DecodeError::new(content_offset, "JADE X-JADE-Encoding", Problem::Base64);
    message.content = Some(decoded.map_err(problem)?.into());
    message.user_defined.retain(|pair| !announces_base64(pair));
    Ok(message)
}

/// Name and value of a user-defined parameter, whose `:X-` was read.
fn user_defined(lexer: &mut Lexer<'_>) -> Result<(String, String), DecodeError> {
    let name = lexer.word::<()>(None, "name of a user-defined parameter")?;
    lexer.skip_space();
    let wrapped = lexer.peek() == Some(b'(');
    let text = lexer.expression::<()>(None, "user-defined parameter")?;
    let text = match unwrapped(&text) {
        Some(inner) if wrapped => inner.to_owned(),
        _ => text.into_owned(),
    };
    Ok((name.to_owned(), text))
}

fn agent_set(lexer: &mut Lexer<'_>) -> Result<Vec<AgentId>, DecodeError> {
    let clause = "FIPA00070 AgentIdentifierSet";
    lexer.open(clause)?;
    lexer.name("set", clause, "set")?;
    agents(lexer, 0)
}

/// Agent identifiers up to the parenthesis that closes the list.
fn agents(lexer: &mut Lexer<'_>, depth: usize) -> Result<Vec<AgentId>, DecodeError> {
    let mut agents = Vec::new();
    while !lexer.accept(b')') {
        agents.push(agent(lexer, depth)?);
    }
    Ok(agents)
}

fn agent(lexer: &mut Lexer<'_>, depth: usize) -> Result<AgentId, DecodeError> {
    if depth > AgentId::MAX_DEPTH {
        return Err(lexer.error(AGENT_ID, Problem::TooDeep("resolvers")));
    }
    lexer.open(AGENT_ID)?;
    let start = lexer.offset();
    lexer.name("agent-identifier", AGENT_ID, "agent-identifier")?;
    let mut name = None;
    let (mut addresses, mut resolvers) = (Vec::new(), Vec::new());
    let mut pairs = Vec::new();
    while !lexer.accept(b')') {
        let keyword = lexer.keyword(SLOTS, AGENT_ID, "a parameter of an agent identifier")?;
        match keyword {
            Keyword::UserDefined => pairs.push(user_defined(lexer)?),
            Keyword::Known(Slot::Name) => {
                let glued = (!lexer.skip_space()).then_some(SLOTS);
                name = Some(lexer.text(glued, "name of an agent")?);
            }
            Keyword::Known(Slot::Addresses) => addresses = self::addresses(lexer)?,
            Keyword::Known(Slot::Resolvers) => {
                sequence(lexer)?;
                resolvers = agents(lexer, depth + 1)?;
            }
        }
    }
    let Some(name) = name else {
        let problem = Problem::Missing("name of an agent");
        return Err(DecodeError::new(start, AGENT_ID, problem));
    };
    built(name.into_owned(), addresses, resolvers, pairs)
        .map_err(|error| DecodeError::new(start, AGENT_ID, problem(&error)))
}

fn built(
    name: String,
    addresses: Vec<String>,
    resolvers: Vec<AgentId>,
    pairs: Vec<(String, String)>,
) -> Result<AgentId, AgentIdError> {
    let mut agent = AgentId::new(name)?;
    for address in addresses {
        agent = agent.with_address(address)?;
    }
    for resolver in resolvers {
        agent = agent.with_resolver(resolver)?;
    }
    for (name, value) in pairs {
        agent = agent.with_user_defined(name, value)?;
    }
    Ok(agent)
}

fn problem(error: &AgentIdError) -> Problem {
    match error {
        AgentIdError::EmptyName => Problem::Empty("name of an agent"),
        AgentIdError::NameTooLong(_) => Problem::TooLong("name of an agent"),
        AgentIdError::Nul(part) => Problem::Nul(part),
        AgentIdError::EmptyAddress => Problem::Empty("address of an agent"),
        AgentIdError::TooDeep => Problem::TooDeep("resolvers"),
        AgentIdError::UserDefinedName(_) => Problem::NotAWord("name of a user-defined parameter"),
    }
}

fn addresses(lexer: &mut Lexer<'_>) -> Result<Vec<String>, DecodeError> {
    sequence(lexer)?;
    let mut addresses = Vec::new();
    while !lexer.accept(b')') {
        let address = lexer.text::<()>(None, "address of an agent")?;
        addresses.push(address.into_owned());
    }
    Ok(addresses)
}

fn sequence(lexer: &mut Lexer<'_>) -> Result<(), DecodeError> {
    lexer.open(AGENT_ID)?;
    lexer.name("sequence", AGENT_ID, "sequence")
}
