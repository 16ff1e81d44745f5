//! Services that tests put together themselves, to look at their transports or take these away.
#![allow(dead_code, reason = "each test file uses a part of it")]

pub(crate) mod weather;

use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use fipa::{AgentId, Kind, Letter, Message, Performative};
use fipa_mts::core::CoreConfig;
use fipa_mts::{Gate, Mts, RuntimeConfig, Started, letter_for};
use fipa_sds::{Directory as _, MemoryDirectory, Registration};
use fipa_transport::{Incarnation, Location, Transport};
#[cfg(feature = "secure")]
pub(crate) use fipa_transport_net::secure::Security;
use fipa_transport_net::{
    Counters, Identity, Limits, TcpConfig, TcpTransport, UdpConfig, UdpLimits, UdpTransport,
    UnixConfig, UnixTransport,
};
#[cfg(feature = "quic")]
use fipa_transport_net::{QuicConfig, QuicTransport};
use fipa_transport_shm::{ShmConfig, ShmCounters, ShmTransport};
use tempfile::TempDir;
use tokio::runtime::Handle;

/// Nobody has keys.
#[cfg(not(feature = "secure"))]
pub(crate) type Security = std::convert::Infallible;

/// The life of the agent that sends, and of the one that receives.
pub(crate) const ROVER: Incarnation = Incarnation::from_u64(0x50e4);
pub(crate) const ARM: Incarnation = Incarnation::from_u64(0xa53);

/// A letter from the rover to the arm with this number.
pub(crate) fn letter(number: usize) -> Letter {
    let message = Message::builder(Performative::Inform)
        .sender(AgentId::new("rover").unwrap())
        .receiver(AgentId::new("arm").unwrap())
        .content(number.to_string())
        .build()
        .unwrap();
    letter_for(&message, SystemTime::now()).unwrap()
}

/// The number of such a letter.
pub(crate) fn number(letter: &Letter) -> usize {
    let message = Message::decode(letter.payload()).unwrap();
    let text = std::str::from_utf8(message.content().unwrap()).unwrap();
    text.parse().unwrap()
}

/// A service: a robot process, or a gateway.
pub(crate) struct Place {
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

/// What a service takes.
#[derive(Default)]
struct Bounds {
    /// Processes that can have its mailbox open.
    clients: Option<usize>,
    gate: Option<Arc<dyn Gate>>,
}

impl Place {
    /// A service of this host with these transports, in this order of preference.
    pub(crate) fn start(host: &Path, name: &str, order: &[Kind], forwards: bool) -> Self {
        Self::with_keys(host, name, order, forwards, None)
    }

    /// The same, speaking with trusted peers only; QUIC needs that.
    pub(crate) fn with_keys(
        host: &Path,
        name: &str,
        order: &[Kind],
        forwards: bool,
        security: Option<Security>,
    ) -> Self {
        Self::build(host, name, order, forwards, security, Bounds::default())
    }

    /// A gateway with keys that refuses what this gate does not admit.
    pub(crate) fn with_gate(
        host: &Path,
        name: &str,
        order: &[Kind],
        security: Security,
        gate: Arc<dyn Gate>,
    ) -> Self {
        let bounds = Bounds {
            gate: Some(gate),
            ..Bounds::default()
        };
        Self::build(host, name, order, true, Some(security), bounds)
    }

    /// A service without leave to forward, whose mailbox so many processes can have open.
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
        let mut limits = Limits::default();
        if security.is_some() {
            // Links to such services are cut, and that is to be noticed soon.
            limits.keep_alive = Duration::from_millis(500);
        }
        // Nobody can have any.
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
                directory: host.join("unix"),
                identity: identity.clone(),
                limits: limits.clone(),
            };
            Arc::new(UnixTransport::new(config, handle.clone()))
        });
        let tcp = has(Kind::Tcp).then(|| {
            let config = TcpConfig {
                listen: listen.clone(),
                identity: identity.clone(),
                limits: limits.clone(),
                processes: true,
                #[cfg(feature = "secure")]
                security: security.clone(),
            };
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
                security: security.clone().unwrap(),
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
        let directory = Arc::new(MemoryDirectory::new(fipa_sds::Mts::new(name, incarnation)));
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

    /// Where this is by this kind of transport.
    pub(crate) fn at(&self, kind: Kind) -> Location {
        let mut locations = self.locations.iter();
        locations.find(|it| it.kind() == kind).unwrap().clone()
    }

    /// Letters for the arm go from here to one of these places.
    pub(crate) fn knows_arm_at(&self, there: Vec<Location>) {
        let arm = Registration::new("arm", ARM, there);
        self.directory.register(arm).unwrap();
    }

    /// Everywhere that this is.
    pub(crate) fn everywhere(&self) -> Vec<Location> {
        self.locations.clone()
    }

    /// One of its transports.
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

/// Keys of services that trust each other and no other service.
#[cfg(feature = "secure")]
pub(crate) fn friends<const N: usize>(here: &Path, names: [&str; N]) -> [Security; N] {
    let keys = names.map(|name| fipa::keys::Keys::at(here.join(format!("keys-{name}"))));
    for (keys, name) in keys.iter().zip(names) {
        keys.init(name, &[], fipa::keys::VALID).unwrap();
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

/// The directory of a host that no other test has.
pub(crate) fn host() -> TempDir {
    let mut builder = tempfile::Builder::new();
    builder.prefix("services-").tempdir().unwrap()
}
