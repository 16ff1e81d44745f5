//! Domains: joining, the directory, and the routes.

use std::path::PathBuf;

use fipa::blocking::{self, Wait as _};
use fipa::config::Sources;
use fipa::{Config, Domain as Opened, Matcher, Query, RegisterOptions};
use fipa_bindings::{Failure, FailureKind, OrFail as _, flattened};
use futures_util::StreamExt as _;
use futures_util::stream::iter;
use pyo3::types::{PyAnyMethods, PyListMethods, PyMapping, PyMappingMethods, PyTuple};
use pyo3::{Bound, Py, PyAny, PyResult, Python, pyclass, pymethods};
use serde::Serialize;

use crate::agent::Agent;
use crate::events::Events;
use crate::failure::OrRaise as _;
use crate::interpreter::away;
use crate::kept::{Kept, own_process};
use crate::log;
use crate::pending::{Output, Pending};
use crate::value::to_python;

/// The membership of this process in a domain.
///
/// `Domain()` joins the domain that the environment configures: `$FIPA_CONFIG`, else `./fipa.toml`, else
/// `~/.config/fipa/fipa.toml`, else `/etc/fipa/fipa.toml`, else the defaults. `config` is another file. `settings`
/// override it: `Domain(settings={"domain": "test"})`. The end of the interpreter closes it, too.
#[pyclass(frozen, subclass, weakref, module = "fipa")]
#[derive(Debug)]
pub(crate) struct Domain {
    opened: Kept<Opened>,
}

#[pymethods]
impl Domain {
    #[new]
    #[pyo3(signature = (config=None, *, settings=None))]
    fn new(
        py: Python<'_>,
        config: Option<PathBuf>,
        settings: Option<&Bound<'_, PyMapping>>,
    ) -> PyResult<Self> {
        own_process(py)?;
        log::collect(py)?;
        let mut sources = Sources::from_environment();
        if config.is_some() {
            sources.file = config;
        }
        if let Some(settings) = settings {
            for entry in settings.items()?.iter() {
                let (key, value): (String, Bound<'_, PyAny>) = entry.extract()?;
                sources.set.push(format!("{key}={}", setting(&value)?));
            }
        }
        let opened = away(py, || {
            let config = Config::load(&sources).or_fail()?;
            blocking::start().or_fail()?;
            let opened = Opened::open(&config).wait().or_fail()?;
            async { opened.follow(sources) }.wait();
            Ok(opened)
        });
        Ok(Self {
            opened: Kept::new(opened.or_raise(py)?),
        })
    }

    /// Registers an agent. `type` is for searches, and `description` for people. Raises `NameTaken` if another agent has
    /// the name.
    #[pyo3(signature = (name, *, r#type="", description=""))]
    fn register(
        &self,
        py: Python<'_>,
        name: String,
        r#type: &str,
        description: &str,
    ) -> PyResult<Pending> {
        let opened = self.opened.get(py)?.clone();
        let options = RegisterOptions {
            agent_type: r#type.to_owned(),
            description: description.to_owned(),
        };
        Ok(Pending::lazy("Domain.register()", async move {
            let agent = opened.register_with(&name, options).await.or_fail()?;
            Ok(Box::new(|py: Python<'_>| Ok(Py::new(py, Agent::new(agent))?.into_any())) as Output)
        }))
    }

    /// Returns the known agents of this host and of others as dictionaries, with `name`, `type`, `description`, `role`,
    /// `reach` (`"local"` or `"remote"`), `locations` and others. `pattern` and `type` are names or patterns.
    #[pyo3(signature = (pattern=None, *, r#type=None))]
    fn agents(
        &self,
        py: Python<'_>,
        pattern: Option<&str>,
        r#type: Option<&str>,
    ) -> PyResult<Py<PyAny>> {
        let query = Query {
            name: matcher(py, pattern)?,
            agent_type: matcher(py, r#type)?,
            ..Query::all()
        };
        let mut found = self.opened.get(py)?.agents();
        found.retain(|entry| query.matches(entry));
        plain(py, &found)
    }

    /// Returns the routes of letters to the agents of a pattern.
    #[pyo3(signature = (pattern=None))]
    fn routes(&self, py: Python<'_>, pattern: Option<&str>) -> PyResult<Py<PyAny>> {
        let query = Query {
            name: matcher(py, pattern)?,
            ..Query::all()
        };
        plain(py, &self.opened.get(py)?.routes(&query))
    }

    /// Counts the contents of at least 1 KiB that have arrived through shared memory, as a dictionary. Those that are read
    /// there are `in_place`; those that were copied, because the program held too many in place, are `copied`.
    fn content_counts(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        plain(py, &self.opened.get(py)?.content_counts())
    }

    /// Follows the directory: dictionaries with `change` (`"joined"`, `"changed"` or `"left"`) and `agent`. The change is
    /// `"lagged"`, without an agent, if the program was too slow and has missed changes.
    fn changes(&self, py: Python<'_>) -> PyResult<Events> {
        let changes = self.opened.get(py)?.changes();
        let changes = changes.flat_map(|change| iter(flattened(&change)));
        Ok(Events::new(changes.map(|change| {
            Ok(Box::new(move |py: Python<'_>| to_python(py, &change)) as Output)
        })))
    }

    /// Leaves the domain, and deregisters its agents.
    fn close(&self, py: Python<'_>) -> PyResult<()> {
        let opened = self.opened.get(py)?.clone();
        away(py, || opened.close().wait());
        log::deliver_all(py)
    }

    fn __enter__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    #[pyo3(signature = (*_exception))]
    fn __exit__(&self, py: Python<'_>, _exception: &Bound<'_, PyTuple>) -> PyResult<()> {
        self.close(py)
    }
}

/// Writes a value of the configuration.
fn setting(value: &Bound<'_, PyAny>) -> PyResult<String> {
    match value.extract::<bool>() {
        Ok(value) => Ok(value.to_string()),
        Err(_) => Ok(value.str()?.to_string()),
    }
}

fn matcher(py: Python<'_>, text: Option<&str>) -> PyResult<Option<Matcher>> {
    text.map(Matcher::parse).transpose().or_fail().or_raise(py)
}

fn plain(py: Python<'_>, values: &impl Serialize) -> PyResult<Py<PyAny>> {
    let values = serde_json::to_value(values);
    let values = values.map_err(|error| Failure::new(FailureKind::Failed, error.to_string()));
    to_python(py, &values.or_raise(py)?)
}
