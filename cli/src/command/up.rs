//! `fipa up`: the gateway of a domain.

use std::time::Duration;

use clap::Args;
use fipa::{Change, Config, Entry, Gateway};
use fipa_acl::escape;
use serde_json::{Value, json};

use crate::membership::{self, Stop, Wish};
use crate::options::{self, Global};
use crate::output;
use crate::report::{self, Failure};

/// Run the gateway, which connects the agents of this host with those of other hosts
///
/// Listens on the network (transport.tcp.listen), announces the agents of this host by mDNS and
/// finds those of others, until Ctrl-C. Agents of one host reach each other without it. A domain
/// has one gateway on a host.
///
/// A hang-up signal (`kill -HUP`) makes it read its configuration again, without losing a letter:
/// mts.transports (their order), mts.deadline, [routes] and discovery.static; it says what has to
/// wait until it is started again.
///
/// Says on standard output what it is and where it listens. With -v, it logs to standard error
/// who joins and who leaves.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa up
  fipa up -v                                        who joins and who leaves
  fipa up --set security.keys=$HOME/.config/fipa/keys --set transport.tcp.listen=0.0.0.0:7788
                                                    open to hosts that are trusted (fipa keys)
  fipa up --set discovery.mdns=false                found by nobody who is not told
  fipa up --json | head -n 1                        one line when it is ready

JSON, one line when it is ready:
  { \"name\": text, \"incarnation\": text, \"domain\": text, \"locations\": [ text ],
    \"discovery\": { \"mdns\": true or false, \"problem\": text when there is one } }")]
pub(crate) struct Arguments {
    /// Print one line of JSON when it is ready
    #[arg(long)]
    json: bool,
}

/// How often a problem with finding other hosts is looked for. Nothing waits for it.
const LOOK_FOR_PROBLEMS: Duration = Duration::from_secs(5);

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    let config = global.config()?;
    options::block_on(serve(&config, arguments.json, global))?
}

async fn serve(config: &Config, json: bool, global: &Global) -> Result<(), Failure> {
    let mut stop = Stop::listen()?;
    let opened = Gateway::open(config).await;
    let mut gateway = opened.map_err(|error| membership::not_joined(error, config))?;
    let mut problem = gateway.discovery_problem();
    let mut changes = gateway.directory().watch();
    if json {
        output::json_line(&ready_json(config, &gateway, problem.as_deref()))?;
    } else {
        output::text(&ready(config, &gateway, problem.as_deref()))?;
    }
    for entry in gateway.directory().entries().iter() {
        tell("is there", entry);
    }
    let mut look = tokio::time::interval(LOOK_FOR_PROBLEMS);
    loop {
        tokio::select! {
            wish = stop.wish() => match wish {
                Wish::End => break,
                Wish::Reload => reload(&mut gateway, global),
            },
            Some(change) = changes.next() => log(&change),
            _ = look.tick() => {
                let now = gateway.discovery_problem();
                if now != problem {
                    match &now {
                        Some(text) => tracing::warn!("other hosts may not be found: {text}"),
                        None => tracing::info!("other hosts are found again"),
                    }
                    problem = now;
                }
            }
        }
    }
    tracing::info!("ending");
    Stop::ending();
    gateway.close().await;
    Ok(())
}

/// Reads the configuration again. One with mistakes changes nothing.
fn reload(gateway: &mut Gateway, global: &Global) {
    let reloaded = global.config().and_then(|config| {
        let later = gateway.reload(&config)?;
        Ok(later)
    });
    match reloaded {
        Ok(later) => {
            tracing::info!("the configuration was read again");
            if !later.is_empty() {
                let later = later.join(", ");
                report::warn(&format!(
                    "what has changed in {later} is used when the gateway is started again"
                ));
            }
        }
        // It is told; the gateway goes on as it was.
        Err(failure) => drop(failure.report()),
    }
}

fn ready(config: &Config, gateway: &Gateway, problem: Option<&str>) -> String {
    let mut text = format!(
        "gateway {} of the domain {} is ready\n",
        escape(gateway.name()),
        config.domain
    );
    for location in gateway.locations() {
        text.push_str(&format!("  listens at {location}\n"));
    }
    let discovery = match (config.discovery.mdns, problem) {
        (false, _) => "are not looked for (discovery.mdns = false)".to_owned(),
        (true, None) => "are looked for by mDNS".to_owned(),
        (true, Some(problem)) => format!("may not be found by mDNS: {}", escape(problem)),
    };
    text.push_str(&format!("  other hosts {discovery}\n  Ctrl-C ends it\n"));
    text
}

fn ready_json(config: &Config, gateway: &Gateway, problem: Option<&str>) -> Value {
    let locations = gateway.locations();
    let locations = locations.iter().map(ToString::to_string);
    let mut discovery = json!({ "mdns": config.discovery.mdns });
    if let Some(problem) = problem {
        discovery["problem"] = problem.into();
    }
    json!({
        "name": gateway.name(),
        "incarnation": gateway.incarnation(),
        "domain": config.domain,
        "locations": locations.collect::<Vec<_>>(),
        "discovery": discovery,
    })
}

fn log(change: &Change) {
    match change {
        Change::Together(changes) => changes.iter().for_each(log),
        Change::Joined(entry) => tell("joined", entry),
        Change::Changed { after, .. } => tell("changed", after),
        Change::Left(entry) => tell("left", entry),
        Change::Lagged => tracing::info!("many joined and left at once"),
    }
}

fn tell(what: &str, entry: &Entry) {
    tracing::info!(
        name = %entry.name,
        reach = ?entry.reach,
        mts = %entry.mts.name,
        "{what}"
    );
}
