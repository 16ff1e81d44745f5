//! State of an endpoint for legacy peers: their letters in both directions.

use std::net::SocketAddr;
use std::time::Duration;

use fipa_transport::{Abandoned, AttemptId, Location, log_limit, quota_address};
use socket2::SockRef;
use tokio::net::TcpStream;

use super::accept_queue::{AcceptQueue, Full};
use super::endpoint::TcpEndpoint;
use crate::legacy::queues::LegacySenders;
use crate::stream::counters::count;

/// Letters of legacy peers.
#[derive(Debug, Default)]
pub(crate) struct Legacy {
    /// Letters to legacy peers.
    pub(super) senders: LegacySenders,
    /// Accepted connections that may carry a letter of a legacy peer.
    pub(super) accept_queue: AcceptQueue,
}

impl Legacy {
    pub(crate) fn close(&self) {
        self.senders.close();
        self.accept_queue.close();
    }

    /// Ends the attempt to send a letter.
    pub(crate) fn abandon(&self, attempt: AttemptId, to: &Location) -> Abandoned {
        self.senders.abandon(attempt, to)
    }
}

/// Resets a connection for which the accept queue has no room, so that its sender sees an error.
pub(super) fn reset(endpoint: &TcpEndpoint, stream: TcpStream, from: SocketAddr, full: Full) {
    let limits = endpoint.limits();
    let (whose, most) = match full {
        Full::Address => ("of its address", limits.max_unread_per_address),
        Full::All => ("of all addresses", limits.max_unread),
        Full::Closed => return,
    };
    count(&endpoint.tally().refused_crowd);
    // With a linger time of zero, closing sends a reset.
    if let Err(error) = SockRef::from(&stream).set_linger(Some(Duration::ZERO)) {
        tracing::debug!(%from, "cannot reset a connection: {error}");
    }
    drop(stream);
    log_limit::warn!(
        of: quota_address(from.ip()), %from,
        "connection reset: {most} connections {whose} wait to be read; a letter on it is lost, let \
         its sender send more slowly"
    );
}
