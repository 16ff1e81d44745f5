//! Interaction protocols as state machines, and a monitor that checks conversations at run time.
//!
//! * [`Machine`]: a protocol, read from an SCXML file (see [`scxml`] for the format).
//! * [`projection`]: protocols with three or more roles, as each role sees them.
//! * [`Library`]: protocols by name. [`Library::standard`] has those of FIPA.
//! * [`recording`]: letters in a file, to be checked later.
//! * [`Monitor`]: checks the messages of any number of conversations, as an observer or for one
//!   participating agent, and returns a [`Verdict`] for each. It reads a [`Header`], without the
//!   content.
//!
//! The crate has no input or output, no clocks and no threads: the caller passes messages and the
//! current time ([`Moment`]), and gets verdicts.
//!
//! A message that continues a conversation of which the monitor does not know the beginning is
//! *unchecked*, and no violation. [`History`] tells the monitor how much it knows, and [`MonitorPolicy`]
//! refuses messages that no conversation shows to be wrong.
//!
//! Files and messages may be hostile: every size has a bound, and [`MonitorLimits`] bounds the memory.

mod act;
mod change;
mod clock;
mod conversation;
mod deadlines;
mod delegated;
mod fingerprints;
mod header;
mod index;
mod judge;
mod library;
mod limits;
mod machine;
mod memory;
mod monitor;
mod names;
mod parties;
mod policy;
pub mod projection;
pub mod recording;
mod report;
mod roles;
pub mod scxml;
mod snapshot;
mod table;
mod verdict;

pub use act::near_standard;
pub use clock::Moment;
pub use header::Header;
pub use library::{Library, LibraryError, LibraryFull};
pub use limits::MonitorLimits;
pub use machine::{After, Cancel, Machine, Scope, State, Subprotocol, Timeout, Transition};
pub use monitor::{Event, Monitor};
pub use policy::{History, MonitorPolicy, one_edit_apart};
pub use snapshot::SnapshotError;
pub use verdict::{
    Accepted, Expected, ReplyMismatch, Unchecked, Verdict, Violation, ViolationKind,
};
