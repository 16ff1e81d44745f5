//! Configuration of an HTTP endpoint.

use crate::Identity;
use crate::stream::config::NetLimits;

/// Configuration of an [`HttpTransport`](crate::HttpTransport).
#[derive(Debug, Clone)]
pub struct HttpConfig {
    /// Numeric addresses to listen on, for example `127.0.0.1:7778`. Port 0 lets the system choose.
    /// May be empty: letters can still be sent, and are not answered.
    pub listen: Vec<String>,
    /// Identity of this endpoint.
    pub identity: Identity,
    /// NetLimits and timeouts.
    pub limits: NetLimits,
    /// Credentials and trust. With them, letters are exchanged only with peers that are excepted
    /// from the proof of identity.
    #[cfg(feature = "secure")]
    pub security: Option<crate::secure::Security>,
}
