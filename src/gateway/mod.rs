//! The gateway of a domain on one host.
//!
//! The gateway runs the same message transport service as every robot process. In addition, it
//! forwards letters and listens on the network. It connects two directories: it announces the
//! agents of this host to other hosts, and publishes the agents of other hosts to the processes of
//! this host.

mod directory_sync;
mod early_letters;
mod exchange;
mod exchange_queues;
mod gateway_agent;
#[cfg(feature = "secure")]
mod guard;
mod introductions;
#[cfg(feature = "web")]
mod metrics;
mod names;
mod namesakes;
mod neighbors;
mod open_listener;
mod platform_agents;
mod publish_pace;
mod self_check;
mod state;

use std::collections::BTreeMap;
use std::fmt;
#[cfg(feature = "web")]
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr};
#[cfg(feature = "web")]
use std::path::PathBuf;
use std::sync::{Arc, OnceLock};
use std::time::Instant;

use fipa_acl::{ErrorChain, escape};
use fipa_mts::Contacts;
use fipa_mts::core::Peer;
use fipa_sds::{
    Cancellation, ContactDirectory, ContactError, Directory, Entry, MergedDirectory, RegisterError,
    Registration, Role as EntryRole, StaticDirectory, reserved_for,
};
use fipa_transport::{
    Incarnation, Introduction, Location, Signature, TransportErrorKind, log_limit,
};
use fipa_transport_net::{Refusals, RefusedDials};
use parking_lot::Mutex;
use tokio::runtime::Handle;
use tokio::sync::watch;
use tokio::task::JoinHandle;

use self::directory_sync::{DirectorySync, DirectorySyncTask};
use self::exchange::{Exchanging, Means};
use self::gateway_agent::GatewayAgent;
#[cfg(feature = "fuzzing")]
pub(crate) use self::gateway_agent::questions::play as play_presence;
#[cfg(feature = "secure")]
use self::guard::Guard;
use self::introductions::Takers;
use self::namesakes::Namesakes;
pub use self::neighbors::Neighbor;
use self::neighbors::{Neighbors, View};
use self::open_listener::OpenListener;
use self::platform_agents::PlatformAgents;
use self::self_check::Arrivals;
pub use self::self_check::{SelfCheck, SelfCheckError};
#[cfg(feature = "fuzzing")]
pub(crate) use self::state::play as play_state;
use self::state::{Predecessor, StateFile, Trust};
use crate::admin::reload::ReloadRequests;
#[cfg(feature = "web")]
use crate::config::is_on_loopback;
use crate::config::{ConfigError, Reloaded};
use crate::domain::background;
use crate::domain::directory_view::DirectoryView;
#[cfg(feature = "web")]
use crate::domain::files::DomainDir;
use crate::domain::process::Owner;
use crate::domain::report::HttpListener;
use crate::domain::service::{Role, Service};
use crate::error::OpenError;
#[cfg(feature = "web")]
use crate::error::WebError;
#[cfg(feature = "web")]
use crate::web::{Encryption, Pages};
use crate::{AgentId, Config};

/// A running gateway. Ends when [`close`](Self::close) is called or the value is dropped.
pub struct Gateway {
    config: Config,
    /// The values of `config`, for the reports of the gateway.
    configuration: Arc<Mutex<BTreeMap<String, String>>>,
    service: Arc<Service>,
    owner: Owner,
    network: Option<Arc<dyn Network>>,
    view: Arc<dyn Directory>,
    neighbors: Arc<Neighbors>,
    exchange: Arc<Exchanging>,
    state: Arc<StateFile>,
    /// The letters of the gateway to itself that have arrived.
    arrivals: Arrivals,
    /// The HTTP listener, as soon as it is open.
    http: Arc<OnceLock<OpenListener>>,
    /// Encrypts at a listener that other hosts reach.
    #[cfg(feature = "web")]
    encryption: Option<Encryption>,
    tasks: Vec<JoinHandle<()>>,
}

impl Gateway {
    /// Starts the gateway of the domain that the configuration names. Must be called within a
    /// tokio runtime, which runs the background tasks of the gateway.
    ///
    /// Waits for other processes of the domain on a thread for blocking calls, up to a minute.
    /// Dropping the future ends the wait; the gateway is then not registered, or ends again if it
    /// already was.
    ///
    /// # Errors
    /// Fails when the configuration, the domain's directory or a configured address cannot be used,
    /// or when the domain already has a gateway.
    pub async fn open(config: &Config) -> Result<Self, OpenError> {
        #[cfg(feature = "web")]
        return Self::open_with_pages(config, Pages::default()).await;
        #[cfg(not(feature = "web"))]
        match config.http.listen.is_empty() {
            true => Self::open_for_letters(config).await,
            false => Err(OpenError::NoFeature {
                key: "http.listen",
                feature: "web",
            }),
        }
    }

    /// Starts the gateway as [`open`](Self::open) does, and shows these pages at `http.listen`, if that is set.
    ///
    /// # Errors
    /// As [`open`](Self::open).
    #[cfg(feature = "web")]
    pub async fn open_with_pages(config: &Config, pages: Pages) -> Result<Self, OpenError> {
        let mut gateway = Self::open_for_letters(config).await?;
        gateway.serve_web(config, pages)?;
        Ok(gateway)
    }

    async fn open_for_letters(config: &Config) -> Result<Self, OpenError> {
        let runtime = Handle::try_current().map_err(|_| OpenError::NoRuntime)?;
        let config = config.clone();
        let opened = background::run(&runtime, move |cancellation| {
            let started = Self::start(&config, cancellation);
            started.map_err(|error| error.explained(&config))
        });
        opened.await?
    }

    /// Starts the gateway on a thread for blocking calls.
    fn start(config: &Config, cancellation: &Cancellation) -> Result<Self, OpenError> {
        #[cfg(feature = "secure")]
        let guard = Guard::open(&config.security, &config.mts.name)?;
        #[cfg(not(feature = "secure"))]
        if !config.security.keys.is_empty() {
            let (key, feature) = ("security.keys", "secure");
            return Err(OpenError::NoFeature { key, feature });
        }
        let known_peers = Arc::new(KnownPeers::default());
        let exchange = Arc::new(Exchanging::new(Incarnation::random().as_u64()));
        let directories = Mutex::new(None);
        let (refusals, refused_dials) = (Refusals::default(), RefusedDials::default());
        let service = Service::start(
            config,
            Role {
                name: config.mts.name.as_str().into(),
                gateway: true,
                brief: false,
                contacts: Some(Arc::clone(&known_peers) as Arc<dyn Contacts>),
                #[cfg(feature = "secure")]
                security: guard.as_ref().map(Guard::security),
                refusals: refusals.clone(),
                refused_dials: refused_dials.clone(),
                view: &|host, mts| {
                    known_peers.neighbors.name_own(&config.mts.name);
                    let network = network(config, mts)?;
                    let exchanged = exchange.directory() as Arc<dyn Directory>;
                    let announced = network.clone().map(Network::directory);
                    let legacy = Arc::new(legacy_peers(config)?) as Arc<dyn Directory>;
                    let known = announced.into_iter().chain([exchanged, legacy]).collect();
                    let known = Arc::new(MergedDirectory::new(known));
                    let contacted = Arc::clone(&known_peers.directory) as Arc<dyn Directory>;
                    let remote = Arc::clone(&known) as Arc<dyn Directory>;
                    let view: Arc<dyn Directory> = Arc::new(View {
                        all: MergedDirectory::new(vec![host, remote, contacted]),
                        neighbors: Arc::clone(&known_peers.neighbors),
                    });
                    *directories.lock() = Some((network, known, Arc::clone(&view)));
                    Ok(view)
                },
            },
            cancellation,
        )?;
        let Some((network, known, view)) = directories.into_inner() else {
            return Err(OpenError::NoRuntime);
        };
        #[cfg(feature = "secure")]
        let trust = Trust::new(guard.as_ref().map(Guard::security));
        #[cfg(not(feature = "secure"))]
        let trust = Trust::default();
        let state = Arc::new(StateFile::new(
            &service.dir,
            trust,
            Arc::clone(&view),
            Arc::clone(&known_peers.directory),
            Arc::clone(&known_peers.neighbors),
        ));
        let mut gateway = Self {
            config: config.clone(),
            configuration: Arc::new(Mutex::new(config.values())),
            service: Arc::new(service),
            owner: Owner::this(),
            network,
            view,
            neighbors: Arc::clone(&known_peers.neighbors),
            exchange,
            state,
            arrivals: Arrivals::default(),
            http: Arc::default(),
            #[cfg(all(feature = "web", feature = "secure"))]
            encryption: guard.as_ref().map(|guard| Encryption(guard.security())),
            #[cfg(all(feature = "web", not(feature = "secure")))]
            encryption: None,
            tasks: Vec::new(),
        };
        // The queue is created first, because letters arrive as soon as the name is registered.
        let own = &gateway.service.own;
        let mts = &gateway.service.mts;
        mts.register(Arc::clone(&gateway.service.name), own.incarnation);
        if let Err(error) = gateway.enter(cancellation) {
            gateway.abort();
            return Err(error);
        }
        // Only the gateway of the domain uses the file, and it does so before it answers letters.
        let predecessor = Arc::new(gateway.state.take_over());
        let publisher = Arc::new(DirectorySync {
            host: Arc::clone(&gateway.service.host),
            network: gateway.network.clone().map(Network::directory),
            known: Arc::clone(&known),
            contacts: Arc::clone(&known_peers.directory),
            service: Arc::clone(&gateway.service),
            only_loopback: announces_on_loopback_only(config),
            pace: Default::default(),
            published: Default::default(),
        });
        // From here on, the sender of a letter from another host is published on this host before
        // the letter is delivered.
        *known_peers.publisher.lock() = Some(Arc::clone(&publisher));
        known_peers.network.lock().clone_from(&gateway.network);
        let publish_task = DirectorySyncTask::new(publisher, gateway.network.clone());
        gateway.tasks.push(tokio::spawn(publish_task.run()));
        let follow = follow_locations(Arc::clone(&gateway.service), Arc::clone(&gateway.neighbors));
        gateway.tasks.push(tokio::spawn(follow));
        #[cfg(feature = "secure")]
        let contacted = Arc::clone(&known_peers.directory);
        gateway.accept_letters(
            config,
            known,
            known_peers,
            refusals,
            refused_dials,
            predecessor,
        )?;
        #[cfg(feature = "secure")]
        gateway.tasks.extend(guard.map(|guard| {
            let (service, exchange) = (Arc::clone(&gateway.service), Arc::clone(&gateway.exchange));
            tokio::spawn(guard.run(Box::new(move |security| {
                withdraw(security, &service.mts, &exchange, &contacted);
            })))
        }));
        Ok(gateway)
    }

    /// Starts to answer letters, to exchange directories with neighbors, and to keep in touch with
    /// the static peers.
    fn accept_letters(
        &mut self,
        config: &Config,
        known: Arc<MergedDirectory>,
        known_peers: Arc<KnownPeers>,
        refusals: Refusals,
        refused_dials: RefusedDials,
        predecessor: Arc<Predecessor>,
    ) -> Result<(), OpenError> {
        let means = self.means()?;
        let namesakes = Arc::new(Namesakes {
            own: self.service.own.clone(),
            neighbors: Arc::clone(&self.neighbors),
            known: Arc::clone(&known),
            has_keys: means.has_keys,
        });
        self.tasks.push(tokio::spawn(Arc::clone(&namesakes).run()));
        let gateway_agent = GatewayAgent {
            service: Arc::clone(&self.service),
            id: means.id.clone(),
            neighbors: Arc::clone(&self.neighbors),
            view: Arc::clone(&self.view),
            exchange: Arc::clone(&self.exchange),
            arrivals: self.arrivals.clone(),
            known_peers,
            configuration: Arc::clone(&self.configuration),
            http: Arc::clone(&self.http),
            refusals,
            refused_dials,
            namesakes,
            questions: Mutex::default(),
            question_rates: Mutex::default(),
            networks: config.contacts.networks.clone(),
        };
        self.tasks.push(tokio::spawn(Arc::new(gateway_agent).run()));
        let platform_agents = PlatformAgents {
            service: Arc::clone(&self.service),
            neighbors: Arc::clone(&self.neighbors),
            view: Arc::clone(&self.view),
            known: Arc::clone(&known),
            exchange: Arc::clone(&self.exchange),
            has_keys: !config.security.keys.is_empty(),
            state: Arc::clone(&self.state),
            predecessor,
        };
        self.tasks.extend(platform_agents.start(&config.platform));
        self.tasks.push(tokio::spawn(Arc::clone(&self.state).run()));
        let exchange = Arc::clone(&self.exchange);
        self.tasks
            .push(tokio::spawn(Arc::clone(&exchange).read_letters()));
        self.tasks.push(tokio::spawn(exchange.run(means, known)));
        let peers = static_peers(config);
        self.neighbors.name_peers(peers.clone());
        self.service.mts.keep_in_touch(peers);
        Ok(())
    }

    /// Answers requests at `http.listen`.
    #[cfg(feature = "web")]
    fn serve_web(&mut self, config: &Config, pages: Pages) -> Result<(), WebError> {
        use crate::web::{Listener, Token};
        let http = &config.http;
        if http.listen.is_empty() {
            return Ok(());
        }
        let token_file = match http.token_file.is_empty() {
            true => self.service.dir.part(DomainDir::TOKEN),
            false => PathBuf::from(&http.token_file),
        };
        let token = Token::load(&token_file).map_err(WebError::Token)?;
        let is_open = !is_on_loopback(&http.listen);
        let encryption = self.encryption.clone().filter(|_| is_open);
        if is_open && encryption.is_none() {
            return Err(WebError::NoKey {
                address: http.listen.clone(),
            });
        }
        let scheme = if encryption.is_some() {
            "https"
        } else {
            "http"
        };
        #[cfg(feature = "secure")]
        let security = encryption
            .as_ref()
            .map(|Encryption(security)| security.clone());
        let listener = Listener::open(&http.listen, &http.names, token, encryption)?;
        let address = listener.address();
        // Set only here.
        let _ = self.http.set(OpenListener {
            listener: HttpListener {
                address,
                url: format!("{scheme}://{}", self.reached_at(address)),
                token_file: token_file.to_string_lossy().into_owned(),
                fingerprint: None,
            },
            #[cfg(feature = "secure")]
            security,
        });
        let shown = metrics::Shown {
            service: Arc::clone(&self.service),
            view: Arc::clone(&self.view),
            neighbors: Arc::clone(&self.neighbors),
            check: self.self_check(),
            discovery_problem: self.discovery_problem(),
            shown: Mutex::default(),
        };
        let serving = listener.serve(Arc::new(shown), pages);
        self.tasks.push(tokio::spawn(serving));
        Ok(())
    }

    /// The address at which other hosts reach a listener of this host.
    #[cfg(feature = "web")]
    fn reached_at(&self, address: SocketAddr) -> SocketAddr {
        if !address.ip().is_unspecified() {
            return address;
        }
        let locations = self.service.shown_locations().into_iter();
        let mut addresses = locations.filter_map(|it| it.address().parse::<SocketAddr>().ok());
        let own = addresses
            .find(|it| it.is_ipv4() == address.is_ipv4() && !is_on_loopback(&it.to_string()));
        match (own, address.is_ipv4()) {
            (Some(own), _) => SocketAddr::new(own.ip(), address.port()),
            (None, true) => SocketAddr::new(Ipv4Addr::LOCALHOST.into(), address.port()),
            (None, false) => SocketAddr::new(Ipv6Addr::LOCALHOST.into(), address.port()),
        }
    }

    fn means(&self) -> Result<Means, OpenError> {
        let id = AgentId::new(&*self.service.name)
            .map_err(|error| OpenError::Name(RegisterError::Failed(Arc::new(error))))?;
        Ok(Means {
            service: Arc::clone(&self.service),
            id,
            neighbors: Arc::clone(&self.neighbors),
            network: self.network.clone(),
            has_keys: !self.config.security.keys.is_empty(),
        })
    }

    /// Registers the gateway in the directory of this host, in which the processes find it.
    fn enter(&self, cancellation: &Cancellation) -> Result<(), OpenError> {
        let service = &self.service;
        let own = register(service, cancellation);
        let own = own.map_err(|error| match error {
            RegisterError::AlreadyRegistered { holder } if holder.role == EntryRole::Gateway => {
                OpenError::GatewayRunning(holder.name.to_string())
            }
            other => other.into(),
        })?;
        // Other gateways are searched for after the registration. If two gateways start at the
        // same moment, at most one of them finds no other.
        service.host.refresh();
        let entries = service.host.entries();
        let mut gateways = entries
            .iter()
            .filter(|entry| entry.role == EntryRole::Gateway);
        match gateways.find(|entry| entry.incarnation != own.incarnation) {
            Some(other) => Err(OpenError::GatewayRunning(other.name.to_string())),
            None => Ok(()),
        }
    }

    /// Returns the name of the gateway.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.service.name
    }

    /// Returns the incarnation of the gateway.
    #[must_use]
    pub fn incarnation(&self) -> Incarnation {
        self.service.own.incarnation
    }

    /// Returns the current locations of the gateway.
    #[must_use]
    pub fn locations(&self) -> Vec<Location> {
        self.service.all_locations()
    }

    /// Returns the directory of this host and of other hosts.
    #[must_use]
    pub fn directory(&self) -> DirectoryView<'_> {
        DirectoryView::of(&*self.view)
    }

    /// Returns the gateways of other hosts with which a connection is open now, whether this
    /// gateway or the other one opened it.
    #[must_use]
    pub fn neighbors(&self) -> Vec<Neighbor> {
        self.neighbors.all()
    }

    /// Applies another configuration without losing a letter. The order of transports, the exceptions from it, the
    /// deadline of letters from legacy peers, the access rules and the static peers take effect at once. The other
    /// keys take effect after a restart of the gateway.
    ///
    /// # Errors
    /// Fails when the configuration has mistakes; nothing has changed then.
    pub fn reload(&mut self, config: &Config) -> Result<Reloaded, ConfigError> {
        config.check()?;
        let mut reloaded = self.service.reload(&mut self.config, config);
        let agents = |config: &Config| {
            let peers = config.discovery.peers.iter();
            peers
                .filter(|it| is_legacy(it))
                .cloned()
                .collect::<Vec<_>>()
        };
        if agents(&self.config) == agents(config) {
            let peers = reloaded
                .later
                .extract_if(.., |key| key == "discovery.static");
            reloaded.applied.extend(peers);
            self.config
                .discovery
                .peers
                .clone_from(&config.discovery.peers);
        }
        let peers = static_peers(config);
        self.neighbors.name_peers(peers.clone());
        self.service.mts.keep_in_touch(peers);
        *self.configuration.lock() = self.config.values();
        Ok(reloaded)
    }

    /// Returns the requests of `fipa reload` to this gateway, which its program answers after it has
    /// [reloaded](Self::reload) the configuration. They go to the latest caller of this function.
    #[must_use]
    pub fn reload_requests(&self) -> ReloadRequests {
        self.service.reload_requests()
    }

    /// Returns a check of whether the gateway delivers letters.
    #[must_use]
    pub fn self_check(&self) -> SelfCheck {
        SelfCheck {
            service: Arc::clone(&self.service),
            view: Arc::clone(&self.view),
            arrivals: self.arrivals.clone(),
        }
    }

    /// Returns the listener for metrics and pages, if `http.listen` is set.
    #[must_use]
    pub fn http(&self) -> Option<HttpListener> {
        self.http.get().map(OpenListener::report)
    }

    /// Returns the current problem of the discovery of other hosts, if there is one, and its changes.
    #[must_use]
    pub fn discovery_problem(&self) -> watch::Receiver<Option<String>> {
        let problem = self.network.as_ref().map(|network| network.problem());
        problem.unwrap_or_else(|| watch::channel(None).1)
    }

    /// Ends the gateway. Announces the end to other hosts, and gives letters in transit a moment to
    /// arrive.
    pub async fn close(mut self) {
        if !self.owner.is_this() {
            return;
        }
        for task in self.tasks.drain(..) {
            task.abort();
        }
        if let Ok(means) = self.means() {
            self.exchange.goodbye(&means).await;
        }
        if let Some(network) = self.network.take() {
            // Closing blocks until the goodbye has been sent.
            background::finish(&self.service.runtime, move || network.close()).await;
        }
        // Before the domain is left: the last process removes the file.
        let state = Arc::clone(&self.state);
        background::finish(&self.service.runtime, move || {
            state.write();
            state.close();
        })
        .await;
        self.service.close().await;
    }

    fn abort(&mut self) {
        if !self.owner.is_this() {
            // In a forked child, a goodbye would end the announcements of the parent.
            std::mem::forget(self.network.take());
            return;
        }
        for task in self.tasks.drain(..) {
            task.abort();
        }
        self.state.close();
        if let Some(network) = self.network.take() {
            network.close();
        }
        self.service.abort();
    }
}

impl fmt::Debug for Gateway {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Gateway")
            .field("mts", &self.service.own)
            .finish_non_exhaustive()
    }
}

impl Drop for Gateway {
    fn drop(&mut self) {
        self.abort();
    }
}

/// Applies a change of the trusted certificates to everything that hosts without trust have here. Their
/// connections end by themselves. The letters end first, because the entries tell where they were to go.
#[cfg(feature = "secure")]
fn withdraw(
    security: &fipa_transport_net::secure::Security,
    mts: &fipa_mts::Mts,
    exchange: &Exchanging,
    contacts: &ContactDirectory,
) {
    let withdrawn = mts.handle_trust(|certificate| security.trusts((*certificate).into()));
    exchange.withdraw(&withdrawn);
    contacts.withdraw(&withdrawn.iter().map(|(gateway, _)| *gateway).collect());
}

/// Registers the gateway with its current locations.
fn register(service: &Service, cancellation: &Cancellation) -> Result<Arc<Entry>, RegisterError> {
    let registration = Registration {
        role: EntryRole::Gateway,
        agent_type: "fipa-mts".to_owned(),
        description: "message transport service".to_owned(),
        ..Registration::new(
            Arc::clone(&service.name),
            service.own.incarnation,
            service.locations(),
        )
    };
    service.host.register_unless(registration, cancellation)
}

/// Updates the gateway's own entry and greets its neighbors when its locations change. The
/// greetings are needed because the directory of the network does not reach all neighbors.
/// [`DirectorySyncTask`] updates the announcements of the agents.
async fn follow_locations(service: Arc<Service>, neighbors: Arc<Neighbors>) {
    let mut locations = service.follow_locations();
    while locations.changed().await.is_ok() {
        let now: Vec<String> = service
            .locations()
            .iter()
            .map(ToString::to_string)
            .collect();
        log_limit::info!(
            locations = now.join(" "),
            "the locations of this gateway have changed"
        );
        let registering = Arc::clone(&service);
        let registered = background::run(&service.runtime, move |cancellation| {
            register(&registering, cancellation)
        });
        if let Err(error) = registered.await.unwrap_or_else(|error| Err(error.into())) {
            log_limit::warn!(error = %ErrorChain(&error), "cannot update the gateway in the directory of this host");
        }
        service
            .mts
            .announce_locations(neighbors.to_greet(Instant::now()));
    }
}

/// Whether the gateway announces its agents on loopback interfaces only. An interface that is given
/// by name is a loopback interface if its name is `lo`.
fn announces_on_loopback_only(config: &Config) -> bool {
    let interfaces = &config.discovery.interfaces;
    let is_loopback = |interface: &crate::config::Interface| {
        let text = interface.to_string();
        let address = text.parse::<std::net::IpAddr>();
        address.map_or(text == "lo", |address| address.is_loopback())
    };
    !interfaces.is_empty() && interfaces.iter().all(is_loopback)
}

/// Whether an entry of `discovery.static` names an agent of a legacy peer instead of a gateway.
fn is_legacy(peer: &crate::config::PeerConfig) -> bool {
    let mut locations = peer.locations.iter();
    locations.all(|location| location.signature() != Signature::Frames)
}

/// Returns the agents of legacy peers that the configuration names.
fn legacy_peers(config: &Config) -> Result<StaticDirectory, OpenError> {
    let legacy = config.discovery.peers.iter().filter(|peer| is_legacy(peer));
    let agents = legacy.map(|peer| (peer.name.as_str(), peer.locations.clone()));
    StaticDirectory::new(agents).map_err(OpenError::StaticPeers)
}

/// Returns the gateways that the configuration names.
fn static_peers(config: &Config) -> Vec<Peer> {
    let peers = config
        .discovery
        .peers
        .iter()
        .filter(|peer| !is_legacy(peer));
    peers
        .map(|peer| Peer {
            name: peer.name.as_str().into(),
            locations: peer.locations.clone(),
        })
        .collect()
}

/// A directory that is shared with other hosts and announces the agents of this host to them.
trait Network: Send + Sync {
    fn directory(self: Arc<Self>) -> Arc<dyn Directory>;
    /// Returns the last error, if there is one, and its changes.
    fn problem(&self) -> watch::Receiver<Option<String>>;
    /// Checks whether this gateway of another host still runs.
    fn suspect(&self, gateway: Incarnation);
    /// Removes the entries of this gateway of another host, because another one has replaced it.
    fn ended(&self, gateway: Incarnation);
    /// Uses the changed interfaces of this host at once.
    fn interfaces_changed(&self);
    /// Withdraws the announcements of this host and closes the directory. Blocks meanwhile.
    fn close(&self);
}

#[cfg(feature = "mdns")]
impl Network for fipa_sds::MdnsDirectory {
    fn directory(self: Arc<Self>) -> Arc<dyn Directory> {
        self
    }

    fn problem(&self) -> watch::Receiver<Option<String>> {
        self.last_error()
    }

    fn suspect(&self, gateway: Incarnation) {
        self.verify_gateway(gateway);
    }

    fn ended(&self, gateway: Incarnation) {
        self.gateway_has_ended(gateway);
    }

    fn interfaces_changed(&self) {
        Self::interfaces_changed(self);
    }

    fn close(&self) {
        Self::close(self);
    }
}

#[cfg(feature = "mdns")]
fn network(config: &Config, mts: &fipa_sds::MtsId) -> Result<Option<Arc<dyn Network>>, OpenError> {
    if !config.discovery.mdns {
        return Ok(None);
    }
    let interfaces = config
        .discovery
        .interfaces
        .iter()
        .map(ToString::to_string)
        .collect();
    let config = fipa_sds::MdnsConfig {
        interfaces,
        ..fipa_sds::MdnsConfig::new(mts.clone())
    };
    let directory = fipa_sds::MdnsDirectory::open(config).map_err(OpenError::Mdns)?;
    Ok(Some(Arc::new(directory)))
}

#[cfg(not(feature = "mdns"))]
fn network(_: &Config, _: &fipa_sds::MtsId) -> Result<Option<Arc<dyn Network>>, OpenError> {
    Ok(None)
}

/// The connected gateways of other hosts, and the agents of other hosts that sent a letter before a
/// directory listed them.
#[derive(Default)]
struct KnownPeers {
    neighbors: Arc<Neighbors>,
    directory: Arc<ContactDirectory>,
    publisher: Mutex<Option<Arc<DirectorySync>>>,
    network: Mutex<Option<Arc<dyn Network>>>,
    /// The platforms that have taken letters.
    takers: Takers,
}

impl KnownPeers {
    /// Records an agent of another host.
    fn record(
        &self,
        now: Instant,
        name: &str,
        agent: Incarnation,
        location: Location,
        host: Option<&str>,
    ) -> Result<(), ContactError> {
        self.record_with(name, agent, |directory| match host {
            Some(host) => directory.record_sender_of_host(now, name, location, host),
            None => directory.record_sender(now, name, agent, location),
        })
    }

    /// Records an agent of another platform because an agent of this host wants to write to it.
    fn introduce(
        &self,
        name: &str,
        locations: Vec<Location>,
        is_given: bool,
    ) -> Result<(), ContactError> {
        self.record_with(name, Incarnation::UNKNOWN, |directory| {
            directory.introduce(Instant::now(), name, locations, is_given)
        })
    }

    fn record_with(
        &self,
        name: &str,
        agent: Incarnation,
        record: impl FnOnce(&ContactDirectory) -> Result<Option<Arc<Entry>>, ContactError>,
    ) -> Result<(), ContactError> {
        // An agent of a platform without a gateway, such as JADE, must not pass for one of a gateway.
        if let Some(gateway) = reserved_for(name).filter(|_| !agent.is_known())
            && self.neighbors.has_gateway(gateway)
        {
            return Err(fipa_sds::EntryError::Reserved(gateway.to_owned()).into());
        }
        if let Some(replaced) = record(&self.directory)? {
            let (agent, at) = (escape(&replaced.name), replaced.locations.first());
            let at = at.map(|at| escape(at.address()).into_owned());
            log_limit::info!(
                of: replaced.peer, %agent, at,
                "forgot an agent of another host, because this gateway knows as many as it can from there; \
                 letters to it fail until it sends another one"
            );
        }
        Ok(())
    }
}

impl Contacts for KnownPeers {
    fn contact_seen(&self, name: &str, agent: Incarnation, location: Location, host: Option<&str>) {
        if let Err(error) = self.record(Instant::now(), name, agent, location, host) {
            log_limit::info!(error = %ErrorChain(&error), "cannot record the sender of a letter");
        }
    }

    fn contact_seen_again(&self, name: &str) {
        self.directory.record_further_letter(Instant::now(), name);
    }

    fn took(&self, name: &str, location: &Location) {
        let now = Instant::now();
        self.directory.took(now, name);
        self.takers.took(now, location);
    }

    fn publish(&self) -> bool {
        let publisher = self.publisher.lock().clone();
        publisher.is_some_and(|publisher| publisher.publish_for_letter())
    }

    fn suspect(&self, location: &Location, fault: TransportErrorKind) {
        self.neighbors.suspect(location, fault);
        if let Some(network) = &*self.network.lock() {
            network.suspect(location.incarnation());
        }
    }

    fn introduced(&self, peer: &Introduction) {
        self.neighbors.introduced(peer);
    }

    fn disconnected(&self, peer: &Introduction) {
        self.neighbors.disconnected(Instant::now(), peer);
    }
}
