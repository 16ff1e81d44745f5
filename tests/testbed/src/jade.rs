//! Requests that JADE has written, which a test sends again with other addresses.

use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::time::Duration;

/// Timeout of an answer that does not come.
const TIMEOUT: Duration = Duration::from_secs(60);

/// Returns a recorded request with the addresses of a test instead of those of the recording.
///
/// # Panics
/// If the bytes are no request.
#[must_use]
pub fn readdressed(request: &[u8], addresses: &[(&str, &str)]) -> Vec<u8> {
    let bytes = replaced(request, addresses);
    let head = position(&bytes, b"\r\n\r\n").expect("a head") + 4;
    let length = content_length(&bytes[..head]);
    // JADE writes two bytes behind the body.
    let uncounted = if bytes.ends_with(b"\r\n\r\n") { 2 } else { 0 };
    let now = bytes.len() - head - uncounted;
    let field = |length: usize| format!("Content-Length: {length}\r\n");
    replaced(&bytes, &[(&field(length), &field(now))])
}

/// Splits the bytes of several requests.
///
/// # Panics
/// If the bytes are no requests.
#[must_use]
pub fn requests(mut bytes: &[u8]) -> Vec<&[u8]> {
    let mut all = Vec::new();
    while !bytes.is_empty() {
        let head = position(bytes, b"\r\n\r\n").expect("a head") + 4;
        let mut end = head + content_length(&bytes[..head]);
        if bytes[end..].starts_with(b"\r\n") {
            end += 2;
        }
        let (request, rest) = bytes.split_at(end);
        all.push(request);
        bytes = rest;
    }
    all
}

/// Returns the message in a request, behind its envelope.
///
/// # Panics
/// If the bytes are no request with two parts.
#[must_use]
pub fn message(request: &[u8]) -> &[u8] {
    let mut rest = request;
    // The head, the preamble, and the heads of both parts.
    for _ in 0..3 {
        rest = &rest[position(rest, b"\r\n\r\n").expect("a part") + 4..];
    }
    &rest[..position(rest, b"\r\n--").expect("a delimiter")]
}

/// Returns the number of bytes behind the head of a request.
///
/// # Panics
/// If the head has none.
#[must_use]
pub fn content_length(head: &[u8]) -> usize {
    let text = str::from_utf8(head).expect("a head is text");
    let (_, length) = text.split_once("Content-Length: ").expect("a length");
    let length = length.lines().next().unwrap_or_default();
    length.parse().expect("a number")
}

/// Sends a request as JADE does, and checks the answer.
///
/// # Panics
/// If the answer is another one than that of success.
pub fn post(request: &[u8], to: &str) {
    let mut stream = TcpStream::connect(to).expect("a connection");
    stream.set_read_timeout(Some(TIMEOUT)).expect("a timeout");
    stream.write_all(request).expect("written");
    let mut answer = [0; 15];
    stream.read_exact(&mut answer).expect("an answer");
    assert_eq!(&answer, b"HTTP/1.1 200 OK");
}

fn position(bytes: &[u8], what: &[u8]) -> Option<usize> {
    bytes.windows(what.len()).position(|it| it == what)
}

/// Replaces each text in the first place of a pair, and nothing in the texts that take its place.
fn replaced(mut bytes: &[u8], pairs: &[(&str, &str)]) -> Vec<u8> {
    let mut out = Vec::new();
    while let [first, rest @ ..] = bytes {
        match pairs
            .iter()
            .find(|(from, _)| bytes.starts_with(from.as_bytes()))
        {
            Some((from, to)) => {
                out.extend(to.as_bytes());
                bytes = &bytes[from.len()..];
            }
            None => {
                out.push(*first);
                bytes = rest;
            }
        }
    }
    out
}
