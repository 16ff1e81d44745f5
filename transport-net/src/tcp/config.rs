//! Configuration of a TCP endpoint.

use crate::Identity;
use crate::refusals::Refusals;
use crate::refused_dials::RefusedDials;
use crate::stream::config::NetLimits;

/// Configuration of a [`TcpTransport`](crate::TcpTransport).
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct TcpConfig {
    /// Numeric addresses to listen on, for example `127.0.0.1:0`, `[::1]:7788`, `0.0.0.0:7788` or
    /// `[fe80::1%eth0]:7788`. `*:7788` means all addresses of this host, `0.0.0.0` and `[::]`
    /// those of one family. Port 0 lets the system choose. May be empty: letters can still be sent, and peers can answer over the
    /// connections that this side opens.
    pub listen: Vec<String>,
    /// Identity of this endpoint.
    pub identity: Identity,
    /// NetLimits and timeouts.
    pub limits: NetLimits,
    /// Whether processes of this host connect over loopback. If not, a peer at a loopback address
    /// is unproved, even if it claims this host and domain, and must also prove its identity when
    /// `security` is set.
    pub processes: bool,
    /// Receives the connections that are refused because of keys or of another version of the protocol.
    pub refusals: Refusals,
    /// Receives the connections of this side that peers refuse.
    pub refused_dials: RefusedDials,
    /// Credentials and trust. Without them, peers need not prove their identity.
    #[cfg(feature = "secure")]
    pub security: Option<crate::secure::Security>,
}

impl TcpConfig {
    /// Returns the configuration with default limits, for the gateway of a host: no process of this
    /// host connects over loopback, and peers need not prove their identity.
    #[must_use]
    pub fn new(listen: Vec<String>, identity: Identity) -> Self {
        Self {
            listen,
            identity,
            limits: NetLimits::default(),
            processes: false,
            refusals: Refusals::default(),
            refused_dials: RefusedDials::default(),
            #[cfg(feature = "secure")]
            security: None,
        }
    }
}
