//! The conformance suite of transports for Unix domain sockets, and for TCP, UDP and QUIC on
//! loopback, over IPv4 and IPv6.
#![allow(
    clippy::unwrap_used,
    reason = "a test or bench that cannot go on may panic"
)]

mod common;

use std::net::UdpSocket;
use std::sync::Arc;
use std::time::Duration;

use fipa_transport::conformance::{Fixture, KeyedEndpoint};
use fipa_transport::{Faulty, Kind, Location, Transport};
use fipa_transport_net::{TcpTransport, UdpTransport, UnixTransport};
use tokio::net::TcpSocket;

struct Tcp {
    runtime: common::Threads,
    address: &'static str,
    /// Bound and never listening: connections to it are refused, and no other socket gets the port.
    nowhere: TcpSocket,
}

impl Tcp {
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

impl Fixture for Tcp {
    fn endpoint(&self) -> Arc<dyn Transport> {
        let config = common::config(&[self.address]);
        let runtime = self.runtime.handle().clone();
        Arc::new(TcpTransport::new(config, runtime))
    }

    fn nowhere(&self) -> Location {
        let address = self.nowhere.local_addr().unwrap().to_string();
        Location::new(Kind::Tcp, &address).unwrap()
    }

    fn keyed_pair(&self, _: Duration) -> Option<[KeyedEndpoint; 2]> {
        None
    }
}

struct Udp {
    runtime: common::Threads,
    address: &'static str,
    /// Connected to itself: datagrams of other sockets are refused, and no other socket gets the
    /// port.
    nowhere: UdpSocket,
    decorated: bool,
}

impl Udp {
    fn new(address: &'static str) -> Self {
        let nowhere = UdpSocket::bind(address).unwrap();
        nowhere.connect(nowhere.local_addr().unwrap()).unwrap();
        Self {
            runtime: common::runtime(),
            address,
            nowhere,
            decorated: false,
        }
    }

    fn decorated(address: &'static str) -> Self {
        Self {
            decorated: true,
            ..Self::new(address)
        }
    }
}

impl Fixture for Udp {
    fn endpoint(&self) -> Arc<dyn Transport> {
        let config = common::udp_config(&[self.address]);
        let transport = Arc::new(UdpTransport::new(config, self.runtime.handle().clone()));
        if self.decorated {
            return Arc::new(Faulty::new(transport, 1, &[]));
        }
        transport
    }

    fn nowhere(&self) -> Location {
        let address = self.nowhere.local_addr().unwrap().to_string();
        Location::new(Kind::Udp, &address).unwrap()
    }

    fn keyed_pair(&self, _: Duration) -> Option<[KeyedEndpoint; 2]> {
        None
    }
}

struct Unix {
    runtime: common::Threads,
    directory: tempfile::TempDir,
}

impl Unix {
    fn new() -> Self {
        Self {
            runtime: common::runtime(),
            directory: tempfile::tempdir().unwrap(),
        }
    }
}

impl Fixture for Unix {
    fn endpoint(&self) -> Arc<dyn Transport> {
        let config = common::unix_config(&self.directory.path().join("unix"));
        Arc::new(UnixTransport::new(config, self.runtime.handle().clone()))
    }

    fn nowhere(&self) -> Location {
        Location::new(Kind::Unix, "0000000000000001").unwrap()
    }

    fn keyed_pair(&self, _: Duration) -> Option<[KeyedEndpoint; 2]> {
        None
    }
}

/// Creates two endpoints for [`Fixture::keyed_pair`] with hosts of their own.
#[cfg(feature = "secure")]
fn keyed_pair(
    valid_for: Duration,
    endpoint: impl Fn(fipa_transport_net::secure::Security) -> Arc<dyn Transport>,
) -> Option<[KeyedEndpoint; 2]> {
    use std::time::SystemTime;

    let now = SystemTime::now();
    let day = Duration::from_secs(86_400);
    let [one, other] = [valid_for, day]
        .map(|time| common::certificates::Host::valid(common::NAME, &[], now - day, now + time));
    Some([(&one, &other), (&other, &one)].map(|(host, peer)| {
        let security = host.security(&[peer]);
        let (shared, without) = (security.clone(), host.credentials(&[]));
        let without = std::sync::Mutex::new(Some(without));
        KeyedEndpoint {
            transport: endpoint(security),
            withdraw: Box::new(move || {
                let without = without.lock().unwrap().take().unwrap();
                shared.replace(without).unwrap();
            }),
        }
    }))
}

mod unix {
    use super::Unix;
    fipa_transport::conformance_tests!(Unix::new());
}

mod tcp_ipv4 {
    use super::Tcp;
    fipa_transport::conformance_tests!(Tcp::new("127.0.0.1:0"));
}

/// With TLS, between endpoints with one certificate.
#[cfg(feature = "secure")]
mod tls {
    use std::sync::Arc;
    use std::time::Duration;

    use fipa_transport::conformance::{Fixture, KeyedEndpoint};
    use fipa_transport::{Location, Transport};
    use fipa_transport_net::TcpTransport;
    use fipa_transport_net::secure::Security;

    use super::{Tcp, common};

    struct Tls {
        tcp: Tcp,
        host: common::certificates::Host,
    }

    impl Tls {
        fn new(address: &'static str) -> Self {
            Self {
                tcp: Tcp::new(address),
                host: common::certificates::Host::new(common::NAME, &[]),
            }
        }

        fn with(&self, security: Security) -> Arc<dyn Transport> {
            let mut config = common::config(&[self.tcp.address]);
            config.security = Some(security);
            // The gateways of several domains of a host share one certificate.
            config.identity.domain = config.identity.incarnation.to_string();
            Arc::new(TcpTransport::new(config, self.tcp.runtime.handle().clone()))
        }
    }

    impl Fixture for Tls {
        fn endpoint(&self) -> Arc<dyn Transport> {
            self.with(self.host.security(&[&self.host]))
        }

        fn nowhere(&self) -> Location {
            self.tcp.nowhere()
        }

        fn keyed_pair(&self, valid_for: Duration) -> Option<[KeyedEndpoint; 2]> {
            super::keyed_pair(valid_for, |security| self.with(security))
        }
    }

    fipa_transport::conformance_tests!(Tls::new("127.0.0.1:0"));
}

/// Between endpoints with one certificate.
#[cfg(feature = "quic")]
mod quic {
    use std::net::UdpSocket;
    use std::sync::Arc;
    use std::time::Duration;

    use fipa_transport::conformance::{Fixture, KeyedEndpoint};
    use fipa_transport::{Kind, Location, Transport};
    use fipa_transport_net::QuicTransport;
    use fipa_transport_net::secure::Security;

    use super::common;

    pub(super) struct Quic {
        runtime: common::Threads,
        address: &'static str,
        /// Connected to itself: datagrams of other sockets are refused, and no other socket gets
        /// the port.
        nowhere: UdpSocket,
        host: common::certificates::Host,
    }

    impl Quic {
        pub(super) fn new(address: &'static str) -> Self {
            let nowhere = UdpSocket::bind(address).unwrap();
            nowhere.connect(nowhere.local_addr().unwrap()).unwrap();
            Self {
                runtime: common::runtime(),
                address,
                nowhere,
                host: common::certificates::Host::new(common::NAME, &[]),
            }
        }

        fn with(&self, security: Security) -> Arc<dyn Transport> {
            let mut config = common::quic_config(&[self.address], security);
            config.identity.domain = config.identity.incarnation.to_string();
            Arc::new(QuicTransport::new(config, self.runtime.handle().clone()))
        }
    }

    impl Fixture for Quic {
        fn endpoint(&self) -> Arc<dyn Transport> {
            self.with(self.host.security(&[&self.host]))
        }

        fn keyed_pair(&self, valid_for: Duration) -> Option<[KeyedEndpoint; 2]> {
            super::keyed_pair(valid_for, |security| self.with(security))
        }

        fn nowhere(&self) -> Location {
            let address = self.nowhere.local_addr().unwrap().to_string();
            Location::new(Kind::Quic, &address).unwrap()
        }
    }
}

#[cfg(feature = "quic")]
mod quic_ipv4 {
    use super::quic::Quic;
    fipa_transport::conformance_tests!(Quic::new("127.0.0.1:0"));
}

#[cfg(feature = "quic")]
mod quic_ipv6 {
    use super::quic::Quic;
    fipa_transport::conformance_tests!(Quic::new("[::1]:0"));
}

/// Endpoints of `https` are legacy peers of each other.
#[cfg(all(feature = "http", feature = "secure"))]
mod https {
    use std::sync::Arc;
    use std::time::Duration;

    use fipa_transport::conformance::{Fixture, KeyedEndpoint};
    use fipa_transport::{Location, Transport};
    use fipa_transport_net::secure::Security;
    use fipa_transport_net::{HttpConfig, HttpTransport};

    use super::{Tcp, common};

    struct Https(Tcp);

    impl Https {
        fn with(&self, security: Security) -> Arc<dyn Transport> {
            let tcp = common::config(&[self.0.address]);
            let config = HttpConfig {
                listen: tcp.listen,
                identity: tcp.identity,
                limits: tcp.limits,
                security: Some(security.clone()),
            };
            let runtime = self.0.runtime.handle().clone();
            Arc::new(HttpTransport::over_tls(config, security, runtime))
        }
    }

    impl Fixture for Https {
        fn endpoint(&self) -> Arc<dyn Transport> {
            let host = common::certificates::Host::new(common::NAME, &[]);
            self.with(host.security(&[]))
        }

        fn nowhere(&self) -> Location {
            self.0.nowhere()
        }

        fn keyed_pair(&self, valid_for: Duration) -> Option<[KeyedEndpoint; 2]> {
            super::keyed_pair(valid_for, |security| self.with(security))
        }
    }

    fipa_transport::trust_conformance_tests!(Https(Tcp::new("127.0.0.1:0")));
}

mod tcp_ipv6 {
    use super::Tcp;
    fipa_transport::conformance_tests!(Tcp::new("[::1]:0"));
}

mod udp_ipv4 {
    use super::Udp;
    fipa_transport::conformance_tests!(Udp::new("127.0.0.1:0"));
}

mod udp_ipv6 {
    use super::Udp;
    fipa_transport::conformance_tests!(Udp::new("[::1]:0"));
}

mod udp_decorated {
    use super::Udp;
    fipa_transport::conformance_tests!(Udp::decorated("127.0.0.1:0"));
}
