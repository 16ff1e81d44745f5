//! Reading envelopes (FIPA00085).

use crate::error::{DecodeError, Problem};
use crate::word::is_token;
use crate::xml::agent_id;
use crate::xml::reader::{Element, Elements};
use crate::{AclRepresentation, Envelope, EnvelopeParams, Received};

const CLAUSE: &str = "FIPA00085";

/// Most elements with parameters: the same bound as for bit-efficient extensions.
const MAX_PARTS: usize = 1025;

/// Reads an envelope, directly behind which the payload may follow, and says how long it is in
/// bytes.
///
/// # Errors
/// When the bytes do not begin with a whole envelope in this encoding.
pub(crate) fn decode(bytes: &[u8]) -> Result<(Envelope, usize), DecodeError> {
    let mut elements = Elements::new(bytes, CLAUSE);
    let root = elements.root("envelope", "the outermost element is not envelope")?;
    let mut parts = Vec::new();
    while let Some(child) = elements.child()? {
        if child.is("params") {
            read_params(&mut elements, &child, &mut parts)?;
        } else {
            elements.skip()?;
        }
    }
    // The sort is stable: JADE gives every part the same index, or puts one inside another.
    parts.sort_by_key(|part| part.index);
    let mut parts = parts.into_iter().map(|part| part.params);
    let Some(base) = parts.next() else {
        return Err(elements.error(root.offset, Problem::Missing("params")));
    };
    let envelope = Envelope {
        base,
        extensions: parts.collect(),
    };
    Ok((envelope, elements.position()))
}

struct Part {
    index: u64,
    params: EnvelopeParams,
}

/// The nesting of elements is bounded by the reader, and with it this recursion.
fn read_params<'a>(
    elements: &mut Elements<'a>,
    begin: &Element<'a>,
    parts: &mut Vec<Part>,
) -> Result<(), DecodeError> {
    if parts.len() >= MAX_PARTS {
        return Err(elements.error(begin.offset, Problem::TooDeep("params")));
    }
    let place = parts.len();
    let index = match elements.attribute(begin, "index")? {
        Some(value) if !value.is_empty() => {
            let number = value.trimmed("index")?.parse();
            number.map_err(|_| elements.error(begin.offset, Problem::Number))?
        }
        // Where peers leave it out, the order counts.
        _ => parts.last().map_or(1, |part| part.index),
    };
    let params = EnvelopeParams::default();
    parts.push(Part { index, params });
    let mut params = EnvelopeParams::default();
    while let Some(child) = elements.child()? {
        if child.is("params") {
            read_params(elements, &child, parts)?;
        } else {
            set(&mut params, elements, &child)?;
        }
    }
    if let Some(part) = parts.get_mut(place) {
        part.params = params;
    }
    Ok(())
}

fn set<'a>(
    params: &mut EnvelopeParams,
    elements: &mut Elements<'a>,
    child: &Element<'a>,
) -> Result<(), DecodeError> {
    if child.is("to") {
        return agent_id::read_all(elements, &mut params.to);
    }
    if child.is("intended-receiver") {
        return agent_id::read_all(elements, &mut params.intended_receivers);
    }
    if child.is("from") {
        let mut agents = Vec::new();
        agent_id::read_all(elements, &mut agents)?;
        params.from = agents.into_iter().next().or(params.from.take());
        return Ok(());
    }
    if child.is("received") {
        let received = read_received(elements, child)?;
        params.received = received.or(params.received.take());
        return Ok(());
    }
    if child.is("date") {
        params.date = Some(elements.value(child, &["value"])?.time()?);
        return Ok(());
    }
    let texts = [
        ("comments", &mut params.comments),
        ("payload-encoding", &mut params.payload_encoding),
        ("transport-behaviour", &mut params.transport_behaviour),
    ];
    for (name, text) in texts {
        if child.is(name) {
            let value = elements.value(child, &["value"])?.text(name)?;
            *text = Some(value).filter(|value| !value.is_empty());
            return Ok(());
        }
    }
    if child.is("acl-representation") {
        let name = elements.value(child, &["value"])?;
        let name = name.trimmed("acl-representation")?;
        params.acl_representation =
            (!name.is_empty()).then(|| AclRepresentation::from(name.as_str()));
        return Ok(());
    }
    if child.is("payload-length") {
        let digits = elements.value(child, &["value"])?;
        let digits = digits.trimmed("payload-length")?;
        // JADE writes -1, and nothing, where it does not know.
        params.payload_length = if digits.is_empty() || digits == "-1" {
            None
        } else {
            let wrong = |_| elements.error(child.offset, Problem::Number);
            Some(digits.parse().map_err(wrong)?)
        };
        return Ok(());
    }
    let pair = user_defined(elements, child)?;
    params.user_defined.extend(pair);
    Ok(())
}

/// A stamp, its parts in any order; `None` if it does not say by whom.
fn read_received<'a>(
    elements: &mut Elements<'a>,
    begin: &Element<'a>,
) -> Result<Option<Received>, DecodeError> {
    let mut by = None;
    let mut from = None;
    let mut date = None;
    let mut id = None;
    let mut via = None;
    let mut pairs = Vec::new();
    while let Some(child) = elements.child()? {
        if child.is("received-date") {
            date = Some(elements.value(&child, &["value"])?.time()?);
            continue;
        }
        let texts = [
            ("received-by", &mut by),
            ("received-from", &mut from),
            ("received-id", &mut id),
            ("received-via", &mut via),
        ];
        let known = texts.into_iter().find(|(name, _)| child.is(name));
        if let Some((name, text)) = known {
            let value = elements.value(&child, &["value"])?.trimmed(name)?;
            *text = Some(value).filter(|value| !value.is_empty());
        } else {
            pairs.extend(user_defined(elements, &child)?);
        }
    }
    let Some(by) = by else { return Ok(None) };
    let Some(date) = date else {
        return Err(elements.error(begin.offset, Problem::Missing("received-date")));
    };
    Ok(Some(Received {
        by,
        from,
        date,
        id,
        via,
        user_defined: pairs,
    }))
}

fn user_defined<'a>(
    elements: &mut Elements<'a>,
    child: &Element<'a>,
) -> Result<Option<(String, String)>, DecodeError> {
    let pair = agent_id::user_defined_pair(elements, child)?;
    if pair.as_ref().is_some_and(|(name, _)| !is_token(name)) {
        let problem = Problem::NotAWord("name of a user-defined parameter");
        return Err(elements.error(child.offset, problem));
    }
    Ok(pair)
}
