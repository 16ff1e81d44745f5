//! State that all lanes share: pending actions, attempts in progress and the health of routes.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_acl::{Letter, Time};
use fipa_sds::{Entry, Source, View};
use fipa_transport::{
    Answer, Attempt, AttemptId, Body, FailureReason, Incarnation, Kind, LegacySource, Location,
    Outcome, Parcel, Principal, Report, Signature, Stream, Ticket, TransportError,
    TransportErrorKind,
};
use smallvec::SmallVec;

use super::departed::Departed;
use super::lane::{Delivery, LaneId};
use super::notes::{Note, Notes};
use super::routes::Tallies;
use super::{CoreConfig, News, Notice, SendId};
use crate::Map;
use crate::failure::Failed;

/// An action that the runtime performs for the delivery core.
#[derive(Debug)]
pub enum Action {
    /// Pass this parcel to the transport of the location's kind. An immediate refusal by the
    /// transport is reported like any other conclusion.
    Dispatch {
        /// Identifies the attempt in its conclusion.
        attempt: AttemptId,
        /// The receiver's location.
        location: Location,
        /// The parcel.
        parcel: Parcel,
    },
    /// Make the transport [abandon](fipa_transport::Transport::abandon) this attempt. Its end is
    /// reported at once with [`Core::handle_conclusion`](super::Core::handle_conclusion).
    Abandon {
        /// The attempt.
        attempt: AttemptId,
        /// The location to which it was dispatched.
        location: Location,
        /// The error of the conclusion.
        error: TransportError,
    },
    /// Pass the transport the answer to an arrival that was deferred.
    Answer {
        /// The transport.
        kind: Kind,
        /// The arrival.
        ticket: Ticket,
        /// The answer.
        answer: Answer,
    },
    /// One receiver's outcome of a letter sent here.
    Outcome {
        /// The submission.
        send: SendId,
        /// The receiver.
        receiver: Arc<str>,
        /// The outcome.
        outcome: Outcome,
    },
    /// An agent of another host that is not in the directory has sent a letter. Letters to it can
    /// be sent to this location, from which its letter came or which a legacy peer states as its
    /// own. The letter waits for the [refresh](Self::Refresh) that follows: the contacts are published to the
    /// processes of this host before it.
    Heard {
        /// Its name in the letter.
        name: String,
        /// Its incarnation; unknown for an agent of a legacy peer.
        agent: Incarnation,
        /// Location of its message transport service.
        location: Location,
        /// The host name in the address that it states, which was replaced by the address of its connection.
        host: Option<String>,
    },
    /// An agent of another host that is in the directory as a contact has sent another letter.
    HeardAgain {
        /// Its name.
        name: Arc<str>,
    },
    /// An agent of a legacy peer has taken a letter.
    Taken {
        /// Its name.
        name: Arc<str>,
        /// The location that took the letter.
        location: Location,
    },
    /// An attempt at this location, of a known incarnation, failed: the service may have ended
    /// without a goodbye. Reported by gateways only.
    Doubtful {
        /// The location.
        location: Location,
        /// Kind of the failure.
        fault: TransportErrorKind,
    },
    /// Refresh the directory, without the core locked, and report the end with
    /// [`Core::handle_refreshed`](super::Core::handle_refreshed) and this number.
    Refresh {
        /// Later refreshes have greater numbers.
        number: u64,
    },
    /// The number of outcomes of a letter for which [`Core::send`](super::Core::send) has returned
    /// none.
    Resolved {
        /// The submission.
        send: SendId,
        /// Number of outcomes, of which some may have been reported already.
        outcomes: usize,
    },
    /// A letter was added to this agent's queue.
    Deliverable {
        /// The agent.
        agent: Incarnation,
    },
    /// Notify the watcher before performing later actions; only while the core is watched.
    Notice(Box<Notice>),
}

/// Origin of a delivery, which determines the receiver of its outcome.
#[derive(Debug)]
pub(crate) enum Origin {
    /// An agent of this process, which gets an outcome.
    Local { send: SendId },
    /// Other message transport services, which get a late answer or a report.
    Forwarded { upstreams: SmallVec<[Upstream; 1]> },
    /// The source at a legacy peer, which gets this in a failure message, if anything.
    LegacyPeer {
        from: LegacySource,
        failed: Option<Arc<Failed>>,
    },
    /// A failure message; its outcome is not reported.
    FailureMessage,
}

/// A service that handed over a copy of a letter.
#[derive(Debug)]
pub(crate) struct Upstream {
    /// Location for reports to it.
    pub(crate) back: Location,
    /// Whether it is on another host.
    pub(crate) remote: bool,
    /// The attempt number of its latest hand-over of the letter, which a report names.
    pub(crate) transfer: u64,
    /// Its arrival that has no answer yet.
    pub(crate) unanswered: Option<(Kind, Ticket)>,
}

/// The way in which a letter leaves a lane.
#[derive(Debug)]
pub(crate) enum Settlement {
    /// It has an outcome.
    Outcome(Outcome),
    /// A custodian returns it, because its predecessor did not arrive, or the custodian ends.
    Returned { uncertain: bool },
    /// A custodian returns it, because the receiver's registration has left this host.
    Moved,
}

/// Receiver of a failure message.
#[derive(Debug, Clone)]
pub(crate) enum FailureTarget {
    /// This agent of this process.
    Ours(Incarnation),
    /// An agent of another service, which sent a letter with these parts.
    Remote(Arc<Failed>),
    /// The source of a legacy peer's letter.
    LegacyPeer {
        from: LegacySource,
        failed: Arc<Failed>,
    },
}

/// A failed delivery that a failure message reports.
#[derive(Debug)]
pub(crate) struct Undelivered {
    pub(crate) sender: FailureTarget,
    pub(crate) receiver: Arc<str>,
    pub(crate) letter: Letter,
    pub(crate) reason: FailureReason,
    pub(crate) detail: String,
}

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
pub(crate) struct AttemptTable {
    pub(crate) config: CoreConfig,
    pub(crate) view: Arc<dyn View>,
    pub(crate) actions: VecDeque<Action>,
    pub(crate) attempts: Map<AttemptId, Purpose>,
    pub(crate) undelivered: VecDeque<Undelivered>,
    pub(super) notes: Notes,
    pub(crate) departed: Departed,
    /// The latest locations that their services have left for others.
    left: VecDeque<Location>,
    /// Services whose certificate is no longer trusted.
    pub(crate) withdrawn: Map<Incarnation, Principal>,
    /// Total bytes of the letters in all lanes.
    pub(crate) held: usize,
    /// At a gateway, the bytes of them for each receiver.
    held_for: Map<Arc<str>, usize>,
    pub(super) tallies: Tallies,
    /// Whether a watcher is notified of events.
    pub(crate) watched: bool,
    health: Map<Location, Health>,
    /// Smoothed time in which each service acknowledges reports.
    round_trips: Map<Incarnation, Duration>,
    next_attempt: u64,
    /// Lanes that wait for a refresh of the directory, with its number.
    refreshing: VecDeque<(u64, LaneId)>,
    /// Number of refreshes that were requested.
    refreshes: u64,
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
const MAX_LEFT: usize = 64;
/// Maximum number of failed routes that are remembered.
const MAX_HEALTH: usize = 4096;

/// Whether letters may be sent to a location. A service of this project is not reached in the dialect
/// of legacy peers, whose letters have no number: it could not recognize one that is repeated.
pub(super) fn leads_to_letters(location: &Location) -> bool {
    location.signature() == Signature::Frames || !location.incarnation().is_known()
}

impl AttemptTable {
    pub(crate) fn new(config: CoreConfig, view: Arc<dyn View>) -> Self {
        Self {
            config,
            view,
            actions: VecDeque::new(),
            attempts: Map::default(),
            undelivered: VecDeque::new(),
            notes: Notes::default(),
            departed: Departed::default(),
            left: VecDeque::new(),
            withdrawn: Map::default(),
            held: 0,
            held_for: Map::default(),
            tallies: Tallies::default(),
            watched: false,
            health: Map::default(),
            round_trips: Map::default(),
            next_attempt: 1,
            refreshing: VecDeque::new(),
            refreshes: 0,
        }
    }

    /// Records a location that its service has left for another one.
    pub(super) fn service_left(&mut self, location: &Location) {
        self.left.retain(|other| other != location);
        if self.left.len() >= MAX_LEFT {
            self.left.pop_front();
        }
        self.left.push_back(location.clone());
    }

    /// Whether the service at this location has recently left it for another one.
    pub(crate) fn has_left(&self, location: &Location) -> bool {
        self.left.contains(location)
    }

    /// The reason for which a letter to an agent fails that the directory does not list. For a [lost
    /// agent](fipa_sds::Directory::lost_agents), the attempt names the location of its gateway.
    pub(super) fn absence(&self, name: &str) -> (FailureReason, Option<Attempt>) {
        let Some(lost) = self.view.lost(name) else {
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
        if lost.source == Source::Contact {
            let time = Time::from_system_time(lost.registered).ok();
            let time = time.and_then(Time::to_rfc3339).unwrap_or_default();
            let why = format!(
                "the gateway forgot this agent at {time}, because it knows as many of that host as it can; it can be \
                 answered after it sends another letter"
            );
            return (FailureReason::NoSuchAgent, attempt(why));
        }
        let why = format!(
            "the connection with the gateway {} ended without a farewell, and has not been restored since",
            lost.mts.shown()
        );
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

    /// Counts the bytes of a letter that came into a lane.
    pub(crate) fn hold(&mut self, receiver: &Arc<str>, len: usize) {
        self.held += len;
        if self.config.forwards {
            *self.held_for.entry(Arc::clone(receiver)).or_default() += len;
        }
    }

    /// Counts the bytes of a letter that left its lane.
    pub(crate) fn release(&mut self, receiver: &Arc<str>, len: usize) {
        self.held -= len;
        if let Some(held) = self.held_for.get_mut(receiver) {
            *held -= len;
            if *held == 0 {
                self.held_for.remove(receiver);
            }
        }
    }

    /// Whether a gateway has room for a letter of this many bytes for this receiver. One letter of
    /// any size is always accepted.
    ///
    /// A receiver that takes its letters slowly, or a peer that keeps letters in custody, does not
    /// use up the room of others: the letters for one receiver have at most half as many bytes as
    /// remain free. One letter for each receiver is accepted while there is room at all.
    pub(crate) fn has_room(&self, receiver: &str, len: usize) -> bool {
        let most = self.config.custody_bytes;
        let held = self.held.saturating_add(len);
        let own = self.held_for.get(receiver).copied().unwrap_or_default();
        let is_share = own == 0 || own.saturating_add(len) <= most.saturating_sub(held) / 2;
        self.held == 0 || (held <= most && is_share)
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
        (sequence, after, transfer): (u64, u64, u64),
        location: Location,
    ) {
        let parcel = Parcel {
            after,
            transfer,
            ..note_parcel(stream, receiver, sequence, Body::Predecessor)
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

    /// Reports the end of a letter to its sender, or to the services that handed it over.
    pub(crate) fn settle(
        &mut self,
        delivery: Box<Delivery>,
        stream: Stream,
        receiver: Arc<str>,
        settlement: Settlement,
    ) {
        let Delivery {
            origin,
            sequence,
            deadline,
            ..
        } = *delivery;
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
                let (brief, report) = answer_and_report(settlement);
                for upstream in upstreams {
                    let letter = (stream, sequence);
                    self.report_to(upstream, letter, &receiver, (&brief, &report), deadline);
                }
            }
            // Only custodians return letters; a failed failure message is not reported.
            (Origin::Local { .. } | Origin::LegacyPeer { .. } | Origin::FailureMessage, _) => {}
        }
    }

    fn report_to(
        &mut self,
        upstream: Upstream,
        (stream, sequence): (Stream, u64),
        receiver: &Arc<str>,
        (brief, report): (&Option<Answer>, &Report),
        deadline: Instant,
    ) {
        let Upstream {
            back,
            remote,
            transfer,
            unanswered,
        } = upstream;
        if let Some((kind, ticket)) = unanswered {
            let answer = match brief {
                // The transport within another host is of no interest there.
                Some(Answer::Delivered { .. }) if remote => Answer::Accepted,
                Some(brief) => brief.clone(),
                None => Answer::Custody,
            };
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
        self.note(Note::until(deadline, back, parcel));
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

    /// Returns the best location of this receiver that is not in `tried`: by the configured order,
    /// with recently failed ones last.
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

    /// Records the time in which a service acknowledged a report.
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

    pub(crate) fn route_worked(&mut self, location: &Location) {
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

    pub(crate) fn route_failed(
        &mut self,
        now: Instant,
        location: &Location,
        fault: TransportErrorKind,
    ) {
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

/// The registration that letters to this agent are for. A legacy peer's agent has no incarnation;
/// one that is derived from its name stands for all its registrations.
pub(crate) fn registration_of(entry: &Entry) -> Incarnation {
    if entry.incarnation.is_known() {
        entry.incarnation
    } else {
        registration_by_name(&entry.name)
    }
}

/// The 64-bit FNV-1a hash: equal in every process, so that reports match their letters.
fn registration_by_name(name: &str) -> Incarnation {
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

/// The answer to services that handed a letter over, if an answer can express the end, and the
/// report otherwise.
fn answer_and_report(settlement: Settlement) -> (Option<Answer>, Report) {
    match settlement {
        Settlement::Outcome(outcome) => {
            let brief = match &outcome {
                Outcome::Delivered { via, attempts } if attempts.is_empty() => {
                    Some(Answer::Delivered { via: *via })
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
