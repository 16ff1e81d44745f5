//! Entries files for the fuzz targets.

use std::sync::Arc;

use super::file;
use super::host_dir::Name;
use crate::{Entry, Mts, Reach, Source};

/// Reads an entries file, writes it, asserts that reading it again gives the same, and returns it.
///
/// # Errors
/// Returns the error of the file.
///
/// # Panics
/// Panics when an accepted file exceeds a limit.
pub fn read_and_written(bytes: &[u8]) -> Result<Vec<u8>, String> {
    let read = file::read(bytes).map_err(|error| fipa_acl::ErrorChain(&error).to_string())?;
    let file::Read { entries, lost } = read;
    assert!(entries.len() + lost.len() <= file::MAX_ENTRIES);
    for (name, entry) in &entries {
        assert_eq!(*name, entry.name);
        entry
            .check()
            .expect("an accepted file is within the limits");
    }
    let mut own: Option<Mts> = None;
    for entry in entries.values().chain(&lost) {
        if entry.reach == Reach::Local {
            own = Some(entry.mts.clone());
        }
    }
    let gateway = entries.values().chain(&lost).find_map(|it| match it.reach {
        Reach::Remote { gateway } => Some(Mts::new("mts", gateway)),
        Reach::Local => None,
    });
    let Some(mts) = own.or(gateway) else {
        return Ok(bytes.to_vec());
    };
    let written = file::write(&mts, entries.values(), &lost);
    let again = file::read(&written).expect("an accepted file can be written and read again");
    let sorted = |entries: &file::Entries, lost: &[Arc<Entry>]| {
        let all = entries.values().chain(lost);
        let mut all: Vec<Entry> = all.map(|it| (**it).clone()).collect();
        for entry in &mut all {
            // The source of a local entry is not written.
            if entry.reach == Reach::Local {
                entry.source = Source::Host;
            }
        }
        all.sort_by(|one, other| one.name.cmp(&other.name));
        all
    };
    assert_eq!(sorted(&again.entries, &again.lost), sorted(&entries, &lost));
    Ok(written)
}

/// Checks that a parsed file name is formatted the same again.
///
/// # Panics
/// Panics when the spelling differs.
pub fn file_name(name: &str) {
    if let Some(parsed) = Name::parse(name) {
        assert_eq!(parsed.to_string(), name);
    }
}
