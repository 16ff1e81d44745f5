//! Locks between agents, beside the same letters sent by hand between the same processes.
//!
//! A group of processes shares a resource. The process with index 0 acquires and releases it, that with
//! index 1 owns it. Each process has an agent that uses locks, and one whose application sends the same
//! letters itself. Both take turns, so other load of the machine affects them alike.

mod group;
mod resources;

use std::time::Duration;

use fipa_drawing::{Bar, Bars};
use serde::Serialize;
use serde_json::{Value, json};

use self::group::{Group, Shape};
use self::resources::Resources;
use crate::baseline::{Baseline, Changes};
use crate::comparison::Program;
use crate::error::BenchError;
use crate::machine::Machine;
use crate::part::Variant;
use crate::plot;
use crate::report::empty_table;

/// Largest ratio of a lock to the letters sent by hand that the project aims for.
const TARGET: f64 = 1.2;

/// Number of agents with which the hand-over is measured.
const HAND_OVER_AGENTS: usize = 8;

/// Measures locks, beside the same letters sent by hand.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct Locks {
    /// Numbers of agents that share a resource, each 2 to [`MAX_AGENTS`](Self::MAX_AGENTS).
    pub agents: Vec<usize>,
    /// Number of resources of the largest group, for memory and idle load.
    pub resources: usize,
    /// Turns of each kind of letters.
    rounds: usize,
    /// Duration of a turn.
    turn: Duration,
    /// Hand-overs in a turn, each way.
    hand_overs: usize,
    /// Time in which idle load is observed.
    idle: Duration,
    program: Program,
}

/// The result of [`Locks::run`].
#[derive(Debug)]
pub struct LocksReport {
    machine: Machine,
    rounds: usize,
    rows: Vec<Row>,
    hand_overs: Vec<HandOver>,
    resources: Option<Resources>,
    notes: Vec<String>,
}

/// Acquiring and releasing a resource without contention.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Row {
    /// The algorithm, as in the protocol of its messages.
    pub(crate) algorithm: &'static str,
    /// Number of agents that share the resource.
    pub(crate) agents: usize,
    pub(crate) hosts: usize,
    /// Number of letters that the algorithm needs.
    letters_needed: usize,
    /// Letters per acquisition and release, counted by a watcher.
    letters: f64,
    letters_by_hand: f64,
    /// Median times in microseconds.
    locks_us: f64,
    by_hand_us: f64,
    /// The median over all rounds of the ratio of medians.
    pub(crate) ratio: f64,
    /// Middle half of these ratios.
    pub(crate) ratio_spread: [f64; 2],
    /// Processor time of all processes for one acquisition and release, in microseconds.
    cpu_us: f64,
    by_hand_cpu_us: f64,
    /// The median over all rounds.
    cpu_ratio: f64,
}

/// The hand-over from a holder to the next waiter.
#[derive(Debug, Clone, Serialize)]
struct HandOver {
    algorithm: &'static str,
    agents: usize,
    hosts: usize,
    /// Letters between the release and the use by the next agent that wait for each other.
    letters_in_sequence: usize,
    /// Median times in microseconds, from the call that releases until the next agent has the lock.
    locks_us: f64,
    by_hand_us: f64,
    /// One letter from the holder to the waiter.
    letter_us: f64,
    /// Ratio to the same letters by hand: the median over all rounds.
    ratio: f64,
    ratio_spread: [f64; 2],
    /// Ratio to one letter: the median over all rounds.
    letter_ratio: f64,
    letter_ratio_spread: [f64; 2],
}

impl Locks {
    /// Largest number of agents that can be measured.
    pub const MAX_AGENTS: usize = 64;

    /// A thorough measurement of five to ten minutes.
    #[must_use]
    pub fn full(program: Program) -> Self {
        Self {
            agents: vec![2, 8, 32],
            resources: 1000,
            rounds: 15,
            turn: Duration::from_millis(50),
            hand_overs: 8,
            idle: Duration::from_secs(15),
            program,
        }
    }

    /// A measurement of about a minute, with fewer agents and resources, whose figures scatter more.
    #[must_use]
    pub fn quick(program: Program) -> Self {
        Self {
            agents: vec![2, 8],
            resources: 64,
            rounds: 3,
            turn: Duration::from_millis(10),
            hand_overs: 3,
            idle: Duration::from_secs(2),
            program,
        }
    }

    /// Number of steps that [`run`](Self::run) reports.
    #[must_use]
    pub fn steps(&self) -> usize {
        self.shapes().len() + 2
    }

    fn shapes(&self) -> Vec<Shape> {
        let mut shapes = Vec::new();
        for hosts in [1, 2] {
            for variant in Variant::ALL {
                let agents = self.agents.iter();
                shapes.extend(agents.map(|&agents| Shape {
                    variant,
                    agents,
                    hosts,
                }));
            }
        }
        shapes
    }

    /// Measures. `progress` is called with the name of each step as it begins. When the future is
    /// dropped, all processes end and all their files are removed.
    ///
    /// # Errors
    ///
    /// If a number of agents cannot be measured, the processes cannot be prepared, or no group can be
    /// measured. A single group that fails is one of the [`notes`](LocksReport::notes).
    pub async fn run(
        mut self,
        machine: Machine,
        progress: impl Fn(&str),
    ) -> Result<LocksReport, BenchError> {
        self.agents.sort_unstable();
        self.agents.dedup();
        let wrong = |agents: &&usize| !(2..=Self::MAX_AGENTS).contains(*agents);
        if let Some(&agents) = self.agents.iter().find(wrong) {
            return Err(BenchError::Agents(agents));
        }
        let mut report = LocksReport {
            machine,
            rounds: self.rounds,
            rows: Vec::new(),
            hand_overs: Vec::new(),
            resources: None,
            notes: Vec::new(),
        };
        for shape in self.shapes() {
            progress(&shape.to_string());
            if let Err(why) = self.measure(shape, &mut report).await {
                report.notes.push(format!("{shape}: {why}"));
            }
        }
        if let Some(&agents) = self.agents.last() {
            progress(&format!("{} resources", self.resources));
            let measured = resources::measure(&self.program, agents, self.resources, self.idle);
            match measured.await {
                Ok(resources) => report.resources = Some(resources),
                Err(why) => report
                    .notes
                    .push(format!("{} resources: {why}", self.resources)),
            }
        }
        progress("ending");
        if report.rows.is_empty() {
            return Err(BenchError::NothingMeasured(report.notes));
        }
        Ok(report)
    }

    async fn measure(&self, shape: Shape, report: &mut LocksReport) -> Result<(), String> {
        let mut group = Group::open(&self.program, shape).await?;
        report
            .rows
            .push(group.cycles(self.rounds, self.turn).await?);
        if shape.agents == HAND_OVER_AGENTS && shape.variant != Variant::TokenHere {
            report
                .hand_overs
                .push(group.hand_overs(self.rounds, self.hand_overs).await?);
        }
        Ok(())
    }
}

impl Row {
    pub(crate) fn name(&self) -> String {
        name(self.algorithm, self.agents, self.hosts)
    }

    fn is_missed(&self) -> bool {
        self.ratio > TARGET
    }
}

/// The name of a group.
fn name(algorithm: &str, agents: usize, hosts: usize) -> String {
    let hosts = match hosts {
        1 => "one host",
        _ => "two hosts",
    };
    format!("{algorithm}, {agents} agents, {hosts}")
}

impl LocksReport {
    /// Groups that could not be measured, each with its reason.
    #[must_use]
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// The result as one JSON object: `machine`, `method`, `rows`, `hand_overs`, `resources` and `notes`.
    /// Names of members end with their unit.
    #[must_use]
    pub fn to_json(&self) -> Value {
        json!({
            "machine": self.machine,
            "method": { "rounds": self.rounds, "target_ratio": TARGET },
            "rows": self.rows,
            "hand_overs": self.hand_overs,
            "resources": self.resources,
            "notes": self.notes,
        })
    }

    /// Compares the result with an earlier one.
    #[must_use]
    pub fn compare(&self, baseline: &Baseline) -> Changes {
        baseline.compare_locks(&self.rows)
    }

    /// The result as tables with a legend.
    #[must_use]
    pub fn to_text(&self) -> String {
        let mut text = self.machine.heading();
        text.push_str(&format!(
            "{} rounds; times in microseconds\n\nAcquire and release, without contention:\n",
            self.rounds,
        ));
        text.push_str(&self.table());
        text.push_str(LEGEND);
        for hand_over in &self.hand_overs {
            text.push_str(&hand_over.to_text());
        }
        if let Some(resources) = &self.resources {
            text.push_str(&resources.to_text());
        }
        for note in &self.notes {
            text.push_str(&format!("note: {note}\n"));
        }
        text
    }

    fn table(&self) -> String {
        let header = [
            "group", "needed", "letters", "by hand", "locks", "x hand", "(spread)", "cpu",
            "x hand", "target",
        ];
        let mut table = empty_table(header, 1);
        for row in &self.rows {
            let [low, high] = row.ratio_spread;
            table.add_row([
                row.name(),
                row.letters_needed.to_string(),
                format!("{:.1}", row.letters),
                format!("{:.0}", row.by_hand_us),
                format!("{:.0}", row.locks_us),
                format!("{:.2}", row.ratio),
                format!("{low:.2}-{high:.2}"),
                format!("{:.0}", row.cpu_us),
                format!("{:.2}", row.cpu_ratio),
                (if row.is_missed() { "missed" } else { "" }).to_owned(),
            ]);
        }
        table.to_string()
    }

    /// Times of acquiring and releasing beside the letters by hand, as an SVG document.
    pub fn to_svg(&self) -> String {
        let groups = self.rows.iter().map(|row| fipa_drawing::Group {
            name: row.name(),
            bars: vec![Bar {
                series: 0,
                value: row.locks_us,
                deviation: 0.0,
                mark: Some(row.by_hand_us),
            }],
        });
        let bars = Bars {
            title: "Acquire and release a resource without contention (median)".to_owned(),
            series: vec!["lock".to_owned()],
            mark: "the same letters by hand".to_owned(),
            groups: groups.collect(),
            unit: plot::duration,
            logarithmic: true,
        };
        bars.svg()
    }
}

const LEGEND: &str = "
needed      letters that the algorithm needs: 3 for the owner's queue, 2(N-1)+3 for Ricart-Agrawala,
            N+3 for the extended Suzuki-Kasami, whose token is at the owner, 3 for the basic one, whose
            token is here
letters     letters of locks, counted by a watcher
by hand     the same letters, sent by the application between the same processes
x hand      ratio to the letters by hand in the same rounds (spread: the middle half of the rounds)
cpu         CPU time of all processes
target      ratio of at most 1.2
";

impl HandOver {
    fn to_text(&self) -> String {
        let [low, high] = self.ratio_spread;
        let [letter_low, letter_high] = self.letter_ratio_spread;
        format!(
            "\nfrom the holder to the next waiter, {}: {:.0} until the waiter has the lock; {:.0} for the \
             {} letters in sequence by hand: ratio {:.2} ({low:.2}-{high:.2}); {:.0} for one letter: ratio \
             {:.2} ({letter_low:.2}-{letter_high:.2})\n",
            name(self.algorithm, self.agents, self.hosts),
            self.locks_us,
            self.by_hand_us,
            self.letters_in_sequence,
            self.ratio,
            self.letter_us,
            self.letter_ratio,
        )
    }
}
