//! The delivery core: what the promises of delivery hang on, without input and output.
//!
//! Everything that happens (a letter to be sent, a parcel that arrived, the end of an attempt, a
//! change of the directory, time that passed) goes in with `now`; what is to be done comes out as
//! [`Action`]s. The same core serves a robot process and, with leave to forward, the gateway; and
//! the same core runs in simulations on virtual time.
//!
//! * `lane`: letters of one stream on their way, in order, one way at a time.
//! * `inbox`: the receiving end, where letters are taken once and in order.
//! * `forward`: letters for somebody else.
//! * `departed`: agents of this host that have moved, which letters follow once.
//! * `peers`: services that the configuration names, and how it stands with them.
//! * `routes`: which way letters would go and what happened on each way, for people.
//! * `desk`: what lanes share: attempts, health of ways, things to be done.
//! * `notice`: what somebody who watches is told.
//!
//! A letter's order and identity are its *stream* (one life of the sender, one life of the
//! receiver) and its sequence. Every letter names the one that must be taken before it, so that
//! letters that failed leave no hole that would be waited for.

mod config;
mod departed;
mod desk;
mod forward;
mod inbox;
mod lane;
mod notice;
mod peers;
mod routes;

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_acl::Letter;
use fipa_sds::{Directory, Entry, Pattern, Resolution};
use fipa_transport::{
    Allowance, Answer, Arrival, AttemptId, Body, Conclusion, FailureReason, Incarnation, Kind,
    Location, Outcome, Parcel, Report, Stream, Verdict, WayFault,
};

pub use config::{CoreConfig, MAX_DEADLINE};
use departed::Departed;
pub use desk::Action;
use desk::{Author, Desk, NOTE_TRIES, Note, Origin, Purpose, Undelivered};
use inbox::Inbox;
pub use inbox::Received;
use lane::{Delivery, Lane, Moved};
pub use notice::{News, Notice};

use crate::{Gate, Map};
use peers::Peers;
pub use peers::{Peer, PeerState};
pub use routes::{Route, Standing, Way, WayState};

/// What time it is, by both clocks.
#[derive(Debug, Clone, Copy)]
pub struct Now {
    /// The clock that never goes back: deadlines and pauses.
    pub instant: Instant,
    /// The calendar: dates in envelopes, for people.
    pub utc: SystemTime,
}

impl Now {
    /// Both clocks of this machine.
    #[must_use]
    pub fn read() -> Self {
        Self {
            instant: Instant::now(),
            utc: SystemTime::now(),
        }
    }
}

/// One call of [`Core::send`]: outcomes name it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct SendId(pub u64);

/// A letter that an agent of this process sends.
#[derive(Debug, Clone)]
pub struct Submission {
    /// The sending agent's incarnation.
    pub sender: Incarnation,
    /// The letter, for all receivers.
    pub letter: Letter,
    /// Names of the receivers, of coalitions too, or patterns.
    pub receivers: Vec<Arc<str>>,
    /// How long delivery may take, at most [`MAX_DEADLINE`].
    pub deadline: Duration,
}

/// Lanes that are empty are forgotten when there are more than this many.
const IDLE_LANES: usize = 1024;
/// How long an empty lane is remembered after that.
const IDLE_TIME: Duration = Duration::from_secs(60);

/// The delivery core. See the module's documentation.
pub struct Core {
    desk: Desk,
    lanes: Map<Stream, Lane>,
    agents: Map<Incarnation, Inbox>,
    timers: BinaryHeap<Reverse<(Instant, Stream)>>,
    notes: BinaryHeap<Reverse<LateNote>>,
    peers: Peers,
    departed: Departed,
    gate: Option<Arc<dyn Gate>>,
    /// How many old peers' letters that were refused may still be told of.
    refusals: Option<Allowance>,
    /// No more letters of others are taken.
    ending: bool,
    next_send: u64,
    /// Sequence of the letters that this service sends in its own name, where it is no agent.
    next_sequence: u64,
    next_forget: Option<Instant>,
}

/// A report that is tried again later.
struct LateNote(Instant, Note);

impl Ord for LateNote {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.0.cmp(&other.0)
    }
}

impl PartialOrd for LateNote {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for LateNote {
    fn eq(&self, other: &Self) -> bool {
        self.0 == other.0
    }
}

impl Eq for LateNote {}

impl Core {
    /// A core that looks up receivers in this directory.
    #[must_use]
    pub fn new(config: CoreConfig, directory: Arc<dyn Directory>) -> Self {
        Self {
            desk: Desk::new(config, directory),
            lanes: Map::default(),
            agents: Map::default(),
            timers: BinaryHeap::new(),
            notes: BinaryHeap::new(),
            peers: Peers::default(),
            departed: Departed::default(),
            gate: None,
            refusals: None,
            ending: false,
            next_send: 1,
            next_sequence: 1,
            next_forget: None,
        }
    }

    /// The same core, that asks this gate which letters it takes.
    #[must_use]
    pub fn gated(self, gate: Arc<dyn Gate>) -> Self {
        Self {
            gate: Some(gate),
            ..self
        }
    }

    /// What the core was told at its start.
    #[must_use]
    pub fn config(&self) -> &CoreConfig {
        &self.desk.config
    }

    /// An agent of this process has been registered: letters for it are taken from now on.
    pub fn register(&mut self, name: Arc<str>, incarnation: Incarnation) {
        let bound = self.desk.config.queue;
        self.agents.insert(incarnation, Inbox::new(name, bound));
    }

    /// An agent of this process goes away: its unread letters are dropped, its letters under way
    /// end as failed or unconfirmed.
    pub fn deregister(&mut self, incarnation: Incarnation) {
        if let Some(mut inbox) = self.agents.remove(&incarnation) {
            let receiver = Arc::clone(&inbox.name);
            for (stream, back) in inbox.all_waiting() {
                self.desk.credit(stream, Arc::clone(&receiver), back);
            }
        }
        for lane in self.lanes.values_mut() {
            if lane.sender() == incarnation {
                lane.give_up(&mut self.desk);
            }
        }
        self.desk.undelivered.clear();
        self.lanes
            .retain(|_, lane| !lane.is_idle() || lane.sender() != incarnation);
    }

    /// Sends a letter. Returns how many outcomes will follow under this number; outcomes that are
    /// known at once are among the actions when this returns.
    pub fn send(&mut self, now: Now, submission: Submission) -> (SendId, usize) {
        let Submission {
            sender,
            letter,
            receivers,
            deadline,
        } = submission;
        let send = SendId(self.next_send);
        self.next_send += 1;
        let deadline = now.instant + deadline.min(MAX_DEADLINE);
        let directory = Arc::clone(&self.desk.directory);
        let sender_name = self
            .agents
            .get(&sender)
            .map(|inbox| Arc::clone(&inbox.name));
        let mut reached: Vec<Incarnation> = Vec::new();
        let mut count = 0;
        let only_one = receivers.len() == 1;
        for receiver in receivers {
            let own = sender_name.as_deref().unwrap_or_default();
            let entries = match fipa_sds::resolve(&*directory, &receiver, own) {
                // What nearly every letter is, without what more of them would take.
                Ok(Resolution::Exact(entry)) if only_one && entry.incarnation.is_known() => {
                    self.send_one(now, (send, sender), &entry, letter, deadline);
                    self.tell_failures(now);
                    return (send, 1);
                }
                Ok(Resolution::Exact(entry)) => vec![entry],
                Ok(Resolution::Multicast(entries)) => entries,
                Ok(Resolution::Coalition { agents, missing }) => {
                    count += missing.len();
                    for member in missing {
                        let reason = FailureReason::NoSuchAgent;
                        self.undeliverable(send, sender, member, letter.clone(), reason);
                    }
                    if agents.is_empty() {
                        continue;
                    }
                    agents
                }
                Ok(Resolution::None) | Err(_) => Vec::new(),
            };
            if entries.is_empty() {
                count += 1;
                let reason = FailureReason::NoSuchAgent;
                self.undeliverable(send, sender, receiver, letter.clone(), reason);
            }
            for entry in entries {
                let life = desk::life_of(&entry);
                if reached.contains(&life) {
                    continue;
                }
                reached.push(life);
                count += 1;
                self.send_one(now, (send, sender), &entry, letter.clone(), deadline);
            }
        }
        self.tell_failures(now);
        (send, count)
    }

    /// Sends a letter to this one life of an agent, whatever others are called; the receivers of
    /// the submission are not looked at. One outcome will follow under this number.
    pub fn send_to(&mut self, now: Now, submission: Submission, entry: &Entry) -> SendId {
        let send = SendId(self.next_send);
        self.next_send += 1;
        let deadline = now.instant + submission.deadline.min(MAX_DEADLINE);
        let sending = (send, submission.sender);
        self.send_one(now, sending, entry, submission.letter, deadline);
        self.tell_failures(now);
        send
    }

    fn send_one(
        &mut self,
        now: Now,
        (send, sender): (SendId, Incarnation),
        entry: &Entry,
        letter: Letter,
        deadline: Instant,
    ) {
        let stream = Stream {
            sender,
            receiver: desk::life_of(entry),
        };
        let name = Arc::clone(&entry.name);
        let waiting = self.lanes.get(&stream).map_or(0, Lane::len);
        if waiting >= self.desk.config.lane {
            return self.undeliverable(send, sender, name, letter, FailureReason::QueueFull);
        }
        let sequence = self.sequence_of(sender);
        self.desk.notice(stream, sequence, &name, || News::Sent {
            send: Some(send),
            letter: letter.clone(),
        });
        let origin = Origin::Local { send };
        let delivery = Delivery::new(origin, letter, sequence, deadline);
        self.put(now, stream, name, delivery);
    }

    fn sequence_of(&mut self, sender: Incarnation) -> u64 {
        let counter = match self.agents.get_mut(&sender) {
            Some(inbox) => &mut inbox.next_sequence,
            None => &mut self.next_sequence,
        };
        *counter += 1;
        *counter - 1
    }

    fn undeliverable(
        &mut self,
        send: SendId,
        sender: Incarnation,
        receiver: Arc<str>,
        letter: Letter,
        reason: FailureReason,
    ) {
        let outcome = Outcome::Failed {
            reason,
            attempts: Vec::new(),
        };
        let sequence = self.sequence_of(sender);
        let stream = Stream {
            sender,
            receiver: Incarnation::UNKNOWN,
        };
        self.desk
            .notice(stream, sequence, &receiver, || News::Sent {
                send: Some(send),
                letter: letter.clone(),
            });
        self.desk
            .notice(stream, sequence, &receiver, || News::Settled {
                outcome: outcome.clone(),
                sender: true,
            });
        self.desk.undelivered.push_back(Undelivered {
            sender: Author::Ours(sender),
            receiver: Arc::clone(&receiver),
            letter,
            reason,
            detail: String::new(),
        });
        self.desk.actions.push_back(Action::Outcome {
            send,
            receiver,
            outcome,
        });
    }

    /// Puts a letter into its lane and gets it moving.
    fn put(&mut self, now: Now, stream: Stream, receiver: Arc<str>, delivery: Delivery) {
        let lane = self
            .lanes
            .entry(stream)
            .or_insert_with(|| Lane::new(now.instant, stream, receiver));
        lane.push(delivery, &mut self.desk);
        self.with_lane(now, stream, |lane, desk, moved| {
            lane.pump(now.instant, desk, moved)
        });
    }

    /// Works on a lane, then takes care of what it could not decide alone and of its timer.
    fn with_lane(
        &mut self,
        now: Now,
        stream: Stream,
        work: impl FnOnce(&mut Lane, &mut Desk, &mut Vec<Moved>),
    ) {
        let mut moved = Vec::new();
        let Some(lane) = self.lanes.get_mut(&stream) else {
            return;
        };
        work(lane, &mut self.desk, &mut moved);
        if let Some(due) = lane.due()
            && lane.scheduled.is_none_or(|scheduled| due < scheduled)
        {
            lane.scheduled = Some(due);
            self.timers.push(Reverse((due, stream)));
        }
        for Moved { to, delivery } in moved {
            let stream = Stream {
                sender: stream.sender,
                receiver: desk::life_of(&to),
            };
            self.put(now, stream, Arc::clone(&to.name), delivery);
        }
    }

    /// Where receivers are looked up.
    #[must_use]
    pub fn directory(&self) -> &Arc<dyn Directory> {
        &self.desk.directory
    }

    /// Whether somebody watches: then [`Action::Notice`] tells of every letter, before what is to
    /// be done about it.
    pub fn watch(&mut self, watched: bool) {
        self.desk.watched = watched;
    }

    /// Takes the next letter out of an agent's queue.
    pub fn take(&mut self, agent: Incarnation) -> Option<Received> {
        let inbox = self.agents.get_mut(&agent)?;
        let received = inbox.take()?;
        let receiver = Arc::clone(&inbox.name);
        for (stream, back) in inbox.credits() {
            self.desk.credit(stream, Arc::clone(&receiver), back);
        }
        Some(received)
    }

    /// How many letters wait in an agent's queue.
    #[must_use]
    pub fn waiting(&self, agent: Incarnation) -> usize {
        self.agents.get(&agent).map_or(0, Inbox::len)
    }

    /// A parcel arrived by the transport of this kind.
    pub fn handle_arrival(
        &mut self,
        now: Now,
        via: Kind,
        answers_at_once: bool,
        arrival: Arrival,
    ) -> Verdict {
        let Arrival {
            mut parcel,
            from,
            ticket,
        } = arrival;
        match std::mem::replace(&mut parcel.body, Body::Credit) {
            Body::Letter(letter) => {
                if parcel.after > 0 && parcel.after >= parcel.sequence {
                    // Followed from letter to letter, this would lead nowhere, or in a circle.
                    let detail = "the letter comes after itself or a later one";
                    return Verdict::Now(Answer::failed(FailureReason::Refused, detail));
                }
                let watched = self.desk.watched;
                if let Some(inbox) = self.agents.get_mut(&parcel.stream.receiver) {
                    let seen = watched.then(|| letter.clone());
                    let gate = self.gate.as_deref();
                    let came = (via, &from.location);
                    let answer = inbox.accept(now.instant, &parcel, letter, came, gate);
                    if answer == Answer::Accepted {
                        if let Some(letter) = seen {
                            let via = Some(via);
                            let Parcel {
                                stream, sequence, ..
                            } = parcel;
                            self.desk
                                .notice(stream, sequence, &parcel.receiver, || News::Taken {
                                    via,
                                    letter,
                                });
                        }
                        let agent = parcel.stream.receiver;
                        self.desk.actions.push_back(Action::Deliverable { agent });
                    }
                    return Verdict::Now(answer);
                }
                let unanswered = (!answers_at_once).then_some((via, ticket));
                let verdict = self.forward(now, via, &parcel, letter, from, unanswered);
                self.tell_failures(now);
                verdict
            }
            Body::Report(report) => {
                self.handle_report(now, &parcel, report);
                Verdict::Now(Answer::Accepted)
            }
            Body::Credit => {
                self.with_lane(now, parcel.stream, |lane, desk, moved| {
                    lane.resume(now.instant, desk, moved)
                });
                self.tell_failures(now);
                Verdict::Now(Answer::Accepted)
            }
        }
    }

    fn handle_report(&mut self, now: Now, parcel: &Parcel, report: Report) {
        self.with_lane(now, parcel.stream, |lane, desk, moved| {
            lane.reported(now.instant, parcel.sequence, report, desk, moved);
        });
        self.tell_failures(now);
    }

    /// An attempt has ended, or was refused by its transport at once.
    pub fn handle_conclusion(&mut self, now: Now, attempt: AttemptId, conclusion: Conclusion) {
        match self.desk.attempts.remove(&attempt) {
            Some(Purpose::Letter { stream, sequence }) => {
                let mut way = None;
                // What found no room has made none: told that it had, it would try again at once,
                // and in vain, until the way counts as broken.
                let made_room = !matches!(
                    &conclusion,
                    Conclusion::NotSent(error) if error.fault == WayFault::Congested
                );
                self.with_lane(now, stream, |lane, desk, moved| {
                    way = lane.way_of(sequence).filter(|_| made_room).cloned();
                    lane.concluded(now.instant, sequence, attempt, conclusion, desk, moved);
                });
                // Whatever has ended has made room.
                if let Some(stream) = way.and_then(|way| self.desk.room_for(&way)) {
                    self.with_lane(now, stream, |lane, desk, moved| {
                        lane.resume(now.instant, desk, moved)
                    });
                }
            }
            Some(Purpose::Note(note)) => self.note_concluded(now, *note, conclusion),
            Some(Purpose::Touch { peer }) => {
                let asked = (peer, attempt);
                self.peers
                    .concluded(now.instant, asked, conclusion, &mut self.desk);
            }
            None => {}
        }
        self.tell_failures(now);
    }

    fn note_concluded(&mut self, now: Now, note: Note, conclusion: Conclusion) {
        let arrived = matches!(conclusion, Conclusion::Answered(_) | Conclusion::Handed);
        // A credit that is lost is made up for by the sender's own pause.
        let again = matches!(note.parcel.body, Body::Report(_)) && note.tries < NOTE_TRIES;
        if !arrived && again {
            let pause = Duration::from_millis(20) * (1 << note.tries);
            self.notes
                .push(Reverse(LateNote(now.instant + pause, note)));
        }
    }

    /// Something in the directory has changed.
    pub fn handle_directory_change(&mut self, now: Now) {
        let streams: Vec<Stream> = self.lanes.keys().copied().collect();
        for stream in streams {
            self.with_lane(now, stream, |lane, desk, moved| {
                if !lane.is_empty() {
                    lane.directory_changed(now.instant, desk, moved);
                }
            });
        }
        self.tell_failures(now);
    }

    /// This entry has left the directory, or its name has another one now. Comes before
    /// [`handle_directory_change`](Self::handle_directory_change). A gateway passes letters for an
    /// agent that has left its host on to where the name is registered next, for half a minute.
    pub fn handle_departure(&mut self, now: Now, entry: &Entry) {
        if self.desk.config.forwards {
            self.departed.left(now.instant, entry);
        }
    }

    /// Time has passed: call this when [`poll_timeout`](Self::poll_timeout) says so.
    pub fn handle_timeout(&mut self, now: Now) {
        while let Some(Reverse((due, stream))) = self.timers.peek().copied() {
            if due > now.instant {
                break;
            }
            self.timers.pop();
            if let Some(lane) = self.lanes.get_mut(&stream)
                && lane.scheduled == Some(due)
            {
                lane.scheduled = None;
            }
            self.with_lane(now, stream, |lane, desk, moved| {
                lane.pump(now.instant, desk, moved)
            });
        }
        while self
            .notes
            .peek()
            .is_some_and(|Reverse(late)| late.0 <= now.instant)
        {
            if let Some(Reverse(LateNote(_, note))) = self.notes.pop() {
                self.desk.note(note);
            }
        }
        self.peers.handle_timeout(now.instant, &mut self.desk);
        self.tell_failures(now);
        self.forget_idle_lanes(now);
    }

    /// Uses these orders of transports from now on, for letters that wait as well. What is under
    /// way stays so.
    pub fn reorder(&mut self, now: Now, order: Vec<Kind>, routes: Vec<(Pattern, Vec<Kind>)>) {
        self.desk.config.order = order;
        self.desk.config.routes = routes;
        self.peers.reorder(now.instant, &mut self.desk);
        self.handle_directory_change(now);
    }

    /// Takes no more letters of others into custody: the service is about to end. Whoever has one
    /// keeps it, and looks for another way or another gateway.
    pub fn refuse_custody(&mut self) {
        self.ending = true;
    }

    /// Keeps in touch with these services, and no others, from now on.
    pub fn keep_in_touch(&mut self, now: Now, peers: Vec<Peer>) {
        self.peers.set(now.instant, peers, &mut self.desk);
    }

    /// How it stands with the services to keep in touch with.
    #[must_use]
    pub fn peers(&self, now: Now) -> Vec<PeerState> {
        self.peers.states(now.instant)
    }

    /// A connection that was opened for this location has ended.
    pub fn handle_parted(&mut self, now: Now, location: &Location) {
        self.peers.parted(now.instant, location);
    }

    fn forget_idle_lanes(&mut self, now: Now) {
        if self.lanes.len() <= IDLE_LANES || self.next_forget.is_some_and(|due| due > now.instant) {
            return;
        }
        self.next_forget = Some(now.instant + IDLE_TIME / 4);
        self.lanes.retain(|_, lane| {
            let quiet = now.instant.saturating_duration_since(lane.active) > IDLE_TIME;
            !lane.is_idle() || (lane.remembers() && !quiet)
        });
    }

    /// When [`handle_timeout`](Self::handle_timeout) wants to be called next.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        let lanes = self.timers.peek().map(|Reverse((due, _))| *due);
        let notes = self.notes.peek().map(|Reverse(late)| late.0);
        [lanes, notes, self.peers.due()].into_iter().flatten().min()
    }

    /// The next thing to be done.
    pub fn poll_action(&mut self) -> Option<Action> {
        self.desk.actions.pop_front()
    }

    /// Whether any letter sent or taken into custody here still has no outcome.
    #[must_use]
    pub fn has_open_letters(&self) -> bool {
        self.lanes.values().any(|lane| !lane.is_empty())
    }

    /// Gives up everything that is under way: the service ends. Outcomes are among the actions.
    pub fn give_up(&mut self) {
        for lane in self.lanes.values_mut() {
            lane.give_up(&mut self.desk);
        }
        self.desk.undelivered.clear();
    }
}
