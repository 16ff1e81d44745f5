//! The sending side of a connection: letters, each a message of packets; losses, and the pace
//! (draft-gg-udt-03 section 6.1).
//!
//! The letters themselves are the send buffer: a packet is written from them whenever it is sent.
//!
//! libudt reports a loss once, when a later packet arrives. When that report, or the repeated packet,
//! is lost as well, nothing tells this side but an acknowledgment that stays behind. Then the first
//! unacknowledged packets are sent again: when it is older than a round trip, or when nothing is
//! acknowledged in time.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use bytes::Bytes;
use fipa_transport::{Abandoned, AttemptId, Conclusion, TransportError};

use super::SYN;
use super::config::{QueueLoad, UdtLimits};
use super::packet::{self, Ack, Data, HEADER, IP_AND_UDP, MESSAGES, Position, ReceiverState};
use super::ranges::Ranges;
use super::rate::RateControl;
use super::round_trip::RoundTrip;
use super::sequence;

/// Maximum number of packets in flight: what libudt accepts at most.
const MAX_WINDOW: u32 = 25_600;

/// The smallest window. A receiver without room gets packets that probe for it.
const MIN_WINDOW: u32 = 2;

/// Time by which sending may fall behind its pace and catch up. Timers are that coarse.
const CATCH_UP: Duration = Duration::from_millis(4);

/// One packet of so many is followed by the next at once, as a probe of the capacity.
const PAIR_EVERY: u64 = 16;

/// Shortest and longest time without an acknowledgment after which packets are sent again.
const SHORTEST_TIMEOUT: Duration = Duration::from_millis(60);
const LONGEST_TIMEOUT: Duration = Duration::from_secs(2);

/// Number of packets that are sent again first.
const FIRST_BURST: u64 = 16;

#[derive(Debug)]
pub(crate) struct Sender {
    limits: UdtLimits,
    /// Bytes of a letter per packet.
    payload: usize,
    waiting: VecDeque<Outgoing>,
    /// Letters of which a packet was sent, until all of them are acknowledged.
    begun: VecDeque<Begun>,
    bytes: usize,
    last_message: u32,
    /// The next new packet, and the first unacknowledged one.
    next: u64,
    acked: u64,
    /// Packets to be sent again.
    lost: Ranges,
    /// The last time at which each unacknowledged packet was sent.
    sent_at: VecDeque<Instant>,
    /// Number of packets that the receiver accepts.
    window: u32,
    rate: RateControl,
    round_trip: RoundTrip,
    /// Time of the next packet at the present pace.
    next_send: Option<Instant>,
    /// Timeouts in a row.
    timeouts: u32,
    /// The packets that were last sent again for an acknowledgment that stayed behind end here.
    burst: (u64, u64),
    /// Time of the last acknowledgment of new packets, or of the first packet after a pause.
    progress: Instant,
    concluded: VecDeque<(AttemptId, Conclusion)>,
}

/// A letter to be sent.
#[derive(Debug)]
struct Outgoing {
    /// `None` when the attempt was abandoned.
    attempt: Option<AttemptId>,
    pieces: [Bytes; 2],
}

#[derive(Debug)]
struct Begun {
    outgoing: Outgoing,
    /// The first packet, and the one after the last.
    first: u64,
    end: u64,
    message: u32,
}

impl Outgoing {
    fn len(&self) -> usize {
        self.pieces.iter().map(Bytes::len).sum()
    }
}

impl Sender {
    /// Creates the sender of a connection whose first packet has this number on the wire.
    pub(crate) fn new(limits: UdtLimits, initial: u32, now: Instant) -> Self {
        let first = sequence::first(initial);
        let payload = payload_of(packet::MAX_PACKET);
        Self {
            limits,
            payload,
            waiting: VecDeque::new(),
            begun: VecDeque::new(),
            bytes: 0,
            last_message: 0,
            next: first,
            acked: first,
            lost: Ranges::default(),
            sent_at: VecDeque::new(),
            window: 0,
            rate: RateControl::new(first, payload, MAX_WINDOW),
            round_trip: RoundTrip::default(),
            next_send: None,
            timeouts: 0,
            burst: (0, 0),
            progress: now,
            concluded: VecDeque::new(),
        }
    }

    /// Begins to send, with the packet size and the window of the handshake.
    pub(crate) fn connected(&mut self, max_packet: u32, window: u32, now: Instant) {
        self.payload = payload_of(max_packet);
        self.window = window.clamp(MIN_WINDOW, MAX_WINDOW);
        self.rate = RateControl::new(self.next, self.payload, self.window);
        self.progress = now;
    }

    /// Queues a letter.
    ///
    /// # Errors
    /// When too much is queued.
    pub(crate) fn send(
        &mut self,
        attempt: AttemptId,
        pieces: [Bytes; 2],
    ) -> Result<(), TransportError> {
        let outgoing = Outgoing {
            attempt: Some(attempt),
            pieces,
        };
        let len = outgoing.len();
        self.limits.check_room(self.load(), len)?;
        self.bytes += len;
        self.waiting.push_back(outgoing);
        Ok(())
    }

    /// Returns the number of letters that wait or are not acknowledged, and of their bytes.
    pub(super) fn load(&self) -> QueueLoad {
        QueueLoad {
            letters: self.waiting.len() + self.begun.len(),
            bytes: self.bytes,
        }
    }

    /// Ends an attempt. The letter is not sent if no packet of it was sent.
    pub(crate) fn abandon(&mut self, attempt: AttemptId) -> Abandoned {
        self.concluded.retain(|(other, _)| *other != attempt);
        let position = self
            .waiting
            .iter()
            .position(|it| it.attempt == Some(attempt));
        if let Some(outgoing) = position.and_then(|position| self.waiting.remove(position)) {
            self.bytes -= outgoing.len();
            return Abandoned::NotSent;
        }
        let mut begun = self.begun.iter_mut();
        if let Some(begun) = begun.find(|it| it.outgoing.attempt == Some(attempt)) {
            begun.outgoing.attempt = None;
        }
        Abandoned::Unconfirmed
    }

    /// Whether no letter is queued or in flight.
    pub(crate) fn is_idle(&self) -> bool {
        self.waiting.is_empty() && self.begun.is_empty()
    }

    /// Returns the next conclusion.
    pub(crate) fn poll_concluded(&mut self) -> Option<(AttemptId, Conclusion)> {
        self.concluded.pop_front()
    }

    pub(crate) fn has_concluded(&self) -> bool {
        !self.concluded.is_empty()
    }

    /// Concludes every letter.
    pub(crate) fn end(
        mut self,
        error: &TransportError,
    ) -> impl Iterator<Item = (AttemptId, Conclusion)> {
        let begun = self.begun.into_iter().filter_map(|it| it.outgoing.attempt);
        for attempt in begun {
            let conclusion = Conclusion::Unconfirmed(error.clone());
            self.concluded.push_back((attempt, conclusion));
        }
        for attempt in self.waiting.into_iter().filter_map(|it| it.attempt) {
            let conclusion = Conclusion::NotSent(error.clone());
            self.concluded.push_back((attempt, conclusion));
        }
        self.concluded.into_iter()
    }

    /// Whether the peer has acknowledged nothing for too long, although it is alive.
    pub(crate) fn is_stalled(&self, now: Instant) -> bool {
        self.stalled_at().is_some_and(|at| at <= now)
    }

    /// Handles an acknowledgment. Returns the number of the acknowledgment that this side
    /// acknowledges, or an error for one that cannot be valid.
    pub(crate) fn handle_ack(&mut self, ack: &Ack, now: Instant) -> Result<Option<u32>, Invalid> {
        let next = sequence::near(self.acked, ack.next);
        if next > self.next {
            return Err(Invalid);
        }
        let gained = next.saturating_sub(self.acked);
        if let Some(sent) = gained
            .checked_sub(1)
            .and_then(|last| self.sent_at.get(usize::try_from(last).ok()?))
        {
            let own = now.saturating_duration_since(*sent);
            let theirs = ack.receiver.map(|it| Duration::from_micros(it.rtt.into()));
            self.round_trip
                .measured(theirs.map_or(own, |it| it.min(own)));
        }
        self.acknowledged(next, now);
        let Some(ReceiverState { window, rates, .. }) = ack.receiver else {
            // A narrow acknowledgment does not open the window.
            let gained = u32::try_from(gained).unwrap_or(u32::MAX);
            self.window = self.window.saturating_sub(gained).max(MIN_WINDOW);
            return Ok(None);
        };
        if next == self.acked {
            self.window = window.clamp(MIN_WINDOW, MAX_WINDOW);
        }
        if let Some((arrivals, capacity)) = rates {
            self.rate.measured(arrivals, capacity);
        }
        if gained > 0 {
            self.rate.on_ack(now, self.acked, self.round_trip.mean());
        }
        self.check_first(now);
        Ok(Some(ack.number))
    }

    /// Handles a report of lost packets, from the first to the last of each run.
    pub(crate) fn handle_losses(
        &mut self,
        losses: &[(u32, u32)],
        now: Instant,
    ) -> Result<(), Invalid> {
        let mut first_lost = None;
        for (first, last) in losses {
            let first = sequence::near(self.acked, *first);
            let last = sequence::near(self.acked, *last);
            if first > last || last >= self.next {
                return Err(Invalid);
            }
            if last >= self.acked {
                let first = first.max(self.acked);
                first_lost.get_or_insert(first);
                self.lost.insert(first..last + 1);
            }
        }
        if let Some(first) = first_lost {
            let sent = self.next.saturating_sub(1);
            self.rate.on_loss(first, sent, self.round_trip.mean());
            // Lost packets are sent at once.
            self.next_send = self.next_send.map(|next| next.min(now));
        }
        Ok(())
    }

    /// Appends the next packet. Returns false if there is none now.
    pub(crate) fn poll_packet(
        &mut self,
        now: Instant,
        time: u32,
        to: u32,
        out: &mut Vec<u8>,
    ) -> bool {
        if self.next_send.is_some_and(|next| now < next) {
            return false;
        }
        let sequence = match self.lost.pop_first() {
            Some(lost) => lost,
            None => match self.next_new(now) {
                Some(new) => new,
                None => {
                    self.next_send = None;
                    return false;
                }
            },
        };
        if let Some(sent) = self.place(sequence).and_then(|it| self.sent_at.get_mut(it)) {
            *sent = now;
        }
        let period = match sequence % PAIR_EVERY {
            0 => Duration::ZERO,
            _ => self.rate.period(),
        };
        let earliest = now.checked_sub(CATCH_UP).unwrap_or(now);
        let paced = self.next_send.unwrap_or(now).max(earliest);
        self.next_send = Some(paced + period);
        self.write(sequence, time, to, out)
    }

    /// Returns the length of a packet that is not the last of its letter.
    pub(crate) fn full(&self) -> usize {
        HEADER + self.payload
    }

    /// Returns the time at which something is to be sent or checked.
    pub(crate) fn poll_timeout(&self) -> Option<Instant> {
        let send = match !self.lost.is_empty() || self.has_new() {
            true => self.next_send.or(Some(self.progress)),
            false => None,
        };
        [send, self.times_out_at(), self.stalled_at()]
            .into_iter()
            .flatten()
            .min()
    }

    /// Sends the first unacknowledged packets again if nothing was acknowledged in time.
    pub(crate) fn handle_timeout(&mut self, now: Instant) {
        if self.times_out_at().is_none_or(|at| now < at) {
            return;
        }
        self.timeouts = self.timeouts.saturating_add(1);
        if self.timeouts > 1 {
            self.rate.on_timeout(self.round_trip.mean());
        }
        self.send_again(FIRST_BURST);
    }

    fn in_flight(&self) -> u64 {
        self.next - self.acked
    }

    /// Returns the time at which the packets in flight time out.
    fn times_out_at(&self) -> Option<Instant> {
        if !self.lost.is_empty() {
            return None;
        }
        let sent = *self.sent_at.front()?;
        let timeout = (self.round_trip.timeout() + SYN).max(SHORTEST_TIMEOUT);
        let timeout = timeout.saturating_mul(1 << self.timeouts.min(8));
        Some(sent.max(self.progress) + timeout.min(LONGEST_TIMEOUT))
    }

    fn stalled_at(&self) -> Option<Instant> {
        (self.in_flight() > 0).then(|| self.progress + self.limits.stall_timeout)
    }

    /// Sends the first unacknowledged packet again, with some behind it, if it was sent so long ago
    /// that it must be lost.
    fn check_first(&mut self, now: Instant) {
        let Some(sent) = self.sent_at.front() else {
            return;
        };
        let timeout = (self.round_trip.timeout() + SYN).max(SHORTEST_TIMEOUT / 2);
        if self.lost.contains(self.acked) || now < *sent + timeout {
            return;
        }
        let (end, len) = self.burst;
        // If all packets of the last burst were lost, those behind them probably are, too.
        let len = match self.acked == end {
            true => len.saturating_mul(2),
            false => FIRST_BURST,
        };
        self.send_again(len);
    }

    /// Marks the first unacknowledged packets as lost.
    fn send_again(&mut self, len: u64) {
        let end = self.acked.saturating_add(len).min(self.next);
        self.lost.insert(self.acked..end);
        self.burst = (end, len);
    }

    /// Releases the packets before this one.
    fn acknowledged(&mut self, next: u64, now: Instant) {
        let Some(gained) = next.checked_sub(self.acked).filter(|gained| *gained > 0) else {
            return;
        };
        let gained = usize::try_from(gained).unwrap_or(usize::MAX);
        self.sent_at.drain(..gained.min(self.sent_at.len()));
        self.lost.remove(0..next);
        self.acked = next;
        self.timeouts = 0;
        self.progress = now;
        while let Some(begun) = self.begun.pop_front_if(|begun| begun.end <= next) {
            self.bytes -= begun.outgoing.len();
            if let Some(attempt) = begun.outgoing.attempt {
                self.concluded.push_back((attempt, Conclusion::Handed));
            }
        }
    }

    /// Whether a new packet may be sent.
    fn has_new(&self) -> bool {
        let window = self.window.min(self.rate.window());
        let unfinished = self.begun.back().is_some_and(|begun| begun.end > self.next);
        self.in_flight() < u64::from(window) && (unfinished || !self.waiting.is_empty())
    }

    /// Takes the next new packet.
    fn next_new(&mut self, now: Instant) -> Option<u64> {
        if !self.has_new() {
            return None;
        }
        if self.begun.back().is_none_or(|begun| begun.end <= self.next) {
            let outgoing = self.waiting.pop_front()?;
            let packets = outgoing.len().div_ceil(self.payload).max(1) as u64;
            // Message numbers begin with 1, as those of libudt do.
            self.last_message = self.last_message % (MESSAGES - 1) + 1;
            self.begun.push_back(Begun {
                outgoing,
                first: self.next,
                end: self.next + packets,
                message: self.last_message,
            });
        }
        if self.in_flight() == 0 {
            self.progress = now;
        }
        let new = self.next;
        self.next += 1;
        self.sent_at.push_back(now);
        Some(new)
    }

    /// Returns the index of an unacknowledged packet.
    fn place(&self, sequence: u64) -> Option<usize> {
        usize::try_from(sequence.checked_sub(self.acked)?).ok()
    }

    /// Appends a packet. Returns false if it belongs to no letter.
    fn write(&self, sequence: u64, time: u32, to: u32, out: &mut Vec<u8>) -> bool {
        let after = self.begun.partition_point(|begun| begun.first <= sequence);
        let begun = after.checked_sub(1).and_then(|index| self.begun.get(index));
        let Some(begun) = begun.filter(|begun| sequence < begun.end) else {
            return false;
        };
        let data = Data {
            sequence: sequence::wire(sequence),
            position: Position::of(sequence == begun.first, sequence + 1 == begun.end),
            in_order: true,
            message: begun.message,
            payload: &[],
        };
        packet::put_data(out, &data, time, to);
        let packets = usize::try_from(sequence - begun.first).unwrap_or(usize::MAX);
        let (mut skip, mut remaining) = (packets.saturating_mul(self.payload), self.payload);
        for piece in &begun.outgoing.pieces {
            let part = piece.get(skip..).unwrap_or_default();
            let part = part.get(..remaining).unwrap_or(part);
            out.extend_from_slice(part);
            skip = skip.saturating_sub(piece.len());
            remaining -= part.len();
        }
        true
    }
}

/// A packet of the peer that cannot be valid.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Invalid;

/// Returns the bytes of a letter in a packet of this size with the headers of IP and UDP.
pub(crate) fn payload_of(max_packet: u32) -> usize {
    let packet = max_packet.clamp(packet::MIN_PACKET, packet::MAX_PACKET);
    packet as usize - IP_AND_UDP - HEADER
}

#[cfg(test)]
mod tests {
    use fipa_transport::TransportErrorKind;

    use super::*;

    const TO: u32 = 7;

    fn sender(now: Instant) -> Sender {
        let mut sender = Sender::new(UdtLimits::default(), sequence::LARGEST - 2, now);
        sender.connected(1500, 8192, now);
        sender
    }

    fn sent(sender: &mut Sender, now: Instant) -> Vec<(u32, Position, u32, Vec<u8>)> {
        let mut all = Vec::new();
        loop {
            let mut out = Vec::new();
            if !sender.poll_packet(now, 0, TO, &mut out) {
                return all;
            }
            let Some((TO, packet::Packet::Data(data))) = packet::Packet::read(&out) else {
                panic!("no data");
            };
            assert!(data.in_order);
            all.push((
                data.sequence,
                data.position,
                data.message,
                data.payload.to_vec(),
            ));
        }
    }

    fn letter(len: usize) -> [Bytes; 2] {
        let bytes: Bytes = (0..len).map(|at| (at % 251) as u8).collect();
        let middle = len / 3;
        [bytes.slice(..middle), bytes.slice(middle..)]
    }

    fn ack(number: u32, next: u64, window: u32) -> Ack {
        Ack {
            number,
            next: sequence::wire(next),
            receiver: Some(ReceiverState {
                rtt: 1000,
                rtt_variance: 100,
                window,
                rates: Some((100_000, 1_000_000)),
            }),
        }
    }

    #[test]
    fn a_letter_becomes_a_message_of_full_packets() {
        let now = Instant::now();
        let mut sender = sender(now);
        let first = sequence::first(sequence::LARGEST - 2);
        sender.send(AttemptId(1), letter(3000)).unwrap();
        sender.send(AttemptId(2), letter(1456)).unwrap();
        sender.send(AttemptId(3), letter(1)).unwrap();
        let sent = sent(&mut sender, now);
        let heads: Vec<_> = sent
            .iter()
            .map(|it| (it.0, it.1, it.2, it.3.len()))
            .collect();
        let last = sequence::LARGEST;
        assert_eq!(
            heads,
            [
                (last - 2, Position::First, 1, 1456),
                (last - 1, Position::Middle, 1, 1456),
                (last, Position::Last, 1, 88),
                (0, Position::Only, 2, 1456),
                (1, Position::Only, 3, 1),
            ]
        );
        let whole: Vec<u8> = sent[..3].iter().flat_map(|it| it.3.clone()).collect();
        assert_eq!(whole, letter(3000).concat());
        assert_eq!(
            sender.handle_ack(&ack(1, first + 2, 8192), now),
            Ok(Some(1))
        );
        assert_eq!(sender.poll_concluded(), None);
        assert_eq!(
            sender.handle_ack(&ack(2, first + 4, 8192), now),
            Ok(Some(2))
        );
        assert_eq!(
            sender.poll_concluded(),
            Some((AttemptId(1), Conclusion::Handed))
        );
        assert_eq!(
            sender.poll_concluded(),
            Some((AttemptId(2), Conclusion::Handed))
        );
        assert_eq!(sender.poll_concluded(), None);
        // What was not sent cannot be acknowledged or lost.
        assert_eq!(
            sender.handle_ack(&ack(3, first + 6, 8192), now),
            Err(Invalid)
        );
        assert_eq!(sender.handle_losses(&[(1, 2)], now), Err(Invalid));
    }

    #[test]
    fn lost_packets_are_sent_again_first() {
        let now = Instant::now();
        let mut sender = sender(now);
        let first = sequence::first(sequence::LARGEST - 2);
        sender.send(AttemptId(1), letter(100_000)).unwrap();
        assert_eq!(sent(&mut sender, now).len(), 16, "the first window");
        let number = |offset: u64| sequence::wire(first + offset);
        let lost = [(number(1), number(1)), (number(4), number(6))];
        sender.handle_losses(&lost, now).unwrap();
        // At the pace of the rate control.
        let times = (1..10).map(|it| now + SYN * it);
        let again = times.flat_map(|now| sent(&mut sender, now));
        let again: Vec<u32> = again.map(|it| it.0).collect();
        assert_eq!(again, [number(1), number(4), number(5), number(6)]);
    }

    #[test]
    fn the_window_of_the_receiver_is_kept() {
        let now = Instant::now();
        let mut sender = sender(now);
        let first = sequence::first(sequence::LARGEST - 2);
        sender.send(AttemptId(1), letter(100_000)).unwrap();
        assert_eq!(sent(&mut sender, now).len(), 16);
        sender.handle_ack(&ack(1, first + 16, 5), now).unwrap();
        assert_eq!(sent(&mut sender, now).len(), 5);
        let narrow = Ack {
            receiver: None,
            ..ack(0, first + 20, 0)
        };
        assert_eq!(sender.handle_ack(&narrow, now), Ok(None));
        assert_eq!(sent(&mut sender, now).len(), 1, "of a window of 2");
        // Without room, packets probe for it until the peer counts as stalled.
        sender.handle_ack(&ack(2, first + 20, 0), now).unwrap();
        assert!(!sender.is_stalled(now + Duration::from_secs(9)));
        assert!(sender.is_stalled(now + UdtLimits::default().stall_timeout));
    }

    #[test]
    fn without_acknowledgments_the_first_packets_are_repeated_less_and_less_often() {
        let begun = Instant::now();
        let mut sender = sender(begun);
        sender.send(AttemptId(1), letter(20_000)).unwrap();
        let mut now = begun;
        assert_eq!(sent(&mut sender, now).len(), 14);
        let mut times = Vec::new();
        while now < begun + Duration::from_secs(9) {
            now = sender.poll_timeout().unwrap();
            sender.handle_timeout(now);
            let first = sequence::LARGEST - 2;
            if sent(&mut sender, now).iter().any(|it| it.0 == first) {
                times.push(now - begun);
            }
        }
        let pauses: Vec<Duration> = times.windows(2).map(|pair| pair[1] - pair[0]).collect();
        assert!(times[0] >= SHORTEST_TIMEOUT, "{times:?}");
        assert!(pauses[1] > pauses[0] && *pauses.last().unwrap() <= LONGEST_TIMEOUT + SYN * 20);
        assert!((4..12).contains(&times.len()), "{times:?}");
    }

    #[test]
    fn an_acknowledgment_that_stays_behind_shows_a_loss() {
        let now = Instant::now();
        let mut sender = sender(now);
        let first = sequence::first(sequence::LARGEST - 2);
        sender.send(AttemptId(1), letter(14_560)).unwrap();
        assert_eq!(sent(&mut sender, now).len(), 10);
        sender.handle_ack(&ack(1, first + 3, 8192), now).unwrap();
        let soon = now + Duration::from_millis(5);
        sender.handle_ack(&ack(2, first + 4, 8192), soon).unwrap();
        assert_eq!(sent(&mut sender, soon).len(), 0, "it may be under way");
        let late = now + Duration::from_millis(100);
        sender.handle_ack(&ack(3, first + 5, 8192), late).unwrap();
        assert_eq!(sent(&mut sender, late).len(), 5);
    }

    #[test]
    fn only_letters_that_were_not_begun_can_be_withdrawn() {
        let now = Instant::now();
        let mut sender = sender(now);
        for attempt in 1..=3 {
            sender.send(AttemptId(attempt), letter(30_000)).unwrap();
        }
        assert_eq!(sent(&mut sender, now).len(), 16);
        assert_eq!(sender.abandon(AttemptId(1)), Abandoned::Unconfirmed);
        assert_eq!(sender.abandon(AttemptId(2)), Abandoned::NotSent);
        let error = TransportError::new(TransportErrorKind::Broken, "gone");
        let ended: Vec<_> = sender.end(&error).collect();
        assert_eq!(ended, [(AttemptId(3), Conclusion::NotSent(error))]);
    }
}
