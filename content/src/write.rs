//! Notation of strings, symbols, names and times, shared by the printer and the serializer.

use std::io::Write as _;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use fipa_acl::{Time, Zone};

use crate::SlDialect;
use crate::chars::{Shape, is_jade_operator, is_term_keyword, is_wff_keyword, truth};
use crate::error::PrintError;

/// Appends a string constant.
#[inline]
pub(crate) fn string(out: &mut Vec<u8>, dialect: SlDialect, text: &str) -> Result<(), PrintError> {
    let shape = Shape::of(text);
    if is_word(shape, dialect) && truth(text).is_none() {
        out.extend_from_slice(text.as_bytes());
        return Ok(());
    }
    quoted(out, dialect, text, shape)
}

/// Appends the name of a parameter or variable.
#[inline]
pub(crate) fn name(out: &mut Vec<u8>, dialect: SlDialect, text: &str) -> Result<(), PrintError> {
    let shape = Shape::of(text);
    if is_word(shape, dialect) {
        out.extend_from_slice(text.as_bytes());
        return Ok(());
    }
    quoted(out, dialect, text, shape)
}

/// Appends a proposition symbol.
pub(crate) fn proposition(
    out: &mut Vec<u8>,
    dialect: SlDialect,
    text: &str,
) -> Result<(), PrintError> {
    let shape = Shape::of(text);
    if is_word(shape, dialect) && !matches!(text, "true" | "false") {
        out.extend_from_slice(text.as_bytes());
        return Ok(());
    }
    quoted(out, dialect, text, shape)
}

/// Appends a function symbol. `arithmetic` is set if it has two arguments by position.
#[inline]
pub(crate) fn function_symbol(
    out: &mut Vec<u8>,
    dialect: SlDialect,
    text: &str,
    arithmetic: bool,
) -> Result<(), PrintError> {
    if dialect == SlDialect::Jade {
        if text.eq_ignore_ascii_case("sequence") || text.eq_ignore_ascii_case("set") {
            return Err(PrintError::Unrepresentable {
                what: "function symbol 'sequence' or 'set'",
                why: "JADE takes the term for a sequence or set",
            });
        }
        if arithmetic && matches!(text, "+" | "-" | "*" | "/" | "%") {
            out.extend_from_slice(text.as_bytes());
            return Ok(());
        }
    }
    symbol(out, dialect, text, is_term_keyword(text))
}

/// Appends a predicate symbol.
pub(crate) fn predicate_symbol(
    out: &mut Vec<u8>,
    dialect: SlDialect,
    text: &str,
) -> Result<(), PrintError> {
    symbol(out, dialect, text, is_wff_keyword(text))
}

fn symbol(
    out: &mut Vec<u8>,
    dialect: SlDialect,
    text: &str,
    is_keyword: bool,
) -> Result<(), PrintError> {
    let shape = Shape::of(text);
    let is_keyword = is_keyword || dialect == SlDialect::Jade && is_jade_operator(text);
    if is_word(shape, dialect) && !is_keyword {
        out.extend_from_slice(text.as_bytes());
        return Ok(());
    }
    quoted(out, dialect, text, shape)
}

/// Appends a byte-length encoded string.
pub(crate) fn bytes(out: &mut Vec<u8>, dialect: SlDialect, bytes: &[u8]) -> Result<(), PrintError> {
    match dialect {
        SlDialect::Standard => counted(out, bytes),
        SlDialect::Jade => counted(out, BASE64.encode(bytes).as_bytes()),
    }
}

/// Appends a date-time.
pub(crate) fn time(out: &mut Vec<u8>, dialect: SlDialect, time: Time) -> Result<(), PrintError> {
    if dialect == SlDialect::Jade {
        let why = if time.is_relative() {
            Some("JADE has no relative times in SL")
        } else if matches!(time.zone(), Zone::Letter(_)) {
            Some("JADE takes a time with another designator than Z for its local one")
        } else {
            None
        };
        if let Some(why) = why {
            let what = "date-time";
            return Err(PrintError::Unrepresentable { what, why });
        }
    }
    // Writing to memory cannot fail.
    let _ = write!(out, "{time}");
    Ok(())
}

#[inline]
fn is_word(shape: Shape, dialect: SlDialect) -> bool {
    shape.is_word() && (dialect == SlDialect::Standard || shape.is_ascii())
}

/// Appends the text in quotation marks, or as a byte-length encoded string if a reader could find
/// another end of the text.
fn quoted(
    out: &mut Vec<u8>,
    dialect: SlDialect,
    text: &str,
    shape: Shape,
) -> Result<(), PrintError> {
    if shape.has_backslashes() {
        match dialect {
            SlDialect::Standard if !is_quotable(text) => return counted(out, text.as_bytes()),
            SlDialect::Jade if text.ends_with('\\') => {
                return Err(PrintError::Unrepresentable {
                    what: "string that ends with a backslash",
                    why: "JADE takes the backslash and the quotation mark behind it for an escape",
                });
            }
            _ => {}
        }
    }
    out.reserve(text.len() + 2);
    out.push(b'"');
    if shape.has_quotes() {
        let mut pieces = text.split('"');
        out.extend_from_slice(pieces.next().unwrap_or_default().as_bytes());
        for piece in pieces {
            out.extend_from_slice(b"\\\"");
            out.extend_from_slice(piece.as_bytes());
        }
    } else {
        out.extend_from_slice(text.as_bytes());
    }
    out.push(b'"');
    Ok(())
}

/// Whether every reader finds the end of the text in quotation marks. The text must have no
/// quotation mark after a backslash, and no backslash at the end.
fn is_quotable(text: &str) -> bool {
    !text.ends_with('\\') && !text.contains("\\\"")
}

#[allow(
    clippy::unnecessary_wraps,
    reason = "a last expression of functions that can fail"
)]
fn counted(out: &mut Vec<u8>, bytes: &[u8]) -> Result<(), PrintError> {
    out.reserve(bytes.len() + 8);
    out.push(b'#');
    out.extend_from_slice(itoa::Buffer::new().format(bytes.len()).as_bytes());
    out.push(b'"');
    out.extend_from_slice(bytes);
    Ok(())
}
