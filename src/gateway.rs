//! The gateway of a domain on one host: the same service as in every robot process, with leave to
//! forward, listening on the network, and the go-between of two directories: what lives on this
//! host is announced to the network, what is announced there is told to the processes here.

use std::collections::HashMap;
use std::sync::Arc;

use fipa_sds::{Directory, Entry, HostDirectory, Reach, Registration, Role as EntryRole};
use fipa_transport::{Incarnation, Kind, Location};
use tokio::task::JoinHandle;

use crate::Config;
use crate::domain::OpenError;
use crate::service::{Role, Service};

/// A running gateway. Ends when [`close`](Self::close) is called or it is dropped.
pub struct Gateway {
    service: Service,
    network: Option<Arc<dyn Network>>,
    view: Arc<dyn Directory>,
    task: Option<JoinHandle<()>>,
}

impl Gateway {
    /// Starts the gateway of the domain that the configuration names. Must be called within a
    /// tokio runtime, which then does the work in the background.
    ///
    /// # Errors
    /// When the configuration, the domain's directory or a configured address cannot be used, or
    /// the domain has a gateway already.
    pub async fn open(config: &Config) -> Result<Self, OpenError> {
        if !config.discovery.peers.is_empty() {
            tracing::warn!(
                "discovery.static is not used by this version: gateways are found by mDNS only"
            );
        }
        let made = parking_lot::Mutex::new(None);
        let service = Service::start(
            config,
            Role {
                name: config.mts.name.as_str().into(),
                gateway: true,
                listen: config.transport.tcp.listen.clone(),
                view: &|host, mts| {
                    let network = network(config, mts)?;
                    let view: Arc<dyn Directory> = match &network {
                        Some(network) => {
                            let there = Arc::clone(network).directory();
                            Arc::new(fipa_sds::MergedDirectory::new(vec![host, there]))
                        }
                        None => host,
                    };
                    *made.lock() = Some((network, Arc::clone(&view)));
                    Ok(view)
                },
            },
        )?;
        let Some((network, view)) = made.into_inner() else {
            return Err(OpenError::NoRuntime);
        };
        let mut gateway = Self {
            service,
            network,
            view,
            task: None,
        };
        if let Err(error) = gateway.enter() {
            gateway.abort();
            return Err(error);
        }
        if let Some(network) = gateway.network.clone() {
            let exchange = Exchange {
                host: Arc::clone(&gateway.service.host),
                network,
                locations: gateway.service.locations.clone(),
                announced: HashMap::new(),
            };
            gateway.task = Some(tokio::spawn(exchange.run()));
        }
        Ok(gateway)
    }

    /// Registers the gateway itself, so that the processes of this host find it.
    fn enter(&self) -> Result<(), OpenError> {
        let service = &self.service;
        let entries = service.host.entries();
        if let Some(other) = entries
            .iter()
            .find(|entry| entry.role == EntryRole::Gateway)
        {
            return Err(OpenError::GatewayRunning(other.name.to_string()));
        }
        service.host.register(Registration {
            role: EntryRole::Gateway,
            agent_type: "fipa-mts".to_owned(),
            description: "message transport service".to_owned(),
            ..Registration::new(
                Arc::clone(&service.own.name),
                service.own.incarnation,
                service.locations.clone(),
            )
        })?;
        Ok(())
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

    /// What goes wrong with finding other hosts, if anything does.
    #[must_use]
    pub fn discovery_problem(&self) -> Option<String> {
        self.network.as_ref().and_then(|network| network.problem())
    }

    /// Ends the gateway: says goodbye to the network and gives letters under way a moment to
    /// arrive.
    pub async fn close(mut self) {
        self.leave_network();
        self.service.close().await;
    }

    fn leave_network(&mut self) {
        if let Some(task) = self.task.take() {
            task.abort();
        }
        if let Some(network) = self.network.take() {
            network.close();
        }
    }

    fn abort(&mut self) {
        self.leave_network();
        self.service.abort();
    }
}

impl Drop for Gateway {
    fn drop(&mut self) {
        self.abort();
    }
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

/// Keeps the two directories in step.
struct Exchange {
    host: Arc<HostDirectory>,
    network: Arc<dyn Network>,
    /// Where this gateway takes letters: the locations of all that it stands for.
    locations: Vec<Location>,
    announced: HashMap<Arc<str>, Arc<Entry>>,
}

impl Exchange {
    async fn run(mut self) {
        let network = Arc::clone(&self.network).directory();
        let (mut here, mut there) = (self.host.watch(), network.watch());
        loop {
            self.announce(&*network);
            self.publish(&*network);
            let goes_on = tokio::select! {
                change = here.next() => change.is_some(),
                change = there.next() => change.is_some(),
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
        let entries = self.host.entries();
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
        let locations = self
            .locations
            .iter()
            .filter(|location| location.kind() != Kind::Shm);
        let locations: Vec<Location> = locations.cloned().collect();
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

    /// Tells the processes of this host who is on others, as reachable through this gateway.
    fn publish(&self, network: &dyn Directory) {
        let entries = network.entries();
        let through_here = entries
            .iter()
            .filter(|entry| entry.role == EntryRole::Agent);
        let through_here = through_here.map(|entry| Entry {
            locations: self.locations.clone(),
            ..Entry::clone(entry)
        });
        if let Err(error) = self.host.publish_remote(through_here.collect()) {
            tracing::warn!(%error, "the processes of this host are not told of all other hosts");
        }
    }
}
