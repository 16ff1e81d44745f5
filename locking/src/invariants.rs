//! The invariants of locks, checked on the history of one resource and one owner.
//!
//! | number | invariant | checked by |
//! |---|---|---|
//! | 1 | Fences strictly rise over all lives of an owner with its state file, and on another host above those that agents have held; no fence is granted twice. | [`History`] |
//! | 2 | The owner has at most one live grant. | [`History`] |
//! | 3 | The owner admits a fence if and only if it is that of the live grant. | [`History`] |
//! | 4 | At no time do two agents hold the resource. | [`History`] |
//! | 5 | No answer revives a grant that has ended. | [`History`] |
//! | 6 | A release ends only the grant of its own conversation and sender. | [`History`] |
//! | 7 | No grant without an open request; none for a withdrawn one. | [`History`] |
//! | 8 | A claim of several resources holds all or none. | [`all_or_none`] |
//! | 9 | While a grant is live, the owner sends no agree and no token. | [`History`] |
//! | 10 | Every open request ends after the last fault. | the model and the simulation |
//! | 11 | After a request has reached all members, and while no process is killed or cut off, each other agent gets at most one grant before it, or two with a token. | [`Turns`] |
//! | 12 | A device that is not the owner admits no fence after one of a later grant. | the model |

use std::collections::{BTreeMap, BTreeSet};

use crate::{
    Act, Action, ClaimId, Content, Conversation, Ending, Event, Fence, LockMessage, LockPeer,
    Locks, Millis, MutualExclusion, Resource,
};

/// A broken invariant.
#[derive(Debug, Clone, PartialEq, Eq, Hash, thiserror::Error)]
#[error("invariant {number}: {text}")]
#[non_exhaustive]
pub struct Violation {
    /// Number of the invariant.
    pub number: u8,
    /// Description with the agents and fences that take part.
    pub text: String,
}

/// History of one resource that one agent name owns.
///
/// The caller records what the owner receives and does, and which agents hold the resource, in the
/// order of one clock. [`violation`](Self::violation) returns the first broken invariant.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct History {
    resource: Resource,
    owner: LockPeer,
    highest: (u64, u64),
    /// Highest fence that an agent has held.
    seen: (u64, u64),
    /// All fences that were granted.
    fences: BTreeSet<Fence>,
    live: Option<Live>,
    /// Reports that were received and neither granted nor released.
    confirmed: BTreeSet<(LockPeer, Conversation)>,
    /// Latest conversation that each agent released.
    released: BTreeMap<LockPeer, Conversation>,
    /// The message that the owner handles.
    handled: Option<(LockPeer, LockMessage)>,
    held: BTreeMap<LockPeer, Fence>,
    /// Agents that hold the resource without a fence.
    inside: BTreeSet<LockPeer>,
    /// Highest fence that an agent held and holds no more.
    highest_ended: (u64, u64),
    /// Whether the owner has forgotten a life.
    forgot: bool,
    violation: Option<Violation>,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Live {
    holder: LockPeer,
    conversation: Conversation,
    fence: Option<Fence>,
}

impl History {
    /// Creates the empty history of a resource and its owner.
    #[must_use]
    pub fn new(resource: Resource, owner: LockPeer) -> Self {
        Self {
            resource,
            owner,
            highest: (0, 0),
            seen: (0, 0),
            fences: BTreeSet::new(),
            live: None,
            confirmed: BTreeSet::new(),
            released: BTreeMap::new(),
            handled: None,
            held: BTreeMap::new(),
            inside: BTreeSet::new(),
            highest_ended: (0, 0),
            forgot: false,
            violation: None,
        }
    }

    /// The first broken invariant.
    #[must_use]
    pub fn violation(&self) -> Option<&Violation> {
        self.violation.as_ref()
    }

    /// Records a restart of the owner, with another registration.
    pub fn owner_restarted(&mut self, owner: LockPeer) {
        self.owner = owner;
        self.live = None;
        self.confirmed.clear();
        self.released.clear();
    }

    /// Records that the owner's next life is on another host, and knows only the fences that agents have
    /// held.
    pub fn owner_moved(&mut self) {
        self.highest = self.seen;
    }

    /// Records that the owner has forgotten its earlier lives, as its operator told it to. Its fences then
    /// differ from those of earlier lives, and have no order with them; holders of an earlier life do not
    /// count.
    pub fn owner_forgot(&mut self) {
        self.forgot = true;
        self.highest = (0, 0);
    }

    /// Records that a registration of an agent has ended, so that its conversations do not count any
    /// more.
    pub fn departed(&mut self, peer: &LockPeer) {
        self.confirmed.retain(|(from, _)| from != peer);
        self.released.remove(peer);
    }

    /// Records a message that the owner is about to handle.
    pub fn owner_receives(&mut self, from: &LockPeer, message: &LockMessage) {
        let Content::Lock { resource, act } = &message.content else {
            return;
        };
        if *resource != self.resource {
            return;
        }
        let request = (from.clone(), message.conversation.clone());
        match act {
            Act::Confirm { .. } | Act::Ask { .. } => {
                self.confirmed.insert(request);
            }
            Act::Release | Act::Token(_) => {
                self.confirmed.remove(&request);
                let latest = self.released.get(from);
                let is_late = |latest: &Conversation| message.conversation.is_not_after(latest);
                // A token is a report in the conversation of its sender's own request.
                let counts = matches!(act, Act::Release) || message.conversation.is_of(from);
                if counts && !latest.is_some_and(is_late) {
                    self.released.insert(request.0, request.1);
                }
            }
            _ => {}
        }
        self.handled = Some((from.clone(), message.clone()));
    }

    /// Records the actions of the owner that follow.
    pub fn owner_acts(&mut self, actions: &[Action]) {
        // The core reports the end of a grant before the messages that follow from it.
        for action in actions {
            match action {
                Action::Event(Event::Granted { resource, grant }) if *resource == self.resource => {
                    self.granted(grant);
                }
                Action::Event(Event::Ended {
                    resource,
                    grant,
                    how,
                }) if *resource == self.resource => self.ended(grant, *how),
                Action::Send { to, message } => self.sent(to, message),
                Action::Event(_) => {}
            }
        }
        self.handled = None;
    }

    fn granted(&mut self, grant: &crate::Grant) {
        let request = (grant.holder.clone(), grant.conversation.clone());
        if let Some(live) = &self.live {
            let text = format!("{grant:?} begins while {live:?} is live");
            self.break_invariant(2, text);
        }
        if let Some(fence) = &grant.fence {
            if fence.position() <= self.highest {
                self.break_invariant(1, format!("{fence} follows {:?}", self.highest));
            }
            if !self.fences.insert(fence.clone()) {
                self.break_invariant(1, format!("{fence} is granted twice"));
            }
            self.highest = self.highest.max(fence.position());
            // The owner reports to itself without messages.
            if grant.holder != self.owner && !self.confirmed.remove(&request) {
                self.break_invariant(7, format!("{grant:?} has no open request"));
            }
            let released = self.released.get(&grant.holder);
            if released.is_some_and(|released| grant.conversation.is_not_after(released)) {
                self.break_invariant(7, format!("{grant:?} was withdrawn"));
            }
        }
        self.live = Some(Live {
            holder: grant.holder.clone(),
            conversation: grant.conversation.clone(),
            fence: grant.fence.clone(),
        });
    }

    fn ended(&mut self, grant: &crate::Grant, how: Ending) {
        self.live = None;
        if how != Ending::Released || grant.holder == self.owner || grant.fence.is_none() {
            return;
        }
        let by_holder = self.handled.as_ref().is_some_and(|(from, message)| {
            let Content::Lock { act, .. } = &message.content else {
                return false;
            };
            *from == grant.holder
                && match act {
                    Act::Release | Act::Token(_) => message.conversation == grant.conversation,
                    Act::Confirm { .. } | Act::Ask { .. } => {
                        !message.conversation.is_not_after(&grant.conversation)
                    }
                    _ => false,
                }
        });
        if !by_holder {
            let text = format!("{grant:?} is released by {:?}", self.handled);
            self.break_invariant(6, text);
        }
    }

    fn sent(&mut self, to: &LockPeer, message: &LockMessage) {
        let Content::Lock { resource, act } = &message.content else {
            return;
        };
        let lets_enter = matches!(act, Act::Agree { .. } | Act::Token(_));
        if *resource == self.resource
            && lets_enter
            && self.live.as_ref().is_some_and(|live| live.fence.is_some())
        {
            self.break_invariant(9, format!("{act:?} to {to} while {:?} is live", self.live));
        }
    }

    /// Records a decision of the owner about a fence.
    pub fn admitted(&mut self, fence: &Fence, accepted: bool) {
        let live = self.live.as_ref().and_then(|live| live.fence.as_ref());
        if accepted != (live == Some(fence)) {
            let text = format!("{fence} is admitted: {accepted}, while {live:?} is live");
            self.break_invariant(3, text);
        }
    }

    /// Records whether an agent holds the resource, according to the agent itself. An agent that
    /// crashed holds nothing.
    pub fn holds(&mut self, agent: &LockPeer, fence: Option<&Fence>) {
        let Some(fence) = fence else {
            if let Some(fence) = self.held.remove(agent) {
                self.highest_ended = self.highest_ended.max(fence.position());
            }
            return;
        };
        let before = self.held.insert(agent.clone(), fence.clone());
        if before.as_ref() == Some(fence) {
            return;
        }
        self.seen = self.seen.max(fence.position());
        if let Some(before) = before {
            self.highest_ended = self.highest_ended.max(before.position());
        }
        if self.forgot {
            return;
        }
        if fence.position() <= self.highest_ended {
            let text = format!(
                "{agent} holds {fence} after {:?} has ended",
                self.highest_ended
            );
            self.break_invariant(5, text);
        }
        if self.held.len() > 1 {
            self.break_invariant(4, format!("held at the same time: {:?}", self.held));
        }
    }

    /// Records that a device admits a fence of grant `number` after one of grant `last`.
    pub fn admitted_by_device(&mut self, fence: &Fence, number: usize, last: Option<usize>) {
        if last.is_some_and(|last| number < last) {
            let text = format!("a device admits {fence} after the fence of a later grant");
            self.break_invariant(12, text);
        }
    }

    /// Records whether an agent holds the resource of an owner that gives no fences.
    pub fn holds_unfenced(&mut self, agent: &LockPeer, holds: bool) {
        if !holds {
            self.inside.remove(agent);
        } else if self.inside.insert(agent.clone()) && self.inside.len() > 1 {
            let text = format!("held at the same time without fences: {:?}", self.inside);
            self.break_invariant(4, text);
        }
    }

    /// Records the highest number of grants that an agent got before a request of another.
    pub fn overtaken(&mut self, turns: &Turns, bound: u64) {
        if turns.highest > bound {
            let text = format!("an agent got {} grants before another", turns.highest);
            self.break_invariant(11, text);
        }
    }

    fn break_invariant(&mut self, number: u8, text: String) {
        self.violation.get_or_insert(Violation { number, text });
    }
}

/// The grants of one resource that precede open requests.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Default)]
pub struct Turns {
    open: BTreeMap<LockPeer, Open>,
    highest: u64,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Open {
    /// Members that have not received the request.
    unreached: BTreeSet<LockPeer>,
    /// Grants of the other agents, by name, since the request has reached all members.
    grants: BTreeMap<String, u64>,
}

impl Turns {
    /// Records a request, and the members that it has to reach.
    pub fn requested(&mut self, by: &LockPeer, unreached: BTreeSet<LockPeer>) {
        let grants = BTreeMap::new();
        self.open.insert(by.clone(), Open { unreached, grants });
    }

    /// Records that a request has reached a member.
    pub fn reached(&mut self, by: &LockPeer, member: &LockPeer) {
        if let Some(open) = self.open.get_mut(by) {
            open.unreached.remove(member);
        }
    }

    /// Records that a request has reached its only receiver.
    pub fn reached_all(&mut self, by: &LockPeer) {
        if let Some(open) = self.open.get_mut(by) {
            open.unreached.clear();
        }
    }

    /// Records a grant.
    pub fn granted(&mut self, to: &LockPeer) {
        self.open.remove(to);
        let reached = self.open.values_mut();
        for open in reached.filter(|open| open.unreached.is_empty()) {
            let grants = open.grants.entry(to.name().to_owned()).or_default();
            *grants += 1;
            self.highest = self.highest.max(*grants);
        }
    }

    /// Records the end of a request without a grant.
    pub fn ended(&mut self, by: &LockPeer) {
        self.open.remove(by);
    }

    /// Records that a process is killed or cut off. The grants count from here on.
    pub fn disturbed(&mut self) {
        for open in self.open.values_mut() {
            open.grants.clear();
        }
    }

    /// Records that a registration has ended.
    pub fn departed(&mut self, peer: &LockPeer) {
        self.open.remove(peer);
        for open in self.open.values_mut() {
            open.unreached.remove(peer);
        }
    }

    /// The highest number of grants that an agent got before a request of another.
    #[must_use]
    pub fn highest(&self) -> u64 {
        self.highest
    }
}

/// Whether a claim holds all its resources or none (invariant 8), once it is acquired or has ended.
#[must_use]
pub fn all_or_none<A: MutualExclusion>(
    agent: &Locks<A>,
    now: Millis,
    claim: ClaimId,
    resources: &[Resource],
) -> bool {
    let held = resources
        .iter()
        .filter(|resource| agent.fence(now, claim, resource).is_some())
        .count();
    held == 0 || held == resources.len()
}
