//! The key of a reader of an agent's messages.

use std::sync::Arc;

/// A conversation that a call leads, or a server.
#[derive(Debug, Clone)]
pub(crate) struct ReaderKey {
    pub(super) id: Arc<str>,
    pub(super) number: u64,
}
