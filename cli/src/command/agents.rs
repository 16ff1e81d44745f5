//! `fipa agents`: who is there, and where.

mod watch;

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use clap::Args;
use comfy_table::{Table, presets};
use fipa::{Directory, Entry, Kind, Location, Matcher, Query, Reach, Role, Source, Time};
use fipa_acl::escape;
use serde_json::{Value, json};

use crate::membership;
use crate::options::Global;
use crate::output;
use crate::report::Failure;

/// Show who is there, and where
///
/// Lists the agents and coalitions of the domain on this host and, when a gateway is running (`fipa up`), those
/// that it knows on other hosts; the gateway itself too. Needs no gateway.
///
/// A pattern is a regular expression for the whole text, such as `arm_.*`. What has none of
/// `* + ? [ ( { | ^ $ \` is compared as it is. Of several filters all have to match.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa agents
  fipa agents 'arm_.*'
  fipa agents --type camera --json | jq -r '.agents[].name'
  fipa agents --location 'tcp://10\\.0\\.0\\.2:.*' --remote
  fipa agents --watch

Columns:
  REACH      this host, or the gateway that letters go through
  LOCATIONS  where it takes letters, in order of preference; of a coalition, its members
  MTS        the message transport service that delivers to it
  LEARNT     how: host (a process of this host), mdns (announced on the network), exchange (told by
             its gateway), static (the configuration), contact (it has written)
  AGE        since it was registered

JSON:
  { \"domain\": text, \"gateway\": the name of this host's gateway, or null,
    \"agents\": [ { \"name\", \"type\", \"description\", \"role\": \"agent\", \"gateway\" or \"coalition\",
                  \"members\": [ name ] and \"leader\": name or null, of a coalition,
                  \"reach\": \"local\" or \"remote\", \"gateway\": name, when it is remote,
                  \"locations\": [ text ], \"unsupported_transports\": [ transport ], when it has
                  no location of another transport, \"mts\": { \"name\", \"incarnation\" },
                  \"incarnation\", \"registered\": time, \"source\": how it was learnt } ] }

With --watch, one object on each line, the first for those who are there already:
  { \"time\", \"change\": \"present\", \"joined\", \"changed\" or \"left\", \"agent\": as above }")]
pub(crate) struct Arguments {
    /// Only those with this name, or whose name matches this pattern
    #[arg(value_parser = Matcher::parse)]
    pattern: Option<Matcher>,

    /// Only those of this type, or whose type matches this pattern
    #[arg(long = "type", value_name = "TYPE", value_parser = Matcher::parse)]
    agent_type: Option<Matcher>,

    /// Only those with such a location, written kind://address
    #[arg(long, value_name = "LOCATION", value_parser = Matcher::parse)]
    location: Option<Matcher>,

    /// Only those with this description
    #[arg(long, value_name = "TEXT", value_parser = Matcher::parse)]
    description: Option<Matcher>,

    /// Only those that this message transport service delivers to
    #[arg(long, value_name = "NAME", value_parser = Matcher::parse)]
    mts: Option<Matcher>,

    /// Only those registered at this time, in UTC, such as '2026-03-01T09:.*'
    #[arg(long, value_name = "TIME", value_parser = Matcher::parse)]
    registered: Option<Matcher>,

    /// Only coalitions with this member
    #[arg(long, value_name = "NAME", value_parser = Matcher::parse)]
    member: Option<Matcher>,

    /// Only those on this host
    #[arg(long)]
    local: bool,

    /// Only those on other hosts
    #[arg(long, conflicts_with = "local")]
    remote: bool,

    /// Go on, and tell who joins, changes and leaves until Ctrl-C
    #[arg(long, short)]
    watch: bool,

    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Whom to show.
struct Filter {
    query: Query,
    local: bool,
    remote: bool,
}

impl Filter {
    fn matches(&self, entry: &Entry) -> bool {
        let reach = match entry.reach {
            Reach::Local => !self.remote,
            Reach::Remote { .. } => !self.local,
        };
        reach && self.query.matches(entry)
    }
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    let config = global.config()?;
    let filter = Filter {
        query: Query {
            name: arguments.pattern,
            agent_type: arguments.agent_type,
            location: arguments.location,
            description: arguments.description,
            mts: arguments.mts,
            registered: arguments.registered,
            member: arguments.member,
        },
        local: arguments.local,
        remote: arguments.remote,
    };
    if arguments.watch {
        return watch::run(&filter, &config, arguments.json);
    }
    let listed = membership::run(async {
        let domain = membership::join(&config).await?;
        let directory = domain.directory();
        directory.refresh();
        let entries = directory.entries();
        let listed = Listed {
            nobody: entries.is_empty(),
            gateway: gateway(directory).map(|entry| entry.name.to_string()),
            entries: entries
                .iter()
                .filter(|entry| filter.matches(entry))
                .map(|entry| Row::of(entry, directory))
                .collect(),
        };
        domain.close().await;
        Ok(listed)
    })?;
    if arguments.json {
        let agents: Vec<&Value> = listed.entries.iter().map(|row| &row.json).collect();
        return output::json(
            &json!({ "domain": config.domain, "gateway": listed.gateway, "agents": agents }),
        );
    }
    if listed.entries.is_empty() {
        let description = match listed.nobody {
            true => "",
            false => " by that description",
        };
        return output::text(&format!(
            "nobody in the domain {} is known here{description}\n",
            config.domain
        ));
    }
    let mut table = Table::new();
    table.load_style(presets::NOTHING).set_header(COLUMNS);
    for column in table.column_iter_mut() {
        column.set_padding((0, 2));
    }
    table.add_rows(listed.entries.into_iter().map(|row| row.cells));
    output::text(&format!("{}\n", table.trim_fmt()))
}

struct Listed {
    /// Whether there is nobody at all, whatever is looked for.
    nobody: bool,
    gateway: Option<String>,
    entries: Vec<Row>,
}

const COLUMNS: [&str; 7] = ["NAME", "TYPE", "REACH", "LOCATIONS", "MTS", "LEARNT", "AGE"];

/// One agent, for people and for programs.
struct Row {
    cells: [String; 7],
    json: Value,
}

impl Row {
    fn of(entry: &Entry, directory: &dyn Directory) -> Self {
        let through = match entry.reach {
            Reach::Local => None,
            Reach::Remote { gateway } => Some(match directory.known_incarnation(gateway) {
                Some(gateway) => gateway.name.to_string(),
                None => "a gateway".to_owned(),
            }),
        };
        let locations = entry.locations.iter().map(ToString::to_string);
        let locations: Vec<String> = locations.collect();
        let registered = Time::from_system_time(entry.registered);
        let mut json = json!({
            "name": entry.name,
            "type": entry.agent_type,
            "description": entry.description,
            "role": role(&entry.role),
            "reach": if through.is_none() { "local" } else { "remote" },
            "locations": locations,
            "mts": entry.mts,
            "incarnation": entry.incarnation,
            "registered": registered.ok().and_then(Time::to_rfc3339),
            "source": entry.source,
        });
        if let Some(gateway) = &through {
            json["gateway"] = gateway.as_str().into();
        }
        if entry.is_unsupported() {
            let kinds = entry.locations.iter().map(|location| location.kind());
            let kinds: BTreeSet<Kind> = kinds.collect();
            json["unsupported_transports"] = json!(kinds);
        }
        let places: Vec<String> = match &entry.role {
            Role::Coalition(members) => {
                json["members"] = json!(members.names());
                json["leader"] = json!(members.leader());
                let leads = |name: &Arc<str>| members.leader().is_some_and(|leader| leader == name);
                let names = members.names().iter();
                let line = |name: &Arc<str>| match leads(name) {
                    true => format!("{} (leads)", escape(name)),
                    false => escape(name).into_owned(),
                };
                names.map(line).collect()
            }
            _ => entry.locations.iter().map(place).collect(),
        };
        let reach = match through {
            None => "this host".to_owned(),
            Some(gateway) => format!("via {}", escape(&gateway)),
        };
        let cells = [
            escape(&entry.name).into_owned(),
            escape(&entry.agent_type).into_owned(),
            reach,
            places.join("\n"),
            escape(&entry.mts.name).into_owned(),
            learnt(entry.source).to_owned(),
            age(entry),
        ];
        Self { cells, json }
    }
}

/// A location, for people.
fn place(location: &Location) -> String {
    let kind = location.kind();
    match kind.is_supported() {
        true => location.to_string(),
        false => format!("{location} (unsupported transport {kind})"),
    }
}

fn gateway(directory: &dyn Directory) -> Option<Arc<Entry>> {
    let entries = directory.entries();
    let mut gateways = entries
        .iter()
        .filter(|entry| entry.role == Role::Gateway && entry.reach == Reach::Local);
    gateways.next().cloned()
}

fn role(role: &Role) -> &'static str {
    match role {
        Role::Agent => "agent",
        Role::Gateway => "gateway",
        Role::Coalition(_) => "coalition",
        _ => "?",
    }
}

fn learnt(source: Source) -> &'static str {
    match source {
        Source::Memory | Source::Host => "host",
        Source::Static => "static",
        Source::Mdns => "mdns",
        Source::Exchange => "exchange",
        Source::Contact => "contact",
        _ => "?",
    }
}

/// In whole seconds, by the clocks of two hosts; nothing when they disagree.
fn age(entry: &Entry) -> String {
    let age = entry.registered.elapsed().unwrap_or_default();
    humantime::format_duration(Duration::from_secs(age.as_secs())).to_string()
}
