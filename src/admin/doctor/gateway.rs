//! Checks the running gateway of this host by its report.

use std::collections::{BTreeMap, BTreeSet};

use fipa_acl::escape;
use fipa_transport::Signature;

use super::peers;
use super::{Area, Check, Severity};
use crate::admin::routes::{
    Connected, ContestedName, Namesakes, RefusedConnection, RefusedDial, RouteReport, StaticPeer,
};
use crate::{Config, Kind};

const AREA: Area = Area("gateway");
const CONFIGURATION: &str = "configuration of the running gateway";
const CONNECTIONS: &str = "connections with other gateways";
const PEERS: &str = "static peers";
const REFUSED: &str = "refused connections";
const REFUSED_DIALS: &str = "connections that peers refused";
const NAMESAKES: &str = "names of gateways";
const NAMES: &str = "names of agents";
const PORTS: &str = "ports of known gateways";

/// Maximum number of values that are shown.
const MAX_SHOWN: usize = 8;

/// Age in seconds of the latest refusal of a peer that may still try to connect: a gateway asks its
/// static peers more often.
const RECENT: u64 = 60;

/// The advice if a connection is refused.
const REFUSED_ADVICE: &str =
    "do what the reason says; the gateways connect by themselves after the change";
/// Age in seconds of the latest refusal of a connection of this gateway. Without letters, it does not try again.
const RECENT_DIAL: u64 = 3_600;

pub(super) fn examine(
    config: &Config,
    report: Result<&RouteReport, &str>,
    checks: &mut Vec<Check>,
) {
    let report = match report {
        Ok(report) => report,
        Err(why) => {
            let advice = "see the log of the gateway; if it hangs, restart it (`fipa up`)";
            checks.push(AREA.problem(CONFIGURATION, Severity::Warning, why, advice));
            return;
        }
    };
    checks.push(configuration(config, report));
    checks.extend(report.neighbors.iter().map(connection));
    checks.extend(report.peers.iter().filter_map(static_peer));
    checks.extend(report.contested.iter().map(contested));
    let recent = report.refused.iter().filter(|it| it.seconds <= RECENT);
    checks.extend(recent.map(refused));
    let recent = report.refused_dials.iter();
    let recent = recent.filter(|it| it.seconds <= RECENT_DIAL);
    checks.extend(recent.map(refused_dial));
    checks.extend(report.namesakes.iter().map(|it| namesakes(report, it)));
    peers::connect_all(PORTS, unconnected(config, report).into_iter(), checks);
}

/// Compares the configuration of the gateway with this one.
fn configuration(config: &Config, report: &RouteReport) -> Check {
    let own_values = config.values();
    let keys: BTreeSet<&String> = own_values
        .keys()
        .chain(report.configuration.keys())
        .collect();
    let differing = keys.into_iter().filter_map(|key| {
        let (own, its) = (own_values.get(key), report.configuration.get(key));
        let shown = |value: Option<&String>| value.map_or("not set", String::as_str).to_owned();
        (own != its).then(|| format!("{key} = {} (here: {})", shown(its), shown(own)))
    });
    let differing: Vec<String> = differing.collect();
    let name = &report.mts;
    if differing.is_empty() {
        return AREA.fine(
            CONFIGURATION,
            format!("{name} runs with the configuration that this command has read"),
        );
    }
    let more = match differing.len().saturating_sub(MAX_SHOWN) {
        0 => String::new(),
        more => format!("; and {more} more"),
    };
    let shown = differing.iter().take(MAX_SHOWN).cloned();
    let shown: Vec<String> = shown.collect();
    AREA.problem(
        CONFIGURATION,
        Severity::Warning,
        format!("{name} runs with other values: {}{more}", shown.join("; ")),
        "write the values into ~/.config/fipa/fipa.toml, which all commands and programs read, instead of \
         --set; then restart the gateway",
    )
}

/// Describes the security of a connection. Connections without encryption are the subject of the check of
/// the keys.
fn connection(connected: &Connected) -> Check {
    let name = &connected.name;
    let security = match &connected.security.certificate {
        Some(certificate) => format!("encrypted, certificate {certificate}"),
        None => "not encrypted".to_owned(),
    };
    AREA.fine(CONNECTIONS, format!("{name}: {security}"))
}

/// Reports a static peer that does not answer, with the reasons. A connected one is among the connections.
fn static_peer(peer: &StaticPeer) -> Option<Check> {
    if peer.answers.is_some() || peer.failures.is_empty() {
        return None;
    }
    let failures = peer.failures.iter();
    let failures = failures.map(|(location, why)| format!("{location}: {why}"));
    let failures: Vec<String> = failures.collect();
    let found = format!("{} does not answer: {}", peer.name, failures.join("; "));
    Some(AREA.problem(
        PEERS,
        Severity::Warning,
        found,
        "do what the reason says; the gateway asks its static peers again every few seconds",
    ))
}

/// Reports an agent of this host whose name an agent of another host also has.
fn contested(contested: &ContestedName) -> Check {
    let ContestedName { name, gateway } = contested;
    AREA.problem(
        NAMES,
        Severity::Warning,
        format!(
            "the agent {name} is also registered at the gateway {gateway}: each other host reaches the one \
             that was announced to it first"
        ),
        "deregister one of the two agents, or give it another name; if it is an agent of the gateway \
         (ams@, df@), set mts.name on one of the hosts",
    )
}

/// Reports a connection that the gateway has refused because of keys or versions.
fn refused(refused: &RefusedConnection) -> Check {
    let RefusedConnection { from, why, seconds } = refused;
    let found = format!("from {from}, {seconds} s ago: {why}");
    AREA.problem(REFUSED, Severity::Warning, found, REFUSED_ADVICE)
}

/// Reports a connection of the gateway that a peer has refused.
fn refused_dial(refused: &RefusedDial) -> Check {
    let RefusedDial { to, why, seconds } = refused;
    AREA.problem(
        REFUSED_DIALS,
        Severity::Warning,
        format!("{to}, {seconds} s ago: {}", escape(why)),
        "do what the reason says, mostly on the host of that peer: `fipa doctor` and the log of its gateway show \
         the refusal; with keys, both hosts trust each other's certificate (`fipa keys list`), and both run the \
         same version",
    )
}

/// Reports gateways with the same name.
fn namesakes(report: &RouteReport, found: &Namesakes) -> Check {
    let name = escape(&found.name);
    let at: Vec<String> = found.at.iter().map(ToString::to_string).collect();
    let at = at.join(", ");
    let own: Vec<String> = report.locations.iter().map(ToString::to_string).collect();
    let text = match found.is_own {
        true => format!(
            "another gateway has the name of this one, {name}: it is at {at}; this one is at {}",
            own.join(", ")
        ),
        false => format!("several gateways have the name {name}: {at}"),
    };
    // Without keys, any host can claim a name.
    let severity = match found.is_proved {
        true => Severity::Bad,
        false => Severity::Warning,
    };
    AREA.problem(
        NAMESAKES,
        severity,
        text,
        "set mts.name on all but one of the hosts to names of their own, and restart their gateways; a host with \
         keys then needs new ones (`fipa keys init` in an empty directory). Until then, lists and logs do not tell \
         the hosts apart, and ams@NAME and df@NAME reach one of them only",
    )
}

/// The TCP addresses of gateways that are known but not connected, without those of the configuration,
/// which have a check of their own. Each has the name of an agent there.
fn unconnected(config: &Config, report: &RouteReport) -> Vec<(String, String)> {
    let listed = config.discovery.peers.iter();
    let listed: BTreeSet<&str> = listed
        .flat_map(|peer| &peer.locations)
        .map(|location| location.address())
        .collect();
    let connected = report.neighbors.iter().map(|it| it.incarnation);
    let connected: BTreeSet<_> = connected.collect();
    let mut addresses = BTreeMap::new();
    for route in &report.routes {
        let Some(gateway) = route.gateway.filter(|it| !connected.contains(it)) else {
            continue;
        };
        for way in &route.ways {
            let location = &way.location;
            if location.kind() == Kind::Tcp
                && location.signature() == Signature::Frames
                && location.incarnation() == gateway
                && !listed.contains(location.address())
            {
                let name = format!("the gateway of {}", route.receiver);
                addresses.insert(location.address().to_owned(), name);
            }
        }
    }
    addresses
        .into_iter()
        .map(|(address, name)| (name, address))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The report of a gateway with this configuration, and without peers.
    fn report(config: &Config) -> RouteReport {
        let empty = serde_json::json!({
            "mts": "sherpa", "incarnation": "0000000000000001", "locations": [], "routes": [],
            "ways": [], "peers": [], "neighbors": [],
        });
        let mut report: RouteReport = serde_json::from_value(empty).unwrap();
        report.configuration = config.values();
        report
    }

    #[test]
    fn values_that_differ_from_those_of_the_gateway_are_listed() {
        let config = Config::for_host("sherpa");
        let same = configuration(&config, &report(&config));
        assert_eq!(same.severity, Severity::Fine, "{}", same.found);
        let mut other = Config::for_host("sherpa");
        other.security.loopback = true;
        other.mts.queue = 7;
        let differs = configuration(&config, &report(&other));
        assert_eq!(differs.severity, Severity::Warning);
        let expected = "sherpa runs with other values: mts.queue = 7 (here: 256); security.loopback = true \
                        (here: false)";
        assert_eq!(differs.found, expected);
    }

    #[test]
    fn names_that_agents_of_two_hosts_have_are_listed() {
        let config = Config::for_host("sherpa");
        let mut report = report(&config);
        report.contested.push(ContestedName {
            name: "arm".to_owned(),
            gateway: "crex".to_owned(),
        });
        let mut checks = Vec::new();
        examine(&config, Ok(&report), &mut checks);
        let listed = checks.iter().find(|check| check.severity != Severity::Fine);
        let found = &listed.unwrap().found;
        assert!(
            found.starts_with("the agent arm is also registered at the gateway crex:"),
            "{found}"
        );
    }

    #[test]
    fn refusals_of_peers_and_gateways_of_one_name_are_listed() {
        let config = Config::for_host("sherpa");
        let mut report = report(&config);
        let at = |text: &str| text.parse::<fipa_transport::Location>().unwrap();
        for seconds in [7, RECENT_DIAL + 1] {
            report.refused_dials.push(RefusedDial {
                to: at("tcp://10.0.0.2:7788"),
                why: "not\u{1b}[2J trusted".to_owned(),
                seconds,
            });
        }
        for (is_own, is_proved) in [(true, true), (false, false)] {
            report.namesakes.push(Namesakes {
                name: "crex".to_owned(),
                is_own,
                at: vec![at("tcp://10.0.0.2:7788"), at("tcp://10.0.0.3:7788")],
                is_proved,
            });
        }
        let mut checks = Vec::new();
        examine(&config, Ok(&report), &mut checks);
        let of = |name| {
            let checks = checks.iter().filter(move |check| check.check == name);
            let checks = checks.map(|check| (check.severity, check.found.as_str()));
            checks.collect::<Vec<_>>()
        };
        let [(Severity::Warning, refused)] = of(REFUSED_DIALS)[..] else {
            panic!("{checks:?}");
        };
        assert!(
            refused.starts_with("tcp://10.0.0.2:7788, 7 s ago: not"),
            "{refused}"
        );
        assert!(!refused.contains('\u{1b}'), "{refused}");
        let [(Severity::Bad, own), (Severity::Warning, others)] = of(NAMESAKES)[..] else {
            panic!("{checks:?}");
        };
        assert!(
            own.contains("the name of this one, crex: it is at tcp://"),
            "{own}"
        );
        let expected =
            "several gateways have the name crex: tcp://10.0.0.2:7788, tcp://10.0.0.3:7788";
        assert_eq!(others, expected);
    }

    #[test]
    fn a_gateway_that_does_not_answer_is_a_warning() {
        let mut checks = Vec::new();
        examine(&Config::for_host("sherpa"), Err("no answer"), &mut checks);
        assert_eq!(checks.len(), 1);
        assert_eq!(checks[0].severity, Severity::Warning);
    }
}
