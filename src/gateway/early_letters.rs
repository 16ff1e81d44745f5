//! Letters that arrive before the directory entry of their sender.
//!
//! Letters and the updates of directories take different ways between hosts, so the first letter of a new agent may
//! overtake its entry.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use fipa_acl::{AgentId, Message};
use fipa_mts::core::Received;
use fipa_transport::Incarnation;

/// Time for which a letter waits for the entry of its sender.
const WAIT: Duration = Duration::from_secs(5);

/// Maximum number of waiting letters.
const MAX_LETTERS: usize = 64;

/// Maximum number of waiting letters of one peer.
const MAX_OF_PEER: usize = 8;

/// Maximum length of a waiting letter, in bytes. Requests to the agents of the gateway are shorter.
const MAX_LEN: usize = 16 * 1024;

/// A sender: its registration, which a legacy peer does not tell, and the name that it claims.
pub(super) type Author = (Incarnation, Option<String>);

/// A letter to an agent of the gateway, with what was read from it.
pub(super) struct Early {
    pub(super) message: Message,
    pub(super) received: Received,
    /// The second name of the agent, if the letter came to that.
    pub(super) asked: Option<AgentId>,
    /// Until when the letter waits for the entry of its sender.
    until: Instant,
}

impl Early {
    pub(super) fn new(
        now: Instant,
        message: Message,
        received: Received,
        asked: Option<AgentId>,
    ) -> Self {
        Self {
            message,
            received,
            asked,
            until: now + WAIT,
        }
    }

    pub(super) fn author(&self) -> Author {
        let name = self.message.sender().map(|id| id.name().to_owned());
        (self.received.sender, name)
    }
}

/// The waiting letters, in the order in which they arrived.
#[derive(Default)]
pub(super) struct EarlyLetters(VecDeque<Early>);

impl EarlyLetters {
    /// Keeps a letter until [`take`](Self::take). Returns false if its time is over, if it is too long, or if too many
    /// letters wait; the letter is then dropped.
    pub(super) fn keep(&mut self, now: Instant, letter: Early) -> bool {
        let peer = &letter.received.peer;
        let of_peer = self.0.iter().filter(|it| it.received.peer == *peer);
        let is_kept = now < letter.until
            && letter.received.letter.len() <= MAX_LEN
            && self.0.len() < MAX_LETTERS
            && of_peer.count() < MAX_OF_PEER;
        if is_kept {
            self.0.push_back(letter);
        }
        is_kept
    }

    /// Takes the letters of an author, because its next letter has arrived.
    pub(super) fn take_of(&mut self, author: &Author) -> VecDeque<Early> {
        let all = self.take().into_iter();
        let (of_author, others) = all.partition(|letter| letter.author() == *author);
        self.0 = others;
        of_author
    }

    /// Takes all letters, because an entry may have arrived or the time of a letter is over.
    pub(super) fn take(&mut self) -> VecDeque<Early> {
        std::mem::take(&mut self.0)
    }

    /// The end of the time of the first letter.
    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        self.0.iter().map(|letter| letter.until).min()
    }
}

#[cfg(test)]
mod tests {
    use std::time::SystemTime;

    use bytes::Bytes;
    use fipa_acl::Performative;
    use fipa_mts::letter_for;
    use fipa_transport::PeerId;

    use super::*;

    #[test]
    fn the_letters_of_an_author_are_taken_in_their_order() {
        let now = Instant::now();
        let mut early = EarlyLetters::default();
        for (sender, content) in [(1, 10), (2, 11), (1, 12)] {
            let mut one = letter(now, 1, content);
            one.received.sender = Incarnation::from_u64(sender);
            assert!(early.keep(now, one));
        }
        let lengths = |letters: VecDeque<Early>| -> Vec<_> {
            let content = |it: &Early| it.message.content().map(Bytes::len);
            letters.iter().map(content).collect()
        };
        assert_eq!(
            lengths(early.take_of(&letter(now, 1, 1).author())),
            [Some(10), Some(12)]
        );
        assert_eq!(lengths(early.take()), [Some(11)]);
    }

    fn letter(at: Instant, peer: u8, content: usize) -> Early {
        let message = Message::builder(Performative::Request)
            .sender(AgentId::new("rover").unwrap())
            .receiver(AgentId::new("df").unwrap())
            .content(vec![b'a'; content])
            .build()
            .unwrap();
        let received = Received {
            letter: letter_for(&message, SystemTime::UNIX_EPOCH).unwrap(),
            sender: Incarnation::from_u64(1),
            via: None,
            service: Incarnation::from_u64(2),
            peer: PeerId::of_ip([192, 0, 2, peer].into()),
            remote: true,
        };
        Early::new(at, message, received, None)
    }

    #[test]
    fn a_letter_waits_for_its_time() {
        let began = Instant::now();
        let mut early = EarlyLetters::default();
        assert_eq!(early.poll_timeout(), None);
        assert!(early.keep(began, letter(began, 1, 10)));
        assert_eq!(early.poll_timeout(), Some(began + WAIT));
        let again = early.take().pop_front().unwrap();
        assert!(early.take().is_empty());
        assert!(early.keep(began + WAIT / 2, again));
        let again = early.take().pop_front().unwrap();
        assert!(!early.keep(began + WAIT, again));
    }

    #[test]
    fn each_peer_has_a_share() {
        let now = Instant::now();
        let mut early = EarlyLetters::default();
        assert!(!early.keep(now, letter(now, 1, MAX_LEN)));
        for peer in 1..=7 {
            for _ in 0..MAX_OF_PEER {
                assert!(early.keep(now, letter(now, peer, 10)));
            }
            assert!(!early.keep(now, letter(now, peer, 10)));
        }
        for _ in 0..MAX_OF_PEER {
            assert!(early.keep(now, letter(now, 8, 10)));
        }
        assert!(!early.keep(now, letter(now, 9, 10)));
        assert_eq!(early.take().len(), MAX_LETTERS);
        assert!(early.keep(now, letter(now, 1, 10)));
    }
}
