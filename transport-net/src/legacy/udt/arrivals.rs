//! Measurements of the receiver for the sender's rate control: the rate of arrival and the capacity
//! of the path (draft-gg-udt-03 section 6.2).
//!
//! The system delivers packets in batches, so the time between two packets of a batch is unknown.
//! Therefore the rate is that of a series of batches, not the median of the draft. A pause ends a
//! series.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use super::SYN;

/// Shortest series, and its least number of packets.
const SHORTEST: Duration = Duration::from_millis(1);
const FEWEST: u32 = 16;

/// Longest series: an older batch is left out.
const LONGEST: Duration = Duration::from_millis(40);

/// Maximum number of batches and of pairs that are kept.
const BATCHES: usize = 64;
const PAIRS: usize = 16;

/// Of how many packets two are sent as a pair, without a pause between them.
const PAIR_EVERY: u32 = 16;

#[derive(Debug, Default)]
pub(crate) struct Arrivals {
    /// The time and the number of packets of each batch of the present series.
    series: VecDeque<(Instant, u32)>,
    rate: u32,
    /// The first packet of a pair, and its time of arrival.
    pair: Option<(u32, Instant)>,
    /// The times between the packets of pairs, in microseconds.
    pairs: VecDeque<u32>,
}

impl Arrivals {
    /// Notes a packet by its sequence number on the wire.
    pub(crate) fn note(&mut self, now: Instant, sequence: u32) {
        match self.series.back_mut() {
            Some((at, count)) if now.saturating_duration_since(*at) < SHORTEST / 20 => {
                *count = count.saturating_add(1);
            }
            Some((at, _)) if now.saturating_duration_since(*at) > SYN => {
                self.measure();
                self.series.clear();
                self.series.push_back((now, 1));
            }
            _ => self.series.push_back((now, 1)),
        }
        while self.series.len() > BATCHES
            || self
                .series
                .front()
                .is_some_and(|(at, _)| now.saturating_duration_since(*at) > LONGEST)
        {
            self.series.pop_front();
        }
        match sequence % PAIR_EVERY {
            0 => self.pair = Some((sequence, now)),
            1 => {
                let pair = self.pair.take();
                if let Some((_, at)) = pair.filter(|(first, _)| first + 1 == sequence) {
                    let between = now.saturating_duration_since(at).as_micros();
                    self.pairs
                        .push_back(u32::try_from(between).unwrap_or(u32::MAX).max(1));
                }
                if self.pairs.len() > PAIRS {
                    self.pairs.pop_front();
                }
            }
            _ => {}
        }
    }

    /// Returns the rate of arrival and the capacity of the path in packets per second; 0 when they
    /// are unknown.
    pub(crate) fn rates(&mut self) -> (u32, u32) {
        self.measure();
        let mut pairs: Vec<u32> = self.pairs.iter().copied().collect();
        pairs.sort_unstable();
        let capacity = pairs
            .get(pairs.len() / 2)
            .map_or(0, |median| 1_000_000 / median);
        (self.rate, capacity.max(self.rate))
    }

    /// Measures the rate of the present series, without its first batch, which began it.
    fn measure(&mut self) {
        let (Some((first, _)), Some((last, _))) = (self.series.front(), self.series.back()) else {
            return;
        };
        let time = last.saturating_duration_since(*first);
        let count: u32 = self.series.iter().skip(1).map(|(_, count)| count).sum();
        if time >= SHORTEST && count >= FEWEST {
            self.rate = (f64::from(count) / time.as_secs_f64()).ceil() as u32;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Notes packets in batches of this size, at this time from each other.
    fn series(arrivals: &mut Arrivals, now: &mut Instant, batch: u32, between: Duration) {
        for packet in 0..320 {
            if packet % batch == 0 {
                *now += between;
            }
            arrivals.note(*now, packet);
        }
    }

    #[test]
    fn the_rate_does_not_depend_on_batches_and_pauses() {
        for batch in [1, 4, 32] {
            let (mut arrivals, mut now) = (Arrivals::default(), Instant::now());
            for _ in 0..3 {
                series(
                    &mut arrivals,
                    &mut now,
                    batch,
                    Duration::from_micros(100) * batch,
                );
                now += Duration::from_secs(1);
            }
            let (rate, _) = arrivals.rates();
            assert!(
                (9_900..=10_100).contains(&rate),
                "{rate} in batches of {batch}"
            );
        }
    }

    #[test]
    fn few_packets_and_short_times_give_no_rate() {
        let (mut arrivals, now) = (Arrivals::default(), Instant::now());
        for packet in 2..300 {
            arrivals.note(now, packet);
        }
        arrivals.note(now + SYN / 2, 300);
        assert_eq!(arrivals.rates().0, 0);
    }

    #[test]
    fn pairs_measure_the_capacity() {
        let (mut arrivals, mut now) = (Arrivals::default(), Instant::now());
        for pair in 0..20_u32 {
            now += Duration::from_millis(3);
            arrivals.note(now, pair * PAIR_EVERY);
            // One pair is interrupted.
            now += Duration::from_micros(if pair == 7 { 900 } else { 50 });
            arrivals.note(now, pair * PAIR_EVERY + 1);
        }
        assert_eq!(arrivals.rates().1, 20_000);
        // A second packet without its first does not count.
        arrivals.note(now, 1 << 20 | 1);
        assert_eq!(arrivals.rates().1, 20_000);
    }
}
