//! The rates of the last minutes, for a chart.

use std::collections::VecDeque;
use std::time::{SystemTime, UNIX_EPOCH};

use serde::Serialize;

use crate::command::top::{Snapshot, TotalsObject};

/// Number of points, one a second.
const MAX_POINTS: usize = 600;

/// The points by their time, in seconds since 1970.
#[derive(Debug, Default)]
pub(super) struct History {
    points: VecDeque<(u64, Point)>,
}

#[derive(Debug, Serialize)]
pub(super) struct Point {
    letters_per_second: f64,
    failures_per_second: f64,
    median_us: Option<u64>,
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
        let totals = TotalsObject::of(counted);
        let point = Point {
            letters_per_second: totals.letters_per_second,
            failures_per_second: totals.failures_per_second,
            median_us: totals.median_us,
        };
        self.points.push_back((second, point));
    }

    pub(super) fn points(&self) -> impl Iterator<Item = (u64, &Point)> {
        self.points.iter().map(|(second, point)| (*second, point))
    }
}
