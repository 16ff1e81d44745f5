//! A diagram of horizontal bars with marks.

use crate::Color;
use crate::canvas::{Anchor, Canvas, Font, Paint};
use crate::scale::{Scale, round_step, span};
use crate::text::width;

const WIDTH: f64 = 960.0;
const LEFT: f64 = 330.0;
const RIGHT: f64 = 110.0;
const TOP: f64 = 84.0;
const BAR: f64 = 13.0;
const GAP: f64 = 11.0;
/// Maximum number of groups.
const MAX_GROUPS: usize = 200;
const COLORS: [Color; 2] = [Color(0x00, 0x72, 0xb2), Color(0x6c, 0xbd, 0xeb)];
const MARK: Color = Color(0xc9, 0x5d, 0x12);

/// A diagram of bars in groups.
#[derive(Debug, Clone)]
pub struct Bars {
    /// Heading.
    pub title: String,
    /// Names of the series, at most two.
    pub series: Vec<String>,
    /// Legend of the marks.
    pub mark: String,
    /// Groups from top to bottom, at most 200.
    pub groups: Vec<Group>,
    /// Formats a value with its unit.
    pub unit: fn(f64) -> String,
    /// Whether the axis has powers of ten. Otherwise it begins at zero.
    pub logarithmic: bool,
}

/// Bars under one name.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Group {
    /// Name at the left edge.
    pub name: String,
    /// Bars from top to bottom.
    pub bars: Vec<Bar>,
}

/// One bar.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Bar {
    /// Index of the series.
    pub series: usize,
    /// Length, in the unit of the diagram.
    pub value: f64,
    /// Standard deviation, in the unit of the value; 0 for none.
    pub deviation: f64,
    /// Value of a mark beside the bar.
    pub mark: Option<f64>,
}

impl Bars {
    /// Draws the diagram as an SVG document.
    #[must_use]
    pub fn svg(&self) -> String {
        let groups = self.groups.get(..MAX_GROUPS).unwrap_or(&self.groups);
        let mut out = Canvas::new(WIDTH);
        let font = Font::new(13.0);
        out.text_within((24.0, 32.0), Font::new(19.0), &self.title, WIDTH - 48.0);
        let mut at = 24.0;
        for (series, name) in self.series.iter().take(COLORS.len()).enumerate() {
            out.rect((at, 50.0), (12.0, 12.0), 0.0, Paint::fill(color_of(series)));
            out.text_within((at + 18.0, 61.0), font, name, 240.0);
            at += width(name, 13.0, false).min(240.0) + 42.0;
        }
        out.line((at + 6.0, 48.0), (at + 6.0, 64.0), Paint::edge(MARK, 3.0));
        out.text_within((at + 18.0, 61.0), font, &self.mark, WIDTH - at - 42.0);

        let bars: usize = groups.iter().map(|group| group.bars.len()).sum();
        let rows = BAR * bars as f64 + GAP * groups.len() as f64;
        let bottom = TOP + rows;
        let (scale, marks) = self.scale();
        for value in &marks {
            let x = scale.place(*value);
            out.line((x, TOP - 4.0), (x, bottom), Paint::edge(Color::FAINT, 1.0));
        }
        let labels = marks
            .iter()
            .map(|value| (scale.place(*value), (self.unit)(*value)));
        out.labels(bottom + 18.0, 12.0, labels);
        let mut y = TOP + GAP / 2.0;
        for group in groups {
            let middle = y + BAR * group.bars.len() as f64 / 2.0;
            let font = Font::new(12.0).anchor(Anchor::End);
            out.text_within((LEFT - 10.0, middle + 4.0), font, &group.name, LEFT - 20.0);
            for bar in &group.bars {
                draw_bar(bar, &scale, y, &mut out);
                y += BAR;
            }
            y += GAP;
        }
        out.height = bottom + 40.0;
        out.finish(&self.title)
    }

    /// Returns the scale, and the values of its lines.
    fn scale(&self) -> (Scale, Vec<f64>) {
        let bars = self.groups.iter().flat_map(|group| &group.bars);
        let values = bars.flat_map(|bar| [Some(bar.value), bar.mark]).flatten();
        let positive = values.filter(|value| *value > 0.0);
        let (least, most) = span(positive).unwrap_or((1.0, 10.0));
        let ends = (LEFT, WIDTH - RIGHT);
        if self.logarithmic {
            return decades((least, most), ends);
        }
        let step = round_step(most / 8.0);
        let until = (most / step).ceil() * step;
        let scale = Scale::linear((0.0, until), ends);
        (scale, scale.marks_by(step))
    }
}

/// Returns a scale from a power of ten to another one, and the powers in it.
pub(crate) fn decades((least, most): (f64, f64), ends: (f64, f64)) -> (Scale, Vec<f64>) {
    let power = |value: f64| value.max(1e-9).log10();
    let (from, until) = (power(least).floor() as i32, power(most).ceil() as i32);
    let until = until.max(from + 1);
    let scale = Scale::logarithmic((10_f64.powi(from), 10_f64.powi(until)), ends);
    (
        scale,
        (from..=until).map(|power| 10_f64.powi(power)).collect(),
    )
}

fn draw_bar(bar: &Bar, scale: &Scale, y: f64, out: &mut Canvas) {
    let end = scale.place(bar.value);
    let paint = Paint::fill(color_of(bar.series));
    out.rect((LEFT, y + 1.0), (end - LEFT, BAR - 2.0), 0.0, paint);
    if bar.deviation > 0.0 {
        let [low, high] = [-bar.deviation, bar.deviation].map(|far| scale.place(bar.value + far));
        let middle = y + BAR / 2.0;
        out.line((low, middle), (high, middle), Paint::edge(Color::INK, 1.0));
    }
    if let Some(mark) = bar.mark {
        let x = scale.place(mark);
        out.line((x, y), (x, y + BAR), Paint::edge(MARK, 3.0));
    }
}

fn color_of(series: usize) -> Color {
    COLORS.get(series).copied().unwrap_or(Color::INK)
}
