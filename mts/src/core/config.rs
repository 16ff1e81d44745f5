//! Configuration of the delivery core.

use std::sync::Arc;
use std::time::Duration;

use fipa_sds::{Pattern, Reach};
use fipa_transport::{Incarnation, Kind, Location, Signature};

use crate::dial::Network;

/// Maximum deadline of a letter. Receivers remember taken letters for at least this long, so that
/// none is delivered twice.
pub const MAX_DEADLINE: Duration = fipa_transport::wire::MAX_REMAINING;

/// The order of transports for letters to particular receivers.
#[derive(Debug, Clone)]
pub struct RouteException {
    /// The names of the receivers.
    pub receivers: Pattern,
    /// Transports in order of preference; others are not used.
    pub order: Vec<Kind>,
    /// Whether letters to receivers on other hosts take the order of [`CoreConfig::order`]. In a robot process such a
    /// letter goes to the gateway first, which has an order of its own.
    pub only_on_this_host: bool,
}

/// Configuration of the delivery core.
#[derive(Debug, Clone)]
pub struct CoreConfig {
    /// Name of this message transport service, used in stamps and as the sender of failure
    /// messages.
    pub name: Arc<str>,
    /// Incarnation of this service.
    pub incarnation: Incarnation,
    /// Whether letters for agents of other processes are forwarded, which is the role of the
    /// gateway.
    pub forwards: bool,
    /// Transports in order of preference; others are not used.
    pub order: Vec<Kind>,
    /// Other orders for receivers whose name matches; the first match counts.
    pub routes: Vec<RouteException>,
    /// Number of letters in an agent's queue at which its senders are held back.
    pub queue: usize,
    /// Bytes of letters in an agent's queue at which its senders are held back. An empty queue
    /// accepts a letter of any size.
    pub queue_bytes: usize,
    /// Maximum number of letters from one sender to one receiver in transit at a time.
    pub window: usize,
    /// Number of open letters from one sender to one receiver, in transit or waiting, at which more
    /// are held back.
    pub lane: usize,
    /// Bytes of these letters at which more are held back. An empty lane accepts a letter of any
    /// size.
    pub lane_bytes: usize,
    /// Bytes of letters of others in a gateway's custody at which more are held back. One letter of
    /// any size is always accepted. The letters for one receiver have at most half as many bytes as
    /// remain free, so that no receiver uses up the room of others.
    pub custody_bytes: usize,
    /// Timeout of an attempt, for a small letter.
    pub attempt_timeout: Duration,
    /// Timeout of an attempt to a legacy peer. It is longer than the timeouts of the transports: when an
    /// attempt has begun, the letter cannot be sent again, because a legacy peer takes a copy for a
    /// new letter.
    pub legacy_attempt_timeout: Duration,
    /// Networks whose addresses in letters of legacy peers are dialed, whichever host stated them.
    pub contact_networks: Vec<Network>,
}

impl CoreConfig {
    /// Creates a configuration with the default limits.
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
            legacy_attempt_timeout: Duration::from_secs(15),
            contact_networks: Vec::new(),
        }
    }

    /// Timeout of an attempt at this location, for a small letter.
    pub(crate) fn timeout_at(&self, location: &Location) -> Duration {
        match location.signature() {
            Signature::Frames => self.attempt_timeout,
            _ => self.legacy_attempt_timeout,
        }
    }

    /// The order of transports for letters to this receiver, which can be reached in this way.
    pub(crate) fn order_for(&self, receiver: &str, reach: Reach) -> &[Kind] {
        self.route_for(receiver, reach).1
    }

    /// The order of transports for letters to this receiver, which can be reached in this way, and the
    /// pattern of the exception that selects it, if any.
    pub(crate) fn route_for(&self, receiver: &str, reach: Reach) -> (Option<&Pattern>, &[Kind]) {
        let mut routes = self.routes.iter();
        let exception = routes.find(|exception| exception.receivers.matches(receiver));
        match exception.filter(|it| !it.only_on_this_host || reach == Reach::Local) {
            Some(exception) => (Some(&exception.receivers), &exception.order),
            None => (None, &self.order),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_exception_for_this_host_leaves_the_order_to_other_hosts() {
        let exception = |receivers: &str, only_on_this_host| RouteException {
            receivers: Pattern::new(receivers).unwrap(),
            order: vec![Kind::Tcp],
            only_on_this_host,
        };
        let config = CoreConfig {
            routes: vec![exception("arm", true), exception("a.*", false)],
            ..CoreConfig::new("mts", Incarnation::from_u64(1), vec![Kind::Shm])
        };
        let gateway = Incarnation::from_u64(2);
        let away = Reach::Remote { gateway };
        assert_eq!(config.order_for("arm", Reach::Local), [Kind::Tcp]);
        // The first match counts, also where it leaves the order to the default.
        assert_eq!(config.order_for("arm", away), [Kind::Shm]);
        assert_eq!(config.order_for("axe", away), [Kind::Tcp]);
        assert_eq!(config.order_for("eye", Reach::Local), [Kind::Shm]);
    }
}
