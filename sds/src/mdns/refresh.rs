//! Keeps what is known of others from expiring, with few packets.
//!
//! Where a record is (SRV, A and AAAA) is good for two minutes. The mDNS library asks for it after
//! 80 % of that (RFC 6762 clause 5.2), for each record in packets of its own; with a thousand
//! records that is much of what an idle network carries and an idle gateway does. So they are
//! asked for a little earlier, many in one packet. The answers go to all, and whoever has
//! heard one need not ask (RFC 6762 clause 7.3).

use std::collections::HashMap;
use std::time::{Duration, Instant};

use simple_dns::rdata::RData;
use simple_dns::{CLASS, Packet, TYPE};

use super::MdnsDirectory;
use super::whole::{is_plausible, label_of, question};

/// How often it is looked whether something is to be asked: what has become due meanwhile is asked
/// together.
const TICK: Duration = Duration::from_secs(5);
/// After what time without having heard of it a record is asked for. With the tick and the jitter
/// that is well below 80 % of two minutes.
const AGE: Duration = Duration::from_secs(65);
/// Up to how much is added to that, so that one host asks and the others need not.
const JITTER: Duration = Duration::from_secs(15);
/// Most questions in one packet: they, and their answers, fit the smallest packet every network
/// carries.
const QUESTIONS: usize = 12;

/// When which record was heard of last.
#[derive(Debug, Default)]
pub(super) struct Refresh {
    /// By label, in lower case: so the network tells names apart.
    records: HashMap<Vec<u8>, Heard>,
    next: Option<Instant>,
}

#[derive(Debug)]
struct Heard {
    /// As it is spelt: the library knows it by that only, and is answered as it was asked.
    label: Vec<u8>,
    last: Instant,
}

impl Refresh {
    /// The record with this label is known.
    pub(super) fn put(&mut self, now: Instant, label: &str) {
        let key = label.as_bytes().to_ascii_lowercase();
        // What is beyond is refreshed by the library.
        if self.records.len() < MdnsDirectory::MAX_RECORDS || self.records.contains_key(&key) {
            let label = label.as_bytes().to_vec();
            self.records.insert(key, Heard { label, last: now });
            self.next.get_or_insert(now + TICK);
        }
    }

    /// The record with this label is gone.
    pub(super) fn forget(&mut self, label: &str) {
        self.records.remove(&label.as_bytes().to_ascii_lowercase());
    }

    /// Somebody was answered.
    pub(super) fn handle_packet(&mut self, now: Instant, packet: &[u8]) {
        if self.records.is_empty() || !is_plausible(packet) {
            return;
        }
        let Ok(packet) = Packet::parse(packet) else {
            return;
        };
        for record in packet.answers.iter().chain(&packet.additional_records) {
            let is_place = matches!(record.rdata, RData::SRV(_));
            if is_place
                && record.ttl > 0
                && record.class == CLASS::IN
                && let Some(label) = label_of(&record.name)
                && let Some(heard) = self.records.get_mut(&label)
            {
                heard.last = now;
            }
        }
    }

    /// The packets to be sent now. `chance`, from 0 to 1, says how much jitter there is.
    pub(super) fn handle_timeout(&mut self, now: Instant, chance: f64) -> Vec<Vec<u8>> {
        if self.next.is_none_or(|next| now < next) {
            return Vec::new();
        }
        self.next = (!self.records.is_empty()).then_some(now + TICK);
        let age = AGE + JITTER.mul_f64(chance.clamp(0.0, 1.0));
        let mut labels = Vec::new();
        for heard in self.records.values_mut() {
            if heard.last + age <= now {
                // If nobody answers, the library asks once more before it is given up.
                heard.last = now;
                labels.push(heard.label.clone());
            }
        }
        let packets = labels.chunks(QUESTIONS);
        packets
            .filter_map(|labels| question(labels, TYPE::SRV))
            .collect()
    }

    /// When it is to be looked again.
    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        self.next
    }
}

#[cfg(test)]
mod tests {
    use simple_dns::rdata::SRV;
    use simple_dns::{Label, Name, PacketFlag, QTYPE, ResourceRecord};

    use super::*;

    fn answer(label: &str, ttl: u32) -> Vec<u8> {
        let name = format!("{label}.{}", super::super::SERVICE_TYPE);
        let labels: Vec<Label<'_>> = name
            .split_terminator('.')
            .map(|one| Label::new(one.as_bytes()).unwrap())
            .collect();
        let srv = SRV {
            priority: 0,
            weight: 0,
            port: 0,
            target: Name::new_unchecked("host.local"),
        };
        let mut packet = Packet::new_reply(0);
        packet.set_flags(PacketFlag::AUTHORITATIVE_ANSWER);
        packet.answers.push(ResourceRecord::new(
            Name::new_with_labels(&labels),
            CLASS::IN,
            ttl,
            RData::SRV(srv),
        ));
        packet.build_bytes_vec_compressed().unwrap()
    }

    /// The labels that packets ask for.
    fn asked(packets: &[Vec<u8>]) -> Vec<String> {
        let mut labels = Vec::new();
        for packet in packets {
            assert!(packet.len() < 1232);
            for question in Packet::parse(packet).unwrap().questions {
                assert_eq!(question.qtype, QTYPE::TYPE(TYPE::SRV));
                let label = question.qname.get_labels()[0].as_ref();
                labels.push(String::from_utf8(label.to_vec()).unwrap());
            }
        }
        labels.sort();
        labels
    }

    #[test]
    fn what_nobody_has_heard_of_for_long_is_asked_for_together() {
        let (mut refresh, start) = (Refresh::default(), Instant::now());
        assert_eq!(refresh.poll_timeout(), None);
        for number in 0..30 {
            let label = format!("Agent {number:02} {}", "x".repeat(54));
            refresh.put(start, &label);
        }
        refresh.put(start, "heard");
        refresh.put(start, "gone");
        let mut rounds = Vec::new();
        for _ in 0..40 {
            let now = refresh.poll_timeout().unwrap();
            if now == start + Duration::from_secs(30) {
                refresh.handle_packet(now, &answer("gone", 120));
                // A goodbye is no sign of life.
                refresh.handle_packet(now, &answer("Agent 00", 0));
                refresh.handle_packet(now, &answer("HEARD", 120));
                refresh.forget("Gone");
            }
            let packets = refresh.handle_timeout(now, 0.5);
            if !packets.is_empty() {
                rounds.push((now - start, packets.len(), asked(&packets)));
            }
        }
        let [(first, packets, many), (second, 1, one), (third, ..), ..] = &rounds[..] else {
            panic!("{rounds:?}");
        };
        assert_eq!((first.as_secs(), *packets, many.len()), (75, 3, 30));
        assert!(many[0].starts_with("Agent 00"), "as it is spelt");
        assert_eq!(
            (second.as_secs(), &one[..]),
            (105, &["heard".to_owned()][..])
        );
        assert_eq!(third.as_secs(), 150);
    }

    #[test]
    fn records_never_come_near_their_end() {
        for chance in [0.0, 0.3, 1.0] {
            let (mut refresh, start) = (Refresh::default(), Instant::now());
            refresh.put(start, "arm");
            let mut last = start;
            while last < start + Duration::from_secs(1000) {
                let now = refresh.poll_timeout().unwrap();
                if !refresh.handle_timeout(now, chance).is_empty() {
                    assert!(now - last < Duration::from_secs(96), "{chance}");
                    last = now;
                }
            }
        }
    }

    #[test]
    fn what_is_remembered_is_bounded() {
        let (mut refresh, now) = (Refresh::default(), Instant::now());
        for number in 0..MdnsDirectory::MAX_RECORDS + 10 {
            refresh.put(now, &number.to_string());
        }
        assert_eq!(refresh.records.len(), MdnsDirectory::MAX_RECORDS);
    }
}
