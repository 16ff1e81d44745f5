//! Configuration of a UDT endpoint.

use std::net::IpAddr;
use std::time::Duration;

use fipa_transport::{TransportError, TransportErrorKind};

use crate::Identity;
use crate::datagrams::shares;
use crate::rate_limit::Rates;
use crate::stream::budget::BudgetLimits;

/// Configuration of a [`UdtTransport`](crate::UdtTransport).
#[derive(Debug, Clone)]
pub struct UdtConfig {
    /// Numeric addresses to listen on, for example `127.0.0.1:0` or `0.0.0.0:7790`. Port 0 lets the
    /// system choose. fipa_services uses IPv4 only. May be empty: letters can still be sent, but
    /// peers cannot answer, because each side opens a connection of its own.
    pub listen: Vec<String>,
    /// Identity of this endpoint. Legacy peers do not learn it; its incarnation is part of the
    /// locations.
    pub identity: Identity,
    /// NetLimits and timeouts.
    pub limits: UdtLimits,
    /// Credentials and trust. Peers cannot prove their identity over UDT. With credentials, letters
    /// are exchanged only with peers on loopback and with those that the credentials list as legacy
    /// peers.
    #[cfg(feature = "secure")]
    pub security: Option<crate::secure::Security>,
}

impl UdtConfig {
    /// Whether letters may be exchanged with a peer at this address.
    pub(super) fn access(&self) -> impl Fn(IpAddr) -> bool + Send + 'static {
        #[cfg(feature = "secure")]
        let security = self.security.clone();
        move |ip| {
            #[cfg(feature = "secure")]
            if let Some(security) = &security {
                return !security.covers(ip) || security.excepts(ip);
            }
            let _any = ip;
            true
        }
    }
}

/// NetLimits of a UDT endpoint. Memory is bounded by about `max_incoming` and 64 KiB per connection for
/// arriving letters, and `max_connections` × `max_queued_bytes` for letters to send.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UdtLimits {
    /// Largest letter sent or accepted, in bytes. Default 10,000,000, the receive buffer of
    /// fipa_services.
    pub max_letter: usize,
    /// Maximum number of connections. Default 256. The peers at one address (with IPv6, in one network
    /// of 64 bits), and those at all loopback addresses together, open at most half of them.
    pub max_connections: usize,
    /// Maximum number of connections that the peers at one address open. Default 64. One more ends
    /// the connection of that address that has been idle for the longest time, if that is longer than
    /// `idle_close`; otherwise it is refused. This limit and the next two do not apply to loopback
    /// addresses.
    pub max_per_address: usize,
    /// Maximum number of letters per second from one address, which is also the maximum burst;
    /// further letters are accepted when the peer sends them again. 0: unlimited. Default 20,000.
    pub peer_letters: u64,
    /// Maximum number of bytes per second from one address, which is also the maximum burst. 0:
    /// unlimited. Default 256 MiB.
    pub peer_bytes: u64,
    /// Maximum number of letters per connection that wait or are not acknowledged. Default 1024.
    pub max_in_flight: usize,
    /// Maximum number of bytes of these letters; a single letter is always accepted. Default 64 MiB.
    pub max_queued_bytes: usize,
    /// Maximum number of bytes reserved for arriving letters, on all connections together. A letter
    /// of more than 64 KiB reserves `max_letter` and 4 MiB for packets that arrive out of order.
    /// Default 64 MiB.
    pub max_incoming: usize,
    /// Maximum number of such bytes of one source: one address (with IPv6, one network of 64 bits), and with
    /// twice as much all loopback addresses together. Default 16 MiB.
    pub max_incoming_per_source: usize,
    /// Timeout of opening a connection. Default 3 s, which is that of libudt.
    pub connect_timeout: Duration,
    /// Time without a packet from a peer that letters are sent to, after which the connection is
    /// given up. Default 3 s.
    pub silence: Duration,
    /// Time in which a letter must progress: in which a peer acknowledges a packet, or sends at least
    /// 4 KiB of a letter that has begun to arrive. Default 10 s.
    pub stall_timeout: Duration,
    /// Time without a letter after which this side closes a connection that it opened, and without a
    /// packet after which it gives up one that a peer opened. Default 60 s.
    pub idle_close: Duration,
}

/// Letters that wait for a location.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct QueueLoad {
    pub(super) letters: usize,
    pub(super) bytes: usize,
}

impl std::ops::Add for QueueLoad {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self {
            letters: self.letters + other.letters,
            bytes: self.bytes + other.bytes,
        }
    }
}

impl UdtLimits {
    /// Returns the maximum number of connections that the peers at this address may open.
    pub(super) fn max_connections_of(&self, home: IpAddr) -> usize {
        shares::connections_of(home, self.max_connections, self.max_per_address)
    }

    /// Returns the memory limits of arriving letters, for the peers at this address and for all.
    pub(super) fn budget_of(&self, home: IpAddr) -> BudgetLimits {
        shares::budget_of(home, self.max_incoming, self.max_incoming_per_source)
    }

    /// Checks whether a letter of this length can be queued behind so many letters, with so many bytes,
    /// to the same location.
    ///
    /// # Errors
    /// When too much is queued.
    pub(super) fn check_room(&self, queued: QueueLoad, len: usize) -> Result<(), TransportError> {
        let QueueLoad {
            letters: count,
            bytes,
        } = queued;
        if count >= self.max_in_flight.max(1)
            || (bytes > 0 && bytes.saturating_add(len) > self.max_queued_bytes)
        {
            let detail = format!(
                "{count} letters of {bytes} bytes wait for this legacy peer (max_in_flight, max_queued_bytes)"
            );
            return Err(TransportError::new(TransportErrorKind::Congested, detail));
        }
        Ok(())
    }

    pub(super) fn rates(&self) -> Rates {
        Rates {
            letters: self.peer_letters,
            bytes: self.peer_bytes,
        }
    }
}

impl Default for UdtLimits {
    fn default() -> Self {
        Self {
            max_letter: 10_000_000,
            max_connections: 256,
            max_per_address: 64,
            peer_letters: 20_000,
            peer_bytes: 256 << 20,
            max_in_flight: 1024,
            max_queued_bytes: 64 << 20,
            max_incoming: 64 << 20,
            max_incoming_per_source: 16 << 20,
            connect_timeout: Duration::from_secs(3),
            silence: Duration::from_secs(3),
            stall_timeout: Duration::from_secs(10),
            idle_close: Duration::from_secs(60),
        }
    }
}
