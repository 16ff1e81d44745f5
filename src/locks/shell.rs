//! The shell around [`Locks`]: one per agent, started by the first call that needs it.
//!
//! Calls of the application and a task change the core under a lock. Its messages go to an outbox, in
//! order, and are encoded and sent outside of the lock.

use std::any::Any;
use std::collections::{HashMap, HashSet, VecDeque};
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant, SystemTime};

use fipa_acl::{AgentId, ErrorChain, Performative, escape, escape_name};
use fipa_locking::{
    Act, Action, Algorithm, AnyAlgorithm, ClaimId, Content, Event, Failure, Fence, LockDialect,
    LockMessage, LockPeer, Locks, Millis, Resource, codec,
};
use fipa_mts::letter_for;
use fipa_sds::{Change, Entry, Role, Watch};
use fipa_transport::{Incarnation, log_limit};
use parking_lot::Mutex;
use tokio::runtime::Handle;
use tokio::sync::{Notify, watch};

use super::clock::{Timer, millis, now};
use super::greetings::Greetings;
use super::owned::{Holding, OwnerEvent};
use super::state_file::StateFile;
use super::{LockError, LockOptions, report};
use crate::DirectoryView;
use crate::agent::AgentCore;
use crate::agent::demultiplexer::Precedence;
use crate::agent::incoming::Incoming;
use crate::agent::lock_slot::{self, RunningLocks, Slot};
use crate::agent::reader_key::ReaderKey;
use crate::domain::background;
use crate::protocol::{PartnerEvent, PartnerWatch};

/// Maximum number of events that wait for the application of an owner. Beyond it, the earliest is
/// dropped.
const MAX_EVENTS: usize = 256;

/// Maximum number of messages that are handled before the departure of an agent.
const MAX_WAITING: usize = 1024;

/// Pause before the state of an owner is written again.
const STORE_AGAIN: Duration = Duration::from_secs(1);

/// Minimum deadline of the letters of a basic algorithm, which repeats nothing. A receiver that has ended
/// is reported before.
const UNREPEATED: Duration = Duration::from_secs(600);

/// Sets the options of an agent's locks, and starts them.
pub(super) fn set(core: &Arc<AgentCore>, options: LockOptions) -> Result<(), LockError> {
    let (algorithm, legacy_peers) = (options.algorithm, options.legacy_peers);
    let options = options.core();
    options.check()?;
    let mut slot = core.locks.0.lock();
    if slot.running.is_some() {
        return Err(LockError::Started);
    }
    slot.options = Some((algorithm, options));
    slot.legacy_peers = legacy_peers;
    drop(slot);
    start(core).map(drop)
}

/// Returns the running locks of an agent.
pub(super) fn started(core: &AgentCore) -> Option<Arc<Shared>> {
    shared(&core.locks.0.lock())
}

fn shared(slot: &Slot) -> Option<Arc<Shared>> {
    let running: Arc<dyn Any + Send + Sync> = Arc::clone(slot.running.as_ref()?) as _;
    running.downcast().ok()
}

/// Returns the running locks of an agent. The first call starts them.
pub(super) fn start(core: &Arc<AgentCore>) -> Result<Arc<Shared>, LockError> {
    let endpoint = &core.endpoint;
    endpoint.domain.inner.owner.check()?;
    let mut slot = core.locks.0.lock();
    if slot.is_closed {
        return Err(LockError::Closed);
    }
    if let Some(shared) = shared(&slot) {
        return Ok(shared);
    }
    let me = LockPeer::new(&endpoint.name, endpoint.incarnation.as_u64())?;
    let runtime = &endpoint.domain.inner.service.runtime;
    let timer = Timer::new(runtime).map_err(LockError::Timer)?;
    let (algorithm, mut options) = slot.options.unwrap_or_default();
    let legacy_peers = slot.legacy_peers;
    // A later registration of the name begins its conversations with higher numbers.
    let time = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
    options.first_conversation = millis(time.unwrap_or_default());
    let mut locks = Locks::new(me.clone(), algorithm, options);
    // Before the first request, so that it waits for the answers to the greetings.
    let directory = endpoint.domain.directory();
    directory.refresh();
    let listed = directory.entries();
    let greeted = listed
        .iter()
        .filter(|entry| is_greeted(core, legacy_peers, entry));
    for agent in greeted.filter_map(|entry| peer_of(entry)) {
        locks.expect(now(), &agent);
    }
    let shared = Arc::new(Shared {
        state: Mutex::new(State::new(locks)),
        sending: Mutex::new(()),
        changed: Notify::new(),
        algorithm,
    });
    let is_of_locks = Box::new(lock_slot::is_of_locks);
    // Before the first letter is sent, so that no answer is missed.
    let messages = core.demultiplexer.serve_all(is_of_locks, Precedence::Part);
    slot.running = Some(Arc::clone(&shared) as Arc<dyn RunningLocks>);
    drop(slot);
    meet_neighbors(core, &me, &shared);
    let task = Task {
        messages,
        // From here on, no change of the directory is missed.
        changes: Some(endpoint.domain.directory().watch()),
        partners: PartnerWatch::new(Arc::clone(core)),
        watched: HashSet::new(),
        greetings: Greetings::new(Instant::now()),
        greets_legacy_peers: legacy_peers,
        core: Arc::clone(core),
        shared: Arc::clone(&shared),
        timer,
    };
    runtime.spawn(task.run());
    Ok(shared)
}

/// Has the agents of this membership that use locks know each other.
fn meet_neighbors(core: &Arc<AgentCore>, me: &LockPeer, shared: &Shared) {
    let this = Arc::downgrade(core);
    for other in core.endpoint.domain.inner.locking.add(this) {
        let Some(of_other) = started(&other) else {
            continue;
        };
        let them = of_other.read(|locks, _| locks.me().clone());
        of_other.meet(&other, me);
        shared.meet(core, &them);
    }
}

/// Whether an agent of the directory is asked for a sign of life. Those of this membership are not: they know each
/// other when they start their locks.
fn is_greeted(core: &AgentCore, greets_legacy_peers: bool, entry: &Entry) -> bool {
    let is_registered = entry.incarnation.is_known();
    let own = core.endpoint.domain.inner.service.own.incarnation;
    entry.role == Role::Agent
        && !entry.is_platform_agent()
        && (is_registered || greets_legacy_peers)
        && !(is_registered && entry.mts.incarnation == own)
}

/// The locks of an agent, shared by its calls and its task.
pub(super) struct Shared {
    state: Mutex<State>,
    /// Held while the outbox is sent, so that messages leave in order.
    sending: Mutex<()>,
    /// Wakes the task after a change of the next timeout.
    changed: Notify,
    algorithm: Algorithm,
}

struct State {
    core: Locks<AnyAlgorithm>,
    outbox: VecDeque<(LockPeer, LockMessage)>,
    claims: HashMap<ClaimId, watch::Sender<ClaimState>>,
    owned: HashMap<Resource, OwnedState>,
    /// Members that the task does not watch yet.
    joined: Vec<LockPeer>,
    /// Time at which the timer of the task expires. It is not after the next timeout of the core. A timeout
    /// that moves to a later time leaves the timer as it is: most timeouts are those of letters that are
    /// answered at once, and each change would wake the task.
    armed: Option<Millis>,
    is_closed: bool,
}

/// The state of a claim.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum ClaimState {
    Waiting,
    Held,
    Failed {
        resource: Resource,
        failure: Failure,
    },
    Lost {
        resource: Resource,
    },
    /// The agent was deregistered.
    Closed,
}

/// A resource that this agent owns or prepares to own.
struct OwnedState {
    holding: watch::Sender<Holding>,
    events: VecDeque<OwnerEvent>,
    changed: Arc<Notify>,
    /// After the end: whether no grant was live.
    none_was_live: Option<bool>,
    /// Epochs that have to be stored.
    raised: watch::Sender<u64>,
}

impl State {
    fn new(core: Locks<AnyAlgorithm>) -> Self {
        Self {
            core,
            outbox: VecDeque::new(),
            claims: HashMap::new(),
            owned: HashMap::new(),
            joined: Vec::new(),
            armed: None,
            is_closed: false,
        }
    }

    /// Whether the core has a timeout before the timer expires.
    fn is_due_earlier(&self) -> bool {
        let due = self.core.poll_timeout();
        due.is_some_and(|due| self.armed.is_none_or(|armed| due < armed))
    }

    fn perform(&mut self, actions: Vec<Action>) {
        for action in actions {
            match action {
                Action::Send { to, message } => self.outbox.push_back((to, message)),
                Action::Event(event) => self.report(event),
            }
        }
    }

    fn report(&mut self, event: Event) {
        match event {
            Event::Acquired { claim } => {
                if let Some(state) = self.claims.get(&claim) {
                    state.send_replace(ClaimState::Held);
                }
            }
            Event::Failed {
                claim,
                resource,
                failure,
            } => self.ended(claim, ClaimState::Failed { resource, failure }),
            Event::Lost { claim, resource } => {
                log_limit::info!(of: resource.as_str(), resource = %escape(resource.as_str()), "a lock is lost");
                self.ended(claim, ClaimState::Lost { resource });
            }
            Event::Owning { resource } => self.holds(&resource, Holding::Owner),
            Event::OwningRefused { resource, by } => {
                self.holds(&resource, Holding::Refused(by.name().to_owned()));
            }
            Event::NoMemory { resource } => self.holds(&resource, Holding::NoMemory),
            Event::Raised { resource, epoch } => {
                if let Some(owned) = self.owned.get(&resource) {
                    owned.raised.send_replace(epoch);
                }
            }
            Event::Contested { resource, by } => {
                log_limit::warn!(
                    of: resource.as_str(), resource = %escape(resource.as_str()), by = %escape_name(by.name()),
                    "another agent claims a resource that this agent owns; each admits its own fences only"
                );
                let by = by.name().to_owned();
                self.notify(&resource, OwnerEvent::Contested { by });
            }
            Event::OtherAlgorithm {
                resource,
                by,
                algorithm,
            } => log_limit::warn!(
                of: resource.as_str(), resource = %escape(resource.as_str()), by = %escape_name(by.name()), %algorithm,
                own = %self.core.kind(),
                "refused an agent that uses another algorithm than that of this owner; agents of distributed_locking \
                 need the algorithm with which the owner was started, and an owner with `legacy_peers`"
            ),
            Event::Granted { resource, grant } => {
                self.notify(&resource, OwnerEvent::granted(grant));
            }
            Event::Ended {
                resource,
                grant,
                how,
            } => self.notify(&resource, OwnerEvent::ended(grant, how)),
            Event::Silent { resource, holder } => {
                let holder = holder.name().to_owned();
                self.notify(&resource, OwnerEvent::Silent { holder });
            }
            other => tracing::debug!(event = ?other, "lock"),
        }
    }

    fn ended(&mut self, claim: ClaimId, how: ClaimState) {
        if let Some(state) = self.claims.remove(&claim) {
            state.send_replace(how);
        }
    }

    fn holds(&self, resource: &Resource, holding: Holding) {
        if let Some(owned) = self.owned.get(resource) {
            owned.holding.send_replace(holding);
        }
    }

    fn notify(&mut self, resource: &Resource, event: OwnerEvent) {
        if let Some(owned) = self.owned.get_mut(resource) {
            if owned.events.len() >= MAX_EVENTS {
                owned.events.pop_front();
            }
            owned.events.push_back(event);
            owned.changed.notify_waiters();
        }
    }
}

impl Shared {
    /// Changes the core, and sends its messages.
    fn act<T>(
        &self,
        core: &AgentCore,
        change: impl FnOnce(&mut State, Millis, &mut Vec<Action>) -> T,
    ) -> T {
        let mut actions = Vec::new();
        let mut state = self.state.lock();
        let result = change(&mut state, now(), &mut actions);
        state.perform(actions);
        let is_task_needed = state.is_due_earlier() || !state.joined.is_empty();
        drop(state);
        if is_task_needed {
            self.changed.notify_one();
        }
        self.flush(core);
        result
    }

    /// Sends the outbox. If another thread is sending it, that thread sends the rest.
    fn flush(&self, core: &AgentCore) {
        loop {
            let Some(sending) = self.sending.try_lock() else {
                return;
            };
            loop {
                // The lock on the state is released before the message is sent.
                let next = self.state.lock().outbox.pop_front();
                let Some((to, message)) = next else {
                    break;
                };
                self.send(core, &to, &message);
            }
            drop(sending);
            // Another thread may have added a message and failed to take the lock.
            if self.state.lock().outbox.is_empty() {
                return;
            }
        }
    }

    fn send(&self, core: &AgentCore, to: &LockPeer, message: &LockMessage) {
        let endpoint = &core.endpoint;
        let algorithm = message.algorithm.unwrap_or(self.algorithm);
        let sent = AgentId::new(to.name())
            .map_err(|error| error.to_string())
            .and_then(|receiver| {
                let message = codec::encode(message, self.algorithm, &endpoint.id, &receiver);
                let message = message.map_err(|error| error.to_string())?;
                let letter = letter_for(&message, SystemTime::now());
                let mut deadline = endpoint.domain.inner.deadline();
                if !algorithm.is_extended() {
                    deadline = deadline.max(UNREPEATED);
                }
                let sending = endpoint.send(&message, letter, deadline);
                // The outcome is not awaited: the algorithms repeat what has no answer.
                sending
                    .map(drop)
                    .map_err(|error| ErrorChain(&error).to_string())
            });
        if let Err(error) = sent {
            tracing::debug!(%error, to = %escape_name(to.name()), "cannot send a message of a lock");
        }
    }

    /// Makes an agent of this library a member.
    fn meet(&self, core: &AgentCore, peer: &LockPeer) {
        self.act(core, |state, now, actions| {
            state.core.join(now, peer, LockDialect::Own, actions);
            state.note(peer);
        });
    }

    /// Begins a claim, and returns its state.
    pub(super) fn claim(
        &self,
        core: &AgentCore,
        owners: &[(Resource, LockPeer, Option<Algorithm>)],
        begin: impl FnOnce(&mut Locks<AnyAlgorithm>, Millis, &mut Vec<Action>) -> ClaimId,
    ) -> (ClaimId, watch::Receiver<ClaimState>) {
        self.act(core, |state, now, actions| {
            for (resource, owner, algorithm) in owners {
                let (own, core) = (LockDialect::Own, &mut state.core);
                match algorithm {
                    Some(_) => core.owner_named(now, resource, owner, own, *algorithm, actions),
                    // The owner is asked.
                    None => core.join(now, owner, own, actions),
                }
                state.note(owner);
            }
            let claim = begin(&mut state.core, now, actions);
            let (sender, receiver) = watch::channel(match state.is_closed {
                false => ClaimState::Waiting,
                true => ClaimState::Closed,
            });
            if !state.is_closed {
                state.claims.insert(claim, sender);
            }
            (claim, receiver)
        })
    }

    /// Releases or withdraws a claim.
    pub(super) fn release(&self, core: &AgentCore, claim: ClaimId) {
        self.act(core, |state, now, actions| {
            state.claims.remove(&claim);
            state.core.release(now, claim, actions);
        });
    }

    /// Reads the core.
    pub(super) fn read<T>(&self, read: impl FnOnce(&Locks<AnyAlgorithm>, Millis) -> T) -> T {
        read(&self.state.lock().core, now())
    }

    /// Reserves a resource that this agent prepares to own. Returns `None` if it owns it already.
    pub(super) fn reserve(&self, resource: &Resource) -> Option<watch::Receiver<Holding>> {
        let mut state = self.state.lock();
        if state.owned.contains_key(resource) {
            return None;
        }
        let (holding, receiver) = watch::channel(match state.is_closed {
            false => Holding::Preparing,
            true => Holding::Closed,
        });
        let reserved = OwnedState {
            holding,
            events: VecDeque::new(),
            changed: Arc::new(Notify::new()),
            none_was_live: state.is_closed.then_some(false),
            raised: watch::Sender::new(0),
        };
        state.owned.insert(resource.clone(), reserved);
        Some(receiver)
    }

    /// Begins to own a reserved resource.
    pub(super) fn own(
        &self,
        core: &AgentCore,
        resource: &Resource,
        life: &fipa_locking::OwnerState,
        lease: Millis,
    ) {
        self.act(core, |state, now, actions| {
            if !state.is_closed {
                state
                    .core
                    .own_with_lease(now, resource, life, lease, actions);
            }
        });
    }

    /// Starts a task that stores the epochs of a reserved resource, until its ownership ends. An owner
    /// without a file has nothing to store.
    pub(super) fn raise_in(
        self: &Arc<Self>,
        core: &Arc<AgentCore>,
        resource: &Resource,
        file: Option<Weak<Mutex<StateFile>>>,
    ) {
        let Some(mut raised) = self
            .state
            .lock()
            .owned
            .get(resource)
            .map(|owned| owned.raised.subscribe())
        else {
            return;
        };
        let runtime = &core.endpoint.domain.inner.service.runtime;
        let (shared, agent) = (Arc::downgrade(self), Arc::downgrade(core));
        let resource = resource.clone();
        let handle = runtime.clone();
        runtime.spawn(async move {
            while raised.changed().await.is_ok() {
                let epoch = *raised.borrow_and_update();
                if let Some(file) = &file
                    && !store(&handle, file, epoch).await
                {
                    return;
                }
                let (Some(shared), Some(agent)) = (shared.upgrade(), agent.upgrade()) else {
                    return;
                };
                shared.act(&agent, |state, now, actions| {
                    state.core.stored(now, &resource, epoch, actions);
                });
            }
        });
    }

    /// Records a fence that a device of this agent has admitted, or tells it its owner.
    pub(super) fn saw(
        &self,
        core: &AgentCore,
        owner: Option<&LockPeer>,
        fence: &Fence,
        tell: bool,
    ) {
        self.act(core, |state, now, actions| {
            if let (Some(owner), Ok(resource)) = (owner, Resource::new(fence.resource())) {
                state
                    .core
                    .owner_known(now, &resource, owner, LockDialect::Own, actions);
                state.note(owner);
            }
            state.core.saw(now, fence, tell, actions);
        });
    }

    /// Ends the ownership of a resource. Returns whether no grant was live.
    pub(super) fn disown(&self, core: &AgentCore, resource: &Resource) -> bool {
        self.act(core, |state, now, actions| {
            let owned = state.owned.remove(resource);
            match owned.and_then(|owned| owned.none_was_live) {
                Some(none_was_live) => none_was_live,
                None => state.core.disown(now, resource, actions),
            }
        })
    }

    /// Ends the live grant of a resource that this agent owns.
    pub(super) fn force(&self, core: &AgentCore, resource: &Resource) {
        self.act(core, |state, now, actions| {
            state.core.force(now, resource, actions);
        });
    }

    /// Waits for the next event of a resource that this agent owns.
    pub(super) async fn next_event(&self, resource: &Resource) -> Option<OwnerEvent> {
        let changed = {
            let state = self.state.lock();
            Arc::clone(&state.owned.get(resource)?.changed)
        };
        loop {
            // Created before the check, so that no event after the check is missed.
            let notified = changed.notified();
            {
                let mut state = self.state.lock();
                let owned = state.owned.get_mut(resource)?;
                if let Some(event) = owned.events.pop_front() {
                    return Some(event);
                }
                if owned.none_was_live.is_some() {
                    return None;
                }
            }
            notified.await;
        }
    }
}

impl RunningLocks for Shared {
    fn close(&self, core: &AgentCore) {
        self.act(core, |state, now, actions| {
            state.is_closed = true;
            for (claim, sender) in std::mem::take(&mut state.claims) {
                state.core.release(now, claim, actions);
                sender.send_replace(ClaimState::Closed);
            }
            let owned = state.owned.iter_mut();
            for (resource, owned) in owned.filter(|(_, owned)| owned.none_was_live.is_none()) {
                owned.none_was_live = Some(state.core.disown(now, resource, actions));
                owned.holding.send_replace(Holding::Closed);
                owned.changed.notify_waiters();
            }
        });
        self.changed.notify_one();
    }
}

impl State {
    /// Whether a message asks for a resource that this agent prepares to own. The directory may list it already.
    fn is_about_to_own(&self, message: &LockMessage) -> bool {
        let Content::Lock { resource, act } = &message.content else {
            return false;
        };
        let is_reserved = self
            .owned
            .get(resource)
            .is_some_and(|it| *it.holding.borrow() == Holding::Preparing);
        let asks = matches!(act, Act::Ask { .. } | Act::Confirm { asked: Some(_) });
        asks && is_reserved && self.core.owner(resource).is_none()
    }

    /// Has the task watch a member.
    fn note(&mut self, peer: &LockPeer) {
        if self.core.is_member(peer) {
            self.joined.push(peer.clone());
        }
    }
}

/// The task of an agent's locks: messages, timeouts and changes of the directory.
struct Task {
    core: Arc<AgentCore>,
    shared: Arc<Shared>,
    messages: ReaderKey,
    /// The changes of the directory, until the domain is closed.
    changes: Option<Watch>,
    partners: PartnerWatch,
    /// The members that `partners` watches.
    watched: HashSet<LockPeer>,
    greetings: Greetings,
    greets_legacy_peers: bool,
    timer: Timer,
}

impl Task {
    async fn run(mut self) {
        self.probe_all();
        let ended = self.serve().await;
        if let Err(error) = ended {
            log_limit::error!(%error, "the locks of an agent have ended");
        }
        self.core.demultiplexer.end_serving(&self.messages);
        self.shared.close(&self.core);
    }

    async fn serve(&mut self) -> std::io::Result<()> {
        loop {
            let (armed, joined, is_closed) = {
                let mut state = self.shared.state.lock();
                let joined = std::mem::take(&mut state.joined);
                if state.is_due_earlier() {
                    state.armed = state.core.poll_timeout();
                }
                (state.armed, joined, state.is_closed)
            };
            if is_closed {
                return Ok(());
            }
            for peer in joined {
                if !self.watched.contains(&peer) {
                    self.partners.add(peer.name());
                    self.watched.insert(peer);
                }
            }
            self.timer.set(armed)?;
            let greets = self.greetings.poll_timeout();
            let (core, changes) = (&self.core, self.changes.as_mut());
            tokio::select! {
                received = core.demultiplexer.next_served(&core.endpoint, &self.messages) => {
                    match received {
                        Ok(incoming) => self.handle(&incoming),
                        // The agent was deregistered, or the domain is closed.
                        Err(_) => return Ok(()),
                    }
                }
                expired = self.timer.expired() => {
                    expired?;
                    // After a pause of this process, messages wait that arrived before the time.
                    self.handle_waiting();
                    self.shared.act(&self.core, |state, now, actions| {
                        state.armed = None;
                        state.core.handle_timeout(now, actions);
                    });
                }
                event = self.partners.next() => if let PartnerEvent::Gone { agent } = event {
                    self.handle_waiting();
                    self.departed(&agent);
                },
                change = next_change(changes) => match change {
                    Some(change) => self.handle_change(&change),
                    None => self.changes = None,
                },
                () = self.shared.changed.notified() => {}
                () = until(greets) => self.probe_due(),
            }
        }
    }

    fn handle(&mut self, incoming: &Incoming) {
        let message = incoming.message();
        let Some(from) = self.sender(incoming) else {
            tracing::debug!(%message, "ignored a message of a lock: its sender is not proved");
            return;
        };
        if message.protocol() == Some(lock_slot::STATUS_PROTOCOL) {
            report::answer(&self.core, &self.shared, message);
            return;
        }
        if matches!(
            message.performative(),
            Performative::Failure | Performative::NotUnderstood
        ) {
            tracing::debug!(%message, "a message of a lock has failed");
            return;
        }
        let decoded = match codec::read(message) {
            Ok(decoded) => decoded,
            Err(error) => {
                tracing::debug!(
                    %error, from = %escape_name(from.name()), "ignored a message of a lock"
                );
                return;
            }
        };
        self.shared.act(&self.core, |state, now, actions| {
            if state.is_about_to_own(&decoded) {
                // The sender asks again.
                return;
            }
            let was_member = state.core.is_member(&from);
            state.core.handle(now, &from, &decoded, actions);
            if !was_member {
                state.note(&from);
            }
        });
    }

    /// Handles the messages that have arrived, so that those of an agent that has left, such as the
    /// release of its lock, count before its departure.
    fn handle_waiting(&mut self) {
        for _ in 0..MAX_WAITING {
            let core = &self.core;
            let waiting = core
                .demultiplexer
                .now_served(&core.endpoint, &self.messages);
            match waiting {
                Some(incoming) => self.handle(&incoming),
                None => return,
            }
        }
    }

    /// Returns the sender of a message, as far as its connection proves it.
    fn sender(&self, incoming: &Incoming) -> Option<LockPeer> {
        let name = incoming.message().sender()?.name();
        let directory = self.core.endpoint.domain.directory();
        let registration = match incoming.sender {
            proved if proved.is_known() => {
                let peer = LockPeer::new(name, proved.as_u64()).ok()?;
                let Some(entry) = incoming.registered(directory) else {
                    // The entry of a member may have left before its last messages arrive.
                    let is_free = directory.known_incarnation(proved).is_none();
                    return (is_free && self.watched.contains(&peer)).then_some(peer);
                };
                match *entry.name == *name {
                    true => proved,
                    // The gateway of this host hands over the letters of legacy peers as its own.
                    false if entry.is_own_gateway() => legacy(directory, name)?,
                    false => return None,
                }
            }
            // A letter of this process, whose service has checked its sender.
            _ if incoming.via.is_none() => directory.lookup(name)?.incarnation,
            _ => legacy(directory, name)?,
        };
        LockPeer::new(name, registration.as_u64()).ok()
    }

    /// Handles the proof that an agent has left or died.
    fn departed(&mut self, agent: &str) {
        let entry = self.core.endpoint.domain.directory().lookup(agent);
        let present = entry.map(|entry| entry.incarnation.as_u64());
        let gone = |peer: &&LockPeer| peer.name() == agent && Some(peer.registration()) != present;
        let gone: Vec<LockPeer> = self.watched.iter().filter(gone).cloned().collect();
        for peer in gone {
            self.watched.remove(&peer);
            self.shared.act(&self.core, |state, now, actions| {
                state.core.depart(now, &peer, actions);
            });
        }
        // A newer registration of the name is watched from now on.
        let newer = self.watched.iter().any(|peer| peer.name() == agent);
        if newer {
            self.partners.add(agent);
        }
    }

    fn handle_change(&mut self, change: &Change) {
        for change in change.single() {
            match change {
                Change::Joined(entry) => self.probe_new(entry),
                Change::Changed { before, after } => {
                    if before.incarnation != after.incarnation {
                        self.forget(before);
                    }
                    self.probe_new(after);
                }
                Change::Left(entry) => self.forget(entry),
                _ => self.probe_all(),
            }
        }
    }

    /// Greets the agents in the directory that were not greeted, and forgets those that are not in it.
    fn probe_all(&mut self) {
        let entries = self.core.endpoint.domain.directory().entries();
        let present: HashSet<LockPeer> = entries.iter().filter_map(|it| peer_of(it)).collect();
        self.greetings.retain(|agent| present.contains(agent));
        for entry in entries.iter() {
            self.probe_new(entry);
        }
    }

    /// Asks an agent for a sign of life, or has it wait. One that uses locks answers, and becomes a member.
    fn probe_new(&mut self, entry: &Entry) {
        if is_greeted(&self.core, self.greets_legacy_peers, entry)
            && let Some(agent) = peer_of(entry)
            && self
                .greetings
                .announced(Instant::now(), &entry.peer, &agent)
        {
            self.ask(agent);
        }
    }

    fn forget(&mut self, entry: &Entry) {
        if let Some(agent) = peer_of(entry) {
            self.greetings.forget(&agent);
        }
    }

    /// Greets the agents that have waited.
    fn probe_due(&mut self) {
        let now = Instant::now();
        for agent in self.greetings.due(now) {
            self.ask(agent);
        }
        if self.greetings.reads_again(now) {
            self.probe_all();
        }
    }

    /// Asks an agent for a sign of life.
    fn ask(&self, agent: LockPeer) {
        self.shared.act(&self.core, |state, now, actions| {
            state.core.probe(now, agent, actions);
        });
    }
}

/// Stores an epoch, and tries again until it is stored. Returns whether the ownership goes on.
async fn store(runtime: &Handle, file: &Weak<Mutex<StateFile>>, epoch: u64) -> bool {
    loop {
        let Some(file) = file.upgrade() else {
            return false;
        };
        let stored = background::run(runtime, move |_| file.lock().raise(epoch)).await;
        let error = match stored {
            Ok(Ok(())) => return true,
            Ok(Err(error)) => error.to_string(),
            Err(error) => error.to_string(),
        };
        log_limit::error!(%error, "cannot write the state of an owner; it grants nothing meanwhile");
        tokio::time::sleep(STORE_AGAIN).await;
    }
}

/// Returns an agent in its registration, which is unknown for a legacy peer.
fn peer_of(entry: &Entry) -> Option<LockPeer> {
    LockPeer::new(&entry.name, entry.incarnation.as_u64()).ok()
}

/// Waits until this time, without end if there is none.
async fn until(time: Option<Instant>) {
    match time {
        Some(time) => tokio::time::sleep_until(time.into()).await,
        None => std::future::pending().await,
    }
}

/// Returns the registration of an agent of a legacy peer. A letter of a legacy peer cannot come from an agent
/// that has one.
fn legacy(directory: DirectoryView<'_>, name: &str) -> Option<Incarnation> {
    let entry = directory.lookup(name);
    let is_registered = entry.is_some_and(|entry| entry.incarnation.is_known());
    (!is_registered).then_some(Incarnation::UNKNOWN)
}

/// Waits for the next change, without end if there is no watch.
async fn next_change(watch: Option<&mut Watch>) -> Option<Change> {
    match watch {
        Some(watch) => watch.next().await,
        None => std::future::pending().await,
    }
}
