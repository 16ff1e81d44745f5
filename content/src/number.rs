//! Numerical constants (FIPA00008 `NumericalConstant`).

use std::borrow::Cow;
use std::fmt;

/// An integer or a floating point number, as written, with any number of decimal or hexadecimal
/// digits.
///
/// Two numbers are equal if their texts are equal: `1`, `+1` and `0x1` differ.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Number<'a>(Cow<'a, str>);

impl<'a> Number<'a> {
    /// Reads the text of a number, for example `-4`, `0x1f`, `2.5` or `1e-3`.
    #[must_use]
    pub fn new(text: impl Into<Cow<'a, str>>) -> Option<Self> {
        let text = text.into();
        is_number(text.as_bytes()).then_some(Self(text))
    }

    /// Returns the number with this text, which the caller has checked.
    pub(crate) fn checked(text: &'a str) -> Self {
        Self(Cow::Borrowed(text))
    }

    /// Returns the text.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }

    /// Whether the text is that of an integer.
    #[must_use]
    pub fn is_integer(&self) -> bool {
        is_integer(self.0.as_bytes())
    }

    /// Returns the value of an integer that fits.
    #[must_use]
    pub fn as_i64(&self) -> Option<i64> {
        self.as_i128()?.try_into().ok()
    }

    /// Returns the value of an integer that fits.
    #[must_use]
    pub fn as_u64(&self) -> Option<u64> {
        self.as_i128()?.try_into().ok()
    }

    /// Returns the value of an integer that fits.
    #[must_use]
    pub fn as_i128(&self) -> Option<i128> {
        match integer(self.0.as_bytes())? {
            (false, magnitude) => i128::try_from(magnitude).ok(),
            (true, magnitude) => 0_i128.checked_sub_unsigned(magnitude),
        }
    }

    /// Returns the nearest floating point number. A text beyond the range of `f64` has none.
    #[must_use]
    pub fn as_f64(&self) -> Option<f64> {
        if self.is_hexadecimal() {
            let (negative, magnitude) = integer(self.0.as_bytes())?;
            #[allow(clippy::cast_precision_loss, reason = "the nearest one is meant")]
            let value = magnitude as f64;
            return Some(if negative { -value } else { value });
        }
        self.0.parse().ok().filter(|value: &f64| value.is_finite())
    }

    /// Returns the same number with an owned text.
    #[must_use]
    pub fn into_owned(self) -> Number<'static> {
        Number(Cow::Owned(self.0.into_owned()))
    }

    fn is_hexadecimal(&self) -> bool {
        is_hexadecimal(self.0.as_bytes())
    }
}

macro_rules! from_integers {
    ($($integer:ty),*) => {$(
        impl From<$integer> for Number<'_> {
            fn from(value: $integer) -> Self {
                Self(Cow::Owned(value.to_string()))
            }
        }
    )*};
}

from_integers!(i8, i16, i32, i64, i128, u8, u16, u32, u64, u128);

impl Number<'_> {
    /// Returns the number with the fewest digits that reads as this value. NaN and the infinities
    /// have no notation in SL.
    #[must_use]
    pub fn from_f64(value: f64) -> Option<Self> {
        value.is_finite().then(|| {
            Self(Cow::Owned(
                zmij::Buffer::new().format_finite(value).to_owned(),
            ))
        })
    }
}

impl fmt::Display for Number<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(&self.0)
    }
}

/// Whether the bytes are a number.
pub(crate) fn is_number(bytes: &[u8]) -> bool {
    let digits = unsigned(bytes);
    if is_hexadecimal(bytes) {
        return digits.len() > 2 && digits.iter().skip(2).all(u8::is_ascii_hexdigit);
    }
    let (whole, rest) = split_digits(digits);
    let (fraction, rest) = match rest {
        [b'.', rest @ ..] => split_digits(rest),
        _ => (&b""[..], rest),
    };
    if whole.is_empty() && fraction.is_empty() {
        return false;
    }
    match rest {
        [] => true,
        [b'e' | b'E', exponent @ ..] => {
            let (digits, rest) = split_digits(unsigned(exponent));
            !digits.is_empty() && rest.is_empty()
        }
        _ => false,
    }
}

/// Whether the bytes of a number are those of an integer.
pub(crate) fn is_integer(bytes: &[u8]) -> bool {
    is_hexadecimal(bytes) || unsigned(bytes).iter().all(u8::is_ascii_digit)
}

pub(crate) fn is_hexadecimal(bytes: &[u8]) -> bool {
    matches!(unsigned(bytes), [b'0', b'x' | b'X', ..])
}

/// Returns the sign and the magnitude of an integer, if it has at most 128 bits.
pub(crate) fn integer(bytes: &[u8]) -> Option<(bool, u128)> {
    let negative = bytes.first() == Some(&b'-');
    let digits = unsigned(bytes);
    let (radix, digits) = match digits {
        [b'0', b'x' | b'X', digits @ ..] => (16, digits),
        digits => (10, digits),
    };
    if digits.is_empty() {
        return None;
    }
    // Most integers are short, and arithmetic with 64 bits is faster.
    if radix == 10 && digits.len() < 20 {
        let value = digits.iter().try_fold(0_u64, |value, digit| {
            let digit = digit.wrapping_sub(b'0');
            (digit < 10).then(|| value * 10 + u64::from(digit))
        })?;
        return Some((negative, u128::from(value)));
    }
    let magnitude = digits.iter().try_fold(0_u128, |value, digit| {
        let digit = char::from(*digit).to_digit(radix)?;
        value
            .checked_mul(u128::from(radix))?
            .checked_add(digit.into())
    })?;
    Some((negative, magnitude))
}

/// A number with decimal digits, read in one pass.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Decimal {
    /// Length of the number, in bytes.
    pub(crate) len: usize,
    pub(crate) negative: bool,
    pub(crate) is_integer: bool,
    /// All digits without the point, if they fit.
    mantissa: Option<u64>,
    /// The power of ten that scales the mantissa.
    exponent: i32,
}

impl Decimal {
    /// Reads the number that the bytes begin with. Hexadecimal ones end after their zero.
    #[inline]
    pub(crate) fn scan(bytes: &[u8]) -> Option<Self> {
        /// Number of digits that always fits 64 bits.
        const MAX_DIGITS: usize = 19;
        let negative = bytes.first() == Some(&b'-');
        let begin = bytes.len() - unsigned(bytes).len();
        let mut at = begin;
        let mut mantissa = 0_u64;
        let mut digits = |at: &mut usize| {
            let first = *at;
            while let Some(digit) = bytes.get(*at).map(|byte| byte.wrapping_sub(b'0'))
                && digit < 10
            {
                mantissa = mantissa.wrapping_mul(10).wrapping_add(u64::from(digit));
                *at += 1;
            }
            *at - first
        };
        let mut total = digits(&mut at);
        let mut exponent = 0;
        let mut is_integer = true;
        if bytes.get(at) == Some(&b'.') {
            is_integer = false;
            at += 1;
            let fraction = digits(&mut at);
            total += fraction;
            exponent = i32::try_from(fraction).map_or(i32::MIN, |fraction| -fraction);
        }
        if total == 0 {
            return None;
        }
        if let Some(b'e' | b'E') = bytes.get(at) {
            is_integer = false;
            let rest = bytes.get(at + 1..).unwrap_or_default();
            let signed = rest.len() - unsigned(rest).len();
            let (digits, _) = split_digits(unsigned(rest));
            if digits.is_empty() {
                return None;
            }
            // Longer digits need the slower conversion.
            let value = std::str::from_utf8(digits)
                .ok()
                .and_then(|text| text.parse().ok());
            let value: i32 = value.unwrap_or(i32::MAX);
            let value = if rest.first() == Some(&b'-') {
                -value
            } else {
                value
            };
            exponent = exponent.saturating_add(value);
            at += 1 + signed + digits.len();
        }
        Some(Self {
            len: at,
            negative,
            is_integer,
            mantissa: (total <= MAX_DIGITS).then_some(mantissa),
            exponent,
        })
    }

    /// Returns the magnitude of an integer, if it has few digits.
    #[inline]
    pub(crate) fn magnitude(&self) -> Option<u64> {
        self.mantissa.filter(|_| self.is_integer)
    }

    /// Returns the value, if one multiplication or division of exact numbers gives it, which rounds
    /// once.
    #[inline]
    pub(crate) fn as_exact_f64(&self) -> Option<f64> {
        const POWERS: [f64; 23] = [
            1e0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8, 1e9, 1e10, 1e11, 1e12, 1e13, 1e14, 1e15,
            1e16, 1e17, 1e18, 1e19, 1e20, 1e21, 1e22,
        ];
        let mantissa = self.mantissa.filter(|mantissa| *mantissa < 1 << 53)?;
        let power = *POWERS.get(usize::try_from(self.exponent.unsigned_abs()).ok()?)?;
        #[allow(clippy::cast_precision_loss, reason = "it has at most 53 bits")]
        let value = mantissa as f64;
        let value = if self.exponent < 0 {
            value / power
        } else {
            value * power
        };
        Some(if self.negative { -value } else { value })
    }
}

fn unsigned(bytes: &[u8]) -> &[u8] {
    match bytes {
        [b'+' | b'-', rest @ ..] => rest,
        rest => rest,
    }
}

fn split_digits(bytes: &[u8]) -> (&[u8], &[u8]) {
    let digits = bytes
        .iter()
        .take_while(|byte| byte.is_ascii_digit())
        .count();
    bytes.split_at_checked(digits).unwrap_or((bytes, &[]))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn numbers_follow_the_grammar() {
        for number in [
            "0", "-1", "+1", "0x1F", "-0Xa", "1.", ".5", "+.5e-3", "1e9", "1.5E+9",
        ] {
            assert!(Number::new(number).is_some(), "{number:?}");
        }
        for other in [
            "", "-", "+", ".", "0x", "1a", "1e", "1e+", "1.5.", "0x1g", "--1", "inf", "NaN",
        ] {
            assert!(Number::new(other).is_none(), "{other:?}");
        }
    }

    proptest! {
        /// Compares with the numbers of the standard library.
        #[test]
        fn decimals_are_read_exactly(
            text in "[+-]?([0-9]{1,22}(\\.[0-9]{0,22})?|\\.[0-9]{1,22})([eE][+-]?[0-9]{1,3})?"
        ) {
            let decimal = Decimal::scan(text.as_bytes()).unwrap();
            prop_assert_eq!(decimal.len, text.len());
            prop_assert_eq!(decimal.is_integer, is_integer(text.as_bytes()));
            if let Some(value) = decimal.as_exact_f64() {
                prop_assert_eq!(value.to_bits(), text.parse::<f64>().unwrap().to_bits());
            }
            if let Some(value) = decimal.magnitude() {
                prop_assert_eq!(integer(text.as_bytes()), Some((decimal.negative, value.into())));
            }
        }

        #[test]
        fn what_is_scanned_is_a_number(text in "[+-]?[0-9.]{0,3}[eE]?[+-]?[0-9]{0,2}") {
            let scanned = Decimal::scan(text.as_bytes());
            let is_whole = scanned.is_some_and(|decimal| decimal.len == text.len());
            prop_assert_eq!(is_whole, is_number(text.as_bytes()));
        }
    }

    #[test]
    fn integers_of_any_length_are_kept() {
        let number = |text: &'static str| Number::new(text).unwrap();
        assert_eq!(number("18446744073709551615").as_u64(), Some(u64::MAX));
        assert_eq!(number("18446744073709551615").as_i64(), None);
        assert_eq!(number("-9223372036854775808").as_i64(), Some(i64::MIN));
        assert_eq!(number("-0x10").as_i64(), Some(-16));
        assert_eq!(number("-0x10").as_f64(), Some(-16.0));
        assert_eq!(Number::from(i128::MIN).as_i128(), Some(i128::MIN));
        let long = "9".repeat(100);
        let long = Number::new(long).unwrap();
        assert_eq!((long.as_i128(), long.as_f64()), (None, Some(1e100)));
        assert_eq!(number("1e999").as_f64(), None);
        assert_eq!(number("1.0").as_i64(), None);
        assert_eq!(Number::from_f64(f64::NAN), None);
        assert_eq!(Number::from_f64(0.2), Number::new("0.2"));
    }
}
