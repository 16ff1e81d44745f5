//! One letter on its way to one receiver, and how far it has come.

use std::time::Instant;

use fipa_acl::Letter;
use fipa_transport::{Answer, Attempt, AttemptId, FailureReason, Location, WayError};

use super::super::desk::{Action, Desk, Origin};

/// How many failed attempts are remembered for one letter's outcome.
const MAX_ATTEMPTS: usize = 16;

/// One letter on its way to one receiver.
#[derive(Debug)]
pub(crate) struct Delivery {
    pub(crate) origin: Origin,
    pub(crate) letter: Letter,
    pub(crate) sequence: u64,
    /// The letter that this one comes after, as it was told by whoever handed it over.
    pub(crate) after: u64,
    pub(crate) deadline: Instant,
    pub(crate) hops: u8,
    /// When whoever handed it over is told that it is in custody, if nothing happened before.
    pub(crate) custody_due: Option<Instant>,
    pub(super) progress: Progress,
}

/// How far a letter has come.
#[derive(Debug)]
pub(super) struct Progress {
    pub(super) state: State,
    /// What was tried, for the outcome.
    pub(super) attempts: Vec<Attempt>,
    /// The ways tried in this round.
    pub(super) tried: Vec<Location>,
    /// Some attempt may have delivered it.
    pub(super) unconfirmed: bool,
    /// The receiver's queue was full.
    pub(super) busy: bool,
}

/// Where a letter is.
#[derive(Debug)]
pub(super) enum State {
    Waiting,
    UnderWay {
        attempt: AttemptId,
        location: Location,
        times_out: Instant,
    },
    Custody {
        location: Location,
    },
}

impl Delivery {
    /// A letter that comes after none that others know of, and has not been on the network.
    pub(crate) fn new(origin: Origin, letter: Letter, sequence: u64, deadline: Instant) -> Self {
        let progress = Progress {
            state: State::Waiting,
            attempts: Vec::new(),
            tried: Vec::new(),
            unconfirmed: false,
            busy: false,
        };
        Self {
            origin,
            letter,
            sequence,
            after: 0,
            deadline,
            hops: 0,
            custody_due: None,
            progress,
        }
    }

    pub(super) fn is_waiting(&self) -> bool {
        matches!(self.progress.state, State::Waiting)
    }

    pub(super) fn failed_at(&mut self, location: &Location, error: WayError) {
        if self.progress.attempts.len() < MAX_ATTEMPTS {
            let location = location.clone();
            self.progress.attempts.push(Attempt {
                via: location.kind(),
                location,
                error,
            });
        }
    }

    /// Why it failed when its time is over.
    pub(super) fn reason_at_deadline(&self) -> FailureReason {
        let progress = &self.progress;
        if progress.unconfirmed || !self.is_waiting() {
            FailureReason::Unconfirmed
        } else if progress.busy {
            FailureReason::QueueFull
        } else if progress.attempts.is_empty() {
            FailureReason::TimedOut
        } else {
            FailureReason::Unreachable
        }
    }

    pub(super) fn custody_taken(&mut self, desk: &mut Desk) {
        if let Origin::Forwarded { unanswered, .. } = &mut self.origin
            && let Some((kind, ticket)) = unanswered.take()
        {
            desk.actions.push_back(Action::Answer {
                kind,
                ticket,
                answer: Answer::Custody,
            });
        }
        self.custody_due = None;
    }
}
