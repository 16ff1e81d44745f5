//! Errors of reading SL text and of writing it.

/// Bytes that are not FIPA-SL: the offset, the problem, and the violated clause.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("at byte {}: {} ({})", .0.offset, .0.problem, .0.clause)]
pub struct ParseError(Box<Place>);

/// Boxed, so that successful results stay small.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Place {
    offset: usize,
    clause: &'static str,
    problem: Problem,
}

impl ParseError {
    #[cold]
    pub(crate) fn new(offset: usize, clause: &'static str, problem: Problem) -> Self {
        Self(Box::new(Place {
            offset,
            clause,
            problem,
        }))
    }

    /// Returns the same error for a text that starts `by` bytes earlier.
    #[cold]
    pub(crate) fn moved(mut self, by: usize) -> Self {
        self.0.offset += by;
        self
    }

    /// Returns the offset of the offending bytes from the start of the parsed bytes.
    #[must_use]
    pub fn offset(&self) -> usize {
        self.0.offset
    }

    /// Returns the violated production of the standard, for example `FIPA00008 Wff`.
    #[must_use]
    pub fn clause(&self) -> &'static str {
        self.0.clause
    }

    /// Returns the problem.
    #[must_use]
    pub fn problem(&self) -> &Problem {
        &self.0.problem
    }
}

/// Mistakes that SL text can have.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Problem {
    /// The bytes end too early.
    #[error("the bytes end within {0}")]
    Truncated(&'static str),
    /// A token that cannot stand there.
    #[error("unexpected {found} where {expected} should be")]
    Unexpected {
        /// The kind of the token.
        found: &'static str,
        /// The kind of token that should be there.
        expected: &'static str,
    },
    /// A byte that starts no token.
    #[error("the byte {0:#04x} begins no token")]
    Byte(u8),
    /// Text that is not UTF-8.
    #[error("the {0} is not UTF-8")]
    NotUtf8(&'static str),
    /// Digits that are not a number.
    #[error("malformed number")]
    Number,
    /// A number out of the range of the requested type.
    #[error("the number is out of range")]
    NumberRange,
    /// A date or a time of day that does not exist.
    #[error("no such date or time of day")]
    DateTime,
    /// A byte-length encoded string of a JADE peer that is not Base64.
    #[error("the byte string is not Base64")]
    Base64,
    /// More nested parentheses than [`MAX_DEPTH`](crate::MAX_DEPTH).
    #[error("nested deeper than {max}", max = crate::MAX_DEPTH)]
    TooDeep,
    /// More terms and formulas than [`MAX_NODES`](crate::MAX_NODES).
    #[error("more than {max} terms and formulas", max = crate::MAX_NODES)]
    TooMany,
    /// Bytes after the end.
    #[error("{0} bytes after the end")]
    Trailing(usize),
}

/// A value that SL, or the dialect of the reader, has no notation for.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum PrintError {
    /// A content without a content expression (FIPA00008 `Content` has at least one).
    #[error("a content has at least one content expression")]
    Empty,
    /// More nested parentheses than [`MAX_DEPTH`](crate::MAX_DEPTH).
    #[error("nested deeper than {max}", max = crate::MAX_DEPTH)]
    TooDeep,
    /// A value that the dialect has no notation for.
    #[error("the {what} cannot be written: {why}")]
    Unrepresentable {
        /// The kind of value.
        what: &'static str,
        /// The reason.
        why: &'static str,
    },
}
