//! Processes on three hosts that exchange letters and log all events, the injected faults, and the
//! checker of the logs.

pub(crate) mod actor;
mod breaches;
pub(crate) mod checker;
pub(crate) mod journal;
pub(crate) mod stage;
