//! Where other hosts reach the gateway at present.

use super::{Area, Check, Verdict};
use crate::{Config, Kind};

const AREA: Area = Area("network");
const LOCATIONS: &str = "locations";

pub(super) fn examine(config: &Config, checks: &mut Vec<Check>) {
    let transport = &config.transport;
    let listens: [(Kind, &[String]); 3] = [
        (Kind::Tcp, &transport.tcp.listen),
        (Kind::Udp, &transport.udp.listen),
        (Kind::Quic, &transport.quic.listen),
    ];
    let used = |kind| config.mts.transports.contains(&kind);
    let built = |kind| kind != Kind::Quic || cfg!(feature = "quic");
    let mut found = Vec::new();
    for (kind, listen) in listens {
        if !used(kind) || !built(kind) {
            continue;
        }
        match fipa_transport_net::reachable_at(listen) {
            Ok(addresses) => found.extend(addresses.into_iter().map(|it| (kind, it))),
            Err(error) => {
                checks.push(AREA.wrong(
                    LOCATIONS,
                    Verdict::Bad,
                    format!("transport.{kind}.listen cannot be used: {error}"),
                    "see `ip address` for the addresses of this host",
                ));
                return;
            }
        }
    }
    if found.is_empty() {
        return;
    }
    let open = listens
        .iter()
        .filter(|(kind, _)| used(*kind))
        .flat_map(|(_, listen)| *listen)
        .any(|text| !crate::config::is_on_loopback(text));
    let leads_here = found
        .iter()
        .any(|(_, address)| !address.ip().to_canonical().is_loopback());
    let texts: Vec<String> = found
        .iter()
        .map(|(kind, address)| format!("{kind}://{address}"))
        .collect();
    let texts = texts.join(", ");
    checks.push(match (open, leads_here) {
        (false, _) => AREA.fine(LOCATIONS, format!("{texts}: this host only")),
        (true, true) => AREA.fine(LOCATIONS, texts),
        (true, false) => AREA.wrong(
            LOCATIONS,
            Verdict::Doubtful,
            format!("{texts}: no interface has an address, so other hosts are told of nothing"),
            "connect this host, or see `ip address`; a running gateway follows by itself",
        ),
    });
}
