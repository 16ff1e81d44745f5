//! Counts the observed letters.

use std::collections::HashSet;
use std::time::Instant;

use fipa::Outcome;
use fipa::admin::watch::{Fate, Passage};

use super::checker::CheckResult;
use super::text::{Ink, Look};

/// Counters of the observed letters.
#[derive(Debug)]
pub(super) struct Tally {
    began: Instant,
    pub(super) letters: u64,
    /// Letters that were shown.
    pub(super) shown: u64,
    pub(super) delivered: u64,
    pub(super) failed: u64,
    /// Letters whose outcome is not known yet.
    pub(super) open: u64,
    pub(super) violations: u64,
    /// Lost records of the watched processes.
    pub(super) lost: u64,
    conversations: HashSet<String>,
}

/// Maximum number of conversations to count.
const MAX_CONVERSATIONS: usize = 100_000;

impl Default for Tally {
    fn default() -> Self {
        Self {
            began: Instant::now(),
            letters: 0,
            shown: 0,
            delivered: 0,
            failed: 0,
            open: 0,
            violations: 0,
            lost: 0,
            conversations: HashSet::new(),
        }
    }
}

impl Tally {
    pub(super) fn letter(&mut self, passage: &Passage, checked: &CheckResult) {
        self.letters += 1;
        self.violations += u64::from(checked.is_violation());
        *self.counter(&passage.fate) += 1;
        let id = passage.message.as_ref().and_then(|it| it.conversation_id());
        if let Some(id) = id
            && self.conversations.len() < MAX_CONVERSATIONS
            && !self.conversations.contains(id)
        {
            self.conversations.insert(id.to_owned());
        }
    }

    /// Counts the later outcome of an open letter.
    pub(super) fn later(&mut self, passage: &Passage) {
        // Only an open letter changes its counter; an outcome is final.
        if !matches!(passage.fate, Fate::UnderWay) && self.open > 0 {
            self.open -= 1;
            *self.counter(&passage.fate) += 1;
        }
    }

    fn counter(&mut self, fate: &Fate) -> &mut u64 {
        match fate {
            Fate::UnderWay => &mut self.open,
            Fate::Settled(Outcome::Failed { .. }) | Fate::Passed(Outcome::Failed { .. }) => {
                &mut self.failed
            }
            Fate::Taken | Fate::Settled(_) | Fate::Passed(_) => &mut self.delivered,
        }
    }

    pub(super) fn conversations(&self) -> usize {
        self.conversations.len()
    }

    pub(super) fn seconds(&self) -> f64 {
        self.began.elapsed().as_secs_f64()
    }

    /// The summary as text.
    pub(super) fn summary(&self, look: Look) -> String {
        let mut parts = vec![format!("{} delivered", self.delivered)];
        if self.failed > 0 {
            parts.push(look.paint(Ink::Bad, &format!("{} failed", self.failed)));
        }
        if self.open > 0 {
            parts.push(format!("{} with unknown outcome", self.open));
        }
        let violations = match self.violations {
            0 => "no violations".to_owned(),
            1 => look.paint(Ink::Bad, "1 violation"),
            many => look.paint(Ink::Bad, &format!("{many} violations")),
        };
        let mut text = format!(
            "\n{} in {:.1} s: {}; {}, {violations}\n",
            counted(self.letters, "letter"),
            self.seconds(),
            parts.join(", "),
            counted(self.conversations() as u64, "conversation"),
        );
        if self.shown < self.letters {
            text.push_str(&format!("{} of them shown\n", self.shown));
        }
        if self.lost > 0 {
            text.push_str(&look.paint(
                Ink::Warning,
                &format!(
                    "{} lost: letters may be missing, and later verdicts may be wrong\n",
                    counted(self.lost, "record")
                ),
            ));
        }
        text
    }
}

fn counted(number: u64, noun: &str) -> String {
    let plural = if number == 1 { "" } else { "s" };
    format!("{number} {noun}{plural}")
}
