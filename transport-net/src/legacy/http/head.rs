//! Heads: the lines in front of a body, up to the first empty line.

/// Maximum length of the head of a request, response or part, in bytes.
pub(super) const MAX_HEAD: usize = 16 << 10;

/// Maximum number of header fields of a head.
pub(super) const MAX_FIELDS: usize = 64;

/// The search for the end of a head that arrives in pieces. No byte is searched twice.
#[derive(Debug, Default)]
pub(super) struct HeadEnd {
    searched: usize,
}

impl HeadEnd {
    /// Returns the length of the head at the beginning of `bytes`, including the empty line. `bytes`
    /// begins with the bytes of the previous call.
    pub(super) fn find(&mut self, bytes: &[u8]) -> Option<usize> {
        loop {
            let rest = bytes.get(self.searched..)?;
            let line = self.searched + memchr::memchr(b'\n', rest)? + 1;
            match bytes.get(line..)? {
                [b'\n', ..] => return Some(line + 1),
                [b'\r', b'\n', ..] => return Some(line + 2),
                // The rest of an empty line may arrive.
                [] | [b'\r'] => {
                    self.searched = line - 1;
                    return None;
                }
                _ => self.searched = line,
            }
        }
    }
}

/// Returns the head with the line breaks of folded header fields replaced by spaces (RFC 9112 clause
/// 5.2). The length is unchanged.
pub(super) fn unfolded(head: &[u8]) -> Vec<u8> {
    let mut out = head.to_vec();
    let mut from = 0;
    while let Some(found) = out.get(from..).and_then(|rest| memchr::memchr(b'\n', rest)) {
        let at = from + found;
        from = at + 1;
        if !matches!(out.get(from), Some(b' ' | b'\t')) {
            continue;
        }
        if let Some(line_feed) = out.get_mut(at) {
            *line_feed = b' ';
        }
        if let Some(carriage_return) = at.checked_sub(1).and_then(|at| out.get_mut(at))
            && *carriage_return == b'\r'
        {
            *carriage_return = b' ';
        }
    }
    out
}

/// Whether a comma-separated list contains this word, in any case.
pub(super) fn lists(value: &[u8], word: &str) -> bool {
    let mut words = value.split(|byte| *byte == b',');
    words.any(|it| it.trim_ascii().eq_ignore_ascii_case(word.as_bytes()))
}

/// Parses a length in decimal digits.
pub(super) fn length(value: &[u8]) -> Option<u64> {
    let digits = std::str::from_utf8(value.trim_ascii()).ok()?;
    let is_plain = !digits.is_empty() && digits.bytes().all(|byte| byte.is_ascii_digit());
    is_plain.then(|| digits.parse().ok())?
}

/// Returns the parameter of a header field such as `multipart/mixed ; boundary="token"`, and `None`
/// if it is missing. The value may be a word or a quoted string.
pub(super) fn parameter(value: &[u8], name: &str) -> Option<Vec<u8>> {
    let mut rest = value.get(memchr::memchr(b';', value)?..)?;
    while let [b';', behind @ ..] = rest {
        let behind = behind.trim_ascii_start();
        let end = behind.iter().position(|byte| matches!(byte, b'=' | b';'));
        let (key, behind) = behind.split_at(end?);
        let [b'=', behind @ ..] = behind else {
            rest = behind;
            continue;
        };
        let behind = behind.trim_ascii_start();
        let (found, behind) = match behind {
            [b'"', inside @ ..] => quoted(inside)?,
            _ => {
                let end = memchr::memchr(b';', behind).unwrap_or(behind.len());
                let (word, behind) = behind.split_at(end);
                (word.trim_ascii().to_vec(), behind)
            }
        };
        if key.trim_ascii().eq_ignore_ascii_case(name.as_bytes()) {
            return Some(found);
        }
        rest = behind.trim_ascii_start();
    }
    None
}

/// Returns the text of a quoted string up to its end, and the bytes behind it.
fn quoted(inside: &[u8]) -> Option<(Vec<u8>, &[u8])> {
    let mut text = Vec::new();
    let mut bytes = inside.iter().enumerate();
    while let Some((at, byte)) = bytes.next() {
        match byte {
            b'"' => return Some((text, inside.get(at + 1..)?)),
            b'\\' => text.push(*bytes.next()?.1),
            byte => text.push(*byte),
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn parameters_are_words_or_quoted_strings() {
        let boundary = |value: &str| {
            parameter(value.as_bytes(), "boundary").map(|it| String::from_utf8(it).unwrap())
        };
        for (value, expected) in [
            ("multipart/mixed ; boundary=\"abc\"", Some("abc")),
            ("multipart/mixed;boundary=abc", Some("abc")),
            (
                "multipart/mixed;     Boundary=\"a b;c\" ; x=1",
                Some("a b;c"),
            ),
            (
                "multipart/mixed; x=\"boundary=no\"; boundary = yes ",
                Some("yes"),
            ),
            ("multipart/mixed; x; boundary=\"q\\\"q\"", Some("q\"q")),
            ("multipart/mixed; boundary=\"open", None),
            ("multipart/mixed; boundary", None),
            ("multipart/mixed", None),
            ("", None),
        ] {
            assert_eq!(boundary(value).as_deref(), expected, "{value}");
        }
    }

    #[test]
    fn folded_fields_become_one_line_of_the_same_length() {
        let folded = b"A: b;\r\n  c\r\nD: e\n\tf\r\n\r\n";
        let expected = b"A: b;    c\r\nD: e \tf\r\n\r\n";
        assert_eq!(unfolded(folded), expected);
    }

    proptest! {
        #[test]
        fn the_end_of_a_head_does_not_depend_on_its_pieces(
            bytes in "[a\r\n:]{0,40}",
            cuts in prop::collection::vec(0_usize..40, 0..6),
        ) {
            let bytes = bytes.as_bytes();
            let whole = HeadEnd::default().find(bytes);
            let mut cuts: Vec<usize> = cuts.into_iter().map(|cut| cut.min(bytes.len())).collect();
            cuts.sort_unstable();
            cuts.push(bytes.len());
            let mut end = HeadEnd::default();
            let found = cuts.into_iter().find_map(|cut| end.find(&bytes[..cut]));
            prop_assert_eq!(found, whole);
            if let Some(len) = whole {
                let head = &bytes[..len];
                prop_assert!(head.ends_with(b"\n\r\n") || head.ends_with(b"\n\n"));
            }
        }
    }
}
