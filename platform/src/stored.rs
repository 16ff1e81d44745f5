//! The state that a successor of an agent takes over: descriptions, and subscriptions of agents without a
//! registration.
//!
//! The values are serialized by the caller. What is read again is checked like the request that it came
//! from, because the file between the two is a value from outside.

use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_acl::{AgentId, Dialect as AclDialect, Message, MessageBuilder, Payload, Representation};
use fipa_content::{Content, SlDialect, Term, Wff};
use serde::{Deserialize, Serialize};

use crate::{Asker, Platform, limits, request};

/// Maximum number of changed descriptions of a subscription that are listed. Of a subscription with
/// more, all descriptions that match count as changed.
pub(crate) const CHANGES: usize = 256;

/// Bytes that are text, with rare exceptions.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
pub(crate) enum Text {
    Text(Arc<str>),
    Bytes(Vec<u8>),
}

impl Text {
    pub(crate) fn new(bytes: Vec<u8>) -> Self {
        match String::from_utf8(bytes) {
            Ok(text) => Self::Text(text.into()),
            Err(error) => Self::Bytes(error.into_bytes()),
        }
    }

    /// Returns the text of an object.
    pub(crate) fn of_term(term: &Term<'_>) -> Option<Self> {
        request::print(SlDialect::Standard, term)
            .ok()
            .map(Self::new)
    }

    pub(crate) fn as_bytes(&self) -> &[u8] {
        match self {
            Self::Text(text) => text.as_bytes(),
            Self::Bytes(bytes) => bytes,
        }
    }
}

/// Reads the text of one object.
pub(crate) fn read_object<T>(text: &[u8], read: impl FnOnce(&Term<'_>) -> Option<T>) -> Option<T> {
    // The terms around it are those of answers, so that what is read here can be printed there.
    let text = [b"((= x (sequence ", text, b")))"].concat();
    let content = Content::parse(&text).ok()?;
    let Ok(Wff::Equal(_, list)) = content.wff() else {
        return None;
    };
    match list.elements()? {
        [term] => read(term),
        _ => None,
    }
}

/// A description in a directory facilitator or an agent management system.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct StoredDescription {
    /// The name of the agent.
    pub name: Arc<str>,
    /// The registration of the agent: see [`Asker::registration`].
    pub registration: u64,
    /// The platform of the agent.
    pub platform: Platform,
    /// The rest of the lease in milliseconds, if there is one.
    #[serde(rename = "left")]
    pub lease_left: Option<u64>,
    /// The description in FIPA-SL.
    pub(crate) text: Text,
}

impl StoredDescription {
    /// Returns the end of the lease, `elapsed` after the description was kept.
    pub(crate) fn ends(&self, now: Instant, elapsed: Duration) -> Option<Instant> {
        let lease_left = self.lease_left.map(Duration::from_millis);
        let lease_left = match self.platform {
            Platform::Host => lease_left?,
            _ => lease_left.unwrap_or(limits::LEASE).min(limits::LEASE),
        };
        // A lease beyond the range of the clock does not end.
        now.checked_add(lease_left.saturating_sub(elapsed))
    }
}

/// Returns the rest of a lease.
pub(crate) fn lease_left(now: Instant, ends: Option<Instant>) -> Option<u64> {
    let lease_left = ends?.saturating_duration_since(now).as_millis();
    Some(u64::try_from(lease_left).unwrap_or(u64::MAX))
}

/// A subscription of an agent without a registration to a directory facilitator.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct StoredSubscription {
    /// The name of the subscriber.
    pub name: Arc<str>,
    /// The platform of the subscriber.
    pub platform: Platform,
    is_jade: bool,
    asked: Option<String>,
    /// The message of the subscriber, without what notifications do not repeat.
    message: Text,
    /// The agents whose descriptions may have changed since the last notification that arrived; `None`
    /// if they are too many.
    pub(crate) changed: Option<Vec<Arc<str>>>,
}

impl StoredSubscription {
    /// Keeps a subscription: the message that made it, and its query.
    pub(crate) fn new(asker: &Asker, message: MessageBuilder, query: &[u8]) -> Option<Self> {
        let content = [b"(", query, b")"].concat();
        let message = message.sender(asker.id.clone()).content(content);
        let message = message.build().ok()?;
        let message = message.encode(Representation::String, AclDialect::Standard);
        Some(Self {
            name: asker.id.name().into(),
            platform: asker.platform,
            is_jade: asker.dialect == SlDialect::Jade,
            asked: asker.asked.as_ref().map(|asked| asked.name().to_owned()),
            message: Text::new(message.ok()?.into()),
            changed: Some(Vec::new()),
        })
    }

    /// Returns the subscriber and its message.
    pub(crate) fn read(&self) -> Option<(Asker, Message)> {
        let payload = Payload::from(bytes::Bytes::copy_from_slice(self.message.as_bytes()));
        let message = Message::decode(&payload).ok()?;
        let id = message.sender()?.clone();
        if *id.name() != *self.name || self.platform == Platform::Host {
            return None;
        }
        let mut asker = Asker::new(id, 0, self.platform);
        if self.is_jade {
            asker.dialect = SlDialect::Jade;
        }
        if let Some(asked) = &self.asked {
            asker.asked = Some(AgentId::new(&**asked).ok()?);
        }
        Some((asker, message))
    }
}
