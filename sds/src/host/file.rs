//! The format of an entries file: one JSON object.
//!
//! ```json
//! {"format":"fipa-directory","version":1,"mts":{"name":"arm-mts","incarnation":"00ab…"},
//!  "entries":[{"name":"arm_left","type":"gripper","incarnation":"00cd…",
//!    "locations":["shm://…#00ab…"],"description":"…","registered":1795172400000,"role":"agent"}]}
//! ```
//! `registered` is in milliseconds since 1970, UTC. The agents of other hosts are in a file of their own
//! ([`remote`](super::remote)).
//!
//! A process of the same user writes the file, which does not make it trustworthy: everything is
//! checked, and a file with any error is rejected as a whole.

use std::collections::HashMap;
use std::sync::Arc;

use fipa_transport::{Incarnation, Location, PeerId};
use serde::{Deserialize, Serialize};

use crate::entry::{millis_of_time, time_of_millis};
use crate::{Entry, EntryError, MtsId, Reach, Role, Source};

const FORMAT: &str = "fipa-directory";
const VERSION: u32 = 1;

/// The entries of one process, by name.
pub(super) type Entries = HashMap<Arc<str>, Arc<Entry>>;

/// Maximum number of entries in one file.
pub(super) const MAX_ENTRIES: usize = 65_536;

/// Largest file, in bytes.
pub(super) const MAX_SIZE: usize = 32 * 1024 * 1024;

pub(super) fn write<'a>(mts: &MtsId, entries: impl Iterator<Item = &'a Arc<Entry>>) -> Vec<u8> {
    let written = Written {
        format: FORMAT.into(),
        version: VERSION,
        mts: mts.clone(),
        entries: entries.map(|entry| WrittenEntry::of(entry)).collect(),
    };
    // Serialization of text, numbers and lists cannot fail.
    serde_json::to_vec(&written).unwrap_or_default()
}

pub(super) fn read(bytes: &[u8]) -> Result<Entries, FileError> {
    let written: Written = serde_json::from_slice(bytes).map_err(FileError::Json)?;
    if written.format != FORMAT {
        return Err(FileError::Format(written.format));
    }
    if written.version != VERSION {
        return Err(FileError::Version(written.version));
    }
    let count = written.entries.len();
    if count > MAX_ENTRIES {
        return Err(FileError::TooMany(count));
    }
    let mut entries = Entries::with_capacity(count);
    for one in written.entries {
        let entry = Arc::new(one.into_entry(&written.mts)?);
        if let Some(twice) = entries.insert(entry.name.clone(), entry) {
            return Err(FileError::Twice(twice.name.clone()));
        }
    }
    Ok(entries)
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
    mts: MtsId,
    entries: Vec<WrittenEntry>,
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
}

impl WrittenEntry {
    fn of(entry: &Entry) -> Self {
        Self {
            name: entry.name.clone(),
            agent_type: entry.agent_type.clone(),
            incarnation: entry.incarnation,
            locations: entry.locations.clone(),
            description: entry.description.clone(),
            registered: millis_of_time(entry.registered),
            role: entry.role.clone(),
        }
    }

    fn into_entry(self, mts: &MtsId) -> Result<Entry, FileError> {
        if !self.incarnation.is_known() {
            return Err(FileError::NoIncarnation(self.name));
        }
        let entry = Entry {
            name: self.name,
            agent_type: self.agent_type,
            incarnation: self.incarnation,
            locations: self.locations,
            mts: mts.clone(),
            description: self.description,
            registered: time_of_millis(self.registered),
            source: Source::Host,
            reach: Reach::Local,
            peer: PeerId::THIS_HOST,
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
