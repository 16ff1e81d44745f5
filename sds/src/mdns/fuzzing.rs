//! Network records for the fuzz targets: handles packets of any source and checks the invariants of
//! the stored state.

use std::collections::BTreeSet;
use std::net::IpAddr;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_transport::{Incarnation, PeerId};

use super::beacon::{self, Beacons};
use super::browse::{Browser, Found, Origin, label_of};
use super::coalition_sync::CoalitionSync;
use super::verification::Verification;
use super::{packet, record};
use crate::{Entry, Reach, Source};

/// A host that receives multicast DNS, without its sockets.
#[derive(Debug)]
pub struct Listener {
    browser: Browser,
    beacons: Beacons,
    verification: Verification,
    coalition_sync: CoalitionSync,
    /// Full names that were found and not removed.
    found: BTreeSet<String>,
}

/// Builds the packets that announce this entry.
#[must_use]
pub fn announced(entry: &Entry) -> Vec<Vec<u8>> {
    let label = record::label(&entry.name, 0, entry.mts.incarnation);
    let says = record::encode(entry);
    packet::announcement(&label, "fipa-2.local", &says)
        .into_iter()
        .collect()
}

impl Listener {
    /// Creates a host whose own gateway has incarnation 1.
    #[must_use]
    pub fn new(now: Instant) -> Self {
        Self {
            browser: Browser::new(now, Incarnation::from_u64(1), 0.5),
            beacons: Beacons::default(),
            verification: Verification::default(),
            coalition_sync: CoalitionSync::default(),
            found: BTreeSet::new(),
        }
    }

    /// Handles a packet from this address.
    pub fn arrive(&mut self, now: Instant, from: IpAddr, bytes: &[u8]) {
        if let Some((gateway, content)) = beacon::read(bytes) {
            let _ = self
                .coalition_sync
                .handle_beacon(now, gateway, content.coalitions);
            let stored = self.verification.of(gateway);
            let _ = self.beacons.handle(now, gateway, content.all, stored);
            self.browser.confirm(now, gateway);
        }
        let interface = u32::from(bytes.len().is_multiple_of(8));
        let from = Origin {
            address: from,
            interface,
        };
        let received = self.browser.handle_packet(now, from, bytes, 0.5);
        self.browser.check();
        let at = SystemTime::UNIX_EPOCH + Duration::from_secs(1_700_000_000);
        for found in received.found {
            let Found {
                fullname,
                properties,
                from,
                interfaces,
            } = found;
            self.found.insert(fullname.to_string());
            let entry = match record::decode(label_of(&fullname), &properties, at) {
                Ok(entry) => entry,
                Err(error) => {
                    self.verification.put(now, &fullname, None);
                    let _ = self.coalition_sync.put(now, &fullname, None);
                    drop(error.to_string());
                    continue;
                }
            };
            entry.check().expect("a decoded entry is within the limits");
            assert!(entry.source == Source::Mdns && entry.reach != Reach::Local);
            if entry.incarnation.is_known() {
                survives(&entry, at);
            }
            let locations = record::on_interfaces(entry.locations.clone(), &interfaces);
            let peer = PeerId::of_ip(from);
            let entry = Entry {
                locations,
                peer,
                ..entry
            };
            self.browser.belongs(&fullname, entry.mts.incarnation);
            self.verification.put(now, &fullname, Some(&entry));
            let _ = self
                .coalition_sync
                .put(now, &fullname, Some(Arc::new(entry)));
        }
    }

    /// Advances the time and runs every timer when it is due.
    pub fn pass(&mut self, now: &mut Instant, time: Duration) {
        let until = *now + time;
        let mut last = None;
        while let Some(due) = Some(self.browser.poll_timeout()).filter(|due| *due <= until) {
            assert_ne!(last.replace(due), Some(due), "the timeout did not advance");
            *now = due.max(*now);
            let due = self.browser.handle_timeout(*now, 0.5);
            self.browser.check();
            for packet in due.packets {
                assert!(packet.len() <= packet::MAX_PACKET);
                assert!(packet::parse(&packet).is_some(), "an invalid query");
            }
            for fullname in due.gone {
                let was_found = self.found.remove(&*fullname);
                assert!(was_found, "{fullname} was removed but never found");
                self.verification.put(*now, &fullname, None);
                let _ = self.coalition_sync.put(*now, &fullname, None);
            }
            let _ = self.coalition_sync.handle_timeout(*now);
            let silent = self.beacons.silent(*now);
            assert!(silent.len() <= 1024);
        }
        *now = until;
    }
}

/// Asserts that a decoded entry is equal after encoding and decoding it again.
fn survives(entry: &Entry, at: SystemTime) {
    let says = record::encode(entry);
    let label = record::label(&entry.name, 0, entry.mts.incarnation);
    match record::decode(&label, &says, at) {
        Ok(again) => assert_eq!(&again, entry),
        Err(error) => panic!("{entry:?} cannot be decoded again: {error}"),
    }
}
