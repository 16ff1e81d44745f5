//! Sockets in the directory, for connections between processes of a domain.

use std::os::fd::OwnedFd;

use rustix::fs::{FileType, Mode, OFlags};
use rustix::io::Errno;
use rustix::net::sockopt::socket_peercred;
use rustix::net::{
    AddressFamily, SocketAddrUnix, SocketFlags, SocketType, bind, connect, listen, socket_with,
};

use super::HostError;
use super::host_dir::{Guard, HostDir, Id, Name};

/// Maximum number of connections that wait to be accepted.
const BACKLOG: i32 = 1024;

impl Guard<'_> {
    pub(super) fn listen(&self) -> Result<OwnedFd, HostError> {
        let host_dir = self.host_dir;
        let temporary = Name::Temporary(host_dir.id());
        host_dir.remove(temporary)?;
        let socket = new_socket()
            .and_then(|socket| {
                // The full path may exceed the length limit of a socket's path.
                let path = host_dir.pinned_path().join(temporary.to_string());
                bind(&socket, &SocketAddrUnix::new(&path)?)?;
                listen(&socket, BACKLOG)?;
                Ok(socket)
            })
            .map_err(|error| host_dir.io("listen at", temporary)(error.into()))?;
        let shared = host_dir
            .users()
            .share_socket(host_dir.dir(), &temporary.to_string());
        shared.map_err(host_dir.io("listen at", temporary))?;
        // Appears under its name only now that it accepts connections.
        host_dir.rename(temporary, Name::Socket(host_dir.id()))?;
        Ok(socket)
    }
}

impl HostDir {
    pub(super) fn connect(&self, id: Id) -> Result<OwnedFd, HostError> {
        use std::os::fd::AsRawFd as _;
        let name = Name::Socket(id);
        let failed = |error: Errno| self.io("connect to", name)(error.into());
        // Opened first: the connection below is to the file that was examined, even if the name is
        // reassigned.
        let flags = OFlags::PATH | OFlags::NOFOLLOW | OFlags::CLOEXEC;
        let file = rustix::fs::openat(self.dir(), name.to_string(), flags, Mode::empty());
        let file = file.map_err(failed)?;
        let stat = rustix::fs::fstat(&file).map_err(failed)?;
        let users = self.users();
        let refused = |why: &str| HostError::NotPrivate {
            path: self.path().join(name.to_string()),
            why: why.to_owned(),
        };
        if FileType::from_raw_mode(stat.st_mode) != FileType::Socket || !users.own(&stat) {
            return Err(refused("it is not a socket of the users of this domain"));
        }
        let path = format!("/proc/self/fd/{}", file.as_raw_fd());
        let connected = new_socket().and_then(|socket| {
            connect(&socket, &SocketAddrUnix::new(path)?)?;
            Ok(socket)
        });
        let socket = connected.map_err(failed)?;
        let peer = socket_peercred(&socket).map_err(failed)?;
        if !users.admit(peer.uid.as_raw()) {
            return Err(refused("another user listens there"));
        }
        Ok(socket)
    }
}

fn new_socket() -> Result<OwnedFd, Errno> {
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    socket_with(AddressFamily::UNIX, SocketType::SEQPACKET, flags, None)
}
