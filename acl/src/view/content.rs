//! Content, borrowed from the message it was read from.

use std::borrow::Cow;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;

use crate::bitefficient::expression::string_content;
use crate::bitefficient::reader::unescaped;
use crate::{Text, xml};

/// Content as it lies in a message.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Content<'a> {
    /// The bytes as they are.
    Bytes(&'a [u8]),
    /// The same, beside the message: see [`Payload`](crate::Payload).
    Beside(&'a [u8]),
    /// Up to a NUL: perhaps in quotation marks, perhaps with a byte count.
    String(&'a [u8]),
    /// The inside of quotation marks with escapes.
    Quoted(&'a [u8]),
    /// An expression, from peers of before the edition of November 2002.
    Expression(Text<'a>),
    /// The inside of an element.
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
            Self::Xml(inner) => xml::unescaped(inner, xml::Whitespace::Counts),
        }
    }

    /// The bytes that checked Base64 stands for.
    pub(crate) fn of_base64(self) -> Cow<'a, [u8]> {
        // The check of the message has seen to it that this can be decoded.
        Cow::Owned(STANDARD.decode(dense(&self.bytes())).unwrap_or_default())
    }
}

/// Whether these bytes are Base64, but for white space between them.
pub(crate) fn check_base64(bytes: &[u8]) -> bool {
    STANDARD.decode(dense(bytes)).is_ok()
}

fn dense(bytes: &[u8]) -> Vec<u8> {
    let dense = bytes.iter().filter(|byte| !byte.is_ascii_whitespace());
    dense.copied().collect()
}
