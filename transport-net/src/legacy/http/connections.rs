//! The accepted connections of an endpoint: how many there are, and which one is evicted for
//! another.
//!
//! The module owns no sockets.

use std::collections::{BTreeMap, HashMap};
use std::net::IpAddr;
use std::sync::Arc;

use fipa_transport::quota_address;
use parking_lot::Mutex;
use tokio::task::AbortHandle;

/// The accepted connections. Clones share them.
#[derive(Debug, Clone, Default)]
pub(super) struct Connections(Arc<Mutex<State>>);

#[derive(Debug, Default)]
struct State {
    closed: bool,
    last_number: u64,
    /// Oldest first.
    entries: BTreeMap<u64, Entry>,
}

#[derive(Debug)]
struct Entry {
    home: IpAddr,
    /// Whether no byte of a request has arrived since the last answer.
    idle: bool,
    task: Option<AbortHandle>,
}

/// The slot of a connection. Dropping it frees the slot.
#[derive(Debug)]
pub(super) struct Slot {
    connections: Connections,
    pub(super) number: u64,
}

impl Connections {
    /// Admits a connection from this address, which may have `each` connections, all addresses
    /// together `all`. When a limit is reached, the oldest idle connection is evicted: of the
    /// address, or of the address with the most. Returns the task of the evicted connection, too.
    /// `None` if no connection is idle, or the endpoint is closed.
    pub(super) fn admit(
        &self,
        from: IpAddr,
        each: usize,
        all: usize,
    ) -> Option<(Slot, Option<AbortHandle>)> {
        let mut state = self.0.lock();
        if state.closed {
            return None;
        }
        let home = quota_address(from);
        let of_home = state.entries.values().filter(|it| it.home == home).count();
        let mut evicted = None;
        if of_home >= each.max(1) || state.entries.len() >= all.max(1) {
            let of = match of_home >= each.max(1) {
                true => home,
                false => state.largest()?,
            };
            let oldest = state.entries.iter();
            let mut oldest = oldest.filter(|(_, it)| it.home == of && it.idle && it.task.is_some());
            let oldest = oldest.next().map(|(number, _)| *number)?;
            evicted = state.entries.remove(&oldest).and_then(|it| it.task);
        }
        state.last_number += 1;
        let number = state.last_number;
        let entry = Entry {
            home,
            idle: true,
            task: None,
        };
        state.entries.insert(number, entry);
        drop(state);
        let slot = Slot {
            connections: self.clone(),
            number,
        };
        Some((slot, evicted))
    }

    /// Ends the tasks of all connections, and admits no more.
    pub(super) fn close(&self) {
        let mut state = self.0.lock();
        state.closed = true;
        let tasks: Vec<_> = state
            .entries
            .values_mut()
            .filter_map(|it| it.task.take())
            .collect();
        drop(state);
        for task in tasks {
            task.abort();
        }
    }
}

impl State {
    /// Returns the address that has the most connections with an idle one among them.
    fn largest(&self) -> Option<IpAddr> {
        let mut homes: HashMap<IpAddr, (bool, usize)> = HashMap::new();
        for entry in self.entries.values() {
            let (has_idle, count) = homes.entry(entry.home).or_default();
            *has_idle |= entry.idle && entry.task.is_some();
            *count += 1;
        }
        let homes = homes.into_iter().filter(|(_, (has_idle, _))| *has_idle);
        homes
            .max_by_key(|(_, (_, count))| *count)
            .map(|(home, _)| home)
    }
}

impl Slot {
    /// Sets the task of the connection. Returns whether the task may continue.
    pub(super) fn started(&self, task: AbortHandle) -> bool {
        let mut state = self.connections.0.lock();
        let is_open = !state.closed;
        match state.entries.get_mut(&self.number) {
            Some(entry) => {
                entry.task = Some(task);
                is_open
            }
            None => false,
        }
    }

    /// Sets whether no byte of a request has arrived.
    pub(super) fn set_idle(&self, idle: bool) {
        if let Some(entry) = self.connections.0.lock().entries.get_mut(&self.number) {
            entry.idle = idle;
        }
    }
}

impl Drop for Slot {
    fn drop(&mut self) {
        self.connections.0.lock().entries.remove(&self.number);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn address(last: u8) -> IpAddr {
        IpAddr::from([10, 0, 0, last])
    }

    fn task() -> AbortHandle {
        let runtime = tokio::runtime::Builder::new_current_thread().build();
        runtime.unwrap().spawn(async {}).abort_handle()
    }

    #[test]
    fn an_address_evicts_its_own_idle_connection_or_is_refused() {
        let connections = Connections::default();
        let admit = |last| connections.admit(address(last), 2, 3);
        let (first, _) = admit(1).unwrap();
        let (second, _) = admit(1).unwrap();
        // Their tasks do not run yet.
        assert!(admit(1).is_none());
        assert!(first.started(task()) && second.started(task()));
        first.set_idle(false);
        let (third, evicted) = admit(1).unwrap();
        assert!(evicted.is_some());
        assert!(!second.started(task()), "the idle one was evicted");
        third.started(task());
        third.set_idle(false);
        assert!(admit(1).is_none(), "no connection is idle");
        let (other, evicted) = admit(2).unwrap();
        assert!(evicted.is_none());
        // All slots are taken; no connection of the first address is idle.
        other.started(task());
        let (_new, evicted) = admit(3).unwrap();
        assert!(evicted.is_some() && !other.started(task()));
        drop(first);
        assert!(admit(1).is_some());
    }

    #[test]
    fn a_closed_endpoint_admits_no_connection() {
        let connections = Connections::default();
        let (slot, _) = connections.admit(address(1), 1, 1).unwrap();
        connections.close();
        assert!(!slot.started(task()));
        assert!(connections.admit(address(2), 1, 1).is_none());
    }
}
