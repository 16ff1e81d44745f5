//! What the delivery core is told once, at its start.

use std::sync::Arc;
use std::time::Duration;

use fipa_sds::Pattern;
use fipa_transport::{Incarnation, Kind};

/// The longest deadline a letter may have. Receivers remember for at least this long what they
/// took, so that nothing arrives twice.
pub const MAX_DEADLINE: Duration = fipa_transport::wire::MAX_REMAINING;

/// What the delivery core is told once, at its start.
#[derive(Debug, Clone)]
pub struct CoreConfig {
    /// The name of this message transport service. It stands in stamps and sends failure messages.
    pub name: Arc<str>,
    /// This life of it.
    pub incarnation: Incarnation,
    /// Whether letters for agents of other processes are passed on: the role of the gateway.
    pub forwards: bool,
    /// The transports in order of preference; what is not listed is not used.
    pub order: Vec<Kind>,
    /// Other orders, for receivers whose name matches; the first match counts.
    pub routes: Vec<(Pattern, Vec<Kind>)>,
    /// Letters that wait in an agent's queue before its senders are held back.
    pub queue: usize,
    /// Bytes of the letters in an agent's queue before its senders are held back. One letter is
    /// always taken.
    pub queue_bytes: usize,
    /// Letters on their way from one sender to one receiver at a time.
    pub window: usize,
    /// Letters that wait for one receiver from one sender, on their way or not, before more are
    /// held back.
    pub lane: usize,
    /// Bytes of the same. One letter is always taken.
    pub lane_bytes: usize,
    /// Bytes of letters of others that a gateway has in custody before more are held back. One
    /// letter is always taken.
    pub custody_bytes: usize,
    /// How long an attempt may go without an answer, for a small letter.
    pub attempt_timeout: Duration,
}

impl CoreConfig {
    /// A configuration with the usual limits.
    #[must_use]
    pub fn new(name: impl Into<Arc<str>>, incarnation: Incarnation, order: Vec<Kind>) -> Self {
        Self {
            name: name.into(),
            incarnation,
            forwards: false,
            order,
            routes: Vec::new(),
            queue: 256,
            queue_bytes: 64 << 20,
            window: 16,
            lane: 1024,
            lane_bytes: 64 << 20,
            custody_bytes: 256 << 20,
            attempt_timeout: Duration::from_secs(1),
        }
    }

    /// The order of transports for letters to this receiver.
    pub(crate) fn order_for(&self, receiver: &str) -> &[Kind] {
        self.route_for(receiver).1
    }

    /// The order of transports for letters to this receiver, and the pattern that says so when it
    /// is an exception.
    pub(crate) fn route_for(&self, receiver: &str) -> (Option<&Pattern>, &[Kind]) {
        let mut routes = self.routes.iter();
        match routes.find(|(pattern, _)| pattern.matches(receiver)) {
            Some((pattern, order)) => (Some(pattern), order),
            None => (None, &self.order),
        }
    }
}
