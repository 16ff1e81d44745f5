//! A protocol as SVG. The states are stacked in the order of the file, each with its transitions. On
//! the right, one line per target state collects all transitions to that state. By construction no
//! two elements overlap, for any protocol.

use std::fmt::Write as _;

use fipa::monitor::{Machine, State};
use fipa_acl::escape;

use super::{CONDITIONS, act, conditions, defaults, role, within};

const MARGIN: usize = 24;
const ROW: usize = 22;
const HEAD: usize = 30;
const GAP: usize = 14;
/// Distance between the lines on the right.
const TRACK: usize = 18;
/// Width of a sign of the legend, with the gap behind it.
const SIGN: usize = 42;
/// Approximate width of a character: fonts differ.
const CHAR: usize = 8;

/// Colors of the roles, the initiator's first.
const ROLES: [&str; 5] = ["#1f5fa8", "#2b7a3d", "#a8571f", "#7a2b70", "#555555"];
/// Colors of the lines.
const LINES: [&str; 6] = [
    "#4878b0", "#58964f", "#c07830", "#8a5a9c", "#a04848", "#5a8c8c",
];

/// A text row in the box of a state.
struct Row {
    text: String,
    color: &'static str,
    dashed: bool,
    target: Option<usize>,
}

struct Placed<'m> {
    name: &'m str,
    is_final: bool,
    rows: Vec<Row>,
    top: usize,
}

/// The line to a target state, with its track.
struct Line {
    target: usize,
    top: usize,
    bottom: usize,
    track: usize,
    /// Index into [`LINES`].
    color: usize,
}

/// Draws a protocol, with the transitions that every protocol has if `with_defaults` is set.
pub(super) fn svg(machine: &Machine, with_defaults: bool) -> String {
    let title = match machine.title() {
        Some(title) => format!("{}: {title}", machine.name()),
        None => machine.name().to_owned(),
    };
    let placed = placed(machine, with_defaults);
    let texts = placed.iter().flat_map(|one| {
        let rows = one.rows.iter().map(|row| row.text.chars().count());
        rows.chain([one.name.chars().count() + 4])
    });
    let width = texts.max().unwrap_or(0) * CHAR + 3 * MARGIN;
    let lines = lines(&placed);
    let tracks = lines.iter().map(|line| line.track + 1).max().unwrap_or(0);
    let legend: usize = machine
        .roles()
        .iter()
        .map(|role| role.chars().count() * CHAR + 34)
        .sum();
    let right = (2 * MARGIN + width + (tracks + 1) * TRACK + MARGIN)
        .max(title.chars().count() * (CHAR + 1) + 2 * MARGIN)
        .max(legend + 2 * MARGIN);
    let end = placed.last().map_or(0, |last| last.top + height(last)) + MARGIN;
    let signs = signs();
    let bottom = end + signs.len() * ROW + MARGIN;
    let longest = signs.iter().map(|sign| sign.text.chars().count()).max();
    let right = right.max(longest.unwrap_or(0) * CHAR + SIGN + 3 * MARGIN);

    let mut out = String::new();
    // Writing to a string cannot fail.
    let _ = writeln!(
        out,
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{right}\" height=\"{bottom}\" \
         viewBox=\"0 0 {right} {bottom}\" font-family=\"DejaVu Sans, Helvetica, Arial, sans-serif\" \
         font-size=\"13\">\n<title>{0}</title>\n\
         <rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n\
         <text x=\"{MARGIN}\" y=\"30\" font-size=\"15\" font-weight=\"bold\">{0}</text>",
        escaped(&title)
    );
    roles(&mut out, machine);
    for line in &lines {
        line_to(&mut out, line, &placed, MARGIN * 2 + width);
    }
    let own = machine.states().len();
    for (number, one) in placed.iter().enumerate() {
        let initial = number < own && one.name == machine.initial().id();
        state(&mut out, one, width, initial);
        for (number, row) in one.rows.iter().enumerate() {
            let y = one.top + HEAD + number * ROW;
            leading(&mut out, row, y, width, &lines);
        }
    }
    for (number, sign) in signs.iter().enumerate() {
        let y = end + number * ROW;
        let _ = writeln!(
            out,
            "{}<text x=\"{}\" y=\"{}\" fill=\"#555555\">{}</text>",
            (sign.draw)(MARGIN, y),
            MARGIN + SIGN,
            y + 5,
            escaped(sign.text)
        );
    }
    out.push_str("</svg>\n");
    out
}

/// A line of the legend.
struct Sign {
    /// Draws the sign at the left end of the line.
    draw: fn(usize, usize) -> String,
    text: &'static str,
}

/// Returns the legend. The colors of the roles are above the states.
fn signs() -> Vec<Sign> {
    let initial = |x, y| {
        format!(
            "<circle cx=\"{}\" cy=\"{y}\" r=\"6\" fill=\"#333333\"/>{}",
            x + 6,
            arrow_right(x + 30, y, "#333333")
        )
    };
    let last = |x: usize, y: usize| {
        format!(
            "<rect x=\"{x}\" y=\"{}\" width=\"30\" height=\"16\" rx=\"5\" fill=\"#eef4ea\" \
             stroke=\"#333333\"/><rect x=\"{}\" y=\"{}\" width=\"24\" height=\"10\" rx=\"3\" \
             fill=\"none\" stroke=\"#333333\"/>",
            y - 8,
            x + 3,
            y - 5
        )
    };
    let dashed = |x, y| {
        format!(
            "<path d=\"M {x} {y} H {}\" fill=\"none\" stroke=\"{}\" stroke-width=\"1.6\" \
             stroke-dasharray=\"5 4\"/>",
            x + 30,
            LINES[0]
        )
    };
    let drawn: [Sign; 3] = [
        Sign {
            draw: initial,
            text: "the first state",
        },
        Sign {
            draw: last,
            text: "the conversation may end here",
        },
        Sign {
            draw: dashed,
            text: "an optional step, or a timeout",
        },
    ];
    let words = CONDITIONS.iter().map(|text| Sign {
        draw: |_, _| String::new(),
        text,
    });
    drawn.into_iter().chain(words).collect()
}

fn height(placed: &Placed<'_>) -> usize {
    HEAD + placed.rows.len() * ROW + if placed.rows.is_empty() { 0 } else { 6 }
}

fn placed(machine: &Machine, with_defaults: bool) -> Vec<Placed<'_>> {
    let own = machine.states().iter().map(|state| Placed {
        name: state.id(),
        is_final: state.is_final(),
        rows: rows(machine, state),
        top: 0,
    });
    let mut all: Vec<Placed<'_>> = own.collect();
    if with_defaults {
        let first = all.len();
        let defaults = defaults::of(machine);
        let number = |name| defaults.iter().position(|state| state.name == name);
        for state in &defaults {
            let rows = state.steps.iter().map(|step| Row {
                text: step.label.clone(),
                color: "#555555",
                dashed: false,
                // The state before is one of the protocol.
                target: step.target.map_or(Some(0), number).map(|at| first + at),
            });
            all.push(Placed {
                name: state.name,
                is_final: state.is_final,
                rows: rows.collect(),
                top: 0,
            });
        }
    }
    let mut top = MARGIN + 56;
    for one in &mut all {
        one.top = top;
        top += height(one) + GAP;
    }
    all
}

fn rows(machine: &Machine, state: &State) -> Vec<Row> {
    let number = |id: &str| machine.states().iter().position(|state| state.id() == id);
    let messages = state.transitions().iter().map(|step| {
        let conditions = conditions(step);
        let to = if machine.roles().len() > 2 {
            format!(" to {}", role(step.to()))
        } else {
            String::new()
        };
        Row {
            text: format!("{}: {}{to}{conditions}", role(step.from()), act(step)),
            color: color(machine, step.from()),
            dashed: step.is_optional(),
            target: number(machine.target(step)),
        }
    });
    let timeouts = state.timeout().map(|timeout| Row {
        text: format!("after {}", super::after(timeout.after())),
        color: "#777777",
        dashed: true,
        target: number(machine.timeout_target(timeout)),
    });
    let within = state.subprotocols().iter().map(|sub| {
        let answers = sub
            .proxied_to()
            .map(|to| format!(", answers to {}", role(to)));
        Row {
            text: format!(
                "{}: starts {}{}",
                role(sub.from()),
                within(sub),
                answers.unwrap_or_default()
            ),
            color: color(machine, sub.from()),
            dashed: false,
            target: None,
        }
    });
    messages.chain(timeouts).chain(within).collect()
}

fn color(machine: &Machine, role: &str) -> &'static str {
    let mut others = machine
        .roles()
        .iter()
        .filter(|other| *other != machine.initiator());
    let number = if role == machine.initiator() {
        0
    } else {
        others
            .position(|other| other == role)
            .map_or(ROLES.len() - 1, |at| at + 1)
    };
    ROLES[number.min(ROLES.len() - 1)]
}

/// One line per state with incoming transitions. Lines that would overlap run in different tracks.
fn lines(placed: &[Placed<'_>]) -> Vec<Line> {
    let mut lines: Vec<Line> = Vec::new();
    for (target, to) in placed.iter().enumerate() {
        let arrow = to.top + HEAD / 2;
        let mut ends = vec![arrow];
        for from in placed {
            for (number, row) in from.rows.iter().enumerate() {
                if row.target == Some(target) {
                    ends.push(middle(from.top + HEAD + number * ROW));
                }
            }
        }
        if ends.len() > 1 {
            lines.push(Line {
                target,
                top: ends.iter().copied().min().unwrap_or(arrow),
                bottom: ends.iter().copied().max().unwrap_or(arrow),
                track: 0,
                color: 0,
            });
        }
    }
    // Short lines get the inner tracks, so that long lines run around them.
    lines.sort_by_key(|line| line.bottom - line.top);
    for at in 0..lines.len() {
        let (before, rest) = lines.split_at_mut(at);
        let Some(line) = rest.first_mut() else {
            continue;
        };
        let overlaps = |other: &Line| other.top < line.bottom + 6 && line.top < other.bottom + 6;
        let taken = |track: usize| before.iter().any(|it| it.track == track && overlaps(it));
        line.track = (0..).find(|track| !taken(*track)).unwrap_or(0);
        // Lines that cross have different colors, as far as there are enough colors.
        let used = |color: usize, all: bool| {
            let same = before.iter().filter(|other| other.color == color);
            same.filter(|other| all || overlaps(other)).count()
        };
        let colors = 0..LINES.len();
        line.color = colors
            .min_by_key(|color| (used(*color, false), used(*color, true)))
            .unwrap_or(0);
    }
    lines
}

fn middle(row: usize) -> usize {
    row + ROW / 2 - 2
}

fn track_x(width_end: usize, track: usize) -> usize {
    width_end + (track + 1) * TRACK
}

fn roles(out: &mut String, machine: &Machine) {
    let mut x = MARGIN;
    let others = machine
        .roles()
        .iter()
        .filter(|role| *role != machine.initiator());
    for role in std::iter::once(machine.initiator()).chain(others.map(String::as_str)) {
        let color = color(machine, role);
        let _ = writeln!(
            out,
            "<circle cx=\"{}\" cy=\"52\" r=\"5\" fill=\"{color}\"/>\
             <text x=\"{}\" y=\"57\" fill=\"{color}\">{}</text>",
            x + 5,
            x + 16,
            escaped(role)
        );
        x += role.chars().count() * CHAR + 34;
    }
}

fn state(out: &mut String, placed: &Placed<'_>, width: usize, initial: bool) {
    let (x, top, height) = (2 * MARGIN, placed.top, height(placed));
    let fill = if placed.is_final {
        "#eef4ea"
    } else {
        "#f4f6fa"
    };
    let _ = writeln!(
        out,
        "<rect x=\"{x}\" y=\"{top}\" width=\"{width}\" height=\"{height}\" rx=\"8\" \
         fill=\"{fill}\" stroke=\"#333333\"/>"
    );
    if placed.is_final {
        let _ = writeln!(
            out,
            "<rect x=\"{}\" y=\"{}\" width=\"{}\" height=\"{}\" rx=\"6\" fill=\"none\" \
             stroke=\"#333333\"/>",
            x + 3,
            top + 3,
            width - 6,
            height - 6
        );
    }
    if initial {
        let y = top + HEAD / 2;
        let _ = writeln!(
            out,
            "<circle cx=\"{}\" cy=\"{y}\" r=\"6\" fill=\"#333333\"/>\
             <path d=\"M {} {y} H {}\" stroke=\"#333333\" stroke-width=\"1.5\"/>{}",
            MARGIN,
            MARGIN,
            x - 6,
            arrow_right(x, y, "#333333")
        );
    }
    let _ = writeln!(
        out,
        "<text x=\"{}\" y=\"{}\" font-weight=\"bold\">{}</text>",
        x + 12,
        top + HEAD / 2 + 5,
        escaped(placed.name)
    );
}

/// Draws a row of a state's box, and its connection to the line of its target.
fn leading(out: &mut String, row: &Row, y: usize, width: usize, lines: &[Line]) {
    let x = 2 * MARGIN;
    let y = middle(y);
    let _ = writeln!(
        out,
        "<circle cx=\"{}\" cy=\"{y}\" r=\"4\" fill=\"{}\"/>\
         <text x=\"{}\" y=\"{}\" fill=\"{}\">{}</text>",
        x + 20,
        row.color,
        x + 32,
        y + 5,
        row.color,
        escaped(&row.text)
    );
    let line = row
        .target
        .and_then(|target| lines.iter().find(|line| line.target == target));
    if let Some(line) = line {
        let color = LINES[line.color];
        let dashes = if row.dashed {
            " stroke-dasharray=\"5 4\""
        } else {
            ""
        };
        let end = track_x(x + width, line.track);
        let _ = writeln!(
            out,
            "<path d=\"M {} {y} H {end}\" fill=\"none\" stroke=\"{color}\" \
             stroke-width=\"1.6\"{dashes}/><circle cx=\"{end}\" cy=\"{y}\" r=\"2.6\" \
             fill=\"{color}\"/>",
            x + width
        );
    }
}

fn line_to(out: &mut String, line: &Line, placed: &[Placed<'_>], end: usize) {
    let Some(target) = placed.get(line.target) else {
        return;
    };
    let color = LINES[line.color];
    let (x, y) = (track_x(end, line.track), target.top + HEAD / 2);
    let _ = writeln!(
        out,
        "<path d=\"M {x} {} V {}\" fill=\"none\" stroke=\"{color}\" stroke-width=\"1.6\"/>\
         <path d=\"M {x} {y} H {}\" fill=\"none\" stroke=\"{color}\" stroke-width=\"1.6\"/>{}",
        line.top,
        line.bottom,
        end + 8,
        arrow_left(end, y, color)
    );
}

fn arrow_left(x: usize, y: usize, color: &str) -> String {
    let (tail, up, down) = (x + 9, y - 5, y + 5);
    format!("<path d=\"M {x} {y} L {tail} {up} V {down} Z\" fill=\"{color}\"/>")
}

fn arrow_right(x: usize, y: usize, color: &str) -> String {
    let (tail, up, down) = (x - 9, y - 5, y + 5);
    format!("<path d=\"M {x} {y} L {tail} {up} V {down} Z\" fill=\"{color}\"/>")
}

fn escaped(text: &str) -> String {
    let mut out = String::new();
    for c in escape(text).chars() {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            c => out.push(c),
        }
    }
    out
}
