//! What the ends of a measurement are told and what they say, one JSON document per line each way,
//! and the loop in which they obey.
//!
//! Nothing of `fipa` is used here: a program with an end of its own to be measured beside ours is
//! built with this file too (`comparison/zenoh`).

use std::io::Write as _;

use clap::ValueEnum;
use rustix::time::{ClockId, clock_gettime};
use serde::{Deserialize, Serialize};

/// Which end of a way.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum End {
    Sender,
    Receiver,
}

/// Where content comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Fill {
    /// The memory is loaned and not written.
    Loaned,
    /// The memory is loaned and all of it written, which counts.
    Filled,
    /// It lies in memory of the application.
    Copied,
}

/// Letters of one sort.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub(crate) struct Letters {
    pub(crate) count: usize,
    pub(crate) size: usize,
    pub(crate) fill: Fill,
    /// How many may be without an answer.
    pub(crate) window: usize,
}

/// What of a multicast is done.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Spread {
    /// Memory for all receivers is loaned, written and given back.
    Fill,
    /// It is loaned, written and sent to all.
    Together,
    /// Each receiver is sent a message of its own, with the content copied.
    Copies,
}

/// What a part is told to do.
#[derive(Debug, Serialize, Deserialize)]
#[serde(tag = "do", rename_all = "snake_case")]
pub(crate) enum Order {
    /// Find the other end: an agent's name or an address.
    Find { to: String },
    /// Receive letters.
    Receive(Letters),
    /// Send letters.
    Send(Letters),
    /// Send letters to all that were found, one after the other.
    Spread { what: Spread, letters: Letters },
    /// Say how much processor time this process has used.
    Cpu,
}

/// What a part saw. Times are in nanoseconds, of the clock that all processes share.
#[derive(Debug, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub(crate) enum Event {
    /// It is there, and can be found under this address.
    Ready { address: String },
    /// It has found the other end.
    Found,
    /// It is about to receive.
    Receiving,
    /// When each letter was there, decoded.
    Received { at: Vec<u64>, cpu_ns: u64 },
    /// When each letter was begun, and when its sender knew that it had arrived.
    Sent {
        began: Vec<u64>,
        ended: Vec<u64>,
        cpu_ns: u64,
    },
    /// Processor time used so far.
    Cpu { ns: u64 },
    /// It could not do what it was told.
    Failed { what: String },
}

/// When letters were begun, and when their senders knew that they had arrived.
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

/// One sort of process.
pub(crate) trait Peer {
    /// The next order; none when there will be none.
    fn next_order(&mut self) -> Option<String> {
        let mut line = String::new();
        let read = std::io::stdin().read_line(&mut line);
        read.is_ok_and(|bytes| bytes > 0).then_some(line)
    }

    fn find(&mut self, _to: &str) -> Result<(), String> {
        Err("this process finds no receivers".to_owned())
    }

    fn receive(&mut self, _letters: &Letters) -> Result<Vec<u64>, String> {
        Err("this process does not receive".to_owned())
    }

    fn send(&mut self, _letters: &Letters) -> Result<Sent, String> {
        Err("this process does not send".to_owned())
    }

    fn spread(&mut self, _what: Spread, _letters: &Letters) -> Result<Sent, String> {
        Err("this process sends to one receiver only".to_owned())
    }
}

/// Obeys until there are no more orders.
pub(crate) fn obey(peer: &mut impl Peer, address: String) {
    say(&Event::Ready { address });
    while let Some(line) = peer.next_order() {
        let event = follow(peer, &line);
        say(&event.unwrap_or_else(|what| Event::Failed { what }));
    }
}

fn follow(peer: &mut impl Peer, line: &str) -> Result<Event, String> {
    let order: Order = serde_json::from_str(line).map_err(told)?;
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
    // Who listens may be gone; then standard input ends too.
    if let Ok(line) = serde_json::to_string(event) {
        let mut out = std::io::stdout().lock();
        let _ = writeln!(out, "{line}").and_then(|()| out.flush());
    }
}

pub(crate) fn told(error: impl std::fmt::Display) -> String {
    error.to_string()
}

/// The time that all processes of this machine share.
pub(crate) fn now_ns() -> u64 {
    nanoseconds(ClockId::Monotonic)
}

/// The processor time of this process, all its threads together.
fn cpu_ns() -> u64 {
    nanoseconds(ClockId::ProcessCPUTime)
}

fn nanoseconds(clock: ClockId) -> u64 {
    let time = clock_gettime(clock);
    let whole = u64::try_from(time.tv_sec).unwrap_or(0);
    whole * 1_000_000_000 + u64::try_from(time.tv_nsec).unwrap_or(0)
}

/// What the content of the letter with this number consists of.
pub(crate) fn byte_of(number: usize) -> u8 {
    number.to_le_bytes()[0]
}

/// Whether content is what was sent, as far as that can be seen without reading all of it.
pub(crate) fn check(content: &[u8], letters: &Letters, number: usize) -> Result<(), String> {
    Glimpse::of(content).check(letters, number)
}

/// What can be seen of content without reading all of it, or keeping it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Glimpse {
    len: usize,
    first: Option<u8>,
    last: Option<u8>,
}

impl Glimpse {
    pub(crate) fn of(content: &[u8]) -> Self {
        Self {
            len: content.len(),
            first: content.first().copied(),
            last: content.last().copied(),
        }
    }

    /// Whether that is what was sent.
    pub(crate) fn check(self, letters: &Letters, number: usize) -> Result<(), String> {
        let Self { len, first, last } = self;
        let byte = Some(byte_of(number));
        let intact = letters.fill == Fill::Loaned || [first, last] == [byte, byte];
        if len == letters.size && intact {
            return Ok(());
        }
        Err(format!(
            "letter {number} of {} bytes came as {len} bytes of {first:?}",
            letters.size
        ))
    }
}
