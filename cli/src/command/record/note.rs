//! Metadata that another process writes into a recording, through its standard input.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

/// A metadata record for the file of a recording.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Note {
    pub(super) name: String,
    pub(super) pairs: BTreeMap<String, String>,
}

impl Note {
    /// Returns the line of JSON for a recording.
    pub(super) fn to_line(&self) -> serde_json::Result<Vec<u8>> {
        let mut line = serde_json::to_vec(self)?;
        line.push(b'\n');
        Ok(line)
    }

    /// Reads the line of JSON.
    pub(super) fn read(line: &str) -> serde_json::Result<Self> {
        serde_json::from_str(line)
    }
}
