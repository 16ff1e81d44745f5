//! The execution of goals: which goal runs when, and what its clients are told.
//!
//! [`Executor`] has no I/O and no clock. Goals, cancels, progress and ends of handlers go in together
//! with `now`, in milliseconds of a monotonic clock; [`Output`]s come out.

use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::fmt;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::sync::Arc;

use fipa_content::{Parameter, Printer, Term};

use crate::description::{ActionDescription, Policy, short};
use crate::message::{Failure, Goal, GoalRef, GoalState, GoalStatus, Progress, Refusal, length};
use crate::{CANCEL, MAX_NAME, MAX_PROGRESS, RESERVED};

/// Maximum number of conversations about one goal.
const MAX_CONVERSATIONS: usize = 4;

/// Maximum length of the note of a progress and of the text of a failure, in characters.
const MAX_TEXT: usize = 1_024;

/// Bounds and times of an [`Executor`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ActionLimits {
    /// Maximum number of goals that run or wait.
    pub goals: usize,
    /// Maximum number of goals of one client that run or wait, and of its conversations about goals.
    pub goals_of_client: usize,
    /// Maximum number of ended goals that are stored.
    pub ended: usize,
    /// Maximum number of ended goals of one client that are stored.
    pub ended_of_client: usize,
    /// Maximum size of arguments of waiting goals and of stored results of one client, in bytes. All
    /// clients together have eight times as much.
    pub bytes_of_client: usize,
    /// Time for which an ended goal is stored, in milliseconds.
    pub retention: u64,
    /// Minimum time between two reports of progress of a goal, in milliseconds.
    pub progress_interval: u64,
    /// Time for a handler to stop, in milliseconds. Then it is ended.
    pub grace: u64,
}

impl Default for ActionLimits {
    fn default() -> Self {
        Self {
            goals: 1_024,
            goals_of_client: 256,
            ended: 1_024,
            ended_of_client: 128,
            bytes_of_client: 1 << 20,
            retention: 600_000,
            progress_interval: 100,
            grace: 5_000,
        }
    }
}

/// The treatment of a goal whose clients are gone.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum Orphans {
    /// It is cancelled.
    #[default]
    Cancel,
    /// It goes on.
    Continue,
}

/// Decides whether a fence is admitted. Called when a goal arrives, and again when it starts.
pub type Gate = Box<dyn FnMut(&str) -> bool + Send>;

/// The options of an offered action, beside its description.
pub struct OfferOptions {
    /// Maximum number of goals that run at the same time.
    pub concurrency: usize,
    /// The treatment of goals whose clients are gone.
    pub orphans: Orphans,
    /// The check of fences; without it, goals with a fence are refused.
    pub gate: Option<Gate>,
    /// Whether the handler decides about each goal. The client gets no agree before [`Executor::accept`].
    pub decides: bool,
    /// A check of arguments beyond the description, for example whether they are values of a Rust type.
    pub check: Option<Check>,
}

/// Checks the arguments of a goal.
pub type Check = Box<dyn Fn(&[Parameter<'static>]) -> Result<(), Refusal> + Send>;

impl Default for OfferOptions {
    fn default() -> Self {
        Self {
            concurrency: 1,
            orphans: Orphans::default(),
            gate: None,
            decides: false,
            check: None,
        }
    }
}

impl fmt::Debug for OfferOptions {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("OfferOptions")
            .field("concurrency", &self.concurrency)
            .field("orphans", &self.orphans)
            .field("decides", &self.decides)
            .finish_non_exhaustive()
    }
}

/// The error of an action that cannot be offered.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum OfferRefused {
    /// The agent offers an action of this name already.
    #[error("the agent offers an action {0:?} already")]
    Offered(String),
    /// A name is empty, too long, reserved, or there twice.
    #[error(
        "the name {0:?} is empty, longer than {MAX_NAME} bytes, there twice, or one of goal, deadline \
         and fence, or cancel-goals"
    )]
    Name(String),
    /// The default of a parameter is no value of it.
    #[error("the default of the parameter {0:?} has another type or is out of range")]
    Default(String),
}

/// The cause for which a running goal is stopped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Cause {
    /// The client cancelled.
    Cancelled,
    /// An operator cancelled.
    CancelledByOperator,
    /// The client left or died.
    ClientGone,
    /// The deadline of the goal passed.
    DeadlinePassed,
    /// A later goal takes its place.
    Preempted,
    /// The action is not offered any more.
    Withdrawn,
}

impl Cause {
    /// Returns the failure of a goal that `operator` has cancelled if an operator has.
    fn failure(self, operator: Option<&str>) -> Failure {
        match self {
            Self::Cancelled => Failure::Cancelled,
            Self::CancelledByOperator => {
                Failure::CancelledBy(operator.unwrap_or_default().to_owned())
            }
            Self::ClientGone => Failure::ClientGone,
            Self::DeadlinePassed => Failure::DeadlinePassed,
            Self::Preempted => Failure::Preempted,
            Self::Withdrawn => Failure::Withdrawn,
        }
    }
}

/// Returns the refusal of a goal that has failed before the client got an agree.
fn refusal(failure: Failure) -> Refusal {
    match failure {
        Failure::Failed(reason) => Refusal::Rejected(reason),
        Failure::StaleFence(fence, _) => Refusal::StaleFence(fence),
        other => Refusal::Rejected(other.to_string()),
    }
}

/// A step that the caller has to take.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum Output {
    /// Run the handler.
    Start(Running),
    /// Ask the handler to stop.
    Stop {
        /// The goal.
        goal: u64,
        /// The cause.
        cause: Cause,
    },
    /// End the handler, which did not stop in time, and call [`Executor::ended`].
    Abort {
        /// The goal.
        goal: u64,
    },
    /// Tell the client that the goal is accepted.
    Agree {
        /// The conversation.
        conversation: u64,
        /// Whether the goal waits in the queue.
        queued: bool,
    },
    /// Tell the client that the goal is refused. The conversation has no further output.
    Refuse {
        /// The conversation.
        conversation: u64,
        /// The reason.
        reason: Refusal,
    },
    /// Tell the client the end of the goal. An [`Agree`](Self::Agree) precedes it.
    Finish {
        /// The conversation.
        conversation: u64,
        /// The result, or the reason of the failure.
        outcome: Result<Option<Term<'static>>, Failure>,
    },
    /// The status of a goal has changed.
    Changed {
        /// The goal.
        goal: u64,
    },
}

/// A goal that is to run.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct Running {
    /// The number of the goal in this executor.
    pub goal: u64,
    /// The name of the action.
    pub action: String,
    /// The name of the client.
    pub client: Arc<str>,
    /// The id that the client gave the goal.
    pub id: String,
    /// The checked arguments with the defaults.
    pub arguments: Vec<Parameter<'static>>,
    /// The end of the time for the goal, in milliseconds of the clock of the caller.
    pub deadline: Option<u64>,
}

/// The goals of one agent.
#[derive(Debug, Default)]
pub struct Executor {
    limits: ActionLimits,
    offers: BTreeMap<String, Offer>,
    goals: HashMap<u64, Record>,
    ids: HashMap<(Arc<str>, String), u64>,
    conversations: HashMap<u64, u64>,
    clients: HashMap<Arc<str>, Client>,
    timers: BTreeSet<(u64, u64, Timer)>,
    outputs: VecDeque<Output>,
    /// Number of goals that run or wait.
    open: usize,
    /// Number of stored ended goals.
    ended: usize,
    /// Size of waiting arguments and stored results.
    bytes: usize,
    /// Size of waiting arguments.
    waiting: usize,
    last: u64,
}

#[derive(Debug)]
struct Offer {
    description: ActionDescription,
    options: OfferOptions,
    running: Vec<u64>,
    waiting: VecDeque<u64>,
    /// The fence that was admitted last.
    fence: Option<String>,
}

/// The goals of one client.
#[derive(Debug, Default)]
struct Client {
    open: usize,
    /// Number of conversations about its goals.
    conversations: usize,
    bytes: usize,
    waiting: usize,
    ended: VecDeque<u64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Timer {
    Deadline,
    Abort,
    Progress,
    Forget,
}

#[derive(Debug)]
struct Record {
    client: Arc<str>,
    id: String,
    action: String,
    digest: u64,
    conversations: Vec<u64>,
    /// Whether its clients were told that it is accepted.
    agreed: bool,
    state: State,
    arguments: Vec<Parameter<'static>>,
    fence: Option<String>,
    /// Bytes that count for the client.
    size: usize,
    accepted: u64,
    timers: Vec<(Timer, u64)>,
    progress: Option<Progress>,
    reported: Option<u64>,
    /// The operator that has cancelled the goal.
    operator: Option<Arc<str>>,
}

#[derive(Debug, Clone, PartialEq)]
enum State {
    Waiting,
    Running,
    Stopping(Cause),
    Ended(Result<Option<Term<'static>>, Failure>),
    /// Ended with a result that is not stored.
    Forgotten,
}

impl Executor {
    /// Creates an executor without actions.
    #[must_use]
    pub fn new(limits: ActionLimits) -> Self {
        Self {
            limits,
            ..Self::default()
        }
    }

    /// Offers an action.
    ///
    /// # Errors
    /// If its name is taken, a name cannot be used, or the default of a parameter is wrong.
    pub fn offer(
        &mut self,
        description: ActionDescription,
        options: OfferOptions,
    ) -> Result<(), OfferRefused> {
        let name = description.name.clone();
        if name.is_empty() || name.len() > MAX_NAME || name == CANCEL {
            return Err(OfferRefused::Name(name));
        }
        if self.offers.contains_key(&name) {
            return Err(OfferRefused::Offered(name));
        }
        let mut known = BTreeSet::new();
        for parameter in &description.parameters {
            let name = &parameter.name;
            let is_wrong = name.is_empty() || name.len() > MAX_NAME;
            if is_wrong || RESERVED.contains(&&**name) || !known.insert(name) {
                return Err(OfferRefused::Name(name.clone()));
            }
            if !parameter.has_valid_default() {
                return Err(OfferRefused::Default(name.clone()));
            }
        }
        let offer = Offer {
            description,
            options,
            running: Vec::new(),
            waiting: VecDeque::new(),
            fence: None,
        };
        self.offers.insert(name, offer);
        Ok(())
    }

    /// Withdraws an action, and stops its goals.
    pub fn withdraw(&mut self, now: u64, action: &str) {
        let Some(offer) = self.offers.remove(action) else {
            return;
        };
        for goal in offer.waiting {
            self.end(now, goal, Err(Failure::Withdrawn));
        }
        for goal in offer.running {
            self.stop(now, goal, Cause::Withdrawn);
        }
    }

    /// Returns the offered actions, by name.
    pub fn descriptions(&self) -> impl Iterator<Item = &ActionDescription> {
        self.offers.values().map(|offer| &offer.description)
    }

    /// Handles a goal of a client, in a new conversation with a number of the caller's choice. `id` is
    /// that of the goal. [`Output::Agree`] follows at once, or when the handler accepts the goal if it decides.
    /// A goal that the client has sent before does not run again: its outcome also goes to this conversation.
    ///
    /// # Errors
    /// If the goal is refused. The conversation then has no further output.
    pub fn request(
        &mut self,
        now: u64,
        conversation: u64,
        client: &str,
        id: &str,
        goal: Goal,
    ) -> Result<(), Refusal> {
        let Some(offer) = self.offers.get_mut(&goal.action) else {
            return Err(Refusal::UnknownAction(short(&goal.action)));
        };
        if id.is_empty() || id.len() > MAX_NAME {
            return Err(Refusal::Malformed("the goal id".to_owned()));
        }
        if goal
            .fence
            .as_ref()
            .is_some_and(|fence| fence.len() > MAX_NAME)
        {
            return Err(Refusal::Malformed("the fence".to_owned()));
        }
        let arguments = offer.description.admit(goal.arguments)?;
        if let Some(check) = &offer.options.check {
            check(&arguments)?;
        }
        let (digest, size) = digest(&goal.action, &arguments);
        let client: Arc<str> = client.into();
        let key = (Arc::clone(&client), id.to_owned());
        if let Some(&known) = self.ids.get(&key) {
            return self.repeat(known, conversation, digest);
        }
        let admitted = match (&goal.fence, &mut offer.options.gate) {
            (None, None) => Ok(()),
            (None, Some(_)) if !offer.description.fenced => Ok(()),
            (None, Some(_)) => Err(Refusal::MissingFence),
            (Some(_), None) => Err(Refusal::UncheckedFence),
            (Some(fence), Some(gate)) => match gate(fence) {
                true => {
                    offer.fence = Some(fence.clone());
                    Ok(())
                }
                false => Err(Refusal::StaleFence(fence.clone())),
            },
        };
        admitted?;
        let is_free = offer.running.len() < offer.options.concurrency.max(1);
        if !is_free {
            let name = || goal.action.clone();
            match offer.description.policy {
                Policy::Reject => return Err(Refusal::Busy(name())),
                Policy::Queue(longest) if offer.waiting.len() >= longest as usize => {
                    return Err(Refusal::QueueFull(name()));
                }
                Policy::Queue(_) | Policy::Preempt => {}
            }
        }
        let known = self.clients.get(&client);
        let (open, waiting) =
            known.map_or((0, 0), |it| (it.open.max(it.conversations), it.waiting));
        let limits = &self.limits;
        // The arguments of running goals belong to their handlers.
        let stored = if is_free { 0 } else { size };
        if self.open >= limits.goals
            || open >= limits.goals_of_client
            || waiting + stored > limits.bytes_of_client
            || self.waiting + stored > limits.bytes_of_client.saturating_mul(8)
        {
            return Err(Refusal::TooManyGoals);
        }
        self.last += 1;
        let number = self.last;
        let record = Record {
            client: Arc::clone(&client),
            id: key.1.clone(),
            action: goal.action.clone(),
            digest,
            conversations: vec![conversation],
            agreed: false,
            state: State::Waiting,
            arguments,
            fence: goal.fence,
            size: stored,
            accepted: now,
            timers: Vec::new(),
            progress: None,
            reported: None,
            operator: None,
        };
        self.goals.insert(number, record);
        self.ids.insert(key, number);
        self.conversations.insert(conversation, number);
        let counted = self.clients.entry(Arc::clone(&client)).or_default();
        counted.open += 1;
        counted.conversations += 1;
        counted.bytes += stored;
        counted.waiting += stored;
        self.bytes += stored;
        self.waiting += stored;
        self.open += 1;
        self.shrink(&client);
        if let Some(deadline) = goal.deadline {
            self.set_timer(number, Timer::Deadline, Some(now.saturating_add(deadline)));
        }
        let admitted = self.offers.get_mut(&goal.action).map(|offer| {
            offer.waiting.push_back(number);
            (offer.description.policy, offer.options.decides)
        });
        let (policy, decides) = admitted.unzip();
        if !is_free && policy == Some(Policy::Preempt) {
            self.preempt(now, &goal.action, number);
        }
        self.start_waiting(now, &goal.action);
        if decides != Some(true) {
            self.agree(number);
        }
        let record = self.goals.get(&number);
        if record.is_some_and(|it| it.state == State::Waiting) {
            self.outputs.push_back(Output::Changed { goal: number });
        }
        Ok(())
    }

    /// Handles that the handler accepts a goal about which it decides. Without effect on a goal that is accepted, or
    /// has ended.
    pub fn accept(&mut self, goal: u64) {
        let record = self.goals.get(&goal);
        if record.is_some_and(|it| matches!(it.state, State::Running | State::Stopping(_))) {
            self.agree(goal);
        }
    }

    /// Tells the clients of an open goal that it is accepted, unless they know it.
    fn agree(&mut self, goal: u64) {
        let Some(record) = self.goals.get_mut(&goal) else {
            return;
        };
        if std::mem::replace(&mut record.agreed, true) {
            return;
        }
        let queued = record.state == State::Waiting;
        for &conversation in &record.conversations {
            self.outputs.push_back(Output::Agree {
                conversation,
                queued,
            });
        }
    }

    /// Joins a conversation to a goal that is known already.
    fn repeat(&mut self, goal: u64, conversation: u64, digest: u64) -> Result<(), Refusal> {
        let Some(record) = self.goals.get_mut(&goal) else {
            return Err(Refusal::TooManyGoals);
        };
        if record.digest != digest {
            return Err(Refusal::UsedId(record.id.clone()));
        }
        let outcome = match &record.state {
            State::Ended(Err(failure)) if !record.agreed => return Err(refusal(failure.clone())),
            State::Forgotten if !record.agreed => {
                return Err(Refusal::Rejected(
                    "the reason is not stored any more".to_owned(),
                ));
            }
            State::Ended(outcome) => Some(outcome.clone()),
            State::Forgotten => Some(Err(Failure::Forgotten)),
            _ => None,
        };
        if outcome.is_none() {
            let client = self.clients.entry(Arc::clone(&record.client)).or_default();
            if record.conversations.len() >= MAX_CONVERSATIONS
                || client.conversations >= self.limits.goals_of_client
            {
                return Err(Refusal::TooManyGoals);
            }
            client.conversations += 1;
            record.conversations.push(conversation);
            self.conversations.insert(conversation, goal);
        }
        if record.agreed {
            self.outputs.push_back(Output::Agree {
                conversation,
                queued: record.state == State::Waiting,
            });
        }
        if let Some(outcome) = outcome {
            self.outputs.push_back(Output::Finish {
                conversation,
                outcome,
            });
        }
        Ok(())
    }

    /// Handles a cancel of the client.
    pub fn cancel(&mut self, now: u64, conversation: u64) {
        if let Some(&goal) = self.conversations.get(&conversation) {
            self.stop(now, goal, Cause::Cancelled);
        }
    }

    /// Handles a cancel of a goal by its number, from its client or an operator.
    pub fn cancel_by(&mut self, now: u64, agent: &str, goal: u64) {
        let Some(record) = self.goals.get_mut(&goal) else {
            return;
        };
        if *record.client == *agent {
            self.stop(now, goal, Cause::Cancelled);
        } else if matches!(record.state, State::Waiting | State::Running) {
            record.operator = Some(agent.into());
            self.stop(now, goal, Cause::CancelledByOperator);
        }
    }

    /// Handles that a conversation has ended without an outcome, because the client is gone. The goal
    /// goes on if it has another conversation.
    pub fn gone(&mut self, now: u64, conversation: u64) {
        let Some(goal) = self.conversations.remove(&conversation) else {
            return;
        };
        let Some(record) = self.goals.get_mut(&goal) else {
            return;
        };
        record.conversations.retain(|known| *known != conversation);
        if let Some(client) = self.clients.get_mut(&record.client) {
            client.conversations = client.conversations.saturating_sub(1);
        }
        let offer = self.offers.get(&record.action);
        let orphans = offer.map_or(Orphans::Cancel, |offer| offer.options.orphans);
        if record.conversations.is_empty() && orphans == Orphans::Cancel {
            self.stop(now, goal, Cause::ClientGone);
        }
    }

    /// Handles progress that a handler reports. A fraction that is not a number is left out, others are
    /// brought into the range from 0 to 1. A value that is too long is left out.
    pub fn progress(&mut self, now: u64, goal: u64, progress: Progress) {
        let interval = self.limits.progress_interval;
        let Some(record) = self.goals.get_mut(&goal) else {
            return;
        };
        if !matches!(record.state, State::Running | State::Stopping(_)) {
            return;
        }
        let fraction = progress.fraction.filter(|part| !part.is_nan());
        let note = progress
            .note
            .map(|note| note.chars().take(MAX_TEXT).collect());
        record.progress = Some(Progress {
            fraction: fraction.map(|part| part.clamp(0.0, 1.0)),
            note,
            value: progress.value.filter(|it| length(it) <= MAX_PROGRESS),
        });
        let due = record
            .reported
            .map_or(now, |last| last.saturating_add(interval));
        if due <= now {
            record.reported = Some(now);
            self.set_timer(goal, Timer::Progress, None);
            self.outputs.push_back(Output::Changed { goal });
        } else {
            self.set_timer(goal, Timer::Progress, Some(due));
        }
    }

    /// Handles the end of a handler: its result, or the text of its error.
    pub fn ended(&mut self, now: u64, goal: u64, result: Result<Option<Term<'static>>, Failure>) {
        let Some(record) = self.goals.get(&goal) else {
            return;
        };
        let outcome = match (&record.state, result) {
            (State::Stopping(cause), Err(_)) => Err(cause.failure(record.operator.as_deref())),
            (State::Running | State::Stopping(_), result) => result.map_err(bounded),
            _ => return,
        };
        let action = record.action.clone();
        if let Some(offer) = self.offers.get_mut(&action) {
            offer.running.retain(|running| *running != goal);
        }
        self.end(now, goal, outcome);
        self.start_waiting(now, &action);
    }

    /// Returns the next step of the caller.
    pub fn poll_output(&mut self) -> Option<Output> {
        self.outputs.pop_front()
    }

    /// Returns the time of the next [`handle_timeout`](Self::handle_timeout).
    #[must_use]
    pub fn poll_timeout(&self) -> Option<u64> {
        self.timers.first().map(|(due, ..)| *due)
    }

    /// Handles the timers that are due.
    pub fn handle_timeout(&mut self, now: u64) {
        while let Some(&(due, goal, timer)) = self.timers.first() {
            if due > now {
                return;
            }
            self.timers.remove(&(due, goal, timer));
            self.set_timer(goal, timer, None);
            match timer {
                Timer::Deadline => self.stop(now, goal, Cause::DeadlinePassed),
                Timer::Abort => self.outputs.push_back(Output::Abort { goal }),
                Timer::Progress => {
                    if let Some(record) = self.goals.get_mut(&goal) {
                        record.reported = Some(now);
                        self.outputs.push_back(Output::Changed { goal });
                    }
                }
                Timer::Forget => self.forget(goal),
            }
        }
    }

    /// Returns the status of the goals that run or wait, in the order of their arrival. It has no values of
    /// progress, which could be long together.
    #[must_use]
    pub fn status(&self, now: u64) -> Vec<GoalStatus> {
        let open = self.goals.iter().filter(|(_, record)| record.is_open());
        let mut open: Vec<_> = open.collect();
        open.sort_unstable_by_key(|(number, _)| **number);
        let all = open.iter().map(|(_, record)| record.status(now));
        let without_value = all.map(|mut status| {
            if let Some(progress) = &mut status.progress {
                progress.value = None;
            }
            status
        });
        without_value.collect()
    }

    /// Returns the status of a goal.
    #[must_use]
    pub fn status_of(&self, now: u64, goal: u64) -> Option<GoalStatus> {
        self.goals.get(&goal).map(|record| record.status(now))
    }

    /// Returns the number of the goal of a client with this id.
    #[must_use]
    pub fn find(&self, client: &str, id: &str) -> Option<u64> {
        self.ids.get(&(Arc::from(client), id.to_owned())).copied()
    }

    /// Returns the result of a goal, if it is done and its result is stored.
    #[must_use]
    pub fn result_of(&self, goal: u64) -> Option<&Term<'static>> {
        match &self.goals.get(&goal)?.state {
            State::Ended(Ok(result)) => result.as_ref(),
            _ => None,
        }
    }

    /// Returns the number of a goal that an agent asks for or wants to cancel. An agent that is not an operator may
    /// do so with its own goals only.
    ///
    /// # Errors
    /// If the goal is that of another client and the agent is not an operator, or the goal is unknown. Of several
    /// clients with a goal of this id, those with an open goal count first.
    pub fn find_for(&self, agent: &str, is_operator: bool, goal: &GoalRef) -> Result<u64, Refusal> {
        let GoalRef { id, client } = goal;
        let unknown = || Refusal::UnknownGoal(short(id));
        if let Some(client) = client {
            if client != agent && !is_operator {
                return Err(Refusal::NotOperator(short(agent)));
            }
            return self.find(client, id).ok_or_else(unknown);
        }
        if let Some(own) = self.find(agent, id) {
            return Ok(own);
        }
        if !is_operator {
            return Err(Refusal::NotOperator(short(agent)));
        }
        let named = self.goals.iter().filter(|(_, record)| record.id == *id);
        let (open, ended): (Vec<_>, Vec<_>) = named.partition(|(_, record)| record.is_open());
        let found = if open.is_empty() { ended } else { open };
        match found[..] {
            [] => Err(unknown()),
            [(number, _)] => Ok(*number),
            _ => Err(Refusal::AmbiguousGoal(short(id))),
        }
    }

    /// Returns the numbers of the goals of an action that run or wait, in the order of their arrival, which an operator
    /// wants to cancel.
    ///
    /// # Errors
    /// If the agent is not an operator, or the action is unknown.
    pub fn open_of(
        &self,
        agent: &str,
        is_operator: bool,
        action: &str,
    ) -> Result<Vec<u64>, Refusal> {
        if !is_operator {
            return Err(Refusal::NotOperator(short(agent)));
        }
        if !self.offers.contains_key(action) {
            return Err(Refusal::UnknownAction(short(action)));
        }
        let open = self.goals.iter();
        let open = open.filter(|(_, record)| record.is_open() && record.action == action);
        let mut numbers: Vec<u64> = open.map(|(number, _)| *number).collect();
        numbers.sort_unstable();
        Ok(numbers)
    }

    /// Number of goals that run or wait.
    #[must_use]
    pub fn open(&self) -> usize {
        self.open
    }

    /// Number of goals that are stored, with those that have ended.
    #[must_use]
    pub fn stored(&self) -> usize {
        self.goals.len()
    }

    /// Size of the arguments of waiting goals and of stored results, in bytes.
    #[must_use]
    pub fn stored_bytes(&self) -> usize {
        self.bytes
    }

    /// Makes room for a goal that takes the place of another one.
    fn preempt(&mut self, now: u64, action: &str, by: u64) {
        let Some(offer) = self.offers.get_mut(action) else {
            return;
        };
        let waiting: Vec<u64> = offer
            .waiting
            .iter()
            .copied()
            .filter(|it| *it != by)
            .collect();
        offer.waiting.retain(|it| *it == by);
        let running = offer.running.clone();
        for goal in waiting {
            self.end(now, goal, Err(Failure::Preempted));
        }
        let stops = |goal: &u64| {
            let record = self.goals.get(goal);
            record.is_some_and(|record| matches!(record.state, State::Stopping(_)))
        };
        if !running.iter().any(stops)
            && let Some(&earliest) = running.first()
        {
            self.stop(now, earliest, Cause::Preempted);
        }
    }

    /// Starts waiting goals as far as the action has room.
    fn start_waiting(&mut self, now: u64, action: &str) {
        loop {
            let Some(offer) = self.offers.get_mut(action) else {
                return;
            };
            if offer.running.len() >= offer.options.concurrency.max(1) {
                return;
            }
            let Some(goal) = offer.waiting.pop_front() else {
                return;
            };
            let Some(record) = self.goals.get_mut(&goal) else {
                continue;
            };
            let is_new = record.accepted == now;
            if let (Some(fence), Some(gate), false) =
                (&record.fence, &mut offer.options.gate, is_new)
            {
                if !gate(fence) {
                    let last = offer.fence.as_ref().unwrap_or(fence).clone();
                    let failure = Failure::StaleFence(fence.clone(), last);
                    self.end(now, goal, Err(failure));
                    continue;
                }
                offer.fence = Some(fence.clone());
            }
            offer.running.push(goal);
            record.state = State::Running;
            let size = std::mem::take(&mut record.size);
            let deadline = record
                .timers
                .iter()
                .find(|(timer, _)| *timer == Timer::Deadline);
            let running = Running {
                goal,
                action: record.action.clone(),
                client: Arc::clone(&record.client),
                id: record.id.clone(),
                arguments: std::mem::take(&mut record.arguments),
                deadline: deadline.map(|(_, due)| *due),
            };
            if let Some(client) = self.clients.get_mut(&record.client) {
                client.bytes -= size;
                client.waiting -= size;
            }
            self.bytes -= size;
            self.waiting -= size;
            self.outputs.push_back(Output::Start(running));
            self.outputs.push_back(Output::Changed { goal });
        }
    }

    /// Stops a goal: one that waits ends at once, one that runs when its handler has stopped.
    fn stop(&mut self, now: u64, goal: u64, cause: Cause) {
        let Some(record) = self.goals.get_mut(&goal) else {
            return;
        };
        match &record.state {
            State::Waiting => {
                if let Some(offer) = self.offers.get_mut(&record.action) {
                    offer.waiting.retain(|waiting| *waiting != goal);
                }
                let failure = cause.failure(record.operator.as_deref());
                self.end(now, goal, Err(failure));
            }
            State::Running => {
                record.state = State::Stopping(cause);
                self.outputs.push_back(Output::Stop { goal, cause });
                self.outputs.push_back(Output::Changed { goal });
                let grace = now.saturating_add(self.limits.grace);
                self.set_timer(goal, Timer::Deadline, None);
                self.set_timer(goal, Timer::Abort, Some(grace));
            }
            _ => {}
        }
    }

    /// Ends a goal and stores its outcome.
    fn end(&mut self, now: u64, goal: u64, outcome: Result<Option<Term<'static>>, Failure>) {
        for timer in [Timer::Deadline, Timer::Abort, Timer::Progress] {
            self.set_timer(goal, timer, None);
        }
        if outcome.is_ok() {
            self.agree(goal);
        }
        let Some(record) = self.goals.get_mut(&goal) else {
            return;
        };
        let conversations = std::mem::take(&mut record.conversations);
        let count = conversations.len();
        for conversation in conversations {
            self.conversations.remove(&conversation);
            self.outputs.push_back(match (&outcome, record.agreed) {
                (Err(failure), false) => Output::Refuse {
                    conversation,
                    reason: refusal(failure.clone()),
                },
                _ => Output::Finish {
                    conversation,
                    outcome: outcome.clone(),
                },
            });
        }
        self.outputs.push_back(Output::Changed { goal });
        record.arguments = Vec::new();
        if let Some(progress) = &mut record.progress {
            progress.value = None;
        }
        let waited = std::mem::take(&mut record.size);
        let size = match &outcome {
            Ok(Some(value)) => length(value),
            Ok(None) => 0,
            Err(_) => MAX_TEXT,
        };
        let client = self.clients.entry(Arc::clone(&record.client)).or_default();
        client.open = client.open.saturating_sub(1);
        client.conversations = client.conversations.saturating_sub(count);
        client.bytes -= waited;
        client.waiting -= waited;
        self.bytes -= waited;
        self.waiting -= waited;
        self.open = self.open.saturating_sub(1);
        if size > self.limits.bytes_of_client / 4 {
            record.state = State::Forgotten;
        } else {
            record.state = State::Ended(outcome);
            record.size = size;
            client.bytes += size;
            self.bytes += size;
        }
        client.ended.push_back(goal);
        self.ended += 1;
        let name = Arc::clone(&record.client);
        self.set_timer(
            goal,
            Timer::Forget,
            Some(now.saturating_add(self.limits.retention)),
        );
        self.shrink(&name);
    }

    /// Removes the earliest ended goals beyond the bounds: first those of this client, then those of
    /// the client with the most.
    fn shrink(&mut self, client: &Arc<str>) {
        loop {
            let Some(own) = self.clients.get(client) else {
                return;
            };
            let over = own.ended.len() > self.limits.ended_of_client
                || own.bytes > self.limits.bytes_of_client;
            let Some(&first) = own.ended.front().filter(|_| over) else {
                break;
            };
            self.forget(first);
        }
        while self.ended > self.limits.ended
            || self.bytes > self.limits.bytes_of_client.saturating_mul(8)
        {
            let most = self.clients.values().max_by_key(|it| it.ended.len());
            let Some(&first) = most.and_then(|most| most.ended.front()) else {
                return;
            };
            self.forget(first);
        }
    }

    /// Removes an ended goal.
    fn forget(&mut self, goal: u64) {
        self.set_timer(goal, Timer::Forget, None);
        if self.goals.get(&goal).is_none_or(Record::is_open) {
            return;
        }
        let Some(record) = self.goals.remove(&goal) else {
            return;
        };
        self.bytes -= record.size;
        self.ended -= 1;
        if let Some(client) = self.clients.get_mut(&record.client) {
            client.bytes -= record.size;
            client.ended.retain(|ended| *ended != goal);
            if client.open == 0 && client.ended.is_empty() {
                self.clients.remove(&record.client);
            }
        }
        self.ids.remove(&(record.client, record.id));
    }

    fn set_timer(&mut self, goal: u64, timer: Timer, due: Option<u64>) {
        let Some(record) = self.goals.get_mut(&goal) else {
            return;
        };
        if let Some(at) = record.timers.iter().position(|(known, _)| *known == timer) {
            let (_, before) = record.timers.swap_remove(at);
            self.timers.remove(&(before, goal, timer));
        }
        if let Some(due) = due {
            record.timers.push((timer, due));
            self.timers.insert((due, goal, timer));
        }
    }
}

impl Record {
    fn is_open(&self) -> bool {
        !matches!(self.state, State::Ended(_) | State::Forgotten)
    }

    fn status(&self, now: u64) -> GoalStatus {
        let (state, failure) = match &self.state {
            State::Waiting => (GoalState::Queued, None),
            State::Running => (GoalState::Executing, None),
            State::Stopping(_) => (GoalState::Stopping, None),
            State::Ended(Err(failure)) => (GoalState::Failed, Some(failure.clone())),
            State::Ended(Ok(_)) | State::Forgotten => (GoalState::Done, None),
        };
        GoalStatus {
            goal: self.id.clone(),
            action: self.action.clone(),
            client: self.client.to_string(),
            state,
            age: now.saturating_sub(self.accepted),
            progress: self.progress.clone(),
            failure,
            result: None,
        }
    }
}

/// Bounds the text of a failure.
fn bounded(failure: Failure) -> Failure {
    match failure {
        Failure::Failed(text) => Failure::Failed(text.chars().take(MAX_TEXT).collect()),
        other => other,
    }
}

/// Returns a digest of a goal, and the size of its arguments.
fn digest(action: &str, arguments: &[Parameter<'_>]) -> (u64, usize) {
    let mut hasher = DefaultHasher::new();
    action.hash(&mut hasher);
    let mut size = 0;
    for argument in arguments {
        argument.name.hash(&mut hasher);
        // A value that cannot be printed equals no other one in the same goal.
        let text = Printer::new().print(&argument.value).unwrap_or_default();
        text.hash(&mut hasher);
        size += argument.name.len() + text.len();
    }
    (hasher.finish(), size)
}
