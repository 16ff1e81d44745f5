//! The JSON format of the letters.
//!
//! ```json
//! { "version": 1, "tell": "again" }
//! { "version": 1, "tell": "goodbye" }
//! { "version": 1, "tell": { "full": { "version": 7, "first": true, "last": false, "agents": [agent] } } }
//! { "version": 1, "tell": { "changes": { "from": 7, "to": 9, "agents": [agent], "left": [name] } } }
//! agent = { "name", "type", "id", "description", "registered": milliseconds since 1970, UTC,
//!           "coalition": { "members": [name], "leader": name }, for a coalition }
//! ```
//!
//! The agents' location is not part of the format: it is that of the gateway that sent the letter.
//! Unknown keys are ignored, so that a later version may add some.

use std::sync::Arc;

use fipa_transport::Incarnation;
use serde::de::Error as _;
use serde::{Deserialize, Serialize};

use crate::entry::millis_of_time;
use crate::{Entry, Members, Role};

const VERSION: u32 = 1;

#[derive(Debug, Serialize, Deserialize)]
struct Envelope<T> {
    version: u32,
    tell: T,
}

/// One letter.
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum ExchangeMessage {
    /// Requests all entries again.
    Again,
    /// The gateway is closing.
    Goodbye,
    Full(Full),
    Changes(Changes),
}

/// Some of the entries of this version. The letters from `first` to `last` contain all.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Full {
    pub(super) version: u64,
    pub(super) first: bool,
    pub(super) last: bool,
    pub(super) agents: Vec<Agent>,
}

/// The changes from one version to a later one.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Changes {
    pub(super) from: u64,
    pub(super) to: u64,
    /// New and changed agents.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(super) agents: Vec<Agent>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(super) left: Vec<String>,
}

#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Agent {
    pub(super) name: String,
    #[serde(rename = "id")]
    pub(super) incarnation: Incarnation,
    #[serde(rename = "type", default, skip_serializing_if = "String::is_empty")]
    pub(super) agent_type: String,
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub(super) description: String,
    pub(super) registered: u64,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) coalition: Option<Members>,
}

impl Agent {
    pub(super) fn of(entry: &Arc<Entry>) -> Self {
        Self {
            name: entry.name.to_string(),
            incarnation: entry.incarnation,
            agent_type: entry.agent_type.clone(),
            description: entry.description.clone(),
            registered: millis_of_time(entry.registered),
            coalition: match &entry.role {
                Role::Coalition(members) => Some(members.clone()),
                _ => None,
            },
        }
    }
}

pub(super) fn encode(tell: &ExchangeMessage) -> Vec<u8> {
    let version = VERSION;
    // Serialization of text, numbers and lists cannot fail.
    serde_json::to_vec(&Envelope { version, tell }).unwrap_or_default()
}

pub(super) fn decode(content: &[u8]) -> Result<ExchangeMessage, serde_json::Error> {
    let envelope: Envelope<ExchangeMessage> = serde_json::from_slice(content)?;
    match envelope.version {
        VERSION => Ok(envelope.tell),
        other => Err(serde_json::Error::custom(format!(
            "version {other} is not supported"
        ))),
    }
}
