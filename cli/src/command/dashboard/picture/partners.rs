//! The partners of an agent, and the reasons why its letters were not delivered, among the newest letters.

use std::collections::{BTreeMap, HashMap};

use fipa::FailureReason;
use serde_json::{Value, json};

use super::letters::Letter;

/// Maximum number of partners. Further ones are left out.
const MAX_ROWS: usize = 100;

/// The letters of an agent with each partner, and the failures by their reasons.
#[derive(Debug, Default)]
pub(super) struct Partners {
    partners: BTreeMap<String, Counts>,
    reasons: HashMap<FailureReason, u64>,
}

#[derive(Debug, Default)]
struct Counts {
    sent: u64,
    received: u64,
    failures: u64,
    violations: u64,
}

impl Partners {
    /// Counts the letters of this agent.
    pub(super) fn of<'a>(name: &str, letters: impl Iterator<Item = &'a Letter>) -> Self {
        let mut partners = Self::default();
        for letter in letters {
            let is_sent = letter.from == name;
            if !is_sent && letter.to != name {
                continue;
            }
            let partner = if is_sent { &letter.to } else { &letter.from };
            let has_room = partners.partners.len() < MAX_ROWS;
            if has_room || partners.partners.contains_key(partner) {
                let counts = partners.partners.entry(partner.clone()).or_default();
                counts.sent += u64::from(is_sent);
                counts.received += u64::from(!is_sent);
                counts.failures += u64::from(letter.has_failed());
                counts.violations += u64::from(letter.violation.is_some());
            }
            if let Some(reason) = letter.reason().filter(|_| is_sent) {
                *partners.reasons.entry(reason).or_default() += 1;
            }
        }
        partners
    }

    /// The rows of the partners by name.
    pub(super) fn rows(&self) -> impl Iterator<Item = (&str, Value)> {
        self.partners.iter().map(|(name, counts)| {
            let row = json!({
                "name": name, "sent": counts.sent, "received": counts.received, "failures": counts.failures,
                "violations": counts.violations,
            });
            (name.as_str(), row)
        })
    }

    /// The rows of the reasons.
    pub(super) fn reasons(&self) -> impl Iterator<Item = (String, Value)> {
        self.reasons.iter().map(|(reason, count)| {
            let reason = reason.to_string();
            let row = json!({ "reason": reason, "failures": count });
            (reason, row)
        })
    }
}
