//! Finds what went wrong in a recording: violations, letters that were not delivered, locks and hosts.

use std::collections::HashMap;

use serde::Deserialize;
use serde_json::{Map, Value};

use super::super::file;
use super::super::file::reader::Item;

/// Maximum number of letters that were not delivered. Further ones are not found.
const MAX_FAILED: usize = 100_000;

/// Maximum length of their later outcomes, in bytes. Further ones are left out.
const MAX_OUTCOMES: usize = 64 << 20;

/// The keys of the object of a letter or of an event.
#[derive(Deserialize)]
struct Keys<'a> {
    event: &'a str,
    number: Option<u64>,
    outcome: Option<&'a str>,
    #[serde(borrow)]
    verdict: Option<Verdict<'a>>,
}

#[derive(Deserialize)]
struct Verdict<'a> {
    verdict: &'a str,
}

/// Numbers of events.
#[derive(Debug, Default)]
pub(super) struct Found {
    pub(super) violations: u64,
    pub(super) abandoned: u64,
    pub(super) lost: u64,
    pub(super) hosts: u64,
    /// The letters that were not delivered, with the outcome that was reported after the letter.
    failed: HashMap<u64, Option<Vec<u8>>>,
    outcomes: usize,
}

impl Found {
    pub(super) fn add(&mut self, item: &Item<'_>) {
        let Item::Message { schema, data, .. } = item else {
            return;
        };
        let name = schema.map(|it| it.header.name.as_str());
        let is_letter = name == Some(file::LETTER_SCHEMA.name);
        if !is_letter && name != Some(file::EVENT_SCHEMA.name) {
            return;
        }
        // An object of another program is no event.
        let Ok(keys) = serde_json::from_slice::<Keys<'_>>(data) else {
            return;
        };
        if is_letter {
            let verdict = keys.verdict.map(|it| it.verdict);
            self.violations += u64::from(verdict == Some("violation"));
        }
        match (keys.event, keys.number) {
            ("letter" | "outcome", Some(number)) => {
                let later = (!is_letter).then_some(*data);
                self.outcome(number, keys.outcome, later);
            }
            ("lock_abandoned", _) => self.abandoned += 1,
            ("lock_lost", _) => self.lost += 1,
            ("host_gone", _) => self.hosts += 1,
            _ => {}
        }
    }

    fn outcome(&mut self, number: u64, outcome: Option<&str>, later: Option<&[u8]>) {
        if outcome != Some("failed") {
            self.failed.remove(&number);
            return;
        }
        if self.failed.len() >= MAX_FAILED && !self.failed.contains_key(&number) {
            return;
        }
        let later = later.filter(|it| it.len() <= MAX_OUTCOMES.saturating_sub(self.outcomes));
        self.outcomes += later.map_or(0, <[u8]>::len);
        self.failed.insert(number, later.map(<[u8]>::to_vec));
    }

    /// Number of letters that were not delivered.
    pub(super) fn failed(&self) -> usize {
        self.failed.len()
    }

    /// Gives a letter its last outcome. Returns `false` if it was delivered, or if this is no letter.
    pub(super) fn settle(&self, letter: &mut Map<String, Value>) -> bool {
        let is_letter = letter.get("event").is_some_and(|it| it == "letter");
        let number = letter.get("number").and_then(Value::as_u64);
        let Some(later) = number
            .and_then(|it| self.failed.get(&it))
            .filter(|_| is_letter)
        else {
            return false;
        };
        let later = later.as_deref().map(serde_json::from_slice::<Map<_, _>>);
        if let Some(Ok(mut later)) = later {
            for key in ["outcome", "reason", "attempts", "settled"] {
                if let Some(value) = later.remove(key) {
                    letter.insert(key.to_owned(), value);
                }
            }
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn the_last_outcome_of_a_letter_counts() {
        let mut found = Found::default();
        let later = |reason: &str| json!({ "outcome": "failed", "reason": reason }).to_string();
        found.outcome(1, Some("under_way"), None);
        found.outcome(2, Some("failed"), None);
        found.outcome(3, Some("failed"), None);
        found.outcome(4, Some("delivered"), None);
        found.outcome(1, Some("failed"), Some(later("no such agent").as_bytes()));
        found.outcome(1, Some("failed"), Some(later("unreachable").as_bytes()));
        found.outcome(2, Some("delivered"), Some(b"{}"));
        assert_eq!(found.failed(), 2);
        let letter = |number: u64| {
            let letter = json!({ "event": "letter", "number": number, "outcome": "under_way" });
            let mut letter = letter.as_object().cloned().unwrap_or_default();
            let is_failed = found.settle(&mut letter);
            is_failed.then(|| json!([letter["outcome"], letter.get("reason")]))
        };
        assert_eq!(letter(1), Some(json!(["failed", "unreachable"])));
        assert_eq!(letter(3), Some(json!(["under_way", null])));
        assert_eq!((letter(2), letter(4)), (None, None));
    }

    #[test]
    fn the_memory_is_bounded() {
        let mut found = Found::default();
        let long = vec![b'x'; MAX_OUTCOMES / 4];
        for number in 0..MAX_FAILED as u64 + 10 {
            found.outcome(number, Some("failed"), Some(&long));
        }
        let kept = found.failed.values().flatten().map(Vec::len);
        assert_eq!(
            (found.failed(), kept.sum::<usize>()),
            (MAX_FAILED, MAX_OUTCOMES)
        );
    }
}
