//! The connections of an endpoint, and the order in which they act.

use std::collections::{BTreeSet, HashMap, HashSet, VecDeque};
use std::net::IpAddr;
use std::time::Instant;

use super::Path;

/// Upper bound of the numbers of connections. It leaves room in a ticket, which holds such a number and
/// that of a letter.
const MAX_CONNECTIONS: u32 = 1 << 24;

/// A connection that sends datagrams, has events and waits for a time.
pub(crate) trait Scheduled {
    /// The path to the peer, if the peer has answered.
    fn path(&self) -> Option<Path>;

    /// Whether there are events to deliver.
    fn has_events(&self) -> bool;

    /// Returns the time at which the connection must act.
    fn poll_timeout(&self) -> Option<Instant>;
}

/// The connections of an endpoint, by number.
///
/// Connections that have changed send in the order in which they changed, each as long as it has
/// datagrams. The same holds for their events.
#[derive(Debug)]
pub(crate) struct Connections<C> {
    slots: HashMap<u32, Slot<C>>,
    /// The connections that may have datagrams.
    ready: VecDeque<u32>,
    /// The connections that may have events.
    eventful: VecDeque<u32>,
    timers: BTreeSet<(Instant, u32)>,
    /// Removed connections.
    gone: Vec<u32>,
    last_number: u32,
}

#[derive(Debug)]
struct Slot<C> {
    connection: C,
    timer: Option<Instant>,
    is_ready: bool,
    is_eventful: bool,
}

impl<C: Scheduled> Connections<C> {
    pub(crate) fn new() -> Self {
        Self {
            slots: HashMap::new(),
            ready: VecDeque::new(),
            eventful: VecDeque::new(),
            timers: BTreeSet::new(),
            gone: Vec::new(),
            last_number: 0,
        }
    }

    pub(crate) fn len(&self) -> usize {
        self.slots.len()
    }

    pub(crate) fn get(&self, number: u32) -> Option<&C> {
        self.slots.get(&number).map(|slot| &slot.connection)
    }

    /// Returns a connection to change it. Afterwards, call [`touch`](Self::touch).
    pub(crate) fn get_mut(&mut self, number: u32) -> Option<&mut C> {
        let slot = self.slots.get_mut(&number)?;
        Some(&mut slot.connection)
    }

    pub(crate) fn iter(&self) -> impl Iterator<Item = (u32, &C)> {
        let slots = self.slots.iter();
        slots.map(|(number, slot)| (*number, &slot.connection))
    }

    pub(crate) fn numbers(&self) -> Vec<u32> {
        self.slots.keys().copied().collect()
    }

    /// Returns the connections that are bound to these addresses, with the address of each. `local`
    /// returns the address of a socket that belongs to one connection.
    pub(crate) fn bound_to(
        &self,
        addresses: &HashSet<IpAddr>,
        local: impl Fn(u32) -> Option<IpAddr>,
    ) -> Vec<(u32, IpAddr)> {
        let bound = self.iter().filter_map(|(number, connection)| {
            let path = connection.path()?;
            let ip = path.local.or_else(|| local(path.socket))?;
            addresses.contains(&ip).then_some((number, ip))
        });
        bound.collect()
    }

    /// Inserts a connection and returns its number. The limits of an endpoint are far below the number
    /// of numbers.
    pub(crate) fn insert(&mut self, connection: C) -> u32 {
        loop {
            self.last_number = (self.last_number + 1) % MAX_CONNECTIONS;
            if !self.slots.contains_key(&self.last_number) {
                break;
            }
        }
        let slot = Slot {
            connection,
            timer: None,
            is_ready: false,
            is_eventful: false,
        };
        self.slots.insert(self.last_number, slot);
        self.last_number
    }

    pub(crate) fn remove(&mut self, number: u32) -> Option<C> {
        let slot = self.slots.remove(&number)?;
        if let Some(timer) = slot.timer {
            self.timers.remove(&(timer, number));
        }
        self.ready.retain(|other| *other != number);
        self.eventful.retain(|other| *other != number);
        self.gone.push(number);
        Some(slot.connection)
    }

    /// Returns the next removed connection.
    pub(crate) fn poll_gone(&mut self) -> Option<u32> {
        self.gone.pop()
    }

    /// Schedules a connection that has changed.
    pub(crate) fn touch(&mut self, number: u32) {
        if let Some(slot) = self.slots.get_mut(&number)
            && !std::mem::replace(&mut slot.is_ready, true)
        {
            self.ready.push_back(number);
        }
        self.reschedule(number);
    }

    /// Returns the first result of `poll` among the connections that may have datagrams.
    pub(crate) fn poll_ready<T>(
        &mut self,
        mut poll: impl FnMut(&mut C) -> Option<T>,
    ) -> Option<(u32, T)> {
        while let Some(number) = self.ready.front().copied() {
            if let Some(slot) = self.slots.get_mut(&number) {
                if let Some(next) = poll(&mut slot.connection) {
                    return Some((number, next));
                }
                slot.is_ready = false;
            }
            self.ready.pop_front();
            // Sending may have concluded letters, too.
            self.reschedule(number);
        }
        None
    }

    /// Returns the first result of `poll` among the connections that may have events.
    pub(crate) fn poll_eventful<T>(
        &mut self,
        mut poll: impl FnMut(u32, &mut C) -> Option<T>,
    ) -> Option<T> {
        while let Some(number) = self.eventful.front().copied() {
            if let Some(slot) = self.slots.get_mut(&number) {
                if let Some(event) = poll(number, &mut slot.connection) {
                    return Some(event);
                }
                slot.is_eventful = false;
            }
            self.eventful.pop_front();
        }
        None
    }

    /// Whether there are events to deliver.
    pub(crate) fn has_events(&self) -> bool {
        !self.eventful.is_empty()
    }

    /// Returns the time at which the first connection must act.
    pub(crate) fn poll_timeout(&self) -> Option<Instant> {
        self.timers.first().map(|(due, _)| *due)
    }

    /// Returns the connections that must act, each once. A timer stays due until the datagrams of its
    /// connection have been polled.
    pub(crate) fn due(&self, now: Instant) -> Vec<u32> {
        let due = self.timers.iter().take_while(|(due, _)| *due <= now);
        due.map(|(_, number)| *number).collect()
    }

    fn reschedule(&mut self, number: u32) {
        let Some(slot) = self.slots.get_mut(&number) else {
            return;
        };
        let due = slot.connection.poll_timeout();
        if due != slot.timer {
            if let Some(before) = slot.timer {
                self.timers.remove(&(before, number));
            }
            if let Some(due) = due {
                self.timers.insert((due, number));
            }
            slot.timer = due;
        }
        if slot.connection.has_events() && !std::mem::replace(&mut slot.is_eventful, true) {
            self.eventful.push_back(number);
        }
    }
}
