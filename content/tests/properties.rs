//! Properties of all contents, and of arbitrary bytes.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

mod arbitrary;
mod bytes;

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

use fipa_content::{Printer, Set, SlDialect, Term, from_slice, from_slice_in, to_vec, to_vec_in};
use proptest::collection::{btree_map, btree_set, vec};
use proptest::option;
use proptest::prelude::*;
use serde::{Deserialize, Serialize};

use arbitrary::{content, nested, text};
use bytes::{DIALECTS, are_read_or_refused, survives};

/// Bytes with a fair probability to form tokens.
fn nearly_sl() -> impl Strategy<Value = Vec<u8>> {
    let pieces = prop::sample::select(
        &[
            "(",
            "(",
            "(",
            ")",
            ")",
            ")",
            " ",
            "a",
            ":a ",
            "?x ",
            "??m",
            "\"",
            "\\\"",
            "#2\"",
            "1",
            "-1.5e3 ",
            "0x",
            "action ",
            "(action a b)",
            "iota ",
            "(p a)",
            "done ",
            "not ",
            "sequence ",
            "set ",
            "20000508T042651481Z ",
            "true ",
            "é",
            "\n",
            "| ",
            "= ",
        ][..],
    );
    let piece = prop_oneof![
        9 => pieces.prop_map(|piece: &str| piece.as_bytes().to_vec()),
        1 => vec(any::<u8>(), 1..3),
    ];
    vec(piece, 0..40).prop_map(|pieces| pieces.concat())
}

/// Returns one of the contents in `tests/contents`, changed in a few places.
fn damaged() -> impl Strategy<Value = Vec<u8>> {
    let directory = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/contents");
    let files = fs::read_dir(directory).unwrap();
    let mut paths: Vec<_> = files.map(|entry| entry.unwrap().path()).collect();
    paths.sort();
    let contents: Vec<_> = paths.iter().map(|path| fs::read(path).unwrap()).collect();
    let change = (any::<prop::sample::Index>(), 0..3_usize, nearly_sl());
    (prop::sample::select(contents), vec(change, 0..3)).prop_map(|(mut content, changes)| {
        for (at, removed, inserted) in changes {
            let at = at.index(content.len() + 1);
            let end = content.len().min(at + removed);
            content.splice(at..end, inserted);
        }
        content
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(ProptestConfig::default().cases.min(192)))]

    #[test]
    fn what_was_printed_reads_the_same(content in content()) {
        for dialect in DIALECTS {
            survives(&content, dialect);
        }
    }

    #[test]
    fn terms_survive_serde(term in nested(2).0) {
        let text = to_vec(&term).unwrap();
        prop_assert_eq!(&text, &Printer::new().print(&term).unwrap());
        prop_assert_eq!(&from_slice::<Term<'_>>(&text).unwrap(), &term);
        if let Ok(text) = to_vec_in(SlDialect::Jade, &term) {
            prop_assert_eq!(&from_slice_in::<Term<'_>>(SlDialect::Jade, &text).unwrap(), &term);
        }
        let json = serde_json::to_vec(&term).unwrap();
        if std::str::from_utf8(&text).is_ok() {
            prop_assert_eq!(&serde_json::from_slice::<Term<'_>>(&json).unwrap(), &term);
        }
    }

    #[test]
    fn any_bytes_are_read_or_refused(
        bytes in prop_oneof![vec(any::<u8>(), 0..80), nearly_sl(), damaged()]
    ) {
        are_read_or_refused(&bytes);
        for dialect in DIALECTS {
            let _ = from_slice_in::<Everything>(dialect, &bytes);
        }
    }

    #[test]
    fn values_survive(value in everything()) {
        let text = to_vec(&value).unwrap();
        prop_assert_eq!(&from_slice::<Everything>(&text).unwrap(), &value);
        // The text is SL.
        let term = Term::parse(&text).unwrap();
        prop_assert_eq!(&term.read::<Everything>().unwrap(), &value);
        prop_assert_eq!(Term::from_value(&value).unwrap(), term);
        if let Ok(text) = to_vec_in(SlDialect::Jade, &value) {
            prop_assert_eq!(&from_slice_in::<Everything>(SlDialect::Jade, &text).unwrap(), &value);
        }
    }
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
struct Everything {
    small: i8,
    large: u64,
    huge: i128,
    single: f32,
    double: f64,
    truth: bool,
    letter: char,
    text: String,
    absent: Option<String>,
    set: Set<BTreeSet<String>>,
    list: Vec<Option1>,
    map: BTreeMap<String, i32>,
    pair: (u16, String),
    kind: Kind,
    unit: (),
}

/// A struct with an optional slot.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Option1 {
    value: Option<i32>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Kind {
    Unit,
    True,
    Newtype(String),
    Absent(Option<u8>),
    Tuple(i8, String),
    Struct { inner: Option<Box<Kind>> },
}

fn kind() -> BoxedStrategy<Kind> {
    let leaf = prop_oneof![
        Just(Kind::Unit),
        Just(Kind::True),
        text().prop_map(Kind::Newtype),
        any::<Option<u8>>().prop_map(Kind::Absent),
        (any::<i8>(), text()).prop_map(|(one, other)| Kind::Tuple(one, other)),
    ];
    leaf.prop_recursive(3, 4, 1, |inner| {
        option::of(inner.prop_map(Box::new)).prop_map(|inner| Kind::Struct { inner })
    })
    .boxed()
}

fn everything() -> impl Strategy<Value = Everything> {
    let numbers = (
        any::<i8>(),
        any::<u64>(),
        any::<i128>(),
        any::<f32>().prop_filter("finite", |value| value.is_finite()),
        any::<f64>().prop_filter("finite", |value| value.is_finite()),
        any::<bool>(),
        any::<char>(),
    );
    let others = (
        text(),
        option::of(text()),
        btree_set(text(), 0..4),
        vec(
            any::<Option<i32>>().prop_map(|value| Option1 { value }),
            0..4,
        ),
        btree_map(text(), any::<i32>(), 0..4),
        (any::<u16>(), text()),
        kind(),
    );
    (numbers, others).prop_map(|(numbers, others)| {
        let (small, large, huge, single, double, truth, letter) = numbers;
        let (text, absent, set, list, map, pair, kind) = others;
        Everything {
            small,
            large,
            huge,
            single,
            double,
            truth,
            letter,
            text,
            absent,
            set: Set(set),
            list,
            map,
            pair,
            kind,
            unit: (),
        }
    })
}
