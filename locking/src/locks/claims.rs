//! Claims: locks of one or several resources that this agent requests or holds.

use super::claim::{Claim, ClaimId};
use super::event::{Action, Event, Failure};
use super::request::{Current, Phase};
use super::{Actions, Locks};
use crate::holder::Holder;
use crate::{Fence, Millis, MutualExclusion, OwnerGate, Resource};

impl<A: MutualExclusion> Locks<A> {
    /// Requests a resource. Fails after `within`, if it is given.
    pub fn lock(
        &mut self,
        now: Millis,
        resource: &Resource,
        within: Option<Millis>,
        out: &mut Actions,
    ) -> ClaimId {
        self.lock_all(now, std::slice::from_ref(resource), within, out)
    }

    /// Requests a resource, and withdraws the request after one round of messages
    /// ([`Options::retry`](crate::Options::retry)), or at once if the resource is in use here.
    pub fn try_lock(&mut self, now: Millis, resource: &Resource, out: &mut Actions) -> ClaimId {
        let busy = self.resources.get(resource).is_some_and(|entry| {
            entry.current.is_some() || !entry.waiting.is_empty() || entry.gate == OwnerGate::Closed
        });
        let greeting = self.greeted.poll_timeout().unwrap_or(now);
        let round = greeting
            .saturating_sub(now)
            .saturating_add(self.options.retry);
        let within = if busy { 0 } else { round };
        let claim = self.claim(now, std::slice::from_ref(resource), Some(within), out);
        if busy {
            // Before a message is sent.
            self.time_out(now, claim, out);
        }
        self.settle(now, out);
        claim
    }

    /// Requests several resources, and acquires all or none. They are acquired in the order of their
    /// names, so that claims of several agents do not wait for each other. An empty list is acquired
    /// at once.
    pub fn lock_all(
        &mut self,
        now: Millis,
        resources: &[Resource],
        within: Option<Millis>,
        out: &mut Actions,
    ) -> ClaimId {
        let id = self.claim(now, resources, within, out);
        self.settle(now, out);
        id
    }

    /// Adds a claim to those that wait for its first resource.
    fn claim(
        &mut self,
        now: Millis,
        resources: &[Resource],
        within: Option<Millis>,
        out: &mut Actions,
    ) -> ClaimId {
        let id = ClaimId(self.next_claim);
        self.next_claim += 1;
        let mut resources = resources.to_vec();
        resources.sort();
        resources.dedup();
        let claim = Claim {
            resources,
            held: 0,
            deadline: within.map(|within| now.saturating_add(within)),
        };
        self.claims.insert(id, claim);
        self.enqueue(id, out);
        id
    }

    /// Releases a claim, or withdraws it. Nothing happens if it has ended.
    pub fn release(&mut self, now: Millis, claim: ClaimId, out: &mut Actions) {
        self.drop_claim(now, claim, out);
        self.settle(now, out);
    }

    /// Whether this agent holds all resources of the claim. Advisory for effects that the owner does
    /// not guard.
    #[must_use]
    pub fn is_held(&self, now: Millis, claim: ClaimId) -> bool {
        self.claims.get(&claim).is_some_and(|state| {
            let mut held = state.resources.iter().map(|resource| {
                self.holder(claim, resource)
                    .is_some_and(|holder| holder.is_held(now))
            });
            state.is_acquired() && held.all(|held| held)
        })
    }

    /// The fence of a resource that the claim holds. A legacy owner gives none.
    #[must_use]
    pub fn fence(&self, now: Millis, claim: ClaimId, resource: &Resource) -> Option<Fence> {
        self.holder(claim, resource)?.fence(now).cloned()
    }

    /// Remaining time of the claim: the shortest lease of its resources. `None` if the claim has
    /// ended, or if no owner gives a lease.
    #[must_use]
    pub fn remaining(&self, now: Millis, claim: ClaimId) -> Option<Millis> {
        let resources = &self.claims.get(&claim)?.resources;
        let holders = resources
            .iter()
            .filter_map(|resource| self.holder(claim, resource));
        holders.filter_map(|holder| holder.remaining(now)).min()
    }

    fn holder(&self, claim: ClaimId, resource: &Resource) -> Option<&Holder> {
        match self.resources.get(resource)?.current.as_ref()? {
            Current {
                claim: of,
                phase: Phase::Entered { holder, .. },
            } if *of == claim => Some(holder),
            _ => None,
        }
    }

    /// Adds a claim to the waiting ones of the resource that it wants next.
    pub(super) fn enqueue(&mut self, id: ClaimId, out: &mut Actions) {
        let Some(claim) = self.claims.get(&id) else {
            return;
        };
        match claim.wanted().cloned() {
            None => out.push(Action::Event(Event::Acquired { claim: id })),
            Some(resource) => {
                self.entry(&resource).waiting.push_back(id);
                self.touched.insert(resource);
            }
        }
    }

    /// Removes a claim from all resources. Returns it.
    pub(super) fn drop_claim(
        &mut self,
        now: Millis,
        id: ClaimId,
        out: &mut Actions,
    ) -> Option<Claim> {
        let claim = self.claims.remove(&id)?;
        for resource in claim.resources.iter().rev() {
            let Some(entry) = self.resources.get_mut(resource) else {
                continue;
            };
            entry.waiting.retain(|waiting| *waiting != id);
            if entry
                .current
                .as_ref()
                .is_some_and(|current| current.claim == id)
            {
                self.end_current(now, resource, out);
            }
            self.touched.insert(resource.clone());
        }
        Some(claim)
    }

    pub(super) fn fail(&mut self, now: Millis, id: ClaimId, failure: Failure, out: &mut Actions) {
        let Some(claim) = self.drop_claim(now, id, out) else {
            return;
        };
        if let Some(resource) = claim.wanted() {
            out.push(Action::Event(Event::Failed {
                claim: id,
                resource: resource.clone(),
                failure,
            }));
        }
    }

    pub(super) fn time_out(&mut self, now: Millis, id: ClaimId, out: &mut Actions) {
        let wanted = self.claims.get(&id).and_then(Claim::wanted);
        let entry = wanted.and_then(|resource| self.resources.get(resource));
        if entry.is_some_and(|entry| entry.owner.is_none()) {
            return self.fail(now, id, Failure::OwnerNotFound, out);
        }
        let ahead = entry.and_then(|entry| {
            let position = entry.waiting.iter().position(|waiting| *waiting == id);
            let current = usize::from(position.is_some() && entry.current.is_some());
            Some(position.unwrap_or(0) + current + entry.algorithm.ahead()?)
        });
        self.fail(now, id, Failure::TimedOut { ahead }, out);
    }
}
