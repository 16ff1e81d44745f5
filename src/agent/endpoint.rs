//! The sending and receiving end of one registration: the part of an [`Agent`](crate::Agent) that is
//! independent of the conversations that its calls lead.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, SystemTime};

use fipa_acl::{
    AgentId, EnvelopeTemplate, ErrorChain, Letter, Message, MessageBuilder, Performative,
};
use fipa_mts::core::Received;
use fipa_mts::{Gone, LetterDraft, Mts, PostError, letter_by};
use fipa_sds::{DeregisterError, Directory};
use fipa_transport::{Incarnation, log_limit};
use parking_lot::Mutex;

use crate::agent::checks::{Checks, Origin};
use crate::agent::delivery::Sent;
#[cfg(feature = "protocols")]
use crate::agent::delivery_report;
use crate::agent::incoming::Incoming;
use crate::agent::stated::HeldLetters;
#[cfg(feature = "opentelemetry")]
use crate::agent::trace_context;
use crate::domain::Domain;
use crate::error::{ReceiveError, SendError};

/// One registration of an agent of this process.
pub(crate) struct Endpoint {
    pub(crate) domain: Domain,
    pub(crate) id: AgentId,
    pub(crate) name: Arc<str>,
    pub(crate) incarnation: Incarnation,
    /// Number of unique texts issued so far.
    unique_ids: AtomicU64,
    pub(crate) checks: Checks,
    /// The envelope of the latest letter.
    template: Mutex<EnvelopeTemplate>,
    /// The letters that wait for the introduction of their receivers.
    held: HeldLetters,
}

/// Whether a message is checked against its protocol before it is sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Checked {
    Yes,
    /// An answer that the checks themselves cause.
    No,
}

impl Endpoint {
    pub(crate) fn new(
        domain: Domain,
        id: AgentId,
        name: Arc<str>,
        incarnation: Incarnation,
    ) -> Self {
        Self {
            checks: domain.inner.rules.checks(
                &name,
                unique_ids_of(incarnation),
                &*domain.inner.service.host,
                domain.inner.service.counting.shared(),
            ),
            domain,
            id,
            name,
            incarnation,
            unique_ids: AtomicU64::new(0),
            template: Mutex::default(),
            held: HeldLetters::default(),
        }
    }

    pub(crate) fn mts(&self) -> &Mts {
        &self.domain.inner.service.mts
    }

    pub(crate) fn unique_id(&self) -> String {
        let number = self.unique_ids.fetch_add(1, Ordering::Relaxed);
        format!("{}{number}", unique_ids_of(self.incarnation))
    }

    pub(crate) fn reply(&self, to: &Message, performative: Performative) -> MessageBuilder {
        to.reply(performative)
            .sender(self.id.clone())
            .reply_with(self.unique_id())
    }

    /// Checks that this agent may send a message.
    pub(crate) fn check(&self, message: &Message) -> Result<(), SendError> {
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

    /// Encodes a message as a letter, dated now.
    pub(crate) fn letter(&self, message: &Message) -> Result<Letter, PostError> {
        letter_by(&mut self.template.lock(), message, SystemTime::now())
    }

    /// Encodes a message, dated now, around content of this length in bytes.
    pub(crate) fn draft(
        &self,
        message: Message,
        content_len: usize,
    ) -> Result<LetterDraft, PostError> {
        let template = &mut self.template.lock();
        LetterDraft::new(message, content_len, SystemTime::now(), template)
    }

    /// Sends a message. The letter is sent before this returns, unless it waits for the introduction of a receiver;
    /// dropping the result does not stop it.
    pub(crate) fn send(
        &self,
        message: &Message,
        letter: Result<Letter, PostError>,
        deadline: Duration,
    ) -> Result<Sent, SendError> {
        self.submit(message, letter, deadline, Checked::Yes)
    }

    fn submit(
        &self,
        message: &Message,
        letter: Result<Letter, PostError>,
        deadline: Duration,
        checked: Checked,
    ) -> Result<Sent, SendError> {
        self.check(message)?;
        let letter = letter?;
        let unsettled = match checked {
            Checked::Yes => {
                let directory = &*self.domain.inner.service.host;
                self.checks.check_outgoing(message, directory)?
            }
            Checked::No => None,
        };
        #[cfg(feature = "opentelemetry")]
        let letter = trace_context::added_to(letter, self.domain.inner.max_letter);
        let receivers = message.receivers();
        if self.held.must_hold(&self.domain, receivers) {
            let held = (letter, receivers);
            let held = self
                .held
                .hold(&self.domain, self.incarnation, held, deadline);
            return Ok(Sent::held(receivers, held, unsettled));
        }
        let mts = self.mts();
        let sending = mts.submit_to_agents(self.incarnation, letter, receivers, deadline);
        Ok(Sent::new(sending, unsettled))
    }

    /// Waits until [`letter_now`](Self::letter_now) has a letter or an error. Another task may take the letter first.
    pub(crate) async fn until_letter(&self) -> Result<(), ReceiveError> {
        self.domain.inner.owner.check()?;
        self.mts().until_letter(self.incarnation).await;
        Ok(())
    }

    /// Returns the next letter, if one is available now.
    pub(crate) fn letter_now(&self) -> Result<Option<Received>, ReceiveError> {
        match self.mts().try_receive(self.incarnation) {
            Ok(received) => Ok(received),
            Err(Gone) => Err(ReceiveError::Closed),
        }
    }

    /// Whether no more letters can arrive.
    #[cfg(feature = "protocols")]
    pub(crate) fn is_closed(&self) -> bool {
        self.mts().is_gone(self.incarnation)
    }

    /// Waits until the domain is closed.
    #[cfg(feature = "protocols")]
    pub(crate) async fn closed(&self) {
        self.mts().gone(self.incarnation).await;
    }

    /// Checks a received letter. Returns `None` if the message cannot be decoded; the sender
    /// then gets a failure message.
    pub(crate) fn decode(&self, received: Received) -> Option<Incoming> {
        let origin = Origin::of(&received);
        #[cfg_attr(not(feature = "protocols"), expect(unused_mut))]
        let mut incoming = match Incoming::new(received) {
            Ok(incoming) => incoming,
            Err(refused) => {
                let (error, received) = *refused;
                log_limit::warn!(
                    of: received.service, agent = %self.name, error = %ErrorChain(&error),
                    "ignored a received letter: its message cannot be decoded"
                );
                self.mts().handle_undecodable(&self.name, &received, &error);
                return None;
            }
        };
        let directory = &*self.domain.inner.service.host;
        #[cfg(feature = "protocols")]
        {
            incoming.undelivered_to = delivery_report::read(&incoming, directory);
        }
        let answer = |message: &Message, reason| self.not_understood(message, reason);
        Some(self.checks.arrived(incoming, origin, directory, answer))
    }

    /// Answers a message that violates its protocol. Returns the answer if it was sent.
    fn not_understood(&self, message: &Message, reason: String) -> Option<Message> {
        let answer = self
            .reply(message, Performative::NotUnderstood)
            .content(reason)
            .build();
        let sent = answer
            .map_err(|error| error.to_string())
            .and_then(|answer| {
                let letter = self.letter(&answer);
                let deadline = self.domain.inner.deadline();
                let sent = self
                    .submit(&answer, letter, deadline, Checked::No)
                    .map_err(|error| ErrorChain(&error).to_string())?;
                // No caller waits for its outcomes.
                drop(sent);
                Ok(answer)
            });
        sent.inspect_err(|error| log_limit::warn!(%error, "cannot answer a protocol violation"))
            .ok()
    }

    /// Ends the registration and returns the letters that were not received.
    pub(crate) fn deregister(&self) -> Result<Vec<Received>, DeregisterError> {
        self.domain.inner.owner.check()?;
        self.held.close();
        let service = &self.domain.inner.service;
        let removed = service.host.deregister(&self.name, self.incarnation);
        let unread = service.mts.deregister(self.incarnation);
        removed.map(|()| unread)
    }
}

/// Returns the beginning of the unique texts of a registration.
fn unique_ids_of(incarnation: Incarnation) -> String {
    // The letter at the beginning is for JADE, which parses text that begins with a digit as a number.
    format!("c{incarnation}-")
}
