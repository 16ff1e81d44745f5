//! What the owner of a UDP endpoint chooses.

use std::net::IpAddr;
use std::time::Duration;

use super::packet::{BASE, LARGEST};
use crate::Identity;
use crate::rate_limit::{Rates, is_one_peer};
use crate::stream::budget::BudgetLimits;

/// Configuration of a [`UdpTransport`](crate::UdpTransport).
#[derive(Debug, Clone)]
pub struct UdpConfig {
    /// Numeric addresses to listen on, for example `127.0.0.1:0`, `[::1]:7788`, `0.0.0.0:7788` or
    /// `[fe80::1%eth0]:7788`. Port 0 lets the system choose. `[::]` is IPv6 only: list `0.0.0.0`
    /// beside it for both. May be empty: then letters can be sent, and peers can answer over the
    /// connections made for that.
    pub listen: Vec<String>,
    /// How this endpoint introduces itself.
    pub identity: Identity,
    /// What it takes and how long it waits.
    pub limits: UdpLimits,
}

/// Bounds of a UDP endpoint. Memory is at most about `max_incoming` for what arrives, and
/// `max_connections` × `max_queued_bytes` for what is sent.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UdpLimits {
    /// Largest datagram sent, in bytes without the headers of IP and UDP: [`UdpLimits::BASE`] to
    /// [`UdpLimits::LARGEST`]. What the path to a peer carries counts as well; it begins as
    /// `BASE` and is found out when a letter needs more. Default `LARGEST`.
    pub max_datagram: usize,
    /// Maximum number of connections. Default 256. The peers at one address (with IPv6, in one network
    /// of 64 bits), and those at all loopback addresses together, open at most half of them.
    pub max_connections: usize,
    /// Maximum number of connections that the peers at one address open. Default 64. This and the next
    /// two are not for loopback addresses.
    pub max_per_address: usize,
    /// Letters a second that are taken from one address, as many of which may come at once; what is
    /// more is taken when the peer sends it again. 0: any number. Default 20,000.
    pub peer_letters: u64,
    /// The same of bytes. Default 256 MiB.
    pub peer_bytes: u64,
    /// Most parcels per connection and direction that are not answered yet. Default 1024.
    pub max_in_flight: usize,
    /// Most bytes per connection and direction that wait to be sent, or for an earlier parcel that
    /// was lost; a single letter is always let in. Default 4 MiB.
    pub max_queued_bytes: usize,
    /// Maximum number of bytes of parcels that wait for an earlier one, on all connections together;
    /// a parcel for which there is no room is taken when the peer sends it again. Default 64 MiB.
    pub max_incoming: usize,
    /// The same for one source: one address (with IPv6, one network of 64 bits), and with twice as much
    /// all loopback addresses together. Default 16 MiB.
    pub max_incoming_per_source: usize,
    /// How long opening a connection may take. Default 2 s.
    pub connect_timeout: Duration,
    /// After this long without a packet from a peer that has something to acknowledge or to
    /// answer, and several attempts to reach it, the connection is given up. Default 2 s.
    pub silence: Duration,
    /// After this long without a letter or an answer a connection is closed. Default 60 s.
    pub idle_close: Duration,
}

impl UdpLimits {
    /// What every path carries: 1,200 bytes.
    pub const BASE: usize = BASE;
    /// Largest datagram there is: 65,487 bytes.
    pub const LARGEST: usize = LARGEST;

    /// How many connections the peers at this address may open. No address, and not all of loopback
    /// together, has more than half of all places.
    pub(super) fn max_connections_of(&self, home: IpAddr) -> usize {
        let half = (self.max_connections / 2).max(1);
        match is_one_peer(home) {
            true => self.max_per_address.min(half),
            false => half,
        }
    }

    /// How many bytes of the peers at this address may wait for earlier ones, and of all.
    pub(super) fn budget_of(&self, home: IpAddr) -> BudgetLimits {
        let each = self.max_incoming_per_source;
        BudgetLimits {
            total: self.max_incoming,
            each: match is_one_peer(home) {
                true => each,
                false => each.saturating_mul(2),
            },
        }
    }

    pub(super) fn rates(&self) -> Rates {
        Rates {
            letters: self.peer_letters,
            bytes: self.peer_bytes,
        }
    }
}

impl Default for UdpLimits {
    fn default() -> Self {
        Self {
            max_datagram: LARGEST,
            max_connections: 256,
            max_per_address: 64,
            peer_letters: 20_000,
            peer_bytes: 256 << 20,
            max_in_flight: 1024,
            max_queued_bytes: 4 << 20,
            max_incoming: 64 << 20,
            max_incoming_per_source: 16 << 20,
            connect_timeout: Duration::from_secs(2),
            silence: Duration::from_secs(2),
            idle_close: Duration::from_secs(60),
        }
    }
}
