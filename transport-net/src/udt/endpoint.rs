//! The core as the protocol of an [endpoint](crate::datagrams::endpoint).

use std::collections::HashSet;
use std::net::IpAddr;
use std::time::Instant;

use fipa_transport::{Kind, LegacySource, Sink, TransportError};

use super::core::{Core, CoreEvent};
use crate::datagrams::{Fragments, Path, Protocol, Transmit, WithProtocol};
use crate::legacy::letter;
use crate::log_limit::warn_limited;

impl Protocol for Core {
    type Event = CoreEvent;

    const KIND: Kind = Kind::Udt;
    // The size of packets is agreed on before the MTU of the path is known.
    const FRAGMENTS: Fragments = Fragments::Allowed;

    /// Does nothing: a handshake contains no addresses of this side.
    fn listens_on(&mut self, _listening: Vec<String>) {}

    fn lost(&mut self, lost: &HashSet<IpAddr>, local: impl Fn(u32) -> Option<IpAddr>) {
        self.lost(Instant::now(), lost, local);
    }

    fn is_opening(&self, number: u32) -> bool {
        self.is_opening(number)
    }

    fn begin(&mut self, now: Instant, number: u32, paths: Vec<Path>) {
        self.begin(now, number, paths);
    }

    fn cannot_begin(&mut self, number: u32, error: TransportError) {
        self.cannot_begin(Instant::now(), number, error);
    }

    fn handle_datagram(&mut self, now: Instant, path: Path, listening: bool, bytes: &[u8]) {
        self.handle_datagram(now, path, listening, bytes);
    }

    fn handle_error(&mut self, now: Instant, number: u32, path: Path, what: &str) {
        self.handle_error(now, number, path, what);
    }

    /// Does nothing: the packet counts as lost, and the system fragments the next one.
    fn too_big(&mut self, _number: u32, _size: usize) {}

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
        self.close(Instant::now());
    }

    fn deliver(event: CoreEvent, sink: &dyn Sink, with: &WithProtocol<'_, Self>) {
        match event {
            CoreEvent::Concluded(attempt, conclusion) => sink.concluded(attempt, conclusion),
            // The reservation of the memory ends when the sink has the letter.
            CoreEvent::Arrived(arrived, from) => match letter::standard(&arrived.bytes) {
                Ok((letter, signature)) => {
                    let source = LegacySource {
                        address: from.ip().to_canonical(),
                        signature,
                    };
                    sink.arrived_unframed(letter, Kind::Udt, source);
                }
                Err(error) => with(&mut |core| {
                    let before = core.count_nonsense();
                    warn_limited(
                        before,
                        format_args!("{from}: letter over UDT refused: {error}"),
                    );
                }),
            },
        }
    }
}
