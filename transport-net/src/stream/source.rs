//! The origin of a connection, as far as the operating system vouches for it.

use std::fmt;
#[cfg(feature = "ip")]
use std::net::{IpAddr, SocketAddr};

use fipa_transport::Principal;
#[cfg(feature = "ip")]
use fipa_transport::quota_address;

/// The party to which connection slots and memory of an accepted connection are charged.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(crate) enum QuotaKey {
    /// The peers at one [whole](Home::whole) origin that have proved nothing.
    Unproved(Home),
    /// The peers with the key of the certificate with this fingerprint, at any address.
    Certificate([u8; 32]),
}

impl QuotaKey {
    /// Returns the quota key of a connection with this origin whose peer has proved `proved`, if
    /// anything.
    pub(crate) fn of(from: Source, proved: Option<&Principal>) -> Self {
        match proved {
            Some(Principal::Certificate(fingerprint)) => Self::Certificate(*fingerprint),
            _ => Self::Unproved(from.home().whole()),
        }
    }
}

/// The other end of a connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Source {
    /// A process of this host and domain (Unix domain socket).
    Process {
        /// Its process number; 0 if it is in another PID namespace.
        number: i32,
        /// Its user, unless that is the user of this process.
        other_user: Option<u32>,
    },
    /// An address (TCP and QUIC).
    #[cfg(feature = "ip")]
    Address(SocketAddr),
}

/// The part of an origin that all connections of one peer share.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) enum Home {
    /// The process of this host.
    Process(i32),
    /// The address without the port.
    #[cfg(feature = "ip")]
    Address(IpAddr),
}

impl Source {
    pub(crate) fn home(self) -> Home {
        match self {
            Self::Process { number, .. } => Home::Process(number),
            #[cfg(feature = "ip")]
            Self::Address(address) => Home::Address(address.ip()),
        }
    }
}

impl Home {
    /// Returns the origin that all addresses of one peer share; see [`quota_address`].
    pub(crate) fn whole(self) -> Self {
        match self {
            Self::Process(_) => self,
            #[cfg(feature = "ip")]
            Self::Address(ip) => Self::Address(quota_address(ip)),
        }
    }
}

impl fmt::Display for Source {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Process { number, .. } => write!(f, "process {number}"),
            #[cfg(feature = "ip")]
            Self::Address(address) => address.fmt(f),
        }
    }
}
