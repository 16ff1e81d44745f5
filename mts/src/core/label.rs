//! A parcel without its body.

use std::sync::Arc;
use std::time::Duration;

use fipa_transport::{Body, Parcel, Stream};

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

impl Label {
    pub(super) fn of(parcel: Parcel) -> (Self, Body) {
        let Parcel {
            receiver,
            stream,
            sequence,
            after,
            transfer,
            remaining,
            body,
        } = parcel;
        let label = Self {
            receiver,
            stream,
            sequence,
            after,
            transfer,
            remaining,
        };
        (label, body)
    }
}
