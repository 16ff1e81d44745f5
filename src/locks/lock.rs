//! A lock: the claim of an agent that holds its resources.

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use fipa_acl::MessageBuilder;
use fipa_locking::{Algorithm, AnyAlgorithm, ClaimId, Fence, LockPeer, Locks, Millis, Resource};
use tokio::sync::watch;

use super::shell::{self, ClaimState, Shared};
use super::{LockError, message, owned};
use crate::agent::AgentCore;

type Actions = Vec<fipa_locking::Action>;

/// A lock of one or several resources. Dropping it releases them.
///
/// The agent renews the leases in the background. A lock is lost when a lease ends without a renewal:
/// the owner is cut off or has ended, or this process was suspended.
#[must_use = "dropping a lock releases it"]
pub struct Lock {
    claim: Claim,
    fences: Vec<(Resource, Option<Fence>)>,
}

/// A request, which is withdrawn or released when it is dropped.
struct Claim {
    core: Arc<AgentCore>,
    shared: Arc<Shared>,
    id: ClaimId,
    state: watch::Receiver<ClaimState>,
}

impl Claim {
    /// Waits until the claim has another state than `state`. Returns the error unless it is held.
    fn after(&self, state: ClaimState) -> impl Future<Output = Result<(), LockError>> + use<> {
        let mut changes = self.state.clone();
        async move {
            let changed = changes.wait_for(|now| *now != state).await;
            let now = changed.map_or(ClaimState::Closed, |now| now.clone());
            match now {
                ClaimState::Waiting | ClaimState::Held => Ok(()),
                ClaimState::Failed { resource, failure } => {
                    Err(LockError::failed(&resource, failure))
                }
                ClaimState::Lost { resource } => Err(LockError::lost(&resource)),
                ClaimState::Closed => Err(LockError::Closed),
            }
        }
    }
}

impl Drop for Claim {
    fn drop(&mut self) {
        // In a forked child, the lock still belongs to the parent.
        if self.core.endpoint.domain.inner.owner.is_this() {
            self.shared.release(&self.core, self.id);
        }
    }
}

impl Lock {
    /// Begins a claim and waits until it is held.
    pub(super) async fn acquire(
        core: &Arc<AgentCore>,
        resources: Vec<Resource>,
        begin: impl FnOnce(&mut Locks<AnyAlgorithm>, Millis, &[Resource], &mut Actions) -> ClaimId,
    ) -> Result<Self, LockError> {
        let shared = shell::start(core)?;
        let owners = listed_owners(core, &shared, &resources);
        let (id, state) = shared.claim(core, &owners, |locks, now, actions| {
            begin(locks, now, &resources, actions)
        });
        let claim = Claim {
            core: Arc::clone(core),
            shared,
            id,
            state,
        };
        claim.after(ClaimState::Waiting).await?;
        let fences = claim.shared.read(|locks, now| {
            let fence = |resource: Resource| {
                let fence = locks.fence(now, id, &resource);
                (resource, fence)
            };
            let fences: Vec<_> = resources.into_iter().map(fence).collect();
            locks.is_held(now, id).then_some(fences)
        });
        match fences {
            Some(fences) => Ok(Self { claim, fences }),
            // The lease has ended before this task ran.
            None => match claim.after(ClaimState::Held).await {
                Err(error) => Err(error),
                Ok(()) => Err(LockError::Closed),
            },
        }
    }

    /// Returns the names of the resources.
    pub fn resources(&self) -> impl Iterator<Item = &str> {
        self.fences.iter().map(|(resource, _)| resource.as_str())
    }

    /// Returns the fence of the lock, of its first resource if there are several. An owner that is an
    /// agent of the C++ library `distributed_locking` gives none.
    ///
    /// The fence stays the same after the loss of the lock. Its owner then refuses it.
    #[must_use]
    pub fn fence(&self) -> Option<&Fence> {
        self.fences.first()?.1.as_ref()
    }

    /// Returns the fence of one of several resources.
    #[must_use]
    pub fn fence_of(&self, resource: &str) -> Option<&Fence> {
        let mut fences = self.fences.iter();
        fences.find(|(own, _)| own.as_str() == resource)?.1.as_ref()
    }

    /// Adds the fences of the lock to a message, as its user-defined parameter
    /// [`FENCE`](super::FENCE). The owner checks it with [`Owned::check`](super::Owned::check).
    pub fn guard(&self, message: MessageBuilder) -> MessageBuilder {
        let fences = self.fences.iter().filter_map(|(_, fence)| fence.as_ref());
        message::with_fences(message, fences)
    }

    /// Whether this agent holds all resources now. Another agent may use a resource as soon as this is
    /// false, so it is advisory for effects that the owner does not guard.
    #[must_use]
    pub fn is_held(&self) -> bool {
        let id = self.claim.id;
        self.claim.shared.read(|locks, now| locks.is_held(now, id))
    }

    /// Returns the remaining time of the shortest lease, which the agent extends before its end. Zero
    /// after the loss of the lock; `None` if no owner gives a lease.
    #[must_use]
    pub fn remaining(&self) -> Option<Duration> {
        let id = self.claim.id;
        self.claim.shared.read(|locks, now| {
            if !locks.is_held(now, id) {
                return Some(Duration::ZERO);
            }
            locks.remaining(now, id).map(Duration::from_millis)
        })
    }

    /// Waits until the lock is lost, and returns the reason: [`LockError::Lost`] or
    /// [`LockError::Closed`]. The future does not keep the lock: it also ends when the lock is released.
    ///
    /// ```no_run
    /// # async fn example(agent: fipa::Agent) -> Result<(), Box<dyn std::error::Error>> {
    /// # async fn work() {}
    /// let lock = agent.lock("bay").await?;
    /// tokio::select! {
    ///     () = work() => lock.release(),
    ///     lost = lock.lost() => return Err(lost.into()),
    /// }
    /// # Ok(())
    /// # }
    /// ```
    pub fn lost(&self) -> impl Future<Output = LockError> + Send + use<> {
        let after = self.claim.after(ClaimState::Held);
        async move {
            match after.await {
                Err(error) => error,
                // Cannot happen: a claim that was held never waits again.
                Ok(()) => LockError::Closed,
            }
        }
    }

    /// Releases the lock, as dropping it does.
    pub fn release(self) {}
}

impl fmt::Debug for Lock {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Lock")
            .field("fences", &self.fences)
            .finish_non_exhaustive()
    }
}

/// Returns the owners that the directory lists, with the algorithms that they name, if they differ from those that the
/// agent knows: an owner that has restarted has another registration.
fn listed_owners(
    core: &AgentCore,
    shared: &Shared,
    resources: &[Resource],
) -> Vec<(Resource, LockPeer, Option<Algorithm>)> {
    let directory = core.endpoint.domain.directory();
    let listed = |resource: &Resource| {
        let known = shared.read(|locks, _| locks.owner_of(resource).cloned());
        let (owner, algorithm) = owned::listed_owner(directory, resource)?;
        let owner = LockPeer::new(&owner.name, owner.incarnation.as_u64()).ok()?;
        (known.as_ref() != Some(&owner)).then(|| (resource.clone(), owner, algorithm))
    };
    resources.iter().filter_map(listed).collect()
}
