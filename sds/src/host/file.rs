//! The format of an entries file: one JSON object.
//!
//! ```json
//! {"format":"fipa-directory","version":1,"mts":{"name":"arm-mts","incarnation":"00ab…"},
//!  "entries":[{"name":"arm_left","type":"gripper","incarnation":"00cd…",
//!    "locations":["shm://…#00ab…"],"description":"…","registered":1795172400000,"role":"agent"}]}
//! ```
//! `registered` is in milliseconds since 1970, UTC. An entry of an agent on another host, which
//! only a gateway writes, has a `remote` with the message transport service of the agent; the
//! gateway is the `mts` of the file. A gateway may also write `lost`: the last entries of agents of
//! other hosts whose gateway fell silent.
//!
//! A process of the same user writes the file, which does not make it trustworthy: everything is
//! checked, and a file with any error is rejected as a whole.

use std::collections::HashMap;
use std::sync::Arc;

use fipa_transport::{Incarnation, Location};
use serde::{Deserialize, Serialize};

use crate::entry::{millis_of_time, time_of_millis};
use crate::{Entry, EntryError, Mts, Reach, Role, Source};

const FORMAT: &str = "fipa-directory";
const VERSION: u32 = 1;

/// The entries of one process, by name.
pub(super) type Entries = HashMap<Arc<str>, Arc<Entry>>;

/// Maximum number of entries in one file.
pub(super) const MAX_ENTRIES: usize = 65_536;

/// Entries read from a file.
#[derive(Debug, Default)]
pub(super) struct Read {
    pub(super) entries: Entries,
    /// The [lost agents](crate::Directory::lost_agents).
    pub(super) lost: Vec<Arc<Entry>>,
}

pub(super) fn write<'a>(
    mts: &Mts,
    entries: impl Iterator<Item = &'a Arc<Entry>>,
    lost: &[Arc<Entry>],
) -> Vec<u8> {
    let written = Written {
        format: FORMAT.into(),
        version: VERSION,
        mts: mts.clone(),
        entries: entries.map(|entry| WrittenEntry::of(entry)).collect(),
        lost: lost.iter().map(|entry| WrittenEntry::of(entry)).collect(),
    };
    // Serialization of text, numbers and lists cannot fail.
    serde_json::to_vec(&written).unwrap_or_default()
}

pub(super) fn read(bytes: &[u8]) -> Result<Read, FileError> {
    let written: Written = serde_json::from_slice(bytes).map_err(FileError::Json)?;
    if written.format != FORMAT {
        return Err(FileError::Format(written.format));
    }
    if written.version != VERSION {
        return Err(FileError::Version(written.version));
    }
    let count = written.entries.len() + written.lost.len();
    if count > MAX_ENTRIES {
        return Err(FileError::TooMany(count));
    }
    let mut entries = Entries::with_capacity(written.entries.len());
    for one in written.entries {
        let entry = Arc::new(one.into_entry(&written.mts)?);
        if let Some(twice) = entries.insert(entry.name.clone(), entry) {
            return Err(FileError::Twice(twice.name.clone()));
        }
    }
    let lost = written.lost.into_iter();
    let lost = lost.map(|one| one.into_entry(&written.mts).map(Arc::new));
    Ok(Read {
        entries,
        lost: lost.collect::<Result<_, _>>()?,
    })
}

/// Error of [`read`].
#[derive(Debug, thiserror::Error)]
pub(super) enum FileError {
    #[error("malformed")]
    Json(#[source] serde_json::Error),
    #[error("the format is {0:?}, expected {FORMAT:?}")]
    Format(String),
    #[error("version {0} is not supported (only {VERSION}); use the same release in all processes")]
    Version(u32),
    #[error("{0} entries; at most {MAX_ENTRIES} are allowed")]
    TooMany(usize),
    #[error("the name {0:?} occurs twice")]
    Twice(Arc<str>),
    #[error("entry {name:?} is not valid")]
    Entry { name: Arc<str>, source: EntryError },
    #[error("entry {0:?} has no incarnation")]
    NoIncarnation(Arc<str>),
}

#[derive(Serialize, Deserialize)]
struct Written {
    format: String,
    version: u32,
    mts: Mts,
    entries: Vec<WrittenEntry>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    lost: Vec<WrittenEntry>,
}

#[derive(Serialize, Deserialize)]
struct WrittenEntry {
    name: Arc<str>,
    #[serde(rename = "type", default, skip_serializing_if = "String::is_empty")]
    agent_type: String,
    incarnation: Incarnation,
    locations: Vec<Location>,
    #[serde(default, skip_serializing_if = "String::is_empty")]
    description: String,
    registered: u64,
    role: Role,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    remote: Option<Mts>,
    /// Source from which the gateway learned it, for entries of other hosts.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    source: Option<Source>,
}

impl WrittenEntry {
    fn of(entry: &Entry) -> Self {
        let remote = match entry.reach {
            Reach::Local => None,
            Reach::Remote { .. } => Some(entry.mts.clone()),
        };
        Self {
            name: entry.name.clone(),
            agent_type: entry.agent_type.clone(),
            incarnation: entry.incarnation,
            locations: entry.locations.clone(),
            description: entry.description.clone(),
            registered: millis_of_time(entry.registered),
            role: entry.role.clone(),
            source: remote.is_some().then_some(entry.source),
            remote,
        }
    }

    fn into_entry(self, mts: &Mts) -> Result<Entry, FileError> {
        let reach = match self.remote {
            None => Reach::Local,
            Some(_) => Reach::Remote {
                gateway: mts.incarnation,
            },
        };
        // Legacy peers may have no incarnation; processes of this host always have one.
        if reach == Reach::Local && !self.incarnation.is_known() {
            return Err(FileError::NoIncarnation(self.name));
        }
        let entry = Entry {
            name: self.name,
            agent_type: self.agent_type,
            incarnation: self.incarnation,
            locations: self.locations,
            mts: self.remote.unwrap_or_else(|| mts.clone()),
            description: self.description,
            registered: time_of_millis(self.registered),
            source: self.source.unwrap_or(Source::Host),
            reach,
            role: self.role,
        };
        match entry.check() {
            Ok(()) => Ok(entry),
            Err(source) => {
                let name = entry.name;
                Err(FileError::Entry { name, source })
            }
        }
    }
}
