//! Receives from the network, and sends the packets that the mDNS library does not send: the
//! queries of [`super::browse`] and the beacons of [`super::beacon`].

use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use fipa_transport::Incarnation;

use super::Shared;
use super::beacon::{self, Beacons, Digest, Repair};
use super::browse::{Browser, Origin, ParsedPacket};
use super::sockets::Sockets;

/// Maximum jitter of the beacon interval, so that gateways do not send simultaneously.
const JITTER: Duration = Duration::from_millis(500);
/// Minimum time between two beacons, however fast coalitions change.
const BREATH: Duration = Duration::from_millis(200);

pub(super) struct Listener {
    sockets: Sockets,
    pub(super) browser: Browser,
    beacons: Beacons,
    next_beacon: Instant,
    /// Earliest time of the next urgent beacon.
    next_urgent: Instant,
    /// Until this time the mDNS library polls the interfaces at a shorter interval.
    fast_poll_until: Option<Instant>,
}

impl Listener {
    pub(super) fn new(shared: &Shared) -> Self {
        let now = Instant::now();
        Self {
            sockets: Sockets::new(),
            browser: Browser::new(now, shared.config.mts.incarnation, fastrand::f64()),
            beacons: Beacons::default(),
            next_beacon: now,
            next_urgent: now,
            fast_poll_until: None,
        }
    }

    /// Sends everything that is due, and returns the time of the next call.
    pub(super) fn send_due(&mut self, shared: &Shared) -> Instant {
        let now = Instant::now();
        if shared.coalitions_changed.swap(false, Ordering::Relaxed) {
            // Other gateways delay coalition changes until they receive the beacon.
            self.next_beacon = self.next_beacon.min(self.next_urgent.max(now));
        }
        if shared.interfaces_changed.swap(false, Ordering::Relaxed) {
            self.next_beacon = now;
            self.poll_fast(now, shared);
        }
        if self.fast_poll_until.is_some_and(|until| until <= now) {
            self.fast_poll_until = None;
            shared.set_poll_interval(super::NORMAL_POLL);
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
                    if changed.fewer {
                        self.browser.retain_interfaces(|it| self.sockets.uses(it));
                        self.poll_fast(now, shared);
                    } else if changed.more {
                        shared.daemon_adds_interfaces();
                    }
                }
                Err(error) => shared.failed(format!("cannot open a multicast socket: {error}")),
            }
            let beacon = beacon::packet(shared.config.mts.incarnation, shared.announced());
            self.send(beacon);
            self.beacons
                .expect(now, shared.verification.lock().gateways());
            for silent in self.beacons.silent(now) {
                self.repair(shared, silent);
            }
        }
        for (label, packet) in shared.relocated(now) {
            self.sockets.send_to_other_hosts(&packet);
            // The library may still announce the previous locations.
            self.browser.report_again(&label);
        }
        let (ended, suspect) = {
            let mut stored = shared.verification.lock();
            (stored.take_ended(), stored.due(now))
        };
        self.browser.end(now, &ended);
        self.browser.suspect(now, &suspect);
        let due = self.browser.handle_timeout(now, fastrand::f64());
        self.send(due.packets);
        for fullname in due.gone {
            shared.put(&fullname, None);
        }
        let later = shared.verification.lock().poll_timeout(now);
        let relocated = shared.own.lock().relocations.poll_timeout();
        let due = [
            Some(self.browser.poll_timeout()),
            later,
            relocated,
            self.fast_poll_until,
        ];
        let due = due.into_iter().flatten().min();
        due.map_or(self.next_beacon, |due| due.min(self.next_beacon))
    }

    fn poll_fast(&mut self, now: Instant, shared: &Shared) {
        self.fast_poll_until = Some(now + super::CHANGING);
        shared.set_poll_interval(super::FAST_POLL);
    }

    fn send(&self, packets: impl IntoIterator<Item = Vec<u8>>) {
        for packet in packets {
            self.sockets.send(&packet);
        }
    }

    /// Receives one packet and processes it.
    pub(super) async fn listen(&mut self, shared: &Shared) -> ParsedPacket {
        let (packet, from, interface) = self.sockets.receive().await;
        let now = Instant::now();
        let is_question = packet.get(2).is_some_and(|flags| flags & 0x80 == 0);
        if is_question && from.port() != shared.config.port {
            // A query from another port gets a unicast answer (RFC 6762 clause 6.7), which does not
            // arrive here.
            return ParsedPacket::default();
        }
        if let Some((gateway, content)) = beacon::read(packet) {
            if gateway != shared.config.mts.incarnation {
                self.handle_beacon(now, shared, gateway, content);
            }
            return ParsedPacket::default();
        }
        let origin = Origin {
            address: from.ip(),
            interface,
        };
        self.browser
            .handle_packet(now, origin, packet, fastrand::f64())
    }

    pub(super) fn handle_beacon(
        &mut self,
        now: Instant,
        shared: &Shared,
        gateway: Incarnation,
        content: beacon::BeaconContent,
    ) {
        shared
            .show(|coalition_sync| coalition_sync.handle_beacon(now, gateway, content.coalitions));
        let stored = shared.verification.lock().of(gateway);
        if let Some(stored) = stored
            && stored.digest == content.all
            && stored.digest != Digest::default()
        {
            self.browser.confirm(now, gateway);
        }
        if let Some(repair) = self.beacons.handle(now, gateway, content.all, stored) {
            self.repair(shared, repair);
        }
    }

    fn repair(&mut self, shared: &Shared, repair: Repair) {
        tracing::debug!(
            ?repair,
            "stored records of another gateway differ from its beacon"
        );
        match repair {
            Repair::Missing => {
                let question = self.browser.ask_for_missing(Instant::now());
                self.send(question);
            }
            Repair::Surplus(gateway) => shared.verification.lock().verify_all(gateway),
            Repair::Silent(gateway) => {
                shared.verification.lock().suspect(Instant::now(), gateway);
            }
        }
    }
}
