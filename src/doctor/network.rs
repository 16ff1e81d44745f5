//! What finding other hosts needs: multicast, out and in.

use std::net::IpAddr;

use fipa_sds::{MdnsConfig, Mts, Multicast, probe};
use fipa_transport::Incarnation;

use super::{Area, Check, Verdict};
use crate::Config;

const AREA: Area = Area("network");
const MULTICAST: &str = "multicast";

/// The way that needs no multicast.
const NAME_THEM: &str = "name a gateway of each other host in discovery.static; gateways tell \
                         each other the rest";

pub(super) fn examine(config: &Config, checks: &mut Vec<Check>) {
    let interfaces = config.discovery.interfaces.iter().map(ToString::to_string);
    let probed = probe(&MdnsConfig {
        interfaces: interfaces.collect(),
        ..MdnsConfig::new(Mts::new("doctor", Incarnation::random()))
    });
    match probed {
        Ok(found) if found.is_empty() => checks.push(AREA.wrong(
            MULTICAST,
            Verdict::Doubtful,
            "no interface is up that discovery.interfaces allows",
            "connect this host, or see `ip address` and discovery.interfaces",
        )),
        Ok(found) => checks.extend(found.iter().map(multicast)),
        Err(error) => checks.push(AREA.wrong(
            MULTICAST,
            Verdict::Bad,
            format!("the interfaces of this machine cannot be listed: {error}"),
            NAME_THEM,
        )),
    }
}

fn multicast(found: &Multicast) -> Check {
    let Multicast {
        interface, address, ..
    } = found;
    let at = format!("{interface} ({address})");
    let wrong = |verdict, what: &str, advice: &str| {
        AREA.wrong(MULTICAST, verdict, format!("{at}: {what}"), advice)
    };
    if let Some(error) = &found.error {
        let what = format!("cannot be used: {error}");
        return wrong(
            Verdict::Bad,
            &what,
            "let UDP port 5353 through the firewall, and see `ip route` for the multicast groups; \
             or name other interfaces in discovery.interfaces",
        );
    }
    if address.is_loopback() {
        return if found.heard_itself {
            AREA.fine(MULTICAST, format!("{at}: goes out and comes in"))
        } else {
            wrong(Verdict::Bad, "this host does not hear itself", FIREWALL)
        };
    }
    match (found.heard.len(), found.answered.len()) {
        (0, 0) if !found.heard_itself => wrong(
            Verdict::Bad,
            "this host does not even hear itself",
            FIREWALL,
        ),
        (0, 0) => wrong(
            Verdict::Doubtful,
            "goes out of this host, and nobody answered: nobody is there, or the network filters \
             multicast, as much Wi-Fi does",
            &format!("start `fipa up` on another host and look again; if it stays so, {NAME_THEM}"),
        ),
        (0, _) => wrong(
            Verdict::Doubtful,
            &format!(
                "gets out, and does not come in: {} answered directly, and nobody was heard by \
                 multicast",
                hosts(found.answered.iter())
            ),
            &format!(
                "let UDP port 5353 in through the firewall of this host, and turn off multicast \
                 filtering (IGMP snooping without a querier, client isolation) in the network; or \
                 {NAME_THEM}"
            ),
        ),
        (_, 0) => wrong(
            Verdict::Doubtful,
            &format!(
                "comes in, and may not get out: {} was heard, and nobody answered (who has no agents \
                 to announce has nothing to answer)",
                hosts(found.heard.iter())
            ),
            &format!(
                "let UDP port 5353 out through the firewall of this host, and direct answers in; \
                 or {NAME_THEM}"
            ),
        ),
        (_, _) => AREA.fine(
            MULTICAST,
            format!(
                "{at}: goes both ways, with {}",
                hosts(found.heard.iter().chain(&found.answered))
            ),
        ),
    }
}

const FIREWALL: &str = "let UDP port 5353 to 224.0.0.251 and ff02::fb out and in through the \
                        firewall of this host (`nft list ruleset` shows it)";

/// Some of them by address, and how many there are.
fn hosts<'a>(all: impl Iterator<Item = &'a IpAddr>) -> String {
    let mut all: Vec<&IpAddr> = all.collect();
    all.sort_unstable();
    all.dedup();
    let some: Vec<String> = all.iter().take(3).map(ToString::to_string).collect();
    let more = match all.len().saturating_sub(some.len()) {
        0 => String::new(),
        more => format!(" and {more} more"),
    };
    format!("{}{more}", some.join(", "))
}
