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
//! Keys appear only when set. Times are RFC 3339 UTC with milliseconds (a time without a zone is
//! taken as UTC), relative times as FIPA00070 writes them. `content` is there when the content is
//! UTF-8, `content_base64` otherwise; on input either may be given. Names of user-defined
//! parameters come without their `X-`.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use serde::{Deserialize, Serialize, Serializer};
use serde_json::{Map, Value};

use crate::{
    AgentId, AgentIdError, BuildError, Envelope, EnvelopeParams, Message, Payload,
    PerformativeError, Received, Time, TimeError,
};

/// The message as JSON.
#[must_use]
pub fn message_to_json(message: &Message) -> Value {
    let (content, content_base64) = match message.content() {
        None => (None, None),
        // Copied before it is looked at: nobody vouches that shared memory stays as it is.
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

/// The message that the JSON describes.
///
/// # Errors
/// When the JSON has another shape, unknown keys, or values that a message cannot have.
pub fn message_from_json(json: &Value) -> Result<Message, JsonError> {
    let json =
        MessageJson::deserialize(json).map_err(|error| JsonError::Shape(error.to_string()))?;
    let mut builder = Message::builder(json.performative.parse()?);
    if let Some(sender) = json.sender {
        builder = builder.sender(sender.agent()?);
    }
    for receiver in json.receivers {
        builder = builder.receiver(receiver.agent()?);
    }
    for agent in json.reply_to {
        builder = builder.reply_to(agent.agent()?);
    }
    builder = match (json.content, json.content_base64) {
        (None, None) => builder,
        (Some(text), None) => builder.content(text),
        (None, Some(encoded)) => {
            let bytes = BASE64.decode(encoded);
            builder.content(bytes.map_err(|error| JsonError::Base64(error.to_string()))?)
        }
        (Some(_), Some(_)) => return Err(JsonError::TwoContents),
    };
    if let Some(text) = json.language {
        builder = builder.language(text);
    }
    if let Some(text) = json.encoding {
        builder = builder.encoding(text);
    }
    if let Some(text) = json.ontology {
        builder = builder.ontology(text);
    }
    if let Some(text) = json.protocol {
        builder = builder.protocol(text);
    }
    if let Some(text) = json.conversation_id {
        builder = builder.conversation_id(text);
    }
    if let Some(text) = json.reply_with {
        builder = builder.reply_with(text);
    }
    if let Some(text) = json.in_reply_to {
        builder = builder.in_reply_to(text);
    }
    if let Some(text) = json.reply_by {
        builder = builder.reply_by(parse_time(&text)?);
    }
    for (name, text) in text_pairs(json.user_defined)? {
        builder = builder.user_defined(name, text);
    }
    Ok(builder.build()?)
}

/// The envelope as JSON.
#[must_use]
pub fn envelope_to_json(envelope: &Envelope) -> Value {
    let mut json = Map::new();
    json.insert("base".to_owned(), params_to_json(&envelope.base));
    let extensions = envelope.extensions.iter().map(params_to_json).collect();
    json.insert("extensions".to_owned(), Value::Array(extensions));
    Value::Object(json)
}

/// A letter as JSON: its envelope, the parameters that count, and the message, or the payload as
/// it is if it is none that can be read.
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

/// JSON that describes no message.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum JsonError {
    /// The JSON has another shape than a message.
    #[error("not a message: {0}")]
    Shape(String),
    /// A performative that is no word.
    #[error(transparent)]
    Performative(#[from] PerformativeError),
    /// An agent identifier that cannot be.
    #[error(transparent)]
    AgentId(#[from] AgentIdError),
    /// A time that is none.
    #[error("reply_by: {0}")]
    Time(#[from] TimeError),
    /// Content that is not base64.
    #[error("content_base64: {0}")]
    Base64(String),
    /// Content is given twice.
    #[error("give either content or content_base64, not both")]
    TwoContents,
    /// The value of a user-defined parameter is not a string.
    #[error("the value of the user-defined parameter {0:?} is not a string")]
    UserDefined(String),
    /// A value that no message can have.
    #[error(transparent)]
    Build(#[from] BuildError),
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
    #[serde(default, skip_serializing_if = "Map::is_empty")]
    user_defined: Map<String, Value>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct AgentJson {
    name: String,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    addresses: Vec<String>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    resolvers: Vec<Self>,
    #[serde(default, skip_serializing_if = "Map::is_empty")]
    user_defined: Map<String, Value>,
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

    fn agent(self) -> Result<AgentId, JsonError> {
        let mut agent = AgentId::new(self.name)?;
        for address in self.addresses {
            agent = agent.with_address(address)?;
        }
        for resolver in self.resolvers {
            agent = agent.with_resolver(resolver.agent()?)?;
        }
        for (name, text) in text_pairs(self.user_defined)? {
            agent = agent.with_user_defined(name, text)?;
        }
        Ok(agent)
    }
}

#[derive(Serialize)]
struct ParamsJson<'a> {
    #[serde(skip_serializing_if = "Vec::is_empty")]
    to: Vec<AgentJson>,
    #[serde(skip_serializing_if = "Option::is_none")]
    from: Option<AgentJson>,
    #[serde(skip_serializing_if = "Option::is_none")]
    comments: Option<&'a str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    acl_representation: Option<&'a str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    payload_length: Option<u64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    payload_encoding: Option<&'a str>,
    #[serde(skip_serializing_if = "Option::is_none", serialize_with = "time")]
    date: Option<Time>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    intended_receivers: Vec<AgentJson>,
    #[serde(skip_serializing_if = "Option::is_none")]
    received: Option<ReceivedJson<'a>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    transport_behaviour: Option<&'a str>,
    #[serde(skip_serializing_if = "Map::is_empty")]
    user_defined: Map<String, Value>,
}

#[derive(Serialize)]
struct ReceivedJson<'a> {
    by: &'a str,
    #[serde(skip_serializing_if = "Option::is_none")]
    from: Option<&'a str>,
    date: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    id: Option<&'a str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    via: Option<&'a str>,
    #[serde(skip_serializing_if = "Map::is_empty")]
    user_defined: Map<String, Value>,
}

fn params_to_json(params: &EnvelopeParams) -> Value {
    value(&ParamsJson {
        to: agents(&params.to),
        from: params.from.as_ref().map(AgentJson::of),
        comments: params.comments.as_deref(),
        acl_representation: params.acl_representation.as_ref().map(|name| name.as_str()),
        payload_length: params.payload_length,
        payload_encoding: params.payload_encoding.as_deref(),
        date: params.date,
        intended_receivers: agents(&params.intended_receivers),
        received: params.received.as_ref().map(received_json),
        transport_behaviour: params.transport_behaviour.as_deref(),
        user_defined: pairs(&params.user_defined),
    })
}

fn received_json(received: &Received) -> ReceivedJson<'_> {
    ReceivedJson {
        by: &received.by,
        from: received.from.as_deref(),
        date: time_text(received.date),
        id: received.id.as_deref(),
        via: received.via.as_deref(),
        user_defined: pairs(&received.user_defined),
    }
}

fn value(json: &impl Serialize) -> Value {
    // Structures of strings, numbers and maps with string keys always become JSON.
    serde_json::to_value(json).unwrap_or_default()
}

fn agents(agents: &[AgentId]) -> Vec<AgentJson> {
    agents.iter().map(AgentJson::of).collect()
}

/// Of several values under one name the last one remains.
fn pairs(pairs: &[(String, String)]) -> Map<String, Value> {
    pairs
        .iter()
        .map(|(name, text)| (name.clone(), Value::String(text.clone())))
        .collect()
}

fn text_pairs(map: Map<String, Value>) -> Result<Vec<(String, String)>, JsonError> {
    map.into_iter()
        .map(|(name, value)| match value {
            Value::String(text) => Ok((name, text)),
            _ => Err(JsonError::UserDefined(name)),
        })
        .collect()
}

fn time_text(time: Time) -> String {
    time.to_rfc3339().unwrap_or_else(|| time.to_string())
}

fn time<S: Serializer>(time: &Option<Time>, serializer: S) -> Result<S::Ok, S::Error> {
    time.map(time_text).serialize(serializer)
}

fn parse_time(text: &str) -> Result<Time, TimeError> {
    Time::from_rfc3339(text).or_else(|error| text.parse().map_err(|_| error))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn a_message_survives() {
        let json = json!({
            "performative": "request",
            "sender": { "name": "a", "addresses": ["tcp://h:1"], "resolvers": [{ "name": "r" }],
                        "user_defined": { "k": "v" } },
            "receivers": [{ "name": "b" }],
            "reply_to": [{ "name": "c" }],
            "content": "grüß",
            "language": "l", "encoding": "e", "ontology": "o", "protocol": "p",
            "conversation_id": "c 1", "reply_with": "r", "in_reply_to": "i",
            "reply_by": "2010-12-23T12:00:37.980Z",
            "user_defined": { "prio": "7" },
        });
        let message = message_from_json(&json).unwrap();
        assert_eq!(message_to_json(&message), json);
    }

    #[test]
    fn content_comes_either_way_but_not_both() {
        let with = |content: Value| {
            let mut json = json!({ "performative": "inform" });
            json.as_object_mut()
                .unwrap()
                .extend(content.as_object().unwrap().clone());
            message_from_json(&json)
        };
        let binary = with(json!({ "content_base64": "//8=" })).unwrap();
        assert_eq!(binary.content().unwrap(), &b"\xff\xff"[..]);
        assert_eq!(message_to_json(&binary)["content_base64"], "//8=");
        let text = with(json!({ "content_base64": "aGk=" })).unwrap();
        assert_eq!(message_to_json(&text)["content"], "hi");
        let both = with(json!({ "content": "a", "content_base64": "aGk=" }));
        assert_eq!(both, Err(JsonError::TwoContents));
        assert!(matches!(
            with(json!({ "content_base64": "?" })),
            Err(JsonError::Base64(_))
        ));
    }

    #[test]
    fn mistakes_are_named() {
        for (json, part) in [
            (json!({}), "performative"),
            (
                json!({ "performative": "inform", "recievers": [] }),
                "recievers",
            ),
            (json!({ "performative": "in form" }), "in form"),
            (
                json!({ "performative": "inform", "sender": { "name": "" } }),
                "name",
            ),
            (
                json!({ "performative": "inform", "reply_by": "soon" }),
                "soon",
            ),
            (
                json!({ "performative": "inform", "protocol": "a b" }),
                "a b",
            ),
            (
                json!({ "performative": "inform", "user_defined": { "k": 1 } }),
                "k",
            ),
        ] {
            let error = message_from_json(&json).unwrap_err().to_string();
            assert!(error.contains(part), "{error}");
        }
    }

    #[test]
    fn relative_times_stay_relative() {
        let json = json!({ "performative": "inform", "reply_by": "+00000000T000030000" });
        let message = message_from_json(&json).unwrap();
        assert!(message.reply_by().unwrap().is_relative());
        assert_eq!(message_to_json(&message), json);
    }
}
