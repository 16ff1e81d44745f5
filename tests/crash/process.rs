//! A child process: an agent that sends and receives according to its role and to commands, and
//! prints a line for every event.
//!
//! Output: `ready`; `at ADDRESS` of a gateway; `sent ID TO` before a letter is sent; `out ID
//! OUTCOME` after its outcome; `took ID` for a received letter with intact content; `corrupt ID`
//! for other content; `loaned` after all loans; `done TOKEN` after a command; `bye` at the end. A
//! letter to several receivers has one ID for each, in their order; its content has the first.
//!
//! Input: `send TOKEN TO COUNT SIZE`, `drop`, `quit`. The process ends when its input ends.

use std::io::{BufRead, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use fipa::{
    Agent, AgentId, Config, Delivery, Domain, Gateway, Incoming, Kind, Message, MessageBuilder,
    Outcome, Performative,
};
use tokio::sync::mpsc::{Receiver, channel};
use tokio::task::JoinSet;

use crate::support;

/// Environment variable with the role of a child process.
pub(crate) const ROLE: &str = "FIPA_CRASH_ROLE";

/// Number of letters that a streaming process has under way.
const WINDOW: usize = 6;

/// Number of letters that a holding process keeps.
const HELD: usize = 40;

/// Lengths of contents: copied, in place, of several pages, and in a segment.
pub(crate) const SIZES: [usize; 4] = [40, 1500, 5000, LARGE];

/// Length of content that is stored once for several receivers.
pub(crate) const LARGE: usize = 70_000;

/// The role of a child process. Its fields contain no spaces, except for the last.
#[derive(Debug, Clone)]
pub(crate) struct Role {
    pub(crate) name: String,
    /// Distinguishes the letters of this process from those of others.
    pub(crate) tag: u32,
    /// `take`, `hold`, `ignore`, or `gateway`.
    pub(crate) receives: String,
    /// `nothing`, `stream`, `many` (each letter to all receivers) or `loan`.
    pub(crate) sends: String,
    /// Receivers, separated by commas.
    pub(crate) to: String,
    /// Arguments of `--set`, separated by spaces.
    pub(crate) settings: String,
}

impl Role {
    pub(crate) fn to_words(&self) -> String {
        let tag = self.tag.to_string();
        let words = [&self.name, &tag, &self.receives, &self.sends, &self.to];
        let words: Vec<&str> = words.iter().map(|word| word.as_str()).collect();
        format!("{} {}", words.join(" "), self.settings)
    }

    fn from_words(words: &str) -> Self {
        let mut words = words.splitn(6, ' ').map(str::to_owned);
        let mut word = || words.next().expect("a role of six words");
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
        support::load(self.settings.split(' '))
    }
}

fn say(line: std::fmt::Arguments<'_>) {
    let mut out = std::io::stdout().lock();
    // If the test has ended, the input ends, too.
    let _ = writeln!(out, "{line}").and_then(|()| out.flush());
}

macro_rules! say {
    ($($line:tt)*) => { say(format_args!($($line)*)) };
}

/// Runs a role until the command `quit`.
pub(crate) fn run(words: &str) {
    let role = Role::from_words(words);
    // Ends a line that the test harness may have started.
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
        // The test process has ended.
        std::process::exit(3);
    });
    runtime.block_on(async {
        if role.receives == "gateway" {
            gateway(&role, queue).await;
        } else {
            agent(&role, queue).await;
        }
    });
    say!("bye");
}

async fn gateway(role: &Role, mut queue: Receiver<String>) {
    // A killed gateway holds the lock until its end has been detected.
    let mut opened = Gateway::open(&role.config()).await;
    while let Err(fipa::error::OpenError::GatewayRunning(_)) = opened {
        tokio::time::sleep(Duration::from_millis(20)).await;
        opened = Gateway::open(&role.config()).await;
    }
    let gateway = opened.unwrap();
    let mut locations = gateway.locations().into_iter();
    let location = locations
        .find(|location| location.kind() == Kind::Tcp)
        .unwrap();
    say!("at {}", location.address());
    say!("ready");
    while queue.recv().await.is_some_and(|line| line != "quit") {}
    gateway.close().await;
}

async fn agent(role: &Role, mut queue: Receiver<String>) {
    let domain = Domain::open(&role.config()).await.unwrap();
    let agent = Arc::new(domain.register(&role.name).await.unwrap());
    say!("ready");
    let (release, mut released) = channel::<()>(1);
    let receiving = tokio::spawn({
        let (agent, mode) = (agent.clone(), role.receives.clone());
        let own = role.name.clone();
        async move {
            let mut held: Vec<Incoming> = Vec::new();
            loop {
                tokio::select! {
                    incoming = agent.receive(), if mode != "ignore" => {
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
        tag: role.tag,
        next,
    };
    let sending = tokio::spawn(
        sender
            .clone()
            .run_sender(role.sends.clone(), role.to.clone()),
    );
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

/// Writes content that is unique to this letter: its ID, then bytes derived from it.
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
    let content = incoming.message().content().cloned().unwrap_or_default();
    // Other performatives report failures.
    if incoming.message().performative() != &Performative::Inform {
        return;
    }
    let Some(head) = content.first_chunk() else {
        return say!("corrupt 0");
    };
    let id = u64::from_le_bytes(*head);
    let mut receivers = incoming.message().receivers().iter();
    let index = receivers.position(|receiver| receiver.name() == own);
    let mut expected = vec![0; content.len()];
    fill(id, &mut expected);
    if expected == content {
        say!("took {}", id + index.unwrap() as u64);
    } else {
        say!("corrupt {id}");
    }
}

#[derive(Clone)]
struct Sender {
    agent: Arc<Agent>,
    tag: u32,
    next: Arc<AtomicU32>,
}

impl Sender {
    async fn run_sender(self, mode: String, to: String) {
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
                    if sending.len() >= WINDOW {
                        sending.join_next().await;
                    }
                }
            }
            "many" => loop {
                self.send_all(&to, WINDOW, LARGE).await;
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

    /// Sends letters, each to all of these receivers.
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
            let index = to.iter().position(|to| **to == **receiver).unwrap();
            let id = id + index as u64;
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
