//! The text of an error with its causes.

use std::error::Error;
use std::fmt;

/// Displays an error and its [sources](Error::source), separated by `: `.
///
/// The errors of this project have messages without the messages of their sources. To report an
/// error in one line, display this value:
///
/// ```
/// use std::fmt;
/// use std::num::ParseIntError;
///
/// use fipa_acl::ErrorChain;
///
/// #[derive(Debug)]
/// struct PortError(ParseIntError);
///
/// impl fmt::Display for PortError {
///     fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
///         f.write_str("not a port")
///     }
/// }
///
/// impl std::error::Error for PortError {
///     fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
///         Some(&self.0)
///     }
/// }
///
/// let error = PortError("arm".parse::<u16>().unwrap_err());
/// assert_eq!(ErrorChain(&error).to_string(), "not a port: invalid digit found in string");
/// ```
#[derive(Debug, Clone, Copy)]
pub struct ErrorChain<'a>(pub &'a (dyn Error + 'static));

impl fmt::Display for ErrorChain<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.0)?;
        let mut next = self.0.source();
        while let Some(error) = next {
            write!(f, ": {error}")?;
            next = error.source();
        }
        Ok(())
    }
}
