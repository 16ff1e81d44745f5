//! The transports that serve legacy peers (fipa_services and JADE) alone, and what they share with the TCP port, which
//! reads unframed letters itself.
//!
//! * `http`, `udt`: the transports.
//! * [`letter`]: reading a letter. [`envelope`]: its envelope in the standard dialect.
//! * [`dialect`]: writing a letter in the dialect of the peer.
//! * [`queues`]: the letters to each location, one after the other.

pub(crate) mod dialect;
pub(crate) mod envelope;
#[cfg(feature = "http")]
pub(crate) mod http;
pub(crate) mod letter;
pub(crate) mod queues;
#[cfg(feature = "udt")]
pub(crate) mod udt;
