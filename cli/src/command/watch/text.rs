//! Output of `fipa watch` as text.

use std::time::SystemTime;

use anstyle::{AnsiColor, Style};
use fipa::admin::watch::{Fate, Passage};
use fipa::{Message, Outcome};
use fipa_acl::{escape, escape_name};
use fipa_content::{Content, Printer, Profile};
use unicode_width::UnicodeWidthStr;

use super::checker::{CheckResult, Overdue};
use crate::output::{self, cut, fitted};

/// The properties of the terminal.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Look {
    /// Columns of the terminal; none if the output is not a terminal.
    pub(super) width: Option<usize>,
    pub(super) color: bool,
}

/// Emphasis of a text.
#[derive(Debug, Clone, Copy)]
pub(super) enum Ink {
    Bad,
    Warning,
    Good,
    Quiet,
}

impl Look {
    pub(super) fn of_stdout() -> Self {
        let width = output::terminal_width();
        Self {
            width,
            color: output::has_color(),
        }
    }

    pub(super) fn paint(self, ink: Ink, text: &str) -> String {
        if !self.color || text.is_empty() {
            return text.to_owned();
        }
        let style = match ink {
            Ink::Bad => AnsiColor::Red.on_default().bold(),
            Ink::Warning => AnsiColor::Yellow.on_default(),
            Ink::Good => AnsiColor::Green.on_default(),
            Ink::Quiet => Style::new().dimmed(),
        };
        format!("{style}{text}{style:#}")
    }
}

/// Prints one line per letter, with details on extra lines.
#[derive(Debug)]
pub(super) struct TextOutput {
    pub(super) look: Look,
}

/// Widths of the columns up to the verdict.
#[derive(Debug, Clone, Copy)]
struct Columns {
    time: usize,
    agents: usize,
    performative: usize,
    protocol: usize,
    conversation: usize,
    size: usize,
    via: usize,
    outcome: usize,
    /// Whether words are abbreviated.
    narrow: bool,
}

const WIDE: Columns = Columns {
    time: 12,
    agents: 26,
    performative: 16,
    protocol: 18,
    conversation: 18,
    size: 10,
    via: 4,
    outcome: 10,
    narrow: false,
};

const NARROW: Columns = Columns {
    time: 8,
    agents: 17,
    performative: 9,
    protocol: 9,
    conversation: 7,
    size: 7,
    via: 3,
    outcome: 1,
    narrow: true,
};

/// Minimum width of the terminal for the wide columns.
const WIDE_ENOUGH: usize = 140;

/// Width of the terminal for which the narrow columns are made. Beyond it, the agents get the rest.
const NARROW_WIDTH: usize = 80;

impl TextOutput {
    pub(super) fn new(look: Look) -> Self {
        Self { look }
    }

    fn columns(&self) -> Columns {
        match self.look.width {
            Some(width) if width < WIDE_ENOUGH => Columns {
                agents: NARROW.agents + width.saturating_sub(NARROW_WIDTH),
                ..NARROW
            },
            _ => WIDE,
        }
    }

    /// The lines above the letters.
    pub(super) fn head(&self, domain: &str, processes: usize) -> String {
        let columns = self.columns();
        let outcome = if columns.narrow { "" } else { "OUTCOME" };
        let names = [
            "UTC",
            "FROM → TO",
            "PERFORMATIVE",
            "PROTOCOL",
            "CONVERSATION",
            "SIZE",
            "VIA",
            outcome,
        ];
        let head = row(&columns, names.map(str::to_owned), "VERDICT");
        first_line(domain, processes) + &self.look.paint(Ink::Quiet, head.trim_end()) + "\n"
    }

    /// The line of a letter, and further lines for a violation, a failure and the content.
    pub(super) fn letter(&self, passage: &Passage, checked: &CheckResult) -> String {
        let (columns, look) = (self.columns(), self.look);
        let message = passage.message.as_ref();
        let protocol = message.and_then(Message::protocol);
        let protocol = protocol.or_else(|| checked.protocol()).unwrap_or("-");
        let protocol = match columns.narrow {
            true => protocol.strip_prefix("fipa-").unwrap_or(protocol),
            false => protocol,
        };
        let cells = [
            time_of_day(passage.at, columns.time),
            agents(
                &escape_name(passage.sender().unwrap_or("?")),
                &escape_name(&passage.receiver),
                columns.agents,
            ),
            message.map_or_else(
                || "(unreadable)".to_owned(),
                |it| escape(it.performative().as_str()).into_owned(),
            ),
            escape_name(protocol).into_owned(),
            escape_name(message.and_then(Message::conversation_id).unwrap_or("-")).into_owned(),
            size(passage.size),
            passage.via.map_or("-", fipa::Kind::name).to_owned(),
            outcome(&passage.fate, columns.narrow).to_owned(),
        ];
        let verdict = match checked {
            CheckResult::Accepted { state, late, .. } => {
                let state = look.paint(Ink::Good, &escape(state));
                let late = if *late { " (late)" } else { "" };
                format!("{state}{}", look.paint(Ink::Warning, late))
            }
            CheckResult::Violation(_) => look.paint(Ink::Bad, "VIOLATION"),
            _ => "-".to_owned(),
        };
        let mut text = row(&columns, cells, &verdict);
        if is_failure(&passage.fate) {
            text = look.paint(Ink::Warning, &text);
        }
        text.push('\n');
        let mut below = |ink, line: &str| {
            text.push_str(&format!("    {}\n", look.paint(ink, line)));
        };
        if let CheckResult::Violation(violation) = checked {
            below(Ink::Bad, &format!("✗ {violation}"));
        }
        if let Some(problem) = delivery_problem(&passage.fate) {
            below(
                Ink::Warning,
                &format!("to {}: {problem}", escape_name(&passage.receiver)),
            );
        }
        if !passage.content.is_empty() {
            match formatted(passage) {
                Some(lines) => lines
                    .lines()
                    .for_each(|line| below(Ink::Quiet, &escape(line))),
                None => below(Ink::Quiet, &escape(&content(passage))),
            }
        }
        text
    }

    /// The later outcome of a letter that was shown before.
    pub(super) fn later(&self, passage: &Passage) -> String {
        let news = delivery_problem(&passage.fate).unwrap_or_else(|| {
            let via = passage
                .via
                .map_or(String::new(), |via| format!(" via {via}"));
            format!("{}{via}", outcome(&passage.fate, false))
        });
        let performative = passage
            .message
            .as_ref()
            .map(|it| it.performative().to_string());
        let text = format!(
            "    later: {} from {} to {}: {news}",
            escape(performative.as_deref().unwrap_or("a letter")),
            escape_name(passage.sender().unwrap_or("?")),
            escape_name(&passage.receiver),
        );
        let ink = if is_failure(&passage.fate) {
            Ink::Warning
        } else {
            Ink::Quiet
        };
        self.look.paint(ink, &text) + "\n"
    }
}

pub(super) fn first_line(domain: &str, processes: usize) -> String {
    let processes = match processes {
        0 => "no process so far".to_owned(),
        1 => "1 process".to_owned(),
        many => format!("{many} processes"),
    };
    format!("watching domain {domain}, {processes}; press Ctrl-C to stop\n")
}

pub(super) fn lost(look: Look, process: &str, records: u64) -> String {
    let what = format!(
        "    {records} records of {} were lost; letters may be missing here, and verdicts may be wrong",
        escape(process),
    );
    look.paint(Ink::Warning, &what) + "\n"
}

pub(super) fn refused(look: Look, process: &str, why: &str) -> String {
    let what = format!("    stopped watching {}: {}", escape(process), escape(why));
    look.paint(Ink::Warning, &what) + "\n"
}

pub(super) fn overdue(look: Look, overdue: &Overdue) -> String {
    let with = overdue.participant.as_ref();
    let with = with.map(|it| format!(" with {}", escape_name(it)));
    let what = format!(
        "    overdue: no message in conversation {:?} of {}, state {:?}{}",
        overdue.conversation_id,
        escape(&overdue.protocol),
        overdue.state,
        with.unwrap_or_default(),
    );
    look.paint(Ink::Warning, &what) + "\n"
}

fn row(columns: &Columns, cells: [String; 8], verdict: &str) -> String {
    let [
        time,
        agents,
        performative,
        protocol,
        conversation,
        size,
        via,
        outcome,
    ] = cells;
    let gap = if columns.narrow { " " } else { "  " };
    let cells = [
        (time, columns.time),
        (agents, columns.agents),
        (performative, columns.performative),
        (protocol, columns.protocol),
        (conversation, columns.conversation),
    ];
    let mut text = String::new();
    for (cell, width) in cells {
        text.push_str(&fitted(&cell, width));
        text.push_str(gap);
    }
    let blank = " ".repeat(columns.size.saturating_sub(size.width()));
    text.push_str(&format!("{blank}{size}{gap}"));
    for (cell, width) in [(via, columns.via), (outcome, columns.outcome)] {
        text.push_str(&fitted(&cell, width));
        text.push_str(gap);
    }
    text + verdict
}

/// The sender and the receiver in at most this number of columns. If both are too long, each has half,
/// and the column that is left over is the receiver's.
fn agents(sender: &str, receiver: &str, width: usize) -> String {
    const ARROW: &str = " → ";
    let room = width.saturating_sub(ARROW.width());
    let half = room / 2;
    let for_receiver = match sender.width() <= half {
        true => room - sender.width(),
        false => receiver.width().min(room - half),
    };
    let receiver = cut(receiver, for_receiver);
    let sender = cut(sender, room - receiver.width());
    format!("{sender}{ARROW}{receiver}")
}

/// The time of day in UTC, in at most this number of columns.
pub(in crate::command) fn time_of_day(at: SystemTime, width: usize) -> String {
    let time = output::rfc3339(at);
    let time = time
        .as_deref()
        .and_then(|time| time.get(11..))
        .unwrap_or("?");
    time.chars().take(width).collect()
}

fn size(bytes: u64) -> String {
    const STEP: f64 = 1024.0;
    let bytes_as_float = bytes as f64;
    match bytes {
        0..10_000 => format!("{bytes} B"),
        10_000..10_240_000 => format!("{:.0} KiB", bytes_as_float / STEP),
        _ => format!("{:.0} MiB", bytes_as_float / STEP / STEP),
    }
}

fn outcome(fate: &Fate, narrow: bool) -> &'static str {
    let (word, sign) = match fate {
        Fate::UnderWay => ("under way", "…"),
        Fate::Taken => ("taken", "✓"),
        Fate::Passed(outcome) | Fate::Settled(outcome) => match outcome {
            Outcome::Delivered { .. } => ("delivered", "✓"),
            Outcome::Sent { .. } => ("sent", "→"),
            _ => ("failed", "✗"),
        },
    };
    if narrow { sign } else { word }
}

fn is_failure(fate: &Fate) -> bool {
    matches!(
        fate,
        Fate::Settled(Outcome::Failed { .. }) | Fate::Passed(Outcome::Failed { .. })
    )
}

/// The outcome of a letter that failed or needed several attempts.
fn delivery_problem(fate: &Fate) -> Option<String> {
    match fate {
        Fate::Settled(outcome) | Fate::Passed(outcome)
            if is_failure(fate) || !outcome.attempts().is_empty() =>
        {
            Some(outcome.to_string())
        }
        _ => None,
    }
}

/// Returns complete content in FIPA-SL on several lines, if it is longer than one line.
fn formatted(passage: &Passage) -> Option<String> {
    let language = passage.message.as_ref()?.language()?;
    Profile::of_language(language)?;
    let content = Content::parse(&passage.content).ok()?;
    let lines = Printer::new().indented().print(&content).ok()?;
    String::from_utf8(lines).ok()
}

fn content(passage: &Passage) -> String {
    let length = passage.content_len.unwrap_or(0);
    let rest = length.saturating_sub(passage.content.len() as u64);
    let text = match std::str::from_utf8(&passage.content) {
        Ok(text) => text,
        // Only the last character is incomplete.
        Err(error) if error.error_len().is_none() => {
            std::str::from_utf8(&passage.content[..error.valid_up_to()]).unwrap_or_default()
        }
        Err(_) => return format!("{length} bytes of binary content"),
    };
    let more = if rest > 0 {
        format!("… ({length} bytes)")
    } else {
        String::new()
    };
    format!("{text}{more}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_sender_does_not_hide_the_receiver() {
        assert_eq!(agents("rover", "arm_1", 17), "rover → arm_1");
        assert_eq!(
            agents("fipa-send-0123456789abcdef", "arm_1", 17),
            "fipa-sen… → arm_1"
        );
        assert_eq!(agents("rover", "manipulator_left", 17), "rover → manipula…");
        assert_eq!(
            agents("fipa-send-0123456789abcdef", "manipulator_left", 17),
            "fipa-s… → manipu…"
        );
        for width in 0..40 {
            let fits = agents("fipa-send-0123456789abcdef", "manipulator_left", width);
            assert!(fits.width() <= width.max(3), "{width}: {fits}");
        }
    }

    #[test]
    fn only_a_look_with_color_paints() {
        let look = Look {
            width: None,
            color: true,
        };
        assert_eq!(look.paint(Ink::Good, "x"), "\u{1b}[32mx\u{1b}[0m");
        assert_eq!(Look::default().paint(Ink::Bad, "x"), "x");
    }

    #[test]
    fn a_size_is_printed_in_its_largest_fitting_unit() {
        assert_eq!(size(271), "271 B");
        assert_eq!(size(65_536), "64 KiB");
        assert_eq!(size(64 << 20), "64 MiB");
    }
}
