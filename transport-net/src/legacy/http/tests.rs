//! Recorded exchanges with JADE, and properties of the parsers.

use bytes::Bytes;
use fipa_acl::{Envelope, Message, Performative};
use fipa_transport::Kind;
use proptest::prelude::*;

use super::letter;
use super::multipart::{self, MultipartError};
use super::request::{self, RequestError, RequestHead, RequestReader, Status};
use super::response::{Response, ResponseError, ResponseReader};
use super::url::Url;

macro_rules! recorded {
    ($($file:literal),* $(,)?) => {
        [$(($file, include_bytes!(concat!("../../../tests/data/jade_http/", $file, ".bin")).as_slice())),*]
    };
}

const MAX_BODY: usize = 1 << 20;

/// The requests that JADE has written.
fn requests_of_jade() -> [(&'static str, &'static [u8]); 5] {
    recorded![
        "string.3-echo-reply-from-jade",
        "xml.3-echo-reply-from-jade",
        "bitefficient.3-echo-reply-from-jade",
        "df-search.3-reply-from-jade",
        "failure-unknown-agent.3-ams-failure-from-jade",
    ]
}

/// The requests that JADE has accepted.
fn requests_to_jade() -> [(&'static str, &'static [u8]); 5] {
    recorded![
        "string.1-request-to-jade",
        "xml.1-request-to-jade",
        "bitefficient.1-request-to-jade",
        "df-search.1-request-to-jade",
        "failure-unknown-agent.1-request-to-jade",
    ]
}

/// The answers that JADE has written.
fn answers_of_jade() -> [(&'static str, &'static [u8]); 5] {
    recorded![
        "string.2-http-response-from-jade",
        "xml.2-http-response-from-jade",
        "bitefficient.2-http-response-from-jade",
        "failure-unknown-agent.2-http-response-from-jade",
        "keepalive-http-response-from-jade",
    ]
}

/// The answers that JADE has accepted.
fn answers_to_jade() -> [(&'static str, &'static [u8]); 3] {
    recorded![
        "string.4-http-response-to-jade",
        "xml.4-http-response-to-jade",
        "bitefficient.4-http-response-to-jade",
    ]
}

/// Reads a request in steps of this many bytes. Returns the bytes that are left.
fn read(bytes: &[u8], step: usize) -> Result<Option<(RequestHead, Bytes, Vec<u8>)>, RequestError> {
    let mut reader = RequestReader::default();
    let mut pieces = bytes.chunks(step.max(1));
    let head = loop {
        if let Some(head) = reader.head(MAX_BODY)? {
            break head;
        }
        match pieces.next() {
            Some(piece) => reader.buffer().extend_from_slice(piece),
            None => return Ok(None),
        }
    };
    while reader.missing(head.length) > 0 {
        match pieces.next() {
            Some(piece) => reader.buffer().extend_from_slice(piece),
            None => return Ok(None),
        }
    }
    let body = reader.body(head.length);
    let mut left = reader.buffer().to_vec();
    left.extend(pieces.flatten());
    Ok(Some((head, body, left)))
}

/// Returns the request line and header fields of a request.
fn head_of(bytes: &[u8]) -> String {
    let end = bytes.windows(4).position(|it| it == b"\r\n\r\n").unwrap();
    String::from_utf8(bytes[..end].to_vec()).unwrap()
}

#[test]
fn recorded_requests_are_read_and_written_byte_for_byte() {
    for (file, bytes) in requests_of_jade().into_iter().chain(requests_to_jade()) {
        let (head, body, left) = read(bytes, 7).unwrap().unwrap();
        // JADE writes a line break that Content-Length does not count.
        let of_jade = file.ends_with("from-jade");
        assert_eq!(left, if of_jade { &b"\r\n"[..] } else { b"" }, "{file}");
        assert_eq!(head.keeps, of_jade, "{file}");
        let parts = multipart::parse(&body, &head.boundary).unwrap();
        let (envelope, payload) = (&body[parts.envelope], &body[parts.payload]);
        assert!(envelope.starts_with(b"<?xml"), "{file}");
        let read = letter::read(&body, &head.boundary).unwrap();
        let message = Message::decode(read.letter.payload()).unwrap();
        let conversation = message.conversation_id().unwrap();
        assert!(["conv-1", "df-1", "fail-1"].contains(&conversation));
        let (named, _) = Envelope::decode(&read.letter.envelope()).unwrap();
        let named = named.effective();
        assert_eq!(named.intended_receivers, message.receivers(), "{file}");
        assert_eq!(named.from.as_ref(), message.sender(), "{file}");
        assert_eq!(named.payload_length, Some(payload.len() as u64), "{file}");
        // Written again, it has the same bytes.
        let text = head_of(bytes);
        let line = text.lines().next().unwrap();
        let url = line.split(' ').nth(1).unwrap();
        let url = Url::parse(Kind::Http, url.strip_prefix("http://").unwrap()).unwrap();
        let boundary = std::str::from_utf8(&head.boundary).unwrap();
        let payload_of = (payload.len(), None);
        let (mut written, end) = request::write(&url, boundary, envelope, payload_of, head.keeps);
        written.extend_from_slice(payload);
        written.extend_from_slice(end.as_bytes());
        written.extend_from_slice(&left);
        assert_eq!(written, bytes, "{file}");
    }
}

#[test]
fn the_failure_of_jade_names_the_receiver_and_the_reason() {
    let [.., (_, bytes)] = requests_of_jade();
    let (head, body, _) = read(bytes, usize::MAX).unwrap().unwrap();
    let letter = letter::read(&body, &head.boundary).unwrap().letter;
    let message = Message::decode(letter.payload()).unwrap();
    assert_eq!(*message.performative(), Performative::Failure);
    let text = String::from_utf8_lossy(message.content().unwrap()).into_owned();
    assert!(text.contains("(MTS-error ( agent-identifier :name nobody@jadetest"));
}

#[test]
fn recorded_answers_are_read_one_after_the_other() {
    let mut reader = ResponseReader::default();
    for (file, bytes) in answers_of_jade() {
        for piece in bytes.chunks(5) {
            reader.buffer().extend_from_slice(piece);
        }
        let expected = Response {
            status: 200,
            reason: "OK".to_owned(),
            keeps: file.starts_with("keepalive"),
        };
        assert_eq!(reader.next(), Ok(Some(expected)), "{file}");
        assert_eq!(reader.next(), Ok(None), "{file}");
    }
    for (file, bytes) in answers_to_jade() {
        reader.buffer().extend_from_slice(bytes);
        assert_eq!(reader.next().unwrap().unwrap().status, 200, "{file}");
        assert_eq!(Status::Ok.answer(false).as_bytes(), bytes, "{file}");
    }
    let kept = Status::Ok.answer(true);
    assert!(kept.contains("\r\nConnection: Keep-Alive\r\n"), "{kept}");
}

#[test]
fn an_answer_with_a_length_may_contain_the_beginning_of_another() {
    let mut reader = ResponseReader::default();
    let body = "HTTP/1.1 500 quoted\r\n\r\n";
    let answer = format!(
        "HTTP/1.1 100 Continue\r\n\r\nHTTP/1.1 406 Not\r\n Acceptable\r\ncontent-length:{}\r\n\r\n{body}",
        body.len()
    );
    for byte in answer.as_bytes() {
        reader.buffer().extend_from_slice(&[*byte]);
    }
    let answer = reader.next().unwrap().unwrap();
    assert_eq!((answer.status, answer.keeps), (406, true));
    assert_eq!(reader.next(), Ok(None));
    reader.buffer().extend_from_slice(b"HTTP/1.0 200\r\n\r\n");
    let old = reader.next().unwrap().unwrap();
    assert_eq!((old.status, old.keeps), (200, false));
    // A chunked body may contain any line.
    let chunked = b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n";
    reader.buffer().extend_from_slice(chunked);
    assert!(!reader.next().unwrap().unwrap().keeps);
}

#[test]
fn answers_that_are_none_end_in_an_error() {
    let all = |bytes: &[u8]| {
        let mut reader = ResponseReader::default();
        reader.buffer().extend_from_slice(bytes);
        reader.next()
    };
    assert_eq!(
        all(b"HTTP/1.1 2x0 OK\r\n\r\n"),
        Err(ResponseError::Malformed)
    );
    assert_eq!(
        all(&b"no answer\n".repeat(7000)),
        Err(ResponseError::NoAnswer)
    );
    assert_eq!(all(&b"x".repeat(70_000)), Err(ResponseError::NoAnswer));
    let endless = [&b"HTTP/1.1 200 OK\r\n"[..], &b"a: b\r\n".repeat(3000)].concat();
    assert_eq!(all(&endless), Err(ResponseError::HeadTooLarge));
}

#[test]
fn answers_that_announce_another_one_without_end_end_in_an_error() {
    let mut reader = ResponseReader::default();
    let interim = b"HTTP/1.1 102 Processing\r\n\r\n";
    let end = (0..10_000).find_map(|_| {
        reader.buffer().extend_from_slice(interim);
        match reader.next() {
            Ok(answer) => {
                assert_eq!(answer, None);
                None
            }
            Err(error) => Some(error),
        }
    });
    assert_eq!(end, Some(ResponseError::NoAnswer));
    // Their number starts again with each answer.
    let mut reader = ResponseReader::default();
    for _ in 0..10 {
        let answer = [&interim.repeat(1000)[..], b"HTTP/1.1 200 OK\r\n\r\n"].concat();
        reader.buffer().extend_from_slice(&answer);
        assert_eq!(reader.next().unwrap().unwrap().status, 200);
    }
}

#[test]
fn a_connection_keeps_no_memory_of_a_body() {
    const LEN: usize = 1 << 20;
    for spare in [0, 100, LEN] {
        let mut reader = RequestReader::default();
        reader.buffer().reserve(LEN + 2 + spare);
        reader.buffer().extend_from_slice(&vec![7; LEN]);
        reader.buffer().extend_from_slice(b"\r\n");
        let body = reader.body(LEN);
        assert_eq!(body, vec![7; LEN]);
        drop(body);
        assert_eq!(&reader.buffer()[..], b"\r\n");
        // As the server reads the next request.
        reader.buffer().reserve(4096);
        assert!(reader.buffer().capacity() < 64 << 10, "{spare}");
    }
}

/// A request with these header fields after the request line and a body of no bytes.
fn request(line: &str, fields: &str) -> String {
    format!("{line}\r\nContent-Length: 0\r\n{fields}\r\n")
}

const LINE: &str = "POST /acc HTTP/1.1";
const MIXED: &str = "Content-Type: multipart/mixed ; boundary=\"b\"\r\n";

#[test]
fn quirks_of_requests_are_accepted() {
    let folded = "Content-Type: multipart-mixed ;\r\n\tboundary=\"b\"\r\n";
    for (line, fields) in [
        (LINE, MIXED),
        ("POST http://h:7778/acc HTTP/1.1", MIXED),
        ("POST http://h/acc?x HTTP/1.0", MIXED),
        (LINE, folded),
        (LINE, "content-type:Multipart/Mixed;boundary=b\r\n"),
    ] {
        let text = request(line, fields);
        let (head, ..) = read(text.as_bytes(), 3).unwrap().unwrap();
        assert_eq!(head.boundary, b"b", "{text}");
    }
    let keeps = |line: &str, field: &str| {
        let text = request(line, &format!("{MIXED}{field}"));
        read(text.as_bytes(), 9).unwrap().unwrap().0.keeps
    };
    assert!(keeps(LINE, "") && keeps(LINE, "Connection: Keep-Alive\r\n"));
    assert!(!keeps(LINE, "Connection: Close\r\n"));
    assert!(!keeps("POST /acc HTTP/1.0", ""));
    assert!(keeps("POST /acc HTTP/1.0", "Connection: keep-alive\r\n"));
    let waits = request(LINE, &format!("{MIXED}Expect: 100-continue\r\n"));
    assert!(read(waits.as_bytes(), 9).unwrap().unwrap().0.waits);
    // Line breaks behind the previous body, and line feeds alone.
    let text = format!("\r\n\n{}", request(LINE, MIXED).replace('\r', ""));
    assert!(read(text.as_bytes(), 1).unwrap().is_some());
}

#[test]
fn other_requests_are_refused() {
    let many = format!("{MIXED}{}", "a: b\r\n".repeat(100));
    let long = format!(
        "Content-Type: multipart/mixed; boundary={}\r\n",
        "b".repeat(10_000)
    );
    let huge = format!("{MIXED}{}", "a: b\r\n".repeat(10_000));
    for (line, fields, expected) in [
        ("GET /acc HTTP/1.1", MIXED, RequestError::Method),
        ("POST /other HTTP/1.1", MIXED, RequestError::Path),
        ("POST http://h HTTP/1.1", MIXED, RequestError::Path),
        ("POST /acc HTTP/2.0", MIXED, RequestError::Version),
        (LINE, "", RequestError::NotMultipart),
        (
            LINE,
            "Content-Type: text/plain\r\n",
            RequestError::NotMultipart,
        ),
        (
            LINE,
            "Content-Type: multipart/mixed\r\n",
            RequestError::Boundary,
        ),
        (LINE, &long, RequestError::Boundary),
        (LINE, &many, RequestError::HeadTooLarge),
        (LINE, &huge, RequestError::HeadTooLarge),
        (
            LINE,
            &format!("{MIXED}Transfer-Encoding: chunked\r\n"),
            RequestError::NoLength,
        ),
        (
            LINE,
            &format!("{MIXED}Content-Length: 1\r\n"),
            RequestError::Malformed("a header field with two values"),
        ),
        (
            LINE,
            &format!("{MIXED}Expect: else\r\n"),
            RequestError::Expectation,
        ),
        (
            LINE,
            &format!("{MIXED}Origin: http://evil.example\r\n"),
            RequestError::WebPage,
        ),
    ] {
        let text = request(line, fields);
        let refused = read(text.as_bytes(), 100);
        assert_eq!(refused, Err(expected), "{line} {:.60}", fields);
    }
    let without = format!("{LINE}\r\n{MIXED}\r\n");
    assert_eq!(read(without.as_bytes(), 100), Err(RequestError::NoLength));
    let larger = format!("{LINE}\r\n{MIXED}Content-Length: {}\r\n\r\n", MAX_BODY + 1);
    assert_eq!(
        read(larger.as_bytes(), 100),
        Err(RequestError::TooLarge(MAX_BODY))
    );
    for length in ["-1", "+1", "0x1", "1 2", ""] {
        let text = format!("{LINE}\r\n{MIXED}Content-Length: {length}\r\n\r\n");
        let refused = read(text.as_bytes(), 100);
        assert!(
            matches!(refused, Err(RequestError::Malformed(_))),
            "{length}"
        );
    }
    assert!(read(&b"\r\n".repeat(100), 10).is_err());
    assert!(matches!(
        read(b"\x16\x03\x01\x02\0\n\r\n", 100),
        Err(RequestError::Malformed(_))
    ));
}

#[test]
fn bodies_have_two_parts() {
    let of = |body: &str| multipart::parse(body.as_bytes(), b"b");
    for (body, expected) in [
        ("", MultipartError::Truncated),
        (
            "--b\r\n\r\ne\r\n--b\r\n\r\np\r\n",
            MultipartError::Truncated,
        ),
        ("--b\r\n\r\ne\r\n--b--\r\n", MultipartError::Parts),
        ("--b--\r\n", MultipartError::Truncated),
        (
            "--b\r\n\r\n1\r\n--b\r\n\r\n2\r\n--b\r\n\r\n3\r\n--b--\r\n",
            MultipartError::Parts,
        ),
        ("--b\r\n--b\r\n--b--\r\n", MultipartError::PartHead),
        (
            "--b\r\nA\r\n--b\r\n\r\np\r\n--b--",
            MultipartError::PartHead,
        ),
        (
            "--b\r\nContent-Transfer-Encoding: base64\r\n\r\ne\r\n--b\r\n\r\np\r\n--b--",
            MultipartError::TransferEncoding,
        ),
    ] {
        assert_eq!(of(body), Err(expected), "{body}");
    }
    let many = "--b\r\n\r\nx\r\n".repeat(100_000);
    assert_eq!(of(&many), Err(MultipartError::Parts));
    let body = "preamble --b\r\n--bc\r\n--b \t\r\nX: y\r\n\r\n<e/>\r\n--b\r\nContent-Type: \
                application/text; charset=UTF-8\r\n\r\n--b x\r\nb--b\r\n--b--ignored";
    let parts = of(body).unwrap();
    assert_eq!(&body[parts.envelope], "<e/>");
    assert_eq!(&body[parts.payload], "--b x\r\nb--b");
    assert_eq!(parts.charset.as_deref(), Some("UTF-8"));
    // Line feeds alone.
    let parts = of("--b\n\ne\n--b\n\np\n--b--").unwrap();
    assert_eq!((parts.envelope, parts.payload), (5..6, 12..13));
}

#[test]
fn latin_text_becomes_utf_8() {
    let [(_, bytes), ..] = requests_to_jade();
    let text = String::from_utf8(bytes.to_vec()).unwrap();
    let (_, body) = text.split_once("\r\n\r\n").unwrap();
    let named = "</acl-representation><payload-encoding>ISO-8859-1</payload-encoding>";
    let body = body.replace("</acl-representation>", named);
    let (before, after) = body.split_once("hello jade").unwrap();
    let body = [before.as_bytes(), b"gr\xfc\xdfe", after.as_bytes()].concat();
    let letter = letter::read(&body.into(), b"BOUNDARY123").unwrap().letter;
    let message = Message::decode(letter.payload()).unwrap();
    assert_eq!(message.content().unwrap(), "grüße");
}

proptest! {
    #[test]
    fn a_written_request_is_read_whatever_the_payload(
        envelope: Vec<u8>,
        payload: Vec<u8>,
        charset in prop::option::of("[A-Z0-9-]{1,12}"),
        keeps: bool,
        step in 1_usize..200,
    ) {
        let boundary = "0123456789abcdef0123456789abcde";
        let url = Url::parse(Kind::Http, "10.0.0.1:7778/acc").unwrap();
        let payload_of = (payload.len(), charset.as_deref());
        let (mut bytes, end) = request::write(&url, boundary, &envelope, payload_of, keeps);
        bytes.extend_from_slice(&payload);
        bytes.extend_from_slice(end.as_bytes());
        let next = b"\r\nPOST next";
        bytes.extend_from_slice(next);
        let (head, body, left) = read(&bytes, step).unwrap().unwrap();
        prop_assert_eq!((head.keeps, &left[..]), (keeps, &next[..]));
        let parts = multipart::parse(&body, &head.boundary).unwrap();
        prop_assert_eq!(&body[parts.envelope], &envelope[..]);
        prop_assert_eq!(&body[parts.payload], &payload[..]);
        prop_assert_eq!(parts.charset, charset);
    }

    #[test]
    fn any_bytes_are_read_the_same_in_any_pieces(
        bytes in prop::collection::vec(prop_oneof![
            Just(b"POST /acc HTTP/1.1\r\n".to_vec()),
            Just(MIXED.as_bytes().to_vec()),
            Just(b"Content-Length: 20\r\n".to_vec()),
            Just(b"\r\n".to_vec()),
            Just(b"--b\r\n".to_vec()),
            Just(b"--b--".to_vec()),
            Just(b"HTTP/1.1 200 OK\r\n".to_vec()),
            any::<Vec<u8>>(),
        ], 0..12),
        step in 1_usize..40,
    ) {
        let bytes = bytes.concat();
        let whole = read(&bytes, usize::MAX);
        prop_assert_eq!(&read(&bytes, step), &whole);
        if let Ok(Some((head, body, _))) = whole {
            if let Ok(parts) = multipart::parse(&body, &head.boundary) {
                prop_assert!(parts.envelope.end <= parts.payload.start);
                prop_assert!(parts.payload.end <= body.len());
            }
            let _ = letter::read(&body, &head.boundary);
        }
        let answers = |step: usize| {
            let mut reader = ResponseReader::default();
            let mut all = Vec::new();
            for piece in bytes.chunks(step) {
                reader.buffer().extend_from_slice(piece);
                loop {
                    match reader.next() {
                        Ok(Some(answer)) => all.push(Ok(answer)),
                        Ok(None) => break,
                        Err(error) => {
                            all.push(Err(error));
                            return all;
                        }
                    }
                }
            }
            all
        };
        prop_assert_eq!(answers(step), answers(bytes.len().max(1)));
    }
}
