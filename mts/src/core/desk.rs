//! What all lanes share: the list of things to be done, the attempts under way and the health of
//! the ways.

use std::collections::VecDeque;
use std::net::IpAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_acl::Letter;
use fipa_sds::{Directory, Entry};
use fipa_transport::{
    Answer, AttemptId, Body, FailureReason, Incarnation, Kind, Location, Outcome, Parcel, Report,
    Stream, Ticket,
};

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
    /// Tell the transport that nobody waits for this attempt any more.
    Abandon {
        /// Which transport.
        kind: Kind,
        /// Which attempt.
        attempt: AttemptId,
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
    /// be sent to where this one came from. Comes before the letter is passed on.
    Heard {
        /// The name it writes under.
        name: String,
        /// This life of it.
        agent: Incarnation,
        /// Where its message transport service can be reached.
        location: Location,
    },
    /// A way has failed that leads to this life of another service: it may be gone without having
    /// said so. Told by gateways only.
    Doubtful {
        /// The service.
        mts: Incarnation,
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
    /// Another message transport service, which is told by a late answer or by a report.
    Forwarded {
        back: Location,
        /// The stream it came with. It left with another one when its receiver had moved.
        stream: Stream,
        /// The arrival that still has no answer.
        unanswered: Option<(Kind, Ticket)>,
    },
    /// An old peer, which has sent it from this address, and is told by a failure message.
    OldPeer { from: IpAddr },
    /// Nobody is told: it is a failure message.
    Nobody,
}

/// Who is told of a failure by a message.
#[derive(Debug)]
pub(crate) enum Author {
    /// This agent of this process.
    Ours(Incarnation),
    /// An old peer's agent, whose letter came from this address.
    OldPeer { from: IpAddr },
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
    Letter { stream: Stream, sequence: u64 },
    /// A report or a credit.
    Note(Box<Note>),
    /// Whether a static peer is there.
    Touch { peer: u64 },
}

/// A report or a credit on its way.
#[derive(Debug)]
pub(crate) struct Note {
    pub(crate) location: Location,
    pub(crate) parcel: Parcel,
    pub(crate) tries: u32,
}

/// How often a report is tried. Whoever waits for it has a deadline of its own.
pub(crate) const NOTE_TRIES: u32 = 5;

/// What all lanes share.
pub(crate) struct Desk {
    pub(crate) config: CoreConfig,
    pub(crate) directory: Arc<dyn Directory>,
    pub(crate) actions: VecDeque<Action>,
    pub(crate) attempts: Map<AttemptId, Purpose>,
    pub(crate) undelivered: VecDeque<Undelivered>,
    /// Bytes of all letters in lanes.
    pub(crate) held: usize,
    pub(super) tallies: Tallies,
    /// Whether anybody is told of what happens to letters.
    pub(crate) watched: bool,
    health: Map<Location, Health>,
    /// Lanes that found no room on the way to a location, in order.
    waiting_for_room: Map<Location, VecDeque<Stream>>,
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
            held: 0,
            tallies: Tallies::default(),
            watched: false,
            health: Map::default(),
            waiting_for_room: Map::default(),
            next_attempt: 1,
        }
    }

    pub(crate) fn dispatch(
        &mut self,
        purpose: Purpose,
        location: Location,
        parcel: Parcel,
    ) -> AttemptId {
        let attempt = AttemptId(self.next_attempt);
        self.next_attempt += 1;
        self.attempts.insert(attempt, purpose);
        self.actions.push_back(Action::Dispatch {
            attempt,
            location,
            parcel,
        });
        attempt
    }

    pub(crate) fn abandon(&mut self, kind: Kind, attempt: AttemptId) {
        if self.attempts.remove(&attempt).is_some() {
            self.actions.push_back(Action::Abandon { kind, attempt });
        }
    }

    /// Sends a report or a credit back to where parcels of a stream came from.
    pub(crate) fn note(&mut self, mut note: Note) {
        note.tries += 1;
        let (location, parcel) = (note.location.clone(), note.parcel.clone());
        self.dispatch(Purpose::Note(Box::new(note)), location, parcel);
    }

    pub(crate) fn credit(&mut self, stream: Stream, receiver: Arc<str>, back: Location) {
        let parcel = note_parcel(stream, receiver, 0, Body::Credit);
        self.note(Note {
            location: back,
            parcel,
            tries: 0,
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

    /// Tells whoever has to know what became of a delivery.
    pub(crate) fn settle(
        &mut self,
        origin: Origin,
        stream: Stream,
        sequence: u64,
        receiver: Arc<str>,
        outcome: Outcome,
    ) {
        self.notice(stream, sequence, &receiver, || News::Settled {
            outcome: outcome.clone(),
            sender: !matches!(origin, Origin::Forwarded { .. }),
        });
        match origin {
            Origin::Local { send } => {
                self.actions.push_back(Action::Outcome {
                    send,
                    receiver,
                    outcome,
                });
            }
            Origin::Forwarded {
                back,
                stream,
                unanswered,
            } => {
                let brief = match &outcome {
                    Outcome::Delivered { attempts, .. } if attempts.is_empty() => {
                        Some(Answer::Accepted)
                    }
                    Outcome::Failed { reason, attempts } if attempts.is_empty() => {
                        Some(Answer::failed(*reason, ""))
                    }
                    _ => None,
                };
                match (unanswered, brief) {
                    (Some((kind, ticket)), Some(answer)) => {
                        self.actions.push_back(Action::Answer {
                            kind,
                            ticket,
                            answer,
                        });
                    }
                    (unanswered, _) => {
                        if let Some((kind, ticket)) = unanswered {
                            let answer = Answer::Custody;
                            self.actions.push_back(Action::Answer {
                                kind,
                                ticket,
                                answer,
                            });
                        }
                        let body = Body::Report(Report { outcome });
                        let parcel = note_parcel(stream, receiver, sequence, body);
                        self.note(Note {
                            location: back,
                            parcel,
                            tries: 0,
                        });
                    }
                }
            }
            Origin::OldPeer { .. } | Origin::Nobody => {}
        }
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

    pub(crate) fn wait_for_room(&mut self, location: &Location, stream: Stream) {
        let waiting = self.waiting_for_room.entry(location.clone()).or_default();
        if !waiting.contains(&stream) {
            waiting.push_back(stream);
        }
    }

    /// The lane that may try this location now that something under way there has ended.
    pub(crate) fn room_for(&mut self, location: &Location) -> Option<Stream> {
        if self.waiting_for_room.is_empty() {
            return None;
        }
        let waiting = self.waiting_for_room.get_mut(location)?;
        let stream = waiting.pop_front();
        if waiting.is_empty() {
            self.waiting_for_room.remove(location);
        }
        stream
    }

    /// How often in a row this way has failed and until when it is put back, if it is.
    pub(super) fn failing(&self, now: Instant, location: &Location) -> Option<(u32, Instant)> {
        let health = self.health.get(location)?;
        (health.retry_at > now).then_some((health.failures, health.retry_at))
    }

    pub(crate) fn way_worked(&mut self, location: &Location) {
        if !self.health.is_empty() {
            self.health.remove(location);
        }
    }

    pub(crate) fn way_failed(&mut self, now: Instant, location: &Location) {
        let mts = location.incarnation();
        if self.config.forwards && mts.is_known() {
            self.actions.push_back(Action::Doubtful { mts });
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
        remaining: Duration::ZERO,
        hops: 0,
        body,
    }
}
