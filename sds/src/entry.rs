//! Entries of the directory, and what somebody who registers has to say.

use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use fipa_transport::{Incarnation, Location};
use serde::{Deserialize, Serialize};

use crate::{Members, NameError, check_name};

/// What the directory knows about one registration.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Entry {
    /// The agent's name, unique in the directory (see [`check_name`]).
    pub name: Arc<str>,
    /// What kind of agent it is, in the words of its owner; may be empty.
    pub agent_type: String,
    /// This registration; unknown when it was learnt from a peer that has no incarnations.
    pub incarnation: Incarnation,
    /// Where it can be reached, in order of preference, each with the incarnation of the message
    /// transport service that listens there.
    pub locations: Vec<Location>,
    /// The message transport service that delivers to it.
    pub mts: Mts,
    /// Free text of its owner; may be empty.
    pub description: String,
    /// When it was registered, by the clock of the host it was registered on, in whole
    /// milliseconds.
    pub registered: SystemTime,
    /// Where this entry was learnt.
    pub source: Source,
    /// Whether it lives on this host.
    pub reach: Reach,
    /// Whether it is an agent, a gateway or a coalition.
    pub role: Role,
}

impl Entry {
    /// Most locations of one entry.
    pub const MAX_LOCATIONS: usize = 8;
    /// Longest type, in bytes.
    pub const MAX_TYPE: usize = 255;
    /// Longest description, in bytes.
    pub const MAX_DESCRIPTION: usize = 1024;

    /// Whether this entry keeps the name when `other` claims it too.
    ///
    /// What lives on this host comes before what the network says, whatever times are claimed
    /// there: a record on the network must not be able to cut a host's own traffic. Otherwise
    /// the earlier registration keeps the name, and a tie goes to the lower incarnation, so that
    /// all who know both decide alike.
    #[must_use]
    pub fn precedes(&self, other: &Self) -> bool {
        let rank = |entry: &Self| {
            let remote = entry.reach != Reach::Local;
            (remote, entry.registered, entry.incarnation)
        };
        rank(self) < rank(other)
    }

    /// Whether it has locations, but only of transports that this project does not have.
    #[must_use]
    pub fn is_unsupported(&self) -> bool {
        let supported = |location: &Location| location.kind().is_supported();
        !self.locations.is_empty() && !self.locations.iter().any(supported)
    }

    /// Whether the entry keeps to the limits that every back end relies on.
    ///
    /// # Errors
    /// Says which limit it breaks.
    pub fn check(&self) -> Result<(), EntryError> {
        check_name(&self.name)?;
        check_name(&self.mts.name).map_err(EntryError::MtsName)?;
        check_text("type", &self.agent_type, Self::MAX_TYPE)?;
        check_text("description", &self.description, Self::MAX_DESCRIPTION)?;
        if self.locations.len() > Self::MAX_LOCATIONS {
            return Err(EntryError::TooManyLocations(self.locations.len()));
        }
        Ok(())
    }
}

fn check_text(field: &'static str, text: &str, max: usize) -> Result<(), EntryError> {
    if text.len() > max {
        return Err(EntryError::TooLong {
            field,
            len: text.len(),
            max,
        });
    }
    if text.chars().any(char::is_control) {
        return Err(EntryError::Control { field });
    }
    Ok(())
}

/// A message transport service: the process that accepts letters for an agent, or the gateway.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Mts {
    /// Its name; several may have the same one.
    pub name: Arc<str>,
    /// This life of it; unknown for a peer that has no incarnations.
    pub incarnation: Incarnation,
}

impl Mts {
    /// A service with this name and incarnation.
    #[must_use]
    pub fn new(name: impl Into<Arc<str>>, incarnation: Incarnation) -> Self {
        Self {
            name: name.into(),
            incarnation,
        }
    }
}

/// Where an entry was learnt.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum Source {
    /// Registered in this process.
    Memory,
    /// Written in the configuration.
    Static,
    /// Told by a process of this host.
    Host,
    /// Announced on the network.
    Mdns,
    /// Told by the gateway of another host, in a letter.
    Exchange,
    /// It has written.
    Contact,
}

/// Whether an agent lives on this host.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Reach {
    /// On this host, without anybody in between.
    Local,
    /// Beyond a gateway.
    Remote {
        /// The gateway that takes letters for it: the host's own when that has published the
        /// entry, else the peer itself. Unknown for a peer that has no incarnations.
        gateway: Incarnation,
    },
}

/// Who stands behind an entry.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum Role {
    /// Somebody to exchange letters with.
    #[default]
    Agent,
    /// A message transport service that forwards for others. Patterns do not match it.
    Gateway,
    /// A name that stands for these agents, or for their leader. Patterns do not match it: they
    /// match its members.
    Coalition(Members),
}

/// What the owner of an agent says when registering it.
///
/// Registering again with the same name and incarnation changes the entry.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Registration {
    /// See [`Entry::name`].
    pub name: Arc<str>,
    /// See [`Entry::agent_type`].
    pub agent_type: String,
    /// See [`Entry::incarnation`].
    pub incarnation: Incarnation,
    /// See [`Entry::locations`].
    pub locations: Vec<Location>,
    /// See [`Entry::description`].
    pub description: String,
    /// See [`Entry::registered`]; cut to whole milliseconds.
    pub registered: SystemTime,
    /// See [`Entry::role`].
    pub role: Role,
}

impl Registration {
    /// A registration as of now, of an agent without type and description.
    #[must_use]
    pub fn new(
        name: impl Into<Arc<str>>,
        incarnation: Incarnation,
        locations: Vec<Location>,
    ) -> Self {
        Self {
            name: name.into(),
            agent_type: String::new(),
            incarnation,
            locations,
            description: String::new(),
            registered: SystemTime::now(),
            role: Role::Agent,
        }
    }

    /// The entry that this registration makes at a service.
    pub(crate) fn into_entry(self, mts: &Mts, source: Source) -> Result<Entry, EntryError> {
        if !self.incarnation.is_known() {
            return Err(EntryError::NoIncarnation);
        }
        let entry = Entry {
            name: self.name,
            agent_type: self.agent_type,
            incarnation: self.incarnation,
            locations: self.locations,
            mts: mts.clone(),
            description: self.description,
            registered: time_of_millis(millis_of_time(self.registered)),
            source,
            reach: Reach::Local,
            role: self.role,
        };
        entry.check()?;
        Ok(entry)
    }
}

/// What is wrong with an entry.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum EntryError {
    /// The name of the agent.
    #[error(transparent)]
    Name(#[from] NameError),
    /// The name of its message transport service.
    #[error("message transport service: {0}")]
    MtsName(#[source] NameError),
    /// A text is too long.
    #[error("the {field} has {len} bytes; at most {max} are allowed")]
    TooLong {
        /// Which one.
        field: &'static str,
        /// Its length in bytes.
        len: usize,
        /// The limit.
        max: usize,
    },
    /// A text has control characters.
    #[error("the {field} has control characters; remove them")]
    Control {
        /// Which one.
        field: &'static str,
    },
    /// There are more than [`Entry::MAX_LOCATIONS`].
    #[error("{0} locations; at most {max} are allowed", max = Entry::MAX_LOCATIONS)]
    TooManyLocations(usize),
    /// A registration without an incarnation.
    #[error("a registration needs an incarnation (draw one with Incarnation::random)")]
    NoIncarnation,
}

/// Milliseconds since 1970, UTC; 0 for what is earlier.
pub(crate) fn millis_of_time(time: SystemTime) -> u64 {
    let since = time.duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_millis())
        .unwrap_or(MAX_MILLIS)
        .min(MAX_MILLIS)
}

/// The year 9999, beyond which calendars do not reach.
const MAX_MILLIS: u64 = 253_370_764_800_000;

/// The time that many milliseconds after 1970, UTC; what is beyond the year 9999 is cut to it.
pub(crate) fn time_of_millis(millis: u64) -> SystemTime {
    UNIX_EPOCH + Duration::from_millis(millis.min(MAX_MILLIS))
}
