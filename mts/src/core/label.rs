//! A parcel without its body.

use std::sync::Arc;
use std::time::Duration;

use fipa_transport::{Hop, Incarnation, Kind, Stream, Ticket};

/// A parcel without its body.
#[derive(Debug)]
pub(super) struct Label {
    pub(super) receiver: Arc<str>,
    pub(super) stream: Stream,
    pub(super) sequence: u64,
    pub(super) after: u64,
    pub(super) transfer: u64,
    pub(super) remaining: Duration,
}

/// The link on which a parcel arrived.
#[derive(Debug)]
pub(super) struct ArrivalLink {
    pub(super) via: Kind,
    pub(super) from: Hop,
    /// Identifies an arrival that may be answered later.
    pub(super) ticket: Option<Ticket>,
}

/// A letter as its custodian identifies it.
#[derive(Debug, Clone, Copy)]
pub(super) struct HandedOver {
    /// The receiver's registration.
    pub(super) registration: Incarnation,
    pub(super) sequence: u64,
    /// The attempt number of the hand-over.
    pub(super) transfer: u64,
}

/// The current predecessor of a letter that was handed over.
#[derive(Debug, Clone, Copy)]
pub(super) struct PredecessorNote {
    pub(super) sequence: u64,
    /// The predecessor.
    pub(super) after: u64,
    /// The attempt number of the hand-over.
    pub(super) transfer: u64,
}
