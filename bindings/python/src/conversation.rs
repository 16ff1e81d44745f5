//! Conversations: requests, and serving them.

use std::sync::Arc;

use bytes::Bytes;
use fipa::Message;
use fipa::blocking::Wait as _;
use fipa::protocol::Reply;
use fipa_bindings::{
    Command, Conversation, Failure, FailureKind, OrFail as _, RequestEvent, TaskEvent, lead,
    request,
};
use futures_core::Stream;
use futures_core::stream::BoxStream;
use futures_util::StreamExt as _;
use futures_util::stream::poll_fn;
use parking_lot::Mutex as Lock;
use pyo3::types::PyTuple;
use pyo3::{Bound, Py, PyAny, PyResult, Python, pyclass, pymethods};
use std::time::Duration;
use tokio::sync::{Mutex, Notify, mpsc, watch};

use crate::agent::Agent;
use crate::events::Events;
use crate::failure::OrRaise as _;
use crate::interpreter::call;
use crate::letter::{self, Letter};
use crate::message::{Content, Draft};
use crate::pending::{Output, Pending, begun, seconds};

/// Time for a conversation, if the program sets none.
pub(crate) const LONG: Duration = Duration::from_secs(365 * 24 * 60 * 60);

/// Returns `None` to the program.
pub(crate) fn nothing() -> Output {
    Box::new(|py| Ok(py.None()))
}

/// Returns a truth value to the program.
fn truth(value: bool) -> Output {
    Box::new(move |py| {
        Ok(pyo3::types::PyBool::new(py, value)
            .to_owned()
            .into_any()
            .unbind())
    })
}

fn over() -> Failure {
    Failure::new(FailureKind::Closed, "the conversation has ended")
}

/// A request to another agent.
#[pyclass(frozen, module = "fipa")]
pub(crate) struct Request {
    led: Arc<Mutex<Led>>,
    cancel: Arc<Notify>,
}

struct Led {
    events: BoxStream<'static, Result<RequestEvent, Failure>>,
    /// An answer that came where an agreement was asked for.
    answer: Option<Box<Message>>,
}

impl Led {
    fn of(events: BoxStream<'static, Result<RequestEvent, Failure>>) -> Arc<Mutex<Self>> {
        Arc::new(Mutex::new(Self {
            events,
            answer: None,
        }))
    }
}

#[pymethods]
impl Request {
    /// Waits until the other agent agrees, or has answered without. The value is whether it has agreed.
    fn agreed(&self) -> Pending {
        let led = Arc::clone(&self.led);
        Pending::begun(async move {
            let mut led = led.lock().await;
            if led.answer.is_some() {
                return Ok(truth(false));
            }
            match led.events.next().await.ok_or_else(over)?? {
                RequestEvent::Agreed => Ok(truth(true)),
                RequestEvent::Answer(answer) => {
                    led.answer = Some(answer);
                    Ok(truth(false))
                }
            }
        })
    }

    /// Waits for the answer.
    fn result(&self) -> Pending {
        let led = Arc::clone(&self.led);
        Pending::begun(async move { Ok(letter::output(*answered(led).await?)) })
    }

    /// Cancels the request. Its `result` then raises `Cancelled`, unless the other agent is done.
    fn cancel(&self) {
        self.cancel.notify_one();
    }
}

async fn answered(led: Arc<Mutex<Led>>) -> Result<Box<Message>, Failure> {
    let mut led = led.lock().await;
    if let Some(answer) = led.answer.take() {
        return Ok(answer);
    }
    loop {
        if let RequestEvent::Answer(answer) = led.events.next().await.ok_or_else(over)?? {
            return Ok(answer);
        }
    }
}

impl Agent {
    /// Returns the events of a request that has not begun.
    fn led(
        &self,
        message: &Bound<'_, PyAny>,
        timeout: Option<f64>,
        cancel: &Arc<Notify>,
    ) -> PyResult<impl Stream<Item = Result<RequestEvent, Failure>> + Send + Unpin + use<>> {
        let agent = self.registered(message.py())?;
        let draft = Draft::read(message, Some(fipa::Performative::Request))?;
        let timeout = seconds(timeout)?.unwrap_or(LONG);
        let cancel = Arc::clone(cancel);
        Ok(request(
            agent.clone(),
            draft.whole(agent)?,
            &draft.act,
            timeout,
            cancel,
        ))
    }
}

impl std::fmt::Debug for Request {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Request").finish_non_exhaustive()
    }
}

#[pymethods]
impl Agent {
    /// Requests an action from one agent (FIPA00026), or asks it (FIPA00027) if the performative is `query-ref` or
    /// `query-if`. The value is the answer. Raises `Refused` if the other agent refuses or fails, `Gone` if it is gone,
    /// and `TimedOut` after `timeout` seconds.
    #[pyo3(signature = (message, *, timeout=None))]
    fn request(&self, message: &Bound<'_, PyAny>, timeout: Option<f64>) -> PyResult<Pending> {
        let events = self.led(message, timeout, &Arc::default())?;
        let led = Led::of(events.boxed());
        Ok(Pending::lazy("Agent.request()", async move {
            Ok(letter::output(*answered(led).await?))
        }))
    }

    /// Sends a request as `request` does, for a program that cancels it or looks at the agreement.
    #[pyo3(signature = (message, *, timeout=None))]
    fn begin_request(&self, message: &Bound<'_, PyAny>, timeout: Option<f64>) -> PyResult<Request> {
        let cancel = Arc::default();
        let events = self.led(message, timeout, &cancel)?;
        Ok(Request {
            led: Led::of(begun(events)),
            cancel,
        })
    }

    /// Serves a protocol, such as `"fipa-request"`: each conversation that begins is a `Task`.
    fn tasks(&self, py: Python<'_>, protocol: &str) -> PyResult<Events> {
        let agent = self.registered(py)?;
        // A server runs a bounded number of handlers, and each sends one task.
        let (begun, mut tasks) = mpsc::unbounded_channel();
        let served = async {
            agent.serve(protocol, move |task| {
                let begun: mpsc::UnboundedSender<Begun> = begun.clone();
                let (cancel, cancelled) = watch::channel(None);
                lead(task, move |event| match event {
                    TaskEvent::Begun(message, conversation) => {
                        let cancelled = cancelled.clone();
                        begun.send((message, conversation, cancelled)).is_ok()
                    }
                    TaskEvent::Cancelled(result) => {
                        cancel.send_replace(Some(result.map_err(|failure| failure.text)));
                        true
                    }
                    // Also the result of the proposal.
                    TaskEvent::Decided(_) => true,
                })
            })
        };
        let server = served.wait().or_fail().or_raise(py)?;
        let tasks = poll_fn(move |context| {
            // The end of the sequence ends the server.
            let _ = &server;
            tasks.poll_recv(context)
        });
        Ok(Events::new(tasks.map(
            |(message, conversation, cancelled)| {
                Ok(Box::new(|py: Python<'_>| {
                    let task = Task {
                        letter: Py::new(py, Letter::from(*message))?,
                        conversation: Lock::new(Some(conversation)),
                        cancelled,
                    };
                    Ok(Py::new(py, task)?.into_any())
                }) as Output)
            },
        )))
    }

    /// Serves a protocol with a handler: a coroutine function, which runs in the event loop of this thread, or a plain
    /// function, which runs in a pool of threads. Returns a decorator if `handler` is left out.
    ///
    /// The handler gets the `Task`, and returns the content of the answer. `fipa.Refuse` refuses; another exception
    /// reports a failure.
    #[pyo3(signature = (protocol, handler=None))]
    fn serve(
        slf: Bound<'_, Self>,
        protocol: &str,
        handler: Option<Py<PyAny>>,
    ) -> PyResult<Py<PyAny>> {
        let py = slf.py();
        let arguments = (slf, protocol, handler);
        Ok(call(py, "fipa._serve", "serve", arguments)?.unbind())
    }
}

type Cancelled = watch::Receiver<Option<Result<(), String>>>;
type Begun = (Box<Message>, Conversation, Cancelled);

/// A conversation that the program serves, until its last message. One that is dropped before ends with a failure.
#[pyclass(frozen, module = "fipa")]
pub(crate) struct Task {
    letter: Py<Letter>,
    /// `None` after the last message.
    conversation: Lock<Option<Conversation>>,
    cancelled: Cancelled,
}

impl Task {
    fn send(&self, py: Python<'_>, command: Command) -> PyResult<Pending> {
        let conversation = self.conversation.lock();
        let conversation = conversation.as_ref().ok_or_else(over).or_raise(py)?;
        let sending = conversation.send(command);
        Ok(Pending::lazy("a message of a task", async move {
            Ok(truth(sending.await?))
        }))
    }

    fn last(&self, py: Python<'_>, reply: Reply) -> PyResult<Pending> {
        let pending = self.send(py, Command::Last(reply));
        *self.conversation.lock() = None;
        pending
    }
}

fn content(of: &Bound<'_, PyAny>) -> PyResult<Bytes> {
    Ok(Content::copied(of)?.into())
}

#[pymethods]
impl Task {
    /// The message with which the conversation began.
    #[getter]
    fn letter(&self, py: Python<'_>) -> Py<Letter> {
        self.letter.clone_ref(py)
    }

    /// Agrees; the result follows.
    #[pyo3(signature = (content=""))]
    fn agree(&self, py: Python<'_>, content: &str) -> PyResult<Pending> {
        self.send(
            py,
            Command::Agree(Bytes::copy_from_slice(content.as_bytes())),
        )
    }

    /// Sends an `inform` after which the conversation goes on.
    fn notify(&self, content: &Bound<'_, PyAny>) -> PyResult<Pending> {
        self.send(content.py(), Command::Notify(self::content(content)?))
    }

    /// Proposes (FIPA00029), and waits for the decision: the value is whether the proposal is accepted. An accepted one
    /// is followed by the result.
    fn propose(&self, content: &Bound<'_, PyAny>) -> PyResult<Pending> {
        self.send(content.py(), Command::Propose(self::content(content)?))
    }

    /// Sends the result, or the answer: the last message. It also confirms a cancel.
    fn inform(&self, content: &Bound<'_, PyAny>) -> PyResult<Pending> {
        self.last(content.py(), Reply::Inform(self::content(content)?))
    }

    /// Refuses: the last message.
    #[pyo3(signature = (reason=""))]
    fn refuse(&self, py: Python<'_>, reason: &str) -> PyResult<Pending> {
        self.last(py, Reply::Refuse(Bytes::copy_from_slice(reason.as_bytes())))
    }

    /// Reports a failure: the last message.
    #[pyo3(signature = (reason=""))]
    fn fail(&self, py: Python<'_>, reason: &str) -> PyResult<Pending> {
        self.last(
            py,
            Reply::Failure(Bytes::copy_from_slice(reason.as_bytes())),
        )
    }

    /// Whether the initiator has cancelled the conversation, or is gone.
    #[getter]
    fn is_cancelled(&self) -> bool {
        self.cancelled.borrow().is_some()
    }

    /// Whether the program has sent the last message.
    #[getter]
    fn is_over(&self) -> bool {
        self.conversation.lock().is_none()
    }

    /// Waits until the initiator cancels the conversation or is gone. It never comes after the last message.
    fn cancelled(&self) -> Pending {
        let mut cancelled = self.cancelled.clone();
        Pending::begun(async move {
            if cancelled.wait_for(Option::is_some).await.is_err() {
                std::future::pending::<()>().await;
            }
            Ok(nothing())
        })
    }

    fn __enter__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    #[pyo3(signature = (*_exception))]
    fn __exit__(&self, _exception: &Bound<'_, PyTuple>) {
        *self.conversation.lock() = None;
    }
}

impl std::fmt::Debug for Task {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Task").finish_non_exhaustive()
    }
}
