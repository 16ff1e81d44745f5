//! Processes on three hosts that exchange letters and log everything, the faults that they meet, and
//! the checker of their logs.

pub(crate) mod actor;
mod breaches;
pub(crate) mod checker;
pub(crate) mod journal;
pub(crate) mod stage;
