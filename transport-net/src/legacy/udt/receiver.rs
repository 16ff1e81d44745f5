//! The receiving side of a connection: packets to letters, loss reports and acknowledgments
//! (draft-gg-udt-03 section 6.2).
//!
//! Packets in sequence are appended to their letter as they arrive; packets behind a gap are held
//! back. All messages are delivered in order, also those that need not be.
//!
//! The length of a letter is unknown until its last packet arrives. A connection holds a few packets
//! without a reservation. For more it reserves the memory of the largest letter at once, so that two
//! letters never wait for each other; until it has the reservation, packets are dropped, and the peer
//! sends them again.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;

use super::SYN;
use super::arrivals::Arrivals;
use super::config::UdtLimits;
use super::packet::{Ack, Control, Data, Position, ReceiverState};
use super::ranges::Ranges;
use super::round_trip::RoundTrip;
use super::sender::payload_of;
use super::sequence;
use crate::rate_limit::PeerRateLimit;
use crate::stream::budget::{Meter, ReservedBytes};
use crate::stream::config::NetLimits;

/// Bytes that a connection holds without a reservation.
const UNRESERVED: usize = 64 << 10;

/// Maximum number of bytes that are held back behind a gap.
const MAX_HELD: usize = 4 << 20;

/// Memory of a packet that is held back, beside its payload.
const HELD_OVERHEAD: usize = 128;

/// Number of packets that the handshake announces, as libudt does. The receiver accepts fewer when
/// it has less memory.
pub(crate) const WINDOW: u32 = 8192;

/// Number of bytes of a letter that is too large whose envelope is read for the failure message.
const BEGINNING: usize = 64 << 10;

/// The smallest window in an acknowledgment. Smaller ones could stop the peer for ever.
const MIN_WINDOW: u32 = 2;

/// A narrow acknowledgment is sent after so many packets.
const NARROW_EVERY: u32 = 64;

/// Number of sent acknowledgments that are remembered.
const MAX_ACKS: usize = 64;

/// Longest time between two acknowledgments of the same packets.
const LONGEST_REPEAT: Duration = Duration::from_millis(300);

/// Shortest time between two reports of the same loss.
const SHORTEST_REPORT: Duration = Duration::from_millis(30);

/// Maximum number of runs in one loss report.
const MAX_RUNS: usize = 150;

/// A letter that has arrived, with the reservation of its memory.
#[derive(Debug)]
pub(crate) struct Arrived {
    pub(crate) bytes: Bytes,
    pub(crate) _room: Option<ReservedBytes>,
}

/// The result of a packet that was dropped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Dropped {
    /// It arrived before.
    Duplicate,
    /// The receiver has no room for it, or the peer exceeds its rate.
    NoRoom,
}

#[derive(Debug)]
pub(crate) struct Receiver {
    limits: UdtLimits,
    /// Bytes per full packet.
    payload: usize,
    /// The next packet in sequence, and the one after the highest that arrived.
    next: u64,
    end: u64,
    /// Packets behind a gap, and their memory.
    held: BTreeMap<u64, Held>,
    held_bytes: usize,
    /// Packets of messages that the peer gave up.
    skipped: Ranges,
    /// The gaps, by their first packet.
    gaps: BTreeMap<u64, Gap>,
    report_at: Option<Instant>,
    /// The letter whose packets arrive now.
    letter: Option<Incomplete>,
    room: Option<ReservedBytes>,
    meter: Meter,
    rate_limit: Option<Arc<PeerRateLimit>>,
    /// No packets are accepted before this time.
    paused_until: Option<Instant>,
    arrived: VecDeque<Arrived>,
    /// The beginnings of letters that were larger than allowed.
    too_large: VecDeque<Bytes>,
    /// Letters that were larger than allowed, and messages that were incomplete.
    pub(crate) refused: u64,
    acks: Acks,
    arrivals: Arrivals,
    round_trip: RoundTrip,
    control: VecDeque<Control>,
    /// Bytes that have arrived, and their number at the beginning of the measuring period.
    bytes: u64,
    period: Option<(Instant, u64)>,
}

#[derive(Debug)]
struct Held {
    position: Position,
    message: u32,
    payload: Box<[u8]>,
}

/// Packets that are missing.
#[derive(Debug)]
struct Gap {
    end: u64,
    reported: Instant,
    reports: u32,
}

#[derive(Debug)]
struct Incomplete {
    message: u32,
    bytes: Vec<u8>,
}

/// The acknowledgments of a receiver.
#[derive(Debug)]
struct Acks {
    last_number: u32,
    /// The packets before this one are acknowledged, and the peer has confirmed so for these.
    acked: u64,
    confirmed: u64,
    /// The next acknowledgment.
    due: Option<Instant>,
    /// The last one that contained rates.
    rates_at: Option<Instant>,
    /// Acknowledgments of the same packets in a row.
    repeats: u32,
    /// Packets since the last one.
    packets: u32,
    /// Number, packet and time of those whose confirmation has not arrived.
    sent: VecDeque<(u32, u64, Instant)>,
}

impl Receiver {
    /// Creates the receiver of a connection whose first packet has this number on the wire.
    pub(crate) fn new(
        limits: UdtLimits,
        initial: u32,
        max_packet: u32,
        rate_limit: Option<Arc<PeerRateLimit>>,
        meter: Meter,
    ) -> Self {
        let first = sequence::first(initial);
        Self {
            limits,
            payload: payload_of(max_packet),
            next: first,
            end: first,
            held: BTreeMap::new(),
            held_bytes: 0,
            skipped: Ranges::default(),
            gaps: BTreeMap::new(),
            report_at: None,
            letter: None,
            room: None,
            meter,
            rate_limit,
            paused_until: None,
            arrived: VecDeque::new(),
            too_large: VecDeque::new(),
            refused: 0,
            acks: Acks {
                last_number: 0,
                acked: first,
                confirmed: first,
                due: None,
                rates_at: None,
                repeats: 0,
                packets: 0,
                sent: VecDeque::new(),
            },
            arrivals: Arrivals::default(),
            round_trip: RoundTrip::default(),
            control: VecDeque::new(),
            bytes: 0,
            period: None,
        }
    }

    /// Handles a packet.
    pub(crate) fn handle_data(&mut self, data: &Data<'_>, now: Instant) -> Result<(), Dropped> {
        self.arrivals.note(now, data.sequence);
        let sequence = sequence::near(self.next, data.sequence);
        if sequence < self.next
            || self.held.contains_key(&sequence)
            || self.skipped.contains(sequence)
        {
            // The acknowledgment was lost, or the peer is impatient.
            self.acks.confirmed = self.acks.confirmed.min(self.acks.acked.saturating_sub(1));
            self.acknowledge_at(now + SYN);
            return Err(Dropped::Duplicate);
        }
        let ahead = sequence - self.next;
        if self.is_paused(now) || ahead >= u64::from(WINDOW) || !self.has_room_for(data, ahead, now)
        {
            return Err(Dropped::NoRoom);
        }
        self.bytes = self.bytes.saturating_add(data.payload.len() as u64);
        if ahead > 0 {
            self.hold(sequence, data, now);
        } else {
            self.append(data.position, data.message, data.payload, now);
            self.next += 1;
            self.advance(now);
        }
        self.note_gaps(sequence, sequence + 1, now);
        self.acks.packets += 1;
        // A short packet ends a letter.
        let ends = data.payload.len() < self.payload;
        self.acknowledge_at(if ends { now } else { now + SYN });
        if self.acks.packets >= NARROW_EVERY && !ends {
            self.acks.packets = 0;
            self.control.push_back(Control::Ack(Ack {
                number: 0,
                next: sequence::wire(self.next),
                receiver: None,
            }));
        }
        self.release();
        Ok(())
    }

    /// Handles the notice that the peer has given up a message.
    pub(crate) fn handle_drop(&mut self, message: u32, first: u32, last: u32, now: Instant) {
        let first = sequence::near(self.next, first);
        let last = sequence::near(self.next, last);
        let limit = self.next + u64::from(WINDOW);
        if last < self.next || first > last || last >= limit {
            return;
        }
        let first = first.max(self.next);
        if self.letter.as_ref().is_some_and(|it| it.message == message) {
            self.letter = None;
            self.refused += 1;
        }
        let dropped: Vec<u64> = self.held.range(first..=last).map(|(at, _)| *at).collect();
        for sequence in dropped {
            if let Some(held) = self.held.remove(&sequence) {
                self.held_bytes -= held.payload.len() + HELD_OVERHEAD;
            }
        }
        self.note_gaps(first, last + 1, now);
        self.skipped.insert(first..last + 1);
        self.advance(now);
        self.acknowledge_at(now);
        self.release();
    }

    /// Handles the confirmation of an acknowledgment.
    pub(crate) fn handle_ack2(&mut self, number: u32, now: Instant) {
        let sent = &mut self.acks.sent;
        if let Some(index) = sent.iter().position(|(other, ..)| *other == number)
            && let Some((_, next, at)) = sent.drain(..=index).next_back()
        {
            self.round_trip.measured(now.saturating_duration_since(at));
            self.acks.confirmed = self.acks.confirmed.max(next);
        }
    }

    /// Returns the next letter.
    pub(crate) fn poll_arrived(&mut self) -> Option<Arrived> {
        self.arrived.pop_front()
    }

    /// Returns the beginning of the next letter that was larger than allowed: its sender gets a failure
    /// message.
    pub(crate) fn poll_too_large(&mut self) -> Option<Bytes> {
        self.too_large.pop_front()
    }

    pub(crate) fn has_arrived(&self) -> bool {
        !self.arrived.is_empty() || !self.too_large.is_empty()
    }

    /// Whether no part of a letter has arrived.
    pub(crate) fn is_idle(&self) -> bool {
        self.letter.is_none() && self.held.is_empty()
    }

    /// Returns the next packet to be sent.
    pub(crate) fn poll_control(&mut self, now: Instant) -> Option<Control> {
        if let Some(control) = self.control.pop_front() {
            return Some(control);
        }
        if self.report_at.is_some_and(|at| at <= now) {
            self.report_at = None;
            if let Some(report) = self.report(now) {
                return Some(report);
            }
        }
        if self.acks.due.is_some_and(|due| due <= now) {
            self.acks.due = None;
            return self.ack(now);
        }
        None
    }

    /// Returns the time at which something is to be sent or checked.
    pub(crate) fn poll_timeout(&self) -> Option<Instant> {
        let due = [
            self.acks.due,
            self.report_at,
            self.paused_until,
            self.period
                .map(|(begun, _)| begun + self.limits.stall_timeout),
        ];
        due.into_iter().flatten().min()
    }

    /// Handles the timers that are due. Returns whether the letter that is arriving arrives too
    /// slowly.
    pub(crate) fn handle_timeout(&mut self, now: Instant) -> bool {
        if self.paused_until.is_some_and(|until| until <= now) {
            self.paused_until = None;
            self.open_window(now);
        }
        let Some((begun, before)) = self.period else {
            return false;
        };
        if now < begun + self.limits.stall_timeout {
            return false;
        }
        let least = self.room.as_ref().map_or(0, ReservedBytes::least_progress);
        let progress = self.bytes - before;
        self.period = Some((now, self.bytes));
        progress < least.max(NetLimits::MIN_PROGRESS)
    }

    fn is_paused(&self, now: Instant) -> bool {
        self.paused_until.is_some_and(|until| now < until)
    }

    /// Whether there is memory for a packet; reserves it if necessary.
    fn has_room_for(&mut self, data: &Data<'_>, ahead: u64, _now: Instant) -> bool {
        let len = data.payload.len();
        if ahead > 0 && self.held_bytes + len + HELD_OVERHEAD > MAX_HELD {
            return false;
        }
        let letter = self.letter.as_ref().map_or(0, |it| it.bytes.len());
        if self.room.is_none() && letter + self.held_bytes + len + HELD_OVERHEAD > UNRESERVED {
            // Another packet of the peer asks again.
            self.room = self.meter.take(self.limits.max_letter + MAX_HELD);
            return self.room.is_some();
        }
        true
    }

    fn hold(&mut self, sequence: u64, data: &Data<'_>, now: Instant) {
        self.held_bytes += data.payload.len() + HELD_OVERHEAD;
        let held = Held {
            position: data.position,
            message: data.message,
            payload: data.payload.into(),
        };
        self.held.insert(sequence, held);
        self.progress_from(now);
    }

    /// Appends a packet in sequence to its letter.
    fn append(&mut self, position: Position, message: u32, payload: &[u8], now: Instant) {
        if position.begins() {
            if self.letter.take().is_some() {
                // Its other packets never come.
                self.refused += 1;
            }
            self.letter = Some(Incomplete {
                message,
                bytes: Vec::new(),
            });
        }
        let Some(letter) = self.letter.as_mut().filter(|it| it.message == message) else {
            return;
        };
        let len = letter.bytes.len() + payload.len();
        if len > self.limits.max_letter {
            tracing::debug!(
                max = self.limits.max_letter,
                "a letter exceeds max_letter and is dropped"
            );
            let beginning = letter.bytes.iter().chain(payload).take(BEGINNING);
            let beginning: Vec<u8> = beginning.copied().collect();
            self.too_large.push_back(beginning.into());
            self.letter = None;
            self.refused += 1;
            return;
        }
        if len > letter.bytes.capacity() {
            let more = letter.bytes.capacity().max(payload.len());
            let most = self.limits.max_letter - letter.bytes.len();
            letter.bytes.reserve_exact(more.min(most));
        }
        letter.bytes.extend_from_slice(payload);
        if !position.ends() {
            self.progress_from(now);
            return;
        }
        if let Some(letter) = self.letter.take() {
            if let Some(until) = self
                .rate_limit
                .as_ref()
                .and_then(|limit| limit.spend(1, letter.bytes.len(), now))
            {
                self.paused_until = Some(until);
            }
            // The reservation goes with the letter, unless packets behind it still need it.
            let keeps = self.held_bytes > UNRESERVED;
            self.arrived.push_back(Arrived {
                bytes: letter.bytes.into(),
                _room: if keeps { None } else { self.room.take() },
            });
        }
    }

    /// Appends the packets that are in sequence now.
    fn advance(&mut self, now: Instant) {
        loop {
            if let Some(held) = self.held.remove(&self.next) {
                self.held_bytes -= held.payload.len() + HELD_OVERHEAD;
                self.append(held.position, held.message, &held.payload, now);
            } else if self.skipped.first() == Some(self.next) {
                self.skipped.pop_first();
            } else {
                return;
            }
            self.next += 1;
        }
    }

    /// Notes the arrival of packets: a gap in front of them, and the end of gaps that they fill.
    fn note_gaps(&mut self, first: u64, end: u64, now: Instant) {
        if first > self.end {
            let gap = Gap {
                end: first,
                reported: now,
                reports: 1,
            };
            self.gaps.insert(self.end, gap);
            let run = (sequence::wire(self.end), sequence::wire(first - 1));
            self.control.push_back(Control::Loss(vec![run]));
            self.schedule_report(now);
        }
        self.end = self.end.max(end);
        while let Some((start, its_end)) = self
            .gaps
            .range(..end)
            .next_back()
            .map(|(start, gap)| (*start, gap.end))
            .filter(|(_, its_end)| *its_end > first)
        {
            let Some(gap) = self.gaps.remove(&start) else {
                break;
            };
            let Gap {
                reported, reports, ..
            } = gap;
            let part = |end| Gap {
                end,
                reported,
                reports,
            };
            if its_end > end {
                self.gaps.insert(end, part(its_end));
            }
            if start < first {
                self.gaps.insert(start, part(first));
            }
        }
        if self.gaps.is_empty() {
            self.report_at = None;
        }
    }

    /// Returns the time after which a loss is reported again. It increases with each report.
    fn report_after(&self, reports: u32) -> Duration {
        let timeout = (self.round_trip.timeout() + SYN).max(SHORTEST_REPORT);
        timeout * reports.saturating_add(1).min(16)
    }

    fn schedule_report(&mut self, now: Instant) {
        let due = now + self.report_after(1);
        self.report_at = Some(self.report_at.map_or(due, |before| before.min(due)));
    }

    /// Reports losses again that the peer has not repaired in time.
    fn report(&mut self, now: Instant) -> Option<Control> {
        let mut runs = Vec::new();
        let timeout = self.report_after(1) / 2;
        let mut next: Option<Instant> = None;
        for (start, gap) in &mut self.gaps {
            let due = gap.reported + timeout * gap.reports.saturating_add(1).min(16);
            let due = if due <= now && runs.len() < MAX_RUNS {
                runs.push((sequence::wire(*start), sequence::wire(gap.end - 1)));
                gap.reported = now;
                gap.reports = gap.reports.saturating_add(1);
                now + timeout * gap.reports.saturating_add(1).min(16)
            } else {
                due.max(now + SYN)
            };
            next = Some(next.map_or(due, |next| next.min(due)));
        }
        self.report_at = next;
        (!runs.is_empty()).then_some(Control::Loss(runs))
    }

    fn acknowledge_at(&mut self, at: Instant) {
        self.acks.due = Some(self.acks.due.map_or(at, |before| before.min(at)));
    }

    /// Tells the peer that there is room again.
    fn open_window(&mut self, now: Instant) {
        self.acks.confirmed = self.acks.confirmed.min(self.acks.acked.saturating_sub(1));
        self.acknowledge_at(now);
    }

    /// Returns the acknowledgment that is due, unless the peer has confirmed it already.
    fn ack(&mut self, now: Instant) -> Option<Control> {
        if self.acks.confirmed >= self.next {
            return None;
        }
        let is_new = self.acks.acked < self.next;
        let acks = &mut self.acks;
        acks.repeats = if is_new {
            0
        } else {
            acks.repeats.saturating_add(1)
        };
        acks.acked = self.next;
        acks.packets = 0;
        acks.last_number = acks.last_number.wrapping_add(1) & sequence::LARGEST;
        if acks.sent.len() >= MAX_ACKS {
            acks.sent.pop_front();
        }
        acks.sent.push_back((acks.last_number, self.next, now));
        let number = acks.last_number;
        let repeat = self.round_trip.timeout() * (1 << acks.repeats.min(5));
        acks.due = Some(now + repeat.min(LONGEST_REPEAT));
        let rates = acks.rates_at.is_none_or(|at| now >= at + SYN).then(|| {
            acks.rates_at = Some(now);
            self.arrivals.rates()
        });
        let micros = |time: Duration| u32::try_from(time.as_micros()).unwrap_or(u32::MAX);
        Some(Control::Ack(Ack {
            number,
            next: sequence::wire(self.next),
            receiver: Some(ReceiverState {
                rtt: micros(self.round_trip.mean()),
                rtt_variance: micros(self.round_trip.variance()),
                window: self.window(now),
                rates,
            }),
        }))
    }

    /// Returns the number of packets that there is room for.
    fn window(&self, now: Instant) -> u32 {
        if self.is_paused(now) {
            return MIN_WINDOW;
        }
        let letter = self.letter.as_ref().map_or(0, |it| it.bytes.len());
        let bytes = match &self.room {
            Some(_) => MAX_HELD.saturating_sub(self.held_bytes),
            // The reservation is made when packets need it.
            None if letter + self.held_bytes < UNRESERVED / 2 => MAX_HELD,
            None => UNRESERVED.saturating_sub(letter + self.held_bytes),
        };
        let packets = bytes / (self.payload + HELD_OVERHEAD);
        u32::try_from(packets)
            .unwrap_or(WINDOW)
            .clamp(MIN_WINDOW, WINDOW)
    }

    /// Begins a measuring period, unless one has begun.
    fn progress_from(&mut self, now: Instant) {
        self.period.get_or_insert((now, self.bytes));
    }

    /// Releases the reservation, and ends the measuring period, when nothing is incomplete.
    fn release(&mut self) {
        if self.is_idle() {
            self.room = None;
            self.period = None;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::packet::MAX_PACKET;
    use super::*;
    use crate::rate_limit::{PeerRateLimits, Rates};
    use crate::stream::budget::{BudgetLimits, ByteBudget};
    use crate::stream::source::{Home, QuotaKey};

    const FULL: usize = 1456;

    /// The first packet of the tests; the numbers wrap around after a few.
    const INITIAL: u32 = sequence::LARGEST - 3;

    fn limits() -> UdtLimits {
        UdtLimits {
            max_letter: 300_000,
            ..UdtLimits::default()
        }
    }

    fn budget() -> BudgetLimits {
        BudgetLimits {
            total: 20 << 20,
            each: 6 << 20,
        }
    }

    fn receiver_of(budget: &ByteBudget, process: i32, rates: Rates) -> Receiver {
        let meter = budget.meter(QuotaKey::Unproved(Home::Process(process)), self::budget());
        let ip = [192, 0, 2, 1].into();
        let rate_limit = PeerRateLimits::default().of(ip, rates, Instant::now());
        Receiver::new(limits(), INITIAL, MAX_PACKET, rate_limit, meter)
    }

    fn receiver() -> Receiver {
        let unlimited = Rates {
            letters: 0,
            bytes: 0,
        };
        receiver_of(&ByteBudget::default(), 1, unlimited)
    }

    fn data(offset: u32, position: Position, message: u32, payload: &[u8]) -> Data<'_> {
        Data {
            sequence: (INITIAL + offset) & sequence::LARGEST,
            position,
            in_order: true,
            message,
            payload,
        }
    }

    /// The packets of a message.
    fn message(first: u32, message: u32, bytes: &[u8]) -> Vec<Data<'_>> {
        let count = bytes.len().div_ceil(FULL) as u32;
        let parts = bytes.chunks(FULL).zip(0..);
        parts
            .map(|(part, at)| {
                let position = Position::of(at == 0, at + 1 == count);
                data(first + at, position, message, part)
            })
            .collect()
    }

    fn letters(receiver: &mut Receiver) -> Vec<Bytes> {
        std::iter::from_fn(|| receiver.poll_arrived())
            .map(|it| it.bytes)
            .collect()
    }

    fn controls(receiver: &mut Receiver, now: Instant) -> Vec<Control> {
        std::iter::from_fn(|| receiver.poll_control(now)).collect()
    }

    #[test]
    fn packets_in_any_order_become_letters_in_order() {
        let (one, other): (Vec<u8>, Vec<u8>) = (vec![1; 5000], vec![2; 3000]);
        let mut packets = message(0, 1, &one);
        packets.extend(message(4, 2, &other));
        packets.extend(message(7, 3, b"x"));
        let mut random = fastrand::Rng::with_seed(5);
        for _ in 0..50 {
            random.shuffle(&mut packets);
            let (mut receiver, now) = (receiver(), Instant::now());
            for packet in &packets {
                receiver.handle_data(packet, now).unwrap();
            }
            assert_eq!(letters(&mut receiver), [&one[..], &other, b"x"]);
            for packet in &packets {
                let again = receiver.handle_data(packet, now);
                assert_eq!(again, Err(Dropped::Duplicate));
            }
            assert!(receiver.is_idle() && receiver.gaps.is_empty());
            assert_eq!((receiver.held_bytes, receiver.end), (0, receiver.next));
        }
    }

    #[test]
    fn a_gap_is_reported_at_once_and_again_until_it_is_filled() {
        let (mut receiver, begun) = (receiver(), Instant::now());
        let bytes = vec![7; 8 * FULL];
        let packets = message(0, 1, &bytes);
        receiver.handle_data(&packets[0], begun).unwrap();
        receiver.handle_data(&packets[5], begun).unwrap();
        let wire = |offset: usize| packets[offset].sequence;
        let report = |from, to| Control::Loss(vec![(wire(from), wire(to))]);
        assert_eq!(controls(&mut receiver, begun)[0], report(1, 4));
        receiver.handle_data(&packets[2], begun).unwrap();
        let mut now = begun;
        let mut reports = 0;
        while reports < 3 {
            now = receiver.poll_timeout().unwrap().max(now);
            receiver.handle_timeout(now);
            for control in controls(&mut receiver, now) {
                if let Control::Loss(runs) = control {
                    assert_eq!(runs, [(wire(1), wire(1)), (wire(3), wire(4))]);
                    reports += 1;
                }
            }
        }
        for offset in [1, 3, 4] {
            receiver.handle_data(&packets[offset], now).unwrap();
        }
        assert_eq!(receiver.report_at, None);
    }

    #[test]
    fn an_acknowledgment_is_repeated_until_it_is_confirmed() {
        let (mut receiver, mut now) = (receiver(), Instant::now());
        receiver.handle_data(&message(0, 1, b"x")[0], now).unwrap();
        let (mut last, mut sent) = (None, now);
        for _ in 0..10 {
            let [Control::Ack(ack)] = controls(&mut receiver, now)[..] else {
                panic!("no acknowledgment");
            };
            assert_eq!(ack.next, (INITIAL + 1) & sequence::LARGEST);
            assert!(last.is_none_or(|last| last < ack.number));
            last = Some(ack.number);
            sent = now;
            now = receiver.poll_timeout().unwrap();
        }
        let trip = Duration::from_millis(1);
        receiver.handle_ack2(last.unwrap(), sent + trip);
        assert_eq!(controls(&mut receiver, now), []);
        assert_eq!(receiver.poll_timeout(), None);
        assert_eq!(receiver.round_trip.mean(), trip);
    }

    #[test]
    fn messages_that_the_peer_gave_up_are_skipped() {
        let (mut receiver, now) = (receiver(), Instant::now());
        let (one, other) = (vec![1; 5 * FULL], vec![2; 2 * FULL]);
        let (first, second) = (message(0, 1, &one), message(5, 2, &other));
        receiver.handle_data(&first[0], now).unwrap();
        receiver.handle_data(&first[3], now).unwrap();
        for packet in &second {
            receiver.handle_data(packet, now).unwrap();
        }
        receiver.handle_drop(1, first[0].sequence, first[4].sequence, now);
        assert_eq!(letters(&mut receiver), [&other[..]]);
        assert!(receiver.is_idle() && receiver.gaps.is_empty());
        // Of packets that never came, too; not of packets far ahead.
        receiver.handle_drop(3, INITIAL + 7, INITIAL + 9, now);
        receiver.handle_drop(4, INITIAL + 10, INITIAL + WINDOW + 10, now);
        receiver.handle_data(&message(10, 5, b"x")[0], now).unwrap();
        assert_eq!(letters(&mut receiver), [&b"x"[..]]);
    }

    #[test]
    fn letters_beyond_the_limit_and_parts_without_a_beginning_are_dropped() {
        let (mut receiver, now) = (receiver(), Instant::now());
        let (large, fits) = (vec![0; 300_001], vec![3; 300_000]);
        let packets = message(0, 1, &large);
        let count = packets.len() as u32;
        for packet in packets.iter().chain(&message(count, 2, &fits)) {
            receiver.handle_data(packet, now).unwrap();
            receiver.poll_control(now);
        }
        let last = 2 * count;
        let tail = data(last, Position::Last, 9, b"tail");
        receiver.handle_data(&tail, now).unwrap();
        assert_eq!(letters(&mut receiver), [&fits[..]]);
        assert_eq!(receiver.refused, 1);
        assert_eq!(receiver.poll_too_large().unwrap(), large[..BEGINNING]);
        assert_eq!(receiver.poll_too_large(), None);
    }

    #[test]
    fn large_letters_of_one_source_take_turns() {
        let (byte_budget, now) = (ByteBudget::default(), Instant::now());
        let unlimited = || Rates {
            letters: 0,
            bytes: 0,
        };
        let mut receivers = [1, 1, 2].map(|it| receiver_of(&byte_budget, it, unlimited()));
        let bytes = vec![4; 200_000];
        let packets = message(0, 1, &bytes);
        let mut positions = [0; 3];
        for _ in 0..packets.len() * 4 {
            for (receiver, position) in receivers.iter_mut().zip(&mut positions) {
                if let Some(packet) = packets.get(*position)
                    && receiver.handle_data(packet, now).is_ok()
                {
                    *position += 1;
                }
            }
        }
        let done = |positions: [usize; 3]| positions.map(|it| it == packets.len());
        assert_eq!(done(positions), [true, false, true]);
        assert!(positions[1] > UNRESERVED / FULL / 2);
        assert_eq!(letters(&mut receivers[0]), [&bytes[..]]);
        let [_, second, _] = &mut receivers;
        for packet in &packets[positions[1]..] {
            second.handle_data(packet, now).unwrap();
        }
        assert_eq!(letters(second), [&bytes[..]]);
        letters(&mut receivers[2]);
        assert_eq!(byte_budget.taken(), 0);
    }

    #[test]
    fn what_is_held_back_is_bounded_and_a_slow_letter_ends_the_connection() {
        let (mut receiver, now) = (receiver(), Instant::now());
        let payload = vec![0; FULL];
        let mut held = 0;
        for offset in 1..2 * WINDOW {
            let packet = data(offset, Position::Middle, 1, &payload);
            held += usize::from(receiver.handle_data(&packet, now).is_ok());
        }
        assert_eq!(held, MAX_HELD / (FULL + HELD_OVERHEAD));
        assert_eq!(receiver.window(now), MIN_WINDOW);
        let later = now + limits().stall_timeout;
        assert!(!receiver.handle_timeout(later));
        assert!(receiver.handle_timeout(later + limits().stall_timeout));
    }

    #[test]
    fn a_peer_beyond_its_rate_is_stopped_for_a_while() {
        let (byte_budget, now) = (ByteBudget::default(), Instant::now());
        let rates = Rates {
            letters: 2,
            bytes: 0,
        };
        let mut receiver = receiver_of(&byte_budget, 1, rates);
        let mut number = 0;
        while receiver
            .handle_data(&message(number, number, b"x")[0], now)
            .is_ok()
        {
            number += 1;
            assert!(number < 10, "no limit");
        }
        assert_eq!(receiver.window(now), MIN_WINDOW);
        let until = receiver.paused_until.unwrap();
        receiver.handle_timeout(until);
        assert!(
            !controls(&mut receiver, until).is_empty(),
            "the window is open"
        );
        let packet = message(number, number, b"x");
        receiver.handle_data(&packet[0], until).unwrap();
        assert_eq!(letters(&mut receiver).len() as u32, number + 1);
    }
}
