//! The rates of the last minutes, for a chart.

use std::collections::VecDeque;
use std::time::{SystemTime, UNIX_EPOCH};

use serde_json::{Value, json};

use crate::command::top::{Snapshot, totals_object};

/// Number of points, one a second.
const MAX_POINTS: usize = 600;

/// The points by their time, in seconds since 1970.
#[derive(Debug, Default)]
pub(super) struct History {
    points: VecDeque<(u64, Value)>,
}

impl History {
    /// Adds a point, unless its second has one. A clock that is set back begins anew.
    pub(super) fn add(&mut self, now: SystemTime, counted: &Snapshot) {
        let second = now
            .duration_since(UNIX_EPOCH)
            .map_or(0, |since| since.as_secs());
        match self.points.back() {
            Some((last, _)) if *last == second => return,
            Some((last, _)) if *last > second => self.points.clear(),
            _ => {}
        }
        if self.points.len() >= MAX_POINTS {
            self.points.pop_front();
        }
        let totals = totals_object(counted);
        let value = |key: &str| totals.get(key).cloned().unwrap_or_default();
        let point = json!({
            "letters_per_second": value("letters_per_second"), "failures_per_second": value("failures_per_second"),
            "median_us": value("median_us"),
        });
        self.points.push_back((second, point));
    }

    pub(super) fn points(&self) -> impl Iterator<Item = (u64, &Value)> {
        self.points.iter().map(|(second, point)| (*second, point))
    }
}
