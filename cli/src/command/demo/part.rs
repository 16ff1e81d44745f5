//! A part in the demo: one process with one agent or one gateway, which does what it is told on
//! standard input and says on standard output what it saw. One JSON document per line each way.
//!
//! What a step of the demo claims is checked here, in the process that received something.
//! A part ends when its standard input does, so that none outlives the demo.

use std::io::Write;
use std::time::{Duration, Instant};

use fipa::watch::{WatchOptions, Watcher};
use fipa::{Agent, AgentId, Config, Deliveries, Domain, Gateway, Incoming, Performative, Reach};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use tokio::io::{AsyncBufReadExt, BufReader, Lines, Stdin};

use crate::command::watch::judge::{Judge, Judged};
use crate::output;

/// The protocol of messages whose only purpose is the time they take.
const MEASURING: &str = "demo-measure";

/// What a part is told to do.
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
    /// Send content of this length, made in loaned memory, and its checksum with it.
    SendLarge { to: String, len: usize },
    /// Say who is there.
    Agents,
    /// Say how many messages were received so far.
    Count,
    /// Send this many messages, each after the one before was confirmed, and say how long it
    /// took.
    Measure {
        to: String,
        len: usize,
        rounds: usize,
    },
}

/// What a part saw.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub(super) enum Event {
    /// It is there.
    Ready { locations: Vec<String> },
    /// A message came.
    Received(Received),
    /// What became of a message it sent.
    Outcomes { deliveries: Value },
    /// Who is there.
    Agents { agents: Vec<Listed> },
    /// How many messages came.
    Count { received: u64 },
    /// How long a confirmed message takes, in microseconds.
    Measured { p50_us: f64, p99_us: f64 },
    /// A letter was seen to break its protocol.
    Caught {
        sender: String,
        performative: String,
        /// What was wrong, and what was expected of whom.
        text: String,
        /// How many letters were seen before that kept to theirs.
        kept: u64,
    },
    /// It could not do what it was told.
    Failed { what: String },
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
    /// The content when it is short text.
    pub(super) content: Option<String>,
    pub(super) len: usize,
    /// Whether the content lies in memory that belongs to the domain's shared memory.
    pub(super) in_shared_memory: bool,
    /// Whether its checksum is the one that was sent with it.
    pub(super) intact: Option<bool>,
}

/// An agent as the directory lists it.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Listed {
    pub(super) name: String,
    pub(super) local: bool,
    pub(super) locations: Vec<String>,
}

/// Runs the gateway of the configured domain until standard input ends.
pub(super) async fn gateway(config: &Config) -> Result<(), String> {
    let gateway = Gateway::open(config)
        .await
        .map_err(|error| error.to_string())?;
    let locations = gateway
        .locations()
        .iter()
        .map(ToString::to_string)
        .collect();
    say(&Event::Ready { locations });
    let mut orders = orders();
    while next(&mut orders).await.is_some() {}
    gateway.close().await;
    Ok(())
}

/// Watches the domain until standard input ends, and says which letters break their protocols.
pub(super) async fn watcher(config: &Config) -> Result<(), String> {
    let watcher = Watcher::open(config, WatchOptions::default()).await;
    let mut watcher = watcher.map_err(|error| error.to_string())?;
    let mut judge = Judge::new(None).map_err(|_| "the protocols cannot be read")?;
    say(&Event::Ready {
        locations: Vec::new(),
    });
    let mut orders = orders();
    let mut kept = 0;
    loop {
        let seen = tokio::select! {
            line = next(&mut orders) => match line {
                Some(_) => continue,
                None => return Ok(()),
            },
            seen = watcher.next() => seen,
        };
        let fipa::watch::Event::Letter(passage) = seen else {
            continue;
        };
        match judge.judge(&passage) {
            Judged::Accepted { .. } => kept += 1,
            Judged::Violation(violation) => say(&Event::Caught {
                sender: violation.sender.clone(),
                performative: violation.performative.clone(),
                text: violation.to_string(),
                kept,
            }),
            _ => {}
        }
    }
}

/// Runs an agent until standard input ends.
pub(super) async fn agent(config: &Config, name: &str) -> Result<(), String> {
    let domain = Domain::open(config)
        .await
        .map_err(|error| error.to_string())?;
    let agent = domain.register(name).map_err(|error| error.to_string())?;
    let entry = domain.directory().lookup(name);
    let locations = entry.map(|entry| entry.locations.iter().map(ToString::to_string).collect());
    say(&Event::Ready {
        locations: locations.unwrap_or_default(),
    });
    let mut orders = orders();
    let mut received = 0;
    loop {
        tokio::select! {
            line = next(&mut orders) => match line {
                Some(line) => {
                    let done = obey(&agent, &line, received).await;
                    say(&done.unwrap_or_else(|what| Event::Failed { what }));
                }
                None => break,
            },
            incoming = agent.receive() => match incoming {
                Ok(incoming) => {
                    received += 1;
                    // Nobody wants to hear of those that only count.
                    if incoming.message.protocol() != Some(MEASURING) {
                        say(&Event::Received(seen(&incoming)));
                    }
                    if let Err(what) = answer(&agent, &incoming).await {
                        say(&Event::Failed { what });
                    }
                }
                Err(error) => return Err(error.to_string()),
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

fn say(event: &Event) {
    // Who listens may be gone; then standard input ends too.
    if let Ok(line) = serde_json::to_string(event) {
        let mut out = std::io::stdout().lock();
        let _ = writeln!(out, "{line}").and_then(|()| out.flush());
    }
}

async fn obey(agent: &Agent, line: &str, received: u64) -> Result<Event, String> {
    let order: Order = serde_json::from_str(line).map_err(|error| error.to_string())?;
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
            let message = message.build().map_err(|error| error.to_string())?;
            outcomes(
                &agent
                    .send(message)
                    .await
                    .map_err(|error| error.to_string())?,
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
            let message = message.build().map_err(|error| error.to_string())?;
            let deliveries = agent.send(message).await;
            outcomes(&deliveries.map_err(|error| error.to_string())?)
        }
        Order::SendLarge { to, len } => send_large(agent, &to, len).await,
        Order::Agents => Ok(Event::Agents {
            agents: agents(agent),
        }),
        Order::Count => Ok(Event::Count { received }),
        Order::Measure { to, len, rounds } => measure(agent, &to, len, rounds).await,
    }
}

fn id(name: &str) -> Result<AgentId, String> {
    AgentId::new(name).map_err(|error| error.to_string())
}

fn outcomes(deliveries: &Deliveries) -> Result<Event, String> {
    Ok(Event::Outcomes {
        deliveries: output::deliveries(deliveries),
    })
}

async fn send_large(agent: &Agent, to: &str, len: usize) -> Result<Event, String> {
    let expected = checksum_of(pattern(len));
    let message = agent
        .message(Performative::Inform)
        .receiver(id(to)?)
        .user_defined("checksum", format!("{expected:016x}"))
        .build()
        .map_err(|error| error.to_string())?;
    let mut loan = agent
        .loan(message, len)
        .map_err(|error| error.to_string())?;
    for (byte, value) in loan.content_mut().iter_mut().zip(pattern(len)) {
        *byte = value;
    }
    outcomes(
        &agent
            .send_loan(loan)
            .await
            .map_err(|error| error.to_string())?,
    )
}

/// Bytes that do not repeat in step with any buffer.
fn pattern(len: usize) -> impl Iterator<Item = u8> {
    (0..len).map(|index| (index.wrapping_mul(0x9e37_79b1) >> 13) as u8)
}

/// The 64-bit FNV-1a hash.
fn checksum_of(bytes: impl Iterator<Item = u8>) -> u64 {
    let step = |hash: u64, byte: u8| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
    bytes.fold(0xcbf2_9ce4_8422_2325, step)
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
            .map_err(|error| error.to_string())?;
        let started = Instant::now();
        let deliveries = agent
            .send(message)
            .await
            .map_err(|error| error.to_string())?;
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

fn seen(incoming: &Incoming) -> Received {
    let message = &incoming.message;
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
        in_shared_memory: lies_in_shared_memory(&content),
        intact: sent
            .map(|(_, sent)| *sent == format!("{:016x}", checksum_of(content.iter().copied()))),
    }
}

/// Whether the kernel says that these bytes are a mapping of the domain's shared memory.
fn lies_in_shared_memory(bytes: &[u8]) -> bool {
    let address = bytes.as_ptr() as usize;
    let maps = std::fs::read_to_string("/proc/self/maps").unwrap_or_default();
    maps.lines()
        .filter(|line| line.contains("/dev/shm/fipa_"))
        .any(|line| {
            let range = line
                .split(' ')
                .next()
                .and_then(|range| range.split_once('-'));
            range.is_some_and(|(from, to)| {
                let number = |text| usize::from_str_radix(text, 16).unwrap_or(0);
                (number(from)..number(to)).contains(&address)
            })
        })
}

/// The participant's side of fipa-request (FIPA00026): agree, then inform of the result.
async fn answer(agent: &Agent, incoming: &Incoming) -> Result<(), String> {
    let message = &incoming.message;
    let asked = *message.performative() == Performative::Request
        && message.protocol() == Some("fipa-request");
    if !asked {
        return Ok(());
    }
    for (performative, content) in [
        (Performative::Agree, "agreed"),
        (Performative::Inform, "done"),
    ] {
        let reply = agent.reply(message, performative).content(content);
        let reply = reply.build().map_err(|error| error.to_string())?;
        let deliveries = agent.send(reply).await.map_err(|error| error.to_string())?;
        if !deliveries.all_succeeded() {
            return Err(deliveries.to_string());
        }
    }
    Ok(())
}
