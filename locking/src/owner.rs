//! The core of an owner, for one resource: one live grant at a time.
//!
//! * The owner counts a lease from its answer. Only a request of the holder extends it.
//! * A release names its conversation. Late and repeated ones change nothing.
//! * A report that arrives before the release of the grant before it waits. Agents of
//!   `distributed_locking` let the next agent enter before they report that they have left.
//! * A grant to a legacy agent has neither fence nor end. It ends with the agent's report, with the
//!   proof that the agent has ended, or by [`Owner::force`].
//! * After a start, the owner grants nothing while a grant of an earlier life may be live.
//! * A report of a fence of another life raises the epoch before the next grant, which waits until the
//!   new epoch is stored. A live grant goes on: a report is not proved, so it must end no grant.

use std::collections::BTreeMap;

use crate::faults::{Fault, fault};
use crate::fence::Position;
use crate::queue::Queue;
use crate::{Act, Conversation, Fence, LockPeer, Millis, OwnerGate, OwnerState, Refusal, Resource};

/// Highest epoch that a report can have. The clock reaches it in nine million years, and the epochs above
/// are left to the restarts that follow a false report.
const MAX_REPORTED: u64 = 1 << 48;

/// The owner's state for one resource.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Owner {
    me: LockPeer,
    resource: Resource,
    epoch: u64,
    /// Random bits of this life.
    run: u64,
    /// Epoch of the last life that the state file of this life knows.
    previous_epoch: u64,
    /// Highest reported epoch of another life.
    reported: Option<u64>,
    /// Epoch that has to be stored before the next grant.
    storing: Option<u64>,
    /// Number of the last grant.
    number: u64,
    lease: Millis,
    /// Time before which a grant of a life elsewhere may be live.
    absent_until: Option<Millis>,
    /// Time before which a grant of an earlier life may be live.
    no_grants_until: Option<Millis>,
    live: Option<Grant>,
    /// Holder whose grant expired, until it reports or ends.
    expired_holder: Option<(LockPeer, Conversation)>,
    /// At most one report per registration.
    queue: Queue,
    /// Latest conversation of each agent that has ended.
    closed: BTreeMap<LockPeer, Conversation>,
    fault: Fault,
}

/// A live grant.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Grant {
    /// The holder.
    pub holder: LockPeer,
    /// The conversation of its request.
    pub conversation: Conversation,
    /// The fence. A legacy agent has none.
    pub fence: Option<Fence>,
    /// End of the lease. The grant of a legacy agent has none.
    pub expires: Option<Millis>,
}

/// End of a grant.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Ending {
    /// The holder released it, or withdrew its request.
    Released,
    /// Its lease ended.
    Expired,
    /// The holder's registration or process ended.
    Gone,
    /// The owner ended it.
    Forced,
}

/// Result of a call of an owner.
#[derive(Debug, Clone, PartialEq, Eq)]
#[allow(
    clippy::exhaustive_enums,
    reason = "the caller has to perform each step"
)]
pub enum OwnerStep {
    /// Send a message.
    Send {
        /// The receiver.
        to: LockPeer,
        /// The conversation.
        conversation: Conversation,
        /// The act.
        act: Act,
    },
    /// Store this epoch. The agent confirms it when it is stored.
    Store(u64),
    /// Ask a member for a sign of life.
    Probe {
        /// The member.
        to: LockPeer,
        /// The time.
        at: Millis,
    },
    /// A grant begins.
    Began(Grant),
    /// A grant ends.
    Ended {
        /// The grant.
        grant: Grant,
        /// The reason.
        how: Ending,
    },
}

impl Owner {
    /// Creates the state of a life that is silent for the given time.
    pub(crate) fn new(
        me: LockPeer,
        resource: Resource,
        life: &OwnerState,
        lease: Millis,
        now: Millis,
        silence: Millis,
        fault: Fault,
    ) -> Self {
        let mut silence = silence;
        if fault!(fault, GrantAfterRestart) {
            silence = 0;
        }
        let mut epoch = life.epoch();
        if fault!(fault, KeepEpoch) {
            epoch = 1;
        }
        let mut run = life.run();
        if fault!(fault, SameRun | FileOnly) {
            run = 0;
        }
        Self {
            me,
            resource,
            epoch,
            run,
            previous_epoch: life.previous_epoch(),
            reported: None,
            storing: None,
            number: 0,
            lease,
            absent_until: (life.absence() > 0).then(|| now.saturating_add(life.absence())),
            no_grants_until: (silence > 0).then(|| now.saturating_add(silence)),
            live: None,
            expired_holder: None,
            queue: Queue::default(),
            closed: BTreeMap::new(),
            fault,
        }
    }

    /// The live grant.
    #[must_use]
    pub fn live(&self, now: Millis) -> Option<&Grant> {
        self.live
            .as_ref()
            .filter(|grant| grant.expires.is_none_or(|expires| now < expires))
    }

    /// Agents whose reports wait, the next one first.
    pub fn waiters(&self) -> impl Iterator<Item = &LockPeer> {
        self.queue.iter().map(|waiter| &waiter.peer)
    }

    /// Whether a command with this fence is carried out: only with the fence of the live grant.
    #[must_use]
    pub fn admit(&self, now: Millis, fence: &Fence) -> bool {
        self.live(now)
            .is_some_and(|grant| grant.fence.as_ref() == Some(fence))
    }

    /// Agents that the owner lets pass in the algorithm.
    #[must_use]
    pub fn gate(&self) -> OwnerGate {
        if self.live.is_some() || self.no_grants_until.is_some() || self.storing.is_some() {
            OwnerGate::Closed
        } else if self.expired_holder.is_some() {
            OwnerGate::Own
        } else {
            OwnerGate::Open
        }
    }

    /// Time of the next timeout.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Millis> {
        let expires = self.live.as_ref().and_then(|grant| grant.expires);
        let turn = match self.gate() {
            OwnerGate::Closed => None,
            OwnerGate::Open | OwnerGate::Own => self.queue.poll_timeout(),
        };
        expires
            .into_iter()
            .chain(self.no_grants_until)
            .chain(self.absent_until)
            .chain(turn)
            .min()
    }

    /// Time in which the owner grants nothing, because a grant of an earlier life may be live.
    #[must_use]
    pub fn silence(&self, now: Millis) -> Millis {
        self.no_grants_until
            .map_or(0, |until| until.saturating_sub(now))
    }

    /// Whether the owner knows a fence of another life.
    pub(crate) fn has_report(&self) -> bool {
        self.reported.is_some()
    }

    /// The last fence of this life.
    pub(crate) fn last(&self) -> Option<Fence> {
        let position = Position {
            epoch: self.epoch,
            number: self.number,
        };
        (self.number > 0).then(|| Fence::new(&self.me, &self.resource, position, self.run))
    }

    /// Handles a report of a fence of this owner that another agent or a device has seen.
    pub(crate) fn seen(&mut self, now: Millis, fence: &Fence) {
        let is_of_another_life = fence.owner() == self.me.name()
            && fence.resource() == self.resource.as_str()
            && fence.run() != self.run;
        let is_deaf = fault!(self.fault, AskNobody | FileOnly);
        if !is_of_another_life || fence.epoch() > MAX_REPORTED || is_deaf {
            return;
        }
        self.reported = self.reported.max(Some(fence.epoch()));
        // Lives on this host are in the file, with their leases.
        if fence.epoch() > self.previous_epoch && self.absent_until.is_some_and(|until| now < until)
        {
            self.no_grants_until = self.no_grants_until.max(self.absent_until);
        }
    }

    /// Handles the end of storing an epoch.
    pub(crate) fn stored(&mut self, now: Millis, epoch: u64, out: &mut Vec<OwnerStep>) {
        if self.storing == Some(epoch) {
            self.storing = None;
            self.epoch = epoch;
        }
        self.handle_timeout(now, out);
    }

    /// Serves requests in the order of their arrival, and tells places: the algorithm is the owner's queue.
    pub(crate) fn be_fair(&mut self, probe_timeout: Millis) {
        self.queue.be_fair(probe_timeout);
    }

    /// Handles a request of the owner's queue. `place` is that in the owner's life before.
    pub(crate) fn ask(
        &mut self,
        now: Millis,
        from: &LockPeer,
        conversation: &Conversation,
        asked: Millis,
        place: Option<u32>,
        out: &mut Vec<OwnerStep>,
    ) {
        self.confirm(now, from, conversation, Some(asked), out);
        if self.no_grants_until.is_some()
            && let Some(place) = place
        {
            self.queue.sort_in(from, place);
        }
    }

    /// Handles a sign of life of a member that was suspected.
    pub(crate) fn sign_of_life(&mut self, now: Millis, peer: &LockPeer, out: &mut Vec<OwnerStep>) {
        self.queue.sign_of_life(peer);
        self.handle_timeout(now, out);
    }

    /// Handles a report that an agent has entered. `asked` is absent in those of legacy agents.
    pub(crate) fn confirm(
        &mut self,
        now: Millis,
        from: &LockPeer,
        conversation: &Conversation,
        asked: Option<Millis>,
        out: &mut Vec<OwnerStep>,
    ) {
        if let Some(waiter) = self.queue.find(from)
            && waiter.conversation == *conversation
        {
            // The report was repeated. One answer follows, to the last repetition.
            waiter.asked = waiter.asked.max(asked);
            self.queue.sign_of_life(from);
            self.handle_timeout(now, out);
            return;
        }
        self.handle_timeout(now, out);
        if let Some(live) = &mut self.live
            && live.holder == *from
            && live.conversation == *conversation
        {
            // The answer was lost, or the report was repeated.
            if let (Some(asked), Some(fence)) = (asked, live.fence.clone()) {
                live.expires = Some(now.saturating_add(self.lease));
                out.push(Self::granted(from, conversation, fence, self.lease, asked));
            }
            return;
        }
        if self.is_closed(from, conversation) {
            if let Some(asked) = asked {
                out.push(Self::refused(from, conversation, Refusal::Closed, asked));
            }
            return;
        }
        if let Some(live) = &self.live
            && live.holder == *from
        {
            if conversation.is_not_after(&live.conversation) {
                return;
            }
            // A newer request of the holder: it has left. Its report was lost or is late.
            self.end(Ending::Released, out);
        }
        self.expired_holder_left(from, conversation);
        if !self.queue.add(from, conversation, asked) {
            return;
        }
        self.grant_next(now, out);
    }

    /// Handles a request to extend a grant.
    pub(crate) fn renew(
        &mut self,
        now: Millis,
        from: &LockPeer,
        conversation: &Conversation,
        fence: &Fence,
        asked: Millis,
        out: &mut Vec<OwnerStep>,
    ) {
        self.handle_timeout(now, out);
        match &mut self.live {
            Some(live) if live.holder == *from && live.fence.as_ref() == Some(fence) => {
                live.expires = Some(now.saturating_add(self.lease));
                let fence = fence.clone();
                out.push(Self::granted(from, conversation, fence, self.lease, asked));
            }
            _ => out.push(Self::refused(from, conversation, Refusal::NotLive, asked)),
        }
    }

    /// Handles a report that an agent has left, or has withdrawn its request.
    pub(crate) fn release(
        &mut self,
        now: Millis,
        from: &LockPeer,
        conversation: &Conversation,
        out: &mut Vec<OwnerStep>,
    ) {
        // Before the timeout, which grants the resource to the next one: a late owner has both to handle.
        self.queue.withdraw(from, conversation);
        self.handle_timeout(now, out);
        self.expired_holder_left(from, conversation);
        let by_name = fault!(self.fault, ReleaseByName);
        let of_live = self.live.as_ref().is_some_and(|live| {
            live.holder == *from && (by_name || live.conversation == *conversation)
        });
        if of_live {
            self.end(Ending::Released, out);
        } else if !self.is_closed(from, conversation) {
            self.close(from, conversation);
        }
        self.grant_next(now, out);
    }

    /// Records that a legacy agent has entered, for an algorithm in which it does not report that.
    pub(crate) fn entered_without_report(
        &mut self,
        peer: &LockPeer,
        conversation: &Conversation,
        out: &mut Vec<OwnerStep>,
    ) {
        if self.live.is_none() {
            let grant = Grant {
                holder: peer.clone(),
                conversation: conversation.clone(),
                fence: None,
                expires: None,
            };
            self.live = Some(grant.clone());
            out.push(OwnerStep::Began(grant));
        }
    }

    /// Records that a legacy agent, if one holds the grant, has left: the token is elsewhere.
    pub(crate) fn left_without_report(&mut self, now: Millis, out: &mut Vec<OwnerStep>) {
        let legacy = self.live.as_ref().is_some_and(|live| live.fence.is_none());
        if legacy {
            self.end(Ending::Released, out);
            self.grant_next(now, out);
        }
    }

    /// Handles the loss of an agent. `gone` is a proof that its registration or its process has ended.
    pub(crate) fn lost(
        &mut self,
        now: Millis,
        peer: &LockPeer,
        gone: bool,
        out: &mut Vec<OwnerStep>,
    ) {
        self.queue.lost(peer, gone);
        if gone {
            if self.live.as_ref().is_some_and(|live| live.holder == *peer) {
                self.end(Ending::Gone, out);
            }
            if self
                .expired_holder
                .as_ref()
                .is_some_and(|(of, _)| of == peer)
            {
                self.expired_holder = None;
            }
            self.closed.remove(peer);
        }
        self.grant_next(now, out);
    }

    /// Ends the grant, and no longer waits for the proof that an expired holder has left.
    pub(crate) fn force(&mut self, now: Millis, out: &mut Vec<OwnerStep>) {
        if self.live.is_some() {
            self.end(Ending::Forced, out);
        }
        self.expired_holder = None;
        self.grant_next(now, out);
    }

    /// Ends the lease and the silence that are over.
    pub(crate) fn handle_timeout(&mut self, now: Millis, out: &mut Vec<OwnerStep>) {
        let over = |until: Option<Millis>| until.is_some_and(|until| until <= now);
        if over(self.no_grants_until) {
            self.no_grants_until = None;
        }
        if over(self.absent_until) {
            self.absent_until = None;
        }
        if over(self.live.as_ref().and_then(|live| live.expires)) {
            if let Some(live) = &self.live {
                self.expired_holder = Some((live.holder.clone(), live.conversation.clone()));
            }
            self.end(Ending::Expired, out);
        }
        self.grant_next(now, out);
    }

    fn is_closed(&self, peer: &LockPeer, conversation: &Conversation) -> bool {
        let closed = self.closed.get(peer);
        !fault!(self.fault, GrantWithdrawn)
            && closed.is_some_and(|closed| conversation.is_not_after(closed))
    }

    fn close(&mut self, peer: &LockPeer, conversation: &Conversation) {
        let closed = self.closed.get(peer);
        if !closed.is_some_and(|closed| conversation.is_not_after(closed)) {
            self.closed.insert(peer.clone(), conversation.clone());
        }
    }

    /// The agent shows that it has left the conversation whose grant expired.
    fn expired_holder_left(&mut self, from: &LockPeer, conversation: &Conversation) {
        let expired_holder = self.expired_holder.as_ref();
        if expired_holder.is_some_and(|(peer, of)| peer == from && of.is_not_after(conversation)) {
            self.expired_holder = None;
        }
    }

    fn end(&mut self, how: Ending, out: &mut Vec<OwnerStep>) {
        if let Some(grant) = self.live.take() {
            self.close(&grant.holder, &grant.conversation);
            out.push(OwnerStep::Ended { grant, how });
        }
    }

    fn grant_next(&mut self, now: Millis, out: &mut Vec<OwnerStep>) {
        self.begin_next(now, out);
        // The order can change until the end of the silence.
        if self.no_grants_until.is_none() {
            self.queue.tell(out);
        }
    }

    fn begin_next(&mut self, now: Millis, out: &mut Vec<OwnerStep>) {
        let gate = self.gate();
        if gate == OwnerGate::Closed {
            return;
        }
        let Some(next) = self.queue.next(now, gate, out) else {
            return;
        };
        let is_fenced = self.queue.get(next).is_some_and(|it| it.asked.is_some());
        if let Some(reported) = self.reported.filter(|epoch| *epoch >= self.epoch)
            && is_fenced
        {
            let epoch = reported.saturating_add(1);
            self.storing = Some(epoch);
            out.push(OwnerStep::Store(epoch));
            return;
        }
        let Some(waiter) = self.queue.remove(next) else {
            return;
        };
        let mut grant = Grant {
            holder: waiter.peer.clone(),
            conversation: waiter.conversation.clone(),
            fence: None,
            expires: None,
        };
        if let Some(asked) = waiter.asked {
            if !fault!(self.fault, ReuseFence) || self.number == 0 {
                self.number += 1;
            }
            let position = Position {
                epoch: self.epoch,
                number: self.number,
            };
            let fence = Fence::new(&self.me, &self.resource, position, self.run);
            grant.fence = Some(fence.clone());
            grant.expires = Some(now.saturating_add(self.lease));
            out.push(Self::granted(
                &waiter.peer,
                &waiter.conversation,
                fence,
                self.lease,
                asked,
            ));
        }
        self.live = Some(grant.clone());
        out.push(OwnerStep::Began(grant));
    }

    fn granted(
        to: &LockPeer,
        conversation: &Conversation,
        fence: Fence,
        lease: Millis,
        asked: Millis,
    ) -> OwnerStep {
        OwnerStep::Send {
            to: to.clone(),
            conversation: conversation.clone(),
            act: Act::Granted {
                fence,
                lease,
                asked,
            },
        }
    }

    fn refused(
        to: &LockPeer,
        conversation: &Conversation,
        reason: Refusal,
        asked: Millis,
    ) -> OwnerStep {
        OwnerStep::Send {
            to: to.clone(),
            conversation: conversation.clone(),
            act: Act::Refused { reason, asked },
        }
    }

    #[cfg(test)]
    pub(crate) fn rebase(&mut self, by: Millis) {
        let expires = self.live.as_mut().and_then(|live| live.expires.as_mut());
        for time in expires
            .into_iter()
            .chain(&mut self.no_grants_until)
            .chain(&mut self.absent_until)
        {
            *time = time.saturating_sub(by);
        }
        self.queue.rebase(by);
    }
}
