//! Checks the messages of this process's agents against their protocols: one monitor per agent, and
//! the reaction that the configuration demands.
//!
//! Not in this module: the rules of the protocols (`fipa-monitor`).

use std::fmt;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use fipa_acl::{Message, MessageView, Performative};
use fipa_monitor::{
    Header, Library, LibraryError, LibraryFull, Limits, Monitor, Now, Verdict, Violation,
};
use parking_lot::Mutex;

use crate::config::{self, Check};
use crate::error::{ProtocolError, SendError};
use crate::incoming::Incoming;

/// The settings of `[monitor]` and the known protocols, for all agents of this process.
pub(crate) struct Rules {
    library: Arc<Library>,
    check: Check,
    answer: bool,
    heartbeat: Duration,
    limits: Limits,
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
        let mut limits = Limits::default();
        limits.idle = config.idle;
        limits.conversations = config.conversations;
        limits.bytes = usize::try_from(config.bytes).unwrap_or(usize::MAX);
        Ok(Self {
            limits,
            library: Arc::new(library),
            check: config.check,
            answer: config.answer,
            heartbeat: config.heartbeat,
        })
    }

    /// Returns the silence of another host after which its agents count as unreachable.
    pub(crate) fn heartbeat(&self) -> Duration {
        self.heartbeat
    }

    /// Returns the known protocols.
    pub(crate) fn library(&self) -> &Arc<Library> {
        &self.library
    }

    /// Creates the checks of an agent.
    pub(crate) fn checks(&self, agent: &str) -> Checks {
        let monitored = (self.check != Check::Off).then(|| Monitored {
            monitor: Mutex::new(
                Monitor::agent(Arc::clone(&self.library), agent).with_limits(self.limits),
            ),
            enforce: self.check == Check::Enforce,
            answer: self.answer,
        });
        Checks(monitored)
    }
}

/// The checks of one agent; empty if the configuration turns them off.
pub(crate) struct Checks(Option<Monitored>);

/// The monitor of one agent.
struct Monitored {
    monitor: Mutex<Monitor>,
    enforce: bool,
    answer: bool,
}

impl Checks {
    /// Checks a message that is about to be sent.
    pub(crate) fn leaving(&self, message: &Message) -> Result<(), SendError> {
        let Some(monitored) = &self.0 else {
            return Ok(());
        };
        match monitored.violation(message) {
            Some(violation) if monitored.enforce => Err(SendError::Violation(violation)),
            Some(violation) => {
                tracing::warn!("sent a message that violates its protocol: {violation}");
                Ok(())
            }
            None => Ok(()),
        }
    }

    /// Checks a received message. `answer` is called with the text of a violation that is to be
    /// answered with not-understood, and returns that answer if one was sent.
    pub(crate) fn arrived(
        &self,
        mut incoming: Incoming,
        answer: impl FnOnce(&Message, String) -> Option<Message>,
    ) -> Incoming {
        let Some(monitored) = &self.0 else {
            return incoming;
        };
        let Some(violation) = monitored.violation_in(&incoming.view()) else {
            return incoming;
        };
        // Not-understood and failure are never answered; otherwise two agents could answer each other
        // without end.
        let never_answered = [Performative::NotUnderstood, Performative::Failure];
        if monitored.answer
            && !never_answered.contains(incoming.message().performative())
            && let Some(answer) = answer(incoming.message(), violation.to_string())
        {
            // The answer ends the conversation in the monitor, if the sender takes part in one.
            let _ = monitored.violation(&answer);
        }
        tracing::warn!("received a message that violates its protocol: {violation}");
        incoming.violates(violation);
        incoming
    }
}

impl Monitored {
    fn violation(&self, message: &Message) -> Option<Box<Violation>> {
        let (act, id) = (message.performative(), message.conversation_id());
        self.check(&Header::from(message), act, id)
    }

    fn violation_in(&self, message: &MessageView<'_>) -> Option<Box<Violation>> {
        let id = message.conversation_id().map(|id| id.as_str());
        let act = message.performative_name();
        self.check(&Header::from(message), &act, id.as_deref())
    }

    fn check(
        &self,
        header: &Header<'_>,
        performative: &dyn fmt::Display,
        conversation: Option<&str>,
    ) -> Option<Box<Violation>> {
        let now = now();
        let mut monitor = self.monitor.lock();
        if monitor.poll_elapsed().is_some_and(|due| due <= now.elapsed) {
            for event in monitor.handle_timeout(now) {
                tracing::debug!(?event, "conversation");
            }
        }
        let verdict = monitor.check(header, now);
        tracing::trace!(
            %performative,
            conversation,
            accepted = verdict.is_accepted(),
            "checked"
        );
        match verdict {
            Verdict::Violation(violation) => Some(violation),
            _ => None,
        }
    }
}

/// Returns the current time. The monotonic clock counts while the machine is suspended.
fn now() -> Now {
    let elapsed = rustix::time::clock_gettime(rustix::time::ClockId::Boottime);
    let elapsed = Duration::try_from(elapsed).unwrap_or_default();
    Now::new(SystemTime::now(), elapsed)
}
