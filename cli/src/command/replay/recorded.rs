//! Reads the letters of a recording.

use std::collections::BTreeMap;
use std::path::Path;

use crate::command::record::file::letter::RecordedLetter;
use crate::command::record::file::reader::Item;
use crate::command::record::file::{ABOUT, FILTERED, LETTER_SCHEMA};
use crate::command::record::tools::{read_file, read_quietly};
use crate::input;
use crate::report::{self, Failure};

/// The data of a recording beside its letters.
#[derive(Debug, Default)]
pub(super) struct Contents {
    /// Whether the file was closed.
    pub(super) is_closed: bool,
    /// Whether a filter has left out letters.
    pub(super) is_filtered: bool,
    /// The metadata at the beginning.
    pub(super) about: BTreeMap<String, String>,
}

/// Reads the letters of a file. Warns if it was not closed.
pub(super) fn read(
    path: &Path,
    visit: impl FnMut(RecordedLetter) -> Result<(), Failure>,
) -> Result<Contents, Failure> {
    let mut letters = Letters::new(visit);
    let end = read_file(path, |item| letters.item(item))?;
    letters.end(path, end.is_closed)
}

/// Reads the letters of a file again, without warnings.
pub(super) fn read_again(
    path: &Path,
    visit: impl FnMut(RecordedLetter) -> Result<(), Failure>,
) -> Result<Contents, Failure> {
    let mut letters = Letters::new(visit);
    let end = read_quietly(path, |item| letters.item(item))?;
    letters.end(path, end.is_closed)
}

struct Letters<V> {
    visit: V,
    contents: Contents,
    is_recording: bool,
}

impl<V: FnMut(RecordedLetter) -> Result<(), Failure>> Letters<V> {
    fn new(visit: V) -> Self {
        Self {
            visit,
            contents: Contents::default(),
            is_recording: false,
        }
    }

    fn item(&mut self, item: Item<'_>) -> Result<(), Failure> {
        match item {
            Item::Message {
                schema: Some(schema),
                header,
                data,
                ..
            } if schema.header.name == LETTER_SCHEMA.name => {
                self.is_recording = true;
                match RecordedLetter::read(data, header.publish_time) {
                    Ok(letter) => (self.visit)(letter),
                    Err(error) => {
                        report::warn(&format!("a letter is left out: {error}"));
                        Ok(())
                    }
                }
            }
            Item::Metadata(metadata) => {
                self.contents.is_filtered |= metadata.name == FILTERED;
                if metadata.name == ABOUT {
                    self.is_recording = true;
                    self.contents.about = metadata.metadata;
                }
                Ok(())
            }
            Item::Message { .. } => Ok(()),
        }
    }

    fn end(mut self, path: &Path, is_closed: bool) -> Result<Contents, Failure> {
        self.contents.is_closed = is_closed;
        match self.is_recording {
            true => Ok(self.contents),
            false => Err(Failure::failed(
                "the file has no letters",
                input::name(path),
                "give a file of `fipa record`",
            )),
        }
    }
}
