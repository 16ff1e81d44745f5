//! A process of the demo with one agent, gateway or watcher. It reads orders from standard input and
//! writes events to standard output, one JSON document per line.
//!
//! The receiving process reports what it received, which the steps of the demo check. The process
//! ends at the end of its standard input, so that it cannot outlive the demo.

use std::io::Write;
use std::time::{Duration, Instant};

use fipa::admin::watch::{WatchOptions, Watcher};
use fipa::error::ErrorChain;
use fipa::locks::{Fence, Lock, OwnOptions, Owned, with_fences};
use fipa::monitor::Library;
use fipa::{
    Agent, AgentId, Config, Deliveries, Domain, Gateway, Incoming, Performative, Reach, fnv1a,
    is_in_place,
};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use tokio::io::{AsyncBufReadExt, BufReader, Lines, Stdin};

use crate::command::watch::checker::{CheckResult, Checker, Earlier, Letter};

/// The protocol of messages that are sent only to measure their time.
const MEASURING: &str = "demo-measure";

/// The protocol of commands to the owner of a resource.
const COMMAND: &str = "demo-command";

/// Lease of the locks of the demo. The owner has no state file, so it waits for one lease.
const LEASE: Duration = Duration::from_secs(2);

/// An order to a process.
#[derive(Debug, Serialize, Deserialize)]
#[serde(tag = "do", rename_all = "snake_case")]
pub(super) enum Order {
    /// Send a small message.
    Send {
        performative: String,
        to: String,
        content: String,
        protocol: Option<String>,
    },
    /// Send a message of a conversation that follows fipa-contract-net.
    Converse {
        performative: String,
        to: String,
        conversation: String,
    },
    /// Send content of this length, in bytes, written into loaned memory, with its checksum.
    SendLarge { to: String, len: usize },
    /// List the agents of the directory.
    Agents,
    /// Own a resource.
    Own { resource: String },
    /// Lock a resource, and keep the lock to the end of the process.
    Lock { resource: String },
    /// Send a command with a fence.
    Command { to: String, fence: String },
    /// Report the number of messages received so far.
    Count,
    /// Send `rounds` messages of `len` bytes, each after the confirmation of the previous one, and
    /// report the times.
    Measure {
        to: String,
        len: usize,
        rounds: usize,
    },
}

/// An event from a process.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub(super) enum Event {
    /// The process is ready.
    Ready { locations: Vec<String> },
    /// A message was received.
    Received(Received),
    /// The outcomes of a message that it sent.
    Outcomes { deliveries: Value },
    /// The agents of the directory.
    Agents { agents: Vec<Listed> },
    /// The agent owns the resource.
    Owned,
    /// The agent holds the resource.
    Locked { fence: String },
    /// The number of received messages.
    Count { received: u64 },
    /// Time from sending to confirmation, in microseconds.
    Measured { p50_us: f64, p99_us: f64 },
    /// The watcher saw a letter that violates its protocol.
    Violation {
        sender: String,
        performative: String,
        /// The violation, with the expected messages and senders.
        text: String,
        /// Number of letters before it that followed their protocols.
        accepted: u64,
    },
    /// The order failed.
    Failed { error: String },
}

/// A message as its receiver saw it.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Received {
    pub(super) performative: String,
    pub(super) sender: String,
    pub(super) protocol: Option<String>,
    pub(super) conversation_id: Option<String>,
    pub(super) in_reply_to: Option<String>,
    pub(super) via: Option<String>,
    /// The content if it is text of at most 1024 bytes.
    pub(super) content: Option<String>,
    pub(super) len: usize,
    /// Whether the content is read in shared memory of its sender.
    pub(super) in_place: bool,
    /// Whether the content has the checksum that was sent with it; none without a checksum.
    pub(super) intact: Option<bool>,
}

/// An agent as the directory lists it.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Listed {
    pub(super) name: String,
    pub(super) local: bool,
    pub(super) locations: Vec<String>,
}

/// An event, or a part of one, as JSON text for an error message.
pub(super) fn shown(value: &impl Serialize) -> String {
    // Events have text keys only, so this cannot fail.
    serde_json::to_string(value).unwrap_or_default()
}

/// Runs the gateway of the configured domain until standard input ends.
pub(super) async fn gateway(config: &Config) -> Result<(), String> {
    let gateway = Gateway::open(config)
        .await
        .map_err(|error| ErrorChain(&error).to_string())?;
    let locations = gateway
        .locations()
        .iter()
        .map(ToString::to_string)
        .collect();
    emit(&Event::Ready { locations });
    let mut orders = orders();
    while next(&mut orders).await.is_some() {}
    gateway.close().await;
    Ok(())
}

/// Watches the domain until standard input ends, and reports letters that violate their protocols.
pub(super) async fn watcher(config: &Config) -> Result<(), String> {
    let watcher = Watcher::open(config, WatchOptions::default()).await;
    let mut watcher = watcher.map_err(|error| ErrorChain(&error).to_string())?;
    let mut checker = Checker::new(Library::standard());
    let mut earlier = Earlier::default();
    earlier.add(watcher.directory());
    emit(&Event::Ready {
        locations: Vec::new(),
    });
    let mut orders = orders();
    let mut accepted = 0;
    loop {
        let seen = tokio::select! {
            line = next(&mut orders) => match line {
                Some(_) => continue,
                None => return Ok(()),
            },
            seen = watcher.next() => seen,
        };
        let fipa::admin::watch::Event::Letter(passage) = seen else {
            continue;
        };
        match checker.check(Letter::of(&passage, &earlier)) {
            CheckResult::Accepted { .. } => accepted += 1,
            CheckResult::Violation(violation) => emit(&Event::Violation {
                sender: violation.sender.clone(),
                performative: violation.performative.clone(),
                text: violation.to_string(),
                accepted,
            }),
            _ => {}
        }
    }
}

/// Runs an agent until standard input ends.
pub(super) async fn agent(config: &Config, name: &str) -> Result<(), String> {
    let domain = Domain::open(config)
        .await
        .map_err(|error| ErrorChain(&error).to_string())?;
    let agent = domain
        .register(name)
        .await
        .map_err(|error| ErrorChain(&error).to_string())?;
    let entry = domain.directory().lookup(name);
    let locations = entry.map(|entry| entry.locations.iter().map(ToString::to_string).collect());
    emit(&Event::Ready {
        locations: locations.unwrap_or_default(),
    });
    let mut orders = orders();
    let mut received = 0;
    let mut held = Held::default();
    loop {
        tokio::select! {
            line = next(&mut orders) => match line {
                Some(line) => {
                    let done = execute(&agent, &line, received, &mut held).await;
                    emit(&done.unwrap_or_else(|error| Event::Failed { error }));
                }
                None => break,
            },
            incoming = agent.receive() => match incoming {
                Ok(incoming) => {
                    received += 1;
                    // Messages of a measurement are counted, but not reported.
                    if incoming.message().protocol() != Some(MEASURING) {
                        emit(&Event::Received(received_message(&incoming)));
                    }
                    if let Err(error) = answer(&agent, &incoming, &held).await {
                        emit(&Event::Failed { error });
                    }
                }
                Err(error) => return Err(ErrorChain(&error).to_string()),
            },
        }
    }
    drop(agent);
    domain.close().await;
    Ok(())
}

fn orders() -> Lines<BufReader<Stdin>> {
    BufReader::new(tokio::io::stdin()).lines()
}

async fn next(orders: &mut Lines<BufReader<Stdin>>) -> Option<String> {
    orders.next_line().await.ok().flatten()
}

fn emit(event: &Event) {
    // The demo may have ended; then standard input ends too.
    if let Ok(line) = serde_json::to_string(event) {
        let mut out = std::io::stdout().lock();
        let _ = writeln!(out, "{line}").and_then(|()| out.flush());
    }
}

/// The resources that the agent owns and holds.
#[derive(Default)]
struct Held {
    owned: Option<Owned>,
    lock: Option<Lock>,
}

async fn execute(
    agent: &Agent,
    line: &str,
    received: u64,
    held: &mut Held,
) -> Result<Event, String> {
    let order: Order =
        serde_json::from_str(line).map_err(|error| ErrorChain(&error).to_string())?;
    match order {
        Order::Send {
            performative,
            to,
            content,
            protocol,
        } => {
            let performative: Performative =
                performative.parse().map_err(|error| format!("{error}"))?;
            let mut message = agent
                .message(performative)
                .receiver(id(&to)?)
                .content(content)
                .conversation_id(format!("{}-to-{to}", agent.name()))
                .reply_with("question-1");
            if let Some(protocol) = protocol {
                message = message.protocol(protocol);
            }
            let message = message
                .build()
                .map_err(|error| ErrorChain(&error).to_string())?;
            outcomes(
                &agent
                    .send(message)
                    .await
                    .map_err(|error| ErrorChain(&error).to_string())?,
            )
        }
        Order::Converse {
            performative,
            to,
            conversation,
        } => {
            let performative: Performative =
                performative.parse().map_err(|error| format!("{error}"))?;
            let message = agent
                .message(performative)
                .receiver(id(&to)?)
                .protocol("fipa-contract-net")
                .conversation_id(conversation);
            let message = message
                .build()
                .map_err(|error| ErrorChain(&error).to_string())?;
            let deliveries = agent.send(message).await;
            outcomes(&deliveries.map_err(|error| ErrorChain(&error).to_string())?)
        }
        Order::SendLarge { to, len } => send_large(agent, &to, len).await,
        Order::Agents => Ok(Event::Agents {
            agents: agents(agent),
        }),
        Order::Own { resource } => {
            let options = OwnOptions {
                lease: LEASE,
                // No file is left behind.
                volatile: true,
                forget: true,
                ..OwnOptions::default()
            };
            let owned = agent.own(&resource, options).await;
            held.owned = Some(owned.map_err(|error| ErrorChain(&error).to_string())?);
            Ok(Event::Owned)
        }
        Order::Lock { resource } => {
            let lock = agent.lock(&resource).await;
            let lock = lock.map_err(|error| ErrorChain(&error).to_string())?;
            let fence = lock.fence().ok_or("a lock without a fence")?.to_string();
            held.lock = Some(lock);
            Ok(Event::Locked { fence })
        }
        Order::Command { to, fence } => {
            let fence: Fence = fence
                .parse()
                .map_err(|error| ErrorChain(&error).to_string())?;
            let command = agent
                .message(Performative::Request)
                .receiver(id(&to)?)
                .protocol(COMMAND)
                .conversation_id(agent.unique_id());
            let command = with_fences(command, [&fence])
                .build()
                .map_err(|error| ErrorChain(&error).to_string())?;
            let deliveries = agent.send(command).await;
            outcomes(&deliveries.map_err(|error| ErrorChain(&error).to_string())?)
        }
        Order::Count => Ok(Event::Count { received }),
        Order::Measure { to, len, rounds } => measure(agent, &to, len, rounds).await,
    }
}

fn id(name: &str) -> Result<AgentId, String> {
    AgentId::new(name).map_err(|error| ErrorChain(&error).to_string())
}

fn outcomes(deliveries: &Deliveries) -> Result<Event, String> {
    Ok(Event::Outcomes {
        deliveries: serde_json::to_value(deliveries).unwrap_or_default(),
    })
}

async fn send_large(agent: &Agent, to: &str, len: usize) -> Result<Event, String> {
    let expected = fnv1a(pattern(len));
    let message = agent
        .message(Performative::Inform)
        .receiver(id(to)?)
        .user_defined("checksum", format!("{expected:016x}"))
        .build()
        .map_err(|error| ErrorChain(&error).to_string())?;
    let mut loan = agent
        .loan(message, len)
        .map_err(|error| ErrorChain(&error).to_string())?;
    for (byte, value) in loan.content_mut().iter_mut().zip(pattern(len)) {
        *byte = value;
    }
    outcomes(
        &agent
            .send_loan(loan)
            .await
            .map_err(|error| ErrorChain(&error).to_string())?,
    )
}

/// A byte pattern whose period matches no buffer size.
fn pattern(len: usize) -> impl Iterator<Item = u8> {
    (0..len).map(|index| (index.wrapping_mul(0x9e37_79b1) >> 13) as u8)
}

fn agents(agent: &Agent) -> Vec<Listed> {
    let directory = agent.domain().directory();
    directory.refresh();
    let listed = directory.entries();
    let listed = listed.iter().map(|entry| Listed {
        name: entry.name.to_string(),
        local: entry.reach == Reach::Local,
        locations: entry.locations.iter().map(ToString::to_string).collect(),
    });
    listed.collect()
}

async fn measure(agent: &Agent, to: &str, len: usize, rounds: usize) -> Result<Event, String> {
    let mut times = Vec::with_capacity(rounds);
    for _ in 0..rounds {
        let message = agent
            .message(Performative::Inform)
            .receiver(id(to)?)
            .content(vec![0; len])
            .protocol(MEASURING)
            .conversation_id("measure")
            .build()
            .map_err(|error| ErrorChain(&error).to_string())?;
        let started = Instant::now();
        let deliveries = agent
            .send(message)
            .await
            .map_err(|error| ErrorChain(&error).to_string())?;
        times.push(started.elapsed());
        if !deliveries.all_succeeded() {
            return Err(deliveries.to_string());
        }
    }
    times.sort_unstable();
    let at = |share: f64| {
        let index = (times.len() as f64 * share) as usize;
        let time = times.get(index.min(times.len().saturating_sub(1))).copied();
        time.unwrap_or(Duration::ZERO).as_secs_f64() * 1e6
    };
    Ok(Event::Measured {
        p50_us: at(0.5),
        p99_us: at(0.99),
    })
}

fn received_message(incoming: &Incoming) -> Received {
    let message = incoming.message();
    let content = message.content().cloned().unwrap_or_default();
    let sent = message
        .user_defined()
        .iter()
        .find(|(name, _)| name == "checksum");
    let text = || std::str::from_utf8(&content).ok().map(str::to_owned);
    Received {
        performative: message.performative().to_string(),
        sender: message
            .sender()
            .map(|id| id.name().to_owned())
            .unwrap_or_default(),
        protocol: message.protocol().map(str::to_owned),
        conversation_id: message.conversation_id().map(str::to_owned),
        in_reply_to: message.in_reply_to().map(str::to_owned),
        via: incoming.via.map(|kind| kind.to_string()),
        content: (content.len() <= 1024).then(text).flatten(),
        len: content.len(),
        in_place: is_in_place(&content),
        intact: sent.map(|(_, sent)| *sent == format!("{:016x}", fnv1a(content.iter().copied()))),
    }
}

/// The participant's side of fipa-request (FIPA00026): agree, then inform of the result.
async fn answer(agent: &Agent, incoming: &Incoming, held: &Held) -> Result<(), String> {
    let message = incoming.message();
    if let Some(owned) = &held.owned
        && message.protocol() == Some(COMMAND)
    {
        let (act, content) = match owned.check(message) {
            Ok(fence) => (Performative::Agree, fence.to_string()),
            Err(error) => (Performative::Refuse, ErrorChain(&error).to_string()),
        };
        let reply = agent.reply(message, act).content(content).build();
        let reply = reply.map_err(|error| ErrorChain(&error).to_string())?;
        let sent = agent.send(reply).await;
        return sent
            .map(drop)
            .map_err(|error| ErrorChain(&error).to_string());
    }
    let is_request = *message.performative() == Performative::Request
        && message.protocol() == Some("fipa-request");
    if !is_request {
        return Ok(());
    }
    for (performative, content) in [
        (Performative::Agree, "agreed"),
        (Performative::Inform, "done"),
    ] {
        let reply = agent.reply(message, performative).content(content);
        let reply = reply
            .build()
            .map_err(|error| ErrorChain(&error).to_string())?;
        let deliveries = agent
            .send(reply)
            .await
            .map_err(|error| ErrorChain(&error).to_string())?;
        if !deliveries.all_succeeded() {
            return Err(deliveries.to_string());
        }
    }
    Ok(())
}
