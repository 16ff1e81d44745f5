//! The party that has one share of a bound.

use std::fmt;
use std::net::IpAddr;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::{Location, Principal, quota_address};

/// The party that has one share of a bound, however many gateways, connections and agents it has: the processes of
/// this host together, the holder of a key, or the host at an address.
///
/// As text it is empty, the fingerprint of a certificate, an [address](quota_address) without port, or the name of a
/// host.
#[derive(Debug, Clone, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct PeerId(Option<Arc<str>>);

impl PeerId {
    /// Maximum length of the text, in bytes.
    pub const MAX_LEN: usize = 64;

    /// The processes of this host.
    pub const THIS_HOST: Self = Self(None);

    /// Returns the peer whose link proves this identity, and that is reached at this location.
    #[must_use]
    pub fn of(principal: Principal, location: Option<&Location>) -> Self {
        match principal {
            Principal::Host | Principal::User(_) => Self::THIS_HOST,
            Principal::Certificate(fingerprint) => Self(Some(hex(&fingerprint).into())),
            Principal::Unproved => location.map_or_else(Self::unknown, Self::at),
        }
    }

    /// Returns the peer with this IP address; see [`quota_address`].
    #[must_use]
    pub fn of_ip(ip: IpAddr) -> Self {
        Self(Some(quota_address(ip).to_string().into()))
    }

    /// Returns the peer that is reached at this location, without proof of its identity.
    fn at(location: &Location) -> Self {
        match (location.quota_address(), location.host()) {
            (Some(ip), _) => Self(Some(ip.to_string().into())),
            (None, host) if host.is_empty() || host.len() > Self::MAX_LEN => Self::unknown(),
            (None, host) => Self(Some(host.into())),
        }
    }

    /// Returns all peers without a known address together.
    #[must_use]
    pub fn unknown() -> Self {
        Self(Some("unknown".into()))
    }

    /// Returns the peer with this text, as another process of this host wrote it; `None` if it is too long.
    #[must_use]
    pub fn from_text(text: &str) -> Option<Self> {
        match text {
            "" => Some(Self::THIS_HOST),
            text => (text.len() <= Self::MAX_LEN).then(|| Self(Some(text.into()))),
        }
    }

    /// Whether the two cannot be one peer, because both are proved: each is the processes of this host or the holder
    /// of a certificate.
    #[must_use]
    pub fn is_proved_other_than(&self, other: &Self) -> bool {
        self.is_proved() && other.is_proved() && self != other
    }

    fn is_proved(&self) -> bool {
        let fingerprint = |text: &str| {
            text.len() == 2 * FINGERPRINT && text.bytes().all(|it| it.is_ascii_hexdigit())
        };
        self.0.as_deref().is_none_or(fingerprint)
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

/// Length of the fingerprint of a certificate, in bytes.
const FINGERPRINT: usize = 32;

fn hex(bytes: &[u8; FINGERPRINT]) -> String {
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
        PeerId::of(principal, Some(&text.parse().unwrap()))
    }

    #[test]
    fn a_host_is_one_peer_at_all_its_ports() {
        let at = |text: &str| of(Principal::Unproved, text);
        let one = at("tcp://192.0.2.1:7788#0000000000000001");
        assert_eq!(one, at("udp://192.0.2.1:9#0000000000000002"));
        assert_eq!(one, PeerId::of_ip("::ffff:192.0.2.1".parse().unwrap()));
        assert_ne!(one, at("tcp://192.0.2.2:7788#0000000000000001"));
        assert_eq!(at("tcp://[fe80::1%2]:1"), at("tcp://[fe80::1%2]:2"));
        assert_ne!(at("tcp://[fe80::1%2]:1"), at("tcp://[fe80::1%3]:1"));
        assert_ne!(at("tcp://[fe80::1%2]:1"), at("tcp://[fe80::2%2]:1"));
        assert_eq!(at("tcp://arm.local:1"), at("tcp://arm.local:2"));
        assert!(!PeerId::of(Principal::Unproved, None).is_this_host());
    }

    #[test]
    fn two_proved_peers_are_never_one() {
        let certified = |number| PeerId::of(Principal::Certificate([number; 32]), None);
        let unproved = PeerId::of_ip([192, 0, 2, 1].into());
        assert!(certified(1).is_proved_other_than(&certified(2)));
        assert!(certified(1).is_proved_other_than(&PeerId::THIS_HOST));
        assert!(!certified(1).is_proved_other_than(&certified(1)));
        for other in [certified(1), PeerId::THIS_HOST, PeerId::unknown()] {
            assert!(!unproved.is_proved_other_than(&other));
            assert!(!other.is_proved_other_than(&unproved));
        }
    }

    #[test]
    fn an_ipv6_network_is_one_peer() {
        let at = |text: &str| of(Principal::Unproved, text);
        let one = at("tcp://[2001:db8::1]:7788");
        assert_eq!(one, at("quic://[2001:db8::ffff:2]:9"));
        assert_eq!(one, at("http://[2001:db8::3]:9/acc"));
        assert_ne!(one, at("tcp://[2001:db8:0:1::1]:7788"));
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
