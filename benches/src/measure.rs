//! The course of a measurement: all paths take turns, so other load affects them alike.

use std::collections::HashMap;
use std::time::Duration;

use hdrhistogram::Histogram;
use serde::Serialize;

use super::many::Many;
use super::part::{Fill, Letters, Wait};
use super::path::{BenchPath, Mechanism, Turn};
use super::stage::Stage;
use crate::error::BenchError;

/// The extent of a measurement.
#[derive(Debug, Clone)]
pub struct Effort {
    pub(super) sizes: Vec<usize>,
    /// Turns of each path with one kind of letter.
    pub(super) rounds: usize,
    /// Duration of a turn.
    pub(super) turn: Duration,
    /// Turns that measure the rate.
    pub(super) rate_rounds: usize,
}

impl Effort {
    /// Largest content that can be measured, in bytes.
    pub const MAX_SIZE: u64 = 32 << 20;

    /// A thorough measurement of content of these sizes, in bytes: about 80 seconds for five sizes.
    ///
    /// # Errors
    ///
    /// [`BenchError::Size`] for a size that cannot be measured.
    pub fn full(sizes: impl IntoIterator<Item = u64>) -> Result<Self, BenchError> {
        Ok(Self {
            sizes: checked(sizes)?,
            rounds: 15,
            turn: Duration::from_millis(25),
            rate_rounds: 3,
        })
    }

    /// A measurement of a few seconds, whose figures scatter more.
    ///
    /// # Errors
    ///
    /// The errors of [`full`](Self::full).
    pub fn quick(sizes: impl IntoIterator<Item = u64>) -> Result<Self, BenchError> {
        Ok(Self {
            sizes: checked(sizes)?,
            rounds: 5,
            turn: Duration::from_millis(8),
            rate_rounds: 1,
        })
    }
}

/// The sizes in order, each once.
fn checked(sizes: impl IntoIterator<Item = u64>) -> Result<Vec<usize>, BenchError> {
    let mut checked = Vec::new();
    for size in sizes {
        if !(1..=Effort::MAX_SIZE).contains(&size) {
            return Err(BenchError::Size(size));
        }
        checked.push(usize::try_from(size).map_err(|_| BenchError::Size(size))?);
    }
    checked.sort_unstable();
    checked.dedup();
    Ok(checked)
}

/// Minimum and maximum number of letters in a turn.
pub(super) const LEAST: usize = 8;
const MOST: usize = 2000;
/// Letters at the beginning of a turn that do not count: they wake sleeping processes.
pub(super) const WARMING: usize = 3;
/// Length of a turn that measures the rate, in turns.
const RATE_TURN: u32 = 3;

/// Percentiles of a time, in microseconds.
#[derive(Debug, Clone, Copy, Serialize)]
pub(super) struct Percentiles {
    pub(super) p50: f64,
    pub(super) p99: f64,
    pub(super) p999: f64,
}

/// Result of one path with one kind of letter.
#[derive(Debug, Clone, Serialize)]
pub(super) struct Row {
    pub(super) path: String,
    pub(super) wait: Wait,
    pub(super) size: usize,
    pub(super) fill: Fill,
    pub(super) samples: u64,
    /// From before sending until the receiver has the decoded letter.
    pub(super) one_way_us: Percentiles,
    /// From before sending until the sender knows that it has arrived.
    pub(super) round_trip_us: Percentiles,
    /// Letters per second with several letters in flight.
    pub(super) rate_per_s: Option<f64>,
    /// Processor time of all processes of the path, one letter at a time.
    pub(super) cpu_us_per_letter: f64,
    pub(super) limit: Option<Limit>,
    /// Ratio of the one-way time to the limit's: the median over all rounds of the ratio of medians.
    pub(super) ratio: Option<f64>,
    /// Middle half of these ratios.
    pub(super) ratio_spread: Option<[f64; 2]>,
    pub(super) round_trip_ratio: Option<f64>,
    /// Middle half of these ratios.
    pub(super) round_trip_ratio_spread: Option<[f64; 2]>,
    pub(super) rate_ratio: Option<f64>,
    pub(super) cpu_ratio: Option<f64>,
    /// Cost of encryption, beside the same path without.
    pub(super) plain: Option<Plain>,
    #[serde(skip)]
    pub(super) mechanism: Mechanism,
}

/// The bare mechanism that moves the same bytes.
#[derive(Debug, Clone, Serialize)]
pub(super) struct Limit {
    pub(super) name: String,
    pub(super) p50_us: f64,
    pub(super) round_trip_p50_us: f64,
    pub(super) rate_per_s: Option<f64>,
    pub(super) cpu_us_per_letter: f64,
}

/// An encrypted path in units of one that is not: medians over all rounds of the ratio of medians;
/// the ratio of rates is one of medians.
#[derive(Debug, Clone, Serialize)]
pub(super) struct Plain {
    pub(super) name: String,
    pub(super) ratio: f64,
    pub(super) round_trip_ratio: f64,
    /// Middle half of the rounds.
    pub(super) round_trip_ratio_spread: [f64; 2],
    pub(super) rate_ratio: Option<f64>,
    pub(super) cpu_ratio: f64,
}

/// Results of all paths, and the reasons for those that are missing.
#[derive(Debug, Default)]
pub(super) struct Measured {
    pub(super) rows: Vec<Row>,
    pub(super) many: Option<Many>,
    pub(super) notes: Vec<String>,
}

/// Measures all paths with all kinds of letters. `progress` is called with the name of each step.
pub(super) async fn all(
    stage: &mut Stage,
    paths: &mut Vec<BenchPath>,
    effort: &Effort,
    progress: &impl Fn(&str),
) -> Measured {
    let mut measured = Measured::default();
    for &size in &effort.sizes {
        let mut able = Vec::new();
        for (index, path) in paths.iter().enumerate() {
            match path.takes(stage, size).await {
                Ok(()) => able.push(index),
                Err(why) => {
                    let name = path.mechanism.name();
                    measured.notes.push(format!("{name}: {size} bytes: {why}"));
                }
            }
        }
        for fill in [Fill::Loaned, Fill::Filled, Fill::Copied] {
            progress(&format!("{} {}", super::report::size(size), name_of(fill)));
            let mut cells = HashMap::new();
            for index in able.clone() {
                let mechanism = paths[index].mechanism;
                if fill != Fill::Loaned || mechanism.loans() {
                    cells.insert(index, Cell::default());
                }
            }
            let failed = cell(stage, paths, size, fill, effort, &mut cells).await;
            measured.rows.extend(rows(paths, size, fill, &cells));
            // After a failure the processes of a path wait for letters that never arrive.
            for (index, why) in failed.into_iter().rev() {
                let path = paths.remove(index);
                let name = path.mechanism.name();
                measured.notes.push(format!("{name}: abandoned: {why}"));
                able.retain(|other| *other != index);
                for other in &mut able {
                    *other -= usize::from(*other > index);
                }
            }
        }
    }
    measured
}

pub(super) fn name_of(fill: Fill) -> &'static str {
    match fill {
        Fill::Loaned => "loaned",
        Fill::Filled => "filled",
        Fill::Copied => "copied",
    }
}

/// Measured values of one path with one kind of letter.
struct Cell {
    letters: usize,
    one_way: Histogram<u64>,
    round_trip: Histogram<u64>,
    /// Medians, one per round.
    one_way_medians: Vec<f64>,
    round_trip_medians: Vec<f64>,
    cpu: Vec<f64>,
    rates: Vec<f64>,
}

impl Default for Cell {
    fn default() -> Self {
        let histogram = || Histogram::new_with_bounds(1, 60_000_000_000, 3);
        let [one_way, round_trip] = [histogram(), histogram()].map(|made| match made {
            Ok(histogram) => histogram,
            Err(error) => unreachable!("three digits up to a minute: {error}"),
        });
        Self {
            letters: LEAST,
            one_way,
            round_trip,
            one_way_medians: Vec::new(),
            round_trip_medians: Vec::new(),
            cpu: Vec::new(),
            rates: Vec::new(),
        }
    }
}

/// Measures one kind of letter. Returns the indices of the paths that failed, in order, with reasons.
async fn cell(
    stage: &mut Stage,
    paths: &[BenchPath],
    size: usize,
    fill: Fill,
    effort: &Effort,
    cells: &mut HashMap<usize, Cell>,
) -> Vec<(usize, String)> {
    let mut failed = Vec::new();
    let letters = |count, window| Letters {
        count,
        size,
        fill,
        window,
        pause_us: 0,
    };
    for round in 0..=effort.rounds + effort.rate_rounds {
        for (index, path) in paths.iter().enumerate() {
            let Some(cell) = cells.get_mut(&index) else {
                continue;
            };
            let is_rate = round > effort.rounds;
            let window = if is_rate {
                Mechanism::window(fill, size)
            } else {
                1
            };
            let count = match is_rate {
                true => (cell.letters * RATE_TURN as usize).max(4 * window),
                false => cell.letters + WARMING,
            };
            match path.turn(stage, letters(count, window)).await {
                // The first turn finds the number of letters that fill a turn.
                Ok(turn) if round == 0 => cell.letters = letters_for(&turn, effort.turn),
                Ok(turn) if is_rate => cell.rates.push(rate(&turn)),
                Ok(turn) => cell.add(&turn),
                Err(why) => {
                    cells.remove(&index);
                    failed.push((index, why));
                }
            }
        }
    }
    failed.sort_by_key(|(index, _)| *index);
    failed
}

fn letters_for(turn: &Turn, time: Duration) -> usize {
    count_for(median(&times(&turn.began, &turn.ended)), time)
}

/// Number of repetitions of this length, in nanoseconds, that fill a turn.
pub(super) fn count_for(typical: f64, time: Duration) -> usize {
    let typical = typical.max(1.0);
    let fit = time.as_nanos() as f64 / typical;
    (fit as usize).clamp(LEAST, MOST)
}

/// Letters per second, without those that warm up.
fn rate(turn: &Turn) -> f64 {
    let from = turn.began.get(WARMING).copied().unwrap_or(0);
    let until = turn.ended.last().copied().unwrap_or(0);
    let letters = turn.began.len().saturating_sub(WARMING);
    letters as f64 * 1e9 / until.saturating_sub(from).max(1) as f64
}

impl Cell {
    fn add(&mut self, turn: &Turn) {
        let one_way = times(&turn.began, &turn.arrived);
        let round_trip = times(&turn.began, &turn.ended);
        for time in &one_way {
            self.one_way.saturating_record(*time as u64);
        }
        for time in &round_trip {
            self.round_trip.saturating_record(*time as u64);
        }
        self.one_way_medians.push(median(&one_way));
        self.round_trip_medians.push(median(&round_trip));
        let per_letter = turn.cpu_ns as f64 / turn.began.len().max(1) as f64;
        self.cpu.push(per_letter / 1e3);
    }

    fn cpu_us(&self) -> f64 {
        median(&self.cpu)
    }

    fn rate(&self) -> Option<f64> {
        (!self.rates.is_empty()).then(|| median(&self.rates))
    }
}

/// Durations in nanoseconds, without the letters that warm up.
pub(super) fn times(from: &[u64], until: &[u64]) -> Vec<f64> {
    let pairs = from.iter().zip(until).skip(WARMING);
    pairs
        .map(|(from, until)| until.saturating_sub(*from) as f64)
        .collect()
}

pub(super) fn median(values: &[f64]) -> f64 {
    quantile(values, 0.5)
}

pub(super) fn quantile(values: &[f64], at: f64) -> f64 {
    let mut values = values.to_vec();
    values.sort_by(f64::total_cmp);
    let last = values.len().saturating_sub(1);
    let index = (last as f64 * at).round() as usize;
    values.get(index).copied().unwrap_or(f64::NAN)
}

fn rows(paths: &[BenchPath], size: usize, fill: Fill, cells: &HashMap<usize, Cell>) -> Vec<Row> {
    let mut rows = Vec::new();
    for (index, path) in paths.iter().enumerate() {
        let Some(cell) = cells.get(&index) else {
            continue;
        };
        let found = |mechanism: Mechanism| {
            let is_it = |other: &BenchPath| other.mechanism == mechanism && other.wait == path.wait;
            let index = paths.iter().position(is_it)?;
            Some((mechanism, cells.get(&index)?))
        };
        let limit = path.mechanism.limit().and_then(found);
        let plain = path.mechanism.plain().and_then(found);
        let plain = plain.map(|(mechanism, plain)| beside(cell, mechanism, plain));
        rows.push(row(path, size, fill, cell, limit, plain));
    }
    rows
}

/// Ratios, one per round.
struct Ratios {
    one_way: Vec<f64>,
    round_trip: Vec<f64>,
    cpu: Vec<f64>,
}

impl Ratios {
    fn new(cell: &Cell, other: &Cell) -> Self {
        let of = |own: &[f64], other: &[f64]| {
            let pairs = own.iter().zip(other);
            pairs.map(|(own, other)| own / other).collect()
        };
        Self {
            one_way: of(&cell.one_way_medians, &other.one_way_medians),
            round_trip: of(&cell.round_trip_medians, &other.round_trip_medians),
            cpu: of(&cell.cpu, &other.cpu),
        }
    }
}

fn rate_ratio(cell: &Cell, other: &Cell) -> Option<f64> {
    Some(cell.rate()? / other.rate()?)
}

/// Lower and upper quartile.
pub(super) fn spread(ratios: &[f64]) -> [f64; 2] {
    [0.25, 0.75].map(|at| quantile(ratios, at))
}

fn beside(cell: &Cell, mechanism: Mechanism, plain: &Cell) -> Plain {
    let ratios = Ratios::new(cell, plain);
    Plain {
        name: mechanism.name(),
        ratio: median(&ratios.one_way),
        round_trip_ratio: median(&ratios.round_trip),
        round_trip_ratio_spread: spread(&ratios.round_trip),
        rate_ratio: rate_ratio(cell, plain),
        cpu_ratio: median(&ratios.cpu),
    }
}

fn row(
    path: &BenchPath,
    size: usize,
    fill: Fill,
    cell: &Cell,
    limit: Option<(Mechanism, &Cell)>,
    plain: Option<Plain>,
) -> Row {
    let ratios = limit.map(|(_, limit)| Ratios::new(cell, limit));
    Row {
        path: path.mechanism.name(),
        wait: path.wait,
        size,
        fill,
        samples: cell.one_way.len(),
        one_way_us: percentiles(&cell.one_way),
        round_trip_us: percentiles(&cell.round_trip),
        rate_per_s: cell.rate(),
        cpu_us_per_letter: cell.cpu_us(),
        limit: limit.map(|(mechanism, limit)| Limit {
            name: mechanism.name(),
            p50_us: percentiles(&limit.one_way).p50,
            round_trip_p50_us: percentiles(&limit.round_trip).p50,
            rate_per_s: limit.rate(),
            cpu_us_per_letter: limit.cpu_us(),
        }),
        ratio: ratios.as_ref().map(|it| median(&it.one_way)),
        ratio_spread: ratios.as_ref().map(|it| spread(&it.one_way)),
        round_trip_ratio: ratios.as_ref().map(|it| median(&it.round_trip)),
        round_trip_ratio_spread: ratios.as_ref().map(|it| spread(&it.round_trip)),
        rate_ratio: limit.and_then(|(_, limit)| rate_ratio(cell, limit)),
        cpu_ratio: ratios.map(|it| median(&it.cpu)),
        plain,
        mechanism: path.mechanism,
    }
}

fn percentiles(histogram: &Histogram<u64>) -> Percentiles {
    let at = |quantile| histogram.value_at_quantile(quantile) as f64 / 1e3;
    Percentiles {
        p50: at(0.5),
        p99: at(0.99),
        p999: at(0.999),
    }
}
