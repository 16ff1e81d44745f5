//! The gateway of a domain on one host: the same service as in every robot process, with leave to
//! forward, listening on the network, and the go-between of two directories: what lives on this
//! host is announced to the network, what is announced there is told to the processes here.

mod clerk;
mod neighbours;

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Instant;

use fipa_mts::Contacts;
use fipa_mts::core::Peer;
use fipa_sds::{
    ContactDirectory, Directory, Entry, HostDirectory, MergedDirectory, Reach, RegisterError,
    Registration, Role as EntryRole,
};
use fipa_transport::{Incarnation, Introduction, Kind, Location};
use parking_lot::Mutex;
use tokio::task::JoinHandle;

use self::clerk::Clerk;
pub use self::neighbours::Neighbour;
use self::neighbours::{Neighbours, View};
use crate::domain::OpenError;
use crate::service::{Role, Service};
use crate::{AgentId, Config};

/// A running gateway. Ends when [`close`](Self::close) is called or it is dropped.
pub struct Gateway {
    service: Arc<Service>,
    network: Option<Arc<dyn Network>>,
    view: Arc<dyn Directory>,
    neighbours: Arc<Neighbours>,
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
        let contacts = Arc::new(Acquaintances::default());
        let made = Mutex::new(None);
        let service = Service::start(
            config,
            Role {
                name: config.mts.name.as_str().into(),
                gateway: true,
                listen: config.transport.tcp.listen.clone(),
                contacts: Some(Arc::clone(&contacts) as Arc<dyn Contacts>),
                view: &|host, mts| {
                    let network = network(config, mts)?;
                    let there = network.clone().map(Network::directory);
                    let heard = Arc::clone(&contacts.directory) as Arc<dyn Directory>;
                    let all = [Some(host as Arc<dyn Directory>), there, Some(heard)];
                    let all = all.into_iter().flatten().collect();
                    let view: Arc<dyn Directory> = Arc::new(View {
                        all: MergedDirectory::new(all),
                        neighbours: Arc::clone(&contacts.neighbours),
                    });
                    *made.lock() = Some((network, Arc::clone(&view)));
                    Ok(view)
                },
            },
        )?;
        let Some((network, view)) = made.into_inner() else {
            return Err(OpenError::NoRuntime);
        };
        let mut gateway = Self {
            service: Arc::new(service),
            network,
            view,
            neighbours: Arc::clone(&contacts.neighbours),
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
            contacts: Arc::clone(&contacts.directory),
            locations: gateway.service.locations.clone(),
        });
        // From now on, who writes becomes known on this host before its letter arrives there.
        *contacts.publisher.lock() = Some(Arc::clone(&publisher));
        let exchange = Exchange {
            publisher,
            announced: HashMap::new(),
        };
        gateway.tasks.push(tokio::spawn(exchange.run()));
        gateway.open_for_letters(config)?;
        Ok(gateway)
    }

    /// From now on the gateway answers letters, and keeps in touch with its static peers.
    fn open_for_letters(&mut self, config: &Config) -> Result<(), OpenError> {
        let own = &self.service.own;
        let id = AgentId::new(&*own.name)
            .map_err(|error| OpenError::Name(RegisterError::Failed(Arc::new(error))))?;
        let clerk = Clerk {
            service: Arc::clone(&self.service),
            id,
            neighbours: Arc::clone(&self.neighbours),
            view: Arc::clone(&self.view),
        };
        self.tasks.push(tokio::spawn(clerk.run()));
        let peers = peers(config);
        self.neighbours.name_peers(peers.clone());
        self.service.mts.keep_in_touch(peers);
        Ok(())
    }

    /// Registers the gateway itself, so that the processes of this host find it.
    fn enter(&self) -> Result<(), OpenError> {
        let service = &self.service;
        let own = service.host.register(Registration {
            role: EntryRole::Gateway,
            agent_type: "fipa-mts".to_owned(),
            description: "message transport service".to_owned(),
            ..Registration::new(
                Arc::clone(&service.own.name),
                service.own.incarnation,
                service.locations.clone(),
            )
        });
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

    /// Where it can be reached.
    #[must_use]
    pub fn locations(&self) -> &[Location] {
        &self.service.locations
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

    /// What goes wrong with finding other hosts, if anything does.
    #[must_use]
    pub fn discovery_problem(&self) -> Option<String> {
        self.network.as_ref().and_then(|network| network.problem())
    }

    /// Ends the gateway: says goodbye to the network and gives letters under way a moment to
    /// arrive.
    pub async fn close(mut self) {
        for task in self.tasks.drain(..) {
            task.abort();
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

/// The static peers of the configuration.
fn peers(config: &Config) -> Vec<Peer> {
    let peers = config.discovery.peers.iter();
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

    fn introduced(&self, peer: &Introduction) {
        self.neighbours.introduced(peer);
    }

    fn parted(&self, peer: &Introduction) {
        self.neighbours.parted(peer);
    }
}

/// Tells the processes of this host who is on others, as reachable through this gateway.
struct Publisher {
    host: Arc<HostDirectory>,
    network: Option<Arc<dyn Directory>>,
    contacts: Arc<ContactDirectory>,
    /// Where this gateway takes letters: the locations of all that it stands for.
    locations: Vec<Location>,
}

impl Publisher {
    fn publish(&self) {
        let announced = self.network.as_ref().map(|network| network.entries());
        let heard = self.contacts.entries();
        let known = announced.iter().flat_map(|entries| entries.iter());
        // The later of one name counts: what is announced, before what was heard.
        let all = heard
            .iter()
            .chain(known)
            .filter(|entry| entry.role == EntryRole::Agent);
        let through_here = all.map(|entry| Entry {
            locations: self.locations.clone(),
            ..Entry::clone(entry)
        });
        if let Err(error) = self.host.publish_remote(through_here.collect()) {
            tracing::warn!(%error, "the processes of this host are not told of all other hosts");
        }
    }
}

/// Keeps the two directories in step.
struct Exchange {
    publisher: Arc<Publisher>,
    announced: HashMap<Arc<str>, Arc<Entry>>,
}

impl Exchange {
    async fn run(mut self) {
        let publisher = Arc::clone(&self.publisher);
        let network: Arc<dyn Directory> = match &publisher.network {
            Some(network) => Arc::clone(network),
            // Nobody is there, and nobody comes.
            None => Arc::new(ContactDirectory::new()),
        };
        let (mut here, mut there) = (publisher.host.watch(), network.watch());
        let mut forgetting = tokio::time::interval(ContactDirectory::MEMORY / 4);
        loop {
            if let Some(network) = &publisher.network {
                self.announce(&**network);
            }
            publisher
                .contacts
                .forget(Instant::now(), |entry| network.known(&entry.name).is_some());
            publisher.publish();
            let goes_on = tokio::select! {
                change = here.next() => change.is_some(),
                change = there.next() => change.is_some(),
                _ = forgetting.tick() => true,
            };
            if !goes_on {
                return;
            }
            // Many changes that came together are one.
            while here.try_next().is_some() || there.try_next().is_some() {}
        }
    }

    /// Announces what has joined on this host, and takes back what has left.
    fn announce(&mut self, network: &dyn Directory) {
        let entries = self.publisher.host.entries();
        let mine: HashMap<Arc<str>, &Arc<Entry>> = entries
            .iter()
            .filter(|entry| entry.reach == Reach::Local && entry.role == EntryRole::Agent)
            .map(|entry| (Arc::clone(&entry.name), entry))
            .collect();
        self.announced.retain(|name, entry| {
            let stays = mine.get(name).is_some_and(|now| ***now == **entry);
            if !stays && let Err(error) = network.deregister(name, entry.incarnation) {
                tracing::debug!(%name, %error, "was not announced any more");
            }
            stays
        });
        let locations = self.publisher.locations.iter();
        let locations: Vec<Location> = locations
            .filter(|location| location.kind() != Kind::Shm)
            .cloned()
            .collect();
        for (name, entry) in mine {
            if self.announced.contains_key(&name) {
                continue;
            }
            let registration = Registration {
                agent_type: entry.agent_type.clone(),
                description: entry.description.clone(),
                registered: entry.registered,
                ..Registration::new(Arc::clone(&name), entry.incarnation, locations.clone())
            };
            match network.register(registration) {
                Ok(_) => {
                    self.announced.insert(name, Arc::clone(entry));
                }
                Err(error) => {
                    tracing::warn!(%name, %error, "an agent is not announced to other hosts");
                }
            }
        }
    }
}
