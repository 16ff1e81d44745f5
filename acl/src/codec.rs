//! Messages to bytes and back, whatever the encoding: the way into the modules that know one each.

use bytes::Bytes;

use crate::bitefficient::dialects::{self, Peer};
use crate::envelope::encode as encode_envelope;
use crate::error::{DecodeError, EncodeError};
use crate::{Dialect, Envelope, Message, MessageView, Payload, Representation, string, xml};

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
        match representation {
            Representation::BitEfficient => match dialect {
                Dialect::Standard => Ok(self.to_payload().to_bytes()),
                Dialect::FipaServices => dialects::encode(self, Peer::FipaServices),
                Dialect::Jade => dialects::encode(self, Peer::Jade),
            },
            Representation::String => string::encode(self, dialect),
            Representation::Xml => xml::encode(self, dialect),
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
            Representation::Xml => xml::encode_envelope(self, dialect),
            other @ Representation::String => Err(EncodeError::UnsupportedRepresentation(other)),
        }
    }
}
