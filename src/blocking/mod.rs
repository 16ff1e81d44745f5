//! Blocking calls for processes without an async runtime.
//!
//! A background thread receives and acknowledges letters while the application does other work. It
//! sleeps when it has nothing to do.
//!
//! ```no_run
//! use fipa::{Performative::Request, blocking::Domain};
//!
//! fn main() -> fipa::Result<()> {
//!     let domain = Domain::from_environment()?;
//!     let rover = domain.register("rover")?;
//!     rover.send(rover.message(Request).receiver("arm_1").content("(lift crate)"))?;
//!     println!("{}", rover.receive()?.message());
//!     Ok(())
//! }
//! ```
//!
//! The calls also work on a thread of a tokio runtime, for example in a function that asynchronous code
//! calls. They block that thread; other tasks on it wait until the call returns.

#[cfg(feature = "actions")]
pub mod actions;
#[cfg(feature = "locks")]
mod locks;
#[cfg(feature = "protocols")]
mod platform;
#[cfg(feature = "protocols")]
mod protocol;

use std::pin::pin;
use std::sync::Arc;
use std::task::{Context, Poll, Wake, Waker};
use std::thread::{self, Thread};
use std::time::Duration;

use fipa_acl::{BuildError, Message, MessageBuilder, Performative};
use fipa_sds::{Cancellation, DeregisterError, RegisterError};
use fipa_transport::threads;
use tokio::runtime::{Builder, Handle, Runtime};

use crate::admin::routes::RouteReport;
use crate::config::Sources;
use crate::domain::process::Owner;
use crate::{
    AgentId, Change, Coalition, CoalitionError, Config, Deliveries, DirectoryView, Entry,
    Incarnation, Incoming, Loan, OpenError, Query, ReceiveError, RegisterOptions, SendError,
    Unread, Watch,
};

#[cfg(feature = "locks")]
pub use self::locks::{Lock, Owned};
#[cfg(feature = "protocols")]
pub use self::platform::{Ams, Df, Notifications};
#[cfg(feature = "protocols")]
pub use self::protocol::Side;

/// The membership of this process in a domain; see [`crate::Domain`].
#[derive(Debug, Clone)]
pub struct Domain {
    // Declared first, because it must be dropped before the runtime that it uses.
    domain: crate::Domain,
    runtime: Background,
}

/// An agent of this process; see [`crate::Agent`]. A clone is a further handle, for example for another
/// thread.
#[derive(Debug, Clone)]
pub struct Agent {
    agent: crate::Agent,
    runtime: Background,
}

/// The changes of a directory; see [`crate::Domain::changes`]. The iterator ends when the last handle of the
/// domain and its agents is dropped.
#[derive(Debug)]
pub struct Changes {
    changes: Watch,
    runtime: Background,
}

/// The runtime of the background thread.
#[derive(Debug, Clone)]
struct Background {
    waiter: Waiter,
    /// Ends with the last owner.
    _runtime: Arc<OwnedRuntime>,
}

#[derive(Debug)]
struct OwnedRuntime {
    /// `None` only while it is dropped.
    runtime: Option<Runtime>,
    owner: Owner,
}

/// Waits on the calling thread for futures of the background thread's runtime.
#[derive(Debug, Clone)]
struct Waiter(Handle);

impl Background {
    fn start() -> std::io::Result<Self> {
        // The start of a runtime panics if the system refuses its thread.
        threads::check(1)?;
        let runtime = Builder::new_multi_thread()
            .worker_threads(1)
            .thread_name("fipa")
            .enable_all()
            .build()?;
        Ok(Self {
            waiter: Waiter(runtime.handle().clone()),
            _runtime: Arc::new(OwnedRuntime {
                runtime: Some(runtime),
                owner: Owner::this(),
            }),
        })
    }
}

impl std::ops::Deref for Background {
    type Target = Waiter;

    fn deref(&self) -> &Waiter {
        &self.waiter
    }
}

impl Drop for OwnedRuntime {
    fn drop(&mut self) {
        let Some(runtime) = self.runtime.take() else {
            return;
        };
        if !self.owner.is_this() {
            // A forked child does not have the thread, and the runtime would wait for its end forever.
            std::mem::forget(runtime);
        } else if Handle::try_current().is_ok() {
            // A thread of another runtime must not wait for the end of this one.
            runtime.shutdown_background();
        }
    }
}

impl Waiter {
    /// Waits for a future, also on a thread of another runtime.
    fn block_on<F: Future>(&self, future: F) -> F::Output {
        if Handle::try_current().is_err() {
            return self.0.block_on(future);
        }
        // tokio refuses to block such a thread. The background thread serves timers and sockets, so this
        // one needs only to be parked. Without the budget of a task, which only a return would renew.
        let mut future = pin!(tokio::task::unconstrained(future));
        let waker = Waker::from(Arc::new(Unpark(thread::current())));
        let mut context = Context::from_waker(&waker);
        loop {
            let polled = {
                let _runtime = self.0.enter();
                future.as_mut().poll(&mut context)
            };
            match polled {
                Poll::Ready(output) => return output,
                Poll::Pending => thread::park(),
            }
        }
    }

    #[cfg(feature = "protocols")]
    fn enter(&self) -> tokio::runtime::EnterGuard<'_> {
        self.0.enter()
    }
}

struct Unpark(Thread);

impl Wake for Unpark {
    fn wake(self: Arc<Self>) {
        self.0.unpark();
    }
}

impl Domain {
    /// Joins the domain that the configuration names; see [`crate::Domain::open`].
    ///
    /// # Errors
    /// If the background thread cannot be started, or as for [`crate::Domain::open`].
    pub fn open(config: &Config) -> Result<Self, OpenError> {
        Self::joined(crate::Domain::open(config))
    }

    /// Joins the domain for a program that ends within a second; see [`crate::Domain::open_briefly`].
    ///
    /// # Errors
    /// As for [`open`](Self::open).
    pub fn open_briefly(config: &Config) -> Result<Self, OpenError> {
        Self::joined(crate::Domain::open_briefly(config))
    }

    fn joined(
        open: impl Future<Output = Result<crate::Domain, OpenError>>,
    ) -> Result<Self, OpenError> {
        let runtime = Background::start().map_err(OpenError::Thread)?;
        let domain = runtime.block_on(open)?;
        Ok(Self { domain, runtime })
    }

    /// Joins the domain of the configuration that the environment selects; see
    /// [`crate::Domain::from_environment`].
    ///
    /// # Errors
    /// See [`crate::Domain::from_environment`].
    pub fn from_environment() -> Result<Self, OpenError> {
        Self::open(&Config::load(&Sources::from_environment())?)
    }

    /// Returns the names of the agents without joining the domain; see [`crate::Domain::names`].
    ///
    /// # Errors
    /// See [`crate::Domain::names`].
    pub fn names(config: &Config) -> Result<Vec<String>, OpenError> {
        crate::Domain::names(config)
    }

    /// Returns the name of the gateway on this host; see [`crate::Domain::gateway_name`].
    ///
    /// # Errors
    /// See [`crate::Domain::gateway_name`].
    pub fn gateway_name(config: &Config) -> Result<Option<String>, OpenError> {
        crate::Domain::gateway_name(config)
    }

    /// Registers an agent with a name and without further description.
    ///
    /// # Errors
    /// See [`crate::Domain::register_with`].
    pub fn register(&self, name: &str) -> Result<Agent, RegisterError> {
        self.register_with(name, RegisterOptions::default())
    }

    /// Registers an agent; see [`crate::Domain::register_with`].
    ///
    /// # Errors
    /// See [`crate::Domain::register_with`].
    pub fn register_with(
        &self,
        name: &str,
        options: RegisterOptions,
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

    /// Returns the known agents; see [`crate::Domain::agents`].
    #[must_use]
    pub fn agents(&self) -> Vec<Arc<Entry>> {
        self.domain.agents()
    }

    /// Returns the known agents of this type; see [`crate::Domain::agents_of_type`].
    #[must_use]
    pub fn agents_of_type(&self, agent_type: &str) -> Vec<Arc<Entry>> {
        self.domain.agents_of_type(agent_type)
    }

    /// Returns the changes of the directory from now on; see [`crate::Domain::changes`].
    #[must_use]
    pub fn changes(&self) -> Changes {
        Changes {
            changes: self.domain.changes(),
            runtime: self.runtime.clone(),
        }
    }

    /// Forms a coalition; see [`crate::Domain::form`].
    ///
    /// # Errors
    /// See [`crate::Domain::form`].
    pub fn form<N: Into<Arc<str>>>(
        &self,
        name: &str,
        members: impl IntoIterator<Item = N>,
        leader: Option<&str>,
        options: RegisterOptions,
    ) -> Result<Coalition, CoalitionError> {
        self.domain.form(name, members, leader, options)
    }

    /// Reports the routes of letters; see [`crate::Domain::routes`].
    #[must_use]
    pub fn routes(&self, to: &Query) -> RouteReport {
        self.domain.routes(to)
    }

    /// Leaves the domain; see [`crate::Domain::close`].
    pub fn close(self) {
        self.runtime.block_on(self.domain.close());
    }
}

impl Changes {
    /// Waits for the next change; returns `None` if there is none within `timeout`, or if the iterator
    /// has ended.
    pub fn next_within(&mut self, timeout: Duration) -> Option<Change> {
        let changes = &mut self.changes;
        let next = self
            .runtime
            .block_on(async { tokio::time::timeout(timeout, changes.next()).await });
        next.ok().flatten()
    }
}

impl Iterator for Changes {
    type Item = Change;

    fn next(&mut self) -> Option<Change> {
        self.runtime.block_on(self.changes.next())
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

    /// Returns the random identifier of this registration.
    #[must_use]
    pub fn incarnation(&self) -> Incarnation {
        self.agent.incarnation()
    }

    /// Returns the domain in which the agent is registered.
    #[must_use]
    pub fn domain(&self) -> Domain {
        Domain {
            domain: self.agent.domain().clone(),
            runtime: self.runtime.clone(),
        }
    }

    /// Returns a unique text for a `conversation-id` or a `reply-with`; see [`crate::Agent::unique_id`].
    #[must_use]
    pub fn unique_id(&self) -> String {
        self.agent.unique_id()
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
    #[cfg(feature = "protocols")]
    pub fn expect_conversation(&self, id: &str) {
        self.agent.expect_conversation(id);
    }

    /// Continues the checks of conversations of an earlier registration; see
    /// [`crate::Agent::restore_conversations`].
    ///
    /// # Errors
    /// See [`crate::Agent::restore_conversations`].
    #[cfg(feature = "protocols")]
    pub fn restore_conversations(
        &self,
        conversations: &[u8],
    ) -> Result<usize, fipa_monitor::SnapshotError> {
        self.agent.restore_conversations(conversations)
    }

    /// Deregisters the agent and keeps the states of its conversations; see [`crate::Agent::depart`].
    ///
    /// # Errors
    /// See [`crate::Agent::depart`].
    #[cfg(feature = "protocols")]
    pub fn depart(self) -> Result<crate::protocol::Departure, DeregisterError> {
        self.agent.depart()
    }

    /// Sets the extent of the monitor's knowledge; see [`crate::Agent::set_history`].
    #[cfg(feature = "protocols")]
    pub fn set_history(&self, history: fipa_monitor::History) {
        self.agent.set_history(history);
    }

    /// Sends a message, or the message of a builder, and waits for its outcomes; see
    /// [`crate::Agent::send`].
    ///
    /// # Errors
    /// See [`crate::Agent::send`].
    pub fn send<M>(&self, message: M) -> Result<Deliveries, SendError>
    where
        M: TryInto<Message, Error: Into<BuildError>>,
    {
        self.runtime.block_on(self.agent.send(message))
    }

    /// Sends a message with the given deadline; see [`crate::Agent::send_within`].
    ///
    /// # Errors
    /// See [`crate::Agent::send`].
    pub fn send_within<M>(&self, message: M, deadline: Duration) -> Result<Deliveries, SendError>
    where
        M: TryInto<Message, Error: Into<BuildError>>,
    {
        self.runtime
            .block_on(self.agent.send_within(message, deadline))
    }

    /// Loans memory for the content of a message; see [`crate::Agent::loan`].
    ///
    /// # Errors
    /// See [`crate::Agent::loan`].
    pub fn loan<M>(&self, message: M, len: usize) -> Result<Loan, SendError>
    where
        M: TryInto<Message, Error: Into<BuildError>>,
    {
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

    /// Waits for the next message for this agent; returns `None` if none arrives within `timeout`.
    ///
    /// # Errors
    /// See [`crate::Agent::receive`].
    pub fn receive_within(&self, timeout: Duration) -> Result<Option<Incoming>, ReceiveError> {
        self.runtime.block_on(self.agent.receive_within(timeout))
    }

    /// Returns the next message for this agent, if one is available now; see
    /// [`crate::Agent::try_receive`].
    ///
    /// # Errors
    /// See [`crate::Agent::try_receive`].
    pub fn try_receive(&self) -> Result<Option<Incoming>, ReceiveError> {
        self.agent.try_receive()
    }

    /// Removes the name from the directory; see [`crate::Agent::deregister`].
    ///
    /// # Errors
    /// See [`crate::Agent::deregister`].
    pub fn deregister(self) -> Result<Unread, DeregisterError> {
        self.agent.deregister()
    }
}
