//! What readers remark about the bytes they read, for [`explain`](crate::explain()).
//!
//! The readers of messages and envelopes say in passing what each stretch of bytes means. Whoever
//! only wants to decode listens with [`Silent`], of which nothing is left in the program.

use std::borrow::Cow;
use std::fmt::Write as _;

use crate::bitefficient::without_x;
use crate::{Text, Time, Zone, escape};

/// Listens to the remarks of a reader.
pub(crate) trait Notes {
    /// Nothing is listened to.
    const SILENT: bool = false;

    /// Everything from the end of the last note up to the offset `end` means this. Nothing is to
    /// be noted where there are no bytes.
    fn note(&mut self, end: usize, meaning: impl FnOnce() -> String);

    /// What follows is part of what was noted last.
    fn deeper(&mut self);

    /// What follows is not part of it any more.
    fn shallower(&mut self);

    /// Like [`note`](Self::note), of the length that an envelope says it has.
    fn note_envelope_len(&mut self, end: usize, said: usize);

    /// Like [`note`](Self::note), of the end of that envelope.
    fn note_envelope_end(&mut self, end: usize, meaning: &'static str);
}

/// Nobody listens.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Silent;

impl Notes for Silent {
    const SILENT: bool = true;

    #[inline(always)]
    fn note(&mut self, _: usize, _: impl FnOnce() -> String) {}

    #[inline(always)]
    fn deeper(&mut self) {}

    #[inline(always)]
    fn shallower(&mut self) {}

    #[inline(always)]
    fn note_envelope_len(&mut self, _: usize, _: usize) {}

    #[inline(always)]
    fn note_envelope_end(&mut self, _: usize, _: &'static str) {}
}

/// Longest part of a text that a note repeats, in characters.
const SHOWN: usize = 60;

/// A parameter and its text, for example `language: 'fipa-sl'`.
pub(crate) fn named(what: &str, value: &Text<'_>) -> String {
    format!("{what}: {}", text(value))
}

/// A text and how it is written.
pub(crate) fn text(text: &Text<'_>) -> String {
    let written = if text.is_counted() {
        ", with its length in front"
    } else if text.is_quoted() {
        ", in quotation marks"
    } else {
        ""
    };
    format!("{}{written}", quoted(&text.as_str()))
}

/// A user-defined parameter and its text.
pub(crate) fn user_defined(name: &Text<'_>, value: &Text<'_>) -> String {
    let name = Text::plain(without_x(name.raw()));
    named(
        &format!("user-defined parameter {}", quoted(&name.as_str())),
        value,
    )
}

/// A text as a note repeats it: cut, and without control characters.
pub(crate) fn quoted(text: &str) -> String {
    format!("'{}'{}", visible(text), ellipsis(text))
}

/// The same without quotation marks.
pub(crate) fn plain(text: &str) -> String {
    format!("{}{}", visible(text), ellipsis(text))
}

/// Content as a note repeats it: as a text if it begins like one.
pub(crate) fn content(bytes: &[u8]) -> String {
    // Enough for all characters that are shown, and then one more that may be cut in two.
    let start = bytes.get(..4 * SHOWN + 4).unwrap_or(bytes);
    let text = match std::str::from_utf8(start) {
        Ok(text) => text,
        Err(error) if error.error_len().is_none() && start.len() < bytes.len() => {
            let whole = start.get(..error.valid_up_to()).unwrap_or_default();
            std::str::from_utf8(whole).unwrap_or_default()
        }
        Err(_) => return "bytes that are no text".to_owned(),
    };
    let more = if text.len() < bytes.len() || !ellipsis(text).is_empty() {
        "…"
    } else {
        ""
    };
    format!("'{}'{more}", visible(text))
}

fn visible(text: &str) -> Cow<'_, str> {
    let end = text.char_indices().nth(SHOWN).map(|(at, _)| at);
    escape(end.and_then(|end| text.get(..end)).unwrap_or(text))
}

fn ellipsis(text: &str) -> &'static str {
    if text.chars().nth(SHOWN).is_some() {
        "…"
    } else {
        ""
    }
}

/// A date and time, with what its designator says of the zone.
pub(crate) fn date(what: &str, time: Time) -> String {
    let Some(rfc3339) = time.to_rfc3339() else {
        return format!("{what} {time}, relative to when it is read");
    };
    let mut out = format!("{what} {}", rfc3339.trim_end_matches('Z'));
    // Writing to a string cannot fail.
    let _ = match time.zone() {
        Zone::Unspecified => write!(out, ", no zone"),
        Zone::Utc => write!(out, ", UTC"),
        Zone::Letter(letter) => write!(out, ", zone {letter}"),
    };
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_are_cut_and_harmless() {
        assert_eq!(quoted("a\x1b"), "'a\\u{1b}'");
        assert_eq!(quoted(&"é".repeat(60)), format!("'{}'", "é".repeat(60)));
        assert_eq!(quoted(&"é".repeat(61)), format!("'{}'…", "é".repeat(60)));
        assert_eq!(plain("(seq"), "(seq");
    }

    #[test]
    fn content_is_text_or_not() {
        assert_eq!(content(b"hi"), "'hi'");
        assert_eq!(content(b"\xff"), "bytes that are no text");
        assert_eq!(content("é\u{1f980}".as_bytes()), "'é\u{1f980}'");
        for len in 50..300 {
            let long = content("\u{1f980}".repeat(len).as_bytes());
            assert_eq!(long.ends_with('…'), len > SHOWN, "{len}");
        }
        assert_eq!(content(b"cut \xf0\x9f"), "bytes that are no text");
    }

    #[test]
    fn dates_say_their_zone() {
        for (text, meaning) in [
            (
                "20261120T112644998",
                "date 2026-11-20T11:26:44.998, no zone",
            ),
            ("20261120T112644998Z", "date 2026-11-20T11:26:44.998, UTC"),
            (
                "20261120T112644998K",
                "date 2026-11-20T11:26:44.998, zone K",
            ),
            (
                "+00000000T000030000",
                "date +00000000T000030000, relative to when it is read",
            ),
        ] {
            assert_eq!(date("date", text.parse().unwrap()), meaning);
        }
    }
}
