//! The algorithm of a resource.
//!
//! The owner chooses the algorithm when it begins to own the resource, and names it in its answers. An agent
//! that was told to use the owner's queue, the default, uses the algorithm that the owner names. An agent
//! that was told to use another one is refused with the name of the owner's. No resource has two.

use super::claim::ClaimId;
use super::event::{Action, Event};
use super::request::{Current, Phase};
use super::{Actions, Locks};
use crate::{
    Act, Algorithm, Content, Conversation, LockDialect, LockMessage, LockPeer, Millis,
    MutualExclusion, Refusal, Resource,
};

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
}
