//! A diagram of latency over size, both logarithmic, as an SVG document.

use std::collections::BTreeMap;
use std::ops::RangeInclusive;

use plotters::coord::ranged1d::{KeyPointHint, Ranged};
use plotters::prelude::*;

use super::measure::Row;
use super::part::{Fill, Socket, Wait, Wire};
use super::path::Mechanism;
use fipa::Kind;

const WIDTH: u32 = 1000;
const HEIGHT: u32 = 560;
/// Width for the names at the right.
const NAMES: u32 = 280;
const INK: RGBColor = RGBColor(0x33, 0x3a, 0x44);
const FAINT: RGBColor = RGBColor(0xdd, 0xe1, 0xe6);

/// One line of the diagram.
struct Line {
    name: String,
    color: RGBColor,
    /// Whether the line is a limit, which is drawn thin.
    is_limit: bool,
    points: Vec<(f64, f64)>,
}

/// Draws the results as an SVG document.
pub(super) fn svg(rows: &[Row], subtitle: &str) -> Result<String, String> {
    let lines = lines(rows);
    if lines.is_empty() {
        return Err("there are no measurements".to_owned());
    }
    let mut text = String::new();
    draw(&lines, subtitle, &mut text).map_err(|error| error.to_string())?;
    Ok(text)
}

/// The lines of a diagram: loaned and filled content over shared memory, copied content over the
/// network. Every name tells how the processes wait. Paths that were measured spinning and blocking
/// have both lines for filled content, so that each other path has one that waits as it does. Letters
/// that are not decoded have no line.
fn lines(rows: &[Row]) -> Vec<Line> {
    let spinning = |mechanism: Mechanism| {
        rows.iter()
            .any(|row| row.mechanism == mechanism && row.wait == Wait::Spin)
    };
    let mut lines: BTreeMap<(usize, Fill, Wait), Line> = BTreeMap::new();
    for row in rows {
        let wanted = match (row.mechanism.loans(), row.fill) {
            (_, Fill::Copied) => false,
            (true, Fill::Loaned) => row.wait == Wait::Spin || !spinning(row.mechanism),
            (_, fill) => fill == Fill::Filled,
        };
        if !wanted || row.mechanism == Mechanism::Letters {
            continue;
        }
        let (order, color) = look(row.mechanism, row.fill, row.wait);
        let wait = match row.wait {
            Wait::Spin => "spinning",
            Wait::Block => "blocking",
        };
        let name = match (row.mechanism.loans(), row.fill) {
            (true, Fill::Loaned) => format!("{}, loaned, {wait}", row.path),
            (true, _) => format!("{}, filled, {wait}", row.path),
            (false, _) => format!("{}, {wait}", row.path),
        };
        let line = lines
            .entry((order, row.fill, row.wait))
            .or_insert_with(|| Line {
                name,
                color,
                is_limit: row.mechanism.limit().is_none(),
                points: Vec::new(),
            });
        line.points.push((row.size as f64, row.one_way_us.p50));
    }
    let mut lines: Vec<Line> = lines.into_values().collect();
    for line in &mut lines {
        line.points.sort_by(|a, b| a.0.total_cmp(&b.0));
    }
    lines
}

/// Order and color of a line; a path and its limit share them.
fn look(mechanism: Mechanism, fill: Fill, wait: Wait) -> (usize, RGBColor) {
    let shm = match (fill, wait) {
        (Fill::Loaned, _) => RGBColor(0x0b, 0x7a, 0x75),
        (_, Wait::Spin) => RGBColor(0x1f, 0x6f, 0xd1),
        (_, Wait::Block) => RGBColor(0x12, 0x3c, 0x73),
    };
    match mechanism {
        Mechanism::Agents(Kind::Shm) | Mechanism::Letters => (0, shm),
        Mechanism::Iceoryx => (1, shm),
        Mechanism::Agents(_) => (2, RGBColor(0xc9, 0x5d, 0x12)),
        Mechanism::Socket(Socket::Unix) => (3, RGBColor(0xc9, 0x5d, 0x12)),
        Mechanism::Socket(Socket::Tcp) => (4, RGBColor(0x7a, 0x83, 0x8f)),
        Mechanism::Gateways(Kind::Udp) => (7, RGBColor(0xb0, 0x3a, 0x7a)),
        Mechanism::Gateways(_) => (8, RGBColor(0x7b, 0x3f, 0xb5)),
        Mechanism::Relay(Wire::Tcp) => (9, RGBColor(0x7b, 0x3f, 0xb5)),
        Mechanism::Secured(Kind::Tcp) => (10, RGBColor(0x2f, 0x8f, 0x3f)),
        Mechanism::Relay(Wire::Tls) => (11, RGBColor(0x2f, 0x8f, 0x3f)),
        Mechanism::Secured(_) => (12, RGBColor(0x4a, 0x4f, 0xc9)),
        Mechanism::Relay(Wire::Quic) => (13, RGBColor(0x4a, 0x4f, 0xc9)),
        Mechanism::Zenoh { shared_memory } => {
            let order = if shared_memory { 14 } else { 15 };
            (order, RGBColor(0x9a, 0x2a, 0x2a))
        }
    }
}

fn draw(
    lines: &[Line],
    subtitle: &str,
    text: &mut String,
) -> Result<(), Box<dyn std::error::Error>> {
    let area = SVGBackend::with_string(text, (WIDTH, HEIGHT)).into_drawing_area();
    area.fill(&WHITE)?;
    let style = |size: u32, color: &RGBColor| ("sans-serif", size).into_font().color(color);
    area.draw_text(
        "One-way time from send to the decoded message (median)",
        &style(20, &INK),
        (24, 18),
    )?;
    area.draw_text(subtitle, &style(13, &INK), (24, 46))?;
    let (_, plot) = area.split_vertically(64);
    let (sizes, times) = (span(lines, |point| point.0), span(lines, |point| point.1));
    let mut chart = ChartBuilder::on(&plot)
        .margin_top(12)
        .margin_right(NAMES)
        .x_label_area_size(44)
        .y_label_area_size(72)
        .build_cartesian_2d(Decades::sizes(sizes), Decades::times(times))?;
    chart
        .configure_mesh()
        .light_line_style(TRANSPARENT)
        .bold_line_style(FAINT)
        .axis_style(INK)
        .label_style(style(13, &INK))
        .x_desc("content")
        .x_label_formatter(&|size| super::report::size(size.round() as usize))
        .y_label_formatter(&|time| duration(*time))
        .draw()?;
    for line in lines {
        let width = if line.is_limit { 1 } else { 3 };
        let points = line.points.iter().copied();
        chart.draw_series(LineSeries::new(points, line.color.stroke_width(width)))?;
        let dots = line.points.iter();
        let size = if line.is_limit { 2 } else { 4 };
        chart.draw_series(dots.map(|point| Circle::new(*point, size, line.color.filled())))?;
    }
    for (line, height) in lines.iter().zip(heights(&chart, lines)) {
        let Some(end) = line.points.last() else {
            continue;
        };
        let (right, _) = chart.backend_coord(end);
        let weight = if line.is_limit { 12 } else { 14 };
        area.draw_text(
            &line.name,
            &style(weight, &line.color),
            (right + 12, height - 7),
        )?;
    }
    drop(chart);
    area.present()?;
    Ok(())
}

/// Positions of the names: beside the ends of the lines, without overlap.
fn heights<DB: DrawingBackend>(
    chart: &ChartContext<'_, DB, Cartesian2d<Decades, Decades>>,
    lines: &[Line],
) -> Vec<i32> {
    const APART: i32 = 17;
    let ends = lines.iter().map(|line| {
        let end = line.points.last().copied().unwrap_or((1.0, 1.0));
        chart.backend_coord(&end).1
    });
    let mut ends: Vec<(usize, i32)> = ends.enumerate().collect();
    ends.sort_by_key(|(_, height)| *height);
    let mut heights = vec![0; lines.len()];
    let mut free = i32::MIN;
    for (index, height) in ends {
        let height = height.max(free);
        if let Some(place) = heights.get_mut(index) {
            *place = height;
        }
        free = height + APART;
    }
    heights
}

/// Minimum and maximum.
fn span(lines: &[Line], of: impl Fn(&(f64, f64)) -> f64) -> RangeInclusive<f64> {
    let values = lines.iter().flat_map(|line| line.points.iter().map(&of));
    let (least, most) = values.fold((f64::INFINITY, 0.0_f64), |(least, most), value| {
        (least.min(value), most.max(value))
    });
    least..=most
}

/// Formats a time in microseconds.
pub(super) fn duration(micros: f64) -> String {
    match micros {
        micros if micros >= 1e6 => format!("{} s", round(micros / 1e6)),
        micros if micros >= 1e3 => format!("{} ms", round(micros / 1e3)),
        micros => format!("{} µs", round(micros)),
    }
}

/// Rounds away the error of a power of ten.
fn round(value: f64) -> f64 {
    (value * 1e4).round() / 1e4
}

/// A logarithmic axis with labels at the measured sizes, or at powers of ten.
struct Decades {
    from: f64,
    until: f64,
    marks: Vec<f64>,
}

impl Decades {
    fn sizes(sizes: RangeInclusive<f64>) -> Self {
        let common = [100.0, 1024.0, 65_536.0, 1_048_576.0, 4_194_304.0];
        let marks = common.into_iter().filter(|mark| sizes.contains(mark));
        Self {
            from: sizes.start() / 1.3,
            until: sizes.end() * 1.1,
            marks: marks.collect(),
        }
    }

    fn times(times: RangeInclusive<f64>) -> Self {
        let from = times.start().log10().floor() as i32;
        let until = times.end().log10().ceil() as i32;
        Self {
            from: 10f64.powi(from),
            until: 10f64.powi(until.max(from + 1)),
            marks: (from..=until).map(|power| 10f64.powi(power)).collect(),
        }
    }
}

impl Ranged for Decades {
    type FormatOption = plotters::coord::ranged1d::NoDefaultFormatting;
    type ValueType = f64;

    fn map(&self, value: &f64, (low, high): (i32, i32)) -> i32 {
        let share = (value.ln() - self.from.ln()) / (self.until.ln() - self.from.ln());
        low + (f64::from(high - low) * share).round() as i32
    }

    fn key_points<Hint: KeyPointHint>(&self, _hint: Hint) -> Vec<f64> {
        self.marks.clone()
    }

    fn range(&self) -> std::ops::Range<f64> {
        self.from..self.until
    }
}

impl plotters::coord::ranged1d::ValueFormatter<f64> for Decades {
    fn format(value: &f64) -> String {
        value.to_string()
    }
}
