//! Letters between hosts.
//!
//! [`TcpTransport`] carries parcels in frames over one persistent connection per peer, and takes
//! the unframed letters of old peers on the same port. Each kind of transport has a module tree
//! of its own; they share nothing but [`Identity`].
//!
//! What must not live here: routes, retries, order across transports, directories. A transport
//! tries once and reports.

mod identity;
mod tcp;

pub use identity::Identity;
pub use tcp::{Counters, Limits, TcpConfig, TcpTransport};
