//! Several drawings under headings.

use crate::canvas::{Canvas, Font, MARGIN, WIDTH};
use crate::text::wrapped;
use crate::{Color, Plane, Sequence, Timeline};

/// Maximum number of sections.
const MAX_SECTIONS: usize = 60;
/// Maximum number of lines of a text.
const MAX_LINES: usize = 12;

/// A page: drawings below each other.
///
/// ```
/// use fipa_drawing::{Page, Plane, Section, Sequence, Timeline};
///
/// let page = Page {
///     title: "Docking".to_owned(),
///     text: "Two rovers dock at one station.".to_owned(),
///     sections: vec![
///         Section::new("Letters", Sequence::default()),
///         Section::new("Locks", Timeline::default()),
///         Section::new("Paths", Plane::default()),
///     ],
/// };
/// assert!(page.svg().contains(">Locks<"));
/// ```
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Page {
    /// Heading of the page.
    pub title: String,
    /// Paragraph below the heading. May be empty.
    pub text: String,
    /// Sections from top to bottom, at most 60.
    pub sections: Vec<Section>,
}

/// A part of a page.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Section {
    /// Heading.
    pub heading: String,
    /// Paragraph below the heading. May be empty.
    pub text: String,
    /// Drawing below the paragraph.
    pub drawing: Option<Drawing>,
}

/// A drawing of a page.
#[derive(Debug, Clone, PartialEq)]
pub enum Drawing {
    /// A sequence diagram.
    Sequence(Sequence),
    /// A timeline.
    Timeline(Timeline),
    /// A plan.
    Plane(Plane),
}

impl Section {
    /// Creates a section with a drawing and without a paragraph.
    pub fn new(heading: impl Into<String>, drawing: impl Into<Drawing>) -> Self {
        Self {
            heading: heading.into(),
            text: String::new(),
            drawing: Some(drawing.into()),
        }
    }
}

impl From<Sequence> for Drawing {
    fn from(sequence: Sequence) -> Self {
        Self::Sequence(sequence)
    }
}

impl From<Timeline> for Drawing {
    fn from(timeline: Timeline) -> Self {
        Self::Timeline(timeline)
    }
}

impl From<Plane> for Drawing {
    fn from(plane: Plane) -> Self {
        Self::Plane(plane)
    }
}

impl Page {
    /// Draws the page as an SVG document.
    #[must_use]
    pub fn svg(&self) -> String {
        let sections = self.sections.get(..MAX_SECTIONS).unwrap_or(&self.sections);
        // Sequences are as wide as their lanes need, and other drawings as wide as they.
        let sequences = sections
            .iter()
            .filter_map(|section| match &section.drawing {
                Some(Drawing::Sequence(sequence)) => Some(sequence.canvas().width),
                _ => None,
            });
        let wide = sequences.fold(WIDTH, f64::max);
        let mut out = Canvas::new(wide);
        out.height = 8.0;
        let left_out = self.sections.len() - sections.len();
        paragraph(&mut out, Font::new(22.0).bold(), &self.title);
        paragraph(&mut out, Font::new(14.5), &self.text);
        for section in sections {
            out.height += 16.0;
            paragraph(&mut out, Font::new(17.5).bold(), &section.heading);
            paragraph(&mut out, Font::new(14.0).color(Color::GRAY), &section.text);
            let canvas = match &section.drawing {
                Some(Drawing::Sequence(sequence)) => sequence.canvas(),
                Some(Drawing::Timeline(timeline)) => timeline.canvas(wide),
                Some(Drawing::Plane(plane)) => plane.canvas(wide),
                None => continue,
            };
            out.height += 8.0;
            out.put((0.0, out.height), &canvas);
            out.height += canvas.height;
        }
        if left_out > 0 {
            out.height += 16.0;
            let text = format!("… {left_out} more, not drawn");
            paragraph(&mut out, Font::new(14.0).color(Color::GRAY), &text);
        }
        out.height += MARGIN;
        out.finish(&self.title)
    }
}

/// Writes a text in as many lines as it needs.
fn paragraph(out: &mut Canvas, font: Font, text: &str) {
    let most = out.width - 2.0 * MARGIN;
    for line in wrapped(text, font.size, font.bold, most, MAX_LINES) {
        out.height += font.size * 1.4;
        out.text((MARGIN, out.height - font.size * 0.3), font, &line);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sections_have_headings_and_one_width() {
        let lanes = (0..11).map(|number| format!("rover_{number}")).collect();
        let steps = Vec::new();
        let page = Page {
            title: "Docking".to_owned(),
            text: String::new(),
            sections: vec![
                Section::new("Locks", Timeline::default()),
                Section::new("Letters", Sequence { lanes, steps }),
            ],
        };
        let svg = page.svg();
        let at = |text: &str| svg.find(text).unwrap();
        assert!(at(">Docking</text>") < at(">Locks<") && at(">Locks<") < at(">Letters<"));
        assert!(
            svg.contains(" width=\"1264\"") && svg.contains("L1240 "),
            "{svg}"
        );
    }

    #[test]
    fn sections_are_limited() {
        let sections = vec![Section::new("Locks", Timeline::default()); 63];
        let page = Page {
            sections,
            ..Page::default()
        };
        assert_eq!(page.svg().matches(">Locks<").count(), 60);
        assert!(page.svg().contains(">… 3 more, not drawn<"));
    }
}
