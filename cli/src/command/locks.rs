//! `fipa locks`: lists resources with their owners, holders and waiting agents.

use std::time::Duration;

use clap::Args;
use fipa::error::ErrorChain;
use fipa::locks::ResourceStatus;
use fipa::{Agent, Config, Incarnation, RegisterOptions};
use fipa_acl::{escape, escape_name};
use serde_json::{Value, json};

use crate::membership::{self, Stop};
use crate::options::{self, Global};
use crate::output;
use crate::report::Failure;

/// Interval of the questions with --watch.
const INTERVAL: Duration = Duration::from_secs(1);

/// List the resources of the domain with their holders
///
/// Asks the owners of all resources in the directory. A resource whose owner does not answer has no
/// details.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa locks
  fipa locks --long
  fipa locks --json | jq -r '.locks[] | select(.holder) | .resource'
  fipa locks --watch

Columns:
  OWNER    agent that grants the resource, and another one that also claims it
  HOLDER   agent that holds it; - if it is free, ? if the owner does not answer
  LEASE    remaining time of the grant, unless the holder extends it
  WAITING  the next agent, and the number of others; with --long their names
  FENCE    with --long: fence of the grant

JSON:
  { \"domain\": text, \"locks\": [ { \"resource\", \"owner\": name,
    \"answered\": whether the owner answered, \"holder\": name or null, \"fence\": text or null, \"lease_ms\": number or null,
    \"waiters\": [ name ] at most 16, \"waiting\": number,
    \"contested_by\": name or null } ] }

With --watch, the list is printed again when a grant, an owner or a waiting
agent changes; with --json, each list is on a line of its own.")]
pub(crate) struct Arguments {
    /// Continue, and print the list again after each change, until Ctrl-C
    #[arg(long, short)]
    watch: bool,

    /// With --watch: end after this number of lists
    #[arg(long, short, value_name = "N", requires = "watch")]
    count: Option<u64>,

    /// With --watch: end after this time, for example 10s
    #[arg(long = "for", value_name = "TIME", requires = "watch", value_parser = options::duration)]
    time: Option<Duration>,

    /// Maximum wait for the answers of the owners
    #[arg(long, value_name = "TIME", default_value = "2s", value_parser = options::duration)]
    timeout: Duration,

    /// Also show the fences, and all agents that wait
    #[arg(long, short, conflicts_with = "json")]
    long: bool,

    /// Print JSON
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    let config = global.config()?;
    let listing = async {
        let domain = membership::join(&config).await?;
        let name = format!("fipa-locks-{}", Incarnation::random());
        let options = RegisterOptions {
            agent_type: "fipa-locks".to_owned(),
            ..RegisterOptions::default()
        };
        let agent = membership::register(&domain, &name, options, &config).await?;
        let listed = list(&agent, &arguments, &config).await;
        drop(agent);
        domain.close().await;
        listed
    };
    if !arguments.watch {
        return membership::run(listing);
    }
    // A signal is the normal end. Dropping the future leaves the domain in order.
    options::block_on(async {
        let mut stop = Stop::listen()?;
        tokio::select! {
            listed = listing => listed,
            () = stop.requested() => Ok(()),
            () = options::after(arguments.time) => Ok(()),
        }
    })?
}

async fn list(agent: &Agent, arguments: &Arguments, config: &Config) -> Result<(), Failure> {
    let mut before = None;
    let mut printed = 0;
    loop {
        let locks = agent.query_locks(arguments.timeout).await;
        let locks = locks.map_err(|error| {
            Failure::failed(
                ErrorChain(&error).to_string(),
                format!("domain {:?}", config.domain),
                "run the command again",
            )
        })?;
        let shown: Vec<_> = locks.iter().map(lasting).collect();
        if before.as_ref() != Some(&shown) {
            print(&locks, arguments, config)?;
            before = Some(shown);
            printed += 1;
        }
        let is_last = arguments.count.is_some_and(|count| printed >= count);
        if !arguments.watch || is_last {
            return Ok(());
        }
        tokio::time::sleep(INTERVAL).await;
    }
}

/// Returns a state without the remaining lease, whose change is not printed.
fn lasting(status: &ResourceStatus) -> ResourceStatus {
    let mut lasting = status.clone();
    lasting.expires = None;
    lasting
}

fn print(locks: &[ResourceStatus], arguments: &Arguments, config: &Config) -> Result<(), Failure> {
    if arguments.json {
        let locks: Vec<Value> = locks.iter().map(in_json).collect();
        let document = json!({ "domain": config.domain, "locks": locks });
        return match arguments.watch {
            true => output::json_line(&document),
            false => output::json(&document),
        };
    }
    if locks.is_empty() {
        return output::text(&format!(
            "no resource is owned in domain {}\n",
            config.domain
        ));
    }
    let table = match arguments.long {
        false => {
            let mut table = output::table(COLUMNS);
            table.add_rows(locks.iter().map(|status| cells(status, false)));
            output::cut_to_lines(&mut table);
            table
        }
        true => {
            let mut table = output::table(COLUMNS.into_iter().chain(["FENCE"]));
            table.add_rows(locks.iter().map(|status| {
                let fence = status.fence.as_ref().map(ToString::to_string);
                let fence = name_or(fence.as_deref(), status);
                cells(status, true).into_iter().chain([fence])
            }));
            table
        }
    };
    output::text(&format!("{}\n", table.trim_fmt()))
}

const COLUMNS: [&str; 5] = ["RESOURCE", "OWNER", "HOLDER", "LEASE", "WAITING"];

/// The text of a cell that may be empty.
fn name_or(name: Option<&str>, status: &ResourceStatus) -> String {
    match (name, status.is_reported) {
        (Some(name), _) => escape_name(name).into_owned(),
        (None, true) => "-".to_owned(),
        (None, false) => "?".to_owned(),
    }
}

/// The cells of a resource: on one line, or with all agents that wait.
fn cells(status: &ResourceStatus, with_all: bool) -> [String; 5] {
    let mut owner = name_or(status.owner.as_deref(), status);
    if let Some(rival) = &status.contested_by {
        owner += &format!(", contested by {}", escape_name(rival));
    }
    let lease = status.expires.map(output::time_span);
    let most = if with_all { usize::MAX } else { 1 };
    let named = status.waiters.iter().take(most);
    let mut waiting: Vec<String> = named
        .map(|waiter| escape_name(waiter).into_owned())
        .collect();
    let more = status.waiting.saturating_sub(waiting.len());
    if more > 0 {
        waiting.push(format!("and {more} more"));
    }
    let separator = if with_all { "\n" } else { " " };
    [
        escape(&status.resource).into_owned(),
        owner,
        name_or(status.holder.as_deref(), status),
        name_or(lease.as_deref(), status),
        match waiting.is_empty() {
            true => name_or(None, status),
            false => waiting.join(separator),
        },
    ]
}

/// The object of a resource.
pub(super) fn in_json(status: &ResourceStatus) -> Value {
    json!({
        "resource": status.resource,
        "owner": status.owner,
        "answered": status.is_reported,
        "holder": status.holder,
        "fence": status.fence.as_ref().map(ToString::to_string),
        "lease_ms": status.expires.map(|lease_left| u64::try_from(lease_left.as_millis()).unwrap_or(u64::MAX)),
        "waiters": status.waiters,
        "waiting": status.waiting,
        "contested_by": status.contested_by,
    })
}
