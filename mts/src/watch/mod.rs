//! Watching: what processes tell of the letters that pass them, and how that becomes one event per
//! letter.
//!
//! * [`record`] is what a process writes about a letter: a fixed header and a few encoded parts.
//!   Whoever watches may be told anything, so every byte is checked.
//! * [`Joiner`] makes events of the records of all processes: a letter that its sender, a gateway
//!   and its receiver tell of is one letter.
//!
//! No input, no output, no clock: the socket between the two is the business of the crate `fipa`.

mod joiner;
pub mod record;

pub use joiner::{Event, Fate, Joiner, Passage, Source};
pub use record::{Record, RecordError};
