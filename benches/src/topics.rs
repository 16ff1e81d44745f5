//! Publications of a topic for several subscribers, beside publish-subscribe of iceoryx2 and of zenoh.
//!
//! One process publishes, and each subscriber is a process. The processes sleep between two publications, so
//! each publication wakes its subscribers as the image of a camera does.

use std::path::PathBuf;

use serde::Serialize;
use serde_json::{Value, json};

use crate::comparison::Program;
use crate::error::BenchError;
use crate::machine::Machine;
use crate::measure::{WARMING, median, quantile, times};
use crate::part::{End, Event, Fill, Letters, Order, Part};
use crate::report::empty_table;
use crate::stage::{ProcessIndex, Stage};

/// Numbers of subscribers.
const SUBSCRIBERS: [usize; 3] = [1, 4, 16];
/// Length of a publication in bytes.
const SIZE: usize = 1 << 20;
/// Publications in a turn.
const TIMES: usize = 20;
/// Pause before each publication, in microseconds.
const PAUSE_US: u64 = 5_000;

/// Largest ratio to iceoryx2 that the project aims for.
const TARGET: f64 = 1.5;
/// Largest number of subscribers that the target is for.
const TARGET_SUBSCRIBERS: usize = 4;

/// Measures publications of 1 MiB for 1, 4 and 16 subscribers.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct Topics {
    /// A program with ends that use zenoh, to be measured in the same rounds.
    pub zenoh: Option<PathBuf>,
    rounds: usize,
    program: Program,
}

/// The result of [`Topics::run`].
#[derive(Debug)]
pub struct TopicsReport {
    machine: Machine,
    rounds: usize,
    rows: Vec<Row>,
    notes: Vec<String>,
}

/// Publications for a number of subscribers.
///
/// Times are medians in microseconds, from before the loan until the last subscriber has the content.
#[derive(Debug, Clone, Serialize)]
struct Row {
    subscribers: usize,
    size: usize,
    fipa_us: f64,
    iceoryx2_us: f64,
    zenoh_us: Option<f64>,
    /// Ratio to iceoryx2: the median over all rounds of the ratio of medians.
    ratio: f64,
    /// Middle half of these ratios.
    ratio_spread: [f64; 2],
    /// Ratio to zenoh.
    zenoh_ratio: Option<f64>,
    zenoh_ratio_spread: Option<[f64; 2]>,
    /// Processor time of all processes for one publication.
    cpu_us: f64,
    iceoryx2_cpu_us: f64,
    zenoh_cpu_us: Option<f64>,
}

/// The processes of one mechanism, and its results, one for each round.
struct Contestant {
    publisher: ProcessIndex,
    subscribers: Vec<ProcessIndex>,
    /// Median times in nanoseconds.
    times: Vec<f64>,
    /// Processor time for one publication in nanoseconds.
    cpu: Vec<f64>,
}

impl Topics {
    /// A measurement of about a minute.
    #[must_use]
    pub fn full(program: Program) -> Self {
        Self {
            zenoh: None,
            rounds: 25,
            program,
        }
    }

    /// A measurement of a few seconds, whose figures scatter more.
    #[must_use]
    pub fn quick(program: Program) -> Self {
        Self {
            rounds: 3,
            ..Self::full(program)
        }
    }

    /// Number of steps that [`run`](Self::run) reports.
    #[must_use]
    pub fn steps(&self) -> usize {
        SUBSCRIBERS.len() + 1
    }

    /// Measures. `progress` is called with the name of each step as it begins. When the future is
    /// dropped, all processes end and all their files are removed.
    ///
    /// # Errors
    ///
    /// If no number of subscribers can be measured. A single one that fails is one of the
    /// [`notes`](TopicsReport::notes).
    pub async fn run(
        self,
        machine: Machine,
        progress: impl Fn(&str),
    ) -> Result<TopicsReport, BenchError> {
        let mut report = TopicsReport {
            machine,
            rounds: self.rounds,
            rows: Vec::new(),
            notes: Vec::new(),
        };
        for subscribers in SUBSCRIBERS {
            progress(&format!("{subscribers} subscribers"));
            match self.measure(subscribers).await {
                Ok(row) => report.rows.push(row),
                Err(why) => report
                    .notes
                    .push(format!("{subscribers} subscribers: {why}")),
            }
        }
        progress("ending");
        if report.rows.is_empty() {
            return Err(BenchError::NothingMeasured(report.notes));
        }
        Ok(report)
    }

    async fn measure(&self, subscribers: usize) -> Result<Row, String> {
        let mut stage = Stage::new(self.program.clone(), self.zenoh.clone())?;
        let mut fipa = agents(&mut stage, subscribers).await?;
        let mut iceoryx2 = iceoryx2(&mut stage, subscribers).await?;
        let mut zenoh = match self.zenoh {
            Some(_) => Some(zenoh_peers(&mut stage, subscribers).await?),
            None => None,
        };
        for _ in 0..self.rounds {
            fipa.turn(&mut stage).await?;
            iceoryx2.turn(&mut stage).await?;
            if let Some(zenoh) = &mut zenoh {
                zenoh.turn(&mut stage).await?;
            }
        }
        let ratios = |other: &Contestant| {
            let pairs = fipa.times.iter().zip(&other.times);
            let ratios: Vec<f64> = pairs.map(|(ours, other)| ours / other).collect();
            let spread = [0.25, 0.75].map(|at| quantile(&ratios, at));
            (median(&ratios), spread)
        };
        let (ratio, ratio_spread) = ratios(&iceoryx2);
        let to_zenoh = zenoh.as_ref().map(ratios);
        Ok(Row {
            subscribers,
            size: SIZE,
            fipa_us: fipa.time_us(),
            iceoryx2_us: iceoryx2.time_us(),
            zenoh_us: zenoh.as_ref().map(Contestant::time_us),
            ratio,
            ratio_spread,
            zenoh_ratio: to_zenoh.map(|(ratio, _)| ratio),
            zenoh_ratio_spread: to_zenoh.map(|(_, spread)| spread),
            cpu_us: fipa.cpu_us(),
            iceoryx2_cpu_us: iceoryx2.cpu_us(),
            zenoh_cpu_us: zenoh.as_ref().map(Contestant::cpu_us),
        })
    }
}

/// Settings of processes that sleep until they are woken.
fn settings() -> [String; 3] {
    [
        "transport.shm.spin=0s",
        "mts.transports=shm",
        "transport.shm.capacity=1GiB",
    ]
    .map(str::to_owned)
}

async fn agents(stage: &mut Stage, subscribers: usize) -> Result<Contestant, String> {
    let settings = settings();
    let (publisher, to) = stage.start(&Part::Publisher, "topic", &settings).await?;
    let mut contestant = Contestant::new(publisher);
    for index in 0..subscribers {
        let part = Part::Subscriber { index };
        let (subscriber, _) = stage.start(&part, "topic", &settings).await?;
        find(stage, subscriber, to.clone()).await?;
        contestant.subscribers.push(subscriber);
    }
    Ok(contestant)
}

async fn iceoryx2(stage: &mut Stage, subscribers: usize) -> Result<Contestant, String> {
    let settings = settings();
    let part = Part::IceoryxPublisher { subscribers };
    let (publisher, _) = stage.start(&part, "ice", &settings).await?;
    let mut contestant = Contestant::new(publisher);
    for _ in 0..subscribers {
        let started = stage.start(&Part::IceoryxSubscriber, "ice", &settings);
        contestant.subscribers.push(started.await?.0);
    }
    Ok(contestant)
}

async fn zenoh_peers(stage: &mut Stage, subscribers: usize) -> Result<Contestant, String> {
    let (publisher, _) = stage.start_zenoh(End::Sender, true).await?;
    let mut contestant = Contestant::new(publisher);
    let mut addresses = Vec::new();
    for _ in 0..subscribers {
        let (subscriber, address) = stage.start_zenoh(End::Receiver, true).await?;
        contestant.subscribers.push(subscriber);
        addresses.push(address);
    }
    find(stage, publisher, addresses.join(",")).await?;
    Ok(contestant)
}

async fn find(stage: &mut Stage, who: ProcessIndex, to: String) -> Result<(), String> {
    stage.tell(who, &Order::Find { to }).await?;
    stage.event(who).await.map(drop)
}

impl Contestant {
    fn new(publisher: ProcessIndex) -> Self {
        Self {
            publisher,
            subscribers: Vec::new(),
            times: Vec::new(),
            cpu: Vec::new(),
        }
    }

    /// Sends the publications of one turn and adds the results.
    async fn turn(&mut self, stage: &mut Stage) -> Result<(), String> {
        let letters = Letters {
            count: TIMES + WARMING,
            size: SIZE,
            fill: Fill::Filled,
            window: 1,
            pause_us: PAUSE_US,
        };
        for subscriber in &self.subscribers {
            stage.tell(*subscriber, &Order::Receive(letters)).await?;
            stage.event(*subscriber).await?;
        }
        stage.tell(self.publisher, &Order::Send(letters)).await?;
        let sent = stage.event(self.publisher).await?;
        let Event::Sent { began, cpu_ns, .. } = sent else {
            return Err(format!("expected times, received {sent:?}"));
        };
        let mut cpu = cpu_ns;
        let mut last = began.clone();
        for subscriber in &self.subscribers {
            let received = stage.event(*subscriber).await?;
            let Event::Received { at, cpu_ns } = received else {
                return Err(format!("expected times, received {received:?}"));
            };
            cpu += cpu_ns;
            for (last, at) in last.iter_mut().zip(at) {
                *last = at.max(*last);
            }
        }
        self.times.push(median(&times(&began, &last)));
        self.cpu.push(cpu as f64 / letters.count as f64);
        Ok(())
    }

    fn time_us(&self) -> f64 {
        median(&self.times) / 1e3
    }

    fn cpu_us(&self) -> f64 {
        median(&self.cpu) / 1e3
    }
}

impl Row {
    fn target(&self) -> &'static str {
        let is_behind = self.zenoh_ratio.is_some_and(|ratio| ratio >= 1.0);
        match self.subscribers <= TARGET_SUBSCRIBERS && (self.ratio > TARGET || is_behind) {
            true => "missed",
            false => "",
        }
    }
}

impl TopicsReport {
    /// Numbers of subscribers that could not be measured, each with its reason.
    #[must_use]
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// The result as one JSON object: `machine`, `method`, `rows` and `notes`. Names of members end with
    /// their unit.
    #[must_use]
    pub fn to_json(&self) -> Value {
        json!({
            "machine": self.machine,
            "method": {
                "rounds": self.rounds,
                "publications_per_round": TIMES,
                "pause_us": PAUSE_US,
                "target_ratio": TARGET,
            },
            "rows": self.rows,
            "notes": self.notes,
        })
    }

    /// The result as a table with a legend.
    #[must_use]
    pub fn to_text(&self) -> String {
        let mut text = self.machine.heading();
        text.push_str(&format!(
            "{} rounds; each round measures every mechanism in turn; publications of 1 MiB; times in \
             microseconds\n\n",
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
            "subscribers",
            "fipa",
            "iceoryx2",
            "zenoh",
            "x iceoryx2",
            "(spread)",
            "x zenoh",
            "(spread)",
            "cpu fipa",
            "iceoryx2",
            "zenoh",
            "target",
        ];
        let mut table = empty_table(header, 0);
        let time = |time: f64| format!("{time:.0}");
        let ratio = |ratio: f64| format!("{ratio:.2}");
        let spread = |[low, high]: [f64; 2]| format!("{low:.2}-{high:.2}");
        for row in &self.rows {
            table.add_row([
                row.subscribers.to_string(),
                time(row.fipa_us),
                time(row.iceoryx2_us),
                row.zenoh_us.map(time).unwrap_or_default(),
                ratio(row.ratio),
                spread(row.ratio_spread),
                row.zenoh_ratio.map(ratio).unwrap_or_default(),
                row.zenoh_ratio_spread.map(spread).unwrap_or_default(),
                time(row.cpu_us),
                time(row.iceoryx2_cpu_us),
                row.zenoh_cpu_us.map(time).unwrap_or_default(),
                row.target().to_owned(),
            ]);
        }
        table.to_string()
    }
}

const LEGEND: &str = "
fipa        median time from before the loan of the memory, which the publisher fills, until the last
            subscriber has the content; all processes sleep 5 ms between two publications
iceoryx2    the same with raw iceoryx2 publish-subscribe and its event
zenoh       the same with the shared memory of zenoh, if --zenoh is given
x           ratio to that mechanism in the same rounds (spread: the middle half of the rounds)
cpu         CPU time of all processes for one publication
target      for 1 and 4 subscribers: at most 1.5 times iceoryx2, and less than zenoh
";
