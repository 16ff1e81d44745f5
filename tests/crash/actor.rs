//! A process of the play: one agent that receives and sends as it is told, and writes a line for
//! everything that happens to it.
//!
//! Lines out: `ready`; `at ADDRESS` of a gateway; `sent ID TO` before a letter is sent, `out ID OUTCOME` when its outcome is
//! known; `took ID` when a letter was received whole, `torn ID` when its content is not what was
//! sent; `loaned` when memory is on loan; `done TOKEN` after a command; `bye`.
//! A letter to several has as many IDs, in the order of its receivers; its content has the first.
//! Lines in: `send TOKEN TO COUNT SIZE`, `drop`, `quit`. Ends when its input ends.

use std::io::{BufRead, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use fipa::config::Sources;
use fipa::{
    Agent, AgentId, Config, Delivery, Domain, Gateway, Incoming, Kind, Message, MessageBuilder,
    Outcome, Performative,
};
use tokio::sync::mpsc::{Receiver, channel};
use tokio::task::JoinSet;

/// What an actor does, as it stands in its environment.
pub(crate) const PART: &str = "FIPA_CRASH_PART";

/// How many letters a streaming actor has under way.
const UNDER_WAY: usize = 6;

/// How many letters a holding actor keeps.
const HELD: usize = 40;

/// The sizes of contents: copied, in place, and several pages.
pub(crate) const SIZES: [usize; 4] = [40, 1500, 5000, LARGE];

/// The size of a content that lies in memory once for several receivers.
pub(crate) const LARGE: usize = 70_000;

/// An actor's part. All words, so that it can be written into the environment.
#[derive(Debug, Clone)]
pub(crate) struct Part {
    pub(crate) name: String,
    /// Tells its letters from those of others.
    pub(crate) tag: u32,
    /// `take`, `hold`, `deaf`, or `gateway`.
    pub(crate) receives: String,
    /// `nothing`, `stream`, `many` (each letter to all) or `loan`.
    pub(crate) sends: String,
    /// To whom, separated by commas.
    pub(crate) to: String,
    /// For `--set`, separated by spaces.
    pub(crate) settings: String,
}

impl Part {
    pub(crate) fn to_words(&self) -> String {
        let tag = self.tag.to_string();
        let words = [&self.name, &tag, &self.receives, &self.sends, &self.to];
        let words: Vec<&str> = words.iter().map(|word| word.as_str()).collect();
        format!("{} {}", words.join(" "), self.settings)
    }

    fn from_words(words: &str) -> Self {
        let mut words = words.splitn(6, ' ').map(str::to_owned);
        let mut word = || words.next().expect("a part of six words");
        Self {
            name: word(),
            tag: word().parse().expect("a number"),
            receives: word(),
            sends: word(),
            to: word(),
            settings: word(),
        }
    }

    fn config(&self) -> Config {
        Config::load(&Sources {
            set: self.settings.split(' ').map(str::to_owned).collect(),
            ..Sources::default()
        })
        .unwrap()
    }
}

fn say(line: std::fmt::Arguments<'_>) {
    let mut out = std::io::stdout().lock();
    // When nobody listens any more, the input ends, too.
    let _ = writeln!(out, "{line}").and_then(|()| out.flush());
}

macro_rules! say {
    ($($line:tt)*) => { say(format_args!($($line)*)) };
}

/// Plays a part until told to quit, or killed.
pub(crate) fn play(words: &str) {
    let part = Part::from_words(words);
    // Ends a line that the test harness may have begun.
    say!("");
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .unwrap();
    let (commands, queue) = channel(16);
    std::thread::spawn(move || {
        for line in std::io::stdin().lock().lines().map_while(Result::ok) {
            if commands.blocking_send(line).is_err() {
                return;
            }
        }
        // Whoever started this is gone.
        std::process::exit(3);
    });
    runtime.block_on(async {
        if part.receives == "gateway" {
            gateway(&part, queue).await;
        } else {
            agent(&part, queue).await;
        }
    });
    say!("bye");
}

async fn gateway(part: &Part, mut queue: Receiver<String>) {
    // One that was killed is in the way until its end has been noticed.
    let mut opened = Gateway::open(&part.config()).await;
    while let Err(fipa::OpenError::GatewayRunning(_)) = opened {
        tokio::time::sleep(Duration::from_millis(20)).await;
        opened = Gateway::open(&part.config()).await;
    }
    let gateway = opened.unwrap();
    let mut ways = gateway.locations().into_iter();
    let way = ways.find(|way| way.kind() == Kind::Tcp).unwrap();
    say!("at {}", way.address());
    say!("ready");
    while queue.recv().await.is_some_and(|line| line != "quit") {}
    gateway.close().await;
}

async fn agent(part: &Part, mut queue: Receiver<String>) {
    let domain = Domain::open(&part.config()).await.unwrap();
    let agent = Arc::new(domain.register(&part.name).unwrap());
    say!("ready");
    let (release, mut released) = channel::<()>(1);
    let receiving = tokio::spawn({
        let (agent, mode) = (agent.clone(), part.receives.clone());
        let own = part.name.clone();
        async move {
            let mut held: Vec<Incoming> = Vec::new();
            loop {
                tokio::select! {
                    incoming = agent.receive(), if mode != "deaf" => {
                        let Ok(incoming) = incoming else { return };
                        take(&incoming, &own);
                        if mode == "hold" && held.len() < HELD {
                            held.push(incoming);
                        }
                    }
                    Some(()) = released.recv() => held.clear(),
                }
            }
        }
    });
    let next = Arc::new(AtomicU32::new(0));
    let sender = Sender {
        agent: agent.clone(),
        tag: part.tag,
        next,
    };
    let sending = tokio::spawn(sender.clone().sends(part.sends.clone(), part.to.clone()));
    while let Some(line) = queue.recv().await {
        let words: Vec<&str> = line.split(' ').collect();
        match words.as_slice() {
            ["send", token, to, count, size] => {
                let (count, size) = (count.parse().unwrap(), size.parse().unwrap());
                let to: Vec<&str> = to.split(',').collect();
                sender.send_all(&to, count, size).await;
                say!("done {token}");
            }
            ["drop"] => release.send(()).await.unwrap(),
            _ => break,
        }
    }
    sending.abort();
    receiving.abort();
    let _ = (sending.await, receiving.await);
    drop((sender, agent));
    domain.close().await;
}

/// Content that only this letter has: its identity, and bytes that follow from it.
fn fill(id: u64, content: &mut [u8]) {
    let mut state = id | 1;
    let (head, rest) = content.split_at_mut(8);
    head.copy_from_slice(&id.to_le_bytes());
    for bytes in rest.chunks_mut(8) {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        let len = bytes.len();
        bytes.copy_from_slice(&state.to_le_bytes()[..len]);
    }
}

fn take(incoming: &Incoming, own: &str) {
    let content = incoming.message.content().cloned().unwrap_or_default();
    // A failure that this agent is told about.
    if incoming.message.performative() != &Performative::Inform {
        return;
    }
    let Some(head) = content.first_chunk() else {
        return say!("torn 0");
    };
    let id = u64::from_le_bytes(*head);
    let mut receivers = incoming.message.receivers().iter();
    let place = receivers.position(|receiver| receiver.name() == own);
    let mut expected = vec![0; content.len()];
    fill(id, &mut expected);
    if expected == content {
        say!("took {}", id + place.unwrap() as u64);
    } else {
        say!("torn {id}");
    }
}

#[derive(Clone)]
struct Sender {
    agent: Arc<Agent>,
    tag: u32,
    next: Arc<AtomicU32>,
}

impl Sender {
    async fn sends(self, mode: String, to: String) {
        let to: Vec<&str> = to.split(',').collect();
        let mut random = fastrand::Rng::with_seed(u64::from(self.tag));
        match mode.as_str() {
            "stream" => {
                let mut sending = JoinSet::new();
                loop {
                    let one = to[random.usize(..to.len())];
                    let to = match random.u8(..4) {
                        0 => owned(&to),
                        _ => owned(&[one]),
                    };
                    let size = SIZES[random.usize(..SIZES.len())];
                    let loans = random.bool();
                    let sender = self.clone();
                    sending.spawn(async move { sender.send(&to, size, loans).await });
                    if sending.len() >= UNDER_WAY {
                        sending.join_next().await;
                    }
                }
            }
            "many" => loop {
                self.send_all(&to, UNDER_WAY, LARGE).await;
            },
            "loan" => {
                let mut loans = Vec::new();
                let each = to.iter().map(|to| owned(&[to]));
                for to in each.chain([owned(&to)]) {
                    for size in SIZES {
                        let mut loan = self.agent.loan(self.message(&to), size).unwrap();
                        fill(0, loan.content_mut());
                        loans.push(loan);
                    }
                }
                say!("loaned");
                std::future::pending::<()>().await;
            }
            _ => {}
        }
    }

    /// Letters, each to all of these.
    async fn send_all(&self, to: &[&str], count: usize, size: usize) {
        let mut sending = JoinSet::new();
        for number in 0..count {
            let (sender, to) = (self.clone(), owned(to));
            sending.spawn(async move { sender.send(&to, size, number % 2 == 0).await });
        }
        sending.join_all().await;
    }

    async fn send(&self, to: &[String], size: usize, loans: bool) {
        let number = self.next.fetch_add(to.len() as u32, Ordering::Relaxed);
        let id = u64::from(self.tag) << 32 | u64::from(number);
        let say_sent = || {
            for (id, to) in (id..).zip(to) {
                say!("sent {id} {to}");
            }
        };
        let deliveries = if loans {
            let mut loan = self.agent.loan(self.message(to), size).unwrap();
            fill(id, loan.content_mut());
            say_sent();
            self.agent.send_loan(loan).await
        } else {
            let mut content = vec![0; size];
            fill(id, &mut content);
            let message = self.builder(to).content(content).build().unwrap();
            say_sent();
            self.agent.send(message).await
        };
        let deliveries = deliveries.unwrap();
        assert_eq!(deliveries.0.len(), to.len(), "{deliveries}");
        for Delivery { receiver, outcome } in &deliveries.0 {
            let place = to.iter().position(|to| **to == **receiver).unwrap();
            let id = id + place as u64;
            match outcome {
                Outcome::Failed { reason, .. } => say!("out {id} {reason:?}"),
                _ => say!("out {id} Delivered"),
            }
        }
    }

    fn message(&self, to: &[String]) -> Message {
        self.builder(to).build().unwrap()
    }

    fn builder(&self, to: &[String]) -> MessageBuilder {
        let message = self.agent.message(Performative::Inform);
        to.iter().fold(message, |message, to| {
            message.receiver(AgentId::new(to).unwrap())
        })
    }
}

fn owned(names: &[&str]) -> Vec<String> {
    names.iter().map(|name| (*name).to_owned()).collect()
}
