//! Times as text: FIPA00070 and RFC 3339.

use std::fmt;
use std::str::FromStr;

use crate::scan::{ONES, TOPS};

use super::{Base, Fields, Time, TimeError, Zone};

impl Time {
    /// Formats the time as RFC 3339 in UTC with milliseconds. Returns `None` for a relative time. A
    /// time without `Z` is taken as UTC.
    #[must_use]
    pub fn to_rfc3339(self) -> Option<String> {
        if self.is_relative() {
            return None;
        }
        Some(self.fields.date_and_time('T') + "Z")
    }

    /// Parses RFC 3339 text with any offset and any number of fractional digits, which are truncated
    /// to milliseconds. The result is in UTC.
    ///
    /// # Errors
    /// The text is not RFC 3339, or the year in UTC does not have four digits.
    pub fn from_rfc3339(text: &str) -> Result<Self, TimeError> {
        let parsed = parse_rfc3339(text).ok_or_else(|| syntax(text))?;
        let (fields, seconds_east) = parsed;
        let local = Self::new(Base::Absolute, Zone::Unspecified, fields)?;
        local.with_local_offset(seconds_east)
    }
}

/// Writes the form of FIPA00070 (`DateTime`).
impl fmt::Display for Time {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let sign = match self.base {
            Base::Absolute => "",
            Base::After => "+",
            Base::Before => "-",
        };
        let at = self.fields;
        write!(
            f,
            "{sign}{:04}{:02}{:02}T{:02}{:02}{:02}{:03}",
            at.year, at.month, at.day, at.hour, at.minute, at.second, at.millisecond
        )?;
        match self.zone {
            Zone::Unspecified => Ok(()),
            Zone::Utc => f.write_str("Z"),
            Zone::Letter(letter) => write!(f, "{letter}"),
        }
    }
}

impl FromStr for Time {
    type Err = TimeError;

    /// Parses the form of FIPA00070 (`DateTime`). `Z` instead of `T` is accepted too (JADE), and so is
    /// an offset from UTC behind an absolute time (`+0000`, fipa_acl). Such a time is converted to UTC.
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        if let Some(time) = parse_common(text.as_bytes()) {
            return Ok(time);
        }
        let (base, rest) = match text.as_bytes() {
            [b'+', rest @ ..] => (Base::After, rest),
            [b'-', rest @ ..] => (Base::Before, rest),
            rest => (Base::Absolute, rest),
        };
        let (fields, designator) = parse_fipa(rest).ok_or_else(|| syntax(text))?;
        let zone = match designator {
            [] => Zone::Unspecified,
            [letter] => Zone::of_letter(*letter).ok_or_else(|| syntax(text))?,
            [sign @ (b'+' | b'-'), h1, h2, m1, m2] if base == Base::Absolute => {
                let east = seconds_east(*sign, [*h1, *h2], [*m1, *m2]);
                let east = east.ok_or_else(|| syntax(text))?;
                return Self::new(base, Zone::Unspecified, fields)?.with_local_offset(east);
            }
            _ => return Err(syntax(text)),
        };
        Self::new(base, zone, fields)
    }
}

/// Parses a time in the common case: absolute, in UTC or without a zone, with a day up to 28 and a
/// second up to 59. All digits of a word are checked at once.
#[inline]
fn parse_common(text: &[u8]) -> Option<Time> {
    let (date, [b'T' | b'Z', rest @ ..]) = text.split_first_chunk::<8>()? else {
        return None;
    };
    let (time, [last @ b'0'..=b'9', designator @ ..]) = rest.split_first_chunk::<8>()? else {
        return None;
    };
    let zone = match designator {
        [] => Zone::Unspecified,
        b"Z" => Zone::Utc,
        _ => return None,
    };
    let (date, time) = (pairs(*date)?, pairs(*time)?);
    let [century, year, month, day] = date;
    let [hour, minute, second, tens] = time;
    let numbers = [century, year, month, day, hour, minute, second, tens];
    if !Fields::are_common(u64::from_le_bytes(numbers)) {
        return None;
    }
    let [numbers @ .., tens] = numbers;
    let millisecond = u16::from(tens) * 10 + u16::from(last - b'0');
    let fields = Fields::of_numbers(numbers, millisecond);
    let base = Base::Absolute;
    Some(Time { base, zone, fields })
}

/// Parses four numbers of two digits each, if all bytes are digits.
#[inline]
fn pairs(digits: [u8; 8]) -> Option<[u8; 4]> {
    const ZEROS: u64 = ONES * b'0' as u64;
    let word = u64::from_le_bytes(digits);
    let numbers = word ^ ZEROS;
    // Sets the top bit of each byte that is not a digit.
    let wrong = numbers | ((numbers & !TOPS) + ONES * (0x80 - 10));
    if wrong & TOPS != 0 {
        return None;
    }
    let [a, b, c, d, e, f, g, h] = numbers.to_le_bytes();
    Some([a * 10 + b, c * 10 + d, e * 10 + f, g * 10 + h])
}

fn syntax(text: &str) -> TimeError {
    TimeError::Syntax(text.chars().take(40).collect())
}

fn parse_fipa(text: &[u8]) -> Option<(Fields, &[u8])> {
    let (date, rest) = text.split_at_checked(8)?;
    let (time, designator) = match rest {
        [b'T' | b't' | b'Z' | b'z', rest @ ..] => rest.split_at_checked(9)?,
        _ => return None,
    };
    let fields = Fields {
        year: number(date.get(..4)?)?,
        month: number(date.get(4..6)?)?.try_into().ok()?,
        day: number(date.get(6..)?)?.try_into().ok()?,
        hour: number(time.get(..2)?)?.try_into().ok()?,
        minute: number(time.get(2..4)?)?.try_into().ok()?,
        second: number(time.get(4..6)?)?.try_into().ok()?,
        millisecond: number(time.get(6..)?)?,
    };
    Some((fields, designator))
}

/// Parses `YYYY-MM-DDThh:mm:ss[.fraction](Z|+hh:mm|-hh:mm)`. Returns the fields and the seconds east
/// of UTC.
fn parse_rfc3339(text: &str) -> Option<(Fields, i32)> {
    let text = text.as_bytes();
    let (local, rest) = text.split_at_checked(19)?;
    let separators: [(usize, &[u8]); 5] =
        [(4, b"-"), (7, b"-"), (10, b"Tt "), (13, b":"), (16, b":")];
    for (at, allowed) in separators {
        if !allowed.contains(local.get(at)?) {
            return None;
        }
    }
    let (fraction, zone) = match rest {
        [b'.', rest @ ..] => {
            let digits = rest.iter().take_while(|byte| byte.is_ascii_digit()).count();
            let (fraction, zone) = rest.split_at_checked(digits)?;
            (!fraction.is_empty()).then_some((fraction, zone))?
        }
        _ => (&b""[..], rest),
    };
    let millisecond = (0..3).fold(0, |ms, at| {
        ms * 10 + u16::from(fraction.get(at).map_or(0, |digit| digit - b'0'))
    });
    let seconds_east = match zone {
        b"Z" | b"z" => 0,
        [sign @ (b'+' | b'-'), h1, h2, b':', m1, m2] => {
            seconds_east(*sign, [*h1, *h2], [*m1, *m2])?
        }
        _ => return None,
    };
    let fields = Fields {
        year: number(local.get(..4)?)?,
        month: number(local.get(5..7)?)?.try_into().ok()?,
        day: number(local.get(8..10)?)?.try_into().ok()?,
        hour: number(local.get(11..13)?)?.try_into().ok()?,
        minute: number(local.get(14..16)?)?.try_into().ok()?,
        second: number(local.get(17..19)?)?.try_into().ok()?,
        millisecond,
    };
    Some((fields, seconds_east))
}

/// Returns the seconds east of UTC of an offset.
fn seconds_east(sign: u8, hours: [u8; 2], minutes: [u8; 2]) -> Option<i32> {
    let (hours, minutes) = (i32::from(number(&hours)?), i32::from(number(&minutes)?));
    if hours > 23 || minutes > 59 {
        return None;
    }
    let seconds = hours * 3600 + minutes * 60;
    Some(if sign == b'-' { -seconds } else { seconds })
}

/// Parses a number of at most four digits.
fn number(digits: &[u8]) -> Option<u16> {
    digits.iter().try_fold(0_u16, |value, digit| {
        let digit = digit.is_ascii_digit().then(|| digit - b'0')?;
        value.checked_mul(10)?.checked_add(u16::from(digit))
    })
}
