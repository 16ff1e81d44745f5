//! Letters between the processes of one host, through shared memory.
//!
//! Every process has one mailbox: an iceoryx2 request-response service of which it is the only
//! server. A parcel is one request, whose memory the receiver reads in place; the answer is the
//! response. Agents inside a process are told apart by the name in the parcel.
//!
//! * [`ShmTransport`] is the transport, [`ShmConfig`] what it needs to know.
//! * [`cleanup_dead`] removes what killed processes left behind; every process does so by itself,
//!   and tools may. [`inspect`] only looks.
//! * [`ShmCounters`] says what happened: what was copied, and why.
//!
//! Inside: `layout` is what lies in shared memory, `inbox` the receiving and `outbox` the sending
//! side of mailboxes, `loan` memory handed out before it is sent, `segment` content that lies in
//! memory once for many receivers (`pool` where it is sent, `library` where it is read),
//! `presence` how processes wake each other and notice each other's end, `memory` where room comes
//! from, `storage` the files of iceoryx2 with their pages allocated, `variant` the iceoryx2 service
//! that uses them, `domain` the traces in the file system, `peers` the other processes known,
//! `shift` who of several threads works, `fault` what the sender is told when a way fails,
//! `fork` how a forked child is recognized, `endpoint` what ties all together. `raw` (feature `raw`) is the bare iceoryx2 that benches
//! compare with.
//!
//! What must not live here: routes, retries, names of agents, deduplication. And no `unsafe` that
//! does not say why it is sound; no other crate of this project has any.
//!
//! # Trust
//! Processes of one domain run as one user, who could do anything to any of them. Even so nothing
//! that another process can still change is parsed: headers, names and envelopes are copied into
//! private memory first. Only content is read in place; whoever uses it should not assume that
//! two reads give the same bytes unless the sender is honest.

mod config;
mod counters;
mod domain;
mod endpoint;
mod fault;
mod fork;
#[cfg(feature = "fuzzing")]
#[doc(hidden)]
pub mod fuzzing;
mod inbox;
mod inspect;
mod layout;
mod library;
mod loan;
mod memory;
mod outbox;
mod peers;
mod pool;
mod presence;
#[cfg(feature = "raw")]
pub mod raw;
mod segment;
mod shift;
mod storage;
mod transport;
mod variant;

pub use config::{ShmConfig, ShmError};
pub use counters::ShmCounters;
pub use domain::{Cleaned, cleanup_dead};
pub use fork::Owner;
pub use inspect::{Inspection, inspect};
pub use transport::ShmTransport;
