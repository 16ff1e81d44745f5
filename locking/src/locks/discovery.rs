//! The owners of resources: agents find them, learn of them and lose them.

use super::event::{Action, Event, Failure};
use super::request::Phase;
use super::{Actions, Locks, MAX_FOREIGN, Received};
use crate::{Act, Algorithm, LockDialect, LockPeer, Millis, MutualExclusion, Resource};

impl<A: MutualExclusion> Locks<A> {
    /// Records the owner of a resource, as the directory knows it. Then no message has to find it.
    pub fn owner_known(
        &mut self,
        now: Millis,
        resource: &Resource,
        owner: &LockPeer,
        dialect: LockDialect,
        out: &mut Actions,
    ) {
        let named = (dialect == LockDialect::Own).then_some(self.kind);
        self.owner_named(now, resource, owner, dialect, named, out);
    }

    /// Records the owner of a resource and its algorithm, as the directory knows them; see
    /// [`owner_known`](Self::owner_known).
    pub fn owner_named(
        &mut self,
        now: Millis,
        resource: &Resource,
        owner: &LockPeer,
        dialect: LockDialect,
        algorithm: Option<Algorithm>,
        out: &mut Actions,
    ) {
        if *owner != self.me && self.admit_member(now, owner, dialect, out) {
            self.entry(resource);
            self.learn_owner(now, resource, owner, algorithm, out);
        }
        self.settle(now, out);
    }

    pub(super) fn discover(&mut self, now: Millis, received: Received<'_>, out: &mut Actions) {
        let Received {
            from,
            resource,
            conversation,
            algorithm,
            act,
        } = received;
        // An earlier registration of this agent is no other owner.
        if from.name() == self.me.name() {
            return;
        }
        if *act == Act::Owned && self.resources.len() < MAX_FOREIGN {
            self.entry(resource);
        }
        let Some(entry) = self.resources.get_mut(resource) else {
            return;
        };
        let established = match &entry.owned {
            Some(owned) => owned.claim_until.is_none(),
            None => {
                if *act == Act::Owned {
                    self.learn_owner(now, resource, from, algorithm, out);
                } else if (*act == Act::Query { claim: true }) {
                    if self.is_return(resource, from) {
                        self.learn_owner(now, resource, from, Some(Algorithm::OwnerQueue), out);
                    }
                    // The owner may have started without its state file.
                    self.tell_seen(now, from, resource, out);
                }
                return;
            }
        };
        let owns = matches!(act, Act::Owned | Act::Contested);
        if let Some(owned) = entry.owned.as_mut().filter(|_| owns && established) {
            owned.rival = Some(from.clone());
        }
        let contested = || {
            Action::Event(Event::Contested {
                resource: resource.clone(),
                by: from.clone(),
            })
        };
        match (act, established) {
            (Act::Query { claim }, true) => {
                // The other members were told when they joined. An answer to all of them would let one
                // message cause any number of others.
                let to = from.clone();
                self.send(to, resource, conversation.clone(), Act::Owned, out);
                if *claim {
                    let to = from.clone();
                    self.send(to, resource, conversation.clone(), Act::Contested, out);
                    out.push(contested());
                }
            }
            // Of two agents that claim a resource at the same time, the lower one owns it.
            (Act::Query { claim: true }, false) if self.me < *from => {
                let to = from.clone();
                self.send(to, resource, conversation.clone(), Act::Contested, out);
                out.push(contested());
            }
            (Act::Query { claim: false }, false) => {}
            (Act::Owned | Act::Contested, true) => out.push(contested()),
            (_, true) => {}
            (_, false) => {
                entry.owned = None;
                out.push(Action::Event(Event::OwningRefused {
                    resource: resource.clone(),
                    by: from.clone(),
                }));
                let me = self.me.clone();
                self.owner_lost(now, resource, &me, true, out);
                if *act == Act::Owned {
                    self.learn_owner(now, resource, from, algorithm, out);
                }
            }
        }
    }

    /// `named` is the algorithm that the owner has named.
    fn learn_owner(
        &mut self,
        now: Millis,
        resource: &Resource,
        peer: &LockPeer,
        named: Option<Algorithm>,
        out: &mut Actions,
    ) {
        let Some(entry) = self.resources.get(resource) else {
            return;
        };
        if entry.owned.is_some() {
            return;
        }
        match &entry.owner {
            Some(known) if known == peer => return,
            Some(known) if known.name() == peer.name() => {
                // The owner has restarted.
                let known = known.clone();
                self.owner_lost(now, resource, &known, false, out);
            }
            // The first of two owners is used until it is lost.
            Some(_) => return,
            None => {}
        }
        let member = self.members.get(peer);
        let is_own = member.is_some_and(|member| member.dialect == LockDialect::Own);
        let kind = named.filter(|_| is_own).unwrap_or_else(|| self.unnamed());
        self.set_algorithm(resource, kind);
        let Some(entry) = self.resources.get_mut(resource) else {
            return;
        };
        entry.owner = Some(peer.clone());
        entry.algorithm.owner_changed();
        self.touched.insert(resource.clone());
        self.tell_seen(now, peer, resource, out);
        let Some(entry) = self.resources.get_mut(resource) else {
            return;
        };
        if let Some(current) = &entry.current
            && matches!(current.phase, Phase::Discovering { .. })
        {
            entry.waiting.push_front(current.claim);
            entry.current = None;
        }
    }

    /// Handles the loss of an agent, if it owns the resource.
    pub(super) fn owner_lost(
        &mut self,
        now: Millis,
        resource: &Resource,
        peer: &LockPeer,
        gone: bool,
        out: &mut Actions,
    ) {
        let Some(entry) = self.resources.get_mut(resource) else {
            return;
        };
        if entry.kind == Algorithm::OwnerQueue && *peer != self.me {
            return self.lose_queue(now, resource, peer);
        }
        let mut failed = Vec::new();
        if entry.owner.as_ref() == Some(peer) {
            entry.owner = None;
            failed.extend(entry.waiting.drain(..));
        }
        let mut steps = Vec::new();
        if let Some(current) = &mut entry.current {
            match &mut current.phase {
                Phase::Discovering { .. } => {}
                Phase::Requesting { .. } if entry.owner.is_none() => failed.push(current.claim),
                Phase::Requesting { .. } => {}
                Phase::Entered { owner, holder } if owner == peer => {
                    if holder.is_unfenced() || gone {
                        holder.owner_lost(&mut steps);
                    }
                    if !holder.is_held(now) && steps.is_empty() {
                        failed.push(current.claim);
                    }
                }
                Phase::Entered { .. } => {}
            }
        }
        self.touched.insert(resource.clone());
        self.perform_holder(now, resource, steps, out);
        for claim in failed {
            let owner = peer.clone();
            self.fail(now, claim, Failure::Unreachable { owner }, out);
        }
    }

    pub(super) fn query_all(
        &mut self,
        now: Millis,
        resource: &Resource,
        claim: bool,
        out: &mut Actions,
    ) {
        let conversation = self.side_conversation("discover", now);
        let members: Vec<_> = self.members.keys().cloned().collect();
        for member in members {
            let act = Act::Query { claim };
            self.send(member, resource, conversation.clone(), act, out);
        }
    }
}
