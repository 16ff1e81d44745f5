//! The log of a process: one line per event of a letter, written immediately.
//!
//! A line is one `write`, so a killed process loses at most the line that it was writing. A letter
//! is logged before it is sent, its outcome as soon as it is known, and a taken letter as soon as
//! `receive` returns it.

use std::fs::{File, OpenOptions};
use std::io::Write as _;
use std::path::Path;

use parking_lot::Mutex;
use rustix::time::{ClockId, clock_gettime};

/// Returns the monotonic time in microseconds. All processes of the machine share this clock.
pub(crate) fn now() -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec as u64 * 1_000_000 + now.tv_nsec as u64 / 1000
}

/// Identifies a letter by the registration of its sender and a number that increases by one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) struct Id {
    pub(crate) sender: u64,
    pub(crate) number: u64,
}

/// An entry of a log.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Event {
    /// The process starts to register this name. Letters for the name may arrive from now on.
    Begins {
        name: String,
    },
    /// The name is registered.
    Registered {
        name: String,
        agent: u64,
    },
    /// The registration has ended, and all its letters were logged.
    Left {
        agent: u64,
    },
    Sends {
        id: Id,
        deadline_ms: u64,
        /// Whether access rules of the gateways forbid the letter.
        forbidden: bool,
        receivers: Vec<String>,
    },
    /// An outcome of a letter. `failure` is the reason of a failure, or `None` if the letter was
    /// delivered.
    Outcome {
        id: Id,
        receiver: String,
        failure: Option<String>,
        how: String,
    },
    Takes {
        agent: u64,
        id: Id,
    },
    /// The agent took a letter whose content differs from the sent content.
    Torn {
        agent: u64,
    },
}

impl Event {
    /// Returns the log line of this event at this time.
    pub(crate) fn to_line(&self, time: u64) -> String {
        let event = match self {
            Self::Begins { name } => format!("B {name}"),
            Self::Registered { name, agent } => format!("R {name} {agent:x}"),
            Self::Left { agent } => format!("L {agent:x}"),
            Self::Sends {
                id,
                deadline_ms,
                forbidden,
                receivers,
            } => {
                let (Id { sender, number }, to) = (id, receivers.join(","));
                let forbidden = u8::from(*forbidden);
                format!("S {sender:x} {number} {deadline_ms} {forbidden} {to}")
            }
            Self::Outcome {
                id,
                receiver,
                failure,
                how,
            } => {
                let Id { sender, number } = id;
                let failure = failure.as_deref().unwrap_or("-");
                format!("O {sender:x} {number} {receiver} {failure} {how}")
            }
            Self::Takes { agent, id } => format!("T {agent:x} {:x} {}", id.sender, id.number),
            Self::Torn { agent } => format!("X {agent:x}"),
        };
        format!("{time} {event}\n")
    }

    fn from_line(line: &str) -> Option<Self> {
        let (kind, rest) = line.split_once(' ')?;
        let words: Vec<&str> = rest.splitn(5, ' ').collect();
        let hex = |text: &str| u64::from_str_radix(text, 16).ok();
        let id = |sender: &str, number: &str| {
            Some(Id {
                sender: hex(sender)?,
                number: number.parse().ok()?,
            })
        };
        Some(match (kind, words.as_slice()) {
            ("B", [name]) => Self::Begins {
                name: (*name).to_owned(),
            },
            ("R", [name, agent]) => Self::Registered {
                name: (*name).to_owned(),
                agent: hex(agent)?,
            },
            ("L", [agent]) => Self::Left { agent: hex(agent)? },
            ("S", [sender, number, deadline, forbidden, to]) => Self::Sends {
                id: id(sender, number)?,
                deadline_ms: deadline.parse().ok()?,
                forbidden: *forbidden == "1",
                receivers: to.split(',').map(str::to_owned).collect(),
            },
            ("O", [sender, number, receiver, failure, how]) => Self::Outcome {
                id: id(sender, number)?,
                receiver: (*receiver).to_owned(),
                failure: (*failure != "-").then(|| (*failure).to_owned()),
                how: (*how).to_owned(),
            },
            ("T", [agent, sender, number]) => Self::Takes {
                agent: hex(agent)?,
                id: id(sender, number)?,
            },
            ("X", [agent]) => Self::Torn { agent: hex(agent)? },
            _ => return None,
        })
    }
}

/// Writer of the log of one process.
pub(crate) struct Journal(Mutex<File>);

impl Journal {
    pub(crate) fn open(path: &Path) -> Self {
        let file = OpenOptions::new().create(true).append(true).open(path);
        Self(Mutex::new(file.unwrap()))
    }

    pub(crate) fn note(&self, event: &Event) {
        let mut file = self.0.lock();
        file.write_all(event.to_line(now()).as_bytes()).unwrap();
    }
}

/// Reads a log. An incomplete last line is ignored.
pub(crate) fn read(path: &Path) -> Vec<(u64, Event)> {
    let text = std::fs::read_to_string(path).unwrap_or_default();
    let whole = text.rfind('\n').map_or("", |end| &text[..end]);
    let events = whole.lines().map(|line| {
        let (time, event) = line.split_once(' ').unwrap();
        let event = Event::from_line(event);
        (
            time.parse().unwrap(),
            event.unwrap_or_else(|| panic!("in {}: {line}", path.display())),
        )
    });
    events.collect()
}
