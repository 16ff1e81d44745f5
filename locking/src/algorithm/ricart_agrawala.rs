//! Ricart-Agrawala: an agent enters when each member has agreed.
//!
//! A member defers its answer while it has entered, and while its own request is earlier. Requests
//! are ordered by their Lamport clock, then by agent.
//!
//! After a request has reached all members, each other agent enters at most once before it: the clock
//! of its next request is higher.
//!
//! A member that joins during a request is asked, too, in both forms. Agents of this library thus exclude each
//! other as soon as one of them knows the other. An agent of `distributed_locking` asks only those that it knows when
//! it begins its request, and agrees to an earlier request of any other agent. Such a request is
//! recognized by the clock of the agreement, and this agent then asks again, with a later clock.

use std::collections::{BTreeMap, BTreeSet};

use super::{Algorithm, Context, MutualExclusion, Step};
use crate::faults::fault;
use crate::{Act, Conversation, LockDialect, LockPeer, Millis, OwnerGate};

/// Maximum clock: `distributed_locking` reads a 32-bit integer. Clocks that have reached it are equal,
/// and the order is that of the agents.
const MAX_CLOCK: u64 = i32::MAX as u64;

/// State of one agent for one resource.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct RicartAgrawala {
    me: LockPeer,
    extended: bool,
    /// Highest clock that was sent or received.
    clock: u64,
    own: Option<OwnRequest>,
    deferred: BTreeMap<LockPeer, Deferred>,
    /// Members of `distributed_locking` that have asked this agent, or were asked again.
    acquainted: BTreeSet<LockPeer>,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct OwnRequest {
    conversation: Conversation,
    clock: u64,
    /// Members that have not agreed. The request has entered when there are none.
    awaited: BTreeSet<LockPeer>,
    entered: bool,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Deferred {
    conversation: Conversation,
    clock: u64,
}

impl RicartAgrawala {
    /// Whether the request of this agent precedes that of `peer`.
    fn precedes(&self, peer: &LockPeer, clock: u64) -> bool {
        self.own
            .as_ref()
            .is_some_and(|own| own.entered || (own.clock, &self.me) < (clock, peer))
    }

    /// Answers the deferred requests that nothing holds back any more.
    fn answer_deferred(&mut self, context: &Context<'_>, out: &mut Vec<Step>) {
        let deferred = std::mem::take(&mut self.deferred);
        for (peer, request) in deferred {
            if self.precedes(&peer, request.clock)
                || !context.gate.lets_pass(context.dialect(&peer))
            {
                self.deferred.insert(peer, request);
            } else {
                out.push(self.agree(peer, request.conversation));
            }
        }
    }

    /// Whether the agent that agrees may have an open request later than that of this agent, without having asked
    /// this agent.
    fn may_be_a_rival(&self, context: &Context<'_>, from: &LockPeer, clock: u64) -> bool {
        let own = self.own.as_ref();
        // An agent of `distributed_locking` agrees with the higher one of both clocks and 2. Of two requests with
        // the same clock, that of the lower agent is earlier.
        let is_later = own.is_some_and(|own| {
            let least = own
                .clock
                .saturating_add(if self.me < *from { 2 } else { 3 });
            !own.entered && own.clock < MAX_CLOCK && clock >= least
        });
        is_later
            && context.dialect(from) == LockDialect::Legacy
            && !self.acquainted.contains(from)
            && !fault!(context.fault, TrustStranger)
    }

    fn agree(&self, to: LockPeer, conversation: Conversation) -> Step {
        let clock = self.clock;
        Step::Send {
            to,
            conversation,
            act: Act::Agree { clock },
        }
    }

    fn ask(own: &OwnRequest, to: &LockPeer) -> Step {
        Step::Send {
            to: to.clone(),
            conversation: own.conversation.clone(),
            act: Act::Request { clock: own.clock },
        }
    }

    fn no_longer_awaited(&mut self, peer: &LockPeer, out: &mut Vec<Step>) {
        if let Some(own) = &mut self.own
            && own.awaited.remove(peer)
            && own.awaited.is_empty()
            && !own.entered
        {
            own.entered = true;
            out.push(Step::Entered);
        }
    }
}

impl MutualExclusion for RicartAgrawala {
    fn new(kind: Algorithm, me: LockPeer, _: bool) -> Self {
        Self {
            me,
            extended: kind.is_extended(),
            clock: 0,
            own: None,
            deferred: BTreeMap::new(),
            acquainted: BTreeSet::new(),
        }
    }

    fn request(&mut self, context: &Context<'_>, conversation: &Conversation, out: &mut Vec<Step>) {
        // An agent that was told that it may enter before this one precedes it.
        self.clock = self.clock.max(context.clock);
        self.clock = (self.clock + 1).min(MAX_CLOCK);
        let mut own = OwnRequest {
            conversation: conversation.clone(),
            clock: self.clock,
            awaited: BTreeSet::new(),
            entered: false,
        };
        for (peer, member) in context.members {
            out.push(Self::ask(&own, peer));
            if !member.suspected || context.owner == Some(peer) {
                own.awaited.insert(peer.clone());
            }
        }
        own.entered = own.awaited.is_empty();
        if own.entered {
            out.push(Step::Entered);
        }
        self.own = Some(own);
    }

    fn leave(&mut self, context: &Context<'_>, out: &mut Vec<Step>) {
        self.own = None;
        self.answer_deferred(context, out);
    }

    fn handle(
        &mut self,
        context: &Context<'_>,
        from: &LockPeer,
        conversation: &Conversation,
        act: &Act,
        out: &mut Vec<Step>,
    ) {
        match *act {
            Act::Request { clock } => {
                self.clock = self.clock.max(clock.min(MAX_CLOCK));
                if fault!(context.fault, Foreign) {
                    self.clock += 2;
                }
                if context.dialect(from) == LockDialect::Legacy {
                    self.acquainted.insert(from.clone());
                }
                let known = self.deferred.get(from);
                if known.is_some_and(|known| known.clock > clock) {
                    // A late copy of a request before the one that waits.
                    return;
                }
                let closed = !context.gate.lets_pass(context.dialect(from))
                    && !fault!(context.fault, IgnoreGate);
                if closed && fault!(context.fault, DropDeferred) {
                    return;
                }
                if closed || self.precedes(from, clock) {
                    let conversation = conversation.clone();
                    let deferred = Deferred {
                        conversation,
                        clock,
                    };
                    self.deferred.insert(from.clone(), deferred);
                } else {
                    self.deferred.remove(from);
                    out.push(self.agree(from.clone(), conversation.clone()));
                }
            }
            Act::Agree { clock } => {
                self.clock = self.clock.max(clock.min(MAX_CLOCK));
                let own = self.own.as_ref();
                if own.is_none_or(|own| own.conversation != *conversation) {
                    return;
                }
                if self.may_be_a_rival(context, from, clock) {
                    self.acquainted.insert(from.clone());
                    out.push(Step::Again);
                } else {
                    self.no_longer_awaited(from, out);
                }
            }
            _ => {}
        }
    }

    fn gate_changed(&mut self, context: &Context<'_>, out: &mut Vec<Step>) {
        if context.gate != OwnerGate::Closed {
            self.answer_deferred(context, out);
        }
    }

    fn grant_ended(&mut self, _: &LockPeer) {}

    fn own(&mut self, _: &Context<'_>, _: &mut Vec<Step>) {}

    fn owner_changed(&mut self) {}

    fn joined(&mut self, context: &Context<'_>, peer: &LockPeer, out: &mut Vec<Step>) {
        if let Some(own) = &mut self.own
            && (self.extended || !fault!(context.fault, AskNoNewcomer))
            && !fault!(context.fault, Foreign)
            && !own.entered
            && own.awaited.insert(peer.clone())
        {
            out.push(Self::ask(own, peer));
        }
    }

    fn lost(&mut self, _: &Context<'_>, peer: &LockPeer, gone: bool, out: &mut Vec<Step>) {
        if gone {
            self.deferred.remove(peer);
            self.acquainted.remove(peer);
        }
        if self.extended || gone {
            self.no_longer_awaited(peer, out);
        }
    }

    fn repeat(&mut self, context: &Context<'_>, out: &mut Vec<Step>) {
        if let Some(own) = &self.own
            && self.extended
        {
            let repeatable = |peer: &&LockPeer| context.accepts_repetition(peer);
            let awaited = own.awaited.iter().filter(repeatable);
            out.extend(awaited.map(|peer| Self::ask(own, peer)));
        }
    }

    fn handle_timeout(&mut self, _: &Context<'_>, _: &mut Vec<Step>) {}

    fn poll_timeout(&self) -> Option<Millis> {
        None
    }

    fn has_entered(&self) -> bool {
        self.own.as_ref().is_some_and(|own| own.entered)
    }

    fn awaited(&self) -> BTreeSet<LockPeer> {
        match &self.own {
            Some(own) if self.extended => own.awaited.clone(),
            _ => BTreeSet::new(),
        }
    }

    fn ahead(&self) -> Option<usize> {
        self.own.as_ref().map(|own| own.awaited.len())
    }

    #[cfg(test)]
    fn rebase(&mut self, _: Millis) {}
}
