//! The JSON form of FIPA-SL. Every content has one, and the same content is read from it.

use std::fmt;

use fipa::Time;
use fipa_content::{
    ActionExpression, Arguments, Content, ContentExpression, FunctionalTerm, IdentifyingExpression,
    LogicalOperator, ModalOperator, Number, Parameter, Quantifier, ReferentialOperator, Term, Wff,
};
use serde::de::{self, Deserialize, Deserializer, MapAccess, SeqAccess, Visitor};
use serde::ser::{Serialize, SerializeMap, Serializer};

pub(super) const HELP: &str = "\
JSON: a list of expressions. A string, a number, true, false and a list (a sequence) are themselves.
  { \"set\": [term] }                                      { \"number\": digits JSON cannot express }
  { \"function\": symbol, \"slots\": { name: term } }        { \"time\": date-time }
  { \"function\": symbol, \"arguments\": [term] }            { \"bytes\": [number] }
  { \"action\": term, \"agent\": term }                      { \"variable\": name }
  { \"either\": [action, action] }                         { \"then\": [action, action] }
  { \"iota\" | \"any\" | \"all\": term, \"where\": formula }
Formulas: true, false, and
  { \"predicate\": symbol, \"arguments\": [term] }           { \"proposition\": symbol }
  { \"equal\": [term, term] }                              { \"result\": term, \"value\": term }
  { \"done\" | \"feasible\": action, \"formula\": formula }    { \"not\": formula }
  { \"and\" | \"or\" | \"implies\" | \"equiv\": [formula, formula] }
  { \"forall\" | \"exists\": variable, \"formula\": formula }
  { \"B\" | \"U\" | \"PG\" | \"I\": agent, \"formula\": formula }
{ \"meta\": name } is a meta-symbol of JADE. JSON is read up to a depth of 127.";

/// JSON whose objects keep the order of their members.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Json {
    Null,
    Truth(bool),
    Number(serde_json::Number),
    Text(String),
    List(Vec<Json>),
    Object(Vec<(String, Json)>),
}

/// Returns the JSON form.
pub(super) fn of_content(content: &Content<'_>) -> Json {
    Json::List(content.expressions.iter().map(of_expression).collect())
}

/// Reads the JSON form.
pub(super) fn to_content(bytes: &[u8]) -> Result<Content<'static>, String> {
    let json: Json = serde_json::from_slice(bytes).map_err(|error| error.to_string())?;
    let expressions = json.list("the content")?.into_iter().map(to_expression);
    let expressions: Vec<ContentExpression<'static>> = expressions.collect::<Result<_, _>>()?;
    Ok(Content::new(expressions))
}

fn object<const N: usize>(members: [(&str, Json); N]) -> Json {
    let members = members.into_iter();
    Json::Object(
        members
            .map(|(name, value)| (name.to_owned(), value))
            .collect(),
    )
}

fn text(text: &str) -> Json {
    Json::Text(text.to_owned())
}

fn of_expression(expression: &ContentExpression<'_>) -> Json {
    match expression {
        ContentExpression::Action(action) => of_action(action),
        ContentExpression::Identifying(expression) => of_identifying(expression),
        ContentExpression::Wff(wff) => of_wff(wff),
    }
}

fn of_action(action: &ActionExpression<'_>) -> Json {
    match action {
        ActionExpression::Action { agent, act } => {
            object([("action", of_term(act)), ("agent", of_term(agent))])
        }
        ActionExpression::Alternative(first, second) => object([(
            "either",
            Json::List(vec![of_action(first), of_action(second)]),
        )]),
        ActionExpression::Sequential(first, second) => object([(
            "then",
            Json::List(vec![of_action(first), of_action(second)]),
        )]),
        ActionExpression::Meta(name) => object([("meta", text(name))]),
    }
}

fn of_identifying(expression: &IdentifyingExpression<'_>) -> Json {
    object([
        (expression.operator.as_str(), of_term(&expression.term)),
        ("where", of_wff(&expression.wff)),
    ])
}

fn of_terms(terms: &[Term<'_>]) -> Json {
    Json::List(terms.iter().map(of_term).collect())
}

fn of_term(term: &Term<'_>) -> Json {
    match term {
        Term::Variable(name) => object([("variable", text(name))]),
        Term::Meta(name) => object([("meta", text(name))]),
        Term::Number(number) => {
            let json: Option<serde_json::Number> = serde_json::from_str(number.as_str()).ok();
            match json.filter(|json| json.to_string() == number.as_str()) {
                Some(json) => Json::Number(json),
                None => object([("number", text(number.as_str()))]),
            }
        }
        Term::String(string) => text(string),
        Term::Bytes(bytes) => {
            let bytes = bytes.iter().map(|&byte| Json::Number(byte.into()));
            object([("bytes", Json::List(bytes.collect()))])
        }
        Term::Boolean(truth) => Json::Truth(*truth),
        Term::DateTime(time) => object([("time", text(&time.to_string()))]),
        Term::Functional(FunctionalTerm { symbol, arguments }) => {
            let arguments = match arguments {
                Arguments::Terms(terms) => ("arguments", of_terms(terms)),
                Arguments::Parameters(parameters) => {
                    let slots = parameters.iter();
                    let slots = slots.map(|it| (it.name.to_string(), of_term(&it.value)));
                    ("slots", Json::Object(slots.collect()))
                }
            };
            object([("function", text(symbol)), arguments])
        }
        Term::Sequence(terms) => of_terms(terms),
        Term::Set(terms) => object([("set", of_terms(terms))]),
        Term::Action(action) => of_action(action),
        Term::Identifying(expression) => of_identifying(expression),
        // Terms of later versions.
        _ => Json::Null,
    }
}

fn of_wff(wff: &Wff<'_>) -> Json {
    let with = |key: &str, value: Json, wff: Option<&Wff<'_>>| match wff {
        Some(wff) => object([(key, value), ("formula", of_wff(wff))]),
        None => object([(key, value)]),
    };
    match wff {
        Wff::Truth(truth) => Json::Truth(*truth),
        Wff::Proposition(symbol) => object([("proposition", text(symbol))]),
        Wff::Equal(left, right) => {
            object([("equal", Json::List(vec![of_term(left), of_term(right)]))])
        }
        Wff::Result(action, value) => {
            object([("result", of_term(action)), ("value", of_term(value))])
        }
        Wff::Predicate { symbol, arguments } => object([
            ("predicate", text(symbol)),
            ("arguments", of_terms(arguments)),
        ]),
        Wff::Not(wff) => object([("not", of_wff(wff))]),
        Wff::Binary {
            operator,
            left,
            right,
        } => object([(
            operator.as_str(),
            Json::List(vec![of_wff(left), of_wff(right)]),
        )]),
        Wff::Quantified {
            quantifier,
            variable,
            wff,
        } => with(quantifier.as_str(), text(variable), Some(wff)),
        Wff::Modal {
            operator,
            agent,
            wff,
        } => with(operator.as_str(), of_term(agent), Some(wff)),
        Wff::Feasible(action, wff) => with("feasible", of_action(action), wff.as_deref()),
        Wff::Done(action, wff) => with("done", of_action(action), wff.as_deref()),
        Wff::Meta(name) => object([("meta", text(name))]),
        // Formulas of later versions.
        _ => Json::Null,
    }
}

impl Json {
    fn list(self, what: &str) -> Result<Vec<Self>, String> {
        match self {
            Self::List(list) => Ok(list),
            _ => Err(format!("{what} is not a list")),
        }
    }

    fn two(self, what: &str) -> Result<[Self; 2], String> {
        let list = self.list(what)?;
        list.try_into()
            .map_err(|_| format!("{what} does not have two elements"))
    }

    fn string(self, what: &str) -> Result<String, String> {
        match self {
            Self::Text(text) => Ok(text),
            _ => Err(format!("{what} is not a string")),
        }
    }
}

/// The members of an object. Its first member says what it is; each member is taken once.
struct Members {
    kind: String,
    value: Json,
    others: Vec<(String, Json)>,
}

impl Members {
    fn of(json: Json, what: &str) -> Result<Self, String> {
        let Json::Object(mut members) = json else {
            return Err(format!("{what} is not an object"));
        };
        if members.is_empty() {
            return Err(format!("{what} has no members"));
        }
        let (kind, value) = members.remove(0);
        Ok(Self {
            kind,
            value,
            others: members,
        })
    }

    fn optional(&mut self, name: &str) -> Option<Json> {
        let place = self.others.iter().position(|(other, _)| other == name)?;
        Some(self.others.remove(place).1)
    }

    fn member(&mut self, name: &str) -> Result<Json, String> {
        let kind = &self.kind;
        let missing = format!("the member {name:?} is missing beside {kind:?}");
        self.optional(name).ok_or(missing)
    }

    /// Returns the result, if no member is left over.
    fn only<T>(self, value: T) -> Result<T, String> {
        match self.others.first() {
            None => Ok(value),
            Some((name, _)) => Err(format!(
                "the member {name:?} does not belong beside {:?}",
                self.kind
            )),
        }
    }
}

fn to_expression(json: Json) -> Result<ContentExpression<'static>, String> {
    let kind = match &json {
        Json::Object(members) => members.first().map_or("", |(kind, _)| kind.as_str()),
        _ => "",
    };
    Ok(match kind {
        "action" | "either" | "then" => to_action(json)?.into(),
        "iota" | "any" | "all" => to_identifying(json)?.into(),
        _ => to_wff(json)?.into(),
    })
}

fn to_action(json: Json) -> Result<ActionExpression<'static>, String> {
    let mut members = Members::of(json, "an action")?;
    let value = std::mem::replace(&mut members.value, Json::Null);
    let pair = |value: Json, what: &str| -> Result<_, String> {
        let [first, second] = value.two(what)?;
        Ok((Box::new(to_action(first)?), Box::new(to_action(second)?)))
    };
    let action = match members.kind.as_str() {
        "action" => ActionExpression::Action {
            act: to_term(value)?,
            agent: to_term(members.member("agent")?)?,
        },
        "either" => {
            let (first, second) = pair(value, "either")?;
            ActionExpression::Alternative(first, second)
        }
        "then" => {
            let (first, second) = pair(value, "then")?;
            ActionExpression::Sequential(first, second)
        }
        "meta" => ActionExpression::Meta(value.string("meta")?.into()),
        other => return Err(format!("{other:?} is not an action")),
    };
    members.only(action)
}

fn to_identifying(json: Json) -> Result<IdentifyingExpression<'static>, String> {
    let mut members = Members::of(json, "a reference")?;
    let value = std::mem::replace(&mut members.value, Json::Null);
    let operator = match members.kind.as_str() {
        "iota" => ReferentialOperator::Iota,
        "any" => ReferentialOperator::Any,
        "all" => ReferentialOperator::All,
        other => return Err(format!("{other:?} is not a reference")),
    };
    let expression = IdentifyingExpression {
        operator,
        term: to_term(value)?,
        wff: to_wff(members.member("where")?)?,
    };
    members.only(expression)
}

fn to_terms(json: Json, what: &str) -> Result<Vec<Term<'static>>, String> {
    json.list(what)?.into_iter().map(to_term).collect()
}

fn number(text: String) -> Result<Term<'static>, String> {
    let malformed = format!("{text:?} is not a number");
    Number::new(text).map(Term::Number).ok_or(malformed)
}

fn to_term(json: Json) -> Result<Term<'static>, String> {
    let kind = match &json {
        Json::Null => return Err("null is not a term".to_owned()),
        Json::Truth(truth) => return Ok(Term::Boolean(*truth)),
        Json::Number(json) => return number(json.to_string()),
        Json::Text(text) => return Ok(Term::from(text.clone())),
        Json::List(_) => return to_terms(json, "a sequence").map(Term::Sequence),
        Json::Object(members) => members.first().map_or("", |(kind, _)| kind.as_str()),
    };
    match kind {
        "action" | "either" | "then" => return to_action(json).map(Term::from),
        "iota" | "any" | "all" => return to_identifying(json).map(Term::from),
        _ => {}
    }
    let mut members = Members::of(json, "a term")?;
    let value = std::mem::replace(&mut members.value, Json::Null);
    let term = match members.kind.as_str() {
        "variable" => Term::Variable(value.string("variable")?.into()),
        "meta" => Term::Meta(value.string("meta")?.into()),
        "number" => number(value.string("number")?)?,
        "time" => {
            let time = value.string("time")?.parse::<Time>();
            Term::DateTime(time.map_err(|error| error.to_string())?)
        }
        "bytes" => {
            let bytes = value.list("bytes")?.into_iter().map(|byte| match byte {
                Json::Number(byte) => byte.as_u64().and_then(|byte| u8::try_from(byte).ok()),
                _ => None,
            });
            let bytes = bytes.collect::<Option<Vec<u8>>>();
            Term::Bytes(bytes.ok_or("bytes are numbers from 0 to 255")?.into())
        }
        "set" => Term::Set(to_terms(value, "set")?),
        "function" => {
            let symbol = value.string("function")?.into();
            let arguments = match members.optional("slots") {
                Some(Json::Object(slots)) if !slots.is_empty() => {
                    let slots = slots.into_iter().map(|(name, value)| {
                        let name = name.into();
                        to_term(value).map(|value| Parameter { name, value })
                    });
                    Arguments::Parameters(slots.collect::<Result<_, _>>()?)
                }
                Some(_) => return Err("slots is not an object with members".to_owned()),
                None => Arguments::Terms(to_terms(members.member("arguments")?, "arguments")?),
            };
            FunctionalTerm { symbol, arguments }.into()
        }
        other => return Err(format!("{other:?} is not a term")),
    };
    members.only(term)
}

fn to_wff(json: Json) -> Result<Wff<'static>, String> {
    if let Json::Truth(truth) = json {
        return Ok(Wff::Truth(truth));
    }
    let mut members = Members::of(json, "a formula")?;
    let value = std::mem::replace(&mut members.value, Json::Null);
    let binary = |operator, value: Json| -> Result<_, String> {
        let [left, right] = value.two("an operator")?;
        Ok(Wff::Binary {
            operator,
            left: Box::new(to_wff(left)?),
            right: Box::new(to_wff(right)?),
        })
    };
    let formula = |members: &mut Members| -> Result<_, String> {
        Ok(Box::new(to_wff(members.member("formula")?)?))
    };
    let optional = |members: &mut Members| -> Result<Option<_>, String> {
        let formula = members.optional("formula").map(to_wff).transpose()?;
        Ok(formula.map(Box::new))
    };
    let quantified = |quantifier, value: Json, members: &mut Members| -> Result<_, String> {
        Ok(Wff::Quantified {
            quantifier,
            variable: value.string("the variable")?.into(),
            wff: formula(members)?,
        })
    };
    let modal = |operator, value: Json, members: &mut Members| -> Result<_, String> {
        Ok(Wff::Modal {
            operator,
            agent: Box::new(to_term(value)?),
            wff: formula(members)?,
        })
    };
    let kind = members.kind.clone();
    let wff = match kind.as_str() {
        "proposition" => Wff::Proposition(value.string("proposition")?.into()),
        "predicate" => Wff::Predicate {
            symbol: value.string("predicate")?.into(),
            arguments: to_terms(members.member("arguments")?, "arguments")?,
        },
        "equal" => {
            let [left, right] = value.two("equal")?;
            Wff::Equal(Box::new(to_term(left)?), Box::new(to_term(right)?))
        }
        "result" => {
            let result = to_term(members.member("value")?)?;
            Wff::Result(Box::new(to_term(value)?), Box::new(result))
        }
        "not" => Wff::Not(Box::new(to_wff(value)?)),
        "and" => binary(LogicalOperator::And, value)?,
        "or" => binary(LogicalOperator::Or, value)?,
        "implies" => binary(LogicalOperator::Implies, value)?,
        "equiv" => binary(LogicalOperator::Equiv, value)?,
        "forall" => quantified(Quantifier::Forall, value, &mut members)?,
        "exists" => quantified(Quantifier::Exists, value, &mut members)?,
        "B" => modal(ModalOperator::Belief, value, &mut members)?,
        "U" => modal(ModalOperator::Uncertainty, value, &mut members)?,
        "PG" => modal(ModalOperator::PersistentGoal, value, &mut members)?,
        "I" => modal(ModalOperator::Intention, value, &mut members)?,
        "feasible" => Wff::Feasible(Box::new(to_action(value)?), optional(&mut members)?),
        "done" => Wff::Done(Box::new(to_action(value)?), optional(&mut members)?),
        "meta" => Wff::Meta(value.string("meta")?.into()),
        other => return Err(format!("{other:?} is not a formula")),
    };
    members.only(wff)
}

impl Serialize for Json {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Null => serializer.serialize_unit(),
            Self::Truth(truth) => serializer.serialize_bool(*truth),
            Self::Number(number) => number.serialize(serializer),
            Self::Text(text) => serializer.serialize_str(text),
            Self::List(list) => list.serialize(serializer),
            Self::Object(members) => {
                let mut map = serializer.serialize_map(Some(members.len()))?;
                for (name, value) in members {
                    map.serialize_entry(name, value)?;
                }
                map.end()
            }
        }
    }
}

impl<'de> Deserialize<'de> for Json {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(JsonVisitor)
    }
}

struct JsonVisitor;

impl<'de> Visitor<'de> for JsonVisitor {
    type Value = Json;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("JSON")
    }

    fn visit_unit<E: de::Error>(self) -> Result<Json, E> {
        Ok(Json::Null)
    }

    fn visit_bool<E: de::Error>(self, truth: bool) -> Result<Json, E> {
        Ok(Json::Truth(truth))
    }

    fn visit_i64<E: de::Error>(self, number: i64) -> Result<Json, E> {
        Ok(Json::Number(number.into()))
    }

    fn visit_u64<E: de::Error>(self, number: u64) -> Result<Json, E> {
        Ok(Json::Number(number.into()))
    }

    fn visit_f64<E: de::Error>(self, number: f64) -> Result<Json, E> {
        let number = serde_json::Number::from_f64(number);
        number
            .map(Json::Number)
            .ok_or_else(|| E::custom("a number that is not finite"))
    }

    fn visit_str<E: de::Error>(self, text: &str) -> Result<Json, E> {
        Ok(Json::Text(text.to_owned()))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut elements: A) -> Result<Json, A::Error> {
        let mut list = Vec::new();
        while let Some(element) = elements.next_element()? {
            list.push(element);
        }
        Ok(Json::List(list))
    }

    fn visit_map<A: MapAccess<'de>>(self, mut members: A) -> Result<Json, A::Error> {
        let mut object = Vec::new();
        while let Some(member) = members.next_entry()? {
            object.push(member);
        }
        Ok(Json::Object(object))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_expression_survives_json() {
        for text in [
            "((action crex (dock :speed 0.5 :target (pose 1 -2 0x1f 1e-3 +4 18446744073709551616))))",
            "((| (action a b) (; (action a c) (action a d))))",
            "((iota ?x (p ?x)) (any (sequence ?x ?y) (q ?x (set a b))) (all ?x true))",
            "((done (action a (f))) (done (action a (f)) (not p)) (feasible (action a b)))",
            "((and p (or q (implies r (equiv s false)))))",
            "((forall ?x (exists ?y (= ?x ?y))))",
            "((B a (U b (PG c (I d (p \"two words\"))))))",
            "((result (action a (f)) (sequence 20261122T120000000Z true \"true\" \"5\")))",
            "((p (f :a 1 :a 2) #2\"\u{80}))",
        ] {
            let content = Content::parse(text).unwrap_or_else(|error| panic!("{text}: {error}"));
            let json = serde_json::to_vec(&of_content(&content)).unwrap();
            let again = to_content(&json).unwrap_or_else(|error| panic!("{text}: {error}"));
            assert_eq!(again, content, "{}", String::from_utf8_lossy(&json));
        }
    }

    #[test]
    fn other_json_is_refused_with_the_reason() {
        for (json, reason) in [
            ("{}", "the content is not a list"),
            ("[[]]", "a formula is not an object"),
            ("[{}]", "a formula has no members"),
            (r#"[{"p":1}]"#, r#""p" is not a formula"#),
            (
                r#"[{"action":"a"}]"#,
                r#"the member "agent" is missing beside "action""#,
            ),
            (
                r#"[{"meta":"a","b":1}]"#,
                r#"the member "b" does not belong beside "meta""#,
            ),
            (
                r#"[{"predicate":"p","arguments":[null]}]"#,
                "null is not a term",
            ),
            (r#"[{"equal":[1]}]"#, "equal does not have two elements"),
            (
                r#"[{"predicate":"p","arguments":[{"number":"x"}]}]"#,
                r#""x" is not a number"#,
            ),
        ] {
            assert_eq!(to_content(json.as_bytes()), Err(reason.to_owned()));
        }
        let deep = "[".repeat(200);
        assert!(
            to_content(deep.as_bytes())
                .unwrap_err()
                .contains("recursion")
        );
    }
}
