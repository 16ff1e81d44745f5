//! Prints the domain as tables and as JSON.

use std::time::Duration;

use fipa::Matcher;
use fipa_acl::{escape, escape_name};
use serde::Serialize;
use serde_json::{Value, json};

use super::peers::{PeerRow, PeerState};
use super::table::{self, AgentRow, Column, Header, Order, PEER_TITLES, Snapshot};
use super::window::Latency;
use crate::command::watch::text::time_of_day;
use crate::output;

/// The tables as text.
pub(super) fn text(snapshot: &Snapshot, order: Order, shown: Option<&Matcher>) -> String {
    let mut text = head(&snapshot.header);
    let mut agents = output::table(Column::ALL.map(Column::title));
    let others = snapshot.others.as_ref().filter(|_| shown.is_none());
    for row in snapshot.sorted(order, shown).into_iter().chain(others) {
        agents.add_row(Column::ALL.map(|column| column.cell(row)));
    }
    output::cut_to_lines(&mut agents);
    text.push_str(&format!("{}\n", agents.trim_fmt()));
    if !snapshot.peers.is_empty() {
        let mut peers = output::table(PEER_TITLES);
        for row in &snapshot.peers {
            peers.add_row(table::peer_cells(row));
        }
        output::cut_to_lines(&mut peers);
        text.push_str(&format!("\n{}\n", peers.trim_fmt()));
    }
    text.push('\n');
    text
}

fn head(header: &Header) -> String {
    let there = &header.surroundings;
    let gateway = there.gateway.as_deref();
    let gateway = gateway.map(|name| format!("gateway {}", escape_name(name)));
    let mut text = format!(
        "{} UTC, domain {} on {}: agents {} here, {} elsewhere; processes {}; {}\n",
        time_of_day(there.time, 8),
        escape_name(&there.domain),
        escape_name(&there.host),
        there.here,
        there.elsewhere,
        there.processes,
        gateway.as_deref().unwrap_or("no gateway"),
    );
    if let Some(problem) = &there.problem {
        text.push_str(&format!("{}\n", escape(problem)));
    }
    text.push_str(&format!(
        "letters {}/s, failures {}/s, violations {}, median {}, p99 {}, lost records {}\n",
        table::rate(header.rates.sent),
        table::rate(header.rates.failed),
        table::count(header.total.violations),
        table::time(header.latency.map(|it| it.median)),
        table::time(header.latency.map(|it| it.percentile_99)),
        table::count(header.lost),
    ));
    text
}

/// The domain as a JSON object.
pub(super) fn json(snapshot: &Snapshot, order: Order, shown: Option<&Matcher>) -> Value {
    let agents = snapshot.sorted(order, shown).into_iter();
    json!(DomainObject {
        totals: TotalsObject::of(snapshot),
        time: output::rfc3339(snapshot.header.surroundings.time),
        agents: agents.map(AgentObject::of).collect(),
        others: snapshot.others.as_ref().map(AgentObject::of),
        hosts: snapshot.peers.iter().map(peer_object).collect(),
    })
}

#[derive(Debug, Serialize)]
struct DomainObject<'a> {
    #[serde(flatten)]
    totals: TotalsObject<'a>,
    time: Option<String>,
    agents: Vec<AgentObject<'a>>,
    others: Option<AgentObject<'a>>,
    hosts: Vec<Value>,
}

/// The values of the whole domain, without the time.
#[derive(Debug, Serialize)]
pub(in crate::command) struct TotalsObject<'a> {
    domain: &'a str,
    host: &'a str,
    agents_here: usize,
    agents_elsewhere: usize,
    processes: usize,
    gateway: Option<&'a str>,
    problem: Option<&'a str>,
    pub(in crate::command) letters_per_second: f64,
    pub(in crate::command) failures_per_second: f64,
    violations_per_second: f64,
    letters: u64,
    failures: u64,
    violations: u64,
    pub(in crate::command) median_us: Option<u64>,
    p99_us: Option<u64>,
    lost: u64,
}

impl<'a> TotalsObject<'a> {
    pub(in crate::command) fn of(snapshot: &'a Snapshot) -> Self {
        let Header {
            surroundings,
            rates,
            total,
            latency,
            lost,
        } = &snapshot.header;
        Self {
            domain: &surroundings.domain,
            host: &surroundings.host,
            agents_here: surroundings.here,
            agents_elsewhere: surroundings.elsewhere,
            processes: surroundings.processes,
            gateway: surroundings.gateway.as_deref(),
            problem: surroundings.problem.as_deref(),
            letters_per_second: rounded(rates.sent),
            failures_per_second: rounded(rates.failed),
            violations_per_second: rounded(rates.violations),
            letters: total.sent,
            failures: total.failed,
            violations: total.violations,
            median_us: median(*latency),
            p99_us: percentile_99(*latency),
            lost: *lost,
        }
    }
}

/// The counted letters of an agent.
#[derive(Debug, Serialize)]
pub(in crate::command) struct AgentCounts {
    sent_per_second: f64,
    received_per_second: f64,
    failures_per_second: f64,
    sent: u64,
    received: u64,
    failures: u64,
    violations: u64,
    median_us: Option<u64>,
    p99_us: Option<u64>,
    via: Option<&'static str>,
}

impl AgentCounts {
    pub(in crate::command) fn of(row: &AgentRow) -> Self {
        let AgentRow {
            name: _,
            rates,
            total,
            latency,
            via,
        } = row;
        Self {
            sent_per_second: rounded(rates.sent),
            received_per_second: rounded(rates.received),
            failures_per_second: rounded(rates.failed),
            sent: total.sent,
            received: total.received,
            failures: total.failed,
            violations: total.violations,
            median_us: median(*latency),
            p99_us: percentile_99(*latency),
            via: via.map(fipa::Kind::name),
        }
    }
}

/// The object of an agent.
#[derive(Debug, Serialize)]
struct AgentObject<'a> {
    name: &'a str,
    #[serde(flatten)]
    counts: AgentCounts,
}

impl<'a> AgentObject<'a> {
    fn of(row: &'a AgentRow) -> Self {
        Self {
            name: &row.name,
            counts: AgentCounts::of(row),
        }
    }
}

/// The object of another host.
pub(in crate::command) fn peer_object(row: &PeerRow) -> Value {
    let (state, time) = match row.state {
        PeerState::Connected(time) => ("connected", Some(time)),
        PeerState::Lost(time) => ("lost", Some(time)),
        PeerState::Silent => ("no_answer", None),
    };
    let transports: Vec<&str> = row.transports.iter().map(|kind| kind.name()).collect();
    json!({
        "name": row.name, "state": state, "seconds": time.map(|time| time.as_secs()),
        "to_per_second": rounded(row.rates.received), "from_per_second": rounded(row.rates.sent),
        "median_us": median(row.latency), "p99_us": percentile_99(row.latency),
        "transports": transports, "encrypted": row.encrypted, "retries": row.retries,
    })
}

fn rounded(rate: f64) -> f64 {
    (rate * 1e3).round() / 1e3
}

fn median(latency: Option<Latency>) -> Option<u64> {
    latency.map(|it| micros(it.median))
}

fn percentile_99(latency: Option<Latency>) -> Option<u64> {
    latency.map(|it| micros(it.percentile_99))
}

fn micros(time: Duration) -> u64 {
    u64::try_from(time.as_micros()).unwrap_or(u64::MAX)
}
