//! Reading the parts of a bit-efficient envelope (FIPA00088), checked and borrowed.
//!
//! What is lenient here: lengths of envelopes are passed over (fipa_services writes wrong ones,
//! and structure says it all); the tag that JADE writes in front of a stamp; the tags that
//! fipa_services writes in front of numbers; strings in every form.

use crate::AgentId;
use crate::bitefficient::Text;
use crate::bitefficient::reader::{Reader, digit_chars, utf8};
use crate::envelope::agent_id::{AgentIdView, agent_id, agent_ids, user_defined_name};
use crate::error::{DecodeError, Problem};
use crate::word::is_token;
use crate::{AclRepresentation, Representation, Time};

const CLAUSE: &str = "FIPA00088 MessageEnvelope";
const DATE: &str = "FIPA00069 2.3 BinDateTime";

/// Most extension envelopes that are accepted in front of a base.
const MAX_EXTENSIONS: usize = 1024;

/// One of the envelopes that an envelope consists of.
#[derive(Debug, Clone, Copy)]
pub(super) enum Part<'a> {
    /// An extension, with the stamp it begins with.
    Extension(ReceivedView<'a>),
    /// The base, which is the last one.
    Base(AclRepresentationView<'a>, Time),
}

#[derive(Debug, Clone, Copy)]
pub(super) enum AclRepresentationView<'a> {
    Standard(Representation),
    Named(Text<'a>),
}

impl AclRepresentationView<'_> {
    pub(super) fn to_owned(self) -> AclRepresentation {
        match self {
            Self::Standard(representation) => representation.into(),
            Self::Named(name) => AclRepresentation::from(&*name.as_str()),
        }
    }
}

#[derive(Debug, Clone, Copy)]
pub(super) struct ReceivedView<'a> {
    pub(super) by: Text<'a>,
    pub(super) date: Time,
    pub(super) from: Option<Text<'a>>,
    pub(super) id: Option<Text<'a>>,
    pub(super) via: Option<Text<'a>>,
    /// User-defined parameters, and what stands between them.
    pub(super) rest: &'a [u8],
}

#[derive(Debug, Clone, Copy)]
pub(super) enum Parameter<'a> {
    To(&'a [u8]),
    From(AgentIdView<'a>),
    AclRepresentation(AclRepresentationView<'a>),
    Comments(Text<'a>),
    PayloadLength(u64),
    PayloadEncoding(Text<'a>),
    IntendedReceivers(&'a [u8]),
    Received(ReceivedView<'a>),
    TransportBehaviour(Text<'a>),
    UserDefined(UserDefined<'a>),
}

#[derive(Debug, Clone, Copy)]
pub(super) enum UserDefined<'a> {
    Pair(Text<'a>, Text<'a>),
    /// Name, a blank, value (JADE).
    Joined(Text<'a>),
}

/// A walk through an envelope, part by part.
#[derive(Debug, Clone)]
pub(super) struct Walk<'a> {
    reader: Reader<'a>,
    place: Place,
    extensions: usize,
}

#[derive(Debug, Clone, Copy)]
enum Place {
    BetweenParts,
    InExtension,
    InBase,
    Behind,
}

/// What a [`Walk`] comes by.
#[derive(Debug)]
pub(super) enum Event<'a> {
    /// A new part begins.
    Part(Part<'a>),
    /// A parameter of the part that began last.
    Parameter(Parameter<'a>),
}

impl<'a> Walk<'a> {
    pub(super) fn new(bytes: &'a [u8]) -> Self {
        Self {
            reader: Reader::new(bytes),
            place: Place::BetweenParts,
            extensions: 0,
        }
    }

    /// How many bytes were walked through: behind the base, the length of the envelope.
    pub(super) fn position(&self) -> usize {
        self.reader.position()
    }

    /// The next thing, or `None` behind the base.
    #[inline]
    pub(super) fn next(&mut self) -> Result<Option<Event<'a>>, DecodeError> {
        loop {
            match self.place {
                Place::BetweenParts => return self.begin_part().map(Some),
                Place::InExtension | Place::InBase => {
                    if let Some(parameter) = parameter(&mut self.reader)? {
                        return Ok(Some(Event::Parameter(parameter)));
                    }
                    self.place = match self.place {
                        Place::InExtension => Place::BetweenParts,
                        _ => Place::Behind,
                    };
                }
                Place::Behind => return Ok(None),
            }
        }
    }

    fn begin_part(&mut self) -> Result<Event<'a>, DecodeError> {
        let part = part(&mut self.reader)?;
        self.place = match part {
            Part::Base(..) => Place::InBase,
            Part::Extension(_) => Place::InExtension,
        };
        self.extensions += 1;
        if self.extensions > MAX_EXTENSIONS + 1 {
            let problem = Problem::TooDeep("extension envelopes");
            return Err(self.reader.error(CLAUSE, problem));
        }
        Ok(Event::Part(part))
    }
}

/// Reads what every part begins with.
fn part<'a>(reader: &mut Reader<'a>) -> Result<Part<'a>, DecodeError> {
    let id = reader.byte(CLAUSE, "an envelope")?;
    if !matches!(id, 0xfd | 0xfe) {
        return Err(not_bit_efficient(reader, id));
    }
    // The length. Two bytes of zero announce one of four.
    if reader.u16_len("FIPA00088 EnvLen")? == 0 {
        reader.u32_len("FIPA00088 EnvLen")?;
    }
    if id == 0xfd {
        // JADE writes the tag of a stamp here.
        reader.take_if(0x0a);
        return Ok(Part::Extension(received(reader)?));
    }
    let representation = acl_representation(reader)?;
    Ok(Part::Base(representation, reader.date_time(DATE)?))
}

/// The next parameter, or `None` at the end of the part.
fn parameter<'a>(reader: &mut Reader<'a>) -> Result<Option<Parameter<'a>>, DecodeError> {
    const CLAUSE: &str = "FIPA00088 Parameter";
    let code = reader.byte(CLAUSE, "an envelope")?;
    Ok(Some(match code {
        0x00 => Parameter::UserDefined(user_defined(reader)?),
        0x01 => return Ok(None),
        0x02 => Parameter::To(agent_ids(reader, AgentId::MAX_DEPTH)?),
        0x03 => Parameter::From(agent_id(reader, AgentId::MAX_DEPTH)?),
        0x04 => Parameter::AclRepresentation(acl_representation(reader)?),
        0x05 => Parameter::Comments(reader.string(CLAUSE, "comments")?),
        0x06 => Parameter::PayloadLength(payload_length(reader)?),
        0x07 => Parameter::PayloadEncoding(reader.string(CLAUSE, "payload-encoding")?),
        0x09 => Parameter::IntendedReceivers(agent_ids(reader, AgentId::MAX_DEPTH)?),
        0x0a => Parameter::Received(received(reader)?),
        0x0b => Parameter::TransportBehaviour(any(reader, "transport-behaviour")?),
        other => return Err(reader.unexpected(CLAUSE, other, "a parameter of an envelope")),
    }))
}

fn acl_representation<'a>(
    reader: &mut Reader<'a>,
) -> Result<AclRepresentationView<'a>, DecodeError> {
    const CLAUSE: &str = "FIPA00088 ACLRepresentation";
    let standard = match reader.peek() {
        Some(0x10) => Representation::BitEfficient,
        Some(0x11) => Representation::String,
        Some(0x12) => Representation::Xml,
        // JADE writes and reads a name without the code.
        _ => {
            reader.take_if(0x00);
            let name = reader.string(CLAUSE, "acl-representation")?;
            return Ok(AclRepresentationView::Named(name));
        }
    };
    reader.skip_peeked();
    Ok(AclRepresentationView::Standard(standard))
}

fn payload_length(reader: &mut Reader<'_>) -> Result<u64, DecodeError> {
    const CLAUSE: &str = "FIPA00088 payload-length";
    // As digits these would be a zero in front, which nobody writes: they are the tags that
    // fipa_services puts there.
    if !reader.take_if(0x12) {
        reader.take_if(0x13);
    }
    let offset = reader.offset();
    let number = digit_chars(reader.digits(CLAUSE)?).try_fold(None, |number: Option<u64>, char| {
        let digit = char.and_then(|char| char.to_digit(10))?;
        let number = number.unwrap_or(0).checked_mul(10)?;
        Some(Some(number.checked_add(u64::from(digit))?))
    });
    number
        .flatten()
        .ok_or_else(|| DecodeError::new(offset, CLAUSE, Problem::Number))
}

fn received<'a>(reader: &mut Reader<'a>) -> Result<ReceivedView<'a>, DecodeError> {
    const CLAUSE: &str = "FIPA00088 ReceivedObject";
    let mut view = ReceivedView {
        by: reader.string(CLAUSE, "received-by")?,
        date: reader.date_time(DATE)?,
        from: None,
        id: None,
        via: None,
        rest: &[],
    };
    let start = reader.position();
    loop {
        let rest = reader.since(start);
        match received_part(reader)? {
            Some(ReceivedPart::From(text)) => view.from = Some(text),
            Some(ReceivedPart::Id(text)) => view.id = Some(text),
            Some(ReceivedPart::Via(text)) => view.via = Some(text),
            Some(ReceivedPart::UserDefined(_)) => {}
            None => {
                view.rest = rest;
                return Ok(view);
            }
        }
    }
}

enum ReceivedPart<'a> {
    From(Text<'a>),
    Id(Text<'a>),
    Via(Text<'a>),
    UserDefined(UserDefined<'a>),
}

fn received_part<'a>(reader: &mut Reader<'a>) -> Result<Option<ReceivedPart<'a>>, DecodeError> {
    const CLAUSE: &str = "FIPA00088 ReceivedObject";
    let code = reader.byte(CLAUSE, "a stamp")?;
    Ok(Some(match code {
        0x00 => ReceivedPart::UserDefined(user_defined(reader)?),
        0x01 => return Ok(None),
        0x02 => ReceivedPart::From(reader.string(CLAUSE, "received-from")?),
        0x03 => ReceivedPart::Id(reader.string(CLAUSE, "received-id")?),
        0x04 => ReceivedPart::Via(reader.string(CLAUSE, "received-via")?),
        other => return Err(reader.unexpected(CLAUSE, other, "a part of a stamp")),
    }))
}

impl<'a> ReceivedView<'a> {
    /// The user-defined parameters of the stamp.
    pub(super) fn user_defined(&self) -> impl Iterator<Item = UserDefined<'a>> + use<'a> {
        let mut reader = Reader::new(self.rest);
        // An error cannot occur in checked bytes, and would end the list.
        std::iter::from_fn(move || {
            while reader.remaining() > 0 {
                if let ReceivedPart::UserDefined(found) = received_part(&mut reader).ok()?? {
                    return Some(found);
                }
            }
            None
        })
    }
}

fn user_defined<'a>(reader: &mut Reader<'a>) -> Result<UserDefined<'a>, DecodeError> {
    const CLAUSE: &str = "FIPA00088 user-defined";
    let mut ahead = reader.clone();
    let first = ahead.string(CLAUSE, "user-defined name")?;
    // A name has no blank: with one, it is name and value in one string, as JADE writes it.
    if let Some((name, _)) = first.raw().split_once(' ')
        && is_token(name)
    {
        *reader = ahead;
        return Ok(UserDefined::Joined(first));
    }
    let name = user_defined_name(reader, CLAUSE)?;
    Ok(UserDefined::Pair(
        name,
        reader.string(CLAUSE, "user-defined value")?,
    ))
}

/// Reads an `Any`, which has to be text.
pub(super) fn any<'a>(
    reader: &mut Reader<'a>,
    what: &'static str,
) -> Result<Text<'a>, DecodeError> {
    const CLAUSE: &str = "FIPA00088 Any";
    let len = match reader.byte(CLAUSE, what)? {
        0x14 => return reader.string(CLAUSE, what),
        0x16 => reader.u8_len(CLAUSE)?,
        0x17 => reader.u16_len(CLAUSE)?,
        0x19 => reader.u32_len(CLAUSE)?,
        other => return Err(reader.unexpected(CLAUSE, other, "a value")),
    };
    let offset = reader.offset();
    let bytes = reader.bytes(len, CLAUSE, what)?;
    if memchr::memchr(0, bytes).is_some() {
        return Err(DecodeError::new(offset, CLAUSE, Problem::Nul(what)));
    }
    utf8(bytes, offset, CLAUSE, what).map(Text::plain)
}

#[cold]
fn not_bit_efficient(reader: &Reader<'_>, found: u8) -> DecodeError {
    if reader.offset() > 1 {
        return reader.unexpected(CLAUSE, found, "the base envelope or another extension");
    }
    let problem = match Representation::detect(&[found]) {
        Some(other @ Representation::Xml) => Problem::UnsupportedRepresentation(other),
        _ => Problem::Unexpected {
            found,
            expected: "an envelope",
        },
    };
    DecodeError::new(0, CLAUSE, problem)
}
