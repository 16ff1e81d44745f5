//! Wake-up of processes, and detection of their end.
//!
//! Every process has three files of its own, named after its incarnation:
//! * The liveness FIFO (`.live`). The process keeps it open for writing, and nothing is written to
//!   it. A process that has it open for reading is notified by the kernel when the last writer
//!   ends, however it ends.
//! * The doorbell (`.bell`), a FIFO that the process reads. A byte makes the process check its
//!   mailbox and its answers.
//! * The status page (`.page` in `/dev/shm`). It states whether the process is polling, so that no
//!   peer needs to ring, and counts how often the process has cleared its doorbell. Peers announce their
//!   parcels there, so that a poll of an empty mailbox is one load. The module `wakeup` has the rules.
//!   Peers also answer parcels of the process there; the module `answer_words` has the rules.
//!
//! A process that sends content to several receivers also has segments (see `segment`).

use std::fs::{DirEntry, File};
use std::io::{self, ErrorKind, Read, Write};
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, OwnedFd, RawFd};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_transport::Incarnation;
use rustix::fs::{CWD, FileType, FlockOperation, Mode, OFlags, flock, mknodat};
use rustix::io::Errno;
use rustix::mm::ProtFlags;
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;

use crate::answer_words::{AnswerWords, LentWords, WordPlace};
use crate::fork::OwnerMark;
use crate::memory::{Mapping, PAGE, is_owned, open_owned};
use crate::paths::{CONTENT, ProcessPaths};
use crate::segment;
use crate::shared_files::{SHM, shared_files};
use crate::wakeup::{RingState, StatusWords};

/// Mode of a file that only its owner may access.
const PRIVATE: Mode = Mode::RUSR.union(Mode::WUSR);

impl ProcessPaths {
    /// Incarnations of the processes that have files in the domain, sorted.
    pub(crate) fn all(&self) -> io::Result<Vec<Incarnation>> {
        let private: io::Result<Vec<DirEntry>> = match std::fs::read_dir(self.directory()) {
            Ok(files) => files.collect(),
            Err(e) if e.kind() == ErrorKind::NotFound => Ok(Vec::new()),
            Err(e) => Err(e),
        };
        let files = private?.into_iter().chain(shared_files());
        let mut found: Vec<Incarnation> = files
            .filter_map(|file| {
                let name = file.file_name();
                let (incarnation, kind) = self.parse(name.to_str()?)?;
                let is_ours = matches!(kind, "live" | "bell" | "page") || kind.ends_with(CONTENT);
                // Any user may create files with such names.
                let is_own = || file.metadata().is_ok_and(|metadata| is_owned(&metadata));
                (is_ours && is_own()).then_some(incarnation)
            })
            .collect();
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

/// Removes a file of a process. An error is that it is missing, or a later cleanup removes it.
pub(crate) fn remove_file(path: &Path) {
    match path.extension().is_some_and(|end| end == CONTENT) {
        true => segment::remove(path),
        false => drop(std::fs::remove_file(path)),
    }
}

/// The files of this process.
#[derive(Debug)]
pub(crate) struct Presence {
    paths: ProcessPaths,
    own: Incarnation,
    owner: OwnerMark,
    doorbell: Arc<Doorbell>,
    page: Arc<StatusPage>,
    lender: Arc<WordLender>,
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
            paths.remove(&[own], remove_file);
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
        let random = [getrandom::u64(), getrandom::u64()].map(|it| it.map_err(io::Error::other));
        let [number, token] = random;
        // The lock shows that the process runs after another program has removed the liveness FIFO.
        flock(&page, FlockOperation::NonBlockingLockExclusive)?;
        let mapped = Arc::new(StatusPage::map(&page)?);
        Ok(Self {
            paths: paths.clone(),
            own,
            owner: OwnerMark::this(),
            doorbell: Arc::new(Doorbell(doorbell)),
            lender: Arc::new(WordLender::new(Arc::clone(&mapped), [number?, token?])),
            page: mapped,
            _locked: page,
            _live,
        })
    }

    pub(crate) fn doorbell(&self) -> &Arc<Doorbell> {
        &self.doorbell
    }

    /// The status page.
    pub(crate) fn page(&self) -> &Arc<StatusPage> {
        &self.page
    }

    /// The words in which peers answer parcels of this process.
    pub(crate) fn lender(&self) -> &Arc<WordLender> {
        &self.lender
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
            self.paths.remove(&[self.own], remove_file);
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
    rings: RingState,
}

impl PeerProcess {
    /// Opens the files of a process. The error is `NotFound` if there are none, and `BrokenPipe` if the process has
    /// ended.
    pub(crate) fn open(paths: &ProcessPaths, of: Incarnation) -> io::Result<Self> {
        let live = open_liveness_fifo(&paths.liveness_fifo(of))?;
        if has_ended(&live) {
            return Err(ErrorKind::BrokenPipe.into());
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
            rings: RingState::new(),
        })
    }

    /// The status page.
    pub(crate) fn page(&self) -> &Arc<StatusPage> {
        &self.page
    }

    /// The liveness FIFO, which becomes readable when the process ends.
    pub(crate) fn live(&self) -> &Arc<OwnedFd> {
        &self.live
    }

    /// Whether the process will poll without being rung at; see [`RingState::is_awake`].
    pub(crate) fn is_awake(&self) -> bool {
        self.rings.is_awake(self.page.words())
    }

    /// Whether the process was polling at the last check.
    pub(crate) fn was_polling(&self) -> bool {
        self.rings.was_polling()
    }

    /// Rings the doorbell unless the process is awake. Returns whether it rang.
    pub(crate) fn wake(&self) -> bool {
        let becomes_awake = || {
            let began = Instant::now();
            while began.elapsed() < POLL_GRACE {
                if (0..POLLS_PER_CLOCK_READ).any(|_| self.is_awake()) {
                    return true;
                }
            }
            false
        };
        let ring = || ring(&self.doorbell);
        self.rings.wake(self.page.words(), becomes_awake, ring)
    }
}

/// Maximum wait for other processes to poll their mailboxes: they may be stopped or short of
/// processor time.
const POLL_TIMEOUT: Duration = Duration::from_secs(1);

/// Maximum wait for processes that do not listen yet.
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
    let mut waited_for: Vec<_> = at.map(|one| (one.page.words().polls(), one)).collect();
    let began = Instant::now();
    loop {
        let waited = began.elapsed();
        waited_for.retain(|(before, one)| {
            let timeout = match before {
                0 => START_TIMEOUT,
                _ => POLL_TIMEOUT,
            };
            let has_polled = one.page.words().polls().wrapping_sub(*before) >= 2;
            !has_polled && waited < timeout && !has_ended(one.live.as_ref())
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

/// The contents of a status page.
#[repr(C)]
struct PageLayout {
    status: StatusWords,
    /// Keeps apart what peers write when they send, and when they answer.
    _apart: [u64; 15],
    answers: AnswerWords,
}

const _: () = assert!(size_of::<PageLayout>() <= PAGE);

/// A mapped status page.
#[derive(Debug)]
pub(crate) struct StatusPage(Mapping);

impl StatusPage {
    fn map(file: &File) -> io::Result<Self> {
        Mapping::new(file, PAGE, ProtFlags::READ | ProtFlags::WRITE).map(Self)
    }

    fn layout(&self) -> &PageLayout {
        // SAFETY: the mapping exists as long as self, is aligned to a page and at least as long as
        // `PageLayout`, of which every bit pattern is valid. Every process maps the page for
        // reading and writing and accesses its words atomically. The page exists: the process that
        // creates the file writes it first, and `PeerProcess::open` checks the length and the
        // owner. No process of the domain shortens the file, and other users have no access to it.
        unsafe { self.0.start().cast::<PageLayout>().as_ref() }
    }

    /// The words about polling, wake-ups and announcements.
    pub(crate) fn words(&self) -> &StatusWords {
        &self.layout().status
    }

    /// The words in which peers answer parcels of the process.
    pub(crate) fn answers(&self) -> &AnswerWords {
        &self.layout().answers
    }
}

/// The words of this process, which it lends to its parcels.
#[derive(Debug)]
pub(crate) struct WordLender {
    page: Arc<StatusPage>,
    lent: LentWords,
}

impl WordLender {
    fn new(page: Arc<StatusPage>, random: [u64; 2]) -> Self {
        let lent = LentWords::new(random);
        page.answers().set_page(lent.page());
        Self { page, lent }
    }

    /// Returns the token of the next parcel, and lends it a word if the receiver may answer there.
    pub(crate) fn lend(self: &Arc<Self>, with_word: bool) -> AnswerPlace {
        let (token, word) = match with_word {
            true => self.lent.lend(self.page.answers()),
            false => (self.lent.token(), WordPlace::NONE),
        };
        AnswerPlace {
            lender: Arc::clone(self),
            token,
            word,
        }
    }
}

/// The token of a parcel, and the word that is lent to it, if any.
#[derive(Debug)]
pub(crate) struct AnswerPlace {
    lender: Arc<WordLender>,
    token: u64,
    word: WordPlace,
}

impl AnswerPlace {
    /// The token, which answers repeat.
    pub(crate) fn token(&self) -> u64 {
        self.token
    }

    pub(crate) fn word(&self) -> WordPlace {
        self.word
    }

    pub(crate) fn has_word(&self) -> bool {
        self.word != WordPlace::NONE
    }

    /// The code of the answer in the word, if there is one.
    pub(crate) fn code(&self) -> Option<u8> {
        self.lender.page.answers().code(self.word, self.token)
    }
}

impl Drop for AnswerPlace {
    fn drop(&mut self) {
        self.lender.lent.give_back(self.word);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a failed precondition fails the test")]

    use std::os::unix::fs::symlink;

    use super::*;

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
