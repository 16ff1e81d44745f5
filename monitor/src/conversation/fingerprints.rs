//! Keyed fingerprints of texts that are only compared with each other.

use std::hash::{BuildHasher, Hasher, RandomState};

use siphasher::sip::SipHasher13;

/// Makes fingerprints with a random key, which a [snapshot](crate::Monitor::snapshot) carries to the next
/// monitor of the agent. No table uses it.
#[derive(Debug)]
pub(crate) struct Fingerprints {
    keys: [u64; 2],
}

impl Fingerprints {
    pub(crate) fn random() -> Self {
        let random = RandomState::new();
        Self {
            keys: [random.hash_one(0), random.hash_one(1)],
        }
    }

    pub(crate) fn keys(&self) -> [u64; 2] {
        self.keys
    }

    pub(crate) fn set_keys(&mut self, keys: [u64; 2]) {
        self.keys = keys;
    }

    /// Returns the fingerprint of a text, and 0 for none.
    #[inline]
    pub(crate) fn of(&self, text: Option<&str>) -> u64 {
        text.map_or(0, |text| self.of_text(text))
    }

    fn of_text(&self, text: &str) -> u64 {
        let [first, second] = self.keys;
        let mut hasher = SipHasher13::new_with_keys(first, second);
        hasher.write(text.as_bytes());
        hasher.finish().max(1)
    }
}
