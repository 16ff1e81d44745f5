//! The protocols that few programs lead, beside those of [`Agent`].

use std::fmt;
use std::sync::Arc;

use crate::agent::{Agent, AgentCore};

/// Protocols that few programs lead, and what the monitor knows about an agent's conversations; see
/// [`Agent::protocols`].
#[derive(Clone, Copy)]
pub struct Protocols<'a> {
    pub(super) core: &'a Arc<AgentCore>,
}

impl fmt::Debug for Protocols<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Protocols")
            .field("agent", &self.core.endpoint.name)
            .finish_non_exhaustive()
    }
}

impl Agent {
    /// Returns the calls of the protocols that few programs lead: auctions, the iterated contract net, brokering,
    /// recruiting, proposals and conditional requests; and the calls that tell the monitor about conversations that
    /// began elsewhere or earlier.
    #[must_use]
    pub fn protocols(&self) -> Protocols<'_> {
        Protocols { core: &self.core }
    }
}
