//! For processes without an async runtime: the same calls, blocking.
//!
//! A hidden thread takes letters in and answers for them while the application is busy with
//! something else; it sleeps when there is nothing to do.

#[cfg(feature = "monitor")]
mod protocol;

use std::ops::Deref;
use std::sync::Arc;
use std::time::Duration;

use fipa_acl::{Message, MessageBuilder, Performative};
use fipa_sds::{DeregisterError, Directory, RegisterError};
use tokio::runtime::{Builder, Runtime};

use crate::owner::Owner;
use crate::{AgentId, Config, Deliveries, Incoming, Loan, ReceiveError, SendError, Unread};

#[cfg(feature = "monitor")]
pub use self::protocol::Side;

/// Why a domain could not be joined.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum OpenError {
    /// The thread in the background could not be started.
    #[error("cannot start a thread: {0}")]
    Thread(#[from] std::io::Error),
    /// The domain could not be joined.
    #[error(transparent)]
    Domain(#[from] crate::OpenError),
}

/// See [`crate::Domain`].
#[derive(Clone)]
pub struct Domain {
    // Dropped before the runtime it needs.
    domain: crate::Domain,
    runtime: Background,
}

/// See [`crate::Agent`].
pub struct Agent {
    agent: crate::Agent,
    runtime: Background,
}

/// The runtime with the hidden thread.
#[derive(Clone)]
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
            // In a forked child the thread is missing, and the runtime would wait for its end.
            std::mem::forget(Arc::clone(&self.runtime));
        }
    }
}

impl Domain {
    /// Joins the domain that the configuration names.
    ///
    /// # Errors
    /// See [`crate::Domain::open`].
    pub fn open(config: &Config) -> Result<Self, OpenError> {
        let runtime = Background::start()?;
        let domain = runtime.block_on(crate::Domain::open(config))?;
        Ok(Self { domain, runtime })
    }

    /// Registers an agent.
    ///
    /// # Errors
    /// See [`crate::Domain::register_with`].
    pub fn register(&self, name: &str) -> Result<Agent, RegisterError> {
        self.register_with(name, crate::RegisterOptions::default())
    }

    /// Registers an agent.
    ///
    /// # Errors
    /// See [`crate::Domain::register_with`].
    pub fn register_with(
        &self,
        name: &str,
        options: crate::RegisterOptions,
    ) -> Result<Agent, RegisterError> {
        let agent = self.domain.register_with(name, options)?;
        Ok(Agent {
            agent,
            runtime: self.runtime.clone(),
        })
    }

    /// Who is there; see [`crate::Domain::directory`].
    #[must_use]
    pub fn directory(&self) -> &dyn Directory {
        self.domain.directory()
    }

    /// Leaves the domain; see [`crate::Domain::close`].
    pub fn close(self) {
        self.runtime.block_on(self.domain.close());
    }
}

impl Agent {
    /// The agent's name.
    #[must_use]
    pub fn name(&self) -> &str {
        self.agent.name()
    }

    /// The agent identifier under which it sends.
    #[must_use]
    pub fn id(&self) -> &AgentId {
        self.agent.id()
    }

    /// A message from this agent, to be filled in.
    pub fn message(&self, performative: Performative) -> MessageBuilder {
        self.agent.message(performative)
    }

    /// An answer from this agent; see [`crate::Agent::reply`].
    pub fn reply(&self, to: &Message, performative: Performative) -> MessageBuilder {
        self.agent.reply(to, performative)
    }

    /// Sends a message and waits for its outcomes; see [`crate::Agent::send`].
    ///
    /// # Errors
    /// See [`crate::Agent::send`].
    pub fn send(&self, message: Message) -> Result<Deliveries, SendError> {
        self.runtime.block_on(self.agent.send(message))
    }

    /// Sends a message with a deadline of its own; see [`crate::Agent::send_within`].
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

    /// Memory for the content of a message; see [`crate::Agent::loan`].
    ///
    /// # Errors
    /// See [`crate::Agent::loan`].
    pub fn loan(&self, message: Message, len: usize) -> Result<Loan, SendError> {
        self.agent.loan(message, len)
    }

    /// Sends a message with the content that was filled in; see [`crate::Agent::send_loan`].
    ///
    /// # Errors
    /// See [`crate::Agent::send`].
    pub fn send_loan(&self, loan: Loan) -> Result<Deliveries, SendError> {
        self.runtime.block_on(self.agent.send_loan(loan))
    }

    /// The next message for this agent; waits until there is one.
    ///
    /// # Errors
    /// See [`crate::Agent::receive`].
    pub fn receive(&self) -> Result<Incoming, ReceiveError> {
        self.runtime.block_on(self.agent.receive())
    }

    /// The next message for this agent, or none when there was none for this long.
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

    /// Takes the name out of the directory; see [`crate::Agent::deregister`].
    ///
    /// # Errors
    /// See [`crate::Agent::deregister`].
    pub fn deregister(self) -> Result<Unread, DeregisterError> {
        self.agent.deregister()
    }
}
