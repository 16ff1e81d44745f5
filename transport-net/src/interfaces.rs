//! Detects changes of the addresses of this host's interfaces.
//!
//! The kernel sends a message on a netlink socket for every change (rtnetlink(7)). The content of
//! these messages is not parsed: a message only triggers listing the interfaces again
//! ([`crate::address`]).

use std::io;
use std::os::fd::OwnedFd;
use std::time::Duration;

use fipa_transport::log_limit;
use rustix::io::Errno;
use rustix::net::netlink::SocketAddrNetlink;
use rustix::net::{AddressFamily, SocketFlags, SocketType, bind, socket_with, sockopt};
use tokio::net::UnixDatagram;
use tokio::time::sleep;

/// The multicast groups `RTNLGRP_LINK`, `RTNLGRP_IPV4_IFADDR` and `RTNLGRP_IPV6_IFADDR`, one bit
/// each (rtnetlink(7)).
const GROUPS: u32 = 0x1 | 0x10 | 0x100;

/// Receive buffer of the socket, in bytes. An overflow is reported by the kernel and counts as a
/// change.
const BUFFER: usize = 64 << 10;

/// Time in which changes are collected: a host that moves removes one address and adds another.
const GATHERING: Duration = Duration::from_millis(50);

/// Polling interval of the interfaces when the kernel offers no netlink socket, for example to a
/// service with restricted address families.
const POLL: Duration = Duration::from_secs(1);

/// A subscription to the changes of this host's interfaces.
#[derive(Debug)]
pub(crate) struct Changes {
    /// `None` when there is no netlink socket and the interfaces are polled.
    ///
    /// The runtime has no type for netlink sockets, and its general one (`AsyncFd`) needs `unsafe`.
    /// Waiting and recv(2) are the same for every datagram socket.
    socket: Option<UnixDatagram>,
}

impl Changes {
    /// Subscribes to later changes. Must be called within a runtime.
    pub(crate) fn subscribe() -> Self {
        let socket = open().and_then(|socket| UnixDatagram::from_std(socket.into()));
        if let Err(error) = &socket {
            log_limit::warn!(
                %error,
                "cannot open a netlink socket; polling the interfaces every {POLL:?} instead \
                 (does RestrictAddressFamilies= lack AF_NETLINK?)"
            );
        }
        Self {
            socket: socket.ok(),
        }
    }

    /// Waits until the interfaces may have changed.
    pub(crate) async fn next(&mut self) {
        let Some(socket) = &self.socket else {
            return sleep(POLL).await;
        };
        let changed = async {
            while !drain(socket)? {
                socket.readable().await?;
            }
            sleep(GATHERING).await;
            drain(socket)
        };
        if let Err(error) = changed.await {
            log_limit::warn!(%error, "the netlink socket failed; polling the interfaces instead");
            self.socket = None;
        }
    }
}

/// Discards the available messages, at most as many as the buffer can hold. Returns whether there
/// were any.
fn drain(socket: &UnixDatagram) -> io::Result<bool> {
    let mut message = [0; 4096];
    let mut any = false;
    for _ in 0..BUFFER {
        match socket.try_recv(&mut message) {
            Ok(_) => any = true,
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => break,
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            // Messages were lost because the buffer was full.
            Err(error) if error.raw_os_error() == Some(Errno::NOBUFS.raw_os_error()) => any = true,
            Err(error) => return Err(error),
        }
    }
    Ok(any)
}

fn open() -> io::Result<OwnedFd> {
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    // Protocol `None` is NETLINK_ROUTE, which is 0.
    let socket = socket_with(AddressFamily::NETLINK, SocketType::RAW, flags, None)?;
    sockopt::set_socket_recv_buffer_size(&socket, BUFFER)?;
    bind(&socket, &SocketAddrNetlink::new(0, GROUPS))?;
    Ok(socket)
}
