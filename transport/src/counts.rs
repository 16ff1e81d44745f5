//! Counters of a process: the letters that it sends, receives and forwards, and what happens to them.
//!
//! A process counts in words of memory that others can read without its help: a page of a file that all
//! processes of the domain on one host open. [`Totals`] are values of these words at one moment, of one process or the
//! sum of several. Counters only grow.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use crate::{Kind, Outcome};

/// Number of words.
const WORDS: usize = 512;

/// The value of the first word: the layout of the others. Changes with it.
const LAYOUT: u64 = 0x6669_7061_0000_0001;

/// Number of kinds of transport, and one for letters without any.
const TRANSPORTS: usize = Kind::ALL.len() + 1;

/// Number of finite buckets of delivery times.
pub const BUCKETS: usize = 13;

/// Number of protocols whose violations are counted apart.
pub const PROTOCOLS: usize = 32;

const OUTCOMES: usize = LetterOutcome::ALL.len();
const LETTERS: usize = 1;
const DELIVERIES: usize = LETTERS + Direction::ALL.len() * TRANSPORTS * OUTCOMES;
/// The finite buckets, the last one, and the sum.
const DELIVERY_WORDS: usize = BUCKETS + 2;
const VIOLATIONS: usize = DELIVERIES + TRANSPORTS * DELIVERY_WORDS;
const EVENTS: usize = VIOLATIONS + PROTOCOLS;

const _: () = assert!(EVENTS + Event::ALL.len() <= WORDS);

/// The direction of a letter at the process that counts it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Direction {
    /// An agent of the process sent it.
    Sent,
    /// It arrived for an agent of the process.
    Received,
    /// The process, a gateway, took it into custody for another one.
    Forwarded,
}

/// The end of a letter at the process that counts it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LetterOutcome {
    /// The receiver's queue has taken it.
    Delivered,
    /// It was handed to a peer that cannot confirm.
    Unconfirmed,
    /// It was not delivered.
    Failed,
    /// The access rules of this process refused it.
    Refused,
}

/// An event that is counted without a label.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Event {
    /// An agent took a letter out of its queue, or the queue ended with the letter in it.
    Read,
    /// A letter was given to the delivery core, for one receiver.
    Submitted,
    /// An attempt to deliver a letter failed.
    FailedAttempt,
    /// A failure message was sent to a sender.
    FailureMessage,
}

impl Direction {
    /// All directions.
    pub const ALL: [Self; 3] = [Self::Sent, Self::Received, Self::Forwarded];

    /// The name of the direction.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Sent => "sent",
            Self::Received => "received",
            Self::Forwarded => "forwarded",
        }
    }
}

impl LetterOutcome {
    /// All outcomes.
    pub const ALL: [Self; 4] = [
        Self::Delivered,
        Self::Unconfirmed,
        Self::Failed,
        Self::Refused,
    ];

    /// The name of the outcome.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Delivered => "delivered",
            Self::Unconfirmed => "unconfirmed",
            Self::Failed => "failed",
            Self::Refused => "refused",
        }
    }
}

impl Event {
    /// All events.
    pub const ALL: [Self; 4] = [
        Self::Read,
        Self::Submitted,
        Self::FailedAttempt,
        Self::FailureMessage,
    ];
}

/// A reference to counters that threads share, wherever their memory is.
pub type SharedCounts = Arc<dyn AsRef<Counts> + Send + Sync>;

/// The counters of one process.
#[derive(Debug)]
#[repr(transparent)]
pub struct Counts([AtomicU64; WORDS]);

impl Default for Counts {
    fn default() -> Self {
        let counts = Self([const { AtomicU64::new(0) }; WORDS]);
        counts.begin();
        counts
    }
}

impl AsRef<Self> for Counts {
    fn as_ref(&self) -> &Self {
        self
    }
}

impl Counts {
    /// Size of the counters, in bytes.
    pub const LEN: usize = WORDS * 8;

    /// Marks counters in memory that was filled with zeros as valid.
    pub fn begin(&self) {
        self.word(0, |layout| layout.store(LAYOUT, Ordering::Relaxed));
    }

    /// Counts a letter. One thread at a time calls this, and the other methods without `shared` in the name.
    #[inline]
    pub fn letter(&self, direction: Direction, via: Option<Kind>, outcome: LetterOutcome) {
        self.add(letter_word(direction, via, outcome), 1);
    }

    /// Counts the outcome of a letter of this process, or of one that it forwards.
    #[inline]
    pub fn settled(&self, direction: Direction, outcome: &Outcome) {
        let (via, end) = match outcome {
            Outcome::Delivered { via, .. } => (Some(*via), LetterOutcome::Delivered),
            Outcome::Sent { via, .. } => (Some(*via), LetterOutcome::Unconfirmed),
            Outcome::Failed { .. } => (None, LetterOutcome::Failed),
        };
        self.letter(direction, via, end);
    }

    /// Counts the time from sending a letter to its outcome.
    #[inline]
    pub fn took(&self, via: Option<Kind>, time: Duration) {
        let nanos = time.as_secs().saturating_mul(1_000_000_000);
        let nanos = nanos.saturating_add(time.subsec_nanos().into());
        let first = DELIVERIES + transport_index(via) * DELIVERY_WORDS;
        self.add(first + bucket_of(nanos), 1);
        self.add(first + BUCKETS + 1, nanos);
    }

    /// Counts an event `times` times.
    #[inline]
    pub fn event(&self, event: Event, times: u64) {
        self.add(EVENTS + event as usize, times);
    }

    /// Counts a violation of the protocol with this number, at most [`PROTOCOLS`] - 1. Any thread may call this at any time.
    pub fn shared_violation(&self, protocol: usize) {
        let place = VIOLATIONS + protocol.min(PROTOCOLS - 1);
        self.word(place, |word| {
            word.fetch_add(1, Ordering::Relaxed);
        });
    }

    /// Returns the current values.
    #[must_use]
    pub fn totals(&self) -> Totals {
        Totals(self.0.iter().map(|it| it.load(Ordering::Relaxed)).collect())
    }

    #[inline]
    fn add(&self, place: usize, number: u64) {
        self.word(place, |word| {
            // Only this thread writes the word.
            let before = word.load(Ordering::Relaxed);
            word.store(before.wrapping_add(number), Ordering::Relaxed);
        });
    }

    #[inline]
    fn word(&self, place: usize, change: impl FnOnce(&AtomicU64)) {
        if let Some(word) = self.0.get(place) {
            change(word);
        }
    }
}

#[inline]
fn transport_index(via: Option<Kind>) -> usize {
    via.map_or(0, |via| 1 + via as usize)
}

#[inline]
fn letter_word(direction: Direction, via: Option<Kind>, outcome: LetterOutcome) -> usize {
    let column = direction as usize * TRANSPORTS + transport_index(via);
    LETTERS + column * OUTCOMES + outcome as usize
}

/// The bucket of a time. Bucket `k` has times of at most [`bound`]`(k)`, and the last one all others.
#[inline]
fn bucket_of(nanos: u64) -> usize {
    match nanos.saturating_sub(1) / 1000 {
        0 => 0,
        micros => (micros.ilog2() as usize / 2 + 1).min(BUCKETS),
    }
}

/// The longest time of a finite bucket: 1 µs, and four times that of the bucket before.
#[must_use]
pub fn bound(bucket: usize) -> Duration {
    Duration::from_micros(1 << (2 * bucket.min(BUCKETS)))
}

/// Values of counters, of one process or the sum of several.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Totals(Vec<u64>);

/// Delivery times of letters over one transport.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct DeliveryTimes {
    /// Number of letters in each finite bucket, the shortest times first.
    pub buckets: [u64; BUCKETS],
    /// Number of letters.
    pub count: u64,
    /// Sum of the times.
    pub sum: Duration,
}

impl Default for Totals {
    fn default() -> Self {
        let mut words = vec![0; WORDS];
        if let Some(layout) = words.first_mut() {
            *layout = LAYOUT;
        }
        Self(words)
    }
}

impl Totals {
    /// Reads the bytes of a page, in the byte order of this host. `None` if they have another layout.
    #[must_use]
    pub fn from_page(bytes: &[u8]) -> Option<Self> {
        let (words, rest) = bytes.as_chunks::<8>();
        let words: Vec<u64> = words.iter().map(|it| u64::from_ne_bytes(*it)).collect();
        let is_ours = rest.is_empty() && words.len() == WORDS && words.first() == Some(&LAYOUT);
        is_ours.then_some(Self(words))
    }

    /// The bytes of a page, in the byte order of this host.
    #[must_use]
    pub fn to_page(&self) -> Vec<u8> {
        self.0.iter().flat_map(|it| it.to_ne_bytes()).collect()
    }

    /// Adds the counters of another process.
    pub fn add(&mut self, other: &Self) {
        for (sum, more) in self.0.iter_mut().zip(&other.0).skip(1) {
            *sum = sum.wrapping_add(*more);
        }
    }

    /// Raises each counter to that of `before`, if it is lower.
    pub fn at_least(&mut self, before: &Self) {
        for (value, before) in self.0.iter_mut().zip(&before.0).skip(1) {
            *value = (*value).max(*before);
        }
    }

    /// Number of letters of this direction that ended so, over this transport.
    #[must_use]
    pub fn letters(&self, direction: Direction, via: Option<Kind>, outcome: LetterOutcome) -> u64 {
        self.word(letter_word(direction, via, outcome))
    }

    /// Number of letters of this direction that ended so, over all transports.
    #[must_use]
    pub fn all_letters(&self, direction: Direction, outcome: LetterOutcome) -> u64 {
        let over = transports().map(|via| self.letters(direction, via, outcome));
        over.fold(0, u64::wrapping_add)
    }

    /// The times from sending to the outcome, of the letters that this transport carried.
    #[must_use]
    pub fn delivery_times(&self, via: Option<Kind>) -> DeliveryTimes {
        let first = DELIVERIES + transport_index(via) * DELIVERY_WORDS;
        let buckets = std::array::from_fn(|bucket| self.word(first + bucket));
        let finite = buckets.iter().copied().fold(0, u64::wrapping_add);
        DeliveryTimes {
            buckets,
            count: finite.wrapping_add(self.word(first + BUCKETS)),
            sum: Duration::from_nanos(self.word(first + BUCKETS + 1)),
        }
    }

    /// Number of violations of the protocol with this number.
    #[must_use]
    pub fn violations(&self, protocol: usize) -> u64 {
        self.word(VIOLATIONS + protocol.min(PROTOCOLS - 1))
    }

    /// Number of these events.
    #[must_use]
    pub fn events(&self, event: Event) -> u64 {
        self.word(EVENTS + event as usize)
    }

    fn word(&self, place: usize) -> u64 {
        self.0.get(place).copied().unwrap_or_default()
    }
}

/// The kinds of transport, and `None` for letters without any.
pub fn transports() -> impl Iterator<Item = Option<Kind>> {
    std::iter::once(None).chain(Kind::ALL.into_iter().map(Some))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_time_is_in_the_first_bucket_that_is_long_enough() {
        for bucket in 0..BUCKETS {
            let longest = u64::try_from(bound(bucket).as_nanos()).unwrap();
            assert_eq!(bucket_of(longest), bucket);
            assert_eq!(bucket_of(longest + 1), bucket + 1);
        }
        assert_eq!(bucket_of(0), 0);
        assert_eq!(bucket_of(u64::MAX), BUCKETS);
        assert_eq!(bound(BUCKETS - 1), Duration::from_micros(16_777_216));
    }

    #[test]
    fn each_counter_has_a_word_of_its_own() {
        let counts = Counts::default();
        let mut expected = Vec::new();
        for direction in Direction::ALL {
            for via in transports() {
                for outcome in LetterOutcome::ALL {
                    let times = 1 + expected.len() as u64;
                    (0..times).for_each(|_| counts.letter(direction, via, outcome));
                    expected.push((direction, via, outcome, times));
                }
            }
        }
        for protocol in 0..PROTOCOLS {
            (0..=protocol).for_each(|_| counts.shared_violation(protocol));
        }
        for event in Event::ALL {
            counts.event(event, 1000 + event as u64);
        }
        let totals = Totals::from_page(&counts.totals().to_page()).unwrap();
        for (direction, via, outcome, times) in expected {
            assert_eq!(totals.letters(direction, via, outcome), times);
        }
        for protocol in 0..PROTOCOLS {
            assert_eq!(totals.violations(protocol), 1 + protocol as u64);
        }
        for event in Event::ALL {
            assert_eq!(totals.events(event), 1000 + event as u64);
        }
        for via in transports() {
            assert_eq!(totals.delivery_times(via), DeliveryTimes::default());
        }
    }

    #[test]
    fn outcomes_have_their_times() {
        let counts = Counts::default();
        let delivered = Outcome::Delivered {
            via: Kind::Quic,
            attempts: Vec::new(),
        };
        counts.took(delivered.via(), Duration::from_micros(3));
        counts.took(delivered.via(), Duration::from_secs(100));
        counts.settled(Direction::Forwarded, &delivered);
        let mut sum = Totals::default();
        sum.add(&counts.totals());
        sum.add(&counts.totals());
        let times = sum.delivery_times(Some(Kind::Quic));
        assert_eq!(times.buckets, [0, 2, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]);
        assert_eq!(times.count, 4);
        assert_eq!(times.sum, Duration::from_micros(200_000_006));
        let forwarded = sum.letters(
            Direction::Forwarded,
            Some(Kind::Quic),
            LetterOutcome::Delivered,
        );
        assert_eq!(forwarded, 2);
    }

    #[test]
    fn a_page_of_another_layout_is_refused() {
        let page = Totals::default().to_page();
        assert_eq!(Totals::from_page(&page), Some(Totals::default()));
        for wrong in [
            &page[1..],
            &page[..0],
            &[0; Counts::LEN],
            &[&page[..], &page].concat(),
        ] {
            assert_eq!(Totals::from_page(wrong), None);
        }
    }
}
