//! The state of one letter to one receiver.

use std::time::Instant;

use fipa_acl::Letter;
use fipa_transport::{
    Answer, Attempt, AttemptId, FailureReason, Hop, Incarnation, Location, TransportError,
    TransportErrorKind,
};
use smallvec::SmallVec;

use super::super::action::Action;
use super::super::lane_table::LaneTable;
use super::super::origin::{Origin, Upstream};
use super::super::rules::{self, AttemptEnd};
use super::turns::{HandOvers, Pace, Turn};

/// Maximum number of failed attempts in one letter's outcome.
const MAX_ATTEMPTS: usize = 16;
/// Maximum number of services that hand over copies of one letter and get its outcome.
const MAX_UPSTREAMS: usize = 4;
/// Maximum number of services that one letter was handed to, whose reports count.
const MAX_HANDED: usize = 16;

/// The delivery of one letter to one receiver.
#[derive(Debug)]
pub(crate) struct OpenLetter {
    pub(crate) origin: Origin,
    pub(crate) letter: Letter,
    pub(crate) sequence: u64,
    /// Position among the letters of the lane since it was empty, at the sender's process.
    pub(super) position: u64,
    /// The receiver's registration that the letter is for.
    pub(crate) registration: Incarnation,
    /// The predecessor: at a custodian as received with the letter, at the sender's process as in
    /// the latest copy.
    pub(crate) after: u64,
    pub(crate) deadline: Instant,
    /// Time of arrival in this lane.
    pub(crate) since: Instant,
    /// Time at which the service that handed the letter over is told that it is in custody, unless
    /// its outcome is known earlier.
    pub(crate) custody_due: Option<Instant>,
    pub(super) progress: Progress,
}

/// Progress of a delivery.
#[derive(Debug)]
pub(super) struct Progress {
    pub(super) state: State,
    pub(super) hand_overs: HandOvers,
    /// Failed attempts, for the outcome.
    pub(super) attempts: Vec<Attempt>,
    /// Locations tried in this round.
    pub(super) tried: SmallVec<[Location; 1]>,
    /// The services that the letter was handed to, and whether they are on this host.
    pub(super) handed: SmallVec<[(Incarnation, bool); 2]>,
    /// Whether an attempt may have delivered it. Never cleared.
    pub(super) uncertain: bool,
    /// Whether the receiver's queue was full.
    pub(super) busy: bool,
    /// Time since which it fits none of the receiver's kinds of transport.
    pub(super) unfit_since: Option<Instant>,
    /// Time since which its receiver's service does not know the receiver that the directory shows.
    pub(super) unknown_since: Option<Instant>,
    /// Set when the letter came back because its predecessor was not taken.
    pub(super) hold: Option<Holding>,
    /// Set while the letter waits for a refresh of the directory.
    pub(super) departure: Option<Box<Departure>>,
}

/// Another service's report on the registration of a letter's receiver.
#[derive(Debug)]
pub(super) enum Departure {
    /// It has left its host.
    Moved,
    /// It is not known there.
    Unknown {
        /// Location and detail of the refusal; `None` for a report.
        refused: Option<(Location, String)>,
    },
}

/// The event that a letter which came back as out of order waits for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Holding {
    /// The end of this attempt or custody of its predecessor, which is in this lane.
    ForPredecessor(AttemptId),
    /// The arrival of the predecessor, until this time; then the letter is returned.
    Until(Instant),
}

/// Position of a letter.
#[derive(Debug)]
pub(super) enum State {
    /// It is in this lane, and can be dispatched in its turn.
    Waiting(Turn),
    /// Its latest hand-over has ended, and nothing was decided about it yet.
    Ended,
    UnderWay {
        attempt: AttemptId,
        location: Location,
        since: Instant,
        times_out: Instant,
        /// Whether the transport was asked to end the attempt, whose conclusion follows at once.
        abandoned: bool,
    },
    Custody {
        /// The attempt that handed it over.
        attempt: AttemptId,
        location: Location,
        /// Time of the custodian's answer.
        since: Instant,
    },
}

impl State {
    /// The latest hand-over and its location, unless the letter is in this lane.
    pub(super) fn handed_over(&self) -> Option<(AttemptId, &Location)> {
        match self {
            Self::Waiting(_) | Self::Ended => None,
            Self::UnderWay {
                attempt, location, ..
            }
            | Self::Custody {
                attempt, location, ..
            } => Some((*attempt, location)),
        }
    }
}

impl OpenLetter {
    /// Creates a delivery for this registration of its receiver.
    pub(crate) fn new(
        now: Instant,
        origin: Origin,
        letter: Letter,
        (registration, sequence): (Incarnation, u64),
        deadline: Instant,
    ) -> Box<Self> {
        let (hand_overs, first) = HandOvers::new(now);
        let progress = Progress {
            state: State::Waiting(first),
            hand_overs,
            attempts: Vec::new(),
            tried: SmallVec::new(),
            handed: SmallVec::new(),
            uncertain: false,
            busy: false,
            unfit_since: None,
            unknown_since: None,
            hold: None,
            departure: None,
        };
        Box::new(Self {
            origin,
            letter,
            sequence,
            position: 0,
            registration,
            after: 0,
            deadline,
            since: now,
            custody_due: None,
            progress,
        })
    }

    pub(super) fn is_waiting(&self) -> bool {
        matches!(self.progress.state, State::Waiting(_))
    }

    /// The time at which a waiting letter may be dispatched, if it is still to come.
    pub(super) fn begins_after(&self, now: Instant) -> Option<Instant> {
        match &self.progress.state {
            State::Waiting(turn) => turn.begins_after(now),
            _ => None,
        }
    }

    /// Delays the dispatch of a waiting letter until then.
    pub(crate) fn delay_until(&mut self, until: Instant) {
        if let State::Waiting(turn) = &mut self.progress.state {
            turn.delay_until(until);
        }
    }

    /// Continues with the pace that the letter had when it was in this lane before.
    pub(super) fn came_before(&mut self, pace: Pace) {
        let hand_overs = &mut self.progress.hand_overs;
        if let State::Waiting(turn) = &mut self.progress.state
            && let Some(from) = hand_overs.resume(self.since, pace, self.letter.len())
        {
            turn.delay_until(from);
        }
    }

    /// Has the transport end the attempt under way, if there is one and it was not asked before. The conclusion
    /// follows at once.
    pub(super) fn abandon(
        &mut self,
        table: &mut LaneTable,
        error: impl FnOnce() -> TransportError,
    ) {
        if let State::UnderWay {
            attempt,
            location,
            abandoned,
            ..
        } = &mut self.progress.state
            && !std::mem::replace(abandoned, true)
        {
            table.abandon(location.clone(), *attempt, error());
        }
    }

    /// Records the end of an attempt or a custody.
    pub(super) fn ended(&mut self, end: AttemptEnd) {
        self.progress.uncertain = rules::stays_uncertain(self.progress.uncertain, end);
    }

    /// Records a failed attempt. Of many, the first ones and the last one at each location are
    /// kept.
    pub(super) fn failed_at(&mut self, location: &Location, error: TransportError) {
        let attempts = &mut self.progress.attempts;
        if attempts.len() >= MAX_ATTEMPTS {
            let mut known = attempts.iter().rev();
            let same = known.position(|attempt| attempt.location == *location);
            // Without one at this location, the newest is replaced.
            attempts.remove(attempts.len() - 1 - same.unwrap_or(0));
        }
        attempts.push(Attempt {
            via: location.kind(),
            location: location.clone(),
            error,
        });
    }

    /// Records that reports of the service at this location count. `local` is whether the receiver
    /// is on this host, and with it the service: it may also be reached over the network.
    pub(super) fn handed_to(&mut self, location: &Location, local: bool) {
        let service = location.incarnation();
        let handed = &mut self.progress.handed;
        let hand_over = (service, local || location.kind().is_host_local());
        if service.is_known() && !handed.contains(&hand_over) && handed.len() < MAX_HANDED {
            handed.push(hand_over);
        }
    }

    /// Whether the letter was ever handed to this service. A service of this host has no proof on
    /// the network, so a report from another host in its name does not count.
    pub(super) fn was_handed_to(&self, service: &Hop) -> bool {
        let mut handed = self.progress.handed.iter();
        handed.any(|hand_over| is_of(*hand_over, service))
    }

    /// The service at this location that the letter was handed to, and whether it is on this host.
    pub(super) fn handed_at(&self, location: &Location) -> Option<(Incarnation, bool)> {
        let mut handed = self.progress.handed.iter().copied();
        handed.find(|(incarnation, _)| *incarnation == location.incarnation())
    }

    /// The reason when the last attempt at every location failed for a cause that another attempt does not
    /// change: the letter is too large, the peer's dialect cannot express it, or the peer is not trusted.
    pub(super) fn unfit(&self) -> Option<FailureReason> {
        let mut reason = None;
        let attempts = &self.progress.attempts;
        for (index, attempt) in attempts.iter().enumerate() {
            let mut later = attempts.iter().skip(index + 1);
            if later.any(|later| later.location == attempt.location) {
                continue;
            }
            match attempt.error.fault {
                TransportErrorKind::Inexpressible => reason = Some(FailureReason::Inexpressible),
                TransportErrorKind::TooLarge => {
                    reason = reason.or(Some(FailureReason::TooLarge));
                }
                TransportErrorKind::Distrusted => {
                    reason = reason.or(Some(FailureReason::Refused));
                }
                _ => return None,
            }
        }
        reason
    }

    /// The reason when no route was open: each attempt failed for lack of memory, or there was no
    /// route.
    fn without_route(&self) -> FailureReason {
        let mut attempts = self.progress.attempts.iter();
        match attempts.all(|attempt| attempt.error.fault == TransportErrorKind::NoRoom) {
            true => FailureReason::NoRoom,
            false => FailureReason::Unreachable,
        }
    }

    /// The reason when its deadline has passed. `behind_full_queue` is whether an earlier letter
    /// met a full queue.
    pub(super) fn reason_at_deadline(&self, behind_full_queue: bool) -> FailureReason {
        let progress = &self.progress;
        if progress.uncertain || !self.is_waiting() {
            FailureReason::Unconfirmed
        } else if progress.busy || (behind_full_queue && progress.attempts.is_empty()) {
            FailureReason::QueueFull
        } else if progress.attempts.is_empty() {
            FailureReason::TimedOut
        } else {
            self.unfit().unwrap_or_else(|| self.without_route())
        }
    }

    /// Answers the services that wait for an answer that the letter is in custody.
    pub(super) fn custody_taken(&mut self, table: &mut LaneTable) {
        if let Origin::Forwarded { upstreams } = &mut self.origin {
            for upstream in upstreams {
                if let Some((kind, ticket)) = upstream.unanswered.take() {
                    table.actions.push_back(Action::Answer {
                        kind,
                        ticket,
                        answer: Answer::Custody,
                    });
                }
            }
        }
        self.custody_due = None;
    }

    /// Adds a service that handed over another copy, or updates the hand-over of a known one: it
    /// gets the outcome for its latest copy.
    pub(super) fn add_upstream(&mut self, upstream: Upstream) {
        let Origin::Forwarded { upstreams } = &mut self.origin else {
            return;
        };
        let service = (upstream.back.incarnation(), upstream.remote);
        let mut known = upstreams.iter_mut();
        if let Some(known) = known.find(|known| (known.back.incarnation(), known.remote) == service)
        {
            if upstream.transfer >= known.transfer {
                *known = upstream;
            }
        } else if upstreams.len() < MAX_UPSTREAMS {
            upstreams.push(upstream);
        }
    }

    /// Whether this service handed the letter over, in this hand-over or a later one. A link with
    /// another host does not prove to be a service of this one.
    pub(super) fn came_from(&self, service: &Hop, transfer: u64) -> bool {
        match &self.origin {
            Origin::Forwarded { upstreams } => upstreams.iter().any(|upstream| {
                is_of((upstream.back.incarnation(), !upstream.remote), service)
                    && upstream.transfer >= transfer
            }),
            _ => false,
        }
    }

    /// The services that handed the letter over.
    pub(super) fn upstreams(&self) -> impl Iterator<Item = Incarnation> {
        let upstreams = match &self.origin {
            Origin::Forwarded { upstreams } => upstreams.as_slice(),
            _ => &[],
        };
        upstreams.iter().map(|upstream| upstream.back.incarnation())
    }
}

/// Whether a link is one of this service, which is on this host if `local`: another host cannot
/// prove to be it.
pub(super) fn is_of((incarnation, local): (Incarnation, bool), link: &Hop) -> bool {
    incarnation == link.location.incarnation() && !(local && link.is_remote())
}
