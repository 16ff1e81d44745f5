//! A reader of the parts of a bit-efficient envelope (FIPA00088). It checks and borrows them.
//!
//! The reader accepts these deviations:
//!
//! * any length of an envelope: fipa_services writes wrong ones, and the structure determines the
//!   end;
//! * the code that JADE writes in front of the stamp of an extension;
//! * the code that fipa_services writes in front of a number;
//! * strings in every form.

use crate::bitefficient::code;
use crate::bitefficient::notes::{self, NoNotes, Notes};
use crate::bitefficient::reader::{Reader, digit_chars};
use crate::bitefficient::without_x;
use crate::envelope::agent_id::{agent_id, agent_ids, user_defined_name};
use crate::envelope::parts::{
    AclRepresentationView, Event, Events, Parameter, Part, ReceivedView, StampParts, UserDefined,
};
use crate::error::{DecodeError, Problem};
use crate::view::AgentIdView;
use crate::word::is_token;
use crate::{AclRepresentation, AgentId, Representation, Text};

const CLAUSE: &str = "FIPA00088 MessageEnvelope";
const DATE: &str = "FIPA00069 2.2 BinDateTimeToken";

/// Maximum number of extension envelopes that the reader accepts.
const MAX_EXTENSIONS: usize = 1024;

/// A pull parser of a bit-efficient envelope.
#[derive(Debug, Clone)]
pub(super) struct EnvelopeReader<'a, N = NoNotes> {
    reader: Reader<'a, N>,
    state: ReaderState,
    extensions: usize,
}

#[derive(Debug, Clone, Copy)]
enum ReaderState {
    BetweenParts,
    InExtension,
    InBase,
    Ended,
}

impl<'a> EnvelopeReader<'a> {
    pub(super) fn new(bytes: &'a [u8]) -> Self {
        Self::noting(bytes, NoNotes)
    }
}

impl<'a, N: Notes> EnvelopeReader<'a, N> {
    /// Creates a reader that notes the meaning of every byte.
    pub(super) fn noting(bytes: &'a [u8], notes: N) -> Self {
        Self {
            reader: Reader::noting(bytes, 0, notes),
            state: ReaderState::BetweenParts,
            extensions: 0,
        }
    }

    fn begin_part(&mut self) -> Result<Event<'a>, DecodeError> {
        let part = part(&mut self.reader)?;
        self.state = match part {
            Part::Extension(_) => ReaderState::InExtension,
            Part::Base(..) | Part::Params { .. } => ReaderState::InBase,
        };
        self.extensions += 1;
        if self.extensions > MAX_EXTENSIONS + 1 {
            let problem = Problem::TooDeep("extension envelopes");
            return Err(self.reader.error(CLAUSE, problem));
        }
        Ok(Event::Part(part))
    }
}

impl<'a, N: Notes> Events<'a> for EnvelopeReader<'a, N> {
    fn position(&self) -> usize {
        self.reader.position()
    }

    #[inline]
    fn next(&mut self) -> Result<Option<Event<'a>>, DecodeError> {
        loop {
            match self.state {
                ReaderState::BetweenParts => return self.begin_part().map(Some),
                ReaderState::InExtension | ReaderState::InBase => {
                    if let Some(parameter) = parameter(&mut self.reader)? {
                        return Ok(Some(Event::Parameter(parameter)));
                    }
                    let (next, end) = match self.state {
                        ReaderState::InExtension => {
                            (ReaderState::BetweenParts, "end of extension envelope")
                        }
                        _ => (ReaderState::Ended, "end of base envelope"),
                    };
                    self.state = next;
                    let offset = self.reader.offset();
                    self.reader.notes().shallower();
                    self.reader.notes().note_envelope_end(offset, end);
                }
                ReaderState::Ended => return Ok(None),
            }
        }
    }
}

/// Reads the header of a part.
fn part<'a, N: Notes>(reader: &mut Reader<'a, N>) -> Result<Part<'a>, DecodeError> {
    let id = reader.byte(CLAUSE, "an envelope")?;
    if !matches!(id, code::envelope::EXTENSION | code::envelope::BASE) {
        return Err(not_bit_efficient(reader, id));
    }
    let is_extension = id == code::envelope::EXTENSION;
    reader.note(|| {
        let part = if is_extension { "extension" } else { "base" };
        format!("{part} envelope")
    });
    // FIPA00088 2.4, note 1: "the sender sets the reserved envelope length parameter (two bytes) to
    // length zero and the following four bytes are used to represent the real length".
    let mut len = reader.u16_len("FIPA00088 EnvLen")?;
    if len == 0 {
        len = reader.u32_len("FIPA00088 EnvLen")?;
    }
    let offset = reader.offset();
    reader.notes().note_envelope_len(offset, len);
    reader.notes().deeper();
    if is_extension {
        // JADE writes the code of a stamp here.
        if reader.take_if(code::envelope::RECEIVED) {
            reader.note(|| "the code of a stamp, as JADE writes it".to_owned());
        }
        return Ok(Part::Extension(received(reader)?));
    }
    let representation = acl_representation(reader)?;
    let date = reader.date_time(DATE)?;
    reader.note(|| notes::date("date", date));
    Ok(Part::Base(representation, date))
}

/// Reads the next parameter. Returns `None` at the end of the part.
fn parameter<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
) -> Result<Option<Parameter<'a>>, DecodeError> {
    const CLAUSE: &str = "FIPA00088 Parameter";
    Ok(Some(match reader.byte(CLAUSE, "an envelope")? {
        code::envelope::USER_DEFINED => Parameter::UserDefined(user_defined(reader)?),
        code::END => return Ok(None),
        code::envelope::TO => Parameter::To(agent_ids(reader, "to")?),
        code::envelope::FROM => Parameter::From(from(reader)?),
        code::envelope::ACL_REPRESENTATION => {
            Parameter::AclRepresentation(acl_representation(reader)?)
        }
        code::envelope::COMMENTS => Parameter::Comments(text(reader, CLAUSE, "comments")?),
        code::envelope::PAYLOAD_LENGTH => Parameter::PayloadLength(payload_length(reader)?),
        code::envelope::PAYLOAD_ENCODING => {
            Parameter::PayloadEncoding(text(reader, CLAUSE, "payload-encoding")?)
        }
        code::envelope::INTENDED_RECEIVER => {
            Parameter::IntendedReceivers(agent_ids(reader, "intended-receiver")?)
        }
        code::envelope::RECEIVED => Parameter::Received(received(reader)?),
        code::envelope::TRANSPORT_BEHAVIOR => {
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
        Some(code::representation::BIT_EFFICIENT) => Representation::BitEfficient,
        Some(code::representation::STRING) => Representation::String,
        Some(code::representation::XML) => Representation::Xml,
        // JADE writes and reads a name without the code.
        _ => {
            reader.take_if(code::representation::NAMED);
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
    // fipa_services writes the code of a number here. As digits, the codes would be "01" and "02",
    // and no peer writes leading zeros.
    let tagged = reader.take_if(code::token::NUMBER) || reader.take_if(code::token::HEX_NUMBER);
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
        parts: StampParts::BitEfficient(&[]),
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
                view.parts = StampParts::BitEfficient(rest);
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
    Ok(Some(match reader.byte(CLAUSE, "a stamp")? {
        code::stamp::USER_DEFINED => ReceivedPart::UserDefined(user_defined(reader)?),
        code::END => return Ok(None),
        code::stamp::FROM => ReceivedPart::From(text(reader, CLAUSE, "received-from")?),
        code::stamp::ID => ReceivedPart::Id(text(reader, CLAUSE, "received-id")?),
        code::stamp::VIA => ReceivedPart::Via(text(reader, CLAUSE, "received-via")?),
        other => return Err(reader.unexpected(CLAUSE, other, "a part of a stamp")),
    }))
}

fn user_defined<'a, N: Notes>(reader: &mut Reader<'a, N>) -> Result<UserDefined<'a>, DecodeError> {
    const CLAUSE: &str = "FIPA00088 user-defined";
    let mut ahead = reader.ahead();
    let first = ahead.string(CLAUSE, "user-defined name")?;
    // A name has no blank. JADE writes name, blank and value in one string.
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

/// Reads an `Any`, which must be text.
pub(super) fn any<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
    what: &'static str,
) -> Result<Text<'a>, DecodeError> {
    const CLAUSE: &str = "FIPA00088 Any";
    let len = match reader.byte(CLAUSE, what)? {
        code::token::STRING => return reader.string(CLAUSE, what),
        code::token::LEN8 => reader.u8_len(CLAUSE)?,
        code::token::LEN16 => reader.u16_len(CLAUSE)?,
        code::token::LEN32 => reader.u32_len(CLAUSE)?,
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
