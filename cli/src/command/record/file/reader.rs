//! Reads recordings, also those that were not closed.
//!
//! A file comes from outside. The records and the chunks of a file, before and after decompression, have a maximum
//! length, which is checked before memory is taken. The messages of a chunk are read after its checksum is verified.

use std::collections::HashMap;
use std::io::{self, ErrorKind, Read};

use mcap::McapError;
use mcap::records::{Channel, MessageHeader, Metadata, SchemaHeader, op};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};

use super::{RecordingError, fields};
use crate::report::Failure;

/// Maximum length of a record, and of a chunk before and after decompression, in bytes.
pub(in crate::command) const MAX_RECORD: usize = 64 << 20;
/// Maximum length of all channels and schemas of a file, in bytes.
const MAX_CHANNELS: usize = 16 << 20;
/// Bytes that are read at once.
const PIECE: usize = 256 << 10;

/// A schema of a file.
#[derive(Debug)]
pub(in crate::command) struct FileSchema {
    pub(in crate::command) header: SchemaHeader,
    pub(in crate::command) data: Vec<u8>,
}

/// A record of a file.
#[derive(Debug)]
pub(in crate::command) enum Item<'a> {
    /// A message.
    Message {
        channel: &'a Channel,
        schema: Option<&'a FileSchema>,
        header: MessageHeader,
        data: &'a [u8],
    },
    /// A metadata record.
    Metadata(Metadata),
}

/// The end of a file.
#[derive(Debug)]
pub(in crate::command) struct End {
    /// Whether the file was closed.
    pub(in crate::command) is_closed: bool,
    /// The damage after the last readable record, unless the file just ends.
    pub(in crate::command) damage: Option<RecordingError>,
}

/// Reads a file to its last readable record.
///
/// # Errors
/// Fails if the file cannot be read or has another format, or `visit` fails.
pub(in crate::command) fn read(
    source: impl Read,
    failed: impl Fn(&RecordingError) -> Failure,
    mut visit: impl FnMut(Item<'_>) -> Result<(), Failure>,
) -> Result<End, Failure> {
    let mut file = FileReader::new(source);
    while let Some(item) = file.next().map_err(|error| failed(&error))? {
        visit(item)?;
    }
    Ok(file.end())
}

/// Reads a file item by item. Has one chunk of it in memory.
pub(in crate::command) struct FileReader<R> {
    records: LinearReader,
    source: R,
    known: Known,
    /// The record of the last item.
    record: Vec<u8>,
    has_begun: bool,
    is_empty: bool,
    end: Option<End>,
}

impl<R: Read> FileReader<R> {
    pub(in crate::command) fn new(source: R) -> Self {
        Self {
            records: LinearReader::new_with_options(
                LinearReaderOptions::default()
                    .with_skip_end_magic(true)
                    .with_prevalidate_chunk_crcs(true)
                    .with_record_length_limit(MAX_RECORD),
            ),
            source,
            known: Known::default(),
            record: Vec::new(),
            has_begun: false,
            is_empty: true,
            end: None,
        }
    }

    /// Returns the next message or metadata; `None` at the last readable record.
    ///
    /// # Errors
    /// Fails if the file cannot be read or has another format.
    pub(in crate::command) fn next(&mut self) -> Result<Option<Item<'_>>, RecordingError> {
        if self.end.is_some() {
            return Ok(None);
        }
        let opcode = match self.advance()? {
            Ok(opcode) => opcode,
            Err(end) => {
                self.end = Some(end);
                return Ok(None);
            }
        };
        match self.known.item(opcode, &self.record) {
            Ok(item) => Ok(Some(item)),
            Err(error) => {
                self.end = Some(damaged(error));
                Ok(None)
            }
        }
    }

    /// The end of the file, after its last item.
    pub(in crate::command) fn end(self) -> End {
        let open = End {
            is_closed: false,
            damage: None,
        };
        self.end.unwrap_or(open)
    }

    /// Reads up to the record of the next item, and returns its opcode.
    fn advance(&mut self) -> Result<Result<u8, End>, RecordingError> {
        loop {
            let (opcode, data) = match self.records.next_event() {
                Some(Ok(LinearReadEvent::ReadRequest(need))) => {
                    let space = self.records.insert(need.min(PIECE));
                    let read = read_piece(&mut self.source, space)?;
                    self.is_empty &= read == 0;
                    self.records.notify_read(read);
                    continue;
                }
                Some(Ok(LinearReadEvent::Record { data, opcode })) => (opcode, data),
                None | Some(Err(McapError::UnexpectedEof)) if self.has_begun => {
                    return Ok(Err(End {
                        is_closed: false,
                        damage: None,
                    }));
                }
                None => return Err(at_beginning(McapError::UnexpectedEof, self.is_empty)),
                Some(Err(error)) if self.has_begun => return Ok(Err(damaged(error.into()))),
                Some(Err(error)) => return Err(at_beginning(error, self.is_empty)),
            };
            self.has_begun = true;
            match opcode {
                op::FOOTER => {
                    return Ok(Err(End {
                        is_closed: true,
                        damage: None,
                    }));
                }
                op::MESSAGE | op::METADATA => {
                    self.record.clear();
                    self.record.extend_from_slice(data);
                    return Ok(Ok(opcode));
                }
                other => {
                    if let Err(error) = self.known.add(other, data) {
                        return Ok(Err(damaged(error)));
                    }
                }
            }
        }
    }
}

fn damaged(error: RecordingError) -> End {
    End {
        is_closed: false,
        damage: Some(error),
    }
}

/// The error of a file in which no record was found.
fn at_beginning(error: McapError, is_empty: bool) -> RecordingError {
    match error {
        _ if is_empty => RecordingError::Empty,
        McapError::BadMagic | McapError::UnexpectedEof => RecordingError::NotARecording,
        other => other.into(),
    }
}

fn read_piece(source: &mut impl Read, space: &mut [u8]) -> io::Result<usize> {
    loop {
        match source.read(space) {
            Err(error) if error.kind() == ErrorKind::Interrupted => {}
            other => return other,
        }
    }
}

/// The announced schemas and channels.
#[derive(Debug, Default)]
struct Known {
    schemas: HashMap<u16, FileSchema>,
    channels: HashMap<u16, Channel>,
    bytes: usize,
}

impl Known {
    /// Adds a schema or a channel. Other records are not parsed.
    fn add(&mut self, opcode: u8, data: &[u8]) -> Result<(), RecordingError> {
        let malformed = || RecordingError::Malformed(opcode);
        match opcode {
            op::SCHEMA => {
                let (header, text) = fields::schema(data).ok_or_else(malformed)?;
                // A repetition has the same data.
                if !self.schemas.contains_key(&header.id) {
                    self.count(data.len())?;
                    let data = text.to_vec();
                    self.schemas.insert(header.id, FileSchema { header, data });
                }
            }
            op::CHANNEL => {
                let channel = fields::channel(data).ok_or_else(malformed)?;
                if !self.channels.contains_key(&channel.id) {
                    self.count(data.len())?;
                    self.channels.insert(channel.id, channel);
                }
            }
            _ => {}
        }
        Ok(())
    }

    /// Returns the item of a record, a message or metadata.
    fn item<'a>(&'a self, opcode: u8, data: &'a [u8]) -> Result<Item<'a>, RecordingError> {
        let malformed = || RecordingError::Malformed(opcode);
        if opcode == op::METADATA {
            let metadata = fields::metadata(data).ok_or_else(malformed)?;
            return Ok(Item::Metadata(metadata));
        }
        let (header, data) = fields::message(data).ok_or_else(malformed)?;
        let id = header.channel_id;
        let channel = self.channels.get(&id);
        let channel = channel.ok_or(RecordingError::UnknownChannel(id))?;
        Ok(Item::Message {
            channel,
            schema: self.schemas.get(&channel.schema_id),
            header,
            data,
        })
    }

    fn count(&mut self, bytes: usize) -> Result<(), RecordingError> {
        self.bytes = self.bytes.saturating_add(bytes);
        match self.bytes > MAX_CHANNELS {
            true => Err(RecordingError::TooManyChannels(MAX_CHANNELS)),
            false => Ok(()),
        }
    }
}
