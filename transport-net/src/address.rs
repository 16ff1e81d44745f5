//! Addresses as text: parsing with scopes, and which of this machine's addresses others can use.

use std::io;
use std::net::{IpAddr, Ipv6Addr, SocketAddr, SocketAddrV6};

use fipa_transport::ListenError;
use if_addrs::{IfOperStatus, Interface};

/// Why a text is not an address.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub(crate) enum AddressError {
    #[error(
        "not an address with a port (expected for example 127.0.0.1:7788 or [fe80::1%eth0]:7788): {0:?}"
    )]
    Syntax(String),
    #[error("no interface is called {0:?} (`ip link` lists them)")]
    NoSuchInterface(String),
    #[error("the interfaces of this machine cannot be listed: {0}")]
    Interfaces(String),
}

/// Where to connect to: an address, or a host name still to be looked up.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Target {
    Numeric(SocketAddr),
    Named(String, u16),
}

/// Parses `address:port`, where the address may be a host name.
pub(crate) fn target(text: &str) -> Result<Target, AddressError> {
    let numeric = match numeric(text) {
        Err(AddressError::Syntax(syntax)) => syntax,
        Ok(address) => return Ok(Target::Numeric(address)),
        Err(other) => return Err(other),
    };
    let named = text.rsplit_once(':').and_then(|(host, port)| {
        let plausible = !host.is_empty()
            && host.len() <= 253
            && host.chars().any(|c| c.is_ascii_alphabetic())
            && host
                .chars()
                .all(|c| c.is_ascii_alphanumeric() || matches!(c, '.' | '-' | '_'));
        let port = port.parse().ok().filter(|port| *port != 0)?;
        plausible.then(|| Target::Named(host.to_owned(), port))
    });
    named.ok_or(AddressError::Syntax(numeric))
}

/// Parses a numeric `address:port`, with an IPv6 scope by number or by interface name
/// (RFC 4007 section 11.2).
pub(crate) fn numeric(text: &str) -> Result<SocketAddr, AddressError> {
    if let Ok(address) = text.parse() {
        return Ok(address);
    }
    let syntax = || AddressError::Syntax(text.chars().take(80).collect());
    let (inner, port) = text
        .strip_prefix('[')
        .and_then(|rest| rest.split_once("]:"))
        .ok_or_else(syntax)?;
    let (ip, zone) = inner.split_once('%').ok_or_else(syntax)?;
    let ip: Ipv6Addr = ip.parse().map_err(|_| syntax())?;
    let port = port.parse().map_err(|_| syntax())?;
    let scope = match zone.parse() {
        Ok(number) => number,
        Err(_) => interface_index(zone)?,
    };
    Ok(SocketAddrV6::new(ip, port, 0, scope).into())
}

/// Why an address cannot be listened on, with what to do.
pub(crate) fn cannot_bind(text: &str, error: &io::Error) -> ListenError {
    let advice = match error.kind() {
        io::ErrorKind::AddrInUse => {
            "; another process listens there: stop it, or choose another port \
             (port 0 lets the system choose)"
        }
        io::ErrorKind::AddrNotAvailable => {
            "; this machine has no such address (`ip address` lists those it has)"
        }
        io::ErrorKind::PermissionDenied => "; choose a port above 1023",
        _ => "",
    };
    ListenError::Bind {
        address: text.to_owned(),
        source: io::Error::new(error.kind(), format!("{error}{advice}")),
    }
}

fn interfaces() -> Result<Vec<Interface>, AddressError> {
    if_addrs::get_if_addrs().map_err(|error| AddressError::Interfaces(error.to_string()))
}

fn interface_index(name: &str) -> Result<u32, AddressError> {
    interfaces()?
        .into_iter()
        .find(|interface| interface.name == name)
        .and_then(|interface| interface.index)
        .ok_or_else(|| AddressError::NoSuchInterface(name.chars().take(40).collect()))
}

/// The addresses under which others reach a socket bound to `bound`, best first: `bound` itself,
/// or for an unspecified address those of the interfaces that are up.
///
/// Loopback and link-local addresses (whose scope means nothing on another host) are named only
/// when there are no others.
pub(crate) fn reachable(bound: SocketAddr) -> Result<Vec<SocketAddr>, AddressError> {
    if !bound.ip().is_unspecified() {
        return Ok(vec![bound]);
    }
    Ok(usable(bound, &interfaces()?))
}

fn usable(bound: SocketAddr, interfaces: &[Interface]) -> Vec<SocketAddr> {
    let of_family = interfaces
        .iter()
        .filter(|interface| interface.oper_status != IfOperStatus::Down)
        .filter(|interface| interface.ip().is_ipv4() == bound.is_ipv4());
    let (mut local, mut global) = (Vec::new(), Vec::new());
    for interface in of_family {
        let ip = interface.ip();
        let scope = match ip {
            IpAddr::V6(v6) if v6.is_unicast_link_local() => interface.index.unwrap_or(0),
            _ => 0,
        };
        let address = match ip {
            IpAddr::V4(_) => SocketAddr::new(ip, bound.port()),
            IpAddr::V6(v6) => SocketAddrV6::new(v6, bound.port(), 0, scope).into(),
        };
        if interface.is_loopback() || interface.is_link_local() {
            local.push(address);
        } else {
            global.push(address);
        }
    }
    if global.is_empty() {
        // Loopback before link-local: it needs no scope.
        local.sort_by_key(|address| !address.ip().is_loopback());
        return local;
    }
    global
}

/// The address at which a connected peer can be reached again, from the addresses it says it
/// listens on and the one its connection comes from.
///
/// The same machine may be known under addresses that lead to it from elsewhere only, so the one
/// the connection was made with goes first, then one that is no loopback address when the peer is
/// not on loopback either. A link-local address is taken with the scope as this host sees it.
pub(crate) fn way_back(listening: &[String], from: SocketAddr) -> SocketAddr {
    let parsed: Vec<SocketAddr> = listening
        .iter()
        .filter_map(|text| numeric_ignoring_scope(text))
        .filter(|address| address.port() != 0 && !address.ip().is_unspecified())
        .collect();
    let with_port = |port| {
        let mut address = from;
        address.set_port(port);
        address
    };
    if let Some(same) = parsed.iter().find(|address| address.ip() == from.ip()) {
        return with_port(same.port());
    }
    parsed
        .into_iter()
        .filter(|address| !is_link_local(address.ip()))
        .find(|address| from.ip().is_loopback() || !address.ip().is_loopback())
        .unwrap_or(from)
}

/// The scope names an interface of another host: it must not be looked up here.
fn numeric_ignoring_scope(text: &str) -> Option<SocketAddr> {
    match text.split_once('%') {
        None => text.parse().ok(),
        Some((ip, rest)) => {
            let (_, port) = rest.split_once(']')?;
            format!("{ip}]{port}").parse().ok()
        }
    }
}

fn is_link_local(ip: IpAddr) -> bool {
    match ip {
        IpAddr::V4(v4) => v4.is_link_local(),
        IpAddr::V6(v6) => v6.is_unicast_link_local(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scope(text: &str) -> Result<u32, AddressError> {
        match numeric(text)? {
            SocketAddr::V6(v6) => Ok(v6.scope_id()),
            SocketAddr::V4(_) => panic!("{text} is IPv6"),
        }
    }

    #[test]
    fn scopes_are_numbers_or_interface_names() {
        assert_eq!(scope("[fe80::1%7]:7788"), Ok(7));
        let interface = interfaces().unwrap().into_iter().next().unwrap();
        let text = format!("[fe80::1%{}]:7788", interface.name);
        assert_eq!(scope(&text), Ok(interface.index.unwrap()));
        assert_eq!(
            scope("[fe80::1%no-such-if]:1"),
            Err(AddressError::NoSuchInterface("no-such-if".into()))
        );
        assert_eq!(scope("[::1]:1"), Ok(0));
    }

    #[test]
    fn targets_are_numbers_or_plausible_names() {
        assert_eq!(
            target("127.0.0.1:7788"),
            Ok(Target::Numeric("127.0.0.1:7788".parse().unwrap()))
        );
        assert_eq!(
            target("crex.local:7788"),
            Ok(Target::Named("crex.local".into(), 7788))
        );
        for wrong in [
            "",
            ":1",
            "crex",
            "crex:",
            "crex:0",
            "crex:65536",
            "10.0.0.2",
            "10.0.0.256:1",
            "[::1]",
            "[::1%]:",
            "fe80::1:1",
            "a/b:1",
        ] {
            assert!(target(wrong).is_err(), "{wrong:?}");
        }
    }

    #[test]
    fn an_unspecified_address_becomes_those_of_the_interfaces() {
        for bound in ["0.0.0.0:7788", "[::]:7788"] {
            let bound: SocketAddr = bound.parse().unwrap();
            for address in reachable(bound).unwrap() {
                assert!(!address.ip().is_unspecified());
                assert_eq!(address.port(), 7788);
                assert_eq!(address.is_ipv4(), bound.is_ipv4());
            }
        }
        let fixed = "127.0.0.1:7788".parse().unwrap();
        assert_eq!(reachable(fixed), Ok(vec![fixed]));
    }

    #[test]
    fn the_way_back_leads_to_where_the_peer_listens() {
        let back = |listening: &[&str], from: &str| {
            let listening: Vec<String> = listening.iter().map(|text| (*text).into()).collect();
            way_back(&listening, from.parse().unwrap()).to_string()
        };
        let from = "10.0.0.2:40000";
        assert_eq!(back(&["192.168.0.2:7", "10.0.0.2:8"], from), "10.0.0.2:8");
        assert_eq!(
            back(&["127.0.0.1:7", "192.168.0.2:7"], from),
            "192.168.0.2:7"
        );
        assert_eq!(back(&["127.0.0.1:7"], "127.0.0.1:40000"), "127.0.0.1:7");
        assert_eq!(back(&["127.0.0.1:7"], from), from);
        assert_eq!(back(&[], from), from);
        assert_eq!(back(&["nonsense", "0.0.0.0:7", "10.0.0.2:0"], from), from);
        assert_eq!(
            back(&["[fe80::2%wlan0]:7"], "[fe80::2%3]:40000"),
            "[fe80::2%3]:7"
        );
    }
}
