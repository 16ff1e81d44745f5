//! How much each peer may send, however many connections it has: letters and bytes a second.
//!
//! Whoever sends more is not refused but read from later, so that its own side holds it back. A
//! peer is an address here: it is what costs something to have many of. Sans-I/O but for the lock.

use std::collections::HashMap;
use std::net::{IpAddr, Ipv4Addr};
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_transport::Allowance;
use parking_lot::Mutex;

/// Addresses that are told apart. All beyond share what one of them has.
const MAX_ADDRESSES: usize = 4096;

/// What a peer may send in a second; 0: any number.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Rates {
    pub(crate) letters: u64,
    pub(crate) bytes: u64,
}

/// What is remembered of all peers.
#[derive(Debug, Default)]
pub(crate) struct Rations(Mutex<HashMap<IpAddr, Arc<Ration>>>);

/// What one peer may still send.
#[derive(Debug)]
pub(crate) struct Ration {
    letters_per_second: f64,
    bytes_per_second: f64,
    left: Mutex<Left>,
}

#[derive(Debug)]
struct Left {
    letters: Allowance,
    bytes: Allowance,
}

impl Rations {
    /// The one of whoever is at this address; none when peers may send as much as they like.
    pub(crate) fn of(&self, ip: IpAddr, rates: Rates, now: Instant) -> Option<Arc<Ration>> {
        if rates.letters == 0 && rates.bytes == 0 {
            return None;
        }
        let ip = whose(ip);
        let mut all = self.0.lock();
        if let Some(ration) = all.get(&ip) {
            return Some(ration.clone());
        }
        if all.len() >= MAX_ADDRESSES {
            // Whoever has been silent for a second has all of it again.
            all.retain(|_, ration| Arc::strong_count(ration) > 1 || !ration.is_full(now));
            if all.len() >= MAX_ADDRESSES {
                return all.values().next().cloned();
            }
        }
        let ration = Arc::new(Ration::new(rates, now));
        all.insert(ip, ration.clone());
        Some(ration)
    }
}

impl Ration {
    fn new(rates: Rates, now: Instant) -> Self {
        let rate = |limit: u64| match limit {
            0 => f64::INFINITY,
            limit => limit as f64,
        };
        let (letters, bytes) = (rate(rates.letters), rate(rates.bytes));
        Self {
            letters_per_second: letters,
            bytes_per_second: bytes,
            left: Mutex::new(Left {
                letters: Allowance::new(letters, now),
                bytes: Allowance::new(bytes, now),
            }),
        }
    }

    /// Counts what has come. Until when nothing more is to be read, if not at once: a second from
    /// now at the latest, so that signs of life are seen in time.
    pub(crate) fn spend(&self, letters: u64, bytes: usize, now: Instant) -> Option<Instant> {
        let mut left = self.left.lock();
        let spent = [
            (letters as f64, self.letters_per_second),
            (bytes as f64, self.bytes_per_second),
        ];
        let Left {
            letters: few,
            bytes: small,
        } = &mut *left;
        let pauses = [few, small].into_iter().zip(spent);
        let pauses = pauses.filter_map(|(allowance, (amount, rate))| {
            // Of what is not limited nothing is ever missing.
            rate.is_finite()
                .then(|| allowance.spend(amount, rate, now))?
        });
        pauses.max().map(|pause| now + pause)
    }

    fn is_full(&self, now: Instant) -> bool {
        let left = self.left.lock();
        let asked = left.letters.asked().max(left.bytes.asked());
        now.saturating_duration_since(asked) >= Duration::from_secs(2)
    }
}

/// Whether an address is that of one peer: the processes of this host are many at one address.
#[cfg(feature = "ip")]
pub(crate) fn is_one_peer(ip: IpAddr) -> bool {
    !ip.to_canonical().is_loopback()
}

/// The address that stands for a source: of IPv6, where every host has many addresses, the network of
/// 64 bits; of loopback, where every user of this host has all addresses, one of them.
pub(crate) fn whose(ip: IpAddr) -> IpAddr {
    match ip.to_canonical() {
        ip if ip.is_loopback() => IpAddr::V4(Ipv4Addr::LOCALHOST),
        IpAddr::V6(v6) if !v6.is_unicast_link_local() => {
            let network = u128::from(v6) & !u128::from(u64::MAX);
            IpAddr::V6(network.into())
        }
        ip => ip,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rates(letters: u64, bytes: u64) -> Rates {
        Rates { letters, bytes }
    }

    #[test]
    fn all_connections_of_a_peer_share_what_it_may_send() {
        let (rations, now) = (Rations::default(), Instant::now());
        let of = |ip: &str| {
            let ip = ip.parse().unwrap();
            rations.of(ip, rates(10, 1000), now).unwrap()
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
    fn a_host_of_ipv6_is_one_peer_whatever_address_it_takes() {
        let whose = |ip: &str| whose(ip.parse().unwrap());
        assert_eq!(whose("2001:db8::1"), whose("2001:db8::ffff:2"));
        assert_ne!(whose("2001:db8::1"), whose("2001:db8:0:1::1"));
        assert_ne!(whose("fe80::1"), whose("fe80::2"));
    }

    #[test]
    fn all_loopback_addresses_are_one_source() {
        let whose = |ip: &str| whose(ip.parse().unwrap());
        for other in ["127.0.0.2", "127.255.255.254", "::1", "::ffff:127.0.0.3"] {
            assert_eq!(whose(other), whose("127.0.0.1"), "{other}");
        }
        assert_ne!(whose("127.0.0.1"), whose("10.0.0.1"));
    }

    #[test]
    fn addresses_that_are_remembered_are_bounded() {
        let (rations, now) = (Rations::default(), Instant::now());
        let address = |number: u32| IpAddr::from(number.to_be_bytes());
        for number in 0..2 * MAX_ADDRESSES as u32 {
            let ration = rations.of(address(number), rates(1, 1), now).unwrap();
            ration.spend(1, 1, now);
        }
        assert_eq!(rations.0.lock().len(), MAX_ADDRESSES);
        let later = now + Duration::from_secs(2);
        rations.of(address(u32::MAX), rates(1, 1), later);
        assert_eq!(rations.0.lock().len(), 1);
    }

    #[test]
    fn what_is_not_limited_is_not_counted() {
        let (rations, now) = (Rations::default(), Instant::now());
        let ip = address();
        assert!(rations.of(ip, rates(0, 0), now).is_none());
        let ration = rations.of(ip, rates(0, 10), now).unwrap();
        assert_eq!(ration.spend(u64::MAX, 10, now), None);
        assert!(ration.spend(0, 1, now).is_some());
    }

    fn address() -> IpAddr {
        IpAddr::from([10, 0, 0, 1])
    }
}
