//! The envelope of an observed letter.

use std::sync::OnceLock;

use bytes::Bytes;
use fipa_acl::Envelope;

/// The envelope of an observed letter, decoded when it is first needed: most watchers need the message alone.
#[derive(Debug, Clone, Default)]
pub struct SeenEnvelope {
    bytes: Bytes,
    decoded: OnceLock<Option<Envelope>>,
}

impl SeenEnvelope {
    /// Returns the envelope; `None` if it is too long for a record, or malformed.
    #[must_use]
    pub fn get(&self) -> Option<&Envelope> {
        let decode = || {
            // Unchanged from the letter, and not yet checked as a whole.
            let (decoded, len) = Envelope::decode(&self.bytes).ok()?;
            (len == self.bytes.len()).then_some(decoded)
        };
        self.decoded.get_or_init(decode).as_ref()
    }

    /// Returns the envelope without the record that it came in, whose memory is then free.
    #[must_use]
    pub(super) fn alone(&self) -> Self {
        Bytes::copy_from_slice(&self.bytes).into()
    }
}

impl From<Bytes> for SeenEnvelope {
    /// Takes an encoded envelope.
    fn from(bytes: Bytes) -> Self {
        Self {
            bytes,
            decoded: OnceLock::new(),
        }
    }
}
