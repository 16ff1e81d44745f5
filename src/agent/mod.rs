//! An agent: a name that sends and receives messages.

#[cfg(feature = "protocols")]
pub(crate) mod checks;
pub(crate) mod delivery;
#[cfg(feature = "protocols")]
pub(crate) mod delivery_report;
#[cfg(feature = "protocols")]
pub(crate) mod demultiplexer;
pub(crate) mod endpoint;
pub(crate) mod incoming;
#[cfg(feature = "protocols")]
pub(crate) mod lock_slot;
#[cfg(feature = "protocols")]
pub(crate) mod reader_key;
pub(crate) mod sender_tasks;
pub(crate) mod stated;
#[cfg(feature = "protocols")]
pub(crate) mod topics;
#[cfg(feature = "opentelemetry")]
pub(crate) mod trace_context;
#[cfg(not(feature = "protocols"))]
pub(crate) mod without_protocols;

use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use fipa_acl::{
    AgentId, AgentIdError, BuildError, ErrorChain, Message, MessageBuilder, Performative,
};
use fipa_mts::LetterDraft;
use fipa_sds::{Cancellation, DeregisterError, RegisterError, Registration};
use fipa_transport::{Incarnation, LoanedContent, log_limit};

#[cfg(not(feature = "protocols"))]
pub(crate) use self::without_protocols::{
    self as checks, self as demultiplexer, self as lock_slot,
};
use crate::agent::delivery::{Deliveries, deliveries};
use crate::agent::demultiplexer::Demultiplexer;
use crate::agent::endpoint::Endpoint;
use crate::agent::incoming::Incoming;
use crate::agent::lock_slot::LockSlot;
use crate::domain::background;
use crate::domain::{Domain, RegisterOptions, warn_of_name};
use crate::error::{ReceiveError, SendError};

/// An agent of this process.
///
/// A clone is a further handle of the same agent, so that several tasks can use it. The agent is
/// deregistered when [`deregister`](Self::deregister) is called on one of the handles, or when the last
/// handle is dropped. A server or conversation of the agent is not a handle.
#[derive(Clone)]
pub struct Agent {
    pub(crate) core: Arc<AgentCore>,
    registration: Arc<RegistrationGuard>,
}

/// The registration that the handles of an agent share.
struct RegistrationGuard {
    core: Arc<AgentCore>,
    /// Whether [`Agent::deregister`] was called.
    is_over: AtomicBool,
}

/// The parts of an agent that its conversations share. They may outlast the [`Agent`], and end with an
/// error once it is deregistered.
pub(crate) struct AgentCore {
    pub(crate) endpoint: Endpoint,
    pub(crate) demultiplexer: Demultiplexer,
    pub(crate) locks: LockSlot,
    #[cfg(feature = "protocols")]
    pub(crate) topics: topics::Topics,
    #[cfg(feature = "actions")]
    pub(crate) actions: crate::actions::table::ActionTable,
}

#[cfg(feature = "actions")]
impl Drop for AgentCore {
    fn drop(&mut self) {
        self.actions.close();
    }
}

#[cfg(feature = "protocols")]
impl AgentCore {
    /// Starts a message with this agent as its sender.
    pub(crate) fn message(&self, performative: Performative) -> MessageBuilder {
        Message::builder(performative).sender(self.endpoint.id.clone())
    }
}

impl Domain {
    /// Registers an agent with a name and without further description.
    ///
    /// # Errors
    /// See [`register_with`](Self::register_with).
    pub async fn register(&self, name: &str) -> Result<Agent, RegisterError> {
        self.register_with(name, RegisterOptions::default()).await
    }

    /// Registers an agent. Afterwards other agents find it by its name on this host and, if a gateway
    /// is running, on other hosts. Its letters wait in its queue until it receives them.
    ///
    /// Waits for other processes that change the directory on a thread for blocking calls, up to a
    /// minute. Dropping the future ends the wait; the name is then not registered, or is removed
    /// again if it already was.
    ///
    /// # Errors
    /// If the name is invalid or another agent has it, or if the directory cannot be written.
    pub async fn register_with(
        &self,
        name: &str,
        options: RegisterOptions,
    ) -> Result<Agent, RegisterError> {
        self.inner.owner.check()?;
        let (domain, name) = (self.clone(), name.to_owned());
        let registered = background::run(&self.inner.service.runtime, move |cancellation| {
            let registered = domain.register_unless(&name, options, cancellation);
            registered.map_err(|error| domain.explained(error))
        });
        registered.await?
    }

    /// Replaces an error that was caused by a directory of the domain in which no file can be written.
    fn explained(&self, error: RegisterError) -> RegisterError {
        if !matches!(error, RegisterError::Failed(_)) {
            return error;
        }
        match self.inner.service.dir.check_writable() {
            Err(cause) => RegisterError::Failed(Arc::new(cause)),
            Ok(()) => error,
        }
    }

    /// Registers an agent on the calling thread.
    pub(crate) fn register_unless(
        &self,
        name: &str,
        options: RegisterOptions,
        cancellation: &Cancellation,
    ) -> Result<Agent, RegisterError> {
        self.inner.owner.check()?;
        let service = &self.inner.service;
        let id = AgentId::new(name)
            .map_err(|error: AgentIdError| RegisterError::Failed(Arc::new(error)))?;
        let incarnation = Incarnation::random();
        let name: Arc<str> = name.into();
        // The queue must exist before the name is visible, because letters can arrive from then on.
        service.mts.register(Arc::clone(&name), incarnation);
        let registration = Registration {
            agent_type: options.agent_type,
            description: options.description,
            ..Registration::new(Arc::clone(&name), incarnation, service.locations())
        };
        match service.host.register_unless(registration, cancellation) {
            Ok(_) => {
                warn_of_name(&id);
                let core = Arc::new(AgentCore {
                    endpoint: Endpoint::new(self.clone(), id, name, incarnation),
                    demultiplexer: Demultiplexer::default(),
                    locks: LockSlot::default(),
                    #[cfg(feature = "protocols")]
                    topics: topics::Topics::default(),
                    #[cfg(feature = "actions")]
                    actions: crate::actions::table::ActionTable::default(),
                });
                let registration = Arc::new(RegistrationGuard {
                    core: Arc::clone(&core),
                    is_over: AtomicBool::new(false),
                });
                Ok(Agent { core, registration })
            }
            Err(error) => {
                // The name was never visible, so the queue holds no letters.
                drop(service.mts.deregister(incarnation));
                Err(error)
            }
        }
    }
}

impl Agent {
    /// Returns the name of the agent.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.core.endpoint.name
    }

    /// Returns the agent identifier that the agent's messages have as their sender.
    #[must_use]
    pub fn id(&self) -> &AgentId {
        &self.core.endpoint.id
    }

    /// Returns the random identifier of this registration.
    #[must_use]
    pub fn incarnation(&self) -> Incarnation {
        self.core.endpoint.incarnation
    }

    /// Returns the domain in which the agent is registered.
    #[must_use]
    pub fn domain(&self) -> &Domain {
        &self.core.endpoint.domain
    }

    /// Returns a unique text for a `conversation-id` or a `reply-with`. It is one word that contains
    /// the random identifier of this registration and a counter.
    #[must_use]
    pub fn unique_id(&self) -> String {
        self.core.endpoint.unique_id()
    }

    /// Starts a message with this agent as its sender.
    pub fn message(&self, performative: Performative) -> MessageBuilder {
        Message::builder(performative).sender(self.core.endpoint.id.clone())
    }

    /// Starts an answer to a message, as FIPA00037 defines it: its receivers are the message's
    /// `reply-to`, or else its sender. It belongs to the same conversation and has a new
    /// `reply-with`.
    pub fn reply(&self, to: &Message, performative: Performative) -> MessageBuilder {
        self.core.endpoint.reply(to, performative)
    }

    /// Sends a message, or the message of a builder, to its receivers, each the name of an agent or a
    /// pattern of names. Waits until every receiver has an outcome, at most for the deadline of the
    /// configuration (`mts.deadline`).
    ///
    /// Letters are sent in the order of the calls, independently of the order in which the futures are awaited. Dropping
    /// the future does not stop the letter.
    ///
    /// ```no_run
    /// # async fn example(rover: fipa::Agent) -> fipa::Result<()> {
    /// use fipa::Performative::Request;
    ///
    /// let lift = rover.message(Request).receiver("arm_1").content("(lift crate)");
    /// println!("{}", rover.send(lift).await?); // for example: arm_1: delivered via shm
    /// # Ok(())
    /// # }
    /// ```
    ///
    /// # Errors
    /// If the message cannot be sent at all, for example because a receiver's name is invalid. Failures
    /// of delivery are in the outcomes.
    pub fn send<M>(
        &self,
        message: M,
    ) -> impl Future<Output = Result<Deliveries, SendError>> + Send + use<M>
    where
        M: TryInto<Message, Error: Into<BuildError>>,
    {
        self.send_within(message, self.core.endpoint.domain.inner.deadline())
    }

    /// Sends a message with the given deadline instead of the configured one.
    ///
    /// # Errors
    /// See [`send`](Self::send).
    pub fn send_within<M>(
        &self,
        message: M,
        deadline: Duration,
    ) -> impl Future<Output = Result<Deliveries, SendError>> + Send + use<M>
    where
        M: TryInto<Message, Error: Into<BuildError>>,
    {
        let sending = self.built(message).and_then(|message| {
            let letter = self.core.endpoint.letter(&message);
            self.core.endpoint.send(&message, letter, deadline)
        });
        async move { Ok(deliveries(sending?).await) }
    }

    /// Builds a message that this agent sends.
    fn built<M>(&self, message: M) -> Result<Message, SendError>
    where
        M: TryInto<Message, Error: Into<BuildError>>,
    {
        if self.registration.is_over.load(Ordering::Acquire) {
            return Err(SendError::Deregistered);
        }
        let message = message.try_into();
        message.map_err(|error| SendError::Build(error.into()))
    }

    /// Loans memory of `len` bytes for the content of a message, in shared memory where possible. The
    /// application writes the content once, and receivers on this host read it in place. Content of
    /// `message` itself is ignored.
    ///
    /// If shared memory cannot be used (a receiver on another host, not enough free memory), the
    /// memory is on the heap. The same applies to content below 4 KiB, because a copy of it takes less
    /// time than a loan, and to short content for several receivers. The envelope has the date of this
    /// call.
    /// [`send_loan`](Self::send_loan) works in all cases.
    ///
    /// # Errors
    /// If the message cannot be sent at all, or if the letter would be larger than the limit
    /// ([`SendError::TooLarge`]).
    pub fn loan<M>(&self, message: M, len: usize) -> Result<Loan, SendError>
    where
        M: TryInto<Message, Error: Into<BuildError>>,
    {
        let message = self.built(message)?;
        self.core.endpoint.check(&message)?;
        let limit = self.core.endpoint.domain.inner.max_letter;
        let too_large = |len: usize| SendError::TooLarge {
            len: len as u64,
            limit,
        };
        // Checked before the length of the content is encoded, which FIPA00069 limits to 32 bits.
        if len as u64 > limit {
            return Err(too_large(len));
        }
        let draft = self.core.endpoint.draft(message, len)?;
        let letter_len = draft.head_len() + len + draft.tail_len();
        if letter_len as u64 > limit {
            return Err(too_large(letter_len));
        }
        let receivers = draft.message().receivers().iter();
        let receivers: Vec<&str> = receivers.map(AgentId::name).collect();
        let name = receivers.iter().map(|name| name.len()).max();
        let head_room = name.unwrap_or(0) + draft.head_len();
        #[cfg(feature = "opentelemetry")]
        let head_room = head_room + trace_context::ROOM;
        let incarnation = self.core.endpoint.incarnation;
        let content = self.core.endpoint.mts().loan(
            incarnation,
            &receivers,
            head_room,
            len,
            draft.tail_len(),
        );
        Ok(Loan { draft, content })
    }

    /// Sends the message of a loan with the content written into it.
    ///
    /// # Errors
    /// See [`send`](Self::send).
    pub fn send_loan(
        &self,
        loan: Loan,
    ) -> impl Future<Output = Result<Deliveries, SendError>> + Send + use<> {
        self.send_loan_within(loan, self.core.endpoint.domain.inner.deadline())
    }

    /// Sends the message of a loan with the given deadline instead of the configured one.
    ///
    /// # Errors
    /// See [`send`](Self::send).
    pub fn send_loan_within(
        &self,
        loan: Loan,
        deadline: Duration,
    ) -> impl Future<Output = Result<Deliveries, SendError>> + Send + use<> {
        let Loan { draft, content } = loan;
        let (message, letter) = draft.complete(content.freeze());
        let sending = self.core.endpoint.send(&message, Ok(letter), deadline);
        async move { Ok(deliveries(sending?).await) }
    }

    /// Waits for the next message for this agent. Dropping the future loses no message. Of several
    /// calls at the same time, on one handle or on clones, each message goes to one of them.
    ///
    /// A message that violates its protocol is returned like others, and
    /// [`Incoming::violation`](crate::Incoming::violation) has the violation.
    ///
    /// # Errors
    /// If the agent can receive no further message, because it is deregistered or the domain is closed.
    /// No message of another agent causes an error.
    pub async fn receive(&self) -> Result<Incoming, ReceiveError> {
        self.core.endpoint.domain.inner.owner.check()?;
        self.core
            .demultiplexer
            .next_other(&self.core.endpoint)
            .await
    }

    /// Waits for the next message for this agent; returns `None` if none arrives within `timeout`.
    ///
    /// # Errors
    /// See [`receive`](Self::receive).
    pub async fn receive_within(
        &self,
        timeout: Duration,
    ) -> Result<Option<Incoming>, ReceiveError> {
        match tokio::time::timeout(timeout, self.receive()).await {
            Ok(received) => received.map(Some),
            Err(_) => Ok(None),
        }
    }

    /// Returns the next message for this agent, if one is available now.
    ///
    /// # Errors
    /// If none is available and the agent can receive no further message; see [`receive`](Self::receive).
    pub fn try_receive(&self) -> Result<Option<Incoming>, ReceiveError> {
        let endpoint = &self.core.endpoint;
        endpoint.domain.inner.owner.check()?;
        endpoint.mts().drive();
        self.core.demultiplexer.other_now(endpoint)
    }

    /// Removes the name from the directory, and returns the messages that were delivered but not received, those of each
    /// conversation in order. The name can be registered again at once, here or on another host. Letters in transit
    /// follow the name there, or fail.
    ///
    /// The registration ends for all handles: `receive` on another handle fails with
    /// [`ReceiveError::Closed`], `send` with [`SendError::Deregistered`], and a second `deregister` with
    /// [`DeregisterError::NotRegistered`].
    ///
    /// # Errors
    /// If the directory cannot be written. The agent then receives no further messages either, and
    /// the messages that were not received are dropped.
    pub fn deregister(self) -> Result<Unread, DeregisterError> {
        if self.registration.is_over.swap(true, Ordering::AcqRel) {
            let name = Arc::clone(&self.core.endpoint.name);
            return Err(DeregisterError::NotRegistered(name));
        }
        self.core.locks.close(&self.core);
        let unread = self.core.endpoint.deregister()?;
        let mut all = self.core.demultiplexer.drain();
        let unread = unread.into_iter();
        all.extend(unread.filter_map(|received| self.core.endpoint.decode(received)));
        all.retain(|incoming| !lock_slot::is_for_locks(incoming));
        Ok(all)
    }
}

impl fmt::Debug for Agent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Agent")
            .field("name", &self.core.endpoint.name)
            .field("incarnation", &self.core.endpoint.incarnation)
            .finish_non_exhaustive()
    }
}

/// The messages that a deregistered agent had not received, as [`Agent::receive`] would have returned
/// them.
pub type Unread = Vec<Incoming>;

impl Drop for RegistrationGuard {
    fn drop(&mut self) {
        let is_over = *self.is_over.get_mut();
        // In a forked child, the agent stays registered for the parent.
        if !is_over && self.core.endpoint.domain.inner.owner.is_this() {
            self.core.locks.close(&self.core);
            match self.core.endpoint.deregister() {
                // Closing the domain has already removed the name.
                Ok(_) | Err(DeregisterError::Closed) => {}
                Err(error) => {
                    log_limit::warn!(error = %ErrorChain(&error), agent = %self.core.endpoint.name, "cannot deregister an agent")
                }
            }
        }
    }
}

/// A message with loaned memory for its content.
pub struct Loan {
    draft: LetterDraft,
    content: Box<dyn LoanedContent>,
}

impl Loan {
    /// Returns the memory of the content, to be written. Its initial bytes are arbitrary.
    pub fn content_mut(&mut self) -> &mut [u8] {
        self.content.content_mut()
    }
}

impl fmt::Debug for Loan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Loan")
            .field("message", self.draft.message())
            .finish_non_exhaustive()
    }
}
