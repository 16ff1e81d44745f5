//! The rules of every transport, kept by TCP on loopback, over IPv4 and IPv6.
#![allow(
    clippy::unwrap_used,
    reason = "a test or bench that cannot go on may panic"
)]

mod common;

use std::sync::Arc;

use fipa_transport::conformance::Fixture;
use fipa_transport::{Kind, Location, Transport};
use fipa_transport_net::TcpTransport;
use tokio::net::TcpSocket;
use tokio::runtime::Runtime;

struct Loopback {
    runtime: Runtime,
    address: &'static str,
    /// Bound and never listening: connecting to it is refused, and nobody else gets the port.
    nowhere: TcpSocket,
}

impl Loopback {
    fn new(address: &'static str) -> Self {
        let runtime = common::runtime();
        let socket = if address.starts_with('[') {
            TcpSocket::new_v6()
        } else {
            TcpSocket::new_v4()
        };
        let nowhere = socket.unwrap();
        nowhere.bind(address.parse().unwrap()).unwrap();
        Self {
            runtime,
            address,
            nowhere,
        }
    }
}

impl Fixture for Loopback {
    fn endpoint(&self) -> Arc<dyn Transport> {
        let config = common::config(&[self.address]);
        let runtime = self.runtime.handle().clone();
        Arc::new(TcpTransport::new(config, runtime))
    }

    fn nowhere(&self) -> Location {
        let address = self.nowhere.local_addr().unwrap().to_string();
        Location::new(Kind::Tcp, &address).unwrap()
    }
}

mod ipv4 {
    use super::Loopback;
    fipa_transport::conformance_tests!(Loopback::new("127.0.0.1:0"));
}

mod ipv6 {
    use super::Loopback;
    fipa_transport::conformance_tests!(Loopback::new("[::1]:0"));
}
