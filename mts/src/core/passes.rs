//! Visits of all lanes, because of an event that may concern any of them. Peers can cause such events, and can have
//! tens of thousands of lanes kept, so lanes are visited in portions, between which the service is unlocked.

use std::collections::{BTreeSet, VecDeque};
use std::ops::Bound;
use std::time::Instant;

use fipa_transport::Incarnation;

use super::ids::LaneId;

/// An event that may concern any lane.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Concern {
    /// The directory has changed.
    Directory,
    /// Routes to this service, or all routes, may work again.
    Reachable(Option<Incarnation>),
    /// Lanes without letters may be dropped.
    Idle,
    /// Lanes without letters may be dropped earlier, because many lanes were created in a short time.
    Crowd,
}

/// A step of a pass.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Step {
    Visit(Concern, LaneId),
    /// All lanes were visited.
    End(Concern),
}

/// Maximum number of services whose lanes are visited separately. Beyond it, the lanes of all services are.
const MAX_PASSES: usize = 16;

/// The visits that are not finished, the earliest first.
#[derive(Debug, Default)]
pub(super) struct Passes {
    passes: VecDeque<Pass>,
}

#[derive(Debug)]
struct Pass {
    concern: Concern,
    since: Instant,
    /// The lane that was visited last.
    visited: Option<LaneId>,
    /// Whether the event happened again during the pass. The pass is finished first, so that frequent events
    /// keep no lane from a visit.
    again: bool,
}

impl Passes {
    /// Begins to visit all lanes.
    pub(super) fn begin(&mut self, now: Instant, concern: Concern) {
        let concern = match concern {
            Concern::Reachable(Some(_)) if self.passes.len() >= MAX_PASSES => {
                Concern::Reachable(None)
            }
            _ => concern,
        };
        match self.passes.iter_mut().find(|it| it.concern == concern) {
            Some(pass) => pass.again = pass.visited.is_some(),
            None => self.passes.push_back(Pass {
                concern,
                since: now,
                visited: None,
                again: false,
            }),
        }
    }

    /// Whether a pass for this concern is not finished.
    pub(super) fn has(&self, concern: Concern) -> bool {
        self.passes.iter().any(|pass| pass.concern == concern)
    }

    /// Returns the next step.
    pub(super) fn next(&mut self, now: Instant, lanes: &BTreeSet<LaneId>) -> Option<Step> {
        let pass = self.passes.front_mut()?;
        let after = pass.visited.map_or(Bound::Unbounded, Bound::Excluded);
        if let Some(lane) = lanes.range((after, Bound::Unbounded)).next() {
            pass.visited = Some(*lane);
            return Some(Step::Visit(pass.concern, *lane));
        }
        let Pass { concern, again, .. } = self.passes.pop_front()?;
        if again {
            self.begin(now, concern);
        }
        Some(Step::End(concern))
    }

    /// Time of the next visit, which is over when there is one.
    pub(super) fn due(&self) -> Option<Instant> {
        self.passes.front().map(|pass| pass.since)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const DIRECTORY: Concern = Concern::Directory;

    #[test]
    fn events_during_a_pass_keep_no_lane_from_a_visit() {
        let (mut passes, now) = (Passes::default(), Instant::now());
        let mut lanes: BTreeSet<LaneId> = (0..10).map(LaneId).collect();
        assert_eq!(passes.due(), None);
        let visit = |lane| Step::Visit(DIRECTORY, LaneId(lane));
        for lane in 0..10 {
            passes.begin(now, DIRECTORY);
            assert_eq!(passes.next(now, &lanes), Some(visit(lane)));
        }
        assert_eq!(passes.due(), Some(now));
        // Lanes end and begin meanwhile.
        lanes.remove(&LaneId(0));
        lanes.insert(LaneId(10));
        let rest: Vec<Step> = std::iter::from_fn(|| passes.next(now, &lanes)).collect();
        let end = Step::End(DIRECTORY);
        let expected = [visit(10), end].into_iter();
        let expected = expected.chain((1..=10).map(visit)).chain([end]);
        assert_eq!(rest, expected.collect::<Vec<_>>());
        assert_eq!(passes.due(), None);
    }

    #[test]
    fn the_number_of_passes_is_bounded() {
        let (mut passes, now) = (Passes::default(), Instant::now());
        for service in 0..1000 {
            let service = Incarnation::from_u64(service);
            passes.begin(now, Concern::Reachable(Some(service)));
        }
        passes.begin(now, DIRECTORY);
        assert_eq!(passes.passes.len(), MAX_PASSES + 2);
        let concerns: Vec<Concern> = passes.passes.iter().map(|it| it.concern).collect();
        assert!(concerns.contains(&Concern::Reachable(None)));
        assert!(concerns.contains(&DIRECTORY));
    }
}
