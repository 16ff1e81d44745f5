//! Datagrams of several peers to the UDP transport, before and after the handshake.
//!
//! * An unverified address receives at most as many bytes as it sent.
//! * Every sent datagram is one of the protocol.
//! * Every attempt has exactly one conclusion.

use std::time::{Duration, Instant};

use fipa_transport_net::fuzzing::{Datagrams, Written, parcel_body as written};

use crate::framed::{answer, parcel};
use crate::input::Input;

/// Runs an endpoint with the datagrams and calls that the bytes encode.
pub fn play(bytes: &[u8]) {
    let mut input = Input(bytes);
    let mut now = Instant::now();
    let mut end = Datagrams::new(u64::from(input.byte()), now);
    let mut packet = 0;
    while !input.is_empty() {
        let peer = input.byte();
        let listening = peer & 0x80 == 0;
        match input.byte() % 14 {
            0 => end.arrive(peer, Written::Raw(input.bytes(255)), listening, now),
            1 | 2 => {
                let (initiator, service) = (input.number(), input.number());
                for cookie in [false, true] {
                    let hello = Written::Hello {
                        initiator,
                        cookie,
                        service: (service, input.number()),
                    };
                    end.arrive(peer, hello, listening, now);
                }
            }
            3 => {
                let hello = Written::Hello {
                    initiator: input.number(),
                    cookie: input.byte() & 1 == 1,
                    service: (input.number(), input.number()),
                };
                end.arrive(peer, hello, listening, now);
            }
            4 => end.arrive(peer, Written::Cookie, listening, now),
            5 => {
                let service = input.number();
                end.arrive(peer, Written::Welcome { service }, listening, now);
            }
            6 => {
                let datagram = match input.below(4) {
                    0 => Written::Refused,
                    _ => Written::Unknown(input.number()),
                };
                end.arrive(peer, datagram, listening, now);
            }
            7..=10 => {
                let mut frames = Vec::new();
                for _ in 0..=input.below(3) {
                    put_frame(&mut frames, &mut input);
                }
                let (known, number) = match input.byte() {
                    0 => (true, input.number()),
                    1 => (false, input.number()),
                    skip => {
                        packet += u64::from(skip % 4);
                        (true, packet)
                    }
                };
                let data = Written::Data {
                    known,
                    number,
                    frames: &frames,
                };
                end.arrive(peer, data, listening, now);
            }
            11 => {
                let service = input.number();
                end.send(peer, service, &parcel(&mut input), now);
            }
            12 => {
                let answer = answer(&mut input);
                end.answer(input.below(256), &answer, now);
            }
            _ => end.pass(&mut now, input.time().min(Duration::from_secs(100))),
        }
    }
    end.close(now);
}

/// Appends a frame of a packet, mostly well-formed: an acknowledgment, a parcel, an answer, or
/// another kind.
fn put_frame(frames: &mut Vec<u8>, input: &mut Input<'_>) {
    let kind = input.byte() % 8;
    frames.push(kind);
    match kind {
        1 => {
            frames.extend(input.number().to_le_bytes());
            frames.extend([0; 4]);
            let map = input.bytes(32);
            frames.push(map.len() as u8);
            frames.extend_from_slice(map);
        }
        2 => {
            frames.extend(input.number().to_le_bytes());
            frames.extend(written(&parcel(input)));
        }
        3 => {
            frames.extend(input.number().to_le_bytes());
            let answer = input.bytes(40);
            frames.push(answer.len() as u8);
            frames.extend_from_slice(answer);
        }
        _ => frames.extend(input.number().to_le_bytes()),
    }
}
