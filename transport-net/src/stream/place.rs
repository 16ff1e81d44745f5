//! Memory of the sink's for content that is arriving.
//!
//! Whoever has introduced himself can announce a large letter and send it slowly. So what is taken
//! for announced content is bounded for the whole endpoint ([`Rooms`]); beyond that content goes to
//! memory that grows as it arrives.

use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use bytes::Bytes;
use fipa_transport::LoanedContent;

/// How many bytes are taken for content that has not arrived.
#[derive(Debug, Clone, Default)]
pub(crate) struct Rooms(Arc<AtomicUsize>);

/// Some of these bytes; given back when this is dropped.
#[derive(Debug)]
pub(crate) struct Room {
    rooms: Rooms,
    len: usize,
}

impl Rooms {
    /// Takes `len` bytes, unless more than `most` would be taken then.
    pub(crate) fn take(&self, len: usize, most: usize) -> Option<Room> {
        let more = |taken: usize| taken.checked_add(len).filter(|sum| *sum <= most);
        let order = Ordering::Relaxed;
        self.0.fetch_update(order, order, more).ok()?;
        Some(Room {
            rooms: self.clone(),
            len,
        })
    }
}

impl Drop for Room {
    fn drop(&mut self) {
        self.rooms.0.fetch_sub(self.len, Ordering::Relaxed);
    }
}

/// Where content is put while it arrives.
pub(crate) struct Place {
    memory: Box<dyn LoanedContent>,
    len: usize,
    /// Until the content is there.
    _room: Room,
}

impl Place {
    pub(crate) fn new(mut memory: Box<dyn LoanedContent>, room: Room) -> Self {
        Self {
            len: memory.content_mut().len(),
            memory,
            _room: room,
        }
    }

    pub(crate) fn len(&self) -> usize {
        self.len
    }

    /// What is to be filled behind the first `filled` bytes; none when nothing is.
    pub(crate) fn missing(&mut self, filled: usize) -> Option<&mut [u8]> {
        let missing = self.memory.content_mut().get_mut(filled..)?;
        (!missing.is_empty()).then_some(missing)
    }

    pub(crate) fn freeze(self) -> Bytes {
        self.memory.freeze()
    }
}

impl fmt::Debug for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Place").field("len", &self.len).finish()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_more_than_allowed_is_taken_and_all_of_it_given_back() {
        let rooms = Rooms::default();
        let first = rooms.take(60, 100).unwrap();
        assert!(rooms.take(41, 100).is_none());
        assert!(rooms.take(usize::MAX, usize::MAX).is_none());
        let second = rooms.take(40, 100);
        assert!(second.is_some());
        drop(first);
        assert!(rooms.take(60, 100).is_some());
    }
}
