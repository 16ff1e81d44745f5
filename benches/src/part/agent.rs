//! Agents and the gateways between them.
//!
//! An agent's process has one thread with tokio's current-thread runtime. It sends and receives in a
//! task, as an application does: tasks run before the future of `block_on`.

use std::collections::VecDeque;
use std::pin::Pin;

use bytes::{Bytes, BytesMut};
use fipa::error::SendError;
use fipa::{
    AgentId, Config, Deliveries, Domain, Gateway, Matcher, MessageBuilder, Performative, Query,
};
use tokio::io::{AsyncBufReadExt, BufReader, Lines, Stdin};
use tokio::runtime::{Builder, Runtime};

use super::orders::{Fill, Letters, Peer, Sent, Spread, byte_of, check, execute_orders, now_ns};
use crate::error::chain_text;

/// One agent, or several agents that only receive.
pub(super) struct Agent {
    agent: fipa::Agent,
    others: Vec<fipa::Agent>,
    /// A message to the other end, without content.
    message: Option<MessageBuilder>,
    /// A message to each agent of the other end, without content.
    each: Vec<MessageBuilder>,
    orders: Lines<BufReader<Stdin>>,
    /// Content that is used for several letters.
    ready: Bytes,
}

type Sending = Pin<Box<dyn Future<Output = Result<Deliveries, SendError>> + Send>>;

/// The agents of a process and their runtime. The agents are absent while a task uses them.
pub(super) struct Running<A> {
    pub(super) agent: Option<A>,
    pub(super) runtime: Runtime,
}

impl Agent {
    pub(super) fn play(config: &Config, names: &[&str], address: &str) -> Result<(), String> {
        let runtime = runtime()?;
        let domain = runtime.block_on(Domain::open(config)).map_err(chain_text)?;
        let mut agents = Vec::new();
        for name in names {
            agents.push(
                runtime
                    .block_on(domain.register(name))
                    .map_err(chain_text)?,
            );
        }
        let agent = agents.pop().ok_or("no agent was registered")?;
        let orders = runtime.block_on(async { orders() });
        let agent = Self {
            agent,
            others: agents,
            message: None,
            each: Vec::new(),
            orders,
            ready: Bytes::new(),
        };
        let mut running = Running {
            agent: Some(agent),
            runtime,
        };
        execute_orders(&mut running, address.to_owned());
        let Running { agent, runtime } = running;
        drop(agent);
        runtime.block_on(domain.close());
        // The thread that reads standard input may block.
        runtime.shutdown_background();
        Ok(())
    }

    fn begin(
        &mut self,
        letters: &Letters,
        number: usize,
        sent: &mut Sent,
    ) -> Result<Sending, String> {
        let message = self
            .message
            .clone()
            .ok_or("the other end was not found yet")?;
        let byte = byte_of(number);
        if letters.fill == Fill::Copied {
            let content = self.content(letters.size, byte);
            let message = message.content(content).build().map_err(chain_text)?;
            sent.began.push(now_ns());
            return Ok(Box::pin(self.agent.send(message)));
        }
        let message = message.build().map_err(chain_text)?;
        sent.began.push(now_ns());
        let mut loan = self.agent.loan(message, letters.size).map_err(chain_text)?;
        if letters.fill == Fill::Filled {
            loan.content_mut().fill(byte);
        }
        Ok(Box::pin(self.agent.send_loan(loan)))
    }

    /// Content with this first and last byte. The previous content is reused if no letter refers to
    /// it.
    fn content(&mut self, size: usize, byte: u8) -> Bytes {
        let before = std::mem::take(&mut self.ready);
        let mut content = match before.try_into_mut() {
            Ok(content) if content.len() == size => content,
            _ => BytesMut::zeroed(size),
        };
        for at in [0, size.saturating_sub(1)] {
            if let Some(place) = content.get_mut(at) {
                *place = byte;
            }
        }
        let content = content.freeze();
        self.ready = content.clone();
        content
    }
}

impl<A: Send + 'static> Running<A> {
    /// Runs work with the agents in a task.
    pub(super) fn run<T: Send + 'static, F>(
        &mut self,
        work: impl FnOnce(A) -> F + Send + 'static,
    ) -> Result<T, String>
    where
        F: Future<Output = (A, T)> + Send + 'static,
    {
        let agent = self.agent.take().ok_or("the agent is not available")?;
        let task = self.runtime.spawn(async move { work(agent).await });
        let (agent, done) = self.runtime.block_on(task).map_err(chain_text)?;
        self.agent = Some(agent);
        Ok(done)
    }
}

/// Executes orders with one agent.
pub(super) fn play<A: Steps>(
    config: &Config,
    name: &str,
    make: impl FnOnce(fipa::Agent, Lines<BufReader<Stdin>>) -> Result<A, String>,
) -> Result<(), String> {
    let runtime = runtime()?;
    let domain = runtime.block_on(Domain::open(config)).map_err(chain_text)?;
    let agent = runtime.block_on(async {
        let agent = domain.register(name).await.map_err(chain_text)?;
        make(agent, orders())
    })?;
    let mut running = Running {
        agent: Some(agent),
        runtime,
    };
    execute_orders(&mut running, name.to_owned());
    let Running { agent, runtime } = running;
    drop(agent);
    runtime.block_on(domain.close());
    // The thread that reads standard input may block.
    runtime.shutdown_background();
    Ok(())
}

/// Waits until the directory lists the agent of this name.
pub(super) async fn listed(agent: &fipa::Agent, name: &str) -> Result<(), String> {
    let directory = agent.domain().directory();
    let mut changes = directory.watch();
    while directory.lookup(name).is_none() {
        changes.next().await.ok_or("the directory was closed")?;
    }
    Ok(())
}

/// The steps of agents that execute orders in a task.
pub(super) trait Steps: Sized + Send + 'static {
    fn orders(&mut self) -> &mut Lines<BufReader<Stdin>>;

    fn find(&mut self, _to: &str) -> impl Future<Output = Result<(), String>> + Send {
        async { Err("this part does not connect".to_owned()) }
    }

    fn receive(
        &mut self,
        _letters: &Letters,
    ) -> impl Future<Output = Result<Vec<u64>, String>> + Send {
        async { Err("this part does not receive".to_owned()) }
    }

    fn send(&mut self, _letters: &Letters) -> impl Future<Output = Result<Sent, String>> + Send {
        async { Err("this process does not send".to_owned()) }
    }

    fn spread(
        &mut self,
        _what: Spread,
        _letters: &Letters,
    ) -> impl Future<Output = Result<Sent, String>> + Send {
        async { Err("this part sends to one receiver only".to_owned()) }
    }
}

impl Steps for Agent {
    fn orders(&mut self) -> &mut Lines<BufReader<Stdin>> {
        &mut self.orders
    }

    async fn find(&mut self, to: &str) -> Result<(), String> {
        let all = Query::by_name(Matcher::parse(to).map_err(chain_text)?);
        let directory = self.agent.domain().directory();
        let mut changes = directory.watch();
        let found = loop {
            // A lookup reads changes of the directory; a search does not.
            let _one = directory.lookup(to);
            let found = directory.search(&all);
            if !found.is_empty() {
                break found;
            }
            changes.next().await.ok_or("the directory was closed")?;
        };
        let message = |to: &str| {
            let message = self.agent.message(Performative::Inform);
            Ok::<_, String>(message.receiver(AgentId::new(to).map_err(chain_text)?))
        };
        let each = found.iter().map(|entry| message(&entry.name));
        let each = each.collect::<Result<_, _>>()?;
        self.message = Some(message(to)?);
        self.each = each;
        Ok(())
    }

    async fn receive(&mut self, letters: &Letters) -> Result<Vec<u64>, String> {
        let mut at = Vec::with_capacity(letters.count);
        for number in 0..letters.count {
            for other in &self.others {
                let incoming = other.receive().await.map_err(chain_text)?;
                let content = incoming.content().ok_or("no content")?;
                check(&content, letters, number)?;
            }
            let incoming = self.agent.receive().await.map_err(chain_text)?;
            at.push(now_ns());
            let content = incoming.content().ok_or("no content")?;
            check(&content, letters, number)?;
        }
        Ok(at)
    }

    async fn spread(&mut self, what: Spread, letters: &Letters) -> Result<Sent, String> {
        let mut sent = Sent::with_room(letters);
        for number in 0..letters.count {
            let byte = byte_of(number);
            if what == Spread::Copies {
                let content = self.content(letters.size, byte);
                let each = self.each.iter().cloned();
                let messages = each.map(|message| message.content(content.clone()).build());
                let messages = messages
                    .collect::<Result<Vec<_>, _>>()
                    .map_err(chain_text)?;
                sent.began.push(now_ns());
                let sending = messages.into_iter().map(|one| self.agent.send(one));
                let sending: Vec<_> = sending.collect();
                for one in sending {
                    delivered(one.await)?;
                }
            } else {
                let message = self
                    .message
                    .clone()
                    .ok_or("the other end was not found yet")?;
                let message = message.build().map_err(chain_text)?;
                sent.began.push(now_ns());
                let mut loan = self.agent.loan(message, letters.size).map_err(chain_text)?;
                loan.content_mut().fill(byte);
                if what == Spread::Together {
                    delivered(self.agent.send_loan(loan).await)?;
                }
            }
            sent.ended.push(now_ns());
        }
        Ok(sent)
    }

    async fn send(&mut self, letters: &Letters) -> Result<Sent, String> {
        let mut sent = Sent::with_room(letters);
        let mut under_way: VecDeque<Sending> = VecDeque::with_capacity(letters.window);
        for number in 0..letters.count {
            if under_way.len() >= letters.window
                && let Some(first) = under_way.pop_front()
            {
                delivered(first.await)?;
                sent.ended.push(now_ns());
            }
            under_way.push_back(self.begin(letters, number, &mut sent)?);
        }
        for rest in under_way {
            delivered(rest.await)?;
            sent.ended.push(now_ns());
        }
        Ok(sent)
    }
}

impl<A: Steps> Peer for Running<A> {
    /// The runtime runs meanwhile, so the agents answer at any time.
    fn next_order(&mut self) -> Option<String> {
        self.run(|mut agent| async move {
            let line = agent.orders().next_line().await;
            (agent, line)
        })
        .ok()?
        .ok()?
    }

    fn find(&mut self, to: &str) -> Result<(), String> {
        let to = to.to_owned();
        self.run(|mut agent| async move {
            let found = agent.find(&to).await;
            (agent, found)
        })?
    }

    fn receive(&mut self, letters: &Letters) -> Result<Vec<u64>, String> {
        let letters = *letters;
        self.run(move |mut agent| async move {
            let received = agent.receive(&letters).await;
            (agent, received)
        })?
    }

    fn send(&mut self, letters: &Letters) -> Result<Sent, String> {
        let letters = *letters;
        self.run(move |mut agent| async move {
            let sent = agent.send(&letters).await;
            (agent, sent)
        })?
    }

    fn spread(&mut self, what: Spread, letters: &Letters) -> Result<Sent, String> {
        let letters = *letters;
        self.run(move |mut agent| async move {
            let sent = agent.spread(what, &letters).await;
            (agent, sent)
        })?
    }
}

/// A gateway. Its address is that of its network transport; it answers only with its processor time.
struct Forwarding {
    orders: Lines<BufReader<Stdin>>,
    runtime: Runtime,
}

impl Peer for Forwarding {
    fn next_order(&mut self) -> Option<String> {
        let Self { orders, runtime } = self;
        runtime.block_on(orders.next_line()).ok().flatten()
    }
}

pub(super) fn gateway(config: &Config) -> Result<(), String> {
    let runtime = runtime()?;
    let gateway = runtime
        .block_on(Gateway::open(config))
        .map_err(chain_text)?;
    let locations = gateway.locations();
    let mut remote = locations.iter().filter(|it| !it.kind().is_host_local());
    let address = remote
        .next()
        .map(|it| format!("{}://{}", it.kind(), it.address()));
    let orders = runtime.block_on(async { orders() });
    let mut forwarding = Forwarding { orders, runtime };
    execute_orders(&mut forwarding, address.unwrap_or_default());
    let runtime = forwarding.runtime;
    runtime.block_on(gateway.close());
    runtime.shutdown_background();
    Ok(())
}

pub(super) fn runtime() -> Result<Runtime, String> {
    let runtime = Builder::new_current_thread().enable_all().build();
    runtime.map_err(|error| format!("cannot start the runtime: {error}"))
}

pub(super) fn orders() -> Lines<BufReader<Stdin>> {
    BufReader::new(tokio::io::stdin()).lines()
}

fn delivered(result: Result<Deliveries, SendError>) -> Result<(), String> {
    let deliveries = result.map_err(chain_text)?;
    if deliveries.all_succeeded() {
        return Ok(());
    }
    Err(deliveries.to_string())
}
