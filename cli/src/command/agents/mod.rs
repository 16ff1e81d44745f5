//! `fipa agents`: lists the agents of a domain.

mod platform;
mod watch;

use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;
use std::time::Duration;

use clap::Args;
use fipa::admin::keys::Keys;
use fipa::admin::routes::{ASKER_TYPE, Connected, LostHost};
use fipa::admin::stopped::StoppedAgent;
use fipa::{
    Config, DirectoryView, Domain, Entry, Incarnation, Kind, Location, Matcher, Query, Reach, Role,
    Signature, Source,
};
use fipa_acl::{Pattern, escape, escape_name};
use serde_json::{Value, json};

use super::routes::security;
use crate::complete;
use crate::membership;
use crate::options::{self, Global};
use crate::output;
use crate::report::Failure;

/// List the agents of the domain
///
/// Lists the agents, coalitions and the gateway of the domain on this host. If a gateway is running
/// (`fipa up`), it also lists the agents on other hosts that the gateway knows, and the hosts that were
/// connected within the last hour and are gone. The command itself needs no gateway.
///
/// A pattern is a regular expression for the whole text, such as `arm_.*`. A text without any of
/// `* + ? [ ( { | ^ $ \` is compared literally. If several filters are given, all must match.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa agents
  fipa agents 'arm_.*' --long
  fipa agents --type camera --json | jq -r '.agents[].name'
  fipa agents --location 'tcp://10\\.0\\.0\\.2:.*' --remote
  fipa agents --watch
  fipa agents --platform http://10.0.0.7:7778/acc    of a JADE platform, as its AMS lists them

Columns:
  HOST       this host, or the gateway of the agent's host; of an agent of a
             legacy peer its address
  AGE        time since its registration
  STATE      ready         on this host
             stopped (pid N)
                           on this host, and its process N is stopped, for example
                           by Ctrl-Z; `kill -CONT N` continues it
             encrypted, not encrypted
                           the connection with its host; `fipa routes` has its
                           certificate
             no connection known, for example by mDNS
             unsupported   all its locations have unsupported transports
             N members     of a coalition
             lost          the host was connected within the last hour
             not trusted   lost, and its certificate is no longer trusted
With --long:
  LOCATIONS  addresses for letters, in order of preference, of an agent on
             another host those that the gateway uses; for a coalition, its
             members
  MTS        message transport service that delivers to the agent
  SOURCE     origin of the entry: host (a process of this host), mdns
             (announced on the network), exchange (from its gateway), static
             (the configuration), contact (a letter from it)

JSON:
  { \"domain\": text, \"gateway\": name of this host's gateway, or null,
    \"agents\": [ { \"name\", \"type\", \"description\", \"role\": \"agent\", \"gateway\" or \"coalition\",
                  \"members\": [ name ] and \"leader\": name or null, for a coalition,
                  \"vacant\": true if it is led and has no leader at present,
                  \"reach\": \"local\" or \"remote\", \"gateway\": name and \"link\":
                  { \"encrypted\": true or false, \"certificate\": fingerprint or null } or null
                  without a connection, if remote,
                  \"locations\": [ text ], \"unsupported_transports\": [ transport ], if no
                  location has a supported one, \"mts\": { \"name\", \"incarnation\" },
                  \"incarnation\", \"registered\": time, \"source\": as above,
                  \"stopped\": the identifier of its process, if it is stopped,
                  \"addresses\": [ text ], those of the gateway of this host for platforms } ],
    \"lost\": [ { \"name\", \"seconds\" since it was last seen,
                \"certificate\": fingerprint or null } ] }

With --platform, as `fipa ams --json`.
With --watch, one object on each line; the first lines are the agents present at the start:
  { \"time\", \"change\": \"present\", \"joined\", \"changed\" or \"left\",
    \"agent\": as above, without a \"link\" }")]
pub(crate) struct Arguments {
    /// Show only agents with this name or with a name that matches this pattern
    #[arg(value_parser = Matcher::parse, add = complete::agents())]
    pattern: Option<Matcher>,

    /// Show only agents of this type or with a type that matches this pattern
    #[arg(long = "type", value_name = "TYPE", value_parser = Matcher::parse)]
    agent_type: Option<Matcher>,

    /// Show only agents with a matching location, written kind://address
    #[arg(long, value_name = "LOCATION", value_parser = Matcher::parse)]
    location: Option<Matcher>,

    /// Show only agents with a matching description
    #[arg(long, value_name = "TEXT", value_parser = Matcher::parse)]
    description: Option<Matcher>,

    /// Show only agents of this message transport service
    #[arg(long, value_name = "NAME", value_parser = Matcher::parse)]
    mts: Option<Matcher>,

    /// Show only agents registered at a matching time, in UTC, such as '2026-03-01T09:.*'
    #[arg(long, value_name = "TIME", value_parser = Matcher::parse)]
    registered: Option<Matcher>,

    /// Show only coalitions with this member
    #[arg(long, value_name = "NAME", value_parser = Matcher::parse)]
    member: Option<Matcher>,

    /// Show only agents on this host
    #[arg(long)]
    local: bool,

    /// Show only agents on other hosts
    #[arg(long, conflicts_with = "local")]
    remote: bool,

    /// List the agents of the platform at this address instead, as its agent management system reports
    /// them; needs a gateway (`fipa up`) with the transport of the address
    #[arg(
        long,
        value_name = "ADDRESS",
        value_parser = membership::address,
        conflicts_with_all = ["agent_type", "location", "description", "mts", "registered", "member",
                              "local", "remote", "watch"]
    )]
    platform: Option<String>,

    /// Continue and print each agent that joins, changes or leaves, until Ctrl-C
    #[arg(long, short)]
    watch: bool,

    /// With --watch: end after this number of lines
    #[arg(long, short, value_name = "N", requires = "watch")]
    count: Option<u64>,

    /// With --watch: end after this time, for example 10s
    #[arg(long = "for", value_name = "TIME", requires = "watch", value_parser = options::duration)]
    time: Option<Duration>,

    /// Also show the locations, the service and the origin of each agent
    #[arg(long, short, conflicts_with_all = ["json", "watch", "platform"])]
    long: bool,

    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Selects the agents to show.
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
        // A command that asks the gateway.
        let is_asker = *entry.agent_type == *ASKER_TYPE;
        let is_probed = is_legacy(entry) && entry.name.starts_with(platform::PROBED);
        reach && !is_asker && !is_probed && self.query.matches(entry)
    }

    /// Whether the lost host is shown: only its name is known.
    fn matches_lost(&self, host: &LostHost) -> bool {
        let Query {
            name,
            agent_type,
            location,
            description,
            mts,
            registered,
            member,
        } = &self.query;
        let others = [agent_type, location, description, mts, registered, member];
        let is_named = |name: &Matcher| name.matches(&host.name);
        !self.local
            && others.iter().all(|filter| filter.is_none())
            && name.as_ref().is_none_or(is_named)
    }
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    let config = global.config()?;
    if let Some(address) = &arguments.platform {
        return platform::run(address, arguments.pattern.as_ref(), &config, arguments.json);
    }
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
        let limits = (arguments.count, arguments.time);
        return watch::run(&filter, limits, &config, arguments.json);
    }
    let listed = membership::run(async {
        let domain = membership::join_briefly(&config).await?;
        let directory = domain.directory();
        directory.refresh();
        let entries = directory.entries();
        let shown = entries.iter().filter(|entry| filter.matches(entry));
        let shown: Vec<&Arc<Entry>> = shown.collect();
        // Without its report the agents are listed as well.
        let is_gateway_shown = shown.iter().any(|entry| entry.role == Role::Gateway);
        let reported = match gateway(directory) {
            Some(_) if is_gateway_shown || !filter.local => Reported::asked(&domain, &shown).await,
            _ => Reported::default(),
        };
        let lost = reported.lost.iter();
        let listed = Listed {
            domain_is_empty: entries.is_empty(),
            gateway: gateway(directory).map(|entry| entry.name.to_string()),
            entries: shown
                .iter()
                .map(|entry| Row::of(entry, directory, &reported))
                .collect(),
            lost: lost
                .filter(|host| filter.matches_lost(host))
                .cloned()
                .collect(),
        };
        domain.close().await;
        Ok(listed)
    })?;
    if arguments.json {
        let agents: Vec<&Value> = listed.entries.iter().map(|row| &row.json).collect();
        return output::json(&json!({
            "domain": config.domain, "gateway": listed.gateway, "agents": agents,
            "lost": listed.lost,
        }));
    }
    if listed.entries.is_empty() && listed.lost.is_empty() {
        let matching = match listed.domain_is_empty {
            true => "",
            false => " that matches the filters",
        };
        return output::text(&format!(
            "no agent{matching} is known in domain {}\n",
            config.domain
        ));
    }
    let trusted = trusted(&config);
    let lost = listed.lost.iter();
    let lost = lost.map(|host| lost_cells(host, trusted.as_deref()));
    let table = match arguments.long {
        false => {
            let mut table = output::table(COLUMNS);
            table.add_rows(listed.entries.into_iter().map(|row| row.cells));
            table.add_rows(lost);
            output::cut_to_lines(&mut table);
            table
        }
        true => {
            let mut table = output::table(COLUMNS.into_iter().chain(LONG_COLUMNS));
            let rows = listed.entries.into_iter();
            table.add_rows(rows.map(|row| row.cells.into_iter().chain(row.long_cells)));
            table.add_rows(lost);
            table
        }
    };
    output::text(&format!("{}\n", table.trim_fmt()))
}

/// Maximum number of questions about the locations of agents of legacy peers.
const MAX_QUESTIONS: usize = 16;

/// The parts of the report of this host's gateway that the list shows.
#[derive(Default)]
struct Reported {
    gateway: Incarnation,
    /// The addresses at which platforms such as JADE write to the gateway.
    addresses: Vec<Location>,
    /// Its connections, by the service at the other end.
    links: HashMap<Incarnation, Connected>,
    /// The locations of agents of legacy peers, by name: the directory of the host has only the locations of
    /// the gateway, through which letters to them go.
    legacy: HashMap<String, Vec<Location>>,
    /// The hosts that are gone.
    lost: Vec<LostHost>,
}

impl Reported {
    /// Asks the gateway of this host. Empty if it does not answer.
    async fn asked(domain: &Domain, shown: &[&Arc<Entry>]) -> Self {
        let legacy = shown
            .iter()
            .filter(|entry| is_legacy(entry) && !entry.is_unsupported());
        // No agent has this name, so the report has no routes.
        let mut questions = vec!["fipa-no-agent".to_owned()];
        for name in legacy.map(|entry| literal(&entry.name)) {
            let count = questions.len();
            match questions.last_mut() {
                Some(last) if last.len() + name.len() < Pattern::MAX_LEN => {
                    last.push('|');
                    last.push_str(&name);
                }
                _ if count < MAX_QUESTIONS => questions.push(name),
                _ => break,
            }
        }
        let mut reported = Self::default();
        for receivers in questions {
            let report = membership::gateway_report(domain, Some(&receivers)).await;
            let Some(report) = report.ok().flatten() else {
                break;
            };
            let neighbors = report.neighbors.into_iter();
            reported.gateway = report.incarnation;
            reported.lost = report.lost;
            reported.addresses = report.locations;
            let is_foreign = |at: &Location| at.signature() != Signature::Frames;
            reported.addresses.retain(is_foreign);
            reported.links = neighbors
                .map(|neighbor| (neighbor.incarnation, neighbor))
                .collect();
            reported
                .legacy
                .extend(report.routes.into_iter().map(|route| {
                    let ways = route.ways.into_iter().map(|way| way.location);
                    (route.receiver, ways.collect())
                }));
        }
        reported
    }
}

/// Whether the agent is one of a legacy peer, which has no incarnation.
fn is_legacy(entry: &Entry) -> bool {
    matches!(entry.reach, Reach::Remote { .. }) && !entry.incarnation.is_known()
}

/// Returns the pattern that matches this name alone.
fn literal(name: &str) -> String {
    let mut pattern = String::new();
    for character in name.chars() {
        if r"\.+*?()|[]{}^$#&-~".contains(character) {
            pattern.push('\\');
        }
        pattern.push(character);
    }
    pattern
}

struct Listed {
    /// Whether the directory has no entry at all, before filtering.
    domain_is_empty: bool,
    gateway: Option<String>,
    entries: Vec<Row>,
    lost: Vec<LostHost>,
}

/// Type of gateways in the directory.
const GATEWAY_TYPE: &str = "fipa-mts";

const COLUMNS: [&str; 5] = ["NAME", "HOST", "TYPE", "AGE", "STATE"];
const LONG_COLUMNS: [&str; 3] = ["LOCATIONS", "MTS", "SOURCE"];

/// An agent as table cells and as JSON.
struct Row {
    cells: [String; 5],
    long_cells: [String; 3],
    json: Value,
}

impl Row {
    fn of(entry: &Entry, directory: DirectoryView<'_>, reported: &Reported) -> Self {
        let has_report = reported.gateway.is_known();
        let own = reported
            .legacy
            .get(&*entry.name)
            .filter(|_| is_legacy(entry));
        let at = own.unwrap_or(&entry.locations);
        let through = match entry.reach {
            Reach::Local => None,
            Reach::Remote { gateway } => Some(match directory.known_incarnation(gateway) {
                Some(gateway) => gateway.name.to_string(),
                None => "an unknown gateway".to_owned(),
            }),
        };
        let mut json = json!(entry);
        if own.is_some() {
            let locations: Vec<String> = at.iter().map(ToString::to_string).collect();
            json["locations"] = json!(locations);
        }
        let stopped = StoppedAgent::of(entry).map(|it| it.process);
        if let Some(process) = stopped {
            json["stopped"] = process.into();
        }
        let link = reported.links.get(&entry.mts.incarnation);
        if let Some(gateway) = &through {
            json["gateway"] = gateway.as_str().into();
            if has_report {
                json["link"] = json!(link.map(|link| &link.security));
            }
        }
        if entry.is_unsupported() {
            let kinds = entry.locations.iter().map(|location| location.kind());
            let kinds: BTreeSet<Kind> = kinds.collect();
            json["unsupported_transports"] = json!(kinds);
        }
        let locations: Vec<String> = match &entry.role {
            Role::Coalition(members) => {
                let is_leader =
                    |name: &Arc<str>| members.leader().is_some_and(|leader| leader == name);
                let names = members.names().iter();
                let line = |name: &Arc<str>| match is_leader(name) {
                    true => format!("{} (leader)", escape_name(name)),
                    false => escape_name(name).into_owned(),
                };
                names.map(line).collect()
            }
            Role::Gateway if entry.incarnation == reported.gateway => {
                let addresses: Vec<String> =
                    reported.addresses.iter().map(ToString::to_string).collect();
                json["addresses"] = json!(addresses);
                let own = entry.locations.iter().map(location_text);
                own.chain(addresses).collect()
            }
            _ => match link {
                // The directory of the host has the locations of its gateway for it.
                Some(link) => link.locations.iter().map(location_text).collect(),
                None => at.iter().map(location_text).collect(),
            },
        };
        let cells = [
            escape_name(&entry.name).into_owned(),
            host(entry, at),
            escape(&entry.agent_type).into_owned(),
            output::time_span(entry.registered.elapsed().unwrap_or_default()),
            match &entry.role {
                Role::Coalition(members) => match members.names().len() {
                    1 => "1 member".to_owned(),
                    _ if members.is_vacant() => "vacant".to_owned(),
                    count => format!("{count} members"),
                },
                _ => state(entry, stopped, link, has_report),
            },
        ];
        let long_cells = [
            locations.join("\n"),
            escape_name(entry.mts.shown()).into_owned(),
            source(entry.source).to_owned(),
        ];
        Self {
            cells,
            long_cells,
            json,
        }
    }
}

/// The host of an agent as table text.
fn host(entry: &Entry, at: &[Location]) -> String {
    match (entry.reach, &entry.mts.name, at.first()) {
        (Reach::Local, _, _) => "this host".to_owned(),
        (Reach::Remote { .. }, Some(gateway), _) => escape_name(gateway).into_owned(),
        (Reach::Remote { .. }, None, Some(location)) => location.host().to_owned(),
        (Reach::Remote { .. }, None, None) => "(unknown)".to_owned(),
    }
}

/// The state of an agent as table text.
fn state(
    entry: &Entry,
    stopped: Option<u32>,
    link: Option<&Connected>,
    has_report: bool,
) -> String {
    let state = match entry.reach {
        _ if entry.is_unsupported() => "unsupported",
        Reach::Local => match stopped {
            Some(process) => return format!("stopped (pid {process})"),
            None => "ready",
        },
        Reach::Remote { .. } => match link {
            Some(link) => security(link.security.encrypted),
            // A legacy peer keeps no connection.
            None if is_legacy(entry) || !has_report => "",
            None => "no connection",
        },
    };
    state.to_owned()
}

/// The fingerprints of the trusted certificates; `None` without keys.
fn trusted(config: &Config) -> Option<Vec<String>> {
    let keys = Some(&config.security.keys).filter(|keys| !keys.is_empty())?;
    let trusted = Keys::at(keys).trusted().ok()?.into_iter();
    Some(trusted.map(|it| it.fingerprint().to_string()).collect())
}

/// The table cells of a lost host.
fn lost_cells(host: &LostHost, trusted: Option<&[String]>) -> [String; 5] {
    let name = escape_name(&host.name);
    let since = output::time_span(Duration::from_secs(host.seconds));
    let state = match (&host.certificate, trusted) {
        (Some(certificate), Some(trusted)) if !trusted.contains(certificate) => {
            "not trusted".to_owned()
        }
        _ => format!("lost {since} ago"),
    };
    let cells = [&*name, &*name, GATEWAY_TYPE, "-", &state];
    cells.map(str::to_owned)
}

/// A location as table text.
fn location_text(location: &Location) -> String {
    let kind = location.kind();
    match kind.is_supported() {
        true => location.to_string(),
        false => format!("{location} (unsupported transport {kind})"),
    }
}

fn gateway(directory: DirectoryView<'_>) -> Option<Arc<Entry>> {
    let entries = directory.entries();
    entries.iter().find(|entry| entry.is_own_gateway()).cloned()
}

fn source(source: Source) -> &'static str {
    match source {
        Source::Memory | Source::Host => "host",
        Source::Static => "static",
        Source::Mdns => "mdns",
        Source::Exchange => "exchange",
        Source::Contact => "contact",
        _ => "?",
    }
}
