//! Shares of the peers in a bounded number of places. No I/O, no clock.

use std::collections::HashMap;
use std::sync::Arc;

use fipa_transport::PeerId;
use parking_lot::Mutex;

/// Number of places that each peer gets while any are free.
const OF_SMALL: usize = 4;

/// A bounded number of places. One half is for the peers that want many: each may take another place while it has fewer
/// than are free there, so one alone gets half of it, and the next one less. The other half is for peers with at
/// most four places.
#[derive(Debug)]
pub(crate) struct PeerShares {
    most: usize,
    taken: usize,
    of_peers: HashMap<PeerId, usize>,
}

impl PeerShares {
    /// This number of free places.
    pub(crate) fn new(most: usize) -> Self {
        Self {
            most,
            taken: 0,
            of_peers: HashMap::new(),
        }
    }

    /// Takes a place for this peer. Returns whether it has one.
    pub(crate) fn take(&mut self, peer: &PeerId) -> bool {
        let of_peer = self.of_peers.get(peer).copied().unwrap_or_default();
        let free_for_many = (self.most / 2).saturating_sub(self.taken);
        let is_small = of_peer < OF_SMALL && self.taken < self.most;
        if !is_small && of_peer >= free_for_many {
            return false;
        }
        self.of_peers.insert(peer.clone(), of_peer + 1);
        self.taken += 1;
        true
    }

    /// Frees a place of this peer.
    pub(crate) fn release(&mut self, peer: &PeerId) {
        if let Some(of_peer) = self.of_peers.get_mut(peer) {
            *of_peer -= 1;
            self.taken -= 1;
            if *of_peer == 0 {
                self.of_peers.remove(peer);
            }
        }
    }

    /// Number of taken places.
    pub(crate) fn taken(&self) -> usize {
        self.taken
    }
}

/// Places that several tasks share.
#[derive(Debug, Clone)]
pub(crate) struct PeerPlaces(Arc<Mutex<PeerShares>>);

impl PeerPlaces {
    /// This number of free places.
    pub(crate) fn new(most: usize) -> Self {
        Self(Arc::new(Mutex::new(PeerShares::new(most))))
    }

    /// Takes a place for this peer, until it is dropped; `None` if the peer has its share.
    pub(crate) fn take(&self, peer: PeerId) -> Option<PeerPlace> {
        let is_taken = self.0.lock().take(&peer);
        is_taken.then(|| PeerPlace {
            places: self.clone(),
            peer,
        })
    }

    /// Number of taken places.
    pub(crate) fn taken(&self) -> usize {
        self.0.lock().taken()
    }
}

/// A place of a peer.
#[derive(Debug)]
pub(crate) struct PeerPlace {
    places: PeerPlaces,
    peer: PeerId,
}

impl Drop for PeerPlace {
    fn drop(&mut self) {
        self.places.0.lock().release(&self.peer);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn peer(number: u8) -> PeerId {
        PeerId::of_ip([192, 0, 2, number].into())
    }

    fn take_all(shares: &mut PeerShares, peer: &PeerId) -> usize {
        (0..10_000).take_while(|_| shares.take(peer)).count()
    }

    #[test]
    fn peers_that_want_all_leave_places_for_others() {
        let mut shares = PeerShares::new(1_024);
        assert_eq!(take_all(&mut shares, &peer(1)), 256);
        assert_eq!(take_all(&mut shares, &peer(2)), 128);
        for greedy in 3..100 {
            assert!(take_all(&mut shares, &peer(greedy)) >= OF_SMALL);
        }
        assert_eq!(take_all(&mut shares, &peer(100)), OF_SMALL);
        assert!(shares.taken() <= 1_024);
    }

    #[test]
    fn a_place_that_is_free_again_can_be_taken() {
        let mut shares = PeerShares::new(4);
        assert_eq!(take_all(&mut shares, &peer(1)), 4);
        assert!(!shares.take(&peer(2)));
        for _ in 0..5 {
            shares.release(&peer(1));
        }
        assert_eq!(shares.taken(), 0);
        assert!(shares.take(&peer(2)));
    }
}
