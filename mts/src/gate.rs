//! The access gate: decides which letters are accepted.

use std::net::IpAddr;
use std::time::Instant;

use fipa_acl::Letter;
use fipa_transport::{Hop, Incarnation, Kind, Location, Principal, quota_address};

/// The link on which a letter arrived.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Link {
    /// The kind of transport.
    pub via: Kind,
    /// The service at its other end, as it introduced itself on this link; unknown for a legacy
    /// peer. Only on a [host-local](Kind::is_host_local) link is that a process of this domain and host.
    pub service: Incarnation,
    /// The user of the process at its other end. `None` if that is the user of this process, or the process is on
    /// another host.
    pub user: Option<u32>,
    /// The party that sent the letter, as far as the link proves it.
    pub source: LetterSource,
}

/// The party at the other end of a link, as far as the link proves it. Quotas count letters by
/// source, and ignore the names in the letters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum LetterSource {
    /// The service with this incarnation in a process of this domain on this host.
    Process(Incarnation),
    /// The services with the key of the certificate with this SHA-256 fingerprint.
    Certificate([u8; 32]),
    /// The services at this address, without further proof: for IPv6 the /64 network, for loopback
    /// 127.0.0.1. `None` if the link has no such address.
    Address(Option<IpAddr>),
}

impl LetterSource {
    /// Returns the source of letters from this service.
    #[must_use]
    pub fn of(hop: &Hop) -> Self {
        match hop.principal {
            Principal::Host | Principal::User(_) => Self::Process(hop.location.incarnation()),
            Principal::Certificate(fingerprint) => Self::Certificate(fingerprint),
            Principal::Unproved => Self::unproved(&hop.location),
        }
    }

    /// Returns the source of unproved services at this location.
    pub(crate) fn unproved(location: &Location) -> Self {
        Self::Address(location.quota_address())
    }

    /// Returns the source of unproved letters from this address.
    #[must_use]
    pub fn at(address: IpAddr) -> Self {
        Self::Address(Some(quota_address(address)))
    }
}

/// The parts of a letter that an [`AccessGate`] decides about.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct LetterParts {
    /// The sender in the envelope; empty if there is none.
    pub sender: String,
    /// The name of the performative.
    pub performative: String,
    /// The protocol.
    pub protocol: Option<String>,
    /// The ontology.
    pub ontology: Option<String>,
    /// The action of a goal for a robot.
    pub action: Option<String>,
    /// Whether a gateway has stamped the letter.
    pub is_stamped: bool,
    /// The reason why no rule can admit the letter.
    pub fault: Option<String>,
}

/// Decides which letters are accepted, for an agent of this service or into a gateway's custody.
pub trait AccessGate: Send + Sync {
    /// Whether the gate decides at present. While it does not, letters are neither read for it nor judged. Becomes true
    /// only while no letter is handled; see [`Mts::reorder`](crate::Mts::reorder).
    fn is_active(&self) -> bool {
        true
    }

    /// Reads the parts of a letter that the decision depends on. That takes time in proportion to
    /// the bytes of the letter, so the runtime calls it before it locks the core, and once for all
    /// receivers of the letter.
    fn read(&self, letter: &Letter) -> LetterParts;

    /// Decides whether a letter for this receiver that arrived on this link is accepted. Called
    /// once per letter and receiver when there is space for it: not for copies of an accepted
    /// letter, and not for one that must wait. Must not block or call the service back.
    ///
    /// # Errors
    /// Returns the reason of the refusal, which the sender is told.
    fn admits(
        &self,
        now: Instant,
        receiver: &str,
        letter: &LetterParts,
        link: Link,
    ) -> Result<(), String>;
}

#[cfg(test)]
mod tests {
    use super::*;

    fn source(location: &str, principal: Principal) -> LetterSource {
        let location: Location = location.parse().unwrap();
        let location = location.with_incarnation(Incarnation::from_u64(7));
        LetterSource::of(&Hop {
            location,
            principal,
        })
    }

    #[test]
    fn a_source_is_what_the_link_proves() {
        let unproved = |location| source(location, Principal::Unproved);
        let at = |ip: &str| LetterSource::at(ip.parse().unwrap());
        assert_eq!(unproved("tcp://192.0.2.1:7"), at("192.0.2.1"));
        assert_eq!(unproved("udp://192.0.2.1:8"), at("192.0.2.1"));
        // A host has many addresses in one network.
        assert_eq!(unproved("tcp://[2001:db8::1]:7"), at("2001:db8::ffff"));
        assert_ne!(unproved("tcp://[fe80::1]:7"), at("fe80::2"));
        assert_eq!(unproved("tcp://127.0.0.9:7"), at("::1"));
        let key = Principal::Certificate([1; 32]);
        assert_eq!(
            source("tcp://192.0.2.1:7", key),
            source("quic://192.0.2.9:7", key)
        );
        let process = source("shm://here", Principal::Host);
        assert_eq!(process, LetterSource::Process(Incarnation::from_u64(7)));
    }
}
