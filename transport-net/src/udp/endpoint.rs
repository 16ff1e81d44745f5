//! The core as the protocol of an [endpoint](crate::datagrams::endpoint).

use std::collections::HashSet;
use std::net::IpAddr;
use std::time::Instant;

use fipa_transport::{Arrival, Arriving, Body, Kind, Parcel, Sink, TransportError, Verdict};

use super::core::{Core, CoreEvent};
use crate::datagrams::{Fragments, Path, Protocol, Transmit, WithProtocol};

impl Protocol for Core {
    type Event = CoreEvent;

    const KIND: Kind = Kind::Udp;
    const FRAGMENTS: Fragments = Fragments::Forbidden;

    fn listens_on(&mut self, listening: Vec<String>) {
        self.listens_on(listening);
    }

    fn lost(&mut self, lost: &HashSet<IpAddr>, local: impl Fn(u32) -> Option<IpAddr>) {
        self.lost(lost, local);
    }

    fn is_opening(&self, number: u32) -> bool {
        self.is_opening(number)
    }

    fn begin(&mut self, now: Instant, number: u32, paths: Vec<Path>) {
        self.begin(now, number, paths);
    }

    fn cannot_begin(&mut self, number: u32, error: TransportError) {
        self.cannot_begin(number, error);
    }

    fn handle_datagram(&mut self, now: Instant, path: Path, listening: bool, bytes: &[u8]) {
        self.handle_datagram(now, path, listening, bytes);
    }

    fn handle_error(&mut self, now: Instant, number: u32, path: Path, what: &str) {
        self.handle_error(now, number, path, what);
    }

    fn too_big(&mut self, number: u32, size: usize) {
        self.too_big(number, size);
    }

    fn poll_transmit(&mut self, now: Instant) -> Option<Transmit> {
        self.poll_transmit(now)
    }

    fn poll_event(&mut self) -> Option<CoreEvent> {
        self.poll_event()
    }

    fn has_events(&self) -> bool {
        self.has_events()
    }

    fn poll_gone(&mut self) -> Option<u32> {
        self.poll_gone()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        self.poll_timeout()
    }

    fn handle_timeout(&mut self, now: Instant) {
        self.handle_timeout(now);
    }

    fn close(&mut self) {
        self.close();
    }

    fn deliver(event: CoreEvent, sink: &dyn Sink, with: &WithProtocol<'_, Self>) {
        match event {
            CoreEvent::Concluded(attempt, conclusion) => sink.concluded(attempt, conclusion),
            CoreEvent::Introduced(peer) => sink.introduced(&peer),
            CoreEvent::Parted(peer) => sink.parted(&peer),
            CoreEvent::Arrived {
                mut parcel,
                from,
                ticket,
            } => {
                place(&mut parcel, sink);
                let verdict = sink.arrived(Arrival {
                    parcel: *parcel,
                    from,
                    ticket: Some(ticket),
                });
                if let Verdict::Now(answer) = verdict {
                    with(&mut |core| core.answer(Instant::now(), ticket, &answer));
                }
            }
        }
    }
}

/// Minimum length of content that is moved into memory of the sink.
const PLACED_FROM: usize = 32 << 10;

/// Moves large content into memory of the sink, if it offers some. The sink forwards it from there
/// without a copy.
fn place(parcel: &mut Parcel, sink: &dyn Sink) {
    let Body::Letter(letter) = &mut parcel.body else {
        return;
    };
    let payload = letter.payload();
    let content = payload.content.clone();
    if content.len() < PLACED_FROM {
        return;
    }
    let memory = sink.memory_for(&Arriving {
        receiver: &parcel.receiver,
        stream: parcel.stream,
        front: parcel.receiver.len() + letter.envelope_len() + payload.head.len(),
        len: content.len(),
        tail: payload.tail.len(),
    });
    let Some(mut memory) = memory else { return };
    let place = memory.content_mut();
    if place.len() == content.len() {
        place.copy_from_slice(&content);
        *letter = std::mem::take(letter).with_content(memory.freeze());
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use bytes::Bytes;
    use fipa_acl::{Letter, Payload};
    use fipa_transport::{AttemptId, Conclusion, Incarnation, LegacySource, LoanedContent, Stream};
    use parking_lot::Mutex;

    use super::*;

    struct Memory(Vec<u8>);

    impl LoanedContent for Memory {
        fn content_mut(&mut self) -> &mut [u8] {
            &mut self.0
        }

        fn freeze(self: Box<Self>) -> Bytes {
            self.0.into()
        }
    }

    /// Lends memory with this difference in length, and records its addresses.
    struct Lends(usize, Mutex<Vec<usize>>);

    impl Sink for Lends {
        fn arrived(&self, _: Arrival) -> Verdict {
            unreachable!("only memory is requested")
        }

        fn arrived_unframed(&self, _: Letter, _: Kind, _: LegacySource) {}

        fn concluded(&self, _: AttemptId, _: Conclusion) {}

        fn memory_for(&self, arriving: &Arriving<'_>) -> Option<Box<dyn LoanedContent>> {
            let Arriving {
                receiver,
                front,
                tail,
                ..
            } = *arriving;
            assert_eq!((receiver, front, tail), ("arm", 3 + 8 + 4, 1));
            let memory = Memory(vec![0; arriving.len + self.0]);
            self.1.lock().push(memory.0.as_ptr() as usize);
            Some(Box::new(memory))
        }
    }

    fn placed(len: usize, difference: usize) -> (bool, Vec<usize>, Bytes) {
        let payload = Payload {
            head: Bytes::from_static(b"head"),
            content: vec![7; len].into(),
            tail: Bytes::from_static(b"\x01"),
        };
        let mut parcel = Parcel {
            receiver: "arm".into(),
            stream: Stream {
                sender: Incarnation::from_u64(1),
                receiver: Incarnation::from_u64(2),
            },
            sequence: 1,
            after: 0,
            transfer: 1,
            remaining: Duration::from_secs(1),
            body: Body::Letter(Letter::new(Bytes::from_static(b"envelope"), payload)),
        };
        let before = parcel.clone();
        let sink = Lends(difference, Mutex::default());
        place(&mut parcel, &sink);
        let Body::Letter(letter) = &parcel.body else {
            unreachable!("it is a letter")
        };
        let addresses = std::mem::take(&mut *sink.1.lock());
        (
            parcel == before,
            addresses,
            letter.payload().content.clone(),
        )
    }

    #[test]
    fn large_content_is_moved_into_memory_of_the_sink() {
        let (is_same, addresses, content) = placed(PLACED_FROM, 0);
        assert!(is_same);
        assert_eq!(addresses, [content.as_ptr() as usize]);
        let (is_same, addresses, _) = placed(PLACED_FROM - 1, 0);
        assert_eq!((is_same, addresses), (true, Vec::new()));
        // Memory of another length is not used.
        let (is_same, addresses, content) = placed(PLACED_FROM, 1);
        assert!(is_same && addresses != [content.as_ptr() as usize]);
    }
}
