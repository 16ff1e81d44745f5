//! The encodings of documents (XML 1.0 clause 4.3.3).

use std::borrow::Cow;

use crate::error::{DecodeError, Problem};

/// Maximum length of a declaration in bytes.
const MAX_DECLARATION: usize = 256;

/// The encoding that a document declares.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum DeclaredEncoding {
    /// UTF-8, or its part US-ASCII, or none: then a document is in UTF-8.
    Utf8,
    Latin1,
    Other,
}

impl DeclaredEncoding {
    /// Returns the encoding that the declaration at the beginning of the bytes names.
    pub(crate) fn of(bytes: &[u8]) -> Self {
        let Some(name) = declared(bytes) else {
            return Self::Utf8;
        };
        let is_one_of = |names: &[&[u8]]| names.iter().any(|it| name.eq_ignore_ascii_case(it));
        if is_one_of(&[b"UTF-8", b"UTF8", b"US-ASCII", b"ASCII"]) {
            Self::Utf8
        } else if is_one_of(&[b"ISO-8859-1", b"ISO8859-1", b"ISO8859_1", b"latin1"]) {
            Self::Latin1
        } else {
            Self::Other
        }
    }

    /// Returns a document, and what follows it, in UTF-8.
    pub(crate) fn in_utf8(self, bytes: &[u8]) -> Cow<'_, [u8]> {
        if self != Self::Latin1 || bytes.is_ascii() {
            return Cow::Borrowed(bytes);
        }
        let text: String = bytes.iter().map(|byte| char::from(*byte)).collect();
        Cow::Owned(text.into_bytes())
    }

    /// Returns the number of bytes that a part of the document in UTF-8 has in this encoding.
    pub(crate) fn len_of(self, utf8: &[u8]) -> usize {
        let is_first = |byte: &&u8| **byte & 0xc0 != 0x80;
        match self {
            Self::Latin1 => utf8.iter().filter(is_first).count(),
            Self::Utf8 | Self::Other => utf8.len(),
        }
    }

    /// Refuses a document with characters of an encoding that is not supported.
    pub(crate) fn check(self, document: &[u8], clause: &'static str) -> Result<(), DecodeError> {
        if self != Self::Other || document.is_ascii() {
            return Ok(());
        }
        let problem = "its declared encoding is neither UTF-8, US-ASCII nor ISO-8859-1";
        Err(DecodeError::new(0, clause, Problem::Xml(problem)))
    }
}

/// Returns the name of the declared encoding.
fn declared(bytes: &[u8]) -> Option<&[u8]> {
    let declaration = bytes.strip_prefix(b"<?xml")?;
    let declaration = declaration.get(..MAX_DECLARATION).unwrap_or(declaration);
    let end = memchr::memmem::find(declaration, b"?>")?;
    let declaration = declaration.get(..end)?;
    let at = memchr::memmem::find(declaration, b"encoding")?;
    let behind = declaration.get(at + b"encoding".len()..)?;
    let behind = behind.trim_ascii_start().strip_prefix(b"=")?;
    let (quote, behind) = behind.trim_ascii_start().split_first()?;
    if !matches!(quote, b'"' | b'\'') {
        return None;
    }
    let end = memchr::memchr(*quote, behind)?;
    behind.get(..end)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn declarations_name_encodings() {
        use DeclaredEncoding::{Latin1, Other, Utf8};
        for (document, expected) in [
            ("<envelope>", Utf8),
            ("<?xml version=\"1.0\"?>", Utf8),
            ("<?xml version=\"1.0\"?><a encoding=\"latin1\"?>", Utf8),
            ("<?xml version='1.0' encoding = 'utf-8' ?>", Utf8),
            ("<?xml version=\"1.0\" encoding=\"us-ascii\"?>", Utf8),
            ("<?xml version=\"1.0\" encoding=\"iso-8859-1\"?>", Latin1),
            ("<?xml version=\"1.0\" encoding=\"ISO-8859-15\"?>", Other),
            ("<?xml encoding=\"iso-8859-1", Utf8),
        ] {
            let found = DeclaredEncoding::of(document.as_bytes());
            assert_eq!(found, expected, "{document}");
        }
        let utf8 = Latin1.in_utf8(b"m\xfcller");
        assert_eq!((&*utf8, Latin1.len_of(&utf8)), ("müller".as_bytes(), 6));
    }
}
