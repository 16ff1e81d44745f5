//! Joining the directory of the host.

use std::sync::Arc;

use fipa_sds::{Cancellation, HostConfig, HostDirectory, HostError, Role};
use fipa_transport::DirectoryError;

use crate::domain::files::{DomainDir, RETRIES};
use crate::error::OpenError;
use crate::{Config, Domain, Entry};

impl Domain {
    /// Returns the names of the agents of a domain that its processes on this host list, sorted, without
    /// joining the domain: it takes milliseconds, creates nothing and waits for no process. With a running
    /// gateway the agents of other hosts are included. Meant for the completion of command lines.
    ///
    /// # Errors
    /// If the directory of the domain cannot be used.
    pub fn names(config: &Config) -> Result<Vec<String>, OpenError> {
        let entries = Self::peek(config)?;
        let mut names: Vec<String> = entries.iter().map(|entry| entry.name.to_string()).collect();
        names.dedup();
        Ok(names)
    }

    /// Returns the name of the gateway that runs on this host in the domain of the configuration, without
    /// joining the domain, as [`names`](Self::names) does.
    ///
    /// # Errors
    /// If the directory of the domain cannot be used.
    pub fn gateway_name(config: &Config) -> Result<Option<String>, OpenError> {
        let entries = Self::peek(config)?;
        let mut gateways = entries.iter().filter(|entry| entry.role == Role::Gateway);
        Ok(gateways.next().map(|gateway| gateway.name.to_string()))
    }

    /// Reads the directory of a domain without joining the domain. The result is sorted by name.
    pub(crate) fn peek(config: &Config) -> Result<Vec<Arc<Entry>>, OpenError> {
        let dir = DomainDir::of(config);
        if !dir.exists()? {
            return Ok(Vec::new());
        }
        Ok(HostDirectory::peek(&dir.part("directory"), dir.users()?)?)
    }
}

/// The kind of membership in the directory of the host.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Membership {
    /// Whether the process may publish agents of other hosts.
    pub(crate) gateway: bool,
    /// Whether the process is likely to end within a second.
    pub(crate) brief: bool,
}

/// Creates the directory of the domain and joins the agent directory of the host in it.
pub(crate) fn join(
    config: &Config,
    own: &fipa_sds::MtsId,
    Membership { gateway, brief }: Membership,
    cancellation: &Cancellation,
) -> Result<(DomainDir, Arc<HostDirectory>), OpenError> {
    let mut tries = 0;
    loop {
        tries += 1;
        let mut dir = DomainDir::prepare(config)?;
        let host = HostConfig {
            dir: dir.part("directory"),
            users: dir.users()?,
            mts: own.clone(),
            gateway,
            brief,
        };
        let joined = HostDirectory::open_unless(host, cancellation);
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
        HostError::Io { source, .. } | HostError::Directory(DirectoryError::Io { source, .. }) => {
            source.kind() == std::io::ErrorKind::NotFound
        }
        HostError::Removed { .. } => true,
        _ => false,
    }
}
