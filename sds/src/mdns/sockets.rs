//! Sockets of multicast DNS.
//!
//! The sockets are bound to the group's address, so that they do not take unicast answers away from
//! other sockets on this port. Queries request multicast answers, because Avahi truncates a unicast
//! answer at 512 bytes.

use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, SocketAddrV4, SocketAddrV6};
use std::task::Poll;

use if_addrs::Interface;
use socket2::{Domain, Protocol, SockRef, Socket, Type};
use tokio::io::ReadBuf;
use tokio::net::UdpSocket;

use super::MdnsConfig;
use super::packet::MAX_PACKET;

/// Maximum number of interfaces in use.
const MAX_INTERFACES: usize = 32;

/// Sockets of the multicast group, one for each interface and family of addresses.
#[derive(Debug)]
pub(super) struct Sockets {
    open: Vec<GroupSocket>,
    /// The interfaces of these sockets.
    interfaces: Vec<Interface>,
    buffer: Vec<u8>,
}

/// A socket of the group, the group's address, and the number of the interface.
#[derive(Debug)]
struct GroupSocket {
    socket: UdpSocket,
    group: SocketAddr,
    interface: u32,
}

/// Differences between the current and previous addresses of interfaces.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Changed {
    /// At least one address is new.
    pub(super) more: bool,
    /// At least one address is gone.
    pub(super) fewer: bool,
}

impl Sockets {
    /// Creates an empty set.
    pub(super) fn new() -> Self {
        Self {
            open: Vec::new(),
            interfaces: Vec::new(),
            buffer: vec![0; MAX_PACKET],
        }
    }

    /// Opens sockets on the interfaces in the configuration, if they changed since the last call.
    /// Returns the differences.
    pub(super) fn refresh(&mut self, config: &MdnsConfig) -> io::Result<Changed> {
        let interfaces = interfaces(config)?;
        if interfaces == self.interfaces {
            return Ok(Changed::default());
        }
        self.open.clear();
        let mut last_error = None;
        for (interface, opened) in groups(&interfaces, config.port) {
            let opened = opened.and_then(|(socket, group)| {
                Ok(GroupSocket {
                    socket: UdpSocket::from_std(socket)?,
                    group,
                    interface,
                })
            });
            match opened {
                Ok(socket) => self.open.push(socket),
                Err(error) => last_error = Some(error),
            }
        }
        match last_error {
            // An address that is not usable yet may become usable soon; the next call retries.
            Some(error) if self.open.is_empty() => Err(error),
            _ => {
                let (mut now, mut before) = (interfaces.iter(), self.interfaces.iter());
                let changed = Changed {
                    more: now.any(|interface| !self.interfaces.contains(interface)),
                    fewer: before.any(|interface| !interfaces.contains(interface)),
                };
                self.interfaces = interfaces;
                Ok(changed)
            }
        }
    }

    /// Whether the interface with this number is in use.
    pub(super) fn uses(&self, interface: u32) -> bool {
        self.open.iter().any(|open| open.interface == interface)
    }

    /// Sends the packet on all interfaces; a failure on one does not affect the others.
    pub(super) fn send(&self, packet: &[u8]) {
        for GroupSocket { socket, group, .. } in &self.open {
            if let Err(error) = SockRef::from(socket).send_to(packet, &(*group).into()) {
                tracing::debug!(%error, %group, "cannot send an mDNS packet");
            }
        }
    }

    /// Sends the packet on all interfaces, but not to this host: while the mDNS library probes for a
    /// record, it would take a changed record for that of another host, and rename its own.
    pub(super) fn send_to_other_hosts(&self, packet: &[u8]) {
        self.set_loopback(false);
        self.send(packet);
        self.set_loopback(true);
    }

    /// Sets whether this host receives what it sends.
    fn set_loopback(&self, on: bool) {
        for GroupSocket { socket, group, .. } in &self.open {
            let of_socket = SockRef::from(socket);
            let set = match group {
                SocketAddr::V4(_) => of_socket.set_multicast_loop_v4(on),
                SocketAddr::V6(_) => of_socket.set_multicast_loop_v6(on),
            };
            if let Err(error) = set {
                tracing::debug!(%error, %group, "cannot set the loopback of multicast packets");
            }
        }
    }

    /// Waits for the next packet, and returns it with its source address and port and the number of the
    /// interface on which it was received. This method is cancel-safe.
    pub(super) async fn receive(&mut self) -> (&[u8], SocketAddr, u32) {
        let Self { open, buffer, .. } = self;
        let (len, from, interface) = std::future::poll_fn(|context| {
            for GroupSocket {
                socket, interface, ..
            } in open.iter()
            {
                let mut packet = ReadBuf::new(buffer);
                // A socket error is reported once, in place of a packet.
                while let Poll::Ready(received) = socket.poll_recv_from(context, &mut packet) {
                    if let Ok(from) = received {
                        return Poll::Ready((packet.filled().len(), from, *interface));
                    }
                }
            }
            Poll::Pending
        })
        .await;
        (self.buffer.get(..len).unwrap_or_default(), from, interface)
    }
}

/// Sends one packet on all interfaces with temporary sockets; a failure on one does not affect the
/// others.
pub(super) fn send_once(config: &MdnsConfig, packet: &[u8]) -> io::Result<()> {
    let mut last_error = None;
    for (_, opened) in groups(&interfaces(config)?, config.port) {
        let sent = opened.and_then(|(socket, group)| socket.send_to(packet, group));
        last_error = sent.err().or(last_error);
    }
    last_error.map_or(Ok(()), Err)
}

/// Lists the addresses of interfaces that are up and match the configuration.
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

/// A non-blocking socket in the group of an interface, and the group's address.
pub(super) type Grouped = (std::net::UdpSocket, SocketAddr);

/// Opens one socket for each IPv4 address, and one for each interface with IPv6. Each has the number of its
/// interface.
fn groups(interfaces: &[Interface], port: u16) -> impl Iterator<Item = (u32, io::Result<Grouped>)> {
    let mut indices = Vec::new();
    let open = move |interface: &Interface| {
        let index = interface.index.unwrap_or_default();
        match interface.ip() {
            IpAddr::V4(address) => Some((index, group_v4(address, port))),
            IpAddr::V6(_) => {
                if indices.contains(&index) {
                    return None;
                }
                indices.push(index);
                Some((index, group_v6(index, port)))
            }
        }
    };
    interfaces.iter().filter_map(open)
}

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
