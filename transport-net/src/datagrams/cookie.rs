//! Cookies: a peer must return its cookie before any state about it is stored.
//!
//! A cookie is a keyed hash of the peer's address, its number and the time, so that checking it
//! needs no memory of having issued it. It is valid for 15 to 30 seconds. UDT has room for its first
//! four bytes only.

use std::hash::{Hash, Hasher};
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use siphasher::sip128::{Hasher128, SipHasher24};

/// A cookie.
pub(crate) type Cookie = [u8; 16];

const SLOT: Duration = Duration::from_secs(15);

#[derive(Debug)]
pub(crate) struct Cookies {
    key: (u64, u64),
    start: Instant,
}

impl Cookies {
    pub(crate) fn new(key: (u64, u64), start: Instant) -> Self {
        Self { key, start }
    }

    pub(crate) fn give(&self, now: Instant, from: SocketAddr, initiator: u64) -> Cookie {
        self.of_slot(self.slot(now), from, initiator)
    }

    pub(crate) fn check(
        &self,
        now: Instant,
        from: SocketAddr,
        initiator: u64,
        cookie: &Cookie,
    ) -> bool {
        self.valid(now, from, initiator)
            .any(|valid| valid == *cookie)
    }

    /// Returns the cookies that are valid for a peer.
    pub(crate) fn valid(
        &self,
        now: Instant,
        from: SocketAddr,
        initiator: u64,
    ) -> impl Iterator<Item = Cookie> {
        let slot = self.slot(now);
        let slots = [slot, slot.wrapping_sub(1)].into_iter();
        slots.map(move |slot| self.of_slot(slot, from, initiator))
    }

    fn slot(&self, now: Instant) -> u64 {
        now.saturating_duration_since(self.start).as_secs() / SLOT.as_secs()
    }

    fn of_slot(&self, slot: u64, from: SocketAddr, initiator: u64) -> Cookie {
        let mut hasher = SipHasher24::new_with_keys(self.key.0, self.key.1);
        (from.ip(), from.port(), initiator, slot).hash(&mut hasher);
        // The hash is only compared with hashes of this process.
        hasher.write_u8(1);
        hasher.finish128().as_bytes()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cookie_is_good_for_its_address_number_and_time() {
        let start = Instant::now();
        let cookies = Cookies::new((1, 2), start);
        let from: SocketAddr = "192.0.2.1:7".parse().unwrap();
        let cookie = cookies.give(start, from, 9);
        assert!(cookies.check(start, from, 9, &cookie));
        assert!(cookies.check(start + SLOT, from, 9, &cookie));
        assert!(!cookies.check(start + 2 * SLOT, from, 9, &cookie));
        assert!(!cookies.check(start, from, 10, &cookie));
        assert!(!cookies.check(start, "192.0.2.1:8".parse().unwrap(), 9, &cookie));
        assert!(!cookies.check(start, "192.0.2.2:7".parse().unwrap(), 9, &cookie));
        assert!(!Cookies::new((1, 3), start).check(start, from, 9, &cookie));
        assert!(!cookies.check(start, from, 9, &[0; 16]));
    }
}
