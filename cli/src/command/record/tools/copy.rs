//! `fipa record repair` and `fipa record filter`: copy recordings.

use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};

use clap::Args;
use mcap::records::MessageHeader;

use super::super::file::reader::{End, Item};
use super::super::file::writer::RecordingFile;
use super::super::file::{self, RecordingError};
use super::super::file_name;
use super::super::recorder::failed;
use super::read_file;
use super::select::{Selection, Selector};
use crate::report::Failure;
use crate::{input, output};

/// Copy a recording that was not closed, up to its last complete chunk
///
/// The copy has an index, which other programs need.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa record repair run.mcap -o repaired.mcap")]
pub(in crate::command) struct Repair {
    /// Recording
    file: PathBuf,

    /// File to write
    #[arg(short, long, value_name = "FILE", value_parser = file_name())]
    output: PathBuf,
}

/// Copy the selected messages of a recording
///
/// With a condition for letters, the copy has only letters.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa record filter run.mcap -o arm.mcap --agent arm_1
  fipa record filter run.mcap -o bad.mcap --violations
  fipa record filter run.mcap -o part.mcap --from 2026-03-01T12:00:00Z --until 2026-03-01T12:05:00Z")]
pub(in crate::command) struct Filtered {
    /// Recording; - for standard input
    file: PathBuf,

    /// File to write
    #[arg(short, long, value_name = "FILE", value_parser = file_name())]
    output: PathBuf,

    #[command(flatten)]
    selection: Selection,
}

pub(in crate::command::record) fn repair(arguments: &Repair) -> Result<(), Failure> {
    let (end, messages) = copy(&arguments.file, &arguments.output, |_| Ok(true), false)?;
    let was = match end.is_closed {
        true => "the recording was closed; ",
        false => "",
    };
    let to = input::name(&arguments.output);
    output::text(&format!("{was}{messages} messages copied to {to}\n"))
}

pub(in crate::command::record) fn filter(arguments: &Filtered) -> Result<(), Failure> {
    let mut selector = Selector::new(&arguments.selection);
    let takes = |item: &Item<'_>| selector.takes(item);
    let (_, messages) = copy(&arguments.file, &arguments.output, takes, true)?;
    let to = input::name(&arguments.output);
    output::text(&format!("{messages} messages copied to {to}\n"))
}

/// Copies the records that `takes` selects. Returns the end of the original and the number of copied messages.
fn copy(
    from: &Path,
    to: &Path,
    mut takes: impl FnMut(&Item<'_>) -> Result<bool, Failure>,
    is_filtered: bool,
) -> Result<(End, u64), Failure> {
    let unwritable = |error: &RecordingError| failed(error, input::name(to));
    // Created with the first record, so that an unreadable original makes no file.
    let mut copy: Option<Copy> = None;
    let end = read_file(from, |item| {
        let copy = match &mut copy {
            Some(copy) => copy,
            none => none.insert(Copy::create(to, is_filtered).map_err(|it| unwritable(&it))?),
        };
        match takes(&item)? {
            true => copy.add(item).map_err(|error| unwritable(&error)),
            false => Ok(()),
        }
    })?;
    let copy = match copy {
        Some(copy) => copy,
        None => Copy::create(to, is_filtered).map_err(|error| unwritable(&error))?,
    };
    let messages = copy.messages;
    copy.file.finish().map_err(|error| unwritable(&error))?;
    Ok((end, messages))
}

struct Copy {
    file: RecordingFile,
    /// The channels of the copy by those of the original.
    channels: HashMap<u16, u16>,
    messages: u64,
}

impl Copy {
    fn create(path: &Path, is_filtered: bool) -> Result<Self, RecordingError> {
        let mut file = RecordingFile::create(path)?;
        if is_filtered {
            file.write_metadata(file::FILTERED, BTreeMap::new())?;
        }
        Ok(Self {
            file,
            channels: HashMap::new(),
            messages: 0,
        })
    }

    fn add(&mut self, item: Item<'_>) -> Result<(), RecordingError> {
        let (channel, schema, header, data) = match item {
            Item::Metadata(metadata) => {
                return self.file.write_metadata(&metadata.name, metadata.metadata);
            }
            Item::Message {
                channel,
                schema,
                header,
                data,
            } => (channel, schema, header, data),
        };
        let format = self.file.format();
        let channel_id = match self.channels.get(&channel.id) {
            Some(id) => *id,
            None => {
                let schema = match schema {
                    Some(it) => {
                        format.add_schema(&it.header.name, &it.header.encoding, &it.data)?
                    }
                    None => 0,
                };
                let (topic, encoding) = (&channel.topic, &channel.message_encoding);
                let id = format.add_channel(schema, topic, encoding, &channel.metadata)?;
                self.channels.insert(channel.id, id);
                id
            }
        };
        let header = MessageHeader {
            channel_id,
            ..header
        };
        format.write_to_known_channel(&header, data)?;
        self.messages += 1;
        Ok(())
    }
}
