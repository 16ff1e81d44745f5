//! The task that watches the directory.
//!
//! When a process ends, in any way, the kernel closes its lock file, which was open for writing,
//! and reports that to every watcher. A process that cannot get an inotify instance, of which the
//! kernel limits the number per user, polls the directory instead. So does a process that is expected
//! to end soon.

use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsStr;
use std::future::poll_fn;
use std::io::{self, ErrorKind};
use std::ops::Bound;
use std::pin::Pin;
use std::sync::Arc;
use std::task::Poll;
use std::time::Duration;

use fipa_acl::ErrorChain;
use fipa_transport::log_limit;
use futures_core::Stream as _;
use inotify::{EventMask, EventStream, Inotify, WatchDescriptor, WatchMask, Watches};
use tokio::time::Instant;

use super::HostError;
use super::host_dir::{HostDir, Id, Name};
use super::shared::Shared;

pub(super) struct Watcher {
    events: Events,
}

/// Bytes of events that are read at once.
const BUFFER: usize = 16 * 1024;

/// Source of changes of the directory.
enum Events {
    Inotify {
        events: EventStream<Vec<u8>>,
        /// The watch of the directory; others are of files whose removal is reported.
        dir: WatchDescriptor,
    },
    Polling(Poller),
}

impl Watcher {
    /// Watches from now on. Must be called within a tokio runtime.
    pub(super) fn new(host_dir: &HostDir) -> Self {
        let events = match Self::inotify(host_dir) {
            Ok((events, dir)) => Events::Inotify { events, dir },
            Err(error) => {
                log_limit::warn!(
                    error = %ErrorChain(&error),
                    "no inotify watch for {}: polling it every {} ms; raise \
                     fs.inotify.max_user_instances (sysctl)",
                    host_dir.path().display(),
                    POLL_EVERY.as_millis()
                );
                Events::Polling(Poller::default())
            }
        };
        Self { events }
    }

    /// Polls from now on.
    pub(super) fn polling() -> Self {
        Self {
            events: Events::Polling(Poller::default()),
        }
    }

    /// Adds watches of files, if the kernel reports changes.
    pub(super) fn watches(&self) -> Option<Watches> {
        match &self.events {
            Events::Inotify { events, .. } => Some(events.watches()),
            Events::Polling(_) => None,
        }
    }

    fn inotify(host_dir: &HostDir) -> io::Result<(EventStream<Vec<u8>>, WatchDescriptor)> {
        let inotify = Inotify::init()?;
        let mask = WatchMask::CLOSE_WRITE
            | WatchMask::MOVED_TO
            | WatchMask::DELETE
            | WatchMask::DELETE_SELF
            | WatchMask::MOVE_SELF
            | WatchMask::ONLYDIR;
        let mut watches = inotify.watches();
        let dir = watches.add(host_dir.pinned_path(), mask)?;
        Ok((inotify.into_event_stream(vec![0; BUFFER])?, dir))
    }

    /// Keeps the view up to date until it is aborted. At `settled`, entries from before a removal
    /// of the directory are dropped, unless their process has joined again.
    ///
    /// The first change is read at once, and later ones are collected during a pause: a process
    /// that registers a hundred agents replaces its file a hundred times, and reading each version
    /// would take quadratic time.
    pub(super) async fn run(mut self, shared: Arc<Shared>, mut settled: Option<Instant>) {
        let mut ending = EndingProcesses::default();
        let mut pause = Pause::default();
        loop {
            let waiting = Instant::now();
            let changes = tokio::select! {
                changes = self.changes(&shared) => changes,
                () = ending.due() => Ok(DirChanges::default()),
                () = sleep_until(settled) => {
                    settled = None;
                    ending.rescan = true;
                    Ok(DirChanges::default())
                }
            };
            let began = Instant::now();
            let handled = changes.and_then(|changes| handle(&shared, changes, &mut ending));
            if let Err(error) = handled {
                if matches!(shared.is_there(), Ok(false)) {
                    // A rejoin ends this watcher.
                    shared.report_disturbed();
                } else {
                    log_limit::error!(error = %ErrorChain(&error), "the view of the host's directory may be out of date");
                }
                // The error may persist (for example `EMFILE`); the pause prevents a busy loop.
                tokio::time::sleep(Duration::from_millis(100)).await;
                ending.rescan = true;
            }
            let pause = pause.after(began - waiting, began.elapsed());
            self = self.pause(pause).await;
        }
    }

    /// Collects changes for this time. The runtime does not watch the events meanwhile: each one would wake it,
    /// in every process of the domain.
    async fn pause(self, pause: Duration) -> Self {
        let events = match self.events {
            Events::Inotify { events, dir } => {
                let inotify = events.into_inotify();
                tokio::time::sleep(pause).await;
                match inotify.into_event_stream(vec![0; BUFFER]) {
                    Ok(events) => Events::Inotify { events, dir },
                    Err(error) => {
                        log_limit::warn!(error = %ErrorChain(&error), "no inotify events: polling the directory");
                        Events::Polling(Poller::default())
                    }
                }
            }
            polling @ Events::Polling(_) => {
                tokio::time::sleep(pause).await;
                polling
            }
        };
        Self { events }
    }

    /// Waits for at least one change, and returns all since the last call.
    async fn changes(&mut self, shared: &Shared) -> Result<DirChanges, HostError> {
        match &mut self.events {
            Events::Inotify { events, dir } => {
                next_events(events, dir)
                    .await
                    .map_err(|source| HostError::Watch {
                        path: shared.host_dir().path().to_owned(),
                        source,
                    })
            }
            Events::Polling(poller) => loop {
                tokio::time::sleep(POLL_EVERY).await;
                let changes = poller.poll(&shared.host_dir())?;
                if !changes.is_empty() {
                    return Ok(changes);
                }
            },
        }
    }
}

async fn next_events(
    events: &mut EventStream<Vec<u8>>,
    dir: &WatchDescriptor,
) -> io::Result<DirChanges> {
    let mut changes = DirChanges::default();
    poll_fn(|context| {
        // Bounded, so that other tasks can run.
        for _ in 0..MOST_EVENTS {
            match Pin::new(&mut *events).poll_next(context) {
                Poll::Ready(Some(event)) => {
                    let event = event?;
                    match event.wd == *dir || event.mask.contains(EventMask::Q_OVERFLOW) {
                        true => {
                            let name = event.name.as_deref().and_then(OsStr::to_str);
                            changes.add(event.mask, name);
                        }
                        false => changes.disturbed = true,
                    }
                }
                // The stream does not end.
                Poll::Ready(None) => return Poll::Ready(Err(ErrorKind::UnexpectedEof.into())),
                Poll::Pending if changes.is_empty() => return Poll::Pending,
                Poll::Pending => return Poll::Ready(Ok(std::mem::take(&mut changes))),
            }
        }
        // The pause that follows drops events that the stream has read ahead.
        changes.lost = true;
        Poll::Ready(Ok(std::mem::take(&mut changes)))
    })
    .await
}

/// Maximum number of events that are handled together.
const MOST_EVENTS: usize = 4096;

/// Interval between polls of the directory without inotify.
const POLL_EVERY: Duration = Duration::from_millis(100);

/// Maximum number of processes whose lock is tried in one poll. Each costs four system calls.
/// Another process with an inotify instance removes the files of dead processes, which one poll
/// detects.
const LOCKS_PER_POLL: usize = 8;

/// Detects what inotify would report.
#[derive(Debug, Default)]
struct Poller {
    /// Generation and time of the last change, as of the last poll.
    seen: Option<(u64, (i64, u64))>,
    /// Whether `seen` was the same in the last two polls. Two changes within one tick of the kernel's
    /// clock have the same time, so the directory is read once more after each change.
    settled: bool,
    /// Processes that have files in the directory.
    processes: BTreeSet<Id>,
    /// Process whose lock was tried last.
    tried: Option<Id>,
}

impl Poller {
    fn poll(&mut self, host_dir: &HostDir) -> Result<DirChanges, HostError> {
        let mut changes = DirChanges::default();
        let now = Some((host_dir.generation()?, host_dir.changed()?));
        let changed = self.seen != now;
        if changed || !self.settled {
            self.read(host_dir, &mut changes)?;
        }
        (self.seen, self.settled) = (now, !changed);
        self.try_locks(host_dir, &mut changes)?;
        Ok(changes)
    }

    fn read(&mut self, host_dir: &HostDir, changes: &mut DirChanges) -> Result<(), HostError> {
        let mut processes = BTreeSet::new();
        for name in host_dir.names()? {
            match name {
                Name::Process(id) => drop(processes.insert(id)),
                Name::Entries(_) | Name::Remote(_) => drop(changes.wrote.insert(name)),
                _ => {}
            }
        }
        changes.sockets = true;
        changes.ended = self.processes.difference(&processes).copied().collect();
        self.processes = processes;
        Ok(())
    }

    /// Detects processes that were killed, which changes nothing in the directory.
    fn try_locks(&mut self, host_dir: &HostDir, changes: &mut DirChanges) -> Result<(), HostError> {
        let after = self.tried.map_or(Bound::Unbounded, Bound::Excluded);
        let later = self.processes.range((after, Bound::Unbounded));
        let ids: Vec<Id> = later.take(LOCKS_PER_POLL).copied().collect();
        for id in &ids {
            if *id != host_dir.id() && !host_dir.is_running(*id)? {
                changes.ended.insert(*id);
            }
        }
        // After the last process, the next poll starts over.
        self.tried = (ids.len() == LOCKS_PER_POLL)
            .then(|| ids.last().copied())
            .flatten();
        Ok(())
    }
}

/// Time to collect changes after a read. With many changes or little CPU time, reading leaves most of the time
/// to the writers. A lookup of an unknown name does not wait for this pause.
#[derive(Debug)]
struct Pause(Duration);

impl Pause {
    const LEAST: Duration = Duration::from_millis(5);
    const MOST: Duration = Duration::from_millis(200);

    /// Returns the pause after a read of this duration, for which the watcher waited that long. While changes
    /// follow each other, each pause is twice as long as the one before.
    fn after(&mut self, waited: Duration, reading: Duration) -> Duration {
        self.0 = match waited > self.0 {
            true => Self::LEAST,
            false => self.0 * 2,
        };
        self.0 = self.0.max(reading * 8).clamp(Self::LEAST, Self::MOST);
        self.0
    }
}

impl Default for Pause {
    fn default() -> Self {
        Self(Self::LEAST)
    }
}

/// Collected changes, without duplicates.
#[derive(Debug, Default)]
struct DirChanges {
    wrote: BTreeSet<Name>,
    ended: BTreeSet<Id>,
    sockets: bool,
    /// Whether events are missing, or the directory was removed or moved.
    lost: bool,
    /// Whether a watched file may have been removed, or one that only a process that ends removes.
    disturbed: bool,
}

impl DirChanges {
    fn add(&mut self, mask: EventMask, name: Option<&str>) {
        let lost = EventMask::Q_OVERFLOW
            | EventMask::DELETE_SELF
            | EventMask::MOVE_SELF
            | EventMask::IGNORED;
        if mask.intersects(lost) {
            self.lost = true;
        }
        match name.and_then(Name::parse) {
            Some(Name::Entries(_) | Name::Remote(_) | Name::Counts(_) | Name::Domain)
                if mask.contains(EventMask::DELETE) =>
            {
                self.disturbed = true;
            }
            Some(name @ (Name::Entries(_) | Name::Remote(_)))
                if mask.contains(EventMask::MOVED_TO) =>
            {
                self.wrote.insert(name);
            }
            Some(Name::Process(id))
                if mask.intersects(EventMask::CLOSE_WRITE | EventMask::DELETE) =>
            {
                self.ended.insert(id);
            }
            Some(Name::Socket(_)) => self.sockets = true,
            _ => {}
        }
    }

    fn is_empty(&self) -> bool {
        let none = self.wrote.is_empty() && self.ended.is_empty();
        none && !self.sockets && !self.lost && !self.disturbed
    }
}

async fn sleep_until(time: Option<Instant>) {
    match time {
        Some(time) => tokio::time::sleep_until(time).await,
        None => std::future::pending().await,
    }
}

fn handle(
    shared: &Shared,
    changes: DirChanges,
    ending: &mut EndingProcesses,
) -> Result<(), HostError> {
    if changes.disturbed {
        shared.report_disturbed();
    }
    // Files that disappear together with the directory do not mean that their processes ended.
    if (changes.lost || ending.rescan || !changes.ended.is_empty()) && !shared.is_there()? {
        return Err(HostError::Removed {
            path: shared.host_dir().path().to_owned(),
        });
    }
    if changes.lost || std::mem::take(&mut ending.rescan) {
        shared.rescan()?;
    }
    if changes.sockets {
        shared.find_sockets()?;
    }
    for name in changes.wrote {
        shared.replaced(name)?;
    }
    for id in changes.ended {
        ending.add(id);
    }
    ending.handle(shared)
}

/// Processes that are ending.
///
/// The kernel reports the closing of a file just before it releases the lock, and another process
/// may hold the domain's lock when the files are to be removed; both are retried a few times.
#[derive(Debug, Default)]
struct EndingProcesses {
    processes: BTreeMap<Id, EndingProcess>,
    rescan: bool,
}

#[derive(Debug)]
struct EndingProcess {
    pause: Duration,
    due: Instant,
}

impl EndingProcesses {
    const FIRST_PAUSE: Duration = Duration::from_millis(1);
    /// After about a second, the process is not ending: a program has only touched its lock file.
    const LAST_PAUSE: Duration = Duration::from_millis(512);

    fn add(&mut self, id: Id) {
        let end = EndingProcess {
            pause: Self::FIRST_PAUSE,
            due: Instant::now(),
        };
        self.processes.insert(id, end);
    }

    async fn due(&self) {
        if self.rescan {
            return;
        }
        sleep_until(self.processes.values().map(|end| end.due).min()).await;
    }

    fn handle(&mut self, shared: &Shared) -> Result<(), HostError> {
        let now = Instant::now();
        let due: Vec<Id> = self
            .processes
            .iter()
            .filter(|(_, end)| end.due <= now)
            .map(|(id, _)| *id)
            .collect();
        for id in due {
            let done = shared.process_ended(id)? && shared.try_remove_files(id)?;
            let Some(end) = self.processes.get_mut(&id) else {
                continue;
            };
            if done {
                shared.report_ended();
            }
            if done || end.pause > Self::LAST_PAUSE {
                self.processes.remove(&id);
            } else {
                end.due = now + end.pause;
                end.pause *= 2;
            }
        }
        Ok(())
    }
}
