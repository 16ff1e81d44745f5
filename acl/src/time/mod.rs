//! Absolute and relative times of FIPA (FIPA00070 `DateTime`, FIPA00069 `BinDateTimeToken`). This
//! module has no clock: the caller passes the current time.

mod calendar;
mod text;

use std::time::{Duration, SystemTime};

use crate::scan::{ONES, TOPS};

use self::calendar::{civil_from_days, days_from_civil, days_of_month};

/// A FIPA date-time with milliseconds.
///
/// A time is either absolute, in UTC or in an unspecified zone, or relative to the time at which it
/// is read. The text form is `20000508T042651481Z`. A relative time has a sign in front:
/// `+00000000T000030000`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Time {
    pub(crate) base: Base,
    pub(crate) zone: Zone,
    pub(crate) fields: Fields,
}

/// The reference of a [`Time`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[allow(clippy::exhaustive_enums, reason = "the standard is final")]
pub enum Base {
    /// The calendar.
    Absolute,
    /// The current time. The fields are added to it.
    After,
    /// The current time. The fields are subtracted from it.
    Before,
}

/// The zone of a [`Time`], which its type designator names.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[allow(clippy::exhaustive_enums, reason = "the standard is final")]
pub enum Zone {
    /// No designator: the local time of the writer (fipa_services, JADE).
    Unspecified,
    /// `Z`: UTC.
    Utc,
    /// Another letter. The standard does not define its meaning.
    Letter(char),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct Fields {
    pub(crate) year: u16,
    pub(crate) month: u8,
    pub(crate) day: u8,
    pub(crate) hour: u8,
    pub(crate) minute: u8,
    pub(crate) second: u8,
    pub(crate) millisecond: u16,
}

/// Error of making a [`Time`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum TimeError {
    /// The text has another form.
    #[error(
        "not a date-time: {0:?}; write for example 20000508T042651481Z, +00000000T000030000 or \
         2000-05-08T04:26:51.481Z"
    )]
    Syntax(String),
    /// A field is out of its range, for example month 13.
    #[error("invalid date or time of day: {0}")]
    Range(String),
    /// The year does not have four digits.
    #[error("the year of the time is not between 0 and 9999")]
    Year,
    /// The span is too long for a relative time. The value is in seconds.
    #[error("a span of {0} s is too long for a relative time")]
    Span(u64),
}

const DAY: u64 = 24 * 60 * 60;
/// Lengths of a year and a month in relative times, as JADE reads them.
const DAYS_PER_YEAR: u64 = 365;
const DAYS_PER_MONTH: u64 = 30;
const MS_PER_DAY: i64 = 86_400_000;

impl Time {
    /// Converts a system time to UTC, truncated to milliseconds.
    ///
    /// # Errors
    /// The year does not have four digits.
    pub fn from_system_time(time: SystemTime) -> Result<Self, TimeError> {
        let ms = match time.duration_since(SystemTime::UNIX_EPOCH) {
            Ok(after) => i64::try_from(after.as_millis()).map_err(|_| TimeError::Year)?,
            Err(before) => {
                // Truncates toward the past, as for times after 1970.
                let before = before.duration().as_nanos().div_ceil(1_000_000);
                -i64::try_from(before).map_err(|_| TimeError::Year)?
            }
        };
        Self::from_unix_ms(ms)
    }

    /// Creates a relative time: `span`, truncated to milliseconds, after the time of reading.
    ///
    /// # Errors
    /// The span is 10,000 years or more.
    pub fn after(span: Duration) -> Result<Self, TimeError> {
        Self::relative(Base::After, span)
    }

    /// Creates a relative time: `span`, truncated to milliseconds, before the time of reading.
    ///
    /// # Errors
    /// The span is 10,000 years or more.
    pub fn before(span: Duration) -> Result<Self, TimeError> {
        Self::relative(Base::Before, span)
    }

    /// The reference of the time.
    #[must_use]
    pub fn base(self) -> Base {
        self.base
    }

    /// Whether the time is relative to the time of reading.
    #[must_use]
    pub fn is_relative(self) -> bool {
        self.base != Base::Absolute
    }

    /// The zone of the time.
    #[must_use]
    pub fn zone(self) -> Zone {
        self.zone
    }

    /// Converts to a system time.
    ///
    /// A relative time is relative to `now`, with years of 365 and months of 30 days. An absolute
    /// time without `Z` is taken as UTC (see [`with_local_offset`](Self::with_local_offset)).
    #[must_use]
    pub fn to_system_time(self, now: SystemTime) -> SystemTime {
        let moved = match self.base {
            Base::Absolute => {
                let ms = self.unix_ms();
                let span = Duration::from_millis(ms.unsigned_abs());
                if ms < 0 {
                    SystemTime::UNIX_EPOCH.checked_sub(span)
                } else {
                    SystemTime::UNIX_EPOCH.checked_add(span)
                }
            }
            Base::After => now.checked_add(self.span()),
            Base::Before => now.checked_sub(self.span()),
        };
        // System times have four-digit years. Only a `now` at the limit of their range fails.
        moved.unwrap_or(now)
    }

    /// Returns the span from an earlier time that the same clock gave. `None` if that time is later, if a time
    /// is relative, or if only one of them is in UTC.
    #[must_use]
    pub fn span_since(self, earlier: Self) -> Option<Duration> {
        if self.is_relative() || earlier.is_relative() || self.zone != earlier.zone {
            return None;
        }
        let span = self.unix_ms().checked_sub(earlier.unix_ms())?;
        u64::try_from(span).ok().map(Duration::from_millis)
    }

    /// Converts an absolute time without `Z` from local time to UTC. Other times are unchanged.
    ///
    /// `seconds_east` is the number of seconds that the local time is ahead of UTC.
    ///
    /// # Errors
    /// The year in UTC does not have four digits.
    pub fn with_local_offset(self, seconds_east: i32) -> Result<Self, TimeError> {
        if self.is_relative() || self.zone == Zone::Utc {
            return Ok(self);
        }
        Self::from_unix_ms(self.unix_ms() - i64::from(seconds_east) * 1000)
    }

    /// Creates a time after checking the ranges of its fields.
    pub(crate) fn new(base: Base, zone: Zone, fields: Fields) -> Result<Self, TimeError> {
        let fits = match base {
            // A leap second is 60. System times do not count leap seconds.
            Base::Absolute => {
                (1..=12).contains(&fields.month)
                    && (1..=days_of_month(fields.year, fields.month)).contains(&fields.day)
                    && fields.hour < 24
                    && fields.minute < 60
                    && fields.second <= 60
            }
            Base::After | Base::Before => {
                let date = fields.month < 100 && fields.day < 100;
                date && fields.hour < 100 && fields.minute < 100 && fields.second < 100
            }
        };
        if !fits || fields.year > 9999 || fields.millisecond > 999 {
            return Err(TimeError::Range(fields.date_and_time(' ')));
        }
        Ok(Self { base, zone, fields })
    }

    fn relative(base: Base, span: Duration) -> Result<Self, TimeError> {
        let seconds = span.as_secs();
        let days = seconds / DAY;
        let year = u16::try_from(days / DAYS_PER_YEAR).map_err(|_| TimeError::Span(seconds))?;
        if year > 9999 {
            return Err(TimeError::Span(seconds));
        }
        let small = |value: u64| u8::try_from(value).unwrap_or(u8::MAX);
        let days = days % DAYS_PER_YEAR;
        let fields = Fields {
            year,
            month: small(days / DAYS_PER_MONTH),
            day: small(days % DAYS_PER_MONTH),
            hour: small(seconds % DAY / 3600),
            minute: small(seconds % 3600 / 60),
            second: small(seconds % 60),
            millisecond: u16::try_from(span.subsec_millis()).unwrap_or(999),
        };
        Self::new(base, Zone::Unspecified, fields)
    }

    fn span(self) -> Duration {
        let Fields {
            year, month, day, ..
        } = self.fields;
        let days =
            u64::from(year) * DAYS_PER_YEAR + u64::from(month) * DAYS_PER_MONTH + u64::from(day);
        let in_day = Duration::from_millis(self.fields.ms_of_day().into());
        Duration::from_secs(days * DAY) + in_day
    }

    fn from_unix_ms(ms: i64) -> Result<Self, TimeError> {
        let (year, month, day) = civil_from_days(ms.div_euclid(MS_PER_DAY));
        let in_day = ms.rem_euclid(MS_PER_DAY);
        let year = u16::try_from(year).map_err(|_| TimeError::Year)?;
        if year > 9999 {
            return Err(TimeError::Year);
        }
        let small = |value: i64| u8::try_from(value).unwrap_or(u8::MAX);
        let fields = Fields {
            year,
            month,
            day,
            hour: small(in_day / 3_600_000),
            minute: small(in_day / 60_000 % 60),
            second: small(in_day / 1000 % 60),
            millisecond: u16::try_from(in_day % 1000).unwrap_or(999),
        };
        Self::new(Base::Absolute, Zone::Utc, fields)
    }

    /// Milliseconds since 1970, with the zone taken as UTC.
    fn unix_ms(self) -> i64 {
        let Fields {
            year, month, day, ..
        } = self.fields;
        let days = days_from_civil(i64::from(year), month, day);
        days * MS_PER_DAY + i64::from(self.fields.ms_of_day())
    }
}

impl Fields {
    /// The fields up to the second are, in this order: century, year of the century, month, day, hour,
    /// minute, second.
    #[inline]
    pub(crate) fn of_numbers(numbers: [u8; 7], millisecond: u16) -> Self {
        let [century, year, month, day, hour, minute, second] = numbers;
        Self {
            year: u16::from(century) * 100 + u16::from(year),
            month,
            day,
            hour,
            minute,
            second,
            millisecond,
        }
    }

    /// Milliseconds since the beginning of the day.
    fn ms_of_day(self) -> u32 {
        let (hour, minute) = (u32::from(self.hour), u32::from(self.minute));
        let seconds = hour * 3600 + minute * 60 + u32::from(self.second);
        seconds * 1000 + u32::from(self.millisecond)
    }

    /// Formats the fields as RFC 3339 does, without a zone and with `between` in front of the hour.
    fn date_and_time(self, between: char) -> String {
        format!(
            "{:04}-{:02}-{:02}{between}{:02}:{:02}:{:02}.{:03}",
            self.year, self.month, self.day, self.hour, self.minute, self.second, self.millisecond
        )
    }

    /// Whether a time is in the common range: a valid month, a day up to 28, a valid hour and minute,
    /// and a second up to 59.
    ///
    /// The bytes of `numbers` are, from the lowest: century, year of the century, month, day, hour,
    /// minute, second, tens of milliseconds. None exceeds 99.
    #[inline]
    pub(crate) fn are_common(numbers: u64) -> bool {
        const LEAST: u64 = u64::from_le_bytes([0, 0, 1, 1, 0, 0, 0, 0]);
        const MOST: u64 = u64::from_le_bytes([99, 99, 12, 28, 23, 59, 59, 99]);
        // No byte carries into the next.
        let too_low = (numbers | TOPS) - LEAST;
        let too_high = numbers + (ONES * 0x7f - MOST);
        (!too_low | too_high) & TOPS == 0
    }
}

impl Zone {
    /// Returns the zone with this designator, which must be an ASCII letter.
    pub(crate) fn of_letter(letter: u8) -> Option<Self> {
        match letter {
            b'Z' | b'z' => Some(Self::Utc),
            letter if letter.is_ascii_alphabetic() => Some(Self::Letter(char::from(letter))),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn at(ms: u64) -> SystemTime {
        SystemTime::UNIX_EPOCH + Duration::from_millis(ms)
    }

    #[test]
    fn known_dates_are_converted() {
        for (ms, text, rfc3339) in [
            (0, "19700101T000000000Z", "1970-01-01T00:00:00.000Z"),
            (
                957_760_011_481,
                "20000508T042651481Z",
                "2000-05-08T04:26:51.481Z",
            ),
            (
                951_782_400_000,
                "20000229T000000000Z",
                "2000-02-29T00:00:00.000Z",
            ),
            (
                253_402_300_799_999,
                "99991231T235959999Z",
                "9999-12-31T23:59:59.999Z",
            ),
        ] {
            let time = Time::from_system_time(at(ms)).unwrap();
            assert_eq!(time.to_string(), text);
            assert_eq!(time.to_rfc3339().unwrap(), rfc3339);
            assert_eq!(text.parse(), Ok(time));
            assert_eq!(Time::from_rfc3339(rfc3339), Ok(time));
            assert_eq!(time.to_system_time(at(1)), at(ms));
        }
        assert!(Time::from_system_time(at(253_402_300_800_000)).is_err());
    }

    #[test]
    fn local_times_have_no_zone_until_they_get_an_offset() {
        let local: Time = "20101223T120037980".parse().unwrap();
        assert_eq!(local.zone(), Zone::Unspecified);
        assert_eq!(local.to_rfc3339().unwrap(), "2010-12-23T12:00:37.980Z");
        let utc = local.with_local_offset(3600).unwrap();
        assert_eq!(utc.to_string(), "20101223T110037980Z");
        assert_eq!(utc.with_local_offset(3600), Ok(utc));
        assert_eq!("20101223Z120037980".parse(), Ok(local));
    }

    #[test]
    fn offsets_and_fractions_of_rfc3339_are_read() {
        for (text, expected) in [
            ("2010-12-23T12:00:37+01:30", "20101223T103037000Z"),
            ("2010-12-23t12:00:37.9z", "20101223T120037900Z"),
            ("2010-12-23 12:00:37.123456-00:30", "20101223T123037123Z"),
        ] {
            assert_eq!(Time::from_rfc3339(text).unwrap().to_string(), expected);
        }
        for wrong in [
            "",
            "2010-12-23T12:00:37",
            "2010-12-23T12:00:37.Z",
            "2010-13-23T12:00:37Z",
            "2010-02-29T12:00:37Z",
            "2010-12-23T12:00:37+0100",
            "0000-01-01T00:00:00+23:59",
        ] {
            assert!(Time::from_rfc3339(wrong).is_err(), "{wrong:?}");
        }
    }

    #[test]
    fn numeric_zones_are_converted_to_utc() {
        for (text, expected) in [
            ("20261120T112644275+0000", "20261120T112644275Z"),
            ("20261120Z112644275+0130", "20261120T095644275Z"),
            ("20261231T233000000-0100", "20270101T003000000Z"),
        ] {
            let time = text.parse::<Time>().unwrap();
            assert_eq!(time.to_string(), expected);
        }
        for wrong in [
            "20261120T112644275+000",
            "20261120T112644275+2400",
            "20261120T112644275+0060",
            "20261120T112644275+00:00",
            "20261120T112644275 0000",
            "+00000000T000030000+0000",
            "00000101T000000000+0001",
        ] {
            assert!(wrong.parse::<Time>().is_err(), "{wrong:?}");
        }
    }

    #[test]
    fn relative_times_are_relative_to_now() {
        let time = Time::after(Duration::from_secs(30)).unwrap();
        assert_eq!(time.to_string(), "+00000000T000030000");
        assert_eq!(time.to_rfc3339(), None);
        assert_eq!(time.to_system_time(at(5)), at(30_005));
        let ago = Time::before(Duration::from_secs(400 * DAY)).unwrap();
        assert_eq!(ago.to_string(), "-00010105T000000000");
        assert!(Time::after(Duration::MAX).is_err());
    }

    #[test]
    fn malformed_times_are_refused() {
        for text in [
            "",
            "20000508",
            "20000508X042651481",
            "20000508T0426514",
            "20001308T042651481",
            "20000508T242651481",
            "20000508T042651481ZZ",
            "20000508T0426514811",
            "2000é508T042651481",
        ] {
            assert!(text.parse::<Time>().is_err(), "{text:?}");
        }
    }

    proptest! {
        #[test]
        fn every_time_is_the_same_after_a_round_trip(ms in 0_u64..253_402_300_800_000) {
            let time = Time::from_system_time(at(ms)).unwrap();
            prop_assert_eq!(time.to_string().parse(), Ok(time));
            prop_assert_eq!(Time::from_rfc3339(&time.to_rfc3339().unwrap()), Ok(time));
            prop_assert_eq!(time.to_system_time(at(0)), at(ms));
        }

        #[test]
        fn every_span_is_the_same_after_a_round_trip(ms in 0_u64..9_999 * 365 * 86_400_000) {
            let span = Duration::from_millis(ms);
            prop_assert_eq!(Time::after(span).unwrap().span(), span);
        }

        #[test]
        fn any_text_is_parsed_or_refused(text in "\\PC{0,40}") {
            let _ = text.parse::<Time>();
            let _ = Time::from_rfc3339(&text);
        }
    }
}
