//! A state machine. The states are stacked in their order, each with its transitions. On the right, one line per
//! target state collects all transitions to that state. By construction no two elements overlap.

use crate::Color;
use crate::canvas::{Canvas, Font, Paint};
use crate::text::{fit, width};

const MARGIN: f64 = 24.0;
const ROW: f64 = 22.0;
const HEAD: f64 = 30.0;
const GAP: f64 = 14.0;
/// Distance between the lines on the right.
const TRACK: f64 = 18.0;
/// Width of a sign of the legend, with the gap behind it.
const SIGN: f64 = 42.0;
/// Font size.
const TEXT: f64 = 13.0;
/// Maximum width of a text.
const MAX_TEXT: f64 = 900.0;
/// Maximum number of states, and of rows of a state.
const MAX_STATES: usize = 300;
/// Left edge of the states.
const LEFT: f64 = 2.0 * MARGIN;
const INK: Color = Color(0x33, 0x33, 0x33);
const GRAY: Color = Color(0x55, 0x55, 0x55);
const FINAL: Color = Color(0xee, 0xf4, 0xea);
const CURRENT: Color = Color(0xff, 0xe0, 0x8a);

/// Colors of the roles. The last one is for all further ones.
const ROLES: [Color; 5] = [
    Color(0x1f, 0x5f, 0xa8),
    Color(0x2b, 0x7a, 0x3d),
    Color(0xa8, 0x57, 0x1f),
    Color(0x7a, 0x2b, 0x70),
    GRAY,
];
/// Colors of the lines.
const LINES: [Color; 6] = [
    Color(0x48, 0x78, 0xb0),
    Color(0x58, 0x96, 0x4f),
    Color(0xc0, 0x78, 0x30),
    Color(0x8a, 0x5a, 0x9c),
    Color(0xa0, 0x48, 0x48),
    Color(0x5a, 0x8c, 0x8c),
];

/// A protocol as a state machine.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Automaton {
    /// Heading.
    pub title: String,
    /// Roles, the initiator first. Their names are the legend of their colors.
    pub roles: Vec<String>,
    /// States from top to bottom, at most 300.
    pub states: Vec<State>,
    /// Index of the first state.
    pub initial: usize,
    /// Index of the state that is marked as the current one.
    pub current: Option<usize>,
    /// Further lines of the legend.
    pub legend: Vec<String>,
}

/// A state with its transitions.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct State {
    /// Name.
    pub name: String,
    /// Whether the conversation may end here.
    pub is_final: bool,
    /// Transitions from top to bottom, at most 300.
    pub rows: Vec<Row>,
}

/// A transition.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Row {
    /// Its message or event.
    pub text: String,
    /// Index of the role that causes it.
    pub role: Option<usize>,
    /// Whether its line is dashed.
    pub dashed: bool,
    /// Index of the state to which it leads.
    pub target: Option<usize>,
}

/// A state with its position.
struct Placed<'a> {
    state: &'a State,
    rows: &'a [Row],
    top: f64,
}

/// The line to a target state, with its track.
struct Track {
    target: usize,
    top: f64,
    bottom: f64,
    track: usize,
    /// Index into [`LINES`].
    color: usize,
}

impl Automaton {
    /// Draws the automaton as an SVG document.
    #[must_use]
    pub fn svg(&self) -> String {
        let placed = self.placed();
        let texts = placed.iter().flat_map(|one| {
            let name = width(&one.state.name, TEXT, true) + 24.0;
            let rows = one
                .rows
                .iter()
                .map(|row| width(&row.text, TEXT, false) + 44.0);
            rows.chain([name])
        });
        let boxes = texts.fold(80.0, f64::max).min(MAX_TEXT);
        let lines = tracks(&placed);
        let tracks = lines.iter().map(|line| line.track + 1).max().unwrap_or(0);
        let roles = self.roles.iter().map(|role| role_width(role)).sum::<f64>();
        let signs = self.legend.iter().map(|text| width(text, TEXT, false));
        let legend = signs.fold(230.0, f64::max).min(MAX_TEXT) + SIGN;
        let title = width(&self.title, 15.0, true).min(MAX_TEXT);
        let right = [title, roles, legend].into_iter().fold(0.0, f64::max) + 2.0 * MARGIN;

        let mut out = Canvas::new(right.max(LEFT + boxes + (tracks + 2) as f64 * TRACK + MARGIN));
        out.text_within(
            (MARGIN, 30.0),
            Font::new(15.0).bold(),
            &self.title,
            MAX_TEXT,
        );
        let mut x = MARGIN;
        for (at, role) in self.roles.iter().enumerate() {
            let color = role_color(Some(at));
            out.circle((x + 5.0, 52.0), 5.0, Paint::fill(color));
            out.text((x + 16.0, 57.0), Font::new(TEXT).color(color), role);
            x += role_width(role);
        }
        for line in &lines {
            line.draw(&placed, LEFT + boxes, &mut out);
        }
        for (at, one) in placed.iter().enumerate() {
            one.draw(
                boxes,
                at == self.initial,
                self.current == Some(at),
                &mut out,
            );
            for (number, row) in one.rows.iter().enumerate() {
                let y = middle(one, number);
                draw_row(row, y, boxes, &lines, &mut out);
            }
        }
        let end = placed
            .last()
            .map_or(MARGIN + 56.0, |last| last.top + last.height());
        self.draw_legend(end + MARGIN, &mut out);
        out.finish(&self.title)
    }

    fn placed(&self) -> Vec<Placed<'_>> {
        let mut top = MARGIN + 56.0;
        let states = self.states.iter().take(MAX_STATES).map(|state| {
            let rows = state.rows.get(..MAX_STATES).unwrap_or(&state.rows);
            let placed = Placed { state, rows, top };
            top += placed.height() + GAP;
            placed
        });
        states.collect()
    }

    /// Draws the legend. The colors of the roles are above the states.
    fn draw_legend(&self, mut y: f64, out: &mut Canvas) {
        let x = MARGIN;
        out.circle((x + 6.0, y), 6.0, Paint::fill(INK));
        out.arrowhead((x + 30.0, y), (1.0, 0.0), INK);
        let box_at = y + ROW;
        let edge = Paint::edge(INK, 1.0);
        out.rect((x, box_at - 8.0), (30.0, 16.0), 5.0, edge.with(FINAL));
        out.rect((x + 3.0, box_at - 5.0), (24.0, 10.0), 3.0, edge);
        let dashes = y + 2.0 * ROW;
        let [first, ..] = LINES;
        out.line(
            (x, dashes),
            (x + 30.0, dashes),
            Paint::edge(first, 1.6).dashed(true),
        );
        let signs = [
            "the first state",
            "the conversation may end here",
            "an optional step, or a timeout",
        ];
        for text in signs
            .into_iter()
            .chain(self.legend.iter().map(String::as_str))
        {
            let font = Font::new(TEXT).color(GRAY);
            out.text_within((x + SIGN, y + 5.0), font, text, MAX_TEXT);
            y += ROW;
        }
        out.height = y + MARGIN;
    }
}

impl Placed<'_> {
    fn height(&self) -> f64 {
        HEAD + self.rows.len() as f64 * ROW + if self.rows.is_empty() { 0.0 } else { 6.0 }
    }

    /// Returns the height of the arrow to this state.
    fn entry(&self) -> f64 {
        self.top + HEAD / 2.0
    }

    fn draw(&self, boxes: f64, is_initial: bool, is_current: bool, out: &mut Canvas) {
        let (top, height, y) = (self.top, self.height(), self.entry());
        let fill = match (is_current, self.state.is_final) {
            (true, _) => CURRENT,
            (false, true) => FINAL,
            (false, false) => Color(0xf4, 0xf6, 0xfa),
        };
        let edge = Paint::edge(INK, if is_current { 3.0 } else { 1.0 });
        out.rect((LEFT, top), (boxes, height), 8.0, edge.with(fill));
        if self.state.is_final {
            let inner = (boxes - 6.0, height - 6.0);
            out.rect((LEFT + 3.0, top + 3.0), inner, 6.0, edge);
        }
        if is_initial {
            out.circle((MARGIN, y), 6.0, Paint::fill(INK));
            out.line((MARGIN, y), (LEFT - 6.0, y), Paint::edge(INK, 1.5));
            out.arrowhead((LEFT, y), (1.0, 0.0), INK);
        }
        let font = Font::new(TEXT).bold();
        out.text_within((LEFT + 12.0, y + 5.0), font, &self.state.name, boxes - 24.0);
    }
}

impl Track {
    fn x(&self, end: f64) -> f64 {
        end + (self.track + 1) as f64 * TRACK
    }

    fn color(&self) -> Color {
        LINES.get(self.color).copied().unwrap_or(GRAY)
    }

    /// Whether two lines would overlap in one track.
    fn meets(&self, other: &Self) -> bool {
        other.top < self.bottom + 6.0 && self.top < other.bottom + 6.0
    }

    fn draw(&self, placed: &[Placed<'_>], end: f64, out: &mut Canvas) {
        let Some(target) = placed.get(self.target) else {
            return;
        };
        let (x, y, paint) = (self.x(end), target.entry(), Paint::edge(self.color(), 1.6));
        out.line((x, self.top), (x, self.bottom), paint);
        out.line((x, y), (end + 8.0, y), paint);
        out.arrowhead((end, y), (-1.0, 0.0), self.color());
    }
}

/// Returns one line per state with incoming transitions. Lines that would overlap run in different tracks.
fn tracks(placed: &[Placed<'_>]) -> Vec<Track> {
    let mut ends: Vec<Option<(f64, f64)>> = vec![None; placed.len()];
    for from in placed {
        for (number, row) in from.rows.iter().enumerate() {
            let target = row
                .target
                .and_then(|at| Some((placed.get(at)?, ends.get_mut(at)?)));
            if let Some((to, ends)) = target {
                let y = middle(from, number);
                let (top, bottom) = ends.unwrap_or((to.entry(), to.entry()));
                *ends = Some((top.min(y), bottom.max(y)));
            }
        }
    }
    let lines = ends.into_iter().enumerate().filter_map(|(target, ends)| {
        let (top, bottom) = ends?;
        Some(Track {
            target,
            top,
            bottom,
            track: 0,
            color: 0,
        })
    });
    let mut lines: Vec<Track> = lines.collect();
    // Short lines get the inner tracks, so that long lines run around them.
    lines.sort_by(|a, b| (a.bottom - a.top).total_cmp(&(b.bottom - b.top)));
    for at in 0..lines.len() {
        let (before, rest) = lines.split_at_mut(at);
        let Some(line) = rest.first_mut() else {
            continue;
        };
        let taken = |track: usize| before.iter().any(|it| it.track == track && it.meets(line));
        line.track = (0..).find(|track| !taken(*track)).unwrap_or(0);
        // Lines that cross have different colors, as far as there are enough colors.
        let used = |color: usize, all: bool| {
            let same = before.iter().filter(|other| other.color == color);
            same.filter(|other| all || other.meets(line)).count()
        };
        let colors = 0..LINES.len();
        line.color = colors
            .min_by_key(|color| (used(*color, false), used(*color, true)))
            .unwrap_or(0);
    }
    lines
}

/// Returns the height of the connection of a transition.
fn middle(placed: &Placed<'_>, row: usize) -> f64 {
    placed.top + HEAD + row as f64 * ROW + ROW / 2.0 - 2.0
}

/// Draws a transition in the box of its state, and its connection to the line of its target.
fn draw_row(row: &Row, y: f64, boxes: f64, lines: &[Track], out: &mut Canvas) {
    let color = row
        .role
        .map_or(Color(0x66, 0x66, 0x66), |role| role_color(Some(role)));
    out.circle((LEFT + 20.0, y), 4.0, Paint::fill(color));
    let text = fit(&row.text, TEXT, false, boxes - 44.0);
    out.text((LEFT + 32.0, y + 5.0), Font::new(TEXT).color(color), &text);
    let target = row
        .target
        .and_then(|target| lines.iter().find(|line| line.target == target));
    if let Some(line) = target {
        let end = line.x(LEFT + boxes);
        let paint = Paint::edge(line.color(), 1.6).dashed(row.dashed);
        out.line((LEFT + boxes, y), (end, y), paint);
        out.circle((end, y), 2.6, Paint::fill(line.color()));
    }
}

fn role_width(role: &str) -> f64 {
    width(role, TEXT, false) + 34.0
}

fn role_color(role: Option<usize>) -> Color {
    let last = ROLES.len() - 1;
    let at = role.map_or(last, |role| role.min(last));
    ROLES.get(at).copied().unwrap_or(GRAY)
}
