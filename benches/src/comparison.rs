//! A comparison of paths: their selection, the course of the measurement, and its result.

use std::path::PathBuf;

use fipa::Kind;
use serde_json::Value;

use crate::baseline::{Baseline, Changes};
use crate::error::BenchError;
use crate::machine::Machine;
use crate::measure::{self, Effort, Measured};
use crate::part::{Socket, Wait};
use crate::path::{BenchPath, Mechanism};
use crate::stage::Stage;
use crate::{many, plot, report};

/// The paths that a comparison measures.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Selection {
    /// All of them.
    All,
    /// Two agents on one host, through shared memory.
    Shm,
    /// Through sockets: two agents directly, and through a gateway on either side.
    Net,
}

/// The program that is started as the processes of a measurement.
#[derive(Debug, Clone)]
pub struct Program {
    /// The file to execute.
    pub path: PathBuf,
    /// Arguments in front of `--part PART [--core NUMBER] [--set KEY=VALUE]...`. The program passes
    /// PART and NUMBER to [`play`](crate::play), with the configuration that the settings make.
    pub arguments: Vec<String>,
}

/// A comparison of the configured transports with the bare mechanisms.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct Comparison {
    /// The paths to measure.
    pub selection: Selection,
    /// The transports in use, in the order of `mts.transports`.
    pub transports: Vec<Kind>,
    /// The extent of the measurement.
    pub effort: Effort,
    /// The program to start.
    pub program: Program,
    /// A program with ends that go through zenoh, to be measured in the same rounds.
    pub zenoh: Option<PathBuf>,
}

/// The result of a [`Comparison`].
#[derive(Debug)]
pub struct Measurement {
    machine: Machine,
    effort: Effort,
    measured: Measured,
}

impl Comparison {
    /// A comparison of all paths.
    pub fn new(transports: Vec<Kind>, effort: Effort, program: Program) -> Self {
        Self {
            selection: Selection::All,
            transports,
            effort,
            program,
            zenoh: None,
        }
    }

    /// Number of steps that [`run`](Self::run) reports.
    pub fn steps(&self) -> usize {
        let paths = self.paths();
        paths.len() + self.effort.sizes.len() * 3 + usize::from(has_many(&paths)) + 1
    }

    /// Measures. `progress` is called with the name of each step as it begins. When the future is
    /// dropped, all processes end and all their files are removed.
    ///
    /// # Errors
    ///
    /// If the processes cannot be prepared, or no path can be measured. A single path that fails is
    /// one of the [`notes`](Measurement::notes).
    pub async fn run(
        self,
        machine: Machine,
        progress: impl Fn(&str),
    ) -> Result<Measurement, BenchError> {
        let selected = self.paths();
        let many = has_many(&selected);
        let mut stage = Stage::new(self.program, self.zenoh).map_err(BenchError::Prepare)?;
        let mut paths = Vec::new();
        let mut notes = Vec::new();
        for (mechanism, wait) in selected {
            progress(&format!("starting {}", mechanism.name()));
            match BenchPath::open(&mut stage, mechanism, wait).await {
                Ok(path) => paths.push(path),
                Err(why) => notes.push(format!("{}: cannot be measured: {why}", mechanism.name())),
            }
        }
        let mut measured = measure::all(&mut stage, &mut paths, &self.effort, &progress).await;
        if many {
            progress("content for many");
            match many::measure(&mut stage, &self.effort).await {
                Ok(many) => measured.many = Some(many),
                Err(why) => notes.push(format!("content for many: cannot be measured: {why}")),
            }
        }
        progress("ending");
        drop(stage);
        notes.append(&mut measured.notes);
        measured.notes = notes;
        if measured.rows.is_empty() {
            return Err(BenchError::NothingMeasured(measured.notes));
        }
        Ok(Measurement {
            machine,
            effort: self.effort,
            measured,
        })
    }

    /// The paths to measure, each followed by its limit.
    fn paths(&self) -> Vec<(Mechanism, Wait)> {
        let mut paths = Vec::new();
        let mut add = |mechanism: Mechanism, wait: Wait| {
            let all = [Some(mechanism), mechanism.plain(), mechanism.limit()];
            for mechanism in all.into_iter().flatten() {
                if !paths.contains(&(mechanism, wait)) {
                    paths.push((mechanism, wait));
                }
            }
        };
        let shm = self.selection != Selection::Net;
        let net = self.selection != Selection::Shm;
        if shm && self.transports.contains(&Kind::Shm) {
            add(Mechanism::Agents(Kind::Shm), Wait::Spin);
            add(Mechanism::Letters, Wait::Spin);
            add(Mechanism::Agents(Kind::Shm), Wait::Block);
        }
        if net {
            for kind in &self.transports {
                match kind {
                    Kind::Unix => add(Mechanism::Agents(Kind::Unix), Wait::Block),
                    Kind::Tcp | Kind::Udp => add(Mechanism::Gateways(*kind), Wait::Block),
                    _ => {}
                }
            }
            // Measured with any configuration, because the measurement makes keys of its own.
            add(Mechanism::Secured(Kind::Tcp), Wait::Block);
            add(Mechanism::Secured(Kind::Quic), Wait::Block);
        }
        add(Mechanism::Socket(Socket::Unix), Wait::Block);
        add(Mechanism::Socket(Socket::Tcp), Wait::Block);
        if self.zenoh.is_some() {
            for (selected, shared_memory) in [(shm, true), (net, false)] {
                if selected {
                    paths.push((Mechanism::Zenoh { shared_memory }, Wait::Block));
                }
            }
        }
        paths
    }
}

fn has_many(paths: &[(Mechanism, Wait)]) -> bool {
    paths.contains(&(Mechanism::Agents(Kind::Shm), Wait::Spin))
}

impl Measurement {
    /// Paths and sizes that could not be measured, each with its reason.
    pub fn notes(&self) -> &[String] {
        &self.measured.notes
    }

    /// The result as one JSON object: `machine`, `method`, `rows`, `multicast` and `notes`. Names of
    /// members end with their unit.
    pub fn to_json(&self) -> Value {
        report::json(&self.machine, &self.effort, &self.measured)
    }

    /// Compares the result with an earlier one.
    pub fn compare(&self, baseline: &Baseline) -> Changes {
        baseline.compare(&self.measured.rows)
    }

    /// The result as a table with a legend.
    pub fn to_text(&self) -> String {
        report::text(&self.machine, &self.effort, &self.measured)
    }

    /// Latency over the size of the content, as an SVG document.
    pub fn to_svg(&self) -> String {
        let machine = &self.machine;
        let subtitle = format!(
            "{}, {} cores, {}; others used {:.0} % of it",
            machine.processor,
            machine.cores,
            machine.system,
            machine.busy * 100.0
        );
        plot::svg(&self.measured.rows, &subtitle)
    }
}
