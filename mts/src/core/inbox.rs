//! The receiving end: an agent's queue, and the state of each sender that makes letters be taken
//! once and in order.

use std::collections::{HashMap, VecDeque};
use std::net::IpAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_acl::Letter;
use fipa_transport::{
    Answer, FailureReason, Hop, Incarnation, Kind, Location, PeerId, Principal, Realm, Stream,
};

use super::label::Label;
use super::rules::{self, Offer};
use super::{CoreConfig, MAX_DEADLINE, work};
use crate::gate::{LetterSource, Link};
use crate::{AccessGate, LetterParts};

/// A letter taken from an agent's queue.
#[derive(Debug, Clone)]
pub struct Received {
    /// The letter.
    pub letter: Letter,
    /// The incarnation of the sending agent; unknown for an agent of a legacy peer, and for letters
    /// of this process itself.
    pub sender: Incarnation,
    /// The transport of its last hop; `None` for letters of this process itself.
    pub via: Option<Kind>,
    /// The service that handed it over, as it introduced itself; unknown for letters of this
    /// process itself and of a legacy peer.
    pub service: Incarnation,
    /// The peer that handed it over, as far as the link proves it.
    pub peer: PeerId,
    /// Whether that service is on another host, as far as its link proves; see [`Hop::is_remote`].
    pub remote: bool,
}

/// An agent of this process.
#[derive(Debug)]
pub(crate) struct Inbox {
    pub(crate) name: Arc<str>,
    queue: VecDeque<Received>,
    bound: usize,
    /// Bytes of the letters in the queue, without failure messages.
    bytes: usize,
    bytes_bound: usize,
    /// Number of remembered letters of one sender: as many as it can have open.
    recent: usize,
    /// With a keyed hash, because untrusted peers choose these keys, tens of thousands of them.
    senders: HashMap<(Realm, Incarnation), SenderState>,
    /// Number of senders of each certificate.
    certified: HashMap<Realm, usize>,
    /// Streams that were told that the queue is full and wait for a credit, in order.
    waiting: VecDeque<(Stream, Location)>,
    /// Failure messages in the queue, which do not count against its bound.
    failures: usize,
    next_sweep: Option<Instant>,
    pub(crate) next_sequence: u64,
}

/// State of one sender: distinguishes a letter that was taken from one that was passed over.
#[derive(Debug)]
struct SenderState {
    last: u64,
    recent: VecDeque<u64>,
    seen: Instant,
}

/// Maximum number of senders of one agent. A sender is kept until every letter of it has passed its
/// deadline, so this bounds the number of incarnations that may send within an hour.
const MAX_SENDERS: usize = 65_536;
/// Number of these places for which certificates compete: each may take another one while it has fewer senders than
/// are free there, so one alone gets half of them, and the next one less. Its holder may invent senders.
const CERTIFIED_SENDERS: usize = MAX_SENDERS / 2;
/// Number of senders that each certificate may have while any place is free.
const SENDERS_OF_SMALL: usize = 256;
/// Maximum number of streams that wait for a credit. Further streams get none, and retry after a
/// pause.
const MAX_WAITING: usize = 4096;
/// Maximum number of failure messages in a queue, which do not count against its limit.
const MAX_FAILURES: usize = 256;

impl Inbox {
    pub(crate) fn new(name: Arc<str>, config: &CoreConfig) -> Self {
        Self {
            name,
            queue: VecDeque::new(),
            bound: config.queue,
            bytes: 0,
            bytes_bound: config.queue_bytes,
            recent: config.lane,
            senders: HashMap::new(),
            certified: HashMap::new(),
            waiting: VecDeque::new(),
            failures: 0,
            next_sweep: None,
            next_sequence: 1,
        }
    }

    /// Puts a letter into the queue, or returns the reason why not. Asks the gate as well, which
    /// has read the letter.
    pub(crate) fn accept(
        &mut self,
        now: Instant,
        label: &Label,
        letter: Letter,
        (via, from): (Kind, &Hop),
        gate: Option<(&dyn AccessGate, Option<&LetterParts>)>,
    ) -> Answer {
        let (stream, sequence) = (label.stream, label.sequence);
        let len = letter.len();
        let has_room = self.has_room(len);
        // Looked up once: the keyed hash takes a tenth of the time of an arrival.
        let mut taken = match stream.sender.is_known() {
            true => self.senders.get_mut(&(stream.realm, stream.sender)),
            false => None,
        };
        if stream.sender.is_known() {
            let last = taken.as_ref().map_or(0, |taken| taken.last);
            let offer = rules::offer(last, sequence, label.after);
            if let Some(taken) = &mut taken {
                taken.seen = now;
                if offer == Offer::Earlier {
                    return taken.answer_again(sequence, self.recent);
                }
            }
            if offer == Offer::OutOfOrder {
                return Answer::OutOfOrder { last };
            }
        }
        if !has_room {
            self.wait(stream, &from.location);
            return Answer::Busy;
        }
        if let Some((gate, parts)) = gate
            && let Err(why) = ask(gate, now, &self.name, parts, link_of(via, from))
        {
            return Answer::failed(FailureReason::Refused, why);
        }
        match taken {
            Some(taken) => taken.take(sequence, self.recent),
            None if stream.sender.is_known() => {
                if let Err(refusal) = self.remember(now, &stream, sequence) {
                    return refusal;
                }
            }
            None => {}
        }
        self.bytes += len;
        self.queue.push_back(Received {
            letter,
            sender: stream.sender,
            via: Some(via),
            service: from.location.incarnation(),
            peer: PeerId::of(from.principal, Some(&from.location)),
            remote: from.is_remote(),
        });
        Answer::Accepted
    }

    /// Whether there is room for a letter of this many bytes. An empty queue accepts any letter.
    fn has_room(&self, len: usize) -> bool {
        let letters = self.queue.len() - self.failures;
        let fits = self.bytes.saturating_add(len) <= self.bytes_bound;
        letters < self.bound && (fits || letters == 0)
    }

    /// Puts a letter without a stream, whose sender cannot wait, into the queue if there is room.
    pub(crate) fn push_unframed(&mut self, letter: Letter, via: Kind, from: IpAddr) -> bool {
        if !self.has_room(letter.len()) {
            return false;
        }
        self.bytes += letter.len();
        self.queue.push_back(Received {
            letter,
            sender: Incarnation::UNKNOWN,
            via: Some(via),
            service: Incarnation::UNKNOWN,
            peer: PeerId::of_ip(from),
            remote: true,
        });
        true
    }

    /// Puts a failure message into the queue. Some fit beyond its limit; an agent that does not
    /// read may miss failures.
    pub(crate) fn push_failure(&mut self, letter: Letter) -> bool {
        if self.failures >= MAX_FAILURES {
            return false;
        }
        self.failures += 1;
        self.queue.push_back(Received {
            letter,
            sender: Incarnation::UNKNOWN,
            via: None,
            service: Incarnation::UNKNOWN,
            peer: PeerId::THIS_HOST,
            remote: false,
        });
        true
    }

    pub(crate) fn take(&mut self) -> Option<Received> {
        let received = self.queue.pop_front()?;
        match received.via {
            None => self.failures -= 1,
            Some(_) => self.bytes -= received.letter.len(),
        }
        Some(received)
    }

    pub(crate) fn len(&self) -> usize {
        self.queue.len()
    }

    /// Streams to notify of room: none before the queue is half empty, so that a full queue does
    /// not cost one credit per letter.
    pub(crate) fn credits(&mut self) -> impl Iterator<Item = (Stream, Location)> {
        let used = self.queue.len() - self.failures;
        let room = if used * 2 <= self.bound && self.bytes <= self.bytes_bound / 2 {
            self.bound - used
        } else {
            0
        };
        self.waiting.drain(..room.min(self.waiting.len()))
    }

    /// All waiting streams, because the agent is going away.
    pub(crate) fn all_waiting(&mut self) -> impl Iterator<Item = (Stream, Location)> {
        self.waiting.drain(..)
    }

    fn wait(&mut self, stream: Stream, back: &Location) {
        work::steps(self.waiting.len());
        let waits_already = self.waiting.iter().any(|(other, _)| *other == stream);
        if !waits_already && self.waiting.len() < MAX_WAITING {
            self.waiting.push_back((stream, back.clone()));
        }
    }

    /// Remembers the first letter of a sender.
    fn remember(&mut self, now: Instant, stream: &Stream, sequence: u64) -> Result<(), Answer> {
        // Not for each letter while there are too many senders: it visits all of them.
        if self.next_sweep.is_none_or(|due| due <= now) {
            self.forget_old(now);
        }
        if !self.has_place(stream.realm) {
            return Err(Answer::failed(
                FailureReason::Refused,
                "too many senders have written within the longest deadline",
            ));
        }
        let mut state = SenderState {
            last: 0,
            recent: VecDeque::new(),
            seen: now,
        };
        state.take(sequence, self.recent);
        self.senders.insert((stream.realm, stream.sender), state);
        if stream.realm != Realm::UNPROVED {
            *self.certified.entry(stream.realm).or_default() += 1;
        }
        Ok(())
    }

    /// Whether there is a place for another sender of this realm.
    fn has_place(&self, realm: Realm) -> bool {
        if self.senders.len() >= MAX_SENDERS {
            return false;
        }
        if realm == Realm::UNPROVED {
            return true;
        }
        let of_realm = self.certified.get(&realm).copied().unwrap_or_default();
        if of_realm < SENDERS_OF_SMALL {
            return true;
        }
        let taken: usize = self.certified.values().sum();
        of_realm < CERTIFIED_SENDERS.saturating_sub(taken)
    }

    /// Drops senders that can no longer have a letter in transit.
    fn forget_old(&mut self, now: Instant) {
        // Twice, because a letter's remaining time does not include its time in transit.
        work::steps(self.senders.len());
        let memory = MAX_DEADLINE * 2;
        self.senders
            .retain(|_, taken| now.saturating_duration_since(taken.seen) < memory);
        self.certified.clear();
        for (realm, _) in self.senders.keys() {
            if *realm != Realm::UNPROVED {
                *self.certified.entry(*realm).or_default() += 1;
            }
        }
        self.next_sweep = Some(now + Duration::from_secs(60));
    }
}

/// Asks a gate about a letter that it has read. It refuses one that it has not read.
pub(super) fn ask(
    gate: &dyn AccessGate,
    now: Instant,
    receiver: &str,
    parts: Option<&LetterParts>,
    link: Link,
) -> Result<(), String> {
    match parts {
        Some(parts) => gate.admits(now, receiver, parts, link),
        None => Err("the access gate has not read the letter".to_owned()),
    }
}

/// The link of a letter that this service handed over by this kind of transport.
pub(super) fn link_of(via: Kind, from: &Hop) -> Link {
    Link {
        via,
        service: from.location.incarnation(),
        user: match from.principal {
            Principal::User(user) => Some(user),
            _ => None,
        },
        source: LetterSource::of(from),
    }
}

impl SenderState {
    /// Records a letter that is taken. The last `bound` letters are remembered.
    fn take(&mut self, sequence: u64, bound: usize) {
        self.last = sequence;
        if self.recent.len() >= bound {
            self.recent.pop_front();
        }
        self.recent.push_back(sequence);
    }

    /// Answers a copy of a letter that was taken or passed over before. The last `bound` letters
    /// are remembered.
    fn answer_again(&self, sequence: u64, bound: usize) -> Answer {
        if self.recent.binary_search(&sequence).is_ok() {
            return Answer::Accepted;
        }
        let forgotten = self.recent.len() >= bound && self.recent.front() > Some(&sequence);
        if forgotten {
            Answer::failed(FailureReason::Unconfirmed, "too long ago to tell")
        } else {
            Answer::failed(
                FailureReason::Refused,
                "later letters were taken before this one",
            )
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn label(sequence: u64, after: u64) -> Label {
        Label {
            receiver: "b".into(),
            stream: Stream::between(Incarnation::from_u64(1), Incarnation::from_u64(2)),
            sequence,
            after,
            transfer: 0,
            remaining: Duration::from_secs(1),
        }
    }

    fn inbox(bound: usize) -> Inbox {
        let config = CoreConfig {
            queue: bound,
            ..CoreConfig::new("mts", Incarnation::from_u64(9), Vec::new())
        };
        Inbox::new("b".into(), &config)
    }

    fn back() -> Hop {
        Hop {
            location: "shm://1#0000000000000001".parse().unwrap(),
            principal: Principal::Host,
        }
    }

    fn offer(inbox: &mut Inbox, sequence: u64, after: u64) -> Answer {
        let label = label(sequence, after);
        inbox.accept(
            Instant::now(),
            &label,
            Letter::default(),
            (Kind::Shm, &back()),
            None,
        )
    }

    #[test]
    fn letters_are_taken_in_order_and_copies_once() {
        let mut inbox = inbox(10);
        assert_eq!(offer(&mut inbox, 5, 3), Answer::OutOfOrder { last: 0 });
        assert_eq!(offer(&mut inbox, 3, 0), Answer::Accepted);
        assert_eq!(offer(&mut inbox, 9, 5), Answer::OutOfOrder { last: 3 });
        assert_eq!(offer(&mut inbox, 5, 3), Answer::Accepted);
        assert_eq!(offer(&mut inbox, 3, 0), Answer::Accepted);
        assert_eq!(offer(&mut inbox, 9, 5), Answer::Accepted);
        assert_eq!(inbox.len(), 3);
    }

    /// Another host may have chosen the registration of a sender for an agent of its own.
    #[test]
    fn a_registration_in_two_realms_is_two_senders() {
        let mut inbox = inbox(10);
        for realm in [7, 0, 8, 7] {
            let mut label = label(1, 0);
            label.stream.realm = Realm::from_u64(realm);
            let hop = (Kind::Shm, &back());
            let answer = inbox.accept(Instant::now(), &label, Letter::default(), hop, None);
            assert_eq!(answer, Answer::Accepted);
        }
        assert_eq!(inbox.len(), 3, "one is a copy");
    }

    #[cfg(debug_assertions)]
    #[test]
    fn letters_of_too_many_senders_visit_them_once_a_minute() {
        let mut inbox = inbox(2 * MAX_SENDERS);
        let began = Instant::now();
        let mut offer = |sender: usize, seconds: u64| {
            let mut label = label(1, 0);
            label.stream.sender = Incarnation::from_u64(1 + sender as u64);
            let at = began + Duration::from_secs(seconds);
            let hop = (Kind::Shm, &back());
            inbox.accept(at, &label, Letter::default(), hop, None)
        };
        let refused = |answer| matches!(answer, Answer::Failed { .. });
        for sender in 0..MAX_SENDERS {
            assert_eq!(offer(sender, 0), Answer::Accepted);
        }
        assert!(refused(offer(MAX_SENDERS, 61)));
        let _ = work::taken();
        for sender in 0..1000 {
            assert!(refused(offer(MAX_SENDERS + sender, 62)));
        }
        assert!(work::taken() < 1000);
        // Known senders are not refused, and new ones are accepted when old ones are forgotten.
        assert_eq!(offer(7, 62), Answer::Accepted);
        let forgotten = MAX_DEADLINE.as_secs() * 2;
        assert_eq!(offer(MAX_SENDERS, forgotten), Answer::Accepted);
        assert!(!refused(offer(7, forgotten)));
    }

    #[test]
    fn a_certificate_that_invents_senders_leaves_places_for_others() {
        let mut inbox = inbox(2 * MAX_SENDERS);
        let now = Instant::now();
        let mut is_accepted = |realm: u64, sender: usize| {
            let mut label = label(1, 0);
            label.stream.realm = Realm::from_u64(realm);
            label.stream.sender = Incarnation::from_u64(1 + sender as u64);
            let hop = (Kind::Shm, &back());
            inbox.accept(now, &label, Letter::default(), hop, None) == Answer::Accepted
        };
        let of_certificate = |realm, is_accepted: &mut dyn FnMut(u64, usize) -> bool| {
            (0..2 * MAX_SENDERS)
                .take_while(|sender| is_accepted(realm, *sender))
                .count()
        };
        assert_eq!(of_certificate(7, &mut is_accepted), CERTIFIED_SENDERS / 2);
        let of_next = of_certificate(8, &mut is_accepted);
        assert!((1000..=CERTIFIED_SENDERS / 4).contains(&of_next));
        for realm in 100..200 {
            assert!(is_accepted(realm, 0), "a certificate with one sender");
        }
        for sender in 0..CERTIFIED_SENDERS / 2 {
            assert!(is_accepted(0, sender), "an agent of this host");
        }
    }

    #[test]
    fn a_letter_that_was_passed_over_is_refused() {
        let mut inbox = inbox(10);
        assert_eq!(offer(&mut inbox, 7, 0), Answer::Accepted);
        let late = offer(&mut inbox, 6, 0);
        assert!(
            matches!(
                late,
                Answer::Failed {
                    reason: FailureReason::Refused,
                    ..
                }
            ),
            "{late:?}"
        );
        assert_eq!(inbox.len(), 1);
    }

    #[test]
    fn a_letter_that_is_too_old_to_remember_is_unconfirmed() {
        let mut inbox = inbox(2000);
        let recent = inbox.recent as u64;
        for sequence in 1..=recent + 1 {
            assert_eq!(offer(&mut inbox, sequence, sequence - 1), Answer::Accepted);
        }
        let old = offer(&mut inbox, 1, 0);
        assert!(
            matches!(
                old,
                Answer::Failed {
                    reason: FailureReason::Unconfirmed,
                    ..
                }
            ),
            "{old:?}"
        );
    }

    #[test]
    fn a_full_queue_answers_busy_and_gives_credit_when_half_empty() {
        let mut inbox = inbox(4);
        for sequence in 1..=4 {
            assert_eq!(offer(&mut inbox, sequence, 0), Answer::Accepted);
        }
        assert_eq!(offer(&mut inbox, 5, 4), Answer::Busy);
        assert_eq!(offer(&mut inbox, 5, 4), Answer::Busy);
        assert!(
            inbox.push_failure(Letter::default()),
            "a failure message fits beyond the limit"
        );
        inbox.take();
        assert_eq!(inbox.credits().count(), 0);
        inbox.take();
        assert_eq!(
            inbox.credits().count(),
            1,
            "one stream waits, however often it asked"
        );
        assert_eq!(inbox.credits().count(), 0);
        assert_eq!(offer(&mut inbox, 5, 4), Answer::Accepted);
    }

    #[test]
    fn the_number_of_failure_messages_is_bounded() {
        let mut inbox = inbox(1);
        let taken = (0..1000)
            .filter(|_| inbox.push_failure(Letter::default()))
            .count();
        assert_eq!(taken, MAX_FAILURES);
        assert_eq!(offer(&mut inbox, 1, 0), Answer::Accepted);
    }
}
