//! Escaping of text from outside for a terminal or a log.
//!
//! Names, contents and reasons come from peers and files. A control character can move the cursor
//! of a terminal or draw a line that looks like the program's own, and a bidirectional character
//! changes the order in which a line is read. [`escape`] makes them visible.
//!
//! The escapes of formats such as XML or Mermaid do not belong here.

use std::borrow::Cow;
use std::fmt::Write as _;

use crate::word::is_token;

/// Returns the text with each [unprintable](is_unprintable) character written as `\u{…}` in
/// hexadecimal digits: `\u{1b}`.
///
/// A `\` in front of `u{` is written `\u{5c}`. So two different texts have different results. All
/// other text is unchanged. The result is one line.
#[must_use]
pub fn escape(text: &str) -> Cow<'_, str> {
    let Some(first) = first_to_escape(text) else {
        return Cow::Borrowed(text);
    };
    let (plain, mut rest) = text.split_at(first);
    let mut out = String::with_capacity(text.len() + 16);
    out.push_str(plain);
    while let Some(c) = rest.chars().next() {
        if is_escaped(c, rest) {
            // Writing to a string cannot fail.
            let _ = write!(out, "\\u{{{:x}}}", u32::from(c));
        } else {
            out.push(c);
        }
        rest = rest.get(c.len_utf8()..).unwrap_or_default();
    }
    Cow::Owned(out)
}

/// Returns a name from outside as part of a line: [escaped](escape), and in quotation marks unless it is one word
/// (for example `rover-1`).
///
/// A name may have blanks, colons and parentheses. Without quotation marks, the agent `a :receiver b` would look like
/// an agent with a receiver, and `a to b` like two agents.
#[must_use]
pub fn escape_name(name: &str) -> Cow<'_, str> {
    let escaped = escape(name);
    let is_word = is_token(&*escaped)
        && !escaped.starts_with([':', '"'])
        && !escaped.contains(char::is_whitespace);
    if is_word {
        return escaped;
    }
    Cow::Owned(quote(name))
}

/// Returns a text in quotation marks, with `\` before each quotation mark and `\` in it, and each
/// [unprintable](is_unprintable) character as in [`escape`].
pub(crate) fn quote(text: &str) -> String {
    let mut out = String::with_capacity(text.len() + 16);
    out.push('"');
    for c in text.chars() {
        match c {
            '"' | '\\' => out.extend(['\\', c]),
            c if is_unprintable(c) => {
                // Writing to a string cannot fail.
                let _ = write!(out, "\\u{{{:x}}}", u32::from(c));
            }
            c => out.push(c),
        }
    }
    out.push('"');
    out
}

/// Whether the character can change how a terminal or a reader interprets a text, or is invisible.
///
/// These are the control characters (Cc), the format characters (Cf), which include the
/// bidirectional ones, the separators of lines and paragraphs (Zl, Zp), and the characters that are
/// not shown if a font lacks them (`Default_Ignorable_Code_Point`) of Unicode 17.
#[must_use]
pub fn is_unprintable(c: char) -> bool {
    match c {
        ' '..='~' => false,
        '\0'..='\u{9f}' => true,
        _ => matches!(
            c,
            '\u{ad}'
                | '\u{34f}'
                | '\u{600}'..='\u{605}'
                | '\u{61c}'
                | '\u{6dd}'
                | '\u{70f}'
                | '\u{890}'..='\u{891}'
                | '\u{8e2}'
                | '\u{115f}'..='\u{1160}'
                | '\u{17b4}'..='\u{17b5}'
                | '\u{180b}'..='\u{180f}'
                | '\u{200b}'..='\u{200f}'
                | '\u{2028}'..='\u{202e}'
                | '\u{2060}'..='\u{206f}'
                | '\u{3164}'
                | '\u{fe00}'..='\u{fe0f}'
                | '\u{feff}'
                | '\u{ffa0}'
                | '\u{fff0}'..='\u{fffb}'
                | '\u{110bd}'
                | '\u{110cd}'
                | '\u{13430}'..='\u{1343f}'
                | '\u{1bca0}'..='\u{1bca3}'
                | '\u{1d173}'..='\u{1d17a}'
                | '\u{e0000}'..='\u{e0fff}'
        ),
    }
}

fn first_to_escape(text: &str) -> Option<usize> {
    let mut characters = text.char_indices();
    let found = characters.find(|(at, c)| is_escaped(*c, text.get(*at..).unwrap_or_default()));
    found.map(|(at, _)| at)
}

/// Whether `c` is written as an escape sequence. `rest` is the text that begins with `c`.
fn is_escaped(c: char, rest: &str) -> bool {
    is_unprintable(c) || c == '\\' && rest.starts_with("\\u{")
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Reverses [`escape`].
    fn read(escaped: &str) -> String {
        let mut out = String::new();
        let mut rest = escaped;
        while let Some(c) = rest.chars().next() {
            let sequence = rest
                .strip_prefix("\\u{")
                .and_then(|rest| rest.split_once('}'));
            rest = match sequence {
                Some((digits, after)) => {
                    let code = u32::from_str_radix(digits, 16).unwrap();
                    out.push(char::from_u32(code).unwrap());
                    after
                }
                None => {
                    out.push(c);
                    &rest[c.len_utf8()..]
                }
            };
        }
        out
    }

    #[test]
    fn printable_text_is_unchanged() {
        for text in [
            "",
            "arm.left",
            r"C:\u",
            r"arm_\d+",
            "béla 机器人 👩",
            "a\u{301}",
        ] {
            assert!(matches!(escape(text), Cow::Borrowed(same) if same == text));
        }
    }

    #[test]
    fn control_characters_are_escaped() {
        assert_eq!(escape("a\u{1b}[2J\nb"), r"a\u{1b}[2J\u{a}b");
        assert_eq!(escape("\u{9b}31m"), r"\u{9b}31m");
        assert_eq!(escape("x\u{202e}y\u{2028}"), r"x\u{202e}y\u{2028}");
        assert_eq!(escape("a\u{34f}\u{3164}b"), r"a\u{34f}\u{3164}b");
        assert_eq!(escape(r"\u{1b}"), r"\u{5c}u{1b}");
        assert_eq!(escape("\\\u{1b}"), r"\\u{1b}");
    }

    #[test]
    fn names_that_are_not_one_word_are_quoted() {
        for (name, shown) in [
            ("rover-1@host:7", "rover-1@host:7"),
            ("béla", "béla"),
            ("a\u{1b}b", r"a\u{1b}b"),
            ("", r#""""#),
            ("a :receiver b", r#""a :receiver b""#),
            (":receiver", r#"":receiver""#),
            ("a)", r#""a)""#),
            ("a\u{a0}to\u{a0}b", "\"a\u{a0}to\u{a0}b\""),
            (r#""a""#, r#""\"a\"""#),
            (r"a b\", r#""a b\\""#),
            ("a \u{1b}", r#""a \u{1b}""#),
            (r#"a" :sender "b"#, r#""a\" :sender \"b""#),
        ] {
            assert_eq!(escape_name(name), shown);
        }
    }

    /// Compares with the tables of the crate `regex`, which follows the releases of Unicode.
    #[test]
    fn unprintable_characters_are_those_of_unicode() {
        let expected = r"^[\p{Cc}\p{Cf}\p{Zl}\p{Zp}\p{Default_Ignorable_Code_Point}]$";
        let expected = regex::Regex::new(expected).unwrap();
        let mut text = String::new();
        for c in char::MIN..=char::MAX {
            text.clear();
            text.push(c);
            assert_eq!(is_unprintable(c), expected.is_match(&text), "{c:?}");
        }
    }

    proptest! {
        #[test]
        fn escaping_is_reversible(text in r"([a\\u{}1\x1b\n\u{9b}\u{202e}]|\PC){0,12}") {
            let escaped = escape(&text);
            prop_assert!(!escaped.chars().any(is_unprintable));
            prop_assert_eq!(read(&escaped), text);
        }
    }
}
