//! Content, borrowed from an encoded message.

use std::borrow::Cow;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;

use crate::bitefficient::expression::string_content;
use crate::bitefficient::reader::unescaped;
use crate::{Text, xml};

/// Encoded content of a message.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Content<'a> {
    /// The bytes of the content.
    Bytes(&'a [u8]),
    /// The bytes of the content, in a piece of their own: see [`Payload`](crate::Payload).
    Beside(&'a [u8]),
    /// A string in quotation marks, with a byte count, or bare.
    String(&'a [u8]),
    /// The inside of quotation marks, with escapes.
    Quoted(&'a [u8]),
    /// An expression, as in editions of FIPA00069 before F (November 2002).
    Expression(Text<'a>),
    /// The inside of an XML element.
    Xml(&'a [u8]),
}

impl<'a> Content<'a> {
    pub(crate) fn bytes(self) -> Cow<'a, [u8]> {
        match self {
            Self::Bytes(bytes) | Self::Beside(bytes) => Cow::Borrowed(bytes),
            Self::String(bytes) => string_content(bytes),
            Self::Quoted(inner) => unescaped(inner),
            Self::Expression(text) => match text.as_str() {
                Cow::Borrowed(text) => Cow::Borrowed(text.as_bytes()),
                Cow::Owned(text) => Cow::Owned(text.into_bytes()),
            },
            Self::Xml(inner) => xml::unescaped(inner, xml::Whitespace::Preserve),
        }
    }

    /// Decodes checked Base64.
    pub(crate) fn of_base64(self) -> Cow<'a, [u8]> {
        // `check_base64` has accepted the bytes, so this cannot fail.
        let dense = without_white_space(&self.bytes());
        Cow::Owned(STANDARD.decode(dense).unwrap_or_default())
    }
}

/// Whether the bytes are Base64, apart from white space.
pub(crate) fn check_base64(bytes: &[u8]) -> bool {
    STANDARD.decode(without_white_space(bytes)).is_ok()
}

fn without_white_space(bytes: &[u8]) -> Vec<u8> {
    let dense = bytes.iter().filter(|byte| !byte.is_ascii_whitespace());
    dense.copied().collect()
}
