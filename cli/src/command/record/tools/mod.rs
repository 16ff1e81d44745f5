//! Tools for recordings.

pub(super) mod copy;
mod found;
pub(super) mod info;
pub(super) mod merge;
mod select;
pub(super) mod to_json;

use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

use super::file::RecordingError;
use super::file::reader::{End, Item, read};
use crate::input;
use crate::report::{self, Failure};

/// Reads a recording, or standard input for the path `-`. Warns if it was not closed.
pub(in crate::command) fn read_file(
    path: &Path,
    visit: impl FnMut(Item<'_>) -> Result<(), Failure>,
) -> Result<End, Failure> {
    let end = read_quietly(path, visit)?;
    warn_if_open(path, &end);
    Ok(end)
}

/// Warns of a file that was not closed.
fn warn_if_open(path: &Path, end: &End) {
    if !end.is_closed {
        let name = input::name(path);
        report::warn(&match &end.damage {
            Some(error) => format!(
                "{name} is damaged and was read up to the damage: {}",
                fipa::error::ErrorChain(error)
            ),
            None => format!(
                "{name} was not closed: the program that wrote it was killed, or still writes; `fipa record repair` \
                 makes a complete file"
            ),
        });
    }
}

/// Reads a recording, without a warning.
pub(in crate::command) fn read_quietly(
    path: &Path,
    visit: impl FnMut(Item<'_>) -> Result<(), Failure>,
) -> Result<End, Failure> {
    let failed = |error: &RecordingError| unreadable(error, path);
    let source: Box<dyn Read> = match path == Path::new("-") {
        true => Box::new(io::stdin().lock()),
        false => Box::new(File::open(path).map_err(|error| failed(&error.into()))?),
    };
    read(source, failed, visit)
}

fn unreadable(error: &RecordingError, path: &Path) -> Failure {
    Failure::failed(
        format!("cannot read: {}", fipa::error::ErrorChain(error)),
        input::name(path),
        "give a file of `fipa record`, or another file in the format MCAP, that this user can read",
    )
}
