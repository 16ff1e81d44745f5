//! Static peers: message transport services in the configuration, with which this service keeps in
//! touch before any letter needs them.
//!
//! Being in touch means that a parcel without effect (a credit that no lane waits for) was recently
//! answered. The check opens the connection, keeps it from being closed as idle, and detects when
//! it is dead; the transport learns which service is at the other end.
//!
//! All locations of a peer are checked concurrently until one answers, so that addresses without a
//! host (a peer may be listed with several, and have only one of them) cause no delay.

use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_transport::{
    AttemptId, Body, Conclusion, Incarnation, Location, Signature, Stream, WayError, WayFault,
};

use super::desk::{Desk, Purpose, note_parcel};

/// A message transport service in the configuration.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Peer {
    /// Its name in the configuration.
    pub name: Arc<str>,
    /// Its possible locations. The service there is unknown until it answers.
    pub locations: Vec<Location>,
}

/// The state of contact with a static peer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PeerState {
    /// The peer.
    pub peer: Peer,
    /// The location that answered last, if it still does.
    pub answers: Option<Location>,
    /// The error of each location since a location last answered.
    pub failures: Vec<(Location, WayError)>,
    /// Number of consecutive rounds in which no location answered.
    pub rounds: u32,
    /// Time until the next check; `None` while an answer is awaited.
    pub asked_again_in: Option<Duration>,
}

/// Interval of checks of a peer that answers.
const KEEP: Duration = Duration::from_secs(5);
/// Backoff before a location that did not answer is checked again.
const FIRST_PAUSE: Duration = Duration::from_millis(100);
const LONGEST_PAUSE: Duration = Duration::from_secs(2);
/// Pause before a check after a connection with the peer has ended.
const PARTED_PAUSE: Duration = Duration::from_millis(200);

/// The static peers of a service.
#[derive(Debug, Default)]
pub(super) struct Peers {
    all: Vec<Watched>,
    next: u64,
    /// The earliest time of all peers.
    due: Option<Instant>,
}

#[derive(Debug)]
struct Watched {
    id: u64,
    peer: Peer,
    /// Its locations in the order of the configuration's transports.
    ways: Vec<Way>,
    /// The location that answers. No other location is checked meanwhile.
    answers: Option<Location>,
}

/// A location of a peer.
#[derive(Debug)]
struct Way {
    location: Location,
    state: State,
    /// Number of consecutive failures.
    failures: u32,
    /// Its latest error since a location of the peer last answered.
    error: Option<WayError>,
    last_asked: Option<Instant>,
}

#[derive(Debug, Clone, Copy)]
enum State {
    AskAt(Instant),
    Asked { attempt: AttemptId, until: Instant },
}

impl Peers {
    /// Replaces the list of peers. Peers on both lists keep their state.
    pub(super) fn set(&mut self, now: Instant, peers: Vec<Peer>, desk: &mut Desk) {
        let mut before = std::mem::take(&mut self.all);
        for peer in peers {
            let same = before.iter().position(|watched| watched.peer == peer);
            let mut watched = match same {
                Some(index) => before.swap_remove(index),
                None => {
                    self.next += 1;
                    Watched::new(self.next, peer)
                }
            };
            watched.order(now, desk);
            self.all.push(watched);
        }
        for gone in before {
            gone.ways.into_iter().for_each(|way| way.give_up(desk));
        }
        self.ask_those_due(now, desk);
    }

    /// Applies a new order of transports.
    pub(super) fn reorder(&mut self, now: Instant, desk: &mut Desk) {
        for watched in &mut self.all {
            watched.order(now, desk);
        }
        self.ask_those_due(now, desk);
    }

    /// Handles the end of a connection that was opened for this location.
    pub(super) fn parted(&mut self, now: Instant, location: &Location) {
        let ways = self.all.iter_mut().flat_map(|watched| &mut watched.ways);
        for way in ways.filter(|way| way.location == *location) {
            let soon = way.last_asked.map_or(now, |asked| asked + PARTED_PAUSE);
            way.ask_by(soon.max(now));
        }
        self.look_ahead();
    }

    /// Checks all peers at once, because this host's network has changed.
    pub(super) fn ask_again(&mut self, now: Instant, desk: &mut Desk) {
        let ways = self.all.iter_mut().flat_map(|watched| &mut watched.ways);
        for way in ways {
            way.failures = 0;
            way.ask_by(now);
        }
        self.ask_those_due(now, desk);
    }

    /// Time of the next call of [`handle_timeout`](Self::handle_timeout).
    pub(super) fn due(&self) -> Option<Instant> {
        self.due
    }

    pub(super) fn handle_timeout(&mut self, now: Instant, desk: &mut Desk) {
        if self.due.is_none_or(|due| due > now) {
            return;
        }
        for watched in &mut self.all {
            for index in 0..watched.ways.len() {
                let Some(way) = watched.ways.get(index) else {
                    break;
                };
                if let State::Asked { attempt, until } = way.state
                    && until <= now
                {
                    desk.drop_attempt(way.location.kind(), attempt);
                    watched.failed(now, index, WayError::new(WayFault::TimedOut, ""));
                }
            }
        }
        self.ask_those_due(now, desk);
    }

    /// Handles the conclusion of a check.
    pub(super) fn concluded(
        &mut self,
        now: Instant,
        (peer, attempt): (u64, AttemptId),
        conclusion: Conclusion,
        desk: &mut Desk,
    ) {
        let Some(watched) = self.all.iter_mut().find(|watched| watched.id == peer) else {
            return;
        };
        let is_asked = |way: &Way| matches!(way.state, State::Asked { attempt: asked, .. } if asked == attempt);
        let Some(index) = watched.ways.iter().position(is_asked) else {
            return;
        };
        match conclusion {
            Conclusion::NotSent(error) | Conclusion::Unconfirmed(error) => {
                watched.failed(now, index, error);
            }
            // Any answer shows that the peer is reachable.
            _ => watched.answered(now, index),
        }
        self.ask_those_due(now, desk);
    }

    pub(super) fn states(&self, now: Instant) -> Vec<PeerState> {
        self.all.iter().map(|watched| watched.tell(now)).collect()
    }

    fn ask_those_due(&mut self, now: Instant, desk: &mut Desk) {
        for watched in &mut self.all {
            watched.ask_those_due(now, desk);
        }
        self.look_ahead();
    }

    fn look_ahead(&mut self) {
        self.due = self.all.iter().filter_map(Watched::due).min();
    }
}

impl Watched {
    fn new(id: u64, peer: Peer) -> Self {
        Self {
            id,
            peer,
            ways: Vec::new(),
            answers: None,
        }
    }

    /// Sorts the locations by the order of transports, which may have changed.
    fn order(&mut self, now: Instant, desk: &mut Desk) {
        let mut before = std::mem::take(&mut self.ways);
        let order = desk.config.order.iter();
        let listed = order.flat_map(|kind| {
            let all = self.peer.locations.iter();
            // Legacy peers accept only letters.
            all.filter(move |location| {
                location.kind() == *kind && location.signature() == Signature::Frames
            })
        });
        for location in listed {
            let known = before.iter().position(|way| way.location == *location);
            self.ways.push(match known {
                Some(index) => before.swap_remove(index),
                None => Way::new(now, location.clone()),
            });
        }
        for gone in before {
            self.answers.take_if(|at| *at == gone.location);
            gone.give_up(desk);
        }
    }

    /// Whether this location is checked: all are until one answers.
    fn is_of_use(&self, way: &Way) -> bool {
        self.answers.as_ref().is_none_or(|at| *at == way.location)
    }

    fn due(&self) -> Option<Instant> {
        let due = |way: &Way| match way.state {
            State::AskAt(at) => self.is_of_use(way).then_some(at),
            State::Asked { until, .. } => Some(until),
        };
        self.ways.iter().filter_map(due).min()
    }

    fn ask_those_due(&mut self, now: Instant, desk: &mut Desk) {
        let (id, name, answers) = (self.id, &self.peer.name, &self.answers);
        let of_use = |way: &&mut Way| answers.as_ref().is_none_or(|at| *at == way.location);
        for way in self.ways.iter_mut().filter(of_use) {
            if matches!(way.state, State::AskAt(at) if at <= now) {
                way.ask(now, (id, name), desk);
            }
        }
    }

    fn answered(&mut self, now: Instant, index: usize) {
        let Some(way) = self.ways.get_mut(index) else {
            return;
        };
        if self.answers.is_none() {
            tracing::info!(peer = %self.peer.name, at = %way.location, "the static peer answers");
        }
        way.state = State::AskAt(now + KEEP);
        self.answers = Some(way.location.clone());
        for way in &mut self.ways {
            way.failures = 0;
            way.error = None;
        }
    }

    fn failed(&mut self, now: Instant, index: usize, error: WayError) {
        let Some(way) = self.ways.get_mut(index) else {
            return;
        };
        let parted = self.answers.take_if(|at| *at == way.location).is_some();
        if parted || way.failures == 0 && self.answers.is_none() {
            tracing::info!(peer = %self.peer.name, at = %way.location, %error, "the static peer does not answer");
        }
        let pause = FIRST_PAUSE.saturating_mul(1 << way.failures.min(10));
        way.state = State::AskAt(now + pause.min(LONGEST_PAUSE));
        way.failures = way.failures.saturating_add(1);
        if self.answers.is_none() {
            way.error = Some(error);
        }
        if parted {
            let others = self.ways.iter_mut().enumerate();
            others
                .filter(|(other, _)| *other != index)
                .for_each(|(_, way)| way.ask_by(now));
        }
    }

    fn tell(&self, now: Instant) -> PeerState {
        let failed = |way: &Way| Some((way.location.clone(), way.error.clone()?));
        let awaited = |way: &Way| matches!(way.state, State::Asked { .. });
        let due = self.due().filter(|_| !self.ways.iter().any(awaited));
        PeerState {
            peer: self.peer.clone(),
            answers: self.answers.clone(),
            failures: self.ways.iter().filter_map(failed).collect(),
            rounds: self.ways.iter().map(|way| way.failures).min().unwrap_or(0),
            asked_again_in: due.map(|due| due.saturating_duration_since(now)),
        }
    }
}

impl Way {
    fn new(now: Instant, location: Location) -> Self {
        Self {
            location,
            state: State::AskAt(now),
            failures: 0,
            error: None,
            last_asked: None,
        }
    }

    /// Schedules a check for this time at the latest, unless an answer is awaited.
    fn ask_by(&mut self, time: Instant) {
        if let State::AskAt(at) = &mut self.state {
            *at = time.min(*at);
        }
    }

    fn ask(&mut self, now: Instant, (peer, name): (u64, &Arc<str>), desk: &mut Desk) {
        let no_stream = Stream {
            sender: Incarnation::UNKNOWN,
            receiver: Incarnation::UNKNOWN,
        };
        let parcel = note_parcel(no_stream, Arc::clone(name), 0, Body::Credit);
        let attempt = desk.next_attempt();
        let purpose = Purpose::Touch { peer };
        desk.dispatch(attempt, purpose, self.location.clone(), parcel);
        self.last_asked = Some(now);
        self.state = State::Asked {
            attempt,
            // Opening a connection may take longer than an answer on an open one.
            until: now + desk.config.attempt_timeout * 3,
        };
    }

    fn give_up(self, desk: &mut Desk) {
        if let State::Asked { attempt, .. } = self.state {
            desk.drop_attempt(self.location.kind(), attempt);
        }
    }
}
