//! How processes wake each other, and notice each other's end.
//!
//! Every process has three files of its own, named after its incarnation:
//! * `live`, a FIFO that it keeps open for writing. Whoever has it open for reading is told by the
//!   kernel when the last writer ends, however it ends. Nothing is ever written to it.
//! * `bell`, a FIFO that it reads. A byte means: look into your mailbox, and after your answers.
//! * a page of shared memory that says whether it is looking already, so that nobody needs to
//!   ring, and how often it has heard its bell. The page and the bell work together as described
//!   at [`Presence::looking`] and [`Neighbour::is_awake`].
//!
//! Besides, while it multicasts, its segments (see `segment`).

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

use crate::domain::files_in;
use crate::fork::Owner;
use crate::memory::{Mapping, PAGE, SHM, open_ours};
use crate::segment;

/// Nobody but the owner.
const PRIVATE: Mode = Mode::RUSR.union(Mode::WUSR);

/// How the names of segments end.
const CONTENT: &str = "content";

/// Names of the files of processes.
#[derive(Debug, Clone)]
pub(crate) struct Names {
    directory: PathBuf,
    prefix: String,
}

impl Names {
    pub(crate) fn new(root: &Path, prefix: &str) -> Self {
        Self {
            directory: root.join("processes"),
            prefix: format!("{prefix}_"),
        }
    }

    pub(crate) fn directory(&self) -> &Path {
        &self.directory
    }

    pub(crate) fn live(&self, of: Incarnation) -> PathBuf {
        self.directory.join(format!("{}{of}.live", self.prefix))
    }

    pub(crate) fn bell(&self, of: Incarnation) -> PathBuf {
        self.directory.join(format!("{}{of}.bell", self.prefix))
    }

    pub(crate) fn page(&self, of: Incarnation) -> PathBuf {
        Path::new(SHM).join(format!("{}{of}.page", self.prefix))
    }

    /// A segment of content for many.
    pub(crate) fn content(&self, of: Incarnation, number: u64) -> PathBuf {
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
        // What is not there need not be removed, and `live` goes last: as long as it is there,
        // whoever cleans up comes back for the others.
        for path in [self.page(of), self.bell(of), self.live(of)] {
            let _ = std::fs::remove_file(path);
        }
    }

    /// The processes that have files here.
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

    /// Whether this process is there. To be asked under the domain's lock, or of a process that
    /// is known to have been there. A process whose files cannot be examined, for example for lack
    /// of descriptors, counts as alive.
    pub(crate) fn is_alive(&self, of: Incarnation) -> bool {
        match open_live(&self.live(of)) {
            Ok(live) => !has_ended(&live),
            Err(error) if error.kind() == ErrorKind::NotFound => self.holds_page(of),
            Err(_) => true,
        }
    }

    /// Whether this process has its page locked: then it is there, though another program has
    /// removed its files from the directory.
    fn holds_page(&self, of: Incarnation) -> bool {
        match open_ours(&self.page(of), File::options().read(true)) {
            // The lock ends with the descriptor, at once.
            Ok((page, _)) => {
                flock(&page, FlockOperation::NonBlockingLockShared) == Err(Errno::WOULDBLOCK)
            }
            Err(error) => !matches!(error.kind(), ErrorKind::NotFound | ErrorKind::InvalidData),
        }
    }

    /// Wakes a process without keeping anything open.
    pub(crate) fn ring_once(&self, of: Incarnation) {
        if let Ok(bell) = open_bell(&self.bell(of)) {
            ring(&bell);
        }
    }
}

/// This process, as others see it.
#[derive(Debug)]
pub(crate) struct Presence {
    names: Names,
    own: Incarnation,
    owner: Owner,
    bell: Arc<Bell>,
    page: Arc<Page>,
    /// Never read: locked for as long as the process lives.
    _locked: File,
    // Last: the other files are there as long as this one is open.
    _live: File,
}

impl Presence {
    /// Makes the files. To be called under the domain's lock.
    pub(crate) fn create(names: Names, own: Incarnation) -> io::Result<Self> {
        // Before anything is removed again: what is there already is somebody else's.
        mknodat(CWD, names.live(own), FileType::Fifo, PRIVATE, 0)?;
        let created = Self::create_files(&names, own);
        if created.is_err() {
            names.remove(own);
        }
        created
    }

    fn create_files(names: &Names, own: Incarnation) -> io::Result<Self> {
        let _live = fifo(true).open(names.live(own))?;
        let bell = names.bell(own);
        mknodat(CWD, &bell, FileType::Fifo, PRIVATE, 0)?;
        let bell = open_bell(&bell)?;
        let mut page = File::options()
            .read(true)
            .write(true)
            .create_new(true)
            .mode(0o600)
            .open(names.page(own))?;
        // Written, not just made longer: a full file system is an error here, and not a signal
        // later.
        page.write_all(&[0; PAGE]).map_err(|e| {
            let text = format!("cannot take a page in {SHM}: {e}");
            io::Error::new(e.kind(), text)
        })?;
        // Says that the process runs where another program has removed `live`.
        flock(&page, FlockOperation::NonBlockingLockExclusive)?;
        Ok(Self {
            names: names.clone(),
            own,
            owner: Owner::this(),
            bell: Arc::new(Bell(bell)),
            page: Arc::new(Page::map(&page, ProtFlags::READ | ProtFlags::WRITE)?),
            _locked: page,
            _live,
        })
    }

    pub(crate) fn bell(&self) -> &Arc<Bell> {
        &self.bell
    }

    /// Where the process counts its looks.
    pub(crate) fn looks(&self) -> Looks {
        Looks(self.page.clone())
    }

    /// Says to others, until the result is dropped, that they need not ring.
    ///
    /// Whoever has put something into the mailbox then reads the page, and rings if nobody is
    /// looking ([`Neighbour::is_awake`]). Between their write and read, and between our write and
    /// next look, stands a sequentially consistent fence: so either they see that nobody looks,
    /// and ring, or a look after the drop finds what they put there. There must be such a look.
    pub(crate) fn looking(&self) -> Looking<'_> {
        let lookers = &self.page.words().lookers;
        lookers.fetch_add(1, Ordering::SeqCst);
        Looking(lookers)
    }

    /// Whether some thread says so. If so, it will look once more.
    pub(crate) fn is_looking(&self) -> bool {
        self.page.words().lookers.load(Ordering::SeqCst) != 0
    }

    /// The bell has been silenced, and what it rang for is about to be looked at.
    pub(crate) fn heard(&self) {
        self.page.words().heard.fetch_add(1, Ordering::SeqCst);
        // Whoever has read the count from before has put in what is found now.
        fence(Ordering::SeqCst);
    }
}

/// How often a process has looked into its mailbox, told to others. Counted by one thread at a
/// time.
#[derive(Debug)]
pub(crate) struct Looks(Arc<Page>);

impl Looks {
    /// The mailbox is empty, as far as this look goes.
    pub(crate) fn one_more(&self) {
        let looks = &self.0.words().looks;
        let before = looks.load(Ordering::Relaxed);
        looks.store(before.wrapping_add(1), Ordering::Release);
    }
}

/// A thread of this process is looking.
pub(crate) struct Looking<'a>(&'a AtomicU32);

impl Drop for Looking<'_> {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::SeqCst);
        fence(Ordering::SeqCst);
    }
}

/// How long to wait before ringing at somebody who was looking lately: who has just sent
/// something is about to look for the answer, and a bell costs both sides more than that moment.
/// Who sleeps between letters is not kept waiting.
pub(crate) const GLANCE: Duration = Duration::from_nanos(1500);

/// How many looks at a page lie between two looks at the clock.
const GLANCES: usize = 16;

impl Drop for Presence {
    fn drop(&mut self) {
        if self.owner.is_this() {
            self.names.remove(self.own);
        }
    }
}

/// The FIFO that is read by its process and written by others.
#[derive(Debug)]
pub(crate) struct Bell(File);

impl Bell {
    /// Takes bytes out. Says whether these were all: then nothing is heard until it is rung again.
    pub(crate) fn silence(&self) -> bool {
        let mut bytes = [0; 512];
        // Less than asked for was all there was, and an error is that there is nothing; so the
        // system need not be asked a second time.
        !matches!((&self.0).read(&mut bytes), Ok(taken) if taken == bytes.len())
    }

    pub(crate) fn ring(&self) {
        ring(&self.0);
    }
}

impl AsFd for Bell {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.0.as_fd()
    }
}

/// A shared descriptor that tokio waits for.
#[derive(Debug)]
pub(crate) struct Watched<T>(Arc<T>);

impl<T: AsFd> Watched<T> {
    /// To be called in the context of a runtime.
    pub(crate) fn readable(shared: Arc<T>) -> io::Result<AsyncFd<Self>> {
        // SAFETY: an `AsFd` of this crate (a `Bell` or an `OwnedFd`) always lends the same
        // descriptor, which it owns and does not close before it is dropped; the `Arc` keeps it.
        let registered =
            unsafe { AsyncFd::register_with_interest(Self(shared), Interest::READABLE) };
        registered.map_err(Into::into)
    }

    pub(crate) fn get(&self) -> &T {
        &self.0
    }
}

impl<T: AsFd> AsRawFd for Watched<T> {
    fn as_raw_fd(&self) -> RawFd {
        self.0.as_fd().as_raw_fd()
    }
}

/// Another process, as this one sees it.
#[derive(Debug)]
pub(crate) struct Neighbour {
    live: Arc<OwnedFd>,
    bell: File,
    page: Page,
    /// What the page's `heard` was when the bell was rung last.
    rung: AtomicU64,
    /// Whether the process was looking when this was asked last.
    looked: AtomicBool,
}

/// No count of what was heard.
const NEVER: u64 = u64::MAX;

impl Neighbour {
    /// Opens the files of a process; `NotFound` when it is not there.
    pub(crate) fn open(names: &Names, of: Incarnation) -> io::Result<Self> {
        let live = open_live(&names.live(of))?;
        if has_ended(&live) {
            return Err(ErrorKind::NotFound.into());
        }
        let (page, found) = open_ours(&names.page(of), File::options().read(true))?;
        if found.len() < PAGE as u64 {
            return Err(io::Error::new(
                ErrorKind::InvalidData,
                "the page is too short",
            ));
        }
        Ok(Self {
            live: Arc::new(live.into()),
            bell: open_bell(&names.bell(of))?,
            page: Page::map(&page, ProtFlags::READ)?,
            rung: AtomicU64::new(NEVER),
            looked: AtomicBool::new(false),
        })
    }

    /// How often the process has looked into its mailbox to the end; 0 when it does not listen
    /// yet.
    pub(crate) fn looks(&self) -> u64 {
        read(&self.page.words().looks)
    }

    /// What becomes readable when the process ends.
    pub(crate) fn live(&self) -> &Arc<OwnedFd> {
        &self.live
    }

    /// Whether the process will look without being rung at: because it is looking, or because its
    /// bell rings already.
    ///
    /// The latter is so when `heard` has not moved since before it was rung: the process moves it
    /// between silencing its bell and looking, so a look is still to come. Only this process's own
    /// ringing counts, so nobody who is killed in between leaves a bell that is believed to ring.
    pub(crate) fn is_awake(&self) -> bool {
        fence(Ordering::SeqCst);
        let words = self.page.words();
        // Relaxed is what may be done to memory that is mapped for reading; the fence is what the
        // agreement with `looking` and `heard` stands on.
        if words.lookers.load(Ordering::Relaxed) != 0 {
            self.looked.store(true, Ordering::Relaxed);
            return true;
        }
        self.rung.load(Ordering::Relaxed) == words.heard.load(Ordering::Relaxed)
    }

    /// Whether it was looking when it was last asked.
    pub(crate) fn was_looking(&self) -> bool {
        self.looked.load(Ordering::Relaxed)
    }

    /// Makes the process look, unless it is awake. Says whether the bell was rung.
    pub(crate) fn wake(&self) -> bool {
        if self.is_awake() {
            return false;
        }
        if self.looked.swap(false, Ordering::Relaxed) {
            let began = Instant::now();
            while began.elapsed() < GLANCE {
                if (0..GLANCES).any(|_| self.is_awake()) {
                    return false;
                }
            }
        }
        let heard = read(&self.page.words().heard);
        ring(&self.bell);
        self.rung.store(heard, Ordering::Relaxed);
        true
    }
}

/// How long others have to look into their mailboxes, who may be stopped, or have too little of
/// the processor.
const PATIENCE: Duration = Duration::from_secs(1);

/// How long those have who do not listen yet, and may never.
const GRACE: Duration = Duration::from_millis(100);

/// How long to wait before asking again who has looked.
const STEP: Duration = Duration::from_millis(5);

/// Waits until these processes have taken everything that is in their mailboxes now, or `stop`
/// says so. Gives up on those who do not look for too long.
///
/// A look that was going on may have passed something by; the one after it has not.
pub(crate) fn wait_for_looks<'a>(at: impl Iterator<Item = &'a Neighbour>, stop: impl Fn() -> bool) {
    let mut waited_for: Vec<_> = at.map(|one| (one.looks(), one)).collect();
    let began = Instant::now();
    loop {
        let waited = began.elapsed();
        waited_for.retain(|(before, one)| {
            let patience = match before {
                0 => GRACE,
                _ => PATIENCE,
            };
            let has_looked = one.looks().wrapping_sub(*before) >= 2;
            !has_looked && waited < patience && !has_ended(one.live.as_ref())
        });
        if waited_for.is_empty() || stop() {
            return;
        }
        for (_, one) in &waited_for {
            ring(&one.bell);
        }
        std::thread::sleep(STEP);
    }
}

/// Whether all writers of a FIFO are gone.
pub(crate) fn has_ended(live: impl AsFd) -> bool {
    let mut byte = [0];
    // Nobody writes, so there is either nothing yet (an error) or nothing any more.
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

fn open_live(path: &Path) -> io::Result<File> {
    fifo(false).open(path)
}

/// For reading too, also by those who ring: then there is always a reader, and no SIGPIPE.
fn open_bell(path: &Path) -> io::Result<File> {
    fifo(true).open(path)
}

fn ring(mut bell: &File) {
    // A full FIFO has been rung often enough.
    let _ = bell.write(&[1]);
}

/// What stands in a page. Written by its process, read by others.
#[derive(Debug)]
#[repr(C)]
struct Words {
    /// How many threads of the process are looking.
    lookers: AtomicU32,
    /// How often the process has silenced its bell before it looked.
    heard: AtomicU64,
    /// What is written often does not disturb those who read the others.
    _apart: [u64; 6],
    /// How often the process has found its mailbox empty, or emptied it.
    looks: AtomicU64,
}

/// What another process counts; whatever is done next happens after it was read. On memory that is
/// mapped for reading only relaxed loads are allowed, so the order is the fence's.
fn read(count: &AtomicU64) -> u64 {
    let count = count.load(Ordering::Relaxed);
    fence(Ordering::Acquire);
    count
}

/// A mapped page.
#[derive(Debug)]
struct Page(Mapping);

impl Page {
    fn map(file: &File, protection: ProtFlags) -> io::Result<Self> {
        Mapping::new(file, PAGE, protection).map(Self)
    }

    fn words(&self) -> &Words {
        // SAFETY: the mapping lives as long as self, is aligned to a page and longer than `Words`,
        // whose every value is valid, and every process accesses these words atomically only.
        // Neighbours map it for reading and only load, relaxed, which Rust allows there for words
        // as long as a pointer. The file is never shortened: its process does not, nobody but this
        // user can, and who opens it has looked at its length and owner.
        unsafe { self.0.start().cast::<Words>().as_ref() }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test that cannot go on says so")]

    use std::os::unix::fs::symlink;

    use super::*;

    #[test]
    fn who_cannot_be_looked_at_is_not_dead() {
        let root = tempfile::tempdir().unwrap();
        let names = Names::new(root.path(), "fipatest-presence");
        std::fs::create_dir(names.directory()).unwrap();
        let (gone, hidden) = (Incarnation::from_u64(1), Incarnation::from_u64(2));
        // What the kernel says instead of what is there, as when too many files are open.
        symlink(names.live(hidden), names.live(hidden)).unwrap();
        assert!(!names.is_alive(gone));
        assert!(names.is_alive(hidden));
    }
}
