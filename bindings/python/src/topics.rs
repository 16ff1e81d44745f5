//! Topics: publishing and subscribing.

use std::ffi::c_int;
use std::sync::Arc;
use std::time::Duration;

use fipa::Performative;
use fipa::blocking::Wait as _;
use fipa::protocol::Keep;
use fipa::topics::{Publisher as Opened, Topic, TopicLoan as OpenLoan};
use fipa_bindings::{Failure, FailureKind, OrFail as _, script};
use parking_lot::Mutex;
use pyo3::types::PyTuple;
use pyo3::{Bound, IntoPyObject as _, Py, PyAny, PyResult, Python, ffi, pyclass, pymethods};

use crate::agent::Agent;
use crate::buffer::{Lent, Writable};
use crate::events::Events;
use crate::failure::OrRaise as _;
use crate::interpreter::call;
use crate::letter;
use crate::message::Content;
use crate::pending::{Output, Pending, seconds};

/// Time for the answer to a subscription, if the program sets none.
const TIMEOUT: Duration = Duration::from_secs(30);

#[pymethods]
impl Agent {
    /// Publishes a topic. `media_type` is for users. Each notification carries `language` and `ontology`.
    ///
    /// With a `rate` in notifications per second, the topic is a stream: subscribers get the newest notification. A
    /// new subscriber gets the `latched` newest contents, at most 64.
    #[pyo3(signature = (topic, *, media_type=None, language=None, ontology=None, rate=None, latched=0))]
    #[allow(clippy::too_many_arguments, reason = "most are options with a name")]
    fn publisher(
        &self,
        py: Python<'_>,
        topic: &str,
        media_type: Option<&str>,
        language: Option<&str>,
        ontology: Option<&str>,
        rate: Option<f64>,
        latched: usize,
    ) -> PyResult<Publisher> {
        let agent = self.registered(py)?;
        let mut described = Topic::new(topic).latched(latched);
        if let Some(media_type) = media_type {
            described = described.media_type(media_type);
        }
        if let Some(language) = language {
            described = described.language(language);
        }
        if let Some(ontology) = ontology {
            described = described.ontology(ontology);
        }
        if let Some(rate) = rate {
            described = described.rate(rate);
        }
        let opened = async { agent.publisher(described) }.wait();
        Ok(Publisher {
            opened: Mutex::new(Some(Arc::new(opened.or_fail().or_raise(py)?))),
        })
    }

    /// Subscribes to a topic of an agent: its notifications are letters. `keep` says which are wanted: `"all"`, or
    /// `"latest N"`.
    ///
    /// A wait raises `Interrupted` when the publisher or its host is lost; the subscription goes on when it returns, and
    /// the program may wait again.
    #[pyo3(signature = (agent, topic, *, keep=None, timeout=None))]
    fn subscribe(
        &self,
        py: Python<'_>,
        agent: &str,
        topic: &str,
        keep: Option<&str>,
        timeout: Option<f64>,
    ) -> PyResult<Events> {
        let own = self.registered(py)?.clone();
        let keep = match keep {
            None => Ok(Keep::Auto),
            Some(text) => text
                .parse::<Keep>()
                .map_err(|error| Failure::invalid(error.to_string())),
        };
        let keep = keep.or_raise(py)?;
        let timeout = seconds(timeout)?.unwrap_or(TIMEOUT);
        let message = own
            .message(Performative::Subscribe)
            .receiver(agent)
            .content(topic.to_owned());
        Ok(Events::new(script(async move |emitter| {
            let subscribed = own.subscribe_keeping(keep, message, timeout).await;
            let mut subscription = subscribed.or_fail()?;
            loop {
                let event: Output = match subscription.next().await {
                    Ok(notification) => letter::output(notification),
                    Err(error) if subscription.goes_on() => interrupted(Failure::of(error)),
                    Err(error) => return Err(Failure::of(error)),
                };
                emitter.emit(event).await;
            }
        })))
    }
}

/// Raises that a subscription is interrupted.
fn interrupted(failure: Failure) -> Output {
    Box::new(move |py| {
        let error = call(py, "fipa._errors", "Interrupted", (failure.text,))?;
        Err(pyo3::PyErr::from_value(error))
    })
}

/// A topic that the agent publishes.
#[pyclass(frozen, module = "fipa")]
pub(crate) struct Publisher {
    /// `None` after `close`.
    opened: Mutex<Option<Arc<Opened>>>,
}

impl Publisher {
    fn opened(&self, py: Python<'_>) -> PyResult<Arc<Opened>> {
        let over = || Failure::new(FailureKind::Closed, "the publisher is closed");
        self.opened.lock().clone().ok_or_else(over).or_raise(py)
    }
}

fn number(count: usize) -> Output {
    Box::new(move |py| Ok(count.into_pyobject(py)?.into_any().unbind()))
}

#[pymethods]
impl Publisher {
    /// Notifies all subscribers. The value is their number. A wait lasts only if a subscriber that wants all
    /// notifications is slow, at most 5 s.
    fn publish(&self, content: &Bound<'_, PyAny>) -> PyResult<Pending> {
        let opened = self.opened(content.py())?;
        let content = Content::copied(content)?;
        Ok(Pending::lazy("Publisher.publish()", async move {
            Ok(number(opened.publish(content).await.subscribers()))
        }))
    }

    /// Loans memory of `length` bytes for a notification, which subscribers on this host read in place.
    fn loan(&self, py: Python<'_>, length: usize) -> PyResult<TopicLoan> {
        let opened = self.opened(py)?;
        let loan = opened.loan(length).or_fail().or_raise(py)?;
        Ok(TopicLoan {
            publisher: opened,
            lent: Lent::new(loan),
        })
    }

    /// Number of the subscribers.
    #[getter]
    fn subscribers(&self, py: Python<'_>) -> PyResult<usize> {
        Ok(self.opened(py)?.subscribers())
    }

    /// Ends the publication.
    fn close(&self) {
        *self.opened.lock() = None;
    }

    fn __enter__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    #[pyo3(signature = (*_exception))]
    fn __exit__(&self, _exception: &Bound<'_, PyTuple>) {
        self.close();
    }
}

impl std::fmt::Debug for Publisher {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Publisher").finish_non_exhaustive()
    }
}

/// Memory for a notification. It is a writable buffer: `memoryview(loan)`, `numpy.frombuffer(loan, ...)`.
#[pyclass(frozen, module = "fipa")]
pub(crate) struct TopicLoan {
    publisher: Arc<Opened>,
    lent: Lent<OpenLoan>,
}

impl Writable for OpenLoan {
    fn memory(&mut self) -> &mut [u8] {
        self.content_mut()
    }
}

#[pymethods]
impl TopicLoan {
    /// Notifies all subscribers, as `Publisher.publish`. Raises `BufferError` as long as a view of the loan exists.
    fn publish(&self) -> PyResult<Pending> {
        let loan = self.lent.take()?;
        let publisher = Arc::clone(&self.publisher);
        Ok(Pending::lazy("TopicLoan.publish()", async move {
            Ok(number(publisher.publish_loan(loan).await.subscribers()))
        }))
    }

    fn __len__(&self) -> usize {
        self.lent.len()
    }

    #[allow(unsafe_code, reason = "the form that CPython prescribes")]
    unsafe fn __getbuffer__(
        slf: Bound<'_, Self>,
        view: *mut ffi::Py_buffer,
        flags: c_int,
    ) -> PyResult<()> {
        let lent = slf.get();
        // SAFETY: CPython passes a view that can be written. The loan belongs to the object.
        unsafe { lent.lent.export(slf.clone().into_any(), view, flags) }
    }

    #[allow(unsafe_code, reason = "the form that CPython prescribes")]
    unsafe fn __releasebuffer__(&self, _view: *mut ffi::Py_buffer) {
        self.lent.release();
    }
}

impl std::fmt::Debug for TopicLoan {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("TopicLoan").finish_non_exhaustive()
    }
}
