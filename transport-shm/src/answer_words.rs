//! Words on the status page of a process in which peers answer its parcels, and the rules for writing and reading them.
//!
//! An answer without data needs no response of iceoryx2. The sender lends a word to each parcel as long as one is free.
//! A parcel names its word, and a token that is larger than those of all parcels that had the word before. The receiver
//! raises the word to the token plus the code of the answer. It never lowers a word, so a late answer to a parcel that
//! was abandoned neither replaces the answer to a later parcel nor passes for it.
//!
//! A process that [joins its domain again](crate::ShmTransport::rejoin) has another page. Each page has a random
//! number, which parcels repeat, so a receiver does not answer on the wrong page.
//!
//! `tests/interleavings.rs` compiles this file with the atomics of loom.

use crate::sync::{AtomicU64, Ordering, fence};

/// Number of words of a process. The others of its unanswered parcels get responses.
pub(crate) const WORDS: usize = 54;

const _: () = assert!(WORDS <= 64, "a bit for each word");

/// Difference between two tokens. The codes of answers are smaller.
const STEP: u64 = 16;

/// Maximum number of attempts to write an answer. Each failed one means that another process has written the word.
const ATTEMPTS: usize = 8;

/// The words of a process.
#[derive(Debug)]
#[repr(C)]
pub(crate) struct AnswerWords<const N: usize = WORDS> {
    /// Number of the page; 0 until the process has set it.
    page: AtomicU64,
    /// Keeps `page`, which does not change, apart from what does.
    _apart: [u64; 15],
    words: [AnswerWord; N],
}

/// A word in a cache line of its own.
#[derive(Debug)]
#[repr(C, align(64))]
struct AnswerWord(AtomicU64);

impl<const N: usize> AnswerWords<N> {
    /// Sets the number of the page, which is not 0.
    pub(crate) fn set_page(&self, page: u64) {
        self.page.store(page, Ordering::Release);
    }

    /// Whether the page has this number, and this word.
    pub(crate) fn has(&self, place: WordPlace) -> bool {
        place.page != 0
            && self.page.load(Ordering::Acquire) == place.page
            && (place.word as usize) < N
    }

    /// Answers the parcel with this token, unless a later parcel in the same word is answered. The caller closes the
    /// parcel's channel afterwards, if at all.
    pub(crate) fn answer(&self, place: WordPlace, token: u64, code: u8) {
        let Some(AnswerWord(word)) = self.words.get(place.word as usize) else {
            return;
        };
        let answer = token.saturating_add(u64::from(code));
        // Mostly wrong, but the exchange gets the cache line for writing at once.
        let mut expected = 0;
        for _ in 0..ATTEMPTS {
            match word.compare_exchange(expected, answer, Ordering::Release, Ordering::Relaxed) {
                Err(found) if found < answer => expected = found,
                _ => break,
            }
        }
        // Before the channel is closed: a sender that finds it closed reads the word once more.
        fence(Ordering::Release);
    }

    /// The code of the answer to the parcel with this token, if it is answered.
    pub(crate) fn code(&self, place: WordPlace, token: u64) -> Option<u8> {
        if place == WordPlace::NONE {
            return None;
        }
        let AnswerWord(word) = self.words.get(place.word as usize)?;
        let code = word.load(Ordering::Acquire).checked_sub(token)?;
        (0 < code && code < STEP).then_some(code as u8)
    }
}

/// The word of a parcel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct WordPlace {
    /// Number of the page; 0 if the parcel has no word.
    pub(crate) page: u64,
    pub(crate) word: u32,
}

impl WordPlace {
    pub(crate) const NONE: Self = Self { page: 0, word: 0 };
}

/// The sender's account of its words.
#[derive(Debug)]
pub(crate) struct LentWords<const N: usize = WORDS> {
    /// Number of the page.
    page: u64,
    /// A bit for each word that is free.
    free: AtomicU64,
    next_token: AtomicU64,
}

impl<const N: usize> LentWords<N> {
    /// All words are free. The random numbers are those of the page and of the first token.
    pub(crate) fn new([page, first]: [u64; 2]) -> Self {
        Self {
            page: page.max(1),
            free: AtomicU64::new(u64::MAX >> (64 - N)),
            // Above the first value of a word, and so small that it does not overflow.
            next_token: AtomicU64::new(((first >> 2) & !(STEP - 1)).max(STEP)),
        }
    }

    pub(crate) fn page(&self) -> u64 {
        self.page
    }

    /// Returns the token of the next parcel, and the word that is lent to it, if one is free.
    pub(crate) fn lend(&self, words: &AnswerWords<N>) -> (u64, WordPlace) {
        let taken = self.take();
        // After the word was taken: tokens of parcels in one word are in the order in which they have it.
        let token = self.token();
        let Some(word) = taken else {
            return (token, WordPlace::NONE);
        };
        let is_smaller = |AnswerWord(word): &AnswerWord| word.load(Ordering::Relaxed) < token;
        if !words.words.get(word as usize).is_some_and(is_smaller) {
            // A faulty process has written it. The word is not lent any more.
            return (token, WordPlace::NONE);
        }
        let page = self.page;
        (token, WordPlace { page, word })
    }

    /// Returns the token of the next parcel, which needs no word.
    pub(crate) fn token(&self) -> u64 {
        self.next_token.fetch_add(STEP, Ordering::Relaxed)
    }

    fn take(&self) -> Option<u32> {
        let mut free = self.free.load(Ordering::Relaxed);
        while free != 0 {
            let rest = free & (free - 1);
            match self
                .free
                .compare_exchange_weak(free, rest, Ordering::Acquire, Ordering::Relaxed)
            {
                Ok(_) => return Some(free.trailing_zeros()),
                Err(now) => free = now,
            }
        }
        None
    }

    /// Takes back a word.
    pub(crate) fn give_back(&self, place: WordPlace) {
        if place != WordPlace::NONE {
            self.free.fetch_or(1 << place.word, Ordering::Release);
        }
    }
}

#[cfg(test)]
impl<const N: usize> Default for AnswerWords<N> {
    fn default() -> Self {
        Self {
            page: AtomicU64::new(0),
            _apart: [0; 15],
            words: std::array::from_fn(|_| AnswerWord(AtomicU64::new(0))),
        }
    }
}
