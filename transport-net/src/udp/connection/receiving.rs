//! The receiving side of a connection: packets, and the parcels and answers in them, in their
//! order.

use std::time::Instant;

use bytes::Bytes;
use fipa_transport::{Answer, Conclusion, Parcel};

use super::super::counters::UdpCounters;
use super::super::packet::{Frame, Frames, split_parcel};
use super::{Connection, Event, MAX_ID, OutOfOrderParcel};
use crate::end::ConnectionEnd;

impl Connection {
    /// Handles a data packet.
    ///
    /// # Errors
    /// When the packet ends the connection.
    pub(crate) fn handle_packet(
        &mut self,
        number: u64,
        frames: &[u8],
        now: Instant,
        counters: &mut UdpCounters,
    ) -> Result<(), ConnectionEnd> {
        if self.dialing.is_some() {
            // The welcome is late or lost; the peer retransmits these frames.
            return Ok(());
        }
        self.last_received = Some(now);
        (self.doubted, self.peer_moved) = (None, false);
        if !self.received.is_new(number) {
            counters.duplicates += 1;
            self.received.wants_ack(now, true);
            return Ok(());
        }
        let (mut elicits, mut at_once, mut taken) = (false, false, true);
        for frame in Frames(frames) {
            let Ok(frame) = frame else {
                return Err(ConnectionEnd::ProtocolViolation(
                    "a malformed packet".into(),
                ));
            };
            match frame {
                Frame::Ack(ack) => {
                    let Some(result) = self.recovery.acknowledged(&ack, now) else {
                        let what = "an acknowledgment of a packet that was not sent";
                        return Err(ConnectionEnd::ProtocolViolation(what.into()));
                    };
                    result
                        .arrived
                        .into_iter()
                        .for_each(|content| self.arrived(content));
                    result
                        .lost
                        .into_iter()
                        .for_each(|content| self.lost(content));
                }
                Frame::Ping => (elicits, at_once) = (true, true),
                Frame::Answer { id, answer } => {
                    elicits = true;
                    self.conclude(id, answer, now)?;
                }
                Frame::Skipped { id } => {
                    elicits = true;
                    taken &= self.hold(id, None, 0)?;
                }
                Frame::Goodbye { last } => return Err(ConnectionEnd::Goodbye { last }),
                Frame::Parcel { id, bytes } => {
                    (elicits, at_once) = (true, true);
                    taken &= self.take_parcel(id, bytes, now, counters)?;
                }
            }
        }
        if taken {
            self.received.note(number, now);
            if elicits {
                self.received.wants_ack(now, at_once);
            }
        }
        Ok(())
    }

    pub(super) fn take_parcel(
        &mut self,
        id: u64,
        bytes: &[u8],
        now: Instant,
        counters: &mut UdpCounters,
    ) -> Result<bool, ConnectionEnd> {
        if id < self.next_arrival || self.held.contains_key(&id) {
            counters.duplicates += 1;
            return Ok(true);
        }
        let nonsense =
            |what: &dyn std::fmt::Display| Err(ConnectionEnd::ProtocolViolation(what.to_string()));
        let Some((header, body)) = split_parcel(bytes) else {
            return nonsense(&"a parcel without a header");
        };
        if self.paused_until.is_some_and(|until| now < until) {
            counters.held_back += 1;
            return Ok(false);
        }
        if self.answers.len() >= self.limits.max_in_flight.max(1).saturating_mul(2) {
            // The peer does not acknowledge answers.
            return Ok(false);
        }
        let parcel = match header.parcel(Bytes::copy_from_slice(body)) {
            Ok(parcel) => parcel,
            Err(error) => return nonsense(&error),
        };
        let held = self.hold(id, Some(Box::new(parcel)), bytes.len())?;
        if held {
            self.busy = now;
            counters.parcels_in += 1;
            let rate_limit = self.rate_limit.as_ref();
            self.paused_until =
                rate_limit.and_then(|rate_limit| rate_limit.spend(1, bytes.len(), now));
        }
        Ok(held)
    }

    /// Stores the parcel with this number, or the notice that the number is skipped, and delivers
    /// all parcels that are next in order. Returns whether there was room.
    pub(super) fn hold(
        &mut self,
        id: u64,
        parcel: Option<Box<Parcel>>,
        len: usize,
    ) -> Result<bool, ConnectionEnd> {
        if id < self.next_arrival || self.held.contains_key(&id) {
            return Ok(true);
        }
        let max = self.limits.max_in_flight.max(1);
        if id >= MAX_ID || self.arrivals.len() >= max {
            return Err(ConnectionEnd::ProtocolViolation(
                "more unanswered parcels than max_in_flight".into(),
            ));
        }
        let crowded = self.held.len() >= max
            || self.held_bytes.saturating_add(len) > self.limits.max_queued_bytes;
        let waits = id > self.next_arrival;
        if waits && crowded {
            return Ok(false);
        }
        let mut room = None;
        if let Some(meter) = self.meter.as_mut().filter(|_| waits && len > 0) {
            room = meter.take_now(len);
            if room.is_none() {
                return Ok(false);
            }
        }
        self.held_bytes += len;
        let held = OutOfOrderParcel {
            parcel,
            _room: room,
        };
        self.held.insert(id, held);
        while let Some(next) = self.held.remove(&self.next_arrival) {
            let id = self.next_arrival;
            self.next_arrival += 1;
            if let Some(parcel) = next.parcel {
                self.arrivals.insert(id);
                self.events.push_back(Event::Arrived { id, parcel });
            }
        }
        if self.held.is_empty() {
            self.held_bytes = 0;
        }
        Ok(true)
    }

    pub(super) fn conclude(
        &mut self,
        id: u64,
        answer: Answer,
        now: Instant,
    ) -> Result<(), ConnectionEnd> {
        if id > self.last_sent {
            return Err(ConnectionEnd::ProtocolViolation(
                "an answer to a parcel that was not sent".into(),
            ));
        }
        // An absent parcel has been concluded before.
        let Some(sent) = self.sent.remove(&id) else {
            return Ok(());
        };
        if let Err(end) = self.contradictions.check(&answer, sent.after) {
            // Reinserted because it still needs a conclusion.
            self.sent.insert(id, sent);
            return Err(end);
        }
        self.resend.remove(&id);
        self.busy = now;
        if let Some(attempt) = sent.attempt {
            self.attempts.remove(&attempt);
            let conclusion = Conclusion::Answered(answer);
            self.events.push_back(Event::Concluded(attempt, conclusion));
        }
        Ok(())
    }
}
