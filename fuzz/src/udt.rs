//! Packets of several peers to the UDT transport, before and after the handshake, and letters to
//! them.
//!
//! * An unverified address receives at most as many bytes as it sent.
//! * Every sent datagram is one of the protocol, and no larger than a packet.
//! * No letter that arrives exceeds the limit.
//! * Every attempt has exactly one conclusion.

use std::time::{Duration, Instant};

use fipa_transport_net::fuzzing::{UdtPacket, UdtPackets};

use crate::input::Input;

/// Runs an endpoint with the packets and calls that the bytes encode.
pub fn play(bytes: &[u8]) {
    let mut input = Input(bytes);
    let mut end = UdtPackets::new(u64::from(input.byte()), Instant::now());
    let mut next = 0_u32;
    while !input.is_empty() {
        let peer = input.byte();
        let listening = peer & 0x80 == 0;
        match input.byte() % 16 {
            0 => end.arrive(peer, UdtPacket::Raw(input.bytes(255)), listening),
            1 | 2 => {
                let client = |returns| UdtPacket::Client {
                    socket: 5,
                    initial: 0x7fff_fff0,
                    size: (1500, 8192),
                    returns,
                };
                end.arrive(peer, client(false), true);
                end.arrive(peer, client(true), true);
                next = 0;
            }
            3 => {
                let client = UdtPacket::Client {
                    socket: word(&mut input),
                    initial: word(&mut input),
                    size: (word(&mut input), word(&mut input)),
                    returns: input.byte() & 1 == 1,
                };
                end.arrive(peer, client, listening);
            }
            4 => end.send(peer, input.byte() as usize * 200),
            5 => {
                let server = |request| UdtPacket::Server {
                    request,
                    socket: 9,
                    size: (1500, 8192),
                };
                end.arrive(peer, server(1), listening);
                end.arrive(peer, server(-1), listening);
            }
            6 => {
                let server = UdtPacket::Server {
                    request: word(&mut input) as i32,
                    socket: word(&mut input),
                    size: (word(&mut input), word(&mut input)),
                };
                end.arrive(peer, server, listening);
            }
            7..=9 => {
                // A letter of a few packets, mostly in sequence.
                let count = u32::from(input.byte() % 20) + 1;
                for packet in 0..count {
                    let skip = match input.byte() {
                        skip @ 0..=8 => u32::from(skip),
                        _ => 0,
                    };
                    let begins = u8::from(packet == 0) * 2;
                    let data = UdtPacket::Data {
                        offset: next + skip,
                        position: begins | u8::from(packet + 1 == count),
                        message: count,
                        payload: &[7; 1456][..usize::from(input.byte()) * 5],
                    };
                    end.arrive(peer, data, listening);
                    next += 1;
                }
            }
            10 => {
                let data = UdtPacket::Data {
                    offset: word(&mut input),
                    position: input.byte(),
                    message: word(&mut input),
                    payload: input.bytes(255),
                };
                end.arrive(peer, data, listening);
            }
            11 => {
                let ack = UdtPacket::Ack {
                    back: word(&mut input).wrapping_sub(1),
                    window: (input.byte() % 4 > 0).then(|| word(&mut input)),
                };
                end.arrive(peer, ack, listening);
            }
            12 => {
                let count = input.below(5);
                let runs: Vec<(u32, u32)> = (0..count)
                    .map(|_| (word(&mut input), word(&mut input)))
                    .collect();
                end.arrive(peer, UdtPacket::Loss(&runs), listening);
            }
            13 => {
                let packet = match input.byte() % 4 {
                    0 => UdtPacket::Ack2(word(&mut input)),
                    1 => UdtPacket::Drop(word(&mut input), word(&mut input), word(&mut input)),
                    2 => UdtPacket::Shutdown,
                    _ => UdtPacket::KeepAlive,
                };
                end.arrive(peer, packet, listening);
            }
            14 => end.pass(Duration::from_millis(u64::from(input.byte()))),
            _ => end.pass(input.time().min(Duration::from_secs(20))),
        }
    }
    end.close();
}

fn word(input: &mut Input<'_>) -> u32 {
    input.number() as u32
}
