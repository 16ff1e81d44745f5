//! Messages and letters as JSON, for tools and logs.
//!
//! ```text
//! message  = { performative, sender: aid, receivers: [aid], reply_to: [aid],
//!              content | content_base64, language, encoding, ontology, protocol,
//!              conversation_id, reply_with, in_reply_to, reply_by, user_defined: {name: value} }
//! aid      = { name, addresses: [url], resolvers: [aid], user_defined: {name: value} }
//! envelope = { base: params, extensions: [params] }     oldest extension first
//! params   = { to: [aid], from: aid, comments, acl_representation, payload_length,
//!              payload_encoding, date, intended_receivers: [aid],
//!              received: { by, from, date, id, via, user_defined },
//!              transport_behaviour, user_defined }
//! letter   = { envelope, effective: params, message | payload_base64 }
//! ```
//!
//! Absent parameters have no key. Absolute times are in the form of RFC 3339, in UTC and with
//! milliseconds; a time without a zone is taken as UTC. Relative times are in the form of FIPA00070.
//! Output has `content` if the content is UTF-8, and `content_base64` otherwise. Input may have
//! either. Names of user-defined parameters have no `X-`.
//!
//! An input document with the key `envelope` is a letter. Any other document is a message, either
//! directly or as the value of the key `message`. `effective` is ignored on input. A letter with
//! neither `message` nor `payload_base64` is an envelope alone.

mod read;

use std::collections::BTreeMap;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

pub use read::{Document, JsonError, JsonProblem, document_from_json, message_from_json};

use crate::{AgentId, Envelope, EnvelopeParams, Message, Payload, Received, Time};

/// Converts a message to JSON: see the [module](self).
#[must_use]
pub fn message_to_json(message: &Message) -> Value {
    let (content, content_base64) = match message.content() {
        None => (None, None),
        // A copy, because another process may change shared memory at any time.
        Some(bytes) => match String::from_utf8(bytes.to_vec()) {
            Ok(text) => (Some(text), None),
            Err(error) => (None, Some(BASE64.encode(error.as_bytes()))),
        },
    };
    let text = |text: Option<&str>| text.map(str::to_owned);
    value(&MessageJson {
        performative: message.performative().to_string(),
        sender: message.sender().map(AgentJson::of),
        receivers: agents(message.receivers()),
        reply_to: agents(message.reply_to()),
        content,
        content_base64,
        language: text(message.language()),
        encoding: text(message.encoding()),
        ontology: text(message.ontology()),
        protocol: text(message.protocol()),
        conversation_id: text(message.conversation_id()),
        reply_with: text(message.reply_with()),
        in_reply_to: text(message.in_reply_to()),
        reply_by: message.reply_by().map(time_text),
        user_defined: pairs(message.user_defined()),
    })
}

/// Converts an envelope to JSON: see the [module](self).
#[must_use]
pub fn envelope_to_json(envelope: &Envelope) -> Value {
    let mut json = Map::new();
    json.insert("base".to_owned(), params_to_json(&envelope.base));
    let extensions = envelope.extensions.iter().map(params_to_json).collect();
    json.insert("extensions".to_owned(), Value::Array(extensions));
    Value::Object(json)
}

/// Converts a letter to JSON: its envelope, the effective parameters, and the message. A payload
/// that cannot be decoded is written as `payload_base64`.
#[must_use]
pub fn letter_to_json(envelope: &Envelope, payload: &Payload) -> Value {
    let mut json = Map::new();
    json.insert("envelope".to_owned(), envelope_to_json(envelope));
    let effective = params_to_json(&envelope.effective());
    json.insert("effective".to_owned(), effective);
    match Message::decode(payload) {
        Ok(message) => json.insert("message".to_owned(), message_to_json(&message)),
        Err(_) => {
            let encoded = BASE64.encode(payload.to_bytes());
            json.insert("payload_base64".to_owned(), Value::String(encoded))
        }
    };
    Value::Object(json)
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct MessageJson {
    performative: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    sender: Option<AgentJson>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    receivers: Vec<AgentJson>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    reply_to: Vec<AgentJson>,
    #[serde(skip_serializing_if = "Option::is_none")]
    content: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    content_base64: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    language: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    encoding: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    ontology: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    protocol: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    conversation_id: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    reply_with: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    in_reply_to: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    reply_by: Option<String>,
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    user_defined: BTreeMap<String, String>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct AgentJson {
    name: String,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    addresses: Vec<String>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    resolvers: Vec<Self>,
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    user_defined: BTreeMap<String, String>,
}

impl AgentJson {
    fn of(agent: &AgentId) -> Self {
        Self {
            name: agent.name().to_owned(),
            addresses: agent.addresses().to_vec(),
            resolvers: agents(agent.resolvers()),
            user_defined: pairs(agent.user_defined()),
        }
    }
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct ParamsJson {
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    to: Vec<AgentJson>,
    #[serde(skip_serializing_if = "Option::is_none")]
    from: Option<AgentJson>,
    #[serde(skip_serializing_if = "Option::is_none")]
    comments: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    acl_representation: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    payload_length: Option<u64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    payload_encoding: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    date: Option<String>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    intended_receivers: Vec<AgentJson>,
    #[serde(skip_serializing_if = "Option::is_none")]
    received: Option<ReceivedJson>,
    #[serde(skip_serializing_if = "Option::is_none")]
    transport_behaviour: Option<String>,
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    user_defined: BTreeMap<String, String>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct ReceivedJson {
    by: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    from: Option<String>,
    date: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    id: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    via: Option<String>,
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    user_defined: BTreeMap<String, String>,
}

fn params_to_json(params: &EnvelopeParams) -> Value {
    let representation = params.acl_representation.as_ref();
    value(&ParamsJson {
        to: agents(&params.to),
        from: params.from.as_ref().map(AgentJson::of),
        comments: params.comments.clone(),
        acl_representation: representation.map(|name| name.as_str().to_owned()),
        payload_length: params.payload_length,
        payload_encoding: params.payload_encoding.clone(),
        date: params.date.map(time_text),
        intended_receivers: agents(&params.intended_receivers),
        received: params.received.as_ref().map(received_json),
        transport_behaviour: params.transport_behaviour.clone(),
        user_defined: pairs(&params.user_defined),
    })
}

fn received_json(received: &Received) -> ReceivedJson {
    ReceivedJson {
        by: received.by.clone(),
        from: received.from.clone(),
        date: time_text(received.date),
        id: received.id.clone(),
        via: received.via.clone(),
        user_defined: pairs(&received.user_defined),
    }
}

fn value(json: &impl Serialize) -> Value {
    // Structures of strings, numbers and maps with string keys can always be converted.
    serde_json::to_value(json).unwrap_or_default()
}

fn agents(agents: &[AgentId]) -> Vec<AgentJson> {
    agents.iter().map(AgentJson::of).collect()
}

/// Converts pairs to a map. The last of several values with the same name counts.
fn pairs(pairs: &[(String, String)]) -> BTreeMap<String, String> {
    pairs.iter().cloned().collect()
}

fn time_text(time: Time) -> String {
    time.to_rfc3339().unwrap_or_else(|| time.to_string())
}
