//! Locks: agents reserve a resource before they use it, and the resource refuses agents whose lock was
//! lost.
//!
//! The owner of a resource is the agent whose hardware it is. It grants the resource to one agent at a
//! time, with a [`Fence`] and a lease, in the order of their requests. With agents of the C++ library
//! `distributed_locking`, a distributed algorithm decides which agent asks next. What the algorithms get wrong under
//! loss and partition costs fairness and time, not safety (`fipa-locking`).
//!
//! ```no_run
//! # async fn example(crane: fipa::Agent, rover: fipa::Agent)
//! #     -> Result<(), Box<dyn std::error::Error>> {
//! use std::time::Duration;
//!
//! use fipa::locks::OwnOptions;
//! use fipa::{AgentId, Performative};
//!
//! // The owner, in the process that moves the hardware.
//! let bay = crane.own("bay", OwnOptions::default()).await?;
//!
//! // Another agent, in any process of any host.
//! let lock = rover.lock_within("bay", Duration::from_secs(10)).await?;
//! let dock = rover.message(Performative::Request).receiver(AgentId::new("crane")?);
//! rover.send(lock.guard(dock).content("(dock)").build()?).await?;
//!
//! // The owner acts on commands with the fence of the live grant only.
//! let command = crane.receive().await?;
//! let fence = bay.check(command.message())?;
//! println!("{fence} may use the bay");
//! # Ok(())
//! # }
//! ```
//!
//! A holder that is suspended, cut off or slow loses its lock when the lease ends, and its late commands
//! have a fence that the owner refuses. [`Lock::is_held`] is advisory for effects that the owner does not
//! guard.
//!
//! [`Agent::use_locks`], or the first call of an agent that needs locks, starts them: a task that answers the messages
//! of other agents. With Ricart-Agrawala, the first request waits until the agents that the directory lists have
//! answered a greeting, or for [`LockOptions::retry`]. Messages of locks never reach [`Agent::receive`]. An agent that
//! sets 1,024 received messages aside without reading them receives no renewals, and loses its locks.

mod clock;
mod device;
mod error;
mod greetings;
mod lock;
mod message;
mod owned;
mod report;
mod shell;
mod state_file;

use std::sync::Arc;
use std::time::Duration;

pub use fipa_locking::{
    Admission, Algorithm, Ending, Fence, FenceError, NameError, NotAdmitted, OptionsError,
    OwnerStateError, Refusal,
};

use fipa_locking::{LockStatus, Options, Resource};

use crate::agent::{Agent, AgentCore};

pub use self::device::Device;
pub use self::error::{LockError, OwnError};
pub use self::lock::Lock;
pub use self::message::{AdmitError, FENCE, fences_of, with_fences};
pub(crate) use self::owned::listed_owner;
pub use self::owned::{ENTRY_PREFIX, OwnOptions, Owned, OwnerEvent};
pub use self::report::ResourceStatus;
pub use self::state_file::StateFileError;

/// The options of an agent's locks; see [`Agent::use_locks`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LockOptions {
    /// The algorithm of the resources that this agent owns. With the default, the owner's queue, this agent uses
    /// the algorithm that the owner of each resource names. With another one, it uses no resource whose owner names
    /// another algorithm ([`LockError::OtherAlgorithm`]).
    pub algorithm: Algorithm,
    /// The algorithm with agents of the C++ library `distributed_locking`, if [`algorithm`](Self::algorithm) is the
    /// owner's queue, in which they cannot take part (the extended Ricart-Agrawala): at a resource of such an agent,
    /// and, with [`legacy_peers`](Self::legacy_peers), at the resources that this agent owns.
    pub legacy_algorithm: Algorithm,
    /// Time in which an existing owner can contradict a new one (1 s).
    pub claim: Duration,
    /// Maximum time to find the owner of a resource (2 s).
    pub discovery: Duration,
    /// Time without a message after which an agent that others wait for is probed (5 s).
    pub probe_interval: Duration,
    /// Time without an answer to a probe after which an agent is left out (2 s).
    pub probe_timeout: Duration,
    /// Time after which a request without an answer is repeated, the round of [`Agent::try_lock`], and with
    /// Ricart-Agrawala the maximum wait for the answers to greetings before the first request (1 s).
    pub retry: Duration,
    /// Whether agents of legacy platforms and static peers are asked whether they use locks (`false`), and the
    /// resources of this agent have an algorithm of the C++ library `distributed_locking`. Its agents then take part
    /// from the start. Otherwise they take part from their first message, at resources with such an algorithm. Other
    /// legacy agents receive a `request` with the protocol `dlm_probe`.
    pub legacy_peers: bool,
}

impl Default for LockOptions {
    fn default() -> Self {
        let core = Options::default();
        Self {
            algorithm: Algorithm::default(),
            legacy_algorithm: core.legacy_algorithm,
            claim: Duration::from_millis(core.claim),
            discovery: Duration::from_millis(core.discovery),
            probe_interval: Duration::from_millis(core.probe_interval),
            probe_timeout: Duration::from_millis(core.probe_timeout),
            retry: Duration::from_millis(core.retry),
            legacy_peers: false,
        }
    }
}

impl LockOptions {
    fn core(&self) -> Options {
        let mut core = Options::default();
        core.claim = clock::millis(self.claim);
        core.discovery = clock::millis(self.discovery);
        core.probe_interval = clock::millis(self.probe_interval);
        core.probe_timeout = clock::millis(self.probe_timeout);
        core.retry = clock::millis(self.retry);
        core.legacy_algorithm = self.legacy_algorithm;
        core.legacy_peers = self.legacy_peers;
        core
    }
}

impl Agent {
    /// Sets the options of this agent's locks, and starts them. From then on, the agent answers the requests of
    /// others. Without this call, the first one that needs locks starts them with the defaults.
    ///
    /// # Errors
    /// If the agent has been deregistered, if a time is zero or longer than a day, or if the agent has used locks
    /// already.
    pub fn use_locks(&self, options: LockOptions) -> Result<(), LockError> {
        shell::set(&self.core, options)
    }

    /// Returns the resources that this agent owns, holds or waits for, and those of other agents that it
    /// has heard of, sorted by name.
    #[must_use]
    pub fn locks(&self) -> Vec<ResourceStatus> {
        let Some(shared) = shell::started(&self.core) else {
            return Vec::new();
        };
        shared.read(|core, now| {
            let all = core.status(now);
            all.map(|status: LockStatus| ResourceStatus::of(&status, core.me(), now))
                .collect()
        })
    }

    /// Asks the owners of all resources in the directory for their state, and waits for their answers
    /// up to `timeout`. A resource whose owner does not answer is listed without details.
    ///
    /// # Errors
    /// If the agent was deregistered.
    pub async fn query_locks(&self, timeout: Duration) -> Result<Vec<ResourceStatus>, LockError> {
        report::query(&self.core, timeout).await
    }

    /// Requests a resource, and waits until this agent holds it. Dropping the future withdraws the
    /// request.
    ///
    /// ```no_run
    /// # async fn example(agent: fipa::Agent) -> Result<(), fipa::locks::LockError> {
    /// let lock = agent.lock("bay").await?;
    /// println!("the bay is ours with fence {:?}", lock.fence());
    /// lock.release();
    /// # Ok(())
    /// # }
    /// ```
    ///
    /// # Errors
    /// If no agent owns the resource, the owner is lost or refuses, or the agent was deregistered.
    pub async fn lock(&self, resource: &str) -> Result<Lock, LockError> {
        acquire(&self.core, Resource::new(resource)?).await
    }

    /// Requests a resource, and withdraws the request after `within`.
    ///
    /// # Errors
    /// As for [`lock`](Self::lock), and [`LockError::TimedOut`] or [`LockError::OwnerNotFound`].
    pub async fn lock_within(&self, resource: &str, within: Duration) -> Result<Lock, LockError> {
        let resource = Resource::new(resource)?;
        Lock::acquire(&self.core, vec![resource], |core, now, all, out| {
            core.lock_all(now, all, Some(clock::millis(within)), out)
        })
        .await
    }

    /// Requests a resource, and withdraws the request after one round of messages
    /// ([`LockOptions::retry`]), or at once if the resource is in use by this agent.
    ///
    /// # Errors
    /// As for [`lock_within`](Self::lock_within).
    pub async fn try_lock(&self, resource: &str) -> Result<Lock, LockError> {
        let resource = Resource::new(resource)?;
        Lock::acquire(&self.core, vec![resource], |core, now, all, out| {
            core.try_lock(now, &all[0], out)
        })
        .await
    }

    /// Requests several resources, and waits until this agent holds all of them. They are acquired in
    /// the order of their names, so that agents do not wait for each other. If one is lost, all are
    /// released.
    ///
    /// # Errors
    /// As for [`lock`](Self::lock). The agent then holds none of them.
    pub async fn lock_all(&self, resources: &[&str]) -> Result<Lock, LockError> {
        self.lock_all_or_time_out(resources, None).await
    }

    /// Requests several resources, and withdraws the request after `within`; see
    /// [`lock_all`](Self::lock_all).
    ///
    /// # Errors
    /// As for [`lock_within`](Self::lock_within). The agent then holds none of them.
    pub async fn lock_all_within(
        &self,
        resources: &[&str],
        within: Duration,
    ) -> Result<Lock, LockError> {
        self.lock_all_or_time_out(resources, Some(clock::millis(within)))
            .await
    }

    async fn lock_all_or_time_out(
        &self,
        resources: &[&str],
        within: Option<u64>,
    ) -> Result<Lock, LockError> {
        let resources: Result<Vec<_>, _> = resources.iter().map(|it| Resource::new(it)).collect();
        Lock::acquire(&self.core, resources?, |core, now, all, out| {
            core.lock_all(now, all, within, out)
        })
        .await
    }

    /// Begins to own a resource: other agents can lock it, and this agent admits commands of the holder
    /// only. Waits for [`LockOptions::claim`], in which an existing owner can contradict.
    ///
    /// The directory lists the owner under `lock:` and the name of the resource, so a message to that
    /// name reaches it.
    ///
    /// # Errors
    /// If the state file cannot be written, unless [`OwnOptions::volatile`] is set; if another agent
    /// owns the resource; if an option is out of bounds; [`OwnError::NoMemory`].
    pub async fn own(&self, resource: &str, options: OwnOptions) -> Result<Owned, OwnError> {
        Owned::begin(Arc::clone(&self.core), Resource::new(resource)?, options).await
    }

    /// Returns a check of the fences that `owner` grants for a resource, for a device of this agent. The
    /// owner itself checks fences with [`Owned`].
    ///
    /// # Errors
    /// If the name of the resource is not valid, or the agent was deregistered.
    pub fn device(&self, owner: &str, resource: &str) -> Result<Device, LockError> {
        Device::begin(&self.core, owner, resource)
    }
}

/// Requests a resource, and waits until the agent holds it.
pub(crate) async fn acquire(core: &Arc<AgentCore>, resource: Resource) -> Result<Lock, LockError> {
    Lock::acquire(core, vec![resource], |core, now, all, out| {
        core.lock_all(now, all, None, out)
    })
    .await
}
