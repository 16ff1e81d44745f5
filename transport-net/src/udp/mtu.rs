//! What the path to a peer carries, as far as is known.
//!
//! It begins as what every path carries. When something larger waits, sizes that links are known
//! to have are tried from the largest down, with packets of that size that carry nothing and must
//! not be fragmented; the first that is acknowledged counts. One that the own interface does not
//! take costs nothing.

use super::packet::{BASE, LARGEST};

/// Loopback; jumbo frames; Ethernet; Ethernet through a tunnel. Less the headers of IPv6 and UDP.
const CANDIDATES: [usize; 4] = [LARGEST, 9000 - 48, 1500 - 48, 1420 - 48];

/// How often a size is tried, since a probe may be lost for other reasons.
const TRIES: u8 = 2;

#[derive(Debug)]
pub(crate) struct Mtu {
    current: usize,
    max: usize,
    /// The next candidate, and how often it has been tried.
    next: usize,
    tries: u8,
    /// Whether a probe is under way.
    probing: bool,
}

impl Mtu {
    pub(crate) fn new(max: usize) -> Self {
        Self {
            current: BASE,
            max: max.clamp(BASE, LARGEST),
            next: 0,
            tries: 0,
            probing: false,
        }
    }

    /// Largest datagram that is known to get through.
    pub(crate) fn current(&self) -> usize {
        self.current
    }

    /// Whether more than `current` cannot be expected.
    pub(crate) fn is_settled(&self) -> bool {
        self.candidate().is_none()
    }

    /// The size of a probe that should be sent now, which counts as sent with this.
    pub(crate) fn take_probe(&mut self) -> Option<usize> {
        let size = self.candidate().filter(|_| !self.probing)?;
        self.probing = true;
        self.tries += 1;
        Some(size)
    }

    /// A packet of that size got through.
    pub(crate) fn arrived(&mut self, size: usize) {
        if Some(size) == self.candidate() {
            self.probing = false;
            self.next = CANDIDATES.len();
        }
        self.current = self.current.max(size.min(self.max));
    }

    /// A probe got lost.
    pub(crate) fn lost(&mut self, size: usize) {
        if Some(size) == self.candidate() && self.probing {
            self.probing = false;
            if self.tries >= TRIES {
                self.step();
            }
        }
    }

    /// The own interface does not take that size, or the path no longer does.
    pub(crate) fn too_big(&mut self, size: usize) {
        if Some(size) == self.candidate() {
            self.probing = false;
            self.step();
        } else if size <= self.current && size > BASE {
            self.current = BASE;
            self.probing = false;
            self.tries = 0;
            self.next = CANDIDATES
                .iter()
                .position(|candidate| *candidate <= size)
                .unwrap_or(CANDIDATES.len());
        }
    }

    fn step(&mut self) {
        self.next += 1;
        self.tries = 0;
    }

    fn candidate(&self) -> Option<usize> {
        let left = CANDIDATES.get(self.next..)?;
        // The limit of the configuration is a size to be tried like the others.
        left.iter()
            .map(|size| (*size).min(self.max))
            .find(|size| *size > self.current)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_largest_that_gets_through_is_found() {
        for (interface, path, found) in [
            (65_536, 65_536, LARGEST),
            (1452, 1452, 1452),
            (1452, 1400, 1372),
            (8952, 1300, BASE),
            (1200, 1200, BASE),
        ] {
            let mut mtu = Mtu::new(LARGEST);
            let mut probes = 0;
            while !mtu.is_settled() {
                let size = mtu.take_probe().unwrap();
                assert_eq!(mtu.take_probe(), None, "one at a time");
                if size > interface {
                    mtu.too_big(size);
                } else if size > path {
                    mtu.lost(size);
                    probes += 1;
                } else {
                    mtu.arrived(size);
                }
            }
            assert_eq!(mtu.current(), found);
            assert!(probes <= 6, "{probes}");
        }
    }

    #[test]
    fn the_limit_of_the_configuration_holds() {
        let mut mtu = Mtu::new(2000);
        assert_eq!(mtu.take_probe(), Some(2000));
        mtu.arrived(2000);
        assert!(mtu.is_settled());
        assert_eq!(mtu.current(), 2000);
        assert!(Mtu::new(BASE).is_settled());
    }

    #[test]
    fn a_path_that_shrinks_is_found_out_about() {
        let mut mtu = Mtu::new(LARGEST);
        assert_eq!(mtu.take_probe(), Some(LARGEST));
        mtu.arrived(LARGEST);
        mtu.too_big(5000);
        assert_eq!(mtu.current(), BASE);
        assert_eq!(mtu.take_probe(), Some(1452));
        mtu.arrived(1452);
        assert_eq!(mtu.current(), 1452);
    }
}
