//! Reading messages (FIPA00071).

use std::borrow::Cow;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use bytes::Bytes;

use crate::dialect::{BASE64, JADE_ENCODING};
use crate::error::{DecodeError, Problem};
use crate::word::is_token;
use crate::xml::agent_id;
use crate::xml::reader::{Element, Elements, Value};
use crate::{AgentId, Message, Payload};

const CLAUSE: &str = "FIPA00071";

/// Reads a message. The content of the result shares the memory it was given in, unless it is
/// escaped.
///
/// # Errors
/// When the payload is not one whole message in this encoding.
pub(crate) fn decode(payload: &Payload) -> Result<Message, DecodeError> {
    let whole = payload.to_bytes();
    let mut elements = Elements::new(&whole, CLAUSE);
    let root = elements.root("fipa-message", "the outermost element is not fipa-message")?;
    let Some(act) = elements.attribute(&root, "act")? else {
        return Err(elements.error(root.offset, Problem::Missing("act")));
    };
    let performative = act.trimmed("act")?.parse();
    let no_word = |_| elements.error(root.offset, Problem::NotAWord("act"));
    let mut message = Message::empty(performative.map_err(no_word)?);
    // fipa_services writes it here too, empty if there is none; the element counts.
    let conversation = elements.attribute(&root, "conversation-id")?;
    let mut content = None;
    while let Some(child) = elements.child()? {
        if child.is("content") {
            content = Some(content_value(&mut elements, &child)?);
        } else {
            set(&mut message, &mut elements, &child)?;
        }
    }
    if let (None, Some(value)) = (&message.conversation_id, conversation)
        && !value.is_empty()
    {
        message.conversation_id = Some(value.text("conversation-id")?);
    }
    if let Some(content) = content {
        let binary = take_jade_encoding(&mut message);
        message.content = Some(content_bytes(&content, binary, &whole)?);
    }
    elements.finish()?;
    Ok(message)
}

fn set<'a>(
    message: &mut Message,
    elements: &mut Elements<'a>,
    child: &Element<'a>,
) -> Result<(), DecodeError> {
    if child.is("receiver") {
        return agent_id::read_all(elements, &mut message.receivers);
    }
    if child.is("reply-to") {
        return agent_id::read_all(elements, &mut message.reply_to);
    }
    if child.is("sender") {
        let mut agents: Vec<AgentId> = Vec::new();
        agent_id::read_all(elements, &mut agents)?;
        message.sender = agents.into_iter().next();
        return Ok(());
    }
    if child.is("reply-by") {
        message.reply_by = Some(elements.value(child, &["time"])?.time()?);
        return Ok(());
    }
    if child.is("protocol") {
        let protocol = elements.value(child, &[])?.trimmed("protocol")?;
        if !protocol.is_empty() && !is_token(&protocol) {
            return Err(elements.error(child.offset, Problem::NotAWord("protocol")));
        }
        message.protocol = Some(protocol).filter(|protocol| !protocol.is_empty());
        return Ok(());
    }
    let texts = [
        ("language", &mut message.language),
        ("encoding", &mut message.encoding),
        ("ontology", &mut message.ontology),
        ("conversation-id", &mut message.conversation_id),
        ("reply-with", &mut message.reply_with),
        ("in-reply-to", &mut message.in_reply_to),
    ];
    for (name, text) in texts {
        if child.is(name) {
            *text = Some(elements.value(child, &[])?.text(name)?);
            return Ok(());
        }
    }
    if let Some((name, value)) = agent_id::user_defined_pair(elements, child)? {
        if !is_token(&name) {
            let problem = Problem::NotAWord("name of a user-defined parameter");
            return Err(elements.error(child.offset, problem));
        }
        message.user_defined.push((name, value));
    }
    Ok(())
}

fn content_value<'a>(
    elements: &mut Elements<'a>,
    child: &Element<'a>,
) -> Result<Value<'a>, DecodeError> {
    let reference = elements.attribute(child, "href")?;
    if reference.is_some_and(|reference| !reference.is_empty()) {
        let problem = Problem::Xml("content that lies elsewhere (href) is not fetched");
        return Err(elements.error(child.offset, problem));
    }
    elements.value(child, &[])
}

/// Whether JADE says that the content is Base64; this is part of the encoding, not of the message.
fn take_jade_encoding(message: &mut Message) -> bool {
    let said = |(name, value): &(String, String)| {
        name.eq_ignore_ascii_case(JADE_ENCODING) && value.trim().eq_ignore_ascii_case(BASE64)
    };
    let before = message.user_defined.len();
    message.user_defined.retain(|pair| !said(pair));
    message.user_defined.len() < before
}

fn content_bytes(content: &Value<'_>, base64: bool, whole: &Bytes) -> Result<Bytes, DecodeError> {
    let bytes = content.bytes()?;
    if base64 {
        let dense: Vec<u8> = bytes
            .iter()
            .copied()
            .filter(|byte| !byte.is_ascii_whitespace())
            .collect();
        let wrong = |_| DecodeError::new(content.offset, CLAUSE, Problem::Base64);
        return Ok(STANDARD.decode(dense).map_err(wrong)?.into());
    }
    Ok(match bytes {
        Cow::Borrowed([]) => Bytes::new(),
        Cow::Borrowed(bytes) => whole.slice_ref(bytes),
        Cow::Owned(bytes) => bytes.into(),
    })
}
