//! The ontology in JSON (RFC 8259).

use std::borrow::Cow;

use fipa_acl::AgentId;
use fipa_content::{Arguments, FunctionalTerm, Number, Parameter, Term};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use crate::CANCEL;
use crate::description::ActionDescription;
use crate::language::{Language, LanguageError};
use crate::message::{ActionAnswer, Ask, Failure, Goal, GoalRef, GoalStatus, Refusal};
use crate::types::OBJECT;

/// The key of the function symbol of an object.
const SYMBOL: &str = "@";

/// The key of arguments by position.
const ARGUMENTS: &str = "@arguments";

/// JSON: `json`.
#[derive(Debug, Clone, Copy, Default)]
pub struct Json;

#[derive(Serialize, Deserialize)]
struct JsonAsk {
    agent: String,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    goal: Option<JsonGoal>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    query: Option<JsonQuery>,
    /// The goal that a query for the status is about.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    of: Option<String>,
    /// The client of that goal.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    client: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    cancel: Option<JsonCancel>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct JsonCancel {
    #[serde(default, skip_serializing_if = "Option::is_none")]
    goal: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    client: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    action: Option<String>,
}

#[derive(Serialize, Deserialize)]
struct JsonGoal {
    action: String,
    #[serde(default)]
    arguments: Map<String, Value>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    id: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    deadline: Option<u64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    fence: Option<String>,
}

#[derive(Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum JsonQuery {
    Actions,
    Status,
}

#[derive(Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum JsonAnswer {
    Agreed(String),
    Done,
    Result(Value),
    Refused(Refusal),
    Failed(Failure),
    Actions(Vec<ActionDescription>),
    Status(Vec<Value>),
}

impl Language for Json {
    fn name(&self) -> &'static str {
        "json"
    }

    fn write_ask(&self, robot: &AgentId, ask: &Ask) -> Result<Vec<u8>, LanguageError> {
        let mut json = JsonAsk {
            agent: robot.name().to_owned(),
            goal: None,
            query: None,
            of: None,
            client: None,
            cancel: None,
        };
        match ask {
            Ask::Goal(goal) => {
                json.goal = Some(JsonGoal {
                    action: goal.action.clone(),
                    arguments: object(&goal.arguments)?,
                    id: goal.id.clone(),
                    deadline: goal.deadline,
                    fence: goal.fence.clone(),
                });
            }
            Ask::Actions => json.query = Some(JsonQuery::Actions),
            Ask::Status => json.query = Some(JsonQuery::Status),
            Ask::StatusOf(GoalRef { id, client }) => {
                json.query = Some(JsonQuery::Status);
                json.of = Some(id.clone());
                json.client.clone_from(client);
            }
            Ask::Cancel(GoalRef { id, client }) => {
                json.cancel = Some(JsonCancel {
                    goal: Some(id.clone()),
                    client: client.clone(),
                    action: None,
                });
            }
            Ask::CancelAll(action) => {
                json.cancel = Some(JsonCancel {
                    goal: None,
                    client: None,
                    action: Some(action.clone()),
                });
            }
        }
        Ok(serde_json::to_vec(&json)?)
    }

    fn read_ask(&self, bytes: &[u8]) -> Result<(String, Ask), LanguageError> {
        let json: JsonAsk = serde_json::from_slice(bytes)?;
        const FORM: LanguageError = LanguageError::Form("either a goal, a query or a cancel");
        let of = match (json.of, json.client) {
            (Some(id), client) => Some(GoalRef { id, client }),
            (None, None) => None,
            (None, Some(_)) => return Err(FORM),
        };
        let ask = match (json.goal, json.query, of, json.cancel) {
            (Some(goal), None, None, None) if goal.action == CANCEL => return Err(FORM),
            (Some(goal), None, None, None) => Ask::Goal(Goal {
                action: goal.action,
                arguments: arguments_from_json(goal.arguments)?,
                id: goal.id,
                deadline: goal.deadline,
                fence: goal.fence,
            }),
            (None, Some(JsonQuery::Actions), None, None) => Ask::Actions,
            (None, Some(JsonQuery::Status), None, None) => Ask::Status,
            (None, Some(JsonQuery::Status), Some(goal), None) => Ask::StatusOf(goal),
            (None, None, None, Some(cancel)) => match (cancel.goal, cancel.client, cancel.action) {
                (Some(id), client, None) => Ask::Cancel(GoalRef { id, client }),
                (None, None, Some(action)) => Ask::CancelAll(action),
                _ => return Err(LanguageError::Form("a cancel of a goal or of an action")),
            },
            _ => return Err(FORM),
        };
        Ok((json.agent, ask))
    }

    fn write_answer(
        &self,
        _robot: &AgentId,
        _to: &Ask,
        answer: &ActionAnswer,
    ) -> Result<Vec<u8>, LanguageError> {
        let json = match answer.clone() {
            ActionAnswer::Agreed { queued } => {
                JsonAnswer::Agreed(if queued { "queued" } else { "executing" }.to_owned())
            }
            ActionAnswer::Done(None) => JsonAnswer::Done,
            ActionAnswer::Done(Some(value)) => JsonAnswer::Result(term_to_json(&value)?),
            ActionAnswer::Refused(reason) => JsonAnswer::Refused(reason),
            ActionAnswer::Failed(reason) => JsonAnswer::Failed(reason),
            ActionAnswer::Actions(all) => JsonAnswer::Actions(all),
            ActionAnswer::Status(all) => {
                JsonAnswer::Status(all.iter().map(write_status).collect::<Result<_, _>>()?)
            }
        };
        Ok(serde_json::to_vec(&json)?)
    }

    fn read_answer(&self, to: &Ask, bytes: &[u8]) -> Result<ActionAnswer, LanguageError> {
        match (serde_json::from_slice(bytes)?, to) {
            (JsonAnswer::Agreed(state), Ask::Goal(_)) => {
                let queued = state == "queued";
                Ok(ActionAnswer::Agreed { queued })
            }
            (JsonAnswer::Done, Ask::Goal(_)) => Ok(ActionAnswer::Done(None)),
            (JsonAnswer::Result(value), Ask::Goal(_)) => {
                Ok(ActionAnswer::Done(Some(term_from_json(value)?)))
            }
            (JsonAnswer::Actions(all), Ask::Actions) => Ok(ActionAnswer::Actions(all)),
            (
                JsonAnswer::Status(all),
                Ask::Status | Ask::StatusOf(_) | Ask::Cancel(_) | Ask::CancelAll(_),
            ) => {
                let all = all.into_iter().map(read_status);
                all.collect::<Result<_, _>>().map(ActionAnswer::Status)
            }
            _ => Err(LanguageError::Form("an answer to this message")),
        }
    }

    fn read_rejection(
        &self,
        is_refusal: bool,
        bytes: &[u8],
    ) -> Result<ActionAnswer, LanguageError> {
        match (serde_json::from_slice(bytes)?, is_refusal) {
            (JsonAnswer::Refused(reason), true) => Ok(ActionAnswer::Refused(reason)),
            (JsonAnswer::Failed(reason), false) => Ok(ActionAnswer::Failed(reason)),
            _ => Err(LanguageError::Form("a refusal or a failure")),
        }
    }
}

/// Writes a status. Its values are JSON as the result of a goal, not texts in SL.
fn write_status(status: &GoalStatus) -> Result<Value, LanguageError> {
    let mut written = serde_json::to_value(status)?;
    let progress = status.progress.as_ref();
    if let Some(value) = progress.and_then(|progress| progress.value.as_ref()) {
        written["progress"]["value"] = term_to_json(value)?;
    }
    if let Some(result) = &status.result {
        written["result"] = term_to_json(result)?;
    }
    Ok(written)
}

/// Reads a status.
fn read_status(mut written: Value) -> Result<GoalStatus, LanguageError> {
    let mut take = |pointer| {
        let value = written.pointer_mut(pointer).map(Value::take);
        let value = value.filter(|value| !value.is_null());
        value.map(term_from_json).transpose()
    };
    let (value, result) = (take("/progress/value")?, take("/result")?);
    let mut status: GoalStatus = serde_json::from_value(written)?;
    if let Some(progress) = &mut status.progress {
        progress.value = value;
    }
    status.result = result;
    Ok(status)
}

fn object(parameters: &[Parameter<'_>]) -> Result<Map<String, Value>, LanguageError> {
    let parameters = parameters.iter();
    let pairs = parameters.map(|it| match &*it.name {
        SYMBOL | ARGUMENTS => Err(LanguageError::NoNotation("a parameter of this name")),
        name => Ok((name.to_owned(), term_to_json(&it.value)?)),
    });
    pairs.collect()
}

/// Writes a term as JSON: a functional term as an object, with its symbol under `@` unless that is `object`, and
/// positional arguments under `@arguments`.
///
/// # Errors
/// If JSON has no notation for a part of the term, such as a byte string.
pub fn term_to_json(term: &Term<'_>) -> Result<Value, LanguageError> {
    Ok(match term {
        Term::Boolean(truth) => Value::Bool(*truth),
        Term::String(text) => Value::String(text.to_string()),
        Term::DateTime(time) => Value::String(time.to_string()),
        Term::Number(number) => {
            let integer = number.is_integer();
            let integer = integer.then(|| {
                number
                    .as_i64()
                    .map(Value::from)
                    .or(number.as_u64().map(Value::from))
            });
            let value = integer
                .flatten()
                .or_else(|| number.as_f64().map(Value::from));
            value.ok_or(LanguageError::NoNotation("a number of this size"))?
        }
        Term::Sequence(elements) | Term::Set(elements) => Value::Array(
            elements
                .iter()
                .map(term_to_json)
                .collect::<Result<_, _>>()?,
        ),
        Term::Functional(functional) => {
            let mut object = match &functional.arguments {
                Arguments::Parameters(parameters) => object(parameters)?,
                Arguments::Terms(terms) if terms.is_empty() => Map::new(),
                Arguments::Terms(terms) => {
                    let terms = terms.iter().map(term_to_json).collect::<Result<_, _>>()?;
                    Map::from_iter([(ARGUMENTS.to_owned(), Value::Array(terms))])
                }
            };
            if functional.symbol != OBJECT {
                let symbol = Value::String(functional.symbol.to_string());
                object.insert(SYMBOL.to_owned(), symbol);
            }
            Value::Object(object)
        }
        _ => return Err(LanguageError::NoNotation("an expression of this kind")),
    })
}

/// Reads a term from JSON, in the form that [`term_to_json`] writes. Objects without a symbol get that of the described
/// type.
///
/// # Errors
/// If SL has no notation for a part of the value, such as `null`.
pub fn term_from_json(value: Value) -> Result<Term<'static>, LanguageError> {
    Ok(match value {
        Value::Bool(truth) => Term::Boolean(truth),
        Value::String(text) => Term::String(Cow::Owned(text)),
        Value::Number(number) => {
            let number = Number::new(number.to_string());
            Term::Number(number.ok_or(LanguageError::Form("a number"))?)
        }
        Value::Array(elements) => Term::Sequence(
            elements
                .into_iter()
                .map(term_from_json)
                .collect::<Result<_, _>>()?,
        ),
        Value::Object(mut object) => {
            let symbol = match object.remove(SYMBOL) {
                Some(Value::String(symbol)) => Cow::Owned(symbol),
                Some(_) => return Err(LanguageError::Form("a symbol in \"@\"")),
                None => Cow::Borrowed(OBJECT),
            };
            let arguments = match object.remove(ARGUMENTS) {
                Some(Value::Array(terms)) if object.is_empty() => {
                    let terms = terms.into_iter().map(term_from_json);
                    Arguments::Terms(terms.collect::<Result<_, _>>()?)
                }
                Some(_) => return Err(LanguageError::Form("arguments in \"@arguments\"")),
                None => match arguments_from_json(object)? {
                    none if none.is_empty() => Arguments::Terms(Vec::new()),
                    parameters => Arguments::Parameters(parameters),
                },
            };
            Term::Functional(FunctionalTerm { symbol, arguments })
        }
        Value::Null => return Err(LanguageError::Form("a value in the place of null")),
    })
}

/// Reads the members of an object as named arguments. A member that is null is left out.
///
/// # Errors
/// As for [`term_from_json`].
pub fn arguments_from_json(
    object: Map<String, Value>,
) -> Result<Vec<Parameter<'static>>, LanguageError> {
    let members = object.into_iter().filter(|(_, value)| !value.is_null());
    let members = members.map(|(name, value)| {
        Ok(Parameter {
            name: Cow::Owned(name),
            value: term_from_json(value)?,
        })
    });
    members.collect()
}
