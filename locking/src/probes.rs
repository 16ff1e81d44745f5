//! Probes: one per pair of agents that depend on each other, for all resources.
//!
//! Each message of a peer is a sign of life. A peer is probed after the interval without one.

use std::collections::BTreeMap;

use crate::{LockPeer, Millis, Options};

/// Number of probes without an answer after which a peer is lost.
const ATTEMPTS: u8 = 2;

#[derive(Debug, Clone, PartialEq, Eq, Hash, Default)]
pub(crate) struct Probes {
    peers: BTreeMap<LockPeer, Probed>,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Probed {
    /// Number of resources whose state depends on the peer.
    dependents: usize,
    next: Millis,
    /// Probes since the last sign of life.
    sent: u8,
}

/// Result of a timeout.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum ProbeStep {
    Send(LockPeer),
    Lost(LockPeer),
}

impl Probes {
    pub(crate) fn depend(&mut self, now: Millis, options: &Options, peer: &LockPeer) {
        let probed = self.peers.entry(peer.clone()).or_insert(Probed {
            dependents: 0,
            next: now.saturating_add(options.probe_interval),
            sent: 0,
        });
        probed.dependents += 1;
    }

    pub(crate) fn no_longer_depend(&mut self, peer: &LockPeer) {
        if let Some(probed) = self.peers.get_mut(peer) {
            probed.dependents = probed.dependents.saturating_sub(1);
            if probed.dependents == 0 {
                self.peers.remove(peer);
            }
        }
    }

    pub(crate) fn sign_of_life(&mut self, now: Millis, options: &Options, peer: &LockPeer) {
        if let Some(probed) = self.peers.get_mut(peer) {
            probed.sent = 0;
            probed.next = now.saturating_add(options.probe_interval);
        }
    }

    /// Whether the peer is lost for lack of answers.
    pub(crate) fn handle_timeout(&mut self, now: Millis, options: &Options) -> Vec<ProbeStep> {
        let mut steps = Vec::new();
        for (peer, probed) in &mut self.peers {
            if probed.next > now {
                continue;
            }
            if probed.sent == ATTEMPTS {
                // The peer is probed again after the interval, while resources depend on it.
                probed.sent = 0;
                probed.next = now.saturating_add(options.probe_interval);
                steps.push(ProbeStep::Lost(peer.clone()));
                continue;
            }
            probed.sent += 1;
            let wait = (options.probe_timeout / Millis::from(ATTEMPTS)).max(1);
            probed.next = now.saturating_add(wait);
            steps.push(ProbeStep::Send(peer.clone()));
        }
        steps
    }

    pub(crate) fn poll_timeout(&self) -> Option<Millis> {
        self.peers.values().map(|probed| probed.next).min()
    }

    #[cfg(test)]
    pub(crate) fn rebase(&mut self, by: Millis) {
        for probed in self.peers.values_mut() {
            probed.next = probed.next.saturating_sub(by);
        }
    }
}
