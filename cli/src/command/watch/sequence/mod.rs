//! A conversation as a sequence diagram of characters.
//!
//! Every participant has a lifeline; every letter has two lines, a label and an arrow. If the lifelines
//! do not fit into the width, the last participants share the last lifeline.

use unicode_width::UnicodeWidthChar;

use super::conversations::{Conversation, Step};
use super::text::{Ink, Look};
use crate::output::cut;

/// Minimum number of columns per lifeline.
const MIN_SPACING: usize = 12;
/// Maximum number of columns per lifeline.
const MAX_SPACING: usize = 28;
/// Columns for the time, left of the first lifeline.
const TIME: usize = 9;
/// Width of the diagram if the output is not a terminal.
const DEFAULT_WIDTH: usize = 100;
/// Minimum width of the diagram.
const MIN_WIDTH: usize = 40;

/// Draws a conversation.
pub(super) fn draw(conversation: &Conversation, look: Look) -> String {
    let width = look.width.unwrap_or(DEFAULT_WIDTH).max(MIN_WIDTH);
    let names = conversation.participants();
    let most = ((width - TIME) / MIN_SPACING).max(2);
    let columns = names.len().clamp(1, most);
    let spacing = ((width - TIME) / columns).clamp(MIN_SPACING, MAX_SPACING);
    let diagram = Diagram {
        width,
        spacing,
        columns,
        names: &names,
    };
    let mut lines = vec![cut(&conversation.title(), width)];
    lines.push(diagram.head());
    let begin = conversation.steps.first().map(|step| step.at);
    for step in &conversation.steps {
        let after = begin.and_then(|begin| step.at.duration_since(begin).ok());
        let time = format!("+{:.3}", after.unwrap_or_default().as_secs_f64());
        let ink = match step {
            Step {
                violation: Some(_), ..
            } => Some(Ink::Bad),
            Step {
                failed: Some(_), ..
            } => Some(Ink::Warning),
            _ => None,
        };
        let painted = |line: String| ink.map_or(line.clone(), |ink| look.paint(ink, &line));
        lines.extend(diagram.arrow(step, &time).map(painted));
        if let Some(violation) = &step.violation {
            for line in wrapped(&format!("✗ {violation}"), width - 4) {
                lines.push(painted(format!("    {line}")));
            }
        }
    }
    lines.push(diagram.blank().text());
    if conversation.left_out > 0 {
        lines.push(format!("{} more letters", conversation.left_out));
    }
    let mut text = String::new();
    for line in lines {
        text.push_str(line.trim_end());
        text.push('\n');
    }
    text
}

struct Diagram<'a> {
    width: usize,
    spacing: usize,
    columns: usize,
    names: &'a [&'a str],
}

impl Diagram<'_> {
    /// The index of a participant's lifeline.
    fn column(&self, name: &str) -> usize {
        let place = self.names.iter().position(|other| *other == name);
        place.unwrap_or(0).min(self.columns - 1)
    }

    /// The screen column of a lifeline.
    fn x(&self, column: usize) -> usize {
        TIME + column * self.spacing
    }

    fn shared(&self, name: &str) -> bool {
        self.names.len() > self.columns && self.column(name) == self.columns - 1
    }

    fn head(&self) -> String {
        let mut line = Line::blank(self.width);
        for column in 0..self.columns {
            let others = self.names.len() - column;
            let name = match self.names.get(column) {
                Some(_) if column + 1 == self.columns && others > 1 => format!("{others} others"),
                Some(name) => (*name).to_owned(),
                None => String::new(),
            };
            line.put(self.x(column), &cut(&name, self.spacing - 2));
        }
        line.text()
    }

    /// A line with the lifelines alone.
    fn blank(&self) -> Line {
        let mut line = Line::blank(self.width);
        for column in 0..self.columns {
            line.put(self.x(column), "│");
        }
        line
    }

    fn arrow(&self, step: &Step, time: &str) -> [String; 2] {
        let (from, to) = (self.column(&step.from), self.column(&step.to));
        let (left, right) = (self.x(from.min(to)), self.x(from.max(to)));
        let mut label = step.label.clone();
        if let Some(failed) = &step.failed {
            label.push_str(&format!(": {failed}"));
        }
        // A shared lifeline does not identify the participant, so the label names it.
        if self.shared(&step.from) {
            label = format!("{}: {label}", step.from);
        }
        if self.shared(&step.to) {
            label.push_str(&format!(" → {}", step.to));
        }
        let mut label_line = self.blank();
        label_line.put(0, &cut(time, TIME - 1));
        let begin = left + 2;
        let own = if right > left {
            right - begin - 1
        } else {
            self.spacing - 3
        };
        // A long label covers lifelines right of the arrow instead of being cut.
        let room = self.width.saturating_sub(begin).max(own);
        label_line.put(begin, &cut(&label, room));
        let mut arrow = self.blank();
        if from == to {
            let corner = (left + 3).min(self.width.saturating_sub(1));
            arrow.put(left, "├");
            arrow.put(left + 1, &"─".repeat(corner - left - 1));
            arrow.put(corner, "╮");
            arrow.put(left + 1, if step.failed.is_some() { "✗" } else { "◄" });
            return [label_line.text(), arrow.text()];
        }
        for x in left + 1..right {
            arrow.put(x, "─");
        }
        for column in from.min(to) + 1..from.max(to) {
            arrow.put(self.x(column), "┼");
        }
        let head = match (&step.failed, to > from) {
            (Some(_), _) => "✗",
            (None, true) => "►",
            (None, false) => "◄",
        };
        let (start, end) = if to > from {
            ("├", right - 1)
        } else {
            ("┤", left + 1)
        };
        arrow.put(self.x(from), start);
        arrow.put(end, head);
        [label_line.text(), arrow.text()]
    }
}

/// A line of the diagram, column by column.
struct Line(Vec<Option<char>>);

impl Line {
    fn blank(width: usize) -> Self {
        Self(vec![Some(' '); width])
    }

    /// Overwrites the line from column `x`; characters beyond its end are omitted. A wide character takes
    /// two columns; the second one stays empty.
    fn put(&mut self, x: usize, text: &str) {
        let mut x = x;
        for c in text.chars() {
            let width = c.width().unwrap_or(0);
            let Some(cells) = self
                .0
                .get_mut(x..x + width)
                .filter(|cells| !cells.is_empty())
            else {
                continue;
            };
            cells.fill(None);
            if let Some(first) = cells.first_mut() {
                *first = Some(c);
            }
            x += width;
        }
    }

    fn text(&self) -> String {
        self.0.iter().flatten().collect()
    }
}

/// The text in lines of at most `width` columns, broken at spaces where possible.
fn wrapped(text: &str, width: usize) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in text.split(' ') {
        let width_of = unicode_width::UnicodeWidthStr::width;
        match lines.last_mut() {
            Some(line) if width_of(line.as_str()) + 1 + width_of(word) <= width => {
                line.push(' ');
                line.push_str(word);
            }
            _ => lines.push(cut(word, width)),
        }
    }
    lines
}

#[cfg(test)]
pub(super) mod tests;
