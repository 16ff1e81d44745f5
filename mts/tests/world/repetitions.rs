//! Counts how often each letter leaves each service. Other services may answer what they want: the
//! number, and the bytes of the repeated content, have a bound.

use std::time::Instant;

use fipa_transport::{AttemptId, Body, Conclusion, Incarnation, Parcel};

use super::checks::Invariant;
use super::{Map, World};

/// Number of times that a letter may leave a service, and the number for each second more.
const BURST: f64 = 16.0;
const PER_SECOND: f64 = 4.0;
/// Number of times that a letter's content may be repeated, and the bytes for each second more.
const CONTENT_BURST: f64 = 4.0;
const BYTES_PER_SECOND: f64 = (1 << 20) as f64;

/// A letter at a service: the service, and the stream's sender and sequence.
type Key = (usize, Incarnation, u64);

/// The hand-overs of all letters by all services.
#[derive(Default)]
pub(super) struct Repetitions {
    letters: Map<Key, HandOvers>,
    /// Attempts without a conclusion.
    open: Map<(usize, AttemptId), (Key, Instant)>,
}

struct HandOvers {
    first: Instant,
    count: u32,
    len: usize,
}

impl World {
    /// Records that a service dispatches a parcel.
    pub(super) fn note_dispatch(&mut self, at: usize, attempt: AttemptId, parcel: &Parcel) {
        let Body::Letter(letter) = &parcel.body else {
            return;
        };
        let sender = parcel.stream.sender;
        // A hostile member may send a letter again itself.
        if self.is_hostile(sender) {
            return;
        }
        let key = (at, sender, parcel.sequence);
        let first = HandOvers {
            first: self.now,
            count: 0,
            len: letter.len(),
        };
        let Repetitions { letters, open } = &mut self.repetitions;
        letters.entry(key).or_insert(first);
        open.insert((at, attempt), (key, self.now));
    }

    /// Checks the bounds when an attempt has ended. A letter that was not sent has not left.
    pub(super) fn check_repetitions(
        &mut self,
        at: usize,
        attempt: AttemptId,
        conclusion: &Conclusion,
    ) {
        let Some((key, dispatched)) = self.repetitions.open.remove(&(at, attempt)) else {
            return;
        };
        let Some(letter) = self.repetitions.letters.get_mut(&key) else {
            return;
        };
        if matches!(conclusion, Conclusion::NotSent(_)) {
            return;
        }
        letter.count += 1;
        let (count, len) = (f64::from(letter.count), letter.len as f64);
        let seconds = (dispatched - letter.first).as_secs_f64();
        let content = (count - 1.0) * len;
        let most = CONTENT_BURST * len + BYTES_PER_SECOND * seconds;
        if count > BURST + PER_SECOND * seconds || content > most {
            self.breach(Invariant::Repetitions, || {
                let (_, sender, sequence) = key;
                format!(
                    "letter {sequence} of {sender} with {len} bytes left service {at} {count} times within {seconds} s"
                )
            });
        }
    }
}
