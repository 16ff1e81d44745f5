//! Sequence diagrams: letters between agents, from top to bottom.

use crate::Color;
use crate::canvas::{Anchor, Canvas, Font, MARGIN, Paint, Point, WIDTH};
use crate::text::{fit, name_lines, width, wrapped};

/// Maximum number of lines for arrows and notes.
const MAX_LINES: usize = 25;
/// Maximum number of lanes. Further agents share the last one.
const MAX_LANES: usize = 12;
/// Maximum number of steps that are read.
const MAX_STEPS: usize = 20_000;
/// Number of arrows between two equal ones that are folded together.
const NEAR: usize = 8;
/// Minimum distance of lanes.
const LANE: f64 = 112.0;
/// Maximum width of the times.
const TIME: f64 = 96.0;
const LABEL: f64 = 14.5;
const SMALL: f64 = 13.0;

/// A sequence diagram.
///
/// It has at most 25 lines. Repeated arrows between the same two lanes are folded into one with their number, for
/// example `align / inform × 14`. If there still are more lines, violations, failures and notes are kept, then the
/// first and the last arrows. A line tells how many are left out.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Sequence {
    /// Agents in their order from left to right. Agents of steps that are missing here follow in the order of their
    /// first steps.
    pub lanes: Vec<String>,
    /// Arrows and notes in the order of time.
    pub steps: Vec<Step>,
}

/// One event of a sequence diagram.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Step {
    /// A letter.
    Arrow(Arrow),
    /// A fact about one agent.
    Note(Note),
}

/// A letter.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Arrow {
    /// Lane of the sender.
    pub from: String,
    /// Lane of the receiver.
    pub to: String,
    /// Text above the arrow, for example the performative.
    pub label: String,
    /// Text at the left edge, for example `1.2 s`. May be empty.
    pub time: String,
    /// Reason why the letter violates its protocol. The arrow is red.
    pub violation: Option<String>,
    /// Reason why the letter was not delivered. The arrow ends with a cross.
    pub failed: Option<String>,
}

/// A fact about one agent, for example `killed`.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Note {
    /// Lane of the agent.
    pub lane: String,
    /// The text.
    pub text: String,
    /// Text at the left edge, for example `1.2 s`. May be empty.
    pub time: String,
}

/// A line of the drawing.
struct Line<'a> {
    kind: Kind<'a>,
    /// Number of steps before this line that are left out.
    left_out: usize,
    /// Number of steps that the line stands for.
    steps: usize,
}

enum Kind<'a> {
    Arrow(&'a Arrow),
    Note(&'a Note),
    Folded(Folded<'a>),
}

/// Repeated arrows between two lanes.
struct Folded<'a> {
    first: &'a Arrow,
    last: &'a Arrow,
    /// Labels with their numbers, in the order of their first arrows.
    labels: Vec<(&'a str, usize)>,
    /// Whether arrows go in both directions.
    both: bool,
}

impl Sequence {
    /// Draws the diagram as an SVG document.
    #[must_use]
    pub fn svg(&self) -> String {
        self.canvas().finish("Sequence diagram")
    }

    pub(crate) fn canvas(&self) -> Canvas {
        let steps = self.steps.get(..MAX_STEPS).unwrap_or(&self.steps);
        let unread = self.steps.len() - steps.len();
        let (lines, left_out) = chosen(folded(steps));
        let layout = Layout::of(&self.lanes, &lines);
        let mut rows = Canvas::new(layout.width);
        for line in &lines {
            layout.gap(&mut rows, line.left_out);
            match &line.kind {
                Kind::Arrow(arrow) => layout.arrow(&mut rows, arrow),
                Kind::Note(note) => layout.note(&mut rows, note),
                Kind::Folded(folded) => layout.folded(&mut rows, folded),
            }
        }
        layout.gap(&mut rows, left_out + unread);
        layout.around(&rows)
    }
}

/// Folds runs of repeated arrows. Notes, violations and failures end a run.
fn folded(steps: &[Step]) -> Vec<Line<'_>> {
    let plain = |step: &Step| match step {
        Step::Arrow(arrow) => arrow.violation.is_none() && arrow.failed.is_none(),
        Step::Note(_) => false,
    };
    let mut lines = Vec::new();
    for segment in steps.chunk_by(|one, next| plain(one) && plain(next)) {
        let arrows: Vec<&Arrow> = segment.iter().filter_map(Step::arrow).collect();
        if arrows.is_empty() || !segment.iter().all(plain) {
            lines.extend(segment.iter().map(Step::line));
            continue;
        }
        let repeated: Vec<bool> = (0..arrows.len())
            .map(|at| is_repeated(&arrows, at))
            .collect();
        let mut begin = 0;
        for chunk in repeated.chunk_by(|one, next| one == next) {
            let run = arrows.get(begin..begin + chunk.len()).unwrap_or_default();
            begin += chunk.len();
            match chunk {
                [true, ..] => groups(run, &mut lines),
                _ => lines.extend(run.iter().map(|arrow| Line::new(Kind::Arrow(arrow), 1))),
            }
        }
    }
    lines
}

/// Whether an equal arrow is near.
fn is_repeated(arrows: &[&Arrow], at: usize) -> bool {
    let near = at.saturating_sub(NEAR)..(at + NEAR + 1).min(arrows.len());
    let Some(this) = arrows.get(at) else {
        return false;
    };
    let mut others = near
        .filter(|other| *other != at)
        .filter_map(|other| arrows.get(other));
    others
        .any(|other| (&other.from, &other.to, &other.label) == (&this.from, &this.to, &this.label))
}

/// Adds a line for each pair of lanes of a run, or the arrows themselves if they are few.
fn groups<'a>(run: &[&'a Arrow], lines: &mut Vec<Line<'a>>) {
    let mut groups: Vec<Vec<&Arrow>> = Vec::new();
    for arrow in run {
        let same = |group: &&mut Vec<&Arrow>| {
            let first = group.first();
            first.is_some_and(|first| {
                (&first.from, &first.to) == (&arrow.from, &arrow.to)
                    || (&first.from, &first.to) == (&arrow.to, &arrow.from)
            })
        };
        match groups.iter_mut().find(same) {
            Some(group) => group.push(arrow),
            None => groups.push(vec![arrow]),
        }
    }
    if groups.iter().all(|group| group.len() < 3) {
        lines.extend(run.iter().map(|arrow| Line::new(Kind::Arrow(arrow), 1)));
        return;
    }
    for group in groups {
        let (Some(first), Some(last)) = (group.first(), group.last()) else {
            continue;
        };
        if group.len() < 3 {
            lines.extend(group.iter().map(|arrow| Line::new(Kind::Arrow(arrow), 1)));
            continue;
        }
        let mut labels: Vec<(&str, usize)> = Vec::new();
        for arrow in &group {
            match labels.iter_mut().find(|(label, _)| *label == arrow.label) {
                Some((_, count)) => *count += 1,
                None => labels.push((&arrow.label, 1)),
            }
        }
        let folded = Folded {
            first,
            last,
            labels,
            both: group.iter().any(|arrow| arrow.from != first.from),
        };
        lines.push(Line::new(Kind::Folded(folded), group.len()));
    }
}

/// Chooses the lines that are drawn. Returns them, and the number of steps that are left out after the last one.
fn chosen(lines: Vec<Line<'_>>) -> (Vec<Line<'_>>, usize) {
    let (marked, plain): (Vec<usize>, Vec<usize>) =
        (0..lines.len()).partition(|at| lines.get(*at).is_some_and(Line::is_marked));
    let marked = &marked[..marked.len().min(MAX_LINES)];
    let room = MAX_LINES - marked.len();
    let (start, end) = match plain.len() > room {
        true => (room.div_ceil(2), plain.len() - room / 2),
        false => (plain.len(), plain.len()),
    };
    let mut kept: Vec<usize> = [marked, &plain[..start], &plain[end..]].concat();
    kept.sort_unstable();
    let mut left_out = 0;
    let mut drawn = Vec::new();
    for (at, mut line) in lines.into_iter().enumerate() {
        if kept.binary_search(&at).is_ok() {
            line.left_out = std::mem::take(&mut left_out);
            drawn.push(line);
        } else {
            left_out += line.steps;
        }
    }
    (drawn, left_out)
}

impl Step {
    fn arrow(&self) -> Option<&Arrow> {
        match self {
            Self::Arrow(arrow) => Some(arrow),
            Self::Note(_) => None,
        }
    }

    fn line(&self) -> Line<'_> {
        match self {
            Self::Arrow(arrow) => Line::new(Kind::Arrow(arrow), 1),
            Self::Note(note) => Line::new(Kind::Note(note), 1),
        }
    }
}

impl<'a> Line<'a> {
    fn new(kind: Kind<'a>, steps: usize) -> Self {
        Self {
            kind,
            left_out: 0,
            steps,
        }
    }

    fn is_marked(&self) -> bool {
        match &self.kind {
            Kind::Arrow(arrow) => arrow.violation.is_some() || arrow.failed.is_some(),
            Kind::Note(_) => true,
            Kind::Folded(_) => false,
        }
    }

    fn names(&self) -> [&'a str; 2] {
        match &self.kind {
            Kind::Arrow(arrow) => [&arrow.from, &arrow.to],
            Kind::Note(note) => [&note.lane, &note.lane],
            Kind::Folded(folded) => [&folded.first.from, &folded.first.to],
        }
    }

    fn times(&self) -> [&'a str; 2] {
        match &self.kind {
            Kind::Arrow(arrow) => [&arrow.time, ""],
            Kind::Note(note) => [&note.time, ""],
            Kind::Folded(folded) => [&folded.first.time, &folded.last.time],
        }
    }
}

impl Folded<'_> {
    fn label(&self) -> String {
        let names: Vec<&str> = self.labels.iter().map(|(label, _)| *label).collect();
        match self.labels.as_slice() {
            [(_, first), others @ ..] if others.iter().all(|(_, count)| count == first) => {
                format!("{} × {first}", names.join(" / "))
            }
            labels => {
                let each = labels
                    .iter()
                    .map(|(label, count)| format!("{label} × {count}"));
                each.collect::<Vec<_>>().join(" / ")
            }
        }
    }
}

/// Positions of the columns.
struct Layout<'a> {
    names: Vec<&'a str>,
    width: f64,
    /// Left edge of the lanes.
    left: f64,
    /// Distance of the lanes.
    spacing: f64,
}

impl<'a> Layout<'a> {
    fn of(lanes: &'a [String], lines: &[Line<'a>]) -> Self {
        let mut names: Vec<&str> = Vec::new();
        let named = lanes.iter().map(String::as_str).take(MAX_LANES);
        for name in named.chain(lines.iter().flat_map(Line::names)) {
            if !names.contains(&name) && names.len() <= MAX_LANES {
                names.push(name);
            }
        }
        if names.len() > MAX_LANES {
            names.truncate(MAX_LANES - 1);
            names.push("others");
        }
        let times = lines
            .iter()
            .flat_map(Line::times)
            .map(|time| width(time, SMALL, false));
        let times = times.fold(0.0, f64::max).min(TIME - 12.0);
        let left = MARGIN + if times > 0.0 { times + 22.0 } else { 0.0 };
        let count = names.len().max(1) as f64;
        let spacing = ((WIDTH - left - MARGIN) / count).max(LANE);
        Self {
            names,
            width: left + spacing * count + MARGIN,
            left,
            spacing,
        }
    }

    fn lane(&self, name: &str) -> f64 {
        let at = self.names.iter().position(|other| *other == name);
        let at = at.unwrap_or(self.names.len().saturating_sub(1));
        self.left + self.spacing * (at as f64 + 0.5)
    }

    fn time(&self, rows: &mut Canvas, y: f64, time: &str) {
        let font = Font::new(SMALL).color(Color::GRAY).anchor(Anchor::End);
        rows.text_within((self.left - 10.0, y), font, time, TIME - 12.0);
    }

    /// Writes a text with its middle at a position as far as the edges allow.
    fn label(&self, rows: &mut Canvas, (x, y): Point, font: Font, text: &str) {
        let most = self.width - MARGIN - self.left;
        let text = fit(text, font.size, font.bold, most - 4.0);
        let half = width(&text, font.size, font.bold) / 2.0 + 2.0;
        let right = (self.width - MARGIN - half).max(self.left + half);
        let x = x.clamp(self.left + half, right);
        rows.text(
            (x, y),
            font.anchor(Anchor::Middle).cover(Color::WHITE),
            &text,
        );
    }

    fn arrow(&self, rows: &mut Canvas, arrow: &Arrow) {
        let (color, reason) = match (&arrow.violation, &arrow.failed) {
            (Some(why), _) => (Color::RED, Some(format!("violation: {why}"))),
            (None, Some(why)) => (Color::INK, Some(format!("not delivered: {why}"))),
            (None, None) => (Color::INK, None),
        };
        let (from, to, y) = (self.lane(&arrow.from), self.lane(&arrow.to), rows.height);
        self.time(rows, y + 21.0, &arrow.time);
        let font = Font::new(LABEL).color(color);
        let font = if arrow.violation.is_some() {
            font.bold()
        } else {
            font
        };
        self.label(
            rows,
            (f64::midpoint(from, to), y + 15.0),
            font,
            &arrow.label,
        );
        let weight = if arrow.violation.is_some() { 2.6 } else { 1.6 };
        let paint = Paint::edge(color, weight).dashed(arrow.failed.is_some());
        let way = Way {
            from,
            to,
            y: y + 23.0,
        };
        way.draw(rows, color, paint, arrow.failed.is_some());
        rows.height += if way.is_loop() { 42.0 } else { 34.0 };
        if let Some(reason) = reason {
            self.reason(rows, &reason, color);
        }
    }

    fn folded(&self, rows: &mut Canvas, folded: &Folded<'_>) {
        let (from, to, y) = (
            self.lane(&folded.first.from),
            self.lane(&folded.first.to),
            rows.height,
        );
        self.time(rows, y + 13.0, &folded.first.time);
        if folded.first.time != folded.last.time && !folded.last.time.is_empty() {
            self.time(rows, y + 28.0, &format!("– {}", folded.last.time));
        }
        let font = Font::new(LABEL).bold();
        self.label(
            rows,
            (f64::midpoint(from, to), y + 15.0),
            font,
            &folded.label(),
        );
        let way = Way {
            from,
            to,
            y: y + 24.0,
        };
        way.draw(rows, Color::INK, Paint::edge(Color::INK, 3.2), false);
        if folded.both && !way.is_loop() {
            rows.arrowhead((from, way.y), (from - to, 0.0), Color::INK);
        }
        rows.height += if way.is_loop() { 44.0 } else { 38.0 };
    }

    fn note(&self, rows: &mut Canvas, note: &Note) {
        let y = rows.height + 4.0;
        let most = self.width - MARGIN - self.left;
        let text = fit(&note.text, LABEL, false, most - 20.0);
        let length = width(&text, LABEL, false) + 20.0;
        let right = (self.width - MARGIN - length).max(self.left);
        let x = (self.lane(&note.lane) - length / 2.0).clamp(self.left, right);
        let paint = Paint::edge(Color(0xb0, 0x8a, 0x00), 1.2).with(Color(0xff, 0xf4, 0xc8));
        rows.rect((x, y), (length, 24.0), 4.0, paint);
        let font = Font::new(LABEL).anchor(Anchor::Middle);
        rows.text((x + length / 2.0, y + 17.0), font, &text);
        self.time(rows, y + 17.0, &note.time);
        rows.height += 36.0;
    }

    /// Writes the reason of a violation or failure below its arrow.
    fn reason(&self, rows: &mut Canvas, reason: &str, color: Color) {
        let (y, most) = (rows.height, self.width - MARGIN - self.left);
        let lines = wrapped(reason, SMALL, false, most - 24.0, 3);
        let height = lines.len() as f64 * 17.0 + 8.0;
        let light = if color == Color::RED {
            color.light()
        } else {
            Color::FAINT
        };
        rows.rect((self.left, y), (most, height), 3.0, Paint::fill(light));
        rows.rect((self.left, y), (4.0, height), 0.0, Paint::fill(color));
        for (at, line) in lines.iter().enumerate() {
            let y = y + 17.0 + at as f64 * 17.0;
            rows.text((self.left + 14.0, y), Font::new(SMALL), line);
        }
        rows.height += height + 6.0;
    }

    fn gap(&self, rows: &mut Canvas, left_out: usize) {
        if left_out == 0 {
            return;
        }
        let text = format!("… {left_out} more, not drawn");
        let middle = f64::midpoint(self.left, self.width - MARGIN);
        let font = Font::new(SMALL).color(Color::GRAY);
        self.label(rows, (middle, rows.height + 17.0), font, &text);
        rows.height += 28.0;
    }

    /// Adds the lanes to the rows.
    fn around(&self, rows: &Canvas) -> Canvas {
        let mut all = Canvas::new(self.width);
        let most = (self.spacing - 22.0).min(160.0);
        let names = self.names.iter().map(|name| name_lines(name, LABEL, most));
        let names: Vec<Vec<String>> = names.collect();
        let lines = names.iter().map(Vec::len).max().unwrap_or(1).max(1) as f64;
        let head = 12.0 + lines * 18.0;
        let bottom = head + 8.0 + rows.height + 6.0;
        for (name, lines) in self.names.iter().zip(&names) {
            let x = self.lane(name);
            all.line(
                (x, head),
                (x, bottom),
                Paint::edge(Color(0x9a, 0xa3, 0xad), 1.2),
            );
            let paint = Paint::edge(Color::INK, 1.2).with(Color(0xee, 0xf2, 0xf7));
            let half = (self.spacing - 10.0).min(180.0) / 2.0;
            all.rect((x - half, 1.0), (half * 2.0, head - 1.0), 5.0, paint);
            let top = (head - lines.len() as f64 * 18.0) / 2.0;
            for (at, line) in lines.iter().enumerate() {
                let font = Font::new(LABEL).bold().anchor(Anchor::Middle);
                all.text((x, top + 14.0 + at as f64 * 18.0), font, line);
            }
        }
        all.put((0.0, head + 8.0), rows);
        all.height = bottom + 2.0;
        all
    }
}

/// A horizontal arrow between two lanes, or a loop at one.
struct Way {
    from: f64,
    to: f64,
    y: f64,
}

impl Way {
    fn is_loop(&self) -> bool {
        (self.from - self.to).abs() < 1.0
    }

    fn draw(&self, rows: &mut Canvas, color: Color, paint: Paint, lost: bool) {
        let Self { from, to, y } = *self;
        let (end, direction) = match self.is_loop() {
            true => ((to, y + 10.0), -1.0),
            false => ((to, y), (to - from).signum()),
        };
        if self.is_loop() {
            let x = from + 26.0;
            let shaft = [(from, y), (x, y), (x, y + 10.0), (to + 6.0, y + 10.0)];
            rows.path(&shaft, false, paint);
        } else {
            rows.line((from, y), (to - direction * 6.0, y), paint);
        }
        if lost {
            let at = (end.0 - direction * 10.0, end.1);
            rows.cross(at, 6.0, Paint::edge(color, 2.4));
        } else {
            rows.arrowhead(end, (direction, 0.0), color);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn arrow(from: &str, to: &str, label: &str) -> Step {
        Step::Arrow(Arrow {
            from: from.to_owned(),
            to: to.to_owned(),
            label: label.to_owned(),
            ..Arrow::default()
        })
    }

    fn drawn(steps: Vec<Step>) -> String {
        let lanes = Vec::new();
        Sequence { lanes, steps }.svg()
    }

    #[test]
    fn repeated_arrows_are_folded() {
        let mut steps = vec![arrow("a", "b", "request"), arrow("b", "a", "agree")];
        for _ in 0..14 {
            steps.extend([arrow("a", "b", "align"), arrow("b", "a", "inform")]);
        }
        steps.push(arrow("b", "a", "done"));
        let svg = drawn(steps);
        assert!(svg.contains(">align / inform × 14<"), "{svg}");
        assert_eq!(svg.matches(">align").count(), 1);
        for text in [">request<", ">agree<", ">done<"] {
            assert!(svg.contains(text), "{svg}");
        }
    }

    #[test]
    fn interleaved_pairs_are_folded_each() {
        let mut steps = Vec::new();
        for _ in 0..5 {
            for arm in ["arm_1", "arm_2"] {
                steps.extend([arrow("dock", arm, "align"), arrow(arm, "dock", "inform")]);
            }
        }
        let svg = drawn(steps);
        assert_eq!(svg.matches(">align / inform × 5<").count(), 2, "{svg}");
    }

    #[test]
    fn different_arrows_and_single_repetitions_are_not_folded() {
        let steps = vec![
            arrow("a", "b", "cfp"),
            arrow("a", "c", "cfp"),
            arrow("b", "a", "propose"),
            arrow("c", "a", "propose"),
            arrow("a", "b", "query"),
            arrow("a", "b", "query"),
        ];
        let svg = drawn(steps);
        assert!(!svg.contains('×'), "{svg}");
    }

    #[test]
    fn violations_interrupt_a_run_and_are_kept() {
        let mut steps: Vec<Step> = Vec::new();
        for number in 0..100 {
            steps.push(arrow("a", "b", &format!("step {number}")));
        }
        steps.insert(
            50,
            Step::Arrow(Arrow {
                from: "a".to_owned(),
                to: "b".to_owned(),
                label: "inform".to_owned(),
                violation: Some("inform breaks fipa-request".to_owned()),
                ..Arrow::default()
            }),
        );
        let svg = drawn(steps);
        for text in [
            ">step 0<",
            ">step 99<",
            "violation: inform breaks",
            "… 38 more, not drawn",
        ] {
            assert!(svg.contains(text), "{text}: {svg}");
        }
        assert_eq!(svg.matches(">step ").count(), 24);
    }

    #[test]
    fn many_agents_share_the_last_lane() {
        let steps = (0..40).map(|number| arrow("a", &format!("arm_{number}"), "cfp"));
        let svg = drawn(steps.collect());
        assert!(svg.contains(">others<"), "{svg}");
        assert!(!svg.contains(">arm_11<"), "{svg}");
    }
}
