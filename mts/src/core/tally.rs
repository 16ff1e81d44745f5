//! Counters of the locations to which letters go.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use fipa_transport::Location;
use parking_lot::Mutex;

use crate::Map;

/// Counters of one location.
#[derive(Debug, Default)]
pub(crate) struct Tally {
    pub(super) tried: AtomicU64,
    pub(super) ended: AtomicU64,
    pub(super) taken: AtomicU64,
    pub(super) turned_back: AtomicU64,
    pub(super) failed: AtomicU64,
    /// Smoothed time until an answer, in microseconds; 0 before the first. Only of locations on other hosts.
    pub(super) answer_micros: AtomicU64,
    pub(super) last_error: Mutex<Option<(String, Instant)>>,
}

/// Counters of all locations.
#[derive(Debug, Default)]
pub(super) struct Tallies(pub(super) Map<Location, Arc<Tally>>);

/// Maximum number of locations with counters.
const MAX_TALLIES: usize = 4096;

impl Tally {
    /// Increments a counter by one. Only the core writes its counters, which its caller has locked.
    pub(super) fn add(counter: &AtomicU64) {
        let before = counter.load(Ordering::Relaxed);
        counter.store(before.wrapping_add(1), Ordering::Relaxed);
    }

    /// Records the time from an attempt to its answer.
    pub(super) fn answered_after(&self, took: Duration) {
        let took = u64::try_from(took.as_micros()).unwrap_or(u64::MAX).max(1);
        let smoothed = match self.answer_micros.load(Ordering::Relaxed) {
            0 => took,
            // As TCP does (RFC 6298 section 2).
            known => known - known / 8 + took / 8,
        };
        self.answer_micros.store(smoothed.max(1), Ordering::Relaxed);
    }

    pub(super) fn fail(&self, now: Instant, error: &impl std::fmt::Display) {
        Self::add(&self.failed);
        *self.last_error.lock() = Some((error.to_string(), now));
    }

    pub(super) fn in_flight(&self) -> u64 {
        let read = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        read(&self.tried).saturating_sub(read(&self.ended))
    }
}

impl Tallies {
    /// Counters of this location. Beyond the limit, those without letters in flight are dropped.
    pub(super) fn of(&mut self, location: &Location) -> Arc<Tally> {
        if let Some(tally) = self.0.get(location) {
            return Arc::clone(tally);
        }
        if self.0.len() >= MAX_TALLIES {
            self.0.retain(|_, tally| tally.in_flight() > 0);
        }
        let tally = Arc::default();
        if self.0.len() < MAX_TALLIES {
            self.0.insert(location.clone(), Arc::clone(&tally));
        }
        tally
    }
}
