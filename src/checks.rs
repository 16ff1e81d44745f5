//! Whether the agents of this process keep to their protocols: each agent's own monitor, and what
//! the configuration wants done.
//!
//! What must not live here: what is right and wrong (that is `fipa-monitor`).

use std::path::PathBuf;
use std::sync::Arc;
use std::time::SystemTime;

use fipa_acl::{Message, Performative};
use fipa_monitor::scxml::ScxmlError;
use fipa_monitor::{Header, Library, LibraryError, LibraryFull, Monitor, Verdict, Violation};
use parking_lot::Mutex;

use crate::agent::{Agent, Incoming, ReceiveError, SendError};
use crate::config::{self, Check};

/// What the configuration wants of all agents of this process.
pub(crate) struct Rules {
    library: Arc<Library>,
    check: Check,
    answer: bool,
}

impl Rules {
    pub(crate) fn load(config: &config::Monitor) -> Result<Self, ProtocolError> {
        let mut library = Library::standard();
        for file in &config.protocols {
            let text = std::fs::read_to_string(file).map_err(|source| ProtocolError::Read {
                path: file.into(),
                source,
            })?;
            library.read(file, &text).map_err(|error| match error {
                LibraryError::Scxml(error) => ProtocolError::Scxml(error),
                _ => ProtocolError::Full(LibraryFull),
            })?;
        }
        Ok(Self {
            library: Arc::new(library),
            check: config.check,
            answer: config.answer,
        })
    }

    /// The protocols that are known.
    pub(crate) fn library(&self) -> &Arc<Library> {
        &self.library
    }

    /// What an agent of this name needs, if anything is checked.
    pub(crate) fn checks(&self, agent: &str) -> Option<Checks> {
        (self.check != Check::Off).then(|| Checks {
            monitor: Mutex::new(Monitor::agent(Arc::clone(&self.library), agent)),
            enforce: self.check == Check::Enforce,
            answer: self.answer,
        })
    }
}

/// An agent's monitor.
pub(crate) struct Checks {
    monitor: Mutex<Monitor>,
    enforce: bool,
    answer: bool,
}

impl Checks {
    /// Checks what is about to be sent.
    pub(crate) fn leaving(&self, message: &Message) -> Result<(), SendError> {
        match self.violation(message) {
            Some(violation) if self.enforce => Err(SendError::Violation(violation)),
            Some(violation) => {
                tracing::warn!("sent all the same: {violation}");
                Ok(())
            }
            None => Ok(()),
        }
    }

    /// Checks what has come.
    pub(crate) fn arrived(
        &self,
        agent: &Agent,
        mut incoming: Incoming,
    ) -> Result<Incoming, ReceiveError> {
        let Some(violation) = self.violation(&incoming.message) else {
            return Ok(incoming);
        };
        if self.answer {
            self.say_not_understood(agent, &incoming.message, &violation);
        }
        if self.enforce {
            let incoming = Box::new(incoming);
            return Err(ReceiveError::Violation {
                violation,
                incoming,
            });
        }
        tracing::warn!("received: {violation}");
        incoming.violation = Some(violation);
        Ok(incoming)
    }

    fn violation(&self, message: &Message) -> Option<Box<Violation>> {
        let now = SystemTime::now();
        let mut monitor = self.monitor.lock();
        if monitor.poll_timeout().is_some_and(|due| due <= now) {
            for event in monitor.handle_timeout(now) {
                tracing::debug!(?event, "conversation");
            }
        }
        let verdict = monitor.check(&Header::from(message), now);
        tracing::trace!(
            performative = %message.performative(),
            conversation = message.conversation_id(),
            accepted = verdict.is_accepted(),
            "checked"
        );
        match verdict {
            Verdict::Violation(violation) => Some(violation),
            _ => None,
        }
    }

    fn say_not_understood(&self, agent: &Agent, message: &Message, violation: &Violation) {
        // Two who do not understand each other must not go on telling so.
        let last_word = [Performative::NotUnderstood, Performative::Failure];
        if last_word.contains(message.performative()) {
            return;
        }
        let answer = agent
            .reply(message, Performative::NotUnderstood)
            .content(violation.to_string())
            .build();
        let posted = answer
            .map_err(|error| error.to_string())
            .and_then(|answer| {
                // For the monitor it ends the conversation, where the sender takes part in one.
                let _ = self.violation(&answer);
                agent.post_aside(&answer).map_err(|error| error.to_string())
            });
        if let Err(error) = posted {
            tracing::warn!(error, "a violation was not answered");
        }
    }
}

/// Why a protocol that the configuration names cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ProtocolError {
    /// The file cannot be read.
    #[error("monitor.protocols: cannot read {}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Why not.
        source: std::io::Error,
    },
    /// The file has mistakes.
    #[error("monitor.protocols: {0}; see `fipa protocol check`")]
    Scxml(#[from] ScxmlError),
    /// There are too many.
    #[error("monitor.protocols: {0}")]
    Full(#[from] LibraryFull),
}
