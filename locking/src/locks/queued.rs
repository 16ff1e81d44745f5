//! Which algorithm a resource has, and requests of the owner's queue whose owner is lost.
//!
//! * The owner chooses the algorithm when it begins to own the resource, and names it in its answers. An agent
//!   that was told to use the owner's queue, the default, uses the algorithm that the owner names. An agent
//!   that was told to use another one is refused with the name of the owner's. No resource has two.
//! * A request whose owner is lost waits for its return, up to [`Options::discovery`](crate::Options::discovery). The
//!   owner then gets it again, with its place.

use super::claim::ClaimId;
use super::event::{Action, Event, Failure};
use super::request::{Current, Phase};
use super::{Actions, Locks};
use crate::{
    Act, Algorithm, Content, Conversation, LockDialect, LockMessage, LockPeer, Millis,
    MutualExclusion, Refusal, Resource,
};

/// A request that waited at an owner that is lost.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) struct Former {
    pub(super) claim: ClaimId,
    owner: LockPeer,
    conversation: Conversation,
    pub(super) place: Option<u32>,
}

/// Whether an act is one of its algorithm only. Grants, refusals and releases count in each: they name their
/// request.
fn is_of_algorithm(act: &Act) -> bool {
    matches!(
        act,
        Act::Ask { .. }
            | Act::Place { .. }
            | Act::Request { .. }
            | Act::Agree { .. }
            | Act::RequestToken { .. }
            | Act::Token(_)
            | Act::Confirm { .. }
            | Act::Renew { .. }
    )
}

impl<A: MutualExclusion> Locks<A> {
    // ----- algorithms

    /// MutualExclusion of a resource.
    pub(super) fn kind_of(&self, resource: &Resource) -> Algorithm {
        let entry = self.resources.get(resource);
        entry.map_or(self.kind, |entry| entry.kind)
    }

    /// Whether this agent uses an algorithm.
    pub(super) fn accepts(&self, kind: Algorithm) -> bool {
        self.kind == Algorithm::OwnerQueue || self.kind == kind
    }

    /// MutualExclusion at an owner that names none: one of `distributed_locking`.
    pub(super) fn unnamed(&self) -> Algorithm {
        match self.kind {
            Algorithm::OwnerQueue => self.options.legacy_algorithm,
            kind => kind,
        }
    }

    pub(super) fn set_algorithm(&mut self, resource: &Resource, kind: Algorithm) {
        if let Some(entry) = self.resources.get_mut(resource)
            && entry.kind != kind
        {
            entry.kind = kind;
            entry.algorithm = A::new(kind, self.me.clone(), false);
        }
    }

    /// MutualExclusion of the resources that this agent begins to own.
    #[must_use]
    pub fn own_algorithm(&self) -> Algorithm {
        match self.options.legacy_peers {
            true => self.unnamed(),
            false => self.kind,
        }
    }

    /// Chooses the algorithm of a resource that this agent begins to own.
    pub(super) fn choose_algorithm(&mut self, resource: &Resource) {
        let kind = self.own_algorithm();
        if !self.has_request(resource) {
            self.set_algorithm(resource, kind);
        }
    }

    fn has_request(&self, resource: &Resource) -> bool {
        let entry = self.resources.get(resource);
        let current = entry.and_then(|entry| entry.current.as_ref());
        current.is_some_and(|current| !matches!(current.phase, Phase::Discovering { .. }))
    }

    /// The algorithm that a message contains. Agents of `distributed_locking` know no names of algorithms.
    pub(super) fn algorithm_in(
        &self,
        act: &Act,
        kind: Algorithm,
        to: &LockPeer,
    ) -> Option<Algorithm> {
        match act {
            act if is_of_algorithm(act) => Some(kind),
            Act::Granted { .. } | Act::Refused { .. } | Act::Release => Some(kind),
            Act::Owned => {
                let member = self.members.get(to);
                member
                    .is_some_and(|member| member.dialect == LockDialect::Own)
                    .then_some(kind)
            }
            _ => None,
        }
    }

    /// Whether a message is of another algorithm than that of its resource. An owner refuses requests of another
    /// algorithm. A member that does not know the owner takes the algorithm of the message.
    pub(super) fn is_refused(
        &mut self,
        from: &LockPeer,
        message: &LockMessage,
        out: &mut Actions,
    ) -> bool {
        let (Some(kind), Content::Lock { resource, act }) = (message.algorithm, &message.content)
        else {
            return false;
        };
        let Some(entry) = self.resources.get(resource) else {
            return false;
        };
        if !is_of_algorithm(act) || entry.kind == kind {
            return false;
        }
        let (own, conversation) = (entry.kind, &message.conversation);
        if entry.owned.is_some() {
            let asked = match act {
                Act::Ask { asked, .. }
                | Act::Confirm { asked: Some(asked) }
                | Act::Renew { asked, .. } => *asked,
                Act::Confirm { asked: None } | Act::Request { .. } | Act::RequestToken { .. } => 0,
                _ => return true,
            };
            let reason = Refusal::Algorithm(own);
            let refused = Act::Refused { reason, asked };
            self.send_in(
                kind,
                from.clone(),
                resource,
                conversation.clone(),
                refused,
                out,
            );
            out.push(Action::Event(Event::OtherAlgorithm {
                resource: resource.clone(),
                by: from.clone(),
                algorithm: kind,
            }));
            return true;
        }
        if entry.owner.is_none() && !self.has_request(resource) && self.accepts(kind) {
            self.set_algorithm(resource, kind);
            return false;
        }
        if let Act::Request { clock } = act {
            // No agent waits for one that does not take part.
            let agree = Act::Agree { clock: *clock };
            let to = from.clone();
            self.send_in(kind, to, resource, conversation.clone(), agree, out);
        } else if let Act::Ask { asked, .. } = act {
            let reason = Refusal::NotOwner;
            let asked = *asked;
            let refused = Act::Refused { reason, asked };
            let to = from.clone();
            self.send_in(kind, to, resource, conversation.clone(), refused, out);
        }
        true
    }

    /// Handles the refusal of a request that has not entered: the owner uses another algorithm.
    pub(super) fn algorithm_refused(
        &mut self,
        now: Millis,
        from: &LockPeer,
        resource: &Resource,
        conversation: &Conversation,
        kind: Algorithm,
        out: &mut Actions,
    ) {
        let Some(entry) = self.resources.get(resource) else {
            return;
        };
        if let Some(Current {
            claim,
            phase: Phase::Requesting {
                conversation: of, ..
            },
        }) = &entry.current
            && entry.owner.as_ref() == Some(from)
            && of == conversation
        {
            let claim = *claim;
            self.ask_in(now, resource, claim, kind, out);
        }
    }

    /// Has a claim request its resource again, with another algorithm.
    pub(super) fn ask_in(
        &mut self,
        now: Millis,
        resource: &Resource,
        claim: ClaimId,
        kind: Algorithm,
        out: &mut Actions,
    ) {
        self.end_current(now, resource, out);
        self.set_algorithm(resource, kind);
        self.entry(resource).waiting.push_front(claim);
        self.touched.insert(resource.clone());
    }

    // ----- lost owners

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

    // ----- members

    /// Handles a sign of life of a member that was suspected.
    pub(super) fn alive_again(&mut self, now: Millis, peer: &LockPeer, out: &mut Actions) {
        let owned = self.resources.iter().filter(|(_, entry)| {
            let core = entry.owned.as_ref().map(|owned| &owned.core);
            entry.kind == Algorithm::OwnerQueue
                && core.is_some_and(|core| core.waiters().any(|waiter| waiter == peer))
        });
        let owned: Vec<_> = owned.map(|(resource, _)| resource.clone()).collect();
        for resource in owned {
            self.at_owner(&resource, out, |core, steps| {
                core.sign_of_life(now, peer, steps)
            });
        }
    }
}
