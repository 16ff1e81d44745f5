//! Access rules: which letters gateways and receiving processes accept.

use std::sync::Arc;
use std::time::Instant;

use fipa_acl::Letter;
use fipa_mts::{AccessGate, LetterParts, Link};
use fipa_transport::TokenBucket;
use parking_lot::Mutex;

use super::Set;

/// Letters that some gate refused, by number and receiver.
pub(super) type Refused = Arc<Mutex<Set<(u64, Arc<str>)>>>;

/// The access rules of one process.
pub(super) struct Rules {
    pub(super) seed: u64,
    /// Fraction of letters that are refused.
    pub(super) share: f64,
    /// Names whose letters are refused temporarily.
    pub(super) denied: Vec<Denied>,
    /// Maximum number of letters per second, and the end of that limit.
    pub(super) rate: Option<(f64, Instant)>,
    /// Whether letters without a number, which are those of hostile members, are accepted. Not
    /// where agents read slowly: queues full of them would count as a failure of the core.
    pub(super) strangers: bool,
    pub(super) taken: Mutex<Option<TokenBucket>>,
    pub(super) refused: Refused,
}

/// Temporarily refuses all letters for one name.
#[derive(Debug, Clone)]
pub(super) struct Denied {
    pub(super) name: Arc<str>,
    pub(super) from: Instant,
    pub(super) until: Instant,
}

impl Rules {
    fn refuses(&self, now: Instant, receiver: &str, number: u64) -> Option<&'static str> {
        let share = fastrand::Rng::with_seed(self.seed ^ number.wrapping_mul(0x9e37_79b9)).f64();
        if share < self.share {
            return Some("this letter is refused");
        }
        let mut denied = self.denied.iter();
        if denied.any(|it| *it.name == *receiver && (it.from..it.until).contains(&now)) {
            return Some("this receiver is denied");
        }
        let (rate, until) = self.rate?;
        let mut taken = self.taken.lock();
        let taken = taken.get_or_insert_with(|| TokenBucket::new(rate, now));
        let refused = now < until && !taken.take(1.0, rate, now);
        refused.then_some("too many letters")
    }
}

impl AccessGate for Rules {
    /// The rules of the simulation are about the numbers of letters.
    fn read(&self, letter: &Letter) -> LetterParts {
        LetterParts {
            action: number_of(letter).map(|number| number.to_string()),
            ..LetterParts::default()
        }
    }

    fn admits(
        &self,
        now: Instant,
        receiver: &str,
        letter: &LetterParts,
        _: Link,
    ) -> Result<(), String> {
        let number = letter.action.as_ref().and_then(|it| it.parse().ok());
        let Some(number) = number else {
            return match self.strangers {
                true => Ok(()),
                false => Err("strangers are refused".to_owned()),
            };
        };
        match self.refuses(now, receiver, number) {
            None => Ok(()),
            Some(why) => {
                self.refused.lock().insert((number, receiver.into()));
                Err(why.to_owned())
            }
        }
    }
}

/// The content of the letter with this number, at least this long.
pub(super) fn content_of(number: u64, size: usize) -> Vec<u8> {
    let mut content = format!("<<{number}>>").into_bytes();
    content.resize(size.max(content.len()), b'.');
    content
}

/// The number of a letter, at the beginning of its content.
pub(super) fn number_of(letter: &Letter) -> Option<u64> {
    let payload = letter.payload();
    let bytes = match payload.is_split() {
        true => &payload.content,
        false => &payload.head,
    };
    number_in(bytes)
}

/// The number of the letter with this content, or with this content anywhere in its message.
pub(super) fn number_in(bytes: &[u8]) -> Option<u64> {
    let start = bytes.windows(2).position(|window| window == b"<<")? + 2;
    let digits = bytes[start..].split(|byte| *byte == b'>').next()?;
    std::str::from_utf8(digits).ok()?.parse().ok()
}
