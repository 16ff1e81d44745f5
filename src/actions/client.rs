//! The client's side: the actions of a robot, goals and their handles.

use std::fmt;
use std::time::Duration;

use fipa_acl::{AgentId, Message, MessageBuilder, Performative};
use fipa_actions::{
    ActionAnswer, ActionDescription, Ask, Failure, Goal, GoalError, GoalRef, GoalStatus, Json,
    Language, LanguageError, ONTOLOGY, Refusal, Sl, language,
};
use fipa_content::{DeserializeError, Term};
use serde::Serialize;
use serde::de::DeserializeOwned;
use tokio::time::Instant;

use crate::agent::Agent;
use crate::protocol::{DialogueError, Notification, Reachability, Request, Subscription};

/// Time that a robot has beyond the deadline of a goal to stop and to report.
const GRACE: Duration = Duration::from_secs(10);
/// Time after which a robot is asked again, if the request before failed. It doubles up to the time that an answer may
/// take.
const FIRST_PAUSE: Duration = Duration::from_secs(1);
/// Maximum time between two questions for the status of a goal whose result is awaited. The robot stores an ended goal
/// for ten minutes.
const QUESTION: Duration = Duration::from_secs(60);

/// The error of a call about actions.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ActionError {
    /// The robot refused. Holds the reason.
    #[error("refused: {0}")]
    Refused(Refusal),
    /// The action failed. Holds the reason.
    #[error("the action failed: {0}")]
    Failed(Failure),
    /// The conversation failed, for example because the robot is gone ([`DialogueError::Gone`]).
    #[error(transparent)]
    Dialogue(DialogueError),
    /// The arguments cannot be a goal.
    #[error(transparent)]
    Goal(#[from] GoalError),
    /// The result is not a value of the requested type.
    #[error("the result is of another type")]
    Result(#[from] DeserializeError),
    /// The answer is none of the ontology of actions: the agent probably offers no actions.
    #[error("the agent's answer is none of the ontology {ONTOLOGY}; it probably offers no actions")]
    Answer(#[source] LanguageError),
    /// A message cannot be written or read.
    #[error(transparent)]
    Language(#[from] LanguageError),
}

impl From<DialogueError> for ActionError {
    fn from(error: DialogueError) -> Self {
        let (message, is_refusal) = match &error {
            DialogueError::Refused(message) => (message, true),
            DialogueError::Failed(message) => (message, false),
            _ => return Self::Dialogue(error),
        };
        let content = message.content().map_or(&[][..], |content| content);
        let language = language(message.language());
        let read = language.and_then(|it| it.read_rejection(is_refusal, content).ok());
        match read {
            Some(ActionAnswer::Refused(reason)) => Self::Refused(reason),
            Some(ActionAnswer::Failed(reason)) => Self::Failed(reason),
            _ => Self::Dialogue(error),
        }
    }
}

impl Agent {
    /// Returns the robot with this identifier, whose actions this agent uses. See
    /// [`actions`](crate::actions).
    #[must_use]
    pub fn robot(&self, robot: AgentId) -> Robot<'_> {
        Robot {
            agent: self,
            robot,
            language: &Sl,
        }
    }
}

/// A robot whose actions an agent uses; see [`Agent::robot`].
#[derive(Debug, Clone)]
pub struct Robot<'a> {
    agent: &'a Agent,
    robot: AgentId,
    language: &'static dyn Language,
}

impl<'a> Robot<'a> {
    /// Returns the identifier of the robot.
    #[must_use]
    pub fn id(&self) -> &AgentId {
        &self.robot
    }

    /// Writes contents in JSON instead of FIPA-SL.
    #[must_use]
    pub fn in_json(self) -> Self {
        Self {
            language: &Json,
            ..self
        }
    }

    /// Returns the actions that the robot offers, by name.
    ///
    /// # Errors
    /// If the robot is gone, refuses, or does not answer in time.
    pub async fn actions(&self) -> Result<Vec<ActionDescription>, ActionError> {
        match self.query(&Ask::Actions).await? {
            ActionAnswer::Actions(all) => Ok(all),
            _ => Err(ActionError::Answer(LanguageError::Form(
                "a list of actions",
            ))),
        }
    }

    /// Returns the status of the goals that run or wait, of all clients, in the order of their arrival.
    ///
    /// # Errors
    /// See [`actions`](Self::actions).
    pub async fn status(&self) -> Result<Vec<GoalStatus>, ActionError> {
        match self.query(&Ask::Status).await? {
            ActionAnswer::Status(all) => Ok(all),
            _ => Err(ActionError::Answer(LanguageError::Form("a list of goals"))),
        }
    }

    /// Subscribes to the status of the goals that run or wait. The first notification has the present
    /// ones.
    ///
    /// # Errors
    /// See [`actions`](Self::actions).
    pub async fn watch_status(&self) -> Result<StatusUpdates, ActionError> {
        let ask = Ask::Status;
        let message = self.message(Performative::Subscribe, &ask)?;
        let subscription = self.agent.subscribe(message, self.timeout()).await?;
        Ok(StatusUpdates {
            ask,
            language: self.language,
            subscription,
        })
    }

    /// Returns the status of a goal, with its result if it is done and the robot still stores it: a goal of this
    /// agent, or of another client if this agent is an operator of the robot (`access.operators`).
    ///
    /// # Errors
    /// See [`actions`](Self::actions); [`Refusal::NotOperator`] of a goal of another client.
    pub async fn status_of(&self, goal: impl Into<GoalRef>) -> Result<GoalStatus, ActionError> {
        let ask = Ask::StatusOf(goal.into());
        let first = match self.query(&ask).await? {
            ActionAnswer::Status(all) => all.into_iter().next(),
            _ => None,
        };
        first.ok_or(ActionError::Answer(LanguageError::Form("a status")))
    }

    /// Cancels a goal by its id, waits until it has ended, and returns its status: a goal of this agent, or of
    /// another client if this agent is an operator of the robot (`access.operators`). The client of the goal gets
    /// [`Failure::CancelledBy`]. A goal that was done before stays done.
    ///
    /// # Errors
    /// See [`status_of`](Self::status_of).
    pub async fn cancel(&self, goal: impl Into<GoalRef>) -> Result<GoalStatus, ActionError> {
        let first = self.cancel_those(&Ask::Cancel(goal.into())).await?;
        let first = first.into_iter().next();
        first.ok_or(ActionError::Answer(LanguageError::Form("a status")))
    }

    /// Cancels all goals of an action, as [`cancel`](Self::cancel) does with one. Only an operator may do so.
    ///
    /// # Errors
    /// See [`status_of`](Self::status_of).
    pub async fn cancel_all(
        &self,
        action: impl Into<String>,
    ) -> Result<Vec<GoalStatus>, ActionError> {
        self.cancel_those(&Ask::CancelAll(action.into())).await
    }

    async fn cancel_those(&self, ask: &Ask) -> Result<Vec<GoalStatus>, ActionError> {
        let message = self.message(Performative::Request, ask)?;
        let mut request = self.agent.request(message, GRACE + self.timeout()).await?;
        let answer = request.result().await?;
        match read(self.language, ask, &answer)? {
            ActionAnswer::Status(all) => Ok(all),
            _ => Err(ActionError::Answer(LanguageError::Form("a list of goals"))),
        }
    }

    /// Creates a goal with an id of its own. `arguments` is a struct whose fields are the parameters, a
    /// map, or `()`.
    ///
    /// # Errors
    /// If the arguments have no named fields, or no notation.
    pub fn goal(
        &self,
        action: impl Into<String>,
        arguments: &(impl Serialize + ?Sized),
    ) -> Result<Goal, GoalError> {
        let mut goal = Goal::new(action, arguments)?;
        goal.id = Some(self.agent.unique_id());
        Ok(goal)
    }

    /// Sends a goal, and waits until the robot accepts it. `arguments` is a struct whose fields are the
    /// parameters, a map, or `()`.
    ///
    /// # Errors
    /// If the robot refuses ([`ActionError::Refused`]), is gone, or does not answer in time.
    pub async fn invoke(
        &self,
        action: impl Into<String>,
        arguments: &(impl Serialize + ?Sized),
    ) -> Result<GoalHandle<'a>, ActionError> {
        let goal = self.goal(action, arguments)?;
        self.send(goal).await
    }

    /// Sends a goal like [`invoke`](Self::invoke), with its deadline, fence and id. A goal that was sent
    /// before, under the same id, does not run again: the handle gets its outcome. The wait goes on while the robot
    /// reports that it has the goal and has not decided.
    ///
    /// # Errors
    /// See [`invoke`](Self::invoke).
    pub async fn send(&self, goal: Goal) -> Result<GoalHandle<'a>, ActionError> {
        let mut handle = self.propose(goal).await?;
        handle.accepted().await?;
        Ok(handle)
    }

    /// Sends a goal like [`send`](Self::send), and does not wait until the robot accepts it. The goal can be cancelled
    /// meanwhile.
    ///
    /// # Errors
    /// If the goal has no notation, or cannot be sent.
    pub async fn propose(&self, mut goal: Goal) -> Result<GoalHandle<'a>, ActionError> {
        goal.id.get_or_insert_with(|| self.agent.unique_id());
        let ask = Ask::Goal(goal.clone());
        Ok(GoalHandle {
            robot: self.clone(),
            request: self.request(&goal, &ask).await?,
            ask,
            goal,
            asks_again: false,
            pause: FIRST_PAUSE,
            next_question: Instant::now() + self.question_interval(),
            question: None,
            again: None,
            earlier: Vec::new(),
        })
    }

    /// Sends a goal, which is also in `ask`.
    async fn request(&self, goal: &Goal, ask: &Ask) -> Result<Request, ActionError> {
        let message = self.message(Performative::Request, ask)?;
        let deadline = goal.deadline.map(Duration::from_millis);
        let timeout = deadline.and_then(|it| it.checked_add(GRACE + self.timeout()));
        let timeout = timeout.unwrap_or(Duration::MAX);
        Ok(self.agent.request(message, timeout).await?)
    }

    /// Waits until the robot accepts a goal.
    async fn accepted(&self, goal: &Goal, request: &mut Request) -> Result<(), ActionError> {
        let goal = GoalRef::from(goal.id.as_deref().unwrap_or_default());
        let mut is_over = false;
        loop {
            let timeout = match is_over {
                // The deadline of a letter.
                true => self.timeout() / 2,
                false => self.timeout(),
            };
            if let Ok(agreed) = tokio::time::timeout(timeout, request.agreed()).await {
                agreed?;
                return Ok(());
            }
            match self.status_of(goal.clone()).await {
                Ok(status) if !status.state.is_over() => is_over = false,
                // The answer to the goal, a refusal if the robot does not know it, is under way.
                Ok(_) | Err(ActionError::Refused(_)) if !is_over => is_over = true,
                // It may have arrived while the robot was asked.
                _ => match tokio::time::timeout(Duration::ZERO, request.agreed()).await {
                    Ok(agreed) => return Ok(agreed.map(drop)?),
                    Err(_) => return Err(ActionError::Dialogue(DialogueError::TimedOut)),
                },
            }
        }
    }

    /// Asks for the status of a goal when it is time, unless that was done, and waits for the answer. Returns whether the
    /// goal has ended.
    async fn reports_end(
        &self,
        goal: &Goal,
        next: Instant,
        question: &mut Option<Request>,
    ) -> bool {
        let ask = Ask::StatusOf(goal.id.as_deref().unwrap_or_default().into());
        let question = match question {
            Some(question) => question,
            None => {
                tokio::time::sleep_until(next).await;
                // Without a timeout: a late answer is not for the application.
                match self.ask(&ask, Duration::MAX).await {
                    Ok(asked) => question.insert(asked),
                    Err(_) => return false,
                }
            }
        };
        let answer = question.result().await.map_err(ActionError::from);
        let answer = answer.and_then(|it| read(self.language, &ask, &it));
        match answer {
            Ok(ActionAnswer::Status(all)) => all.first().is_some_and(|it| it.state.is_over()),
            _ => false,
        }
    }

    /// Time between two questions for the status of a goal.
    fn question_interval(&self) -> Duration {
        QUESTION.min(self.timeout() * 10)
    }

    /// Sends a goal again, unless that was done, and waits until the robot accepts it.
    async fn ask_again(
        &self,
        goal: &Goal,
        ask: &Ask,
        again: &mut Option<Request>,
    ) -> Result<(), ActionError> {
        let request = match again {
            Some(request) => request,
            None => again.insert(self.request(goal, ask).await?),
        };
        self.accepted(goal, request).await
    }

    fn timeout(&self) -> Duration {
        self.agent.domain().inner.answer_timeout()
    }

    fn message(&self, act: Performative, ask: &Ask) -> Result<MessageBuilder, ActionError> {
        let content = self.language.write_ask(&self.robot, ask)?;
        let message = self.agent.message(act).receiver(self.robot.clone());
        let message = message.ontology(ONTOLOGY).language(self.language.name());
        Ok(message.content(content))
    }

    async fn query(&self, ask: &Ask) -> Result<ActionAnswer, ActionError> {
        let mut question = self.ask(ask, self.timeout()).await?;
        let answer = question.result().await?;
        read(self.language, ask, &answer)
    }

    async fn ask(&self, ask: &Ask, timeout: Duration) -> Result<Request, ActionError> {
        let message = self.message(Performative::QueryRef, ask)?;
        Ok(self.agent.query(message, timeout).await?)
    }
}

fn read(
    language: &'static dyn Language,
    ask: &Ask,
    message: &Message,
) -> Result<ActionAnswer, ActionError> {
    let content = message.content().map_or(&[][..], |content| content);
    let answer = language.read_answer(ask, content);
    answer.map_err(ActionError::Answer)
}

/// A goal that was sent to a robot; see [`Robot::invoke`]. Dropping it does not cancel the goal; the
/// further messages go to [`Agent::receive`].
#[must_use = "result() returns the result"]
pub struct GoalHandle<'a> {
    robot: Robot<'a>,
    goal: Goal,
    ask: Ask,
    request: Request,
    /// Whether the robot is to be asked again: its host was silent, or the goal has ended and no result has arrived.
    asks_again: bool,
    /// Time until the robot is asked again, if the request before failed.
    pause: Duration,
    /// Time of the next question for the status.
    next_question: Instant,
    /// A question for the status that has no answer yet.
    question: Option<Request>,
    /// A request that the robot has not accepted yet.
    again: Option<Request>,
    /// Those before the host of the robot was silent. Their late answers are not for the application.
    earlier: Vec<Request>,
}

impl GoalHandle<'_> {
    /// Returns the goal with its id. After an unconfirmed outcome, [`Robot::send`] sends it again.
    #[must_use]
    pub fn goal(&self) -> &Goal {
        &self.goal
    }

    /// Returns the id of the goal.
    #[must_use]
    pub fn id(&self) -> &str {
        self.goal.id.as_deref().unwrap_or_default()
    }

    /// Returns a receiver of changes of the reachability of the robot.
    #[must_use]
    pub fn reachability(&self) -> Reachability {
        self.request.reachability()
    }

    /// Waits until the robot accepts the goal. Dropping the future loses nothing.
    ///
    /// # Errors
    /// If the robot refuses ([`ActionError::Refused`]), is gone, or neither answers in time nor reports that it has the
    /// goal.
    pub async fn accepted(&mut self) -> Result<(), ActionError> {
        self.robot.accepted(&self.goal, &mut self.request).await
    }

    /// Subscribes to the progress of the goal. The handle can be used meanwhile.
    ///
    /// # Errors
    /// If the robot is gone, refuses, or does not answer in time.
    pub async fn progress(&self) -> Result<ProgressUpdates, ActionError> {
        let ask = Ask::StatusOf(self.id().into());
        let robot = &self.robot;
        let message = robot.message(Performative::Subscribe, &ask)?;
        let subscription = robot.agent.subscribe(message, robot.timeout()).await?;
        Ok(ProgressUpdates {
            ask,
            language: robot.language,
            timeout: robot.timeout(),
            is_over: false,
            subscription: Some(subscription),
        })
    }

    /// Waits for the result. `()` is the result of an action without one.
    ///
    /// # Errors
    /// If the action fails ([`ActionError::Failed`]), the robot is gone, or the deadline of the goal has
    /// passed without a word of the robot.
    pub async fn result<R: DeserializeOwned>(mut self) -> Result<R, ActionError> {
        let value = self.outcome().await?;
        Ok(value.unwrap_or_else(|| Term::Sequence(Vec::new())).read()?)
    }

    /// Waits for the result as a term, `None` for an action without one. Dropping the future loses
    /// nothing. The robot may have failed to deliver the result: it is asked again if its host was silent and returns,
    /// and after some time without a result it is asked whether the goal has ended.
    ///
    /// # Errors
    /// See [`result`](Self::result).
    pub async fn outcome(&mut self) -> Result<Option<Term<'static>>, ActionError> {
        let mut reachability = self.request.reachability();
        let message = loop {
            let is_silent = !reachability.unreachable().is_empty();
            self.asks_again |= is_silent;
            let asks_now = self.asks_again && !is_silent;
            if asks_now {
                let again = tokio::select! {
                    biased;
                    message = self.request.result() => break message,
                    again = self.robot.ask_again(&self.goal, &self.ask, &mut self.again) => again,
                };
                if again.is_err() {
                    self.earlier.extend(self.again.take());
                }
                match again {
                    Ok(()) => {
                        if let Some(mut again) = self.again.take() {
                            again.take_reachability(&mut self.request);
                            let earlier = std::mem::replace(&mut self.request, again);
                            self.earlier.push(earlier);
                        }
                        (self.asks_again, self.pause) = (false, FIRST_PAUSE);
                        continue;
                    }
                    // The robot has the goal, and answers the requests that there are.
                    Err(ActionError::Refused(Refusal::TooManyGoals)) => {
                        (self.asks_again, self.pause) = (false, FIRST_PAUSE);
                    }
                    Err(ActionError::Dialogue(
                        DialogueError::NotDelivered { .. }
                        | DialogueError::TimedOut
                        | DialogueError::Undelivered(_)
                        | DialogueError::Unreachable { .. },
                    )) => {}
                    // The host is silent again.
                    Err(_) if !reachability.unreachable().is_empty() => {}
                    Err(error) => return Err(error),
                }
            }
            tokio::select! {
                biased;
                message = self.request.result() => break message,
                true = reachability.changed() => {}
                () = tokio::time::sleep(self.pause), if asks_now && self.asks_again => {
                    self.pause = self.robot.timeout().min(self.pause * 2);
                }
                is_over = self.robot.reports_end(&self.goal, self.next_question, &mut self.question), if !self.asks_again => {
                    self.question = None;
                    self.next_question = Instant::now() + self.robot.question_interval();
                    self.asks_again = is_over;
                }
            }
        };
        match read(self.robot.language, &self.ask, &message?)? {
            ActionAnswer::Done(value) => Ok(value),
            _ => Err(LanguageError::Form("a result").into()),
        }
    }

    /// Cancels the goal, waits until the robot has stopped, and returns true. Returns false if the goal
    /// has ended in the meantime or goes on; [`outcome`](Self::outcome) then returns its outcome.
    ///
    /// # Errors
    /// If the robot is gone, or does not answer within `timeout`.
    pub async fn cancel(&mut self, timeout: Duration) -> Result<bool, ActionError> {
        Ok(self.request.cancel(timeout).await?)
    }
}

impl Drop for GoalHandle<'_> {
    /// Takes the late answers to the other requests.
    fn drop(&mut self) {
        let earlier = std::mem::take(&mut self.earlier).into_iter();
        let others = self.again.take().into_iter().chain(self.question.take());
        let requests: Vec<Request> = earlier.chain(others).collect();
        let inner = &self.robot.agent.domain().inner;
        // In a forked child, the requests belong to the parent.
        if requests.is_empty() || !inner.owner.is_this() {
            return;
        }
        let timeout = self.robot.timeout();
        let runtime = &inner.service.runtime;
        runtime.spawn(tokio::time::timeout(timeout, async move {
            for mut request in requests {
                let _late = request.result().await;
            }
        }));
    }
}

impl fmt::Debug for GoalHandle<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("GoalHandle")
            .field("goal", &self.goal)
            .finish_non_exhaustive()
    }
}

/// The progress of a goal; see [`GoalHandle::progress`]. Dropping it cancels the subscription, not the goal.
#[derive(Debug)]
#[must_use = "next() returns the progress"]
pub struct ProgressUpdates {
    ask: Ask,
    language: &'static dyn Language,
    timeout: Duration,
    /// Whether the last status was that of the end of the goal.
    is_over: bool,
    /// `None` after the end of the subscription.
    subscription: Option<Subscription>,
}

impl ProgressUpdates {
    /// Waits for the next status of the goal, without a time limit, also while the host of the robot is silent. Returns
    /// the status with the end of the goal, and then `None`. Dropping the future loses no status.
    ///
    /// # Errors
    /// If the robot is gone or ends the subscription.
    pub async fn next(&mut self) -> Result<Option<GoalStatus>, ActionError> {
        let Some(subscription) = &mut self.subscription else {
            return Ok(None);
        };
        if !self.is_over {
            let message = next_of(subscription).await?;
            let ActionAnswer::Status(mut all) = read(self.language, &self.ask, &message)? else {
                return Err(LanguageError::Form("a status").into());
            };
            let status = all.pop();
            self.is_over = status.as_ref().is_none_or(|status| status.state.is_over());
            if status.is_some() {
                return Ok(status);
            }
        }
        // The robot ends the subscription.
        let _ = tokio::time::timeout(self.timeout, subscription.next()).await;
        self.subscription = None;
        Ok(None)
    }
}

/// Waits for the next notification, also while the host of the robot is silent.
async fn next_of(subscription: &mut Subscription) -> Result<Notification, DialogueError> {
    loop {
        match subscription.next().await {
            Err(DialogueError::Unreachable { .. }) => {}
            next => return next,
        }
    }
}

/// The status of all goals of a robot; see [`Robot::watch_status`]. Dropping it cancels the subscription.
#[derive(Debug)]
#[must_use = "next() returns the status"]
pub struct StatusUpdates {
    ask: Ask,
    language: &'static dyn Language,
    subscription: Subscription,
}

impl StatusUpdates {
    /// Waits for the next change, without a time limit, also while the host of the robot is silent, and returns the
    /// goals that run or wait. There are at most ten notifications per second. Dropping the future loses no
    /// notification.
    ///
    /// # Errors
    /// If the robot is gone or ends the subscription.
    pub async fn next(&mut self) -> Result<Vec<GoalStatus>, ActionError> {
        let message = next_of(&mut self.subscription).await?;
        match read(self.language, &self.ask, &message)? {
            ActionAnswer::Status(all) => Ok(all),
            _ => Err(ActionError::Answer(LanguageError::Form("a list of goals"))),
        }
    }

    /// Cancels the subscription.
    ///
    /// # Errors
    /// If the robot does not confirm within `timeout`.
    pub async fn cancel(self, timeout: Duration) -> Result<(), ActionError> {
        Ok(self.subscription.cancel(timeout).await?)
    }
}
