//! The endpoint of a [`TcpTransport`](super::TcpTransport): its framed connections and its letters
//! of legacy peers.

use std::ops::Deref;
use std::sync::Arc;

use fipa_transport::{Abandoned, AttemptId, Location, Signature};

use super::legacy::Legacy;
use crate::stream::endpoint::Endpoint;

/// An endpoint that also exchanges unframed letters with legacy peers.
#[derive(Debug)]
pub(super) struct TcpEndpoint {
    /// The framed connections.
    pub(super) stream: Arc<Endpoint>,
    /// Letters of legacy peers, in both directions.
    pub(super) legacy: Legacy,
}

impl TcpEndpoint {
    pub(super) fn new(stream: Arc<Endpoint>) -> Arc<Self> {
        Arc::new(Self {
            stream,
            legacy: Legacy::default(),
        })
    }

    /// Ends an attempt, framed or not.
    pub(super) fn abandon(&self, attempt: AttemptId, to: &Location) -> Abandoned {
        match to.signature() {
            Signature::Frames => self.stream.abandon(attempt, to),
            _ => self.legacy.abandon(attempt, to),
        }
    }

    /// Closes every connection. The tasks of the connections conclude outstanding attempts.
    pub(super) fn close(&self) {
        self.legacy.close();
        self.stream.close();
    }
}

impl Deref for TcpEndpoint {
    type Target = Arc<Endpoint>;

    fn deref(&self) -> &Self::Target {
        &self.stream
    }
}
