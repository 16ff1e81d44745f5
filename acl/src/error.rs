//! Errors of decoding and encoding, shared by all encodings.

use crate::Representation;

/// Bytes that are not what they should be: where, what is wrong, and the clause that says so.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("at byte {}: {} ({})", .0.offset, .0.problem, .0.clause)]
pub struct DecodeError(Box<ErrorPosition>);

/// Apart from the error, so that what succeeds does not carry room for it around.
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

    /// Where the offending bytes begin, counted from the start of what was decoded.
    #[must_use]
    pub fn offset(&self) -> usize {
        self.0.offset
    }

    /// The clause of the standard that is violated, for example `FIPA00069 2.1`.
    #[must_use]
    pub fn clause(&self) -> &'static str {
        self.0.clause
    }

    /// What is wrong.
    #[must_use]
    pub fn problem(&self) -> &Problem {
        &self.0.problem
    }
}

/// What can be wrong with encoded bytes.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Problem {
    /// The bytes end too early.
    #[error("the bytes end within {0}")]
    Truncated(&'static str),
    /// A byte that cannot stand there.
    #[error("unexpected byte {found:#04x} where {expected} should be")]
    Unexpected {
        /// The byte.
        found: u8,
        /// What should be there.
        expected: &'static str,
    },
    /// Text that is not UTF-8.
    #[error("the {0} is not UTF-8")]
    NotUtf8(&'static str),
    /// Text with a NUL character inside.
    #[error("the {0} has a NUL character")]
    Nul(&'static str),
    /// Text that must be a word and is not.
    #[error("the {0} is not a word")]
    NotAWord(&'static str),
    /// Text that must not be empty.
    #[error("the {0} is empty")]
    Empty(&'static str),
    /// Text that is too long.
    #[error("the {0} is too long")]
    TooLong(&'static str),
    /// Nesting deeper than accepted.
    #[error("{0} nested too deep")]
    TooDeep(&'static str),
    /// The message uses dynamic code tables, which both sides have to agree on beforehand, and was
    /// read without one.
    #[error("the message uses dynamic code tables, and was read without one")]
    CodeTable,
    /// The message refers to an entry that is not in the code table.
    #[error("there is no entry {0} in the code table")]
    NoSuchCode(usize),
    /// Digits that are not a number or not one of the range expected.
    #[error("malformed number")]
    Number,
    /// Digits that are not a date and time.
    #[error("no such date or time of day")]
    DateTime,
    /// Opening and closing of an expression do not match.
    #[error("unbalanced expression")]
    Unbalanced,
    /// Bytes behind the end of the message.
    #[error("{0} bytes behind the end")]
    Trailing(usize),
    /// The content that came beside the message is not the one that the message announces.
    #[error("the pieces of the split message do not fit together: {0}")]
    Split(&'static str),
    /// A mandatory parameter is missing.
    #[error("the {0} is missing")]
    Missing(&'static str),
    /// Content that was announced as Base64 and is not.
    #[error("the content is not Base64")]
    Base64,
    /// XML that is not well-formed, or uses what is not accepted from strangers.
    #[error("unacceptable XML: {0}")]
    Xml(&'static str),
    /// Another encoding than the one that is understood.
    #[error("the {0} representation is not supported here")]
    UnsupportedRepresentation(Representation),
    /// Neither a message nor an envelope in any known encoding.
    #[error("neither bit-efficient nor string nor XML")]
    UnknownRepresentation,
}

/// What an encoding cannot carry.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum EncodeError {
    /// There is more content than a length of 32 bits can say.
    #[error("content of {0} bytes (a message carries at most 4294967295)")]
    ContentTooLong(usize),
    /// An envelope of more bytes than a length of 32 bits can say.
    #[error("an envelope of {0} bytes is too long")]
    EnvelopeTooLong(usize),
    /// A mandatory parameter is missing.
    #[error("the {parameter} of {of} is missing")]
    Missing {
        /// The parameter.
        parameter: &'static str,
        /// What it is missing in.
        of: &'static str,
    },
    /// A parameter that has no place in this encoding.
    #[error("{of} cannot carry the parameter {parameter}")]
    NoPlace {
        /// The parameter.
        parameter: &'static str,
        /// What has no place for it.
        of: &'static str,
    },
    /// A text has a NUL character.
    #[error("the {0} has a NUL character")]
    Nul(&'static str),
    /// A text is empty that would be taken for absent.
    #[error("the {0} is empty; leave it out instead")]
    Empty(&'static str),
    /// The name of a user-defined parameter is not one word.
    #[error(
        "not a name for a user-defined parameter: {0:?} (one word without blanks, parentheses or \
         control characters, and without X-)"
    )]
    UserDefinedName(String),
    /// A value that the encoding or the reader it is for has no way to say.
    #[error("the {what} cannot be written: {why}")]
    Unrepresentable {
        /// The parameter.
        what: &'static str,
        /// What stands in the way.
        why: &'static str,
    },
    /// There is no such encoding of this kind of thing.
    #[error("there is no {0} representation to write this in")]
    UnsupportedRepresentation(Representation),
}
