//! Addresses as text: parsing with scopes, and the addresses of this host that other hosts can use.

use std::collections::HashSet;
use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, SocketAddrV6, ToSocketAddrs as _};
use std::path::Path;

use fipa_transport::{Incarnation, Kind, ListenError, Location, LocationError, threads};
use if_addrs::{IfOperStatus, Interface};
use rustix::io::Errno;
use tokio::sync::oneshot;

/// The reason for which a text is not an address.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum AddressError {
    /// The text has another form.
    #[error(
        "not an address with a port (expected for example 127.0.0.1:7788 or [fe80::1%eth0]:7788): {0:?}"
    )]
    Syntax(String),
    /// The scope names no interface of this host.
    #[error("no network interface has the name {0:?}; run `ip link` to list them")]
    NoSuchInterface(String),
    /// A link-local IPv6 address has no scope, so it may be on any interface.
    #[error(
        "the address {0} is link-local and needs the interface that leads to it: [{0}%eth0] for eth0"
    )]
    NoScope(Ipv6Addr),
    /// The network interfaces cannot be listed.
    #[error("cannot list the network interfaces of this host: {0}")]
    Interfaces(String),
}

/// The target of a connection: an address, or a host name to be resolved.
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
/// (RFC 4007 section 11.2). A link-local IPv6 address without a scope is an error.
pub(crate) fn numeric(text: &str) -> Result<SocketAddr, AddressError> {
    match scoped(text)? {
        SocketAddr::V6(v6) if v6.scope_id() == 0 && v6.ip().is_unicast_link_local() => {
            Err(AddressError::NoScope(*v6.ip()))
        }
        address => Ok(address),
    }
}

fn scoped(text: &str) -> Result<SocketAddr, AddressError> {
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

/// Returns the addresses of a peer that is given by address or host name, and port. Blocks while the name
/// is looked up.
///
/// # Errors
/// When the text is neither, or the name cannot be resolved.
pub fn resolve(text: &str) -> io::Result<Vec<SocketAddr>> {
    match target(text).map_err(|error| io::Error::new(io::ErrorKind::InvalidInput, error))? {
        Target::Numeric(address) => Ok(vec![address]),
        Target::Named(name, port) => Ok((name.as_str(), port).to_socket_addrs()?.collect()),
    }
}

/// Looks up a host name on a thread of its own.
///
/// # Errors
/// When the name cannot be resolved, or the system refuses another thread.
pub async fn look_up(name: String, port: u16) -> io::Result<Vec<SocketAddr>> {
    let (sender, found) = oneshot::channel();
    threads::spawn(move || {
        let addresses = (name.as_str(), port).to_socket_addrs();
        // The receiver may have been dropped meanwhile.
        let _ = sender.send(addresses.map(Iterator::collect));
    })?;
    found.await.map_err(io::Error::other)?
}

/// Returns the addresses at which other hosts presently reach an endpoint that listens on these
/// addresses, best first. A port 0 stays 0.
///
/// # Errors
/// When a text is not an address, or the interfaces cannot be listed.
pub fn reachable_at(listen: &[String]) -> Result<Vec<SocketAddr>, AddressError> {
    let mut bound = Vec::new();
    for text in listen {
        bound.extend(to_bind(text)?);
    }
    Ok(Listening::new(bound)?.reachable)
}

/// Returns the addresses of the sockets for an entry of `listen`: `*:port` means all addresses of this
/// host, of both families.
fn to_bind(text: &str) -> Result<Vec<SocketAddr>, AddressError> {
    let Some(port) = text.strip_prefix("*:") else {
        return Ok(vec![numeric(text)?]);
    };
    let port: u16 = port
        .parse()
        .map_err(|_| AddressError::Syntax(text.chars().take(80).collect()))?;
    let any = [
        IpAddr::from(Ipv4Addr::UNSPECIFIED),
        Ipv6Addr::UNSPECIFIED.into(),
    ];
    Ok(any.map(|ip| SocketAddr::new(ip, port)).to_vec())
}

/// Opens the sockets for these entries of `listen` with `open`, which also returns the address that a
/// socket is bound to. Of the two families of `*:port`, the host may lack one.
///
/// # Errors
/// When a text is not an address, or a socket cannot be opened.
pub(crate) fn bind_all<S>(
    listen: &[String],
    mut open: impl FnMut(SocketAddr) -> io::Result<(S, SocketAddr)>,
) -> Result<Vec<(S, SocketAddr)>, ListenError> {
    let mut sockets = Vec::new();
    for text in listen {
        let addresses =
            to_bind(text).map_err(|error| ListenError::Unavailable(error.to_string()))?;
        let (before, mut lacking) = (sockets.len(), None);
        for address in &addresses {
            match open(*address) {
                Ok(socket) => sockets.push(socket),
                Err(error) if addresses.len() > 1 && lacks_family(&error) => lacking = Some(error),
                Err(error) => return Err(cannot_bind(text, &error)),
            }
        }
        if let Some(error) = lacking.filter(|_| sockets.len() == before) {
            return Err(cannot_bind(text, &error));
        }
    }
    Ok(sockets)
}

/// Whether the kernel lacks the family of an address, or has switched it off.
fn lacks_family(error: &io::Error) -> bool {
    let unsupported = error.raw_os_error() == Some(Errno::AFNOSUPPORT.raw_os_error());
    unsupported || error.kind() == io::ErrorKind::AddrNotAvailable
}

/// Returns the error of binding to an address, with a remedy.
fn cannot_bind(text: &str, error: &io::Error) -> ListenError {
    let advice = match error.kind() {
        io::ErrorKind::AddrInUse => {
            "; another process listens on this port: stop it, or choose another port \
             (port 0 lets the system choose)"
        }
        io::ErrorKind::AddrNotAvailable => {
            "; this host does not have this address; run `ip address` to list its addresses"
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

/// Returns the addresses of the interfaces, without the link-local ones of ports of a bridge or bond,
/// such as those of containers: packets to them arrive at the bridge.
fn own_addresses() -> Result<Vec<Interface>, AddressError> {
    let is_port = |name: &str| {
        Path::new("/sys/class/net")
            .join(name)
            .join("master")
            .exists()
    };
    let mut interfaces = interfaces()?;
    interfaces.retain(|interface| !interface.is_link_local() || !is_port(&interface.name));
    Ok(interfaces)
}

fn interface_index(name: &str) -> Result<u32, AddressError> {
    interfaces()?
        .into_iter()
        .find(|interface| interface.name == name)
        .and_then(|interface| interface.index)
        .ok_or_else(|| AddressError::NoSuchInterface(name.chars().take(40).collect()))
}

/// The listening sockets of an endpoint, and the addresses at which others presently reach them.
///
/// A socket bound to an unspecified address is reached at the addresses of the interfaces that are
/// up; these change while the endpoint runs ([`refresh`](Self::refresh)).
#[derive(Debug, Clone, Default)]
pub(crate) struct Listening {
    bound: Vec<SocketAddr>,
    /// Best first.
    reachable: Vec<SocketAddr>,
    /// The addresses of all interfaces.
    assigned: HashSet<IpAddr>,
}

/// The effect of a change of the interfaces on an endpoint.
#[derive(Debug, Default, PartialEq, Eq)]
pub(crate) struct Moved {
    /// Whether the reachable addresses have changed.
    pub(crate) relocated: bool,
    /// Addresses that this host no longer has.
    pub(crate) lost: HashSet<IpAddr>,
}

impl Listening {
    /// Creates the list for sockets that are bound to these addresses.
    ///
    /// # Errors
    /// When the interfaces are needed and cannot be listed.
    pub(crate) fn new(bound: Vec<SocketAddr>) -> Result<Self, AddressError> {
        let mut listening = Self {
            bound,
            ..Self::default()
        };
        if listening.depends_on_interfaces() {
            listening.update(&own_addresses()?);
        } else {
            listening.reachable = reachable(&listening.bound, &[]);
        }
        Ok(listening)
    }

    /// Whether connections from other hosts are possible: an endpoint that listens on loopback only
    /// need not watch the interfaces.
    pub(crate) fn depends_on_interfaces(&self) -> bool {
        self.bound.iter().any(|bound| !bound.ip().is_loopback())
    }

    /// Lists the interfaces again.
    ///
    /// # Errors
    /// When the interfaces cannot be listed. The list is unchanged then.
    pub(crate) fn refresh(&mut self) -> Result<Moved, AddressError> {
        Ok(self.update(&own_addresses()?))
    }

    fn update(&mut self, interfaces: &[Interface]) -> Moved {
        let assigned: HashSet<IpAddr> = interfaces.iter().map(Interface::ip).collect();
        let reachable = reachable(&self.bound, interfaces);
        let lost = self.assigned.difference(&assigned).copied().collect();
        let relocated = reachable != self.reachable;
        (self.assigned, self.reachable) = (assigned, reachable);
        Moved { relocated, lost }
    }

    /// Whether a connection to this address leads to this endpoint itself.
    pub(crate) fn is_own(&self, address: SocketAddr) -> bool {
        let (ip, port) = (address.ip().to_canonical(), address.port());
        self.bound.iter().any(|bound| {
            let is_here = match bound.ip().is_unspecified() {
                true => {
                    let same_family = bound.is_ipv4() == ip.is_ipv4();
                    same_family && (ip.is_loopback() || self.assigned.contains(&ip))
                }
                false => bound.ip() == ip,
            };
            bound.port() == port && is_here
        })
    }

    /// Returns the addresses for a hello: first unspecified addresses, which tell the peer that the
    /// port is open at the source address of any connection, then the addresses of the interfaces.
    pub(crate) fn texts(&self) -> Vec<String> {
        let any = self.bound.iter().filter(|it| it.ip().is_unspecified());
        any.chain(&self.reachable)
            .map(ToString::to_string)
            .collect()
    }

    /// Returns the addresses at which others reach the endpoint, best first.
    #[cfg(test)]
    pub(crate) fn reachable(&self) -> &[SocketAddr] {
        &self.reachable
    }

    /// Returns the locations of these addresses.
    ///
    /// # Errors
    /// When an address is not valid in a location, which does not happen with addresses of the
    /// standard library.
    pub(crate) fn locations(
        &self,
        kind: Kind,
        incarnation: Incarnation,
    ) -> Result<Vec<Location>, LocationError> {
        let locations = self.reachable.iter().map(|address| {
            if kind.is_http() {
                // Platforms know no incarnations.
                return Location::new(kind, &format!("{address}/acc"));
            }
            let location = Location::new(kind, &address.to_string())?;
            Ok(location.with_incarnation(incarnation))
        });
        locations.collect()
    }
}

/// Returns the addresses at which others reach sockets with these addresses, best first: each address
/// itself, or for an unspecified one those of the interfaces that are up.
///
/// Link-local addresses come after all others, and only for an interface that has no other address. They
/// have no scope: it names an interface of this host, and on another host another one. Loopback addresses
/// are only returned when there are no others.
fn reachable(bound: &[SocketAddr], interfaces: &[Interface]) -> Vec<SocketAddr> {
    let any = bound.iter().filter(|bound| bound.ip().is_unspecified());
    let ports = |ip: IpAddr| {
        let of_family = any
            .clone()
            .filter(move |bound| bound.is_ipv4() == ip.is_ipv4());
        of_family.map(|bound| bound.port())
    };
    let up = interfaces
        .iter()
        .filter(|interface| interface.oper_status != IfOperStatus::Down);
    let has_other = |name: &str| {
        let mut others = up.clone().filter(|other| *other.name == *name);
        others.any(|other| !other.is_link_local() && ports(other.ip()).next().is_some())
    };
    let fixed = bound.iter().filter(|bound| !bound.ip().is_unspecified());
    let mut reachable: Vec<SocketAddr> = fixed
        .map(|bound| SocketAddr::new(bound.ip(), bound.port()))
        .collect();
    // In the order of the configuration, which prefers a family.
    let of_interfaces = |which: &dyn Fn(&Interface) -> bool| {
        let of_bound = any.clone().flat_map(|bound| {
            let of_family = up.clone().filter(|it| it.ip().is_ipv4() == bound.is_ipv4());
            let of_family = of_family.filter(|interface| which(interface));
            of_family.map(|interface| SocketAddr::new(interface.ip(), bound.port()))
        });
        of_bound.collect::<Vec<_>>()
    };
    reachable.extend(of_interfaces(&|it| {
        !it.is_loopback() && !it.is_link_local()
    }));
    reachable.extend(of_interfaces(&|it| {
        !it.is_loopback() && it.is_link_local() && !has_other(&it.name)
    }));
    if reachable.is_empty() {
        return of_interfaces(&Interface::is_loopback);
    }
    let mut known = HashSet::new();
    reachable.retain(|address| known.insert(*address));
    reachable
}

/// The error of dialing an [own](Listening::is_own) address for a peer. Two hosts can have the same
/// address, for example of a bridge for containers.
pub(crate) fn itself(address: SocketAddr) -> String {
    format!("{address} is an address of this host, at which this gateway itself listens")
}

/// Returns the address at which a connected peer can be reached again: the source address of its
/// connection, with a port from its listening addresses.
///
/// No other part of the listening addresses is used: a peer may list addresses of third parties,
/// which must not be dialed for that reason. The port is that of the same address when it is
/// listed; else that of an unspecified address, when the peer listens on all of its addresses and
/// may have got this one since it made the list; else that of the first other address, when the
/// peer is known under another one (address translation). A loopback address is ignored for a
/// connection from another host.
pub(crate) fn return_address(listening: &[String], from: SocketAddr) -> SocketAddr {
    let listening: Vec<SocketAddr> = listening
        .iter()
        .filter_map(|text| numeric_ignoring_scope(text))
        .filter(|address| address.port() != 0)
        .collect();
    let first = |fits: &dyn Fn(IpAddr) -> bool| listening.iter().find(|it| fits(it.ip()));
    let port = first(&|ip| ip == from.ip())
        .or_else(|| first(&|ip| ip.is_unspecified() && ip.is_ipv4() == from.is_ipv4()))
        .or_else(|| {
            first(&|ip| {
                let is_reachable = from.ip().is_loopback() || !ip.is_loopback();
                is_reachable && !ip.is_unspecified() && !is_link_local(ip)
            })
        })
        .map_or(from.port(), |address| address.port());
    let mut back = from;
    back.set_port(port);
    back
}

/// Whether a peer with these listening addresses lists `ip` as its own. Addresses that denote
/// another host on every host or link do not count.
pub(crate) fn lists(listening: &[String], ip: IpAddr) -> bool {
    let ip = ip.to_canonical();
    let own = listening
        .iter()
        .filter_map(|text| numeric_ignoring_scope(text));
    let mut own = own.map(|address| address.ip().to_canonical());
    !ip.is_loopback() && !ip.is_unspecified() && !is_link_local(ip) && own.any(|own| own == ip)
}

/// Parses an address without its scope, which names an interface of another host.
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
    use if_addrs::{IfAddr, Ifv4Addr, Ifv6Addr};
    use proptest::prelude::*;

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
    fn targets_are_numeric_addresses_or_valid_host_names() {
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
    fn an_unspecified_address_is_replaced_by_those_of_the_interfaces() {
        for bound in ["0.0.0.0:7788", "[::]:7788"] {
            let bound: SocketAddr = bound.parse().unwrap();
            let listening = Listening::new(vec![bound]).unwrap();
            for address in listening.reachable() {
                assert!(!address.ip().is_unspecified());
                assert_eq!(address.port(), 7788);
                assert_eq!(address.is_ipv4(), bound.is_ipv4());
            }
            assert_eq!(listening.texts()[0], bound.to_string());
        }
        let fixed = "127.0.0.1:7788".parse().unwrap();
        assert_eq!(Listening::new(vec![fixed]).unwrap().reachable(), [fixed]);
    }

    /// An interface with this address.
    fn interface(name: &str, index: u32, ip: Ipv4Addr) -> Interface {
        Interface {
            name: name.into(),
            addr: IfAddr::V4(Ifv4Addr {
                ip,
                netmask: Ipv4Addr::new(255, 255, 255, 0),
                prefixlen: 24,
                broadcast: None,
            }),
            index: Some(index),
            oper_status: IfOperStatus::Up,
            is_p2p: false,
        }
    }

    #[test]
    fn reachable_addresses_follow_the_interfaces() {
        let own = |last| Ipv4Addr::new(10, 0, 0, last);
        let lo = interface("lo", 1, Ipv4Addr::LOCALHOST);
        let ethernet = |last| [lo.clone(), interface("eth0", 2, own(last))];
        let at = |ip| vec![SocketAddr::from((ip, 7788))];
        let mut listening = Listening {
            bound: at(Ipv4Addr::UNSPECIFIED),
            ..Listening::default()
        };
        let started = listening.update(std::slice::from_ref(&lo));
        assert!(started.relocated);
        assert_eq!(listening.reachable(), at(Ipv4Addr::LOCALHOST));

        let connected = listening.update(&ethernet(1));
        assert!(connected.relocated && connected.lost.is_empty());
        assert_eq!(listening.reachable(), at(own(1)));
        assert_eq!(listening.texts(), ["0.0.0.0:7788", "10.0.0.1:7788"]);
        assert_eq!(listening.update(&ethernet(1)), Moved::default());

        let moved = listening.update(&ethernet(2));
        assert!(moved.relocated);
        assert_eq!(moved.lost, HashSet::from([own(1).into()]));
        assert_eq!(listening.reachable(), at(own(2)));
    }

    /// An interface with this link-local IPv6 address.
    fn interface_v6(name: &str, index: u32, ip: &str) -> Interface {
        Interface {
            addr: IfAddr::V6(Ifv6Addr {
                ip: ip.parse().unwrap(),
                netmask: Ipv6Addr::UNSPECIFIED,
                prefixlen: 64,
                broadcast: None,
            }),
            ..interface(name, index, Ipv4Addr::LOCALHOST)
        }
    }

    #[test]
    fn link_local_addresses_are_listed_where_an_interface_has_no_other() {
        let lo = [
            interface("lo", 1, Ipv4Addr::LOCALHOST),
            interface_v6("lo", 1, "::1"),
        ];
        let ethernet = [
            interface_v6("eth0", 2, "fe80::2"),
            interface_v6("eth0", 2, "fd00::2"),
            interface("eth0", 2, Ipv4Addr::new(10, 0, 0, 2)),
        ];
        let cables = [
            interface_v6("eth1", 3, "fe80::3"),
            interface("eth2", 4, Ipv4Addr::new(169, 254, 0, 4)),
        ];
        let listed = |listen: &str, interfaces: &[&[Interface]]| {
            let addresses = reachable(&to_bind(listen).unwrap(), &interfaces.concat());
            addresses
                .iter()
                .map(ToString::to_string)
                .collect::<Vec<_>>()
        };
        let all: [&[Interface]; 3] = [&lo, &ethernet, &cables];
        let (v4, v6) = (
            ["10.0.0.2:7", "169.254.0.4:7"],
            ["[fd00::2]:7", "[fe80::3]:7"],
        );
        assert_eq!(listed("*:7", &all), [v4[0], v6[0], v4[1], v6[1]]);
        assert_eq!(listed("0.0.0.0:7", &all), v4);
        assert_eq!(listed("[::]:7", &all), v6);
        // Without a scope, which names an interface of this host.
        assert_eq!(listed("[fe80::3%3]:7", &all), ["[fe80::3]:7"]);
        assert_eq!(listed("*:7", &[&lo, &cables[..1]]), ["[fe80::3]:7"]);
        assert_eq!(listed("*:7", &[&lo]), ["127.0.0.1:7", "[::1]:7"]);
        assert_eq!(listed("0.0.0.0:7", &[&lo, &ethernet[..2]]), ["127.0.0.1:7"]);
    }

    #[test]
    fn own_addresses_are_those_of_the_sockets() {
        let mut listening = Listening {
            bound: to_bind("*:7788").unwrap(),
            ..Listening::default()
        };
        listening.update(&[
            interface("docker0", 3, Ipv4Addr::new(172, 17, 0, 1)),
            interface_v6("eth0", 2, "fe80::2"),
        ]);
        let is_own = |text: &str| listening.is_own(text.parse().unwrap());
        for own in [
            "172.17.0.1:7788",
            "[::ffff:172.17.0.1]:7788",
            "[fe80::2%2]:7788",
            "127.0.0.1:7788",
        ] {
            assert!(is_own(own), "{own}");
        }
        for other in ["172.17.0.1:7789", "172.17.0.2:7788", "[fe80::3%2]:7788"] {
            assert!(!is_own(other), "{other}");
        }
        let one = Listening::new(vec!["127.0.0.1:7788".parse().unwrap()]).unwrap();
        assert!(!one.is_own("127.0.0.2:7788".parse().unwrap()));
    }

    #[test]
    fn a_link_local_address_without_a_scope_is_not_dialed() {
        let bare = Err(AddressError::NoScope("fe80::1".parse().unwrap()));
        assert_eq!(numeric("[fe80::1]:7788"), bare);
        assert_eq!(target("[fe80::1]:7788"), bare.map(Target::Numeric));
        assert!(target("[fe80::1%2]:7788").is_ok());
    }

    #[test]
    fn a_family_that_the_host_lacks_is_left_out_of_all_addresses() {
        let open = |lacking: &'static [bool]| {
            move |address: SocketAddr| match lacking.contains(&address.is_ipv4()) {
                true => Err(io::Error::from(Errno::AFNOSUPPORT)),
                false => Ok(((), address)),
            }
        };
        let bound = |listen: &str, lacking| bind_all(&[listen.to_owned()], open(lacking));
        assert_eq!(bound("*:7", &[]).unwrap().len(), 2);
        assert_eq!(bound("*:7", &[false]).unwrap().len(), 1);
        assert!(bound("*:7", &[true, false]).is_err());
        assert!(bound("[::]:7", &[false]).is_err());
        assert!(bound("*:x", &[]).is_err());
    }

    #[test]
    fn a_socket_bound_to_one_address_keeps_it() {
        let fixed = SocketAddr::from((Ipv4Addr::new(10, 0, 0, 1), 7788));
        let mut listening = Listening {
            bound: vec![fixed],
            ..Listening::default()
        };
        let on = interface("eth0", 2, Ipv4Addr::new(10, 0, 0, 1));
        listening.update(&[on]);
        let gone = listening.update(&[]);
        assert!(!gone.relocated);
        assert_eq!(gone.lost, HashSet::from([fixed.ip()]));
        assert_eq!(listening.reachable(), [fixed]);
        assert_eq!(listening.texts(), ["10.0.0.1:7788"]);
    }

    proptest! {
        #[test]
        fn the_return_address_belongs_to_the_peer(
            listening in prop::collection::vec(
                prop_oneof![
                    any::<SocketAddr>().prop_map(|address| address.to_string()),
                    any::<u16>().prop_map(|port| format!("0.0.0.0:{port}")),
                    any::<u16>().prop_map(|port| format!("[fe80::1%eth0]:{port}")),
                    ".{0,20}",
                ],
                0..6,
            ),
            from: SocketAddr,
        ) {
            let back = return_address(&listening, from);
            prop_assert_eq!(back.ip(), from.ip());
        }
    }

    #[test]
    fn the_return_address_has_a_listening_port_of_the_peer() {
        let back = |listening: &[&str], from: &str| {
            let listening: Vec<String> = listening.iter().map(|text| (*text).into()).collect();
            return_address(&listening, from.parse().unwrap()).to_string()
        };
        let from = "10.0.0.2:40000";
        assert_eq!(back(&["192.168.0.2:7", "10.0.0.2:8"], from), "10.0.0.2:8");
        assert_eq!(back(&["127.0.0.1:6", "192.168.0.2:7"], from), "10.0.0.2:7");
        assert_eq!(back(&["127.0.0.1:7"], "127.0.0.1:40000"), "127.0.0.1:7");
        assert_eq!(back(&["127.0.0.1:7"], from), from);
        assert_eq!(back(&[], from), from);
        assert_eq!(back(&["nonsense", "[::]:7", "10.0.0.2:0"], from), from);
        // The peer listens on all addresses, and has got this one since it made the list.
        let any = ["0.0.0.0:7", "192.168.0.2:7"];
        assert_eq!(back(&any, from), "10.0.0.2:7");
        assert_eq!(
            back(&["[fe80::2%wlan0]:7"], "[fe80::2%3]:40000"),
            "[fe80::2%3]:7"
        );
    }
}
