//! The handshake: an unproved peer gets a cookie, and a peer that returns the cookie gets a
//! connection.

use std::net::{IpAddr, SocketAddr};
use std::time::{Duration, Instant};

use fipa_transport::{Hop, Kind, Location, Principal, log_limit, quota_address};

use super::super::connection::Connection;
use super::super::packet::{self, NO_COOKIE};
use super::{Core, Inbound, MAX_OUTBOX};
use crate::address;
use crate::datagrams::Path;
use crate::end::ConnectionEnd;
use crate::hello::{Hello, Load};

/// Time in which a connected service must respond to a ping when an unproved peer claims to be that
/// service.
const RESPONSE_TIMEOUT: Duration = Duration::from_secs(1);

/// Time for which such a ping and its response are valid. It is longer than [`RESPONSE_TIMEOUT`] and
/// the longest pause between two hellos.
const PING_VALIDITY: Duration = Duration::from_secs(3);

/// The result of checking a claimed incarnation.
enum ClaimStatus {
    /// No other connection has it.
    Free,
    /// A ping was sent on the other connection.
    Asked,
    /// The other connection, at this address, responded.
    Taken { by: Option<IpAddr> },
}

impl Core {
    /// Handles the hello of an unproved peer.
    pub(super) fn handle_hello(
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
            if let Some(entry) = self.connections.get(*number) {
                let id = entry.connection.id();
                let own = self.own_hello(0, String::new());
                self.reply(path, packet::welcome(initiator, id, &own));
            }
            return;
        }
        // A peer that claims to be this service itself would make it send letters to itself.
        let own = self.identity.incarnation;
        let is_fit = |it: &Hello| it.max_in_flight > 0 && it.identity.incarnation != own;
        let Some(peer) = Hello::decode(hello).filter(is_fit) else {
            self.counters.ignored += 1;
            return;
        };
        let inbound = Inbound {
            incarnation: peer.identity.incarnation,
            ip: from.ip(),
            dialed: peer.dialed.clone(),
        };
        let before = self.inbound.get(&inbound);
        if before.is_some_and(|(serial, _)| *serial > peer.serial) {
            self.counters.ignored += 1;
            return;
        }
        match self.claim_status(now, &inbound) {
            ClaimStatus::Free => {}
            // The peer repeats its hello because it gets no reply.
            ClaimStatus::Asked => return,
            ClaimStatus::Taken { by } if by == Some(from.ip()) => {
                self.counters.refused_again += 1;
                tracing::debug!(
                    "{from}: another connection of a connected service was refused, because the first one is alive"
                );
                self.reply(path, packet::refused(initiator));
                return;
            }
            ClaimStatus::Taken { .. } => {
                log_limit::warn!(
                    of: quota_address(from.ip()),
                    "{from}: connection refused: it claims the incarnation of a connected service whose connection is alive"
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
        self.connections.touch(number);
    }

    /// Checks whether the service with this incarnation may be the peer of a new connection. An
    /// unproved peer must not end the connections of the service that it claims to be: these get a
    /// ping, and end if there is no response within [`RESPONSE_TIMEOUT`]. No state about the unproved
    /// peer is stored.
    fn claim_status(&mut self, now: Instant, inbound: &Inbound) -> ClaimStatus {
        let mut status = ClaimStatus::Free;
        for number in self.conflicting(inbound) {
            let Some(other) = self.connections.get_mut(number) else {
                continue;
            };
            let asked = other.asked.filter(|asked| now < *asked + PING_VALIDITY);
            match asked {
                None => {
                    other.asked = Some(now);
                    other.connection.ask();
                    self.connections.touch(number);
                }
                Some(asked) if other.connection.received_since(asked) => {
                    let by = other.connection.path().map(|path| path.remote.ip());
                    return ClaimStatus::Taken { by };
                }
                Some(asked) if now >= asked + RESPONSE_TIMEOUT => {
                    // Letters that the peer sent on the previous connection must not arrive after
                    // letters on this one.
                    self.end(number, &ConnectionEnd::Superseded);
                    continue;
                }
                Some(_) => {}
            }
            status = ClaimStatus::Asked;
        }
        status
    }

    /// Returns the connections that end if this one is accepted: the earlier one for the same
    /// location, and those at other addresses, unless their peers list this address as their own.
    fn conflicting(&self, inbound: &Inbound) -> Vec<u32> {
        let same = self.inbound.get(inbound).map(|(_, number)| *number);
        let known = self.known.get(&inbound.incarnation);
        let conflicts = |number: &u32| {
            let Some(entry) = self.connections.get(*number) else {
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
        known.filter(conflicts).collect()
    }

    /// Handles the welcome that answers the hello of a connection.
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
        self.of_dialing(to, path, |number, connection| {
            if peer.identity.incarnation == own {
                return Err(ConnectionEnd::Itself);
            }
            let name = peer.identity.name.as_str().into();
            connection.welcomed(path, acceptor, peer, now)?;
            connection.rate_limit = rate_limit;
            connection.meter = Some(meter);
            greeted = Some((number, name));
            Ok(())
        });
        if let (Some((number, name)), Some(hop)) = (greeted, hop) {
            self.counters.dialed += 1;
            self.enter(now, number, name, hop);
        }
    }

    /// Handles a datagram that reports a connection as unknown.
    pub(super) fn is_unknown(&mut self, path: Path, peer_id: u64) {
        let is_meant = |connection: &Connection| {
            connection.peer().is_some()
                && connection.peer_id() == peer_id
                && connection.path().is_some_and(|p| p.remote == path.remote)
        };
        let meant = self.connections.iter();
        let meant = meant
            .filter(|(_, entry)| is_meant(&entry.connection))
            .map(|(number, _)| number)
            .next();
        match meant {
            Some(number) => {
                let what =
                    "the peer no longer has this connection, probably because it was restarted";
                self.end(number, &ConnectionEnd::Broken(what.into()));
            }
            None => self.counters.ignored += 1,
        }
    }

    /// Calls `act` with the connection that is being opened over this path.
    pub(super) fn of_dialing(
        &mut self,
        to: u64,
        path: Path,
        act: impl FnOnce(u32, &mut Connection) -> Result<(), ConnectionEnd>,
    ) {
        let number = self.ids.get(&to).copied();
        let entry = number.and_then(|number| self.connections.get_mut(number));
        let meant = entry
            .and_then(|entry| entry.connection.dialing_mut())
            .is_some_and(|dialing| dialing.uses(path));
        match number.filter(|_| meant) {
            Some(number) => self.with(number, |connection, _| act(number, connection)),
            None => self.counters.ignored += 1,
        }
    }

    pub(super) fn hop(&self, peer: &Hello, from: SocketAddr) -> Option<Hop> {
        let back = address::return_address(&peer.listening, from).to_string();
        let location = Location::new(Kind::Udp, &back).ok()?;
        Some(Hop {
            location: location.with_incarnation(peer.identity.incarnation),
            principal: Principal::Unproved,
        })
    }

    pub(in crate::udp) fn own_hello(&self, serial: u64, dialed: String) -> Hello {
        Hello {
            identity: self.identity.clone(),
            max_letter: self.limits.max_datagram as u64,
            max_in_flight: u32::try_from(self.limits.max_in_flight.max(1)).unwrap_or(u32::MAX),
            serial,
            dialed,
            listening: self.listening.clone(),
            load: Load::Any,
        }
    }

    pub(super) fn reply(&mut self, path: Path, datagram: Vec<u8>) {
        if self.outbox.len() < MAX_OUTBOX {
            self.outbox.push_back((path, datagram));
        }
    }
}
