//! One letter on its way to one receiver, and how far it has come.

use std::time::Instant;

use fipa_acl::Letter;
use fipa_transport::{
    Answer, Attempt, AttemptId, FailureReason, Hop, Incarnation, Location, WayError, WayFault,
};
use smallvec::SmallVec;

use super::super::desk::{Action, Desk, Origin, Upstream};
use super::super::rules::{self, End};

/// Failed attempts that are remembered for one letter's outcome.
const MAX_ATTEMPTS: usize = 16;
/// Services that hand over copies of one letter and are told its outcome.
const MAX_UPSTREAMS: usize = 4;
/// Services that one letter was handed to, whose reports are believed.
const MAX_HANDED: usize = 16;

/// One letter on its way to one receiver.
#[derive(Debug)]
pub(crate) struct Delivery {
    pub(crate) origin: Origin,
    pub(crate) letter: Letter,
    pub(crate) sequence: u64,
    /// The receiver's registration that the letter is for.
    pub(crate) registration: Incarnation,
    /// The predecessor. At a custodian as the letter's sender told it; at the sender's process as
    /// the latest copy says it.
    pub(crate) after: u64,
    pub(crate) deadline: Instant,
    /// When the letter came here.
    pub(crate) since: Instant,
    /// When the service that handed the letter over is told that it is in custody, unless its
    /// outcome is known before.
    pub(crate) custody_due: Option<Instant>,
    /// Not dispatched before this time.
    pub(crate) not_before: Option<Instant>,
    pub(super) progress: Progress,
}

/// How far a letter has come.
#[derive(Debug)]
pub(super) struct Progress {
    pub(super) state: State,
    /// Failed attempts, for the outcome.
    pub(super) attempts: Vec<Attempt>,
    /// The ways tried in this round.
    pub(super) tried: SmallVec<[Location; 1]>,
    /// The services that the letter was handed to, and whether over a route within the host.
    pub(super) handed: SmallVec<[(Incarnation, bool); 2]>,
    /// An attempt may have delivered it. Never cleared.
    pub(super) uncertain: bool,
    /// The receiver's queue was full.
    pub(super) busy: bool,
    /// Since when it fits none of the kinds that its receiver shows.
    pub(super) unfit_since: Option<Instant>,
    /// The letter came back because its predecessor was not taken.
    pub(super) hold: Option<Holding>,
}

/// What a letter that came back as out of order waits for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Holding {
    /// The end of this attempt or custody of its predecessor, which is in this lane.
    ForPredecessor(AttemptId),
    /// The arrival of the predecessor, until this time; then the letter is handed back.
    Until(Instant),
}

/// Where a letter is.
#[derive(Debug)]
pub(super) enum State {
    Waiting,
    UnderWay {
        attempt: AttemptId,
        location: Location,
        times_out: Instant,
        /// The transport has been asked to end the attempt, and concludes it at once.
        abandoned: bool,
    },
    Custody {
        /// The attempt that handed it over.
        attempt: AttemptId,
        location: Location,
        /// When the custodian said so.
        since: Instant,
    },
}

impl State {
    /// The latest hand-over, and where it went, unless the letter is here.
    pub(super) fn handed_over(&self) -> Option<(AttemptId, &Location)> {
        match self {
            Self::Waiting => None,
            Self::UnderWay {
                attempt, location, ..
            }
            | Self::Custody {
                attempt, location, ..
            } => Some((*attempt, location)),
        }
    }
}

impl Delivery {
    /// A letter for this registration of its receiver.
    pub(crate) fn new(
        now: Instant,
        origin: Origin,
        letter: Letter,
        (registration, sequence): (Incarnation, u64),
        deadline: Instant,
    ) -> Self {
        let progress = Progress {
            state: State::Waiting,
            attempts: Vec::new(),
            tried: SmallVec::new(),
            handed: SmallVec::new(),
            uncertain: false,
            busy: false,
            unfit_since: None,
            hold: None,
        };
        Self {
            origin,
            letter,
            sequence,
            registration,
            after: 0,
            deadline,
            since: now,
            custody_due: None,
            not_before: None,
            progress,
        }
    }

    pub(super) fn is_waiting(&self) -> bool {
        matches!(self.progress.state, State::Waiting)
    }

    /// An attempt, or a custody, has ended like this.
    pub(super) fn ended(&mut self, end: End) {
        self.progress.uncertain = rules::stays_uncertain(self.progress.uncertain, end);
    }

    /// Remembers a failed attempt. Of many, the first ones and the last one at each location stay.
    pub(super) fn failed_at(&mut self, location: &Location, error: WayError) {
        let attempts = &mut self.progress.attempts;
        if attempts.len() >= MAX_ATTEMPTS {
            let mut known = attempts.iter().rev();
            let same = known.position(|attempt| attempt.location == *location);
            // Without one at this location, the newest gives way.
            attempts.remove(attempts.len() - 1 - same.unwrap_or(0));
        }
        attempts.push(Attempt {
            via: location.kind(),
            location: location.clone(),
            error,
        });
    }

    /// Remembers that reports of the service at this location are believed.
    pub(super) fn handed_to(&mut self, location: &Location) {
        let service = location.incarnation();
        let handed = &mut self.progress.handed;
        let hand_over = (service, location.kind().is_host_local());
        if service.is_known() && !handed.contains(&hand_over) && handed.len() < MAX_HANDED {
            handed.push(hand_over);
        }
    }

    /// Whether the letter was ever handed to this service. One of this host, which proves nothing to
    /// others, is not believed to be on another.
    pub(super) fn was_handed_to(&self, service: &Hop) -> bool {
        let mut handed = self.progress.handed.iter();
        handed.any(|(incarnation, local)| {
            *incarnation == service.location.incarnation() && !(*local && service.is_remote())
        })
    }

    /// The reason when every attempt failed because of the letter itself: it is too large, or the
    /// peer's dialect cannot express it.
    pub(super) fn unfit(&self) -> Option<FailureReason> {
        let mut reason = None;
        for attempt in &self.progress.attempts {
            match attempt.error.fault {
                WayFault::Inexpressible => reason = Some(FailureReason::Inexpressible),
                WayFault::TooLarge => {
                    reason = reason.or(Some(FailureReason::TooLarge));
                }
                _ => return None,
            }
        }
        reason
    }

    /// The reason when its deadline has passed. `behind_full_queue` is whether a letter before it
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
            self.unfit().unwrap_or(FailureReason::Unreachable)
        }
    }

    /// Tells the services that wait for an answer that the letter is in custody.
    pub(super) fn custody_taken(&mut self, desk: &mut Desk) {
        if let Origin::Forwarded { upstreams } = &mut self.origin {
            for upstream in upstreams {
                if let Some((kind, ticket)) = upstream.unanswered.take() {
                    desk.actions.push_back(Action::Answer {
                        kind,
                        ticket,
                        answer: Answer::Custody,
                    });
                }
            }
        }
        self.custody_due = None;
    }

    /// Another copy has come: the service that handed it over is told the outcome of this letter,
    /// for the latest copy that it handed over.
    pub(super) fn add_upstream(&mut self, upstream: Upstream) {
        let Origin::Forwarded { upstreams } = &mut self.origin else {
            return;
        };
        let service = upstream.back.incarnation();
        let mut known = upstreams.iter_mut();
        if let Some(known) = known.find(|known| known.back.incarnation() == service) {
            if upstream.transfer >= known.transfer {
                *known = upstream;
            }
        } else if upstreams.len() < MAX_UPSTREAMS {
            upstreams.push(upstream);
        }
    }

    /// Whether this service has handed the letter over, this time at the latest.
    pub(super) fn came_from(&self, service: Incarnation, transfer: u64) -> bool {
        match &self.origin {
            Origin::Forwarded { upstreams } => upstreams.iter().any(|upstream| {
                upstream.back.incarnation() == service && upstream.transfer >= transfer
            }),
            _ => false,
        }
    }

    /// The services that have handed the letter over.
    pub(super) fn upstreams(&self) -> impl Iterator<Item = Incarnation> {
        let upstreams = match &self.origin {
            Origin::Forwarded { upstreams } => upstreams.as_slice(),
            _ => &[],
        };
        upstreams.iter().map(|upstream| upstream.back.incarnation())
    }
}
