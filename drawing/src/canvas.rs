//! Shapes and texts of one drawing, and the SVG document of them.

use std::fmt::Write as _;

use crate::Color;
use crate::text::{escaped, fit, width};

/// Width of a drawing that has no reason for another one, in units of the document.
pub(crate) const WIDTH: f64 = 800.0;
/// Space at the edges.
pub(crate) const MARGIN: f64 = 16.0;
/// Numbers from outside are limited to this magnitude.
const MOST: f64 = 1e9;

/// A position: to the right, and down.
pub(crate) type Point = (f64, f64);

/// A drawing under construction. Everything is drawn in the order of the calls.
#[derive(Debug)]
pub(crate) struct Canvas {
    pub(crate) width: f64,
    pub(crate) height: f64,
    body: String,
}

/// Inside and edge of a shape.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Paint {
    fill: Option<Color>,
    edge: Option<(Color, f64)>,
    dashed: bool,
}

impl Paint {
    pub(crate) fn fill(color: Color) -> Self {
        Self {
            fill: Some(color),
            edge: None,
            dashed: false,
        }
    }

    pub(crate) fn edge(color: Color, width: f64) -> Self {
        Self {
            fill: None,
            edge: Some((color, width)),
            dashed: false,
        }
    }

    /// Fills the shape, too.
    pub(crate) fn with(self, fill: Color) -> Self {
        let fill = Some(fill);
        Self { fill, ..self }
    }

    pub(crate) fn dashed(self, dashed: bool) -> Self {
        Self { dashed, ..self }
    }
}

/// The side of a text at its position.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Anchor {
    Start,
    Middle,
    End,
}

/// The look of a text.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Font {
    pub(crate) size: f64,
    pub(crate) color: Color,
    pub(crate) bold: bool,
    pub(crate) anchor: Anchor,
    /// Color of an area behind the text, which hides what was drawn there.
    pub(crate) cover: Option<Color>,
}

impl Font {
    /// Returns a dark text that starts at its position.
    pub(crate) fn new(size: f64) -> Self {
        Self {
            size,
            color: Color::INK,
            bold: false,
            anchor: Anchor::Start,
            cover: None,
        }
    }

    pub(crate) fn color(self, color: Color) -> Self {
        Self { color, ..self }
    }

    pub(crate) fn bold(self) -> Self {
        let bold = true;
        Self { bold, ..self }
    }

    pub(crate) fn anchor(self, anchor: Anchor) -> Self {
        Self { anchor, ..self }
    }

    pub(crate) fn cover(self, color: Color) -> Self {
        let cover = Some(color);
        Self { cover, ..self }
    }
}

// Writing to a string cannot fail.
impl Canvas {
    pub(crate) fn new(width: f64) -> Self {
        Self {
            width,
            height: 0.0,
            body: String::new(),
        }
    }

    pub(crate) fn line(&mut self, from: Point, to: Point, paint: Paint) {
        self.path(&[from, to], false, paint);
    }

    /// Draws a line through points, closed to a polygon on request.
    pub(crate) fn path(&mut self, points: &[Point], closed: bool, paint: Paint) {
        self.body.push_str("<path d=\"");
        for (at, (x, y)) in points.iter().enumerate() {
            let verb = if at == 0 { "M" } else { "L" };
            let _ = write!(self.body, "{verb}{} {}", Number(*x), Number(*y));
        }
        let _ = writeln!(self.body, "{}\"{paint}/>", if closed { "Z" } else { "" });
    }

    pub(crate) fn circle(&mut self, (x, y): Point, radius: f64, paint: Paint) {
        let (x, y, radius) = (Number(x), Number(y), Number(radius));
        let _ = writeln!(
            self.body,
            "<circle cx=\"{x}\" cy=\"{y}\" r=\"{radius}\"{paint}/>"
        );
    }

    /// Draws a rectangle with round corners.
    pub(crate) fn rect(&mut self, (x, y): Point, (width, height): Point, round: f64, paint: Paint) {
        let (x, y, round) = (Number(x), Number(y), Number(round));
        let (width, height) = (Number(width.max(0.0)), Number(height.max(0.0)));
        let _ = writeln!(
            self.body,
            "<rect x=\"{x}\" y=\"{y}\" width=\"{width}\" height=\"{height}\" rx=\"{round}\"{paint}/>"
        );
    }

    /// Draws an arrowhead with its tip at a point. The direction is that of the arrow.
    pub(crate) fn arrowhead(&mut self, (x, y): Point, direction: Point, color: Color) {
        let length = direction.0.hypot(direction.1).max(1e-9);
        let (along, aside) = (direction.0 / length, direction.1 / length);
        let corner = |side: f64| {
            (
                x - 10.0 * along - side * 5.0 * aside,
                y - 10.0 * aside + side * 5.0 * along,
            )
        };
        self.path(
            &[(x, y), corner(1.0), corner(-1.0)],
            true,
            Paint::fill(color),
        );
    }

    /// Draws a cross.
    pub(crate) fn cross(&mut self, (x, y): Point, size: f64, paint: Paint) {
        self.line((x - size, y - size), (x + size, y + size), paint);
        self.line((x - size, y + size), (x + size, y - size), paint);
    }

    /// Draws a text on one line. The position is that of its base line.
    pub(crate) fn text(&mut self, (x, y): Point, font: Font, text: &str) {
        if text.is_empty() {
            return;
        }
        let length = width(text, font.size, font.bold);
        let (anchor, left) = match font.anchor {
            Anchor::Start => ("", x),
            Anchor::Middle => (" text-anchor=\"middle\"", x - length / 2.0),
            Anchor::End => (" text-anchor=\"end\"", x - length),
        };
        if let Some(color) = font.cover {
            let corner = (left - 2.0, y - font.size * 0.85);
            let size = (length + 4.0, font.size * 1.15);
            self.rect(corner, size, 0.0, Paint::fill(color));
        }
        let weight = if font.bold {
            " font-weight=\"bold\""
        } else {
            ""
        };
        let _ = writeln!(
            self.body,
            "<text x=\"{}\" y=\"{}\" font-size=\"{}\" fill=\"{}\"{weight}{anchor}>{}</text>",
            Number(x),
            Number(y),
            Number(font.size),
            font.color,
            escaped(text)
        );
    }

    /// Draws a text on one line, cut to a width.
    pub(crate) fn text_within(&mut self, at: Point, font: Font, text: &str, most: f64) {
        self.text(at, font, &fit(text, font.size, font.bold, most));
    }

    /// Writes the labels of a horizontal axis below their positions, except those without room.
    pub(crate) fn labels(
        &mut self,
        y: f64,
        size: f64,
        labels: impl Iterator<Item = (f64, String)>,
    ) {
        let font = Font::new(size).anchor(Anchor::Middle);
        let mut free = 0.0;
        for (x, text) in labels {
            let half = width(&text, size, false) / 2.0;
            let x = x.min(self.width - half);
            if x - half >= free {
                self.text((x, y), font, &text);
                free = x + half + 6.0;
            }
        }
    }

    /// Puts another drawing with its upper left corner at a point.
    pub(crate) fn put(&mut self, (x, y): Point, other: &Self) {
        let (x, y) = (Number(x), Number(y));
        let body = &other.body;
        let _ = write!(
            self.body,
            "<g transform=\"translate({x} {y})\">\n{body}</g>\n"
        );
    }

    /// Draws shapes that show a text under the pointer.
    pub(crate) fn tip(&mut self, text: &str, draw: impl FnOnce(&mut Self)) {
        let text = escaped(&fit(text, 1.0, false, 200.0));
        let _ = write!(self.body, "<g><title>{text}</title>");
        draw(self);
        self.body.push_str("</g>\n");
    }

    /// Returns the SVG document, which has a white background.
    pub(crate) fn finish(&self, title: &str) -> String {
        let (width, height) = (Number(self.width.ceil()), Number(self.height.ceil()));
        format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" \
             viewBox=\"0 0 {width} {height}\" font-family=\"system-ui, Segoe UI, DejaVu Sans, Helvetica, \
             Arial, sans-serif\">\n<title>{}</title>\n\
             <rect width=\"100%\" height=\"100%\" fill=\"#ffffff\"/>\n{}</svg>\n",
            escaped(title),
            self.body
        )
    }
}

impl std::fmt::Display for Paint {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self.fill {
            Some(color) => write!(f, " fill=\"{color}\"")?,
            None => f.write_str(" fill=\"none\"")?,
        }
        if let Some((color, width)) = self.edge {
            write!(f, " stroke=\"{color}\" stroke-width=\"{}\"", Number(width))?;
        }
        if self.dashed {
            f.write_str(" stroke-dasharray=\"5 4\"")?;
        }
        Ok(())
    }
}

/// A number of the document, with one decimal at most.
struct Number(f64);

impl std::fmt::Display for Number {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        // Zero has no sign.
        let rounded = (sane(self.0) * 10.0).round() / 10.0 + 0.0;
        write!(f, "{rounded}")
    }
}

/// Limits a number from outside. Zero stands for what is no number.
pub(crate) fn sane(value: f64) -> f64 {
    if value.is_nan() {
        return 0.0;
    }
    value.clamp(-MOST, MOST)
}
