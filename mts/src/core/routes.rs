//! The choice of a route: the location of a receiver that its next letter goes to, and the failures that
//! put a location back.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use fipa_sds::Entry;
use fipa_transport::{Kind, Location, Signature};

use crate::Map;

/// The health of the locations to which letters go.
#[derive(Debug, Default)]
pub(crate) struct Routes {
    health: Map<Location, Health>,
    /// The latest locations that their services have left for others.
    vacated: VecDeque<Location>,
}

#[derive(Debug)]
struct Health {
    failures: u32,
    retry_at: Instant,
}

/// Backoff of a failed route.
const LONGEST_PENALTY: Duration = Duration::from_secs(5);

const FIRST_PENALTY: Duration = Duration::from_millis(100);

/// Maximum number of locations that are remembered after their services have left them.
const MAX_VACATED: usize = 64;

/// Maximum number of failed routes that are remembered.
const MAX_HEALTH: usize = 4096;

impl Routes {
    /// Records a location that its service has left for another one.
    pub(super) fn service_left(&mut self, location: &Location) {
        self.vacated.retain(|other| other != location);
        if self.vacated.len() >= MAX_VACATED {
            self.vacated.pop_front();
        }
        self.vacated.push_back(location.clone());
    }

    /// Whether the service at this location has recently left it for another one.
    pub(crate) fn service_has_left(&self, location: &Location) -> bool {
        self.vacated.contains(location)
    }

    /// Returns the best location of this receiver that is not in `tried`: by this order of transports,
    /// with recently failed ones last.
    pub(crate) fn choose(
        &self,
        now: Instant,
        order: &[Kind],
        entry: &Entry,
        tried: &[Location],
    ) -> Option<Location> {
        let ways = order.iter().flat_map(|kind| {
            entry
                .locations
                .iter()
                .filter(move |location| location.kind() == *kind)
        });
        let untried =
            ways.filter(|location| leads_to_letters(location) && !tried.contains(location));
        // The first healthy route; without one, the route that may be retried soonest.
        let mut fallback: Option<(&Location, Instant)> = None;
        for location in untried {
            match self.health.get(location) {
                Some(health) if health.retry_at > now => {
                    if fallback.is_none_or(|(_, soonest)| health.retry_at < soonest) {
                        fallback = Some((location, health.retry_at));
                    }
                }
                _ => return Some(location.clone()),
            }
        }
        fallback.map(|(location, _)| location.clone())
    }

    /// Number of consecutive failures of this route, and the end of its backoff, if it is in
    /// backoff.
    pub(super) fn failing(&self, now: Instant, location: &Location) -> Option<(u32, Instant)> {
        let health = self.health.get(location)?;
        (health.retry_at > now).then_some((health.failures, health.retry_at))
    }

    /// Records that a letter was taken at this location.
    pub(crate) fn worked(&mut self, location: &Location) {
        if !self.health.is_empty() {
            self.health.remove(location);
        }
    }

    /// Drops the recorded failures of these routes. Returns whether there were any.
    pub(super) fn forget_failures(&mut self, which: impl Fn(&Location) -> bool) -> bool {
        let before = self.health.len();
        self.health.retain(|location, _| !which(location));
        self.health.len() < before
    }

    /// Records a failed attempt at this location, which puts it back for a time that doubles.
    pub(super) fn failed(&mut self, now: Instant, location: &Location) {
        if self.health.len() >= MAX_HEALTH && !self.health.contains_key(location) {
            self.health.retain(|_, health| health.retry_at > now);
            if self.health.len() >= MAX_HEALTH {
                return;
            }
        }
        let health = self.health.entry(location.clone()).or_insert(Health {
            failures: 0,
            retry_at: now,
        });
        let penalty = FIRST_PENALTY.saturating_mul(1 << health.failures.min(10));
        health.failures += 1;
        health.retry_at = now + penalty.min(LONGEST_PENALTY);
    }
}

/// Whether letters may be sent to a location. A service of this project is not reached in the dialect
/// of legacy peers, whose letters have no number: it could not recognize one that is repeated.
pub(super) fn leads_to_letters(location: &Location) -> bool {
    location.signature() == Signature::Frames || !location.incarnation().is_known()
}
