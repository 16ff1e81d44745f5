//! Hostile text of any depth, size and bytes gives typed errors in bounded memory and time.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

use std::thread;

use fipa_content::{
    Content, DeserializeErrorKind, MAX_DEPTH, MAX_NODES, PrintError, Printer, Problem,
    SerializeError, SlDialect, Term, from_slice, to_vec,
};
use serde::de::IgnoredAny;
use serde::{Deserialize, Serialize};

fn nested(depth: usize) -> String {
    [&"(f ".repeat(depth)[..], "x", &")".repeat(depth)].concat()
}

#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(rename = "f")]
struct Nested {
    inner: Option<Box<Nested>>,
}

impl Nested {
    fn of(depth: usize) -> Self {
        (1..depth).fold(Self::default(), |inner, _| Self {
            inner: Some(Box::new(inner)),
        })
    }
}

/// Returns the problem for which the text is refused as a value of the type.
fn problem<T>(text: &str) -> Problem
where
    T: for<'de> Deserialize<'de>,
{
    let Err(error) = from_slice::<T>(text) else {
        panic!("{text} was read");
    };
    match error.kind() {
        DeserializeErrorKind::Syntax(error) => error.problem().clone(),
        other => panic!("{other}"),
    }
}

#[test]
fn depth_is_bounded() {
    // A small stack, compared to the usual thread stacks.
    let small = thread::Builder::new().stack_size(1 << 20);
    let run = small.spawn(|| {
        let allowed = nested(MAX_DEPTH);
        let term = Term::parse(&allowed).unwrap();
        assert_eq!(Printer::new().print(&term).unwrap(), allowed.as_bytes());
        Printer::new().indented().print(&term).unwrap();
        from_slice::<IgnoredAny>(&allowed).unwrap();
        from_slice::<Term<'static>>(&allowed).unwrap();
        from_slice::<serde_json::Value>(&allowed).unwrap();
        for depth in [MAX_DEPTH + 1, 1_000_000] {
            let deeper = nested(depth);
            let error = Term::parse(&deeper).unwrap_err();
            assert_eq!(error.problem(), &Problem::TooDeep);
            assert_eq!(error.offset(), 3 * MAX_DEPTH);
            assert_eq!(problem::<IgnoredAny>(&deeper), Problem::TooDeep);
            assert_eq!(problem::<serde_json::Value>(&deeper), Problem::TooDeep);
            assert_eq!(problem::<Term<'static>>(&deeper), Problem::TooDeep);
            for piece in ["(not ", "(done (| ", "(B a ", "(= (all (any "] {
                let wff = format!("({}", piece.repeat(depth));
                let error = Content::parse(&wff).unwrap_err();
                assert!(
                    matches!(
                        error.problem(),
                        Problem::TooDeep | Problem::Unexpected { .. }
                    ),
                    "{piece}: {error}"
                );
            }
        }
        let value = Nested::of(MAX_DEPTH);
        let text = to_vec(&value).unwrap();
        from_slice::<Nested>(&text).unwrap();
        let too_deep = SerializeError::Print(PrintError::TooDeep);
        assert_eq!(to_vec(&Nested::of(MAX_DEPTH + 1)), Err(too_deep));
        let deeper = "(f :inner ".repeat(1_000_000);
        assert_eq!(problem::<Nested>(&deeper), Problem::TooDeep);
    });
    run.unwrap().join().unwrap();
}

#[test]
fn formulas_nest_as_deep_as_terms() {
    let not = |depth| ["(", &"(not ".repeat(depth)[..], "p", &")".repeat(depth + 1)].concat();
    let allowed = not(MAX_DEPTH - 1);
    let content = Content::parse(&allowed).unwrap();
    assert_eq!(Printer::new().print(&content).unwrap(), allowed.as_bytes());
    let error = Content::parse(&not(MAX_DEPTH))
        .unwrap_err()
        .problem()
        .clone();
    assert_eq!(error, Problem::TooDeep);
    // A constructed term is not written deeper than the parser accepts.
    let deeper = (0..=MAX_DEPTH).fold(Term::from("x"), |term, _| Term::functional("f", [term]));
    assert_eq!(Printer::new().print(&deeper), Err(PrintError::TooDeep));
}

#[test]
fn a_term_inside_of_a_value_counts_with_what_is_around() {
    let term = Term::parse(&nested(MAX_DEPTH)).unwrap().into_owned();
    assert!(matches!(to_vec(&[&term]), Err(SerializeError::Term(_))));
    let text = format!("(sequence {})", nested(MAX_DEPTH));
    assert_eq!(problem::<Vec<Term<'static>>>(&text), Problem::TooDeep);
}

#[test]
fn the_number_of_terms_is_bounded() {
    let many = |number| format!("(sequence{})", " a".repeat(number));
    let allowed = many(MAX_NODES - 1);
    assert!(Term::parse(&allowed).is_ok());
    let more = many(MAX_NODES);
    let error = Term::parse(&more).unwrap_err();
    assert_eq!(error.problem(), &Problem::TooMany);
    // This bound does not apply to typed values, whose size follows from the text.
    let typed: Vec<&str> = from_slice(&more).unwrap();
    assert_eq!(typed.len(), MAX_NODES);
}

#[test]
fn announced_lengths_take_no_memory() {
    for length in [
        "18446744073709551615",
        "99999999999999999999999999",
        "4294967296",
    ] {
        for text in [format!("#{length}\""), format!("(f #{length}\"abc)")] {
            let error = Term::parse(&text).unwrap_err();
            let truncated = Problem::Truncated("byte-length encoded string");
            assert_eq!(error.problem(), &truncated);
            assert_eq!(problem::<IgnoredAny>(&text), truncated);
        }
    }
}

/// Each of these texts takes quadratic time if a search repeats per token. The watchdog of the test
/// runner then ends the test.
#[test]
fn large_text_is_read_once() {
    const SIZE: usize = 512 << 10;
    for piece in [
        "\"", "\\\"", "#1\"", "(", ":a", "?", "a ", "\"\\\"", "(f :a ", "1", ".", "\n",
    ] {
        let text = piece.repeat(SIZE / piece.len());
        let _ = Term::parse(&text);
        let _ = Content::parse_in(SlDialect::Jade, &text);
        let _ = from_slice::<IgnoredAny>(&text);
        let _ = from_slice::<Nested>(&text);
        // Also as the value of an unknown slot.
        let _ = from_slice::<Nested>(&format!("(f :other \"{text}"));
    }
    let long = format!("\"{}\"", "a\\\"".repeat(SIZE / 3));
    let read: String = from_slice(&long).unwrap();
    assert_eq!(read.len(), SIZE / 3 * 2);
    assert_eq!(to_vec(&read).unwrap(), long.as_bytes());
    let wide = Term::Sequence(vec![Term::from("a b"); 200_000]);
    let indented = Printer::new().indented().print(&wide).unwrap();
    assert_eq!(Term::parse(&indented).unwrap(), wide);
}

/// Every prefix and every changed byte of a content is accepted or refused.
#[test]
fn damaged_text_is_refused_where_it_is_damaged() {
    let text = "((action (agent-identifier :name crex) (dock :target (pose :x 1.5 :frame \"a b\")))\
                (= (iota ?x (p ?x #2\"())) 20000508T042651481Z))";
    assert!(Content::parse(text).is_ok());
    for end in 0..text.len() {
        let error = Content::parse(&text[..end]).unwrap_err();
        assert!(error.offset() <= end, "{error}");
        assert!(error.clause().contains("FIPA00008"), "{error}");
    }
    let mut changed = text.as_bytes().to_vec();
    for at in 0..changed.len() {
        let byte = changed[at];
        for other in *b"\0 \"#()+-.0:?Z\\e|\x80\xc3\xff" {
            changed[at] = other;
            if let Err(error) = Content::parse(&changed) {
                assert!(error.offset() <= changed.len());
            }
            let _ = from_slice::<IgnoredAny>(&changed);
        }
        changed[at] = byte;
    }
}
