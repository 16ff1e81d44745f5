//! The state that all lanes share: the actions for the runtime, the attempts in progress, the choice of a route by
//! the configured order, and the parts below them.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_acl::Time;
use fipa_sds::{Entry, Source, View};
use fipa_transport::counts::{Counts, SharedCounts};
use fipa_transport::{
    Attempt, AttemptId, Body, FailureReason, Incarnation, Location, Parcel, Principal, Stream,
    TransportError, TransportErrorKind,
};

use super::action::Action;
use super::departed::Departed;
use super::ids::{LaneId, registration_by_name};
use super::label::PredecessorNote;
use super::lane_budget::LaneBudget;
use super::notes::{Note, Notes, note_parcel};
use super::routes::Routes;
use super::tally::Tallies;
use super::undelivered::Undelivered;
use super::{CoreConfig, News, Notice};
use crate::Map;

/// Purpose of an attempt.
#[derive(Debug)]
pub(crate) enum Purpose {
    /// A letter of a lane.
    Letter { lane: LaneId, sequence: u64 },
    /// A report, a credit or a predecessor.
    Note(Box<Note>),
    /// Check of contact with a static peer.
    PeerCheck { peer: u64 },
}

/// State that all lanes share.
pub(crate) struct LaneTable {
    pub(crate) config: CoreConfig,
    pub(crate) view: Arc<dyn View>,
    pub(crate) actions: VecDeque<Action>,
    pub(crate) attempts: Map<AttemptId, Purpose>,
    pub(crate) undelivered: VecDeque<Undelivered>,
    pub(super) notes: Notes,
    pub(crate) departed: Departed,
    /// Services whose certificate is no longer trusted.
    pub(crate) withdrawn: Map<Incarnation, Principal>,
    pub(super) custody: LaneBudget,
    pub(super) routes: Routes,
    pub(super) tallies: Tallies,
    /// The counters of this process.
    counts: SharedCounts,
    /// Whether a watcher is notified of events.
    pub(crate) watched: bool,
    /// Smoothed time in which each service acknowledges reports.
    round_trips: Map<Incarnation, Duration>,
    next_attempt: u64,
    /// Lanes that wait for a refresh of the directory, with its number.
    refreshing: VecDeque<(u64, LaneId)>,
    /// Number of refreshes that were requested.
    refreshes: u64,
}

/// Maximum number of services whose round trips are remembered.
const MAX_ROUND_TRIPS: usize = 4096;

impl LaneTable {
    pub(crate) fn new(config: CoreConfig, view: Arc<dyn View>) -> Self {
        Self {
            config,
            view,
            actions: VecDeque::new(),
            attempts: Map::default(),
            undelivered: VecDeque::new(),
            notes: Notes::default(),
            departed: Departed::default(),
            withdrawn: Map::default(),
            custody: LaneBudget::default(),
            routes: Routes::default(),
            tallies: Tallies::default(),
            counts: Arc::new(Counts::default()),
            watched: false,
            round_trips: Map::default(),
            next_attempt: 1,
            refreshing: VecDeque::new(),
            refreshes: 0,
        }
    }

    /// The counters of this process. Only the core writes them, except those of violations.
    pub(crate) fn counts(&self) -> &Counts {
        (*self.counts).as_ref()
    }

    pub(super) fn count_in(&mut self, counts: SharedCounts) {
        self.counts = counts;
    }

    /// The reason for which a letter to an agent fails that the directory does not list. For a [lost
    /// agent](fipa_sds::View::lost_agents), the attempt names the location of its gateway.
    pub(super) fn absence(&self, name: &str) -> (FailureReason, Option<Attempt>) {
        let Some(lost) = self.view.lost_agent(name) else {
            return (FailureReason::NoSuchAgent, None);
        };
        let location = lost.locations.first();
        let attempt = |why| {
            location.map(|location| Attempt {
                via: location.kind(),
                location: location.clone(),
                error: TransportError::new(TransportErrorKind::Unreachable, why),
            })
        };
        let time = Time::from_system_time(lost.registered).ok();
        let time = time.and_then(Time::to_rfc3339).unwrap_or_default();
        if lost.source == Source::Contact {
            let why = format!(
                "the gateway forgot this agent at {time}, because it knows as many of that host as it can; it can be \
                 answered after it sends another letter"
            );
            return (FailureReason::NoSuchAgent, attempt(why));
        }
        let why = format!("its host {} was last seen at {time}", lost.mts.shown());
        (FailureReason::Unreachable, attempt(why))
    }

    /// Requests a refresh of the directory, and returns its number.
    pub(crate) fn want_refresh(&mut self) -> u64 {
        self.refreshes += 1;
        let number = self.refreshes;
        self.actions.push_back(Action::Refresh { number });
        number
    }

    /// Requests a refresh of the directory for a lane, and returns its number.
    pub(crate) fn want_refresh_for(&mut self, lane: LaneId) -> u64 {
        let number = self.want_refresh();
        self.refreshing.push_back((number, lane));
        number
    }

    /// Returns the next lane that waits for this refresh or an earlier one.
    pub(crate) fn refreshed_lane(&mut self, number: u64) -> Option<LaneId> {
        let (first, _) = self.refreshing.front()?;
        if *first > number {
            return None;
        }
        self.refreshing.pop_front().map(|(_, lane)| lane)
    }

    /// Returns the number of the next attempt, which is also the number of its hand-over.
    pub(crate) fn next_attempt(&mut self) -> AttemptId {
        let attempt = AttemptId(self.next_attempt);
        self.next_attempt += 1;
        attempt
    }

    pub(crate) fn dispatch(
        &mut self,
        attempt: AttemptId,
        purpose: Purpose,
        location: Location,
        parcel: Parcel,
    ) {
        self.attempts.insert(attempt, purpose);
        self.actions.push_back(Action::Dispatch {
            attempt,
            location,
            parcel,
        });
    }

    /// Makes the transport end an attempt, whose conclusion follows at once.
    pub(crate) fn abandon(
        &mut self,
        location: Location,
        attempt: AttemptId,
        error: TransportError,
    ) {
        self.actions.push_back(Action::Abandon {
            attempt,
            location,
            error,
        });
    }

    /// Makes the transport end an attempt whose conclusion is ignored.
    pub(crate) fn drop_attempt(&mut self, location: Location, attempt: AttemptId) {
        if self.attempts.remove(&attempt).is_some() {
            let error = TransportError::new(TransportErrorKind::TimedOut, "");
            self.abandon(location, attempt, error);
        }
    }

    /// The [best location](Routes::choose) of this receiver that is not in `tried`, by the configured order.
    pub(crate) fn choose(
        &self,
        now: Instant,
        entry: &Entry,
        tried: &[Location],
    ) -> Option<Location> {
        let order = self.config.order_for(&entry.name, entry.reach);
        self.routes.choose(now, order, entry, tried)
    }

    /// Records a failed attempt at this location.
    pub(crate) fn route_failed(
        &mut self,
        now: Instant,
        location: &Location,
        fault: TransportErrorKind,
    ) {
        if self.config.forwards && location.incarnation().is_known() {
            self.actions.push_back(Action::Suspect {
                location: location.clone(),
                fault,
            });
        }
        self.routes.failed(now, location);
    }

    pub(crate) fn credit(&mut self, stream: Stream, receiver: Arc<str>, back: Location) {
        let parcel = note_parcel(stream, receiver, 0, Body::Credit);
        self.note(Note::once(back, parcel));
    }

    /// Sends a service the current predecessor of a letter that was handed over in this transfer,
    /// and asks whether it has the letter. A lost note only costs time: the service returns the
    /// letter after waiting, or is asked again.
    pub(crate) fn predecessor(
        &mut self,
        stream: Stream,
        receiver: Arc<str>,
        note: PredecessorNote,
        location: Location,
    ) {
        let parcel = Parcel {
            after: note.after,
            transfer: note.transfer,
            ..note_parcel(stream, receiver, note.sequence, Body::Predecessor)
        };
        self.note(Note::once(location, parcel));
    }

    /// Notifies the watcher, if there is one.
    pub(crate) fn notice(
        &mut self,
        stream: Stream,
        sequence: u64,
        receiver: &Arc<str>,
        news: impl FnOnce() -> News,
    ) {
        if self.watched {
            self.actions.push_back(Action::Notice(Box::new(Notice {
                stream,
                sequence,
                receiver: Arc::clone(receiver),
                news: news(),
            })));
        }
    }

    /// Resolves the receiver of a stream, if it is in the view of the directory. Another host may
    /// announce an agent with this registration under another name, which is not the receiver.
    pub(crate) fn receiver(&self, registration: Incarnation, name: &str) -> Option<Arc<Entry>> {
        let registered = self.view.registered(registration);
        let registered = registered.filter(|entry| *entry.name == *name);
        registered.or_else(|| {
            let entry = self.view.named(name)?;
            let is_meant = match entry.incarnation.is_known() {
                true => entry.incarnation == registration,
                false => registration == registration_by_name(name),
            };
            is_meant.then_some(entry)
        })
    }

    /// Records the time in which a service acknowledged a report.
    pub(crate) fn acknowledged(&mut self, service: Incarnation, took: Duration) {
        if let Some(known) = self.round_trips.get_mut(&service) {
            // Smoothed, as TCP does (RFC 6298 section 2).
            *known = (*known * 7 + took) / 8;
            return;
        }
        if self.round_trips.len() >= MAX_ROUND_TRIPS {
            self.round_trips.clear();
        }
        self.round_trips.insert(service, took);
    }

    /// The smoothed time in which this service acknowledges reports, if known.
    pub(crate) fn round_trip(&self, service: Incarnation) -> Option<Duration> {
        self.round_trips.get(&service).copied()
    }

    /// Records that an agent of a legacy peer took a letter.
    pub(crate) fn taken_by_legacy_peer(&mut self, receiver: &Arc<str>, location: &Location) {
        if self.config.forwards {
            let (name, location) = (Arc::clone(receiver), location.clone());
            self.actions.push_back(Action::Taken { name, location });
        }
    }
}
