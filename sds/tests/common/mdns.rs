//! Directories on the loopback interface.

use std::net::UdpSocket;

use fipa_sds::{MdnsConfig, MdnsDirectory, MtsId};
use fipa_transport::Incarnation;

/// An unused port, so that tests do not receive each other's packets.
pub fn free_port() -> u16 {
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    socket.local_addr().unwrap().port()
}

pub fn open(port: u16, name: &str) -> MdnsDirectory {
    let config = MdnsConfig {
        interfaces: vec!["lo".to_owned()],
        port,
        ..MdnsConfig::new(MtsId::new(name, Incarnation::random()))
    };
    MdnsDirectory::open(config).unwrap()
}
