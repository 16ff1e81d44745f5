//! The runtime: drives the delivery core with real transports, a directory and the clocks.
//!
//! A thin shell around the core, which one lock protects: inputs are passed to the core, and its
//! actions are carried out before the lock is released, so that parcels leave in the order in which
//! the core decided. Transports never call back from within a dispatch, so this cannot deadlock.
//!
//! The core has a view of the directory, which is replaced when the directory has changed. Only a
//! refresh of the directory, which may read files, is performed after the lock was released.
//!
//! A task that waits for an outcome or a letter first drives the transports for a short time on its
//! own thread, and then sleeps until it is woken.

mod clocks;
mod loans;
mod receiving;

use std::fmt;
use std::future::Future;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use fipa_acl::{AgentId, Letter};
use fipa_sds::{Change, Directory, Entry, View};
use fipa_transport::counts::SharedCounts;
use fipa_transport::{
    Abandoned, Attempt, Body, Conclusion, Incarnation, Introduction, Kind, ListenError, Location,
    Outcome, OwnerProcess, Parcel, Principal, Transport, TransportError, TransportErrorKind,
    log_limit,
};
use parking_lot::{Mutex, MutexGuard};
use tokio::runtime::Handle;
use tokio::sync::{Notify, watch};
use tokio::task::JoinHandle;
use tracing::Span;

use self::clocks::Clocks;
use self::receiving::TransportSink;
use crate::AccessGate;
use crate::Map;
use crate::core::letter_log::{self, LetterId};
use crate::core::{
    Action, Core, CoreConfig, LetterReader, Notice, Now, Peer, PeerState, Received, Route,
    RouteException, RouteState, Submission, SubmissionId, Undecodable,
};
use crate::dial::listened_at;

/// Configuration of the runtime, in addition to that of the core.
#[derive(Clone)]
pub struct RuntimeConfig {
    /// Time for which a waiting task polls the transports before it sleeps. Zero saves energy.
    pub spin: Duration,
    /// Deadline of letters that legacy peers pass to the gateway: theirs have none.
    /// [`Mts::reorder`] changes it.
    pub unframed_deadline: Duration,
    /// Receiver of news about other hosts. Must not call the service back.
    pub contacts: Option<Arc<dyn Contacts>>,
    /// Observer of the letters that pass while the service is [watched](Mts::watch).
    pub tap: Option<Arc<dyn Tap>>,
    /// Decides which letters are accepted; without one, all are. Called with the service locked.
    pub gate: Option<Arc<dyn AccessGate>>,
    /// Where the service counts letters; without it, in memory of its own.
    pub counts: Option<SharedCounts>,
}

impl fmt::Debug for RuntimeConfig {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("RuntimeConfig")
            .field("spin", &self.spin)
            .field("unframed_deadline", &self.unframed_deadline)
            .finish_non_exhaustive()
    }
}

/// Receives news about other hosts: services with an open connection, and agents that are in no
/// directory.
pub trait Contacts: Send + Sync {
    /// A letter from an agent behind this location has arrived; see [`Action::ContactSeen`]. Called with the service
    /// locked; must not block. `host` is the host name that it states, if its location has an address instead.
    fn contact_seen(&self, name: &str, agent: Incarnation, location: Location, host: Option<&str>);

    /// A known agent has sent another letter; see [`Action::ContactSeenAgain`]. Called with the service locked; must not
    /// block.
    fn contact_seen_again(&self, name: &str);

    /// An agent of a legacy peer has taken a letter; see [`Action::Taken`]. Called with the service locked; must
    /// not block.
    fn took(&self, name: &str, location: &Location);

    /// Publishes the agents of other hosts, also those of [`contact_seen`](Self::contact_seen), to the processes of this
    /// host, unless they see them. Returns whether they see all of them. Called without the service locked, because it
    /// may write files.
    fn publish(&self) -> bool;

    /// A service may be gone; see [`Action::Suspect`].
    fn suspect(&self, location: &Location, fault: TransportErrorKind);

    /// A service has introduced itself on a connection; see
    /// [`Sink::introduced`](fipa_transport::Sink::introduced).
    fn introduced(&self, peer: &Introduction);

    /// A connection has ended; see [`Sink::disconnected`](fipa_transport::Sink::disconnected).
    fn disconnected(&self, peer: &Introduction);
}

/// Maximum time for which a service that closes waits until other services confirm its reports about
/// letters that were in its custody.
const LAST_REPORTS: Duration = Duration::from_millis(200);

/// Maximum number of routes that are computed under one lock.
const ROUTES_AT_ONCE: usize = 64;

/// Observer of the letters that pass while the service is [watched](Mts::watch).
pub trait Tap: Send + Sync {
    /// Reports an event of a letter. Called with the service locked, before the event is processed
    /// further; must not block or call the service back.
    fn notice(&self, notice: &Notice);
}

/// The error if no more letters can arrive for an agent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the agent was deregistered, or the service closed")]
pub struct Gone;

/// A running message transport service.
///
/// Cheap to clone; all clones are the same service. It runs until [`close`](Self::close).
#[derive(Clone)]
pub struct Mts {
    shared: Arc<ServiceHandle>,
}

impl fmt::Debug for Mts {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let kinds = self.shared.transports.iter().map(|one| one.kind());
        f.debug_struct("Mts")
            .field("transports", &kinds.collect::<Vec<_>>())
            .finish_non_exhaustive()
    }
}

/// The service as its users hold it. Dropping the last of them closes the transports.
///
/// Sinks and tasks hold the inner value, but only during a call. One of them may drop it last,
/// within a call by a transport; that transport is closed by then, because `close` waits for such
/// calls.
struct ServiceHandle(Arc<Shared>);

impl std::ops::Deref for ServiceHandle {
    type Target = Shared;

    fn deref(&self) -> &Shared {
        &self.0
    }
}

impl Drop for ServiceHandle {
    fn drop(&mut self) {
        // In a forked child, closing would end the parent's connections.
        if self.owner.is_this() {
            for transport in &self.transports {
                transport.close();
            }
        }
    }
}

struct Shared {
    state: Mutex<State>,
    transports: Vec<Arc<dyn Transport>>,
    directory: Arc<dyn Directory>,
    config: RuntimeConfig,
    /// Reads arriving letters before the state is locked.
    reader: LetterReader,
    /// Wakes the timer when an action is due earlier than its wake-up, or the service is gone.
    timer: Arc<Notify>,
    closed: AtomicBool,
    tasks: Mutex<Vec<JoinHandle<()>>>,
    /// Current locations of each transport, in the order of the transports.
    locations: Mutex<Vec<(Kind, Vec<Location>)>>,
    located: watch::Sender<Arc<[Location]>>,
    owner: OwnerProcess,
}

/// Work that actions of the core leave to be done without the lock.
#[derive(Default)]
struct Unlocked {
    /// Generation of the directory whose view the core has, if the processes of this host may not see all of it.
    ahead: Option<u64>,
    /// Number of the last refresh of the directory that the core has requested.
    refresh: Option<u64>,
}

struct State {
    core: Core,
    clocks: Clocks,
    /// Generation of the directory before the core's view was taken.
    generation: u64,
    /// Replaced views, which are freed after the lock was released.
    replaced: Vec<Arc<dyn View>>,
    unframed_deadline: Duration,
    /// Time at which the timer wakes up.
    armed: Option<Instant>,
    submissions: Map<SubmissionId, Arc<Slot>>,
    agents: Map<Incarnation, Arc<AgentWaiter>>,
}

/// Wakes the tasks that receive for an agent. Written under the lock of the state, and read without
/// it by polling tasks.
#[derive(Default)]
struct AgentWaiter {
    /// Whether the agent's queue has a letter.
    ready: AtomicBool,
    /// Whether no more letters will arrive.
    gone: AtomicBool,
    notify: Notify,
    /// Notifies all waiters when `gone` is set.
    over: Notify,
}

impl AgentWaiter {
    fn close(&self) {
        self.gone.store(true, Ordering::Release);
        self.over.notify_waiters();
        self.notify.notify_waiters();
        // For a task that is about to wait.
        self.notify.notify_one();
    }
}

/// Collects the outcomes of one letter.
struct Slot {
    outcomes: Mutex<Outcomes>,
    complete: Notify,
}

/// Maximum number of expected outcomes for which memory is reserved.
const FEW_OUTCOMES: usize = 64;

/// Number of expected outcomes of a letter whose receivers are not resolved yet.
const UNRESOLVED: usize = usize::MAX;

struct Outcomes {
    expected: usize,
    known: Vec<(Arc<str>, Outcome)>,
}

impl Slot {
    fn taken_if_complete(&self) -> Option<Vec<(Arc<str>, Outcome)>> {
        let mut outcomes = self.outcomes.lock();
        let complete = outcomes.known.len() >= outcomes.expected;
        complete.then(|| std::mem::take(&mut outcomes.known))
    }
}

/// A service that has started, and the transports that failed.
#[derive(Debug)]
pub struct Started {
    /// The service.
    pub mts: Mts,
    /// Its locations at the start, in the order of its transports; for later ones see
    /// [`Mts::locations`].
    pub locations: Vec<Location>,
    /// Transports that could not be opened; the service runs without them.
    pub failed: Vec<(Kind, ListenError)>,
}

impl Mts {
    /// Starts the service: opens the transports and starts the timer. Transports that cannot be
    /// opened are skipped and returned in [`Started::failed`].
    pub fn start(
        core: CoreConfig,
        config: RuntimeConfig,
        directory: Arc<dyn Directory>,
        transports: Vec<Arc<dyn Transport>>,
        handle: &Handle,
    ) -> Started {
        let generation = directory.generation();
        let mut core = Core::new(core, directory.view());
        if let Some(gate) = &config.gate {
            core = core.gated(Arc::clone(gate));
        }
        if let Some(counts) = &config.counts {
            core = core.counting(Arc::clone(counts));
        }
        let reader = core.reader().clone();
        let state = State {
            core,
            clocks: Clocks::new(),
            generation,
            replaced: Vec::new(),
            unframed_deadline: config.unframed_deadline,
            armed: None,
            submissions: Map::default(),
            agents: Map::default(),
        };
        let shared = Arc::new(Shared {
            state: Mutex::new(state),
            transports: transports.clone(),
            directory: Arc::clone(&directory),
            config,
            reader,
            timer: Arc::default(),
            closed: AtomicBool::new(false),
            tasks: Mutex::default(),
            locations: Mutex::new(
                transports
                    .iter()
                    .map(|it| (it.kind(), Vec::new()))
                    .collect(),
            ),
            located: watch::Sender::new(Arc::default()),
            owner: OwnerProcess::this(),
        });
        let mut failed = Vec::new();
        for transport in &transports {
            let sink = Arc::new(TransportSink {
                shared: Arc::downgrade(&shared),
                kind: transport.kind(),
            });
            match transport.listen(sink) {
                Ok(found) => shared.locate(transport.kind(), found, false),
                Err(error) => failed.push((transport.kind(), error)),
            }
        }
        let locations = shared.located.borrow().to_vec();
        let tasks = [
            handle.spawn(keep_time(
                Arc::downgrade(&shared),
                Arc::clone(&shared.timer),
            )),
            handle.spawn(watch_directory(Arc::downgrade(&shared), directory)),
        ];
        shared.tasks.lock().extend(tasks);
        Started {
            mts: Self {
                shared: Arc::new(ServiceHandle(shared)),
            },
            locations,
            failed,
        }
    }

    /// Returns the service's locations, in the order of its transports. The list changes with the
    /// addresses of this host.
    #[must_use]
    pub fn locations(&self) -> watch::Receiver<Arc<[Location]>> {
        self.shared.located.subscribe()
    }

    /// Opens connections to these services, by name and location, so that their greetings announce
    /// this service's locations; see [`Core::announce_locations`].
    pub fn announce_locations(&self, services: Vec<(Arc<str>, Location)>) {
        let mut state = self.shared.lock();
        state.core.announce_locations(services);
        self.shared.carry_out(state);
    }

    /// Starts to accept letters for this agent. It must be in the directory, or be added soon.
    pub fn register(&self, name: Arc<str>, incarnation: Incarnation) {
        let mut state = self.shared.lock();
        let waiter = Arc::new(AgentWaiter::default());
        if self.shared.closed.load(Ordering::Acquire) {
            waiter.close();
        }
        state.agents.insert(incarnation, waiter);
        state.core.register(name, incarnation);
    }

    /// Removes the agent; see [`Core::deregister`]. Returns the letters that are left in its queue.
    pub fn deregister(&self, incarnation: Incarnation) -> Vec<Received> {
        let mut state = self.shared.lock();
        let unread = std::iter::from_fn(|| state.core.take(incarnation)).collect();
        let now = state.clocks.now();
        state.core.deregister(now, incarnation);
        if let Some(waiter) = state.agents.remove(&incarnation) {
            waiter.close();
        }
        self.shared.carry_out(state);
        unread
    }

    /// Sets whether the [`Tap`] is notified of every letter. While it is off, watching costs only
    /// the check of a flag under the lock.
    pub fn watch(&self, watched: bool) {
        self.shared.lock().core.watch(watched);
    }

    /// Sends a letter. The future returns one outcome per receiver; the letter is submitted when
    /// this method returns, even if the future is never awaited.
    ///
    /// Large content for several receivers is first copied to memory that all of them can read, if
    /// a transport offers that ([`Transport::loan_for_many`]).
    pub fn submit(&self, mut submission: Submission) -> Sending {
        if let Some(content) = self.content_for_many(&submission) {
            submission.letter = submission.letter.with_content(content);
        }
        self.begin(|core, now| core.submit(now, submission))
    }

    /// Sends a letter to agents, as [`submit`](Self::submit) does.
    pub fn submit_to_agents(
        &self,
        sender: Incarnation,
        mut letter: Letter,
        receivers: &[AgentId],
        deadline: Duration,
    ) -> Sending {
        // Most letters have one receiver, whose name the view shows.
        if let [receiver] = receivers {
            let mut state = self.shared.lock();
            let now = state.clocks.now();
            let name = receiver.name();
            match state
                .core
                .submit_to_name(now, sender, letter, name, deadline)
            {
                Ok(id) => return self.begun(state, id, Some(1)),
                Err(back) => letter = back,
            }
        }
        self.submit(Submission {
            sender,
            letter,
            receivers: receivers.iter().map(|id| id.name().into()).collect(),
            deadline,
        })
    }

    fn begin(&self, send: impl FnOnce(&mut Core, Now) -> (SubmissionId, Option<usize>)) -> Sending {
        let mut state = self.shared.lock();
        let now = state.clocks.now();
        let (id, expected) = send(&mut state.core, now);
        self.begun(state, id, expected)
    }

    /// Carries out the actions of a letter that was submitted, with this number of outcomes.
    fn begun(
        &self,
        mut state: MutexGuard<'_, State>,
        id: SubmissionId,
        expected: Option<usize>,
    ) -> Sending {
        let expected = expected.unwrap_or(UNRESOLVED);
        let outcomes = Outcomes {
            expected,
            known: Vec::new(),
        };
        let slot = Arc::new(Slot {
            outcomes: Mutex::new(outcomes),
            complete: Notify::new(),
        });
        if expected > 0 {
            state.submissions.insert(id, Arc::clone(&slot));
        }
        self.shared.carry_out(state);
        if expected <= FEW_OUTCOMES {
            // While the receiver has the letter.
            slot.outcomes.lock().known.reserve(expected);
        }
        Sending {
            shared: Arc::clone(&self.shared),
            slot,
        }
    }

    /// Fails a letter for an agent that cannot be reached at any of its addresses; see
    /// [`Core::fail_unreachable`].
    pub fn fail_unreachable(
        &self,
        sender: Incarnation,
        letter: Letter,
        receiver: Arc<str>,
        attempts: Vec<Attempt>,
    ) -> Sending {
        self.begin(|core, now| {
            let letter = (sender, letter);
            (
                core.fail_unreachable(now, letter, receiver, attempts),
                Some(1),
            )
        })
    }

    /// Sends a letter to exactly this incarnation of an agent; see [`Core::submit_to`].
    pub fn submit_to(&self, submission: Submission, entry: &Entry) -> Sending {
        self.begin(|core, now| (core.submit_to(now, submission, entry), Some(1)))
    }

    /// Replaces the orders of transports and the deadline of legacy peers' letters; see
    /// [`Core::reorder`]. No letter is lost. `change_gate` is called while no letter is handled, so that each letter is
    /// handled under the rules of one time. It must not block.
    pub fn reorder(
        &self,
        order: Vec<Kind>,
        routes: Vec<RouteException>,
        unframed_deadline: Duration,
        change_gate: impl FnOnce(),
    ) {
        let mut state = self.shared.lock();
        change_gate();
        state.unframed_deadline = unframed_deadline;
        let now = state.clocks.now();
        state.core.reorder(now, order, routes);
        self.shared.carry_out(state);
    }

    /// Ends the letters for agents of services whose certificate is no longer trusted, and returns these
    /// services; see [`Core::handle_trust`].
    pub fn handle_trust(
        &self,
        is_trusted: impl Fn(&[u8; 32]) -> bool,
    ) -> Vec<(Incarnation, Principal)> {
        let mut state = self.shared.lock();
        let now = state.clocks.now();
        let withdrawn = state.core.handle_trust(now, is_trusted);
        self.shared.carry_out(state);
        withdrawn
    }

    /// Returns the kinds of the open transports.
    pub fn kinds(&self) -> impl Iterator<Item = Kind> {
        self.shared.transports.iter().map(|it| it.kind())
    }

    /// Sets the services to keep in touch with; see [`Core::keep_in_touch`].
    pub fn keep_in_touch(&self, peers: Vec<Peer>) {
        let mut state = self.shared.lock();
        let now = state.clocks.now();
        state.core.keep_in_touch(now, peers);
        self.shared.carry_out(state);
    }

    /// Returns the states of the services to keep in touch with.
    #[must_use]
    pub fn peers(&self) -> Vec<PeerState> {
        let mut state = self.shared.lock();
        let now = state.clocks.now();
        state.core.peers(now)
    }

    /// Returns the routes that letters from here to these agents would take now.
    #[must_use]
    pub fn routes(&self, to: &[Arc<Entry>]) -> Vec<Route> {
        // In several parts, so that letters are not blocked meanwhile.
        let parts = to.chunks(ROUTES_AT_ONCE).flat_map(|part| {
            let mut state = self.shared.lock();
            let now = state.clocks.now();
            let routes = part.iter().map(|entry| state.core.route(now, entry));
            routes.collect::<Vec<_>>()
        });
        parts.collect()
    }

    /// Returns the bytes of the letters that have no outcome yet: at a gateway, those in custody.
    #[must_use]
    pub fn held_bytes(&self) -> usize {
        self.shared.lock().core.held_bytes()
    }

    /// Returns the health and counters of each route; see [`Core::ways`].
    #[must_use]
    pub fn ways(&self) -> Vec<RouteState> {
        let mut state = self.shared.lock();
        let now = state.clocks.now();
        state.core.ways(now)
    }

    /// Waits for the next letter for this agent; `None` when the agent was deregistered or the
    /// service closed.
    pub async fn receive(&self, agent: Incarnation) -> Option<Received> {
        loop {
            self.until_letter(agent).await;
            match self.try_receive(agent) {
                Ok(Some(received)) => return Some(received),
                Ok(None) => {}
                Err(Gone) => return None,
            }
        }
    }

    /// Waits until [`try_receive`](Self::try_receive) has a letter for this agent, or an error. Another task may take
    /// the letter first.
    pub async fn until_letter(&self, agent: Incarnation) {
        let Some(waiter) = self.shared.lock().agents.get(&agent).map(Arc::clone) else {
            return;
        };
        let is_over = || {
            let is_gone = waiter.gone.load(Ordering::Acquire);
            if is_gone {
                // Other tasks may be about to wait too, and each notification wakes one.
                waiter.notify.notify_one();
            }
            (is_gone || waiter.ready.load(Ordering::Acquire)).then_some(())
        };
        self.shared.wait(&waiter.notify, is_over).await;
    }

    /// Whether no more letters can arrive for this agent, because it was deregistered or the service closed.
    #[must_use]
    pub fn is_gone(&self, agent: Incarnation) -> bool {
        let state = self.shared.lock();
        let waiter = state.agents.get(&agent);
        waiter.is_none_or(|waiter| waiter.gone.load(Ordering::Acquire))
    }

    /// Waits until no more letters can arrive for this agent, because it was deregistered or the
    /// service closed.
    pub async fn gone(&self, agent: Incarnation) {
        let Some(waiter) = self.shared.lock().agents.get(&agent).map(Arc::clone) else {
            return;
        };
        // Created before the check, so that a later notification is not missed.
        let over = waiter.over.notified();
        if !waiter.gone.load(Ordering::Acquire) {
            over.await;
        }
    }

    /// Returns the next letter for this agent if there is one.
    ///
    /// # Errors
    /// If there is none, and no more can arrive, because the agent was deregistered or the service closed.
    pub fn try_receive(&self, agent: Incarnation) -> Result<Option<Received>, Gone> {
        let mut state = self.shared.lock();
        let received = state.core.take(agent);
        let more = state.core.waiting(agent) > 0;
        let mut is_gone = true;
        if let Some(waiter) = state.agents.get(&agent) {
            waiter.ready.store(more, Ordering::Release);
            if more {
                // Another task may be waiting for the same agent's letters.
                waiter.notify.notify_one();
            }
            is_gone = waiter.gone.load(Ordering::Acquire);
        }
        match received {
            Some(received) => {
                self.shared.carry_out(state);
                Ok(Some(received))
            }
            None if is_gone => Err(Gone),
            None => Ok(None),
        }
    }

    /// Reports that an agent took a letter whose message cannot be decoded; see
    /// [`Core::handle_undecodable`].
    pub fn handle_undecodable(
        &self,
        receiver: &Arc<str>,
        received: &Received,
        why: &dyn fmt::Display,
    ) {
        let Some(undecodable) = Undecodable::read(received, why) else {
            return;
        };
        // The sender may have been registered just now.
        self.shared.directory.refresh();
        let mut state = self.shared.lock();
        let now = state.clocks.now();
        state.core.handle_undecodable(now, receiver, undecodable);
        self.shared.carry_out(state);
    }

    /// Does pending work on the calling thread; see [`Transport::drive`].
    pub fn drive(&self) -> bool {
        self.shared.drive()
    }

    /// Closes the service: accepts no more letters of others, gives letters in transit up to
    /// `timeout` to finish, then abandons them and closes the transports. Letters in custody return
    /// to the services that handed them over.
    pub async fn close(&self, timeout: Duration) {
        self.shared.lock().core.refuse_custody();
        self.wait_while(timeout, Core::has_open_letters).await;
        self.give_up();
        self.wait_while(LAST_REPORTS, Core::has_open_reports).await;
        self.abort();
    }

    /// Waits while the condition is true, at most for this time.
    async fn wait_while(&self, most: Duration, condition: impl Fn(&Core) -> bool) {
        let until = Instant::now() + most;
        while condition(&self.shared.lock().core) && Instant::now() < until {
            if !self.shared.drive() {
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
        }
    }

    fn give_up(&self) {
        let mut state = self.shared.lock();
        let now = state.clocks.now();
        state.core.give_up(now);
        for waiter in state.agents.values() {
            waiter.close();
        }
        self.shared.carry_out(state);
    }

    /// Closes the service at once and abandons letters in transit.
    pub fn abort(&self) {
        if self.shared.closed.swap(true, Ordering::AcqRel) {
            return;
        }
        for task in self.shared.tasks.lock().drain(..) {
            task.abort();
        }
        self.give_up();
        for transport in &self.shared.transports {
            transport.close();
        }
    }
}

impl Shared {
    /// Sets the locations of a transport. `moved` is whether they come from
    /// [`Sink::relocated`](fipa_transport::Sink::relocated), which may be called before `listen`
    /// returns and then takes precedence.
    fn locate(&self, kind: Kind, found: Vec<Location>, moved: bool) {
        let mut locations = self.locations.lock();
        let place = locations.iter_mut().find(|(other, _)| *other == kind);
        if let Some((_, place)) = place
            && (moved || place.is_empty())
        {
            *place = found;
        }
        let all = locations.iter().flat_map(|(_, of_one)| of_one).cloned();
        let all: Arc<[Location]> = all.collect();
        self.located.send_replace(Arc::clone(&all));
        let own = listened_at(&*all);
        // Under the lock of the locations, so that the last ones are set last.
        self.state.lock().core.listens_at(own);
    }

    fn transport(&self, kind: Kind) -> Option<&Arc<dyn Transport>> {
        self.transports
            .iter()
            .find(|transport| transport.kind() == kind)
    }

    fn drive(&self) -> bool {
        let mut did_something = false;
        for transport in &self.transports {
            did_something |= transport.drive();
        }
        did_something
    }

    /// Locks the state, in which the core has the present view of the directory.
    fn lock(&self) -> MutexGuard<'_, State> {
        let mut state = self.state.lock();
        state.update_view(&*self.directory);
        state
    }

    /// Carries out all actions of the core, then releases the lock.
    fn carry_out(&self, guard: MutexGuard<'_, State>) {
        self.carry_out_then(guard, drop);
    }

    /// Carries out all actions of the core, then releases the lock with this function.
    fn carry_out_then<'a>(
        &'a self,
        guard: MutexGuard<'a, State>,
        release: fn(MutexGuard<'a, State>),
    ) {
        let mut rest = self.perform(guard, release);
        while let Some(number) = rest.refresh {
            let contacts = self.config.contacts.as_ref();
            let published = rest
                .ahead
                .filter(|_| contacts.is_some_and(|it| it.publish()));
            self.directory.refresh();
            let mut state = self.lock();
            let now = state.clocks.now();
            if published == Some(state.generation) {
                state.core.handle_published();
            }
            state.core.handle_refreshed(now, number);
            rest = self.perform(state, release);
        }
    }

    /// Carries out the actions of the core, then releases the lock. Returns what is to be done without the lock.
    fn perform<'a>(
        &self,
        mut guard: MutexGuard<'a, State>,
        release: fn(MutexGuard<'a, State>),
    ) -> Unlocked {
        let state = &mut *guard;
        let mut rest = Unlocked::default();
        while let Some(action) = state.core.poll_action() {
            match action {
                Action::Dispatch {
                    attempt,
                    location,
                    parcel,
                } => {
                    let span = letter_log::is_enabled().then(|| dispatch_span(&parcel, &location));
                    let post = || match self.transport(location.kind()) {
                        Some(transport) => transport.post(attempt, &location, parcel),
                        None => Err(no_such_transport(location.kind())),
                    };
                    let result = match span {
                        Some(span) => span.in_scope(post),
                        None => post(),
                    };
                    if let Err(error) = result {
                        let conclusion = Conclusion::NotSent(error);
                        let now = state.clocks.now();
                        state.core.handle_conclusion(now, attempt, conclusion);
                    }
                }
                Action::Abandon {
                    attempt,
                    location,
                    error,
                } => {
                    let end = match self.transport(location.kind()) {
                        Some(transport) => transport.abandon(attempt, &location),
                        None => Abandoned::Unconfirmed,
                    };
                    let conclusion = end.conclusion(error);
                    let now = state.clocks.now();
                    state.core.handle_conclusion(now, attempt, conclusion);
                }
                Action::Answer {
                    kind,
                    ticket,
                    answer,
                } => {
                    if let Some(transport) = self.transport(kind) {
                        transport.answer(ticket, answer);
                    }
                }
                Action::Outcome {
                    submission,
                    receiver,
                    outcome,
                } => {
                    state.outcome(submission, receiver, outcome);
                }
                Action::Suspect { location, fault } => {
                    if let Some(contacts) = &self.config.contacts {
                        contacts.suspect(&location, fault);
                    }
                }
                Action::ContactSeen {
                    name,
                    agent,
                    location,
                    host,
                } => {
                    if let Some(contacts) = &self.config.contacts {
                        contacts.contact_seen(&name, agent, location, host.as_deref());
                        state.update_view(&*self.directory);
                    }
                }
                Action::ContactSeenAgain { name } => {
                    if let Some(contacts) = &self.config.contacts {
                        contacts.contact_seen_again(&name);
                    }
                }
                Action::Taken { name, location } => {
                    if let Some(contacts) = &self.config.contacts {
                        contacts.took(&name, &location);
                    }
                }
                // One refresh is enough for all that were requested before it.
                Action::Refresh { number } => rest.refresh = Some(number),
                Action::Resolved {
                    submission,
                    outcomes,
                } => state.resolved(submission, outcomes),
                Action::Notice(notice) => {
                    if let Some(tap) = &self.config.tap {
                        tap.notice(&notice);
                    }
                }
                Action::Deliverable { agent } => {
                    if let Some(waiter) = state.agents.get(&agent) {
                        waiter.ready.store(true, Ordering::Release);
                        waiter.notify.notify_one();
                    }
                }
            }
        }
        rest.ahead = state.core.is_ahead().then_some(state.generation);
        let due = state.core.poll_timeout();
        let earlier = due.is_some_and(|due| state.armed.is_none_or(|armed| due < armed));
        let replaced = std::mem::take(&mut state.replaced);
        release(guard);
        // The last owner of a view frees the memory of all its entries.
        drop(replaced);
        if earlier {
            self.timer.notify_one();
        }
        rest
    }

    /// Waits until `look` finds something: drives the transports for a while, then sleeps.
    async fn wait<T>(&self, notify: &Notify, mut look: impl FnMut() -> Option<T>) -> T {
        let mut started = None;
        loop {
            if let Some(found) = look() {
                return found;
            }
            // Without spinning, every event already notifies this task, so polling is redundant.
            if !self.config.spin.is_zero() && self.drive() {
                continue;
            }
            let started = *started.get_or_insert_with(Instant::now);
            if started.elapsed() < self.config.spin {
                std::hint::spin_loop();
                continue;
            }
            notify.notified().await;
        }
    }
}

impl Drop for Shared {
    fn drop(&mut self) {
        if !self.owner.is_this() {
            // In a forked child: closing the transports would end the parent's connections.
            std::mem::forget(std::mem::take(&mut self.transports));
            return;
        }
        self.timer.notify_one();
    }
}

impl State {
    /// Gives the core the present view of the directory, if that has changed.
    fn update_view(&mut self, directory: &dyn Directory) {
        // Read before the view, so that a change in between causes another update.
        let generation = directory.generation();
        if self.generation != generation {
            self.generation = generation;
            self.replaced.push(self.core.set_view(directory.view()));
        }
    }

    fn resolved(&mut self, submission: SubmissionId, outcomes: usize) {
        let Some(slot) = self.submissions.get(&submission) else {
            return;
        };
        let complete = {
            let mut of_slot = slot.outcomes.lock();
            of_slot.expected = outcomes;
            of_slot.known.len() >= outcomes
        };
        if complete {
            slot.complete.notify_one();
            self.submissions.remove(&submission);
        }
    }

    fn outcome(&mut self, submission: SubmissionId, receiver: Arc<str>, outcome: Outcome) {
        let Some(slot) = self.submissions.get(&submission) else {
            return;
        };
        let complete = {
            let mut outcomes = slot.outcomes.lock();
            if outcome.attempts().is_empty() {
                tracing::trace!(%receiver, %outcome, "letter");
            } else {
                log_limit::info!(of: &*receiver, %receiver, %outcome, "letter");
            }
            outcomes.known.push((receiver, outcome));
            outcomes.known.len() >= outcomes.expected
        };
        if complete {
            slot.complete.notify_one();
            self.submissions.remove(&submission);
        }
    }
}

/// Logs that a parcel is passed to a transport. Returns the span for what the transport logs about it.
#[cold]
fn dispatch_span(parcel: &Parcel, location: &Location) -> Span {
    let span = letter_log::span(LetterId::new(parcel.stream, parcel.sequence));
    let receiver = &parcel.receiver;
    span.in_scope(|| match &parcel.body {
        Body::Letter(_) => tracing::debug!(%location, %receiver, "dispatching"),
        Body::Report(report) => tracing::debug!(%location, ?report, "reporting"),
        Body::Credit => {
            tracing::debug!(%location, %receiver, "asking for more letters of the stream")
        }
        Body::Predecessor => {
            tracing::debug!(%location, after = parcel.after, "changing the predecessor")
        }
    });
    span
}

fn no_such_transport(kind: Kind) -> TransportError {
    let text = format!("this process has no transport of kind {kind}");
    TransportError::new(TransportErrorKind::Closed, text)
}

/// A future with the outcomes of one letter.
#[must_use = "await it to get the outcomes of the letter"]
pub struct Sending {
    shared: Arc<ServiceHandle>,
    slot: Arc<Slot>,
}

impl fmt::Debug for Sending {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Sending").finish_non_exhaustive()
    }
}

impl Sending {
    /// Waits for one outcome per receiver, in the order of arrival.
    pub async fn outcomes(self) -> Vec<(Arc<str>, Outcome)> {
        self.shared
            .wait(&self.slot.complete, || self.slot.taken_if_complete())
            .await
    }
}

impl IntoFuture for Sending {
    type Output = Vec<(Arc<str>, Outcome)>;
    type IntoFuture = std::pin::Pin<Box<dyn Future<Output = Self::Output> + Send>>;

    fn into_future(self) -> Self::IntoFuture {
        Box::pin(self.outcomes())
    }
}

/// Calls the core whenever a timeout is due.
async fn keep_time(shared: Weak<Shared>, timer: Arc<Notify>) {
    loop {
        let due = {
            let Some(shared) = shared.upgrade() else {
                return;
            };
            let mut state = shared.lock();
            let now = state.clocks.now();
            state.core.handle_timeout(now);
            state.armed = state.core.poll_timeout();
            let due = state.armed;
            // More may be due at once. A thread that waits for the lock precedes it.
            shared.carry_out_then(state, MutexGuard::unlock_fair);
            due
        };
        match due {
            // After a timeout as well as a notification, the core is polled.
            Some(due) => drop(tokio::time::timeout_at(due.into(), timer.notified()).await),
            None => timer.notified().await,
        }
    }
}

/// Maximum number of changes that are handled under one lock.
const CHANGES_AT_ONCE: usize = 64;

/// Notifies the core of changes in the directory.
async fn watch_directory(shared: Weak<Shared>, directory: Arc<dyn Directory>) {
    let mut watch = directory.watch();
    while let Some(change) = watch.next().await {
        let Some(shared) = shared.upgrade() else {
            return;
        };
        let mut changes = vec![change];
        while changes.len() < CHANGES_AT_ONCE
            && let Some(change) = watch.try_next()
        {
            changes.push(change);
        }
        let mut state = shared.lock();
        let now = state.clocks.now();
        let mut vacated: Vec<Location> = Vec::new();
        for change in changes.iter().flat_map(Change::single) {
            match change {
                Change::Left(entry) => state.core.handle_departure(now, entry),
                Change::Changed { before, after } if before.incarnation != after.incarnation => {
                    state.core.handle_departure(now, before);
                }
                Change::Changed { before, after } if before.locations != after.locations => {
                    vacated.extend(state.core.handle_relocation(before, after));
                }
                _ => {}
            }
        }
        vacated.sort_unstable();
        vacated.dedup();
        // Before the letters are sent again.
        for location in &vacated {
            if let Some(transport) = shared.transport(location.kind()) {
                transport.location_vacated(location);
            }
        }
        state.core.handle_directory_change(now);
        shared.carry_out(state);
    }
}
