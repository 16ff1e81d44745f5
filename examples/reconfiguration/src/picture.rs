//! The picture of a run: the plane, the coalition, the docking conversation and the locks.

use std::collections::{BTreeMap, BTreeSet};

use fipa_drawing::{
    Arrow, Body, Color, Interval, Mark, Note, Page, Plane, Section, Sequence, Shape, Step,
    Timeline, TimelineRow,
};

use crate::report::{Claim, Report};

/// The bodies, in the order of their colors.
const BODIES: [&str; 4] = ["sherpa", "crex", "payload_1", "payload_2"];

/// The label of a body that belongs to no coalition.
const ALONE: &str = "alone";

/// Draws a run.
#[must_use]
pub fn page(reports: &[Report]) -> Page {
    let run = Run::of(reports);
    let (fault, seed) = run.started();
    let fault = if fault == "none" {
        "No fault".to_owned()
    } else {
        format!("Fault: {fault}")
    };
    Page {
        title: "A stack of two items on crex".to_owned(),
        text: format!(
            "sherpa, the master of each docking, drives crex to two payload items, which latch on to crex one after the \
             other; the three become the robot crex_stack. {fault}, seed {seed}"
        ),
        sections: vec![
            Section {
                text: "Poses in meters, as the simulated world has them. A line is the way of a body; one without a line stands still.".to_owned(),
                ..Section::new("The plane", run.plane())
            },
            Section {
                text: "Seconds since an operator searched for robots. A bar is the robot that a body belongs to.".to_owned(),
                ..Section::new("Who belongs to what", run.members())
            },
            Section {
                text: "The same seconds. A bar is a grant: its holder, and the number that rises with each grant (its fence).".to_owned(),
                ..Section::new("Locks", run.locks())
            },
            Section {
                text: "The letters of one conversation of the protocol dock, not to scale: the first docking that failed, or the first.".to_owned(),
                ..Section::new("One docking", run.docking())
            },
        ],
    }
}

struct Run<'a> {
    reports: &'a [Report],
    start: u64,
    end: f64,
}

impl<'a> Run<'a> {
    fn of(reports: &'a [Report]) -> Self {
        // The waits for the processes are not drawn.
        let begins = reports
            .iter()
            .find(|it| matches!(it.claim, Claim::Found { .. }));
        let start = begins.or(reports.first()).map_or(0, |report| report.at);
        let ends = reports
            .iter()
            .rev()
            .find(|it| matches!(it.claim, Claim::Finished { .. }));
        let end = ends.or(reports.last()).map_or(start, |report| report.at);
        let mut run = Self {
            reports,
            start,
            end: 0.0,
        };
        run.end = run.seconds(end);
        run
    }

    fn seconds(&self, at: u64) -> f64 {
        at.saturating_sub(self.start) as f64 / 1e6
    }

    fn started(&self) -> (&str, u64) {
        let found = self.reports.iter().find_map(|it| match &it.claim {
            Claim::Started { fault, seed } => Some((fault.as_str(), *seed)),
            _ => None,
        });
        found.unwrap_or(("none", 0))
    }

    fn plane(&self) -> Plane {
        let bodies = BODIES.iter().enumerate().map(|(index, name)| {
            let poses = self.reports.iter().filter_map(|it| match &it.claim {
                Claim::Poses { poses } => poses.get(*name),
                _ => None,
            });
            let item = name.starts_with("payload");
            Body {
                name: (*name).to_owned(),
                shape: Shape::Rectangle {
                    length: if item { 0.2 } else { 0.6 },
                    width: if item { 0.15 } else { 0.4 },
                },
                color: Color::nth(index),
                poses: poses
                    .map(|pose| fipa_drawing::Pose {
                        x: pose.x,
                        y: pose.y,
                        heading: pose.yaw,
                    })
                    .collect(),
            }
        });
        Plane {
            bodies: bodies.collect(),
        }
    }

    fn members(&self) -> Timeline {
        let interval = |index: usize, label: &str, from: f64| Interval {
            label: label.to_owned(),
            from,
            until: None,
            color: Color::nth(index),
        };
        let alone =
            |(index, name): (usize, &&'static str)| (*name, vec![interval(index, ALONE, 0.0)]);
        let mut rows: BTreeMap<&str, Vec<Interval>> =
            BODIES.iter().enumerate().map(alone).collect();
        for report in self.reports {
            let Claim::Coalition {
                name,
                members,
                leader,
            } = &report.claim
            else {
                continue;
            };
            let at = self.seconds(report.at);
            for (index, body) in BODIES.iter().enumerate() {
                let Some(row) = rows.get_mut(body) else {
                    continue;
                };
                let label = match (
                    members.iter().any(|member| member == body),
                    leader.as_deref() == Some(body),
                ) {
                    (false, _) => ALONE.to_owned(),
                    (true, false) => name.clone(),
                    (true, true) => format!("{name}, leader"),
                };
                if let Some(open) = row.last_mut().filter(|open| open.label != label) {
                    open.until = Some(at);
                    row.push(interval(index, &label, at));
                }
            }
        }
        let rows = BODIES.iter().map(|name| TimelineRow {
            name: (*name).to_owned(),
            intervals: rows.remove(name).unwrap_or_default(),
        });
        Timeline {
            rows: rows.collect(),
            marks: self.marks(),
            until: Some(self.end),
        }
    }

    fn locks(&self) -> Timeline {
        let mut rows: BTreeMap<&str, Vec<(&str, Interval)>> = BTreeMap::new();
        for report in self.reports {
            let at = self.seconds(report.at);
            match &report.claim {
                Claim::Granted {
                    resource,
                    holder,
                    fence,
                } => {
                    let number = fence.split('.').nth(1).unwrap_or_default();
                    let color = BODIES
                        .iter()
                        .position(|body| body == holder)
                        .unwrap_or(BODIES.len());
                    let interval = Interval {
                        label: format!("{holder} #{number}"),
                        from: at,
                        until: None,
                        color: Color::nth(color),
                    };
                    rows.entry(resource).or_default().push((fence, interval));
                }
                Claim::Ended {
                    resource, fence, ..
                } => {
                    let row = rows.entry(resource).or_default();
                    if let Some((_, interval)) = row.iter_mut().find(|(it, _)| it == fence) {
                        interval.until = Some(at);
                    }
                }
                _ => {}
            }
        }
        let rows = rows.into_iter().map(|(name, intervals)| TimelineRow {
            name: name.to_owned(),
            intervals: intervals
                .into_iter()
                .map(|(_, interval)| interval)
                .collect(),
        });
        Timeline {
            rows: rows.collect(),
            marks: self.marks(),
            until: Some(self.end),
        }
    }

    fn marks(&self) -> Vec<Mark> {
        let faults = self
            .reports
            .iter()
            .filter(|it| it.by == "launcher")
            .filter_map(|it| match &it.claim {
                Claim::Fault { what } => Some(Mark {
                    at: self.seconds(it.at),
                    label: what.clone(),
                }),
                _ => None,
            });
        faults.collect()
    }

    /// Returns the conversation to draw: the first one that has failed, or the first one.
    fn conversation(&self) -> &str {
        let failed = self.reports.iter().find_map(|it| match &it.claim {
            Claim::NotDocked { conversation, .. } => Some(conversation.as_str()),
            _ => None,
        });
        let first = || {
            self.reports.iter().find_map(|it| match &it.claim {
                Claim::Step { conversation, .. } => Some(conversation.as_str()),
                _ => None,
            })
        };
        failed.or_else(first).unwrap_or_default()
    }

    fn docking(&self) -> Sequence {
        let drawn = self.conversation();
        let time = |at: u64| format!("{:.1} s", self.seconds(at));
        let is_drawn = |report: &Report| {
            matches!(&report.claim, Claim::Letter { conversation, protocol, .. }
                if conversation == drawn && protocol == "dock")
        };
        let mut times = self
            .reports
            .iter()
            .filter(|it| is_drawn(it))
            .map(|it| it.at);
        let (from, to) = (
            times.next().unwrap_or_default(),
            times.next_back().unwrap_or_default(),
        );
        let agents: BTreeSet<&str> = BODIES.into_iter().collect();
        let steps = self
            .reports
            .iter()
            .filter(|it| (from..=to).contains(&it.at))
            .filter_map(|it| match &it.claim {
                Claim::Letter {
                    sender,
                    receiver,
                    performative,
                    ..
                } if is_drawn(it) => Some(Step::Arrow(Arrow {
                    from: sender.clone(),
                    to: receiver.clone(),
                    label: performative.clone(),
                    time: time(it.at),
                    violation: (!agents.contains(sender.as_str()))
                        .then(|| "takes no part".to_owned()),
                    ..Arrow::default()
                })),
                Claim::Fault { what } if it.by == "launcher" => {
                    let lane = what.split(' ').next().filter(|word| agents.contains(word));
                    Some(Step::Note(Note {
                        lane: lane.unwrap_or("sherpa").to_owned(),
                        text: what.clone(),
                        time: time(it.at),
                    }))
                }
                Claim::Refused { action, .. } => Some(Step::Note(Note {
                    lane: it.by.clone(),
                    text: format!("{} refuses to {action}: old fence", it.by),
                    time: time(it.at),
                })),
                _ => None,
            });
        Sequence {
            lanes: vec!["sherpa".to_owned(), "crex".to_owned()],
            steps: steps.collect(),
        }
    }
}
