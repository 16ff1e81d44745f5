//! Static peers: message transport services that the configuration names, and that this one keeps
//! in touch with before any letter needs it.
//!
//! Being in touch means that a parcel without consequences (a credit that nobody waits for) was
//! answered a moment ago. Asking opens the connection, keeps it from being closed as idle, and
//! notices when it is worth nothing any more; who is at its other end is told by the transport.

use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_transport::{
    AttemptId, Body, Conclusion, Incarnation, Location, Signature, Stream, WayError, WayFault,
};

use super::desk::{Desk, Purpose, note_parcel};

/// A message transport service that the configuration names.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Peer {
    /// What it is called here.
    pub name: Arc<str>,
    /// Where it may be found. Who is there is not known before it was asked.
    pub locations: Vec<Location>,
}

/// How it stands with a static peer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PeerState {
    /// The peer.
    pub peer: Peer,
    /// Where it answered last, if it still does.
    pub answers: Option<Location>,
    /// Why it did not answer, for each location since it last did.
    pub failures: Vec<(Location, WayError)>,
    /// How often in a row it could not be found at any of its locations.
    pub rounds: u32,
    /// How long until it is asked again; none while an answer is awaited.
    pub asked_again_in: Option<Duration>,
}

/// How often a peer that answers is asked.
const KEEP: Duration = Duration::from_secs(5);
/// Pauses after nobody was found at any of its locations.
const FIRST_PAUSE: Duration = Duration::from_millis(100);
const LONGEST_PAUSE: Duration = Duration::from_secs(5);
/// Pause before asking again when a connection with it has ended.
const PARTED_PAUSE: Duration = Duration::from_millis(200);

/// The static peers of a service.
#[derive(Debug, Default)]
pub(super) struct Peers {
    all: Vec<Watched>,
    next: u64,
    /// The earliest of their times.
    due: Option<Instant>,
}

#[derive(Debug)]
struct Watched {
    id: u64,
    peer: Peer,
    /// Its locations in the order of the configuration's transports.
    ways: Vec<Location>,
    /// Which of them is asked next, or was asked.
    current: usize,
    state: State,
    answers: bool,
    failures: Vec<(Location, WayError)>,
    rounds: u32,
    last_asked: Option<Instant>,
}

#[derive(Debug, Clone, Copy)]
enum State {
    AskAt(Instant),
    Asked { attempt: AttemptId, until: Instant },
}

impl State {
    fn due(self) -> Instant {
        match self {
            Self::AskAt(at) => at,
            Self::Asked { until, .. } => until,
        }
    }
}

impl Peers {
    /// Keeps in touch with these from now on. Those that were there before stay as they are.
    pub(super) fn set(&mut self, now: Instant, peers: Vec<Peer>, desk: &mut Desk) {
        let mut before = std::mem::take(&mut self.all);
        for peer in peers {
            let same = before.iter().position(|watched| watched.peer == peer);
            let mut watched = match same {
                Some(index) => before.swap_remove(index),
                None => {
                    self.next += 1;
                    Watched::new(self.next, peer, now)
                }
            };
            watched.order(desk);
            self.all.push(watched);
        }
        for gone in before {
            gone.give_up(desk);
        }
        self.ask_who_is_due(now, desk);
    }

    /// The order of transports has changed.
    pub(super) fn reorder(&mut self, now: Instant, desk: &mut Desk) {
        for watched in &mut self.all {
            watched.order(desk);
        }
        self.ask_who_is_due(now, desk);
    }

    /// A connection that had been opened for this location has ended.
    pub(super) fn parted(&mut self, now: Instant, location: &Location) {
        for watched in &mut self.all {
            if let State::AskAt(at) = watched.state
                && watched.ways.get(watched.current) == Some(location)
            {
                let soon = watched.last_asked.map_or(now, |asked| asked + PARTED_PAUSE);
                watched.state = State::AskAt(at.min(soon.max(now)));
            }
        }
        self.look_ahead();
    }

    /// The network of this host has changed: peers that did not answer are asked at once.
    pub(super) fn ask_again(&mut self, now: Instant, desk: &mut Desk) {
        for watched in &mut self.all {
            watched.rounds = 0;
            if let State::AskAt(at) = watched.state {
                watched.state = State::AskAt(at.min(now));
            }
        }
        self.ask_who_is_due(now, desk);
    }

    /// When [`handle_timeout`](Self::handle_timeout) wants to be called.
    pub(super) fn due(&self) -> Option<Instant> {
        self.due
    }

    pub(super) fn handle_timeout(&mut self, now: Instant, desk: &mut Desk) {
        if self.due.is_none_or(|due| due > now) {
            return;
        }
        for watched in &mut self.all {
            if let State::Asked { attempt, until } = watched.state
                && until <= now
            {
                if let Some(way) = watched.ways.get(watched.current) {
                    desk.drop_attempt(way.kind(), attempt);
                }
                watched.failed(now, WayError::new(WayFault::TimedOut, ""));
            }
        }
        self.ask_who_is_due(now, desk);
    }

    /// What became of asking one of them.
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
        if !matches!(watched.state, State::Asked { attempt: asked, .. } if asked == attempt) {
            return;
        }
        match conclusion {
            Conclusion::NotSent(error) | Conclusion::Unconfirmed(error) => {
                watched.failed(now, error);
            }
            // Whatever it said: it is there.
            _ => watched.answered(now),
        }
        self.ask_who_is_due(now, desk);
    }

    pub(super) fn states(&self, now: Instant) -> Vec<PeerState> {
        self.all.iter().map(|watched| watched.tell(now)).collect()
    }

    fn ask_who_is_due(&mut self, now: Instant, desk: &mut Desk) {
        for watched in &mut self.all {
            watched.ask_if_due(now, desk);
        }
        self.look_ahead();
    }

    fn look_ahead(&mut self) {
        let with_ways = self.all.iter().filter(|watched| !watched.ways.is_empty());
        self.due = with_ways.map(|watched| watched.state.due()).min();
    }
}

impl Watched {
    fn new(id: u64, peer: Peer, now: Instant) -> Self {
        Self {
            id,
            peer,
            ways: Vec::new(),
            current: 0,
            state: State::AskAt(now),
            answers: false,
            failures: Vec::new(),
            rounds: 0,
            last_asked: None,
        }
    }

    /// The order of transports may have changed.
    fn order(&mut self, desk: &Desk) {
        let asked = self.ways.get(self.current).cloned();
        let of = |kind| {
            let all = self.peer.locations.iter();
            // Old peers understand nothing that is not a letter.
            all.filter(move |location| {
                location.kind() == kind && location.signature() == Signature::Frames
            })
        };
        let order = desk.config.order.iter();
        self.ways = order.flat_map(|kind| of(*kind)).cloned().collect();
        let still = self.ways.iter().position(|way| Some(way) == asked.as_ref());
        self.current = still.unwrap_or(0);
    }

    fn give_up(self, desk: &mut Desk) {
        if let (State::Asked { attempt, .. }, Some(way)) = (self.state, self.ways.get(self.current))
        {
            desk.drop_attempt(way.kind(), attempt);
        }
    }

    fn ask_if_due(&mut self, now: Instant, desk: &mut Desk) {
        let (State::AskAt(at), Some(way)) = (self.state, self.ways.get(self.current)) else {
            return;
        };
        if at > now {
            return;
        }
        let nobodys = Stream {
            sender: Incarnation::UNKNOWN,
            receiver: Incarnation::UNKNOWN,
        };
        let parcel = note_parcel(nobodys, Arc::clone(&self.peer.name), 0, Body::Credit);
        let attempt = desk.next_attempt();
        let purpose = Purpose::Touch { peer: self.id };
        desk.dispatch(attempt, purpose, way.clone(), parcel);
        self.last_asked = Some(now);
        self.state = State::Asked {
            attempt,
            // Opening a connection may take longer than an answer on one that is there.
            until: now + desk.config.attempt_timeout * 3,
        };
    }

    fn answered(&mut self, now: Instant) {
        if !self.answers {
            tracing::info!(peer = %self.peer.name, way = ?self.ways.get(self.current), "in touch");
        }
        self.answers = true;
        self.failures.clear();
        self.rounds = 0;
        self.state = State::AskAt(now + KEEP);
    }

    fn failed(&mut self, now: Instant, error: WayError) {
        if let Some(way) = self.ways.get(self.current) {
            if self.answers || self.rounds == 0 {
                tracing::info!(peer = %self.peer.name, %way, %error, "not in touch");
            }
            self.failures.retain(|(other, _)| other != way);
            self.failures.push((way.clone(), error));
        }
        self.answers = false;
        self.current += 1;
        let mut pause = Duration::ZERO;
        if self.current >= self.ways.len() {
            self.current = 0;
            pause = FIRST_PAUSE.saturating_mul(1 << self.rounds.min(10));
            self.rounds = self.rounds.saturating_add(1);
        }
        self.state = State::AskAt(now + pause.min(LONGEST_PAUSE));
    }

    fn tell(&self, now: Instant) -> PeerState {
        let answers = self.ways.get(self.current).filter(|_| self.answers);
        PeerState {
            peer: self.peer.clone(),
            answers: answers.cloned(),
            failures: self.failures.clone(),
            rounds: self.rounds,
            asked_again_in: match self.state {
                State::AskAt(at) => Some(at.saturating_duration_since(now)),
                State::Asked { .. } => None,
            },
        }
    }
}
