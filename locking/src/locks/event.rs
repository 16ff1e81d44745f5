//! Actions and events of the core of an agent, and the state of its resources.

use super::claim::ClaimId;
use crate::owner::{Ending, Grant};
use crate::{Algorithm, LockMessage, LockPeer, Refusal, Resource};

/// Result of a call of the core.
#[derive(Debug, Clone, PartialEq, Eq)]
#[allow(
    clippy::exhaustive_enums,
    reason = "the caller has to perform each action"
)]
pub enum Action {
    /// Send a message.
    Send {
        /// The receiver.
        to: LockPeer,
        /// The message.
        message: LockMessage,
    },
    /// Report an event to the application.
    Event(Event),
}

/// An event for the application.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum Event {
    /// The agent holds all resources of the claim.
    Acquired {
        /// The claim.
        claim: ClaimId,
    },
    /// The claim ended without a lock.
    Failed {
        /// The claim.
        claim: ClaimId,
        /// The resource that it waited for.
        resource: Resource,
        /// The reason.
        failure: Failure,
    },
    /// A resource of an acquired claim was lost, and the others were released.
    Lost {
        /// The claim.
        claim: ClaimId,
        /// The resource.
        resource: Resource,
    },
    /// This agent owns the resource: no other agent contradicted.
    Owning {
        /// The resource.
        resource: Resource,
    },
    /// This agent does not own the resource, because another agent does.
    OwningRefused {
        /// The resource.
        resource: Resource,
        /// The owner.
        by: LockPeer,
    },
    /// Another agent claims a resource that this agent owns. Each owner admits its own fences only.
    Contested {
        /// The resource.
        resource: Resource,
        /// The other agent.
        by: LockPeer,
    },
    /// This agent does not own the resource: no state file, clock, agent or device says which epoch is
    /// higher than those of its earlier lives.
    NoMemory {
        /// The resource.
        resource: Resource,
    },
    /// An owner's epoch has to rise. The caller stores [`OwnerState::raised`](crate::OwnerState::raised), and then
    /// calls [`Locks::stored`](crate::Locks::stored). The owner grants nothing before.
    Raised {
        /// The resource.
        resource: Resource,
        /// The new epoch.
        epoch: u64,
    },
    /// Another agent uses another algorithm for a resource that this agent owns, and was refused.
    OtherAlgorithm {
        /// The resource.
        resource: Resource,
        /// The other agent.
        by: LockPeer,
        /// Its algorithm.
        algorithm: Algorithm,
    },
    /// This owner granted a resource.
    Granted {
        /// The resource.
        resource: Resource,
        /// The grant.
        grant: Grant,
    },
    /// A grant of this owner ended.
    Ended {
        /// The resource.
        resource: Resource,
        /// The grant.
        grant: Grant,
        /// The reason.
        how: Ending,
    },
    /// A legacy agent that holds a resource of this owner does not answer. [`Locks::force`](crate::Locks::force)
    /// ends its grant.
    Silent {
        /// The resource.
        resource: Resource,
        /// The holder.
        holder: LockPeer,
    },
}

/// Reason of a failed claim.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Failure {
    /// No agent owns the resource.
    #[error("no agent owns the resource; start its owner")]
    NoOwner,
    /// The time of the claim is over, and no owner of the resource has been found yet.
    #[error("timed out; no owner of the resource was found, so start its owner")]
    OwnerNotFound,
    /// The owner is lost.
    #[error("the owner {owner} does not answer")]
    Unreachable {
        /// The owner.
        owner: LockPeer,
    },
    /// The time of the claim is over.
    #[error("timed out")]
    TimedOut {
        /// Estimate of the number of requests that would have been served before; `None` if the owner has not
        /// told the place of the request.
        ahead: Option<usize>,
    },
    /// The owner refuses.
    #[error("the owner refuses: {0}")]
    Refused(Refusal),
    /// The owner names another algorithm than the one that this agent was told to use.
    #[error("the owner uses the algorithm {owner}, and this agent was told to use {own}")]
    Algorithm {
        /// MutualExclusion of the owner.
        owner: Algorithm,
        /// MutualExclusion of this agent.
        own: Algorithm,
    },
    /// A resource of the claim was lost before all were acquired.
    #[error("the lock of another resource of the claim was lost")]
    Lost,
}

/// State of a resource, as this agent sees it.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct LockStatus {
    /// The resource.
    pub resource: Resource,
    /// Its owner, if known.
    pub owner: Option<LockPeer>,
    /// The live grant, at the owner.
    pub grant: Option<Grant>,
    /// Agents that wait for a grant, at the owner.
    pub waiters: Vec<LockPeer>,
    /// At the owner: another agent that claims the resource.
    pub rival: Option<LockPeer>,
    /// Whether this agent holds the resource.
    pub is_held: bool,
    /// Number of claims of this agent that wait for the resource.
    pub claims: usize,
}
