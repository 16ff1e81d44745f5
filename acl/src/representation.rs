//! Names of the encodings, and how to tell them apart.

use std::fmt;

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
    /// Tells the encoding of a message or an envelope from its first bytes (white space and a
    /// byte order mark in front of text are passed over). `None` for what begins like neither.
    #[must_use]
    pub fn detect(bytes: &[u8]) -> Option<Self> {
        if let Some(0xfa..=0xfe) = bytes.first() {
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

impl fmt::Display for Representation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::BitEfficient => "bit-efficient",
            Self::String => "string",
            Self::Xml => "XML",
        })
    }
}

/// How the message behind an envelope is encoded, as the envelope says it (FIPA00067
/// `acl-representation`).
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
#[allow(
    clippy::exhaustive_enums,
    reason = "Other is there for what is not known"
)]
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
    /// The component name.
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

/// The representation with this component name; the standard ones are recognised in any case.
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
    fn the_first_bytes_tell() {
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
