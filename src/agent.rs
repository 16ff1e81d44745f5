//! An agent: a name that sends and receives messages.

use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, SystemTime};

use bytes::Bytes;
use fipa_acl::{AgentId, DecodeError, Letter, Message, MessageBuilder, Performative, escape};
use fipa_mts::core::Submission;
use fipa_mts::{PostError, Sending, letter_around, letter_for};
use fipa_sds::{DeregisterError, Directory};
use fipa_transport::{Forked, Incarnation, Kind, LoanedContent, Outcome};

use crate::domain::Domain;

/// An agent of this process. Deregistered when dropped.
pub struct Agent {
    domain: Domain,
    id: AgentId,
    name: Arc<str>,
    incarnation: Incarnation,
    /// How many unique texts were given out.
    given_out: AtomicU64,
    registered: bool,
    #[cfg(feature = "monitor")]
    checks: Option<crate::checks::Checks>,
    #[cfg(feature = "monitor")]
    pub(crate) desk: crate::protocol::Desk,
}

impl Agent {
    pub(crate) fn new(
        domain: Domain,
        id: AgentId,
        name: Arc<str>,
        incarnation: Incarnation,
    ) -> Self {
        Self {
            #[cfg(feature = "monitor")]
            checks: domain.inner.rules.checks(&name),
            #[cfg(feature = "monitor")]
            desk: crate::protocol::Desk::default(),
            domain,
            id,
            name,
            incarnation,
            given_out: AtomicU64::new(0),
            registered: true,
        }
    }

    /// The agent's name.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The agent identifier under which it sends.
    #[must_use]
    pub fn id(&self) -> &AgentId {
        &self.id
    }

    /// This registration.
    #[must_use]
    pub fn incarnation(&self) -> Incarnation {
        self.incarnation
    }

    /// The domain it is registered in.
    #[must_use]
    pub fn domain(&self) -> &Domain {
        &self.domain
    }

    /// A text that nobody has used before, for a `conversation-id` or a `reply-with`: one word, made
    /// of the random number of this registration and one that rises.
    #[must_use]
    pub fn unique_id(&self) -> String {
        let number = self.given_out.fetch_add(1, Ordering::Relaxed);
        // With a letter in front: JADE takes text that begins with a digit for a number.
        format!("c{}-{number}", self.incarnation)
    }

    /// A message from this agent, to be filled in.
    pub fn message(&self, performative: Performative) -> MessageBuilder {
        Message::builder(performative).sender(self.id.clone())
    }

    /// An answer from this agent, as FIPA00037 has it: to whom the message wants answers, in the
    /// same conversation, with a new `reply-with` of its own.
    pub fn reply(&self, to: &Message, performative: Performative) -> MessageBuilder {
        to.reply(performative)
            .sender(self.id.clone())
            .reply_with(self.unique_id())
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
        self.send_within(message, self.domain.inner.deadline)
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
        self.check(&message)?;
        // The lengths of all that stands around the content do not depend on when it is sent.
        let empty = letter_around(&message, Bytes::new(), SystemTime::now())?;
        let (head, tail) = message.around_content(len).map_err(PostError::from)?;
        let receivers: Vec<&str> = message.receivers().iter().map(AgentId::name).collect();
        let name = receivers.iter().map(|name| name.len()).max();
        let head_room = name.unwrap_or(0) + longest_envelope(&empty) + head.len();
        let mts = &self.domain.inner.service.mts;
        let content = mts.loan(self.incarnation, &receivers, head_room, len, tail.len());
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
        self.post(&message, letter, self.domain.inner.deadline)
    }

    /// The letter is on its way when this returns.
    fn post(
        &self,
        message: &Message,
        letter: Result<Letter, PostError>,
        deadline: Duration,
    ) -> impl Future<Output = Result<Deliveries, SendError>> + Send + use<> {
        let sending = self.begin(message, letter, deadline);
        async move { Ok(deliveries(sending?).await) }
    }

    /// Sends a message whose outcomes are asked for later, with [`deliveries`], or never.
    #[cfg(feature = "monitor")]
    pub(crate) fn send_off(
        &self,
        message: &Message,
        deadline: Duration,
    ) -> Result<Sending, SendError> {
        let letter = letter_for(message, SystemTime::now());
        self.begin(message, letter, deadline)
    }

    fn begin(
        &self,
        message: &Message,
        letter: Result<Letter, PostError>,
        deadline: Duration,
    ) -> Result<Sending, SendError> {
        self.check(message)?;
        let letter = letter?;
        #[cfg(feature = "monitor")]
        if let Some(checks) = &self.checks {
            checks.leaving(message)?;
        }
        Ok(self.submit(message, letter, deadline))
    }

    fn submit(&self, message: &Message, letter: Letter, deadline: Duration) -> Sending {
        let receivers = message.receivers().iter();
        self.domain.inner.service.mts.send(Submission {
            sender: self.incarnation,
            letter,
            receivers: receivers.map(|id| id.name().into()).collect(),
            deadline,
        })
    }

    /// Sends a message that is not checked, and whose outcomes nobody waits for.
    #[cfg(feature = "monitor")]
    pub(crate) fn post_aside(&self, message: &Message) -> Result<(), SendError> {
        self.check(message)?;
        let letter = letter_for(message, SystemTime::now())?;
        // Dropping the future does not stop the letter.
        drop(self.submit(message, letter, self.domain.inner.deadline));
        Ok(())
    }

    fn check(&self, message: &Message) -> Result<(), SendError> {
        self.domain.inner.owner.check()?;
        if message.receivers().is_empty() {
            return Err(SendError::NoReceiver);
        }
        match message.sender() {
            Some(sender) if sender.name() == &*self.name => Ok(()),
            Some(sender) => Err(SendError::NotTheSender {
                agent: self.name.to_string(),
                sender: sender.name().to_owned(),
            }),
            None => Err(SendError::NoSender),
        }
    }

    /// The next message for this agent; waits until there is one. Dropping the future loses
    /// nothing.
    ///
    /// # Errors
    /// When the domain was closed, or the letter that came holds no message that can be decoded.
    pub async fn receive(&self) -> Result<Incoming, ReceiveError> {
        self.domain.inner.owner.check()?;
        #[cfg(feature = "monitor")]
        return self.desk.next_other(self).await;
        #[cfg(not(feature = "monitor"))]
        self.next_letter().await
    }

    /// The next message for this agent, if there is one now.
    ///
    /// # Errors
    /// When the letter that came holds no message that can be decoded.
    pub fn try_receive(&self) -> Result<Option<Incoming>, ReceiveError> {
        self.domain.inner.owner.check()?;
        self.domain.inner.service.mts.drive();
        #[cfg(feature = "monitor")]
        return self.desk.other_now(self);
        #[cfg(not(feature = "monitor"))]
        self.letter_now().transpose()
    }

    /// The next message, whatever conversation it belongs to.
    pub(crate) async fn next_letter(&self) -> Result<Incoming, ReceiveError> {
        self.domain.inner.owner.check()?;
        let mts = &self.domain.inner.service.mts;
        match mts.receive(self.incarnation).await {
            Some(received) => self.taken(received),
            None => Err(ReceiveError::Closed),
        }
    }

    /// Waits until the domain is closed.
    #[cfg(feature = "monitor")]
    pub(crate) async fn closed(&self) {
        self.domain.inner.service.mts.gone(self.incarnation).await;
    }

    pub(crate) fn letter_now(&self) -> Option<Result<Incoming, ReceiveError>> {
        let received = self.domain.inner.service.mts.try_receive(self.incarnation);
        received.map(|received| self.taken(received))
    }

    fn taken(&self, received: fipa_mts::core::Received) -> Result<Incoming, ReceiveError> {
        let message = Message::decode(received.letter.payload()).map_err(|source| {
            let mts = &self.domain.inner.service.mts;
            mts.handle_undecodable(&self.name, &received, source.to_string());
            ReceiveError::Malformed {
                source,
                letter: Box::new(received.letter.clone()),
            }
        })?;
        let incoming = Incoming {
            message,
            letter: received.letter,
            via: received.via,
            #[cfg(feature = "monitor")]
            violation: None,
        };
        #[cfg(feature = "monitor")]
        if let Some(checks) = &self.checks {
            return checks.arrived(self, incoming);
        }
        Ok(incoming)
    }

    /// Takes the name out of the directory, and returns the messages that have been delivered and
    /// not received yet, in order. The name can be registered anew at once, here or on another
    /// host: letters on their way follow it there, or fail.
    ///
    /// # Errors
    /// When the directory cannot be written; the agent receives nothing any more all the same, and
    /// what was not received is dropped.
    pub fn deregister(mut self) -> Result<Unread, DeregisterError> {
        let unread = self.leave()?;
        #[cfg(feature = "monitor")]
        let mut all = self.desk.drain();
        #[cfg(not(feature = "monitor"))]
        let mut all = Unread::new();
        all.extend(unread.into_iter().map(|received| self.taken(received)));
        Ok(all)
    }

    fn leave(&mut self) -> Result<Vec<fipa_mts::core::Received>, DeregisterError> {
        self.domain.inner.owner.check()?;
        self.registered = false;
        let service = &self.domain.inner.service;
        let left = service.host.deregister(&self.name, self.incarnation);
        let unread = service.mts.deregister(self.incarnation);
        left.map(|()| unread)
    }
}

/// What an agent that was deregistered had not received, as [`Agent::receive`] would have told it.
pub type Unread = Vec<Result<Incoming, ReceiveError>>;

impl Drop for Agent {
    fn drop(&mut self) {
        // In a forked child it stays registered for the parent.
        if self.registered && self.domain.inner.owner.is_this() {
            match self.leave() {
                // The domain was closed before, and has taken the name with it.
                Ok(_) | Err(DeregisterError::Closed) => {}
                Err(error) => tracing::warn!(%error, agent = %self.name, "not deregistered"),
            }
        }
    }
}

/// Waits until every receiver has an outcome.
pub(crate) async fn deliveries(sending: Sending) -> Deliveries {
    let outcomes = sending.outcomes().await.into_iter();
    let delivered = outcomes.map(|(receiver, outcome)| Delivery { receiver, outcome });
    Deliveries(delivered.collect())
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

/// What became of a message, one [`Delivery`] per receiver.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Deliveries(pub Vec<Delivery>);

/// What became of a message at one receiver.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Delivery {
    /// The receiver's name, or the name or pattern that matched nobody.
    pub receiver: Arc<str>,
    /// What became of it.
    pub outcome: Outcome,
}

impl Deliveries {
    /// Whether every receiver has got it, or it was handed to a peer that cannot confirm.
    #[must_use]
    pub fn all_succeeded(&self) -> bool {
        self.0.iter().all(|delivery| delivery.outcome.is_success())
    }
}

impl fmt::Display for Deliveries {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (index, Delivery { receiver, outcome }) in self.0.iter().enumerate() {
            let newline = if index > 0 { "\n" } else { "" };
            write!(f, "{newline}{}: {outcome}", escape(receiver))?;
        }
        Ok(())
    }
}

/// A message that came.
#[derive(Debug, Clone)]
pub struct Incoming {
    /// The message. Its content may lie in the sender's shared memory: it stays readable for as
    /// long as it is held, and assumes an honest sender of the same user.
    pub message: Message,
    /// The letter it came in.
    pub letter: Letter,
    /// How it came on its last stretch; none for what this process itself told the agent.
    pub via: Option<Kind>,
    /// How it violates its protocol, where that is checked and the configuration says `warn`.
    #[cfg(feature = "monitor")]
    pub violation: Option<Box<fipa_monitor::Violation>>,
}

/// Why a message was not sent.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SendError {
    /// It names no receiver.
    #[error("the message has no receiver; give it one with MessageBuilder::receiver")]
    NoReceiver,
    /// It names no sender.
    #[error("the message has no sender; begin it with Agent::message")]
    NoSender,
    /// It says that it is from somebody else.
    #[error("the message is from {sender:?}, and {agent:?} sends only its own")]
    NotTheSender {
        /// The agent that was to send it.
        agent: String,
        /// Whom the message names.
        sender: String,
    },
    /// It violates its protocol, and the configuration says `enforce`.
    #[cfg(feature = "monitor")]
    #[error("not sent: {0}")]
    Violation(Box<fipa_monitor::Violation>),
    /// It cannot be encoded.
    #[error(transparent)]
    Post(#[from] PostError),
    /// This process is a forked child of the one that registered the agent.
    #[error(transparent)]
    Forked(#[from] Forked),
}

/// Why no message was received.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReceiveError {
    /// The domain was closed.
    #[error("the domain was closed")]
    Closed,
    /// This process is a forked child of the one that registered the agent.
    #[error(transparent)]
    Forked(#[from] Forked),
    /// A letter came whose message cannot be decoded. Its sender gets a failure message.
    #[error("a letter with a message that cannot be decoded: {source}")]
    Malformed {
        /// Why not.
        source: DecodeError,
        /// The letter.
        letter: Box<Letter>,
    },
    /// A message came that violates its protocol, and the configuration says `enforce`.
    #[cfg(feature = "monitor")]
    #[error("{violation}")]
    Violation {
        /// In which way.
        violation: Box<fipa_monitor::Violation>,
        /// The message.
        incoming: Box<Incoming>,
    },
}
