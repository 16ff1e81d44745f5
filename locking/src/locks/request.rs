//! The request of this agent for a resource, from the search for the owner to the end of the lock.

use super::claim::{Claim, ClaimId};
use super::event::{Action, Event, Failure};
use super::{Actions, Locks, Received};
use crate::algorithm::Step;
use crate::holder::{Holder, HolderStep};
use crate::{
    Act, Algorithm, Conversation, Fence, LockDialect, LockPeer, Millis, MutualExclusion, Refusal,
    Resource,
};

/// The claim of this agent that takes part in the algorithm.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) struct Current {
    pub(super) claim: ClaimId,
    pub(super) phase: Phase,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) enum Phase {
    Discovering {
        until: Millis,
        next: Millis,
    },
    Requesting {
        conversation: Conversation,
        next: Millis,
    },
    Entered {
        owner: LockPeer,
        holder: Holder,
    },
}

impl<A: MutualExclusion> Locks<A> {
    pub(super) fn start(&mut self, now: Millis, resource: &Resource, out: &mut Actions) {
        let retry = now.saturating_add(self.options.retry);
        let until = now.saturating_add(self.options.discovery);
        let conversation = Conversation::new(self.me.shared_name().clone(), self.next_conversation);
        let (own, accepts) = (self.kind, self.accepts(self.kind_of(resource)));
        let Some(entry) = self.resources.get_mut(resource) else {
            return;
        };
        if entry.current.is_some() {
            return;
        }
        // Only an agent that asks all members has to know them.
        let needs_members = entry.kind.needs_permission();
        if needs_members && entry.owner.is_some() && self.greeted.poll_timeout().is_some() {
            return;
        }
        let Some(claim) = entry.waiting.pop_front() else {
            return;
        };
        if entry.owner.is_some() && entry.owned.is_none() && !accepts {
            let owner = entry.kind;
            return self.fail(now, claim, Failure::Algorithm { owner, own }, out);
        }
        if entry.owner.is_none() {
            let phase = Phase::Discovering { until, next: retry };
            entry.current = Some(Current { claim, phase });
            self.query_all(now, resource, false, out);
            return;
        }
        let phase = Phase::Requesting {
            conversation: conversation.clone(),
            next: retry,
        };
        entry.current = Some(Current { claim, phase });
        if needs_members {
            self.greeted.end();
        }
        self.next_conversation = self.next_conversation.saturating_add(1);
        self.at_algorithm(now, resource, out, |algorithm, context, steps| {
            algorithm.request(context, &conversation, steps);
        });
    }

    /// The request of this agent has entered.
    pub(super) fn entered(&mut self, now: Millis, resource: &Resource, out: &mut Actions) {
        let kind = self.kind_of(resource);
        let report = !kind.has_token();
        let Some(entry) = self.resources.get_mut(resource) else {
            return;
        };
        let (Some(owner), Some(current)) = (&entry.owner, &mut entry.current) else {
            return;
        };
        let Phase::Requesting { conversation, .. } = &current.phase else {
            return;
        };
        let dialect = self.members.get(owner).map(|member| member.dialect);
        let conversation = conversation.clone();
        let mut steps = Vec::new();
        let holder = match dialect {
            _ if kind == Algorithm::OwnerQueue => {
                let former = entry.former.take();
                let former = former.filter(|former| former.claim == current.claim);
                let place = former.and_then(|former| former.place);
                Holder::queued(conversation, now, place, &self.options, &mut steps)
            }
            Some(LockDialect::Legacy) => {
                Holder::unfenced(conversation, report, &self.options, &mut steps)
            }
            // This agent, or an agent of this library.
            _ => Holder::new(conversation, now, &self.options, &mut steps),
        };
        let owner = owner.clone();
        current.phase = Phase::Entered { owner, holder };
        self.perform_holder(now, resource, steps, out);
    }

    /// Ends the request of this agent for a resource.
    pub(super) fn end_current(&mut self, now: Millis, resource: &Resource, out: &mut Actions) {
        let Some(entry) = self.resources.get_mut(resource) else {
            return;
        };
        let Some(current) = entry.current.take() else {
            return;
        };
        let mut report = None;
        let has_token = entry.kind.has_token();
        match current.phase {
            Phase::Discovering { .. } => {
                return self.withdraw_former(resource, current.claim, out);
            }
            Phase::Requesting { .. } => {}
            Phase::Entered { owner, holder } => {
                if !(holder.is_unfenced() && has_token) {
                    report = Some((owner, holder.conversation().clone()));
                }
            }
        }
        let mut steps = Vec::new();
        self.algorithm_steps(now, resource, &mut steps, |algorithm, context, steps| {
            algorithm.leave(context, steps);
        });
        if let Some((owner, conversation)) = report {
            let returns_token = steps.iter().any(|step| {
                matches!(step, Step::Send { to, conversation: of, act: Act::Token(_) }
                    if *to == owner && *of == conversation)
            });
            // The report leaves before the messages that let the next agent enter.
            if !returns_token {
                self.send(owner, resource, conversation, Act::Release, out);
            }
        }
        self.perform(now, resource, steps, out);
    }

    /// Ends the request of this agent, and has its claim request the resource again.
    pub(super) fn ask_again(&mut self, now: Millis, resource: &Resource, out: &mut Actions) {
        let current = self.resources.get(resource);
        let current = current.and_then(|entry| entry.current.as_ref());
        let Some(claim) = current.map(|current| current.claim) else {
            return;
        };
        self.end_current(now, resource, out);
        self.entry(resource).waiting.push_front(claim);
        self.touched.insert(resource.clone());
    }

    pub(super) fn for_holder(&mut self, now: Millis, received: Received<'_>, out: &mut Actions) {
        let Received {
            from,
            resource,
            conversation,
            act,
            ..
        } = received;
        let current = self
            .resources
            .get_mut(resource)
            .and_then(|entry| entry.current.as_mut());
        if let Some(Current {
            phase: Phase::Entered { owner, holder },
            ..
        }) = current
            && owner == from
            && holder.conversation() == conversation
        {
            let mut steps = Vec::new();
            let seen = match act {
                Act::Granted { fence, .. } if fence.owner() == from.name() => Some(fence.clone()),
                _ => None,
            };
            match act {
                Act::Granted {
                    fence,
                    lease,
                    asked,
                } => holder.granted(now, fence, *lease, *asked, &mut steps),
                Act::Refused { reason, asked } => {
                    holder.refused(now, *reason, *asked, &mut steps);
                }
                _ => {}
            }
            if let Some(fence) = seen {
                self.remember(&fence);
                let entry = self.resources.get(resource);
                let seen = entry.and_then(|entry| entry.seen.get(fence.owner()));
                let is_late = entry.is_some_and(|entry| entry.owner.as_ref() != Some(from));
                let is_unknown = |seen: &&Fence| is_late || seen.run() != fence.run();
                if let Some(seen) = seen.filter(is_unknown).cloned() {
                    // The owner's present life may not know of this fence.
                    self.tell(now, &seen, resource, out);
                }
            }
            self.perform_holder(now, resource, steps, out);
        } else if let Act::Refused {
            reason: Refusal::Algorithm(kind),
            ..
        } = act
        {
            self.algorithm_refused(now, from, resource, conversation, *kind, out);
        } else if matches!(act, Act::Granted { .. }) {
            // The request was withdrawn while the grant was under way.
            let to = from.clone();
            self.send(to, resource, conversation.clone(), Act::Release, out);
        }
    }

    pub(super) fn perform_holder(
        &mut self,
        now: Millis,
        resource: &Resource,
        steps: Vec<HolderStep>,
        out: &mut Actions,
    ) {
        for step in steps {
            let current = self
                .resources
                .get(resource)
                .and_then(|entry| entry.current.as_ref());
            let Some(Current {
                claim,
                phase: Phase::Entered { owner, holder },
            }) = current
            else {
                return;
            };
            let (id, owner) = (*claim, owner.clone());
            let conversation = holder.conversation().clone();
            match step {
                HolderStep::Send(act) => self.send(owner, resource, conversation, act, out),
                HolderStep::Held => {
                    if let Some(claim) = self.claims.get_mut(&id)
                        && claim.wanted() == Some(resource)
                    {
                        claim.held += 1;
                        self.enqueue(id, out);
                    }
                }
                HolderStep::Lost => {
                    let acquired = self.claims.get(&id).is_some_and(Claim::is_acquired);
                    if acquired {
                        self.drop_claim(now, id, out);
                        out.push(Action::Event(Event::Lost {
                            claim: id,
                            resource: resource.clone(),
                        }));
                    } else {
                        self.fail(now, id, Failure::Lost, out);
                    }
                }
                HolderStep::Refused(Refusal::NotOwner) => {
                    self.fail(now, id, Failure::Refused(Refusal::NotOwner), out);
                    if let Some(entry) = self.resources.get_mut(resource)
                        && entry.owner.as_ref() == Some(&owner)
                    {
                        entry.owner = None;
                    }
                }
                HolderStep::Refused(Refusal::Algorithm(kind)) => {
                    self.ask_in(now, resource, id, kind, out);
                }
                // The grant ended before this agent could use it.
                HolderStep::Refused(_) => self.ask_again(now, resource, out),
            }
        }
    }

    pub(super) fn time_out_current(&mut self, now: Millis, resource: &Resource, out: &mut Actions) {
        let retry = now.saturating_add(self.options.retry);
        let current = self
            .resources
            .get_mut(resource)
            .and_then(|entry| entry.current.as_mut());
        let Some(current) = current else {
            return;
        };
        let claim = current.claim;
        match &mut current.phase {
            Phase::Discovering { until, .. } if *until <= now => {
                self.not_found(now, resource, claim, out);
            }
            Phase::Discovering { next, .. } if *next <= now => {
                *next = retry;
                self.query_all(now, resource, false, out);
            }
            Phase::Requesting { next, .. } if *next <= now => {
                *next = retry;
                self.at_algorithm(now, resource, out, |algorithm, context, steps| {
                    algorithm.repeat(context, steps);
                });
            }
            Phase::Entered { holder, .. } => {
                let mut steps = Vec::new();
                holder.handle_timeout(now, &mut steps);
                self.perform_holder(now, resource, steps, out);
            }
            Phase::Discovering { .. } | Phase::Requesting { .. } => {}
        }
    }
}
