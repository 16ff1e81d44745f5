//! Path MTU discovery.
//!
//! The MTU is assumed to be the size that every path must carry. When a larger parcel waits, known
//! link MTUs are probed from the largest down, with padded, unfragmented packets of that size; the
//! first acknowledged size is used. A size that the local interface rejects costs no packet.

use super::packet::{BASE, LARGEST};

/// Loopback; jumbo frames; Ethernet; Ethernet through a tunnel. Less the headers of IPv6 and UDP.
const CANDIDATES: [usize; 4] = [LARGEST, 9000 - 48, 1500 - 48, 1420 - 48];

/// Number of probes per size, since a probe may be lost for other reasons.
const TRIES: u8 = 2;

#[derive(Debug)]
pub(crate) struct Mtu {
    current: usize,
    max: usize,
    /// The next candidate and the number of its probes.
    next: usize,
    tries: u8,
    /// Whether a probe is in flight.
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

    /// Returns the size of the largest datagram that is known to arrive.
    pub(crate) fn current(&self) -> usize {
        self.current
    }

    /// Whether no larger size is left to probe.
    pub(crate) fn is_settled(&self) -> bool {
        self.candidate().is_none()
    }

    /// Returns the size of a probe to send now, which counts as sent.
    pub(crate) fn take_probe(&mut self) -> Option<usize> {
        let size = self.candidate().filter(|_| !self.probing)?;
        self.probing = true;
        self.tries += 1;
        Some(size)
    }

    /// Records the arrival of a packet of this size.
    pub(crate) fn arrived(&mut self, size: usize) {
        if Some(size) == self.candidate() {
            self.probing = false;
            self.next = CANDIDATES.len();
        }
        self.current = self.current.max(size.min(self.max));
    }

    /// Records the loss of a probe.
    pub(crate) fn lost(&mut self, size: usize) {
        if Some(size) == self.candidate() && self.probing {
            self.probing = false;
            if self.tries >= TRIES {
                self.step();
            }
        }
    }

    /// Records that the local interface or the path does not carry this size.
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
        let candidates = CANDIDATES.get(self.next..)?;
        // The configured limit is probed like the other sizes.
        candidates
            .iter()
            .map(|size| (*size).min(self.max))
            .find(|size| *size > self.current)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_largest_size_that_arrives_is_found() {
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
                assert_eq!(mtu.take_probe(), None, "one probe at a time");
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
    fn the_configured_limit_is_respected() {
        let mut mtu = Mtu::new(2000);
        assert_eq!(mtu.take_probe(), Some(2000));
        mtu.arrived(2000);
        assert!(mtu.is_settled());
        assert_eq!(mtu.current(), 2000);
        assert!(Mtu::new(BASE).is_settled());
    }

    #[test]
    fn a_smaller_path_mtu_is_detected() {
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
