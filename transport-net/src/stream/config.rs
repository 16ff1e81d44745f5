//! Configuration of an endpoint of framed connections.

#[cfg(feature = "ip")]
use fipa_transport::Principal;
use std::time::Duration;

use super::budget::BudgetLimits;
use super::source::{Home, QuotaKey};
use crate::Identity;
#[cfg(feature = "ip")]
use crate::rate_limit::{Rates, is_one_peer};
use crate::refused_dials::RefusedDials;

/// Identity, limits and trust of an endpoint.
#[derive(Debug, Clone)]
pub(crate) struct StreamConfig {
    pub(crate) identity: Identity,
    pub(crate) limits: NetLimits,
    /// Receives the connections of this side that peers refuse.
    pub(crate) refused_dials: RefusedDials,
    /// Whether processes of this host connect over loopback.
    #[cfg(feature = "ip")]
    pub(crate) processes: bool,
    /// Receives the connections that are refused because of keys or of another version of the protocol.
    #[cfg(feature = "ip")]
    pub(crate) refusals: crate::refusals::Refusals,
    /// Credentials and trust. Without them, peers need not prove their identity.
    #[cfg(feature = "secure")]
    pub(crate) security: Option<crate::secure::Security>,
}

impl StreamConfig {
    /// Returns a configuration without reports of refusals and without security.
    pub(crate) fn new(identity: Identity, limits: NetLimits) -> Self {
        Self {
            identity,
            limits,
            refused_dials: RefusedDials::default(),
            #[cfg(feature = "ip")]
            processes: false,
            #[cfg(feature = "ip")]
            refusals: crate::refusals::Refusals::default(),
            #[cfg(feature = "secure")]
            security: None,
        }
    }

    /// Whether frames are exchanged with a peer at this address that has proved nothing.
    #[cfg(feature = "ip")]
    pub(crate) fn takes_frames_of(&self, ip: std::net::IpAddr) -> bool {
        #[cfg(feature = "secure")]
        if let Some(security) = &self.security {
            return !security.covers(ip) && self.processes;
        }
        let _unproved = ip;
        true
    }

    /// Returns the principal of a peer without a certificate that connects from this address and
    /// sends this identity. An unproved peer can claim to be of this host.
    #[cfg(feature = "ip")]
    pub(crate) fn principal_at(&self, ip: std::net::IpAddr, peer: &Identity) -> Principal {
        let is_here = self.processes && ip.to_canonical().is_loopback();
        match is_here && !self.identity.is_remote(peer) {
            true => Principal::Host,
            false => Principal::Unproved,
        }
    }

    /// Whether a peer with this origin is subject to limits: it is one peer of another host, or
    /// must prove its identity.
    pub(crate) fn limits_peer_at(&self, home: Home) -> bool {
        match home {
            Home::Process(_) => false,
            #[cfg(feature = "ip")]
            Home::Address(ip) => {
                #[cfg(feature = "secure")]
                if let Some(security) = &self.security
                    && security.covers(ip)
                {
                    return true;
                }
                is_one_peer(ip)
            }
        }
    }

    /// Returns the maximum number of introduced connections of one quota key: at most half of all,
    /// so that no quota key blocks the listener.
    pub(crate) fn max_connections_of(&self, quota_key: &QuotaKey) -> usize {
        let half = (self.limits.max_connections / 2).max(1);
        let is_one_peer = match quota_key {
            QuotaKey::Unproved(home) => self.limits_peer_at(*home),
            QuotaKey::Certificate(_) => true,
        };
        match is_one_peer {
            true => self.limits.max_per_address.min(half),
            false => half,
        }
    }

    /// Returns the memory limits of arriving letters, for one quota key and for all.
    pub(crate) fn budget_of(&self, quota_key: &QuotaKey) -> BudgetLimits {
        let each = self.limits.max_incoming_per_source;
        // A loopback address stands for many processes.
        let is_many = match quota_key {
            #[cfg(feature = "ip")]
            QuotaKey::Unproved(Home::Address(ip)) => !is_one_peer(*ip),
            _ => false,
        };
        BudgetLimits {
            total: self.limits.max_incoming,
            each: if is_many {
                each.saturating_mul(2)
            } else {
                each
            },
        }
    }

    /// Whether letters may be sent to a legacy peer at this address, which cannot prove its
    /// identity.
    #[cfg(feature = "ip")]
    pub(crate) fn gives_legacy_peers_at(&self, ip: std::net::IpAddr) -> bool {
        #[cfg(feature = "secure")]
        if let Some(security) = &self.security {
            return !security.covers(ip) || security.excepts(ip);
        }
        let _anybody = ip;
        true
    }

    /// Checks that letters may be sent to a legacy peer at this address.
    ///
    /// # Errors
    /// When it would have to prove its identity, which it cannot.
    #[cfg(feature = "ip")]
    pub(crate) fn check_legacy_peer(
        &self,
        peer: std::net::SocketAddr,
    ) -> Result<(), fipa_transport::TransportError> {
        if self.gives_legacy_peers_at(peer.ip()) {
            return Ok(());
        }
        let detail = format!(
            "{peer} is a legacy peer, which cannot prove its identity, and is not listed in security.legacy_peers"
        );
        let fault = fipa_transport::TransportErrorKind::Refused;
        Err(fipa_transport::TransportError::new(fault, detail))
    }
}

/// NetLimits of an endpoint that sends letters over byte streams. Memory is bounded by about
/// `max_incoming` for arriving letters, and `max_connections` × `max_queued_bytes` for letters that
/// wait to be sent, the latter only when this side sends them.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NetLimits {
    /// Largest letter sent or taken, in bytes. Default 64 MiB.
    pub max_letter: usize,
    /// Maximum number of connections whose peer has introduced itself, or that this side opened.
    /// Default 256. The peers of one source have at most half of them: one certificate, one address
    /// (with IPv6, one network of 64 bits), all loopback addresses together, or one process.
    pub max_connections: usize,
    /// Maximum number of accepted connections that have not introduced themselves: those whose
    /// handshake has begun and those that have been silent for 250 ms. One more evicts the oldest
    /// of the address (with IPv6, the network of 64 bits) that has the most. Default 64. The same
    /// number of letters of legacy peers are read at once, and always at least one of each address.
    pub max_strangers: usize,
    /// Maximum number of legacy peers' letters of one address that are read at once. Default 32.
    pub max_reads_per_address: usize,
    /// Maximum number of connections of one address that wait unread beside these, in the order of
    /// acceptance. The next one evicts the oldest that has sent no byte; when all have sent a byte,
    /// the next one itself is reset. Default 512.
    pub max_unread_per_address: usize,
    /// Maximum number of connections of all addresses that wait unread. Default 1024.
    pub max_unread: usize,
    /// Maximum number of connections that the peers with one certificate, or the peers at one
    /// address that have proved nothing, have opened and introduced themselves on. Default 64. It
    /// does not apply to loopback addresses, unless peers there must also prove their identity.
    pub max_per_address: usize,
    /// Maximum number of letters per second from one address, which is also the maximum burst;
    /// further letters are read later. 0: unlimited. Default 20,000. This limit and the next do not
    /// apply to loopback addresses either.
    pub peer_letters: u64,
    /// Maximum number of bytes per second from one address, which is also the maximum burst. 0:
    /// unlimited. Default 256 MiB.
    pub peer_bytes: u64,
    /// Maximum number of unanswered parcels per connection and direction. Default 1024.
    pub max_in_flight: usize,
    /// Maximum number of bytes per connection that wait to be handed to the kernel; a single letter
    /// is always accepted. Default 64 MiB.
    pub max_queued_bytes: usize,
    /// Maximum number of bytes of letters that are arriving, on all connections together: the whole
    /// length of a letter of 32 KiB or more from its header to its end, and the memory of a legacy
    /// peer's letter from 64 KiB on. When there is no room for another letter, its connection is not
    /// read until there is. A letter that is larger than this arrives alone. While others wait, a
    /// letter that has not arrived within 12 times `stall_timeout` at its present pace ends its
    /// connection. Default 256 MiB.
    pub max_incoming: usize,
    /// Part of `max_incoming` that one source may use. A source is the peers with one certificate, or
    /// without proof one process or one address (with IPv6, one network of 64 bits). All loopback
    /// addresses together are one source with twice this limit. Default 64 MiB.
    pub max_incoming_per_source: usize,
    /// Maximum number of bytes of [the sink's memory](fipa_transport::Sink::memory_for) for
    /// announced content that is arriving, on all connections together. Beyond it, content is read
    /// into memory that grows as the bytes arrive. Default 32 MiB.
    pub max_arriving: usize,
    /// Timeout of opening a connection. Default 2 s.
    pub connect_timeout: Duration,
    /// Timeout of the peer's hello on a new connection. Default 5 s.
    pub handshake_timeout: Duration,
    /// Period in which a partly arrived frame, or letter of a legacy peer, must progress by at
    /// least [`NetLimits::MIN_PROGRESS`] bytes. Default 10 s.
    pub stall_timeout: Duration,
    /// Time without a byte from the peer after which it gets a ping; after the same time again
    /// without a byte the connection is given up. Default 10 s.
    pub keep_alive: Duration,
    /// Time without a letter or an answer after which a connection is closed. Default 60 s.
    pub idle_close: Duration,
}

impl NetLimits {
    /// Number of bytes that must arrive within `stall_timeout` while a frame has partly arrived.
    pub const MIN_PROGRESS: u64 = 4096;

    #[cfg(feature = "ip")]
    pub(crate) fn rates(&self) -> Rates {
        Rates {
            letters: self.peer_letters,
            bytes: self.peer_bytes,
        }
    }
}

impl Default for NetLimits {
    fn default() -> Self {
        Self {
            max_letter: 64 << 20,
            max_connections: 256,
            max_strangers: 64,
            max_reads_per_address: 32,
            max_unread_per_address: 512,
            max_unread: 1024,
            max_per_address: 64,
            peer_letters: 20_000,
            peer_bytes: 256 << 20,
            max_in_flight: 1024,
            max_queued_bytes: 64 << 20,
            max_incoming: 256 << 20,
            max_incoming_per_source: 64 << 20,
            max_arriving: 32 << 20,
            connect_timeout: Duration::from_secs(2),
            handshake_timeout: Duration::from_secs(5),
            stall_timeout: Duration::from_secs(10),
            keep_alive: Duration::from_secs(10),
            idle_close: Duration::from_secs(60),
        }
    }
}

#[cfg(all(test, feature = "ip"))]
mod tests {
    use std::net::{IpAddr, Ipv4Addr};

    use super::*;
    use fipa_transport::Incarnation;

    fn identity(host: &str, domain: &str) -> Identity {
        Identity {
            name: "mts".into(),
            incarnation: Incarnation::from_u64(1),
            domain: domain.into(),
            host: host.into(),
        }
    }

    /// Host and domain are in every hello, so a peer can repeat them.
    #[test]
    fn only_a_listed_loopback_peer_of_this_host_and_domain_is_local() {
        let (loopback, elsewhere) = (Ipv4Addr::LOCALHOST, Ipv4Addr::new(192, 0, 2, 1));
        let mapped = IpAddr::V6(loopback.to_ipv6_mapped());
        for (processes, ip, host, domain, is_local) in [
            (true, IpAddr::V4(loopback), "here", "test", true),
            (true, mapped, "here", "test", true),
            (true, IpAddr::V4(loopback), "there", "test", false),
            (true, IpAddr::V4(loopback), "here", "other", false),
            (true, IpAddr::V4(elsewhere), "here", "test", false),
            (false, IpAddr::V4(loopback), "here", "test", false),
            (false, IpAddr::V4(elsewhere), "here", "test", false),
        ] {
            let config = StreamConfig {
                processes,
                ..StreamConfig::new(identity("here", "test"), NetLimits::default())
            };
            let principal = config.principal_at(ip, &identity(host, domain));
            let expected = match is_local {
                true => Principal::Host,
                false => Principal::Unproved,
            };
            assert_eq!(principal, expected, "{processes}, {ip}, {host}, {domain}");
        }
    }
}
