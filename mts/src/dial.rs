//! The rules for addresses in agent identifiers: which of them a gateway dials.
//!
//! An identifier is a claim. Without rules, its writer could make a gateway connect to any host and port that the
//! gateway reaches. [`judge`] is the one function that decides; the core asks it about the addresses in
//! letters, and the gateway about those that its processes ask it to use.

use std::fmt;
use std::net::{IpAddr, SocketAddr};
use std::str::FromStr;

use fipa_transport::{Kind, Location};

/// A network: an address, and the number of its leading bits that count.
///
/// As text `10.0.0.0/8`, `fd00::/8`, or an address alone.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Network {
    address: IpAddr,
    bits: u8,
}

/// The error of reading a [`Network`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum NetworkError {
    /// The part before the slash is not an address.
    #[error("not a network (expected for example 10.0.0.0/8, fd00::/8 or 10.0.0.7)")]
    Syntax,
    /// The prefix is not a number of bits of the address.
    #[error("the prefix of the network has at most {0} bits")]
    Prefix(u8),
    /// The address has bits behind the prefix.
    #[error("the address has bits behind the prefix; write {0}")]
    HostBits(Network),
}

impl Network {
    /// Whether the network has this address. A mapped IPv4 address counts as the IPv4 address.
    #[must_use]
    pub fn contains(&self, ip: IpAddr) -> bool {
        let address = ip.to_canonical();
        let there = Self { address, ..*self };
        // The prefix of one family is no prefix of the other.
        address.is_ipv4() == self.address.is_ipv4() && there.masked() == *self
    }

    /// Returns the network with all bits behind the prefix set to zero.
    fn masked(self) -> Self {
        let address = match self.address {
            IpAddr::V4(it) => {
                let mask = u32::MAX.checked_shl(32 - u32::from(self.bits));
                IpAddr::V4((u32::from(it) & mask.unwrap_or(0)).into())
            }
            IpAddr::V6(it) => {
                let mask = u128::MAX.checked_shl(128 - u32::from(self.bits));
                IpAddr::V6((u128::from(it) & mask.unwrap_or(0)).into())
            }
        };
        Self { address, ..self }
    }
}

impl FromStr for Network {
    type Err = NetworkError;

    fn from_str(text: &str) -> Result<Self, NetworkError> {
        let (address, bits) = match text.split_once('/') {
            Some((address, bits)) => (address, Some(bits)),
            None => (text, None),
        };
        let address: IpAddr = address.parse().map_err(|_| NetworkError::Syntax)?;
        let most = if address.is_ipv4() { 32 } else { 128 };
        let bits = match bits {
            None => most,
            Some(bits) => {
                let digits = bits.bytes().all(|it| it.is_ascii_digit());
                let bits = bits.parse().ok().filter(|_| digits);
                bits.filter(|bits| *bits <= most)
                    .ok_or(NetworkError::Prefix(most))?
            }
        };
        let network = Self { address, bits };
        match network.masked() {
            masked if masked == network => Ok(network),
            masked => Err(NetworkError::HostBits(masked)),
        }
    }
}

impl fmt::Display for Network {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let most = if self.address.is_ipv4() { 32 } else { 128 };
        match self.bits == most {
            true => write!(f, "{}", self.address),
            false => write!(f, "{}/{}", self.address, self.bits),
        }
    }
}

/// The origin of an address in an agent identifier.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Claim {
    /// The program or the operator of this host gave it.
    Given,
    /// The sender of a letter stated it as its own, in a letter that came from this host.
    Return(IpAddr),
    /// It is in a decoded identifier. `is_host` is whether its host is that of the connection on which the
    /// identifier came, or of a platform that took a letter from here within a day. `is_endpoint` is whether the
    /// platform took that letter at this very address and port.
    Received {
        /// Whether the host is known.
        is_host: bool,
        /// Whether the address and the port are known.
        is_endpoint: bool,
    },
}

/// The reason for which an address is not dialed. Each text names the key that would permit it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum NotDialed {
    /// Neither a letter came from the host, nor did it take one.
    #[error(
        "the identifier was received, and neither did it come from the host of this address, nor did a platform there \
         take a letter within a day; list the network in contacts.networks to permit it"
    )]
    OtherHost,
    /// The address is one that other hosts must not make a gateway dial.
    #[error(
        "{0} are not dialed for a received identifier; list the network in contacts.networks to permit it"
    )]
    Special(&'static str),
}

/// Decides whether a gateway dials this address, to which a host name is resolved already. `networks` are those of
/// `contacts.networks`, and `own` the addresses at which this gateway listens.
///
/// # Errors
/// The reason for which it does not.
pub fn judge(
    at: SocketAddr,
    claim: Claim,
    networks: &[Network],
    own: &[SocketAddr],
) -> Result<(), NotDialed> {
    let ip = at.ip().to_canonical();
    if claim == Claim::Given || networks.iter().any(|network| network.contains(ip)) {
        return Ok(());
    }
    let (is_host, is_near_allowed) = match claim {
        Claim::Given => (true, true),
        // The connection proves that the source is reached on this link, or is this host.
        Claim::Return(from) => (from.to_canonical() == ip, from.to_canonical() == ip),
        // The gateway dials this address and port anyway.
        Claim::Received { is_endpoint, .. } if is_endpoint => return Ok(()),
        Claim::Received { is_host, .. } => (is_host, false),
    };
    let is_own = own.iter().any(|own| {
        let is_there = own.ip().to_canonical() == ip || own.ip().is_unspecified();
        // The socket may listen at all addresses, and `own` has those for other hosts.
        own.port() == at.port() && (is_there || ip.is_loopback())
    });
    let special = match ip {
        _ if ip.is_unspecified() || is_this_network(ip) => Some("addresses of no host"),
        _ if ip.is_multicast() || is_broadcast(ip) => Some("addresses of many hosts"),
        _ if is_own => Some("addresses at which this gateway listens"),
        _ if ip.is_loopback() && !is_near_allowed => Some("loopback addresses"),
        _ if is_link_local(ip) && !is_near_allowed => Some("link-local addresses"),
        _ if at.port() < 1024 && !matches!(at.port(), 80 | 443) => {
            Some("ports below 1024 except 80 and 443")
        }
        _ => None,
    };
    match special {
        Some(what) => Err(NotDialed::Special(what)),
        None if is_host => Ok(()),
        None => Err(NotDialed::OtherHost),
    }
}

/// Whether the address is in `0.0.0.0/8`, which a kernel may take for this host.
fn is_this_network(ip: IpAddr) -> bool {
    matches!(ip, IpAddr::V4(v4) if v4.octets()[0] == 0)
}

fn is_broadcast(ip: IpAddr) -> bool {
    matches!(ip, IpAddr::V4(v4) if v4.is_broadcast())
}

fn is_link_local(ip: IpAddr) -> bool {
    match ip {
        IpAddr::V4(v4) => v4.is_link_local(),
        IpAddr::V6(v6) => v6.is_unicast_link_local(),
    }
}

/// The port of an address of HTTP without one; JADE's.
pub(crate) const HTTP_PORT: u16 = 7778;

/// The host and the port to which a location leads.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum Endpoint {
    /// An address.
    Numeric(SocketAddr),
    /// A host name, in lower case, and a port.
    Named(String, u16),
}

impl Endpoint {
    /// Returns the endpoint of a location. `None` if its address has none.
    #[must_use]
    pub fn of(location: &Location) -> Option<Self> {
        let authority = location.authority();
        if let Ok(at) = authority.parse::<SocketAddr>() {
            return Some(Self::Numeric(at));
        }
        let is_http = matches!(location.kind(), Kind::Http | Kind::Https);
        let bare = authority.strip_prefix('[').unwrap_or(authority);
        let bare = bare.strip_suffix(']').unwrap_or(bare);
        if let Ok(ip) = bare.parse::<IpAddr>() {
            return is_http.then(|| Self::Numeric(SocketAddr::new(ip, HTTP_PORT)));
        }
        let (name, port) = match authority.rsplit_once(':') {
            Some((name, port)) => (name, port.parse().ok()?),
            None if is_http => (authority, HTTP_PORT),
            None => return None,
        };
        let is_plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '-' | '_');
        let is_name = !name.is_empty() && name.len() <= 253 && name.chars().all(is_plain);
        (is_name && port != 0).then(|| Self::Named(name.to_ascii_lowercase(), port))
    }

    /// The port.
    #[must_use]
    pub fn port(&self) -> u16 {
        match self {
            Self::Numeric(at) => at.port(),
            Self::Named(_, port) => *port,
        }
    }
}

/// Returns the addresses and ports at which a service with these locations listens on the network.
pub fn listened_at<'a>(locations: impl IntoIterator<Item = &'a Location>) -> Vec<SocketAddr> {
    let networked = locations.into_iter();
    let networked = networked.filter(|location| !location.kind().is_host_local());
    let own = networked.filter_map(|location| match Endpoint::of(location)? {
        Endpoint::Numeric(at) => Some(at),
        Endpoint::Named(..) => None,
    });
    own.collect()
}

/// Returns a location with this address and port instead of its host name. `None` if it has no path.
#[must_use]
pub fn located_at(location: &Location, at: SocketAddr) -> Option<Location> {
    let path = location.address().get(location.authority().len()..)?;
    let there = Location::new(location.kind(), &format!("{at}{path}")).ok()?;
    there.with_signature(location.signature()).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn networks(texts: &[&str]) -> Vec<Network> {
        texts.iter().map(|text| text.parse().unwrap()).collect()
    }

    #[test]
    fn the_table_of_claims_and_addresses() {
        const NEITHER: Claim = Claim::Received {
            is_host: false,
            is_endpoint: false,
        };
        const HOST: Claim = Claim::Received {
            is_host: true,
            is_endpoint: false,
        };
        const ENDPOINT: Claim = Claim::Received {
            is_host: true,
            is_endpoint: true,
        };
        let own: Vec<SocketAddr> = ["10.0.0.1:7778", "[fd00::1]:7788"]
            .iter()
            .map(|it| it.parse().unwrap())
            .collect();
        let back = |ip: &str| Claim::Return(ip.parse().unwrap());
        // The address; whether each claim permits it without networks; the networks that permit it. In the columns:
        // received, received from its host, received from its endpoint, stated by the source of a letter.
        let table = [
            ("10.0.0.7:7778", [false, true, true, true], "10.0.0.0/24"),
            ("10.0.0.7:80", [false, true, true, true], "10.0.0.7"),
            ("10.0.0.7:443", [false, true, true, true], "10.0.0.7/32"),
            ("10.0.0.7:1024", [false, true, true, true], "0.0.0.0/0"),
            ("10.0.0.7:22", [false, false, true, false], "10.0.0.0/8"),
            ("10.0.0.7:0", [false, false, true, false], "10.0.0.0/8"),
            ("10.0.0.1:7778", [false, false, true, false], "10.0.0.1"),
            ("10.0.0.1:7779", [false, true, true, true], "10.0.0.1"),
            ("[fd00::1]:7788", [false, false, true, false], "fd00::/8"),
            ("[fd00::2]:7788", [false, true, true, true], "fd00::/64"),
            (
                "[::ffff:10.0.0.7]:7778",
                [false, true, true, true],
                "10.0.0.0/8",
            ),
            (
                "[::ffff:10.0.0.1]:7778",
                [false, false, true, false],
                "10.0.0.1",
            ),
            ("127.0.0.1:8080", [false, false, true, true], "127.0.0.0/8"),
            ("127.0.0.1:7788", [false, false, true, false], "127.0.0.0/8"),
            ("127.0.0.1:22", [false, false, true, false], "127.0.0.0/8"),
            ("[::1]:8080", [false, false, true, true], "::1"),
            (
                "[::ffff:127.0.0.1]:8080",
                [false, false, true, true],
                "127.0.0.1",
            ),
            (
                "169.254.169.254:80",
                [false, false, true, true],
                "169.254.0.0/16",
            ),
            ("[fe80::7]:7778", [false, false, true, true], "fe80::/10"),
            (
                "224.0.0.251:5353",
                [false, false, true, false],
                "224.0.0.0/4",
            ),
            ("[ff02::1]:7778", [false, false, true, false], "ff00::/8"),
            (
                "255.255.255.255:7778",
                [false, false, true, false],
                "0.0.0.0/0",
            ),
            ("0.0.0.0:7778", [false, false, true, false], "0.0.0.0/8"),
            ("0.1.2.3:7778", [false, false, true, false], "0.0.0.0/8"),
            ("[::]:7778", [false, false, true, false], "::/0"),
        ];
        for (text, permitted, network) in table {
            let at: SocketAddr = text.parse().unwrap();
            let source = at.ip().to_string();
            let claims = [NEITHER, HOST, ENDPOINT, back(&source)];
            for (claim, permitted) in claims.into_iter().zip(permitted) {
                let judged = judge(at, claim, &[], &own);
                assert_eq!(judged.is_ok(), permitted, "{text} {claim:?}: {judged:?}");
                if let Err(why) = judged {
                    assert!(why.to_string().contains("contacts.networks"), "{why}");
                }
                // A network that is listed permits everything in it.
                assert_eq!(judge(at, claim, &networks(&[network]), &own), Ok(()));
                let elsewhere = networks(&["192.0.2.0/24", "2001:db8::/32"]);
                assert_eq!(judge(at, claim, &elsewhere, &own).is_ok(), permitted);
            }
            assert_eq!(judge(at, Claim::Given, &[], &own), Ok(()), "{text}");
            // The source of a letter states the address of a third party.
            for source in ["10.0.0.9", "127.0.0.9", "fe80::9", "::1"] {
                let other = source.parse::<IpAddr>().unwrap() != at.ip();
                let judged = judge(at, back(source), &[], &own);
                assert!(!other || judged.is_err(), "{text} from {source}");
            }
        }
    }

    #[test]
    fn a_wildcard_listens_at_all_own_ports() {
        let own = ["0.0.0.0:7778".parse().unwrap()];
        let host = Claim::Received {
            is_host: true,
            is_endpoint: false,
        };
        let at = |text: &str| judge(text.parse().unwrap(), host, &[], &own);
        assert!(at("10.0.0.1:7778").is_err() && at("10.0.0.1:7779").is_ok());
    }

    #[test]
    fn networks_are_read_and_written() {
        for text in [
            "10.0.0.0/8",
            "0.0.0.0/0",
            "::/0",
            "fd00::/8",
            "10.0.0.7",
            "::1",
        ] {
            assert_eq!(text.parse::<Network>().unwrap().to_string(), text);
        }
        assert_eq!(
            "10.0.0.7/32".parse::<Network>().unwrap().to_string(),
            "10.0.0.7"
        );
        for text in [
            "",
            "x",
            "10.0.0.0/",
            "10.0.0.0/33",
            "10.0.0.0/+8",
            "::/129",
            "10/8",
        ] {
            assert!(text.parse::<Network>().is_err(), "{text}");
        }
        let error = "10.0.0.7/8".parse::<Network>().unwrap_err().to_string();
        assert!(error.contains("write 10.0.0.0/8"), "{error}");
    }

    #[test]
    fn a_location_leads_to_a_host_and_a_port() {
        let of = |text: &str| Endpoint::of(&text.parse().unwrap());
        let numeric = |text: &str| Some(Endpoint::Numeric(text.parse().unwrap()));
        assert_eq!(of("http://10.0.0.7/acc"), numeric("10.0.0.7:7778"));
        assert_eq!(of("http://[::1]/acc"), numeric("[::1]:7778"));
        assert_eq!(of("tcp://10.0.0.7:6789;jade"), numeric("10.0.0.7:6789"));
        assert_eq!(of("tcp://10.0.0.7;jade"), None);
        assert_eq!(
            of("http://Crex.local/x"),
            Some(Endpoint::Named("crex.local".into(), 7778))
        );
        assert_eq!(of("http://crex:0/x"), None);
        let at = located_at(
            &"http://crex:80/x".parse().unwrap(),
            "10.0.0.7:80".parse().unwrap(),
        );
        assert_eq!(at.unwrap().to_string(), "http://10.0.0.7:80/x");
    }
}
