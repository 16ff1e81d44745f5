//! Joining the directory of the host.

use std::sync::Arc;

use fipa_sds::{Cancellation, HostConfig, HostDirectory, HostError};

use crate::domain_dir::{DomainDir, RETRIES};
use crate::error::OpenError;

/// Creates the directory of the domain and joins the agent directory of the host in it.
pub(crate) fn join(
    domain: &str,
    own: &fipa_sds::Mts,
    gateway: bool,
    cancellation: &Cancellation,
) -> Result<(DomainDir, Arc<HostDirectory>), OpenError> {
    let mut tries = 0;
    loop {
        tries += 1;
        let mut dir = DomainDir::prepare(domain)?;
        let config = HostConfig {
            dir: dir.part("directory"),
            mts: own.clone(),
            gateway,
        };
        let joined = HostDirectory::open_unless(config, cancellation);
        match joined {
            Ok(host) => {
                // Not earlier, because a leaving process may still remove an empty directory.
                dir.lock()?;
                return Ok((dir, Arc::new(host)));
            }
            Err(error) if was_removed(&error) && tries < RETRIES => {}
            Err(error) => {
                dir.leave();
                return Err(error.into());
            }
        }
    }
}

/// Whether the error means that a leaving process removed the directory between creation and join.
fn was_removed(error: &HostError) -> bool {
    match error {
        HostError::Io { source, .. } => source.kind() == std::io::ErrorKind::NotFound,
        HostError::Removed { .. } => true,
        _ => false,
    }
}
