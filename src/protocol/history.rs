//! Conversations that began elsewhere or earlier.

use std::fmt;

use fipa_monitor::{History, SnapshotError};
use fipa_sds::DeregisterError;

use super::protocols::Protocols;
use crate::agent::checks::Checks;
use crate::agent::{Agent, Unread};

/// An agent that was deregistered in order to register again, on this host or on another one.
pub struct Departure {
    unread: Unread,
    checks: Checks,
}

impl Departure {
    /// Returns the messages that were delivered but not received, in order. They count as received in
    /// the [conversations](Self::conversations).
    pub fn take_unread(&mut self) -> Unread {
        std::mem::take(&mut self.unread)
    }

    /// Returns the states of the agent's conversations, for
    /// [`Protocols::restore_conversations`] of its next registration. Empty if `monitor.check` is off.
    ///
    /// A letter that was sent before the departure may still have its outcome to come. Wait for the
    /// outcomes before this call: an undelivered message that is unknown to the next registration cannot
    /// be sent again under `enforce`.
    ///
    /// The states do not include those that are uncertain: of conversations that began between other
    /// agents, that may have begun before this registration, or whose last message was not delivered; and
    /// of protocols with three or more roles. Their messages are not checked after the move.
    #[must_use]
    pub fn conversations(&self) -> Vec<u8> {
        self.checks.conversations()
    }
}

impl fmt::Debug for Departure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Departure")
            .field("unread", &self.unread.len())
            .finish_non_exhaustive()
    }
}

impl Agent {
    /// [Deregisters](Self::deregister) the agent, which will register again on this host or on another
    /// one, and keeps the states of its conversations.
    ///
    /// ```no_run
    /// # async fn example(agent: fipa::Agent, there: fipa::Domain)
    /// # -> Result<(), Box<dyn std::error::Error>> {
    /// let departure = agent.depart()?;
    /// let conversations = departure.conversations();
    /// // The application transfers the bytes with its own state.
    /// let agent = there.register("arm").await?;
    /// agent.protocols().restore_conversations(&conversations)?;
    /// # Ok(())
    /// # }
    /// ```
    ///
    /// # Errors
    /// See [`deregister`](Self::deregister).
    pub fn depart(self) -> Result<Departure, DeregisterError> {
        let checks = self.core.endpoint.checks.clone();
        let unread = self.deregister()?;
        Ok(Departure { unread, checks })
    }
}

impl Protocols<'_> {
    /// Continues the checks of conversations of an earlier registration, of which
    /// [`Departure::conversations`] returned the states. Returns their number. Call this before the agent
    /// sends or receives a message.
    ///
    /// Messages of these conversations are checked as if the agent had not moved. The bytes are checked
    /// completely. With `monitor.check` off, this does nothing.
    ///
    /// # Errors
    /// If the bytes are malformed, are those of another agent, name a state that the protocols of this
    /// host do not have, or exceed `monitor.bytes`; or if the agent already has conversations. Nothing is
    /// changed, and messages of earlier conversations are not checked.
    pub fn restore_conversations(self, conversations: &[u8]) -> Result<usize, SnapshotError> {
        let checks = &self.core.endpoint.checks;
        checks.restore_conversations(conversations)
    }

    /// Tells the monitor that another agent has begun, or will begin, a conversation with this
    /// identifier and names this agent in a `reply-to` (FIPA00061). The answers that this agent then
    /// receives are not unsolicited.
    ///
    /// Without this call, with `monitor.check` and unless `monitor.exempt` lists the protocol, such an
    /// answer [violates](crate::Incoming::violation) its protocol if its sender is on this host and was
    /// registered after this agent.
    pub fn expect_conversation(self, id: &str) {
        self.core.endpoint.checks.expect_conversation(id);
    }

    /// Sets the extent of the monitor's knowledge about conversations in which this agent took part
    /// under an earlier registration of its name.
    ///
    /// By default, an agent on this host that was registered after this one, and a conversation id of
    /// [`Agent::unique_id`], cannot belong to such a conversation, and all others may. A
    /// message that may continue such a conversation is not checked. An agent that restores its
    /// conversations after a restart sets [`History::Unknown`]: it is then not refused any message that
    /// continues one. An agent with a name that is never used again sets [`History::Complete`].
    pub fn set_history(self, history: History) {
        self.core.endpoint.checks.set_history(history);
    }
}
