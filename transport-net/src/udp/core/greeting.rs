//! How connections begin: strangers are given cookies, and those who bring one back a connection.

use std::net::SocketAddr;
use std::time::{Duration, Instant};

use fipa_transport::{Hop, Kind, Location, Principal};

use super::super::connection::{Connection, Path};
use super::super::packet::{self, NO_COOKIE};
use super::{Core, Inbound, MAX_OUTBOX};
use crate::address;
use crate::end::ConnectionEnd;
use crate::hello::{Hello, OWN_INCARNATION};
use crate::log_limit::warn_limited;
use crate::rate_limit::quota_address;

/// How long a connected service has to give a sign of life when a stranger says that it is the service.
const SIGN_OF_LIFE: Duration = Duration::from_secs(1);

/// For how long such a question and its answer count. Longer than [`SIGN_OF_LIFE`] and the longest pause
/// between two hellos.
const ASKED_FOR: Duration = Duration::from_secs(3);

/// Whether a new connection of a service that may be connected begins.
enum Standing {
    /// It begins.
    Free,
    /// The connected service has been asked for a sign of life.
    Asked,
    /// The connected service has given one.
    Taken,
}

impl Core {
    /// A stranger says hello.
    pub(super) fn greet(
        &mut self,
        now: Instant,
        path: Path,
        initiator: u64,
        cookie: &packet::Cookie,
        hello: &[u8],
    ) {
        let from = path.remote;
        if *cookie == NO_COOKIE || !self.cookies.check(now, from, initiator, cookie) {
            let cookie = self.cookies.give(now, from, initiator);
            self.reply(path, packet::cookie_for(initiator, &cookie));
            return;
        }
        if let Some(number) = self.greeted.get(&(from, initiator)) {
            // The welcome was lost.
            if let Some(entry) = self.connections.get(number) {
                let id = entry.connection.id();
                let own = self.own_hello(0, String::new());
                self.reply(path, packet::welcome(initiator, id, &own));
            }
            return;
        }
        // One that says that it is this service itself would make it write to itself.
        let own = self.identity.incarnation;
        let is_fit = |it: &Hello| it.max_in_flight > 0 && it.identity.incarnation != own;
        let Some(peer) = Hello::decode(hello).filter(is_fit) else {
            self.counters.ignored += 1;
            return;
        };
        let inbound = Inbound {
            incarnation: peer.identity.incarnation,
            ip: from.ip(),
            dialled: peer.dialled.clone(),
        };
        let before = self.inbound.get(&inbound);
        if before.is_some_and(|(serial, _)| *serial > peer.serial) {
            self.counters.ignored += 1;
            return;
        }
        match self.standing(now, &inbound) {
            Standing::Free => {}
            // The peer sends its hello again, because it gets no answer.
            Standing::Asked => return,
            Standing::Taken => {
                let before = self.counters.refused_unproved;
                warn_limited(
                    before,
                    format_args!(
                        "{from}: connection refused: its incarnation has a connection that is alive"
                    ),
                );
                self.counters.refused_unproved += 1;
                self.reply(path, packet::refused(initiator));
                return;
            }
        }
        let home = quota_address(from.ip());
        let same_address = self
            .greeted
            .keys()
            .filter(|(a, _)| quota_address(a.ip()) == home);
        let greedy = same_address.count() >= self.limits.max_connections_of(home);
        if greedy || self.connections.len() >= self.limits.max_connections {
            self.counters.refused_crowd += 1;
            self.reply(path, packet::refused(initiator));
            return;
        }
        let Some(hop) = self.hop(&peer, from) else {
            self.counters.ignored += 1;
            return;
        };
        let id = self.fresh_id();
        let serial = peer.serial;
        let name = peer.identity.name.as_str().into();
        let limits = self.limits.clone();
        let connection = Connection::accepted(limits, id, initiator, peer, path, now)
            .bounded(self.rate_limit(from.ip(), now), self.meter(from.ip()));
        let number = self.insert(connection, None, Some((from, initiator)));
        self.greeted.insert((from, initiator), number);
        self.inbound.insert(inbound, (serial, number));
        self.enter(now, number, name, hop);
        self.counters.accepted += 1;
        let own = self.own_hello(0, String::new());
        self.reply(path, packet::welcome(initiator, id, &own));
        self.touch(number);
    }

    /// Whether the service with this incarnation may be the peer of a new connection. A stranger must
    /// not end the connections of the service that it claims to be: these are asked for a sign of life,
    /// and end if there is none within [`SIGN_OF_LIFE`]. Nothing is remembered of the stranger.
    fn standing(&mut self, now: Instant, inbound: &Inbound) -> Standing {
        let mut standing = Standing::Free;
        for number in self.rivals(inbound) {
            let Some(rival) = self.connections.get_mut(&number) else {
                continue;
            };
            let asked = rival.asked.filter(|asked| now < *asked + ASKED_FOR);
            match asked {
                None => {
                    rival.asked = Some(now);
                    rival.connection.ask();
                    self.touch(number);
                }
                Some(asked) if rival.connection.is_heard_since(asked) => return Standing::Taken,
                Some(asked) if now >= asked + SIGN_OF_LIFE => {
                    // What the peer sent on its connection before this one must not arrive after what
                    // it sends now.
                    self.end(number, &ConnectionEnd::Superseded);
                    continue;
                }
                Some(_) => {}
            }
            standing = Standing::Asked;
        }
        standing
    }

    /// The connections that end if this one begins: the earlier one for the same location, and those at
    /// other addresses than this, unless their peers list this one as their own.
    fn rivals(&self, inbound: &Inbound) -> Vec<u32> {
        let same = self.inbound.get(inbound).map(|(_, number)| *number);
        let known = self.known.get(&inbound.incarnation);
        let is_rival = |number: &u32| {
            let Some(entry) = self.connections.get(number) else {
                return false;
            };
            let there = entry.connection.path().map(|path| path.remote.ip());
            if there == Some(inbound.ip) {
                return same == Some(*number);
            }
            let peer = entry.connection.peer();
            !peer.is_some_and(|peer| address::lists(&peer.listening, inbound.ip))
        };
        let known = known.into_iter().flatten().copied();
        known.filter(is_rival).collect()
    }

    /// A peer has answered the hello of a connection.
    pub(super) fn welcome(
        &mut self,
        now: Instant,
        path: Path,
        to: u64,
        acceptor: u64,
        hello: &[u8],
    ) {
        let Some(peer) = Hello::decode(hello) else {
            self.counters.ignored += 1;
            return;
        };
        let hop = self.hop(&peer, path.remote);
        let rate_limit = self.rate_limit(path.remote.ip(), now);
        let meter = self.meter(path.remote.ip());
        let (own, mut greeted) = (self.identity.incarnation, None);
        self.of_dialling(to, path, |number, connection| {
            if peer.identity.incarnation == own {
                return Err(ConnectionEnd::ProtocolViolation(OWN_INCARNATION.into()));
            }
            let name = peer.identity.name.as_str().into();
            connection.welcomed(path, acceptor, peer, now)?;
            connection.rate_limit = rate_limit;
            connection.meter = Some(meter);
            greeted = Some((number, name));
            Ok(())
        });
        if let (Some((number, name)), Some(hop)) = (greeted, hop) {
            self.counters.dialled += 1;
            self.enter(now, number, name, hop);
        }
    }

    /// Somebody knows nothing of a connection.
    pub(super) fn is_unknown(&mut self, path: Path, peer_id: u64) {
        let is_meant = |connection: &Connection| {
            connection.peer().is_some()
                && connection.peer_id() == peer_id
                && connection.path().is_some_and(|p| p.remote == path.remote)
        };
        let meant = self.connections.iter();
        let meant = meant
            .filter(|(_, entry)| is_meant(&entry.connection))
            .map(|(number, _)| *number)
            .next();
        match meant {
            Some(number) => {
                let what = "the peer has forgotten the connection; was it restarted?";
                self.end(number, &ConnectionEnd::Broken(what.into()));
            }
            None => self.counters.ignored += 1,
        }
    }

    /// Lets a connection that is being opened have what came for it.
    pub(super) fn of_dialling(
        &mut self,
        to: u64,
        path: Path,
        act: impl FnOnce(u32, &mut Connection) -> Result<(), ConnectionEnd>,
    ) {
        let number = self.ids.get(&to).copied();
        let entry = number.and_then(|number| self.connections.get_mut(&number));
        let meant = entry
            .and_then(|entry| entry.connection.dialling_mut())
            .is_some_and(|dialling| dialling.uses(path));
        match number.filter(|_| meant) {
            Some(number) => self.with(number, |connection, _| act(number, connection)),
            None => self.counters.ignored += 1,
        }
    }

    pub(super) fn hop(&self, peer: &Hello, from: SocketAddr) -> Option<Hop> {
        let back = address::way_back(&peer.listening, from).to_string();
        let location = Location::new(Kind::Udp, &back).ok()?;
        Some(Hop {
            location: location.with_incarnation(peer.identity.incarnation),
            principal: Principal::Unproved,
        })
    }

    pub(in crate::udp) fn own_hello(&self, serial: u64, dialled: String) -> Hello {
        Hello {
            identity: self.identity.clone(),
            max_letter: self.limits.max_datagram as u64,
            max_in_flight: u32::try_from(self.limits.max_in_flight.max(1)).unwrap_or(u32::MAX),
            serial,
            dialled,
            listening: self.listening.clone(),
        }
    }

    pub(super) fn reply(&mut self, path: Path, datagram: Vec<u8>) {
        if self.outbox.len() < MAX_OUTBOX {
            self.outbox.push_back((path, datagram));
        }
    }
}
