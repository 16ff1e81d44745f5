//! Services that tests assemble themselves, to read the counters of their transports or to close
//! transports.
#![allow(dead_code, reason = "each test file uses a part of it")]

pub(crate) mod links;

use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use fipa::{AgentId, Kind, Letter, Message, Performative};
use fipa_mts::core::CoreConfig;
use fipa_mts::{AccessGate, Mts, RuntimeConfig, Started, letter_for};
use fipa_sds::{Directory as _, MemoryDirectory, Registration};
use fipa_transport::{Incarnation, Location, Transport};
#[cfg(feature = "secure")]
pub(crate) use fipa_transport_net::secure::Security;
use fipa_transport_net::{
    Counters, Identity, NetLimits, TcpConfig, TcpTransport, UdpConfig, UdpLimits, UdpTransport,
    UnixConfig, UnixTransport,
};
#[cfg(feature = "quic")]
use fipa_transport_net::{QuicConfig, QuicTransport};
use fipa_transport_shm::{ShmConfig, ShmCounters, ShmTransport};
use tempfile::TempDir;
use tokio::runtime::Handle;

/// Without the feature `secure` there are no keys.
#[cfg(not(feature = "secure"))]
pub(crate) type Security = std::convert::Infallible;

/// The incarnation of the agent that sends.
pub(crate) const ROVER: Incarnation = Incarnation::from_u64(0x50e4);
/// The incarnation of the agent that receives.
pub(crate) const ARM: Incarnation = Incarnation::from_u64(0xa53);

/// Makes a letter from the rover to the arm with this number as its content.
pub(crate) fn letter(number: usize) -> Letter {
    let message = Message::builder(Performative::Inform)
        .sender(AgentId::new("rover").unwrap())
        .receiver(AgentId::new("arm").unwrap())
        .content(number.to_string())
        .build()
        .unwrap();
    letter_for(&message, SystemTime::now()).unwrap()
}

/// Returns the number in such a letter.
pub(crate) fn number(letter: &Letter) -> usize {
    let message = Message::decode(letter.payload()).unwrap();
    let text = std::str::from_utf8(message.content().unwrap()).unwrap();
    text.parse().unwrap()
}

/// A message transport service: of a robot process, or a gateway.
pub(crate) struct TestService {
    pub(crate) mts: Mts,
    directory: Arc<MemoryDirectory>,
    shm: Option<Arc<ShmTransport>>,
    unix: Option<Arc<UnixTransport>>,
    tcp: Option<Arc<TcpTransport>>,
    udp: Option<Arc<UdpTransport>>,
    #[cfg(feature = "quic")]
    quic: Option<Arc<QuicTransport>>,
    locations: Vec<Location>,
}

/// The restrictions of a service.
#[derive(Default)]
struct Bounds {
    /// Maximum number of processes that can have its mailbox open.
    clients: Option<usize>,
    gate: Option<Arc<dyn AccessGate>>,
}

impl TestService {
    /// Starts a service of this host with these transports, in this order of preference.
    pub(crate) fn start(host: &Path, name: &str, order: &[Kind], forwards: bool) -> Self {
        Self::with_keys(host, name, order, forwards, None)
    }

    /// Starts a service that accepts trusted peers only, which QUIC requires.
    pub(crate) fn with_keys(
        host: &Path,
        name: &str,
        order: &[Kind],
        forwards: bool,
        security: Option<Security>,
    ) -> Self {
        Self::build(host, name, order, forwards, security, Bounds::default())
    }

    /// Starts a gateway with keys that refuses the letters that this gate does not admit.
    pub(crate) fn with_gate(
        host: &Path,
        name: &str,
        order: &[Kind],
        security: Security,
        gate: Arc<dyn AccessGate>,
    ) -> Self {
        let bounds = Bounds {
            gate: Some(gate),
            ..Bounds::default()
        };
        Self::build(host, name, order, true, Some(security), bounds)
    }

    /// Starts a service that does not forward, and whose mailbox so many processes can have open.
    pub(crate) fn with_clients(host: &Path, name: &str, order: &[Kind], clients: usize) -> Self {
        let bounds = Bounds {
            clients: Some(clients),
            ..Bounds::default()
        };
        Self::build(host, name, order, false, None, bounds)
    }

    fn build(
        host: &Path,
        name: &str,
        order: &[Kind],
        forwards: bool,
        security: Option<Security>,
        bounds: Bounds,
    ) -> Self {
        let mut limits = NetLimits::default();
        if security.is_some() {
            // Tests cut the links to such services, which must be detected soon.
            limits.keep_alive = Duration::from_millis(500);
        }
        // There are no keys without the feature.
        #[cfg(not(feature = "secure"))]
        drop(security);
        let incarnation = Incarnation::random();
        let handle = Handle::current();
        let mark = host.file_name().unwrap().to_str().unwrap();
        let identity = Identity {
            name: name.into(),
            incarnation,
            domain: mark.into(),
            host: mark.into(),
        };
        let listen = vec!["127.0.0.1:0".to_owned()];
        let has = |kind| order.contains(&kind);
        let shm = has(Kind::Shm).then(|| {
            let prefix = format!("fipa_{mark}_{}", std::process::id());
            let mut config = ShmConfig::new(host.join("shm"), prefix, incarnation);
            config.max_clients = bounds.clients.unwrap_or(config.max_clients);
            Arc::new(ShmTransport::new(config, handle.clone()).unwrap())
        });
        let unix = has(Kind::Unix).then(|| {
            let config = UnixConfig {
                users: fipa_transport::DomainUsers::This,
                directory: host.join("unix"),
                identity: identity.clone(),
                limits: limits.clone(),
            };
            Arc::new(UnixTransport::new(config, handle.clone()))
        });
        let tcp = has(Kind::Tcp).then(|| {
            let mut config = TcpConfig::new(listen.clone(), identity.clone());
            config.limits = limits.clone();
            config.processes = true;
            #[cfg(feature = "secure")]
            {
                config.security = security.clone();
            }
            Arc::new(TcpTransport::new(config, handle.clone()))
        });
        let udp = has(Kind::Udp).then(|| {
            let config = UdpConfig {
                listen: listen.clone(),
                identity: identity.clone(),
                limits: UdpLimits::default(),
            };
            Arc::new(UdpTransport::new(config, handle.clone()))
        });
        #[cfg(feature = "quic")]
        let quic = has(Kind::Quic).then(|| {
            let config = QuicConfig {
                listen: listen.clone(),
                identity: identity.clone(),
                limits: limits.clone(),
                refused_dials: fipa_transport_net::RefusedDials::default(),
                security: security.clone().unwrap(),
                refusals: fipa_transport_net::Refusals::default(),
            };
            Arc::new(QuicTransport::new(config, handle.clone()))
        });
        let transports = [
            shm.clone().map(|it| it as Arc<dyn Transport>),
            unix.clone().map(|it| it as Arc<dyn Transport>),
            tcp.clone().map(|it| it as Arc<dyn Transport>),
            udp.clone().map(|it| it as Arc<dyn Transport>),
            #[cfg(feature = "quic")]
            quic.clone().map(|it| it as Arc<dyn Transport>),
        ];
        let directory = Arc::new(MemoryDirectory::new(fipa_sds::MtsId::new(
            name,
            incarnation,
        )));
        let core = CoreConfig {
            forwards,
            ..CoreConfig::new(name, incarnation, order.to_vec())
        };
        let runtime = RuntimeConfig {
            spin: Duration::ZERO,
            unframed_deadline: Duration::from_secs(5),
            contacts: None,
            tap: None,
            gate: bounds.gate,
            counts: None,
        };
        let transports = transports.into_iter().flatten().collect();
        let Started {
            mts,
            locations,
            failed,
        } = Mts::start(core, runtime, directory.clone(), transports, &handle);
        assert!(failed.is_empty(), "{failed:?}");
        Self {
            mts,
            directory,
            shm,
            unix,
            tcp,
            udp,
            #[cfg(feature = "quic")]
            quic,
            locations,
        }
    }

    /// Returns the location of the service for this kind of transport.
    pub(crate) fn at(&self, kind: Kind) -> Location {
        let mut locations = self.locations.iter();
        locations.find(|it| it.kind() == kind).unwrap().clone()
    }

    /// Registers the arm in the directory of this service, at these locations.
    pub(crate) fn register_arm_at(&self, there: Vec<Location>) {
        let arm = Registration::new("arm", ARM, there);
        self.directory.register(arm).unwrap();
    }

    /// Returns all locations of the service.
    pub(crate) fn all_locations(&self) -> Vec<Location> {
        self.locations.clone()
    }

    /// Returns one of its transports.
    pub(crate) fn transport(&self, kind: Kind) -> Arc<dyn Transport> {
        let found = match kind {
            Kind::Shm => self.shm.clone().map(|it| it as Arc<dyn Transport>),
            Kind::Unix => self.unix.clone().map(|it| it as Arc<dyn Transport>),
            Kind::Tcp => self.tcp.clone().map(|it| it as Arc<dyn Transport>),
            #[cfg(feature = "quic")]
            Kind::Quic => self.quic.clone().map(|it| it as Arc<dyn Transport>),
            _ => self.udp.clone().map(|it| it as Arc<dyn Transport>),
        };
        found.unwrap()
    }

    pub(crate) fn shm(&self) -> ShmCounters {
        self.shm.as_ref().unwrap().counters()
    }

    pub(crate) fn tcp(&self) -> Counters {
        self.tcp.as_ref().unwrap().counters()
    }
}

/// Makes keys for services that trust each other and no other service.
#[cfg(feature = "secure")]
pub(crate) fn mutual_keys<const N: usize>(here: &Path, names: [&str; N]) -> [Security; N] {
    let keys = names.map(|name| fipa::admin::keys::Keys::at(here.join(format!("keys-{name}"))));
    for (keys, name) in keys.iter().zip(names) {
        keys.init(name, &[], fipa::admin::keys::VALID).unwrap();
    }
    for (at, one) in keys.iter().enumerate() {
        let others = keys.iter().enumerate().filter(|(other, _)| *other != at);
        for (_, other) in others {
            let pem = std::fs::read(other.own_file()).unwrap();
            one.trust(&pem).unwrap();
        }
    }
    let rules = fipa_transport_net::secure::Rules {
        loopback: true,
        ..Default::default()
    };
    let mut names = names.iter();
    keys.map(|keys| {
        let credentials = keys.credentials_of(names.next().unwrap()).unwrap();
        Security::new(credentials, rules.clone()).unwrap()
    })
}

/// Makes the directory of a host that no other test uses.
pub(crate) fn host() -> TempDir {
    let mut builder = tempfile::Builder::new();
    builder.prefix("services-").tempdir().unwrap()
}
