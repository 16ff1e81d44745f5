//! From encoded envelopes and letters to owned values.

use bytes::Bytes;

use crate::bitefficient::{Text, without_x};
use crate::envelope::agent_id::AgentIdViews;
use crate::envelope::read::{Event, Parameter, Part, ReceivedView, UserDefined, Walk};
use crate::envelope::view::Age;
use crate::error::{DecodeError, Problem};
use crate::{
    AgentId, Envelope, EnvelopeParams, EnvelopeView, Letter, Received, Representation, xml,
};

impl Envelope {
    /// Reads an encoded envelope with its extensions, behind which the payload may follow, and
    /// says how long it is in bytes.
    ///
    /// The reader is lenient: it takes what the standard says and what fipa_services and JADE
    /// write. Texts that are empty and stamps without a name, which is how fipa_services says that
    /// there is none, become absent. XML envelopes (FIPA00085) are told by their `<`.
    ///
    /// # Errors
    /// When the bytes do not begin with a whole envelope.
    pub fn decode(bytes: &[u8]) -> Result<(Self, usize), DecodeError> {
        if is_xml(bytes) {
            return xml::decode_envelope(bytes);
        }
        let mut newest_first = Vec::new();
        let mut oldest_first = Vec::new();
        let mut age = Age::Base;
        let mut current = EnvelopeParams::default();
        let mut walk = Walk::new(bytes);
        let mut begun = false;
        while let Some(event) = walk.next()? {
            match event {
                Event::Part(part) => {
                    if begun {
                        let extensions = match age {
                            Age::OldestFirst => &mut oldest_first,
                            Age::NewestFirst | Age::Base => &mut newest_first,
                        };
                        extensions.push(std::mem::take(&mut current));
                    }
                    begun = true;
                    age = Age::of(&part);
                    begin(&mut current, part);
                }
                Event::Parameter(parameter) => set(&mut current, parameter)?,
            }
        }
        let mut extensions = oldest_first;
        extensions.extend(newest_first.into_iter().rev());
        let envelope = Self {
            base: current,
            extensions,
        };
        Ok((envelope, walk.position()))
    }
}

impl Letter {
    /// Takes a letter that lies in one piece apart. Nothing is copied.
    ///
    /// # Errors
    /// When the bytes do not begin with a whole envelope. The message behind it is not looked at.
    pub fn split(mut bytes: Bytes) -> Result<Self, DecodeError> {
        let envelope_len = if is_xml(&bytes) {
            xml::decode_envelope(&bytes)?.1
        } else {
            EnvelopeView::parse(&bytes)?.len()
        };
        let envelope = bytes.split_to(envelope_len);
        Ok(Self::new(envelope, bytes))
    }

    /// Takes a letter that lies in one piece apart and reads its envelope.
    ///
    /// # Errors
    /// Like [`Letter::split`].
    pub fn decode(mut bytes: Bytes) -> Result<(Envelope, Self), DecodeError> {
        let (envelope, envelope_len) = Envelope::decode(&bytes)?;
        let encoded = bytes.split_to(envelope_len);
        Ok((envelope, Self::new(encoded, bytes)))
    }

    /// Reads the envelope, stamps included.
    ///
    /// # Errors
    /// When the bytes of the envelope are not one whole envelope.
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

fn is_xml(bytes: &[u8]) -> bool {
    Representation::detect(bytes) == Some(Representation::Xml)
}

fn begin(params: &mut EnvelopeParams, part: Part<'_>) {
    match part {
        Part::Extension(view) => params.received = received(view),
        Part::Base(representation, date) => {
            params.acl_representation = Some(representation.to_owned());
            params.date = Some(date);
        }
    }
}

fn set(params: &mut EnvelopeParams, parameter: Parameter<'_>) -> Result<(), DecodeError> {
    match parameter {
        // JADE writes a list that is empty where there is none.
        Parameter::To([]) | Parameter::IntendedReceivers([]) => {}
        Parameter::To(ids) => params.to = agents(ids)?,
        Parameter::From(agent) => params.from = Some(agent.to_owned()?),
        Parameter::AclRepresentation(representation) => {
            params.acl_representation = Some(representation.to_owned());
        }
        Parameter::Comments(text) => params.comments = present(Some(text)),
        Parameter::PayloadLength(len) => params.payload_length = Some(len),
        Parameter::PayloadEncoding(text) => params.payload_encoding = present(Some(text)),
        Parameter::IntendedReceivers(ids) => params.intended_receivers = agents(ids)?,
        // fipa_services repeats the stamp of an extension here, with more in it.
        Parameter::Received(view) => params.received = received(view).or(params.received.take()),
        Parameter::TransportBehaviour(text) => params.transport_behaviour = present(Some(text)),
        Parameter::UserDefined(pair) => params.user_defined.push(owned_pair(pair)),
    }
    Ok(())
}

fn agents(ids: &[u8]) -> Result<Vec<AgentId>, DecodeError> {
    AgentIdViews::new(ids)
        .map(|agent| agent.to_owned())
        .collect()
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
        UserDefined::Pair(name, value) => (
            without_x(&name.as_str()).to_owned(),
            value.as_str().into_owned(),
        ),
        UserDefined::Joined(text) => {
            let text = text.as_str();
            let (name, value) = text.split_once(' ').unwrap_or((&text, ""));
            (without_x(name).to_owned(), value.to_owned())
        }
    }
}
