//! The actions that an agent offers, and their goals: the shell around [`fipa_actions::Executor`].
//!
//! [`ActionTable`] runs the handlers and the timers. Conversations with clients are in `actions/`.

use std::any::Any;
use std::collections::HashMap;
use std::fmt;
use std::pin::Pin;
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_acl::AgentId;
use fipa_actions::{
    ActionDescription, ActionLimits, Cause, Executor, Failure, Goal, GoalRef, GoalStatus,
    OfferOptions, OfferRefused, Output, Progress, Refusal, Running,
};
use fipa_content::Term;
use parking_lot::Mutex;
use tokio::runtime::Handle;
use tokio::sync::{Notify, mpsc, watch};
use tokio::task::AbortHandle;

/// Maximum number of subscriptions of one client.
const MAX_SUBSCRIPTIONS: usize = 256;

/// The result of a goal.
pub(crate) type Outcome = Result<Option<Term<'static>>, Failure>;

/// The events that a client gets about its goal.
pub(crate) enum Told {
    /// The goal is accepted.
    Agreed {
        /// Whether the goal waits in the queue.
        queued: bool,
    },
    /// The goal is refused. The last event.
    Refused(Refusal),
    /// The goal has ended. The last event.
    Ended(Outcome),
}

/// Runs a goal.
pub(crate) type Handler =
    Arc<dyn Fn(Running, Execution) -> Pin<Box<dyn Future<Output = Outcome> + Send>> + Send + Sync>;

/// The actions of an agent. Clones share them.
#[derive(Clone, Default)]
pub(crate) struct ActionTable(Arc<Shared>);

#[derive(Default)]
struct Shared {
    state: Mutex<State>,
    /// The servers and the timers, from the first offer until the end of the agent. This lock is taken before that of
    /// `state`.
    serving: Mutex<Option<Serving>>,
    /// Notified when a timer is set that is due before the others.
    armed: Notify,
}

struct State {
    began: Instant,
    executor: Executor,
    handlers: HashMap<String, Handler>,
    tasks: HashMap<u64, Task>,
    /// Receivers of the decisions and outcomes, by conversation.
    conversations: HashMap<u64, mpsc::UnboundedSender<Told>>,
    conversation: u64,
    /// The goals whose status clients watch.
    watched: HashMap<u64, watch::Sender<GoalStatus>>,
    /// Number of changes of the status of goals.
    changes: watch::Sender<u64>,
    /// Number of subscriptions, by client.
    subscriptions: HashMap<String, usize>,
}

/// The servers and the timers of an agent that offers actions. They end when it is dropped.
struct Serving {
    _servers: Vec<Box<dyn Any + Send>>,
    timers: AbortHandle,
}

impl Drop for Serving {
    fn drop(&mut self) {
        self.timers.abort();
    }
}

struct Task {
    stop: watch::Sender<Option<Cause>>,
    abort: Option<AbortHandle>,
}

impl Default for State {
    fn default() -> Self {
        Self {
            began: Instant::now(),
            executor: Executor::new(ActionLimits::default()),
            handlers: HashMap::new(),
            tasks: HashMap::new(),
            conversations: HashMap::new(),
            conversation: 0,
            watched: HashMap::new(),
            changes: watch::Sender::new(0),
            subscriptions: HashMap::new(),
        }
    }
}

impl State {
    fn now(&self) -> u64 {
        u64::try_from(self.began.elapsed().as_millis()).unwrap_or(u64::MAX)
    }
}

impl fmt::Debug for ActionTable {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ActionTable").finish_non_exhaustive()
    }
}

/// An agent that asks for goals or cancels them.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Asking<'a> {
    pub(crate) agent: &'a str,
    /// Whether it is an operator of the robot.
    pub(crate) is_operator: bool,
}

/// A goal that a client has sent.
pub(crate) struct Admitted {
    /// Gets at most two events.
    pub(crate) told: mpsc::UnboundedReceiver<Told>,
    pub(crate) conversation: Conversation,
}

/// The conversation about a goal. Dropping it before the outcome means that the client is gone.
pub(crate) struct Conversation {
    table: ActionTable,
    number: u64,
}

impl Conversation {
    /// Handles a cancel of the client.
    pub(crate) fn cancel(&self) {
        let number = self.number;
        self.table
            .change(|executor, now| executor.cancel(now, number));
    }
}

impl Drop for Conversation {
    fn drop(&mut self) {
        let number = self.number;
        self.table
            .change(|executor, now| executor.gone(now, number));
        self.table.0.state.lock().conversations.remove(&number);
    }
}

/// A subscription of a client, which counts until it is dropped.
pub(crate) struct Subscribed {
    table: ActionTable,
    client: String,
}

impl Drop for Subscribed {
    fn drop(&mut self) {
        let mut state = self.table.0.state.lock();
        if let Some(count) = state.subscriptions.get_mut(&self.client) {
            *count -= 1;
            if *count == 0 {
                state.subscriptions.remove(&self.client);
            }
        }
    }
}

impl ActionTable {
    /// Counts a subscription. Returns `None` if the client has too many.
    pub(crate) fn subscribe(&self, client: &str) -> Option<Subscribed> {
        let mut state = self.0.state.lock();
        let count = state.subscriptions.entry(client.to_owned()).or_default();
        if *count >= MAX_SUBSCRIPTIONS {
            return None;
        }
        *count += 1;
        Some(Subscribed {
            table: self.clone(),
            client: client.to_owned(),
        })
    }

    /// Adds an action.
    pub(crate) fn offer(
        &self,
        description: ActionDescription,
        options: OfferOptions,
        handler: Handler,
    ) -> Result<(), OfferRefused> {
        let mut state = self.0.state.lock();
        let name = description.name.clone();
        state.executor.offer(description, options)?;
        state.handlers.insert(name, handler);
        Ok(())
    }

    /// Starts the servers, which `start` returns, and the timers, unless they run.
    pub(crate) fn serve<E>(
        &self,
        runtime: &Handle,
        start: impl FnOnce() -> Result<Vec<Box<dyn Any + Send>>, E>,
    ) -> Result<(), E> {
        let mut serving = self.0.serving.lock();
        if serving.is_none() {
            *serving = Some(Serving {
                _servers: start()?,
                timers: runtime.spawn(run_timers(self.clone())).abort_handle(),
            });
        }
        Ok(())
    }

    /// Ends the servers and the timers, when the agent is gone.
    pub(crate) fn close(&self) {
        for task in self.0.state.lock().tasks.values() {
            task.stop.send_replace(Some(Cause::Withdrawn));
        }
        let serving = self.0.serving.lock().take();
        drop(serving);
    }

    pub(crate) fn withdraw(&self, action: &str) {
        self.0.state.lock().handlers.remove(action);
        self.change(|executor, now| executor.withdraw(now, action));
    }

    pub(crate) fn descriptions(&self) -> Vec<ActionDescription> {
        let state = self.0.state.lock();
        state.executor.descriptions().cloned().collect()
    }

    pub(crate) fn status(&self) -> Vec<GoalStatus> {
        let state = self.0.state.lock();
        state.executor.status(state.now())
    }

    /// Returns the status of a goal with its result.
    pub(crate) fn status_of(&self, by: Asking<'_>, goal: &GoalRef) -> Result<GoalStatus, Refusal> {
        let state = self.0.state.lock();
        let number = state.executor.find_for(by.agent, by.is_operator, goal)?;
        let status = state.executor.status_of(state.now(), number);
        let mut status = status.ok_or_else(|| Refusal::UnknownGoal(goal.id.clone()))?;
        status.result = state.executor.result_of(number).cloned();
        Ok(status)
    }

    /// Returns a receiver of the status of a goal.
    pub(crate) fn watch(
        &self,
        by: Asking<'_>,
        goal: &GoalRef,
    ) -> Result<watch::Receiver<GoalStatus>, Refusal> {
        let mut state = self.0.state.lock();
        let number = state.executor.find_for(by.agent, by.is_operator, goal)?;
        let watched = state.watch(number);
        watched.ok_or_else(|| Refusal::UnknownGoal(goal.id.clone()))
    }

    /// Cancels a goal. Returns a receiver of its status.
    pub(crate) fn cancel(
        &self,
        by: Asking<'_>,
        goal: &GoalRef,
    ) -> Result<Vec<watch::Receiver<GoalStatus>>, Refusal> {
        self.cancel_those(by, |executor| {
            let number = executor.find_for(by.agent, by.is_operator, goal)?;
            Ok(vec![number])
        })
    }

    /// Cancels all goals of an action. Returns receivers of their status.
    pub(crate) fn cancel_all(
        &self,
        by: Asking<'_>,
        action: &str,
    ) -> Result<Vec<watch::Receiver<GoalStatus>>, Refusal> {
        self.cancel_those(by, |executor| {
            executor.open_of(by.agent, by.is_operator, action)
        })
    }

    fn cancel_those(
        &self,
        by: Asking<'_>,
        find: impl FnOnce(&Executor) -> Result<Vec<u64>, Refusal>,
    ) -> Result<Vec<watch::Receiver<GoalStatus>>, Refusal> {
        let (numbers, receivers) = {
            let mut state = self.0.state.lock();
            let numbers = find(&state.executor)?;
            let receivers = numbers.iter().filter_map(|number| state.watch(*number));
            let receivers = receivers.collect();
            (numbers, receivers)
        };
        self.change(|executor, now| {
            for number in numbers {
                executor.cancel_by(now, by.agent, number);
            }
        });
        Ok(receivers)
    }

    /// Returns a receiver of the number of changes of the status of goals.
    pub(crate) fn changes(&self) -> watch::Receiver<u64> {
        self.0.state.lock().changes.subscribe()
    }

    /// Handles a goal.
    pub(crate) fn request(&self, client: &str, id: &str, goal: Goal) -> Result<Admitted, Refusal> {
        let (sender, told) = mpsc::unbounded_channel();
        let number = {
            let mut state = self.0.state.lock();
            state.conversation += 1;
            let number = state.conversation;
            state.conversations.insert(number, sender);
            number
        };
        let requested =
            self.change(|executor, now| executor.request(now, number, client, id, goal));
        match requested {
            Ok(()) => Ok(Admitted {
                told,
                conversation: Conversation {
                    table: self.clone(),
                    number,
                },
            }),
            Err(refusal) => {
                self.0.state.lock().conversations.remove(&number);
                Err(refusal)
            }
        }
    }

    fn ended(&self, goal: u64, outcome: Outcome) {
        self.0.state.lock().tasks.remove(&goal);
        self.change(|executor, now| executor.ended(now, goal, outcome));
    }

    /// Changes the executor and takes the steps that follow.
    fn change<T>(&self, change: impl FnOnce(&mut Executor, u64) -> T) -> T {
        let mut started = Vec::new();
        let mut state = self.0.state.lock();
        let before = state.executor.poll_timeout();
        let now = state.now();
        let changed = change(&mut state.executor, now);
        while let Some(output) = state.executor.poll_output() {
            match output {
                Output::Start(running) => {
                    let (stop, stopped) = watch::channel(None);
                    state.tasks.insert(running.goal, Task { stop, abort: None });
                    let handler = state.handlers.get(&running.action).cloned();
                    started.push((running, handler, stopped));
                }
                Output::Stop { goal, cause } => {
                    if let Some(task) = state.tasks.get(&goal) {
                        task.stop.send_replace(Some(cause));
                    }
                }
                Output::Abort { goal } => {
                    if let Some(abort) = state.tasks.get(&goal).and_then(|it| it.abort.as_ref()) {
                        abort.abort();
                    }
                }
                Output::Agree {
                    conversation,
                    queued,
                } => {
                    if let Some(waiting) = state.conversations.get(&conversation) {
                        // The conversation may have ended.
                        let _ = waiting.send(Told::Agreed { queued });
                    }
                }
                Output::Refuse {
                    conversation,
                    reason,
                } => state.tell_last(conversation, Told::Refused(reason)),
                Output::Finish {
                    conversation,
                    outcome,
                } => state.tell_last(conversation, Told::Ended(outcome)),
                Output::Changed { goal } => {
                    state
                        .changes
                        .send_modify(|count| *count = count.wrapping_add(1));
                    if state.watched.contains_key(&goal) {
                        state.report(goal, now);
                    }
                }
                _ => {}
            }
        }
        let due = state.executor.poll_timeout();
        drop(state);
        if due.is_some_and(|due| before.is_none_or(|before| due < before)) {
            self.0.armed.notify_one();
        }
        for (running, handler, stopped) in started {
            self.start(running, handler, stopped);
        }
        changed
    }

    /// Runs a handler in a task of its own.
    fn start(
        &self,
        running: Running,
        handler: Option<Handler>,
        stopped: watch::Receiver<Option<Cause>>,
    ) {
        let (goal, table) = (running.goal, self.clone());
        let (Some(handler), Ok(runtime)) = (handler, Handle::try_current()) else {
            return self.ended(goal, Err(Failure::Withdrawn));
        };
        let deadline = running.deadline.map(Duration::from_millis);
        let deadline = deadline.and_then(|due| self.0.state.lock().began.checked_add(due));
        let execution = Execution {
            table: table.clone(),
            goal,
            client: AgentId::new(&*running.client).ok(),
            id: running.id.clone(),
            deadline,
            stopped,
        };
        let handled = runtime.spawn(async move { handler(running, execution).await });
        if let Some(task) = self.0.state.lock().tasks.get_mut(&goal) {
            task.abort = Some(handled.abort_handle());
        }
        runtime.spawn(async move {
            let outcome = handled.await.unwrap_or(Err(Failure::Ended));
            table.ended(goal, outcome);
        });
    }
}

impl State {
    /// Tells the client of a conversation the last event.
    fn tell_last(&mut self, conversation: u64, last: Told) {
        if let Some(waiting) = self.conversations.remove(&conversation) {
            // The conversation may have ended.
            let _ = waiting.send(last);
        }
    }

    /// Returns a receiver of the status of the goal with this number.
    fn watch(&mut self, goal: u64) -> Option<watch::Receiver<GoalStatus>> {
        let status = self.executor.status_of(self.now(), goal)?;
        if status.state.is_over() {
            return Some(watch::Sender::new(status).subscribe());
        }
        let watched = self.watched.entry(goal);
        let watched = watched.or_insert_with(|| watch::Sender::new(status));
        Some(watched.subscribe())
    }

    /// Reports the status of a watched goal.
    fn report(&mut self, goal: u64, now: u64) {
        let status = self.executor.status_of(now, goal);
        let is_over = status.as_ref().is_none_or(|status| status.state.is_over());
        if let (Some(watched), Some(status)) = (self.watched.get(&goal), status) {
            watched.send_replace(status);
        }
        let unwatched = self.watched.get(&goal);
        if is_over || unwatched.is_some_and(|watched| watched.is_closed()) {
            self.watched.remove(&goal);
        }
    }
}

/// Runs the timers of an agent's goals.
async fn run_timers(table: ActionTable) {
    loop {
        let due = {
            let state = table.0.state.lock();
            let due = state.executor.poll_timeout().map(Duration::from_millis);
            due.map(|due| state.began.checked_add(due).unwrap_or_else(Instant::now))
        };
        let armed = table.0.armed.notified();
        match due {
            None => armed.await,
            Some(due) => tokio::select! {
                () = armed => {}
                () = tokio::time::sleep_until(due.into()) => {
                    table.change(Executor::handle_timeout);
                }
            },
        }
    }
}

/// A running goal, for its handler.
#[derive(Debug)]
pub struct Execution {
    table: ActionTable,
    goal: u64,
    client: Option<AgentId>,
    id: String,
    deadline: Option<Instant>,
    stopped: watch::Receiver<Option<Cause>>,
}

impl Execution {
    /// Returns the id that the client gave the goal.
    #[must_use]
    pub fn id(&self) -> &str {
        &self.id
    }

    /// Returns the client.
    #[must_use]
    pub fn client(&self) -> Option<&AgentId> {
        self.client.as_ref()
    }

    /// Returns the end of the time for the goal.
    #[must_use]
    pub fn deadline(&self) -> Option<Instant> {
        self.deadline
    }

    /// Accepts the goal, if the handler decides ([`Action::decided_by_handler`](super::Action::decided_by_handler)):
    /// the client gets the `agree`. Without effect on a goal that is accepted already.
    pub fn accept(&self) {
        let goal = self.goal;
        self.table.change(|executor, _| executor.accept(goal));
    }

    /// Ends the goal at once, with its result, `None` for an action without one, or with the reason of its failure. The
    /// value that the handler returns afterwards is ignored.
    pub fn end(&self, result: Result<Option<Term<'static>>, String>) {
        let (goal, outcome) = (self.goal, result.map_err(Failure::Failed));
        self.table
            .change(|executor, now| executor.ended(now, goal, outcome));
    }

    /// Reports progress. Clients get at most ten reports of a goal per second, and always the last one.
    pub fn progress(&self, progress: Progress) {
        let goal = self.goal;
        self.table
            .change(|executor, now| executor.progress(now, goal, progress));
    }

    /// Waits until the handler is to stop, and returns the cause: the client or an operator has cancelled,
    /// the client is gone, the deadline has passed, or another goal takes its place. For use in `tokio::select!` beside the
    /// work. The handler then brings the robot into a safe state and returns an error, or a result if the
    /// action is done nevertheless. After five seconds it is dropped.
    pub async fn stopped(&self) -> Cause {
        let mut stopped = self.stopped.clone();
        loop {
            if let Some(cause) = *stopped.borrow_and_update() {
                return cause;
            }
            // The sender exists as long as the handler runs.
            if stopped.changed().await.is_err() {
                return Cause::Withdrawn;
            }
        }
    }

    /// Returns the cause for which the handler is to stop, if it is to.
    #[must_use]
    pub fn stop_cause(&self) -> Option<Cause> {
        *self.stopped.borrow()
    }
}

#[cfg(test)]
mod tests {
    use std::convert::Infallible;
    use std::sync::Barrier;
    use std::sync::atomic::{AtomicUsize, Ordering};
    use std::thread;

    use super::*;

    #[test]
    fn threads_that_offer_first_at_once_start_the_servers_once() {
        const THREADS: usize = 4;
        let runtime = tokio::runtime::Runtime::new().unwrap();
        let table = ActionTable::default();
        let (starts, barrier) = (AtomicUsize::new(0), Barrier::new(THREADS));
        thread::scope(|scope| {
            for _ in 0..THREADS {
                scope.spawn(|| {
                    barrier.wait();
                    let started = table.serve(runtime.handle(), || {
                        starts.fetch_add(1, Ordering::Relaxed);
                        thread::yield_now();
                        Ok::<_, Infallible>(Vec::new())
                    });
                    started.unwrap();
                });
            }
        });
        assert_eq!(starts.into_inner(), 1);
        table.close();
    }
}
