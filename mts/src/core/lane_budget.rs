//! The bytes of the letters in all lanes, and the room that a gateway has for more.

use std::sync::Arc;

use super::CoreConfig;
use crate::Map;

/// The bytes of the letters in all lanes.
#[derive(Debug, Default)]
pub(crate) struct LaneBudget {
    /// Total.
    held: usize,
    /// At a gateway, the bytes for each receiver.
    held_for: Map<Arc<str>, usize>,
}

impl LaneBudget {
    /// The bytes of the letters in all lanes.
    pub(crate) fn held(&self) -> usize {
        self.held
    }

    /// Counts the bytes of a letter that came into a lane.
    pub(crate) fn hold(&mut self, receiver: &Arc<str>, len: usize, config: &CoreConfig) {
        self.held += len;
        if config.forwards {
            *self.held_for.entry(Arc::clone(receiver)).or_default() += len;
        }
    }

    /// Counts the bytes of a letter that left its lane.
    pub(crate) fn release(&mut self, receiver: &Arc<str>, len: usize) {
        self.held -= len;
        if let Some(held) = self.held_for.get_mut(receiver) {
            *held -= len;
            if *held == 0 {
                self.held_for.remove(receiver);
            }
        }
    }

    /// Whether a gateway has room for a letter of this many bytes for this receiver. One letter of
    /// any size is always accepted.
    ///
    /// A receiver that takes its letters slowly, or a peer that keeps letters in custody, does not
    /// use up the room of others: the letters for one receiver have at most half as many bytes as
    /// remain free. One letter for each receiver is accepted while there is room at all.
    pub(crate) fn has_room(&self, receiver: &str, len: usize, config: &CoreConfig) -> bool {
        let most = config.custody_bytes;
        let held = self.held.saturating_add(len);
        let own = self.held_for.get(receiver).copied().unwrap_or_default();
        let is_share = own == 0 || own.saturating_add(len) <= most.saturating_sub(held) / 2;
        self.held == 0 || (held <= most && is_share)
    }
}
