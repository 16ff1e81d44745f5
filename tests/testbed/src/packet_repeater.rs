//! Repeats a captured multicast DNS packet.

use std::net::{Ipv4Addr, SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use socket2::{Domain, Protocol, Socket, Type};

/// Interval of the repetitions, shorter than the interval of beacons.
const INTERVAL: Duration = Duration::from_millis(500);
const WATCHDOG: Duration = Duration::from_secs(60);

/// Repeats a multicast DNS packet until it is dropped. To hosts that only listen, the sender of the
/// packet seems to be running.
#[derive(Debug)]
pub struct PacketRepeater {
    socket: UdpSocket,
    group: SocketAddr,
    packet: Vec<u8>,
    ended: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl PacketRepeater {
    /// Captures a packet that contains these bytes, at this port of the group 224.0.0.251, on the
    /// interface with this address. Call it within [`Host::enter`](crate::Host::enter) for the interface
    /// of a host.
    ///
    /// # Panics
    /// If no such packet is received within 60 s.
    #[must_use]
    pub fn capture(bytes: &str, interface: Ipv4Addr, port: u16) -> Self {
        let group = Ipv4Addr::new(224, 0, 0, 251);
        let address = SocketAddr::from((group, port));
        let socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP)).unwrap();
        socket.set_reuse_address(true).unwrap();
        socket.set_reuse_port(true).unwrap();
        socket.set_multicast_if_v4(&interface).unwrap();
        socket.set_multicast_ttl_v4(255).unwrap();
        socket.join_multicast_v4(&group, &interface).unwrap();
        socket.set_read_timeout(Some(INTERVAL)).unwrap();
        socket.bind(&address.into()).unwrap();
        let socket = UdpSocket::from(socket);
        let started = Instant::now();
        let mut buffer = [0; 9000];
        let packet = loop {
            assert!(started.elapsed() < WATCHDOG, "no packet with {bytes:?}");
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
            thread: None,
        }
    }

    /// Starts the repetition.
    ///
    /// # Panics
    /// If the socket or the thread cannot be created.
    pub fn start(&mut self) {
        let (socket, group) = (self.socket.try_clone().unwrap(), self.group);
        let (packet, ended) = (self.packet.clone(), Arc::clone(&self.ended));
        self.thread = Some(std::thread::spawn(move || {
            while !ended.load(Ordering::Relaxed) {
                socket.send_to(&packet, group).unwrap();
                std::thread::sleep(INTERVAL);
            }
        }));
    }
}

impl Drop for PacketRepeater {
    fn drop(&mut self) {
        self.ended.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // A panic of the thread was printed already.
            let _ = thread.join();
        }
    }
}
