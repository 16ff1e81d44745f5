//! An agent: a name that sends and receives messages.

use std::sync::Arc;
use std::time::{Duration, SystemTime};

use bytes::Bytes;
use fipa_acl::{AgentId, AgentIdError, Letter, Message, MessageBuilder, Performative};
use fipa_mts::{PostError, letter_around, letter_for};
use fipa_sds::{DeregisterError, Directory, RegisterError, Registration};
use fipa_transport::{Incarnation, LoanedContent};

use crate::delivery::{Deliveries, deliveries};
use crate::demultiplexer::Demultiplexer;
use crate::domain::{Domain, RegisterOptions, warn_of_name};
use crate::endpoint::Endpoint;
use crate::error::{ReceiveError, SendError};
use crate::incoming::Incoming;

/// An agent of this process. Deregistered when dropped.
pub struct Agent {
    pub(crate) endpoint: Endpoint,
    pub(crate) demultiplexer: Demultiplexer,
    registered: bool,
}

impl Domain {
    /// Registers an agent with nothing but a name.
    ///
    /// # Errors
    /// See [`register_with`](Self::register_with).
    pub fn register(&self, name: &str) -> Result<Agent, RegisterError> {
        self.register_with(name, RegisterOptions::default())
    }

    /// Registers an agent. From now on it is found by its name, here and, when a gateway is
    /// running, on other hosts; its letters wait in its queue until it receives them.
    ///
    /// # Errors
    /// When somebody else has the name, or it is no name.
    pub fn register_with(
        &self,
        name: &str,
        options: RegisterOptions,
    ) -> Result<Agent, RegisterError> {
        self.inner.owner.check()?;
        let service = &self.inner.service;
        let id = AgentId::new(name)
            .map_err(|error: AgentIdError| RegisterError::Failed(Arc::new(error)))?;
        let incarnation = Incarnation::random();
        let name: Arc<str> = name.into();
        // The queue first: once the name is known, letters come.
        service.mts.register(Arc::clone(&name), incarnation);
        let registration = Registration {
            agent_type: options.agent_type,
            description: options.description,
            ..Registration::new(Arc::clone(&name), incarnation, service.locations())
        };
        match service.host.register(registration) {
            Ok(_) => {
                warn_of_name(&id);
                Ok(Agent {
                    endpoint: Endpoint::new(self.clone(), id, name, incarnation),
                    demultiplexer: Demultiplexer::default(),
                    registered: true,
                })
            }
            Err(error) => {
                // Nobody can have written to it.
                drop(service.mts.deregister(incarnation));
                Err(error)
            }
        }
    }
}

impl Agent {
    /// The agent's name.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.endpoint.name
    }

    /// The agent identifier under which it sends.
    #[must_use]
    pub fn id(&self) -> &AgentId {
        &self.endpoint.id
    }

    /// This registration.
    #[must_use]
    pub fn incarnation(&self) -> Incarnation {
        self.endpoint.incarnation
    }

    /// The domain it is registered in.
    #[must_use]
    pub fn domain(&self) -> &Domain {
        &self.endpoint.domain
    }

    /// A text that nobody has used before, for a `conversation-id` or a `reply-with`: one word, made
    /// of the random number of this registration and one that rises.
    #[must_use]
    pub fn unique_id(&self) -> String {
        self.endpoint.unique_id()
    }

    /// A message from this agent, to be filled in.
    pub fn message(&self, performative: Performative) -> MessageBuilder {
        Message::builder(performative).sender(self.endpoint.id.clone())
    }

    /// An answer from this agent, as FIPA00037 has it: to whom the message wants answers, in the
    /// same conversation, with a new `reply-with` of its own.
    pub fn reply(&self, to: &Message, performative: Performative) -> MessageBuilder {
        self.endpoint.reply(to, performative)
    }

    /// Sends a message to its receivers, each an agent's name or a pattern of names, and waits
    /// until every receiver has an outcome: within the deadline of the configuration.
    ///
    /// Letters leave in the order of the calls, whether the futures are awaited in that order or
    /// not; a future that is dropped does not stop its letter.
    ///
    /// # Errors
    /// When the message cannot be sent at all. What happened on the way is in the outcomes.
    pub fn send(
        &self,
        message: Message,
    ) -> impl Future<Output = Result<Deliveries, SendError>> + Send + use<> {
        self.send_within(message, self.endpoint.domain.inner.deadline)
    }

    /// Sends a message with a deadline of its own.
    ///
    /// # Errors
    /// See [`send`](Self::send).
    pub fn send_within(
        &self,
        message: Message,
        deadline: Duration,
    ) -> impl Future<Output = Result<Deliveries, SendError>> + Send + use<> {
        let letter = letter_for(&message, SystemTime::now());
        self.post(&message, letter, deadline)
    }

    /// Memory for the content of a message to agents of this host, in shared memory where
    /// possible: the content is written once, by the application, and the receivers read it in
    /// place. A content of the message itself is ignored.
    ///
    /// Where shared memory cannot be used (another host, no room), the memory is on the heap, and
    /// so is short content for several receivers; [`send_loan`](Self::send_loan) works all the
    /// same.
    ///
    /// # Errors
    /// When the message cannot be sent at all.
    pub fn loan(&self, message: Message, len: usize) -> Result<Loan, SendError> {
        self.endpoint.check(&message)?;
        // The lengths of all that stands around the content do not depend on when it is sent.
        let empty = letter_around(&message, Bytes::new(), SystemTime::now())?;
        let (head, tail) = message.around_content(len).map_err(PostError::from)?;
        let receivers: Vec<&str> = message.receivers().iter().map(AgentId::name).collect();
        let name = receivers.iter().map(|name| name.len()).max();
        let head_room = name.unwrap_or(0) + longest_envelope(&empty) + head.len();
        let incarnation = self.endpoint.incarnation;
        let content = self
            .endpoint
            .mts()
            .loan(incarnation, &receivers, head_room, len, tail.len());
        Ok(Loan { message, content })
    }

    /// Sends a message with the content that was filled in.
    ///
    /// # Errors
    /// See [`send`](Self::send).
    pub fn send_loan(
        &self,
        loan: Loan,
    ) -> impl Future<Output = Result<Deliveries, SendError>> + Send + use<> {
        let Loan { message, content } = loan;
        let letter = letter_around(&message, content.freeze(), SystemTime::now());
        self.post(&message, letter, self.endpoint.domain.inner.deadline)
    }

    /// The letter is on its way when this returns.
    fn post(
        &self,
        message: &Message,
        letter: Result<Letter, PostError>,
        deadline: Duration,
    ) -> impl Future<Output = Result<Deliveries, SendError>> + Send + use<> {
        let sending = self.endpoint.send(message, letter, deadline);
        async move { Ok(deliveries(sending?).await) }
    }

    /// The next message for this agent; waits until there is one. Dropping the future loses
    /// nothing.
    ///
    /// # Errors
    /// When the domain was closed, or the letter that came holds no message that can be decoded.
    pub async fn receive(&self) -> Result<Incoming, ReceiveError> {
        self.endpoint.domain.inner.owner.check()?;
        self.demultiplexer.next_other(&self.endpoint).await
    }

    /// The next message for this agent, if there is one now.
    ///
    /// # Errors
    /// When the letter that came holds no message that can be decoded.
    pub fn try_receive(&self) -> Result<Option<Incoming>, ReceiveError> {
        self.endpoint.domain.inner.owner.check()?;
        self.endpoint.mts().drive();
        self.demultiplexer.other_now(&self.endpoint)
    }

    /// Takes the name out of the directory, and returns the messages that have been delivered and
    /// not received yet, in order. The name can be registered anew at once, here or on another
    /// host: letters on their way follow it there, or fail.
    ///
    /// # Errors
    /// When the directory cannot be written; the agent receives nothing any more all the same, and
    /// what was not received is dropped.
    pub fn deregister(mut self) -> Result<Unread, DeregisterError> {
        self.registered = false;
        let unread = self.endpoint.deregister()?;
        let mut all = self.demultiplexer.drain();
        let unread = unread.into_iter();
        all.extend(unread.map(|received| self.endpoint.decode(received)));
        Ok(all)
    }
}

/// What an agent that was deregistered had not received, as [`Agent::receive`] would have told it.
pub type Unread = Vec<Result<Incoming, ReceiveError>>;

impl Drop for Agent {
    fn drop(&mut self) {
        // In a forked child it stays registered for the parent.
        if self.registered && self.endpoint.domain.inner.owner.is_this() {
            match self.endpoint.deregister() {
                // The domain was closed before, and has taken the name with it.
                Ok(_) | Err(DeregisterError::Closed) => {}
                Err(error) => {
                    tracing::warn!(%error, agent = %self.endpoint.name, "not deregistered")
                }
            }
        }
    }
}

/// The digits of the payload's length are the one thing in an envelope that depends on the
/// content: 20 more are the most there can be, two to a byte.
fn longest_envelope(letter: &Letter) -> usize {
    letter.envelope_len() + 10
}

/// A message whose content is being written in place.
pub struct Loan {
    message: Message,
    content: Box<dyn LoanedContent>,
}

impl Loan {
    /// The content, to be written. It starts out as anything.
    pub fn content_mut(&mut self) -> &mut [u8] {
        self.content.content_mut()
    }
}
