//! What all lanes share: the list of things to be done, the attempts under way and the health of
//! the ways.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_acl::Letter;
use fipa_sds::{Directory, Entry};
use fipa_transport::{
    Answer, AttemptId, Body, FailureReason, Incarnation, Kind, LegacySource, Location, Outcome,
    Parcel, Report, Stream, Ticket, WayError, WayFault,
};
use smallvec::SmallVec;

use super::departed::Departed;
use super::lane::{Delivery, LaneId};
use super::routes::Tallies;
use super::{CoreConfig, News, Notice, SendId};
use crate::Map;

/// Something the runtime has to do for the delivery core.
#[derive(Debug)]
pub enum Action {
    /// Give this parcel to the transport of the location's kind. When the transport refuses at
    /// once, the core is told as of any other conclusion.
    Dispatch {
        /// The number under which the conclusion is reported.
        attempt: AttemptId,
        /// Where to.
        location: Location,
        /// What.
        parcel: Parcel,
    },
    /// Have the transport [abandon](fipa_transport::Transport::abandon) this attempt. The core is
    /// told at once how it ended, by [`Core::handle_conclusion`](super::Core::handle_conclusion).
    Abandon {
        /// The transport.
        kind: Kind,
        /// The attempt.
        attempt: AttemptId,
        /// The error of the conclusion.
        error: WayError,
    },
    /// Give the transport the answer to an arrival that was put off.
    Answer {
        /// Which transport.
        kind: Kind,
        /// Which arrival.
        ticket: Ticket,
        /// The answer.
        answer: Answer,
    },
    /// One receiver's outcome of a letter sent here.
    Outcome {
        /// Which submission.
        send: SendId,
        /// The receiver.
        receiver: Arc<str>,
        /// What became of it.
        outcome: Outcome,
    },
    /// An agent of another host that the directory does not know has written; letters for it can
    /// be sent to where this one came from, or where it says that a legacy peer takes them. Comes before the letter is passed on.
    Heard {
        /// The name it writes under.
        name: String,
        /// This life of it; unknown for an agent of a legacy peer.
        agent: Incarnation,
        /// Where its message transport service can be reached.
        location: Location,
    },
    /// An attempt at this location, of a known incarnation, has failed: the service may be gone without
    /// having said so. Told by gateways only.
    Doubtful {
        /// The location.
        location: Location,
        /// Why the attempt failed.
        fault: WayFault,
    },
    /// Something was put into this agent's queue.
    Deliverable {
        /// The agent.
        agent: Incarnation,
    },
    /// Tell whoever watches, before anything else is done; only while the core is watched.
    Notice(Box<Notice>),
}

/// Where a delivery came from, and who is told its outcome.
#[derive(Debug)]
pub(crate) enum Origin {
    /// An agent of this process.
    Local { send: SendId },
    /// Other message transport services, which are told by a late answer or by a report.
    Forwarded { upstreams: SmallVec<[Upstream; 1]> },
    /// An old peer, which has sent it from this source, and is told by a failure message.
    OldPeer { from: LegacySource },
    /// Nobody is told: it is a failure message.
    Nobody,
}

/// A service that handed a copy of a letter over.
#[derive(Debug)]
pub(crate) struct Upstream {
    /// Where reports to it go.
    pub(crate) back: Location,
    /// Its latest hand-over of the letter, which a report names.
    pub(crate) transfer: u64,
    /// The arrival that still has no answer.
    pub(crate) unanswered: Option<(Kind, Ticket)>,
}

/// How a letter leaves a lane.
#[derive(Debug)]
pub(crate) enum Settlement {
    /// It has an outcome.
    Outcome(Outcome),
    /// A custodian hands it back, because its predecessor did not come.
    Returned { uncertain: bool },
    /// A custodian hands it back, because its receiver's registration has left this host.
    Moved,
}

/// Who is told of a failure by a message.
#[derive(Debug)]
pub(crate) enum Author {
    /// This agent of this process.
    Ours(Incarnation),
    /// An agent of another service. A legacy peer's letter came from this source.
    Remote { from: Option<LegacySource> },
}

/// A delivery that did not succeed, for the failure message.
#[derive(Debug)]
pub(crate) struct Undelivered {
    pub(crate) sender: Author,
    pub(crate) receiver: Arc<str>,
    pub(crate) letter: Letter,
    pub(crate) reason: FailureReason,
    pub(crate) detail: String,
}

/// What an attempt was for.
#[derive(Debug)]
pub(crate) enum Purpose {
    /// A letter of a lane.
    Letter { lane: LaneId, sequence: u64 },
    /// A report, a credit or a predecessor.
    Note(Box<Note>),
    /// Whether a static peer is there.
    Touch { peer: u64 },
}

/// A note about letters on its way: a report, a credit or a predecessor.
#[derive(Debug)]
pub(crate) struct Note {
    pub(crate) location: Location,
    pub(crate) parcel: Parcel,
    pub(crate) tries: u32,
    /// When it was sent last, if it is to be acknowledged.
    pub(crate) sent: Option<Instant>,
    /// Until when it is repeated without an acknowledgment.
    pub(crate) until: Option<Instant>,
}

impl Note {
    fn is_report(&self) -> bool {
        matches!(self.parcel.body, Body::Report(_))
    }

    /// The hand-over that the note is about: stream, sequence and transfer.
    fn transfer(&self) -> (Stream, u64, u64) {
        let Parcel {
            stream,
            sequence,
            transfer,
            ..
        } = self.parcel;
        (stream, sequence, transfer)
    }
}

/// What all lanes share.
pub(crate) struct Desk {
    pub(crate) config: CoreConfig,
    pub(crate) directory: Arc<dyn Directory>,
    pub(crate) actions: VecDeque<Action>,
    pub(crate) attempts: Map<AttemptId, Purpose>,
    pub(crate) undelivered: VecDeque<Undelivered>,
    /// Notes that have been sent and are repeated if they are not acknowledged.
    pub(crate) repeated: VecDeque<AttemptId>,
    pub(crate) departed: Departed,
    /// Bytes of all letters in lanes.
    pub(crate) held: usize,
    pub(super) tallies: Tallies,
    /// Whether anybody is told of what happens to letters.
    pub(crate) watched: bool,
    health: Map<Location, Health>,
    /// The time in which services acknowledge reports.
    round_trips: Map<Incarnation, Duration>,
    /// Hand-overs whose end was reported and neither acknowledged nor refused yet.
    open_reports: Map<(Stream, u64, u64), ()>,
    /// Lanes that found no room on the way to a location, in order.
    waiting_for_room: Map<Location, VecDeque<LaneId>>,
    next_attempt: u64,
}

#[derive(Debug)]
struct Health {
    failures: u32,
    retry_at: Instant,
}

/// Longest time a failed way is left alone.
const LONGEST_PENALTY: Duration = Duration::from_secs(5);
const FIRST_PENALTY: Duration = Duration::from_millis(100);
/// Ways that are remembered as failed, at most.
const MAX_HEALTH: usize = 4096;

impl Desk {
    pub(crate) fn new(config: CoreConfig, directory: Arc<dyn Directory>) -> Self {
        Self {
            config,
            directory,
            actions: VecDeque::new(),
            attempts: Map::default(),
            undelivered: VecDeque::new(),
            repeated: VecDeque::new(),
            departed: Departed::default(),
            held: 0,
            tallies: Tallies::default(),
            watched: false,
            health: Map::default(),
            round_trips: Map::default(),
            open_reports: Map::default(),
            waiting_for_room: Map::default(),
            next_attempt: 1,
        }
    }

    /// The number of the next attempt, which is also the number of its hand-over.
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

    /// Has the transport end an attempt, whose conclusion follows at once.
    pub(crate) fn abandon(&mut self, kind: Kind, attempt: AttemptId, error: WayError) {
        self.actions.push_back(Action::Abandon {
            kind,
            attempt,
            error,
        });
    }

    /// Has the transport end an attempt whose conclusion does not matter any more.
    pub(crate) fn drop_attempt(&mut self, kind: Kind, attempt: AttemptId) {
        if self.attempts.remove(&attempt).is_some() {
            let error = WayError::new(WayFault::TimedOut, "");
            self.abandon(kind, attempt, error);
        }
    }

    /// Sends a note. It is repeated when it says so, each time to another of the locations at which
    /// the service is reached at present.
    pub(crate) fn note(&mut self, mut note: Note) {
        if note.tries > 0 {
            note.location = self.present_location(&note);
        }
        if note.tries == 0 && note.is_report() {
            self.open_reports.insert(note.transfer(), ());
        }
        note.tries += 1;
        let (location, parcel) = (note.location.clone(), note.parcel.clone());
        let attempt = self.next_attempt();
        if note.until.is_some() {
            self.repeated.push_back(attempt);
        }
        self.dispatch(attempt, Purpose::Note(Box::new(note)), location, parcel);
    }

    /// Where the service that a note goes to is reached: it may have another address by now. The
    /// directory has the locations of the letters' sender, which is behind that service.
    fn present_location(&self, note: &Note) -> Location {
        let service = note.location.incarnation();
        let sender = self.directory.known_incarnation(note.parcel.stream.sender);
        let mut present: Vec<&Location> = Vec::new();
        if let Some(entry) = &sender {
            let locations = entry.locations.iter();
            present.extend(locations.filter(|it| it.incarnation() == service));
        }
        let next = (note.tries as usize).checked_rem(present.len());
        match next.and_then(|next| present.get(next)) {
            Some(location) if service.is_known() => (*location).clone(),
            _ => note.location.clone(),
        }
    }

    pub(crate) fn credit(&mut self, stream: Stream, receiver: Arc<str>, back: Location) {
        let parcel = note_parcel(stream, receiver, 0, Body::Credit);
        self.note(Note {
            location: back,
            parcel,
            tries: 0,
            sent: None,
            until: None,
        });
    }

    /// Tells a service the present predecessor of a letter that was handed to it in this transfer, and
    /// asks whether it has the letter. A lost note costs time only: the service hands the letter back
    /// when it waits too long, and is asked again.
    pub(crate) fn predecessor(
        &mut self,
        stream: Stream,
        receiver: Arc<str>,
        (sequence, after, transfer): (u64, u64, u64),
        location: Location,
    ) {
        let parcel = Parcel {
            after,
            transfer,
            ..note_parcel(stream, receiver, sequence, Body::Predecessor)
        };
        self.note(Note {
            location,
            parcel,
            tries: 0,
            sent: None,
            until: None,
        });
    }

    /// Tells whoever watches, if anybody does.
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

    /// Tells the letter's sender, or the services that handed it over, how it left its lane.
    pub(crate) fn settle(
        &mut self,
        delivery: Delivery,
        stream: Stream,
        receiver: Arc<str>,
        settlement: Settlement,
    ) {
        let Delivery {
            origin,
            sequence,
            deadline,
            ..
        } = delivery;
        if let Settlement::Outcome(outcome) = &settlement {
            self.notice(stream, sequence, &receiver, || News::Settled {
                outcome: outcome.clone(),
                sender: !matches!(origin, Origin::Forwarded { .. }),
            });
        }
        match (origin, settlement) {
            (Origin::Local { send }, Settlement::Outcome(outcome)) => {
                self.actions.push_back(Action::Outcome {
                    send,
                    receiver,
                    outcome,
                });
            }
            (Origin::Forwarded { upstreams }, settlement) => {
                let (brief, report) = tidings(settlement);
                for upstream in upstreams {
                    let letter = (stream, sequence);
                    self.tell(upstream, letter, &receiver, (&brief, &report), deadline);
                }
            }
            // Only custodians hand letters back; failure messages have no sender to be told.
            (Origin::Local { .. } | Origin::OldPeer { .. } | Origin::Nobody, _) => {}
        }
    }

    fn tell(
        &mut self,
        upstream: Upstream,
        (stream, sequence): (Stream, u64),
        receiver: &Arc<str>,
        (brief, report): (&Option<Answer>, &Report),
        deadline: Instant,
    ) {
        let Upstream {
            back,
            transfer,
            unanswered,
        } = upstream;
        if let Some((kind, ticket)) = unanswered {
            let answer = brief.clone().unwrap_or(Answer::Custody);
            self.actions.push_back(Action::Answer {
                kind,
                ticket,
                answer,
            });
            if brief.is_some() {
                return;
            }
        }
        let body = Body::Report(report.clone());
        let parcel = Parcel {
            transfer,
            ..note_parcel(stream, Arc::clone(receiver), sequence, body)
        };
        self.note(Note {
            location: back,
            parcel,
            tries: 0,
            sent: None,
            until: Some(deadline),
        });
    }

    /// Who is meant by this stream and this name, if the directory still has such an agent.
    pub(crate) fn receiver(&self, life: Incarnation, name: &str) -> Option<Arc<Entry>> {
        self.directory.by_incarnation(life).or_else(|| {
            let nameless = life == life_by_name(name);
            let entry = nameless.then(|| self.directory.lookup(name)).flatten();
            entry.filter(|entry| !entry.incarnation.is_known())
        })
    }

    /// The best way to this receiver that was not tried yet: the configured order, cut to what
    /// the receiver offers, ways that failed recently moved to the end.
    pub(crate) fn choose(
        &self,
        now: Instant,
        entry: &Entry,
        tried: &[Location],
    ) -> Option<Location> {
        let order = self.config.order_for(&entry.name);
        let ways = order.iter().flat_map(|kind| {
            entry
                .locations
                .iter()
                .filter(move |location| location.kind() == *kind)
        });
        let untried = ways.filter(|location| !tried.contains(location));
        // The first healthy one; among the others, the one that may be tried again soonest.
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

    pub(crate) fn wait_for_room(&mut self, location: &Location, lane: LaneId) {
        let waiting = self.waiting_for_room.entry(location.clone()).or_default();
        if !waiting.contains(&lane) {
            waiting.push_back(lane);
        }
    }

    /// The lane that may try this location now that something under way there has ended.
    pub(crate) fn room_for(&mut self, location: &Location) -> Option<LaneId> {
        if self.waiting_for_room.is_empty() {
            return None;
        }
        let waiting = self.waiting_for_room.get_mut(location)?;
        let lane = waiting.pop_front();
        if waiting.is_empty() {
            self.waiting_for_room.remove(location);
        }
        lane
    }

    /// How often in a row this way has failed and until when it is put back, if it is.
    pub(super) fn failing(&self, now: Instant, location: &Location) -> Option<(u32, Instant)> {
        let health = self.health.get(location)?;
        (health.retry_at > now).then_some((health.failures, health.retry_at))
    }

    /// A note was answered, or is not repeated any more. A report that was refused may not be believed
    /// when it is repeated.
    pub(crate) fn note_ended(&mut self, note: &Note) {
        if note.is_report() {
            self.open_reports.remove(&note.transfer());
        }
    }

    /// Whether the end of this hand-over of a letter is being reported and not acknowledged yet.
    pub(crate) fn is_reporting(&self, stream: Stream, sequence: u64, transfer: u64) -> bool {
        self.open_reports
            .contains_key(&(stream, sequence, transfer))
    }

    /// A service has acknowledged a report within this time.
    pub(crate) fn acknowledged(&mut self, service: Incarnation, took: Duration) {
        if let Some(known) = self.round_trips.get_mut(&service) {
            // Smoothed, as TCP does (RFC 6298 section 2).
            *known = (*known * 7 + took) / 8;
            return;
        }
        if self.round_trips.len() >= MAX_HEALTH {
            self.round_trips.clear();
        }
        self.round_trips.insert(service, took);
    }

    /// The time in which this service acknowledges reports, if it has.
    pub(crate) fn round_trip(&self, service: Incarnation) -> Option<Duration> {
        self.round_trips.get(&service).copied()
    }

    pub(crate) fn way_worked(&mut self, location: &Location) {
        if !self.health.is_empty() {
            self.health.remove(location);
        }
    }

    /// Forgets the failures of these ways.
    pub(super) fn forget_failures(&mut self, which: impl Fn(&Location) -> bool) {
        self.health.retain(|location, _| !which(location));
    }

    pub(crate) fn way_failed(&mut self, now: Instant, location: &Location, fault: WayFault) {
        if self.config.forwards && location.incarnation().is_known() {
            self.actions.push_back(Action::Doubtful {
                location: location.clone(),
                fault,
            });
        }
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

/// The life that letters to this agent are for. An old peer's agent has no incarnation; all of its
/// lives are one, which its name stands for.
pub(crate) fn life_of(entry: &Entry) -> Incarnation {
    if entry.incarnation.is_known() {
        entry.incarnation
    } else {
        life_by_name(&entry.name)
    }
}

/// The same in every process, so that reports find their letters: the 64-bit FNV-1a hash.
fn life_by_name(name: &str) -> Incarnation {
    let step = |hash: u64, byte: &u8| (hash ^ u64::from(*byte)).wrapping_mul(0x100_0000_01b3);
    let hash = name.as_bytes().iter().fold(0xcbf2_9ce4_8422_2325, step);
    Incarnation::from_u64(hash.max(1))
}

pub(super) fn note_parcel(stream: Stream, receiver: Arc<str>, sequence: u64, body: Body) -> Parcel {
    Parcel {
        receiver,
        stream,
        sequence,
        after: 0,
        transfer: 0,
        remaining: Duration::ZERO,
        body,
    }
}

/// How services that handed a letter over are told: by this answer when it says everything, else
/// by this report.
fn tidings(settlement: Settlement) -> (Option<Answer>, Report) {
    match settlement {
        Settlement::Outcome(outcome) => {
            let brief = match &outcome {
                Outcome::Delivered { attempts, .. } if attempts.is_empty() => {
                    Some(Answer::Accepted)
                }
                Outcome::Failed { reason, attempts } if attempts.is_empty() => {
                    Some(Answer::failed(*reason, ""))
                }
                _ => None,
            };
            (brief, Report::Settled(outcome))
        }
        Settlement::Returned { uncertain } => (
            Some(Answer::Returned { uncertain }),
            Report::Returned { uncertain },
        ),
        Settlement::Moved => (Some(Answer::Moved), Report::Moved),
    }
}
