//! Writing bit-efficient envelopes.
//!
//! The standard is FIPA00088 as its examples have it (texts bare), newest extension first, with the
//! right lengths. fipa_services and JADE cannot read each other's envelopes: the former demands
//! every text with its length in front, a code in front of numbers and the oldest extension first;
//! the latter takes whatever stands in front of a text for a part of it.

use bytes::Bytes;

use crate::bitefficient::reader::{Form, string_form};
use crate::bitefficient::without_x;
use crate::bitefficient::write::{
    Hand, Out, write_agent_id_by, write_agent_set_by, write_date_time, write_digits,
    write_local_date_time,
};
use crate::dialect::local_time;
use crate::error::EncodeError;
use crate::word::{self, is_token};
use crate::{AclRepresentation, AgentId, Dialect, Envelope, EnvelopeParams, Received, Time};

const BASE: &str = "a base envelope";
const EXTENSION: &str = "an extension envelope";

/// The encoded envelope, all extensions included, in the hand that a reader needs.
///
/// # Errors
/// When a mandatory parameter is missing, or one has a value that cannot be written for the reader.
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
    /// The encoded envelope, all extensions included, in the standard's dialect.
    ///
    /// # Errors
    /// When a mandatory parameter is missing, or one has a value that cannot be encoded. An
    /// extension needs a stamp and has no place for a date.
    pub fn encode_standard(&self) -> Result<Bytes, EncodeError> {
        encode(self, Dialect::Standard)
    }

    /// The envelope that a sender puts around a message, encoded in the standard's dialect from
    /// borrowed parts: to the receivers, who are all intended, from the sender, with the length of
    /// the payload and the date. What every letter needs is made without a value in between.
    ///
    /// # Errors
    /// Like [`encode_standard`](Self::encode_standard).
    pub fn encode_around(
        receivers: &[AgentId],
        from: Option<&AgentId>,
        representation: &AclRepresentation,
        payload_length: u64,
        date: Time,
    ) -> Result<Bytes, EncodeError> {
        let mut writer = Writer::new(Dialect::Standard);
        // Enough for names of usual length, so that the buffer rarely has to grow.
        writer.out.reserve(128 + 96 * receivers.len().min(16));
        let start = writer.begin(0xfe);
        writer.acl_representation(representation)?;
        writer.time("date", date)?;
        let to = writer.out.len();
        write_agent_set_by(&mut writer, 0x02, receivers)?;
        let list = to..writer.out.len();
        if let Some(from) = from {
            writer.out.byte(0x03);
            write_agent_id_by(&mut writer, from)?;
        }
        writer.out.byte(0x06);
        writer.payload_length(payload_length)?;
        // The same list under another code.
        let intended = writer.out.len();
        writer.out.extend_from_within(list);
        if let Some(code) = writer.out.get_mut(intended) {
            *code = 0x09;
        }
        writer.out.byte(0x01);
        writer.end(start)?;
        Ok(writer.out.into())
    }

    /// One encoded extension envelope, to be put in front of a letter
    /// ([`Letter::stamped`](crate::Letter::stamped)).
    ///
    /// # Errors
    /// Like [`encode_standard`](Self::encode_standard).
    pub fn encode_extension(params: &EnvelopeParams) -> Result<Bytes, EncodeError> {
        let mut writer = Writer::new(Dialect::Standard);
        writer.extension(params)?;
        Ok(writer.out.into())
    }
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

    fn for_fipa_services(&self) -> bool {
        self.dialect == Dialect::FipaServices
    }

    fn extension(&mut self, params: &EnvelopeParams) -> Result<(), EncodeError> {
        if params.date.is_some() {
            let (parameter, of) = ("date", EXTENSION);
            return Err(EncodeError::NoPlace { parameter, of });
        }
        let start = self.begin(0xfd);
        match &params.received {
            Some(stamp) => self.received(stamp, !self.for_fipa_services())?,
            None if self.for_fipa_services() => self.no_stamp(),
            None => return Err(missing("received", EXTENSION)),
        }
        let parameters = self.out.len();
        self.parameters(params)?;
        self.out.byte(0x01);
        if self.for_fipa_services() {
            // It counts neither the stamp nor right, and looks at it as little as others.
            let counted = self.out.len() - parameters + 4;
            let len = u16::try_from(counted).map_err(|_| EncodeError::EnvelopeTooLong(counted))?;
            self.set_len(start, len);
            return Ok(());
        }
        self.end(start)
    }

    fn base(&mut self, params: &EnvelopeParams) -> Result<(), EncodeError> {
        let start = self.begin(0xfe);
        let representation = params.acl_representation.as_ref();
        let representation = representation.ok_or_else(|| missing("acl-representation", BASE))?;
        self.acl_representation(representation)?;
        self.time("date", params.date.ok_or_else(|| missing("date", BASE))?)?;
        self.parameters(params)?;
        self.out.byte(0x01);
        if self.for_fipa_services() {
            // Whatever the length.
            self.set_len(start, 16);
            return Ok(());
        }
        self.end(start)
    }

    /// Id, and room for a length. Gives where that is.
    fn begin(&mut self, id: u8) -> usize {
        self.out.byte(id);
        self.out.slice(&[0, 0]);
        self.out.len()
    }

    /// Puts in the length of an envelope that is there up to its end; it counts all of it
    /// (FIPA00088 `EnvLen`).
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
        if let Some(room) = self.out.get_mut(start - 2..start) {
            room.copy_from_slice(&len.to_be_bytes());
        }
    }

    /// The parameters that base and extension have in common, in the order of their codes, which
    /// is that of fipa_services too.
    fn parameters(&mut self, params: &EnvelopeParams) -> Result<(), EncodeError> {
        let base = params.date.is_some();
        write_agent_set_by(self, 0x02, &params.to)?;
        if let Some(from) = &params.from {
            self.out.byte(0x03);
            write_agent_id_by(self, from)?;
        }
        // In a base envelope it stands in front already. fipa_services says it twice.
        if let Some(representation) = &params.acl_representation
            && (!base || self.for_fipa_services())
        {
            self.out.byte(0x04);
            match self.dialect {
                // It reads a name here, not the code.
                Dialect::Jade => {
                    let what = "acl-representation";
                    if representation.as_str().starts_with(char::is_control) {
                        let why = "others than JADE would take it for the code of one";
                        return Err(EncodeError::Unrepresentable { what, why });
                    }
                    self.string(what, representation.as_str())?;
                }
                _ => self.acl_representation(representation)?,
            }
        }
        self.text(0x05, "comments", params.comments.as_deref())?;
        if let Some(len) = params.payload_length {
            self.out.byte(0x06);
            self.payload_length(len)?;
        }
        match params.payload_encoding.as_deref() {
            None if base && self.for_fipa_services() => {
                self.out.byte(0x07);
                self.string("payload-encoding", "")?;
            }
            encoding => self.text(0x07, "payload-encoding", encoding)?,
        }
        write_agent_set_by(self, 0x09, &params.intended_receivers)?;
        if let Some(received) = &params.received
            && (base || self.for_fipa_services())
        {
            self.out.byte(0x0a);
            self.received(received, true)?;
        }
        if let Some(text) = &params.transport_behaviour {
            self.out.byte(0x0b);
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
                let why = "fipa_services reads none above 4294967295";
                return Err(EncodeError::Unrepresentable { what, why });
            }
            self.out.byte(0x12);
        }
        write_digits(len, &mut self.out);
        Ok(())
    }

    fn received(&mut self, received: &Received, whole: bool) -> Result<(), EncodeError> {
        self.string("received-by", present("received-by", &received.by)?)?;
        self.time("date of the stamp", received.date)?;
        self.text(0x02, "received-from", received.from.as_deref())?;
        self.text(0x03, "received-id", received.id.as_deref())?;
        self.text(0x04, "received-via", received.via.as_deref())?;
        // fipa_services writes stamps of extensions twice, first without them.
        if whole {
            self.user_defined(&received.user_defined)?;
        }
        self.out.byte(0x01);
        Ok(())
    }

    /// The way of fipa_services to say that there is no stamp: no name and the first of all times.
    fn no_stamp(&mut self) {
        self.out.slice(b"#0\"\0");
        self.out
            .slice(b"\x20\x2a\x81\x12\x12\x11\x11\x11\x11\x11\x01");
    }

    fn acl_representation(
        &mut self,
        representation: &AclRepresentation,
    ) -> Result<(), EncodeError> {
        // A standard name spelled out is the standard one.
        match AclRepresentation::from(representation.as_str()) {
            AclRepresentation::BitEfficient => self.out.byte(0x10),
            AclRepresentation::String => self.out.byte(0x11),
            AclRepresentation::Xml => self.out.byte(0x12),
            AclRepresentation::Other(_) if self.for_fipa_services() => {
                return Err(EncodeError::Unrepresentable {
                    what: "acl-representation",
                    why: "fipa_services knows only those of the standard",
                });
            }
            AclRepresentation::Other(name) => {
                self.out.byte(0x00);
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
            self.out.byte(0x00);
            self.user_defined_name(name)?;
            self.string("user-defined value", value)?;
        }
        Ok(())
    }

    fn user_defined_name(&mut self, name: &str) -> Result<(), EncodeError> {
        let what = "user-defined name";
        // fipa_services keeps names without X- in its memory, and does not add it here.
        if self.for_fipa_services() && without_x(name.as_bytes()) == name.as_bytes() {
            self.string(what, name)
        } else {
            self.string(what, &format!("X-{name}"))
        }
    }

    fn any(&mut self, value: &str) -> Result<(), EncodeError> {
        self.out.byte(0x14);
        self.string("value", value)
    }

    fn text(
        &mut self,
        code: u8,
        what: &'static str,
        text: Option<&str>,
    ) -> Result<(), EncodeError> {
        match text {
            None => Ok(()),
            Some(text) => {
                self.out.byte(code);
                self.string(what, present(what, text)?)
            }
        }
    }

    /// In the standard, bare: only a text that would be taken for a text in another form, for the
    /// end of a list (01), or for the code (0a) that JADE puts in front of stamps, is put in
    /// quotation marks.
    fn string(&mut self, what: &'static str, text: &str) -> Result<(), EncodeError> {
        if text.contains('\0') {
            return Err(EncodeError::Nul(what));
        }
        let bare =
            string_form(text.as_bytes()).0 == Form::Bare && !text.starts_with(['\x01', '\n']);
        match self.dialect {
            Dialect::FipaServices => {
                self.out.slice(format!("#{}\"", text.len()).as_bytes());
                self.out.slice(text.as_bytes());
            }
            _ if bare => self.out.slice(text.as_bytes()),
            Dialect::Jade => {
                let why = "JADE has no quotation marks in envelopes, which it would need";
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

impl Hand for Writer {
    fn byte(&mut self, byte: u8) {
        self.out.byte(byte);
    }

    fn name(&mut self, what: &'static str, text: &str) -> Result<(), EncodeError> {
        self.string(what, text)
    }

    fn user_defined_of_agent(&mut self, name: &str, value: &str) -> Result<(), EncodeError> {
        // JADE keeps to the code of messages, and to plain strings.
        if self.dialect == Dialect::Jade {
            self.out.byte(0x04);
            self.user_defined_name(name)?;
            return self.string("user-defined value", value);
        }
        self.out.byte(0x05);
        self.user_defined_name(name)?;
        self.any(value)
    }
}

fn missing(parameter: &'static str, of: &'static str) -> EncodeError {
    EncodeError::Missing { parameter, of }
}

/// An empty text is how peers say that there is none.
fn present<'a>(what: &'static str, text: &'a str) -> Result<&'a str, EncodeError> {
    (!text.is_empty())
        .then_some(text)
        .ok_or(EncodeError::Empty(what))
}
