//! What the owner of an endpoint chooses.

use crate::Identity;
use crate::stream::config::Limits;

/// Configuration of a [`TcpTransport`](crate::TcpTransport).
#[derive(Debug, Clone)]
pub struct TcpConfig {
    /// Numeric addresses to listen on, for example `127.0.0.1:0`, `[::1]:7788`, `0.0.0.0:7788` or
    /// `[fe80::1%eth0]:7788`. Port 0 lets the system choose. `[::]` is IPv6 only: list `0.0.0.0`
    /// beside it for both. May be empty: then letters can be sent, and peers can answer over the
    /// connections made for that.
    pub listen: Vec<String>,
    /// How this endpoint introduces itself.
    pub identity: Identity,
    /// What it takes and how long it waits.
    pub limits: Limits,
    /// Whether processes of this host connect over loopback. Without it a peer that connects from a
    /// loopback address is a stranger, whatever host and domain it says to be of, and with `security`
    /// it has to prove itself, too.
    pub processes: bool,
    /// What peers have to prove. Without it nobody has to prove anything.
    #[cfg(feature = "secure")]
    pub security: Option<crate::secure::Security>,
}
