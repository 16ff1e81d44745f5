//! Prints the results of a command on standard output.
//!
//! Commands [escape](fipa_acl::escape) texts from outside before they put them into lines.

use std::borrow::Cow;
use std::fmt::Write as _;
use std::io::{self, IsTerminal, Write};
use std::time::{Duration, SystemTime};

use comfy_table::{Cell, ContentArrangement, Table, presets};
use fipa::Time;
use fipa_acl::{escape, is_unprintable};
use rustix::event::{PollFd, PollFlags, poll};
use rustix::io::Errno;
use serde::Serialize;
use tokio::sync::oneshot;
use unicode_width::{UnicodeWidthChar, UnicodeWidthStr};

use crate::report::Failure;

/// Prints a text. The text has its own final newline.
pub(crate) fn text(text: &str) -> Result<(), Failure> {
    bytes(printable(text).as_bytes())
}

/// Escapes the lines that still have unprintable characters, for example an error of the operating
/// system with a file name. Other lines stay as they are: they may be escaped already.
pub(crate) fn printable(text: &str) -> Cow<'_, str> {
    if !text.contains(|c| c != '\n' && is_unprintable(c)) {
        return Cow::Borrowed(text);
    }
    let lines = text
        .split('\n')
        .map(|line| match line.contains(is_unprintable) {
            true => escape(line),
            false => Cow::Borrowed(line),
        });
    Cow::Owned(lines.collect::<Vec<_>>().join("\n"))
}

/// Writes the characters that have a meaning in Mermaid, or in HTML, into which Mermaid puts labels, as
/// references to characters. The text is [escaped](escape) already, so it is one line.
pub(crate) fn mermaid(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match "#;:<>{}%\"\\&`$".contains(c) {
            // Writing to a string cannot fail.
            true => drop(write!(out, "#{};", u32::from(c))),
            false => out.push(c),
        }
    }
    out
}

/// Creates a table in the style of all commands. On a terminal it has at most the width of the terminal:
/// long cells continue in further lines.
pub(crate) fn table<T: Into<Cell>>(columns: impl IntoIterator<Item = T>) -> Table {
    table_within(columns, terminal_width())
}

/// Keeps each row of a table on one line of a terminal: what does not fit is cut.
pub(crate) fn cut_to_lines(table: &mut Table) {
    for row in table.row_iter_mut() {
        row.max_height(1);
    }
}

/// A size in the largest unit that represents it exactly, as in the configuration.
pub(crate) fn size(bytes: u64) -> String {
    let units = [(30, "GiB"), (20, "MiB"), (10, "KiB")];
    let exact = units
        .iter()
        .find(|(bits, _)| bytes != 0 && bytes.trailing_zeros() >= *bits);
    match exact {
        Some((bits, unit)) => format!("{}{unit}", bytes >> bits),
        None => format!("{bytes} bytes"),
    }
}

/// The two largest units of a time, for table cells.
pub(crate) fn time_span(time: Duration) -> String {
    let seconds = time.as_secs();
    match (
        seconds / 86_400,
        seconds / 3600 % 24,
        seconds / 60 % 60,
        seconds % 60,
    ) {
        (0, 0, 0, seconds) => format!("{seconds}s"),
        (0, 0, minutes, seconds) => format!("{minutes}m {seconds}s"),
        (0, hours, minutes, _) => format!("{hours}h {minutes}m"),
        (days, hours, _, _) => format!("{days}d {hours}h"),
    }
}

/// Creates a table without a header, in the same style and within the same width. The caller sets the
/// padding of its columns.
pub(crate) fn rows() -> Table {
    rows_within(terminal_width())
}

fn table_within<T: Into<Cell>>(
    columns: impl IntoIterator<Item = T>,
    width: Option<usize>,
) -> Table {
    let columns: Vec<Cell> = columns.into_iter().map(Into::into).collect();
    let mut table = rows_within(width);
    table.set_header(columns);
    for column in table.column_iter_mut() {
        column.set_padding((0, 2));
    }
    table
}

fn rows_within(width: Option<usize>) -> Table {
    let mut table = Table::new();
    table.load_style(presets::NOTHING);
    if let Some(width) = width.and_then(|width| u16::try_from(width).ok()) {
        table
            .set_content_arrangement(ContentArrangement::Dynamic)
            .set_width(width);
    }
    table
}

/// The text in exactly this number of columns: shortened, or padded with spaces.
pub(crate) fn fitted(text: &str, width: usize) -> String {
    let text = cut(text, width);
    let blank = " ".repeat(width.saturating_sub(text.width()));
    text + &blank
}

/// The text in at most this number of columns.
pub(crate) fn cut(text: &str, width: usize) -> String {
    if text.width() <= width {
        return text.to_owned();
    }
    let mut columns_left = width.saturating_sub(1);
    let fits = |c: &char| {
        let needed = c.width().unwrap_or(0);
        let fits = needed <= columns_left;
        columns_left = columns_left.saturating_sub(needed);
        fits
    };
    let mut short: String = text.chars().take_while(fits).collect();
    if width > 0 {
        short.push('…');
    }
    short
}

/// Prints the converted input of a command: unchanged for another program or a file, escaped on a
/// terminal.
pub(crate) fn converted(converted: &[u8]) -> Result<(), Failure> {
    match io::stdout().is_terminal() {
        true => text(&String::from_utf8_lossy(converted)),
        false => bytes(converted),
    }
}

/// Whether texts on standard output have colors: on a terminal, unless NO_COLOR is set.
pub(crate) fn has_color() -> bool {
    let plain = std::env::var_os("NO_COLOR").is_some_and(|value| !value.is_empty());
    io::stdout().is_terminal() && !plain
}

/// Columns of the terminal; `None` if standard output is not a terminal.
pub(crate) fn terminal_width() -> Option<usize> {
    let size = terminal_size::terminal_size();
    size.filter(|_| io::stdout().is_terminal())
        .map(|(width, _)| usize::from(width.0))
}

/// Prints bytes unchanged.
pub(crate) fn bytes(bytes: &[u8]) -> Result<(), Failure> {
    bytes_if_read(bytes).map(drop)
}

/// Watches standard output for the loss of its reader, as after `| head`. Where the kernel cannot
/// report that, it is never detected.
pub(crate) struct Reader(oneshot::Receiver<()>);

impl Reader {
    /// Starts watching standard output.
    pub(crate) fn of_output() -> Self {
        let (gone, reader) = oneshot::channel();
        // This thread ends with the process at the latest: only the loss of the reader ends `poll`. If the system
        // refuses it, the loss is not detected.
        let _ = std::thread::Builder::new().spawn(move || {
            let stdout = io::stdout();
            let mut watched = [PollFd::new(&stdout, PollFlags::empty())];
            while let Err(Errno::INTR) = poll(&mut watched, None) {}
            if watched[0].revents().contains(PollFlags::ERR) {
                // The `Reader` may have been dropped.
                let _ = gone.send(());
            }
        });
        Self(reader)
    }

    /// Returns when the output has no reader left. Safe to cancel.
    pub(crate) async fn gone(&mut self) {
        if (&mut self.0).await.is_err() {
            std::future::pending().await
        }
    }
}

/// Prints bytes unchanged. Returns whether the output still has a reader, so that a command that
/// prints continuously can end together with its reader.
pub(crate) fn bytes_if_read(bytes: &[u8]) -> Result<bool, Failure> {
    let mut stdout = io::stdout().lock();
    let written = stdout.write_all(bytes).and_then(|()| stdout.flush());
    match written {
        // The reader has closed the pipe, as `head` does.
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(false),
        Err(error) => Err(Failure::failed(
            format!("cannot write the output: {error}"),
            "standard output",
            "check whether the disk is full, or redirect the output to another file",
        )),
        Ok(()) => Ok(true),
    }
}

/// Prints one JSON document.
pub(crate) fn json(value: &impl Serialize) -> Result<(), Failure> {
    document(serde_json::to_string_pretty(value))
}

/// Prints one JSON document on a line of its own.
pub(crate) fn json_line(value: &impl Serialize) -> Result<(), Failure> {
    document(serde_json::to_string(value))
}

fn document(document: serde_json::Result<String>) -> Result<(), Failure> {
    let document = document.map_err(|error| {
        Failure::failed(
            format!("cannot write the output as JSON: {error}"),
            "standard output",
            "run the command without --json",
        )
    })?;
    text(&format!("{}\n", visible_in_json(&document)))
}

/// Returns a time in UTC as in RFC 3339. `None` if it is out of the range of that.
pub(crate) fn rfc3339(time: SystemTime) -> Option<String> {
    Time::from_system_time(time).ok().and_then(Time::to_rfc3339)
}

/// Returns a time in UTC as in RFC 3339; empty if it is out of the range of that.
pub(crate) fn moment(time: SystemTime) -> String {
    rfc3339(time).unwrap_or_default()
}

/// Returns the name of this host.
pub(crate) fn host_name() -> String {
    let name = rustix::system::uname();
    name.nodename().to_string_lossy().into_owned()
}

/// Escapes the unprintable characters that serde_json leaves unescaped. They occur only within
/// strings, where JSON has `\u` for them (RFC 8259 clause 7).
pub(crate) fn visible_in_json(document: &str) -> Cow<'_, str> {
    let is_unescaped = |c: char| c != '\n' && is_unprintable(c);
    if !document.contains(is_unescaped) {
        return Cow::Borrowed(document);
    }
    let mut out = String::with_capacity(document.len() + 16);
    for c in document.chars() {
        if is_unescaped(c) {
            for unit in c.encode_utf16(&mut [0; 2]) {
                // Writing to a string cannot fail.
                let _ = write!(out, "\\u{unit:04x}");
            }
        } else {
            out.push(c);
        }
    }
    Cow::Owned(out)
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    #[test]
    fn characters_with_a_meaning_in_mermaid_are_written_as_references() {
        let hostile = "a;b#1:<img src=x>%%{init}\"&lt;`$$";
        let expected =
            "a#59;b#35;1#58;#60;img src=x#62;#37;#37;#123;init#125;#34;#38;lt#59;#96;#36;#36;";
        assert_eq!(mermaid(hostile), expected);
        assert_eq!(mermaid("cfp (tcp), béla@home/x"), "cfp (tcp), béla@home/x");
    }

    #[test]
    fn escaping_a_json_document_keeps_its_meaning() {
        let value = json!({ "a\u{9b}b": "\u{7f}\u{202e}\u{e0001}\n\\u{1b}", "c": [1, "é"] });
        for document in [value.to_string(), format!("{value:#}")] {
            let visible = visible_in_json(&document);
            assert!(
                !visible.contains(|c| c != '\n' && is_unprintable(c)),
                "{visible:?}"
            );
            assert_eq!(serde_json::from_str::<Value>(&visible).unwrap(), value);
        }
    }

    #[test]
    fn texts_are_cut_to_columns_not_to_characters() {
        assert_eq!(fitted("arm", 5), "arm  ");
        assert_eq!(fitted("manipulator", 5), "mani…");
        assert_eq!(fitted("机器人手臂", 6), "机器… ");
        assert_eq!(cut("x", 0), "");
    }

    #[test]
    fn a_table_fits_the_terminal() {
        let location = "tcp://[2001:db8:0:1:2:3:4:5]:7788#0123456789abcdef".to_owned();
        let rows = |width| {
            let mut table = table_within(["NAME", "LOCATIONS", "AGE"], width);
            table.add_row(["manipulator_left", &location, "3days 4h 5m"]);
            table.trim_fmt()
        };
        assert!(rows(None).contains(&location), "a file has whole lines");
        let narrow = rows(Some(60));
        assert!(
            narrow.lines().all(|line| line.chars().count() <= 60),
            "{narrow}"
        );
    }

    #[test]
    fn a_row_of_a_list_is_one_line_of_the_terminal() {
        let mut table = table_within(["NAME", "HOST", "TYPE", "AGE", "STATE"], Some(80));
        let long = "x".repeat(200);
        let rows = [["arm_1", "crex-mts", "arm", "3d 4h", "encrypted"]; 2];
        table.add_rows(rows);
        table.add_row([&long, &long, &long, "3d 4h", "not encrypted"]);
        cut_to_lines(&mut table);
        let lines = table.trim_fmt();
        assert_eq!(lines.lines().count(), 4, "{lines}");
        assert!(
            lines.lines().all(|line| line.chars().count() <= 80),
            "{lines}"
        );
    }

    #[test]
    fn a_time_span_has_its_two_largest_units() {
        for (seconds, text) in [
            (0, "0s"),
            (75, "1m 15s"),
            (3600, "1h 0m"),
            (200_000, "2d 7h"),
        ] {
            assert_eq!(time_span(Duration::from_secs(seconds)), text);
        }
    }

    #[test]
    fn a_line_that_is_escaped_already_is_not_escaped_again() {
        assert_eq!(printable("a\\u{1b}\nb\u{9b}\n"), "a\\u{1b}\nb\\u{9b}\n");
    }
}
