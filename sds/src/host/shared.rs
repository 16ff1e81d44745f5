//! State of a host's directory: the entries of other processes, and those that this process writes.

use std::collections::HashMap;
use std::sync::Arc;

use arc_swap::ArcSwap;
use fipa_acl::ErrorChain;
use fipa_transport::{Incarnation, log_limit};
use parking_lot::Mutex;
use tokio::sync::{Notify, watch};

use super::file::{self, Entries, FileError};
use super::host_dir::{Guard, HostDir, Id, MAX_ENTRIES_FILE, Name, Version};
use super::{Cancellation, HostError, SocketId};
use crate::table::Table;
use crate::{DeregisterError, Entry, Mts, Reach, RegisterError, Source};

/// The state behind a [`HostDirectory`](super::HostDirectory), shared with its task.
///
/// Locks are taken in this order: the domain's, `own`, `others`, the table's.
#[derive(Debug)]
pub(super) struct Shared {
    /// Replaced when the directory was removed and joined again.
    host_dir: ArcSwap<HostDir>,
    pub(super) table: Table<Id>,
    mts: Mts,
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
    /// Agents of other hosts that this gateway publishes. They are not in its own table, because it
    /// has them from other back ends.
    remote: Vec<Arc<Entry>>,
    /// Lost agents of other hosts, which this gateway publishes.
    lost: Vec<Arc<Entry>>,
}

/// The entries of the other processes.
#[derive(Debug, Default)]
struct OtherProcesses {
    generation: u64,
    processes: HashMap<Id, Process>,
}

impl OtherProcesses {
    /// Whether another process has registered an agent of this name in a file that exists now.
    fn has_registered(&self, name: &str) -> bool {
        self.processes.values().any(|process| {
            let entry = process.entries.get(name);
            process.version.is_some() && entry.is_some_and(|entry| entry.reach == Reach::Local)
        })
    }
}

#[derive(Debug, Default)]
struct Process {
    version: Option<Version>,
    entries: Entries,
    lost: Vec<Arc<Entry>>,
}

impl Shared {
    pub(super) fn new(host_dir: HostDir, mts: Mts) -> Self {
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
        let nothing = own.agents.is_empty() && own.remote.is_empty() && own.lost.is_empty();
        Ok(host_dir.is_there()? && (nothing || host_dir.version(host_dir.id())?.is_some()))
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
        let host_dir = Arc::new(HostDir::join(
            before.path(),
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

    /// Reads the changes of other processes; takes one system call when there are none.
    pub(super) fn refresh(&self) -> Result<(), HostError> {
        let generation = self.host_dir().generation()?;
        let mut others = self.others.lock();
        if others.generation == generation {
            return Ok(());
        }
        self.scan(&mut others)?;
        // Read before the files, so that a change in between causes another read.
        others.generation = generation;
        Ok(())
    }

    /// Reads all files again and checks which processes are running, regardless of the generation.
    pub(super) fn rescan(&self) -> Result<(), HostError> {
        let mut others = self.others.lock();
        let known: Vec<Id> = others.processes.keys().copied().collect();
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
            if let Name::Entries(id) = name
                && id != self.host_dir().id()
            {
                self.read(others, id)?;
            }
        }
        Ok(())
    }

    /// Reads the process's entries file if it has changed.
    pub(super) fn process_wrote(&self, id: Id) -> Result<(), HostError> {
        if id == self.host_dir().id() {
            return Ok(());
        }
        self.read(&mut self.others.lock(), id)
    }

    fn read(&self, others: &mut OtherProcesses, id: Id) -> Result<(), HostError> {
        let known = others.processes.get(&id);
        let version = self.host_dir().version(id)?;
        if known.is_some_and(|process| process.version == version) {
            return Ok(());
        }
        // The files of an unknown process may be leftovers of a dead one.
        if known.is_none() && !self.host_dir().is_running(id)? {
            return Ok(());
        }
        let read = self.read_file(id).unwrap_or_else(|error| {
            // Treated as empty; the process's next file may be valid.
            let path = self.host_dir().path().join(Name::Entries(id).to_string());
            log_limit::error!(path = %path.display(), error = %ErrorChain(&error), "entries file ignored");
            file::Read::default()
        });
        let process = others.processes.entry(id).or_default();
        // Taken before reading, so that a replacement in between causes another read.
        process.version = version;
        let before = std::mem::replace(&mut process.entries, read.entries);
        let differs = process.lost != read.lost;
        process.lost = read.lost;
        self.tell(id, &before, &process.entries);
        if differs {
            self.show_lost(others);
        }
        Ok(())
    }

    fn read_file(&self, id: Id) -> Result<file::Read, ReadError> {
        match self.host_dir().read_entries(id)? {
            Some(bytes) => Ok(file::read(&bytes)?),
            None => Ok(file::Read::default()),
        }
    }

    /// Shows the lost agents that the gateways among the other processes publish.
    fn show_lost(&self, others: &OtherProcesses) {
        let processes = others.processes.values();
        let lost = processes.flat_map(|process| &process.lost);
        self.table.set_lost(lost.cloned());
    }

    fn tell(&self, id: Id, before: &Entries, after: &Entries) {
        let left = before.keys().filter(|name| !after.contains_key(*name));
        let left = left.map(|name| (id, name.clone(), None));
        let changed = after
            .iter()
            .filter(|(name, entry)| before.get(*name) != Some(entry));
        let changed = changed.map(|(name, entry)| (id, name.clone(), Some(Arc::clone(entry))));
        self.table.update(left.chain(changed));
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
            if !process.lost.is_empty() {
                self.show_lost(others);
            }
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
            // A contact is only the sender of a letter, which may have left since. Claims of
            // directories precede it, so no other process holds the name.
            if holder.source == Source::Contact {
                break;
            }
            if ours || self.host_dir().is_running(id).map_err(failed)? {
                return Err(RegisterError::AlreadyRegistered { holder });
            }
            self.forget(&mut self.others.lock(), id);
            guard.remove_files(id).map_err(failed)?;
        }
        Ok(())
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
        remote: Vec<Arc<Entry>>,
        lost: Vec<Arc<Entry>>,
    ) -> Result<(), HostError> {
        self.change(|guard, own| {
            if own.closed {
                return Err(HostError::Closed);
            }
            if own.remote == remote && own.lost == lost {
                return Ok(());
            }
            let remote = std::mem::replace(&mut own.remote, remote);
            let lost = std::mem::replace(&mut own.lost, lost);
            self.write_now_or_later(guard, own).map_err(|error| {
                (own.remote, own.lost) = (remote, lost);
                match error {
                    WriteError::Full(why) => HostError::Full(why),
                    WriteError::Host(error) => error,
                }
            })
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
        let written = guard.map_err(WriteError::from);
        let written = written.and_then(|guard| self.write(&guard, own));
        match written {
            Err(WriteError::Host(_)) if matches!(self.host_dir().is_there(), Ok(false)) => Ok(()),
            written => written,
        }
    }

    fn write(&self, guard: &Guard<'_>, own: &OwnEntries) -> Result<(), WriteError> {
        // A name that is registered here is not also published as a remote agent.
        let remote = own.remote.iter();
        let remote = remote.filter(|entry| !own.agents.contains_key(&entry.name));
        let count = own.agents.len() + own.remote.len() + own.lost.len();
        if count > file::MAX_ENTRIES {
            let most = file::MAX_ENTRIES;
            let why = format!("this process has {count} entries; at most {most} are allowed");
            return Err(WriteError::Full(why));
        }
        let bytes = file::write(&self.mts, own.agents.values().chain(remote), &own.lost);
        if bytes.len() > MAX_ENTRIES_FILE {
            let len = bytes.len();
            let why = format!(
                "the entries of this process take {len} bytes, but at most {MAX_ENTRIES_FILE} are allowed"
            );
            return Err(WriteError::Full(why));
        }
        guard.write_entries(&bytes)?;
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
}

#[derive(Debug, thiserror::Error)]
enum WriteError {
    #[error("{0}")]
    Full(String),
    #[error(transparent)]
    Host(#[from] HostError),
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
