//! A message as the checks read it.

use std::borrow::Cow;
use std::time::SystemTime;

use crate::protocol::act::{Act, ActNumber};

/// A message with the values that every check of it needs.
pub(crate) struct ObservedMessage<'a> {
    pub(crate) act: Act<'a>,
    pub(crate) conversation_id: &'a str,
    pub(crate) protocol: Option<&'a str>,
    pub(crate) sender: &'a str,
    /// The receivers, each once.
    pub(crate) receivers: &'a [Cow<'a, str>],
    pub(crate) reply_with: u64,
    pub(crate) reply_with_text: &'a str,
    pub(crate) in_reply_to: u64,
    /// The agents that receive replies instead of the sender.
    pub(crate) reply_to: &'a [Cow<'a, str>],
    pub(crate) reply_by: Option<SystemTime>,
    /// All receivers of the message, if this is the copy for one of them.
    pub(crate) addressed: &'a [Cow<'a, str>],
    /// The peer to which a conversation belongs that the message begins, if it is not the sender.
    pub(crate) peer: Option<&'a str>,
    /// Whether the sender is the monitored agent.
    pub(crate) own: bool,
    /// The agent that did not get a message, if this is the report of a message transport service.
    pub(crate) undelivered_to: Option<&'a str>,
    /// Index of the monitored agent in the receivers, if another agent is the sender.
    pub(crate) own_receiver: Option<usize>,
}

/// A message that was accepted before, and was not delivered to one receiver.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SentMessage<'a> {
    pub(crate) sender: &'a str,
    pub(crate) receiver: &'a str,
    pub(crate) act: ActNumber,
    pub(crate) reply_with: u64,
}
