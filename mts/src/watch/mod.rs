//! Watching: the records that processes write about passing letters, and the events built from
//! them.
//!
//! * [`record`] defines the record of a letter: a fixed header and a few encoded parts. A watcher
//!   must not trust its sources, so every byte is checked.
//!
//! * [`Joiner`] builds events from the records of all processes: a letter that its sender, a
//!   gateway and its receiver report is one letter.
//!
//! No I/O and no clock: the crate `fipa` has the socket between the two.

mod envelope;
mod joiner;
pub mod record;

pub use envelope::SeenEnvelope;
pub use joiner::{Event, Fate, Joiner, Passage, RecordSource};
pub use record::{Record, RecordError};
