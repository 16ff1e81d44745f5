//! Prints the domain as tables and as JSON.

use std::time::Duration;

use fipa::Matcher;
use fipa_acl::{escape, escape_name};
use serde_json::{Map, Value, json};

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
    let agents = snapshot.sorted(order, shown).into_iter().map(agent_object);
    let agents = agents.collect::<Vec<_>>();
    let mut object = totals_object(snapshot);
    let mut put = |key: &str, value: Value| object.insert(key.to_owned(), value);
    put(
        "time",
        output::rfc3339(snapshot.header.surroundings.time).into(),
    );
    put("agents", agents.into());
    put("others", snapshot.others.as_ref().map(agent_object).into());
    put(
        "hosts",
        snapshot
            .peers
            .iter()
            .map(peer_object)
            .collect::<Vec<_>>()
            .into(),
    );
    Value::Object(object)
}

/// The values of the whole domain, without the time.
pub(in crate::command) fn totals_object(snapshot: &Snapshot) -> Map<String, Value> {
    let Header {
        surroundings,
        rates,
        total,
        latency,
        lost,
    } = &snapshot.header;
    let totals = json!({
        "domain": surroundings.domain, "host": surroundings.host,
        "agents_here": surroundings.here, "agents_elsewhere": surroundings.elsewhere,
        "processes": surroundings.processes, "gateway": surroundings.gateway,
        "problem": surroundings.problem,
        "letters_per_second": rounded(rates.sent), "failures_per_second": rounded(rates.failed),
        "violations_per_second": rounded(rates.violations),
        "letters": total.sent, "failures": total.failed, "violations": total.violations,
        "median_us": median(*latency), "p99_us": percentile_99(*latency), "lost": lost,
    });
    match totals {
        Value::Object(totals) => totals,
        _ => Map::new(),
    }
}

/// The object of an agent.
pub(in crate::command) fn agent_object(row: &AgentRow) -> Value {
    let AgentRow {
        name,
        rates,
        total,
        latency,
        via,
    } = row;
    json!({
        "name": name, "sent_per_second": rounded(rates.sent),
        "received_per_second": rounded(rates.received), "failures_per_second": rounded(rates.failed),
        "sent": total.sent, "received": total.received, "failures": total.failed,
        "violations": total.violations, "median_us": median(*latency),
        "p99_us": percentile_99(*latency), "via": via.map(fipa::Kind::name),
    })
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
