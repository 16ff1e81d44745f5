//! Messages that are answered, between programs in Rust and in Python, beside what Python has otherwise.
//!
//! Each mechanism has a process that sends and one that answers. `ends.py` has those in Python.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use tokio::process::Command;

use crate::comparison::Program;
use crate::error::BenchError;
use crate::machine::Machine;
use crate::measure::{Effort, LEAST, WARMING, count_for, median, spread, times};
use crate::part::{End, Event, Fill, Letters, Order, Part};
use crate::report::{self, empty_table};
use crate::stage::{ProcessIndex, Stage};

const ENDS: &str = include_str!("ends.py");

const BASELINE: &str = "rust to rust";
const PYTHON: &str = "python to python";

/// Mechanism, size and largest ratio to [`BASELINE`] that the project aims for.
const TARGETS: [(&str, usize, f64); 2] = [
    ("python to rust", 1 << 10, 3.0),
    ("python to rust", 1 << 20, 1.1),
];
/// Size from which [`PYTHON`] should take less time than each mechanism of others.
const AHEAD_FROM: usize = 1 << 20;

/// Two processes; a process in Python is a function of `ends.py`, and the others are in Rust.
#[derive(Debug, Clone, Copy)]
struct Mechanism {
    name: &'static str,
    sender: Option<&'static str>,
    receiver: Option<&'static str>,
    /// The module that Python imports.
    module: Option<&'static str>,
}

const fn ours(
    name: &'static str,
    sender: Option<&'static str>,
    receiver: Option<&'static str>,
) -> Mechanism {
    Mechanism {
        name,
        sender,
        receiver,
        module: Some("fipa"),
    }
}

const fn others(
    name: &'static str,
    function: &'static str,
    module: Option<&'static str>,
) -> Mechanism {
    Mechanism {
        name,
        sender: Some(function),
        receiver: Some(function),
        module,
    }
}

const MECHANISMS: [Mechanism; 10] = [
    ours(BASELINE, None, None),
    ours("python to rust", Some("python"), None),
    ours("python to rust, asyncio", Some("python_asyncio"), None),
    ours(PYTHON, Some("python"), Some("python")),
    ours(
        "python to python, asyncio",
        Some("python_asyncio"),
        Some("python_asyncio"),
    ),
    others("multiprocessing pipe", "pipe", None),
    others("multiprocessing shared memory", "shared_memory", None),
    others("zenoh", "zenoh", Some("zenoh")),
    others("iceoryx2", "iceoryx2", Some("iceoryx2")),
    others("rclpy", "rclpy", Some("rclpy")),
];

/// Measures messages that are answered, between Rust and Python.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct Languages {
    /// The interpreter of Python, which can import `fipa`: a path, or a name in `PATH`.
    pub python: PathBuf,
    effort: Effort,
    program: Program,
}

/// The result of [`Languages::run`].
#[derive(Debug)]
pub struct LanguagesReport {
    machine: Machine,
    rounds: usize,
    python: String,
    packages: BTreeMap<String, String>,
    rows: Vec<Row>,
    notes: Vec<String>,
}

/// The version of an interpreter of Python, and the packages that it can import.
#[derive(Debug, Deserialize)]
struct Versions {
    python: String,
    packages: BTreeMap<String, Package>,
}

#[derive(Debug, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Package {
    Version(String),
    Missing(String),
}

/// Messages of one size with one mechanism.
#[derive(Debug, Clone, Serialize)]
struct Row {
    mechanism: &'static str,
    size: usize,
    /// Median from before the content is copied until the sender has the answer.
    round_trip_us: f64,
    /// Ratio to [`BASELINE`]: the median over all rounds of the ratio of medians.
    ratio: f64,
    /// Middle half of these ratios.
    ratio_spread: [f64; 2],
    /// Ratio to [`PYTHON`], of a mechanism of others.
    python_ratio: Option<f64>,
    python_ratio_spread: Option<[f64; 2]>,
    /// Processor time of both processes for one message.
    cpu_us: f64,
    target: Option<&'static str>,
}

/// The processes of a mechanism, and its results for one size, one for each round.
struct Contestant {
    mechanism: Mechanism,
    sender: ProcessIndex,
    receiver: ProcessIndex,
    count: usize,
    /// Median times in nanoseconds.
    times: Vec<f64>,
    /// Processor time for one message in nanoseconds.
    cpu: Vec<f64>,
}

impl Languages {
    /// A measurement of this extent, with `python3`.
    #[must_use]
    pub fn new(program: Program, effort: Effort) -> Self {
        Self {
            python: "python3".into(),
            effort,
            program,
        }
    }

    /// Number of steps that [`run`](Self::run) reports.
    #[must_use]
    pub fn steps(&self) -> usize {
        MECHANISMS.len() + self.effort.sizes.len() + 1
    }

    /// Measures. `progress` is called with the name of each step as it begins. When the future is
    /// dropped, all processes end and all their files are removed.
    ///
    /// # Errors
    ///
    /// If this Python has no package `fipa`, or two processes in Rust cannot be measured. Another mechanism that
    /// fails is one of the [`notes`](LanguagesReport::notes).
    pub async fn run(
        self,
        machine: Machine,
        progress: impl Fn(&str),
    ) -> Result<LanguagesReport, BenchError> {
        let mut stage = Stage::new(self.program.clone(), None).map_err(BenchError::Prepare)?;
        let script = stage.write("ends.py", ENDS).map_err(BenchError::Prepare)?;
        let Versions { python, packages } = self.versions(&script).await?;
        let mut report = LanguagesReport {
            machine,
            rounds: self.effort.rounds,
            python,
            packages: BTreeMap::new(),
            rows: Vec::new(),
            notes: Vec::new(),
        };
        let mut contestants = Vec::new();
        for (index, mechanism) in MECHANISMS.into_iter().enumerate() {
            let name = mechanism.name;
            progress(&format!("starting {name}"));
            match mechanism.module.and_then(|module| packages.get(module)) {
                Some(Package::Missing(why)) if mechanism.module == Some("fipa") => {
                    return Err(self.no_package(why.clone()));
                }
                Some(Package::Missing(why)) => {
                    report.notes.push(format!("{name}: not measured: {why}"));
                    continue;
                }
                Some(Package::Version(version)) => {
                    let module = mechanism.module.unwrap_or_default().to_owned();
                    report.packages.insert(module, version.clone());
                }
                None => {}
            }
            match self.start(&mut stage, mechanism, index, &script).await {
                Ok(contestant) => contestants.push(contestant),
                Err(why) => report.notes.push(format!("{name}: not measured: {why}")),
            }
        }
        for &size in &self.effort.sizes {
            progress(&report::size(size));
            self.measure(&mut stage, &mut contestants, size, &mut report.notes)
                .await;
            report.rows.extend(rows(&contestants, size));
        }
        progress("ending");
        drop(stage);
        match report.rows.is_empty() {
            true => Err(BenchError::NothingMeasured(report.notes)),
            false => Ok(report),
        }
    }

    async fn versions(&self, script: &Path) -> Result<Versions, BenchError> {
        let output = Command::new(&self.python)
            .arg(script)
            .arg("versions")
            .kill_on_drop(true)
            .output()
            .await
            .map_err(|source| BenchError::Interpreter {
                path: self.python.clone(),
                source,
            })?;
        serde_json::from_slice(&output.stdout).map_err(|_| {
            let text = String::from_utf8_lossy(&output.stderr);
            let last = text.lines().last().unwrap_or("it printed nothing");
            self.no_package(last.to_owned())
        })
    }

    fn no_package(&self, why: String) -> BenchError {
        BenchError::Package {
            python: self.python.clone(),
            why,
        }
    }

    async fn start(
        &self,
        stage: &mut Stage,
        mechanism: Mechanism,
        index: usize,
        script: &Path,
    ) -> Result<Contestant, String> {
        let largest = self.effort.sizes.last().copied().unwrap_or(1).to_string();
        // A domain for each mechanism: an agent keeps only its partner in its directory.
        let domain = format!("l{index}");
        let python = |function: &str, end: &str| {
            let mut command = Command::new(&self.python);
            command
                .env("PYTHONDONTWRITEBYTECODE", "1")
                .arg(script)
                .args([function, end]);
            command
        };
        let rust = |end| {
            (
                Part::Correspondent { end },
                ["mts.transports=shm".to_owned()],
            )
        };
        let (receiver, address) = match mechanism.receiver {
            Some(function) => {
                let command = python(function, "receiver");
                stage.start_foreign(command, &domain, &[&largest]).await?
            }
            None => {
                let (part, settings) = rust(End::Receiver);
                stage.start(&part, &domain, &settings).await?
            }
        };
        let (sender, _) = match mechanism.sender {
            Some(function) => {
                let command = python(function, "sender");
                let arguments = [largest.as_str(), &address];
                stage.start_foreign(command, &domain, &arguments).await?
            }
            None => {
                let (part, settings) = rust(End::Sender);
                let started = stage.start(&part, &domain, &settings).await?;
                stage.tell(started.0, &Order::Find { to: address }).await?;
                stage.event(started.0).await?;
                started
            }
        };
        Ok(Contestant {
            mechanism,
            sender,
            receiver,
            count: LEAST,
            times: Vec::new(),
            cpu: Vec::new(),
        })
    }

    /// Measures one size. Mechanisms that fail are removed.
    async fn measure(
        &self,
        stage: &mut Stage,
        contestants: &mut Vec<Contestant>,
        size: usize,
        notes: &mut Vec<String>,
    ) {
        for contestant in contestants.iter_mut() {
            contestant.count = LEAST;
        }
        for round in 0..=self.effort.rounds {
            let mut failed = Vec::new();
            for contestant in contestants.iter_mut() {
                if let Err(why) = contestant.turn(stage, size).await {
                    let name = contestant.mechanism.name;
                    notes.push(format!("{name}: abandoned: {why}"));
                    failed.push(name);
                }
                // The first turn finds the number of messages that fill a turn.
                if round == 0 {
                    contestant.count = count_for(median(&contestant.times), self.effort.turn);
                    contestant.times.clear();
                    contestant.cpu.clear();
                }
            }
            contestants.retain(|it| !failed.contains(&it.mechanism.name));
        }
    }
}

impl Contestant {
    /// Sends the messages of one turn and adds the results.
    async fn turn(&mut self, stage: &mut Stage, size: usize) -> Result<(), String> {
        let letters = Letters {
            count: self.count + WARMING,
            size,
            fill: Fill::Copied,
            window: 1,
            pause_us: 0,
        };
        stage.tell(self.receiver, &Order::Receive(letters)).await?;
        stage.event(self.receiver).await?;
        stage.tell(self.sender, &Order::Send(letters)).await?;
        match (
            stage.event(self.sender).await?,
            stage.event(self.receiver).await?,
        ) {
            (
                Event::Sent {
                    began,
                    ended,
                    cpu_ns,
                },
                Event::Received { cpu_ns: more, .. },
            ) => {
                self.times.push(median(&times(&began, &ended)));
                self.cpu.push((cpu_ns + more) as f64 / letters.count as f64);
                Ok(())
            }
            other => Err(format!("expected times, received {other:?}")),
        }
    }

    /// Ratios to another mechanism, one for each round.
    fn ratios(&self, other: &Self) -> Vec<f64> {
        let pairs = self.times.iter().zip(&other.times);
        pairs.map(|(own, other)| own / other).collect()
    }
}

/// The rows of a size; none without the baseline.
fn rows(contestants: &[Contestant], size: usize) -> Vec<Row> {
    let named = |name: &str| contestants.iter().find(|it| it.mechanism.name == name);
    let Some(baseline) = named(BASELINE) else {
        return Vec::new();
    };
    let python = named(PYTHON);
    let row = |contestant: &Contestant| {
        let ratios = contestant.ratios(baseline);
        let is_other = contestant.mechanism.module != Some("fipa");
        let beside = python.filter(|_| is_other);
        let beside = beside.map(|python| contestant.ratios(python));
        let python_ratio = beside.as_deref().map(median);
        let name = contestant.mechanism.name;
        let ratio = median(&ratios);
        let aimed = TARGETS
            .iter()
            .find(|(of, at, _)| (*of, *at) == (name, size));
        let is_met = match (aimed, python_ratio) {
            (Some((_, _, most)), _) => Some(ratio <= *most),
            (None, Some(factor)) if size >= AHEAD_FROM => Some(factor > 1.0),
            _ => None,
        };
        Row {
            mechanism: name,
            size,
            round_trip_us: median(&contestant.times) / 1e3,
            ratio,
            ratio_spread: spread(&ratios),
            python_ratio,
            python_ratio_spread: beside.as_deref().map(spread),
            cpu_us: median(&contestant.cpu) / 1e3,
            target: is_met.map(|is_met| if is_met { "met" } else { "missed" }),
        }
    };
    contestants.iter().map(row).collect()
}

impl LanguagesReport {
    /// Mechanisms that were not measured, each with its reason.
    #[must_use]
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// The result as one JSON object: `machine`, `method`, `rows` and `notes`. Names of members end with
    /// their unit.
    #[must_use]
    pub fn to_json(&self) -> Value {
        let targets = TARGETS.map(|(mechanism, size, most)| {
            json!({ "mechanism": mechanism, "size": size, "largest_ratio": most })
        });
        json!({
            "machine": self.machine,
            "method": {
                "rounds": self.rounds,
                "python": self.python,
                "packages": self.packages,
                "targets": targets,
            },
            "rows": self.rows,
            "notes": self.notes,
        })
    }

    /// The result as a table with a legend.
    #[must_use]
    pub fn to_text(&self) -> String {
        let mut text = self.machine.heading();
        let packages = self.packages.iter();
        let packages: Vec<_> = packages.map(|(name, it)| format!("{name} {it}")).collect();
        text.push_str(&format!(
            "Python {} with {}; {} rounds; each round measures every mechanism in turn; times in microseconds\n\n",
            self.python,
            packages.join(", "),
            self.rounds,
        ));
        text.push_str(&self.table());
        text.push_str(LEGEND);
        for note in &self.notes {
            text.push_str(&format!("note: {note}\n"));
        }
        text
    }

    fn table(&self) -> String {
        let header = [
            "mechanism",
            "content",
            "round trip",
            "x rust",
            "(spread)",
            "x python",
            "(spread)",
            "cpu",
            "target",
        ];
        let mut table = empty_table(header, 1);
        let ratio = |ratio: f64| format!("{ratio:.2}");
        let spread = |[low, high]: [f64; 2]| format!("{low:.2}-{high:.2}");
        for row in &self.rows {
            table.add_row([
                row.mechanism.to_owned(),
                report::size(row.size),
                format!("{:.1}", row.round_trip_us),
                ratio(row.ratio),
                spread(row.ratio_spread),
                row.python_ratio.map(ratio).unwrap_or_default(),
                row.python_ratio_spread.map(spread).unwrap_or_default(),
                format!("{:.1}", row.cpu_us),
                row.target.unwrap_or_default().to_owned(),
            ]);
        }
        table.to_string()
    }
}

const LEGEND: &str = "
round trip  median time from before the sender copies its content into the memory of the mechanism until it
            has the answer: the first and the last byte, which the receiver has read
x rust      ratio to rust to rust in the same rounds (spread: the middle half of the rounds)
x python    of the mechanisms of others, ratio to python to python in the same rounds
cpu         CPU time of both processes for one message
target      python to rust: at most 3 times rust with 1 KiB, and 1.1 times with 1 MiB; with 1 MiB and more,
            each mechanism of others takes longer than python to python
";
