//! Measurement of the difference between the clocks of two hosts.
//!
//! The arithmetic is that of NTP (RFC 5905 §8): of several questions, the one with the shortest round trip counts. The
//! error of its result is at most half of the round trip.

use std::collections::BTreeMap;
use std::time::{SystemTime, UNIX_EPOCH};

use serde::{Deserialize, Serialize};

/// Name of the metadata record with the difference at the beginning of a recording.
pub(in crate::command) const CLOCK_AT_START: &str = "fipa.clock.start";
/// Name of the metadata record with the difference at the end of a recording.
pub(in crate::command) const CLOCK_AT_STOP: &str = "fipa.clock.stop";

/// The difference between the clocks of two hosts.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(in crate::command) struct Clock {
    /// The host with whose clock the other one was compared.
    pub(in crate::command) reference: String,
    /// The time of the other host minus the time of the reference, in nanoseconds.
    pub(in crate::command) offset: i64,
    /// The maximum error of the difference, in nanoseconds.
    pub(in crate::command) uncertainty: u64,
    /// The time of the measurement by the clock of the other host, in nanoseconds since 1970.
    pub(in crate::command) at: i64,
}

impl Clock {
    /// The measurement for a host itself.
    pub(super) fn of_reference(reference: &str) -> Self {
        Self {
            reference: reference.to_owned(),
            offset: 0,
            uncertainty: 0,
            at: now(),
        }
    }

    /// The metadata record of a measurement for this host.
    pub(super) fn to_metadata(&self, host: &str) -> BTreeMap<String, String> {
        [
            ("host", host.to_owned()),
            ("reference", self.reference.clone()),
            ("offset_ns", self.offset.to_string()),
            ("uncertainty_ns", self.uncertainty.to_string()),
            ("at_ns", self.at.to_string()),
        ]
        .map(|(key, value)| (key.to_owned(), value))
        .into()
    }

    /// Reads a metadata record. Returns `None` if a value is missing or malformed.
    pub(in crate::command) fn from_metadata(pairs: &BTreeMap<String, String>) -> Option<Self> {
        Some(Self {
            reference: pairs.get("reference")?.clone(),
            offset: pairs.get("offset_ns")?.parse().ok()?,
            uncertainty: pairs.get("uncertainty_ns")?.parse().ok()?,
            at: pairs.get("at_ns")?.parse().ok()?,
        })
    }
}

/// The times at which a recorder received and answered a question, in nanoseconds since 1970.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub(super) struct ClockAnswer {
    pub(super) received: i64,
    pub(super) answered: i64,
}

/// One question about the clock of another host: the times of the own clock before and after it, and the answer.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sample {
    pub(super) asked: i64,
    pub(super) answer: ClockAnswer,
    pub(super) returned: i64,
}

impl Sample {
    /// The time on the way in both directions; `None` if a clock was set during the question.
    fn round_trip(&self) -> Option<u64> {
        let total = self.returned.checked_sub(self.asked)?;
        let there = self.answer.answered.checked_sub(self.answer.received)?;
        let is_forward = total >= 0 && there >= 0;
        let trip = total.checked_sub(there).filter(|_| is_forward)?;
        u64::try_from(trip).ok()
    }

    fn offset(&self) -> Option<i64> {
        let to = i128::from(self.answer.received) - i128::from(self.asked);
        let from = i128::from(self.answer.answered) - i128::from(self.returned);
        i64::try_from((to + from) / 2).ok()
    }
}

/// Returns the difference by the sample with the shortest round trip.
pub(super) fn best(reference: &str, samples: &[Sample]) -> Option<Clock> {
    let measured = samples.iter().filter_map(|sample| {
        let trip = sample.round_trip()?;
        Some((trip, sample.offset()?, sample.answer.received))
    });
    let (trip, offset, at) = measured.min_by_key(|(trip, ..)| *trip)?;
    Some(Clock {
        reference: reference.to_owned(),
        offset,
        uncertainty: trip.div_ceil(2),
        at,
    })
}

/// The time of this host in nanoseconds since 1970.
pub(super) fn now() -> i64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH);
    i64::try_from(since.unwrap_or_default().as_nanos()).unwrap_or(i64::MAX)
}

#[cfg(test)]
mod tests {
    use fastrand::Rng;

    use super::*;

    fn sample(asked: i64, received: i64, answered: i64, returned: i64) -> Sample {
        Sample {
            asked,
            answer: ClockAnswer { received, answered },
            returned,
        }
    }

    #[test]
    fn the_true_difference_is_within_the_uncertainty() {
        let mut random = Rng::with_seed(175);
        for _ in 0..10_000 {
            let difference = random.i64(-1 << 50..1 << 50);
            let samples: Vec<Sample> = (0..random.usize(1..9))
                .map(|_| {
                    let asked = random.i64(1 << 60..1 << 61);
                    let [to, work, back] = [(); 3].map(|()| random.i64(0..1 << 30));
                    let received = asked + to + difference;
                    let answered = received + work;
                    sample(asked, received, answered, asked + to + work + back)
                })
                .collect();
            let clock = best("a", &samples).unwrap();
            let error = (clock.offset - difference).unsigned_abs();
            assert!(error <= clock.uncertainty, "{difference}: {clock:?}");
        }
    }

    #[test]
    fn the_shortest_round_trip_counts() {
        let slow = sample(0, 1_000, 1_000, 1_000);
        let fast = sample(5_000, 5_110, 5_120, 5_030);
        let clock = best("a", &[slow, fast]).unwrap();
        assert_eq!(
            (clock.offset, clock.uncertainty, clock.at),
            (100, 10, 5_110)
        );
    }

    #[test]
    fn a_clock_that_was_set_during_a_question_and_extreme_times_give_no_result() {
        for one in [
            sample(10, 5, 5, 0),
            sample(0, 9, 5, 10),
            sample(0, 0, 20, 10),
            sample(i64::MIN, 0, 0, i64::MAX),
            sample(0, i64::MIN, i64::MAX, 1),
        ] {
            assert_eq!(best("a", &[one]), None, "{one:?}");
        }
        assert_eq!(best("a", &[]), None);
    }

    #[test]
    fn metadata_has_the_measurement() {
        let clock = Clock {
            reference: "a".to_owned(),
            offset: -5,
            uncertainty: 3,
            at: 17,
        };
        let mut pairs = clock.to_metadata("b");
        assert_eq!(Clock::from_metadata(&pairs), Some(clock));
        pairs.insert("offset_ns".to_owned(), "1.5".to_owned());
        assert_eq!(Clock::from_metadata(&pairs), None);
    }
}
