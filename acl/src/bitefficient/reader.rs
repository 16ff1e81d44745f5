//! A reader of the elements that both bit-efficient encodings share. It checks every bound.

use std::borrow::Cow;

use crate::Text;
use crate::bitefficient::code;
use crate::bitefficient::notes::{NoNotes, Notes};
use crate::error::{DecodeError, Problem};
use crate::scan::{Kind, ONES, TOPS, find_byte, near_text};
use crate::time::{Base, Fields, Time, Zone};

/// A position in bytes that came from outside.
#[derive(Debug, Clone)]
pub(crate) struct Reader<'a, N = NoNotes> {
    bytes: &'a [u8],
    /// The bytes that were not read yet.
    rest: &'a [u8],
    /// Offset of `bytes` in the decoded input, for errors.
    base: usize,
    notes: N,
}

type Result<T> = std::result::Result<T, DecodeError>;

impl<'a> Reader<'a> {
    pub(crate) fn new(bytes: &'a [u8]) -> Self {
        Self::noting(bytes, 0, NoNotes)
    }
}

impl<'a, N: Notes> Reader<'a, N> {
    /// Creates a reader of bytes that begin at the offset `base` of the decoded input.
    pub(crate) fn noting(bytes: &'a [u8], base: usize, notes: N) -> Self {
        Self {
            bytes,
            rest: bytes,
            base,
            notes,
        }
    }

    /// Notes the meaning of the bytes read since the last note.
    #[inline(always)]
    pub(crate) fn note(&mut self, meaning: impl FnOnce() -> String) {
        let end = self.offset();
        self.notes.note(end, meaning);
    }

    /// Returns the receiver of the notes.
    #[inline(always)]
    pub(crate) fn notes(&mut self) -> &mut N {
        &mut self.notes
    }

    /// Reads a set or sequence member by member, including its end. Returns the bytes of the
    /// members.
    #[inline(always)]
    pub(crate) fn set<T>(
        &mut self,
        name: &'static str,
        mut member: impl FnMut(&mut Self) -> Result<T>,
    ) -> Result<&'a [u8]> {
        self.note(|| name.to_owned());
        self.notes().deeper();
        let start = self.position();
        loop {
            let members = self.since(start);
            if self.take_if(code::END) {
                self.notes().shallower();
                self.note(|| format!("end of {name}"));
                return Ok(members);
            }
            member(self)?;
        }
    }

    /// Returns a second reader at the same position, to look ahead. It takes no notes.
    #[inline]
    pub(crate) fn ahead(&self) -> Reader<'a> {
        Reader {
            bytes: self.bytes,
            rest: self.rest,
            base: self.base,
            notes: NoNotes,
        }
    }

    /// Moves to the position of the reader that looked ahead.
    #[inline]
    pub(crate) fn follow(&mut self, ahead: &Reader<'a>) {
        self.rest = ahead.rest;
    }

    /// Continues with other bytes, which begin at the offset `base`.
    pub(crate) fn continue_with(&mut self, bytes: &'a [u8], base: usize) {
        self.bytes = bytes;
        self.rest = bytes;
        self.base = base;
    }

    /// Number of bytes read.
    #[inline]
    pub(crate) fn position(&self) -> usize {
        self.bytes.len() - self.rest.len()
    }

    /// Offset of the next byte in the decoded input.
    #[inline]
    pub(crate) fn offset(&self) -> usize {
        self.base + self.position()
    }

    #[inline]
    pub(crate) fn remaining(&self) -> usize {
        self.rest.len()
    }

    /// The bytes that were not read yet.
    pub(crate) fn rest(&self) -> &'a [u8] {
        self.rest
    }

    /// The bytes read since `start`, an earlier [`position`](Self::position).
    #[inline]
    pub(crate) fn since(&self, start: usize) -> &'a [u8] {
        self.bytes.get(start..self.position()).unwrap_or_default()
    }

    #[cold]
    pub(crate) fn error(&self, clause: &'static str, problem: Problem) -> DecodeError {
        DecodeError::new(self.offset(), clause, problem)
    }

    /// Returns the error for the byte that was read last.
    #[cold]
    pub(crate) fn unexpected(
        &self,
        clause: &'static str,
        found: u8,
        expected: &'static str,
    ) -> DecodeError {
        let offset = self.offset().saturating_sub(1);
        DecodeError::new(offset, clause, Problem::Unexpected { found, expected })
    }

    #[inline]
    pub(crate) fn byte(&mut self, clause: &'static str, what: &'static str) -> Result<u8> {
        match self.rest.split_first() {
            Some((&byte, rest)) => {
                self.rest = rest;
                Ok(byte)
            }
            None => Err(self.error(clause, Problem::Truncated(what))),
        }
    }

    #[inline]
    pub(crate) fn peek(&self) -> Option<u8> {
        self.rest.first().copied()
    }

    /// Skips the next byte, which the caller has peeked at.
    #[inline]
    pub(crate) fn skip_peeked(&mut self) {
        self.rest = self.rest.get(1..).unwrap_or_default();
    }

    /// Reads the next byte if it equals `byte`.
    #[inline]
    pub(crate) fn take_if(&mut self, byte: u8) -> bool {
        match self.rest.split_first() {
            Some((next, rest)) if *next == byte => {
                self.rest = rest;
                true
            }
            _ => false,
        }
    }

    #[inline]
    pub(crate) fn bytes(
        &mut self,
        len: usize,
        clause: &'static str,
        what: &'static str,
    ) -> Result<&'a [u8]> {
        match self.rest.split_at_checked(len) {
            Some((taken, rest)) => {
                self.rest = rest;
                Ok(taken)
            }
            None => Err(self.error(clause, Problem::Truncated(what))),
        }
    }

    pub(crate) fn u8_len(&mut self, clause: &'static str) -> Result<usize> {
        self.byte(clause, "a length").map(usize::from)
    }

    pub(crate) fn u16_len(&mut self, clause: &'static str) -> Result<usize> {
        let bytes = self.bytes(2, clause, "a length")?;
        Ok(bytes
            .iter()
            .fold(0, |len, byte| len << 8 | usize::from(*byte)))
    }

    pub(crate) fn u32_len(&mut self, clause: &'static str) -> Result<usize> {
        let bytes = self.bytes(4, clause, "a length")?;
        let long = bytes
            .iter()
            .fold(0, |len, byte| len << 8 | u64::from(*byte));
        usize::try_from(long).map_err(|_| self.error(clause, Problem::TooLong("length")))
    }

    /// Reads the bytes up to the next NUL, and the NUL.
    #[inline]
    pub(crate) fn until_nul(
        &mut self,
        clause: &'static str,
        what: &'static str,
    ) -> Result<&'a [u8]> {
        if let Some((text, rest, _)) = near_text(self.rest) {
            self.rest = rest;
            return Ok(text);
        }
        let nul = memchr::memchr(0, self.rest);
        match nul.and_then(|nul| self.rest.split_at_checked(nul)) {
            Some((text, rest)) => {
                self.rest = rest.get(1..).unwrap_or_default();
                Ok(text)
            }
            None => Err(self.error(clause, Problem::Truncated(what))),
        }
    }

    /// Reads UTF-8 text up to the next NUL, and the NUL.
    #[inline]
    pub(crate) fn plain(&mut self, clause: &'static str, what: &'static str) -> Result<&'a [u8]> {
        if let Some((text, rest, kind)) = near_text(self.rest)
            && kind.is_ascii()
        {
            self.rest = rest;
            return Ok(text);
        }
        self.plain_slow(clause, what)
    }

    #[inline(never)]
    fn plain_slow(&mut self, clause: &'static str, what: &'static str) -> Result<&'a [u8]> {
        let bytes = self.until_nul(clause, what)?;
        self.check_utf8(bytes, 1, clause, what)?;
        Ok(bytes)
    }

    /// Reads the next text in the common case: a short ASCII word (`10 … 00`) or string (`14 … 00`).
    #[inline(always)]
    pub(crate) fn short_text(&mut self) -> Option<Text<'a>> {
        let (&first, rest) = self.rest.split_first()?;
        if !matches!(first, code::token::WORD | code::token::STRING) {
            return None;
        }
        let (bytes, rest, kind) = near_text(rest)?;
        if !kind.is_ascii() {
            return None;
        }
        self.rest = rest;
        Some(if first == code::token::WORD {
            Text::plain(bytes)
        } else {
            Text::string(bytes)
        })
    }

    /// Reads the next word and its kind in the common case: a short ASCII word.
    #[inline(always)]
    pub(crate) fn short_word(&mut self) -> Option<(&'a [u8], Kind)> {
        let [code::token::WORD, rest @ ..] = self.rest else {
            return None;
        };
        let (word, rest, kind) = near_text(rest)?;
        kind.is_ascii().then(|| {
            self.rest = rest;
            (word, kind)
        })
    }

    /// Reads the next agent identifier in the common case: a short ASCII name and no other part
    /// (`02 10 … 00 01`).
    #[inline(always)]
    pub(crate) fn short_agent_name(&mut self) -> Option<&'a [u8]> {
        let [code::agent::BEGIN, code::token::WORD, rest @ ..] = self.rest else {
            return None;
        };
        let (name, [code::END, rest @ ..], kind) = near_text(rest)? else {
            return None;
        };
        (kind.is_ascii() && !name.is_empty()).then(|| {
            self.rest = rest;
            name
        })
    }

    /// Reads the same in an envelope, where the name is a bare string (`02 … 00 01`).
    #[inline(always)]
    pub(crate) fn short_bare_name(&mut self) -> Option<&'a [u8]> {
        let [code::agent::BEGIN, rest @ ..] = self.rest else {
            return None;
        };
        let (name, [code::END, rest @ ..], kind) = near_text(rest)? else {
            return None;
        };
        let bare = !matches!(name, [] | [b'"' | b'#', ..]);
        (kind.is_ascii() && bare).then(|| {
            self.rest = rest;
            name
        })
    }

    /// Reads a set of agent identifiers of a message, including its end, if
    /// [`short_agent_name`](Self::short_agent_name) reads every one of them.
    #[inline(always)]
    pub(crate) fn short_agent_names(&mut self) -> Option<&'a [u8]> {
        let mut ahead = self.ahead();
        let start = ahead.position();
        while ahead.short_agent_name().is_some() {}
        let names = ahead.since(start);
        ahead.take_if(code::END).then(|| {
            self.follow(&ahead);
            names
        })
    }

    /// Reads UTF-8 text of `len` bytes.
    pub(crate) fn counted(
        &mut self,
        len: usize,
        clause: &'static str,
        what: &'static str,
    ) -> Result<&'a [u8]> {
        let offset = self.offset();
        let bytes = self.bytes(len, clause, what)?;
        if memchr::memchr(0, bytes).is_some() {
            return Err(DecodeError::new(offset, clause, Problem::Nul(what)));
        }
        self.check_utf8(bytes, 0, clause, what)?;
        Ok(bytes)
    }

    /// Reads a `String 00`.
    ///
    /// The three forms that peers write are accepted: in quotation marks (standard, fipa_services),
    /// with its length in front (fipa_services), and bare (JADE).
    #[inline(always)]
    pub(crate) fn string(&mut self, clause: &'static str, what: &'static str) -> Result<Text<'a>> {
        self.plain(clause, what).map(Text::string)
    }

    /// Checks the bytes that end `behind` bytes before the current position.
    fn check_utf8(
        &self,
        bytes: &[u8],
        behind: usize,
        clause: &'static str,
        what: &'static str,
    ) -> Result<()> {
        let Err(error) = std::str::from_utf8(bytes) else {
            return Ok(());
        };
        let offset = self.offset() - behind - bytes.len() + error.valid_up_to();
        Err(DecodeError::new(offset, clause, Problem::NotUtf8(what)))
    }

    /// Reads the next date and time in the common case: absolute, in UTC or without a zone, with a
    /// day up to 28 and a second up to 59.
    #[inline(always)]
    fn short_date_time(&mut self) -> Option<Time> {
        let (&[id, first @ .., last], rest) = self.rest.split_first_chunk::<10>()?;
        let numbers = all_digits(first).filter(|numbers| Fields::are_common(*numbers))?;
        let [numbers @ .., tens] = numbers.to_le_bytes();
        let (0x10..=0xa0, 0) = (last & 0xf0, last & 0x0f) else {
            return None;
        };
        let (zone, rest) = match (id, rest) {
            (code::date_time::ABSOLUTE, rest) => (Zone::Unspecified, rest),
            (code::date_time::ABSOLUTE_WITH_DESIGNATOR, [b'Z', rest @ ..]) => (Zone::Utc, rest),
            _ => return None,
        };
        self.rest = rest;
        let millisecond = u16::from(tens) * 10 + u16::from(last >> 4) - 1;
        let fields = Fields::of_numbers(numbers, millisecond);
        let base = Base::Absolute;
        Some(Time { base, zone, fields })
    }

    /// Reads a date and time with its code (FIPA00069 2.2 `BinDateTimeToken`).
    #[inline(always)]
    pub(crate) fn date_time(&mut self, clause: &'static str) -> Result<Time> {
        match self.short_date_time() {
            Some(time) => Ok(time),
            None => self.date_time_slow(clause),
        }
    }

    #[inline(never)]
    fn date_time_slow(&mut self, clause: &'static str) -> Result<Time> {
        let id = self.byte(clause, "a date")?;
        let (base, has_designator) = match id {
            code::date_time::ABSOLUTE => (Base::Absolute, false),
            code::date_time::AFTER => (Base::After, false),
            code::date_time::BEFORE => (Base::Before, false),
            code::date_time::ABSOLUTE_WITH_DESIGNATOR => (Base::Absolute, true),
            code::date_time::AFTER_WITH_DESIGNATOR => (Base::After, true),
            code::date_time::BEFORE_WITH_DESIGNATOR => (Base::Before, true),
            other => return Err(self.unexpected(clause, other, "the code of a date")),
        };
        let offset = self.offset();
        let wrong = || DecodeError::new(offset, clause, Problem::DateTime);
        let digits = self.bytes(9, clause, "a date")?;
        let digits = <[u8; 9]>::try_from(digits).map_err(|_| wrong())?;
        let fields = bin_date(digits).ok_or_else(wrong)?;
        let zone = if has_designator {
            let letter = self.byte(clause, "a date")?;
            Zone::of_letter(letter).ok_or_else(wrong)?
        } else {
            Zone::Unspecified
        };
        Time::new(base, zone, fields).map_err(|_| wrong())
    }

    /// Reads `Digits` up to the first byte with a low nibble of 0.
    ///
    /// FIPA00069 2.4, note 5: "If the ASCII presentation of a number contains odd number
    /// characters, the last four bits of the coded number are set to zero (the Padding token),
    /// otherwise an additional 0x00 byte is added to end of coded number."
    pub(crate) fn digits(&mut self, clause: &'static str) -> Result<&'a [u8]> {
        let last = self.rest.iter().position(|byte| byte & 0x0f == 0);
        let Some(last) = last else {
            return Err(self.error(clause, Problem::Truncated("a number")));
        };
        let digits = self.bytes(last + 1, clause, "a number")?;
        if digit_chars(digits).any(|char| char.is_none()) {
            let offset = self.offset() - digits.len();
            return Err(DecodeError::new(offset, clause, Problem::Number));
        }
        Ok(digits)
    }
}

/// The form in which a `String` is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Form {
    Quoted,
    Counted,
    Bare,
}

/// Removes quotation marks or a byte count. The escapes in a quoted text remain.
#[inline]
pub(crate) fn string_form(bytes: &[u8]) -> (Form, &[u8]) {
    match bytes {
        [b'"', inner @ .., b'"'] => (Form::Quoted, inner),
        [b'#', rest @ ..] => match counted(rest) {
            Some(text) => (Form::Counted, text),
            None => (Form::Bare, bytes),
        },
        _ => (Form::Bare, bytes),
    }
}

/// Unescapes the text between quotation marks: `\"` becomes `"`, and any other backslash stays.
pub(crate) fn unescaped(inner: &[u8]) -> Cow<'_, [u8]> {
    // Most texts have no quotation mark. Checking for one is faster than searching for escapes.
    let mut escapes = match find_byte(inner, b'"') {
        Some(_) => memchr::memmem::find_iter(inner, b"\\\"").peekable(),
        None => return Cow::Borrowed(inner),
    };
    if escapes.peek().is_none() {
        return Cow::Borrowed(inner);
    }
    let mut out = Vec::with_capacity(inner.len());
    let mut done = 0;
    for backslash in escapes {
        out.extend_from_slice(inner.get(done..backslash).unwrap_or_default());
        done = backslash + 1;
    }
    out.extend_from_slice(inner.get(done..).unwrap_or_default());
    Cow::Owned(out)
}

/// Returns the text behind `n"` if it has n bytes.
fn counted(bytes: &[u8]) -> Option<&[u8]> {
    // A length has at most 10 digits. The bound keeps hostile input cheap.
    let mark = bytes.iter().take(11).position(|&byte| byte == b'"')?;
    let (digits, text) = (bytes.get(..mark)?, bytes.get(mark + 1..)?);
    let mut len = 0_usize;
    for digit in digits {
        if !digit.is_ascii_digit() {
            return None;
        }
        len = len * 10 + usize::from(digit - b'0');
    }
    (!digits.is_empty() && len == text.len()).then_some(text)
}

/// Returns the characters of digits. `None` stands for an unassigned nibble.
pub(crate) fn digit_chars(digits: &[u8]) -> impl Iterator<Item = Option<char>> + '_ {
    let nibbles = digits.iter().flat_map(|byte| [byte >> 4, byte & 0x0f]);
    // Padding occurs in the last byte only.
    let count = digits.len() * 2;
    nibbles
        .enumerate()
        .filter(move |&(place, nibble)| !(nibble == 0 && place + 2 >= count))
        .map(|(_, nibble)| match nibble {
            1..=10 => Some(char::from(b'0' + nibble - 1)),
            12 => Some('+'),
            13 => Some('E'),
            14 => Some('-'),
            15 => Some('.'),
            _ => None,
        })
}

/// Decodes the nine bytes of a `BinDate`.
///
/// FIPA00069 2.4, note 8: "These fields always have static length (two bytes for year and
/// milliseconds, one byte for other components)."
///
/// Milliseconds are three digits and padding, or four digits (fipa_services). The fields between
/// year and milliseconds may be one digit and padding.
fn bin_date(digits: [u8; 9]) -> Option<Fields> {
    let [y1, y2, month, day, hour, minute, second, m1, m2] = digits;
    let first = [y1, y2, month, day, hour, minute, second, m1];
    let numbers = match all_digits(first) {
        Some(numbers) => numbers.to_le_bytes(),
        None => {
            let padded = |byte: u8| match (byte >> 4, byte & 0x0f) {
                (digit, 0) | (0, digit) => nibble(digit),
                _ => two(byte),
            };
            let fields = [month, day, hour, minute, second].map(padded);
            let [Some(a), Some(b), Some(c), Some(d), Some(e)] = fields else {
                return None;
            };
            [two(y1)?, two(y2)?, a, b, c, d, e, two(m1)?]
        }
    };
    let [numbers @ .., tens] = numbers;
    let millisecond = if m2 & 0x0f == 0 {
        u16::from(tens) * 10 + u16::from(nibble(m2 >> 4)?)
    } else {
        u16::from(tens) * 100 + u16::from(two(m2)?)
    };
    Some(Fields::of_numbers(numbers, millisecond))
}

/// Decodes eight numbers of two digits each, if all nibbles are digits.
#[inline]
fn all_digits(bytes: [u8; 8]) -> Option<u64> {
    let word = u64::from_le_bytes(bytes);
    let (high, low) = (word >> 4 & (ONES * 0x0f), word & (ONES * 0x0f));
    // Sets the top bit of each byte with a padding nibble or a nibble above the digits.
    let padding = |nibbles: u64| !(nibbles + ONES * 0x7f);
    let beyond = |nibbles: u64| nibbles + ONES * (0x80 - 11);
    let wrong = padding(high) | padding(low) | beyond(high) | beyond(low);
    (wrong & TOPS == 0).then(|| high * 10 + low - ONES * 11)
}

/// Decodes a number of two digits.
fn two(byte: u8) -> Option<u8> {
    Some(nibble(byte >> 4)? * 10 + nibble(byte & 0x0f)?)
}

fn nibble(nibble: u8) -> Option<u8> {
    (1..=10).contains(&nibble).then(|| nibble - 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn text_of(digits: &[u8]) -> String {
        let mut reader = Reader::new(digits);
        let read = reader.digits("").unwrap();
        assert_eq!(reader.remaining(), 0);
        digit_chars(read).map(Option::unwrap).collect()
    }

    #[test]
    fn digits_are_read_as_the_standard_codes_them() {
        for (bytes, text) in [
            (&[0x80][..], "7"),
            (&[0x53, 0x00], "42"),
            (&[0x21, 0x10], "100"),
            (&[0xe2, 0xf6, 0x00], "-1.5"),
            (&[0x76, 0x64, 0x70], "65536"),
            (&[0x2d, 0x21, 0x00], "1E10"),
        ] {
            assert_eq!(text_of(bytes), text);
        }
        assert!(Reader::new(&[0x53]).digits("").is_err(), "no end");
        assert!(Reader::new(&[0xb0]).digits("").is_err(), "B has no meaning");
        assert!(
            Reader::new(&[0x03, 0x10]).digits("").is_err(),
            "padding in front"
        );
    }

    #[test]
    fn milliseconds_with_three_or_four_digits_are_read() {
        let padded = [0x20, 0x31, 0x11, 0x16, 0x19, 0x15, 0x37, 0x62, 0x59, 0x20];
        let four = [0x20, 0x31, 0x11, 0x16, 0x19, 0x15, 0x37, 0x62, 0x15, 0x92];
        for bytes in [padded, four] {
            let time = Reader::new(&bytes).date_time("").unwrap();
            assert_eq!(time.to_string(), "20000508T042651481");
        }
    }

    #[test]
    fn the_form_of_a_string_is_detected() {
        for (bytes, form, text) in [
            (&b"\"hi\""[..], Form::Quoted, &b"hi"[..]),
            (b"#2\"hi", Form::Counted, b"hi"),
            (b"#3\"hi", Form::Bare, b"#3\"hi"),
            (b"#\"\"", Form::Bare, b"#\"\""),
            (b"#99999999999\"x", Form::Bare, b"#99999999999\"x"),
            (b"\"", Form::Bare, b"\""),
            (b"hi", Form::Bare, b"hi"),
            (b"", Form::Bare, b""),
        ] {
            assert_eq!(string_form(bytes), (form, text));
        }
    }
}
