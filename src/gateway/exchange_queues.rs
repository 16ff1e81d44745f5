//! The unread exchange letters of neighbors. No I/O, no clock.
//!
//! Reading a list of agents takes long. The peers take turns, one letter each, and so do the gateways of a peer. So
//! the letters of one peer delay those of another one by one letter, however many there are. A peer whose letters
//! have taken much time waits before its next turn.
//!
//! The queues are bounded by bytes, not by letters: all parts of a list of an honest gateway fit, because a gateway
//! that has to send a list again whenever it exceeds a bound might never complete it. A new list replaces unread
//! letters about earlier ones. Of letters beyond the bounds, the loss is recorded in their place, so that the gateway
//! is asked for all agents again.

use std::collections::{HashMap, VecDeque};
use std::time::{Duration, Instant};

use fipa_sds::{Exchange, LetterKind};
use fipa_transport::{Incarnation, PeerId};

/// Bytes that each letter is charged beside its content.
const PER_LETTER: usize = 1024;

/// Maximum number of unread bytes of one peer. A complete list takes about 3 MiB.
const MAX_OF_PEER: usize = 8 * 1024 * 1024;

/// Maximum number of unread bytes of all peers.
const MAX_TOTAL: usize = 64 * 1024 * 1024;

/// Each peer may take this share of the time of the thread that reads the letters: one part of so many.
const SHARE: u32 = 4;

/// Time in which a peer uses up its share in advance.
const ADVANCE: Duration = Duration::from_secs(8);

/// The unread letters of all peers.
#[derive(Debug, Default)]
pub(super) struct ExchangeQueues {
    queues: HashMap<PeerId, PeerQueue>,
    /// The peers with letters, in the order of their turns.
    turns: VecDeque<PeerId>,
    bytes: usize,
    /// The time until which the past letters of a peer have used up its share, if it is not over.
    used_until: HashMap<PeerId, Instant>,
}

#[derive(Debug, Default)]
struct PeerQueue {
    gateways: HashMap<Incarnation, VecDeque<Unread>>,
    /// The gateways with letters, in the order of their turns.
    turns: VecDeque<Incarnation>,
    bytes: usize,
}

/// A letter to read, or the place of lost ones.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Unread {
    /// The content of a letter.
    Letter(Vec<u8>),
    /// At least one letter was dropped for lack of room.
    Lost,
}

/// The next letter to read.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct NextLetter {
    pub(super) peer: PeerId,
    pub(super) gateway: Incarnation,
    pub(super) unread: Unread,
}

impl ExchangeQueues {
    /// Adds a letter of a gateway, which this peer handed over.
    pub(super) fn push(&mut self, peer: &PeerId, gateway: Incarnation, content: &[u8]) {
        let charged = content.len() + PER_LETTER;
        let queue = self.queues.entry(peer.clone()).or_default();
        if queue.gateways.is_empty() {
            self.turns.push_back(peer.clone());
        }
        if !queue.gateways.contains_key(&gateway) {
            // More are no neighbors.
            if queue.gateways.len() >= Exchange::MAX_NEIGHBORS {
                return;
            }
            queue.turns.push_back(gateway);
        }
        let letters = queue.gateways.entry(gateway).or_default();
        if Exchange::letter_kind(content) == LetterKind::NewList {
            let mut freed = 0;
            letters.retain(|unread| {
                let is_replaced = unread.is_about_list();
                freed += if is_replaced { unread.charge() } else { 0 };
                !is_replaced
            });
            queue.bytes -= freed;
            self.bytes -= freed;
        }
        if queue.bytes + charged > MAX_OF_PEER {
            return lose(letters);
        }
        letters.push_back(Unread::Letter(content.to_vec()));
        queue.bytes += charged;
        self.bytes += charged;
        while self.bytes > MAX_TOTAL && self.drop_latest() {}
    }

    /// Drops the latest letter of a gateway of the peer with most bytes.
    fn drop_latest(&mut self) -> bool {
        let Some(queue) = self.queues.values_mut().max_by_key(|queue| queue.bytes) else {
            return false;
        };
        let mut gateways = queue.gateways.values_mut();
        let Some((letters, at)) = gateways.find_map(|letters| {
            let at = letters.iter().rposition(Unread::is_letter)?;
            Some((letters, at))
        }) else {
            return false;
        };
        let dropped = letters.remove(at);
        let freed = dropped.as_ref().map_or(0, Unread::charge);
        letters.truncate(at);
        lose(letters);
        queue.bytes -= freed;
        self.bytes -= freed;
        true
    }

    /// Returns the next letter, of the peer whose turn it is.
    pub(super) fn poll(&mut self, now: Instant) -> Option<NextLetter> {
        let is_due = |peer: &PeerId| self.due(peer).is_none_or(|due| due <= now);
        let place = self.turns.iter().position(is_due)?;
        let peer = self.turns.remove(place)?;
        let queue = self.queues.get_mut(&peer)?;
        let gateway = queue.turns.pop_front()?;
        let letters = queue.gateways.get_mut(&gateway)?;
        let unread = letters.pop_front();
        match letters.is_empty() {
            true => drop(queue.gateways.remove(&gateway)),
            false => queue.turns.push_back(gateway),
        }
        let freed = unread.as_ref().map_or(0, Unread::charge);
        queue.bytes -= freed;
        self.bytes -= freed;
        match queue.gateways.is_empty() {
            true => drop(self.queues.remove(&peer)),
            false => self.turns.push_back(peer.clone()),
        }
        Some(NextLetter {
            peer,
            gateway,
            unread: unread?,
        })
    }

    /// Returns the time of the next turn, if there are letters.
    pub(super) fn poll_timeout(&self, now: Instant) -> Option<Instant> {
        let turns = self.turns.iter();
        turns.map(|peer| self.due(peer).unwrap_or(now)).min()
    }

    /// Records the time that a letter of this peer took.
    pub(super) fn handle_cost(&mut self, now: Instant, peer: PeerId, cost: Duration) {
        self.used_until.retain(|_, until| *until > now);
        let until = self.used_until.entry(peer).or_insert(now);
        *until += cost * SHARE;
    }

    /// Returns the earliest time of the next turn of a peer that has used its share in advance.
    fn due(&self, peer: &PeerId) -> Option<Instant> {
        let until = self.used_until.get(peer)?;
        until.checked_sub(ADVANCE)
    }
}

fn lose(letters: &mut VecDeque<Unread>) {
    if letters.back() != Some(&Unread::Lost) {
        letters.push_back(Unread::Lost);
    }
}

impl Unread {
    fn is_letter(&self) -> bool {
        matches!(self, Self::Letter(_))
    }

    fn is_about_list(&self) -> bool {
        match self {
            Self::Letter(content) => Exchange::letter_kind(content) != LetterKind::Other,
            Self::Lost => false,
        }
    }

    fn charge(&self) -> usize {
        match self {
            Self::Letter(content) => content.len() + PER_LETTER,
            Self::Lost => 0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn peer(number: u8) -> PeerId {
        PeerId::of_ip([10, 0, 0, number].into())
    }

    fn gateway(number: u64) -> Incarnation {
        Incarnation::from_u64(number)
    }

    /// A letter with changes.
    fn changes(number: usize) -> Vec<u8> {
        format!(r#"{{"version":1,"tell":{{"changes":{{"from":{number},"to":{number}}}}}}}"#)
            .into_bytes()
    }

    fn list(version: usize, first: bool) -> Vec<u8> {
        let text = format!(
            r#"{{"version":1,"tell":{{"full":{{"version":{version},"first":{first},"last":true,"agents":[]}}}}}}"#
        );
        text.into_bytes()
    }

    /// Returns the gateways and letters in the order in which they are read.
    fn read_all(queues: &mut ExchangeQueues, now: Instant) -> Vec<(u64, Unread)> {
        let next = || queues.poll(now);
        std::iter::from_fn(next)
            .map(|next| (next.gateway.as_u64(), next.unread))
            .collect()
    }

    #[test]
    fn a_flood_of_one_peer_delays_the_letters_of_others_by_one_letter() {
        let (mut queues, now) = (ExchangeQueues::default(), Instant::now());
        // The flood comes from many gateways of one peer.
        for number in 0..5000 {
            queues.push(&peer(1), gateway(100 + number % 200), &changes(1));
        }
        for number in [1, 2] {
            queues.push(&peer(2), gateway(2), &changes(number));
            queues.push(&peer(3), gateway(3), &changes(number));
        }
        let order = read_all(&mut queues, now);
        assert_eq!(order.len(), 5004);
        for (from, places) in [(2, [1, 4]), (3, [2, 5])] {
            for (place, number) in places.into_iter().zip([1, 2]) {
                assert_eq!(order[place], (from, Unread::Letter(changes(number))));
            }
        }
        assert_eq!((queues.bytes, queues.poll_timeout(now)), (0, None));
    }

    #[test]
    fn a_new_list_replaces_unread_letters_about_lists_of_the_same_gateway() {
        let (mut queues, now) = (ExchangeQueues::default(), Instant::now());
        let again = br#"{"version":1,"tell":"again"}"#;
        let other = changes(5);
        queues.push(&peer(1), gateway(8), &other);
        for content in [&list(1, true)[..], &list(1, false), &changes(1), again] {
            queues.push(&peer(1), gateway(7), content);
        }
        queues.push(&peer(1), gateway(7), &list(2, true));
        queues.push(&peer(1), gateway(7), &changes(2));
        let of = |content: &[u8]| Unread::Letter(content.to_vec());
        let expected = [
            (8, of(&other)),
            (7, of(again)),
            (7, of(&list(2, true))),
            (7, of(&changes(2))),
        ];
        assert_eq!(read_all(&mut queues, now), expected);
        assert_eq!(queues.bytes, 0);
    }

    #[test]
    fn letters_beyond_the_bounds_are_lost_in_their_place_and_others_are_not_affected() {
        let (mut queues, now) = (ExchangeQueues::default(), Instant::now());
        let large = vec![b' '; Exchange::MAX_CONTENT];
        queues.push(&peer(200), gateway(200), &changes(1));
        for number in 1..=20 {
            for _ in 0..20 {
                queues.push(&peer(number), gateway(number.into()), &large);
            }
        }
        assert!(queues.bytes <= MAX_TOTAL);
        queues.push(&peer(201), gateway(201), &changes(1));
        assert!(queues.bytes <= MAX_TOTAL);
        let order = read_all(&mut queues, now);
        for honest in [200, 201] {
            let of: Vec<_> = order.iter().filter(|(from, _)| *from == honest).collect();
            assert_eq!(of, [&(honest, Unread::Letter(changes(1)))]);
        }
        for number in 1..=20 {
            let mut of = order.iter().filter(|(from, _)| *from == number);
            assert_eq!(of.next_back(), Some(&(number, Unread::Lost)));
            assert!(of.all(|(_, unread)| unread.is_letter()));
        }
        assert_eq!(queues.bytes, 0);
    }

    #[test]
    fn a_peer_whose_letters_take_long_waits_and_delays_no_other_one() {
        let (mut queues, began) = (ExchangeQueues::default(), Instant::now());
        let (mut now, mut read) = (began, 0);
        let cost = Duration::from_millis(500);
        while now < began + Duration::from_secs(100) {
            queues.push(&peer(1), gateway(1), &changes(1));
            match queues.poll(now) {
                Some(next) => {
                    now += cost;
                    queues.handle_cost(now, next.peer, cost);
                    read += 1;
                }
                None => {
                    // Another peer has its turn at once.
                    queues.push(&peer(2), gateway(2), &changes(1));
                    assert_eq!(queues.poll(now).unwrap().peer, peer(2));
                    let due = queues.poll_timeout(now).unwrap();
                    assert!(due > now);
                    now = due;
                }
            }
        }
        // A quarter of the time, and what it may use in advance.
        assert!((50..60).contains(&read), "{read}");
    }
}
