//! The hosts of other gateways, from the reports of the gateway of this host. No I/O and no clock.

use std::time::{Duration, Instant};

use fipa::Kind;
use fipa::admin::routes::{Connected, RouteReport, RouteState};
use fipa_acl::escape_name;

use super::meter::Meter;
use super::window::{Latency, Rates};

/// Maximum number of shown hosts.
const MAX_PEERS: usize = 256;

/// The state of a peer host.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(in crate::command) enum PeerState {
    /// Connected for this time.
    Connected(Duration),
    /// Not connected for this time.
    Lost(Duration),
    /// A static peer that does not answer.
    Silent,
}

/// A peer host.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::command) struct PeerRow {
    /// Its name, which its gateway claims or proves.
    pub(in crate::command) name: String,
    pub(in crate::command) state: PeerState,
    /// The letters of its agents (`sent`) and to its agents (`received`).
    pub(in crate::command) rates: Rates,
    /// Delivery times of letters to its agents.
    pub(in crate::command) latency: Option<Latency>,
    /// The transports that have carried letters to it or, before the first letter, those that can.
    pub(in crate::command) transports: Vec<Kind>,
    /// Whether its connections are encrypted; `None` without a connection.
    pub(in crate::command) encrypted: Option<bool>,
    /// The attempts since the start of the gateway that failed or that the peer rejected. Each was tried again, on
    /// this or another route, or failed its letter.
    pub(in crate::command) retries: u64,
}

impl PeerRow {
    /// The name for a terminal.
    pub(super) fn shown_name(&self) -> String {
        escape_name(&self.name).into_owned()
    }
}

/// The latest report of the gateway.
#[derive(Debug, Default)]
pub(super) struct Peers {
    report: Option<(Instant, RouteReport)>,
    problem: Option<String>,
}

impl Peers {
    /// Handles a report; `None` if no gateway is running.
    pub(super) fn handle_report(&mut self, now: Instant, report: Option<RouteReport>) {
        self.report = report.map(|report| (now, report));
        self.problem = None;
    }

    /// Handles a request for a report that failed. The last report stays.
    pub(super) fn handle_failure(&mut self, problem: String) {
        self.problem = Some(problem);
    }

    /// The reason why there is no recent report.
    pub(super) fn problem(&self) -> Option<&str> {
        self.problem.as_deref()
    }

    /// The connected hosts, the lost ones, and the static peers that do not answer, by name.
    pub(super) fn rows(&self, now: Instant, meter: &Meter) -> Vec<PeerRow> {
        let Some((at, report)) = &self.report else {
            return Vec::new();
        };
        let since = |seconds: u64| {
            Duration::from_secs(seconds).saturating_add(now.saturating_duration_since(*at))
        };
        let connected = report.neighbors.iter().map(|neighbor| {
            let state = PeerState::Connected(since(neighbor.seconds));
            let mut row = row(&neighbor.name, state, now, meter);
            row.encrypted = Some(neighbor.security.encrypted);
            let ways: Vec<&RouteState> = ways(neighbor, report).collect();
            let attempts = ways
                .iter()
                .map(|way| way.failed.saturating_add(way.turned_back));
            row.retries = attempts.fold(0, u64::saturating_add);
            let used = ways.iter().filter(|way| way.taken > 0);
            row.transports = kinds(used.map(|way| way.location.kind()));
            if row.transports.is_empty() {
                row.transports = kinds(neighbor.locations.iter().map(fipa::Location::kind));
            }
            row
        });
        let is_connected = |name: &str| report.neighbors.iter().any(|it| it.name == name);
        let lost = report.lost.iter().filter(|host| !is_connected(&host.name));
        let lost = lost.map(|host| {
            let state = PeerState::Lost(since(host.seconds));
            row(&host.name, state, now, meter)
        });
        let is_lost = |name: &str| report.lost.iter().any(|it| it.name == name);
        let silent = report.peers.iter().filter(|peer| {
            peer.answers.is_none() && !is_connected(&peer.name) && !is_lost(&peer.name)
        });
        let silent = silent.map(|peer| row(&peer.name, PeerState::Silent, now, meter));
        let mut rows: Vec<PeerRow> = connected
            .chain(lost)
            .chain(silent)
            .take(MAX_PEERS)
            .collect();
        rows.sort_by(|a, b| a.name.cmp(&b.name));
        rows
    }
}

fn row(name: &str, state: PeerState, now: Instant, meter: &Meter) -> PeerRow {
    let counter = meter.of_host(name);
    let slots = meter.slots();
    PeerRow {
        name: name.to_owned(),
        state,
        rates: counter.map_or_else(Rates::default, |it| it.rates(now, slots)),
        latency: counter.and_then(|it| it.latency(now, slots)),
        transports: Vec::new(),
        encrypted: None,
        retries: 0,
    }
}

/// The counters of the locations of a peer.
fn ways<'a>(
    neighbor: &'a Connected,
    report: &'a RouteReport,
) -> impl Iterator<Item = &'a RouteState> {
    let known = &neighbor.locations;
    report
        .ways
        .iter()
        .filter(|way| known.contains(&way.location))
}

fn kinds(kinds: impl Iterator<Item = Kind>) -> Vec<Kind> {
    let mut kinds: Vec<Kind> = kinds.collect();
    kinds.sort_unstable();
    kinds.dedup();
    kinds
}

#[cfg(test)]
pub(super) mod tests;
