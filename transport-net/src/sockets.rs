//! Sockets of TCP: their options, as far as all protocols over TCP share them.

use std::io;
use std::net::SocketAddr;

use socket2::{Domain, Protocol, SockRef, Socket, Type};
use tokio::net::{TcpListener, TcpStream};

use crate::stream::budget::PERIODS;
use crate::stream::config::NetLimits;

/// Connections that the system holds until they are accepted: the letters of a legacy peer wait there
/// while this process is stopped.
const BACKLOG: i32 = 1024;

/// Opens a listening socket, and returns the address that it is bound to. Must be called within a
/// runtime.
pub(crate) fn listen(address: SocketAddr) -> io::Result<(TcpListener, SocketAddr)> {
    let socket = open(address)?;
    let bound = socket.local_addr()?;
    Ok((TcpListener::from_std(socket)?, bound))
}

fn open(address: SocketAddr) -> io::Result<std::net::TcpListener> {
    let socket = Socket::new(
        Domain::for_address(address),
        Type::STREAM.nonblocking(),
        Some(Protocol::TCP),
    )?;
    // A restarted process gets its port although connections linger. Two listeners on one port
    // remain impossible.
    socket.set_reuse_address(true)?;
    if address.is_ipv6() {
        socket.set_only_v6(true)?;
    }
    socket.bind(&address.into())?;
    socket.listen(BACKLOG)?;
    Ok(socket.into())
}

/// Sets the options of a connected socket.
pub(crate) fn prepare(stream: &TcpStream, limits: &NetLimits) -> io::Result<()> {
    stream.set_nodelay(true)?;
    // Bounds the time for which the kernel keeps bytes that the peer's host does not acknowledge, also after the end of
    // the connection. The kernel counts the time in which the peer does not read, too, and a peer may wait for memory.
    let unread = limits.stall_timeout.saturating_mul(PERIODS);
    let timeout = limits.keep_alive.saturating_mul(2).saturating_add(unread);
    SockRef::from(stream).set_tcp_user_timeout(Some(timeout))
}

/// Opens a connection to an address. Returns the address, too.
pub(crate) async fn connect(address: SocketAddr) -> io::Result<(TcpStream, SocketAddr)> {
    let stream = TcpStream::connect(address).await?;
    // Without a listener on an ephemeral port, a host can connect to itself.
    if stream.local_addr()? == stream.peer_addr()? {
        return Err(io::ErrorKind::ConnectionRefused.into());
    }
    Ok((stream, address))
}

/// Returns the listening address with the IP address `local`, if the endpoint listens there.
pub(crate) fn listening_at(listening: &[String], local: SocketAddr) -> Option<SocketAddr> {
    listening
        .iter()
        .filter_map(|text| text.parse::<SocketAddr>().ok())
        .find(|address| address.ip() == local.ip())
}
