//! Reads recordings, also those that were not closed.
//!
//! A file comes from outside. The records and the chunks of a file, before and after decompression, have a maximum
//! length, which is checked before memory is taken. The messages of a chunk are read after its checksum is verified.

use std::borrow::Cow;
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
    mut source: impl Read,
    failed: impl Fn(&RecordingError) -> Failure,
    mut visit: impl FnMut(Item<'_>) -> Result<(), Failure>,
) -> Result<End, Failure> {
    let mut records = LinearReader::new_with_options(
        LinearReaderOptions::default()
            .with_skip_end_magic(true)
            .with_emit_chunks(true)
            .with_record_length_limit(MAX_RECORD),
    );
    let mut known = Known::default();
    let (mut has_begun, mut is_empty) = (false, true);
    let end = |is_closed, damage| End { is_closed, damage };
    loop {
        let (opcode, data) = match records.next_event() {
            Some(Ok(LinearReadEvent::ReadRequest(need))) => {
                let space = records.insert(need.min(PIECE));
                let read = read_piece(&mut source, space).map_err(|error| failed(&error.into()))?;
                is_empty &= read == 0;
                records.notify_read(read);
                continue;
            }
            Some(Ok(LinearReadEvent::Record { data, opcode })) => (opcode, data),
            None | Some(Err(McapError::UnexpectedEof)) if has_begun => return Ok(end(false, None)),
            None => return Err(failed(&at_beginning(McapError::UnexpectedEof, is_empty))),
            Some(Err(error)) if has_begun => return Ok(end(false, Some(error.into()))),
            Some(Err(error)) => return Err(failed(&at_beginning(error, is_empty))),
        };
        has_begun = true;
        let damage = match opcode {
            op::FOOTER => return Ok(end(true, None)),
            op::CHUNK => match unpacked(data) {
                Ok(chunk) => known.visit_chunk(&chunk, &mut visit)?,
                Err(error) => Some(error),
            },
            _ => known.visit(opcode, data, &mut visit)?,
        };
        if damage.is_some() {
            return Ok(end(false, damage));
        }
    }
}

/// Returns the records of a chunk. The reader of the crate `mcap` does not check that the records of a chunk end with
/// it.
fn unpacked(chunk: &[u8]) -> Result<Cow<'_, [u8]>, RecordingError> {
    let (header, stored) = fields::chunk(chunk).ok_or(RecordingError::Malformed(op::CHUNK))?;
    let records = match header.compression.as_str() {
        "" => Cow::Borrowed(stored),
        "zstd" if header.uncompressed_size > MAX_RECORD as u64 => {
            return Err(McapError::ChunkTooLarge(header.uncompressed_size).into());
        }
        "zstd" => {
            let unpacked = unpacked_zstd(stored, header.uncompressed_size);
            let unpacked = unpacked.map_err(|it| McapError::DecompressionError(it.to_string()))?;
            Cow::Owned(unpacked)
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
    /// Visits the item of a record, if it has one. Returns its damage.
    fn visit(
        &mut self,
        opcode: u8,
        data: &[u8],
        visit: &mut impl FnMut(Item<'_>) -> Result<(), Failure>,
    ) -> Result<Option<RecordingError>, Failure> {
        match self.item(opcode, data) {
            Ok(Some(item)) => visit(item)?,
            Ok(None) => {}
            Err(error) => return Ok(Some(error)),
        }
        Ok(None)
    }

    /// Visits the items of the records of a chunk up to the first damage, and returns it.
    fn visit_chunk(
        &mut self,
        mut records: &[u8],
        visit: &mut impl FnMut(Item<'_>) -> Result<(), Failure>,
    ) -> Result<Option<RecordingError>, Failure> {
        while !records.is_empty() {
            let Some((opcode, data)) = fields::next_record(&mut records) else {
                return Ok(Some(RecordingError::Malformed(op::CHUNK)));
            };
            let damage = self.visit(opcode, data, visit)?;
            if damage.is_some() {
                return Ok(damage);
            }
        }
        Ok(None)
    }

    /// Returns the item of a record, or `None` if it is none.
    fn item<'a>(
        &'a mut self,
        opcode: u8,
        data: &'a [u8],
    ) -> Result<Option<Item<'a>>, RecordingError> {
        let malformed = || RecordingError::Malformed(opcode);
        let len = data.len();
        if matches!(opcode, op::CHANNEL | op::METADATA) && len > MAX_PAIRS {
            let len = len as u64;
            return Err(McapError::RecordTooLarge { opcode, len }.into());
        }
        match opcode {
            op::SCHEMA => {
                let (header, text) = fields::schema(data).ok_or_else(malformed)?;
                // A repetition has the same data.
                if !self.schemas.contains_key(&header.id) {
                    self.count(len)?;
                    let data = text.to_vec();
                    self.schemas.insert(header.id, FileSchema { header, data });
                }
                Ok(None)
            }
            op::CHANNEL => {
                let channel = fields::channel(data).ok_or_else(malformed)?;
                if !self.channels.contains_key(&channel.id) {
                    self.count(len.saturating_add(channel.metadata.len() * PAIR))?;
                    self.channels.insert(channel.id, channel);
                }
                Ok(None)
            }
            op::MESSAGE => {
                let (header, data) = fields::message(data).ok_or_else(malformed)?;
                let id = header.channel_id;
                let channel = self.channels.get(&id);
                let channel = channel.ok_or(RecordingError::UnknownChannel(id))?;
                Ok(Some(Item::Message {
                    channel,
                    schema: self.schemas.get(&channel.schema_id),
                    header,
                    data,
                }))
            }
            op::METADATA => {
                let metadata = fields::metadata(data).ok_or_else(malformed)?;
                Ok(Some(Item::Metadata(metadata)))
            }
            // Other records are not parsed.
            _ => Ok(None),
        }
    }

    fn count(&mut self, bytes: usize) -> Result<(), RecordingError> {
        self.bytes = self.bytes.saturating_add(bytes);
        match self.bytes > MAX_CHANNELS {
            true => Err(RecordingError::TooManyChannels(MAX_CHANNELS)),
            false => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests;
