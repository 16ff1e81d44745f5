//! The names of sendings, lanes and registrations within a core.

use std::sync::Arc;

use fipa_sds::Entry;
use fipa_transport::{Incarnation, Stream};

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

/// The 64-bit FNV-1a hash: equal in every process, so that reports match their letters.
pub(super) fn registration_by_name(name: &str) -> Incarnation {
    let step = |hash: u64, byte: &u8| (hash ^ u64::from(*byte)).wrapping_mul(0x100_0000_01b3);
    let hash = name.as_bytes().iter().fold(0xcbf2_9ce4_8422_2325, step);
    Incarnation::from_u64(hash.max(1))
}
