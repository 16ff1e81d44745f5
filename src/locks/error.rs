//! Errors of locks.

use std::io;

use fipa_acl::BuildError;
use fipa_locking::{Algorithm, Failure, NameError, OptionsError, Refusal, Resource};
use fipa_transport::Forked;
use fipa_transport::threads::ThreadError;

use super::StateFileError;
use crate::domain::background::BackgroundError;
use crate::error::SendError;

/// The error if an agent does not get a lock, or has lost it.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LockError {
    /// The name of the resource or of this agent is not valid.
    #[error("a resource or its agent cannot have this name")]
    Name(#[from] NameError),
    /// No agent owns the resource.
    #[error("no agent owns {resource:?}; start its owner")]
    NoOwner {
        /// The resource.
        resource: String,
    },
    /// The time of the request is over, and no owner of the resource has been found yet.
    #[error("timed out: no owner of {resource:?} was found; start its owner")]
    OwnerNotFound {
        /// The resource.
        resource: String,
    },
    /// The owner of the resource is lost: it left, died, or does not answer.
    #[error("{resource:?} is unreachable: its owner {owner:?} does not answer")]
    Unreachable {
        /// The resource.
        resource: String,
        /// The name of the owner.
        owner: String,
    },
    /// The time of the request is over.
    #[error("timed out waiting for {resource:?}{}", requests_ahead(*.ahead))]
    TimedOut {
        /// The resource.
        resource: String,
        /// Estimate of the number of requests that would have been served before; `None` if the owner has not
        /// told the place of the request. It tells the first eight.
        ahead: Option<usize>,
    },
    /// The owner refuses the request.
    #[error("the owner of {resource:?} refuses: {reason}")]
    Refused {
        /// The resource.
        resource: String,
        /// The reason.
        reason: Refusal,
    },
    /// This agent was told to use an algorithm, and the owner of the resource uses another one.
    #[error(
        "the owner of {resource:?} uses the algorithm {owner}, and this agent was told to use {own}; use that of \
         the owner, or name none"
    )]
    OtherAlgorithm {
        /// The resource.
        resource: String,
        /// The algorithm of the owner.
        owner: Algorithm,
        /// The algorithm of this agent.
        own: Algorithm,
    },
    /// The lock was lost: its lease ended without a renewal, or the owner has ended it.
    #[error("the lock of {resource:?} was lost")]
    Lost {
        /// The resource.
        resource: String,
    },
    /// The agent was deregistered, or its domain was closed.
    #[error("the agent was deregistered")]
    Closed,
    /// The options can only be set before the agent uses locks.
    #[error("the agent has used locks already; set the options before the first lock")]
    Started,
    /// An option is out of bounds.
    #[error(transparent)]
    Options(#[from] OptionsError),
    /// The system has no timer left.
    #[error("cannot create a timer")]
    Timer(#[source] io::Error),
    /// The system refuses another thread.
    #[error(transparent)]
    Thread(ThreadError),
    /// The question to the owners cannot be written.
    #[error("cannot write the question to the owners")]
    Question(#[from] BuildError),
    /// The question to the owners cannot be sent.
    #[error("cannot ask the owners")]
    Send(#[from] SendError),
    /// This process is a forked child of the one that registered the agent.
    #[error(transparent)]
    Forked(#[from] Forked),
}

fn requests_ahead(ahead: Option<usize>) -> String {
    match ahead {
        Some(1) => ", with 1 request ahead".to_owned(),
        Some(ahead) => format!(", with about {ahead} requests ahead"),
        None => String::new(),
    }
}

impl From<BackgroundError> for LockError {
    fn from(error: BackgroundError) -> Self {
        match error {
            BackgroundError::Thread(error) => Self::Thread(error),
            _ => Self::Closed,
        }
    }
}

impl LockError {
    pub(super) fn failed(resource: &Resource, failure: Failure) -> Self {
        let resource = resource.as_str().to_owned();
        match failure {
            Failure::NoOwner => Self::NoOwner { resource },
            Failure::OwnerNotFound => Self::OwnerNotFound { resource },
            Failure::Unreachable { owner } => Self::Unreachable {
                resource,
                owner: owner.name().to_owned(),
            },
            Failure::TimedOut { ahead } => Self::TimedOut { resource, ahead },
            Failure::Algorithm { owner, own } => Self::OtherAlgorithm {
                resource,
                owner,
                own,
            },
            Failure::Refused(reason) => Self::Refused { resource, reason },
            _ => Self::Lost { resource },
        }
    }

    pub(super) fn lost(resource: &Resource) -> Self {
        let resource = resource.as_str().to_owned();
        Self::Lost { resource }
    }
}

/// The error if an agent cannot own a resource.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum OwnError {
    /// The name of the resource is not valid.
    #[error("a resource cannot have this name")]
    Name(#[from] NameError),
    /// An option is out of bounds.
    #[error(transparent)]
    Options(#[from] OptionsError),
    /// The state file cannot be used.
    #[error(transparent)]
    StateFile(#[from] StateFileError),
    /// Another agent owns the resource.
    #[error("{resource:?} is owned by {owner:?}; stop that agent, or own another resource")]
    Taken {
        /// The resource.
        resource: String,
        /// The name of the owner.
        owner: String,
    },
    /// The owner may have granted fences before, and nothing says which: there is no state file, the clock was
    /// not set, and no agent or device that is connected has seen one.
    #[error(
        "nothing says which fences of {resource:?} earlier runs have granted: there is no state file, the \
         clock is not set, and no agent or device has seen one; set the clock, restore the file, or start \
         with `forget` if there was no earlier run"
    )]
    NoMemory {
        /// The resource.
        resource: String,
    },
    /// This agent owns the resource already.
    #[error("this agent owns {resource:?} already")]
    AlreadyOwned {
        /// The resource.
        resource: String,
    },
    /// The locks of the agent cannot be used.
    #[error(transparent)]
    Locks(#[from] LockError),
}
