//! Messages to bytes and back, whatever the encoding: the way into the modules that know one each.

use bytes::{BufMut, Bytes};

use crate::bitefficient::dialects::{self, Peer};
use crate::bitefficient::write::{Counter, Output, Sink};
use crate::envelope::encode as encode_envelope;
use crate::error::{DecodeError, EncodeError};
use crate::{
    Dialect, Envelope, Message, MessageView, Payload, Representation, bitefficient, string, xml,
};

impl Message {
    /// Reads an encoded message, whichever encoding and dialect it is in: its first bytes tell.
    ///
    /// The content of the result shares the memory it was given in, unless it has to be
    /// unescaped. Of bit-efficient messages it is not even looked at.
    ///
    /// # Errors
    /// When the payload is not one whole message.
    pub fn decode(payload: &Payload) -> Result<Self, DecodeError> {
        let text = !matches!(payload.head.first(), Some(0xfa..=0xfe));
        if text && payload.is_split() {
            // Nobody splits these; they are read in one piece.
            let whole = Payload::from(payload.to_bytes());
            return MessageView::parse_payload(&whole)?.to_message(&whole);
        }
        MessageView::parse_payload(payload)?.to_message(payload)
    }

    /// The encoded message as one piece of memory, in the hand that a reader needs.
    ///
    /// [`to_payload`](Self::to_payload) is the way to send it bit-efficiently without copying the
    /// content.
    ///
    /// # Errors
    /// When the encoding or the reader has no way to say what the message says.
    pub fn encode(
        &self,
        representation: Representation,
        dialect: Dialect,
    ) -> Result<Bytes, EncodeError> {
        if (representation, dialect) == (Representation::BitEfficient, Dialect::Standard) {
            return Ok(self.to_payload().to_bytes());
        }
        let content_len = self.content().map_or(0, Bytes::len);
        // Room for the other parameters and some escaped characters: moving long content to larger
        // memory takes longer than encoding it.
        let room = (content_len / 16).saturating_add(1024);
        let mut out = Vec::with_capacity(content_len.saturating_add(room));
        self.write(representation, dialect, &mut out)?;
        Ok(out.into())
    }

    /// How many bytes [`encode_into`](Self::encode_into) writes.
    ///
    /// # Errors
    /// Like [`encode`](Self::encode).
    pub fn encoded_len(
        &self,
        representation: Representation,
        dialect: Dialect,
    ) -> Result<usize, EncodeError> {
        if (representation, dialect) == (Representation::BitEfficient, Dialect::Standard) {
            return Ok(bitefficient::encoded_len(self));
        }
        let mut counter = Counter(0);
        self.write(representation, dialect, &mut counter)?;
        Ok(counter.0)
    }

    /// Writes the encoded message into memory that is there: [`encoded_len`](Self::encoded_len)
    /// bytes. Of a message that cannot be encoded, a part may have been written.
    ///
    /// # Errors
    /// Like [`encode`](Self::encode).
    ///
    /// # Panics
    /// When the buffer has a limit and less room than that.
    pub fn encode_into(
        &self,
        representation: Representation,
        dialect: Dialect,
        out: &mut impl BufMut,
    ) -> Result<(), EncodeError> {
        if (representation, dialect) == (Representation::BitEfficient, Dialect::Standard) {
            bitefficient::encode(self, out);
            return Ok(());
        }
        let mut sink = Sink::new(out);
        let written = self.write(representation, dialect, &mut sink);
        sink.flush();
        written
    }

    /// Writes other representations and dialects than the bit-efficient one of the standard.
    fn write(
        &self,
        representation: Representation,
        dialect: Dialect,
        out: &mut dyn Output,
    ) -> Result<(), EncodeError> {
        match (representation, dialect) {
            (Representation::BitEfficient, Dialect::Standard) => {
                out.slice(&self.to_payload().to_bytes());
                Ok(())
            }
            (Representation::BitEfficient, Dialect::FipaServices) => {
                dialects::encode(self, Peer::FipaServices, out)
            }
            (Representation::BitEfficient, Dialect::Jade) => {
                dialects::encode(self, Peer::Jade, out)
            }
            (Representation::String, _) => string::encode(self, dialect, out),
            (Representation::Xml, _) => xml::encode(self, dialect, out),
        }
    }
}

impl Envelope {
    /// The encoded envelope, all extensions included, in the hand that a reader needs.
    ///
    /// In XML, JADE reads no extensions: it gets the parameters that count
    /// ([`effective`](Self::effective)), with the newest stamp only. fipa_services reads no zones:
    /// it gets times without, and takes them as its local ones. Its bit-efficient envelopes may
    /// have extensions without a stamp.
    ///
    /// # Errors
    /// When a mandatory parameter is missing, or one has a value that the encoding or the reader
    /// has no way to say.
    pub fn encode(
        &self,
        representation: Representation,
        dialect: Dialect,
    ) -> Result<Bytes, EncodeError> {
        match representation {
            Representation::BitEfficient => encode_envelope(self, dialect),
            Representation::Xml => {
                let mut out = Vec::with_capacity(1024);
                xml::encode_envelope(self, dialect, &mut out)?;
                Ok(out.into())
            }
            other @ Representation::String => Err(EncodeError::UnsupportedRepresentation(other)),
        }
    }
}
