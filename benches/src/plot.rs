//! A diagram of latency over size, both logarithmic, as an SVG document.

use std::collections::BTreeMap;

use fipa_drawing::{Color, Line, Plot};

use super::measure::Row;
use super::part::{Fill, Socket, Wait, Wire};
use super::path::Mechanism;
use fipa::Kind;

/// Draws the results as an SVG document.
pub(super) fn svg(rows: &[Row], subtitle: &str) -> String {
    let common = [100, 1024, 65_536, 1_048_576, 4_194_304];
    let marks = common.map(|size: usize| (size as f64, super::report::size(size)));
    let plot = Plot {
        title: "One-way time from send to the decoded message (median)".to_owned(),
        subtitle: subtitle.to_owned(),
        x: "content".to_owned(),
        x_marks: marks.into(),
        unit: duration,
        lines: lines(rows),
    };
    plot.svg()
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
                thin: row.mechanism.limit().is_none(),
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
fn look(mechanism: Mechanism, fill: Fill, wait: Wait) -> (usize, Color) {
    let shm = match (fill, wait) {
        (Fill::Loaned, _) => Color(0x0b, 0x7a, 0x75),
        (_, Wait::Spin) => Color(0x1f, 0x6f, 0xd1),
        (_, Wait::Block) => Color(0x12, 0x3c, 0x73),
    };
    match mechanism {
        Mechanism::Agents(Kind::Shm) | Mechanism::Letters => (0, shm),
        Mechanism::Iceoryx => (1, shm),
        Mechanism::Agents(_) => (2, Color(0xc9, 0x5d, 0x12)),
        Mechanism::Socket(Socket::Unix) => (3, Color(0xc9, 0x5d, 0x12)),
        Mechanism::Socket(Socket::Tcp) => (4, Color(0x7a, 0x83, 0x8f)),
        Mechanism::Gateways(Kind::Udp) => (7, Color(0xb0, 0x3a, 0x7a)),
        Mechanism::Gateways(_) => (8, Color(0x7b, 0x3f, 0xb5)),
        Mechanism::Relay(Wire::Tcp) => (9, Color(0x7b, 0x3f, 0xb5)),
        Mechanism::Secured(Kind::Tcp) => (10, Color(0x2f, 0x8f, 0x3f)),
        Mechanism::Relay(Wire::Tls) => (11, Color(0x2f, 0x8f, 0x3f)),
        Mechanism::Secured(_) => (12, Color(0x4a, 0x4f, 0xc9)),
        Mechanism::Relay(Wire::Quic) => (13, Color(0x4a, 0x4f, 0xc9)),
        Mechanism::Zenoh { shared_memory } => {
            let order = if shared_memory { 14 } else { 15 };
            (order, Color(0x9a, 0x2a, 0x2a))
        }
    }
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
