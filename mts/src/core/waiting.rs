//! Letters that wait until the directory has been refreshed, because their receiver is not in the
//! view of the directory; and letters that wait for the next leader of a coalition.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Instant;

use fipa_acl::Letter;
use fipa_transport::Incarnation;

use super::CoreConfig;
use super::ids::SubmissionId;
use crate::Map;

/// A letter that was sent and whose receivers are to be resolved.
#[derive(Debug)]
pub(super) struct Unresolved {
    pub(super) submission: SubmissionId,
    pub(super) sender: Incarnation,
    pub(super) letter: Letter,
    pub(super) receivers: Vec<Arc<str>>,
    pub(super) deadline: Instant,
}

/// The letters that wait, in the order in which they were sent. Letters of one sender stay in
/// order: later ones wait behind an earlier one, even if their receivers are in the view.
#[derive(Debug, Default)]
pub(super) struct WaitingLetters {
    /// Each with the number of the refresh that it waits for; 0 for the next leader of a coalition.
    letters: VecDeque<(u64, Unresolved)>,
    /// Letters and bytes of each sender.
    senders: Map<Incarnation, (usize, usize)>,
}

impl WaitingLetters {
    pub(super) fn is_empty(&self) -> bool {
        self.letters.is_empty()
    }

    /// Whether a letter of this sender waits.
    pub(super) fn has_any_of(&self, sender: Incarnation) -> bool {
        self.senders.contains_key(&sender)
    }

    /// Whether another letter of the sender may wait: the limits are those of a lane.
    pub(super) fn has_room(&self, sender: Incarnation, len: usize, config: &CoreConfig) -> bool {
        let (letters, bytes) = self.senders.get(&sender).copied().unwrap_or_default();
        letters < config.lane && bytes.saturating_add(len) <= config.lane_bytes
    }

    pub(super) fn push(&mut self, number: u64, letter: Unresolved) {
        let (letters, bytes) = self.senders.entry(letter.sender).or_default();
        *letters += 1;
        *bytes += letter.letter.len();
        self.letters.push_back((number, letter));
    }

    /// Removes the first letter if it waits for this refresh or an earlier one.
    pub(super) fn pop(&mut self, number: u64) -> Option<Unresolved> {
        let (of_first, _) = self.letters.front()?;
        if *of_first > number {
            return None;
        }
        let (_, letter) = self.letters.pop_front()?;
        self.uncount(&letter);
        Some(letter)
    }

    /// Removes the letters for which this holds.
    pub(super) fn remove(&mut self, goes: impl Fn(&Unresolved) -> bool) -> Vec<Unresolved> {
        if self.is_empty() {
            return Vec::new();
        }
        let (gone, stay) = std::mem::take(&mut self.letters)
            .into_iter()
            .partition::<VecDeque<_>, _>(|(_, letter)| goes(letter));
        self.letters = stay;
        let gone: Vec<Unresolved> = gone.into_iter().map(|(_, letter)| letter).collect();
        for letter in &gone {
            self.uncount(letter);
        }
        gone
    }

    /// The earliest deadline.
    pub(super) fn due(&self) -> Option<Instant> {
        self.letters.iter().map(|(_, letter)| letter.deadline).min()
    }

    fn uncount(&mut self, letter: &Unresolved) {
        if let Some((letters, bytes)) = self.senders.get_mut(&letter.sender) {
            *letters -= 1;
            *bytes -= letter.letter.len();
            if *letters == 0 {
                self.senders.remove(&letter.sender);
            }
        }
    }
}
