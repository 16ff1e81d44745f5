//! The notifications that a subscriber to a topic asks for, and the parameters of the messages that carry the wish.

use std::fmt;
use std::num::NonZeroU32;
use std::str::FromStr;
use std::time::SystemTime;

use fipa_acl::{Message, MessageBuilder, Time};

/// User-defined parameter of a `subscribe` and its `agree`, and of the notifications of a stream: a [`Keep`].
pub(crate) const DELIVERY: &str = "X-delivery";

/// User-defined parameter of a notification: its number, decimal.
pub(super) const SAMPLE: &str = "X-sample";

/// User-defined parameter of a notification: the time of its publication (FIPA00070, UTC, milliseconds).
pub(super) const PUBLISHED: &str = "X-published";

/// Maximum number of notifications of which a publisher keeps the newest for one subscriber.
pub(crate) const MAX_KEPT: u32 = 64;

/// The notifications that a subscriber gets if it is slower than the publisher.
///
/// A subscriber asks for it in its `subscribe` message, and the publisher answers in its `agree`, by the user-defined
/// parameter `X-delivery`: `all`, `latest(n)` or `auto`. A partner that does not know the parameter gets all.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[non_exhaustive]
pub enum Keep {
    /// The newest one of a stream, which is a topic with a [rate](crate::topics::Topic::rate) or with loaned contents; all of others.
    #[default]
    Auto,
    /// Each one. A subscriber that does not receive them slows the publisher down, for at most
    /// [`Topic::wait_for_slow`](crate::topics::Topic::wait_for_slow) per notification.
    All,
    /// The newest `n`, at most 64. An older one that has not left is replaced by a newer one, which the subscriber sees
    /// as a [gap](super::Notification::missed).
    Latest(NonZeroU32),
}

impl Keep {
    /// Returns [`Keep::Latest`] of this number, of 1 for 0.
    #[must_use]
    pub const fn latest(n: u32) -> Self {
        match NonZeroU32::new(n) {
            Some(n) => Self::Latest(n),
            None => Self::Latest(NonZeroU32::MIN),
        }
    }

    /// Returns the number of notifications that are kept for a topic; `None` for all of them.
    pub(crate) fn bound(self, is_stream: bool) -> Option<usize> {
        match self {
            Self::All => None,
            Self::Auto => is_stream.then_some(1),
            Self::Latest(n) => Some(n.get().min(MAX_KEPT) as usize),
        }
    }

    /// Reads the parameter of a message.
    pub(crate) fn of(message: &Message) -> Option<Self> {
        value(message, DELIVERY)?.parse().ok()
    }
}

impl fmt::Display for Keep {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Auto => f.write_str("auto"),
            Self::All => f.write_str("all"),
            Self::Latest(n) => write!(f, "latest({n})"),
        }
    }
}

/// The error if a text is no [`Keep`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("expected auto, all or latest(n), with n from 1")]
#[non_exhaustive]
pub struct KeepError;

impl FromStr for Keep {
    type Err = KeepError;

    fn from_str(text: &str) -> Result<Self, KeepError> {
        match text {
            "auto" => Ok(Self::Auto),
            "all" => Ok(Self::All),
            _ => {
                let n = text
                    .strip_prefix("latest(")
                    .and_then(|n| n.strip_suffix(')'));
                let n = n.and_then(|n| n.parse().ok()).ok_or(KeepError)?;
                Ok(Self::Latest(n))
            }
        }
    }
}

/// Adds the parameters of a notification.
pub(crate) fn marked(
    message: MessageBuilder,
    number: u64,
    published: SystemTime,
    keep: Keep,
) -> MessageBuilder {
    let message = message.user_defined(SAMPLE, number.to_string());
    let message = match keep {
        Keep::Latest(_) => message.user_defined(DELIVERY, keep.to_string()),
        _ => message,
    };
    match Time::from_system_time(published) {
        Ok(published) => message.user_defined(PUBLISHED, published.to_string()),
        Err(_) => message,
    }
}

/// Returns the number of a notification.
pub(super) fn number_of(message: &Message) -> Option<u64> {
    value(message, SAMPLE)?.parse().ok()
}

/// Returns the time of the publication of a notification, by the clock of the publisher's host.
pub(super) fn published_at(message: &Message) -> Option<SystemTime> {
    let time: Time = value(message, PUBLISHED)?.parse().ok()?;
    Some(time.to_system_time(SystemTime::now()))
}

fn value<'m>(message: &'m Message, name: &str) -> Option<&'m str> {
    let mut all = message.user_defined().iter();
    let (_, value) = all.find(|(other, _)| other.eq_ignore_ascii_case(name))?;
    Some(value)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_of_keep_are_read_back() {
        for keep in [Keep::Auto, Keep::All, Keep::latest(1), Keep::latest(7)] {
            assert_eq!(keep.to_string().parse(), Ok(keep));
        }
        for text in ["", "latest", "latest(0)", "latest(-1)", "latest(1", "ALL"] {
            assert_eq!(text.parse::<Keep>(), Err(KeepError), "{text}");
        }
    }

    #[test]
    fn a_stream_keeps_the_newest_by_default_and_no_subscriber_keeps_more_than_the_bound() {
        assert_eq!(Keep::Auto.bound(true), Some(1));
        assert_eq!(Keep::Auto.bound(false), None);
        assert_eq!(Keep::All.bound(true), None);
        assert_eq!(Keep::latest(u32::MAX).bound(false), Some(MAX_KEPT as usize));
    }
}
