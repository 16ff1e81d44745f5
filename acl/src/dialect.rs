//! Whose hand to write in, where peers read less than the standard allows.

use std::fmt;

/// The user-defined parameter by which JADE says that content is Base64, without `X-`.
pub(crate) const JADE_ENCODING: &str = "JADE-Encoding";
/// The value that says so, whatever its case.
pub(crate) const BASE64: &str = "Base64";

/// Which reader an encoding is written for.
///
/// Reading needs none of this: every reader takes the standard and what both peers write.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Dialect {
    /// The standard to the letter.
    #[default]
    Standard,
    /// The C++ libraries `fipa_acl` and `fipa_services`.
    FipaServices,
    /// JADE with its add-ons.
    Jade,
}

impl fmt::Display for Dialect {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Standard => "standard",
            Self::FipaServices => "fipa_services",
            Self::Jade => "JADE",
        })
    }
}
