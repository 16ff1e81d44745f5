//! The latest connections that were refused because the keys or the protocol versions of the two sides do not match.

use std::collections::VecDeque;
use std::net::IpAddr;
use std::sync::Arc;
use std::time::Instant;

use fipa_transport::quota_address;
use parking_lot::Mutex;

/// A connection that was refused because only one side has keys, because a side does not trust the
/// certificate of the other, or because the sides speak different versions of the protocol.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Refusal {
    /// The address of the peer.
    pub from: IpAddr,
    /// The reason, and the remedy.
    pub why: String,
    /// Time of the refusal.
    pub at: Instant,
}

/// The latest [`Refusal`] of each [source](quota_address). All clones have the same contents.
#[derive(Debug, Clone, Default)]
pub struct Refusals(Arc<Mutex<VecDeque<Refusal>>>);

impl Refusals {
    /// Maximum number of sources. Another source replaces the one that was refused longest ago.
    pub const MAX: usize = 16;

    /// Returns the refusals, the latest first.
    #[must_use]
    pub fn latest(&self) -> Vec<Refusal> {
        self.0.lock().iter().cloned().collect()
    }

    pub(crate) fn add(&self, from: IpAddr, why: &str) {
        let from = from.to_canonical();
        let mut all = self.0.lock();
        all.retain(|known| quota_address(known.from) != quota_address(from));
        all.truncate(Self::MAX - 1);
        all.push_front(Refusal {
            from,
            why: why.to_owned(),
            at: Instant::now(),
        });
    }
}

#[cfg(test)]
mod tests {
    use std::net::Ipv4Addr;

    use super::*;

    #[test]
    fn the_latest_refusal_of_each_source_is_kept() {
        let refusals = Refusals::default();
        let address = |last| IpAddr::from(Ipv4Addr::new(10, 0, 0, last));
        for last in 0..=20 {
            refusals.add(address(last), "early");
        }
        refusals.add(Ipv4Addr::new(10, 0, 0, 7).to_ipv6_mapped().into(), "late");
        let latest = refusals.latest();
        assert_eq!(latest.len(), Refusals::MAX);
        assert_eq!((latest[0].from, &*latest[0].why), (address(7), "late"));
        assert_eq!(latest[1].from, address(20));
        let of_seven = latest.iter().filter(|it| it.from == address(7));
        assert_eq!(of_seven.count(), 1);
        for last in 0..=20 {
            refusals.add(
                std::net::Ipv6Addr::new(0xfd00, 0, 0, 1, 0, 0, 0, last).into(),
                "many",
            );
        }
        assert_eq!(refusals.latest()[1..], latest[..Refusals::MAX - 1]);
    }
}
