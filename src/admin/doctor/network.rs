//! Checks multicast in both directions, which the discovery of other hosts needs.

use std::net::IpAddr;

use fipa_sds::{MdnsConfig, MtsId, Multicast, probe};
use fipa_transport::Incarnation;

use super::{Area, Check, Severity};
use crate::Config;

const AREA: Area = Area("network");
const MULTICAST: &str = "multicast";

/// The remedy that works without multicast.
const USE_STATIC: &str = "list one gateway of each other host in discovery.static; the gateways then \
                          exchange their directories directly";

pub(super) fn examine(config: &Config, checks: &mut Vec<Check>) {
    let interfaces = config.discovery.interfaces.iter().map(ToString::to_string);
    let probed = probe(&MdnsConfig {
        interfaces: interfaces.collect(),
        ..MdnsConfig::new(MtsId::new("doctor", Incarnation::random()))
    });
    match probed {
        Ok(found) if found.is_empty() => checks.push(AREA.problem(
            MULTICAST,
            Severity::Warning,
            "no interface is up among those that discovery.interfaces allows",
            "connect this host to the network, or change discovery.interfaces (`ip address` lists the \
             interfaces)",
        )),
        Ok(found) => checks.extend(found.iter().map(multicast)),
        Err(error) => checks.push(AREA.problem(
            MULTICAST,
            Severity::Bad,
            format!("cannot list the network interfaces of this machine: {error}"),
            USE_STATIC,
        )),
    }
}

fn multicast(found: &Multicast) -> Check {
    let Multicast {
        interface, address, ..
    } = found;
    let at = format!("{interface} ({address})");
    let problem = |severity, found: &str, advice: &str| {
        AREA.problem(MULTICAST, severity, format!("{at}: {found}"), advice)
    };
    if let Some(error) = &found.error {
        let found = format!("multicast cannot be used: {error}");
        return problem(
            Severity::Bad,
            &found,
            "allow UDP port 5353 in the firewall and check the route of the multicast groups (`ip \
             route`), or list other interfaces in discovery.interfaces",
        );
    }
    if address.is_loopback() {
        return if found.heard_itself {
            AREA.fine(MULTICAST, format!("{at}: multicast is sent and received"))
        } else {
            problem(Severity::Bad, NOT_EVEN_OWN, FIREWALL)
        };
    }
    match (found.multicasting.len(), found.answered.len()) {
        (0, 0) if !found.heard_itself => problem(Severity::Bad, NOT_EVEN_OWN, FIREWALL),
        (0, 0) => problem(
            Severity::Warning,
            "multicast leaves this host, but no other host answered: none is running, or the network \
             filters multicast, as many Wi-Fi networks do",
            &format!(
                "start `fipa up` on another host and repeat this check; if no host answers then, \
                 {USE_STATIC}"
            ),
        ),
        (0, _) => problem(
            Severity::Warning,
            &format!(
                "outgoing multicast works, incoming does not: {} answered by unicast, and no multicast \
                 packet of another host arrived",
                hosts(found.answered.iter())
            ),
            &format!(
                "allow incoming UDP port 5353 in the firewall of this host, and turn off multicast \
                 filtering (IGMP snooping without a querier, client isolation) in the network; or \
                 {USE_STATIC}"
            ),
        ),
        (_, 0) => problem(
            Severity::Warning,
            &format!(
                "incoming multicast works, outgoing may not: packets of {} arrived, but no host \
                 answered (a host without agents has nothing to answer)",
                hosts(found.multicasting.iter())
            ),
            &format!(
                "allow outgoing UDP port 5353, and unicast answers to it, in the firewall of this \
                 host; or {USE_STATIC}"
            ),
        ),
        (_, _) => AREA.fine(
            MULTICAST,
            format!(
                "{at}: multicast works in both directions, with {}",
                hosts(found.multicasting.iter().chain(&found.answered))
            ),
        ),
    }
}

const NOT_EVEN_OWN: &str = "this host does not receive its own multicast packets";

const FIREWALL: &str = "allow UDP port 5353 to 224.0.0.251 and ff02::fb in both directions in the \
                        firewall of this host (`nft list ruleset` shows its rules)";

/// Lists the first three addresses and the number of the others.
fn hosts<'a>(all: impl Iterator<Item = &'a IpAddr>) -> String {
    let mut all: Vec<&IpAddr> = all.collect();
    all.sort_unstable();
    all.dedup();
    let first: Vec<String> = all.iter().take(3).map(ToString::to_string).collect();
    let more = match all.len().saturating_sub(first.len()) {
        0 => String::new(),
        more => format!(" and {more} more"),
    };
    format!("{}{more}", first.join(", "))
}
