//! Counters over the last seconds, in memory that does not grow. No I/O and no clock.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use fipa::Kind;

/// Number of parts of a window.
const SLOTS: u64 = 10;
/// Maximum number of delivery times that one counter keeps; the latest stay.
const MAX_TIMES: usize = 512;

/// Divides the time into slots.
#[derive(Debug, Clone, Copy)]
pub(super) struct Slots {
    began: Instant,
    length: Duration,
}

/// Numbers of letters.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(in crate::command) struct Counts {
    pub(in crate::command) sent: u64,
    pub(in crate::command) received: u64,
    pub(in crate::command) failed: u64,
    pub(in crate::command) violations: u64,
}

impl Counts {
    fn add(&mut self, other: &Self) {
        self.sent = self.sent.saturating_add(other.sent);
        self.received = self.received.saturating_add(other.received);
        self.failed = self.failed.saturating_add(other.failed);
        self.violations = self.violations.saturating_add(other.violations);
    }
}

/// Letters per second.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(in crate::command) struct Rates {
    pub(in crate::command) sent: f64,
    pub(in crate::command) received: f64,
    pub(in crate::command) failed: f64,
    pub(in crate::command) violations: f64,
}

/// Percentiles of delivery times.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::command) struct Latency {
    pub(super) median: Duration,
    pub(super) percentile_99: Duration,
}

/// The letters of one agent, of one host, or of all.
#[derive(Debug, Clone)]
pub(super) struct Counter {
    slots: VecDeque<Slot>,
    times: VecDeque<(Instant, Duration)>,
    total: Counts,
    active: Instant,
}

#[derive(Debug, Clone)]
struct Slot {
    number: u64,
    counts: Counts,
    kinds: [u32; Kind::ALL.len()],
}

impl Slots {
    /// Begins now. The counters cover a window of this length.
    pub(super) fn new(now: Instant, window: Duration) -> Self {
        let length = window / u32::try_from(SLOTS).unwrap_or(u32::MAX);
        let length = length.max(Duration::from_millis(1));
        Self { began: now, length }
    }

    pub(super) fn window(self) -> Duration {
        self.length * u32::try_from(SLOTS).unwrap_or(u32::MAX)
    }

    fn number(self, now: Instant) -> u64 {
        let elapsed = now.saturating_duration_since(self.began);
        u64::try_from(elapsed.as_nanos() / self.length.as_nanos()).unwrap_or(u64::MAX)
    }

    /// The number of the first slot of the window that ends now.
    fn first(self, now: Instant) -> u64 {
        self.number(now).saturating_sub(SLOTS)
    }

    /// Seconds that the window covers: less after the beginning, but not less than a slot.
    fn covered(self, now: Instant) -> f64 {
        let elapsed = now.saturating_duration_since(self.began);
        let first = self.first(now) as f64 * self.length.as_secs_f64();
        (elapsed.as_secs_f64() - first).max(self.length.as_secs_f64())
    }
}

impl Counter {
    pub(super) fn new(now: Instant) -> Self {
        Self {
            slots: VecDeque::new(),
            times: VecDeque::new(),
            total: Counts::default(),
            active: now,
        }
    }

    pub(super) fn add(&mut self, now: Instant, slots: Slots, counts: Counts) {
        self.total.add(&counts);
        if let Some(slot) = self.slot(now, slots) {
            slot.counts.add(&counts);
        }
    }

    /// Adds a letter that this transport has carried.
    pub(super) fn carry(&mut self, now: Instant, slots: Slots, kind: Kind) {
        let position = Kind::ALL.iter().position(|it| *it == kind);
        let slot = self.slot(now, slots);
        if let Some((position, slot)) = position.zip(slot)
            && let Some(count) = slot.kinds.get_mut(position)
        {
            *count = count.saturating_add(1);
        }
    }

    /// Adds the delivery time of a letter.
    pub(super) fn time(&mut self, now: Instant, time: Duration) {
        if self.times.len() >= MAX_TIMES {
            self.times.pop_front();
        }
        self.times.push_back((now, time));
    }

    fn slot(&mut self, now: Instant, slots: Slots) -> Option<&mut Slot> {
        self.active = now;
        let number = slots.number(now);
        if self.slots.back().is_none_or(|slot| slot.number < number) {
            self.slots.push_back(Slot {
                number,
                counts: Counts::default(),
                kinds: [0; Kind::ALL.len()],
            });
        }
        let first = slots.first(now);
        while self.slots.front().is_some_and(|slot| slot.number < first) {
            self.slots.pop_front();
        }
        self.slots.back_mut()
    }

    fn current(&self, now: Instant, slots: Slots) -> impl Iterator<Item = &Slot> {
        let first = slots.first(now);
        self.slots.iter().filter(move |slot| slot.number >= first)
    }

    pub(super) fn rates(&self, now: Instant, slots: Slots) -> Rates {
        let mut counts = Counts::default();
        for slot in self.current(now, slots) {
            counts.add(&slot.counts);
        }
        let covered = slots.covered(now);
        Rates {
            sent: counts.sent as f64 / covered,
            received: counts.received as f64 / covered,
            failed: counts.failed as f64 / covered,
            violations: counts.violations as f64 / covered,
        }
    }

    /// The percentiles of the delivery times within the window; `None` without any.
    pub(super) fn latency(&self, now: Instant, slots: Slots) -> Option<Latency> {
        let window = slots.window();
        let is_recent = |at: Instant| now.saturating_duration_since(at) <= window;
        let recent = self.times.iter().filter(|(at, _)| is_recent(*at));
        let mut times: Vec<Duration> = recent.map(|(_, time)| *time).collect();
        times.sort_unstable();
        Some(Latency {
            median: percentile(&times, 50)?,
            percentile_99: percentile(&times, 99)?,
        })
    }

    /// The transport that has carried most letters within the window.
    pub(super) fn most_used(&self, now: Instant, slots: Slots) -> Option<Kind> {
        let mut sums = [0_u64; Kind::ALL.len()];
        for slot in self.current(now, slots) {
            for (sum, count) in sums.iter_mut().zip(slot.kinds) {
                *sum += u64::from(count);
            }
        }
        let used = sums.into_iter().zip(Kind::ALL).filter(|(sum, _)| *sum > 0);
        // The first one of several with the same number.
        let most = used.reduce(|most, next| if next.0 > most.0 { next } else { most });
        most.map(|(_, kind)| kind)
    }

    /// The numbers of letters since the beginning.
    pub(super) fn total(&self) -> Counts {
        self.total
    }

    pub(super) fn idle(&self, now: Instant) -> Duration {
        now.saturating_duration_since(self.active)
    }
}

/// The nearest-rank percentile of sorted times.
fn percentile(sorted: &[Duration], percent: usize) -> Option<Duration> {
    let rank = (sorted.len() * percent).div_ceil(100).max(1);
    sorted.get(rank - 1).copied()
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    fn sent(number: u64) -> Counts {
        Counts {
            sent: number,
            ..Counts::default()
        }
    }

    #[test]
    fn rates_cover_the_window_only() {
        let start = Instant::now();
        let slots = Slots::new(start, 5 * SECOND);
        let mut counter = Counter::new(start);
        for tenth in 0..100 {
            counter.add(start + SECOND * tenth / 10, slots, sent(3));
        }
        let now = start + 10 * SECOND;
        let rate = counter.rates(now, slots).sent;
        assert!((29.0..=31.0).contains(&rate), "{rate}");
        assert_eq!(counter.rates(now + 6 * SECOND, slots).sent, 0.0);
        assert_eq!(counter.total(), sent(300));
        assert!(counter.slots.len() <= 11, "{}", counter.slots.len());
    }

    #[test]
    fn a_window_that_has_just_begun_is_shorter() {
        let start = Instant::now();
        let slots = Slots::new(start, 10 * SECOND);
        let mut counter = Counter::new(start);
        counter.add(start, slots, sent(10));
        // Less than a slot counts as one.
        assert_eq!(counter.rates(start, slots).sent, 10.0);
        assert_eq!(counter.rates(start + 2 * SECOND, slots).sent, 5.0);
    }

    #[test]
    fn percentiles_are_those_of_the_recent_letters() {
        let start = Instant::now();
        let slots = Slots::new(start, 5 * SECOND);
        let mut counter = Counter::new(start);
        assert_eq!(counter.latency(start, slots), None);
        counter.time(start, Duration::from_secs(9));
        let now = start + 6 * SECOND;
        for millis in (1..=100).rev() {
            counter.time(now, Duration::from_millis(millis));
        }
        let latency = counter.latency(now, slots).unwrap();
        assert_eq!(latency.median, Duration::from_millis(50));
        assert_eq!(latency.percentile_99, Duration::from_millis(99));
        for _ in 0..MAX_TIMES + 10 {
            counter.time(now, Duration::from_millis(7));
        }
        assert_eq!(counter.times.len(), MAX_TIMES);
        let latency = counter.latency(now, slots).unwrap();
        assert_eq!(latency.percentile_99, Duration::from_millis(7));
    }

    #[test]
    fn one_time_is_every_percentile() {
        let one = [SECOND];
        assert_eq!(percentile(&one, 50), Some(SECOND));
        assert_eq!(percentile(&one, 99), Some(SECOND));
        assert_eq!(percentile(&[], 99), None);
    }

    #[test]
    fn the_transport_with_most_letters_is_named() {
        let start = Instant::now();
        let slots = Slots::new(start, 5 * SECOND);
        let mut counter = Counter::new(start);
        assert_eq!(counter.most_used(start, slots), None);
        for kind in [Kind::Unix, Kind::Tcp, Kind::Shm, Kind::Tcp] {
            counter.carry(start, slots, kind);
        }
        assert_eq!(counter.most_used(start, slots), Some(Kind::Tcp));
        counter.carry(start, slots, Kind::Shm);
        assert_eq!(counter.most_used(start, slots), Some(Kind::Shm));
        assert_eq!(counter.most_used(start + 20 * SECOND, slots), None);
    }
}
