//! Actions of robots: offering them, and invoking those of other robots.

use std::sync::Arc;
use std::time::Duration;

use fipa::AgentId;
use fipa::actions::{
    Action, ActionDescription, Cause, Execution, Goal, GoalStatus, Progress, Term,
    arguments_from_json, term_from_json, term_to_json,
};
use fipa::blocking::Wait;
use parking_lot::Mutex;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value, json};
use tokio::sync::{Notify, mpsc, oneshot};

use crate::agent::OwnAgent;
use crate::failure::{Failure, FipaResult, OrFail, call};
use crate::item::{Event, FipaEvent, Following, GivenHandle, OperationHandle, Text, script};
use crate::locks::HeldLock;
use crate::raw::{FipaText, Place, limit};
use crate::table::{self, FipaHandle, Object};

/// Time for the answer to a cancel.
const CANCEL: Duration = Duration::from_secs(10);

type Arguments = Map<String, Value>;

/// A goal of an action that this agent offers.
struct OpenGoal {
    arguments: Text,
    execution: Arc<Execution>,
    end: Mutex<Option<oneshot::Sender<Result<Term<'static>, String>>>>,
}

impl Object for OpenGoal {
    fn text(&self) -> Option<&str> {
        Some(self.arguments.as_str())
    }
}

/// Offers an action. `description` is a JSON object with a `name` and, as far as they are needed, `description`,
/// `parameters` (each with `name`, `type` such as `number`, and `unit`, `range`, `default`, `description`,
/// `optional`), `result` (a type), and `policy` (`reject`, `preempt`, or `{"queue": N}`). Each goal is an item of the
/// kind `FIPA_EVENT_GOAL`. Closing the offer withdraws the action and cancels its goals.
///
/// # Safety
/// The text must be readable. `offer` is NULL or can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_offer(
    agent: FipaHandle,
    description: FipaText,
    tag: u64,
    offer: *mut FipaHandle,
) -> FipaResult {
    call(|| {
        // SAFETY: The caller promises it.
        let offer = unsafe { Place::of(offer, "the handle") }?;
        let own = table::get::<OwnAgent>(agent)?;
        // SAFETY: The caller promises it.
        let description = described(unsafe { description.required("the description") }?)?;
        // The robot admits a bounded number of goals, and each sends at most two events.
        let (events, received) = mpsc::unbounded_channel();
        let offered = async {
            own.agent
                .offer(Action::from(description), move |arguments, execution| {
                    pursue(arguments, Arc::new(execution), events.clone())
                })
        };
        let offered = offered.wait().or_fail()?;
        let open = Following::new(&own.items, tag, offered, received);
        Ok(table::give(offer, open))
    })
}

/// Reads the description of an action, with defaults for what it leaves out.
fn described(text: &str) -> Result<ActionDescription, Failure> {
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
    serde_json::from_value(Value::Object(description)).map_err(wrong)
}

/// Hands a goal to the program, and waits until the program ends it.
async fn pursue(
    arguments: Arguments,
    execution: Arc<Execution>,
    events: mpsc::UnboundedSender<Event>,
) -> Result<Term<'static>, String> {
    let (end, mut ended) = oneshot::channel();
    let handle = GivenHandle::default();
    let arguments = Text::json(&arguments).map_err(|failure| failure.text)?;
    let goal = OpenGoal {
        arguments,
        execution: Arc::clone(&execution),
        end: Mutex::new(Some(end)),
    };
    let withdrawn = "the program has ended its offer";
    let event = Event::giving(FipaEvent::Goal, goal, &handle);
    events.send(event).map_err(|_| withdrawn)?;
    let mut is_stopped = false;
    loop {
        tokio::select! {
            result = &mut ended => {
                return result.unwrap_or_else(|_| Err("the program has dropped the goal".to_owned()));
            }
            cause = execution.stopped(), if !is_stopped => {
                is_stopped = true;
                let (code, text) = stop(cause);
                // The program may have ended its offer; it still can end the goal.
                let stop = Event::about(FipaEvent::Stop, &handle);
                let _ = events.send(stop.result(Err(Failure::new(code, text))));
            }
        }
    }
}

fn stop(cause: Cause) -> (FipaResult, &'static str) {
    match cause {
        Cause::DeadlinePassed => (FipaResult::TimedOut, "the time for the goal is over"),
        Cause::ClientGone => (FipaResult::Gone, "the client of the goal is gone"),
        Cause::Preempted => (
            FipaResult::Cancelled,
            "another goal takes the place of the goal",
        ),
        Cause::Withdrawn => (FipaResult::Cancelled, "the action is not offered any more"),
        _ => (FipaResult::Cancelled, "the goal was cancelled"),
    }
}

/// Reports the progress of a goal: a JSON object with `fraction` from 0 to 1, `note` and `value`, each optional.
///
/// # Safety
/// The text must be readable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_goal_progress(goal: FipaHandle, progress: FipaText) -> FipaResult {
    call(|| {
        let goal = table::get::<OpenGoal>(goal)?;
        // SAFETY: The caller promises it.
        let text = unsafe { progress.required("the progress") }?;
        let read: Map<String, Value> = parsed(text, "the progress")?;
        let mut progress = Progress::default();
        for (key, value) in read {
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
        goal.execution.progress(progress);
        Ok(FipaResult::Ok)
    })
}

/// Ends a goal: with its result, a value in JSON or an empty text, if `is_done` is not 0; else with a failure, whose
/// reason is the text. The caller closes the handle afterwards. A goal that is closed without an end fails.
///
/// # Safety
/// The text must be readable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_goal_end(
    goal: FipaHandle,
    is_done: i32,
    result: FipaText,
) -> FipaResult {
    call(|| {
        let goal = table::get::<OpenGoal>(goal)?;
        // SAFETY: The caller promises it.
        let text = unsafe { result.read("the result") }?.unwrap_or_default();
        let result = match is_done {
            0 => Err(text.to_owned()),
            // An empty sequence is no result.
            _ if text.is_empty() => Ok(Term::Sequence(Vec::new())),
            _ => Ok(parsed(text, "the result").and_then(|value| term(value, "the result"))?),
        };
        let end = goal.end.lock().take();
        let over = || Failure::new(FipaResult::Closed, "the goal has ended");
        end.ok_or_else(over)?.send(result).map_err(|_| over())?;
        Ok(FipaResult::Ok)
    })
}

/// Lists the actions of a robot. The item is of the kind `FIPA_EVENT_RESULT`, a JSON array of descriptions as in
/// `fipa_offer`, or `FIPA_EVENT_ENDED` with the failure.
///
/// # Safety
/// The text must be readable. `operation` is NULL or can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_begin_actions(
    agent: FipaHandle,
    robot: FipaText,
    tag: u64,
    operation: *mut FipaHandle,
) -> FipaResult {
    call(|| {
        // SAFETY: The caller promises it.
        let operation = unsafe { Place::of(operation, "the handle") }?;
        let own = table::get::<OwnAgent>(agent)?;
        // SAFETY: The caller promises it.
        let robot = AgentId::new(unsafe { robot.required("the robot") }?).or_fail()?;
        let agent = own.agent.clone();
        let events = script(async move |emitter| {
            let actions = agent.robot(robot).actions().await.or_fail()?;
            let actions = Text::json(&actions)?;
            emitter.emit(Event::with(FipaEvent::Result, actions)).await;
            Ok(())
        });
        let began = OperationHandle::of(own.items.follow(tag, events));
        Ok(table::give(operation, began))
    })
}

/// Invokes an action of a robot. `arguments` is empty or a JSON object. `lock` is 0 or a lock whose first fence the
/// goal carries. With `timeout_ms`, the robot stops the goal after that time.
///
/// The items are `FIPA_EVENT_ACCEPTED`, `FIPA_EVENT_PROGRESS` as often as the robot reports it, and then
/// `FIPA_EVENT_RESULT`, or `FIPA_EVENT_ENDED` with the failure. `fipa_cancel` cancels the goal.
///
/// # Safety
/// The texts must be readable. `operation` is NULL or can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_begin_goal(
    agent: FipaHandle,
    robot: FipaText,
    action: FipaText,
    arguments: FipaText,
    lock: FipaHandle,
    timeout_ms: i64,
    tag: u64,
    operation: *mut FipaHandle,
) -> FipaResult {
    call(|| {
        // SAFETY: The caller promises it.
        let operation = unsafe { Place::of(operation, "the handle") }?;
        let own = table::get::<OwnAgent>(agent)?;
        // SAFETY: The caller promises it.
        let robot = AgentId::new(unsafe { robot.required("the robot") }?).or_fail()?;
        // SAFETY: The caller promises it.
        let action = unsafe { action.required("the action") }?;
        // SAFETY: The caller promises it.
        let arguments = unsafe { arguments.read("the arguments") }?.filter(|it| !it.is_empty());
        let arguments: Arguments = match arguments {
            Some(text) => parsed(text, "the arguments")?,
            None => Map::new(),
        };
        let arguments = arguments_from_json(arguments);
        let arguments =
            arguments.map_err(|error| Failure::invalid(format!("the arguments: {error}")))?;
        let mut goal = Goal::of(action, arguments);
        goal.deadline = limit(timeout_ms).and_then(|it| u64::try_from(it.as_millis()).ok());
        if lock != 0 {
            let lock = table::get::<HeldLock>(lock)?;
            goal.fence = lock.lock.fence().map(ToString::to_string);
        }
        let cancel = Arc::new(Notify::new());
        let (agent, cancelling) = (own.agent.clone(), Arc::clone(&cancel));
        let events = script(async move |emitter| {
            let robot = agent.robot(robot);
            let mut running = robot.send(goal).await.or_fail()?;
            emitter.emit(Event::of(FipaEvent::Accepted)).await;
            // A goal that has ended already has no progress.
            let mut updates = running.progress().await.ok();
            let result = loop {
                tokio::select! {
                    biased;
                    status = async { updates.as_mut()?.next().await.ok().flatten() }, if updates.is_some() => {
                        match status {
                            Some(status) => {
                                let progress = progress(&status)?;
                                emitter.emit(Event::with(FipaEvent::Progress, progress)).await;
                            }
                            None => updates = None,
                        }
                    }
                    result = running.outcome() => break result.or_fail()?,
                    () = cancelling.notified() => {
                        running.cancel(CANCEL).await.or_fail()?;
                    }
                }
            };
            let value = match result {
                Some(term) => json_of(&term)?,
                None => Value::Null,
            };
            let value = Text::json(&value)?;
            emitter.emit(Event::with(FipaEvent::Result, value)).await;
            Ok(())
        });
        let began = OperationHandle::cancellable(own.items.follow(tag, events), cancel);
        Ok(table::give(operation, began))
    })
}

fn progress(status: &GoalStatus) -> Result<Text, Failure> {
    let progress = status.progress.as_ref();
    let value = progress.and_then(|progress| progress.value.as_ref());
    let value = value.map(json_of).transpose()?;
    Text::json(&json!({
        "state": status.state.as_str(),
        "fraction": progress.and_then(|progress| progress.fraction),
        "note": progress.and_then(|progress| progress.note.as_deref()),
        "value": value,
    }))
}

/// Reads JSON of the caller; `what` names it in errors.
fn parsed<T: DeserializeOwned>(text: &str, what: &str) -> Result<T, Failure> {
    serde_json::from_str(text).map_err(|error| Failure::invalid(format!("{what}: {error}")))
}

/// Returns the value of the caller in SL.
fn term(value: Value, what: &str) -> Result<Term<'static>, Failure> {
    term_from_json(value).map_err(|error| Failure::invalid(format!("{what}: {error}")))
}

/// Returns a value of another agent in JSON.
fn json_of(term: &Term<'_>) -> Result<Value, Failure> {
    term_to_json(term).map_err(|error| Failure::new(FipaResult::Failed, error.to_string()))
}
