//! The core of one agent: requester, member, owner and holder of any number of resources.

mod queued;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;

use crate::algorithm::{Context, Member, Step};
use crate::faults::fault;
use crate::greeted::Greeted;
use crate::holder::{Holder, HolderStep};
use crate::owner::{Ending, Grant, Owner, OwnerStep};
use crate::probes::{ProbeStep, Probes};
use crate::{
    Act, Algorithm, Content, Conversation, Fence, Gate, LockDialect, LockMessage, LockPeer, Millis,
    MutualExclusion, Options, OwnerState, Refusal, Resource,
};

/// Maximum number of members. Messages of further agents are ignored.
const MAX_MEMBERS: usize = 4096;
/// Maximum number of resources that messages of other agents add.
const MAX_FOREIGN: usize = 4096;
/// Maximum number of owners of a resource whose fences are kept.
const MAX_SEEN: usize = 16;
/// Number of ended registrations whose late messages are recognized.
const MAX_GONE: usize = 256;

/// A lock of one or several resources that this agent requests or holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct ClaimId(u64);

/// Result of a call of the core.
#[derive(Debug, Clone, PartialEq, Eq)]
#[allow(
    clippy::exhaustive_enums,
    reason = "the caller has to perform each action"
)]
pub enum Action {
    /// Send a message.
    Send {
        /// The receiver.
        to: LockPeer,
        /// The message.
        message: LockMessage,
    },
    /// Report an event to the application.
    Event(Event),
}

/// An event for the application.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum Event {
    /// The agent holds all resources of the claim.
    Acquired {
        /// The claim.
        claim: ClaimId,
    },
    /// The claim ended without a lock.
    Failed {
        /// The claim.
        claim: ClaimId,
        /// The resource that it waited for.
        resource: Resource,
        /// The reason.
        failure: Failure,
    },
    /// A resource of an acquired claim was lost, and the others were released.
    Lost {
        /// The claim.
        claim: ClaimId,
        /// The resource.
        resource: Resource,
    },
    /// This agent owns the resource: no other agent contradicted.
    Owning {
        /// The resource.
        resource: Resource,
    },
    /// This agent does not own the resource, because another agent does.
    OwningRefused {
        /// The resource.
        resource: Resource,
        /// The owner.
        by: LockPeer,
    },
    /// Another agent claims a resource that this agent owns. Each owner admits its own fences only.
    Contested {
        /// The resource.
        resource: Resource,
        /// The other agent.
        by: LockPeer,
    },
    /// This agent does not own the resource: no state file, clock, agent or device says which epoch is
    /// higher than those of its earlier lives.
    NoMemory {
        /// The resource.
        resource: Resource,
    },
    /// An owner's epoch has to rise. The caller stores [`OwnerState::raised`], and then calls
    /// [`Locks::stored`]. The owner grants nothing before.
    Raised {
        /// The resource.
        resource: Resource,
        /// The new epoch.
        epoch: u64,
    },
    /// Another agent uses another algorithm for a resource that this agent owns, and was refused.
    OtherAlgorithm {
        /// The resource.
        resource: Resource,
        /// The other agent.
        by: LockPeer,
        /// Its algorithm.
        algorithm: Algorithm,
    },
    /// This owner granted a resource.
    Granted {
        /// The resource.
        resource: Resource,
        /// The grant.
        grant: Grant,
    },
    /// A grant of this owner ended.
    Ended {
        /// The resource.
        resource: Resource,
        /// The grant.
        grant: Grant,
        /// The reason.
        how: Ending,
    },
    /// A legacy agent that holds a resource of this owner does not answer. [`Locks::force`] ends its
    /// grant.
    Silent {
        /// The resource.
        resource: Resource,
        /// The holder.
        holder: LockPeer,
    },
}

/// Reason of a failed claim.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Failure {
    /// No agent owns the resource.
    #[error("no agent owns the resource; start its owner")]
    NoOwner,
    /// The time of the claim is over, and no owner of the resource has been found yet.
    #[error("timed out; no owner of the resource was found, so start its owner")]
    OwnerNotFound,
    /// The owner is lost.
    #[error("the owner {owner} does not answer")]
    Unreachable {
        /// The owner.
        owner: LockPeer,
    },
    /// The time of the claim is over.
    #[error("timed out with an estimated {ahead} requests ahead")]
    TimedOut {
        /// Estimate of the number of requests that would have been served before.
        ahead: usize,
    },
    /// The owner refuses.
    #[error("the owner refuses: {0}")]
    Refused(Refusal),
    /// The owner names another algorithm than the one that this agent was told to use.
    #[error("the owner uses the algorithm {owner}, and this agent was told to use {here}")]
    Algorithm {
        /// MutualExclusion of the owner.
        owner: Algorithm,
        /// MutualExclusion of this agent.
        here: Algorithm,
    },
    /// A resource of the claim was lost before all were acquired.
    #[error("the lock of another resource of the claim was lost")]
    Lost,
}

/// State of a resource, as this agent sees it.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct LockStatus {
    /// The resource.
    pub resource: Resource,
    /// Its owner, if known.
    pub owner: Option<LockPeer>,
    /// The live grant, at the owner.
    pub grant: Option<Grant>,
    /// Agents that wait for a grant, at the owner.
    pub waiters: Vec<LockPeer>,
    /// At the owner: another agent that claims the resource.
    pub rival: Option<LockPeer>,
    /// Whether this agent holds the resource.
    pub is_held: bool,
    /// Number of claims of this agent that wait for the resource.
    pub claims: usize,
}

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
    gate: Gate,
    algorithm: A,
    waiting: VecDeque<ClaimId>,
    current: Option<Current>,
    dependencies: BTreeSet<LockPeer>,
    due: Option<Millis>,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Owned {
    core: Owner,
    /// End of the time in which an existing owner may contradict.
    claim_until: Option<Millis>,
    needs_report: bool,
    /// Another agent that claims the resource.
    rival: Option<LockPeer>,
}

/// The claim of this agent that takes part in the algorithm.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Current {
    claim: ClaimId,
    phase: Phase,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
enum Phase {
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

/// A claim acquires its resources in the order of their names.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Claim {
    resources: Vec<Resource>,
    /// Number of resources that are held. The next one is requested.
    held: usize,
    deadline: Option<Millis>,
}

impl Claim {
    fn is_acquired(&self) -> bool {
        self.held == self.resources.len()
    }

    fn wanted(&self) -> Option<&Resource> {
        self.resources.get(self.held)
    }
}

use queued::Former;

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

    // ----- claims

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
    /// ([`Options::retry`]), or at once if the resource is in use here.
    pub fn try_lock(&mut self, now: Millis, resource: &Resource, out: &mut Actions) -> ClaimId {
        let busy = self.resources.get(resource).is_some_and(|entry| {
            entry.current.is_some() || !entry.waiting.is_empty() || entry.gate == Gate::Closed
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

    // ----- owner

    /// Begins to own a resource, with a state that the caller has written and synced.
    ///
    /// [`Event::Owning`] follows after [`Options::claim`], or [`Event::OwningRefused`] if another agent
    /// owns the resource. Nothing happens if this agent owns it already.
    pub fn own(&mut self, now: Millis, resource: &Resource, state: &OwnerState, out: &mut Actions) {
        self.own_with_lease(now, resource, state, self.options.lease, out);
    }

    /// Begins to own a resource, and grants it with this lease instead of [`Options::lease`]. The state
    /// has to be for leases of at least this time; see [`own`](Self::own).
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
        let was_silent = owned.core.gate() == Gate::Closed;
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

    /// Records a fence that a device of this agent has admitted. With `tell`, tells its owner: the device
    /// refuses a grant of it for this fence ([`NotAdmitted::OtherRun`](crate::NotAdmitted::OtherRun)).
    ///
    /// An owner that starts asks for the highest recorded fence, in order to grant higher ones.
    pub fn saw(&mut self, now: Millis, fence: &Fence, tell: bool, out: &mut Actions) {
        let Ok(resource) = Resource::new(fence.resource()) else {
            return;
        };
        self.entry(&resource);
        self.remember(fence);
        if tell {
            self.tell(now, fence, &resource, out);
        }
        self.settle(now, out);
    }

    /// Keeps a fence if it is the highest one of its owner. Of two runs with the same epoch, it keeps the
    /// first one, as a device does.
    fn remember(&mut self, fence: &Fence) {
        let entry = Resource::new(fence.resource())
            .ok()
            .and_then(|resource| self.resources.get_mut(&resource));
        let Some(entry) = entry else {
            return;
        };
        let count = entry.seen.len();
        match entry.seen.get_mut(fence.owner()) {
            Some(seen) if seen.run() != fence.run() && fence.epoch() <= seen.epoch() => {}
            Some(seen) if fence.position() > seen.position() => *seen = fence.clone(),
            None if count < MAX_SEEN => {
                drop(entry.seen.insert(fence.owner().into(), fence.clone()))
            }
            Some(_) | None => {}
        }
    }

    /// Tells an owner the highest fence of it that was seen here.
    fn tell_seen(&mut self, now: Millis, owner: &LockPeer, resource: &Resource, out: &mut Actions) {
        let entry = self.resources.get(resource);
        let seen = entry.and_then(|entry| entry.seen.get(owner.shared_name()));
        if let Some(fence) = seen.cloned() {
            self.report_to(now, owner.clone(), &fence, resource, out);
        }
    }

    /// Tells a fence to its owner.
    fn tell(&mut self, now: Millis, fence: &Fence, resource: &Resource, out: &mut Actions) {
        if fence.owner() == self.me.name() {
            self.at_owner(resource, out, |core, _| core.seen(now, fence));
        } else if let Some(owner) = self.owner_of(resource).cloned()
            && owner.name() == fence.owner()
        {
            self.report_to(now, owner, fence, resource, out);
        }
    }

    fn report_to(
        &mut self,
        now: Millis,
        owner: LockPeer,
        fence: &Fence,
        resource: &Resource,
        out: &mut Actions,
    ) {
        let dialect = self.members.get(&owner).map(|member| member.dialect);
        if dialect == Some(LockDialect::Own) {
            let act = Act::Seen {
                fence: fence.clone(),
            };
            let conversation = self.side_conversation("fence", now);
            self.send(owner, resource, conversation, act, out);
        }
    }

    /// Whether a command with this fence is carried out: only with the fence of the live grant of this
    /// owner.
    #[must_use]
    pub fn admit(&self, now: Millis, resource: &Resource, fence: &Fence) -> bool {
        self.owner(resource)
            .is_some_and(|core| core.admit(now, fence))
    }

    /// Ends the live grant of a resource, for a legacy holder that does not answer.
    pub fn force(&mut self, now: Millis, resource: &Resource, out: &mut Actions) {
        self.at_owner(resource, out, |core, steps| core.force(now, steps));
        self.settle(now, out);
    }

    /// The owner's core, if this agent owns the resource.
    #[must_use]
    pub fn owner(&self, resource: &Resource) -> Option<&Owner> {
        Some(&self.resources.get(resource)?.owned.as_ref()?.core)
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

    // ----- members

    /// Adds a member, or updates its dialect.
    pub fn join(&mut self, now: Millis, peer: &LockPeer, dialect: LockDialect, out: &mut Actions) {
        self.admit_member(now, peer, dialect, out);
        self.settle(now, out);
    }

    /// Has the first request of this agent wait for a message of another agent, which the caller has asked for a sign
    /// of life. It waits for [`Options::retry`] from the first call on at most. Agents that use locks answer,
    /// and become members.
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

    // ----- input

    /// Asks an agent for a sign of life.
    pub fn probe(&mut self, now: Millis, to: LockPeer, out: &mut Actions) {
        let message = LockMessage {
            conversation: self.side_conversation("probe", now),
            dialect: LockDialect::Own,
            algorithm: None,
            content: Content::Probe,
        };
        out.push(Action::Send { to, message });
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
        self.probes.heard(now, &self.options, from);
        self.dispatch(now, from, message, out);
        // The message may be the withdrawal of the request that waits.
        if was_suspected {
            self.heard_again(now, from, out);
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
                let algorithm = message.algorithm;
                match act {
                    Act::Query { .. } | Act::Owned | Act::Contested => {
                        self.discover(now, from, resource, conversation, (act, algorithm), out);
                    }
                    Act::Seen { fence } => {
                        self.at_owner(resource, out, |core, _| core.seen(now, fence));
                    }
                    Act::Ask { .. } | Act::Confirm { .. } | Act::Renew { .. } | Act::Release => {
                        self.for_owner(now, from, resource, conversation, act, out);
                    }
                    Act::Granted { .. } | Act::Refused { .. } => {
                        self.for_holder(now, from, resource, conversation, act, out);
                    }
                    Act::Place { .. }
                    | Act::Request { .. }
                    | Act::Agree { .. }
                    | Act::RequestToken { .. }
                    | Act::Token(_) => {
                        self.for_algorithm(
                            now,
                            from,
                            resource,
                            conversation,
                            (act, algorithm),
                            out,
                        );
                    }
                }
            }
        }
    }

    fn discover(
        &mut self,
        now: Millis,
        from: &LockPeer,
        resource: &Resource,
        conversation: &Conversation,
        (act, algorithm): (&Act, Option<Algorithm>),
        out: &mut Actions,
    ) {
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

    fn for_owner(
        &mut self,
        now: Millis,
        from: &LockPeer,
        resource: &Resource,
        conversation: &Conversation,
        act: &Act,
        out: &mut Actions,
    ) {
        let owns = self.owner(resource).is_some();
        let has_token = self.kind_of(resource).has_token();
        match act {
            Act::Ask { asked, place } if owns => self.at_owner(resource, out, |core, steps| {
                core.ask(now, from, conversation, (*asked, *place), steps);
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

    fn for_holder(
        &mut self,
        now: Millis,
        from: &LockPeer,
        resource: &Resource,
        conversation: &Conversation,
        act: &Act,
        out: &mut Actions,
    ) {
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

    fn for_algorithm(
        &mut self,
        now: Millis,
        from: &LockPeer,
        resource: &Resource,
        conversation: &Conversation,
        (act, algorithm): (&Act, Option<Algorithm>),
        out: &mut Actions,
    ) {
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

    // ----- members, inside

    /// Returns whether the agent is a member.
    fn admit_member(
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

    fn suspect(&mut self, now: Millis, peer: &LockPeer, out: &mut Actions) {
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

    /// Handles the loss of an agent, if it owns the resource.
    fn owner_lost(
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

    // ----- claims, inside

    /// Adds a claim to the waiting ones of the resource that it wants next.
    fn enqueue(&mut self, id: ClaimId, out: &mut Actions) {
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
    fn drop_claim(&mut self, now: Millis, id: ClaimId, out: &mut Actions) -> Option<Claim> {
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

    fn fail(&mut self, now: Millis, id: ClaimId, failure: Failure, out: &mut Actions) {
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

    fn time_out(&mut self, now: Millis, id: ClaimId, out: &mut Actions) {
        let wanted = self.claims.get(&id).and_then(Claim::wanted);
        let entry = wanted.and_then(|resource| self.resources.get(resource));
        if entry.is_some_and(|entry| entry.owner.is_none()) {
            return self.fail(now, id, Failure::OwnerNotFound, out);
        }
        let ahead = entry.map_or(0, |entry| {
            let position = entry.waiting.iter().position(|waiting| *waiting == id);
            let current = usize::from(position.is_some() && entry.current.is_some());
            position.unwrap_or(0) + current + entry.algorithm.ahead()
        });
        self.fail(now, id, Failure::TimedOut { ahead }, out);
    }

    fn start(&mut self, now: Millis, resource: &Resource, out: &mut Actions) {
        let retry = now.saturating_add(self.options.retry);
        let until = now.saturating_add(self.options.discovery);
        let conversation = Conversation::new(self.me.shared_name().clone(), self.next_conversation);
        let (here, accepts) = (self.kind, self.accepts(self.kind_of(resource)));
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
            return self.fail(now, claim, Failure::Algorithm { owner, here }, out);
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
    fn entered(&mut self, now: Millis, resource: &Resource, out: &mut Actions) {
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
    fn end_current(&mut self, now: Millis, resource: &Resource, out: &mut Actions) {
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
    fn ask_again(&mut self, now: Millis, resource: &Resource, out: &mut Actions) {
        let current = self.resources.get(resource);
        let current = current.and_then(|entry| entry.current.as_ref());
        let Some(claim) = current.map(|current| current.claim) else {
            return;
        };
        self.end_current(now, resource, out);
        self.entry(resource).waiting.push_front(claim);
        self.touched.insert(resource.clone());
    }

    fn perform_holder(
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

    // ----- timeouts, inside

    fn time_out_resource(&mut self, now: Millis, resource: &Resource, out: &mut Actions) {
        let Some(entry) = self.resources.get(resource) else {
            return;
        };
        let current = entry.current.as_ref().map(|current| current.claim);
        let waiting = entry.waiting.iter().copied().chain(current);
        let over: Vec<_> = waiting
            .filter(|claim| {
                self.claims.get(claim).is_some_and(|claim| {
                    claim.wanted() == Some(resource)
                        && claim.deadline.is_some_and(|deadline| deadline <= now)
                })
            })
            .collect();
        for claim in over {
            self.time_out(now, claim, out);
        }
        self.end_of_claim(now, resource, out);
        self.at_owner(resource, out, |core, steps| core.handle_timeout(now, steps));
        self.update_gate(now, resource, out);
        self.at_algorithm(now, resource, out, |algorithm, context, steps| {
            algorithm.handle_timeout(context, steps);
        });
        self.time_out_current(now, resource, out);
    }

    fn time_out_current(&mut self, now: Millis, resource: &Resource, out: &mut Actions) {
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

    /// Ends the time in which an existing owner may contradict.
    fn end_of_claim(&mut self, now: Millis, resource: &Resource, out: &mut Actions) {
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

    // ----- inside

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

    fn update_gate(&mut self, now: Millis, resource: &Resource, out: &mut Actions) {
        let Some(entry) = self.resources.get_mut(resource) else {
            return;
        };
        let owned = entry.owned.as_ref();
        let gate = owned.map_or(Gate::Open, |owned| owned.core.gate());
        if gate != entry.gate {
            entry.gate = gate;
            self.at_algorithm(now, resource, out, |algorithm, context, steps| {
                algorithm.gate_changed(context, steps);
            });
        }
    }

    /// Updates the timer and the dependencies of a resource.
    fn update_entry(&mut self, now: Millis, resource: &Resource) {
        let due = self.due(resource);
        let dependencies = self.dependencies(now, resource);
        let Some(entry) = self.resources.get_mut(resource) else {
            return;
        };
        if entry.due != due {
            if let Some(old) = entry.due {
                self.timers.remove(&(old, resource.clone()));
            }
            entry.due = due;
            self.timers.extend(due.map(|due| (due, resource.clone())));
        }
        let before = std::mem::replace(&mut entry.dependencies, dependencies);
        for peer in entry.dependencies.difference(&before) {
            self.probes.depend(now, &self.options, peer);
        }
        for peer in before.difference(&entry.dependencies) {
            self.probes.no_longer_depend(peer);
        }
    }

    fn due(&self, resource: &Resource) -> Option<Millis> {
        let entry = self.resources.get(resource)?;
        let owned = entry.owned.as_ref();
        let current = entry.current.as_ref();
        let of_current = current.and_then(|current| match &current.phase {
            Phase::Discovering { until, next } => Some(*until.min(next)),
            Phase::Requesting { next, .. } => entry.kind.is_extended().then_some(*next),
            Phase::Entered { holder, .. } => holder.poll_timeout(),
        });
        let claims = entry
            .waiting
            .iter()
            .chain(current.map(|current| &current.claim));
        let deadlines = claims.filter_map(|claim| {
            let claim = self.claims.get(claim)?;
            claim.deadline.filter(|_| claim.wanted() == Some(resource))
        });
        deadlines
            .chain(of_current)
            .chain(owned.and_then(|owned| owned.claim_until))
            .chain(owned.and_then(|owned| owned.core.poll_timeout()))
            .chain(entry.algorithm.poll_timeout())
            .min()
    }

    /// Agents whose loss changes the state of a resource here.
    fn dependencies(&self, now: Millis, resource: &Resource) -> BTreeSet<LockPeer> {
        let Some(entry) = self.resources.get(resource) else {
            return BTreeSet::new();
        };
        let mut peers = entry.algorithm.awaited();
        if let Some(owned) = &entry.owned {
            peers.extend(owned.core.waiters().cloned());
            peers.extend(owned.core.live(now).map(|grant| grant.holder.clone()));
        }
        if let Some(current) = &entry.current
            && entry.kind.is_extended()
        {
            match &current.phase {
                Phase::Discovering { .. } => {}
                Phase::Requesting { .. } => peers.extend(entry.owner.clone()),
                // The answers to renewals are signs of life.
                Phase::Entered { owner, holder } => {
                    if holder.is_unfenced() || !holder.is_held(now) {
                        peers.insert(owner.clone());
                    }
                }
            }
        }
        peers.remove(&self.me);
        peers
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
                gate: Gate::Open,
                algorithm: A::new(kind, me.clone(), false),
                waiting: VecDeque::new(),
                current: None,
                dependencies: BTreeSet::new(),
                due: None,
            })
    }

    fn at_owner(
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

    fn at_algorithm(
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

    fn algorithm_steps(
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

    fn perform(&mut self, now: Millis, resource: &Resource, steps: Vec<Step>, out: &mut Actions) {
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

    fn query_all(&mut self, now: Millis, resource: &Resource, claim: bool, out: &mut Actions) {
        let conversation = self.side_conversation("discover", now);
        let members: Vec<_> = self.members.keys().cloned().collect();
        for member in members {
            let act = Act::Query { claim };
            self.send(member, resource, conversation.clone(), act, out);
        }
    }

    fn send(
        &mut self,
        to: LockPeer,
        resource: &Resource,
        conversation: Conversation,
        act: Act,
        out: &mut Actions,
    ) {
        let kind = self.kind_of(resource);
        self.send_in(kind, to, resource, conversation, act, out);
    }

    /// Sends a message of an algorithm.
    fn send_in(
        &mut self,
        kind: Algorithm,
        to: LockPeer,
        resource: &Resource,
        conversation: Conversation,
        act: Act,
        out: &mut Actions,
    ) {
        let message = LockMessage {
            conversation,
            dialect: LockDialect::Own,
            algorithm: self.algorithm_in(&act, kind, &to),
            content: Content::Lock {
                resource: resource.clone(),
                act,
            },
        };
        if to == self.me {
            self.local.push_back(message);
        } else {
            out.push(Action::Send { to, message });
        }
    }

    /// A conversation beside those of requests. Its number is the time, or the next one that is free.
    fn side_conversation(&mut self, kind: &str, now: Millis) -> Conversation {
        let number = now.max(self.next_side_conversation);
        self.next_side_conversation = number.saturating_add(1);
        let prefix: Arc<str> = format!("{}_{kind}", self.me.name()).into();
        Conversation::new(prefix, number)
    }

    #[cfg(test)]
    fn probed(&mut self, now: Millis, from: &LockPeer) {
        for entry in self.resources.values_mut() {
            if let Some(Current {
                phase: Phase::Entered { owner, holder },
                ..
            }) = &mut entry.current
                && owner == from
            {
                holder.probed(now);
            }
        }
    }

    /// Moves all times back, so that equal situations at different times are equal states.
    #[cfg(test)]
    pub(crate) fn rebase(&mut self, by: Millis) {
        let back = |time: &mut Millis| *time = time.saturating_sub(by);
        // States that differ in names of conversations alone are equal.
        self.next_side_conversation = 0;
        self.probes.rebase(by);
        self.greeted.rebase(by);
        for claim in self.claims.values_mut() {
            claim.deadline.iter_mut().for_each(back);
        }
        self.timers = std::mem::take(&mut self.timers)
            .into_iter()
            .map(|(due, resource)| (due.saturating_sub(by), resource))
            .collect();
        for entry in self.resources.values_mut() {
            entry.due.iter_mut().for_each(back);
            entry.algorithm.rebase(by);
            if let Some(owned) = &mut entry.owned {
                owned.core.rebase(by);
                owned.claim_until.iter_mut().for_each(back);
            }
            match entry.current.as_mut().map(|current| &mut current.phase) {
                Some(Phase::Discovering { until, next }) => {
                    back(until);
                    back(next);
                }
                Some(Phase::Requesting { next, .. }) => back(next),
                Some(Phase::Entered { holder, .. }) => holder.rebase(by),
                None => {}
            }
        }
    }
}
