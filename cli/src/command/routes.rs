//! `fipa routes`: which way letters would go, and why.

use std::time::Duration;

use clap::Args;
use comfy_table::{Table, presets};
use fipa::routes::{self, AskError, Report, Route, Standing, WayState};
use fipa::{Domain, Incarnation, Matcher, Query, Reach, RegisterOptions, Role};
use fipa_acl::escape;
use serde_json::json;

use crate::membership;
use crate::options::Global;
use crate::output;
use crate::report::Failure;

/// Show which way letters would go now, and why
///
/// For every agent that is known here: the ways from a process of this host that starts now, in
/// the order in which they would be tried; for agents of other hosts also those from the gateway,
/// as it says itself. Then what has happened on each way of the gateway since it was started, its
/// static peers, and the gateways it is connected with.
///
/// A way that failed is put back: it is tried after all that work, until some time has passed,
/// and more time after every further failure.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa routes
  fipa routes 'arm_.*'
  fipa routes --json | jq '.gateway.ways[] | select(.failed > 0)'

JSON:
  { \"domain\": text, \"process\": report, \"gateway\": report, or null when none is running }
  report = { \"mts\": name, \"incarnation\", \"locations\": [ text ],
    \"routes\": [ { \"receiver\", \"incarnation\", \"gateway\": incarnation or null,
                  \"exception\": the pattern of [routes] that decides, or null,
                  \"ways\": [ { \"location\", \"standing\": { \"standing\": \"ready\", \"failing\"
                              \"not_in_order\" or \"unsupported\", with \"milliseconds\", \"failures\" and
                              \"error\" when it is failing } } ] } ],
    \"ways\": [ { \"location\", \"standing\", \"in_flight\", \"tried\", \"taken\", \"turned_back\",
                \"failed\", \"last_error\", \"last_error_seconds\" } ],
    \"peers\": [ { \"name\", \"answers\": location or null, \"failures\": [ [ location, text ] ],
                 \"asked_again_in\": milliseconds or null } ],
    \"neighbours\": [ { \"name\", \"incarnation\", \"locations\", \"connections\", \"seconds\" } ] }")]
pub(crate) struct Arguments {
    /// Only to those with this name, or whose name matches this pattern
    #[arg(value_parser = parse_receivers)]
    pattern: Option<Receivers>,

    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Receivers as they were written, and what that means.
#[derive(Debug, Clone)]
struct Receivers {
    text: String,
    matcher: Matcher,
}

fn parse_receivers(text: &str) -> Result<Receivers, fipa::PatternError> {
    Ok(Receivers {
        text: text.to_owned(),
        matcher: Matcher::parse(text)?,
    })
}

/// How long the gateway has to answer.
const PATIENCE: Duration = Duration::from_secs(5);

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    let config = global.config()?;
    let pattern = arguments.pattern.as_ref();
    let query = pattern.map_or_else(Query::all, |it| Query::by_name(it.matcher.clone()));
    let (process, gateway) = membership::run(async {
        let domain = membership::join(&config).await?;
        domain.directory().refresh();
        let process = domain.routes(&query);
        let asked = ask(&domain, pattern.map(|it| it.text.as_str())).await;
        domain.close().await;
        Ok((process, asked?))
    })?;
    if arguments.json {
        return output::json(
            &json!({ "domain": config.domain, "process": process, "gateway": gateway }),
        );
    }
    if process.routes.is_empty() {
        let name = pattern.map_or("", |_| " by that name");
        let domain = &config.domain;
        return output::text(&format!(
            "nobody in the domain {domain} is known here{name}\n"
        ));
    }
    output::text(&told(&process, gateway.as_ref()))
}

/// What the gateway of this host says, if there is one.
async fn ask(domain: &Domain, receivers: Option<&str>) -> Result<Option<Report>, Failure> {
    let entries = domain.directory().entries();
    let mut gateways = entries
        .iter()
        .filter(|entry| entry.role == Role::Gateway && entry.reach == Reach::Local);
    let Some(gateway) = gateways.next() else {
        return Ok(None);
    };
    let name = format!("fipa-routes-{}", Incarnation::random());
    let not_told = |error: &dyn std::fmt::Display| {
        Failure::failed(
            error.to_string(),
            format!("the gateway {:?}", gateway.name),
            "see its log; if it hangs, end it and start it again with `fipa up`",
        )
    };
    let agent = domain
        .register_with(&name, RegisterOptions::default())
        .map_err(|error| not_told(&error))?;
    let report = routes::of_gateway(&agent, gateway, receivers, PATIENCE).await;
    match report {
        Ok(mut report) => {
            report.routes.retain(|route| route.receiver != name);
            Ok(Some(report))
        }
        Err(AskError::NotDelivered(_)) if domain.directory().lookup(&gateway.name).is_none() => {
            Ok(None)
        }
        Err(error) => Err(not_told(&error)),
    }
}

fn told(process: &Report, gateway: Option<&Report>) -> String {
    let mut text = String::new();
    let mut table = table(&["TO", "FROM", "WAY", "STANDING"]);
    for route in &process.routes {
        rows_of(&mut table, route, "here");
        let onwards = gateway.filter(|_| route.gateway.is_some());
        let same = |other: &&Route| other.incarnation == route.incarnation;
        if let Some(onwards) = onwards.and_then(|it| it.routes.iter().find(same)) {
            rows_of(&mut table, onwards, "the gateway");
        }
    }
    text.push_str(&format!("{}\n", table.trim_fmt()));
    match gateway {
        Some(gateway) => text.push_str(&gateway_told(gateway)),
        None => text.push_str("\nno gateway is running; agents of other hosts are not reached\n"),
    }
    text
}

fn gateway_told(gateway: &Report) -> String {
    let locations: Vec<String> = gateway.locations.iter().map(ToString::to_string).collect();
    let mut text = format!("\nThe gateway {}:\n", escape(&gateway.mts));
    text.push_str(&format!("takes letters at {}\n", locations.join(", ")));
    let mut ways = table(&[
        "WAY",
        "STANDING",
        "UNDER WAY",
        "TRIED",
        "TAKEN",
        "TURNED BACK",
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
        text.push_str("has sent no letters yet\n");
    } else {
        text.push_str(&format!("{}\n", ways.trim_fmt()));
    }
    for peer in &gateway.peers {
        let stands = match (&peer.answers, peer.failures.last()) {
            (Some(location), _) => format!("answers at {location}"),
            (None, Some((location, why))) => {
                format!("does not answer; last at {location}: {}", escape(why))
            }
            (None, None) => "has not answered yet".to_owned(),
        };
        text.push_str(&format!("static peer {}: {stands}\n", escape(&peer.name)));
    }
    for neighbour in &gateway.neighbours {
        let locations = neighbour.locations.iter().map(ToString::to_string);
        let locations: Vec<String> = locations.collect();
        let since = humantime::format_duration(Duration::from_secs(neighbour.seconds));
        text.push_str(&format!(
            "connected with {} for {since}: {}\n",
            escape(&neighbour.name),
            locations.join(", ")
        ));
    }
    text
}

fn rows_of(table: &mut Table, route: &Route, from: &str) {
    let receiver = match &route.exception {
        Some(pattern) => format!("{} (by routes.{pattern:?})", escape(&route.receiver)),
        None => escape(&route.receiver).into_owned(),
    };
    if route.ways.is_empty() {
        table.add_row([receiver.as_str(), from, "none", "it has no locations"]);
    }
    let mut first = true;
    for way in &route.ways {
        let to = if first { receiver.as_str() } else { "" };
        let from = if first { from } else { "" };
        let mut standing = standing(&way.standing);
        if !matches!(way.standing, Standing::NotInOrder | Standing::Unsupported) {
            standing = format!("{}, {standing}", if first { "first" } else { "then" });
        }
        table.add_row([to, from, &way.location.to_string(), &standing]);
        first = false;
    }
}

fn standing(standing: &Standing) -> String {
    match standing {
        Standing::Ready => "ready".to_owned(),
        Standing::Failing {
            milliseconds,
            failures,
            error,
        } => {
            let left = humantime::format_duration(Duration::from_millis(*milliseconds));
            format!(
                "failed {failures} times, put back for {left}: {}",
                escape(error)
            )
        }
        Standing::NotInOrder => "not used: not in the order of transports".to_owned(),
        Standing::Unsupported => "not used: unsupported transport".to_owned(),
        other => format!("{other:?}"),
    }
}

fn last_error(way: &WayState) -> String {
    match (&way.last_error, way.last_error_seconds) {
        (Some(error), Some(seconds)) => {
            let ago = humantime::format_duration(Duration::from_secs(seconds));
            format!("{} ({ago} ago)", escape(error))
        }
        _ => String::new(),
    }
}

fn table(columns: &[&str]) -> Table {
    let mut table = Table::new();
    table.load_style(presets::NOTHING).set_header(columns);
    for column in table.column_iter_mut() {
        column.set_padding((0, 2));
    }
    table
}
