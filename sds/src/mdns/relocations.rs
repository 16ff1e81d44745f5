//! Announcements of records in which only the locations changed.
//!
//! The mDNS library notices a new address of this host at its next poll of the interfaces. Letters
//! do not arrive until other gateways have the new locations, so this crate announces such a record
//! itself: at once, and again after one and after three seconds, because a packet can be lost (RFC
//! 6762 clause 8.3 demands two announcements at least, and that the intervals double).
//!
//! Meanwhile the library may still announce the previous locations. A record that another packet
//! made outdated is announced again at once.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Intervals between the announcements of one record.
const INTERVALS: [Duration; 2] = [Duration::from_secs(1), Duration::from_secs(2)];

/// Minimum time between an announcement and its repetition because of an outdated copy.
const CORRECTION: Duration = Duration::from_millis(100);

/// Maximum number of records that are announced this way; the library announces the others.
const MAX_RECORDS: usize = 256;

/// Records whose locations changed, and the times of their announcements.
#[derive(Debug, Default)]
pub(super) struct Relocations {
    pending: VecDeque<Pending>,
}

#[derive(Debug)]
struct Pending {
    name: Arc<str>,
    due: Instant,
    last: Option<Instant>,
    /// Number of announcements sent.
    sent: usize,
}

impl Relocations {
    /// Adds the record of this agent, which is announced at once. A record that is added again
    /// starts again.
    pub(super) fn add(&mut self, now: Instant, name: &Arc<str>) {
        self.pending.retain(|pending| pending.name != *name);
        if self.pending.len() < MAX_RECORDS {
            self.pending.push_back(Pending {
                name: Arc::clone(name),
                due: now,
                last: None,
                sent: 0,
            });
        }
    }

    /// Handles a packet with an outdated record of this agent. Returns whether the record is
    /// announced again.
    pub(super) fn handle_outdated(&mut self, now: Instant, name: &str) -> bool {
        let pending = self.pending.iter_mut().find(|one| &*one.name == name);
        let Some(pending) = pending else {
            return false;
        };
        let earliest = pending.last.map_or(now, |last| last + CORRECTION);
        if earliest.max(now) >= pending.due {
            return false;
        }
        pending.due = earliest.max(now);
        // The announcement after this one follows as it would have without this one.
        pending.sent = pending.sent.saturating_sub(1);
        true
    }

    /// Returns the names of the agents whose records are announced now.
    pub(super) fn take_due(&mut self, now: Instant) -> Vec<Arc<str>> {
        let mut due = Vec::new();
        self.pending.retain_mut(|pending| {
            if now < pending.due {
                return true;
            }
            due.push(Arc::clone(&pending.name));
            let next = INTERVALS.get(pending.sent);
            pending.sent += 1;
            pending.last = Some(now);
            pending.due = now + next.copied().unwrap_or_default();
            next.is_some()
        });
        due
    }

    /// Returns the time of the next announcement.
    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        self.pending.iter().map(|pending| pending.due).min()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_record_is_announced_three_times_at_growing_intervals() {
        let mut relocations = Relocations::default();
        let start = Instant::now();
        let [arm, leg]: [Arc<str>; 2] = ["arm".into(), "leg".into()];
        relocations.add(start, &arm);
        let mut now = start;
        let mut announced = Vec::new();
        while let Some(due) = relocations.poll_timeout() {
            now = now.max(due);
            for name in relocations.take_due(now) {
                announced.push((now - start, name));
            }
        }
        let times = [0, 1, 3].map(Duration::from_secs);
        assert_eq!(announced, times.map(|time| (time, Arc::clone(&arm))));

        // Another change of the locations starts again, and does not disturb other records.
        relocations.add(start, &arm);
        relocations.add(start, &leg);
        assert_eq!(relocations.take_due(start).len(), 2);
        let later = start + Duration::from_millis(500);
        relocations.add(later, &arm);
        assert_eq!(relocations.take_due(later), [Arc::clone(&arm)]);
        let second = start + Duration::from_secs(1);
        assert_eq!(relocations.take_due(second), [leg]);
        let of_arm = later + Duration::from_secs(1);
        assert_eq!(relocations.take_due(of_arm), [arm]);
    }

    #[test]
    fn a_record_that_became_outdated_is_announced_again_at_a_bounded_rate() {
        let mut relocations = Relocations::default();
        let (start, arm): (_, Arc<str>) = (Instant::now(), "arm".into());
        assert!(!relocations.handle_outdated(start, &arm));
        relocations.add(start, &arm);
        assert_eq!(relocations.take_due(start).len(), 1);
        let mut sent = 0;
        for milliseconds in 0..600 {
            let now = start + Duration::from_millis(milliseconds);
            relocations.handle_outdated(now, &arm);
            sent += relocations.take_due(now).len();
        }
        assert_eq!(sent, 5, "one each 100 ms");
        // After the last correction, at 600 ms, the series goes on, and ends.
        let mut now = start;
        while let Some(due) = relocations.poll_timeout() {
            now = due;
            sent += relocations.take_due(now).len();
        }
        assert_eq!(sent, 5 + 1 + INTERVALS.len());
        assert!(!relocations.handle_outdated(now, &arm));
    }

    #[test]
    fn the_number_of_records_is_bounded() {
        let mut relocations = Relocations::default();
        let now = Instant::now();
        for number in 0..2 * MAX_RECORDS {
            relocations.add(now, &number.to_string().into());
        }
        assert_eq!(relocations.take_due(now).len(), MAX_RECORDS);
    }
}
