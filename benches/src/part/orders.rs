//! Orders to and events from the parts of a measurement, one JSON document per line, and the loop that
//! executes orders.
//!
//! The file uses nothing of `fipa`: programs that measure another middleware include it
//! (`benches/comparison/zenoh`).

use std::collections::BTreeMap;
use std::io::Write as _;
use std::time::Duration;

use rustix::time::{ClockId, clock_gettime};
use serde::{Deserialize, Serialize};

/// An end of a path.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum End {
    Sender,
    Receiver,
}

impl std::str::FromStr for End {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match text {
            "sender" => Ok(Self::Sender),
            "receiver" => Ok(Self::Receiver),
            _ => Err("an end is sender or receiver"),
        }
    }
}

/// Origin of the content.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Fill {
    /// The memory is loaned and not written.
    Loaned,
    /// The memory is loaned and written completely, which is part of the time.
    Filled,
    /// The content is in memory of the application.
    Copied,
}

/// A number of letters of one kind.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub(crate) struct Letters {
    pub(crate) count: usize,
    pub(crate) size: usize,
    pub(crate) fill: Fill,
    /// Maximum number of letters without an acknowledgment.
    pub(crate) window: usize,
    /// Pause before each publication of a topic, in microseconds.
    #[serde(default)]
    pub(crate) pause_us: u64,
}

impl Letters {
    pub(crate) fn pause(&self) -> Duration {
        Duration::from_micros(self.pause_us)
    }
}

/// A step of sending to many receivers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Spread {
    /// Memory for all receivers is loaned, written and returned.
    Fill,
    /// It is loaned, written and sent to all.
    Together,
    /// Each receiver is sent a message of its own, with the content copied.
    Copies,
}

/// Origin of the letters of a step of a lock.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum By {
    /// The calls of locks.
    Locks,
    /// The application sends the same letters itself.
    Hand,
    /// The application sends one letter in place of all letters.
    Letter,
}

/// A step of an agent that uses locks.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(tag = "step", rename_all = "snake_case")]
pub(crate) enum LockStep {
    /// Wait until the directory lists the other agents.
    Find,
    /// Begin to own these resources.
    Own { resources: Vec<String> },
    /// Acquire and release a resource, this number of times in a row.
    Cycle {
        by: By,
        resource: String,
        count: usize,
    },
    /// Hold a resource in turn with the agent of this index, each this number of times.
    TakeTurns {
        by: By,
        resource: String,
        other: usize,
        begins: bool,
        count: usize,
    },
    /// Acquire these resources and keep them.
    Hold { resources: Vec<String> },
}

/// An order to a part.
#[derive(Debug, Serialize, Deserialize)]
#[serde(tag = "do", rename_all = "snake_case")]
pub(crate) enum Order {
    /// Find the other end: an agent's name or an address.
    Find { to: String },
    /// Receive letters.
    Receive(Letters),
    /// Send letters.
    Send(Letters),
    /// Send letters to all found receivers, one letter after the other.
    Spread { what: Spread, letters: Letters },
    /// Report the processor time of this process.
    Cpu,
    /// Execute a step of an agent that uses locks.
    Lock(LockStep),
    /// Report the letters since the last such order. Waits before until no more letters of the protocol
    /// `quiet` pass.
    CountLetters { quiet: Option<String> },
}

/// An event of a part. Times are nanoseconds of the clock that all processes share.
#[derive(Debug, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub(crate) enum Event {
    /// The part is ready at this address.
    Ready { address: String },
    /// The part has found the other end.
    Found,
    /// The part is ready to receive.
    Receiving,
    /// Arrival times of the decoded letters.
    Received { at: Vec<u64>, cpu_ns: u64 },
    /// Start and acknowledgment times of the letters.
    Sent {
        began: Vec<u64>,
        ended: Vec<u64>,
        cpu_ns: u64,
    },
    /// Processor time used so far.
    Cpu { ns: u64 },
    /// A step without times is complete.
    Done,
    /// Times at which the agent got a resource, and at which it released it.
    TookTurns {
        acquired: Vec<u64>,
        released: Vec<u64>,
    },
    /// Letters of the agents of this host by protocol, and records of letters that were lost.
    Letters {
        by_protocol: BTreeMap<String, u64>,
        lost: u64,
    },
    /// An order failed.
    Failed { what: String },
}

/// Start and acknowledgment times of letters.
#[derive(Debug, Default)]
pub(crate) struct Sent {
    pub(crate) began: Vec<u64>,
    pub(crate) ended: Vec<u64>,
}

impl Sent {
    pub(crate) fn with_room(letters: &Letters) -> Self {
        Self {
            began: Vec::with_capacity(letters.count),
            ended: Vec::with_capacity(letters.count),
        }
    }
}

/// A part that executes orders.
pub(crate) trait Peer {
    /// Reads the next order; `None` at the end of the orders.
    fn next_order(&mut self) -> Option<String> {
        let mut line = String::new();
        let read = std::io::stdin().read_line(&mut line);
        read.is_ok_and(|bytes| bytes > 0).then_some(line)
    }

    fn find(&mut self, _to: &str) -> Result<(), String> {
        Err("this part does not connect".to_owned())
    }

    fn receive(&mut self, _letters: &Letters) -> Result<Vec<u64>, String> {
        Err("this part does not receive".to_owned())
    }

    fn send(&mut self, _letters: &Letters) -> Result<Sent, String> {
        Err("this process does not send".to_owned())
    }

    fn spread(&mut self, _what: Spread, _letters: &Letters) -> Result<Sent, String> {
        Err("this part sends to one receiver only".to_owned())
    }

    /// Executes a step of an agent that uses locks.
    fn lock(&mut self, _step: LockStep) -> Result<Event, String> {
        Err("this part uses no locks".to_owned())
    }

    fn count_letters(&mut self, _quiet: Option<String>) -> Result<Event, String> {
        Err("this part counts no letters".to_owned())
    }
}

/// Executes orders until they end.
pub(crate) fn execute_orders(peer: &mut impl Peer, address: String) {
    say(&Event::Ready { address });
    while let Some(line) = peer.next_order() {
        let event = follow(peer, &line);
        say(&event.unwrap_or_else(|what| Event::Failed { what }));
    }
}

fn follow(peer: &mut impl Peer, line: &str) -> Result<Event, String> {
    let order: Order = serde_json::from_str(line).map_err(to_text)?;
    let before = cpu_ns();
    Ok(match order {
        Order::Find { to } => {
            peer.find(&to)?;
            Event::Found
        }
        Order::Receive(letters) => {
            say(&Event::Receiving);
            let at = peer.receive(&letters)?;
            let cpu_ns = cpu_ns() - before;
            Event::Received { at, cpu_ns }
        }
        Order::Send(letters) => sent(peer.send(&letters)?, before),
        Order::Spread { what, letters } => sent(peer.spread(what, &letters)?, before),
        Order::Cpu => Event::Cpu { ns: before },
        Order::Lock(step) => peer.lock(step)?,
        Order::CountLetters { quiet } => peer.count_letters(quiet)?,
    })
}

fn sent(sent: Sent, cpu_before: u64) -> Event {
    let Sent { began, ended } = sent;
    Event::Sent {
        began,
        ended,
        cpu_ns: cpu_ns() - cpu_before,
    }
}

pub(crate) fn say(event: &Event) {
    // If the measurement has ended, standard input ends too.
    if let Ok(line) = serde_json::to_string(event) {
        let mut out = std::io::stdout().lock();
        let _ = writeln!(out, "{line}").and_then(|()| out.flush());
    }
}

pub(crate) fn to_text(error: impl std::fmt::Display) -> String {
    error.to_string()
}

/// The monotonic clock of the machine, in nanoseconds.
pub(crate) fn now_ns() -> u64 {
    nanoseconds(ClockId::Monotonic)
}

/// Processor time of all threads of this process, in nanoseconds.
fn cpu_ns() -> u64 {
    nanoseconds(ClockId::ProcessCPUTime)
}

fn nanoseconds(clock: ClockId) -> u64 {
    let time = clock_gettime(clock);
    let whole = u64::try_from(time.tv_sec).unwrap_or(0);
    whole * 1_000_000_000 + u64::try_from(time.tv_nsec).unwrap_or(0)
}

/// The byte that fills the content of the letter with this number.
pub(crate) fn byte_of(number: usize) -> u8 {
    number.to_le_bytes()[0]
}

/// Checks length, first and last byte of received content.
pub(crate) fn check(content: &[u8], letters: &Letters, number: usize) -> Result<(), String> {
    ContentProbe::of(content).check(letters, number)
}

/// Length, first and last byte of content.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ContentProbe {
    len: usize,
    first: Option<u8>,
    last: Option<u8>,
}

impl ContentProbe {
    pub(crate) fn of(content: &[u8]) -> Self {
        Self {
            len: content.len(),
            first: content.first().copied(),
            last: content.last().copied(),
        }
    }

    /// Compares with the content that was sent.
    pub(crate) fn check(self, letters: &Letters, number: usize) -> Result<(), String> {
        let Self { len, first, last } = self;
        let byte = Some(byte_of(number));
        let intact = letters.fill == Fill::Loaned || [first, last] == [byte, byte];
        if len == letters.size && intact {
            return Ok(());
        }
        Err(format!(
            "letter {number} of {} bytes arrived with {len} bytes that begin with {first:?}",
            letters.size
        ))
    }
}
