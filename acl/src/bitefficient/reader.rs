//! Reading what both bit-efficient formats consist of, with every bound checked.

use std::borrow::Cow;

use crate::Text;
use crate::bitefficient::notes::{Notes, Silent};
use crate::error::{DecodeError, Problem};
use crate::scan::{Kind, ONES, TOPS, find_byte, near_text};
use crate::time::{Base, Fields, Time, Zone};

/// A place in bytes that came from outside.
#[derive(Debug, Clone)]
pub(crate) struct Reader<'a, N = Silent> {
    bytes: &'a [u8],
    /// Those that were not read yet.
    rest: &'a [u8],
    /// Where `bytes` begin in what is decoded, for errors.
    base: usize,
    /// Who is told what the bytes mean.
    notes: N,
}

type Result<T> = std::result::Result<T, DecodeError>;

impl<'a> Reader<'a> {
    pub(crate) fn new(bytes: &'a [u8]) -> Self {
        Self::noting(bytes, 0, Silent)
    }
}

impl<'a, N: Notes> Reader<'a, N> {
    /// A reader of bytes that begin at the offset `base` of what is decoded.
    pub(crate) fn noting(bytes: &'a [u8], base: usize, notes: N) -> Self {
        Self {
            bytes,
            rest: bytes,
            base,
            notes,
        }
    }

    /// What was read since the last note means this.
    #[inline(always)]
    pub(crate) fn note(&mut self, meaning: impl FnOnce() -> String) {
        let end = self.offset();
        self.notes.note(end, meaning);
    }

    /// Who is told what the bytes mean, to be told more.
    #[inline(always)]
    pub(crate) fn notes(&mut self) -> &mut N {
        &mut self.notes
    }

    /// Reads a set or sequence member by member up to its end, and gives the bytes in front of that.
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
            if self.take_if(0x01) {
                self.notes().shallower();
                self.note(|| format!("end of {name}"));
                return Ok(members);
            }
            member(self)?;
        }
    }

    /// A second reader at the same place, to look ahead; nobody is told what it reads.
    #[inline]
    pub(crate) fn ahead(&self) -> Reader<'a> {
        Reader {
            bytes: self.bytes,
            rest: self.rest,
            base: self.base,
            notes: Silent,
        }
    }

    /// Goes on where the one that looked ahead is.
    #[inline]
    pub(crate) fn follow(&mut self, ahead: &Reader<'a>) {
        self.rest = ahead.rest;
    }

    /// Goes on with other bytes, which begin at the offset `base`.
    pub(crate) fn go_on(&mut self, bytes: &'a [u8], base: usize) {
        self.bytes = bytes;
        self.rest = bytes;
        self.base = base;
    }

    /// How many bytes were read.
    #[inline]
    pub(crate) fn position(&self) -> usize {
        self.bytes.len() - self.rest.len()
    }

    /// Where the next byte stands in what is decoded.
    #[inline]
    pub(crate) fn offset(&self) -> usize {
        self.base + self.position()
    }

    #[inline]
    pub(crate) fn remaining(&self) -> usize {
        self.rest.len()
    }

    /// What was not read yet.
    pub(crate) fn rest(&self) -> &'a [u8] {
        self.rest
    }

    /// What was read since `start`, a former [`position`](Self::position).
    #[inline]
    pub(crate) fn since(&self, start: usize) -> &'a [u8] {
        self.bytes.get(start..self.position()).unwrap_or_default()
    }

    #[cold]
    pub(crate) fn error(&self, clause: &'static str, problem: Problem) -> DecodeError {
        DecodeError::new(self.offset(), clause, problem)
    }

    /// The error for the byte that was read last.
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

    /// Passes over the next byte, which was peeked at.
    #[inline]
    pub(crate) fn skip_peeked(&mut self) {
        self.rest = self.rest.get(1..).unwrap_or_default();
    }

    /// Reads the byte if it is the next one.
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

    /// The bytes up to the next NUL, which is read too.
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

    /// UTF-8 text up to the next NUL, as it stands.
    #[inline]
    pub(crate) fn plain(&mut self, clause: &'static str, what: &'static str) -> Result<&'a [u8]> {
        if let Some((text, rest, kind)) = near_text(self.rest)
            && kind.is_ascii()
        {
            self.rest = rest;
            return Ok(text);
        }
        self.other_plain(clause, what)
    }

    #[inline(never)]
    fn other_plain(&mut self, clause: &'static str, what: &'static str) -> Result<&'a [u8]> {
        let bytes = self.until_nul(clause, what)?;
        self.check_utf8(bytes, 1, clause, what)?;
        Ok(bytes)
    }

    /// The next text, if it is of the kind that nearly all are: short, in ASCII, and a word
    /// (`10 … 00`) or a string (`14 … 00`).
    #[inline(always)]
    pub(crate) fn short_text(&mut self) -> Option<Text<'a>> {
        let (&code, rest) = self.rest.split_first()?;
        if code & !0x04 != 0x10 {
            return None;
        }
        let (bytes, rest, kind) = near_text(rest)?;
        if !kind.is_ascii() {
            return None;
        }
        self.rest = rest;
        Some(if code == 0x10 {
            Text::plain(bytes)
        } else {
            Text::string(bytes)
        })
    }

    /// The next word, if it is short and in ASCII as nearly all are, and what kind it is.
    #[inline(always)]
    pub(crate) fn short_word(&mut self) -> Option<(&'a [u8], Kind)> {
        let [0x10, rest @ ..] = self.rest else {
            return None;
        };
        let (word, rest, kind) = near_text(rest)?;
        kind.is_ascii().then(|| {
            self.rest = rest;
            (word, kind)
        })
    }

    /// The next agent identifier, if it is of the kind that nearly all are: a short name in ASCII,
    /// and nothing else (`02 10 … 00 01`).
    #[inline(always)]
    pub(crate) fn short_agent_name(&mut self) -> Option<&'a [u8]> {
        let [0x02, 0x10, rest @ ..] = self.rest else {
            return None;
        };
        let (name, [0x01, rest @ ..], kind) = near_text(rest)? else {
            return None;
        };
        (kind.is_ascii() && !name.is_empty()).then(|| {
            self.rest = rest;
            name
        })
    }

    /// The same of an envelope, where a bare text stands for a word (`02 … 00 01`).
    #[inline(always)]
    pub(crate) fn short_bare_name(&mut self) -> Option<&'a [u8]> {
        let [0x02, rest @ ..] = self.rest else {
            return None;
        };
        let (name, [0x01, rest @ ..], kind) = near_text(rest)? else {
            return None;
        };
        let bare = !matches!(name, [] | [b'"' | b'#', ..]);
        (kind.is_ascii() && bare).then(|| {
            self.rest = rest;
            name
        })
    }

    /// A set of agent identifiers of a message that are of this kind, up to its end, which is read too.
    #[inline(always)]
    pub(crate) fn short_agent_names(&mut self) -> Option<&'a [u8]> {
        let mut ahead = self.ahead();
        let start = ahead.position();
        while ahead.short_agent_name().is_some() {}
        let names = ahead.since(start);
        ahead.take_if(0x01).then(|| {
            self.follow(&ahead);
            names
        })
    }

    /// UTF-8 text of this length.
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

    /// Text up to the next NUL, by the rule for `String 00` that fits every peer: in quotation
    /// marks (standard, fipa_services), with its length in front (fipa_services), or bare (JADE).
    #[inline(always)]
    pub(crate) fn string(&mut self, clause: &'static str, what: &'static str) -> Result<Text<'a>> {
        self.plain(clause, what).map(Text::string)
    }

    /// Checks bytes, `behind` which bytes more were read.
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

    /// The next date and time, if it is of the kind that nearly all are: on the calendar, in UTC or
    /// without a zone, and within what every month and every minute has.
    #[inline(always)]
    fn short_date_time(&mut self) -> Option<Time> {
        let (&[code, first @ .., last], rest) = self.rest.split_first_chunk::<10>()?;
        let numbers = all_digits(first).filter(|numbers| Fields::are_usual(*numbers))?;
        let [century, year, month, day, hour, minute, second, tens] = numbers.to_le_bytes();
        let (0x10..=0xa0, 0) = (last & 0xf0, last & 0x0f) else {
            return None;
        };
        let (zone, rest) = match (code, rest) {
            (0x20, rest) => (Zone::Unspecified, rest),
            (0x24, [b'Z', rest @ ..]) => (Zone::Utc, rest),
            _ => return None,
        };
        self.rest = rest;
        let fields = Fields {
            year: u16::from(century) * 100 + u16::from(year),
            month,
            day,
            hour,
            minute,
            second,
            millisecond: u16::from(tens) * 10 + u16::from(last >> 4) - 1,
        };
        let base = Base::Absolute;
        Some(Time { base, zone, fields })
    }

    /// A date and time after its code byte (FIPA00069 `BinDateTime`), which says what follows.
    #[inline(always)]
    pub(crate) fn date_time(&mut self, clause: &'static str) -> Result<Time> {
        match self.short_date_time() {
            Some(time) => Ok(time),
            None => self.other_date_time(clause),
        }
    }

    #[inline(never)]
    fn other_date_time(&mut self, clause: &'static str) -> Result<Time> {
        let code = self.byte(clause, "a date")?;
        let base = match code {
            0x20 | 0x24 => Base::Absolute,
            0x21 | 0x25 => Base::After,
            0x22 | 0x26 => Base::Before,
            other => return Err(self.unexpected(clause, other, "the code of a date")),
        };
        let offset = self.offset();
        let wrong = || DecodeError::new(offset, clause, Problem::DateTime);
        let digits = self.bytes(9, clause, "a date")?;
        let digits = <[u8; 9]>::try_from(digits).map_err(|_| wrong())?;
        let fields = bin_date(digits).ok_or_else(wrong)?;
        let zone = if code >= 0x24 {
            let letter = self.byte(clause, "a date")?;
            Zone::of_letter(letter).ok_or_else(wrong)?
        } else {
            Zone::Unspecified
        };
        Time::new(base, zone, fields).map_err(|_| wrong())
    }

    /// Digits (FIPA00069 2.2): ends behind the first byte whose low nibble is 0.
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

/// The way a `String` was written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Form {
    Quoted,
    Counted,
    Bare,
}

/// Takes off quotation marks or a byte count. The escapes in a quoted text remain.
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

/// What stands between quotation marks: `\"` becomes `"`; a backslash before anything else is a
/// backslash.
pub(crate) fn unescaped(inner: &[u8]) -> Cow<'_, [u8]> {
    // Nearly none has quotation marks at all, which is quicker found out.
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

/// The text behind `n"`, if it is of n bytes.
fn counted(bytes: &[u8]) -> Option<&[u8]> {
    // A length has at most 10 digits; looking no further keeps hostile input cheap.
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

/// The characters of digits that were read; `None` stands for a nibble without a meaning.
pub(crate) fn digit_chars(digits: &[u8]) -> impl Iterator<Item = Option<char>> + '_ {
    let nibbles = digits.iter().flat_map(|byte| [byte >> 4, byte & 0x0f]);
    // Only the last byte can have padding.
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

/// The nine bytes of `BinDate` (FIPA00069 2.3). Milliseconds are three digits and padding, or four
/// digits (fipa_services). The fields between year and milliseconds may be one digit and padding.
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
    let [century, year, month, day, hour, minute, second, tens] = numbers;
    let millisecond = if m2 & 0x0f == 0 {
        u16::from(tens) * 10 + u16::from(nibble(m2 >> 4)?)
    } else {
        u16::from(tens) * 100 + u16::from(two(m2)?)
    };
    Some(Fields {
        year: u16::from(century) * 100 + u16::from(year),
        month,
        day,
        hour,
        minute,
        second,
        millisecond,
    })
}

/// The numbers that eight times two digits are, if all of them are digits.
#[inline]
fn all_digits(bytes: [u8; 8]) -> Option<u64> {
    let word = u64::from_le_bytes(bytes);
    let (high, low) = (word >> 4 & (ONES * 0x0f), word & (ONES * 0x0f));
    // In every byte: the top bit is set where there is a padding nibble or none of a digit.
    let padding = |nibbles: u64| !(nibbles + ONES * 0x7f);
    let beyond = |nibbles: u64| nibbles + ONES * (0x80 - 11);
    let wrong = padding(high) | padding(low) | beyond(high) | beyond(low);
    (wrong & TOPS == 0).then(|| high * 10 + low - ONES * 11)
}

/// The number that two digits are.
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
    fn digits_of_the_clause() {
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
    fn milliseconds_of_three_and_of_four_digits() {
        let padded = [0x20, 0x31, 0x11, 0x16, 0x19, 0x15, 0x37, 0x62, 0x59, 0x20];
        let four = [0x20, 0x31, 0x11, 0x16, 0x19, 0x15, 0x37, 0x62, 0x15, 0x92];
        for bytes in [padded, four] {
            let time = Reader::new(&bytes).date_time("").unwrap();
            assert_eq!(time.to_string(), "20000508T042651481");
        }
    }

    #[test]
    fn the_form_of_strings() {
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
