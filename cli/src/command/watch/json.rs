//! Output of `fipa watch` as JSON, one object per line.

use fipa::admin::watch::{Fate, Passage};
use fipa::{Attempt, Message, MessageBuilder, Outcome};
use fipa_acl::json::{letter_to_json, message_to_json};
use serde_json::{Map, Value, json};

use super::checker::{CheckResult, Overdue};
use super::tally::Tally;
use crate::output;

fn line(value: &Value) -> String {
    format!("{}\n", output::visible_in_json(&value.to_string()))
}

pub(super) fn watching(domain: &str, processes: usize) -> String {
    line(&json!({ "event": "watching", "domain": domain, "processes": processes }))
}

pub(super) fn letter(passage: &Passage, checked: &CheckResult) -> String {
    line(&Value::Object(letter_object(passage, checked)))
}

/// The object of a letter.
pub(in crate::command) fn letter_object(
    passage: &Passage,
    checked: &CheckResult,
) -> Map<String, Value> {
    let message = passage.message.as_ref();
    let cut = passage
        .content_len
        .is_some_and(|len| len > passage.content.len() as u64 && !passage.content.is_empty());
    let submission = passage
        .submission
        .map(|submission| format!("{}/{submission}", passage.stream.sender));
    let mut object = Map::new();
    let mut put = |key: &str, value: Option<Value>| {
        if let Some(value) = value {
            object.insert(key.to_owned(), value);
        }
    };
    let time = output::rfc3339(passage.at);
    put("event", Some("letter".into()));
    put("number", Some(passage.number.into()));
    put("time", time.map(Value::from));
    put("sender", passage.sender().map(Value::from));
    put("receiver", Some((*passage.receiver).into()));
    put(
        "performative",
        message.map(|it| it.performative().to_string().into()),
    );
    put(
        "protocol",
        message.and_then(|it| it.protocol()).map(Value::from),
    );
    put(
        "conversation_id",
        message.and_then(|it| it.conversation_id()).map(Value::from),
    );
    put("size", Some(passage.size.into()));
    put("content_length", passage.content_len.map(Value::from));
    put("content_cut", cut.then_some(Value::Bool(true)));
    put("via", passage.via.map(|via| via.name().into()));
    put("gateway", passage.gateway.as_deref().map(Value::from));
    put("message", submission.map(Value::from));
    fate(&mut object, &passage.fate);
    object.insert("verdict".to_owned(), verdict(checked));
    object.insert("letter".to_owned(), contents(passage));
    object
}

pub(super) fn later(passage: &Passage) -> String {
    line(&Value::Object(later_object(passage)))
}

/// The object of a later outcome.
pub(in crate::command) fn later_object(passage: &Passage) -> Map<String, Value> {
    let mut object = Map::new();
    object.insert("event".to_owned(), "outcome".into());
    object.insert("number".to_owned(), passage.number.into());
    if let Some(sender) = passage.sender() {
        object.insert("sender".to_owned(), sender.into());
    }
    object.insert("receiver".to_owned(), (*passage.receiver).into());
    if let Some(via) = passage.via {
        object.insert("via".to_owned(), via.name().into());
    }
    fate(&mut object, &passage.fate);
    object
}

/// Adds the state of a delivery.
pub(in crate::command) fn fate(object: &mut Map<String, Value>, fate: &Fate) {
    let outcome = match fate {
        Fate::UnderWay => {
            object.insert("outcome".to_owned(), "under_way".into());
            return;
        }
        Fate::Taken => {
            object.insert("outcome".to_owned(), "taken".into());
            return;
        }
        Fate::Passed(outcome) | Fate::Settled(outcome) => outcome,
    };
    let word = match outcome {
        Outcome::Delivered { .. } => "delivered",
        Outcome::Sent { .. } => "sent",
        _ => "failed",
    };
    object.insert("outcome".to_owned(), word.into());
    if let Outcome::Failed { reason, .. } = outcome {
        object.insert("reason".to_owned(), reason.to_string().into());
    }
    let attempt = |attempt: &Attempt| {
        json!({
            "via": attempt.via.name(),
            "location": attempt.location.to_string(),
            "error": attempt.error.to_string(),
        })
    };
    let attempts: Vec<Value> = outcome.attempts().iter().map(attempt).collect();
    object.insert("attempts".to_owned(), attempts.into());
    let is_settled = matches!(fate, Fate::Settled(_));
    object.insert("settled".to_owned(), is_settled.into());
}

fn verdict(checked: &CheckResult) -> Value {
    match checked {
        CheckResult::Accepted {
            protocol,
            state,
            opened,
            ended,
            complete,
            late,
        } => json!({
            "verdict": "accepted", "protocol": protocol, "state": state, "opened": opened,
            "ended": ended, "complete": complete, "late": late,
        }),
        CheckResult::Violation(violation) => {
            let expected = violation.expected.iter().map(|expected| {
                json!({
                    "performative": expected.performative,
                    "from": expected.from,
                    "to": expected.to,
                })
            });
            json!({
                "verdict": "violation", "kind": violation.kind.as_str(),
                "protocol": violation.protocol, "state": violation.state,
                "participant": violation.participant,
                "expected": expected.collect::<Vec<Value>>(), "text": violation.to_string(),
            })
        }
        CheckResult::Unchecked(why) => json!({ "verdict": "unchecked", "reason": why.to_string() }),
        CheckResult::Excluded(why) => json!({ "verdict": "unchecked", "reason": why }),
        CheckResult::Checked => Value::Null,
    }
}

/// The message with the observed part of its content.
pub(in crate::command) fn message(passage: &Passage) -> Option<Message> {
    let message = passage.message.clone()?;
    // Empty content differs from none.
    let has_empty = passage.content_len == Some(0);
    if passage.content.is_empty() && !has_empty {
        return Some(message);
    }
    let bare = message.clone();
    let with = MessageBuilder::from(message).content(passage.content.clone());
    // A valid message stays valid with any content.
    Some(with.build().unwrap_or(bare))
}

/// The observed parts of the letter, in the format of `fipa decode`.
fn contents(passage: &Passage) -> Value {
    let message = message(passage);
    let mut letter = match passage.envelope.get() {
        Some(envelope) => letter_to_json(envelope, &fipa::Payload::default()),
        None => json!({}),
    };
    if let Some(object) = letter.as_object_mut() {
        object.remove("payload_base64");
        if let Some(message) = message {
            object.insert("message".to_owned(), message_to_json(&message));
        }
    }
    letter
}

pub(super) fn overdue(overdue: &Overdue) -> String {
    line(&overdue_object(overdue))
}

/// The object of an overdue message.
pub(in crate::command) fn overdue_object(overdue: &Overdue) -> Value {
    json!({
        "event": "overdue", "protocol": overdue.protocol,
        "conversation_id": overdue.conversation_id, "participant": overdue.participant,
        "state": overdue.state,
    })
}

pub(super) fn lost(process: &str, records: u64) -> String {
    line(&lost_object(process, records))
}

/// The object of lost records.
pub(in crate::command) fn lost_object(process: &str, records: u64) -> Value {
    json!({ "event": "lost", "process": process, "records": records })
}

pub(super) fn refused(process: &str, error: &str) -> String {
    line(&refused_object(process, error))
}

/// The object of a process whose data is invalid.
pub(in crate::command) fn refused_object(process: &str, error: &str) -> Value {
    json!({ "event": "refused", "process": process, "error": error })
}

pub(super) fn summary(tally: &Tally) -> String {
    line(&json!({
        "event": "summary", "seconds": (tally.seconds() * 1e3).round() / 1e3,
        "letters": tally.letters, "shown": tally.shown,
        "outcomes": {
            "delivered": tally.delivered, "failed": tally.failed, "unknown": tally.open,
        },
        "conversations": tally.conversations(), "violations": tally.violations,
        "lost": tally.lost,
    }))
}
