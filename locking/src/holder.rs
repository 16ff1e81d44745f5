//! The core of a holder, for one request that has entered: it asks the owner for a grant, counts the
//! lease and extends it.
//!
//! The holder counts 0.95 of the lease from *sending* its request, the owner the whole lease from its
//! answer. Each request contains the time of its sending, and the answer repeats it. So a late or
//! repeated answer never extends the lease beyond that of its own request.

use crate::faults::{Fault, fault};
use crate::{Act, Conversation, Fence, Millis, Options, Refusal};

/// Share of the lease that the holder uses, in percent. The rest covers clocks whose rates differ.
const SHARE: Millis = 95;

/// The holder's state for one request.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Holder {
    conversation: Conversation,
    /// Whether the request goes to the owner's queue, and its place in the owner's life before.
    queued: Option<Option<u32>>,
    phase: Phase,
    fence: Option<Fence>,
    /// Lease of the last answer.
    lease: Millis,
    /// Time of the first request. Answers to earlier ones are not ours.
    first: Millis,
    /// End of the lease.
    until: Millis,
    /// Time of the next request.
    next: Millis,
    /// Time after which a request without an answer is repeated, before the first grant.
    retry: Millis,
    fault: Fault,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum Phase {
    /// No grant was usable so far.
    Asking,
    Held,
    /// A legacy owner gives no lease.
    Unfenced,
    Lost,
}

/// Result of a call of a holder.
#[derive(Debug, Clone, PartialEq, Eq)]
#[allow(
    clippy::exhaustive_enums,
    reason = "the caller has to perform each step"
)]
pub enum HolderStep {
    /// Send this to the owner.
    Send(Act),
    /// The grant is usable.
    Held,
    /// The grant ended.
    Lost,
    /// The owner refuses the request.
    Refused(Refusal),
}

impl Holder {
    /// Creates the state of a request that has entered, and asks the owner.
    pub(crate) fn new(
        conversation: Conversation,
        now: Millis,
        options: &Options,
        out: &mut Vec<HolderStep>,
    ) -> Self {
        let mut holder = Self::asking(conversation, now, options);
        holder.ask(now, out);
        holder
    }

    /// Creates the state of a request for the owner's queue, and asks the owner.
    pub(crate) fn queued(
        conversation: Conversation,
        now: Millis,
        place: Option<u32>,
        options: &Options,
        out: &mut Vec<HolderStep>,
    ) -> Self {
        let mut holder = Self::asking(conversation, now, options);
        holder.queued = Some(place);
        holder.ask(now, out);
        holder
    }

    fn asking(conversation: Conversation, now: Millis, options: &Options) -> Self {
        Self {
            conversation,
            queued: None,
            phase: Phase::Asking,
            fence: None,
            lease: options.lease,
            first: now,
            until: 0,
            next: now.saturating_add(options.retry),
            retry: options.retry,
            fault: options.fault,
        }
    }

    /// Creates the state of a request at a legacy owner, which gives no fence. `report` is whether the
    /// algorithm reports to the owner.
    pub(crate) fn unfenced(
        conversation: Conversation,
        report: bool,
        options: &Options,
        out: &mut Vec<HolderStep>,
    ) -> Self {
        if report {
            out.push(HolderStep::Send(Act::Confirm { asked: None }));
        }
        out.push(HolderStep::Held);
        Self {
            conversation,
            queued: None,
            phase: Phase::Unfenced,
            fence: None,
            lease: 0,
            first: 0,
            until: Millis::MAX,
            next: Millis::MAX,
            retry: options.retry,
            fault: options.fault,
        }
    }

    /// The conversation of the request.
    #[must_use]
    pub fn conversation(&self) -> &Conversation {
        &self.conversation
    }

    /// The fence, if a grant is usable now.
    #[must_use]
    pub fn fence(&self, now: Millis) -> Option<&Fence> {
        self.fence.as_ref().filter(|_| self.is_held(now))
    }

    /// Whether the grant is usable now. Another process may use the resource as soon as this is false.
    #[must_use]
    pub fn is_held(&self, now: Millis) -> bool {
        match self.phase {
            Phase::Held => now < self.until,
            Phase::Unfenced => true,
            Phase::Asking | Phase::Lost => false,
        }
    }

    /// Whether no grant was usable so far.
    pub(crate) fn is_asking(&self) -> bool {
        self.phase == Phase::Asking
    }

    /// Place in the owner's life before, which the request tells.
    pub(crate) fn place(&self) -> Option<u32> {
        self.queued.flatten()
    }

    /// Whether the owner gives no fence.
    #[must_use]
    pub fn is_unfenced(&self) -> bool {
        self.phase == Phase::Unfenced
    }

    /// Remaining time of the lease. A legacy owner gives none.
    #[must_use]
    pub fn remaining(&self, now: Millis) -> Option<Millis> {
        (!self.is_unfenced()).then(|| match self.is_held(now) {
            true => self.until - now,
            false => 0,
        })
    }

    /// Handles a grant of the owner, in the conversation of the request.
    pub(crate) fn granted(
        &mut self,
        now: Millis,
        fence: &Fence,
        lease: Millis,
        asked: Millis,
        out: &mut Vec<HolderStep>,
    ) {
        self.handle_timeout(now, out);
        let of_this_request = (self.first..=now).contains(&asked)
            && self.fence.as_ref().is_none_or(|own| own == fence);
        if !of_this_request {
            return;
        }
        let mut asked = asked;
        if fault!(self.fault, CountFromArrival) {
            asked = now;
        }
        let lease = lease.min(crate::options::MAX_SPAN);
        let until = asked.saturating_add(lease.saturating_mul(SHARE) / 100);
        match self.phase {
            Phase::Asking => {
                self.fence = Some(fence.clone());
                self.lease = lease;
                if now < until {
                    self.phase = Phase::Held;
                    self.until = until;
                    self.next = self.next_renewal(asked);
                    out.push(HolderStep::Held);
                    self.handle_timeout(now, out);
                } else {
                    // The report waited longer than the lease: the grant has to be confirmed first.
                    self.ask(now, out);
                }
            }
            Phase::Held => {
                self.until = self.until.max(until);
                self.lease = lease;
            }
            Phase::Unfenced | Phase::Lost => {}
        }
    }

    /// Handles a refusal of the owner, in the conversation of the request.
    pub(crate) fn refused(
        &mut self,
        now: Millis,
        reason: Refusal,
        asked: Millis,
        out: &mut Vec<HolderStep>,
    ) {
        self.handle_timeout(now, out);
        if !(self.first..=now).contains(&asked) {
            return;
        }
        match self.phase {
            Phase::Asking => out.push(HolderStep::Refused(reason)),
            Phase::Held => self.lose(out),
            Phase::Unfenced | Phase::Lost => {}
        }
    }

    /// Handles a probe of the owner. It renews nothing.
    #[cfg(test)]
    pub(crate) fn probed(&mut self, now: Millis) {
        if fault!(self.fault, RenewByProbe) && self.is_held(now) {
            self.until = now + self.lease;
        }
    }

    /// The owner is lost. A lease is used to its end.
    pub(crate) fn owner_lost(&mut self, out: &mut Vec<HolderStep>) {
        if self.phase == Phase::Unfenced {
            self.lose(out);
        }
    }

    /// Ends a lease that is over, and repeats requests.
    pub(crate) fn handle_timeout(&mut self, now: Millis, out: &mut Vec<HolderStep>) {
        match self.phase {
            Phase::Held if self.until <= now => self.lose(out),
            Phase::Held | Phase::Asking if self.next <= now => self.ask(now, out),
            _ => {}
        }
    }

    /// Time of the next timeout.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Millis> {
        match self.phase {
            Phase::Asking => Some(self.next),
            Phase::Held => Some(self.next.min(self.until)),
            Phase::Unfenced | Phase::Lost => None,
        }
    }

    fn next_renewal(&self, asked: Millis) -> Millis {
        asked.saturating_add((self.lease / 3).max(1))
    }

    fn ask(&mut self, now: Millis, out: &mut Vec<HolderStep>) {
        self.next = match self.phase {
            Phase::Asking => now.saturating_add(self.retry),
            _ => self.next_renewal(now),
        };
        out.push(HolderStep::Send(match &self.fence {
            Some(fence) => Act::Renew {
                fence: fence.clone(),
                asked: now,
            },
            None => match self.queued {
                Some(place) => Act::Ask { asked: now, place },
                None => Act::Confirm { asked: Some(now) },
            },
        }));
    }

    fn lose(&mut self, out: &mut Vec<HolderStep>) {
        self.phase = Phase::Lost;
        out.push(HolderStep::Lost);
    }

    #[cfg(test)]
    pub(crate) fn rebase(&mut self, by: Millis) {
        for time in [&mut self.first, &mut self.until, &mut self.next] {
            if *time != Millis::MAX {
                *time = time.saturating_sub(by);
            }
        }
    }
}
