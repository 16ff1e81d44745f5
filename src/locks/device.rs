//! A device that is not the owner of the resource whose fences it checks.

use std::fmt;
use std::sync::Arc;

use fipa_acl::Message;
use fipa_locking::{Admission, Fence, LockPeer, NotAdmitted};
use parking_lot::Mutex;

use super::shell::{self, Shared};
use super::{AdmitError, LockError, message, owned};
use crate::agent::AgentCore;

/// A check of fences by a device that is not the owner of the resource: it admits a fence that is at least
/// the highest that it has admitted ([`Admission`]).
///
/// It tells the owner this fence if the owner starts without its state file, and if the owner grants a
/// fence that the device has to refuse. The owner's next grants are then higher.
pub struct Device {
    core: Arc<AgentCore>,
    shared: Arc<Shared>,
    admission: Mutex<Admission>,
}

impl Device {
    pub(crate) fn begin(
        core: &Arc<AgentCore>,
        owner: &str,
        resource: &str,
    ) -> Result<Self, LockError> {
        let admission = Mutex::new(Admission::new(owner, resource)?);
        Ok(Self {
            shared: shell::start(core)?,
            core: Arc::clone(core),
            admission,
        })
    }

    /// Returns the highest fence that was admitted. A device that restarts passes it to
    /// [`admit`](Self::admit) first.
    #[must_use]
    pub fn highest(&self) -> Option<Fence> {
        self.admission.lock().highest().cloned()
    }

    /// Admits a fence.
    ///
    /// # Errors
    /// If a command with this fence must not be acted on.
    pub fn admit(&self, fence: &Fence) -> Result<(), AdmitError> {
        let mut admission = self.admission.lock();
        let is_new = admission.highest() != Some(fence);
        let Err(refused) = admission.check(fence) else {
            drop(admission);
            if is_new {
                self.shared.saw(&self.core, None, fence, false);
            }
            return Ok(());
        };
        let (owner, resource) = (admission.owner().to_owned(), admission.resource().clone());
        drop(admission);
        Err(match refused {
            NotAdmitted::OtherRun { highest } => {
                let directory = self.core.endpoint.domain.directory();
                let listed = owned::listed_owner(directory, &resource);
                let listed = listed
                    .and_then(|(it, _)| LockPeer::new(&it.name, it.incarnation.as_u64()).ok());
                let listed = listed.filter(|listed| listed.name() == owner);
                self.shared.saw(&self.core, listed.as_ref(), &highest, true);
                AdmitError::OtherRun {
                    fence: fence.clone(),
                    highest,
                }
            }
            NotAdmitted::Foreign => AdmitError::Missing {
                owner,
                resource: resource.as_str().to_owned(),
            },
            _ => AdmitError::Stale {
                fence: fence.clone(),
                resource: resource.as_str().to_owned(),
            },
        })
    }

    /// Admits a fence in a message, which [`Lock::guard`](super::Lock::guard) has put there, and returns it.
    ///
    /// # Errors
    /// If the message must not be acted on.
    pub fn check(&self, message: &Message) -> Result<Fence, AdmitError> {
        let (owner, resource) = {
            let admission = self.admission.lock();
            let resource = admission.resource().as_str().to_owned();
            (admission.owner().to_owned(), resource)
        };
        let mut error = AdmitError::Missing { owner, resource };
        for fence in message::fences_of(message)? {
            match self.admit(&fence) {
                Ok(()) => return Ok(fence),
                Err(AdmitError::Missing { .. }) => {}
                Err(refused) => error = refused,
            }
        }
        Err(error)
    }
}

impl fmt::Debug for Device {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Device")
            .field("admission", &*self.admission.lock())
            .finish_non_exhaustive()
    }
}
