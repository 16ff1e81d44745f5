//! Errors of decoding and encoding, shared by all encodings.

use crate::Representation;

/// Error of decoding: the offset, the problem, and the violated clause of the standard.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("at byte {}: {} ({})", .0.offset, .0.problem, .0.clause)]
pub struct DecodeError(Box<ErrorPosition>);

/// The data of an error. It is boxed to keep `Result` values small.
#[derive(Debug, Clone, PartialEq, Eq)]
struct ErrorPosition {
    offset: usize,
    clause: &'static str,
    problem: Problem,
}

impl DecodeError {
    #[cold]
    pub(crate) fn new(offset: usize, clause: &'static str, problem: Problem) -> Self {
        Self(Box::new(ErrorPosition {
            offset,
            clause,
            problem,
        }))
    }

    /// Offset of the invalid bytes in the decoded input.
    #[must_use]
    pub fn offset(&self) -> usize {
        self.0.offset
    }

    /// The violated clause or production of the standard, for example `FIPA00069 2.2 BinWord`.
    #[must_use]
    pub fn clause(&self) -> &'static str {
        self.0.clause
    }

    /// The problem.
    #[must_use]
    pub fn problem(&self) -> &Problem {
        &self.0.problem
    }
}

/// A problem of encoded bytes.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Problem {
    /// The bytes end too early.
    #[error("the bytes end within {0}")]
    Truncated(&'static str),
    /// A byte that is not allowed at its position.
    #[error("found byte {found:#04x}, expected {expected}")]
    Unexpected {
        /// The byte.
        found: u8,
        /// The expected item.
        expected: &'static str,
    },
    /// Text that is not UTF-8.
    #[error("the {0} is not UTF-8")]
    NotUtf8(&'static str),
    /// Text with a NUL character.
    #[error("the {0} has a NUL character")]
    Nul(&'static str),
    /// Text that must be a word but is not.
    #[error("the {0} is not a word")]
    NotAWord(&'static str),
    /// Text that must not be empty.
    #[error("the {0} is empty")]
    Empty(&'static str),
    /// Text that is too long.
    #[error("the {0} is too long")]
    TooLong(&'static str),
    /// Items that are nested too deep, or too many of them.
    #[error("the {0} are nested too deep")]
    TooDeep(&'static str),
    /// The message uses dynamic code tables but was decoded without one. Both sides must agree on
    /// code tables beforehand.
    #[error("the message uses a dynamic code table; decode it with the table of its sender")]
    CodeTable,
    /// The message refers to a missing entry of the code table.
    #[error("the code table has no entry {0}")]
    NoSuchCode(usize),
    /// Digits that are not a number, or a number out of range.
    #[error("malformed number")]
    Number,
    /// Digits that are not a date and time.
    #[error("malformed or invalid date and time")]
    DateTime,
    /// Opening and closing parentheses of an expression do not match.
    #[error("the parentheses of the expression do not match")]
    Unbalanced,
    /// Bytes behind the end of the message.
    #[error("{0} unexpected bytes after the end")]
    Trailing(usize),
    /// The pieces of a split message do not form one message.
    #[error("the pieces of the split message do not match: {0}")]
    Split(&'static str),
    /// A mandatory parameter is missing.
    #[error("the {0} is missing")]
    Missing(&'static str),
    /// Content that is marked as Base64 but is not.
    #[error("the content is marked as Base64 but is not valid Base64")]
    Base64,
    /// XML that is not well-formed, or uses a feature that this reader refuses.
    #[error("invalid XML: {0}")]
    Xml(&'static str),
    /// An encoding that the reader does not support.
    #[error("the {0} representation is not supported here")]
    UnsupportedRepresentation(Representation),
    /// Neither a message nor an envelope in any known encoding.
    #[error("unknown representation: not bit-efficient, string or XML")]
    UnknownRepresentation,
}

/// Error of encoding a message or an envelope.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum EncodeError {
    /// The content is longer than [`Message::MAX_CONTENT`](crate::Message::MAX_CONTENT).
    #[error("content of {0} bytes is too long for a message (maximum 4294967295)")]
    ContentTooLong(usize),
    /// The envelope is longer than its length field allows: 32 bits, or 16 bits for
    /// fipa_services.
    #[error("an envelope of {0} bytes is too long for its length field")]
    EnvelopeTooLong(usize),
    /// A mandatory parameter is missing.
    #[error("the {parameter} of {of} is missing")]
    Missing {
        /// The parameter.
        parameter: &'static str,
        /// The item without the parameter.
        of: &'static str,
    },
    /// A parameter that the encoding does not define.
    #[error("{of} cannot have the parameter {parameter}")]
    NoPlace {
        /// The parameter.
        parameter: &'static str,
        /// The item that cannot have the parameter.
        of: &'static str,
    },
    /// A text has a NUL character.
    #[error("the {0} has a NUL character")]
    Nul(&'static str),
    /// A text is empty. Readers would take it for absent.
    #[error("the {0} is empty; omit it instead")]
    Empty(&'static str),
    /// The name of a user-defined parameter is not one word.
    #[error(
        "not a name of a user-defined parameter: {0:?}; give one word without blanks, parentheses \
         or control characters, and without X-"
    )]
    UserDefinedName(String),
    /// A value that the encoding or the dialect cannot represent.
    #[error("the {what} cannot be encoded: {why}")]
    Unrepresentable {
        /// The parameter.
        what: &'static str,
        /// The reason.
        why: &'static str,
    },
    /// The standards define no such encoding of an envelope.
    #[error("envelopes have no {0} representation")]
    UnsupportedRepresentation(Representation),
}
