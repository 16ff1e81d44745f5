//! Dialects of SL.

use std::fmt;

/// The reader that SL text is written for, or the writer that it comes from.
///
/// In each dialect, reading accepts the notations of both, with one exception:
/// a byte-length encoded string (`#4"…`) is text or raw bytes in the standard, and Base64 in JADE.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum SlDialect {
    /// FIPA00008.
    #[default]
    Standard,
    /// JADE and its `SLCodec`.
    ///
    /// * `#n"` carries Base64, and strings are never written so.
    /// * Words are ASCII. Other text is written in quotation marks.
    /// * A content of several expressions has a blank after the last one.
    /// * `??x` is a meta-symbol. Times are absolute, integers have 64 bits.
    Jade,
}

impl fmt::Display for SlDialect {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Standard => "standard",
            Self::Jade => "JADE",
        })
    }
}
