//! The owner of a resource.

use std::fmt;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use fipa_acl::{ErrorChain, Message};
use fipa_locking::{Algorithm, Ending, Fence, Grant, Options, OwnerState, Resource};
use fipa_sds::{Cancellation, Entry, Members, RegisterError, Role};
use fipa_transport::{Incarnation, log_limit};
use parking_lot::Mutex;

use super::shell::{self, Shared};
use super::state_file::StateFile;
use super::{AdmitError, LockError, OwnError, ResourceStatus, clock, message};
use crate::agent::AgentCore;
use crate::domain::background;
use crate::error::CoalitionError;
use crate::{Coalition, DirectoryView, RegisterOptions};

/// Type of the directory's entry of an owned resource.
pub(super) const TYPE: &str = "fipa-lock";

/// Beginning of the name of the directory's entry of an owned resource; the name of the resource
/// follows.
pub const ENTRY_PREFIX: &str = "lock:";

/// The options of [`Agent::own`](crate::Agent::own).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OwnOptions {
    /// Lease of a grant (15 s). A holder that ends without a proof delays the next one for this time. A
    /// holder renews its grant three times per lease.
    pub lease: Duration,
    /// Directory of the state files. By default `FIPA_STATE_DIR`, else `fipa` in `XDG_STATE_HOME`, else
    /// `~/.local/state/fipa`.
    pub state_dir: Option<PathBuf>,
    /// Whether to do without a state file. Each start is then one without a file.
    ///
    /// An owner that starts without a file grants nothing for one lease, and for at least 15 s. Earlier runs
    /// should not have had a longer lease. Its fences rise with the time of day, and above those that agents
    /// and devices ([`Device`](super::Device)) report.
    pub volatile: bool,
    /// Whether an owner without a file grants at once, because no lock of an earlier run is in use and no
    /// device has seen its fences: the first start. It changes nothing if there is a file.
    ///
    /// Without it, an owner without a file whose clock shows a time before this release, and to which no
    /// agent or device reports a fence, cannot own the resource ([`OwnError::NoMemory`]).
    pub forget: bool,
}

impl Default for OwnOptions {
    fn default() -> Self {
        Self {
            lease: Duration::from_millis(Options::default().lease),
            state_dir: None,
            volatile: false,
            forget: false,
        }
    }
}

/// An event at the owner of a resource.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum OwnerEvent {
    /// An agent holds the resource.
    Granted {
        /// The name of the holder.
        holder: String,
        /// The fence. An agent of the C++ library `distributed_locking` has none.
        fence: Option<Fence>,
    },
    /// A grant has ended.
    Ended {
        /// The name of the holder.
        holder: String,
        /// The fence.
        fence: Option<Fence>,
        /// The reason.
        how: Ending,
    },
    /// Another agent claims the resource. Each owner admits its own fences only.
    Contested {
        /// The name of the other agent.
        by: String,
    },
    /// A holder without a lease, an agent of the C++ library, does not answer. [`Owned::force`] ends its
    /// grant.
    Silent {
        /// The name of the holder.
        holder: String,
    },
}

impl OwnerEvent {
    pub(super) fn granted(grant: Grant) -> Self {
        Self::Granted {
            holder: grant.holder.name().to_owned(),
            fence: grant.fence,
        }
    }

    pub(super) fn ended(grant: Grant, how: Ending) -> Self {
        Self::Ended {
            holder: grant.holder.name().to_owned(),
            fence: grant.fence,
            how,
        }
    }
}

/// The state of an ownership.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Holding {
    Preparing,
    Owner,
    Refused(String),
    /// No fence is known to be higher than those of earlier runs.
    NoMemory,
    /// The agent was deregistered.
    Closed,
}

/// A resource that this agent owns. Dropping it ends the ownership: the live grant's fence is refused
/// from then on.
#[must_use = "dropping it ends the ownership"]
pub struct Owned {
    core: Arc<AgentCore>,
    shared: Arc<Shared>,
    resource: Resource,
    files: Option<Files>,
}

/// The parts of an ownership that are files.
struct Files {
    /// The entry of the directory, if the name of the resource permits one.
    listed: Option<Coalition>,
    state: Option<Arc<Mutex<StateFile>>>,
    life: OwnerState,
}

impl Files {
    fn close(self, none_was_live: bool) {
        drop(self.listed);
        if let Some(state) = self.state {
            state.lock().end(none_was_live);
        }
    }
}

impl Owned {
    pub(crate) async fn begin(
        core: Arc<AgentCore>,
        resource: Resource,
        options: OwnOptions,
    ) -> Result<Self, OwnError> {
        let lease = clock::millis(options.lease);
        let mut bounds = Options::default();
        bounds.lease = lease;
        bounds.check()?;
        let shared = shell::start(&core)?;
        let Some(mut holding) = shared.reserve(&resource) else {
            let resource = resource.as_str().to_owned();
            return Err(OwnError::AlreadyOwned { resource });
        };
        let mut owned = Self {
            core,
            shared,
            resource: resource.clone(),
            files: None,
        };
        let agent = Arc::clone(&owned.core);
        let service = &owned.core.endpoint.domain.inner.service;
        let algorithm = owned.shared.read(|locks, _| locks.own_algorithm());
        let prepared = background::run(&service.runtime, move |cancellation| {
            prepare(&agent, &resource, &options, algorithm, cancellation)
        });
        let files = prepared.await.map_err(LockError::from)??;
        let life = files.life;
        let file = files.state.as_ref().map(Arc::downgrade);
        owned.files = Some(files);
        owned.shared.raise_in(&owned.core, &owned.resource, file);
        owned.shared.own(&owned.core, &owned.resource, &life, lease);
        let decided = holding.wait_for(|now| *now != Holding::Preparing).await;
        let decided = decided.map_or(Holding::Closed, |now| now.clone());
        match decided {
            Holding::Owner => Ok(owned),
            Holding::Refused(owner) => Err(OwnError::Taken {
                resource: owned.resource.as_str().to_owned(),
                owner,
            }),
            Holding::NoMemory => Err(OwnError::NoMemory {
                resource: owned.resource.as_str().to_owned(),
            }),
            Holding::Preparing | Holding::Closed => Err(LockError::Closed.into()),
        }
    }

    /// Returns the name of the resource.
    #[must_use]
    pub fn resource(&self) -> &str {
        self.resource.as_str()
    }

    /// Whether a command with this fence is carried out: only with the fence of the live grant.
    #[must_use]
    pub fn admit(&self, fence: &Fence) -> bool {
        let resource = &self.resource;
        self.shared
            .read(|locks, now| locks.admit(now, resource, fence))
    }

    /// Checks the fence in a message, which [`Lock::guard`](super::Lock::guard) has put there. Returns
    /// the fence of the live grant.
    ///
    /// # Errors
    /// If the message must not be acted on.
    pub fn check(&self, message: &Message) -> Result<Fence, AdmitError> {
        let owner = &*self.core.endpoint.name;
        let mut fences = message::fences_of(message)?;
        fences.retain(|fence| fence.owner() == owner && fence.resource() == self.resource.as_str());
        // A message may have an old fence beside the live one.
        if let Some(at) = fences.iter().position(|fence| self.admit(fence)) {
            return Ok(fences.swap_remove(at));
        }
        let resource = self.resource.as_str().to_owned();
        Err(match fences.pop() {
            Some(fence) => AdmitError::Stale { fence, resource },
            None => AdmitError::Missing {
                owner: owner.to_owned(),
                resource,
            },
        })
    }

    /// Returns the time in which the owner grants nothing, because a lock of an earlier run may be in use.
    #[must_use]
    pub fn silence(&self) -> Duration {
        self.shared.read(|locks, now| {
            let core = locks.owner(&self.resource);
            Duration::from_millis(core.map_or(0, |core| core.silence(now)))
        })
    }

    /// Returns the present state: holder, fence, lease and waiting agents.
    #[must_use]
    pub fn status(&self) -> ResourceStatus {
        self.shared.read(|locks, now| {
            let mut all = locks.status(now);
            let status = all.find(|status| status.resource == self.resource);
            match status {
                Some(status) => ResourceStatus::of(&status, locks.me(), now),
                None => ResourceStatus::unknown(self.resource.as_str(), None),
            }
        })
    }

    /// Waits for the next event; `None` when the agent is deregistered. At most 256 events wait; then
    /// the earliest is dropped. Dropping the future loses no event.
    pub async fn next(&self) -> Option<OwnerEvent> {
        self.shared.next_event(&self.resource).await
    }

    /// Ends the live grant, for a holder of the C++ library `distributed_locking` that does not answer.
    /// That agent is not told, so stop it first.
    pub fn force(&self) {
        self.shared.force(&self.core, &self.resource);
    }

    /// Ends the ownership, and waits until the state file is written. The next start then grants at
    /// once if no grant is live now.
    pub async fn release(mut self) {
        let none_was_live = self.shared.disown(&self.core, &self.resource);
        let Some(files) = self.files.take() else {
            return;
        };
        let runtime = &self.core.endpoint.domain.inner.service.runtime;
        background::finish(runtime, move || files.close(none_was_live)).await;
    }
}

impl Drop for Owned {
    fn drop(&mut self) {
        // In a forked child, the resource still belongs to the parent.
        if !self.core.endpoint.domain.inner.owner.is_this() {
            std::mem::forget(self.files.take());
            return;
        }
        let none_was_live = self.shared.disown(&self.core, &self.resource);
        if let Some(files) = self.files.take() {
            let runtime = &self.core.endpoint.domain.inner.service.runtime;
            drop(background::finish(runtime, move || {
                files.close(none_was_live)
            }));
        }
    }
}

impl fmt::Debug for Owned {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Owned")
            .field("resource", &self.resource)
            .finish_non_exhaustive()
    }
}

/// Writes the state file and the entry of the directory. Blocks.
fn prepare(
    core: &AgentCore,
    resource: &Resource,
    options: &OwnOptions,
    algorithm: Algorithm,
    cancellation: &Cancellation,
) -> Result<Files, OwnError> {
    let domain = &core.endpoint.domain;
    let lease = clock::millis(options.lease);
    let (run, seconds) = (Incarnation::random().as_u64(), clock::time_of_day());
    let without_file = match options.forget {
        true => OwnerState::first().next_life(lease),
        false => OwnerState::without_memory(lease),
    };
    let state = match options.volatile {
        true => None,
        false => Some(StateFile::begin(
            options.state_dir.as_deref(),
            [
                domain.inner.service.domain_name(),
                &core.endpoint.name,
                resource.as_str(),
            ],
            lease,
            without_file,
            seconds,
        )?),
    };
    let life = match &state {
        Some(file) => file.state(),
        None => without_file.with_clock(seconds),
    };
    let life = life.with_run(run);
    let state = state.map(|file| Arc::new(Mutex::new(file)));
    let listing = RegisterOptions {
        agent_type: TYPE.to_owned(),
        description: algorithm.protocol().to_owned(),
    };
    let owner = Arc::clone(&core.endpoint.name);
    let members = Members::new([owner], None).map_err(CoalitionError::from);
    let listed = members.and_then(|members| {
        domain.form_unless(&entry_name(resource), members, listing, cancellation)
    });
    let listed = match listed {
        Ok(listed) => Some(listed),
        Err(CoalitionError::Register(RegisterError::AlreadyRegistered { holder })) => {
            let owner = listed_members(&holder).unwrap_or(&holder.name);
            return Err(OwnError::Taken {
                resource: resource.as_str().to_owned(),
                owner: owner.to_string(),
            });
        }
        // The owner is found by messages. Not every name of a resource is one of an agent.
        Err(error) => {
            log_limit::info!(
                error = %ErrorChain(&error), "a resource is not listed in the directory"
            );
            None
        }
    };
    Ok(Files {
        listed,
        state,
        life,
    })
}

fn entry_name(resource: &Resource) -> String {
    format!("{ENTRY_PREFIX}{resource}")
}

fn listed_members(entry: &Entry) -> Option<&Arc<str>> {
    match &entry.role {
        Role::Coalition(members) => members.names().first(),
        _ => None,
    }
}

/// Returns the resource and the owner of a directory's entry, if it is that of an owned resource. Only
/// the owner's own process can list it.
pub(super) fn listed(
    directory: DirectoryView<'_>,
    entry: &Entry,
) -> Option<(Resource, Arc<Entry>)> {
    let resource = entry.name.strip_prefix(ENTRY_PREFIX)?;
    if entry.agent_type != TYPE {
        return None;
    }
    let owner = directory.known(listed_members(entry)?)?;
    let is_own = owner.incarnation.is_known() && owner.mts.incarnation == entry.mts.incarnation;
    let resource = Resource::new(resource).ok()?;
    is_own.then_some((resource, owner))
}

/// Returns the owner of a resource and the algorithm that it names, if the directory lists it.
pub(crate) fn listed_owner(
    directory: DirectoryView<'_>,
    resource: &Resource,
) -> Option<(Arc<Entry>, Option<Algorithm>)> {
    let entry = directory.lookup(&entry_name(resource))?;
    let (_, owner) = listed(directory, &entry)?;
    Some((owner, Algorithm::named(&entry.description)))
}
