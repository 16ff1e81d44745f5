//! The traces of a domain in the file system: making them, and removing those of the dead.
//!
//! When a process is killed, somebody has to remove its mailbox and its side of every connection.
//! That must wait until its last letters have been taken by those who are alive: iceoryx2 0.10
//! never lets go of memory for requests that it finds in the mailbox after their sender has been
//! cleaned up. So whoever cleans up first rings all bells, and waits until everybody has looked.

use std::collections::{HashMap, HashSet};
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
use rustix::fs::{FlockOperation, Mode, OFlags, fchmod, fstat, open};
use rustix::io::Errno;

use crate::fork::Owner;
use crate::layout::Svc;
use crate::memory::{SHM, lock};
use crate::presence::{Names, Neighbour, wait_for_looks};
use crate::{ShmConfig, ShmError};

/// What [`cleanup_dead`] did.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[non_exhaustive]
pub struct Cleaned {
    /// Processes that are there.
    pub alive: usize,
    /// Dead processes whose traces were removed.
    pub removed: usize,
    /// Dead processes whose traces could not be removed, or are being removed by somebody else.
    pub failed: usize,
}

/// Removes what killed processes of a domain left behind. For tools: an endpoint does this by
/// itself when it starts, when it closes, and when it notices that a process it talks to is gone.
///
/// Blocks until all living processes have looked into their mailboxes, at most a second. The
/// configuration's incarnation is not used; it must only be a known one.
///
/// # Errors
/// When the configuration makes no sense, or files cannot be listed.
pub fn cleanup_dead(config: &ShmConfig) -> Result<Cleaned, ShmError> {
    let domain = Domain::new(config)?;
    if !config.root.exists() {
        return Ok(Cleaned::default());
    }
    domain.settle()?;
    domain.clean(false)
}

/// A domain's place in the file system.
#[derive(Debug)]
pub(crate) struct Domain {
    /// Whether this is an endpoint's, which ends with it.
    member: bool,
    owner: Owner,
    /// Somebody of this process is cleaning.
    cleaning: Mutex<()>,
    /// The endpoint closes: whoever is cleaning should come to an end, and nobody wait for long.
    closing: AtomicBool,
    /// Somebody has the lock and does not let go.
    held_up: AtomicBool,
    ice: Config,
    names: Names,
    config: ShmConfig,
}

impl Domain {
    pub(crate) fn new(config: &ShmConfig) -> Result<Self, ShmError> {
        Ok(Self {
            member: false,
            owner: Owner::this(),
            cleaning: Mutex::default(),
            closing: AtomicBool::new(false),
            held_up: AtomicBool::new(false),
            ice: config.iceoryx()?,
            names: Names::new(&config.root, &config.prefix),
            config: config.clone(),
        })
    }

    /// The same, of an endpoint.
    pub(crate) fn joined(mut self) -> Self {
        self.member = true;
        self
    }

    /// The last cleaning up of an endpoint.
    pub(crate) fn leave(&self) -> Result<Cleaned, ShmError> {
        self.closing.store(true, Ordering::SeqCst);
        self.clean(true)
    }

    pub(crate) fn owner(&self) -> Owner {
        self.owner
    }

    pub(crate) fn iceoryx(&self) -> &Config {
        &self.ice
    }

    pub(crate) fn names(&self) -> &Names {
        &self.names
    }

    /// Makes the directories, checks that they are nobody else's, and excludes others as
    /// [`lock`](Self::lock) does. Whoever leaves last may be removing them at the same time.
    pub(crate) fn enter(&self) -> Result<OwnedFd, ShmError> {
        let mut tries = 0;
        loop {
            tries += 1;
            match self.try_enter() {
                Err(error) if error.is_missing_file() && tries < ENTERING => {}
                entered => return entered,
            }
        }
    }

    fn try_enter(&self) -> Result<OwnedFd, ShmError> {
        make_private(&self.config.root)?;
        let lock = self.lock()?;
        make_private(self.names.directory())?;
        Ok(lock)
    }

    /// Excludes others from starting and cleaning until the result is dropped. The lock is on the
    /// directory itself, so that there is no file to be left behind.
    pub(crate) fn lock(&self) -> Result<OwnedFd, ShmError> {
        let how = FlockOperation::NonBlockingLockExclusive;
        self.locked(how, || match self.closing.load(Ordering::Relaxed) {
            true => LEAVING,
            false => LOCKING,
        })
    }

    /// Excludes others from cleaning, but not from doing the same, until the result is dropped.
    /// For whoever is about to make files outside of [`Domain::lock`]; all letters of this process
    /// wait meanwhile.
    pub(crate) fn lock_shared(&self) -> Result<OwnedFd, ShmError> {
        self.locked(FlockOperation::NonBlockingLockShared, || SHARING)
    }

    /// Whoever was waited for in vain is not waited for again until the lock was to be had.
    fn locked(
        &self,
        how: FlockOperation,
        patience: impl Fn() -> Duration,
    ) -> Result<OwnedFd, ShmError> {
        let root = &self.config.root;
        let held_up = self.held_up.load(Ordering::Relaxed);
        let locked = lock(root, how, || match held_up {
            true => Duration::ZERO,
            false => patience(),
        });
        let busy = matches!(locked, Err(Errno::WOULDBLOCK));
        self.held_up.store(busy, Ordering::Relaxed);
        locked.map_err(|e| match busy {
            true => ShmError::Busy { path: root.clone() },
            false => file_error("cannot lock", root, e),
        })
    }

    /// Closes to others what iceoryx2 0.10 leaves open to everybody. To be called under the lock,
    /// after making a node.
    pub(crate) fn close_to_others(&self) -> Result<(), ShmError> {
        for file in files_in(Path::new(SHM)) {
            let name = file.file_name();
            let name = name.to_string_lossy();
            if !name.starts_with(&self.prefix()) || !name.ends_with(".global_mgmt") {
                continue;
            }
            let path = file.path();
            // Opened first: in a directory where everybody may write, a name proves nothing.
            let flags = OFlags::RDONLY | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::CLOEXEC;
            let closed = open(&path, flags, Mode::empty()).and_then(|file| {
                let found = fstat(&file)?;
                if found.st_mode & 0o077 == 0 {
                    return Ok(());
                }
                fchmod(&file, Mode::RUSR | Mode::WUSR)
            });
            closed.map_err(|e| file_error("cannot close to other users", &path, e))?;
        }
        Ok(())
    }

    /// Waits until the living have taken what the dead have sent, and says how many there are.
    pub(crate) fn settle(&self) -> Result<usize, ShmError> {
        let all = self.all()?.into_iter();
        let living = all.filter_map(|one| Neighbour::open(&self.names, one).ok());
        let living: Vec<Neighbour> = living.collect();
        wait_for_looks(living.iter(), || self.closing.load(Ordering::SeqCst));
        Ok(living.len())
    }

    /// Rings at every process, and says how many are there.
    pub(crate) fn ring_all(&self) -> Result<usize, ShmError> {
        let all = self.all()?;
        let alive = all.into_iter().filter(|one| self.names.is_alive(*one));
        Ok(alive.map(|one| self.names.ring_once(one)).count())
    }

    /// How many processes are there, and how many have left traces, at least.
    pub(crate) fn count(&self) -> Result<(usize, usize), ShmError> {
        let all = self.all()?;
        let known = all.len();
        let alive = all.into_iter().filter(|one| self.names.is_alive(*one));
        let alive = alive.count();
        Ok((
            alive,
            (known - alive).max(self.made().saturating_sub(alive)),
        ))
    }

    /// How many nodes or services there are, of which a living process has one each.
    fn made(&self) -> usize {
        let nodes = files_in(&self.config.root.join("nodes"));
        let nodes = nodes.filter(|node| node.file_type().is_ok_and(|kind| kind.is_dir()));
        nodes.count().max(files_in(&self.services()).count())
    }

    /// How long this process leaves it to others to clean up after the dead: the longer, the more
    /// of the living come before it.
    pub(crate) fn turn(&self, own: Incarnation) -> Duration {
        let all = self.all().unwrap_or_default();
        let before = all
            .into_iter()
            .take_while(|one| *one < own)
            .filter(|one| self.names.is_alive(*one));
        TURN.saturating_mul(u32::try_from(before.count()).unwrap_or(u32::MAX))
            .min(PATIENCE)
    }

    /// Whether there are traces of dead processes, as far as can be told without the lock. Errors
    /// count as such, which `clean` will meet again.
    pub(crate) fn has_dead(&self) -> bool {
        !self.count().is_ok_and(|(_, dead)| dead == 0)
    }

    fn all(&self) -> Result<Vec<Incarnation>, ShmError> {
        self.names
            .all()
            .map_err(|e| file_error("cannot list", self.names.directory(), e))
    }

    /// Removes the traces of dead processes, and when nobody is left, those of the domain. With
    /// `if_alone` nothing more is done when somebody is left: they notice the dead by themselves.
    pub(crate) fn clean(&self, if_alone: bool) -> Result<Cleaned, ShmError> {
        let mut cleaned = Cleaned::default();
        // Waits for another thread of this process, which comes to an end when the endpoint closes.
        let Some(_cleaning) = self.cleaning.try_lock_for(PATIENCE) else {
            return Ok(cleaned);
        };
        let lock = match self.lock() {
            // Somebody else was the last, and has removed all.
            Err(error) if error.is_missing_file() => return Ok(cleaned),
            lock => lock?,
        };
        for one in self.all()? {
            if self.names.is_alive(one) {
                cleaned.alive += 1;
            } else {
                self.names.remove(one);
                cleaned.removed += 1;
            }
        }
        let nodes = self.nodes()?;
        let is_dead = |node: &NodeState<Svc>| matches!(node, NodeState::Dead(_));
        if cleaned.alive == 0 && nodes.iter().all(is_dead) {
            self.remove_all();
            return Ok(cleaned);
        }
        self.remove_empty(&nodes);
        self.remove_halves(&nodes);
        self.remove_untagged();
        self.remove_orphans();
        // Who starts must not wait for what follows: iceoryx2 waits in vain, and for long, for
        // whatever a dead process was making when it was killed.
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
                    let removed = dead.blocking_remove_stale_resources(PATIENCE);
                    cleaned.failed += usize::from(removed.is_err());
                }
                NodeState::Dead(dead) => nameless.push(*dead.id()),
                _ => {}
            }
        }
        if !nameless.is_empty() {
            // Killed while it was being made, or while somebody removed it: iceoryx2 does not know
            // any more what it was. Looked at again, while nobody can be making one.
            let _lock = self.lock()?;
            for node in self.nodes()? {
                if let NodeState::Dead(dead) = node
                    && dead.details().is_none()
                    && nameless.contains(dead.id())
                {
                    self.remove_node(&dead.id().value().to_string());
                }
            }
        }
        if dead > 0 {
            let lock = self.lock()?;
            self.remove_orphans();
            drop(lock);
            // Only who looks into its mailbox lets go of its side of connections with the dead.
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
            reason: format!("{e:?}"),
            prefix: self.config.prefix.clone(),
        })?;
        Ok(nodes)
    }

    /// Removes the empty files that processes leave which are killed between making a file and
    /// giving it a length. iceoryx2 0.10 waits for such a file to become longer, without end. To
    /// be called under the lock, under which nobody else makes connections or services.
    fn remove_empty(&self, nodes: &[NodeState<Svc>]) {
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
        for file in files_in(Path::new(SHM)) {
            let name = file.file_name();
            let name = name.to_string_lossy();
            let is_empty = || file.metadata().is_ok_and(|metadata| metadata.len() == 0);
            let nobody_makes_it = [".connection", ".dynamic", ".global_mgmt"]
                .iter()
                .any(|end| name.ends_with(end))
                || ports.iter().any(|port| name.contains(port));
            if name.starts_with(&prefix) && nobody_makes_it && is_empty() {
                // Met again next time if it fails.
                let _ = std::fs::remove_file(file.path());
            }
        }
    }

    /// Removes the nodes whose process was killed while it was making them, or while it removed
    /// its own: iceoryx2 takes them for nodes that are about to be there, or that make no sense.
    /// To be called under the lock, under which nobody makes a node; who removes one does not
    /// mind help.
    fn remove_halves(&self, nodes: &[NodeState<Svc>]) {
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
            // A directory is named by the number alone, the files that say who lives by prefix,
            // number and an ending.
            let id = name.strip_prefix(&prefix).unwrap_or(&name);
            let id = id.split('.').next().unwrap_or_default();
            if !id.is_empty() && id.bytes().all(|b| b.is_ascii_digit()) && !whole.contains(id) {
                self.remove_node(id);
            }
        }
    }

    /// Removes the services that no node says it uses: what a process leaves that is killed
    /// between making a service and saying so, or while it removes one. To be called under the
    /// lock, under which nobody makes a service.
    ///
    /// Of iceoryx2 0.10 one is left, too, when whoever takes the last node out of a service is killed
    /// before it locks that: who comes next finds no node to take out, and takes that for its not
    /// having been the last.
    fn remove_untagged(&self) {
        // Without all that are used nobody can say which are not.
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
        // Only the service's own file says which shared memory is its, and so goes last.
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
        let shared = files_in(Path::new(SHM)).filter(|file| {
            let id = self.id_of(file, ".dynamic");
            id.is_some_and(|id| ids.contains(&id))
        });
        for file in shared.map(|file| file.path()).chain(untagged.into_values()) {
            // Met again next time if it fails.
            let _ = std::fs::remove_file(file);
        }
    }

    /// Removes the connections of ports that nobody has any more. iceoryx2 0.10 leaves one behind
    /// when a process is killed after making its file and before saying which end it is: then
    /// neither end is the last to go. To be called under the lock, under which nobody makes a
    /// port; a port says that it is there before it connects, and as long as it does.
    ///
    /// Whoever lives and still has such a connection open keeps its memory, and does not mind that
    /// the file is gone.
    fn remove_orphans(&self) {
        // Without all the ports nobody can say whose is missing.
        let Ok(ports) = self.tagged(".port_tag") else {
            return;
        };
        for file in files_in(Path::new(SHM)) {
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
            {
                // Met again next time if it fails.
                let _ = std::fs::remove_file(file.path());
            }
        }
    }

    /// What all nodes, dead ones too, say they have or use, by tags with this ending.
    fn tagged(&self, end: &str) -> std::io::Result<HashSet<String>> {
        let mut tagged = HashSet::new();
        for node in std::fs::read_dir(self.config.root.join("nodes"))? {
            let node = node?;
            if !node.file_type()?.is_dir() {
                continue;
            }
            let tags = match std::fs::read_dir(node.path()) {
                Ok(tags) => tags,
                // It leaves just now.
                Err(e) if e.kind() == std::io::ErrorKind::NotFound => continue,
                Err(e) => return Err(e),
            };
            for tag in tags {
                tagged.extend(self.id_of(&tag?, end));
            }
        }
        Ok(tagged)
    }

    /// Of what in this domain a file with this ending is.
    fn id_of(&self, file: &std::fs::DirEntry, end: &str) -> Option<String> {
        let name = file.file_name();
        let name = name.to_str()?.strip_prefix(&self.prefix())?;
        let id = name.strip_suffix(end)?.rsplit('_').next()?;
        Some(id.to_owned())
    }

    /// The files by which others find a process with this mailbox.
    pub(crate) fn files_of(&self, process: Incarnation, service_hash: &str) -> Vec<PathBuf> {
        let service = format!("{}{service_hash}.service", self.prefix());
        vec![
            self.names.live(process),
            self.names.bell(process),
            self.names.page(process),
            self.services().join(service),
        ]
    }

    fn services(&self) -> PathBuf {
        self.config.root.join("services")
    }

    /// Removes what is in the file system of a node.
    fn remove_node(&self, id: &str) {
        let nodes = self.config.root.join("nodes");
        let name = format!("{}{id}.", self.prefix());
        remove_files(&nodes, &name);
        remove_files(&nodes.join(id), &self.prefix());
        let _ = std::fs::remove_dir(nodes.join(id));
    }

    /// Nobody is there, and nobody can come while the lock is held: what has the domain's prefix
    /// can go. That is what iceoryx2 leaves for the next process, when there may never be one,
    /// and what it could not make sense of after a process was killed.
    fn remove_all(&self) {
        let prefix = self.prefix();
        remove_files(Path::new(SHM), &prefix);
        for directory in ["nodes", "services", "processes"] {
            let directory = self.config.root.join(directory);
            for node in files_in(&directory) {
                remove_files(&node.path(), &prefix);
                // Fails when it is a file, or has files of another prefix.
                let _ = std::fs::remove_dir(node.path());
            }
            remove_files(&directory, &prefix);
            let _ = std::fs::remove_dir(&directory);
        }
    }

    fn prefix(&self) -> String {
        self.ice.global.prefix.to_string()
    }
}

/// How much longer the next one waits before it cleans up.
const TURN: Duration = Duration::from_millis(20);

/// How long to wait for the lock of the domain. Everybody has it for milliseconds, when it starts or
/// ends; but hundreds may do that at the same time, on a machine that is busy.
const LOCKING: Duration = Duration::from_secs(30);

/// The same, for who may go another way.
const SHARING: Duration = Duration::from_secs(1);

/// The same, for whoever ends. When many end, those who have the lock meanwhile clean up for it.
const LEAVING: Duration = Duration::from_secs(2);

/// How often an endpoint tries to enter a domain whose directory others are removing.
const ENTERING: u32 = 20;

/// How long to wait for somebody else who is removing the traces of the same process.
const PATIENCE: Duration = Duration::from_secs(1);

/// What is in a directory, as far as it can be read.
pub(crate) fn files_in(directory: &Path) -> impl Iterator<Item = std::fs::DirEntry> + use<> {
    let files = std::fs::read_dir(directory);
    files.into_iter().flatten().flatten()
}

/// Removes the files with this prefix. What cannot be removed is met again next time.
fn remove_files(directory: &Path, prefix: &str) {
    for file in files_in(directory) {
        if file.file_name().to_string_lossy().starts_with(prefix) {
            let _ = std::fs::remove_file(file.path());
        }
    }
}

impl Drop for Domain {
    /// Whoever goes last removes what is left, also when it held content for longer than its
    /// endpoint was open.
    fn drop(&mut self) {
        if self.member && self.owner.is_this() && self.config.root.exists() {
            self.closing.store(true, Ordering::SeqCst);
            // Nobody to report to; what cannot be removed is removed by the next who starts.
            let _ = self.clean(true);
            // Those who are still there let go of what connected them with this process.
            let _ = self.ring_all();
        }
    }
}

fn make_private(directory: &Path) -> Result<(), ShmError> {
    let mut builder = std::fs::DirBuilder::new();
    builder
        .recursive(true)
        .mode(0o700)
        .create(directory)
        .map_err(|e| file_error("cannot make the directory", directory, e))?;
    let metadata = std::fs::symlink_metadata(directory)
        .map_err(|e| file_error("cannot look at the directory", directory, e))?;
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
