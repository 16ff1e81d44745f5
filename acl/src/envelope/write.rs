//! Writing bit-efficient envelopes: FIPA00088 as its examples have it (texts bare), newest
//! extension first, with the right lengths.

use bytes::Bytes;

use crate::bitefficient::reader::{Form, string_form};
use crate::bitefficient::write::{Out, write_date_time, write_digits};
use crate::error::EncodeError;
use crate::word::{self, is_token};
use crate::{AclRepresentation, AgentId, Envelope, EnvelopeParams, Received};

const BASE: &str = "a base envelope";
const EXTENSION: &str = "an extension envelope";

impl Envelope {
    /// The encoded envelope, all extensions included, in the standard's dialect.
    ///
    /// # Errors
    /// When a mandatory parameter is missing, or one has a value that cannot be encoded. An
    /// extension needs a stamp and has no place for a date.
    pub fn encode_standard(&self) -> Result<Bytes, EncodeError> {
        let mut out = Vec::new();
        for extension in self.extensions.iter().rev() {
            write_extension(extension, &mut out)?;
        }
        write_base(&self.base, &mut out)?;
        Ok(out.into())
    }

    /// One encoded extension envelope, to be put in front of a letter
    /// ([`Letter::stamped`](crate::Letter::stamped)).
    ///
    /// # Errors
    /// Like [`encode_standard`](Self::encode_standard).
    pub fn encode_extension(params: &EnvelopeParams) -> Result<Bytes, EncodeError> {
        let mut out = Vec::new();
        write_extension(params, &mut out)?;
        Ok(out.into())
    }
}

fn write_extension(params: &EnvelopeParams, out: &mut Vec<u8>) -> Result<(), EncodeError> {
    if params.date.is_some() {
        let (parameter, of) = ("date", EXTENSION);
        return Err(EncodeError::NoPlace { parameter, of });
    }
    let mut body = Vec::new();
    let stamp = params.received.as_ref();
    write_received(stamp.ok_or_else(missing("received", EXTENSION))?, &mut body)?;
    if let Some(representation) = &params.acl_representation {
        body.push(0x04);
        write_acl_representation(representation, &mut body)?;
    }
    write_parameters(params, &mut body)?;
    write_part(0xfd, &body, out)
}

fn write_base(params: &EnvelopeParams, out: &mut Vec<u8>) -> Result<(), EncodeError> {
    let mut body = Vec::new();
    let representation = params.acl_representation.as_ref();
    let representation = representation.ok_or_else(missing("acl-representation", BASE))?;
    write_acl_representation(representation, &mut body)?;
    write_date_time(params.date.ok_or_else(missing("date", BASE))?, &mut body);
    write_parameters(params, &mut body)?;
    if let Some(received) = &params.received {
        body.push(0x0a);
        write_received(received, &mut body)?;
    }
    write_part(0xfe, &body, out)
}

fn missing(parameter: &'static str, of: &'static str) -> impl Fn() -> EncodeError {
    move || EncodeError::Missing { parameter, of }
}

/// Id, length, body, end. The length counts all of that (FIPA00088 `EnvLen`).
fn write_part(id: u8, body: &[u8], out: &mut Vec<u8>) -> Result<(), EncodeError> {
    out.push(id);
    let with_short_len = body.len() + 4;
    if let Ok(len) = u16::try_from(with_short_len) {
        out.slice(&len.to_be_bytes());
    } else {
        let len = with_short_len + 4;
        let len = u32::try_from(len).map_err(|_| EncodeError::EnvelopeTooLong(len))?;
        out.slice(&[0, 0]);
        out.slice(&len.to_be_bytes());
    }
    out.slice(body);
    out.push(0x01);
    Ok(())
}

/// The parameters that base and extension have in common, in the order of their codes.
fn write_parameters(params: &EnvelopeParams, out: &mut Vec<u8>) -> Result<(), EncodeError> {
    write_agent_ids(0x02, &params.to, out)?;
    if let Some(from) = &params.from {
        out.push(0x03);
        write_agent_id(from, out)?;
    }
    write_text(0x05, "comments", params.comments.as_deref(), out)?;
    if let Some(len) = params.payload_length {
        out.push(0x06);
        write_digits(len, out);
    }
    write_text(
        0x07,
        "payload-encoding",
        params.payload_encoding.as_deref(),
        out,
    )?;
    write_agent_ids(0x09, &params.intended_receivers, out)?;
    if let Some(text) = &params.transport_behaviour {
        out.push(0x0b);
        write_any(present("transport-behaviour", text)?, out)?;
    }
    write_user_defined(&params.user_defined, out)
}

fn write_received(received: &Received, out: &mut Vec<u8>) -> Result<(), EncodeError> {
    write_string("received-by", present("received-by", &received.by)?, out)?;
    write_date_time(received.date, out);
    write_text(0x02, "received-from", received.from.as_deref(), out)?;
    write_text(0x03, "received-id", received.id.as_deref(), out)?;
    write_text(0x04, "received-via", received.via.as_deref(), out)?;
    write_user_defined(&received.user_defined, out)?;
    out.push(0x01);
    Ok(())
}

fn write_acl_representation(
    representation: &AclRepresentation,
    out: &mut Vec<u8>,
) -> Result<(), EncodeError> {
    // A standard name spelled out is the standard one.
    match AclRepresentation::from(representation.as_str()) {
        AclRepresentation::BitEfficient => out.push(0x10),
        AclRepresentation::String => out.push(0x11),
        AclRepresentation::Xml => out.push(0x12),
        AclRepresentation::Other(name) => {
            out.push(0x00);
            write_string(
                "acl-representation",
                present("acl-representation", &name)?,
                out,
            )?;
        }
    }
    Ok(())
}

fn write_agent_ids(code: u8, agents: &[AgentId], out: &mut Vec<u8>) -> Result<(), EncodeError> {
    if agents.is_empty() {
        return Ok(());
    }
    out.push(code);
    for agent in agents {
        write_agent_id(agent, out)?;
    }
    out.push(0x01);
    Ok(())
}

fn write_agent_id(agent: &AgentId, out: &mut Vec<u8>) -> Result<(), EncodeError> {
    out.push(0x02);
    write_string("agent name", agent.name(), out)?;
    if !agent.addresses().is_empty() {
        out.push(0x02);
        for address in agent.addresses() {
            write_string("address", address, out)?;
        }
        out.push(0x01);
    }
    write_agent_ids(0x03, agent.resolvers(), out)?;
    for (name, value) in agent.user_defined() {
        out.push(0x05);
        write_string("user-defined name", &format!("X-{name}"), out)?;
        write_any(value, out)?;
    }
    out.push(0x01);
    Ok(())
}

fn write_user_defined(pairs: &[(String, String)], out: &mut Vec<u8>) -> Result<(), EncodeError> {
    for (name, value) in pairs {
        if !is_token(name) {
            return Err(EncodeError::UserDefinedName(
                name.chars().take(60).collect(),
            ));
        }
        out.push(0x00);
        write_string("user-defined name", &format!("X-{name}"), out)?;
        write_string("user-defined value", value, out)?;
    }
    Ok(())
}

fn write_any(value: &str, out: &mut Vec<u8>) -> Result<(), EncodeError> {
    out.push(0x14);
    write_string("value", value, out)
}

fn write_text(
    code: u8,
    what: &'static str,
    text: Option<&str>,
    out: &mut Vec<u8>,
) -> Result<(), EncodeError> {
    match text {
        None => Ok(()),
        Some(text) => {
            out.push(code);
            write_string(what, present(what, text)?, out)
        }
    }
}

/// An empty text is how peers say that there is none.
fn present<'a>(what: &'static str, text: &'a str) -> Result<&'a str, EncodeError> {
    (!text.is_empty())
        .then_some(text)
        .ok_or(EncodeError::Empty(what))
}

/// A text as the standard's examples have it, bare. Only one that would be taken for a text in
/// another form, or for the tag (0a) that JADE puts in front of stamps, is put in quotation marks.
fn write_string(what: &'static str, text: &str, out: &mut Vec<u8>) -> Result<(), EncodeError> {
    if text.contains('\0') {
        return Err(EncodeError::Nul(what));
    }
    if string_form(text.as_bytes()).0 == Form::Bare && !text.starts_with('\n') {
        out.slice(text.as_bytes());
    } else {
        word::quoted(text, |piece| out.slice(piece.as_bytes()));
    }
    out.push(0x00);
    Ok(())
}
