//! Receives from the network, and sends the packets that the mDNS library does not send: the
//! queries of [`super::browse`] and the beacons of [`super::beacon`].

use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use fipa_transport::Incarnation;

use super::Shared;
use super::beacon::{self, Beacons, Digest, Repair};
use super::browse::{Browser, Heard};
use super::sockets::Sockets;

/// Maximum jitter of the beacon interval, so that gateways do not send simultaneously.
const JITTER: Duration = Duration::from_millis(500);
/// Minimum time between two beacons, however fast coalitions change.
const BREATH: Duration = Duration::from_millis(200);

pub(super) struct Ear {
    sockets: Sockets,
    pub(super) browser: Browser,
    beacons: Beacons,
    next_beacon: Instant,
    /// Earliest time of the next urgent beacon.
    next_urgent: Instant,
    /// Until this time the mDNS library polls the interfaces at a shorter interval.
    looks_soon: Option<Instant>,
}

impl Ear {
    pub(super) fn new(shared: &Shared) -> Self {
        let now = Instant::now();
        Self {
            sockets: Sockets::new(),
            browser: Browser::new(now, shared.config.mts.incarnation, fastrand::f64()),
            beacons: Beacons::default(),
            next_beacon: now,
            next_urgent: now,
            looks_soon: None,
        }
    }

    /// Sends everything that is due, and returns the time of the next call.
    pub(super) fn speak(&mut self, shared: &Shared) -> Instant {
        let now = Instant::now();
        if shared.coalitions_changed.swap(false, Ordering::Relaxed) {
            // Other gateways delay coalition changes until they receive the beacon.
            self.next_beacon = self.next_beacon.min(self.next_urgent.max(now));
        }
        if shared.interfaces_changed.swap(false, Ordering::Relaxed) {
            self.next_beacon = now;
            self.looks_soon = Some(now + beacon::INTERVAL);
            shared.daemon_looks(super::LOOKS_SOON);
        }
        if self.looks_soon.is_some_and(|until| until <= now) {
            self.looks_soon = None;
            shared.daemon_looks(super::LOOKS);
        }
        if now >= self.next_beacon {
            self.next_beacon = now + beacon::INTERVAL + JITTER.mul_f64(fastrand::f64());
            self.next_urgent = now + BREATH;
            // Interfaces may have appeared or disappeared.
            match self.sockets.refresh(&shared.config) {
                Ok(changed) => {
                    if changed.more {
                        self.browser.start_again(now, fastrand::f64());
                    }
                    // The library notices a removed address only at its next poll, and until then
                    // would use it instead of the new one.
                    if changed.more && !changed.fewer {
                        shared.daemon_adds_interfaces();
                    }
                }
                Err(error) => shared.failed(format!("cannot open a multicast socket: {error}")),
            }
            let beacon = beacon::packet(shared.config.mts.incarnation, shared.announced());
            self.send(beacon);
            for silent in self.beacons.silent(now) {
                self.repair(shared, silent);
            }
        }
        self.send(shared.moved());
        let (ended, doubtful) = {
            let mut held = shared.held.lock();
            (held.take_ended(), held.due(now))
        };
        self.browser.end(now, &ended);
        self.browser.doubt(now, &doubtful);
        let due = self.browser.handle_timeout(now, fastrand::f64());
        self.send(due.packets);
        for fullname in due.gone {
            shared.put(&fullname, None);
        }
        let later = shared.held.lock().poll_timeout(now);
        let due = [Some(self.browser.poll_timeout()), later, self.looks_soon];
        let due = due.into_iter().flatten().min();
        due.map_or(self.next_beacon, |due| due.min(self.next_beacon))
    }

    fn send(&self, packets: impl IntoIterator<Item = Vec<u8>>) {
        for packet in packets {
            self.sockets.send(&packet);
        }
    }

    /// Receives one packet and processes it.
    pub(super) async fn listen(&mut self, shared: &Shared) -> Heard {
        let (packet, from) = self.sockets.receive().await;
        let now = Instant::now();
        let is_question = packet.get(2).is_some_and(|flags| flags & 0x80 == 0);
        if is_question && from.port() != shared.config.port {
            // A query from another port gets a unicast answer (RFC 6762 clause 6.7), which does not
            // arrive here.
            return Heard::default();
        }
        if let Some((gateway, said)) = beacon::read(packet) {
            if gateway != shared.config.mts.incarnation {
                self.handle_beacon(now, shared, gateway, said);
            }
            return Heard::default();
        }
        self.browser
            .handle_packet(now, from.ip(), packet, fastrand::f64())
    }

    pub(super) fn handle_beacon(
        &mut self,
        now: Instant,
        shared: &Shared,
        gateway: Incarnation,
        said: beacon::Announced,
    ) {
        shared.show(|together| together.said(now, gateway, said.coalitions));
        let held = shared.held.lock().of(gateway);
        if let Some(held) = held
            && held.digest == said.all
            && held.digest != Digest::default()
        {
            self.browser.confirm(now, gateway);
        }
        if let Some(repair) = self.beacons.handle(now, gateway, said.all, held) {
            self.repair(shared, repair);
        }
    }

    fn repair(&mut self, shared: &Shared, repair: Repair) {
        tracing::debug!(?repair, "stored records of another gateway differ from its beacon");
        match repair {
            Repair::Missing => {
                let question = self.browser.ask_for_missing(Instant::now());
                self.send(question);
            }
            Repair::Surplus(gateway) => shared.held.lock().verify_all(gateway),
            Repair::Silent(gateway) => {
                shared.held.lock().doubt(Instant::now(), gateway);
            }
        }
    }
}
