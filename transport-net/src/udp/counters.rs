//! Counters of a UDP endpoint, for diagnosis.

use serde::Serialize;

/// Counters of a UDP endpoint since its creation.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct UdpCounters {
    /// Connections that are open now and whose peer has introduced itself.
    pub connections: u64,
    /// Connections opened by this side whose peer has introduced itself.
    pub dialed: u64,
    /// Connections opened by peers that introduced themselves.
    pub accepted: u64,
    /// Connections that could not be opened.
    pub dial_failures: u64,
    /// Parcels (letters, reports, credits) sent, each counted once.
    pub parcels_out: u64,
    /// Retransmitted parcels.
    pub sent_again: u64,
    /// Parcels that arrived, each counted once.
    pub parcels_in: u64,
    /// Duplicate packets and parcels that arrived.
    pub duplicates: u64,
    /// Parcels not accepted at once because their peer exceeded its rate limit.
    pub held_back: u64,
    /// Ignored datagrams: malformed, or from unknown peers.
    pub ignored: u64,
    /// Connections closed because the peer violated the protocol.
    pub refused_nonsense: u64,
    /// Connections refused because a limit was reached.
    pub refused_crowd: u64,
    /// Connections refused because their peer claimed to be a service that is already connected.
    pub refused_unproved: u64,
    /// Connections refused because the peer has an earlier one from the same address, which is alive. A
    /// healthy peer opens another one when its first one is slow.
    pub refused_again: u64,
}
