//! Letters that were not delivered, until their senders are told.

use std::sync::Arc;

use fipa_acl::Letter;
use fipa_transport::{FailureReason, Incarnation, LegacySource};

use crate::failure::Failed;

/// Receiver of a failure message.
#[derive(Debug, Clone)]
pub(crate) enum FailureTarget {
    /// This agent of this process.
    Ours(Incarnation),
    /// An agent of another service, which sent a letter with these parts.
    Remote(Arc<Failed>),
    /// The source of a legacy peer's letter.
    LegacyPeer {
        from: LegacySource,
        failed: Arc<Failed>,
    },
}

/// A failed delivery that a failure message reports.
#[derive(Debug)]
pub(crate) struct Undelivered {
    pub(crate) sender: FailureTarget,
    pub(crate) receiver: Arc<str>,
    pub(crate) letter: Letter,
    pub(crate) reason: FailureReason,
    pub(crate) detail: String,
    /// Number of the sender's letters that one message reports.
    pub(crate) count: usize,
}
