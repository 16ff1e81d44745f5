//! Bodies: an envelope and a payload between boundaries (RFC 2046 clause 5.1).

use std::ops::Range;

use memchr::memmem;

use super::head::{HeadEnd, MAX_FIELDS, MAX_HEAD, parameter, unfolded};

/// Maximum length of a boundary in bytes. RFC 2046 allows 70.
pub(super) const MAX_BOUNDARY: usize = 200;

/// The reason for which a body is refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub(crate) enum MultipartError {
    #[error("the body has not two parts")]
    Parts,
    #[error("the body ends before its last boundary")]
    Truncated,
    #[error("the head of a part is malformed, or exceeds {MAX_HEAD} bytes")]
    PartHead,
    #[error("a part has a transfer encoding other than 7bit, 8bit or binary")]
    TransferEncoding,
}

/// The two parts of a body.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Parts {
    pub(super) envelope: Range<usize>,
    pub(super) payload: Range<usize>,
    /// The character set of the payload, if its part names one.
    pub(super) charset: Option<String>,
}

/// Finds the parts of a body, in time proportional to its length.
///
/// # Errors
/// When the body has not exactly two parts.
pub(crate) fn parse(body: &[u8], boundary: &[u8]) -> Result<Parts, MultipartError> {
    let mut boundaries = Boundaries::new(body, boundary);
    let first = boundaries.next().ok_or(MultipartError::Truncated)?;
    let second = boundaries.next().ok_or(MultipartError::Truncated)?;
    if first.is_last || second.is_last {
        return Err(MultipartError::Parts);
    }
    let last = boundaries.next().ok_or(MultipartError::Truncated)?;
    if !last.is_last {
        return Err(MultipartError::Parts);
    }
    let (envelope, _) = part(body, first.behind..second.before)?;
    let (payload, charset) = part(body, second.behind..last.before)?;
    Ok(Parts {
        envelope,
        payload,
        charset,
    })
}

/// A line with the boundary.
struct Boundary {
    /// Offset of the line break in front of it.
    before: usize,
    /// Offset behind the line.
    behind: usize,
    /// Whether it ends the body.
    is_last: bool,
}

/// The boundaries of a body, in order.
struct Boundaries<'a> {
    body: &'a [u8],
    finder: memmem::Finder<'a>,
    from: usize,
}

impl<'a> Boundaries<'a> {
    fn new(body: &'a [u8], boundary: &'a [u8]) -> Self {
        Self {
            body,
            finder: memmem::Finder::new(boundary),
            from: 0,
        }
    }

    /// Returns the boundary whose token is at this offset, if it is one.
    fn at(&self, token: usize) -> Option<Boundary> {
        let dashes = token.checked_sub(2)?;
        if self.body.get(dashes..token)? != b"--" {
            return None;
        }
        let before = match self.body.get(..dashes)? {
            [] => dashes,
            [.., b'\r', b'\n'] => dashes - 2,
            [.., b'\n'] => dashes - 1,
            _ => return None,
        };
        let end = token + self.finder.needle().len();
        let behind = self.body.get(end..)?;
        if behind.starts_with(b"--") {
            return Some(Boundary {
                before,
                behind: end + 2,
                is_last: true,
            });
        }
        // White space may follow on the line.
        let padding = behind.iter().take_while(|it| matches!(it, b' ' | b'\t'));
        let padding = padding.take(MAX_BOUNDARY).count();
        let line_break = match behind.get(padding..)? {
            [b'\r', b'\n', ..] => 2,
            [b'\n', ..] => 1,
            _ => return None,
        };
        Some(Boundary {
            before,
            behind: end + padding + line_break,
            is_last: false,
        })
    }
}

impl Iterator for Boundaries<'_> {
    type Item = Boundary;

    fn next(&mut self) -> Option<Boundary> {
        loop {
            let token = self.from + self.finder.find(self.body.get(self.from..)?)?;
            match self.at(token) {
                Some(boundary) => {
                    // The line break behind a boundary may be the one in front of the next.
                    self.from = boundary.behind;
                    return Some(boundary);
                }
                None => self.from = token + self.finder.needle().len(),
            }
        }
    }
}

/// Returns the content of a part, and its character set.
fn part(
    body: &[u8],
    range: Range<usize>,
) -> Result<(Range<usize>, Option<String>), MultipartError> {
    // Two boundaries without a line between share a line break.
    let bytes = body.get(range.clone()).ok_or(MultipartError::PartHead)?;
    let len = match bytes {
        [b'\r', b'\n', ..] => return Ok((range.start + 2..range.end, None)),
        [b'\n', ..] => return Ok((range.start + 1..range.end, None)),
        _ => {
            let searched = bytes.get(..MAX_HEAD).unwrap_or(bytes);
            HeadEnd::default().find(searched)
        }
    };
    let len = len.ok_or(MultipartError::PartHead)?;
    let head = unfolded(bytes.get(..len).unwrap_or_default());
    let mut fields = [httparse::EMPTY_HEADER; MAX_FIELDS];
    let fields = match httparse::parse_headers(&head, &mut fields) {
        Ok(httparse::Status::Complete((_, fields))) => fields,
        _ => return Err(MultipartError::PartHead),
    };
    let field = |name: &str| {
        let mut fields = fields.iter();
        let found = fields.find(|field| field.name.eq_ignore_ascii_case(name));
        found.map(|field| field.value)
    };
    if let Some(encoding) = field("Content-Transfer-Encoding") {
        let encoding = encoding.trim_ascii();
        let is_plain = |name: &&str| encoding.eq_ignore_ascii_case(name.as_bytes());
        if !["7bit", "8bit", "binary"].iter().any(is_plain) {
            return Err(MultipartError::TransferEncoding);
        }
    }
    let charset = field("Content-Type").and_then(|content| parameter(content, "charset"));
    let charset = charset.and_then(|charset| String::from_utf8(charset).ok());
    Ok((range.start + len..range.end, charset))
}
