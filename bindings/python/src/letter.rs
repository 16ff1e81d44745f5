//! Letters that the program reads.

use bytes::Bytes;
use fipa::protocol::Notification;
use fipa::{AgentId, Incoming, Kind, Message};
use parking_lot::Mutex;
use pyo3::exceptions::{PyUnicodeDecodeError, PyValueError};
use pyo3::types::{PyBytes, PyDict, PyDictMethods as _, PyMemoryView, PyTuple};
use pyo3::{Bound, Py, PyAny, PyResult, Python, pyclass, pymethods};
use std::sync::Arc;
use std::time::SystemTime;

use crate::buffer::view;
use crate::interpreter::call;
use crate::pending::Output;
use crate::value::sl_loads;

/// A letter that has arrived: a message (FIPA00061), and what is known of its way.
///
/// `content` is read in place, and may be in shared memory of the sender. A view of it holds that memory, of which a
/// process has a bounded amount: `with letter:` frees it at the end of the block, and `bytes(letter.content)` copies it.
#[pyclass(frozen, module = "fipa")]
#[derive(Debug)]
pub(crate) struct Letter {
    source: Mutex<Option<Arc<Source>>>,
    /// The view that the program has of the content.
    content: Mutex<Option<Py<PyMemoryView>>>,
    notified: Option<Notified>,
}

#[derive(Debug)]
enum Source {
    Incoming(Box<Incoming>),
    Message(Box<Message>),
}

/// What is known of a notification.
#[derive(Debug)]
struct Notified {
    missed: u64,
    number: Option<u64>,
    age: Option<f64>,
}

impl From<Incoming> for Letter {
    fn from(incoming: Incoming) -> Self {
        Self::of(Source::Incoming(Box::new(incoming)), None)
    }
}

impl From<Message> for Letter {
    fn from(message: Message) -> Self {
        Self::of(Source::Message(Box::new(message)), None)
    }
}

impl From<Notification> for Letter {
    fn from(notification: Notification) -> Self {
        let notified = Notified {
            missed: notification.missed(),
            number: notification.number(),
            age: notification.age().map(|age| age.as_secs_f64()),
        };
        let message = Box::new(notification.into_message());
        Self::of(Source::Message(message), Some(notified))
    }
}

impl Source {
    fn message(&self) -> &Message {
        match self {
            Self::Incoming(incoming) => incoming.message(),
            Self::Message(message) => message,
        }
    }

    /// Returns the content, without decoding the other parameters.
    fn content(&self) -> Bytes {
        let content = match self {
            Self::Incoming(incoming) => incoming.content(),
            Self::Message(message) => message.content().cloned(),
        };
        content.unwrap_or_default()
    }
}

impl Letter {
    fn of(source: Source, notified: Option<Notified>) -> Self {
        Self {
            source: Mutex::new(Some(Arc::new(source))),
            content: Mutex::new(None),
            notified,
        }
    }

    fn source(&self) -> PyResult<Arc<Source>> {
        let source = self.source.lock();
        let released = || PyValueError::new_err("the letter was released");
        source.clone().ok_or_else(released)
    }

    /// Reads the message.
    pub(crate) fn read<R>(&self, read: impl FnOnce(&Message) -> R) -> PyResult<R> {
        Ok(read(self.source()?.message()))
    }

    fn text(&self, read: impl FnOnce(&Message) -> Option<&str>) -> PyResult<Option<String>> {
        self.read(|message| read(message).map(str::to_owned))
    }
}

/// The output of a future that ends with a letter.
pub(crate) fn output(letter: impl Into<Letter> + Send + 'static) -> Output {
    Box::new(|py| Ok(Py::new(py, letter.into())?.into_any()))
}

#[pymethods]
impl Letter {
    /// The act, such as `"request"` or `"inform"`.
    #[getter]
    fn performative(&self) -> PyResult<String> {
        self.read(|message| message.performative().as_str().to_owned())
    }

    /// The name of the sender.
    #[getter]
    fn sender(&self) -> PyResult<Option<String>> {
        self.text(|message| message.sender().map(AgentId::name))
    }

    /// The names of the receivers.
    #[getter]
    fn receivers<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyTuple>> {
        names(py, self.source()?.message().receivers())
    }

    /// The names of the agents that get the answers instead of the sender.
    #[getter]
    fn reply_to<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyTuple>> {
        names(py, self.source()?.message().reply_to())
    }

    /// The content as a read-only view, without a copy.
    #[getter]
    fn content(&self, py: Python<'_>) -> PyResult<Py<PyMemoryView>> {
        let source = self.source()?;
        if let Some(content) = &*self.content.lock() {
            return Ok(content.clone_ref(py));
        }
        let created = view(py, source.content())?;
        *self.content.lock() = Some(created.clone_ref(py));
        Ok(created)
    }

    /// The content as a text in UTF-8.
    #[getter(text)]
    fn content_text(&self, py: Python<'_>) -> PyResult<String> {
        let content = self.source()?.content();
        match str::from_utf8(&content) {
            Ok(text) => Ok(text.to_owned()),
            Err(error) => Err(PyUnicodeDecodeError::new_err_from_utf8(py, &content, error)),
        }
    }

    /// Reads the content as an expression of SL (FIPA00008).
    fn sl(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        sl_loads(py, &self.content_text(py)?)
    }

    /// The language of the content.
    #[getter]
    fn language(&self) -> PyResult<Option<String>> {
        self.text(|message| message.language())
    }

    /// The encoding of the content.
    #[getter]
    fn encoding(&self) -> PyResult<Option<String>> {
        self.text(|message| message.encoding())
    }

    /// The ontology of the content.
    #[getter]
    fn ontology(&self) -> PyResult<Option<String>> {
        self.text(|message| message.ontology())
    }

    /// The interaction protocol, such as `"fipa-request"`.
    #[getter]
    fn protocol(&self) -> PyResult<Option<String>> {
        self.text(|message| message.protocol())
    }

    /// The conversation identifier.
    #[getter]
    fn conversation_id(&self) -> PyResult<Option<String>> {
        self.text(|message| message.conversation_id())
    }

    /// The text that an answer has as its `in_reply_to`.
    #[getter]
    fn reply_with(&self) -> PyResult<Option<String>> {
        self.text(|message| message.reply_with())
    }

    /// The `reply_with` of the message that this one answers.
    #[getter]
    fn in_reply_to(&self) -> PyResult<Option<String>> {
        self.text(|message| message.in_reply_to())
    }

    /// The time by which an answer is due, as a `datetime` in UTC.
    #[getter]
    fn reply_by(&self) -> PyResult<Option<SystemTime>> {
        let by = self.read(Message::reply_by)?;
        Ok(by.map(|by| by.to_system_time(SystemTime::now())))
    }

    /// The user-defined parameters.
    #[getter]
    fn parameters<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let parameters = PyDict::new(py);
        for (name, value) in self.source()?.message().user_defined() {
            parameters.set_item(name, value)?;
        }
        Ok(parameters)
    }

    /// The transport that handed the letter to this process. `None` for a letter of this process itself, and for a
    /// message that a conversation has read.
    #[getter]
    fn via(&self) -> PyResult<Option<&'static str>> {
        Ok(match &*self.source()? {
            Source::Incoming(incoming) => incoming.via.map(Kind::name),
            Source::Message(_) => None,
        })
    }

    /// Whether the content is read in shared memory of the sender. A process has a bounded number of such contents: at most
    /// 15 of one sender. It gets copies of further ones.
    #[getter]
    fn in_place(&self) -> PyResult<bool> {
        Ok(fipa::is_in_place(&self.source()?.content()))
    }

    /// How the message violates its protocol, if `monitor.check` is `warn` or `enforce`.
    #[getter]
    fn violation(&self) -> PyResult<Option<String>> {
        Ok(match &*self.source()? {
            Source::Incoming(incoming) => incoming.violation().map(ToString::to_string),
            Source::Message(_) => None,
        })
    }

    /// Number of the notifications of the topic that were missed just before this one.
    #[getter]
    fn missed(&self) -> u64 {
        self.notified.as_ref().map_or(0, |it| it.missed)
    }

    /// The number of the notification, if the publisher counts them.
    #[getter]
    fn number(&self) -> Option<u64> {
        self.notified.as_ref().and_then(|it| it.number)
    }

    /// The time in seconds from the publication to the arrival, if the publisher reports it.
    #[getter]
    fn age(&self) -> Option<f64> {
        self.notified.as_ref().and_then(|it| it.age)
    }

    /// Returns the parameters that are set as a dictionary, with the content as a text.
    fn to_dict(slf: Bound<'_, Self>) -> PyResult<Py<PyAny>> {
        Ok(call(slf.py(), "fipa._message", "letter_to_dict", (slf,))?.unbind())
    }

    /// Ends the view of the content; the letter cannot be read afterwards. The memory is free unless another object, such
    /// as an array of numpy, still reads it.
    fn release(&self, py: Python<'_>) -> PyResult<()> {
        if let Some(content) = &*self.content.lock() {
            content.call_method0(py, "release")?;
        }
        *self.content.lock() = None;
        *self.source.lock() = None;
        Ok(())
    }

    fn __enter__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    #[pyo3(signature = (*_exception))]
    fn __exit__(&self, py: Python<'_>, _exception: &Bound<'_, PyTuple>) -> PyResult<()> {
        self.release(py)
    }

    fn __bytes__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyBytes>> {
        Ok(PyBytes::new(py, &self.source()?.content()))
    }

    fn __repr__(&self) -> String {
        match self.read(|message| format!("<fipa.Letter {}>", message.performative())) {
            Ok(text) => text,
            Err(_) => "<fipa.Letter released>".to_owned(),
        }
    }

    fn __str__(&self) -> PyResult<String> {
        self.read(ToString::to_string)
    }
}

fn names<'py>(py: Python<'py>, agents: &[AgentId]) -> PyResult<Bound<'py, PyTuple>> {
    PyTuple::new(py, agents.iter().map(AgentId::name))
}
