//! Configuration of a UDP endpoint.

use std::net::IpAddr;
use std::time::Duration;

use super::packet::{BASE, LARGEST};
use crate::Identity;
use crate::datagrams::shares;
use crate::rate_limit::Rates;
use crate::stream::budget::BudgetLimits;

/// Configuration of a [`UdpTransport`](crate::UdpTransport).
#[derive(Debug, Clone)]
pub struct UdpConfig {
    /// Numeric addresses to listen on, for example `127.0.0.1:0`, `[::1]:7788`, `0.0.0.0:7788` or
    /// `[fe80::1%eth0]:7788`. `*:7788` means all addresses of this host, `0.0.0.0` and `[::]`
    /// those of one family. Port 0 lets the system choose. May be empty: letters can still be sent, and peers can answer over the
    /// connections that this side opens.
    pub listen: Vec<String>,
    /// Identity of this endpoint.
    pub identity: Identity,
    /// NetLimits and timeouts.
    pub limits: UdpLimits,
}

/// NetLimits of a UDP endpoint. Memory is bounded by about `max_incoming` for arriving parcels, and
/// `max_connections` × `max_queued_bytes` for parcels to send.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UdpLimits {
    /// Largest datagram sent, in bytes without the headers of IP and UDP: [`UdpLimits::BASE`] to
    /// [`UdpLimits::LARGEST`]. The MTU of the path to a peer is a further limit; it is assumed to
    /// be `BASE` and probed when a letter needs more. Default `LARGEST`.
    pub max_datagram: usize,
    /// Maximum number of connections. Default 256. The peers at one address (with IPv6, in one network
    /// of 64 bits), and those at all loopback addresses together, open at most half of them.
    pub max_connections: usize,
    /// Maximum number of connections that the peers at one address open. Default 64. This limit and
    /// the next two do not apply to loopback addresses.
    pub max_per_address: usize,
    /// Maximum number of letters per second from one address, which is also the maximum burst;
    /// further letters are accepted when the peer retransmits them. 0: unlimited. Default 20,000.
    pub peer_letters: u64,
    /// Maximum number of bytes per second from one address, which is also the maximum burst. 0:
    /// unlimited. Default 256 MiB.
    pub peer_bytes: u64,
    /// Maximum number of unanswered parcels per connection and direction. Default 1024.
    pub max_in_flight: usize,
    /// Maximum number of bytes per connection and direction that wait to be sent, or for an earlier
    /// parcel that was lost; a single letter is always accepted. Default 4 MiB.
    pub max_queued_bytes: usize,
    /// Maximum number of bytes of parcels that wait for an earlier one, on all connections
    /// together; a parcel beyond it is accepted when the peer retransmits it. Default 64 MiB.
    pub max_incoming: usize,
    /// Maximum number of such bytes of one source: one address (with IPv6, one network of 64 bits), and with
    /// twice as much all loopback addresses together. Default 16 MiB.
    pub max_incoming_per_source: usize,
    /// Timeout of opening a connection. Default 2 s.
    pub connect_timeout: Duration,
    /// Time without a packet from a peer that owes an acknowledgment or an answer, after which the
    /// connection is given up, provided that there were several retransmissions. Default 2 s.
    pub silence: Duration,
    /// Time without a letter or an answer after which a connection is closed. Default 60 s.
    pub idle_close: Duration,
}

impl UdpLimits {
    /// Size of a datagram that every path must carry: 1,200 bytes.
    pub const BASE: usize = BASE;
    /// Size of the largest possible datagram: 65,487 bytes.
    pub const LARGEST: usize = LARGEST;

    /// Returns the maximum number of connections that the peers at this address may open.
    pub(super) fn max_connections_of(&self, home: IpAddr) -> usize {
        shares::connections_of(home, self.max_connections, self.max_per_address)
    }

    /// Returns the memory limits of parcels that wait for earlier ones, for the peers at this
    /// address and for all.
    pub(super) fn budget_of(&self, home: IpAddr) -> BudgetLimits {
        shares::budget_of(home, self.max_incoming, self.max_incoming_per_source)
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
