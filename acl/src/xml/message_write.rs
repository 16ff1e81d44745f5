//! Writer of messages (FIPA00071).

use crate::bitefficient::write;
use crate::dialect::{JADE_ENCODING, local_time};
use crate::error::EncodeError;
use crate::xml::agent_id::{self, Form};
use crate::xml::writer::XmlWriter;
use crate::{Dialect, Message, Performative, Time};

/// Writes the message.
///
/// fipa_services reads only times without a zone, as local times: its message has no zones.
///
/// # Errors
/// XML cannot represent a value (bytes that are not text, control characters), or the dialect cannot.
pub(crate) fn encode(
    message: &Message,
    dialect: Dialect,
    out: &mut dyn write::Output,
) -> Result<(), EncodeError> {
    let mut out = XmlWriter::new(out, dialect);
    let jade = dialect == Dialect::Jade;
    match dialect {
        Dialect::Standard => out.raw("<?xml version=\"1.0\"?>"),
        Dialect::FipaServices => out.raw("<?xml version=\"1.0\" ?>"),
        Dialect::Jade => {}
    }
    out.raw("<fipa-message");
    out.attribute("act", "performative", &act(message, jade)?)?;
    if dialect == Dialect::FipaServices {
        let conversation = message.conversation_id().unwrap_or_default();
        out.attribute("conversation-id", "conversation-id", conversation)?;
    }
    out.raw(">");
    let sender = message.sender().map(std::slice::from_ref);
    let sender = ("sender", sender.unwrap_or_default());
    let receivers = ("receiver", message.receivers());
    let first = if jade {
        [sender, receivers]
    } else {
        [receivers, sender]
    };
    for (element, agents) in first {
        agent_id::write_all(&mut out, element, agents, Form::Message, dialect)?;
    }
    write_content(&mut out, message, dialect)?;
    for (element, text) in [
        ("language", message.language()),
        ("encoding", message.encoding()),
        ("ontology", message.ontology()),
    ] {
        write_text(&mut out, element, text, dialect)?;
    }
    if let Some(protocol) = message.protocol() {
        write_text(&mut out, "protocol", Some(protocol), dialect)?;
    }
    if jade {
        let conversation = message.conversation_id();
        write_text(&mut out, "conversation-id", conversation, dialect)?;
    }
    write_text(&mut out, "reply-with", message.reply_with(), dialect)?;
    write_text(&mut out, "in-reply-to", message.in_reply_to(), dialect)?;
    if let Some(time) = message.reply_by() {
        let text = time_text(time, dialect)?;
        out.empty("reply-by", "time", "reply-by", &text)?;
    }
    agent_id::write_all(
        &mut out,
        "reply-to",
        message.reply_to(),
        Form::Message,
        dialect,
    )?;
    if !jade {
        let conversation = message.conversation_id();
        write_text(&mut out, "conversation-id", conversation, dialect)?;
    }
    for (name, value) in message.user_defined() {
        if name.eq_ignore_ascii_case(JADE_ENCODING) {
            return Err(EncodeError::Unrepresentable {
                what: "user-defined parameter JADE-Encoding",
                why: "readers would take it for the encoding of the content",
            });
        }
        match dialect {
            Dialect::Standard => out.user_defined(name, value, false)?,
            Dialect::FipaServices => out.user_defined(name, value, true)?,
            Dialect::Jade => {
                readable_by_jade("user-defined parameter", value)?;
                out.user_element(name, value)?;
            }
        }
    }
    out.close("fipa-message");
    Ok(())
}

fn act(message: &Message, jade: bool) -> Result<String, EncodeError> {
    match message.performative() {
        Performative::Other(_) if jade => Err(EncodeError::Unrepresentable {
            what: "performative",
            why: "JADE drops messages with a user-defined performative",
        }),
        act if jade => Ok(act.as_str().to_ascii_uppercase()),
        act => Ok(act.as_str().to_owned()),
    }
}

fn write_content(
    out: &mut XmlWriter<'_>,
    message: &Message,
    dialect: Dialect,
) -> Result<(), EncodeError> {
    let Some(content) = message.content() else {
        return Ok(());
    };
    out.open("content");
    if dialect == Dialect::Jade {
        // A copy, because another process may change shared memory at any time.
        let content = content.to_vec();
        let text = std::str::from_utf8(&content).map_err(|_| EncodeError::Unrepresentable {
            what: "content",
            why: "it is not UTF-8 text",
        })?;
        readable_by_jade("content", text)?;
        out.content(&content)?;
    } else {
        out.content(content)?;
    }
    out.close("content");
    Ok(())
}

fn write_text(
    out: &mut XmlWriter<'_>,
    element: &'static str,
    text: Option<&str>,
    dialect: Dialect,
) -> Result<(), EncodeError> {
    let Some(text) = text else { return Ok(()) };
    if dialect == Dialect::Jade {
        readable_by_jade(element, text)?;
    }
    out.element(element, element, text)
}

/// Refuses a text that JADE misreads. JADE removes the white space around a text, and its parser
/// inserts blanks at escaped characters.
fn readable_by_jade(what: &'static str, text: &str) -> Result<(), EncodeError> {
    if text.trim() != text {
        let why = "JADE removes the white space around it";
        return Err(EncodeError::Unrepresentable { what, why });
    }
    if text.contains(['<', '>', '&', '\r']) {
        let why = "JADE inserts blanks at its escaped characters";
        return Err(EncodeError::Unrepresentable { what, why });
    }
    Ok(())
}

fn time_text(time: Time, dialect: Dialect) -> Result<String, EncodeError> {
    let time = match dialect {
        Dialect::FipaServices => local_time("reply-by", time)?,
        _ => time,
    };
    Ok(time.to_string())
}
