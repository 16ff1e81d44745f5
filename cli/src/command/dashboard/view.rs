//! A view of the domain as rows of JSON, and the changes between two states of it.

use std::collections::BTreeMap;

use serde::Serialize;
use serde_json::Value;

/// Rows by section and key. Equal rows have equal texts.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct View {
    sections: BTreeMap<&'static str, BTreeMap<String, String>>,
}

impl View {
    /// Adds a section, so that it is there without rows, too.
    pub(super) fn section(&mut self, section: &'static str) {
        self.sections.entry(section).or_default();
    }

    /// Adds a row.
    pub(super) fn put(
        &mut self,
        section: &'static str,
        key: impl Into<String>,
        row: &impl Serialize,
    ) {
        let rows = self.sections.entry(section).or_default();
        // Texts, numbers, and lists of them are always representable.
        let row = serde_json::to_string(row).unwrap_or_else(|_| "null".to_owned());
        rows.insert(key.into(), row);
    }

    /// Returns the whole view as a JSON object: section, key, row.
    pub(super) fn json(&self) -> String {
        let mut text = String::from("{");
        for (section, rows) in &self.sections {
            separate(&mut text);
            push_key(&mut text, section);
            push_rows(&mut text, rows);
        }
        text.push('}');
        text
    }

    /// Returns the rows that are new or different since an earlier state as `set`, and the keys of the others as
    /// `gone`; `None` if both states are equal.
    pub(super) fn changes_since(&self, earlier: &Self) -> Option<String> {
        let none = BTreeMap::new();
        let (mut set, mut gone) = (String::new(), String::new());
        for (section, rows) in &self.sections {
            let before = earlier.sections.get(section).unwrap_or(&none);
            let changed = rows
                .iter()
                .filter(|(key, row)| before.get(*key) != Some(*row));
            let changed: BTreeMap<&String, &String> = changed.collect();
            if !changed.is_empty() {
                separate(&mut set);
                push_key(&mut set, section);
                push_rows(&mut set, changed);
            }
        }
        for (section, before) in &earlier.sections {
            let rows = self.sections.get(section).unwrap_or(&none);
            let removed = before.keys().filter(|key| !rows.contains_key(*key));
            let removed: Vec<&String> = removed.collect();
            if !removed.is_empty() {
                separate(&mut gone);
                push_key(&mut gone, section);
                gone.push_str(&Value::from_iter(removed.into_iter().cloned()).to_string());
            }
        }
        let is_equal = set.is_empty() && gone.is_empty();
        (!is_equal).then(|| format!("{{\"set\":{{{set}}},\"gone\":{{{gone}}}}}"))
    }
}

fn separate(text: &mut String) {
    if !text.is_empty() && !text.ends_with('{') {
        text.push(',');
    }
}

fn push_key(text: &mut String, key: &str) {
    text.push_str(&Value::from(key).to_string());
    text.push(':');
}

fn push_rows(
    text: &mut String,
    rows: impl IntoIterator<Item = (impl AsRef<str>, impl AsRef<str>)>,
) {
    text.push('{');
    for (key, row) in rows {
        separate(text);
        push_key(text, key.as_ref());
        text.push_str(row.as_ref());
    }
    text.push('}');
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a failed precondition fails the test")]

    use proptest::prelude::*;
    use serde_json::{Map, json};

    use super::*;

    fn view(has_sections: bool, rows: &[(bool, String, u8)]) -> View {
        let mut view = View::default();
        if has_sections {
            view.section("a");
            view.section("b");
        }
        for (first, key, row) in rows {
            let section = if *first { "a" } else { "b" };
            view.put(section, key.as_str(), &json!({ "n": row }));
        }
        view
    }

    /// Applies changes as the page does.
    fn apply(state: &mut Map<String, Value>, changes: &Value) {
        for (section, rows) in changes["set"].as_object().unwrap() {
            let into = state.entry(section.as_str()).or_insert_with(|| json!({}));
            let into = into.as_object_mut().unwrap();
            into.extend(rows.as_object().unwrap().clone());
        }
        for (section, keys) in changes["gone"].as_object().unwrap() {
            let from = state
                .get_mut(section)
                .and_then(Value::as_object_mut)
                .unwrap();
            for key in keys.as_array().unwrap() {
                from.remove(key.as_str().unwrap());
            }
        }
    }

    #[test]
    fn equal_views_have_no_changes() {
        let one = view(true, &[(true, "x".to_owned(), 1)]);
        assert_eq!(one.changes_since(&one.clone()), None);
        assert_eq!(one.json(), r#"{"a":{"x":{"n":1}},"b":{}}"#);
    }

    proptest! {
        #[test]
        fn a_state_with_its_changes_is_the_next_state(
            have_sections in any::<(bool, bool)>(),
            before in prop::collection::vec((any::<bool>(), ".{0,3}", 0_u8..3), 0..8),
            after in prop::collection::vec((any::<bool>(), ".{0,3}", 0_u8..3), 0..8),
        ) {
            let (before, after) = (view(have_sections.0, &before), view(have_sections.1, &after));
            let mut state: Map<String, Value> = serde_json::from_str(&before.json()).unwrap();
            if let Some(changes) = after.changes_since(&before) {
                apply(&mut state, &serde_json::from_str(&changes).unwrap());
            }
            let mut expected: Map<String, Value> = serde_json::from_str(&after.json()).unwrap();
            // A section without rows is as one that is missing.
            for view in [&mut state, &mut expected] {
                view.retain(|_, rows| *rows != json!({}));
            }
            prop_assert_eq!(state, expected);
        }
    }
}
