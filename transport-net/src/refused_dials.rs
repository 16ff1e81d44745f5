//! The latest connections of this side that peers refused.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Instant;

use fipa_transport::{Incarnation, Location};
use parking_lot::Mutex;

/// Maximum length of a stored reason, in characters. Peers can cause texts of any length.
const MAX_REASON: usize = 1024;

/// A connection that this side opened and the peer refused, for example because it does not trust this host.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct RefusedDial {
    /// The dialed location.
    pub to: Location,
    /// The reason as far as it is known. It may contain text from the peer.
    pub why: String,
    /// Time of the refusal.
    pub at: Instant,
}

/// The latest [`RefusedDial`] of each address. All clones have the same contents.
#[derive(Debug, Clone, Default)]
pub struct RefusedDials(Arc<Mutex<VecDeque<RefusedDial>>>);

impl RefusedDials {
    /// Maximum number of addresses. Another address replaces the one that was refused longest ago.
    pub const MAX: usize = 16;

    /// Returns the refusals, the latest first.
    #[must_use]
    pub fn latest(&self) -> Vec<RefusedDial> {
        self.0.lock().iter().cloned().collect()
    }

    /// Records a refusal.
    pub(crate) fn add(&self, to: &Location, why: &str) {
        let mut all = self.0.lock();
        all.retain(|known| !is_same(&known.to, to));
        all.truncate(Self::MAX - 1);
        all.push_front(RefusedDial {
            to: to.clone(),
            why: why.chars().take(MAX_REASON).collect(),
            at: Instant::now(),
        });
    }

    /// Removes the refusals of a service that has introduced itself: at the location that this side dialed, if
    /// this side opened the connection, and at all locations with the incarnation of the service.
    pub(crate) fn connected(&self, dialed: Option<&Location>, service: Incarnation) {
        let mut all = self.0.lock();
        if all.is_empty() {
            return;
        }
        all.retain(|known| {
            let is_dialed = dialed.is_some_and(|dialed| is_same(dialed, &known.to));
            let is_of_service = service.is_known() && known.to.incarnation() == service;
            !is_dialed && !is_of_service
        });
    }
}

/// Whether two locations have the same address.
fn is_same(one: &Location, other: &Location) -> bool {
    one.kind() == other.kind() && one.address() == other.address()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(port: u64) -> Location {
        let location: Location = format!("tcp://10.0.0.2:{port}").parse().unwrap();
        location.with_incarnation(Incarnation::from_u64(port))
    }

    #[test]
    fn the_latest_refusal_of_each_address_is_kept_until_a_connection_succeeds() {
        let refused = RefusedDials::default();
        for port in 1..=20 {
            refused.add(&at(port), "early");
        }
        refused.add(&at(7), &"late".repeat(MAX_REASON));
        let latest = refused.latest();
        assert_eq!(latest.len(), RefusedDials::MAX);
        assert_eq!(latest[0].to, at(7));
        assert_eq!(latest[0].why.len(), MAX_REASON);
        assert_eq!(latest[1].to, at(20));
        // The service has another incarnation meanwhile.
        refused.connected(
            Some(&at(7).with_incarnation(Incarnation::UNKNOWN)),
            Incarnation::from_u64(99),
        );
        // The service of this incarnation has opened the connection.
        refused.connected(None, Incarnation::from_u64(20));
        let latest = refused.latest();
        assert_eq!(latest.len(), RefusedDials::MAX - 2);
        assert_eq!(latest[0].to, at(19));
        refused.connected(None, Incarnation::UNKNOWN);
        assert_eq!(refused.latest(), latest);
    }
}
