//! Where a letter in a lane comes from, and how it leaves.

use std::sync::Arc;

use fipa_transport::{Kind, LegacySource, Location, Outcome, Ticket};
use smallvec::SmallVec;

use super::ids::SubmissionId;
use crate::failure::Failed;

/// Origin of a delivery, which determines the receiver of its outcome.
#[derive(Debug)]
pub(crate) enum Origin {
    /// An agent of this process, which gets an outcome.
    Local { submission: SubmissionId },
    /// Other message transport services, which get a late answer or a report.
    Forwarded { upstreams: SmallVec<[Upstream; 1]> },
    /// The source at a legacy peer, which gets this in a failure message, if anything.
    LegacyPeer {
        from: LegacySource,
        failed: Option<Arc<Failed>>,
    },
    /// A failure message; its outcome is not reported.
    FailureMessage,
}

/// A service that handed over a copy of a letter.
#[derive(Debug)]
pub(crate) struct Upstream {
    /// Location for reports to it.
    pub(crate) back: Location,
    /// Whether it is on another host.
    pub(crate) remote: bool,
    /// The attempt number of its latest hand-over of the letter, which a report names.
    pub(crate) transfer: u64,
    /// Its arrival that has no answer yet.
    pub(crate) unanswered: Option<(Kind, Ticket)>,
}

/// The way in which a letter leaves a lane.
#[derive(Debug)]
pub(crate) enum Settlement {
    /// It has an outcome.
    Outcome(Outcome),
    /// A custodian returns it, because its predecessor did not arrive, or the custodian ends.
    Returned { uncertain: bool },
    /// A custodian returns it, because the receiver's registration has left this host.
    Moved,
}
