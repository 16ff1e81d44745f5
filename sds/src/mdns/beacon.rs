//! Beacons: how gateways notice that they have missed something of each other.
//!
//! An announcement or a goodbye is said once or twice. Who was out of range then never hears of
//! it: the next question is asked within the hour, and a record that is gone is believed in for
//! minutes. So every gateway says every two seconds how many agents it announces and a digest of
//! them, and the same of the coalitions among them, in a packet of 150 bytes that old peers pass
//! over:
//!
//! `<incarnation>._fipa_gateway._udp.local. TXT "agents=500" "digest=0123456789abcdef"
//! "coalitions=2:0123456789abcdef"`
//!
//! with a PTR record that introduces it.
//!
//! Whoever holds something else of that gateway asks the network, first for what it has not got,
//! then for what it should not have any more. Who is not heard for some seconds is asked, too.
//! Nothing new is believed because of a beacon: it makes others ask, or, when they hold just what
//! it says, spares them asking whether that is still so.

use std::collections::HashMap;
use std::time::{Duration, Instant};

use fipa_transport::Incarnation;
use simple_dns::rdata::{PTR, RData, TXT};
use simple_dns::{CLASS, Label, Name, Packet, PacketFlag, ResourceRecord};

use super::packet::parse_answer;
use super::record::Properties;

/// How often a gateway says what it has.
pub(super) const INTERVAL: Duration = Duration::from_secs(2);
/// For how long it counts; no more than that is remembered by others' caches.
const TTL: u32 = 10;
/// How long a gateway that said something is silent before it is asked.
pub(super) const SILENCE: Duration = Duration::from_secs(8);
/// How long what is held of a gateway has to be unchanged before it is compared: what is under
/// way need not be asked for.
const QUIET: Duration = Duration::from_secs(1);
/// Pauses between two repairs of the same gateway.
const FIRST_PAUSE: Duration = Duration::from_secs(2);
const LONGEST_PAUSE: Duration = Duration::from_secs(60);
/// Most gateways that are listened to.
const MAX_GATEWAYS: usize = 1024;

const TYPE_LABELS: [&str; 3] = ["_fipa_gateway", "_udp", "local"];

/// What a gateway announces, in short.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Digest {
    agents: u32,
    digest: u64,
}

impl Digest {
    /// The digest of one record.
    pub(super) fn of(properties: &Properties) -> Self {
        // Fowler, Noll and Vo: nobody gains by forging it, being the same everywhere is the point.
        let strings = properties.iter().flat_map(|(key, value)| {
            let ends = [0xff_u8, u8::try_from(value.len()).unwrap_or(u8::MAX)];
            key.bytes().chain(ends).chain(value.iter().copied())
        });
        let digest = strings.fold(0xcbf2_9ce4_8422_2325, |hash: u64, byte| {
            (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3)
        });
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

/// What a beacon says that its gateway announces.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Announced {
    /// All of it.
    pub(super) all: Digest,
    /// The coalitions, which are seen to change [together](super::together).
    pub(super) coalitions: Digest,
}

/// What is held of one gateway, and since when.
#[derive(Debug, Clone, Copy)]
pub(super) struct Held {
    pub(super) digest: Digest,
    pub(super) changed: Instant,
}

/// What there is to be asked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Repair {
    /// For whatever is not held.
    Missing,
    /// Whether all that is held of this gateway is still so.
    Surplus(Incarnation),
    /// Whether this gateway is still there.
    Silent(Incarnation),
}

/// Others' beacons.
#[derive(Debug, Default)]
pub(super) struct Beacons {
    heard: HashMap<Incarnation, Heard>,
}

#[derive(Debug)]
struct Heard {
    digest: Digest,
    last: Instant,
    /// How often in a row what is held was different.
    repairs: u32,
    /// When it may be repaired next.
    due: Instant,
}

impl Beacons {
    /// A gateway has said what it has. What follows from that, given what is held of it.
    pub(super) fn handle(
        &mut self,
        now: Instant,
        gateway: Incarnation,
        digest: Digest,
        held: Option<Held>,
    ) -> Option<Repair> {
        if self.heard.len() >= MAX_GATEWAYS && !self.heard.contains_key(&gateway) {
            return None;
        }
        let heard = self.heard.entry(gateway).or_insert_with(|| Heard {
            digest,
            last: now,
            repairs: 0,
            due: now + QUIET,
        });
        if heard.digest != digest {
            // What has just changed is announced at this moment.
            heard.due = heard.due.max(now + QUIET);
        }
        heard.digest = digest;
        heard.last = now;
        let is = held.map(|held| held.digest).unwrap_or_default();
        if is == digest {
            heard.repairs = 0;
            return None;
        }
        if heard.due > now || held.is_some_and(|held| held.changed + QUIET > now) {
            return None;
        }
        let nothing_missing = is.agents >= digest.agents;
        let pause = FIRST_PAUSE * 2_u32.saturating_pow((heard.repairs / 2).min(8));
        heard.due = now + pause.min(LONGEST_PAUSE);
        heard.repairs += 1;
        // In turns, beginning with what is more likely: both may be true.
        Some(match (nothing_missing, heard.repairs % 2) {
            (true, 1) | (false, 0) => Repair::Surplus(gateway),
            _ => Repair::Missing,
        })
    }

    /// Gateways that have been silent for a while. Each is told once.
    pub(super) fn silent(&mut self, now: Instant) -> Vec<Repair> {
        let mut silent = Vec::new();
        self.heard.retain(|gateway, heard| {
            let stays = now < heard.last + SILENCE;
            if !stays {
                silent.push(Repair::Silent(*gateway));
            }
            stays
        });
        silent
    }
}

/// The packet with the beacon of a gateway.
pub(super) fn packet(gateway: Incarnation, announced: Announced) -> Option<Vec<u8>> {
    let label = gateway.to_string();
    let mut labels = vec![Label::new(label.as_bytes()).ok()?];
    labels.extend(TYPE_LABELS.map(|label| Label::new_unchecked(label.as_bytes())));
    let Announced { all, coalitions } = announced;
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
    // The mDNS library keeps what belongs to no service that is introduced, and every change of it,
    // for ever.
    let service = Name::new_with_labels(&labels[1..]);
    let introduced = RData::PTR(PTR(Name::new_with_labels(&labels)));
    let record = ResourceRecord::new(service, CLASS::IN, TTL, introduced);
    packet.answers.push(record);
    packet.build_bytes_vec_compressed().ok()
}

/// The beacon that a packet is, if it is one.
pub(super) fn read(packet: &[u8]) -> Option<(Incarnation, Announced)> {
    // Nearly all packets are none: that is seen without reading them.
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
    let announced = Announced {
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
    fn beacons_are_read_as_they_were_written() {
        for numbers in [&[][..], &[7], &[1, 2, 3]] {
            let announced = Announced {
                all: digest(numbers),
                coalitions: digest(&numbers[numbers.len() / 2..]),
            };
            let written = packet(gateway(0xab), announced).unwrap();
            assert!(written.len() < 160, "{}", written.len());
            assert_eq!(read(&written), Some((gateway(0xab), announced)));
        }
        assert_eq!(read(b""), None);
        assert_eq!(read(&question_for_all(&[])[0]), None);
        // It introduces itself, or the mDNS library would keep it for ever.
        let written = packet(gateway(0xab), Announced::default()).unwrap();
        let answers = parse_answer(&written).unwrap().answers;
        let (of, introduced) = match &answers[..] {
            [of, pointer] => (of.name.clone(), pointer),
            other => panic!("{other:?}"),
        };
        assert_eq!(introduced.rdata, RData::PTR(PTR(of)));
        assert_eq!(introduced.name.to_string(), "_fipa_gateway._udp.local");
    }

    #[test]
    fn what_is_missing_is_asked_for_in_turns_with_what_is_too_much() {
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
        // What is held now is right, and then more than right.
        let now = start + Duration::from_secs(100);
        let held = |numbers: &[u64]| {
            Some(Held {
                digest: digest(numbers),
                changed: start,
            })
        };
        let mut hear = |millis, beacon: &[u64], held| {
            let now = now + Duration::from_millis(millis);
            beacons.handle(now, gateway(1), digest(beacon), held)
        };
        assert_eq!(hear(0, &[1, 2], held(&[1, 2])), None);
        // It has just changed; a moment later it counts.
        assert_eq!(hear(0, &[1], held(&[1, 2])), None);
        assert_eq!(
            hear(2000, &[1], held(&[1, 2])),
            Some(Repair::Surplus(gateway(1)))
        );
        let changing = Some(Held {
            digest: digest(&[1, 2]),
            changed: now + Duration::from_secs(9),
        });
        assert_eq!(hear(9500, &[1], changing), None);
    }

    #[test]
    fn the_silent_are_told_once() {
        let mut beacons = Beacons::default();
        let now = Instant::now();
        beacons.handle(now, gateway(1), digest(&[1]), None);
        assert_eq!(beacons.silent(now + SILENCE / 2), []);
        assert_eq!(beacons.silent(now + SILENCE), [Repair::Silent(gateway(1))]);
        assert_eq!(beacons.silent(now + SILENCE * 2), []);
        for number in 0..MAX_GATEWAYS as u64 + 10 {
            beacons.handle(now, gateway(number + 1), digest(&[]), None);
        }
        assert_eq!(beacons.heard.len(), MAX_GATEWAYS);
    }

    proptest! {
        #[test]
        fn broken_beacons_do_no_harm(at in 0_usize..140, byte: u8) {
            let mut written = packet(gateway(1), Announced::default()).unwrap();
            if let Some(broken) = written.get_mut(at) {
                *broken = byte;
            }
            let _ = read(&written);
        }
    }
}
