//! Entry point of the fuzz target: the readers of both sides.

use bytes::Bytes;

use super::request::RequestReader;
use super::response::ResponseReader;
use super::{letter, multipart, request};
use crate::legacy::http::url::Url;

/// Maximum length of a body.
const MAX_BODY: usize = 4096;

/// Reads bytes as the requests of a client, in pieces of `step` bytes. Returns the number of
/// requests.
pub fn requests(bytes: &[u8], step: usize) -> usize {
    let mut reader = RequestReader::default();
    let mut pieces = bytes.chunks(step.max(1));
    let mut count = 0;
    loop {
        let head = match reader.head(MAX_BODY) {
            Ok(Some(head)) => head,
            Ok(None) => match pieces.next() {
                Some(piece) => {
                    reader.buffer().extend_from_slice(piece);
                    continue;
                }
                None => return count,
            },
            Err(_) => return count,
        };
        assert!(head.length <= MAX_BODY, "a longer body is refused");
        while reader.missing(head.length) > 0 {
            match pieces.next() {
                Some(piece) => reader.buffer().extend_from_slice(piece),
                None => return count,
            }
        }
        let body = reader.body(head.length);
        assert_eq!(body.len(), head.length);
        self::body(&body, &head.boundary);
        count += 1;
    }
}

/// Reads bytes as a body. The parts of a body are the same when they are written again.
pub fn body(bytes: &[u8], boundary: &[u8]) {
    let bytes = Bytes::copy_from_slice(bytes);
    let Ok(parts) = multipart::parse(&bytes, boundary) else {
        return;
    };
    let (envelope, payload) = (
        bytes.slice(parts.envelope.clone()),
        bytes.slice(parts.payload.clone()),
    );
    let Ok(letter) = letter::read(&bytes, boundary) else {
        return;
    };
    let token = "0123456789abcdef0123456789abcde";
    let url = Url::parse(fipa_transport::Kind::Http, "10.0.0.1").expect("an address");
    let (mut written, end) = request::write(&url, token, &envelope, (payload.len(), None), true);
    written.extend_from_slice(&payload);
    written.extend_from_slice(end.as_bytes());
    let mut reader = RequestReader::default();
    reader.buffer().extend_from_slice(&written);
    let head = reader.head(usize::MAX).expect("our own head");
    let head = head.expect("a complete head");
    let body = reader.body(head.length);
    let read = letter::read(&body, &head.boundary).expect("our own body");
    // The character set of the part was not written.
    if parts.charset.is_none() {
        assert_eq!(read, letter, "a letter survives");
    }
}

/// Reads bytes as the answers of a server, in pieces of `step` bytes. Returns the number of
/// answers.
pub fn answers(bytes: &[u8], step: usize) -> usize {
    let mut reader = ResponseReader::default();
    let mut count = 0;
    for piece in bytes.chunks(step.max(1)) {
        reader.buffer().extend_from_slice(piece);
        loop {
            match reader.next() {
                Ok(Some(_)) => count += 1,
                Ok(None) => break,
                Err(_) => return count,
            }
        }
    }
    count
}
