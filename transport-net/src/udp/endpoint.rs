//! The core as the protocol of an [endpoint](crate::datagrams::endpoint).

use std::collections::HashSet;
use std::net::IpAddr;
use std::time::Instant;

use fipa_transport::{Arrival, Kind, Reaction, Sink, TransportError};

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
            CoreEvent::Disconnected(peer) => sink.disconnected(&peer),
            CoreEvent::Arrived {
                parcel,
                from,
                ticket,
            } => {
                let reaction = sink.arrived(Arrival {
                    parcel: *parcel,
                    from,
                    ticket: Some(ticket),
                });
                if let Reaction::Now(answer) = reaction {
                    with(&mut |core| core.answer(Instant::now(), ticket, &answer));
                }
            }
        }
    }
}
