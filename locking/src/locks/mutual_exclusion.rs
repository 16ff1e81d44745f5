//! The algorithm of a resource, which decides on the next holder.

use super::{Actions, Locks, MAX_FOREIGN, Received};
use crate::algorithm::{Context, Step};
use crate::faults::fault;
use crate::{Act, LockDialect, Millis, MutualExclusion, OwnerGate, Resource};

impl<A: MutualExclusion> Locks<A> {
    pub(super) fn for_algorithm(&mut self, now: Millis, received: Received<'_>, out: &mut Actions) {
        let Received {
            from,
            resource,
            conversation,
            algorithm,
            act,
        } = received;
        let kind = algorithm.unwrap_or(self.kind);
        if !self.resources.contains_key(resource) {
            match act {
                Act::Request { clock } => {
                    if !fault!(self.options.fault, ForgetClock) {
                        self.clock = self.clock.max(*clock);
                    }
                    let agree = Act::Agree { clock: *clock };
                    self.send_in(
                        kind,
                        from.clone(),
                        resource,
                        conversation.clone(),
                        agree,
                        out,
                    );
                    return;
                }
                // A member that gets the token later has to know the requests. A token for an
                // earlier registration has to be passed on.
                Act::RequestToken { .. } | Act::Token(_)
                    if self.accepts(kind) && self.resources.len() < MAX_FOREIGN =>
                {
                    self.entry(resource);
                    self.set_algorithm(resource, kind);
                }
                _ => return,
            }
        }
        self.touched.insert(resource.clone());
        let live = self.owner(resource).and_then(|core| core.live(now));
        let legacy_holder = live.is_some_and(|live| live.fence.is_none());
        self.at_algorithm(now, resource, out, |algorithm, context, steps| {
            algorithm.handle(context, from, conversation, act, steps);
        });
        if let Act::Token(_) = act {
            self.at_owner(resource, out, |core, steps| {
                if conversation.is_of(from) {
                    // The token's return is the report of the agent that had it.
                    core.release(now, from, conversation, steps);
                }
                if legacy_holder {
                    core.left_without_report(now, steps);
                }
            });
        }
    }

    pub(super) fn update_gate(&mut self, now: Millis, resource: &Resource, out: &mut Actions) {
        let Some(entry) = self.resources.get_mut(resource) else {
            return;
        };
        let owned = entry.owned.as_ref();
        let gate = owned.map_or(OwnerGate::Open, |owned| owned.core.gate());
        if gate != entry.gate {
            entry.gate = gate;
            self.at_algorithm(now, resource, out, |algorithm, context, steps| {
                algorithm.gate_changed(context, steps);
            });
        }
    }

    pub(super) fn at_algorithm(
        &mut self,
        now: Millis,
        resource: &Resource,
        out: &mut Actions,
        call: impl FnOnce(&mut A, &Context<'_>, &mut Vec<Step>),
    ) {
        let mut steps = Vec::new();
        self.algorithm_steps(now, resource, &mut steps, call);
        self.perform(now, resource, steps, out);
    }

    pub(super) fn algorithm_steps(
        &mut self,
        now: Millis,
        resource: &Resource,
        steps: &mut Vec<Step>,
        call: impl FnOnce(&mut A, &Context<'_>, &mut Vec<Step>),
    ) {
        let Some(entry) = self.resources.get_mut(resource) else {
            return;
        };
        let context = Context {
            now,
            members: &self.members,
            owner: entry.owner.as_ref(),
            gate: entry.gate,
            lease: self.options.lease,
            retry: self.options.retry,
            clock: self.clock,
            fault: self.options.fault,
        };
        call(&mut entry.algorithm, &context, steps);
    }

    pub(super) fn perform(
        &mut self,
        now: Millis,
        resource: &Resource,
        steps: Vec<Step>,
        out: &mut Actions,
    ) {
        for step in steps {
            match step {
                Step::Send {
                    to,
                    conversation,
                    act,
                } => {
                    let dialect = self.members.get(&to).map(|member| member.dialect);
                    if matches!(act, Act::Token(_)) && dialect == Some(LockDialect::Legacy) {
                        self.at_owner(resource, out, |core, steps| {
                            core.entered_without_report(&to, &conversation, steps);
                        });
                    }
                    self.send(to, resource, conversation, act, out);
                }
                Step::Entered => self.entered(now, resource, out),
                Step::Again => self.ask_again(now, resource, out),
            }
        }
    }
}
