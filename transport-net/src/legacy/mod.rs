//! The letters of legacy peers (fipa_services and JADE), as far as their transports share them.
//!
//! * [`letter`]: reading a letter. [`envelope`]: its envelope in the standard dialect.
//! * [`dialect`]: writing a letter in the dialect of the peer.
//! * [`queues`]: the letters to each location, one after the other.

pub(crate) mod dialect;
pub(crate) mod envelope;
pub(crate) mod letter;
pub(crate) mod queues;
