//! Answers, as the client reads them.
//!
//! JADE's answers have no length, even on a connection that stays open. The reader therefore ends an
//! answer with its head, and skips lines until the next one that begins with `HTTP/1.`.

use bytes::BytesMut;

use super::head::{HeadEnd, MAX_HEAD, length, lists, unfolded};

/// Maximum number of bytes between the head of an answer and the next answer. Answers that announce
/// another one count.
const MAX_BODY: usize = 64 << 10;

/// The beginning of each answer.
const BEGIN: &[u8] = b"HTTP/1.";

/// The reason for which an answer cannot be read.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub(crate) enum ResponseError {
    #[error("the head of the answer exceeds {MAX_HEAD} bytes")]
    HeadTooLarge,
    #[error("no HTTP answer within {MAX_BODY} bytes")]
    NoAnswer,
    #[error("the status of the answer is malformed")]
    Malformed,
}

/// An answer without its body.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Response {
    pub(super) status: u16,
    /// The text behind the status.
    pub(super) reason: String,
    /// Whether the connection can carry another request.
    pub(super) keeps: bool,
}

/// A reader of consecutive answers on one connection.
#[derive(Debug, Default)]
pub(crate) struct ResponseReader {
    buffer: BytesMut,
    end: HeadEnd,
    /// Bytes of a body with a known length that have not arrived yet.
    body: usize,
    /// Number of bytes skipped since the last answer.
    skipped: usize,
    /// Whether the buffer begins within a line that is skipped.
    within: bool,
}

impl ResponseReader {
    /// The buffer to which received bytes are appended.
    pub(super) fn buffer(&mut self) -> &mut BytesMut {
        &mut self.buffer
    }

    /// Removes the next answer from the buffer. `None` if more bytes are needed. Answers that
    /// announce another one (status 1xx) are skipped.
    ///
    /// # Errors
    /// When the bytes are no answer. The rest of the connection is unusable then.
    pub(super) fn next(&mut self) -> Result<Option<Response>, ResponseError> {
        loop {
            if !self.skip()? {
                return Ok(None);
            }
            let searched = self.buffer.get(..MAX_HEAD).unwrap_or(&self.buffer);
            let Some(len) = self.end.find(searched) else {
                return match self.buffer.len() < MAX_HEAD {
                    true => Ok(None),
                    false => Err(ResponseError::HeadTooLarge),
                };
            };
            let head = self.buffer.split_to(len);
            self.end = HeadEnd::default();
            let (response, body) = parse(&head)?;
            self.body = body;
            if response.status >= 200 {
                self.skipped = 0;
                return Ok(Some(response));
            }
            self.skip_bytes(len)?;
        }
    }

    /// Skips bytes up to the beginning of an answer. Returns whether it has been found.
    fn skip(&mut self) -> Result<bool, ResponseError> {
        let body = self.body.min(self.buffer.len());
        self.body -= body;
        self.drop_front(body)?;
        loop {
            if !self.within {
                let len = self.buffer.len().min(BEGIN.len());
                if self.buffer.get(..len) == BEGIN.get(..len) {
                    return Ok(len == BEGIN.len());
                }
            }
            match memchr::memchr(b'\n', &self.buffer) {
                Some(end) => {
                    self.within = false;
                    self.drop_front(end + 1)?;
                }
                None => {
                    self.within = !self.buffer.is_empty() || self.within;
                    let len = self.buffer.len();
                    self.drop_front(len)?;
                    return Ok(false);
                }
            }
        }
    }

    fn drop_front(&mut self, len: usize) -> Result<(), ResponseError> {
        let _ = self.buffer.split_to(len);
        self.skip_bytes(len)
    }

    /// Counts skipped bytes.
    fn skip_bytes(&mut self, len: usize) -> Result<(), ResponseError> {
        self.skipped += len;
        match self.skipped <= MAX_BODY {
            true => Ok(()),
            false => Err(ResponseError::NoAnswer),
        }
    }
}

/// Parses a complete head. Returns the length of the body, 0 if it is not known.
fn parse(head: &[u8]) -> Result<(Response, usize), ResponseError> {
    let head = unfolded(head);
    let mut lines = head.split(|byte| *byte == b'\n').map(<[u8]>::trim_ascii);
    let status = lines.next().and_then(|line| line.strip_prefix(BEGIN));
    let status = status.ok_or(ResponseError::Malformed)?;
    let (minor, behind) = status.split_first().ok_or(ResponseError::Malformed)?;
    let behind = behind.trim_ascii_start();
    let (code, reason) = behind.split_at_checked(3).ok_or(ResponseError::Malformed)?;
    let code = length(code).and_then(|code| u16::try_from(code).ok());
    let code = code.filter(|code| (100..=999).contains(code));
    let (mut keeps, mut body, mut fits) = (*minor != b'0', None, true);
    for line in lines {
        let Some(colon) = memchr::memchr(b':', line) else {
            continue;
        };
        let (name, value) = line.split_at(colon);
        let (name, value) = (name.trim_ascii(), value.get(1..).unwrap_or_default());
        if name.eq_ignore_ascii_case(b"connection") {
            keeps = match *minor {
                b'0' => lists(value, "keep-alive"),
                _ => !lists(value, "close"),
            };
        } else if name.eq_ignore_ascii_case(b"content-length") {
            body = length(value);
            fits &= body.is_some_and(|body| body <= MAX_BODY as u64);
        } else if name.eq_ignore_ascii_case(b"transfer-encoding") {
            // A chunked body can contain any line.
            fits = false;
        }
    }
    let response = Response {
        status: code.ok_or(ResponseError::Malformed)?,
        reason: String::from_utf8_lossy(reason.trim_ascii())
            .chars()
            .take(80)
            .collect(),
        keeps: keeps && fits,
    };
    let body = body.filter(|_| fits).unwrap_or(0);
    Ok((response, usize::try_from(body).unwrap_or(0)))
}
