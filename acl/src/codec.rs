//! Encoding and decoding of messages and envelopes. The modules of the encodings do the work.

use bytes::{BufMut, Bytes};

use crate::bitefficient::dialects::{self, Peer};
use crate::bitefficient::write::{Counter, Output, Sink};
use crate::envelope::encode as encode_envelope;
use crate::error::{DecodeError, EncodeError};
use crate::representation::is_bit_efficient;
use crate::{
    Dialect, Envelope, Message, MessageView, Payload, Representation, bitefficient, string, xml,
};

impl Message {
    /// Decodes a message in any encoding (FIPA00069, FIPA00070, FIPA00071) and dialect. The first
    /// bytes determine the encoding.
    ///
    /// The content shares the memory of the payload unless it must be unescaped. The content of a
    /// bit-efficient message is not accessed.
    ///
    /// # Errors
    /// The payload is not one whole message.
    pub fn decode(payload: &Payload) -> Result<Self, DecodeError> {
        let first = payload.head.first();
        let text = !first.is_some_and(|first| is_bit_efficient(*first));
        if text && payload.is_split() {
            // Only bit-efficient messages are read in pieces.
            let whole = Payload::from(payload.to_bytes());
            return MessageView::parse_payload(&whole)?.to_message(&whole);
        }
        MessageView::parse_payload(payload)?.to_message(payload)
    }

    /// Encodes the message into one piece of memory.
    ///
    /// [`to_payload`](Self::to_payload) encodes bit-efficiently without copying the content.
    ///
    /// # Errors
    /// The encoding or the dialect cannot represent a value of the message.
    pub fn encode(
        &self,
        representation: Representation,
        dialect: Dialect,
    ) -> Result<Bytes, EncodeError> {
        if (representation, dialect) == (Representation::BitEfficient, Dialect::Standard) {
            return Ok(self.to_payload().to_bytes());
        }
        let content_len = self.content().map_or(0, Bytes::len);
        // Capacity for the other parameters and some escaped characters: moving long content to
        // larger memory takes longer than encoding it.
        let extra = (content_len / 16).saturating_add(1024);
        let mut out = Vec::with_capacity(content_len.saturating_add(extra));
        self.write(representation, dialect, &mut out)?;
        Ok(out.into())
    }

    /// Number of bytes that [`encode_into`](Self::encode_into) writes.
    ///
    /// # Errors
    /// The errors of [`encode`](Self::encode).
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

    /// Encodes the message into a buffer: [`encoded_len`](Self::encoded_len) bytes. After an error,
    /// the buffer may hold a part of the message.
    ///
    /// # Errors
    /// The errors of [`encode`](Self::encode).
    ///
    /// # Panics
    /// If the buffer has a fixed capacity and less space than that.
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

    /// Writes the message. The callers write the standard's bit-efficient encoding themselves.
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
    /// Encodes the envelope with all extensions: bit-efficiently (FIPA00088) or in XML (FIPA00085).
    ///
    /// JADE reads no extensions in XML. Its envelope has the [`effective`](Self::effective)
    /// parameters, with the newest stamp only. fipa_services reads no zones. Its envelope has times
    /// without a zone, which it takes as local times. Its bit-efficient envelope may have extensions
    /// without a stamp.
    ///
    /// # Errors
    /// A mandatory parameter is missing, or the encoding or the dialect cannot represent a value.
    /// There are no envelopes in the string encoding.
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
