//! A message as the checks read it.

use std::borrow::Cow;

use crate::protocol::act::Act;

/// A message with the values that every check of it needs.
pub(crate) struct ObservedMessage<'a> {
    pub(crate) act: Act<'a>,
    pub(crate) sender: &'a str,
    /// The receivers, each once.
    pub(crate) receivers: &'a [Cow<'a, str>],
    pub(crate) reply_with: u64,
    pub(crate) reply_with_text: &'a str,
    pub(crate) in_reply_to: u64,
    /// Whether the sender is the monitored agent.
    pub(crate) own: bool,
    /// The agent that did not get a message, if this is the report of a message transport service.
    pub(crate) undelivered_to: Option<&'a str>,
    /// Index of the monitored agent in the receivers, if another agent is the sender.
    pub(crate) own_receiver: Option<usize>,
}
