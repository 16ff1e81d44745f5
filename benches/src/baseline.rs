//! An earlier result to compare with: the JSON output of the command.
//!
//! Only ratios to the limits are compared, because times depend on the load of the machine. A ratio
//! has changed when the middle halves of its rounds in both results do not overlap, and the medians
//! differ by more than [`NEGLIGIBLE`].

use std::collections::HashMap;
use std::fmt;
use std::path::Path;

use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::error::BenchError;
use crate::locks;
use crate::measure::{Row, name_of};
use crate::part::{Fill, Wait};
use crate::report;

/// Relative difference of medians that is never reported.
const NEGLIGIBLE: f64 = 0.05;

/// An earlier result.
#[derive(Debug)]
pub struct Baseline(HashMap<Key, Ratios>);

/// Identifies a row.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Deserialize)]
#[serde(untagged)]
enum Key {
    /// A path with one kind of letter.
    Path {
        path: String,
        wait: Wait,
        size: usize,
        fill: Fill,
    },
    /// A group of agents that shares a resource.
    Locks {
        algorithm: String,
        agents: usize,
        hosts: usize,
    },
}

/// Ratios to the limit, each with the middle half of the rounds.
#[derive(Debug, Clone, Copy, Deserialize)]
struct Ratios {
    ratio: Option<f64>,
    ratio_spread: Option<[f64; 2]>,
    round_trip_ratio: Option<f64>,
    round_trip_ratio_spread: Option<[f64; 2]>,
}

#[derive(Deserialize)]
struct Document {
    rows: Vec<BaselineRow>,
}

#[derive(Deserialize)]
struct BaselineRow {
    #[serde(flatten)]
    key: Key,
    #[serde(flatten)]
    ratios: Ratios,
}

/// The differences between a result and an earlier one.
#[derive(Debug, Default)]
pub struct Changes {
    changes: Vec<Change>,
    /// Number of ratios that were compared.
    compared: usize,
}

#[derive(Debug, PartialEq, Serialize)]
struct Change {
    what: String,
    before: f64,
    after: f64,
}

impl Baseline {
    /// Reads the JSON output of an earlier measurement.
    ///
    /// # Errors
    ///
    /// [`BenchError::Read`] if the file cannot be read, [`BenchError::Baseline`] if it is not such
    /// output.
    pub fn read(path: &Path) -> Result<Self, BenchError> {
        let text = std::fs::read(path).map_err(|source| BenchError::Read {
            path: path.into(),
            source,
        })?;
        let document: Document =
            serde_json::from_slice(&text).map_err(|source| BenchError::Baseline {
                path: path.into(),
                source,
            })?;
        let rows = document.rows.into_iter();
        Ok(Self(rows.map(|row| (row.key, row.ratios)).collect()))
    }

    /// Compares the rows that both results have.
    pub(crate) fn compare(&self, rows: &[Row]) -> Changes {
        let mut changes = Changes::default();
        for row in rows {
            let key = Key::Path {
                path: row.path.clone(),
                wait: row.wait,
                size: row.size,
                fill: row.fill,
            };
            let Some(before) = self.0.get(&key) else {
                continue;
            };
            let name = format!(
                "{}, {}, {} {}",
                row.path,
                report::wait(row.wait),
                report::size(row.size),
                name_of(row.fill)
            );
            changes.add(
                format!("{name}, one way"),
                before.ratio.zip(before.ratio_spread),
                row.ratio.zip(row.ratio_spread),
            );
            changes.add(
                format!("{name}, round trip"),
                before.round_trip_ratio.zip(before.round_trip_ratio_spread),
                row.round_trip_ratio.zip(row.round_trip_ratio_spread),
            );
        }
        changes
    }

    /// Compares the groups that both results have.
    pub(crate) fn compare_locks(&self, rows: &[locks::Row]) -> Changes {
        let mut changes = Changes::default();
        for row in rows {
            let key = Key::Locks {
                algorithm: row.algorithm.to_owned(),
                agents: row.agents,
                hosts: row.hosts,
            };
            if let Some(before) = self.0.get(&key) {
                changes.add(
                    row.name(),
                    before.ratio.zip(before.ratio_spread),
                    Some((row.ratio, row.ratio_spread)),
                );
            }
        }
        changes
    }
}

impl Changes {
    /// Whether a ratio to a limit has risen.
    #[must_use]
    pub fn is_slower(&self) -> bool {
        self.changes.iter().any(Change::is_slower)
    }

    /// Number of ratios that were compared: those that both results have.
    #[must_use]
    pub fn compared(&self) -> usize {
        self.compared
    }

    /// The changes as a JSON array of objects with `what`, `before` and `after`.
    pub fn to_json(&self) -> Value {
        json!(self.changes)
    }

    fn add(
        &mut self,
        what: String,
        before: Option<(f64, [f64; 2])>,
        after: Option<(f64, [f64; 2])>,
    ) {
        let (Some((before, [low, high])), Some((after, [new_low, new_high]))) = (before, after)
        else {
            return;
        };
        self.compared += 1;
        let overlap = new_low <= high && low <= new_high;
        if !overlap && (after - before).abs() > NEGLIGIBLE * before {
            self.changes.push(Change {
                what,
                before,
                after,
            });
        }
    }
}

impl Change {
    fn is_slower(&self) -> bool {
        self.after > self.before
    }
}

impl fmt::Display for Changes {
    /// One line per change, and a summary.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for change in &self.changes {
            let Change {
                what,
                before,
                after,
            } = change;
            let direction = if change.is_slower() {
                "slower"
            } else {
                "faster"
            };
            writeln!(
                f,
                "{direction}: {what}: {before:.2} before, {after:.2} now ({:+.0} %)",
                (after / before - 1.0) * 100.0
            )?;
        }
        writeln!(
            f,
            "{} of {} ratios to the limits changed beyond their spread",
            self.changes.len(),
            self.compared
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn changed(before: (f64, [f64; 2]), after: (f64, [f64; 2])) -> Vec<Change> {
        let mut changes = Changes::default();
        changes.add("ratio".to_owned(), Some(before), Some(after));
        assert_eq!(changes.compared, 1);
        changes.changes
    }

    #[test]
    fn a_change_is_beyond_both_spreads_and_not_negligible() {
        let before = (2.0, [1.9, 2.1]);
        assert!(changed(before, (2.2, [2.05, 2.4])).is_empty(), "overlap");
        assert!(changed((2.0, [2.0, 2.0]), (2.06, [2.05, 2.07])).is_empty());
        assert!(changed(before, (2.4, [2.2, 2.5]))[0].is_slower());
        assert!(!changed(before, (1.5, [1.4, 1.6]))[0].is_slower());
    }

    #[test]
    fn a_ratio_that_one_result_lacks_is_not_compared() {
        let mut changes = Changes::default();
        changes.add("ratio".to_owned(), None, Some((2.0, [1.0, 3.0])));
        assert_eq!(changes.compared(), 0);
    }
}
