//! The founder of a coalition: it owns the lock of the leader, and keeps the entry in the directory.

use std::fmt;
use std::sync::Arc;

use fipa_acl::{ErrorChain, Message};
use fipa_locking::{Fence, NameError};
use fipa_sds::{Members, RegisterError};
use fipa_transport::log_limit;
use parking_lot::Mutex;
use tokio::runtime::Handle;
use tokio::task::JoinHandle;

use super::lock_of;
use crate::RegisterOptions;
use crate::agent::AgentCore;
use crate::domain::background::{self, BackgroundError};
use crate::domain::coalition::Coalition;
use crate::error::CoalitionError;
use crate::locks::{AdmitError, OwnError, OwnOptions, Owned};

/// The options of [`Agent::found_coalition`](crate::Agent::found_coalition).
#[derive(Debug, Clone, Default)]
pub struct CoalitionOptions {
    /// The lease of the leader, and the state file of its lock.
    pub lock: OwnOptions,
    /// Type and description of the entry.
    pub listing: RegisterOptions,
}

/// A coalition that this agent has founded. Dropping it dissolves the coalition.
#[must_use = "dropping it dissolves the coalition"]
pub struct LedCoalition {
    core: Arc<AgentCore>,
    founded: Arc<Founded>,
    task: JoinHandle<()>,
}

/// The entry of a coalition, and the lock of its leader.
struct Founded {
    entry: Mutex<Coalition>,
    lock: Owned,
}

impl Founded {
    /// Replaces the members with `write`, which gets the entry and the members with the holder of the lock as the
    /// leader. The grant of an agent that is no member ends. Blocks.
    fn replace<T>(
        &self,
        entry: &mut Coalition,
        names: Vec<Arc<str>>,
        write: impl FnOnce(&mut Coalition, Members) -> Result<T, CoalitionError>,
    ) -> Result<T, CoalitionError> {
        let holder = self.lock.status().holder;
        let is_member = |holder: &String| names.iter().any(|name| **name == **holder);
        let is_foreign = holder.as_ref().is_some_and(|holder| !is_member(holder));
        let members = match holder.filter(is_member) {
            Some(leader) => Members::new(names, Some(leader.into())),
            None => Members::vacant(names),
        }?;
        let written = write(entry, members)?;
        if is_foreign {
            self.lock.force();
        }
        Ok(written)
    }

    /// Writes the holder of the lock into the entry. Blocks.
    fn update(&self) -> Result<(), CoalitionError> {
        let mut entry = self.entry.lock();
        let names = entry.members().names().to_vec();
        self.replace(&mut entry, names, |entry, members| {
            match *entry.members() == members {
                true => Ok(()),
                false => entry.replace(members, Vec::new(), &[]),
            }
        })
    }
}

/// Writes each new leader into the entry.
async fn follow(runtime: Handle, founded: Arc<Founded>) {
    while founded.lock.next().await.is_some() {
        let updated = Arc::clone(&founded);
        if let Err(error) = blocking(&runtime, move || updated.update()).await {
            let name = founded.entry.lock().name().to_owned();
            log_limit::warn!(error = %ErrorChain(&error), coalition = name, "cannot list the leader of a coalition");
        }
    }
}

impl LedCoalition {
    pub(super) async fn found(
        core: &Arc<AgentCore>,
        name: &str,
        names: Vec<Arc<str>>,
        options: CoalitionOptions,
    ) -> Result<Self, FoundError> {
        let members = Members::vacant(names).map_err(CoalitionError::from)?;
        let lock = Owned::begin(Arc::clone(core), lock_of(name)?, options.lock).await?;
        let (domain, name) = (core.endpoint.domain.clone(), name.to_owned());
        let formed = background::run(runtime_of(core), move |cancellation| {
            domain.form_unless(&name, members, options.listing, cancellation)
        });
        let formed = formed.await??;
        Ok(Self::start(core, formed, lock))
    }

    fn start(core: &Arc<AgentCore>, entry: Coalition, lock: Owned) -> Self {
        let entry = Mutex::new(entry);
        let founded = Arc::new(Founded { entry, lock });
        let runtime = runtime_of(core);
        let task = runtime.spawn(follow(runtime.clone(), Arc::clone(&founded)));
        Self {
            core: Arc::clone(core),
            founded,
            task,
        }
    }

    /// Returns the name of the coalition.
    #[must_use]
    pub fn name(&self) -> String {
        self.founded.entry.lock().name().to_owned()
    }

    /// Returns the members, and the leader if there is one at present.
    #[must_use]
    pub fn members(&self) -> Members {
        self.founded.entry.lock().members().clone()
    }

    /// Checks a command of the leader, as [`Owned::check`] does.
    ///
    /// # Errors
    /// If the message must not be acted on.
    pub fn check(&self, message: &Message) -> Result<Fence, AdmitError> {
        self.founded.lock.check(message)
    }

    /// Replaces the members, in this order. If the leader is no longer among them, its lock ends.
    ///
    /// # Errors
    /// If the members are invalid, or if the directory cannot be written. The coalition is then unchanged.
    pub async fn change<N: Into<Arc<str>>>(
        &self,
        members: impl IntoIterator<Item = N>,
    ) -> Result<(), FoundError> {
        let names = members.into_iter().map(Into::into).collect();
        let founded = Arc::clone(&self.founded);
        blocking(runtime_of(&self.core), move || {
            let mut entry = founded.entry.lock();
            founded.replace(&mut entry, names, |entry, members| {
                entry.replace(members, Vec::new(), &[])
            })
        })
        .await
    }

    /// Adds all members of another coalition of this process and removes the name of that coalition, in one atomic
    /// change of the directory. The leader of this coalition stays, and the lock of the other one ends.
    ///
    /// # Errors
    /// If there are too many members together, or if the directory cannot be written. Both are then unchanged.
    pub async fn merge(&self, other: Self) -> Result<(), Box<(FoundError, Self)>> {
        let (ours, theirs) = (Arc::clone(&self.founded), Arc::clone(&other.founded));
        let merged = blocking(runtime_of(&self.core), move || {
            let (mut ours_entry, mut theirs) = (ours.entry.lock(), theirs.entry.lock());
            let names = ours_entry.names_with(&theirs);
            ours.replace(&mut ours_entry, names, |entry, members| {
                entry.absorb(members, &mut theirs)
            })
        });
        match merged.await {
            Ok(()) => {
                other.end().await;
                Ok(())
            }
            Err(error) => Err(Box::new((error, other))),
        }
    }

    /// Moves these members to a new coalition, which this agent founds, too, in one atomic change of the directory. If
    /// the leader is among them, its lock ends.
    ///
    /// # Errors
    /// If one of them is not a member, if no member would remain, if the name is invalid or taken, if the lock of the
    /// new coalition cannot be owned, or if the directory cannot be written. The coalition is then unchanged.
    pub async fn split<N: Into<Arc<str>>>(
        &self,
        name: &str,
        members: impl IntoIterator<Item = N>,
        options: CoalitionOptions,
    ) -> Result<Self, FoundError> {
        let parting: Vec<Arc<str>> = members.into_iter().map(Into::into).collect();
        let lock = Owned::begin(Arc::clone(&self.core), lock_of(name)?, options.lock).await?;
        let (founded, name) = (Arc::clone(&self.founded), name.to_owned());
        let formed = blocking(runtime_of(&self.core), move || {
            let mut entry = founded.entry.lock();
            let staying = entry.names_without(&parting)?;
            let parting = Members::vacant(parting)?;
            founded.replace(&mut entry, staying, |entry, staying| {
                entry.split_off(&name, parting, staying, options.listing)
            })
        });
        let formed = formed.await?;
        Ok(Self::start(&self.core, formed, lock))
    }

    /// Removes the name from the directory, and ends the lock of the leader.
    ///
    /// # Errors
    /// If the directory cannot be written.
    pub async fn dissolve(self) -> Result<(), FoundError> {
        let founded = Arc::clone(&self.founded);
        let removed = blocking(runtime_of(&self.core), move || {
            Ok(founded.entry.lock().remove()?)
        });
        let removed = removed.await;
        self.end().await;
        removed
    }

    /// Waits until the task has ended.
    async fn end(mut self) {
        self.task.abort();
        // It was aborted.
        let _ = (&mut self.task).await;
    }
}

impl Drop for LedCoalition {
    fn drop(&mut self) {
        self.task.abort();
    }
}

impl fmt::Debug for LedCoalition {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("LedCoalition")
            .field("entry", &*self.founded.entry.lock())
            .finish_non_exhaustive()
    }
}

fn runtime_of(core: &AgentCore) -> &Handle {
    &core.endpoint.domain.inner.service.runtime
}

/// Runs work that blocks on a thread of its own.
async fn blocking<T: Send + 'static>(
    runtime: &Handle,
    work: impl FnOnce() -> Result<T, CoalitionError> + Send + 'static,
) -> Result<T, FoundError> {
    Ok(background::run(runtime, move |_| work()).await??)
}

/// The error of founding or changing a coalition.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FoundError {
    /// The lock of the leader cannot have this name.
    #[error("the lock of the leader cannot have this name")]
    Name(#[from] NameError),
    /// The lock of the leader cannot be owned.
    #[error("the lock of the leader cannot be owned")]
    Lock(#[from] OwnError),
    /// The members are invalid, or the directory refuses the coalition.
    #[error(transparent)]
    Directory(#[from] CoalitionError),
    /// The domain is closed, or the system refuses a thread.
    #[error("the directory cannot be written")]
    Background(#[source] RegisterError),
}

impl From<BackgroundError> for FoundError {
    fn from(error: BackgroundError) -> Self {
        Self::Background(error.into())
    }
}
