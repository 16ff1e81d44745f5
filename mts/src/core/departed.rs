//! Registrations that recently left this host. Letters that were sent to one of them before that
//! became known are answered with [`Answer::Moved`]: they are certainly not taken, and the sender's
//! process may send them to the next registration of the name.
//!
//! [`Answer::Moved`]: fipa_transport::Answer::Moved

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use fipa_sds::{Entry, Reach, Role};
use fipa_transport::Incarnation;

use crate::Map;

/// Time for which a registration is remembered: longer than the news of its departure takes to
/// spread.
const MEMORY: Duration = Duration::from_secs(30);
/// Maximum number of registrations; the earliest departure is evicted first.
const MAX_DEPARTED: usize = 4096;

/// Registrations that recently left this host.
#[derive(Debug, Default)]
pub(crate) struct Departed {
    since: Map<Incarnation, Instant>,
    order: VecDeque<(Instant, Incarnation)>,
}

impl Departed {
    /// Records an entry that left the directory or was replaced by another registration.
    pub(super) fn record_departure(&mut self, now: Instant, entry: &Entry) {
        if entry.reach != Reach::Local || entry.role != Role::Agent {
            return;
        }
        while let Some((since, registration)) = self.order.front().copied() {
            let old = now.saturating_duration_since(since) > MEMORY;
            if !old && self.order.len() < MAX_DEPARTED {
                break;
            }
            self.order.pop_front();
            self.since.remove(&registration);
        }
        if self.since.insert(entry.incarnation, now).is_none() {
            self.order.push_back((now, entry.incarnation));
        }
    }

    /// Whether this registration recently left this host.
    pub(crate) fn contains(&self, now: Instant, registration: Incarnation) -> bool {
        let since = self.since.get(&registration);
        since.is_some_and(|since| now.saturating_duration_since(*since) <= MEMORY)
    }
}

#[cfg(test)]
mod tests {
    use fipa_sds::{Directory, MemoryDirectory, MtsId, Registration};
    use std::sync::Arc;

    use super::*;

    fn entry() -> Entry {
        let directory = MemoryDirectory::new(MtsId::new("mts", Incarnation::from_u64(1)));
        let arm = Registration::new("arm", Incarnation::from_u64(7), Vec::new());
        directory.register(arm).unwrap();
        Entry::clone(&Arc::clone(&directory.lookup("arm").unwrap()))
    }

    #[test]
    fn a_departed_registration_is_remembered_for_a_limited_time() {
        let (entry, now) = (entry(), Instant::now());
        let mut departed = Departed::default();
        assert!(!departed.contains(now, entry.incarnation));
        departed.record_departure(now, &entry);
        assert!(departed.contains(now, entry.incarnation));
        assert!(!departed.contains(now, Incarnation::from_u64(9)));
        assert!(!departed.contains(now + MEMORY * 2, entry.incarnation));
    }

    #[test]
    fn the_number_of_departed_registrations_is_bounded() {
        let (mut entry, now) = (entry(), Instant::now());
        let mut departed = Departed::default();
        for number in 0..10_000 {
            entry.incarnation = Incarnation::from_u64(100 + number);
            departed.record_departure(now, &entry);
        }
        assert_eq!(departed.since.len(), MAX_DEPARTED);
        assert_eq!(departed.order.len(), MAX_DEPARTED);
        entry.incarnation = Incarnation::from_u64(8);
        departed.record_departure(now + MEMORY * 2, &entry);
        assert_eq!(departed.since.len(), 1);
    }
}
