//! The delivery core: implements the delivery guarantees without I/O.
//!
//! Every input (a letter to send, an arrived parcel, the end of an attempt, a change of the
//! directory, elapsed time) is passed in with `now`; the actions to perform come out as
//! [`Action`]s. The same core serves a robot process and, with permission to forward, the gateway;
//! simulations run it on virtual time.
//!
//! Inputs:
//!
//! * `submit`: letters of agents of this process; their receivers are looked up.
//! * `arrival`: parcels from other services; unknown receivers are refused.
//! * `unframed`: letters of legacy peers.
//! * `network`: changes of the directory, of connections, of trust.
//!
//! The path of a letter:
//!
//! * `waiting`: it waits for a refresh of the directory, or for the next leader of a coalition.
//! * `lane`: it is among the open letters of one stream, in order, on one route at a time; `lanes` creates,
//!   visits and drops lanes, `passes` divides visits of all lanes into portions.
//! * `routes`: the choice of the location that it goes to, and the failures of locations.
//! * `forward`: a gateway takes it into custody, as far as `lane_budget` has room.
//! * `backlog`: a letter of a legacy peer waits there while the lane of its receiver is full.
//! * `inbox`: it is accepted once and in order into an agent's queue.
//! * `settlement`: its sender, or the services that handed it over, are told its end.
//!
//! Parts that these use:
//!
//! * `rules`: the rules that keep a stream in order and alive, as pure functions.
//! * `attempts`: the state that all lanes share; attempts in progress. `ids`: names within a core.
//! * `label`, `origin`, `tally`, `undelivered`: values that the others pass on.
//! * `action`: the actions for the runtime.
//! * `notes`: reports, credits and predecessors, which are repeated or wait for room.
//! * `failures`: failure messages to senders; `limits`: their rate limits; `summaries`: those beyond them.
//! * `principals`: the identities that services and senders have proved.
//! * `contacts`: agents that become known by their letters.
//! * `peers`: services in the configuration, and the state of contact with them.
//! * `departed`: registrations that recently left this host.
//! * `notice`: notifications for watchers.
//! * `route_report`: reports of the routes of letters, and counters of each location.
//!
//! The core looks up receivers in a [`View`] of the directory, which does not change and takes no
//! I/O to read. If a name or a registration is not in it, the letter waits, and the core emits
//! [`Action::Refresh`]; [`Core::handle_refreshed`] resolves the letter again. So a letter to a name
//! that was registered before the letter was sent does not fail as unknown.
//!
//! A letter is identified and ordered by its *stream* (one registration of the sender, one of the
//! receiver) and its sequence number. Every copy names its predecessor, the letter that must be
//! taken before it, so that a failed letter leaves no gap to wait for.

mod action;
mod arrival;
mod backlog;
mod config;
mod contacts;
mod custody;
mod departed;
mod failures;
mod ids;
mod inbox;
mod label;
mod lane;
mod lane_budget;
mod lane_table;
mod lanes;
pub(crate) mod letter_log;
mod limits;
mod network;
mod notes;
mod origin;
mod passes;
mod peers;
mod principals;
mod reading;
mod route_report;
mod routes;
#[doc(hidden)]
pub mod rules;
mod settlement;
mod submit;
mod summaries;
mod tally;
mod undelivered;
mod unframed;
mod waiting;
mod watch_event;
#[doc(hidden)]
pub mod work;

use std::cmp::Reverse;
use std::collections::{BTreeSet, BinaryHeap};
use std::fmt;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Instant, SystemTime};

use fipa_sds::View;
use fipa_transport::counts::{Event, SharedCounts};
use fipa_transport::{AttemptId, Conclusion, FailureReason, Incarnation, Kind};

pub use self::action::Action;
use self::backlog::Backlog;
pub use self::config::{CoreConfig, MAX_DEADLINE, RouteException};
pub use self::failures::Undecodable;
pub use self::ids::SubmissionId;
use self::ids::{LaneId, LaneKey};
use self::inbox::Inbox;
pub use self::inbox::Received;
use self::lane::{Lane, PauseEnd};
use self::lane_table::{LaneTable, Purpose};
use self::lanes::{IDLE_LANES, LANES_AT_ONCE};
use self::limits::{FailureLimit, SenderLimit};
use self::passes::Passes;
use self::peers::Peers;
pub use self::peers::{Peer, PeerState};
use self::principals::Principals;
pub use self::reading::{LetterReader, ReadLetter};
pub use self::route_report::{Route, RouteCandidate, RouteState, Standing};
pub use self::submit::Submission;
use self::summaries::Summaries;
pub use self::unframed::Unframed;
use self::unframed::failed_for;
use self::waiting::{Unresolved, WaitingLetters};
pub use self::watch_event::{News, Notice};
use crate::{AccessGate, Map};

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

/// The delivery core. See the module documentation.
pub struct Core {
    table: LaneTable,
    /// In boxes: a table that grows moves its values, under the lock.
    lanes: Map<LaneId, Box<Lane>>,
    /// In the order of creation, so that runs with one seed are equal.
    lane_order: BTreeSet<LaneId>,
    passes: Passes,
    lane_ids: Map<LaneKey, LaneId>,
    agents: Map<Incarnation, Inbox>,
    timers: BinaryHeap<Reverse<(Instant, LaneId)>>,
    waiting: WaitingLetters,
    backlog: Backlog,
    summaries: Summaries,
    /// Letters to coalitions that have no leader at present, each with one receiver.
    leaderless: WaitingLetters,
    static_peers: Peers,
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
    /// Whether the view may have agents of other hosts that the processes of this host do not see yet.
    is_ahead: bool,
    /// Whether the service has ended, and so sends nothing.
    closed: bool,
    next_lane: u64,
    next_submission: u64,
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
            table: LaneTable::new(config, view),
            lanes: Map::default(),
            lane_order: BTreeSet::new(),
            passes: Passes::default(),
            lane_ids: Map::default(),
            agents: Map::default(),
            timers: BinaryHeap::new(),
            waiting: WaitingLetters::default(),
            backlog: Backlog::default(),
            summaries: Summaries::default(),
            leaderless: WaitingLetters::default(),
            static_peers: Peers::default(),
            principals: Principals::default(),
            reader,
            failure_limit: FailureLimit::default(),
            contact_limit: contacts::contact_limit(),
            legacy_contact_limit: contacts::contact_limit(),
            own_addresses: Vec::new(),
            ending: false,
            is_ahead: false,
            closed: false,
            next_lane: 1,
            next_submission: 1,
            next_sequence: 1,
            next_forget: None,
            crowd: 2 * IDLE_LANES,
        }
    }

    /// Sets the gate that decides which letters are accepted.
    #[must_use]
    pub fn gated(mut self, gate: Arc<dyn AccessGate>) -> Self {
        self.reader.set_gate = Some(gate);
        self
    }

    /// Counts here from now on.
    #[must_use]
    pub fn counting(mut self, counts: SharedCounts) -> Self {
        self.table.count_in(counts);
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
        let is_own = |letter: &Unresolved| letter.sender == incarnation;
        self.fail_waiting(is_own, FailureReason::Closed);
        if let Some(mut inbox) = self.agents.remove(&incarnation) {
            let receiver = Arc::clone(&inbox.name);
            self.table.counts().event(Event::Read, inbox.len() as u64);
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

    /// Replaces the view of the directory. Call it before other methods when the directory has
    /// changed. Returns the previous view.
    pub fn set_view(&mut self, view: Arc<dyn View>) -> Arc<dyn View> {
        self.is_ahead = true;
        std::mem::replace(&mut self.table.view, view)
    }

    /// Whether the view may have agents of other hosts that the processes of this host do not see yet.
    #[must_use]
    pub fn is_ahead(&self) -> bool {
        self.is_ahead
    }

    /// Records that the processes of this host see all agents of other hosts in the view.
    pub fn handle_published(&mut self) {
        self.is_ahead = false;
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
                self.static_peers
                    .concluded(now.instant, asked, conclusion, &mut self.table);
            }
            None => {}
        }
        self.send_failures(now);
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
            self.with_lane(now, id, |lane, table| lane.dispatch_all(now.instant, table));
        }
        self.visit_lanes(now);
        self.visit_backlog(now);
        self.summarize(now);
        let is_late = |letter: &Unresolved| letter.deadline <= now.instant;
        self.fail_waiting(is_late, FailureReason::TimedOut);
        self.handle_note_timers(now);
        self.static_peers
            .handle_timeout(now.instant, &mut self.table);
        self.send_failures(now);
        self.forget_idle_lanes(now);
    }

    /// Replaces the orders of transports, also for waiting letters. Attempts in progress are not
    /// affected.
    pub fn reorder(&mut self, now: Now, order: Vec<Kind>, routes: Vec<RouteException>) {
        self.table.config.order = order;
        self.table.config.routes = routes;
        self.static_peers.reorder(now.instant, &mut self.table);
        self.handle_directory_change(now);
    }

    /// Stops taking letters of others into custody, because the service is about to end. Services
    /// that hold such a letter keep it, and try another route or gateway.
    pub fn refuse_custody(&mut self) {
        self.ending = true;
    }

    /// Time of the next call of [`handle_timeout`](Self::handle_timeout).
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        let lanes = self.timers.peek().map(|Reverse((due, _))| *due);
        let notes = self.table.notes.due();
        let others = earlier(self.static_peers.due(), self.passes.due());
        let unresolved = earlier(self.waiting.due(), self.leaderless.due());
        let legacy = earlier(self.backlog.due(), self.summaries.due());
        let others = earlier(earlier(others, unresolved), legacy);
        earlier(earlier(lanes, notes), others)
    }

    /// Returns the next action to perform.
    pub fn poll_action(&mut self) -> Option<Action> {
        self.table.actions.pop_front()
    }

    /// Whether any letter that was sent or taken into custody here has no outcome yet.
    #[must_use]
    pub fn has_open_letters(&self) -> bool {
        let unresolved = !self.waiting.is_empty() || !self.leaderless.is_empty();
        unresolved || !self.backlog.is_empty() || self.lanes.values().any(|lane| !lane.is_empty())
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
        self.fail_waiting(|_| true, FailureReason::Closed);
        self.end_backlog(now);
        self.summaries = Summaries::default();
        for id in self.lanes_in_order() {
            if let Some(lane) = self.lanes.get_mut(&id) {
                lane.give_up(now.instant, &mut self.table);
            }
        }
        self.table.undelivered.clear();
    }
}

/// Returns the earlier one of two times.
fn earlier(one: Option<Instant>, other: Option<Instant>) -> Option<Instant> {
    match (one, other) {
        (Some(one), Some(other)) => Some(one.min(other)),
        (one, other) => one.or(other),
    }
}
