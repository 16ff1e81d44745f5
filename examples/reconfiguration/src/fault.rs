//! The faults of a run.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// A fault that the launcher causes, or in which an agent takes part.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Fault {
    /// The item is killed while it is carried.
    ItemKilled,
    /// The link between the hosts passes nothing for 10 s.
    LinkCut,
    /// The master is stopped for longer than its lease, and goes on.
    MasterStopped,
    /// An agent sends what it may not send.
    Rogue,
    /// The operator cancels the docking.
    Cancel,
}

impl Fault {
    /// All faults.
    pub const ALL: [Self; 5] = [
        Self::ItemKilled,
        Self::LinkCut,
        Self::MasterStopped,
        Self::Rogue,
        Self::Cancel,
    ];

    /// Returns the fault that a seed decides.
    #[cfg(feature = "robots")]
    #[must_use]
    pub fn random(seed: u64) -> Self {
        let mut rng = fastrand::Rng::with_seed(seed);
        rng.choice(Self::ALL).unwrap_or(Self::Cancel)
    }

    /// Returns the name.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::ItemKilled => "item-killed",
            Self::LinkCut => "link-cut",
            Self::MasterStopped => "master-stopped",
            Self::Rogue => "rogue",
            Self::Cancel => "cancel",
        }
    }
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

impl FromStr for Fault {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let found = Self::ALL.into_iter().find(|fault| fault.as_str() == text);
        found.ok_or_else(|| format!("no fault {text:?}"))
    }
}
