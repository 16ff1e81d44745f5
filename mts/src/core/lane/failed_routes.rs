//! Reasons for letters whose deadline passed before they were dispatched: the attempts of the
//! letters before them.

use std::time::Instant;

use fipa_sds::Entry;
use fipa_transport::{Attempt, FailureReason, Location, TransportError, TransportErrorKind};

use super::Lane;

impl Lane {
    /// Records an error of a route, unless it concerns one letter only.
    pub(super) fn route_failed(&mut self, location: &Location, error: &TransportError) {
        if matches!(
            error.fault,
            TransportErrorKind::TooLarge | TransportErrorKind::Inexpressible
        ) {
            return;
        }
        self.route_worked(location);
        if self.failed.len() >= Entry::MAX_LOCATIONS {
            self.failed.remove(0);
        }
        self.failed.push(Attempt {
            via: location.kind(),
            location: location.clone(),
            error: error.clone(),
        });
    }

    /// Records that a route works.
    pub(super) fn route_worked(&mut self, location: &Location) {
        if !self.failed.is_empty() {
            self.failed.retain(|attempt| attempt.location != *location);
        }
    }

    /// Records that the receiver's queue is full.
    pub(super) fn was_full(&mut self, now: Instant) {
        self.busy = true;
        self.was_busy = Some(now);
    }

    /// The reason for the letter at `index`, which waits and whose deadline has passed. A letter
    /// without attempts of its own gets those of the letters before it.
    pub(super) fn reason_while_waiting(&mut self, index: usize) -> FailureReason {
        // Only a queue that was full since the letter arrived counts.
        let since = self.letters[index].since;
        let busy = self.busy || self.was_busy.is_some_and(|at| at >= since);
        let waits_behind = self.waits_behind();
        let open_letter = &mut self.letters[index];
        if open_letter.progress.attempts.is_empty() && !open_letter.progress.busy && !busy {
            open_letter.progress.attempts.clone_from(&self.failed);
        }
        let reason = open_letter.reason_at_deadline(busy);
        if reason == FailureReason::TimedOut {
            open_letter.progress.attempts.extend(waits_behind);
        }
        reason
    }

    /// The route on which letters have no answer yet.
    fn waits_behind(&self) -> Option<Attempt> {
        let location = self.route.as_ref().filter(|_| self.under_way > 0)?;
        let detail = format!("letters before it have no answer ({})", self.under_way);
        Some(Attempt {
            via: location.kind(),
            location: location.clone(),
            error: TransportError::new(TransportErrorKind::TimedOut, detail),
        })
    }
}
