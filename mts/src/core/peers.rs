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
    AttemptId, Body, Conclusion, Incarnation, Location, Signature, Stream, TransportError,
    TransportErrorKind, log_limit,
};

use super::lane_table::{LaneTable, Purpose};
use super::notes::note_parcel;

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
    pub failures: Vec<(Location, TransportError)>,
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
/// Pause before a check after a connection with the peer has ended, which doubles while connections do not
/// last until the next regular check.
const RECONNECT_PAUSE: Duration = Duration::from_millis(200);

/// The static peers of a service.
#[derive(Debug, Default)]
pub(super) struct Peers {
    all: Vec<StaticPeer>,
    next: u64,
    /// The earliest time of all peers.
    due: Option<Instant>,
}

#[derive(Debug)]
struct StaticPeer {
    id: u64,
    peer: Peer,
    /// Its locations in the order of the configuration's transports.
    candidates: Vec<PeerLocation>,
    /// The location that answers. No other location is checked meanwhile.
    answers: Option<Location>,
}

/// A location of a peer.
#[derive(Debug)]
struct PeerLocation {
    location: Location,
    state: State,
    /// Number of consecutive failures.
    failures: u32,
    /// Its latest error since a location of the peer last answered.
    error: Option<TransportError>,
    last_asked: Option<Instant>,
    /// Number of connections that have ended since one lasted.
    short_connections: u32,
    /// Whether a connection has ended since the latest answer.
    has_disconnected: bool,
}

#[derive(Debug, Clone, Copy)]
enum State {
    AskAt(Instant),
    Asked { attempt: AttemptId, until: Instant },
}

impl Peers {
    /// Replaces the list of peers. Peers on both lists keep their state.
    pub(super) fn set(&mut self, now: Instant, peers: Vec<Peer>, table: &mut LaneTable) {
        let mut before = std::mem::take(&mut self.all);
        for peer in peers {
            let same = before
                .iter()
                .position(|static_peer| static_peer.peer == peer);
            let mut static_peer = match same {
                Some(index) => before.swap_remove(index),
                None => {
                    self.next += 1;
                    StaticPeer::new(self.next, peer)
                }
            };
            static_peer.order(now, table);
            self.all.push(static_peer);
        }
        for gone in before {
            gone.candidates
                .into_iter()
                .for_each(|candidate| candidate.give_up(table));
        }
        self.ask_those_due(now, table);
    }

    /// Applies a new order of transports.
    pub(super) fn reorder(&mut self, now: Instant, table: &mut LaneTable) {
        for static_peer in &mut self.all {
            static_peer.order(now, table);
        }
        self.ask_those_due(now, table);
    }

    /// Handles the end of a connection that was opened for this location.
    pub(super) fn disconnected(&mut self, now: Instant, location: &Location) {
        let candidates = self
            .all
            .iter_mut()
            .flat_map(|static_peer| &mut static_peer.candidates);
        for candidate in candidates.filter(|candidate| candidate.location == *location) {
            let again = candidate.short_connections.saturating_sub(1);
            let pause = RECONNECT_PAUSE.saturating_mul(1 << again.min(10));
            let pause = pause.min(LONGEST_PAUSE);
            candidate.short_connections = candidate.short_connections.saturating_add(1);
            candidate.has_disconnected = true;
            let soon = candidate.last_asked.map_or(now, |asked| asked + pause);
            candidate.ask_by(soon.max(now));
        }
        self.update_due();
    }

    /// Checks all peers at once, because this host's network has changed.
    pub(super) fn ask_again(&mut self, now: Instant, table: &mut LaneTable) {
        let candidates = self
            .all
            .iter_mut()
            .flat_map(|static_peer| &mut static_peer.candidates);
        for candidate in candidates {
            candidate.failures = 0;
            candidate.ask_by(now);
        }
        self.ask_those_due(now, table);
    }

    /// Time of the next call of [`handle_timeout`](Self::handle_timeout).
    pub(super) fn due(&self) -> Option<Instant> {
        self.due
    }

    pub(super) fn handle_timeout(&mut self, now: Instant, table: &mut LaneTable) {
        if self.due.is_none_or(|due| due > now) {
            return;
        }
        for static_peer in &mut self.all {
            for index in 0..static_peer.candidates.len() {
                let Some(candidate) = static_peer.candidates.get(index) else {
                    break;
                };
                if let State::Asked { attempt, until } = candidate.state
                    && until <= now
                {
                    table.drop_attempt(candidate.location.clone(), attempt);
                    static_peer.failed(
                        now,
                        index,
                        TransportError::new(TransportErrorKind::TimedOut, ""),
                    );
                }
            }
        }
        self.ask_those_due(now, table);
    }

    /// Handles the conclusion of a check.
    pub(super) fn concluded(
        &mut self,
        now: Instant,
        (peer, attempt): (u64, AttemptId),
        conclusion: Conclusion,
        table: &mut LaneTable,
    ) {
        let Some(static_peer) = self
            .all
            .iter_mut()
            .find(|static_peer| static_peer.id == peer)
        else {
            return;
        };
        let is_asked = |candidate: &PeerLocation| matches!(candidate.state, State::Asked { attempt: asked, .. } if asked == attempt);
        let Some(index) = static_peer.candidates.iter().position(is_asked) else {
            return;
        };
        match conclusion {
            Conclusion::NotSent(error) | Conclusion::Unconfirmed(error) => {
                static_peer.failed(now, index, error);
            }
            // Any answer shows that the peer is reachable.
            _ => static_peer.answered(now, index),
        }
        self.ask_those_due(now, table);
    }

    pub(super) fn states(&self, now: Instant) -> Vec<PeerState> {
        self.all
            .iter()
            .map(|static_peer| static_peer.state(now))
            .collect()
    }

    fn ask_those_due(&mut self, now: Instant, table: &mut LaneTable) {
        for static_peer in &mut self.all {
            static_peer.ask_those_due(now, table);
        }
        self.update_due();
    }

    fn update_due(&mut self) {
        self.due = self.all.iter().filter_map(StaticPeer::due).min();
    }
}

impl StaticPeer {
    fn new(id: u64, peer: Peer) -> Self {
        Self {
            id,
            peer,
            candidates: Vec::new(),
            answers: None,
        }
    }

    /// Sorts the locations by the order of transports, which may have changed.
    fn order(&mut self, now: Instant, table: &mut LaneTable) {
        let mut before = std::mem::take(&mut self.candidates);
        let order = table.config.order.iter();
        let listed = order.flat_map(|kind| {
            let all = self.peer.locations.iter();
            // Legacy peers accept only letters.
            all.filter(move |location| {
                location.kind() == *kind && location.signature() == Signature::Frames
            })
        });
        for location in listed {
            let known = before
                .iter()
                .position(|candidate| candidate.location == *location);
            self.candidates.push(match known {
                Some(index) => before.swap_remove(index),
                None => PeerLocation::new(now, location.clone()),
            });
        }
        for gone in before {
            self.answers.take_if(|at| *at == gone.location);
            gone.give_up(table);
        }
    }

    /// Whether this location is checked: all are until one answers.
    fn is_of_use(&self, candidate: &PeerLocation) -> bool {
        self.answers
            .as_ref()
            .is_none_or(|at| *at == candidate.location)
    }

    fn due(&self) -> Option<Instant> {
        let due = |candidate: &PeerLocation| match candidate.state {
            State::AskAt(at) => self.is_of_use(candidate).then_some(at),
            State::Asked { until, .. } => Some(until),
        };
        self.candidates.iter().filter_map(due).min()
    }

    fn ask_those_due(&mut self, now: Instant, table: &mut LaneTable) {
        let (id, name, answers) = (self.id, &self.peer.name, &self.answers);
        let of_use = |candidate: &&mut PeerLocation| {
            answers.as_ref().is_none_or(|at| *at == candidate.location)
        };
        for candidate in self.candidates.iter_mut().filter(of_use) {
            if matches!(candidate.state, State::AskAt(at) if at <= now) {
                candidate.ask(now, (id, name), table);
            }
        }
    }

    fn answered(&mut self, now: Instant, index: usize) {
        let Some(candidate) = self.candidates.get_mut(index) else {
            return;
        };
        if self.answers.is_none() {
            log_limit::info!(of: &*self.peer.name, peer = %self.peer.name, at = %candidate.location, "the static peer answers");
        }
        candidate.state = State::AskAt(now + KEEP);
        if !std::mem::replace(&mut candidate.has_disconnected, false) {
            candidate.short_connections = 0;
        }
        self.answers = Some(candidate.location.clone());
        for candidate in &mut self.candidates {
            candidate.failures = 0;
            candidate.error = None;
        }
    }

    fn failed(&mut self, now: Instant, index: usize, error: TransportError) {
        let Some(candidate) = self.candidates.get_mut(index) else {
            return;
        };
        let was_answering = self
            .answers
            .take_if(|at| *at == candidate.location)
            .is_some();
        if was_answering || candidate.failures == 0 && self.answers.is_none() {
            log_limit::info!(of: &*self.peer.name, peer = %self.peer.name, at = %candidate.location, %error, "the static peer does not answer");
        }
        let pause = FIRST_PAUSE.saturating_mul(1 << candidate.failures.min(10));
        candidate.state = State::AskAt(now + pause.min(LONGEST_PAUSE));
        candidate.failures = candidate.failures.saturating_add(1);
        if self.answers.is_none() {
            candidate.error = Some(error);
        }
        if was_answering {
            let others = self.candidates.iter_mut().enumerate();
            others
                .filter(|(other, _)| *other != index)
                .for_each(|(_, candidate)| candidate.ask_by(now));
        }
    }

    fn state(&self, now: Instant) -> PeerState {
        let failed =
            |candidate: &PeerLocation| Some((candidate.location.clone(), candidate.error.clone()?));
        let awaited = |candidate: &PeerLocation| matches!(candidate.state, State::Asked { .. });
        let due = self.due().filter(|_| !self.candidates.iter().any(awaited));
        PeerState {
            peer: self.peer.clone(),
            answers: self.answers.clone(),
            failures: self.candidates.iter().filter_map(failed).collect(),
            rounds: self
                .candidates
                .iter()
                .map(|candidate| candidate.failures)
                .min()
                .unwrap_or(0),
            asked_again_in: due.map(|due| due.saturating_duration_since(now)),
        }
    }
}

impl PeerLocation {
    fn new(now: Instant, location: Location) -> Self {
        Self {
            location,
            state: State::AskAt(now),
            failures: 0,
            error: None,
            last_asked: None,
            short_connections: 0,
            has_disconnected: false,
        }
    }

    /// Schedules a check for this time at the latest, unless an answer is awaited.
    fn ask_by(&mut self, time: Instant) {
        if let State::AskAt(at) = &mut self.state {
            *at = time.min(*at);
        }
    }

    fn ask(&mut self, now: Instant, (peer, name): (u64, &Arc<str>), table: &mut LaneTable) {
        let no_stream = Stream::between(Incarnation::UNKNOWN, Incarnation::UNKNOWN);
        let parcel = note_parcel(no_stream, Arc::clone(name), 0, Body::Credit);
        let attempt = table.next_attempt();
        let purpose = Purpose::PeerCheck { peer };
        table.dispatch(attempt, purpose, self.location.clone(), parcel);
        self.last_asked = Some(now);
        self.state = State::Asked {
            attempt,
            // Opening a connection may take longer than an answer on an open one.
            until: now + table.config.attempt_timeout * 3,
        };
    }

    fn give_up(self, table: &mut LaneTable) {
        if let State::Asked { attempt, .. } = self.state {
            table.drop_attempt(self.location.clone(), attempt);
        }
    }
}
