//! Expressions: words, strings, numbers, and expressions of those in parentheses.

use std::borrow::Cow;

use crate::Text;
use crate::bitefficient::notes::{self, Notes};
use crate::bitefficient::reader::{Form, Reader, digit_chars, string_form, unescaped};
use crate::error::{DecodeError, Problem};
use crate::word::push_string_literal;

/// Deepest nesting of expressions that is accepted.
pub(crate) const MAX_EXPRESSION_DEPTH: usize = 64;

const CLAUSE: &str = "FIPA00069 2.1 BinExpression";

/// Reads a `BinExpression`: checked in one pass, nothing kept but where it is.
#[inline(always)]
pub(crate) fn expression<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
    what: &'static str,
) -> Result<Text<'a>, DecodeError> {
    match reader.short_text() {
        Some(text) => Ok(text),
        None => other_expression(reader, what),
    }
}

#[inline(never)]
fn other_expression<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
    what: &'static str,
) -> Result<Text<'a>, DecodeError> {
    let start = reader.position();
    if let Some(0x60 | 0x70..=0x79) = reader.peek() {
        reader.note(|| format!("{what}: an expression"));
    }
    let code = reader.byte(CLAUSE, what)?;
    match code {
        0x10 => reader.plain(CLAUSE, what).map(Text::plain),
        0x14 => reader.string(CLAUSE, what),
        // An opaque expression, a leftover of former editions: the string that follows is it.
        0xff => {
            let code = reader.byte(CLAUSE, what)?;
            string_after(reader, code, what)
        }
        0x16 | 0x17 | 0x19 => string_after(reader, code, what),
        0x12 | 0x13 => {
            reader.digits(CLAUSE)?;
            Ok(Text::encoded(reader.since(start)))
        }
        0x60 | 0x70..=0x79 => {
            reader.notes().deeper();
            check_levels(reader, code, what)?;
            reader.notes().shallower();
            Ok(Text::encoded(reader.since(start)))
        }
        0x11 | 0x15 | 0x18 => Err(reader.error(CLAUSE, Problem::CodeTable)),
        other => Err(reader.unexpected(CLAUSE, other, "an expression")),
    }
}

/// The text of a `BinString` whose code was read.
fn string_after<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
    code: u8,
    what: &'static str,
) -> Result<Text<'a>, DecodeError> {
    if code == 0x14 {
        return reader.string(CLAUSE, what);
    }
    if matches!(code, 0x15 | 0x18) {
        return Err(reader.error(CLAUSE, Problem::CodeTable));
    }
    let len = match code {
        0x16 => reader.u8_len(CLAUSE)?,
        0x17 => reader.u16_len(CLAUSE)?,
        0x19 => reader.u32_len(CLAUSE)?,
        other => return Err(reader.unexpected(CLAUSE, other, "a string")),
    };
    reader.counted(len, CLAUSE, what).map(Text::plain)
}

/// Walks over a parenthesised expression whose first byte was read, up to the parenthesis that
/// closes it.
fn check_levels<N: Notes>(
    reader: &mut Reader<'_, N>,
    first: u8,
    what: &'static str,
) -> Result<(), DecodeError> {
    let mut depth = 0_usize;
    let mut code = first;
    loop {
        match code {
            0x60 | 0x70..=0x79 => depth += 1,
            0x40 | 0x50..=0x59 => depth = depth.saturating_sub(1),
            _ => {}
        }
        if depth > MAX_EXPRESSION_DEPTH {
            return Err(reader.error(CLAUSE, Problem::TooDeep("expressions")));
        }
        if depth == 0 {
            // A token fused with the last parenthesis would stand outside of everything.
            return if code == 0x40 {
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

/// The kind of token that a code inside an expression announces.
enum Token {
    /// Nothing but the parenthesis.
    None,
    Word,
    Number,
    String,
    Len8,
    Len16,
    Len32,
}

/// FIPA00069 2.1: the code of Len32 is x9 among the strings, and x8 among the levels.
fn token_of(code: u8) -> Option<Token> {
    Some(match code {
        0x40 | 0x60 => Token::None,
        0x10 | 0x50 | 0x70 => Token::Word,
        0x12 | 0x13 | 0x52 | 0x53 | 0x72 | 0x73 => Token::Number,
        0x14 | 0x54 | 0x74 => Token::String,
        0x16 | 0x56 | 0x76 => Token::Len8,
        0x17 | 0x57 | 0x77 => Token::Len16,
        0x19 | 0x58 | 0x78 => Token::Len32,
        _ => return None,
    })
}

fn check_token<N: Notes>(
    reader: &mut Reader<'_, N>,
    code: u8,
    what: &'static str,
) -> Result<(), DecodeError> {
    let Some(token) = token_of(code) else {
        return Err(match code {
            0x11 | 0x15 | 0x18 | 0x51 | 0x55 | 0x59 | 0x71 | 0x75 | 0x79 => {
                reader.error(CLAUSE, Problem::CodeTable)
            }
            other => reader.unexpected(CLAUSE, other, "an expression"),
        });
    };
    match token {
        Token::None => {}
        Token::Word => {
            reader.plain(CLAUSE, what)?;
        }
        Token::Number => {
            reader.digits(CLAUSE)?;
        }
        Token::String => {
            reader.string(CLAUSE, what)?;
        }
        Token::Len8 => {
            string_after(reader, 0x16, what)?;
        }
        Token::Len16 => {
            string_after(reader, 0x17, what)?;
        }
        Token::Len32 => {
            string_after(reader, 0x19, what)?;
        }
    }
    Ok(())
}

/// Notes a token of an expression that was read from `start` on, behind its code, as FIPA00070
/// writes it.
fn note_token<N: Notes>(reader: &mut Reader<'_, N>, code: u8, start: usize) {
    let bytes = reader.since(start);
    let closes = matches!(code, 0x40 | 0x50..=0x59);
    let opens = matches!(code, 0x60 | 0x70..=0x79);
    if closes {
        reader.notes().shallower();
    }
    reader.note(|| {
        let mut token = String::new();
        // The bytes were checked just now: this cannot fail.
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

/// Writes a checked number or expression as FIPA00070 does.
pub(crate) fn render(bytes: &[u8]) -> String {
    let mut out = String::new();
    let mut reader = Reader::new(bytes);
    while let Some(code) = reader.peek() {
        reader.skip_peeked();
        match code {
            0x40 | 0x50..=0x59 => out.push(')'),
            0x60 | 0x70..=0x79 => {
                separate(&mut out);
                out.push('(');
            }
            _ => {}
        }
        // The bytes were checked when the message was read: this cannot fail.
        if render_token(&mut reader, code, &mut out).is_err() {
            break;
        }
    }
    out
}

fn render_token(reader: &mut Reader<'_>, code: u8, out: &mut String) -> Result<(), DecodeError> {
    let text = match token_of(code) {
        None | Some(Token::None) => return Ok(()),
        Some(Token::Word) => {
            separate(out);
            out.push_str(&Text::plain(reader.plain(CLAUSE, "word")?).as_str());
            return Ok(());
        }
        Some(Token::Number) => {
            separate(out);
            out.extend(digit_chars(reader.digits(CLAUSE)?).flatten());
            return Ok(());
        }
        Some(Token::String) => reader.string(CLAUSE, "string")?,
        Some(Token::Len8) => string_after(reader, 0x16, "string")?,
        Some(Token::Len16) => string_after(reader, 0x17, "string")?,
        Some(Token::Len32) => string_after(reader, 0x19, "string")?,
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

/// The content of a `14 String 00`, which need not be UTF-8.
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
    fn every_form_of_text() {
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
    fn expressions_are_written_out() {
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
    fn nonsense_is_refused() {
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
