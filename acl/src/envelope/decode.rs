//! Decoding of envelopes and letters into owned values.

use bytes::Bytes;

use crate::envelope::parts::{Event, Events, Parameter, Part, ReceivedView, UserDefined};
use crate::envelope::read::EnvelopeReader;
use crate::envelope::view::{ValuePosition, is_xml};
use crate::error::{DecodeError, Problem};
use crate::view::AgentIds;
use crate::{AgentId, Envelope, EnvelopeParams, EnvelopeView, Letter, Received, Text, xml};

impl Envelope {
    /// Decodes an envelope with its extensions and returns its length in bytes. A payload may
    /// follow.
    ///
    /// Bit-efficient envelopes (FIPA00088) and XML envelopes (FIPA00085), which begin with `<`, are
    /// accepted. The reader is lenient: it accepts the standard and what fipa_services and JADE
    /// write. Empty texts and stamps without a name, which fipa_services writes for missing values,
    /// become absent. An XML envelope is in UTF-8, or in ISO-8859-1 if it declares that.
    ///
    /// # Errors
    /// The bytes do not begin with a whole envelope.
    pub fn decode(bytes: &[u8]) -> Result<(Self, usize), DecodeError> {
        if is_xml(bytes) {
            let encoding = xml::DeclaredEncoding::of(bytes);
            let utf8 = encoding.in_utf8(bytes);
            let (envelope, len) = decode(xml::EnvelopeReader::new(&utf8))?;
            let document = utf8.get(..len).unwrap_or_default();
            encoding.check(document, "FIPA00085")?;
            Ok((envelope, encoding.len_of(document)))
        } else {
            decode(EnvelopeReader::new(bytes))
        }
    }
}

fn decode<'a>(mut reader: impl Events<'a>) -> Result<(Envelope, usize), DecodeError> {
    let mut parts: Vec<(ValuePosition, EnvelopeParams)> = Vec::new();
    let mut current = 0;
    while let Some(event) = reader.next()? {
        match event {
            Event::Part(part) => {
                let position = ValuePosition::of(&part, parts.len() + 1);
                current = position.part.saturating_sub(1);
                // In XML, an outer part may continue behind a nested one.
                if current == parts.len() {
                    let mut params = EnvelopeParams::default();
                    begin(&mut params, part);
                    parts.push((position, params));
                }
            }
            Event::Parameter(parameter) => {
                if let Some((_, params)) = parts.get_mut(current) {
                    set(params, parameter)?;
                }
            }
        }
    }
    parts.sort_by_key(|(position, _)| (position.recency, position.part));
    let mut parts = parts.into_iter().map(|(_, params)| params);
    let envelope = Envelope {
        base: parts.next().unwrap_or_default(),
        extensions: parts.collect(),
    };
    Ok((envelope, reader.position()))
}

impl Letter {
    /// Splits a letter in one piece of memory into envelope and payload. Nothing is copied, and the
    /// payload is not checked.
    ///
    /// # Errors
    /// The bytes do not begin with a whole envelope.
    pub fn split(mut bytes: Bytes) -> Result<Self, DecodeError> {
        let envelope_len = EnvelopeView::parse(&bytes)?.len();
        let envelope = bytes.split_to(envelope_len);
        Ok(Self::new(envelope, bytes))
    }

    /// Splits a letter like [`split`](Self::split) and decodes its envelope.
    ///
    /// # Errors
    /// The errors of [`split`](Self::split).
    pub fn decode(mut bytes: Bytes) -> Result<(Envelope, Self), DecodeError> {
        let (envelope, envelope_len) = Envelope::decode(&bytes)?;
        let encoded = bytes.split_to(envelope_len);
        Ok((envelope, Self::new(encoded, bytes)))
    }

    /// Decodes the envelope, including the stamps.
    ///
    /// # Errors
    /// The bytes of the envelope are not one whole envelope.
    pub fn parse_envelope(&self) -> Result<Envelope, DecodeError> {
        let bytes = self.envelope();
        let (envelope, used) = Envelope::decode(&bytes)?;
        let rest = bytes.get(used..).unwrap_or_default();
        let (rest, clause) = if is_xml(&bytes) {
            (rest.trim_ascii(), "FIPA00085")
        } else {
            (rest, "FIPA00088 MessageEnvelope")
        };
        match rest.len() {
            0 => Ok(envelope),
            rest => Err(DecodeError::new(used, clause, Problem::Trailing(rest))),
        }
    }
}

fn begin(params: &mut EnvelopeParams, part: Part<'_>) {
    match part {
        Part::Extension(view) => params.received = received(view),
        Part::Base(representation, date) => {
            params.acl_representation = Some(representation.to_owned());
            params.date = Some(date);
        }
        Part::Params { .. } => {}
    }
}

fn set(params: &mut EnvelopeParams, parameter: Parameter<'_>) -> Result<(), DecodeError> {
    match parameter {
        Parameter::To(ids) => add(&mut params.to, ids)?,
        Parameter::From(agent) => params.from = Some(agent.to_agent_id()?),
        Parameter::Date(date) => params.date = Some(date),
        Parameter::AclRepresentation(representation) => {
            params.acl_representation = Some(representation.to_owned());
        }
        Parameter::Comments(text) => params.comments = present(Some(text)),
        Parameter::PayloadLength(len) => params.payload_length = Some(len),
        Parameter::PayloadEncoding(text) => params.payload_encoding = present(Some(text)),
        Parameter::IntendedReceivers(ids) => add(&mut params.intended_receivers, ids)?,
        // fipa_services repeats the stamp of an extension here with more parameters.
        Parameter::Received(view) => params.received = received(view).or(params.received.take()),
        Parameter::TransportBehaviour(text) => params.transport_behaviour = present(Some(text)),
        Parameter::UserDefined(pair) => params.user_defined.push(owned_pair(pair)),
    }
    Ok(())
}

/// Adds a list of agents. In XML, the lists of one part add up. In the bit-efficient encoding, the
/// last one counts. JADE writes an empty list for a missing one.
fn add(agents: &mut Vec<AgentId>, ids: AgentIds<'_>) -> Result<(), DecodeError> {
    let more = ids.to_agent_ids()?;
    if !ids.is_xml() && !more.is_empty() {
        agents.clear();
    }
    agents.extend(more);
    Ok(())
}

fn received(view: ReceivedView<'_>) -> Option<Received> {
    Some(Received {
        by: present(Some(view.by))?,
        from: present(view.from),
        date: view.date,
        id: present(view.id),
        via: present(view.via),
        user_defined: view.user_defined().map(owned_pair).collect(),
    })
}

fn present(text: Option<Text<'_>>) -> Option<String> {
    text.filter(|text| !text.is_empty())
        .map(|text| text.as_str().into_owned())
}

fn owned_pair(pair: UserDefined<'_>) -> (String, String) {
    match pair {
        UserDefined::Pair(name, value) => (name.as_str().into_owned(), value.as_str().into_owned()),
        UserDefined::Joined(text) => {
            let text = text.as_str();
            let (name, value) = text.split_once(' ').unwrap_or((&text, ""));
            let name = Text::plain(name.as_bytes()).without_x();
            (name.as_str().into_owned(), value.to_owned())
        }
    }
}
