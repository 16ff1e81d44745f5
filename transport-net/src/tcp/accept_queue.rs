//! Accepted connections whose letter has not been passed on yet.
//!
//! A legacy peer opens one connection per letter and closes it after the letter, so the letters of
//! one address must be passed on in the order in which their connections were accepted. The queue
//! of an address grants two permissions in that order: to read (at most
//! [`NetLimits::max_reads_per_address`] connections at once; the others wait in the kernel's buffers),
//! and to pass on a letter that has been read.
//!
//! A connection without progress for [`TURN`] loses its turn: the letters behind it no longer wait
//! for it. The first byte distinguishes legacy letters from frames and TLS; connections with those
//! leave the queue at once.
//!
//! The queue owns no sockets and reads no clock. The tasks in [`accept`](super::accept) do the I/O.

use std::collections::{BTreeMap, HashMap};
use std::mem::MaybeUninit;
use std::net::IpAddr;
use std::sync::{Arc, Weak};
use std::time::Duration;

use fipa_transport::quota_address;
use parking_lot::Mutex;
use socket2::SockRef;
use tokio::net::TcpStream;
use tokio::sync::Notify;
use tokio::task::AbortHandle;

use super::endpoint::TcpEndpoint;
use crate::stream::config::NetLimits;
use crate::stream::counters::count;

/// Time without a byte after which a connection loses its turn.
pub(crate) const TURN: Duration = Duration::from_millis(250);

/// The queues of all addresses.
#[derive(Debug, Default)]
pub(crate) struct AcceptQueue(Mutex<State>);

#[derive(Debug, Default)]
struct State {
    closed: bool,
    last_ticket: u64,
    by_address: HashMap<IpAddr, Peer>,
    /// Number of connections that may be read.
    reading: usize,
    /// Number of connections that may not be read yet.
    waiting: usize,
    /// Number of connections that have left the queues so far.
    departures: u64,
}

/// The connections of one address.
#[derive(Debug, Default)]
struct Peer {
    /// In the order of acceptance.
    turns: BTreeMap<u64, Entry>,
    /// Number of connections that may be read, with or without a turn.
    reading: usize,
}

#[derive(Debug)]
struct Entry {
    phase: Phase,
    /// Wakes the connection's task when one of the permissions may have been granted.
    wake: Arc<Notify>,
    /// The connection's task, once it runs.
    task: Option<AbortHandle>,
    /// The socket, until its first byte has been seen.
    silent: Option<Weak<TcpStream>>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phase {
    /// Waits for the permission to read.
    Waiting,
    /// May be read; the letters behind it wait for it.
    Reading,
    /// May be read, and has lost its turn.
    Stalled,
}

/// The reason for which a connection is not admitted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Full {
    /// Too many connections of its address wait.
    Address,
    /// Too many connections of all addresses wait.
    All,
    /// The endpoint has been closed.
    Closed,
}

/// Tasks to end because their connections were evicted.
type Evicted = Vec<AbortHandle>;

impl State {
    /// Appends a connection to the queue of its address. When the queue is full, the oldest
    /// connection without a byte is evicted, because no letter is lost with it.
    fn admit(
        &mut self,
        limits: &NetLimits,
        home: IpAddr,
        entry: Entry,
        is_silent: impl Fn(&Entry) -> bool,
    ) -> Result<(u64, Evicted), Full> {
        if self.closed {
            return Err(Full::Closed);
        }
        let of_home = self.by_address.get(&home).map_or(0, Peer::waiting);
        let full = if of_home >= limits.max_unread_per_address.max(1) {
            Some(Full::Address)
        } else if self.waiting >= limits.max_unread.max(1) {
            Some(Full::All)
        } else {
            None
        };
        let mut evicted = Evicted::new();
        if let Some(full) = full {
            let from = match full {
                Full::All => self.most_waiting().unwrap_or(home),
                _ => home,
            };
            let ticket = self.silent(from, is_silent).ok_or(full)?;
            evicted.extend(self.remove(limits, from, ticket).and_then(|out| out.task));
        }
        self.last_ticket += 1;
        let ticket = self.last_ticket;
        let peer = self.by_address.entry(home).or_default();
        peer.turns.insert(ticket, entry);
        self.waiting += 1;
        self.grant(limits, home);
        Ok((ticket, evicted))
    }

    /// Returns the address with the most waiting connections.
    fn most_waiting(&self) -> Option<IpAddr> {
        let peers = self.by_address.iter();
        let most = peers.max_by_key(|(_, peer)| peer.waiting());
        most.map(|(home, _)| *home)
    }

    /// Returns the oldest connection of an address that has not sent a byte.
    fn silent(&self, home: IpAddr, is_silent: impl Fn(&Entry) -> bool) -> Option<u64> {
        let mut turns = self.by_address.get(&home)?.turns.iter();
        let oldest = turns.find(|(_, entry)| entry.task.is_some() && is_silent(entry));
        oldest.map(|(ticket, _)| *ticket)
    }

    /// Removes a connection, and grants its permissions to others.
    fn remove(&mut self, limits: &NetLimits, home: IpAddr, ticket: u64) -> Option<Entry> {
        let peer = self.by_address.get_mut(&home)?;
        let entry = peer.turns.remove(&ticket)?;
        self.departures = self.departures.wrapping_add(1);
        match entry.phase {
            Phase::Waiting => self.waiting -= 1,
            Phase::Reading | Phase::Stalled => {
                peer.reading -= 1;
                self.reading -= 1;
            }
        }
        peer.wake_first();
        if peer.turns.is_empty() {
            self.by_address.remove(&home);
        }
        self.grant(limits, home);
        if self.reading < limits.max_strangers {
            self.grant_others(limits);
        }
        Some(entry)
    }

    /// Lets connections of an address be read, in the order of acceptance, as far as there is room.
    fn grant(&mut self, limits: &NetLimits, home: IpAddr) {
        while self.grant_one(limits, home) {}
    }

    fn grant_one(&mut self, limits: &NetLimits, home: IpAddr) -> bool {
        let Some(peer) = self.by_address.get_mut(&home) else {
            return false;
        };
        // One connection of each address may always be read, so that no address blocks another.
        let has_room =
            peer.reading < limits.max_reads_per_address && self.reading < limits.max_strangers;
        let has_room = has_room || peer.reading == 0;
        let mut entries = peer.turns.values_mut();
        let next = entries.find(|entry| entry.phase == Phase::Waiting);
        match next {
            Some(entry) if has_room => {
                entry.phase = Phase::Reading;
                entry.wake.notify_one();
                peer.reading += 1;
                self.reading += 1;
                self.waiting -= 1;
                true
            }
            _ => false,
        }
    }

    /// Lets connections of all addresses be read, first those of the address with the fewest.
    fn grant_others(&mut self, limits: &NetLimits) {
        while self.reading < limits.max_strangers {
            let peers = self.by_address.iter();
            let waits = peers.filter(|(_, peer)| {
                peer.waiting() > 0 && peer.reading < limits.max_reads_per_address
            });
            let fewest = waits.min_by_key(|(_, peer)| peer.reading);
            let Some(home) = fewest.map(|(home, _)| *home) else {
                return;
            };
            self.grant_one(limits, home);
        }
    }

    /// Takes the turn from a connection that is read and makes no progress. When all readable
    /// connections of the address are stalled and others wait, the older half is evicted.
    fn stall(&mut self, limits: &NetLimits, home: IpAddr, ticket: u64) -> Evicted {
        let mut evicted = Evicted::new();
        let Some(peer) = self.by_address.get_mut(&home) else {
            return evicted;
        };
        match peer.turns.get_mut(&ticket) {
            Some(entry) if entry.phase == Phase::Reading => entry.phase = Phase::Stalled,
            _ => return evicted,
        }
        peer.wake_first();
        let all_stalled = peer.reading >= limits.max_reads_per_address
            && peer
                .turns
                .values()
                .all(|entry| entry.phase != Phase::Reading);
        if all_stalled && peer.waiting() > 0 {
            let stalled = peer.turns.iter();
            let stalled = stalled.filter(|(_, entry)| entry.phase == Phase::Stalled);
            let half = peer.reading.div_ceil(2);
            let oldest: Vec<u64> = stalled.take(half).map(|(ticket, _)| *ticket).collect();
            for ticket in oldest {
                evicted.extend(self.remove(limits, home, ticket).and_then(|out| out.task));
            }
        }
        evicted
    }

    /// Whether no connection that was accepted before this one has a turn.
    fn is_first(&self, home: IpAddr, ticket: u64) -> bool {
        let Some(peer) = self.by_address.get(&home) else {
            return true;
        };
        match peer.turns.get(&ticket) {
            Some(entry) if entry.phase == Phase::Stalled => true,
            _ => peer.first().is_none_or(|first| first == ticket),
        }
    }
}

impl Peer {
    fn waiting(&self) -> usize {
        self.turns.len() - self.reading
    }

    /// Returns the connection that has the turn.
    fn first(&self) -> Option<u64> {
        let mut turns = self.turns.iter();
        let first = turns.find(|(_, entry)| entry.phase != Phase::Stalled);
        first.map(|(ticket, _)| *ticket)
    }

    fn wake_first(&self) {
        if let Some(entry) = self.first().and_then(|first| self.turns.get(&first)) {
            entry.wake.notify_one();
        }
    }
}

impl Entry {
    /// Whether the kernel has no byte of this connection.
    fn is_silent(&self) -> bool {
        let Some(socket) = self.silent.as_ref().and_then(Weak::upgrade) else {
            return false;
        };
        is_silent(&socket)
    }
}

/// Whether the kernel has neither a byte nor the end of this connection. The socket itself is
/// queried, because the runtime learns of bytes later.
pub(crate) fn is_silent(socket: &TcpStream) -> bool {
    let mut byte = [MaybeUninit::uninit()];
    match SockRef::from(socket).peek(&mut byte) {
        Ok(_) => false,
        Err(error) => error.kind() == std::io::ErrorKind::WouldBlock,
    }
}

impl AcceptQueue {
    /// Appends a connection from this address to its queue.
    ///
    /// # Errors
    /// When the queue is full and no connection can be evicted.
    pub(crate) fn admit(
        &self,
        endpoint: &Arc<TcpEndpoint>,
        from: IpAddr,
        socket: &Arc<TcpStream>,
    ) -> Result<QueueTurn, Full> {
        let home = quota_address(from);
        let wake = Arc::new(Notify::new());
        let entry = Entry {
            phase: Phase::Waiting,
            wake: wake.clone(),
            task: None,
            silent: Some(Arc::downgrade(socket)),
        };
        let limits = endpoint.limits();
        let mut state = self.0.lock();
        let (ticket, evicted) = state.admit(limits, home, entry, Entry::is_silent)?;
        drop(state);
        end(endpoint, evicted);
        Ok(QueueTurn {
            endpoint: endpoint.clone(),
            home,
            ticket,
            wake,
        })
    }

    /// Number of connections that wait for the permission to read, and of those that have left the
    /// queues so far.
    pub(crate) fn progress(&self) -> (usize, u64) {
        let state = self.0.lock();
        (state.waiting, state.departures)
    }

    /// Ends the tasks of all connections, and admits no more.
    pub(crate) fn close(&self) {
        let mut state = self.0.lock();
        state.closed = true;
        let entries = state
            .by_address
            .values()
            .flat_map(|peer| peer.turns.values());
        let tasks: Vec<_> = entries.filter_map(|entry| entry.task.clone()).collect();
        drop(state);
        for task in tasks {
            task.abort();
        }
    }
}

fn end(endpoint: &TcpEndpoint, evicted: Evicted) {
    for task in evicted {
        count(&endpoint.tally().refused_crowd);
        task.abort();
    }
}

/// The position of one connection in the queue of its address. Dropping it lets the next one
/// proceed.
#[derive(Debug)]
pub(crate) struct QueueTurn {
    endpoint: Arc<TcpEndpoint>,
    home: IpAddr,
    ticket: u64,
    wake: Arc<Notify>,
}

impl QueueTurn {
    /// Sets the task of this connection. Returns whether the task may continue.
    pub(crate) fn started(&self, task: AbortHandle) -> bool {
        self.with_entry(|entry| entry.task = Some(task)).is_some() && !self.state().closed
    }

    /// Notes that the first byte has been seen.
    pub(crate) fn has_bytes(&self) {
        self.with_entry(|entry| entry.silent = None);
    }

    /// Takes the turn from this connection: no byte came for [`TURN`].
    pub(crate) fn stalled(&self) {
        let limits = self.endpoint.limits();
        let evicted = self.state().stall(limits, self.home, self.ticket);
        end(&self.endpoint, evicted);
    }

    /// Waits for the permission to read this connection.
    pub(crate) async fn may_read(&self) {
        while self.with_entry(|entry| entry.phase) == Some(Phase::Waiting) {
            self.wake.notified().await;
        }
    }

    /// Waits until the letters of all connections before this one have been passed on.
    pub(crate) async fn is_first(&self) {
        loop {
            let is_first = self.state().is_first(self.home, self.ticket);
            if is_first {
                return;
            }
            self.wake.notified().await;
        }
    }

    fn state(&self) -> parking_lot::MutexGuard<'_, State> {
        self.endpoint.legacy.accept_queue.0.lock()
    }

    fn with_entry<T>(&self, change: impl FnOnce(&mut Entry) -> T) -> Option<T> {
        let mut state = self.state();
        let peer = state.by_address.get_mut(&self.home)?;
        peer.turns.get_mut(&self.ticket).map(change)
    }
}

impl Drop for QueueTurn {
    fn drop(&mut self) {
        let limits = self.endpoint.limits();
        self.state().remove(limits, self.home, self.ticket);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HERE: IpAddr = IpAddr::V4(std::net::Ipv4Addr::new(10, 0, 0, 1));

    fn limits() -> NetLimits {
        NetLimits {
            max_strangers: 4,
            max_reads_per_address: 2,
            max_unread_per_address: 5,
            max_unread: 8,
            ..NetLimits::default()
        }
    }

    fn address(last: u8) -> IpAddr {
        IpAddr::from([10, 0, 0, last])
    }

    fn entry() -> Entry {
        Entry {
            phase: Phase::Waiting,
            wake: Arc::default(),
            task: None,
            silent: None,
        }
    }

    fn admit(state: &mut State, home: IpAddr) -> Result<u64, Full> {
        let admitted = state.admit(&limits(), home, entry(), |_| false);
        admitted.map(|(ticket, _)| ticket)
    }

    fn may_read(state: &State, home: IpAddr) -> Vec<u64> {
        let turns = state
            .by_address
            .get(&home)
            .into_iter()
            .flat_map(|p| &p.turns);
        let reading = turns.filter(|(_, entry)| entry.phase != Phase::Waiting);
        reading.map(|(ticket, _)| *ticket).collect()
    }

    #[test]
    fn permissions_are_granted_in_the_order_of_acceptance() {
        let mut state = State::default();
        let tickets: Vec<u64> = (0..5).map(|_| admit(&mut state, HERE).unwrap()).collect();
        assert_eq!(may_read(&state, HERE), tickets[..2]);
        // The second letter is complete first, and waits for the first.
        assert!(!state.is_first(HERE, tickets[1]));
        assert!(state.is_first(HERE, tickets[0]));
        state.remove(&limits(), HERE, tickets[0]);
        assert!(state.is_first(HERE, tickets[1]));
        assert_eq!(may_read(&state, HERE), tickets[1..3]);
        for ticket in &tickets[1..] {
            state.remove(&limits(), HERE, *ticket);
        }
        assert!(state.by_address.is_empty());
        assert_eq!((state.reading, state.waiting), (0, 0));
    }

    #[test]
    fn a_connection_beyond_the_limits_is_not_admitted() {
        let mut state = State::default();
        for _ in 0..7 {
            admit(&mut state, HERE).unwrap();
        }
        assert_eq!(admit(&mut state, HERE), Err(Full::Address));
        for _ in 0..5 {
            admit(&mut state, address(2)).unwrap();
        }
        assert_eq!(admit(&mut state, address(2)), Err(Full::All));
        assert_eq!(may_read(&state, HERE).len(), 2);
    }

    #[test]
    fn a_full_queue_evicts_a_connection_without_a_byte() {
        let mut state = State::default();
        let silent = admit(&mut state, HERE).unwrap();
        for _ in 0..6 {
            admit(&mut state, HERE).unwrap();
        }
        let runtime = tokio::runtime::Builder::new_current_thread().build();
        let task = runtime.unwrap().spawn(async {}).abort_handle();
        let turns = &mut state.by_address.get_mut(&HERE).unwrap().turns;
        turns.get_mut(&silent).unwrap().task = Some(task);
        let admitted = state.admit(&limits(), HERE, entry(), |entry| entry.task.is_some());
        let (_, evicted) = admitted.unwrap();
        assert_eq!(evicted.len(), 1);
        assert!(!state.by_address[&HERE].turns.contains_key(&silent));
    }

    #[test]
    fn letters_do_not_wait_for_a_stalled_connection() {
        let mut state = State::default();
        let stalled = admit(&mut state, HERE).unwrap();
        let next = admit(&mut state, HERE).unwrap();
        assert!(!state.is_first(HERE, next));
        assert!(state.stall(&limits(), HERE, stalled).is_empty());
        assert!(state.is_first(HERE, next));
        // A stalled letter is passed on when it completes.
        assert!(state.is_first(HERE, stalled));
        // A stalled connection still counts as read.
        let third = admit(&mut state, HERE).unwrap();
        assert_eq!(may_read(&state, HERE), [stalled, next]);
        state.remove(&limits(), HERE, next);
        assert_eq!(may_read(&state, HERE), [stalled, third]);
    }

    #[test]
    fn stalled_connections_do_not_block_their_address() {
        let mut state = State::default();
        let tickets: Vec<u64> = (0..3).map(|_| admit(&mut state, HERE).unwrap()).collect();
        state.stall(&limits(), HERE, tickets[0]);
        assert_eq!(may_read(&state, HERE), tickets[..2]);
        // Without a task there is no task to abort; the entry is removed all the same.
        state.stall(&limits(), HERE, tickets[1]);
        assert_eq!(may_read(&state, HERE), tickets[1..]);
    }

    #[test]
    fn no_address_blocks_another() {
        let mut state = State::default();
        for last in 1..=2 {
            for _ in 0..3 {
                admit(&mut state, address(last)).unwrap();
            }
        }
        // All four slots are taken; one connection of a third address is still read at a time.
        let third = admit(&mut state, address(3)).unwrap();
        let waits = admit(&mut state, address(3)).unwrap();
        assert_eq!(may_read(&state, address(3)), [third]);
        assert_eq!(state.reading, 5);
        state.remove(&limits(), address(3), third);
        assert_eq!(may_read(&state, address(3)), [waits]);
        state.remove(&limits(), address(3), waits);
        // A released slot goes to a waiting connection.
        let first = may_read(&state, address(1))[0];
        state.remove(&limits(), address(1), first);
        assert_eq!(may_read(&state, address(1)).len(), 2);
    }

    #[test]
    fn a_closed_queue_admits_no_connection() {
        let mut state = State {
            closed: true,
            ..State::default()
        };
        assert_eq!(admit(&mut state, HERE), Err(Full::Closed));
    }
}
