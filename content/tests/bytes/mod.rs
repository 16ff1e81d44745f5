//! Properties of arbitrary bytes: all readers agree on accepting or refusing them. The fuzz target
//! `content` has the same body.

use std::collections::BTreeMap;

use fipa_content::{
    Content, PrintError, Printer, Profile, Query, SlDialect, Term, Wff, from_slice_in, to_vec_in,
};
use serde::de::IgnoredAny;
use serde::{Deserialize, Serialize};

pub(crate) const DIALECTS: [SlDialect; 2] = [SlDialect::Standard, SlDialect::Jade];

/// Reads the bytes as each kind of expression and as values.
pub(crate) fn are_read_or_refused(bytes: &[u8]) {
    for dialect in DIALECTS {
        match Content::parse_in(dialect, bytes) {
            Ok(content) => survives(&content, dialect),
            Err(error) => assert!(error.offset() <= bytes.len()),
        }
        if let Err(error) = Wff::parse_in(dialect, bytes) {
            assert!(error.offset() <= bytes.len());
        }
        let term = Term::parse_in(dialect, bytes);
        let read = from_slice_in::<Term<'_>>(dialect, bytes);
        match (&term, &read) {
            (Ok(term), Ok(read)) => {
                // The deserializer passes terms in the standard notation, in which a byte string of
                // JADE that is UTF-8 becomes text.
                if dialect == SlDialect::Standard {
                    assert_eq!(term, read);
                }
                from_slice_in::<IgnoredAny>(dialect, bytes).expect("a term can be ignored");
            }
            (Err(_), Err(error)) => assert!(error.offset() <= bytes.len()),
            _ => panic!("{term:?} is read as {read:?}"),
        }
        let _ = from_slice_in::<serde_json::Value>(dialect, bytes);
        if let Ok(value) = from_slice_in::<Value>(dialect, bytes) {
            let text = to_vec_in(dialect, &value).expect("what was read can be written");
            let again = from_slice_in::<Value>(dialect, &text).expect("what was written is read");
            assert_eq!(again, value);
        }
    }
}

/// Checks that the content is the same after printing and parsing, in every layout and in every
/// dialect that has a notation for it.
pub(crate) fn survives(content: &Content<'_>, dialect: SlDialect) {
    let printer = Printer::new().dialect(dialect);
    let mut layouts = vec![printer, printer.indented()];
    if dialect == SlDialect::Jade {
        layouts.push(printer.jade_failure());
    }
    for printer in layouts {
        match printer.print(content) {
            Ok(text) => assert_eq!(Content::parse_in(dialect, &text).as_ref(), Ok(content)),
            Err(PrintError::Unrepresentable { .. }) if dialect == SlDialect::Jade => {}
            Err(error) => panic!("{dialect}: {error}"),
        }
    }
    assert_eq!(&content.clone().into_owned(), content);
    assert!(!content.to_string().contains('\n'));
    // Each profile contains the previous one.
    let least = Profile::of(content);
    for profile in Profile::ALL {
        let is_in = least.is_some_and(|least| profile >= least);
        assert_eq!(profile.check(content).is_ok(), is_in);
    }
    if let Ok(query) = Query::read(content) {
        assert_eq!(&query.content(), content);
    }
    if let Ok(action) = content.action() {
        let _ = action.read::<Value>();
    }
    if let Ok((_, reason)) = content.refusal() {
        let _ = reason.read::<Value>();
    }
}

/// A value with the usual kinds of fields.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Value {
    Search(Vec<Value>, BTreeMap<String, i64>),
    Dock {
        target: Option<Box<Value>>,
        speed: Option<f32>,
    },
    Pose(f64, f64),
    Text(String),
    Stop,
}
