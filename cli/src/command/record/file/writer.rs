//! Writes recordings: chunks that are complete on the disk at short intervals, and files that are split.

use std::collections::{BTreeMap, HashMap};
use std::ffi::OsStr;
use std::fs::{self, File, OpenOptions};
use std::io::{self, BufWriter, Seek, SeekFrom, Write};
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use mcap::records::{MessageHeader, Metadata};
use mcap::{WriteOptions, Writer};

use super::{RecordingError, Schema};

/// Length of a chunk before compression, in bytes.
const CHUNK: u64 = 1 << 20;
/// Level of the compression with zstd: the fastest of the positive ones.
const LEVEL: u32 = 1;
/// Number of channels from which on values of further topics are not recorded. The format has at most 65,535.
const MAX_CHANNELS: usize = 4096;
/// Number of digits of a date such as 20260301. A file with a date in its name is none of a split recording.
const DATE: usize = 8;
/// Bytes that are collected before a write.
const BUFFER: usize = 256 << 10;

/// The channel of a message.
#[derive(Debug, Clone, Copy)]
pub(in crate::command) struct Target<'a> {
    pub(in crate::command) topic: &'a str,
    pub(in crate::command) encoding: &'a str,
    pub(in crate::command) schema: Option<Schema>,
}

/// The times and the number of a message.
#[derive(Debug, Clone, Copy)]
pub(in crate::command) struct Stamp {
    pub(in crate::command) nanos: u64,
    pub(in crate::command) sequence: u32,
}

/// A file that is being written.
pub(in crate::command) struct RecordingFile {
    writer: Writer<BufWriter<Counted>>,
    file: Arc<File>,
    written: Arc<AtomicU64>,
    /// By topic and encoding: names of agents and of topics can make equal topics.
    channels: HashMap<String, HashMap<String, u16>>,
}

impl RecordingFile {
    /// Creates a file. Fails if it exists.
    pub(in crate::command) fn create(path: &Path) -> Result<Self, RecordingError> {
        let file = OpenOptions::new().write(true).create_new(true).open(path)?;
        let file = Arc::new(file);
        let written = Arc::new(AtomicU64::new(0));
        let counted = Counted {
            file: Arc::clone(&file),
            written: Arc::clone(&written),
        };
        let options = WriteOptions::new()
            .library(concat!("fipa ", env!("CARGO_PKG_VERSION")))
            .chunk_size(Some(CHUNK))
            .compression_level(LEVEL)
            // In the thread of the caller.
            .compression_threads(0)
            // A chunk is written as a whole, so that a killed process leaves complete ones.
            .disable_seeking(true);
        let writer = options.create(BufWriter::with_capacity(BUFFER, counted))?;
        Ok(Self {
            writer,
            file,
            written,
            channels: HashMap::new(),
        })
    }

    /// Writes a message.
    pub(in crate::command) fn write(
        &mut self,
        target: Target<'_>,
        stamp: Stamp,
        data: &[u8],
    ) -> Result<(), RecordingError> {
        let channel_id = match self.channel(target.topic, target.encoding) {
            Some(channel) => channel,
            None => self.add_channel(target)?,
        };
        let header = MessageHeader {
            channel_id,
            sequence: stamp.sequence,
            log_time: stamp.nanos,
            publish_time: stamp.nanos,
        };
        self.writer.write_to_known_channel(&header, data)?;
        Ok(())
    }

    /// Whether a message with this encoding needs no channel beyond [`MAX_CHANNELS`].
    pub(in crate::command) fn has_room(&self, topic: &str, encoding: &str) -> bool {
        let channels = || self.channels.values().map(HashMap::len).sum::<usize>();
        self.channel(topic, encoding).is_some() || channels() < MAX_CHANNELS
    }

    fn channel(&self, topic: &str, encoding: &str) -> Option<u16> {
        self.channels.get(topic)?.get(encoding).copied()
    }

    fn add_channel(&mut self, target: Target<'_>) -> Result<u16, RecordingError> {
        let schema = match target.schema {
            Some(Schema { name, text }) => {
                self.writer
                    .add_schema(name, "jsonschema", text.as_bytes())?
            }
            None => 0,
        };
        let none = BTreeMap::new();
        let Target {
            topic, encoding, ..
        } = target;
        let channel = self.writer.add_channel(schema, topic, encoding, &none)?;
        let channels = self.channels.entry(topic.to_owned()).or_default();
        channels.insert(encoding.to_owned(), channel);
        Ok(channel)
    }

    /// The writer of the format, for copies of records.
    pub(in crate::command) fn format(&mut self) -> &mut Writer<impl Write + Seek + use<>> {
        &mut self.writer
    }

    /// Writes a metadata record.
    pub(in crate::command) fn write_metadata(
        &mut self,
        name: &str,
        metadata: BTreeMap<String, String>,
    ) -> Result<(), RecordingError> {
        let name = name.to_owned();
        self.writer.write_metadata(&Metadata { name, metadata })?;
        Ok(())
    }

    /// Bytes that are written to the file.
    pub(in crate::command) fn written(&self) -> u64 {
        self.written.load(Ordering::Relaxed)
    }

    /// Ends the chunk and writes it. Returns the file, which the caller synchronizes with the disk.
    pub(in crate::command) fn flush(&mut self) -> Result<Arc<File>, RecordingError> {
        self.writer.flush()?;
        Ok(Arc::clone(&self.file))
    }

    /// Whether another program has removed the file.
    pub(in crate::command) fn is_removed(&self) -> Result<bool, RecordingError> {
        Ok(self.file.metadata()?.nlink() == 0)
    }

    /// Writes the index and synchronizes the file with the disk. Returns the length of the file.
    pub(in crate::command) fn finish(mut self) -> Result<u64, RecordingError> {
        self.writer.finish()?;
        self.writer.into_inner().flush()?;
        self.file.sync_all()?;
        Ok(self.written.load(Ordering::Relaxed))
    }
}

/// A file whose written bytes are counted.
struct Counted {
    file: Arc<File>,
    written: Arc<AtomicU64>,
}

impl Write for Counted {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let written = (&*self.file).write(bytes)?;
        self.written.fetch_add(written as u64, Ordering::Relaxed);
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        (&*self.file).flush()
    }
}

impl Seek for Counted {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        (&*self.file).seek(to)
    }
}

/// The files of a recording and their limits.
#[derive(Debug, Clone)]
pub(in crate::command) struct Split {
    /// The path of the only file. Files of a split recording have a number before the extension.
    pub(in crate::command) path: PathBuf,
    /// Approximate maximum length of a file in bytes.
    pub(in crate::command) size: Option<u64>,
    /// Maximum time of a file.
    pub(in crate::command) duration: Option<Duration>,
    /// Maximum number of files; the oldest ones are deleted.
    pub(in crate::command) keep: Option<usize>,
}

impl Split {
    fn is_split(&self) -> bool {
        self.size.is_some() || self.duration.is_some()
    }

    /// The path of a file of a split recording.
    fn numbered(&self, number: u64) -> PathBuf {
        let (stem, extension) = self.parts();
        self.path
            .with_file_name(format!("{stem}_{number:04}{extension}"))
    }

    fn parts(&self) -> (String, String) {
        let text = |part: Option<&OsStr>| part.unwrap_or_default().to_string_lossy().into_owned();
        let extension = match self.path.extension() {
            Some(extension) => format!(".{}", extension.to_string_lossy()),
            None => String::new(),
        };
        (text(self.path.file_stem()), extension)
    }

    /// The numbers of the files that exist, in order.
    fn existing(&self) -> io::Result<Vec<u64>> {
        let (stem, extension) = self.parts();
        let directory = match self.path.parent() {
            Some(parent) if !parent.as_os_str().is_empty() => parent,
            _ => Path::new("."),
        };
        let mut numbers = Vec::new();
        for entry in fs::read_dir(directory)? {
            let name = entry?.file_name();
            let name = name.to_string_lossy();
            let number = name
                .strip_prefix(&stem)
                .and_then(|rest| rest.strip_prefix('_'))
                .and_then(|rest| rest.strip_suffix(&extension))
                .filter(|digits| {
                    digits.len() < DATE && digits.bytes().all(|it| it.is_ascii_digit())
                })
                .and_then(|digits| digits.parse::<u64>().ok())
                .filter(|number| self.numbered(*number).file_name() == Some(OsStr::new(&*name)));
            numbers.extend(number);
        }
        numbers.sort_unstable();
        Ok(numbers)
    }

    /// The path of the next file. Files of an earlier recording with the same name stay.
    pub(in crate::command) fn next(&self) -> io::Result<PathBuf> {
        if !self.is_split() {
            return Ok(self.path.clone());
        }
        let last = self.existing()?.last().copied();
        Ok(self.numbered(last.map_or(0, |last| last.saturating_add(1))))
    }

    /// Deletes the oldest files beyond the number to keep.
    pub(in crate::command) fn delete_oldest(&self) -> io::Result<()> {
        let Some(keep) = self.keep.filter(|_| self.is_split()) else {
            return Ok(());
        };
        let existing = self.existing()?;
        let excess = existing.len().saturating_sub(keep);
        for number in existing.into_iter().take(excess) {
            match fs::remove_file(self.numbered(number)) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
                _ => {}
            }
        }
        Ok(())
    }

    /// Whether a file of this length and age is full.
    pub(in crate::command) fn is_full(&self, written: u64, since: Instant) -> bool {
        self.size.is_some_and(|size| written >= size)
            || self.duration.is_some_and(|time| since.elapsed() >= time)
    }
}

/// Synchronizes files with the disk in a thread of its own, because a slow disk must not delay the recording.
pub(in crate::command) struct Syncer {
    files: SyncSender<Arc<File>>,
    thread: JoinHandle<io::Result<()>>,
}

impl Syncer {
    pub(in crate::command) fn start() -> io::Result<Self> {
        let (files, requests) = sync_channel(1);
        let run = move || sync_all(&requests);
        let thread = std::thread::Builder::new().name("fipa-sync".to_owned());
        Ok(Self {
            files,
            thread: thread.spawn(run)?,
        })
    }

    /// Requests that a file be synchronized. Does nothing if earlier requests wait. Returns whether the thread runs.
    pub(in crate::command) fn request(&self, file: Arc<File>) -> bool {
        !matches!(
            self.files.try_send(file),
            Err(TrySendError::Disconnected(_))
        )
    }

    /// Ends the thread. Returns its error.
    pub(in crate::command) fn end(self) -> io::Result<()> {
        drop(self.files);
        match self.thread.join() {
            Ok(ended) => ended,
            Err(_) => Err(io::Error::other(
                "the thread that synchronizes files has panicked",
            )),
        }
    }
}

fn sync_all(requests: &Receiver<Arc<File>>) -> io::Result<()> {
    while let Ok(file) = requests.recv() {
        file.sync_data()?;
    }
    Ok(())
}
