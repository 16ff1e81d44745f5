//! Interaction protocols as state machines, and a monitor that checks conversations at run time.
//!
//! * [`Machine`]: a protocol, read from an SCXML file (see [`scxml`] for the format).
//! * [`projection`]: protocols with three or more roles, as each role sees them.
//! * [`Library`]: protocols by name. [`Library::standard`] has those of FIPA.
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

mod check;
mod clock;
mod conversation;
mod header;
mod limits;
mod monitor;
mod policy;
mod protocol;
mod snapshot;
mod verdict;

pub use clock::Moment;
pub use header::Header;
pub use limits::MonitorLimits;
pub use monitor::{Event, Monitor};
pub use policy::{History, MonitorPolicy};
pub use protocol::act::near_standard;
pub use protocol::library::{Library, LibraryError, LibraryFull};
pub use protocol::machine::{
    After, Cancel, Machine, Scope, State, Subprotocol, Timeout, Transition,
};
pub use protocol::spelling::one_edit_apart;
pub use protocol::{projection, scxml};
pub use snapshot::SnapshotError;
pub use verdict::{
    Accepted, Expected, ReplyMismatch, Unchecked, Verdict, Violation, ViolationKind,
};
