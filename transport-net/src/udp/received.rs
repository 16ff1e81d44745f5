//! The set of received packets: detects duplicates and builds acknowledgments.

use std::time::{Duration, Instant};

use super::packet::{Ack, BITMAP};

/// Maximum delay of an acknowledgment that waits for another frame.
pub(crate) const MAX_DELAY: Duration = Duration::from_millis(10);

/// Number of packets below the highest one that are tracked; older ones count as received.
const WINDOW: u64 = BITMAP as u64 * 8;

#[derive(Debug, Default)]
pub(crate) struct Received {
    /// The highest packet and its time of arrival.
    largest: Option<(u64, Instant)>,
    /// Bit i: the packet `largest - 1 - i`.
    before: [u64; BITMAP / 8],
    due: Option<Instant>,
}

impl Received {
    /// Whether a packet has not arrived before, within [`WINDOW`].
    pub(crate) fn is_new(&self, number: u64) -> bool {
        let Some((largest, _)) = self.largest else {
            return true;
        };
        match largest.checked_sub(number) {
            None => true,
            Some(0) => false,
            Some(distance) => distance <= WINDOW && !self.bit(distance - 1),
        }
    }

    /// Records a new packet.
    pub(crate) fn note(&mut self, number: u64, now: Instant) {
        match self.largest {
            None => self.largest = Some((number, now)),
            Some((largest, _)) if number > largest => {
                self.shift(number - largest);
                self.largest = Some((number, now));
            }
            Some((largest, _)) => self.set(largest - number - 1),
        }
    }

    /// Requests an acknowledgment, at once or with the next frames.
    pub(crate) fn wants_ack(&mut self, now: Instant, at_once: bool) {
        let due = if at_once { now } else { now + MAX_DELAY };
        self.due = Some(self.due.map_or(due, |before| before.min(due)));
    }

    /// Returns the time at which an acknowledgment must be sent, if one is due.
    pub(crate) fn due(&self) -> Option<Instant> {
        self.due
    }

    /// Returns the acknowledgment, which counts as sent.
    pub(crate) fn take_ack(&mut self, now: Instant) -> Option<Ack> {
        let (largest, at) = self.largest?;
        self.due = None;
        let delay = now.saturating_duration_since(at).as_micros();
        let mut before = [0; BITMAP];
        for (bytes, word) in before.chunks_exact_mut(8).zip(self.before) {
            bytes.copy_from_slice(&word.to_le_bytes());
        }
        Some(Ack {
            largest,
            delay_us: u32::try_from(delay).unwrap_or(u32::MAX),
            before,
        })
    }

    /// Shifts the bits by `distance` and sets the bit of the previous highest packet.
    fn shift(&mut self, distance: u64) {
        let whole = (distance / 64) as usize;
        let part = (distance % 64) as u32;
        let old = self.before;
        for (index, word) in self.before.iter_mut().enumerate() {
            let from = |index: usize, back: usize| {
                let index = index.checked_sub(back)?;
                old.get(index).copied()
            };
            let low = from(index, whole).unwrap_or(0);
            let carried = from(index, whole.saturating_add(1)).unwrap_or(0);
            *word = if part == 0 {
                low
            } else {
                (low << part) | (carried >> (64 - part))
            };
        }
        self.set(distance - 1);
    }

    fn bit(&self, bit: u64) -> bool {
        let word = self.before.get((bit / 64) as usize);
        word.is_some_and(|word| word & (1 << (bit % 64)) != 0)
    }

    fn set(&mut self, bit: u64) {
        if let Some(word) = self.before.get_mut((bit / 64) as usize) {
            *word |= 1 << (bit % 64);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn it_matches_a_set_of_received_packets(
            numbers in prop::collection::vec(
                prop_oneof![0..40_u64, 0..600_u64, Just(1 << 40), 0..u64::MAX], 1..200),
        ) {
            let now = Instant::now();
            let mut received = Received::default();
            let mut seen: HashSet<u64> = HashSet::new();
            for number in numbers {
                let largest = seen.iter().max().copied().unwrap_or(0);
                let remembered = largest.saturating_sub(number) <= WINDOW;
                let new = received.is_new(number);
                prop_assert_eq!(new, remembered && !seen.contains(&number), "{}", number);
                if new {
                    received.note(number, now);
                    seen.insert(number);
                }
                let ack = received.take_ack(now).unwrap();
                let largest = seen.iter().max().copied().unwrap_or(0);
                for back in 0..=WINDOW {
                    let Some(number) = largest.checked_sub(back) else { break };
                    prop_assert_eq!(ack.covers(number), seen.contains(&number), "{}", number);
                }
            }
        }
    }
}
