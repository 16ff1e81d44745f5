//! The agents that are asked for a sign of life before the first request.
//!
//! Ricart-Agrawala asks the members only. So an agent that starts waits until those that it has found have
//! answered, or for a limited time: most agents use no locks and never answer.

use std::collections::BTreeSet;

use crate::{LockPeer, Millis};

/// The agents whose answers the first request of an agent waits for.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Default)]
pub(crate) struct Greeted {
    peers: BTreeSet<LockPeer>,
    /// End of the wait.
    until: Option<Millis>,
    is_over: bool,
}

impl Greeted {
    /// Adds an agent. The wait ends `within` after the first one.
    pub(crate) fn expect(&mut self, now: Millis, within: Millis, peer: &LockPeer) {
        if !self.is_over {
            self.until.get_or_insert(now.saturating_add(within));
            self.peers.insert(peer.clone());
        }
    }

    /// Handles an agent that has answered or has left. Returns whether it ends the wait.
    pub(crate) fn no_longer_expect(&mut self, peer: &LockPeer) -> bool {
        self.peers.remove(peer) && self.peers.is_empty()
    }

    /// Handles the end of the time. Returns whether agents were still expected.
    pub(crate) fn handle_timeout(&mut self, now: Millis) -> bool {
        let is_over = self.until.is_some_and(|until| until <= now);
        is_over && self.end()
    }

    /// Ends the wait for good. Returns whether there was one.
    pub(crate) fn end(&mut self) -> bool {
        self.is_over = true;
        self.until = None;
        !std::mem::take(&mut self.peers).is_empty()
    }

    /// End of the wait, if there is one.
    pub(crate) fn poll_timeout(&self) -> Option<Millis> {
        self.until.filter(|_| !self.peers.is_empty())
    }

    #[cfg(test)]
    pub(crate) fn rebase(&mut self, by: Millis) {
        self.until = self.until.map(|until| until.saturating_sub(by));
    }
}
