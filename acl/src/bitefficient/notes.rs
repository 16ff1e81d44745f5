//! Notes that readers take about the bytes they read, for [`explain`](crate::explain()).
//!
//! The readers of messages and envelopes report the meaning of each span of bytes to [`Notes`].
//! Decoding uses [`NoNotes`], which the compiler removes.

use std::borrow::Cow;
use std::fmt::Write as _;

use crate::bitefficient::without_x;
use crate::{Text, Time, Zone, escape};

/// Receives the notes of a reader.
pub(crate) trait Notes {
    /// Whether the notes are used. Without them, a reader may take its fast paths.
    const ENABLED: bool = true;

    /// Notes the meaning of the bytes from the end of the last note up to the offset `end`. An
    /// empty span is ignored.
    fn note(&mut self, end: usize, meaning: impl FnOnce() -> String);

    /// Makes the following notes part of the last one.
    fn deeper(&mut self);

    /// Undoes one [`deeper`](Self::deeper).
    fn shallower(&mut self);

    /// Notes the length field of an envelope like [`note`](Self::note). Its value is `announced`.
    fn note_envelope_len(&mut self, end: usize, announced: usize);

    /// Notes the end of that envelope like [`note`](Self::note).
    fn note_envelope_end(&mut self, end: usize, meaning: &'static str);
}

/// Discards all notes.
#[derive(Debug, Clone, Copy)]
pub(crate) struct NoNotes;

impl Notes for NoNotes {
    const ENABLED: bool = false;

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

/// Maximum number of characters of a text that a note repeats.
const SHOWN: usize = 60;

/// Formats a parameter and its text, for example `language: 'fipa-sl'`.
pub(crate) fn named(what: &str, value: &Text<'_>) -> String {
    format!("{what}: {}", text(value))
}

/// Formats a text and the form that it is written in.
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

/// Formats a user-defined parameter and its text.
pub(crate) fn user_defined(name: &Text<'_>, value: &Text<'_>) -> String {
    let name = Text::plain(without_x(name.raw()));
    named(
        &format!("user-defined parameter {}", quoted(&name.as_str())),
        value,
    )
}

/// Formats a text in quotation marks, truncated and without control characters.
pub(crate) fn quoted(text: &str) -> String {
    format!("'{}'{}", visible(text), ellipsis(text))
}

/// Formats a text like [`quoted`], without quotation marks.
pub(crate) fn plain(text: &str) -> String {
    format!("{}{}", visible(text), ellipsis(text))
}

/// Formats content: as a text if it begins with UTF-8.
pub(crate) fn content(bytes: &[u8]) -> String {
    // Enough for all characters shown and one more, which may be incomplete.
    let start = bytes.get(..4 * SHOWN + 4).unwrap_or(bytes);
    let text = match std::str::from_utf8(start) {
        Ok(text) => text,
        Err(error) if error.error_len().is_none() && start.len() < bytes.len() => {
            let whole = start.get(..error.valid_up_to()).unwrap_or_default();
            std::str::from_utf8(whole).unwrap_or_default()
        }
        Err(_) => return "bytes that are not UTF-8".to_owned(),
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

/// Formats a date and time and its zone.
pub(crate) fn date(what: &str, time: Time) -> String {
    let Some(rfc3339) = time.to_rfc3339() else {
        return format!("{what} {time}, relative to the time of reading");
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
    fn texts_are_truncated_and_escaped() {
        assert_eq!(quoted("a\x1b"), "'a\\u{1b}'");
        assert_eq!(quoted(&"é".repeat(60)), format!("'{}'", "é".repeat(60)));
        assert_eq!(quoted(&"é".repeat(61)), format!("'{}'…", "é".repeat(60)));
        assert_eq!(plain("(seq"), "(seq");
    }

    #[test]
    fn content_is_shown_as_text_if_it_is_utf8() {
        assert_eq!(content(b"hi"), "'hi'");
        assert_eq!(content(b"\xff"), "bytes that are not UTF-8");
        assert_eq!(content("é\u{1f980}".as_bytes()), "'é\u{1f980}'");
        for len in 50..300 {
            let long = content("\u{1f980}".repeat(len).as_bytes());
            assert_eq!(long.ends_with('…'), len > SHOWN, "{len}");
        }
        assert_eq!(content(b"cut \xf0\x9f"), "bytes that are not UTF-8");
    }

    #[test]
    fn dates_are_shown_with_their_zone() {
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
                "date +00000000T000030000, relative to the time of reading",
            ),
        ] {
            assert_eq!(date("date", text.parse().unwrap()), meaning);
        }
    }
}
