//! A process that takes part in the directory of a domain without agents, to reach the processes of the domain.

use std::sync::Arc;

use fipa_acl::ErrorChain;
use fipa_sds::{HostDirectory, MtsId};
use fipa_transport::{Incarnation, log_limit};
use tokio::runtime::Handle;

use crate::Config;
use crate::domain::background;
use crate::domain::files::DomainDir;
use crate::domain::membership::{self, Membership};
use crate::domain::process::Owner;
use crate::error::OpenError;

/// Membership in the directory of a domain. Dropping it leaves the domain.
pub(super) struct Member {
    pub(super) host: Arc<HostDirectory>,
    pub(super) dir: DomainDir,
    owner: Owner,
}

impl Member {
    /// Joins the domain that the configuration names. Waits for other processes on a thread of its own; dropping the
    /// future ends the wait. Must be called within a tokio runtime.
    ///
    /// # Errors
    /// If the configuration is invalid, or the directory of the domain cannot be used.
    pub(super) async fn join(config: &Config, role: &str) -> Result<Self, OpenError> {
        config.check()?;
        let runtime = Handle::try_current().map_err(|_| OpenError::NoRuntime)?;
        let name = format!("fipa-{role}-{}", std::process::id());
        let own = MtsId::new(name, Incarnation::random());
        let config = config.clone();
        let joined = background::run(&runtime, move |cancellation| {
            let (dir, host) = membership::join(&config, &own, Membership::default(), cancellation)?;
            let owner = Owner::this();
            Ok(Self { host, dir, owner })
        });
        joined.await?
    }

    /// Whether this process has joined: in a forked child, everything still belongs to the parent.
    pub(super) fn is_own(&self) -> bool {
        self.owner.is_this()
    }
}

impl Drop for Member {
    fn drop(&mut self) {
        if !self.is_own() {
            return;
        }
        if let Err(error) = self.host.close() {
            log_limit::warn!(error = %ErrorChain(&error), "cannot remove this process from the directory of this host");
        }
        self.dir.leave();
    }
}
