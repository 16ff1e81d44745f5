//! Assembles a message transport service: the transports of the configuration, the agent directory
//! of the host, and the runtime over both.

use std::collections::BTreeMap;
use std::sync::Arc;
#[cfg(feature = "shm")]
use std::sync::Weak;
use std::time::Duration;

use fipa_acl::ErrorChain;
use fipa_mts::core::{CoreConfig, RouteException};
use fipa_mts::{AccessGate, Contacts, Mts, RuntimeConfig, Started};
use fipa_sds::{Cancellation, Directory, Entry, HostDirectory, Pattern};
use fipa_transport::{Incarnation, Kind, Location, Signature, Transport, log_limit};
#[cfg(feature = "shm")]
use fipa_transport_shm::{ShmCounters, ShmTransport};
use tokio::runtime::Handle;
use tokio::sync::watch;
use tokio::task::JoinHandle;

use crate::Config;
use crate::access::gate::{Of, RulesGate};
use crate::admin::open_files;
use crate::admin::reload::ReloadRequests;
use crate::admin::watch::Watchers;
use crate::config::{self, Reloaded};
use crate::domain::change_log;
use crate::domain::counting::Counting;
use crate::domain::files::DomainDir;
use crate::domain::maintenance::DirMaintenance;
use crate::domain::membership::{self, Membership};
use crate::domain::report::RouteReport;
use crate::error::OpenError;

/// Interval of keep-alive messages on an idle connection. A broken connection, for example after a
/// change of address, is detected after twice this time, which must be less than the default deadline
/// of a letter.
const KEEP_ALIVE: Duration = Duration::from_secs(2);

/// Time that a closing service waits for letters in transit.
pub(crate) const CLOSING_TIMEOUT: Duration = Duration::from_secs(1);

/// A message transport service in one of its two roles.
pub(crate) struct Service {
    pub(crate) mts: Mts,
    pub(crate) host: Arc<HostDirectory>,
    /// The current locations of the service.
    locations: watch::Receiver<Arc<[Location]>>,
    pub(crate) name: Arc<str>,
    /// The service in the directory.
    pub(crate) own: fipa_sds::MtsId,
    pub(crate) dir: DomainDir,
    /// Whether the service is the gateway.
    gateway: bool,
    gate: Arc<RulesGate>,
    /// The place in which this process counts letters.
    pub(crate) counting: Counting,
    watchers: Arc<Watchers>,
    /// The task that serves the watchers.
    watching: JoinHandle<()>,
    maintenance: JoinHandle<()>,
    #[cfg(feature = "shm")]
    shm: Option<Weak<ShmTransport>>,
    /// The task that logs changes of the directory, if these lines are logged.
    changes: Option<JoinHandle<()>>,
    /// The runtime of the background tasks.
    pub(crate) runtime: Handle,
}

/// The differences between a robot process and the gateway.
pub(crate) struct Role<'a> {
    /// The name of the service.
    pub(crate) name: Arc<str>,
    /// Whether the service is the gateway, which forwards letters.
    pub(crate) gateway: bool,
    /// Whether the process is likely to end within a second.
    pub(crate) brief: bool,
    /// The recipient of notifications about agents of other hosts that have sent letters.
    pub(crate) contacts: Option<Arc<dyn Contacts>>,
    /// The proofs of identity that peers must give.
    #[cfg(feature = "secure")]
    pub(crate) security: Option<fipa_transport_net::secure::Security>,
    /// Receives the TCP connections that are refused because of keys.
    #[cfg(feature = "net")]
    pub(crate) refusals: fipa_transport_net::Refusals,
    /// Receives the connections of this side that peers refuse.
    #[cfg(feature = "net")]
    pub(crate) refused_dials: fipa_transport_net::RefusedDials,
    /// Creates the view of the directory in which receivers are looked up.
    pub(crate) view: &'a View<'a>,
}

/// Returns at most as many of these locations as an entry can have, in the same order. Each kind keeps its
/// first ones: a host with many addresses is still reached over each of its transports.
fn best(locations: Vec<Location>) -> Vec<Location> {
    let mut counts: BTreeMap<Kind, usize> = BTreeMap::new();
    let ranks = locations.iter().map(|location| {
        let count = counts.entry(location.kind()).or_default();
        *count += 1;
        *count
    });
    let mut ranked: Vec<(usize, usize)> = ranks.zip(0..).collect();
    ranked.sort_unstable();
    ranked.truncate(Entry::MAX_LOCATIONS);
    let is_ranked = |place: &usize| ranked.iter().any(|(_, it)| it == place);
    let places = 0..locations.len();
    let ranked_places: Vec<bool> = places.map(|place| is_ranked(&place)).collect();
    let all = locations.into_iter().zip(ranked_places);
    all.filter_map(|(location, is_ranked)| is_ranked.then_some(location))
        .collect()
}

/// Creates a view from the directory of this host and the service that looks up receivers.
pub(crate) type View<'a> =
    dyn Fn(Arc<HostDirectory>, &fipa_sds::MtsId) -> Result<Arc<dyn Directory>, OpenError> + 'a;

impl Service {
    /// Starts the service. Waits for other processes, so it must be called on a thread for blocking
    /// calls.
    pub(crate) fn start(
        config: &Config,
        role: Role<'_>,
        cancellation: &Cancellation,
    ) -> Result<Self, OpenError> {
        if config.mts.raise_open_files
            && let Err(error) = open_files::raise()
        {
            log_limit::warn!(%error, "cannot raise the limit of open files");
        }
        config.check()?;
        let handle = Handle::try_current().map_err(|_| OpenError::NoRuntime)?;
        let incarnation = Incarnation::random();
        let own = fipa_sds::MtsId::new(Arc::clone(&role.name), incarnation);
        let membership = Membership {
            gateway: role.gateway,
            brief: role.brief,
        };
        let (dir, host) = membership::join(config, &own, membership, cancellation)?;
        let view = (role.view)(Arc::clone(&host), &own).inspect_err(|_| dir.leave())?;
        let gate = gate(config, &role, &host).inspect_err(|_| dir.leave())?;
        let watchers = Arc::new(Watchers::new(&own, role.gateway));
        let changes = change_log::start(&*view, &handle);
        let mut refused = Vec::new();
        let counting = Counting::start(&host);
        let mut maintenance =
            DirMaintenance::new(dir.clone(), Arc::clone(&host), Some(counting.clone()));
        let mut parts = TransportParts {
            config,
            role: &role,
            maintenance: &mut maintenance,
            incarnation,
            handle: &handle,
        };
        let transports = parts.transports(&mut refused);
        let Started { mts, failed, .. } = Mts::start(
            core_config(config, &role, incarnation),
            RuntimeConfig {
                spin: config.transport.shm.spin,
                unframed_deadline: config.mts.deadline,
                contacts: role.contacts.clone(),
                tap: Some(Arc::clone(&watchers) as Arc<dyn fipa_mts::Tap>),
                gate: Some(Arc::clone(&gate) as Arc<dyn AccessGate>),
                counts: Some(counting.shared()),
            },
            view,
            transports,
            &handle,
        );
        let connected = watchers.connect_all(&host, &mts);
        let running = Arc::clone(&watchers).run(Arc::clone(&host), mts.clone(), connected);
        let watching = handle.spawn(running);
        let service = Self {
            watchers,
            gate,
            counting,
            gateway: role.gateway,
            changes,
            watching,
            locations: mts.locations(),
            #[cfg(feature = "shm")]
            shm: maintenance.shm.clone(),
            maintenance: handle.spawn(maintenance.run()),
            mts,
            host,
            name: role.name,
            own,
            dir,
            runtime: handle,
        };
        for (kind, error) in failed {
            // A gateway needs all its network transports; within the host another one may do.
            if role.gateway && !kind.is_host_local() {
                service.abort();
                return Err(OpenError::Listen {
                    kind,
                    source: error,
                });
            }
            refused.push((kind, ErrorChain(&error).to_string()));
        }
        if service.locations().is_empty() {
            service.abort();
            return Err(OpenError::NoTransport(reasons(config, &refused)));
        }
        // A transport does not know that its directory is the cause.
        let cause = match refused.is_empty() {
            true => None,
            false => service.dir.check_writable().err(),
        };
        let cause = cause.map(|cause| ErrorChain(&cause).to_string());
        for (kind, error) in &refused {
            let error = cause
                .as_ref()
                .filter(|_| kind.is_host_local())
                .unwrap_or(error);
            log_limit::warn!(%kind, error, "a transport cannot be used; continuing without it");
        }
        Ok(service)
    }

    /// Returns the name of the domain.
    #[cfg(feature = "protocols")]
    pub(crate) fn domain_name(&self) -> &str {
        self.dir.name()
    }

    /// Returns the current locations of the service.
    #[cfg(feature = "net")]
    pub(crate) fn all_locations(&self) -> Vec<Location> {
        self.locations.borrow().to_vec()
    }

    /// Returns the current locations of the service as they are shown to people and to other platforms: each address
    /// of a transport once, those for platforms such as JADE with their path.
    #[cfg(feature = "net")]
    pub(crate) fn shown_locations(&self) -> Vec<Location> {
        let framed = self.locations();
        let locations = self.locations.borrow();
        let others = locations.iter().filter(|location| {
            let same = |framed: &Location| {
                framed.kind() == location.kind() && framed.address() == location.address()
            };
            location.signature() != Signature::Frames && !framed.iter().any(same)
        });
        let mut all = framed.clone();
        for location in others.map(with_path) {
            if !all.contains(&location) {
                all.push(location);
            }
        }
        all
    }

    /// Returns the current locations of the service for directories, at most as many as an entry can
    /// have. The locations for legacy peers only are left out: services that confirm deliveries must
    /// not use them.
    pub(crate) fn locations(&self) -> Vec<Location> {
        self.best_locations(|location| location.signature() == Signature::Frames)
    }

    fn best_locations(&self, is_used: impl Fn(&Location) -> bool) -> Vec<Location> {
        let locations = self.locations.borrow();
        let used = locations.iter().filter(|location| is_used(location));
        best(used.cloned().collect())
    }

    /// Returns the locations that other hosts may learn: those for directories, and the UDT ones, by which only legacy
    /// peers reach an agent.
    #[cfg(feature = "net")]
    pub(crate) fn announced_locations(&self) -> Vec<Location> {
        self.best_locations(|location| {
            location.signature() == Signature::Frames || location.kind() == Kind::Udt
        })
    }

    /// Returns a receiver that is notified of changes of the locations.
    #[cfg(feature = "net")]
    pub(crate) fn follow_locations(&self) -> watch::Receiver<Arc<[Location]>> {
        self.locations.clone()
    }

    /// Reports the routes that letters to these agents would take now.
    pub(crate) fn report(&self, to: &[Arc<Entry>]) -> RouteReport {
        RouteReport {
            mts: self.name.to_string(),
            incarnation: self.own.incarnation,
            locations: self.locations(),
            routes: self.mts.routes(to),
            ways: self.mts.ways(),
            peers: self.mts.peers().into_iter().map(Into::into).collect(),
            neighbors: Vec::new(),
            refused: Vec::new(),
            refused_dials: Vec::new(),
            lost: Vec::new(),
            contested: Vec::new(),
            namesakes: Vec::new(),
            configuration: BTreeMap::new(),
            http: None,
        }
    }

    /// Whether this service has a transport of this kind.
    #[cfg(feature = "net")]
    pub(crate) fn uses(&self, kind: Kind) -> bool {
        self.mts.kinds().any(|open| open == kind)
    }

    /// Applies the keys of another configuration that every service follows: the order of transports, the
    /// exceptions from it, the deadline and the access rules. Copies the applied values into `current`.
    /// Keys that concern only gateways are left out of the result of other processes.
    pub(crate) fn reload(&self, current: &mut Config, new: &Config) -> Reloaded {
        let open: Vec<Kind> = self.mts.kinds().collect();
        let all_open = used(new, self.gateway).all(|kind| open.contains(&kind));
        let mut keys = current.differences(new);
        keys.retain(|key| self.gateway || !config::is_of_gateway(key));
        let (applied, later) = keys.into_iter().partition(|key| match key.as_str() {
            "mts.deadline" | "routes" => true,
            "mts.transports" => all_open,
            key => key.starts_with("access."),
        });
        let order: Vec<Kind> = used(new, self.gateway)
            .filter(|kind| open.contains(kind))
            .collect();
        let routes = routes(new, &order, self.gateway);
        // Always parsed, because the check of the configuration has parsed the rules.
        let rules = (current.access != new.access).then(|| new.access.rules());
        self.mts.reorder(order, routes, new.mts.deadline, || {
            if let Some(Ok(rules)) = rules {
                self.gate.set_rules(rules);
            }
        });
        current.mts.deadline = new.mts.deadline;
        current.routes.clone_from(&new.routes);
        current.access.clone_from(&new.access);
        if all_open {
            current.mts.transports.clone_from(&new.mts.transports);
        }
        Reloaded { applied, later }
    }

    /// Returns the access gate.
    pub(crate) fn gate(&self) -> Arc<RulesGate> {
        Arc::clone(&self.gate)
    }

    /// Returns the requests to read the configuration again, which `fipa reload` sends. They go to the latest caller.
    pub(crate) fn reload_requests(&self) -> ReloadRequests {
        self.watchers.reload_requests()
    }

    /// Returns the counters of shared memory; zeros if the process does not use it.
    #[cfg(feature = "shm")]
    pub(crate) fn shm_counters(&self) -> ShmCounters {
        let shm = self.shm.as_ref().and_then(Weak::upgrade);
        shm.map_or_else(ShmCounters::default, |shm| shm.counters())
    }

    /// Waits for letters in transit, at most [`CLOSING_TIMEOUT`], and ends the service.
    pub(crate) async fn close(&self) {
        self.mts.close(CLOSING_TIMEOUT).await;
        log_limit::report_omitted();
        self.abort();
    }

    /// Ends the service at once and removes its files.
    pub(crate) fn abort(&self) {
        self.watching.abort();
        self.maintenance.abort();
        if let Some(changes) = &self.changes {
            changes.abort();
        }
        self.mts.abort();
        if let Err(error) = self.host.close() {
            log_limit::warn!(error = %ErrorChain(&error), "cannot remove this process from the directory of this host");
        }
        self.dir.leave();
    }
}

/// Returns a location of HTTP with the path at which platforms write to a gateway.
#[cfg(feature = "net")]
fn with_path(location: &Location) -> Location {
    let is_http = matches!(location.kind(), Kind::Http | Kind::Https);
    let has_path = location.address().contains('/');
    if !is_http || has_path {
        return location.clone();
    }
    let address = format!("{}/acc", location.address());
    let with = Location::new(location.kind(), &address);
    let with = with.and_then(|with| with.with_signature(location.signature()));
    with.map_or_else(
        |_| location.clone(),
        |with| with.with_incarnation(location.incarnation()),
    )
}

/// Creates the access gate with the rules of the configuration.
fn gate(
    config: &Config,
    role: &Role<'_>,
    host: &Arc<HostDirectory>,
) -> Result<Arc<RulesGate>, OpenError> {
    let of = match role.gateway {
        true => Of::Gateway(Arc::clone(&role.name)),
        false => Of::Process,
    };
    let gate = RulesGate::new(of, Arc::clone(host));
    // Cannot fail, because the check of the configuration has parsed the rules.
    gate.set_rules(config.access.rules().map_err(OpenError::Access)?);
    Ok(Arc::new(gate))
}

/// Joins the reasons why no transport can be used.
fn reasons(config: &Config, refused: &[(Kind, String)]) -> String {
    let refused = refused.iter();
    let mut texts: Vec<String> = refused
        .map(|(kind, error)| format!("{kind}: {error}"))
        .collect();
    if !config.mts.transports.iter().any(|it| it.is_host_local()) {
        let unused = "mts.transports has none for processes of one host: list shm or unix, or set \
                      transport.tcp.processes = true to use tcp";
        texts.push(unused.to_owned());
    }
    texts.join("; ")
}

fn core_config(config: &Config, role: &Role<'_>, incarnation: Incarnation) -> CoreConfig {
    let order: Vec<Kind> = used(config, role.gateway).collect();
    CoreConfig {
        forwards: role.gateway,
        routes: routes(config, &order, role.gateway),
        queue: config.mts.queue,
        queue_bytes: usize::try_from(config.mts.queue_bytes).unwrap_or(usize::MAX),
        lane_bytes: usize::try_from(config.mts.queue_bytes).unwrap_or(usize::MAX),
        contact_networks: config.contacts.networks.clone(),
        ..CoreConfig::new(Arc::clone(&role.name), incarnation, order)
    }
}

/// Returns `[routes]` of the configuration, restricted to the transports in use. In a robot process, a line that
/// lists only transports between hosts says nothing about the route to the gateway, so it applies to receivers on
/// this host.
fn routes(config: &Config, order: &[Kind], gateway: bool) -> Vec<RouteException> {
    let routes = config.routes.iter().filter_map(|route| {
        // Always compiles, because the check of the configuration has compiled it.
        let receivers = Pattern::new(&route.receiver).ok()?;
        let used = route.transports.iter().copied();
        let is_within_host = route.transports.iter().any(|kind| kind.is_host_local());
        Some(RouteException {
            receivers,
            order: used.filter(|kind| order.contains(kind)).collect(),
            only_on_this_host: !gateway && !is_within_host,
        })
    });
    routes.collect()
}

/// Returns the kinds of transport for this role, in order of preference. One configuration serves the
/// gateway and all other processes of a host. Only the gateway uses the network, unless
/// `transport.tcp.processes` turns on TCP within the host.
fn used(config: &Config, gateway: bool) -> impl Iterator<Item = Kind> {
    let kinds = config.mts.transports.iter().copied();
    kinds.filter(move |kind| {
        let tcp = *kind == Kind::Tcp && config.transport.tcp.processes;
        gateway || kind.is_host_local() || tcp
    })
}

/// The parts from which the transports of a service are made.
struct TransportParts<'a> {
    config: &'a Config,
    role: &'a Role<'a>,
    maintenance: &'a mut DirMaintenance,
    incarnation: Incarnation,
    handle: &'a Handle,
}

impl TransportParts<'_> {
    /// Creates the transports for this role that are built in. Adds the reason of each failure to
    /// `refused`.
    fn transports(&mut self, refused: &mut Vec<(Kind, String)>) -> Vec<Arc<dyn Transport>> {
        let mut transports: Vec<Arc<dyn Transport>> = Vec::new();
        for kind in used(self.config, self.role.gateway) {
            let opened = match kind {
                #[cfg(feature = "shm")]
                Kind::Shm => self.shm(),
                Kind::Unix => self.unix(),
                #[cfg(feature = "net")]
                Kind::Tcp => self.tcp(),
                #[cfg(feature = "net")]
                Kind::Udp => self.udp(),
                #[cfg(feature = "quic")]
                Kind::Quic => match &self.role.security {
                    Some(security) => self.quic(security),
                    // Cannot happen: the check of the configuration demands keys for QUIC.
                    None => continue,
                },
                #[cfg(feature = "http")]
                Kind::Http => self.http(),
                #[cfg(all(feature = "http", feature = "secure"))]
                Kind::Https => self.https(),
                #[cfg(feature = "udt")]
                Kind::Udt => self.udt(),
                // One configuration serves all processes of a robot; their features may differ.
                other => {
                    tracing::debug!(kind = %other, "this program was built without a transport");
                    continue;
                }
            };
            match opened {
                Ok(transport) => transports.push(transport),
                Err(error) => refused.push((kind, error)),
            }
        }
        transports
    }

    #[cfg(feature = "shm")]
    fn shm(&mut self) -> Result<Arc<dyn Transport>, String> {
        use fipa_transport_shm::ShmConfig;
        let settings = &self.config.transport.shm;
        let config = ShmConfig {
            capacity: settings.capacity,
            max_letter: usize::try_from(settings.max_letter).unwrap_or(usize::MAX),
            answers_late: self.role.gateway,
            ..ShmConfig::new(
                self.maintenance.dir.memory(),
                self.maintenance.dir.prefix(),
                self.incarnation,
            )
        };
        let transport = ShmTransport::new(config, self.handle.clone());
        let transport = transport.map_err(|error| ErrorChain(&error).to_string())?;
        let transport = Arc::new(transport);
        self.maintenance.shm = Some(Arc::downgrade(&transport));
        self.tidy(&transport, ShmTransport::tidy);
        Ok(transport)
    }

    fn unix(&mut self) -> Result<Arc<dyn Transport>, String> {
        use fipa_transport_net::{UnixConfig, UnixTransport};
        let config = UnixConfig {
            directory: self.maintenance.dir.part("unix"),
            users: self.maintenance.host.users(),
            identity: self.identity()?,
            limits: stream_limits(self.config),
        };
        let transport = Arc::new(UnixTransport::new(config, self.handle.clone()));
        self.maintenance.unix = Some(Arc::downgrade(&transport));
        self.tidy(&transport, UnixTransport::tidy);
        Ok(transport)
    }

    /// Starts a task that removes a transport's leftovers of processes that have ended. The directory
    /// detects the end of every process, a transport only of those that it has connections with.
    fn tidy<T: Transport>(&self, transport: &Arc<T>, tidy: impl Fn(&T) + Send + 'static) {
        let mut departures = self.maintenance.host.departures();
        let weak = Arc::downgrade(transport);
        self.handle.spawn(async move {
            while departures.next().await {
                match weak.upgrade() {
                    Some(transport) => tidy(&transport),
                    None => return,
                }
            }
        });
    }

    #[cfg(feature = "net")]
    fn tcp(&self) -> Result<Arc<dyn Transport>, String> {
        use fipa_transport_net::{TcpConfig, TcpTransport};
        let mut tcp = TcpConfig::new(
            listen(&self.config.transport.tcp.listen, self.role),
            self.identity()?,
        );
        tcp.limits = stream_limits(self.config);
        tcp.processes = self.config.transport.tcp.processes;
        tcp.refusals = self.role.refusals.clone();
        tcp.refused_dials = self.role.refused_dials.clone();
        #[cfg(feature = "secure")]
        {
            tcp.security = self.role.security.clone();
        }
        Ok(Arc::new(TcpTransport::new(tcp, self.handle.clone())))
    }

    #[cfg(feature = "net")]
    fn udp(&self) -> Result<Arc<dyn Transport>, String> {
        use fipa_transport_net::{UdpConfig, UdpTransport};
        let config = UdpConfig {
            listen: self.config.transport.udp.listen.clone(),
            identity: self.identity()?,
            limits: datagram_limits(self.config),
        };
        Ok(Arc::new(UdpTransport::new(config, self.handle.clone())))
    }

    #[cfg(feature = "quic")]
    fn quic(
        &self,
        security: &fipa_transport_net::secure::Security,
    ) -> Result<Arc<dyn Transport>, String> {
        use fipa_transport_net::{QuicConfig, QuicTransport};
        let config = QuicConfig {
            listen: self.config.transport.quic.listen.clone(),
            identity: self.identity()?,
            limits: stream_limits(self.config),
            refused_dials: self.role.refused_dials.clone(),
            security: security.clone(),
            refusals: self.role.refusals.clone(),
        };
        Ok(Arc::new(QuicTransport::new(config, self.handle.clone())))
    }

    #[cfg(feature = "http")]
    fn http(&self) -> Result<Arc<dyn Transport>, String> {
        use fipa_transport_net::{HttpConfig, HttpTransport};
        let config = HttpConfig {
            listen: self.config.transport.http.listen.clone(),
            identity: self.identity()?,
            limits: stream_limits(self.config),
            #[cfg(feature = "secure")]
            security: self.role.security.clone(),
        };
        Ok(Arc::new(HttpTransport::new(config, self.handle.clone())))
    }

    #[cfg(all(feature = "http", feature = "secure"))]
    fn https(&self) -> Result<Arc<dyn Transport>, String> {
        use fipa_transport_net::{HttpConfig, HttpTransport};
        let Some(security) = &self.role.security else {
            return Err("https needs keys (security.keys)".to_owned());
        };
        let settings = &self.config.transport.https;
        let authorities = crate::admin::keys::authorities(settings.authorities.as_ref());
        let authorities = authorities.map_err(|error| ErrorChain(&error).to_string())?;
        let set = security.set_authorities(authorities);
        set.map_err(|error| ErrorChain(&error).to_string())?;
        let config = HttpConfig {
            listen: settings.listen.clone(),
            identity: self.identity()?,
            limits: stream_limits(self.config),
            security: Some(security.clone()),
        };
        let transport = HttpTransport::over_tls(config, security.clone(), self.handle.clone());
        Ok(Arc::new(transport))
    }

    #[cfg(feature = "udt")]
    fn udt(&self) -> Result<Arc<dyn Transport>, String> {
        use fipa_transport_net::{UdtConfig, UdtTransport};
        let config = UdtConfig {
            listen: self.config.transport.udt.listen.clone(),
            identity: self.identity()?,
            limits: udt_limits(self.config),
            #[cfg(feature = "secure")]
            security: self.role.security.clone(),
        };
        Ok(Arc::new(UdtTransport::new(config, self.handle.clone())))
    }

    fn identity(&self) -> Result<fipa_transport_net::Identity, String> {
        Ok(fipa_transport_net::Identity {
            name: self.role.name.to_string(),
            incarnation: self.incarnation,
            domain: self.config.domain.clone(),
            host: self
                .maintenance
                .dir
                .host_id()
                .map_err(|error| format!("cannot identify this host: {}", ErrorChain(&error)))?,
        })
    }
}

/// Returns the limits of UDT, whose largest letter is that of its peers.
#[cfg(feature = "udt")]
fn udt_limits(config: &Config) -> fipa_transport_net::UdtLimits {
    fipa_transport_net::UdtLimits {
        max_per_address: config.security.peer_connections,
        peer_letters: config.security.peer_letters as u64,
        peer_bytes: config.security.peer_bytes,
        ..fipa_transport_net::UdtLimits::default()
    }
}

/// Returns the limits of the transports that carry letters of any size.
fn stream_limits(config: &Config) -> fipa_transport_net::NetLimits {
    fipa_transport_net::NetLimits {
        max_letter: usize::try_from(config.transport.shm.max_letter).unwrap_or(usize::MAX),
        keep_alive: KEEP_ALIVE,
        max_per_address: config.security.peer_connections,
        peer_letters: config.security.peer_letters as u64,
        peer_bytes: config.security.peer_bytes,
        ..fipa_transport_net::NetLimits::default()
    }
}

/// Returns the limits of UDP, whose letters fit datagrams.
#[cfg(feature = "net")]
fn datagram_limits(config: &Config) -> fipa_transport_net::UdpLimits {
    fipa_transport_net::UdpLimits {
        max_per_address: config.security.peer_connections,
        peer_letters: config.security.peer_letters as u64,
        peer_bytes: config.security.peer_bytes,
        ..fipa_transport_net::UdpLimits::default()
    }
}

/// Returns the addresses to listen on: those of the configuration for the gateway, loopback for other
/// processes.
#[cfg(feature = "net")]
fn listen(addresses: &[String], role: &Role<'_>) -> Vec<String> {
    if role.gateway {
        addresses.to_vec()
    } else {
        vec!["127.0.0.1:0".to_owned()]
    }
}

#[cfg(all(test, feature = "net"))]
mod tests {
    use super::*;
    use crate::config::Sources;

    #[test]
    fn a_host_with_many_addresses_keeps_each_of_its_transports() {
        let tcp = (1..=20).map(|last| format!("tcp://10.0.0.{last}:1"));
        let others = ["udp://10.0.0.1:1", "quic://10.0.0.1:1"].map(str::to_owned);
        let all: Vec<Location> = tcp.chain(others).map(|it| it.parse().unwrap()).collect();
        let best = best(all.clone());
        assert_eq!(best.len(), Entry::MAX_LOCATIONS);
        let first = Entry::MAX_LOCATIONS - 2;
        assert_eq!(best[..first], all[..first]);
        assert_eq!(best[first..], all[20..]);
        assert_eq!(super::best(all[..3].to_vec()), all[..3]);
    }

    #[test]
    fn limits_per_peer_of_the_configuration_apply_to_every_transport() {
        let set = ["connections=3", "letters=5", "bytes=70KiB"];
        let sources = Sources {
            set: set.map(|it| format!("security.peer_{it}")).into(),
            ..Sources::default()
        };
        let config = Config::load(&sources).unwrap();
        let stream = stream_limits(&config);
        let datagram = datagram_limits(&config);
        #[cfg(feature = "udt")]
        {
            let udt = udt_limits(&config);
            let limits = (udt.max_per_address, udt.peer_letters, udt.peer_bytes);
            assert_eq!(limits, (3, 5, 70 << 10));
        }
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
