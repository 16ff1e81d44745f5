//! Goals of actions that a program pursues from outside Rust's futures.

use std::fmt;
use std::sync::Arc;

use fipa::actions::{
    Action, ActionDescription, Cause, Execution, Goal, GoalStatus, Progress, Term, term_from_json,
    term_to_json,
};
use fipa::{Agent, AgentId};
use futures_core::Stream;
use parking_lot::Mutex;
use serde_json::{Map, Value, json};
use tokio::sync::{Notify, oneshot};

use crate::conversation::CANCEL;
use crate::failure::{Failure, FailureKind, OrFail as _};
use crate::script::script;

/// Reads the description of an action: a JSON object with a `name` and, as far as they are needed, `description`,
/// `parameters`, `result`, and `policy`.
///
/// # Errors
/// If the text is not such an object.
pub fn action_of(text: &str) -> Result<Action, Failure> {
    let wrong = |error: serde_json::Error| {
        Failure::invalid(format!("the description of the action: {error}"))
    };
    let mut description: Map<String, Value> = serde_json::from_str(text).map_err(wrong)?;
    let defaults = [
        ("parameters", json!([])),
        ("result", json!("any")),
        ("policy", json!("reject")),
        ("fenced", json!(false)),
    ];
    for (key, default) in defaults {
        description.entry(key).or_insert(default);
    }
    if let Some(Value::Array(parameters)) = description.get_mut("parameters") {
        for parameter in parameters.iter_mut().filter_map(Value::as_object_mut) {
            parameter.entry("optional").or_insert(json!(false));
        }
    }
    let description: ActionDescription =
        serde_json::from_value(Value::Object(description)).map_err(wrong)?;
    Ok(Action::from(description))
}

/// A goal that the program pursues. A goal that is dropped without an end fails.
pub struct Pursuit {
    execution: Arc<Execution>,
    end: Mutex<Option<oneshot::Sender<Result<Term<'static>, String>>>>,
}

impl Pursuit {
    /// Reports the progress: an object with `fraction` from 0 to 1, `note` and `value`, each optional.
    ///
    /// # Errors
    /// If the object has another key, or a value of another type.
    pub fn progress(&self, report: Map<String, Value>) -> Result<(), Failure> {
        let mut progress = Progress::default();
        for (key, value) in report {
            progress = match (key.as_str(), value) {
                ("fraction", Value::Number(part)) => Progress {
                    fraction: part.as_f64(),
                    ..progress
                },
                ("note", Value::String(note)) => progress.note(note),
                ("value", value) => progress
                    .value(&term(value, "the progress")?)
                    .map_err(|error| Failure::invalid(error.to_string()))?,
                _ => {
                    return Err(Failure::invalid(format!(
                        "the progress has a wrong {key:?}"
                    )));
                }
            };
        }
        self.execution.progress(progress);
        Ok(())
    }

    /// Ends the goal with its result, `None` for an action without one, or with the reason of its failure.
    ///
    /// # Errors
    /// If the goal has ended already, or SL has no form for the result.
    pub fn end(&self, result: Result<Option<Value>, String>) -> Result<(), Failure> {
        let result = match result {
            Err(reason) => Err(reason),
            // An empty sequence is no result.
            Ok(None) => Ok(Term::Sequence(Vec::new())),
            Ok(Some(value)) => Ok(term(value, "the result")?),
        };
        let end = self.end.lock().take();
        let over = || Failure::new(FailureKind::Closed, "the goal has ended");
        end.ok_or_else(over)?.send(result).map_err(|_| over())
    }
}

impl fmt::Debug for Pursuit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Pursuit").finish_non_exhaustive()
    }
}

/// An event of an action that the program offers.
#[derive(Debug)]
#[allow(
    clippy::exhaustive_enums,
    reason = "each interface has a form for each event"
)]
pub enum Offered {
    /// A goal with its arguments.
    Goal(Map<String, Value>, Pursuit),
    /// The goal is to stop, for this reason.
    Stop(Failure),
}

/// Hands a goal to the program, and waits until the program ends it. `tell` hands an event to the program, and returns
/// false if the program takes no more. It is for the handler of [`Agent::offer`].
///
/// # Errors
/// The reason of the failure.
pub async fn offered(
    arguments: Map<String, Value>,
    execution: Execution,
    tell: impl Fn(Offered) -> bool + Send,
) -> Result<Term<'static>, String> {
    let execution = Arc::new(execution);
    let (end, mut ended) = oneshot::channel();
    let pursuit = Pursuit {
        execution: Arc::clone(&execution),
        end: Mutex::new(Some(end)),
    };
    if !tell(Offered::Goal(arguments, pursuit)) {
        return Err("the program has ended its offer".to_owned());
    }
    let mut is_stopped = false;
    loop {
        tokio::select! {
            result = &mut ended => {
                return result.unwrap_or_else(|_| Err("the program has dropped the goal".to_owned()));
            }
            cause = execution.stopped(), if !is_stopped => {
                is_stopped = true;
                // The program may have ended its offer; it still can end the goal.
                let _ = tell(Offered::Stop(stop(cause)));
            }
        }
    }
}

fn stop(cause: Cause) -> Failure {
    let (kind, text) = match cause {
        Cause::DeadlinePassed => (FailureKind::TimedOut, "the time for the goal is over"),
        Cause::ClientGone => (FailureKind::Gone, "the client of the goal is gone"),
        Cause::Preempted => (
            FailureKind::Cancelled,
            "another goal takes the place of the goal",
        ),
        Cause::Withdrawn => (FailureKind::Cancelled, "the action is not offered any more"),
        _ => (FailureKind::Cancelled, "the goal was cancelled"),
    };
    Failure::new(kind, text)
}

/// An event of a goal that another robot pursues.
#[derive(Debug)]
#[allow(
    clippy::exhaustive_enums,
    reason = "each interface has a form for each event"
)]
pub enum GoalEvent {
    /// The robot has accepted the goal.
    Accepted,
    /// The progress: an object with `state`, `fraction`, `note` and `value`.
    Progress(Value),
    /// The result, null for an action without one. The last event.
    Result(Value),
}

/// Sends a goal to a robot. `cancel` cancels it. Dropping the stream leaves the goal to the rules of the action for goals
/// without a client.
pub fn invoke(
    agent: Agent,
    robot: AgentId,
    goal: Goal,
    cancel: Arc<Notify>,
) -> impl Stream<Item = Result<GoalEvent, Failure>> + Send + use<> {
    script(async move |emitter| {
        let robot = agent.robot(robot);
        let mut running = robot.send(goal).await.or_fail()?;
        emitter.emit(GoalEvent::Accepted).await;
        // A goal that has ended already has no progress.
        let mut updates = running.progress().await.ok();
        let result = loop {
            tokio::select! {
                biased;
                status = async { updates.as_mut()?.next().await.ok().flatten() }, if updates.is_some() => {
                    match status {
                        Some(status) => {
                            emitter.emit(GoalEvent::Progress(progress(&status)?)).await;
                        }
                        None => updates = None,
                    }
                }
                result = running.outcome() => break result.or_fail()?,
                () = cancel.notified() => {
                    running.cancel(CANCEL).await.or_fail()?;
                }
            }
        };
        let value = match result {
            Some(term) => json_of(&term)?,
            None => Value::Null,
        };
        emitter.emit(GoalEvent::Result(value)).await;
        Ok(())
    })
}

fn progress(status: &GoalStatus) -> Result<Value, Failure> {
    let progress = status.progress.as_ref();
    let value = progress.and_then(|progress| progress.value.as_ref());
    Ok(json!({
        "state": status.state.as_str(),
        "fraction": progress.and_then(|progress| progress.fraction),
        "note": progress.and_then(|progress| progress.note.as_deref()),
        "value": value.map(json_of).transpose()?,
    }))
}

/// Returns the value of the program in SL.
fn term(value: Value, what: &str) -> Result<Term<'static>, Failure> {
    term_from_json(value).map_err(|error| Failure::invalid(format!("{what}: {error}")))
}

/// Returns a value of another agent in JSON.
fn json_of(term: &Term<'_>) -> Result<Value, Failure> {
    term_to_json(term).map_err(|error| Failure::new(FailureKind::Failed, error.to_string()))
}
