//! Text parameters, borrowed from an encoded message or envelope.

use std::borrow::Cow;
use std::fmt;

use crate::bitefficient::expression::render;
use crate::bitefficient::reader::{Form, string_form, unescaped};
use crate::bitefficient::without_x;
use crate::word::is_token;
use crate::xml;

/// A text in an encoded message or envelope.
///
/// [`as_str`](Self::as_str) borrows most texts. It allocates a text with escapes, a number or an
/// expression.
#[derive(Clone, Copy)]
pub struct Text<'a>(pub(super) Repr<'a>);

/// The encoded bytes of a text. The reader has checked that they are UTF-8. They are not a `str`
/// because making one checks them again, and many texts are never accessed.
#[derive(Clone, Copy)]
pub(super) enum Repr<'a> {
    /// The text itself.
    Plain(&'a [u8]),
    /// A `String 00` of the bit-efficient encodings: in quotation marks, behind a byte count, or
    /// bare.
    String(&'a [u8]),
    /// The inside of quotation marks. `\"` stands for `"`.
    Quoted(&'a [u8]),
    /// A number or an expression in its bit-efficient form.
    Encoded(&'a [u8]),
    /// The inside of an XML element or attribute.
    Xml(&'a [u8], xml::Whitespace),
}

impl<'a> Text<'a> {
    /// The text. Numbers and expressions are in the form of FIPA00070.
    #[must_use]
    pub fn as_str(&self) -> Cow<'a, str> {
        match self.0 {
            Repr::Plain(text) => checked(text),
            Repr::String(bytes) => match string_form(bytes) {
                (Form::Quoted, inner) => all_checked(unescaped(inner)),
                (_, text) => checked(text),
            },
            Repr::Quoted(inner) => all_checked(unescaped(inner)),
            Repr::Encoded(bytes) => Cow::Owned(render(bytes)),
            Repr::Xml(bytes, space) => all_checked(xml::unescaped(bytes, space)),
        }
    }

    /// Whether the text is a `Word` apart from its first character.
    pub(crate) fn is_token(&self) -> bool {
        match self.0 {
            Repr::Plain(text) => is_token(text),
            _ => is_token(&*self.as_str()),
        }
    }

    /// Whether the text is empty.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        match self.0 {
            Repr::Plain(text) | Repr::Quoted(text) => text.is_empty(),
            Repr::String(bytes) => string_form(bytes).1.is_empty(),
            Repr::Encoded(_) => false,
            Repr::Xml(..) => self.as_str().is_empty(),
        }
    }

    /// The encoded bytes, including escapes, without quotation marks or a byte count.
    pub(crate) fn raw(&self) -> &'a [u8] {
        match self.0 {
            Repr::Plain(text) | Repr::Quoted(text) => text,
            Repr::String(bytes) => string_form(bytes).1,
            Repr::Encoded(bytes) | Repr::Xml(bytes, _) => bytes,
        }
    }

    /// Removes the `X-` of a user-defined name. Some peers write none.
    pub(crate) fn without_x(self) -> Self {
        Self(match self.0 {
            Repr::Plain(text) => Repr::Plain(without_x(text)),
            Repr::String(_) => Repr::Plain(without_x(self.raw())),
            Repr::Xml(bytes, space) => Repr::Xml(without_x(bytes), space),
            other @ (Repr::Quoted(_) | Repr::Encoded(_)) => other,
        })
    }

    /// Creates a text of checked UTF-8.
    #[inline(always)]
    pub(crate) fn plain(text: &'a [u8]) -> Self {
        Self(Repr::Plain(text))
    }

    /// Creates a text of a checked `String 00` without its NUL.
    #[inline(always)]
    pub(crate) fn string(bytes: &'a [u8]) -> Self {
        Self(Repr::String(bytes))
    }

    /// Creates a text of checked UTF-8 between quotation marks.
    #[inline]
    pub(crate) fn quoted(inner: &'a [u8]) -> Self {
        Self(Repr::Quoted(inner))
    }

    /// Creates a text of a checked number or expression of FIPA00069.
    pub(crate) fn encoded(bytes: &'a [u8]) -> Self {
        Self(Repr::Encoded(bytes))
    }

    /// Creates a text of checked XML.
    pub(crate) fn xml(bytes: &'a [u8], space: xml::Whitespace) -> Self {
        Self(Repr::Xml(bytes, space))
    }

    /// Whether the text is encoded in quotation marks.
    pub(crate) fn is_quoted(&self) -> bool {
        match self.0 {
            Repr::String(bytes) => string_form(bytes).0 == Form::Quoted,
            Repr::Quoted(_) => true,
            _ => false,
        }
    }

    /// Whether the text is encoded with a byte count. In envelopes, only fipa_services writes one.
    pub(crate) fn is_counted(&self) -> bool {
        matches!(self.0, Repr::String(bytes) if string_form(bytes).0 == Form::Counted)
    }
}

fn checked(text: &[u8]) -> Cow<'_, str> {
    match std::str::from_utf8(text) {
        Ok(text) => Cow::Borrowed(text),
        // The reader has checked the bytes, so this does not occur.
        Err(_) => String::from_utf8_lossy(text),
    }
}

fn all_checked(text: Cow<'_, [u8]>) -> Cow<'_, str> {
    match text {
        Cow::Borrowed(text) => checked(text),
        Cow::Owned(text) => match String::from_utf8(text) {
            Ok(text) => Cow::Owned(text),
            Err(error) => Cow::Owned(String::from_utf8_lossy(error.as_bytes()).into_owned()),
        },
    }
}

/// Compares the texts, not their encoded bytes.
impl PartialEq for Text<'_> {
    fn eq(&self, other: &Self) -> bool {
        self.as_str() == other.as_str()
    }
}

impl Eq for Text<'_> {}

impl PartialEq<str> for Text<'_> {
    fn eq(&self, other: &str) -> bool {
        self.as_str() == other
    }
}

impl PartialEq<&str> for Text<'_> {
    fn eq(&self, other: &&str) -> bool {
        self.as_str() == *other
    }
}

impl fmt::Display for Text<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(&self.as_str())
    }
}

impl fmt::Debug for Text<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:?}", self.as_str())
    }
}
