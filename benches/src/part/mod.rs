//! The part of one process in a measurement: an end of a path, or a process between the ends.
//!
//! A part reads orders from standard input and writes events to standard output, one JSON document per
//! line, and ends with its standard input. Between two orders it sleeps, so many paths can be kept
//! ready and take turns.

mod agent;
mod iceoryx;
mod languages;
mod letters;
mod locks;
mod orders;
mod relay;
mod socket;
mod topics;
mod watcher;
mod wire;

use std::time::Duration;

use fipa::Config;
use fipa_transport_shm::raw::Wait as RawWait;
use rustix::event::{PollFd, PollFlags, poll};
use rustix::io::Errno;
use serde::{Deserialize, Serialize};

use crate::error::PartError;
use crate::machine;

pub(super) use self::locks::{BY_HAND, Variant};
pub(super) use self::orders::{By, End, Event, Fill, Letters, LockStep, Order, Spread};
pub(super) use self::wire::Wire;

/// Time in which a part ends by itself after its orders have ended.
const GRACE: Duration = Duration::from_millis(100);

/// The part of a process; the argument of `--part`.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Part {
    /// An agent of this name in the configured domain.
    Agent { end: End, name: String },
    /// A number of receiving agents; their address is a pattern.
    Crowd { count: usize },
    /// An agent that uses locks, and one that sends the same letters by hand.
    Locks(LockAgents),
    /// Counts the letters of the configured domain on this host.
    Watcher,
    /// The gateway of the configured domain.
    Gateway,
    /// The shared memory transport alone.
    Letters { end: End },
    /// Bare iceoryx2.
    Iceoryx { end: End, wait: Wait },
    /// An agent that sends requests, or one that answers them.
    Correspondent { end: End },
    /// An agent that publishes a topic.
    Publisher,
    /// An agent with this index that subscribes to the topic.
    Subscriber { index: usize },
    /// Bare iceoryx2 publish-subscribe: the publisher for this number of subscribers.
    IceoryxPublisher { subscribers: usize },
    /// A subscriber of bare iceoryx2.
    IceoryxSubscriber,
    /// A bare socket; the address comes with the first order of the end that connects.
    Socket { end: End, kind: Socket },
    /// Between bare iceoryx2 and a bare connection.
    Relay { end: End, wire: Wire },
}

impl Part {
    /// The end of the path that the part is; `None` for a part between the ends.
    pub(super) fn end(&self) -> Option<End> {
        match self {
            Self::Agent { end, .. }
            | Self::Letters { end }
            | Self::Iceoryx { end, .. }
            | Self::Socket { end, .. } => Some(*end),
            Self::Crowd { .. } => Some(End::Receiver),
            // More processes or threads than processors take part.
            Self::Locks(_)
            | Self::Watcher
            | Self::Correspondent { .. }
            | Self::Publisher
            | Self::Subscriber { .. }
            | Self::IceoryxPublisher { .. }
            | Self::IceoryxSubscriber
            | Self::Gateway
            | Self::Relay { .. } => None,
        }
    }
}

/// The agents of all processes of a group that shares resources.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct LockAgents {
    pub(super) variant: Variant,
    /// Number of processes.
    pub(super) count: usize,
    /// Index of this process. The process with index [`OWNER`](Self::OWNER) owns the resource.
    pub(super) index: usize,
    /// The beginning of all names.
    pub(super) prefix: String,
}

impl LockAgents {
    /// Index of the owner of the resource that is measured.
    pub(super) const OWNER: usize = 1;

    /// The name of the agent that uses locks.
    pub(super) fn locks(&self, index: usize) -> String {
        format!("{}-l{index}", self.prefix)
    }

    /// The name of the agent that sends letters by hand.
    pub(super) fn by_hand(&self, index: usize) -> String {
        format!("{}-h{index}", self.prefix)
    }
}

/// A kind of socket.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Socket {
    Tcp,
    Unix,
}

/// Behavior of a waiting process.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Wait {
    /// It polls.
    Spin,
    /// It sleeps until it is woken.
    Block,
}

impl From<Wait> for RawWait {
    fn from(wait: Wait) -> Self {
        match wait {
            Wait::Spin => Self::Spin,
            Wait::Block => Self::Block,
        }
    }
}

/// Plays the part of one process in a measurement, until its standard input ends.
///
/// `part` is the JSON text of the option `--part` that a [`Program`](crate::Program) gets, `core` the
/// number of `--core`: the processor that this process is pinned to.
///
/// # Errors
///
/// If `part` is not such a text, the processor is not available, or the part could not be played.
pub fn play(part: &str, core: Option<usize>, config: &Config) -> Result<(), PartError> {
    std::thread::spawn(end_with_orders);
    let pinned = core.map_or(Ok(()), machine::pin_to);
    let part = serde_json::from_str(part).map_err(|error| error.to_string());
    let played = pinned.and(part).and_then(|part| play_part(part, config));
    played.map_err(PartError)
}

/// Ends the process soon after its orders end, also if it waits for a process that has ended.
fn end_with_orders() {
    let stdin = std::io::stdin();
    loop {
        // The end of the writing side is reported without being asked for.
        let mut watched = [PollFd::new(&stdin, PollFlags::empty())];
        match poll(&mut watched, None) {
            Ok(_) | Err(Errno::INTR) => {}
            Err(_) => return,
        }
        if !watched[0].revents().is_empty() {
            std::thread::sleep(GRACE);
            std::process::exit(0);
        }
    }
}

fn play_part(part: Part, config: &Config) -> Result<(), String> {
    match part {
        Part::Agent { name, .. } => agent::Agent::play(config, &[&name], &name),
        Part::Crowd { count } => {
            let names: Vec<String> = (0..count).map(|number| format!("one-{number}")).collect();
            let names: Vec<&str> = names.iter().map(String::as_str).collect();
            agent::Agent::play(config, &names, "one-.*")
        }
        Part::Locks(agents) => locks::play(config, agents),
        Part::Watcher => watcher::play(config),
        Part::Gateway => agent::gateway(config),
        Part::Letters { end } => letters::play(config, end),
        Part::Iceoryx { end, wait } => iceoryx::play(config, end, wait.into()),
        Part::Correspondent { end } => languages::play(config, end),
        Part::Publisher => topics::publish(config),
        Part::Subscriber { index } => topics::subscribe(config, index),
        Part::IceoryxPublisher { subscribers } => iceoryx::publish(config, subscribers),
        Part::IceoryxSubscriber => iceoryx::subscribe(config),
        Part::Socket { end, kind } => socket::play(end, kind),
        Part::Relay { end, wire } => relay::play(config, end, wire),
    }
}
