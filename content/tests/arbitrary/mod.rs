//! Contents, formulas and terms of all kinds, for property tests.

use std::borrow::Cow;

use fipa_content::{
    ActionExpression, Arguments, Content, ContentExpression, FunctionalTerm, IdentifyingExpression,
    LogicalOperator, ModalOperator, Number, Parameter, Quantifier, ReferentialOperator, Term, Wff,
};
use proptest::collection::vec;
use proptest::option;
use proptest::prelude::*;
use proptest::sample::select;

/// Text with special cases of the notation.
pub(crate) fn text() -> BoxedStrategy<String> {
    const SPECIAL: [&str; 37] = [
        "",
        "true",
        "FALSE",
        "action",
        "sequence",
        "set",
        "all",
        "B",
        "b",
        "not",
        "=",
        "|",
        ";",
        "+",
        "-",
        "1",
        "+1",
        ".5",
        "-x",
        "0x1f",
        "20000508T042651481Z",
        "?x",
        "??x",
        ":x",
        "#1\"a",
        "a\\",
        "a\\\"b",
        "\\\"",
        "\"",
        "a\"b",
        "é",
        "a b",
        "(",
        "\n",
        "result",
        "done",
        "%",
    ];
    prop_oneof![
        3 => "[a-z@:/.-]{0,8}",
        2 => select(&SPECIAL[..]).prop_map(str::to_owned),
        1 => "\\PC{0,12}",
        1 => "[\\x00-\\x20\"\\\\#()]{0,6}",
    ]
    .boxed()
}

fn name() -> BoxedStrategy<Cow<'static, str>> {
    text().prop_map(Cow::Owned).boxed()
}

fn number() -> BoxedStrategy<Number<'static>> {
    prop_oneof![
        any::<i64>().prop_map(Number::from),
        any::<u128>().prop_map(Number::from),
        any::<f64>().prop_filter_map("finite", Number::from_f64),
        "[+-]?0[xX][0-9a-fA-F]{1,40}".prop_filter_map("a number", Number::new),
        "[+-]?([0-9]{1,40}\\.?|[0-9]{0,3}\\.[0-9]{1,3})([eE][+-]?[0-9]{1,3})?"
            .prop_filter_map("a number", Number::new),
    ]
    .boxed()
}

fn constant() -> BoxedStrategy<Term<'static>> {
    const TIMES: [&str; 5] = [
        "20000508T042651481Z",
        "20101223T120037980",
        "20101223T120037980a",
        "+00000000T000030000",
        "-00010105T000000000",
    ];
    let bytes = vec(any::<u8>(), 0..12).prop_map(|mut bytes| {
        // Bytes that are UTF-8 read as a string.
        bytes.push(0xff);
        Term::Bytes(Cow::Owned(bytes))
    });
    prop_oneof![
        3 => number().prop_map(Term::Number),
        3 => text().prop_map(Term::from),
        1 => bytes,
        1 => any::<bool>().prop_map(Term::Boolean),
        1 => select(&TIMES[..]).prop_map(|text| Term::DateTime(text.parse().unwrap())),
        1 => name().prop_map(Term::Variable),
        1 => name().prop_map(Term::Meta),
    ]
    .boxed()
}

fn arguments(term: BoxedStrategy<Term<'static>>) -> BoxedStrategy<Arguments<'static>> {
    let parameter = (name(), term.clone()).prop_map(|(name, value)| Parameter { name, value });
    prop_oneof![
        vec(term, 0..4).prop_map(Arguments::Terms),
        vec(parameter, 1..4).prop_map(Arguments::Parameters),
    ]
    .boxed()
}

/// Generates terms and formulas of this depth.
pub(crate) fn nested(depth: usize) -> (BoxedStrategy<Term<'static>>, BoxedStrategy<Wff<'static>>) {
    let atom = prop_oneof![
        any::<bool>().prop_map(Wff::Truth),
        name().prop_map(Wff::Proposition),
        name().prop_map(Wff::Meta),
    ]
    .boxed();
    if depth == 0 {
        return (constant(), atom);
    }
    let (term, wff) = nested(depth - 1);
    let action = action(&term, depth - 1);
    let operator = select(
        &[
            ReferentialOperator::Iota,
            ReferentialOperator::Any,
            ReferentialOperator::All,
        ][..],
    );
    let identifying = (operator, term.clone(), wff.clone()).prop_map(|(operator, term, wff)| {
        IdentifyingExpression {
            operator,
            term,
            wff,
        }
    });
    let functional = (name(), arguments(term.clone()))
        .prop_map(|(symbol, arguments)| Term::from(FunctionalTerm { symbol, arguments }));
    let terms = prop_oneof![
        2 => constant(),
        3 => functional,
        1 => vec(term.clone(), 0..4).prop_map(Term::Sequence),
        1 => vec(term.clone(), 0..4).prop_map(Term::Set),
        1 => action.clone().prop_map(Term::from),
        1 => identifying.prop_map(Term::from),
    ]
    .boxed();
    let logical = select(
        &[
            LogicalOperator::And,
            LogicalOperator::Or,
            LogicalOperator::Implies,
            LogicalOperator::Equiv,
        ][..],
    );
    let modal = select(
        &[
            ModalOperator::Belief,
            ModalOperator::Uncertainty,
            ModalOperator::PersistentGoal,
            ModalOperator::Intention,
        ][..],
    );
    let quantifier = select(&[Quantifier::Forall, Quantifier::Exists][..]);
    let boxed = |wff: &BoxedStrategy<Wff<'static>>| wff.clone().prop_map(Box::new);
    let two = (
        term.clone().prop_map(Box::new),
        term.clone().prop_map(Box::new),
    );
    let after = (action.prop_map(Box::new), option::of(boxed(&wff)));
    let wffs = prop_oneof![
        2 => atom,
        3 => (name(), vec(term.clone(), 1..4))
            .prop_map(|(symbol, arguments)| Wff::Predicate { symbol, arguments }),
        1 => two.clone().prop_map(|(left, right)| Wff::Equal(left, right)),
        1 => two.prop_map(|(action, value)| Wff::Result(action, value)),
        1 => boxed(&wff).prop_map(Wff::Not),
        1 => (logical, boxed(&wff), boxed(&wff))
            .prop_map(|(operator, left, right)| Wff::Binary { operator, left, right }),
        1 => (quantifier, name(), boxed(&wff))
            .prop_map(|(quantifier, variable, wff)| Wff::Quantified { quantifier, variable, wff }),
        1 => (modal, term.prop_map(Box::new), boxed(&wff))
            .prop_map(|(operator, agent, wff)| Wff::Modal { operator, agent, wff }),
        1 => after.clone().prop_map(|(action, wff)| Wff::Feasible(action, wff)),
        1 => after.prop_map(|(action, wff)| Wff::Done(action, wff)),
    ]
    .boxed();
    (terms, wffs)
}

fn action(
    term: &BoxedStrategy<Term<'static>>,
    depth: usize,
) -> BoxedStrategy<ActionExpression<'static>> {
    let simple = (term.clone(), term.clone())
        .prop_map(|(agent, act)| ActionExpression::Action { agent, act });
    if depth == 0 {
        return simple.boxed();
    }
    let two = {
        let part = action(term, depth - 1);
        (part.clone().prop_map(Box::new), part.prop_map(Box::new))
    };
    prop_oneof![
        3 => simple,
        1 => name().prop_map(ActionExpression::Meta),
        1 => two.clone().prop_map(|(first, second)| ActionExpression::Alternative(first, second)),
        1 => two.prop_map(|(first, second)| ActionExpression::Sequential(first, second)),
    ]
    .boxed()
}

/// Generates a content.
pub(crate) fn content() -> BoxedStrategy<Content<'static>> {
    let (term, wff) = nested(3);
    let expression = prop_oneof![
        2 => wff.prop_map(ContentExpression::Wff),
        1 => term.prop_filter_map("an expression", |term| match term {
            Term::Identifying(expression) => Some(ContentExpression::Identifying(*expression)),
            Term::Action(action) => Some(ContentExpression::from(*action)),
            _ => None,
        }),
    ];
    vec(expression, 1..4).prop_map(Content::new).boxed()
}
