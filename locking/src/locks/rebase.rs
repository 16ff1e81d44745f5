//! For the model: moves times back.

use super::Locks;
use super::request::{Current, Phase};
use crate::{LockPeer, Millis, MutualExclusion};

impl<A: MutualExclusion> Locks<A> {
    #[cfg(test)]
    pub(super) fn probed(&mut self, now: Millis, from: &LockPeer) {
        for entry in self.resources.values_mut() {
            if let Some(Current {
                phase: Phase::Entered { owner, holder },
                ..
            }) = &mut entry.current
                && owner == from
            {
                holder.probed(now);
            }
        }
    }

    /// Moves all times back, so that equal situations at different times are equal states.
    #[cfg(test)]
    pub(crate) fn rebase(&mut self, by: Millis) {
        let back = |time: &mut Millis| *time = time.saturating_sub(by);
        // States that differ in names of conversations alone are equal.
        self.next_side_conversation = 0;
        self.probes.rebase(by);
        self.greeted.rebase(by);
        for claim in self.claims.values_mut() {
            claim.deadline.iter_mut().for_each(back);
        }
        self.timers = std::mem::take(&mut self.timers)
            .into_iter()
            .map(|(due, resource)| (due.saturating_sub(by), resource))
            .collect();
        for entry in self.resources.values_mut() {
            entry.due.iter_mut().for_each(back);
            entry.algorithm.rebase(by);
            if let Some(owned) = &mut entry.owned {
                owned.core.rebase(by);
                owned.claim_until.iter_mut().for_each(back);
            }
            match entry.current.as_mut().map(|current| &mut current.phase) {
                Some(Phase::Discovering { until, next }) => {
                    back(until);
                    back(next);
                }
                Some(Phase::Requesting { next, .. }) => back(next),
                Some(Phase::Entered { holder, .. }) => holder.rebase(by),
                None => {}
            }
        }
    }
}
