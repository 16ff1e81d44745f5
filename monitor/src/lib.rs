//! Interaction protocols as state machines, and a monitor that checks conversations at run time.
//!
//! * [`Machine`]: a protocol, read from an SCXML file (see [`scxml`] for the format).
//! * [`Library`]: protocols by name. [`Library::standard`] has those of FIPA.
//! * [`Monitor`]: checks the messages of any number of conversations, as an observer or for one
//!   participating agent, and returns a [`Verdict`] for each. It reads a [`Header`], without the
//!   content.
//!
//! The crate has no input or output, no clocks and no threads: the caller passes messages and the
//! current time, and gets verdicts.
//!
//! Files and messages may be hostile: every size has a bound, and [`Limits`] bounds the memory.

mod act;
mod change;
mod conversation;
mod deadlines;
mod delegated;
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
