//! Messages of the program.

use std::time::SystemTime;

use fipa::{Agent, MessageBuilder, Performative, Time};
use fipa_bindings::{Failure, OrFail as _};
use pyo3::buffer::PyBuffer;
use pyo3::intern;
use pyo3::types::{
    PyAnyMethods, PyBytes, PyBytesMethods, PyListMethods, PyMapping, PyMappingMethods,
    PyMemoryView, PyString, PyStringMethods,
};
use pyo3::{Bound, Py, PyAny, PyErr, PyResult, Python};

use crate::failure::OrRaise as _;
use crate::letter::Letter;
use crate::lock::Lock;
use crate::membership::Membership;

/// A content of the program, which does not change during a call.
pub(crate) enum Content<'py> {
    Text(Bound<'py, PyString>),
    Bytes(Bound<'py, PyBytes>),
    Buffer(PyBuffer<u8>),
}

impl<'py> Content<'py> {
    /// Reads a `str`, `bytes`, or an object with a contiguous buffer, such as an array.
    pub(crate) fn read(content: &Bound<'py, PyAny>) -> PyResult<Self> {
        if let Ok(text) = content.cast::<PyString>() {
            return Ok(Self::Text(text.clone()));
        }
        if let Ok(bytes) = content.cast::<PyBytes>() {
            return Ok(Self::Bytes(bytes.clone()));
        }
        let view = PyMemoryView::from(content)?;
        let bytes = view.call_method1("cast", ("B",))?;
        Ok(Self::Buffer(PyBuffer::get(&bytes)?))
    }

    pub(crate) fn len(&self) -> PyResult<usize> {
        Ok(match self {
            Self::Text(text) => text.to_str()?.len(),
            Self::Bytes(bytes) => bytes.as_bytes().len(),
            Self::Buffer(buffer) => buffer.len_bytes(),
        })
    }

    /// Writes the content into memory of its length.
    pub(crate) fn write(&self, py: Python<'_>, to: &mut [u8]) -> PyResult<()> {
        match self {
            Self::Text(text) => to.copy_from_slice(text.to_str()?.as_bytes()),
            Self::Bytes(bytes) => to.copy_from_slice(bytes.as_bytes()),
            Self::Buffer(buffer) => buffer.copy_to_slice(py, to)?,
        }
        Ok(())
    }

    /// Copies a content.
    pub(crate) fn copied(content: &Bound<'py, PyAny>) -> PyResult<Vec<u8>> {
        let read = Self::read(content)?;
        let mut bytes = vec![0; read.len()?];
        read.write(content.py(), &mut bytes)?;
        Ok(bytes)
    }
}

/// A message of the program (`fipa.Message`).
pub(crate) struct Draft<'py> {
    pub(crate) act: Performative,
    message: Bound<'py, PyAny>,
    pub(crate) receivers: Vec<String>,
}

impl<'py> Draft<'py> {
    /// Reads a message. `default` is the act of one that has none.
    pub(crate) fn read(
        message: &Bound<'py, PyAny>,
        default: Option<Performative>,
    ) -> PyResult<Self> {
        let py = message.py();
        let act: String = message.getattr(intern!(py, "performative"))?.extract()?;
        let act = match (act.is_empty(), default) {
            (true, Some(default)) => default,
            (true, None) => {
                return Err(Failure::invalid("the performative is missing")).or_raise(py);
            }
            (false, _) => act.parse::<Performative>().or_fail().or_raise(py)?,
        };
        Ok(Self {
            act,
            receivers: names(&message.getattr(intern!(py, "receivers"))?)?,
            message: message.clone(),
        })
    }

    pub(crate) fn content(&self) -> PyResult<Option<Content<'py>>> {
        let py = self.message.py();
        let content = self.message.getattr(intern!(py, "content"))?;
        (!content.is_none())
            .then(|| Content::read(&content))
            .transpose()
    }

    /// Creates the message of an agent, without receivers and content.
    pub(crate) fn without_receivers(&self, agent: &Agent) -> PyResult<MessageBuilder> {
        self.complete(agent.message(self.act.clone()))
    }

    /// Creates the message of an agent, without content.
    pub(crate) fn without_content(&self, agent: &Agent) -> PyResult<MessageBuilder> {
        Ok(self.addressed(self.without_receivers(agent)?))
    }

    /// Creates an answer, without content. What the message sets takes precedence.
    pub(crate) fn answering(&self, agent: &Agent, letter: &Letter) -> PyResult<MessageBuilder> {
        let reply = letter.read(|message| agent.reply(message, self.act.clone()))?;
        Ok(self.addressed(self.complete(reply)?))
    }

    fn addressed(&self, builder: MessageBuilder) -> MessageBuilder {
        match self.receivers.is_empty() {
            true => builder,
            false => builder.replace_receivers(&self.receivers),
        }
    }

    /// Creates the message of an agent with a copy of the content.
    pub(crate) fn whole(&self, agent: &Agent) -> PyResult<MessageBuilder> {
        self.with_content(self.without_content(agent)?)
    }

    /// Adds a copy of the content.
    pub(crate) fn with_content(&self, builder: MessageBuilder) -> PyResult<MessageBuilder> {
        let py = self.message.py();
        let content = self.message.getattr(intern!(py, "content"))?;
        match content.is_none() {
            true => Ok(builder),
            false => Ok(builder.content(Content::copied(&content)?)),
        }
    }

    /// Adds all parameters but the act, the sender, the receivers and the content.
    fn complete(&self, mut builder: MessageBuilder) -> PyResult<MessageBuilder> {
        let py = self.message.py();
        for agent in names(&self.message.getattr(intern!(py, "reply_to"))?)? {
            builder = builder.reply_to(agent.as_str());
        }
        type Set = fn(MessageBuilder, String) -> MessageBuilder;
        let parameters: [(&Bound<'_, PyString>, Set); 7] = [
            (intern!(py, "language"), MessageBuilder::language),
            (intern!(py, "encoding"), MessageBuilder::encoding),
            (intern!(py, "ontology"), MessageBuilder::ontology),
            (intern!(py, "protocol"), MessageBuilder::protocol),
            (
                intern!(py, "conversation_id"),
                MessageBuilder::conversation_id,
            ),
            (intern!(py, "reply_with"), MessageBuilder::reply_with),
            (intern!(py, "in_reply_to"), MessageBuilder::in_reply_to),
        ];
        for (name, set) in parameters {
            let value: Option<String> = self.message.getattr(name)?.extract()?;
            if let Some(value) = value {
                builder = set(builder, value);
            }
        }
        let by: Option<SystemTime> = self.message.getattr(intern!(py, "reply_by"))?.extract()?;
        if let Some(by) = by {
            builder = builder.reply_by(Time::from_system_time(by).or_fail().or_raise(py)?);
        }
        let parameters = self.message.getattr(intern!(py, "parameters"))?;
        for parameter in parameters.cast::<PyMapping>()?.items()?.iter() {
            let (name, value): (String, String) = parameter.extract()?;
            builder = builder.user_defined(&name, &value);
        }
        let lock = self.message.getattr(intern!(py, "lock"))?;
        guarded(&lock, builder)
    }
}

/// Adds the fences of a lock, or of the membership in a coalition that the agent leads.
fn guarded(lock: &Bound<'_, PyAny>, builder: MessageBuilder) -> PyResult<MessageBuilder> {
    if lock.is_none() {
        return Ok(builder);
    }
    if let Ok(member) = lock.cast::<Membership>() {
        return member.get().guard(lock.py(), builder);
    }
    let lock: &Bound<'_, Lock> = lock.cast().map_err(PyErr::from)?;
    lock.get().guard(builder)
}

/// Reads names: a text, or a sequence of texts.
pub(crate) fn names(of: &Bound<'_, PyAny>) -> PyResult<Vec<String>> {
    match of.cast::<PyString>() {
        Ok(one) => Ok(vec![one.to_str()?.to_owned()]),
        Err(_) => of.extract(),
    }
}

/// An argument that is a lock or `None`.
pub(crate) type LockArgument = Option<Py<Lock>>;
