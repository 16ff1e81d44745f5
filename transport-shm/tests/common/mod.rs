//! Test support: a domain of its own, endpoints, and a sink that records.

// Every test binary uses a part of this.
#![allow(dead_code)]
#![allow(clippy::unwrap_used, reason = "a failed precondition fails the test")]

use std::fs::File;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use bytes::Bytes;
use fipa_acl::{Letter, Payload};
use fipa_transport::{
    Answer, Arrival, AttemptId, Body, Conclusion, Hop, Incarnation, Kind, LegacySource, Location,
    Parcel, Reaction, Sink, Stream, Transport, TransportErrorKind,
};
use fipa_transport_shm::{ShmConfig, ShmTransport};
use std::sync::{Condvar, Mutex};
use tokio::runtime::Runtime;

/// A domain with a unique name, removed at the end.
pub(crate) struct TestDomain {
    // First: its tasks use the domain.
    pub(crate) runtime: Runtime,
    pub(crate) directory: tempfile::TempDir,
    pub(crate) prefix: String,
    _remains: Remains,
}

/// Files in shared memory that are left at the end of a test. If the process ends at once, a thread that has just
/// answered a letter may still own the last part of an endpoint, and does not remove the files.
struct Remains(String);

impl Drop for Remains {
    fn drop(&mut self) {
        for entry in std::fs::read_dir("/dev/shm")
            .into_iter()
            .flatten()
            .flatten()
        {
            if entry.file_name().to_string_lossy().starts_with(&self.0) {
                // The endpoint may have removed it meanwhile.
                let _ = std::fs::remove_file(entry.path());
            }
        }
    }
}

impl TestDomain {
    pub(crate) fn new() -> Self {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .unwrap();
        let prefix = format!("fipatest-{}", Incarnation::random());
        Self {
            directory: tempfile::tempdir().unwrap(),
            _remains: Remains(prefix.clone()),
            prefix,
            runtime,
        }
    }

    pub(crate) fn config(&self) -> ShmConfig {
        let root = self.directory.path().join("domain");
        ShmConfig::new(root, &self.prefix, Incarnation::random())
    }

    pub(crate) fn endpoint(&self) -> ShmTransport {
        self.endpoint_with(self.config())
    }

    pub(crate) fn endpoint_with(&self, config: ShmConfig) -> ShmTransport {
        ShmTransport::new(config, self.runtime.handle().clone()).unwrap()
    }

    /// An endpoint that listens, with its sink.
    pub(crate) fn listening(&self) -> (Arc<ShmTransport>, Arc<RecordingSink>) {
        self.listening_with(self.config())
    }

    pub(crate) fn listening_with(
        &self,
        config: ShmConfig,
    ) -> (Arc<ShmTransport>, Arc<RecordingSink>) {
        let endpoint = Arc::new(self.endpoint_with(config));
        let sink = Arc::new(RecordingSink::default());
        endpoint.listen(sink.clone()).unwrap();
        (endpoint, sink)
    }

    /// Takes the lock of the domain, which processes hold while they start, end and clean up.
    pub(crate) fn locked(&self) -> File {
        let lock = File::open(self.directory.path().join("domain")).unwrap();
        lock.lock().unwrap();
        lock
    }

    /// Takes the lock under which processes of the domain allocate memory.
    pub(crate) fn memory_locked(&self) -> File {
        let lock = File::open(self.directory.path().join("domain/processes")).unwrap();
        lock.lock().unwrap();
        lock
    }

    /// Waits until no file of the domain remains. A thread that has just answered a letter may still own
    /// the last part of an endpoint that was dropped.
    pub(crate) fn until_removed(&self) {
        fipa_testbed::until("all files are removed", || self.files().is_empty());
    }

    /// All files of this domain, sorted.
    pub(crate) fn files(&self) -> Vec<String> {
        files(self.directory.path(), &self.prefix)
    }
}

pub(crate) fn files(root: &Path, prefix: &str) -> Vec<String> {
    let mut found = Vec::new();
    let mut directories = vec![root.to_owned()];
    while let Some(directory) = directories.pop() {
        for entry in std::fs::read_dir(&directory)
            .into_iter()
            .flatten()
            .flatten()
        {
            if entry.file_type().is_ok_and(|kind| kind.is_dir()) {
                directories.push(entry.path());
            } else {
                found.push(entry.path().display().to_string());
            }
        }
    }
    for entry in std::fs::read_dir("/dev/shm").unwrap().flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        if name.starts_with(prefix) {
            found.push(format!("/dev/shm/{name}"));
        }
    }
    found.sort();
    found
}

pub(crate) fn location_of(incarnation: Incarnation) -> Location {
    Location::new(Kind::Shm, &incarnation.to_string())
        .unwrap()
        .with_incarnation(incarnation)
}

/// A sink that accepts everything and records its calls.
#[derive(Default)]
pub(crate) struct RecordingSink {
    pub(crate) arrived: Mutex<Vec<(Parcel, Hop)>>,
    pub(crate) concluded: Mutex<Vec<(AttemptId, Conclusion)>>,
}

impl Sink for RecordingSink {
    fn arrived(&self, arrival: Arrival) -> Reaction {
        let mut arrived = self.arrived.lock().unwrap();
        arrived.push((arrival.parcel, arrival.from));
        Reaction::Now(Answer::Accepted)
    }

    fn arrived_unframed(&self, _letter: Letter, _via: Kind, _from: LegacySource) {
        panic!("shared memory has no letters without a frame");
    }

    fn concluded(&self, attempt: AttemptId, conclusion: Conclusion) {
        self.concluded.lock().unwrap().push((attempt, conclusion));
    }
}

impl RecordingSink {
    pub(crate) fn arrivals(&self) -> usize {
        self.arrived.lock().unwrap().len()
    }

    pub(crate) fn conclusions(&self) -> usize {
        self.concluded.lock().unwrap().len()
    }

    pub(crate) fn conclusion_of(&self, attempt: AttemptId) -> Option<Conclusion> {
        let concluded = self.concluded.lock().unwrap();
        let found = concluded.iter().find(|(one, _)| *one == attempt);
        found.map(|(_, conclusion)| conclusion.clone())
    }

    /// The content of the letter that arrived at this index.
    pub(crate) fn content(&self, index: usize) -> Bytes {
        match &self.arrived.lock().unwrap()[index].0.body {
            Body::Letter(letter) => letter.payload().content.clone(),
            other => panic!("{other:?}"),
        }
    }
}

/// A sink whose thread waits within a conclusion while the gate is closed.
#[derive(Default)]
pub(crate) struct GatedSink {
    pub(crate) recorded: RecordingSink,
    is_closed: Mutex<bool>,
    opened: Condvar,
    waits: AtomicBool,
}

impl GatedSink {
    pub(crate) fn close_gate(&self) {
        *self.is_closed.lock().unwrap() = true;
    }

    pub(crate) fn open_gate(&self) {
        *self.is_closed.lock().unwrap() = false;
        self.opened.notify_all();
    }

    /// Whether a thread waits within a conclusion.
    pub(crate) fn is_waiting(&self) -> bool {
        self.waits.load(Ordering::SeqCst)
    }
}

impl Sink for GatedSink {
    fn arrived(&self, arrival: Arrival) -> Reaction {
        self.recorded.arrived(arrival)
    }

    fn arrived_unframed(&self, letter: Letter, via: Kind, from: LegacySource) {
        self.recorded.arrived_unframed(letter, via, from);
    }

    fn concluded(&self, attempt: AttemptId, conclusion: Conclusion) {
        self.recorded.concluded(attempt, conclusion);
        let mut is_closed = self.is_closed.lock().unwrap();
        while *is_closed {
            self.waits.store(true, Ordering::SeqCst);
            is_closed = self.opened.wait(is_closed).unwrap();
        }
        self.waits.store(false, Ordering::SeqCst);
    }
}

pub(crate) fn attempt() -> AttemptId {
    static NEXT: AtomicU64 = AtomicU64::new(1);
    AttemptId(NEXT.fetch_add(1, Ordering::Relaxed))
}

/// A parcel with a letter that has separate content.
pub(crate) fn parcel(content: Bytes) -> Parcel {
    let payload = Payload {
        head: Bytes::from_static(b"message up to its content"),
        content,
        tail: Bytes::from_static(b"\x01"),
    };
    Parcel {
        receiver: "arm_left".into(),
        stream: Stream::between(Incarnation::from_u64(1), Incarnation::from_u64(2)),
        sequence: 1,
        after: 0,
        remaining: Duration::from_secs(5),
        transfer: 0,
        body: Body::Letter(Letter::new(Bytes::from_static(b"envelope"), payload)),
    }
}

/// Length of the pieces in front of the content of [`parcel`].
pub(crate) const FRONT: usize =
    "arm_left".len() + "envelope".len() + "message up to its content".len();

/// The part of a file that memory of this process is mapped from.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct MappedRange {
    pub(crate) device: String,
    pub(crate) inode: String,
    /// Offset in the file, in bytes.
    pub(crate) offset: usize,
    pub(crate) path: Option<String>,
}

/// The mapping that contains these bytes, from `/proc/self/maps`.
/// Waits until the mailbox of the other side is open: until then, a loan fails as congested.
pub(crate) fn open(sender: &ShmTransport, receiver: &Location) {
    fipa_testbed::until("the mailbox is open", || {
        match sender.loan(receiver, 100, 100, 1) {
            Ok(loan) => loan.is_some(),
            Err(error) if error.fault == TransportErrorKind::Congested => false,
            Err(error) => panic!("{error}"),
        }
    });
}

pub(crate) fn mapping_of(bytes: &[u8]) -> MappedRange {
    let address = bytes.as_ptr() as usize;
    let maps = std::fs::read_to_string("/proc/self/maps").unwrap();
    let found = maps.lines().find_map(|line| {
        let mut fields = line.split_whitespace();
        let (start, end) = fields.next()?.split_once('-')?;
        let start = usize::from_str_radix(start, 16).ok()?;
        let end = usize::from_str_radix(end, 16).ok()?;
        let offset = usize::from_str_radix(fields.nth(1)?, 16).ok()?;
        let (device, inode) = (fields.next()?, fields.next()?);
        let path = fields.next().filter(|path| path.starts_with('/'));
        let contains = (start..end).contains(&address) && address + bytes.len() <= end;
        contains.then(|| MappedRange {
            device: device.to_owned(),
            inode: inode.to_owned(),
            offset: address - start + offset,
            path: path.map(str::to_owned),
        })
    });
    found.unwrap()
}
