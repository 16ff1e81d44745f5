//! A received message.

use fipa_acl::{Letter, Message};
use fipa_mts::core::Received;
use fipa_transport::Kind;
#[cfg(feature = "monitor")]
use {fipa_monitor::Violation, fipa_transport::Incarnation};

/// A received message.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct Incoming {
    /// The message. Its content may be in shared memory of the sender: it stays readable as long as
    /// this value exists, but another process of the same user can change it.
    pub message: Message,
    /// The letter that carried the message.
    pub letter: Letter,
    /// The transport that handed the letter to this process; `None` for a letter from this
    /// process itself.
    pub via: Option<Kind>,
    #[cfg(feature = "monitor")]
    violation: Option<Box<Violation>>,
    /// The registration of the sending agent, as far as the service that handed the letter over proves
    /// it; unknown for an agent of a legacy peer, and for letters of this process itself.
    #[cfg(feature = "monitor")]
    pub(crate) sender: Incarnation,
}

impl Incoming {
    pub(crate) fn new(message: Message, received: Received) -> Self {
        Self {
            message,
            #[cfg(feature = "monitor")]
            sender: received.sender,
            letter: received.letter,
            via: received.via,
            #[cfg(feature = "monitor")]
            violation: None,
        }
    }

    /// Returns the message. Its content may be in shared memory of the sender: it stays readable as long
    /// as this value exists, but another process of the same user can change it.
    #[must_use]
    pub fn message(&self) -> &Message {
        &self.message
    }

    /// Returns the violation of the message's protocol, if there is one and `monitor.check` is `warn`
    /// or `enforce`.
    ///
    /// The agent that sent the message has made the mistake, and the receiving agent goes on. An
    /// application that acts on messages must not act on such a message.
    ///
    /// ```no_run
    /// # async fn example(agent: fipa::Agent) -> Result<(), fipa::ReceiveError> {
    /// loop {
    ///     let incoming = agent.receive().await?;
    ///     if let Some(violation) = incoming.violation() {
    ///         eprintln!("ignored: {violation}");
    ///         continue;
    ///     }
    ///     println!("{}", incoming.message);
    /// }
    /// # }
    /// ```
    #[cfg(feature = "monitor")]
    #[must_use]
    pub fn violation(&self) -> Option<&Violation> {
        self.violation.as_deref()
    }

    #[cfg(feature = "monitor")]
    pub(crate) fn violates(&mut self, violation: Box<Violation>) {
        self.violation = Some(violation);
    }

    /// Separates the message from its violation.
    #[cfg(feature = "monitor")]
    pub(crate) fn into_parts(self) -> (Message, Option<Box<Violation>>) {
        (self.message, self.violation)
    }
}
