//! A state of the domain at one time, and the columns and cells of its tables. No I/O and no clock.

use std::cmp::Ordering;
use std::time::{Duration, Instant, SystemTime};

use clap::ValueEnum;
use fipa::{Kind, Matcher};
use fipa_acl::escape_name;

use super::meter::Meter;
use super::peers::{PeerRow, PeerState};
use super::window::{Counter, Counts, Latency, Rates, Slots};
use crate::output;

/// The domain at one time.
#[derive(Debug)]
pub(in crate::command) struct Snapshot {
    pub(in crate::command) header: Header,
    pub(in crate::command) agents: Vec<AgentRow>,
    /// The letters of all agents without a row; `None` if all agents have one.
    pub(in crate::command) others: Option<AgentRow>,
    pub(in crate::command) peers: Vec<PeerRow>,
}

/// The data of the whole domain that the counters do not have.
#[derive(Debug, Clone)]
pub(in crate::command) struct Surroundings {
    pub(in crate::command) domain: String,
    pub(in crate::command) host: String,
    pub(in crate::command) time: SystemTime,
    /// Number of agents on this host.
    pub(in crate::command) here: usize,
    /// Number of known agents on other hosts.
    pub(in crate::command) elsewhere: usize,
    /// Number of watched processes.
    pub(in crate::command) processes: usize,
    /// The name of the gateway of this host.
    pub(in crate::command) gateway: Option<String>,
    /// The reason why the data of the gateway are old.
    pub(in crate::command) problem: Option<String>,
}

/// The data of the whole domain.
#[derive(Debug)]
pub(in crate::command) struct Header {
    pub(in crate::command) surroundings: Surroundings,
    pub(in crate::command) rates: Rates,
    pub(in crate::command) total: Counts,
    pub(in crate::command) latency: Option<Latency>,
    pub(in crate::command) lost: u64,
}

/// The letters of an agent.
#[derive(Debug, Clone)]
pub(in crate::command) struct AgentRow {
    pub(in crate::command) name: String,
    pub(in crate::command) rates: Rates,
    pub(in crate::command) total: Counts,
    pub(in crate::command) latency: Option<Latency>,
    pub(in crate::command) via: Option<Kind>,
}

impl Snapshot {
    pub(super) fn new(
        now: Instant,
        meter: &Meter,
        peers: Vec<PeerRow>,
        surroundings: Surroundings,
    ) -> Self {
        let (all, slots) = (meter.all(), meter.slots());
        let agents = meter.agents();
        let others = meter.others();
        Self {
            header: Header {
                surroundings,
                rates: all.rates(now, slots),
                total: all.total(),
                latency: all.latency(now, slots),
                lost: meter.lost(),
            },
            agents: agents
                .map(|(name, counter)| AgentRow::new(now, slots, name, counter))
                .collect(),
            others: others.map(|counter| AgentRow::new(now, slots, "(other agents)", counter)),
            peers,
        }
    }

    /// The agents that match, in order.
    pub(super) fn sorted(&self, order: Order, shown: Option<&Matcher>) -> Vec<&AgentRow> {
        let is_shown = |row: &&AgentRow| shown.is_none_or(|it| it.matches(&row.name));
        let mut rows: Vec<&AgentRow> = self.agents.iter().filter(is_shown).collect();
        rows.sort_by(|a, b| order.compare(a, b));
        rows
    }
}

impl AgentRow {
    fn new(now: Instant, slots: Slots, name: &str, counter: &Counter) -> Self {
        Self {
            name: name.to_owned(),
            rates: counter.rates(now, slots),
            total: counter.total(),
            latency: counter.latency(now, slots),
            via: counter.most_used(now, slots),
        }
    }
}

/// A column of the table of agents.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(super) enum Column {
    /// Name
    Agent,
    /// Letters per second that it sends
    Sent,
    /// Letters per second that it receives
    Received,
    /// Its letters per second that fail
    Failed,
    /// Its letters since the start that violate their protocols
    Violations,
    /// Median of the delivery times of its letters
    Median,
    /// 99th percentile of the delivery times of its letters
    P99,
    /// The transport that carries most of its letters
    Via,
}

impl Column {
    pub(super) const ALL: [Self; 8] = [
        Self::Agent,
        Self::Sent,
        Self::Received,
        Self::Failed,
        Self::Violations,
        Self::Median,
        Self::P99,
        Self::Via,
    ];

    pub(super) fn title(self) -> &'static str {
        match self {
            Self::Agent => "AGENT",
            Self::Sent => "SENT/s",
            Self::Received => "RECV/s",
            Self::Failed => "FAIL/s",
            Self::Violations => "VIOL",
            Self::Median => "MEDIAN",
            Self::P99 => "P99",
            Self::Via => "VIA",
        }
    }

    /// The columns of the terminal for its cells; `None` for the rest of the line.
    pub(super) fn width(self) -> Option<usize> {
        match self {
            Self::Agent => None,
            Self::Sent | Self::Received | Self::Failed => Some(7),
            Self::Violations => Some(6),
            Self::Median | Self::P99 => Some(8),
            Self::Via => Some(5),
        }
    }

    /// The width of the terminal from which it is shown.
    pub(super) fn shown_from(self) -> usize {
        match self {
            Self::Agent | Self::Sent | Self::Received | Self::Failed => 0,
            Self::Median => 50,
            Self::P99 => 60,
            Self::Violations => 66,
            Self::Via => 72,
        }
    }

    pub(super) fn is_text(self) -> bool {
        matches!(self, Self::Agent | Self::Via)
    }

    pub(super) fn cell(self, row: &AgentRow) -> String {
        match self {
            Self::Agent => escape_name(&row.name).into_owned(),
            Self::Sent => rate(row.rates.sent),
            Self::Received => rate(row.rates.received),
            Self::Failed => rate(row.rates.failed),
            Self::Violations => count(row.total.violations),
            Self::Median => time(row.latency.map(|it| it.median)),
            Self::P99 => time(row.latency.map(|it| it.percentile_99)),
            Self::Via => row.via.map_or("-", Kind::name).to_owned(),
        }
    }

    fn compare(self, a: &AgentRow, b: &AgentRow) -> Ordering {
        let by_rate = |of: fn(&Rates) -> f64| of(&a.rates).total_cmp(&of(&b.rates));
        let by_time = |of: fn(Latency) -> Duration| a.latency.map(of).cmp(&b.latency.map(of));
        match self {
            Self::Agent => Ordering::Equal,
            Self::Sent => by_rate(|it| it.sent),
            Self::Received => by_rate(|it| it.received),
            Self::Failed => by_rate(|it| it.failed),
            Self::Violations => a.total.violations.cmp(&b.total.violations),
            Self::Median => by_time(|it| it.median),
            Self::P99 => by_time(|it| it.percentile_99),
            Self::Via => a.via.map(Kind::name).cmp(&b.via.map(Kind::name)),
        }
    }
}

/// The order of the agents.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Order {
    pub(super) column: Column,
    pub(super) reversed: bool,
}

impl Order {
    /// Numbers from the largest, texts from the first; agents with equal values by name.
    fn compare(self, a: &AgentRow, b: &AgentRow) -> Ordering {
        let by_name = a.name.cmp(&b.name);
        let by_column = self.column.compare(a, b);
        let by_column = match self.column.is_text() {
            true => by_column,
            false => by_column.reverse(),
        };
        match (self.reversed, self.column) {
            (false, _) => by_column.then(by_name),
            (true, Column::Agent) => by_name.reverse(),
            (true, _) => by_column.reverse().then(by_name),
        }
    }
}

/// The titles of the table of hosts.
pub(super) const PEER_TITLES: [&str; 9] = [
    "HOST",
    "STATE",
    "TO/s",
    "FROM/s",
    "MEDIAN",
    "P99",
    "TRANSPORTS",
    "SECURITY",
    "RETRIES",
];

/// The cells of a host.
pub(super) fn peer_cells(row: &PeerRow) -> [String; 9] {
    let transports: Vec<&str> = row.transports.iter().map(|kind| kind.name()).collect();
    [
        row.shown_name(),
        state(&row.state),
        rate(row.rates.received),
        rate(row.rates.sent),
        time(row.latency.map(|it| it.median)),
        time(row.latency.map(|it| it.percentile_99)),
        match transports.is_empty() {
            true => "-".to_owned(),
            false => transports.join(","),
        },
        match row.encrypted {
            Some(true) => "encrypted",
            Some(false) => "plain",
            None => "-",
        }
        .to_owned(),
        count(row.retries),
    ]
}

fn state(state: &PeerState) -> String {
    match state {
        PeerState::Connected(time) => format!("up {}", output::time_span(*time)),
        PeerState::Lost(time) => format!("lost {}", output::time_span(*time)),
        PeerState::Silent => "no answer".to_owned(),
    }
}

/// A rate in at most six characters.
pub(super) fn rate(rate: f64) -> String {
    match rate {
        0.0 => "0".to_owned(),
        ..0.095 => "<0.1".to_owned(),
        ..9.95 => format!("{rate:.1}"),
        ..9_999.5 => format!("{rate:.0}"),
        ..999_500.0 => format!("{:.0}k", rate / 1e3),
        _ => format!("{:.1}M", rate / 1e6),
    }
}

/// A number in at most five characters.
pub(super) fn count(number: u64) -> String {
    match number {
        0..=9_999 => number.to_string(),
        10_000..=9_999_999 => format!("{}k", number / 1000),
        10_000_000..=9_999_999_999 => format!("{}M", number / 1_000_000),
        _ => ">9G".to_owned(),
    }
}

/// A time in at most seven characters.
pub(super) fn time(time: Option<Duration>) -> String {
    let Some(time) = time else {
        return "-".to_owned();
    };
    let micros = time.as_secs_f64() * 1e6;
    match micros {
        ..999.5 => format!("{micros:.0} µs"),
        ..9_950.0 => format!("{:.1} ms", micros / 1e3),
        ..999_500.0 => format!("{:.0} ms", micros / 1e3),
        ..99.5e6 => format!("{:.1} s", micros / 1e6),
        ..9_999.5e6 => format!("{:.0} s", micros / 1e6),
        _ => "> 2 h".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn agent(name: &str, sent: f64, median: u64) -> AgentRow {
        let latency = (median > 0).then(|| Latency {
            median: Duration::from_millis(median),
            percentile_99: Duration::from_millis(2 * median),
        });
        AgentRow {
            name: name.to_owned(),
            rates: Rates {
                sent,
                ..Rates::default()
            },
            total: Counts::default(),
            latency,
            via: None,
        }
    }

    fn snapshot(agents: Vec<AgentRow>) -> Snapshot {
        let now = Instant::now();
        let meter = Meter::new(now, Duration::from_secs(5));
        let surroundings = Surroundings {
            domain: "default".to_owned(),
            host: "sherpa".to_owned(),
            time: SystemTime::UNIX_EPOCH,
            here: 0,
            elsewhere: 0,
            processes: 0,
            gateway: None,
            problem: None,
        };
        Snapshot {
            agents,
            ..Snapshot::new(now, &meter, Vec::new(), surroundings)
        }
    }

    fn names<'a>(rows: &[&'a AgentRow]) -> Vec<&'a str> {
        rows.iter().map(|row| row.name.as_str()).collect()
    }

    #[test]
    fn numbers_are_sorted_from_the_largest_and_names_from_the_first() {
        let agents = vec![agent("b", 1.0, 5), agent("c", 9.0, 0), agent("a", 1.0, 7)];
        let snapshot = snapshot(agents);
        let sorted = |column, reversed| {
            let order = Order { column, reversed };
            names(&snapshot.sorted(order, None)).concat()
        };
        assert_eq!(sorted(Column::Agent, false), "abc");
        assert_eq!(sorted(Column::Agent, true), "cba");
        assert_eq!(sorted(Column::Sent, false), "cab");
        assert_eq!(sorted(Column::Sent, true), "abc");
        assert_eq!(sorted(Column::Median, false), "abc");
        assert_eq!(sorted(Column::P99, true), "cba");
        assert_eq!(sorted(Column::Via, false), "abc");
    }

    #[test]
    fn a_pattern_selects_agents() {
        let agents = vec![
            agent("arm_1", 1.0, 0),
            agent("arm_2", 2.0, 0),
            agent("rover", 3.0, 0),
        ];
        let snapshot = snapshot(agents);
        let order = Order {
            column: Column::Agent,
            reversed: false,
        };
        let arms = Matcher::parse("arm_.*").unwrap();
        assert_eq!(
            names(&snapshot.sorted(order, Some(&arms))),
            ["arm_1", "arm_2"]
        );
    }

    #[test]
    fn numbers_fit_their_columns() {
        let rates = [
            (0.0, "0"),
            (0.01, "<0.1"),
            (0.5, "0.5"),
            (9.96, "10"),
            (1234.0, "1234"),
            (12_345.0, "12k"),
            (1.5e6, "1.5M"),
        ];
        for (value, text) in rates {
            assert_eq!(rate(value), text);
        }
        for (number, text) in [(7, "7"), (12_345, "12k"), (123_456_789, "123M")] {
            assert_eq!(count(number), text);
        }
        assert_eq!(count(u64::MAX), ">9G");
        let times = [
            (85, "85 µs"),
            (1234, "1.2 ms"),
            (340_000, "340 ms"),
            (1_500_000, "1.5 s"),
            (120_000_000, "120 s"),
        ];
        for (micros, text) in times {
            assert_eq!(time(Some(Duration::from_micros(micros))), text);
        }
        assert_eq!(time(None), "-");
        assert_eq!(time(Some(Duration::MAX)), "> 2 h");
    }
}
