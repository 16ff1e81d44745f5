//! Sockets: opening them, and the thin layer over the system calls.

use std::io::{self, IoSliceMut};
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr};

use quinn_udp::{RecvMeta, UdpSocketState};
use rustix::net::sockopt::{self, Ipv4PathMtuDiscovery, Ipv6PathMtuDiscovery};
use socket2::{Domain, Protocol, Type};
use tokio::io::Interest;
use tokio::net::UdpSocket;

use super::{Fragments, Path, Transmit};

/// Size of the receive buffer in bytes; the system may allow less.
const BUFFER: usize = 4 << 20;

/// Maximum number of datagrams, or runs of datagrams, received in one call.
const BATCH: usize = 8;

/// Size of the buffer of each.
const LARGEST: usize = 1 << 16;

pub(crate) struct Socket {
    pub(crate) number: u32,
    /// The connection that the socket was opened for. A socket without one accepts datagrams of
    /// unproved peers.
    pub(crate) owner: Option<u32>,
    io: UdpSocket,
    state: UdpSocketState,
}

/// The result of sending a datagram.
pub(crate) enum Sent {
    /// Sent, or dropped in a way that is equivalent to a loss in the network.
    Perhaps,
    TooBig,
    Broken(io::Error),
}

impl Socket {
    /// Opens a listening socket. Must be called within a runtime.
    pub(crate) fn listen(
        number: u32,
        address: SocketAddr,
        fragments: Fragments,
    ) -> io::Result<Self> {
        Self::open(number, None, address, fragments, |socket| {
            socket.bind(&address.into())
        })
    }

    /// Opens a socket for the connection to one peer. Only for a connected socket the operating
    /// system reports that the peer is unreachable. Must be called within a runtime.
    pub(crate) fn connect(
        number: u32,
        owner: u32,
        remote: SocketAddr,
        fragments: Fragments,
    ) -> io::Result<Self> {
        let any: SocketAddr = if remote.is_ipv4() {
            (Ipv4Addr::UNSPECIFIED, 0).into()
        } else {
            (Ipv6Addr::UNSPECIFIED, 0).into()
        };
        Self::open(number, Some(owner), remote, fragments, |socket| {
            socket.bind(&any.into())?;
            socket.connect(&remote.into())
        })
    }

    fn open(
        number: u32,
        owner: Option<u32>,
        address: SocketAddr,
        fragments: Fragments,
        prepare: impl FnOnce(&socket2::Socket) -> io::Result<()>,
    ) -> io::Result<Self> {
        let socket = socket2::Socket::new(
            Domain::for_address(address),
            Type::DGRAM.nonblocking(),
            Some(Protocol::UDP),
        )?;
        if address.is_ipv6() {
            socket.set_only_v6(true)?;
        }
        socket.set_recv_buffer_size(BUFFER)?;
        prepare(&socket)?;
        let socket: std::net::UdpSocket = socket.into();
        let state = UdpSocketState::new((&socket).into())?;
        if fragments == Fragments::Allowed {
            // After `UdpSocketState::new`, which forbids fragments.
            match address {
                SocketAddr::V4(_) => {
                    sockopt::set_ip_mtu_discover(&socket, Ipv4PathMtuDiscovery::WANT)?;
                }
                SocketAddr::V6(_) => {
                    sockopt::set_ipv6_mtu_discover(&socket, Ipv6PathMtuDiscovery::WANT)?;
                }
            }
        }
        Ok(Self {
            number,
            owner,
            io: UdpSocket::from_std(socket)?,
            state,
        })
    }

    pub(crate) fn address(&self) -> io::Result<SocketAddr> {
        self.io.local_addr()
    }

    /// Returns the address of the connected peer.
    pub(crate) fn peer(&self) -> io::Result<SocketAddr> {
        self.io.peer_addr()
    }

    /// Sends datagrams. Several are sent with one system call where the system can divide them.
    pub(crate) fn send(&self, transmit: &Transmit) -> Sent {
        let Transmit {
            path,
            contents,
            segment,
            ..
        } = transmit;
        let Some(segment) = segment.filter(|segment| contents.len() > *segment) else {
            return self.send_one(*path, contents, None);
        };
        if self.state.max_gso_segments() >= contents.len().div_ceil(segment)
            && let Sent::Perhaps = self.send_one(*path, contents, Some(segment))
        {
            return Sent::Perhaps;
        }
        // The system or the interface cannot divide them.
        for datagram in contents.chunks(segment) {
            match self.send_one(*path, datagram, None) {
                Sent::Perhaps => {}
                other => return other,
            }
        }
        Sent::Perhaps
    }

    fn send_one(&self, path: Path, contents: &[u8], segment_size: Option<usize>) -> Sent {
        let transmit = quinn_udp::Transmit {
            destination: path.remote,
            ecn: None,
            contents,
            segment_size,
            src_ip: path.local,
        };
        // Bypasses the runtime, which learns that a new socket is writable only after a while.
        let Err(error) = self.state.try_send((&self.io).into(), &transmit) else {
            return Sent::Perhaps;
        };
        if quinn_udp::is_msg_size_err(&error) {
            return Sent::TooBig;
        }
        match error.kind() {
            // The buffers of the system are full, or a filter dropped the datagram: equivalent to a
            // loss in the network.
            io::ErrorKind::WouldBlock
            | io::ErrorKind::PermissionDenied
            | io::ErrorKind::OutOfMemory
            | io::ErrorKind::Interrupted => Sent::Perhaps,
            _ if error.raw_os_error() == Some(ENOBUFS) => Sent::Perhaps,
            _ => Sent::Broken(error),
        }
    }

    /// Waits for datagrams or errors.
    pub(crate) async fn readable(&self) -> io::Result<Interest> {
        let ready = self.io.ready(Interest::READABLE | Interest::ERROR).await?;
        Ok(if ready.is_error() {
            Interest::ERROR
        } else {
            Interest::READABLE
        })
    }

    /// Receives datagrams after [`readable`](Self::readable), and calls `tell` with each datagram
    /// and its path. Returns their number; 0 when there are none now.
    pub(crate) fn receive(
        &self,
        readiness: Interest,
        buffers: &mut Buffers,
        mut tell: impl FnMut(Path, &[u8]),
    ) -> io::Result<usize> {
        let mut meta = [RecvMeta::default(); BATCH];
        let received = self.io.try_io(readiness, || {
            let mut slices = buffers.slices();
            self.state.recv((&self.io).into(), &mut slices, &mut meta)
        });
        let count = match received {
            Ok(count) => count,
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => return Ok(0),
            Err(error) => return Err(error),
        };
        let mut datagrams = 0;
        for (meta, buffer) in meta.iter().take(count).zip(&buffers.0) {
            let path = Path {
                socket: self.number,
                remote: meta.addr,
                local: meta.dst_ip,
            };
            let run = buffer.get(..meta.len).unwrap_or_default();
            if run.is_empty() {
                tell(path, run);
                datagrams += 1;
            }
            for datagram in run.chunks(meta.stride.max(1)) {
                tell(path, datagram);
                datagrams += 1;
            }
        }
        Ok(datagrams)
    }
}

/// No buffer space available; `std` has no constant for it.
const ENOBUFS: i32 = 105;

/// Receive buffers.
pub(crate) struct Buffers(Vec<Vec<u8>>);

impl Buffers {
    pub(crate) fn new() -> Self {
        Self(vec![vec![0; LARGEST]; BATCH])
    }

    fn slices(&mut self) -> [IoSliceMut<'_>; BATCH] {
        let mut rest = self.0.iter_mut();
        std::array::from_fn(|_| match rest.next() {
            Some(buffer) => IoSliceMut::new(buffer),
            None => IoSliceMut::new(&mut []),
        })
    }
}
