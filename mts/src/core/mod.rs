//! The delivery core: implements the delivery guarantees without I/O.
//!
//! Every input (a letter to send, an arrived parcel, the end of an attempt, a change of the
//! directory, elapsed time) is passed in with `now`; the actions to perform come out as
//! [`Action`]s. The same core serves a robot process and, with permission to forward, the gateway;
//! simulations run it on virtual time.
//!
//! * `rules`: the rules that keep a stream in order and alive, as pure functions.
//! * `lane`: the open letters of one stream, in order, on one route at a time.
//! * `inbox`: the receiving end, which accepts letters once and in order.
//! * `forward`: letters for agents of other processes.
//! * `failures`: failure messages to senders.
//! * `limits`: rate limits of these messages.
//! * `departed`: registrations that recently left this host.
//! * `peers`: services in the configuration, and the state of contact with them.
//! * `routes`: reports of the routes of letters, and counters of each route.
//! * `attempts`: state that lanes share: attempts, health of routes, pending actions.
//! * `notes`: reports, credits and predecessors, which are repeated or wait for room.
//! * `notice`: notifications for watchers.
//! * `passes`: visits of all lanes, in portions.
//! * `waiting`: letters that wait for a refresh of the directory.
//!
//! The core looks up receivers in a [`View`] of the directory, which does not change and takes no
//! I/O to read. If a name or a registration is not in it, the letter waits, and the core emits
//! [`Action::Refresh`]; [`Core::handle_refreshed`] resolves the letter again. So a letter to a name
//! that was registered before the letter was sent does not fail as unknown.
//!
//! A letter is identified and ordered by its *stream* (one registration of the sender, one of the
//! receiver) and its sequence number. Every copy names its predecessor, the letter that must be
//! taken before it, so that a failed letter leaves no gap to wait for.

mod attempts;
mod config;
mod departed;
mod failures;
mod forward;
mod inbox;
mod lane;
mod limits;
mod notes;
mod notice;
mod passes;
mod peers;
mod principals;
mod reading;
mod routes;
#[doc(hidden)]
pub mod rules;
mod waiting;
#[doc(hidden)]
pub mod work;

use std::cmp::Reverse;
use std::collections::{BTreeSet, BinaryHeap};
use std::fmt;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_acl::Letter;
use fipa_sds::{Entry, Pattern, Resolution, Role, Source, View};
use fipa_transport::{
    Answer, Arrival, Attempt, AttemptId, Body, Conclusion, FailureReason, Hop, Incarnation,
    Introduction, Kind, Location, Outcome, Parcel, Principal, Realm, Report, Stream, Verdict,
};

pub use attempts::Action;
use attempts::{AttemptTable, FailureTarget, Origin, Purpose, Undelivered};
pub use config::{CoreConfig, MAX_DEADLINE};
pub use failures::Undecodable;
pub use forward::Unframed;
use inbox::Inbox;
pub use inbox::Received;
use lane::{Delivery, Lane, LaneId, LaneKey, PauseEnd};
use limits::{FailureLimit, SenderLimit};
use notes::Note;
pub use notice::{News, Notice};
use passes::{Concern, Passes, Step};
pub use reading::{LetterReader, ReadLetter};

use waiting::{Unresolved, WaitingLetters};

use crate::{AccessGate, Map};
use peers::Peers;
pub use peers::{Peer, PeerState};
use principals::{PrincipalError, Principals};
pub use routes::{Route, RouteCandidate, RouteState, Standing};

/// The current time by two clocks.
#[derive(Debug, Clone, Copy)]
pub struct Now {
    /// Monotonic clock, for deadlines and pauses.
    pub instant: Instant,
    /// Wall clock, for dates in envelopes.
    pub utc: SystemTime,
}

impl Now {
    /// Reads both clocks of this machine.
    #[must_use]
    pub fn read() -> Self {
        Self {
            instant: Instant::now(),
            utc: SystemTime::now(),
        }
    }
}

/// Identifies a call of [`Core::send`] in its outcomes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct SendId(pub u64);

/// A letter that an agent of this process sends.
#[derive(Debug, Clone)]
pub struct Submission {
    /// The sending agent's incarnation.
    pub sender: Incarnation,
    /// The letter, the same for all receivers.
    pub letter: Letter,
    /// Names of receivers or coalitions, or patterns.
    pub receivers: Vec<Arc<str>>,
    /// Time limit of the delivery, at most [`MAX_DEADLINE`].
    pub deadline: Duration,
}

/// Maximum number of lanes that one call visits for one cause. Peers can have tens of thousands of lanes kept, and
/// the service is locked during a call.
const LANES_AT_ONCE: usize = 16;

/// Empty lanes are dropped when there are more lanes than this.
const IDLE_LANES: usize = 1024;
/// Minimum time for which a lane without letters is kept.
const IDLE_TIME: Duration = Duration::from_secs(60);
/// This minimum when many lanes are created in a short time. A lane that is dropped too early costs time,
/// but no letter: its next letter waits longer for a predecessor that failed.
const IDLE_TIME_IN_A_CROWD: Duration = Duration::from_secs(1);

/// The delivery core. See the module documentation.
pub struct Core {
    table: AttemptTable,
    /// In boxes: a table that grows moves its values, under the lock.
    lanes: Map<LaneId, Box<Lane>>,
    /// In the order of creation, so that runs with one seed are equal.
    lane_order: BTreeSet<LaneId>,
    passes: Passes,
    lane_ids: Map<LaneKey, LaneId>,
    agents: Map<Incarnation, Inbox>,
    timers: BinaryHeap<Reverse<(Instant, LaneId)>>,
    waiting: WaitingLetters,
    peers: Peers,
    principals: Principals,
    reader: LetterReader,
    failure_limit: FailureLimit,
    /// Limit the rates at which agents of other gateways, and of legacy peers, become known by their letters.
    contact_limit: SenderLimit,
    legacy_contact_limit: SenderLimit,
    /// The addresses at which this service listens on the network.
    own_addresses: Vec<SocketAddr>,
    /// Whether letters of others are no longer accepted.
    ending: bool,
    /// Whether the service has ended, and so sends nothing.
    closed: bool,
    next_lane: u64,
    next_send: u64,
    /// Next sequence number of the letters that this service sends in its own name.
    next_sequence: u64,
    next_forget: Option<Instant>,
    /// Number of lanes at which empty ones are dropped at once.
    crowd: usize,
}

impl fmt::Debug for Core {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Core")
            .field("lanes", &self.lanes.len())
            .field("agents", &self.agents.len())
            .field("closed", &self.closed)
            .finish_non_exhaustive()
    }
}

impl Core {
    /// Creates a core that looks up receivers in this view of the directory.
    #[must_use]
    pub fn new(config: CoreConfig, view: Arc<dyn View>) -> Self {
        let reader = LetterReader::new(&config);
        Self {
            table: AttemptTable::new(config, view),
            lanes: Map::default(),
            lane_order: BTreeSet::new(),
            passes: Passes::default(),
            lane_ids: Map::default(),
            agents: Map::default(),
            timers: BinaryHeap::new(),
            waiting: WaitingLetters::default(),
            peers: Peers::default(),
            principals: Principals::default(),
            reader,
            failure_limit: FailureLimit::default(),
            contact_limit: forward::contact_limit(),
            legacy_contact_limit: forward::contact_limit(),
            own_addresses: Vec::new(),
            ending: false,
            closed: false,
            next_lane: 1,
            next_send: 1,
            next_sequence: 1,
            next_forget: None,
            crowd: 2 * IDLE_LANES,
        }
    }

    /// Sets the gate that decides which letters are accepted.
    #[must_use]
    pub fn gated(mut self, gate: Arc<dyn AccessGate>) -> Self {
        self.reader.gate = Some(gate);
        self
    }

    /// Returns the reader of the letters for [`handle_read_arrival`](Self::handle_read_arrival).
    #[must_use]
    pub fn reader(&self) -> &LetterReader {
        &self.reader
    }

    /// Returns the configuration.
    #[must_use]
    pub fn config(&self) -> &CoreConfig {
        &self.table.config
    }

    /// Registers an agent of this process: letters for it are accepted from now on.
    pub fn register(&mut self, name: Arc<str>, incarnation: Incarnation) {
        let inbox = Inbox::new(name, &self.table.config);
        self.agents.insert(incarnation, inbox);
    }

    /// Removes an agent of this process: its unread letters are dropped, and its open letters end
    /// as failed or unconfirmed.
    pub fn deregister(&mut self, now: Now, incarnation: Incarnation) {
        // Their sequences are those of the agent.
        for letter in self.waiting.remove(|letter| letter.sender == incarnation) {
            self.fail_unresolved(letter, FailureReason::Closed);
        }
        if let Some(mut inbox) = self.agents.remove(&incarnation) {
            let receiver = Arc::clone(&inbox.name);
            for (stream, back) in inbox.all_waiting() {
                self.table.credit(stream, Arc::clone(&receiver), back);
            }
        }
        for id in self.lanes_in_order() {
            if let Some(lane) = self.lanes.get_mut(&id)
                && lane.sender() == incarnation
            {
                lane.give_up(now.instant, &mut self.table);
            }
        }
        self.table.undelivered.clear();
        self.forget_lanes(|lane| lane.is_idle() && lane.sender() == incarnation);
    }

    /// Sends a letter. Returns the number of outcomes that follow under this ID; outcomes that are
    /// known at once are among the actions when this method returns. The number is `None` if a
    /// receiver is not in the view, or is a pattern: [`Action::Resolved`] then reports it after the
    /// directory was refreshed. Letters of one sender are resolved in the order of the calls.
    pub fn send(&mut self, now: Now, submission: Submission) -> (SendId, Option<usize>) {
        let Submission {
            sender,
            letter,
            receivers,
            deadline,
        } = submission;
        let letter = match &receivers[..] {
            [receiver] => match self.send_to_name(now, sender, letter, receiver, deadline) {
                Ok(send) => return (send, Some(1)),
                Err(letter) => letter,
            },
            _ => letter,
        };
        let send = SendId(self.next_send);
        self.next_send += 1;
        if self.closed {
            for receiver in &receivers {
                let receiver = Arc::clone(receiver);
                let reason = FailureReason::Closed;
                self.undeliverable(send, sender, receiver, letter.clone(), reason);
            }
            self.table.undelivered.clear();
            return (send, Some(receivers.len()));
        }
        let deadline = now.instant + deadline.min(MAX_DEADLINE);
        let mut unresolved = Unresolved {
            send,
            sender,
            letter,
            receivers,
            deadline,
        };
        if self.is_in_turn(sender) {
            match self.resolve(now, unresolved, false) {
                Ok(outcomes) => return (send, Some(outcomes)),
                Err(back) => unresolved = back,
            }
        }
        let len = unresolved.letter.len();
        if self.waiting.has_room(sender, len, &self.table.config) {
            let number = self.table.want_refresh();
            self.waiting.push(number, unresolved);
            return (send, None);
        }
        let outcomes = unresolved.receivers.len();
        self.fail_receivers(unresolved, FailureReason::QueueFull);
        self.send_failures(now);
        (send, Some(outcomes))
    }

    /// Sends a letter to the agent with exactly this name. One outcome follows.
    ///
    /// # Errors
    /// Returns the letter if it must be submitted to [`send`](Self::send), for example because the view
    /// shows no such agent.
    #[expect(
        clippy::result_large_err,
        reason = "the letter is moved in and back; a box would cost an allocation"
    )]
    pub fn send_to_name(
        &mut self,
        now: Now,
        sender: Incarnation,
        letter: Letter,
        receiver: &str,
        deadline: Duration,
    ) -> Result<SendId, Letter> {
        if self.closed || !self.is_in_turn(sender) {
            return Err(letter);
        }
        let is_agent = |entry: &Arc<Entry>| {
            entry.incarnation.is_known() && !matches!(entry.role, Role::Coalition(_))
        };
        let Some(entry) = self.table.view.named(receiver).filter(is_agent) else {
            return Err(letter);
        };
        let send = SendId(self.next_send);
        self.next_send += 1;
        let deadline = now.instant + deadline.min(MAX_DEADLINE);
        self.send_one(now, (send, sender), &entry, letter, deadline);
        self.send_failures(now);
        Ok(send)
    }

    /// Whether no earlier letter of this sender waits to be resolved.
    fn is_in_turn(&self, sender: Incarnation) -> bool {
        self.waiting.is_empty() || !self.waiting.has_any_of(sender)
    }

    /// Resolves the receivers of a letter in the view, and sends it to them. Returns the number of
    /// outcomes, or the letter if a refresh of the directory may add receivers. After a refresh, an
    /// unknown receiver is final.
    #[expect(
        clippy::result_large_err,
        reason = "the letter is moved in and back; a box would cost an allocation"
    )]
    fn resolve(
        &mut self,
        now: Now,
        unresolved: Unresolved,
        is_fresh: bool,
    ) -> Result<usize, Unresolved> {
        let view = Arc::clone(&self.table.view);
        let sender = unresolved.sender;
        let sender_name = self
            .agents
            .get(&sender)
            .map(|inbox| Arc::clone(&inbox.name));
        let own = sender_name.as_deref().unwrap_or_default();
        let mut resolved = Vec::new();
        for receiver in &unresolved.receivers {
            let resolution = fipa_sds::resolve(&*view, receiver, own);
            match resolution {
                Ok(resolution) if !is_fresh && !resolution.is_complete() => {
                    return Err(unresolved);
                }
                Ok(resolution) => resolved.push(resolution),
                // Not a valid pattern, so no name matches it.
                Err(_) => resolved.push(Resolution::None),
            }
        }
        let Unresolved {
            send,
            letter,
            receivers,
            deadline,
            ..
        } = unresolved;
        let mut reached: Vec<Incarnation> = Vec::new();
        let mut count = 0;
        for (receiver, resolution) in receivers.into_iter().zip(resolved) {
            let entries = match resolution {
                Resolution::Exact(entry) => vec![entry],
                Resolution::Multicast(entries) => entries,
                Resolution::Coalition { agents, missing } => {
                    count += missing.len();
                    for member in missing {
                        self.absent(send, sender, member, letter.clone());
                    }
                    if agents.is_empty() {
                        continue;
                    }
                    agents
                }
                Resolution::None => Vec::new(),
            };
            if entries.is_empty() {
                count += 1;
                self.absent(send, sender, receiver, letter.clone());
            }
            for entry in entries {
                let registration = attempts::registration_of(&entry);
                if reached.contains(&registration) {
                    continue;
                }
                reached.push(registration);
                count += 1;
                self.send_one(now, (send, sender), &entry, letter.clone(), deadline);
            }
        }
        self.send_failures(now);
        Ok(count)
    }

    /// Ends a letter whose receivers were not resolved.
    fn fail_unresolved(&mut self, letter: Unresolved, reason: FailureReason) {
        self.table.actions.push_back(Action::Resolved {
            send: letter.send,
            outcomes: letter.receivers.len(),
        });
        self.fail_receivers(letter, reason);
    }

    fn fail_receivers(&mut self, letter: Unresolved, reason: FailureReason) {
        let Unresolved {
            send,
            sender,
            letter,
            receivers,
            ..
        } = letter;
        for receiver in receivers {
            self.undeliverable(send, sender, receiver, letter.clone(), reason);
        }
    }

    /// Replaces the view of the directory. Call it before other methods when the directory has
    /// changed. Returns the previous view.
    pub fn set_view(&mut self, view: Arc<dyn View>) -> Arc<dyn View> {
        std::mem::replace(&mut self.table.view, view)
    }

    /// Handles the end of a refresh of the directory, which began after the core had emitted
    /// [`Action::Refresh`] with this number. Call [`set_view`](Self::set_view) before. A refresh
    /// covers all earlier numbers, too.
    pub fn handle_refreshed(&mut self, now: Now, number: u64) {
        while let Some(lane) = self.table.refreshed_lane(number) {
            self.with_lane(now, lane, |lane, table| {
                lane.refreshed(now.instant, number, table);
            });
        }
        while let Some(letter) = self.waiting.pop(number) {
            let send = letter.send;
            if let Ok(outcomes) = self.resolve(now, letter, true) {
                let resolved = Action::Resolved { send, outcomes };
                self.table.actions.push_back(resolved);
            }
        }
        self.send_failures(now);
    }

    /// Whether the view has an agent, coalition or gateway of exactly this name.
    #[must_use]
    pub fn knows(&self, name: &str) -> bool {
        self.table.view.named(name).is_some()
    }

    /// Whether the directory is to be refreshed before a letter for this registration and name
    /// arrives, because this service would forward it and does not know the receiver.
    #[must_use]
    pub fn misses(&self, registration: Incarnation, name: &str) -> bool {
        self.table.config.forwards
            && !self.agents.contains_key(&registration)
            && self.table.receiver(registration, name).is_none()
    }

    /// Sends a letter to exactly this registration of an agent; the receivers in the submission are
    /// ignored. One outcome follows under this ID.
    pub fn send_to(&mut self, now: Now, submission: Submission, entry: &Entry) -> SendId {
        let send = SendId(self.next_send);
        self.next_send += 1;
        let deadline = now.instant + submission.deadline.min(MAX_DEADLINE);
        let sending = (send, submission.sender);
        self.send_one(now, sending, entry, submission.letter, deadline);
        self.send_failures(now);
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
        let stream = Stream::between(sender, attempts::registration_of(entry));
        let name = &entry.name;
        if self.closed {
            let reason = FailureReason::Closed;
            return self.undeliverable(send, sender, Arc::clone(name), letter, reason);
        }
        let lane = self.lane(now, own_lane(sender, entry), name);
        if !self.holds_back(now, lane, letter.len()) {
            let reason = FailureReason::QueueFull;
            return self.undeliverable(send, sender, Arc::clone(name), letter, reason);
        }
        let sequence = self.sequence_of(sender);
        self.table.notice(stream, sequence, name, || News::Sent {
            send: Some(send),
            letter: letter.clone(),
        });
        let origin = Origin::Local { send };
        let letter_of = (stream.receiver, sequence);
        let delivery = Delivery::new(now.instant, origin, letter, letter_of, deadline);
        self.put(now, lane, delivery);
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
        self.failed(send, sender, receiver, letter, (reason, Vec::new()));
    }

    /// Fails a letter for an agent that cannot be reached at any of its addresses. `attempts` has the reason for
    /// each of them. One outcome follows.
    pub fn fail_unreachable(
        &mut self,
        now: Now,
        (sender, letter): (Incarnation, Letter),
        receiver: Arc<str>,
        attempts: Vec<Attempt>,
    ) -> SendId {
        let send = SendId(self.next_send);
        self.next_send += 1;
        let reason = FailureReason::NoSuchAgent;
        self.failed(send, sender, receiver, letter, (reason, attempts));
        self.send_failures(now);
        send
    }

    /// Fails a letter to an agent that the directory does not list.
    fn absent(&mut self, send: SendId, sender: Incarnation, receiver: Arc<str>, letter: Letter) {
        let (reason, attempt) = self.table.absence(&receiver);
        let why = (reason, attempt.into_iter().collect());
        self.failed(send, sender, receiver, letter, why);
    }

    fn failed(
        &mut self,
        send: SendId,
        sender: Incarnation,
        receiver: Arc<str>,
        letter: Letter,
        (reason, attempts): (FailureReason, Vec<Attempt>),
    ) {
        let details: Vec<String> = attempts.iter().map(ToString::to_string).collect();
        let detail = details.join("; ");
        let outcome = Outcome::Failed { reason, attempts };
        let sequence = self.sequence_of(sender);
        let stream = Stream::between(sender, Incarnation::UNKNOWN);
        self.table
            .notice(stream, sequence, &receiver, || News::Sent {
                send: Some(send),
                letter: letter.clone(),
            });
        self.table
            .notice(stream, sequence, &receiver, || News::Settled {
                outcome: outcome.clone(),
                sender: true,
            });
        self.table.undelivered.push_back(Undelivered {
            sender: FailureTarget::Ours(sender),
            receiver: Arc::clone(&receiver),
            letter,
            reason,
            detail,
        });
        self.table.actions.push_back(Action::Outcome {
            send,
            receiver,
            outcome,
        });
    }

    /// Puts a letter into its lane and dispatches what can be dispatched.
    fn put(&mut self, now: Now, lane: LaneId, delivery: Box<Delivery>) {
        self.with_lane(now, lane, |lane, table| {
            lane.push(delivery, table);
            lane.pump(now.instant, table);
        });
    }

    /// Returns the lane with this key; creates it if necessary.
    fn lane(&mut self, now: Now, key: LaneKey, receiver: &Arc<str>) -> LaneId {
        if let Some(id) = self.lane_ids.get(&key) {
            return *id;
        }
        self.disperse_crowd(now);
        let id = LaneId(self.next_lane);
        self.next_lane += 1;
        self.lane_ids.insert(key.clone(), id);
        let lane = Lane::new(now.instant, id, key, Arc::clone(receiver));
        self.lanes.insert(id, Box::new(lane));
        self.lane_order.insert(id);
        id
    }

    /// All lanes in the order of creation. Not for events that peers cause; see [`Passes`].
    fn lanes_in_order(&self) -> Vec<LaneId> {
        work::steps(self.lanes.len());
        self.lane_order.iter().copied().collect()
    }

    /// Returns the lane with letters of this stream for the receiver of this name.
    fn lane_of(&self, stream: Stream, receiver: &Arc<str>) -> Option<LaneId> {
        let keys = [
            LaneKey::Custody(stream),
            LaneKey::Name(stream.sender, Arc::clone(receiver)),
            LaneKey::Service(stream),
        ];
        keys.iter().find_map(|key| self.lane_ids.get(key).copied())
    }

    /// Runs `work` on a lane, then schedules its timer and repeated notes.
    fn with_lane(&mut self, now: Now, id: LaneId, work: impl FnOnce(&mut Lane, &mut AttemptTable)) {
        let Some(lane) = self.lanes.get_mut(&id) else {
            return;
        };
        work(lane, &mut self.table);
        if let Some(due) = lane.due()
            && lane.scheduled.is_none_or(|scheduled| due < scheduled)
        {
            lane.scheduled = Some(due);
            self.timers.push(Reverse((due, id)));
        }
        self.await_answers(now);
    }

    /// Returns the view of the directory in which receivers are looked up.
    #[must_use]
    pub fn view(&self) -> &Arc<dyn View> {
        &self.table.view
    }

    /// Turns watching on or off: while it is on, an [`Action::Notice`] reports every event of a
    /// letter before the action that follows from it.
    pub fn watch(&mut self, watched: bool) {
        self.table.watched = watched;
    }

    /// Takes the next letter from an agent's queue.
    pub fn take(&mut self, agent: Incarnation) -> Option<Received> {
        let inbox = self.agents.get_mut(&agent)?;
        let received = inbox.take()?;
        let receiver = Arc::clone(&inbox.name);
        for (stream, back) in inbox.credits() {
            self.table.credit(stream, Arc::clone(&receiver), back);
        }
        Some(received)
    }

    /// Number of letters in an agent's queue.
    #[must_use]
    pub fn waiting(&self, agent: Incarnation) -> usize {
        self.agents.get(&agent).map_or(0, Inbox::len)
    }

    /// Handles a parcel that arrived by this kind of transport.
    #[inline]
    pub fn handle_arrival(&mut self, now: Now, via: Kind, arrival: Arrival) -> Verdict {
        let read = self.reader.read_arrival(&arrival);
        self.handle_read_arrival(now, via, arrival, read)
    }

    /// Handles a parcel whose letter the [reader](Self::reader) of this core has
    /// [read](LetterReader::read_arrival) before the core was locked. A gateway refuses a letter that
    /// was not read, and so does a core with a gate.
    pub fn handle_read_arrival(
        &mut self,
        now: Now,
        via: Kind,
        arrival: Arrival,
        read: Option<Box<ReadLetter>>,
    ) -> Verdict {
        let Arrival {
            mut parcel,
            from,
            ticket,
        } = arrival;
        work::steps(1);
        let is_letter = matches!(parcel.body, Body::Letter(_));
        let view = &*self.table.view;
        if let Err(error) = self.principals.check_service(&from, is_letter, view) {
            return Verdict::Now(Answer::failed(FailureReason::Refused, error.to_string()));
        }
        if from.is_remote() {
            parcel.stream.realm = match parcel.body {
                Body::Letter(_) | Body::Predecessor => self.principals.realm(&from),
                // About letters of agents of this host.
                Body::Report(_) | Body::Credit => Realm::UNPROVED,
            };
        }
        match std::mem::replace(&mut parcel.body, Body::Credit) {
            Body::Letter(letter) => {
                let name = read.as_ref().and_then(|read| read.sender_name());
                let sender = (parcel.stream.sender, name);
                let view = &*self.table.view;
                if let Err(error) = self.principals.check_sender(sender, &from, view) {
                    if error == PrincipalError::NotIntroduced {
                        return Verdict::Now(Answer::Busy);
                    }
                    let detail = error.to_string();
                    return Verdict::Now(Answer::failed(FailureReason::Refused, detail));
                }
                if parcel.sequence == 0 || parcel.after >= parcel.sequence {
                    let detail = "the letter's sequence is not above its predecessor's";
                    return Verdict::Now(Answer::failed(FailureReason::Refused, detail));
                }
                if self.closed && self.agents.contains_key(&parcel.stream.receiver) {
                    let reason = FailureReason::NoSuchAgent;
                    return Verdict::Now(Answer::failed(reason, "the process is closing"));
                }
                if let Some(detail) = reading::too_long(&letter) {
                    return Verdict::Now(Answer::failed(FailureReason::TooLarge, detail));
                }
                if let Some(detail) = read.as_ref().and_then(|read| read.fault.clone()) {
                    return Verdict::Now(Answer::failed(FailureReason::Refused, detail));
                }
                let watched = self.table.watched;
                if let Some(inbox) = self.agents.get_mut(&parcel.stream.receiver) {
                    let seen = watched.then(|| letter.clone());
                    let parts = read.as_ref().and_then(|read| read.parts.as_ref());
                    let gate = self.reader.gate.as_deref().map(|gate| (gate, parts));
                    let came = (via, &from);
                    let answer = inbox.accept(now.instant, &parcel, letter, came, gate);
                    if answer == Answer::Accepted {
                        if let Some(letter) = seen {
                            let via = Some(via);
                            let Parcel {
                                stream, sequence, ..
                            } = parcel;
                            self.table
                                .notice(stream, sequence, &parcel.receiver, || News::Taken {
                                    via,
                                    letter,
                                });
                        }
                        let agent = parcel.stream.receiver;
                        self.table.actions.push_back(Action::Deliverable { agent });
                    }
                    return Verdict::Now(answer);
                }
                let unanswered = ticket.map(|ticket| (via, ticket));
                let came = (via, from, unanswered);
                let verdict = self.forward(now, came, &parcel, letter, read);
                self.send_failures(now);
                verdict
            }
            Body::Report(report) => {
                self.handle_report(now, &parcel, &from, report);
                Verdict::Now(Answer::Accepted)
            }
            Body::Credit => {
                if let Some(lane) = self.lane_of(parcel.stream, &parcel.receiver) {
                    self.with_lane(now, lane, |lane, table| {
                        lane.credited(now.instant, &from, table);
                    });
                }
                self.send_failures(now);
                Verdict::Now(Answer::Accepted)
            }
            Body::Predecessor => {
                let mut answer = None;
                if let Some(lane) = self.lane_ids.get(&LaneKey::Custody(parcel.stream)) {
                    let letter = (parcel.sequence, parcel.after, parcel.transfer);
                    self.with_lane(now, *lane, |lane, table| {
                        answer = lane.handle_predecessor_note(now.instant, &from, letter, table);
                    });
                }
                self.send_failures(now);
                // A report that is on its way tells more than that the letter is gone.
                let (sequence, transfer) = (parcel.sequence, parcel.transfer);
                let is_reported = self.table.is_reporting(parcel.stream, sequence, transfer);
                Verdict::Now(match answer {
                    Some(answer) => answer,
                    None if is_reported => {
                        self.table.repeat_reports(now.instant, &from.location);
                        self.await_answers(now);
                        Answer::Accepted
                    }
                    None => Answer::Returned { uncertain: true },
                })
            }
        }
    }

    fn handle_report(&mut self, now: Now, parcel: &Parcel, from: &Hop, report: Report) {
        if let Some(lane) = self.lane_of(parcel.stream, &parcel.receiver) {
            let Parcel {
                stream,
                sequence,
                transfer,
                ..
            } = *parcel;
            let letter = (stream.receiver, sequence, transfer);
            self.with_lane(now, lane, |lane, table| {
                lane.reported(now.instant, from, letter, report, table);
            });
        }
        self.send_failures(now);
    }

    /// Handles the end of an attempt, or its immediate refusal by the transport.
    pub fn handle_conclusion(&mut self, now: Now, attempt: AttemptId, conclusion: Conclusion) {
        match self.table.attempts.remove(&attempt) {
            Some(Purpose::Letter { lane: id, sequence }) => {
                // An attempt that failed for lack of room has freed none; waking a waiting lane
                // here would make it retry and fail, until the route counts as broken.
                let made_room = !matches!(
                    &conclusion,
                    Conclusion::NotSent(error) if error.fault.waits_for_room()
                );
                let mut next = None;
                self.with_lane(now, id, |lane, table| {
                    if made_room
                        && table.notes.wait_for_room()
                        && let Some(route) = lane.route_of(sequence).cloned()
                    {
                        // A note goes before the next letter of the lane.
                        next = table.made_room(now.instant, &route);
                    }
                    lane.concluded(now.instant, sequence, attempt, conclusion, table);
                });
                if let Some(id) = next {
                    self.with_lane(now, id, |lane, table| {
                        lane.resume(now.instant, PauseEnd::Room, table);
                    });
                }
            }
            Some(Purpose::Note(note)) => self.note_concluded(now, *note, conclusion),
            Some(Purpose::PeerCheck { peer }) => {
                let asked = (peer, attempt);
                self.peers
                    .concluded(now.instant, asked, conclusion, &mut self.table);
            }
            None => {}
        }
        self.send_failures(now);
    }

    /// Handles a change of the directory, after [`set_view`](Self::set_view). Of many lanes, this call
    /// visits a portion, and calls of [`handle_timeout`](Self::handle_timeout) visit the others.
    pub fn handle_directory_change(&mut self, now: Now) {
        self.passes.begin(now.instant, Concern::Directory);
        self.visit_lanes(now);
        self.send_failures(now);
    }

    /// Visits the next lanes that an event concerns.
    fn visit_lanes(&mut self, now: Now) {
        for _ in 0..LANES_AT_ONCE {
            work::steps(1);
            match self.passes.next(now.instant, &self.lane_order) {
                Some(Step::Visit(concern, id)) => self.visit_lane(now, id, concern),
                Some(Step::End(Concern::Crowd)) => {
                    self.crowd = 2 * self.lanes.len().max(IDLE_LANES);
                }
                Some(Step::End(_)) => {}
                None => break,
            }
        }
    }

    fn visit_lane(&mut self, now: Now, id: LaneId, concern: Concern) {
        match concern {
            Concern::Directory => self.with_lane(now, id, |lane, table| {
                if !lane.is_empty() {
                    lane.directory_changed(now.instant, table);
                }
            }),
            Concern::Reachable(service) => self.with_lane(now, id, |lane, table| {
                if lane.is_paused_towards(table, |location| is_at(service, location)) {
                    lane.resume(now.instant, PauseEnd::Reachable, table);
                }
            }),
            Concern::Idle => self.forget_idle_lane(now, id, IDLE_TIME),
            Concern::Crowd => self.forget_idle_lane(now, id, IDLE_TIME_IN_A_CROWD),
        }
    }

    fn forget_idle_lane(&mut self, now: Now, id: LaneId, memory: Duration) {
        let Some(lane) = self.lanes.get(&id) else {
            return;
        };
        let quiet = now.instant.saturating_duration_since(lane.active) > memory;
        if lane.is_idle() && (quiet || !lane.remembers()) {
            self.lane_ids.remove(lane.key());
            self.lanes.remove(&id);
            self.lane_order.remove(&id);
        }
    }

    /// Handles an entry that left the directory or was replaced by another of the same name. Must
    /// be called before [`handle_directory_change`](Self::handle_directory_change). For 30 s a
    /// gateway answers letters for an agent that left its host with [`Answer::Moved`].
    pub fn handle_departure(&mut self, now: Now, entry: &Entry) {
        if self.table.config.forwards {
            self.table.departed.left(now.instant, entry);
            self.principals.left(entry);
        }
    }

    /// Handles another entry of the same registration. Must be called before
    /// [`handle_directory_change`](Self::handle_directory_change), which then ends the attempts at the locations
    /// that its service has left. Returns these locations, for [`left`](fipa_transport::Transport::left). The
    /// announcement of a service with a certificate counts only if it comes from the service itself.
    pub fn handle_relocation(&mut self, before: &Entry, after: &Entry) -> Vec<Location> {
        let is_there = |service: Incarnation| {
            let mut locations = after.locations.iter();
            service.is_known() && locations.any(|it| it.incarnation() == service)
        };
        let is_proved = |service: Incarnation| {
            let principal = self.principals.of_service(service);
            matches!(principal, Some(Principal::Certificate(_)))
        };
        let left: Vec<Location> = before
            .locations
            .iter()
            .filter(|it| !it.kind().is_host_local() && !after.locations.contains(it))
            .filter(|it| is_there(it.incarnation()))
            .filter(|it| after.source == Source::Exchange || !is_proved(it.incarnation()))
            .cloned()
            .collect();
        for location in &left {
            self.table.service_left(location);
        }
        left
    }

    /// Handles elapsed time; call it at the time that [`poll_timeout`](Self::poll_timeout) returns.
    /// Peers can make much work due at once; this call does a portion of it, and the next timeout is
    /// due at once then.
    pub fn handle_timeout(&mut self, now: Now) {
        // Collected first, because work on a lane may set its timer again; that one is for a later
        // call.
        let mut lanes = Vec::new();
        for _ in 0..LANES_AT_ONCE {
            let due = self.timers.peek().copied();
            let Some(Reverse((due, id))) = due.filter(|Reverse((due, _))| *due <= now.instant)
            else {
                break;
            };
            work::steps(1);
            self.timers.pop();
            if let Some(lane) = self.lanes.get_mut(&id)
                && lane.scheduled == Some(due)
            {
                lane.scheduled = None;
                lanes.push(id);
            }
        }
        for id in lanes {
            self.with_lane(now, id, |lane, table| lane.pump(now.instant, table));
        }
        self.visit_lanes(now);
        if !self.waiting.is_empty() {
            let late = |letter: &Unresolved| letter.deadline <= now.instant;
            for letter in self.waiting.remove(late) {
                self.fail_unresolved(letter, FailureReason::TimedOut);
            }
        }
        self.handle_note_timers(now);
        self.peers.handle_timeout(now.instant, &mut self.table);
        self.send_failures(now);
        self.forget_idle_lanes(now);
    }

    /// Replaces the orders of transports, also for waiting letters. Attempts in progress are not
    /// affected.
    pub fn reorder(&mut self, now: Now, order: Vec<Kind>, routes: Vec<(Pattern, Vec<Kind>)>) {
        self.table.config.order = order;
        self.table.config.routes = routes;
        self.peers.reorder(now.instant, &mut self.table);
        self.handle_directory_change(now);
    }

    /// Stops taking letters of others into custody, because the service is about to end. Services
    /// that hold such a letter keep it, and try another route or gateway.
    pub fn refuse_custody(&mut self) {
        self.ending = true;
    }

    /// Sets the services to keep in touch with.
    pub fn keep_in_touch(&mut self, now: Now, peers: Vec<Peer>) {
        self.peers.set(now.instant, peers, &mut self.table);
    }

    /// Returns the state of contact with each of these services.
    #[must_use]
    pub fn peers(&self, now: Now) -> Vec<PeerState> {
        self.peers.states(now.instant)
    }

    /// Handles the end of a connection that was opened for this location.
    pub fn handle_parted(&mut self, now: Now, peer: &Introduction) {
        self.principals.parted(peer);
        if let Some(dialed) = &peer.dialed {
            self.peers.parted(now.instant, dialed);
        }
    }

    /// Whether a peer may be the service that it claims to be: `false` if another principal has proved
    /// to be it and is connected, or if its incarnation is that of another principal's agent.
    #[must_use]
    pub fn accepts(&self, peer: &Introduction) -> bool {
        self.principals.accepts(peer, &*self.table.view)
    }

    /// Handles the introduction of a service on a connection. Its incarnation now belongs to the
    /// principal that the link proves, and failed routes to it may work again.
    pub fn handle_introduced(&mut self, now: Now, peer: &Introduction) {
        self.principals.introduced(peer, &*self.table.view);
        let service = peer.hop.location.incarnation();
        // It has proved another certificate.
        let withdrawn = self.table.withdrawn.get(&service).copied();
        if withdrawn.is_some() && withdrawn != self.principals.of_service(service) {
            self.table.withdrawn.remove(&service);
        }
        self.table.repeat_reports(now.instant, &peer.hop.location);
        self.await_answers(now);
        if service.is_known() {
            self.handle_reachable(now, Some(service));
        }
    }

    /// Handles a change of the trusted certificates, which `is_trusted` knows by their fingerprints. Letters
    /// for the agents of services whose certificate is no longer trusted end. Returns these services.
    /// Letters of their agents that were taken before stay.
    pub fn handle_trust(
        &mut self,
        now: Now,
        is_trusted: impl Fn(&[u8; 32]) -> bool,
    ) -> Vec<(Incarnation, Principal)> {
        self.table.withdrawn = self.principals.untrusted(is_trusted);
        if !self.table.withdrawn.is_empty() {
            // Only the owner of this host withdraws trust.
            for id in self.lanes_in_order() {
                self.with_lane(now, id, |lane, table| {
                    if !lane.is_empty() {
                        lane.trust_changed(now.instant, table);
                    }
                });
            }
        }
        self.send_failures(now);
        let withdrawn = self.table.withdrawn.iter();
        withdrawn.map(|(it, principal)| (*it, *principal)).collect()
    }

    /// Handles a change of this host's network, or a connection that this service has opened. Drops
    /// the recorded failures of routes to the service, or of all routes if `service` is `None`, and
    /// dispatches the letters that wait because of them.
    pub fn handle_reachable(&mut self, now: Now, service: Option<Incarnation>) {
        let had_failed = self
            .table
            .forget_failures(|location| is_at(service, location));
        if service.is_none() {
            self.peers.ask_again(now.instant, &mut self.table);
        } else if !had_failed {
            // No letter waits for this service. A peer decides how often it connects.
            return;
        }
        self.passes.begin(now.instant, Concern::Reachable(service));
        self.visit_lanes(now);
        self.send_failures(now);
    }

    /// Opens connections to these locations, to announce the current locations of this service to
    /// them: dispatches one credit to each, which no lane waits for. It is not repeated.
    pub fn greet(&mut self, services: Vec<(Arc<str>, Location)>) {
        for (name, location) in services {
            let no_stream = Stream::between(Incarnation::UNKNOWN, Incarnation::UNKNOWN);
            let parcel = attempts::note_parcel(no_stream, name, 0, Body::Credit);
            self.table.note(Note::once(location, parcel));
        }
    }

    fn forget_idle_lanes(&mut self, now: Now) {
        if self.lanes.len() <= IDLE_LANES || self.next_forget.is_some_and(|due| due > now.instant) {
            return;
        }
        self.next_forget = Some(now.instant + IDLE_TIME / 4);
        self.passes.begin(now.instant, Concern::Idle);
    }

    /// Drops empty lanes when their number has doubled since the last time, because peers can invent
    /// senders, each with a lane.
    fn disperse_crowd(&mut self, now: Now) {
        let is_under_way = self.passes.has(Concern::Crowd);
        if self.lanes.len() < self.crowd && !is_under_way {
            return;
        }
        if !is_under_way {
            self.passes.begin(now.instant, Concern::Crowd);
        }
        self.visit_lanes(now);
    }

    fn forget_lanes(&mut self, forget: impl Fn(&Lane) -> bool) {
        work::steps(self.lanes.len());
        let ids = &mut self.lane_ids;
        let order = &mut self.lane_order;
        self.lanes.retain(|id, lane| {
            let goes = forget(lane);
            if goes {
                ids.remove(lane.key());
                order.remove(id);
            }
            !goes
        });
    }

    /// Time of the next call of [`handle_timeout`](Self::handle_timeout).
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        let lanes = self.timers.peek().map(|Reverse((due, _))| *due);
        let notes = self.table.notes.due();
        let others = earlier(self.peers.due(), self.passes.due());
        earlier(earlier(lanes, notes), earlier(others, self.waiting.due()))
    }

    /// Returns the next action to perform.
    pub fn poll_action(&mut self) -> Option<Action> {
        self.table.actions.pop_front()
    }

    /// Whether any letter that was sent or taken into custody here has no outcome yet.
    #[must_use]
    pub fn has_open_letters(&self) -> bool {
        !self.waiting.is_empty() || self.lanes.values().any(|lane| !lane.is_empty())
    }

    /// Whether the end of a letter in custody was reported, and the service that handed it over has
    /// not confirmed the report.
    #[must_use]
    pub fn has_open_reports(&self) -> bool {
        self.table.has_open_reports()
    }

    /// Abandons all open letters, because the service ends; later submissions fail as closed, and
    /// letters that arrive are not taken. Outcomes are among the actions, and follow from the
    /// conclusions of the abandoned attempts. Letters in custody return to the services that handed
    /// them over, which may take a moment; see [`has_open_reports`](Self::has_open_reports).
    pub fn give_up(&mut self, now: Now) {
        self.closed = true;
        self.ending = true;
        for letter in self.waiting.remove(|_| true) {
            self.fail_unresolved(letter, FailureReason::Closed);
        }
        for id in self.lanes_in_order() {
            if let Some(lane) = self.lanes.get_mut(&id) {
                lane.give_up(now.instant, &mut self.table);
            }
        }
        self.table.undelivered.clear();
    }
}

/// Whether this service is at the location; `None` stands for all services.
fn is_at(service: Option<Incarnation>, location: &Location) -> bool {
    service.is_none_or(|it| it == location.incarnation())
}

/// Key of the lane for letters that this process sends to this receiver.
fn own_lane(sender: Incarnation, entry: &Entry) -> LaneKey {
    match entry.role {
        Role::Agent => LaneKey::Name(sender, Arc::clone(&entry.name)),
        // Several services may have the same name.
        _ => LaneKey::Service(Stream::between(sender, attempts::registration_of(entry))),
    }
}

/// Returns the earlier one of two times.
fn earlier(one: Option<Instant>, other: Option<Instant>) -> Option<Instant> {
    match (one, other) {
        (Some(one), Some(other)) => Some(one.min(other)),
        (one, other) => one.or(other),
    }
}
