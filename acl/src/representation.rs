//! Names of the encodings and their detection.

use std::fmt;

use crate::bitefficient::code;

/// The three standard encodings of a message or an envelope.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Representation {
    /// FIPA00069 for messages, FIPA00088 for envelopes.
    BitEfficient,
    /// FIPA00070; messages only.
    String,
    /// FIPA00071 for messages, FIPA00085 for envelopes.
    Xml,
}

impl Representation {
    /// Detects the encoding of a message or an envelope by its first bytes. White space and a byte
    /// order mark in front of text are skipped. Returns `None` for an unknown encoding.
    #[must_use]
    pub fn detect(bytes: &[u8]) -> Option<Self> {
        if bytes.first().is_some_and(|first| is_bit_efficient(*first)) {
            return Some(Self::BitEfficient);
        }
        let text = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
        match text.iter().find(|byte| !byte.is_ascii_whitespace())? {
            b'(' => Some(Self::String),
            b'<' => Some(Self::Xml),
            _ => None,
        }
    }
}

/// Whether a message or an envelope with this first byte is bit-efficient.
///
/// FIPA00069 2.4, note 1: "The identifier byte can be used to separate bit-efficient ACL messages
/// from (for example) string-based messages and separate different coding schemes."
pub(crate) fn is_bit_efficient(first: u8) -> bool {
    (code::message_id::PLAIN..=code::envelope::BASE).contains(&first)
}

impl fmt::Display for Representation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::BitEfficient => "bit-efficient",
            Self::String => "string",
            Self::Xml => "XML",
        })
    }
}

/// Encoding of the message behind an envelope (FIPA00067 `acl-representation`).
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
#[allow(clippy::exhaustive_enums, reason = "`Other` stands for any other name")]
pub enum AclRepresentation {
    /// `fipa.acl.rep.bitefficient.std`
    BitEfficient,
    /// `fipa.acl.rep.string.std`
    String,
    /// `fipa.acl.rep.xml.std`
    Xml,
    /// Any other name.
    Other(String),
}

impl AclRepresentation {
    /// Component name of the representation.
    #[must_use]
    pub fn as_str(&self) -> &str {
        match self {
            Self::BitEfficient => "fipa.acl.rep.bitefficient.std",
            Self::String => "fipa.acl.rep.string.std",
            Self::Xml => "fipa.acl.rep.xml.std",
            Self::Other(name) => name,
        }
    }
}

/// Returns the representation with this component name. The case of standard names is ignored.
impl From<&str> for AclRepresentation {
    fn from(name: &str) -> Self {
        [Self::BitEfficient, Self::String, Self::Xml]
            .into_iter()
            .find(|known| known.as_str().eq_ignore_ascii_case(name))
            .unwrap_or_else(|| Self::Other(name.to_owned()))
    }
}

impl From<Representation> for AclRepresentation {
    fn from(representation: Representation) -> Self {
        match representation {
            Representation::BitEfficient => Self::BitEfficient,
            Representation::String => Self::String,
            Representation::Xml => Self::Xml,
        }
    }
}

impl fmt::Display for AclRepresentation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.as_str())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_bytes_determine_the_encoding() {
        use Representation::{BitEfficient, String, Xml};
        for (bytes, expected) in [
            (&b"\xfa\x10"[..], Some(BitEfficient)),
            (b"\xfd\x00", Some(BitEfficient)),
            (b"\xfe", Some(BitEfficient)),
            (b" \r\n(INFORM", Some(String)),
            (b"<?xml", Some(Xml)),
            (b"\xef\xbb\xbf<fipa-message", Some(Xml)),
            (b"", None),
            (b"hello", None),
            (b"\xff", None),
        ] {
            assert_eq!(Representation::detect(bytes), expected, "{bytes:?}");
        }
    }
}
