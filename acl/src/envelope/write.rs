//! Writing bit-efficient envelopes.
//!
//! The standard's dialect follows the examples of FIPA00088: texts without quotation marks, the
//! newest extension first, correct lengths. fipa_services and JADE cannot read each other's
//! envelopes: fipa_services requires a byte count in front of every text, a code in front of numbers
//! and the oldest extension first. JADE reads a byte count as part of the text.

use std::ops::Range;

use bytes::Bytes;

use crate::bitefficient::code;
use crate::bitefficient::reader::{Form, string_form};
use crate::bitefficient::without_x;
use crate::bitefficient::write::{
    Output, TAIL, TextWriter, append_head, head_len, write_agent_id_by, write_agent_set_by,
    write_date_time, write_digits, write_local_date_time,
};
use crate::dialect::local_time;
use crate::envelope::present;
use crate::error::EncodeError;
use crate::word::{self, is_token};
use crate::{
    AclRepresentation, AgentId, Dialect, Envelope, EnvelopeParams, Letter, Message, Payload,
    Received, Time,
};

const BASE: &str = "a base envelope";
const EXTENSION: &str = "an extension envelope";

/// Encodes the envelope with all extensions in a dialect.
///
/// # Errors
/// A mandatory parameter is missing, or the dialect cannot represent a value.
pub(crate) fn encode(envelope: &Envelope, dialect: Dialect) -> Result<Bytes, EncodeError> {
    let mut writer = Writer::new(dialect);
    if dialect == Dialect::FipaServices {
        for extension in &envelope.extensions {
            writer.extension(extension)?;
        }
    } else {
        for extension in envelope.extensions.iter().rev() {
            writer.extension(extension)?;
        }
    }
    writer.base(&envelope.base)?;
    Ok(writer.out.into())
}

impl Envelope {
    /// Encodes the envelope with all extensions bit-efficiently (FIPA00088) in the standard's
    /// dialect.
    ///
    /// # Errors
    /// A mandatory parameter is missing, or the encoding cannot represent a value. A base needs
    /// `acl_representation` and `date`. An extension needs `received` and cannot have a `date`.
    pub fn encode_standard(&self) -> Result<Bytes, EncodeError> {
        encode(self, Dialect::Standard)
    }

    /// Encodes one extension envelope bit-efficiently (FIPA00088) in the standard's dialect.
    /// [`Letter::stamped`](crate::Letter::stamped) adds it to a letter.
    ///
    /// # Errors
    /// `received` is missing, `date` is set, or the encoding cannot represent a value.
    pub fn encode_extension(params: &EnvelopeParams) -> Result<Bytes, EncodeError> {
        let mut writer = Writer::new(Dialect::Standard);
        writer.extension(params)?;
        Ok(writer.out.into())
    }
}

impl Message {
    /// Encodes the message as a new letter: a bit-efficient message (FIPA00069) in a bit-efficient
    /// envelope (FIPA00088), both in the standard's dialect.
    ///
    /// The receivers of the message become `to` and `intended-receiver` of the envelope, and `date`
    /// its date. Envelope and message share one allocation. The content is shared, not copied.
    ///
    /// # Errors
    /// The envelope cannot represent a value.
    pub fn to_letter(&self, date: Time) -> Result<Letter, EncodeError> {
        EnvelopeTemplate::default().letter_of(self, date, false)
    }

    /// Encodes the message as a new letter, as [`to_letter`](Self::to_letter) does, around content of
    /// `content_len` bytes. [`Letter::with_content`] adds the content.
    ///
    /// This is for content that the application writes in place. The content of the message itself
    /// is ignored.
    ///
    /// # Errors
    /// `content_len` exceeds [`Message::MAX_CONTENT`], or the envelope cannot represent a value.
    pub fn to_letter_around(&self, content_len: usize, date: Time) -> Result<Letter, EncodeError> {
        EnvelopeTemplate::default().letter_around(self, content_len, date, false)
    }
}

/// The envelope of the latest letter that was encoded with it.
///
/// Most letters of an agent have the receivers of its letter before. Their envelopes differ in the date
/// and in the payload length, and are copied.
#[derive(Debug, Default)]
pub struct EnvelopeTemplate {
    sender: Option<AgentId>,
    receivers: Vec<AgentId>,
    /// Empty before the first letter.
    envelope: Vec<u8>,
    /// The date of the envelope, and its place there.
    date: Option<(Time, Range<usize>)>,
    /// The payload length of the envelope, and its place there.
    payload_length: (u64, Range<usize>),
    /// Length of the letter without its content.
    frame_len: usize,
}

/// Maximum length of an envelope that is kept, in bytes.
const MAX_TEMPLATE: usize = 512;

impl EnvelopeTemplate {
    /// Encodes a message as [`Message::to_letter`] does.
    ///
    /// # Errors
    /// See [`Message::to_letter`].
    pub fn to_letter(&mut self, message: &Message, date: Time) -> Result<Letter, EncodeError> {
        self.letter_of(message, date, true)
    }

    /// Encodes a message as [`Message::to_letter_around`] does.
    ///
    /// # Errors
    /// See [`Message::to_letter_around`].
    pub fn to_letter_around(
        &mut self,
        message: &Message,
        content_len: usize,
        date: Time,
    ) -> Result<Letter, EncodeError> {
        self.letter_around(message, content_len, date, true)
    }

    fn letter_of(
        &mut self,
        message: &Message,
        date: Time,
        is_kept: bool,
    ) -> Result<Letter, EncodeError> {
        let content = message.content.clone();
        let letter = self.enclose(message, content.as_ref().map(Bytes::len), date, is_kept)?;
        Ok(match content {
            Some(content) => letter.with_content(content),
            None => letter,
        })
    }

    fn letter_around(
        &mut self,
        message: &Message,
        content_len: usize,
        date: Time,
        is_kept: bool,
    ) -> Result<Letter, EncodeError> {
        if content_len as u64 > Message::MAX_CONTENT {
            return Err(EncodeError::ContentTooLong(content_len));
        }
        self.enclose(message, Some(content_len), date, is_kept)
    }

    /// Encodes a letter without its content. Keeps its envelope if `is_kept`.
    fn enclose(
        &mut self,
        message: &Message,
        content_len: Option<usize>,
        date: Time,
        is_kept: bool,
    ) -> Result<Letter, EncodeError> {
        if let Some(letter) = self.copy(message, content_len, date) {
            return Ok(letter);
        }
        let payload_len = payload_len(head_len(message, content_len), content_len);
        let mut writer = Writer::new(Dialect::Standard);
        // Enough for names of usual length, so that the buffer rarely grows.
        let names = 96 * message.receivers.len().min(16);
        writer.out.reserve(128 + names);
        let places = writer.envelope_of(message, payload_len, date)?;
        let out = writer.out;
        let is_kept = is_kept && out.len() <= MAX_TEMPLATE;
        if is_kept {
            self.sender.clone_from(&message.sender);
            self.receivers.clone_from(&message.receivers);
            self.envelope.clone_from(&out);
            self.date = Some((date, places.0));
            self.payload_length = (payload_len, places.1);
        }
        let envelope_len = out.len();
        let out = with_head(out, message, content_len);
        if is_kept {
            self.frame_len = out.len();
        }
        Ok(framed(out, envelope_len, content_len))
    }

    /// Encodes a letter without its content, with a changed copy of the envelope. Returns `None` if
    /// sender, receivers or the length of a parameter differ.
    fn copy(
        &mut self,
        message: &Message,
        content_len: Option<usize>,
        date: Time,
    ) -> Option<Letter> {
        if self.sender != message.sender || self.receivers != message.receivers {
            return None;
        }
        let (of_envelope, place) = self.date.as_mut()?;
        if *of_envelope != date {
            let end = self.envelope.len();
            write_date_time(date, &mut self.envelope);
            if !replace(&mut self.envelope, end, place) {
                self.envelope.truncate(end);
                return None;
            }
            *of_envelope = date;
        }
        let envelope_len = self.envelope.len();
        let mut out = Vec::with_capacity(self.frame_len);
        out.slice(&self.envelope);
        let mut out = with_head(out, message, content_len);
        let head_len = out.len() - envelope_len - own_tail(content_len).len();
        let payload_len = payload_len(head_len, content_len);
        let (of_envelope, place) = &mut self.payload_length;
        if *of_envelope != payload_len {
            write_digits(payload_len, &mut self.envelope);
            if !replace(&mut self.envelope, envelope_len, place) {
                self.envelope.truncate(envelope_len);
                return None;
            }
            *of_envelope = payload_len;
            let changed = self.envelope.get(place.clone())?;
            out.get_mut(place.clone())?.copy_from_slice(changed);
        }
        self.frame_len = out.len();
        Some(framed(out, envelope_len, content_len))
    }
}

fn payload_len(head_len: usize, content_len: Option<usize>) -> u64 {
    (head_len + content_len.unwrap_or(0) + TAIL.len()) as u64
}

/// The bytes behind the content, which follow the head at once if there is no content.
fn own_tail(content_len: Option<usize>) -> &'static [u8] {
    match content_len {
        Some(_) => &[],
        None => TAIL,
    }
}

/// Appends the message without its content to its envelope.
fn with_head(mut envelope: Vec<u8>, message: &Message, content_len: Option<usize>) -> Vec<u8> {
    append_head(message, content_len, &mut envelope);
    envelope.slice(own_tail(content_len));
    envelope
}

/// A letter whose content is still missing, from its envelope and the message behind it.
fn framed(envelope_and_head: Vec<u8>, envelope_len: usize, content_len: Option<usize>) -> Letter {
    let mut envelope = Bytes::from(envelope_and_head);
    let head = envelope.split_off(envelope_len);
    let tail = match content_len {
        Some(_) => Bytes::from_static(TAIL),
        None => Bytes::new(),
    };
    let payload = Payload {
        head,
        content: Bytes::new(),
        tail,
    };
    Letter::new(envelope, payload)
}

/// Moves the bytes from `end` to this range, if they have its length.
fn replace(out: &mut Vec<u8>, end: usize, range: &Range<usize>) -> bool {
    let fits = out.len() - end == range.len() && range.end <= end;
    if fits {
        out.copy_within(end.., range.start);
        out.truncate(end);
    }
    fits
}

struct Writer {
    out: Vec<u8>,
    dialect: Dialect,
}

impl Writer {
    fn new(dialect: Dialect) -> Self {
        let out = Vec::new();
        Self { out, dialect }
    }

    /// Writes the envelope of a new letter with a bit-efficient message. Returns the positions of its
    /// date and its payload length; a longer envelope than [`MAX_TEMPLATE`] may have others.
    fn envelope_of(
        &mut self,
        message: &Message,
        payload_len: u64,
        date: Time,
    ) -> Result<(Range<usize>, Range<usize>), EncodeError> {
        let start = self.begin(code::envelope::BASE);
        self.out.byte(code::representation::BIT_EFFICIENT);
        let date_at = self.out.len();
        self.time("date", date)?;
        let to = self.out.len();
        write_agent_set_by(self, code::envelope::TO, &message.receivers)?;
        let list = to..self.out.len();
        if let Some(from) = &message.sender {
            self.out.byte(code::envelope::FROM);
            write_agent_id_by(self, from)?;
        }
        self.out.byte(code::envelope::PAYLOAD_LENGTH);
        let length_at = self.out.len();
        self.payload_length(payload_len)?;
        let intended = self.out.len();
        // The same list with another code.
        self.out.extend_from_within(list);
        if let Some(parameter) = self.out.get_mut(intended) {
            *parameter = code::envelope::INTENDED_RECEIVER;
        }
        self.out.byte(code::END);
        self.end(start)?;
        Ok((date_at..to, length_at..intended))
    }

    fn for_fipa_services(&self) -> bool {
        self.dialect == Dialect::FipaServices
    }

    fn extension(&mut self, params: &EnvelopeParams) -> Result<(), EncodeError> {
        if params.date.is_some() {
            let (parameter, of) = ("date", EXTENSION);
            return Err(EncodeError::NoPlace { parameter, of });
        }
        let start = self.begin(code::envelope::EXTENSION);
        match &params.received {
            Some(stamp) => self.received(stamp, !self.for_fipa_services())?,
            None if self.for_fipa_services() => self.no_stamp(),
            None => return Err(missing("received", EXTENSION)),
        }
        let parameters = self.out.len();
        self.parameters(params)?;
        self.out.byte(code::END);
        if self.for_fipa_services() {
            // fipa_services writes this length, which leaves out the stamp. Its reader ignores it.
            let counted = self.out.len() - parameters + 4;
            let len = u16::try_from(counted).map_err(|_| EncodeError::EnvelopeTooLong(counted))?;
            self.set_len(start, len);
            return Ok(());
        }
        self.end(start)
    }

    fn base(&mut self, params: &EnvelopeParams) -> Result<(), EncodeError> {
        let start = self.begin(code::envelope::BASE);
        let representation = params.acl_representation.as_ref();
        let representation = representation.ok_or_else(|| missing("acl-representation", BASE))?;
        self.acl_representation(representation)?;
        self.time("date", params.date.ok_or_else(|| missing("date", BASE))?)?;
        self.parameters(params)?;
        self.out.byte(code::END);
        if self.for_fipa_services() {
            // fipa_services writes this length in every base.
            self.set_len(start, 16);
            return Ok(());
        }
        self.end(start)
    }

    /// Writes the identifier of an envelope and space for its length. Returns the offset behind it.
    fn begin(&mut self, id: u8) -> usize {
        self.out.byte(id);
        self.out.slice(&[0, 0]);
        self.out.len()
    }

    /// Inserts the length of a complete envelope.
    ///
    /// FIPA00088 2.4, note 1: "The length of the envelope comprises all the parts of the envelope,
    /// including the message identifier and the length parameter itself."
    fn end(&mut self, start: usize) -> Result<(), EncodeError> {
        let len = self.out.len() - start + 3;
        if let Ok(len) = u16::try_from(len) {
            self.set_len(start, len);
            return Ok(());
        }
        let len = len + 4;
        let len = u32::try_from(len).map_err(|_| EncodeError::EnvelopeTooLong(len))?;
        self.out.splice(start..start, len.to_be_bytes());
        Ok(())
    }

    fn set_len(&mut self, start: usize, len: u16) {
        if let Some(field) = self.out.get_mut(start - 2..start) {
            field.copy_from_slice(&len.to_be_bytes());
        }
    }

    /// Writes the parameters that base and extension share, in the order of their codes.
    /// fipa_services uses the same order.
    fn parameters(&mut self, params: &EnvelopeParams) -> Result<(), EncodeError> {
        let base = params.date.is_some();
        write_agent_set_by(self, code::envelope::TO, &params.to)?;
        if let Some(from) = &params.from {
            self.out.byte(code::envelope::FROM);
            write_agent_id_by(self, from)?;
        }
        // The header of a base envelope has it already. fipa_services writes it twice.
        if let Some(representation) = &params.acl_representation
            && (!base || self.for_fipa_services())
        {
            self.out.byte(code::envelope::ACL_REPRESENTATION);
            match self.dialect {
                // JADE reads a name here, not the code.
                Dialect::Jade => {
                    let what = "acl-representation";
                    if representation.as_str().starts_with(char::is_control) {
                        let why = "readers other than JADE take its first character for a code";
                        return Err(EncodeError::Unrepresentable { what, why });
                    }
                    self.string(what, representation.as_str())?;
                }
                _ => self.acl_representation(representation)?,
            }
        }
        let comments = params.comments.as_deref();
        self.text(code::envelope::COMMENTS, "comments", comments)?;
        if let Some(len) = params.payload_length {
            self.out.byte(code::envelope::PAYLOAD_LENGTH);
            self.payload_length(len)?;
        }
        let parameter = code::envelope::PAYLOAD_ENCODING;
        match params.payload_encoding.as_deref() {
            None if base && self.for_fipa_services() => {
                self.out.byte(parameter);
                self.string("payload-encoding", "")?;
            }
            encoding => self.text(parameter, "payload-encoding", encoding)?,
        }
        let intended = &params.intended_receivers;
        write_agent_set_by(self, code::envelope::INTENDED_RECEIVER, intended)?;
        if let Some(received) = &params.received
            && (base || self.for_fipa_services())
        {
            self.out.byte(code::envelope::RECEIVED);
            self.received(received, true)?;
        }
        if let Some(text) = &params.transport_behaviour {
            self.out.byte(code::envelope::TRANSPORT_BEHAVIOR);
            self.any(present("transport-behaviour", text)?)?;
        }
        if self.for_fipa_services() && !params.user_defined.is_empty() {
            return Err(EncodeError::Unrepresentable {
                what: "user-defined parameter of an envelope",
                why: "fipa_services does not read one in a bit-efficient envelope",
            });
        }
        self.user_defined(&params.user_defined)
    }

    fn payload_length(&mut self, len: u64) -> Result<(), EncodeError> {
        if self.for_fipa_services() {
            if u32::try_from(len).is_err() {
                let what = "payload-length";
                let why = "fipa_services reads no number above 4294967295";
                return Err(EncodeError::Unrepresentable { what, why });
            }
            self.out.byte(code::token::NUMBER);
        }
        write_digits(len, &mut self.out);
        Ok(())
    }

    fn received(&mut self, received: &Received, whole: bool) -> Result<(), EncodeError> {
        self.string("received-by", present("received-by", &received.by)?)?;
        self.time("date of the stamp", received.date)?;
        let from = received.from.as_deref();
        self.text(code::stamp::FROM, "received-from", from)?;
        self.text(code::stamp::ID, "received-id", received.id.as_deref())?;
        self.text(code::stamp::VIA, "received-via", received.via.as_deref())?;
        // fipa_services writes the stamp of an extension twice, first without these.
        if whole {
            self.user_defined(&received.user_defined)?;
        }
        self.out.byte(code::END);
        Ok(())
    }

    /// Writes the stamp that fipa_services writes for a missing one: an empty name and the first
    /// instant of 1970.
    fn no_stamp(&mut self) {
        self.out.slice(b"#0\"\0");
        self.out.byte(code::date_time::ABSOLUTE);
        self.out.slice(b"\x2a\x81\x12\x12\x11\x11\x11\x11\x11");
        self.out.byte(code::END);
    }

    fn acl_representation(
        &mut self,
        representation: &AclRepresentation,
    ) -> Result<(), EncodeError> {
        // `Other` may hold a standard name.
        match AclRepresentation::from(representation.as_str()) {
            AclRepresentation::BitEfficient => self.out.byte(code::representation::BIT_EFFICIENT),
            AclRepresentation::String => self.out.byte(code::representation::STRING),
            AclRepresentation::Xml => self.out.byte(code::representation::XML),
            AclRepresentation::Other(_) if self.for_fipa_services() => {
                return Err(EncodeError::Unrepresentable {
                    what: "acl-representation",
                    why: "fipa_services reads only the representations of the standard",
                });
            }
            AclRepresentation::Other(name) => {
                self.out.byte(code::representation::NAMED);
                self.string("acl-representation", present("acl-representation", &name)?)?;
            }
        }
        Ok(())
    }

    fn user_defined(&mut self, pairs: &[(String, String)]) -> Result<(), EncodeError> {
        for (name, value) in pairs {
            if !is_token(name) {
                let shown = name.chars().take(60).collect();
                return Err(EncodeError::UserDefinedName(shown));
            }
            self.out.byte(code::envelope::USER_DEFINED);
            self.user_defined_name(name)?;
            self.string("user-defined value", value)?;
        }
        Ok(())
    }

    fn user_defined_name(&mut self, name: &str) -> Result<(), EncodeError> {
        let what = "user-defined name";
        // fipa_services stores names without X- and does not add it here.
        if self.for_fipa_services() && without_x(name.as_bytes()) == name.as_bytes() {
            self.string(what, name)
        } else {
            self.string(what, &format!("X-{name}"))
        }
    }

    fn any(&mut self, value: &str) -> Result<(), EncodeError> {
        self.out.byte(code::token::STRING);
        self.string("value", value)
    }

    fn text(
        &mut self,
        parameter: u8,
        what: &'static str,
        text: Option<&str>,
    ) -> Result<(), EncodeError> {
        match text {
            None => Ok(()),
            Some(text) => {
                self.out.byte(parameter);
                self.string(what, present(what, text)?)
            }
        }
    }

    /// Writes a string. The standard's dialect writes it in quotation marks only if a reader would
    /// otherwise take it for a text in another form, for the end of a list (01), or for the code
    /// (0a) that JADE writes in front of stamps.
    fn string(&mut self, what: &'static str, text: &str) -> Result<(), EncodeError> {
        if text.as_bytes().contains(&0) {
            return Err(EncodeError::Nul(what));
        }
        let bare = string_form(text.as_bytes()).0 == Form::Bare
            && !matches!(text.as_bytes(), [0x01 | b'\n', ..]);
        match self.dialect {
            Dialect::FipaServices => {
                self.out.slice(format!("#{}\"", text.len()).as_bytes());
                self.out.slice(text.as_bytes());
            }
            _ if bare => self.out.slice(text.as_bytes()),
            Dialect::Jade => {
                let why = "it needs quotation marks, which JADE does not read in envelopes";
                return Err(EncodeError::Unrepresentable { what, why });
            }
            Dialect::Standard => word::quoted(text, |piece| self.out.slice(piece.as_bytes())),
        }
        self.out.byte(0x00);
        Ok(())
    }

    fn time(&mut self, what: &'static str, time: Time) -> Result<(), EncodeError> {
        if self.for_fipa_services() {
            write_local_date_time(local_time(what, time)?, &mut self.out);
        } else {
            write_date_time(time, &mut self.out);
        }
        Ok(())
    }
}

impl TextWriter for Writer {
    fn byte(&mut self, byte: u8) {
        self.out.byte(byte);
    }

    fn name(&mut self, what: &'static str, text: &str) -> Result<(), EncodeError> {
        self.string(what, text)
    }

    fn user_defined_of_agent(&mut self, name: &str, value: &str) -> Result<(), EncodeError> {
        // JADE uses the code of messages and writes the value without a code.
        if self.dialect == Dialect::Jade {
            self.out.byte(code::agent::USER_DEFINED);
            self.user_defined_name(name)?;
            return self.string("user-defined value", value);
        }
        self.out.byte(code::agent::USER_DEFINED_IN_ENVELOPE);
        self.user_defined_name(name)?;
        self.any(value)
    }
}

fn missing(parameter: &'static str, of: &'static str) -> EncodeError {
    EncodeError::Missing { parameter, of }
}
