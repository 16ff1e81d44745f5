//! Locations: the addresses of message transport services, with their transports.

use std::fmt;
use std::net::{IpAddr, Ipv6Addr};
use std::str::FromStr;
use std::sync::Arc;

use fipa_acl::is_unprintable;
use serde::{Deserialize, Serialize};

use crate::serde_text::serde_as_text;
use crate::{Incarnation, quota_address, scoped_quota_address};

/// A kind of transport, as named in the configuration and in addresses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum Kind {
    /// Shared memory between processes of one host.
    Shm,
    /// Framed, acknowledged letters over TCP.
    Tcp,
    /// One letter per datagram, acknowledged.
    Udp,
    /// Letters over QUIC, encrypted.
    Quic,
    /// Framed, acknowledged letters over Unix domain sockets between processes of one host.
    Unix,
    /// UDT, one of the transports of fipa_services: letters of legacy peers, not encrypted.
    Udt,
    /// Letters in multipart messages over HTTP (FIPA00084): JADE's transport between platforms.
    Http,
    /// Letters in multipart messages over HTTP and TLS.
    Https,
}

impl Kind {
    /// All kinds. The position is the code on the wire, so new ones go last.
    pub const ALL: [Self; 8] = [
        Self::Shm,
        Self::Tcp,
        Self::Udp,
        Self::Quic,
        Self::Unix,
        Self::Udt,
        Self::Http,
        Self::Https,
    ];

    /// Whether every gateway can use this kind. UDT is an option of the build, for legacy peers; where
    /// it is off, letters to agents that have no other locations fail as
    /// [unsupported](crate::FailureReason::Unsupported).
    #[must_use]
    pub const fn is_supported(self) -> bool {
        !matches!(self, Self::Udt)
    }

    /// Name of this kind, which is also the scheme of its addresses.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Shm => "shm",
            Self::Tcp => "tcp",
            Self::Udp => "udp",
            Self::Quic => "quic",
            Self::Unix => "unix",
            Self::Udt => "udt",
            Self::Http => "http",
            Self::Https => "https",
        }
    }

    /// Whether this is HTTP, with or without TLS.
    #[must_use]
    pub const fn is_http(self) -> bool {
        matches!(self, Self::Http | Self::Https)
    }

    /// Whether locations of this kind lead only to processes of this host. Such locations are
    /// neither announced to other hosts nor accepted from them.
    #[must_use]
    pub const fn is_host_local(self) -> bool {
        matches!(self, Self::Shm | Self::Unix)
    }
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

impl FromStr for Kind {
    type Err = LocationError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Self::ALL
            .into_iter()
            .find(|kind| kind.name() == text)
            .ok_or_else(|| LocationError::UnknownKind(text.chars().take(40).collect()))
    }
}

/// The protocol at a location: the signature type of a service locator (FIPA00001), which legacy
/// peers call the signature of a location.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Signature {
    /// Frames of this project, acknowledged.
    #[default]
    Frames,
    /// One letter per connection, bit-efficient in the dialect of fipa_services, not acknowledged.
    FipaServices,
    /// An XML envelope and a string message, whose delivery is not confirmed: JADE. Over TCP, its
    /// proxy agent reads one letter per connection.
    JadeProxy,
    /// An XML envelope and an XML message, whose delivery is not confirmed, over HTTP, to a platform with
    /// JADE's codec for XML.
    JadeXml,
    /// An XML envelope and a bit-efficient message, whose delivery is not confirmed, over HTTP, to a platform
    /// with JADE's codec for it.
    JadeBitEfficient,
}

impl Signature {
    /// All signatures.
    pub const ALL: [Self; 5] = [
        Self::Frames,
        Self::FipaServices,
        Self::JadeProxy,
        Self::JadeXml,
        Self::JadeBitEfficient,
    ];

    /// Whether the peer is JADE.
    #[must_use]
    pub const fn is_jade(self) -> bool {
        matches!(
            self,
            Self::JadeProxy | Self::JadeXml | Self::JadeBitEfficient
        )
    }

    /// Name of this signature in a [`Location`]. The name of frames is omitted there.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Frames => "fipa",
            Self::FipaServices => "fipa-services",
            Self::JadeProxy => "jade",
            Self::JadeXml => "jade-xml",
            Self::JadeBitEfficient => "jade-bit-efficient",
        }
    }

    /// The signature type in the directory of legacy peers. A location for frames also accepts the
    /// letters of fipa_services on the same port, so it has their signature type.
    #[must_use]
    pub const fn signature_type(self) -> &'static str {
        match self {
            Self::Frames | Self::FipaServices => "fipa::services::transports::MessageTransport",
            Self::JadeProxy | Self::JadeXml | Self::JadeBitEfficient => "JadeProxyAgent",
        }
    }

    /// The signature that a legacy peer means by a signature type, if known. Never
    /// [`Signature::Frames`], because legacy peers use the same text for their own protocol.
    #[must_use]
    pub fn of_signature_type(text: &str) -> Option<Self> {
        [Self::FipaServices, Self::JadeProxy]
            .into_iter()
            .find(|signature| signature.signature_type() == text)
    }
}

impl fmt::Display for Signature {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

impl FromStr for Signature {
    type Err = LocationError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Self::ALL
            .into_iter()
            .find(|signature| signature.name() == text)
            .ok_or_else(|| LocationError::UnknownSignature(text.chars().take(40).collect()))
    }
}

/// The address of a message transport service, the protocol there, and the incarnation of the
/// service.
///
/// Written `kind://address`, then `;signature` unless the protocol is frames (it may be omitted for
/// `udt`, over which only fipa_services is supported, and for `http`, over which only JADE is:
/// without it, messages to JADE are strings), then `#incarnation` if known: `tcp://10.0.0.2:7788#00abcdef01234567`,
/// `tcp://10.0.0.3:6789;fipa-services`, `tcp://10.0.0.4:6789;jade`, `http://10.0.0.4:7778/acc`. The transport defines the meaning of `address`. Ports are reused, so
/// a transport that finds another incarnation than the known one at a location reports that no
/// receiver was reached.
///
/// Cheap to clone.
#[derive(Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Location {
    kind: Kind,
    address: Arc<str>,
    signature: Signature,
    incarnation: Incarnation,
}

impl Location {
    /// Maximum length of an address in bytes.
    pub const MAX_ADDRESS: usize = 512;

    /// Creates a location with an unknown incarnation and the signature [`Signature::Frames`] (over
    /// UDT: [`Signature::FipaServices`], over HTTP: [`Signature::JadeProxy`]).
    ///
    /// # Errors
    /// Returns an error if the address is empty, too long, or contains white space,
    /// [unprintable](fipa_acl::is_unprintable) characters, `#` or `;`.
    pub fn new(kind: Kind, address: &str) -> Result<Self, LocationError> {
        if address.is_empty() || address.len() > Self::MAX_ADDRESS {
            return Err(LocationError::AddressLength(address.len()));
        }
        if address
            .chars()
            .any(|c| c.is_whitespace() || is_unprintable(c) || matches!(c, '#' | ';'))
        {
            return Err(LocationError::AddressCharacters(
                address.chars().take(40).collect(),
            ));
        }
        Ok(Self {
            kind,
            address: address.into(),
            signature: match kind {
                Kind::Udt => Signature::FipaServices,
                Kind::Http | Kind::Https => Signature::JadeProxy,
                _ => Signature::Frames,
            },
            incarnation: Incarnation::UNKNOWN,
        })
    }

    /// Sets the incarnation.
    #[must_use]
    pub fn with_incarnation(mut self, incarnation: Incarnation) -> Self {
        self.incarnation = incarnation;
        self
    }

    /// Sets the signature.
    ///
    /// # Errors
    /// Returns an error if this kind of transport does not support it: UDT supports only that of
    /// fipa_services, HTTP those of JADE, TCP all but the latter's encodings, and all others only
    /// frames.
    pub fn with_signature(mut self, signature: Signature) -> Result<Self, LocationError> {
        let is_spoken = match self.kind {
            Kind::Tcp => !matches!(signature, Signature::JadeXml | Signature::JadeBitEfficient),
            Kind::Udt => signature == Signature::FipaServices,
            Kind::Http | Kind::Https => signature.is_jade(),
            _ => signature == Signature::Frames,
        };
        if !is_spoken {
            return Err(LocationError::NotOverKind(signature, self.kind));
        }
        self.signature = signature;
        Ok(self)
    }

    /// The kind of transport that can reach the location.
    #[must_use]
    pub fn kind(&self) -> Kind {
        self.kind
    }

    /// The part of the address that the transport defines.
    #[must_use]
    pub fn address(&self) -> &str {
        &self.address
    }

    /// Host and port of the address: the part of an address of HTTP in front of its path, and the
    /// whole address of other transports.
    #[must_use]
    pub fn authority(&self) -> &str {
        match (self.kind, self.address.find('/')) {
            (Kind::Http | Kind::Https, Some(path)) => self.address.get(..path).unwrap_or_default(),
            _ => &self.address,
        }
    }

    /// Host of the address: the [authority](Self::authority) without the port.
    #[must_use]
    pub fn host(&self) -> &str {
        let authority = self.authority();
        authority
            .rsplit_once(':')
            .map_or(authority, |(host, _)| host)
    }

    /// The address by which quotas count the host, if the host is an IP address; see [`quota_address`].
    /// The scope counts if it is the number of an interface.
    ///
    /// [`quota_address`]: crate::quota_address
    #[must_use]
    pub fn quota_address(&self) -> Option<IpAddr> {
        if let Some((ip, scope, _)) = self.ipv6() {
            let interface = scope.and_then(|scope| scope.parse().ok());
            return Some(scoped_quota_address(ip.into(), interface.unwrap_or(0)));
        }
        self.host().parse().ok().map(quota_address)
    }

    /// Whether this is a link-local IPv6 address, which is only valid together with the interface that leads
    /// to it, its scope.
    #[must_use]
    pub fn is_link_local(&self) -> bool {
        self.ipv6()
            .is_some_and(|(ip, _, _)| ip.is_unicast_link_local())
    }

    /// Returns this location without the scope of an IPv6 address. The scope is an interface of the host
    /// that wrote it and has no meaning on another one (RFC 4007 section 6).
    #[must_use]
    pub fn without_scope(self) -> Self {
        match self.ipv6() {
            Some((ip, Some(_), rest)) => {
                let address = format!("[{ip}]{rest}").into();
                Self { address, ..self }
            }
            _ => self,
        }
    }

    /// Returns this location with the interface of this number as the scope of its IPv6 address. Other
    /// locations stay as they are.
    #[must_use]
    pub fn on_interface(self, interface: u32) -> Self {
        match self.ipv6() {
            Some((ip, _, rest)) => {
                let address = format!("[{ip}%{interface}]{rest}").into();
                Self { address, ..self }
            }
            None => self,
        }
    }

    /// Splits an IPv6 address: the part before the scope, the scope, and the text after the bracket.
    fn ipv6(&self) -> Option<(Ipv6Addr, Option<&str>, &str)> {
        let (inner, rest) = self.address.strip_prefix('[')?.split_once(']')?;
        let (ip, scope) = match inner.split_once('%') {
            Some((ip, scope)) => (ip, Some(scope)),
            None => (inner, None),
        };
        Some((ip.parse().ok()?, scope, rest))
    }

    /// The protocol at the location.
    #[must_use]
    pub fn signature(&self) -> Signature {
        self.signature
    }

    /// Incarnation of the message transport service at this location; may be unknown.
    #[must_use]
    pub fn incarnation(&self) -> Incarnation {
        self.incarnation
    }
}

impl fmt::Display for Location {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}://{}", self.kind, self.address)?;
        let is_default = match self.kind {
            Kind::Http | Kind::Https => self.signature == Signature::JadeProxy,
            _ => self.signature == Signature::Frames,
        };
        if !is_default {
            write!(f, ";{}", self.signature)?;
        }
        if self.incarnation.is_known() {
            write!(f, "#{}", self.incarnation)?;
        }
        Ok(())
    }
}

impl fmt::Debug for Location {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{self}")
    }
}

/// Text that is not a location.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum LocationError {
    /// The text has no `://`.
    #[error("not a location (expected for example tcp://10.0.0.2:7788): {0:?}")]
    NoScheme(String),
    /// No transport has this name.
    #[error("unknown transport {0:?} (known: shm, unix, tcp, udp, quic, udt, http, https)")]
    UnknownKind(String),
    /// The address is empty or too long.
    #[error("the address has {0} bytes; 1 to {max} are allowed", max = Location::MAX_ADDRESS)]
    AddressLength(usize),
    /// The address contains characters that are not allowed.
    #[error("the address contains white space, control or format characters, '#' or ';': {0:?}")]
    AddressCharacters(String),
    /// The text after `;` is not a signature.
    #[error(
        "unknown signature after ';' (known: fipa-services, jade, jade-xml, jade-bit-efficient, fipa): {0:?}"
    )]
    UnknownSignature(String),
    /// This kind of transport does not support this signature.
    #[error("the transport {1} does not support the signature {0}")]
    NotOverKind(Signature, Kind),
    /// The text after `#` is not an incarnation.
    #[error("not an incarnation after '#': {0:?}; 16 hexadecimal digits are expected")]
    Incarnation(String),
}

impl FromStr for Location {
    type Err = LocationError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let short = || text.chars().take(40).collect();
        let (kind, rest) = text
            .split_once("://")
            .ok_or_else(|| LocationError::NoScheme(short()))?;
        let kind = kind.parse()?;
        let (rest, incarnation) = match rest.split_once('#') {
            Some((rest, digits)) => {
                let parsed = digits.parse();
                (
                    rest,
                    parsed.map_err(|_| LocationError::Incarnation(short()))?,
                )
            }
            None => (rest, Incarnation::UNKNOWN),
        };
        let (address, signature) = match rest.split_once(';') {
            Some((address, signature)) => (address, Some(signature.parse()?)),
            None => (rest, None),
        };
        let location = Self::new(kind, address)?.with_incarnation(incarnation);
        match signature {
            Some(signature) => location.with_signature(signature),
            None => Ok(location),
        }
    }
}

serde_as_text!(Location);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scopes_are_replaced_and_removed() {
        let location = |text: &str| text.parse::<Location>().unwrap();
        for (text, bare, on_seven, is_link_local) in [
            (
                "tcp://[fe80::1%eth0]:7788#00abcdef01234567",
                "tcp://[fe80::1]:7788#00abcdef01234567",
                "tcp://[fe80::1%7]:7788#00abcdef01234567",
                true,
            ),
            (
                "http://[fe80::1]:7778/acc",
                "http://[fe80::1]:7778/acc",
                "http://[fe80::1%7]:7778/acc",
                true,
            ),
            (
                "udp://[fd00::1%2]:1",
                "udp://[fd00::1]:1",
                "udp://[fd00::1%7]:1",
                false,
            ),
            (
                "tcp://169.254.0.1:1",
                "tcp://169.254.0.1:1",
                "tcp://169.254.0.1:1",
                false,
            ),
            (
                "tcp://crex.local:1",
                "tcp://crex.local:1",
                "tcp://crex.local:1",
                false,
            ),
            ("tcp://[x%]y", "tcp://[x%]y", "tcp://[x%]y", false),
        ] {
            assert_eq!(location(text).without_scope().to_string(), bare);
            assert_eq!(location(text).on_interface(7).to_string(), on_seven);
            assert_eq!(location(text).is_link_local(), is_link_local, "{text}");
        }
    }

    #[test]
    fn text_round_trips() {
        for text in [
            "tcp://10.0.0.2:7788",
            "tcp://[fe80::1%eth0]:7788#00abcdef01234567",
            "shm://0000000000000001#0000000000000001",
            "unix://0000000000000001#0000000000000001",
            "tcp://10.0.0.3:6789;fipa-services",
            "tcp://[fe80::1%eth0]:6789;jade#00abcdef01234567",
            "udt://10.0.0.3:6790;fipa-services",
            "http://10.0.0.4:7778/acc",
            "http://jade.local:7778/acc#00abcdef01234567",
        ] {
            assert_eq!(text.parse::<Location>().unwrap().to_string(), text);
        }
    }

    #[test]
    fn the_signature_of_frames_may_be_omitted() {
        let plain: Location = "tcp://10.0.0.2:7788".parse().unwrap();
        assert_eq!(plain.signature(), Signature::Frames);
        assert_eq!("tcp://10.0.0.2:7788;fipa".parse(), Ok(plain.clone()));
        let old = plain.clone().with_signature(Signature::FipaServices);
        assert_ne!(old, Ok(plain));
    }

    #[test]
    fn udt_supports_only_fipa_services() {
        let udt: Location = "udt://10.0.0.3:6790".parse().unwrap();
        assert_eq!(udt.signature(), Signature::FipaServices);
        assert!(!udt.kind().is_supported());
        for refused in [Signature::Frames, Signature::JadeProxy] {
            let refused = udt.clone().with_signature(refused);
            assert!(matches!(refused, Err(LocationError::NotOverKind(..))));
        }
    }

    #[test]
    fn http_supports_only_jade() {
        let http: Location = "http://10.0.0.4:7778/acc".parse().unwrap();
        assert_eq!(http.signature(), Signature::JadeProxy);
        assert_eq!("http://10.0.0.4:7778/acc;jade".parse(), Ok(http.clone()));
        assert_eq!(http.authority(), "10.0.0.4:7778");
        for refused in [Signature::Frames, Signature::FipaServices] {
            let refused = http.clone().with_signature(refused);
            assert!(matches!(refused, Err(LocationError::NotOverKind(..))));
        }
        for signature in [Signature::JadeXml, Signature::JadeBitEfficient] {
            let encoded = http.clone().with_signature(signature).unwrap();
            assert_eq!(encoded.to_string(), format!("{http};{signature}"));
            assert_eq!(encoded.to_string().parse(), Ok(encoded.clone()));
            let tcp = Location::new(Kind::Tcp, "10.0.0.4:6789").unwrap();
            assert!(tcp.with_signature(signature).is_err());
        }
        let tcp: Location = "tcp://10.0.0.4:6789;jade".parse().unwrap();
        assert_eq!(tcp.authority(), "10.0.0.4:6789");
    }

    #[test]
    fn signature_types_of_legacy_peers_are_recognized() {
        for (text, signature) in [
            (
                "fipa::services::transports::MessageTransport",
                Signature::FipaServices,
            ),
            ("JadeProxyAgent", Signature::JadeProxy),
        ] {
            assert_eq!(Signature::of_signature_type(text), Some(signature));
            assert_eq!(signature.signature_type(), text);
        }
        assert_eq!(Signature::of_signature_type("fipa"), None);
    }

    #[test]
    fn invalid_text_is_refused() {
        for text in [
            "",
            "tcp",
            "tcp://",
            "smoke://hill",
            "tcp://a b",
            "tcp://a#1",
            "tcp://a;b",
            "tcp://a;",
            "tcp://;jade",
            "tcp://a;jade;jade",
            "tcp://a#0000000000000001;jade",
            "udp://a;jade",
            "shm://a;fipa-services",
        ] {
            assert!(text.parse::<Location>().is_err(), "{text:?}");
        }
        let long = format!("tcp://{}", "x".repeat(Location::MAX_ADDRESS + 1));
        assert_eq!(
            long.parse::<Location>(),
            Err(LocationError::AddressLength(513))
        );
    }
}
