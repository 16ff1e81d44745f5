//! Resources that this agent owns.

use super::event::{Action, Event};
use super::{Actions, Locks, Received};
use crate::faults::fault;
use crate::owner::{Grant, Owner, OwnerStep};
use crate::{
    Act, Algorithm, Fence, LockDialect, LockPeer, Millis, MutualExclusion, OwnerGate, OwnerState,
    Refusal, Resource,
};

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) struct Owned {
    pub(super) core: Owner,
    /// End of the time in which an existing owner may contradict.
    pub(super) claim_until: Option<Millis>,
    pub(super) needs_report: bool,
    /// Another agent that claims the resource.
    pub(super) rival: Option<LockPeer>,
}

impl<A: MutualExclusion> Locks<A> {
    /// Begins to own a resource, with a state that the caller has written and synced.
    ///
    /// [`Event::Owning`] follows after [`Options::claim`](crate::Options::claim), or [`Event::OwningRefused`] if
    /// another agent owns the resource. Nothing happens if this agent owns it already.
    pub fn own(&mut self, now: Millis, resource: &Resource, state: &OwnerState, out: &mut Actions) {
        self.own_with_lease(now, resource, state, self.options.lease, out);
    }

    /// Begins to own a resource, and grants it with this lease instead of
    /// [`Options::lease`](crate::Options::lease). The state has to be for leases of at least this time; see
    /// [`own`](Self::own).
    pub fn own_with_lease(
        &mut self,
        now: Millis,
        resource: &Resource,
        state: &OwnerState,
        lease: Millis,
        out: &mut Actions,
    ) {
        let (me, options) = (self.me.clone(), self.options);
        if self.entry(resource).owned.is_some() {
            return;
        }
        self.choose_algorithm(resource);
        let entry = self.entry(resource);
        let silence = state.silence().max(options.claim);
        let mut core = Owner::new(
            me.clone(),
            resource.clone(),
            state,
            lease,
            now,
            silence,
            options.fault,
        );
        // A life of this name in this process, or one whose fences this agent has held.
        if let Some(fence) = entry.seen.get(me.shared_name()) {
            core.seen(now, fence);
        }
        let mut needs_report = state.needs_report();
        if fault!(options.fault, BeginAnyway) {
            needs_report = false;
        }
        // An owner that needs a report is no owner before it has one.
        let claim = if needs_report { silence } else { options.claim };
        if entry.kind == Algorithm::OwnerQueue {
            core.be_fair(options.probe_timeout);
        }
        entry.owned = Some(Owned {
            core,
            claim_until: Some(now.saturating_add(claim)),
            needs_report,
            rival: None,
        });
        if entry.owner.is_none() {
            entry.owner = Some(me);
        }
        self.touched.insert(resource.clone());
        self.query_all(now, resource, true, out);
        self.settle(now, out);
    }

    /// Stops owning a resource. Returns whether no grant was live, so that the state file may be
    /// [closed](OwnerState::closed).
    pub fn disown(&mut self, now: Millis, resource: &Resource, out: &mut Actions) -> bool {
        let owned = self
            .resources
            .get_mut(resource)
            .and_then(|entry| entry.owned.take());
        let Some(owned) = owned else {
            return true;
        };
        let was_silent = owned.core.gate() == OwnerGate::Closed;
        if let Some(last) = owned.core.last() {
            self.remember(&last);
        }
        self.owner_lost(now, resource, &self.me.clone(), true, out);
        self.settle(now, out);
        !was_silent
    }

    /// Continues with an epoch that the caller has written and synced, after [`Event::Raised`].
    pub fn stored(&mut self, now: Millis, resource: &Resource, epoch: u64, out: &mut Actions) {
        self.at_owner(resource, out, |core, steps| core.stored(now, epoch, steps));
        self.settle(now, out);
    }

    /// Ends the live grant of a resource, for a legacy holder that does not answer.
    pub fn force(&mut self, now: Millis, resource: &Resource, out: &mut Actions) {
        self.at_owner(resource, out, |core, steps| core.force(now, steps));
        self.settle(now, out);
    }

    /// Whether a command with this fence is carried out: only with the fence of the live grant of this
    /// owner.
    #[must_use]
    pub fn admit(&self, now: Millis, resource: &Resource, fence: &Fence) -> bool {
        self.owner(resource)
            .is_some_and(|core| core.admit(now, fence))
    }

    /// The owner's core, if this agent owns the resource.
    #[must_use]
    pub fn owner(&self, resource: &Resource) -> Option<&Owner> {
        Some(&self.resources.get(resource)?.owned.as_ref()?.core)
    }

    pub(super) fn for_owner(&mut self, now: Millis, received: Received<'_>, out: &mut Actions) {
        let Received {
            from,
            resource,
            conversation,
            act,
            ..
        } = received;
        let owns = self.owner(resource).is_some();
        let has_token = self.kind_of(resource).has_token();
        match act {
            Act::Ask { asked, place } if owns => self.at_owner(resource, out, |core, steps| {
                core.ask(now, from, conversation, *asked, *place, steps);
            }),
            Act::Confirm { asked } if owns => self.at_owner(resource, out, |core, steps| {
                if has_token {
                    // The agent has the token, so the legacy agent that had it has left.
                    core.left_without_report(now, steps);
                }
                core.confirm(now, from, conversation, *asked, steps);
            }),
            Act::Renew { fence, asked } if owns => self.at_owner(resource, out, |core, steps| {
                core.renew(now, from, conversation, fence, *asked, steps);
            }),
            Act::Release if owns => self.at_owner(resource, out, |core, steps| {
                core.release(now, from, conversation, steps);
            }),
            Act::Ask { asked, .. }
            | Act::Confirm { asked: Some(asked) }
            | Act::Renew { asked, .. } => {
                let refused = Act::Refused {
                    reason: Refusal::NotOwner,
                    asked: *asked,
                };
                self.send(from.clone(), resource, conversation.clone(), refused, out);
            }
            _ => {}
        }
    }

    /// Ends the time in which an existing owner may contradict.
    pub(super) fn end_of_claim(&mut self, now: Millis, resource: &Resource, out: &mut Actions) {
        let Some(entry) = self.resources.get_mut(resource) else {
            return;
        };
        let Some(owned) = &mut entry.owned else {
            return;
        };
        if owned.claim_until.is_none_or(|until| now < until) {
            return;
        }
        if owned.needs_report && !owned.core.has_report() {
            entry.owned = None;
            let me = self.me.clone();
            out.push(Action::Event(Event::NoMemory {
                resource: resource.clone(),
            }));
            self.owner_lost(now, resource, &me, true, out);
            return;
        }
        owned.claim_until = None;
        entry.owner = Some(self.me.clone());
        out.push(Action::Event(Event::Owning {
            resource: resource.clone(),
        }));
        let conversation = self.side_conversation("announce", now);
        // Agents of `distributed_locking` accept no announcement, only answers.
        let members: Vec<_> = self
            .members
            .iter()
            .filter(|(_, member)| member.dialect == LockDialect::Own)
            .map(|(peer, _)| peer.clone())
            .collect();
        for member in members {
            self.send(member, resource, conversation.clone(), Act::Owned, out);
        }
        self.at_algorithm(now, resource, out, |algorithm, context, steps| {
            algorithm.own(context, steps);
        });
    }

    pub(super) fn at_owner(
        &mut self,
        resource: &Resource,
        out: &mut Actions,
        call: impl FnOnce(&mut Owner, &mut Vec<OwnerStep>),
    ) {
        let entry = self.resources.get_mut(resource);
        let Some(owned) = entry.and_then(|entry| entry.owned.as_mut()) else {
            return;
        };
        let mut steps = Vec::new();
        call(&mut owned.core, &mut steps);
        self.touched.insert(resource.clone());
        self.perform_owner(resource, steps, out);
    }

    fn perform_owner(&mut self, resource: &Resource, steps: Vec<OwnerStep>, out: &mut Actions) {
        for step in steps {
            match step {
                OwnerStep::Send {
                    to,
                    conversation,
                    act,
                } => self.send(to, resource, conversation, act, out),
                OwnerStep::Store(epoch) => {
                    let resource = resource.clone();
                    out.push(Action::Event(Event::Raised { resource, epoch }));
                }
                OwnerStep::Probe { to, at } => self.probe(at, to, out),
                OwnerStep::Began(grant) => {
                    let resource = resource.clone();
                    out.push(Action::Event(Event::Granted { resource, grant }));
                }
                OwnerStep::Ended { grant, how } => {
                    self.ended(resource, &grant);
                    let resource = resource.clone();
                    out.push(Action::Event(Event::Ended {
                        resource,
                        grant,
                        how,
                    }));
                }
            }
        }
    }

    /// Marks a token whose holder's grant has ended. The next change of the gate replaces it.
    fn ended(&mut self, resource: &Resource, grant: &Grant) {
        if let Some(entry) = self.resources.get_mut(resource) {
            entry.algorithm.grant_ended(&grant.holder);
        }
    }
}
