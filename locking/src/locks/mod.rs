//! The core of one agent: requester, member, owner and holder of any number of resources.

mod algorithm_choice;
mod claim;
mod claims;
mod discovery;
mod event;
mod lost_owner;
mod members;
mod mutual_exclusion;
mod owning;
#[cfg(test)]
mod rebase;
mod request;
mod seen;
mod sending;
mod timers;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;

use self::claim::Claim;
use self::lost_owner::Former;
use self::owning::Owned;
use self::request::{Current, Phase};
use crate::algorithm::Member;
use crate::greeted::Greeted;
use crate::probes::{ProbeStep, Probes};
use crate::{
    Act, Algorithm, Content, Conversation, Fence, LockDialect, LockMessage, LockPeer, Millis,
    MutualExclusion, Options, OwnerGate, Resource,
};

pub use self::claim::ClaimId;
pub use self::event::{Action, Event, Failure, LockStatus};

/// Maximum number of resources that messages of other agents add.
const MAX_FOREIGN: usize = 4096;

/// The core of one agent.
///
/// All methods take the current time, and add to the actions that the caller has to perform in order.
/// After each call, the next call of [`handle_timeout`](Self::handle_timeout) is due at
/// [`poll_timeout`](Self::poll_timeout).
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Locks<A> {
    me: LockPeer,
    kind: Algorithm,
    options: Options,
    members: BTreeMap<LockPeer, Member>,
    gone: VecDeque<LockPeer>,
    greeted: Greeted,
    resources: BTreeMap<Resource, Entry<A>>,
    claims: BTreeMap<ClaimId, Claim>,
    probes: Probes,
    timers: BTreeSet<(Millis, Resource)>,
    /// Highest clock of the requests that were answered while there was no state for their resource.
    clock: u64,
    next_conversation: u64,
    next_side_conversation: u64,
    next_claim: u64,
    /// Messages of this agent to itself. Empty between calls.
    local: VecDeque<LockMessage>,
    /// Resources whose state has changed. Empty between calls.
    touched: BTreeSet<Resource>,
}

/// A message about a resource.
#[derive(Debug, Clone, Copy)]
struct Received<'a> {
    from: &'a LockPeer,
    resource: &'a Resource,
    conversation: &'a Conversation,
    algorithm: Option<Algorithm>,
    act: &'a Act,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Entry<A> {
    owner: Option<LockPeer>,
    owned: Option<Owned>,
    /// Highest fence of each owner that this agent or a device of it has seen.
    seen: BTreeMap<Arc<str>, Fence>,
    /// The algorithm, which the owner names.
    kind: Algorithm,
    /// The request that waited at an owner that is lost.
    former: Option<Former>,
    /// The gate that the algorithm was told.
    gate: OwnerGate,
    algorithm: A,
    waiting: VecDeque<ClaimId>,
    current: Option<Current>,
    dependencies: BTreeSet<LockPeer>,
    due: Option<Millis>,
}

type Actions = Vec<Action>;

impl<A: MutualExclusion> Locks<A> {
    /// Creates the core of an agent without members and resources.
    #[must_use]
    pub fn new(me: LockPeer, kind: Algorithm, options: Options) -> Self {
        Self {
            me,
            kind,
            options,
            members: BTreeMap::new(),
            gone: VecDeque::new(),
            greeted: Greeted::default(),
            resources: BTreeMap::new(),
            claims: BTreeMap::new(),
            probes: Probes::default(),
            timers: BTreeSet::new(),
            clock: 0,
            next_conversation: options.first_conversation,
            next_side_conversation: 0,
            next_claim: 0,
            local: VecDeque::new(),
            touched: BTreeSet::new(),
        }
    }

    /// This agent.
    #[must_use]
    pub fn me(&self) -> &LockPeer {
        &self.me
    }

    /// The algorithm that this agent was told to use. With the owner's queue, it uses the algorithm that the owner of
    /// each resource names.
    #[must_use]
    pub fn kind(&self) -> Algorithm {
        self.kind
    }

    /// The other members.
    pub fn members(&self) -> impl Iterator<Item = &LockPeer> {
        self.members.keys()
    }

    /// Whether this registration is a member.
    #[must_use]
    pub fn is_member(&self, peer: &LockPeer) -> bool {
        self.members.contains_key(peer)
    }

    /// Owner of a resource, if it is known.
    #[must_use]
    pub fn owner_of(&self, resource: &Resource) -> Option<&LockPeer> {
        self.resources.get(resource)?.owner.as_ref()
    }

    /// State of all resources.
    pub fn status(&self, now: Millis) -> impl Iterator<Item = LockStatus> {
        self.resources.iter().map(move |(resource, entry)| {
            let core = entry.owned.as_ref().map(|owned| &owned.core);
            let current = entry.current.as_ref();
            let is_held = current.is_some_and(|current| match &current.phase {
                Phase::Entered { holder, .. } => holder.is_held(now),
                Phase::Discovering { .. } | Phase::Requesting { .. } => false,
            });
            LockStatus {
                resource: resource.clone(),
                owner: entry.owner.clone(),
                grant: core.and_then(|core| core.live(now)).cloned(),
                waiters: core
                    .map(|core| core.waiters().cloned().collect())
                    .unwrap_or_default(),
                rival: entry.owned.as_ref().and_then(|owned| owned.rival.clone()),
                is_held,
                claims: entry.waiting.len() + usize::from(current.is_some() && !is_held),
            }
        })
    }

    /// Handles a message. `from` is the sender, as far as its connection proves it.
    pub fn handle(
        &mut self,
        now: Millis,
        from: &LockPeer,
        message: &LockMessage,
        out: &mut Actions,
    ) {
        let was_suspected = self
            .members
            .get(from)
            .is_some_and(|member| member.suspected);
        if *from == self.me || !self.admit_member(now, from, message.dialect, out) {
            return;
        }
        self.probes.sign_of_life(now, &self.options, from);
        self.dispatch(now, from, message, out);
        // The message may be the withdrawal of the request that waits.
        if was_suspected {
            self.alive_again(now, from, out);
        }
        self.settle(now, out);
    }

    /// Handles the end of all timeouts that are due.
    pub fn handle_timeout(&mut self, now: Millis, out: &mut Actions) {
        if self.greeted.handle_timeout(now) {
            self.touched.extend(self.resources.keys().cloned());
        }
        let due: Vec<_> = self
            .timers
            .iter()
            .take_while(|(due, _)| *due <= now)
            .map(|(_, resource)| resource.clone())
            .collect();
        for resource in due {
            self.time_out_resource(now, &resource, out);
            self.touched.insert(resource);
        }
        for step in self.probes.handle_timeout(now, &self.options) {
            match step {
                ProbeStep::Send(peer) => self.probe(now, peer, out),
                ProbeStep::Lost(peer) => self.suspect(now, &peer, out),
            }
        }
        self.settle(now, out);
    }

    /// Time of the next timeout.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Millis> {
        let timer = self.timers.first().map(|(due, _)| *due);
        timer
            .into_iter()
            .chain(self.probes.poll_timeout())
            .chain(self.greeted.poll_timeout())
            .min()
    }

    fn dispatch(&mut self, now: Millis, from: &LockPeer, message: &LockMessage, out: &mut Actions) {
        let conversation = &message.conversation;
        match &message.content {
            Content::Probe => {
                #[cfg(test)]
                self.probed(now, from);
                let answer = LockMessage {
                    conversation: conversation.clone(),
                    dialect: LockDialect::Own,
                    algorithm: None,
                    content: Content::Alive,
                };
                let to = from.clone();
                out.push(Action::Send {
                    to,
                    message: answer,
                });
            }
            Content::Alive => {}
            Content::Lock { resource, act } => {
                if self.resources.contains_key(resource) {
                    self.touched.insert(resource.clone());
                }
                if self.is_refused(from, message, out) {
                    return;
                }
                let received = Received {
                    from,
                    resource,
                    conversation,
                    algorithm: message.algorithm,
                    act,
                };
                match act {
                    Act::Query { .. } | Act::Owned | Act::Contested => {
                        self.discover(now, received, out);
                    }
                    Act::Seen { fence } => {
                        self.at_owner(resource, out, |core, _| core.seen(now, fence));
                    }
                    Act::Ask { .. } | Act::Confirm { .. } | Act::Renew { .. } | Act::Release => {
                        self.for_owner(now, received, out);
                    }
                    Act::Granted { .. } | Act::Refused { .. } => {
                        self.for_holder(now, received, out);
                    }
                    Act::Place { .. }
                    | Act::Request { .. }
                    | Act::Agree { .. }
                    | Act::RequestToken { .. }
                    | Act::Token(_) => {
                        self.for_algorithm(now, received, out);
                    }
                }
            }
        }
    }

    /// Brings all touched resources into a state in which only messages and time change something.
    fn settle(&mut self, now: Millis, out: &mut Actions) {
        // Each local message and each start consumes a message or a waiting claim.
        loop {
            if let Some(message) = self.local.pop_front() {
                let me = self.me.clone();
                self.dispatch(now, &me, &message, out);
                continue;
            }
            let Some(resource) = self.touched.pop_first() else {
                return;
            };
            self.update_gate(now, &resource, out);
            self.start(now, &resource, out);
            if self.local.is_empty() && !self.touched.contains(&resource) {
                self.update_entry(now, &resource);
            } else {
                self.touched.insert(resource);
            }
        }
    }

    fn entry(&mut self, resource: &Resource) -> &mut Entry<A> {
        let (kind, me) = (self.kind, &self.me);
        self.resources
            .entry(resource.clone())
            .or_insert_with(|| Entry {
                owner: None,
                owned: None,
                seen: BTreeMap::new(),
                kind,
                former: None,
                gate: OwnerGate::Open,
                algorithm: A::new(kind, me.clone(), false),
                waiting: VecDeque::new(),
                current: None,
                dependencies: BTreeSet::new(),
                due: None,
            })
    }
}
