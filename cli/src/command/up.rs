//! `fipa up`: the gateway of a domain.

use clap::Args;
use fipa::admin::keys::{Certificate, Keys};
use fipa::admin::routes::HttpListener;
use fipa::config::{ConfigError, Reloaded};
use fipa::{Config, Gateway, log_limit};
use fipa_acl::{escape, escape_name};
use serde_json::{Value, json};

use crate::command::dashboard::Dashboard;
use crate::command::record::fleet::service::RecorderService;
use crate::membership::{self, SignalRequest, Stop};
use crate::options::{self, Global};
use crate::output;
use crate::report::{self, Failure};
use crate::service_manager;

/// Run the gateway, which connects the agents of this host with agents on other hosts
///
/// The gateway listens on the network (transport.tcp.listen), announces the agents of this host by
/// mDNS and discovers the agents of other hosts, until Ctrl-C. Agents of one host reach each other
/// without it. A domain has at most one gateway on a host.
///
/// On `fipa reload` and SIGHUP (`kill -HUP`) the gateway reads its configuration again and loses no letter. It applies
/// the order of mts.transports, mts.deadline, [routes], [access] and discovery.static, and warns about changes
/// that take effect only after a restart.
///
/// With record.directory, an agent records the letters of this host for the agents in access.recorders
/// (`fipa record fleet`).
///
/// Under systemd, the gateway reports when it is ready, reloads and stops (Type=notify). With WatchdogSec= it also
/// reports that it works, each time after it has passed a letter to itself.
///
/// The command prints the gateway's name and addresses on standard output. With -v it logs on
/// standard error when agents join and leave.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa up
  fipa up -v                                        logs agents that join and leave
  fipa up --set security.keys=$HOME/.config/fipa/keys --set 'transport.tcp.listen=*:7788'
                                                    open to trusted hosts (see fipa keys)
  fipa up --set discovery.mdns=false                not discoverable; peers need a static address
  fipa up --json | head -n 1                        prints one line when the gateway is ready

JSON, one line when the gateway is ready:
  { \"name\": text, \"incarnation\": text, \"domain\": text, \"locations\": [ text ],
    \"http\": { \"address\": text, \"url\": text, \"token_file\": text,
      \"fingerprint\": text or null without encryption } or null without http.listen,
    \"recorder\": name of the agent that records, or null without record.directory,
    \"discovery\": { \"mdns\": true or false, \"problem\": text, if there is one },
    \"security\": { \"encrypted\": true or false, \"insecure\": security.insecure,
                  \"trusted\": [ { \"mts\": text, \"fingerprint\": text } ] } }")]
pub(crate) struct Arguments {
    /// Print one line of JSON when the gateway is ready
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    let config = global.config()?;
    options::block_on(serve(&config, arguments.json, global))?
}

async fn serve(config: &Config, json: bool, global: &Global) -> Result<(), Failure> {
    let mut stop = Stop::listen()?;
    let (dashboard, pages) = Dashboard::start(config);
    let opened = tokio::select! {
        opened = Gateway::open_with_pages(config, pages) => opened,
        // A signal is the normal end, also while the gateway waits for another process.
        () = stop.requested() => {
            Stop::ending();
            return Ok(());
        }
    };
    let mut gateway = opened.map_err(|error| membership::not_joined(error, config))?;
    let mut problems = gateway.discovery_problem();
    let mut problem = problems.borrow_and_update().clone();
    let mut reloads = gateway.reload_requests();
    // Letters do not depend on the recorder.
    let recorder = tokio::select! {
        recorder = RecorderService::start(config, gateway.name()) => recorder,
        () = stop.requested() => {
            Stop::ending();
            dashboard.close().await;
            gateway.close().await;
            return Ok(());
        }
    };
    let recorder = recorder.unwrap_or_else(|failure| {
        report::warn(&format!("no recorder runs: {}", failure.problem()));
        None
    });
    let name_of_recorder = recorder.as_ref().map(RecorderService::name);
    if json {
        output::json_line(&ready_json(
            config,
            &gateway,
            problem.as_deref(),
            name_of_recorder,
        ))?;
    } else {
        output::text(&ready(
            config,
            &gateway,
            problem.as_deref(),
            name_of_recorder,
        ))?;
    }
    let name = escape_name(gateway.name());
    service_manager::ready(&format!("gateway {name} of domain {}", config.domain));
    let watchdog = service_manager::start_watchdog(gateway.self_check());
    loop {
        tokio::select! {
            request = stop.next_request() => match request {
                SignalRequest::End => break,
                SignalRequest::Reload => {
                    membership::report_reload(&reload(&mut gateway, global));
                }
            },
            Some(request) = reloads.next() => {
                let reloaded = reload(&mut gateway, global);
                membership::report_reload(&reloaded);
                request.answer(&reloaded);
            }
            Ok(()) = problems.changed() => {
                let now = problems.borrow_and_update().clone();
                if now != problem {
                    match &now {
                        Some(text) => log_limit::warn!("discovery of other hosts may fail: {text}"),
                        None => log_limit::info!("discovery of other hosts works again"),
                    }
                    problem = now;
                }
            }
        }
    }
    log_limit::info!("stopping the gateway");
    service_manager::stopping();
    if let Some(watchdog) = watchdog {
        watchdog.abort();
    }
    Stop::ending();
    if let Some(recorder) = recorder {
        recorder.close().await;
    }
    dashboard.close().await;
    gateway.close().await;
    Ok(())
}

/// Reads the configuration again, and applies it. An invalid configuration changes nothing.
fn reload(gateway: &mut Gateway, global: &Global) -> Result<Reloaded, ConfigError> {
    service_manager::reloading();
    let reloaded = global
        .effective()
        .and_then(|effective| gateway.reload(&effective.into_config()));
    let status = match reloaded {
        Ok(_) => "configuration reloaded",
        Err(_) => "continuing with the previous configuration, because the new one has errors",
    };
    service_manager::ready(status);
    reloaded
}

fn ready(
    config: &Config,
    gateway: &Gateway,
    problem: Option<&str>,
    recorder: Option<&str>,
) -> String {
    let mut text = format!(
        "gateway {} of domain {} is ready\n",
        escape_name(gateway.name()),
        config.domain
    );
    for location in gateway.locations() {
        text.push_str(&format!("  listening on {location}\n"));
    }
    if let Some(HttpListener {
        url, token_file, ..
    }) = gateway.http()
    {
        let token = escape(&token_file);
        text.push_str(&format!(
            "  metrics at {url}/metrics, with the token in {token}\n  \
               dashboard: run `fipa dashboard` for its link\n"
        ));
    }
    if let Some(recorder) = recorder {
        text.push_str(&format!(
            "  recordings in {}, by {}\n",
            escape(&config.record.directory),
            escape_name(recorder)
        ));
    }
    text.push_str(&format!("  other hosts: {}\n", trusted_hosts(config)));
    let discovery = match (config.discovery.mdns, problem) {
        (false, _) => "off (discovery.mdns = false)".to_owned(),
        (true, None) => "mDNS".to_owned(),
        (true, Some(problem)) => format!("mDNS, which may fail: {}", escape(problem)),
    };
    text.push_str(&format!(
        "  discovery of other hosts: {discovery}\n  press Ctrl-C to stop\n"
    ));
    text
}

/// The hosts with which the gateway exchanges letters, and whether the letters are encrypted.
fn trusted_hosts(config: &Config) -> String {
    if config.security.keys.is_empty() {
        return match config.security.insecure {
            true => "any that can connect, not encrypted (security.insecure = true)".to_owned(),
            false => {
                "none without keys (security.keys is not set), except over loopback".to_owned()
            }
        };
    }
    let trusted = trusted(config);
    let name = |it: &Certificate| {
        let fingerprint = it.fingerprint().to_string();
        let digits = fingerprint.get(..16).unwrap_or(&fingerprint);
        format!("{} ({digits}…)", escape(it.certified().mts()))
    };
    let names: Vec<_> = trusted.iter().map(name).collect();
    match names.as_slice() {
        [] => "none: no certificate is trusted yet (`fipa keys pair`)".to_owned(),
        names => format!("encrypted, with the certificates of {}", names.join(", ")),
    }
}

/// The certificates of other hosts that the gateway trusts.
fn trusted(config: &Config) -> Vec<Certificate> {
    if config.security.keys.is_empty() {
        return Vec::new();
    }
    let trusted = Keys::at(&config.security.keys).trusted();
    trusted.unwrap_or_default()
}

fn ready_json(
    config: &Config,
    gateway: &Gateway,
    problem: Option<&str>,
    recorder: Option<&str>,
) -> Value {
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
        "http": gateway.http(),
        "recorder": recorder,
        "discovery": discovery,
        "security": {
            "encrypted": !config.security.keys.is_empty(),
            "insecure": config.security.insecure,
            "trusted": trusted(config).iter().map(|it| json!({
                "mts": it.certified().mts(),
                "fingerprint": it.fingerprint().to_string(),
            })).collect::<Vec<_>>(),
        },
    })
}
