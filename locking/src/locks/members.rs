//! Members: the other agents that take part.

use super::event::{Action, Event};
use super::request::Phase;
use super::{Actions, Locks};
use crate::algorithm::Member;
use crate::faults::fault;
use crate::{Act, Algorithm, LockDialect, LockPeer, Millis, MutualExclusion, Resource};

/// Maximum number of members. Messages of further agents are ignored.
const MAX_MEMBERS: usize = 4096;

/// Number of ended registrations whose late messages are recognized.
const MAX_GONE: usize = 256;

impl<A: MutualExclusion> Locks<A> {
    /// Adds a member, or updates its dialect.
    pub fn join(&mut self, now: Millis, peer: &LockPeer, dialect: LockDialect, out: &mut Actions) {
        self.admit_member(now, peer, dialect, out);
        self.settle(now, out);
    }

    /// Has the first request of this agent wait for a message of another agent, which the caller has asked for a
    /// sign of life. It waits for [`Options::retry`](crate::Options::retry) from the first call on at most. Agents
    /// that use locks answer, and become members.
    ///
    /// Only Ricart-Agrawala needs the wait.
    pub fn expect(&mut self, now: Millis, peer: &LockPeer) {
        let is_needed = !self.kind.has_token()
            && *peer != self.me
            && !self.members.contains_key(peer)
            && !self.gone.contains(peer)
            && !fault!(self.options.fault, AwaitNoAnswer);
        if is_needed {
            self.greeted.expect(now, self.options.retry, peer);
        }
    }

    /// Removes a member whose registration has ended: its process ended, or it has left. Its grants
    /// end at once, and its late messages are ignored. The caller has to have a proof.
    pub fn depart(&mut self, now: Millis, peer: &LockPeer, out: &mut Actions) {
        if !self.gone.contains(peer) {
            self.gone.push_back(peer.clone());
            if self.gone.len() > MAX_GONE {
                self.gone.pop_front();
            }
        }
        self.members.remove(peer);
        self.no_longer_expect(peer);
        let resources: Vec<_> = self.resources.keys().cloned().collect();
        for resource in resources {
            self.member_lost(now, &resource, peer, true, out);
        }
        self.settle(now, out);
    }

    /// Returns whether the agent is a member.
    pub(super) fn admit_member(
        &mut self,
        now: Millis,
        peer: &LockPeer,
        dialect: LockDialect,
        out: &mut Actions,
    ) -> bool {
        if *peer == self.me || self.gone.contains(peer) {
            return false;
        }
        self.no_longer_expect(peer);
        if let Some(member) = self.members.get_mut(peer) {
            member.suspected = false;
            if dialect == LockDialect::Own {
                member.dialect = dialect;
            }
            return true;
        }
        if self.members.len() >= MAX_MEMBERS {
            return false;
        }
        let member = Member {
            dialect,
            suspected: false,
        };
        self.members.insert(peer.clone(), member);
        let resources: Vec<_> = self.resources.keys().cloned().collect();
        for resource in resources {
            let Some(entry) = self.resources.get(&resource) else {
                continue;
            };
            let discovering = entry
                .current
                .as_ref()
                .is_some_and(|current| matches!(current.phase, Phase::Discovering { .. }));
            let act = match &entry.owned {
                Some(owned) if owned.claim_until.is_some() => Some(Act::Query { claim: true }),
                Some(_) => (dialect == LockDialect::Own).then_some(Act::Owned),
                None => discovering.then_some(Act::Query { claim: false }),
            };
            if let Some(act) = act {
                let kind = match act {
                    Act::Owned => "announce",
                    _ => "discover",
                };
                let conversation = self.side_conversation(kind, now);
                self.send(peer.clone(), &resource, conversation, act, out);
            }
            self.at_algorithm(now, &resource, out, |algorithm, context, steps| {
                algorithm.joined(context, peer, steps);
            });
            self.touched.insert(resource);
        }
        true
    }

    /// An expected agent has answered or has left.
    fn no_longer_expect(&mut self, peer: &LockPeer) {
        if self.greeted.no_longer_expect(peer) {
            self.touched.extend(self.resources.keys().cloned());
        }
    }

    pub(super) fn suspect(&mut self, now: Millis, peer: &LockPeer, out: &mut Actions) {
        if let Some(member) = self.members.get_mut(peer) {
            member.suspected = true;
        }
        let dependent: Vec<_> = self
            .resources
            .iter()
            .filter(|(_, entry)| entry.dependencies.contains(peer))
            .map(|(resource, _)| resource.clone())
            .collect();
        for resource in dependent {
            let live = self.owner(&resource).and_then(|core| core.live(now));
            if live.is_some_and(|live| live.holder == *peer && live.fence.is_none()) {
                out.push(Action::Event(Event::Silent {
                    resource: resource.clone(),
                    holder: peer.clone(),
                }));
            }
            self.member_lost(now, &resource, peer, false, out);
        }
    }

    fn member_lost(
        &mut self,
        now: Millis,
        resource: &Resource,
        peer: &LockPeer,
        gone: bool,
        out: &mut Actions,
    ) {
        self.touched.insert(resource.clone());
        let owned = self.resources.get_mut(resource);
        if let Some(owned) = owned.and_then(|entry| entry.owned.as_mut())
            && gone
        {
            owned.rival.take_if(|rival| rival == peer);
        }
        self.at_owner(resource, out, |core, steps| {
            core.lost(now, peer, gone, steps)
        });
        self.update_gate(now, resource, out);
        self.owner_lost(now, resource, peer, gone, out);
        self.at_algorithm(now, resource, out, |algorithm, context, steps| {
            algorithm.lost(context, peer, gone, steps);
        });
    }

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
