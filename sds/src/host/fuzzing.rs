//! Files of the host directory for the fuzz targets.

use std::sync::Arc;

use super::host_dir::Name;
use super::remote::RemoteAgents;
use super::{file, remote};
use crate::{Entry, MtsId, View as _};

/// Reads an entries file, writes it, asserts that reading it again gives the same, and returns it.
///
/// # Errors
/// Returns the error of the file.
///
/// # Panics
/// Panics when an accepted file exceeds a limit.
pub fn read_and_written(bytes: &[u8]) -> Result<Vec<u8>, String> {
    let entries = file::read(bytes).map_err(|error| fipa_acl::ErrorChain(&error).to_string())?;
    assert!(entries.len() <= file::MAX_ENTRIES);
    for (name, entry) in &entries {
        assert_eq!(*name, entry.name);
        entry
            .check()
            .expect("an accepted file is within the limits");
    }
    let Some(mts) = entries.values().next().map(|entry| entry.mts.clone()) else {
        return Ok(bytes.to_vec());
    };
    let written = file::write(&mts, entries.values());
    let again = file::read(&written).expect("an accepted file can be written and read again");
    assert_eq!(again, entries);
    Ok(written)
}

/// Reads a file with agents of other hosts, asserts that lookups find what the list has, and that a file with the
/// same agents has the same.
///
/// # Panics
/// Panics when an accepted file exceeds a limit or is not consistent.
pub fn read_remote(bytes: &[u8]) {
    let Ok(agents) = RemoteAgents::open(bytes.to_vec()) else {
        return;
    };
    let all = agents.all();
    for entry in all.iter() {
        entry
            .check()
            .expect("an accepted entry is within the limits");
        assert_eq!(agents.named(&entry.name).as_ref(), Some(entry));
    }
    let lost: Vec<Arc<Entry>> = agents.lost_agents().to_vec();
    let Some(gateway) = all.first().map(|entry| match entry.reach {
        crate::Reach::Remote { gateway } => MtsId::new("mts", gateway),
        crate::Reach::Local => panic!("an agent of another host is not local"),
    }) else {
        return;
    };
    let written = remote::write(&gateway, &all, &lost);
    let again = RemoteAgents::open(written).expect("a written file can be read");
    assert_eq!(again.all(), all);
    assert_eq!(again.lost_agents(), lost);
    remote::changed(Some(&agents), Some(&again), all.len()).expect("both files can be compared");
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
