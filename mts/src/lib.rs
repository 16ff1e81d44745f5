//! The message transport service: delivers letters to agents once and in order, or reports them as
//! failed.
//!
//! [`core`] makes the decisions without I/O; the runtime drives it with transports, a directory and
//! a clock. The same service runs in every robot process and, with permission to forward, as the
//! gateway between hosts.

pub mod core;
pub mod dial;
mod failure;
mod gate;
mod post;
mod runtime;
mod stamp;
pub mod watch;

/// A hash map for several lookups per letter, with a fast hash that is seeded per process. Not for
/// keys that untrusted peers choose without a close bound: timing can reveal which keys collide.
type Map<K, V> = std::collections::HashMap<K, V, foldhash::fast::RandomState>;

/// A hash set with the hash of [`Map`], for the same keys.
type Set<K> = std::collections::HashSet<K, foldhash::fast::RandomState>;

pub use failure::DeliveryFailure;
pub use gate::{AccessGate, LetterParts, LetterSource, Link};
pub use post::{LetterDraft, PostError, letter_by, letter_for};
pub use runtime::{Contacts, Gone, Mts, RuntimeConfig, Sending, Started, Tap};
pub use stamp::stamped_peer;
