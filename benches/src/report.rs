//! The results as a table and as JSON.

use comfy_table::{CellAlignment, Table, presets};
use serde_json::{Value, json};

use super::machine::Machine;
use super::many::Many;
use super::measure::{Effort, Measured, Row, name_of};
use super::part::{Fill, Wait};
use super::path::MAX_IN_FLIGHT;

/// All results as JSON.
pub(super) fn json(machine: &Machine, effort: &Effort, measured: &Measured) -> Value {
    json!({
        "machine": machine,
        "method": {
            "rounds": effort.rounds,
            "letters_in_flight_for_rate": {
                "copied": 16, "loaned": 8, "filled": 8, "max_content_bytes": MAX_IN_FLIGHT,
            },
        },
        "rows": measured.rows,
        "multicast": measured.many,
        "notes": measured.notes,
    })
}

/// All results as a table with a legend.
pub(super) fn text(machine: &Machine, effort: &Effort, measured: &Measured) -> String {
    let mut text = machine.heading();
    text.push_str(&format!(
        "{} rounds; each round measures every route in turn; sender and receiver on separate CPUs if \
         there are two; times in microseconds\n\n",
        effort.rounds
    ));
    text.push_str(&table(&measured.rows).to_string());
    text.push_str(LEGEND);
    text.push_str(&encrypted(&measured.rows));
    if let Some(many) = &measured.many {
        text.push_str(&of_many(many));
    }
    for note in &measured.notes {
        text.push_str(&format!("note: {note}\n"));
    }
    text.push_str(&summary(&measured.rows));
    text
}

const LEGEND: &str = "
wait        spin: the waiting process polls; block: it sleeps until it is woken
content     loaned: in loaned memory, not written; filled: in loaned memory, written within the
            measured time; copied: in the memory of the application
encoded     letters encoded before, through the transport alone, not decoded
n           number of samples
p50-p99.9   percentiles of the one-way time: from the call of send until the receiver has the
            decoded message
round trip  from the call of send until the sender has the acknowledgment
rate/s      letters per second with 16 letters in flight (8 if loaned or filled), and at most
            48 MiB of content
cpu         CPU time of all processes of the route per letter, one letter at a time
x limit     ratio of the one-way time to that of the same bytes through the raw mechanism in the same
            rounds (spread: the middle half of the rounds); trip, rate and cpu are the other ratios
";

/// The round trips of one size, a line per path: the result in one screen.
fn summary(rows: &[Row]) -> String {
    /// The size that users send most: the nearest measured size is shown.
    const TYPICAL: usize = 1024;
    let sizes = rows.iter().map(|row| row.size);
    let Some(typical) = sizes.min_by_key(|size| size.abs_diff(TYPICAL)) else {
        return String::new();
    };
    let shown = rows.iter().filter(|row| {
        row.size == typical && row.fill == Fill::Copied && row.round_trip_ratio.is_some()
    });
    let head = [
        "route",
        "wait",
        "round trip",
        "limit",
        "ratio",
        "rate/s",
        "ratio",
    ];
    let mut table = empty_table(head, 2);
    let ratio = |ratio: Option<f64>| ratio.map_or_else(String::new, |ratio| format!("{ratio:.2}"));
    for row in shown {
        let limit = row.limit.as_ref();
        table.add_row([
            row.path.clone(),
            wait(row.wait).to_owned(),
            format!("{} µs", micro(row.round_trip_us.p50)),
            limit.map_or_else(String::new, |limit| {
                format!("{} µs", micro(limit.round_trip_p50_us))
            }),
            ratio(row.round_trip_ratio),
            row.rate_per_s
                .map_or_else(String::new, |rate| format!("{rate:.0}")),
            ratio(row.rate_ratio),
        ]);
    }
    format!(
        "\nIn short, {} copied, acknowledged:\n{table}\n`fipa bench --svg FILE` draws all sizes.\n",
        size(typical)
    )
}

/// Cost of encryption, one line per path and content.
fn encrypted(rows: &[Row]) -> String {
    let mut text = String::new();
    for row in rows {
        let Some(plain) = &row.plain else { continue };
        let [low, high] = plain.round_trip_ratio_spread;
        let rate = plain.rate_ratio.map(|ratio| format!(", rate {ratio:.2}"));
        text.push_str(&format!(
            "{} with {} {}, ratio to {}: round trip {:.2} ({low:.2}-{high:.2}), one way {:.2}{}, \
             cpu {:.2}\n",
            row.path,
            size(row.size),
            name_of(row.fill),
            plain.name,
            plain.round_trip_ratio,
            plain.ratio,
            rate.unwrap_or_default(),
            plain.cpu_ratio,
        ));
    }
    if !text.is_empty() {
        text.insert(0, '\n');
    }
    text
}

fn of_many(many: &Many) -> String {
    let [low, high] = many.ratio_spread;
    format!(
        "\nmulticast of {} filled to {} receivers: {} until all receivers have it; writing the content \
         takes {}, a small message to all {}: ratio to their sum {:.2} ({low:.2}-{high:.2}); with one \
         copy per receiver {}, {:.1} times as long\n",
        size(many.size),
        many.receivers,
        micro(many.together_us),
        micro(many.fill_us),
        micro(many.small_us),
        many.ratio,
        micro(many.copies_us),
        many.copies_ratio,
    )
}

/// Creates a table with this header. All columns but the first `left` ones are aligned to the right.
pub(super) fn empty_table<const N: usize>(header: [&str; N], left: usize) -> Table {
    let mut table = Table::new();
    table.load_style(presets::NOTHING);
    table.set_header(header);
    for column in table.column_iter_mut().skip(left) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    table
}

fn table(rows: &[Row]) -> Table {
    let head = [
        "content",
        "route",
        "wait",
        "n",
        "p50",
        "p99",
        "p99.9",
        "round trip",
        "rate/s",
        "cpu",
        "x limit",
        "(spread)",
        "trip",
        "rate",
        "cpu",
    ];
    let mut table = empty_table(head, 3);
    let mut last = String::new();
    for row in rows {
        let content = format!("{} {}", size(row.size), name_of(row.fill));
        let shown = if content == last {
            String::new()
        } else {
            content.clone()
        };
        last = content;
        let times = |ratio: Option<f64>| ratio.map(|ratio| format!("{ratio:.2}"));
        let spread = row
            .ratio_spread
            .map(|[low, high]| format!("{low:.2}-{high:.2}"));
        let cells = [
            shown,
            row.path.clone(),
            wait(row.wait).to_owned(),
            row.samples.to_string(),
            micro(row.one_way_us.p50),
            micro(row.one_way_us.p99),
            micro(row.one_way_us.p999),
            micro(row.round_trip_us.p50),
            row.rate_per_s
                .map(|rate| format!("{rate:.0}"))
                .unwrap_or_default(),
            micro(row.cpu_us_per_letter),
            times(row.ratio).unwrap_or_default(),
            spread.unwrap_or_default(),
            times(row.round_trip_ratio).unwrap_or_default(),
            times(row.rate_ratio).unwrap_or_default(),
            times(row.cpu_ratio).unwrap_or_default(),
        ];
        table.add_row(cells);
    }
    table
}

fn micro(time: f64) -> String {
    match time {
        time if time < 10.0 => format!("{time:.2}"),
        time if time < 100.0 => format!("{time:.1}"),
        time => format!("{time:.0}"),
    }
}

pub(super) fn wait(wait: Wait) -> &'static str {
    match wait {
        Wait::Spin => "spin",
        Wait::Block => "block",
    }
}

/// Formats a size in bytes.
pub(super) fn size(bytes: usize) -> String {
    const KIB: usize = 1 << 10;
    const MIB: usize = 1 << 20;
    match bytes {
        bytes if bytes >= MIB && bytes.is_multiple_of(MIB) => format!("{} MiB", bytes / MIB),
        bytes if bytes >= KIB && bytes.is_multiple_of(KIB) => format!("{} KiB", bytes / KIB),
        bytes => format!("{bytes} B"),
    }
}
