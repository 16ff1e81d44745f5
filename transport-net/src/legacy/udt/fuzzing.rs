//! An endpoint of the UDT transport for fuzz targets: takes packets of any peers, and checks the
//! invariants of the packets that it sends.

use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use bytes::Bytes;
use fipa_acl::Letter;
use fipa_transport::{AttemptId, Conclusion, Kind, Location};

use super::config::UdtLimits;
use super::core::{Core, CoreEvent};
use super::packet::{
    self, CONCLUSION, Control, DATAGRAMS, Data, HANDSHAKE_LEN, Handshake, MESSAGES, Packet,
    Position, REQUEST, VERSION,
};
use super::sequence;
use crate::datagrams::{DatagramCore, Path, fuzzing};

/// Maximum number of packets sent in response to one.
const MOST: usize = 100_000;

/// An endpoint with peers at a few addresses.
pub struct UdtPackets {
    core: Core,
    now: Instant,
    dispatched: u64,
    concluded: BTreeMap<AttemptId, Conclusion>,
    /// The last handshake sent to each address.
    handshakes: BTreeMap<SocketAddr, Handshake>,
    /// The last new packet to each address, and the last acknowledged one.
    sent: BTreeMap<SocketAddr, u32>,
    acked: BTreeMap<SocketAddr, u32>,
    /// Addresses that have returned a cookie, or that this side has sent to first.
    proved: BTreeSet<SocketAddr>,
}

impl std::fmt::Debug for UdtPackets {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("UdtPackets").finish_non_exhaustive()
    }
}

/// A packet as a peer writes it.
#[derive(Debug, Clone, Copy)]
pub enum UdtPacket<'a> {
    /// Raw bytes.
    Raw(&'a [u8]),
    /// The handshake of a client, and then the one that returns the cookie.
    Client {
        /// Its socket.
        socket: u32,
        /// Its first packet.
        initial: u32,
        /// The largest packet and the window.
        size: (u32, u32),
        /// Whether it returns the cookie.
        returns: bool,
    },
    /// An answer to a handshake of this side.
    Server {
        /// The code of the request.
        request: i32,
        /// Its socket.
        socket: u32,
        /// The largest packet and the window.
        size: (u32, u32),
    },
    /// A part of a letter.
    Data {
        /// Its distance from the first packet.
        offset: u32,
        /// Bits: the end and the beginning of a message.
        position: u8,
        /// The number of the message.
        message: u32,
        /// Its contents.
        payload: &'a [u8],
    },
    /// An acknowledgment of packets up to this distance from the last packet sent.
    Ack {
        /// The distance backward.
        back: u32,
        /// The window; a narrow acknowledgment has none.
        window: Option<u32>,
    },
    /// A loss report of packets between these distances from the last packet sent.
    Loss(&'a [(u32, u32)]),
    /// The confirmation of an acknowledgment.
    Ack2(u32),
    /// The notice that a message was given up, with distances from the first packet.
    Drop(u32, u32, u32),
    /// The end of the connection.
    Shutdown,
    /// Nothing but a sign of life.
    KeepAlive,
}

fn address(peer: u8) -> SocketAddr {
    fuzzing::address(peer, 7790)
}

fn path(peer: u8) -> Path {
    fuzzing::path(address(peer))
}

impl UdtPackets {
    /// An endpoint whose random numbers follow from the seed.
    #[must_use]
    pub fn new(seed: u64, now: Instant) -> Self {
        let limits = UdtLimits {
            max_letter: 200_000,
            max_connections: 8,
            max_per_address: 2,
            max_in_flight: 8,
            max_incoming: 10 << 20,
            max_incoming_per_source: 5 << 20,
            ..UdtLimits::default()
        };
        Self {
            core: Core::new(limits, Box::new(|_| true), fuzzing::random(seed), now),
            now,
            dispatched: 0,
            concluded: BTreeMap::new(),
            handshakes: BTreeMap::new(),
            sent: BTreeMap::new(),
            acked: BTreeMap::new(),
            proved: BTreeSet::new(),
        }
    }

    /// Handles a packet of this peer. Checks that an unproved address gets no more bytes than it has
    /// sent.
    pub fn arrive(&mut self, peer: u8, packet: UdtPacket<'_>, listening: bool) {
        let from = address(peer);
        let before = self.flush();
        assert!(!before.contains_key(&from) || self.proved.contains(&from));
        let Some(bytes) = self.written(from, packet) else {
            return;
        };
        let cookie = self.handshakes.get(&from).map(|it| it.cookie);
        if let Some((0, Packet::Control(Control::Handshake(it)))) = Packet::read(&bytes)
            && it.request == CONCLUSION
            && cookie == Some(it.cookie)
        {
            self.proved.insert(from);
        }
        self.core
            .handle_datagram(self.now, path(peer), listening, &bytes);
        for (to, len) in self.flush() {
            assert!(
                self.proved.contains(&to) || (to == from && len <= bytes.len()),
                "{len} bytes to {to} for {} of {from}",
                bytes.len()
            );
        }
    }

    /// Sends a letter of this length to this peer.
    pub fn send(&mut self, peer: u8, len: usize) {
        let Ok(to) = Location::new(Kind::Udt, &address(peer).to_string()) else {
            return;
        };
        let attempt = AttemptId(self.dispatched);
        let pieces = [Bytes::from(vec![1; len / 2 + 1]), Bytes::from(vec![2; len])];
        let [envelope, message] = pieces.clone();
        let letter = Letter::new(envelope, message);
        let dispatched = self.core.post(attempt, &to, "arm".into(), letter);
        if dispatched.is_err() {
            return;
        }
        self.dispatched += 1;
        self.proved.insert(address(peer));
        if self.core.begin_translation().is_some()
            && let Some(fresh) = self.core.handle_translated(self.now, Ok(pieces))
        {
            self.core.begin(self.now, fresh, vec![path(peer)]);
        }
        // Ends the task.
        assert!(self.core.begin_translation().is_none(), "one letter");
        self.flush();
    }

    /// Advances the time and handles the timers that are due.
    pub fn pass(&mut self, time: Duration) {
        let until = self.now + time;
        let mut steps = 0;
        while let Some(due) = self.core.poll_timeout().filter(|due| *due <= until) {
            steps += 1;
            assert!(steps < 1_000_000, "time stands still");
            self.now = due.max(self.now);
            self.core.handle_timeout(self.now);
            self.flush();
        }
        self.now = until;
    }

    /// Closes the endpoint and checks that every attempt has a conclusion.
    pub fn close(&mut self) {
        self.core.close(self.now);
        self.flush();
        for attempt in (0..self.dispatched).map(AttemptId) {
            assert!(self.concluded.contains_key(&attempt), "{attempt:?}");
        }
    }

    /// Returns the bytes of a packet; `None` if it needs a handshake that was not sent.
    fn written(&self, from: SocketAddr, packet: UdtPacket<'_>) -> Option<Vec<u8>> {
        let own = self.handshakes.get(&from).copied();
        let handshake = Handshake {
            version: VERSION,
            kind: DATAGRAMS,
            initial: 0,
            max_packet: 1500,
            window: 8192,
            request: REQUEST,
            socket: 1,
            cookie: 0,
            address: [0; 4],
        };
        let sent = self.sent.get(&from).copied().unwrap_or(0);
        let back = |back: u32| sent.wrapping_sub(back) & sequence::LARGEST;
        let ahead = |offset: u32| {
            let initial = own.map_or(0, |own| own.initial);
            initial.wrapping_add(offset) & sequence::LARGEST
        };
        let control = match packet {
            UdtPacket::Raw(bytes) => return Some(bytes.to_vec()),
            UdtPacket::Client {
                socket,
                initial,
                size: (max_packet, window),
                returns,
            } => {
                let client = Handshake {
                    initial,
                    max_packet,
                    window,
                    socket,
                    request: if returns { CONCLUSION } else { REQUEST },
                    cookie: own.map_or(0, |own| own.cookie),
                    ..handshake
                };
                return Some(packet::control(&Control::Handshake(client), 0, 0));
            }
            UdtPacket::Server {
                request,
                socket,
                size: (max_packet, window),
            } => Control::Handshake(Handshake {
                request,
                socket,
                max_packet,
                window,
                initial: own?.initial,
                cookie: 77,
                ..handshake
            }),
            UdtPacket::Data {
                offset,
                position,
                message,
                payload,
            } => {
                let data = Data {
                    sequence: ahead(offset),
                    position: Position::of(position & 2 != 0, position & 1 != 0),
                    in_order: true,
                    message: message % MESSAGES,
                    payload,
                };
                let mut bytes = Vec::new();
                packet::put_data(&mut bytes, &data, 0, own?.socket);
                return Some(bytes);
            }
            UdtPacket::Ack {
                back: behind,
                window,
            } => Control::Ack(packet::Ack {
                number: behind,
                next: back(behind),
                receiver: window.map(|window| packet::ReceiverState {
                    rtt: behind.wrapping_mul(1000),
                    rtt_variance: 10,
                    window,
                    rates: (window % 2 == 1).then_some((window, behind)),
                }),
            }),
            UdtPacket::Loss(runs) => {
                let runs = runs.iter().map(|(first, last)| (back(*first), back(*last)));
                Control::Loss(runs.collect())
            }
            UdtPacket::Ack2(number) => Control::Ack2(number),
            UdtPacket::Drop(message, first, last) => Control::Drop {
                message: message % MESSAGES,
                first: ahead(first),
                last: ahead(last),
            },
            UdtPacket::Shutdown => Control::Shutdown,
            UdtPacket::KeepAlive => Control::KeepAlive,
        };
        Some(packet::control(&control, 0, own?.socket))
    }

    /// Takes the packets to send. Returns the number of bytes sent to each address.
    fn flush(&mut self) -> BTreeMap<SocketAddr, usize> {
        let mut bytes = BTreeMap::new();
        let mut count = 0;
        loop {
            while let Some(event) = self.core.poll_event() {
                match event {
                    CoreEvent::Arrived(arrived, _) => {
                        assert!(
                            (1..=200_000).contains(&arrived.bytes.len())
                                || arrived.bytes.is_empty()
                        );
                    }
                    CoreEvent::TooLarge(beginning, _) => assert!(beginning.len() <= 200_000),
                    CoreEvent::Concluded(attempt, conclusion) => {
                        assert!(attempt.0 < self.dispatched);
                        let twice = self.concluded.insert(attempt, conclusion);
                        assert_eq!(twice, None, "{attempt:?} is concluded twice");
                    }
                }
            }
            let Some(transmit) = self.core.poll_transmit(self.now) else {
                if self.core.has_events() {
                    continue;
                }
                return bytes;
            };
            let to = transmit.path.remote;
            let segment = transmit.segment.unwrap_or(transmit.contents.len());
            for packet in transmit.contents.chunks(segment) {
                count += 1;
                assert!(count < MOST, "one packet makes this side send without end");
                assert!(packet.len() <= 1472);
                match Packet::read(packet) {
                    Some((_, Packet::Control(Control::Handshake(handshake)))) => {
                        assert_eq!(packet.len(), HANDSHAKE_LEN);
                        self.handshakes.insert(to, handshake);
                        if handshake.request == REQUEST && handshake.cookie == 0 {
                            self.sent.insert(to, handshake.initial);
                        }
                    }
                    Some((_, Packet::Data(data))) => {
                        self.sent.insert(to, data.sequence);
                    }
                    Some((_, Packet::Control(Control::Ack(ack)))) => {
                        self.acked.insert(to, ack.next);
                    }
                    Some((_, Packet::Control(_))) => {}
                    None => panic!("what leaves is no packet of this protocol"),
                }
                *bytes.entry(to).or_default() += packet.len();
            }
        }
    }
}
