//! Reads the input of a command from a file or from standard input.

use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

use fipa::Config;
use fipa_acl::escape;

use crate::output;
use crate::report::Failure;

/// Maximum size of a message that a tool converts, in bytes: four times the default maximum of a letter.
pub(crate) const MAX_MESSAGE: u64 = 256 << 20;

/// Reads a whole file, or standard input for the path `-`. More than `limit` bytes are an error. A file with
/// more bytes is not read.
pub(crate) fn read(path: &Path, limit: u64) -> Result<Vec<u8>, Failure> {
    read_within(path, limit, "use a smaller input")
}

fn read_within(path: &Path, limit: u64, help: &str) -> Result<Vec<u8>, Failure> {
    let mut bytes = Vec::new();
    let read = if path == Path::new("-") {
        read_all(&mut io::stdin().lock(), limit, &mut bytes)
    } else {
        File::open(path).and_then(|mut file| match file.metadata()?.len() <= limit {
            true => read_all(&mut file, limit, &mut bytes),
            false => Ok(false),
        })
    };
    match read {
        Ok(true) => Ok(bytes),
        Ok(false) => Err(Failure::failed(
            format!("the input has more than {}", output::size(limit)),
            name(path),
            help,
        )),
        Err(error) => Err(Failure::failed(
            format!("cannot read: {error}"),
            name(path),
            "give a file that this user can read, or - for standard input",
        )),
    }
}

/// Reads the content of a message: a file, or standard input. It ends at the size of the largest letter.
pub(crate) fn content(path: &Path, config: &Config) -> Result<Vec<u8>, Failure> {
    let limit = config.transport.shm.max_letter;
    read_within(
        path,
        limit,
        "send less, or increase transport.shm.max_letter in the configuration of all processes",
    )
}

/// Refuses input without a byte that is not white space.
pub(crate) fn check_not_empty(bytes: &[u8], path: &Path, help: &str) -> Result<(), Failure> {
    match bytes.trim_ascii().is_empty() {
        true => Err(Failure::failed("the input is empty", name(path), help)),
        false => Ok(()),
    }
}

/// The name of an input in error messages.
pub(crate) fn name(path: &Path) -> String {
    if path == Path::new("-") {
        "standard input".to_owned()
    } else {
        escape(&path.to_string_lossy()).into_owned()
    }
}

/// The name of an input in error messages, with the line and the column of an offset. Both count from 1,
/// columns in characters.
pub(crate) fn place(path: &Path, bytes: &[u8], offset: usize) -> String {
    let before = bytes.get(..offset).unwrap_or(bytes);
    let start = before
        .iter()
        .rposition(|byte| *byte == b'\n')
        .map_or(0, |at| at + 1);
    let line = 1 + before.iter().filter(|byte| **byte == b'\n').count();
    let inside = before.get(start..).unwrap_or_default();
    let column = 1 + String::from_utf8_lossy(inside).chars().count();
    format!("{}:{line}:{column}", name(path))
}

/// Whether the source had at most `limit` bytes.
fn read_all(source: &mut dyn Read, limit: u64, bytes: &mut Vec<u8>) -> io::Result<bool> {
    let read = source.take(limit.saturating_add(1)).read_to_end(bytes)?;
    Ok(read as u64 <= limit)
}
