//! Timelines: intervals in rows, over seconds.

use crate::Color;
use crate::canvas::{Canvas, Font, MARGIN, Paint, WIDTH};
use crate::scale::{Scale, number, span};
use crate::text::{fit, name_lines, width};

/// Maximum number of rows.
const MAX_ROWS: usize = 40;
/// Maximum number of intervals of a row.
const MAX_INTERVALS: usize = 500;
/// Maximum number of instants.
const MAX_MARKS: usize = 40;
/// Maximum number of intervals of a row at the same time.
const MAX_LANES: usize = 12;
/// Maximum number of lines for labels, of the marks and below the bars of a row.
const MAX_LABELS: usize = 5;
const BAR: f64 = 24.0;
const GAP: f64 = 4.0;
/// Height of a line of labels.
const LINE: f64 = 18.0;
const LABEL: f64 = 14.0;
const SMALL: f64 = 13.0;
/// Minimum width of the column of names: the timelines of a page with short names have equal axes.
const MIN_NAMES: f64 = 100.0;
/// Maximum width of the column of names.
const MAX_NAMES: f64 = 190.0;

/// A timeline.
///
/// Labels that have no room in their bars are beside or below them. Viewers also show the label and times of a bar
/// under the pointer.
///
/// ```
/// use fipa_drawing::{Color, Interval, Mark, Timeline, TimelineRow};
///
/// let held = Interval {
///     label: "rover #7".to_owned(),
///     from: 1.0,
///     until: Some(4.5),
///     color: Color::nth(0),
/// };
/// let killed = Mark { at: 3.0, label: "rover killed".to_owned() };
/// let locks = Timeline {
///     rows: vec![TimelineRow { name: "berth".to_owned(), intervals: vec![held] }],
///     marks: vec![killed],
///     until: Some(10.0),
/// };
/// assert!(locks.svg().contains(">rover #7<"));
/// ```
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Timeline {
    /// Rows from top to bottom, at most 40.
    pub rows: Vec<TimelineRow>,
    /// Instants that concern all rows, for example faults, at most 40.
    pub marks: Vec<Mark>,
    /// End of the time axis in seconds, if it is after all intervals and marks.
    pub until: Option<f64>,
}

/// A row of a timeline, for example an agent or a resource.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TimelineRow {
    /// Name at the left edge.
    pub name: String,
    /// Intervals in any order, at most 500. Those at the same time are drawn below each other, at most 12. A line
    /// tells how many are left out.
    pub intervals: Vec<Interval>,
}

/// An interval of time, for example the membership of a coalition, or the holder of a lock.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Interval {
    /// Text in or near the bar.
    pub label: String,
    /// Begin in seconds.
    pub from: f64,
    /// End in seconds. `None` for an interval that lasts beyond the end of the timeline.
    pub until: Option<f64>,
    /// Color of the bar.
    pub color: Color,
}

/// An instant, for example a fault.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Mark {
    /// Time in seconds.
    pub at: f64,
    /// Text above the line of the mark.
    pub label: String,
}

/// A horizontal piece of a line of labels.
#[derive(Debug, Clone, Copy)]
struct Piece {
    left: f64,
    right: f64,
}

/// Lines of labels that do not overlap.
#[derive(Debug, Default)]
struct Lines(Vec<Vec<Piece>>);

impl Lines {
    /// Returns the first line with room for a piece, which is taken.
    fn take(&mut self, piece: Piece) -> Option<usize> {
        let free = |line: &Vec<Piece>| {
            let mut others = line.iter();
            others.all(|other| piece.right + 8.0 < other.left || other.right + 8.0 < piece.left)
        };
        if let Some(at) = self.0.iter().position(free) {
            self.0.get_mut(at)?.push(piece);
            return Some(at);
        }
        if self.0.len() >= MAX_LABELS {
            return None;
        }
        self.0.push(vec![piece]);
        Some(self.0.len() - 1)
    }

    fn height(&self) -> f64 {
        self.0.len() as f64 * LINE
    }
}

/// A bar of a row.
struct Bar<'a> {
    interval: &'a Interval,
    left: f64,
    right: f64,
    lane: usize,
}

impl Timeline {
    /// Draws the timeline as an SVG document.
    #[must_use]
    pub fn svg(&self) -> String {
        self.canvas(WIDTH).finish("Timeline")
    }

    pub(crate) fn canvas(&self, wide: f64) -> Canvas {
        let rows = self.rows.get(..MAX_ROWS).unwrap_or(&self.rows);
        let names = rows.iter().map(|row| width(&row.name, LABEL, true));
        let names = names.fold(0.0, f64::max).clamp(MIN_NAMES, MAX_NAMES);
        let left = MARGIN + names + 12.0;
        let right = wide - MARGIN - 8.0;
        let scale = Scale::linear(self.span(), (left, right));
        let mut out = Canvas::new(wide);

        let marks = self.marks.iter().filter(|mark| mark.at.is_finite());
        let mut marks: Vec<&Mark> = marks.take(MAX_MARKS).collect();
        marks.sort_by(|a, b| a.at.total_cmp(&b.at));
        let mut lines = Lines::default();
        let labels: Vec<(&Mark, Option<(usize, Piece)>)> = marks
            .iter()
            .map(|mark| {
                let length = width(&fit(&mark.label, SMALL, true, 300.0), SMALL, true);
                let least = (right - length).max(left);
                let at = (scale.place(mark.at) - length / 2.0).clamp(MARGIN.min(least), least);
                let piece = Piece {
                    left: at,
                    right: at + length,
                };
                (*mark, lines.take(piece).map(|line| (line, piece)))
            })
            .collect();
        let top = lines.height() + if marks.is_empty() { 0.0 } else { 6.0 };

        let mut drawn = Canvas::new(wide);
        let mut texts = Canvas::new(wide);
        for row in rows {
            draw_row(row, &scale, (left, right), &mut drawn, &mut texts);
            let y = top + drawn.height;
            out.line((MARGIN, y), (right, y), Paint::edge(Color::FAINT, 1.0));
        }
        if self.rows.len() > rows.len() {
            let more = format!("… {} more rows", self.rows.len() - rows.len());
            let at = (MARGIN + 4.0, drawn.height + 16.0);
            texts.text(at, Font::new(SMALL).color(Color::GRAY), &more);
            drawn.height += 24.0;
        }
        let bottom = top + drawn.height + 4.0;
        let marks = scale.marks(8.0);
        for value in &marks {
            let x = scale.place(*value);
            out.line((x, top), (x, bottom), Paint::edge(Color::FAINT, 1.0));
        }
        let seconds = marks
            .iter()
            .map(|value| (scale.place(*value), format!("{} s", number(*value))));
        out.labels(bottom + 18.0, SMALL, seconds);
        out.put((0.0, top), &drawn);
        for (mark, label) in &labels {
            let x = scale.place(mark.at);
            let begin = label.map_or(top, |(line, _)| line as f64 * LINE + LINE - 4.0);
            let paint = Paint::edge(Color::RED, 1.6).dashed(true);
            out.line((x, begin), (x, bottom + 4.0), paint);
        }
        out.put((0.0, top), &texts);
        for (mark, label) in labels {
            if let Some((line, piece)) = label {
                let font = Font::new(SMALL)
                    .bold()
                    .color(Color::RED)
                    .cover(Color::WHITE);
                let at = (piece.left, line as f64 * LINE + 13.0);
                out.text_within(at, font, &mark.label, 300.0);
            }
        }
        out.line(
            (left, bottom),
            (right, bottom),
            Paint::edge(Color::INK, 1.2),
        );
        out.height = bottom + 26.0;
        out
    }

    /// Returns begin and end of the axis. It begins at zero unless that wastes much of it.
    fn span(&self) -> (f64, f64) {
        let rows = self.rows.iter().take(MAX_ROWS);
        let intervals = rows.flat_map(|row| row.intervals.iter().take(MAX_INTERVALS));
        let ends = intervals.flat_map(|it| [it.from, it.until.unwrap_or(it.from)]);
        let marks = self.marks.iter().take(MAX_MARKS).map(|mark| mark.at);
        let (from, until) = span(ends.chain(marks).chain(self.until)).unwrap_or((0.0, 1.0));
        let from = if from > 0.0 && from < until / 3.0 {
            0.0
        } else {
            from
        };
        // An interval may begin at the end.
        (from, until + (until - from) * 0.03)
    }
}

fn draw_row(
    row: &TimelineRow,
    scale: &Scale,
    (left, right): (f64, f64),
    out: &mut Canvas,
    texts: &mut Canvas,
) {
    let bars = bars(row, scale, right);
    let left_out = row.intervals.len() - bars.len();
    let lanes = bars.iter().map(|bar| bar.lane + 1).max().unwrap_or(1) as f64;
    let top = out.height + GAP;
    // One more: the sum of the widths is rounded.
    let name = name_lines(&row.name, LABEL, left - MARGIN - 11.0);
    for (at, line) in name.iter().enumerate() {
        let y = top + 17.0 + at as f64 * LINE;
        texts.text((MARGIN + 4.0, y), Font::new(LABEL).bold(), line);
    }
    let mut height = name.len() as f64 * LINE + GAP;
    if left_out > 0 {
        let at = (MARGIN + 4.0, top + height + 12.0);
        let text = format!("… {left_out} more");
        texts.text(at, Font::new(SMALL).color(Color::GRAY), &text);
        height += LINE;
    }
    let end = top + lanes * (BAR + GAP);
    let mut lines = Lines::default();
    // From the right, so that a line from a bar to its label passes beside the labels of later bars.
    for (at, bar) in bars.iter().enumerate().rev() {
        let y = top + bar.lane as f64 * (BAR + GAP);
        draw_bar(bar, y, out);
        let length = width(&bar.interval.label, SMALL, false);
        let next = bars
            .iter()
            .skip(at + 1)
            .find(|other| other.lane == bar.lane);
        let free = next.map_or(right, |next| next.left);
        if length + 12.0 <= bar.right - bar.left {
            inside(bar, y, texts);
        } else if bar.right + 5.0 + length + 3.0 <= free {
            let font = Font::new(SMALL).cover(Color::WHITE);
            texts.text((bar.right + 5.0, y + 17.0), font, &bar.interval.label);
        } else {
            below(bar, y, (left, right, end), &mut lines, (out, texts));
        }
    }
    out.height = (end + lines.height()).max(top + height);
}

/// Writes a label into its bar, as far as it fits.
fn inside(bar: &Bar<'_>, y: f64, texts: &mut Canvas) {
    let font = Font::new(SMALL).cover(bar.interval.color.light());
    let space = bar.right - bar.left - 12.0;
    texts.text_within((bar.left + 7.0, y + 17.0), font, &bar.interval.label, space);
}

/// Writes a label below the bars, or into the bar as far as it fits.
fn below(
    bar: &Bar<'_>,
    y: f64,
    (left, right, end): (f64, f64, f64),
    lines: &mut Lines,
    (out, texts): (&mut Canvas, &mut Canvas),
) {
    let space = bar.right - bar.left;
    let label = fit(&bar.interval.label, SMALL, false, 260.0);
    let length = width(&label, SMALL, false);
    let least = (right - length).max(left);
    let at = (bar.left + 1.0).min(least);
    let piece = Piece {
        left: at,
        right: at + length,
    };
    if let Some(line) = lines.take(piece) {
        let y = end + line as f64 * LINE;
        let paint = Paint::edge(bar.interval.color, 1.2);
        let x = f64::midpoint(bar.left, bar.right).min(bar.left + 5.0);
        out.line((x, end - GAP), (x, y + 4.0), paint);
        texts.text((at, y + 14.0), Font::new(SMALL).cover(Color::WHITE), &label);
    } else if space > 40.0 {
        inside(bar, y, texts);
    }
}

fn draw_bar(bar: &Bar<'_>, y: f64, out: &mut Canvas) {
    let color = bar.interval.color;
    let paint = Paint::edge(color, 1.4).with(color.light());
    let (left, right) = (bar.left, bar.right);
    let (bottom, middle) = (y + BAR, y + BAR / 2.0);
    let (from, until) = (number(bar.interval.from), bar.interval.until.map(number));
    let until = until.map_or_else(String::new, |until| format!("{until} s"));
    let text = format!("{}: {from} s – {until}", bar.interval.label);
    out.tip(&text, |out| {
        let corners = [(left, y), (right, y), (right, bottom), (left, bottom)];
        if bar.interval.until.is_some() {
            out.path(&corners, true, paint);
        } else {
            let [first, second, rest @ ..] = corners;
            let tip = (right + 8.0, middle);
            out.path(&[&[first, second, tip][..], &rest].concat(), true, paint);
        }
        let thick = 4.0_f64.min(right - left);
        out.rect((left, y), (thick, BAR), 0.0, Paint::fill(color));
    });
}

/// Returns the bars of a row in the order of their begins.
fn bars<'a>(row: &'a TimelineRow, scale: &Scale, right: f64) -> Vec<Bar<'a>> {
    let finite = |it: &&Interval| it.from.is_finite() && it.until.is_none_or(f64::is_finite);
    let intervals = row.intervals.iter().take(MAX_INTERVALS).filter(finite);
    let mut intervals: Vec<&Interval> = intervals.collect();
    intervals.sort_by(|a, b| a.from.total_cmp(&b.from));
    let mut ends: Vec<f64> = Vec::new();
    let mut bars = Vec::new();
    for interval in intervals {
        let until = interval.until.unwrap_or(f64::INFINITY);
        let lane = ends.iter().position(|end| *end <= interval.from);
        let lane = lane.unwrap_or(ends.len());
        match ends.get_mut(lane) {
            Some(end) => *end = until.max(interval.from),
            None if lane < MAX_LANES => ends.push(until),
            None => continue,
        }
        let left = scale.place(interval.from);
        let end = interval.until.map_or(right, |until| scale.place(until));
        bars.push(Bar {
            interval,
            left,
            right: end.max(left + 2.0),
            lane,
        });
    }
    bars
}

#[cfg(test)]
mod tests {
    use super::*;

    fn interval(label: &str, from: f64, until: Option<f64>) -> Interval {
        Interval {
            label: label.to_owned(),
            from,
            until,
            color: Color::nth(0),
        }
    }

    fn drawn(intervals: Vec<Interval>) -> String {
        let name = "berth".to_owned();
        let rows = vec![TimelineRow { name, intervals }];
        let (marks, until) = (Vec::new(), Some(100.0));
        Timeline { rows, marks, until }.svg()
    }

    #[test]
    fn a_label_is_in_its_bar_else_beside_it_else_below() {
        let svg = drawn(vec![
            interval("inside", 0.0, Some(50.0)),
            interval("below its bar", 60.0, Some(61.0)),
            interval("beside", 62.0, Some(63.0)),
        ]);
        let y = |text: &str| {
            let (before, _) = svg.split_once(&format!(">{text}<")).unwrap();
            let (_, y) = before.rsplit_once(" y=\"").unwrap();
            y.split_once('"').unwrap().0.parse::<f64>().unwrap()
        };
        assert_eq!(y("inside"), y("beside"));
        assert!(y("below its bar") > y("beside"));
    }

    #[test]
    fn intervals_at_the_same_time_are_below_each_other() {
        let intervals = (0..20).map(|at| interval(&format!("i{at}"), f64::from(at), None));
        let svg = drawn(intervals.collect());
        assert_eq!(svg.matches("</g>\n<g><title>i").count(), 11, "{svg}");
        assert!(svg.contains(">… 8 more<"), "{svg}");
    }

    #[test]
    fn intervals_without_finite_times_are_left_out() {
        let svg = drawn(vec![
            interval("good", 0.0, None),
            interval("bad", f64::NAN, None),
            interval("endless", 0.0, Some(f64::INFINITY)),
        ]);
        assert!(
            svg.contains(">good<") && svg.contains(">… 2 more<"),
            "{svg}"
        );
    }
}
