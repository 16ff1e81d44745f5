//! Goals of actions that a program pursues from outside Rust's futures.

use std::fmt;
use std::pin::pin;
use std::sync::Arc;

use fipa::actions::{
    Action, ActionDescription, Cause, Execution, Goal, GoalStatus, Orphans, Progress, Term,
    term_from_json, term_to_json,
};
use fipa::locks::Admission;
use fipa::{Agent, AgentId};
use futures_core::Stream;
use parking_lot::Mutex;
use serde_json::{Map, Value, json};
use tokio::sync::{Notify, oneshot};

use crate::conversation::CANCEL;
use crate::failure::{Failure, FailureKind, OrFail as _};
use crate::script::script;

/// Reads the description of an action: a JSON object with a `name` and, as far as they are needed, `description`,
/// `parameters`, `result`, and `policy`. These keys are not part of the description that clients read:
///
/// - `concurrency`: the maximum number of goals that run at the same time, 1 if it is left out.
/// - `client_gone`: `cancel` or `continue`, the treatment of a goal whose client is gone.
/// - `fenced_by`: an object with `owner` and `resource`, the lock whose fence each goal needs.
/// - `decides`: whether the client gets no agree before [`Pursuit::accept`].
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
    let options = OPTIONS.map(|key| description.remove(key));
    let description: ActionDescription =
        serde_json::from_value(Value::Object(description)).map_err(wrong)?;
    let mut action = Action::from(description);
    for (key, value) in OPTIONS.into_iter().zip(options) {
        if let Some(value) = value {
            action = with_option(action, key, &value)?;
        }
    }
    Ok(action)
}

/// The keys of a description that clients do not read.
const OPTIONS: [&str; 4] = ["concurrency", "client_gone", "fenced_by", "decides"];

/// Sets an option of an action.
fn with_option(action: Action, key: &str, value: &Value) -> Result<Action, Failure> {
    let wrong = |expected: &str| {
        Err(Failure::invalid(format!(
            "the description of the action: {key:?} is {value}; expected {expected}"
        )))
    };
    match key {
        "concurrency" => match value.as_u64().and_then(|goals| usize::try_from(goals).ok()) {
            Some(goals) if goals > 0 => Ok(action.concurrency(goals)),
            _ => wrong("a number of goals from 1"),
        },
        "client_gone" => match value.as_str() {
            Some("cancel") => Ok(action.orphans(Orphans::Cancel)),
            Some("continue") => Ok(action.orphans(Orphans::Continue)),
            _ => wrong("\"cancel\" or \"continue\""),
        },
        "fenced_by" => {
            let part = |name: &str| value.get(name).and_then(Value::as_str);
            let is_known = value.as_object().is_some_and(|object| object.len() == 2);
            let (Some(owner), Some(resource), true) = (part("owner"), part("resource"), is_known)
            else {
                return wrong("an object with the texts owner and resource");
            };
            let expected = |error: String| format!("the names of an agent and a resource: {error}");
            if let Err(error) = AgentId::new(owner) {
                return wrong(&expected(error.to_string()));
            }
            match Admission::new(owner, resource) {
                Ok(admission) => Ok(action.fenced_by(admission)),
                Err(error) => wrong(&expected(error.to_string())),
            }
        }
        _ => match value.as_bool() {
            Some(true) => Ok(action.decided_by_handler()),
            Some(false) => Ok(action),
            None => wrong("true or false"),
        },
    }
}

/// A goal that the program pursues. A goal that is dropped without an end fails.
pub struct Pursuit {
    execution: Arc<Execution>,
    end: Mutex<Option<oneshot::Sender<()>>>,
}

impl Pursuit {
    /// Returns the id that the client gave the goal.
    pub fn id(&self) -> &str {
        self.execution.id()
    }

    /// Returns the name of the client.
    pub fn client(&self) -> Option<&str> {
        self.execution.client().map(AgentId::name)
    }

    /// Accepts the goal of an action with `decides`: the client gets the agree. Without effect on other goals, and on
    /// one that is accepted already.
    pub fn accept(&self) {
        self.execution.accept();
    }

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

    /// Ends the goal at once, with its result, `None` for an action without one, or with the reason of its failure. A
    /// goal of an action with `decides` that fails before it is accepted is refused with that reason.
    ///
    /// # Errors
    /// If the goal has ended already, or SL has no form for the result.
    pub fn end(&self, result: Result<Option<Value>, String>) -> Result<(), Failure> {
        let result = match result {
            Err(reason) => Err(reason),
            Ok(None) => Ok(None),
            Ok(Some(value)) => Ok(Some(term(value, "the result")?)),
        };
        let end = self.end.lock().take();
        let over = || Failure::new(FailureKind::Closed, "the goal has ended");
        let end = end.filter(|end| !end.is_closed()).ok_or_else(over)?;
        self.execution.end(result);
        // The handler returns.
        let _ = end.send(());
        Ok(())
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
            biased;
            // `Pursuit::end` has given the result.
            _ = &mut ended => return Err("the program has dropped the goal".to_owned()),
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
        let mut running = robot.propose(goal).await.or_fail()?;
        loop {
            tokio::select! {
                biased;
                accepted = running.accepted() => {
                    accepted.or_fail()?;
                    break;
                }
                () = cancel.notified() => {
                    running.cancel(CANCEL).await.or_fail()?;
                }
            }
        }
        emitter.emit(GoalEvent::Accepted).await;
        // A goal that has ended already has no progress.
        let mut updates = running.progress().await.ok();
        let result = loop {
            let result = {
                let mut outcome = pin!(running.outcome());
                loop {
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
                        result = &mut outcome => break Some(result),
                        () = cancel.notified() => break None,
                    }
                }
            };
            if let Some(result) = result {
                break result.or_fail()?;
            }
            running.cancel(CANCEL).await.or_fail()?;
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_of_an_action_are_read_and_a_wrong_one_is_named() {
        for options in [
            json!({"concurrency": 3, "client_gone": "continue", "decides": true}),
            json!({"concurrency": 1, "client_gone": "cancel", "decides": false}),
            json!({"fenced_by": {"owner": "crane", "resource": "bay"}}),
        ] {
            let mut description = options.clone();
            description["name"] = json!("dock");
            let action = format!("{:?}", action_of(&description.to_string()).unwrap());
            let is = |text: &str| action.contains(text);
            assert_eq!(
                is("concurrency: 3"),
                options["concurrency"] == 3,
                "{action}"
            );
            assert_eq!(is("Continue"), options["client_gone"] == "continue");
            assert_eq!(is("decides: true"), options["decides"] == true);
            assert_eq!(is("fenced: true"), !options["fenced_by"].is_null());
        }
        for (key, value) in [
            ("concurrency", json!(0)),
            ("concurrency", json!(1.5)),
            ("client_gone", json!("ignore")),
            ("client_gone", json!(true)),
            ("fenced_by", json!("bay")),
            ("fenced_by", json!({"owner": "crane"})),
            (
                "fenced_by",
                json!({"owner": "crane", "resource": "bay", "lock": 1}),
            ),
            ("fenced_by", json!({"owner": "", "resource": "bay"})),
            ("fenced_by", json!({"owner": "crane", "resource": ""})),
            ("decides", json!("yes")),
            ("decides", json!(null)),
        ] {
            let description = json!({"name": "dock", key: value});
            let error = action_of(&description.to_string()).unwrap_err();
            assert_eq!(error.kind, FailureKind::Invalid);
            let named = format!("{key:?} is {value}; expected ");
            assert!(error.text.contains(&named), "{error}");
        }
    }
}
