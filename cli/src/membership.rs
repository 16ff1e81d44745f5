//! Shared code of the commands that join a domain: joining, registering, error reports, and an
//! orderly end on a signal.

use std::io;
use std::sync::Arc;
use std::time::Duration;

use clap::Args;
use fipa::admin::contact;
use fipa::admin::routes::{self, AskError, RouteReport};
use fipa::admin::stopped::StoppedAgent;
use fipa::admin::watch::{WatchOptions, Watcher};
use fipa::config::{ConfigError, Reloaded};
use fipa::error::{DomainDirError, ErrorChain, ListenError, OpenError, RegisterError, WebError};
use fipa::threads::ThreadError;
use fipa::{Agent, AgentId, Config, Domain, Entry, Incarnation, RegisterOptions, log_limit};
use fipa_acl::{escape, escape_name};
use rustix::process::Signal;
use tokio::signal::unix::{self, SignalKind};

use crate::options;
use crate::report::{self, Failure};
use crate::signals::Signals;

/// Signals within this time after the first one count as the same request to end.
const SIGNAL_GRACE: Duration = Duration::from_millis(500);

/// The signals that end a command. SIGHUP ends it if the terminal from which it was started has been closed.
/// Otherwise SIGHUP requests to read the configuration again, as it does of other services.
pub(crate) struct Stop {
    signals: Signals,
    /// Whether the command was started from a terminal.
    from_terminal: bool,
    /// Whether a request to read the configuration again came while the command waited for a request to end.
    has_reload: bool,
}

/// The request that a signal makes of a service.
pub(crate) enum SignalRequest {
    /// End the service.
    End,
    /// Read the configuration again.
    Reload,
}

impl Stop {
    /// Starts listening. From now on the signals do not end the process by themselves.
    ///
    /// Must be called within a tokio runtime.
    pub(crate) fn listen() -> Result<Self, Failure> {
        Ok(Self {
            signals: Signals::listen()?,
            from_terminal: has_terminal(),
            has_reload: false,
        })
    }

    /// Waits for the next request. One to read the configuration again that came during [`requested`](Self::requested)
    /// is the next one.
    pub(crate) async fn next_request(&mut self) -> SignalRequest {
        match std::mem::take(&mut self.has_reload) {
            true => SignalRequest::Reload,
            false => self.next_signal().await,
        }
    }

    async fn next_signal(&mut self) -> SignalRequest {
        let is_closed = |from_terminal| from_terminal && !has_terminal();
        match self.signals.next().await {
            Signal::HUP if !is_closed(self.from_terminal) => SignalRequest::Reload,
            _ => SignalRequest::End,
        }
    }

    /// Waits for a signal that ends the command. [`join`] handles requests to read the configuration again.
    pub(crate) async fn requested(&mut self) {
        while let SignalRequest::Reload = self.next_signal().await {
            self.has_reload = true;
        }
    }

    /// Does work that may wait for another process, for example to join the domain. A signal ends it with an error;
    /// dropping the future leaves the domain in order.
    pub(crate) async fn during<T>(
        &mut self,
        work: impl Future<Output = Result<T, Failure>>,
    ) -> Result<T, Failure> {
        tokio::select! {
            done = work => done,
            // Before the work is dropped, which may wait, too.
            () = async {
                self.requested().await;
                Self::ending();
            } => Err(Failure::failed(
                "canceled by a signal before the command was done",
                "this process",
                "run the command again",
            )),
        }
    }

    /// Marks the start of the orderly end, which can take a while when another process delays it. A
    /// second signal ends the process at once; the next process of the domain removes the files that
    /// it leaves behind.
    pub(crate) fn ending() {
        // A thread and a runtime of its own: all threads of the command may be blocked. If the system refuses
        // it, a second signal changes nothing.
        let _ = std::thread::Builder::new().spawn(|| {
            // Some programs, for example `timeout`, send the signal twice.
            std::thread::sleep(SIGNAL_GRACE);
            let signaled = options::block_on(async {
                let mut again = Self::listen()?;
                again.requested().await;
                Ok::<_, Failure>(())
            });
            if matches!(signaled, Ok(Ok(()))) {
                std::process::exit(1);
            }
        });
    }
}

/// Runs work that ends by itself. A signal cancels it; dropping the future leaves the domain in
/// order.
pub(crate) fn run<T>(work: impl Future<Output = Result<T, Failure>>) -> Result<T, Failure> {
    options::block_on(async { Stop::listen()?.during(work).await })?
}

/// Whether this process has a terminal. The kernel takes a closed terminal from all processes that were started from it.
fn has_terminal() -> bool {
    std::fs::File::open("/dev/tty").is_ok()
}

/// Returns the agent of this name if it is one of this host and its process is stopped.
pub(crate) fn stopped(agent: &Agent, name: &str) -> Option<StoppedAgent> {
    StoppedAgent::of(&*agent.domain().directory().known(name)?)
}

/// Joins the domain of the configuration. From then on, `fipa reload` and SIGHUP make the process read it again.
pub(crate) async fn join(config: &Config) -> Result<Domain, Failure> {
    let joined = Domain::open(config).await;
    let domain = joined.map_err(|error| not_joined(error, config))?;
    let follower = domain.follow(options::sources());
    // Fails for lack of descriptors. SIGHUP then does nothing, or ends a command without `Stop`.
    if let Ok(mut hang_up) = unix::signal(SignalKind::hangup()) {
        tokio::spawn(async move {
            while hang_up.recv().await.is_some() {
                match follower.reload() {
                    Some(reloaded) => report_reload(&reloaded),
                    None => return,
                }
            }
        });
    }
    Ok(domain)
}

/// Reports the result of reading the configuration again. After a mistake the process continues with the previous
/// configuration.
pub(crate) fn report_reload(reloaded: &Result<Reloaded, ConfigError>) {
    match reloaded {
        Ok(Reloaded { later, .. }) => {
            log_limit::info!("configuration reloaded");
            if !later.is_empty() {
                let later = later.join(", ");
                report::warn(&format!(
                    "changes to {later} take effect when this process is restarted"
                ));
            }
        }
        Err(error) => report::warn(&format!(
            "continuing with the previous configuration: {}",
            ErrorChain(error)
        )),
    }
}

/// Joins the domain of the configuration, for a command that ends within a second.
pub(crate) async fn join_briefly(config: &Config) -> Result<Domain, Failure> {
    let joined = Domain::open_briefly(config).await;
    joined.map_err(|error| not_joined(error, config))
}

/// Watches the domain of the configuration.
pub(crate) async fn watch(config: &Config, options: WatchOptions) -> Result<Watcher, Failure> {
    let watcher = Watcher::open(config, options).await;
    watcher.map_err(|error| not_joined(error, config))
}

/// The error report for a domain that cannot be joined or a gateway that cannot be started.
pub(crate) fn not_joined(error: OpenError, config: &Config) -> Failure {
    let domain = format!("domain {:?}", config.domain);
    match error {
        OpenError::Config(error) => error.into(),
        OpenError::GatewayRunning(name) => Failure::failed(
            format!("the domain already has a gateway, {name:?}"),
            domain,
            "use that gateway, stop it, or start this one in another domain (--set domain=NAME)",
        ),
        OpenError::Name(error) => not_registered(error, &config.mts.name, config),
        OpenError::Listen { kind, source } => {
            let used = matches!(&source, ListenError::Bind { source, .. }
                if source.kind() == io::ErrorKind::AddrInUse);
            let advice = if used {
                "`ss -lntup` lists the process that uses the port"
            } else {
                "use an address of this machine and a port that this user may open"
            };
            Failure::failed(
                ErrorChain(&source).to_string(),
                format!("transport.{kind}.listen of the configuration"),
                advice,
            )
        }
        OpenError::Web(error) => not_served(&error),
        OpenError::Keys(_) => Failure::failed(
            ErrorChain(&error).to_string(),
            format!("mts.name {:?}", config.mts.name),
            "run `fipa doctor`; keys belong to one gateway: use its name (--set mts.name=NAME), or make \
             new keys in an empty directory (`fipa keys init --dir DIRECTORY`)",
        ),
        OpenError::KeyLog(_) => Failure::failed(
            ErrorChain(&error).to_string(),
            "$SSLKEYLOGFILE",
            "set SSLKEYLOGFILE to a file that only this user can read, or remove security.key_log",
        ),
        OpenError::DomainDir(DomainDirError::NotPrivate {
            path,
            problem,
            remedy,
        }) => Failure::failed(
            format!("{} cannot be used: {problem}", path.display()),
            domain,
            remedy,
        ),
        OpenError::DomainDir(error @ DomainDirError::NotWritable { .. }) => {
            not_writable(&error, domain)
        }
        OpenError::Thread(error) => Failure::failed(
            ErrorChain(&error).to_string(),
            domain,
            "raise the limit that the message names, or end processes",
        ),
        OpenError::NoTransport(_) => Failure::failed(
            ErrorChain(&error).to_string(),
            domain,
            "check mts.transports (`fipa config show`); the message above has the reason for each",
        ),
        other => Failure::failed(
            ErrorChain(&other).to_string(),
            domain,
            "check whether this user can write to $FIPA_RUNTIME_DIR, or to /tmp/fipa-<user id> when it is \
             not set: the processes of a domain meet there",
        ),
    }
}

/// The error report for a gateway that cannot answer HTTP.
fn not_served(error: &WebError) -> Failure {
    let (key, advice) = match error {
        WebError::Listen { source, .. } if source.kind() == io::ErrorKind::AddrInUse => (
            "http.listen",
            "`ss -ltnp` lists the process that uses the port",
        ),
        WebError::Listen { .. } => (
            "http.listen",
            "use a loopback address of this machine and a port that this user may open",
        ),
        WebError::NoKey { .. } => (
            "http.listen",
            "set security.keys, or use a loopback address, for example 127.0.0.1:9790",
        ),
        _ => (
            "http.token_file",
            "give a file in a directory to which only the user of the gateway can write; if it is missing, the \
             gateway creates it",
        ),
    };
    Failure::failed(
        ErrorChain(error).to_string(),
        format!("{key} of the configuration"),
        advice,
    )
}

/// The error report for a directory of the domain in which no file can be written.
fn not_writable(error: &DomainDirError, domain: String) -> Failure {
    match error {
        DomainDirError::NotWritable {
            path,
            problem,
            remedy,
            source,
        } => Failure::failed(
            format!("{} cannot be used: {problem} ({source})", path.display()),
            domain,
            remedy,
        ),
        other => Failure::failed(
            ErrorChain(other).to_string(),
            domain,
            "`fipa doctor` checks the directory of the domain",
        ),
    }
}

/// Registers an agent.
pub(crate) async fn register(
    domain: &Domain,
    name: &str,
    options: RegisterOptions,
    config: &Config,
) -> Result<Agent, Failure> {
    let registered = domain.register_with(name, options).await;
    registered.map_err(|error| not_registered(error, name, config))
}

/// Runs `work` as an agent of the domain, and leaves the domain after it.
pub(crate) fn run_agent(
    config: &Config,
    register: impl AsyncFnOnce(&Domain) -> Result<Agent, Failure>,
    work: impl AsyncFnOnce(&Agent, &mut Stop) -> Result<(), Failure>,
) -> Result<(), Failure> {
    options::block_on(async {
        let mut stop = Stop::listen()?;
        let domain = stop.during(join(config)).await?;
        let agent = stop.during(register(&domain)).await;
        let done = match &agent {
            Ok(agent) => work(agent, &mut stop).await,
            Err(_) => Ok(()),
        };
        Stop::ending();
        let registered = agent.map(drop);
        domain.close().await;
        registered.and(done)
    })?
}

// The agent of a command that receives messages, and the command's end. Not a doc comment: clap would print
// it as the help of the command.
#[derive(Debug, Args)]
pub(crate) struct Receiver {
    /// Name of the agent
    name: AgentId,

    /// Type of the agent, for `fipa agents --type`
    #[arg(long = "type", value_name = "TYPE", default_value = "")]
    agent_type: String,

    /// Description of the agent, for `fipa agents --description`
    #[arg(long, value_name = "TEXT", default_value = "")]
    description: String,

    /// End after this number of messages
    #[arg(long, short, value_name = "N")]
    pub(crate) count: Option<u64>,

    /// End after this time, for example 10s
    #[arg(long = "for", value_name = "TIME", value_parser = options::duration)]
    pub(crate) time: Option<Duration>,
}

impl Receiver {
    /// Registers the agent in the domain of the configuration.
    pub(crate) async fn register(
        &self,
        domain: &Domain,
        config: &Config,
    ) -> Result<Agent, Failure> {
        let options = RegisterOptions {
            agent_type: self.agent_type.clone(),
            description: self.description.clone(),
        };
        register(domain, self.name.name(), options, config).await
    }
}

/// The error report for a name that cannot be registered.
pub(crate) fn not_registered(error: RegisterError, name: &str, config: &Config) -> Failure {
    let domain = format!("domain {:?}", config.domain);
    match error {
        RegisterError::AlreadyRegistered { holder } => Failure::failed(
            format!(
                "the name {name:?} is already registered by an agent at {:?}",
                holder.mts.shown()
            ),
            domain,
            "choose another name, or stop that agent (`fipa agents --long` shows its locations)",
        ),
        RegisterError::Invalid(error) => Failure::wrong_usage(
            format!("cannot register the name {name:?}: {}", ErrorChain(&error)),
            "the command line",
            "use a name within these limits",
        ),
        RegisterError::Failed(ref error)
            if let Some(cause) = error.downcast_ref::<DomainDirError>() =>
        {
            not_writable(cause, domain)
        }
        RegisterError::Failed(ref error)
            if let Some(cause) = error.downcast_ref::<ThreadError>() =>
        {
            Failure::failed(
                ErrorChain(cause).to_string(),
                domain,
                "raise the limit that the message names, or end processes",
            )
        }
        other => Failure::failed(
            ErrorChain(&other).to_string(),
            domain,
            "`fipa agents` lists the registered agents; stop those that are not needed",
        ),
    }
}

/// Maximum time for the gateway's answer to an introduction.
const INTRODUCTION_TIMEOUT: Duration = Duration::from_secs(5);

/// Parses the address of an agent of another platform.
pub(crate) fn address(text: &str) -> Result<String, contact::AddressError> {
    contact::location(text).map(|_| text.to_owned())
}

// The address of an agent of another platform. Not a doc comment: clap would print it as the help of the command.
#[derive(Debug, Args)]
pub(crate) struct Addresses {
    /// Address of the agent, if it is an agent of another platform that is not in the directory, for example
    /// http://10.0.0.7:7778/acc; repeatable: the next one is used after a letter was not sent to the one before
    #[arg(long, value_name = "ADDRESS", value_parser = address)]
    address: Vec<String>,
}

impl Addresses {
    /// Whether an address is given.
    pub(crate) fn is_given(&self) -> bool {
        !self.address.is_empty()
    }

    /// Adds the addresses to the identifier of an agent, and introduces it to the gateway.
    pub(crate) async fn of(&self, agent: &Agent, id: &AgentId) -> Result<AgentId, Failure> {
        introduce(agent, id.clone(), &self.address).await
    }
}

/// Maximum number of agents that a search introduces to the gateway.
const MAX_FOUND: usize = 64;

/// Introduces agents that a directory facilitator of another platform has listed to the gateway of this host, so that
/// letters to their names reach them. Warns if the gateway refuses one.
pub(crate) async fn introduce_found(agent: &Agent, found: impl Iterator<Item = &AgentId>) {
    let directory = agent.domain().directory();
    let unknown = found.filter(|id| {
        let has_address = id
            .addresses()
            .iter()
            .any(|it| contact::location(it).is_ok());
        has_address && directory.lookup(id.name()).is_none()
    });
    let unknown: Vec<AgentId> = unknown.take(MAX_FOUND).cloned().collect();
    let Some(gateway) = gateway(agent.domain()).filter(|_| !unknown.is_empty()) else {
        return;
    };
    for id in unknown {
        let introduced = contact::introduce(agent, &gateway, &id, INTRODUCTION_TIMEOUT).await;
        if let Err(error) = introduced {
            report::warn(&format!(
                "letters to {} cannot be sent: {}",
                escape_name(id.name()),
                escape(&ErrorChain(&error).to_string())
            ));
            return;
        }
    }
}

/// Adds addresses to the identifier of an agent of another platform, and introduces the agent to the
/// gateway of this host. Does nothing without addresses.
pub(crate) async fn introduce(
    agent: &Agent,
    mut id: AgentId,
    addresses: &[String],
) -> Result<AgentId, Failure> {
    if addresses.is_empty() {
        return Ok(id);
    }
    let failed = |what: String| {
        Failure::failed(
            what,
            addresses.join(", "),
            "check the address, and that `fipa up` runs with the transport in mts.transports",
        )
    };
    for address in addresses {
        let with = id.with_address(address);
        id = with.map_err(|error| failed(error.to_string()))?;
    }
    let gateway = gateway(agent.domain()).ok_or_else(no_gateway)?;
    contact::introduce(agent, &gateway, &id, INTRODUCTION_TIMEOUT)
        .await
        .map_err(|error| failed(ErrorChain(&error).to_string()))?;
    Ok(id)
}

/// Returns the gateway of this host, if one is running.
pub(crate) fn gateway(domain: &Domain) -> Option<Arc<Entry>> {
    let entries = domain.directory().entries();
    entries.iter().find(|entry| entry.is_own_gateway()).cloned()
}

/// Maximum time for the gateway's report.
const REPORT_TIMEOUT: Duration = Duration::from_secs(5);

/// Requests the report of this host's gateway about the routes to these receivers, or to all. Returns
/// `None` when no gateway is running.
pub(crate) async fn gateway_report(
    domain: &Domain,
    receivers: Option<&str>,
) -> Result<Option<RouteReport>, Failure> {
    if gateway(domain).is_none() {
        return Ok(None);
    }
    let agent = asker(domain).await?;
    report_to(&agent, receivers).await
}

/// Registers an agent that serves only to query the gateway of this host.
pub(crate) async fn asker(domain: &Domain) -> Result<Agent, Failure> {
    let name = format!("fipa-routes-{}", Incarnation::random());
    let options = RegisterOptions {
        agent_type: routes::ASKER_TYPE.to_owned(),
        ..RegisterOptions::default()
    };
    let registered = domain.register_with(&name, options).await;
    registered.map_err(|error| no_report(&error, "this host"))
}

/// Like [`gateway_report`], with the agent of [`asker`].
pub(crate) async fn report_to(
    agent: &Agent,
    receivers: Option<&str>,
) -> Result<Option<RouteReport>, Failure> {
    let domain = agent.domain();
    let Some(gateway) = gateway(domain) else {
        return Ok(None);
    };
    let report = routes::of_gateway(agent, &gateway, receivers, REPORT_TIMEOUT).await;
    match report {
        Ok(mut report) => {
            report.routes.retain(|route| route.receiver != agent.name());
            Ok(Some(report))
        }
        Err(AskError::NotDelivered(_)) if domain.directory().lookup(&gateway.name).is_none() => {
            Ok(None)
        }
        Err(error) => Err(no_report(&error, &format!("gateway {:?}", gateway.name))),
    }
}

fn no_report(error: &(dyn std::error::Error + 'static), place: &str) -> Failure {
    Failure::failed(
        ErrorChain(error).to_string(),
        place,
        "check the log of the gateway; if it hangs, restart it (`fipa up`)",
    )
}

pub(crate) fn no_gateway() -> Failure {
    Failure::failed(
        "no gateway is running on this host, and only gateways reach other platforms",
        "this host",
        "start one with the transport http in mts.transports: `fipa up`",
    )
}
