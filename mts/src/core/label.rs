//! A parcel without its body.

use std::sync::Arc;
use std::time::Duration;

use fipa_transport::Stream;

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
