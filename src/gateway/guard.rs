//! The gateway's keys: read when it opens, and again whenever their directory changes.

use std::time::Duration;

use fipa_transport_net::secure::{Credentials, Rules, Security};

use crate::config;
use crate::domain::OpenError;
use crate::keys::{Keys, Stamp};

/// How often the directory is looked at. Looking is three calls to the system.
const LOOK: Duration = Duration::from_secs(1);

/// Keeps the keys of a gateway as they are in their directory.
pub(super) struct Guard {
    keys: Keys,
    name: String,
    security: Security,
    seen: Stamp,
}

impl Guard {
    /// Reads the keys that the configuration names, if it does.
    pub(super) fn open(config: &config::Security, name: &str) -> Result<Option<Self>, OpenError> {
        if config.keys.is_empty() {
            return Ok(None);
        }
        let keys = Keys::at(&config.keys);
        let seen = keys.stamp();
        let credentials = read(&keys, name).map_err(OpenError::Keys)?;
        let rules = Rules {
            loopback: config.loopback,
            old_peers: config.old_peers.clone(),
        };
        let security = Security::new(credentials, rules);
        let security = security.map_err(|error| OpenError::Keys(error.to_string()))?;
        Ok(Some(Self {
            keys,
            name: name.to_owned(),
            security,
            seen,
        }))
    }

    /// For the transports.
    pub(super) fn security(&self) -> Security {
        self.security.clone()
    }

    /// Looks after the directory for as long as it is polled.
    pub(super) async fn run(mut self) {
        let mut look = tokio::time::interval(LOOK);
        loop {
            look.tick().await;
            let now = self.keys.stamp();
            if now == self.seen {
                continue;
            }
            let (keys, name) = (self.keys.clone(), self.name.clone());
            let read = tokio::task::spawn_blocking(move || read(&keys, &name)).await;
            let replaced = match read {
                Ok(Ok(credentials)) => {
                    let count = credentials.trusted.len();
                    let replaced = self.security.replace(credentials);
                    replaced.map(|()| count).map_err(|error| error.to_string())
                }
                Ok(Err(error)) => Err(error),
                Err(error) => Err(error.to_string()),
            };
            match replaced {
                Ok(count) => tracing::info!(trusted = count, "the keys were read again"),
                Err(error) => {
                    tracing::warn!(
                        "the keys have changed and cannot be used: {error}; those before stay"
                    );
                }
            }
            self.seen = now;
        }
    }
}

fn read(keys: &Keys, name: &str) -> Result<Credentials, String> {
    let credentials = keys.credentials().map_err(|error| error.to_string())?;
    let certified = credentials.own.certified().mts();
    if certified != name {
        return Err(format!(
            "the certificate in {} is of {certified:?}, and `mts.name` is {name:?}: peers would refuse \
             this gateway",
            keys.dir().display()
        ));
    }
    Ok(credentials)
}
