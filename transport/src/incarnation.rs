//! Incarnations: identifiers of single registrations of a name.

use std::fmt;
use std::str::FromStr;

use crate::serde_text::serde_as_text;

/// One registration of an agent or of a message transport service.
///
/// Drawn at random for every registration. A name may be registered again after a crash or a move,
/// on this host or another. The incarnation tells the registrations apart, on which order and
/// deduplication depend. Zero is [`Incarnation::UNKNOWN`], for peers without incarnations
/// (fipa_services, JADE).
///
/// Written as 16 lower-case hexadecimal digits.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Default)]
pub struct Incarnation(u64);

impl Incarnation {
    /// The incarnation of a peer that has none.
    pub const UNKNOWN: Self = Self(0);

    /// Draws an incarnation from the operating system's random numbers.
    ///
    /// # Panics
    /// Panics if the operating system has no random numbers, which Linux rules out after boot.
    #[must_use]
    pub fn random() -> Self {
        loop {
            let drawn = getrandom::u64().expect("the operating system provides random numbers");
            if drawn != 0 {
                return Self(drawn);
            }
        }
    }

    /// The incarnation with this number; zero is [`Incarnation::UNKNOWN`].
    #[must_use]
    pub const fn from_u64(number: u64) -> Self {
        Self(number)
    }

    /// The number of this incarnation.
    #[must_use]
    pub const fn as_u64(self) -> u64 {
        self.0
    }

    /// Whether the incarnation is known, that is, not zero.
    #[must_use]
    pub const fn is_known(self) -> bool {
        self.0 != 0
    }
}

impl fmt::Display for Incarnation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:016x}", self.0)
    }
}

impl fmt::Debug for Incarnation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{self}")
    }
}

/// Text that is not an incarnation.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("not an incarnation (16 hexadecimal digits expected): {0:?}")]
pub struct IncarnationError(String);

impl FromStr for Incarnation {
    type Err = IncarnationError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        // Each letter over shared memory parses an incarnation; this takes a third of the instructions
        // of `from_str_radix`.
        let digits = |text: &str| {
            text.bytes().try_fold(0u64, |number, byte| {
                let digit = char::from(byte).to_digit(16)?;
                Some((number << 4) | u64::from(digit))
            })
        };
        let number = Some(text).filter(|text| text.len() == 16).and_then(digits);
        number
            .map(Self)
            .ok_or_else(|| IncarnationError(text.chars().take(40).collect()))
    }
}

serde_as_text!(Incarnation);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_round_trips_and_invalid_text_is_refused() {
        let incarnation = Incarnation::from_u64(0x00ab_cdef_0123_4567);
        assert_eq!(incarnation.to_string(), "00abcdef01234567");
        assert_eq!("00abcdef01234567".parse(), Ok(incarnation));
        for wrong in [
            "",
            "12",
            "+0abcdef01234567",
            "00abcdef0123456g",
            "00abcdef012345678",
        ] {
            assert!(wrong.parse::<Incarnation>().is_err(), "{wrong:?}");
        }
    }
}
