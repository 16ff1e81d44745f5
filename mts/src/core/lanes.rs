//! The lanes of the core: their creation, their visits in portions, and the end of idle ones.

use std::cmp::Reverse;
use std::sync::Arc;
use std::time::Duration;

use fipa_sds::{Entry, Role};
use fipa_transport::{Incarnation, Location, Stream};

use super::ids::{LaneId, LaneKey, registration_of};
use super::lane::{Lane, OpenLetter, PauseEnd};
use super::lane_table::LaneTable;
use super::passes::{Concern, Step};
use super::{Core, Now, work};

/// Maximum number of lanes that one call visits for one cause. Peers can have tens of thousands of lanes kept, and
/// the service is locked during a call.
pub(super) const LANES_AT_ONCE: usize = 16;

/// Empty lanes are dropped when there are more lanes than this.
pub(super) const IDLE_LANES: usize = 1024;

/// Minimum time for which a lane without letters is kept.
const IDLE_TIME: Duration = Duration::from_secs(60);

/// This minimum when many lanes are created in a short time. A lane that is dropped too early costs time,
/// but no letter: its next letter waits longer for a predecessor that failed.
const IDLE_TIME_IN_A_CROWD: Duration = Duration::from_secs(1);

impl Core {
    /// Puts a letter into its lane and dispatches what can be dispatched.
    pub(super) fn put(&mut self, now: Now, lane: LaneId, open_letter: Box<OpenLetter>) {
        self.with_lane(now, lane, |lane, table| {
            lane.push(open_letter, table);
            lane.dispatch_all(now.instant, table);
        });
    }

    /// Returns the lane with this key; creates it if necessary.
    pub(super) fn lane(&mut self, now: Now, key: LaneKey, receiver: &Arc<str>) -> LaneId {
        if let Some(id) = self.lane_ids.get(&key) {
            return *id;
        }
        self.disperse_crowd(now);
        let id = LaneId(self.next_lane);
        self.next_lane += 1;
        self.lane_ids.insert(key.clone(), id);
        let lane = Lane::new(now.instant, id, key, Arc::clone(receiver));
        self.lanes.insert(id, Box::new(lane));
        self.lane_order.insert(id);
        id
    }

    /// All lanes in the order of creation. Not for events that peers cause; see [`Passes`].
    pub(super) fn lanes_in_order(&self) -> Vec<LaneId> {
        work::steps(self.lanes.len());
        self.lane_order.iter().copied().collect()
    }

    /// Returns the lane with letters of this stream for the receiver of this name.
    pub(super) fn lane_of(&self, stream: Stream, receiver: &Arc<str>) -> Option<LaneId> {
        let keys = [
            LaneKey::Custody(stream),
            LaneKey::Name(stream.sender, Arc::clone(receiver)),
            LaneKey::Service(stream),
        ];
        keys.iter().find_map(|key| self.lane_ids.get(key).copied())
    }

    /// Runs `work` on a lane, then schedules its timer and repeated notes.
    pub(super) fn with_lane(
        &mut self,
        now: Now,
        id: LaneId,
        work: impl FnOnce(&mut Lane, &mut LaneTable),
    ) {
        let Some(lane) = self.lanes.get_mut(&id) else {
            return;
        };
        work(lane, &mut self.table);
        if self.backlog.has_any_of(id) {
            self.relieve(now, id);
        }
        let Some(lane) = self.lanes.get_mut(&id) else {
            return;
        };
        if let Some(due) = lane.due()
            && lane.scheduled.is_none_or(|scheduled| due < scheduled)
        {
            lane.scheduled = Some(due);
            self.timers.push(Reverse((due, id)));
        }
        self.await_answers(now);
    }

    /// Visits the next lanes that an event concerns.
    pub(super) fn visit_lanes(&mut self, now: Now) {
        for _ in 0..LANES_AT_ONCE {
            work::steps(1);
            match self.passes.next(now.instant, &self.lane_order) {
                Some(Step::Visit(concern, id)) => self.visit_lane(now, id, concern),
                Some(Step::End(Concern::Crowd)) => {
                    self.crowd = 2 * self.lanes.len().max(IDLE_LANES);
                }
                Some(Step::End(_)) => {}
                None => break,
            }
        }
    }

    fn visit_lane(&mut self, now: Now, id: LaneId, concern: Concern) {
        match concern {
            Concern::Directory => self.with_lane(now, id, |lane, table| {
                if !lane.is_empty() {
                    lane.directory_changed(now.instant, table);
                }
            }),
            Concern::Reachable(service) => self.with_lane(now, id, |lane, table| {
                if lane.is_paused_towards(table, |location| is_at(service, location)) {
                    lane.resume(now.instant, PauseEnd::Reachable, table);
                }
            }),
            Concern::Idle => self.forget_idle_lane(now, id, IDLE_TIME),
            Concern::Crowd => self.forget_idle_lane(now, id, IDLE_TIME_IN_A_CROWD),
        }
    }

    fn forget_idle_lane(&mut self, now: Now, id: LaneId, memory: Duration) {
        let Some(lane) = self.lanes.get(&id) else {
            return;
        };
        let quiet = now.instant.saturating_duration_since(lane.active) > memory;
        let is_awaited = self.backlog.has_any_of(id);
        if lane.is_idle() && !is_awaited && (quiet || !lane.remembers()) {
            self.lane_ids.remove(lane.key());
            self.lanes.remove(&id);
            self.lane_order.remove(&id);
        }
    }

    pub(super) fn forget_idle_lanes(&mut self, now: Now) {
        if self.lanes.len() <= IDLE_LANES || self.next_forget.is_some_and(|due| due > now.instant) {
            return;
        }
        self.next_forget = Some(now.instant + IDLE_TIME / 4);
        self.passes.begin(now.instant, Concern::Idle);
    }

    /// Drops empty lanes when their number has doubled since the last time, because peers can invent
    /// senders, each with a lane.
    fn disperse_crowd(&mut self, now: Now) {
        let is_under_way = self.passes.has(Concern::Crowd);
        if self.lanes.len() < self.crowd && !is_under_way {
            return;
        }
        if !is_under_way {
            self.passes.begin(now.instant, Concern::Crowd);
        }
        self.visit_lanes(now);
    }

    pub(super) fn forget_lanes(&mut self, forget: impl Fn(&Lane) -> bool) {
        work::steps(self.lanes.len());
        let ids = &mut self.lane_ids;
        let order = &mut self.lane_order;
        let backlog = &self.backlog;
        self.lanes.retain(|id, lane| {
            let goes = forget(lane) && !backlog.has_any_of(*id);
            if goes {
                ids.remove(lane.key());
                order.remove(id);
            }
            !goes
        });
    }

    /// Whether another letter of this process can wait in this lane. Letters in the backlog of the lane go first.
    pub(super) fn has_room_to_wait(&self, now: Now, id: LaneId, len: usize) -> bool {
        let lane = self.lanes.get(&id).filter(|_| !self.backlog.has_any_of(id));
        lane.is_some_and(|lane| lane.has_room_to_wait(now.instant, len, &self.table))
    }

    /// Whether this lane has room for a letter whose sender cannot be held back. Letters in the backlog of the lane go
    /// first.
    pub(super) fn has_room_for_stranger(&self, id: LaneId, len: usize) -> bool {
        let lane = self.lanes.get(&id).filter(|_| !self.backlog.has_any_of(id));
        lane.is_some_and(|lane| {
            lane.has_room(len, &self.table) && lane.fits_into_custody(len, &self.table)
        })
    }

    /// Makes the letters of a lane wait until the agents of other hosts were published to the processes of this host, so
    /// that their receivers can answer.
    pub(super) fn await_publication(&mut self, lane: LaneId) {
        if let Some(lane) = self.lanes.get_mut(&lane) {
            lane.want_refresh(&mut self.table);
        }
    }
}

/// Whether this service is at the location; `None` stands for all services.
pub(super) fn is_at(service: Option<Incarnation>, location: &Location) -> bool {
    service.is_none_or(|it| it == location.incarnation())
}

/// Key of the lane for letters that this process sends to this receiver.
pub(super) fn own_lane(sender: Incarnation, entry: &Entry) -> LaneKey {
    match entry.role {
        Role::Agent => LaneKey::Name(sender, Arc::clone(&entry.name)),
        // Several services may have the same name.
        _ => LaneKey::Service(Stream::between(sender, registration_of(entry))),
    }
}
