//! The streams of a QUIC connection, as its link reads them. A peer opens, fills, finishes and resets
//! streams in any order, alternating with operations of the honest end.
//!
//! * No bytes on any stream make the link panic or run without end.
//! * No letter is read before the hello, and streams are read in the order of their opening.
//! * Memory stays within the announced lengths and the limits.
//! * Every attempt has exactly one conclusion, and every introduction one end.

use fipa_transport_net::fuzzing::{QuicStreams, answer_body, frame, hello_body, parcel_body};

use crate::framed::{answer, parcel};
use crate::input::Input;

/// Runs a connection with the bytes and operations that the input encodes.
pub fn play(bytes: &[u8]) {
    let mut input = Input(bytes);
    let how = input.byte();
    let mut end = QuicStreams::new(how & 0x30 == 0x30, how & 2 == 2, how & 1 == 1);
    if how & 4 == 0 {
        let service = if how & 0xf0 == 0xf0 { 1 } else { 7 };
        end.control(&frame(1, 0, &hello_body(service, 4)));
    }
    let mut next = 1;
    while !input.is_empty() && !end.has_ended() {
        // Half of the operations are about the latest stream.
        let pick = match input.byte() {
            0..=127 => usize::MAX,
            pick => usize::from(pick - 128),
        };
        match input.byte() % 18 {
            0 => end.control(input.bytes(255)),
            1 => {
                let (kind, id) = (input.byte() % 8, input.number());
                end.control(&frame(kind, id, input.bytes(255)));
            }
            2 => end.control(&frame(3, input.number(), &answer_body(&answer(&mut input)))),
            3 => end.open(),
            4 | 5 => {
                // A stream as honest peers use it.
                end.open();
                end.letter(
                    usize::MAX,
                    &frame(2, next, &parcel_body(&parcel(&mut input))),
                );
                end.end_letter(usize::MAX, false);
                next += 1;
            }
            6 => {
                // The parcel may be on the wrong stream, or one of several.
                let written = frame(2, next, &parcel_body(&parcel(&mut input)));
                next += 1;
                match input.byte() & 1 {
                    0 => end.letter(pick, &written),
                    _ => end.control(&written),
                }
            }
            7 => {
                // The start of a parcel, possibly with another announced length.
                let mut begun = frame(2, next, &parcel_body(&parcel(&mut input)));
                next += u64::from(input.byte() & 1);
                if input.byte() & 1 == 0 {
                    begun[16..24].copy_from_slice(&input.number().to_le_bytes());
                }
                begun.truncate(input.below(256) * 256);
                end.letter(pick, &begun);
            }
            8 => end.letter(pick, input.bytes(255)),
            9 => end.letter(pick, &vec![7; input.below(256) * 512]),
            10 => {
                let (kind, id) = (input.byte() % 8, input.number());
                end.letter(pick, &frame(kind, id, input.bytes(255)));
            }
            11 | 12 => end.end_letter(pick, input.below(8) == 7),
            13 => end.send(&parcel(&mut input)),
            14 => end.abandon(input.number()),
            15 => end.answer(input.below(256), &answer(&mut input)),
            16 => end.room(match input.byte() {
                255 => usize::MAX,
                room => usize::from(room) * 64,
            }),
            _ => match input.byte() {
                0 => end.lose(),
                1 => end.end_control(false),
                2 => end.end_control(true),
                _ => {}
            },
        }
    }
    end.close();
}
