//! `fipa doctor`: checks this machine.

use clap::Args;
use fipa::admin::doctor::{Check, Severity, examine, examine_gateway};
use fipa::{Config, Domain};
use fipa_acl::escape;
use serde_json::json;

use crate::membership;
use crate::options::Global;
use crate::output;
use crate::report::Failure;

/// Check this machine for problems
///
/// Checks the requirements of the configured transports: the size of /dev/shm, limits, permissions,
/// files left by dead processes, domains of other users, and the TCP ports of the peers in
/// discovery.static. If discovery.mdns is on, it also tests multicast on each network interface, which
/// takes three seconds. It asks the running gateway for its configuration, compares it with the one that
/// this command reads, shows whether its connections are encrypted, which static peers do not answer,
/// which connections it refused because keys or protocol versions differ, which of its connections peers
/// refused and which gateways have the same name, and tests the TCP ports of the gateways that it knows. It
/// changes nothing; to test the directory of the domain, it writes a file without a name.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa doctor
  fipa doctor --set transport.shm.capacity=1GiB
  fipa doctor --set 'discovery.interfaces=[\"wlan0\"]'
  fipa doctor --json | jq -r '.checks[] | select(.severity != \"fine\") | .advice'

Verdicts:
  fine      no problem
  warning  works, but may fail under load or later
  bad       does not work; the exit code is 1

JSON:
  { \"severity\": the worst severity,
    \"checks\": [ { \"area\", \"check\", \"severity\", \"found\", \"advice\": unless the severity is fine } ] }")]
pub(crate) struct Arguments {
    /// Print JSON
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    let config = global.config()?;
    let mut checks = examine(&config);
    checks.extend(of_gateway(&config));
    let worst = checks.iter().map(|check| check.severity).max();
    let worst = worst.unwrap_or(Severity::Fine);
    if arguments.json {
        output::json(&json!({ "severity": worst, "checks": checks }))?;
    } else {
        output::text(&table(&checks))?;
    }
    if worst < Severity::Bad {
        return Ok(());
    }
    let bad = checks
        .iter()
        .filter(|check| check.severity == Severity::Bad);
    let bad: Vec<String> = bad
        .map(|check| format!("{}: {}", check.area, check.check))
        .collect();
    Err(Failure::failed(
        match bad.len() {
            1 => "1 check failed".to_owned(),
            several => format!("{several} checks failed"),
        },
        bad.join(", "),
        "follow the advice (->) beside each of them",
    ))
}

/// Asks the gateway of this host, if one is running. Without one, no domain is joined.
fn of_gateway(config: &Config) -> Vec<Check> {
    // An error has a check of its own.
    if !matches!(Domain::gateway_name(config), Ok(Some(_))) {
        return Vec::new();
    }
    let report = membership::run(async {
        let domain = membership::join(config).await?;
        let report = membership::gateway_report(&domain, None).await;
        domain.close().await;
        report
    });
    match report {
        Ok(Some(report)) => examine_gateway(config, Ok(&report)),
        // It has ended meanwhile.
        Ok(None) => Vec::new(),
        Err(failure) => examine_gateway(config, Err(&failure.problem())),
    }
}

fn table(checks: &[Check]) -> String {
    let mut table = output::table(["VERDICT", "AREA", "CHECK", "FOUND"]);
    for check in checks {
        let mut found = escape(&check.found).into_owned();
        if let Some(advice) = &check.advice {
            found = format!("{found}\n-> {}", escape(advice));
        }
        table.add_row([word(check.severity), check.area, check.check, &found]);
    }
    format!("{}\n", table.trim_fmt())
}

fn word(severity: Severity) -> &'static str {
    match severity {
        Severity::Fine => "fine",
        Severity::Warning => "warning",
        _ => "bad",
    }
}
