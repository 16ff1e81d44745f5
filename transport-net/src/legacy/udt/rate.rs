//! Rate control of the sender (draft-gg-udt-03 section 7.2): DAIMD, which increases the rate by less
//! the less capacity is left, and decreases it by an eighth at a loss. Beside it, a window of packets
//! in flight.

use std::time::{Duration, Instant};

use super::SYN;

/// The first window, and the part of a window that does not depend on the rate.
const FIRST_WINDOW: f64 = 16.0;

/// The longest time between two packets, in microseconds. The draft has no limit.
const MAX_PERIOD: f64 = 10_000.0;

/// Increase of the packets per [`SYN`] when no capacity is left.
const MIN_INCREASE: f64 = 0.01;

/// Maximum number of decreases within one period of congestion: 0.875^5 is about one half.
const MAX_DECREASES: u32 = 5;

#[derive(Debug)]
pub(crate) struct RateControl {
    /// Size of a packet in bytes, and the largest window.
    packet: f64,
    max_window: f64,
    /// Time between two packets in microseconds; 0 during slow start.
    period: f64,
    window: f64,
    slow_start: bool,
    /// The acknowledged packet at the last increase.
    last_ack: u64,
    increased: Option<Instant>,
    /// Whether a loss was reported since then.
    loss: bool,
    /// Rate of arrival and capacity, in packets per second, once they are known.
    arrivals: Option<f64>,
    capacity: Option<f64>,
    /// The last packet that was sent when the rate was last decreased, and the period before.
    decreased_at: u64,
    period_before: f64,
    /// Loss reports in this period of congestion, and their average.
    reports: u32,
    mean_reports: f64,
    /// Every report with a number that is a multiple of this decreases the rate.
    spread: u32,
    decreases: u32,
}

impl RateControl {
    /// Creates the control for a connection whose first packet has this sequence number. `packet` is
    /// the size of a full packet in bytes.
    pub(crate) fn new(first: u64, packet: usize, max_window: u32) -> Self {
        Self {
            packet: packet as f64,
            max_window: f64::from(max_window),
            period: 0.0,
            window: FIRST_WINDOW,
            slow_start: true,
            last_ack: first,
            increased: None,
            loss: false,
            arrivals: None,
            capacity: None,
            decreased_at: first.saturating_sub(1),
            period_before: 0.0,
            reports: 0,
            mean_reports: 0.0,
            spread: 1,
            decreases: 0,
        }
    }

    /// Returns the time between two packets.
    pub(crate) fn period(&self) -> Duration {
        Duration::from_nanos((self.period * 1000.0) as u64)
    }

    /// Returns the number of packets that may be in flight.
    pub(crate) fn window(&self) -> u32 {
        self.window.clamp(FIRST_WINDOW, self.max_window) as u32
    }

    /// Notes the rates that the receiver has measured, in packets per second; 0 if unknown.
    pub(crate) fn measured(&mut self, arrivals: u32, capacity: u32) {
        for (average, new) in [
            (&mut self.arrivals, arrivals),
            (&mut self.capacity, capacity),
        ] {
            if new > 0 {
                let new = f64::from(new);
                *average = Some(average.map_or(new, |average| (average * 7.0 + new) / 8.0));
            }
        }
    }

    /// Handles an acknowledgment of all packets before `ack`.
    pub(crate) fn on_ack(&mut self, now: Instant, ack: u64, rtt: Duration) {
        if self.increased.is_some_and(|last| now < last + SYN) {
            return;
        }
        self.increased = Some(now);
        let gained = ack.saturating_sub(self.last_ack) as f64;
        self.last_ack = ack;
        if self.slow_start {
            self.window += gained;
            if self.window <= self.max_window {
                return;
            }
            self.end_slow_start(rtt);
        } else if let Some(arrivals) = self.arrivals {
            self.window = arrivals * (rtt + SYN).as_secs_f64() + FIRST_WINDOW;
        }
        if std::mem::take(&mut self.loss) {
            return;
        }
        let syn = micros(SYN);
        let increase = self.increase();
        self.period = self.period * syn / (self.period * increase + syn);
    }

    /// Handles a report of lost packets. `first` is the first lost packet, `sent` the last one that
    /// has been sent.
    pub(crate) fn on_loss(&mut self, first: u64, sent: u64, rtt: Duration) {
        if self.slow_start {
            self.end_slow_start(rtt);
            if self.arrivals.is_some() {
                return;
            }
        }
        self.loss = true;
        if first > self.decreased_at {
            self.period_before = self.period;
            self.mean_reports = self.mean_reports * 0.875 + f64::from(self.reports) * 0.125;
            self.reports = 1;
            self.decreases = 1;
            self.spread = spread(sent, self.mean_reports);
            self.decrease(sent);
        } else {
            self.reports = self.reports.saturating_add(1);
            if self.decreases < MAX_DECREASES && self.reports.is_multiple_of(self.spread) {
                self.decreases += 1;
                self.decrease(sent);
            }
        }
    }

    /// Handles a timeout: the packets in flight got no acknowledgment.
    pub(crate) fn on_timeout(&mut self, rtt: Duration) {
        if self.slow_start {
            self.end_slow_start(rtt);
        }
    }

    /// Begins to send at the rate that has been reached.
    fn end_slow_start(&mut self, rtt: Duration) {
        self.slow_start = false;
        self.period = match self.arrivals {
            Some(arrivals) => 1e6 / arrivals,
            None => micros(rtt + SYN) / self.window,
        }
        .min(MAX_PERIOD);
    }

    fn decrease(&mut self, sent: u64) {
        self.period = (self.period * 1.125).ceil().min(MAX_PERIOD);
        self.decreased_at = sent;
    }

    /// Returns the increase of the packets per [`SYN`].
    fn increase(&self) -> f64 {
        let Some(capacity) = self.capacity else {
            return MIN_INCREASE;
        };
        let mut spare = match self.period {
            period if period > 0.0 => capacity - 1e6 / period,
            _ => 0.0,
        };
        if self.period > self.period_before && spare > capacity / 9.0 {
            spare = capacity / 9.0;
        }
        if spare <= 0.0 {
            return MIN_INCREASE;
        }
        let magnitude = (spare * self.packet * 8.0).log10().ceil();
        let increase = 10_f64.powf(magnitude) * 0.000_001_5 / self.packet;
        increase.max(MIN_INCREASE)
    }
}

fn micros(duration: Duration) -> f64 {
    duration.as_secs_f64() * 1e6
}

/// Returns a number from 1 to the mean number of reports, so that senders do not decrease their rate
/// at the same time. It follows from the sequence number, so that runs can be repeated.
fn spread(sent: u64, mean: f64) -> u32 {
    let most = (mean.ceil() as u64).clamp(1, 1 << 20);
    // Fibonacci hashing.
    let mixed = sent.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 32;
    (mixed % most) as u32 + 1
}

#[cfg(test)]
mod tests {
    use super::*;

    const RTT: Duration = Duration::from_millis(2);

    fn control() -> RateControl {
        RateControl::new(100, 1500, 8192)
    }

    #[test]
    fn slow_start_adds_what_was_acknowledged_once_per_syn() {
        let (mut control, now) = (control(), Instant::now());
        assert_eq!((control.window(), control.period()), (16, Duration::ZERO));
        control.on_ack(now, 116, RTT);
        assert_eq!(control.window(), 32);
        control.on_ack(now + SYN / 2, 120, RTT);
        assert_eq!(control.window(), 32);
        control.on_ack(now + SYN, 148, RTT);
        assert_eq!((control.window(), control.period()), (64, Duration::ZERO));
    }

    #[test]
    fn a_loss_ends_slow_start_at_the_rate_of_arrival() {
        let mut control = control();
        control.measured(10_000, 100_000);
        control.on_loss(105, 110, RTT);
        assert_eq!(control.period(), Duration::from_micros(100));
        // Without a measurement: at the rate of the window.
        let mut control = self::control();
        control.on_loss(105, 110, RTT);
        assert_eq!(
            control.period(),
            Duration::from_micros(12_000 / 16 * 9 / 8 + 1)
        );
    }

    #[test]
    fn a_loss_lowers_the_rate_by_an_eighth_and_at_most_by_half_in_one_period() {
        let mut control = control();
        control.measured(10_000, 100_000);
        control.on_loss(105, 110, RTT);
        control.on_loss(111, 200, RTT);
        assert_eq!(control.period(), Duration::from_micros(113));
        for _ in 0..100 {
            control.on_loss(150, 200, RTT);
        }
        let lowest = control.period();
        assert!(lowest > Duration::from_micros(113) && lowest < Duration::from_micros(210));
    }

    #[test]
    fn the_rate_grows_by_less_the_less_capacity_is_left() {
        let steps = |capacity: u32| {
            let (mut control, mut now) = (control(), Instant::now());
            control.measured(1000, capacity);
            control.on_loss(105, 110, RTT);
            for step in 0..100 {
                now += SYN;
                control.on_ack(now, 110 + step, RTT);
            }
            control.period()
        };
        let (small, large) = (steps(1100), steps(100_000));
        assert!(large < small / 5, "{large:?} {small:?}");
        assert!(small < Duration::from_millis(1));
    }

    #[test]
    fn the_rate_never_falls_below_its_limit() {
        let mut control = control();
        for number in 0..10_000 {
            control.on_loss(1000 + number * 2, 1001 + number * 2, RTT);
        }
        assert_eq!(control.period(), Duration::from_micros(MAX_PERIOD as u64));
    }
}
