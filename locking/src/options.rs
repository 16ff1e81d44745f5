//! Times of the core.

use crate::faults::Fault;
use crate::{Algorithm, Millis};

/// Times of the core of one agent, in milliseconds, and its algorithm with agents of `distributed_locking`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Options {
    /// Lease of a grant (default 15 s). The owner counts it from its answer, the holder 0.95 of it
    /// from its request.
    pub lease: Millis,
    /// Time without a message after which a peer that this agent depends on is probed (default 5 s).
    pub probe_interval: Millis,
    /// Time without an answer to a probe after which the peer is left out (default 2 s). The probe is
    /// repeated once in this time.
    pub probe_timeout: Millis,
    /// Time after which a request without an answer is repeated (default 1 s).
    pub retry: Millis,
    /// Time in which the owner of a resource has to be found (default 2 s).
    pub discovery: Millis,
    /// Time in which an existing owner may contradict a new one (default 1 s).
    pub claim: Millis,
    /// Number of the first conversation. A restarted agent should not use its earlier numbers.
    pub first_conversation: u64,
    /// MutualExclusion with agents of `distributed_locking`, for an agent whose own is the owner's queue (default:
    /// the extended Ricart-Agrawala).
    pub legacy_algorithm: Algorithm,
    /// Whether agents of `distributed_locking` use the resources that this agent owns (default: no). Then these
    /// have the algorithm for such agents.
    pub legacy_peers: bool,
    pub(crate) fault: Fault,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            lease: 15_000,
            probe_interval: 5_000,
            probe_timeout: 2_000,
            retry: 1_000,
            discovery: 2_000,
            claim: 1_000,
            first_conversation: 0,
            legacy_algorithm: Algorithm::RicartAgrawalaExtended,
            legacy_peers: false,
            fault: Fault::NO,
        }
    }
}

/// Error of [`Options::check`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum OptionsError {
    /// A time is out of bounds.
    #[error("{name} is {value} ms; it has to be between {min} and {max} ms")]
    OutOfBounds {
        /// Name of the time.
        name: &'static str,
        /// Its value.
        value: Millis,
        /// The minimum.
        min: Millis,
        /// The maximum.
        max: Millis,
    },
}

/// Maximum of each time: one day. Larger values could overflow with the time of a peer's clock.
pub(crate) const MAX_SPAN: Millis = 24 * 3_600_000;

impl Options {
    /// Checks that each time is between 1 ms (`lease`: 20 ms) and one day.
    ///
    /// # Errors
    /// A time is out of bounds.
    pub fn check(&self) -> Result<(), OptionsError> {
        for (name, value, min) in [
            ("lease", self.lease, 20),
            ("probe_interval", self.probe_interval, 1),
            ("probe_timeout", self.probe_timeout, 1),
            ("retry", self.retry, 1),
            ("discovery", self.discovery, 1),
            ("claim", self.claim, 1),
        ] {
            if !(min..=MAX_SPAN).contains(&value) {
                let max = MAX_SPAN;
                return Err(OptionsError::OutOfBounds {
                    name,
                    value,
                    min,
                    max,
                });
            }
        }
        Ok(())
    }
}
