//! Requests: the reader of the server, and the writer of the client (FIPA00084).

use bytes::{Bytes, BytesMut};

use super::head::{HeadEnd, MAX_FIELDS, MAX_HEAD, length, lists, parameter, unfolded};
use super::multipart::MAX_BOUNDARY;
use super::url::{PATH, Url};

/// Maximum number of line-break bytes in front of a request. JADE writes two behind each body, which
/// `Content-Length` does not count.
const MAX_LINE_BREAKS: usize = 16;

/// The reason for which a request is refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub(crate) enum RequestError {
    #[error("the head of the request exceeds {MAX_HEAD} bytes or {MAX_FIELDS} header fields")]
    HeadTooLarge,
    #[error("the head of the request is malformed: {0}")]
    Malformed(&'static str),
    #[error("the method is not POST")]
    Method,
    #[error("the version is not HTTP/1.0 or HTTP/1.1")]
    Version,
    #[error("the path is not {PATH}")]
    Path,
    #[error("the request comes from a web page (it has the header field Origin)")]
    WebPage,
    #[error("the request has no Content-Length, or its body is chunked")]
    NoLength,
    #[error("the body exceeds {0} bytes (max_letter)")]
    TooLarge(usize),
    #[error("the content is not multipart/mixed")]
    NotMultipart,
    #[error("the boundary is missing, empty or longer than {MAX_BOUNDARY} bytes")]
    Boundary,
    #[error("the expectation is not 100-continue")]
    Expectation,
}

impl RequestError {
    /// Returns the status of the answer (RFC 9110 clause 15).
    pub(super) fn status(&self) -> Status {
        match self {
            Self::HeadTooLarge => Status::HeadTooLarge,
            Self::Malformed(_) | Self::Boundary => Status::BadRequest,
            Self::Method => Status::MethodNotAllowed,
            Self::Version => Status::Version,
            Self::Path => Status::NotFound,
            Self::WebPage => Status::Forbidden,
            Self::NoLength => Status::LengthRequired,
            Self::TooLarge(_) => Status::TooLarge,
            Self::NotMultipart => Status::NotMultipart,
            Self::Expectation => Status::Expectation,
        }
    }
}

/// The status of an answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Status {
    Ok,
    BadRequest,
    Forbidden,
    NotFound,
    MethodNotAllowed,
    Timeout,
    LengthRequired,
    TooLarge,
    NotMultipart,
    Expectation,
    HeadTooLarge,
    Unavailable,
    Version,
}

impl Status {
    fn text(self) -> &'static str {
        match self {
            Self::Ok => "200 OK",
            Self::BadRequest => "400 Bad Request",
            Self::Forbidden => "403 Forbidden",
            Self::NotFound => "404 Not Found",
            Self::MethodNotAllowed => "405 Method Not Allowed",
            Self::Timeout => "408 Request Timeout",
            Self::LengthRequired => "411 Length Required",
            Self::TooLarge => "413 Content Too Large",
            Self::NotMultipart => "415 Unsupported Media Type",
            Self::Expectation => "417 Expectation Failed",
            Self::HeadTooLarge => "431 Request Header Fields Too Large",
            Self::Unavailable => "503 Service Unavailable",
            Self::Version => "505 HTTP Version Not Supported",
        }
    }

    /// Returns an answer without a body. JADE compares `Keep-Alive` with its case, and needs a body
    /// that is empty or ends with a line break.
    pub(super) fn answer(self, keeps: bool) -> String {
        let text = self.text();
        let connection = if keeps { "Keep-Alive" } else { "close" };
        let allow = match self {
            Self::MethodNotAllowed => "Allow: POST\r\n",
            _ => "",
        };
        format!("HTTP/1.1 {text}\r\nContent-Length: 0\r\n{allow}Connection: {connection}\r\n\r\n")
    }
}

/// The head of an accepted request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct RequestHead {
    /// Length of the body in bytes.
    pub(super) length: usize,
    /// The boundary between the parts of the body.
    pub(super) boundary: Vec<u8>,
    /// Whether the client keeps the connection open.
    pub(super) keeps: bool,
    /// Whether the client waits for an interim answer before it sends the body.
    pub(super) waits: bool,
}

/// A reader of consecutive requests on one connection.
#[derive(Debug, Default)]
pub(crate) struct RequestReader {
    buffer: BytesMut,
    end: HeadEnd,
    line_breaks: usize,
}

impl RequestReader {
    /// The buffer to which received bytes are appended.
    pub(super) fn buffer(&mut self) -> &mut BytesMut {
        &mut self.buffer
    }

    /// Whether no byte of the next request has arrived.
    pub(super) fn is_idle(&mut self) -> Result<bool, RequestError> {
        self.skip_line_breaks()?;
        Ok(self.buffer.is_empty())
    }

    fn skip_line_breaks(&mut self) -> Result<(), RequestError> {
        let is_break = |byte: &u8| matches!(byte, b'\r' | b'\n');
        let breaks = self.buffer.iter().take_while(|byte| is_break(byte)).count();
        self.line_breaks += breaks;
        if self.line_breaks > MAX_LINE_BREAKS {
            return Err(RequestError::Malformed("too many empty lines"));
        }
        let _ = self.buffer.split_to(breaks);
        Ok(())
    }

    /// Removes the head of the next request from the buffer. `None` if more bytes are needed.
    ///
    /// # Errors
    /// When the request is refused. The rest of the connection is unusable then.
    pub(super) fn head(&mut self, max_body: usize) -> Result<Option<RequestHead>, RequestError> {
        if self.is_idle()? {
            return Ok(None);
        }
        let searched = self.buffer.get(..MAX_HEAD).unwrap_or(&self.buffer);
        let Some(len) = self.end.find(searched) else {
            return match self.buffer.len() < MAX_HEAD {
                true => Ok(None),
                false => Err(RequestError::HeadTooLarge),
            };
        };
        let head = self.buffer.split_to(len);
        self.end = HeadEnd::default();
        self.line_breaks = 0;
        parse(&head, max_body).map(Some)
    }

    /// Number of bytes of a body of this length that are still missing.
    pub(super) fn missing(&self, length: usize) -> usize {
        length.saturating_sub(self.buffer.len())
    }

    /// Removes a complete body of this length from the buffer. The bytes behind it get memory of their
    /// own: the memory of the body is free when the body is dropped, however long the connection stays
    /// open.
    pub(super) fn body(&mut self, length: usize) -> Bytes {
        let behind = BytesMut::from(self.buffer.get(length..).unwrap_or_default());
        let mut body = std::mem::replace(&mut self.buffer, behind);
        body.truncate(length);
        body.freeze()
    }
}

/// Parses a complete head.
fn parse(head: &[u8], max_body: usize) -> Result<RequestHead, RequestError> {
    let head = unfolded(head);
    let mut fields = [httparse::EMPTY_HEADER; MAX_FIELDS];
    let mut request = httparse::Request::new(&mut fields);
    let parsed = request.parse(&head).map_err(|error| match error {
        httparse::Error::TooManyHeaders => RequestError::HeadTooLarge,
        httparse::Error::Version => RequestError::Version,
        httparse::Error::HeaderName => RequestError::Malformed("the name of a header field"),
        httparse::Error::HeaderValue => RequestError::Malformed("the value of a header field"),
        _ => RequestError::Malformed("the request line"),
    })?;
    if parsed != httparse::Status::Complete(head.len()) {
        return Err(RequestError::Malformed("the end of the head"));
    }
    if request.method != Some("POST") {
        return Err(RequestError::Method);
    }
    if request.path.and_then(path) != Some(PATH) {
        return Err(RequestError::Path);
    }
    let fields = &*request.headers;
    let one = |name: &str| {
        let mut found = fields
            .iter()
            .filter(|field| field.name.eq_ignore_ascii_case(name))
            .map(|field| field.value);
        let first = found.next();
        match found.all(|other| Some(other) == first) {
            true => Ok(first),
            false => Err(RequestError::Malformed("a header field with two values")),
        }
    };
    if one("Origin")?.is_some() {
        return Err(RequestError::WebPage);
    }
    let content = one("Content-Type")?.ok_or(RequestError::NotMultipart)?;
    let media = content.split(|byte| *byte == b';').next();
    // The example of FIPA00084 has a hyphen.
    let is_mixed = |name: &&[u8]| {
        let name = name.trim_ascii();
        name.eq_ignore_ascii_case(b"multipart/mixed")
            || name.eq_ignore_ascii_case(b"multipart-mixed")
    };
    media.filter(is_mixed).ok_or(RequestError::NotMultipart)?;
    let boundary = parameter(content, "boundary").ok_or(RequestError::Boundary)?;
    if !(1..=MAX_BOUNDARY).contains(&boundary.len()) {
        return Err(RequestError::Boundary);
    }
    if one("Transfer-Encoding")?.is_some() {
        return Err(RequestError::NoLength);
    }
    let body = one("Content-Length")?.ok_or(RequestError::NoLength)?;
    let body = length(body).ok_or(RequestError::Malformed("Content-Length"))?;
    let body = usize::try_from(body).unwrap_or(usize::MAX);
    if body > max_body {
        return Err(RequestError::TooLarge(max_body));
    }
    let waits = match one("Expect")? {
        None => false,
        Some(what) if what.trim_ascii().eq_ignore_ascii_case(b"100-continue") => true,
        Some(_) => return Err(RequestError::Expectation),
    };
    let connection = one("Connection")?.unwrap_or_default();
    Ok(RequestHead {
        length: body,
        boundary,
        // JADE takes a missing field for keep-alive, as HTTP/1.1 does.
        keeps: match request.version {
            Some(0) => lists(connection, "keep-alive"),
            _ => !lists(connection, "close"),
        },
        waits,
    })
}

/// Returns the path of a request target, which may be an absolute URI.
fn path(target: &str) -> Option<&str> {
    let path = match target.split_once("://") {
        Some((_, behind)) => behind.get(behind.find('/')?..)?,
        None => target,
    };
    path.split('?').next()
}

/// Returns a request up to the payload, and the bytes behind the payload, which has this length. The
/// payload must not contain the boundary. `charset` is that of a payload in another one than
/// US-ASCII.
pub(super) fn write(
    to: &Url,
    boundary: &str,
    envelope: &[u8],
    (payload_length, charset): (usize, Option<&str>),
    keeps: bool,
) -> (Vec<u8>, String) {
    let first = format!(
        "This is not part of the MIME multipart encoded message.\r\n\
         --{boundary}\r\nContent-Type: application/xml\r\n\r\n"
    );
    let charset = charset.map_or_else(String::new, |charset| format!("; charset={charset}"));
    let second = format!("\r\n--{boundary}\r\nContent-Type: application/text{charset}\r\n\r\n");
    let last = format!("\r\n--{boundary}--\r\n");
    let length = first.len() + envelope.len() + second.len() + payload_length + last.len();
    let connection = if keeps { "Keep-Alive" } else { "close" };
    let mut out = format!(
        "POST {to} HTTP/1.1\r\nCache-Control: no-cache\r\nMime-Version: 1.0\r\nHost: {}\r\n\
         Content-Type: multipart/mixed ; boundary=\"{boundary}\"\r\nContent-Length: {length}\r\n\
         Connection: {connection}\r\n\r\n",
        to.host()
    )
    .into_bytes();
    out.extend_from_slice(first.as_bytes());
    out.extend_from_slice(envelope);
    out.extend_from_slice(second.as_bytes());
    (out, last)
}
