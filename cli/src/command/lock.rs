//! `fipa lock`: runs a command while a lock is held.

use std::ffi::OsString;
use std::io;
use std::os::unix::process::ExitStatusExt as _;
use std::process::ExitStatus;
use std::time::Duration;

use clap::Args;
use fipa::admin::open_files;
use fipa::error::ErrorChain;
use fipa::locks::{Lock, LockError};
use fipa::{Agent, AgentId, Config, Incarnation, RegisterOptions};
use rustix::process::{Pid, Signal, kill_process_group, test_kill_process_group};
use tokio::process::{Child, Command};

use super::own::Group;
use crate::complete;
use crate::membership;
use crate::options::{self, Global};
use crate::report::{self, Failure};
use crate::signals::Signals;

/// Interval of looking for processes that are left in the group.
const PAUSE: Duration = Duration::from_millis(20);

/// Exit code if the lock was not acquired in time.
const TIMED_OUT: u8 = 124;
/// Exit code if this command has failed.
const FAILED: u8 = 125;
/// Exit code if the command cannot be run.
const NOT_RUN: u8 = 126;
/// Exit code if the command is not found.
const NOT_FOUND: u8 = 127;

/// Run a command while a resource is locked
///
/// Waits for the lock of the resource, runs the command, and releases the lock when the command ends, in
/// the manner of flock(1). `fipa own` or a robot process owns the resource.
///
/// The environment of the command has the fence of the lock in FIPA_FENCE. The owner of the resource
/// refuses commands with an old fence, so pass it on (`fipa send --fence`).
///
/// If the lock is lost, the command's process group gets SIGTERM, and SIGKILL after the time of
/// --kill-after; with --keep, a warning is printed instead. SIGINT, SIGTERM and SIGHUP are passed on to the group. The command does not
/// read from the terminal: redirect its input.
///
/// If `fipa lock` itself is killed, the command goes on without the lock. The owner then refuses its fence.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa lock bay -- ./dock.sh
  fipa lock bay --within 10s -- ./dock.sh
  fipa lock bay -- sh -c \\
      'fipa send lock:bay dock -p request --fence $FIPA_FENCE --wait'

Exit codes:
  124  the lock was not acquired within the time of --within
  125  fipa lock has failed: for example, the lock was lost
  126  the command cannot be run
  127  the command was not found
  else that of the command; 128 + the signal if a signal ended it")]
pub(crate) struct Arguments {
    /// Name of the resource
    #[arg(add = complete::resources())]
    resource: String,

    /// Maximum wait for the lock, for example 10s [default: no limit]
    #[arg(long, value_name = "TIME", value_parser = options::duration)]
    within: Option<Duration>,

    /// Let the command go on when the lock is lost
    #[arg(long)]
    keep: bool,

    /// Time from SIGTERM to SIGKILL after the loss of the lock
    #[arg(long, value_name = "TIME", default_value = "5s", value_parser = options::duration)]
    kill_after: Duration,

    /// Name of the agent that holds the lock [default: a random name]
    #[arg(long, value_name = "NAME")]
    agent: Option<AgentId>,

    #[command(flatten)]
    group: Group,

    /// Command and its arguments
    #[arg(last = true, required = true, value_name = "COMMAND")]
    command: Vec<OsString>,
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    let config = global.config()?;
    options::block_on(lock(&arguments, &config))?
}

async fn lock(arguments: &Arguments, config: &Config) -> Result<(), Failure> {
    let own_failure = |failure: Failure| failure.with_code(FAILED);
    let mut signals = Signals::listen().map_err(own_failure)?;
    let canceled = || {
        own_failure(Failure::failed(
            "canceled by a signal before the lock was acquired",
            format!("resource {:?}", arguments.resource),
            "run the command again",
        ))
    };
    let domain = tokio::select! {
        joined = membership::join(config) => joined.map_err(own_failure)?,
        _ = signals.next() => return Err(canceled()),
    };
    let name = match &arguments.agent {
        Some(id) => id.name().to_owned(),
        None => format!("fipa-lock-{}", Incarnation::random()),
    };
    let options = RegisterOptions {
        agent_type: "fipa-lock-holder".to_owned(),
        ..RegisterOptions::default()
    };
    let agent = tokio::select! {
        agent = membership::register(&domain, &name, options, config) => agent,
        _ = signals.next() => Err(canceled()),
    };
    let ended = match &agent {
        Err(_) => Ok(()),
        Ok(agent) => {
            let locked = tokio::select! {
                locked = acquire(agent, arguments) => locked,
                _ = signals.next() => Err(canceled()),
            };
            match locked {
                Ok(lock) => hold(&lock, arguments, &mut signals).await,
                Err(failure) => Err(failure),
            }
        }
    };
    // While the agent is registered, the domain delivers the release of its lock.
    domain.close().await;
    agent.map_err(own_failure)?;
    ended
}

async fn acquire(agent: &Agent, arguments: &Arguments) -> Result<Lock, Failure> {
    let resource = &arguments.resource;
    let locked = async {
        arguments.group.apply(agent)?;
        match arguments.within {
            Some(within) => agent.lock_within(resource, within).await,
            None => agent.lock(resource).await,
        }
    };
    let error = match locked.await {
        Ok(lock) => return Ok(lock),
        Err(error) => error,
    };
    let mut place = format!("resource {resource:?}");
    if matches!(error, LockError::TimedOut { .. })
        && let Some(holder) = holder(agent, resource).await
    {
        place += &format!(", held by {holder:?}");
    }
    let code = match error {
        LockError::TimedOut { .. } | LockError::OwnerNotFound { .. } => TIMED_OUT,
        _ => FAILED,
    };
    let help = match error {
        LockError::NoOwner { .. } | LockError::OwnerNotFound { .. } => {
            "start the owner, for example `fipa own RESOURCE`; an owner of the C++ library distributed_locking \
             needs --legacy-peers here"
        }
        LockError::OtherAlgorithm { .. } => "leave --algorithm out, or name that of the owner",
        LockError::TimedOut { .. } if arguments.group.legacy_peers() => {
            "`fipa locks` shows the owner, the holder and the waiting agents; an owner of the C++ library \
             distributed_locking answers only its own algorithm, so name that with --algorithm"
        }
        LockError::Name(_) => "use a name of 1 to 255 bytes without control characters",
        _ => "`fipa locks` shows the owner, the holder and the waiting agents",
    };
    Err(Failure::failed(ErrorChain(&error).to_string(), place, help).with_code(code))
}

/// Maximum wait for the name of the holder after the time of --within.
const HOLDER_TIMEOUT: Duration = Duration::from_secs(1);

/// The holder of a resource, as its owner reports it.
async fn holder(agent: &Agent, resource: &str) -> Option<String> {
    let locks = agent.query_locks(HOLDER_TIMEOUT).await.ok()?;
    let mut locks = locks.into_iter();
    locks.find(|lock| lock.resource == resource)?.holder
}

/// Runs the command.
async fn hold(lock: &Lock, arguments: &Arguments, signals: &mut Signals) -> Result<(), Failure> {
    // Not empty, by the definition of the arguments.
    let Some((program, rest)) = arguments.command.split_first() else {
        return Ok(());
    };
    let mut command = Command::new(program);
    command.args(rest).process_group(0).env_remove("FIPA_FENCE");
    if let Some(fence) = lock.fence() {
        command.env("FIPA_FENCE", fence.to_string());
    }
    let spawned = open_files::with_inherited(|| command.spawn()).flatten();
    let mut child = spawned.map_err(|error| not_run(&error, program))?;
    let group = child.id().and_then(|id| Pid::from_raw(id.cast_signed()));
    let mut is_lost = false;
    loop {
        tokio::select! {
            // After a pause of this process, the command may have ended before its lock.
            biased;
            status = child.wait() => {
                if !is_lost && !lock.is_held() {
                    let resource = &arguments.resource;
                    report::warn(&format!("the command has ended, and the lock of {resource:?} is lost"));
                }
                return ended(status);
            }
            signal = signals.next() => to_group(group, signal),
            lost = lock.lost(), if !is_lost => {
                is_lost = true;
                let resource = &arguments.resource;
                if arguments.keep {
                    report::warn(&format!("{lost}; the command goes on without it (--keep)"));
                    continue;
                }
                end(&mut child, group, arguments.kill_after).await;
                return Err(Failure::failed(
                    format!("{lost}; the command was ended"),
                    format!("resource {resource:?}"),
                    "check the owner with `fipa locks`, and run the command again",
                )
                .with_code(FAILED));
            }
        }
    }
}

fn not_run(error: &io::Error, program: &OsString) -> Failure {
    let code = match error.kind() {
        io::ErrorKind::NotFound => NOT_FOUND,
        _ => NOT_RUN,
    };
    Failure::failed(
        format!("cannot run the command: {error}"),
        program.display().to_string(),
        "give an executable file, or a command in PATH",
    )
    .with_code(code)
}

/// Passes the exit code of the command on.
fn ended(status: io::Result<ExitStatus>) -> Result<(), Failure> {
    let status = status.map_err(|error| {
        Failure::failed(
            format!("cannot wait for the command: {error}"),
            "this process",
            "run the command again",
        )
        .with_code(FAILED)
    })?;
    if status.success() {
        return Ok(());
    }
    let code = match (status.code(), status.signal()) {
        (Some(code), _) => u8::try_from(code).unwrap_or(u8::MAX),
        (None, Some(signal)) => u8::try_from(signal).map_or(u8::MAX, |it| it.saturating_add(128)),
        (None, None) => FAILED,
    };
    Err(Failure::already_reported().with_code(code))
}

/// Ends the process group of the command.
async fn end(child: &mut Child, group: Option<Pid>, kill_after: Duration) {
    to_group(group, Signal::TERM);
    let all_ended = async {
        // Only the group's end proves that no process of the command uses the resource.
        let _ = child.wait().await;
        while group.is_some_and(|group| test_kill_process_group(group).is_ok()) {
            tokio::time::sleep(PAUSE).await;
        }
    };
    if tokio::time::timeout(kill_after, all_ended).await.is_err() {
        to_group(group, Signal::KILL);
        let _ = child.wait().await;
    }
}

/// Sends a signal to the process group of the command, if it has not ended.
fn to_group(group: Option<Pid>, signal: Signal) {
    if let Some(group) = group {
        // Fails if no process is left.
        let _ = kill_process_group(group, signal);
    }
}
