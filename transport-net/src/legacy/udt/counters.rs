//! Counters of a UDT endpoint, for diagnosis.

use serde::Serialize;

/// Counters of a UDT endpoint since its creation.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct UdtCounters {
    /// Connections that are open now.
    pub connections: u64,
    /// Connections opened by this side.
    pub dialed: u64,
    /// Connections opened by peers.
    pub accepted: u64,
    /// Connections that could not be opened.
    pub dial_failures: u64,
    /// Letters that their peer has acknowledged.
    pub letters_out: u64,
    /// Letters that arrived.
    pub letters_in: u64,
    /// Packets with parts of letters that were sent, with those that were sent again.
    pub packets_out: u64,
    /// Packets with parts of letters that arrived and were accepted.
    pub packets_in: u64,
    /// Packets that arrived again.
    pub duplicates: u64,
    /// Packets that were dropped for lack of memory, or because their peer exceeded its rate limit;
    /// the peer sends them again.
    pub held_back: u64,
    /// Ignored datagrams: malformed, or from unknown peers.
    pub ignored: u64,
    /// Letters that are malformed, incomplete or too large, and connections that were closed because
    /// their peer sent too slowly or stopped reading.
    pub refused_nonsense: u64,
    /// Connections refused because a limit was reached.
    pub refused_crowd: u64,
    /// Handshakes of peers that must prove their identity, which is impossible over UDT.
    pub refused_unproved: u64,
}
