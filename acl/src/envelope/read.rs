//! Reading the parts of a bit-efficient envelope (FIPA00088), checked and borrowed.
//!
//! What is lenient here: lengths of envelopes are passed over (fipa_services writes wrong ones,
//! and structure says it all); the tag that JADE writes in front of a stamp; the tags that
//! fipa_services writes in front of numbers; strings in every form.

use crate::bitefficient::notes::{self, Notes, Silent};
use crate::bitefficient::reader::{Reader, digit_chars};
use crate::bitefficient::without_x;
use crate::envelope::agent_id::{agent_id, agent_ids, user_defined_name};
use crate::envelope::parts::{
    AclRepresentationView, Event, Events, Parameter, Part, ReceivedView, Stamp, UserDefined,
};
use crate::error::{DecodeError, Problem};
use crate::view::AgentIdView;
use crate::word::is_token;
use crate::{AclRepresentation, AgentId, Representation, Text};

const CLAUSE: &str = "FIPA00088 MessageEnvelope";
const DATE: &str = "FIPA00069 2.3 BinDateTime";

/// Most extension envelopes that are accepted in front of a base.
const MAX_EXTENSIONS: usize = 1024;

/// A walk through an envelope, part by part.
#[derive(Debug, Clone)]
pub(super) struct Walk<'a, N = Silent> {
    reader: Reader<'a, N>,
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

impl<'a> Walk<'a> {
    pub(super) fn new(bytes: &'a [u8]) -> Self {
        Self::noting(bytes, Silent)
    }
}

impl<'a, N: Notes> Walk<'a, N> {
    /// A walk that tells `notes` what every byte means.
    pub(super) fn noting(bytes: &'a [u8], notes: N) -> Self {
        Self {
            reader: Reader::noting(bytes, 0, notes),
            place: Place::BetweenParts,
            extensions: 0,
        }
    }

    fn begin_part(&mut self) -> Result<Event<'a>, DecodeError> {
        let part = part(&mut self.reader)?;
        self.place = match part {
            Part::Extension(_) => Place::InExtension,
            Part::Base(..) | Part::Params { .. } => Place::InBase,
        };
        self.extensions += 1;
        if self.extensions > MAX_EXTENSIONS + 1 {
            let problem = Problem::TooDeep("extension envelopes");
            return Err(self.reader.error(CLAUSE, problem));
        }
        Ok(Event::Part(part))
    }
}

impl<'a, N: Notes> Events<'a> for Walk<'a, N> {
    fn position(&self) -> usize {
        self.reader.position()
    }

    #[inline]
    fn next(&mut self) -> Result<Option<Event<'a>>, DecodeError> {
        loop {
            match self.place {
                Place::BetweenParts => return self.begin_part().map(Some),
                Place::InExtension | Place::InBase => {
                    if let Some(parameter) = parameter(&mut self.reader)? {
                        return Ok(Some(Event::Parameter(parameter)));
                    }
                    let (next, end) = match self.place {
                        Place::InExtension => (Place::BetweenParts, "end of extension envelope"),
                        _ => (Place::Behind, "end of base envelope"),
                    };
                    self.place = next;
                    let offset = self.reader.offset();
                    self.reader.notes().shallower();
                    self.reader.notes().note_envelope_end(offset, end);
                }
                Place::Behind => return Ok(None),
            }
        }
    }
}

/// Reads what every part begins with.
fn part<'a, N: Notes>(reader: &mut Reader<'a, N>) -> Result<Part<'a>, DecodeError> {
    let id = reader.byte(CLAUSE, "an envelope")?;
    if !matches!(id, 0xfd | 0xfe) {
        return Err(not_bit_efficient(reader, id));
    }
    reader.note(|| {
        let part = if id == 0xfd { "extension" } else { "base" };
        format!("{part} envelope")
    });
    // The length. Two bytes of zero announce one of four.
    let mut len = reader.u16_len("FIPA00088 EnvLen")?;
    if len == 0 {
        len = reader.u32_len("FIPA00088 EnvLen")?;
    }
    let offset = reader.offset();
    reader.notes().note_envelope_len(offset, len);
    reader.notes().deeper();
    if id == 0xfd {
        // JADE writes the tag of a stamp here.
        if reader.take_if(0x0a) {
            reader.note(|| "the code of a stamp, as JADE writes it".to_owned());
        }
        return Ok(Part::Extension(received(reader)?));
    }
    let representation = acl_representation(reader)?;
    let date = reader.date_time(DATE)?;
    reader.note(|| notes::date("date", date));
    Ok(Part::Base(representation, date))
}

/// The next parameter, or `None` at the end of the part.
fn parameter<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
) -> Result<Option<Parameter<'a>>, DecodeError> {
    const CLAUSE: &str = "FIPA00088 Parameter";
    let code = reader.byte(CLAUSE, "an envelope")?;
    Ok(Some(match code {
        0x00 => Parameter::UserDefined(user_defined(reader)?),
        0x01 => return Ok(None),
        0x02 => Parameter::To(agent_ids(reader, "to")?),
        0x03 => Parameter::From(from(reader)?),
        0x04 => Parameter::AclRepresentation(acl_representation(reader)?),
        0x05 => Parameter::Comments(text(reader, CLAUSE, "comments")?),
        0x06 => Parameter::PayloadLength(payload_length(reader)?),
        0x07 => Parameter::PayloadEncoding(text(reader, CLAUSE, "payload-encoding")?),
        0x09 => {
            let set = "intended-receiver";
            Parameter::IntendedReceivers(agent_ids(reader, set)?)
        }
        0x0a => Parameter::Received(received(reader)?),
        0x0b => {
            let text = any(reader, "transport-behaviour")?;
            reader.note(|| notes::named("transport-behaviour", &text));
            Parameter::TransportBehaviour(text)
        }
        other => return Err(reader.unexpected(CLAUSE, other, "a parameter of an envelope")),
    }))
}

fn from<'a, N: Notes>(reader: &mut Reader<'a, N>) -> Result<AgentIdView<'a>, DecodeError> {
    reader.note(|| "from".to_owned());
    reader.notes().deeper();
    let from = agent_id(reader, AgentId::MAX_DEPTH)?;
    reader.notes().shallower();
    Ok(from)
}

#[inline]
fn text<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
    clause: &'static str,
    what: &'static str,
) -> Result<Text<'a>, DecodeError> {
    let text = reader.string(clause, what)?;
    reader.note(|| notes::named(what, &text));
    Ok(text)
}

fn acl_representation<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
) -> Result<AclRepresentationView<'a>, DecodeError> {
    const CLAUSE: &str = "FIPA00088 ACLRepresentation";
    let standard = match reader.peek() {
        Some(0x10) => Representation::BitEfficient,
        Some(0x11) => Representation::String,
        Some(0x12) => Representation::Xml,
        // JADE writes and reads a name without the code.
        _ => {
            reader.take_if(0x00);
            let name = text(reader, CLAUSE, "acl-representation")?;
            return Ok(AclRepresentationView::Named(name));
        }
    };
    reader.skip_peeked();
    reader.note(|| {
        let name = AclRepresentation::from(standard);
        format!("acl-representation: {name}")
    });
    Ok(AclRepresentationView::Standard(standard))
}

fn payload_length<N: Notes>(reader: &mut Reader<'_, N>) -> Result<u64, DecodeError> {
    const CLAUSE: &str = "FIPA00088 payload-length";
    // As digits these would be a zero in front, which nobody writes: they are the tags that
    // fipa_services puts there.
    let tagged = reader.take_if(0x12) || reader.take_if(0x13);
    let offset = reader.offset();
    let number = digit_chars(reader.digits(CLAUSE)?).try_fold(None, |number: Option<u64>, char| {
        let digit = char.and_then(|char| char.to_digit(10))?;
        let number = number.unwrap_or(0).checked_mul(10)?;
        Some(Some(number.checked_add(u64::from(digit))?))
    });
    let len = number
        .flatten()
        .ok_or_else(|| DecodeError::new(offset, CLAUSE, Problem::Number))?;
    reader.note(|| {
        let written = if tagged {
            ", with the code of a number in front (fipa_services)"
        } else {
            ""
        };
        format!("payload-length: {len}{written}")
    });
    Ok(len)
}

fn received<'a, N: Notes>(reader: &mut Reader<'a, N>) -> Result<ReceivedView<'a>, DecodeError> {
    const CLAUSE: &str = "FIPA00088 ReceivedObject";
    let by = reader.string(CLAUSE, "received-by")?;
    reader.note(|| format!("received: by {}", notes::text(&by)));
    reader.notes().deeper();
    let date = reader.date_time(DATE)?;
    reader.note(|| notes::date("date", date));
    let mut view = ReceivedView {
        by,
        date,
        from: None,
        id: None,
        via: None,
        rest: Stamp::BitEfficient(&[]),
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
                reader.notes().shallower();
                reader.note(|| "end of received".to_owned());
                view.rest = Stamp::BitEfficient(rest);
                return Ok(view);
            }
        }
    }
}

pub(super) enum ReceivedPart<'a> {
    From(Text<'a>),
    Id(Text<'a>),
    Via(Text<'a>),
    UserDefined(UserDefined<'a>),
}

pub(super) fn received_part<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
) -> Result<Option<ReceivedPart<'a>>, DecodeError> {
    const CLAUSE: &str = "FIPA00088 ReceivedObject";
    let code = reader.byte(CLAUSE, "a stamp")?;
    Ok(Some(match code {
        0x00 => ReceivedPart::UserDefined(user_defined(reader)?),
        0x01 => return Ok(None),
        0x02 => ReceivedPart::From(text(reader, CLAUSE, "received-from")?),
        0x03 => ReceivedPart::Id(text(reader, CLAUSE, "received-id")?),
        0x04 => ReceivedPart::Via(text(reader, CLAUSE, "received-via")?),
        other => return Err(reader.unexpected(CLAUSE, other, "a part of a stamp")),
    }))
}

fn user_defined<'a, N: Notes>(reader: &mut Reader<'a, N>) -> Result<UserDefined<'a>, DecodeError> {
    const CLAUSE: &str = "FIPA00088 user-defined";
    let mut ahead = reader.ahead();
    let first = ahead.string(CLAUSE, "user-defined name")?;
    // A name has no blank: with one, it is name and value in one string, as JADE writes it.
    if let Some(blank) = memchr::memchr(b' ', first.raw())
        && first.raw().get(..blank).is_some_and(is_token)
    {
        reader.follow(&ahead);
        reader.note(|| {
            let text = first.as_str();
            let (name, value) = text.split_once(' ').unwrap_or_default();
            let name = Text::plain(without_x(name.as_bytes()));
            let (name, value) = (notes::quoted(&name.as_str()), notes::quoted(value));
            format!("user-defined parameter {name}: {value}, in one string as JADE writes it")
        });
        return Ok(UserDefined::Joined(first));
    }
    let name = user_defined_name(reader, CLAUSE)?;
    let value = reader.string(CLAUSE, "user-defined value")?;
    reader.note(|| notes::user_defined(&name, &value));
    Ok(UserDefined::Pair(name.without_x(), value))
}

/// Reads an `Any`, which has to be text.
pub(super) fn any<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
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
    reader.counted(len, CLAUSE, what).map(Text::plain)
}

#[cold]
fn not_bit_efficient<N: Notes>(reader: &Reader<'_, N>, found: u8) -> DecodeError {
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
