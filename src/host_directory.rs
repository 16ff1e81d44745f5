//! Joining the directory of the host.

use std::sync::Arc;

use fipa_sds::{HostConfig, HostDirectory, HostError};

use crate::error::OpenError;
use crate::place::{Place, RETRIES};

/// Makes the directory of the domain and joins the directory of the host in it.
pub(crate) fn join(
    domain: &str,
    own: &fipa_sds::Mts,
    gateway: bool,
) -> Result<(Place, Arc<HostDirectory>), OpenError> {
    let mut tries = 0;
    loop {
        tries += 1;
        let mut place = Place::prepare(domain)?;
        let joined = HostDirectory::open(HostConfig {
            dir: place.part("directory"),
            mts: own.clone(),
            gateway,
        });
        match joined {
            Ok(host) => {
                // Only now: a process that leaves may still remove an empty directory.
                place.hold()?;
                return Ok((place, Arc::new(host)));
            }
            Err(error) if was_removed(&error) && tries < RETRIES => {}
            Err(error) => {
                place.leave();
                return Err(error.into());
            }
        }
    }
}

/// Whether the last process that left removed the directory between its creation and the join.
fn was_removed(error: &HostError) -> bool {
    match error {
        HostError::Io { source, .. } => source.kind() == std::io::ErrorKind::NotFound,
        HostError::Removed { .. } => true,
        _ => false,
    }
}
