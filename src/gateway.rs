//! The gateway of a domain on one host: the same service as in every robot process, with leave to
//! forward, listening on the network, and the go-between of two directories: what lives on this
//! host is announced to the network, what is announced there is told to the processes here.

mod clerk;
mod exchange;
#[cfg(feature = "secure")]
mod guard;
mod neighbours;
mod publisher;

use std::sync::Arc;
use std::time::Instant;

use fipa_mts::Contacts;
use fipa_mts::core::Peer;
use fipa_sds::{
    ContactDirectory, Directory, Entry, MergedDirectory, RegisterError, Registration,
    Role as EntryRole, StaticDirectory,
};
use fipa_transport::{Incarnation, Introduction, Kind, Location, Signature, TransportErrorKind};
use parking_lot::Mutex;
use tokio::task::JoinHandle;

use self::clerk::Clerk;
use self::exchange::{Exchanging, Means};
#[cfg(feature = "secure")]
use self::guard::Guard;
pub use self::neighbours::Neighbour;
use self::neighbours::{Neighbours, View};
use self::publisher::{Keeper, Publisher};
use crate::config::ConfigError;
use crate::error::OpenError;
use crate::owner::Owner;
use crate::service::{Role, Service};
use crate::{AgentId, Config};

/// A running gateway. Ends when [`close`](Self::close) is called or it is dropped.
pub struct Gateway {
    config: Config,
    service: Arc<Service>,
    owner: Owner,
    network: Option<Arc<dyn Network>>,
    view: Arc<dyn Directory>,
    neighbours: Arc<Neighbours>,
    exchange: Arc<Exchanging>,
    tasks: Vec<JoinHandle<()>>,
}

impl Gateway {
    /// Starts the gateway of the domain that the configuration names. Must be called within a
    /// tokio runtime, which then does the work in the background.
    ///
    /// # Errors
    /// When the configuration, the domain's directory or a configured address cannot be used, or
    /// the domain has a gateway already.
    pub async fn open(config: &Config) -> Result<Self, OpenError> {
        #[cfg(feature = "secure")]
        let guard = Guard::open(&config.security, &config.mts.name)?;
        #[cfg(not(feature = "secure"))]
        if !config.security.keys.is_empty() {
            let without = "this program was built without the feature `secure`";
            return Err(OpenError::Keys(without.to_owned()));
        }
        let contacts = Arc::new(Acquaintances::default());
        let exchange = Arc::new(Exchanging::new(Incarnation::random().as_u64()));
        let made = Mutex::new(None);
        let service = Service::start(
            config,
            Role {
                name: config.mts.name.as_str().into(),
                gateway: true,
                contacts: Some(Arc::clone(&contacts) as Arc<dyn Contacts>),
                #[cfg(feature = "secure")]
                security: guard.as_ref().map(Guard::security),
                view: &|host, mts| {
                    let network = network(config, mts)?;
                    let told = exchange.directory() as Arc<dyn Directory>;
                    let there = network.clone().map(Network::directory);
                    let old = Arc::new(legacy_peers(config)?) as Arc<dyn Directory>;
                    let known = there.into_iter().chain([told, old]).collect();
                    let known = Arc::new(MergedDirectory::new(known));
                    let heard = Arc::clone(&contacts.directory) as Arc<dyn Directory>;
                    let beyond = Arc::clone(&known) as Arc<dyn Directory>;
                    let view: Arc<dyn Directory> = Arc::new(View {
                        all: MergedDirectory::new(vec![host, beyond, heard]),
                        neighbours: Arc::clone(&contacts.neighbours),
                    });
                    *made.lock() = Some((network, known, Arc::clone(&view)));
                    Ok(view)
                },
            },
        )?;
        let Some((network, known, view)) = made.into_inner() else {
            return Err(OpenError::NoRuntime);
        };
        let mut gateway = Self {
            config: config.clone(),
            service: Arc::new(service),
            owner: Owner::this(),
            network,
            view,
            neighbours: Arc::clone(&contacts.neighbours),
            exchange,
            tasks: Vec::new(),
        };
        // The queue first: once the name is known, letters come.
        let own = &gateway.service.own;
        let mts = &gateway.service.mts;
        mts.register(Arc::clone(&own.name), own.incarnation);
        if let Err(error) = gateway.enter() {
            gateway.abort();
            return Err(error);
        }
        let publisher = Arc::new(Publisher {
            host: Arc::clone(&gateway.service.host),
            network: gateway.network.clone().map(Network::directory),
            known: Arc::clone(&known),
            contacts: Arc::clone(&contacts.directory),
            service: Arc::clone(&gateway.service),
            has_keys: !config.security.keys.is_empty(),
            only_loopback: speaks_on_loopback_only(config),
        });
        // From now on, who writes becomes known on this host before its letter arrives there.
        *contacts.publisher.lock() = Some(Arc::clone(&publisher));
        contacts.network.lock().clone_from(&gateway.network);
        let keeper = Keeper::new(publisher, gateway.network.clone());
        gateway.tasks.push(tokio::spawn(keeper.run()));
        let follow = follow_locations(
            Arc::clone(&gateway.service),
            Arc::clone(&gateway.neighbours),
        );
        gateway.tasks.push(tokio::spawn(follow));
        gateway.open_for_letters(config, known)?;
        #[cfg(feature = "secure")]
        gateway
            .tasks
            .extend(guard.map(|guard| tokio::spawn(guard.run())));
        Ok(gateway)
    }

    /// From now on the gateway answers letters, exchanges its directory with neighbours and keeps
    /// in touch with its static peers.
    fn open_for_letters(
        &mut self,
        config: &Config,
        known: Arc<MergedDirectory>,
    ) -> Result<(), OpenError> {
        let means = self.means()?;
        let clerk = Clerk {
            service: Arc::clone(&self.service),
            id: means.id.clone(),
            neighbours: Arc::clone(&self.neighbours),
            view: Arc::clone(&self.view),
            exchange: Arc::clone(&self.exchange),
            notices: Mutex::default(),
        };
        self.tasks.push(tokio::spawn(clerk.run()));
        let exchange = Arc::clone(&self.exchange);
        self.tasks.push(tokio::spawn(exchange.run(means, known)));
        let peers = peers(config);
        self.neighbours.name_peers(peers.clone());
        self.service.mts.keep_in_touch(peers);
        Ok(())
    }

    fn means(&self) -> Result<Means, OpenError> {
        let id = AgentId::new(&*self.service.own.name)
            .map_err(|error| OpenError::Name(RegisterError::Failed(Arc::new(error))))?;
        Ok(Means {
            service: Arc::clone(&self.service),
            id,
            neighbours: Arc::clone(&self.neighbours),
            network: self.network.clone(),
            has_keys: !self.config.security.keys.is_empty(),
        })
    }

    /// Registers the gateway itself, so that the processes of this host find it.
    fn enter(&self) -> Result<(), OpenError> {
        let service = &self.service;
        let own = register(service);
        let own = own.map_err(|error| match error {
            RegisterError::AlreadyRegistered { holder } if holder.role == EntryRole::Gateway => {
                OpenError::GatewayRunning(holder.name.to_string())
            }
            other => other.into(),
        })?;
        // Looked for only now: of two that start at the same moment, at most one finds nobody.
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

    /// The name of the gateway.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.service.own.name
    }

    /// This life of it.
    #[must_use]
    pub fn incarnation(&self) -> Incarnation {
        self.service.own.incarnation
    }

    /// Where it can be reached at present.
    #[must_use]
    pub fn locations(&self) -> Vec<Location> {
        self.service.locations()
    }

    /// Who is there, on this host and on others.
    #[must_use]
    pub fn directory(&self) -> &dyn Directory {
        &*self.view
    }

    /// The gateways of other hosts that a connection is open with at the moment, whoever opened
    /// it.
    #[must_use]
    pub fn neighbours(&self) -> Vec<Neighbour> {
        self.neighbours.all()
    }

    /// Uses another configuration from now on, without losing a letter: orders of transports,
    /// exceptions, the deadline of legacy peers' letters, static peers. Returns the keys that differ
    /// and are used only after the gateway was started again.
    ///
    /// # Errors
    /// When the configuration has mistakes. Nothing has been changed then.
    pub fn reload(&mut self, config: &Config) -> Result<Vec<String>, ConfigError> {
        config.check()?;
        let mut later = self.config.differences(config);
        let open: Vec<Kind> = self.service.mts.kinds().collect();
        let agents = |config: &Config| {
            let peers = config.discovery.peers.iter();
            peers.filter(|it| is_old(it)).cloned().collect::<Vec<_>>()
        };
        let same_agents = agents(&self.config) == agents(config);
        later.retain(|key| match key.as_str() {
            "mts.deadline" | "routes" => false,
            "discovery.static" => !same_agents,
            "mts.transports" => config
                .mts
                .transports
                .iter()
                .any(|kind| !open.contains(kind)),
            _ => true,
        });
        self.service.reorder(config);
        let peers = peers(config);
        self.neighbours.name_peers(peers.clone());
        self.service.mts.keep_in_touch(peers);
        self.config.mts.deadline = config.mts.deadline;
        self.config.routes.clone_from(&config.routes);
        if same_agents {
            self.config
                .discovery
                .peers
                .clone_from(&config.discovery.peers);
        }
        if !later.iter().any(|key| key == "mts.transports") {
            self.config
                .mts
                .transports
                .clone_from(&config.mts.transports);
        }
        Ok(later)
    }

    /// What goes wrong with finding other hosts, if anything does.
    #[must_use]
    pub fn discovery_problem(&self) -> Option<String> {
        self.network.as_ref().and_then(|network| network.problem())
    }

    /// Ends the gateway: says goodbye to the network and gives letters under way a moment to
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
            // Blocks for as long as it takes to say goodbye.
            let goodbye = tokio::task::spawn_blocking(move || network.close()).await;
            if let Err(error) = goodbye {
                tracing::warn!(%error, "did not say goodbye to the network");
            }
        }
        self.service.close().await;
    }

    fn abort(&mut self) {
        if !self.owner.is_this() {
            // In a forked child: saying goodbye to the network would be in the parent's name.
            std::mem::forget(self.network.take());
            return;
        }
        for task in self.tasks.drain(..) {
            task.abort();
        }
        if let Some(network) = self.network.take() {
            network.close();
        }
        self.service.abort();
    }
}

impl Drop for Gateway {
    fn drop(&mut self) {
        self.abort();
    }
}

/// Registers the gateway with its present locations.
fn register(service: &Service) -> Result<Arc<Entry>, RegisterError> {
    service.host.register(Registration {
        role: EntryRole::Gateway,
        agent_type: "fipa-mts".to_owned(),
        description: "message transport service".to_owned(),
        ..Registration::new(
            Arc::clone(&service.own.name),
            service.own.incarnation,
            service.locations(),
        )
    })
}

/// Keeps the gateway's own entry right, and says hello to its neighbours from where it is now: they
/// cannot all be told by the directory of the network. The rest is up to [`Keeper`].
async fn follow_locations(service: Arc<Service>, neighbours: Arc<Neighbours>) {
    let mut locations = service.follow_locations();
    while locations.changed().await.is_ok() {
        let now: Vec<String> = service
            .locations()
            .iter()
            .map(ToString::to_string)
            .collect();
        tracing::info!(
            locations = now.join(" "),
            "this gateway is reached elsewhere now"
        );
        if let Err(error) = register(&service) {
            tracing::warn!(%error, "the processes of this host are not told where the gateway is");
        }
        service.mts.greet(neighbours.to_greet(Instant::now()));
    }
}

/// Whether the directory of the network is announced on loopback only. An interface by name counts
/// when it is the one called `lo`.
fn speaks_on_loopback_only(config: &Config) -> bool {
    let interfaces = &config.discovery.interfaces;
    let is_loopback = |interface: &crate::config::Interface| {
        let text = interface.to_string();
        let address = text.parse::<std::net::IpAddr>();
        address.map_or(text == "lo", |address| address.is_loopback())
    };
    !interfaces.is_empty() && interfaces.iter().all(is_loopback)
}

/// Whether a line of `discovery.static` names an agent of a legacy peer, not a gateway.
fn is_old(peer: &crate::config::Peer) -> bool {
    let mut locations = peer.locations.iter();
    locations.all(|location| location.signature() != Signature::Frames)
}

/// The agents of legacy peers that the configuration names.
fn legacy_peers(config: &Config) -> Result<StaticDirectory, OpenError> {
    let peers = config.discovery.peers.iter().filter(|peer| is_old(peer));
    let agents = peers.map(|peer| (peer.name.as_str(), peer.locations.clone()));
    StaticDirectory::new(agents).map_err(|error| OpenError::Discovery(error.to_string()))
}

/// The gateways that the configuration names.
fn peers(config: &Config) -> Vec<Peer> {
    let peers = config.discovery.peers.iter().filter(|peer| !is_old(peer));
    peers
        .map(|peer| Peer {
            name: peer.name.as_str().into(),
            locations: peer.locations.clone(),
        })
        .collect()
}

/// A directory of other hosts, in which this one's agents are announced.
trait Network: Send + Sync {
    fn directory(self: Arc<Self>) -> Arc<dyn Directory>;
    fn problem(&self) -> Option<String>;
    /// Finds out whether this gateway is still there.
    fn doubt(&self, gateway: Incarnation);
    /// This gateway is not there any more: another one has its place.
    fn ended(&self, gateway: Incarnation);
    /// The interfaces of this host have changed: others are spoken to on the new ones at once.
    fn interfaces_changed(&self);
    fn close(&self);
}

#[cfg(feature = "mdns")]
impl Network for fipa_sds::MdnsDirectory {
    fn directory(self: Arc<Self>) -> Arc<dyn Directory> {
        self
    }

    fn problem(&self) -> Option<String> {
        self.status().last_error
    }

    fn doubt(&self, gateway: Incarnation) {
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
fn network(config: &Config, mts: &fipa_sds::Mts) -> Result<Option<Arc<dyn Network>>, OpenError> {
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
    let directory = fipa_sds::MdnsDirectory::open(config)
        .map_err(|error| OpenError::Discovery(error.to_string()))?;
    Ok(Some(Arc::new(directory)))
}

#[cfg(not(feature = "mdns"))]
fn network(_: &Config, _: &fipa_sds::Mts) -> Result<Option<Arc<dyn Network>>, OpenError> {
    Ok(None)
}

/// Gateways of other hosts that are connected, and agents there that have written before anybody
/// told of them.
#[derive(Default)]
struct Acquaintances {
    neighbours: Arc<Neighbours>,
    directory: Arc<ContactDirectory>,
    publisher: Mutex<Option<Arc<Publisher>>>,
    network: Mutex<Option<Arc<dyn Network>>>,
}

impl Contacts for Acquaintances {
    fn heard(&self, name: &str, agent: Incarnation, location: Location) {
        match self.directory.heard(Instant::now(), name, agent, location) {
            Ok(true) => {
                if let Some(publisher) = &*self.publisher.lock() {
                    publisher.publish();
                }
            }
            Ok(false) => {}
            Err(error) => tracing::info!(%error, "who has written cannot be answered"),
        }
    }

    fn doubtful(&self, location: &Location, fault: TransportErrorKind) {
        self.neighbours.doubt(location, fault);
        if let Some(network) = &*self.network.lock() {
            network.doubt(location.incarnation());
        }
    }

    fn introduced(&self, peer: &Introduction) {
        self.neighbours.introduced(peer);
    }

    fn parted(&self, peer: &Introduction) {
        self.neighbours.parted(Instant::now(), peer);
    }
}
