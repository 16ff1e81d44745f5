//! Agents of this host whose process is stopped: they take no letter until it continues.

use std::fmt::{self, Display, Formatter};
use std::sync::Arc;

use fipa_acl::escape_name;

use crate::{Config, Domain, Entry, Reach, Role};

/// An agent of this host whose process is stopped. Its text names the agent and the process.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct StoppedAgent {
    /// The name of the agent.
    pub name: Arc<str>,
    /// The identifier of its process.
    pub process: u32,
}

impl StoppedAgent {
    /// Returns the agent of this entry if it is one of this host and its process is stopped.
    #[must_use]
    pub fn of(entry: &Entry) -> Option<Self> {
        // The name of the service of a process ends with the identifier of the process.
        let service = entry.mts.name.as_deref();
        let service =
            service.filter(|_| entry.reach == Reach::Local && entry.role == Role::Agent)?;
        let (_, process) = service.rsplit_once('-')?;
        let process: u32 = process.parse().ok()?;
        is_stopped(process).then(|| Self {
            name: Arc::clone(&entry.name),
            process,
        })
    }

    /// Returns the stopped agents of the domain of the configuration, sorted by name, without joining the domain, as
    /// [`Domain::names`] does.
    ///
    /// # Errors
    /// If the directory of the domain cannot be used.
    pub fn all(config: &Config) -> Result<Vec<Self>, crate::error::OpenError> {
        let entries = Domain::peek(config)?;
        Ok(entries.iter().filter_map(|it| Self::of(it)).collect())
    }

    /// Returns the remedy as text.
    #[must_use]
    pub fn remedy(&self) -> String {
        format!("continue it: `kill -CONT {}`", self.process)
    }

    /// Returns the text with the remedy.
    #[must_use]
    pub fn advice(&self) -> String {
        format!("{self}; {}", self.remedy())
    }
}

impl Display for StoppedAgent {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "the process {} of {} is stopped, by SIGSTOP, Ctrl-Z or a debugger",
            self.process,
            escape_name(&self.name)
        )
    }
}

fn is_stopped(process: u32) -> bool {
    let stat = std::fs::read_to_string(format!("/proc/{process}/stat"));
    // The name of the program is in parentheses and may contain any character.
    let state = stat.as_ref().ok().and_then(|stat| {
        let (_, after_name) = stat.rsplit_once(')')?;
        after_name.split_whitespace().next()
    });
    matches!(state, Some("T" | "t"))
}
