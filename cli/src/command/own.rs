//! `fipa own`: an agent that owns a resource.

use std::path::PathBuf;
use std::time::Duration;

use clap::Args;
use fipa::error::ErrorChain;
use fipa::locks::{
    AdmitError, Algorithm, Ending, Fence, LockError, LockOptions, OwnError, OwnOptions,
};
use fipa::locks::{Owned, OwnerEvent};
use fipa::{Agent, AgentId, Config, Message, MessageBuilder, Performative, RegisterOptions};
use fipa_acl::{escape, escape_name};

use crate::answers::Answers;
use crate::membership::{self, Stop};
use crate::options::{self, Global};
use crate::output;
use crate::report::Failure;

/// Own a resource: other agents can lock it, and commands of the holder are admitted
///
/// The agent prints one line for each grant and for each end of a grant, until Ctrl-C. `fipa lock`, or a
/// program with the library, locks the resource.
///
/// Each request that the agent receives is a command. It is admitted (agree) if it has the fence of the
/// live grant (`fipa send --fence`), and refused otherwise. The directory lists the agent under the name
/// lock:RESOURCE, too.
///
/// The epoch of the fences is in a file, in FIPA_STATE_DIR, XDG_STATE_HOME/fipa or ~/.local/state/fipa. Each
/// start raises it above the file, the time of day, and the fences that agents and devices report, so a
/// fence of an earlier run is never valid again, on any host.
///
/// Without the file, the owner grants nothing for one lease, and for at least 15s. If the clock is not set,
/// either, and no agent or device has seen a fence, it does not start. Use --forget for the first start.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa own bay --forget                the first start: grant at once
  fipa own bay
  fipa own bay --agent crane --lease 5s
  fipa own bay --volatile              without a state file

In other terminals:
  fipa lock bay -- ./dock.sh
  fipa locks --watch")]
pub(crate) struct Arguments {
    /// Name of the resource
    resource: String,

    /// Name of the agent [default: RESOURCE-owner]
    #[arg(long, value_name = "NAME")]
    agent: Option<AgentId>,

    /// Lease of a grant: a holder that ends without a proof delays the next one for this time
    #[arg(long, value_name = "TIME", default_value = "15s", value_parser = options::duration)]
    lease: Duration,

    /// Keep the epoch of the fences in this directory
    #[arg(long, value_name = "DIR", conflicts_with = "volatile")]
    state_dir: Option<PathBuf>,

    /// Use no state file: each start is one without a file
    #[arg(long)]
    volatile: bool,

    /// Without a state file, grant at once: no lock of an earlier run is in use, and no device knows a fence
    /// of one
    #[arg(long)]
    forget: bool,

    #[command(flatten)]
    group: Group,
}

/// Options that all agents which use a resource have in common.
#[derive(Debug, Args)]
pub(super) struct Group {
    /// Algorithm that decides which agent is next. The owner names it to the others, which need no option; one
    /// with another algorithm is refused: owner_queue, ricart_agrawala, ricart_agrawala_extended, suzuki_kasami
    /// or suzuki_kasami_extended
    #[arg(long, value_name = "NAME", default_value = "owner_queue", value_parser = algorithm)]
    algorithm: Algorithm,

    /// Take part with agents of the C++ library distributed_locking: legacy peers are asked whether they
    /// use locks, and the algorithm is ricart_agrawala_extended unless --algorithm names another one of that
    /// library
    #[arg(long)]
    legacy_peers: bool,
}

fn algorithm(text: &str) -> Result<Algorithm, String> {
    let mut all = Algorithm::ALL.into_iter();
    all.find(|one| one.protocol() == text).ok_or_else(|| {
        let names = Algorithm::ALL.map(Algorithm::protocol);
        format!("expected one of {}", names.join(", "))
    })
}

impl Group {
    pub(super) fn legacy_peers(&self) -> bool {
        self.legacy_peers
    }

    pub(super) fn apply(&self, agent: &Agent) -> Result<(), LockError> {
        agent.use_locks(LockOptions {
            algorithm: self.algorithm,
            legacy_peers: self.legacy_peers,
            ..LockOptions::default()
        })
    }
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    let config = global.config()?;
    options::block_on(own(arguments, &config))?
}

async fn own(arguments: Arguments, config: &Config) -> Result<(), Failure> {
    let mut stop = Stop::listen()?;
    let domain = stop.during(membership::join(config)).await?;
    let resource = arguments.resource;
    let name = match &arguments.agent {
        Some(id) => id.name().to_owned(),
        None => format!("{resource}-owner"),
    };
    let options = RegisterOptions {
        agent_type: "fipa-own".to_owned(),
        ..RegisterOptions::default()
    };
    let agent = stop
        .during(membership::register(&domain, &name, options, config))
        .await?;
    let begun = async {
        arguments.group.apply(&agent)?;
        let options = OwnOptions {
            lease: arguments.lease,
            state_dir: arguments.state_dir,
            volatile: arguments.volatile,
            forget: arguments.forget,
        };
        agent.own(&resource, options).await
    };
    let begun = tokio::select! {
        begun = begun => Some(begun),
        () = stop.requested() => None,
    };
    let ended = match begun {
        None => Ok(()),
        Some(Err(error)) => Err(not_owned(&error, &resource)),
        Some(Ok(owned)) => {
            let served = tokio::select! {
                served = serve(&agent, &owned, config) => served,
                () = stop.requested() => Ok(()),
            };
            Stop::ending();
            owned.release().await;
            served
        }
    };
    // While the agent is registered, the domain delivers its last messages.
    domain.close().await;
    drop(agent);
    ended
}

async fn serve(agent: &Agent, owned: &Owned, config: &Config) -> Result<(), Failure> {
    output::text(&format!(
        "{} is owned by {} in domain {}; press Ctrl-C to stop\n",
        escape(owned.resource()),
        escape_name(agent.name()),
        config.domain
    ))?;
    let silence = owned.silence();
    if !silence.is_zero() {
        // Rounded up to seconds.
        let seconds =
            Duration::from_secs(silence.as_secs() + u64::from(silence.subsec_nanos() > 0));
        output::text(&format!(
            "it grants nothing for {}, because a lock of an earlier run may be in use\n",
            humantime::format_duration(seconds)
        ))?;
    }
    let mut answers = Answers::new(agent);
    loop {
        tokio::select! {
            event = owned.next() => match event {
                Some(event) => output::text(&line(&event))?,
                None => return Ok(()),
            },
            received = agent.receive() => match received {
                Ok(incoming) if incoming.violation().is_some() => {}
                Ok(incoming) => {
                    if let Some(answer) = handle(agent, owned, incoming.message())? {
                        answers.send(&incoming, answer).await;
                    }
                }
                Err(error) => {
                    return Err(Failure::failed(
                        ErrorChain(&error).to_string(),
                        format!("agent {:?}", agent.name()),
                        "restart the agent",
                    ));
                }
            },
        }
    }
}

fn line(event: &OwnerEvent) -> String {
    let fenced = |fence: &Option<Fence>| match fence {
        Some(fence) => format!(", fence {}", escape(&fence.to_string())),
        None => String::new(),
    };
    match event {
        OwnerEvent::Granted { holder, fence } => {
            format!("granted to {}{}\n", escape_name(holder), fenced(fence))
        }
        OwnerEvent::Ended { holder, fence, how } => {
            let how = match how {
                Ending::Released => "released by",
                Ending::Expired => "expired for",
                Ending::Gone => "ended with",
                Ending::Forced => "taken from",
                _ => "ended for",
            };
            format!("{how} {}{}\n", escape_name(holder), fenced(fence))
        }
        OwnerEvent::Contested { by } => format!("contested by {}\n", escape_name(by)),
        OwnerEvent::Silent { holder } => {
            format!("{} holds it and does not answer\n", escape_name(holder))
        }
        _ => String::new(),
    }
}

/// Admits or refuses a command, and returns the answer. Other messages are ignored.
fn handle(
    agent: &Agent,
    owned: &Owned,
    message: &Message,
) -> Result<Option<MessageBuilder>, Failure> {
    if *message.performative() != Performative::Request {
        return Ok(None);
    }
    let (act, text) = match owned.check(message) {
        Ok(fence) => (Performative::Agree, format!("admitted with {fence}")),
        Err(error) => (
            Performative::Refuse,
            format!("refused: {}", refusal(&error)),
        ),
    };
    output::text(&format!("{}: {message}\n", escape(&text)))?;
    let answer = message.reply(act).sender(agent.id().clone()).content(text);
    Ok(Some(answer))
}

fn refusal(error: &AdmitError) -> String {
    ErrorChain(error).to_string()
}

fn not_owned(error: &OwnError, resource: &str) -> Failure {
    let place = format!("resource {resource:?}");
    let problem = ErrorChain(error).to_string();
    match error {
        OwnError::Name(_) | OwnError::Options(_) => {
            Failure::wrong_usage(problem, place, "`fipa own --help` describes the options")
        }
        OwnError::StateFile(_) => Failure::failed(
            problem,
            place,
            "give a directory with --state-dir, or use no file with --volatile",
        ),
        OwnError::NoMemory { .. } => Failure::failed(
            problem,
            place,
            "set the clock, or copy the state file of the earlier host; if no lock of an earlier run is in \
             use and no device knows its fences, use --forget",
        ),
        OwnError::Taken { .. } => Failure::failed(
            problem,
            place,
            "`fipa locks` lists the resources with their owners",
        ),
        _ => Failure::failed(problem, place, "run the command again"),
    }
}
