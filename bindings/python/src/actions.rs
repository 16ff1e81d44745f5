//! Actions of robots: offering them, and invoking those of other robots.

use std::collections::VecDeque;
use std::sync::Arc;

use fipa::AgentId;
use fipa::actions::{Action, Goal as Sent, arguments_from_json};
use fipa::blocking::Wait as _;
use fipa_bindings::{
    Failure, FailureKind, GoalEvent, Offered, OrFail as _, Pursuit, action_of, invoke, offered,
};
use futures_core::stream::BoxStream;
use futures_util::StreamExt as _;
use futures_util::stream::poll_fn;
use pyo3::types::PyTuple;
use pyo3::{Bound, Py, PyAny, PyResult, Python, pyclass, pymethods};
use serde_json::{Map, Value};
use tokio::sync::{Mutex, Notify, mpsc, watch};

use crate::agent::Agent;
use crate::conversation::nothing;
use crate::events::Events;
use crate::failure::OrRaise as _;
use crate::interpreter::call;
use crate::message::LockArgument;
use crate::pending::{Output, Pending, begun, detached, seconds, step};
use crate::value::{from_python, to_python};

/// Maximum number of progress reports that a cancelled goal keeps for the iteration. The oldest are dropped.
const MAX_EARLY: usize = 64;

/// Reads an object of the program.
fn object(of: &Bound<'_, PyAny>, what: &str) -> PyResult<Map<String, Value>> {
    match from_python(of, what)? {
        Value::Object(object) => Ok(object),
        _ => Err(Failure::invalid(format!("{what}: not a dictionary"))).or_raise(of.py()),
    }
}

fn value(value: Value) -> Output {
    Box::new(move |py| to_python(py, &value))
}

#[pymethods]
impl Agent {
    /// Offers an action: each goal of a client is a `Goal`. `description` is a dictionary with a `name` and, as far as
    /// they are needed, `description`, `parameters`, `result` (a type) and `policy` (`"reject"`, `"preempt"`, or
    /// `{"queue": N}`). `concurrency` is the maximum number of goals that run at the same time, by default 1.
    /// `client_gone` is `"cancel"`, the default, or `"continue"`: what happens to a goal whose client is gone.
    /// `fenced_by` is a dictionary with `owner` and `resource`: each goal needs the fence of that lock. With
    /// `decides`, `True`, the client learns that its goal is accepted when the program calls `Goal.accept`. The end of
    /// the sequence withdraws the action.
    fn goals(&self, description: &Bound<'_, PyAny>) -> PyResult<Events> {
        let py = description.py();
        let agent = self.registered(py)?;
        let text = Value::Object(object(description, "the description of the action")?);
        let action: Action = action_of(&text.to_string()).or_raise(py)?;
        // The robot admits a bounded number of goals.
        let (begun, mut goals) = mpsc::unbounded_channel();
        let offering = async {
            agent.offer(action, move |arguments: Map<String, Value>, execution| {
                let begun: mpsc::UnboundedSender<Begun> = begun.clone();
                let (stop, stopped) = watch::channel(None);
                offered(arguments, execution, move |event| match event {
                    Offered::Goal(arguments, pursuit) => {
                        let stopped = stopped.clone();
                        begun.send((arguments, pursuit, stopped)).is_ok()
                    }
                    Offered::Stop(failure) => {
                        stop.send_replace(Some(failure.text));
                        true
                    }
                })
            })
        };
        let offer = offering.wait().or_fail().or_raise(py)?;
        let goals = poll_fn(move |context| {
            // The end of the sequence withdraws the action.
            let _ = &offer;
            goals.poll_recv(context)
        });
        Ok(Events::new(goals.map(|(arguments, pursuit, stopped)| {
            Ok(Box::new(|py: Python<'_>| {
                let goal = Goal {
                    arguments: to_python(py, &Value::Object(arguments))?,
                    pursuit,
                    stopped,
                };
                Ok(Py::new(py, goal)?.into_any())
            }) as Output)
        })))
    }

    /// Offers a function as an action: a decorator. The name is that of the function; its parameters and their types are
    /// those of the action, and its docstring describes it. The first parameter is the `Goal`. `policy` is as in `goals`,
    /// `"reject"` if it is left out.
    #[pyo3(signature = (function=None, *, name=None, policy=None))]
    fn action(
        slf: Bound<'_, Self>,
        function: Option<Py<PyAny>>,
        name: Option<&str>,
        policy: Option<Py<PyAny>>,
    ) -> PyResult<Py<PyAny>> {
        let py = slf.py();
        let arguments = (slf, function, name, policy);
        Ok(call(py, "fipa._serve", "action", arguments)?.unbind())
    }

    /// Lists the actions of a robot as dictionaries, as `goals` reads them.
    fn actions(&self, py: Python<'_>, robot: &str) -> PyResult<Pending> {
        let agent = self.registered(py)?.clone();
        let robot = AgentId::new(robot).or_fail().or_raise(py)?;
        Ok(Pending::lazy("Agent.actions()", async move {
            let actions = agent.robot(robot).actions().await.or_fail()?;
            let actions = serde_json::to_value(&actions);
            let failed =
                |error: serde_json::Error| Failure::new(FailureKind::Failed, error.to_string());
            Ok(value(actions.map_err(failed)?))
        }))
    }

    /// Invokes an action of a robot. With `timeout` in seconds, the robot stops the goal after that time. The goal
    /// carries the first fence of `lock`.
    ///
    /// Each goal has an `id`. One that was sent before, by an agent of this name and with the same id, does not run
    /// again: both calls get its outcome. So a program sends a goal again if it does not know the outcome.
    ///
    /// A goal that is dropped goes on by the rules of its action: by default, the robot cancels it when this agent has
    /// gone. `with agent.invoke(...) as goal:` or `async with` cancels it at the end of the block.
    #[pyo3(signature = (robot, action, arguments=None, *, lock=None, timeout=None, id=None))]
    #[expect(
        clippy::too_many_arguments,
        reason = "most have defaults, and names in Python"
    )]
    fn invoke(
        &self,
        py: Python<'_>,
        robot: &str,
        action: &str,
        arguments: Option<&Bound<'_, PyAny>>,
        lock: LockArgument,
        timeout: Option<f64>,
        id: Option<String>,
    ) -> PyResult<RemoteGoal> {
        let agent = self.registered(py)?.clone();
        let robot = AgentId::new(robot).or_fail().or_raise(py)?;
        let arguments = match arguments {
            Some(arguments) => object(arguments, "the arguments")?,
            None => Map::new(),
        };
        let arguments = arguments_from_json(arguments)
            .map_err(|error| Failure::invalid(format!("the arguments: {error}")));
        let mut goal = Sent::of(action, arguments.or_raise(py)?);
        goal.deadline =
            seconds(timeout)?.and_then(|timeout| u64::try_from(timeout.as_millis()).ok());
        if let Some(lock) = lock {
            goal.fence = lock
                .get()
                .read(|lock| lock.fence().map(ToString::to_string))
                .flatten();
        }
        let id = id.unwrap_or_else(|| agent.unique_id());
        goal.id = Some(id.clone());
        let cancel = Arc::<Notify>::default();
        let accepted = watch::Sender::new(false);
        let events = invoke(agent, robot, goal, Arc::clone(&cancel));
        Ok(RemoteGoal {
            led: Arc::new(Mutex::new(Led {
                events: begun(events),
                accepted: accepted.clone(),
                early: VecDeque::new(),
                end: None,
            })),
            id,
            accepted,
            cancel,
        })
    }
}

type Begun = (Map<String, Value>, Pursuit, watch::Receiver<Option<String>>);

/// A goal of an action that the program offers. One that is dropped without an end fails.
#[pyclass(frozen, module = "fipa")]
pub(crate) struct Goal {
    arguments: Py<PyAny>,
    pursuit: Pursuit,
    /// The reason to stop.
    stopped: watch::Receiver<Option<String>>,
}

#[pymethods]
impl Goal {
    /// The arguments, a dictionary.
    #[getter]
    fn arguments(&self, py: Python<'_>) -> Py<PyAny> {
        self.arguments.clone_ref(py)
    }

    /// The id that the client gave the goal.
    #[getter]
    fn id(&self) -> &str {
        self.pursuit.id()
    }

    /// The name of the client.
    #[getter]
    fn client(&self) -> Option<&str> {
        self.pursuit.client()
    }

    /// Accepts the goal of an action with `decides`. Without effect on other goals, and on one that is accepted already.
    fn accept(&self) {
        self.pursuit.accept();
    }

    /// Reports the progress: the done part from 0 to 1, the present step in words, and a value of the action.
    #[pyo3(signature = (fraction=None, note=None, value=None))]
    fn progress(
        &self,
        py: Python<'_>,
        fraction: Option<f64>,
        note: Option<&str>,
        value: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<()> {
        let mut report = Map::new();
        if let Some(fraction) = fraction {
            report.insert("fraction".to_owned(), fraction.into());
        }
        if let Some(note) = note {
            report.insert("note".to_owned(), note.into());
        }
        if let Some(value) = value {
            report.insert("value".to_owned(), from_python(value, "the progress")?);
        }
        self.pursuit.progress(report).or_raise(py)
    }

    /// Ends the goal with its result. It is accepted, if it was not.
    #[pyo3(signature = (result=None))]
    fn succeed(&self, py: Python<'_>, result: Option<&Bound<'_, PyAny>>) -> PyResult<()> {
        let result = result.map(|result| from_python(result, "the result"));
        self.pursuit.end(Ok(result.transpose()?)).or_raise(py)
    }

    /// Ends the goal with a failure. A goal of an action with `decides` that was not accepted is refused with this
    /// reason.
    #[pyo3(signature = (reason=""))]
    fn fail(&self, py: Python<'_>, reason: &str) -> PyResult<()> {
        self.pursuit.end(Err(reason.to_owned())).or_raise(py)
    }

    /// Why the goal is to stop: it was cancelled, its time is over, or its client is gone. `None` if it goes on.
    #[getter]
    fn stop_reason(&self) -> Option<String> {
        self.stopped.borrow().clone()
    }

    /// Waits until the goal is to stop.
    fn stopped(&self) -> Pending {
        let mut stopped = self.stopped.clone();
        Pending::begun(async move {
            if stopped.wait_for(Option::is_some).await.is_err() {
                std::future::pending::<()>().await;
            }
            Ok(nothing())
        })
    }
}

impl std::fmt::Debug for Goal {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Goal").finish_non_exhaustive()
    }
}

/// A goal of another robot. Iterate over its progress with `for` or `async for`: dictionaries with `state`, `fraction`,
/// `note` and `value`.
///
/// The end of a block, `with` or `async with`, cancels a goal that has not ended. It does not wait until the robot has
/// stopped; `result` does, also after the block. A goal that is dropped without a block is not cancelled.
#[pyclass(frozen, module = "fipa")]
pub(crate) struct RemoteGoal {
    led: Arc<Mutex<Led>>,
    id: String,
    accepted: watch::Sender<bool>,
    cancel: Arc<Notify>,
}

struct Led {
    events: BoxStream<'static, Result<GoalEvent, Failure>>,
    /// Whether the robot has accepted the goal.
    accepted: watch::Sender<bool>,
    /// The progress that has arrived after a cancel.
    early: VecDeque<Value>,
    /// The result, or the failure.
    end: Option<Result<Value, Failure>>,
}

impl Led {
    /// Waits for the next progress. Keeps the end.
    async fn next(&mut self) -> Result<Option<Value>, Failure> {
        loop {
            if let Some(progress) = self.early.pop_front() {
                return Ok(Some(progress));
            }
            match &self.end {
                Some(Ok(_)) => return Ok(None),
                Some(Err(failure)) => return Err(failure.clone()),
                None => {}
            }
            if let Some(progress) = self.event().await {
                return Ok(Some(progress));
            }
        }
    }

    /// Waits until the robot accepts the goal. No progress comes before.
    async fn accepted(&mut self) -> Result<(), Failure> {
        while !*self.accepted.borrow() {
            if let Some(Err(failure)) = &self.end {
                return Err(failure.clone());
            }
            self.event().await;
        }
        Ok(())
    }

    /// Waits for the end, and keeps the progress.
    async fn ended(&mut self) {
        while self.end.is_none() {
            if let Some(progress) = self.event().await {
                if self.early.len() == MAX_EARLY {
                    self.early.pop_front();
                }
                self.early.push_back(progress);
            }
        }
    }

    /// Waits for the next event, and returns it if it is a progress.
    async fn event(&mut self) -> Option<Value> {
        let over = || Failure::new(FailureKind::Closed, "the goal has ended");
        let event = self.events.next().await;
        match event.unwrap_or_else(|| Err(over())) {
            Ok(GoalEvent::Accepted) => drop(self.accepted.send_replace(true)),
            Ok(GoalEvent::Progress(progress)) => return Some(progress),
            Ok(GoalEvent::Result(result)) => self.end = Some(Ok(result)),
            Err(failure) => self.end = Some(Err(failure)),
        }
        None
    }
}

impl RemoteGoal {
    fn pending(&self, is_step: bool) -> Pending {
        let led = Arc::clone(&self.led);
        Pending::next(is_step, async move {
            let progress = led.lock().await.next().await?;
            Ok(progress.map(value))
        })
    }
}

#[pymethods]
impl RemoteGoal {
    /// The id of the goal, to send it again with `Agent.invoke`.
    #[getter]
    fn id(&self) -> &str {
        &self.id
    }

    /// Waits for the result. Raises `Refused` if the robot rejects the goal or fails.
    fn result(&self) -> Pending {
        let led = Arc::clone(&self.led);
        Pending::lazy("RemoteGoal.result()", async move {
            let mut led = led.lock().await;
            while led.next().await?.is_some() {}
            let result = led.end.clone().unwrap_or(Ok(Value::Null))?;
            Ok(value(result))
        })
    }

    /// Waits until the robot accepts the goal. Raises `Refused` if the robot rejects it. The progress stays for the
    /// iteration.
    fn accepted(&self) -> Pending {
        let (led, mut accepted) = (Arc::clone(&self.led), self.accepted.subscribe());
        Pending::lazy("RemoteGoal.accepted()", async move {
            // Another wait, which has the lock, may learn it.
            let known = async { accepted.wait_for(|it| *it).await.is_ok() };
            let led = tokio::select! {
                biased;
                true = known => None,
                led = led.lock() => Some(led),
            };
            if let Some(mut led) = led {
                led.accepted().await?;
            }
            Ok(nothing())
        })
    }

    /// Cancels the goal, unless it has ended. Its `result` then raises `Cancelled`, unless the robot is done.
    fn cancel(&self) {
        self.cancel.notify_one();
        // The program may never wait for the goal.
        let led = Arc::clone(&self.led);
        detached(async move { led.lock().await.ended().await });
    }

    fn __enter__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    #[pyo3(signature = (*_exception))]
    fn __exit__(&self, _exception: &Bound<'_, PyTuple>) {
        self.cancel();
    }

    fn __aenter__(slf: Bound<'_, Self>) -> PyResult<Py<PyAny>> {
        let py = slf.py();
        Ok(call(py, "fipa._loop", "itself", (slf,))?.unbind())
    }

    #[pyo3(signature = (*_exception))]
    fn __aexit__(&self, py: Python<'_>, _exception: &Bound<'_, PyTuple>) -> PyResult<Py<PyAny>> {
        self.cancel();
        Ok(call(py, "fipa._loop", "nothing", ())?.unbind())
    }

    fn __iter__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    fn __next__(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        step(py, &self.pending(true))
    }

    fn __aiter__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    fn __anext__(&self) -> Pending {
        self.pending(true)
    }
}

impl std::fmt::Debug for RemoteGoal {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("RemoteGoal").finish_non_exhaustive()
    }
}
