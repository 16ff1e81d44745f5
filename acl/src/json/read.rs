//! Conversion of JSON to messages and letters.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

use super::{AgentJson, MessageJson, ParamsJson, ReceivedJson};
use crate::{
    AclRepresentation, AgentId, AgentIdError, BuildError, Envelope, EnvelopeParams, Message,
    PerformativeError, Received, Time, TimeError,
};

/// A message or a letter that a JSON document describes.
#[derive(Debug, Clone, PartialEq, Eq)]
#[allow(clippy::exhaustive_enums, reason = "the format has only these kinds")]
pub enum Document {
    /// A message.
    Message(Message),
    /// A letter with a message.
    Letter(Box<Envelope>, Message),
    /// A letter with an encoded payload. The payload is empty for an envelope alone.
    EncodedLetter(Box<Envelope>, Vec<u8>),
}

/// Reads a message or a letter from JSON: see the [module](super).
///
/// # Errors
/// The JSON has another structure, unknown keys, or values that a message or an envelope cannot
/// have.
pub fn document_from_json(json: &Value) -> Result<Document, JsonError> {
    if json.get("envelope").is_some() {
        return letter(shaped(json)?);
    }
    if json.get("message").is_some() {
        let wrapped: WrappedJson = shaped(json)?;
        let message = message_from_json(&wrapped.message).map_err(within("message"))?;
        return Ok(Document::Message(message));
    }
    message_from_json(json).map(Document::Message)
}

/// Reads a message from JSON: see the [module](super).
///
/// # Errors
/// The JSON has another structure, unknown keys, or values that a message cannot have.
pub fn message_from_json(json: &Value) -> Result<Message, JsonError> {
    let json: MessageJson = shaped(json)?;
    let performative = json.performative.parse();
    let mut builder = Message::builder(performative.map_err(at("performative"))?);
    if let Some(sender) = json.sender {
        builder = builder.sender(agent(sender).map_err(within("sender"))?);
    }
    builder = builder.receivers(agents(json.receivers, "receivers")?);
    for agent in agents(json.reply_to, "reply_to")? {
        builder = builder.reply_to(agent);
    }
    builder = match (json.content, json.content_base64) {
        (None, None) => builder,
        (Some(text), None) => builder.content(text),
        (None, Some(encoded)) => builder.content(base64(&encoded).map_err(at("content_base64"))?),
        (Some(_), Some(_)) => return Err(at("content")(JsonProblem::TwoContents)),
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
        builder = builder.reply_by(time(&text).map_err(at("reply_by"))?);
    }
    for (name, text) in json.user_defined {
        builder = builder.user_defined(name, text);
    }
    builder.build().map_err(at(""))
}

/// Error of reading a message or a letter from JSON: the path of the value and the problem.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{}{problem}", if path.is_empty() { String::new() } else { format!("{path}: ") })]
pub struct JsonError {
    path: String,
    problem: JsonProblem,
}

impl JsonError {
    /// Path of the invalid value, for example `message.receivers[1].name`. Empty for the whole
    /// document.
    #[must_use]
    pub fn path(&self) -> &str {
        &self.path
    }

    /// The problem of the value.
    #[must_use]
    pub fn problem(&self) -> &JsonProblem {
        &self.problem
    }
}

/// A problem of a JSON document.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum JsonProblem {
    /// The JSON has another structure.
    #[error("{0}")]
    Shape(String),
    /// A performative that is not a word.
    #[error(transparent)]
    Performative(#[from] PerformativeError),
    /// An invalid agent identifier.
    #[error(transparent)]
    AgentId(#[from] AgentIdError),
    /// An invalid time.
    #[error(transparent)]
    Time(#[from] TimeError),
    /// Text that is not base64.
    #[error("not base64: {0}")]
    Base64(String),
    /// The content is given twice.
    #[error("give either content or content_base64, not both")]
    TwoContents,
    /// The payload of a letter is given twice.
    #[error("give either message or payload_base64, not both")]
    TwoPayloads,
    /// A value that a message cannot have.
    #[error(transparent)]
    Build(#[from] BuildError),
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct WrappedJson {
    message: Value,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct LetterJson {
    envelope: EnvelopeJson,
    #[serde(rename = "effective")]
    _effective: Option<serde::de::IgnoredAny>,
    message: Option<Value>,
    payload_base64: Option<String>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct EnvelopeJson {
    base: ParamsJson,
    #[serde(default)]
    extensions: Vec<ParamsJson>,
}

fn letter(json: LetterJson) -> Result<Document, JsonError> {
    let envelope = Box::new(envelope(json.envelope).map_err(within("envelope"))?);
    match (json.message, json.payload_base64) {
        (Some(message), None) => {
            let message = message_from_json(&message).map_err(within("message"))?;
            Ok(Document::Letter(envelope, message))
        }
        (None, payload) => {
            let payload = base64(&payload.unwrap_or_default()).map_err(at("payload_base64"))?;
            Ok(Document::EncodedLetter(envelope, payload))
        }
        (Some(_), Some(_)) => Err(at("payload_base64")(JsonProblem::TwoPayloads)),
    }
}

fn envelope(json: EnvelopeJson) -> Result<Envelope, JsonError> {
    let base = params(json.base).map_err(within("base"))?;
    let extensions = json.extensions.into_iter().enumerate();
    let extensions = extensions
        .map(|(index, json)| params(json).map_err(within(&format!("extensions[{index}]"))));
    Ok(Envelope {
        base,
        extensions: extensions.collect::<Result<_, _>>()?,
    })
}

fn params(json: ParamsJson) -> Result<EnvelopeParams, JsonError> {
    let from = json.from.map(agent).transpose().map_err(within("from"))?;
    let date = json.date.as_deref().map(time).transpose();
    let received = json.received.map(received).transpose();
    Ok(EnvelopeParams {
        to: agents(json.to, "to")?,
        from,
        comments: json.comments,
        acl_representation: json
            .acl_representation
            .as_deref()
            .map(AclRepresentation::from),
        payload_length: json.payload_length,
        payload_encoding: json.payload_encoding,
        date: date.map_err(at("date"))?,
        intended_receivers: agents(json.intended_receivers, "intended_receivers")?,
        received: received.map_err(within("received"))?,
        transport_behaviour: json.transport_behaviour,
        user_defined: json.user_defined.into_iter().collect(),
    })
}

fn received(json: ReceivedJson) -> Result<Received, JsonError> {
    Ok(Received {
        by: json.by,
        from: json.from,
        date: time(&json.date).map_err(at("date"))?,
        id: json.id,
        via: json.via,
        user_defined: json.user_defined.into_iter().collect(),
    })
}

fn agents(json: Vec<AgentJson>, key: &str) -> Result<Vec<AgentId>, JsonError> {
    let agents = json.into_iter().enumerate();
    let agents =
        agents.map(|(index, json)| agent(json).map_err(within(&format!("{key}[{index}]"))));
    agents.collect()
}

fn agent(json: AgentJson) -> Result<AgentId, JsonError> {
    let result = AgentId::new(json.name).map_err(at("name"))?;
    let mut result = result.received();
    for (index, address) in json.addresses.into_iter().enumerate() {
        let added = result.with_address(address);
        result = added.map_err(at(&format!("addresses[{index}]")))?;
    }
    for (index, resolver) in agents(json.resolvers, "resolvers")?.into_iter().enumerate() {
        let added = result.with_resolver(resolver);
        result = added.map_err(at(&format!("resolvers[{index}]")))?;
    }
    for (name, text) in json.user_defined {
        let added = result.with_user_defined(name, text);
        result = added.map_err(at("user_defined"))?;
    }
    Ok(result)
}

fn time(text: &str) -> Result<Time, TimeError> {
    Time::from_rfc3339(text).or_else(|error| text.parse().map_err(|_| error))
}

fn base64(encoded: &str) -> Result<Vec<u8>, JsonProblem> {
    let decoded = BASE64.decode(encoded);
    decoded.map_err(|error| JsonProblem::Base64(error.to_string()))
}

/// Deserializes the JSON.
fn shaped<T: DeserializeOwned>(json: &Value) -> Result<T, JsonError> {
    serde_path_to_error::deserialize(json).map_err(|error| {
        let path = error.path().to_string();
        JsonError {
            // `serde_path_to_error` writes "." for the whole document.
            path: if path == "." { String::new() } else { path },
            problem: JsonProblem::Shape(error.inner().to_string()),
        }
    })
}

/// Makes an error of a problem at a key.
fn at<P: Into<JsonProblem>>(key: &str) -> impl Fn(P) -> JsonError {
    move |problem| JsonError {
        path: key.to_owned(),
        problem: problem.into(),
    }
}

/// Puts a key in front of the path of an error.
fn within(key: &str) -> impl Fn(JsonError) -> JsonError {
    move |error| JsonError {
        path: match &*error.path {
            "" => key.to_owned(),
            path => format!("{key}.{path}"),
        },
        problem: error.problem,
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::json::{letter_to_json, message_to_json};

    #[test]
    fn a_message_is_the_same_after_a_round_trip() {
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
    fn content_is_text_or_base64_but_not_both() {
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
        assert_eq!(both.unwrap_err().problem(), &JsonProblem::TwoContents);
        let wrong = with(json!({ "content_base64": "?" })).unwrap_err();
        assert_eq!(wrong.path(), "content_base64");
        assert!(matches!(wrong.problem(), JsonProblem::Base64(_)));
    }

    #[test]
    fn errors_have_the_path_and_the_problem() {
        let base = json!({ "acl_representation": "x", "date": "2026-11-20T11:26:44.998Z" });
        let agents = json!([{ "name": "a" }, { "name": "b", "resolvers": [{ "name": "" }] }]);
        for (json, path, part) in [
            (json!({}), "", "performative"),
            (json!([]), "", "invalid"),
            (
                json!({ "performative": "inform", "recievers": [] }),
                "recievers",
                "unknown",
            ),
            (
                json!({ "performative": "in form" }),
                "performative",
                "in form",
            ),
            (
                json!({ "message": { "performative": "inform", "sender": { "name": "" } } }),
                "message.sender.name",
                "must not be empty",
            ),
            (
                json!({ "performative": "inform", "sender": { "name": 7 } }),
                "sender.name",
                "string",
            ),
            (
                json!({ "performative": "inform", "reply_by": "soon" }),
                "reply_by",
                "soon",
            ),
            (
                json!({ "performative": "inform", "protocol": "a b" }),
                "",
                "a b",
            ),
            (
                json!({ "performative": "inform", "user_defined": { "k": 1 } }),
                "user_defined.k",
                "string",
            ),
            (json!({ "message": {}, "extra": 1 }), "extra", "unknown"),
            (json!({ "envelope": {} }), "envelope", "base"),
            (
                json!({ "envelope": { "base": { "to": agents } } }),
                "envelope.base.to[1].resolvers[0].name",
                "must not be empty",
            ),
            (
                json!({ "envelope": { "base": base, "extensions": [{ "date": "soon" }] } }),
                "envelope.extensions[0].date",
                "soon",
            ),
            (
                json!({ "envelope": { "base": { "received": { "by": "x", "date": "" } } } }),
                "envelope.base.received.date",
                "date-time",
            ),
            (
                json!({ "envelope": { "base": base }, "message": { "performative": "a b" } }),
                "message.performative",
                "a b",
            ),
            (
                json!({ "envelope": { "base": base }, "payload_base64": "?" }),
                "payload_base64",
                "base64",
            ),
            (
                json!({ "envelope": { "base": base }, "message": {}, "payload_base64": "" }),
                "payload_base64",
                "not both",
            ),
        ] {
            let error = document_from_json(&json).unwrap_err();
            assert_eq!(error.path(), path, "{error}");
            assert!(error.to_string().contains(part), "{error}");
        }
    }

    #[test]
    fn a_letter_is_the_same_after_a_round_trip() {
        let letter = json!({
            "envelope": {
                "base": {
                    "to": [{ "name": "b", "addresses": ["tcp://h:1"] }],
                    "from": { "name": "a" },
                    "comments": "c", "acl_representation": "fipa.acl.rep.bitefficient.std",
                    "payload_length": 4, "payload_encoding": "utf-8",
                    "date": "2026-11-20T11:26:44.998Z",
                    "intended_receivers": [{ "name": "b" }],
                    "transport_behaviour": "t", "user_defined": { "k": "v" },
                },
                "extensions": [{
                    "received": {
                        "by": "m", "from": "f", "date": "2026-11-20T11:26:45.000Z",
                        "id": "i", "via": "v", "user_defined": { "k": "v" },
                    },
                }],
            },
            "message": { "performative": "inform" },
        });
        let Document::Letter(envelope, message) = document_from_json(&letter).unwrap() else {
            panic!("a letter with a message expected");
        };
        let mut printed = letter_to_json(&envelope, &message.to_payload());
        // The output, which has the effective parameters too, is accepted as input.
        let again = document_from_json(&printed).unwrap();
        assert_eq!(again, Document::Letter(envelope.clone(), message));
        printed.as_object_mut().unwrap().remove("effective");
        assert_eq!(printed, letter);

        let alone = json!({ "envelope": letter["envelope"] });
        let expected = Document::EncodedLetter(envelope.clone(), Vec::new());
        assert_eq!(document_from_json(&alone), Ok(expected));
        let binary = json!({ "envelope": letter["envelope"], "payload_base64": "/w==" });
        let expected = Document::EncodedLetter(envelope, vec![0xff]);
        assert_eq!(document_from_json(&binary), Ok(expected));
    }

    #[test]
    fn relative_times_stay_relative() {
        let json = json!({ "performative": "inform", "reply_by": "+00000000T000030000" });
        let message = message_from_json(&json).unwrap();
        assert!(message.reply_by().unwrap().is_relative());
        assert_eq!(message_to_json(&message), json);
    }
}
