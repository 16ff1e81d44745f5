//! A diagram of lines over two logarithmic axes.

use crate::Color;
use crate::bars::decades;
use crate::canvas::{Anchor, Canvas, Font, Paint, Point};
use crate::scale::{Scale, span};

const WIDTH: f64 = 1000.0;
const HEIGHT: f64 = 560.0;
const LEFT: f64 = 84.0;
/// Right end of the axis; the names of the lines are beside it.
const RIGHT: f64 = 720.0;
const TOP: f64 = 76.0;
const BOTTOM: f64 = 512.0;
/// Distance of the names.
const NAMES: f64 = 17.0;
/// Maximum numbers of lines and of points of a line.
const MAX_LINES: usize = 40;
const MAX_POINTS: usize = 1000;

/// A diagram of lines. Both axes are logarithmic, so values of 0 and less are left out.
#[derive(Debug, Clone)]
pub struct Plot {
    /// Heading.
    pub title: String,
    /// Line below the heading.
    pub subtitle: String,
    /// Name of the horizontal axis.
    pub x: String,
    /// Values of the horizontal axis that have a label. Those outside of the lines are left out.
    pub x_marks: Vec<(f64, String)>,
    /// Formats a power of ten of the vertical axis with its unit.
    pub unit: fn(f64) -> String,
    /// Lines, at most 40. Their names are at their right ends.
    pub lines: Vec<Line>,
}

/// One line of a plot.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Line {
    /// Name.
    pub name: String,
    /// Color of the line and its name.
    pub color: Color,
    /// Whether the line is drawn thin, for example a limit of another line.
    pub thin: bool,
    /// Points in the order of the first value, at most 1000.
    pub points: Vec<(f64, f64)>,
}

impl Plot {
    /// Draws the diagram as an SVG document.
    #[must_use]
    pub fn svg(&self) -> String {
        let lines: Vec<(&Line, Vec<Point>)> = self
            .lines
            .iter()
            .take(MAX_LINES)
            .map(|line| (line, drawable(line)))
            .collect();
        let points = || lines.iter().flat_map(|(_, points)| points);
        let sizes = span(points().map(|point| point.0)).unwrap_or((1.0, 10.0));
        let times = span(points().map(|point| point.1)).unwrap_or((1.0, 10.0));
        let x = Scale::logarithmic((sizes.0 / 1.3, sizes.1 * 1.1), (LEFT, RIGHT));
        let (y, marks) = decades(times, (BOTTOM, TOP));

        let mut out = Canvas::new(WIDTH);
        out.text_within((24.0, 36.0), Font::new(20.0), &self.title, WIDTH - 48.0);
        out.text_within((24.0, 58.0), Font::new(13.0), &self.subtitle, WIDTH - 48.0);
        let faint = Paint::edge(Color::FAINT, 1.0);
        let shown = self
            .x_marks
            .iter()
            .filter(|(value, _)| *value >= sizes.0 && *value <= sizes.1);
        for (value, _) in shown.clone() {
            let at = x.place(*value);
            out.line((at, TOP), (at, BOTTOM), faint);
        }
        let labels = shown.map(|(value, label)| (x.place(*value), label.clone()));
        out.labels(BOTTOM + 18.0, 13.0, labels);
        for value in marks {
            let at = y.place(value);
            out.line((LEFT, at), (RIGHT, at), faint);
            let font = Font::new(13.0).anchor(Anchor::End);
            out.text((LEFT - 8.0, at + 5.0), font, &(self.unit)(value));
        }
        let corner = [(LEFT, TOP), (LEFT, BOTTOM), (RIGHT, BOTTOM)];
        out.path(&corner, false, Paint::edge(Color::INK, 1.0));
        let font = Font::new(13.0).anchor(Anchor::Middle);
        out.text((f64::midpoint(LEFT, RIGHT), BOTTOM + 38.0), font, &self.x);

        let mut ends: Vec<(&Line, Point)> = Vec::new();
        for (line, points) in &lines {
            let places: Vec<Point> = points
                .iter()
                .map(|point| (x.place(point.0), y.place(point.1)))
                .collect();
            let (weight, dot) = if line.thin { (1.0, 2.0) } else { (3.0, 4.0) };
            out.path(&places, false, Paint::edge(line.color, weight));
            for place in &places {
                out.circle(*place, dot, Paint::fill(line.color));
            }
            ends.extend(places.last().map(|end| (*line, *end)));
        }
        // Names are beside the ends of the lines, and below each other.
        ends.sort_by(|a, b| a.1.1.total_cmp(&b.1.1));
        let mut free = f64::MIN;
        for (line, (right, height)) in ends {
            let height = height.max(free);
            free = height + NAMES;
            let size = if line.thin { 12.0 } else { 14.0 };
            let font = Font::new(size).color(line.color);
            out.text_within(
                (right + 12.0, height + 5.0),
                font,
                &line.name,
                WIDTH - right - 20.0,
            );
        }
        out.height = HEIGHT.max(free);
        out.finish(&self.title)
    }
}

/// Returns the points that have a place on logarithmic axes.
fn drawable(line: &Line) -> Vec<Point> {
    let positive = |value: f64| value > 0.0 && value.is_finite();
    let points = line.points.iter().copied().take(MAX_POINTS);
    points
        .filter(|point| positive(point.0) && positive(point.1))
        .collect()
}
