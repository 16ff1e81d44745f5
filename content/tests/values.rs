//! Rust values as terms: each line of the mapping in the crate documentation, and the errors.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::fmt::Debug;

use fipa_acl::{AgentId, Time};
use fipa_content::{
    Agent, DateTime, DeserializeError, DeserializeErrorKind, ParseError, PrintError, Problem,
    SerializeError, Set, SlDialect, Term, from_slice, from_slice_in, to_vec, to_vec_in,
};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

fn text(value: &(impl Serialize + ?Sized)) -> String {
    String::from_utf8(to_vec(value).unwrap()).unwrap()
}

/// Writes the value, compares the text, and reads it again.
fn same<T: Serialize + DeserializeOwned + PartialEq + Debug>(value: T, expected: &str) {
    assert_eq!(text(&value), expected);
    assert_eq!(from_slice::<T>(expected).unwrap(), value, "{expected}");
}

fn refused<T: DeserializeOwned + Debug>(text: &str) -> DeserializeError {
    from_slice::<T>(text).unwrap_err()
}

#[derive(Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename = "pose")]
struct Pose {
    x: f64,
    y: f64,
    frame: Option<String>,
}

#[derive(Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename = "goal", deny_unknown_fields)]
struct Goal {
    target: Pose,
    waypoints: Option<Vec<Pose>>,
}

#[derive(Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Act {
    Brake,
    Lift(u8),
    LiftMaybe(Option<u8>),
    Plus(i32, i32),
    Dock {
        speed: Option<f64>,
    },
    #[serde(rename = "set")]
    Keyword(u8),
}

#[derive(Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename = "brake")]
struct Unit;

#[derive(Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename = "plus")]
struct Tuple(i32, i32);

#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Newtype(f64);

const POSE: &str = "(pose :x 1.5 :y 0.2)";

fn pose() -> Pose {
    let frame = None;
    Pose {
        x: 1.5,
        y: 0.2,
        frame,
    }
}

#[test]
fn structs_are_functional_terms() {
    same(pose(), POSE);
    let frame = Some("sherpa/emi 2".to_owned());
    same(
        Pose { frame, ..pose() },
        r#"(pose :x 1.5 :y 0.2 :frame "sherpa/emi 2")"#,
    );
    same(Unit, "(brake)");
    same(Tuple(1, -2), "(plus 1 -2)");
    same(Newtype(2.0), "2.0");
    // By position, in any order by name, and with any blanks.
    for text in [
        "(pose 1.5 0.2 here)",
        "( \"pose\"\n:y .2 :frame here\t:x 15e-1 )",
    ] {
        let read: Pose = from_slice(text).unwrap();
        let frame = Some("here".to_owned());
        assert_eq!(read, Pose { frame, ..pose() });
    }
}

#[test]
fn enums_are_function_symbols() {
    same(Act::Brake, "brake");
    same(Act::Lift(3), "(lift 3)");
    same(Act::LiftMaybe(Some(3)), "(lift-maybe 3)");
    same(Act::LiftMaybe(None), "(lift-maybe)");
    same(Act::Plus(1, 2), "(plus 1 2)");
    same(Act::Dock { speed: Some(0.5) }, "(dock :speed 0.5)");
    same(Act::Dock { speed: None }, "(dock)");
    // Quotation marks distinguish strings from reserved words.
    same(Act::Keyword(1), "(\"set\" 1)");
    assert_eq!(from_slice::<Act>("(brake)").unwrap(), Act::Brake);
    assert_eq!(
        from_slice::<Act>("(dock 0.5)").unwrap(),
        Act::Dock { speed: Some(0.5) }
    );

    // An operator of SL is not a function symbol.
    assert!(matches!(
        refused::<Act>("(action a b)").kind(),
        DeserializeErrorKind::Type { .. }
    ));
    assert!(matches!(
        refused::<Pose>("(set 1)").kind(),
        DeserializeErrorKind::Symbol { .. }
    ));

    let error = refused::<Act>("(fly 3)");
    let found = "fly".to_owned();
    assert!(matches!(
        error.kind(),
        DeserializeErrorKind::Variant { found: it, expected } if *it == found && expected.len() == 6
    ));
    assert!(matches!(
        refused::<Act>("(lift)").kind(),
        DeserializeErrorKind::Length { .. }
    ));
    assert!(matches!(
        refused::<Act>("(lift 1 2)").kind(),
        DeserializeErrorKind::Length { .. }
    ));
    assert!(matches!(
        refused::<Act>("(brake 1)").kind(),
        DeserializeErrorKind::Length { .. }
    ));
    assert!(matches!(
        refused::<Act>("lift").kind(),
        DeserializeErrorKind::Type { .. }
    ));
    assert!(matches!(
        refused::<Act>("(set 1)").kind(),
        DeserializeErrorKind::Type { .. }
    ));
}

#[test]
fn collections_are_sequences_sets_and_properties() {
    same(vec![1, 2], "(sequence 1 2)");
    same(
        (1, "a".to_owned(), [true]),
        "(sequence 1 a (sequence true))",
    );
    same((), "(sequence)");
    same(Set(BTreeSet::from([1, 2])), "(set 1 2)");
    same(Some(Set(vec![vec![1]])), "(set (sequence 1))");
    // Only the outer collection is a set.
    assert_eq!(
        text(&Set(Lists { list: vec![1] })),
        "(Lists :list (sequence 1))"
    );
    assert_eq!(text(&Set(vec![vec![1]])), "(set (sequence 1))");
    assert_eq!(from_slice::<Vec<u8>>("(set 1 2)").unwrap(), [1, 2]);
    assert_eq!(from_slice::<Set<Vec<u8>>>("(sequence 1)").unwrap().0, [1]);
    let map = BTreeMap::from([("a".to_owned(), Some(1)), ("b".to_owned(), None)]);
    same(map, "(set (property :name a :value 1) (property :name b))");
    same(
        HashMap::from([(7, pose())]),
        &format!("(set (property :name 7 :value {POSE}))"),
    );
    let slots: BTreeMap<String, f64> = from_slice(POSE).unwrap();
    assert_eq!(slots["x"], 1.5);
    let error = refused::<BTreeMap<String, i32>>("(set (property :value 1 :name a))");
    assert_eq!(error.kind(), &DeserializeErrorKind::MissingSlot("name"));
}

#[derive(Serialize)]
struct Lists {
    list: Vec<u8>,
}

#[test]
fn an_absent_value_is_written_in_slots_only() {
    for refused in [
        to_vec(&None::<u8>),
        to_vec(&vec![None, Some(1)]),
        to_vec(&(1, None::<u8>)),
        to_vec(&HashMap::from([(None::<u8>, 1)])),
    ] {
        assert_eq!(refused, Err(SerializeError::Absent));
    }
}

#[test]
fn strings_that_look_like_something_else_are_quoted() {
    same("dock".to_owned(), "dock");
    same("df@crex".to_owned(), "df@crex");
    same(String::new(), r#""""#);
    same("true".to_owned(), r#""true""#);
    same("True".to_owned(), r#""True""#);
    same("42".to_owned(), r#""42""#);
    same("a \"b\"".to_owned(), r#""a \"b\"""#);
    same(r"C:\".to_owned(), r#"#3"C:\"#);
    same('é', "é");
    assert_eq!(to_vec_in(SlDialect::Jade, "é").unwrap(), "\"é\"".as_bytes());
    same(true, "true");
    assert!(from_slice::<bool>("TRUE").unwrap());
    assert!(from_slice::<bool>("\"true\"").is_err());
    // In the standard dialect, the unquoted words are also strings.
    assert_eq!(from_slice::<String>("true").unwrap(), "true");
    let borrowed: &str = from_slice("\"a b\"").unwrap();
    assert_eq!(borrowed, "a b");
    assert!(matches!(
        refused::<String>("42").kind(),
        DeserializeErrorKind::Type { .. }
    ));
}

#[test]
fn integers_of_every_size() {
    same(u64::MAX, "18446744073709551615");
    same(i64::MIN, "-9223372036854775808");
    same(u128::MAX, "340282366920938463463374607431768211455");
    same(i128::MIN, "-170141183460469231731687303715884105728");
    same(i8::MIN, "-128");
    assert_eq!(from_slice::<i16>("-0x10").unwrap(), -16);
    assert_eq!(from_slice::<u8>("+7").unwrap(), 7);
    assert!(matches!(
        refused::<u8>("256").kind(),
        DeserializeErrorKind::Value { .. }
    ));
    assert!(matches!(
        refused::<u8>("-1").kind(),
        DeserializeErrorKind::Value { .. }
    ));
    assert!(matches!(
        refused::<u8>("1.0").kind(),
        DeserializeErrorKind::Type { .. }
    ));
    let error = refused::<u128>("340282366920938463463374607431768211456");
    let DeserializeErrorKind::Syntax(error) = error.kind() else {
        panic!("{error}");
    };
    assert_eq!(error.problem(), &Problem::NumberRange);
    // JADE has 64 bits with a sign.
    assert_eq!(
        to_vec_in(SlDialect::Jade, &i64::MAX).unwrap(),
        b"9223372036854775807"
    );
    for refused in [
        to_vec_in(SlDialect::Jade, &(1_u64 << 63)),
        to_vec_in(SlDialect::Jade, &i128::MIN),
    ] {
        assert!(matches!(
            refused,
            Err(SerializeError::Print(PrintError::Unrepresentable {
                what: "integer",
                ..
            }))
        ));
    }
}

#[test]
fn floats_are_finite() {
    same(0.1_f32, "0.1");
    same(-0.0, "-0.0");
    same(f64::MAX, "1.7976931348623157e+308");
    same(f64::MIN_POSITIVE, "2.2250738585072014e-308");
    assert_eq!(from_slice::<f64>("3").unwrap(), 3.0);
    assert_eq!(from_slice::<f64>("0x10").unwrap(), 16.0);
    for value in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        assert_eq!(to_vec(&value), Err(SerializeError::NotFinite));
        assert_eq!(
            to_vec(&vec![Pose { x: value, ..pose() }]),
            Err(SerializeError::NotFinite)
        );
    }
    for text in ["1e999", "-1e999"] {
        let error = refused::<f64>(text);
        assert!(
            matches!(error.kind(), DeserializeErrorKind::Syntax(_)),
            "{error}"
        );
    }
    assert!(from_slice::<f32>("1e39").is_err());
    assert!(matches!(
        refused::<f64>("NaN").kind(),
        DeserializeErrorKind::Type { .. }
    ));
}

/// A value of bytes, as in `serde_bytes`.
#[derive(Debug, PartialEq)]
struct Bytes(Vec<u8>);

impl Serialize for Bytes {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_bytes(&self.0)
    }
}

impl<'de> Deserialize<'de> for Bytes {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Visitor;
        impl serde::de::Visitor<'_> for Visitor {
            type Value = Bytes;

            fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str("bytes")
            }

            fn visit_bytes<E>(self, bytes: &[u8]) -> Result<Bytes, E> {
                Ok(Bytes(bytes.to_vec()))
            }
        }
        deserializer.deserialize_bytes(Visitor)
    }
}

#[test]
fn bytes_are_counted_and_base64_for_jade() {
    for bytes in [&b""[..], b"abc", b"\xff\x00)\"", "é".as_bytes()] {
        let value = Bytes(bytes.to_vec());
        let written = to_vec(&value).unwrap();
        assert_eq!(
            written,
            [format!("#{}\"", bytes.len()).as_bytes(), bytes].concat()
        );
        assert_eq!(from_slice::<Bytes>(&written).unwrap(), value);
        let written = to_vec_in(SlDialect::Jade, &value).unwrap();
        assert!(written.is_ascii());
        assert_eq!(
            from_slice_in::<Bytes>(SlDialect::Jade, &written).unwrap(),
            value
        );
    }
    assert_eq!(from_slice::<Bytes>("word").unwrap().0, b"word");
}

#[test]
fn times_agents_and_terms_are_parts_of_values() {
    let time: Time = "20000508T042651481Z".parse().unwrap();
    same(DateTime(time), "20000508T042651481Z");
    assert!(matches!(
        refused::<DateTime>("soon").kind(),
        DeserializeErrorKind::Type { .. }
    ));
    let relative: Time = "+00000000T000030000".parse().unwrap();
    same(Some(DateTime(relative)), "+00000000T000030000");
    assert!(to_vec_in(SlDialect::Jade, &DateTime(relative)).is_err());

    let agent = AgentId::new("crex")
        .unwrap()
        .with_address("tcp://h:1")
        .unwrap();
    let agent = agent.with_resolver(AgentId::new("df").unwrap()).unwrap();
    let agent = agent.with_user_defined("prio", "high up").unwrap();
    same(
        vec![Agent(agent)],
        "(sequence (agent-identifier :name crex :addresses (sequence tcp://h:1) :resolvers \
         (sequence (agent-identifier :name df)) :X-prio \"high up\"))",
    );
    let error = refused::<Agent>("(agent-identifier :addresses (sequence a))");
    assert!(error.to_string().contains(":name"), "{error}");

    same(Term::parse("(all ?x (p ?x))").unwrap(), "(all ?x (p ?x))");
    // Other formats use the text.
    let json = serde_json::to_string(&(DateTime(time), Set([1]), Term::from("a b"))).unwrap();
    assert_eq!(json, r#"["20000508T042651481Z",[1],"\"a b\""]"#);
    let back: (DateTime, Set<[u8; 1]>, Term<'static>) = serde_json::from_str(&json).unwrap();
    assert_eq!(back, (DateTime(time), Set([1]), Term::from("a b")));
}

#[test]
fn slots_that_are_unknown_missing_or_there_twice() {
    let read: Pose = from_slice("(pose :x 1.5 :color (rgb 1 \"#\") :y 0.2 :color no)").unwrap();
    assert_eq!(read, pose());
    let goal = format!("(goal :target {POSE} :speed 1)");
    let error = refused::<Goal>(&goal);
    assert!(matches!(
        error.kind(),
        DeserializeErrorKind::UnknownSlot { found, expected: ["target", "waypoints"] }
            if found == "speed"
    ));
    assert_eq!(error.offset(), goal.find(":speed").unwrap());
    let error = refused::<Goal>("(goal)");
    assert_eq!(error.kind(), &DeserializeErrorKind::MissingSlot("target"));
    let error = refused::<Pose>("(pose :x 1 :x 2 :y 3)");
    assert_eq!(error.kind(), &DeserializeErrorKind::DuplicateSlot("x"));
    assert_eq!(error.offset(), 11);
}

#[derive(Serialize)]
struct Twice {
    #[serde(rename = "a")]
    one: u8,
    inner: Inner,
    #[serde(rename = "a")]
    other: u8,
}

#[derive(Serialize)]
struct Inner {
    a: u8,
}

#[test]
fn two_fields_with_one_slot_are_refused() {
    let inner = Inner { a: 2 };
    let value = Twice {
        one: 1,
        inner,
        other: 3,
    };
    assert_eq!(to_vec(&value), Err(SerializeError::DuplicateSlot("a")));
    assert_eq!(
        text(&vec![Inner { a: 1 }, Inner { a: 2 }]),
        "(sequence (Inner :a 1) (Inner :a 2))"
    );
}

#[test]
fn errors_name_the_slot_the_offset_and_the_type() {
    let text = "(goal :target (pose :x 1 :y 2) :waypoints (sequence (pose :x far :y 2)))";
    let error = refused::<Goal>(text);
    assert_eq!(error.slot(), "waypoints[0].x");
    assert_eq!(error.offset(), text.find("far").unwrap());
    assert_eq!(
        error.to_string(),
        "slot waypoints[0].x: at byte 61: found the string \"far\" where f64 should be"
    );
    let error = refused::<Goal>("(goal :target (point :x 1 :y 2))");
    let (found, expected) = ("point".to_owned(), "pose");
    assert_eq!(
        error.kind(),
        &DeserializeErrorKind::Symbol { found, expected }
    );
    assert_eq!((error.slot(), error.offset()), ("target".to_owned(), 14));
    let error = refused::<Goal>("(goal :target (pose :x 1 2))");
    let DeserializeErrorKind::Syntax(syntax) = error.kind() else {
        panic!("{error}");
    };
    assert_eq!(
        (syntax.offset(), syntax.clause()),
        (25, "FIPA00008 FunctionalTerm")
    );
    // Untrusted text is truncated and escaped.
    let error = refused::<u8>(&format!("\"\u{1b}{}\"", "x".repeat(1000)));
    let shown = error.to_string();
    assert!(shown.len() < 200 && !shown.contains('\u{1b}'), "{shown}");
}

#[test]
fn nothing_may_follow() {
    for (text, offset, left) in [("1 2", 2, 1), ("(sequence) )", 11, 1)] {
        let error = refused::<Term<'static>>(text);
        let DeserializeErrorKind::Syntax(error) = error.kind() else {
            panic!("{error}");
        };
        let (at, problem): (_, &Problem) = (ParseError::offset(error), error.problem());
        assert_eq!((at, problem), (offset, &Problem::Trailing(left)));
    }
    assert!(from_slice::<u8>("").is_err() && from_slice::<u8>("  ").is_err());
}
