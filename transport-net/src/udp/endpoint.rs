//! The core as the protocol of an [endpoint](crate::datagrams::endpoint).

use std::collections::HashSet;
use std::net::IpAddr;
use std::time::Instant;

use fipa_transport::{Arrival, Kind, Reaction, Sink, TransportError};

use super::core::{Core, CoreEvent};
use crate::datagrams::{Fragments, Protocol, WithProtocol};

impl Protocol for Core {
    const KIND: Kind = Kind::Udp;
    const FRAGMENTS: Fragments = Fragments::Forbidden;

    fn listens_on(&mut self, listening: Vec<String>) {
        self.listens_on(listening);
    }

    fn lost(&mut self, lost: &HashSet<IpAddr>, local: impl Fn(u32) -> Option<IpAddr>) {
        self.lost(lost, local);
    }

    fn cannot_begin(&mut self, number: u32, error: TransportError) {
        self.cannot_begin(number, error);
    }

    fn too_big(&mut self, number: u32, size: usize) {
        self.too_big(number, size);
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
