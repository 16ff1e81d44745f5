//! Packets of multicast DNS for records of this service type: builds queries and announcements,
//! parses packets.

use simple_dns::ResourceRecord;
use simple_dns::rdata::{PTR, RData, SRV, TXT};
use simple_dns::{
    CLASS, CharacterString, Label, Name, Packet, PacketFlag, QCLASS, QTYPE, Question, TYPE,
};

use super::SERVICE_TYPE;
use super::record::Properties;

/// Largest packet of multicast DNS (RFC 6762 clause 17).
pub(super) const MAX_PACKET: usize = 9000;
/// TTLs of records that name a host, and of others, in seconds (RFC 6762 clause 10).
const HOST_TTL: u32 = 120;
const OTHER_TTL: u32 = 4500;
/// Maximum number of questions in one packet, so that it fits the smallest MTU.
const QUESTIONS: usize = 12;
/// Maximum number of known answers in one packet, for the same reason.
pub(super) const KNOWN: usize = 14;

/// Parses a packet. A packet that is too short for the number of records in its header is rejected
/// first, because the library allocates memory for them before it checks.
pub(super) fn parse(packet: &[u8]) -> Option<Packet<'_>> {
    let header = packet.first_chunk::<12>()?;
    let count = |at: usize| usize::from(u16::from_be_bytes([header[at], header[at + 1]]));
    let claimed = count(4) * 5 + (count(6) + count(8) + count(10)) * 11;
    let fits = packet.len() <= MAX_PACKET && claimed + header.len() <= packet.len();
    fits.then(|| Packet::parse(packet).ok())?
}

/// Parses a packet if it is a response.
pub(super) fn parse_answer(packet: &[u8]) -> Option<Packet<'_>> {
    parse(packet).filter(|packet| packet.has_flags(PacketFlag::RESPONSE))
}

/// Whether the packet may name this service type. Rejects most packets without parsing.
pub(super) fn may_name_our_type(packet: &[u8]) -> bool {
    let name = service_labels().next().unwrap_or_default().as_bytes();
    memchr::memchr_iter(b'_', packet).any(|at| {
        let found = packet.get(at..at + name.len());
        found.is_some_and(|found| found.eq_ignore_ascii_case(name))
    })
}

/// The label of a record of this type, with its original spelling.
pub(super) fn label_of<'a>(name: &'a Name<'_>) -> Option<&'a str> {
    let (label, rest) = name.get_labels().split_first()?;
    is_of_our_type(rest).then(|| std::str::from_utf8(label.as_ref()).ok())?
}

/// Whether it is the name of this service type.
pub(super) fn is_service(name: &Name<'_>) -> bool {
    is_of_our_type(name.get_labels())
}

fn is_of_our_type(labels: &[Label<'_>]) -> bool {
    let same =
        |(one, other): (&Label<'_>, &str)| one.as_ref().eq_ignore_ascii_case(other.as_bytes());
    labels.len() == service_labels().count() && labels.iter().zip(service_labels()).all(same)
}

/// All strings of a TXT record, in order.
pub(super) fn properties(txt: &TXT<'_>) -> Properties {
    let properties = txt.iter_raw().filter_map(|(key, value)| {
        let key = std::str::from_utf8(key).ok()?;
        Some((key.to_owned(), value.unwrap_or_default().to_vec()))
    });
    properties.collect()
}

/// Builds queries for records of these kinds with these labels. Invalid labels are skipped.
pub(super) fn questions<'a>(
    labels: &'a [impl AsRef<str>],
    kinds: &'a [TYPE],
) -> impl Iterator<Item = Vec<u8>> + 'a {
    labels
        .chunks(QUESTIONS / kinds.len())
        .filter_map(move |labels| {
            let mut packet = Packet::new_query(0);
            for label in labels {
                let Some(name) = name_of(label.as_ref()) else {
                    continue;
                };
                for kind in kinds {
                    let (kind, class) = (QTYPE::TYPE(*kind), QCLASS::CLASS(CLASS::IN));
                    let question = Question::new(name.clone(), kind, class, false);
                    packet.questions.push(question);
                }
            }
            packet.build_bytes_vec_compressed().ok()
        })
}

/// Builds a query for all records of this type except those with these labels (RFC 6762 clause
/// 7.1).
pub(super) fn question_for_all(known: &[&str]) -> Vec<Vec<u8>> {
    let service = Name::new_unchecked(SERVICE_TYPE);
    let mut chunks = known.chunks(KNOWN);
    let first = chunks.next().unwrap_or_default();
    let all = std::iter::once(first).chain(chunks);
    let last = known.len().div_ceil(KNOWN).max(1) - 1;
    let packets = all.enumerate().filter_map(|(number, chunk)| {
        let mut packet = Packet::new_query(0);
        if number == 0 {
            let (kind, class) = (QTYPE::TYPE(TYPE::PTR), QCLASS::CLASS(CLASS::IN));
            let question = Question::new(service.clone(), kind, class, false);
            packet.questions.push(question);
        }
        if number < last {
            packet.set_flags(PacketFlag::TRUNCATION);
        }
        for name in chunk.iter().filter_map(|label| name_of(label)) {
            let pointer = RData::PTR(PTR(name));
            let known = ResourceRecord::new(service.clone(), CLASS::IN, 4500, pointer);
            packet.answers.push(known);
        }
        packet.build_bytes_vec_compressed().ok()
    });
    packets.collect()
}

fn name_of(label: &str) -> Option<Name<'_>> {
    let mut name = vec![Label::new(label.as_bytes()).ok()?];
    name.extend(service_labels().map(|label| Label::new_unchecked(label.as_bytes())));
    Some(Name::new_with_labels(&name))
}

/// Builds a packet that announces a record of this type: its label, host and properties. Receivers
/// replace their stored version (RFC 6762 clause 10.2). Returns `None` if it does not fit a packet.
pub(super) fn announcement(label: &str, host: &str, says: &Properties) -> Option<Vec<u8>> {
    let strings: Vec<Vec<u8>> = says
        .iter()
        .map(|(key, value)| [key.as_bytes(), b"=", value].concat())
        .collect();
    let mut txt = TXT::new();
    for string in &strings {
        txt.add_char_string(CharacterString::new(string).ok()?);
    }
    let name = name_of(label)?;
    let place = RData::SRV(SRV {
        priority: 0,
        weight: 0,
        port: 0,
        target: Name::new(host).ok()?,
    });
    let service = Name::new_unchecked(SERVICE_TYPE);
    let introduced = RData::PTR(PTR(name.clone()));
    let mut packet = Packet::new_reply(0);
    packet.set_flags(PacketFlag::AUTHORITATIVE_ANSWER);
    packet.answers = vec![
        ResourceRecord::new(service, CLASS::IN, OTHER_TTL, introduced),
        ResourceRecord::new(name.clone(), CLASS::IN, HOST_TTL, place).with_cache_flush(true),
        ResourceRecord::new(name, CLASS::IN, OTHER_TTL, RData::TXT(txt)).with_cache_flush(true),
    ];
    let packet = packet.build_bytes_vec_compressed().ok()?;
    (packet.len() <= MAX_PACKET).then_some(packet)
}

fn service_labels() -> impl Iterator<Item = &'static str> {
    SERVICE_TYPE.split_terminator('.')
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// A record of a packet.
    pub(in crate::mdns) enum Part<'a> {
        Ptr,
        /// SRV record with this host.
        Srv(&'a str),
        /// TXT record with these strings.
        Txt(&'a [&'a [u8]]),
    }

    /// Builds an answer with these records of the instance with this label.
    pub(in crate::mdns) fn answer(label: &str, parts: &[Part<'_>], ttl: u32) -> Vec<u8> {
        let mut packet = Packet::new_reply(0);
        packet.set_flags(PacketFlag::AUTHORITATIVE_ANSWER);
        for part in parts {
            let mut name = name_of(label).unwrap();
            let data = match part {
                Part::Ptr => {
                    let instance = std::mem::replace(&mut name, Name::new_unchecked(SERVICE_TYPE));
                    RData::PTR(PTR(instance))
                }
                Part::Srv(host) => RData::SRV(SRV {
                    priority: 0,
                    weight: 0,
                    port: 0,
                    target: Name::new_unchecked(host),
                }),
                Part::Txt(strings) => {
                    let mut txt = TXT::new();
                    for string in *strings {
                        txt.add_char_string(CharacterString::new(string).unwrap());
                    }
                    RData::TXT(txt)
                }
            };
            let record = ResourceRecord::new(name, CLASS::IN, ttl, data);
            packet.answers.push(record);
        }
        packet.build_bytes_vec_compressed().unwrap()
    }

    /// The labels and kinds that packets query for.
    pub(in crate::mdns) fn asked(packets: &[Vec<u8>]) -> Vec<(String, QTYPE)> {
        let mut asked = Vec::new();
        for packet in packets {
            assert!(packet.len() < 1232, "{}", packet.len());
            for question in parse(packet).unwrap().questions {
                let label = label_of(&question.qname).unwrap_or_default();
                asked.push((label.to_owned(), question.qtype));
            }
        }
        asked
    }

    #[test]
    fn an_announcement_contains_the_properties_of_the_record() {
        let says: Properties = vec![
            ("fipa-name".into(), b"arm".to_vec()),
            ("fipa-locations".into(), b"tcp://10.0.0.2:7788".to_vec()),
        ];
        let packet = announcement("arm", "fipa-1.local", &says).unwrap();
        let packet = parse_answer(&packet).unwrap();
        let [introduced, place, text] = &packet.answers[..] else {
            panic!("{packet:?}")
        };
        assert!(is_service(&introduced.name) && !introduced.cache_flush);
        for record in [place, text] {
            assert_eq!(label_of(&record.name), Some("arm"));
            assert!(record.cache_flush);
        }
        let RData::TXT(txt) = &text.rdata else {
            panic!("{text:?}")
        };
        assert_eq!(properties(txt), says);
        let long = vec![("x".to_owned(), vec![0; 250]); 40];
        assert_eq!(announcement("arm", "fipa-1.local", &long), None);
    }

    #[test]
    fn questions_fit_the_smallest_packet() {
        let labels: Vec<String> = (0..30)
            .map(|number| format!("Agent {number:02} {}", "x".repeat(54)))
            .collect();
        for kinds in [&[TYPE::SRV][..], &[TYPE::SRV, TYPE::TXT]] {
            let packets: Vec<_> = questions(&labels, kinds).collect();
            let asked = asked(&packets);
            assert_eq!(asked.len(), labels.len() * kinds.len());
            assert_eq!(asked[0].0, labels[0], "the spelling is kept");
        }
    }

    #[test]
    fn known_answers_are_listed_in_a_query_for_all() {
        let labels: Vec<String> = (0..30).map(|number| format!("agent {number}")).collect();
        let labels: Vec<&str> = labels.iter().map(String::as_str).collect();
        let packets = question_for_all(&labels);
        let parsed: Vec<_> = packets
            .iter()
            .map(|packet| parse(packet).unwrap())
            .collect();
        let [first, second, third] = &parsed[..] else {
            panic!("{parsed:?}");
        };
        assert_eq!((first.questions.len(), second.questions.len()), (1, 0));
        assert!(is_service(&first.questions[0].qname));
        assert!(second.has_flags(PacketFlag::TRUNCATION));
        assert!(!third.has_flags(PacketFlag::TRUNCATION));
        let known: usize = parsed.iter().map(|packet| packet.answers.len()).sum();
        assert_eq!(known, 30);
        assert!(packets.iter().all(|packet| packet.len() < 1232));
        assert_eq!(question_for_all(&[]).len(), 1);
    }

    #[test]
    fn packets_with_fewer_records_than_claimed_are_rejected() {
        let good = answer("arm", &[Part::Txt(&[b"TYPE=x"])], 120);
        assert!(parse_answer(&good).is_some());
        for at in [4, 6, 8, 10] {
            let mut claims = good.clone();
            claims[at] = 0xff;
            assert!(parse(&claims).is_none());
        }
        let question = &question_for_all(&["arm"])[0];
        assert!(may_name_our_type(question) && may_name_our_type(&good));
        assert!(may_name_our_type(&good.to_ascii_uppercase()));
        assert!(!may_name_our_type(&good[..30]) && !may_name_our_type(b"__fipa_"));
        assert!(parse(question).is_some() && parse_answer(question).is_none());
        // A name that points to itself.
        let mut cyclic = vec![0, 0, 0x84, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0xc0, 12];
        cyclic.extend([0, 16, 0, 1, 0, 0, 0, 1, 0, 0]);
        assert!(parse(&cyclic).is_none());
    }
}
