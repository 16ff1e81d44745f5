//! State of a host's directory: the entries of other processes, and those that this process writes.

use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;

use arc_swap::ArcSwap;
use fipa_acl::ErrorChain;
use fipa_transport::{Incarnation, Kind, log_limit};
use parking_lot::Mutex;
use tokio::sync::{Notify, watch};

use super::file::{self, Entries, FileError};
use super::host_dir::{Content, Guard, HostDir, Id, Name, Version};
use super::remote::{self, RemoteAgents, RemoteError, RemoteLists};
use super::{Cancellation, HostError, SocketId};
use crate::table::Table;
use crate::{Change, DeregisterError, Entry, MtsId, RegisterError, Source, View, Watch};

/// The state behind a [`HostDirectory`](super::HostDirectory), shared with its task.
///
/// Locks are taken in this order: the domain's, `own`, `others`, the table's.
#[derive(Debug)]
pub(super) struct Shared {
    /// Replaced when the directory was removed and joined again.
    host_dir: ArcSwap<HostDir>,
    pub(super) table: Table<Id>,
    mts: MtsId,
    own: Mutex<OwnEntries>,
    others: Mutex<OtherProcesses>,
    /// Number of processes that have ended.
    ended: watch::Sender<u64>,
    sockets: watch::Sender<Vec<SocketId>>,
    /// Notified when the directory may have been removed.
    disturbed: Notify,
}

/// The entries that this process writes.
#[derive(Debug, Default)]
struct OwnEntries {
    closed: bool,
    agents: Entries,
    /// The file with the agents of other hosts that this gateway publishes; empty if it has published none. They
    /// are not in its own table, because it has them from other back ends.
    remote: Vec<u8>,
}

/// The entries of the other processes.
#[derive(Debug, Default)]
struct OtherProcesses {
    generation: u64,
    processes: HashMap<Id, Process>,
    /// The files of gateways.
    gateways: HashMap<Id, Gateway>,
}

impl OtherProcesses {
    /// Whether another process has registered an agent of this name in a file that exists now.
    fn has_registered(&self, name: &str) -> bool {
        self.registrar(name).is_some()
    }

    /// Returns the process that has registered an agent of this name in a file that exists now.
    fn registrar(&self, name: &str) -> Option<&Process> {
        let mut processes = self.processes.values();
        processes.find(|process| process.version.is_some() && process.entries.contains_key(name))
    }
}

#[derive(Debug, Default)]
struct Process {
    /// The owner of the file with the entries.
    user: u32,
    version: Option<Version>,
    entries: Entries,
}

/// The agents of other hosts that a gateway publishes.
#[derive(Debug)]
struct Gateway {
    version: Option<Version>,
    /// `None` if the file is not valid.
    remote: Option<Arc<RemoteAgents>>,
}

impl Shared {
    pub(super) fn new(host_dir: HostDir, mts: MtsId) -> Self {
        Self {
            host_dir: ArcSwap::from_pointee(host_dir),
            table: Table::new(),
            mts,
            own: Mutex::default(),
            others: Mutex::default(),
            ended: watch::Sender::default(),
            sockets: watch::Sender::default(),
            disturbed: Notify::new(),
        }
    }

    pub(super) fn host_dir(&self) -> Arc<HostDir> {
        self.host_dir.load_full()
    }

    /// Reports that the directory may have been removed.
    pub(super) fn report_disturbed(&self) {
        self.disturbed.notify_one();
    }

    pub(super) async fn disturbed(&self) {
        self.disturbed.notified().await;
    }

    /// Whether other processes can find the entries of this one.
    pub(super) fn is_there(&self) -> Result<bool, HostError> {
        let own = self.own.lock();
        if own.closed {
            return Ok(true);
        }
        let host_dir = self.host_dir();
        let id = host_dir.id();
        let is_there = |name, is_empty| match is_empty {
            true => Ok(true),
            false => host_dir.version(name).map(|version| version.is_some()),
        };
        Ok(host_dir.is_there()?
            && is_there(Name::Entries(id), own.agents.is_empty())?
            && is_there(Name::Remote(id), own.remote.is_empty())?)
    }

    /// Returns the user whose process on this host has registered an agent of this name.
    pub(super) fn user_of(&self, name: &str) -> Option<u32> {
        if self.own.lock().agents.contains_key(name) {
            return Some(rustix::process::geteuid().as_raw());
        }
        Some(self.others.lock().registrar(name)?.user)
    }

    /// Joins the directory again after it, or files of this process in it, were removed; returns
    /// whether that was necessary.
    ///
    /// Entries of other processes stay until [`rescan`](Self::rescan): these processes need time to
    /// join again.
    pub(super) fn rejoin(&self) -> Result<bool, HostError> {
        if self.is_there()? {
            return Ok(false);
        }
        let before = self.host_dir();
        // The process counts on in a new file with the same values, so those of this one are not kept.
        before.remove(Name::Counts(before.id()))?;
        let host_dir = Arc::new(HostDir::join(
            before.path(),
            before.users(),
            before.id(),
            &Cancellation::new(),
        )?);
        let guard = host_dir.lock()?;
        let mut own = self.own.lock();
        if own.closed {
            drop(own);
            guard.leave()?;
            return Ok(false);
        }
        self.host_dir.store(Arc::clone(&host_dir));
        let mut others = self.others.lock();
        others.generation = 0;
        for process in others.processes.values_mut() {
            // A new file may have the version of the removed one.
            process.version = None;
        }
        for gateway in others.gateways.values_mut() {
            gateway.version = None;
        }
        self.scan(&mut others)?;
        let taken: Vec<Arc<str>> = own
            .agents
            .keys()
            .filter(|name| others.has_registered(name))
            .cloned()
            .collect();
        drop(others);
        for name in taken {
            if let Some(entry) = own.agents.remove(&name) {
                log_limit::error!(
                    %name,
                    "another process registered the name while the directory was gone; this agent \
                     is no longer registered"
                );
                self.table.release(host_dir.id(), &name, entry.incarnation);
            }
        }
        self.write(&guard, &own).map_err(|error| match error {
            WriteError::Full(why) => HostError::Full(why),
            WriteError::Host(error) => error,
        })?;
        if !own.remote.is_empty() {
            guard.write(Name::Remote(host_dir.id()), &own.remote)?;
        }
        drop((own, guard));
        self.find_sockets()?;
        Ok(true)
    }

    pub(super) fn departures(&self) -> watch::Receiver<u64> {
        self.ended.subscribe()
    }

    /// Reports that processes have ended.
    pub(super) fn report_ended(&self) {
        self.ended.send_modify(|count| *count += 1);
    }

    pub(super) fn sockets(&self) -> watch::Receiver<Vec<SocketId>> {
        self.sockets.subscribe()
    }

    /// Updates the list of processes that have a socket.
    pub(super) fn find_sockets(&self) -> Result<(), HostError> {
        let names = self.host_dir().names()?;
        let mut found: Vec<SocketId> = names
            .into_iter()
            .filter_map(|name| match name {
                Name::Socket(id) if id != self.host_dir().id() => Some(SocketId(id)),
                _ => None,
            })
            .collect();
        found.sort_unstable();
        self.sockets.send_if_modified(|known| {
            let changed = *known != found;
            *known = found;
            changed
        });
        Ok(())
    }

    /// Reads the changes of other processes; takes one system call when there are none, and examines the files
    /// of the processes that made them. A file per process would make a start of many quadratic.
    pub(super) fn refresh(&self) -> Result<(), HostError> {
        let host_dir = self.host_dir();
        let generation = host_dir.generation()?;
        let mut others = self.others.lock();
        if others.generation == generation {
            return Ok(());
        }
        match host_dir.replaced_between(others.generation, generation)? {
            Some(names) => {
                for name in names {
                    self.read(&mut others, name)?;
                }
            }
            None => self.scan(&mut others)?,
        }
        // Read before the files, so that a change in between causes another read.
        others.generation = generation;
        Ok(())
    }

    /// Reads all files again and checks which processes are running, regardless of the generation.
    pub(super) fn rescan(&self) -> Result<(), HostError> {
        let mut others = self.others.lock();
        let known = others.processes.keys().chain(others.gateways.keys());
        let known: BTreeSet<Id> = known.copied().collect();
        for id in known {
            if !self.host_dir().is_running(id)? {
                self.forget(&mut others, id);
            }
        }
        // A process may have ended before its files were read for the first time.
        self.report_ended();
        self.scan(&mut others)?;
        drop(others);
        self.find_sockets()
    }

    fn scan(&self, others: &mut OtherProcesses) -> Result<(), HostError> {
        for name in self.host_dir().names()? {
            self.read(others, name)?;
        }
        Ok(())
    }

    /// Reads a file that another process has replaced.
    pub(super) fn replaced(&self, name: Name) -> Result<(), HostError> {
        self.read(&mut self.others.lock(), name)
    }

    /// Reads a file of another process if it has changed.
    fn read(&self, others: &mut OtherProcesses, name: Name) -> Result<(), HostError> {
        let own = self.host_dir().id();
        match name {
            Name::Entries(id) if id != own => self.read_entries(others, id),
            Name::Remote(id) if id != own => self.read_remote(others, id),
            _ => Ok(()),
        }
    }

    fn read_entries(&self, others: &mut OtherProcesses, id: Id) -> Result<(), HostError> {
        let known = others.processes.get(&id);
        let name = Name::Entries(id);
        let version = self.host_dir().version(name)?;
        if known.is_some_and(|process| process.version == version) {
            return Ok(());
        }
        // The files of an unknown process may be leftovers of a dead one.
        if known.is_none() && !self.host_dir().is_running(id)? {
            return Ok(());
        }
        let this_user = rustix::process::geteuid().as_raw();
        let read = || -> Result<(Entries, u32), ReadError> {
            let Some(Content { bytes, user }) = self.host_dir().read(name)? else {
                return Ok((Entries::default(), this_user));
            };
            let entries = file::read(&bytes)?;
            Ok(match user == this_user {
                true => (entries, user),
                false => (without_memory(entries), user),
            })
        };
        let (entries, user) = read().unwrap_or_else(|error| self.ignored(name, &error));
        let process = others.processes.entry(id).or_default();
        process.user = user;
        // Taken before reading, so that a replacement in between causes another read.
        process.version = version;
        let before = std::mem::replace(&mut process.entries, entries);
        self.tell(id, &before, &process.entries);
        Ok(())
    }

    fn read_remote(&self, others: &mut OtherProcesses, id: Id) -> Result<(), HostError> {
        let known = others.gateways.get(&id);
        let name = Name::Remote(id);
        let version = self.host_dir().version(name)?;
        if version == known.and_then(|gateway| gateway.version) {
            return Ok(());
        }
        if known.is_none() && !self.host_dir().is_running(id)? {
            return Ok(());
        }
        let read = || -> Result<Option<Arc<RemoteAgents>>, ReadError> {
            let file = self.host_dir().open(name)?;
            Ok(file.map(RemoteAgents::open).transpose()?.map(Arc::new))
        };
        let remote = read().unwrap_or_else(|error| self.ignored(name, &error));
        let gateway = Gateway { version, remote };
        let before = others.gateways.insert(id, gateway);
        self.show_remote(others, id, before);
        Ok(())
    }

    /// Logs a file that is treated as empty; the process's next file may be valid.
    fn ignored<T: Default>(&self, name: Name, error: &ReadError) -> T {
        let path = self.host_dir().path().join(name.to_string());
        log_limit::error!(path = %path.display(), error = %ErrorChain(error), "entries file ignored");
        T::default()
    }

    /// Shows the agents that the gateways among the other processes publish, after that of this one
    /// changed.
    fn show_remote(&self, others: &OtherProcesses, id: Id, before: Option<Gateway>) {
        let before = before.and_then(|gateway| gateway.remote);
        let remotes = others.gateways.iter();
        let remotes = remotes.filter_map(|(id, gateway)| Some((id, gateway.remote.as_ref()?)));
        let after = others.gateways.get(&id).and_then(|it| it.remote.as_ref());
        let lists = |changed: Option<&Arc<RemoteAgents>>| {
            let others = remotes.clone().filter(|(other, _)| **other != id);
            RemoteLists(others.map(|(_, it)| it).chain(changed).cloned().collect())
        };
        let earlier = lists(before.as_ref());
        let later = Arc::new(lists(after));
        let lost = later
            .0
            .iter()
            .flat_map(|agents| agents.lost_agents().to_vec());
        self.table
            .set_beneath(Arc::clone(&later) as Arc<dyn View>, lost);
        if !self.table.is_watched() {
            return;
        }
        let names = remote::changed(before.as_deref(), after.map(|it| &**it), Watch::CAPACITY);
        let names = names.unwrap_or_else(|error| {
            log_limit::error!(error = %ErrorChain(&error), "cannot compare the agents of other hosts");
            None
        });
        let changes = names.map(|names| {
            let change = |name: &Arc<str>| Change::between(earlier.named(name), later.named(name));
            names.iter().filter_map(change).collect()
        });
        self.table.changed_beneath(changes);
    }

    fn tell(&self, id: Id, before: &Entries, after: &Entries) {
        let removed = before.keys().filter(|name| !after.contains_key(*name));
        let removed = removed.map(|name| (id, name.clone(), None));
        let changed = after
            .iter()
            .filter(|(name, entry)| before.get(*name) != Some(entry));
        let changed = changed.map(|(name, entry)| (id, name.clone(), Some(Arc::clone(entry))));
        self.table.update(removed.chain(changed));
    }

    /// Drops the entries of a process if it is dead. Returns false if it is running.
    pub(super) fn process_ended(&self, id: Id) -> Result<bool, HostError> {
        if self.host_dir().is_running(id)? {
            return Ok(false);
        }
        self.forget(&mut self.others.lock(), id);
        Ok(true)
    }

    fn forget(&self, others: &mut OtherProcesses, id: Id) {
        if let Some(process) = others.processes.remove(&id) {
            self.tell(id, &process.entries, &Entries::new());
        }
        if let Some(gateway) = others.gateways.remove(&id) {
            self.show_remote(others, id, Some(gateway));
        }
    }

    /// Removes the files of a process if it is dead. Returns false if another process holds the
    /// lock.
    pub(super) fn try_remove_files(&self, id: Id) -> Result<bool, HostError> {
        let host_dir = self.host_dir();
        let Some(guard) = host_dir.try_lock()? else {
            return Ok(false);
        };
        if !self.host_dir().is_running(id)? {
            guard.remove_files(id)?;
        }
        Ok(true)
    }

    pub(super) fn register(
        &self,
        entry: Entry,
        cancellation: &Cancellation,
    ) -> Result<Arc<Entry>, RegisterError> {
        let host_dir = self.host_dir();
        let guard = host_dir.lock_unless(cancellation).map_err(failed)?;
        self.free(&guard, &entry)?;
        // The check above may have read many files.
        cancellation.check().map_err(failed)?;
        let mut own = self.own.lock();
        if own.closed {
            return Err(RegisterError::Closed);
        }
        let entry = Arc::new(entry);
        let before = own.agents.insert(entry.name.clone(), Arc::clone(&entry));
        if let Err(error) = self.write(&guard, &own) {
            match before {
                Some(before) => own.agents.insert(before.name.clone(), before),
                None => own.agents.remove(&entry.name),
            };
            return Err(error.into());
        }
        self.table.put(self.host_dir().id(), Arc::clone(&entry));
        Ok(entry)
    }

    pub(super) fn replace(
        &self,
        entries: Vec<Entry>,
        leaving: &[(&str, Incarnation)],
    ) -> Result<(), RegisterError> {
        let host_dir = self.host_dir();
        let guard = host_dir.lock().map_err(failed)?;
        for entry in &entries {
            self.free(&guard, entry)?;
        }
        let mut own = self.own.lock();
        if own.closed {
            return Err(RegisterError::Closed);
        }
        let before = own.agents.clone();
        for (name, incarnation) in leaving {
            let ours = own.agents.get(*name);
            if ours.is_none_or(|entry| entry.incarnation != *incarnation) {
                own.agents = before;
                return Err(RegisterError::NotOurs((*name).into()));
            }
            own.agents.remove(*name);
        }
        let entries = entries
            .into_iter()
            .map(|entry| (entry.name.clone(), Arc::new(entry)));
        own.agents.extend(entries);
        if let Err(error) = self.write(&guard, &own) {
            own.agents = before;
            return Err(error.into());
        }
        self.tell(self.host_dir().id(), &before, &own.agents);
        Ok(())
    }

    /// Checks that no running process holds the name, and removes the files of dead ones that do.
    fn free(&self, guard: &Guard<'_>, entry: &Entry) -> Result<(), RegisterError> {
        self.refresh().map_err(failed)?;
        while let Some((id, holder)) = self.table.holder(&entry.name) {
            let ours = id == self.host_dir().id();
            if ours && holder.incarnation == entry.incarnation {
                break;
            }
            if ours || self.host_dir().is_running(id).map_err(failed)? {
                return Err(RegisterError::AlreadyRegistered { holder });
            }
            self.forget(&mut self.others.lock(), id);
            guard.remove_files(id).map_err(failed)?;
        }
        while let Some((id, holder)) = self.remote_holder(&entry.name) {
            if self.host_dir().is_running(id).map_err(failed)? {
                return Err(RegisterError::AlreadyRegistered { holder });
            }
            self.forget(&mut self.others.lock(), id);
            guard.remove_files(id).map_err(failed)?;
        }
        Ok(())
    }

    /// Returns a gateway that publishes an agent of this name, and that agent. A contact does not hold its
    /// name: it is only the sender of a letter, which may have left since.
    fn remote_holder(&self, name: &str) -> Option<(Id, Arc<Entry>)> {
        let others = self.others.lock();
        others.gateways.iter().find_map(|(id, gateway)| {
            let holder = gateway.remote.as_ref()?.named(name)?;
            (holder.source != Source::Contact).then_some((*id, holder))
        })
    }

    pub(super) fn deregister(
        &self,
        name: &str,
        of: impl Fn(&Entry) -> bool,
    ) -> Result<(), DeregisterError> {
        let failed = |error: WriteError| DeregisterError::Failed(Arc::new(error));
        self.change(|guard, own| {
            if own.closed {
                return Err(DeregisterError::Closed);
            }
            let Some(entry) = own.agents.get(name).filter(|entry| of(entry)).cloned() else {
                return Err(DeregisterError::NotRegistered(name.into()));
            };
            own.agents.remove(name);
            if let Err(error) = self.write_now_or_later(guard, own) {
                own.agents.insert(entry.name.clone(), entry);
                return Err(failed(error));
            }
            let id = self.host_dir().id();
            self.table.release(id, name, entry.incarnation);
            Ok(())
        })
    }

    /// Replaces the agents of other hosts that this gateway publishes, and the lost ones.
    pub(super) fn publish(
        &self,
        remote: &[Arc<Entry>],
        lost: &[Arc<Entry>],
    ) -> Result<usize, HostError> {
        let bytes = remote::write(&self.mts, remote, lost);
        let size = bytes.len();
        self.change(|guard, own| {
            if own.closed {
                return Err(HostError::Closed);
            }
            if own.remote == bytes {
                return Ok(size);
            }
            let before = std::mem::replace(&mut own.remote, bytes);
            let write = |guard: Guard<'_>| guard.write(Name::Remote(guard.id()), &own.remote);
            self.now_or_later(guard.and_then(write))
                .inspect_err(|_| own.remote = before)?;
            Ok(size)
        })
    }

    /// Changes this process's entries under the lock of the domain, or without it if the directory
    /// was removed.
    fn change<T>(
        &self,
        change: impl FnOnce(Result<Guard<'_>, HostError>, &mut OwnEntries) -> T,
    ) -> T {
        loop {
            let host_dir = self.host_dir();
            let guard = host_dir.lock();
            let mut own = self.own.lock();
            // After a rejoin, this is a different directory. `own` is locked, so it cannot change
            // below.
            if Arc::ptr_eq(&host_dir, &self.host_dir()) {
                return change(guard, &mut own);
            }
        }
    }

    /// Writes this process's entries. If the directory was removed, [`rejoin`](Self::rejoin) writes
    /// them later.
    fn write_now_or_later(
        &self,
        guard: Result<Guard<'_>, HostError>,
        own: &OwnEntries,
    ) -> Result<(), WriteError> {
        match guard
            .map_err(WriteError::from)
            .and_then(|guard| self.write(&guard, own))
        {
            Err(WriteError::Host(error)) => Ok(self.now_or_later(Err(error))?),
            written => written,
        }
    }

    /// Ignores an error if the directory was removed: [`rejoin`](Self::rejoin) writes later.
    fn now_or_later(&self, written: Result<(), HostError>) -> Result<(), HostError> {
        match written {
            Err(_) if matches!(self.host_dir().is_there(), Ok(false)) => Ok(()),
            written => written,
        }
    }

    fn write(&self, guard: &Guard<'_>, own: &OwnEntries) -> Result<(), WriteError> {
        let count = own.agents.len();
        if count > file::MAX_ENTRIES {
            let most = file::MAX_ENTRIES;
            let why = format!("this process has {count} agents; at most {most} are allowed");
            return Err(WriteError::Full(why));
        }
        let bytes = file::write(&self.mts, own.agents.values());
        if bytes.len() > file::MAX_SIZE {
            let (len, most) = (bytes.len(), file::MAX_SIZE);
            let why = format!(
                "the entries of this process take {len} bytes, but at most {most} are allowed"
            );
            return Err(WriteError::Full(why));
        }
        guard.write(Name::Entries(guard.id()), &bytes)?;
        Ok(())
    }

    /// Leaves the directory. A repeated call does nothing.
    pub(super) fn close(&self) -> Result<(), HostError> {
        let host_dir = self.host_dir();
        let guard = host_dir.lock();
        let mut own = self.own.lock();
        if std::mem::replace(&mut own.closed, true) {
            return Ok(());
        }
        let agents = std::mem::take(&mut own.agents);
        self.tell(self.host_dir().id(), &agents, &Entries::new());
        guard?.leave()
    }
}

#[derive(Debug, thiserror::Error)]
enum ReadError {
    #[error(transparent)]
    Host(#[from] HostError),
    #[error(transparent)]
    File(#[from] FileError),
    #[error(transparent)]
    Remote(#[from] RemoteError),
}

#[derive(Debug, thiserror::Error)]
enum WriteError {
    #[error("{0}")]
    Full(String),
    #[error(transparent)]
    Host(#[from] HostError),
}

/// Removes the locations in shared memory, which belongs to one user.
fn without_memory(entries: Entries) -> Entries {
    let entries = entries.into_iter().map(|(name, entry)| {
        let mut entry = Arc::unwrap_or_clone(entry);
        entry.locations.retain(|it| it.kind() != Kind::Shm);
        (name, Arc::new(entry))
    });
    entries.collect()
}

impl From<WriteError> for RegisterError {
    fn from(error: WriteError) -> Self {
        match error {
            WriteError::Full(why) => Self::Full(why),
            WriteError::Host(error) => failed(error),
        }
    }
}

fn failed(error: HostError) -> RegisterError {
    RegisterError::Failed(Arc::new(error))
}
