//! Draws the domain on a terminal.

use ratatui::Frame;
use ratatui::buffer::Buffer;
use ratatui::layout::Rect;
use ratatui::style::{Color, Modifier, Style};
use ratatui::text::{Line, Span};
use unicode_width::UnicodeWidthStr;

use super::peers::{PeerRow, PeerState};
use super::table::{self, AgentRow, Column, Header, PEER_TITLES, Snapshot};
use super::view::View;
use crate::command::watch::text::time_of_day;
use crate::output::{cut, fitted};

/// Widths of the cells of hosts (`None` for the rest of the line), and the width of the terminal from which they are
/// shown.
const PEER_COLUMNS: [(Option<usize>, usize); 9] = [
    (None, 0),
    (Some(12), 0),
    (Some(6), 0),
    (Some(6), 0),
    (Some(8), 50),
    (Some(8), 100),
    (Some(11), 80),
    (Some(9), 60),
    (Some(7), 68),
];

/// The cells of hosts that are aligned to the left.
const PEER_TEXTS: [usize; 4] = [0, 1, 6, 7];

/// Number of lines from which blank ones separate the tables.
const ROOMY: usize = 12;

const HELP: [&str; 18] = [
    "q Ctrl-C   quit",
    "< > ← →    sort by the column before or after; 1 to 8 sort by a column",
    "r          reverse the order",
    "/          show only agents with a name or names that match a pattern",
    "Esc        show all agents again",
    "p Space    pause, continue",
    "↑ ↓ PgUp PgDn Home   scroll the agents",
    "",
    "SENT RECV  letters per second that the agent sends and receives",
    "FAIL       its letters per second that fail",
    "VIOL       its letters so far that violate their protocols",
    "MEDIAN P99 time from sending a letter to its outcome",
    "VIA        the transport that carries most of its letters",
    "TO FROM    letters per second to and from the agents of the host",
    "RETRIES    attempts to send to the host that failed or were rejected",
    "",
    "Rates and times cover the last seconds.",
    "Any key closes this page.",
];

/// The colors of the screen, or only bold, dim and reversed texts.
#[derive(Debug, Clone, Copy)]
pub(super) struct Palette {
    pub(super) color: bool,
}

impl Palette {
    fn colored(self, color: Color) -> Style {
        match self.color {
            true => Style::new().fg(color),
            false => Style::new(),
        }
    }

    fn bad(self) -> Style {
        self.colored(Color::Red).add_modifier(Modifier::BOLD)
    }

    fn warning(self) -> Style {
        self.colored(Color::Yellow)
    }

    fn good(self) -> Style {
        self.colored(Color::Green)
    }

    fn quiet() -> Style {
        Style::new().add_modifier(Modifier::DIM)
    }

    fn title() -> Style {
        Style::new().add_modifier(Modifier::REVERSED)
    }
}

/// The lines of a rectangle, from the top.
struct Lines<'a> {
    buffer: &'a mut Buffer,
    area: Rect,
    next: u16,
}

impl Lines<'_> {
    fn width(&self) -> usize {
        usize::from(self.area.width)
    }

    fn left(&self) -> usize {
        usize::from(self.area.height.saturating_sub(self.next))
    }

    fn put<'s>(&mut self, line: impl Into<Line<'s>>) {
        if self.left() > 0 {
            let y = self.area.y + self.next;
            self.buffer
                .set_line(self.area.x, y, &line.into(), self.area.width);
            self.next += 1;
        }
    }
}

/// Draws the screen.
pub(super) fn draw(frame: &mut Frame<'_>, snapshot: &Snapshot, view: &View, palette: Palette) {
    let area = frame.area();
    let mut lines = Lines {
        buffer: frame.buffer_mut(),
        area,
        next: 0,
    };
    if view.help {
        let width = lines.width();
        for line in HELP {
            lines.put(cut(line, width));
        }
        return;
    }
    header(&mut lines, &snapshot.header, view, palette);
    // The footer has the last line; the hosts have at most a third of the rest, or two lines.
    let room = lines.left().saturating_sub(1);
    let blank = usize::from(room >= ROOMY);
    let for_peers = match snapshot.peers.len() {
        0 => 0,
        _ if room < 5 => 0,
        peers => (peers + 1 + blank).min((room / 3).max(2)),
    };
    agents(&mut lines, snapshot, view, palette, room - for_peers);
    if for_peers > 0 {
        if blank > 0 {
            lines.put("");
        }
        peers(&mut lines, &snapshot.peers, palette, for_peers - blank);
    }
    while lines.left() > 1 {
        lines.put("");
    }
    footer(&mut lines, view, palette);
}

fn header(lines: &mut Lines<'_>, header: &Header, view: &View, palette: Palette) {
    let bold = Style::new().add_modifier(Modifier::BOLD);
    let there = &header.surroundings;
    let width = lines.width();
    let paused = if view.paused { " PAUSED " } else { "" };
    let time = format!("{} UTC", time_of_day(there.time, 8));
    let title = format!(
        "fipa top: domain {} on {}",
        fipa_acl::escape_name(&there.domain),
        fipa_acl::escape_name(&there.host)
    );
    let for_title = width.saturating_sub(paused.len() + time.len() + 2);
    lines.put(vec![
        Span::styled(fitted(&title, for_title), bold),
        Span::styled(paused, palette.warning().add_modifier(Modifier::REVERSED)),
        Span::raw(format!("  {time}")),
    ]);
    let gateway = match &there.gateway {
        Some(name) => format!("gateway {}", fipa_acl::escape_name(name)),
        None => "no gateway".to_owned(),
    };
    let agents = format!("agents {} here, {} elsewhere", there.here, there.elsewhere);
    let processes = format!("processes {}", there.processes);
    let plain = |text: String| (text, Style::new());
    flow(lines, [agents, processes, gateway].map(plain));
    let rates = &header.rates;
    let counted = |text: String, value: f64, style: Style| match value > 0.0 {
        true => (text, style),
        false => (text, Style::new()),
    };
    let violations = header.total.violations;
    let median = table::time(header.latency.map(|it| it.median));
    let percentile_99 = table::time(header.latency.map(|it| it.percentile_99));
    let numbers = [
        plain(format!("letters {}/s", table::rate(rates.sent))),
        counted(
            format!("failures {}/s", table::rate(rates.failed)),
            rates.failed,
            palette.warning(),
        ),
        counted(
            format!("violations {}", table::count(violations)),
            violations as f64,
            palette.bad(),
        ),
        counted(
            format!("lost {}", table::count(header.lost)),
            header.lost as f64,
            palette.warning(),
        ),
        plain(format!("median {median}")),
        plain(format!("p99 {percentile_99}")),
    ];
    flow(lines, numbers);
    if let Some(problem) = &there.problem {
        lines.put(Span::styled(cut(problem, width), palette.warning()));
    }
    if lines.left() > ROOMY {
        lines.put("");
    }
}

/// Puts texts side by side, on as many lines as they need.
fn flow<const N: usize>(lines: &mut Lines<'_>, texts: [(String, Style); N]) {
    const GAP: &str = "  ";
    let width = lines.width();
    let (mut spans, mut used) = (Vec::new(), 0);
    for (text, style) in texts {
        let text = cut(&text, width);
        if !spans.is_empty() && used + GAP.len() + text.width() > width {
            lines.put(std::mem::take(&mut spans));
            used = 0;
        }
        if !spans.is_empty() {
            spans.push(Span::raw(GAP));
            used += GAP.len();
        }
        used += text.width();
        spans.push(Span::styled(text, style));
    }
    lines.put(spans);
}

/// Draws the agents in at most this number of lines.
fn agents(
    lines: &mut Lines<'_>,
    snapshot: &Snapshot,
    view: &View,
    palette: Palette,
    height: usize,
) {
    let rows = snapshot.sorted(view.order, view.filter.as_ref().map(|it| &it.matcher));
    let width = lines.width();
    let columns = Column::ALL.map(|column| (column.width(), column.shown_from()));
    let widths = widths(&columns, width);
    let titles = Column::ALL.map(|column| {
        let mark = match (column == view.order.column, view.order.reversed) {
            (false, _) => "",
            (true, false) => "▼",
            (true, true) => "▲",
        };
        match (&view.filter, column) {
            (Some(filter), Column::Agent) => {
                let pattern = fipa_acl::escape(&filter.text);
                format!("AGENT{mark} matching {pattern}")
            }
            _ => format!("{}{mark}", column.title()),
        }
    });
    let is_text = |column: usize| Column::ALL.get(column).is_some_and(|it| it.is_text());
    let plain = |text: String| (text, Style::new());
    lines.put(line(titles.map(plain), &widths, is_text).style(Palette::title()));
    let room = height.saturating_sub(1);
    let others = usize::from(snapshot.others.is_some() && view.filter.is_none());
    let is_cut = rows.len() + others > room;
    let shown = match is_cut {
        true => room.saturating_sub(1 + others),
        false => rows.len(),
    };
    let first = view.first.min(rows.len().saturating_sub(shown));
    let visible = rows.iter().copied().skip(first).take(shown);
    for row in visible.chain(snapshot.others.as_ref().filter(|_| others > 0 && room > 0)) {
        let cells = Column::ALL.map(|column| (column.cell(row), style(column, row, palette)));
        lines.put(line(cells, &widths, is_text));
    }
    if is_cut && room > others {
        let more = rows.len() - shown;
        let text = format!("… {more} more of {} agents", rows.len());
        lines.put(Span::styled(cut(&text, width), Palette::quiet()));
    } else if rows.is_empty() && room > 0 {
        let text = match &view.filter {
            Some(_) => "no agent matches",
            None => "no agents",
        };
        lines.put(Span::styled(text, Palette::quiet()));
    }
}

fn style(column: Column, row: &AgentRow, palette: Palette) -> Style {
    let has_letters = row.rates.sent + row.rates.received + row.rates.failed > 0.0;
    match column {
        Column::Failed if row.rates.failed > 0.0 => palette.warning(),
        Column::Violations if row.total.violations > 0 => palette.bad(),
        _ if !has_letters => Palette::quiet(),
        Column::Agent => Style::new().add_modifier(Modifier::BOLD),
        _ => Style::new(),
    }
}

/// Draws the hosts in at most this number of lines.
fn peers(lines: &mut Lines<'_>, rows: &[PeerRow], palette: Palette, height: usize) {
    let width = lines.width();
    let widths = widths(&PEER_COLUMNS, width);
    let is_text = |column: usize| PEER_TEXTS.contains(&column);
    let titles = PEER_TITLES.map(|title| (title.to_owned(), Style::new()));
    lines.put(line(titles, &widths, is_text).style(Palette::title()));
    let room = height.saturating_sub(1);
    let shown = match rows.len() > room {
        true => room.saturating_sub(1),
        false => rows.len(),
    };
    for row in rows.iter().take(shown) {
        let of_state = match row.state {
            PeerState::Connected(_) => palette.good(),
            PeerState::Lost(_) => palette.bad(),
            PeerState::Silent => palette.warning(),
        };
        let mut column = 0;
        let cells = table::peer_cells(row).map(|cell| {
            column += 1;
            (cell, if column == 2 { of_state } else { Style::new() })
        });
        lines.put(line(cells, &widths, is_text));
    }
    if rows.len() > shown && room > 0 {
        let text = format!("… {} more of {} hosts", rows.len() - shown, rows.len());
        lines.put(Span::styled(cut(&text, width), Palette::quiet()));
    }
}

fn footer(lines: &mut Lines<'_>, view: &View, palette: Palette) {
    let width = lines.width();
    match &view.input {
        Some(input) => {
            let text = fipa_acl::escape(&input.text);
            let error = input.error.as_ref().map(|it| format!("  {it}"));
            let line = format!("pattern: {text}▏");
            lines.put(vec![
                Span::raw(cut(&line, width)),
                Span::styled(error.unwrap_or_default(), palette.bad()),
            ]);
        }
        None => {
            let keys = "q quit  ←→ sort  r reverse  / filter  p pause  ? help";
            lines.put(Span::styled(cut(keys, width), Palette::quiet()));
        }
    }
}

/// The widths of the columns on a terminal of this width; 0 for those that are not shown.
fn widths<const N: usize>(columns: &[(Option<usize>, usize); N], terminal: usize) -> [usize; N] {
    let shown = columns.map(|(width, from)| (terminal >= from).then_some(width));
    let fixed = shown.iter().flatten().flatten();
    let used: usize = fixed.map(|width| width + 1).sum();
    let rest = terminal.saturating_sub(used);
    shown.map(|width| width.map_or(0, |width| width.unwrap_or(rest)))
}

/// A line of cells. Texts are aligned to the left, numbers to the right.
fn line<const N: usize>(
    cells: [(String, Style); N],
    widths: &[usize; N],
    is_text: impl Fn(usize) -> bool,
) -> Line<'static> {
    let mut spans = Vec::new();
    for (column, ((cell, style), width)) in cells.into_iter().zip(widths).enumerate() {
        if *width == 0 {
            continue;
        }
        if !spans.is_empty() {
            spans.push(Span::raw(" "));
        }
        let text = match is_text(column) {
            true => fitted(&cell, *width),
            false => right(&cell, *width),
        };
        spans.push(Span::styled(text, style));
    }
    Line::from(spans)
}

/// The text in exactly this number of columns, at their right end.
fn right(text: &str, width: usize) -> String {
    let text = cut(text, width);
    let blank = width.saturating_sub(text.width());
    " ".repeat(blank) + &text
}

#[cfg(test)]
mod tests;
