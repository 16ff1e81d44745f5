//! Diagnoses multicast on each interface, for a user whose gateways do not find each other.
//!
//! A query is sent by multicast from the mDNS port, which other hosts answer by multicast, and from
//! an ephemeral port, which they answer by unicast (RFC 6762 clause 6.7). The answers distinguish
//! the two directions. The probe registers nothing and changes no other host.

use std::collections::BTreeSet;
use std::io;
use std::net::{IpAddr, Ipv6Addr, SocketAddr, UdpSocket};
use std::time::{Duration, Instant};

use if_addrs::Interface;
use simple_dns::{CLASS, Name, Packet, QCLASS, QTYPE, Question, TYPE};
use socket2::{Domain, Protocol, Socket, Type};

use super::packet::{self, MAX_PACKET};
use super::sockets::{group_v4, group_v6, interfaces};
use super::{MdnsConfig, SERVICE_TYPE};

/// Queried in addition to this project's service type: any host with any service answers (RFC 6763
/// clause 9).
const ANY_SERVICE: &str = "_services._dns-sd._udp.local.";
/// Times of the queries. A host that has just multicast an answer may stay silent for a second (RFC
/// 6762 clause 6).
const ASKED: [Duration; 3] = [
    Duration::ZERO,
    Duration::from_millis(300),
    Duration::from_millis(1300),
];
/// Total time to wait for answers. Gateways send a beacon every 2 to 2.5 s.
const TIMEOUT: Duration = Duration::from_millis(2700);
/// Interval between polls of the sockets.
const TICK: Duration = Duration::from_millis(5);
/// Maximum number of hosts remembered per interface.
const MAX_OTHERS: usize = 1000;

/// Result for one interface and address family.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Multicast {
    /// The name of the interface.
    pub interface: String,
    /// The address of this host on it.
    pub address: IpAddr,
    /// The error that prevented sending or receiving, if any.
    pub error: Option<String>,
    /// Whether this host received its own query, which shows that the system lets multicast out and
    /// in.
    pub heard_itself: bool,
    /// Hosts from which any multicast packet arrived.
    pub multicasting: BTreeSet<IpAddr>,
    /// Hosts that answered the query by unicast.
    pub answered: BTreeSet<IpAddr>,
}

/// Probes multicast on all interfaces in the configuration; loopback only when it is named. Blocks
/// for about three seconds.
///
/// # Errors
/// Fails when the interfaces of this machine cannot be listed.
pub fn probe(config: &MdnsConfig) -> io::Result<Vec<Multicast>> {
    let mut own: Vec<IpAddr> = Vec::new();
    let mut probes: Vec<Probe> = Vec::new();
    for interface in interfaces(config)? {
        own.push(interface.ip());
        let named = !config.interfaces.is_empty();
        let same = |probe: &Probe| {
            probe.found.interface == interface.name
                && probe.found.address.is_ipv4() == interface.ip().is_ipv4()
        };
        if (named || !interface.is_loopback()) && !probes.iter().any(same) {
            probes.push(Probe::open(&interface, config.port));
        }
    }
    let question = question().map_err(io::Error::other)?;
    let mut buffer = vec![0; MAX_PACKET];
    let (started, mut asked) = (Instant::now(), 0);
    while started.elapsed() < TIMEOUT && !probes.is_empty() {
        if ASKED
            .get(asked)
            .is_some_and(|due| started.elapsed() >= *due)
        {
            asked += 1;
            for probe in &mut probes {
                probe.ask(&question);
            }
        }
        for probe in &mut probes {
            probe.listen(&mut buffer, &question, &own);
        }
        std::thread::sleep(TICK);
    }
    Ok(probes.into_iter().map(|probe| probe.found).collect())
}

/// One interface and address family.
struct Probe {
    found: Multicast,
    sockets: Option<Sockets>,
}

struct Sockets {
    /// Socket in the group.
    group: UdpSocket,
    /// Socket on an ephemeral port.
    direct: UdpSocket,
    /// Address of the group.
    to: SocketAddr,
}

impl Probe {
    fn open(interface: &Interface, port: u16) -> Self {
        let found = Multicast {
            interface: interface.name.clone(),
            address: interface.ip(),
            error: None,
            heard_itself: false,
            multicasting: BTreeSet::new(),
            answered: BTreeSet::new(),
        };
        let mut probe = Self {
            found,
            sockets: None,
        };
        match Sockets::open(interface, port) {
            Ok(sockets) => probe.sockets = Some(sockets),
            Err(error) => probe.failed(&error),
        }
        probe
    }

    fn failed(&mut self, error: &io::Error) {
        self.found.error.get_or_insert_with(|| error.to_string());
    }

    fn ask(&mut self, question: &[u8]) {
        let Some(sockets) = &self.sockets else {
            return;
        };
        let sent = sockets.group.send_to(question, sockets.to);
        let sent = sent.and_then(|_| sockets.direct.send_to(question, sockets.to));
        if let Err(error) = sent {
            self.failed(&error);
        }
    }

    /// Processes the packets that have arrived.
    fn listen(&mut self, buffer: &mut [u8], question: &[u8], own: &[IpAddr]) {
        let Some(sockets) = &self.sockets else {
            return;
        };
        let found = &mut self.found;
        receive(&sockets.group, buffer, |packet, from| {
            if own.contains(&from) {
                found.heard_itself |= packet == question;
            } else if found.multicasting.len() < MAX_OTHERS {
                found.multicasting.insert(from);
            }
        });
        receive(&sockets.direct, buffer, |packet, from| {
            if !own.contains(&from)
                && packet::parse_answer(packet).is_some()
                && found.answered.len() < MAX_OTHERS
            {
                found.answered.insert(from);
            }
        });
    }
}

impl Sockets {
    fn open(interface: &Interface, port: u16) -> io::Result<Self> {
        let (group, to) = match interface.ip() {
            IpAddr::V4(address) => group_v4(address, port)?,
            IpAddr::V6(_) => group_v6(interface.index.unwrap_or_default(), port)?,
        };
        let direct = Socket::new(Domain::for_address(to), Type::DGRAM, Some(Protocol::UDP))?;
        direct.set_nonblocking(true)?;
        match interface.ip() {
            IpAddr::V4(address) => {
                direct.set_multicast_if_v4(&address)?;
                direct.set_multicast_ttl_v4(255)?;
                direct.set_multicast_loop_v4(true)?;
                direct.bind(&SocketAddr::new(address.into(), 0).into())?;
            }
            IpAddr::V6(_) => {
                direct.set_multicast_if_v6(interface.index.unwrap_or_default())?;
                direct.set_multicast_hops_v6(255)?;
                direct.bind(&SocketAddr::new(Ipv6Addr::UNSPECIFIED.into(), 0).into())?;
            }
        }
        let direct = direct.into();
        Ok(Self { group, direct, to })
    }
}

/// Passes every packet that has arrived to `packet`, with its source address.
fn receive(socket: &UdpSocket, buffer: &mut [u8], mut packet: impl FnMut(&[u8], IpAddr)) {
    // An empty queue also ends the loop with an error; errors of single packets do not matter.
    while let Ok((len, from)) = socket.recv_from(buffer) {
        packet(buffer.get(..len).unwrap_or_default(), from.ip());
    }
}

/// Builds a query for this service type and for any service.
fn question() -> Result<Vec<u8>, simple_dns::SimpleDnsError> {
    // Receivers ignore the ID of a query; it distinguishes this query from others of this host.
    let mut packet = Packet::new_query(fastrand::u16(1..));
    for name in [SERVICE_TYPE, ANY_SERVICE] {
        packet.questions.push(Question::new(
            Name::new(name.trim_end_matches('.'))?,
            QTYPE::TYPE(TYPE::PTR),
            QCLASS::CLASS(CLASS::IN),
            false,
        ));
    }
    packet.build_bytes_vec_compressed()
}
