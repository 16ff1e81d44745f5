//! The code that is shown on one host and typed on the other.

use std::fmt;
use std::str::FromStr;

/// Number of digits of a code.
const DIGITS: usize = 9;

/// A code for one pairing: 9 digits, about 30 bits, in the form `123-456-789`.
///
/// One attempt is allowed, so a guess succeeds with a probability of 1 to 1,000,000,000. `Debug` hides the digits.
#[derive(Clone, PartialEq, Eq)]
pub struct Code([u8; DIGITS]);

/// The error of reading a [`Code`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("a code has {DIGITS} digits, as in 123-456-789")]
#[non_exhaustive]
pub struct CodeError;

impl Code {
    /// Returns a new code.
    ///
    /// # Errors
    /// If the system has no random numbers.
    pub(super) fn random() -> Result<Self, getrandom::Error> {
        let count = 10_u64.pow(9);
        // Of the rest at the top, some codes would be more likely than others.
        let limit = u64::MAX - u64::MAX % count;
        loop {
            let number = getrandom::u64()?;
            if number < limit {
                return Ok(Self::from_number(number % count));
            }
        }
    }

    fn from_number(mut number: u64) -> Self {
        let mut digits = [0; DIGITS];
        for digit in digits.iter_mut().rev() {
            // Below 10.
            *digit = b'0' + (number % 10) as u8;
            number /= 10;
        }
        Self(digits)
    }

    /// The digits in ASCII.
    pub(super) fn digits(&self) -> &[u8] {
        &self.0
    }
}

/// Reads the digits, which blanks and hyphens may separate.
impl FromStr for Code {
    type Err = CodeError;

    fn from_str(text: &str) -> Result<Self, CodeError> {
        let mut digits = [0; DIGITS];
        let mut read = text.bytes().filter(|byte| !b" -\t\r\n".contains(byte));
        for digit in &mut digits {
            *digit = read.next().filter(u8::is_ascii_digit).ok_or(CodeError)?;
        }
        match read.next() {
            None => Ok(Self(digits)),
            Some(_) => Err(CodeError),
        }
    }
}

impl fmt::Display for Code {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (number, digit) in self.0.iter().enumerate() {
            let separator = if number > 0 && number % 3 == 0 {
                "-"
            } else {
                ""
            };
            write!(f, "{separator}{}", char::from(*digit))?;
        }
        Ok(())
    }
}

impl fmt::Debug for Code {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Code")
    }
}
