//! Entries files for fuzz targets.

use super::file;
use super::place::Name;
use crate::{Entry, Mts, Reach, Source};

/// Reads an entries file. What it says is the same when it is written and read again; returns that.
///
/// # Errors
/// Says what is wrong with the file.
///
/// # Panics
/// When a file that was read breaks a limit.
pub fn read_and_written(bytes: &[u8]) -> Result<Vec<u8>, String> {
    let entries = file::read(bytes).map_err(|error| error.to_string())?;
    assert!(entries.len() <= file::MAX_ENTRIES);
    for (name, entry) in &entries {
        assert_eq!(*name, entry.name);
        entry.check().expect("what is read keeps to the limits");
    }
    let mut own: Option<Mts> = None;
    for entry in entries.values() {
        if entry.reach == Reach::Local {
            own = Some(entry.mts.clone());
        }
    }
    let gateway = entries.values().find_map(|it| match it.reach {
        Reach::Remote { gateway } => Some(Mts::new("mts", gateway)),
        Reach::Local => None,
    });
    let Some(mts) = own.or(gateway) else {
        return Ok(bytes.to_vec());
    };
    let written = file::write(&mts, entries.values());
    let again = file::read(&written).expect("what was read can be written");
    let sorted = |entries: &file::Entries| {
        let mut all: Vec<Entry> = entries.values().map(|it| (**it).clone()).collect();
        for entry in &mut all {
            // It is not written of an entry of this host.
            if entry.reach == Reach::Local {
                entry.source = Source::Host;
            }
        }
        all.sort_by(|one, other| one.name.cmp(&other.name));
        all
    };
    assert_eq!(sorted(&again), sorted(&entries));
    Ok(written)
}

/// A name of a file in the directory is one of ours, and spelt as we spell it, or none.
///
/// # Panics
/// When it is spelt otherwise.
pub fn file_name(name: &str) {
    if let Some(parsed) = Name::parse(name) {
        assert_eq!(parsed.to_string(), name);
    }
}
