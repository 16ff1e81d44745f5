//! Parcels that are answered later, and hold a slot of their sender until then.

use std::collections::BTreeMap;
use std::sync::Arc;

use fipa_transport::{Answer, Incarnation, Ticket};
use parking_lot::Mutex;

use crate::answer_words::WordPlace;
use crate::borrowed::{BorrowLimits, RequestOwner};
use crate::layout::{Ack, UninitAck, code_of};
use crate::presence::StatusPage;

/// The way of an answer to its sender.
#[expect(
    clippy::large_enum_variant,
    reason = "a box would be an allocation for each answer"
)]
pub(crate) enum AnswerWay {
    /// A response of iceoryx2.
    Response(UninitAck),
    /// A word on the status page of the sender.
    Word(Arc<StatusPage>, WordPlace),
}

/// A parcel without an answer, and the place of the answer.
pub(crate) struct UnansweredParcel {
    way: AnswerWay,
    token: u64,
    sender: Incarnation,
    // After the answer: dropping the request closes the channel of the response.
    owner: RequestOwner,
    // After the request: a slot that counts as free must be free.
    slot: Option<HeldSlot>,
}

impl UnansweredParcel {
    pub(crate) fn new(
        way: AnswerWay,
        token: u64,
        sender: Incarnation,
        owner: RequestOwner,
    ) -> Self {
        Self {
            way,
            token,
            sender,
            owner,
            slot: None,
        }
    }

    pub(crate) fn owner(&self) -> &RequestOwner {
        &self.owner
    }

    /// Whether this answer needs a response, and there is no memory for one.
    pub(crate) fn lacks_response(&self, answer: &Answer) -> bool {
        matches!(self.way, AnswerWay::Word(..)) && code_of(answer).is_none()
    }

    /// Replaces the way of the answer.
    pub(crate) fn set_response(&mut self, response: UninitAck) {
        self.way = AnswerWay::Response(response);
    }

    /// Answers the parcel, and releases it.
    pub(crate) fn send(self, answer: &Answer) {
        match self.way {
            AnswerWay::Response(response) => {
                let response = response.write_payload(Ack::new(answer, self.token));
                // Fails if the sender has ended, which then needs no answer.
                let _ = response.send();
            }
            AnswerWay::Word(page, place) => {
                if let Some(code) = code_of(answer) {
                    page.answers().answer(place, self.token, code);
                }
            }
        }
    }

    /// Counts the slot of the parcel as held by a late answer. False at the limits.
    pub(crate) fn hold(&mut self, limits: &Arc<BorrowLimits>) -> bool {
        let (sender, counted) = match &self.owner {
            RequestOwner::Unshared(active) => (active.origin().value(), false),
            RequestOwner::Content(held) => (held.sender(), true),
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
