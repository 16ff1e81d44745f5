//! The identities that platforms have proved, kept beyond the end of their connections.
//!
//! A platform whose certificate is no longer trusted is refused at its next connection. Letters for it would be sent
//! again until their deadline, as for a platform that was never trusted and may be trusted soon.

use std::collections::VecDeque;

use fipa_transport::Location;
use parking_lot::Mutex;

use crate::stream::proof::Proof;

/// Maximum number of platforms. A platform that is forgotten is like one that was never trusted.
const MAX_PLATFORMS: usize = 256;

/// The latest proof of each platform that a connection was opened to, the latest last.
#[derive(Debug, Default)]
pub(super) struct Proved(Mutex<VecDeque<(Location, Proof)>>);

impl Proved {
    /// Records that a platform has proved its identity.
    pub(super) fn add(&self, platform: &Location, proof: Proof) {
        let mut all = self.0.lock();
        all.retain(|(known, _)| known != platform);
        if all.len() >= MAX_PLATFORMS {
            all.pop_front();
        }
        all.push_back((platform.clone(), proof));
    }

    /// Whether the trust in what this platform proved latest was withdrawn.
    pub(super) fn is_withdrawn(&self, platform: &Location) -> bool {
        let all = self.0.lock();
        let mut proofs = all.iter().filter(|(known, _)| known == platform);
        proofs.any(|(_, proof)| proof.is_distrusted())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_number_of_platforms_is_bounded() {
        let proved = Proved::default();
        for port in 1..=1000 {
            let at = format!("https://192.0.2.1:{port}/acc").parse().unwrap();
            proved.add(&at, Proof::default());
            proved.add(&at, Proof::default());
            assert!(!proved.is_withdrawn(&at));
        }
        assert_eq!(proved.0.lock().len(), MAX_PLATFORMS);
    }
}
