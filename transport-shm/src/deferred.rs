//! Parcels that are answered later, and hold a slot of their sender until then.

use std::collections::BTreeMap;
use std::sync::Arc;

use fipa_transport::{Answer, Incarnation, Ticket};
use parking_lot::Mutex;

use crate::inbox::{BorrowLimits, RequestOwner};
use crate::layout::{Ack, UninitAck};

/// A parcel without an answer, and the memory for the answer.
pub(crate) struct UnansweredParcel {
    answer: UninitAck,
    token: u64,
    sender: Incarnation,
    // After the answer: dropping the request closes the channel of the response.
    owner: RequestOwner,
    // After the request: a slot that counts as free must be free.
    slot: Option<HeldSlot>,
}

impl UnansweredParcel {
    pub(crate) fn new(
        answer: UninitAck,
        token: u64,
        sender: Incarnation,
        owner: RequestOwner,
    ) -> Self {
        Self {
            answer,
            token,
            sender,
            owner,
            slot: None,
        }
    }

    /// Answers the parcel, and releases it.
    pub(crate) fn send(self, answer: &Answer) {
        let answer = self.answer.write_payload(Ack::new(answer, self.token));
        // Fails if the sender has ended, which then needs no answer.
        let _ = answer.send();
    }

    /// Counts the slot of the parcel as held by a late answer. False at the limits.
    pub(crate) fn hold(&mut self, limits: &Arc<BorrowLimits>) -> bool {
        let (sender, counted) = match &self.owner {
            RequestOwner::Unshared(active) => (active.origin().value(), false),
            RequestOwner::Content { sender, .. } => (*sender, true),
        };
        let limits = Arc::clone(limits);
        let begun = limits.begin_late_answer(sender, counted);
        if begun {
            self.slot = Some(HeldSlot {
                sender,
                counted,
                limits,
            });
        }
        begun
    }
}

/// A slot of a sender that a late answer holds.
struct HeldSlot {
    sender: u128,
    /// Whether content in the parcel holds the slot, too.
    counted: bool,
    limits: Arc<BorrowLimits>,
}

impl Drop for HeldSlot {
    fn drop(&mut self) {
        self.limits.end_late_answer(self.sender, self.counted);
    }
}

/// The parcels of a mailbox that are answered later.
#[derive(Default)]
pub(crate) struct LateAnswers(Mutex<BTreeMap<Ticket, UnansweredParcel>>);

impl LateAnswers {
    pub(crate) fn insert(&self, ticket: Ticket, parcel: UnansweredParcel) {
        self.0.lock().insert(ticket, parcel);
    }

    /// Takes a parcel back that is to be answered at once.
    pub(crate) fn take(&self, ticket: Ticket) -> Option<UnansweredParcel> {
        self.0.lock().remove(&ticket)
    }

    /// Answers a parcel. Returns its sender, which must be woken, or `None` if the ticket is unknown.
    pub(crate) fn answer(&self, ticket: Ticket, answer: &Answer) -> Option<Incarnation> {
        let parcel = self.take(ticket)?;
        let sender = parcel.sender;
        parcel.send(answer);
        Some(sender)
    }

    /// Drops all parcels without an answer.
    pub(crate) fn drop_all(&self) {
        let parcels = std::mem::take(&mut *self.0.lock());
        drop(parcels);
    }
}
