//! The robot's side of conversations about actions.

use std::any::Any;
use std::convert::Infallible;
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_acl::{AgentId, Message, Performative};
use fipa_actions::{
    ActionAnswer, Ask, Failure, Goal, Language, MAX_CONTENT, ONTOLOGY, Refusal, language,
};
use fipa_transport::FailureReason;

use crate::access::gate::RulesGate;
use crate::actions::table::{ActionTable, Asking, Told};
use crate::agent::AgentCore;
use crate::protocol::{DialogueError, Reply, Task, serve_those};

/// Minimum time between two notifications of a subscription to all goals.
const STATUS_INTERVAL: Duration = Duration::from_millis(100);

/// Pause after a notification that was not delivered.
const UNDELIVERED_PAUSE: Duration = Duration::from_secs(1);

/// Time without a delivery after which a subscription ends.
const UNDELIVERED_TIMEOUT: Duration = Duration::from_secs(600);

/// Starts the servers of an agent, unless they run.
pub(super) fn start(core: &Arc<AgentCore>) -> Result<(), DialogueError> {
    let runtime = &core.endpoint.domain.inner.service.runtime;
    core.actions.serve(runtime, || servers(core))
}

fn servers(core: &Arc<AgentCore>) -> Result<Vec<Box<dyn Any + Send>>, DialogueError> {
    let is_about_actions = |message: &Message| message.ontology() == Some(ONTOLOGY);
    let mut servers: Vec<Box<dyn Any + Send>> = Vec::new();
    for (protocol, part) in [
        ("fipa-request", Part::Goals),
        ("fipa-query", Part::Queries),
        ("fipa-subscribe", Part::Subscriptions),
    ] {
        let (table, id) = (core.actions.clone(), core.endpoint.id.clone());
        let gate = core.endpoint.domain.inner.service.gate();
        let handler = move |task: Task| {
            let side = Side::new(table.clone(), id.clone(), &gate, &task);
            async move {
                Ok::<_, Infallible>(match part {
                    Part::Goals => side.perform(task).await,
                    Part::Queries => side.answer(&task),
                    Part::Subscriptions => side.notify(task).await,
                })
            }
        };
        let server = serve_those(core, protocol, is_about_actions, handler)?;
        servers.push(Box::new(server));
    }
    Ok(servers)
}

#[derive(Debug, Clone, Copy)]
enum Part {
    Goals,
    Queries,
    Subscriptions,
}

/// One conversation.
struct Side {
    table: ActionTable,
    robot: AgentId,
    client: String,
    is_operator: bool,
    language: Option<&'static dyn Language>,
    /// The conversation id, which is the id of a goal without one.
    id: String,
}

impl Side {
    fn new(table: ActionTable, robot: AgentId, gate: &RulesGate, task: &Task) -> Self {
        let message = task.message();
        let client = message.sender().map(AgentId::name).unwrap_or_default();
        Self {
            table,
            robot,
            client: client.to_owned(),
            is_operator: gate.is_operator(client),
            language: language(message.language()),
            id: message.conversation_id().unwrap_or_default().to_owned(),
        }
    }

    fn asking(&self) -> Asking<'_> {
        Asking {
            agent: &self.client,
            is_operator: self.is_operator,
        }
    }

    /// Reads the first message of the client.
    fn ask(&self, task: &Task) -> Result<Ask, Refusal> {
        let content = task.message().content().map_or(&[][..], |content| content);
        if content.len() > MAX_CONTENT {
            return Err(Refusal::TooLarge(MAX_CONTENT as u64));
        }
        let language = self.language.unwrap_or(&fipa_actions::Sl);
        let (robot, ask) = language.read_ask(content).map_err(|error| {
            let text = fipa_acl::ErrorChain(&error).to_string();
            Refusal::Malformed(text.chars().take(200).collect())
        })?;
        if robot != self.robot.name() {
            let robot = robot.chars().take(200).collect();
            return Err(Refusal::NotThisAgent(robot));
        }
        Ok(ask)
    }

    fn write(&self, to: &Ask, answer: &ActionAnswer) -> Vec<u8> {
        let language = self.language.unwrap_or(&fipa_actions::Sl);
        let written = language.write_answer(&self.robot, to, answer);
        written.unwrap_or_else(|error| {
            let failure = Failure::Failed(format!("the answer has no notation: {error}"));
            let written = language.write_answer(&self.robot, to, &ActionAnswer::Failed(failure));
            written.unwrap_or_default()
        })
    }

    fn refuse(&self, to: &Ask, reason: Refusal) -> Reply {
        Reply::Refuse(self.write(to, &ActionAnswer::Refused(reason)).into())
    }

    fn refuse_unread(&self, reason: Refusal) -> Reply {
        self.refuse(&Ask::Goal(Goal::of("unread", Vec::new())), reason)
    }

    /// Performs the action of a goal.
    async fn perform(self, mut task: Task) -> Reply {
        if self.language.is_none() {
            return Reply::Refuse(
                "unknown content language; the languages are fipa-sl and json".into(),
            );
        }
        let mut goal = match self.ask(&task) {
            Ok(Ask::Goal(goal)) => goal,
            Ok(ask @ (Ask::Cancel(_) | Ask::CancelAll(_))) => return self.cancel(&ask, task).await,
            Ok(_) => return self.refuse_unread(Refusal::Malformed("a query in a request".into())),
            Err(reason) => return self.refuse_unread(reason),
        };
        let id = goal.id.get_or_insert_with(|| self.id.clone()).clone();
        let reference = Ask::Goal(Goal {
            id: Some(id.clone()),
            ..Goal::of(goal.action.clone(), Vec::new())
        });
        let mut admitted = match self.table.request(&self.client, &id, goal) {
            Ok(admitted) => admitted,
            Err(reason) => return self.refuse(&reference, reason),
        };
        let agreed = |queued| self.write(&reference, &ActionAnswer::Agreed { queued });
        let (mut cancelled, mut late_agree) = (false, None);
        let outcome = loop {
            // Returning drops the conversation, which cancels the goal: its client is gone.
            tokio::select! {
                biased;
                told = admitted.told.recv() => match told {
                    // The answer to the cancel comes first.
                    Some(Told::Agreed { queued }) if cancelled => late_agree = Some(queued),
                    Some(Told::Agreed { queued }) => {
                        if has_ended(task.agree(agreed(queued)).await, &task) {
                            return Reply::Nothing;
                        }
                    }
                    Some(Told::Refused(reason)) if !cancelled => return self.refuse(&reference, reason),
                    Some(Told::Refused(_)) => return task.confirm_cancel().await.unwrap_or(Reply::Nothing),
                    Some(Told::Ended(outcome)) => break outcome,
                    None => break Err(Failure::Withdrawn),
                },
                received = task.cancelled() => match received {
                    Ok(()) => {
                        cancelled = true;
                        admitted.conversation.cancel();
                    }
                    // A mistake of the client does not end its goal.
                    Err(error) if is_mistake(&error) => {}
                    Err(_) => return Reply::Nothing,
                },
            }
        };
        let content = |answer: &ActionAnswer| self.write(&reference, answer).into();
        match outcome {
            Err(_) if cancelled => task.confirm_cancel().await.unwrap_or(Reply::Nothing),
            Err(failure) => Reply::Failure(content(&ActionAnswer::Failed(failure))),
            Ok(value) => {
                let too_late =
                    ActionAnswer::Failed(Failure::Failed("the action is done".to_owned()));
                if cancelled
                    && task
                        .fail_cancel(self.write(&reference, &too_late))
                        .await
                        .is_err()
                {
                    return Reply::Nothing;
                }
                if let Some(queued) = late_agree
                    && has_ended(task.agree(agreed(queued)).await, &task)
                {
                    return Reply::Nothing;
                }
                match self.language.unwrap_or(&fipa_actions::Sl).write_answer(
                    &self.robot,
                    &reference,
                    &ActionAnswer::Done(value),
                ) {
                    Ok(content) => Reply::Inform(content.into()),
                    Err(error) => {
                        let failure = format!("the result has no notation: {error}");
                        Reply::Failure(content(&ActionAnswer::Failed(Failure::Failed(failure))))
                    }
                }
            }
        }
    }

    /// Cancels goals, and waits until they have ended.
    async fn cancel(&self, ask: &Ask, mut task: Task) -> Reply {
        let cancelled = match ask {
            Ask::Cancel(goal) => self.table.cancel(self.asking(), goal),
            Ask::CancelAll(action) => self.table.cancel_all(self.asking(), action),
            _ => return self.refuse_unread(Refusal::Malformed("a cancel".into())),
        };
        let receivers = match cancelled {
            Ok(receivers) => receivers,
            Err(reason) => return self.refuse(ask, reason),
        };
        let agreed = self.write(ask, &ActionAnswer::Agreed { queued: false });
        if has_ended(task.agree(agreed).await, &task) {
            return Reply::Nothing;
        }
        let mut ended = Vec::with_capacity(receivers.len());
        for mut status in receivers {
            // A handler that does not stop is dropped after the grace time, so each goal ends.
            let _ = status.wait_for(|status| status.state.is_over()).await;
            ended.push(status.borrow().clone());
        }
        Reply::Inform(self.write(ask, &ActionAnswer::Status(ended)).into())
    }

    /// Answers a query.
    fn answer(self, task: &Task) -> Reply {
        if *task.message().performative() != Performative::QueryRef || self.language.is_none() {
            return self.refuse_unread(Refusal::Malformed("a query-ref in fipa-sl or json".into()));
        }
        let ask = match self.ask(task) {
            Ok(ask) => ask,
            Err(reason) => return self.refuse_unread(reason),
        };
        let answer = match &ask {
            Ask::Actions => ActionAnswer::Actions(self.table.descriptions()),
            Ask::Status => ActionAnswer::Status(self.table.status()),
            Ask::StatusOf(goal) => match self.table.status_of(self.asking(), goal) {
                Ok(status) => ActionAnswer::Status(vec![status]),
                Err(reason) => return self.refuse(&ask, reason),
            },
            _ => return self.refuse_unread(Refusal::Malformed("a goal in a query".into())),
        };
        Reply::Inform(self.write(&ask, &answer).into())
    }

    /// Serves a subscription to the status of one goal, or of all.
    async fn notify(self, mut task: Task) -> Reply {
        let ask = match self.ask(&task) {
            Ok(ask) if self.language.is_some() => ask,
            Ok(_) => return self.refuse_unread(Refusal::Malformed("the content language".into())),
            Err(reason) => return self.refuse_unread(reason),
        };
        let Some(_subscribed) = self.table.subscribe(&self.client) else {
            return self.refuse(&ask, Refusal::TooManyGoals);
        };
        match &ask {
            Ask::StatusOf(goal) => match self.table.watch(self.asking(), goal) {
                Err(reason) => self.refuse(&ask, reason),
                Ok(mut status) => {
                    if has_ended(task.agree("").await, &task) {
                        return Reply::Nothing;
                    }
                    let mut undelivered = None;
                    loop {
                        let now = status.borrow_and_update().clone();
                        let is_over = now.state.is_over();
                        let content = self.write(&ask, &ActionAnswer::Status(vec![now]));
                        match notified(&mut task, content, &mut undelivered).await {
                            Ok(true) => {}
                            Ok(false) => continue,
                            Err(end) => return end,
                        }
                        if is_over {
                            let end =
                                ActionAnswer::Failed(Failure::Failed("the goal has ended".into()));
                            return Reply::Failure(self.write(&ask, &end).into());
                        }
                        tokio::select! {
                            ended = ended(&mut task) => return ended,
                            changed = status.changed() => if changed.is_err() {
                                return Reply::Failure("the goal is not stored any more".into());
                            },
                        }
                    }
                }
            },
            Ask::Status => {
                if has_ended(task.agree("").await, &task) {
                    return Reply::Nothing;
                }
                let mut changes = self.table.changes();
                let mut undelivered = None;
                loop {
                    changes.mark_unchanged();
                    let content = self.write(&ask, &ActionAnswer::Status(self.table.status()));
                    match notified(&mut task, content, &mut undelivered).await {
                        Ok(true) => {}
                        Ok(false) => continue,
                        Err(end) => return end,
                    }
                    let next = async {
                        tokio::time::sleep(STATUS_INTERVAL).await;
                        changes.changed().await
                    };
                    tokio::select! {
                        ended = ended(&mut task) => return ended,
                        changed = next => if changed.is_err() {
                            return Reply::Failure("the agent has ended".into());
                        },
                    }
                }
            }
            _ => self.refuse_unread(Refusal::Malformed("a subscription to the status".into())),
        }
    }
}

/// Whether the conversation has ended with this message. It goes on with a client that the message has not reached:
/// its host may be silent for a while.
fn has_ended(sent: Result<(), DialogueError>, task: &Task) -> bool {
    match sent {
        Ok(()) => false,
        Err(DialogueError::NotDelivered {
            reason: FailureReason::NoSuchAgent,
            ..
        }) => !task.may_return(),
        Err(DialogueError::NotDelivered { reason, .. }) => !matches!(
            reason,
            FailureReason::Unreachable
                | FailureReason::TimedOut
                | FailureReason::Unconfirmed
                | FailureReason::QueueFull
                | FailureReason::NoRoom
                // By a limit of the rate.
                | FailureReason::Refused
        ),
        Err(_) => true,
    }
}

/// Sends a notification. Returns whether it was delivered; otherwise another one follows, after a pause. `undelivered`
/// is the time of the first one that was not delivered since the last that was.
///
/// # Errors
/// The end of the conversation.
async fn notified(
    task: &mut Task,
    content: Vec<u8>,
    undelivered: &mut Option<Instant>,
) -> Result<bool, Reply> {
    let sent = task.inform(content).await;
    if sent.is_ok() {
        *undelivered = None;
        return Ok(true);
    }
    let since = *undelivered.get_or_insert_with(Instant::now);
    if has_ended(sent, task) || since.elapsed() > UNDELIVERED_TIMEOUT {
        return Err(Reply::Nothing);
    }
    tokio::select! {
        ended = ended(task) => Err(ended),
        () = tokio::time::sleep(UNDELIVERED_PAUSE) => Ok(false),
    }
}

/// Whether an error while a client is awaited is a mistake of the client, which does not end the conversation.
fn is_mistake(error: &DialogueError) -> bool {
    matches!(
        error,
        DialogueError::Unexpected(_)
            | DialogueError::Violation { .. }
            | DialogueError::Unchecked(_)
            | DialogueError::NotUnderstood(_)
            | DialogueError::Undelivered(_)
    )
}

/// Waits until the subscriber cancels or is gone.
async fn ended(task: &mut Task) -> Reply {
    loop {
        match task.cancelled().await {
            Ok(()) => return task.confirm_cancel().await.unwrap_or(Reply::Nothing),
            Err(error) if is_mistake(&error) => {}
            Err(_) => return Reply::Nothing,
        }
    }
}
