//! Takes files in the format MCAP apart, and puts them together with other chunks.

/// Length of the magic number.
const MAGIC: usize = 8;
const CHUNK: u8 = 6;

/// The compression of a chunk.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Compression {
    None,
    Zstd,
}

/// Returns the file with its chunks changed by `change`, and with valid lengths and checksums.
pub(crate) fn rechunked(
    file: &[u8],
    compression: Compression,
    mut change: impl FnMut(&mut Vec<u8>),
) -> Vec<u8> {
    let (magic, mut rest) = file.split_at(MAGIC);
    let mut all = magic.to_vec();
    // Behind the last record is the magic number again.
    while rest.len() > MAGIC {
        let len = 9 + usize::try_from(number(&rest[1..9])).unwrap();
        let (record, next) = rest.split_at(len);
        rest = next;
        if record[0] == CHUNK {
            let mut records = records_of(&record[9..]);
            change(&mut records);
            all.extend(chunk(&records, compression));
        } else {
            all.extend(record);
        }
    }
    all.extend(rest);
    all
}

/// Returns the records of a chunk.
fn records_of(chunk: &[u8]) -> Vec<u8> {
    let compression = 32 + usize::try_from(number(&chunk[28..32])).unwrap();
    let stored = &chunk[compression + 8..];
    match &chunk[32..compression] {
        b"" => stored.to_vec(),
        _ => zstd::decode_all(stored).unwrap(),
    }
}

/// A chunk with these records.
pub(crate) fn chunk(records: &[u8], compression: Compression) -> Vec<u8> {
    let (name, stored) = match compression {
        Compression::None => ("", records.to_vec()),
        Compression::Zstd => ("zstd", zstd::encode_all(records, 1).unwrap()),
    };
    let checksum = crc32fast::hash(records);
    chunk_of(records.len() as u64, checksum, name, &stored)
}

/// A chunk that announces records of this length and checksum.
pub(crate) fn chunk_of(len: u64, checksum: u32, compression: &str, stored: &[u8]) -> Vec<u8> {
    let mut chunk = vec![0; 16];
    chunk.extend(len.to_le_bytes());
    chunk.extend(checksum.to_le_bytes());
    chunk.extend(u32::try_from(compression.len()).unwrap().to_le_bytes());
    chunk.extend(compression.as_bytes());
    chunk.extend((stored.len() as u64).to_le_bytes());
    chunk.extend(stored);
    record(CHUNK, &chunk)
}

/// A record of the file or of a chunk.
pub(crate) fn record(opcode: u8, data: &[u8]) -> Vec<u8> {
    let mut record = vec![opcode];
    record.extend((data.len() as u64).to_le_bytes());
    record.extend(data);
    record
}

fn number(bytes: &[u8]) -> u64 {
    let bytes = bytes.iter().rev();
    bytes.fold(0, |number, byte| number << 8 | u64::from(*byte))
}
