//! A diagram of horizontal bars with marks, as an SVG document.

use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

const WIDTH: i32 = 960;
const TOP: i32 = 84;
const LEFT: i32 = 330;
const RIGHT: i32 = 110;
const BAR: i32 = 13;
const GAP: i32 = 11;
const INK: RGBColor = RGBColor(0x33, 0x3a, 0x44);
const FAINT: RGBColor = RGBColor(0xdd, 0xe1, 0xe6);
const COLORS: [RGBColor; 2] = [RGBColor(0x1f, 0x6f, 0xd1), RGBColor(0x0b, 0x7a, 0x75)];
const MARK: RGBColor = RGBColor(0xc9, 0x5d, 0x12);

/// The contents of a diagram.
pub(super) struct Picture<'a> {
    pub(super) title: &'a str,
    pub(super) series: &'a [&'a str],
    /// Legend of the marks.
    pub(super) mark: &'a str,
    pub(super) groups: Vec<Group>,
    /// Formats a value with its unit.
    pub(super) unit: fn(f64) -> String,
    pub(super) logarithmic: bool,
}

/// Bars under one name.
pub(super) struct Group {
    pub(super) name: String,
    pub(super) bars: Vec<Bar>,
}

/// One bar.
pub(super) struct Bar {
    pub(super) series: usize,
    pub(super) value: f64,
    /// Standard deviation, in the unit of the value.
    pub(super) deviation: f64,
    pub(super) mark: Option<f64>,
}

/// Draws the diagram as an SVG document.
pub(super) fn svg(picture: &Picture<'_>) -> Result<String, String> {
    let mut text = String::new();
    draw(picture, &mut text).map_err(|error| error.to_string())?;
    Ok(text)
}

/// Maps a value to its position.
struct Scale {
    from: f64,
    until: f64,
    /// Distance of the lines of a linear scale.
    step: f64,
    logarithmic: bool,
}

impl Scale {
    fn of(picture: &Picture<'_>) -> Self {
        let bars = picture.groups.iter().flat_map(|group| &group.bars);
        let values = bars.flat_map(|bar| [Some(bar.value), bar.mark]).flatten();
        let (least, most) = values.fold((f64::INFINITY, 1e-9_f64), |(least, most), value| {
            (least.min(value), most.max(value))
        });
        let logarithmic = picture.logarithmic;
        let decade = |value: f64| value.max(1e-9).log10();
        let below = 10f64.powf(decade(most).floor());
        let step = match most / below {
            share if share < 2.0 => below / 5.0,
            share if share < 5.0 => below / 2.0,
            _ => below,
        };
        let (from, until) = if logarithmic {
            let above = 10f64.powf(decade(most).ceil());
            (10f64.powf(decade(least).floor()), above)
        } else {
            (0.0, (most / step).ceil() * step)
        };
        Self {
            from,
            until,
            step,
            logarithmic,
        }
    }

    fn marks(&self) -> Vec<f64> {
        if self.logarithmic {
            let decades = (self.until / self.from).log10().round() as i32;
            return (0..=decades).map(|n| self.from * 10f64.powi(n)).collect();
        }
        let steps = (self.until / self.step).round() as i32;
        (0..=steps).map(|n| self.step * f64::from(n)).collect()
    }

    fn place(&self, value: f64) -> i32 {
        let share = if self.logarithmic {
            (value.max(self.from) / self.from).log10() / (self.until / self.from).log10()
        } else {
            value / self.until
        };
        LEFT + (f64::from(WIDTH - LEFT - RIGHT) * share.clamp(0.0, 1.0)).round() as i32
    }
}

fn draw(picture: &Picture<'_>, text: &mut String) -> Result<(), Box<dyn std::error::Error>> {
    let bars: usize = picture.groups.iter().map(|group| group.bars.len()).sum();
    let rows = BAR * i32::try_from(bars)? + GAP * i32::try_from(picture.groups.len())?;
    let height = TOP + rows + 40;
    let size = (u32::try_from(WIDTH)?, u32::try_from(height)?);
    let area = SVGBackend::with_string(text, size).into_drawing_area();
    area.fill(&WHITE)?;
    let font = |size: u32, color: &RGBColor| ("sans-serif", size).into_font().color(color);
    let anchored = |horizontal| font(12, &INK).pos(Pos::new(horizontal, VPos::Center));
    area.draw_text(picture.title, &font(19, &INK), (24, 16))?;
    let mut at = 24;
    for (series, name) in picture.series.iter().enumerate() {
        let color = color_of(series);
        area.draw(&Rectangle::new([(at, 50), (at + 12, 62)], color.filled()))?;
        area.draw_text(name, &font(13, &INK), (at + 18, 49))?;
        at += 110;
    }
    area.draw(&PathElement::new(
        vec![(at + 6, 48), (at + 6, 64)],
        MARK.stroke_width(3),
    ))?;
    area.draw_text(picture.mark, &font(13, &INK), (at + 18, 49))?;

    let scale = Scale::of(picture);
    let bottom = TOP + rows;
    for value in scale.marks() {
        let x = scale.place(value);
        area.draw(&PathElement::new(vec![(x, TOP - 4), (x, bottom)], FAINT))?;
        let label = (picture.unit)(value);
        area.draw_text(&label, &anchored(HPos::Center), (x, bottom + 14))?;
    }
    let mut y = TOP + GAP / 2;
    for group in &picture.groups {
        let middle = y + BAR * i32::try_from(group.bars.len())? / 2;
        area.draw_text(&group.name, &anchored(HPos::Right), (LEFT - 10, middle))?;
        for bar in &group.bars {
            let color = color_of(bar.series);
            let end = scale.place(bar.value);
            let corners = [(LEFT, y + 1), (end, y + BAR - 1)];
            area.draw(&Rectangle::new(corners, color.filled()))?;
            if bar.deviation > 0.0 {
                let [low, high] = [-bar.deviation, bar.deviation]
                    .map(|deviation| scale.place(bar.value + deviation));
                let line = vec![(low, y + BAR / 2), (high, y + BAR / 2)];
                area.draw(&PathElement::new(line, INK))?;
            }
            if let Some(mark) = bar.mark {
                let x = scale.place(mark);
                let line = vec![(x, y), (x, y + BAR)];
                area.draw(&PathElement::new(line, MARK.stroke_width(3)))?;
            }
            y += BAR;
        }
        y += GAP;
    }
    area.present()?;
    Ok(())
}

fn color_of(series: usize) -> RGBColor {
    COLORS.get(series).copied().unwrap_or(INK)
}
