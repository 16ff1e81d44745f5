//! The framed stream and its connection, which TCP, TLS, the Unix socket and QUIC share. Bytes of a
//! peer alternate with operations of the honest end.
//!
//! * No bytes make the reader or the connection panic.
//! * Memory stays within the announced lengths and the limits.
//! * Every attempt has exactly one conclusion.

use std::time::{Duration, Instant};

use bytes::Bytes;
use fipa_acl::{Letter, Payload};
use fipa_transport::{Answer, Body, FailureReason, Incarnation, Parcel, Report, Stream};
use fipa_transport_net::fuzzing::{Framed, answer_body, frame, hello_body, parcel_body as written};

use crate::input::Input;

/// Runs a connection with the bytes and operations that the input encodes.
pub fn play(bytes: &[u8]) {
    let mut input = Input(bytes);
    let how = input.byte();
    let mut now = Instant::now();
    let mut end = Framed::new(how & 1 == 1, how & 2 == 2, now);
    if how & 4 == 0 {
        let service = if how & 0xf8 == 0 { 1 } else { 7 };
        let hello = frame(1, 0, &hello_body(service, 4));
        end.arrive(&hello, usize::MAX, now);
    }
    let mut next = 1;
    while !input.is_empty() && !end.has_ended() {
        let step = match input.byte() {
            0..=127 => usize::MAX,
            step => usize::from(step - 127),
        };
        match input.byte() % 12 {
            0 => end.arrive(input.bytes(255), step, now),
            1 => {
                let kind = input.byte() % 8;
                let id = input.number();
                end.arrive(&frame(kind, id, input.bytes(255)), step, now);
            }
            2 | 3 => {
                let body = written(&parcel(&mut input));
                end.arrive(&frame(2, next, &body), step, now);
                next += 1;
            }
            4 => {
                // The start of a parcel with another announced length.
                let mut begun = frame(2, next, &written(&parcel(&mut input)));
                let said = input.number();
                begun[16..24].copy_from_slice(&said.to_le_bytes());
                end.arrive(&begun, step, now);
            }
            5 => {
                let body = answer_body(&answer(&mut input));
                end.arrive(&frame(3, input.number(), &body), step, now);
            }
            6 => end.send(&parcel(&mut input)),
            7 => end.abandon(input.number(), now),
            8 => {
                let answer = answer(&mut input);
                end.answer(input.below(256), &answer, now);
            }
            9 | 10 => end.transmit(step.saturating_mul(8), now),
            _ => {
                now += input.time().min(Duration::from_secs(100));
                end.timeout(now);
            }
        }
    }
    end.close();
}

/// Returns a parcel with any fields.
pub fn parcel(input: &mut Input<'_>) -> Parcel {
    let body = match input.below(6) {
        0 => Body::Credit,
        1 => Body::Predecessor,
        2 => Body::Report(Report::Moved),
        3 => Body::Letter(letter(input.bytes(60), 40_000 + input.below(256) * 100)),
        _ => {
            let len = input.below(256);
            Body::Letter(letter(input.bytes(60), len))
        }
    };
    Parcel {
        receiver: String::from_utf8_lossy(input.bytes(20)).into(),
        stream: Stream::between(
            Incarnation::from_u64(input.number()),
            Incarnation::from_u64(input.number()),
        ),
        sequence: input.number(),
        after: input.number(),
        transfer: input.number(),
        remaining: input.time(),
        body,
    }
}

fn letter(envelope: &[u8], len: usize) -> Letter {
    let payload = Payload {
        head: Bytes::from_static(b"head"),
        content: vec![7; len].into(),
        tail: Bytes::from_static(b"\x01"),
    };
    Letter::new(Bytes::copy_from_slice(envelope), payload)
}

/// Returns any answer.
pub fn answer(input: &mut Input<'_>) -> Answer {
    match input.below(7) {
        0 => Answer::Accepted,
        1 => Answer::Custody,
        2 => Answer::Busy,
        3 => Answer::OutOfOrder {
            last: input.number(),
        },
        4 => Answer::Returned {
            uncertain: input.byte() & 1 == 1,
        },
        5 => Answer::Moved,
        _ => Answer::failed(
            FailureReason::Refused,
            String::from_utf8_lossy(input.bytes(255)),
        ),
    }
}
