//! Packets in flight: round-trip time, loss detection and the congestion window.
//!
//! A simplified form of RFC 9002: a packet is lost when one sent three later has been acknowledged.
//! Without any acknowledgment for some measured time, the contents of the oldest packets are
//! retransmitted, with backoff. The contents of a lost packet are sent in a new packet, so every
//! acknowledgment refers to one certain packet.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use super::packet::{Ack, BASE};
use super::received::MAX_DELAY;

/// The content of a packet, which is retransmitted after a loss.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum SentContent {
    Parcel(u64),
    Answer(u64),
    Skipped(u64),
    Ping,
    /// A probe of the path, with its size.
    Probe(usize),
}

/// Number of later packets that must have arrived before a packet counts as lost.
const REORDERING: u64 = 3;

/// Timeout before the first round trip was measured.
const FIRST_TIMEOUT: Duration = Duration::from_millis(100);

/// Margin for the granularity of timers.
const GRANULARITY: Duration = Duration::from_millis(10);

/// Maximum backoff, unless the round trip takes longer: a silent path must be detected as broken or
/// working again soon.
const LONGEST_BACKOFF: Duration = Duration::from_millis(300);

/// Congestion window in bytes: initial, minimum and maximum.
const WINDOW: (usize, usize, usize) = (32 << 10, 4 * BASE, 1 << 20);

/// Maximum span of the numbers of packets in flight: an acknowledgment covers 256.
const MAX_SPAN: u64 = 200;

#[derive(Debug)]
pub(crate) struct Recovery {
    next: u64,
    sent: BTreeMap<u64, Packet>,
    in_flight: usize,
    rtt: Option<Rtt>,
    window: usize,
    threshold: usize,
    /// The window has already been reduced for losses of packets below this number.
    answered: u64,
    backoff: u32,
    last_sent: Instant,
    waiting_since: Option<Instant>,
}

#[derive(Debug)]
struct Packet {
    at: Instant,
    size: usize,
    contents: Vec<SentContent>,
}

#[derive(Debug, Clone, Copy)]
struct Rtt {
    smoothed: Duration,
    variation: Duration,
}

/// The result of an acknowledgment.
#[derive(Debug, Default)]
pub(crate) struct AckResult {
    pub(crate) arrived: Vec<SentContent>,
    pub(crate) lost: Vec<SentContent>,
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

    /// Whether a packet of this size may be sent now.
    pub(crate) fn has_room(&self, size: usize) -> bool {
        let span = self
            .sent
            .first_key_value()
            .map_or(0, |(oldest, _)| self.next - oldest);
        let fits = self.in_flight == 0 || self.in_flight.saturating_add(size) <= self.window;
        fits && span < MAX_SPAN
    }

    /// Returns the number of the next packet.
    pub(crate) fn take_number(&mut self) -> u64 {
        self.next += 1;
        self.next - 1
    }

    /// Records a sent packet that elicits an acknowledgment.
    pub(crate) fn sent(
        &mut self,
        number: u64,
        now: Instant,
        size: usize,
        contents: Vec<SentContent>,
    ) {
        self.in_flight += size;
        self.last_sent = now;
        self.waiting_since.get_or_insert(now);
        let at = now;
        self.sent.insert(number, Packet { at, size, contents });
    }

    /// Records a round-trip time.
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

    /// Handles an acknowledgment. Returns `None` when it covers a packet that was never sent.
    pub(crate) fn acknowledged(&mut self, ack: &Ack, now: Instant) -> Option<AckResult> {
        if ack.largest >= self.next {
            return None;
        }
        let mut result = AckResult::default();
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
            result.arrived.extend(packet.contents);
        }
        if !result.arrived.is_empty() {
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
            result.lost.extend(self.lose(number));
        }
        Some(result)
    }

    /// Handles a timeout: returns the contents of the oldest packets for retransmission.
    pub(crate) fn timed_out(&mut self) -> Vec<SentContent> {
        self.backoff = self.backoff.saturating_add(1);
        let oldest: Vec<u64> = self.sent.keys().take(2).copied().collect();
        oldest
            .into_iter()
            .flat_map(|number| self.lose(number))
            .collect()
    }

    /// Withdraws the last packet, which could not be sent. Returns its contents.
    pub(crate) fn withdraw(&mut self) -> Vec<SentContent> {
        let last = self.next.checked_sub(1);
        let packet = last.and_then(|number| self.remove(number));
        if self.sent.is_empty() && self.backoff == 0 {
            self.waiting_since = None;
        }
        packet.map_or_else(Vec::new, |packet| packet.contents)
    }

    /// Resets the backoff when no acknowledgment is awaited.
    pub(crate) fn reset_backoff(&mut self) {
        self.backoff = 0;
        self.waiting_since = None;
    }

    /// Returns the time of the retransmission timeout.
    pub(crate) fn timeout_at(&self) -> Option<Instant> {
        (!self.sent.is_empty()).then(|| self.last_sent + self.retransmission_timeout())
    }

    /// Returns the time since which acknowledgments are missing, and the number of timeouts since.
    pub(crate) fn waiting_since(&self) -> Option<(Instant, u32)> {
        self.waiting_since.map(|since| (since, self.backoff))
    }

    /// Whether packets are in flight.
    pub(crate) fn is_waiting(&self) -> bool {
        !self.sent.is_empty()
    }

    fn retransmission_timeout(&self) -> Duration {
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

    fn lose(&mut self, number: u64) -> Vec<SentContent> {
        let Some(packet) = self.remove(number) else {
            return Vec::new();
        };
        // The loss of a probe indicates the MTU of the path, not congestion.
        let is_probe = packet
            .contents
            .iter()
            .any(|k| matches!(k, SentContent::Probe(_)));
        if !is_probe && number >= self.answered {
            self.answered = self.next;
            self.window = (self.window / 2).max(WINDOW.1);
            self.threshold = self.window;
        }
        packet.contents
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
        recovery.sent(number, now, 1000, vec![SentContent::Parcel(number)]);
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
        assert_eq!(recovery.timeout_at(), None);
        send(&mut recovery, now);
        let wait = |recovery: &Recovery| recovery.timeout_at().unwrap() - now;
        let first = wait(&recovery);
        assert!(first > Duration::from_millis(55) && first < Duration::from_millis(70));
        assert_eq!(recovery.timed_out(), [SentContent::Parcel(30)]);
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
    fn a_packet_overtaken_by_later_ones_is_lost() {
        let now = Instant::now();
        let mut recovery = Recovery::new(now);
        for _ in 0..5 {
            send(&mut recovery, now);
        }
        let result = recovery.acknowledged(&ack(2), now).unwrap();
        assert_eq!(result.arrived, [SentContent::Parcel(2)]);
        assert!(result.lost.is_empty());
        let before = recovery.window;
        let result = recovery.acknowledged(&ack(4), now).unwrap();
        assert_eq!(
            result.lost,
            [SentContent::Parcel(0), SentContent::Parcel(1)]
        );
        assert!(recovery.window < before);
        assert!(recovery.acknowledged(&ack(5), now).is_none());
    }

    #[test]
    fn bytes_in_flight_are_bounded() {
        let now = Instant::now();
        let mut recovery = Recovery::new(now);
        assert!(recovery.has_room(100_000), "one packet is always allowed");
        let mut count = 0;
        while recovery.has_room(1000) {
            send(&mut recovery, now);
            count += 1;
        }
        assert_eq!(count, WINDOW.0 / 1000);
    }
}
