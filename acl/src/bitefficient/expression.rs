//! Expressions: words, strings, numbers, and sequences of expressions in parentheses (FIPA00069 2.2
//! `BinExpression`).

use std::borrow::Cow;

use crate::Text;
use crate::bitefficient::code::{self, TokenKind, closes_level, opens_level};
use crate::bitefficient::notes::{self, Notes};
use crate::bitefficient::reader::{Form, Reader, digit_chars, string_form, unescaped};
use crate::error::{DecodeError, Problem};
use crate::word::push_string_literal;

/// Maximum nesting depth of expressions that the reader accepts.
pub(crate) const MAX_EXPRESSION_DEPTH: usize = 64;

const CLAUSE: &str = "FIPA00069 2.2 BinExpression";

/// Reads and checks a `BinExpression` in one pass. The result borrows its bytes.
#[inline(always)]
pub(crate) fn expression<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
    what: &'static str,
) -> Result<Text<'a>, DecodeError> {
    match reader.short_text() {
        Some(text) => Ok(text),
        None => expression_slow(reader, what),
    }
}

#[inline(never)]
fn expression_slow<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
    what: &'static str,
) -> Result<Text<'a>, DecodeError> {
    let start = reader.position();
    if reader.peek().is_some_and(opens_level) {
        reader.note(|| format!("{what}: an expression"));
    }
    let first = reader.byte(CLAUSE, what)?;
    match first {
        code::token::WORD => reader.plain(CLAUSE, what).map(Text::plain),
        code::token::STRING => reader.string(CLAUSE, what),
        // An opaque expression, which earlier editions used: the string is its text.
        code::token::OPAQUE => {
            let first = reader.byte(CLAUSE, what)?;
            string_after(reader, first, what)
        }
        code::token::LEN8 | code::token::LEN16 | code::token::LEN32 => {
            string_after(reader, first, what)
        }
        code::token::NUMBER | code::token::HEX_NUMBER => {
            reader.digits(CLAUSE)?;
            Ok(Text::encoded(reader.since(start)))
        }
        first if opens_level(first) => {
            reader.notes().deeper();
            check_levels(reader, first, what)?;
            reader.notes().shallower();
            Ok(Text::encoded(reader.since(start)))
        }
        code::token::WORD_INDEX | code::token::STRING_INDEX | code::token::LEN_INDEX => {
            Err(reader.error(CLAUSE, Problem::CodeTable))
        }
        other => Err(reader.unexpected(CLAUSE, other, "an expression")),
    }
}

/// Reads the text of a `BinString` whose code was read.
fn string_after<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
    code: u8,
    what: &'static str,
) -> Result<Text<'a>, DecodeError> {
    let len = match code {
        code::token::STRING => return reader.string(CLAUSE, what),
        code::token::STRING_INDEX | code::token::LEN_INDEX => {
            return Err(reader.error(CLAUSE, Problem::CodeTable));
        }
        code::token::LEN8 => reader.u8_len(CLAUSE)?,
        code::token::LEN16 => reader.u16_len(CLAUSE)?,
        code::token::LEN32 => reader.u32_len(CLAUSE)?,
        other => return Err(reader.unexpected(CLAUSE, other, "a string")),
    };
    reader.counted(len, CLAUSE, what).map(Text::plain)
}

/// Checks an expression in parentheses up to the closing parenthesis. Its first byte was read.
fn check_levels<N: Notes>(
    reader: &mut Reader<'_, N>,
    first: u8,
    what: &'static str,
) -> Result<(), DecodeError> {
    let mut depth = 0_usize;
    let mut code = first;
    loop {
        if opens_level(code) {
            depth += 1;
        } else if closes_level(code) {
            depth = depth.saturating_sub(1);
        }
        if depth > MAX_EXPRESSION_DEPTH {
            return Err(reader.error(CLAUSE, Problem::TooDeep("expressions")));
        }
        if depth == 0 {
            // A token fused with the last parenthesis would be outside the expression.
            return if code == code::end::ALONE {
                let end = reader.position();
                note_token(reader, code, end);
                Ok(())
            } else {
                Err(reader.error(CLAUSE, Problem::Unbalanced))
            };
        }
        let start = reader.position();
        check_token(reader, code, what)?;
        note_token(reader, code, start);
        code = reader.byte(CLAUSE, what)?;
    }
}

fn check_token<N: Notes>(
    reader: &mut Reader<'_, N>,
    code: u8,
    what: &'static str,
) -> Result<(), DecodeError> {
    let Some(kind) = TokenKind::of(code) else {
        return Err(reader.unexpected(CLAUSE, code, "an expression"));
    };
    match kind {
        TokenKind::None => {}
        TokenKind::Word => {
            reader.plain(CLAUSE, what)?;
        }
        TokenKind::Number => {
            reader.digits(CLAUSE)?;
        }
        TokenKind::String => {
            reader.string(CLAUSE, what)?;
        }
        TokenKind::Len8 => {
            string_after(reader, code::token::LEN8, what)?;
        }
        TokenKind::Len16 => {
            string_after(reader, code::token::LEN16, what)?;
        }
        TokenKind::Len32 => {
            string_after(reader, code::token::LEN32, what)?;
        }
        TokenKind::TextIndex | TokenKind::LenIndex => {
            return Err(reader.error(CLAUSE, Problem::CodeTable));
        }
    }
    Ok(())
}

/// Notes a token of an expression in the form of FIPA00070. The bytes behind its code begin at
/// `start`.
fn note_token<N: Notes>(reader: &mut Reader<'_, N>, code: u8, start: usize) {
    let bytes = reader.since(start);
    let (opens, closes) = (opens_level(code), closes_level(code));
    if closes {
        reader.notes().shallower();
    }
    reader.note(|| {
        let mut token = String::new();
        // The bytes were checked, so this cannot fail.
        let _ = render_token(&mut Reader::new(bytes), code, &mut token);
        let parenthesis = match (opens, closes) {
            (true, _) => "(",
            (_, true) if token.is_empty() => ")",
            (_, true) => ") ",
            _ => "",
        };
        notes::plain(&format!("{parenthesis}{token}"))
    });
    if opens {
        reader.notes().deeper();
    }
}

/// Writes a checked number or expression in the form of FIPA00070.
pub(crate) fn render(bytes: &[u8]) -> String {
    let mut out = String::new();
    let mut reader = Reader::new(bytes);
    while let Some(code) = reader.peek() {
        reader.skip_peeked();
        if closes_level(code) {
            out.push(')');
        } else if opens_level(code) {
            separate(&mut out);
            out.push('(');
        }
        // The bytes were checked when the message was read, so this cannot fail.
        if render_token(&mut reader, code, &mut out).is_err() {
            break;
        }
    }
    out
}

fn render_token(reader: &mut Reader<'_>, code: u8, out: &mut String) -> Result<(), DecodeError> {
    let text = match TokenKind::of(code) {
        None | Some(TokenKind::None | TokenKind::TextIndex | TokenKind::LenIndex) => return Ok(()),
        Some(TokenKind::Word) => {
            separate(out);
            out.push_str(&Text::plain(reader.plain(CLAUSE, "word")?).as_str());
            return Ok(());
        }
        Some(TokenKind::Number) => {
            separate(out);
            out.extend(digit_chars(reader.digits(CLAUSE)?).flatten());
            return Ok(());
        }
        Some(TokenKind::String) => reader.string(CLAUSE, "string")?,
        Some(TokenKind::Len8) => string_after(reader, code::token::LEN8, "string")?,
        Some(TokenKind::Len16) => string_after(reader, code::token::LEN16, "string")?,
        Some(TokenKind::Len32) => string_after(reader, code::token::LEN32, "string")?,
    };
    separate(out);
    push_string_literal(out, &text.as_str());
    Ok(())
}

fn separate(out: &mut String) {
    if !out.is_empty() && !out.ends_with('(') {
        out.push(' ');
    }
}

/// Returns the content of a `14 String 00`, which need not be UTF-8.
pub(crate) fn string_content(bytes: &[u8]) -> Cow<'_, [u8]> {
    match string_form(bytes) {
        (Form::Quoted, inner) => unescaped(inner),
        (_, inner) => Cow::Borrowed(inner),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(bytes: &[u8]) -> Result<String, DecodeError> {
        let mut reader = Reader::new(bytes);
        let text = expression(&mut reader, "test")?;
        assert_eq!(reader.remaining(), 0);
        Ok(text.as_str().into_owned())
    }

    #[test]
    fn every_form_of_text_is_read() {
        for (bytes, text) in [
            (&b"\x10word\0"[..], "word"),
            (b"\x14\"a \\\"b\\\"\"\0", "a \"b\""),
            (b"\x14\"la\\ng\"\0", "la\\ng"),
            (b"\x14\"on\"to\"\0", "on\"to"),
            (b"\x14#3\"a\"b\0", "a\"b"),
            (b"\x14a b\0", "a b"),
            (b"\x16\x03a b", "a b"),
            (b"\x17\x00\x01a", "a"),
            (b"\x19\0\0\0\x01a", "a"),
            (b"\xff\x14\"(x)\"\0", "(x)"),
            (b"\x12\x53\x00", "42"),
            (b"\x13\x80", "7"),
        ] {
            assert_eq!(read(bytes).as_deref(), Ok(text), "{bytes:?}");
        }
    }

    #[test]
    fn expressions_are_rendered_as_strings() {
        let fused = b"\x70seq\0\x12\x53\0\x12\xe2\xf6\0\x14\"a\"\0\x40";
        assert_eq!(read(fused).unwrap(), "(seq 42 -1.5 \"a\")");
        assert_eq!(read(b"\x60\x10HI\0\x40").unwrap(), "(HI)");
        let levels = b"\x60\x60\x10a\0\x50b\0\x74\"c\"\0\x40\x40";
        assert_eq!(read(levels).unwrap(), "((a) b (\"c\"))");
        assert_eq!(
            read(b"\x78\0\0\0\x01a\x58\0\0\0\x01b")
                .unwrap_err()
                .problem(),
            &Problem::Unbalanced
        );
        assert_eq!(
            read(b"\x60\x78\0\0\0\x01a\x58\0\0\0\x01b\x40").unwrap(),
            "((\"a\") \"b\")"
        );
    }

    #[test]
    fn nesting_is_bounded() {
        let nested = |depth: usize| [vec![0x60; depth], vec![0x40; depth]].concat();
        assert!(read(&nested(MAX_EXPRESSION_DEPTH)).is_ok());
        let error = read(&nested(MAX_EXPRESSION_DEPTH + 1)).unwrap_err();
        assert_eq!(error.problem(), &Problem::TooDeep("expressions"));
        assert!(read(&vec![0x60; 1_000_000]).is_err());
    }

    #[test]
    fn malformed_expressions_are_refused() {
        for bytes in [
            &b""[..],
            b"\x10word",
            b"\x14\"a\"",
            b"\x16\x05a",
            b"\x16\x01\0",
            b"\x10\xff\0",
            b"\x15\0",
            b"\x60",
            b"\x60\x71\0\x40",
            b"\x40",
            b"\x99",
            b"\xff\x10a\0",
        ] {
            assert!(read(bytes).is_err(), "{bytes:?}");
        }
    }

    #[test]
    fn quoted_content_is_unescaped() {
        assert_eq!(
            string_content(br#""say \"hi\" \\ ""#),
            &br#"say "hi" \\ "#[..]
        );
        assert_eq!(string_content(b"#3\"\xff\"\\"), &b"\xff\"\\"[..]);
        assert_eq!(string_content(br#"raw \" text"#), &br#"raw \" text"#[..]);
    }
}
