//! The productions of FIPA00008, profiles, layouts, and the contents of conversations.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

use fipa_acl::AgentId;
use fipa_content::{
    ActionExpression, AgentTermError, Content, ContentExpression, PrintError, Printer, Problem,
    Profile, Query, ReadError, SerializeError, Term, Wff,
};
use serde::{Deserialize, Serialize};

/// Contents, each with the smallest profile that has it.
const CONTENTS: [(&str, Profile); 29] = [
    ("(p)", Profile::Sl0),
    ("(true false \"true\")", Profile::Sl0),
    ("((p a 1 -2.5 #2\"a\\))", Profile::Sl0),
    ("((p (f) (f a) (f :a 1 :b (set)) (sequence)))", Profile::Sl0),
    ("((= a b))", Profile::Sl0),
    ("((result (action a (f)) (sequence 1)))", Profile::Sl0),
    ("((done (action a f)))", Profile::Sl0),
    ("((action a (f)) (refused \"no way\"))", Profile::Sl0),
    (
        "((p 20000508T042651481Z +00000000T000030000))",
        Profile::Sl0,
    ),
    ("((p (action a (f))))", Profile::Sl0),
    ("((not p))", Profile::Sl1),
    ("((and p (or q (not r))))", Profile::Sl1),
    ("((implies p q))", Profile::Sl2),
    ("((equiv p (p a)))", Profile::Sl2),
    ("((p ?x))", Profile::Sl2),
    ("((p ?\"a b\"))", Profile::Sl2),
    ("((iota ?x (p ?x)))", Profile::Sl2),
    ("((any (sequence ?x ?y) (p ?x ?y)))", Profile::Sl2),
    ("((= (all ?x (p ?x)) (set 1 2)))", Profile::Sl2),
    ("((done (action a f) p))", Profile::Sl2),
    ("((feasible (action a f)))", Profile::Sl2),
    (
        "((feasible (; (action a f) (| (action a g) (action b h))) p))",
        Profile::Sl2,
    ),
    ("((B a (U a (PG a (I a p)))))", Profile::Sl2),
    (
        "((forall ?x (forall ?y (exists ?z (p ?x ?y ?z)))))",
        Profile::Sl2,
    ),
    ("((B a (forall ?x (p ?x))))", Profile::Sl2),
    ("((exists ?x (forall ?y (p ?x ?y))))", Profile::Sl),
    ("((not (exists ?x (p ?x))))", Profile::Sl),
    ("((and p (forall ?x (p ?x))))", Profile::Sl),
    ("((iota ?x (exists ?y (p ?x ?y))))", Profile::Sl),
];

#[test]
fn every_production_is_read_and_written() {
    for (text, profile) in CONTENTS {
        let content = Content::parse(text).unwrap_or_else(|error| panic!("{text}: {error}"));
        let written = Printer::new().print(&content).unwrap();
        assert_eq!(String::from_utf8(written).unwrap(), text);
        assert_eq!(content.to_string(), text);
        assert_eq!(Profile::of(&content), Some(profile), "{text}");
    }
}

#[test]
fn profiles_name_what_they_do_not_have() {
    let content = Content::parse("((not (p (f :a ?x))))").unwrap();
    let error = Profile::Sl0.check(&content).unwrap_err();
    assert_eq!(error.construct(), "logical operator 'not'");
    assert_eq!(
        error.to_string(),
        "fipa-sl0 has no logical operator 'not' (fipa-sl1 has)"
    );
    let error = Profile::Sl1.check(&content).unwrap_err();
    assert_eq!(
        (error.construct(), error.needs()),
        ("variable", Some(Profile::Sl2))
    );
    let meta = Content::parse("((p ??x))").unwrap();
    let error = Profile::Sl.check(&meta).unwrap_err();
    assert_eq!(error.to_string(), "fipa-sl has no meta-symbol");
    assert_eq!(Profile::of_language("FIPA-SL0"), Some(Profile::Sl0));
    assert_eq!(Profile::of_language("fipa-kif"), None);
}

#[test]
fn what_breaks_the_grammar_is_named_with_its_clause() {
    let unexpected = |found, expected| Problem::Unexpected { found, expected };
    for (text, offset, clause, problem) in [
        ("", 0, "Content", Problem::Truncated("Content")),
        ("()", 1, "ContentExpression", unexpected("')'", "formula")),
        ("(p", 2, "Content", Problem::Truncated("Content")),
        (
            "(1)",
            1,
            "ContentExpression",
            unexpected("number", "formula"),
        ),
        ("(p) q", 4, "Content", Problem::Trailing(1)),
        ("((p))", 3, "Term", unexpected("')'", "term")),
        (
            "((p :a 1))",
            4,
            "Term",
            unexpected("parameter name", "term"),
        ),
        (
            "((p (f a :b 1)))",
            9,
            "Term",
            unexpected("parameter name", "term"),
        ),
        (
            "((p (f :b 1 a)))",
            12,
            "FunctionalTerm",
            unexpected("word", "parameter name or ')'"),
        ),
        ("((p (f :b)))", 9, "Term", unexpected("')'", "term")),
        ("((p (1 2)))", 5, "Term", unexpected("number", "symbol")),
        ("((not p q))", 8, "Wff", unexpected("word", "')'")),
        (
            "((not (action a b)))",
            7,
            "Wff",
            unexpected("term", "formula"),
        ),
        (
            "((forall x p))",
            9,
            "Variable",
            unexpected("word", "variable"),
        ),
        (
            "((done p))",
            7,
            "ActionExpression",
            unexpected("word", "action expression"),
        ),
        (
            "((done (f a)))",
            8,
            "ActionExpression",
            unexpected("symbol", "'action', '|' or ';'"),
        ),
        ("((action a))", 10, "Term", unexpected("')'", "term")),
        ("((iota ?x))", 9, "Wff", unexpected("')'", "formula")),
        (
            "((iota ?x p q))",
            12,
            "IdentifyingExpression",
            unexpected("word", "')'"),
        ),
    ] {
        let error = Content::parse(text).unwrap_err();
        assert_eq!(
            (error.offset(), error.clause(), error.problem()),
            (offset, &*format!("FIPA00008 {clause}"), &problem),
            "{text}"
        );
    }
}

#[test]
fn keywords_count_only_where_they_stand_for_something() {
    // Keywords that are quoted or not right after a parenthesis are symbols.
    let text = "((\"not\" action) (p (not a) (B a b) (\"sequence\" 1) set))";
    let content = Content::parse(text).unwrap();
    assert_eq!(content.to_string(), text);
    assert!(matches!(
        &content.expressions[0],
        ContentExpression::Wff(Wff::Predicate { symbol, .. }) if symbol == "not"
    ));
    assert_eq!(
        Term::parse("(set 1)").unwrap(),
        Term::Set(vec![Term::parse("1").unwrap()])
    );
}

#[test]
fn long_lists_are_indented() {
    let text = "((action (agent-identifier :name crex) (dock :target (pose :x 1.5 :y 0.2 :yaw 3.1 \
                :frame \"sherpa/emi 2\") :speed 0.5)))";
    let content = Content::parse(text).unwrap();
    let indented = Printer::new().indented().print(&content).unwrap();
    assert_eq!(
        String::from_utf8(indented).unwrap(),
        "\
((action
    (agent-identifier :name crex)
    (dock
      :target (pose :x 1.5 :y 0.2 :yaw 3.1 :frame \"sherpa/emi 2\")
      :speed 0.5)))"
    );
    let short = Content::parse("((done (action a b)))").unwrap();
    let indented = Printer::new().indented().print(&short).unwrap();
    assert_eq!(indented, b"((done (action a b)))");
    let empty = Content {
        expressions: vec![],
    };
    assert_eq!(Printer::new().print(&empty), Err(PrintError::Empty));
    assert_eq!(
        empty.to_string(),
        "<a content has at least one content expression>"
    );
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Act {
    Dock { speed: f64 },
}

#[derive(Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Reason {
    Unauthorised,
    MissingParameter(String, String),
}

#[derive(Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Operator {
    Not(u8),
}

fn dock() -> (AgentId, Act) {
    (AgentId::new("crex").unwrap(), Act::Dock { speed: 0.5 })
}

const DOCK: &str = "(action (agent-identifier :name crex) (dock :speed 0.5))";

#[test]
fn an_action_is_requested_done_and_has_a_result() {
    let (agent, act) = dock();
    let action = ActionExpression::new(&agent, &act).unwrap();
    let request = Content::from(action.clone());
    assert_eq!(request.to_string(), format!("({DOCK})"));
    let read: (AgentId, Act) = request.action().unwrap().read().unwrap();
    assert_eq!(read, dock());

    let done = Content::from(Wff::done(action.clone()));
    assert_eq!(done.to_string(), format!("((done {DOCK}))"));
    assert_eq!(done.done().unwrap(), &action);
    let result = Content::from(Wff::result(action.clone(), &vec![1, 2]).unwrap());
    assert_eq!(
        result.to_string(),
        format!("((result {DOCK} (sequence 1 2)))")
    );
    assert_eq!(result.result::<Vec<u8>>().unwrap(), (&action, vec![1, 2]));
    assert!(matches!(result.result::<u8>(), Err(ReadError::Value(_))));
    for other in [&done, &result] {
        assert!(matches!(other.action(), Err(ReadError::Expression(_))));
    }
    assert!(matches!(result.done(), Err(ReadError::Expression(_))));
}

#[test]
fn an_action_is_refused_with_a_reason() {
    let (agent, act) = dock();
    let action = ActionExpression::new(&agent, &act).unwrap();
    for (reason, text) in [
        (Reason::Unauthorised, "unauthorised"),
        (
            Reason::MissingParameter("dock".into(), "target".into()),
            "(missing-parameter dock target)",
        ),
    ] {
        let refusal = Content::of_refusal(action.clone(), Wff::from_value(&reason).unwrap());
        assert_eq!(refusal.to_string(), format!("({DOCK} {text})"));
        let (refused, why) = refusal.refusal().unwrap();
        assert_eq!((refused, why.read::<Reason>().unwrap()), (&action, reason));
    }
    // A term with parameters by name is not a predicate.
    assert_eq!(Wff::from_value(&act), Err(SerializeError::Predicate));
    // A predicate symbol never reads as an operator.
    let not = Wff::from_value(&("not", 1)).unwrap_err();
    assert_eq!(not, SerializeError::Predicate);
    let not = Wff::from_value(&Operator::Not(1)).unwrap();
    assert_eq!(not.to_string(), "(\"not\" 1)");
    assert_eq!(not.read::<Operator>().unwrap(), Operator::Not(1));
    assert!(Wff::parse("(not p)").unwrap().read::<Operator>().is_err());
}

#[test]
fn queries_are_answered_by_position() {
    let wff = Wff::parse("(position ?x ?y)").unwrap();
    let query = Query::iota(["x", "y"], wff.clone());
    let text = "(iota (sequence ?x ?y) (position ?x ?y))";
    assert_eq!(query.content().to_string(), format!("({text})"));
    assert_eq!(Query::read(&query.content()).unwrap(), query);
    assert_eq!(query.variables().collect::<Vec<_>>(), ["x", "y"]);
    let answer = query.answer_one(&(1.5, 0.2)).unwrap();
    assert_eq!(
        answer.to_string(),
        format!("((= {text} (sequence 1.5 0.2)))")
    );
    assert_eq!(query.read_one::<(f64, f64)>(&answer).unwrap(), (1.5, 0.2));
    // Equality has no direction.
    let turned = format!("((= (sequence 1.5 0.2) {text}))");
    let turned = Content::parse(&turned).unwrap();
    assert_eq!(query.read_one::<(f64, f64)>(&turned).unwrap(), (1.5, 0.2));

    let all = Query::all(["x"], Wff::parse("(free ?x)").unwrap());
    let answer = all.answer_all(["arm", "leg"]).unwrap();
    assert_eq!(answer.to_string(), "((= (all ?x (free ?x)) (set arm leg)))");
    assert_eq!(all.read_all::<String>(&answer).unwrap(), ["arm", "leg"]);
    assert_eq!(
        query.read_one::<(f64, f64)>(&answer),
        Err(ReadError::OtherQuery)
    );
    let any = Query::any(["x"], wff);
    assert_eq!(any.read_one::<u8>(&answer), Err(ReadError::OtherQuery));
    let none = Content::parse("(true)").unwrap();
    assert!(matches!(
        all.read_all::<u8>(&none),
        Err(ReadError::Expression(_))
    ));
    assert!(matches!(Query::read(&none), Err(ReadError::Expression(_))));
}

#[test]
fn agent_identifiers_are_read_as_peers_write_them() {
    let read = |text: &str| AgentId::try_from(&Term::parse(text).unwrap());
    let agent = read(
        "(Agent-Identifier :Name crex :addresses (set tcp://h:1) :resolvers (sequence \
         (agent-identifier :name df)) :X-prio (high 1) :unknown 1)",
    );
    let agent = agent.unwrap();
    assert_eq!(
        (agent.name(), agent.addresses()),
        ("crex", &["tcp://h:1".to_owned()][..])
    );
    assert_eq!(agent.resolvers()[0].name(), "df");
    assert_eq!(
        agent.user_defined(),
        [("prio".to_owned(), "(high 1)".to_owned())]
    );
    assert_eq!(read("(agent-identifier :name 42)").unwrap().name(), "42");
    for (text, error) in [
        ("crex", AgentTermError::Symbol),
        ("(agent :name crex)", AgentTermError::Symbol),
        ("(agent-identifier)", AgentTermError::MissingName),
        (
            "(agent-identifier :name (f))",
            AgentTermError::Slot {
                slot: "name",
                expected: "a string",
            },
        ),
        (
            "(agent-identifier :name a :addresses b)",
            AgentTermError::Slot {
                slot: "addresses",
                expected: "a sequence",
            },
        ),
        (
            "(agent-identifier :name a :name b)",
            AgentTermError::DuplicateSlot("name"),
        ),
    ] {
        assert_eq!(read(text), Err(error), "{text}");
    }
    assert!(matches!(
        read("(agent-identifier :name \"\")"),
        Err(AgentTermError::Value(_))
    ));
}
