//! Interaction protocols as state machines, and conversations that are checked while they run.
//!
//! * [`Machine`] is a protocol, read from SCXML ([`scxml`] has the form); [`Library`] is those that
//!   are known by name, [`Library::standard`] all of FIPA's.
//! * [`Monitor`] takes the messages of any number of conversations, as an observer or as an agent
//!   that takes part, and gives a [`Verdict`] for each. It reads a [`Header`]: no content is needed.
//!
//! What must not live here: input and output, clocks, threads. Messages and the time go in,
//! verdicts come out; whoever sends letters or watches them is elsewhere.
//!
//! Files and messages are hostile until checked: every size has a bound, and what is remembered is
//! limited by [`Limits`].

mod act;
mod change;
mod conversation;
mod deadlines;
mod elsewhere;
mod header;
mod judge;
mod library;
mod limits;
mod machine;
mod monitor;
mod names;
mod report;
pub mod scxml;
mod table;
mod verdict;

pub use header::Header;
pub use library::{Library, LibraryError, LibraryFull};
pub use limits::Limits;
pub use machine::{After, Cancel, Machine, Scope, State, Subprotocol, Timeout, Transition};
pub use monitor::{Event, Monitor};
pub use verdict::{Accepted, Expected, Unchecked, Verdict, Violation, ViolationKind};
