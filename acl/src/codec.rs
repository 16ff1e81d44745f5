//! Messages to bytes and back, whatever the encoding: the way into the modules that know one each.

use bytes::Bytes;

use crate::error::{DecodeError, EncodeError};
use crate::{Dialect, Envelope, Message, Payload, Representation, bitefficient, string, xml};

impl Message {
    /// Reads an encoded message, whichever encoding and dialect it is in: its first bytes tell.
    ///
    /// The content of the result shares the memory it was given in, unless it has to be
    /// unescaped. Of bit-efficient messages it is not even looked at.
    ///
    /// # Errors
    /// When the payload is not one whole message.
    pub fn decode(payload: &Payload) -> Result<Self, DecodeError> {
        match Representation::detect(&payload.head) {
            Some(Representation::String) => string::decode(payload),
            Some(Representation::Xml) => xml::decode(payload),
            _ => bitefficient::decode(payload),
        }
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
            // Both peers read what the standard says.
            Representation::BitEfficient => Ok(self.to_payload().to_bytes()),
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
    /// it gets times without, and takes them as its local ones.
    ///
    /// # Errors
    /// When a mandatory parameter is missing, or one has a value that the encoding or the reader
    /// has no way to say.
    pub fn encode(
        &self,
        representation: Representation,
        dialect: Dialect,
    ) -> Result<Bytes, EncodeError> {
        match (representation, dialect) {
            (Representation::BitEfficient, Dialect::FipaServices) => {
                Err(EncodeError::Unrepresentable {
                    what: "bit-efficient envelope",
                    why: "fipa_services does not read those of the standard; XML it does",
                })
            }
            (Representation::BitEfficient, Dialect::Standard | Dialect::Jade) => {
                self.encode_standard()
            }
            (Representation::Xml, dialect) => xml::encode_envelope(self, dialect),
            (other @ Representation::String, _) => {
                Err(EncodeError::UnsupportedRepresentation(other))
            }
        }
    }
}
