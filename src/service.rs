//! Puts a message transport service together: the transports that the configuration wants, the
//! directory of the host, and the runtime over both.

use std::sync::Arc;
use std::time::Duration;

use fipa_mts::core::CoreConfig;
use fipa_mts::{Contacts, Gate, Mts, RuntimeConfig, Started};
use fipa_sds::{Directory, Entry, HostDirectory, Pattern};
use fipa_transport::{Incarnation, Kind, Location, Transport};
use tokio::runtime::Handle;
use tokio::sync::watch;
use tokio::task::JoinHandle;

use crate::Config;
use crate::error::OpenError;
use crate::gate::{Door, Of};
use crate::host_directory;
use crate::keeper::Keeper;
use crate::place::Place;
use crate::routes::Report;
use crate::watch::Taps;

/// How often the other end of a quiet connection is asked for a sign of life. One that leads
/// nowhere any more, because an address has changed, is found out after twice this long, which
/// has to be less than the usual deadline of a letter.
const KEEP_ALIVE: Duration = Duration::from_secs(2);

/// How long a service that ends waits for what is under way.
pub(crate) const CLOSING_PATIENCE: Duration = Duration::from_secs(1);

/// A message transport service in one of its two roles.
pub(crate) struct Service {
    pub(crate) mts: Mts,
    pub(crate) host: Arc<HostDirectory>,
    /// Where the service is reached at present.
    locations: watch::Receiver<Arc<[Location]>>,
    /// The service as the directory names it.
    pub(crate) own: fipa_sds::Mts,
    place: Place,
    /// Serves those who watch.
    tapped: JoinHandle<()>,
    keeper: JoinHandle<()>,
}

/// What differs between a robot process and the gateway.
pub(crate) struct Role<'a> {
    /// The name of the service.
    pub(crate) name: Arc<str>,
    /// Leave to forward.
    pub(crate) gateway: bool,
    /// Who is told of agents of other hosts that have written.
    pub(crate) contacts: Option<Arc<dyn Contacts>>,
    /// What peers have to prove to it.
    #[cfg(feature = "secure")]
    pub(crate) security: Option<fipa_transport_net::secure::Security>,
    /// Makes the view of the directory in which receivers are looked up.
    pub(crate) view: &'a View<'a>,
}

/// From the directory of this host, and the service that looks up receivers, to its view.
pub(crate) type View<'a> =
    dyn Fn(Arc<HostDirectory>, &fipa_sds::Mts) -> Result<Arc<dyn Directory>, OpenError> + 'a;

impl Service {
    pub(crate) fn start(config: &Config, role: Role<'_>) -> Result<Self, OpenError> {
        config.check()?;
        let handle = Handle::try_current().map_err(|_| OpenError::NoRuntime)?;
        let incarnation = Incarnation::random();
        let own = fipa_sds::Mts::new(Arc::clone(&role.name), incarnation);
        let (place, host) = host_directory::join(&config.domain, &own, role.gateway)?;
        let view = (role.view)(Arc::clone(&host), &own).inspect_err(|_| place.leave())?;
        let gate = gate(config, &role, &host).inspect_err(|_| place.leave())?;
        let taps = Arc::new(Taps::new(&own, role.gateway));
        let mut refused = Vec::new();
        let mut keeper = Keeper::new(place.clone(), Arc::clone(&host));
        let transports = transports(
            config,
            &role,
            &mut keeper,
            incarnation,
            &handle,
            &mut refused,
        );
        let Started { mts, failed, .. } = Mts::start(
            core_config(config, &role, incarnation),
            RuntimeConfig {
                spin: config.transport.shm.spin,
                unframed_deadline: config.mts.deadline,
                contacts: role.contacts.clone(),
                tap: Some(Arc::clone(&taps) as Arc<dyn fipa_mts::Tap>),
                gate,
            },
            view,
            transports,
            &handle,
        );
        let begun = taps.begin(&host, &mts);
        let tapped = handle.spawn(taps.run(Arc::clone(&host), mts.clone(), begun));
        let service = Self {
            tapped,
            locations: mts.locations(),
            keeper: handle.spawn(keeper.run()),
            mts,
            host,
            own,
            place,
        };
        for (kind, error) in failed {
            // Without a route within the host there may be another one.
            if role.gateway && !kind.is_host_local() {
                service.abort();
                return Err(OpenError::Listen {
                    kind,
                    source: error,
                });
            }
            refused.push((kind, error.to_string()));
        }
        if service.locations().is_empty() {
            service.abort();
            return Err(OpenError::NoTransport(told(config, &refused)));
        }
        for (kind, error) in &refused {
            tracing::warn!(%kind, error, "a transport cannot be used; going on without it");
        }
        Ok(service)
    }

    /// Where the service is reached at present: as many locations as an entry of the directory has.
    pub(crate) fn locations(&self) -> Vec<Location> {
        let locations = self.locations.borrow();
        locations
            .iter()
            .take(Entry::MAX_LOCATIONS)
            .cloned()
            .collect()
    }

    /// Tells of changes of the locations since the service has started.
    #[cfg(feature = "net")]
    pub(crate) fn follow_locations(&self) -> watch::Receiver<Arc<[Location]>> {
        self.locations.clone()
    }

    /// What this service does with letters to these agents now.
    pub(crate) fn report(&self, to: &[Arc<Entry>]) -> Report {
        Report {
            mts: self.own.name.to_string(),
            incarnation: self.own.incarnation,
            locations: self.locations(),
            routes: self.mts.routes(to),
            ways: self.mts.ways(),
            peers: self.mts.peers().into_iter().map(Into::into).collect(),
            neighbours: Vec::new(),
        }
    }

    /// Uses the orders and the deadline of this configuration from now on. Of the gateway.
    #[cfg(feature = "net")]
    pub(crate) fn reorder(&self, config: &Config) {
        let mut order = config.mts.transports.clone();
        let open: Vec<Kind> = self.mts.kinds().collect();
        order.retain(|kind| open.contains(kind));
        let routes = routes(config, &order, true);
        self.mts.reorder(order, routes, config.mts.deadline);
    }

    /// Gives what is under way a moment to end, then ends.
    pub(crate) async fn close(&self) {
        self.mts.close(CLOSING_PATIENCE).await;
        self.abort();
    }

    /// Ends at once and leaves nothing behind.
    pub(crate) fn abort(&self) {
        self.tapped.abort();
        self.keeper.abort();
        self.mts.abort();
        if let Err(error) = self.host.close() {
            tracing::warn!(%error, "could not leave the directory of this host in order");
        }
        self.place.leave();
    }
}

/// Who says which letters are taken, when the configuration has rules for that.
fn gate(
    config: &Config,
    role: &Role<'_>,
    host: &Arc<HostDirectory>,
) -> Result<Option<Arc<dyn Gate>>, OpenError> {
    let of = match role.gateway {
        true => Of::Gateway(Arc::clone(&role.name)),
        false => Of::Process(Arc::clone(host)),
    };
    // What the configuration's check has passed can be understood.
    let access = config
        .access
        .rules()
        .map_err(|error| OpenError::Access(error.to_string()))?;
    Ok(access.map(|access| Arc::new(Door::new(access, of)) as Arc<dyn Gate>))
}

fn told(config: &Config, refused: &[(Kind, String)]) -> String {
    let refused = refused.iter();
    let mut texts: Vec<String> = refused
        .map(|(kind, error)| format!("{kind}: {error}"))
        .collect();
    if !config.mts.transports.iter().any(|it| it.is_host_local()) {
        let unused = "within a host, list shm or unix in mts.transports, or set \
                      transport.tcp.processes for tcp";
        texts.push(unused.to_owned());
    }
    texts.join("; ")
}

fn core_config(config: &Config, role: &Role<'_>, incarnation: Incarnation) -> CoreConfig {
    let order: Vec<Kind> = used(config, role).collect();
    CoreConfig {
        forwards: role.gateway,
        routes: routes(config, &order, role.gateway),
        queue: config.mts.queue,
        queue_bytes: usize::try_from(config.mts.queue_bytes).unwrap_or(usize::MAX),
        lane_bytes: usize::try_from(config.mts.queue_bytes).unwrap_or(usize::MAX),
        ..CoreConfig::new(Arc::clone(&role.name), incarnation, order)
    }
}

/// The exceptions of the configuration, cut to the transports that are used. Those that list
/// transports between hosts only are for the gateway.
fn routes(config: &Config, order: &[Kind], gateway: bool) -> Vec<(Pattern, Vec<Kind>)> {
    let routes = config.routes.iter().filter_map(|route| {
        // Checked when the configuration was: what does not compile cannot be here.
        let pattern = Pattern::new(&route.receiver).ok()?;
        let used = route.transports.iter().copied();
        let used: Vec<Kind> = used.filter(|kind| order.contains(kind)).collect();
        let names_local = route.transports.iter().any(|kind| kind.is_host_local());
        (gateway || names_local || !used.is_empty()).then_some((pattern, used))
    });
    routes.collect()
}

/// The kinds of transport that are wanted in this role, in order of preference. One configuration
/// serves the gateway and all other processes of a host; only the gateway uses the network, unless
/// the owner wants TCP within the host, too.
fn used<'a>(config: &'a Config, role: &Role<'_>) -> impl Iterator<Item = Kind> + use<'a> {
    let gateway = role.gateway;
    let kinds = config.mts.transports.iter().copied();
    kinds.filter(move |kind| {
        let tcp = *kind == Kind::Tcp && config.transport.tcp.processes;
        gateway || kind.is_host_local() || tcp
    })
}

/// The transports that are wanted, built in, and work here.
fn transports(
    config: &Config,
    role: &Role<'_>,
    keeper: &mut Keeper,
    incarnation: Incarnation,
    handle: &Handle,
    refused: &mut Vec<(Kind, String)>,
) -> Vec<Arc<dyn Transport>> {
    let mut transports: Vec<Arc<dyn Transport>> = Vec::new();
    for kind in used(config, role) {
        let made = match kind {
            #[cfg(feature = "shm")]
            Kind::Shm => shm(config, keeper, incarnation, handle),
            Kind::Unix => unix(config, role, keeper, incarnation, handle),
            #[cfg(feature = "net")]
            Kind::Tcp => tcp(config, role, &keeper.place, incarnation, handle),
            #[cfg(feature = "net")]
            Kind::Udp => udp(config, role, &keeper.place, incarnation, handle),
            #[cfg(feature = "quic")]
            Kind::Quic => match &role.security {
                Some(security) => quic(config, role, security, &keeper.place, incarnation, handle),
                // The check of the configuration does not let this happen.
                None => continue,
            },
            // One configuration serves all processes of a robot, whatever they were built with.
            other => {
                tracing::debug!(kind = %other, "this program was built without it");
                continue;
            }
        };
        match made {
            Ok(transport) => transports.push(transport),
            Err(error) => refused.push((kind, error)),
        }
    }
    transports
}

#[cfg(feature = "shm")]
fn shm(
    config: &Config,
    keeper: &mut Keeper,
    incarnation: Incarnation,
    handle: &Handle,
) -> Result<Arc<dyn Transport>, String> {
    use fipa_transport_shm::{ShmConfig, ShmTransport};
    let settings = &config.transport.shm;
    let config = ShmConfig {
        capacity: settings.capacity,
        max_letter: usize::try_from(settings.max_letter).unwrap_or(usize::MAX),
        ..ShmConfig::new(keeper.place.part("shm"), keeper.place.prefix(), incarnation)
    };
    let transport = ShmTransport::new(config, handle.clone()).map_err(|error| error.to_string())?;
    let transport = Arc::new(transport);
    keeper.shm = Some(Arc::downgrade(&transport));
    tidy(handle, keeper, &transport, ShmTransport::tidy);
    Ok(transport)
}

fn unix(
    config: &Config,
    role: &Role<'_>,
    keeper: &mut Keeper,
    incarnation: Incarnation,
    handle: &Handle,
) -> Result<Arc<dyn Transport>, String> {
    use fipa_transport_net::{UnixConfig, UnixTransport};
    let config = UnixConfig {
        directory: keeper.place.part("unix"),
        identity: identity(config, role, &keeper.place, incarnation)?,
        limits: stream_limits(config),
    };
    let transport = Arc::new(UnixTransport::new(config, handle.clone()));
    keeper.unix = Some(Arc::downgrade(&transport));
    tidy(handle, keeper, &transport, UnixTransport::tidy);
    Ok(transport)
}

/// Has a transport remove what processes have left that ended. The directory notices the end of
/// every process, a transport only of those that it talks to.
fn tidy<T: Transport>(
    handle: &Handle,
    keeper: &Keeper,
    transport: &Arc<T>,
    tidy: impl Fn(&T) + Send + 'static,
) {
    let (mut departures, there) = (keeper.host.departures(), Arc::downgrade(transport));
    handle.spawn(async move {
        while departures.next().await {
            match there.upgrade() {
                Some(transport) => tidy(&transport),
                None => return,
            }
        }
    });
}

#[cfg(feature = "net")]
fn tcp(
    config: &Config,
    role: &Role<'_>,
    place: &Place,
    incarnation: Incarnation,
    handle: &Handle,
) -> Result<Arc<dyn Transport>, String> {
    use fipa_transport_net::{TcpConfig, TcpTransport};
    let config = TcpConfig {
        listen: listen(&config.transport.tcp.listen, role),
        identity: identity(config, role, place, incarnation)?,
        limits: stream_limits(config),
        processes: config.transport.tcp.processes,
        #[cfg(feature = "secure")]
        security: role.security.clone(),
    };
    Ok(Arc::new(TcpTransport::new(config, handle.clone())))
}

#[cfg(feature = "net")]
fn udp(
    config: &Config,
    role: &Role<'_>,
    place: &Place,
    incarnation: Incarnation,
    handle: &Handle,
) -> Result<Arc<dyn Transport>, String> {
    use fipa_transport_net::{UdpConfig, UdpTransport};
    let config = UdpConfig {
        listen: config.transport.udp.listen.clone(),
        identity: identity(config, role, place, incarnation)?,
        limits: datagram_limits(config),
    };
    Ok(Arc::new(UdpTransport::new(config, handle.clone())))
}

#[cfg(feature = "quic")]
fn quic(
    config: &Config,
    role: &Role<'_>,
    security: &fipa_transport_net::secure::Security,
    place: &Place,
    incarnation: Incarnation,
    handle: &Handle,
) -> Result<Arc<dyn Transport>, String> {
    use fipa_transport_net::{QuicConfig, QuicTransport};
    let config = QuicConfig {
        listen: config.transport.quic.listen.clone(),
        identity: identity(config, role, place, incarnation)?,
        limits: stream_limits(config),
        security: security.clone(),
    };
    Ok(Arc::new(QuicTransport::new(config, handle.clone())))
}

/// The limits of transports that carry letters of any size.
fn stream_limits(config: &Config) -> fipa_transport_net::Limits {
    fipa_transport_net::Limits {
        max_letter: usize::try_from(config.transport.shm.max_letter).unwrap_or(usize::MAX),
        keep_alive: KEEP_ALIVE,
        max_per_address: config.security.peer_connections,
        peer_letters: config.security.peer_letters as u64,
        peer_bytes: config.security.peer_bytes,
        ..fipa_transport_net::Limits::default()
    }
}

/// The limits of the one whose letters fit datagrams.
#[cfg(feature = "net")]
fn datagram_limits(config: &Config) -> fipa_transport_net::UdpLimits {
    fipa_transport_net::UdpLimits {
        max_per_address: config.security.peer_connections,
        peer_letters: config.security.peer_letters as u64,
        peer_bytes: config.security.peer_bytes,
        ..fipa_transport_net::UdpLimits::default()
    }
}

/// A gateway listens where its owner wants it, other processes for their own host.
#[cfg(feature = "net")]
fn listen(addresses: &[String], role: &Role<'_>) -> Vec<String> {
    if role.gateway {
        addresses.to_vec()
    } else {
        vec!["127.0.0.1:0".to_owned()]
    }
}

fn identity(
    config: &Config,
    role: &Role<'_>,
    place: &Place,
    incarnation: Incarnation,
) -> Result<fipa_transport_net::Identity, String> {
    Ok(fipa_transport_net::Identity {
        name: role.name.to_string(),
        incarnation,
        domain: config.domain.clone(),
        host: place
            .host_id()
            .map_err(|error| format!("cannot tell this host: {error}"))?,
    })
}

#[cfg(all(test, feature = "net"))]
mod tests {
    use super::*;
    use crate::config::Sources;

    #[test]
    fn what_one_peer_may_have_is_what_the_configuration_says_over_every_transport() {
        let set = ["connections=3", "letters=5", "bytes=70KiB"];
        let sources = Sources {
            set: set.map(|it| format!("security.peer_{it}")).into(),
            ..Sources::default()
        };
        let config = Config::load(&sources).unwrap();
        let stream = stream_limits(&config);
        let datagram = datagram_limits(&config);
        for (connections, letters, bytes) in [
            (
                stream.max_per_address,
                stream.peer_letters,
                stream.peer_bytes,
            ),
            (
                datagram.max_per_address,
                datagram.peer_letters,
                datagram.peer_bytes,
            ),
        ] {
            assert_eq!((connections, letters, bytes), (3, 5, 70 << 10));
        }
    }
}
