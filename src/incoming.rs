//! A received message.

use fipa_acl::{Letter, Message};
use fipa_transport::Kind;

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
    /// The violation of the message's protocol, if `monitor.check` is `warn`.
    #[cfg(feature = "monitor")]
    pub violation: Option<Box<fipa_monitor::Violation>>,
}

impl Incoming {
    pub(crate) fn new(message: Message, letter: Letter, via: Option<Kind>) -> Self {
        Self {
            message,
            letter,
            via,
            #[cfg(feature = "monitor")]
            violation: None,
        }
    }
}
