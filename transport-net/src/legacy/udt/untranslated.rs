//! Letters that wait for their translation into the dialect of their peer.
//!
//! One task translates the letters of all locations, because a translation may take as long as the
//! runtime's other tasks can wait. The letters of a location keep their order. The locations take
//! turns, so a location with many letters delays another one by one translation.
//!
//! A letter stays in its queue while it is translated.

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;

use bytes::Bytes;
use fipa_acl::Letter;
use fipa_transport::{AttemptId, Location, TransportError};

use super::config::QueueLoad;
use super::too_large;
use crate::legacy::dialect::translate;

/// The letters that wait for their translation.
#[derive(Debug, Default)]
pub(crate) struct Untranslated {
    /// The locations with letters.
    queues: HashMap<Location, Queue>,
    /// The locations with letters in the order of their turns, without the current one.
    turns: VecDeque<Location>,
    /// The location whose first letter is being translated. `None` when that letter was abandoned.
    current: Option<Location>,
    /// Whether the task that translates letters has been started and has not ended.
    is_running: bool,
}

#[derive(Debug, Default)]
struct Queue {
    letters: VecDeque<Waiting>,
    bytes: usize,
}

#[derive(Debug)]
struct Waiting {
    attempt: AttemptId,
    receiver: Arc<str>,
    letter: Letter,
    len: usize,
}

/// A letter to be translated.
#[derive(Debug)]
pub(crate) struct Translation {
    pub(crate) to: Location,
    pub(crate) receiver: Arc<str>,
    pub(crate) letter: Letter,
}

impl Translation {
    /// Returns envelope and message in the dialect of the peer.
    ///
    /// # Errors
    /// When the dialect cannot express the letter, or the result has more bytes than `max`.
    pub(crate) fn run(&self, max: usize) -> Result<[Bytes; 2], TransportError> {
        let pieces = translate(&self.letter, &self.receiver, &self.to, None)
            .map_err(|error| TransportError::new(error.fault(), error))?;
        let len = pieces.iter().map(Bytes::len).sum();
        match len > max {
            true => Err(too_large(len, max)),
            false => Ok(pieces),
        }
    }
}

impl Queue {
    fn remove(&mut self, position: usize) -> Option<Waiting> {
        let removed = self.letters.remove(position)?;
        self.bytes -= removed.len;
        Some(removed)
    }
}

impl Untranslated {
    /// Returns the number of letters that wait for this location, and of their bytes.
    pub(super) fn load(&self, to: &Location) -> QueueLoad {
        let queue = self.queues.get(to);
        queue.map_or_else(QueueLoad::default, |queue| QueueLoad {
            letters: queue.letters.len(),
            bytes: queue.bytes,
        })
    }

    /// Returns the locations with letters.
    pub(crate) fn locations(&self) -> impl Iterator<Item = &Location> {
        self.queues.keys()
    }

    /// Adds a letter. Returns whether the task that translates letters must be started.
    pub(crate) fn push(
        &mut self,
        attempt: AttemptId,
        to: &Location,
        receiver: Arc<str>,
        letter: Letter,
    ) -> bool {
        if !self.queues.contains_key(to) {
            self.turns.push_back(to.clone());
        }
        let queue = self.queues.entry(to.clone()).or_default();
        let len = letter.len();
        queue.bytes += len;
        queue.letters.push_back(Waiting {
            attempt,
            receiver,
            letter,
            len,
        });
        !std::mem::replace(&mut self.is_running, true)
    }

    /// Returns the next letter to be translated. The task ends if there is none; otherwise it calls
    /// [`finish`](Self::finish) after the translation.
    pub(crate) fn begin(&mut self) -> Option<Translation> {
        while let Some(to) = self.turns.pop_front() {
            let queue = self.queues.get(&to);
            if let Some(next) = queue.and_then(|queue| queue.letters.front()) {
                self.current = Some(to.clone());
                return Some(Translation {
                    to,
                    receiver: Arc::clone(&next.receiver),
                    letter: next.letter.clone(),
                });
            }
        }
        self.is_running = false;
        None
    }

    /// Removes the letter that [`begin`](Self::begin) returned. `None` if its attempt has ended.
    pub(crate) fn finish(&mut self) -> Option<(AttemptId, Location)> {
        let to = self.current.take()?;
        let removed = self.queues.get_mut(&to)?.remove(0)?;
        self.take_turn(&to);
        Some((removed.attempt, to))
    }

    /// Removes a letter. Returns whether it was here.
    pub(crate) fn abandon(&mut self, attempt: AttemptId, to: &Location) -> bool {
        let Some(queue) = self.queues.get_mut(to) else {
            return false;
        };
        let mut letters = queue.letters.iter();
        let Some(position) = letters.position(|waiting| waiting.attempt == attempt) else {
            return false;
        };
        queue.remove(position);
        let is_empty = queue.letters.is_empty();
        if position == 0 && self.current.as_ref() == Some(to) {
            self.current = None;
            self.take_turn(to);
        } else if is_empty {
            self.queues.remove(to);
            self.turns.retain(|other| other != to);
        }
        true
    }

    /// Removes all letters, and notes that the task has ended or will get no further letter.
    pub(crate) fn clear(&mut self) -> impl Iterator<Item = AttemptId> {
        let Self { queues, .. } = std::mem::take(self);
        let letters = queues.into_values().flat_map(|queue| queue.letters);
        letters.map(|waiting| waiting.attempt)
    }

    /// Gives a location that is not current another turn, if it has letters.
    fn take_turn(&mut self, to: &Location) {
        match self.queues.get(to) {
            Some(queue) if !queue.letters.is_empty() => self.turns.push_back(to.clone()),
            _ => {
                self.queues.remove(to);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use fipa_transport::Kind;

    use super::*;

    fn location(port: u16) -> Location {
        Location::new(Kind::Udt, &format!("192.0.2.1:{port}")).unwrap()
    }

    fn push(untranslated: &mut Untranslated, attempt: u64, to: u16) -> bool {
        let letter = Letter::new(Bytes::from(vec![0; 10]), Bytes::new());
        untranslated.push(AttemptId(attempt), &location(to), "arm".into(), letter)
    }

    /// Translates all letters. Returns their attempts in that order.
    fn rest(untranslated: &mut Untranslated) -> Vec<u64> {
        let mut attempts = Vec::new();
        while let Some(begun) = untranslated.begin() {
            let (attempt, to) = untranslated.finish().unwrap();
            assert_eq!(begun.to, to);
            attempts.push(attempt.0);
        }
        attempts
    }

    fn assert_empty(untranslated: &Untranslated) {
        assert!(untranslated.queues.is_empty(), "{untranslated:?}");
        assert!(untranslated.turns.is_empty(), "{untranslated:?}");
        assert_eq!(untranslated.current, None);
    }

    #[test]
    fn letters_keep_their_order_and_locations_take_turns() {
        let mut untranslated = Untranslated::default();
        for (attempt, to) in [(1, 1), (2, 1), (3, 1), (4, 2), (5, 3), (6, 2)] {
            let starts = push(&mut untranslated, attempt, to);
            assert_eq!(starts, attempt == 1, "one task");
        }
        let (letters, bytes) = (3, 30);
        assert_eq!(
            untranslated.load(&location(1)),
            QueueLoad { letters, bytes }
        );
        assert_eq!(rest(&mut untranslated), [1, 4, 5, 2, 6, 3]);
        assert_empty(&untranslated);
        assert_eq!(untranslated.load(&location(1)), QueueLoad::default());
        assert!(push(&mut untranslated, 7, 1), "the task has ended");
    }

    #[test]
    fn letters_that_arrive_during_a_translation_wait_behind_it() {
        let mut untranslated = Untranslated::default();
        push(&mut untranslated, 1, 1);
        untranslated.begin().unwrap();
        assert_eq!(
            untranslated.load(&location(1)),
            QueueLoad {
                letters: 1,
                bytes: 10
            },
            "it counts"
        );
        assert!(!push(&mut untranslated, 2, 1));
        assert!(!push(&mut untranslated, 3, 2));
        assert_eq!(untranslated.finish(), Some((AttemptId(1), location(1))));
        assert_eq!(rest(&mut untranslated), [3, 2]);
        assert_empty(&untranslated);
    }

    #[test]
    fn abandoned_letters_leave_wherever_they_wait() {
        let mut untranslated = Untranslated::default();
        for (attempt, to) in [(1, 1), (2, 1), (3, 1), (4, 2)] {
            push(&mut untranslated, attempt, to);
        }
        assert!(!untranslated.abandon(AttemptId(4), &location(1)));
        assert!(!untranslated.abandon(AttemptId(1), &location(9)));
        assert!(untranslated.abandon(AttemptId(2), &location(1)));
        assert!(!untranslated.abandon(AttemptId(2), &location(1)), "once");
        assert!(untranslated.abandon(AttemptId(4), &location(2)));
        assert_eq!(rest(&mut untranslated), [1, 3]);
        assert_empty(&untranslated);
    }

    #[test]
    fn a_letter_that_is_abandoned_during_its_translation_has_no_result() {
        for more in [false, true] {
            let mut untranslated = Untranslated::default();
            push(&mut untranslated, 1, 1);
            if more {
                push(&mut untranslated, 2, 1);
            }
            untranslated.begin().unwrap();
            assert!(untranslated.abandon(AttemptId(1), &location(1)));
            // The same number again is another letter.
            push(&mut untranslated, 1, 1);
            assert_eq!(untranslated.finish(), None);
            let expected: &[u64] = if more { &[2, 1] } else { &[1] };
            assert_eq!(rest(&mut untranslated), expected);
            assert_empty(&untranslated);
        }
    }

    #[test]
    fn all_letters_leave_at_the_end() {
        let mut untranslated = Untranslated::default();
        for (attempt, to) in [(1, 1), (2, 1), (3, 2)] {
            push(&mut untranslated, attempt, to);
        }
        untranslated.begin().unwrap();
        let mut cleared: Vec<_> = untranslated.clear().collect();
        cleared.sort_unstable();
        assert_eq!(cleared, [1, 2, 3].map(AttemptId));
        assert_eq!(untranslated.finish(), None);
        assert_empty(&untranslated);
        assert!(push(&mut untranslated, 4, 1), "another task is needed");
    }
}
