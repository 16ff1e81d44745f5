//! The files of a domain: their creation, and cleanup after dead processes.
//!
//! After a process was killed, another one removes its mailbox and its side of every connection.
//! That must wait until the living processes have taken its last letters: iceoryx2 0.10 does not
//! release memory of requests that a receiver finds after their sender has been cleaned up. So the
//! cleaning process first rings all doorbells and waits until every living process has polled.

use std::collections::{HashMap, HashSet};
use std::fs::DirEntry;
use std::os::fd::OwnedFd;
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use fipa_transport::Incarnation;
use iceoryx2::node::{Node, NodeState, NodeView};
use iceoryx2::prelude::{CallbackProgression, Config};
use iceoryx2::service::Service;
use parking_lot::Mutex;
use rustix::fs::{FlockOperation, Mode, OFlags, Stat, fchmod, fstat, lstat, open};
use rustix::io::Errno;

use crate::fork::Owner;
use crate::layout::Svc;
use crate::memory::{is_owned, lock};
use crate::presence::{PeerProcess, ProcessPaths, wait_for_polls};
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
    owner: Owner,
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
            owner: Owner::this(),
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

    pub(crate) fn owner(&self) -> Owner {
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
            Some(secret) => secret,
            None => Secret::draw().map_err(failed)?,
        };
        if Secret::read(root).map_err(failed)?.is_none() {
            secret.store(root).map_err(failed)?;
        }
        let domain = Self::new(config, Some(secret))?;
        make_private(domain.paths.directory())?;
        Ok((domain, lock))
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
        let all = self.all()?.into_iter();
        let (alive, gone): (Vec<_>, Vec<_>) = all.partition(|one| self.paths.is_alive(*one));
        self.paths.remove(&gone, || self.is_current(&lock));
        cleaned.alive = alive.len();
        if self.is_current(&lock) {
            cleaned.removed = gone.len();
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

    /// Removes empty files of processes that were killed between creating a file and extending it.
    /// iceoryx2 0.10 waits without limit for such a file to grow. The caller must hold the lock,
    /// under which no other process creates connections or services.
    fn remove_empty_files(&self, nodes: &[NodeState<Svc>], lock: &OwnedFd) {
        let prefix = self.prefix();
        let mut ports = Vec::new();
        for node in nodes {
            let NodeState::Dead(dead) = node else {
                continue;
            };
            let directory = self.config.root.join("nodes");
            let tags = files_in(&directory.join(dead.id().value().to_string()));
            ports.extend(tags.filter_map(|tag| self.id_of(&tag, ".port_tag")));
        }
        for file in shared_files() {
            let name = file.file_name();
            let name = name.to_string_lossy();
            let is_empty = || file.metadata().is_ok_and(|metadata| metadata.len() == 0);
            let nobody_makes_it = [".connection", ".dynamic", ".global_mgmt"]
                .iter()
                .any(|end| name.ends_with(end))
                || ports.iter().any(|port| name.contains(port));
            if name.starts_with(&prefix) && nobody_makes_it && is_empty() && self.is_current(lock) {
                // A failed removal is retried by the next cleanup.
                let _ = std::fs::remove_file(file.path());
            }
        }
    }

    /// Removes the nodes whose process was killed while it created or removed them: iceoryx2 takes
    /// them for nodes that are being created, or for invalid ones. The caller must hold the lock,
    /// under which no process creates a node. A process that removes its node tolerates the help.
    fn remove_partial_nodes(&self, nodes: &[NodeState<Svc>], lock: &OwnedFd) {
        let whole: HashSet<String> = nodes
            .iter()
            .filter_map(|node| match node {
                NodeState::Alive(node) => Some(node.id().value().to_string()),
                NodeState::Dead(node) => Some(node.id().value().to_string()),
                _ => None,
            })
            .collect();
        let prefix = self.prefix();
        for file in files_in(&self.config.root.join("nodes")) {
            let name = file.file_name();
            let name = name.to_string_lossy();
            // A directory is named by the number alone; the files that show whether the node is
            // alive are named by prefix, number and suffix.
            let id = name.strip_prefix(&prefix).unwrap_or(&name);
            let id = id.split('.').next().unwrap_or_default();
            if !id.is_empty() && id.bytes().all(|b| b.is_ascii_digit()) && !whole.contains(id) {
                self.remove_node(id, lock);
            }
        }
    }

    /// Removes the services that no node claims to use. A process leaves one if it is killed
    /// between creating a service and tagging it, or while it removes one. The caller must hold the
    /// lock, under which no process creates a service.
    ///
    /// iceoryx2 0.10 also leaves one if the process that removes the last node from a service is
    /// killed before it locks the service: a later process finds no node to remove, and so does not
    /// consider itself the last one.
    fn remove_untagged_services(&self, lock: &OwnedFd) {
        // Without the complete list of used services, unused ones cannot be told apart.
        let Ok(used) = self.tagged(".service_tag") else {
            return;
        };
        let untagged: HashMap<String, PathBuf> = files_in(&self.services())
            .filter_map(|file| Some((self.id_of(&file, ".service")?, file.path())))
            .filter(|(service, _)| !used.contains(service))
            .collect();
        if untagged.is_empty() {
            return;
        }
        // Only the service's own file names its shared memory, so it is removed last.
        let mut ids = HashSet::new();
        let listed = Svc::list(&self.ice, |service| {
            let details = service.static_details;
            if untagged.contains_key(details.service_hash().as_str()) {
                ids.insert(details.unique_service_id().value().to_string());
            }
            match ids.len() < untagged.len() {
                true => CallbackProgression::Continue,
                false => CallbackProgression::Stop,
            }
        });
        if listed.is_err() {
            return;
        }
        let shared = shared_files().filter(|file| {
            let id = self.id_of(file, ".dynamic");
            id.is_some_and(|id| ids.contains(&id))
        });
        for file in shared.map(|file| file.path()).chain(untagged.into_values()) {
            if self.is_current(lock) {
                // A failed removal is retried by the next cleanup.
                let _ = std::fs::remove_file(file);
            }
        }
    }

    /// Removes connections of ports that no process has. iceoryx2 0.10 leaves one if a
    /// process is killed between creating its file and recording its own end: then neither end is
    /// the last to close. The caller must hold the lock, under which no process creates a port. A
    /// port is tagged before it connects, and as long as it exists.
    ///
    /// A living process that still has such a connection open keeps its memory and does not need
    /// the file.
    fn remove_orphaned_connections(&self, lock: &OwnedFd) {
        // Without the complete list of ports, missing ones cannot be told apart.
        let Ok(ports) = self.tagged(".port_tag") else {
            return;
        };
        for file in shared_files() {
            let name = file.file_name();
            let name = name.to_string_lossy();
            let ends = name
                .strip_prefix(&self.prefix())
                .and_then(|name| name.strip_suffix(".connection"))
                .map(|name| name.rsplitn(3, '_'));
            let Some(mut ends) = ends else {
                continue;
            };
            if let (Some(receiver), Some(sender)) = (ends.next(), ends.next())
                && [sender, receiver].iter().any(|port| !ports.contains(*port))
                && self.is_current(lock)
            {
                // A failed removal is retried by the next cleanup.
                let _ = std::fs::remove_file(file.path());
            }
        }
    }

    /// Identifiers in the tags with this suffix, of all nodes including dead ones.
    fn tagged(&self, end: &str) -> std::io::Result<HashSet<String>> {
        let mut tagged = HashSet::new();
        for node in std::fs::read_dir(self.config.root.join("nodes"))? {
            let node = node?;
            if !node.file_type()?.is_dir() {
                continue;
            }
            let tags = match std::fs::read_dir(node.path()) {
                Ok(tags) => tags,
                // The node was just removed.
                Err(e) if e.kind() == std::io::ErrorKind::NotFound => continue,
                Err(e) => return Err(e),
            };
            for tag in tags {
                tagged.extend(self.id_of(&tag?, end));
            }
        }
        Ok(tagged)
    }

    /// The identifier in the name of a file of this domain with this suffix.
    fn id_of(&self, file: &DirEntry, end: &str) -> Option<String> {
        let name = file.file_name();
        let name = name.to_str()?.strip_prefix(&self.prefix())?;
        let id = name.strip_suffix(end)?.rsplit('_').next()?;
        Some(id.to_owned())
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

    /// Removes the files of a node.
    fn remove_node(&self, id: &str, lock: &OwnedFd) {
        if !self.is_current(lock) {
            return;
        }
        let nodes = self.config.root.join("nodes");
        let name = format!("{}{id}.", self.prefix());
        remove_files(files_in(&nodes), &name);
        remove_files(files_in(&nodes.join(id)), &self.prefix());
        let _ = std::fs::remove_dir(nodes.join(id));
    }

    /// Removes all files with the domain's prefix, whatever secret follows it: processes may have been
    /// killed after another program had removed the secret. The caller holds the lock, and no process
    /// of the domain runs. Also removes what iceoryx2 leaves for the next process, and structures that
    /// it cannot interpret after a process was killed.
    fn remove_all(&self, lock: &OwnedFd) {
        if !self.is_current(lock) {
            return;
        }
        let prefix = format!("{}_", self.config.prefix);
        remove_files(shared_files(), &prefix);
        for directory in ["nodes", "services", "processes"] {
            let directory = self.config.root.join(directory);
            for node in files_in(&directory) {
                remove_files(files_in(&node.path()), &prefix);
                // Fails for a file, and for a directory with files of another prefix.
                let _ = std::fs::remove_dir(node.path());
            }
            remove_files(files_in(&directory), &prefix);
            let _ = std::fs::remove_dir(&directory);
        }
        secret::remove(&self.config.root);
    }

    /// Whether the lock is that of the directory. If another program has removed the directory, other
    /// processes may have created it again, and the lock of the removed one says nothing about their
    /// files. Checked before each removal.
    fn is_current(&self, lock: &OwnedFd) -> bool {
        let is_same = |(held, found): (Stat, Stat)| {
            (held.st_dev, held.st_ino) == (found.st_dev, found.st_ino)
        };
        let found = fstat(lock).and_then(|held| Ok((held, lstat(&self.config.root)?)));
        found.is_ok_and(is_same)
            && Secret::read(&self.config.root).is_ok_and(|secret| secret == self.secret)
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

/// Removes the files with this prefix. A failed removal is retried by the next cleanup.
fn remove_files(files: impl Iterator<Item = DirEntry>, prefix: &str) {
    for file in files {
        if file.file_name().to_string_lossy().starts_with(prefix) {
            let _ = std::fs::remove_file(file.path());
        }
    }
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
        if domain
            .all()?
            .into_iter()
            .any(|one| domain.paths.is_alive(one))
        {
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
    let mut builder = std::fs::DirBuilder::new();
    builder
        .recursive(true)
        .mode(0o700)
        .create(directory)
        .map_err(|e| file_error("cannot create the directory", directory, e))?;
    let metadata = std::fs::symlink_metadata(directory)
        .map_err(|e| file_error("cannot examine the directory", directory, e))?;
    let me = rustix::process::geteuid().as_raw();
    let problem = if !metadata.is_dir() {
        "is not a directory".to_owned()
    } else if metadata.uid() != me {
        format!("belongs to user {}, and this is user {me}", metadata.uid())
    } else if metadata.mode() & 0o077 != 0 {
        format!("has mode {:04o}", metadata.mode() & 0o7777)
    } else {
        return Ok(());
    };
    Err(ShmError::NotPrivate {
        path: directory.to_owned(),
        problem,
    })
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
