//! What a machine needs for all this to work, and what is wrong with it.
//!
//! Each area has a file with one function that examines it and adds its [`Check`]s; a new area is
//! a file here and a line in [`examine`]. Examining changes nothing; the
//! network is asked who is there.

#[cfg(feature = "net")]
mod locations;
#[cfg(feature = "mdns")]
mod network;
mod place;
mod queues;
#[cfg(feature = "net")]
mod security;
#[cfg(feature = "shm")]
mod shm;

use serde::Serialize;

use crate::Config;

/// One thing that was looked at.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct Check {
    /// What it matters for, for example `shared memory`.
    pub area: &'static str,
    /// What was looked at, for example `size of /dev/shm`.
    pub check: &'static str,
    /// Whether it is as it should be.
    pub verdict: Verdict,
    /// What was found.
    pub found: String,
    /// What to do about it; none when it is fine.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub advice: Option<String>,
}

/// Whether something is as it should be, from best to worst.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum Verdict {
    /// It is.
    Fine,
    /// It works, and may fail under load, or later.
    Doubtful,
    /// Something does not work.
    Bad,
}

/// Examines everything that the configuration makes use of. Blocks for some milliseconds; for three
/// seconds when `discovery.mdns` is on, while it listens to the network.
#[must_use]
pub fn examine(config: &Config) -> Vec<Check> {
    let mut checks = Vec::new();
    place::examine(config, &mut checks);
    #[cfg(feature = "shm")]
    if config.mts.transports.contains(&crate::Kind::Shm) {
        shm::examine(config, &mut checks);
    }
    #[cfg(feature = "mdns")]
    if config.discovery.mdns {
        network::examine(config, &mut checks);
    }
    #[cfg(feature = "net")]
    locations::examine(config, &mut checks);
    #[cfg(feature = "net")]
    security::examine(config, &mut checks);
    queues::examine(config, &mut checks);
    checks
}

/// Makes the checks of one area.
pub(crate) struct Area(pub(crate) &'static str);

impl Area {
    pub(crate) fn fine(&self, check: &'static str, found: impl Into<String>) -> Check {
        Check {
            area: self.0,
            check,
            verdict: Verdict::Fine,
            found: found.into(),
            advice: None,
        }
    }

    pub(crate) fn wrong(
        &self,
        check: &'static str,
        verdict: Verdict,
        found: impl Into<String>,
        advice: impl Into<String>,
    ) -> Check {
        Check {
            verdict,
            advice: Some(advice.into()),
            ..self.fine(check, found)
        }
    }
}
