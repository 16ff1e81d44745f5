//! The readers of letters over HTTP: requests, bodies and answers of peers.
//!
//! * No bytes make a reader panic, and every reader ends.
//! * The result does not depend on the pieces in which the bytes arrive.
//! * A letter that was read is the same when it is written and read again.

use fipa_transport_net::fuzzing::http::{answers, body, requests};

use crate::input::Input;

macro_rules! recorded {
    ($file:literal) => {
        include_bytes!(concat!(
            "../../transport-net/tests/data/jade_http/",
            $file,
            ".bin"
        ))
        .as_slice()
    };
}
/// Recorded exchanges of JADE, with the byte that selects the reader.
pub const RECORDED: [(u8, &[u8]); 6] = [
    (0, recorded!("string.3-echo-reply-from-jade")),
    (0, recorded!("xml.3-echo-reply-from-jade")),
    (0, recorded!("bitefficient.3-echo-reply-from-jade")),
    (
        0,
        recorded!("failure-unknown-agent.3-ams-failure-from-jade"),
    ),
    (1, recorded!("keepalive-http-response-from-jade")),
    (1, recorded!("string.4-http-response-to-jade")),
];

/// Reads the bytes behind the first two as the first one selects; the second is the length of the
/// pieces.
pub fn play(bytes: &[u8]) {
    let mut input = Input(bytes);
    let (reader, step) = (input.byte(), usize::from(input.byte()).max(1));
    let bytes = input.0;
    match reader % 3 {
        0 => assert_eq!(requests(bytes, step), requests(bytes, usize::MAX)),
        1 => assert_eq!(answers(bytes, step), answers(bytes, usize::MAX)),
        _ => body(bytes, b"b"),
    }
}

/// Returns the seeds: recorded exchanges, and a body.
#[must_use]
pub fn seeds() -> Vec<Vec<u8>> {
    let recorded = RECORDED.iter();
    let recorded = recorded.map(|(reader, bytes)| [&[*reader, 100], *bytes].concat());
    let body = b"\x02\x00--b\r\nContent-Type: application/xml\r\n\r\n<envelope><params index='1'><to>\
                 <agent-identifier><name>a</name></agent-identifier></to><acl-representation>x\
                 </acl-representation><date>20261120Z111103289</date></params></envelope>\r\n--b\r\n\
                 \r\n(inform)\r\n--b--\r\n";
    recorded.chain([body.to_vec()]).collect()
}
