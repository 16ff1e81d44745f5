//! An endpoint of the UDP transport for fuzz targets: takes datagrams of any peers, and checks the
//! invariants of the datagrams that it sends.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use fipa_transport::{Answer, AttemptId, Conclusion, Incarnation, Kind, Location, Parcel, Ticket};

use super::config::UdpLimits;
use super::core::{Core, CoreEvent};
use super::packet::{self, Datagram, NO_COOKIE};
use crate::Identity;
use crate::datagrams::{DatagramCore, Path, fuzzing};
use crate::hello::{Hello, Load};

/// Maximum number of datagrams sent in response to one.
const MOST: usize = 4096;

/// An endpoint with peers at a few addresses.
pub struct Datagrams {
    core: Core,
    dispatched: u64,
    concluded: BTreeMap<AttemptId, Conclusion>,
    tickets: Vec<Ticket>,
    /// The last cookie sent to each address, with the number of the connection.
    cookies: BTreeMap<SocketAddr, packet::Cookie>,
    numbers: BTreeMap<SocketAddr, u64>,
    /// Addresses that have returned a cookie, or that this side has sent to first.
    proved: BTreeSet<SocketAddr>,
}

impl fmt::Debug for Datagrams {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Datagrams")
            .field("dispatched", &self.dispatched)
            .field("concluded", &self.concluded)
            .finish_non_exhaustive()
    }
}

/// A datagram as a peer writes it.
#[derive(Debug, Clone, Copy)]
pub enum Written<'a> {
    /// Raw bytes.
    Raw(&'a [u8]),
    /// A hello of this service, with the last cookie of its address or without one.
    Hello {
        /// Its number of the connection.
        initiator: u64,
        /// Whether it returns the cookie.
        cookie: bool,
        /// Its incarnation and the number of its connection.
        service: (u64, u64),
    },
    /// The answers to a hello of this side: a cookie, a welcome, or a refusal.
    Cookie,
    /// See [`Written::Cookie`].
    Welcome {
        /// The incarnation of the service that answers.
        service: u64,
    },
    /// See [`Written::Cookie`].
    Refused,
    /// The connection is not known.
    Unknown(u64),
    /// A packet of the connection with this address, or of any other.
    Data {
        /// Whether it is for that connection.
        known: bool,
        /// Number of the packet.
        number: u64,
        /// Its frames.
        frames: &'a [u8],
    },
}

fn address(peer: u8) -> SocketAddr {
    fuzzing::address(peer, 7788)
}

fn path(peer: u8) -> Path {
    fuzzing::path(address(peer))
}

fn hello(service: u64, serial: u64) -> Hello {
    Hello {
        identity: Identity {
            name: "peer".into(),
            incarnation: Incarnation::from_u64(service),
            domain: "default".into(),
            host: "there".into(),
        },
        max_letter: 60_000,
        max_in_flight: 100,
        serial,
        dialed: "0123456789abcdef".into(),
        listening: vec![address(0).to_string()],
        load: Load::Any,
    }
}

impl Datagrams {
    /// An endpoint whose random numbers follow from the seed.
    #[must_use]
    pub fn new(seed: u64, now: Instant) -> Self {
        let identity = hello(1, 0).identity;
        let limits = UdpLimits {
            max_connections: 8,
            max_in_flight: 8,
            max_incoming: 200_000,
            max_incoming_per_source: 100_000,
            ..UdpLimits::default()
        };
        let listening = vec!["192.0.2.1:7788".to_owned()];
        Self {
            core: Core::new(identity, limits, listening, fuzzing::random(seed), now),
            dispatched: 0,
            concluded: BTreeMap::new(),
            tickets: Vec::new(),
            cookies: BTreeMap::new(),
            numbers: BTreeMap::new(),
            proved: BTreeSet::new(),
        }
    }

    /// Handles a datagram of this peer. Checks that an unproved address gets fewer bytes than it
    /// has sent.
    pub fn arrive(&mut self, peer: u8, written: Written<'_>, listening: bool, now: Instant) {
        let from = address(peer);
        let cookie = self.cookies.get(&from).copied();
        let number = self.numbers.get(&from).copied().unwrap_or(1);
        let bytes = match written {
            Written::Raw(bytes) => bytes.to_vec(),
            Written::Hello {
                initiator,
                cookie: brings,
                service: (service, serial),
            } => {
                let cookie = cookie.filter(|_| brings).unwrap_or(NO_COOKIE);
                packet::hello(initiator, &cookie, &hello(service, serial))
            }
            Written::Cookie => packet::cookie_for(number, &[7; 16]),
            Written::Welcome { service } => packet::welcome(number, 5, &hello(service, 0)),
            Written::Refused => packet::refused(number),
            Written::Unknown(number) => packet::unknown(number),
            Written::Data {
                known,
                number: packet,
                frames,
            } => {
                let mut bytes = Vec::new();
                packet::put_data(&mut bytes, if known { number } else { packet }, packet);
                bytes.extend_from_slice(frames);
                bytes
            }
        };
        let before = self.flush(now);
        assert!(before.is_empty() || !before.contains_key(&from) || self.proved.contains(&from));
        self.core
            .handle_datagram(now, path(peer), listening, &bytes);
        for (to, len) in self.flush(now) {
            assert!(
                self.proved.contains(&to) || (to == from && len <= bytes.len()),
                "{len} bytes to {to} for {} of {from}",
                bytes.len()
            );
        }
    }

    /// Sends a parcel to this peer.
    pub fn send(&mut self, peer: u8, service: u64, parcel: &Parcel, now: Instant) {
        let Ok(to) = Location::new(Kind::Udp, &address(peer).to_string()) else {
            return;
        };
        let to = to.with_incarnation(Incarnation::from_u64(service));
        let attempt = AttemptId(self.dispatched);
        let Ok(fresh) = self.core.post(now, attempt, &to, parcel) else {
            return;
        };
        self.dispatched += 1;
        self.proved.insert(address(peer));
        if let Some(fresh) = fresh {
            self.core.begin(now, fresh, vec![path(peer)]);
        }
        self.flush(now);
    }

    /// Answers one of the parcels that arrived.
    pub fn answer(&mut self, pick: usize, answer: &Answer, now: Instant) {
        if !self.tickets.is_empty() {
            let ticket = self.tickets.swap_remove(pick % self.tickets.len());
            self.core.answer(now, ticket, answer);
            self.flush(now);
        }
    }

    /// Advances the time and handles the timers that are due.
    pub fn pass(&mut self, now: &mut Instant, time: Duration) {
        let until = *now + time;
        let mut steps = 0;
        while let Some(due) = self.core.poll_timeout().filter(|due| *due <= until) {
            steps += 1;
            assert!(steps < 100_000, "time stands still");
            *now = due.max(*now);
            self.core.handle_timeout(*now);
            self.flush(*now);
        }
        *now = until;
    }

    /// Closes the endpoint and checks that every attempt has a conclusion.
    pub fn close(&mut self, now: Instant) {
        self.core.close();
        self.flush(now);
        for attempt in (0..self.dispatched).map(AttemptId) {
            assert!(self.concluded.contains_key(&attempt), "{attempt:?}");
        }
    }

    /// Takes the datagrams to send. Returns the number of bytes sent to each address.
    fn flush(&mut self, now: Instant) -> BTreeMap<SocketAddr, usize> {
        let mut bytes = BTreeMap::new();
        let mut count = 0;
        loop {
            while let Some(event) = self.core.poll_event() {
                match event {
                    CoreEvent::Arrived { ticket, .. } => self.tickets.push(ticket),
                    CoreEvent::Concluded(attempt, conclusion) => {
                        assert!(attempt.0 < self.dispatched);
                        let twice = self.concluded.insert(attempt, conclusion);
                        assert_eq!(twice, None, "{attempt:?} is concluded twice");
                    }
                    CoreEvent::Introduced(peer) => {
                        let service = peer.hop.location.incarnation();
                        assert_ne!(
                            service,
                            Incarnation::from_u64(1),
                            "it is this service itself"
                        );
                    }
                    CoreEvent::Disconnected(_) => {}
                }
            }
            let Some(transmit) = self.core.poll_transmit(now) else {
                if self.core.has_events() {
                    continue;
                }
                return bytes;
            };
            count += 1;
            assert!(
                count < MOST,
                "one datagram makes this side send without end"
            );
            let to = transmit.path.remote;
            match Datagram::read(&transmit.contents) {
                Some(Datagram::Cookie { cookie, .. }) => drop(self.cookies.insert(to, cookie)),
                Some(Datagram::Welcome { acceptor, .. }) => {
                    self.proved.insert(to);
                    self.numbers.insert(to, acceptor);
                    // A welcome is no larger than the hello that it answers.
                    assert!(transmit.contents.len() <= packet::BASE);
                    continue;
                }
                Some(Datagram::Hello { initiator, .. }) => drop(self.numbers.insert(to, initiator)),
                Some(_) => {}
                None => panic!("what leaves is no datagram of this protocol"),
            }
            *bytes.entry(to).or_default() += transmit.contents.len();
        }
    }
}
