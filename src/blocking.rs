//! Blocking calls for processes without an async runtime.
//!
//! A background thread receives and acknowledges letters while the application does other work. It
//! sleeps when it has nothing to do.

#[cfg(feature = "monitor")]
mod platform;
#[cfg(feature = "monitor")]
mod protocol;

use std::ops::Deref;
use std::sync::Arc;
use std::time::Duration;

use fipa_acl::{Message, MessageBuilder, Performative};
use fipa_sds::{Cancellation, DeregisterError, RegisterError};
use tokio::runtime::{Builder, Runtime};

use crate::owner::Owner;
use crate::{
    AgentId, Config, Deliveries, DirectoryView, Incoming, Loan, ReceiveError, SendError, Unread,
};

#[cfg(feature = "monitor")]
pub use self::platform::{Ams, Df, Notifications};
#[cfg(feature = "monitor")]
pub use self::protocol::Side;

/// The error of [`Domain::open`].
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum OpenError {
    /// The background thread cannot be started.
    #[error("cannot start the background thread")]
    Thread(#[from] std::io::Error),
    /// The domain cannot be joined.
    #[error(transparent)]
    Domain(#[from] crate::OpenError),
}

/// The membership of this process in a domain; see [`crate::Domain`].
#[derive(Debug, Clone)]
pub struct Domain {
    // Declared first, because it must be dropped before the runtime that it uses.
    domain: crate::Domain,
    runtime: Background,
}

/// An agent of this process; see [`crate::Agent`].
#[derive(Debug)]
pub struct Agent {
    agent: crate::Agent,
    runtime: Background,
}

/// The runtime of the background thread.
#[derive(Debug, Clone)]
struct Background {
    runtime: Arc<Runtime>,
    owner: Owner,
}

impl Background {
    fn start() -> std::io::Result<Self> {
        let runtime = Builder::new_multi_thread()
            .worker_threads(1)
            .thread_name("fipa")
            .enable_all()
            .build()?;
        Ok(Self {
            runtime: Arc::new(runtime),
            owner: Owner::this(),
        })
    }
}

impl Deref for Background {
    type Target = Runtime;

    fn deref(&self) -> &Runtime {
        &self.runtime
    }
}

impl Drop for Background {
    fn drop(&mut self) {
        if !self.owner.is_this() {
            // A forked child does not have the thread, and the runtime would wait for its end forever.
            std::mem::forget(Arc::clone(&self.runtime));
        }
    }
}

impl Domain {
    /// Joins the domain that the configuration names; see [`crate::Domain::open`].
    ///
    /// # Errors
    /// If the background thread cannot be started, or as for [`crate::Domain::open`].
    pub fn open(config: &Config) -> Result<Self, OpenError> {
        let runtime = Background::start()?;
        let domain = runtime.block_on(crate::Domain::open(config))?;
        Ok(Self { domain, runtime })
    }

    /// Registers an agent with a name and without further description.
    ///
    /// # Errors
    /// See [`crate::Domain::register_with`].
    pub fn register(&self, name: &str) -> Result<Agent, RegisterError> {
        self.register_with(name, crate::RegisterOptions::default())
    }

    /// Registers an agent; see [`crate::Domain::register_with`].
    ///
    /// # Errors
    /// See [`crate::Domain::register_with`].
    pub fn register_with(
        &self,
        name: &str,
        options: crate::RegisterOptions,
    ) -> Result<Agent, RegisterError> {
        let agent = self
            .domain
            .register_unless(name, options, &Cancellation::new())?;
        Ok(Agent {
            agent,
            runtime: self.runtime.clone(),
        })
    }

    /// Returns the directory; see [`crate::Domain::directory`].
    #[must_use]
    pub fn directory(&self) -> DirectoryView<'_> {
        self.domain.directory()
    }

    /// Leaves the domain; see [`crate::Domain::close`].
    pub fn close(self) {
        self.runtime.block_on(self.domain.close());
    }
}

impl Agent {
    /// Returns the name of the agent.
    #[must_use]
    pub fn name(&self) -> &str {
        self.agent.name()
    }

    /// Returns the agent identifier that the agent's messages have as their sender.
    #[must_use]
    pub fn id(&self) -> &AgentId {
        self.agent.id()
    }

    /// Starts a message with this agent as its sender.
    pub fn message(&self, performative: Performative) -> MessageBuilder {
        self.agent.message(performative)
    }

    /// Starts an answer to a message; see [`crate::Agent::reply`].
    pub fn reply(&self, to: &Message, performative: Performative) -> MessageBuilder {
        self.agent.reply(to, performative)
    }

    /// Announces a conversation that other agents began; see [`crate::Agent::expect_conversation`].
    #[cfg(feature = "monitor")]
    pub fn expect_conversation(&self, id: &str) {
        self.agent.expect_conversation(id);
    }

    /// Sets the extent of the monitor's knowledge; see [`crate::Agent::set_history`].
    #[cfg(feature = "monitor")]
    pub fn set_history(&self, history: fipa_monitor::History) {
        self.agent.set_history(history);
    }

    /// Sends a message and waits for its outcomes; see [`crate::Agent::send`].
    ///
    /// # Errors
    /// See [`crate::Agent::send`].
    pub fn send(&self, message: Message) -> Result<Deliveries, SendError> {
        self.runtime.block_on(self.agent.send(message))
    }

    /// Sends a message with the given deadline; see [`crate::Agent::send_within`].
    ///
    /// # Errors
    /// See [`crate::Agent::send`].
    pub fn send_within(
        &self,
        message: Message,
        deadline: Duration,
    ) -> Result<Deliveries, SendError> {
        self.runtime
            .block_on(self.agent.send_within(message, deadline))
    }

    /// Loans memory for the content of a message; see [`crate::Agent::loan`].
    ///
    /// # Errors
    /// See [`crate::Agent::loan`].
    pub fn loan(&self, message: Message, len: usize) -> Result<Loan, SendError> {
        self.agent.loan(message, len)
    }

    /// Sends the message of a loan; see [`crate::Agent::send_loan`].
    ///
    /// # Errors
    /// See [`crate::Agent::send`].
    pub fn send_loan(&self, loan: Loan) -> Result<Deliveries, SendError> {
        self.runtime.block_on(self.agent.send_loan(loan))
    }

    /// Waits for the next message for this agent.
    ///
    /// # Errors
    /// See [`crate::Agent::receive`].
    pub fn receive(&self) -> Result<Incoming, ReceiveError> {
        self.runtime.block_on(self.agent.receive())
    }

    /// Waits for the next message for this agent; returns `None` if none arrives within `patience`.
    ///
    /// # Errors
    /// See [`crate::Agent::receive`].
    pub fn receive_within(&self, patience: Duration) -> Result<Option<Incoming>, ReceiveError> {
        self.runtime.block_on(async {
            match tokio::time::timeout(patience, self.agent.receive()).await {
                Ok(received) => received.map(Some),
                Err(_) => Ok(None),
            }
        })
    }

    /// Removes the name from the directory; see [`crate::Agent::deregister`].
    ///
    /// # Errors
    /// See [`crate::Agent::deregister`].
    pub fn deregister(self) -> Result<Unread, DeregisterError> {
        self.agent.deregister()
    }
}
