//! Somebody who goes on saying what another one has said.

use std::net::{Ipv4Addr, SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use socket2::{Domain, Protocol, Socket, Type};

/// More often than anybody expects it.
const PAUSE: Duration = Duration::from_millis(500);
const WATCHDOG: Duration = Duration::from_secs(60);

/// Repeats a packet of multicast DNS over and over, until dropped: whoever has said it seems to be
/// there still, to those who only listen.
pub struct Ghost {
    socket: UdpSocket,
    group: SocketAddr,
    packet: Vec<u8>,
    ended: Arc<AtomicBool>,
    speaking: Option<JoinHandle<()>>,
}

impl Ghost {
    /// Waits for a packet with these bytes in it, at this port of the group, on the interface with
    /// this address. Within a host ([`Host::enter`](crate::Host::enter)) it is that host's.
    ///
    /// # Panics
    /// When none comes.
    #[must_use]
    pub fn of(bytes: &str, interface: Ipv4Addr, port: u16) -> Self {
        let group = Ipv4Addr::new(224, 0, 0, 251);
        let address = SocketAddr::from((group, port));
        let socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP)).unwrap();
        socket.set_reuse_address(true).unwrap();
        socket.set_reuse_port(true).unwrap();
        socket.set_multicast_if_v4(&interface).unwrap();
        socket.set_multicast_ttl_v4(255).unwrap();
        socket.join_multicast_v4(&group, &interface).unwrap();
        socket.set_read_timeout(Some(PAUSE)).unwrap();
        socket.bind(&address.into()).unwrap();
        let socket = UdpSocket::from(socket);
        let started = Instant::now();
        let mut buffer = [0; 9000];
        let packet = loop {
            assert!(started.elapsed() < WATCHDOG, "nobody says {bytes:?}");
            let Ok(len) = socket.recv(&mut buffer) else {
                continue;
            };
            let packet = &buffer[..len];
            if packet.windows(bytes.len()).any(|it| it == bytes.as_bytes()) {
                break packet.to_vec();
            }
        };
        Self {
            socket,
            group: address,
            packet,
            ended: Arc::default(),
            speaking: None,
        }
    }

    /// Begins to say it.
    ///
    /// # Panics
    /// When it cannot.
    pub fn speak(&mut self) {
        let (socket, group) = (self.socket.try_clone().unwrap(), self.group);
        let (packet, ended) = (self.packet.clone(), Arc::clone(&self.ended));
        self.speaking = Some(std::thread::spawn(move || {
            while !ended.load(Ordering::Relaxed) {
                socket.send_to(&packet, group).unwrap();
                std::thread::sleep(PAUSE);
            }
        }));
    }
}

impl Drop for Ghost {
    fn drop(&mut self) {
        self.ended.store(true, Ordering::Relaxed);
        if let Some(speaking) = self.speaking.take() {
            // That it has panicked has been said.
            let _ = speaking.join();
        }
    }
}
