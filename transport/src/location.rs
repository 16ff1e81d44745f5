//! Where an agent can be reached, and by which transport.

use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::Incarnation;

/// A kind of transport, as it is named in the configuration and in addresses.
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
}

impl Kind {
    /// Every kind, in no particular order.
    pub const ALL: [Self; 4] = [Self::Shm, Self::Tcp, Self::Udp, Self::Quic];

    /// The name of this kind, which is also the scheme of its addresses.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Shm => "shm",
            Self::Tcp => "tcp",
            Self::Udp => "udp",
            Self::Quic => "quic",
        }
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

/// An address at which a message transport service can be reached, with the incarnation of the
/// service that listened there.
///
/// Written `kind://address` or `kind://address#incarnation`, for example
/// `tcp://10.0.0.2:7788#00abcdef01234567`. What `address` means is up to the transport. A
/// transport that connects to a location with a known incarnation and finds another one there
/// reports that nobody was reached: ports are reused.
///
/// Cheap to clone.
#[derive(Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Location {
    kind: Kind,
    address: Arc<str>,
    incarnation: Incarnation,
}

impl Location {
    /// Longest address accepted, in bytes.
    pub const MAX_ADDRESS: usize = 512;

    /// A location of a service whose incarnation is not known.
    ///
    /// # Errors
    /// When the address is empty, too long, or has characters that an address cannot have
    /// (white space, control characters, `#`, `;`).
    pub fn new(kind: Kind, address: &str) -> Result<Self, LocationError> {
        if address.is_empty() || address.len() > Self::MAX_ADDRESS {
            return Err(LocationError::AddressLength(address.len()));
        }
        if address
            .chars()
            .any(|c| c.is_whitespace() || c.is_control() || matches!(c, '#' | ';'))
        {
            return Err(LocationError::AddressCharacters(
                address.escape_default().collect(),
            ));
        }
        Ok(Self {
            kind,
            address: address.into(),
            incarnation: Incarnation::UNKNOWN,
        })
    }

    /// The same location, of the service with this incarnation.
    #[must_use]
    pub fn with_incarnation(mut self, incarnation: Incarnation) -> Self {
        self.incarnation = incarnation;
        self
    }

    /// The transport that can reach it.
    #[must_use]
    pub fn kind(&self) -> Kind {
        self.kind
    }

    /// The transport's own part of the address.
    #[must_use]
    pub fn address(&self) -> &str {
        &self.address
    }

    /// The incarnation of the message transport service at this location, which may be unknown.
    #[must_use]
    pub fn incarnation(&self) -> Incarnation {
        self.incarnation
    }
}

impl fmt::Display for Location {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}://{}", self.kind, self.address)?;
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
    /// There is no `://`.
    #[error("not a location (expected for example tcp://10.0.0.2:7788): {0:?}")]
    NoScheme(String),
    /// No transport has this name.
    #[error("unknown transport {0:?} (known: shm, tcp, udp, quic)")]
    UnknownKind(String),
    /// The address is empty or too long.
    #[error("address of {0} bytes (1 to {max} allowed)", max = Location::MAX_ADDRESS)]
    AddressLength(usize),
    /// The address has characters that no address has.
    #[error("address with white space, control characters, '#' or ';': {0:?}")]
    AddressCharacters(String),
    /// What stands behind `#` is not an incarnation.
    #[error("not an incarnation behind '#' (16 hexadecimal digits expected): {0:?}")]
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
        let (address, incarnation) = match rest.split_once('#') {
            Some((address, digits)) => {
                let parsed = digits.parse();
                (
                    address,
                    parsed.map_err(|_| LocationError::Incarnation(short()))?,
                )
            }
            None => (rest, Incarnation::UNKNOWN),
        };
        Ok(Self::new(kind, address)?.with_incarnation(incarnation))
    }
}

impl Serialize for Location {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for Location {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        String::deserialize(deserializer)?
            .parse()
            .map_err(serde::de::Error::custom)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_round_trips() {
        for text in [
            "tcp://10.0.0.2:7788",
            "tcp://[fe80::1%eth0]:7788#00abcdef01234567",
            "shm://0000000000000001#0000000000000001",
        ] {
            assert_eq!(text.parse::<Location>().unwrap().to_string(), text);
        }
    }

    #[test]
    fn nonsense_is_refused() {
        for text in [
            "",
            "tcp",
            "tcp://",
            "smoke://hill",
            "tcp://a b",
            "tcp://a#1",
            "tcp://a;b",
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
