//! The packets of UDT (draft-gg-udt-03 section 2), as libudt 4.11 writes them. Integers are
//! big-endian words of 32 bits.
//!
//! Every packet begins with four words. The last two are a time in microseconds, which is not used,
//! and the socket of the receiver, or 0 in the handshake of a client.
//!
//! | packet | first word | second word | contents |
//! |---|---|---|---|
//! | data | sequence number | position (2 bits), in order (1), message number (29) | a part of the message |
//! | handshake | 0x8000_0000 | 0 | [`Handshake`], 12 words |
//! | keep-alive | 0x8001_0000 | 0 | a word without meaning |
//! | acknowledgment | 0x8002_0000 | number of the acknowledgment | [`Ack`]: 1, 4 or 6 words |
//! | loss report | 0x8003_0000 | 0 | lost packets: a number, or the first (top bit set) and the last of several |
//! | shutdown | 0x8005_0000 | 0 | a word without meaning |
//! | acknowledgment of an acknowledgment | 0x8006_0000 | its number | a word without meaning |
//! | message drop request | 0x8007_0000 | message number | the first and the last packet of the message |
//!
//! Packets of other types, and malformed ones, are ignored. libudt appends the word without meaning
//! because it cannot send an empty part.

use std::net::{IpAddr, SocketAddr};

use super::sequence;

/// Length of the header of every packet.
pub(crate) const HEADER: usize = 16;

/// Length of the headers of IP and UDP, which count as parts of a packet.
pub(crate) const IP_AND_UDP: usize = 28;

/// The largest packet with the headers of IP and UDP that this side sends or accepts, and the one
/// that libudt proposes.
pub(crate) const MAX_PACKET: u32 = 1500;

/// The smallest such packet that this side agrees on. A smaller one would make a letter a flood of
/// packets.
pub(crate) const MIN_PACKET: u32 = 576;

/// Length of a handshake.
pub(crate) const HANDSHAKE_LEN: usize = HEADER + 4 * 12;

/// The version of the protocol.
pub(crate) const VERSION: u32 = 4;

/// The type of a socket that exchanges messages.
pub(crate) const DATAGRAMS: u32 = 2;

/// The request of a client, and the answer with a cookie.
pub(crate) const REQUEST: i32 = 1;
/// The request with the cookie, and the answer that opens the connection.
pub(crate) const CONCLUSION: i32 = -1;
/// The answer that refuses the connection.
pub(crate) const REFUSAL: i32 = 1002;

/// Number of message numbers.
pub(crate) const MESSAGES: u32 = 1 << 29;

const CONTROL: u32 = 1 << 31;
const HANDSHAKE: u16 = 0;
const KEEP_ALIVE: u16 = 1;
const ACK: u16 = 2;
const LOSS: u16 = 3;
const SHUTDOWN: u16 = 5;
const ACK2: u16 = 6;
const DROP: u16 = 7;

/// The position of a packet in its message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Position {
    Middle = 0b00,
    Last = 0b01,
    First = 0b10,
    Only = 0b11,
}

impl Position {
    /// Returns the position of a packet that begins a message, ends it, or both.
    pub(crate) fn of(begins: bool, ends: bool) -> Self {
        match (begins, ends) {
            (true, true) => Self::Only,
            (true, false) => Self::First,
            (false, true) => Self::Last,
            (false, false) => Self::Middle,
        }
    }

    pub(crate) fn begins(self) -> bool {
        matches!(self, Self::First | Self::Only)
    }

    pub(crate) fn ends(self) -> bool {
        matches!(self, Self::Last | Self::Only)
    }

    fn from_bits(bits: u32) -> Self {
        Self::of(bits & 0b10 != 0, bits & 0b01 != 0)
    }
}

/// A packet with a part of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Data<'a> {
    /// The sequence number on the wire.
    pub(crate) sequence: u32,
    pub(crate) position: Position,
    /// Whether the message must not arrive before earlier ones.
    pub(crate) in_order: bool,
    pub(crate) message: u32,
    pub(crate) payload: &'a [u8],
}

/// The contents of a handshake.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Handshake {
    pub(crate) version: u32,
    /// The type of the socket.
    pub(crate) kind: u32,
    /// The sequence number of the first packet.
    pub(crate) initial: u32,
    /// The largest packet with the headers of IP and UDP.
    pub(crate) max_packet: u32,
    /// Number of packets that the sender of this handshake accepts.
    pub(crate) window: u32,
    /// [`REQUEST`], [`CONCLUSION`], or [`REFUSAL`].
    pub(crate) request: i32,
    /// The socket of the sender.
    pub(crate) socket: u32,
    pub(crate) cookie: u32,
    /// The address of the receiver as the sender sees it; nothing depends on it.
    pub(crate) address: [u32; 4],
}

/// An acknowledgment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Ack {
    /// Its number.
    pub(crate) number: u32,
    /// All packets before this sequence number on the wire have arrived.
    pub(crate) next: u32,
    /// Absent in an acknowledgment between two others, which is not acknowledged itself.
    pub(crate) receiver: Option<ReceiverState>,
}

/// The state of a receiver in its acknowledgment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct ReceiverState {
    /// Round-trip time in microseconds.
    pub(crate) rtt: u32,
    /// Variance of the round-trip time in microseconds.
    pub(crate) rtt_variance: u32,
    /// Number of packets that the receiver accepts.
    pub(crate) window: u32,
    /// Packets per second: the rate of their arrival and the capacity of the path; 0 when unknown.
    pub(crate) rates: Option<(u32, u32)>,
}

/// A packet that controls the connection.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Control {
    Handshake(Handshake),
    KeepAlive,
    Ack(Ack),
    /// Lost packets: the first and the last of each run on the wire.
    Loss(Vec<(u32, u32)>),
    Shutdown,
    /// The acknowledgment of the acknowledgment with this number.
    Ack2(u32),
    /// The sender has given up a message.
    Drop {
        message: u32,
        first: u32,
        last: u32,
    },
}

/// A packet, without its time and its receiver.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Packet<'a> {
    Data(Data<'a>),
    Control(Control),
}

impl<'a> Packet<'a> {
    /// Reads a packet and the socket of its receiver. Returns `None` for one that is malformed or of
    /// an unknown type.
    pub(crate) fn read(bytes: &'a [u8]) -> Option<(u32, Self)> {
        let (header, contents) = bytes.split_at_checked(HEADER)?;
        let mut words = words(header);
        let (first, second) = (words.next()?, words.next()?);
        let to = words.nth(1)?;
        if first & CONTROL == 0 {
            let data = Data {
                sequence: first,
                position: Position::from_bits(second >> 30),
                in_order: second & MESSAGES != 0,
                message: second % MESSAGES,
                payload: contents,
            };
            return Some((to, Self::Data(data)));
        }
        let kind = ((first & !CONTROL) >> 16) as u16;
        let control = match kind {
            HANDSHAKE => Control::Handshake(handshake(contents)?),
            KEEP_ALIVE => Control::KeepAlive,
            ACK => Control::Ack(ack(second, contents)?),
            LOSS => Control::Loss(losses(contents)?),
            SHUTDOWN => Control::Shutdown,
            ACK2 => Control::Ack2(second),
            DROP => {
                let mut words = self::words(contents);
                Control::Drop {
                    message: second % MESSAGES,
                    first: words.next()? & sequence::LARGEST,
                    last: words.next()? & sequence::LARGEST,
                }
            }
            _ => return None,
        };
        Some((to, Self::Control(control)))
    }
}

/// Returns the words of these bytes, without an incomplete last one.
fn words(bytes: &[u8]) -> impl Iterator<Item = u32> {
    let (words, _) = bytes.as_chunks::<4>();
    words.iter().map(|word| u32::from_be_bytes(*word))
}

fn handshake(contents: &[u8]) -> Option<Handshake> {
    if contents.len() != HANDSHAKE_LEN - HEADER {
        return None;
    }
    let mut words = words(contents);
    let mut next = || words.next();
    Some(Handshake {
        version: next()?,
        kind: next()?,
        initial: next()?,
        max_packet: next()?,
        window: next()?,
        request: next()?.cast_signed(),
        socket: next()?,
        cookie: next()?,
        address: [next()?, next()?, next()?, next()?],
    })
}

fn ack(number: u32, contents: &[u8]) -> Option<Ack> {
    let mut words = words(contents);
    let next = words.next()? & sequence::LARGEST;
    let receiver = match (words.next(), words.next(), words.next()) {
        (Some(rtt), Some(rtt_variance), Some(window)) => Some(ReceiverState {
            rtt,
            rtt_variance,
            window,
            rates: words.next().zip(words.next()),
        }),
        _ => None,
    };
    Some(Ack {
        number,
        next,
        receiver,
    })
}

fn losses(contents: &[u8]) -> Option<Vec<(u32, u32)>> {
    let mut words = words(contents);
    let mut losses = Vec::new();
    while let Some(word) = words.next() {
        let first = word & sequence::LARGEST;
        let last = match word & CONTROL {
            0 => first,
            _ => words.next().filter(|last| last & CONTROL == 0)?,
        };
        losses.push((first, last));
    }
    (!losses.is_empty()).then_some(losses)
}

/// Writes a packet of data without its payload, and appends it.
pub(crate) fn put_data(out: &mut Vec<u8>, data: &Data<'_>, time: u32, to: u32) {
    let position = (data.position as u32) << 30;
    let in_order = if data.in_order { MESSAGES } else { 0 };
    put(
        out,
        [
            data.sequence & sequence::LARGEST,
            position | in_order | (data.message % MESSAGES),
            time,
            to,
        ],
    );
    out.extend_from_slice(data.payload);
}

/// Writes a packet that controls a connection. The time is in microseconds.
pub(crate) fn control(control: &Control, time: u32, to: u32) -> Vec<u8> {
    let mut out = Vec::with_capacity(HANDSHAKE_LEN);
    let mut header = |kind: u16, second: u32| {
        put(
            &mut out,
            [CONTROL | u32::from(kind) << 16, second, time, to],
        );
    };
    match control {
        Control::Handshake(it) => {
            header(HANDSHAKE, 0);
            let [a, b, c, d] = it.address;
            let contents = [
                it.version,
                it.kind,
                it.initial,
                it.max_packet,
                it.window,
                it.request.cast_unsigned(),
                it.socket,
                it.cookie,
                a,
                b,
                c,
                d,
            ];
            put(&mut out, contents);
        }
        Control::KeepAlive => {
            header(KEEP_ALIVE, 0);
            put(&mut out, [0]);
        }
        Control::Ack(ack) => {
            header(ACK, ack.number);
            put(&mut out, [ack.next]);
            if let Some(it) = ack.receiver {
                put(&mut out, [it.rtt, it.rtt_variance, it.window]);
                if let Some((arrivals, capacity)) = it.rates {
                    put(&mut out, [arrivals, capacity]);
                }
            }
        }
        Control::Loss(losses) => {
            header(LOSS, 0);
            for (first, last) in losses {
                match first == last {
                    true => put(&mut out, [*first]),
                    false => put(&mut out, [CONTROL | *first, *last]),
                }
            }
        }
        Control::Shutdown => {
            header(SHUTDOWN, 0);
            put(&mut out, [0]);
        }
        Control::Ack2(number) => {
            header(ACK2, *number);
            put(&mut out, [0]);
        }
        Control::Drop {
            message,
            first,
            last,
        } => {
            header(DROP, *message);
            put(&mut out, [*first, *last]);
        }
    }
    out
}

fn put<const N: usize>(out: &mut Vec<u8>, words: [u32; N]) {
    for word in words {
        out.extend_from_slice(&word.to_be_bytes());
    }
}

/// Returns an address as a handshake contains it: libudt writes the words of an address in the byte
/// order of its host, which is little-endian on every usual one.
pub(crate) fn address_words(address: SocketAddr) -> [u32; 4] {
    let word = |octets: &[u8; 4]| u32::from_le_bytes(*octets);
    match address.ip() {
        IpAddr::V4(v4) => [word(&v4.octets()), 0, 0, 0],
        IpAddr::V6(v6) => {
            let octets = v6.octets();
            let (words, _) = octets.as_chunks::<4>();
            let mut words = words.iter().map(word);
            std::array::from_fn(|_| words.next().unwrap_or(0))
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn wire() -> impl Strategy<Value = u32> {
        0..=sequence::LARGEST
    }

    prop_compose! {
        fn any_handshake()(
            words in any::<[u32; 7]>(), request in any::<i32>(), address in any::<[u32; 4]>(),
        ) -> Handshake {
            let [version, kind, initial, max_packet, window, socket, cookie] = words;
            Handshake { version, kind, initial, max_packet, window, request, socket, cookie, address }
        }
    }

    prop_compose! {
        fn any_ack()(
            number in any::<u32>(),
            next in wire(),
            state in prop::option::of((any::<[u32; 3]>(), any::<Option<(u32, u32)>>())),
        ) -> Ack {
            let receiver = state.map(|([rtt, rtt_variance, window], rates)| {
                ReceiverState { rtt, rtt_variance, window, rates }
            });
            Ack { number, next, receiver }
        }
    }

    fn any_control() -> impl Strategy<Value = Control> {
        prop_oneof![
            any_handshake().prop_map(Control::Handshake),
            Just(Control::KeepAlive),
            any_ack().prop_map(Control::Ack),
            prop::collection::vec((wire(), wire()), 1..300).prop_map(Control::Loss),
            Just(Control::Shutdown),
            any::<u32>().prop_map(Control::Ack2),
            (0..MESSAGES, wire(), wire()).prop_map(|(message, first, last)| Control::Drop {
                message,
                first,
                last
            }),
        ]
    }

    proptest! {
        #[test]
        fn control_packets_round_trip(packet in any_control(), time in any::<u32>(), to in any::<u32>()) {
            let bytes = control(&packet, time, to);
            prop_assert_eq!(Packet::read(&bytes), Some((to, Packet::Control(packet))));
        }

        #[test]
        fn data_packets_round_trip(
            sequence in wire(), bits in 0..4_u32, in_order in any::<bool>(), message in 0..MESSAGES,
            payload in prop::collection::vec(any::<u8>(), 0..1500), to in any::<u32>(),
        ) {
            let position = Position::from_bits(bits);
            let data = Data { sequence, position, in_order, message, payload: &payload };
            let mut bytes = Vec::new();
            put_data(&mut bytes, &data, 1, to);
            prop_assert_eq!(Packet::read(&bytes), Some((to, Packet::Data(data))));
        }

        #[test]
        fn any_bytes_are_read_without_harm(bytes in prop::collection::vec(any::<u8>(), 0..100)) {
            if let Some((to, Packet::Control(packet))) = Packet::read(&bytes) {
                // The same packet is written again, up to the bits that are ignored.
                let again = control(&packet, 0, to);
                prop_assert_eq!(Packet::read(&again), Some((to, Packet::Control(packet))));
            }
        }
    }

    /// The loss list of the draft's section 6.4.
    #[test]
    fn the_loss_list_of_the_draft_is_read_and_written() {
        let losses = vec![(2, 2), (6, 0xB), (0xE, 0xE)];
        let bytes = control(&Control::Loss(losses.clone()), 0, 7);
        let list = [0x0000_0002_u32, 0x8000_0006, 0x0000_000B, 0x0000_000E];
        let list: Vec<u8> = list.iter().flat_map(|word| word.to_be_bytes()).collect();
        assert_eq!(bytes[HEADER..], list);
        let read = Packet::read(&bytes);
        assert_eq!(read, Some((7, Packet::Control(Control::Loss(losses)))));
    }

    #[test]
    fn malformed_packets_are_not_read() {
        let header = |first: u32| {
            let mut bytes = Vec::new();
            put(&mut bytes, [first, 0, 0, 0]);
            bytes
        };
        assert_eq!(Packet::read(&header(0)[..HEADER - 1]), None);
        for (kind, words) in [
            // A handshake that is too short or too long.
            (HANDSHAKE, &[0; 11][..]),
            (HANDSHAKE, &[0; 13]),
            (ACK, &[]),
            // An empty list, and runs without an end.
            (LOSS, &[]),
            (LOSS, &[1, CONTROL | 2]),
            (LOSS, &[CONTROL | 2, CONTROL | 3]),
            (DROP, &[1]),
            (4, &[0]),
            (8, &[0]),
            (0x7fff, &[0]),
        ] {
            let mut bytes = header(CONTROL | u32::from(kind) << 16);
            for word in words {
                put(&mut bytes, [*word]);
            }
            assert_eq!(Packet::read(&bytes), None, "{kind} {words:?}");
        }
    }

    /// A handshake of libudt 4.11 to 10.99.0.2 has the address `02 00 63 0a`.
    #[test]
    fn addresses_are_written_as_libudt_does() {
        let words = address_words("10.99.0.2:7".parse().unwrap());
        assert_eq!(words.map(u32::to_be_bytes)[0], [0x02, 0x00, 0x63, 0x0a]);
        let words = address_words("[0102:0304::0f10]:7".parse().unwrap());
        assert_eq!(words, [0x0403_0201, 0, 0, 0x100f_0000]);
    }
}
