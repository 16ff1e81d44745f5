//! The timer of each resource, and the agents whose loss changes its state.

use std::collections::BTreeSet;

use super::request::Phase;
use super::{Actions, Locks};
use crate::{LockPeer, Millis, MutualExclusion, Resource};

impl<A: MutualExclusion> Locks<A> {
    pub(super) fn time_out_resource(
        &mut self,
        now: Millis,
        resource: &Resource,
        out: &mut Actions,
    ) {
        let Some(entry) = self.resources.get(resource) else {
            return;
        };
        let current = entry.current.as_ref().map(|current| current.claim);
        let waiting = entry.waiting.iter().copied().chain(current);
        let over: Vec<_> = waiting
            .filter(|claim| {
                self.claims.get(claim).is_some_and(|claim| {
                    claim.wanted() == Some(resource)
                        && claim.deadline.is_some_and(|deadline| deadline <= now)
                })
            })
            .collect();
        for claim in over {
            self.time_out(now, claim, out);
        }
        self.end_of_claim(now, resource, out);
        self.at_owner(resource, out, |core, steps| core.handle_timeout(now, steps));
        self.update_gate(now, resource, out);
        self.at_algorithm(now, resource, out, |algorithm, context, steps| {
            algorithm.handle_timeout(context, steps);
        });
        self.time_out_current(now, resource, out);
    }

    /// Updates the timer and the dependencies of a resource.
    pub(super) fn update_entry(&mut self, now: Millis, resource: &Resource) {
        let due = self.due(resource);
        let dependencies = self.dependencies(now, resource);
        let Some(entry) = self.resources.get_mut(resource) else {
            return;
        };
        if entry.due != due {
            if let Some(old) = entry.due {
                self.timers.remove(&(old, resource.clone()));
            }
            entry.due = due;
            self.timers.extend(due.map(|due| (due, resource.clone())));
        }
        let before = std::mem::replace(&mut entry.dependencies, dependencies);
        for peer in entry.dependencies.difference(&before) {
            self.probes.depend(now, &self.options, peer);
        }
        for peer in before.difference(&entry.dependencies) {
            self.probes.no_longer_depend(peer);
        }
    }

    fn due(&self, resource: &Resource) -> Option<Millis> {
        let entry = self.resources.get(resource)?;
        let owned = entry.owned.as_ref();
        let current = entry.current.as_ref();
        let of_current = current.and_then(|current| match &current.phase {
            Phase::Discovering { until, next } => Some(*until.min(next)),
            Phase::Requesting { next, .. } => entry.kind.is_extended().then_some(*next),
            Phase::Entered { holder, .. } => holder.poll_timeout(),
        });
        let claims = entry
            .waiting
            .iter()
            .chain(current.map(|current| &current.claim));
        let deadlines = claims.filter_map(|claim| {
            let claim = self.claims.get(claim)?;
            claim.deadline.filter(|_| claim.wanted() == Some(resource))
        });
        deadlines
            .chain(of_current)
            .chain(owned.and_then(|owned| owned.claim_until))
            .chain(owned.and_then(|owned| owned.core.poll_timeout()))
            .chain(entry.algorithm.poll_timeout())
            .min()
    }

    /// Agents whose loss changes the state of a resource here.
    fn dependencies(&self, now: Millis, resource: &Resource) -> BTreeSet<LockPeer> {
        let Some(entry) = self.resources.get(resource) else {
            return BTreeSet::new();
        };
        let mut peers = entry.algorithm.awaited();
        if let Some(owned) = &entry.owned {
            peers.extend(owned.core.waiters().cloned());
            peers.extend(owned.core.live(now).map(|grant| grant.holder.clone()));
        }
        if let Some(current) = &entry.current
            && entry.kind.is_extended()
        {
            match &current.phase {
                Phase::Discovering { .. } => {}
                Phase::Requesting { .. } => peers.extend(entry.owner.clone()),
                // The answers to renewals are signs of life.
                Phase::Entered { owner, holder } => {
                    if holder.is_unfenced() || !holder.is_held(now) {
                        peers.insert(owner.clone());
                    }
                }
            }
        }
        peers.remove(&self.me);
        peers
    }
}
