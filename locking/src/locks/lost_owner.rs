//! Requests of the owner's queue whose owner is lost.
//!
//! Such a request waits for the return of the owner, up to [`Options::discovery`](crate::Options::discovery). The
//! owner then gets it again, with its place.

use super::claim::ClaimId;
use super::event::Failure;
use super::request::Phase;
use super::{Actions, Locks};
use crate::{Act, Algorithm, Conversation, LockPeer, Millis, MutualExclusion, Resource};

/// A request that waited at an owner that is lost.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) struct Former {
    pub(super) claim: ClaimId,
    owner: LockPeer,
    conversation: Conversation,
    pub(super) place: Option<u32>,
}

impl<A: MutualExclusion> Locks<A> {
    /// Handles the loss of the owner of a resource with a queue, which may return. A lease is used to its end.
    pub(super) fn lose_queue(&mut self, now: Millis, resource: &Resource, peer: &LockPeer) {
        let until = now.saturating_add(self.options.discovery);
        let Some(entry) = self.resources.get_mut(resource) else {
            return;
        };
        if entry.owner.as_ref() == Some(peer) {
            entry.owner = None;
        }
        self.touched.insert(resource.clone());
        let Some(current) = &mut entry.current else {
            return;
        };
        let Phase::Entered { owner, holder } = &current.phase else {
            return;
        };
        if owner != peer || !holder.is_asking() {
            return;
        }
        entry.former = Some(Former {
            claim: current.claim,
            owner: peer.clone(),
            conversation: holder.conversation().clone(),
            place: entry.algorithm.place().or(holder.place()),
        });
        entry.algorithm = A::new(entry.kind, self.me.clone(), false);
        if entry.owner.is_some() {
            // Another owner is known.
            entry.waiting.push_front(current.claim);
            entry.current = None;
            return;
        }
        // The members are asked at the next timeout, unless the owner has just told of its return.
        current.phase = Phase::Discovering { until, next: now };
    }

    /// Whether an agent that begins to own a resource is its earlier owner, which has restarted.
    pub(super) fn is_return(&self, resource: &Resource, from: &LockPeer) -> bool {
        self.resources.get(resource).is_some_and(|entry| {
            let former = entry.former.as_ref().map(|former| &former.owner);
            let mut owners = entry.owner.iter().chain(former);
            entry.kind == Algorithm::OwnerQueue && owners.any(|owner| owner.name() == from.name())
        })
    }

    /// Fails a claim whose time to find the owner is over. Those behind a request that was lost with its owner have
    /// waited as long.
    pub(super) fn not_found(
        &mut self,
        now: Millis,
        resource: &Resource,
        claim: ClaimId,
        out: &mut Actions,
    ) {
        let Some(entry) = self.resources.get_mut(resource) else {
            return;
        };
        let former = entry.former.as_ref();
        let Some(former) = former.filter(|former| former.claim == claim) else {
            return self.fail(now, claim, Failure::NoOwner, out);
        };
        let owner = former.owner.clone();
        let behind = std::mem::take(&mut entry.waiting);
        for claim in [claim].into_iter().chain(behind) {
            let owner = owner.clone();
            self.fail(now, claim, Failure::Unreachable { owner }, out);
        }
    }

    /// Withdraws a request at an owner that is lost. It may be cut off only.
    pub(super) fn withdraw_former(
        &mut self,
        resource: &Resource,
        claim: ClaimId,
        out: &mut Actions,
    ) {
        let former = self
            .resources
            .get_mut(resource)
            .and_then(|entry| entry.former.take_if(|former| former.claim == claim));
        if let Some(former) = former
            && self.members.contains_key(&former.owner)
        {
            let (to, conversation) = (former.owner, former.conversation);
            self.send(to, resource, conversation, Act::Release, out);
        }
    }
}
