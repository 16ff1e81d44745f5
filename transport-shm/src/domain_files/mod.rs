//! The files of a domain: their creation, and [cleanup] after dead processes.
//!
//! After a process was killed, another one removes its mailbox and its side of every connection.
//! That must wait until the living processes have taken its last letters: iceoryx2 0.10 does not
//! release memory of requests that a receiver finds after their sender has been cleaned up. So the
//! cleaning process first rings all doorbells and waits until every living process has polled.

use std::fs::DirEntry;
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use fipa_transport::{DirectoryError, DomainUsers, Incarnation};
use iceoryx2::node::{Node, NodeState, NodeView};
use iceoryx2::prelude::{CallbackProgression, Config};
use parking_lot::Mutex;
use rustix::fs::{FlockOperation, Mode, OFlags, fchmod, fstat, open};
use rustix::io::Errno;

mod cleanup;

use crate::fork::OwnerMark;
use crate::layout::Svc;
use crate::memory::{is_owned, lock};
use crate::paths::ProcessPaths;
use crate::presence::{PeerProcess, wait_for_polls};
use crate::secret::{self, Secret};
use crate::shared_files::shared_files;
use crate::{ShmConfig, ShmError};

/// The result of [`cleanup_dead`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[non_exhaustive]
pub struct Cleaned {
    /// Number of processes that run.
    pub alive: usize,
    /// Number of dead processes whose files were removed.
    pub removed: usize,
    /// Number of dead processes whose files could not be removed, or that another process removes
    /// now.
    pub failed: usize,
}

/// Removes the files of killed processes of a domain. For tools: an endpoint does this by itself
/// when it starts, when it closes, and when a connected process ends.
///
/// Blocks until all living processes have polled their mailboxes, at most a second. The
/// configuration's incarnation is not used, but must be known.
///
/// # Errors
/// Returns an error if the configuration is invalid, the lock is held for too long, or files cannot
/// be listed.
pub fn cleanup_dead(config: &ShmConfig) -> Result<Cleaned, ShmError> {
    let domain = DomainFiles::of(config)?;
    if !config.root.exists() {
        return Ok(Cleaned::default());
    }
    domain.settle()?;
    domain.clean(false)
}

/// The directories and files of a domain.
#[derive(Debug)]
pub(crate) struct DomainFiles {
    /// Whether this belongs to an endpoint, whose files are removed at the end.
    member: bool,
    owner: OwnerMark,
    /// Held by the thread of this process that cleans up.
    cleaning: Mutex<()>,
    /// Whether the endpoint closes: a running cleanup stops, and waits are short.
    closing: AtomicBool,
    /// Whether the last wait for the lock timed out.
    lock_timed_out: AtomicBool,
    /// The secret in the names of the files. `None` if no process had joined the domain.
    secret: Option<Secret>,
    ice: Config,
    paths: ProcessPaths,
    config: ShmConfig,
}

impl DomainFiles {
    /// Returns the files of a domain, which may have no process. For tools.
    pub(crate) fn of(config: &ShmConfig) -> Result<Self, ShmError> {
        Self::new(config, secret_of(config)?)
    }

    fn new(config: &ShmConfig, secret: Option<Secret>) -> Result<Self, ShmError> {
        let prefix = match &secret {
            Some(secret) => format!("{}_{}", config.prefix, secret.as_str()),
            None => config.prefix.clone(),
        };
        Ok(Self {
            member: false,
            owner: OwnerMark::this(),
            cleaning: Mutex::default(),
            closing: AtomicBool::new(false),
            lock_timed_out: AtomicBool::new(false),
            secret,
            ice: config.iceoryx(&prefix)?,
            paths: ProcessPaths::new(&config.root, &prefix),
            config: config.clone(),
        })
    }

    /// Marks this as belonging to an endpoint.
    pub(crate) fn for_endpoint(mut self) -> Self {
        self.member = true;
        self
    }

    /// Performs the last cleanup of an endpoint.
    pub(crate) fn leave(&self) -> Result<Cleaned, ShmError> {
        self.begin_closing();
        self.clean(true)
    }

    pub(crate) fn owner(&self) -> OwnerMark {
        self.owner
    }

    pub(crate) fn iceoryx(&self) -> &Config {
        &self.ice
    }

    pub(crate) fn paths(&self) -> &ProcessPaths {
        &self.paths
    }

    /// Creates the directories and the secret, checks that the directories are private, and takes the
    /// lock as [`lock`](Self::lock) does. Retries if another process removes them at the same time.
    pub(crate) fn enter(config: &ShmConfig) -> Result<(Self, OwnedFd), ShmError> {
        config.check()?;
        let mut tries = 0;
        loop {
            tries += 1;
            match Self::try_enter(config) {
                Err(error) if error.is_missing_file() && tries < MAX_ENTER_ATTEMPTS => {}
                entered => return entered,
            }
        }
    }

    fn try_enter(config: &ShmConfig) -> Result<(Self, OwnedFd), ShmError> {
        let root = &config.root;
        make_private(root)?;
        let lock = lock_root(root, FlockOperation::NonBlockingLockExclusive, || {
            LOCK_TIMEOUT
        })?;
        let failed = |e| file_error("cannot create", &secret::path(root), e);
        let secret = match secret_of(config)? {
            Some(secret) if secret.has_this_layout() => secret,
            Some(other) => {
                Self::end_other_layout(config, other, &lock)?;
                Secret::draw().map_err(failed)?
            }
            None => Secret::draw().map_err(failed)?,
        };
        if Secret::read(root).map_err(failed)?.is_none() {
            secret.store(root).map_err(failed)?;
        }
        let domain = Self::new(config, Some(secret))?;
        make_private(domain.paths.directory())?;
        Ok((domain, lock))
    }

    /// Removes the files of a domain with this secret, whose processes have another layout than this one.
    ///
    /// # Errors
    /// If one of them runs.
    fn end_other_layout(
        config: &ShmConfig,
        secret: Secret,
        lock: &OwnedFd,
    ) -> Result<(), ShmError> {
        let others = secret::layout_name(secret.layout());
        let domain = Self::new(config, Some(secret))?;
        if domain.has_living()? {
            return Err(ShmError::OtherLayout {
                path: config.root.clone(),
                others,
                this: secret::layout_name(secret::LAYOUT),
            });
        }
        domain.remove_all(lock);
        Ok(())
    }

    /// Keeps other processes from starting and cleaning up until the result is dropped. The lock is
    /// on the directory itself, so no lock file remains.
    pub(crate) fn lock(&self) -> Result<OwnedFd, ShmError> {
        let how = FlockOperation::NonBlockingLockExclusive;
        self.locked(how, || match self.closing.load(Ordering::Relaxed) {
            true => CLOSING_LOCK_TIMEOUT,
            false => LOCK_TIMEOUT,
        })
    }

    /// Keeps other processes from cleaning up, but not from taking this lock, until the result is
    /// dropped. Taken to create files outside of [`DomainFiles::lock`]. Letters to a process wait
    /// while its mailbox is opened.
    pub(crate) fn lock_shared(&self) -> Result<OwnedFd, ShmError> {
        let how = FlockOperation::NonBlockingLockShared;
        self.locked(how, || match self.closing.load(Ordering::Relaxed) {
            true => Duration::ZERO,
            false => SHARED_LOCK_TIMEOUT,
        })
    }

    /// Takes the lock like [`lock_shared`](Self::lock_shared) without a wait. `None` if another
    /// process has it.
    pub(crate) fn try_lock_shared(&self) -> Result<Option<OwnedFd>, ShmError> {
        let root = &self.config.root;
        let how = FlockOperation::NonBlockingLockShared;
        match lock(root, how, || Duration::ZERO) {
            Ok(lock) => Ok(Some(lock)),
            Err(Errno::WOULDBLOCK) => Ok(None),
            Err(e) => Err(file_error("cannot lock", root, e)),
        }
    }

    /// Ends waits and cleanups of other threads early, because the endpoint closes.
    pub(crate) fn begin_closing(&self) {
        self.closing.store(true, Ordering::SeqCst);
    }

    /// Takes the lock. After a timeout, the next calls do not wait until one has succeeded.
    fn locked(
        &self,
        how: FlockOperation,
        timeout: impl Fn() -> Duration,
    ) -> Result<OwnedFd, ShmError> {
        let lock_timed_out = self.lock_timed_out.load(Ordering::Relaxed);
        let locked = lock_root(&self.config.root, how, || match lock_timed_out {
            true => Duration::ZERO,
            false => timeout(),
        });
        let busy = matches!(locked, Err(ShmError::Busy { .. }));
        self.lock_timed_out.store(busy, Ordering::Relaxed);
        locked
    }

    /// Removes the access of other users to files that iceoryx2 0.10 leaves open to them. The
    /// caller must hold the lock and have created a node.
    pub(crate) fn restrict_permissions(&self) -> Result<(), ShmError> {
        for file in shared_files() {
            let name = file.file_name();
            let name = name.to_string_lossy();
            if !name.starts_with(&self.prefix()) || !name.ends_with(".global_mgmt") {
                continue;
            }
            // The prefix is visible now, and a file of another user is none of this domain.
            if !file.metadata().is_ok_and(|metadata| is_owned(&metadata)) {
                continue;
            }
            let path = file.path();
            // Opened before the check: in a directory that any user may write to, a name proves
            // nothing.
            let flags = OFlags::RDONLY | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::CLOEXEC;
            let closed = open(&path, flags, Mode::empty()).and_then(|file| {
                let found = fstat(&file)?;
                if found.st_mode & 0o077 == 0 {
                    return Ok(());
                }
                fchmod(&file, Mode::RUSR | Mode::WUSR)
            });
            closed.map_err(|e| file_error("cannot restrict the permissions of", &path, e))?;
        }
        Ok(())
    }

    /// Waits until living processes have taken the letters of dead ones. Returns their number.
    pub(crate) fn settle(&self) -> Result<usize, ShmError> {
        let all = self.all()?.into_iter();
        let living = all.filter_map(|one| PeerProcess::open(&self.paths, one).ok());
        let living: Vec<PeerProcess> = living.collect();
        wait_for_polls(living.iter(), || self.closing.load(Ordering::SeqCst));
        Ok(living.len())
    }

    /// Rings at every living process. Returns their number.
    pub(crate) fn ring_all(&self) -> Result<usize, ShmError> {
        let all = self.all()?;
        let alive = all.into_iter().filter(|one| self.paths.is_alive(*one));
        Ok(alive.map(|one| self.paths.ring_once(one)).count())
    }

    /// Number of processes that run, and a lower bound of the number of dead ones with files.
    pub(crate) fn count(&self) -> Result<(usize, usize), ShmError> {
        let all = self.all()?;
        let known = all.len();
        let alive = all.into_iter().filter(|one| self.paths.is_alive(*one));
        let alive = alive.count();
        Ok((
            alive,
            (known - alive).max(self.node_count().saturating_sub(alive)),
        ))
    }

    /// Number of nodes or services, whichever is larger. A living process has one of each.
    fn node_count(&self) -> usize {
        let nodes = files_in(&self.config.root.join("nodes"));
        let nodes = nodes.filter(|node| node.file_type().is_ok_and(|kind| kind.is_dir()));
        nodes.count().max(files_in(&self.services()).count())
    }

    /// Delay before this process cleans up. It grows with the number of living processes that come
    /// before this one in order of incarnation.
    pub(crate) fn cleanup_delay(&self, own: Incarnation) -> Duration {
        let all = self.all().unwrap_or_default();
        let before = all
            .into_iter()
            .take_while(|one| *one < own)
            .filter(|one| self.paths.is_alive(*one));
        CLEANUP_STEP
            .saturating_mul(u32::try_from(before.count()).unwrap_or(u32::MAX))
            .min(CLEANUP_TIMEOUT)
    }

    /// Whether there seem to be files of dead processes. Checked without the lock; an error counts
    /// as true, and `clean` reports it.
    pub(crate) fn has_dead(&self) -> bool {
        !self.count().is_ok_and(|(_, dead)| dead == 0)
    }

    /// Whether a process of the domain runs.
    fn has_living(&self) -> Result<bool, ShmError> {
        let mut all = self.all()?.into_iter();
        Ok(all.any(|one| self.paths.is_alive(one)))
    }

    fn all(&self) -> Result<Vec<Incarnation>, ShmError> {
        self.paths
            .all()
            .map_err(|e| file_error("cannot list", self.paths.directory(), e))
    }

    /// Removes the files of dead processes, and those of the domain if no process is left. With
    /// `if_alone`, does nothing more if other processes run: they detect dead ones by themselves.
    pub(crate) fn clean(&self, if_alone: bool) -> Result<Cleaned, ShmError> {
        let mut cleaned = Cleaned::default();
        // Waits for another thread of this process, which stops when the endpoint closes.
        let Some(_cleaning) = self.cleaning.try_lock_for(CLEANUP_TIMEOUT) else {
            return Ok(cleaned);
        };
        let lock = match self.lock() {
            // Another process was the last one and has removed everything.
            Err(error) if error.is_missing_file() => return Ok(cleaned),
            lock => lock?,
        };
        if self.has_successor() {
            return Ok(cleaned);
        }
        let all = self.all()?.into_iter();
        let (alive, gone): (Vec<_>, Vec<_>) = all.partition(|one| self.paths.is_alive(*one));
        self.paths
            .remove(&gone, |path| self.remove_file(path, &lock));
        cleaned.alive = alive.len();
        if self.is_current(&lock) {
            cleaned.removed = gone.len();
        }
        if self.secret.as_ref().is_some_and(|it| !it.has_this_layout()) {
            // The files of iceoryx2 cannot be read here.
            if cleaned.alive == 0 {
                self.remove_all(&lock);
            }
            return Ok(cleaned);
        }
        let nodes = self.nodes()?;
        let is_dead = |node: &NodeState<Svc>| matches!(node, NodeState::Dead(_));
        if cleaned.alive == 0 && nodes.iter().all(is_dead) {
            self.remove_all(&lock);
            return Ok(cleaned);
        }
        self.remove_empty_files(&nodes, &lock);
        self.remove_partial_nodes(&nodes, &lock);
        self.remove_untagged_services(&lock);
        self.remove_orphaned_connections(&lock);
        // The rest runs without the lock, because a starting process must not wait for it: iceoryx2
        // waits long for structures that a dead process left unfinished.
        drop(lock);
        if if_alone {
            return Ok(cleaned);
        }
        let mut nameless = Vec::new();
        let dead = nodes.iter().filter(|node| is_dead(node)).count();
        for node in nodes {
            if self.closing.load(Ordering::SeqCst) {
                break;
            }
            match node {
                NodeState::Dead(dead) if dead.details().is_some() => {
                    let removed = dead.blocking_remove_stale_resources(CLEANUP_TIMEOUT);
                    cleaned.failed += usize::from(removed.is_err());
                }
                NodeState::Dead(dead) => nameless.push(*dead.id()),
                _ => {}
            }
        }
        if !nameless.is_empty() {
            // These processes were killed while they created or removed a node, or they create one
            // now. Under the lock no process creates a node, so the check is repeated there.
            let lock = self.lock()?;
            for node in self.nodes()? {
                if let NodeState::Dead(dead) = node
                    && dead.details().is_none()
                    && nameless.contains(dead.id())
                {
                    self.remove_node(&dead.id().value().to_string(), &lock);
                }
            }
        }
        if dead > 0 {
            let lock = self.lock()?;
            self.remove_orphaned_connections(&lock);
            drop(lock);
            // A process releases its side of connections with dead ones only when it polls its
            // mailbox.
            self.ring_all()?;
        }
        Ok(cleaned)
    }

    /// Whether the last process of this domain has ended, and another one has started the domain again with a secret
    /// of its own. The files that exist then belong to processes that this value does not know. The caller must hold
    /// the lock.
    fn has_successor(&self) -> bool {
        match Secret::read(&self.config.root) {
            Ok(None) => false,
            Ok(stored) => stored != self.secret,
            // Files that cannot be examined are not removed.
            Err(_) => true,
        }
    }

    fn nodes(&self) -> Result<Vec<NodeState<Svc>>, ShmError> {
        let mut nodes = Vec::new();
        let listed = Node::<Svc>::list(&self.ice, |node| {
            nodes.push(node);
            CallbackProgression::Continue
        });
        listed.map_err(|e| ShmError::Iceoryx {
            what: "cannot list the nodes",
            reason: crate::errors::words(&e),
            prefix: self.config.prefix.clone(),
        })?;
        Ok(nodes)
    }

    /// The files by which other processes find a process with this mailbox.
    pub(crate) fn files_of(&self, process: Incarnation, service_hash: &str) -> Vec<PathBuf> {
        let service = format!("{}{service_hash}.service", self.prefix());
        vec![
            self.paths.liveness_fifo(process),
            self.paths.doorbell(process),
            self.paths.status_page(process),
            self.services().join(service),
            secret::path(&self.config.root),
        ]
    }

    fn services(&self) -> PathBuf {
        self.config.root.join("services")
    }

    fn prefix(&self) -> String {
        self.ice.global.prefix.to_string()
    }
}

/// Maximum number of secrets whose processes are looked for.
const MAX_SECRETS: usize = 32;

/// Delay of a cleanup for each living process that comes before.
const CLEANUP_STEP: Duration = Duration::from_millis(20);

/// Timeout of the domain's lock. Each process holds it for milliseconds when it starts or ends, but
/// hundreds may do so at the same time on a busy machine.
const LOCK_TIMEOUT: Duration = Duration::from_secs(30);

/// Timeout of the shared lock, whose caller may use another transport.
const SHARED_LOCK_TIMEOUT: Duration = Duration::from_secs(1);

/// Timeout of the lock for a process that ends. When many end, the lock's holders clean up for it.
const CLOSING_LOCK_TIMEOUT: Duration = Duration::from_secs(2);

/// Maximum number of attempts to enter a domain whose directory is being removed.
const MAX_ENTER_ATTEMPTS: u32 = 20;

/// Timeout for another thread or process that removes files of the same process.
const CLEANUP_TIMEOUT: Duration = Duration::from_secs(1);

/// Entries of a directory. Skips those that cannot be read.
pub(crate) fn files_in(directory: &Path) -> impl Iterator<Item = DirEntry> + use<> {
    let files = std::fs::read_dir(directory);
    files.into_iter().flatten().flatten()
}

impl Drop for DomainFiles {
    /// The last owner in the process removes the remaining files, also if content was held for
    /// longer than the endpoint was open.
    fn drop(&mut self) {
        if self.member && self.owner.is_this() && self.config.root.exists() {
            self.closing.store(true, Ordering::SeqCst);
            // The error has no receiver; the next process that starts removes what is left.
            let _ = self.clean(true);
            // The remaining processes release their connections with this one.
            let _ = self.ring_all();
        }
    }
}

/// Returns the secret of a domain. If another program has removed the link, running processes of the
/// domain have the secret in the names of their files.
fn secret_of(config: &ShmConfig) -> Result<Option<Secret>, ShmError> {
    let stored = Secret::read(&config.root)
        .map_err(|e| file_error("cannot read", &secret::path(&config.root), e))?;
    if stored.is_some() {
        return Ok(stored);
    }
    let mut examined = Vec::new();
    for file in shared_files() {
        let name = file.file_name();
        let Some(secret) = Secret::in_name(&config.prefix, &name.to_string_lossy()) else {
            continue;
        };
        if examined.contains(&secret) || !file.metadata().is_ok_and(|it| is_owned(&it)) {
            continue;
        }
        let domain = DomainFiles::new(config, Some(secret.clone()))?;
        if domain.has_living()? {
            return Ok(Some(secret));
        }
        examined.push(secret);
        if examined.len() >= MAX_SECRETS {
            break;
        }
    }
    Ok(None)
}

/// Takes the lock of a domain, which is on the directory itself.
fn lock_root(
    root: &Path,
    how: FlockOperation,
    timeout: impl Fn() -> Duration,
) -> Result<OwnedFd, ShmError> {
    lock(root, how, timeout).map_err(|e| match e {
        Errno::WOULDBLOCK => ShmError::Busy {
            path: root.to_owned(),
        },
        _ => file_error("cannot lock", root, e),
    })
}

fn make_private(directory: &Path) -> Result<(), ShmError> {
    let failed = |source| file_error("cannot create or open the directory", directory, source);
    match DomainUsers::This.create_directory(directory) {
        Ok(_) => Ok(()),
        Err(DirectoryError::NotPrivate { path, intrusion }) => {
            Err(ShmError::NotPrivate { path, intrusion })
        }
        Err(DirectoryError::Io { source, .. }) => Err(failed(source)),
        Err(other) => Err(failed(std::io::Error::other(other))),
    }
}

pub(crate) fn file_error(
    what: &'static str,
    path: &Path,
    source: impl Into<std::io::Error>,
) -> ShmError {
    ShmError::File {
        what,
        path: path.to_owned(),
        source: source.into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::presence::Presence;

    #[test]
    fn a_domain_of_processes_of_another_layout_is_refused_until_they_have_ended() {
        let directory = tempfile::tempdir().unwrap();
        let root = directory.path().join("shm");
        let prefix = format!("fipatest-layout-{}", std::process::id());
        let own = Incarnation::from_u64(7);
        let config = ShmConfig::new(&root, prefix, own);
        let (started, lock) = DomainFiles::enter(&config).unwrap();
        let digits = started.secret.clone().unwrap();
        let (random, _) = digits.as_str().split_at(digits.as_str().len() - 1);
        let other = ['4', '8'].into_iter().find(|it| *it != secret::LAYOUT);
        let name = format!("x_{random}{}_", other.unwrap());
        let secret = Secret::in_name("x", &name).unwrap();
        secret.store(&root).unwrap();
        drop(lock);
        let others = DomainFiles::of(&config).unwrap();
        let presence = Presence::create(others.paths().clone(), own).unwrap();
        let refused = DomainFiles::enter(&config).unwrap_err();
        assert!(matches!(refused, ShmError::OtherLayout { .. }), "{refused}");
        assert_eq!(others.clean(false).unwrap().alive, 1);
        assert!(others.paths().is_alive(own));

        drop(presence);
        let left = others.paths().status_page(own);
        std::fs::write(&left, "").unwrap();
        let (started, lock) = DomainFiles::enter(&config).unwrap();
        assert!(started.secret.as_ref().unwrap().has_this_layout());
        assert!(!left.exists());
        drop(lock);
        started.clean(true).unwrap();
    }

    /// A process that ends cleans up last of all, and a tool may have read the directory before.
    #[test]
    fn a_late_cleanup_removes_no_file_of_a_domain_that_was_started_again() {
        let directory = tempfile::tempdir().unwrap();
        let prefix = format!("fipatest-again-{}", std::process::id());
        let own = Incarnation::from_u64(7);
        let config = ShmConfig::new(directory.path().join("shm"), prefix, own);
        let (left, lock) = DomainFiles::enter(&config).unwrap();
        drop(lock);
        assert_eq!(left.clean(true).unwrap().alive, 0);
        let empty = DomainFiles::of(&config).unwrap();
        let (started, lock) = DomainFiles::enter(&config).unwrap();
        let _presence = Presence::create(started.paths().clone(), own).unwrap();
        drop(lock);
        for late in [left, empty] {
            late.clean(true).unwrap();
            assert!(started.paths().is_alive(own));
            assert!(PeerProcess::open(started.paths(), own).is_ok());
            assert_eq!(DomainFiles::of(&config).unwrap().secret, started.secret);
        }
    }
}
