//! The sending side of a connection: the next parcel, the small frames beside it, and the handling
//! of losses.

use std::time::Instant;

use bytes::Bytes;
use fipa_transport::Conclusion;
use zerocopy::IntoBytes;

use super::super::counters::UdpCounters;
use super::super::packet::{self, ANSWER_OVERHEAD};
use super::super::recovery::SentContent;
use super::{Connection, Event, LOSSES_OF_LARGE, Sent, too_large};

impl Connection {
    /// Handles the acknowledgment of content.
    pub(super) fn arrived(&mut self, content: SentContent) {
        match content {
            SentContent::Parcel(id) => {
                self.resend.remove(&id);
                if let Some(sent) = self.sent.get_mut(&id) {
                    sent.outgoing = None;
                }
            }
            SentContent::Answer(id) => {
                self.answers.remove(&id);
            }
            SentContent::Skipped(id) => {
                self.sent.remove(&id);
            }
            SentContent::Ping => {}
            SentContent::Probe(size) => self.mtu.arrived(size),
        }
    }

    /// Handles the loss of content.
    pub(super) fn lost(&mut self, content: SentContent) {
        match content {
            SentContent::Parcel(id) => {
                let Some(sent) = self.sent.get_mut(&id) else {
                    return;
                };
                let Some(outgoing) = &sent.outgoing else {
                    return;
                };
                sent.losses = sent.losses.saturating_add(1);
                let size = outgoing.size;
                if sent.losses >= LOSSES_OF_LARGE {
                    self.mtu.too_big(size);
                }
                self.resend.insert(id);
            }
            SentContent::Answer(id) if self.answers.contains_key(&id) => {
                self.urgent.push_front(content)
            }
            SentContent::Skipped(id) if self.sent.contains_key(&id) => {
                self.urgent.push_front(content)
            }
            SentContent::Answer(_) | SentContent::Skipped(_) => {}
            SentContent::Ping => self.urgent.push_front(content),
            SentContent::Probe(size) => self.mtu.lost(size),
        }
    }

    /// Removes parcels that are abandoned or too large for the path.
    pub(super) fn drop_unsendable(&mut self) {
        let current = self.mtu.current();
        while let Some(id) = self.resend.first().copied() {
            let Some(sent) = self.sent.get_mut(&id) else {
                self.resend.remove(&id);
                continue;
            };
            let size = sent.outgoing.as_ref().map_or(0, |outgoing| outgoing.size);
            if sent.attempt.is_some() && (size <= current || !self.mtu.is_settled()) {
                break;
            }
            self.resend.remove(&id);
            sent.outgoing = None;
            // Tells the peer not to wait for it.
            self.urgent.push_back(SentContent::Skipped(id));
            if let Some(attempt) = sent.attempt.take() {
                self.attempts.remove(&attempt);
                let concluded = Conclusion::Unconfirmed(too_large(size, current));
                self.events.push_back(Event::Concluded(attempt, concluded));
            }
        }
        while self.mtu.is_settled()
            && let Some(outgoing) = self.waiting.front()
            && outgoing.size > current
        {
            let (attempt, size) = (outgoing.attempt, outgoing.size);
            self.waiting_bytes -= size;
            self.waiting.pop_front();
            let concluded = Conclusion::NotSent(too_large(size, current));
            self.events.push_back(Event::Concluded(attempt, concluded));
        }
    }

    /// Returns the parcel that may be sent next: whether it is new, and the size of its datagram.
    pub(super) fn next_parcel(&self) -> Option<(bool, usize)> {
        if let Some(id) = self.resend.first() {
            let size = self.sent.get(id)?.outgoing.as_ref()?.size;
            return (size <= self.mtu.current()).then_some((false, size));
        }
        let window = self.peer.as_ref()?.max_in_flight as usize;
        let size = self.waiting.front()?.size;
        (self.sent.len() < window && size <= self.mtu.current()).then_some((true, size))
    }

    pub(super) fn put_next_parcel(
        &mut self,
        out: &mut Vec<u8>,
        fresh: bool,
        now: Instant,
        counters: &mut UdpCounters,
    ) -> Option<SentContent> {
        let id = if fresh {
            let outgoing = self.waiting.pop_front()?;
            self.waiting_bytes -= outgoing.size;
            self.last_sent += 1;
            self.attempts.insert(outgoing.attempt, self.last_sent);
            counters.parcels_out += 1;
            let sent = Sent {
                attempt: Some(outgoing.attempt),
                after: outgoing.after,
                outgoing: Some(outgoing),
                losses: 0,
            };
            self.sent.insert(self.last_sent, sent);
            self.busy = now;
            self.last_sent
        } else {
            counters.sent_again += 1;
            self.resend.pop_first()?
        };
        let outgoing = self.sent.get(&id)?.outgoing.as_ref()?;
        packet::put_parcel(out, id);
        out.extend_from_slice(outgoing.header.as_bytes());
        for piece in &outgoing.pieces {
            out.extend_from_slice(piece);
        }
        Some(SentContent::Parcel(id))
    }

    pub(super) fn frame_len(&self, small: SentContent) -> usize {
        match small {
            SentContent::Answer(id) => {
                ANSWER_OVERHEAD + self.answers.get(&id).map_or(0, Bytes::len)
            }
            SentContent::Skipped(_) => 9,
            _ => 1,
        }
    }

    /// Appends a small frame. Returns whether there was one to append.
    pub(super) fn put_small(&self, out: &mut Vec<u8>, small: SentContent) -> bool {
        match small {
            SentContent::Answer(id) => match self.answers.get(&id) {
                Some(body) => packet::put_answer(out, id, body),
                None => return false,
            },
            SentContent::Skipped(id) => packet::put_skipped(out, id),
            SentContent::Ping => packet::put_ping(out),
            SentContent::Parcel(_) | SentContent::Probe(_) => return false,
        }
        true
    }

    /// Whether a parcel waits that is larger than the known MTU.
    pub(super) fn wants_probe(&self) -> bool {
        let current = self.mtu.current();
        let again = self.resend.first().and_then(|id| self.sent.get(id));
        again
            .and_then(|sent| sent.outgoing.as_ref())
            .or(self.waiting.front())
            .is_some_and(|outgoing| outgoing.size > current)
    }
}
