//! The names of sendings, lanes and registrations within a core.

use std::sync::Arc;

use fipa_sds::Entry;
use fipa_transport::{Incarnation, Stream, fnv1a};

/// Identifies a call of [`Core::submit`](super::Core::submit) in its outcomes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct SubmissionId(pub u64);

/// The number of a lane within its core.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) struct LaneId(pub(crate) u64);

/// The letters of a lane.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(crate) enum LaneKey {
    /// Letters that this process sends, from this agent or service to all registrations of this
    /// name.
    Name(Incarnation, Arc<str>),
    /// Letters that this process sends to this registration of a service, whose name other services
    /// may have.
    Service(Stream),
    /// Letters of others in custody.
    Custody(Stream),
}

/// The registration that letters to this agent are for. A legacy peer's agent has no incarnation;
/// one that is derived from its name stands for all its registrations.
pub(crate) fn registration_of(entry: &Entry) -> Incarnation {
    if entry.incarnation.is_known() {
        entry.incarnation
    } else {
        registration_by_name(&entry.name)
    }
}

/// Equal in every process, so that reports match their letters.
pub(super) fn registration_by_name(name: &str) -> Incarnation {
    Incarnation::from_u64(fnv1a(name.bytes()).max(1))
}
