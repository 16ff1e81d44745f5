//! A process of the soak: agents that send letters to all others and receive, and log both.
//!
//! Lines in: `register NAME`, `leave NAME`, `prove TOKEN` (every agent of the process sends letters
//! to every other until one to each is delivered), `burst` (one agent sends many letters at once), `rest` (no more new letters), `quit`. Lines out:
//! `registered NAME`, `left NAME`, `proved TOKEN`, `idle` (after `rest`, once every letter has its
//! outcomes), `bye`. The process ends when its input ends.

use std::collections::BTreeMap;
use std::io::{BufRead as _, Write as _};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;

use fastrand::Rng;
use fipa::config::Sources;
use fipa::error::RegisterError;
use fipa::{Agent, AgentId, Config, Deliveries, Domain, Incoming, Outcome, Performative};
use parking_lot::Mutex;
use tokio::sync::mpsc::{UnboundedReceiver, unbounded_channel};
use tokio::sync::oneshot;
use tokio::task::{JoinHandle, JoinSet};
use tokio::time::sleep;

use super::journal::{Event, Id, Journal};

/// The environment variable that holds a [`Part`].
pub(crate) const PART: &str = "FIPA_SOAK_PART";

/// Maximum number of letters without an outcome from one sender to one receiver.
const UNDER_WAY: usize = 24;
/// Pause of a sender between two letters, in milliseconds.
const PAUSE: std::ops::Range<u64> = 4..40;
/// Number of letters of a burst.
const BURST: usize = 200;
/// Gateways refuse letters with this performative.
pub(crate) const FORBIDDEN: Performative = Performative::Cancel;

/// The task of a process. Each field is encoded as one or several lines.
#[derive(Debug, Clone)]
pub(crate) struct Part {
    pub(crate) seed: u64,
    pub(crate) log: String,
    /// The agents of all processes.
    pub(crate) names: Vec<String>,
    pub(crate) settings: Vec<String>,
}

impl Part {
    pub(crate) fn to_text(&self) -> String {
        let (names, settings) = (self.names.join(" "), self.settings.join("\n"));
        format!("{}\n{}\n{names}\n{settings}", self.seed, self.log)
    }

    fn from_text(text: &str) -> Self {
        let mut lines = text.lines();
        let mut line = || lines.next().expect("a part of several lines").to_owned();
        Self {
            seed: line().parse().unwrap(),
            log: line(),
            names: line().split(' ').map(str::to_owned).collect(),
            settings: lines.map(str::to_owned).collect(),
        }
    }
}

fn say(line: &str) {
    let mut out = std::io::stdout().lock();
    // If the reader has ended, the input of this process ends, too.
    let _ = writeln!(out, "{line}").and_then(|()| out.flush());
}

/// Runs a part until the command `quit`, or until the process is killed.
pub(crate) fn play(text: &str) {
    let part = Part::from_text(text);
    // Ends a line that the test harness may have started.
    say("");
    let (commands, queue) = unbounded_channel();
    std::thread::spawn(move || {
        for line in std::io::stdin().lock().lines().map_while(Result::ok) {
            if commands.send(line).is_err() {
                return;
            }
        }
        // The test has ended.
        std::process::exit(3);
    });
    let mut builder = tokio::runtime::Builder::new_multi_thread();
    let runtime = builder.worker_threads(1).enable_all().build().unwrap();
    runtime.block_on(perform(part, queue));
    say("bye");
}

/// State that all agents of the process share.
struct Shared {
    domain: Domain,
    journal: Journal,
    names: Vec<String>,
    rests: AtomicBool,
    /// Number of letters with a missing outcome.
    open: AtomicUsize,
}

/// An agent with a `register` command.
struct Presence {
    sender: Arc<Mutex<Option<Arc<Sender>>>>,
    leave: oneshot::Sender<()>,
    task: JoinHandle<()>,
}

async fn perform(part: Part, mut queue: UnboundedReceiver<String>) {
    let config = Config::load(&Sources {
        set: part.settings.clone(),
        ..Sources::default()
    });
    let shared = Arc::new(Shared {
        domain: Domain::open(&config.unwrap()).await.unwrap(),
        journal: Journal::open(Path::new(&part.log)),
        names: part.names.clone(),
        rests: AtomicBool::new(false),
        open: AtomicUsize::new(0),
    });
    let mut random = Rng::with_seed(part.seed);
    let mut present: BTreeMap<String, Presence> = BTreeMap::new();
    while let Some(line) = queue.recv().await {
        match line.split(' ').collect::<Vec<_>>().as_slice() {
            ["register", name] => {
                let (leave, leaves) = oneshot::channel();
                let sender = Arc::default();
                let random = random.fork();
                let agent = agent(
                    shared.clone(),
                    (*name).to_owned(),
                    leaves,
                    random,
                    Arc::clone(&sender),
                );
                let presence = Presence {
                    sender,
                    leave,
                    task: tokio::spawn(agent),
                };
                present.insert((*name).to_owned(), presence);
            }
            ["leave", name] => {
                let presence = present.remove(*name).unwrap();
                let _ = presence.leave.send(());
                presence.task.await.unwrap();
                say(&format!("left {name}"));
            }
            ["prove", token] => {
                let senders = present.values().filter_map(|it| it.sender.lock().clone());
                let proofs: JoinSet<()> = senders.map(Sender::prove).collect();
                let token = (*token).to_owned();
                tokio::spawn(async move {
                    proofs.join_all().await;
                    say(&format!("proved {token}"));
                });
            }
            ["burst"] => {
                let senders = present.values().filter_map(|it| it.sender.lock().clone());
                let senders: Vec<Arc<Sender>> = senders.collect();
                if let Some(sender) = random.choice(&senders)
                    && !shared.rests.load(Ordering::SeqCst)
                {
                    sender.burst(random.choice(&shared.names).unwrap());
                }
            }
            ["rest"] => {
                shared.rests.store(true, Ordering::SeqCst);
                let shared = shared.clone();
                tokio::spawn(async move {
                    while shared.open.load(Ordering::SeqCst) > 0 {
                        sleep(Duration::from_millis(5)).await;
                    }
                    say("idle");
                });
            }
            _ => break,
        }
    }
    for (_, presence) in present {
        let _ = presence.leave.send(());
        presence.task.await.unwrap();
    }
    // Letters under way get their outcomes.
    shared.domain.clone().close().await;
    while shared.open.load(Ordering::SeqCst) > 0 {
        sleep(Duration::from_millis(5)).await;
    }
}

/// Registers as soon as the name is free, then sends and receives until the command `leave`.
async fn agent(
    shared: Arc<Shared>,
    name: String,
    mut leaves: oneshot::Receiver<()>,
    random: Rng,
    published: Arc<Mutex<Option<Arc<Sender>>>>,
) {
    shared.journal.note(&Event::Begins { name: name.clone() });
    let agent = loop {
        match shared.domain.register(&name).await {
            Ok(agent) => break agent,
            Err(RegisterError::AlreadyRegistered { .. }) => {}
            Err(other) => panic!("{name}: {other}"),
        }
        tokio::select! {
            () = sleep(Duration::from_millis(5)) => {}
            _ = &mut leaves => return,
        }
    };
    let incarnation = agent.incarnation().as_u64();
    shared.journal.note(&Event::Registered {
        name: name.clone(),
        agent: incarnation,
    });
    let sender = Arc::new(Sender {
        shared: shared.clone(),
        incarnation,
        agent: Mutex::new(Some(Arc::new(agent))),
        last: Mutex::new(0),
    });
    *published.lock() = Some(Arc::clone(&sender));
    say(&format!("registered {name}"));
    let sending = tokio::spawn(Arc::clone(&sender).send_all(random));
    let agent = sender.agent.lock().clone().unwrap();
    loop {
        tokio::select! {
            incoming = agent.receive() => take(&shared, incarnation, &incoming.unwrap()),
            _ = &mut leaves => break,
        }
    }
    sending.abort();
    let _ = sending.await;
    *published.lock() = None;
    drop(sender.agent.lock().take());
    let agent = Arc::into_inner(agent).expect("nothing else uses the agent");
    for unread in agent.deregister().unwrap() {
        take(&shared, incarnation, &unread);
    }
    shared.journal.note(&Event::Left { agent: incarnation });
}

/// Returns the unique content of this letter.
fn content(id: Id, size: usize) -> Vec<u8> {
    let Id { sender, number } = id;
    let mut content = format!("{sender:x} {number} ").into_bytes();
    let filler = b'a' + (number % 26) as u8;
    content.resize(content.len().max(size), filler);
    content
}

fn id_in(content: &[u8]) -> Option<Id> {
    let mut words = content.splitn(3, |byte| *byte == b' ');
    let mut word = || std::str::from_utf8(words.next()?).ok();
    let id = Id {
        sender: u64::from_str_radix(word()?, 16).ok()?,
        number: word()?.parse().ok()?,
    };
    (content == self::content(id, content.len())).then_some(id)
}

fn take(shared: &Shared, agent: u64, incoming: &Incoming) {
    let message = incoming.message();
    // Gateways report failures in messages.
    if ![Performative::Inform, FORBIDDEN].contains(message.performative()) {
        return;
    }
    let content = message.content().cloned().unwrap_or_default();
    shared.journal.note(&match id_in(&content) {
        Some(id) => Event::Takes { agent, id },
        None => Event::Torn { agent },
    });
}

/// The sending side of an agent.
struct Sender {
    shared: Arc<Shared>,
    incarnation: u64,
    agent: Mutex<Option<Arc<Agent>>>,
    /// The number of the last letter.
    last: Mutex<u64>,
}

/// A letter to be sent.
struct Draft {
    to: Vec<String>,
    size: usize,
    deadline: Duration,
    forbidden: bool,
}

impl Sender {
    async fn send_all(self: Arc<Self>, mut random: Rng) {
        let own = self.agent.lock().as_ref().map(|it| it.name().to_owned());
        let others = self
            .shared
            .names
            .iter()
            .filter(|it| Some(*it) != own.as_ref());
        let others: Vec<_> = others.map(|it| (it, Arc::new(()))).collect();
        loop {
            sleep(Duration::from_millis(random.u64(PAUSE))).await;
            if self.shared.rests.load(Ordering::SeqCst) {
                continue;
            }
            let receivers = if random.u8(..10) == 0 { 2 } else { 1 };
            let to = random.choose_multiple(others.iter(), receivers);
            // Each letter under way holds a reference of its receivers.
            if to
                .iter()
                .any(|(_, open)| Arc::strong_count(open) > UNDER_WAY)
            {
                continue;
            }
            let held: Vec<Arc<()>> = to.iter().map(|(_, open)| open.clone()).collect();
            let outcomes = self.send(draft(
                &mut random,
                to.iter().map(|(name, _)| (*name).clone()),
            ));
            let Some(outcomes) = outcomes else { return };
            tokio::spawn(async move {
                outcomes.await;
                drop(held);
            });
        }
    }

    /// Sends many letters to one agent at once.
    fn burst(&self, to: &str) {
        for _ in 0..BURST {
            let outcomes = self.send(Draft {
                to: vec![to.to_owned()],
                size: 100,
                deadline: Duration::from_secs(5),
                forbidden: false,
            });
            tokio::spawn(async move {
                if let Some(outcomes) = outcomes {
                    outcomes.await;
                }
            });
        }
    }

    /// Sends letters to every other agent until one to each is delivered.
    async fn prove(self: Arc<Self>) {
        let own = self.agent.lock().as_ref().map(|it| it.name().to_owned());
        let names = self.shared.names.clone().into_iter();
        let others = names.filter(|name| Some(name) != own.as_ref());
        let proofs = others.map(|name| {
            let sender = self.clone();
            async move {
                let draft = || Draft {
                    to: vec![name.clone()],
                    size: 40,
                    deadline: Duration::from_secs(20),
                    forbidden: false,
                };
                while let Some(outcomes) = sender.send(draft())
                    && !outcomes.await.all_succeeded()
                {
                    sleep(Duration::from_millis(20)).await;
                }
            }
        });
        proofs.collect::<JoinSet<()>>().join_all().await;
    }

    /// Sends a letter in the order of its number. The returned future logs the outcomes.
    fn send(&self, draft: Draft) -> Option<impl Future<Output = Deliveries> + Send + use<>> {
        let agent = self.agent.lock().clone()?;
        let mut last = self.last.lock();
        *last += 1;
        let id = Id {
            sender: self.incarnation,
            number: *last,
        };
        let shared = self.shared.clone();
        let kind = if draft.forbidden {
            FORBIDDEN
        } else {
            Performative::Inform
        };
        let mut message = agent.message(kind).content(content(id, draft.size));
        for name in &draft.to {
            message = message.receiver(AgentId::new(name).unwrap());
        }
        shared.open.fetch_add(1, Ordering::SeqCst);
        shared.journal.note(&Event::Sends {
            id,
            deadline_ms: draft.deadline.as_millis() as u64,
            forbidden: draft.forbidden,
            receivers: draft.to,
        });
        let outcomes = agent.send_within(message.build().unwrap(), draft.deadline);
        drop(last);
        Some(async move {
            let deliveries = outcomes.await.unwrap();
            for delivery in &deliveries.0 {
                let failure = match &delivery.outcome {
                    Outcome::Failed { reason, .. } => Some(format!("{reason:?}")),
                    _ => None,
                };
                shared.journal.note(&Event::Outcome {
                    id,
                    receiver: delivery.receiver.to_string(),
                    failure,
                    how: delivery.outcome.to_string().replace('\n', "; "),
                });
            }
            shared.open.fetch_sub(1, Ordering::SeqCst);
            deliveries
        })
    }
}

fn draft(random: &mut Rng, to: impl Iterator<Item = String>) -> Draft {
    let size = match random.u16(..1000) {
        0..3 => 1_000_000,
        3..15 => 200_000,
        15..100 => 5000,
        _ => 40,
    };
    // Log-uniform from 10 ms to 60 s.
    let deadline = 10.0 * 6000_f64.powf(random.f64());
    Draft {
        to: to.collect(),
        size,
        deadline: Duration::from_millis(deadline as u64),
        forbidden: random.u8(..50) == 0,
    }
}
