//! What the owner of an endpoint chooses.

#[cfg(feature = "ip")]
use fipa_transport::Principal;
use std::time::Duration;

use super::place::Budget;
use super::source::{Account, Home};
use crate::Identity;
#[cfg(feature = "ip")]
use crate::ration::{Rates, is_one_peer};

/// How an endpoint introduces itself, and what it takes from whom.
#[derive(Debug, Clone)]
pub(crate) struct StreamConfig {
    pub(crate) identity: Identity,
    pub(crate) limits: Limits,
    /// Whether processes of this host connect over loopback.
    #[cfg(feature = "ip")]
    pub(crate) processes: bool,
    /// What peers have to prove. Without it nobody has to prove anything.
    #[cfg(feature = "secure")]
    pub(crate) security: Option<crate::secure::Security>,
}

impl StreamConfig {
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

    /// What a peer has proved that connects from this address, without a certificate, and says this of
    /// itself. Strangers can say that they are of this host.
    #[cfg(feature = "ip")]
    pub(crate) fn principal_at(&self, ip: std::net::IpAddr, peer: &Identity) -> Principal {
        let is_here = self.processes && ip.to_canonical().is_loopback();
        match is_here && !self.identity.is_remote(peer) {
            true => Principal::Host,
            false => Principal::Unproved,
        }
    }

    /// Whether there are limits to what a peer there may have: if it is one peer of another host, or
    /// has to prove who it is.
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

    /// How many introduced connections one account may have at a time. No account has more than half
    /// of all places, so none stops the listener.
    pub(crate) fn places_of(&self, account: &Account) -> usize {
        let half = (self.limits.max_connections / 2).max(1);
        let is_one_peer = match account {
            Account::Unproved(home) => self.limits_peer_at(*home),
            Account::Certificate(_) => true,
        };
        match is_one_peer {
            true => self.limits.max_per_address.min(half),
            false => half,
        }
    }

    /// How much memory the letters of one account may take while they arrive, and those of all.
    pub(crate) fn budget_of(&self, account: &Account) -> Budget {
        let each = self.limits.max_incoming_per_source;
        // Loopback stands for many processes.
        let is_many = match account {
            #[cfg(feature = "ip")]
            Account::Unproved(Home::Address(ip)) => !is_one_peer(*ip),
            _ => false,
        };
        Budget {
            total: self.limits.max_incoming,
            each: if is_many {
                each.saturating_mul(2)
            } else {
                each
            },
        }
    }

    /// Whether letters may go to an old peer at this address, which cannot prove anything.
    #[cfg(feature = "ip")]
    pub(crate) fn gives_old_peers_at(&self, ip: std::net::IpAddr) -> bool {
        #[cfg(feature = "secure")]
        if let Some(security) = &self.security {
            return !security.covers(ip) || security.excepts(ip);
        }
        let _anybody = ip;
        true
    }
}

/// Bounds of an endpoint whose letters go over streams of bytes. Memory is at most about
/// `max_incoming` for letters that are arriving, and `max_connections` × `max_queued_bytes` for those
/// that wait to be sent, the latter only when this side sends them.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Limits {
    /// Largest letter sent or taken, in bytes. Default 64 MiB.
    pub max_letter: usize,
    /// Maximum number of connections whose peer has introduced itself, or that this side opened.
    /// Default 256. The peers of one source have at most half of them: one certificate, one address
    /// (with IPv6, one network of 64 bits), all loopback addresses together, or one process.
    pub max_connections: usize,
    /// Maximum number of accepted connections that have not introduced themselves: those whose
    /// handshake has begun and those that have been silent for 250 ms. One more pushes out the oldest
    /// of the address (with IPv6, the network of 64 bits) that has the most. Default 64. As many
    /// letters of legacy peers are read at once, and one of each address in any case.
    pub max_strangers: usize,
    /// Maximum number of legacy peers' letters of one address that are read at once. Default 32.
    pub max_reads_per_address: usize,
    /// Maximum number of connections of one address that wait unread beside these, in the order of
    /// acceptance. The next one pushes out the oldest that has sent nothing; when all have sent
    /// something, the next one itself is reset. Default 512.
    pub max_unread_per_address: usize,
    /// The same for all addresses together. Default 1024.
    pub max_unread: usize,
    /// Maximum number of connections that the peers with one certificate, or the peers at one address
    /// that have proved nothing, have opened and introduced themselves on. Default 64. It does not
    /// apply to loopback addresses, unless peers there have to prove who they are, too.
    pub max_per_address: usize,
    /// Letters a second that are taken from one address, as many of which may come at once; what is
    /// more is read later. 0: any number. Default 20,000. This and the next are not for loopback
    /// addresses either.
    pub peer_letters: u64,
    /// The same of bytes. Default 256 MiB.
    pub peer_bytes: u64,
    /// Most parcels per connection and direction that are not answered yet. Default 1024.
    pub max_in_flight: usize,
    /// Most bytes per connection that wait to be handed to the kernel; a single letter is always
    /// let in. Default 64 MiB.
    pub max_queued_bytes: usize,
    /// Maximum number of bytes of letters that are arriving, on all connections together: the whole
    /// length of a letter of 32 KiB or more from its header to its end, and the memory of a legacy
    /// peer's letter from 64 KiB on. When there is no room for another letter, its connection is not
    /// read until there is. A letter that is larger than this arrives alone. While others wait, a
    /// letter that has not arrived within 12 times `stall_timeout` at its present pace ends its
    /// connection. Default 256 MiB.
    pub max_incoming: usize,
    /// The same for the peers with one certificate, or for one source that has proved nothing: one
    /// address (with IPv6, one network of 64 bits) or process, and with twice as much all loopback
    /// addresses together. Default 64 MiB.
    pub max_incoming_per_source: usize,
    /// Most bytes of [the sink's memory](fipa_transport::Sink::memory_for) that are taken for
    /// content which has been announced and is arriving, on all connections together. What is
    /// beyond is read into memory that grows as it arrives. Default 32 MiB.
    pub max_arriving: usize,
    /// How long opening a connection may take. Default 2 s.
    pub connect_timeout: Duration,
    /// How long a new connection may take to say hello. Default 5 s.
    pub handshake_timeout: Duration,
    /// How long a frame, or an old peer's letter, may stand half arrived with less than
    /// [`Limits::MIN_PROGRESS`] bytes of progress. Default 10 s.
    pub stall_timeout: Duration,
    /// After this long without a byte from the peer it is asked for a sign of life; after as long
    /// again without one the connection is given up. Default 10 s.
    pub keep_alive: Duration,
    /// After this long without a letter or an answer a connection is closed. Default 60 s.
    pub idle_close: Duration,
}

impl Limits {
    /// Bytes that must arrive within `stall_timeout` while something is half arrived.
    pub const MIN_PROGRESS: u64 = 4096;

    #[cfg(feature = "ip")]
    pub(crate) fn rates(&self) -> Rates {
        Rates {
            letters: self.peer_letters,
            bytes: self.peer_bytes,
        }
    }
}

impl Default for Limits {
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
