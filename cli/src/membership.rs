//! What the commands share that take part in a domain: they join it, say why they cannot, and end
//! in order when they are told to.

use std::io::{self, IsTerminal};
use std::pin::pin;
use std::time::Duration;

use fipa::{Agent, Config, Domain, ListenError, OpenError, RegisterError, RegisterOptions};
use tokio::signal::unix::{Signal, SignalKind, signal};

use crate::options;
use crate::report::Failure;

/// Within this time signals to end are one.
const AT_ONCE: Duration = Duration::from_millis(500);

/// The signals that tell a command to end: Ctrl-C, `kill`, and a terminal that closes.
pub(crate) struct Stop {
    interrupt: Signal,
    terminate: Signal,
    hang_up: Signal,
    /// Whether it was started from a terminal.
    from_terminal: bool,
}

/// What a signal wants of a service.
pub(crate) enum Wish {
    /// It is to end.
    End,
    /// It is to read its configuration again.
    Reload,
}

impl Stop {
    /// From now on they end nothing by themselves. Must be called within a tokio runtime.
    pub(crate) fn listen() -> Result<Self, Failure> {
        let listen = |kind| {
            signal(kind).map_err(|error: io::Error| {
                Failure::failed(
                    format!("cannot wait for signals: {error}"),
                    "this process",
                    "see `ulimit -n` for how many files it may open",
                )
            })
        };
        Ok(Self {
            interrupt: listen(SignalKind::interrupt())?,
            terminate: listen(SignalKind::terminate())?,
            hang_up: listen(SignalKind::hangup())?,
            from_terminal: io::stdin().is_terminal(),
        })
    }

    /// What a service is told: a hang-up means that its configuration has changed, unless the
    /// terminal that it was started from has really been closed.
    pub(crate) async fn wish(&mut self) -> Wish {
        tokio::select! {
            _ = self.interrupt.recv() => Wish::End,
            _ = self.terminate.recv() => Wish::End,
            _ = self.hang_up.recv() => {
                if self.from_terminal && !io::stdin().is_terminal() {
                    Wish::End
                } else {
                    Wish::Reload
                }
            }
        }
    }

    /// Returns when one of them has come.
    pub(crate) async fn requested(&mut self) {
        tokio::select! {
            _ = self.interrupt.recv() => {}
            _ = self.terminate.recv() => {}
            _ = self.hang_up.recv() => {}
        }
    }

    /// From now on the command ends, which takes a while when another process holds it up. Whoever
    /// says once more that it is to end does not wait for that: what is left behind then is removed by
    /// the next process of the domain.
    pub(crate) fn ending() {
        // On a thread and a runtime of its own: those of the command may all be held up.
        std::thread::spawn(|| {
            // Some say it twice at once, as `timeout` does.
            std::thread::sleep(AT_ONCE);
            let told = options::block_on(async {
                let mut again = Self::listen()?;
                again.requested().await;
                Ok::<_, Failure>(())
            });
            if matches!(told, Ok(Ok(()))) {
                std::process::exit(1);
            }
        });
    }
}

/// Does some work that ends by itself. A signal ends it before; dropping the work leaves the
/// domain in order.
pub(crate) fn run<T>(work: impl Future<Output = Result<T, Failure>>) -> Result<T, Failure> {
    options::block_on(async {
        let mut stop = Stop::listen()?;
        let mut work = pin!(work);
        tokio::select! {
            done = &mut work => done,
            () = stop.requested() => Err(Failure::failed(
                "told to end before it was done",
                "this process got a signal",
                "run it again when you want the rest",
            )),
        }
    })?
}

/// Joins the domain that the configuration names.
pub(crate) async fn join(config: &Config) -> Result<Domain, Failure> {
    let joined = Domain::open(config).await;
    joined.map_err(|error| not_joined(error, config))
}

/// Why a domain could not be joined, or its gateway not be started.
pub(crate) fn not_joined(error: OpenError, config: &Config) -> Failure {
    let domain = format!("domain {:?}", config.domain);
    match error {
        OpenError::Config(error) => error.into(),
        OpenError::GatewayRunning(name) => Failure::failed(
            format!("the domain has a gateway already, {name:?}"),
            domain,
            "use that one, end it, or start this one for another domain: --set domain=NAME",
        ),
        OpenError::Name(error) => not_registered(error, &config.mts.name, config),
        OpenError::Listen { kind, source } => {
            let used = matches!(&source, ListenError::Bind { source, .. }
                if source.kind() == io::ErrorKind::AddrInUse);
            let advice = if used {
                "end the process that uses the port (`ss -lntp` lists them), or choose another; \
                 with port 0 the system chooses a free one"
            } else {
                "give it addresses of this machine with ports that this user may use"
            };
            Failure::failed(
                source.to_string(),
                format!("transport.{kind}.listen of the configuration"),
                advice,
            )
        }
        OpenError::Keys(_) => Failure::failed(
            error.to_string(),
            format!("mts.name {:?}", config.mts.name),
            "`fipa doctor` says what is wrong; keys are of one gateway: use its name (--set \
             mts.name=NAME), or make new ones in an empty directory (`fipa keys init --dir`)",
        ),
        OpenError::NoTransport(_) => Failure::failed(
            error.to_string(),
            domain,
            "see `fipa config show` for mts.transports, and the reasons above for each of them",
        ),
        other => Failure::failed(
            other.to_string(),
            domain,
            "processes of a domain meet in $FIPA_RUNTIME_DIR, else in /tmp/fipa-<user id>: see \
             whether this user can write there",
        ),
    }
}

/// Registers an agent of this process.
pub(crate) fn register(
    domain: &Domain,
    name: &str,
    options: RegisterOptions,
    config: &Config,
) -> Result<Agent, Failure> {
    let registered = domain.register_with(name, options);
    registered.map_err(|error| not_registered(error, name, config))
}

/// Why a name could not be registered.
pub(crate) fn not_registered(error: RegisterError, name: &str, config: &Config) -> Failure {
    let domain = format!("domain {:?}", config.domain);
    match error {
        RegisterError::AlreadyRegistered { holder } => Failure::failed(
            format!(
                "the name {name:?} is taken by an agent at {:?}",
                holder.mts.name
            ),
            domain,
            "choose another name, or end that agent (`fipa agents` shows where it is)",
        ),
        RegisterError::Invalid(error) => Failure::wrong_usage(
            format!("{name:?} cannot be registered: {error}"),
            "the command line",
            "keep to these limits",
        ),
        other => Failure::failed(
            other.to_string(),
            domain,
            "see `fipa agents` for who is there; end what is not needed",
        ),
    }
}
