//! Actions of robots: offering them, and invoking those of other robots.

use std::sync::Arc;

use fipa::AgentId;
use fipa::actions::{Goal, arguments_from_json};
use fipa::blocking::Wait;
use fipa_bindings::{Failure, GoalEvent, Offered, OrFail, Pursuit, action_of, invoke, offered};
use futures_util::StreamExt as _;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value};
use tokio::sync::{Notify, mpsc};

use crate::agent::OwnAgent;
use crate::failure::{FipaResult, call};
use crate::item::{Event, FipaEvent, Following, GivenHandle, OperationHandle, Text};
use crate::locks::HeldLock;
use crate::raw::{FipaText, Place, limit};
use crate::table::{self, FipaHandle, Object};

type Arguments = Map<String, Value>;

/// A goal of an action that this agent offers.
struct OpenGoal {
    arguments: Text,
    pursuit: Pursuit,
}

impl Object for OpenGoal {
    fn text(&self) -> Option<&str> {
        Some(self.arguments.as_str())
    }
}

/// Offers an action. `description` is a JSON object with a `name` and, as far as they are needed, `description`,
/// `parameters` (each with `name`, `type` such as `number`, and `unit`, `range`, `default`, `description`,
/// `optional`), `result` (a type), and `policy` (`reject`, `preempt`, or `{"queue": N}`). `concurrency` is the maximum
/// number of goals that run at the same time, by default 1; `client_gone` is `cancel`, the default, or `continue`, for a
/// goal whose client is gone; `fenced_by` is an object with `owner` and `resource`, the lock whose fence each goal needs;
/// with `decides`, `true`, the client learns that its goal is accepted by `fipa_goal_accept`. Each goal is an item of the
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
        let action = action_of(unsafe { description.required("the description") }?)?;
        // The robot admits a bounded number of goals, and each sends at most two events.
        let (events, received) = mpsc::unbounded_channel();
        let offered = async {
            own.agent.offer(action, move |arguments, execution| {
                let (events, handle) = (events.clone(), GivenHandle::default());
                offered(arguments, execution, move |event| {
                    events.send(offered_event(event, &handle)).is_ok()
                })
            })
        };
        let offered = offered.wait().or_fail()?;
        let open = Following::new(&own.items, tag, offered, received);
        Ok(table::give(offer, open))
    })
}

fn offered_event(event: Offered, handle: &GivenHandle) -> Event {
    match event {
        Offered::Goal(arguments, pursuit) => match Text::json(&arguments) {
            Ok(arguments) => {
                Event::giving(FipaEvent::Goal, OpenGoal { arguments, pursuit }, handle)
            }
            Err(failure) => Event::ended(Err(failure)),
        },
        Offered::Stop(failure) => Event::about(FipaEvent::Stop, handle).result(Err(failure)),
    }
}

/// Accepts a goal of an action with `decides`. Without effect on other goals, and on one that is accepted already.
#[unsafe(no_mangle)]
pub extern "C" fn fipa_goal_accept(goal: FipaHandle) -> FipaResult {
    call(|| {
        table::get::<OpenGoal>(goal)?.pursuit.accept();
        Ok(FipaResult::Ok)
    })
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
        goal.pursuit.progress(parsed(text, "the progress")?)?;
        Ok(FipaResult::Ok)
    })
}

/// Ends a goal: with its result, a value in JSON or an empty text, if `is_done` is not 0; else with a failure, whose
/// reason is the text; a goal of an action with `decides` that was not accepted is refused with it. The caller closes
/// the handle afterwards. A goal that is closed without an end fails.
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
        goal.pursuit.end(match is_done {
            0 => Err(text.to_owned()),
            _ if text.is_empty() => Ok(None),
            _ => Ok(Some(parsed(text, "the result")?)),
        })?;
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
        let listed = async move {
            match agent.robot(robot).actions().await {
                Ok(actions) => Event::json(FipaEvent::Result, &actions),
                Err(error) => Event::ended(Err(Failure::of(error))),
            }
        };
        let began = OperationHandle::of(own.items.begin(tag, listed));
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
        let events = invoke(agent, robot, goal, cancelling).map(|event| match event {
            Ok(GoalEvent::Accepted) => Event::of(FipaEvent::Accepted),
            Ok(GoalEvent::Progress(value)) => Event::json(FipaEvent::Progress, &value),
            Ok(GoalEvent::Result(value)) => Event::json(FipaEvent::Result, &value),
            Err(failure) => Event::ended(Err(failure)),
        });
        let began = OperationHandle::cancellable(own.items.follow(tag, events), cancel);
        Ok(table::give(operation, began))
    })
}

/// Reads JSON of the caller; `what` names it in errors.
fn parsed<T: DeserializeOwned>(text: &str, what: &str) -> Result<T, Failure> {
    serde_json::from_str(text).map_err(|error| Failure::invalid(format!("{what}: {error}")))
}
