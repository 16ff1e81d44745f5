//! Packets under way: round-trip time, what got lost, and how much may be under way at once.
//!
//! As in RFC 9002, simplified: a packet is lost when one sent three later has been acknowledged; if
//! nothing is heard for some measured time, the oldest go out again, with back-off. What was in
//! a lost packet goes out in a new one, so every acknowledgement is of one certain packet.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use super::packet::{Ack, BASE};
use super::received::MAX_DELAY;

/// What a packet carried, to be sent again if it got lost.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kept {
    Parcel(u64),
    Answer(u64),
    Skipped(u64),
    Ping,
    /// A probe of the path, with its size.
    Probe(usize),
}

/// How many later packets must have arrived before one counts as lost.
const REORDERING: u64 = 3;

/// Time-out before the first round trip was measured.
const FIRST_TIMEOUT: Duration = Duration::from_millis(100);

/// ReservedBytes for the coarseness of timers.
const GRANULARITY: Duration = Duration::from_millis(10);

/// Back-off stops here, unless the round trip takes longer: a way that is silent must be found
/// broken, or working again, soon.
const LONGEST_BACKOFF: Duration = Duration::from_millis(300);

/// Bytes that may be under way: at first, at least and at most.
const WINDOW: (usize, usize, usize) = (32 << 10, 4 * BASE, 1 << 20);

/// Numbers of packets under way span at most this: an acknowledgement tells of 256.
const MAX_SPAN: u64 = 200;

#[derive(Debug)]
pub(crate) struct Recovery {
    next: u64,
    sent: BTreeMap<u64, Packet>,
    in_flight: usize,
    rtt: Option<Rtt>,
    window: usize,
    threshold: usize,
    /// Losses among packets below this have been answered with a smaller window already.
    answered: u64,
    backoff: u32,
    last_sent: Instant,
    waiting_since: Option<Instant>,
}

#[derive(Debug)]
struct Packet {
    at: Instant,
    size: usize,
    kept: Vec<Kept>,
}

#[derive(Debug, Clone, Copy)]
struct Rtt {
    smoothed: Duration,
    variation: Duration,
}

/// What an acknowledgement told.
#[derive(Debug, Default)]
pub(crate) struct Told {
    pub(crate) arrived: Vec<Kept>,
    pub(crate) lost: Vec<Kept>,
}

impl Recovery {
    pub(crate) fn new(now: Instant) -> Self {
        Self {
            next: 0,
            sent: BTreeMap::new(),
            in_flight: 0,
            rtt: None,
            window: WINDOW.0,
            threshold: usize::MAX,
            answered: 0,
            backoff: 0,
            last_sent: now,
            waiting_since: None,
        }
    }

    /// Whether a packet of that size may leave now.
    pub(crate) fn has_room(&self, size: usize) -> bool {
        let span = self
            .sent
            .first_key_value()
            .map_or(0, |(oldest, _)| self.next - oldest);
        let fits = self.in_flight == 0 || self.in_flight.saturating_add(size) <= self.window;
        fits && span < MAX_SPAN
    }

    /// The number of the next packet.
    pub(crate) fn take_number(&mut self) -> u64 {
        self.next += 1;
        self.next - 1
    }

    /// A packet that wants to be acknowledged has been sent.
    pub(crate) fn sent(&mut self, number: u64, now: Instant, size: usize, kept: Vec<Kept>) {
        self.in_flight += size;
        self.last_sent = now;
        self.waiting_since.get_or_insert(now);
        let at = now;
        self.sent.insert(number, Packet { at, size, kept });
    }

    /// A round trip was measured by other means.
    pub(crate) fn measured(&mut self, sample: Duration) {
        self.rtt = Some(match self.rtt {
            None => Rtt {
                smoothed: sample,
                variation: sample / 2,
            },
            Some(Rtt {
                smoothed,
                variation,
            }) => Rtt {
                smoothed: (smoothed * 7 + sample) / 8,
                variation: (variation * 3 + smoothed.abs_diff(sample)) / 4,
            },
        });
    }

    /// Takes an acknowledgement; nothing when it is of a packet that was never sent.
    pub(crate) fn acknowledged(&mut self, ack: &Ack, now: Instant) -> Option<Told> {
        if ack.largest >= self.next {
            return None;
        }
        let mut told = Told::default();
        let numbers: Vec<u64> = self.sent.range(..=ack.largest).map(|(n, _)| *n).collect();
        let mut grown = 0;
        for number in numbers {
            if !ack.covers(number) {
                continue;
            }
            let Some(packet) = self.remove(number) else {
                continue;
            };
            if number == ack.largest {
                let delay = Duration::from_micros(ack.delay_us.into()).min(MAX_DELAY * 4);
                let trip = now.saturating_duration_since(packet.at);
                self.measured(trip.checked_sub(delay).unwrap_or(trip));
            }
            if number >= self.answered {
                grown += packet.size;
            }
            told.arrived.extend(packet.kept);
        }
        if !told.arrived.is_empty() {
            self.backoff = 0;
            self.grow(grown);
            self.waiting_since = (!self.sent.is_empty()).then_some(now);
        }
        let lost: Vec<u64> = self
            .sent
            .range(..(ack.largest + 1).saturating_sub(REORDERING))
            .map(|(number, _)| *number)
            .collect();
        for number in lost {
            told.lost.extend(self.lose(number));
        }
        Some(told)
    }

    /// Nothing was heard for too long: what was in the oldest packets is to be sent again.
    pub(crate) fn timed_out(&mut self) -> Vec<Kept> {
        self.backoff = self.backoff.saturating_add(1);
        let oldest: Vec<u64> = self.sent.keys().take(2).copied().collect();
        oldest
            .into_iter()
            .flat_map(|number| self.lose(number))
            .collect()
    }

    /// The packet sent last did not leave. What it carried is to be sent otherwise.
    pub(crate) fn withdraw(&mut self) -> Vec<Kept> {
        let last = self.next.checked_sub(1);
        let packet = last.and_then(|number| self.remove(number));
        if self.sent.is_empty() && self.backoff == 0 {
            self.waiting_since = None;
        }
        packet.map_or_else(Vec::new, |packet| packet.kept)
    }

    /// Nothing is awaited any more.
    pub(crate) fn calm(&mut self) {
        self.backoff = 0;
        self.waiting_since = None;
    }

    /// When nothing will have been heard for too long.
    pub(crate) fn timeout(&self) -> Option<Instant> {
        (!self.sent.is_empty()).then(|| self.last_sent + self.patience())
    }

    /// Since when acknowledgements are awaited in vain, and how often what was sent has been sent
    /// again.
    pub(crate) fn waiting_since(&self) -> Option<(Instant, u32)> {
        self.waiting_since.map(|since| (since, self.backoff))
    }

    /// Whether packets are under way.
    pub(crate) fn is_waiting(&self) -> bool {
        !self.sent.is_empty()
    }

    fn patience(&self) -> Duration {
        let base = match self.rtt {
            None => FIRST_TIMEOUT,
            Some(rtt) => rtt.smoothed + (rtt.variation * 4).max(GRANULARITY) + MAX_DELAY,
        };
        let longest = base.max(LONGEST_BACKOFF);
        base.saturating_mul(1 << self.backoff.min(10)).min(longest)
    }

    fn remove(&mut self, number: u64) -> Option<Packet> {
        let packet = self.sent.remove(&number)?;
        self.in_flight -= packet.size;
        Some(packet)
    }

    fn lose(&mut self, number: u64) -> Vec<Kept> {
        let Some(packet) = self.remove(number) else {
            return Vec::new();
        };
        // A probe that gets lost tells of the size of the path, not of its load.
        let is_probe = packet.kept.iter().any(|k| matches!(k, Kept::Probe(_)));
        if !is_probe && number >= self.answered {
            self.answered = self.next;
            self.window = (self.window / 2).max(WINDOW.1);
            self.threshold = self.window;
        }
        packet.kept
    }

    fn grow(&mut self, acknowledged: usize) {
        let step = if self.window < self.threshold {
            acknowledged
        } else {
            acknowledged.saturating_mul(BASE) / self.window
        };
        self.window = self.window.saturating_add(step).min(WINDOW.2);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::udp::packet::BITMAP;

    fn ack(largest: u64) -> Ack {
        Ack {
            largest,
            delay_us: 0,
            before: [0; BITMAP],
        }
    }

    fn send(recovery: &mut Recovery, now: Instant) -> u64 {
        let number = recovery.take_number();
        recovery.sent(number, now, 1000, vec![Kept::Parcel(number)]);
        number
    }

    #[test]
    fn the_timeout_follows_the_measured_round_trip_and_backs_off() {
        let mut now = Instant::now();
        let mut recovery = Recovery::new(now);
        for _ in 0..30 {
            let number = send(&mut recovery, now);
            now += Duration::from_millis(40);
            recovery.acknowledged(&ack(number), now).unwrap();
        }
        assert_eq!(recovery.timeout(), None);
        send(&mut recovery, now);
        let wait = |recovery: &Recovery| recovery.timeout().unwrap() - now;
        let first = wait(&recovery);
        assert!(first > Duration::from_millis(55) && first < Duration::from_millis(70));
        assert_eq!(recovery.timed_out(), [Kept::Parcel(30)]);
        send(&mut recovery, now);
        assert_eq!(wait(&recovery), first * 2);
        for _ in 0..20 {
            recovery.timed_out();
            send(&mut recovery, now);
        }
        assert_eq!(wait(&recovery), LONGEST_BACKOFF);
        assert!(recovery.waiting_since().unwrap().1 > 20);
        let number = send(&mut recovery, now);
        recovery.acknowledged(&ack(number), now).unwrap();
        assert_eq!(recovery.backoff, 0);
    }

    #[test]
    fn what_later_packets_overtook_is_lost() {
        let now = Instant::now();
        let mut recovery = Recovery::new(now);
        for _ in 0..5 {
            send(&mut recovery, now);
        }
        let told = recovery.acknowledged(&ack(2), now).unwrap();
        assert_eq!(told.arrived, [Kept::Parcel(2)]);
        assert!(told.lost.is_empty());
        let before = recovery.window;
        let told = recovery.acknowledged(&ack(4), now).unwrap();
        assert_eq!(told.lost, [Kept::Parcel(0), Kept::Parcel(1)]);
        assert!(recovery.window < before);
        assert!(recovery.acknowledged(&ack(5), now).is_none());
    }

    #[test]
    fn what_may_be_under_way_is_bounded() {
        let now = Instant::now();
        let mut recovery = Recovery::new(now);
        assert!(recovery.has_room(100_000), "one always may");
        let mut count = 0;
        while recovery.has_room(1000) {
            send(&mut recovery, now);
            count += 1;
        }
        assert_eq!(count, WINDOW.0 / 1000);
    }
}
