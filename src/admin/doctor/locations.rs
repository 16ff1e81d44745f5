//! Checks the locations at which other hosts reach the gateway.

use fipa_acl::ErrorChain;

use super::{Area, Check, Severity};
use crate::{Config, Kind};

const AREA: Area = Area("network");
const LOCATIONS: &str = "locations";

pub(super) fn examine(config: &Config, checks: &mut Vec<Check>) {
    let transport = &config.transport;
    let listens: [(Kind, &[String]); 6] = [
        (Kind::Tcp, &transport.tcp.listen),
        (Kind::Udp, &transport.udp.listen),
        (Kind::Quic, &transport.quic.listen),
        (Kind::Http, &transport.http.listen),
        (Kind::Https, &transport.https.listen),
        (Kind::Udt, &transport.udt.listen),
    ];
    let used = |kind: Kind| config.mts.transports.contains(&kind);
    let built = |kind: Kind| {
        let lacks_quic = kind == Kind::Quic && !cfg!(feature = "quic");
        let lacks_http = kind.is_http() && !cfg!(feature = "http");
        let lacks_tls = kind == Kind::Https && !cfg!(feature = "secure");
        let lacks_udt = kind == Kind::Udt && !cfg!(feature = "udt");
        !lacks_quic && !lacks_http && !lacks_tls && !lacks_udt
    };
    let mut found = Vec::new();
    for (kind, listen) in listens {
        if !used(kind) || !built(kind) {
            continue;
        }
        match fipa_transport_net::reachable_at(listen) {
            Ok(addresses) => found.extend(addresses.into_iter().map(|it| (kind, it))),
            Err(error) => {
                checks.push(AREA.problem(
                    LOCATIONS,
                    Severity::Bad,
                    format!(
                        "transport.{kind}.listen cannot be used: {}",
                        ErrorChain(&error)
                    ),
                    "use an address of this host; `ip address` lists them",
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
    let has_address = found
        .iter()
        .any(|(_, address)| !address.ip().to_canonical().is_loopback());
    let texts: Vec<String> = found
        .iter()
        .map(|(kind, address)| match kind {
            Kind::Http | Kind::Https => format!("{kind}://{address}/acc"),
            _ => format!("{kind}://{address}"),
        })
        .collect();
    let texts = texts.join(", ");
    // Other addresses than those that the configuration lists.
    let others = fipa_transport_net::reachable_at(&["*:0".to_owned()]).unwrap_or_default();
    let other = others.iter().find(|it| !it.ip().is_loopback());
    checks.push(match (open, has_address) {
        (false, _) => AREA.fine(LOCATIONS, format!("{texts}: reachable from this host only")),
        (true, true) => AREA.fine(LOCATIONS, texts),
        (true, false) if other.is_some() => AREA.problem(
            LOCATIONS,
            Severity::Bad,
            format!(
                "{texts}: the network interfaces have no address of the family that `listen` lists{}, so the \
                 gateway announces no location",
                other.map(|it| format!(", but {}", it.ip())).unwrap_or_default()
            ),
            "list \"*:PORT\" in transport.tcp.listen and restart the gateway: it means all addresses of this \
             host, IPv4 and IPv6",
        ),
        (true, false) => AREA.problem(
            LOCATIONS,
            Severity::Warning,
            format!(
                "{texts}: no network interface has an address, so the gateway announces no location"
            ),
            "connect this host to the network (`ip address` lists the interfaces); a running gateway \
             then announces its new addresses without a restart",
        ),
    });
}
