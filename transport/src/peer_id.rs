//! The party that has one share of a bound.

use std::fmt;
use std::net::IpAddr;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::{Location, Principal};

/// The party that has one share of a bound, however many gateways, connections and agents it has: the processes of
/// this host together, the holder of a key, or the host at an address.
///
/// As text it is empty, the fingerprint of a certificate, or an address without port and scope.
#[derive(Debug, Clone, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct PeerId(Option<Arc<str>>);

impl PeerId {
    /// Maximum length of the text, in bytes.
    pub const MAX_LEN: usize = 255;

    /// The processes of this host.
    pub const THIS_HOST: Self = Self(None);

    /// Returns the peer whose link proves this identity, and that is reached at the first of these locations.
    #[must_use]
    pub fn of(principal: Principal, locations: &[Location]) -> Self {
        match principal {
            Principal::Host => Self::THIS_HOST,
            Principal::Certificate(fingerprint) => Self(Some(hex(&fingerprint).into())),
            Principal::Unproved => Self::at(locations.first().map_or("", Location::authority)),
        }
    }

    /// Returns the peer with this IP address.
    #[must_use]
    pub fn of_ip(ip: IpAddr) -> Self {
        Self(Some(ip.to_canonical().to_string().into()))
    }

    /// Returns the peer that is reached at this host and port, without proof of its identity.
    fn at(authority: &str) -> Self {
        let host = authority
            .rsplit_once(':')
            .map_or(authority, |(host, _)| host);
        let host = host.trim_matches(['[', ']']);
        let host = host.split_once('%').map_or(host, |(host, _)| host);
        match host.parse() {
            Ok(ip) => Self::of_ip(ip),
            Err(_) if host.is_empty() || host.len() > Self::MAX_LEN => Self(Some("unknown".into())),
            Err(_) => Self(Some(host.into())),
        }
    }

    /// Returns the peer with this text, as another process of this host wrote it; `None` if it is too long.
    #[must_use]
    pub fn from_text(text: &str) -> Option<Self> {
        match text {
            "" => Some(Self::THIS_HOST),
            text => (text.len() <= Self::MAX_LEN).then(|| Self(Some(text.into()))),
        }
    }

    /// Returns the text.
    #[must_use]
    pub fn as_str(&self) -> &str {
        self.0.as_deref().unwrap_or_default()
    }

    /// Whether these are the processes of this host.
    #[must_use]
    pub fn is_this_host(&self) -> bool {
        self.0.is_none()
    }
}

fn hex(bytes: &[u8]) -> String {
    use fmt::Write as _;
    let mut text = String::with_capacity(2 * bytes.len());
    for byte in bytes {
        // Writing to a string cannot fail.
        let _ = write!(text, "{byte:02x}");
    }
    text
}

impl fmt::Display for PeerId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.0 {
            Some(text) => f.pad(text),
            None => f.pad("this host"),
        }
    }
}

impl Serialize for PeerId {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.as_str())
    }
}

impl<'de> Deserialize<'de> for PeerId {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = std::borrow::Cow::<'_, str>::deserialize(deserializer)?;
        Self::from_text(&text)
            .ok_or_else(|| serde::de::Error::custom("the name of a peer is too long"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(principal: Principal, text: &str) -> PeerId {
        PeerId::of(principal, &[text.parse().unwrap()])
    }

    #[test]
    fn a_host_is_one_peer_at_all_its_ports() {
        let at = |text: &str| of(Principal::Unproved, text);
        let one = at("tcp://192.0.2.1:7788#0000000000000001");
        assert_eq!(one, at("udp://192.0.2.1:9#0000000000000002"));
        assert_eq!(one, PeerId::of_ip("::ffff:192.0.2.1".parse().unwrap()));
        assert_ne!(one, at("tcp://192.0.2.2:7788#0000000000000001"));
        assert_eq!(at("tcp://[fe80::1%eth0]:1"), at("tcp://[fe80::1]:2"));
        assert_ne!(at("tcp://[fd00::1]:1"), at("tcp://[fd00::2]:1"));
        assert_eq!(at("tcp://arm.local:1"), at("tcp://arm.local:2"));
        assert!(!PeerId::of(Principal::Unproved, &[]).is_this_host());
    }

    #[test]
    fn a_certificate_is_one_peer_at_all_addresses() {
        let key = Principal::Certificate([7; 32]);
        let certified = of(key, "tcp://192.0.2.1:7788");
        assert_eq!(certified, of(key, "quic://192.0.2.9:1"));
        assert_ne!(certified, of(Principal::Unproved, "tcp://192.0.2.1:7788"));
    }

    #[test]
    fn a_peer_is_read_as_it_was_written() {
        for peer in [
            PeerId::THIS_HOST,
            of(Principal::Certificate([7; 32]), "tcp://192.0.2.1:7788"),
            of(Principal::Unproved, "tcp://[fe80::1%eth0]:1"),
        ] {
            assert_eq!(PeerId::from_text(peer.as_str()), Some(peer));
        }
        assert_eq!(PeerId::from_text(&"x".repeat(PeerId::MAX_LEN + 1)), None);
    }
}
