//! The letters of legacy peers (fipa_services and JADE), whichever transport carries them.
//!
//! * [`letter`]: reading a letter. [`dialect`]: writing one for a peer.

pub(crate) mod dialect;
pub(crate) mod letter;
