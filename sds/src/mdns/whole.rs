//! Reads the records of old peers as a whole.
//!
//! fipa_services splits a value that is longer than 200 bytes over several strings with the same
//! key. The mDNS library keeps only the first string of each key (RFC 6763 clause 6.4), so what
//! it finds of such a peer is asked for once more, by questions of our own, and read from the
//! answers with a DNS library that keeps all.
//!
//! The questions are ordinary multicast ones, because Avahi cuts what it answers to one host alone
//! at 512 bytes. The sockets are bound to the group's address: they take nothing away from others
//! on this port, to whom somebody answers directly.
//!
//! [`Reader`] decides what is asked when, and reads answers; [`Sockets`] is its shell.

use std::collections::HashMap;
use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, SocketAddrV4, SocketAddrV6};
use std::sync::Arc;
use std::task::Poll;
use std::time::{Duration, Instant};

use if_addrs::Interface;
use simple_dns::rdata::RData;
use simple_dns::{CLASS, Label, Name, Packet, QCLASS, QTYPE, Question, TYPE};
use socket2::{Domain, Protocol, SockRef, Socket, Type};
use tokio::io::ReadBuf;
use tokio::net::UdpSocket;

use super::record::Properties;
use super::{MdnsConfig, SERVICE_TYPE};

/// Largest packet of multicast DNS (RFC 6762 clause 17).
pub(super) const MAX_PACKET: usize = 9000;
/// Most records asked for at one time.
const MAX_WANTED: usize = 4096;
/// Most questions in one packet: they fit the smallest packet every network carries.
pub(super) const QUESTIONS: usize = 8;
/// When a record is asked for, after it was found. Who has just said it must not repeat it within
/// a second (RFC 6762 clause 6).
const PAUSES: [Duration; 4] = [
    Duration::from_millis(20),
    Duration::from_millis(1200),
    Duration::from_secs(3),
    Duration::from_secs(9),
];
/// Up to how much is added to that, so that not all ask at the same moment.
const JITTER: Duration = Duration::from_millis(100);
/// Most interfaces that are asked on.
const MAX_INTERFACES: usize = 32;

/// What is asked when, and what the answers say.
#[derive(Debug, Default)]
pub(super) struct Reader {
    /// By label, in lower case: so the network tells names apart.
    wanted: HashMap<Vec<u8>, Wanted>,
}

#[derive(Debug)]
struct Wanted {
    fullname: Arc<str>,
    label: Vec<u8>,
    asked: usize,
    due: Instant,
}

impl Reader {
    /// Asks for the record with this full name, which has this label. `chance`, from 0 to 1, says
    /// how much jitter there is.
    pub(super) fn want(&mut self, now: Instant, fullname: &Arc<str>, label: &str, chance: f64) {
        let key = label.as_bytes().to_ascii_lowercase();
        if self.wanted.len() >= MAX_WANTED && !self.wanted.contains_key(&key) {
            // What was found by the mDNS library stands.
            return;
        }
        let wanted = Wanted {
            fullname: Arc::clone(fullname),
            label: label.as_bytes().to_vec(),
            asked: 0,
            due: now + PAUSES[0] + JITTER.mul_f64(chance.clamp(0.0, 1.0)),
        };
        self.wanted.insert(key, wanted);
    }

    /// The record with this label is gone.
    pub(super) fn forget(&mut self, label: &str) {
        self.wanted.remove(&label.as_bytes().to_ascii_lowercase());
    }

    /// When there is something to be asked next.
    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        self.wanted.values().map(|wanted| wanted.due).min()
    }

    /// The packets to be sent now. What was asked for often enough is given up.
    pub(super) fn handle_timeout(&mut self, now: Instant) -> Vec<Vec<u8>> {
        let mut labels = Vec::new();
        self.wanted.retain(|_, wanted| {
            if wanted.due > now {
                return true;
            }
            wanted.asked += 1;
            match PAUSES.get(wanted.asked) {
                Some(pause) => wanted.due = now + *pause,
                // Time for the last answer.
                None if wanted.asked == PAUSES.len() => wanted.due = now + PAUSES[1],
                None => return false,
            }
            labels.push(wanted.label.clone());
            true
        });
        let packets = labels.chunks(QUESTIONS);
        packets
            .filter_map(|labels| question(labels, TYPE::TXT))
            .collect()
    }

    /// The records that a packet has and that were asked for, whole. What is no answer has none.
    pub(super) fn handle_packet(&mut self, packet: &[u8]) -> Vec<(Arc<str>, Properties)> {
        if self.wanted.is_empty() || !is_plausible(packet) {
            return Vec::new();
        }
        let Ok(packet) = Packet::parse(packet) else {
            return Vec::new();
        };
        let mut found = Vec::new();
        for record in packet.answers.iter().chain(&packet.additional_records) {
            let RData::TXT(txt) = &record.rdata else {
                continue;
            };
            // A goodbye says nothing about what the record is.
            if record.ttl == 0 || record.class != CLASS::IN {
                continue;
            }
            let wanted = label_of(&record.name).and_then(|label| self.wanted.remove(&label));
            let Some(wanted) = wanted else {
                continue;
            };
            let properties = txt.iter_raw().filter_map(|(key, value)| {
                let key = std::str::from_utf8(key).ok()?;
                Some((key.to_owned(), value.unwrap_or_default().to_vec()))
            });
            found.push((wanted.fullname, properties.collect()));
        }
        found
    }
}

/// The label of a record of our type, in lower case.
pub(super) fn label_of(name: &Name<'_>) -> Option<Vec<u8>> {
    let (label, rest) = name.get_labels().split_first()?;
    let same =
        |(one, other): (&Label<'_>, &str)| one.as_ref().eq_ignore_ascii_case(other.as_bytes());
    let of_our_type =
        rest.len() == service_labels().count() && rest.iter().zip(service_labels()).all(same);
    of_our_type.then(|| label.as_ref().to_ascii_lowercase())
}

fn service_labels() -> impl Iterator<Item = &'static str> {
    SERVICE_TYPE.split_terminator('.')
}

/// One packet that asks for the records of this kind with these labels. None when a label is none.
pub(super) fn question(labels: &[Vec<u8>], kind: TYPE) -> Option<Vec<u8>> {
    let mut packet = Packet::new_query(0);
    for label in labels {
        let mut name = vec![Label::new(label.as_slice()).ok()?];
        name.extend(service_labels().map(|label| Label::new_unchecked(label.as_bytes())));
        packet.questions.push(Question::new(
            Name::new_with_labels(&name),
            QTYPE::TYPE(kind),
            QCLASS::CLASS(CLASS::IN),
            false,
        ));
    }
    packet.build_bytes_vec_compressed().ok()
}

/// Whether the packet is an answer, and large enough for as many records as it claims to have:
/// the library takes memory for them before it looks.
pub(super) fn is_plausible(packet: &[u8]) -> bool {
    let Some(header) = packet.first_chunk::<12>() else {
        return false;
    };
    let count = |at: usize| usize::from(u16::from_be_bytes([header[at], header[at + 1]]));
    let claimed = count(4) * 5 + (count(6) + count(8) + count(10)) * 11;
    let is_answer = header[2] & 0x80 != 0;
    is_answer && packet.len() <= MAX_PACKET && claimed + header.len() <= packet.len()
}

/// Sockets of the multicast group, one for each interface and family of addresses.
#[derive(Debug)]
pub(super) struct Sockets {
    open: Vec<(UdpSocket, SocketAddr)>,
    /// Those they are for.
    interfaces: Vec<Interface>,
    buffer: Vec<u8>,
}

impl Sockets {
    /// None yet.
    pub(super) fn new() -> Self {
        Self {
            open: Vec::new(),
            interfaces: Vec::new(),
            buffer: vec![0; MAX_PACKET],
        }
    }

    /// Opens what can be opened of the interfaces that the configuration names, if they are not
    /// the same as before.
    pub(super) fn refresh(&mut self, config: &MdnsConfig) -> io::Result<()> {
        let interfaces = interfaces(config)?;
        if interfaces == self.interfaces {
            return Ok(());
        }
        self.open.clear();
        let mut indices = Vec::new();
        let mut last_error = None;
        for interface in &interfaces {
            let opened = match interface.ip() {
                IpAddr::V4(address) => group_v4(address, config.port),
                IpAddr::V6(_) => {
                    let index = interface.index.unwrap_or_default();
                    // One for all addresses of an interface.
                    if indices.contains(&index) {
                        continue;
                    }
                    indices.push(index);
                    group_v6(index, config.port)
                }
            };
            let opened = opened.and_then(|(socket, to)| Ok((UdpSocket::from_std(socket)?, to)));
            match opened {
                Ok(socket) => self.open.push(socket),
                Err(error) => last_error = Some(error),
            }
        }
        match last_error {
            // An address that is not usable yet may be in a moment.
            Some(error) if self.open.is_empty() => Err(error),
            _ => {
                self.interfaces = interfaces;
                Ok(())
            }
        }
    }

    /// Sends the packet on all interfaces. One that fails is no reason not to ask on the others.
    pub(super) fn send(&self, packet: &[u8]) {
        for (socket, group) in &self.open {
            if let Err(error) = SockRef::from(socket).send_to(packet, &(*group).into()) {
                tracing::debug!(%error, %group, "an mDNS question was not sent");
            }
        }
    }

    /// The next packet. Cancelling the future loses nothing.
    pub(super) async fn receive(&mut self) -> &[u8] {
        let Self { open, buffer, .. } = self;
        let len = std::future::poll_fn(|context| {
            for (socket, _) in open.iter() {
                let mut packet = ReadBuf::new(buffer);
                // An error is told once, and stands for a packet that did not come.
                while let Poll::Ready(received) = socket.poll_recv(context, &mut packet) {
                    if received.is_ok() {
                        return Poll::Ready(packet.filled().len());
                    }
                }
            }
            Poll::Pending
        })
        .await;
        self.buffer.get(..len).unwrap_or_default()
    }
}

/// Sends one packet on all interfaces, for who has no sockets any more. One that fails is no reason
/// not to send on the others.
pub(super) fn send_once(config: &MdnsConfig, packet: &[u8]) -> io::Result<()> {
    let mut indices = Vec::new();
    let mut last_error = None;
    for interface in interfaces(config)? {
        let index = interface.index.unwrap_or_default();
        let opened = match interface.ip() {
            IpAddr::V4(address) => group_v4(address, config.port),
            IpAddr::V6(_) if indices.contains(&index) => continue,
            IpAddr::V6(_) => {
                indices.push(index);
                group_v6(index, config.port)
            }
        };
        let sent = opened.and_then(|(socket, group)| socket.send_to(packet, group));
        last_error = sent.err().or(last_error);
    }
    last_error.map_or(Ok(()), Err)
}

/// The addresses of those that are up and that the configuration names.
pub(super) fn interfaces(config: &MdnsConfig) -> io::Result<Vec<Interface>> {
    let mut interfaces = if_addrs::get_if_addrs()?;
    interfaces.retain(|interface| {
        let chosen = |one: &String| match one.parse::<IpAddr>() {
            Ok(address) => address == interface.ip(),
            Err(_) => *one == interface.name,
        };
        let all = config.interfaces.is_empty();
        interface.is_oper_up() && (all || config.interfaces.iter().any(chosen))
    });
    interfaces.truncate(MAX_INTERFACES);
    Ok(interfaces)
}

/// A socket in the group of an interface, which is not waited for, and the group.
pub(super) type Grouped = (std::net::UdpSocket, SocketAddr);

pub(super) fn group_v4(interface: Ipv4Addr, port: u16) -> io::Result<Grouped> {
    let group = Ipv4Addr::new(224, 0, 0, 251);
    let address = SocketAddr::V4(SocketAddrV4::new(group, port));
    let socket = socket(Domain::IPV4, address)?;
    let of_socket = SockRef::from(&socket);
    of_socket.set_multicast_if_v4(&interface)?;
    of_socket.set_multicast_all_v4(false)?;
    of_socket.set_multicast_ttl_v4(255)?;
    of_socket.join_multicast_v4(&group, &interface)?;
    Ok((socket, address))
}

pub(super) fn group_v6(interface: u32, port: u16) -> io::Result<Grouped> {
    let group = Ipv6Addr::new(0xff02, 0, 0, 0, 0, 0, 0, 0xfb);
    let address = SocketAddr::V6(SocketAddrV6::new(group, port, 0, interface));
    let socket = socket(Domain::IPV6, address)?;
    let of_socket = SockRef::from(&socket);
    of_socket.set_multicast_if_v6(interface)?;
    of_socket.set_multicast_all_v6(false)?;
    of_socket.set_multicast_hops_v6(255)?;
    of_socket.join_multicast_v6(&group, interface)?;
    Ok((socket, address))
}

fn socket(domain: Domain, address: SocketAddr) -> io::Result<std::net::UdpSocket> {
    let socket = Socket::new(domain, Type::DGRAM, Some(Protocol::UDP))?;
    if domain == Domain::IPV6 {
        socket.set_only_v6(true)?;
    }
    socket.set_reuse_address(true)?;
    socket.set_reuse_port(true)?;
    socket.set_nonblocking(true)?;
    socket.bind(&address.into())?;
    Ok(socket.into())
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use simple_dns::rdata::TXT;
    use simple_dns::{CharacterString, PacketFlag, ResourceRecord};

    use super::*;

    fn fullname(label: &str) -> Arc<str> {
        format!("{label}.{SERVICE_TYPE}").into()
    }

    fn answer(label: &str, strings: &[&[u8]], ttl: u32) -> Vec<u8> {
        let mut labels = vec![Label::new(label.as_bytes()).unwrap()];
        labels.extend(service_labels().map(|one| Label::new(one.as_bytes()).unwrap()));
        let mut txt = TXT::new();
        for string in strings {
            txt.add_char_string(CharacterString::new(string).unwrap());
        }
        let mut packet = Packet::new_reply(0);
        packet.set_flags(PacketFlag::AUTHORITATIVE_ANSWER);
        packet.answers.push(ResourceRecord::new(
            Name::new_with_labels(&labels),
            CLASS::IN,
            ttl,
            RData::TXT(txt),
        ));
        packet.build_bytes_vec_compressed().unwrap()
    }

    #[test]
    fn all_strings_are_read_in_order() {
        let mut reader = Reader::default();
        let now = Instant::now();
        reader.want(now, &fullname("arm?left"), "arm?left", 0.5);
        let strings: [&[u8]; 4] = [b"LOCATOR=tcp://a", b"TYPE=\xff", b"locator=:1 x;", b"flag"];
        let others = answer("leg", &strings, 120);
        assert!(reader.handle_packet(&others).is_empty());
        assert!(
            reader
                .handle_packet(&answer("arm?left", &strings, 0))
                .is_empty()
        );
        let found = reader.handle_packet(&answer("ARM?left", &strings, 120));
        let [(name, properties)] = &found[..] else {
            panic!("{found:?}");
        };
        assert_eq!(*name, fullname("arm?left"));
        let expected: [(&str, &[u8]); 4] = [
            ("LOCATOR", b"tcp://a"),
            ("TYPE", b"\xff"),
            ("locator", b":1 x;"),
            ("flag", b""),
        ];
        let expected = expected.map(|(key, value)| (key.to_owned(), value.to_vec()));
        assert_eq!(*properties, expected);
        assert_eq!(reader.poll_timeout(), None);
    }

    #[test]
    fn what_nobody_answers_is_asked_a_few_times() {
        let mut reader = Reader::default();
        let mut now = Instant::now();
        for number in 0..QUESTIONS + 1 {
            let label = format!("agent {number}");
            reader.want(now, &fullname(&label), &label, 0.0);
        }
        let mut packets = 0;
        while let Some(due) = reader.poll_timeout() {
            assert!(due > now, "time goes on");
            now = due;
            for packet in reader.handle_timeout(now) {
                packets += 1;
                assert!(packet.len() < 1232, "{}", packet.len());
                let packet = Packet::parse(&packet).unwrap();
                let name = packet.questions[0].qname.to_string();
                assert!(
                    name.ends_with("._fipa_service_directory._udp.local"),
                    "{name}"
                );
            }
        }
        assert_eq!(packets, 2 * PAUSES.len());
        assert_eq!(reader.poll_timeout(), None);
    }

    #[test]
    fn what_is_asked_for_is_bounded() {
        let mut reader = Reader::default();
        let now = Instant::now();
        for number in 0..MAX_WANTED + 10 {
            let label = number.to_string();
            reader.want(now, &fullname(&label), &label, 1.0);
        }
        assert_eq!(reader.wanted.len(), MAX_WANTED);
        reader.forget("1");
        assert_eq!(reader.wanted.len(), MAX_WANTED - 1);
    }

    #[test]
    fn packets_that_claim_more_than_they_have_are_not_read() {
        let good = answer("arm", &[b"TYPE=x"], 120);
        assert!(is_plausible(&good));
        for at in [4, 6, 8, 10] {
            let mut claims = good.clone();
            claims[at] = 0xff;
            assert!(!is_plausible(&claims));
        }
        // A name that points to itself.
        let mut reader = Reader::default();
        reader.want(Instant::now(), &fullname("arm"), "arm", 0.0);
        let mut cyclic = vec![0, 0, 0x84, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0xc0, 12];
        cyclic.extend([0, 16, 0, 1, 0, 0, 0, 1, 0, 0]);
        assert!(reader.handle_packet(&cyclic).is_empty());
        assert!(reader.poll_timeout().is_some());
    }

    proptest! {
        #[test]
        fn arbitrary_packets_do_no_harm(
            mut packet in prop::collection::vec(any::<u8>(), 0..600),
            answers in 0..8_u8,
        ) {
            let mut reader = Reader::default();
            reader.want(Instant::now(), &fullname("arm"), "arm", 0.0);
            if let Some(header) = packet.first_chunk_mut::<12>() {
                *header = [0, 0, 0x84, 0, 0, 0, 0, answers, 0, 0, 0, 0];
            }
            reader.handle_packet(&packet);
        }

        #[test]
        fn broken_answers_do_no_harm(at in 0_usize..120, byte: u8) {
            let mut reader = Reader::default();
            reader.want(Instant::now(), &fullname("arm"), "arm", 0.0);
            let mut packet = answer("arm", &[b"TYPE=x", b"LOCATOR=y", b"LOCATOR=z"], 120);
            if let Some(broken) = packet.get_mut(at) {
                *broken = byte;
            }
            reader.handle_packet(&packet);
        }
    }
}
