//! Letters of legacy peers, as far as TCP and HTTP share them.
//!
//! * [`queues`]: the letters to each location, one after the other.
//! * [`dialect`]: letters in the dialect of the peer.
//! * [`envelope`]: envelopes of legacy peers in the standard dialect.

pub(crate) mod dialect;
pub(crate) mod envelope;
pub(crate) mod queues;
