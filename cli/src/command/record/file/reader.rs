//! Reads recordings, also those that were not closed.
//!
//! A file comes from outside. The records and the chunks of a file, before and after decompression, have a maximum
//! length, which is checked before memory is taken. The messages of a chunk are read after its checksum is verified.

use std::collections::HashMap;
use std::io::{self, ErrorKind, Read};
use std::ops::Range;

use mcap::McapError;
use mcap::records::{Channel, MessageHeader, Metadata, SchemaHeader, op};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};

use super::{RecordingError, fields};
use crate::report::Failure;

/// Maximum length of a record, and of a chunk before and after decompression, in bytes.
pub(in crate::command) const MAX_RECORD: usize = 64 << 20;
/// Maximum length of all channels and schemas of a file, in bytes.
const MAX_CHANNELS: usize = 16 << 20;
/// Maximum length of a channel or a metadata record, whose pairs of texts take more memory than bytes of the file.
const MAX_PAIRS: usize = 4 << 20;
/// Bytes that a pair of texts counts in addition to its texts.
const PAIR: usize = 128;
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
    file: LinearReader,
    source: R,
    known: Known,
    /// The records of the last chunk, or the last record outside of a chunk.
    records: Vec<u8>,
    /// Position of the next one in `records`.
    position: usize,
    has_begun: bool,
    is_empty: bool,
    end: Option<End>,
}

impl<R: Read> FileReader<R> {
    pub(in crate::command) fn new(source: R) -> Self {
        Self {
            file: LinearReader::new_with_options(
                LinearReaderOptions::default()
                    .with_skip_end_magic(true)
                    .with_emit_chunks(true)
                    .with_record_length_limit(MAX_RECORD),
            ),
            source,
            known: Known::default(),
            records: Vec::new(),
            position: 0,
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
        let Some((opcode, place)) = self.advance()? else {
            return Ok(None);
        };
        let data = self.records.get(place).unwrap_or_default();
        match self.known.item(opcode, data) {
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

    /// Moves to the next item. Returns its opcode and its place in `records`; `None` at the end.
    fn advance(&mut self) -> Result<Option<(u8, Range<usize>)>, RecordingError> {
        while self.end.is_none() {
            let mut rest = self.records.get(self.position..).unwrap_or_default();
            if rest.is_empty() {
                self.load()?;
                continue;
            }
            let Some((opcode, data)) = fields::next_record(&mut rest) else {
                self.end = Some(damaged(RecordingError::Malformed(op::CHUNK)));
                break;
            };
            let end = self.records.len() - rest.len();
            self.position = end;
            if matches!(opcode, op::MESSAGE | op::METADATA) {
                return Ok(Some((opcode, end - data.len()..end)));
            }
            if let Err(error) = self.known.add(opcode, data) {
                self.end = Some(damaged(error));
            }
        }
        Ok(None)
    }

    /// Reads the next chunk, or the next record outside of a chunk.
    fn load(&mut self) -> Result<(), RecordingError> {
        let (opcode, data) = loop {
            match self.file.next_event() {
                Some(Ok(LinearReadEvent::ReadRequest(need))) => {
                    let space = self.file.insert(need.min(PIECE));
                    let read = read_piece(&mut self.source, space)?;
                    self.is_empty &= read == 0;
                    self.file.notify_read(read);
                }
                Some(Ok(LinearReadEvent::Record { data, opcode })) => break (opcode, data),
                None | Some(Err(McapError::UnexpectedEof)) if self.has_begun => {
                    self.end = Some(End {
                        is_closed: false,
                        damage: None,
                    });
                    return Ok(());
                }
                None => return Err(at_beginning(McapError::UnexpectedEof, self.is_empty)),
                Some(Err(error)) if self.has_begun => {
                    self.end = Some(damaged(error.into()));
                    return Ok(());
                }
                Some(Err(error)) => return Err(at_beginning(error, self.is_empty)),
            }
        };
        self.has_begun = true;
        self.position = 0;
        match opcode {
            op::FOOTER => {
                self.end = Some(End {
                    is_closed: true,
                    damage: None,
                });
            }
            op::CHUNK => match unpacked(data) {
                Ok(records) => self.records = records,
                Err(error) => self.end = Some(damaged(error)),
            },
            // As in a chunk.
            _ => {
                self.records.clear();
                self.records.push(opcode);
                self.records.extend((data.len() as u64).to_le_bytes());
                self.records.extend_from_slice(data);
            }
        }
        Ok(())
    }
}

fn damaged(error: RecordingError) -> End {
    End {
        is_closed: false,
        damage: Some(error),
    }
}

/// Returns the records of a chunk. The reader of the crate `mcap` does not check that the records of a chunk end with
/// it.
fn unpacked(chunk: &[u8]) -> Result<Vec<u8>, RecordingError> {
    let (header, stored) = fields::chunk(chunk).ok_or(RecordingError::Malformed(op::CHUNK))?;
    let records = match header.compression.as_str() {
        "" => stored.to_vec(),
        "zstd" if header.uncompressed_size > MAX_RECORD as u64 => {
            return Err(McapError::ChunkTooLarge(header.uncompressed_size).into());
        }
        "zstd" => {
            let unpacked = unpacked_zstd(stored, header.uncompressed_size);
            unpacked.map_err(|it| McapError::DecompressionError(it.to_string()))?
        }
        _ => return Err(McapError::UnsupportedCompression(header.compression).into()),
    };
    if records.len() as u64 != header.uncompressed_size {
        return Err(RecordingError::Malformed(op::CHUNK));
    }
    // The format allows chunks without a checksum.
    let (saved, calculated) = (header.uncompressed_crc, crc32fast::hash(&records));
    if saved != 0 && saved != calculated {
        return Err(McapError::BadChunkCrc { saved, calculated }.into());
    }
    Ok(records)
}

/// Decompresses at most `len` bytes. Takes memory for the bytes that there are.
fn unpacked_zstd(stored: &[u8], len: u64) -> io::Result<Vec<u8>> {
    let mut decoder = zstd::Decoder::with_buffer(stored)?;
    decoder.window_log_max(MAX_RECORD.ilog2())?;
    let mut unpacked = Vec::new();
    decoder.take(len).read_to_end(&mut unpacked)?;
    Ok(unpacked)
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
        let len = data.len();
        match opcode {
            op::SCHEMA => {
                let (header, text) = fields::schema(data).ok_or_else(malformed)?;
                // A repetition has the same data.
                if !self.schemas.contains_key(&header.id) {
                    self.count(len)?;
                    let data = text.to_vec();
                    self.schemas.insert(header.id, FileSchema { header, data });
                }
            }
            op::CHANNEL => {
                check_pairs(opcode, len)?;
                let channel = fields::channel(data).ok_or_else(malformed)?;
                if !self.channels.contains_key(&channel.id) {
                    self.count(len.saturating_add(channel.metadata.len() * PAIR))?;
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
            check_pairs(opcode, data.len())?;
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

/// Checks the length of a record with pairs of texts.
fn check_pairs(opcode: u8, len: usize) -> Result<(), RecordingError> {
    match len > MAX_PAIRS {
        true => {
            let len = len as u64;
            Err(McapError::RecordTooLarge { opcode, len }.into())
        }
        false => Ok(()),
    }
}

#[cfg(test)]
mod tests;
