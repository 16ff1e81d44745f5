//! A process's membership in a domain.

use std::sync::Arc;

use fipa_acl::{Dialect, Message, Performative, Representation};
use fipa_sds::{Directory, HostError, Query, RegisterError, Registration};
use fipa_transport::{Incarnation, Kind, ListenError};

use crate::agent::Agent;
use crate::config::ConfigError;
use crate::owner::Owner;
use crate::place::PlaceError;
use crate::routes::{self, Report};
use crate::service::{Role, Service};
use crate::{AgentId, AgentIdError, Config};

/// This process's membership in a domain: processes of one domain on one host see each other.
///
/// Cheap to clone; ends when [`close`](Self::close) is called or the last clone and the last
/// agent are dropped.
///
/// A child process that is forked without exec cannot use its parent's membership: calls fail with
/// [`Forked`](crate::Forked), and dropping releases nothing. The child can open a domain of its own,
/// on a runtime of its own. Until it ends or calls exec, it keeps its parent's locks, so that other
/// processes notice the parent's end only afterwards.
#[derive(Clone)]
pub struct Domain {
    pub(crate) inner: Arc<Inner>,
}

pub(crate) struct Inner {
    pub(crate) service: Service,
    pub(crate) owner: Owner,
    pub(crate) deadline: std::time::Duration,
    #[cfg(feature = "monitor")]
    pub(crate) rules: crate::checks::Rules,
}

impl Drop for Inner {
    fn drop(&mut self) {
        // In a forked child everything stays the parent's.
        if self.owner.is_this() {
            self.service.abort();
        }
    }
}

/// Why a domain could not be joined.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum OpenError {
    /// The configuration has mistakes.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// There is no tokio runtime with I/O and time; processes without one use
    /// [`crate::blocking`].
    #[error("no tokio runtime is running; call this from one, or use fipa::blocking")]
    NoRuntime,
    /// The domain's directory cannot be used.
    #[error(transparent)]
    Place(#[from] PlaceError),
    /// A protocol that the configuration names cannot be used.
    #[cfg(feature = "monitor")]
    #[error(transparent)]
    Protocol(#[from] crate::checks::ProtocolError),
    /// The directory of the host cannot be used.
    #[error(transparent)]
    Directory(#[from] HostError),
    /// A transport that the gateway needs cannot be opened.
    #[error("{kind}: {source}")]
    Listen {
        /// Which transport.
        kind: Kind,
        /// Why.
        source: ListenError,
    },
    /// None of the configured transports works.
    #[error("no transport can be used: {0}")]
    NoTransport(String),
    /// The service's own name is taken, or not a name.
    #[error("cannot register the gateway: {0}")]
    Name(#[from] RegisterError),
    /// There can be one gateway only.
    #[error("the domain has a gateway already, {0:?}; end it, or name another domain")]
    GatewayRunning(String),
    /// The socket of a watcher cannot be used.
    #[error("cannot listen to the processes of the domain: {0}")]
    Watch(std::io::Error),
    /// The rules for who may send to whom cannot be used.
    #[error("access: {0}")]
    Access(String),
    /// The keys that the configuration names cannot be used.
    #[error("security.keys: {0}")]
    Keys(String),
    /// Other hosts cannot be looked for.
    #[error("discovery: {0}")]
    Discovery(String),
}

/// What an agent says about itself when registering.
#[derive(Debug, Clone, Default)]
pub struct RegisterOptions {
    /// What kind of agent it is, for searches; may be empty.
    pub agent_type: String,
    /// Free text; may be empty.
    pub description: String,
}

impl Domain {
    /// Joins the domain that the configuration names. Must be called within a tokio runtime,
    /// which then does the work in the background.
    ///
    /// # Errors
    /// When the configuration, the domain's directory or every transport cannot be used.
    pub async fn open(config: &Config) -> Result<Self, OpenError> {
        #[cfg(feature = "monitor")]
        let rules = crate::checks::Rules::load(&config.monitor)?;
        #[cfg(not(feature = "monitor"))]
        if config.monitor.check != crate::config::Check::Off {
            tracing::warn!("monitor.check does nothing: built without the feature \"monitor\"");
        }
        let host = gethostname::gethostname();
        let name = format!("{}-{}", host.to_string_lossy(), std::process::id());
        let service = Service::start(
            config,
            Role {
                name: name.into(),
                gateway: false,
                // Another way than shared memory between processes of this host; never further.
                contacts: None,
                // What stays on this host needs no proof.
                #[cfg(feature = "secure")]
                security: None,
                view: &|host, _| Ok(host),
            },
        )?;
        let deadline = config.mts.deadline;
        Ok(Self {
            inner: Arc::new(Inner {
                service,
                owner: Owner::this(),
                deadline,
                #[cfg(feature = "monitor")]
                rules,
            }),
        })
    }

    /// Registers an agent with nothing but a name.
    ///
    /// # Errors
    /// See [`register_with`](Self::register_with).
    pub fn register(&self, name: &str) -> Result<Agent, RegisterError> {
        self.register_with(name, RegisterOptions::default())
    }

    /// Registers an agent. From now on it is found by its name, here and, when a gateway is
    /// running, on other hosts; its letters wait in its queue until it receives them.
    ///
    /// # Errors
    /// When somebody else has the name, or it is no name.
    pub fn register_with(
        &self,
        name: &str,
        options: RegisterOptions,
    ) -> Result<Agent, RegisterError> {
        self.inner.owner.check()?;
        let service = &self.inner.service;
        let id = AgentId::new(name)
            .map_err(|error: AgentIdError| RegisterError::Failed(Arc::new(error)))?;
        let incarnation = Incarnation::random();
        let name: Arc<str> = name.into();
        // The queue first: once the name is known, letters come.
        service.mts.register(Arc::clone(&name), incarnation);
        let registration = Registration {
            agent_type: options.agent_type,
            description: options.description,
            ..Registration::new(Arc::clone(&name), incarnation, service.locations())
        };
        match service.host.register(registration) {
            Ok(_) => {
                warn_of_name(&id);
                Ok(Agent::new(self.clone(), id, name, incarnation))
            }
            Err(error) => {
                // Nobody can have written to it.
                drop(service.mts.deregister(incarnation));
                Err(error)
            }
        }
    }

    /// Who is there: the agents of this host and, when a gateway is running, those it knows of.
    #[must_use]
    pub fn directory(&self) -> &dyn Directory {
        &*self.inner.service.host
    }

    /// Which way letters from this process to the agents that match would go now, and what has
    /// happened on each of its ways. For agents of other hosts that is the way to the gateway; see
    /// [`routes::of_gateway`](crate::routes::of_gateway) for how it goes on from there.
    #[must_use]
    pub fn routes(&self, to: &Query) -> Report {
        let entries = routes::agents(self.directory(), to);
        self.inner.service.report(&entries)
    }

    /// Leaves the domain: gives letters under way a moment to arrive, then ends. All agents of
    /// this process are deregistered.
    pub async fn close(self) {
        if !self.inner.owner.is_this() {
            return;
        }
        self.inner.service.close().await;
    }
}

/// Logs that legacy peers cannot be told this name, if so: their encodings write names as words.
pub(crate) fn warn_of_name(id: &AgentId) {
    let fails = |dialect| {
        let message = Message::builder(Performative::Inform)
            .sender(id.clone())
            .build()
            .ok()?;
        message.encode(Representation::String, dialect).err()
    };
    if let Some(error) = fails(Dialect::Standard).or_else(|| fails(Dialect::Jade)) {
        tracing::warn!(
            "agents of legacy peers (string encoding, JADE) can neither get letters from {:?} nor name it \
             ({error}); use a name without blanks and parentheses where there are such peers",
            id.name()
        );
    }
}
