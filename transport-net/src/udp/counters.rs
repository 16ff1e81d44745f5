//! What an endpoint counts, for people who look at it.

use serde::Serialize;

/// What happened at a UDP endpoint since it was made.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct UdpCounters {
    /// Connections now open with peers that introduced themselves.
    pub connections: u64,
    /// Connections opened from this side, with a welcome from the other.
    pub dialled: u64,
    /// Connections opened by peers that introduced themselves.
    pub accepted: u64,
    /// Connections that could not be opened.
    pub dial_failures: u64,
    /// Parcels (letters, reports, credits) sent, each counted once.
    pub parcels_out: u64,
    /// Parcels sent again.
    pub sent_again: u64,
    /// Parcels that arrived, each counted once.
    pub parcels_in: u64,
    /// Packets and parcels that arrived again.
    pub duplicates: u64,
    /// Parcels to be taken later, because their peer had sent more than it may.
    pub held_back: u64,
    /// Datagrams ignored: garbage, or from strangers.
    pub ignored: u64,
    /// Connections closed because of what the peer sent.
    pub refused_nonsense: u64,
    /// Connections refused because there were too many.
    pub refused_crowd: u64,
    /// Connections refused because the service that their peers say to be is connected.
    pub refused_unproved: u64,
}
