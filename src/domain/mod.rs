//! The membership of a process in a domain.

pub(crate) mod accounts;
pub(crate) mod background;
pub(crate) mod change_log;
pub(crate) mod coalition;
pub(crate) mod counting;
pub(crate) mod directory_view;
pub(crate) mod files;
pub(crate) mod maintenance;
pub(crate) mod membership;
#[cfg(any(feature = "protocols", feature = "net"))]
pub(crate) mod presence;
pub(crate) mod process;
pub(crate) mod report;
pub(crate) mod service;
pub(crate) mod user_dir;

use std::ffi::OsStr;
use std::fmt;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Weak};
use std::time::Duration;

use fipa_acl::{Dialect, Message, Performative, Representation};
use fipa_sds::{Cancellation, Entry, Query, Watch};
use fipa_transport::log_limit;
use parking_lot::Mutex;
use tokio::runtime::Handle;

use self::report::RouteReport;
use crate::agent::checks::Rules;
use crate::agent::lock_slot;
use crate::agent::stated::Introductions;
use crate::config::{ConfigError, Reloaded, Sources};
use crate::domain::directory_view::DirectoryView;
use crate::domain::process::Owner;
use crate::domain::service::{Role, Service};
use crate::error::OpenError;
use crate::{AgentId, Config};

/// The membership of this process in a domain. The processes of one domain on one host find each
/// other.
///
/// A clone is cheap. The membership ends when [`close`](Self::close) is called, or when the last clone
/// and the last agent are dropped.
///
/// A child process that is forked without exec cannot use its parent's membership: calls fail with
/// [`Forked`](crate::error::Forked), and dropping releases nothing. The child can open a domain of its own
/// on a runtime of its own. Until it ends or calls exec, it keeps its parent's locks, so other
/// processes detect the end of the parent only afterwards.
#[derive(Clone)]
pub struct Domain {
    pub(crate) inner: Arc<Inner>,
}

pub(crate) struct Inner {
    pub(crate) service: Service,
    pub(crate) owner: Owner,
    /// The configuration that applies now.
    config: Mutex<Config>,
    /// Its `mts.deadline` in nanoseconds, which each letter needs.
    deadline: AtomicU64,
    /// Maximum length of a letter, in bytes.
    pub(crate) max_letter: u64,
    pub(crate) rules: Rules,
    #[cfg_attr(
        not(feature = "protocols"),
        expect(dead_code, reason = "there are no locks")
    )]
    pub(crate) locking: lock_slot::Neighbors,
    pub(crate) introductions: Introductions,
}

impl Inner {
    /// Returns the deadline of letters whose sender sets none.
    pub(crate) fn deadline(&self) -> Duration {
        Duration::from_nanos(self.deadline.load(Ordering::Relaxed))
    }

    /// Returns the time for a question and its answer: their two deadlines.
    #[cfg(feature = "protocols")]
    pub(crate) fn answer_timeout(&self) -> Duration {
        self.deadline() * 2
    }
}

impl Drop for Inner {
    fn drop(&mut self) {
        // In a forked child, everything still belongs to the parent.
        if self.owner.is_this() {
            self.service.abort();
        }
    }
}

impl fmt::Debug for Inner {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Inner").finish_non_exhaustive()
    }
}

impl fmt::Debug for Domain {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Domain")
            .field("mts", &self.inner.service.own)
            .finish_non_exhaustive()
    }
}

/// Numbers of contents that have arrived through shared memory: see [`Domain::content_counts`].
#[cfg(feature = "shm")]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize)]
#[non_exhaustive]
pub struct ContentCounts {
    /// Contents that are read in the memory of their sender.
    pub in_place: u64,
    /// Contents that were copied, because the process already held as many in place as it may: 15 of one sender, 256 of
    /// all. A program that reads a letter and drops it has none.
    pub copied: u64,
}

/// Reads the configuration of a domain again, from the sources that the program has given.
#[derive(Debug, Clone)]
pub struct Follower {
    domain: Weak<Inner>,
    sources: Arc<Sources>,
}

impl Follower {
    /// Reads the configuration again, and [applies](Domain::reload) it. Returns `None` after the process has left the
    /// domain.
    ///
    /// # Errors
    /// Fails when the configuration cannot be read or has mistakes; nothing has changed then.
    #[must_use]
    pub fn reload(&self) -> Option<Result<Reloaded, ConfigError>> {
        let inner = self.domain.upgrade()?;
        let domain = Domain { inner };
        let config = Config::load(&self.sources);
        Some(config.and_then(|config| domain.reload(&config)))
    }
}

/// The description of an agent in the directory.
#[derive(Debug, Clone, Default)]
pub struct RegisterOptions {
    /// The kind of agent, for searches; may be empty.
    pub agent_type: String,
    /// Free text; may be empty.
    pub description: String,
}

impl Domain {
    /// Joins the domain of the configuration that the environment of this process selects: the file
    /// named by `$FIPA_CONFIG`, else `./fipa.toml`, else `~/.config/fipa/fipa.toml`, else
    /// `/etc/fipa/fipa.toml`, else the defaults. See [`open`](Self::open). The process [follows](Self::follow) the
    /// configuration.
    ///
    /// # Errors
    /// If the file cannot be read or has mistakes, or as for [`open`](Self::open).
    pub async fn from_environment() -> Result<Self, OpenError> {
        let sources = Sources::from_environment();
        let domain = Self::open(&Config::load(&sources)?).await?;
        domain.follow(sources);
        Ok(domain)
    }

    /// Joins the domain that the configuration names. Must be called within a tokio runtime, which
    /// then runs the background tasks.
    ///
    /// Waits for other processes on a thread for blocking calls, up to a minute. Dropping the future
    /// ends the wait, and the process leaves the domain again.
    ///
    /// # Errors
    /// If the configuration is invalid, if the directory of the domain cannot be used, or if no
    /// transport can be used.
    pub async fn open(config: &Config) -> Result<Self, OpenError> {
        Self::open_for(config, false).await
    }

    /// Joins the domain like [`open`](Self::open), for a program that ends within a second, such as a
    /// command that sends one message. Joining and leaving is faster by about 20 ms, because the process
    /// does not have the kernel watch the directory. It polls the directory every 100 ms, so it learns
    /// later that an agent joined or left; a letter to an agent that has just joined does not wait.
    ///
    /// # Errors
    /// As for [`open`](Self::open).
    pub async fn open_briefly(config: &Config) -> Result<Self, OpenError> {
        Self::open_for(config, true).await
    }

    async fn open_for(config: &Config, brief: bool) -> Result<Self, OpenError> {
        let runtime = Handle::try_current().map_err(|_| OpenError::NoRuntime)?;
        let config = config.clone();
        let opened = background::run(&runtime, move |cancellation| {
            let joined = Self::join(&config, brief, cancellation);
            joined.map_err(|error| error.explained(&config))
        });
        opened.await?
    }

    /// Joins the domain on a thread for blocking calls.
    fn join(config: &Config, brief: bool, cancellation: &Cancellation) -> Result<Self, OpenError> {
        let rules = Rules::load(&config.monitor)?;
        let name = process_name(&gethostname::gethostname(), std::process::id());
        let service = Service::start(
            config,
            Role {
                name: name.into(),
                gateway: false,
                brief,
                // Letters from other hosts reach this process only through the gateway.
                contacts: None,
                // Connections within this host need no proof of identity.
                #[cfg(feature = "secure")]
                security: None,
                #[cfg(feature = "net")]
                refusals: fipa_transport_net::Refusals::default(),
                #[cfg(feature = "net")]
                refused_dials: fipa_transport_net::RefusedDials::default(),
                view: &|host, _| Ok(host),
            },
            cancellation,
        )?;
        Ok(Self {
            inner: Arc::new(Inner {
                service,
                owner: Owner::this(),
                config: Mutex::new(config.clone()),
                deadline: AtomicU64::new(nanoseconds(config.mts.deadline)),
                max_letter: config.transport.shm.max_letter,
                rules,
                locking: lock_slot::Neighbors::default(),
                introductions: Introductions::default(),
            }),
        })
    }

    /// Returns the directory: the agents of this host and, if a gateway is running, the agents that it
    /// has discovered on other hosts.
    #[must_use]
    pub fn directory(&self) -> DirectoryView<'_> {
        DirectoryView::of(&*self.inner.service.host)
    }

    /// Returns the known agents, sorted by name: those of this host and, if a gateway is running, those
    /// that it has discovered on other hosts. Gateways with their agents, and coalitions, are not
    /// included; [`directory`](Self::directory) has them, too.
    #[must_use]
    pub fn agents(&self) -> Vec<Arc<Entry>> {
        self.directory().refresh();
        let mut agents = report::agents(&*self.inner.service.host, &Query::all());
        agents.retain(|entry| !entry.is_platform_agent());
        agents
    }

    /// Returns the [`agents`](Self::agents) that were registered with exactly this type
    /// ([`RegisterOptions::agent_type`]).
    #[must_use]
    pub fn agents_of_type(&self, agent_type: &str) -> Vec<Arc<Entry>> {
        let mut agents = self.agents();
        agents.retain(|entry| entry.agent_type == agent_type);
        agents
    }

    /// Returns the changes from now on of the agents, coalitions and gateways in the directory, as a
    /// [`Stream`](futures_core::Stream), which ends when the last handle of the domain and its agents is
    /// dropped. For a complete picture, call this first and then
    /// [`agents`](Self::agents); an agent that joined in between appears in both.
    ///
    /// ```no_run
    /// # async fn example(domain: fipa::Domain) {
    /// use fipa::Change;
    ///
    /// let mut changes = domain.changes();
    /// for arm in domain.agents_of_type("arm") {
    ///     println!("{} is here", arm.name);
    /// }
    /// while let Some(change) = changes.next().await {
    ///     match change {
    ///         Change::Joined(entry) => println!("{} has joined", entry.name),
    ///         Change::Left(entry) => println!("{} has left", entry.name),
    ///         _ => {}
    ///     }
    /// }
    /// # }
    /// ```
    #[must_use]
    pub fn changes(&self) -> Watch {
        self.directory().watch()
    }

    /// Reports the routes that letters from this process to the matching agents would take now, and
    /// the state of each route. For agents on other hosts, the report contains the route to the
    /// gateway; [`routes::of_gateway`](crate::admin::routes::of_gateway) reports the routes from there.
    #[must_use]
    pub fn routes(&self, to: &Query) -> RouteReport {
        let entries = report::agents(&*self.inner.service.host, to);
        self.inner.service.report(&entries)
    }

    /// Counts the contents of at least 1 KiB that have arrived through shared memory, since the domain was opened.
    #[cfg(feature = "shm")]
    #[must_use]
    pub fn content_counts(&self) -> ContentCounts {
        let counters = self.inner.service.shm_counters();
        ContentCounts {
            in_place: counters.in_place,
            copied: counters.copied_full,
        }
    }

    /// Applies another configuration without losing a letter. The order of the transports, the exceptions from it, the
    /// deadline of letters and the access rules take effect at once, also for letters that wait. The other keys take
    /// effect when the process joins the domain again. Keys that only gateways use are not in the result.
    ///
    /// # Errors
    /// Fails when the configuration has mistakes; nothing has changed then.
    pub fn reload(&self, config: &Config) -> Result<Reloaded, ConfigError> {
        config.check()?;
        let mut current = self.inner.config.lock();
        let reloaded = self.inner.service.reload(&mut current, config);
        let deadline = nanoseconds(current.mts.deadline);
        self.inner.deadline.store(deadline, Ordering::Relaxed);
        Ok(reloaded)
    }

    /// Whether the agent with this name may record the letters of this host and fetch the recordings
    /// (`access.recorders`). While an agent may, the sender of a received message is the one of its envelope, which other
    /// rules of `[access]` check, too.
    #[must_use]
    pub fn is_recorder(&self, agent: &str) -> bool {
        self.inner.service.gate().is_recorder(agent)
    }

    /// Reads the configuration from these sources again whenever `fipa reload` requests it, and
    /// [applies](Self::reload) it, as long as the process takes part in the domain. A call replaces the sources of
    /// the previous one. With the result, the program reads it at other times, for example after SIGHUP.
    pub fn follow(&self, sources: Sources) -> Follower {
        let mut requests = self.inner.service.reload_requests();
        let follower = Follower {
            domain: Arc::downgrade(&self.inner),
            sources: Arc::new(sources),
        };
        let following = follower.clone();
        self.inner.service.runtime.spawn(async move {
            while let Some(request) = requests.next().await {
                let Some(reloaded) = following.reload() else {
                    return;
                };
                if let Ok(reloaded) = &reloaded {
                    log_limit::info!(
                        applied = reloaded.applied.join(" "),
                        after_restart = reloaded.later.join(" "),
                        "the configuration was read again"
                    );
                }
                request.answer(&reloaded);
            }
        });
        follower
    }

    /// Leaves the domain. Waits up to one second for letters in transit, and deregisters all agents of
    /// this process.
    pub async fn close(self) {
        if !self.inner.owner.is_this() {
            return;
        }
        self.inner.service.close().await;
    }
}

fn nanoseconds(deadline: Duration) -> u64 {
    u64::try_from(deadline.as_nanos()).unwrap_or(u64::MAX)
}

/// Returns the name of the message transport service of a process on the host with this name.
fn process_name(host: &OsStr, process: u32) -> String {
    format!("{}-{process}", fipa_sds::to_name(&host.to_string_lossy()))
}

/// Logs a warning if legacy peers cannot read or write this name.
pub(crate) fn warn_of_name(id: &AgentId) {
    for (peer, reason) in peers_without(id) {
        log_limit::warn!(
            "agents of {peer} can neither receive letters from {:?} nor address it ({reason}); use a \
             name of ASCII letters, digits, '-', '_' and '.' if there are such peers",
            id.name()
        );
    }
}

/// Returns the implementations of legacy peers that cannot exchange letters with an agent of this
/// name, with the reason.
fn peers_without(id: &AgentId) -> Vec<(Dialect, String)> {
    let peers = [
        (Dialect::FipaServices, Representation::BitEfficient),
        (Dialect::Jade, Representation::String),
    ];
    let reason = |(dialect, representation)| {
        // JADE quotes a name that is no word, but writes its messages in US-ASCII, and its envelopes in
        // an encoding that they do not declare.
        if dialect == Dialect::Jade && !id.name().is_ascii() {
            return Some((
                dialect,
                "JADE writes names of ASCII characters only".to_owned(),
            ));
        }
        let message = Message::builder(Performative::Inform).sender(id.clone());
        let encoded = message.build().ok()?.encode(representation, dialect);
        encoded.err().map(|error| (dialect, error.to_string()))
    };
    peers.into_iter().filter_map(reason).collect()
}

#[cfg(test)]
mod tests {
    use std::os::unix::ffi::OsStrExt as _;

    use super::*;

    #[test]
    fn a_warning_names_the_peers_that_cannot_use_the_name() {
        use Dialect::{FipaServices, Jade};
        for (name, expected) in [
            ("rover", &[][..]),
            ("arm.left@robot-1:1099/JADE", &[]),
            ("odd echo", &[FipaServices]),
            ("1a", &[FipaServices]),
            ("ödd", &[FipaServices, Jade]),
            ("ödd echo", &[FipaServices, Jade]),
        ] {
            let peers = peers_without(&AgentId::new(name).unwrap());
            let peers: Vec<_> = peers.into_iter().map(|(peer, _)| peer).collect();
            assert_eq!(peers, expected, "{name}");
        }
    }

    #[test]
    fn a_process_on_a_host_of_any_name_has_a_valid_name() {
        let names: [&[u8]; 5] = [b"sherpa", b"(none)", br"([{*+?|^$\", b" a\xff ", b""];
        for host in names {
            let name = process_name(OsStr::from_bytes(host), 4711);
            assert_eq!(fipa_sds::check_name(&name), Ok(()), "{name}");
            assert!(name.ends_with("-4711"), "{name}");
        }
        assert_eq!(process_name(OsStr::new("sherpa"), 4711), "sherpa-4711");
    }
}
