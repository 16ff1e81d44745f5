//! The message transport service: how letters get to agents, once, in order, or back as failed.
//!
//! [`core`] decides, without input and output; the runtime drives it with transports, a directory
//! and a clock. The same service runs in every robot process and, with leave to forward, as the
//! gateway between hosts.

pub mod core;
mod failure;
mod gate;
mod post;
mod runtime;
mod stamp;
pub mod watch;

/// A table that is looked into several times for every letter, by a quick hash that is seeded in
/// every process. Not for what strangers fill without a closer bound: it does not stand up to
/// somebody who finds out, by how long things take, which keys collide.
type Map<K, V> = std::collections::HashMap<K, V, foldhash::fast::RandomState>;

pub use failure::DeliveryFailure;
pub use gate::{Gate, Link, Source};
pub use post::{PostError, letter_around, letter_for};
pub use runtime::{Contacts, Mts, RuntimeConfig, Sending, Started, Tap};
