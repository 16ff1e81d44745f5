//! The values of elements and attributes: sequences of texts and CDATA sections, with references.

use std::borrow::Cow;

use memchr::memmem;

use crate::error::{DecodeError, Problem};
use crate::scan::{self, find_byte};
use crate::xml::reader::{Elements, Event};
use crate::{Text, Time};

/// Maximum length of a reference to a character, from `&` to `;`, in bytes.
const MAX_REFERENCE: usize = 12;

/// The treatment of the white space around a text. Escaped white space is always preserved.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Whitespace {
    Preserve,
    Trim,
}

/// A text without markup, or a CDATA section.
#[derive(Debug, Clone, Copy)]
pub(super) struct Piece<'a> {
    raw: &'a [u8],
    offset: usize,
    /// Whether the piece is from a CDATA section, which has no escapes.
    literal: bool,
}

impl<'a> Piece<'a> {
    pub(super) fn text(raw: &'a [u8], offset: usize) -> Self {
        let literal = false;
        Self {
            raw,
            offset,
            literal,
        }
    }

    pub(super) fn literal(raw: &'a [u8], offset: usize) -> Self {
        let literal = true;
        Self {
            raw,
            offset,
            literal,
        }
    }

    pub(super) fn is_blank(&self) -> bool {
        !self.literal && self.raw.trim_ascii().is_empty()
    }

    /// Whether the piece has no escapes.
    fn is_plain(&self) -> bool {
        self.literal || memchr::memchr(b'&', self.raw).is_none()
    }

    fn check(&self, clause: &'static str) -> Result<(), DecodeError> {
        if self.literal {
            return Ok(());
        }
        self.each(|_| ()).map_err(|rest| {
            let offset = self.offset + (self.raw.len() - rest);
            DecodeError::new(offset, clause, Problem::Xml("no such entity or character"))
        })
    }

    /// Refuses `]]>` outside of a CDATA section (XML 1.0 clause 2.4). fipa_services writes content
    /// with `]]>` into one section without escaping it. Accepting the rest would change the text.
    fn check_end_of_section(&self, clause: &'static str) -> Result<(), DecodeError> {
        match memmem::find(self.raw, b"]]>") {
            Some(at) if !self.literal => {
                let problem = Problem::Xml("']]>' outside of a CDATA section");
                Err(DecodeError::new(self.offset + at, clause, problem))
            }
            _ => Ok(()),
        }
    }

    fn unescape(&self, out: &mut Vec<u8>) {
        if self.literal {
            out.extend_from_slice(self.raw);
        } else {
            // Malformed references were refused when the value was read.
            let _ = self.each(|bytes| out.extend_from_slice(bytes));
        }
    }

    /// Passes the unescaped text to `give` in pieces. At a malformed reference, fails with the number
    /// of remaining bytes.
    fn each(&self, mut give: impl FnMut(&[u8])) -> Result<(), usize> {
        let mut rest = self.raw;
        while let Some(start) = memchr::memchr(b'&', rest) {
            let (before, reference) = rest.split_at(start);
            give(before);
            let shown = reference.get(..MAX_REFERENCE).unwrap_or(reference);
            let end = shown.iter().position(|byte| *byte == b';').unwrap_or(0);
            let Some(character) = reference.get(1..end).and_then(character) else {
                return Err(reference.len());
            };
            give(character.encode_utf8(&mut [0; 4]).as_bytes());
            rest = reference.get(end + 1..).unwrap_or_default();
        }
        give(rest);
        Ok(())
    }
}

/// Returns the character that the text between `&` and `;` stands for.
fn character(reference: &[u8]) -> Option<char> {
    let (digits, radix) = match reference {
        b"lt" => return Some('<'),
        b"gt" => return Some('>'),
        b"amp" => return Some('&'),
        b"quot" => return Some('"'),
        b"apos" => return Some('\''),
        [b'#', b'x' | b'X', digits @ ..] => (digits, 16),
        [b'#', digits @ ..] => (digits, 10),
        _ => return None,
    };
    let digits = std::str::from_utf8(digits).ok()?;
    if digits.starts_with('+') {
        return None;
    }
    let code = u32::from_str_radix(digits, radix).ok()?;
    char::from_u32(code).filter(|character| *character != '\0')
}

/// The value of an element or attribute, still escaped.
pub(super) struct Value<'a> {
    /// All bytes inside, including markup.
    pub(super) all: &'a [u8],
    first: Piece<'a>,
    /// Number of pieces.
    pieces: usize,
    is_blank: bool,
    pub(super) offset: usize,
    clause: &'static str,
}

impl<'a> Value<'a> {
    /// Creates a value without pieces.
    pub(super) fn new(offset: usize, clause: &'static str) -> Self {
        Self {
            all: &[],
            first: Piece::text(&[], offset),
            pieces: 0,
            is_blank: true,
            offset,
            clause,
        }
    }

    pub(super) fn attribute(raw: &'a [u8], offset: usize, clause: &'static str) -> Self {
        Self {
            all: raw,
            first: Piece::text(raw, offset),
            pieces: 1,
            is_blank: false,
            offset,
            clause,
        }
    }

    #[inline]
    pub(super) fn add(&mut self, piece: Piece<'a>) {
        if self.pieces == 0 {
            self.first = piece;
        }
        self.pieces += 1;
        self.is_blank = self.is_blank && piece.is_blank();
    }

    /// Whether the value has no text, not even white space.
    pub(super) fn is_empty(&self) -> bool {
        self.pieces == 0 || self.pieces == 1 && self.first.raw.is_empty()
    }

    pub(super) fn is_blank(&self) -> bool {
        self.is_blank
    }

    /// Returns the bytes if they are in one piece without escapes. Otherwise checks them.
    pub(super) fn bytes(&self) -> Result<Option<&'a [u8]>, DecodeError> {
        if self.pieces == 0 || self.pieces == 1 && self.first.is_plain() {
            return Ok(Some(self.first.raw));
        }
        if self.pieces == 1 {
            self.first.check(self.clause)?;
            return Ok(None);
        }
        let mut elements = Elements::inside(self.all);
        while let Some(event) = elements.next()? {
            match event {
                Event::Text(piece) => {
                    let piece = Piece {
                        offset: self.offset + piece.offset,
                        ..piece
                    };
                    piece.check(self.clause)?;
                    piece.check_end_of_section(self.clause)?;
                }
                Event::Start(_) => elements.skip()?,
                Event::End => break,
            }
        }
        Ok(None)
    }

    /// Returns the text.
    #[inline]
    pub(super) fn text(
        &self,
        space: Whitespace,
        what: &'static str,
    ) -> Result<Text<'a>, DecodeError> {
        let odd = |word| scan::zero(word) | word | scan::is(word, b'&') | scan::is(word, b'<');
        if self.pieces <= 1 && !scan::any(self.first.raw, odd) {
            return Ok(Text::plain(match space {
                Whitespace::Trim if !self.first.literal => self.first.raw.trim_ascii(),
                _ => self.first.raw,
            }));
        }
        self.text_slow(space, what)
    }

    #[inline(never)]
    fn text_slow(&self, space: Whitespace, what: &'static str) -> Result<Text<'a>, DecodeError> {
        let wrong = |problem| DecodeError::new(self.offset, self.clause, problem);
        if std::str::from_utf8(self.all).is_err() {
            return Err(wrong(Problem::NotUtf8(what)));
        }
        if memchr::memchr(0, self.all).is_some() {
            return Err(wrong(Problem::Nul(what)));
        }
        let text = match self.bytes()? {
            Some(plain) if self.first.literal || space == Whitespace::Preserve => {
                Text::plain(plain)
            }
            Some(plain) => Text::plain(plain.trim_ascii()),
            None if self.pieces == 1 => Text::xml(self.first.raw, space),
            None => Text::xml(self.all, space),
        };
        Ok(text)
    }

    /// Returns the text without the white space around it.
    #[inline]
    pub(super) fn trimmed(&self, what: &'static str) -> Result<Text<'a>, DecodeError> {
        self.text(Whitespace::Trim, what)
    }

    /// Parses the text as a date and time.
    pub(super) fn time(&self) -> Result<Time, DecodeError> {
        let wrong = |_| DecodeError::new(self.offset, self.clause, Problem::DateTime);
        self.trimmed("date")?.as_str().parse().map_err(wrong)
    }
}

/// Unescapes the inside of an element or attribute.
pub(crate) fn unescaped(inside: &[u8], space: Whitespace) -> Cow<'_, [u8]> {
    let trims = space == Whitespace::Trim;
    if find_byte(inside, b'<').is_none() && find_byte(inside, b'&').is_none() {
        return Cow::Borrowed(if trims { inside.trim_ascii() } else { inside });
    }
    let mut out = Vec::with_capacity(inside.len());
    let mut last: Option<Piece<'_>> = None;
    let mut elements = Elements::inside(inside);
    // An error cannot occur in checked bytes. It would end the text.
    while let Ok(Some(event)) = elements.next() {
        let mut piece = match event {
            Event::Text(piece) => piece,
            Event::Start(_) => match elements.skip() {
                Ok(()) => continue,
                Err(_) => break,
            },
            Event::End => break,
        };
        match last {
            Some(last) => last.unescape(&mut out),
            None if trims && !piece.literal => piece.raw = piece.raw.trim_ascii_start(),
            None => {}
        }
        last = Some(piece);
    }
    if let Some(mut last) = last {
        if trims && !last.literal {
            last.raw = last.raw.trim_ascii_end();
        }
        last.unescape(&mut out);
    }
    Cow::Owned(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_unescaped_and_trimmed() {
        for (inside, preserved, trimmed) in [
            (" a ", " a ", "a"),
            (" &lt;&#x20;", " < ", "< "),
            (" <![CDATA[ a ]]> ", "  a  ", " a "),
            ("a<!-- no -->b<x>no</x> c", "ab c", "ab c"),
            ("<![CDATA[&amp;]]>", "&amp;", "&amp;"),
        ] {
            let text = |space| unescaped(inside.as_bytes(), space).into_owned();
            assert_eq!(text(Whitespace::Preserve), preserved.as_bytes(), "{inside}");
            assert_eq!(text(Whitespace::Trim), trimmed.as_bytes(), "{inside}");
        }
    }
}
