//! Rate limits of the peers: letters and bytes per second, over all connections of a peer.
//!
//! Bytes beyond the limit are not refused but read later, so that backpressure slows the sender. A
//! peer is identified by its address here, because additional addresses are costly to obtain. The
//! module does no I/O; it only locks.

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_transport::{TokenBucket, quota_address};
use parking_lot::Mutex;

/// Maximum number of addresses with a limit of their own. All further addresses share one limit.
const MAX_ADDRESSES: usize = 4096;

/// The limits of a peer per second; 0: unlimited.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Rates {
    pub(crate) letters: u64,
    pub(crate) bytes: u64,
}

/// The rate limits of all peers.
#[derive(Debug, Default)]
pub(crate) struct PeerRateLimits(Mutex<HashMap<IpAddr, Arc<PeerRateLimit>>>);

/// The rate limit of one peer.
#[derive(Debug)]
pub(crate) struct PeerRateLimit {
    letters_per_second: f64,
    bytes_per_second: f64,
    buckets: Mutex<Buckets>,
}

#[derive(Debug)]
struct Buckets {
    letters: TokenBucket,
    bytes: TokenBucket,
}

impl PeerRateLimits {
    /// Returns the rate limit of the peer at this address; `None` when peers are unlimited.
    pub(crate) fn of(&self, ip: IpAddr, rates: Rates, now: Instant) -> Option<Arc<PeerRateLimit>> {
        if rates.letters == 0 && rates.bytes == 0 {
            return None;
        }
        let ip = quota_address(ip);
        let mut all = self.0.lock();
        if let Some(rate_limit) = all.get(&ip) {
            return Some(rate_limit.clone());
        }
        if all.len() >= MAX_ADDRESSES {
            // A peer that has been silent for long enough has its full limit again.
            all.retain(|_, rate_limit| {
                Arc::strong_count(rate_limit) > 1 || !rate_limit.is_full(now)
            });
            if all.len() >= MAX_ADDRESSES {
                return all.values().next().cloned();
            }
        }
        let rate_limit = Arc::new(PeerRateLimit::new(rates, now));
        all.insert(ip, rate_limit.clone());
        Some(rate_limit)
    }
}

impl PeerRateLimit {
    fn new(rates: Rates, now: Instant) -> Self {
        let rate = |limit: u64| match limit {
            0 => f64::INFINITY,
            limit => limit as f64,
        };
        let (letters, bytes) = (rate(rates.letters), rate(rates.bytes));
        Self {
            letters_per_second: letters,
            bytes_per_second: bytes,
            buckets: Mutex::new(Buckets {
                letters: TokenBucket::new(letters, now),
                bytes: TokenBucket::new(bytes, now),
            }),
        }
    }

    /// Charges received letters and bytes. Returns the time until which nothing more is to be read,
    /// if any: at most a second from now, so that pings are read in time.
    pub(crate) fn spend(&self, letters: u64, bytes: usize, now: Instant) -> Option<Instant> {
        let mut buckets = self.buckets.lock();
        let spent = [
            (letters as f64, self.letters_per_second),
            (bytes as f64, self.bytes_per_second),
        ];
        let Buckets {
            letters: few,
            bytes: small,
        } = &mut *buckets;
        let pauses = [few, small].into_iter().zip(spent);
        let pauses = pauses.filter_map(|(allowance, (amount, rate))| {
            // An unlimited rate never causes a pause.
            rate.is_finite()
                .then(|| allowance.spend(amount, rate, now))?
        });
        pauses.max().map(|pause| now + pause)
    }

    fn is_full(&self, now: Instant) -> bool {
        let buckets = self.buckets.lock();
        let asked = buckets.letters.asked().max(buckets.bytes.asked());
        now.saturating_duration_since(asked) >= Duration::from_secs(2)
    }
}

/// Whether an address belongs to one peer. A loopback address belongs to many processes.
#[cfg(feature = "ip")]
pub(crate) fn is_one_peer(ip: IpAddr) -> bool {
    !ip.to_canonical().is_loopback()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rates(letters: u64, bytes: u64) -> Rates {
        Rates { letters, bytes }
    }

    #[test]
    fn all_connections_of_a_peer_share_its_rate_limit() {
        let (rate_limits, now) = (PeerRateLimits::default(), Instant::now());
        let of = |ip: &str| {
            let ip = ip.parse().unwrap();
            rate_limits.of(ip, rates(10, 1000), now).unwrap()
        };
        assert_eq!(of("10.0.0.1").spend(6, 0, now), None);
        let later = of("::ffff:10.0.0.1").spend(5, 0, now);
        assert_eq!(later, Some(now + Duration::from_millis(100)));
        assert_eq!(of("10.0.0.2").spend(6, 0, now), None);
        let later = of("10.0.0.2").spend(0, 1500, now);
        assert_eq!(later, Some(now + Duration::from_millis(500)));
        let over = now + Duration::from_millis(500);
        assert_eq!(of("10.0.0.2").spend(0, 0, over), None);
    }

    #[test]
    fn the_number_of_rate_limits_is_bounded() {
        let (rate_limits, now) = (PeerRateLimits::default(), Instant::now());
        let address = |number: u32| IpAddr::from(number.to_be_bytes());
        for number in 0..2 * MAX_ADDRESSES as u32 {
            let rate_limit = rate_limits.of(address(number), rates(1, 1), now).unwrap();
            rate_limit.spend(1, 1, now);
        }
        assert_eq!(rate_limits.0.lock().len(), MAX_ADDRESSES);
        // An address that has just spent its limit does not get a new one.
        let (soon, later) = (
            now + Duration::from_millis(1900),
            now + Duration::from_secs(2),
        );
        let busy = address(0);
        let spent = rate_limits.of(busy, rates(1, 1), soon).unwrap();
        spent.spend(100, 100, soon);
        drop(spent);
        rate_limits.of(address(u32::MAX), rates(1, 1), later);
        assert_eq!(rate_limits.0.lock().len(), 2);
        let same = rate_limits.of(busy, rates(1, 1), later).unwrap();
        assert!(same.spend(1, 1, later).is_some());
    }

    #[test]
    fn an_unlimited_rate_is_not_counted() {
        let (rate_limits, now) = (PeerRateLimits::default(), Instant::now());
        let ip = address();
        assert!(rate_limits.of(ip, rates(0, 0), now).is_none());
        let rate_limit = rate_limits.of(ip, rates(0, 10), now).unwrap();
        assert_eq!(rate_limit.spend(u64::MAX, 10, now), None);
        assert!(rate_limit.spend(0, 1, now).is_some());
    }

    fn address() -> IpAddr {
        IpAddr::from([10, 0, 0, 1])
    }
}
