//! Parses the records of a file that have texts.
//!
//! The parser of the crate `mcap` takes memory for the announced length of a text before it reads the text. A length here
//! is checked against the length of the record.

use std::collections::BTreeMap;

use mcap::records::{Channel, ChunkHeader, MessageHeader, Metadata, SchemaHeader};

/// The rest of a record.
struct Fields<'a>(&'a [u8]);

impl<'a> Fields<'a> {
    fn bytes(&mut self, len: usize) -> Option<&'a [u8]> {
        let (bytes, rest) = self.0.split_at_checked(len)?;
        self.0 = rest;
        Some(bytes)
    }

    fn array<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (array, rest) = self.0.split_first_chunk()?;
        self.0 = rest;
        Some(*array)
    }

    fn u16(&mut self) -> Option<u16> {
        self.array().map(u16::from_le_bytes)
    }

    fn u32(&mut self) -> Option<u32> {
        self.array().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Option<u64> {
        self.array().map(u64::from_le_bytes)
    }

    /// Bytes behind their length.
    fn prefixed(&mut self) -> Option<&'a [u8]> {
        let len = usize::try_from(self.u32()?).ok()?;
        self.bytes(len)
    }

    fn text(&mut self) -> Option<String> {
        std::str::from_utf8(self.prefixed()?)
            .ok()
            .map(str::to_owned)
    }

    fn map(&mut self) -> Option<BTreeMap<String, String>> {
        let mut pairs = Self(self.prefixed()?);
        let mut map = BTreeMap::new();
        while !pairs.0.is_empty() {
            let key = pairs.text()?;
            map.insert(key, pairs.text()?);
        }
        Some(map)
    }
}

/// Returns a chunk and its records as they are stored; `None` if the record is malformed.
pub(super) fn chunk(record: &[u8]) -> Option<(ChunkHeader, &[u8])> {
    let mut fields = Fields(record);
    let header = ChunkHeader {
        message_start_time: fields.u64()?,
        message_end_time: fields.u64()?,
        uncompressed_size: fields.u64()?,
        uncompressed_crc: fields.u32()?,
        compression: fields.text()?,
        compressed_size: fields.u64()?,
    };
    let len = usize::try_from(header.compressed_size).ok()?;
    Some((header, fields.bytes(len)?))
}

/// Splits the first record off the records of a chunk; `None` if it is not whole.
pub(super) fn next_record<'a>(records: &mut &'a [u8]) -> Option<(u8, &'a [u8])> {
    let mut fields = Fields(records);
    let [opcode] = fields.array()?;
    let len = usize::try_from(fields.u64()?).ok()?;
    let data = fields.bytes(len)?;
    *records = fields.0;
    Some((opcode, data))
}

/// Returns a schema and its data; `None` if the record is malformed.
pub(super) fn schema(record: &[u8]) -> Option<(SchemaHeader, &[u8])> {
    let mut fields = Fields(record);
    let header = SchemaHeader {
        id: fields.u16()?,
        name: fields.text()?,
        encoding: fields.text()?,
    };
    Some((header, fields.prefixed()?))
}

/// Returns a channel; `None` if the record is malformed.
pub(super) fn channel(record: &[u8]) -> Option<Channel> {
    let mut fields = Fields(record);
    Some(Channel {
        id: fields.u16()?,
        schema_id: fields.u16()?,
        topic: fields.text()?,
        message_encoding: fields.text()?,
        metadata: fields.map()?,
    })
}

/// Returns a message and its data; `None` if the record is malformed.
pub(super) fn message(record: &[u8]) -> Option<(MessageHeader, &[u8])> {
    let mut fields = Fields(record);
    let header = MessageHeader {
        channel_id: fields.u16()?,
        sequence: fields.u32()?,
        log_time: fields.u64()?,
        publish_time: fields.u64()?,
    };
    Some((header, fields.0))
}

/// Returns a metadata record; `None` if it is malformed.
pub(super) fn metadata(record: &[u8]) -> Option<Metadata> {
    let mut fields = Fields(record);
    Some(Metadata {
        name: fields.text()?,
        metadata: fields.map()?,
    })
}
