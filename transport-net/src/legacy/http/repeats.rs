//! Recognizes repeated letters.
//!
//! JADE sends a request again on a new connection when a connection that it has used before fails.
//! The gateway may have taken the letter of the first request. Two equal letters are therefore one
//! if one of them came first on its connection, and the other was the latest of another connection
//! that had carried letters before. Equal letters in other circumstances are different letters: an
//! agent may send the same message twice within the millisecond of a date.
//!
//! The module reads no clock.

use fipa_transport::quota_address;
use std::collections::{BTreeMap, HashMap, VecDeque};
use std::net::IpAddr;
use std::time::{Duration, Instant};

/// Time for which a letter is remembered; JADE's connections time out after the same time.
const MEMORY: Duration = Duration::from_secs(60);

/// Maximum number of letters that are remembered of one address, and of all.
const MAX_PER_ADDRESS: usize = 256;
const MAX_LETTERS: usize = 4096;

/// The letters that connections carried last.
#[derive(Debug, Default)]
pub(super) struct Repeats {
    letters: HashMap<u64, Remembered>,
    /// Their numbers, oldest first, by address. No queue is empty.
    of_address: HashMap<IpAddr, VecDeque<u64>>,
    /// All numbers, oldest first, with their addresses.
    in_order: BTreeMap<u64, IpAddr>,
    /// The number of the latest letter of each connection that is remembered.
    latest: HashMap<u64, u64>,
    last_number: u64,
}

#[derive(Debug)]
struct Remembered {
    digest: u128,
    connection: u64,
    /// Whether it was the first of its connection.
    first: bool,
    at: Instant,
}

/// A letter that has arrived.
#[derive(Debug, Clone, Copy)]
pub(super) struct Arrived {
    pub(super) digest: u128,
    pub(super) from: IpAddr,
    /// The number of its connection.
    pub(super) connection: u64,
    /// Whether it is the first of its connection.
    pub(super) first: bool,
}

impl Repeats {
    /// Remembers a letter. Returns whether it repeats another one.
    pub(super) fn is_repeat(&mut self, now: Instant, letter: Arrived) -> bool {
        self.forget_old(now);
        let from = quota_address(letter.from);
        if let Some(before) = self.latest.get(&letter.connection).copied() {
            // The client has sent another request, so the answer to the previous one has arrived.
            self.forget(before);
        }
        let repeated = self.of_address.get(&from).is_some_and(|numbers| {
            numbers.iter().any(|number| {
                self.letters.get(number).is_some_and(|other| {
                    other.digest == letter.digest
                        && other.connection != letter.connection
                        && other.first != letter.first
                })
            })
        });
        while self
            .of_address
            .get(&from)
            .is_some_and(|of| of.len() >= MAX_PER_ADDRESS)
            || self.letters.len() >= MAX_LETTERS
        {
            let of_from = self.of_address.get(&from);
            let greedy = of_from.filter(|of| of.len() >= MAX_PER_ADDRESS);
            let oldest = match greedy.and_then(|of| of.front()) {
                Some(oldest) => Some(*oldest),
                None => self.in_order.keys().next().copied(),
            };
            match oldest {
                Some(oldest) => self.forget(oldest),
                None => break,
            }
        }
        self.last_number += 1;
        let number = self.last_number;
        let remembered = Remembered {
            digest: letter.digest,
            connection: letter.connection,
            first: letter.first,
            at: now,
        };
        self.letters.insert(number, remembered);
        self.of_address.entry(from).or_default().push_back(number);
        self.in_order.insert(number, from);
        self.latest.insert(letter.connection, number);
        repeated
    }

    fn forget_old(&mut self, now: Instant) {
        while let Some(number) = self.in_order.keys().next().copied() {
            let is_old = self
                .letters
                .get(&number)
                .is_none_or(|it| now.saturating_duration_since(it.at) >= MEMORY);
            if !is_old {
                return;
            }
            self.forget(number);
        }
    }

    fn forget(&mut self, number: u64) {
        if let Some(remembered) = self.letters.remove(&number)
            && self.latest.get(&remembered.connection) == Some(&number)
        {
            self.latest.remove(&remembered.connection);
        }
        let Some(from) = self.in_order.remove(&number) else {
            return;
        };
        if let Some(numbers) = self.of_address.get_mut(&from) {
            numbers.retain(|other| *other != number);
            if numbers.is_empty() {
                self.of_address.remove(&from);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn letter(digest: u128, connection: u64, first: bool) -> Arrived {
        Arrived {
            digest,
            from: IpAddr::from([10, 0, 0, 1]),
            connection,
            first,
        }
    }

    #[test]
    fn a_letter_on_a_new_connection_repeats_the_latest_of_a_used_one() {
        let (mut repeats, now) = (Repeats::default(), Instant::now());
        assert!(!repeats.is_repeat(now, letter(1, 1, true)));
        assert!(!repeats.is_repeat(now, letter(2, 1, false)));
        assert!(repeats.is_repeat(now, letter(2, 2, true)));
        // In the other order: the first copy waited longer.
        assert!(!repeats.is_repeat(now, letter(3, 3, true)));
        assert!(repeats.is_repeat(now, letter(3, 1, false)));
    }

    #[test]
    fn equal_letters_are_different_ones_in_other_circumstances() {
        let (mut repeats, now) = (Repeats::default(), Instant::now());
        // On one connection.
        assert!(!repeats.is_repeat(now, letter(1, 1, true)));
        assert!(!repeats.is_repeat(now, letter(1, 1, false)));
        assert!(!repeats.is_repeat(now, letter(1, 1, false)));
        // The client has used the connection after the letter.
        assert!(!repeats.is_repeat(now, letter(2, 1, false)));
        assert!(!repeats.is_repeat(now, letter(1, 2, true)));
        // Each on a connection of its own.
        assert!(!repeats.is_repeat(now, letter(3, 3, true)));
        assert!(!repeats.is_repeat(now, letter(3, 4, true)));
        // From another address.
        assert!(!repeats.is_repeat(now, letter(4, 1, false)));
        let elsewhere = Arrived {
            from: IpAddr::from([10, 0, 0, 2]),
            ..letter(4, 5, true)
        };
        assert!(!repeats.is_repeat(now, elsewhere));
        // Too late.
        assert!(!repeats.is_repeat(now + MEMORY, letter(4, 6, true)));
    }

    #[test]
    fn memory_is_bounded_and_an_address_evicts_its_own_letters() {
        let (mut repeats, now) = (Repeats::default(), Instant::now());
        let other = Arrived {
            from: IpAddr::from([10, 0, 0, 2]),
            ..letter(7, 1, false)
        };
        repeats.is_repeat(now, other);
        for connection in 2..2 + 2 * MAX_PER_ADDRESS as u64 {
            repeats.is_repeat(now, letter(connection.into(), connection, true));
        }
        assert_eq!(repeats.letters.len(), MAX_PER_ADDRESS + 1);
        let again = Arrived {
            connection: 9999,
            first: true,
            ..other
        };
        assert!(repeats.is_repeat(now, again));
        for number in 0..2 * MAX_LETTERS as u32 {
            let from = IpAddr::from((number | 0x0b00_0000).to_be_bytes());
            let arrived = letter(number.into(), 10_000 + u64::from(number), true);
            repeats.is_repeat(now, Arrived { from, ..arrived });
        }
        assert_eq!(repeats.letters.len(), MAX_LETTERS);
        assert_eq!(repeats.latest.len(), MAX_LETTERS);
        repeats.forget_old(now + MEMORY);
        assert!(repeats.letters.is_empty() && repeats.in_order.is_empty());
        assert!(repeats.of_address.is_empty() && repeats.latest.is_empty());
    }
}
