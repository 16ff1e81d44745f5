//! The calls of [`crate::locks`] under the same names, blocking.

use std::ops::Deref;
use std::time::Duration;

use super::{Agent, Background};
use crate::locks::{
    self, Device, LockError, LockOptions, OwnError, OwnOptions, OwnerEvent, ResourceStatus,
};

/// A lock; see [`crate::locks::Lock`], whose methods it has. Dropping it releases the resources.
#[derive(Debug)]
#[must_use = "dropping a lock releases it"]
pub struct Lock {
    // Declared first, because it must be dropped before the runtime that it uses.
    lock: locks::Lock,
    runtime: Background,
}

/// A resource that this agent owns; see [`crate::locks::Owned`], whose methods it has. Dropping it ends
/// the ownership.
#[derive(Debug)]
#[must_use = "dropping it ends the ownership"]
pub struct Owned {
    owned: locks::Owned,
    runtime: Background,
}

impl Agent {
    /// See [`crate::Agent::use_locks`].
    ///
    /// # Errors
    /// See [`crate::Agent::use_locks`].
    pub fn use_locks(&self, options: LockOptions) -> Result<(), LockError> {
        self.agent.use_locks(options)
    }

    /// See [`crate::Agent::locks`].
    #[must_use]
    pub fn locks(&self) -> Vec<ResourceStatus> {
        self.agent.locks()
    }

    /// See [`crate::Agent::query_locks`].
    ///
    /// # Errors
    /// See [`crate::Agent::query_locks`].
    pub fn query_locks(&self, timeout: Duration) -> Result<Vec<ResourceStatus>, LockError> {
        self.runtime.block_on(self.agent.query_locks(timeout))
    }

    /// See [`crate::Agent::lock`].
    ///
    /// # Errors
    /// See [`crate::Agent::lock`].
    pub fn lock(&self, resource: &str) -> Result<Lock, LockError> {
        self.acquired(self.runtime.block_on(self.agent.lock(resource)))
    }

    /// See [`crate::Agent::lock_within`].
    ///
    /// # Errors
    /// See [`crate::Agent::lock_within`].
    pub fn lock_within(&self, resource: &str, within: Duration) -> Result<Lock, LockError> {
        let lock = self.agent.lock_within(resource, within);
        self.acquired(self.runtime.block_on(lock))
    }

    /// See [`crate::Agent::try_lock`].
    ///
    /// # Errors
    /// See [`crate::Agent::try_lock`].
    pub fn try_lock(&self, resource: &str) -> Result<Lock, LockError> {
        self.acquired(self.runtime.block_on(self.agent.try_lock(resource)))
    }

    /// See [`crate::Agent::lock_all`].
    ///
    /// # Errors
    /// See [`crate::Agent::lock_all`].
    pub fn lock_all(&self, resources: &[&str]) -> Result<Lock, LockError> {
        self.acquired(self.runtime.block_on(self.agent.lock_all(resources)))
    }

    /// See [`crate::Agent::lock_all_within`].
    ///
    /// # Errors
    /// See [`crate::Agent::lock_all_within`].
    pub fn lock_all_within(&self, resources: &[&str], within: Duration) -> Result<Lock, LockError> {
        let lock = self.agent.lock_all_within(resources, within);
        self.acquired(self.runtime.block_on(lock))
    }

    /// See [`crate::Agent::own`].
    ///
    /// # Errors
    /// See [`crate::Agent::own`].
    pub fn own(&self, resource: &str, options: OwnOptions) -> Result<Owned, OwnError> {
        let owned = self.runtime.block_on(self.agent.own(resource, options))?;
        let runtime = self.runtime.clone();
        Ok(Owned { owned, runtime })
    }

    /// See [`crate::Agent::device`].
    ///
    /// # Errors
    /// See [`crate::Agent::device`].
    pub fn device(&self, owner: &str, resource: &str) -> Result<Device, LockError> {
        self.agent.device(owner, resource)
    }

    fn acquired(&self, lock: Result<locks::Lock, LockError>) -> Result<Lock, LockError> {
        let runtime = self.runtime.clone();
        lock.map(|lock| Lock { lock, runtime })
    }
}

impl Deref for Lock {
    type Target = locks::Lock;

    fn deref(&self) -> &locks::Lock {
        &self.lock
    }
}

impl Lock {
    /// Waits until the lock is lost, and returns the reason; `None` if it is still held after
    /// `timeout`. See [`crate::locks::Lock::lost`].
    #[must_use]
    pub fn lost_within(&self, timeout: Duration) -> Option<LockError> {
        self.runtime.block_on(async {
            let lost = tokio::time::timeout(timeout, self.lock.lost());
            lost.await.ok()
        })
    }

    /// Releases the lock, as dropping it does.
    pub fn release(self) {}
}

impl Deref for Owned {
    type Target = locks::Owned;

    fn deref(&self) -> &locks::Owned {
        &self.owned
    }
}

impl Owned {
    /// Waits for the next event; returns `None` if there is none within `timeout`, or if the agent is
    /// deregistered. See [`crate::locks::Owned::next`].
    #[must_use]
    pub fn next_within(&self, timeout: Duration) -> Option<OwnerEvent> {
        self.runtime.block_on(async {
            let next = tokio::time::timeout(timeout, self.owned.next());
            next.await.ok().flatten()
        })
    }

    /// Ends the ownership, and waits until the state file is written; see
    /// [`crate::locks::Owned::release`].
    pub fn release(self) {
        self.runtime.block_on(self.owned.release());
    }
}
