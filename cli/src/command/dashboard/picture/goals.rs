//! The goals that agents run, and those that a client of the page cancels.

use std::collections::VecDeque;

use serde_json::{Value, json};

use super::{clipped, moment};
use crate::command::dashboard::goals::{Cancelled, RunningGoal};
use crate::command::dashboard::view::View;

/// Maximum number of goals that run.
const MAX_GOALS: usize = 200;

/// Maximum number of cancelled goals.
const MAX_CANCELLED: usize = 20;

/// Goals as rows.
#[derive(Debug, Default)]
pub(in crate::command::dashboard) struct Goals {
    running: Vec<(String, Value)>,
    /// The newest last, each with its number.
    cancelled: VecDeque<(u64, Value)>,
}

impl Goals {
    /// Takes the goals that run. Further ones than 200 are left out.
    pub(in crate::command::dashboard) fn take(&mut self, running: &[RunningGoal]) {
        self.running = running.iter().take(MAX_GOALS).map(row).collect();
    }

    /// Takes a goal that a client of the page cancels, or its outcome.
    pub(in crate::command::dashboard) fn put_cancelled(&mut self, cancelled: &Cancelled) {
        let row = cancelled_object(cancelled);
        let mut known = self.cancelled.iter_mut();
        if let Some((_, known)) = known.find(|(number, _)| *number == cancelled.number) {
            *known = row;
            return;
        }
        if self.cancelled.len() >= MAX_CANCELLED {
            self.cancelled.pop_front();
        }
        self.cancelled.push_back((cancelled.number, row));
    }

    /// Adds the rows.
    pub(super) fn put(&self, view: &mut View) {
        for section in ["goals", "cancelled"] {
            view.section(section);
        }
        for (key, row) in &self.running {
            view.put("goals", key.as_str(), row);
        }
        for (number, row) in &self.cancelled {
            view.put("cancelled", number.to_string(), row);
        }
    }
}

/// The row of a goal that runs, and its key. Two clients of a robot may use one identifier.
fn row(goal: &RunningGoal) -> (String, Value) {
    let RunningGoal {
        robot,
        status,
        since,
        is_answered,
        may_cancel,
    } = goal;
    let progress = status.progress.as_ref();
    let key = json!([robot, status.client, status.goal]).to_string();
    // An order to cancel needs the whole names.
    let row = json!({
        "robot": robot, "goal": status.goal, "action": clipped(&status.action), "client": status.client,
        "state": status.state.as_str(), "since": moment(*since),
        "fraction": progress.and_then(|it| it.fraction), "note": progress.and_then(|it| it.note.as_deref()).map(clipped),
        "answered": is_answered, "may_cancel": may_cancel,
    });
    (key, row)
}

/// The object of a goal that a client of the page cancels.
pub(in crate::command::dashboard) fn cancelled_object(cancelled: &Cancelled) -> Value {
    let Cancelled {
        number: _,
        at,
        by,
        robot,
        goal,
        client,
        outcome,
    } = cancelled;
    let (status, reason) = match outcome {
        Some(Ok(status)) => {
            let failure = status.failure.as_ref();
            (Some(status), failure.map(ToString::to_string))
        }
        Some(Err(reason)) => (None, Some(reason.clone())),
        None => (None, None),
    };
    json!({
        "time": moment(*at), "by": by, "robot": clipped(robot), "goal": clipped(goal), "client": clipped(client),
        "action": status.map(|status| clipped(&status.action)),
        "state": status.map_or("asked", |status| status.state.as_str()),
        "reason": reason.as_deref().map(clipped),
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a failed precondition fails the test")]

    use std::time::UNIX_EPOCH;

    use super::*;

    fn cancelled(number: u64) -> Cancelled {
        Cancelled {
            number,
            at: UNIX_EPOCH,
            by: "dashboard@base".to_owned(),
            robot: "crex".to_owned(),
            goal: format!("g-{number}"),
            client: "rover".to_owned(),
            outcome: None,
        }
    }

    #[test]
    fn the_last_cancels_are_listed_from_their_begin_and_once() {
        let mut goals = Goals::default();
        for number in 0..=20 {
            goals.put_cancelled(&cancelled(number));
        }
        let newest = |goals: &Goals| goals.cancelled.back().unwrap().1.clone();
        assert_eq!(goals.cancelled.len(), MAX_CANCELLED);
        assert_eq!(newest(&goals)["state"], "asked");
        assert_eq!(newest(&goals)["reason"], Value::Null);
        goals.put_cancelled(&Cancelled {
            outcome: Some(Err("no answer".to_owned())),
            ..cancelled(20)
        });
        assert_eq!(goals.cancelled.len(), MAX_CANCELLED);
        assert_eq!(newest(&goals)["goal"], "g-20");
        assert_eq!(newest(&goals)["reason"], "no answer");
    }
}
