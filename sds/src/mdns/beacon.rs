//! Beacons: gateways detect with them that they missed announcements of each other.
//!
//! An announcement or a goodbye is sent once or twice. A host that was out of range misses it: the
//! next query may come up to an hour later, and a removed record stays in caches for minutes. Every
//! gateway therefore sends, every two seconds, the number and a digest of the agents that it
//! announces, and the same of the coalitions among them, in a packet of 150 bytes that legacy peers
//! ignore:
//!
//! `<incarnation>._fipa_gateway._udp.local. TXT "agents=500" "digest=0123456789abcdef"
//! "coalitions=2:0123456789abcdef"`
//!
//! together with a PTR record that introduces it.
//!
//! A gateway whose records of the sender differ queries the network, first for missing records,
//! then for surplus ones. It also queries for a gateway whose beacons stop for some seconds. A
//! beacon never adds an entry: it triggers queries, or, when it matches the stored records, makes
//! queries for their renewal unnecessary.

use std::collections::HashMap;
use std::time::{Duration, Instant};

use fipa_transport::{Incarnation, fnv1a};
use simple_dns::rdata::{PTR, RData, TXT};
use simple_dns::{CLASS, Label, Name, Packet, PacketFlag, ResourceRecord};

use super::packet::parse_answer;
use super::record::Properties;

/// Interval between beacons.
pub(super) const INTERVAL: Duration = Duration::from_secs(2);
/// TTL in seconds; other hosts cache a beacon for no longer.
const TTL: u32 = 10;
/// Time without a beacon after which a gateway is queried.
pub(super) const SILENCE: Duration = Duration::from_secs(8);
/// Time for which the stored records of a gateway must be unchanged before they are compared:
/// records that are still arriving need no query.
const QUIET: Duration = Duration::from_secs(1);
/// Pauses between two queries for the same gateway.
const FIRST_PAUSE: Duration = Duration::from_secs(2);
const LONGEST_PAUSE: Duration = Duration::from_secs(60);
/// Maximum number of gateways whose beacons are processed.
const MAX_GATEWAYS: usize = 1024;

const TYPE_LABELS: [&str; 3] = ["_fipa_gateway", "_udp", "local"];

/// Number and digest of the records that a gateway announces.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Digest {
    agents: u32,
    digest: u64,
}

impl Digest {
    /// Computes the digest of one record.
    pub(super) fn of(properties: &Properties) -> Self {
        // All hosts compute the same value, and a forged digest gains nothing.
        let strings = properties.iter().flat_map(|(key, value)| {
            let ends = [0xff_u8, u8::try_from(value.len()).unwrap_or(u8::MAX)];
            key.bytes().chain(ends).chain(value.iter().copied())
        });
        let digest = fnv1a(strings);
        Self { agents: 1, digest }
    }

    pub(super) fn add(&mut self, other: Self) {
        self.agents = self.agents.saturating_add(other.agents);
        self.digest ^= other.digest;
    }

    pub(super) fn remove(&mut self, other: Self) {
        self.agents = self.agents.saturating_sub(other.agents);
        self.digest ^= other.digest;
    }
}

/// The content of a beacon.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct BeaconContent {
    /// All agents of the gateway.
    pub(super) all: Digest,
    /// The coalitions, which change [atomically](super::coalition_sync).
    pub(super) coalitions: Digest,
}

/// Digest of the stored records of one gateway, and the time of its last change.
#[derive(Debug, Clone, Copy)]
pub(super) struct StoredDigest {
    pub(super) digest: Digest,
    pub(super) changed: Instant,
}

/// A query that a beacon triggers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Repair {
    /// For records that are missing.
    Missing,
    /// For all stored records of this gateway, because some may be outdated.
    Surplus(Incarnation),
    /// For this gateway, which has stopped sending beacons.
    Silent(Incarnation),
}

/// Beacons of other gateways.
#[derive(Debug, Default)]
pub(super) struct Beacons {
    gateways: HashMap<Incarnation, BeaconState>,
}

#[derive(Debug)]
struct BeaconState {
    digest: Digest,
    last: Instant,
    /// Number of consecutive mismatches that led to a query.
    repairs: u32,
    /// Earliest time of the next query.
    due: Instant,
}

impl BeaconState {
    fn new(now: Instant, digest: Digest) -> Self {
        Self {
            digest,
            last: now,
            repairs: 0,
            due: now + QUIET,
        }
    }
}

impl Beacons {
    /// Handles a beacon, and returns the query that it triggers, given the stored records of the
    /// gateway.
    pub(super) fn handle(
        &mut self,
        now: Instant,
        gateway: Incarnation,
        digest: Digest,
        stored: Option<StoredDigest>,
    ) -> Option<Repair> {
        if self.gateways.len() >= MAX_GATEWAYS && !self.gateways.contains_key(&gateway) {
            return None;
        }
        let state = self
            .gateways
            .entry(gateway)
            .or_insert_with(|| BeaconState::new(now, digest));
        if state.digest != digest {
            // The gateway is still announcing its latest change.
            state.due = state.due.max(now + QUIET);
        }
        state.digest = digest;
        state.last = now;
        let current = stored.map(|stored| stored.digest).unwrap_or_default();
        if current == digest {
            state.repairs = 0;
            return None;
        }
        if state.due > now || stored.is_some_and(|stored| stored.changed + QUIET > now) {
            return None;
        }
        let nothing_missing = current.agents >= digest.agents;
        let pause = FIRST_PAUSE * 2_u32.saturating_pow((state.repairs / 2).min(8));
        state.due = now + pause.min(LONGEST_PAUSE);
        state.repairs += 1;
        // Alternates, starting with the likelier cause, because both may apply.
        Some(match (nothing_missing, state.repairs % 2) {
            (true, 1) | (false, 0) => Repair::Surplus(gateway),
            _ => Repair::Missing,
        })
    }

    /// Expects beacons of these gateways, because their records are stored. A gateway that ends before
    /// its first beacon arrives is silent, too, and so is one that a query has not removed.
    pub(super) fn expect(&mut self, now: Instant, gateways: impl Iterator<Item = Incarnation>) {
        for gateway in gateways.filter(|gateway| gateway.is_known()) {
            if self.gateways.len() >= MAX_GATEWAYS {
                return;
            }
            self.gateways
                .entry(gateway)
                .or_insert_with(|| BeaconState::new(now, Digest::default()));
        }
    }

    /// Returns the gateways whose beacons have stopped, each once unless it is expected again.
    pub(super) fn silent(&mut self, now: Instant) -> Vec<Repair> {
        let mut silent = Vec::new();
        self.gateways.retain(|gateway, state| {
            let stays = now < state.last + SILENCE;
            if !stays {
                silent.push(Repair::Silent(*gateway));
            }
            stays
        });
        silent
    }
}

/// Builds the packet with the beacon of a gateway.
pub(super) fn packet(gateway: Incarnation, announced: BeaconContent) -> Option<Vec<u8>> {
    let label = gateway.to_string();
    let mut labels = vec![Label::new(label.as_bytes()).ok()?];
    labels.extend(TYPE_LABELS.map(|label| Label::new_unchecked(label.as_bytes())));
    let BeaconContent { all, coalitions } = announced;
    let strings = [
        format!("agents={}", all.agents),
        format!("digest={:016x}", all.digest),
        format!(
            "coalitions={}:{:016x}",
            coalitions.agents, coalitions.digest
        ),
    ];
    let mut txt = TXT::new();
    for string in &strings {
        txt.add_string(string).ok()?;
    }
    let name = Name::new_with_labels(&labels);
    let record = ResourceRecord::new(name, CLASS::IN, TTL, RData::TXT(txt));
    let mut packet = Packet::new_reply(0);
    packet.set_flags(PacketFlag::AUTHORITATIVE_ANSWER);
    packet.answers.push(record.with_cache_flush(true));
    // The mDNS library keeps records of a service that is not introduced, and every version of
    // them, forever.
    let service = Name::new_with_labels(&labels[1..]);
    let introduced = RData::PTR(PTR(Name::new_with_labels(&labels)));
    let record = ResourceRecord::new(service, CLASS::IN, TTL, introduced);
    packet.answers.push(record);
    packet.build_bytes_vec_compressed().ok()
}

/// Parses a beacon; `None` if the packet is not one.
pub(super) fn read(packet: &[u8]) -> Option<(Incarnation, BeaconContent)> {
    // Most packets are not beacons; this search rejects them without parsing.
    memchr::memmem::find(packet, TYPE_LABELS[0].as_bytes())?;
    let packet = parse_answer(packet)?;
    let mut answers = packet.answers.iter();
    let record = answers.find(|record| matches!(record.rdata, RData::TXT(_)))?;
    let (label, rest) = record.name.get_labels().split_first()?;
    let same = rest.len() == TYPE_LABELS.len()
        && rest
            .iter()
            .zip(TYPE_LABELS)
            .all(|(one, other)| one.as_ref().eq_ignore_ascii_case(other.as_bytes()));
    let RData::TXT(txt) = &record.rdata else {
        return None;
    };
    let gateway: Incarnation = std::str::from_utf8(label.as_ref()).ok()?.parse().ok()?;
    let text = |wanted: &str| {
        let mut pairs = txt.iter_raw();
        let found = pairs.find(|(key, _)| *key == wanted.as_bytes());
        std::str::from_utf8(found?.1?).ok()
    };
    let digest = |agents: &str, digest: &str| {
        Some(Digest {
            agents: agents.parse().ok()?,
            digest: u64::from_str_radix(digest, 16).ok()?,
        })
    };
    let (coalitions, of_coalitions) = text("coalitions")?.split_once(':')?;
    let announced = BeaconContent {
        all: digest(text("agents")?, text("digest")?)?,
        coalitions: digest(coalitions, of_coalitions)?,
    };
    (same && gateway.is_known()).then_some((gateway, announced))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::packet::question_for_all;
    use super::*;

    fn digest(numbers: &[u64]) -> Digest {
        let mut whole = Digest::default();
        for number in numbers {
            let value = number.to_be_bytes().to_vec();
            whole.add(Digest::of(&vec![("fipa-id".to_owned(), value)]));
        }
        whole
    }

    fn gateway(number: u64) -> Incarnation {
        Incarnation::from_u64(number)
    }

    #[test]
    fn digests_do_not_depend_on_the_order() {
        let mut one = digest(&[1, 2, 3]);
        assert_eq!(one, digest(&[3, 1, 2]));
        one.remove(digest(&[2]));
        assert_eq!(one, digest(&[1, 3]));
        assert_ne!(one, digest(&[1, 4]));
    }

    #[test]
    fn beacons_survive_a_round_trip() {
        for numbers in [&[][..], &[7], &[1, 2, 3]] {
            let announced = BeaconContent {
                all: digest(numbers),
                coalitions: digest(&numbers[numbers.len() / 2..]),
            };
            let written = packet(gateway(0xab), announced).unwrap();
            assert!(written.len() < 160, "{}", written.len());
            assert_eq!(read(&written), Some((gateway(0xab), announced)));
        }
        assert_eq!(read(b""), None);
        assert_eq!(read(&question_for_all(&[])[0]), None);
        // The PTR record is needed because the mDNS library would otherwise keep the beacon
        // forever.
        let written = packet(gateway(0xab), BeaconContent::default()).unwrap();
        let answers = parse_answer(&written).unwrap().answers;
        let (of, introduced) = match &answers[..] {
            [of, pointer] => (of.name.clone(), pointer),
            other => panic!("{other:?}"),
        };
        assert_eq!(introduced.rdata, RData::PTR(PTR(of)));
        assert_eq!(introduced.name.to_string(), "_fipa_gateway._udp.local");
    }

    #[test]
    fn queries_for_missing_and_surplus_records_alternate() {
        let mut beacons = Beacons::default();
        let start = Instant::now();
        let mut asked = Vec::new();
        for millis in (0..20_000).step_by(500) {
            let now = start + Duration::from_millis(millis);
            asked.extend(beacons.handle(now, gateway(1), digest(&[1, 2]), None));
        }
        assert_eq!(
            asked[..3],
            [
                Repair::Missing,
                Repair::Surplus(gateway(1)),
                Repair::Missing
            ]
        );
        assert!((4..=6).contains(&asked.len()), "{asked:?}");
        // The stored records first match, and then include a surplus.
        let now = start + Duration::from_secs(100);
        let stored = |numbers: &[u64]| {
            Some(StoredDigest {
                digest: digest(numbers),
                changed: start,
            })
        };
        let mut handle = |millis, beacon: &[u64], stored| {
            let now = now + Duration::from_millis(millis);
            beacons.handle(now, gateway(1), digest(beacon), stored)
        };
        assert_eq!(handle(0, &[1, 2], stored(&[1, 2])), None);
        // A change counts only after the quiet time.
        assert_eq!(handle(0, &[1], stored(&[1, 2])), None);
        assert_eq!(
            handle(2000, &[1], stored(&[1, 2])),
            Some(Repair::Surplus(gateway(1)))
        );
        let changing = Some(StoredDigest {
            digest: digest(&[1, 2]),
            changed: now + Duration::from_secs(9),
        });
        assert_eq!(handle(9500, &[1], changing), None);
    }

    #[test]
    fn a_silent_gateway_is_reported_once() {
        let mut beacons = Beacons::default();
        let now = Instant::now();
        beacons.handle(now, gateway(1), digest(&[1]), None);
        assert_eq!(beacons.silent(now + SILENCE / 2), []);
        assert_eq!(beacons.silent(now + SILENCE), [Repair::Silent(gateway(1))]);
        assert_eq!(beacons.silent(now + SILENCE * 2), []);
        // A gateway with records, of which no beacon has arrived.
        beacons.expect(now, [gateway(2), Incarnation::UNKNOWN].into_iter());
        beacons.expect(now + SILENCE / 2, [gateway(2)].into_iter());
        assert_eq!(beacons.silent(now + SILENCE), [Repair::Silent(gateway(2))]);
        for number in 0..MAX_GATEWAYS as u64 + 10 {
            beacons.handle(now, gateway(number + 1), digest(&[]), None);
        }
        assert_eq!(beacons.gateways.len(), MAX_GATEWAYS);
    }

    proptest! {
        #[test]
        fn a_corrupted_beacon_does_not_panic(at in 0_usize..140, byte: u8) {
            let mut written = packet(gateway(1), BeaconContent::default()).unwrap();
            if let Some(broken) = written.get_mut(at) {
                *broken = byte;
            }
            let _ = read(&written);
        }
    }
}
