//! `fipa routes`: the routes that letters would take now.

use std::time::Duration;

use clap::Args;
use comfy_table::Table;
use fipa::admin::routes::{Connected, Route, RouteReport, RouteState, Standing};
use fipa::admin::stopped::StoppedAgent;
use fipa::{Config, Kind, Location, Matcher, Query, Signature};
use fipa_acl::{escape, escape_name};
use serde_json::{Value, json};

use crate::complete;
use crate::membership;
use crate::options::Global;
use crate::output;
use crate::report::Failure;

/// Show the routes that letters would take now
///
/// Lists, for every known agent, the routes from a new process of this host in the order in which
/// they would be tried. For agents on other hosts it also lists the routes from the gateway, as the
/// gateway reports them. Then it lists the gateway's counters for each route since its start, its
/// static peers and its connected gateways, with the certificates that they have proved.
///
/// A route that failed is tried after all working routes until its backoff ends. The backoff grows
/// with each further failure.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa routes
  fipa routes 'arm_.*'                      routes to agents whose names match
  fipa routes --json | jq '.gateway.ways[] | select(.failed > 0)'

Columns:
  STATUS       whether and when the route would be used; first and then give the order
  IN FLIGHT    letters sent and not yet answered
  TRIED        attempts to send a letter
  TAKEN        letters accepted by the peer, or sent to a peer that cannot confirm
  REJECTED     letters that the peer did not accept, for example because its queue was full
  FAILED       attempts without a connection or an answer
  SECURITY     whether letters are encrypted (TLS or QUIC)
  CERTIFICATE  the first digits of its fingerprint; `fipa keys list` shows all

JSON:
  { \"domain\": text, \"process\": report, \"gateway\": report, or null if no gateway is running,
    \"stopped\": stopped }
  report = { \"mts\": name, \"incarnation\", \"locations\": [ text ],
    \"routes\": [ { \"receiver\", \"incarnation\", \"gateway\": incarnation or null,
                  \"exception\": the matching pattern of [routes], or null,
                  \"ways\": [ { \"location\", \"standing\": { \"standing\": \"ready\", \"failing\",
                              \"not_in_order\" or \"unsupported\", with \"milliseconds\", \"failures\" and
                              \"error\" if it is failing } } ] } ],
    \"ways\": [ { \"location\", \"standing\", \"in_flight\", \"tried\", \"taken\", \"turned_back\",
                \"failed\", \"last_error\", \"last_error_seconds\" } ],
    \"peers\": [ { \"name\", \"answers\": location or null, \"failures\": [ [ location, text ] ],
                 \"asked_again_in\": milliseconds or null } ],
    \"neighbors\": [ { \"name\", \"incarnation\", \"locations\", \"connections\", \"seconds\",
                      \"security\": { \"encrypted\": true or false,
                                    \"certificate\": fingerprint or null } } ],
    \"configuration\": { key: value as TOML } of a gateway }
  stopped = [ { \"receiver\", \"process\" } ], the receivers whose process is stopped")]
pub(crate) struct Arguments {
    /// Show only routes to agents with this name or with a name that matches this pattern
    #[arg(value_parser = parse_receivers, add = complete::agents())]
    pattern: Option<Receivers>,

    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// A pattern of receivers: its text and its parsed form.
#[derive(Debug, Clone)]
struct Receivers {
    text: String,
    matcher: Matcher,
}

fn parse_receivers(text: &str) -> Result<Receivers, fipa::error::PatternError> {
    Ok(Receivers {
        text: text.to_owned(),
        matcher: Matcher::parse(text)?,
    })
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    let config = global.config()?;
    let pattern = arguments.pattern.as_ref();
    let query = pattern.map_or_else(Query::all, |it| Query::by_name(it.matcher.clone()));
    let (process, gateway, stopped) = membership::run(async {
        let domain = membership::join(&config).await?;
        domain.directory().refresh();
        let process = domain.routes(&query);
        let known = |route: &Route| StoppedAgent::of(&*domain.directory().known(&route.receiver)?);
        let stopped: Vec<StoppedAgent> = process.routes.iter().filter_map(known).collect();
        let gateway = membership::gateway_report(&domain, pattern.map(|it| it.text.as_str())).await;
        domain.close().await;
        Ok((process, gateway?, stopped))
    })?;
    if arguments.json {
        let in_json = stopped
            .iter()
            .map(|it| json!({ "receiver": it.name, "process": it.process }));
        let in_json: Vec<Value> = in_json.collect();
        return output::json(
            &json!({ "domain": config.domain, "process": process, "gateway": gateway, "stopped": in_json }),
        );
    }
    if process.routes.is_empty() {
        let named = pattern.map_or("", |_| " with this name");
        let domain = &config.domain;
        return output::text(&format!("no agent{named} is known in domain {domain}\n"));
    }
    output::text(&described(&process, gateway.as_ref(), &stopped, &config))
}

fn described(
    process: &RouteReport,
    gateway: Option<&RouteReport>,
    stopped: &[StoppedAgent],
    config: &Config,
) -> String {
    let mut text = String::new();
    let mut table = output::table(["TO", "FROM", "ROUTE", "STATUS"]);
    for route in &process.routes {
        let stopped = stopped.iter().find(|it| *it.name == *route.receiver);
        rows_of(&mut table, route, "this host", stopped, |location| {
            unused_by_process(route, location, config)
        });
        let remote = gateway.filter(|_| route.gateway.is_some());
        let same = |other: &&Route| other.incarnation == route.incarnation;
        if let Some((gateway, onward)) =
            remote.and_then(|it| Some((it, it.routes.iter().find(same)?)))
        {
            rows_of(&mut table, onward, "gateway", None, |location| {
                unused_by_gateway(onward, location, gateway)
            });
        }
    }
    text.push_str(&format!("{}\n", table.trim_fmt()));
    for agent in stopped {
        text.push_str(&format!("\n{}\n", agent.advice()));
    }
    match gateway {
        Some(gateway) => text.push_str(&gateway_described(gateway)),
        None => text.push_str("\nno gateway is running, so agents on other hosts are unreachable; start one with `fipa up`\n"),
    }
    text
}

fn gateway_described(gateway: &RouteReport) -> String {
    let locations: Vec<String> = gateway.locations.iter().map(ToString::to_string).collect();
    let mut text = format!("\nGateway {}:\n", escape_name(&gateway.mts));
    text.push_str(&format!("listening on {}\n", locations.join(", ")));
    let mut ways = output::table([
        "ROUTE",
        "STATUS",
        "IN FLIGHT",
        "TRIED",
        "TAKEN",
        "REJECTED",
        "FAILED",
        "LAST ERROR",
    ]);
    for way in &gateway.ways {
        ways.add_row([
            way.location.to_string(),
            standing(&way.standing),
            way.in_flight.to_string(),
            way.tried.to_string(),
            way.taken.to_string(),
            way.turned_back.to_string(),
            way.failed.to_string(),
            last_error(way),
        ]);
    }
    if gateway.ways.is_empty() {
        text.push_str("no letters sent yet\n");
    } else {
        text.push_str(&format!("{}\n", ways.trim_fmt()));
    }
    for peer in &gateway.peers {
        let status = match (&peer.answers, peer.failures.last()) {
            (Some(location), _) => format!("responding at {location}"),
            (None, Some((location, why))) => {
                format!(
                    "not responding; last attempt at {location}: {}",
                    escape(why)
                )
            }
            (None, None) => "no response yet".to_owned(),
        };
        text.push_str(&format!(
            "static peer {}: {status}\n",
            escape_name(&peer.name)
        ));
    }
    if !gateway.neighbors.is_empty() {
        text.push_str(&connections(&gateway.neighbors));
    }
    text
}

/// The connected gateways, whether letters to them are encrypted, and the certificates that they proved.
fn connections(neighbors: &[Connected]) -> String {
    let mut table = output::table([
        "CONNECTED TO",
        "FOR",
        "SECURITY",
        "CERTIFICATE",
        "LOCATIONS",
    ]);
    for neighbor in neighbors {
        let locations = neighbor.locations.iter().map(ToString::to_string);
        let locations: Vec<String> = locations.collect();
        let since = humantime::format_duration(Duration::from_secs(neighbor.seconds));
        let certificate = neighbor.security.certificate.as_deref();
        table.add_row([
            escape_name(&neighbor.name).into_owned(),
            since.to_string(),
            security(neighbor.security.encrypted).to_owned(),
            certificate.map_or("-", fingerprint).to_owned(),
            locations.join("\n"),
        ]);
    }
    format!("\n{}\n", table.trim_fmt())
}

/// The security of a link as table text.
pub(super) fn security(encrypted: bool) -> &'static str {
    match encrypted {
        true => "encrypted",
        false => "not encrypted",
    }
}

/// The first digits of a fingerprint, which `fipa keys` accepts.
fn fingerprint(certificate: &str) -> &str {
    certificate.get(..16).unwrap_or(certificate)
}

/// Adds the rows of a route. `unused` returns the reason why no letter takes a location.
fn rows_of(
    table: &mut Table,
    route: &Route,
    from: &str,
    stopped: Option<&StoppedAgent>,
    unused: impl Fn(&Location) -> String,
) {
    let receiver = match &route.exception {
        Some(pattern) => format!("{} (by routes.{pattern:?})", escape_name(&route.receiver)),
        None => escape_name(&route.receiver).into_owned(),
    };
    if route.ways.is_empty() {
        table.add_row([
            receiver.as_str(),
            from,
            "none",
            "the agent has no locations",
        ]);
    }
    let mut first = true;
    for way in &route.ways {
        let to = if first { receiver.as_str() } else { "" };
        let from = if first { from } else { "" };
        let place = if first { "first" } else { "then" };
        let status = match &way.standing {
            Standing::NotInOrder => format!("not used: {}", unused(&way.location)),
            Standing::Unsupported => standing(&way.standing),
            Standing::Ready if let Some(StoppedAgent { process, .. }) = stopped => {
                format!("{place}, but process {process} is stopped")
            }
            used => format!("{place}, {}", standing(used)),
        };
        table.add_row([to, from, &way.location.to_string(), &status]);
        first = false;
    }
}

/// The reason why a process does not use a location of a receiver.
fn unused_by_process(route: &Route, location: &Location, config: &Config) -> String {
    let kind = location.kind();
    let rule = route
        .exception
        .as_ref()
        .and_then(|pattern| config.routes.iter().find(|it| it.receiver == *pattern));
    match rule {
        _ if is_for_legacy_peers(location) => FOR_LEGACY_PEERS.to_owned(),
        _ if !config.mts.transports.contains(&kind) => NOT_LISTED.to_owned(),
        Some(rule) if !rule.transports.contains(&kind) => not_in_rule(&rule.receiver),
        _ if kind == Kind::Tcp && !config.transport.tcp.processes => {
            "transport.tcp.processes is false, so only the gateway uses tcp".to_owned()
        }
        _ => format!("only the gateway uses {kind}"),
    }
}

/// The reason why the gateway, which uses all transports that it lists, does not use a location of a receiver.
fn unused_by_gateway(route: &Route, location: &Location, gateway: &RouteReport) -> String {
    let listed = gateway.configuration.get("mts.transports");
    let is_listed = listed.is_some_and(|it| it.contains(&format!("\"{}\"", location.kind())));
    match &route.exception {
        _ if is_for_legacy_peers(location) => FOR_LEGACY_PEERS.to_owned(),
        Some(pattern) if is_listed => not_in_rule(pattern),
        _ => NOT_LISTED.to_owned(),
    }
}

const NOT_LISTED: &str = "transport not listed in mts.transports";

const FOR_LEGACY_PEERS: &str = "for letters of legacy peers";

/// Whether a service of this project takes only letters of legacy peers at this location.
fn is_for_legacy_peers(location: &Location) -> bool {
    location.signature() != Signature::Frames && location.incarnation().is_known()
}

fn not_in_rule(pattern: &str) -> String {
    format!("transport not listed in routes.{pattern:?}")
}

fn standing(standing: &Standing) -> String {
    match standing {
        Standing::Ready => "ready".to_owned(),
        Standing::Failing {
            milliseconds,
            failures,
            error,
        } => {
            let time_left = humantime::format_duration(Duration::from_millis(*milliseconds));
            let times = if *failures == 1 { "time" } else { "times" };
            format!(
                "failed {failures} {times}, tried last for {time_left}: {}",
                escape(error)
            )
        }
        Standing::NotInOrder => "not used".to_owned(),
        Standing::Unsupported => "not used: unsupported transport".to_owned(),
        _ => "unknown state".to_owned(),
    }
}

fn last_error(way: &RouteState) -> String {
    match (&way.last_error, way.last_error_seconds) {
        (Some(error), Some(seconds)) => {
            let ago = humantime::format_duration(Duration::from_secs(seconds));
            format!("{} ({ago} ago)", escape(error))
        }
        _ => String::new(),
    }
}
