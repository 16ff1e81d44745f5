//! Wake-up of processes, and detection of their end.
//!
//! Every process has three files of its own, named after its incarnation:
//! * The liveness FIFO (`.live`). The process keeps it open for writing, and nothing is written to
//!   it. A process that has it open for reading is notified by the kernel when the last writer
//!   ends, however it ends.
//! * The doorbell (`.bell`), a FIFO that the process reads. A byte makes the process check its
//!   mailbox and its answers.
//! * The status page (`.page` in `/dev/shm`). It states whether the process is polling, so that no
//!   peer needs to ring, and counts how often the process has cleared its doorbell.
//!   [`Presence::begin_polling`] and [`PeerProcess::is_awake`] describe the protocol between the
//!   page and the doorbell. Peers announce their parcels there ([`Announcements`]), so that a poll
//!   of an empty mailbox is one load.
//!
//! A process that sends content to several receivers also has segments (see `segment`).

use std::fs::File;
use std::io::{self, ErrorKind, Read, Write};
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, OwnedFd, RawFd};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering, fence};
use std::time::{Duration, Instant};

use fipa_transport::Incarnation;
use rustix::fs::{CWD, FileType, FlockOperation, Mode, OFlags, flock, mknodat};
use rustix::io::Errno;
use rustix::mm::ProtFlags;
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;

use crate::domain_files::files_in;
use crate::fork::Owner;
use crate::memory::{Mapping, PAGE, SHM, open_owned};
use crate::segment;

/// Mode of a file that only its owner may access.
const PRIVATE: Mode = Mode::RUSR.union(Mode::WUSR);

/// Suffix of the file names of segments.
const CONTENT: &str = "content";

/// Paths of the files of processes.
#[derive(Debug, Clone)]
pub(crate) struct ProcessPaths {
    directory: PathBuf,
    prefix: String,
}

impl ProcessPaths {
    pub(crate) fn new(root: &Path, prefix: &str) -> Self {
        Self {
            directory: root.join("processes"),
            prefix: format!("{prefix}_"),
        }
    }

    pub(crate) fn directory(&self) -> &Path {
        &self.directory
    }

    pub(crate) fn liveness_fifo(&self, of: Incarnation) -> PathBuf {
        self.directory.join(format!("{}{of}.live", self.prefix))
    }

    pub(crate) fn doorbell(&self, of: Incarnation) -> PathBuf {
        self.directory.join(format!("{}{of}.bell", self.prefix))
    }

    pub(crate) fn status_page(&self, of: Incarnation) -> PathBuf {
        Path::new(SHM).join(format!("{}{of}.page", self.prefix))
    }

    /// Path of a segment of content for several receivers.
    pub(crate) fn segment(&self, of: Incarnation, number: u64) -> PathBuf {
        Path::new(SHM).join(format!("{}{of}.{number}.{CONTENT}", self.prefix))
    }

    pub(crate) fn remove(&self, of: Incarnation) {
        let contents = format!("{}{of}.", self.prefix);
        for file in files_in(Path::new(SHM)) {
            let name = file.file_name();
            let name = name.to_string_lossy();
            if name.starts_with(&contents) && name.ends_with(CONTENT) {
                segment::remove(&file.path());
            }
        }
        // The liveness FIFO goes last: as long as it exists, a later cleanup finds the process and
        // removes the other files. A missing file is not an error.
        for path in [
            self.status_page(of),
            self.doorbell(of),
            self.liveness_fifo(of),
        ] {
            let _ = std::fs::remove_file(path);
        }
    }

    /// Incarnations of the processes that have files in the domain, sorted.
    pub(crate) fn all(&self) -> io::Result<Vec<Incarnation>> {
        let mut found = Vec::new();
        for directory in [self.directory.as_path(), Path::new(SHM)] {
            let files = match std::fs::read_dir(directory) {
                Ok(files) => files,
                Err(e) if e.kind() == ErrorKind::NotFound => continue,
                Err(e) => return Err(e),
            };
            for file in files {
                let name = file?.file_name();
                let incarnation: Option<Incarnation> = name
                    .to_str()
                    .and_then(|name| name.strip_prefix(&self.prefix))
                    .and_then(|name| name.split_once('.'))
                    .filter(|(_, kind)| {
                        matches!(*kind, "live" | "bell" | "page") || kind.ends_with(CONTENT)
                    })
                    .and_then(|(digits, _)| digits.parse().ok());
                found.extend(incarnation);
            }
        }
        found.sort_unstable();
        found.dedup();
        Ok(found)
    }

    /// Whether this process runs. The caller must hold the domain's lock, or be certain that the
    /// process has started. A process whose files cannot be examined, for example for lack of
    /// descriptors, counts as alive.
    pub(crate) fn is_alive(&self, of: Incarnation) -> bool {
        match open_liveness_fifo(&self.liveness_fifo(of)) {
            Ok(live) => !has_ended(&live),
            Err(error) if error.kind() == ErrorKind::NotFound => self.holds_status_page(of),
            Err(_) => true,
        }
    }

    /// Whether this process has its status page locked. It then runs, although another program has
    /// removed its files from the directory.
    fn holds_status_page(&self, of: Incarnation) -> bool {
        match open_owned(&self.status_page(of), File::options().read(true)) {
            // A lock taken here ends at once, with the descriptor.
            Ok((page, _)) => {
                flock(&page, FlockOperation::NonBlockingLockShared) == Err(Errno::WOULDBLOCK)
            }
            Err(error) => !matches!(error.kind(), ErrorKind::NotFound | ErrorKind::InvalidData),
        }
    }

    /// Rings the doorbell of a process without keeping it open.
    pub(crate) fn ring_once(&self, of: Incarnation) {
        if let Ok(doorbell) = open_doorbell(&self.doorbell(of)) {
            ring(&doorbell);
        }
    }
}

/// The files of this process.
#[derive(Debug)]
pub(crate) struct Presence {
    paths: ProcessPaths,
    own: Incarnation,
    owner: Owner,
    doorbell: Arc<Doorbell>,
    page: Arc<StatusPage>,
    /// Locked for as long as the process runs; never read.
    _locked: File,
    // Last: the other files exist as long as this one is open.
    _live: File,
}

impl Presence {
    /// Creates the files. The caller must hold the domain's lock.
    pub(crate) fn create(paths: ProcessPaths, own: Incarnation) -> io::Result<Self> {
        // Outside of the cleanup on error: files that exist already belong to another process.
        mknodat(CWD, paths.liveness_fifo(own), FileType::Fifo, PRIVATE, 0)?;
        let created = Self::create_files(&paths, own);
        if created.is_err() {
            paths.remove(own);
        }
        created
    }

    fn create_files(paths: &ProcessPaths, own: Incarnation) -> io::Result<Self> {
        let _live = fifo(true).open(paths.liveness_fifo(own))?;
        let doorbell = paths.doorbell(own);
        mknodat(CWD, &doorbell, FileType::Fifo, PRIVATE, 0)?;
        let doorbell = open_doorbell(&doorbell)?;
        let mut page = File::options()
            .read(true)
            .write(true)
            .create_new(true)
            .mode(0o600)
            .open(paths.status_page(own))?;
        // Written and not only extended: a full file system then causes an error here, and not a
        // signal later.
        page.write_all(&[0; PAGE]).map_err(|e| {
            let text = format!("cannot allocate the status page in {SHM}: {e}");
            io::Error::new(e.kind(), text)
        })?;
        // The lock shows that the process runs after another program has removed the liveness FIFO.
        flock(&page, FlockOperation::NonBlockingLockExclusive)?;
        Ok(Self {
            paths: paths.clone(),
            own,
            owner: Owner::this(),
            doorbell: Arc::new(Doorbell(doorbell)),
            page: Arc::new(StatusPage::map(&page)?),
            _locked: page,
            _live,
        })
    }

    pub(crate) fn doorbell(&self) -> &Arc<Doorbell> {
        &self.doorbell
    }

    /// The counter of completed polls.
    pub(crate) fn polls(&self) -> PollCounter {
        PollCounter(self.page.clone())
    }

    /// The announcements of parcels for this process.
    pub(crate) fn announcements(&self) -> Announcements {
        Announcements(self.page.clone())
    }

    /// Announces to other processes, until the guard is dropped, that this process polls and needs
    /// no wake-up. The caller must poll once more after dropping the guard.
    ///
    /// A peer that has put something into the mailbox reads the page afterwards, and rings if no
    /// thread polls ([`PeerProcess::is_awake`]). A sequentially consistent fence stands between the
    /// peer's write and its read, and between the guard's write and the next poll here. So either
    /// the peer sees that no thread polls, and rings, or the poll after the drop finds the parcel.
    pub(crate) fn begin_polling(&self) -> PollGuard<'_> {
        let pollers = &self.page.words().pollers;
        pollers.fetch_add(1, Ordering::SeqCst);
        PollGuard(pollers)
    }

    /// Whether a thread of this process polls. If so, that thread polls once more.
    pub(crate) fn is_polling(&self) -> bool {
        self.page.words().pollers.load(Ordering::SeqCst) != 0
    }

    /// Counts that the doorbell has been cleared. The caller polls afterwards.
    pub(crate) fn count_wakeup(&self) {
        self.page.words().wakeups.fetch_add(1, Ordering::SeqCst);
        // A peer that has read the previous count stored its parcel before that, so the poll that
        // follows finds it.
        fence(Ordering::SeqCst);
    }
}

/// The number of completed polls of the mailbox, which other processes can read. Incremented by one
/// thread at a time.
#[derive(Debug)]
pub(crate) struct PollCounter(Arc<StatusPage>);

impl PollCounter {
    /// Counts a poll that found the mailbox empty at its end.
    pub(crate) fn increment(&self) {
        let polls = &self.0.words().polls;
        let before = polls.load(Ordering::Relaxed);
        polls.store(before.wrapping_add(1), Ordering::Release);
    }
}

/// The announcements of parcels for one mailbox, which its process and all peers share.
///
/// A peer announces a parcel *before* it puts it into the mailbox, and afterwards counts the
/// announcement as settled. So as long as the mailbox's process has taken as many parcels as were
/// announced, its mailbox is empty, and the process need not visit the slots of all possible
/// connections to know that. An announced parcel may also never arrive, because sending failed or
/// the parcel was abandoned. Therefore the process corrects its account when all announcements are
/// settled and the mailbox is empty ([`settled`](Self::settled)).
///
/// A peer that is killed between the two steps leaves an announcement that is never settled. Each
/// poll of the mailbox then visits all slots.
#[derive(Debug, Clone)]
pub(crate) struct Announcements(Arc<StatusPage>);

impl Announcements {
    /// Announces a parcel. The announcement is settled when the guard is dropped, after sending.
    pub(crate) fn announce(&self) -> Announcement<'_> {
        let words = self.0.words();
        // Before the fence in `PeerProcess::is_awake`: a peer that sees a polling process has
        // announced its parcel to that process's last check.
        words.announced.fetch_add(1, Ordering::SeqCst);
        Announcement(&words.settled)
    }

    /// Number of announced parcels.
    pub(crate) fn announced(&self) -> u64 {
        self.0.words().announced.load(Ordering::Acquire)
    }

    /// Number of announced parcels if all of them are in the mailbox, were taken, or will never
    /// arrive. `None` if a peer may be about to put one there.
    pub(crate) fn settled(&self) -> Option<u64> {
        // This load comes first and acquires each counted step, so the other load includes the
        // announcements of these steps. If the counts are equal, there was no other announcement.
        let settled = self.0.words().settled.load(Ordering::Acquire);
        let announced = self.announced();
        (announced == settled).then_some(announced)
    }
}

/// An announcement of a parcel, which is settled when this is dropped.
pub(crate) struct Announcement<'a>(&'a AtomicU64);

impl Drop for Announcement<'_> {
    fn drop(&mut self) {
        self.0.fetch_add(1, Ordering::Release);
    }
}

/// Marks that a thread of this process polls.
pub(crate) struct PollGuard<'a>(&'a AtomicU32);

impl Drop for PollGuard<'_> {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::SeqCst);
        fence(Ordering::SeqCst);
    }
}

/// Time to wait before ringing at a process that polled recently. Such a process is about to check
/// for the answer, and a wake-up costs both sides more than this wait. A process that sleeps
/// between letters is rung at once.
pub(crate) const POLL_GRACE: Duration = Duration::from_nanos(1500);

/// Number of checks of the status page between two reads of the clock.
const POLLS_PER_CLOCK_READ: usize = 16;

impl Drop for Presence {
    fn drop(&mut self) {
        if self.owner.is_this() {
            self.paths.remove(self.own);
        }
    }
}

/// The FIFO that its process reads and other processes write.
#[derive(Debug)]
pub(crate) struct Doorbell(File);

impl Doorbell {
    /// Removes bytes from the FIFO. Returns whether it is empty: then it becomes readable again
    /// only by the next ring.
    pub(crate) fn clear(&self) -> bool {
        let mut bytes = [0; 512];
        // A short read emptied the FIFO, and an error means that it was empty, so no second system
        // call is needed.
        !matches!((&self.0).read(&mut bytes), Ok(taken) if taken == bytes.len())
    }

    pub(crate) fn ring(&self) {
        ring(&self.0);
    }
}

impl AsFd for Doorbell {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.0.as_fd()
    }
}

/// A shared descriptor that tokio polls.
#[derive(Debug)]
pub(crate) struct SharedFd<T>(Arc<T>);

impl<T: AsFd> SharedFd<T> {
    /// Registers the descriptor with tokio. The caller must be in the context of a runtime.
    pub(crate) fn readable(shared: Arc<T>) -> io::Result<AsyncFd<Self>> {
        // SAFETY: `T` is a `Doorbell` or an `OwnedFd`. Both own their descriptor, always lend the
        // same one, and do not close it before they are dropped. The `Arc` in `Self(shared)` keeps
        // the value, and tokio deregisters the descriptor before it drops that `Arc`.
        let registered =
            unsafe { AsyncFd::register_with_interest(Self(shared), Interest::READABLE) };
        registered.map_err(Into::into)
    }

    pub(crate) fn get(&self) -> &T {
        &self.0
    }
}

impl<T: AsFd> AsRawFd for SharedFd<T> {
    fn as_raw_fd(&self) -> RawFd {
        self.0.as_fd().as_raw_fd()
    }
}

/// The open files of another process.
#[derive(Debug)]
pub(crate) struct PeerProcess {
    live: Arc<OwnedFd>,
    doorbell: File,
    page: Arc<StatusPage>,
    /// Value of the page's `wakeups` when this process last rang; [`NO_WAKEUP_COUNT`] before that.
    wakeups_at_ring: AtomicU64,
    /// Whether the process was polling at the last check.
    polled_at_last_check: AtomicBool,
}

/// A value that `wakeups` does not reach.
const NO_WAKEUP_COUNT: u64 = u64::MAX;

impl PeerProcess {
    /// Opens the files of a process. The error is `NotFound` if the process does not run.
    pub(crate) fn open(paths: &ProcessPaths, of: Incarnation) -> io::Result<Self> {
        let live = open_liveness_fifo(&paths.liveness_fifo(of))?;
        if has_ended(&live) {
            return Err(ErrorKind::NotFound.into());
        }
        let (page, found) = open_owned(
            &paths.status_page(of),
            File::options().read(true).write(true),
        )?;
        if found.len() < PAGE as u64 {
            return Err(io::Error::new(
                ErrorKind::InvalidData,
                "the status page is too short",
            ));
        }
        Ok(Self {
            live: Arc::new(live.into()),
            doorbell: open_doorbell(&paths.doorbell(of))?,
            page: Arc::new(StatusPage::map(&page)?),
            wakeups_at_ring: AtomicU64::new(NO_WAKEUP_COUNT),
            polled_at_last_check: AtomicBool::new(false),
        })
    }

    /// Number of times the process has polled its mailbox until it was empty; 0 if it does not
    /// listen yet.
    pub(crate) fn polls(&self) -> u64 {
        self.page.words().polls.load(Ordering::Acquire)
    }

    /// The announcements of parcels for the process.
    pub(crate) fn announcements(&self) -> Announcements {
        Announcements(self.page.clone())
    }

    /// The liveness FIFO, which becomes readable when the process ends.
    pub(crate) fn live(&self) -> &Arc<OwnedFd> {
        &self.live
    }

    /// Whether the process will poll without being rung at: because it is polling, or because this
    /// process has rung and the wake-up is still pending.
    ///
    /// The latter holds while `wakeups` is the same as before this process rang. The peer
    /// increments it between clearing its doorbell and polling, so a poll is still to come. Rings
    /// of other processes do not count, so a process that is killed before it rings causes no
    /// missed wake-up.
    pub(crate) fn is_awake(&self) -> bool {
        fence(Ordering::SeqCst);
        let words = self.page.words();
        // The fence provides the order that `begin_polling` and `count_wakeup` rely on.
        if words.pollers.load(Ordering::Relaxed) != 0 {
            self.polled_at_last_check.store(true, Ordering::Relaxed);
            return true;
        }
        self.wakeups_at_ring.load(Ordering::Relaxed) == words.wakeups.load(Ordering::Relaxed)
    }

    /// Whether the process was polling at the last check.
    pub(crate) fn was_polling(&self) -> bool {
        self.polled_at_last_check.load(Ordering::Relaxed)
    }

    /// Rings the doorbell unless the process is awake. Returns whether it rang.
    pub(crate) fn wake(&self) -> bool {
        if self.is_awake() {
            return false;
        }
        if self.polled_at_last_check.swap(false, Ordering::Relaxed) {
            let began = Instant::now();
            while began.elapsed() < POLL_GRACE {
                if (0..POLLS_PER_CLOCK_READ).any(|_| self.is_awake()) {
                    return false;
                }
            }
        }
        let wakeups = self.page.words().wakeups.load(Ordering::Acquire);
        ring(&self.doorbell);
        self.wakeups_at_ring.store(wakeups, Ordering::Relaxed);
        true
    }
}

/// Maximum wait for other processes to poll their mailboxes: they may be stopped or short of
/// processor time.
const POLL_TIMEOUT: Duration = Duration::from_secs(1);

/// The same for processes that do not listen yet.
const START_TIMEOUT: Duration = Duration::from_millis(100);

/// Pause between two checks of the poll counters.
const POLL_CHECK_INTERVAL: Duration = Duration::from_millis(5);

/// Waits until these processes have taken everything that is in their mailboxes now, or `stop`
/// returns true. Gives up on a process that does not poll in time.
///
/// A poll that was in progress at the start may have missed a parcel, so a second one must follow.
pub(crate) fn wait_for_polls<'a>(
    at: impl Iterator<Item = &'a PeerProcess>,
    stop: impl Fn() -> bool,
) {
    let mut waited_for: Vec<_> = at.map(|one| (one.polls(), one)).collect();
    let began = Instant::now();
    loop {
        let waited = began.elapsed();
        waited_for.retain(|(before, one)| {
            let patience = match before {
                0 => START_TIMEOUT,
                _ => POLL_TIMEOUT,
            };
            let has_polled = one.polls().wrapping_sub(*before) >= 2;
            !has_polled && waited < patience && !has_ended(one.live.as_ref())
        });
        if waited_for.is_empty() || stop() {
            return;
        }
        for (_, one) in &waited_for {
            ring(&one.doorbell);
        }
        std::thread::sleep(POLL_CHECK_INTERVAL);
    }
}

/// Whether all writers of a FIFO have closed it.
pub(crate) fn has_ended(live: impl AsFd) -> bool {
    let mut byte = [0];
    // Nothing is ever written: the read fails while a writer exists and returns 0 afterwards.
    matches!(rustix::io::read(live, &mut byte), Ok(0))
}

fn fifo(write: bool) -> std::fs::OpenOptions {
    let mut options = File::options();
    options
        .read(true)
        .write(write)
        .custom_flags((OFlags::NONBLOCK | OFlags::NOFOLLOW).bits() as i32);
    options
}

fn open_liveness_fifo(path: &Path) -> io::Result<File> {
    fifo(false).open(path)
}

/// Opens a doorbell for reading and writing. A writer that also reads never gets SIGPIPE.
fn open_doorbell(path: &Path) -> io::Result<File> {
    fifo(true).open(path)
}

fn ring(mut doorbell: &File) {
    // A full FIFO is readable, so the error can be ignored.
    let _ = doorbell.write(&[1]);
}

/// The status page. Peers write only the announcements, and the process writes all other words.
#[derive(Debug)]
#[repr(C)]
struct StatusWords {
    /// Number of threads of the process that poll.
    pollers: AtomicU32,
    /// Number of times the process has cleared its doorbell before it polled.
    wakeups: AtomicU64,
    /// Keeps `polls`, which changes often, in a cache line of its own.
    _apart: [u64; 6],
    /// Number of times the process has found its mailbox empty, or emptied it.
    polls: AtomicU64,
    /// Keeps apart what the process and its peers write, also from processors that load two cache
    /// lines at once.
    _apart_from_announced: [u64; 23],
    /// Number of parcels that peers have announced.
    announced: AtomicU64,
    /// Keeps `announced`, which the process polls, in a cache line of its own.
    _apart_from_settled: [u64; 15],
    /// Number of announced parcels that are in the mailbox, were in it, or never will be.
    settled: AtomicU64,
}

/// A mapped status page.
#[derive(Debug)]
struct StatusPage(Mapping);

impl StatusPage {
    fn map(file: &File) -> io::Result<Self> {
        Mapping::new(file, PAGE, ProtFlags::READ | ProtFlags::WRITE).map(Self)
    }

    fn words(&self) -> &StatusWords {
        // SAFETY: the mapping exists as long as self, is aligned to a page and longer than
        // `StatusWords`, of which every bit pattern is valid. Every process maps the page for
        // reading and writing and accesses these words atomically. The page exists: the process that
        // creates the file writes it first, and `PeerProcess::open` checks the length and the
        // owner. No process of the domain shortens the file, and other users have no access to it.
        unsafe { self.0.start().cast::<StatusWords>().as_ref() }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a failed precondition fails the test")]

    use std::os::unix::fs::symlink;

    use super::*;

    /// The announcements for a process, as the process and as a peer see them.
    fn announcements() -> (Announcements, Announcements) {
        let file = tempfile::tempfile().unwrap();
        file.set_len(PAGE as u64).unwrap();
        let map = || Announcements(Arc::new(StatusPage::map(&file).unwrap()));
        (map(), map())
    }

    #[test]
    fn announcements_are_settled_when_no_peer_is_about_to_send() {
        let (own, peer) = announcements();
        assert_eq!((own.announced(), own.settled()), (0, Some(0)));
        let first = peer.announce();
        let second = peer.announce();
        assert_eq!((own.announced(), own.settled()), (2, None));
        drop(second);
        assert_eq!(own.settled(), None, "the first parcel may still arrive");
        drop(first);
        assert_eq!(own.settled(), Some(2));
    }

    #[test]
    fn settled_announcements_have_been_sent() {
        let (own, peer) = announcements();
        let sent = AtomicU64::new(0);
        std::thread::scope(|scope| {
            for _ in 0..2 {
                scope.spawn(|| {
                    for _ in 0..10_000 {
                        let _announced = peer.announce();
                        sent.fetch_add(1, Ordering::Relaxed);
                    }
                });
            }
            while own.announced() < 20_000 {
                if let Some(settled) = own.settled() {
                    let sent = sent.load(Ordering::Relaxed);
                    assert!(sent >= settled, "{sent} of {settled} parcels");
                }
            }
        });
        assert_eq!(own.settled(), Some(20_000));
    }

    #[test]
    fn a_process_that_cannot_be_examined_counts_as_alive() {
        let root = tempfile::tempdir().unwrap();
        let paths = ProcessPaths::new(root.path(), "fipatest-presence");
        std::fs::create_dir(paths.directory()).unwrap();
        let (gone, hidden) = (Incarnation::from_u64(1), Incarnation::from_u64(2));
        // A symbolic link to itself gives an error other than `NotFound`, as a lack of descriptors
        // does.
        symlink(paths.liveness_fifo(hidden), paths.liveness_fifo(hidden)).unwrap();
        assert!(!paths.is_alive(gone));
        assert!(paths.is_alive(hidden));
    }
}
