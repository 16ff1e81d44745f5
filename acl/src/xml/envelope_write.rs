//! Writer of envelopes (FIPA00085).

use crate::bitefficient::write;
use crate::dialect::local_time;
use crate::envelope::present;
use crate::error::EncodeError;
use crate::xml::agent_id::{self, Form};
use crate::xml::writer::XmlWriter;
use crate::{Dialect, Envelope, EnvelopeParams, Received, Time};

/// Writes the envelope with all extensions.
///
/// JADE reads one part only: its envelope has the effective parameters, without older stamps.
/// fipa_services reads only times without a zone: its envelope has no zones.
///
/// # Errors
/// XML or the dialect cannot represent a value.
pub(crate) fn encode(
    envelope: &Envelope,
    dialect: Dialect,
    out: &mut dyn write::Output,
) -> Result<(), EncodeError> {
    // JADE takes each byte of an envelope for a character of ISO-8859-1.
    let mut out = XmlWriter::new(out, dialect).in_ascii(dialect == Dialect::Jade);
    out.raw(match dialect {
        Dialect::Standard => "<?xml version=\"1.0\"?>",
        Dialect::FipaServices => "<?xml version=\"1.0\" ?>",
        // JADE writes this line break.
        Dialect::Jade => "<?xml version=\"1.0\"?>\n",
    });
    out.open("envelope");
    if dialect == Dialect::Jade {
        write_part(&mut out, 1, &envelope.effective(), dialect)?;
    } else {
        for (index, part) in (1..).zip([&envelope.base].into_iter().chain(&envelope.extensions)) {
            write_part(&mut out, index, part, dialect)?;
        }
    }
    out.close("envelope");
    Ok(())
}

fn write_part(
    out: &mut XmlWriter<'_>,
    index: usize,
    params: &EnvelopeParams,
    dialect: Dialect,
) -> Result<(), EncodeError> {
    out.raw(&format!("<params index=\"{index}\">"));
    agent_id::write_all(out, "to", &params.to, Form::Envelope, dialect)?;
    let from = params.from.as_ref().map(std::slice::from_ref);
    agent_id::write_all(
        out,
        "from",
        from.unwrap_or_default(),
        Form::Envelope,
        dialect,
    )?;
    write_text(out, "comments", params.comments.as_deref())?;
    if let Some(representation) = &params.acl_representation {
        let (element, name) = ("acl-representation", representation.as_str());
        out.open(element);
        out.text_trimmed(element, present(element, name)?)?;
        out.close(element);
    }
    if let Some(len) = params.payload_length {
        out.element("payload-length", "payload-length", &len.to_string())?;
    }
    write_text(out, "payload-encoding", params.payload_encoding.as_deref())?;
    if let Some(date) = params.date {
        out.element("date", "date", &time_text("date", date, dialect)?)?;
    }
    let intended = &params.intended_receivers;
    agent_id::write_all(out, "intended-receiver", intended, Form::Envelope, dialect)?;
    if let Some(behaviour) = params.transport_behaviour.as_deref() {
        if dialect != Dialect::Standard {
            return Err(EncodeError::Unrepresentable {
                what: "transport-behaviour",
                why: "neither fipa_services nor JADE reads it in an XML envelope",
            });
        }
        write_text(out, "transport-behaviour", Some(behaviour))?;
    }
    let user_defined = &params.user_defined;
    // JADE writes these in front of the stamp, fipa_services behind it.
    if dialect == Dialect::Jade {
        write_user_defined(out, user_defined, dialect)?;
    }
    if let Some(received) = &params.received {
        write_received(out, received, dialect)?;
    }
    if dialect != Dialect::Jade {
        write_user_defined(out, user_defined, dialect)?;
    }
    out.close("params");
    Ok(())
}

fn write_received(
    out: &mut XmlWriter<'_>,
    received: &Received,
    dialect: Dialect,
) -> Result<(), EncodeError> {
    let date = time_text("received-date", received.date, dialect)?;
    let by = ("received-by", Some(received.by.as_str()));
    let from = ("received-from", received.from.as_deref());
    let date = ("received-date", Some(date.as_str()));
    let id = ("received-id", received.id.as_deref());
    let via = ("received-via", received.via.as_deref());
    out.open("received");
    let order = if dialect == Dialect::Jade {
        [date, by, from, id, via]
    } else {
        [by, from, date, id, via]
    };
    for (element, value) in order {
        if let Some(value) = value {
            out.empty(element, "value", element, present(element, value)?)?;
        }
    }
    write_user_defined(out, &received.user_defined, dialect)?;
    out.close("received");
    Ok(())
}

fn write_text(
    out: &mut XmlWriter<'_>,
    element: &'static str,
    text: Option<&str>,
) -> Result<(), EncodeError> {
    match text {
        None => Ok(()),
        Some(text) => out.element(element, element, present(element, text)?),
    }
}

fn write_user_defined(
    out: &mut XmlWriter<'_>,
    pairs: &[(String, String)],
    dialect: Dialect,
) -> Result<(), EncodeError> {
    for (name, value) in pairs {
        out.user_defined(name, value, dialect != Dialect::Standard)?;
    }
    Ok(())
}

fn time_text(what: &'static str, time: Time, dialect: Dialect) -> Result<String, EncodeError> {
    if time.is_relative() {
        let why = "FIPA00085 has no relative times";
        return Err(EncodeError::Unrepresentable { what, why });
    }
    Ok(match dialect {
        Dialect::Standard => time.to_string(),
        Dialect::FipaServices => local_time(what, time)?.to_string(),
        // JADE writes Z instead of T, and ignores a letter at the end.
        Dialect::Jade => time.to_string().replacen('T', "Z", 1),
    })
}
